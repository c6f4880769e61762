"""A small part of benchmarks/kills.py: runs that are killed, run side by side, and meet a full disk."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rosbags", reason="its recordings stand beside a bag: pip install 'yid-ocp[bags]'")
FOLDER = Path(__file__).parents[1] / "benchmarks"


@pytest.mark.slow
def test_disturbed_runs_lose_nothing():
    counts = ("--kills", "12", "--pairs", "3", "--disks", "6", "--caches", "2", "--seed", "1")
    done = subprocess.run([sys.executable, FOLDER / "kills.py", *counts], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    assert json.loads(done.stdout.splitlines()[-1])["wrong"] == 0

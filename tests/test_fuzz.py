"""Damaged inputs are read or refused in words: some of them, and many as a slow test; see benchmarks/fuzz.py."""

from __future__ import annotations

import inspect
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from yid_ocp.errors import DataError
from yid_ocp.vision.frames import import_open3d

pytest.importorskip("rosbags", reason="bags need rosbags: pip install '.[bags]'")


@pytest.fixture(scope="module")
def fuzz(benchmark_module):
    try:
        import_open3d()
    except DataError as error:
        pytest.skip(str(error))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))  # its workers find it by its name
        yield benchmark_module("fuzz")


def test_some_damaged_inputs(fuzz):
    cases = [fuzz.Case(kind, seed) for kind in fuzz.KINDS for seed in ((0, 1) if fuzz.SHARES[kind] > 1 else (0,))]
    count, found = fuzz.hunt(iter(cases), 600.0, 1)
    assert [f"{case.kind} --only {case.seed}: {said}" for case, said in found] == []
    assert count == len(cases)


@pytest.mark.slow
def test_twenty_thousand_damaged_inputs(fuzz):
    count, found = fuzz.hunt(fuzz.drawn(list(fuzz.KINDS), 20_000, 100_000), 7200.0, 2)
    assert found == []
    assert count == 20_000


def test_what_is_wrong_is_found(fuzz, tmp_path, monkeypatch):
    """Exceptions that are not ours, and files that are left."""
    (tmp_path / "valid").mkdir()
    fuzz.originals(tmp_path / "valid")
    monkeypatch.chdir(tmp_path)

    def said(probe) -> str:
        monkeypatch.setitem(fuzz.KINDS, "csv", probe)
        monkeypatch.setattr(fuzz, "MEMORY", 1 << 60)
        return fuzz.tried(fuzz.Case("csv", 1), tmp_path / "valid", tmp_path / "room" / "work")

    (tmp_path / "room").mkdir()
    assert said(lambda folder, rng: None) == ""
    assert said(lambda folder, rng: 1 / 0).startswith("ZeroDivisionError")
    assert "left" in said(lambda folder, rng: Path("left.txt").touch())
    (tmp_path / "room" / "stand" / "left.txt").unlink()
    assert said(fuzz.probe_csv) == ""


def test_memory_of_the_process_that_starts_an_input_does_not_count(fuzz):
    large = np.ones(2**25)
    del large
    code = f"from pathlib import Path\n{inspect.getsource(fuzz.peak_memory)}\nprint(peak_memory())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 2**27 < 2**28 < fuzz.peak_memory()


def test_a_process_that_dies_is_said_and_the_others_go_on(fuzz):
    cases = iter([fuzz.Case("csv", 1), fuzz.Case("no such kind", 1), fuzz.Case("csv", 2)])
    count, found = fuzz.hunt(cases, 60.0, 1)
    assert count == 3
    assert [(case.kind, said) for case, said in found] == [("no such kind", "its process ended with 1")]

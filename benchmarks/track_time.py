"""Processor time of a frame of `track`, from the filtered cloud to the fitted points.

    python benchmarks/track_time.py [CONFIG ...]

The shipped configurations of one and two arms, whose virtual cameras film MuJoCo, when none is named; ten frames a
second are wanted.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

from yid_ocp.config.reader import load_config
from yid_ocp.report.terminal import table
from yid_ocp.workflow.track import run_track

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
SHIPPED = (CONFIGS / "track_single_arm.yaml", CONFIGS / "track_dual_arm.yaml")


def main() -> int:
    """Track and print one table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("configs", metavar="CONFIG", nargs="*", type=Path, default=SHIPPED)
    rows = [("configuration", "frames", "mean [s]", "largest [s]")]
    for config in parser.parse_args().configs:
        with tempfile.TemporaryDirectory() as folder:
            found = run_track(load_config(config, ["output.report=false"]), Path(folder) / "run").track
        spent = [frame.seconds for frame in found.frames if frame.fit is not None]
        rows.append((config.stem, str(len(spent)), f"{np.mean(spent):.3f}", f"{np.max(spent):.3f}"))
    print("\n".join(table(rows)))
    return 0


if __name__ == "__main__":
    sys.exit(main())

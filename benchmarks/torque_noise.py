"""How wrong and how rough a real arm's recorded torques are: what the noise of virtual experiments stands for.

    python benchmarks/torque_noise.py [CONFIG]

For every joint of Baxter's left arm in free motion (`configs/baxter_arm.yaml`), over the recordings that it lists:

- white noise: square root of the power spectral density above 30 Hz, where the arm hardly moves, taken as white over
  the whole band (median over the recordings);
- roughness: rms of the second difference from one sample of 10 ms to the next;
- offset: what is added to the torque of a whole recording alike, fitted to each recording by itself beside the joints'
  dampings and the spring at the shoulder. The rigid model's own errors of gravity are in it, so its rms is an upper
  bound of what the sensor adds; its spread from recording to recording, whose postures are much alike, a lower one (at
  left_s1 the spring takes some of it).
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy.signal
from numpy.typing import NDArray

from yid_ocp.config.reader import load_config
from yid_ocp.data import Recording, read_recording
from yid_ocp.report.terminal import aligned_table_lines
from yid_ocp.workflow.solve import run_solve

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "baxter_arm.yaml"
QUIET_ABOVE = 30.0  # [Hz]

Array = NDArray[np.float64]


def white_std(recording: Recording) -> Array:
    """Standard deviation of white noise with the torques' density above 30 Hz, shape (nj,) [N m]."""
    joints = recording.joints
    assert joints is not None
    assert joints.effort is not None
    rate = 1.0 / float(np.median(np.diff(joints.t)))
    frequency, density = scipy.signal.welch(joints.effort, rate, axis=0)
    return np.asarray(np.sqrt(density[frequency > QUIET_ABOVE].mean(0) * rate / 2))


def roughness(recording: Recording) -> Array:
    """Rms of the torques' second differences, shape (nj,) [N m]."""
    assert recording.joints is not None
    assert recording.joints.effort is not None
    return np.asarray(np.diff(recording.joints.effort, 2, axis=0).std(0))


def offsets(config: Path, recording: str, joints: Sequence[str]) -> Array:
    """Constant error of each joint's torque in one recording [N m]."""
    effects = ["{kind: joint_spring, location: left_s1, values: {stiffness: 10.0}}"]
    effects += [f"{{kind: effort_offset, location: {joint}}}" for joint in joints]
    free = ["left_*.damping", "joint_spring@left_s1.stiffness", "joint_spring@left_s1.rest_angle"]
    free += [f"effort_offset@{joint}.offset" for joint in joints]
    settings = [
        f"recordings.estimate=[{json.dumps(recording)}]",
        "recordings.held_out=[]",
        f"model.effects=[{', '.join(effects)}]",
        "parameters={}",
        f"parameters={{{', '.join(f'{json.dumps(name)}: {{free: true}}' for name in free)}}}",
        "output.write_report=false",
    ]
    with tempfile.TemporaryDirectory() as folder:
        found = run_solve(load_config(config, settings), Path(folder) / "run").result["parameters"]
    return np.array([found[f"effort_offset@{joint}.offset"]["value"] for joint in joints])


def main() -> None:
    parser = argparse.ArgumentParser(description="How wrong and how rough a real arm's recorded torques are.")
    parser.add_argument("config", nargs="?", type=Path, default=CONFIG)
    config = parser.parse_args().config
    given = load_config(config).recordings
    files = [*given.estimate, *given.held_out]
    recordings = [read_recording(file) for file in files]
    joints = recordings[0].joint_names
    white = np.median([white_std(entry) for entry in recordings], axis=0)
    rough = np.median([roughness(entry) for entry in recordings], axis=0)
    constant = np.array([offsets(config, file, joints) for file in files])
    heads = ("joint", "white [N m]", "second difference [N m]", "offset, rms [N m]", "offset, spread [N m]")
    columns = (white, rough, np.sqrt((constant**2).mean(0)), constant.std(0, ddof=1))
    rows = [(name, *(f"{column[i]:.3f}" for column in columns)) for i, name in enumerate(joints)]
    print("\n".join(aligned_table_lines([heads, *rows])))


if __name__ == "__main__":
    main()

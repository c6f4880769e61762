"""Recordings that the tests of this folder share."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st

from yid_ocp.data.readers import read_any
from yid_ocp.data.recording import JOINT_CHANNEL_UNITS, JointGroup, PointGroup, Recording
from yid_ocp.errors import DataError


def turned(angle: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = [1.0, 2.0, 3.0]
    return pose


def example() -> Recording:
    generator = np.random.default_rng(0)
    t = np.arange(50) / 100
    channels: dict[str, Any] = {
        channel: generator.normal(size=(50, 2)) if unit != "1" else generator.integers(0, 2, (50, 2))
        for channel, unit in JOINT_CHANNEL_UNITS.items()
    }
    stds: dict[str, Any] = {"position_std": 1e-3, "velocity_std": [0.01, 0.02], "effort_bias_std": [0.2, 0.3]}
    joints = JointGroup(("left_s0", "left_s1"), t, **channels, **stds, effort_kind="mean")
    seen = generator.normal(size=(4, 3, 3))
    seen[1, 2] = np.nan
    own = np.array([0.0, 0.1, 0.35, 0.9]), seen, np.full((4, 3, 3), 0.01), "camera", "world", turned(0.3)
    camera = PointGroup("points_camera", ("w_T1", "w_T2", "w_T3"), *own, clock_offset_std=0.02)
    arm = PointGroup("points_arm", ("w_T2",), t, generator.normal(size=(50, 1, 3)), sensor_name="arm", clock="nominal")
    truth = {"T1.bend": 22.0, "T1.twist": 3}
    return Recording(joints, (arm, camera), "a test", "nowhere", "example", true_parameters=truth)


def with_joints(**changes: Any) -> Recording:
    recording = example()
    return dataclasses.replace(recording, joints=dataclasses.replace(joints_of(recording), **changes))


def with_camera(**changes: Any) -> Recording:
    arm, camera = example().points
    return dataclasses.replace(example(), points=(arm, dataclasses.replace(camera, **changes)))


def changed(array: np.ndarray, index: Any, value: float) -> np.ndarray:
    array = array.copy()
    array[index] = value
    return array


def assert_same(left: Recording, right: Recording) -> None:
    np.testing.assert_equal(contents(left), contents(right))


def contents(recording: Recording) -> dict[str, Any]:
    """What a file keeps of a recording."""
    whole = {key: value for key, value in vars(recording).items() if key not in ("name", "sha256")}
    joints = vars(recording.joints) if recording.joints is not None else None
    return {**whole, "joints": joints, "points": [vars(group) for group in recording.points]}


def finite(bound: float) -> st.SearchStrategy[float]:
    return st.floats(-bound, bound, allow_nan=False)


def table(folder: Path, text: str, name: str = "run.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def refused(path: Path, message: str, read: Callable[..., object] = read_any, **options: Any) -> DataError:
    """The error that reading ends with."""
    with pytest.raises(DataError, match=message) as caught:
        read(path, **options)
    return caught.value


def joints_of(recording: Recording) -> JointGroup:
    assert recording.joints is not None
    return recording.joints

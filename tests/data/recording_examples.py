"""Recordings that the tests of this folder share."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from yid_ocp.data.recording import JOINT_CHANNEL_UNITS, JointGroup, PointGroup, Recording


def turned(angle: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = [1.0, 2.0, 3.0]
    return pose


def example() -> Recording:
    generator = np.random.default_rng(0)
    t = np.arange(50) / 100
    joints = JointGroup(
        names=("left_s0", "left_s1"),
        t=t,
        **{  # type: ignore[arg-type]
            channel: generator.normal(size=(50, 2)) if unit != "1" else generator.integers(0, 2, (50, 2))
            for channel, unit in JOINT_CHANNEL_UNITS.items()
        },
        position_std=1e-3,
        velocity_std=np.array([0.01, 0.02]),
        effort_bias_std=np.array([0.2, 0.3]),
        effort_kind="mean",
    )
    frames = np.array([0.0, 0.1, 0.35, 0.9])
    seen = generator.normal(size=(4, 3, 3))
    seen[1, 2] = np.nan
    camera = PointGroup(
        "points_camera",
        ("w_T1", "w_T2", "w_T3"),
        frames,
        seen,
        np.full((4, 3, 3), 0.01),
        "camera",
        "world",
        turned(0.3),
    )
    arm = PointGroup("points_arm", ("w_T2",), t, generator.normal(size=(50, 1, 3)), sensor="arm", clock="nominal")
    return Recording(
        joints, (arm, camera), "a test", "nowhere", "example", true_parameters={"T1.bend": 22.0, "T1.twist": 3}
    )


def with_joints(**changes: Any) -> Recording:
    recording = example()
    assert recording.joints is not None
    return dataclasses.replace(recording, joints=dataclasses.replace(recording.joints, **changes))


def with_camera(**changes: Any) -> Recording:
    recording = example()
    return dataclasses.replace(
        recording, points=(recording.points[0], dataclasses.replace(recording.points[1], **changes))
    )


def changed(array: np.ndarray, index: Any, value: float) -> np.ndarray:
    array = array.copy()
    array[index] = value
    return array


def assert_same(left: Recording, right: Recording) -> None:
    assert (left.description, left.source, left.true_parameters) == (
        right.description,
        right.source,
        right.true_parameters,
    )
    assert (left.marker_reference_pose is None) == (right.marker_reference_pose is None)
    if left.marker_reference_pose is not None and right.marker_reference_pose is not None:
        assert np.array_equal(left.marker_reference_pose, right.marker_reference_pose)
    assert [type(group) for group in left.groups] == [type(group) for group in right.groups]
    for one, other in zip(left.groups, right.groups, strict=True):
        for field in dataclasses.fields(one):
            ours, theirs = getattr(one, field.name), getattr(other, field.name)
            if isinstance(ours, np.ndarray):
                assert np.array_equal(ours, theirs, equal_nan=True), field.name
            else:
                assert ours == theirs, field.name


def finite(bound: float) -> st.SearchStrategy[float]:
    return st.floats(-bound, bound, allow_nan=False)


def table(folder: Path, text: str, name: str = "run.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def joints_of(recording: Recording) -> JointGroup:
    assert recording.joints is not None
    return recording.joints

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_examples import assert_same, changed, example, finite, joints_of, with_camera, with_joints

from yid_ocp.data.recording import JointGroup, Recording, validated_recording
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.errors import DataError

# ------------------------------------------------------------------------------------------------------ in memory


def test_arrays_are_copied_and_read_only_and_not_ragged() -> None:
    t = np.array([0.0, 1.0])
    group = JointGroup(("a",), t, np.zeros((2, 1)), effort=np.ones((2, 1)))
    t[0] = -1.0
    assert group.t[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        group.t[0] = 5.0
    assert list(group.values_by_channel) == ["position", "effort"]
    with pytest.raises(DataError, match="not an array of numbers"):
        JointGroup(("a",), [0.0, 1.0], [[0.0], [1.0, 2.0]])  # type: ignore[arg-type]


def test_names_and_duration() -> None:
    recording = example()
    assert recording.joint_names == ("left_s0", "left_s1")
    assert recording.point_names == ("w_T2", "w_T1", "w_T3")
    assert recording.duration == pytest.approx(0.9)
    assert Recording(points=recording.points[:1]).joint_names == ()


def test_slice_keeps_each_clock_and_both_ends_and_drops_groups_without_samples() -> None:
    part = example().time_slice(0.1, 0.4)
    joints = joints_of(part)
    assert joints.t[[0, -1]] == pytest.approx([0.1, 0.4])
    assert joints.values_by_channel["effort"].shape == (31, 2)
    assert list(part.points[1].t) == [0.1, 0.35]
    assert np.shape(part.points[1].std) == (2, 3, 3)
    assert_same(part, validated_recording(part))
    part = example().time_slice(0.6, 1.0)
    assert part.joints is None
    assert [group.name for group in part.points] == ["points_camera"]


@pytest.mark.parametrize("bounds", [(5.0, 6.0), (0.4, 0.1), (0.1, 0.1), (float("nan"), 1.0)])
def test_an_empty_slice_is_refused(bounds: tuple[float, float]) -> None:
    with pytest.raises(DataError, match="nothing was recorded") as caught:
        example().time_slice(*bounds)
    assert "0 s to 0.9 s" in caught.value.allowed


def test_positions_of_the_straight_object_follow_their_points() -> None:
    straight = np.arange(9.0).reshape(3, 3)
    recording = validated_recording(
        dataclasses.replace(example(), points=example().points[1:], marker_reference_pose=straight)
    )
    assert recording.marker_reference_pose is not None
    with pytest.raises(ValueError, match="read-only"):
        recording.marker_reference_pose[0, 0] = 5.0
    assert np.array_equal(validated_recording(recording.time_slice(0.0, 0.2)).marker_reference_pose, straight)
    assert recording.time_slice(0.4, 0.45).marker_reference_pose is None, "no frame of the points lies in between"


@given(st.lists(finite(1e6), min_size=2, max_size=20, unique=True), finite(1e6), finite(1e6))
def test_a_slice_holds_just_the_times_in_between(times: list[float], one: float, other: float) -> None:
    t, start, stop = np.array(sorted(times)), min(one, other), max(one, other)
    recording = Recording(JointGroup(("a",), t, np.zeros((len(t), 1))))
    expected = t[(t >= start - 1e-9) & (t <= stop + 1e-9)]
    if start == stop or not len(expected):
        with pytest.raises(DataError):
            recording.time_slice(start, stop)
    else:
        assert np.array_equal(joints_of(recording.time_slice(start, stop)).t, expected)


# ---------------------------------------------------------------------------------------------------- validation

BASE = example()
T, Q, CAMERA = joints_of(BASE).t, joints_of(BASE).position, BASE.points[1]


def with_straight(straight: np.ndarray, **changes: Any) -> Recording:
    return dataclasses.replace(BASE, marker_reference_pose=straight, **changes)


INVALID: dict[str, tuple[Callable[[], Recording], str]] = {
    "no group": (lambda: Recording(), "no measurements"),
    "no samples": (lambda: with_joints(t=np.empty(0), position=np.empty((0, 2))), "no samples"),
    "no names": (lambda: with_joints(names=()), "no names"),
    "empty name": (lambda: with_joints(names=("a", "")), "'' cannot be used"),
    "name not text": (lambda: with_joints(names=("a", 1)), "1 cannot be used"),
    "null in a name": (lambda: with_joints(names=("a", "b\0c")), "cannot be used"),
    "null in the frame": (lambda: with_camera(frame="\0"), "cannot be stored"),
    "half a letter": (lambda: dataclasses.replace(BASE, source="\ud800"), "cannot be stored"),
    "repeated joint": (lambda: with_joints(names=("a", "a")), "'a' occurs 2 times"),
    "repeated point": (lambda: with_camera(names=("a", "b", "a")), "'a' occurs 2 times"),
    "repeated group": (lambda: dataclasses.replace(BASE, points=(CAMERA, CAMERA)), "two groups of points"),
    "name of group": (lambda: with_camera(name="camera"), "a group of points is called 'camera'"),
    "clock kind": (lambda: with_joints(clock="wall"), "the clock is 'wall'"),
    "shape of t": (lambda: with_joints(t=T[:, None]), r"shape \(50, 1\)"),
    "length of t": (lambda: with_joints(t=T[:-1]), r"shape \(50, 2\)"),
    "shape of position": (lambda: with_joints(position=Q[:, :1]), r"shape \(50, 1\)"),
    "shape of effort": (lambda: with_joints(effort=Q[:-1]), r"shape \(49, 2\)"),
    "shape of points": (lambda: with_camera(position=CAMERA.position[..., :2]), r"shape \(4, 3, 2\)"),
    "shape of std": (lambda: with_camera(std=np.ones((4, 3))), r"shape \(4, 3\)"),
    "shape of joint std": (lambda: with_joints(effort_std=np.ones(3)), r"shape \(3,\)"),
    "clock offset": (lambda: with_camera(clock_offset_std=-1.0), "clock_offset_std is -1.0"),
    "shape of pose": (lambda: with_camera(camera_pose=np.eye(3)), r"shape \(3, 3\)"),
    "infinite time": (lambda: with_joints(t=changed(T, 7, np.inf)), "time at index 7 is inf"),
    "time going back": (lambda: with_joints(t=changed(T, 4, 0.02)), r"from sample 4 to 5: 0\.03 s, then 0\.02 s"),
    "time standing": (lambda: with_camera(t=np.zeros(4)), "from sample 1 to 2: 0.0 s, then 0.0 s"),
    "NaN position": (
        lambda: with_joints(position=changed(Q, ([5, 6, 8], 1), np.nan)),
        r"'position' has 3 missing or infinite values, the first of joint 'left_s1' at t = 0\.05 s",
    ),
    "NaN velocity": (lambda: with_joints(velocity=changed(Q, (2, 0), np.nan)), "'velocity' has 1 .* joint 'left_s0'"),
    "NaN effort": (lambda: with_joints(effort=changed(Q, (2, 0), np.nan)), "'effort' has 1 missing .* joint 'left_s0'"),
    "infinite effort": (lambda: with_joints(external_effort=changed(Q, (0, 0), np.inf)), "'external_effort' has 1"),
    "infinite point": (lambda: with_camera(position=changed(CAMERA.position, (0, 0, 0), np.inf)), "'w_T1' is .*inf"),
    "half seen": (lambda: with_camera(position=changed(CAMERA.position, (3, 1, 2), np.nan)), "'w_T2' is .*nan"),
    "negative std": (lambda: with_camera(std=changed(np.ones((4, 3, 3)), (0, 0, 0), -0.5)), "that was seen is -0.5 m"),
    "NaN std": (lambda: with_camera(std=changed(np.ones((4, 3, 3)), (0, 0, 0), np.nan)), "that was seen is nan m"),
    "negative joint std": (lambda: with_joints(position_std=-1.0), "position_std is -1.0"),
    "NaN joint std": (lambda: with_joints(velocity_std=np.array([0.1, np.nan])), "velocity_std is"),
    "negative bias": (lambda: with_joints(effort_bias_std=-0.1), "effort_bias_std is -0.1"),
    "shape of bias": (lambda: with_joints(effort_bias_std=np.ones(3)), r"shape \(3,\)"),
    "kind of effort": (lambda: with_joints(effort_kind="average"), "effort_kind is 'average', which is unknown"),
    "NaN pose": (lambda: with_camera(camera_pose=changed(np.eye(4), (0, 3), np.nan)), "value that is not finite"),
    "last row": (lambda: with_camera(camera_pose=changed(np.eye(4), (3, 0), 1.0)), "the pose has the last row"),
    "scaled pose": (lambda: with_camera(camera_pose=np.diag([2.0, 2.0, 2.0, 1.0])), "not orthonormal"),
    "reflection": (lambda: with_camera(camera_pose=np.diag([1.0, 1.0, -1.0, 1.0])), "reflection"),
    "degrees": (lambda: with_joints(position=Q + 90.0), "'position' reaches 9"),
    "--units deg": (lambda: with_joints(position_command=Q - 90.0), "'position_command' reaches 9"),
    "efforts of no robot": (lambda: with_joints(effort=np.full_like(Q, 1e300)), "'effort' reaches 1e\\+300 N m"),
    "speeds of no robot": (lambda: with_joints(velocity=np.full_like(Q, -1e7)), "'velocity' reaches 1e\\+07 rad/s"),
    "a spread of no robot": (lambda: with_joints(effort_std=1e200), "effort_std is 1e\\+200"),
    "an endless spread": (lambda: with_joints(effort_std=np.inf), "effort_std is inf"),
    "millimetres": (lambda: with_camera(position=1e3 * CAMERA.position), "a coordinate reaches"),
    "straight without points": (lambda: with_straight(np.zeros((1, 3)), points=()), "but no group of points"),
    "straight of others": (lambda: with_straight(np.zeros((3, 3))), r"shape \(3, 3\)"),
    "straight unseen": (lambda: with_straight(np.array([[0.0, np.nan, 0.0]])), "has a position that is not finite"),
    "straight in millimetres": (lambda: with_straight(np.array([[100.0, 0.0, 0.0]])), "a coordinate reaches 100 m"),
    "straight of a later group": (
        lambda: with_straight(np.zeros((3, 3)), points=BASE.points[::-1]),
        "belong to 'points_camera', but a file would list 'points_arm' first",
    ),
    "truth not finite": (lambda: dataclasses.replace(BASE, true_parameters={"T1.bend": np.inf}), "'T1.bend' is inf"),
    "truth not a number": (lambda: dataclasses.replace(BASE, true_parameters={"T1.bend": "3"}), "is '3'"),  # type: ignore[dict-item]
}


@pytest.mark.parametrize("case", INVALID)
def test_invalid_recordings_are_refused(case: str, tmp_path: Path) -> None:
    make, message = INVALID[case]
    with pytest.raises(DataError, match=message) as caught:
        validated_recording(make())
    assert "recording '" in caught.value.where
    assert case not in ("degrees", "millimetres", "--units deg") or case in caught.value.hint
    if case != "NaN effort":
        with pytest.raises(DataError, match=message):
            write_recording(make(), tmp_path / "run.h5")
        assert not list(tmp_path.iterdir())


def test_nan_effort_on_request() -> None:
    recording = with_joints(effort=changed(Q, (2, 0), np.nan))
    assert validated_recording(recording, allow_nan_effort=True) is recording
    with pytest.raises(DataError, match="velocity"):
        validated_recording(with_joints(velocity=changed(Q, (2, 0), np.nan)), allow_nan_effort=True)


def test_a_point_may_never_be_seen_and_its_std_be_nan_then() -> None:
    std = np.where(np.isnan(CAMERA.position), np.nan, 0.01)
    for recording in (with_camera(std=std), with_camera(position=np.full((4, 3, 3), np.nan))):
        assert validated_recording(recording) is recording

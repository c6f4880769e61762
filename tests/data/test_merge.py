"""Recordings of one run by several devices become one: clocks, offsets, what is said of them."""

from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.data import JointGroup, PointGroup, Recording
from yid_ocp.data.checks import recording_quality_issues
from yid_ocp.data.merge import merge_recordings
from yid_ocp.errors import DataError
from yid_ocp.sensors import SensorOptions


def wander(t: np.ndarray, seed: int) -> np.ndarray:
    """Angles of two joints [rad]: sums of sines of unrelated periods."""
    rng = np.random.default_rng(seed)
    waves = zip(rng.uniform(0.1, 0.4, 12), rng.uniform(0.5, 6, 12), rng.uniform(0, 6, 12), strict=True)
    parts = [size * np.sin(speed * t + phase) for size, speed, phase in waves]
    return np.stack([sum(parts[:6]), sum(parts[6:])], axis=1)


def tip(angles: np.ndarray) -> np.ndarray:
    """End of a planar arm of two rods of 0.5 m, shape (N, 1, 3)."""
    along = np.cumsum(angles, axis=1)
    place = 0.5 * np.stack([np.cos(along).sum(axis=1), np.sin(along).sum(axis=1), np.zeros(len(along))], axis=1)
    return place[:, None]


T, FRAMES = np.arange(0, 20, 0.005), np.arange(0, 19, 0.01)
ROBOT = Recording(JointGroup(("a", "b"), T, wander(T, 0)), name="robot")


def camera(late: float = 0.0, start: float = 0.0) -> Recording:
    """Points on a clock that shows `start` where the robot's shows zero, and that come `late`."""
    seen = tip(wander(FRAMES - late, 0)) + 5e-4 * np.random.default_rng(1).standard_normal((len(FRAMES), 1, 3))
    return Recording(None, (PointGroup("points", ("tip",), FRAMES + start, seen),), name="camera")


def test_a_shared_clock_is_left_as_it_is_and_said() -> None:
    merged = merge_recordings([camera(), ROBOT])
    assert np.array_equal(merged.joints.t, T)
    assert np.array_equal(merged.points[0].t, FRAMES)
    [note] = merged.notes
    assert all(fact in note for fact in ("robot and camera", "one clock", "18.99 of 20 s")), note


@pytest.mark.parametrize("late", [0.08, 1.5])
def test_points_that_are_late_on_a_shared_clock_are_said_but_not_shifted(late: float) -> None:
    merged = merge_recordings([ROBOT, camera(late)])
    assert np.array_equal(merged.points[0].t, FRAMES)
    [note] = merged.notes
    assert "if shifted by -" in note
    offset = float(note.partition("--clock-offset camera=")[2].rstrip(")"))
    assert offset == pytest.approx(-late, abs=0.05)
    [issue] = recording_quality_issues(merged, lambda group: SensorOptions())
    assert (issue.cause, issue.severity) == ("clock_offset", "warning")
    assert issue.setting == f"sensors.points.clock_offset_std: {-offset:g}"
    assert recording_quality_issues(merged, lambda group: SensorOptions(clock_offset_std=0.1)) == []
    assert np.allclose(merge_recordings([ROBOT, camera(late)], {"camera": -late}).points[0].t, FRAMES - late)


def test_clocks_without_anything_in_common_are_aligned_by_the_motion() -> None:
    merged = merge_recordings([ROBOT, camera(start=1.7e9 + 3.0)])
    assert merged.points[0].t[0] == pytest.approx(0.0, abs=0.03)
    assert ("do not overlap" in merged.notes[0], merged.points[0].clock_offset_std) == (True, 0.03)
    # large angles, of which positions are no linear functions
    far = replace(camera().points[0], position=tip(1.5 * wander(FRAMES, 0)), t=FRAMES + 1e9)
    wide = replace(ROBOT, joints=replace(ROBOT.joints, position=1.5 * wander(T, 0)))
    assert merge_recordings([wide, Recording(None, (far,))]).points[0].t[0] == pytest.approx(0.0, abs=0.06)
    [note] = merge_recordings([ROBOT, camera(start=9.0)], {"camera": -9.3}).notes
    assert "--clock-offset states. But" in note
    assert float(note.partition("--clock-offset camera=")[2].rstrip(")")) == pytest.approx(-9.0, abs=0.03)
    # both since 1970: one clock, counted from its first sample
    both = merge_recordings([replace(ROBOT, joints=replace(ROBOT.joints, t=T + 1.7e9)), camera(start=1.7e9)])
    assert (both.joints.t[0], both.points[0].t[0]) == (0.0, 0.0)


def test_what_cannot_be_aligned_is_refused() -> None:
    place = tip(wander(FRAMES, 9)) + 0.3 * np.random.default_rng(3).random((len(FRAMES), 1, 3))
    points = PointGroup("points", ("tip",), FRAMES + 1e9, place)
    other = Recording(None, (points,), name="camera")
    with pytest.raises(DataError, match="do not overlap") as caught:
        merge_recordings([ROBOT, other])
    assert "--clock-offset camera=-1000000000.0000" in caught.value.hint
    assert merge_recordings([ROBOT, other], {"camera": -1e9}).points[0].t[0] == 0.0
    for joints, t, what in (
        (JointGroup(("a",), T[:20] / 10, wander(T[:20], 0)[:, :1]), FRAMES + 1e9, "do not overlap"),
        (ROBOT.joints, 1e3 * FRAMES, "2 of 1900 samples of camera"),  # milliseconds
        (ROBOT.joints, 1e-3 * FRAMES, "samples of camera would be 1e-05 s apart"),  # seconds read as milliseconds
        (replace(ROBOT.joints, t=1e9 * (1.7e9 + T)), FRAMES, "4000 samples of robot .*, so its times seem to be in ns"),
    ):
        with pytest.raises(DataError, match=what):
            merge_recordings([replace(ROBOT, joints=joints), replace(other, points=(replace(points, t=t),))])
    with pytest.raises(DataError, match="there is no recording"):
        merge_recordings([ROBOT, camera()], {"kamera": 1.0})
    with pytest.raises(DataError, match="the joint 'a' is in robot and in twin") as caught:
        merge_recordings([ROBOT, replace(ROBOT, name="twin")])
    assert "--columns 'q_*=skip'" in caught.value.hint


def test_joints_of_two_files_come_to_the_faster_clock_and_equal_groups_keep_their_file() -> None:
    slow = T[::4]
    gripper = Recording(JointGroup(("finger",), slow, np.sin(slow)[:, None]), name="gripper")
    merged = merge_recordings([ROBOT, gripper, camera(), replace(camera(), name="second")])
    assert merged.joints.names == ("a", "b", "finger")
    assert np.allclose(merged.joints.position[:, 2], np.interp(merged.joints.t, slow, np.sin(slow)))
    assert any("gripper were interpolated to the times of robot" in note for note in merged.notes)
    assert [group.name for group in merged.points] == ["points_camera", "points_second"]

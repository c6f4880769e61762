from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from yid_ocp import vision
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.data.recording_hdf5 import read_recording, write_recording
from yid_ocp.errors import ConfigError, DataError, ModelError
from yid_ocp.vision import SceneDescription, TrackOptions
from yid_ocp.vision.camera_registration import CLOCK_OFFSET_INDEX, CameraState
from yid_ocp.vision.track import SingleFrameTracker, track_object

MILLIMETRE = 1e-3
LATENCY, CALIBRATION_FRAMES = 0.06, 4


@pytest.fixture(scope="module")
def plain(system, small):
    """The small sequence tracked without the robot's meshes, all points."""
    options = TrackOptions(tracked_points=system.point_frames)
    return track_object(SceneDescription(system), small.recording, small.sequence, options)


def test_points_at_two_metres(clean):
    """Under 10 mm in the median and nothing accepted that is off by more than 40 mm, at stamps 60 ms late."""
    assert len(clean.track.t) >= 7
    assert np.isfinite(clean.errors).all()
    assert (np.median(clean.errors, axis=0) < 3 * MILLIMETRE).all()
    assert clean.errors.max() < 15 * MILLIMETRE
    assert all((frame.cpu_seconds > 0) == (frame.shape_fit is not None) for frame in clean.track.frame_reports)
    # errors are within the stated standard deviations
    relative = (clean.track.position - clean.truth(clean.track.t)) / clean.track.std
    assert np.mean(relative**2) < 1.5
    assert np.abs(relative).max() < 4
    assert clean.track.std.max() < 20 * MILLIMETRE


@pytest.mark.slow
def test_a_third_of_the_frames_lost_a_fifth_of_the_points_wrong_and_stamps_late(tracked):
    hard = tracked(outliers=0.2, dropped_frame_fraction=1 / 3, seed=11, latency_std=0.003, late=(2, 5))
    assert np.isfinite(hard.errors).mean() > 0.9
    assert (np.nanmedian(hard.errors, axis=0) < 5 * MILLIMETRE).all()
    assert np.nanmax(hard.errors) < 15 * MILLIMETRE
    dropped = {frame.index: frame.drop_reason for frame in hard.track.frame_reports if not frame.is_good}
    assert set(dropped) == {2, 5}
    assert all("late" in reason for reason in dropped.values())


def test_a_small_sequence_from_disk_whatever_the_seed(system, small, plain):
    """The same frame sequence, other random points in the walk: within the noise."""
    for seed, off in ((0, 0.0), (1, 2 * MILLIMETRE)):
        options = TrackOptions(tracked_points=system.point_frames, seed=seed)
        found = track_object(SceneDescription(system), small.recording, small.sequence, options)
        assert np.abs(plain.position - found.position).max() <= off
    assert np.linalg.norm(plain.position - small.truth, axis=2).max() < 8 * MILLIMETRE
    assert [frame.n_raw_points for frame in plain.frame_reports] == [len(cloud) for cloud in small.clouds]


def test_the_camera_and_its_clock_are_found(clean):
    camera, made = clean.track.camera_calibration, clean.made.sequence
    assert camera.n_frames == CALIBRATION_FRAMES
    std = np.sqrt(np.diag(camera.state_covariance))
    true = CameraState(
        made.camera_pose, clock_offset=LATENCY, clock_reference_stamp=camera.camera_state.clock_reference_stamp
    )
    assert (np.abs(camera.camera_state.state_increment_from(true)) < 4 * std).all()
    assert std[CLOCK_OFFSET_INDEX] < 0.01
    assert "clock offset" in camera.message
    assert camera.arm_visibility.there > 0.9
    assert (clean.track.shared_std <= clean.track.std).all()
    assert clean.track.shared_std.max() > 0


def test_a_displaced_camera_is_put_right(system, recording, clean):
    whole, some = clean.made.sequence, [1, 4, 7]
    names = tuple(whole.frame_names[i] for i in some)
    load = lambda k: whole.load_cloud(some[k])  # noqa: E731
    sequence = replace(whole, stamps=whole.stamps[some], frame_names=names, load_cloud=load)
    pose = sequence.camera_pose.copy()
    pose[:3, 3] += [0.03, -0.025, 0.02]
    pose[:3, :3] = Rotation.from_rotvec([0.02, -0.01, 0.03]).as_matrix() @ pose[:3, :3]
    found = track_object(SceneDescription(system, "package:baxter"), recording, replace(sequence, camera_pose=pose))
    assert "sees the arm" in found.camera_calibration.message
    columns = [system.point_frames.index(name) for name in found.point_names]
    errors = found.position - clean.truth(found.t)[:, columns]
    assert np.nanmean((errors / found.std) ** 2) < 1.5
    assert np.nanmax(np.linalg.norm(errors, axis=2)) < 15 * MILLIMETRE
    assert np.allclose(found.to_point_group().camera_pose, sequence.camera_pose, atol=0.02)
    assert "all frames share an error of" in found.to_point_group().sensor_name


def test_a_recording_that_solve_reads(tmp_path, clean, recording, system):
    joints = recording.joints
    old = PointGroup("points_camera", ("w_T1",), [0.0], np.zeros((1, 1, 3)), 0.01)
    arm = PointGroup("points_arm", ("w_T2",), joints.t, np.zeros((len(joints.t), 1, 3)), 0.001)
    made = clean.track.recording_with_points(replace(recording, points=(old, arm), description="Before."))
    write_recording(made, tmp_path / "tracked.h5")
    again = read_recording(tmp_path / "tracked.h5")
    assert [group.name for group in again.points] == ["points_arm", "points_camera"]
    group = again.points[1]
    assert group.names == system.point_frames
    assert np.array_equal(group.t, clean.track.t)
    assert np.array_equal(group.position, clean.track.position)
    assert (group.std >= 0.002).all()
    assert np.array_equal(group.camera_pose, clean.track.camera_calibration.camera_state.pose)
    assert again.description.startswith("Before.")
    assert "clock offset" in again.description


def test_positions_of_a_straight_object_stay_with_their_points(clean, recording):
    for name, kept in (("points_arm", True), ("points_camera", False), ("points_mocap", False)):
        group = PointGroup(name, ("w_T1",), [0.0], np.zeros((1, 1, 3)))
        before = replace(recording, points=(group,), marker_reference_pose=np.ones((1, 3)))
        assert (clean.track.recording_with_points(before).marker_reference_pose is not None) is kept
    assert clean.track.recording_with_points(recording).marker_reference_pose is None


def test_the_points_are_those_that_no_arm_holds(system, small):
    tracker = SingleFrameTracker(SceneDescription(system), small.recording, small.sequence, TrackOptions())
    assert tracker.point_names == ("w_T1", "w_T3")
    with pytest.raises(ConfigError, match="no point 'w_T9'"):
        track_object(SceneDescription(system), small.recording, small.sequence, TrackOptions(tracked_points=("w_T9",)))


def test_the_spline_passes_through_the_good_frames(clean, system):
    found = clean.track
    for k, t in enumerate(found.t):
        assert np.allclose(found.point_positions_at_time(t), found.position[k], atol=1e-9)
    between = 0.5 * (found.t[4] + found.t[5])
    [truth] = clean.truth([between])
    assert np.linalg.norm(found.point_positions_at_time(between) - truth, axis=1).max() < 0.05
    assert np.array_equal(found.point_positions_at_time(found.t[-1] + 5.0), found.point_positions_at_time(found.t[-1]))


UNREADABLE = Mock(side_effect=DataError("the point cloud cannot be used", hint=""))
DUST = np.random.default_rng(0)
BAD = {
    "the cloud has no finite points": lambda points: points[:0],
    "the cloud has no finite points:": lambda points: np.full_like(points, np.nan),
    "not in metres": lambda points: 1000 * points,
    "no point lies in the region that the object can reach": lambda points: points + np.array([30.0, 0.0, 0.0]),
    "too few points of the object": lambda points: points[:60],
    "an end is not where its gripper is": lambda points: points * [1.0, 1.0, 1.05],
    "the point cloud cannot be used": UNREADABLE,
    "": lambda points: points + DUST.uniform(-0.3, 0.3, points.shape),  # random points are no object
}


def test_bad_frames_are_dropped_with_the_reason_and_do_not_stop_the_rest(system, small):
    """Clouds that are bad, stamps that are out of order, duplicated or missing, and a time without joint angles."""
    bad, t = list(BAD.values()), small.sequence.stamps
    stamps = [t[2], t[0], t[1], *(t[1] + 1e-3 * (1 + np.arange(len(bad)))), t[0], np.nan, 99.0]

    def load(index):
        if 3 <= index < 3 + len(bad):
            return bad[index - 3](small.clouds[1])
        return small.clouds[[2, 0, 1][index] if index < 3 else 0]

    sequence = replace(small.sequence, stamps=np.array(stamps), frame_names=tuple(map(str, stamps)), load_cloud=load)
    found = track_object(SceneDescription(system), small.recording, sequence)
    assert np.array_equal(found.t, t)
    reports = {frame.index: frame.drop_reason for frame in found.frame_reports}
    assert list(reports)[:2] == [1, 3 + len(bad)]
    for index, reason in enumerate(BAD, start=3):
        assert reports[index]
        assert reason.rstrip(":") in reports[index]
    for index, reason in enumerate(("a duplicate", "not a number", "no joint angles"), start=3 + len(bad)):
        assert reason in reports[index]
    assert sum(found.frame_drop_reason_counts.values()) == len(bad) + 3


@pytest.mark.parametrize(("scale", "lowest", "message"), [(1000, -9.0, "metres"), (1, 5.0, "track.camera_pose")])
def test_nothing_but_bad_clouds_is_an_error(system, small, scale, lowest, message):
    options = TrackOptions(filters=vision.CloudFilterOptions(box_lower=(-9.0, -9.0, lowest)))
    sequence = replace(small.sequence, load_cloud=lambda index: scale * small.clouds[index])
    with pytest.raises(DataError, match="no frame could be used") as caught:
        track_object(SceneDescription(system), small.recording, sequence, options)
    assert message in caught.value.what
    assert f"in {len(small.clouds)} of {len(small.clouds)} frames, " in caught.value.what  # all for one reason
    assert "dimensions contradict the model" not in caught.value.what
    assert caught.value.hint
    told = SceneDescription(system), small.recording, replace(sequence, load_cloud=UNREADABLE), options
    tracker = SingleFrameTracker(*told)
    tracker.arm_surface, tracker.calibration_frames = tracker, (0, 1)
    with pytest.raises(
        DataError, match=r"none of 2 frames can be used .* In the first, the point cloud cannot be used"
    ):
        tracker._calibration()


def test_the_time_of_another_clock(system, small):
    later = replace(small.sequence, stamps=small.sequence.stamps + 1.7e9)
    with pytest.raises(DataError, match="the clocks differ") as caught:
        track_object(SceneDescription(system), small.recording, later)
    assert "set track.options.clock_offset_search.initial_stamp_minus_joint_time" in caught.value.hint
    options = TrackOptions(clock_offset_search=vision.CameraClockOptions(initial_stamp_minus_joint_time=1.7e9))
    assert len(track_object(SceneDescription(system), small.recording, later, options).t) == 3


def test_a_recording_that_does_not_fit(system, small, urdf_folder):
    joints = small.recording.joints
    points = PointGroup("points", ("a",), [0.0], np.zeros((1, 1, 3)))
    with pytest.raises(DataError, match="no joint angles"):
        track_object(SceneDescription(system), Recording(points=(points,)), small.sequence)
    names = ("left_s9", *joints.names[1:])
    with pytest.raises(DataError, match="joint 'left_s0' of the model is not recorded"):
        track_object(SceneDescription(system), Recording(JointGroup(names, joints.t, joints.position)), small.sequence)
    with pytest.raises(ModelError, match="no visual shapes"):
        track_object(SceneDescription(system, urdf_folder / "double_pendulum.urdf"), small.recording, small.sequence)

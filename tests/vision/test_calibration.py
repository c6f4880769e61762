"""The camera's pose, depth and clock from an arm of three joints that it sees, with what was true known."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from yid_ocp.errors import DataError
from yid_ocp.model.urdf import read_urdf
from yid_ocp.vision import (
    ArmBasedCameraCalibrationOptions,
    CameraClockOptions,
    CameraIntrinsics,
    calibration,
    look_at_pose,
)
from yid_ocp.vision.camera_registration import (
    CAMERA_STATE_SIZE,
    CLOCK_DRIFT_INDEX,
    CLOCK_OFFSET_INDEX,
    DEPTH_SCALE_INDEX,
    TRANSLATION_SLICE,
    CameraState,
    MovingArmSurface,
    StampedCloud,
    _CalibrationEquations,
    robust_cost_derivatives,
)
from yid_ocp.vision.surface_meshes import ArticulatedSurfaces, load_robot_meshes_by_joint

ARM = """<robot name="arm"><link name="base"><visual><geometry><box size="0.3 0.3 0.2"/></geometry></visual></link>
<joint name="yaw" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.1"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<link name="upper"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><origin xyz="0.05 0 0.2"/><geometry><box size="0.12 0.1 0.4"/></geometry></visual></link>
<joint name="pitch" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0 0 0.4"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<link name="fore"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><origin xyz="0.25 0 0" rpy="0 1.5708 0"/><geometry><cylinder radius="0.05" length="0.5"/></geometry></visual>
</link>
<joint name="roll" type="revolute"><parent link="fore"/><child link="hand"/><origin xyz="0.5 0 0"/><axis xyz="1 0 0"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<link name="hand"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><origin xyz="0.08 0 0"/><geometry><box size="0.16 0.2 0.05"/></geometry></visual></link></robot>"""

POSE = look_at_pose([1.9, 0.6, 0.8], [0.2, 0.0, 0.35])
LENS = CameraIntrinsics.from_field_of_view(160, 120, math.radians(58.0))
NOISE = 0.004  # [m]
POINTS = np.array([[0.5, 0.3, 0.5], [0.6, -0.3, 0.2], [0.3, 0.0, -0.2]])


def lively(t):
    return np.array([0.5 * math.sin(1.3 * t), 0.3 + 0.35 * math.sin(1.9 * t + 1.0), 0.6 * math.sin(2.3 * t)])


def still(t):
    return lively(0.4)


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    file = tmp_path_factory.mktemp("arm") / "arm.urdf"
    file.write_text(ARM)
    tree = read_urdf(file).with_numeric_values()
    return ArticulatedSurfaces(tree, load_robot_meshes_by_joint(file, tree))


def arm_of(robot, motion=lively):
    return MovingArmSurface(robot, motion, lambda q: np.zeros((0, 3)), 0.08)


def clouds(robot, times, rng, motion=lively, scale=1.0, pose=POSE):
    """What a camera measures of the arm before a wall: noise along the rays, and pixels that fly at edges."""
    found = []
    for t in times:
        depth, cosine, _ = robot.render_depth_incidence_and_part(LENS, pose, motion(t))
        depth = np.where(np.isfinite(depth), depth, 3.2)
        depth = np.where(rng.random(depth.shape) < 0.02, depth + rng.uniform(-0.3, 0.3, depth.shape), depth)
        depth = depth + NOISE * rng.standard_normal(depth.shape)
        found.append(LENS.points_from_depth(np.where(cosine > 0.12, depth * scale, 3.2 * scale)))
    return found


def found_of(robot, seed, *, turn=0.0, shift=0.0, scale=1.0, latency=0.0, drift=0.0, duration=4.0, frames=6, **options):
    """A calibration, and the true state."""
    rng = np.random.default_rng(seed)
    motion = options.pop("motion", lively)
    times = 1.0 + (np.arange(frames) + rng.uniform(0.1, 0.9, frames)) * duration / frames
    stamps = times + latency + drift * times + options.pop("late", np.zeros(frames))
    seen = list(map(StampedCloud, stamps.tolist(), clouds(robot, times, rng, motion, scale)))
    clock = options.pop("clock", CameraClockOptions())
    pose, (axis, way) = POSE.copy(), rng.standard_normal((2, 3))
    pose[:3, :3] = Rotation.from_rotvec(math.radians(turn) * axis / np.linalg.norm(axis)).as_matrix() @ POSE[:3, :3]
    pose[:3, 3] += shift * way / np.linalg.norm(way)
    found = calibration.calibrate_camera(
        arm_of(robot, motion), seen, pose, rng, ArmBasedCameraCalibrationOptions(**options), clock
    )
    about = found.camera_state.clock_reference_stamp
    return found, CameraState(POSE, 1 / scale, 0.0, latency + drift * (about - latency), drift, about)


@pytest.fixture(scope="module")
def clean(robot):
    """A calibration from a right pose and clock."""
    return found_of(robot, 3)


def displaced(found, true):
    """By how much, and in how many standard deviations, points of the world are off, shape (N, 3)."""
    error = found.camera_state.measured_to_world_points(true.world_to_measured_points(POINTS)) - POINTS
    stamps = np.full(len(POINTS), found.camera_state.clock_reference_stamp)
    return error, error / found.point_std_from_calibration(POINTS, 0 * POINTS, stamps)


def std_of(found, index=CLOCK_OFFSET_INDEX):
    return math.sqrt(found.state_covariance[index, index])


def test_slopes_of_the_state_are_derivatives():
    rng = np.random.default_rng(0)
    state = CameraState(POSE, 1.03, 0.02, 0.1, 1e-3, 5.0)
    seen = state.world_to_measured_points(POINTS)
    assert np.allclose(state.measured_to_world_points(seen), POINTS, atol=1e-12)
    slopes = state.world_point_jacobian_by_pose_and_depth(POINTS)
    for k in range(CLOCK_OFFSET_INDEX):
        change = 1e-6 * np.eye(CAMERA_STATE_SIZE)[k]
        both = (state.with_state_increment(by) for by in (change, -change))
        ahead, behind = (other.measured_to_world_points(seen) for other in both)
        # the offset acts on measured depths, the factor on those with it: the same to first order in both
        assert np.allclose((ahead - behind) / 2e-6, slopes[:, :, k], atol=0.05 * np.abs(slopes[:, :, k]).max() + 1e-6)
    change = 0.05 * rng.standard_normal(CAMERA_STATE_SIZE)
    assert np.allclose(state.with_state_increment(change).state_increment_from(state), change, atol=1e-12)
    assert state.stamps_to_joint_clock(7.0) == pytest.approx(7.0 - 0.1 - 2e-3)


def test_slopes_of_the_rows_are_derivatives(robot):
    [cloud] = clouds(robot, [1.7], np.random.default_rng(1))
    state, arm = CameraState(POSE, clock_reference_stamp=1.2), arm_of(robot)
    points = state.measured_to_world_points(cloud)
    glimpse = StampedCloud(1.7, cloud[arm.near_moving_surface_off_grasps_mask(points, 1.7, 0.02)][::7])
    rows = arm.linearized_surface_distances(state, glimpse, 0.1, along=True)
    moved = {TRANSLATION_SLICE.start: 1e-4, TRANSLATION_SLICE.start + 2: 1e-4, 0: 1e-4, DEPTH_SCALE_INDEX: 1e-4}
    for k, step in {**moved, CLOCK_OFFSET_INDEX: 1e-3, CLOCK_DRIFT_INDEX: 1e-3}.items():
        change = step * np.eye(CAMERA_STATE_SIZE)[k]
        both = (state.with_state_increment(by) for by in (change, -change))
        ahead, behind = (arm.linearized_surface_distances(other, glimpse, 0.1, along=True) for other in both)
        if len(ahead.residuals) == len(behind.residuals) == len(rows.residuals):
            slope = (ahead.residuals - behind.residuals) / (2 * step)
            off = np.abs(slope - rows.jacobian[:, k])
            # rays near an edge meet another facet
            assert np.median(off) < 0.05 * np.abs(rows.jacobian[:, k]).max() + 1e-4


@pytest.mark.parametrize("wrong", [{}, {"turn": 4.0, "shift": 0.04, "latency": -0.3}, {"scale": 0.96, "latency": 0.4}])
def test_pose_depth_and_clock_are_found(robot, clean, wrong):
    found, true = found_of(robot, 3, frames=5, **wrong) if wrong else clean
    error, relative = displaced(found, true)
    assert np.abs(error).max() < 0.01
    assert np.abs(relative).max() < 4
    assert std_of(found) < 0.01
    assert abs(found.camera_state.clock_offset - true.clock_offset) < 4 * std_of(found)
    assert found.arm_visibility.there > 0.9
    assert ("With its specified pose, the camera sees" in found.message) == bool("turn" in wrong or "scale" in wrong)


def test_standard_deviations_are_honest(robot):
    """Normalised errors of many clocks and places are of size one: neither three times as large nor a third."""
    z = []
    for seed in range(4):
        found, true = found_of(robot, 10 + seed, turn=1.0, shift=0.01, latency=0.05, frames=3)
        error = found.camera_state.state_increment_from(true) / np.sqrt(np.diag(found.state_covariance))
        z.append([error[CLOCK_OFFSET_INDEX], *displaced(found, true)[1].ravel()])
    size = np.sqrt(np.mean(np.square(z), axis=0))
    assert size.max() < 2.2
    assert size[0] > 0.2
    assert 0.2 < np.median(size) < 1.5


def rows_of(errors, places):
    """Frames of points that all have the slope one by the first unknown."""
    slope = np.eye(1, CAMERA_STATE_SIZE)
    rows = []
    for error, place in zip(errors, places, strict=True):
        patch = np.column_stack([place, np.zeros((len(place), 3), int)])
        rows.append(_CalibrationEquations(np.repeat(slope, len(error), axis=0), error, patch))
    return rows


def test_errors_alike_in_a_frame_or_on_a_patch_count_as_one_and_others_only_once():
    """Variance of a sum of scores: of independent errors that of their number, of errors alike that of their groups."""
    rng = np.random.default_rng(0)
    frames, patches, each = 200, 150, 2
    places = np.tile(np.repeat(np.arange(patches), each), (frames, 1))
    own = 1e-2 * rng.standard_normal((frames, patches * each))
    by_frame = own * 0.1 + 1e-2 * rng.standard_normal((frames, 1))
    by_patch = own * 0.1 + 1e-2 * rng.standard_normal(patches)[np.newaxis, places[0]]

    def variance(errors):
        found = robust_cost_derivatives(rows_of(errors, places), 10.0)
        return found.score_covariance[0, 0] / found.hessian[0, 0]

    alone = variance(own)
    assert variance(by_frame) / alone == pytest.approx(patches * each, rel=0.5)
    assert variance(by_patch) / alone == pytest.approx(frames * each, rel=0.5)
    # E[w^2 z^2] / E[w] of a normal z and w = 1/(1 + (z/2.5)^2)^2, once although both ways of grouping have it
    assert alone == pytest.approx(0.414, rel=0.3)


def test_one_frame_at_its_minimum_has_the_errors_of_its_patches():
    """The sum over a frame is zero at the minimum: without a least value its errors would seem to be none."""
    rng = np.random.default_rng(1)
    error = np.tile(1e-2 * rng.standard_normal(50), 2) * np.repeat([1.0, -1.0], 50)
    found = robust_cost_derivatives(rows_of([error], [np.arange(100)]), 10.0)
    assert abs(found.gradient[0]) < 1e-9 * found.hessian[0, 0]
    assert found.score_covariance[0, 0] / found.hessian[0, 0] == pytest.approx(0.41, rel=0.3)


def test_drift_is_found_where_the_recording_is_long(robot, clean):
    found, _ = found_of(robot, 5, drift=1e-3, duration=60.0, frames=5, latency=0.05)
    std = std_of(found, CLOCK_DRIFT_INDEX)
    assert std < 2.5e-4
    assert abs(found.camera_state.clock_drift - 1e-3) < 4 * std
    assert "drift" in found.message
    assert np.abs(found.camera_state.stamps_to_joint_clock(61.0 + 0.05 + 0.061) - 61.0) < 0.02
    short, _ = clean  # four seconds tell little of it
    assert std_of(short, CLOCK_DRIFT_INDEX) > 2 * std
    assert "drift" not in short.message


def test_frames_stamped_late_do_not_pull(robot):
    late = np.zeros(6)
    late[[2, 4]] = 0.15
    found, true = found_of(robot, 6, late=late)
    assert abs(found.camera_state.clock_offset - true.clock_offset) < max(4 * std_of(found), 0.004)
    rng = np.random.default_rng(0)
    [cloud] = clouds(robot, [2.6], rng)
    for by, expected in ((0.0, False), (0.15, True)):
        stamp = 2.6 + found.camera_state.clock_offset + by
        points = found.camera_state.measured_to_world_points(cloud)
        own = calibration.stamp_delay_beyond_clock_offset(
            arm_of(robot), found.camera_state, stamp, points, rng, found.usual_square_distance
        )
        assert own.delay == pytest.approx(by, abs=max(4 * own.std, 0.01))
        assert own.is_significant is expected


def test_a_kept_pose_that_the_arm_contradicts_is_said_and_counted(robot):
    before = np.zeros(3)
    for shift, turn in ((0.0, 0.0), (0.03, 2.0)):
        found, true = found_of(robot, 7, shift=shift, turn=turn, fix_pose=True, frames=4)
        assert np.array_equal(found.camera_state.pose, found.prior_state.pose)
        assert found.camera_state.depth_scale == 1.0
        assert ("by the fixed pose" in found.message) == (shift > 0)
        assert np.abs(displaced(found, true)[1]).max() < 3
        std = np.linalg.norm(found.point_std_from_calibration(POINTS, np.zeros((3, 3)), np.zeros(3)), axis=1)
        assert (std > before).all(), "a worse pose never gives smaller standard deviations"
        before = std
        assert abs(found.camera_state.clock_offset - true.clock_offset) < 0.02, "the clock is found all the same"


def test_speed_and_time_enter_the_standard_deviation(clean):
    found, _ = clean
    about = found.camera_state.clock_reference_stamp
    rest, fast = (found.point_std_from_calibration(POINTS, np.full((3, 3), v), np.full(3, about)) for v in (0.0, 2.0))
    assert (fast > 0.8 * 2.0 * std_of(found)).all()
    assert (found.point_std_from_calibration(POINTS, np.full((3, 3), 2.0), np.full(3, about + 100)) > fast).all()
    assert (rest > 0).all()
    clock = CameraClockOptions(initial_stamp_minus_joint_time=0.1)
    nothing = calibration.calibration_without_estimation(POSE, clock, "nothing moves")
    assert nothing.point_std_from_calibration(POINTS, np.ones((3, 3)), np.zeros(3)) == pytest.approx(0.0)
    assert nothing.camera_state.stamps_to_joint_clock(1.0) == pytest.approx(0.9)


def test_refused_where_the_arm_does_not_tell(robot):
    with pytest.raises(DataError, match="moves too little") as caught:
        found_of(robot, 9, motion=still, frames=3)
    assert "search_half_width: 0" in caught.value.hint
    known = CameraClockOptions(search_half_width=0.0)
    found, true = found_of(robot, 9, motion=still, clock=known, turn=2.0, shift=0.02, frames=4)
    assert np.abs(displaced(found, true)[1]).max() < 4
    assert "as specified" in found.message
    away = look_at_pose([1.9, 0.6, 0.8], [4.0, 0.6, 0.8])
    rng = np.random.default_rng(0)
    nothing = list(map(StampedCloud, (1.0, 2.0, 3.0), clouds(robot, [1.0, 2.0, 3.0], rng)))
    options = ArmBasedCameraCalibrationOptions(fix_pose=True)
    told = arm_of(robot), nothing, away, rng, ArmBasedCameraCalibrationOptions(), known, "there"
    with pytest.raises(DataError, match="in view in 0 of 3 frames"):
        calibration.calibrate_camera(*told)
    kept = calibration.calibrate_camera(arm_of(robot), nothing, away, rng, options, known)
    assert kept.n_frames == 0
    assert "as specified (not estimated, because the arm is in view in 0 of 3 frames" in kept.message


def test_refused_where_the_camera_sees_through_the_arm(robot):
    """Another motion than the recorded one: nowhere does the arm lie on the clouds."""
    rng = np.random.default_rng(0)
    times = np.linspace(1.0, 4.0, 4)
    other = list(map(StampedCloud, times, clouds(robot, times, rng, lambda t: lively(1.7 * t + 9))))
    with pytest.raises(DataError, match="cannot be calibrated"):
        calibration.calibrate_camera(
            arm_of(robot), other, POSE, rng, ArmBasedCameraCalibrationOptions(), CameraClockOptions()
        )

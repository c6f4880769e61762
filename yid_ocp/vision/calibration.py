"""Calibration of a camera's pose, depth and clock from the visible arm, and detection of late frame stamps.

The remaining uncertainty is an error common to all frames; it is part of the standard deviation of every point. A frame
whose own clock offset differs from the common offset was stamped late (or early). Clock offset and latency of the
camera cannot be separated: both are stamp minus joint time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Ge

from yid_ocp.arrays import Array
from yid_ocp.errors import DataError
from yid_ocp.options import OptionInfo, check_option_bounds
from yid_ocp.vision.camera_registration import (
    CAMERA_STATE_SIZE,
    CLOCK_DRIFT_INDEX,
    CLOCK_OFFSET_INDEX,
    DEPTH_SCALE_INDEX,
    MIN_ARM_POINTS_PER_FRAME,
    ROTATION_SLICE,
    TRANSLATION_SLICE,
    CameraState,
    MovingArmSurface,
    RobustCostDerivatives,
    StampedCloud,
    SurfaceObservationFractions,
    candidate_camera_states,
    robust_cost_derivatives,
    seen_occluded_and_seen_through_surface_fractions,
)
from yid_ocp.vision.point_cloud import MAD_TO_STD, weighted_median

_OFF_ARM_DISTANCE = 0.04  # distance from the arm up to which a point belongs to it [m]
_MAX_START_POINTS = 5000  # points of a frame among which starts are tried
_MAX_ARM_POINTS, _MAX_START_ARM_POINTS = 500, 150  # near the arm: for its offset, to see which start is best
_START_CLOCK_STEP, _MAX_START_CLOCK_OFFSET = 0.04, 0.4  # starts: apart, and the furthest [s]
_REACH_FACTORS = (1.0, 0.7, 0.5, 0.5)  # factors on the reach, by iteration
_MIN_ON_ARM_FRACTION = 0.3  # fraction of the points that must lie on the arm; otherwise they are something else
_RESTART_MISFIT_RATIO = 1.5  # times the usual misfit, from which on other starts are tried
_MAX_BETTER_START_RATIO = 0.8  # ratio to the misfit at the common offset, below which another offset is accepted
_MIN_STAMP_ERROR = 0.02  # smallest deviation of a stamp from the common offset [s]
_STAMP_ERROR_STDS = 4.0  # standard deviations
_ARM_SHIFT_STD = 1e-3  # std of the arm's position in one frame relative to the calibration [m]
_CORRELATED_GROUP_SIZE = 3.0  # group size of random points with correlated errors
_MIN_POINT_STD = 1e-3  # [m]
_MAX_CLOCK_STEP = 0.05  # largest change of an offset in one iteration [s]
_MAX_STAMP_DELAY = 0.03  # deviation of a stamp from the common offset that is allowed, as are four stds [s]
_DRIFT_PRIOR_STD, _MAX_CLOCK_OFFSET_STD = 1e-3, 0.02  # of the camera's clock: std of its drift; largest std [s]
_ROTATION_PRIOR_STD, _TRANSLATION_PRIOR_STD = 0.06, 0.04  # of a specified pose, along each axis [rad], [m]
_DEPTH_SCALE_PRIOR_STD, _DEPTH_OFFSET_PRIOR_STD = 0.03, 0.01  # [-], [m]
_MIN_ARM_COVERAGE = 0.6  # fraction of the arm's visible, unoccluded surface that must coincide with points


@dataclass(frozen=True)
class CameraClockOptions:
    """The settings for the estimation of the camera clock's offset and drift relative to the joints' clock."""

    initial_stamp_minus_joint_time: Annotated[float, OptionInfo("initial value of stamp minus joint time", "s")] = 0.0
    search_half_width: Annotated[
        float, Ge(0), OptionInfo("half width of the search for the offset around the initial value; 0: no search", "s")
    ] = 0.5

    def __post_init__(self) -> None:
        check_option_bounds(self, "clock options")


class _StampDelay(NamedTuple):
    """Delay of one frame's time stamp beyond the common clock offset [s], its std [s] and its misfit [m^2]."""

    delay: float
    std: float
    mean_square_distance: float

    @property
    def is_significant(self) -> bool:
        """Whether the stamp is significantly late or early relative to the common offset."""
        return abs(self.delay) > max(_MAX_STAMP_DELAY, _STAMP_ERROR_STDS * self.std)


def stamp_delay_beyond_clock_offset(
    arm: MovingArmSurface, state: CameraState, stamp: float, points: Array, rng: np.random.Generator, usual: float = 0.0
) -> _StampDelay | None:
    """Estimate the delay [s] of a frame's time stamp beyond the common clock offset. None if the arm is not in view.

    `points` (N, 3) [m] are the frame's points in the world. If the misfit is close to the `usual` misfit of other
    frames [m^2], only nearby delays are searched.
    """
    t, origin = float(state.stamps_to_joint_clock(stamp)), state.pose[:3, 3]
    points = points[rng.permutation(len(points))[:_MAX_START_POINTS]]
    chosen = points[arm.near_moving_surface_off_grasps_mask(points, t, 2 * _OFF_ARM_DISTANCE)][:_MAX_ARM_POINTS]
    if len(chosen) < MIN_ARM_POINTS_PER_FRAME:
        return None
    trial = _nearby(arm, origin, t, chosen, 0.0)
    if trial.mean_square_distance > _RESTART_MISFIT_RATIO * usual:
        steps, few = round(_MAX_START_CLOCK_OFFSET / _START_CLOCK_STEP), chosen[:_MAX_START_ARM_POINTS]
        grid = _START_CLOCK_STEP * np.arange(-steps, steps + 1)
        met = [arm.match_points_to_surface(few, origin, t - delay, _OFF_ARM_DISTANCE, along=True) for delay in grid]
        start = float(grid[int(np.argmin([_mean_square(one.normal_distance, len(few)) for one in met]))])
        if abs(start) > _MIN_STAMP_ERROR:
            other = _nearby(arm, origin, t, chosen, start)
            if other.mean_square_distance < _MAX_BETTER_START_RATIO * trial.mean_square_distance:
                trial = other
    return trial


def _nearby(arm: MovingArmSurface, origin: Array, t: float, points: Array, start: float) -> _StampDelay:
    """The delay near the delay `start` [s], by Gauss-Newton steps that match points within a decreasing distance."""
    x = np.array([start, 0.0, 0.0, 0.0])
    hessian, sigma = np.zeros((4, 4)), _OFF_ARM_DISTANCE
    for share in _REACH_FACTORS:
        met = arm.match_points_to_surface(points + x[1:], origin, t - x[0], share * _OFF_ARM_DISTANCE, along=True)
        if len(met.normal_distance) < MIN_ARM_POINTS_PER_FRAME:
            break
        sigma = max(MAD_TO_STD * float(np.median(np.abs(met.normal_distance))), _MIN_POINT_STD)
        slope = np.column_stack([met.normal_velocity, met.normal])
        prior = np.array([0.0, *[_CORRELATED_GROUP_SIZE * (sigma / _ARM_SHIFT_STD) ** 2] * 3])
        hessian = slope.T @ slope + np.diag(prior) + 1e-9 * np.eye(4)
        step = -np.linalg.solve(hessian, slope.T @ met.normal_distance + prior * x)
        x += np.clip(step, -_MAX_CLOCK_STEP, _MAX_CLOCK_STEP)
    error = arm.match_points_to_surface(points + x[1:], origin, t - x[0], _OFF_ARM_DISTANCE, along=True).normal_distance
    on_arm, std = np.count_nonzero(np.abs(error) < _REACH_FACTORS[-1] * _OFF_ARM_DISTANCE), math.inf
    if on_arm >= max(_MIN_ON_ARM_FRACTION * len(points), MIN_ARM_POINTS_PER_FRAME):
        std = sigma * math.sqrt(_CORRELATED_GROUP_SIZE * float(np.linalg.inv(hessian)[0, 0]))
    return _StampDelay(float(x[0]), std, _mean_square(error, len(points)))


def _mean_square(error: Array, count: int) -> float:
    return float((error @ error + (count - len(error)) * _OFF_ARM_DISTANCE**2) / count)


def _find_on_time_frames(own: Sequence[_StampDelay | None]) -> tuple[list[int], float]:
    """Indices of the frames with consistent delays, from which the calibration is made, and the median misfit [m^2]."""
    known = {i: entry for i, entry in enumerate(own) if entry is not None and math.isfinite(entry.std)}
    if not known:
        return [], 0.0
    delay, std, square = np.array(list(known.values())).T
    near = np.abs(delay - weighted_median(delay, std**-2)) < np.maximum(_MIN_STAMP_ERROR, _STAMP_ERROR_STDS * std)
    return [i for i, good in zip(known, near, strict=True) if good], float(np.median(square))


_MIN_FRAMES, _MAX_START_FRAMES = 3, 6  # of a calibration, and of the frames that try initial states
_GOOD_START_FRACTION = 0.9  # fraction of the arm that matches: no further initial states are tried
_STAGE_REACHES = (0.08, 0.06, 0.045)  # reach of nearest surfaces, from stage to stage [m]
_RAY_REACH = 0.035  # along the camera's rays [m]
_STAGE_ITERATIONS, _LAST_STAGE_ITERATIONS = 3, 15
_STAGE_POINTS, _LAST_STAGE_POINTS = 250, 700  # points per frame near the arm
_STEP_TOLERANCE = 1e-5  # largest step at convergence: [rad], [m], [s]
_VIEW_MARGIN = 0.3  # margin around the directions to the arm, as x/z and y/z
_MIN_REPORTED_DISPLACEMENT = 0.006  # displacement of the arm that is worth a word [m]
_CONTRADICTION_STDS = 3.0  # standard deviations


@dataclass(frozen=True)
class ArmBasedCameraCalibrationOptions:
    """The settings of the camera calibration by the visible arm: which parts are estimated, and from which frames."""

    fix_pose: Annotated[
        bool,
        OptionInfo(
            "whether the specified pose and depth are kept (from a hand-eye calibration, for example); the arm then "
            "determines the clock and checks the rest"
        ),
    ] = False
    n_frames: Annotated[
        int, Ge(_MIN_FRAMES), OptionInfo("number of frames, spread over the sequence, that are compared with the arm")
    ] = 24

    def __post_init__(self) -> None:
        check_option_bounds(self, "calibration options")


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """The result of a camera calibration: camera state, covariance, prior and visibility of the arm."""

    camera_state: CameraState  # pose, depth and clock that the tracking uses
    prior_state: CameraState  # specified pose, depth and clock
    usual_square_distance: float | None  # misfit of single frames [m^2]; None if no clock was compared
    # (10, 10), of `camera_state`, in the order of `CameraState.state_increment_from`; zero if nothing was estimated
    state_covariance: Array
    estimate_minus_used: Array  # (10,), estimate minus used state, if the pose is fixed
    arm_visibility: SurfaceObservationFractions | None  # visibility of the arm at the calibrated state
    n_frames: int  # number of frames used
    message: str  # text for the user

    @property
    def camera_position(self) -> Array:
        """The position of the camera in the world, (3,) [m]."""
        return self.camera_state.pose[:3, 3]

    def point_std_from_calibration(self, points: Array, velocity: Array, stamps: Array) -> Array:
        """Return the standard deviations (N, 3) [m] of points that the camera's uncertain pose, depth and clock cause.

        The error is common to all points at one location. `velocity` (N, 3) is in m/s, `stamps` (N,) in s.
        """
        slopes = np.empty((len(points), 3, CAMERA_STATE_SIZE))
        slopes[:, :, :CLOCK_OFFSET_INDEX] = self.camera_state.world_point_jacobian_by_pose_and_depth(points)
        # a point dated too early is at a later position of the motion
        slopes[:, :, CLOCK_OFFSET_INDEX] = velocity
        slopes[:, :, CLOCK_DRIFT_INDEX] = velocity * (stamps - self.camera_state.clock_reference_stamp)[:, None]
        variance = np.einsum("nij,jk,nik->ni", slopes, self.state_covariance, slopes)
        # a shape held by the gripper, with deviating camera points, can be wrong in any direction
        beside = slopes @ self.estimate_minus_used
        evenly = np.linalg.norm(beside, axis=1, keepdims=True) / math.sqrt(3.0)
        return np.asarray(np.sqrt(variance + np.maximum(np.abs(beside), evenly) ** 2))


def calibration_without_estimation(pose: Array, options: CameraClockOptions, reason: str) -> CameraCalibration:
    """Return a calibration with the specified pose and clock offset. `reason` says why nothing was estimated."""
    offset = options.initial_stamp_minus_joint_time
    text = f"The camera's pose and its clock offset of {1e3 * offset:.0f} ms are as specified"
    text += f" (not estimated, because {reason})"
    state, zero = CameraState(pose, clock_offset=offset), np.zeros(CAMERA_STATE_SIZE)
    return CameraCalibration(state, state, None, np.diag(zero), zero, None, 0, text)


def calibrate_camera(
    arm: MovingArmSurface,
    frames: Sequence[StampedCloud],
    pose: Array,
    rng: np.random.Generator,
    options: ArmBasedCameraCalibrationOptions,
    clock: CameraClockOptions,
    source: str = "sequence",
) -> CameraCalibration:
    """Estimate the pose, depth error and clock offset of a depth camera from frames that show the robot's arm.

    `frames` is a subset of the frames, with thinned point clouds of the robot and its surroundings. The search starts
    at the pose `pose` (4, 4). `source` names the data in error messages. Raises `DataError` if the arm is not in view,
    does not match the clouds, or moves too little to determine the clock.
    """
    about = float(np.mean([g.stamp for g in frames])) if frames else 0.0
    told = CameraState(pose, clock_offset=clock.initial_stamp_minus_joint_time, clock_reference_stamp=about)
    try:
        return _Calibrator(arm, told, rng, options, clock).run(frames)
    except _UntoldError as error:
        reason, advice = error.args
        if options.fix_pose and clock.search_half_width == 0:
            return calibration_without_estimation(pose, clock, reason)
        known = "write --fix-pose and set track.options.clock_offset_search.search_half_width: 0"
        hint = f"{advice}; if camera pose and clock are known, {known}"
        what, allowed = f"the camera cannot be calibrated by the arm: {reason}", "frames that show the moving arm"
        raise DataError(what, where=source, allowed=allowed, hint=hint) from None


class _UntoldError(Exception):
    """Reason why the arm does not determine the calibration, and advice."""


@dataclass
class _Calibrator:
    """Data of one call of `calibrate_camera`."""

    arm: MovingArmSurface
    told: CameraState
    rng: np.random.Generator
    options: ArmBasedCameraCalibrationOptions
    clock: CameraClockOptions

    @cached_property
    def precision(self) -> Array:
        """Inverse covariance (10, 10) of the prior."""
        pose = [_ROTATION_PRIOR_STD] * 3 + [_TRANSLATION_PRIOR_STD] * 3
        # uniform distribution over the search range; zero without a search
        offset = max(self.clock.search_half_width / math.sqrt(3.0), 1e-6)
        std = [*pose, _DEPTH_SCALE_PRIOR_STD, _DEPTH_OFFSET_PRIOR_STD, offset, _DRIFT_PRIOR_STD]
        return np.diag(np.array(std) ** -2)

    def run(self, frames: Sequence[StampedCloud]) -> CameraCalibration:
        glimpses = [g for g in map(self._about_the_arm, frames) if g is not None]
        if len(glimpses) < _MIN_FRAMES:
            needed = f"the arm is in view in {len(glimpses)} of {len(frames)} frames, but {_MIN_FRAMES} are needed"
            turn = "turn the camera so that it sees the arm, or " * (len(glimpses) < len(frames))
            raise _UntoldError(needed, f"{turn}record for longer")
        state, chosen = self._start(glimpses), glimpses
        for _ in range(2):  # once more without the frames that were stamped late
            state = self._rounds(state, chosen, _STAGE_REACHES[-1], True, _STAGE_POINTS, _STAGE_ITERATIONS)[0]
            last = _LAST_STAGE_POINTS, _LAST_STAGE_ITERATIONS
            state, cost, used = self._rounds(state, chosen, _RAY_REACH, True, *last)
            placed = [(g.stamp, state.measured_to_world_points(g.points)) for g in used]
            own = [stamp_delay_beyond_clock_offset(self.arm, state, *seen, self.rng) for seen in placed]
            on_time, usual = _find_on_time_frames(own)
            chosen = [used[i] for i in on_time]
            if len(chosen) < _MIN_FRAMES:
                told = f"one clock offset fits only {len(chosen)} of {len(used)} frames, but at least {_MIN_FRAMES}"
                raise _UntoldError(f"{told} are needed", "check that all time stamps come from one clock without jumps")
        presence = seen_occluded_and_seen_through_surface_fractions(self.arm, chosen, state, _RAY_REACH)
        free = presence.there + presence.through
        if not presence.there >= _MIN_ARM_COVERAGE * free:
            seen, least = 100 * presence.there / max(free, 1e-9), 100 * _MIN_ARM_COVERAGE
            told = f"points lie on {seen:.0f} % of the arm's unobstructed surface, but {least:.0f} % are needed"
            hint = "check track.camera_pose, model.robot and whether recordings.estimate is of the same motion"
            raise _UntoldError(told, hint)
        covariance = cost(state).state_covariance(self.precision)
        std = math.sqrt(covariance[CLOCK_OFFSET_INDEX, CLOCK_OFFSET_INDEX])
        if self.clock.search_half_width > 0 and not std < _MAX_CLOCK_OFFSET_STD:
            limit = f"{1e3 * std:.0f} ms, but must be below {1e3 * _MAX_CLOCK_OFFSET_STD:.0f} ms"
            told = f"the arm moves too little to determine the clock offset, whose std is {limit}"
            known = "set track.options.clock_offset_search.initial_stamp_minus_joint_time, and search_half_width: 0"
            raise _UntoldError(told, f"record a faster motion, or {known}")
        used_state = state
        if self.options.fix_pose:
            used_state = replace(self.told, clock_offset=state.clock_offset, clock_drift=state.clock_drift)
        beside = state.state_increment_from(used_state)
        words = self._message(state, covariance, chosen[len(chosen) // 2].stamp)
        coverage = f"{100 * presence.there:.0f} % of the arm is seen"
        words += f". These values are from {len(chosen)} images, in which {coverage}."
        return CameraCalibration(used_state, self.told, usual, covariance, beside, presence, len(chosen), words)

    def _about_the_arm(self, glimpse: StampedCloud) -> StampedCloud | None:
        """The frame's points around the arm, according to the specified state; None if the arm is out of view."""
        own = self.told.world_to_measured_points(self.arm.visible_surface_points_and_parts(self.told, glimpse.stamp)[0])
        points = glimpse.points[glimpse.points[:, 2] > 0]
        if len(own) < MIN_ARM_POINTS_PER_FRAME or not len(points):
            return None
        at, towards = points[:, :2] / points[:, 2:], own[:, :2] / own[:, 2:]
        low, high = towards.min(axis=0) - _VIEW_MARGIN, towards.max(axis=0) + _VIEW_MARGIN
        kept = points[((at > low) & (at < high)).all(axis=1)]
        return StampedCloud(glimpse.stamp, kept) if len(kept) >= MIN_ARM_POINTS_PER_FRAME else None

    def _start(self, glimpses: Sequence[StampedCloud]) -> CameraState:
        """The initial state of the estimation, at which most of the arm's surface coincides with measured points."""
        few = []
        for k in np.linspace(0, len(glimpses) - 1, min(len(glimpses), _MAX_START_FRAMES)).round():
            stamp, points = glimpses[int(k)].stamp, glimpses[int(k)].points
            few.append(StampedCloud(stamp, self.rng.choice(points, min(len(points), _MAX_START_POINTS), replace=False)))
        tried = candidate_camera_states(self.arm, few, self.told, self.clock.search_half_width)
        best, most = tried[0], -1.0
        for trial in tried:
            for reach in _STAGE_REACHES:
                trial = self._rounds(trial, few, reach, False, _STAGE_POINTS, _STAGE_ITERATIONS)[0]
            presence = seen_occluded_and_seen_through_surface_fractions(self.arm, few, trial, 0.5 * _RAY_REACH)
            if presence.there - presence.through > most:
                best, most = trial, presence.there - presence.through
            if most > _GOOD_START_FRACTION:
                break
        return best

    def _rounds(
        self, state: CameraState, frames: list[StampedCloud], reach: float, along: bool, cap: int, rounds: int
    ) -> tuple[CameraState, Callable[[CameraState], RobustCostDerivatives], list[StampedCloud]]:
        """The state after `rounds` steps with up to `cap` points per frame, the cost function and the chosen points."""
        chosen = []
        for glimpse in frames:
            points = state.measured_to_world_points(glimpse.points)
            t = float(state.stamps_to_joint_clock(glimpse.stamp))
            near = np.flatnonzero(self.arm.near_moving_surface_off_grasps_mask(points, t, 1.5 * reach))
            if len(near) > cap:
                near = self.rng.choice(near, cap, replace=False)
            if len(near) >= MIN_ARM_POINTS_PER_FRAME:
                chosen.append(StampedCloud(glimpse.stamp, glimpse.points[near]))
        if len(chosen) < _MIN_FRAMES:
            hint = "check track.camera_pose and track.point_cloud_unit"
            raise _UntoldError(f"only {len(chosen)} frames have points on the arm, {_MIN_FRAMES} are needed", hint)

        def cost(state: CameraState) -> RobustCostDerivatives:
            rows = [self.arm.linearized_surface_distances(state, g, reach, along) for g in chosen]
            return robust_cost_derivatives(rows, reach)

        for _ in range(rounds):
            hessian, gradient, _ = cost(state).scaled_hessian_gradient_and_data_weight(self.precision)
            pull = gradient + self.precision @ state.state_increment_from(self.told)
            step = np.asarray(-np.linalg.solve(hessian + self.precision, pull), float)
            state = state.with_state_increment(step)
            if np.abs(step).max() < _STEP_TOLERANCE:
                break
        return state, cost, chosen

    def _message(self, state: CameraState, covariance: Array, stamp: float) -> str:
        stds = np.sqrt(np.diag(covariance))
        known = f"± {1e3 * stds[CLOCK_OFFSET_INDEX]:.1f} ms" if self.clock.search_half_width > 0 else "ms as specified"
        words = [f"The camera's clock offset (stamp minus joint time) is {1e3 * state.clock_offset:.1f} {known}"]
        if abs(state.clock_drift) > 2 * (drift := stds[CLOCK_DRIFT_INDEX]):
            words.append(f"It drifts by {1e3 * state.clock_drift:.2f} ± {1e3 * drift:.2f} ms per second")
        points = self.arm.visible_surface_points_and_parts(state, stamp)[0].mean(axis=0, keepdims=True)
        away = np.linalg.norm(state.measured_to_world_points(self.told.world_to_measured_points(points)) - points)
        change, gap_text = state.state_increment_from(self.told), f"{1e3 * away:.0f} mm"
        if away > _MIN_REPORTED_DISPLACEMENT and self.options.fix_pose:
            slopes = state.world_point_jacobian_by_pose_and_depth(points)[0]
            spread = slopes @ covariance[:CLOCK_OFFSET_INDEX, :CLOCK_OFFSET_INDEX] @ slopes.T
            gap = slopes @ change[:CLOCK_OFFSET_INDEX]
            if float(gap @ np.linalg.solve(spread + 1e-6 * np.eye(3), gap)) > _CONTRADICTION_STDS**2 * 3:
                off = f"The images show the arm {gap_text} from its place by the fixed pose, which std includes"
                words.append(f"{off}. To correct the pose, set track.options.calibration.fix_pose: false")
        elif away > _MIN_REPORTED_DISPLACEMENT:
            turn, shift = (float(np.linalg.norm(change[part])) for part in (ROTATION_SLICE, TRANSLATION_SLICE))
            off = f"With its specified pose, the camera sees the arm {gap_text} from its place by the joint angles"
            moved = f"Points use it corrected by {math.degrees(turn):.1f} degrees and {1e3 * shift:.0f} mm, and depth"
            words.append(f"{off}. {moved} divided by {math.exp(-change[DEPTH_SCALE_INDEX]):.3f}")
        return ". ".join(words)

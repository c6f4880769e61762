"""Comparison of the camera's clock with the joints' clock, and detection of late time stamps.

The common offset of the two clocks and its drift are part of the calibration. Here a frame is taken by itself: its own
offset is where the robot's surface lies best on its points, and a frame whose own offset is another than the common one
was stamped late. Clock offset and latency cannot be told apart and come as one number, stamp minus joint time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt
from numpy.typing import NDArray

from yid_ocp.options import OptionInfo, check_option_bounds
from yid_ocp.vision.camera_registration import MIN_ARM_POINTS, ArmSurface, CameraState
from yid_ocp.vision.filters import weighted_median

Array = NDArray[np.float64]

_REACH = 0.04  # at which a point stops to be the arm's [m]
_THIN = 5000  # points of a frame that are looked at
_POINTS, _FEW = 500, 150  # near the arm: for its offset, to see which start is best
_COARSE = 0.04  # between starts [s]
_FURTHEST = 0.4  # of them [s]
_NARROWING = (1.0, 0.7, 0.5, 0.5)  # of the reach, from iteration to iteration
_SHARE = 0.3  # of the points must lie on the arm, or they are something else
_UNUSUAL = 1.5  # times the usual misfit, from which on other starts are tried
_CLEARLY = 0.8  # of the misfit at the common offset, below which another is believed
_LEAST_LATE = 0.02  # [s]; a stamp that is off by less is like the others
_LATE = 4.0  # standard deviations
_SHIFT_STD = 1e-3  # of the arm in one frame from where it should be by the calibration [m]
_ALIKE = 3.0  # points drawn at random have errors that are alike in groups of so many
_TO_SIGMA, _LEAST_SIGMA = 1.4826, 1e-3  # from the median of sizes; [m]
_LARGEST_CHANGE = 0.05  # of an offset in one iteration [s]


@dataclass(frozen=True)
class CameraClockOptions:
    """Settings of the comparison of the camera's clock with the joints' clock."""

    initial_offset: Annotated[float, OptionInfo("stamp minus joint time, as far as known", "s")] = 0.0
    search_half_width: Annotated[
        float, Ge(0), OptionInfo("how far from there the offset is looked for; 0 to take it as it is", "s")
    ] = 0.5
    drift_prior_std: Annotated[
        float, Gt(0), OptionInfo("standard deviation of the drift of the camera's clock, in seconds per second")
    ] = 1e-3
    max_offset_std: Annotated[float, Gt(0), OptionInfo("an offset of larger standard deviation is not used", "s")] = (
        0.02
    )
    max_stamp_delay: Annotated[
        float,
        Gt(0),
        OptionInfo(
            "a frame whose own offset differs from the common one by more, and by more than four standard deviations, "
            "is dropped",
            "s",
        ),
    ] = 0.03

    def __post_init__(self) -> None:
        check_option_bounds(self, "clock options")


@dataclass(frozen=True)
class StampDelay:
    """Delay of one frame's time stamp beyond the common clock offset.

    Attributes
    ----------
    delay : float
        Its offset beyond the common one [s].
    std : float
        Of that; infinite where too few points lie on the arm [s].
    mean_square_distance : float
        Mean square of its points' distances from the arm there [m^2].
    """

    delay: float
    std: float
    mean_square_distance: float


def estimate_stamp_delay(
    arm: ArmSurface,
    state: CameraState,
    stamp: float,
    points: Array,
    rng: np.random.Generator,
    usual: float = 0.0,
) -> StampDelay | None:
    """Estimate the delay of one frame's time stamp beyond the common offset.

    Parameters
    ----------
    arm : Arm
    state : CameraState
        Of the sequence.
    stamp : float
        [s]
    points : ndarray, shape (N, 3)
        Of the frame in the world, the robot's among them [m].
    rng : Generator
    usual : float
        Misfit of other frames [m^2]; where this one's is not much larger, its offset is looked for nearby only.

    Returns
    -------
    OwnOffset or None
        None where the arm is not in view.
    """
    t, origin = float(state.to_joint_time(stamp)), state.pose[:3, 3]
    points = points[rng.permutation(len(points))[:_THIN]]
    chosen = points[arm.is_near_surface(points, t, 2 * _REACH)][:_POINTS]
    if len(chosen) < MIN_ARM_POINTS:
        return None
    trial = _nearby(arm, origin, t, chosen, 0.0)
    if trial.mean_square_distance > _UNUSUAL * usual:
        steps = round(_FURTHEST / _COARSE)
        grid = _COARSE * np.arange(-steps, steps + 1)
        few = chosen[:_FEW]
        start = float(grid[int(np.argmin([_misfit(arm, origin, t - delay, few) for delay in grid]))])
        if abs(start) > _LEAST_LATE:
            other = _nearby(arm, origin, t, chosen, start)
            trial = other if other.mean_square_distance < _CLEARLY * trial.mean_square_distance else trial
    return trial


def _nearby(arm: ArmSurface, origin: Array, t: float, points: Array, start: float) -> StampDelay:
    """The offset not far from a start, by Gauss and Newton's method within one reach after the other.

    A shift of the frame is a further unknown, since the calibration is not exact: an arm that moves slowly tells a
    shift from a delay as little as it should.
    """
    x = np.array([start, 0.0, 0.0, 0.0])
    hessian, sigma = np.zeros((4, 4)), _REACH
    for share in _NARROWING:
        met = arm.match_points(points + x[1:], origin, t - x[0], share * _REACH, along=True)
        if len(met.normal_distance) < MIN_ARM_POINTS:
            break
        sigma = max(_TO_SIGMA * float(np.median(np.abs(met.normal_distance))), _LEAST_SIGMA)
        slope = np.column_stack([met.normal_velocity, met.normal])
        prior = np.array([0.0, *[_ALIKE * (sigma / _SHIFT_STD) ** 2] * 3])
        hessian = slope.T @ slope + np.diag(prior) + 1e-9 * np.eye(4)
        step = -np.linalg.solve(hessian, slope.T @ met.normal_distance + prior * x)
        x += np.clip(step, -_LARGEST_CHANGE, _LARGEST_CHANGE)
    error = arm.match_points(points + x[1:], origin, t - x[0], _REACH, along=True).normal_distance
    on_arm = np.count_nonzero(np.abs(error) < _NARROWING[-1] * _REACH)
    std = math.inf
    if on_arm >= max(_SHARE * len(points), MIN_ARM_POINTS):
        std = sigma * math.sqrt(_ALIKE * float(np.linalg.inv(hessian)[0, 0]))
    return StampDelay(float(x[0]), std, _mean_square(error, len(points)))


def _misfit(arm: ArmSurface, origin: Array, t: float, points: Array) -> float:
    return _mean_square(arm.match_points(points, origin, t, _REACH, along=True).normal_distance, len(points))


def _mean_square(error: Array, count: int) -> float:
    """Mean square of errors, those of the other points being beyond the reach."""
    return float((error @ error + (count - len(error)) * _REACH**2) / count)


@dataclass(frozen=True, eq=False)
class OnTimeFrames:
    """Frames that agree on one clock offset, and their median misfit.

    Attributes
    ----------
    frame_indices : tuple of int
        Those that agree on one offset.
    median_square_distance : float
        Median of theirs [m^2].
    """

    frame_indices: tuple[int, ...]
    median_square_distance: float


def find_on_time_frames(own: Sequence[StampDelay | None]) -> OnTimeFrames:
    """Frames whose delays agree, so that frames stamped late do not bias the others."""
    known = [(i, entry) for i, entry in enumerate(own) if entry is not None and math.isfinite(entry.std)]
    if not known:
        return OnTimeFrames((), 0.0)
    delay, std = (np.array([getattr(entry, name) for _, entry in known]) for name in ("delay", "std"))
    apart = np.abs(delay - weighted_median(delay, std**-2))
    near = apart < np.maximum(_LEAST_LATE, _LATE * std)
    on_time = tuple(i for (i, _), good in zip(known, near, strict=True) if good)
    return OnTimeFrames(on_time, float(np.median([entry.mean_square_distance for _, entry in known])))


def is_stamped_late(own: StampDelay, options: CameraClockOptions) -> bool:
    """Whether a frame's time stamp is significantly late."""
    return abs(own.delay) > max(options.max_stamp_delay, _LATE * own.std)

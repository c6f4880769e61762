"""Offset between the camera's clock and the joints', from the arm that both of them see.

The robot's surface at the joint angles of time t - d should lie where the camera saw it at its time t:

    d = argmin sum_i min(|p_i - surface(q(t_i - d))|, c)^2

over the camera's points near the moving links. Found by a search on a grid, then Gauss and Newton's method, with a
shift of the camera as a further unknown, so that errors of its pose and of its depth are not taken for time. Clock
offset and latency cannot be told apart and come as one number, stamp minus joint time. A minimum for every frame by
itself finds those that were stamped late.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt
from numpy.typing import NDArray

from yid_ocp.options import About, check
from yid_ocp.vision.filters import Cloud, weighted_median
from yid_ocp.vision.meshes import Surfaces

Array = NDArray[np.float64]

_POINTS, _FEW = 1000, 150  # of every frame: for the result, for the first search
_COARSE = 0.02  # [s]
_FEWEST = 40  # points without which nothing is known of a frame
_CONTRAST = 0.05  # by which a minimum must be lower than the highest sum, of that
_NARROWING = (1.0, 0.7, 0.5, 0.35, 0.35)  # of the reach, from iteration to iteration
_SHARE = 0.3  # of a frame's points must lie on the arm, or they are something else
_CLEARLY = 0.8  # of the misfit at the common offset, below which a frame's own minimum elsewhere is believed
_LEAST_LATE = 0.02  # [s]; a stamp that is off by less is like the others
_SHIFT = 1e-2  # weight, against that of the points, that keeps a shift small which they do not determine
_NOTED_SHIFT = 0.006  # [m]
_MEDIAN_SQUARE = 0.4549  # of a normal variable
_STEP = 0.01  # over which velocities are taken [s]
_LARGEST_CHANGE = 0.05  # of an offset in one iteration [s]


@dataclass(frozen=True)
class ClockOptions:
    """How the camera's clock is compared with the joints'."""

    offset: Annotated[float, About("stamp minus joint time, as far as known", "s")] = 0.0
    search: Annotated[
        float, Ge(0), About("how far from there the offset is looked for; 0 to take it as it is", "s")
    ] = 0.3
    reach: Annotated[float, Gt(0), About("distance at which a point stops to be the arm's", "m")] = 0.04
    determined: Annotated[float, Gt(0), About("an offset of larger standard deviation is not used", "s")] = 0.02
    late: Annotated[
        float,
        Gt(0),
        About(
            "a frame whose own offset differs from the common one by more, and by more than four standard deviations, "
            "is dropped",
            "s",
        ),
    ] = 0.03

    def __post_init__(self) -> None:
        check(self, "clock options")


@dataclass(frozen=True, eq=False)
class Clock:
    """The camera's clock against the joints'.

    Attributes
    ----------
    offset : float
        Stamp minus joint time, latency included [s].
    std : float
        Its standard deviation; infinite where it was not estimated [s].
    estimated : bool
    shift : ndarray, shape (3,)
        What would have to be added to the camera's points to bring them onto the arm [m]: an error of its pose, of its
        depth or of the joints' zeros. It is only reported.
    variance : float
        Of a frame's own offset times what the frame says of it: see `own_delay` [m^2].
    message : str
        In words.
    """

    offset: float
    std: float
    estimated: bool
    shift: Array
    variance: float
    message: str

    def joint_time(self, stamp: float) -> float:
        """Time on the joints' clock of a time stamp [s]."""
        return stamp - self.offset


def estimate_clock(
    robot: Surfaces,
    clouds: Sequence[Cloud],
    stamps: Array,
    posture: Callable[[float], Array],
    rng: np.random.Generator,
    options: ClockOptions | None = None,
) -> Clock:
    """Estimate the offset of the camera's clock.

    Parameters
    ----------
    robot : Surfaces
    clouds : sequence of Cloud
        Of every frame, the robot's points among them.
    stamps : ndarray, shape (M,)
        [s]
    posture : callable
        From a time on the joints' clock to a configuration; outside of the recording it may stay at the ends.
    rng : Generator
    options : ClockOptions, optional

    Returns
    -------
    Clock
        With the offset of the options where the arm is not seen or hardly moves.
    """
    chosen = options or ClockOptions()
    try:
        if chosen.search == 0:
            raise _UndeterminedError("it was not to be estimated")
        arm, samples = _Arm(robot, posture), {}
        for i, cloud in enumerate(clouds):
            points = arm.points_near(cloud, float(stamps[i]), rng, chosen)
            if points is not None:
                samples[i] = points
        if not samples:
            raise _UndeterminedError("the arm is not in view")
        return _estimated(arm, samples, stamps, rng, chosen)
    except _UndeterminedError as reason:
        text = f"clock offset {1e3 * chosen.offset:.0f} ms as given: {reason}"
        return Clock(chosen.offset, math.inf, False, np.zeros(3), 0.0, text)


def own_delay(
    robot: Surfaces,
    cloud: Cloud,
    stamp: float,
    posture: Callable[[float], Array],
    clock: Clock,
    rng: np.random.Generator,
    options: ClockOptions,
) -> tuple[float, float]:
    """How late one frame was stamped, beyond the common offset, and the standard deviation of that [s].

    Parameters
    ----------
    robot : Surfaces
    cloud : Cloud
        The robot's points among them.
    stamp : float
        [s]
    posture : callable
        See `estimate_clock`.
    clock : Clock
        Of the sequence.
    rng : Generator
    options : ClockOptions

    Returns
    -------
    (float, float)
        NaN where it cannot be told: the clock was not estimated, or the arm is not in view.
    """
    nothing = (math.nan, math.nan)
    if not clock.estimated:
        return nothing
    arm = _Arm(robot, posture)
    points = arm.points_near(cloud, stamp, rng, options)
    if points is None:
        return nothing
    grid = _grid(options)
    curve = _coarse_curve(arm, points, stamp, rng, grid, options.reach)
    own = _own(arm, points + clock.shift, stamp, clock.offset, float(grid[int(np.argmin(curve))]), options)
    return own.offset - clock.offset, math.sqrt(clock.variance / max(own.information, 1e-12))


class _UndeterminedError(Exception):
    """Why the offset cannot be estimated, so that the given one is used."""


@dataclass(frozen=True)
class _OwnOffset:
    """One frame by itself: its offset [s], mean square of its points' distances there [m^2], how much it says of it."""

    offset: float
    misfit: float
    information: float


@dataclass(frozen=True, eq=False)
class _Arm:
    """The robot's surface along its recorded motion."""

    robot: Surfaces
    posture: Callable[[float], Array]

    def poses(self, t: float) -> Array:
        """Poses of the parts, shape (parts, 4, 4)."""
        return self.robot.poses(self.posture(t))

    def speed(self, t: float) -> float:
        """Largest component of the velocity of any part's origin [m/s]."""
        ahead, behind = self.poses(t + _STEP), self.poses(t - _STEP)
        return float(np.abs((ahead[:, :3, 3] - behind[:, :3, 3]) / (2 * _STEP)).max())

    def points_near(self, cloud: Cloud, stamp: float, rng: np.random.Generator, options: ClockOptions) -> Array | None:
        """Points of a frame near the moving links, the fastest of them; None for too few."""
        if len(cloud) < _FEWEST:
            return None
        t = stamp - options.offset
        speed = max(self.speed(t + d) for d in (-options.search, 0.0, options.search))
        within = options.reach + min(speed * options.search, 0.1)
        _, _, part = self.robot.closest(cloud.points, self.posture(t), within)
        near = np.flatnonzero(part >= 0)
        if len(near) < _FEWEST:
            return None
        points = cloud.points[near]
        before, after = self.poses(t - 0.1)[part[near]], self.poses(t + 0.1)[part[near]]
        local = np.einsum("nji,nj->ni", before[:, :3, :3], points - before[:, :3, 3])
        moved = np.einsum("nij,nj->ni", after[:, :3, :3], local) + after[:, :3, 3] - points
        fastest = np.argsort(-np.linalg.norm(moved, axis=1), kind="stable")[: 2 * _POINTS]
        return points[rng.choice(fastest, min(_POINTS, len(fastest)), replace=False)]

    def rows(self, points: Array, t: float, reach: float) -> Array:
        """Linear equations in changes of offset and camera: (rate, normal (3), distance) of each point within reach."""
        distance, normal, part = self.robot.closest(points, self.posture(t), reach)
        near = np.flatnonzero(part >= 0)
        behind, now, ahead = (self.poses(t + d)[part[near]] for d in (-_STEP, 0.0, _STEP))
        local = np.einsum("nji,nj->ni", now[:, :3, :3], points[near] - now[:, :3, 3])
        moved = np.einsum("nij,nj->ni", ahead[:, :3, :3] - behind[:, :3, :3], local)
        velocity = (moved + ahead[:, :3, 3] - behind[:, :3, 3]) / (2 * _STEP)
        # a later offset takes the surface back along its velocity, away from the point
        rate = np.einsum("ni,ni->n", normal[near], velocity)
        return np.column_stack([rate, normal[near], distance[near]])

    def own_offset(
        self, points: Array, stamp: float, start: float, reach: float, narrowing: Sequence[float]
    ) -> _OwnOffset:
        """The offset of one frame, not far from a start."""
        offset, information = start, 0.0
        for share in narrowing:
            rows = self.rows(points, stamp - offset, share * reach)
            information = float(rows[:, 0] @ rows[:, 0])
            if information > 0:
                offset -= float(np.clip(rows[:, 0] @ rows[:, 4] / information, -_LARGEST_CHANGE, _LARGEST_CHANGE))
        distance = np.full(len(points), reach)
        last = self.rows(points, stamp - offset, reach)[:, 4]
        distance[: len(last)] = last
        on_arm = np.count_nonzero(last < narrowing[-1] * reach)
        enough = on_arm >= _SHARE * len(points)
        return _OwnOffset(offset, float(np.mean(distance**2)), information if enough else 0.0)


def _estimated(
    arm: _Arm, samples: Mapping[int, Array], stamps: Array, rng: np.random.Generator, options: ClockOptions
) -> Clock:
    """The offset that most frames agree on; `_UndeterminedError` where there is none."""
    coarse = _grid(options)
    curves = {
        i: _coarse_curve(arm, points, float(stamps[i]), rng, coarse, options.reach) for i, points in samples.items()
    }
    offset, shift = _lowest(curves, coarse, options), np.zeros(3)
    usual = sorted(samples)
    own, information = np.full(len(stamps), np.nan), np.zeros(len(stamps))
    for narrowing in (_NARROWING, _NARROWING[-2:], _NARROWING[-2:]):
        chosen = {i: samples[i] for i in usual}
        offset, shift = _aligned(arm, chosen, stamps, (offset, shift), [share * options.reach for share in narrowing])
        for i, points in samples.items():
            lowest = float(coarse[int(np.argmin(curves[i]))])
            trial = _own(arm, points + shift, float(stamps[i]), offset, lowest, options)
            own[i], information[i] = trial.offset, trial.information
        if np.linalg.norm(shift) > options.reach:
            raise _UndeterminedError("what the camera sees does not lie on the arm")
        offset, usual = _agreed(own, information, list(samples))
    return _summary(own, information, usual, offset, shift, options)


def _grid(options: ClockOptions) -> Array:
    """Offsets of the coarse search [s]."""
    steps = math.ceil(options.search / _COARSE)
    return np.asarray(options.offset + _COARSE * np.arange(-steps, steps + 1, dtype=float))


def _own(arm: _Arm, points: Array, stamp: float, offset: float, lowest: float, options: ClockOptions) -> _OwnOffset:
    """One frame's own offset, near the common one unless another fits clearly better [s]."""
    trial = arm.own_offset(points, stamp, offset, options.reach, _NARROWING[-3:])
    if abs(lowest - offset) > _LEAST_LATE:
        other = arm.own_offset(points, stamp, lowest, options.reach, _NARROWING[1:])
        trial = other if other.misfit < _CLEARLY * trial.misfit else trial
    return trial


def _coarse_curve(
    arm: _Arm, points: Array, stamp: float, rng: np.random.Generator, coarse: Array, reach: float
) -> Array:
    """Mean square distance of some points of a frame at the offsets of a coarse grid [m^2]."""
    few = points[rng.choice(len(points), min(_FEW, len(points)), replace=False)]
    sums = np.empty(len(coarse))
    for k, offset in enumerate(coarse):
        away = arm.robot.distance(few, arm.posture(stamp - offset), reach, moving_only=True)
        sums[k] = np.mean(np.minimum(away, reach) ** 2)
    return sums


def _lowest(curves: Mapping[int, Array], coarse: Array, options: ClockOptions) -> float:
    """The offset of the grid at which all frames together fit best [s]."""
    total = np.sum(list(curves.values()), axis=0)
    best = int(np.argmin(total))
    if total.max() - total.min() < _CONTRAST * total.max():
        raise _UndeterminedError("the arm hardly moves")
    if best in (0, len(coarse) - 1):
        raise _UndeterminedError(f"no best offset within {options.search:g} s of it; the clocks may differ by more")
    return float(coarse[best])


def _aligned(
    arm: _Arm, samples: Mapping[int, Array], stamps: Array, start: tuple[float, Array], reaches: Sequence[float]
) -> tuple[float, Array]:
    """Offset and shift of the camera by Gauss-Newton steps on all frames, within one reach after the other."""
    offset, shift = start
    for reach in reaches:
        rows = [arm.rows(points + shift, float(stamps[i]) - offset, reach) for i, points in samples.items()]
        stacked = np.concatenate(rows)
        if len(stacked) < _FEWEST:
            raise _UndeterminedError("the arm is not in view")
        held = np.diag([1e-9, *[len(stacked) * _SHIFT] * 3])
        gradient = stacked[:, :4].T @ stacked[:, 4] + held @ np.append(0.0, shift)
        change = np.linalg.solve(stacked[:, :4].T @ stacked[:, :4] + held, -gradient)
        offset += float(np.clip(change[0], -_LARGEST_CHANGE, _LARGEST_CHANGE))
        shift = shift + change[1:]
    return offset, shift


def _agreed(own: Array, information: Array, frames: Sequence[int]) -> tuple[float, list[int]]:
    """Median of the frames' own offsets, and the frames near it: those stamped late must not pull the others."""
    usual = [i for i in frames if information[i] > 0]
    if len(usual) < 2:
        raise _UndeterminedError("the arm is hardly in view")
    offset = weighted_median(own[usual], information[usual])
    apart = own - offset
    variance = float(np.median((information * apart**2)[usual])) / _MEDIAN_SQUARE
    limit = np.maximum(_LEAST_LATE, 4 * np.sqrt(variance / np.maximum(information, 1e-12)))
    usual = [i for i in usual if abs(apart[i]) < limit[i]]
    if len(usual) < 2:
        raise _UndeterminedError("the frames do not agree on one")
    return offset, usual


def _summary(
    own: Array, information: Array, usual: list[int], offset: float, shift: Array, options: ClockOptions
) -> Clock:
    """Common offset and standard deviations, from the scatter of the frames' own offsets."""
    apart = own[usual] - offset
    weight = information[usual]
    # the errors of one frame's points are alike to an unknown degree: only the scatter says how much a frame knows
    variance = max(float(np.mean(weight * apart**2)), 1e-12)
    count = len(usual)
    offset += float(weight @ apart / weight.sum())
    std = math.sqrt(float(weight**2 @ (own[usual] - offset) ** 2) * count / (count - 1)) / float(weight.sum())
    if not std < options.determined:
        raise _UndeterminedError("the arm moves too little to tell")
    text = f"clock offset {1e3 * offset:.1f} ms ± {1e3 * std:.1f} ms (stamp minus joint time, from {count} frames)"
    if np.linalg.norm(shift) > _NOTED_SHIFT:
        text += f"; the camera sees the arm {1e3 * np.linalg.norm(shift):.0f} mm from where the joints have it"
    return Clock(offset, std, True, shift, variance, text)

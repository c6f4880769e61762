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
from collections.abc import Callable, Sequence
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
_FEWEST = 40  # points that tell anything of a frame
_CONTRAST = 0.05  # by which a minimum must be lower than the highest sum, of that
_NARROWING = (1.0, 0.7, 0.5, 0.35, 0.35)  # of the reach, from iteration to iteration
_SHARE = 0.3  # of a frame's points must lie on the arm, or they are something else
_CLEARLY = 0.8  # of the misfit at the common offset, below which a frame's own minimum elsewhere is believed
_LEAST_LATE = 0.02  # [s]; a stamp that is off by less is like the others
_SHIFT = 1e-2  # weight, against that of the points, that keeps a shift that they do not tell small
_NOTED_SHIFT = 0.006  # [m]
_MEDIAN_SQUARE = 0.4549  # of a normal variable
_STEP = 0.01  # over which velocities are taken [s]


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
        Its deviation; infinite where it was not estimated [s].
    estimated : bool
    delay : ndarray, shape (M,)
        Each frame's own offset minus the common one [s]; NaN where it cannot be told.
    delay_std : ndarray, shape (M,)
        [s]
    shift : ndarray, shape (3,)
        What would have to be added to the camera's points to bring them onto the arm [m]: an error of its pose, of its
        depth or of the joints' zeros. It is only reported.
    message : str
        In words.
    """

    offset: float
    std: float
    estimated: bool
    delay: Array
    delay_std: Array
    shift: Array
    message: str


def estimate_clock(
    robot: Surfaces,
    clouds: Sequence[Cloud | None],
    stamps: Array,
    posture: Callable[[float], Array],
    rng: np.random.Generator,
    options: ClockOptions | None = None,
) -> Clock:
    """Estimate the offset of the camera's clock.

    Parameters
    ----------
    robot : Surfaces
    clouds : sequence of Cloud or None
        Of every frame, the robot's points among them; None for frames that are of no use.
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
    count = len(stamps)
    nothing = np.full(count, np.nan)

    def taken(reason: str) -> Clock:
        text = f"clock offset {1e3 * chosen.offset:.0f} ms as given: {reason}"
        return Clock(chosen.offset, math.inf, False, nothing, nothing, np.zeros(3), text)

    if chosen.search == 0:
        return taken("it was not to be estimated")
    steps = math.ceil(chosen.search / _COARSE)
    coarse = chosen.offset + _COARSE * np.arange(-steps, steps + 1)
    samples: dict[int, Array] = {}
    for i, cloud in enumerate(clouds):
        points = _arm_points(robot, cloud, float(stamps[i]), posture, rng, chosen)
        if points is not None:
            samples[i] = points
    if not samples:
        return taken("the arm is not in view")
    curves = {}
    for i, points in samples.items():
        few = points[rng.choice(len(points), min(_FEW, len(points)), replace=False)]
        sums = np.empty(len(coarse))
        for k, offset in enumerate(coarse):
            away = robot.distance(few, posture(stamps[i] - offset), chosen.reach, moving_only=True)
            sums[k] = np.mean(np.minimum(away, chosen.reach) ** 2)
        curves[i] = sums
    total = np.sum(list(curves.values()), axis=0)
    best = int(np.argmin(total))
    if total.max() - total.min() < _CONTRAST * total.max():
        return taken("the arm hardly moves")
    if best in (0, len(coarse) - 1):
        return taken(f"no best offset within {chosen.search:g} s of it; the clocks may differ by more")
    offset = float(coarse[best])
    shift: Array = np.zeros(3)
    usual = sorted(samples)
    own, information = nothing.copy(), np.zeros(count)
    for narrowing in (_NARROWING, _NARROWING[-2:], _NARROWING[-2:]):
        for share in narrowing:
            reach = share * chosen.reach
            rows = [_rows(robot, samples[i] + shift, float(stamps[i]) - offset, posture, reach) for i in usual]
            stacked = np.concatenate(rows)
            if len(stacked) < _FEWEST:
                return taken("the arm is not in view")
            held = np.diag([1e-9, *[len(stacked) * _SHIFT] * 3])
            gradient = stacked[:, :4].T @ stacked[:, 4] + held @ np.append(0.0, shift)
            change = np.linalg.solve(stacked[:, :4].T @ stacked[:, :4] + held, -gradient)
            offset += float(np.clip(change[0], -0.05, 0.05))
            shift = shift + change[1:]
        for i, points in samples.items():
            trial = _own(robot, points + shift, float(stamps[i]), offset, posture, chosen.reach, _NARROWING[-3:])
            lowest = float(coarse[int(np.argmin(curves[i]))])
            if abs(lowest - offset) > _LEAST_LATE:
                other = _own(robot, points + shift, float(stamps[i]), lowest, posture, chosen.reach, _NARROWING[1:])
                trial = other if other[0] < _CLEARLY * trial[0] else trial
            _, own[i], information[i] = trial
        if np.linalg.norm(shift) > chosen.reach:
            return taken("what the camera sees does not lie on the arm")
        told = information > 0
        usual = [i for i in samples if told[i]]
        if len(usual) < 2:
            return taken("the arm is hardly in view")
        # frames that were stamped late must not pull the others
        offset = weighted_median(own[usual], information[usual])
        deviation = own - offset
        variance = float(np.median((information * deviation**2)[usual])) / _MEDIAN_SQUARE
        limit = np.maximum(_LEAST_LATE, 4 * np.sqrt(variance / np.maximum(information, 1e-12)))
        usual = [i for i in usual if abs(deviation[i]) < limit[i]]
        if len(usual) < 2:
            return taken("the frames do not agree on one")
    return _summary(own, information, usual, offset, shift, chosen)


def _summary(
    own: Array, information: Array, usual: list[int], offset: float, shift: Array, options: ClockOptions
) -> Clock:
    """Common offset and deviations, from the scatter of the frames' own offsets."""
    deviation = own[usual] - offset
    heft = information[usual]
    # the errors of one frame's points are alike to an unknown degree: how much a frame tells, its scatter must say
    variance = max(float(np.mean(heft * deviation**2)), 1e-12)
    own_std = np.sqrt(variance / np.maximum(information, 1e-12))
    count = len(usual)
    offset += float(heft @ deviation / heft.sum())
    std = math.sqrt(float(heft**2 @ (own[usual] - offset) ** 2) * count / (count - 1)) / float(heft.sum())
    if not std < options.determined:
        nothing = np.full(len(own), np.nan)
        text = f"clock offset {1e3 * options.offset:.0f} ms as given: the arm moves too little to tell"
        return Clock(options.offset, math.inf, False, nothing, nothing, np.zeros(3), text)
    own_std = np.where(np.isfinite(own), own_std, np.nan)
    text = f"clock offset {1e3 * offset:.1f} ms ± {1e3 * std:.1f} ms (stamp minus joint time, from {count} frames)"
    if np.linalg.norm(shift) > _NOTED_SHIFT:
        text += f"; the camera sees the arm {1e3 * np.linalg.norm(shift):.0f} mm from where the joints have it"
    return Clock(offset, std, True, own - offset, own_std, shift, text)


def _arm_points(
    robot: Surfaces,
    cloud: Cloud | None,
    stamp: float,
    posture: Callable[[float], Array],
    rng: np.random.Generator,
    options: ClockOptions,
) -> Array | None:
    """Points of a frame near the moving links, the fastest of them; None for too few."""
    if cloud is None or len(cloud) < _FEWEST:
        return None
    t = stamp - options.offset
    sweep = max(float(np.abs(_movement(robot, posture, t + d)).max()) for d in (-options.search, 0.0, options.search))
    within = options.reach + min(sweep * options.search, 0.1)
    _, _, part = robot.closest(cloud.points, posture(t), within)
    near = np.flatnonzero(part >= 0)
    if len(near) < _FEWEST:
        return None
    points = cloud.points[near]
    before, after = robot.poses(posture(t - 0.1))[part[near]], robot.poses(posture(t + 0.1))[part[near]]
    local = np.einsum("nji,nj->ni", before[:, :3, :3], points - before[:, :3, 3])
    moved = np.einsum("nij,nj->ni", after[:, :3, :3], local) + after[:, :3, 3] - points
    fastest = np.argsort(-np.linalg.norm(moved, axis=1), kind="stable")[: 2 * _POINTS]
    return points[rng.choice(fastest, min(_POINTS, len(fastest)), replace=False)]


def _movement(robot: Surfaces, posture: Callable[[float], Array], t: float) -> Array:
    """Velocity of the parts' origins [m/s], shape (parts, 3)."""
    ahead, behind = robot.poses(posture(t + _STEP)), robot.poses(posture(t - _STEP))
    return np.asarray((ahead[:, :3, 3] - behind[:, :3, 3]) / (2 * _STEP))


def _own(
    robot: Surfaces,
    points: Array,
    stamp: float,
    start: float,
    posture: Callable[[float], Array],
    reach: float,
    narrowing: Sequence[float],
) -> tuple[float, float, float]:
    """One frame's misfit, its own offset (not far from a start), and how much it tells of it."""
    offset, information = start, 0.0
    for share in narrowing:
        rows = _rows(robot, points, stamp - offset, posture, share * reach)
        information = float(rows[:, 0] @ rows[:, 0])
        if information > 0:
            offset -= float(np.clip(rows[:, 0] @ rows[:, 4] / information, -0.05, 0.05))
    distance = np.full(len(points), reach)
    last = _rows(robot, points, stamp - offset, posture, reach)[:, 4]
    distance[: len(last)] = last
    lies = np.count_nonzero(last < narrowing[-1] * reach)
    return float(np.mean(distance**2)), offset, information if lies >= _SHARE * len(points) else 0.0


def _rows(robot: Surfaces, points: Array, t: float, posture: Callable[[float], Array], reach: float) -> Array:
    """Linear equations in a change of offset and a shift of the camera: (rate, normal (3), distance) of each point."""
    distance, normal, part = robot.closest(points, posture(t), reach)
    near = np.flatnonzero(part >= 0)
    behind, now, ahead = (robot.poses(posture(t + d))[part[near]] for d in (-_STEP, 0.0, _STEP))
    local = np.einsum("nji,nj->ni", now[:, :3, :3], points[near] - now[:, :3, 3])
    moved = np.einsum("nij,nj->ni", ahead[:, :3, :3] - behind[:, :3, :3], local)
    velocity = (moved + ahead[:, :3, 3] - behind[:, :3, 3]) / (2 * _STEP)
    # a later offset takes the surface back along its velocity, away from the point
    rate = np.einsum("ni,ni->n", normal[near], velocity)
    return np.column_stack([rate, normal[near], distance[near]])

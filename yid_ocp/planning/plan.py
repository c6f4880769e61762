"""Planning of a motion that brings a point to a target: end equilibria by statics, the path by shooting."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from yid_ocp.errors import ConfigError, nearest
from yid_ocp.integrator.statics import Rest
from yid_ocp.integrator.step import Step, compile_step
from yid_ocp.integrator.step_model import Rollout
from yid_ocp.model.system import System
from yid_ocp.options import check
from yid_ocp.planning.ends import (
    REACHED,
    End,
    check_limits,
    check_reached,
    end_at,
    first_rest,
    joint_range,
    start_posture,
)
from yid_ocp.planning.mover import Mover
from yid_ocp.planning.options import PlanOptions
from yid_ocp.planning.path import SplinePath
from yid_ocp.planning.points import Points
from yid_ocp.planning.rows import Rows
from yid_ocp.planning.shooting import Shooting, Shot, failed
from yid_ocp.progress import SILENT, Progress
from yid_ocp.virtual.posture import initial_posture

Array = NDArray[np.float64]

HALVINGS = 3  # of the time step
STEADY = 0.1  # change by halving it, in parts of what counts as reached and as rest, that counts as none


@dataclass(frozen=True)
class Known:
    """Covariance of uncertain model parameters.

    Attributes
    ----------
    names : tuple of str
    covariance : ndarray, shape (len(names), len(names))
    """

    names: tuple[str, ...] = ()
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))


@dataclass(frozen=True, eq=False)
class Plan:
    """A planned motion that brings a point to a target, with its predicted errors.

    Attributes
    ----------
    reached : bool
        Whether the point reaches its target by a motion within the limits.
    message : str
    joints : tuple of str
    t : ndarray, shape (N + 1,)
        [s]
    position, velocity, acceleration : ndarray, shape (N + 1, nc)
        Of the joints [rad or m, per s, per s^2].
    effort : ndarray, shape (N + 1, nc)
        Required joint efforts, the last row repeated [N m or N].
    state : ndarray, shape (N + 1, nx)
    points : mapping of str to ndarray, shape (N + 1, 3)
        Trajectories of the system's points and of the one with the target [m].
    point : str
        Frame that is moved to the target.
    place : ndarray, shape (3,)
        Target position [m].
    error : float
        Largest distance of the point from its target while the arms stand still at the end [m].
    swing : float
        Largest speed of a point of the object in that time [m/s].
    off_path : float or None
        Largest distance of the point from its reference path at the same time [m]; None without a path.
    std : ndarray, shape (3,), or None
        Of the point's final position, from the parameters' covariance [m]; None without one.
    unknowns : ndarray, shape (K, nc)
    evaluations : int
    mover : Mover
        Its step may be a shorter one than that the plan began with.
    """

    reached: bool
    message: str
    joints: tuple[str, ...]
    t: Array
    position: Array
    velocity: Array
    acceleration: Array
    effort: Array
    state: Array
    points: dict[str, Array]
    point: str
    place: Array
    error: float
    swing: float
    off_path: float | None
    std: Array | None
    unknowns: Array
    evaluations: int
    mover: Mover


@dataclass(frozen=True, eq=False)
class PlannedMovement:
    """A planned joint motion as reference for the virtual robot's controller (`virtual.motion.Movement`)."""

    joints: tuple[str, ...]
    path: SplinePath
    unknowns: Array

    def at(self, t: float) -> tuple[Array, Array, Array]:
        """Joint displacement from the start, velocity and acceleration at time t [s], three arrays of shape (nj,)."""
        offset, rate, bend = (self.path.basis(np.array([t]), order)[0] @ self.unknowns for order in range(3))
        return offset, rate, bend


def plan(
    step: Step,
    options: PlanOptions,
    theta: Array | None = None,
    known: Known | None = None,
    progress: Progress = SILENT,
) -> Plan:
    """Plan a motion of a step's prescribed joints that brings a point to a target.

    Parameters
    ----------
    step : Step
        Arms prescribed, nothing driven.
    options : PlanOptions
    theta : ndarray, optional, shape (ntheta,)
        Parameters of the model; the system's values when absent.
    known : Known, optional
        Covariance of some of them.
    progress : Progress, optional

    Returns
    -------
    Plan
        Also where no motion within the limits was found: `message` says which one is passed, and by how much.

    Raises
    ------
    ConfigError, ModelError
        A goal that cannot be reached, names that do not exist, an empty box, no rest to begin from.
    """
    check(options, "plan")
    system = step.system
    if system.driven or not system.prescribed:
        raise ConfigError(
            "no joint is prescribed",
            where="plan",
            allowed="a robot whose arms move",
            hint="set model.robot and model.arms",
        )
    known = Known() if known is None else known
    values = system.parameters.vector() if theta is None else np.asarray(theta, float)
    progress.stage("finding where the motion begins and ends")
    posture = _posture(system, options, values)
    start = first_rest(step, values, posture)
    point, inside = _points(step, options)
    n = system.size
    begin = point.at(start.state[None, :n], values)[0][0, :3]
    place = _place(options, begin)
    _check_box(options, inside, start, n, values, place)
    check_limits(step, values, start, options.limits, "where the motion begins")
    end = end_at(step, values, start, point, place, options.tolerance)
    check_reached(end, point.names[0], place, options.tolerance)
    check_limits(step, values, end.rest, options.limits, "where it ends")

    def attempt(duration: float) -> Plan:
        return _attempt(step, replace(options, duration=duration), values, known, (start, end), (point, inside), place)

    progress.stage(f"searching the motion in {options.duration:g} s")
    found = attempt(options.duration)
    if options.shortest:
        found = _shortest(found, options, step.time_step, attempt, progress)
    return found


def _posture(system: System, options: PlanOptions, theta: Array) -> Array:
    if options.posture is not None:
        return start_posture(system, options.posture)
    if not system.grasps:
        raise ConfigError(
            "nothing says where the motion begins",
            where="plan.posture",
            allowed="every joint that moves",
            hint="only where a gripper holds the object do the angles follow from that",
        )
    by_name = dict(zip(system.parameters.names, map(float, theta), strict=True))
    return start_posture(system, {k: v for k, v in initial_posture(system, by_name).items() if k in system.prescribed})


def _points(step: Step, options: PlanOptions) -> tuple[Points, Points | None]:
    system = step.system
    if options.point is None:
        raise ConfigError(
            "no point is named", where="plan.point", allowed="a frame of the model", hint=nearest("", system.points)
        )
    calm = [name for name in system.points if name != options.point]
    inside = None
    if options.goal == "box":
        inside = Points(system, options.inside or system.points)
    return Points(system, [options.point, *calm]), inside


def _place(options: PlanOptions, begin: Array) -> Array:
    if (options.place is None) == (options.shift is None):
        twice = options.place is not None
        raise ConfigError(
            f"{'it is said twice' if twice else 'nothing says'} where the point is to arrive",
            where="plan.place",
            allowed="one of place and shift",
            hint="set the other one to null" if twice else "set plan.place, or plan.shift from where it rests",
        )
    if options.goal == "path" and not options.via:
        raise ConfigError("the path has no places on the way", where="plan.via", allowed="one or more shifts [m]")
    return np.array(options.place, float) if options.place is not None else begin + np.array(options.shift, float)


def _check_box(options: PlanOptions, inside: Points | None, start: Rest, n: int, theta: Array, place: Array) -> None:
    if inside is None:
        return
    if options.box is None:
        raise ConfigError("there is no box", where="plan.box", allowed="two corners [m]", hint="goal: place needs none")
    low, high = np.array(options.box)
    if np.any(low >= high):
        worst = int(np.argmin(high - low))
        axis = "xyz"[worst]
        raise ConfigError(
            f"the box is empty along {axis}: it goes from {low[worst]:.4g} up to {high[worst]:.4g} m",
            where="plan.box",
            allowed="lowest corner first",
        )
    at = inside.at(start.state[None, :n], theta)[0].reshape(-1, 3)
    for name, where, when in [*((name, x, "starts") for name, x in zip(inside.names, at, strict=True)),
                              (str(options.point), place, "is to arrive")]:  # fmt: skip
        if when == "is to arrive" and name not in inside.names:
            continue
        over = np.maximum(low - where, where - high)
        if np.any(over > 0):
            row = int(np.argmax(over))
            raise ConfigError(
                f"'{name}' {when} {1e3 * over[row]:.3g} mm outside the box along {'xyz'[row]}",
                where="plan.box",
                allowed=f"{low[row]:.4g} to {high[row]:.4g} m, it is at {where[row]:.4g} m",
                hint="enlarge the box, or name the frames to keep in it under plan.inside",
            )


def _attempt(
    step: Step,
    options: PlanOptions,
    theta: Array,
    known: Known,
    ends: tuple[Rest, End],
    points: tuple[Points, Points | None],
    place: Array,
) -> Plan:
    """The best motion of one duration: found with the step's time step, sharpened with shorter ones.

    What swings in the end is a small difference of large motions: a step that is fine enough for them leaves out part
    of it.
    """
    start, end = ends
    path = SplinePath(options.duration, options.knots)
    mover = Mover(step, theta, start, path, options.settle)
    guess = straight = path.straight(end.posture - mover.first)
    lower, upper = (np.tile(side - mover.first, (options.knots, 1)) for side in joint_range(step.system))
    evaluations = 0
    for halved in range(HALVINGS + 1):
        rows = Rows(mover, options, points[0], place, straight, points[1])
        cases = [rows, *_scenarios(rows, known)] if options.spread else [rows]
        shot = Shooting(cases, straight.shape).solve(guess, lower, upper, options.iterations)
        evaluations += shot.evaluations
        if not shot.finished or halved == HALVINGS:
            break
        finer = _finer(mover)
        if _steady(rows, finer, shot.w):
            break
        mover, guess = finer, shot.w
    return _outcome(rows, replace(shot, evaluations=evaluations), known)


def _finer(mover: Mover) -> Mover:
    """The same with half the time step."""
    step = mover.step
    half = compile_step(
        step.system, step.time_step / 2, step.force_split, step.constraint_force, use_compiler=step.compiled
    )
    return replace(mover, step=half, start=first_rest(half, mover.theta, mover.first, mover.configuration))


def _steady(rows: Rows, finer: Mover, w: Array) -> bool:
    """Whether half the time step moves the point neither from where it arrives nor from rest."""
    options, n, h = rows.options, rows.mover.step.system.size, rows.mover.step.time_step
    own, other = (
        rows.point.at(mover.roll(w).state[::every, :n], mover.theta)[0].reshape(len(rows.mover.times), -1, 3)
        for mover, every in ((rows.mover, 1), (finer, 2))
    )
    change = (other - own)[rows.mover.standing]
    place = np.linalg.norm(change[:, 0], axis=1).max()
    speed = np.linalg.norm(np.diff(change, axis=0), axis=2).max() / h
    return bool(place <= STEADY * options.tolerance and speed <= STEADY * options.swing)


def _scenarios(rows: Rows, known: Known) -> list[Rows]:
    """The same motion with parameters a standard deviation off, along the axes that move the point's rest most."""
    mover, system = rows.mover, rows.mover.step.system
    if not len(known.names):
        raise ConfigError(
            "the parameters' uncertainty is not known", where="plan.spread", allowed="plan.run: FOLDER of `solve`"
        )
    values, vectors = np.linalg.eigh(known.covariance)
    axes = vectors * np.sqrt(np.maximum(values, 0.0))
    slope = _point_slopes(rows, mover.roll(rows.simple, names=known.names), len(known.names))
    moved = np.linalg.norm((slope @ axes).reshape(-1, axes.shape[1]), axis=0)
    found = []
    for k in np.argsort(-moved)[:2]:
        for sign in (-1.0, 1.0):
            theta = mover.theta.copy()
            for name, change in zip(known.names, sign * axes[:, k], strict=True):
                i = system.parameters.index(name)
                entry = system.parameters[name]
                floor = max(entry.lower, 0.2 * theta[i]) if theta[i] > 0 else entry.lower
                theta[i] = np.clip(theta[i] + change, floor, entry.upper)
            rest = first_rest(mover.step, theta, mover.first, mover.configuration)
            found.append(
                Rows(replace(mover, theta=theta, start=rest), rows.options, rows.point, rows.target, rows.simple)
            )
    return found


def _point_slopes(rows: Rows, rollout: Rollout, count: int) -> Array:
    """Derivative of the point's place at every node of the end by parameters, shape (nodes, 3, count)."""
    mover, n = rows.mover, rows.mover.step.system.size
    assert rollout.by_state is not None
    end = mover.standing
    _, by_q = rows.point.at(rollout.state[end, :n], mover.theta)
    return np.einsum("tiq,tqd->tid", by_q[:, :3], rollout.by_state[end, :n, :count])


def _outcome(rows: Rows, shot: Shot, known: Known) -> Plan:
    mover, step, n = rows.mover, rows.mover.step, rows.mover.step.system.size
    rollout, std = mover.roll(shot.w), None
    if len(known.names):
        slope = _point_slopes(rows, mover.roll(shot.w, names=known.names), len(known.names))[-1]
        std = np.sqrt(np.maximum(np.diag(slope @ known.covariance @ slope.T), 0.0))
    names = tuple(dict.fromkeys((*step.system.points, rows.point.names[0])))
    at = Points(step.system, names).at(rollout.state[:, :n], mover.theta)[0].reshape(len(mover.times), -1, 3)
    own = rows.point.at(rollout.state[:, :n], mover.theta)[0].reshape(len(mover.times), -1, 3)
    end = mover.standing
    error = float(np.max(np.linalg.norm(own[end, 0] - rows.target, axis=1)))
    swing = float(np.max(np.linalg.norm(np.diff(own[end], axis=0), axis=2)) / step.time_step)
    course = rows.course
    off_path = None if course is None else float(np.max(np.linalg.norm(own[:, 0] - course, axis=1)))
    broken = rows.broken(rows.limits(rollout, shot.w).value)
    message = shot.message
    for what, (name, value, bound) in broken.items():
        message += f"; {name} passes its limit of {what}: {value:.4g} where {bound:.4g} is allowed"
    if failed(rollout):
        message += "; the model could not be stepped to the end of the motion"
    if broken:
        message += "; take a longer plan.duration, a nearer place, or a higher plan.limits where the machine allows it"
    # what errs least over all likely parameters need not arrive with the likeliest ones
    doubt = float(np.linalg.norm(std)) if std is not None and rows.options.spread else 0.0
    far = not error <= REACHED * max(rows.options.tolerance, doubt)
    if shot.finished and far:
        message = (
            f"the best motion within the limits leaves the point {1e3 * error:.3g} mm from its place; take a longer "
            "plan.duration or a nearer place"
        )
    reached = shot.finished and not broken and not far
    return Plan(
        reached, message, step.system.prescribed, mover.times, mover.positions(shot.w),
        mover.path.basis(mover.times, 1) @ shot.w, mover.path.basis(mover.times, 2) @ shot.w,
        np.vstack([rollout.effort, rollout.effort[-1:]]), rollout.state,
        {name: at[:, i] for i, name in enumerate(names)}, rows.point.names[0], rows.target, error, swing, off_path, std,
        shot.w, shot.evaluations, mover,
    )  # fmt: skip


def _shortest(
    found: Plan, options: PlanOptions, h: float, attempt: Callable[[float], Plan], progress: Progress
) -> Plan:
    """Halve the gap between a duration with which the goal is reached and one with which it is not, in steps of h."""

    def good(one: Plan) -> bool:
        return one.reached and one.swing <= options.swing

    if not good(found):
        return found
    low, high = 0, round(options.duration / h)
    finest = max(1, round(0.02 / h))
    progress.stage("searching the shortest motion")
    for done in itertools.count():
        if high - low <= finest:
            break
        middle = (low + high) // 2
        left = math.ceil(math.log2((high - low) / finest))
        progress.advance(done, done + left, f"a motion in {middle * h:g} s")
        tried = attempt(middle * h)
        if good(tried):
            found, high = tried, middle
        else:
            low = middle
    return found

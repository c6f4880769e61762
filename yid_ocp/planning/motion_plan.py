"""Planning of a motion that brings a point to a target: end equilibria by statics, the path by shooting."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from yid_ocp.errors import ConfigError, nearest_name_hint
from yid_ocp.integrator.statics import Equilibrium
from yid_ocp.integrator.step import Step, compile_step
from yid_ocp.integrator.step_model import Rollout
from yid_ocp.model.system import System
from yid_ocp.options import check_option_bounds
from yid_ocp.planning.end_equilibria import (
    REACHED_TOLERANCE_FACTOR,
    EndEquilibrium,
    check_standstill_limits,
    check_target_reachable,
    joint_position_limits,
    ordered_start_positions,
    solve_end_equilibrium,
    solve_start_equilibrium,
)
from yid_ocp.planning.frame_positions import FramePositions
from yid_ocp.planning.options import PlanOptions
from yid_ocp.planning.path_simulator import PathSimulator
from yid_ocp.planning.plan_constraints import PlanResidualsAndLimits
from yid_ocp.planning.plan_shooting import PlanShooting, PlanShootingResult, has_rollout_failed
from yid_ocp.planning.spline_path import SplinePath
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.virtual.joint_motion import grasping_joint_angles

Array = NDArray[np.float64]

_MAX_STEP_HALVINGS = 3  # of the time step
_CONVERGED_TOLERANCE_FRACTION = (
    0.1  # change by halving it, in parts of what counts as reached and as rest, that counts as none
)


@dataclass(frozen=True)
class ParameterCovariance:
    """Covariance of uncertain model parameters.

    Attributes
    ----------
    parameter_names : tuple of str
    covariance : ndarray, shape (len(names), len(names))
    """

    parameter_names: tuple[str, ...] = ()
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))


@dataclass(frozen=True, eq=False)
class MotionPlan:
    """A planned motion that brings a point to a target, with its predicted errors.

    Attributes
    ----------
    is_successful : bool
        Whether the point reaches its target by a motion within the limits.
    message : str
    joint_names : tuple of str
    t : ndarray, shape (N + 1,)
        [s]
    joint_positions, joint_velocities, joint_accelerations : ndarray, shape (N + 1, nc)
        Of the joints [rad or m, per s, per s^2].
    joint_efforts : ndarray, shape (N + 1, nc)
        Required joint efforts, the last row repeated [N m or N].
    state_trajectory : ndarray, shape (N + 1, nx)
    point_trajectories : mapping of str to ndarray, shape (N + 1, 3)
        Trajectories of the system's points and of the one with the target [m].
    target_point : str
        Frame that is moved to the target.
    target_position : ndarray, shape (3,)
        Target position [m].
    max_position_error : float
        Largest distance of the point from its target while the arms stand still at the end [m].
    max_residual_speed : float
        Largest speed of a point of the object in that time [m/s].
    max_path_deviation : float or None
        Largest distance of the point from its reference path at the same time [m]; None without a path.
    end_position_std : ndarray, shape (3,), or None
        Of the point's final position, from the parameters' covariance [m]; None without one.
    spline_coefficients : ndarray, shape (K, nc)
    n_evaluations : int
    simulator : Mover
        Its step may be a shorter one than that the plan began with.
    """

    is_successful: bool
    message: str
    joint_names: tuple[str, ...]
    t: Array
    joint_positions: Array
    joint_velocities: Array
    joint_accelerations: Array
    joint_efforts: Array
    state_trajectory: Array
    point_trajectories: dict[str, Array]
    target_point: str
    target_position: Array
    max_position_error: float
    max_residual_speed: float
    max_path_deviation: float | None
    end_position_std: Array | None
    spline_coefficients: Array
    n_evaluations: int
    simulator: PathSimulator


@dataclass(frozen=True, eq=False)
class PlannedMovement:
    """A planned joint motion as reference for the virtual robot's controller (`virtual.motion.JointMotion`)."""

    joints: tuple[str, ...]
    path: SplinePath
    spline_coefficients: Array

    def offset_and_derivatives(self, t: float) -> tuple[Array, Array, Array]:
        """Joint displacement from the start, velocity and acceleration at time t [s], three arrays of shape (nj,)."""
        offset, rate, bend = (
            self.path.basis_values(np.array([t]), order)[0] @ self.spline_coefficients for order in range(3)
        )
        return offset, rate, bend


def plan_motion(
    step: Step,
    options: PlanOptions,
    theta: Array | None = None,
    known: ParameterCovariance | None = None,
    progress: Progress = NULL_PROGRESS,
) -> MotionPlan:
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
    check_option_bounds(options, "plan")
    system = step.system
    if system.driven or not system.prescribed:
        raise ConfigError(
            "no joint is prescribed",
            where="plan",
            allowed="a robot whose arms move",
            hint="set model.robot and model.arms",
        )
    known = ParameterCovariance() if known is None else known
    values = system.parameters.vector() if theta is None else np.asarray(theta, float)
    progress.begin_stage("finding where the motion begins and ends")
    posture = _posture(system, options, values)
    start = solve_start_equilibrium(step, values, posture)
    point, inside = _points(step, options)
    n = system.n_coordinates
    begin = point.positions_and_jacobian(start.state[None, :n], values)[0][0, :3]
    place = _place(options, begin)
    _check_box(options, inside, start, n, values, place)
    check_standstill_limits(step, values, start, options.limits, "where the motion begins")
    end = solve_end_equilibrium(step, values, start, point, place, options.position_tolerance)
    check_target_reachable(end, point.names[0], place, options.position_tolerance)
    check_standstill_limits(step, values, end.equilibrium, options.limits, "where it ends")

    def attempt(duration: float) -> MotionPlan:
        return _attempt(step, replace(options, duration=duration), values, known, (start, end), (point, inside), place)

    progress.begin_stage(f"searching the motion in {options.duration:g} s")
    found = attempt(options.duration)
    if options.minimize_duration:
        found = _shortest(found, options, step.time_step, attempt, progress)
    return found


def _posture(system: System, options: PlanOptions, theta: Array) -> Array:
    if options.start_joint_positions is not None:
        return ordered_start_positions(system, options.start_joint_positions)
    if not system.grasps:
        raise ConfigError(
            "nothing says where the motion begins",
            where="plan.start_joint_positions",
            allowed="every joint that moves",
            hint="only where a gripper holds the object do the angles follow from that",
        )
    by_name = dict(zip(system.parameters.names, map(float, theta), strict=True))
    return ordered_start_positions(
        system, {k: v for k, v in grasping_joint_angles(system, by_name).items() if k in system.prescribed}
    )


def _points(step: Step, options: PlanOptions) -> tuple[FramePositions, FramePositions | None]:
    system = step.system
    if options.point is None:
        raise ConfigError(
            "no point is named",
            where="plan.point",
            allowed="a frame of the model",
            hint=nearest_name_hint("", system.point_frames),
        )
    calm = [name for name in system.point_frames if name != options.point]
    inside = None
    if options.goal == "box":
        inside = FramePositions(system, options.frames_in_box or system.point_frames)
    return FramePositions(system, [options.point, *calm]), inside


def _place(options: PlanOptions, begin: Array) -> Array:
    if (options.target_position is None) == (options.target_offset is None):
        twice = options.target_position is not None
        raise ConfigError(
            f"{'it is said twice' if twice else 'nothing says'} where the point is to arrive",
            where="plan.target_position",
            allowed="one of place and shift",
            hint="set the other one to null"
            if twice
            else "set plan.target_position, or plan.target_offset from where it rests",
        )
    if options.goal == "path" and not options.waypoint_offsets:
        raise ConfigError(
            "the path has no places on the way", where="plan.waypoint_offsets", allowed="one or more shifts [m]"
        )
    return (
        np.array(options.target_position, float)
        if options.target_position is not None
        else begin + np.array(options.target_offset, float)
    )


def _check_box(
    options: PlanOptions, inside: FramePositions | None, start: Equilibrium, n: int, theta: Array, place: Array
) -> None:
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
    at = inside.positions_and_jacobian(start.state[None, :n], theta)[0].reshape(-1, 3)
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
                hint="enlarge the box, or name the frames to keep in it under plan.frames_in_box",
            )


def _attempt(
    step: Step,
    options: PlanOptions,
    theta: Array,
    known: ParameterCovariance,
    ends: tuple[Equilibrium, EndEquilibrium],
    points: tuple[FramePositions, FramePositions | None],
    place: Array,
) -> MotionPlan:
    """The best motion of one duration: found with the step's time step, sharpened with shorter ones.

    What swings in the end is a small difference of large motions: a step that is fine enough for them leaves out part
    of it.
    """
    start, end = ends
    path = SplinePath(options.duration, options.n_spline_coefficients)
    mover = PathSimulator(step, theta, start, path, options.hold_duration)
    guess = straight = path.straight_line_coefficients(end.joint_positions - mover.start_positions)
    lower, upper = (
        np.tile(side - mover.start_positions, (options.n_spline_coefficients, 1))
        for side in joint_position_limits(step.system)
    )
    evaluations = 0
    for halved in range(_MAX_STEP_HALVINGS + 1):
        rows = PlanResidualsAndLimits(mover, options, points[0], place, straight, points[1])
        cases = [rows, *_scenarios(rows, known)] if options.minimize_parameter_sensitivity else [rows]
        shot = PlanShooting(cases, straight.shape).solve(guess, lower, upper, options.max_iterations)
        evaluations += shot.n_evaluations
        if not shot.is_converged or halved == _MAX_STEP_HALVINGS:
            break
        finer = _finer(mover)
        if _steady(rows, finer, shot.w):
            break
        mover, guess = finer, shot.w
    return _outcome(rows, replace(shot, n_evaluations=evaluations), known)


def _finer(mover: PathSimulator) -> PathSimulator:
    """The same with half the time step."""
    step = mover.step
    half = compile_step(
        step.system, step.time_step / 2, step.force_split, step.constraint_force, use_compiler=step.is_compiled
    )
    return replace(
        mover,
        step=half,
        start_equilibrium=solve_start_equilibrium(half, mover.theta, mover.start_positions, mover.start_configuration),
    )


def _steady(rows: PlanResidualsAndLimits, finer: PathSimulator, w: Array) -> bool:
    """Whether half the time step moves the point neither from where it arrives nor from rest."""
    options, n, h = rows.options, rows.simulator.step.system.n_coordinates, rows.simulator.step.time_step
    own, other = (
        rows.point.positions_and_jacobian(mover.simulate_path(w).state[::every, :n], mover.theta)[0].reshape(
            len(rows.simulator.node_times), -1, 3
        )
        for mover, every in ((rows.simulator, 1), (finer, 2))
    )
    change = (other - own)[rows.simulator.standstill_nodes]
    place = np.linalg.norm(change[:, 0], axis=1).max()
    speed = np.linalg.norm(np.diff(change, axis=0), axis=2).max() / h
    return bool(
        place <= _CONVERGED_TOLERANCE_FRACTION * options.position_tolerance
        and speed <= _CONVERGED_TOLERANCE_FRACTION * options.rest_speed_tolerance
    )


def _scenarios(rows: PlanResidualsAndLimits, known: ParameterCovariance) -> list[PlanResidualsAndLimits]:
    """The same motion with parameters a standard deviation off, along the axes that move the point's rest most."""
    mover, system = rows.simulator, rows.simulator.step.system
    if not len(known.parameter_names):
        raise ConfigError(
            "the parameters' uncertainty is not known",
            where="plan.minimize_parameter_sensitivity",
            allowed="plan.parameter_run: FOLDER of `solve`",
        )
    values, vectors = np.linalg.eigh(known.covariance)
    axes = vectors * np.sqrt(np.maximum(values, 0.0))
    slope = _point_slopes(
        rows,
        mover.simulate_path(rows.quasi_static_coefficients, names=known.parameter_names),
        len(known.parameter_names),
    )
    moved = np.linalg.norm((slope @ axes).reshape(-1, axes.shape[1]), axis=0)
    found = []
    for k in np.argsort(-moved)[:2]:
        for sign in (-1.0, 1.0):
            theta = mover.theta.copy()
            for name, change in zip(known.parameter_names, sign * axes[:, k], strict=True):
                i = system.parameters.index(name)
                entry = system.parameters[name]
                floor = max(entry.lower, 0.2 * theta[i]) if theta[i] > 0 else entry.lower
                theta[i] = np.clip(theta[i] + change, floor, entry.upper)
            rest = solve_start_equilibrium(mover.step, theta, mover.start_positions, mover.start_configuration)
            found.append(
                PlanResidualsAndLimits(
                    replace(mover, theta=theta, start_equilibrium=rest),
                    rows.options,
                    rows.point,
                    rows.target,
                    rows.quasi_static_coefficients,
                )
            )
    return found


def _point_slopes(rows: PlanResidualsAndLimits, rollout: Rollout, count: int) -> Array:
    """Derivative of the point's place at every node of the end by parameters, shape (nodes, 3, count)."""
    mover, n = rows.simulator, rows.simulator.step.system.n_coordinates
    assert rollout.state_sensitivity is not None
    end = mover.standstill_nodes
    _, by_q = rows.point.positions_and_jacobian(rollout.state[end, :n], mover.theta)
    return np.einsum("tiq,tqd->tid", by_q[:, :3], rollout.state_sensitivity[end, :n, :count])


def _outcome(rows: PlanResidualsAndLimits, shot: PlanShootingResult, known: ParameterCovariance) -> MotionPlan:
    mover, step, n = rows.simulator, rows.simulator.step, rows.simulator.step.system.n_coordinates
    rollout, std = mover.simulate_path(shot.w), None
    if len(known.parameter_names):
        slope = _point_slopes(
            rows, mover.simulate_path(shot.w, names=known.parameter_names), len(known.parameter_names)
        )[-1]
        std = np.sqrt(np.maximum(np.diag(slope @ known.covariance @ slope.T), 0.0))
    names = tuple(dict.fromkeys((*step.system.point_frames, rows.point.names[0])))
    at = (
        FramePositions(step.system, names)
        .positions_and_jacobian(rollout.state[:, :n], mover.theta)[0]
        .reshape(len(mover.node_times), -1, 3)
    )
    own = rows.point.positions_and_jacobian(rollout.state[:, :n], mover.theta)[0].reshape(len(mover.node_times), -1, 3)
    end = mover.standstill_nodes
    error = float(np.max(np.linalg.norm(own[end, 0] - rows.target, axis=1)))
    swing = float(np.max(np.linalg.norm(np.diff(own[end], axis=0), axis=2)) / step.time_step)
    course = rows.reference_path
    off_path = None if course is None else float(np.max(np.linalg.norm(own[:, 0] - course, axis=1)))
    broken = rows.violated_limits(rows.limit_values(rollout, shot.w).value)
    message = shot.message
    for what, (name, value, bound) in broken.items():
        message += f"; {name} passes its limit of {what}: {value:.4g} where {bound:.4g} is allowed"
    if has_rollout_failed(rollout):
        message += "; the model could not be stepped to the end of the motion"
    if broken:
        message += "; take a longer plan.duration, a nearer place, or a higher plan.limits where the machine allows it"
    # what errs least over all likely parameters need not arrive with the likeliest ones
    doubt = float(np.linalg.norm(std)) if std is not None and rows.options.minimize_parameter_sensitivity else 0.0
    far = not error <= REACHED_TOLERANCE_FACTOR * max(rows.options.position_tolerance, doubt)
    if shot.is_converged and far:
        message = (
            f"the best motion within the limits leaves the point {1e3 * error:.3g} mm from its place; take a longer "
            "plan.duration or a nearer place"
        )
    reached = shot.is_converged and not broken and not far
    return MotionPlan(
        reached, message, step.system.prescribed, mover.node_times, mover.joint_positions(shot.w),
        mover.path.basis_values(mover.node_times, 1) @ shot.w, mover.path.basis_values(mover.node_times, 2) @ shot.w,
        np.vstack([rollout.effort, rollout.effort[-1:]]), rollout.state,
        {name: at[:, i] for i, name in enumerate(names)}, rows.point.names[0], rows.target, error, swing, off_path, std,
        shot.w, shot.n_evaluations, mover,
    )  # fmt: skip


def _shortest(
    found: MotionPlan, options: PlanOptions, h: float, attempt: Callable[[float], MotionPlan], progress: Progress
) -> MotionPlan:
    """Halve the gap between a duration with which the goal is reached and one with which it is not, in steps of h."""

    def good(one: MotionPlan) -> bool:
        return one.is_successful and one.max_residual_speed <= options.rest_speed_tolerance

    if not good(found):
        return found
    low, high = 0, round(options.duration / h)
    finest = max(1, round(0.02 / h))
    progress.begin_stage("searching the shortest motion")
    for done in itertools.count():
        if high - low <= finest:
            break
        middle = (low + high) // 2
        left = math.ceil(math.log2((high - low) / finest))
        progress.report_parts_done(done, done + left, f"a motion in {middle * h:g} s")
        tried = attempt(middle * h)
        if good(tried):
            found, high = tried, middle
        else:
            low = middle
    return found

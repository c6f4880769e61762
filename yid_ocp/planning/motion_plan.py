"""Planning of a motion that brings a point to a target: statics gives the final equilibrium, shooting the path."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.display import NULL_PROGRESS, Progress
from yid_ocp.errors import ConfigError
from yid_ocp.integrator.step import Step, step_with_time_step
from yid_ocp.model.system import System
from yid_ocp.options import check_option_bounds
from yid_ocp.planning.joint_paths import (
    TARGET_REACHED_TOLERANCE_FACTOR,
    FramePositionEvaluator,
    PathSimulator,
    PlannedMotion,
    PlanOptions,
    RestToRestSplineBasis,
    check_rest_effort_and_spring_limits,
    solve_equilibrium_at_point_target,
    solve_start_equilibrium,
    start_joint_positions_as_array,
)
from yid_ocp.planning.motion_search import MotionToTargetResult, MotionToTargetSearch, PlanResidualAndLimitFunctions
from yid_ocp.virtual.joint_motion import grasping_joint_angles

_MAX_STEP_HALVINGS = 3  # largest number of halvings of the time step
_CONVERGED_TOLERANCE_FRACTION = 0.1  # change after halving, as a fraction of the tolerances, that counts as zero


@dataclass(frozen=True)
class ParameterCovarianceBeforePlan:
    """The covariance matrix of uncertain model parameters, in the order of `parameter_names`."""

    parameter_names: tuple[str, ...] = ()
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))


@dataclass(frozen=True, eq=False)
class TargetMotionPlan(PlannedMotion):
    """A planned motion that brings a point to a target, with its predicted errors.

    The time step of its simulation is shorter than that of the planner's argument `step` if accuracy required halving.
    """

    target_position: Array  # (3,) [m]
    max_position_error: float  # largest distance of the point from its target during the final standstill [m]
    max_residual_speed: float  # largest speed of a point of the object in that time [m/s]
    max_path_deviation: float | None  # largest distance from the reference path [m]; None without one
    end_position_std: Array | None  # (3,), of the final position, from the parameters' covariance [m]; None without one
    n_evaluations: int  # motions that the search simulated with derivatives
    is_unfinished: bool  # whether the search ended at plan.max_iterations, with a motion within the limits


def plan_motion_to_target(
    step: Step,
    options: PlanOptions,
    theta: Array | None = None,
    known: ParameterCovarianceBeforePlan | None = None,
    progress: Progress = NULL_PROGRESS,
) -> TargetMotionPlan:
    """Plan a motion of the prescribed joints that brings a point to a target.

    `theta` holds the parameter values; default: those of the system. `known` is the covariance of uncertain parameters.
    If no motion keeps the limits, a plan is still returned, whose `message` states the violated limits. Raises
    `ConfigError` or `ModelError` if the target is out of reach, a name does not exist, or there is no equilibrium.
    """
    check_option_bounds(options, "plan")
    system = step.system
    if system.driven or not system.prescribed:
        what, hint = "the model has no arm with prescribed joints", "set model.robot and model.arms.mode: prescribed"
        what = f"joint '{system.driven[0]}' is driven, not prescribed" if system.driven else what
        raise ConfigError(what, where="plan", allowed="a robot whose arm joints are all prescribed", hint=hint)
    known = ParameterCovarianceBeforePlan() if known is None else known
    values = system.parameters.vector() if theta is None else np.asarray(theta, float)
    progress.begin_stage("finding where the motion begins and ends")
    start = solve_start_equilibrium(step, values, _posture(system, options, values))
    path = RestToRestSplineBasis(options.duration, options.n_spline_coefficients)
    mover = PathSimulator(step, values, start, path, options.hold_duration)
    point, inside = moved_point_and_boxed_frames(system, options)
    place = _place(options, mover.frame_positions_along_states(point, start.state[None])[0, 0])
    if inside is not None:
        _check_box(options, inside, mover.frame_positions_along_states(inside, start.state[None])[0], place)
    check_rest_effort_and_spring_limits(step, values, start, options.limits, "where the motion begins")
    end = solve_equilibrium_at_point_target(step, values, start, point, place, options)
    check_rest_effort_and_spring_limits(step, values, end, options.limits, "where it ends")
    joints = [system.mechanism.joints[i] for i in mover.moved_joint_indices]
    travel = end.state[mover.moved_joint_indices] - mover.moved_joint_start_positions
    least = np.abs(travel) / [options.limits.velocity_fraction * (joint.velocity_limit or math.inf) for joint in joints]
    if options.duration < (shortest := float(least.max())):
        joint, turn = joints[int(least.argmax())], abs(travel[int(least.argmax())])
        size = f"{turn:.3g} {'rad' if joint.kind == 'revolute' else 'm'}"
        what = f"joint {joint.name} would move by {size} in {options.duration:g} s, faster than its speed limit"
        hint = "set a longer plan.duration, or a target nearer to the start"
        raise ConfigError(what, where="plan.duration", allowed=f"at least {shortest:.3g} s", hint=hint)

    def attempt(duration: float) -> TargetMotionPlan:
        own = replace(mover, path=replace(path, duration=duration))
        straight = own.path.straight_line_coefficients(travel)
        rows = PlanResidualAndLimitFunctions(own, replace(options, duration=duration), point, place, straight, inside)
        return _attempt(rows, known)

    progress.begin_stage(f"searching for a motion that lasts {options.duration:g} s")
    found = attempt(options.duration)
    if options.minimize_duration:
        found = _shortest(found, options, step.time_step, attempt, progress)
    return found


def _posture(system: System, options: PlanOptions, theta: Array) -> Array:
    if options.start_joint_positions is not None:
        return start_joint_positions_as_array(system, options.start_joint_positions)
    if not system.grasps:
        what, where = "the start positions of the joints are not given", "plan.start_joint_positions"
        hint = f"set {where}: {{JOINT: POSITION}}, or set model.grasp, from which start positions follow"
        raise ConfigError(what, where=where, allowed="a start position of every joint that moves", hint=hint)
    angles = grasping_joint_angles(system, dict(zip(system.parameters.names, map(float, theta), strict=True)))
    return start_joint_positions_as_array(system, {name: angles[name] for name in angles if name in system.prescribed})


def moved_point_and_boxed_frames(
    system: System, options: PlanOptions
) -> tuple[FramePositionEvaluator, FramePositionEvaluator | None]:
    """Return evaluators of the moved point and of the frames in a box. Raises `ConfigError` for unknown frames."""
    if options.point is None:
        what, hint = "plan.point is missing, the point that moves to the target", "add --set plan.point=NAME"
        if options.target_position is None and options.point_target_offset_from_start is None:
            hint += " and its target, --set 'plan.target_position=[X, Y, Z]' (world, m)"
        allowed = ", ".join(system.point_frames or system.mechanism.frames)
        raise ConfigError(what, where="plan.point", allowed=allowed, hint=hint)
    calm = [name for name in system.point_frames if name != options.point]
    boxed = options.frames_in_box or system.point_frames
    inside = FramePositionEvaluator(system, boxed, "plan.frames_in_box") if options.goal == "box" else None
    return FramePositionEvaluator(system, [options.point, *calm]), inside


def _place(options: PlanOptions, begin: Array) -> Array:
    target = options.target_position
    if (target is None) == (options.point_target_offset_from_start is None):
        keys = "plan.target_position", "plan.point_target_offset_from_start"
        hint = f"set only {keys[0]}: [x, y, z] (world, m), or only {keys[1]}: [dx, dy, dz] (from its start, m)"
        what = f"the target of the point '{options.point}' is {'not given' if target is None else 'given twice'}"
        raise ConfigError(what, where=", ".join(keys), allowed="exactly one of the two keys", hint=hint)
    if options.goal == "path" and not options.point_waypoint_offsets_from_start:
        what, hint = "plan.goal is path, but the path has no waypoints", "list them, such as [[0, 0, 0.1]]"
        raise ConfigError(what, where="plan.point_waypoint_offsets_from_start", allowed="offsets [m]", hint=hint)
    if target is not None:
        return np.array(target, float)
    return begin + np.array(options.point_target_offset_from_start, float)


def _check_box(options: PlanOptions, inside: FramePositionEvaluator, at: Array, place: Array) -> None:
    """Raise `ConfigError` without a valid box, or if the target `place` or a start position in `at` is outside it."""
    if options.box is None:
        what, hint = "plan.goal is box, but plan.box is not set", "set plan.box, or plan.goal: place"
        raise ConfigError(what, where="plan.box", allowed="[[x, y, z], [x, y, z]], lowest and highest [m]", hint=hint)
    low, high = np.array(options.box)
    if np.any(low >= high):
        worst = int(np.argmin(high - low))
        what = f"the box is empty along {'xyz'[worst]}: it goes from {low[worst]:.4g} up to {high[worst]:.4g} m"
        raise ConfigError(what, where="plan.box", allowed="the lowest corner first", hint="exchange the two numbers")
    places = [(name, x, "starts") for name, x in zip(inside.names, at, strict=True)]
    if options.point in inside.names:
        places.append((str(options.point), place, "has its target"))
    for name, where, when in places:
        over = np.maximum(low - where, where - high)
        if np.any(over > 0):
            row = int(np.argmax(over))
            what = f"'{name}' {when} {over[row]:.3g} m outside the box along {'xyz'[row]}, at {where[row]:.4g} m"
            hint = "move this position, enlarge the box, or list only other frames under plan.frames_in_box"
            raise ConfigError(what, where="plan.box", allowed=f"{low[row]:.4g} to {high[row]:.4g} m", hint=hint)


def _attempt(rows: PlanResidualAndLimitFunctions, known: ParameterCovarianceBeforePlan) -> TargetMotionPlan:
    """Find the best motion of one duration, refined with shorter time steps to resolve residual motion."""
    options, guess, evaluations = rows.options, rows.quasi_static_coefficients, 0
    for halved in range(_MAX_STEP_HALVINGS + 1):
        cases = [rows, *_scenarios(rows, known)] if options.minimize_parameter_sensitivity else [rows]
        shot = MotionToTargetSearch(cases).solve(guess, options.max_iterations)
        evaluations += shot.n_evaluations
        if not shot.is_converged or halved == _MAX_STEP_HALVINGS:
            break
        half = step_with_time_step(rows.simulator.step, rows.simulator.step.time_step / 2)
        finer = _at_rest(rows.simulator, half, rows.simulator.theta)
        if _steady(rows, finer, shot.w):
            break
        guess, rows = shot.w, replace(rows, simulator=finer)
    return _outcome(rows, replace(shot, n_evaluations=evaluations), known)


def _at_rest(mover: PathSimulator, step: Step, theta: Array) -> PathSimulator:
    """The simulator with another step or other parameters, and the start equilibrium that belongs to them."""
    rest = solve_start_equilibrium(step, theta, mover.moved_joint_start_positions, mover.system_start_configuration)
    return replace(mover, step=step, theta=theta, start_equilibrium=rest)


def _steady(rows: PlanResidualAndLimitFunctions, finer: PathSimulator, w: Array) -> bool:
    """Whether the final position of the point and its standstill are the same with half the time step."""
    pairs = ((rows.simulator, 1), (finer, 2))
    own, other = (arm.frame_positions_along_states(rows.point, arm.simulate_path(w).state[::n]) for arm, n in pairs)
    change = (other - own)[rows.simulator.node_indices_after_motion]
    place = np.linalg.norm(change[:, 0], axis=1).max()
    speed = np.linalg.norm(np.diff(change, axis=0), axis=2).max() / rows.simulator.step.time_step
    reached, rest = rows.options.position_tolerance, rows.options.point_rest_speed_tolerance
    return bool(np.all(np.array([place / reached, speed / rest]) <= _CONVERGED_TOLERANCE_FRACTION))


def _scenarios(
    rows: PlanResidualAndLimitFunctions, known: ParameterCovarianceBeforePlan
) -> list[PlanResidualAndLimitFunctions]:
    """Cases with parameters off by one std along the two axes of their covariance that move the final point most."""
    mover, system = rows.simulator, rows.simulator.step.system
    if not len(known.parameter_names):
        what, where = "the uncertainty of the parameters is not known", "plan.minimize_parameter_sensitivity"
        allowed = "false; or true with the run folder of a `solve` under plan.parameter_run_folder"
        raise ConfigError(what, where=where, allowed=allowed, hint="set plan.parameter_run_folder, or set this false")
    values, vectors = np.linalg.eigh(known.covariance)
    axes = vectors * np.sqrt(np.maximum(values, 0.0))
    slope = _point_slopes(rows, rows.quasi_static_coefficients, known)
    moved, found = np.linalg.norm((slope @ axes).reshape(-1, axes.shape[1]), axis=0), []
    for k in np.argsort(-moved)[:2]:
        for sign in (-1.0, 1.0):
            theta = mover.theta.copy()
            for name, change in zip(known.parameter_names, sign * axes[:, k], strict=True):
                i, entry = system.parameters.index(name), system.parameters[name]
                floor = max(entry.lower, 0.2 * theta[i]) if theta[i] > 0 else entry.lower
                theta[i] = np.clip(theta[i] + change, floor, entry.upper)
            found.append(replace(rows, simulator=_at_rest(mover, mover.step, theta), inside=None))
    return found


def _point_slopes(rows: PlanResidualAndLimitFunctions, w: Array, known: ParameterCovarianceBeforePlan) -> Array:
    """Derivative of the point's final position, at each final node, by the uncertain parameters, (nodes, 3, count)."""
    mover, n, end = rows.simulator, rows.simulator.step.system.n_coordinates, rows.simulator.node_indices_after_motion
    rollout = mover.simulate_path(w, names=known.parameter_names)
    assert rollout.state_sensitivity is not None
    _, by_q = rows.point.positions_and_jacobian(rollout.state[end, :n], mover.theta)
    return np.einsum("tiq,tqd->tid", by_q[:, :3], rollout.state_sensitivity[end, :n])


def _outcome(
    rows: PlanResidualAndLimitFunctions, shot: MotionToTargetResult, known: ParameterCovarianceBeforePlan
) -> TargetMotionPlan:
    mover = rows.simulator
    rollout, std = mover.simulate_path(shot.w), None
    if len(known.parameter_names):
        slope = _point_slopes(rows, shot.w, known)[-1]
        std = np.sqrt(np.maximum(np.diag(slope @ known.covariance @ slope.T), 0.0))
    own = mover.frame_positions_along_states(rows.point, rollout.state)
    end = mover.node_indices_after_motion
    error = float(np.max(np.linalg.norm(own[end, 0] - rows.target, axis=1)))
    swing = float(np.max(np.linalg.norm(np.diff(own[end], axis=0), axis=2)) / mover.step.time_step)
    course = rows.desired_point_trajectory
    off_path = None if course is None else float(np.max(np.linalg.norm(own[:, 0] - course, axis=1)))
    broken = rows.worst_value_and_bound_by_violated_limit(rows.constraints_and_jacobian(rollout, shot.w)[0])
    message = shot.message
    for what, (name, value, bound) in broken.items():
        message += f". The {what} of {name} reaches {value:.4g}, but the limit is {bound:.4g}"
    if not np.all(np.isfinite(rollout.state)):
        message += ". The simulation failed before the end of the motion"
    if broken:
        message += ". Set a longer plan.duration, a nearer target, or higher plan.limits if the robot allows it"
    # the motion with the smallest mean error need not reach the target at the most likely parameters
    doubt = float(np.linalg.norm(std)) if std is not None and rows.options.minimize_parameter_sensitivity else 0.0
    most = TARGET_REACHED_TOLERANCE_FACTOR * max(rows.options.position_tolerance, doubt)
    far = not error <= most
    if shot.is_converged and far:
        message = f"the best motion within the limits leaves the point {1e3 * error:.3g} mm from its target "
        message += f"({1e3 * most:.3g} mm, {TARGET_REACHED_TOLERANCE_FACTOR:g} times tolerance or std, is tolerated). "
        message += "Set a longer plan.duration or a nearer target"
    reached = shot.is_converged and not broken and not far
    errors = error, swing, off_path, std, shot.n_evaluations, shot.is_unfinished
    point = rows.point.names[0]
    return TargetMotionPlan(mover, shot.w, rollout, reached, message, rows.target, *errors, target_point=point)


def _shortest(
    found: TargetMotionPlan,
    options: PlanOptions,
    h: float,
    attempt: Callable[[float], TargetMotionPlan],
    progress: Progress,
) -> TargetMotionPlan:
    """The plan with the shortest duration, found by bisection to 0.02 s; `found` itself if that misses the goal."""

    def good(one: TargetMotionPlan) -> bool:
        return one.is_successful and one.max_residual_speed <= options.point_rest_speed_tolerance

    if not good(found):
        return found
    low, high = 0, round(options.duration / h)
    finest = max(1, round(0.02 / h))
    progress.begin_stage("searching for the shortest motion")
    for done in itertools.count():
        if high - low <= finest:
            break
        middle, left = (low + high) // 2, math.ceil(math.log2((high - low) / finest))
        progress.report_parts_done(done, done + left, f"a motion that lasts {middle * h:g} s")
        tried = attempt(middle * h)
        if good(tried):
            found, high = tried, middle
        else:
            low = middle
    return found

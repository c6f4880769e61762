"""Settings, joint paths, equilibria and simulation of planned motions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Annotated, Literal

import casadi as ca
import numpy as np
from annotated_types import Ge, Gt, Le
from scipy.interpolate import BSpline
from scipy.optimize import least_squares

from yid_ocp.arrays import Array, IntArray, Vector3
from yid_ocp.errors import ConfigError, ModelError, require_known_names, unknown_name_error_arguments
from yid_ocp.integrator.statics import Equilibrium, EquilibriumSolver
from yid_ocp.integrator.step import Step, simulate
from yid_ocp.integrator.step_model import Rollout, SensitivityDirections
from yid_ocp.model.system import System
from yid_ocp.options import OptionInfo
from yid_ocp.parallel import CASADI_LOCK


@dataclass(frozen=True, kw_only=True)
class PlanLimits:
    """The limits of a planned motion on velocity, acceleration, effort and spring angles."""

    velocity_fraction: Annotated[float, Gt(0), Le(1), OptionInfo("used fraction of the URDF's velocity limits")] = 0.9
    max_acceleration: Annotated[float, Gt(0), OptionInfo("limit of every joint", "rad/s^2 or m/s^2")] = 20.0
    effort_fraction: Annotated[float, Gt(0), Le(1), OptionInfo("used fraction of the URDF's effort limits")] = 0.9
    max_spring_angle: Annotated[
        float | None, Gt(0), OptionInfo("largest angle of every spring of the object; default: no limit", "rad")
    ] = None


@dataclass(frozen=True, kw_only=True)
class PlanOptions:
    """The goal, duration and numerical settings of a planned motion of the arms."""

    goal: Annotated[
        Literal["place", "path", "box", "information"],
        OptionInfo(
            "place: bring a point to a target; path: along a path; box: with points kept inside a box; information: "
            "the most informative recordings"
        ),
    ] = "place"
    point: Annotated[str | None, OptionInfo("frame to move: a tip of the object, T3:50%, a gripper")] = None
    target_position: Annotated[Vector3 | None, OptionInfo("position in the world; or give an offset", "m")] = None
    point_target_offset_from_start: Annotated[
        Vector3 | None, OptionInfo("target position relative to the point's equilibrium position at the start", "m")
    ] = None
    point_waypoint_offsets_from_start: Annotated[
        tuple[Vector3, ...], OptionInfo("waypoints of a path, relative to the start, passed at equal times", "m")
    ] = ()
    box: Annotated[tuple[Vector3, Vector3] | None, OptionInfo("lowest and highest corner in the world", "m")] = None
    frames_in_box: Annotated[
        tuple[str, ...] | None, OptionInfo("frames kept inside the box; default: all points of the object")
    ] = None
    start_joint_positions: Annotated[
        Mapping[str, float] | None,
        OptionInfo(
            "joint positions at the start, at standstill; default: those at the start of the first recording, else "
            "of the arms' first grasp of the undeformed object",
            "rad or m",
        ),
    ] = None
    duration: Annotated[float, Gt(0), Le(60), OptionInfo("duration of the arms' motion", "s")] = 1.5
    hold_duration: Annotated[
        float, Gt(0), Le(60), OptionInfo("standstill after the motion, with the point at its target", "s")
    ] = 0.5
    n_spline_coefficients: Annotated[
        int, Ge(2), Le(40), OptionInfo("coefficients of each joint's spline of degree 5, the final position included")
    ] = 7
    minimize_duration: Annotated[
        bool, OptionInfo("whether to search the shortest duration with which the goal is reached")
    ] = False
    position_tolerance: Annotated[float, Gt(0), OptionInfo("distance that counts as reached", "m")] = 1e-3
    point_rest_speed_tolerance: Annotated[float, Gt(0), OptionInfo("point's speed counted as standstill", "m/s")] = 0.01
    effort_weight: Annotated[
        float, Ge(0), OptionInfo("weight of the mean square effort over its limit; raise it for calm motions")
    ] = 0.0
    minimize_parameter_sensitivity: Annotated[
        bool, OptionInfo("whether the error due to the parameters' uncertainty is minimised as well")
    ] = False
    parameters_to_identify: Annotated[
        tuple[str, ...] | None,
        OptionInfo("goal information: parameters to determine most precisely together; default: all free parameters"),
    ] = None
    effects_to_discriminate: Annotated[
        tuple[str, ...] | None, OptionInfo("goal information: effects to discriminate, kind@location")
    ] = None
    n_random_starts: Annotated[
        int, Ge(1), Le(1000), OptionInfo("goal information: number of random initial motions; the best result is kept")
    ] = 5
    seed: Annotated[int, Ge(0), OptionInfo("random seed of these motions")] = 0
    limits: Annotated[PlanLimits, OptionInfo("limits of joints and springs")] = field(default_factory=PlanLimits)
    max_iterations: Annotated[
        int,
        Ge(1),
        OptionInfo("limit on evaluations of a search, per refinement of the limits; goal information: limit on rounds"),
    ] = 100


class FramePositionEvaluator:
    """A compiled function of frames' world positions, with Jacobian. `ConfigError` at `where` for unknown frames."""

    def __init__(self, system: System, names: Sequence[str], where: str = "plan.point") -> None:
        for name in names:
            if not system.mechanism.has_frame(name):
                known = (*system.point_frames, *(f"{own}:50%" for own in system.mechanism.link_chains))
                said = unknown_name_error_arguments(name, (*known, *(own.holder_frame for own in system.grasps)))
                raise ConfigError(f"there is no frame '{name}'", where=where, **said)
        self.names = tuple(names)
        with CASADI_LOCK:
            (q, kinematics), theta = system.symbols_and_kinematics, system.parameters.symbols
            at = ca.vertcat(ca.SX(0, 1), *(kinematics.frame_position(name) for name in names))
            slope = ca.densify(ca.jacobian(at, q))
            self._function = ca.Function("points", [q, theta], [ca.densify(at), ca.vec(slope.T)])

    def positions_and_jacobian(self, q: Array, theta: Array) -> tuple[Array, Array]:
        """Return positions (N, 3 np) [m] of np frames at configurations (N, n), and their Jacobian (N, 3 np, n)."""
        at, slope = (np.array(x).T for x in self._function(np.asarray(q).T, np.asarray(theta)))
        return at, slope.reshape(len(at), at.shape[1], np.shape(q)[1])


_SPLINE_DEGREE = 5
_N_REST_CONTROL_POINTS = 3  # equal control points at each end, for zero velocity and acceleration there


@dataclass(frozen=True)
class RestToRestSplineBasis:
    """A spline path of joints from rest to rest: q(t) = first + sum_k basis_k(t) w_k, constant after `duration`.

    The coefficients w_k (one row for each k) are control points of a spline of degree 5 with clamped ends. The path and
    its derivatives lie within the convex hulls of their control points. So limits on control points hold at all times.
    """

    duration: float  # [s]
    n_coefficients: int  # number K of coefficients per joint; the last one is the final displacement

    def _splines(self, order: int) -> BSpline:
        ends, free = _N_REST_CONTROL_POINTS, self.n_coefficients - 1
        controls = np.zeros((2 * ends + free, self.n_coefficients))
        controls[ends : ends + free, :-1] = np.eye(free)
        controls[-ends:, -1] = 1.0
        inner = np.linspace(0.0, self.duration, len(controls) - _SPLINE_DEGREE + 1)
        knots = np.concatenate([np.zeros(_SPLINE_DEGREE), inner, np.full(_SPLINE_DEGREE, self.duration)])
        return BSpline(knots, controls, _SPLINE_DEGREE).derivative(order)

    def coefficients_to_control_points_matrix(self, order: int = 0) -> Array:
        """Return the matrix (n, K) from K coefficients to n control points of the spline's `order`-th derivative."""
        splines = self._splines(order)
        return np.asarray(splines.c[: len(splines.t) - splines.k - 1])

    def basis_values(self, t: Array, order: int = 0) -> Array:
        """Return the values (N, K) of K basis functions or their `order`-th time derivatives at times `t` (N,) [s]."""
        return np.asarray(self._splines(order)(np.minimum(t, self.duration)))

    def straight_line_coefficients(self, change: Array) -> Array:
        """Return the coefficients (K, nj) of a straight path in joint space with the total motion `change` (nj,)."""
        t = np.linspace(0.0, self.duration, 200)
        s = t / self.duration
        smooth = s**3 * (10 - 15 * s + 6 * s**2)
        share = np.linalg.lstsq(self.basis_values(t)[:, :-1], smooth - self.basis_values(t)[:, -1], rcond=None)[0]
        return np.append(share, 1.0)[:, None] * np.asarray(change, float)[None, :]


@dataclass(frozen=True, eq=False)
class PathSimulator:
    """A simulator of a system that starts at equilibrium and whose prescribed joints then follow a spline path."""

    step: Step  # all moving joints are prescribed, none is driven
    theta: Array  # (ntheta,)
    start_equilibrium: Equilibrium
    path: RestToRestSplineBasis
    hold_duration: float  # time for which the joints stand still at the end [s]

    @property
    def moved_joint_indices(self) -> list[int]:
        """The indices of the moved joints in the configuration vector."""
        return list(self.step.system.prescribed_coordinate_indices)

    @property
    def moved_joint_start_positions(self) -> Array:
        """The start positions of the moved joints, shape (nc,) [rad or m]."""
        return np.asarray(self.start_equilibrium.state[self.moved_joint_indices])

    def coefficient_bounds(self) -> tuple[Array, Array]:
        """Return the lower and upper bounds of the coefficients, from the joints' position limits, each (K, nc)."""
        shape, limits = (self.path.n_coefficients, 1), _position_limits(self.step.system)
        lower, upper = (np.tile(side - self.moved_joint_start_positions, shape) for side in limits)
        return lower, upper

    @cached_property
    def node_times(self) -> Array:
        """The times of the nodes from the start of the motion, shape (N + 1,) [s]."""
        moving = round(self.path.duration / self.step.time_step)
        standing = max(1, round(self.hold_duration / self.step.time_step))
        return np.asarray(self.step.time_step * np.arange(moving + standing + 1))

    @cached_property
    def node_indices_after_motion(self) -> IntArray:
        """The indices of the nodes at which the motion has ended and the joints stand still."""
        return np.flatnonzero(self.node_times >= self.path.duration - 1e-9)

    @cached_property
    def _basis(self) -> Array:
        return self.path.basis_values(self.node_times)

    def joint_positions(self, w: Array) -> Array:
        """Return the positions (N + 1, nc) of the moved joints at the nodes, for spline coefficients `w` (K, nc)."""
        return self.moved_joint_start_positions + self._basis @ w

    def simulate_path(self, w: Array, slopes: bool = False, names: Sequence[str] = ()) -> Rollout:
        """Simulate the path with coefficients `w` (K, nc).

        The rollout has sensitivities to the K nc coefficients if `slopes`, else to the parameters `names`.
        """
        begin, nodes, directions = self.start_equilibrium.state, len(self.node_times), None
        if slopes:
            by_path = np.asarray(np.kron(self._basis, np.eye(w.shape[1])), float).reshape(nodes, w.shape[1], w.size)
            directions = SensitivityDirections((), np.zeros((len(begin), w.size)), prescribed_tangents=by_path)
        elif names:
            known, guess = self.moved_joint_start_positions, self.system_start_configuration
            rest = EquilibriumSolver(self.step).solve(known, self.theta, guess=guess, names=names)
            directions = SensitivityDirections(tuple(names), rest.state_by_theta)
        return simulate(self.step, self.theta, begin, nodes - 1, path=self.joint_positions(w), directions=directions)

    def frame_positions_along_states(self, frames: FramePositionEvaluator, state: Array) -> Array:
        """Return the positions of frames along a trajectory (N, nx), shape (N, frames, 3) [m]."""
        q = state[:, : self.step.system.n_coordinates]
        return frames.positions_and_jacobian(q, self.theta)[0].reshape(len(state), -1, 3)

    @property
    def system_start_configuration(self) -> Array:
        """The configuration q of the system at the start, shape (n,)."""
        return np.asarray(self.start_equilibrium.state[: self.step.system.n_coordinates])


_TRAVEL_WEIGHT = 1e-2  # weight of a joint's travel [rad] relative to the distance to the target [position tolerances]
_MIN_POINT_MOBILITY = 1e-9  # motion of the point by a joint's, in metres per radian or metre, that counts as none
TARGET_REACHED_TOLERANCE_FACTOR = 1.5  # in position tolerances; beyond it, a target is out of reach


@dataclass(frozen=True, eq=False)
class PlannedMotion:
    """A planned motion of the arms, with its simulation, whether the planner succeeded, and a message on the result."""

    simulator: PathSimulator
    spline_coefficients: Array  # (K, nc)
    rollout: Rollout
    is_successful: bool  # whether a motion within the limits reaches the goal, or the search for the best one converged
    message: str
    target_point: str | None = field(default=None, kw_only=True)  # point that a target is for; None without a target

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The names of the moved joints."""
        return self.simulator.step.system.prescribed

    @property
    def t(self) -> Array:
        """The times of the nodes, shape (N + 1,) [s]."""
        return self.simulator.node_times

    @property
    def joint_positions(self) -> Array:
        """The positions of the moved joints, shape (N + 1, nc) [rad or m]."""
        return self.simulator.joint_positions(self.spline_coefficients)

    @property
    def joint_velocities(self) -> Array:
        """The velocities of the moved joints, shape (N + 1, nc) [rad/s or m/s]."""
        return self.simulator.path.basis_values(self.t, 1) @ self.spline_coefficients

    @property
    def joint_accelerations(self) -> Array:
        """The accelerations of the moved joints, shape (N + 1, nc) [rad/s^2 or m/s^2]."""
        return self.simulator.path.basis_values(self.t, 2) @ self.spline_coefficients

    @property
    def joint_efforts(self) -> Array:
        """The efforts (N + 1, nc) [N m or N] that the moved joints need. The last row repeats the row before it."""
        return np.vstack([self.rollout.effort, self.rollout.effort[-1:]])

    @cached_property
    def point_trajectories(self) -> dict[str, Array]:
        """The world trajectories (N + 1, 3) [m] of the system's points and of the target point, if any, by name."""
        system = self.simulator.step.system
        names = tuple(dict.fromkeys((*system.point_frames, *filter(None, [self.target_point]))))
        places = self.simulator.frame_positions_along_states(FramePositionEvaluator(system, names), self.rollout.state)
        return {name: places[:, i] for i, name in enumerate(names)}


def _position_limits(system: System) -> tuple[Array, Array]:
    joints = [system.mechanism.joints[i] for i in system.prescribed_coordinate_indices]
    return np.array([joint.lower_limit for joint in joints]), np.array([joint.upper_limit for joint in joints])


def start_joint_positions_as_array(system: System, posture: Mapping[str, float]) -> Array:
    """Return the start positions (nc,) of the moved joints. Raises `ConfigError` if one is missing or out of range."""
    where = "plan.start_joint_positions"
    require_known_names(posture, system.prescribed, "moved joint", where, ConfigError)
    if missing := [name for name in system.prescribed if name not in posture]:
        what, allowed = f"the position of {', '.join(missing)} is missing", "a start position of every joint that moves"
        hint = f"add the missing positions, or set {where}: null for the default start"
        raise ConfigError(what, where=where, allowed=allowed, hint=hint)
    chosen = np.array([float(posture[name]) for name in system.prescribed])
    for name, value, low, high in zip(system.prescribed, chosen, *_position_limits(system), strict=True):
        if not low - 1e-9 <= value <= high + 1e-9:
            unit = system.mechanism.joint(name).unit("rad")
            over = max(low - value, value - high)
            what = f"joint {name} starts at {value:.4g} {unit}, which is {over:.3g} {unit} beyond its limit"
            allowed, hint = f"{low:.4g} to {high:.4g} {unit}", f"set {where}.{name} to a position within its limits"
            raise ConfigError(what, where=f"{where}.{name}", allowed=allowed, hint=hint)
    return chosen


def solve_start_equilibrium(step: Step, theta: Array, configuration: Array, guess: Array | None = None) -> Equilibrium:
    """Compute the equilibrium at which a motion begins, near the configuration `guess` if given.

    Raises `ModelError` if there is no equilibrium, for example because a grasp cannot be closed.
    """
    rest = EquilibriumSolver(step).solve(configuration, theta, guess=guess)
    if not rest.is_converged:
        allowed, where = "joint positions at which every grasp holds the object at rest", "plan.start_joint_positions"
        hint = f"set {where}, or add a recording that begins with the grasped object; or correct model.grasp"
        raise ModelError(f"the motion cannot begin: {rest.message}", where=where, allowed=allowed, hint=hint)
    return rest


def check_rest_effort_and_spring_limits(
    step: Step, theta: Array, rest: Equilibrium, limits: PlanLimits, when: str
) -> None:
    """Raise `ConfigError` if an effort or spring angle at the equilibrium `rest` exceeds its limit.

    `when` is the part of the message that says which equilibrium it is, such as "where it ends".
    """
    system, joints = step.system, step.system.mechanism.joints
    efforts = zip(system.prescribed_coordinate_indices, simulate(step, theta, rest.state, 1).effort[0], strict=True)
    springs = sorted({system.mechanism.joint_index(spring.joint_name) for spring in system.elastic_joints})
    largest = np.inf if limits.max_spring_angle is None else limits.max_spring_angle
    able = limits.effort_fraction
    rows = [(i, "effort_fraction", "an effort", effort, able * joints[i].effort_limit) for i, effort in efforts]
    rows += [(i, "max_spring_angle", "an angle", rest.state[i], largest) for i in springs]
    for i, which, noun, value, limit in rows:
        if not abs(value) <= limit * (1 + 1e-9):
            unit = joints[i].unit("rad" if noun == "an angle" else "N m")
            over = f"{noun} of {value:.4g} {unit}, which is {abs(value) - limit:.3g} {unit} beyond its limit"
            what, where = f"{joints[i].name} at rest {when} has {over}", f"plan.limits.{which}"
            hint = f"raise {where} if the robot allows it, or set another plan.start_joint_positions or target"
            raise ConfigError(what, where=where, allowed=f"up to {limit:.4g} {unit}", hint=hint)


def solve_equilibrium_at_point_target(
    step: Step, theta: Array, start: Equilibrium, point: FramePositionEvaluator, target: Array, options: PlanOptions
) -> Equilibrium:
    """Find an equilibrium within the joint limits at which a point is at its target, from the initial guess `start`.

    Raises `ConfigError` if no joint moves the point, or if it stays over 1.5 `position_tolerance` from the target.
    """
    statics, system, tolerance = EquilibriumSolver(step), step.system, options.position_tolerance
    n, first = system.n_coordinates, start.state[list(system.prescribed_coordinate_indices)]

    def point_and_slope(rest: Equilibrium) -> tuple[Array, Array]:
        where, by_q = point.positions_and_jacobian(rest.state[None, :n], theta)
        return where[0, :3], by_q[0, :3] @ rest.state_by_known_coordinates[:n]

    if np.abs(point_and_slope(start)[1]).max(initial=0.0) < _MIN_POINT_MOBILITY:
        what, allowed = f"no joint moves the point '{point.names[0]}'", "a frame of a moving link or a grasped object"
        hint = "choose another point" + ", or set model.grasp" * (not system.grasps)
        raise ConfigError(what, where="plan.point", allowed=allowed, hint=hint)
    guess = [start.state[:n]]

    @lru_cache(maxsize=1)
    def rows(known: tuple[float, ...]) -> tuple[Array, Array]:
        x = np.array(known)
        rest = statics.solve(x, theta, guess=guess[0])
        if not rest.is_converged:
            return np.full(3 + len(x), 1e3), np.zeros((3 + len(x), len(x)))
        guess[0] = rest.state[:n]
        where, slope = point_and_slope(rest)
        value = np.concatenate([(where - target) / tolerance, _TRAVEL_WEIGHT * (x - first)])
        return value, np.vstack([slope / tolerance, _TRAVEL_WEIGHT * np.eye(len(x))])

    lower, upper = _position_limits(system)
    begin = np.clip(first, lower + 1e-6, upper - 1e-6)
    found = least_squares(
        lambda x: rows(tuple(x))[0], begin, jac=lambda x: rows(tuple(x))[1], bounds=(lower, upper), max_nfev=100
    )
    rest = statics.solve(found.x, theta, guess=guess[0])
    distance = float(np.linalg.norm(point_and_slope(rest)[0] - target)) if rest.is_converged else np.inf
    if not distance <= TARGET_REACHED_TOLERANCE_FACTOR * tolerance:
        size = f"{distance:.3g} m" if distance >= 1 else f"{1e3 * distance:.3g} mm"
        off = f"{size} off" if rest.is_converged else "at no position near the target"
        near = (found.x - lower < 1e-3) | (upper - found.x < 1e-3)
        names = ", ".join(name for name, one in zip(system.prescribed, near, strict=True) if one)
        limits = f", with {names} at the joint's limit" if names else ""
        place = f"({', '.join(f'{x:.4g}' for x in target)}) m in the world"
        what = f"the target {place} is out of reach: '{point.names[0]}' comes to rest {off}{limits}"
        hint = "set a nearer target, a smaller plan.point_target_offset_from_start, or other plan.start_joint_positions"
        where = f"plan.{'point_target_offset_from_start' if options.target_position is None else 'target_position'}"
        raise ConfigError(what, where=where, allowed="a position at which the point can rest", hint=hint)
    return rest

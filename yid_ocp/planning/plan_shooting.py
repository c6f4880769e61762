"""Goal and limits of a planned motion with Jacobians, and single shooting for it within limits.

Bounds of the unknowns are kept by the trust region, all other limits by an augmented Lagrangian: a row g <= u adds
rho/2 max(0, g - u + lam/rho)^2 to the cost, and lam is raised until no row is passed.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from yid_ocp.arrays import Array
from yid_ocp.integrator.step_model import Rollout
from yid_ocp.planning.joint_paths import FramePositionFunction, PathSimulator, PlanOptions, last_value_kept

_LIMIT_NODE_STRIDE = 2  # nodes between those at which limits on what moves freely are asked for
_QUASI_STATIC_DISTANCE = 1.0  # RMS distance of the joints from the quasi-static motion that counts as one [rad or m]
_ACCELERATION_WEIGHT = 1e-3  # of their mean square, in parts of their limit: of equal motions the calmer one


@dataclass(frozen=True)
class _ValueWithJacobian:
    """A vector (nr,) and its Jacobian (nr, nw) by the spline coefficients."""

    value: Array
    jacobian: Array | None


@dataclass(frozen=True, eq=False)
class _LimitRows:
    """Bounds of limit rows of one kind."""

    description: str  # the limited quantity, with its unit
    lower: Array  # (rows,)
    upper: Array  # (rows,)
    unit: Array  # (rows,), divisor that scales each row to order one
    row_names: tuple[str, ...]  # joint, spring or frame of each row


def limit_units_and_scaled_bounds(limits: Sequence[_LimitRows]) -> tuple[Array, Array, Array]:
    """Units of all limit rows, and their lower and upper bounds in these units, shape (rows,) each."""
    unit, lower, upper = (np.concatenate([getattr(rows, k) for rows in limits]) for k in ("unit", "lower", "upper"))
    return unit, lower / unit, upper / unit


def _stacked(parts: list[_ValueWithJacobian]) -> _ValueWithJacobian:
    """Vectors and Jacobians stacked one below the other."""
    slopes = [part.jacobian for part in parts]
    known = [slope for slope in slopes if slope is not None]
    value = np.concatenate([part.value for part in parts]) if parts else np.zeros(0)
    return _ValueWithJacobian(value, np.vstack(known) if len(known) == len(slopes) and known else None)


@dataclass(eq=False)
class PlanResidualsAndLimits:
    """Goal residuals and limited quantities of a planned motion, for one set of model parameters."""

    simulator: PathSimulator
    options: PlanOptions
    point: FramePositionFunction  # of the frame that is to arrive, and of all frames that are to rest
    target: Array  # (3,), where it is to arrive [m]
    quasi_static_coefficients: Array  # (K, nc); of motions that do equally well, the one nearest to them is wanted
    inside: FramePositionFunction | None = None  # frames that stay in the box

    def __post_init__(self) -> None:
        system = self.simulator.step.system
        self._joints = [system.mechanism.joints[i] for i in self.simulator.moved_joint_indices]
        able = self.options.limits.effort_fraction
        self._effort_limit = able * np.array([joint.effort_limit for joint in self._joints])
        self._springs = sorted({system.mechanism.joint_index(spring.joint_name) for spring in system.elastic_joints})
        self.limit_rows = self._bounded()

    @property
    def reference_point_positions(self) -> Array | None:
        """Reference position of the point at every node, shape (N + 1, 3) [m]; None where only the end counts."""
        if self.options.goal != "path":
            return None
        begin = self.simulator.start_configuration[None]
        first = self.point.positions_and_jacobian(begin, self.simulator.theta)[0][0, :3]
        places = np.vstack([first, *(first + np.asarray(via) for via in self.options.waypoint_offsets), self.target])
        at = np.linspace(0.0, self.simulator.path.duration, len(places))
        # the clock starts and stops gently as well, so that the way is one that can be followed
        return np.array(CubicSpline(at, places, bc_type="clamped")(np.minimum(self.simulator.node_times, at[-1])))

    def _goal_residual(self, rollout: Rollout, w: Array) -> _ValueWithJacobian:
        """Goal residual: distances and speeds over their tolerances, and weak regularisation of the motion."""
        mover, options, h = self.simulator, self.options, self.simulator.step.time_step
        n, size = mover.step.system.n_coordinates, w.size
        at, by_q = self.point.positions_and_jacobian(rollout.state[:, :n], mover.theta)
        by_w = None
        if rollout.state_sensitivity is not None:
            by_w = np.einsum("tiq,tqd->tid", by_q, rollout.state_sensitivity[:, :n, -size:])
        end, course = mover.standstill_node_indices, self.reference_point_positions
        after, before, reached = end[1:], end[1:] - 1, options.position_tolerance
        by_speed = None if by_w is None else (by_w[after] - by_w[before]) / h
        parts = [_rows(at[end, :3] - self.target, None if by_w is None else by_w[end, :3], reached)]
        parts.append(_rows((at[after] - at[before]) / h, by_speed, options.rest_speed_tolerance))
        if course is not None:
            parts.append(_rows(at[:, :3] - course, None if by_w is None else by_w[:, :3], reached))
        bend = mover.path.coefficients_to_control_points_matrix(2) / options.limits.max_acceleration
        parts.append(_rows(bend @ w, _by_coefficients(bend, w), _ACCELERATION_WEIGHT**-0.5))
        parts.append(_rows(w - self.quasi_static_coefficients, np.eye(size), _QUASI_STATIC_DISTANCE))
        if options.effort_weight:
            finite = np.isfinite(self._effort_limit)
            unit = self._effort_limit[finite] / np.sqrt(options.effort_weight)
            by_effort = None if rollout.effort_sensitivity is None else rollout.effort_sensitivity[:, finite, -size:]
            if by_effort is not None:
                by_effort = by_effort / unit[:, None]
            parts.append(_rows(rollout.effort[:, finite] / unit, by_effort, 1.0))
        return _stacked(parts)

    def limited_quantity_values(self, rollout: Rollout, w: Array) -> _ValueWithJacobian:
        """Values of the limited quantities along a motion, in the order of `limit_rows` and in their own units."""
        mover, size, every = self.simulator, w.size, slice(None, None, _LIMIT_NODE_STRIDE)
        n, moved, pushed = mover.step.system.n_coordinates, rollout.state_sensitivity, rollout.effort_sensitivity
        controls = [mover.path.coefficients_to_control_points_matrix(order) for order in (1, 2)]
        parts = [_ValueWithJacobian((matrix @ w).ravel(), _by_coefficients(matrix, w)) for matrix in controls]
        finite = np.isfinite(self._effort_limit)
        by_effort = None if pushed is None else pushed[every, finite, -size:].reshape(-1, size)
        parts.append(_ValueWithJacobian(rollout.effort[every, finite].ravel(), by_effort))
        if self.options.limits.max_spring_angle is not None:
            slope = None if moved is None else moved[every, self._springs, -size:].reshape(-1, size)
            parts.append(_ValueWithJacobian(rollout.state[every, self._springs].ravel(), slope))
        if self.inside is not None:
            at, by_q = self.inside.positions_and_jacobian(rollout.state[every, :n], mover.theta)
            slope = None if moved is None else np.einsum("tiq,tqd->tid", by_q, moved[every, :n, -size:])
            parts.append(_ValueWithJacobian(at.ravel(), None if slope is None else slope.reshape(-1, size)))
        return _stacked(parts)

    def _bounded(self) -> list[_LimitRows]:
        mover, limits = self.simulator, self.options.limits
        names = tuple(joint.name for joint in self._joints)
        speed = limits.velocity_fraction * np.array([joint.velocity_limit for joint in self._joints])
        sharp = np.full(len(names), limits.max_acceleration)
        count = len(mover.path.coefficients_to_control_points_matrix())
        found = [_even("velocity [rad/s or m/s]", names, speed, count - 1)]
        found.append(_even("acceleration [rad/s^2 or m/s^2]", names, sharp, count - 2))
        finite = np.isfinite(self._effort_limit)
        steps = len(range(0, len(mover.node_times) - 1, _LIMIT_NODE_STRIDE))
        able = tuple(name for name, one in zip(names, finite, strict=True) if one)
        found.append(_even("effort [N m or N]", able, self._effort_limit[finite], steps))
        nodes = len(range(0, len(mover.node_times), _LIMIT_NODE_STRIDE))
        if limits.max_spring_angle is not None:
            springs = tuple(mover.step.system.mechanism.joint_names[i] for i in self._springs)
            found.append(_even("angle [rad]", springs, np.full(len(springs), limits.max_spring_angle), nodes))
        if self.inside is not None and self.options.box is not None:
            low, high = (np.tile(corner, len(self.inside.names) * nodes) for corner in self.options.box)
            axes = tuple(f"{name}, {axis}" for name in self.inside.names for axis in "xyz")
            found.append(_LimitRows("place [m]", low, high, np.full(len(low), 0.1), axes * nodes))
        return found

    def limits_with_quantity_values(self, value: Array) -> Iterator[tuple[_LimitRows, Array]]:
        """Every kind of limit with its rows of `limited_quantity_values`."""
        ends = np.cumsum([len(rows.row_names) for rows in self.limit_rows])
        return zip(self.limit_rows, np.split(value, ends[:-1]), strict=True)

    def worst_violation_per_limit(self, value: Array) -> dict[str, tuple[str, float, float]]:
        """The worst violated row of each kind of limit: its name, value and bound."""
        found = {}
        for rows, own in self.limits_with_quantity_values(value):
            over = np.maximum(own - rows.upper, rows.lower - own) / rows.unit
            worst = int(np.argmax(over)) if len(own) else 0
            if len(own) and over[worst] > 1e-4:
                bound = rows.upper[worst] if own[worst] > rows.upper[worst] else rows.lower[worst]
                found[rows.description] = (rows.row_names[worst], float(own[worst]), float(bound))
        return found


def _by_coefficients(matrix: Array, w: Array) -> Array:
    """Derivative of `matrix @ w` by the coefficients, row by row."""
    return np.einsum("tk,ji->tjki", matrix, np.eye(w.shape[1])).reshape(-1, w.size)


def _rows(value: Array, slope: Array | None, unit: float) -> _ValueWithJacobian:
    """Rows of nodes (N, m), so that the sum of their squares is the mean over the nodes in squares of the unit."""
    scale = 1.0 / (unit * np.sqrt(len(value)))
    return _ValueWithJacobian(scale * value.ravel(), None if slope is None else scale * slope.reshape(value.size, -1))


def _even(what: str, names: tuple[str, ...], limit: Array, count: int) -> _LimitRows:
    upper = np.tile(limit, count)
    return _LimitRows(what, -upper, upper, np.where(np.isfinite(upper), upper, 1.0), names * count)


_INITIAL_PENALTY, _PENALTY_GROWTH, _MAX_PENALTY = 1e3, 10.0, 1e8
_LIMIT_TOLERANCE = 1e-4  # largest violation of a limit, in parts of it, that counts as none
_MAX_OUTER_ITERATIONS = 12
_FAILED_ROLLOUT_RESIDUAL = 1e4  # residual of a motion that cannot be stepped: the trust region shrinks


@dataclass(frozen=True)
class PlanShootingResult:
    """Result of a search for a planned motion: coefficients w (K, nc), converged only if within the limits."""

    w: Array
    is_converged: bool
    message: str
    n_evaluations: int


class PlanShootingProblem:
    """Shooting problem with the residuals of several parameter cases and the limits of the first case."""

    def __init__(self, cases: Sequence[PlanResidualsAndLimits], shape: tuple[int, int]) -> None:
        self._cases, self._shape = list(cases), shape
        self._residual_and_limit_values = last_value_kept(self._evaluated)
        self._unit, self._lower, self._upper = limit_units_and_scaled_bounds(self._cases[0].limit_rows)
        self.evaluations = 0

    def _evaluated(self, x: Array) -> tuple[_ValueWithJacobian, _ValueWithJacobian]:
        """Residual and scaled limit values with their Jacobians; not finite where a rollout fails."""
        self.evaluations += 1
        w = x.reshape(self._shape)
        rollouts = [case.simulator.simulate_path(w, True) for case in self._cases]
        parts = [case._goal_residual(rollout, w) for case, rollout in zip(self._cases, rollouts, strict=True)]
        whole, scale = _stacked(parts), 1.0 / np.sqrt(len(self._cases))
        limits = self._cases[0].limited_quantity_values(rollouts[0], w)
        assert whole.jacobian is not None
        assert limits.jacobian is not None
        residual = _ValueWithJacobian(scale * whole.value, scale * whole.jacobian)
        return residual, _ValueWithJacobian(limits.value / self._unit, limits.jacobian / self._unit[:, None])

    def solve(self, start: Array, lower: Array, upper: Array, iterations: int) -> PlanShootingResult:
        """Optimise a motion from initial coefficients within bounds, all of shape (K, nc).

        References
        ----------
        Rockafellar (1973), Math. Programming 5:354, doi:10.1007/BF01580138.
        Branch, Coleman and Li (1999), SIAM J. Sci. Comput. 21(1):1, doi:10.1137/S1064827595289108.
        """
        low, high = lower.ravel(), upper.ravel()
        x = np.clip(start.ravel(), low + 1e-9, high - 1e-9)
        pull = np.zeros((2, len(self._unit)))
        penalty, before, ended = _INITIAL_PENALTY, np.inf, False
        for _ in range(_MAX_OUTER_ITERATIONS):
            value, slope = (functools.partial(self._penalised, pull, penalty, part) for part in (0, 1))
            stop = {"max_nfev": iterations, "ftol": 1e-6, "xtol": 1e-7, "gtol": 1e-8}
            found = least_squares(value, x, jac=slope, bounds=(low, high), x_scale=1.0, **stop)
            x, ended = found.x, found.status > 0
            reached = self._residual_and_limit_values(x)[1].value
            over = np.vstack([reached - self._upper, self._lower - reached])
            passed = float(np.max(over, initial=0.0))
            if passed <= _LIMIT_TOLERANCE or not np.isfinite(passed):
                break
            pull = np.maximum(0.0, pull + penalty * over)
            if passed > 0.25 * before:
                penalty = min(_PENALTY_GROWTH * penalty, _MAX_PENALTY)
            before = passed
        finished = bool(ended and passed <= _LIMIT_TOLERANCE)
        message = "the motion was found" if finished else "no motion within the limits was found"
        if not ended and not passed > _LIMIT_TOLERANCE:
            message = f"the search was stopped after {iterations} evaluations; raise plan.max_iterations"
        return PlanShootingResult(x.reshape(self._shape), finished, message, self.evaluations)

    def _penalised(self, pull: Array, penalty: float, part: int, x: Array) -> Array:
        """Residual with the penalties of the limits (part 0), or its Jacobian (part 1)."""
        residual, limits = self._residual_and_limit_values(x)
        assert residual.jacobian is not None
        assert limits.jacobian is not None
        root = np.sqrt(penalty)
        sides = ((1.0, limits.value - self._upper, pull[0]), (-1.0, self._lower - limits.value, pull[1]))
        # a one beside them: the search ends where the cost falls by little of what counts as reached
        values, slopes = [np.ones(1), residual.value], [np.zeros((1, len(x))), residual.jacobian]
        for sign, over, raised in sides:
            shifted = np.maximum(over + raised / penalty, 0.0)
            values.append(root * shifted)
            slopes.append(sign * root * np.where(shifted > 0, 1.0, 0.0)[:, None] * limits.jacobian)
        value, slope = np.concatenate(values), np.vstack(slopes)
        if np.all(np.isfinite(value)) and np.all(np.isfinite(slope)):
            return (value, slope)[part]
        return (np.full(len(value), _FAILED_ROLLOUT_RESIDUAL), np.zeros_like(slope))[part]

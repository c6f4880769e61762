"""Search for motions within limits that reach a goal or give the most information.

To reach a goal, single shooting is used. The trust region keeps the bounds of the unknowns. An augmented Lagrangian
keeps all other limits: a row g <= u adds rho/2 max(0, g - u + lam/rho)^2 to the cost; lam is raised until all hold.

To maximise information, each round linearises the sensitivities J(w) and the limits, and SLSQP (Kraft 1988, DFVLR-FB
88-28) maximises the criterion of the linear J within a trust region (Burke and Ferris 1995, doi:10.1007/BF01585997).
All iterates satisfy the limits. Each parameter has a prior standard deviation of `MAX_WEAK_RELATIVE_STD` of its value.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares, minimize

from yid_ocp.arrays import Array
from yid_ocp.display import Progress
from yid_ocp.errors import SolverError
from yid_ocp.inference.uncertainty import MAX_WEAK_RELATIVE_STD
from yid_ocp.integrator.step_model import Rollout
from yid_ocp.planning.joint_paths import FramePositionEvaluator, PathSimulator, PlanOptions
from yid_ocp.planning.planned_experiment import SplineMotionExperiment

_LIMIT_NODE_STRIDE = 2  # node spacing at which limits on free coordinates are evaluated
_QUASI_STATIC_DISTANCE = 1.0  # RMS distance of the joints from the quasi-static motion that counts as one [rad or m]
_ACCELERATION_WEIGHT = 1e-3  # of the mean square acceleration [limits], to prefer the calmer of two equal motions


@dataclass(frozen=True, eq=False)
class _LimitRows:
    description: str  # limited quantity, with its unit
    lower: Array  # (rows,)
    upper: Array  # (rows,)
    unit: Array  # (rows,), divisor that scales each row to order one
    row_names: tuple[str, ...]  # joint, spring or frame of each row


def _limit_units_and_scaled_bounds(limits: Sequence[_LimitRows]) -> tuple[Array, Array, Array]:
    """Units of all limit rows, and their lower and upper bounds in these units, shape (rows,) each."""
    unit, lower, upper = (np.concatenate([getattr(rows, k) for rows in limits]) for k in ("unit", "lower", "upper"))
    return unit, lower / unit, upper / unit


@dataclass(eq=False)
class PlanResidualAndLimitFunctions:
    """Functions of a planned motion: the residual of its goal, and the quantities that must stay within limits."""

    simulator: PathSimulator
    options: PlanOptions
    point: FramePositionEvaluator  # evaluator of the target frame, and of all frames that must come to rest
    target: Array  # (3,), target position in the world [m]
    quasi_static_coefficients: Array  # (K, nc); the search prefers motions near these coefficients
    inside: FramePositionEvaluator | None = None  # frames that stay in the box

    def __post_init__(self) -> None:
        system = self.simulator.step.system
        self._joints = [system.mechanism.joints[i] for i in self.simulator.moved_joint_indices]
        able = self.options.limits.effort_fraction
        self._effort_limit = able * np.array([joint.effort_limit for joint in self._joints])
        self._springs = sorted({system.mechanism.joint_index(spring.joint_name) for spring in system.elastic_joints})
        self.limit_rows = self._bounded()

    @property
    def desired_point_trajectory(self) -> Array | None:
        """The reference position of the point at every node, (N + 1, 3) [m]. None if only the end position counts."""
        if self.options.goal != "path":
            return None
        begin = self.simulator.system_start_configuration[None]
        first = self.point.positions_and_jacobian(begin, self.simulator.theta)[0][0, :3]
        vias = (first + np.asarray(offset) for offset in self.options.point_waypoint_offsets_from_start)
        places = np.vstack([first, *vias, self.target])
        at = np.linspace(0.0, self.simulator.path.duration, len(places))
        # clamped ends, so that the reference motion starts and stops smoothly
        return np.array(CubicSpline(at, places, bc_type="clamped")(np.minimum(self.simulator.node_times, at[-1])))

    def _goal_residual(self, rollout: Rollout, w: Array) -> list[tuple[Array, Array]]:
        """Goal residual (distances and speeds over tolerances, weak regularisation) and its Jacobian, in parts."""
        mover, options, h = self.simulator, self.options, self.simulator.step.time_step
        n, size = mover.step.system.n_coordinates, w.size
        assert rollout.state_sensitivity is not None
        assert rollout.effort_sensitivity is not None
        at, by_q = self.point.positions_and_jacobian(rollout.state[:, :n], mover.theta)
        by_w = np.einsum("tiq,tqd->tid", by_q, rollout.state_sensitivity[:, :n])
        end, course = mover.node_indices_after_motion, self.desired_point_trajectory
        after, before, reached = end[1:], end[1:] - 1, options.position_tolerance
        by_speed = (by_w[after] - by_w[before]) / h
        parts = [_rows(at[end, :3] - self.target, by_w[end, :3], reached)]
        parts.append(_rows((at[after] - at[before]) / h, by_speed, options.point_rest_speed_tolerance))
        if course is not None:
            parts.append(_rows(at[:, :3] - course, by_w[:, :3], reached))
        bend = mover.path.coefficients_to_control_points_matrix(2) / options.limits.max_acceleration
        parts.append(_rows(bend @ w, np.asarray(np.kron(bend, np.eye(w.shape[1])), float), _ACCELERATION_WEIGHT**-0.5))
        parts.append(_rows(w - self.quasi_static_coefficients, np.eye(size), _QUASI_STATIC_DISTANCE))
        if options.effort_weight:
            unit = self._effort_limit / np.sqrt(options.effort_weight)
            parts.append(_rows(rollout.effort / unit, rollout.effort_sensitivity / unit[:, None], 1.0))
        return parts

    def constraints_and_jacobian(self, rollout: Rollout, w: Array) -> tuple[Array, Array | None]:
        """Return the values (rows,) of the limited quantities along a motion, in the order and units of `limit_rows`.

        Also returns their Jacobian (rows, K nc) with respect to the spline coefficients, K for each of nc prescribed
        joints, or None if `rollout` has no sensitivities.
        """
        mover, size, every = self.simulator, w.size, slice(None, None, _LIMIT_NODE_STRIDE)
        n, moved, pushed = mover.step.system.n_coordinates, rollout.state_sensitivity, rollout.effort_sensitivity
        controls = [mover.path.coefficients_to_control_points_matrix(order) for order in (1, 2)]
        one = np.eye(w.shape[1])  # the derivative of m @ w is a Kronecker product
        parts: list[tuple[Array, Array | None]] = [(m @ w, np.asarray(np.kron(m, one), float)) for m in controls]
        parts.append((rollout.effort[every], None if pushed is None else pushed[every]))
        if self.options.limits.max_spring_angle is not None:
            slope = None if moved is None else moved[every, self._springs]
            parts.append((rollout.state[every, self._springs], slope))
        if self.inside is not None:
            at, by_q = self.inside.positions_and_jacobian(rollout.state[every, :n], mover.theta)
            parts.append((at, None if moved is None else np.einsum("tiq,tqd->tid", by_q, moved[every, :n])))
        value = np.concatenate([rows.ravel() for rows, _ in parts])
        slopes = [slope.reshape(-1, size) for _, slope in parts if slope is not None]
        return value, np.vstack(slopes) if len(slopes) == len(parts) else None

    def _bounded(self) -> list[_LimitRows]:
        mover, limits = self.simulator, self.options.limits
        names = tuple(joint.name for joint in self._joints)
        speed = limits.velocity_fraction * np.array([joint.velocity_limit for joint in self._joints])
        sharp = np.full(len(names), limits.max_acceleration)
        count = len(mover.path.coefficients_to_control_points_matrix())
        found = [_even("velocity [rad/s or m/s]", names, speed, count - 1)]
        found.append(_even("acceleration [rad/s^2 or m/s^2]", names, sharp, count - 2))
        steps = len(range(0, len(mover.node_times) - 1, _LIMIT_NODE_STRIDE))
        found.append(_even("effort [N m or N]", names, self._effort_limit, steps))
        nodes = len(range(0, len(mover.node_times), _LIMIT_NODE_STRIDE))
        if limits.max_spring_angle is not None:
            springs = tuple(mover.step.system.mechanism.joint_names[i] for i in self._springs)
            found.append(_even("angle [rad]", springs, np.full(len(springs), limits.max_spring_angle), nodes))
        if self.inside is not None and self.options.box is not None:
            low, high = (np.tile(corner, len(self.inside.names) * nodes) for corner in self.options.box)
            axes = tuple(f"{name}, {axis}" for name in self.inside.names for axis in "xyz")
            found.append(_LimitRows("place [m]", low, high, np.full(len(low), 0.1), axes * nodes))
        return found

    def split_values_by_limit_kind(self, value: Array) -> Iterator[tuple[_LimitRows, Array]]:
        """Split `value`, ordered as `limit_rows`, into pairs (limit rows, values), one for each kind of limit."""
        ends = np.cumsum([len(rows.row_names) for rows in self.limit_rows])
        return zip(self.limit_rows, np.split(value, ends[:-1]), strict=True)

    def worst_value_and_bound_by_violated_limit(self, value: Array) -> dict[str, tuple[str, float, float]]:
        """Return row name, value and bound of the worst violation, by kind of limit. Other kinds are absent."""
        found = {}
        for rows, own in self.split_values_by_limit_kind(value):
            over = np.maximum(own - rows.upper, rows.lower - own) / rows.unit
            worst = int(np.argmax(over)) if len(own) else 0
            if len(own) and over[worst] > 1e-4:
                bound = rows.upper[worst] if own[worst] > rows.upper[worst] else rows.lower[worst]
                found[rows.description] = (rows.row_names[worst], float(own[worst]), float(bound))
        return found


def _rows(value: Array, slope: Array, unit: float) -> tuple[Array, Array]:
    """Rows (N, m) of nodes, scaled such that the sum of their squares is the mean over the nodes in units squared."""
    scale = 1.0 / (unit * np.sqrt(len(value)))
    return scale * value.ravel(), scale * slope.reshape(value.size, -1)


def _even(what: str, names: tuple[str, ...], limit: Array, count: int) -> _LimitRows:
    upper = np.tile(limit, count)
    return _LimitRows(what, -upper, upper, np.where(np.isfinite(upper), upper, 1.0), names * count)


_INITIAL_PENALTY, _PENALTY_GROWTH, _MAX_PENALTY = 1e3, 10.0, 1e8
_LIMIT_TOLERANCE = 1e-4  # largest violation of a limit, as a fraction of it, that counts as zero
_MAX_OUTER_ITERATIONS = 12
_FAILED_ROLLOUT_RESIDUAL = 1e4  # residual of a motion that cannot be stepped: the trust region shrinks


@dataclass(frozen=True)
class MotionToTargetResult:
    """The coefficients w (K, nc) of a planned motion, and how the search for it ended."""

    w: Array
    is_converged: bool
    is_unfinished: bool  # whether the search ended at its limit of evaluations, with a motion within the limits
    message: str
    n_evaluations: int


class MotionToTargetSearch:
    """A search for the motion that reaches a target best in all `cases` of parameters. Limits hold for the first."""

    def __init__(self, cases: Sequence[PlanResidualAndLimitFunctions]) -> None:
        self._cases, self._shape = list(cases), cases[0].quasi_static_coefficients.shape
        self._residual_and_limit_values = functools.lru_cache(maxsize=1)(self._evaluated)
        self._unit, self._lower, self._upper = _limit_units_and_scaled_bounds(self._cases[0].limit_rows)

    def _evaluated(self, x: tuple[float, ...]) -> tuple[Array, Array, Array, Array]:
        """Residual, scaled limit values and the Jacobians of both; not finite if a rollout fails."""
        w = np.reshape(x, self._shape)
        rollouts = [case.simulator.simulate_path(w, True) for case in self._cases]
        pairs = zip(self._cases, rollouts, strict=True)
        parts = [rows for case, rollout in pairs for rows in case._goal_residual(rollout, w)]
        value, slope = (np.concatenate(rows) / np.sqrt(len(self._cases)) for rows in zip(*parts, strict=True))
        limited, by_w = self._cases[0].constraints_and_jacobian(rollouts[0], w)
        assert by_w is not None
        return value, slope, limited / self._unit, by_w / self._unit[:, None]

    def solve(self, start: Array, iterations: int) -> MotionToTargetResult:
        """Optimise the spline coefficients (K, nc) of a motion: K coefficients for each of nc prescribed joints.

        The limits of the motion are enforced by an augmented Lagrangian (Rockafellar 1973, doi:10.1007/BF01580138). The
        bounds of the coefficients are enforced by an interior trust-region method (Branch, Coleman and Li 1999,
        doi:10.1137/S1064827595289108), with at most `iterations` evaluations per multiplier update.
        """
        low, high = (bound.ravel() for bound in self._cases[0].simulator.coefficient_bounds())
        x, pull = np.clip(start.ravel(), low + 1e-9, high - 1e-9), np.zeros((2, len(self._unit)))
        penalty, before, ended = _INITIAL_PENALTY, np.inf, False
        for _ in range(_MAX_OUTER_ITERATIONS):
            value, slope = (functools.partial(self._penalised, pull, penalty, part) for part in (0, 1))
            stop = {"max_nfev": iterations, "ftol": 1e-6, "xtol": 1e-7, "gtol": 1e-8}
            found = least_squares(value, x, jac=slope, bounds=(low, high), x_scale=1.0, **stop)
            x, ended = found.x, found.status > 0
            reached = self._residual_and_limit_values(tuple(x))[2]
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
        if is_unfinished := not ended and not passed > _LIMIT_TOLERANCE:
            message = f"plan.max_iterations ended the search ({iterations} evaluations). Raise it or use this motion"
        evaluations = self._residual_and_limit_values.cache_info().misses
        return MotionToTargetResult(x.reshape(self._shape), finished, is_unfinished, message, evaluations)

    def _penalised(self, pull: Array, penalty: float, part: int, x: Array) -> Array:
        """Residual with the penalties of the limits (part 0), or its Jacobian (part 1)."""
        residual, by_x, limited, limits_by_x = self._residual_and_limit_values(tuple(x))
        root = np.sqrt(penalty)
        # cost plus one: the search ends if the cost falls by little compared with a reached target
        values, slopes = [np.ones(1), residual], [np.zeros((1, len(x))), by_x]
        for sign, over, raised in ((1.0, limited - self._upper, pull[0]), (-1.0, self._lower - limited, pull[1])):
            shifted = np.maximum(over + raised / penalty, 0.0)
            values.append(root * shifted)
            slopes.append(sign * root * np.where(shifted > 0, 1.0, 0.0)[:, None] * limits_by_x)
        value, slope = np.concatenate(values), np.vstack(slopes)
        if np.all(np.isfinite(value)) and np.all(np.isfinite(slope)):
            return (value, slope)[part]
        return (np.full(len(value), _FAILED_ROLLOUT_RESIDUAL), np.zeros_like(slope))[part]


def _prior(columns: int, bounded: Sequence[int]) -> Array:
    """Prior information of each column: parameters have a std of `MAX_WEAK_RELATIVE_STD`, others a negligible term."""
    prior = np.full(columns, 1e-6)
    prior[list(bounded)] = MAX_WEAK_RELATIVE_STD**-2
    return prior


@dataclass(frozen=True)
class DOptimalityCriterion:
    """A measure of how well a motion determines chosen parameters: -1/2 log det of their covariance.

    All other unknowns are eliminated. This is D-optimality, or D_s-optimality if only some parameters are chosen
    (Atkinson, Donev and Tobias 2007, Optimum Experimental Designs, with SAS, sections 10.2 and 10.3).
    """

    chosen_columns: tuple[int, ...]
    parameter_columns: tuple[int, ...]

    def value_and_gradient_wrt_sensitivities(self, rows: Array) -> tuple[float, Array]:
        """Return the criterion [nat] and its gradient (nr, nx) by the sensitivities `rows`."""
        information, chosen = rows.T @ rows, list(self.chosen_columns)
        information[np.diag_indices_from(information)] += _prior(len(information), self.parameter_columns)
        whole = np.asarray(scipy.linalg.inv(information))
        own = whole[np.ix_(chosen, chosen)]
        wide = whole[:, chosen]  # d C = -C d(J'J) C
        return -0.5 * float(np.linalg.slogdet(own)[1]), rows @ (wide @ np.linalg.solve(own, wide.T))


@dataclass(frozen=True)
class EffectDiscriminationCriterion:
    """A measure of how well the measurements separate effects: -1/2 log sum_ij 1 / (1 + d_ij^2).

    d_ij^2 = min_b |J_i a - J_j b|^2 is the squared distance of effect i (amplitudes a, sensitivities J_i) from its best
    imitation by effect j and all nuisance unknowns (values b, sensitivities J_j). Small distances dominate the sum.
    """

    amplitude_columns: tuple[tuple[int, ...], ...]  # columns of the amplitudes of every effect
    # amplitudes in units of the columns, (amplitudes, cases): one case if they are known, else one per amplitude
    amplitude_cases: tuple[Array, ...]
    parameter_columns: tuple[int, ...]  # columns with a prior: nominal parameters and parameters of effects

    def imitation_distance(self, rows: Array, i: int, j: int) -> float:
        """Return the distance [data stds] of effect i from its best imitation by effect j."""
        return float(np.sqrt(self._apart(rows, i, j)[0]))

    def value_and_gradient_wrt_sensitivities(self, rows: Array) -> tuple[float, Array]:
        """Return the criterion [nat] and its gradient (nr, nx) by the sensitivities `rows`."""
        total, by_rows = 0.0, np.zeros_like(rows)
        for i, j in itertools.permutations(range(len(self.amplitude_columns)), 2):
            square, rest, others, used = self._apart(rows, i, j)
            weight = 1.0 / (1.0 + square)
            total += weight
            factor = 2.0 * weight**2 / len(self.amplitude_cases[i].T)
            by_rows[:, list(self.amplitude_columns[i])] += factor * rest @ self.amplitude_cases[i].T
            by_rows[:, others] -= factor * rest @ used.T
        return -0.5 * float(np.log(total)), 0.5 * by_rows / total

    def _apart(self, rows: Array, i: int, j: int) -> tuple[float, Array, list[int], Array]:
        """Squared distance, unexplained change by effect i, and columns and coefficients that imitate it."""
        away = {column for k, effect in enumerate(self.amplitude_columns) if k != j for column in effect}
        others = [column for column in range(rows.shape[1]) if column not in away]
        change, basis = rows[:, list(self.amplitude_columns[i])] @ self.amplitude_cases[i], rows[:, others]
        prior = _prior(rows.shape[1], self.parameter_columns)[others]
        used = scipy.linalg.solve(basis.T @ basis + np.diag(prior), basis.T @ change, assume_a="pos")
        rest = change - basis @ used
        return float(np.sum(rest**2) + np.sum(prior[:, None] * used**2)) / change.shape[1], rest, others, used


MotionSearchCriterion = DOptimalityCriterion | EffectDiscriminationCriterion

_MIN_TRUST_RADIUS, _INITIAL_TRUST_RADIUS, _MAX_TRUST_RADIUS = 1e-3, 0.05, 0.4  # for every unknown [rad or m]
_MIN_STEP = 1e-9  # step of the linearised problem that counts as zero [rad or m]
_MAX_INNER_ITERATIONS = 100  # iterations of the inner search
_LIMIT_SLACK = 1e-3  # margin of the linear limits, as a fraction of the limits
_MIN_GAIN = 1e-2  # gain of the criterion below which the search ends [nat]
_MAX_LIMIT_CORRECTIONS = 2  # largest number of corrections of the linear limits after a step violates the true limits


@dataclass(frozen=True)
class MotionSearchResult:
    """The coefficients w (K, nc) that a search for an informative motion found, and its criterion before and after."""

    w: Array
    initial_criterion: float  # [nat], as the other criteria
    final_criterion: float
    is_converged: bool
    n_iterations: int
    configured_criterion: float  # at w in the configured problem; minus infinity if its rollout fails


class InformativeMotionSearch:
    """A search for the motion, within limits, that maximises an optimality criterion of a planned experiment."""

    def __init__(
        self,
        experiment: SplineMotionExperiment,
        limits: PlanResidualAndLimitFunctions,
        criterion: MotionSearchCriterion,
    ) -> None:
        self.experiment, self.limits, self.criterion = experiment, limits, criterion
        self.lower, self.upper = (bound.ravel() for bound in experiment.simulator.coefficient_bounds())
        self._unit, self._low, self._high = _limit_units_and_scaled_bounds(limits.limit_rows)

    def _limited_values(self, w: Array) -> tuple[Array, bool]:
        """Limited quantities of a motion over their limits, and whether its rollout succeeds and satisfies them."""
        value = self.limits.constraints_and_jacobian(self.experiment.simulator.simulate_path(w), w)[0] / self._unit
        flat = w.ravel()
        within = np.all((value <= self._high) & (value >= self._low))  # False for values that are not finite
        return value, bool(within and np.all((flat <= self.upper) & (flat >= self.lower)))

    def shrink_coefficients_to_limits(self, w: Array) -> Array:
        """Scale spline coefficients (K, nc) down until the motion satisfies its limits. Zero if it never does."""
        for _ in range(60):
            if self._limited_values(w)[1]:
                return w
            w = 0.8 * w
        return np.zeros_like(w)

    def _value_and_rows(self, w: Array) -> tuple[float, Array | None]:
        """Criterion and sensitivities of a motion; the criterion is minus infinity if the rollout fails."""
        rows = self.experiment.sensitivities_to_unknowns(w)
        return -np.inf if rows is None else self.criterion.value_and_gradient_wrt_sensitivities(rows)[0], rows

    def improve_motion(self, start: Array, rounds: int, progress: Progress) -> MotionSearchResult:
        """Maximise the criterion in at most `rounds` rounds from coefficients `start` (K, nc) within the limits."""
        w, radius = start, _INITIAL_TRUST_RADIUS
        value, rows = self._value_and_rows(w)
        first, finished, done = value, False, 0
        while rows is not None and done < rounds and not finished:
            done += 1
            slopes = self.experiment.sensitivity_derivatives_by_coefficients(w, rows)
            limited, by_w = self.limits.constraints_and_jacobian(self.experiment.simulator.simulate_path(w, True), w)
            if slopes is None or by_w is None:
                break
            bounded = limited / self._unit, by_w / self._unit[:, None]
            gained, small, still = 0.0, False, False
            while not small:
                step = self._step(rows, slopes, w, bounded, radius)
                still = not np.any(np.abs(step) > _MIN_STEP)
                if still:
                    break
                there, its = self._value_and_rows(w + step)
                small = radius <= _MIN_TRUST_RADIUS
                if its is not None and there > value:
                    gained, w, value, rows = there - value, w + step, there, its
                    radius = min(2.0 * radius, _MAX_TRUST_RADIUS) if np.abs(step).max() > 0.9 * radius else radius
                    break
                radius = max(0.3 * radius, 0.5 * _MIN_TRUST_RADIUS)
            progress.report_parts_done(done, rounds, f"information raised from {first:.3g} to {value:.3g} nat")
            # if no step has any gain, the criterion is not smooth enough to be improved, as for a snapping object
            finished = gained < _MIN_GAIN and (done > 1 or gained > 0.0 or still)
            if gained == 0.0:
                break
        return MotionSearchResult(w, first, value, finished, done, self._configured_criterion(w))

    def _configured_criterion(self, w: Array) -> float:
        try:
            rows = self.experiment.planned_recording_sensitivities(w)
        except SolverError:
            return -np.inf
        return self.criterion.value_and_gradient_wrt_sensitivities(rows)[0]

    def _step(self, rows: Array, slopes: Array, w: Array, bounded: tuple[Array, Array], radius: float) -> Array:
        """The best step of the linearised problem within a trust region, shortened until the true limits hold."""
        value, slope = bounded
        reach, shift = np.abs(slope).sum(1) * radius, np.zeros_like(value)
        for _ in range(1 + _MAX_LIMIT_CORRECTIONS):
            high, low = self._high - _LIMIT_SLACK - value - shift, value + shift - self._low - _LIMIT_SLACK
            near_high, near_low = np.flatnonzero(reach > high), np.flatnonzero(reach > low)
            room = np.maximum(np.concatenate([high[near_high], low[near_low]]), 0.0)
            step = self._inner(rows, slopes, w, np.vstack([-slope[near_high], slope[near_low]]), room, radius)
            there = w + step.reshape(w.shape)
            true, is_within = self._limited_values(there)
            if is_within:
                return there - w
            if not np.all(np.isfinite(true)):
                break
            shift = true - value - slope @ step
        for share in (0.9, 0.7, 0.4, 0.2, 0.1):
            part = share * step.reshape(w.shape)
            if self._limited_values(w + part)[1]:
                return part
        return np.zeros_like(w)

    def _inner(self, rows: Array, slopes: Array, w: Array, normal: Array, room: Array, radius: float) -> Array:
        """Maximise the criterion of linear sensitivities over steps with normal @ step + room >= 0."""
        # in fractions of the radius, so that the first inner step is neither tiny nor large
        flat, normal = radius * slopes.reshape(len(slopes), -1), radius * normal

        def cost(x: Array) -> tuple[float, Array]:
            found, by_rows = self.criterion.value_and_gradient_wrt_sensitivities(rows + (x @ flat).reshape(rows.shape))
            return -found, -(flat @ by_rows.ravel())

        low = np.maximum(-1.0, np.minimum(self.lower - w.ravel(), 0.0) / radius)
        high = np.minimum(1.0, np.maximum(self.upper - w.ravel(), 0.0) / radius)
        constraints = [{"type": "ineq", "fun": lambda x: normal @ x + room, "jac": lambda x: normal}]
        limits = {"bounds": list(zip(low, high, strict=True)), "constraints": constraints if len(room) else ()}
        stop = {"maxiter": _MAX_INNER_ITERATIONS, "ftol": 1e-4}
        found = minimize(cost, np.zeros(w.size), jac=True, method="SLSQP", options=stop, **limits)
        step = radius * np.clip(found.x, low, high)
        return step if np.all(np.isfinite(step)) else np.zeros_like(step)

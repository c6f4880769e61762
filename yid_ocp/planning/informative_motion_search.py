"""Search for the most informative motion within limits, and the optimality criteria that it maximises.

In every round sensitivities J(w) and limits are linearised and the criterion of the linear J is maximised within a
trust region. All iterates keep the limits. Every parameter has a prior standard deviation of `MAX_WEAK_RELATIVE_STD` of
its value, so that a criterion stays finite where no measurement informs one.

References
----------
Burke and Ferris (1995), Math. Programming 71:179, doi:10.1007/BF01585997 (composite functions).
Kraft (1988), DFVLR-FB 88-28 (the inner problem's SLSQP).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from scipy.optimize import minimize

from yid_ocp.arrays import Array
from yid_ocp.inference.uncertainty import MAX_WEAK_RELATIVE_STD
from yid_ocp.planning.plan_shooting import PlanResidualsAndLimits, limit_units_and_scaled_bounds
from yid_ocp.planning.planned_experiment import PlannedExperiment
from yid_ocp.progress import NULL_PROGRESS, Progress


def _prior(columns: int, bounded: Sequence[int]) -> Array:
    """Information beforehand: of parameters `MAX_WEAK_RELATIVE_STD`, of all else next to none (it is in the rows)."""
    prior = np.full(columns, 1e-6)
    prior[list(bounded)] = MAX_WEAK_RELATIVE_STD**-2
    return prior


@dataclass(frozen=True)
class DOptimalityCriterion:
    """Minus half the log determinant of the covariance of chosen parameters, all others and nuisances eliminated.

    With all parameters chosen that is D-optimality, with some of them D_s-optimality, with one its standard deviation.

    References
    ----------
    Atkinson, Donev and Tobias (2007), Optimum Experimental Designs, with SAS, sections 10.2 and 10.3.
    """

    chosen_columns: tuple[int, ...]
    parameter_columns: tuple[int, ...]

    def value_and_gradient_by_sensitivities(self, rows: Array, slope: bool = True) -> tuple[float, Array]:
        """Criterion [nat] at sensitivities (nr, columns) to relative changes, and its gradient by them if asked for."""
        information, chosen = rows.T @ rows, list(self.chosen_columns)
        information[np.diag_indices_from(information)] += _prior(len(information), self.parameter_columns)
        whole = np.asarray(scipy.linalg.inv(information))
        own = whole[np.ix_(chosen, chosen)]
        found = -0.5 * float(np.linalg.slogdet(own)[1])
        if not slope:
            return found, np.zeros((0, 0))
        # d C = -C d(J'J) C
        wide = whole[:, chosen]
        return found, rows @ (wide @ np.linalg.solve(own, wide.T))


@dataclass(frozen=True)
class EffectDiscriminationCriterion:
    """Criterion of how far each effect's change of the readings is from what another and the unknowns can imitate.

    d_ij^2 = min_b |J_i a - J_j b|^2, over what j and the nuisances can do; the smaller distances count most:
    -1/2 log sum_ij 1 / (1 + d_ij^2).
    """

    amplitude_columns: tuple[tuple[int, ...], ...]  # of every effect
    # of the amplitudes, in units of the columns, (amplitudes, cases): one case where they are known, else one for each
    amplitude_cases: tuple[Array, ...]
    parameter_columns: tuple[int, ...]  # with a prior: of the nominal parameters and of the effects

    def pairwise_effect_distances(self, rows: Array) -> Array:
        """Distances of effect i's (row) changes from what effect j can imitate [data stds]; diagonal infinite."""
        found = np.full((len(self.amplitude_columns),) * 2, np.inf)
        for i, j in itertools.permutations(range(len(found)), 2):
            found[i, j] = np.sqrt(self._apart(rows, i, j)[0])
        return found

    def value_and_gradient_by_sensitivities(self, rows: Array, slope: bool = True) -> tuple[float, Array]:
        """As `DOptimalityCriterion.value_and_gradient_by_sensitivities`."""
        total, by_rows = 0.0, np.zeros_like(rows)
        for i, j in itertools.permutations(range(len(self.amplitude_columns)), 2):
            square, rest, others, used = self._apart(rows, i, j)
            weight = 1.0 / (1.0 + square)
            total += weight
            if slope:
                factor = 2.0 * weight**2 / len(self.amplitude_cases[i].T)
                by_rows[:, list(self.amplitude_columns[i])] += factor * rest @ self.amplitude_cases[i].T
                by_rows[:, others] -= factor * rest @ used.T
        return -0.5 * float(np.log(total)), 0.5 * by_rows / total if slope else np.zeros((0, 0))

    def _apart(self, rows: Array, i: int, j: int) -> tuple[float, Array, list[int], Array]:
        """Squared distance, what is left of the change by i, the columns of what may explain it, and how they do."""
        away = {column for k, effect in enumerate(self.amplitude_columns) if k != j for column in effect}
        others = [column for column in range(rows.shape[1]) if column not in away]
        change, basis = rows[:, list(self.amplitude_columns[i])] @ self.amplitude_cases[i], rows[:, others]
        prior = _prior(rows.shape[1], self.parameter_columns)[others]
        used = scipy.linalg.solve(basis.T @ basis + np.diag(prior), basis.T @ change, assume_a="pos")
        rest = change - basis @ used
        square = float(np.sum(rest**2) + np.sum(prior[:, None] * used**2)) / change.shape[1]
        return square, rest, others, used


OptimalityCriterion = DOptimalityCriterion | EffectDiscriminationCriterion

_INITIAL_TRUST_RADIUS, _MAX_TRUST_RADIUS = 0.05, 0.4  # of the trust region, for every unknown of the motion [rad or m]
_MIN_TRUST_RADIUS = 1e-3
_MIN_STEP = 1e-9  # step in the linear picture that counts as none [rad or m]
_MAX_INNER_ITERATIONS = 100  # iterations of the inner search
_LIMIT_SLACK = 1e-3  # by which the linear limits are tighter, in parts of the limits
_MIN_GAIN = 1e-2  # of the criterion [nat]: less in a round is the end
_MAX_LIMIT_CORRECTIONS = 2  # of the linear limits where a step passes the true ones


@dataclass(frozen=True)
class MotionSearchResult:
    """Result of a motion search: final spline coefficients w (K, nc), initial and final criterion [nat]."""

    w: Array
    initial_criterion: float
    final_criterion: float
    is_converged: bool
    n_iterations: int
    configured_criterion: float = -np.inf  # in the configured problem; minus infinity where that cannot be simulated


class InformativeMotionSearch:
    """Search for the motion of an experiment that maximises a criterion within limits."""

    def __init__(
        self, experiment: PlannedExperiment, limits: PlanResidualsAndLimits, criterion: OptimalityCriterion
    ) -> None:
        self.experiment, self.limits, self.criterion = experiment, limits, criterion
        self.lower, self.upper = (bound.ravel() for bound in experiment.simulator.coefficient_bounds())
        self._unit, self._low, self._high = limit_units_and_scaled_bounds(limits.limit_rows)

    def _limited_values(self, w: Array) -> tuple[Array, bool]:
        """Limited quantities of a motion in parts of their limits, and whether it can be simulated and keeps these."""
        value = self.limits.limited_quantity_values(self.experiment.simulator.simulate_path(w), w).value / self._unit
        flat = w.ravel()
        within = np.all((value <= self._high) & (value >= self._low))  # not where a value is not finite
        return value, bool(within and np.all((flat <= self.upper) & (flat >= self.lower)))

    def shrink_to_limits(self, w: Array) -> Array:
        """Spline coefficients (K, nc) of the motion, scaled down until it keeps the limits."""
        for _ in range(60):
            if self._limited_values(w)[1]:
                return w
            w = 0.8 * w
        return np.zeros_like(w)

    def _value_and_rows(self, w: Array) -> tuple[float, Array | None]:
        """Criterion and sensitivities of a motion; minus infinity where it cannot be simulated."""
        rows = self.experiment.search_problem_sensitivities(w)
        return -np.inf if rows is None else self.criterion.value_and_gradient_by_sensitivities(rows, False)[0], rows

    def improve_motion(self, start: Array, rounds: int, progress: Progress = NULL_PROGRESS) -> MotionSearchResult:
        """Maximise the criterion from spline coefficients (K, nc) that keep the limits, until convergence."""
        w, radius = start, _INITIAL_TRUST_RADIUS
        value, rows = self._value_and_rows(w)
        first, finished, done = value, False, 0
        while rows is not None and done < rounds and not finished:
            done += 1
            slopes = self.experiment.sensitivity_derivatives_by_coefficients(w, rows)
            rolled = self.experiment.simulator.simulate_path(w, True)
            limits = self.limits.limited_quantity_values(rolled, w)
            if slopes is None or limits.jacobian is None:
                break
            bounded = limits.value / self._unit, limits.jacobian / self._unit[:, None]
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
            progress.report_parts_done(done, rounds, f"{value - first:.3g} nat beyond the start")
            # a motion from which no step gains anything at all is too rough to be improved, as where the object snaps
            finished = gained < _MIN_GAIN and (done > 1 or gained > 0.0 or still)
            if gained == 0.0:
                break
        return MotionSearchResult(w, first, value, finished, done)

    def _step(self, rows: Array, slopes: Array, w: Array, bounded: tuple[Array, Array], radius: float) -> Array:
        """The best step in the linear picture within a trust region, made such that the true limits are kept."""
        value, slope = bounded
        reach = np.abs(slope).sum(1) * radius
        shift = np.zeros_like(value)
        for _ in range(1 + _MAX_LIMIT_CORRECTIONS):
            high, low = self._high - _LIMIT_SLACK - value - shift, value + shift - self._low - _LIMIT_SLACK
            near_high, near_low = np.flatnonzero(reach > high), np.flatnonzero(reach > low)
            normal = np.vstack([-slope[near_high], slope[near_low]])
            room = np.maximum(np.concatenate([high[near_high], low[near_low]]), 0.0)
            step = self._inner(rows, slopes, w, normal, room, radius)
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
        # in parts of the radius, so that the first step of the inner search is neither tiny nor far
        flat, normal = radius * slopes.reshape(len(slopes), -1), radius * normal

        def cost(x: Array) -> tuple[float, Array]:
            found, by_rows = self.criterion.value_and_gradient_by_sensitivities(rows + (x @ flat).reshape(rows.shape))
            return -found, -(flat @ by_rows.ravel())

        low = np.maximum(-1.0, np.minimum(self.lower - w.ravel(), 0.0) / radius)
        high = np.minimum(1.0, np.maximum(self.upper - w.ravel(), 0.0) / radius)
        constraints = [{"type": "ineq", "fun": lambda x: normal @ x + room, "jac": lambda x: normal}]
        found = minimize(
            cost, np.zeros(w.size), jac=True, method="SLSQP", bounds=list(zip(low, high, strict=True)),
            constraints=constraints if len(room) else (), options={"maxiter": _MAX_INNER_ITERATIONS, "ftol": 1e-4},
        )  # fmt: skip
        step = radius * np.clip(found.x, low, high)
        return step if np.all(np.isfinite(step)) else np.zeros_like(step)

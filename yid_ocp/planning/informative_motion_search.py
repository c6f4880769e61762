"""Search for the most informative motion by sequential linearisation of the sensitivities, within limits.

Sensitivities J(w) of a motion w are nearly linear in it, since springs and small motions are; the criterion of J is
not. In every round J and the limits are linearised and the criterion of the linear J is maximised within a trust
region. All iterates keep the limits.

References
----------
Burke and Ferris (1995), Math. Programming 71:179, doi:10.1007/BF01585997 (composite functions).
Kraft (1988), DFVLR-FB 88-28 (the inner problem's SLSQP).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from yid_ocp.planning.optimality_criteria import OptimalityCriterion
from yid_ocp.planning.plan_constraints import PlanResidualsAndLimits
from yid_ocp.planning.planned_experiment import PlannedExperiment
from yid_ocp.progress import NULL_PROGRESS, Progress

log = logging.getLogger(__name__)
Array = NDArray[np.float64]

_INITIAL_TRUST_RADIUS, _MAX_TRUST_RADIUS = 0.05, 0.4  # of the trust region, for every unknown of the motion [rad or m]
_MIN_TRUST_RADIUS = 1e-3
_MIN_STEP = 1e-9  # step in the linear picture that counts as none [rad or m]
_MAX_INNER_ITERATIONS = 100  # iterations of the inner search
_LIMIT_SLACK = 1e-3  # by which the linear limits are tighter, in parts of the limits
_MIN_GAIN = 1e-2  # of the criterion [nat]: less in a round is the end
_MAX_LIMIT_CORRECTIONS = 2  # of the linear limits where a step passes the true ones


@dataclass(frozen=True)
class MotionSearchResult:
    """Result of the search for an informative motion from one initial motion.

    Attributes
    ----------
    w : ndarray, shape (K, nc)
    initial_criterion, final_criterion : float
        Criterion at the start and in the end [nat].
    is_converged : bool
        Whether no further iteration improves the criterion.
    n_iterations : int
    """

    w: Array
    initial_criterion: float
    final_criterion: float
    is_converged: bool
    n_iterations: int


class InformativeMotionSearch:
    """Search for the motion of an experiment that maximises a criterion within limits.

    Parameters
    ----------
    experiment : Experiment
    limits : Rows
        Its bounded rows are the limits.
    criterion : Criterion
    lower, upper : ndarray, shape (nc,)
        Of every joint's unknowns, which bound the joint.
    """

    def __init__(
        self,
        experiment: PlannedExperiment,
        limits: PlanResidualsAndLimits,
        criterion: OptimalityCriterion,
        lower: Array,
        upper: Array,
    ) -> None:
        self.experiment, self.limits, self.criterion = experiment, limits, criterion
        shape = (experiment.simulator.path.n_coefficients, 1)
        self.lower, self.upper = np.tile(lower, shape).ravel(), np.tile(upper, shape).ravel()
        parts = [np.concatenate([getattr(b, k) for b in limits.limit_rows]) for k in ("unit", "lower", "upper")]
        self._unit, self._low, self._high = parts[0], parts[1] / parts[0], parts[2] / parts[0]

    def max_limit_violation(self, w: Array) -> float:
        """Largest limit violation of a motion, relative to the limits; infinite where it cannot be simulated."""
        value = self.limits.limit_values(self.experiment.simulator.simulate_path(w), w).value / self._unit
        if not np.all(np.isfinite(value)):
            return np.inf
        flat = w.ravel()
        joints = max(float(np.max(flat - self.upper)), float(np.max(self.lower - flat)))
        return max(float(np.max(value - self._high)), float(np.max(self._low - value)), joints)

    def shrink_to_limits(self, w: Array) -> Array:
        """The motion, scaled down until it keeps the limits."""
        for _ in range(60):
            if self.max_limit_violation(w) <= 0.0:
                return w
            w = 0.8 * w
        return np.zeros_like(w)

    def criterion_and_sensitivities(self, w: Array) -> tuple[float, Array | None]:
        """Criterion and sensitivities of a motion; minus infinity where it cannot be simulated."""
        rows = self.experiment.search_sensitivities(w)
        return (-np.inf, None) if rows is None else (self.criterion.value_and_gradient(rows, False)[0], rows)

    def improve_motion(self, start: Array, rounds: int, progress: Progress = NULL_PROGRESS) -> MotionSearchResult:
        """Improve a motion that keeps the limits until convergence."""
        w, radius = start, _INITIAL_TRUST_RADIUS
        value, rows = self.criterion_and_sensitivities(w)
        first, finished, done = value, False, 0
        while rows is not None and done < rounds and not finished:
            done += 1
            slopes = self.experiment.sensitivity_derivatives(w, rows)
            rolled = self.experiment.simulator.simulate_path(w, True)
            limits = self.limits.limit_values(rolled, w)
            if slopes is None or limits.jacobian is None:
                break
            bounded = limits.value / self._unit, limits.jacobian / self._unit[:, None]
            gained, small, still = 0.0, False, False
            while not small:
                step = self._step(rows, slopes, w, bounded, radius)
                still = not np.any(np.abs(step) > _MIN_STEP)
                if still:
                    break
                there, its = self.criterion_and_sensitivities(w + step)
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
            if self.max_limit_violation(there) <= 0.0:
                return there - w
            true = self.limits.limit_values(self.experiment.simulator.simulate_path(there), there).value / self._unit
            if not np.all(np.isfinite(true)):
                break
            shift = true - value - slope @ step
        for share in (0.9, 0.7, 0.4, 0.2, 0.1):
            part = share * step.reshape(w.shape)
            if self.max_limit_violation(w + part) <= 0.0:
                return part
        return np.zeros_like(w)

    def _inner(self, rows: Array, slopes: Array, w: Array, normal: Array, room: Array, radius: float) -> Array:
        """Maximise the criterion of linear sensitivities over steps with normal @ step + room >= 0."""
        # in parts of the radius, so that the first step of the inner search is neither tiny nor far
        flat, normal = radius * slopes.reshape(len(slopes), -1), radius * normal

        def cost(x: Array) -> tuple[float, Array]:
            found, by_rows = self.criterion.value_and_gradient(rows + (x @ flat).reshape(rows.shape))
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

"""Profile likelihood of one unknown: the others refitted at fixed values of it, and the resulting interval."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from yid_ocp.inference.linearized_residual import bounded_least_squares_step, residual_without_weak_priors
from yid_ocp.inference.uncertainty import (
    ConfidenceInterval,
    ParameterEstimate,
    covariance_and_chi2,
    is_std_sufficient,
    parameter_unknown_names,
    typical_parameter_sizes,
    with_profile_interval,
)
from yid_ocp.parallel import map_with_batched_calls
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.progress import NULL_PROGRESS, ParallelProgress, Progress
from yid_ocp.solvers import Solution
from yid_ocp.solvers.gauss_newton import GaussNewton

log = logging.getLogger(__name__)
Array = NDArray[np.float64]

# quantiles 0.95 and 0.999 of chi2 with one degree of freedom
CHI2_QUANTILE_95, _CHI2_QUANTILE_999 = 3.841458820694124, 10.827566170662733
_SMALL_VALUE_FRACTION = 0.3  # a value below this part of its typical size is small
_MAX_LOG_DISTANCE = math.log(1e3)  # up to which a positive unknown is followed before its interval counts as open
_LOG_PRIOR_STD = math.log(1e3)  # standard deviation that keeps other positive unknowns in place that nothing informs
_REFIT_CHI2_ATOL = 1e-3  # chi2 that a refit may leave on the table
_ROOT_RTOL = 0.01  # of the root of delta chi2 against its level's
_MAX_REFIT_ITERATIONS, _MAX_PROFILE_POINTS = 30, 12
_MAX_AUTOMATIC_INTERVALS, _MAX_UNKNOWNS = 12, 300  # beyond, profiles take long and are worked out only where asked for
_OPTIMUM_ITERATIONS = 20  # iterations that bring all unknowns, nuisances among them, to their best fit
_CLIFF_HEIGHT_RATIO = 10.0  # height that is no parabola's, of the level's
_CLIFF_WIDTH_RTOL = 1e-3  # distance of a cliff's two sides, of that from the fit
_MAX_STEP_GROWTH, _STEP_OVERSHOOT = 3.0, 1.3


@dataclass(frozen=True)
class ParameterProfile:
    """Profile likelihood of one unknown, whose best fit is at `value`.

    Attributes
    ----------
    lower, upper : float or None
        Ends of the 95 % interval; None where it is open.
    values, delta_chi2 : ndarray, shape (k,)
        Points at which the others were refitted, in order, and chi2 above the best, over max(1, chi2 per degree of
        freedom).
    notes : tuple of str
        Why an end is open where that is not for lack of information, or that a better fit was met on the way.
    """

    name: str
    value: float
    lower: float | None
    upper: float | None
    values: Array
    delta_chi2: Array
    notes: tuple[str, ...] = ()

    @property
    def interval(self) -> ConfidenceInterval:
        """Lower and upper end of the 95 % interval; None for an open end."""
        return self.lower, self.upper


def profile_likelihood(
    problem: EstimationProblem,
    x: Array,
    index: int,
    std: float,
    evaluation: Evaluation | None = None,
    level: float = CHI2_QUANTILE_95,
) -> ParameterProfile:
    """Profile-likelihood interval of one unknown: min over all others of chi2(x) - chi2(best) = level.

    Each value is reached from the last one, the others first moved along the tangent and then by Gauss-Newton.
    Unknowns that are positive by nature move in their logarithm. The weak prior does not count. An end is open where
    the level is not reached before the unknown's bound, or before it has changed by a factor of 1000.

    Parameters
    ----------
    x : ndarray, shape (nx,)
        The best fit.
    index : int
        Which unknown.
    std : float
        Its standard deviation, for the first guess; may be infinite.
    evaluation : Evaluation, optional
        At `x`, with the Jacobian.
    level : float
        3.84 for 95 %.

    References
    ----------
    Venzon and Moolgavkar (1988), Applied Statistics 37:87, doi:10.2307/2347496.
    """
    best = problem.evaluate(x) if evaluation is None else evaluation
    walk = _Walk(problem, x, index, best, level)
    size = std / abs(x[index]) if walk.logarithmic else std
    size = min(size, 0.5) if walk.logarithmic else min(size, 10 * float(problem.unknown_scales[index]))
    lower = walk.end(-1, size)
    upper = walk.end(1, size)
    order = np.argsort([point.value for point in walk.points])
    values = np.array([walk.points[i].value for i in order])
    deltas = np.array([walk.points[i].chi2 for i in order]) - walk.base
    notes = walk.notes
    if walk.base < -0.1 * level:
        notes = [*notes, f"a fit better by {-walk.base:.2g} in chi2 was met; the point was not the best one"]
    return ParameterProfile(problem.unknown_names[index], float(x[index]), lower, upper, values, deltas, tuple(notes))


def with_profile_intervals(
    problem: EstimationProblem, solution: Solution, progress: Progress = NULL_PROGRESS
) -> Solution:
    """The solution with profile-likelihood intervals, and the verdicts they allow, for weakly determined parameters.

    There the cost is not a parabola; nor is it for stiffnesses that are small compared with their typical size
    (`check_small_estimate`). The solution is unchanged where the problem is too large, as profiles then take long.
    """
    usable = solution.evaluation is not None and problem.options.weighting != "paper"
    if not usable or not is_small_problem(problem):
        return solution
    sizes = typical_parameter_sizes(problem, solution.x)
    asked = {}
    for name, entry in solution.parameters.items():
        if entry.verdict in ("identifiable", "weak"):
            size = sizes[name.split("[")[0]]
            if not is_std_sufficient(entry) or entry.value < _SMALL_VALUE_FRACTION * size:
                asked[name] = size
    if not asked:
        return solution
    progress.begin_stage(f"intervals of {', '.join(asked)} by profile likelihood")
    best, there = nearby_optimum(problem, solution.x)
    parts = ParallelProgress(progress, len(asked), next(iter(asked)))

    def judged(name: str) -> ParameterEstimate:
        index, size = problem.unknown_names.index(name), asked[name]
        entry = check_small_estimate(problem, best, index, solution.parameters[name], size, there)
        if entry.verdict != "not_identifiable" and not is_std_sufficient(entry):
            profile = profile_likelihood(problem, best, index, entry.std, there)
            entry = with_profile_interval(entry, profile.interval, size)
        parts.count_done(name)
        return entry

    found = dict(zip(asked, map_with_batched_calls(judged, asked), strict=True))
    return replace(solution, parameters={**solution.parameters, **found})


def check_small_estimate(
    problem: EstimationProblem, x: Array, index: int, entry: ParameterEstimate, size: float, evaluation: Evaluation
) -> ParameterEstimate:
    """The estimate, or `not_identifiable` where it is small and the data do not rule out its typical size at 99.9 %.

    A branch's twist that no sensor sees swings only where its stiffness is near zero. There it follows the noise: the
    cost has a narrow minimum, below what it is for all large values by what one more parameter takes from the noise.

    Parameters
    ----------
    x : ndarray, shape (nx,)
        The best fit.
    index : int
        Which unknown.
    size : float
        Its typical size, as in `inference.uncertainty.typical_parameter_sizes`.
    evaluation : Evaluation
        At `x`, with the Jacobian.
    """
    if entry.verdict not in ("identifiable", "weak") or not 0 <= entry.value < _SMALL_VALUE_FRACTION * size:
        return entry
    walk = _Walk(problem, x, index, evaluation, _CHI2_QUANTILE_999)
    rise = walk.rise(size)
    log.info("%s = %.3g: chi2 rises by %.3g up to %.3g", problem.unknown_names[index], entry.value, rise, size)
    if rise > _CHI2_QUANTILE_999:
        return entry
    return replace(entry, verdict="not_identifiable", std=math.inf, interval=None)


def is_small_problem(problem: EstimationProblem) -> bool:
    """Whether a problem is small enough for its profile intervals to be computed by default."""
    few = len(parameter_unknown_names(problem)) <= _MAX_AUTOMATIC_INTERVALS
    return few and len(problem.unknown_names) <= _MAX_UNKNOWNS


def nearby_optimum(problem: EstimationProblem, x: Array) -> tuple[Array, Evaluation]:
    """Unknowns of the problem's optimum near a point, and the evaluation there with its Jacobian."""
    outcome = GaussNewton(max_iterations=_OPTIMUM_ITERATIONS).minimize_cost(problem, x, None)
    return outcome.x, problem.evaluate(outcome.x)


@dataclass(frozen=True)
class _Point:
    """A refit at one value: unknowns, chi2 above the first one, residual rows and their Jacobian."""

    value: float
    x: Array
    chi2: float
    rows: Array
    jacobian: Array


class _Walk:
    """Follows the profile to both sides."""

    def __init__(self, problem: EstimationProblem, x: Array, index: int, best: Evaluation, level: float) -> None:
        self.problem, self.index, self.level = problem, index, level
        lower, upper = problem.bounds
        self.positive = problem.is_positive & (x > 0)
        self.logarithmic = bool(self.positive[index])
        # infinite bounds and bounds at zero become infinite ones of the coordinates
        with np.errstate(divide="ignore", invalid="ignore"):
            self.lower = np.where(self.positive, np.log(np.maximum(lower, 0.0)), lower)
            self.upper = np.where(self.positive, np.log(np.maximum(upper, 0.0)), upper)
        self.others = np.array([i for i in range(len(x)) if i != index], int)
        self.anchored = np.array([i for i in self.others if self.positive[i]], int)
        self.centre = self.coordinates(x)
        self.noise = problem.data_noise_unit
        self.scale = max(1.0, covariance_and_chi2(problem, best)[1])
        self.first = self._chi2(best)
        self.base = 0.0
        self.notes: list[str] = []
        rows, jacobian = self._rows(best, self.centre)
        self.points = [_Point(float(x[index]), self.centre, 0.0, rows, jacobian)]

    def coordinates(self, x: Array) -> Array:
        """Logarithms of positive unknowns, the others as they are."""
        return np.where(self.positive, np.log(np.where(self.positive, x, 1.0)), x)

    def unknowns(self, s: Array) -> Array:
        """The inverse of `coordinates`."""
        return np.where(self.positive, np.exp(np.where(self.positive, s, 0.0)), s)

    def end(self, sign: int, size: float) -> float | None:
        """Where the profile crosses the level on one side; None where it does not."""
        start = self.points[0]
        limit = self._limit(sign)
        target = math.sqrt(self.level)
        inside, s = start, self.centre[self.index]
        outside: _Point | None = None
        barrier: float | None = None
        step = target * size
        for _ in range(_MAX_PROFILE_POINTS):
            reach = limit if barrier is None else barrier
            trial = s + sign * step
            trial = min(trial, reach) if sign > 0 else max(trial, reach)
            if abs(trial - s) < 1e-9 * max(1.0, abs(s)):
                if barrier is None:
                    return None  # it stands at its bound
                break
            point = self._refit(inside, trial)
            if point is None:
                barrier, step = trial, 0.5 * abs(trial - s)
                if step < 1e-3 * max(abs(trial - self.centre[self.index]), 1e-12):
                    break
                continue
            self.points.append(point)
            self.base = min(self.base, point.chi2)
            height = self._height(point)
            if abs(height - target) < _ROOT_RTOL * target:
                return point.value
            if height > target:
                outside = point
                break
            inside, s = point, trial
            if trial == limit:
                return None
            # the root of a parabola is a line, whose slope from the start tells how far the level still is
            gone = abs(trial - self.centre[self.index])
            ahead = gone * (target / height - 1.0) * _STEP_OVERSHOOT if height > 0.05 * target else math.inf
            step = min(max(ahead, 0.2 * gone), _MAX_STEP_GROWTH * gone) if barrier is None else 0.5 * abs(barrier - s)
        if outside is None:
            if barrier is None:
                self.notes.append(f"no end was met {'above' if sign > 0 else 'below'} in {_MAX_PROFILE_POINTS} refits")
            else:
                value = self.unknowns(np.full(len(self.centre), barrier))[self.index]
                self.notes.append(f"the model cannot be rolled out {'above' if sign > 0 else 'below'} {value:.4g}")
            return None
        return self._root(inside, outside, target)

    def rise(self, value: float) -> float:
        """Chi2 at a value, the others refitted, above the first one; NaN where no rollout succeeds."""
        whole = self.unknowns(self.centre)
        whole[self.index] = value
        point = self._refit(self.points[0], float(self.coordinates(whole)[self.index]))
        return math.nan if point is None else point.chi2

    def _limit(self, sign: int) -> float:
        bound = float((self.upper if sign > 0 else self.lower)[self.index])
        if not self.logarithmic:
            reach = self.centre[self.index] + sign * 1e3 * float(self.problem.unknown_scales[self.index])
        else:
            reach = self.centre[self.index] + sign * _MAX_LOG_DISTANCE
        return min(bound, reach) if sign > 0 else max(bound, reach)

    def _height(self, point: _Point) -> float:
        return math.sqrt(max(point.chi2 - self.base, 0.0))

    def _root(self, inside: _Point, outside: _Point, target: float) -> float:
        """Regula falsi (Illinois) on the root of delta chi2, which is nearly a line; bisection where it is a cliff."""
        a, b = inside, outside
        heights = [self._height(a) - target, self._height(b) - target]
        share = 1.0  # of the older side's height that counts, halved each time that side is kept
        for attempt in range(2 * _MAX_PROFILE_POINTS + 1):
            at = [float(point.x[self.index]) for point in (a, b)]
            older = share * heights[0]
            cliff = max(heights) > _CLIFF_HEIGHT_RATIO * target
            s = 0.5 * (at[0] + at[1]) if cliff else at[1] - heights[1] * (at[1] - at[0]) / (heights[1] - older)
            # a cliff's edge is known well enough when its two sides are near each other
            near = abs(at[1] - at[0]) < _CLIFF_WIDTH_RTOL * abs(at[1] - self.centre[self.index])
            if min(map(abs, heights)) < _ROOT_RTOL * target or near or attempt == 2 * _MAX_PROFILE_POINTS:
                s = at[int(abs(heights[1]) < abs(heights[0]))]
                break
            # beyond the end the others may sit where nothing moves them any more
            point = self._refit(a if heights[0] < heights[1] else b, s)
            if point is None:
                break
            self.points.append(point)
            self.base = min(self.base, point.chi2)
            height = self._height(point) - target
            if height * heights[1] < 0:
                a, heights[0], share = b, heights[1], 1.0
            else:
                share *= 0.5
            b, heights[1] = point, height
        whole = self.centre.copy()
        whole[self.index] = s
        return float(self.unknowns(whole)[self.index])

    def _refit(self, near: _Point, s: float) -> _Point | None:
        """Best fit of the others at coordinate `s` of the profiled one, None where no rollout succeeds."""
        now, others = near.x.copy(), self.others
        tangent = -near.jacobian[:, self.index] * (s - now[self.index])
        if len(others):
            low, high = self.lower[others] - now[others], self.upper[others] - now[others]
            now[others] += bounded_least_squares_step(near.jacobian[:, others], -tangent, 0.0, low, high)
        now[self.index] = s
        found = self._at(now)
        if found is None:
            # the tangent may lead too far; the others where they were
            now = near.x.copy()
            now[self.index] = s
            found = self._at(now)
        damping, rejected = 1e-8, 0
        for _ in range(_MAX_REFIT_ITERATIONS):
            if found is None or not len(others):
                break
            jacobian = found.jacobian[:, others]
            low, high = self.lower[others] - now[others], self.upper[others] - now[others]
            step = bounded_least_squares_step(jacobian, found.rows, damping, low, high)
            largest = float(np.max(np.abs(step[self.positive[others]]), initial=0.0))
            step *= min(1.0, 1.5 / max(largest, 1e-300))
            promised = -2.0 * float(found.rows @ (jacobian @ step)) - float(np.sum((jacobian @ step) ** 2))
            if promised / self.scale < _REFIT_CHI2_ATOL:
                break
            trial = now.copy()
            trial[others] += step
            after = self._at(trial)
            before = float(found.rows @ found.rows)
            if after is not None and float(after.rows @ after.rows) < before:
                now, found, damping, rejected = trial, after, max(damping / 5, 1e-12), 0
            else:
                damping, rejected = max(damping * 10, 1e-6), rejected + 1
                if rejected > 8:
                    break
        return found

    def _at(self, s: Array) -> _Point | None:
        x = self.unknowns(s)
        evaluation = self.problem.evaluate(x)
        if not evaluation.ok or evaluation.jacobian is None:
            return None
        rows, jacobian = self._rows(evaluation, s)
        chi2 = (self._chi2(evaluation) - self.first) / self.scale
        return _Point(float(x[self.index]), s.copy(), chi2, rows, jacobian)

    def _chi2(self, evaluation: Evaluation) -> float:
        """Twice the cost without the weak priors, in units of the noise."""
        rows = self.problem.residual_rows
        stated, weak = (float(np.sum(evaluation.residual[own] ** 2)) for own in (rows.stated_priors, rows.weak_priors))
        return (2.0 * evaluation.cost - weak - stated) / self.noise**2 + stated

    def _rows(self, evaluation: Evaluation, s: Array) -> tuple[Array, Array]:
        """Residual and Jacobian by the coordinates, with the anchors in place of the weak priors."""
        residual, jacobian = residual_without_weak_priors(self.problem, evaluation)
        slope = np.where(self.positive, self.unknowns(s), 1.0)
        anchors = np.zeros((len(self.anchored), len(s)))
        anchors[np.arange(len(self.anchored)), self.anchored] = 1.0 / _LOG_PRIOR_STD
        held = (s - self.centre)[self.anchored] / _LOG_PRIOR_STD
        return np.concatenate([residual, held]), np.vstack([jacobian * slope, anchors])

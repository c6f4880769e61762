"""Profile likelihood and confidence interval of one unknown parameter."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.display import NULL_PROGRESS, PartsDoneCounter, Progress
from yid_ocp.inference import uncertainty
from yid_ocp.inference.linearized_residual import (
    bounded_levenberg_marquardt_step,
    residual_and_jacobian_with_stated_priors,
)
from yid_ocp.parallel import map_with_merged_calls
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.solvers import GaussNewton, Solution

log = logging.getLogger(__name__)
_Judgement = TypeVar("_Judgement")

_CHI2_QUANTILE_999 = 10.827566170662733  # of one degree of freedom
_SMALL_VALUE_FRACTION = 0.3  # a value below this part of its typical size is small
_MAX_LOG_DISTANCE = math.log(1e3)  # range of a positive unknown beyond which its interval is open
_LOG_PRIOR_STD = math.log(1e3)  # prior std of the logarithm that holds other positive unknowns without information
_REFIT_CHI2_ATOL = 1e-3  # a refit ends if a step would lower chi2 by less
_TARGET_HEIGHT = math.sqrt(uncertainty.CHI2_95_TWO_SIDED)  # root of delta chi2 at the ends of an interval
_ROOT_RTOL = 0.01  # relative tolerance on the root of delta chi2
_MAX_REFIT_ITERATIONS, _MAX_REJECTED_STEPS, _MAX_PROFILE_POINTS = 30, 8, 12
_MAX_AUTOMATIC_INTERVALS, _MAX_UNKNOWNS = 12, 300  # larger problems need an explicit request
_OPTIMUM_ITERATIONS = 20  # iterations that bring all unknowns to their best fit
_CLIFF_HEIGHT_RATIO = 10.0  # height over target that indicates a discontinuity
_CLIFF_WIDTH_RTOL = 1e-3  # distance of a discontinuity's two sides over its distance from the fit
_MAX_STEP_GROWTH, _STEP_OVERSHOOT = 3.0, 1.3


@dataclass(frozen=True)
class ParameterProfileLikelihood:
    """Profile likelihood of one unknown: rise of chi2 at fixed values, with the others refitted, and 95 % interval."""

    interval: uncertainty.ConfidenceInterval  # lower and upper end of the 95 % interval; None for an open end
    values: Array  # values at which the other unknowns were refitted, ascending, shape (k,)
    delta_chi2: Array  # (chi2 - best chi2) / max(1, chi2 per dof), shape (k,)
    notes: tuple[str, ...] = ()  # sentences on ends of the interval that were not found
    better_fit: str = ""  # a sentence on a better fit, if one was found


def compute_profile_likelihood_interval(
    problem: EstimationProblem, x: Array, index: int, std: float, evaluation: Evaluation
) -> ParameterProfileLikelihood:
    """Compute the 95 % profile-likelihood interval of one unknown, in which chi2 rises by less than 3.84.

    At each value of the unknown, all other unknowns are refitted by Gauss-Newton, from a prediction along the tangent.
    Chi2 does not include the weak prior. An end of the interval is open if chi2 does not rise by 3.84 before the
    unknown reaches its bound or, if it is positive, 1000 times or 1/1000 of its estimate. Positive unknowns are
    represented by their logarithm (Venzon and Moolgavkar 1988, Applied Statistics 37:87, doi:10.2307/2347496).

    `index` selects the unknown, `x` (nx,) is the best fit, and `evaluation` the evaluation at `x` with Jacobian. `std`,
    the standard deviation of the unknown, sets the first step and may be infinite.
    """
    walk = _Walk(problem, x, index, evaluation)
    size = min(std / abs(x[index]), 0.5) if walk.logarithmic else min(std, 10 * float(problem.unknown_scales[index]))
    interval = walk.end(-1, size), walk.end(1, size)
    points = sorted(walk.points, key=lambda point: point.value)
    deltas = np.array([point.chi2 for point in points]) - walk.base
    values, name = np.array([point.value for point in points]), problem.unknown_names[index]
    better = ""
    far = abs(values[np.argmin(deltas)] - x[index]) > (std if math.isfinite(std) else 0.0)
    if walk.base < -1.0 and far:  # both by one standard deviation; less does not show which value is better
        best, setting = f"{values[np.argmin(deltas)]:.4g}", f"parameters.{name.partition('[')[0]}.initial"
        better = f"a better fit exists at {best} (chi2 lower by {-walk.base:.2g}), so the fit missed the best value. "
        better += f"Repeat `yid-ocp solve` with --set {setting}={best}"
    return ParameterProfileLikelihood(interval, values, deltas, tuple(walk.notes), better)


def solution_with_profile_intervals(
    problem: EstimationProblem, solution: Solution, progress: Progress = NULL_PROGRESS
) -> Solution:
    """Return the solution with profile-likelihood intervals and matching verdicts for weakly determined parameters.

    The cost as a function of such a parameter is not quadratic, so a standard deviation does not describe it. The same
    holds for a stiffness that is small compared with its typical size (`mark_near_zero_estimate_unidentifiable`). If
    the problem is too large, the solution is unchanged. If a refit fits better, `checks.notes` of the result says so.
    """
    usable = solution.evaluation is not None and problem.options.weighting != "paper"
    if not usable or not is_small_enough_for_profiles(problem):
        return solution
    sizes = uncertainty.typical_parameter_magnitudes(problem, solution.x)
    asked, better_fits = {}, dict[str, str]()
    for name, entry in solution.parameters.items():
        size = sizes.get(name.split("[")[0], math.nan)
        small = entry.value < _SMALL_VALUE_FRACTION * size
        if entry.verdict in ("identifiable", "weak") and (small or not uncertainty.needs_no_profile_likelihood(entry)):
            asked[name] = size
    if not asked:
        return solution

    def judged(name: str, best: Array, there: Evaluation) -> uncertainty.ParameterEstimate:
        index, size = problem.unknown_names.index(name), asked[name]
        entry = mark_near_zero_estimate_unidentifiable(problem, best, index, solution.parameters[name], size, there)
        if entry.verdict != "not_identifiable" and not uncertainty.needs_no_profile_likelihood(entry):
            profile = compute_profile_likelihood_interval(problem, best, index, entry.std, there)
            entry = uncertainty.apply_profile_interval(entry, profile.interval, size)
            if profile.better_fit:
                better_fits[name] = f"For {name}, {profile.better_fit}."
        return entry

    # each parameter takes about one and a half times as long as the solution
    progress.begin_stage(f"computing 95 % intervals of {', '.join(asked)}", 7.5 * len(asked), 5.2)
    found = apply_function_per_parameter_at_optimum(judged, problem, solution.x, tuple(asked), progress)
    checks = uncertainty.EstimateChecksBeyondFit(notes=better_fits) if better_fits else solution.checks
    return replace(solution, parameters={**solution.parameters, **found}, checks=checks)


def apply_function_per_parameter_at_optimum(
    judged: Callable[[str, Array, Evaluation], _Judgement],
    problem: EstimationProblem,
    x: Array,
    names: Sequence[str],
    progress: Progress,
) -> dict[str, _Judgement]:
    """Find the optimum from `x` (nx,), and return judged(name, optimum, evaluation) by name, computed in parallel."""
    best = GaussNewton(max_iterations=_OPTIMUM_ITERATIONS).minimize_cost(problem, x, None).x
    there, parts = problem.evaluate(best), PartsDoneCounter(progress, len(names), names[0])

    def one(name: str) -> _Judgement:
        found = judged(name, best, there)
        parts.count_done(name)
        return found

    return dict(zip(names, map_with_merged_calls(one, names, len(problem.episodes)), strict=True))


def mark_near_zero_estimate_unidentifiable(
    problem: EstimationProblem,
    x: Array,
    index: int,
    entry: uncertainty.ParameterEstimate,
    size: float,
    evaluation: Evaluation,
) -> uncertainty.ParameterEstimate:
    """Mark a stiffness estimate near zero as `not_identifiable` if the data also allow a stiffness of typical size.

    Near zero, the cost of a stiffness that no sensor observes can have a narrow, spurious minimum: only a branch with
    almost no stiffness moves enough to fit the noise. `x` (nx,) is the best fit, `evaluation` its evaluation, `index`
    selects the unknown, and `size` is its entry of `typical_parameter_magnitudes`. The test has the level 99.9 %.
    """
    if entry.verdict not in ("identifiable", "weak") or not 0 <= entry.value < _SMALL_VALUE_FRACTION * size:
        return entry
    rise = _Walk(problem, x, index, evaluation).rise(size)
    log.info("%s = %.3g: chi2 rises by %.3g up to %.3g", problem.unknown_names[index], entry.value, rise, size)
    if not rise <= _CHI2_QUANTILE_999:  # also if no rollout succeeds there (nan), as with a payload of 9 kg
        return entry
    return replace(entry, verdict="not_identifiable", std=math.inf, interval=None)


def is_small_enough_for_profiles(problem: EstimationProblem) -> bool:
    """Check whether a problem is small enough for intervals by default: at most 12 parameters and 300 unknowns."""
    few = len(uncertainty.parameter_unknown_names(problem)) <= _MAX_AUTOMATIC_INTERVALS
    return few and len(problem.unknown_names) <= _MAX_UNKNOWNS


class _Point(NamedTuple):
    """A refit at one fixed `value`: coordinates, chi2 minus that of the first point, residual and its Jacobian."""

    value: float
    x: Array
    chi2: float
    rows: Array
    jacobian: Array


class _Walk:
    """Follows the profile of one unknown in both directions. The coordinate of a positive unknown is its logarithm."""

    def __init__(self, problem: EstimationProblem, x: Array, index: int, best: Evaluation) -> None:
        self.problem, self.index = problem, index
        lower, upper = problem.bounds
        self.positive = problem.positive_unknowns_mask & (x > 0)
        self.logarithmic = bool(self.positive[index])
        # infinite bounds and bounds at zero become infinite bounds of the coordinates
        with np.errstate(divide="ignore", invalid="ignore"):
            self.lower = np.where(self.positive, np.log(np.maximum(lower, 0.0)), lower)
            self.upper = np.where(self.positive, np.log(np.maximum(upper, 0.0)), upper)
        self.others = np.setdiff1d(np.arange(len(x)), index)
        self.anchored = self.others[self.positive[self.others]]
        self.centre = np.where(self.positive, np.log(np.where(self.positive, x, 1.0)), x)
        self.scale = max(1.0, uncertainty.unknowns_covariance_and_reduced_chi2(problem, best)[1])
        self.first = uncertainty.cost_with_stated_priors(problem, best)
        self.base = 0.0
        self.notes: list[str] = []
        self.points = [_Point(float(x[index]), self.centre, 0.0, *self._rows(best, self.centre))]

    def _unknowns(self, s: Array) -> Array:
        return np.where(self.positive, np.exp(np.where(self.positive, s, 0.0)), s)

    def end(self, sign: int, size: float) -> float | None:
        """Return the value on the side `sign` at which chi2 has risen by 3.84, or None. `size` sets the first step."""
        inside, s, centre = self.points[0], self.centre[self.index], self.centre[self.index]
        reach = _MAX_LOG_DISTANCE if self.logarithmic else 1e3 * float(self.problem.unknown_scales[self.index])
        bound = float((self.upper if sign > 0 else self.lower)[self.index])
        limit = sign * min(sign * bound, sign * float(centre) + reach)
        barrier: float | None = None  # beyond it no rollout succeeds
        step, side = _TARGET_HEIGHT * size, "above" if sign > 0 else "below"
        for _ in range(_MAX_PROFILE_POINTS):
            trial = sign * min(sign * (s + sign * step), sign * (limit if barrier is None else barrier))
            if abs(trial - s) < 1e-9 * max(1.0, abs(s)):
                if barrier is None:
                    return None  # the unknown is at its bound
                break
            point = self._refit(inside, trial)
            if point is None:
                barrier, step = trial, 0.5 * abs(trial - s)
                continue
            height = self._added(point)
            if abs(height - _TARGET_HEIGHT) < _ROOT_RTOL * _TARGET_HEIGHT:
                return point.value
            if height > _TARGET_HEIGHT:
                return self._root(inside, point)
            inside, s = point, trial
            if trial == limit:
                return None
            # the root of delta chi2 is linear for a quadratic cost; its slope predicts the crossing
            gone, near = abs(trial - centre), height <= 0.05 * _TARGET_HEIGHT
            ahead = math.inf if near else gone * (_TARGET_HEIGHT / height - 1.0) * _STEP_OVERSHOOT
            step = min(max(ahead, 0.2 * gone), _MAX_STEP_GROWTH * gone) if barrier is None else 0.5 * abs(barrier - s)
        if barrier is None:
            self.notes.append(f"{_MAX_PROFILE_POINTS} fits did not find the end of the interval {side} the value")
        else:
            why = f"the model cannot be simulated {side} {self._value(barrier):.4g}"
            self.notes.append(f"the end of the interval {side} the value is unknown, because {why}")
        return None

    def rise(self, value: float) -> float:
        """Return the rise of chi2 at a value, with the other unknowns refitted, or NaN if no rollout succeeds."""
        point = self._refit(self.points[0], math.log(value) if self.logarithmic else value)
        return math.nan if point is None else point.chi2

    def _value(self, s: float) -> float:
        return float(np.exp(s)) if self.logarithmic else s

    def _added(self, point: _Point) -> float:
        """Store a point and return the square root of its delta chi2."""
        self.points.append(point)
        self.base = min(self.base, point.chi2)
        return self._height(point)

    def _height(self, point: _Point) -> float:
        return math.sqrt(max(point.chi2 - self.base, 0.0))

    def _root(self, inside: _Point, outside: _Point) -> float:
        """Return the interval's end between two points: regula falsi on the root of delta chi2, bisection at a jump."""
        a, b, target = inside, outside, _TARGET_HEIGHT
        heights = [self._height(a) - target, self._height(b) - target]
        share = 1.0  # weight of the older side's height, halved each time it is kept
        for attempt in range(2 * _MAX_PROFILE_POINTS + 1):
            at = [float(point.x[self.index]) for point in (a, b)]
            cliff = max(heights) > _CLIFF_HEIGHT_RATIO * target
            falsi = at[1] - heights[1] * (at[1] - at[0]) / (heights[1] - share * heights[0])
            s = 0.5 * (at[0] + at[1]) if cliff else falsi
            # a discontinuity is located once its two sides are close
            near = abs(at[1] - at[0]) < _CLIFF_WIDTH_RTOL * abs(at[1] - self.centre[self.index])
            if min(map(abs, heights)) < _ROOT_RTOL * target or near or attempt == 2 * _MAX_PROFILE_POINTS:
                s = at[int(abs(heights[1]) < abs(heights[0]))]
                break
            # beyond the end, the other unknowns may be in a flat region
            point = self._refit(a if heights[0] < heights[1] else b, s)
            if point is None:
                break
            height = self._added(point) - target
            if height * heights[1] < 0:
                a, heights[0], share = b, heights[1], 1.0
            else:
                share *= 0.5
            b, heights[1] = point, height
        return self._value(s)

    def _refit(self, near: _Point, s: float) -> _Point | None:
        now, others = near.x.copy(), self.others
        slope = near.jacobian[:, self.index] * (s - now[self.index])
        now[others] += self._others_step(now, near.jacobian[:, others], slope, 0.0)
        now[self.index] = s
        found = self._at(now)
        if found is None:
            # if the tangent leads too far, the other unknowns keep their values
            now = near.x.copy()
            now[self.index] = s
            found = self._at(now)
        damping, rejected = 1e-8, 0
        for _ in range(_MAX_REFIT_ITERATIONS):
            if found is None or rejected > _MAX_REJECTED_STEPS:
                break
            jacobian = found.jacobian[:, others]
            step = self._others_step(now, jacobian, found.rows, damping)
            step *= min(1.0, 1.5 / max(float(np.max(np.abs(step[self.positive[others]]), initial=0.0)), 1e-300))
            promised = -2.0 * float(found.rows @ (jacobian @ step)) - float(np.sum((jacobian @ step) ** 2))
            if promised / self.scale < _REFIT_CHI2_ATOL:
                break
            trial = now.copy()
            trial[others] += step
            after = self._at(trial)
            if after is not None and float(after.rows @ after.rows) < float(found.rows @ found.rows):
                now, found, damping, rejected = trial, after, max(damping / 5, 1e-12), 0
            else:
                damping, rejected = max(damping * 10, 1e-6), rejected + 1
        return found

    def _others_step(self, s: Array, jacobian: Array, rows: Array, damping: float) -> Array:
        low, high = (bound[self.others] - s[self.others] for bound in (self.lower, self.upper))
        return bounded_levenberg_marquardt_step(jacobian, rows, damping, low, high)

    def _at(self, s: Array) -> _Point | None:
        x = self._unknowns(s)
        evaluation = self.problem.evaluate(x)
        if not evaluation.ok or evaluation.jacobian is None:
            return None
        chi2 = 2.0 * (uncertainty.cost_with_stated_priors(self.problem, evaluation) - self.first) / self.scale
        return _Point(float(x[self.index]), s.copy(), chi2, *self._rows(evaluation, s))

    def _rows(self, evaluation: Evaluation, s: Array) -> tuple[Array, Array]:
        """Return residual and Jacobian by the coordinates `s`, with logarithmic priors instead of the weak priors."""
        residual, jacobian = residual_and_jacobian_with_stated_priors(self.problem, evaluation)
        slope = np.where(self.positive, self._unknowns(s), 1.0)
        anchors = np.eye(len(s))[self.anchored] / _LOG_PRIOR_STD
        held = (s - self.centre)[self.anchored] / _LOG_PRIOR_STD
        return np.concatenate([residual, held]), np.vstack([jacobian * slope, anchors])

"""Uncertainty of a fit: covariance, intervals and verdicts of parameters, and goodness of fit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.problem.null_test import USUAL, GapLimits, more_than_noise, null_test, residual_series
from yid_ocp.problem.problem import EstimationProblem

Array = NDArray[np.float64]
Interval = tuple[float | None, float | None]

IDENTIFIABLE = 0.1
WEAK = 4.0
# A standard deviation of so many times the value, or its typical size, stands for none at all.
UNINFORMED = 1e6
# A value so near its bound, in units of the unknown's typical size, lies at it.
AT_BOUND = 1e-4
# 95 % quantiles of chi2 with one degree of freedom, for an interval with one end and with two.
ONE_SIDED, TWO_SIDED = 2.705543454095404, 3.841458820694124
# Blocks of time into which all recordings are cut where the misfit counts, and their shortest and longest length [s].
BLOCKS, SHORTEST, LONGEST = 24, 0.25, 2.0
# So many recordings, or channels of single recordings, tell by themselves how far what they say scatters.
ENOUGH_RECORDINGS, ENOUGH_CHANNELS = 4, 8
# A parabola whose end the cost reaches with a smaller part of the promised height is no likelihood's.
PROMISED = 0.5
# With more parameters two rollouts for each take longer than the search itself.
MOST_ASKED = 12


@dataclass(frozen=True)
class Fit:
    """Whether the model explains the recordings on which it was fitted.

    Attributes
    ----------
    chi2_per_dof : float
        Mean square of the residual in standard deviations of the noise; NaN where there is none.
    p_value : float
        Probability of a residual this large under noise alone.
    explains : bool
        By the null test of a diagnosis, at its level and relevance; see `null_test.more_than_noise`.
    believed : bool
        Whether the data have no grave quality issue; see `ProblemOptions.doubts`.
    """

    chi2_per_dof: float
    p_value: float
    explains: bool
    believed: bool = True


NO_FIT = Fit(math.nan, math.nan, False)
"""Goodness of fit of a run without a result."""


@dataclass(frozen=True)
class Estimate:
    """Estimate of one parameter with standard deviation, bounds and verdict.

    Attributes
    ----------
    value, std : float
        In `unit`; `std` is infinite where the data do not inform the parameter.
    unit : str
    initial, lower, upper : float
    free : bool
    verdict : str
        See `verdict`; `fixed` where it was not free.
    interval : (float or None, float or None), or None
        95 % interval where a standard deviation does not tell it: one-sided at a bound, by profile likelihood where the
        cost is no parabola; None for an open end.
    """

    value: float
    std: float
    unit: str
    initial: float
    lower: float
    upper: float
    free: bool
    verdict: str
    interval: Interval | None = None

    @property
    def ends(self) -> tuple[float, float]:
        """Both ends of the 95 % interval, infinite where there is none."""
        if self.interval is None:
            return self.value - 1.96 * self.std, self.value + 1.96 * self.std
        lower, upper = self.interval
        return -math.inf if lower is None else lower, math.inf if upper is None else upper


# -- does the model explain the data ----------------------------------------------------------------------------------


def judge_fit(problem: EstimationProblem, evaluation: Evaluation, limits: GapLimits = USUAL) -> Fit:
    """Null test of a fit on its own recordings, with residuals in noise units whatever the weighting."""
    if not evaluation.ok:
        return NO_FIT
    residual = evaluation.residual
    if problem.options.weighting == "paper":
        parts = [
            ((predicted - samples.value) / samples.std)[samples.seen]
            for episode, result in zip(problem.episodes, evaluation.episodes, strict=True)
            for samples, predicted in zip(episode.samples, result.predicted, strict=True)
        ]
        residual = np.concatenate(parts) if parts else np.zeros(0)
    found = null_test(residual_series(problem), residual / limits.noise_fraction, len(problem.names))
    return Fit(found.chi2_per_dof, found.p_value, not more_than_noise((found,), limits), problem.options.believed)


# -- how sure ---------------------------------------------------------------------------------------------------------


def uncertainty(problem: EstimationProblem, evaluation: Evaluation) -> tuple[Array, float]:
    """Return the covariance of the unknowns, from data and stated priors, and chi2 per degree of freedom.

    Directions that the data do not inform get a variance of (1e8 x scale)^2 rather than an infinite one.
    """
    if evaluation.jacobian is None or not evaluation.ok:
        return np.full((len(problem.start), len(problem.start)), np.nan), math.nan
    spread, chi2 = spread_by_noise(problem, evaluation), _chi2_per_dof(problem, evaluation)
    return spread @ spread.T * max(1.0, chi2), chi2


def spread_by_noise(problem: EstimationProblem, evaluation: Evaluation) -> Array:
    """Factor F of the covariance F F' of the unknowns under noise alone, shape (nx, nx).

    The factor keeps the digits that a covariance with uninformed directions loses.
    """
    count, scale = len(problem.start), problem.scales
    _, jacobian = problem.informing(evaluation)
    _, singular, vectors = np.linalg.svd(jacobian * scale, full_matrices=False)
    inverse = np.zeros(count)
    inverse[: len(singular)] = singular
    basis = np.eye(count) if len(vectors) == 0 else _completed(vectors, count)
    return scale[:, None] * basis.T / np.maximum(inverse, 1e-8)


def _chi2_per_dof(problem: EstimationProblem, evaluation: Evaluation) -> float:
    """Of the data, stated priors counting as observations."""
    residual, _ = problem.informing(evaluation)
    data = residual[problem.rows.data]
    return float(data @ data) / max(len(residual) - len(problem.start), 1)


def _completed(vectors: Array, count: int) -> Array:
    if len(vectors) == count:
        return vectors
    rest = np.linalg.svd(np.eye(count) - vectors.T @ vectors)[0][:, : count - len(vectors)]
    return np.vstack([vectors, rest.T])


def counting_misfit(problem: EstimationProblem, evaluation: Evaluation, covariance: Array) -> Array:
    """Covariance widened for model misfit, at least as large as the block-wise sandwich estimate.

    What a model leaves out repeats itself from sample to sample and shows in all channels at once. The sandwich
    A^-1 S A^-1 therefore takes S from the scores J' r summed over blocks of time of one recording, all channels
    together, and where there are enough from those of single channels of whole recordings (a zero that moves, friction
    that holds) and of whole recordings; the largest variance of each unknown counts.

    Parameters
    ----------
    problem : EstimationProblem
    evaluation : Evaluation
        With its Jacobian.
    covariance : ndarray, shape (nx, nx)
        From `uncertainty`.

    Returns
    -------
    ndarray, shape (nx, nx)

    References
    ----------
    White (1982), Econometrica 50:1, doi:10.2307/1912526; Cameron, Gelbach, Miller (2011), J. Business and Economic
    Statistics 29:238, doi:10.1198/jbes.2010.07136 (clusters).
    """
    if evaluation.jacobian is None or not len(covariance):
        return covariance
    scale = problem.scales
    residual, jacobian = problem.informing(evaluation)
    jacobian = jacobian * scale
    inverse = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-10, hermitian=True)
    scores = jacobian * residual[:, None]
    plain = np.maximum(np.diag(covariance), 1e-300)
    widest = plain
    for labels in _clusters(problem):
        sums = np.array([scores[rows].sum(axis=0) for rows in labels])
        sums = sums - sums.mean(axis=0)
        middle = sums.T @ sums * len(sums) / (len(sums) - 1)
        widest = np.maximum(widest, np.diag(inverse @ middle @ inverse) * scale**2)
    factor = np.sqrt(widest / plain)
    return covariance * np.outer(factor, factor)


def _clusters(problem: EstimationProblem) -> list[list[NDArray[np.int64]]]:
    """Rows of the data cut into blocks of time, and where there are enough into recordings and channels of these."""
    total = sum(episode.grid.steps for episode in problem.episodes) * problem.step.time_step
    length = float(np.clip(total / BLOCKS, SHORTEST, LONGEST))
    blocks: dict[tuple[str, int], list[NDArray[np.int64]]] = {}
    recordings: dict[str, list[NDArray[np.int64]]] = {}
    channels: list[list[NDArray[np.int64]]] = []
    for series in residual_series(problem):
        channels.append([series.rows])
        recordings.setdefault(series.recording, []).append(series.rows)
        at = (series.t / length).astype(int)
        for block in np.unique(at):
            blocks.setdefault((series.recording, int(block)), []).append(series.rows[at == block])
    found: list[list[NDArray[np.int64]]] = []
    if len(blocks) > 1:
        found.append([np.concatenate(parts) for parts in blocks.values()])
    if len(recordings) > 1 and len(channels) >= ENOUGH_CHANNELS:
        found.append([np.concatenate(parts) for parts in channels])
    if len(recordings) >= ENOUGH_RECORDINGS:
        found.append([np.concatenate(parts) for parts in recordings.values()])
    return found


def covariance_of_fit(problem: EstimationProblem, evaluation: Evaluation, fit: Fit) -> Array:
    """Covariance of the unknowns at a fit, widened for misfit where the model does not explain the data."""
    covariance, _ = uncertainty(problem, evaluation)
    return covariance if fit.explains else counting_misfit(problem, evaluation, covariance)


def standing_std(problem: EstimationProblem, x: Array, evaluation: Evaluation, covariance: Array) -> Array:
    """Standard deviation of each unknown, shape (nx,), that of parameters checked against the cost.

    The covariance is that of a parabola at the fit. Where it does not fix a parameter well, the cost is worked out at
    the end of its 95 % interval, the others moved along; where it rises less than the parabola promised, the
    standard deviation is that of a parabola through there, infinite where the cost does not rise at all. Stiffnesses
    that are small by chance look informed at the fit and are not. Of more than `MOST_ASKED` parameters none is asked.
    """
    spread = plain_std(covariance, x)
    lower, upper = problem.bounds
    scale = max(1.0, _chi2_per_dof(problem, evaluation))
    parameters = parameter_names(problem)
    for name in parameters if len(parameters) <= MOST_ASKED else ():
        i = problem.names.index(name)
        size = max(abs(float(x[i])), float(problem.scales[i]))
        if not math.isfinite(spread[i]) or not IDENTIFIABLE * abs(x[i]) < spread[i] < UNINFORMED * size:
            continue
        heights = []
        for sign in (-1.0, 1.0):
            room = float(upper[i] - x[i]) if sign > 0 else float(x[i] - lower[i])
            # farther than this off its typical size a parabola has nothing to say
            step = min(math.sqrt(TWO_SIDED) * spread[i], room, 10 * size)
            if step < IDENTIFIABLE * spread[i]:
                continue
            moved = np.clip(x + sign * step * covariance[:, i] / covariance[i, i], lower, upper)
            trial = problem.evaluate(moved, False, evaluation.warm)
            if trial.ok:
                rise = _informed_cost(problem, trial) - _informed_cost(problem, evaluation)
                heights.append(max(2.0 * rise / scale, 1e-12) / (step / spread[i]) ** 2)
        if heights and min(heights) < PROMISED:
            spread[i] /= math.sqrt(min(heights))
    return spread


def parameter_names(problem: EstimationProblem) -> tuple[str, ...]:
    """Unknowns that are parameters, local ones with their recording's name; initial states are left out."""
    parameters = {*problem.shared, *problem.local}
    return tuple(name for name in problem.names if name.split("[")[0] in parameters)


def plain_std(covariance: Array, x: Array) -> Array:
    """Standard deviations from a covariance, shape (nx,); infinite where it holds no numbers."""
    if not len(covariance):
        return np.zeros(len(x))
    diagonal = np.diag(covariance)
    return np.where(np.isnan(diagonal), np.inf, np.sqrt(np.maximum(diagonal, 0.0)))


def known_covariance(names: Sequence[str], matrix: Array, std: Sequence[float]) -> dict[str, Any]:
    """Names and covariance of parameters for result.json: correlations of a matrix, scaled to given deviations.

    Parameters
    ----------
    names : sequence of str, length n
    matrix : ndarray, shape (n, n)
    std : sequence of float, length n
        Those that are not finite and positive are left out: nothing is known of their parameters.
    """
    at = [i for i, value in enumerate(std) if math.isfinite(value) and value > 0 and matrix[i, i] > 0]
    factor = np.array([std[i] for i in at]) / np.sqrt(np.array([matrix[i, i] for i in at]))
    kept = matrix[np.ix_(at, at)] * np.outer(factor, factor)
    return {"names": [names[i] for i in at], "matrix": kept.tolist()}


def _informed_cost(problem: EstimationProblem, evaluation: Evaluation) -> float:
    """Cost in units of the noise without the weak priors."""
    weak, stated = (
        0.5 * float(np.sum(evaluation.residual[rows] ** 2))
        for rows in (problem.rows.weak_priors, problem.rows.stated_priors)
    )
    return (evaluation.cost - weak - stated) / problem.noise**2 + stated


# -- what may be said -------------------------------------------------------------------------------------------------


def verdict(value: float, std: float, *, scale: float = 0.0, explains: bool = True, at_bound: bool = False) -> str:
    """Verdict on a free parameter from its value and standard deviation.

    ==================  ================================================================================================
    not_identifiable    the standard deviation is above 400 % of the value
    not_trusted         the model does not explain the data, or the data are in grave doubt
    at_bound            the value lies at one of its bounds
    identifiable        the standard deviation is up to 10 % of the value
    weak                anything else
    ==================  ================================================================================================

    The first that holds is returned. A value that may be zero is judged by `scale` as well: identifiable where value
    and two standard deviations stay below a tenth of it, weak where they stay below all of it.

    Parameters
    ----------
    value, std : float
        In the same unit.
    scale : float
        Plausible size of the parameter, zero where unknown.
    explains, at_bound : bool
    """
    found = by_size(value, std, scale)
    if found == "not_identifiable":
        return found
    if not explains:
        return "not_trusted"
    return "at_bound" if at_bound else found


def by_size(value: float, std: float, scale: float = 0.0) -> str:
    """Verdict by relative standard deviation alone: identifiable, weak or not_identifiable."""
    if not math.isfinite(std):
        return "not_identifiable"
    relative, reach = std / max(abs(value), 1e-12), abs(value) + 2 * std
    near_zero = abs(value) <= 2 * std
    if relative <= IDENTIFIABLE or (near_zero and reach <= IDENTIFIABLE * scale):
        return "identifiable"
    return "weak" if relative <= WEAK or (near_zero and reach <= scale) else "not_identifiable"


def by_profile(entry: Estimate, interval: Interval, scale: float) -> Estimate:
    """Estimate with its profile-likelihood interval, and standard deviation and verdict consistent with it.

    Open on both sides it is not_identifiable, on one side at best weak and without a ±. An end that is not met before
    a bound within `scale` is that bound. Else the wider side stands for two standard deviations (`by_size`), and is
    the ± where a parabola's would be less than half of it.

    Parameters
    ----------
    entry : Estimate
    interval : (float or None, float or None)
        95 %.
    scale : float
        See `verdict`.
    """
    low, high = interval
    if low is None and entry.value - entry.lower <= scale:
        low = entry.lower
    if high is None and entry.upper - entry.value <= scale:
        high = entry.upper
    if interval == (None, None):
        std, found = math.inf, "not_identifiable"
    elif low is None or high is None:
        std, found = math.inf, "weak"
    else:
        wide = max(entry.value - low, high - entry.value) / math.sqrt(TWO_SIDED)
        std = wide if PROMISED * wide > entry.std else entry.std
        found = by_size(entry.value, wide, scale)
        found = "weak" if found == "not_identifiable" else found
    order = ("identifiable", "weak", "not_identifiable")
    said = max(entry.verdict, found, key=order.index) if entry.verdict in order else entry.verdict
    return replace(entry, std=std, verdict=said, interval=interval)


def stands_by_itself(entry: Estimate) -> bool:
    """Whether the standard deviation describes the uncertainty, so that no profile likelihood is needed."""
    return entry.verdict == "identifiable" and entry.std <= IDENTIFIABLE * abs(entry.value)


def typical_sizes(problem: EstimationProblem, x: Array) -> Mapping[str, float]:
    """Plausible size of each free parameter: by its prior, its bounds, similar parameters, or its initial value.

    A prior counts with its standard deviation, finite bounds with half of what lies between them, the others of the
    same kind (`bend`, say, or else of the same unit) with the median of their sizes.
    """
    theta, _ = problem.split(x, 0)
    entries = list(problem.system.parameters)
    scales = {name.split("[")[0]: float(scale) for name, scale in zip(problem.names, problem.scales, strict=True)}
    sizes = dict(zip((entry.name for entry in entries), np.abs(theta), strict=True))
    joint = problem.options.joint_prior
    known = {**problem.options.priors, **dict(zip(joint.names, np.sqrt(np.diag(joint.covariance)), strict=True))}
    found = {}
    for entry in entries:
        if entry.name not in (*problem.shared, *problem.local):
            continue
        width = entry.upper - entry.lower
        alike = [o for o in entries if o.name != entry.name and o.unit == entry.unit and "@" not in o.name]
        own = [o for o in alike if _kind(o.name) == _kind(entry.name)]
        others = [float(sizes[o.name]) for o in own or alike if sizes[o.name] > 0]
        if entry.name in known:
            found[entry.name] = float(known[entry.name])
        elif math.isfinite(width):
            found[entry.name] = width / 2
        else:
            found[entry.name] = float(np.median(others)) if others and "@" not in entry.name else scales[entry.name]
    return found


def _kind(name: str) -> str:
    return name.rpartition(".")[2]


def estimates(
    problem: EstimationProblem, x: Array, evaluation: Evaluation, covariance: Array, fit: Fit | None
) -> dict[str, Estimate]:
    """Estimates of all parameters, local ones by recording, with value, standard deviation and verdict.

    Parameters
    ----------
    problem : EstimationProblem
    x : ndarray, shape (nx,)
    evaluation : Evaluation
        At `x`, with its Jacobian.
    covariance : ndarray, shape (nx, nx)
    fit : Fit, optional
        None where the point is not a fit; misfit and bounds are then ignored.
    """
    known = fit is not None and evaluation.ok and evaluation.jacobian is not None
    spread = standing_std(problem, x, evaluation, covariance) if known else plain_std(covariance, x)
    sizes, theta = typical_sizes(problem, x), problem.split(x, 0)[0]
    scales, (lower, upper) = problem.scales, problem.bounds
    result: dict[str, Estimate] = {}
    free = {name: problem.names.index(name) for name in parameter_names(problem)}
    for i, entry in enumerate(problem.system.parameters):
        if entry.name not in problem.local:
            value, bounds = float(theta[i]), (entry.lower, entry.upper)
            result[entry.name] = Estimate(value, 0.0, entry.unit, float(problem.theta[i]), *bounds, False, "fixed")
    for name, at in free.items():
        entry = problem.system.parameters[name.split("[")[0]]
        value, initial = float(x[at]), float(problem.start[at])
        std = float(spread[at])
        std = std if std < UNINFORMED * max(abs(value), float(scales[at])) else math.inf
        side = bound_side(value, float(lower[at]), float(upper[at]), float(scales[at])) if known else 0
        explains = fit is None or (fit.explains and fit.believed)
        said = verdict(value, std, scale=sizes[entry.name], explains=explains, at_bound=side != 0)
        interval = None
        if said == "not_identifiable":
            std = math.inf
        elif side:
            interval = one_sided(value, std, side, _pull(problem, evaluation, at))
        bounds = (float(lower[at]), float(upper[at]))
        result[name] = Estimate(value, std, entry.unit, initial, *bounds, True, said, interval)
    return result


def distrusted(known: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """Estimates with the verdict not_trusted in place of any but fixed and not_identifiable."""
    return {
        name: replace(entry, verdict="not_trusted") if entry.free and entry.verdict != "not_identifiable" else entry
        for name, entry in known.items()
    }


def bound_side(value: float, lower: float, upper: float, size: float) -> int:
    """-1 where a value lies at its lower bound, 1 at its upper one, 0 elsewhere."""
    near = AT_BOUND * size
    return -1 if value - lower <= near else 1 if upper - value <= near else 0


def one_sided(value: float, std: float, side: int, slope: float) -> Interval:
    """95 % interval of a parameter at its bound: slope d + d^2/(2 std^2) = 2.71/2 at a distance d from it.

    Parameters
    ----------
    value, std : float
    side : -1 or 1
        Whether the bound is the lower or the upper one.
    slope : float
        Rise of the cost, over the factor by which the noise is larger than stated, away from the bound.
    """
    pull = max(slope, 0.0)
    reach = std * (math.sqrt((pull * std) ** 2 + ONE_SIDED) - pull * std)
    return (value, value - side * reach) if side < 0 else (value - side * reach, value)


def _pull(problem: EstimationProblem, evaluation: Evaluation, at: int) -> float:
    """Size of the gradient of the cost by one unknown, in units of the noise that the misfit makes."""
    residual, jacobian = problem.informing(evaluation)
    scale = max(1.0, _chi2_per_dof(problem, evaluation))
    return abs(float(jacobian[:, at] @ residual)) / scale

"""Uncertainty of a fit: covariance, intervals and verdicts of parameters, and goodness of fit."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.special

from yid_ocp.arrays import Array, BoolArray, IntArray
from yid_ocp.data.channel_checks import Issue
from yid_ocp.display import ReprMixin, ReprTexts, grouped
from yid_ocp.errors import SolverError
from yid_ocp.inference import null_test
from yid_ocp.inference.linearized_residual import residual_and_jacobian_with_stated_priors, triangular_factor
from yid_ocp.problem.episodes import EpisodeAndPredictionOrFailure
from yid_ocp.problem.estimation_problem import EstimationProblem
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.problem.options import ExcessResidualCriteria

ConfidenceInterval = tuple[float | None, float | None]

MAX_IDENTIFIABLE_RELATIVE_STD = 0.1
MAX_WEAK_RELATIVE_STD = 4.0
HOPELESS_CHI2 = 1e3  # per degree of freedom: units, signs or names are probably wrong
_POSSIBLE_NOISE_CHI2 = 25.0  # per degree of freedom, up to which stated noise that is too small can be the cause
MIN_RELATIVE_STD_TAKEN_AS_INFINITE = 1e6  # of the value (or its typical size)
_AT_BOUND_FRACTION = 1e-4  # distance from a bound, over the unknown's typical size, that counts as at the bound
# 95 % quantiles of chi2 with one degree of freedom, for an interval with one end and with two.
_CHI2_95_ONE_SIDED, CHI2_95_TWO_SIDED = 2.705543454095404, 3.841458820694124
# Number of time blocks into which all recordings are cut if misfit is included, and their limits of length [s].
_N_TIME_BLOCKS, _MIN_BLOCK_LENGTH, _MAX_BLOCK_LENGTH = 24, 0.25, 2.0
# With at least this many recordings, or channels of recordings, scores are clustered by these.
_MIN_CLUSTER_RECORDINGS, _MIN_CLUSTER_CHANNELS = 4, 8
_MIN_COST_RISE_RATIO = 0.5  # of the predicted rise, below which the Gaussian approximation is rejected
# Two rollouts for each of more parameters take longer than the search itself.
_MAX_CHECKED_PARAMETERS = 12
_PRIOR_STD_RATIO = 3.0  # factor on a standard deviation without priors, from which on priors determine an unknown
_MIN_PRIOR_SHARE = 0.5  # of the largest deviation from a prior [stds], from which on another prior is named, too


@dataclass(frozen=True)
class GoodnessOfFit:
    """The result of the null test of a fit: does the model explain the recordings to which it was fitted?"""

    chi2_per_dof: float
    p_value: float  # probability of a chi2 this large under noise alone
    explains: bool  # result of the null test (`residuals_exceed_noise`)
    data_trusted: bool = True  # no serious data issue (`ProblemOptions.data_issues`)
    noise_fraction: float = 1.0  # of the stated standard deviations


@dataclass(frozen=True, repr=False)
class ParameterEstimate(ReprMixin):
    """The estimate of one parameter, with value, standard deviation, bounds and verdict.

    The 95 % `interval` is given if `std` does not describe the uncertainty. At a bound, the interval is one-sided. If
    the cost is not quadratic, it is a profile-likelihood interval. An end that is None is open.
    """

    value: float
    std: float  # infinite without information on the parameter
    unit: str
    initial: float
    lower: float
    upper: float
    free: bool
    verdict: str  # `parameter_verdict`, or `fixed`
    interval: ConfidenceInterval | None = None

    @property
    def confidence_interval_ends(self) -> tuple[float, float]:
        """The ends of the 95 % interval, infinite if open. Without a stated interval they are value ± 1.96 std."""
        if self.interval is None:
            return self.value - 1.96 * self.std, self.value + 1.96 * self.std
        lower, upper = self.interval
        return -math.inf if lower is None else lower, math.inf if upper is None else upper

    def _summary(self) -> ReprTexts:
        std = finite_or_none(self.std) if self.free else None
        text = value_and_uncertainty_text(self.value, std, self.interval, verdict=self.verdict)
        return ReprTexts(f"{text} {self.unit}, {VERDICT_TABLE_TEXTS[self.verdict]}")


@dataclass(frozen=True)
class EstimateShiftByDiscretisation:
    """The change of an estimate by twice the links, half the time step or more encoder noise. None if not computed."""

    links: float | None = None
    time_step: float | None = None
    encoder_noise: float | None = None  # by one more draw of the noise of angles that move an object


def assess_goodness_of_fit(
    problem: EstimationProblem,
    evaluation: Evaluation,
    limits: ExcessResidualCriteria = null_test.DEFAULT_EXCESS_RESIDUAL_CRITERIA,
    x: Array | None = None,
) -> GoodnessOfFit:
    """Test whether a fit explains its own recordings. Residuals are in noise units for any weighting of the problem.

    If the unknowns `x` of the fit are given, noise of encoders that move the model counts as noise.
    """
    if not evaluation.ok:
        return GoodnessOfFit(math.nan, math.nan, False)
    residual = evaluation.residual
    if problem.options.weighting == "paper":
        parts = [np.zeros(0)]
        for episode, result in zip(problem.episodes, evaluation.episode_predictions, strict=True):
            for samples, predicted in zip(episode.measurements, result.predicted_outputs, strict=True):
                parts.append(((predicted - samples.value) / samples.std)[samples.positive_weight_mask])
        residual, x = np.concatenate(parts), None  # encoder noise is known for rows of the cost only
    series = null_test.channels_with_residual_indices(problem)
    fitted = effective_parameter_count(problem, evaluation)
    share, is_trusted = limits.noise_fraction_of_stated_std, problem.options.has_no_data_issue_above_warning
    found = null_test.residual_chi2_null_test(series, residual / share, fitted)
    if x is not None and null_test.residuals_exceed_noise((found,), limits):
        residual = null_test.whiten_with_encoder_noise(problem, x, residual)
        found = null_test.residual_chi2_null_test(series, residual / share, fitted)
    explains = not null_test.residuals_exceed_noise((found,), limits)
    return GoodnessOfFit(found.chi2_per_dof, found.p_value, explains, is_trusted, share)


def null_tests_of_fit(
    problem: EstimationProblem,
    x: Array,
    evaluation: Evaluation,
    level: float,
    predicted: Sequence[EpisodeAndPredictionOrFailure] = (),
) -> tuple[null_test.NullTestResult, null_test.NullTestResult, Array]:
    """Test whether the residuals of a fit at `x` are only noise: of the estimation and of the held-out recordings.

    Noise of encoders that move the model counts as noise, on held-out recordings also errors of the fitted parameters.
    The array (n, k) is the change of held-out residuals by one std of each error of shared parameters. Raises
    `SolverError` if a held-out recording cannot be predicted.
    """
    shared, filters = len(problem.shared_parameters), problem.held_out_whitening_filters
    predicted = predicted or problem.predict_held_out(x, True)
    own = problem.with_episodes([episode for episode, _ in predicted], ())  # with their fitted initial states
    point = null_test.unknowns_without_encoder_noise_bias(problem, x)

    def residual_of(moved: EstimationProblem) -> Array | None:
        other = problem.with_episodes(problem.episodes, moved.episodes, problem.whitening_filters, filters)
        with contextlib.suppress(SolverError):
            return np.concatenate([part.residual for part in other.held_out_residuals(other.predict_held_out(point))])
        return None

    found = problem.held_out_residuals(predicted)
    residual = np.concatenate([part.residual for part in found])
    slopes = np.vstack([np.asarray(part.jacobian)[:, :shared] for part in found])
    by_parameters = np.asarray(slopes @ noise_only_covariance_sqrt(problem, evaluation)[:shared])
    by_path = null_test.encoder_noise_residual_covariance_factor(own, point, residual_of)[: len(residual)]
    residual = null_test.whiten_with_drawn_errors(residual, by_parameters, by_path)
    by_path = null_test.encoder_noise_residual_covariance_factor(problem, point)
    fitted = null_test.whiten_with_drawn_errors(evaluation.residual, by_path[:, :0], by_path)
    count = effective_parameter_count(problem, evaluation)
    before, held_out = (
        null_test.residual_chi2_null_test(null_test.channels_with_residual_indices(of), r, parameters, level)
        for of, r, parameters in ((problem, fitted, count), (own, residual, 0))
    )
    return before, held_out, by_parameters


def unknowns_covariance_and_reduced_chi2(problem: EstimationProblem, evaluation: Evaluation) -> tuple[Array, float]:
    """Compute the covariance (nx, nx) of the unknowns from data and stated priors, and chi2 per degree of freedom.

    A direction without information has the std 1e8 x the unknown's scale. The covariance is multiplied by max(1, chi2).
    If `stated_std_factor` is below 1, priors count here at least with the std that was stated, before this factor.
    """
    if evaluation.jacobian is None or not evaluation.ok:
        return np.full((len(problem.initial_unknowns), len(problem.initial_unknowns)), np.nan), math.nan
    spread, chi2 = noise_only_covariance_sqrt(problem, evaluation), _chi2_per_dof(problem, evaluation)
    scale = max(1.0, chi2)
    priors = residual_and_jacobian_with_stated_priors(problem, evaluation)[1][problem.residual_rows.stated_priors]
    pull = spread @ (priors @ spread).T * math.sqrt(max(0.0, problem.options.stated_std_factor**-2 - scale))
    return spread @ spread.T * scale + pull @ pull.T, chi2


def noise_only_covariance_sqrt(problem: EstimationProblem, evaluation: Evaluation) -> Array:
    """Compute F (nx, nx) of the unknowns' covariance F F' from noise alone. F is precise in weak directions, too."""
    scale, (residual, jacobian) = problem.unknown_scales, residual_and_jacobian_with_stated_priors(problem, evaluation)
    _, singular, vectors = np.linalg.svd(triangular_factor(jacobian, residual)[:-1, :-1] * scale)
    return scale[:, None] * vectors.T / np.maximum(singular, 1e-8)


def effective_parameter_count(problem: EstimationProblem, evaluation: Evaluation) -> float:
    """Count the unknowns that the data determine, without the part that stated priors determine (MacKay 1992).

    It is n - trace(P (J'J)^-1 P') for n unknowns and the Jacobians P of the stated priors and J of data and priors.
    """
    count, rows = len(problem.unknown_names), problem.residual_rows.stated_priors
    if evaluation.jacobian is None or rows.start == rows.stop:
        return count
    priors = residual_and_jacobian_with_stated_priors(problem, evaluation)[1][rows]
    return count - float(np.sum((priors @ noise_only_covariance_sqrt(problem, evaluation)) ** 2))


def _chi2_per_dof(problem: EstimationProblem, evaluation: Evaluation) -> float:
    """Chi2 of the data per degree of freedom. Stated priors count as observations."""
    residual, _ = residual_and_jacobian_with_stated_priors(problem, evaluation)
    data = residual[problem.residual_rows.data]
    return float(data @ data) / max(len(residual) - len(problem.initial_unknowns), 1)


def _misfit_sandwich_covariance(problem: EstimationProblem, evaluation: Evaluation, covariance: Array) -> Array:
    """Covariance widened for model misfit, at least as large as the block-wise sandwich estimate.

    The sandwich is A^-1 S A^-1 with A = J'J (White 1982, doi:10.2307/1912526). S is the covariance of the scores J' r,
    summed over clusters of rows (Cameron, Gelbach, Miller 2011, doi:10.1198/jbes.2010.07136): time blocks of all
    channels of a recording, as a misfit is correlated in time and across channels; channels of recordings, for constant
    errors such as an offset; and recordings. Kinds with too few clusters are omitted. The largest variance counts.
    """
    if evaluation.jacobian is None or not len(covariance):
        return covariance
    scale, (residual, jacobian) = problem.unknown_scales, residual_and_jacobian_with_stated_priors(problem, evaluation)
    priors = jacobian[problem.residual_rows.stated_priors] * scale / problem.options.stated_std_factor
    information = jacobian.T @ jacobian * np.outer(scale, scale)
    inverse = np.asarray(np.linalg.pinv(information, rcond=1e-10, hermitian=True), float)
    plain = np.maximum(np.diag(covariance), 1e-300)
    widest = plain
    for labels in _clusters(problem):
        middle = _score_covariance(information, inverse, ((jacobian[rows] * scale, residual[rows]) for rows in labels))
        middle += priors.T @ priors
        widest = np.maximum(widest, np.diag(inverse @ middle @ inverse) * scale**2)
    factor = np.sqrt(widest / plain)
    return covariance * np.outer(factor, factor)


def _score_covariance(information: Array, inverse: Array, clusters: Iterable[tuple[Array, Array]]) -> Array:
    """Covariance (nx, nx) of the sum of scores J' r over independent clusters of rows (J, r).

    A fit follows a cluster that alone determines a direction, so that the cluster's residual is too small. Its score is
    therefore divided by (1 - h)^(1/2), where h is the cluster's part of the information (Bell, McCaffrey 2002).
    """
    values, vectors = np.linalg.eigh(information)
    root = vectors * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    back = root @ inverse
    parts, adjusted = [(slopes.T @ slopes, slopes.T @ errors) for slopes, errors in clusters], []
    sums = np.array([score for _, score in parts])
    for (own, _), total in zip(parts, sums - sums.mean(axis=0), strict=True):
        share, axes = np.linalg.eigh(back @ own @ back.T)
        # directions that no other cluster informs cannot be corrected
        kept = share < 1 - 1e-6
        grown = np.where(kept, 1.0 / np.sqrt(np.where(kept, 1.0 - np.maximum(share, 0.0), 1.0)), 0.0)
        adjusted.append(root @ (axes * grown) @ axes.T @ (back @ total))
    scores = np.array(adjusted) * float(scipy.special.stdtrit(len(sums) - 1, 0.975) / scipy.special.ndtri(0.975))
    return scores.T @ scores


def _clusters(problem: EstimationProblem) -> list[list[IntArray]]:
    """Rows of the data in time blocks and, if there are enough, in recordings and in channels of recordings."""
    total = sum(episode.grid.steps for episode in problem.episodes) * problem.step.time_step
    length = float(np.clip(total / _N_TIME_BLOCKS, _MIN_BLOCK_LENGTH, _MAX_BLOCK_LENGTH))
    series = null_test.channels_with_residual_indices(problem)
    channels = [[own.residual_indices] for own in series]
    recordings = grouped((own.recording, own.residual_indices) for own in series)
    numbered = ((own, (own.t / length).astype(int)) for own in series)
    parts = ((own.recording, own.residual_indices[at == k], int(k)) for own, at in numbered for k in np.unique(at))
    blocks = grouped(((recording, k), rows) for recording, rows, k in parts)
    kinds = (
        (blocks.values(), len(blocks) > 1),
        (channels, len(recordings) > 1 and len(channels) >= _MIN_CLUSTER_CHANNELS),
        (recordings.values(), len(recordings) >= _MIN_CLUSTER_RECORDINGS),
    )
    return [[np.concatenate(parts) for parts in clusters] for clusters, are_enough in kinds if are_enough]


def misfit_robust_covariance(problem: EstimationProblem, evaluation: Evaluation, fit: GoodnessOfFit) -> Array:
    """Return the covariance (nx, nx) of the unknowns, widened for misfit if the fit does not explain the data."""
    covariance, _ = unknowns_covariance_and_reduced_chi2(problem, evaluation)
    return covariance if fit.explains else _misfit_sandwich_covariance(problem, evaluation, covariance)


def _cost_checked_std(problem: EstimationProblem, x: Array, evaluation: Evaluation, covariance: Array) -> Array:
    """Standard deviation of each unknown, (nx,). Those of parameters are checked against the cost, positive ones first.

    A stiff object vibrates too fast for the samples, and its derivatives promise more than the cost holds. If the cost
    rises to less than half of its prediction at an end of the 95 % interval, the standard deviation is that of a
    parabola through this point. It is very large if the cost does not rise.
    """
    spread = _std_from_covariance(covariance)
    lower, upper = problem.bounds
    scale = max(1.0, _chi2_per_dof(problem, evaluation))
    parameters = map(problem.unknown_names.index, parameter_unknown_names(problem))
    for i in sorted(parameters, key=lambda i: not problem.positive_unknowns_mask[i])[:_MAX_CHECKED_PARAMETERS]:
        size = max(abs(float(x[i])), float(problem.unknown_scales[i]))
        if not 0 < spread[i] < MIN_RELATIVE_STD_TAKEN_AS_INFINITE * size:
            continue
        heights = []
        for sign, room in ((-1.0, float(x[i] - lower[i])), (1.0, float(upper[i] - x[i]))):
            # beyond this distance from the value, a parabola is not a useful approximation
            step = min(math.sqrt(CHI2_95_TWO_SIDED) * spread[i], room, 10 * size)
            if step < MAX_IDENTIFIABLE_RELATIVE_STD * spread[i]:
                continue
            moved = np.clip(x + sign * step * covariance[:, i] / covariance[i, i], lower, upper)
            trial = problem.evaluate(moved, False, evaluation.equilibrium_guesses)
            if trial.ok:
                rise = cost_with_stated_priors(problem, trial) - cost_with_stated_priors(problem, evaluation)
                heights.append(max(2.0 * rise / scale, 1e-12) / (step / spread[i]) ** 2)
        if heights and min(heights) < _MIN_COST_RISE_RATIO:
            spread[i] /= math.sqrt(min(heights))
    return spread


def parameter_unknown_names(problem: EstimationProblem) -> tuple[str, ...]:
    """Return the names of unknowns that are parameters, not initial states. Local ones include a recording's name."""
    parameters = {*problem.shared_parameters, *problem.local_parameters}
    return tuple(name for name in problem.unknown_names if name.split("[")[0] in parameters)


def _std_from_covariance(covariance: Array) -> Array:
    """Standard deviations from a covariance, (nx,). They are infinite where the covariance is NaN."""
    diagonal = np.diag(covariance)
    return np.where(np.isnan(diagonal), np.inf, np.sqrt(np.maximum(diagonal, 0.0)))


def covariance_to_dict(names: Sequence[str], matrix: Array, std: Sequence[float]) -> dict[str, Any]:
    """Return the `matrix` of result.json rescaled to the deviations `std`, without those that are infinite or zero."""
    at = [i for i, value in enumerate(std) if math.isfinite(value) and value > 0 and matrix[i, i] > 0]
    factor = np.asarray(std, float)[at] / np.sqrt(np.diag(matrix)[at])
    return {"names": [names[i] for i in at], "matrix": (matrix[np.ix_(at, at)] * np.outer(factor, factor)).tolist()}


def cost_with_stated_priors(problem: EstimationProblem, evaluation: Evaluation) -> float:
    """Return the cost r'r/2 of data (in units of noise) and stated priors, without weak priors."""
    rows = problem.residual_rows
    weak, stated = (0.5 * float(np.sum(evaluation.residual[r] ** 2)) for r in (rows.weak_priors, rows.stated_priors))
    return (evaluation.cost - weak - stated) / problem.stated_rms_noise_of_data_residuals**2 + stated


def parameter_verdict(
    value: float, std: float, *, scale: float = 0.0, explains: bool = True, at_bound: bool = False
) -> str:
    """Judge a free parameter by its value and standard deviation. Returns the first verdict whose condition holds.

    - not_identifiable: the standard deviation is above 400 % of the value
    - not_trusted: the model does not explain the data, or the data have serious issues
    - at_bound: the value lies at one of its bounds
    - identifiable: the standard deviation is up to 10 % of the value
    - weak: all other cases

    A value near zero is also judged by `scale`, the parameter's plausible size (zero if unknown). It is identifiable if
    |value| + 2 std is at most a tenth of `scale`, and weak if it is at most `scale`.
    """
    found = verdict_by_relative_std(value, std, scale)
    if found == "not_identifiable":
        return found
    if not explains:
        return "not_trusted"
    return "at_bound" if at_bound else found


def verdict_by_relative_std(value: float, std: float, scale: float = 0.0) -> str:
    """Judge a parameter by its relative standard deviation alone: identifiable, weak or not_identifiable."""
    if not math.isfinite(std):
        return "not_identifiable"
    relative, reach = std / max(abs(value), 1e-12), abs(value) + 2 * std
    near_zero = abs(value) <= 2 * std
    if relative <= MAX_IDENTIFIABLE_RELATIVE_STD or (near_zero and reach <= MAX_IDENTIFIABLE_RELATIVE_STD * scale):
        return "identifiable"
    return "weak" if relative <= MAX_WEAK_RELATIVE_STD or (near_zero and reach <= scale) else "not_identifiable"


def apply_profile_interval(entry: ParameterEstimate, interval: ConfidenceInterval, scale: float) -> ParameterEstimate:
    """Return an estimate with a 95 % profile-likelihood interval, and with a std and verdict that agree with it.

    An open end becomes the parameter's bound if the bound is within `scale` of the value (`scale` as in
    `parameter_verdict`). With two open ends the verdict is not_identifiable. With one open end it is at best weak, and
    std is infinite. Without open ends, the distance from the value to the farther end, divided by 1.96, decides the
    verdict. It replaces std if std is less than half of it. If it is less than half of std, and the value is not
    at a bound, refits may have ended in local minima, so the interval is value ± 1.96 std.
    """
    order, (low, high) = ("identifiable", "weak", "not_identifiable"), interval
    if low is None and entry.value - entry.lower <= scale:
        low = entry.lower
    if high is None and entry.upper - entry.value <= scale:
        high = entry.upper
    if interval == (None, None):
        std, found = math.inf, "not_identifiable"
    elif low is None or high is None:
        std, found = math.inf, "weak"
    else:
        wide = max(entry.value - low, high - entry.value) / math.sqrt(CHI2_95_TWO_SIDED)
        std = wide if _MIN_COST_RISE_RATIO * wide > entry.std else entry.std
        found = min(verdict_by_relative_std(entry.value, wide, scale), "weak", key=order.index)
        if wide < _MIN_COST_RISE_RATIO * std < math.inf and entry.value not in (entry.lower, entry.upper):
            reach = math.sqrt(CHI2_95_TWO_SIDED) * std
            interval = max(entry.value - reach, entry.lower), min(entry.value + reach, entry.upper)
    said = max(entry.verdict, found, key=order.index) if entry.verdict in order else entry.verdict
    return replace(entry, std=std, verdict=said, interval=interval)


def needs_no_profile_likelihood(entry: ParameterEstimate) -> bool:
    """Check whether a parameter needs no profile because its relative standard deviation is at most 10 %."""
    return entry.verdict == "identifiable" and entry.std <= MAX_IDENTIFIABLE_RELATIVE_STD * abs(entry.value)


def typical_parameter_magnitudes(problem: EstimationProblem, x: Array) -> Mapping[str, float]:
    """Return the typical magnitude of each free parameter, from priors, similar parameters or scales.

    It is the first of these that is available: the prior's standard deviation; the median of other parameters of the
    same kind (such as `bend`), or of the same unit, except for effects; and the scale of the unknown.
    """
    (theta, _), entries = problem.unpack_episode_unknowns(x, 0), list(problem.system.parameters)
    pairs = zip(problem.unknown_names, problem.unknown_scales, strict=True)
    scales = {name.split("[")[0]: float(scale) for name, scale in pairs}
    sizes = dict(zip((entry.name for entry in entries), np.abs(theta), strict=True))
    joint, known = problem.options.multivariate_prior, dict(problem.options.prior_stds)
    known |= dict(zip(joint.parameter_names, np.sqrt(np.diag(joint.covariance)), strict=True))
    found = {}
    for entry in (e for e in entries if e.name in (*problem.shared_parameters, *problem.local_parameters)):
        alike = [o for o in entries if o.name != entry.name and o.unit == entry.unit and "@" not in o.name]
        own = [o for o in alike if o.name.rpartition(".")[2] == entry.name.rpartition(".")[2]]
        others = [float(sizes[o.name]) for o in own or alike if sizes[o.name] > 0]
        usual = float(np.median(others)) if others and "@" not in entry.name else scales[entry.name]
        found[entry.name] = float(known.get(entry.name, usual))
    return found


def parameter_estimates(
    problem: EstimationProblem, x: Array, evaluation: Evaluation, covariance: Array, fit: GoodnessOfFit | None
) -> dict[str, ParameterEstimate]:
    """Create the estimates of all parameters from the unknowns `x`, their covariance (nx, nx) and the evaluation.

    Local parameters are listed by recording. If `x` is not a fit, `fit` is None, and misfit and bounds are ignored.
    """
    known = fit is not None and evaluation.ok and evaluation.jacobian is not None
    spread = _cost_checked_std(problem, x, evaluation, covariance) if known else _std_from_covariance(covariance)
    sizes, theta = typical_parameter_magnitudes(problem, x), problem.unpack_episode_unknowns(x, 0)[0]
    scales, (lower, upper) = problem.unknown_scales, problem.bounds
    result: dict[str, ParameterEstimate] = {}
    free = {name: problem.unknown_names.index(name) for name in parameter_unknown_names(problem)}
    for entry, value, initial in zip(problem.system.parameters, theta, problem.theta, strict=True):
        if entry.name not in problem.local_parameters:
            told = entry.unit, float(initial), entry.lower, entry.upper
            result[entry.name] = ParameterEstimate(float(value), 0.0, *told, False, "fixed")
    for name, at in free.items():
        entry = problem.system.parameters[name.split("[")[0]]
        value, std, low, high, scale = (float(v[at]) for v in (x, spread, lower, upper, scales))
        std = std if std < MIN_RELATIVE_STD_TAKEN_AS_INFINITE * max(abs(value), scale) else math.inf
        near = _AT_BOUND_FRACTION * scale
        side = 0  # -1 at the lower bound, 1 at the upper
        if known and min(value - low, high - value) <= near:
            side = -1 if value - low <= near else 1
        explains = fit is None or (fit.explains and fit.data_trusted)
        said = parameter_verdict(value, std, scale=sizes[entry.name], explains=explains, at_bound=side != 0)
        interval = None
        if said == "not_identifiable":
            std = math.inf
        elif side:
            # slope of the cost in units of the noise, which includes the misfit
            residual, jacobian = residual_and_jacobian_with_stated_priors(problem, evaluation)
            pull = std * abs(float(jacobian[:, at] @ residual)) / max(1.0, _chi2_per_dof(problem, evaluation))
            # one-sided 95 % end: pull d/std + d^2/(2 std^2) = 2.71/2 at a distance d from the bound
            reach = std * (math.sqrt(pull**2 + _CHI2_95_ONE_SIDED) - pull)
            interval = (value, min(value + reach, high)) if side < 0 else (max(value - reach, low), value)
        initial = float(problem.initial_unknowns[at])
        result[name] = ParameterEstimate(value, std, entry.unit, initial, low, high, True, said, interval)
    return result


def mark_free_estimates_not_trusted(known: Mapping[str, ParameterEstimate]) -> dict[str, ParameterEstimate]:
    """Give free estimates the verdict not_trusted. Fixed and not_identifiable parameters keep their verdicts."""
    doubted = {name for name, entry in known.items() if entry.free and entry.verdict != "not_identifiable"}
    return {name: replace(e, verdict="not_trusted") if name in doubted else e for name, e in known.items()}


VERDICT_TABLE_TEXTS: Mapping[str, str] = {
    "fixed": "fixed",
    "identifiable": "found",
    "weak": "weakly determined",
    "not_identifiable": "cannot be found",
    "at_bound": "at its bound",
    "not_trusted": "in doubt",
}
"""Words for each verdict of a parameter."""


def goodness_of_fit_message(fit: Mapping[str, Any], with_advice: bool = True) -> str:
    """Return a sentence that states whether a model explains its recordings. `with_advice`: what to do if it does not.

    `fit` has the attributes of a `GoodnessOfFit`; `p_value` and `noise_fraction` may be missing.
    A fit with more error than noise alone usually leaves is not called within noise, even if it is not significant.
    """
    chi2_per_dof, explains, p_value = fit["chi2_per_dof"], fit["explains"], fit.get("p_value")
    if chi2_per_dof is None or chi2_per_dof != chi2_per_dof:
        return "It is not known whether the model explains the recordings."
    chi2 = f"{chi2_per_dof:.3g}" if chi2_per_dof < 1000 else f"{chi2_per_dof:.0f}"
    fraction = fit.get("noise_fraction", 1.0)
    share = f" with {fraction:g} of the stated std (diagnosis.noise_fraction_of_stated_std)" if fraction < 1 else ""
    size = f"chi2 per degree of freedom is {chi2}; noise alone{share} gives 1"
    if explains and chi2_per_dof > 1 + null_test.DEFAULT_EXCESS_RESIDUAL_CRITERIA.min_excess_chi2_per_dof:
        chance = "" if p_value is None else f", and so much or more in {100 * p_value:.2g} % of cases"
        said = "The errors are larger than noise usually leaves them, so the model may lack a small effect"
        return f"{said} ({size}{chance}). To confirm the values, add recordings or run `yid-ocp diagnose`."
    if explains:
        too_large = overstated_noise_sentence(chi2_per_dof, p_value)
        return f"The model explains the recordings to within their noise ({size}).{too_large}"
    said = f"Do not use the values yet, because the model does not explain the recordings ({size})."
    checks = "check units, signs, names and noise and " * (chi2_per_dof * fraction**2 > HOPELESS_CHI2)
    if fraction == 1 and chi2_per_dof <= _POSSIBLE_NOISE_CHI2:
        checks = f"check the stated noise (is the true noise {chi2_per_dof**0.5:.2g} times as large?) and "
    return f"{said} To find the cause, {checks}run `yid-ocp diagnose`." if with_advice else said


def overstated_noise_sentence(chi2_per_dof: float, p_value: float | None) -> str:
    """Return a sentence, after a space, if the error of many samples is far below the stated noise; else nothing."""
    said = f" The stated noise is about {chi2_per_dof**-0.5:.2g} times too large, so every ± is too large."
    return said if chi2_per_dof < 0.25 and p_value is not None and p_value > 0.9999 else ""


def value_and_uncertainty_text(
    value: float,
    std: float | None,
    interval: ConfidenceInterval | None = None,
    least_digits: int = 4,
    verdict: str | None = None,
) -> str:
    """Format a value with its 95 % interval, or with its std to two digits; a dash if it is not identifiable."""
    if verdict == "not_identifiable":
        return "–"
    if interval is not None and interval != (None, None):
        return f"{value:.4g} ({interval_text(*interval)})"
    if std is None:
        return f"{value:.4g}"
    ratio = math.floor(math.log10(abs(value))) - math.floor(math.log10(std)) if 0 < std < abs(value) else 0
    return f"{value:.{max(least_digits, ratio + 2)}g} ± {std:.2g}"


def finite_or_none(value: float) -> float | None:
    """Return a finite number unchanged, and None for infinity or NaN."""
    return value if math.isfinite(value) else None


def percent_number_text(part: float) -> str:
    """Format a fraction as a percentage with two digits. There are no exponents below 10000 %."""
    return f"{100 * part:.0f}" if 100 * part >= 99.5 and part < 100 else f"{100 * part * (abs(part) > 1e-9):.2g}"


def interval_text(lower: float | None, upper: float | None) -> str:
    """Format the ends of a 95 % interval. None is an open end."""
    if lower is None:
        return "open" if upper is None else f"below {upper:.4g}"
    return f"above {lower:.4g}" if upper is None else f"{lower:.4g} to {upper:.4g}"


def mask_of_priors_determining_unknown(data: Array, priors: Array, column: int) -> BoolArray:
    """Return a mask (nx,) of the unknowns whose priors determine the unknown `column`. All False if the data do.

    `data` (n, nx) and `priors` (k, nx) are Jacobians of whitened residuals. Priors determine an unknown if its standard
    deviation is more than `_PRIOR_STD_RATIO` times as large without them. Other unknowns can then compensate a change
    of the unknown in the predictions. The mask marks those that this moves farthest from their priors.
    """
    others = np.arange(data.shape[1]) != column
    found, whole = np.zeros(len(others), bool), np.vstack([data, priors])
    size = np.linalg.norm(whole[:, others], axis=0)
    scale = np.where(size > 0, 1 / np.maximum(size, 1e-300), 0.0)

    def left(rows: Array) -> tuple[Array, float]:
        moved = np.linalg.lstsq(rows[:, others] * scale, rows[:, column], rcond=1e-9)[0] * scale
        return np.asarray(moved), float(np.sum((rows[:, column] - rows[:, others] @ moved) ** 2))

    (_, by_data), (moved, by_all) = left(data), left(whole)
    away = np.abs(moved) * np.linalg.norm(priors[:, others], axis=0)
    if _PRIOR_STD_RATIO**2 * by_data < by_all and away.any():
        found[others] = away >= _MIN_PRIOR_SHARE * away.max()
    return found


@dataclass(frozen=True)
class EstimateChecksBeyondFit:
    """Further checks of an estimate: finer discretisations, held-out recordings and stability of the time step.

    Attributes
    ----------
    data_std : mapping of str to float
        Standard deviation of every free parameter, without discretisation error.
    discretisation_shifts : mapping of str to EstimateShiftByDiscretisation
        Shift of every free parameter in each finer model that was tried.
    notes : mapping of str to str
        Notes on finer discretisations or parameters. `uncounted_errors`: errors that standard deviations leave out.
    expected_prediction_errors : mapping of recording to mapping of channel to float
        Root mean square error of each held-out prediction expected from sensor and torque noise, in the channel's unit.
    step_stability : mapping
        Growth of errors whose sign alternates from step to step, at the `estimate` and at the `start` of a failed fit.
    """

    data_std: Mapping[str, float] = field(default_factory=dict)
    discretisation_shifts: Mapping[str, EstimateShiftByDiscretisation] = field(default_factory=dict)
    notes: Mapping[str, str] = field(default_factory=dict)
    uncounted_errors: tuple[str, ...] = ()
    held_out_predictions: tuple[EpisodeAndPredictionOrFailure, ...] = ()
    expected_prediction_errors: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    data_issues: tuple[Issue, ...] = ()
    step_stability: Mapping[str, Any] = field(default_factory=dict)
    cable_memory_message: str = ""

"""Screening of all candidates: detectability and score tests from one computation of sensitivities.

r is the whitened residual of the nominal fit, J_theta its sensitivity to the parameters of the nominal fit, J_j that to
the amplitudes of candidate j, and P = I - J_theta J_theta^+. The score is s_j = -J_j' P r, its information
G_j = J_j' P J_j, its statistic LM_j = s_j' S_j^-1 s_j. S_j, the covariance of s_j, has the noise's autocorrelation
(Newey and West 1987, doi:10.2307/1913610) and the noise of encoders; the bias by the latter is subtracted (Cook and
Stefanski 1994, doi:10.1080/01621459.1994.10476871). The linear model predicts a decrease of r'r by s_j' G_j^-1 s_j, or
less if an amplitude would leave its bounds. Shape parameters are tried on a grid, and the best p-value is corrected for
that many trials (Davies 1987, doi:10.1093/biomet/74.1.33, bounded by Bonferroni). `docs/design/screening_and_refits.md`
has the derivation.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg

from yid_ocp.arrays import Array, IntArray
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem, join_effect_labels
from yid_ocp.display import grouped
from yid_ocp.effects import EffectBase
from yid_ocp.errors import failed_rollout_error
from yid_ocp.inference import null_test
from yid_ocp.inference.linearized_residual import (
    orthonormal_basis_and_coefficients,
    residual_and_jacobian_with_stated_priors,
)
from yid_ocp.inference.null_test import OutputResidualIndices, channels_with_residual_indices
from yid_ocp.problem import EstimationProblem

DETECTABLE_AMPLITUDE_Z = 2.576 + 1.282  # found with 90 % power at the 1 % level [standard deviations]
_SHAPE_GRID_SIZE = 4  # values tried per shape parameter
_N_BIAS_DRAWS = 2  # of encoder noise, for the bias of scores


@dataclass(frozen=True)
class _EffectSignature:
    """Derivative of the residual with respect to the amplitudes of a candidate."""

    effect: EffectBase
    shape_values: dict[str, float]
    projected_sensitivity: Array  # X = P J_j, shape (nr, p), by its amplitudes
    score_noise_covariance: Array  # shape (p, p): covariance of X'r under the noise's own autocorrelation
    score_prior_covariance: Array  # shape (p, p): the part of it that stated priors make
    score_bias: Array  # E[X'r] - E[X]'E[r], shape (p,): encoder noise moves both X and r
    changes: Mapping[str, Array]  # of each shared parameter by the amplitudes, shape (p,), if it hides them best


@dataclass(frozen=True)
class CandidateDetectability:
    """The smallest amplitudes of a candidate that are detectable, given its sensitivity and the noise."""

    effect: EffectBase
    detectable_amplitudes: dict[str, float]  # amplitudes in the parameter's unit
    is_detectable: bool  # whether one of them lies within the prior range
    # the largest change of each shared parameter by an amplitude that is neither detectable nor beyond the prior range
    hidden_changes: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class ScoreTestResult:
    """The score test of one candidate effect: predicted parameter values, predicted decrease of chi2, and p-value."""

    effect: EffectBase
    predicted_values: dict[str, float]  # amplitudes after the step of the linear model, and the shape values
    predicted_chi2_decrease: float
    lm_statistic: float  # LM with robust covariance
    p_value: float
    changes: Mapping[str, float] = field(default_factory=dict)  # of each shared parameter by the step


def _shape_grid(effect: EffectBase, size: int = _SHAPE_GRID_SIZE) -> list[dict[str, float]]:
    """Grid values of a candidate's shape parameters, uniform or log-uniform over the prior range."""
    ranges = {name: effect.prior_ranges[name] for name in effect.shape_parameter_names}
    axes = [(np.geomspace if low > 0 else np.linspace)(low, high, size) for low, high in ranges.values()]
    return [dict(zip(ranges, map(float, point), strict=True)) for point in zip(*axes, strict=True)] or [{}]


def linearize_candidates(
    problem: AllCandidatesProblem, base: Sequence[EffectBase], values: Mapping[str, float]
) -> tuple[Array, list[_EffectSignature]]:
    """Linearise the residual with respect to the amplitudes of all candidates that are not yet in the model.

    The model contains the effects in `base`, with all their parameters free. `values` are the fitted unknowns of this
    model. Returns the residual (nr,) and a signature for each candidate and each trial value of its shape parameters,
    both without the part that free parameters explain. Raises `SolverError` if the rollout at `values` fails.
    """
    labels = {effect.label for effect in base}
    tried = [effect for effect in problem.candidate_effects if effect.label not in labels]
    if not tried:
        return np.zeros(0), []
    placed = problem.problem_with_effects_and_relinearized_filters(base, values)
    series, rows = channels_with_residual_indices(problem.problem), problem.problem.residual_rows
    x = placed.pack_unknowns(values)
    unbiased = null_test.unknowns_without_encoder_noise_bias(placed, x)
    scatter = null_test.encoder_noise_residual_covariance_factor(placed, unbiased)[rows.data]
    is_in_scatter = np.any(scatter, axis=1)
    is_noisy = placed.system.prescribed and not is_in_scatter.all()
    rng, draws = np.random.default_rng(1), range(_N_BIAS_DRAWS if is_noisy else 0)
    redrawn = [null_test.episodes_with_noisier_motion(placed, rng) for _ in draws]
    # changes by encoder noise hardly depend on the effects in the model
    known = problem.changes_by_encoder_noise
    fitted = placed.unknowns.named_values(x)
    held = placed.with_parameter_values({name: fitted[name] for name in placed.shared_parameters})
    grid, sensitivities, warm = [], list[Array](), None
    for point, shapes in enumerate(itertools.zip_longest(*map(_shape_grid, tried))):
        chosen = [(effect, shape) for effect, shape in zip(tried, shapes, strict=True) if shape is not None]
        amplitudes = [name for effect, _ in chosen for name in effect.amplitude_parameter_names]
        # where amplitudes are neutral, other shapes change nothing but the derivatives by these amplitudes
        free = placed.local_parameters if point else placed.free
        trial = held.with_free_parameters_without_recompiling((*free, *amplitudes))
        trial = trial.with_parameter_values({name: value for _, shape in chosen for name, value in shape.items()})
        evaluation = trial.evaluate(trial.pack_unknowns(values), equilibrium_guesses=warm)
        if not evaluation.ok:
            raise failed_rollout_error(evaluation.message, f"simulation with {join_effect_labels(base)}")
        warm = evaluation.equilibrium_guesses
        data, jacobian = residual_and_jacobian_with_stated_priors(trial, evaluation)
        del evaluation  # its Jacobian is large
        if point not in known:
            changed = (_changes(trial.with_episodes(own, ()), values, data, jacobian) for own in redrawn)
            known[point] = [(change * ~is_in_scatter, by_name) for change, by_name in filter(None, changed)]
        places = [trial.unknown_names.index(name) for name in amplitudes]
        if not point:
            residual, others = data, [name for name in trial.unknown_names if name not in amplitudes]
            nominal = np.delete(jacobian, places, axis=1)
        sensitivities.append(np.zeros((len(residual), len(places))))
        sensitivities[-1][rows.data] = jacobian[rows.data][:, places]
        grid.append((chosen, amplitudes))
    basis, followed = orthonormal_basis_and_coefficients(nominal, np.hstack(sensitivities))
    del nominal, jacobian
    residual, signatures = residual - basis @ (basis.T @ residual), list[_EffectSignature]()
    follows = np.split(followed, np.cumsum([own.shape[1] for own in sensitivities])[:-1], axis=1)
    for point, ((chosen, amplitudes), follow) in enumerate(zip(grid, follows, strict=True)):
        moved = sensitivities[point] - basis @ (basis.T @ sensitivities[point])
        by_shared = -follow[[others.index(name) for name in placed.shared_parameters]]
        shifts, errors = list[Array](), [error for error, _ in known[point]]
        for error, (_, first), (_, own) in zip(errors, known[0], known[point], strict=False):
            changes, unmoved = first | own, np.zeros_like(error)
            by_own, by_others = (np.stack([changes.get(n, unmoved) for n in part], 1) for part in (amplitudes, others))
            # the part of a signature that free parameters explain changes with their own signatures
            shift = np.zeros_like(moved)
            shift[rows.data] = by_own - by_others @ follow
            shifts.append(shift - basis @ (basis.T @ shift))
        edges = np.cumsum([len(effect.amplitude_parameter_names) for effect, _ in chosen])[:-1]
        split = (np.split(np.ascontiguousarray(own), edges, axis=1) for own in (moved, by_shared, *shifts))
        for (effect, shape), (columns, changes, *shifted) in zip(chosen, zip(*split, strict=True), strict=True):
            pairs = [*zip(shifted, errors, strict=False)]
            of_score = _covariance_and_bias_of_score(problem.problem, series, columns, scatter, pairs)
            by_name = dict(zip(placed.shared_parameters, changes, strict=True))
            signatures.append(_EffectSignature(effect, shape, columns, *of_score, by_name))
    return residual, signatures


def _covariance_and_bias_of_score(
    problem: EstimationProblem,
    series: Sequence[OutputResidualIndices],
    columns: Array,
    scatter: Array,
    changes: Sequence[tuple[Array, Array]],
) -> tuple[Array, Array, Array]:
    """Covariance of X'r for the `columns` X, the part of it by stated priors, and bias, see `_EffectSignature`.

    `changes` are those of X and of the data's r by redrawn encoder noise, `scatter` a factor of the covariance of r.
    """
    rows = problem.residual_rows
    driven = columns[rows.data].T @ scatter
    priors = columns[rows.stated_priors] / problem.options.stated_std_factor
    by_priors = priors.T @ priors
    noise = null_test.covariance_of_scores(columns, series) + driven @ driven.T + by_priors
    bias = np.zeros(columns.shape[1])
    for own, error in changes:
        noise += null_test.covariance_of_scores(own, series) / len(changes) ** 2
        bias += own[rows.data].T @ error / len(changes)
    return noise, by_priors, bias


def _changes(
    again: EstimationProblem, values: Mapping[str, float], data: Array, jacobian: Array
) -> tuple[Array, dict[str, Array]] | None:
    """Changes by redrawn noise of the data's residual `data` and, for each unknown, of a column of its Jacobian."""
    outcome, rows = again.evaluate(again.pack_unknowns(values)), again.residual_rows.data
    if not outcome.ok:
        return None
    other, slopes = residual_and_jacobian_with_stated_priors(again, outcome)
    changes = np.subtract(slopes[rows], jacobian[rows], dtype=np.float32)  # of many columns
    return (other - data)[rows], dict(zip(again.unknown_names, changes.T, strict=True))


def _detectability(signature: _EffectSignature) -> CandidateDetectability:
    effect, names = signature.effect, signature.effect.amplitude_parameter_names
    information = signature.projected_sensitivity.T @ signature.projected_sensitivity
    inverse = _pinv(information)
    variance = np.diag(inverse @ signature.score_noise_covariance @ inverse)
    sizes = DETECTABLE_AMPLITUDE_Z * np.sqrt(np.maximum(variance, 0.0))
    sizes = np.where(np.diag(information) > 1e-16, sizes, np.inf)
    room = [np.abs(np.subtract(effect.prior_ranges[name], effect.neutral_values[name])).max() for name in names]
    hidden = {name: float(np.max(np.abs(own) * np.minimum(sizes, room))) for name, own in signature.changes.items()}
    found = dict(zip(names, sizes.tolist(), strict=True))
    return CandidateDetectability(effect, found, bool(np.any(sizes < room)), hidden)


def _pinv(matrix: Array) -> Array:
    return np.asarray(np.linalg.pinv(matrix, rcond=1e-10, hermitian=True))


def _room(effect: EffectBase) -> Array:
    """Largest changes of amplitudes from neutral, downwards and upwards, shape (2, p)."""
    neutral, bounds = effect.neutral_values, effect.parameters
    ends = [(bounds[n].lower - neutral[n], bounds[n].upper - neutral[n]) for n in effect.amplitude_parameter_names]
    return np.array(ends).T


def _promised(information: Array, slope: Array, room: Array) -> tuple[Array, float]:
    """Step of the linear model within bounds, and its decrease of r'r."""
    step = np.clip(_pinv(information) @ slope, *room)
    return step, float((2 * slope - information @ step) @ step)


def _score(signature: _EffectSignature, residual: Array, series: Sequence[OutputResidualIndices]) -> ScoreTestResult:
    effect, x, floor = signature.effect, signature.projected_sensitivity, signature.score_noise_covariance
    slope = signature.score_bias - x.T @ residual
    room = _room(effect)
    step, decrease = _promised(x.T @ x, slope, room)
    # without the candidate's share of the residual, which would hide its significance
    covariance = null_test.newey_west_covariance_of_scores(x, residual + x @ step, series)
    covariance += signature.score_prior_covariance
    # a residual below the noise must not make a score significant
    statistic = float(slope @ _pinv(max(floor, covariance, key=np.trace)) @ slope)
    p_value = null_test.chi2_p_value(statistic, len(step))
    if room[0].tolist() == [0.0]:
        statistic, p_value = (statistic, p_value / 2) if step[0] > 0 else (0.0, 1.0)
    values = _values(effect, step) | signature.shape_values
    changes = {name: float(own @ step) for name, own in signature.changes.items()}
    return ScoreTestResult(effect, values, max(decrease, 0.0), statistic, p_value, changes)


def _values(effect: EffectBase, step: Array) -> dict[str, float]:
    """Amplitudes after a step from neutral."""
    return {n: effect.neutral_values[n] + float(x) for n, x in zip(effect.amplitude_parameter_names, step, strict=True)}


ScoredCandidatePair = tuple[tuple[EffectBase, EffectBase], dict[str, float], float]
"""Two candidates, their values after the step of the linear model, and its decrease of r'r beyond chance."""


def _columns(effects: Sequence[EffectBase]) -> list[IntArray]:
    """Indices of each effect's amplitudes among those of all."""
    ends = np.cumsum([0, *(len(effect.amplitude_parameter_names) for effect in effects)])
    return [np.arange(*own) for own in itertools.pairwise(ends)]


def _overlap_fractions(effects: Sequence[EffectBase], information: Array) -> Array:
    """Fractions of signatures that candidates explain of each other, with amplitudes scaled by prior range."""
    ranges = [effect.prior_ranges[name] for effect in effects for name in effect.amplitude_parameter_names]
    scale = np.array([(high - low) / 2 for low, high in ranges])
    gram, blocks = information * scale[:, None] * scale, _columns(effects)
    inverses = [np.linalg.pinv(gram[np.ix_(b, b)], rcond=1e-8, hermitian=True) for b in blocks]
    starts = [block[0] for block in blocks]
    explained = gram @ scipy.linalg.block_diag(np.zeros((0, 0)), *inverses) * gram
    sums = np.add.reduceat(np.add.reduceat(explained, starts, axis=0), starts, axis=1)
    sizes = np.add.reduceat(np.diag(gram), starts)
    return np.clip(sums / np.maximum(sizes, 1e-300)[:, None], 0.0, 1.0)


@dataclass(frozen=True)
class ScreeningResult:
    """The detectability, score tests and confusability of all candidates at one point.

    A linear model tells how the amplitudes of all candidates, each at one shape value, change the residual.
    """

    detectability: tuple[CandidateDetectability, ...]
    candidate_scores: tuple[ScoreTestResult, ...]  # of the detectable ones, largest predicted decrease of r'r first
    # shape (nj, nj), in the order of `detectability`: of row j's signature, beyond nominal parameters, by column i's
    overlap_fractions: Array
    information: Array  # X'X of all signatures side by side, shape (n, n)
    score_vector: Array  # -X'r, shape (n,)

    @property
    def largest_predicted_chi2_decrease(self) -> float:
        """The largest decrease of r'r that the linear model predicts for one candidate; 0 without candidates."""
        return max((score.predicted_chi2_decrease for score in self.candidate_scores), default=0.0)

    @property
    def undetectable_labels(self) -> list[str]:
        """The labels of the candidates that the recordings would not show."""
        return [entry.effect.label for entry in self.detectability if not entry.is_detectable]

    @property
    def labels(self) -> list[str]:
        """The labels of all candidates."""
        return [entry.effect.label for entry in self.detectability]

    def candidates_confusable_with(self, label: str, limit: float) -> tuple[str, ...]:
        """List the other candidates that explain at least the fraction `limit` of the signature of `label`."""
        row = self.overlap_fractions[self.labels.index(label)]
        return tuple(n for n, f in zip(self.labels, row, strict=True) if f >= limit and n != label)

    def rank_candidate_pairs(self, without: str) -> list[ScoredCandidatePair]:
        """List all pairs of scored candidates, except the label `without`, by penalised decrease of r'r (r: residual).

        Two effects together can explain a residual that neither explains alone, because each masks the other.
        """
        effects = [entry.effect for entry in self.detectability]
        scored = {score.effect.label: score.predicted_values for score in self.candidate_scores}
        every, among = zip(effects, _columns(effects), strict=True), scored.keys() - {without}
        wanted = [(effect, at, _room(effect)) for effect, at in every if effect.label in among]
        found: list[ScoredCandidatePair] = []
        for (one, first, room), (other, second, its_room) in itertools.combinations(wanted, 2):
            at, both = np.concatenate([first, second]), np.concatenate([room, its_room], axis=1)
            step, decrease = _promised(self.information[at[:, None], at], self.score_vector[at], both)
            values = _values(one, step[: len(first)]) | _values(other, step[len(first) :])
            found.append(((one, other), scored[one.label] | scored[other.label] | values, decrease - len(at)))
        return sorted(found, key=lambda pair: -pair[-1])


EMPTY_SCREENING_RESULT = ScreeningResult((), (), np.zeros((0, 0)), np.zeros((0, 0)), np.zeros(0))
"""Screening where the model cannot be simulated: no candidate is known there."""


def screen_candidates(
    problem: AllCandidatesProblem, base: Sequence[EffectBase], values: Mapping[str, float]
) -> ScreeningResult:
    """Compute detectability, scores and confusability of all candidates that are not in `base`, at `values`."""
    residual, signatures = linearize_candidates(problem, base, values)
    series = channels_with_residual_indices(problem.problem)
    grids = grouped((own.effect.label, own) for own in signatures)
    visible, scores, kept = list[CandidateDetectability](), list[ScoreTestResult](), list[_EffectSignature]()
    for grid in grids.values():
        # the smallest amplitude that is detectable at `DETECTABLE_AMPLITUDE_Z` stds
        found = [*map(_detectability, grid)]
        clearest = min(found, key=lambda o: (not o.is_detectable, min(o.detectable_amplitudes.values())))
        hidden = {name: max(own.hidden_changes[name] for own in found) for name in clearest.hidden_changes}
        visible.append(replace(clearest, hidden_changes=hidden))
        chosen = grid[len(grid) // 2]
        if visible[-1].is_detectable:
            tried = [(_score(signature, residual, series), signature) for signature in grid]
            # shape values that make no difference differ by rounding alone: the first one stays
            best, chosen = max(tried, key=lambda own: float(f"{own[0].predicted_chi2_decrease:.6g}"))
            scores.append(replace(best, p_value=min(1.0, best.p_value * len(tried))))
        kept.append(chosen)
    every = np.hstack([np.zeros((len(residual), 0)), *(own.projected_sensitivity for own in kept)])
    slope = np.concatenate([np.zeros(0), *(own.score_bias for own in kept)]) - every.T @ residual
    ranked, information = sorted(scores, key=lambda own: -own.predicted_chi2_decrease), every.T @ every
    overlaps = _overlap_fractions([own.effect for own in kept], information)
    return ScreeningResult(tuple(visible), tuple(ranked), overlaps, information, slope)


def changes_by_candidates_at_location(
    screened: ScreeningResult, base: Sequence[EffectBase], level: float
) -> dict[str, float]:
    """Forecast how the parameters of each effect in `base` change if a candidate at its location is added.

    It is the candidate with the largest predicted decrease of r'r whose p-value is below `level`. Effects without one
    are left out.
    """
    significant = grouped((s.effect.location, s) for s in screened.candidate_scores if s.p_value < level)
    changed = [effect for effect in base if effect.location in significant]
    return {n: significant[effect.location][0].changes[n] for effect in changed for n in effect.parameters.names}

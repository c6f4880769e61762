"""Refit the nominal parameters together with effects, and judge the fits on held-out recordings.

A loss is the mean square of whitened residuals in blocks of held-out time. All models use the same blocks, so that
differences between models are paired. G = max(0, chi2/n - 1) is the gap.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Protocol, TypeVar, cast

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem, join_effect_labels, neutral_effect_parameter_values
from yid_ocp.diagnosis.screening import ScoredCandidatePair, ScreeningResult, screen_candidates
from yid_ocp.diagnosis.thresholds import DEFAULT_THRESHOLDS, Thresholds
from yid_ocp.display import PartsDoneCounter, Progress
from yid_ocp.effects import EffectBase, ReportedParameterValue
from yid_ocp.inference.null_test import chi2_p_value, times_since_recording_start
from yid_ocp.inference.uncertainty import (
    assess_goodness_of_fit,
    misfit_robust_covariance,
    unknowns_covariance_factor,
)
from yid_ocp.inference.whitening import (
    problem_relinearized_at_torque_bias,
    problem_with_sensor_noise_only,
    torque_bias_change_in_stds,
)
from yid_ocp.parallel import map_with_merged_calls
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode, EpisodePrediction
from yid_ocp.problem.evaluation import EquilibriumGuesses, Evaluation
from yid_ocp.problem.predictions import rmse_unit_and_count_by_channel
from yid_ocp.solvers import GaussNewton, Solution, Status
from yid_ocp.solvers.base import SolverResult

REFIT_SOLVER = GaussNewton(max_iterations=25, step_tolerance=1e-3, cost_tolerance=1e-5)
"""A refit starts near its end and must be good to a small part of its std only."""
_Answer = TypeVar("_Answer")
_UNINFORMATIVE_STD_RATIO = 100.0  # std over prior range from which a parameter counts as not informed
_HALF_DONE_FRACTION = 0.2  # explained fraction of the excess from which a refit that leaves more than noise is repeated
_RELINEARIZE_Z = 1.0  # stated standard deviations of a torque's offset: an effect that takes more is fitted once more


@dataclass(frozen=True)
class HeldOutLoss:
    """Whitened squared prediction errors of a model in nb time blocks of the held-out recordings, (nb,)."""

    block_chi2: Array  # sums of whitened squares; infinite if a rollout failed
    block_sample_counts: Array
    channel_rmse: dict[str, tuple[float, str]]  # root mean square error and its unit
    # chi2 of the deviation from a baseline, which does not depend on the resampled blocks
    baseline_chi2: float = 0.0

    @property
    def total_chi2(self) -> float:
        """Sum of whitened squares over all blocks, plus the chi2 of the deviation from a baseline."""
        return float(self.block_chi2.sum()) + self.baseline_chi2

    @property
    def chi2_per_sample(self) -> float:
        """`total_chi2` divided by the number n of held-out samples; 1 on average for noise alone."""
        return self.total_chi2 / max(float(self.block_sample_counts.sum()), 1.0)

    @property
    def excess_chi2_per_sample(self) -> float:
        """Held-out gap G = max(0, chi2/n - 1)."""
        return max(0.0, self.chi2_per_sample - 1.0)


@dataclass(frozen=True)
class StoredFit:
    """Stored values and standard deviations of a refit. One evaluation restores a `RefittedModel` from them."""

    values: dict[str, float]  # values of all unknowns
    std: dict[str, float]  # inflated by the misfit as in `solve`; infinite if not informed by the data
    p_values: dict[str, float]  # by effect: p-value of its amplitudes, at fixed shape parameters
    solver_message: str  # why the solver ended


@dataclass(frozen=True)
class RefitStatistics(StoredFit):
    """Statistics of a refit used by rules: estimates, and predictions of estimation and held-out recordings."""

    effects: tuple[EffectBase, ...]
    cost: float
    held_out_loss: HeldOutLoss
    residual_count: int  # number of residuals of the estimation recordings, priors included
    has_process_noise: bool  # whether errors of torques drive the motion

    @property
    def effect_parameter_count(self) -> int:
        """Number of parameters of all effects in the model."""
        return sum(len(effect.parameters) for effect in self.effects)

    def effect_parameters_as_reported(self, effect: EffectBase) -> dict[str, ReportedParameterValue]:
        """Fitted parameters of an effect in reported units, with standard deviations."""
        return effect.parameters_as_reported(self.values, self.std)


@dataclass(frozen=True)
class RefittedModel(RefitStatistics):
    """The nominal model with some effects after a refit, as a problem with its evaluation."""

    problem: EstimationProblem  # composed system; free nominal parameters and parameters of the effects
    evaluation: Evaluation
    is_from_store: bool = False


class RefitStore(Protocol):
    """Interface of a store of finished refits, from which an interrupted diagnosis resumes; called by two threads."""

    def get(self, name: str) -> StoredFit | None:
        """The refit stored under a name, or None."""

    def put(self, name: str, refitted: StoredFit) -> None:
        """Store a refit under a name."""


@dataclass(frozen=True)
class FinerStepRefitStore:
    """Refits of another store made at a finer time step [s] than stated, under separate names."""

    store: RefitStore
    time_step: float

    def get(self, name: str) -> StoredFit | None:
        """The refit stored under a name at this time step, or None."""
        return self.store.get(f"{name} at {self.time_step:g} s")

    def put(self, name: str, refitted: StoredFit) -> None:
        """Store a refit under a name and this time step."""
        self.store.put(f"{name} at {self.time_step:g} s", refitted)


@dataclass(frozen=True)
class NominalSolutionAndRefitStore:
    """Solution of the nominal problem and refits of an interrupted run, known before a diagnosis."""

    solution: Solution | None = None
    store: RefitStore | None = None  # receives every new refit


@dataclass(frozen=True)
class EffectSearchRecord:
    """Record of all results that a search for effects requested, by name. Other rules can reuse it without refits."""

    refits: dict[str, RefitStatistics | None] = field(default_factory=dict)  # None if the fit failed
    screenings: dict[str, ScreeningResult] = field(default_factory=dict)  # by name; next to effects in the model
    pairs: dict[str, tuple[ScoredCandidatePair, ...]] = field(
        default_factory=dict
    )  # by the label of the excluded effect


class UnrecordedRefitError(LookupError):
    """Raised when rules require a refit that the recorded search did not make."""


@dataclass(frozen=True)
class RefitContext:
    """Problem, thresholds, progress, store and deadline of one diagnosis. It makes the refits that rules request.

    With `is_finished`, results come from the record alone, without using the problem; a missing result raises
    `UnrecordedRefitError`.
    """

    problem: AllCandidatesProblem
    thresholds: Thresholds
    progress: Progress
    store: RefitStore | None = None
    deadline: float = math.inf  # value of `time.perf_counter` after which no further refit starts [s]
    skipped: list[str] = field(default_factory=list)  # skipped steps, shared by all copies of this context
    left_by: dict[str, str] = field(default_factory=dict)  # held-out chi2/n of all refits by their effects, likewise
    record: EffectSearchRecord = field(default_factory=EffectSearchRecord)  # likewise
    is_finished: bool = False

    def record_skip_if_past_deadline(self, *what: str) -> bool:
        """Whether the deadline for refits has passed. If so, `what` is recorded as skipped."""
        is_late = time.perf_counter() >= self.deadline
        self.skipped.extend(what if is_late else ())
        return is_late

    def refit(
        self, effects: Sequence[EffectBase], start: Mapping[str, float], name: str = ""
    ) -> RefitStatistics | None:
        """Refit the model with some effects; None if no rollout succeeds. `name` distinguishes different starts."""
        asked = (self.problem, effects, start, self.store, name, self.thresholds)
        return self._answer(self.record.refits, name or join_effect_labels(effects), lambda: refit_with_effects(*asked))

    def refit_on_held_out(self, fit: RefitStatistics) -> RefitStatistics | None:
        """Fit the same effects on the held-out recordings. None if that is not possible."""
        name = f"{join_effect_labels(fit.effects)} on the held-out recordings"
        return self._answer(self.record.refits, name, lambda: self._turned(fit, name))

    def _turned(self, fit: RefitStatistics, name: str) -> RefittedModel | None:
        """The effects of a fit, refitted with estimation and held-out recordings exchanged."""
        if self.problem.is_split_in_blocks:
            return None
        self.progress.begin_stage("fitting the held-out recordings with the same effects", 1.0, 2.5)
        problem = self.problem.problem
        turned = replace(self.problem, problem=problem.with_episodes(problem.held_out, problem.episodes))
        turned = turned.whitened_at(fit.values) if problem.has_process_noise else turned
        # parameters shared by both sets of recordings, without initial states
        names = {*turned.nominal_free_parameters, *(n for effect in fit.effects for n in effect.parameters.names)}
        start = {name: value for name, value in fit.values.items() if name in names}
        return refit_with_effects(turned, fit.effects, start, self.store, name, self.thresholds)

    def screen(self, base: Sequence[EffectBase], values: Mapping[str, float], name: str) -> ScreeningResult:
        """Screen all candidates in addition to some effects. `name` says which fit provides `values`."""
        return self._answer(
            self.record.screenings, name, lambda: screen_candidates(self.problem, base, values, self.thresholds)
        )

    def ranked_candidate_pairs(self, screened: ScreeningResult, without: str = "") -> tuple[ScoredCandidatePair, ...]:
        """Rank the most promising pairs of candidates, without one label. See `_MAX_RECORDED_PAIRS`."""
        labels = [score.effect.label for score in screened.candidate_scores if score.effect.label != without]
        found = screened.joint_score_model.ranked_candidate_pairs(labels)
        return self._answer(self.record.pairs, without, lambda: tuple(itertools.islice(found, _MAX_RECORDED_PAIRS)))

    def _answer(self, answers: dict[str, _Answer], name: str, work: Callable[[], _Answer]) -> _Answer:
        """A result from the record, or computed and recorded."""
        if self.is_finished:
            if name not in answers:
                raise UnrecordedRefitError(name)
            return answers[name]
        found = work()
        # a model's rollouts would fill the memory
        light = isinstance(found, RefittedModel)
        kept = {own.name: getattr(found, own.name) for own in fields(RefitStatistics)} if light else {}
        answers.setdefault(name, cast(_Answer, RefitStatistics(**kept)) if light else found)
        return found


_MAX_RECORDED_PAIRS = 48
"""Number of recorded pairs of candidates; all further pairs predict a smaller decrease than the refitted pairs."""


@dataclass(frozen=True)
class _Attempt:
    """End of a run, and its problem, with filters linearised about the torques there."""

    problem: EstimationProblem
    outcome: SolverResult
    finish: Evaluation


def refit_with_effects(
    problem: AllCandidatesProblem,
    effects: Sequence[EffectBase],
    start: Mapping[str, float],
    store: RefitStore | None = None,
    name: str = "",
    limits: Thresholds = DEFAULT_THRESHOLDS,
) -> RefittedModel | None:
    """Fit nominal and effect parameters, and predict held-out recordings. Returns None if no rollout succeeds.

    `start` holds the initial unknowns. If the rollout fails there, they are moved towards neutral effects. `name` is
    the name in the store of refits; the default, the labels of the effects, suffices if no other start is tried.
    """
    problem = problem.restricted_to_effect_location(effects)
    known = load_stored_refit(problem, effects, store, name)
    if known is not None:
        return known
    best = _attempt(problem, effects, start)
    if best is not None and _half_done(problem, effects, start, best.finish, limits):
        # the nominal fit may have moved its parameters to a point from which this model does not return
        fresh = {
            key: value
            for key, value in start.items()
            if key.split("[")[0] not in problem.nominal_free_parameters and not key.startswith("start.")
        }
        best = _cheaper(best, _attempt(problem, effects, fresh) if len(fresh) < len(start) else None)
    # earlier effects were already tried from both starts
    for effect in effects[-1:]:
        moved = effect.alternative_start(start)
        if moved is None or (best is not None and _leaves_noise(best.finish, limits)):
            continue
        best = _cheaper(best, _attempt(problem, effects, {**start, **moved}))
    if best is None:
        return None
    x, finish = best.outcome.x, best.finish
    values = best.problem.named_values(x)
    own = problem.with_relinearized_held_out_filters(best.problem, effects, values)
    factor = _refit_covariance_factor(own, finish, limits)
    std = _mark_uninformative_std(effects, own.named_values(np.linalg.norm(factor, axis=1)))
    found = StoredFit(values, std, _effect_p_values(effects, own.unknown_names, x, factor), best.outcome.message)
    if store is not None:
        store.put(name or join_effect_labels(effects), found)
    return _model(found, effects, own, finish, x)


def load_stored_refit(
    problem: AllCandidatesProblem, effects: Sequence[EffectBase], store: RefitStore | None, name: str = ""
) -> RefittedModel | None:
    """Restore a refit from the store by one evaluation. None if it is not in the store."""
    known = None if store is None else store.get(name or join_effect_labels(effects))
    unknowns = {*problem.with_nominal_and_effects_free(effects).unknown_names}
    labels = {effect.label for effect in effects}
    if known is None or not (set(known.values) == set(known.std) == unknowns and set(known.p_values) == labels):
        return None
    own = problem.with_effects_and_relinearized_filters(effects, known.values)
    x = own.unknown_vector(known.values)
    finish = own.evaluate(x)
    if not finish.ok:
        return None
    own = problem.with_relinearized_held_out_filters(own, effects, known.values)
    return _model(known, effects, own, finish, x, True)


def refit_in_all_candidates_step(problem: AllCandidatesProblem, fit: RefittedModel) -> RefittedModel:
    """A refit with its problem and evaluation in the step of all candidates; its statistics are kept."""
    if fit.problem.step is problem.problem.step:
        return fit
    own = problem.with_effects_and_relinearized_filters(fit.effects, fit.values)
    finish = own.evaluate(own.unknown_vector(fit.values))
    own = problem.with_relinearized_held_out_filters(own, fit.effects, fit.values)
    return replace(fit, problem=own, evaluation=finish)


def _model(
    known: StoredFit,
    effects: Sequence[EffectBase],
    own: EstimationProblem,
    finish: Evaluation,
    x: Array,
    is_from_store: bool = False,
) -> RefittedModel:
    kept = (known.values, known.std, known.p_values, known.solver_message, tuple(effects), finish.cost)
    size = (len(finish.residual), own.has_process_noise)
    return RefittedModel(*kept, _held_out_loss(own, x), *size, own, finish, is_from_store)


def _half_done(
    problem: AllCandidatesProblem,
    effects: Sequence[EffectBase],
    start: Mapping[str, float],
    finish: Evaluation,
    limits: Thresholds,
) -> bool:
    """Whether a refit explains much, but by far not all, of the gap left without its effects."""
    own, count = problem.with_nominal_and_effects_free(effects), len(finish.residual)
    x = own.unknown_vector({**start, **neutral_effect_parameter_values(effects)})
    before = own.evaluate(x, False, finish.equilibrium_guesses)
    if 2 * finish.cost < (1 + limits.min_excess_chi2_per_dof) * count or not before.ok:
        return False
    return before.cost - finish.cost > _HALF_DONE_FRACTION * (before.cost - count / 2)


def _leaves_noise(finish: Evaluation, limits: Thresholds) -> bool:
    """Whether a refit leaves no more than noise, so that no other start can be better."""
    return chi2_p_value(2 * finish.cost, len(finish.residual)) >= limits.significance_level


def _cheaper(first: _Attempt | None, second: _Attempt | None) -> _Attempt | None:
    """The attempt with the lower cost, the first if equal."""
    if first is None or second is None:
        return first or second
    return second if second.finish.cost < first.finish.cost else first


def _attempt(
    problem: AllCandidatesProblem, effects: Sequence[EffectBase], start: Mapping[str, float]
) -> _Attempt | None:
    """One run from one start; None if the model cannot be rolled out."""
    neutral = neutral_effect_parameter_values(effects)
    own = problem.with_effects_and_relinearized_filters(effects, start)
    for pull in (1.0, 0.5, 0.2, 0.05, 0.0):
        drawn = {name: value + pull * (start.get(name, value) - value) for name, value in neutral.items()}
        outcome = REFIT_SOLVER.minimize_cost(own, own.unknown_vector({**start, **drawn}), None)
        if outcome.status != Status.FAILED:
            break
    found = _seen(problem, effects, outcome)
    # without effects, all filters are fixed anew at the end of the run
    if found is None or not effects:
        return found
    filters = problem.problem.whitening_filters, found.problem.whitening_filters
    if torque_bias_change_in_stds(*filters) < _RELINEARIZE_Z:
        return found
    # with fixed torques, a run can stop with an effect and a redundant torque offset that block each other
    outcome = REFIT_SOLVER.minimize_cost(found.problem, outcome.x, None, _relinearizing(found.problem))
    return found if outcome.status == Status.FAILED else _cheaper(found, _seen(problem, effects, outcome))


def _relinearizing(problem: EstimationProblem) -> Callable[..., Evaluation]:
    """Evaluate with filters linearised about the torques at each point, starting from the previous filters."""

    def evaluate(
        x: Array, derivatives: bool = True, equilibrium_guesses: EquilibriumGuesses | None = None
    ) -> Evaluation:
        nonlocal problem
        problem = problem_relinearized_at_torque_bias(problem, x, x)
        return problem.evaluate(x, derivatives, equilibrium_guesses)

    return evaluate


def _seen(problem: AllCandidatesProblem, effects: Sequence[EffectBase], outcome: SolverResult) -> _Attempt | None:
    """The end of a run, linearised about the torques there."""
    placed = problem.with_effects_and_relinearized_filters(
        effects, problem.with_nominal_and_effects_free(effects).named_values(outcome.x)
    )
    finish = placed.evaluate(outcome.x, equilibrium_guesses=outcome.equilibrium_guesses)
    return _Attempt(placed, outcome, finish) if finish.ok else None


def _refit_covariance_factor(problem: EstimationProblem, finish: Evaluation, limits: Thresholds) -> Array:
    """Factor F (nx, nx) of the covariance F F' of the unknowns, inflated by the misfit as in `solve`."""
    factor = unknowns_covariance_factor(problem, finish)
    fit = assess_goodness_of_fit(problem, finish, limits.null_test_limits)
    std = np.sqrt(np.diag(misfit_robust_covariance(problem, finish, fit)))
    return factor * (std / np.linalg.norm(factor, axis=1))[:, None]


def _effect_p_values(effects: Sequence[EffectBase], names: Sequence[str], x: Array, factor: Array) -> dict[str, float]:
    """Wald test of each effect: all amplitudes together, at fixed shapes, because weak effects have any shape.

    A well-known load can be divided among amplitudes in any way, so that no single one differs from neutral. `factor` F
    gives the covariance F F'. Davies 1987, doi:10.1093/biomet/74.1.33.
    """
    found = {}
    for effect in effects:
        shapes, sized = (
            [names.index(n) for n in of] for of in (effect.shape_parameter_names, effect.amplitude_parameter_names)
        )
        away = x[sized] - [effect.neutral_values[names[i]] for i in sized]
        others = np.linalg.qr(factor[shapes].T)[0]
        rows = factor[sized] - factor[sized] @ others @ others.T
        scale = np.linalg.norm(rows, axis=1)
        whitened = np.linalg.lstsq(rows / scale[:, None], away / scale, rcond=None)[0]
        found[effect.label] = chi2_p_value(float(whitened @ whitened), len(sized))
    return found


def _mark_uninformative_std(effects: Sequence[EffectBase], std: Mapping[str, float]) -> dict[str, float]:
    """Standard deviations, infinite above `_UNINFORMATIVE_STD_RATIO` times the width of the prior range."""
    most = {n: _UNINFORMATIVE_STD_RATIO * (b - a) for effect in effects for n, (a, b) in effect.prior_ranges.items()}
    return {name: math.inf if size > most.get(name, math.inf) else size for name, size in std.items()}


def refit_with_each_effect(
    search: RefitContext,
    base: Sequence[EffectBase],
    tried: Sequence[tuple[Sequence[EffectBase], Mapping[str, float]]],
    values: Mapping[str, float],
    where: str = "",
) -> list[RefitStatistics]:
    """Refit the model with each of several effects, or pairs of effects, added to `base`. Failed refits are omitted.

    Each entry of `tried` holds the added effects and their initial parameters; `values` are the initial values of all
    other unknowns. `where` labels these initial values in the store of refits, so that refits of the same effects from
    other values remain distinct.
    """
    if not tried:
        return []
    beside = f" beside {', '.join(effect.label for effect in base)}" if base else ""
    noun, head = "effects" if len(tried[0][0]) == 1 else "pairs", ("effects", "held-out chi2/n")
    # one effect is often enough; otherwise pairs, more effects and replacements follow
    ahead = 11.0 if noun == "pairs" else {0: 8.0, 1: 14.0}.get(len(base), 9.0)
    search.progress.begin_stage(f"refitting with each of {len(tried)} {noun}{beside}", 2 + 0.5 * len(tried), ahead)
    parts = PartsDoneCounter(search.progress, len(tried), join_effect_labels(tried[0][0]))

    def one(entry: tuple[Sequence[EffectBase], Mapping[str, float]]) -> RefitStatistics | None:
        effects, label = (*base, *entry[0]), join_effect_labels(entry[0])
        name = f"{join_effect_labels(effects)} {where}" if where else ""
        fit = search.refit(effects, {**values, **entry[1]}, name)
        text = f"no fit with {label}"
        if fit is not None:
            how = "resumed the refit" if getattr(fit, "is_from_store", False) else "refitted"
            search.left_by[join_effect_labels(effects)] = left = f"{fit.held_out_loss.chi2_per_sample:.4g}"
            text = f"{how} with {label}: held-out chi2/n {left}"
        parts.count_done(text, lambda: [head, *sorted(search.left_by.items(), key=lambda entry: float(entry[1]))])
        return fit

    fits: list[RefitStatistics | None] = []
    rest, begun = list(tried), time.perf_counter()
    while rest and not search.record_skip_if_past_deadline(*(join_effect_labels(effects) for effects, _ in rest)):
        # a batch is cheaper than single refits; with a deadline, only as many as fit, best first
        count, now = len(rest), time.perf_counter()
        if search.deadline < math.inf:
            count = int((search.deadline - now) * len(fits) / max(now - begun, 1e-9)) if fits else 1
        batch, rest = rest[: max(count, 1)], rest[max(count, 1) :]
        fits += map_with_merged_calls(one, batch)
    return [fit for fit in fits if fit is not None]


def _block_duration(episodes: Sequence[Episode]) -> float:
    """Length of the held-out time blocks [s]: about forty blocks of 0.5 s to 2 s."""
    total = sum(episode.grid.steps * episode.grid.time_step for episode in episodes)
    return float(np.clip(total / 40, 0.5, 2.0))


def _held_out_loss(problem: EstimationProblem, x: Array) -> HeldOutLoss:
    """Loss of a model on the held-out recordings; initial states are found in the same way for every model."""
    length, found = _block_duration(problem.held_out), problem.predict_held_out(x)
    squares: list[Array] = []
    counts: list[Array] = []
    for i, (episode, result) in enumerate(found):
        number = int(episode.grid.steps * episode.grid.time_step / length) + 1
        blocks = []
        for samples in episode.measurements:
            used, block = samples.positive_weight_mask, times_since_recording_start(episode, samples) / length
            block = np.minimum(block.astype(int), number - 1).reshape(len(block), -1)
            blocks.append(np.broadcast_to(block, used.shape)[used])
        of_row = np.concatenate(blocks)
        count = np.bincount(of_row, minlength=number).astype(float)
        if isinstance(result, str):
            total = np.full(number, np.inf)
        else:
            rows = problem.whitened_held_out_prediction_residual(i, episode, result).residual
            total = np.bincount(of_row, weights=rows**2, minlength=number)
        squares.append(total[count > 0])
        counts.append(count[count > 0])
    if problem.has_process_noise:
        # errors in metres and radians are those of predictions from recorded torques minus offsets
        found = problem_with_sensor_noise_only(problem).predict_held_out(x)
    channels, contradiction = held_out_rmse_and_unit_by_channel(found), _contradiction(problem, x)
    return HeldOutLoss(np.concatenate(squares), np.concatenate(counts), channels, contradiction)


def held_out_rmse_and_unit_by_channel(
    found: Sequence[tuple[Episode, EpisodePrediction | str]],
) -> dict[str, tuple[float, str]]:
    """Root mean square error and unit of each channel over the predicted held-out recordings."""
    predicted = [(result, episode) for episode, result in found if not isinstance(result, str)]
    errors = rmse_unit_and_count_by_channel(*map(list, zip(*predicted, strict=True))) if predicted else {}
    return {name: (float(entry["rmse"]), str(entry["unit"])) for name, entry in errors.items()}


def _contradiction(problem: EstimationProblem, x: Array) -> float:
    """Sum of squares of the joint prior's residuals."""
    joint = problem.options.multivariate_prior.restricted_to(problem.shared_parameters)
    at = [problem.unknown_names.index(name) for name in joint.parameter_names]
    apart = (x - problem.initial_unknowns)[at]
    return float(apart @ np.linalg.solve(joint.covariance, apart)) if at else 0.0

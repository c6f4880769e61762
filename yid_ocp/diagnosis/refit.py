"""Refits of the nominal parameters together with effects, and their errors on held-out recordings."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem, join_effect_labels, neutral_effect_parameter_values
from yid_ocp.diagnosis.screening import EMPTY_SCREENING_RESULT, ScoredCandidatePair, ScreeningResult, screen_candidates
from yid_ocp.diagnosis.thresholds import DEFAULT_THRESHOLDS, Thresholds
from yid_ocp.display import NULL_PROGRESS, PartsDoneCounter, Progress, count_with_noun
from yid_ocp.effects import EffectBase
from yid_ocp.errors import SolverError
from yid_ocp.inference import null_test, whitening
from yid_ocp.inference.uncertainty import assess_goodness_of_fit, misfit_robust_covariance, noise_only_covariance_sqrt
from yid_ocp.parallel import map_in_threads, map_with_merged_calls
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.evaluation import EquilibriumGuesses, Evaluation
from yid_ocp.solvers import Status
from yid_ocp.solvers.base import SolverResult

_SECANT_STDS = 0.4  # half the length of secants, in stds of the unknowns: longer than the steps of a rough cost
_Answer = TypeVar("_Answer")
_UNINFORMATIVE_STD_RATIO = 100.0  # std over prior range from which a parameter counts as not informed
_MAX_RECORDED_PAIRS = 48  # of candidates; all further pairs predict a smaller decrease than the refitted pairs
_MIN_LEFT_OUT_FOR_OWN_STEP = 800  # candidates, times refits, times recordings, which repay a step's compilation
_RELINEARIZE_Z = 1.0  # stated standard deviations of a torque's offset: an effect that takes more is fitted once more


@dataclass(frozen=True)
class StoredFit:
    """The stored values and standard deviations of a refit. One evaluation restores a `RefittedModel` from them."""

    values: dict[str, float]  # values of all unknowns
    std: dict[str, float]  # inflated by the misfit as in `solve`; infinite if not informed by the data
    p_values: dict[str, float]  # by effect: p-value of its amplitudes, at fixed shape parameters


RefitStore = MutableMapping[str, StoredFit]
"""Finished refits by name. Two threads use it."""


@dataclass(frozen=True)
class RefitStatistics(StoredFit):
    """The result of a refit without its estimation problem: effects, estimates, cost and held-out errors."""

    effects: tuple[EffectBase, ...]
    cost: float
    held_out_loss: null_test.HeldOutLoss
    residual_count: int  # number of residuals of the estimation recordings, priors included

    def statistics(self) -> RefitStatistics:
        """Return the statistics of the refit without its problem and evaluation, which saves memory."""
        return RefitStatistics(**{own.name: getattr(self, own.name) for own in fields(RefitStatistics)})

    @property
    def excess_chi2(self) -> float:
        """The excess of r'r of the estimation recordings over the number of residuals, which noise alone gives."""
        return 2 * self.cost - self.residual_count

    @property
    def total_effect_parameter_count(self) -> int:
        """The number of parameters of all effects in the model together."""
        return sum(len(effect.parameters) for effect in self.effects)

    def implausible_parameters(self, effect: EffectBase, limits: Thresholds) -> list[str]:
        """List the parameters of an effect that are far outside their prior range, by a width or a factor."""
        room = limits.prior_range_margin_in_widths

        def is_outside(name: str, low: float, high: float) -> bool:
            unsure, width = limits.min_z * self.std.get(name, 0.0), room * (high - low)
            least = low / (1 + room) if low > 0 else low - width
            return not least - unsure <= self.values[name] <= high + width + unsure

        return [name for name, ends in effect.prior_ranges.items() if is_outside(name, *ends)]

    def determines_size(self, effect: EffectBase, min_z: float) -> bool:
        """Check whether an amplitude of an effect differs from its neutral value by more than `min_z` stds."""
        names, neutral = effect.amplitude_parameter_names, effect.neutral_values
        return any(abs(self.values[n] - neutral[n]) > min_z * self.std.get(n, 0.0) for n in names)


@dataclass(frozen=True)
class RefittedModel(RefitStatistics):
    """The nominal model after a refit with some effects, stored as a problem with its evaluation."""

    problem: EstimationProblem  # composed system; free nominal parameters and parameters of the effects
    evaluation: Evaluation

    @property
    def unknowns(self) -> Array:
        """The fitted values of the problem's unknowns, shape (nx,)."""
        return self.problem.pack_unknowns(self.values)

    @property
    def at_estimates(self) -> tuple[EstimationProblem, Array, Evaluation]:
        """The problem, the fitted values of its unknowns, shape (nx,), and its evaluation there."""
        return self.problem, self.unknowns, self.evaluation


@dataclass(frozen=True)
class EffectSearchRecord:
    """A record of all results that a search for effects used, by name. Other rules can reuse them without refits."""

    refits: dict[str, RefitStatistics | None] = field(default_factory=dict)  # None if the fit failed
    screenings: dict[str, ScreeningResult] = field(default_factory=dict)  # by name; next to effects in the model
    pairs: dict[str, list[ScoredCandidatePair]] = field(default_factory=dict)  # by the label of the excluded effect


@dataclass(frozen=True)
class RefitContext:
    """The problem, thresholds, progress, store and deadline of a diagnosis. It makes the refits that rules request."""

    problem: AllCandidatesProblem
    thresholds: Thresholds = DEFAULT_THRESHOLDS
    progress: Progress = NULL_PROGRESS
    store: RefitStore = field(default_factory=dict)
    deadline: float = math.inf  # value of `time.perf_counter` after which no further refit starts [s]
    n_batched: int = 1  # rollouts of a refit: its recordings, or 0 if batches do not pay and waiting fits fill memory
    skipped: list[str] = field(default_factory=list)  # skipped steps, shared by all copies of this context
    record: EffectSearchRecord = field(default_factory=EffectSearchRecord)  # likewise
    stage_ends: dict[str, float] = field(default_factory=dict)  # values of `time.perf_counter` by stage, likewise
    rounds: list[tuple[tuple[EffectBase, ...], int]] = field(default_factory=list)  # effects, number of refits
    # called with the fit of the first effect before others are tried beside it, and with the fall of r'r they promise
    check_discretisation: Callable[[RefitStatistics, float], object] = lambda fit, gap: None

    def record_stage_end_time(self, name: str) -> None:
        """Record that a stage ends now."""
        self.stage_ends[name] = time.perf_counter()

    def is_skipped_past_deadline(self, *what: str) -> bool:
        """Check whether the deadline for refits has passed. If so, `what` is recorded as skipped."""
        is_late = time.perf_counter() >= self.deadline
        if is_late:
            self.skipped.extend(what)
        return is_late

    def refit(self, effects: Sequence[EffectBase], start: Mapping[str, float], name: str) -> RefitStatistics | None:
        """Refit the model with the given effects. None if no simulation succeeds. `name` distinguishes the starts."""
        how = effects, start, name
        return self._answer(self.record.refits, name, lambda: refit_with_effects(self._of_round(effects), *how))

    def refit_on_held_out(self, fit: RefitStatistics) -> RefitStatistics | None:
        """Fit the effects of `fit` again, on the held-out recordings. None if that is not possible."""
        name = f"{join_effect_labels(fit.effects)} on the held-out recordings"

        def turned() -> RefittedModel | None:
            if self.problem.is_split_in_blocks:
                return None
            self.progress.begin_stage("fitting the same effects to the held-out recordings", 1.0, 5.5)
            composed = self._of_round(fit.effects).problem
            problem = composed.problem
            exchanged = problem.with_episodes(problem.held_out, problem.episodes)
            # parameters shared by both sets of recordings, without initial states
            names = (*problem.free, *(name for effect in fit.effects for name in effect.parameters.names))
            start = {name: fit.values[name] for name in fit.values.keys() & names}
            composed = replace(composed, problem=exchanged, held_out_spread=None)
            whitened = composed.with_whitening_linearized_at(fit.values, fit.effects)
            return refit_with_effects(replace(self, problem=whitened), fit.effects, start, name)

        return self._answer(self.record.refits, name, turned)

    def _of_round(self, effects: Sequence[EffectBase]) -> RefitContext:
        """The context with the effects of the first round that has all the given ones, or with all candidates."""
        problem = self.problem.problem
        for own, count in self.rounds:
            left_out = count * len(problem.episodes) * (len(problem.system.effects) - len(own))
            has_all = {effect.label for effect in effects} <= {effect.label for effect in own}
            if has_all and left_out >= _MIN_LEFT_OUT_FOR_OWN_STEP:
                return replace(self, problem=self.problem.with_step_of_only_effects(own))
        return self

    def screen(self, base: Sequence[EffectBase], values: Mapping[str, float], name: str) -> ScreeningResult:
        """Test all candidates as additions to the effects in `base`. `name` says which fit provides `values`.

        There are no candidates if the model with all of them cannot be simulated at these values.
        """

        def screened() -> ScreeningResult:
            with contextlib.suppress(SolverError):
                return screen_candidates(self.problem, base, values)
            return EMPTY_SCREENING_RESULT

        return self._answer(self.record.screenings, name, screened)

    def rank_candidate_pairs(self, screened: ScreeningResult, without: str) -> list[ScoredCandidatePair]:
        """Rank the most promising pairs of candidates, except the label `without`. See `_MAX_RECORDED_PAIRS`."""
        ranked = screened.rank_candidate_pairs
        return self._answer(self.record.pairs, without, lambda: ranked(without)[:_MAX_RECORDED_PAIRS])

    def _answer(self, answers: dict[str, Any], name: str, work: Callable[[], _Answer]) -> _Answer:
        found = work()
        # a model's rollouts would fill the memory
        answers.setdefault(name, found.statistics() if isinstance(found, RefittedModel) else found)
        return found


EffectsWithStart = tuple[Sequence[EffectBase], Mapping[str, float]]  # effects to refit, and their values at the start
_Attempt = tuple[EstimationProblem, SolverResult, Evaluation]
"""Problem with filters linearised about the torques at the end of a run, the run, and the evaluation at its end."""


def refit_with_effects(
    search: RefitContext, effects: Sequence[EffectBase], start: Mapping[str, float], name: str = ""
) -> RefittedModel | None:
    """Fit nominal and effect parameters together, then predict held-out recordings. None if no rollout succeeds.

    `start` holds the initial unknowns. If the rollout fails there, they are moved towards neutral effects. `name` and
    the time step are the name in the store of refits.
    """
    problem, limits = search.problem, search.thresholds
    name = f"{name} at {problem.problem.step.time_step:g} s"
    if stored := search.store.get(name):
        placed, at_stored = _evaluated(problem, effects, stored.values)
        if at_stored.ok:
            return _model(stored, effects, placed, at_stored, problem.held_out_spread)
    runs = [_attempt(problem, effects, start)]
    _, _, end = runs[0]
    if not (end.ok and null_test.chi2_p_value(2 * end.cost, len(end.residual)) >= limits.significance_level):
        # earlier effects were already tried from both starts
        moved = filter(None, (effect.alternative_start(start) for effect in effects[-1:]))
        runs += [_attempt(problem, effects, {**start, **values}) for values in moved]
    own, outcome, finish = min(runs, key=lambda run: run[-1].cost)
    if not finish.ok:
        return None
    values = own.unknowns.named_values(outcome.x)
    own = problem.relinearize_held_out_filters_of_problem(own, effects, values)
    factor = _refit_covariance_factor(own, finish, limits)
    if outcome.status == Status.STALLED and finish.cost > len(finish.residual):  # chi2 per sample is above 2
        factor = _refit_covariance_factor(own, _with_secants(own, finish, outcome.x, factor), limits)
    ranges = ((name, *ends) for effect in effects for name, ends in effect.prior_ranges.items())
    most = {name: _UNINFORMATIVE_STD_RATIO * (high - low) for name, low, high in ranges}
    sizes = own.unknowns.named_values(np.linalg.norm(factor, axis=1))
    std = {name: math.inf if size > most.get(name, math.inf) else size for name, size in sizes.items()}
    found = StoredFit(values, std, _effect_p_values(effects, own.unknown_names, outcome.x, factor))
    search.store[name] = found
    return _model(found, effects, own, finish, problem.held_out_spread)


def _evaluated(
    problem: AllCandidatesProblem, effects: Sequence[EffectBase], values: Mapping[str, float]
) -> tuple[EstimationProblem, Evaluation]:
    """The problem with effects at known values, and its evaluation there."""
    own = problem.problem_with_effects_and_relinearized_filters(effects, values)
    finish = own.evaluate(own.pack_unknowns(values))
    return problem.relinearize_held_out_filters_of_problem(own, effects, values), finish


def reevaluate_refit_with_all_candidates(problem: AllCandidatesProblem, fit: RefittedModel) -> RefittedModel:
    """Evaluate a refit again at its estimates, with the step of all candidates. Its other results are kept."""
    if fit.problem.step is problem.problem.step:
        return fit
    own, finish = _evaluated(problem, fit.effects, fit.values)
    return replace(fit, problem=own, evaluation=finish, cost=finish.cost) if finish.ok else fit


def _model(
    known: StoredFit, effects: Sequence[EffectBase], own: EstimationProblem, end: Evaluation, spread: Array | None
) -> RefittedModel:
    x, factor = own.pack_unknowns(known.values), noise_only_covariance_sqrt(own, end)
    loss, kept = null_test.held_out_loss(own, x, factor, spread), (known.values, known.std, known.p_values)
    return RefittedModel(*kept, tuple(effects), end.cost, loss, len(end.residual), own, end)


def _attempt(problem: AllCandidatesProblem, effects: Sequence[EffectBase], start: Mapping[str, float]) -> _Attempt:
    """One run from one start; its evaluation is not `ok` if the model cannot be rolled out."""
    neutral, solver = neutral_effect_parameter_values(effects), problem.refit_solver
    own = problem.problem_with_effects_and_relinearized_filters(effects, start)
    for pull in (1.0, 0.5, 0.2, 0.05, 0.0):
        drawn = {name: value + pull * (start.get(name, value) - value) for name, value in neutral.items()}
        outcome = solver.minimize_cost(own, own.pack_unknowns({**start, **drawn}), None)
        if outcome.status != Status.FAILED:
            break
    while outcome.status == Status.ITERATION_LIMIT and outcome.history[-1].cost < outcome.history[-6:][0].cost / 2:
        # from far away, the cost still falls fast at the limit
        outcome = solver.minimize_cost(own, outcome.x, None)
    if not own.has_process_noise and outcome.evaluation is not None:
        return own, outcome, outcome.evaluation  # there are no filters to linearise
    found = _seen(problem, effects, outcome)
    moving, _, end = found
    before, after = problem.problem.whitening_filters, moving.whitening_filters
    # without effects, all filters are fixed anew at the end of the run
    if not effects or not end.ok or whitening.max_torque_bias_change_in_stds(before, after) < _RELINEARIZE_Z:
        return found

    def evaluate(
        x: Array, derivatives: bool = True, equilibrium_guesses: EquilibriumGuesses | None = None
    ) -> Evaluation:
        nonlocal moving
        moving = whitening.problem_relinearized_at_torque_bias(moving, x, x)
        return moving.evaluate(x, derivatives, equilibrium_guesses)

    # with fixed torques, a run can stop with an effect and a redundant torque offset that block each other
    again = _seen(problem, effects, solver.minimize_cost(moving, outcome.x, None, evaluate))
    return min(found, again, key=lambda run: run[-1].cost)


def _seen(problem: AllCandidatesProblem, effects: Sequence[EffectBase], outcome: SolverResult) -> _Attempt:
    """The end of a run, linearised about the torques there."""
    values = problem.problem_with_nominal_and_effects_free(effects).unknowns.named_values(outcome.x)
    placed = problem.problem_with_effects_and_relinearized_filters(effects, values)
    return placed, outcome, placed.evaluate(outcome.x, equilibrium_guesses=outcome.equilibrium_guesses)


def _refit_covariance_factor(problem: EstimationProblem, finish: Evaluation, limits: Thresholds) -> Array:
    """Factor F (nx, nx) of the covariance F F' of the unknowns, inflated by the misfit as in `solve`."""
    factor = noise_only_covariance_sqrt(problem, finish)
    fit = assess_goodness_of_fit(problem, finish, limits.null_test_excess_criteria)
    std = np.sqrt(np.diag(misfit_robust_covariance(problem, finish, fit)))
    return factor * (std / np.linalg.norm(factor, axis=1))[:, None]


def _with_secants(problem: EstimationProblem, at: Evaluation, x: Array, factor: Array) -> Evaluation:
    """An evaluation with secants over a part of a std in place of derivatives, if all their ends can be evaluated.

    Where friction holds a joint, the cost has small steps. Derivatives then differ from point to point, secants do not.
    """
    ends = [np.clip(x + sign * _SECANT_STDS * factor.T, *problem.bounds) for sign in (1.0, -1.0)]
    found = [[problem.evaluate(end, False, at.equilibrium_guesses) for end in points] for points in ends]
    if not all(point.ok for points in found for point in points):
        return at
    upper, lower = (np.array([point.residual for point in points]) for points in found)
    return replace(at, jacobian=np.linalg.lstsq(ends[0] - ends[1], upper - lower, rcond=None)[0].T)


def _effect_p_values(effects: Sequence[EffectBase], names: Sequence[str], x: Array, factor: Array) -> dict[str, float]:
    """Wald test of each effect: all amplitudes together, at fixed shapes, because weak effects have any shape.

    A well-known load can be divided among amplitudes in any way, so that no single one differs from neutral. `factor` F
    gives the covariance F F'. Davies 1987, doi:10.1093/biomet/74.1.33.
    """
    found = {}
    for effect in effects:
        shapes = [names.index(name) for name in effect.shape_parameter_names]
        sized = [names.index(name) for name in effect.amplitude_parameter_names]
        away = x[sized] - [effect.neutral_values[names[i]] for i in sized]
        others = np.linalg.qr(factor[shapes].T)[0]
        rows = factor[sized] - factor[sized] @ others @ others.T
        scale = np.linalg.norm(rows, axis=1)
        whitened = np.linalg.lstsq(rows / scale[:, None], away / scale, rcond=None)[0]
        found[effect.label] = null_test.chi2_p_value(float(whitened @ whitened), len(sized))
    return found


def refit_with_each_effect(
    search: RefitContext,
    base: Sequence[EffectBase],
    tried: Sequence[EffectsWithStart],
    values: Mapping[str, float],
    where: str = "",
) -> list[RefitStatistics]:
    """Refit the model once for each effect, or pair of effects, added to `base`. Failed refits are omitted.

    A refit that cannot predict the held-out recordings has failed. Each entry of `tried` holds the added effects and
    their initial parameters; `values` are the initial values of all other unknowns, and `where` is their name.
    """
    if not tried:
        return []
    head, added = ("effects", "held-out chi2/n"), count_with_noun(len(tried), ("effect", "pair")[len(tried[0][0]) - 1])
    text = f"refitting {join_effect_labels(base)} with {'each of ' * (len(tried) > 1)}{added}"
    # one effect is often enough; otherwise pairs, more effects and replacements follow
    search.progress.begin_stage(text, 2 + 0.5 * len(tried), (10.0, 16.0, 11.0)[min(len(base), 2)])
    parts = PartsDoneCounter(search.progress, len(tried), join_effect_labels(tried[0][0]))

    def table() -> list[tuple[str, str]]:
        known = {name: fit.held_out_loss.chi2_per_sample for name, fit in [*search.record.refits.items()] if fit}
        return [head, *((name, f"{left:.4g}") for name, left in sorted(known.items(), key=lambda entry: entry[1]))]

    def one(entry: EffectsWithStart) -> RefitStatistics | None:
        effects, label = (*base, *entry[0]), join_effect_labels(entry[0])
        fit = search.refit(effects, {**values, **entry[1]}, f"{join_effect_labels(effects)} {where}".strip())
        left = "failed" if fit is None else f"{fit.held_out_loss.chi2_per_sample:.4g} (best so far: {table()[1][1]})"
        parts.count_done(f"held-out chi2/n with {label}: {left}", table)
        return fit

    together = {effect.label: effect for effects, _ in tried for effect in (*base, *effects)}
    search.rounds.append((tuple(together.values()), len(tried)))
    fits: list[RefitStatistics | None] = []
    # a batch is cheaper than single refits, which a deadline needs
    size = len(tried) if search.deadline == math.inf else 1
    merged = partial(map_with_merged_calls, questions_per_item=search.n_batched)
    at_once = merged if search.n_batched else map_in_threads
    for i in range(0, len(tried), size):
        if search.is_skipped_past_deadline(*(f"{join_effect_labels(own)} {where}".strip() for own, _ in tried[i:])):
            break
        fits += at_once(one, tried[i : i + size])
    return [fit for fit in filter(None, fits) if math.isfinite(fit.held_out_loss.total_chi2)]

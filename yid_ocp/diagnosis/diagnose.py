"""Run all steps of a diagnosis of the sim-to-real gap, from the nominal fit to the verdict."""

from __future__ import annotations

import functools
import itertools
import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import threadpoolctl

from yid_ocp.analysis.discretisation import predicted_refit_residual_at_finer_step
from yid_ocp.analysis.estimate_history import RunEstimates
from yid_ocp.arrays import Array
from yid_ocp.data.recording import Recording
from yid_ocp.diagnosis.baseline import EarlierRunsBaseline, add_baseline_prior
from yid_ocp.diagnosis.diagnosis_result import (
    DiagnosisResult,
    diagnosis_summary_text,
    held_out_truncation_message,
    recommended_experiment_text,
)
from yid_ocp.diagnosis.events import NO_EVENTS, EventSet, find_force_and_fault_events, problem_corrected_for_events
from yid_ocp.diagnosis.hypotheses import (
    SIMULATED_DURATION_FRACTIONS_TO_KEEP,
    AllCandidatesProblem,
    CandidateNamesOrAll,
    TruncatedHeldOutRecording,
    exclude_candidates,
    join_effect_labels,
    make_candidate_effects,
)
from yid_ocp.diagnosis.law import GapLaw, find_gap_law
from yid_ocp.diagnosis.refit import (
    FinerStepRefitStore,
    NominalSolutionAndRefitStore,
    RefitContext,
    RefitStore,
    RefittedModel,
    StoredFit,
    load_stored_refit,
    refit_in_all_candidates_step,
    refit_with_effects,
)
from yid_ocp.diagnosis.screening import CandidateScore, screen_candidates
from yid_ocp.diagnosis.thresholds import DEFAULT_THRESHOLDS, Thresholds
from yid_ocp.diagnosis.verdict import GapLocalization, Judgement, NominalModelGapEvidence, judge
from yid_ocp.display import NULL_PROGRESS, LoggingProgress, Progress
from yid_ocp.errors import DataError, SolverError, failed_rollout_error
from yid_ocp.inference.null_test import (
    NullTestResult,
    assumed_channel_noise_levels,
    encoder_noise_residual_factor,
    residual_channels,
    residual_chi2_null_test,
    residuals_exceed_noise,
    whiten_with_extra_errors,
)
from yid_ocp.inference.smoother import (
    GapLocation,
    SmoothedUnknownsResult,
    gap_locations_by_smoother_evidence,
    gap_locations_from_effect_closures,
    merge_time_intervals,
    select_and_smooth_unknowns,
)
from yid_ocp.inference.uncertainty import unknowns_covariance_factor
from yid_ocp.inference.whitening import problem_with_sensor_noise_only, problem_with_whitening_at
from yid_ocp.parallel import map_with_merged_calls
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.measurements import subtract_estimated_biases
from yid_ocp.solvers import GaussNewton, Solution, solve
from yid_ocp.solvers.base import INITIAL_VALUE_RESTART_FACTORS

log = logging.getLogger(__name__)

_SAME_WEIGHTS_STDS = 0.05  # change of a fit in stds from which its whitening is repeated
_MAX_EVENT_ROUNDS = 3  # maximum number of refits of the nominal model, each without the events found before it


def diagnose(
    problem: EstimationProblem,
    candidates: CandidateNamesOrAll = "all",
    held_out: Sequence[Recording] = (),
    *,
    thresholds: Thresholds | None = None,
    progress: Progress | None = None,
    known_fits: NominalSolutionAndRefitStore | None = None,
    baseline: RunEstimates | Sequence[RunEstimates] | EarlierRunsBaseline = (),
    exclude: Sequence[str] = (),
) -> DiagnosisResult:
    """Diagnose the gap between model and recordings: whether it exists, where, its causes, and what closes it.

    Raises `ConfigError` or `ModelError` if a candidate does not fit the system, `DataError` if a held-out recording is
    also estimated on or there is no noise level, and `SolverError` if the nominal model cannot be rolled out or its
    residual is not whitened.

    Parameters
    ----------
    problem : EstimationProblem
        Problem of the nominal model, with free stiffnesses.
    candidates, exclude : "all" or sequence of str
        Effects to try, and exceptions from these, as `kind` or `kind@location`.
    held_out : sequence of Recording
        Recordings that no fit uses. Default: those of the problem. Without any, alternate blocks are held out.
    progress : Progress, optional
        Default: the package's log.
    baseline : RunEstimates or sequence of RunEstimates, or EarlierRunsBaseline, optional
        Estimates of earlier runs of the same model (`read_estimates`), used as priors, so that changes since then are
        diagnosed. A problem that already has these priors (`add_baseline_prior`) is used as it is. An
        `EarlierRunsBaseline` can also hold reference recordings made without the sought effects; these are predicted
        with the found effects removed.

    Returns
    -------
    DiagnosisResult
        Verdict, effects with parameters in their own units, and fractions of the gap [1]; `to_dict` has all with units.
    """
    with threadpoolctl.threadpool_limits(1):  # threads cost more than they save for small matrices
        clock = {"": time.perf_counter()}
        told = progress or LoggingProgress(log)
        known = known_fits or NominalSolutionAndRefitStore()
        runs = (baseline,) if isinstance(baseline, RunEstimates) else baseline
        earlier = runs if isinstance(runs, EarlierRunsBaseline) else EarlierRunsBaseline.from_runs(runs, ())
        if earlier.combined_estimates is not None and not problem.options.multivariate_prior.parameter_names:
            problem = add_baseline_prior(problem, earlier.combined_estimates)
        composed = _composed(problem, candidates, exclude, held_out, told)
        clock["compose"] = time.perf_counter()
        limits = thresholds or DEFAULT_THRESHOLDS
        search = RefitContext(composed, limits, told, known.store, clock[""] + (limits.budget or math.inf))
        return _diagnosed(problem, _examined(problem, search, known.solution, clock), earlier, clock)


@dataclass(frozen=True)
class _Examined:
    """The nominal model on data without events: fit, null tests, screening, and whether there is a gap."""

    search: RefitContext  # the weights of all hypotheses frozen at the fit
    nominal: RefittedModel
    truncated: tuple[TruncatedHeldOutRecording, ...]
    whole: EstimationProblem  # the problem with all samples
    events: EventSet
    smoothed: SmoothedUnknownsResult | None  # about the fit, on all recordings, if it was run
    evidence: NominalModelGapEvidence
    stated_and_finer_time_step: tuple[float, float] | None = None  # if the error of the stated step was part of the gap

    @property
    def is_search_worthwhile(self) -> bool:
        """Whether there is a gap, and enough samples to determine its cause."""
        limits = self.search.thresholds
        return self.evidence.has_gap(limits) and self.evidence.has_enough_samples(limits)


def _examined(
    problem: EstimationProblem, search: RefitContext, solution: Solution | None, clock: dict[str, float]
) -> _Examined:
    limits, stated = search.thresholds, problem.step.time_step
    search.progress.begin_stage("fitting the nominal model", 3.0, 10.5)
    nominal = fit_nominal_model(problem, search.problem, solution, search.store, limits)
    # neither events nor candidates are sought while the step makes most of the gap
    while finer := _at_finer_step_that_explains_gap(search, nominal):
        search, nominal = finer
    problem = problem.with_time_step(nominal.problem.step.time_step)
    search, nominal, cuts = _followed(search, nominal)
    clock["nominal"] = time.perf_counter()
    found = _examined_about_fit(problem, search, nominal, cuts, clock)
    while found.is_search_worthwhile:
        ranked, own = found.evidence.screening.candidate_scores, found.search
        own = replace(own, problem=replace(own.problem, candidate_effects=search.problem.candidate_effects))
        if (finer := _at_finer_step_that_explains_gap(own, found.nominal, found.events, ranked)) is None:
            break
        problem = problem.with_time_step(finer[1].problem.step.time_step)
        found = _examined_about_fit(problem, *_followed(*finer, found.truncated), clock)
    little = 1 + limits.min_excess_chi2_per_dof
    poor = found.is_search_worthwhile and found.evidence.nominal_test.chi2_per_dof < little
    may_restart = poor and not search.record_skip_if_past_deadline("the nominal model from other starts")
    if may_restart and (other := _better_nominal_fit(found.search, found.nominal)) is not None:
        # the smoother's result belongs to another fit
        found = _tested(*_followed(found.search, other, found.truncated), found.whole, found.events, None)
    clock["other_starts"] = time.perf_counter()
    used = found.nominal.problem.step.time_step
    return found if used == stated else replace(found, stated_and_finer_time_step=(stated, used))


def _examined_about_fit(
    problem: EstimationProblem,
    search: RefitContext,
    nominal: RefittedModel,
    cuts: tuple[TruncatedHeldOutRecording, ...],
    clock: dict[str, float],
) -> _Examined:
    """Remove events found with a nominal fit, then run null tests and screening."""
    search.progress.begin_stage("looking for events", 2.0, 8.5)
    whole = _undivided(search.problem, problem)
    search, nominal, events, smoothed = _without_events(search, nominal, whole)
    clock["events"] = time.perf_counter()
    found = _tested(search, nominal, cuts, whole, events, smoothed)
    clock["screening"] = time.perf_counter()
    return found


def _diagnosed(
    problem: EstimationProblem, seen: _Examined, earlier: EarlierRunsBaseline, clock: dict[str, float]
) -> DiagnosisResult:
    search, nominal, evidence = seen.search, seen.nominal, seen.evidence
    limits, held = search.thresholds, evidence.nominal_held_out_test
    evidence = replace(evidence, has_left_baseline=earlier.fit_parameters_differ_significantly(nominal, limits))
    smoothed: SmoothedUnknownsResult | None = None

    def locate() -> GapLocalization:
        nonlocal smoothed
        search.progress.begin_stage("locating the gap", 1.0, 8.5)
        # without events, the smoother already ran on all fitted data
        known = None if search.problem.is_split_in_blocks else seen.smoothed
        smoothed = _smooth_about_model(nominal, limits) if known is None else known
        by_chance = smoothed.dof_before - smoothed.dof_after
        places = gap_locations_by_smoother_evidence(smoothed, limits.location_z)
        return GapLocalization(places, smoothed.chi2_before - smoothed.chi2_after - by_chance)

    located = functools.cache(locate)

    def finished(stage: str) -> None:
        clock[stage] = time.perf_counter()

    judged = judge(search, evidence, located, finished)
    where = () if smoothed is None else located().locations
    accepted, final = judged.accepted_selections, nominal
    if accepted:
        assert isinstance(accepted[-1].refitted_model, RefittedModel)
        final = refit_in_all_candidates_step(search.problem, accepted[-1].refitted_model)
        judged = replace(judged, selected_effects=(*accepted[:-1], replace(accepted[-1], refitted_model=final)))
    remaining, rest = held, where
    if accepted:
        remaining, where, rest = _after(evidence.nominal_test, final, where, judged, limits)
    law = _law(problem, seen, judged.verdict, final, rest)
    finished("law")
    # a disturbance that a better model explains was no event
    events = _happened(seen.whole, final, limits)[0] if accepted else seen.events
    finished("remaining")
    finding = DiagnosisResult(
        **(vars(evidence) | vars(judged)),
        noise_floor=assumed_channel_noise_levels(nominal.problem),
        located_gap=None if smoothed is None else located(),
        record=search.record,
        smoother_result=smoothed,
        gap_locations=where,
        remaining_test=remaining,
        remaining_gap_locations=rest,
        held_out_names=tuple(episode.name for episode in nominal.problem.held_out),
        is_split_in_blocks=search.problem.is_split_in_blocks,
        thresholds=limits,
        truncated_recordings=seen.truncated,
        stage_seconds={name: clock[name] - clock[last] for last, name in itertools.pairwise(clock)},
        events=events,
        baseline_comparison=earlier.compare_with_baseline(final, limits),
        counterfactual=earlier.counterfactual_prediction_errors(nominal, final, search.progress),
        untried=tuple(dict.fromkeys(search.skipped)),
        stated_and_finer_time_step=seen.stated_and_finer_time_step,
        search_seconds=clock["refits"] - clock[""],
        law=law,
    )
    finding = replace(finding, next_experiment=recommended_experiment_text(finding))
    return replace(finding, summary=diagnosis_summary_text(finding))


def _law(
    problem: EstimationProblem, seen: _Examined, verdict: str, final: RefittedModel, where: Sequence[GapLocation]
) -> GapLaw | None:
    """The law of the remaining gap, if no effect explains it or the accepted effects leave a gap."""
    if verdict != "unknown" and not (final.effects and where):
        return None
    places = [name for place in where for name in (place.location, *place.indistinguishable_from)]
    if seen.stated_and_finer_time_step is not None:
        problem = problem.with_time_step(seen.stated_and_finer_time_step[1])
    return find_gap_law(seen.search, problem, final, places, seen.events)


def _at_finer_step_that_explains_gap(
    search: RefitContext, fit: RefittedModel, events: EventSet = NO_EVENTS, ranked: Sequence[CandidateScore] = ()
) -> tuple[RefitContext, RefittedModel] | None:
    """Hypotheses and nominal fit at half the step, if it explains half of the best candidate's decrease or of all."""
    h, residual = fit.problem.step.time_step / 2, fit.evaluation.residual
    excess = float(residual @ residual) - np.count_nonzero(residual)
    gap = max((score.predicted_chi2_decrease for score in ranked), default=excess)
    if not ranked and excess < search.thresholds.min_excess_chi2_per_dof * len(residual):
        return None
    search.progress.begin_stage("trying half the time step", 1.0, 8.5)
    finer, x = search.problem.with_time_step(h), fit.problem.unknown_vector(fit.values)
    fine = problem_corrected_for_events(finer.problem, events)
    left = predicted_refit_residual_at_finer_step(fine, fit.problem, x, fit.evaluation)
    if left is None or excess - (rest := float(left @ left) - np.count_nonzero(left)) <= gap / 2:
        return None
    search.progress.begin_stage(f"half the time step lowers chi2 by {excess - rest:.3g}: going on at {h:g} s")
    store = None if search.store is None else FinerStepRefitStore(search.store, h)
    search = replace(search, problem=finer, store=store)
    return None if (again := _settled(search, fit.values, "")) is None else (search, again)


def _undivided(composed: AllCandidatesProblem, problem: EstimationProblem) -> EstimationProblem:
    """The composed problem with all samples, even if a diagnosis divides a single recording in blocks."""
    pairs = zip(composed.problem.episodes, problem.episodes, strict=True)
    episodes = [replace(episode, measurements=own.measurements) for episode, own in pairs]
    return composed.problem.with_episodes(episodes, () if composed.is_split_in_blocks else composed.problem.held_out)


def _happened(
    whole: EstimationProblem, fit: RefittedModel, limits: Thresholds, weighted: EstimationProblem | None = None
) -> tuple[EventSet, SmoothedUnknownsResult | None]:
    """Events in all recordings, from a fit's residual (none if the prediction fails), and the smoother's result."""
    own, x = fit.problem.with_episodes(whole.episodes, whole.held_out), fit.problem.unknown_vector(fit.values)
    smoothed, guesses, is_flagged = None, fit.evaluation.equilibrium_guesses, False
    if own.system.unprescribed_coordinate_indices:
        judged = weighted or problem_with_whitening_at(own, x, guesses)
        residual = judged.evaluate(x, False, guesses)
        if not residual.ok:
            return NO_EVENTS, None
        test = _null_test(judged, residual.residual, len(fit.values), limits)
        is_flagged = any(window.is_flagged for window in test.windows)
    evaluation = own.evaluate(x, is_flagged, guesses)
    if is_flagged:
        smoothed = _smooth_about_model(replace(fit, problem=own, evaluation=evaluation), limits)
    if not evaluation.ok:
        return NO_EVENTS, None
    found = find_force_and_fault_events(own, x, evaluation, smoothed, limits)
    (pushed, others), share = found.split_force_from_other_events(), 1 - limits.min_event_chi2_fraction
    if pushed and _excess(fit, problem_corrected_for_events(own, pushed)) > share * _excess(fit, own):
        found = others
    return found, smoothed


def _excess(fit: RefittedModel, problem: EstimationProblem) -> float:
    """r'r of a fit minus the number of used samples, over all recordings that can be predicted."""
    x, guesses = problem.unknown_vector(fit.values), fit.evaluation.equilibrium_guesses
    judged = problem_with_whitening_at(problem, x, guesses)
    evaluation = judged.evaluate(x, False, guesses)
    if not evaluation.ok:
        return math.inf
    rows = [evaluation.residual[judged.residual_rows.data]]
    for i, (episode, result) in enumerate(judged.predict_held_out(x)):
        if not isinstance(result, str):
            rows.append(judged.whitened_held_out_prediction_residual(i, episode, result).residual)
    counted = np.concatenate(rows)
    return float(counted @ counted) - np.count_nonzero(counted)


def _without_events(
    search: RefitContext, nominal: RefittedModel, whole: EstimationProblem
) -> tuple[RefitContext, RefittedModel, EventSet, SmoothedUnknownsResult | None]:
    """Remove what events explain, refit the nominal model, and examine it again."""
    first, own = search.problem, None if search.problem.is_split_in_blocks else nominal.problem
    events, smoothed = _happened(whole, nominal, search.thresholds, own)
    for round_ in range(_MAX_EVENT_ROUNDS):
        if not events:
            break
        less = replace(first, problem=problem_corrected_for_events(first.problem, events))
        search.progress.begin_stage(f"fitting the nominal model without {len(events.disturbances)} events", 3.0, 8.5)
        cleaned = replace(search, problem=less)
        again = _settled(cleaned, nominal.values, f"the nominal model without events, round {round_ + 1}")
        if again is None:
            break
        search, nominal, before = cleaned, again, events
        # the smoother's result includes the events
        events, smoothed = _happened(whole, nominal, search.thresholds)[0], None
        if events.has_same_disturbances(before):
            break
    return search, nominal, events, smoothed


def _tested(
    search: RefitContext,
    nominal: RefittedModel,
    cuts: tuple[TruncatedHeldOutRecording, ...],
    whole: EstimationProblem,
    events: EventSet,
    smoothed: SmoothedUnknownsResult | None,
) -> _Examined:
    """Null tests and screening at a nominal fit, where the whitening of all hypotheses is fixed."""
    angles, limits = _largest_joint_angles(nominal), search.thresholds
    effects = tuple(effect.with_prior_ranges_scaled_to_angles(angles) for effect in search.problem.candidate_effects)
    composed = replace(search.problem, problem=nominal.problem, candidate_effects=effects)
    before, held = _estimation_null_test(nominal, limits), _held_out_null_test(nominal, limits)
    search.progress.begin_stage(f"screening {len(effects)} candidates", 3.0, 5.5)
    screened = screen_candidates(composed, (), nominal.values, limits)
    evidence = NominalModelGapEvidence(nominal, before, held, screened, _offsets_stated(nominal.problem))
    return _Examined(replace(search, problem=composed), nominal, cuts, whole, events, smoothed, evidence)


def _followed(
    search: RefitContext, nominal: RefittedModel, before: tuple[TruncatedHeldOutRecording, ...] = ()
) -> tuple[RefitContext, RefittedModel, tuple[TruncatedHeldOutRecording, ...]]:
    """Truncate held-out recordings where the nominal model stops following them, and refit it if any was truncated."""
    found = before
    for margin in SIMULATED_DURATION_FRACTIONS_TO_KEEP:
        if np.isfinite(nominal.held_out_loss.chi2_per_sample):
            break
        composed = replace(search.problem, problem=nominal.problem)
        composed, cuts = composed.truncate_failing_held_out_recordings(nominal.values, margin)
        for cut in cuts:
            search.progress.begin_stage(held_out_truncation_message(cut))
        names = {cut.recording for cut in cuts}
        found = (*(cut for cut in found if cut.recording not in names), *cuts)
        shorter = replace(search, problem=composed)
        again = _settled(
            shorter, nominal.values, f"the nominal model, limited to the part that it can follow ({margin:g})"
        )
        if again is not None:
            search, nominal = shorter, again
    return search, nominal, found


def _offsets_stated(problem: EstimationProblem) -> bool:
    """Whether the size of torque offsets or of constant sensor errors is stated."""
    errors = (episode.input_errors for episode in problem.episodes)
    torques = any(entry is not None and np.any(entry.torque_bias_std > 0) for entry in errors)
    return torques or any(episode.has_uncertain_sensor_biases for episode in problem.episodes)


def _better_nominal_fit(search: RefitContext, nominal: RefittedModel) -> RefittedModel | None:
    """The nominal model refitted from another start with a much higher likelihood; None if there is none."""
    search.progress.begin_stage("fitting the nominal model from other starts", 6.0, 9.5)
    problem, limits = search.problem.problem, search.thresholds

    def begun(factor: float) -> RefittedModel | None:
        x = problem.initial_unknowns
        start = problem.named_values(np.where(problem.positive_unknowns_mask, np.clip(factor * x, *problem.bounds), x))
        name = f"the nominal model from {factor:g} times its start"
        return refit_with_effects(search.problem, (), start, search.store, name, limits)

    best = nominal
    for found in map_with_merged_calls(begun, INITIAL_VALUE_RESTART_FACTORS):
        if found is not None and found.cost < best.cost - limits.min_log_bayes_factor:
            best = found
    return None if best is nominal else _settled(search, best.values, "the nominal model from a better start")


def _settled(search: RefitContext, start: Mapping[str, float], name: str) -> RefittedModel | None:
    """The nominal model fitted from a start, with whitening fixed near its end."""
    composed, limits = search.problem, search.thresholds
    if composed.problem.has_process_noise:
        composed = composed.whitened_at(start)
        first = refit_with_effects(composed, (), start, limits=limits)
        if first is not None:
            slopes, vector = first.evaluation.jacobian, first.problem.unknown_vector
            moved = vector(first.values) - vector(start)
            if slopes is not None and float(np.linalg.norm(slopes @ moved)) < _SAME_WEIGHTS_STDS:
                if search.store is not None:
                    known = StoredFit(first.values, first.std, first.p_values, first.solver_message)
                    search.store.put(name or join_effect_labels(()), known)
                return first
            start = first.values
        composed = composed.whitened_at(start)
    return refit_with_effects(composed, (), start, search.store, name, limits)


def _composed(
    problem: EstimationProblem,
    candidates: CandidateNamesOrAll,
    leave_out: Sequence[str],
    held_out: Sequence[Recording],
    progress: Progress,
) -> AllCandidatesProblem:
    """The problem with all candidates; see `diagnose` for errors."""
    if problem.options.weighting != "whitened":
        what = "a diagnosis needs residuals in units of their noise"
        hint = "set problem.weighting: whitened and the noise levels under `sensors`"
        raise SolverError(what, where="problem.weighting", allowed="whitened", hint=hint)
    effects = make_candidate_effects(problem.system, [episode.recording for episode in problem.episodes], candidates)
    exclude_candidates(effects, leave_out)  # reject names before compilation
    progress.begin_stage(f"composing {len(effects)} candidates into one step", ahead=16.0)
    composed = AllCandidatesProblem.from_problem(problem, effects, held_out)
    return replace(composed, candidate_effects=tuple(exclude_candidates(composed.candidate_effects, leave_out)))


def _after(
    before: NullTestResult, last: RefittedModel, where: tuple[GapLocation, ...], judged: Judgement, limits: Thresholds
) -> tuple[NullTestResult, tuple[GapLocation, ...], tuple[GapLocation, ...]]:
    """Held-out null test with the accepted effects, locations of the gap, and locations of the residual gap."""
    remaining = _held_out_null_test(last, limits)
    left = residuals_exceed_noise((_estimation_null_test(last, limits), remaining), limits.null_test_limits)
    rest = gap_locations_by_smoother_evidence(_smooth_about_model(last, limits), limits.location_z) if left else ()
    windows = merge_time_intervals([(w.start_time, w.end_time) for w in before.windows if w.is_flagged])
    return remaining, gap_locations_from_effect_closures(where, judged.closure_by_location, rest, windows), rest


def fit_nominal_model(
    problem: EstimationProblem,
    composed: AllCandidatesProblem,
    solution: Solution | None = None,
    store: RefitStore | None = None,
    limits: Thresholds = DEFAULT_THRESHOLDS,
) -> RefittedModel:
    """Fit the nominal model within the problem with all candidates. Raises `SolverError` if the fit fails."""
    known = load_stored_refit(composed, (), store)
    if known is not None and composed.problem.has_process_noise:
        known = load_stored_refit(composed.whitened_at(known.values), (), store)
    if known is not None:
        return known
    start: Mapping[str, float] = {}
    begun = composed
    # a single recording that is both fitted and held out has no solution yet
    if solution is not None or not composed.is_split_in_blocks:
        found = solve(problem, GaussNewton(max_iterations=30), verdicts=False) if solution is None else solution
        if found.evaluation is None:
            raise failed_rollout_error(f"its fit fails: {found.message}", "nominal model")
        start = dict(zip(found.unknown_names, map(float, found.x), strict=True))
        if found.problem is not None and composed.problem.has_process_noise:
            begun = composed.linearized_about_estimated_input_errors(found.problem)
    fit = _settled(RefitContext(begun, limits, NULL_PROGRESS, store), start, "")
    if fit is None and start:
        # a gap may move parameters so far that the solver's equilibrium is not found again from there
        fit = _settled(RefitContext(composed, limits, NULL_PROGRESS, store), {}, "the nominal model from its start")
    if fit is None:
        raise failed_rollout_error("it fails at the fitted values", "nominal model")
    return fit


def _largest_joint_angles(fit: RefittedModel) -> dict[str, float]:
    """The largest joint angle of each segment in the estimation recordings [rad]."""
    system, states = fit.problem.system, [r.rollout.state for r in fit.evaluation.episode_predictions]
    found = {}
    for segment in system.segment_layouts:
        index = [system.mechanism.joint_index(joint) for link in segment.link_joints for joint in link]
        found[segment.name] = max(float(np.abs(state[:, index]).max()) for state in states)
    return found


def _null_test(problem: EstimationProblem, residual: Array, fitted: int, limits: Thresholds) -> NullTestResult:
    """The null test of a residual after a fit of the given number of parameters."""
    samples = residual_channels(problem)
    return residual_chi2_null_test(samples, residual, fitted, limits.significance_level, limits.residual_window)


def _estimation_null_test(fit: RefittedModel, limits: Thresholds) -> NullTestResult:
    spread = encoder_noise_residual_factor(fit.problem, fit.problem.unknown_vector(fit.values))
    residual = whiten_with_extra_errors(fit.evaluation.residual, spread)
    return _null_test(fit.problem, residual, len(fit.values), limits)


def _held_out_null_test(fit: RefittedModel, limits: Thresholds = DEFAULT_THRESHOLDS) -> NullTestResult:
    """The null test of a model on the held-out recordings."""
    problem, shared = fit.problem, len(fit.problem.shared_parameters)
    residuals, slopes = [], []
    for i, (episode, result) in enumerate(problem.predict_held_out(problem.unknown_vector(fit.values), True)):
        if isinstance(result, str):
            what, allowed = (
                f"the held-out recording cannot be predicted: {result}",
                "recordings that the model can follow",
            )
            hint = "hold out another recording"
            raise DataError(what, where=f"recording '{episode.name}'", allowed=allowed, hint=hint)
        rows = problem.whitened_held_out_prediction_residual(i, episode, result)
        assert rows.jacobian is not None
        residuals.append(rows.residual)
        slopes.append(rows.jacobian[:, :shared])
    x, own = problem.unknown_vector(fit.values), problem.with_episodes(problem.held_out, ())

    def predicted(moved: EstimationProblem) -> Array | None:
        other = problem.with_episodes(problem.episodes, moved.episodes)
        parts = []
        for i, (episode, result) in enumerate(other.predict_held_out(x)):
            if isinstance(result, str):
                return None
            parts.append(other.whitened_held_out_prediction_residual(i, episode, result).residual)
        return np.concatenate(parts)

    spread = np.vstack(slopes) @ unknowns_covariance_factor(problem, fit.evaluation)[:shared]
    if (by_path := encoder_noise_residual_factor(own, x, predicted)).size:
        spread = np.hstack([spread, by_path])
    residual = whiten_with_extra_errors(np.concatenate(residuals), spread)
    return _null_test(own, residual, 0, limits)


def _smooth_about_model(fit: RefittedModel, limits: Thresholds) -> SmoothedUnknownsResult:
    """Run the weak-constraint smoother about a fitted model, with torque noise among its unknowns."""
    problem, evaluation, x = fit.problem, fit.evaluation, fit.problem.unknown_vector(fit.values)
    if problem.has_process_noise:
        problem = problem_with_sensor_noise_only(problem)
        evaluation = problem.evaluate(x, equilibrium_guesses=fit.evaluation.equilibrium_guesses)
    if any(episode.has_uncertain_sensor_biases for episode in problem.episodes):
        less = [
            replace(e, measurements=subtract_estimated_biases(e.measurements, result.predicted_outputs))
            for e, result in zip(problem.episodes, evaluation.episode_predictions, strict=True)
        ]
        problem = problem.with_episodes(less, ())
        evaluation = problem.evaluate(x, equilibrium_guesses=evaluation.equilibrium_guesses)
    return select_and_smooth_unknowns(problem, x, evaluation, limits)

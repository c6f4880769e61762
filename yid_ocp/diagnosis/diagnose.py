"""All steps of a diagnosis of the sim-to-real gap, from the nominal fit to the verdict."""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import threadpoolctl

from yid_ocp.analysis import discretisation
from yid_ocp.analysis.run_estimates import RunEstimates
from yid_ocp.data.recording import Recording
from yid_ocp.diagnosis import hypotheses, select
from yid_ocp.diagnosis.baseline import EarlierRunsBaseline, problem_with_priors_and_baseline
from yid_ocp.diagnosis.diagnosis_result import DiagnosisResult
from yid_ocp.diagnosis.events import EventSet, find_events, problem_corrected_for_events
from yid_ocp.diagnosis.gap_law import find_gap_law
from yid_ocp.diagnosis.hypotheses import NOMINAL_SOLVER, REFIT_SOLVER, AllCandidatesProblem, CandidateNamesOrAll
from yid_ocp.diagnosis.refit import (
    EffectSearchRecord,
    RefitContext,
    RefitStatistics,
    RefitStore,
    RefittedModel,
    reevaluate_refit_with_all_candidates,
    refit_with_effects,
)
from yid_ocp.diagnosis.screening import EMPTY_SCREENING_RESULT, changes_by_candidates_at_location, screen_candidates
from yid_ocp.diagnosis.sentences import diagnosis_summary_text, next_step_texts, recommended_experiment_text
from yid_ocp.diagnosis.thresholds import DEFAULT_THRESHOLDS, Thresholds
from yid_ocp.diagnosis.verdict import Judgement, NominalModelGapEvidence, judge
from yid_ocp.display import LoggingProgress, Progress, count_with_noun
from yid_ocp.errors import SolverError, failed_rollout_error
from yid_ocp.inference import null_test, smoother
from yid_ocp.inference.smoother import GapLocation, SmoothedUnknownsResult
from yid_ocp.inference.uncertainty import noise_only_covariance_sqrt, null_tests_of_fit
from yid_ocp.integrator.compiled import MAX_BATCHED_COLUMNS
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.options import RefinementKind
from yid_ocp.solvers import GaussNewton, Solution, fit_problem

_LOG_PROGRESS = LoggingProgress(logging.getLogger(__name__))
# of the r'r that a discretisation twice as fine removes: errors of order two leave a third of the change
_LEFT_BY_DISCRETISATION = 1 / 9
_LONGEST_FINAL_TIME_STEP = 2e-3  # steps up to this one are never halved, since a forecast may promise too much [s]
_FAR_RATIO, _FAR_IN_STDS = 3.0, 5.0  # of an estimate to its initial value, or from a prior's mean
_NEGLIGIBLE_MOVE_IN_STDS = 0.1  # largest change of an estimate that does not change which events are found
_MAX_EVENT_ROUNDS = 3  # maximum number of refits of the nominal model, each without the events found before it


def diagnose(
    problem: EstimationProblem,
    candidates: CandidateNamesOrAll = "all",
    held_out: Sequence[Recording] = (),
    *,
    thresholds: Thresholds = DEFAULT_THRESHOLDS,
    progress: Progress = _LOG_PROGRESS,
    solution: Solution | None = None,
    store: RefitStore | None = None,
    baseline: RunEstimates | Sequence[RunEstimates] | EarlierRunsBaseline = (),
    exclude: Sequence[str] = (),
    refit_solver: GaussNewton = REFIT_SOLVER,
) -> DiagnosisResult:
    """Diagnose the gap between model and recordings: find out whether it exists, where it is, and what causes it.

    Raises `ConfigError` or `ModelError` if a candidate does not fit the system, `DataError` if a held-out recording is
    also estimated on or there is no noise level, and `SolverError` if the nominal model cannot be rolled out.

    Parameters
    ----------
    problem : EstimationProblem
        Problem of the nominal model, with free stiffnesses.
    candidates, exclude : "all" or sequence of str
        Effects to try, and exceptions from these, as `kind` or `kind@location`.
    held_out : sequence of Recording
        Recordings that no fit uses. Default: those of the problem. Without any, alternate blocks are held out.
    progress : Progress
        Default: the package's log.
    solution : Solution, optional
        Solution of the nominal model from which its fit starts. Default: it is computed.
    store : mutable mapping of str to StoredFit, optional
        Finished refits of an interrupted diagnosis by name. It receives every new refit.
    baseline : RunEstimates or sequence of RunEstimates, or EarlierRunsBaseline
        Estimates of earlier runs of the same model (`read_estimates`), used as priors unless the problem already has
        them: changes since then are diagnosed. An `EarlierRunsBaseline` can also hold reference recordings made without
        the sought effects, which are predicted with the found effects removed.
    refit_solver : GaussNewton
        Solver of all refits, for example with looser tolerances if model error dominates the cost.

    Returns
    -------
    DiagnosisResult
        Verdict, effects with parameters in their own units, and fractions of the gap [1]; `to_dict` has all with units.
    """
    with threadpoolctl.threadpool_limits(1):  # threads cost more than they save for small matrices
        begun = time.perf_counter()
        problem, earlier = problem_with_priors_and_baseline(problem, baseline)
        problem, solution = hypotheses.fit_with_encoder_noise_in_points(problem, solution, progress)
        composed = hypotheses.make_all_candidates_problem(problem, candidates, exclude, held_out, progress)
        composed = replace(composed, refit_solver=refit_solver)
        deadline = begun + (thresholds.budget or math.inf)
        columns = len(composed.problem.unknowns.unknown_indices_affecting_recording(0))
        batched = len(composed.problem.episodes) * (columns <= MAX_BATCHED_COLUMNS)
        refits = {} if store is None else store
        search = RefitContext(composed, thresholds, progress, refits, deadline, batched, stage_ends={"": begun})
        search.record_stage_end_time("compose")
        progress.begin_stage("fitting the nominal model", 3.0, 15.5)
        # no name for the fit, whose Jacobian would fill the memory to the end
        seen = _examined(search, fit_nominal_model(problem, search, solution))
        return _diagnosed(problem, seen, earlier)


@dataclass(frozen=True)
class _Examined:
    """The nominal model on data without events: fit, null tests, screening, and whether there is a gap."""

    search: RefitContext  # the weights of all hypotheses frozen at the fit
    nominal: RefittedModel
    with_events: AllCandidatesProblem  # before events were removed from the data
    events: EventSet
    smoothed: SmoothedUnknownsResult | None  # about the fit, on all its recordings, if it was run
    evidence: NominalModelGapEvidence


def _examined(search: RefitContext, nominal: RefittedModel) -> _Examined:
    """Null tests and screening of the nominal model on data without events, at a discretisation that makes no gap."""
    limits = search.thresholds
    search, nominal = _followed(search, nominal)
    search.record_stage_end_time("nominal")
    search.progress.begin_stage("looking for events (pushes and wrong samples)", 4.0, 11.5)
    with_events = search.problem
    search, nominal, events, smoothed = _without_events(search, nominal)
    search.record_stage_end_time("events")
    states = [prediction.rollout.state for prediction in nominal.evaluation.episode_predictions]
    effects = search.problem.candidates_with_prior_ranges_from_states(states)
    predicted = nominal.problem.predict_held_out(nominal.unknowns, True)
    test, held_out_test, spread = null_tests_of_fit(*nominal.at_estimates, limits.significance_level, predicted)
    # the whitening of all hypotheses is fixed here
    own = nominal.problem
    composed = replace(search.problem, problem=own, candidate_effects=effects, held_out_spread=spread)
    composed.changes_by_encoder_noise.clear()
    factor = noise_only_covariance_sqrt(own, nominal.evaluation)
    nominal = replace(nominal, held_out_loss=null_test.held_out_loss(own, nominal.unknowns, factor, spread, predicted))
    del predicted  # its derivatives would fill the memory
    least = _LEFT_BY_DISCRETISATION * composed.chi2_removed_by_discretisation
    evidence = NominalModelGapEvidence(nominal, test, held_out_test, EMPTY_SCREENING_RESULT)
    evidence = replace(evidence, discretisation_chi2=least, has_left_start=_has_left_start(nominal))
    ahead = 15.0 if evidence.residual_exceeds_noise(limits) else 1.5
    search.progress.begin_stage(f"screening {count_with_noun(len(effects), 'candidate effect')}", 4.0, ahead)
    seen = _Examined(replace(search, problem=composed), nominal, with_events, events, smoothed, evidence)
    try:
        screened = screen_candidates(composed, (), nominal.values)
    except SolverError:
        if not own.step.time_step > _LONGEST_FINAL_TIME_STEP:
            raise
        return _at_half_time_step(seen, "the model with all candidates fails", 0.0)
    search.record_stage_end_time("screening")
    seen = replace(seen, evidence=replace(evidence, screening=screened))
    if not seen.evidence.warrants_effect_search(limits):
        return seen
    return _at_finer_discretisation(seen, nominal, screened.largest_predicted_chi2_decrease)


def _has_left_start(fit: RefittedModel) -> bool:
    """Check whether a fit contradicts priors, or an estimate is far from its initial value, so not a good start."""
    problem, rows = fit.problem, fit.problem.residual_rows.stated_priors
    deviations = fit.evaluation.residual[rows] / problem.options.stated_std_factor
    initial = problem.unknowns.named_values(problem.initial_unknowns)
    known = [name for name in problem.shared_parameters if initial[name] > _FAR_IN_STDS * fit.std[name]]
    is_far = [not 1 / _FAR_RATIO < fit.values[name] / initial[name] < _FAR_RATIO for name in known]
    return any([*is_far, *(np.abs(deviations) > _FAR_IN_STDS)])


def _at_finer_discretisation(seen: _Examined, fit: RefittedModel, gap: float, is_refitted: bool = False) -> _Examined:
    """The nominal model, examined again at half the time step or without the error of the links.

    `seen` if neither lowers r'r of a fit significantly and by half of a candidate's fall (`gap`), or after the links.
    `is_refitted`: only half the step is tried, by a refit, since a fit with long steps may lie in a wrong minimum.
    """
    if seen.with_events.is_corrected_for_links:
        return seen
    least = max(gap / 2, 2 * seen.search.thresholds.min_log_bayes_factor)
    if fit.problem.step.time_step > _LONGEST_FINAL_TIME_STEP:
        seen.search.progress.begin_stage("testing whether half the time step lowers chi2", 1.0, 12.0)
        fine = _at_finer_step(seen.search, fit, seen.events)
        fall = discretisation.predicted_chi2_fall_at_finer_step(fine, *fit.at_estimates, is_refitted)
        if fall > least:
            return _at_half_time_step(seen, f"half the time step lowers chi2 by {fall:.3g}", fall)
    return seen if is_refitted else _without_error_of_links(seen, fit, least)


def _at_half_time_step(seen: _Examined, why: str, fall: float) -> _Examined:
    h = seen.nominal.problem.step.time_step / 2
    seen.search.progress.begin_stage(f"starting again with time steps of {h:g} s, because {why}")
    return _restarted(seen, seen.with_events.with_half_time_step(fall), seen.nominal.values, seen.search.store)


def _restarted(
    seen: _Examined, problem: AllCandidatesProblem, start: Mapping[str, float], store: RefitStore
) -> _Examined:
    """The nominal model, examined again on another problem."""
    search = replace(seen.search, problem=problem, store=store, record=EffectSearchRecord(), rounds=[])
    return _examined(search, _fitted_nominal_model(search, start))


def _examined_anew(seen: _Examined, judged: Judgement) -> _Examined:
    """The nominal model, examined again if noise or discretisation need it beside the effects; else `seen`."""
    if judged.verdict != "unknown":
        return seen
    fits = [entry.refitted_model for entry in judged.selected_effects]
    if not fits:
        return _at_finer_discretisation(
            seen, seen.nominal, seen.evidence.screening.largest_predicted_chi2_decrease, True
        )
    problem = seen.with_events.with_encoder_noise_in_efforts(fits[-1].effects, fits[-1].values)
    if problem is None:
        return seen
    beside = hypotheses.join_effect_labels(fits[-1].effects)
    seen.search.progress.begin_stage(f"starting again with noise beside {beside}")
    return _restarted(seen, problem, seen.nominal.values, {})


class _FinerModelExplainsError(Exception):
    """A finer discretisation removes what more effects would explain. The argument is the model examined with it."""


def _check_discretisation(seen: _Examined, fit: RefitStatistics, gap: float) -> None:
    """Raise `_FinerModelExplainsError` if the discretisation explains what the effects of a fit leave."""
    assert isinstance(fit, RefittedModel)
    anew = _at_finer_discretisation(seen, reevaluate_refit_with_all_candidates(seen.search.problem, fit), gap)
    if anew is not seen:
        raise _FinerModelExplainsError(anew)


def _without_priors_of(problem: AllCandidatesProblem, released: Sequence[str]) -> AllCandidatesProblem:
    prior = problem.problem.options.multivariate_prior
    kept = prior.restricted_to([name for name in prior.parameter_names if name not in released])
    return replace(problem, problem=problem.problem.with_replaced_multivariate_prior(kept))


def _with_changed_parameters(
    seen: _Examined, judged: Judgement, earlier: EarlierRunsBaseline
) -> tuple[_Examined, Judgement]:
    """The nominal model, examined again without the priors of parameters that have left the earlier runs.

    `seen` if it does not explain the recordings, or decidedly worse than rejected or not decidedly better than accepted
    effects. Changes that explain as much as accepted effects enter the returned judgement and its probability.
    """
    search, fit, released = seen.search, seen.nominal, list[str]()
    while left := earlier.shifted_parameters_with_prior(fit, search.thresholds):
        tried = [*released, left[0]]
        search.progress.begin_stage(f"trying a change of {' and '.join(tried)} since the baseline", 1.0, 8.5)
        free = _without_priors_of(search.problem, tried)
        refitted = refit_with_effects(replace(search, problem=free, store={}), (), fit.values)
        if refitted is None:
            break
        fit, released = refitted, tried
    best = [seen.nominal, *(entry.refitted_model for entry in judged.selected_effects)][-1]
    decisive = select.decisive_bic_difference(search.thresholds)
    distance = select.bic_difference(fit, best, len(released)) / decisive
    if not released or distance > 1.0:
        return seen, judged
    if judged.accepted_selected_effects and distance > -1.0:
        shifts = earlier.parameter_shifts_of_fit(fit, search.thresholds)
        assert shifts is not None  # the priors are those of earlier runs
        rivals = tuple(own for own in shifts.parameter_shifts if own.name in released)
        probability = judged.probability * select.relative_probability(distance)
        return seen, replace(
            judged,
            verdict="confusable",
            probability=probability,
            rival_shifts=rivals,
            rival_probability=judged.probability - probability,
        )
    with contextlib.suppress(SolverError):
        anew = _restarted(seen, _without_priors_of(seen.with_events, released), seen.nominal.values, {})
        if not anew.evidence.residual_exceeds_noise(search.thresholds):
            return anew, judged
    return seen, judged


def _at_finer_step(search: RefitContext, fit: RefittedModel, events: EventSet) -> EstimationProblem:
    """The problem of a fit at half the time step, without events and without held-out recordings."""
    composed = replace(search.problem, problem=search.problem.estimated_at_half_time_step)
    return problem_corrected_for_events(composed.problem_with_nominal_and_effects_free(fit.effects), events)


def _without_error_of_links(seen: _Examined, fit: RefittedModel, least: float) -> _Examined:
    """The nominal model, examined again on data without the error of the links, if that lowers r'r by so much."""
    seen.search.progress.begin_stage("testing whether twice the links lower chi2", 1.0, 11.0)
    own = seen.with_events.problem_with_nominal_and_effects_free(fit.effects)
    known = seen.with_events.problem, own, fit.unknowns, fit.evaluation
    corrected = discretisation.problem_data_corrected_for_few_links(*known, fit.effects, least)
    if corrected is None:
        return seen
    problem = replace(seen.with_events, problem=corrected)
    refitted = refit_with_effects(replace(seen.search, problem=problem, store={}), fit.effects, fit.values)
    if refitted is None or not 2 * (fit.cost - refitted.cost) > least:
        return seen
    gain = 2 * (fit.cost - refitted.cost)
    said = f"starting again with data corrected for too few links, because twice the links lower chi2 by {gain:.3g}"
    seen.search.progress.begin_stage(said)
    removed = problem.chi2_removed_by_discretisation + gain
    problem = replace(problem, is_corrected_for_links=True, chi2_removed_by_discretisation=removed)
    return _restarted(seen, problem, refitted.values, {})


def _followed(search: RefitContext, nominal: RefittedModel) -> tuple[RefitContext, RefittedModel]:
    """Truncate held-out recordings where the nominal model stops following them, and refit it if any was truncated."""
    for fraction in hypotheses.KEPT_HELD_OUT_FRACTIONS:
        if np.isfinite(nominal.held_out_loss.chi2_per_sample):
            break
        composed = replace(search.problem, problem=nominal.problem)
        composed, cuts = composed.truncate_failing_held_out_recordings(nominal.values, fraction)
        for cut in cuts:
            search.progress.begin_stage(cut.sentence(nominal.problem.step.time_step))
        search = replace(search, problem=composed)
        name = f"the nominal model, limited to the part that it can follow ({fraction:g})"
        nominal = _fitted_nominal_model(search, nominal.values, name)
    return search, nominal


def _without_events(
    search: RefitContext, nominal: RefittedModel
) -> tuple[RefitContext, RefittedModel, EventSet, SmoothedUnknownsResult | None]:
    """Remove what events explain, refit the nominal model, and examine it again."""
    first, whole = search.problem, search.problem.problem_fitting_all_samples
    events, smoothed = find_events(whole, nominal, search.thresholds)
    for round_ in range(_MAX_EVENT_ROUNDS):
        if not events:
            break
        less = replace(first, problem=problem_corrected_for_events(first.problem, events))
        search.progress.begin_stage("fitting the nominal model without the events that were found", 3.0, 11.5)
        search, name = replace(search, problem=less), f"the nominal model without events, round {round_ + 1}"
        old, before, smoothed = nominal, events, None  # the smoother's result includes the events
        nominal = _fitted_nominal_model(search, old.values, name)
        moved = (abs(nominal.values[own] - old.values[own]) / max(std, 1e-300) for own, std in nominal.std.items())
        if max(moved, default=0.0) < _NEGLIGIBLE_MOVE_IN_STDS:  # the same events would be found again
            break
        events, _ = find_events(whole, nominal, search.thresholds)
        if events.has_same_force_and_fault_events(before):
            break
    return search, nominal, events, None if first.is_split_in_blocks else smoothed


def _diagnosed(problem: EstimationProblem, seen: _Examined, earlier: EarlierRunsBaseline) -> DiagnosisResult:
    before: _Examined | None = None
    while seen is not before:  # no recursion, which would keep what was found before
        before = seen
        search, nominal, limits = seen.search, seen.nominal, seen.search.thresholds
        shifted = earlier.shifted_parameters_with_prior(nominal, limits)
        evidence = replace(seen.evidence, has_left_baseline=bool(shifted))
        # beside the prior of a changed parameter, a finer model may only imitate the change
        checked = search if shifted else replace(search, check_discretisation=partial(_check_discretisation, seen))
        try:
            judged = judge(checked, evidence)
        except _FinerModelExplainsError as found:
            seen = found.args[0]
            continue
        # a search that begins anew would find nothing
        if search.is_skipped_past_deadline(*(f"a change of {name} since the baseline" for name in shifted)):
            break
        seen, judged = _with_changed_parameters(seen, judged, earlier)
        if seen is before:
            seen = _examined_anew(seen, judged)
    smoothed: SmoothedUnknownsResult | None = None
    where = rest = tuple[GapLocation, ...]()
    screened = EMPTY_SCREENING_RESULT
    if judged.verdict not in ("no_gap", "insufficient_data"):
        search.progress.begin_stage("locating the gap in the model and its sensors", 3.0, 2.0)
        # without events, the smoother already ran on all fitted data
        least = limits.min_log_bayes_factor
        smoothed = seen.smoothed or smoother.smooth_unknown_forces_and_biases(*nominal.at_estimates, least)
        where = rest = smoother.gap_locations_by_smoother_evidence(smoothed)
    search.record_stage_end_time("localisation")
    remaining, events, counted = evidence.nominal_held_out_test, seen.events, tuple[RefinementKind, ...]()
    accepted = judged.accepted_selected_effects
    last = [nominal, *(entry.refitted_model for entry in accepted)][-1]
    assert isinstance(last, RefittedModel)
    final = reevaluate_refit_with_all_candidates(search.problem, last)
    if judged.verdict in ("no_gap", "effect", "confusable"):
        fine = _at_finer_step(search, final, events)
        known = *final.at_estimates, final.std, final.effects, search.problem.is_corrected_for_links
        std, counted = discretisation.stds_with_discretisation_and_encoder_errors(fine, *known)
        final = replace(final, std=std)
    if not accepted:
        evidence = replace(evidence, nominal_model=final)
    else:
        fitted, remaining, _ = null_tests_of_fit(*final.at_estimates, limits.significance_level)
        rest = ()
        if null_test.residuals_exceed_noise((fitted, remaining), limits.null_test_excess_criteria):
            screened = search.screen(final.effects, final.values, "what the effects leave")
            if not search.is_skipped_past_deadline("the location of the remaining error"):
                left = smoother.smooth_unknown_forces_and_biases(*final.at_estimates, limits.min_log_bayes_factor)
                rest = smoother.gap_locations_by_smoother_evidence(left)
        windows = smoother.merge_time_intervals(evidence.nominal_test.flagged_windows)
        closed = judged.accepted_effects_closure_by_location
        where = smoother.gap_locations_from_closures_and_smoother(where, closed, rest, windows)
        # a disturbance that a better model explains was no event
        events = find_events(seen.with_events.problem_fitting_all_samples, final, limits)[0]
    search.record_stage_end_time("remaining")
    # what no effect explains
    places = [name for place in rest for name in (place.location, *place.indistinguishable_from)]
    prior = nominal.problem.options.multivariate_prior
    law = find_gap_law(search, problem.with_replaced_multivariate_prior(prior), final, places, seen.events)
    if accepted:
        forecast = changes_by_candidates_at_location(screened, final.effects, limits.significance_level)
        # no surer than values change by a law of what is left, or as forecast for an effect
        at, beside = final.values, final.values if law is None else law.model.values
        changes = {name: max(abs(beside[name] - at[name]), abs(forecast.get(name, 0.0))) for name in final.std}
        final = replace(final, std={name: max(std, changes[name]) for name, std in final.std.items()})
        judged = replace(judged, selected_effects=(*accepted[:-1], replace(accepted[-1], refitted_model=final)))
    search.record_stage_end_time("law")
    ends = search.stage_ends
    finding = DiagnosisResult(
        **(vars(evidence) | vars(judged)),
        noise_floor=null_test.assumed_noise_rmse_by_channel(nominal.problem),
        record=search.record,
        smoother_result=smoothed,
        gap_locations=where,
        remaining_test=remaining,
        remaining_gap_locations=rest,
        is_split_in_blocks=search.problem.is_split_in_blocks,
        thresholds=limits,
        truncated_recordings=tuple(search.problem.truncated_recordings.values()),
        stage_seconds={name: ends[name] - ends[last] for last, name in itertools.pairwise(ends)},
        events=events,
        baseline_comparison=earlier.parameter_shifts_of_fit(final, limits),
        counterfactual=earlier.predict_counterfactual_errors(nominal, final, search.progress),
        untried=tuple(dict.fromkeys(search.skipped)),
        stated_and_used_time_step=(problem.step.time_step, nominal.problem.step.time_step),
        is_corrected_for_links=search.problem.is_corrected_for_links,
        errors_in_std=counted,
        law=law,
    )
    finding = replace(finding, next_experiment=recommended_experiment_text(finding))
    return replace(finding, summary=diagnosis_summary_text(finding), next_steps=next_step_texts(finding))


def _fitted_nominal_model(
    search: RefitContext, start: Mapping[str, float], name: str = "the nominal model"
) -> RefittedModel:
    """The nominal model fitted from a start, with whitening fixed there. Raises `SolverError` if it fails."""
    problem = search.problem.with_whitening_linearized_at(start)
    nominal = problem.with_step_of_only_effects(())
    # a gap may move parameters so far that the solver's equilibrium is not found again from there
    for own in (start, {}):
        if fit := refit_with_effects(replace(search, problem=nominal), (), own, name):
            return reevaluate_refit_with_all_candidates(problem, fit)
    raise failed_rollout_error("all fits fail, also from the initial values", "nominal model")


def fit_nominal_model(
    problem: EstimationProblem, search: RefitContext, solution: Solution | None = None
) -> RefittedModel:
    """Fit the nominal model in the problem that contains all candidate effects. Raises `SolverError` on failure."""
    solution = solution or fit_problem(problem, NOMINAL_SOLVER, verdicts=False)
    start = dict(zip(solution.unknown_names, map(float, solution.x), strict=True))
    composed = search.problem.with_smoothed_input_errors_of(solution.problem)
    return _fitted_nominal_model(replace(search, problem=composed), start)

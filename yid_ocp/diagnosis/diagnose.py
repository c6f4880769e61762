"""Diagnosis of the sim-to-real gap: all steps in order, from the nominal fit to the verdict."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import threadpoolctl

from yid_ocp.analysis.estimate_history import RunEstimates
from yid_ocp.data.recording import Recording
from yid_ocp.diagnosis.baseline import NO_BASELINE, BaselineData, with_baseline_prior
from yid_ocp.diagnosis.diagnosis_messages import (
    diagnosis_summary_text,
    insufficient_data_message,
    next_experiment_text,
    truncation_message,
)
from yid_ocp.diagnosis.diagnosis_result import DiagnosisResult, nominal_parameter_changes
from yid_ocp.diagnosis.events import NO_EVENTS, EventSet, find_events, problem_without_events
from yid_ocp.diagnosis.hypotheses import (
    TRUNCATION_FRACTIONS,
    AllCandidatesProblem,
    CandidateChoice,
    TruncatedRecording,
    exclude_candidates,
    make_candidate_effects,
)
from yid_ocp.diagnosis.localise import (
    GapLocation,
    attribute_gap_to_effects,
    localise_gap,
    main_gap_locations,
    merge_intervals,
)
from yid_ocp.diagnosis.refit import (
    KnownFits,
    RefitContext,
    RefitModel,
    RefitStore,
    load_stored_refit,
    refit_with_effects,
)
from yid_ocp.diagnosis.screening import ScreeningResult, screen_candidates
from yid_ocp.diagnosis.select import GapClosure, SelectedEffect, gap_closure, select_effects
from yid_ocp.diagnosis.thresholds import DEFAULT_THRESHOLDS, Thresholds
from yid_ocp.diagnosis.transfer_check import check_transfer, inflate_std_by_disagreement
from yid_ocp.diagnosis.verdict import (
    compute_explained_fraction,
    decide_verdict,
    find_unknown_reason,
    has_gap,
    is_chance_excess,
)
from yid_ocp.errors import DataError, SolverError
from yid_ocp.inference.null_test import (
    NullTestResult,
    channel_noise_levels,
    residual_channels,
    run_null_test,
    whiten_with_extra_errors,
)
from yid_ocp.inference.smoother import SmootherResult, run_smoother
from yid_ocp.inference.uncertainty import noise_covariance_factor
from yid_ocp.inference.whitening import whitened_at, whitened_by_sensor_noise
from yid_ocp.parallel import map_with_batched_calls
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.measurements import subtract_estimated_biases
from yid_ocp.progress import LoggingProgress, Progress
from yid_ocp.solvers import GaussNewton, Solution, solve
from yid_ocp.solvers.base import RESTART_FACTORS

log = logging.getLogger(__name__)

_MAX_EVENT_ROUNDS = 3  # maximum number of refits of the nominal model, each without the events found before it


def diagnose(
    problem: EstimationProblem,
    candidates: CandidateChoice = "all",
    held_out: Sequence[Recording] = (),
    *,
    thresholds: Thresholds | None = None,
    progress: Progress | None = None,
    known_fits: KnownFits | None = None,
    baseline: RunEstimates | Sequence[RunEstimates] | BaselineData = (),
    exclude: Sequence[str] = (),
) -> DiagnosisResult:
    """Diagnose the gap between model and recordings: whether it exists, where, its cause, and how far it closes.

    Parameters
    ----------
    problem : EstimationProblem
        Of the nominal model, with the stiffnesses free.
    candidates : "all" or sequence of str
        `kind` or `kind@location`.
    held_out : sequence of Recording
        Never touched by a fit; the problem's own where absent. Where there are none, alternate blocks are held out.
    progress : Progress, optional
        Told what is going on; the package's log when absent.
    known_fits : KnownFits, optional
    baseline : RunEstimates or sequence of RunEstimates, or BaselineData, optional
        What earlier runs of the same model say of its parameters (`read_estimates`): priors, so that the question is
        what differs now. A problem that has them already (`with_baseline_prior`) is taken as it is. A `BaselineData`
        may have reference recordings too, made without what is looked for; the effects found are taken out for them.
    exclude : sequence of str, optional
        Candidates that are not tried, `kind` or `kind@location`.

    Raises
    ------
    ConfigError, ModelError
        Candidates that do not fit the system.
    DataError
        Held-out recordings that are estimated on, no noise level.
    SolverError
        The nominal model cannot be rolled out, or is not whitened.
    """
    # the matrices are small: threads of the linear algebra library cost more than they give
    with threadpoolctl.threadpool_limits(1):
        clock, told, known = _Clock(), progress or LoggingProgress(log), known_fits or KnownFits()
        runs = (baseline,) if isinstance(baseline, RunEstimates) else baseline
        earlier = runs if isinstance(runs, BaselineData) else BaselineData.from_runs(runs, ())
        if earlier.combined_estimates is not None and not problem.options.multivariate_prior.parameter_names:
            problem = with_baseline_prior(problem, earlier.combined_estimates)
        composed = _composed(problem, candidates, exclude, held_out, told)
        clock.lap("compose")
        search = RefitContext(composed, thresholds or DEFAULT_THRESHOLDS, told, known.store)
        return _diagnosed(problem, search, known.solution, clock, earlier)


@dataclass(frozen=True)
class _Examined:
    """The nominal model beside all that is no event: fit, null tests, screening, and whether there is a gap."""

    search: RefitContext
    nominal: RefitModel
    truncated: tuple[TruncatedRecording, ...]
    whole: EstimationProblem
    events: EventSet
    smoothed: SmootherResult | None
    before: NullTestResult
    held: NullTestResult
    screened: ScreeningResult
    has_enough_samples: bool
    has_gap: bool


def _examined(problem: EstimationProblem, search: RefitContext, solution: Solution | None, clock: _Clock) -> _Examined:
    limits, progress = search.thresholds, search.progress
    progress.begin_stage("fitting the nominal model")
    nominal = fit_nominal_model(problem, search.problem, solution, search.store, limits)
    search, nominal, cuts = _followed(search, nominal)
    clock.lap("nominal")
    progress.begin_stage("looking for events")
    whole = _undivided(search.problem, problem)
    search, nominal, happened = _without_events(search, nominal, whole)
    about = nominal
    clock.lap("events")
    search, before, held, screened = _tested(search, nominal)
    clock.lap("screening")
    enough = before.degrees_of_freedom >= limits.min_samples_per_unknown * len(nominal.values)
    offsets = _offsets_stated(nominal.problem)
    gap = has_gap(before, held, limits, screened.candidate_scores, offsets)
    if gap and enough and before.chi2_per_dof < limits.restart_chi2:
        other = _better_nominal_fit(search, nominal)
        if other is not None:
            search, nominal, cuts = _followed(search, other, cuts)
            search, before, held, screened = _tested(search, nominal)
            gap = has_gap(before, held, limits, screened.candidate_scores, offsets)
    # where nothing happened it was run on all that was fitted already
    known = happened.smoothed if nominal is about and not search.problem.is_split_in_blocks else None
    return _Examined(search, nominal, cuts, whole, happened.events, known, before, held, screened, enough, gap)


def _diagnosed(
    problem: EstimationProblem,
    search: RefitContext,
    solution: Solution | None,
    clock: _Clock,
    earlier: BaselineData = NO_BASELINE,
) -> DiagnosisResult:
    seen = _examined(problem, search, solution, clock)
    search, nominal, before, held, screened = seen.search, seen.nominal, seen.before, seen.held, seen.screened
    limits, progress, enough, events = search.thresholds, search.progress, seen.has_enough_samples, seen.events
    changed = earlier.changed_parameters(nominal, limits)
    clock.lap("other_starts")
    moved = bool(changed) and not seen.has_gap
    gap, smoothed, trusted = seen.has_gap or moved, None, None
    if gap and enough:
        progress.begin_stage("locating the gap")
        smoothed = _smooth_about_model(nominal, limits) if seen.smoothed is None else seen.smoothed
        # it knows noise of torques by its spectrum only: too little for a verdict to rest on what it explains
        trusted = None if nominal.problem.has_process_noise else smoothed
        gap = not is_chance_excess(trusted, screened.candidate_scores, before, held, limits)
    clock.lap("localisation")
    fits: tuple[RefitModel, ...] = ()
    added: tuple[SelectedEffect, ...] = ()
    if gap and enough and screened.candidate_scores:
        there = () if smoothed is None else main_gap_locations(localise_gap(smoothed, limits.location_z))
        fits, added = select_effects(search, nominal, screened, [place.location for place in there], bool(changed))
    clock.lap("refits")
    carried = check_transfer(search, added[-1].refitted_model) if added else ()
    if carried:
        last = inflate_std_by_disagreement(added[-1].refitted_model, carried)
        added = (*added[:-1], replace(added[-1], refitted_model=last))
    clock.lap("carry_over")
    total = GapClosure(np.nan, np.nan, np.nan)
    if added:
        total = gap_closure(nominal.held_out_loss, added[-1].refitted_model.held_out_loss, limits=limits)
    explained = compute_explained_fraction(nominal, added, trusted)
    gap = gap and (bool(added) or not moved)  # what parameters explain by moving is no gap
    same = all(entry.is_consistent for entry in carried)
    verdict = decide_verdict(gap, screened.detectability, added, total, limits, enough, explained, same)
    accepted = added if verdict in ("effect", "confusable") else ()
    final = accepted[-1].refitted_model if accepted else nominal
    remaining, where, rest_where = _after(nominal, accepted, smoothed, before, held, limits)
    if accepted:
        # what a better model explains was no event
        events = _happened(seen.whole, final, limits).events
    clock.lap("remaining")
    finding = DiagnosisResult(
        verdict=verdict,
        noise_floor=channel_noise_levels(nominal.problem),
        nominal_test=before,
        nominal_held_out_test=held,
        detectability=screened.detectability,
        confusability=screened.confusability,
        candidate_scores=screened.candidate_scores,
        smoother_result=smoothed,
        gap_locations=where,
        nominal_model=nominal,
        single_effect_models=fits,
        selected_effects=added,
        gap_closure=total,
        remaining_test=remaining,
        remaining_gap_locations=rest_where,
        nominal_changes=nominal_parameter_changes(nominal, final),
        next_experiment=next_experiment_text(verdict, accepted, where, screened.undetectable_labels),
        held_out_names=tuple(episode.name for episode in nominal.problem.held_out),
        is_split_in_blocks=search.problem.is_split_in_blocks,
        message=insufficient_data_message(verdict, before, len(nominal.values), screened.detectability, limits),
        thresholds=limits,
        truncated_recordings=seen.truncated,
        unknown_reason=find_unknown_reason(added, total, limits, explained, same) if verdict == "unknown" else "",
        explained_fraction=explained,
        transfer_checks=carried,
        stage_seconds=clock.laps,
        events=events,
        baseline_comparison=earlier.compare_with_baseline(final, limits),
        counterfactual=earlier.predict_reference_recordings(nominal, accepted, progress),
    )
    return replace(finding, summary=diagnosis_summary_text(finding))


def _undivided(composed: AllCandidatesProblem, problem: EstimationProblem) -> EstimationProblem:
    """The composed problem with all samples, although a diagnosis divides a single recording in blocks."""
    pairs = zip(composed.problem.episodes, problem.episodes, strict=True)
    episodes = [replace(episode, measurements=own.measurements) for episode, own in pairs]
    return composed.problem.with_episodes(episodes, () if composed.is_split_in_blocks else composed.problem.held_out)


@dataclass(frozen=True)
class _Happened:
    """Events about a fit, and what the smoother says about it where it was asked."""

    events: EventSet = NO_EVENTS
    smoothed: SmootherResult | None = None


def _happened(whole: EstimationProblem, fit: RefitModel, limits: Thresholds) -> _Happened:
    """Events about a fit in all that was recorded; nothing where that cannot be predicted."""
    own, x = fit.problem.with_episodes(whole.episodes, whole.held_out), fit.problem.vector(fit.values)
    smoothed = None
    if own.system.free_indices:
        judged = whitened_at(own, x, fit.evaluation.equilibrium_guesses) if own.has_process_noise else own
        residual = judged.evaluate(x, False, fit.evaluation.equilibrium_guesses)
        if not residual.ok:
            return _Happened()
        test = run_null_test(
            residual_channels(judged),
            residual.residual,
            len(fit.values),
            limits.significance_level,
            limits.residual_window,
        )
        if any(window.is_flagged for window in test.windows):
            evaluation = own.evaluate(x, equilibrium_guesses=fit.evaluation.equilibrium_guesses)
            smoothed = _smooth_about_model(replace(fit, problem=own, evaluation=evaluation), limits)
    if smoothed is None:
        evaluation = own.evaluate(x, False, fit.evaluation.equilibrium_guesses)
    if not evaluation.ok:
        return _Happened()
    found = find_events(own, x, evaluation, smoothed, limits)
    pushed = found.only_force_events
    if pushed and _excess(fit, problem_without_events(own, pushed)) > (1 - limits.min_event_chi2_fraction) * _excess(
        fit, own
    ):
        found = found.without_force_events
    return _Happened(found, smoothed)


def _excess(fit: RefitModel, problem: EstimationProblem) -> float:
    """r'r of a fit beyond the number of samples that count, in all of a problem's recordings that can be predicted."""
    x, warm = problem.vector(fit.values), fit.evaluation.equilibrium_guesses
    judged = whitened_at(problem, x, warm) if problem.has_process_noise else problem
    evaluation = judged.evaluate(x, False, warm)
    if not evaluation.ok:
        return math.inf
    rows = [evaluation.residual[judged.residual_rows.data]]
    for i, (episode, result) in enumerate(judged.predict_held_out(x)):
        if not isinstance(result, str):
            rows.append(judged.held_out_residual(i, episode, result).residual)
    counted = np.concatenate(rows)
    return float(counted @ counted) - np.count_nonzero(counted)


def _without_events(
    search: RefitContext, nominal: RefitModel, whole: EstimationProblem
) -> tuple[RefitContext, RefitModel, _Happened]:
    """All that follows without what events explain, the nominal model fitted to that, and the events about it."""
    composed, limits = search.problem, search.thresholds
    happened = _happened(whole, nominal, limits)
    for round_ in range(_MAX_EVENT_ROUNDS):
        if not happened.events:
            return search, nominal, happened
        cleaned = replace(composed, problem=problem_without_events(composed.problem, happened.events))
        search.progress.begin_stage(f"fitting the nominal model without {len(happened.events.disturbances)} events")
        name = f"the nominal model without events, round {round_ + 1}"
        again = _settled(cleaned, nominal.values, search.store, name, limits)
        if again is None:
            break
        search, nominal, before = replace(search, problem=cleaned), again, happened.events
        # what the smoother says is of all recordings, events not taken out
        happened = replace(_happened(whole, nominal, limits), smoothed=None)
        if happened.events.overlaps_with(before):
            break
    return search, nominal, happened


def _tested(
    search: RefitContext, nominal: RefitModel
) -> tuple[RefitContext, NullTestResult, NullTestResult, ScreeningResult]:
    """Null tests and screening at a nominal fit, at which the weights of all hypotheses are frozen."""
    angles, limits = _largest_joint_angles(nominal), search.thresholds
    effects = tuple(effect.with_expected_ranges(angles) for effect in search.problem.candidate_effects)
    composed = replace(search.problem, problem=nominal.problem, candidate_effects=effects)
    before, held = _estimation_null_test(nominal, limits), _held_out_null_test(nominal, limits)
    search.progress.begin_stage(f"screening {len(composed.candidate_effects)} candidates")
    screened = screen_candidates(composed, (), nominal.values, limits)
    return replace(search, problem=composed), before, held, screened


def _followed(
    search: RefitContext, nominal: RefitModel, before: tuple[TruncatedRecording, ...] = ()
) -> tuple[RefitContext, RefitModel, tuple[TruncatedRecording, ...]]:
    """The nominal model beside held-out recordings as far as it can follow them, fitted again where they were cut."""
    found = before
    for margin in TRUNCATION_FRACTIONS:
        if np.isfinite(nominal.held_out_loss.chi2_per_sample):
            break
        composed, cuts = replace(search.problem, problem=nominal.problem).truncate_held_out(nominal.values, margin)
        for cut in cuts:
            search.progress.begin_stage(truncation_message(cut))
        names = {cut.recording for cut in cuts}
        found = (*(cut for cut in found if cut.recording not in names), *cuts)
        name = f"the nominal model beside what it can follow ({margin:g})"
        again = _settled(composed, nominal.values, search.store, name, search.thresholds)
        if again is not None:
            search, nominal = replace(search, problem=composed), again
    return search, nominal, found


def _offsets_stated(problem: EstimationProblem) -> bool:
    driving = (
        e.input_errors is not None and bool(np.any(e.input_errors.torque_bias_std > 0)) for e in problem.episodes
    )
    return any(driving) or any(e.has_constant_sensor_errors for e in problem.episodes)


def _better_nominal_fit(search: RefitContext, nominal: RefitModel) -> RefitModel | None:
    """Return the nominal model refitted from a start that ends far likelier; None if no start does."""
    search.progress.begin_stage("fitting the nominal model from other starts")
    problem, limits = search.problem.problem, search.thresholds

    def begun(factor: float) -> RefitModel | None:
        start = problem.named_values(
            np.where(
                problem.is_positive,
                np.clip(factor * problem.initial_unknowns, *problem.bounds),
                problem.initial_unknowns,
            )
        )
        name = f"the nominal model from {factor:g} times its start"
        return refit_with_effects(search.problem, (), start, search.store, name, limits)

    best = nominal
    for found in map_with_batched_calls(begun, RESTART_FACTORS):
        if found is not None and found.cost < best.cost - limits.min_log_bayes_factor:
            best = found
    if best is nominal:
        return None
    return _settled(search.problem, best.values, search.store, "the nominal model from a better start", limits)


def _settled(
    composed: AllCandidatesProblem, start: Mapping[str, float], store: RefitStore | None, name: str, limits: Thresholds
) -> RefitModel | None:
    """The nominal model fitted from a start, under weights that were frozen near its end."""
    if composed.problem.has_process_noise:
        composed, start = _nearer(composed, start, limits)
        composed = composed.whitened_at(start)
    return refit_with_effects(composed, (), start, store, name, limits)


def _nearer(
    composed: AllCandidatesProblem, start: Mapping[str, float], limits: Thresholds
) -> tuple[AllCandidatesProblem, Mapping[str, float]]:
    """The problem weighted at a start, and the nominal fit under these weights."""
    weighted = composed.whitened_at(start)
    first = refit_with_effects(weighted, (), start, limits=limits)
    return weighted, start if first is None else first.values


def _composed(
    problem: EstimationProblem,
    candidates: CandidateChoice,
    leave_out: Sequence[str],
    held_out: Sequence[Recording],
    progress: Progress,
) -> AllCandidatesProblem:
    """The problem with all candidates; see `diagnose` for what is refused."""
    if problem.options.weighting != "whitened":
        raise SolverError(
            "a diagnosis needs residuals in units of their noise",
            where="problem.weighting",
            allowed="whitened",
            hint="set problem.weighting: whitened and the noise levels under `sensors`",
        )
    effects = make_candidate_effects(problem.system, [episode.recording for episode in problem.episodes], candidates)
    exclude_candidates(effects, leave_out)  # refused before anything is compiled
    progress.begin_stage(f"composing {len(effects)} candidates into one step")
    composed = AllCandidatesProblem.from_problem(problem, effects, held_out)
    return replace(composed, candidate_effects=tuple(exclude_candidates(composed.candidate_effects, leave_out)))


def _after(
    nominal: RefitModel,
    accepted: Sequence[SelectedEffect],
    smoothed: SmootherResult | None,
    before: NullTestResult,
    held: NullTestResult,
    limits: Thresholds,
) -> tuple[NullTestResult, tuple[GapLocation, ...], tuple[GapLocation, ...]]:
    """The held-out null test with the effects, the places of the gap, and those of what is left of it."""
    where = () if smoothed is None else localise_gap(smoothed, limits.location_z)
    if not accepted:
        return held, where, where
    last = accepted[-1].refitted_model
    remaining = _held_out_null_test(last, limits)
    left = has_gap(_estimation_null_test(last, limits), remaining, limits)
    rest = localise_gap(_smooth_about_model(last, limits), limits.location_z) if left else ()
    windows = merge_intervals([(w.start_time, w.end_time) for w in before.windows if w.is_flagged])
    return remaining, attribute_gap_to_effects(where, _closed(accepted), rest, windows), rest


class _Clock:
    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.laps: dict[str, float] = {}

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now


def fit_nominal_model(
    problem: EstimationProblem,
    composed: AllCandidatesProblem,
    solution: Solution | None = None,
    store: RefitStore | None = None,
    limits: Thresholds = DEFAULT_THRESHOLDS,
) -> RefitModel:
    """Return the fit of the nominal model within the problem with all candidates.

    Raises
    ------
    SolverError
        The nominal model cannot be rolled out.
    """
    known = load_stored_refit(composed, (), store)
    if known is not None and composed.problem.has_process_noise:
        known = load_stored_refit(composed.whitened_at(known.values), (), store)
    if known is not None:
        return known
    start = _nominal_start(problem, composed, solution)
    fit = _settled(composed, start, store, "", limits)
    if fit is None and start:
        # a gap may drive parameters so far that the equilibrium which the solver followed is not found again from there
        fit = _settled(composed, {}, store, "the nominal model from its start", limits)
    if fit is None:
        raise SolverError("the nominal model cannot be rolled out at its fit", where="diagnosis")
    return fit


def _nominal_start(
    problem: EstimationProblem, composed: AllCandidatesProblem, solution: Solution | None
) -> Mapping[str, float]:
    """Unknowns of the nominal model's solution; nothing where a single recording is both fitted and held out."""
    if solution is None and composed.is_split_in_blocks:
        return {}
    found = solve(problem, GaussNewton(max_iterations=30)) if solution is None else solution
    if found.evaluation is None:
        raise SolverError(f"the nominal model cannot be fitted: {found.message}", where="diagnosis")
    return dict(zip(found.unknown_names, map(float, found.x), strict=True))


def _largest_joint_angles(fit: RefitModel) -> dict[str, float]:
    """Return the largest joint angle of each segment in the estimation recordings [rad]."""
    system = fit.problem.system
    found = {}
    for segment in system.segment_layouts:
        index = [system.mechanism.joint_index(joint) for link in segment.link_joints for joint in link]
        found[segment.name] = max(
            float(np.abs(r.rollout.state[:, index]).max()) for r in fit.evaluation.episode_predictions
        )
    return found


def _estimation_null_test(fit: RefitModel, limits: Thresholds = DEFAULT_THRESHOLDS) -> NullTestResult:
    """Return the null test of a model on the estimation recordings."""
    series = residual_channels(fit.problem)
    return run_null_test(
        series, fit.evaluation.residual, len(fit.values), limits.significance_level, limits.residual_window
    )


def _held_out_null_test(fit: RefitModel, limits: Thresholds = DEFAULT_THRESHOLDS) -> NullTestResult:
    """Return the null test of a model on the held-out recordings."""
    problem = fit.problem
    residuals, slopes = [], []
    for i, (episode, result) in enumerate(problem.predict_held_out(problem.vector(fit.values), True)):
        if isinstance(result, str):
            raise DataError(
                f"the held-out recording cannot be predicted: {result}",
                where=episode.name,
                hint="hold out a recording that the nominal model can follow",
            )
        rows = problem.held_out_residual(i, episode, result)
        assert rows.jacobian is not None
        residuals.append(rows.residual)
        slopes.append(rows.jacobian[:, : len(problem.shared_parameters)])
    series = residual_channels(problem.with_episodes(problem.held_out, ()))
    spread = np.vstack(slopes) @ noise_covariance_factor(problem, fit.evaluation)[: len(problem.shared_parameters)]
    residual = whiten_with_extra_errors(np.concatenate(residuals), spread)
    return run_null_test(series, residual, 0, limits.significance_level, limits.residual_window)


def _smooth_about_model(fit: RefitModel, limits: Thresholds = DEFAULT_THRESHOLDS) -> SmootherResult:
    """Run the weak-constraint smoother about a fitted model, with torque noise among its unknowns."""
    problem, evaluation, x = fit.problem, fit.evaluation, fit.problem.vector(fit.values)
    if problem.has_process_noise:
        problem = whitened_by_sensor_noise(problem)
        evaluation = problem.evaluate(x, equilibrium_guesses=fit.evaluation.equilibrium_guesses)
    if any(episode.has_constant_sensor_errors for episode in problem.episodes):
        pairs = zip(problem.episodes, evaluation.episode_predictions, strict=True)
        less = [
            replace(e, measurements=subtract_estimated_biases(e.measurements, result.predicted_outputs))
            for e, result in pairs
        ]
        problem = problem.with_episodes(less, ())
        evaluation = problem.evaluate(x, equilibrium_guesses=evaluation.equilibrium_guesses)
    return run_smoother(problem, x, evaluation, limits)


def _closed(added: Sequence[SelectedEffect]) -> dict[str, float]:
    """What the effects at every location close, of the whole gap, each by what it adds to those before it."""
    closed: dict[str, float] = {}
    before = 0.0
    for entry in added:
        closed[entry.effect.location] = closed.get(entry.effect.location, 0.0) + max(
            entry.cumulative_closure.fraction - before, 0.0
        )
        before = max(entry.cumulative_closure.fraction, before)
    return closed

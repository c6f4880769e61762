"""Diagnosis of the sim-to-real gap: all steps in order, from the nominal fit to the verdict."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import threadpoolctl

from yid_ocp.analysis.history import Estimates
from yid_ocp.data.recording import Recording
from yid_ocp.diagnosis.baseline import with_baseline
from yid_ocp.diagnosis.carry_over import carried_over, counting_both
from yid_ocp.diagnosis.earlier import UNTOLD, Earlier
from yid_ocp.diagnosis.events import NOTHING, Events, find_events, without_events
from yid_ocp.diagnosis.finding import Finding, absorption
from yid_ocp.diagnosis.hypotheses import MARGINS, CandidateProblem, Choice, Cut, chosen_effects, left_out
from yid_ocp.diagnosis.localise import Place, attributed, localise, main_places, merged
from yid_ocp.diagnosis.refit import Fit, Search, Store, recalled, refit
from yid_ocp.diagnosis.screening import Screened, screen
from yid_ocp.diagnosis.select import Added, Closure, closure, compose
from yid_ocp.diagnosis.smoother import Smoothed, smooth
from yid_ocp.diagnosis.thresholds import DEFAULTS, Thresholds
from yid_ocp.diagnosis.verdict import decide, explained_part, has_gap, shapeless, why_unknown
from yid_ocp.diagnosis.words import cut_short, next_experiment, sentences, shortage
from yid_ocp.errors import DataError, SolverError
from yid_ocp.parallel import map_in_step
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.constant_errors import without_constants
from yid_ocp.problem.null_test import NullTest, noise_floor, null_test, residual_series, whitened_beside
from yid_ocp.progress import Logged, Progress
from yid_ocp.solvers import GaussNewton, Solution, solve
from yid_ocp.solvers.base import RESTARTS
from yid_ocp.solvers.judgement import spread_by_noise

log = logging.getLogger(__name__)

ROUNDS = 3
"""Maximum number of refits of the nominal model, each without the events found before it."""


def diagnose(
    problem: EstimationProblem,
    candidates: Choice = "all",
    held_out: Sequence[Recording] = (),
    *,
    thresholds: Thresholds | None = None,
    solution: Solution | None = None,
    progress: Progress | None = None,
    store: Store | None = None,
    baseline: Estimates | Sequence[Estimates] = (),
    without: Sequence[Recording] = (),
    leave_out: Sequence[str] = (),
) -> Finding:
    """Diagnose the gap between model and recordings: whether it exists, where, its cause, and how far it closes.

    Parameters
    ----------
    problem : EstimationProblem
        Of the nominal model, with the stiffnesses free.
    candidates : "all" or sequence of str
        `kind` or `kind@location`.
    held_out : sequence of Recording
        Never touched by a fit; the problem's own where absent. Where there are none, alternate blocks are held out.
    thresholds : Thresholds, optional
    solution : Solution, optional
        Of the nominal problem, where it is known.
    progress : Progress, optional
        Told what is going on; the package's log when absent.
    store : Store, optional
        Of refits that an earlier run of the same diagnosis finished; told of every further one.
    baseline : Estimates or sequence of Estimates, optional
        What earlier runs of the same model say of its parameters (`read_estimates`): priors, so that the question is
        what differs now. A problem that has them already (`with_baseline`) is taken as it is.
    without : sequence of Recording, optional
        Made without what is looked for: what the effects found are taken out for (`counterfactual`).
    leave_out : sequence of str, optional
        Candidates that are not tried, `kind` or `kind@location`.

    Returns
    -------
    Finding

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
        clock, told = _Clock(), progress or Logged(log)
        runs = (baseline,) if isinstance(baseline, Estimates) else tuple(baseline)
        earlier = Earlier.of(runs, tuple(without))
        if earlier.known is not None and not problem.options.joint_prior.names:
            problem = with_baseline(problem, earlier.known)
        composed = _composed(problem, candidates, leave_out, held_out, told)
        clock.lap("compose")
        search = Search(composed, thresholds or DEFAULTS, told, store)
        return _diagnosed(problem, search, solution, clock, earlier)


def _diagnosed(
    problem: EstimationProblem, search: Search, solution: Solution | None, clock: _Clock, earlier: Earlier = UNTOLD
) -> Finding:
    limits, progress = search.limits, search.progress
    progress.stage("fitting the nominal model")
    nominal = nominal_fit(problem, search.problem, solution, search.store, limits)
    search, nominal, cuts = _followed(search, nominal)
    clock.lap("nominal")
    progress.stage("looking for events")
    whole = _undivided(search.problem, problem)
    search, nominal, happened = _without_events(search, nominal, whole)
    events, about = happened.events, nominal
    clock.lap("events")
    search, before, held, screened = _tested(search, nominal)
    clock.lap("screening")
    enough = before.degrees >= limits.samples_per_unknown * len(nominal.values)
    offsets = _offsets_stated(nominal.problem)
    smoothed, trusted, gap = None, None, has_gap(before, held, limits, screened.scores, offsets)
    other = elsewhere(search, nominal) if gap and enough and before.chi2_per_dof < limits.poor else None
    if other is not None:
        search, nominal, cuts = _followed(search, other, cuts)
        search, before, held, screened = _tested(search, nominal)
        gap = has_gap(before, held, limits, screened.scores, offsets)
    changed = earlier.changed(nominal, limits)
    clock.lap("other_starts")
    moved = bool(changed) and not gap
    gap = gap or moved
    if gap and enough:
        progress.stage("locating the gap")
        # where nothing happened it was run on all that was fitted already
        known = happened.smoothed if nominal is about and not search.problem.blocks else None
        smoothed = smooth_fit(nominal, limits) if known is None else known
        # it knows noise of torques by its spectrum only: too little for a verdict to rest on what it explains
        trusted = None if nominal.problem.disturbed else smoothed
        gap = not shapeless(trusted, screened.scores, before, held, limits)
    clock.lap("localisation")
    fits: tuple[Fit, ...] = ()
    added: tuple[Added, ...] = ()
    if gap and enough and screened.scores:
        there = () if smoothed is None else main_places(localise(smoothed, limits.sure))
        fits, added = compose(search, nominal, screened, [place.location for place in there], bool(changed))
    clock.lap("refits")
    carried = carried_over(search, added[-1].fit) if added else ()
    if carried:
        added = (*added[:-1], replace(added[-1], fit=counting_both(added[-1].fit, carried)))
    clock.lap("carry_over")
    total = closure(nominal.loss, added[-1].fit.loss, limits=limits) if added else Closure(np.nan, np.nan, np.nan)
    explained = explained_part(nominal, added, trusted)
    gap = gap and (bool(added) or not moved)  # what parameters explain by moving is no gap
    same = all(entry.agrees for entry in carried)
    verdict = decide(gap, screened.visible, added, total, limits, enough, explained, same)
    accepted = added if verdict in ("effect", "confusable") else ()
    remaining, where, rest_where = _after(nominal, accepted, smoothed, before, held, limits)
    if accepted:
        # what a better model explains was no event
        events = _happened(whole, accepted[-1].fit, limits).events
    clock.lap("remaining")
    finding = Finding(
        verdict=verdict,
        floor=noise_floor(nominal.problem),
        before=before,
        held_out_before=held,
        visibility=screened.visible,
        confusability=screened.alike,
        scores=screened.scores,
        smoothed=smoothed,
        where=where,
        nominal=nominal,
        fits=fits,
        added=added,
        closure=total,
        remaining=remaining,
        remaining_where=rest_where,
        absorbed=absorption(nominal, accepted[-1].fit if accepted else nominal),
        next_experiment=next_experiment(verdict, accepted, where, screened.unseen),
        held_out=tuple(episode.name for episode in nominal.problem.held_out),
        in_blocks=search.problem.blocks,
        message=shortage(verdict, before, len(nominal.values), screened.visible, limits),
        limits=limits,
        cuts=cuts,
        reason=why_unknown(added, total, limits, explained, same) if verdict == "unknown" else "",
        explained=explained,
        carried=carried,
        seconds=clock.laps,
        events=events,
        since=earlier.since(accepted[-1].fit if accepted else nominal, limits),
        counterfactual=earlier.counterfactual(nominal, accepted, progress),
    )
    return replace(finding, summary=sentences(finding))


def _undivided(composed: CandidateProblem, problem: EstimationProblem) -> EstimationProblem:
    """The composed problem with all samples, although a diagnosis divides a single recording in blocks."""
    pairs = zip(composed.problem.episodes, problem.episodes, strict=True)
    episodes = [replace(episode, samples=own.samples) for episode, own in pairs]
    return composed.problem.on(episodes, () if composed.blocks else composed.problem.held_out)


@dataclass(frozen=True)
class _Happened:
    """Events about a fit, and what the smoother says about it where it was asked."""

    events: Events = NOTHING
    smoothed: Smoothed | None = None


def _happened(whole: EstimationProblem, fit: Fit, limits: Thresholds) -> _Happened:
    """Events about a fit in all that was recorded; nothing where that cannot be predicted.

    Forces that take little of the gap with them are the largest errors of a model that errs everywhere.
    """
    own, x = fit.problem.on(whole.episodes, whole.held_out), fit.problem.vector(fit.values)
    smoothed = None
    if own.system.free_indices:
        judged = own.weighted_at(x, fit.evaluation.warm) if own.disturbed else own
        residual = judged.evaluate(x, False, fit.evaluation.warm)
        if not residual.ok:
            return _Happened()
        test = null_test(residual_series(judged), residual.residual, len(fit.values), limits.level, limits.window)
        if any(window.flagged for window in test.windows):
            evaluation = own.evaluate(x, warm=fit.evaluation.warm)
            smoothed = smooth_fit(replace(fit, problem=own, evaluation=evaluation), limits)
    if smoothed is None:
        evaluation = own.evaluate(x, False, fit.evaluation.warm)
    if not evaluation.ok:
        return _Happened()
    found = find_events(own, x, evaluation, smoothed, limits)
    pushed = found.forces_alone
    if pushed and _excess(fit, without_events(own, pushed)) > (1 - limits.event_share) * _excess(fit, own):
        found = found.without_forces
    return _Happened(found, smoothed)


def _excess(fit: Fit, problem: EstimationProblem) -> float:
    """r'r of a fit beyond the number of samples that count, in all of a problem's recordings that can be predicted."""
    x, warm = problem.vector(fit.values), fit.evaluation.warm
    judged = problem.weighted_at(x, warm) if problem.disturbed else problem
    evaluation = judged.evaluate(x, False, warm)
    if not evaluation.ok:
        return math.inf
    rows = [evaluation.residual[judged.rows.data]]
    for i, (episode, result) in enumerate(judged.validate(x)):
        if not isinstance(result, str):
            rows.append(judged.held_out_rows(i, episode, result).residual)
    counted = np.concatenate(rows)
    return float(counted @ counted) - np.count_nonzero(counted)


def _without_events(search: Search, nominal: Fit, whole: EstimationProblem) -> tuple[Search, Fit, _Happened]:
    """All that follows without what events explain, the nominal model fitted to that, and the events about it.

    Pushes pull a fit towards them: about a fit without those that were found, others may show.
    """
    composed, limits = search.problem, search.limits
    happened = _happened(whole, nominal, limits)
    for round_ in range(ROUNDS):
        if not happened.events:
            return search, nominal, happened
        cleaned = replace(composed, problem=without_events(composed.problem, happened.events))
        search.progress.stage(f"fitting the nominal model without {len(happened.events.found)} events")
        name = f"the nominal model without events, round {round_ + 1}"
        again = _settled(cleaned, nominal.values, search.store, name, limits)
        if again is None:
            break
        search, nominal, before = replace(search, problem=cleaned), again, happened.events
        # what the smoother says is of all recordings, events not taken out
        happened = replace(_happened(whole, nominal, limits), smoothed=None)
        if happened.events.like(before):
            break
    return search, nominal, happened


def _tested(search: Search, nominal: Fit) -> tuple[Search, NullTest, NullTest, Screened]:
    """Null tests and screening at a nominal fit, at which the weights of all hypotheses are frozen."""
    angles, limits = largest_angles(nominal), search.limits
    effects = tuple(effect.expected(angles) for effect in search.problem.effects)
    composed = replace(search.problem, problem=nominal.problem, effects=effects)
    before, held = fitted_test(nominal, limits), held_out_test(nominal, limits)
    search.progress.stage(f"screening {len(composed.effects)} candidates")
    screened = screen(composed, (), nominal.values, limits)
    return replace(search, problem=composed), before, held, screened


def _followed(search: Search, nominal: Fit, before: tuple[Cut, ...] = ()) -> tuple[Search, Fit, tuple[Cut, ...]]:
    """The nominal model beside held-out recordings as far as it can follow them, fitted again where they were cut."""
    found = before
    for margin in MARGINS:
        if np.isfinite(nominal.loss.mean):
            break
        composed, cuts = replace(search.problem, problem=nominal.problem).followed(nominal.values, margin)
        for cut in cuts:
            search.progress.stage(cut_short(cut))
        names = {cut.recording for cut in cuts}
        found = (*(cut for cut in found if cut.recording not in names), *cuts)
        name = f"the nominal model beside what it can follow ({margin:g})"
        again = _settled(composed, nominal.values, search.store, name, search.limits)
        if again is not None:
            search, nominal = replace(search, problem=composed), again
    return search, nominal, found


def _offsets_stated(problem: EstimationProblem) -> bool:
    driving = (e.errors is not None and bool(np.any(e.errors.bias_std > 0)) for e in problem.episodes)
    return any(driving) or any(e.has_constant_errors for e in problem.episodes)


def elsewhere(search: Search, nominal: Fit) -> Fit | None:
    """Return the nominal model refitted from a start that ends far likelier; None if no start does.

    A parameter that few samples tell of has several valleys, and a wrong one of them costs too little to be noticed in
    chi2: what candidates gain there, they gain from the parameter's error.
    """
    search.progress.stage("fitting the nominal model from other starts")
    problem, limits = search.problem.problem, search.limits

    def begun(factor: float) -> Fit | None:
        start = problem.named(
            np.where(problem.positive, np.clip(factor * problem.start, *problem.bounds), problem.start)
        )
        name = f"the nominal model from {factor:g} times its start"
        return refit(search.problem, (), start, search.store, name, limits)

    best = nominal
    for found in map_in_step(begun, RESTARTS):
        if found is not None and found.cost < best.cost - limits.worth:
            best = found
    if best is nominal:
        return None
    return _settled(search.problem, best.values, search.store, "the nominal model from a better start", limits)


def _settled(
    composed: CandidateProblem, start: Mapping[str, float], store: Store | None, name: str, limits: Thresholds
) -> Fit | None:
    """The nominal model fitted from a start, under weights that were frozen near its end."""
    if composed.problem.disturbed:
        composed, start = _nearer(composed, start, limits)
        composed = composed.weighted_at(start)
    return refit(composed, (), start, store, name, limits)


def _nearer(
    composed: CandidateProblem, start: Mapping[str, float], limits: Thresholds
) -> tuple[CandidateProblem, Mapping[str, float]]:
    """The problem weighted at a start, and the nominal fit under these weights."""
    weighted = composed.weighted_at(start)
    first = refit(weighted, (), start, limits=limits)
    return weighted, start if first is None else first.values


def _composed(
    problem: EstimationProblem,
    candidates: Choice,
    leave_out: Sequence[str],
    held_out: Sequence[Recording],
    progress: Progress,
) -> CandidateProblem:
    """The problem with all candidates; see `diagnose` for what is refused."""
    if problem.options.weighting != "whitened":
        raise SolverError(
            "a diagnosis needs residuals in units of their noise",
            where="problem.weighting",
            allowed="whitened",
            hint="set problem.weighting: whitened and the noise levels under `sensors`",
        )
    effects = chosen_effects(problem.system, [episode.recording for episode in problem.episodes], candidates)
    left_out(effects, leave_out)  # refused before anything is compiled
    progress.stage(f"composing {len(effects)} candidates into one step")
    composed = CandidateProblem.of(problem, effects, held_out)
    return replace(composed, effects=tuple(left_out(composed.effects, leave_out)))


def _after(
    nominal: Fit,
    accepted: Sequence[Added],
    smoothed: Smoothed | None,
    before: NullTest,
    held: NullTest,
    limits: Thresholds,
) -> tuple[NullTest, tuple[Place, ...], tuple[Place, ...]]:
    """The held-out null test with the effects, the places of the gap, and those of what is left of it."""
    where = () if smoothed is None else localise(smoothed, limits.sure)
    if not accepted:
        return held, where, where
    last = accepted[-1].fit
    remaining = held_out_test(last, limits)
    left = has_gap(fitted_test(last, limits), remaining, limits)
    rest = localise(smooth_fit(last, limits), limits.sure) if left else ()
    windows = merged([(w.begin, w.end) for w in before.windows if w.flagged])
    return remaining, attributed(where, _closed(accepted), rest, windows), rest


class _Clock:
    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.laps: dict[str, float] = {}

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now


def nominal_fit(
    problem: EstimationProblem,
    composed: CandidateProblem,
    solution: Solution | None = None,
    store: Store | None = None,
    limits: Thresholds = DEFAULTS,
) -> Fit:
    """Return the fit of the nominal model within the problem with all candidates.

    Raises
    ------
    SolverError
        The nominal model cannot be rolled out.
    """
    known = recalled(composed, (), store)
    if known is not None and composed.problem.disturbed:
        known = recalled(composed.weighted_at(known.values), (), store)
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
    problem: EstimationProblem, composed: CandidateProblem, solution: Solution | None
) -> Mapping[str, float]:
    """Unknowns of the nominal model's solution; nothing where a single recording is both fitted and held out."""
    found = solution if solution is not None or composed.blocks else solve(problem, GaussNewton(iterations=30))
    if found is None:
        return {}
    if found.evaluation is None:
        raise SolverError(f"the nominal model cannot be fitted: {found.message}", where="diagnosis")
    return dict(zip(found.names, map(float, found.x), strict=True))


def largest_angles(fit: Fit) -> dict[str, float]:
    """Return the largest joint angle of each segment in the estimation recordings [rad]."""
    system = fit.problem.system
    found = {}
    for segment in system.segments:
        index = [system.mechanism.joint_index(joint) for link in segment.links for joint in link]
        found[segment.name] = max(float(np.abs(r.rollout.state[:, index]).max()) for r in fit.evaluation.episodes)
    return found


def fitted_test(fit: Fit, limits: Thresholds = DEFAULTS) -> NullTest:
    """Return the null test of a model on the estimation recordings."""
    series = residual_series(fit.problem)
    return null_test(series, fit.evaluation.residual, len(fit.values), limits.level, limits.window)


def held_out_test(fit: Fit, limits: Thresholds = DEFAULTS) -> NullTest:
    """Return the null test of a model on the held-out recordings.

    What is held out is predicted by parameters that noise has moved: without a gap the residual has the covariance
    I + J F F' J', where F F' is that of the parameters (`spread_by_noise`). It is tested in units of that.

    Raises
    ------
    DataError
        A held-out recording cannot be predicted by the nominal model.
    """
    problem = fit.problem
    residuals, slopes = [], []
    for i, (episode, result) in enumerate(problem.validate(problem.vector(fit.values), True)):
        if isinstance(result, str):
            raise DataError(
                f"the held-out recording cannot be predicted: {result}",
                where=episode.name,
                hint="hold out a recording that the nominal model can follow",
            )
        rows = problem.held_out_rows(i, episode, result)
        assert rows.jacobian is not None
        residuals.append(rows.residual)
        slopes.append(rows.jacobian[:, : len(problem.shared)])
    series = residual_series(problem.on(problem.held_out, ()))
    spread = np.vstack(slopes) @ spread_by_noise(problem, fit.evaluation)[: len(problem.shared)]
    residual = whitened_beside(np.concatenate(residuals), spread)
    return null_test(series, residual, 0, limits.level, limits.window)


def smooth_fit(fit: Fit, limits: Thresholds = DEFAULTS) -> Smoothed:
    """Run the weak-constraint smoother about a fitted model, with torque noise among its unknowns.

    Estimated constant sensor errors are subtracted first.
    """
    problem, evaluation, x = fit.problem, fit.evaluation, fit.problem.vector(fit.values)
    if problem.disturbed:
        problem = problem.weighted_by_sensors()
        evaluation = problem.evaluate(x, warm=fit.evaluation.warm)
    if any(episode.has_constant_errors for episode in problem.episodes):
        pairs = zip(problem.episodes, evaluation.episodes, strict=True)
        less = [replace(e, samples=without_constants(e.samples, result.predicted)) for e, result in pairs]
        problem = problem.on(less, ())
        evaluation = problem.evaluate(x, warm=evaluation.warm)
    return smooth(problem, x, evaluation, limits)


def _closed(added: Sequence[Added]) -> dict[str, float]:
    """What the effects at every location close, of the whole gap, each by what it adds to those before it."""
    closed: dict[str, float] = {}
    before = 0.0
    for entry in added:
        closed[entry.effect.location] = closed.get(entry.effect.location, 0.0) + max(entry.closure.value - before, 0.0)
        before = max(entry.closure.value, before)
    return closed

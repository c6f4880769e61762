"""All steps of a diagnosis, one after the other."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import threadpoolctl
from numpy.typing import NDArray

from yid_ocp.data.recording import Recording
from yid_ocp.diagnosis.hypotheses import CandidateProblem, Choice, Series, chosen_effects, describe, residual_series
from yid_ocp.diagnosis.localise import attributed, localise, merged
from yid_ocp.diagnosis.null_test import NullTest, noise_floor, null_test
from yid_ocp.diagnosis.screening import Confusability, Score, Visibility, confusability, linearise, visibility
from yid_ocp.diagnosis.screening import scores as score_all
from yid_ocp.diagnosis.select import Closure, Fit, Store, closure, gain, recalled, refit, refit_all, within_reach
from yid_ocp.diagnosis.smoother import Smoothed, smooth
from yid_ocp.diagnosis.verdict import Absorbed, Added, Finding, Thresholds, decide, has_gap, next_experiment, shapeless
from yid_ocp.effects import EffectBase
from yid_ocp.errors import DataError, SolverError
from yid_ocp.problem import EstimationProblem
from yid_ocp.solvers import GaussNewton, Solution, solve

Array = NDArray[np.float64]
Progress = Callable[[str], None]
log = logging.getLogger(__name__)


def diagnose(
    problem: EstimationProblem,
    candidates: Choice = "all",
    held_out: Sequence[Recording] = (),
    *,
    thresholds: Thresholds | None = None,
    solution: Solution | None = None,
    progress: Progress | None = None,
    store: Store | None = None,
) -> Finding:
    """Say whether there is a gap between model and recordings, where, which effect makes it, and how far it closes.

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
    progress : callable, optional
        Told in words what is going on.
    store : Store, optional
        Of refits that an earlier run of the same diagnosis finished; told of every further one.

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
        return _diagnosed(
            problem, candidates, held_out, thresholds or Thresholds(), solution, progress or log.info, store
        )


def _diagnosed(
    problem: EstimationProblem,
    candidates: Choice,
    held_out: Sequence[Recording],
    limits: Thresholds,
    solution: Solution | None,
    say: Progress,
    store: Store | None,
) -> Finding:
    clock = _Clock()
    if problem.options.weighting != "whitened":
        raise SolverError(
            "a diagnosis needs residuals in units of their noise",
            where="problem.weighting",
            allowed="whitened",
            hint="set problem.weighting: whitened and the noise levels under `sensors`",
        )
    effects = chosen_effects(problem.system, [episode.recording for episode in problem.episodes], candidates)
    say(f"composing {len(effects)} candidates into one step")
    composed = CandidateProblem.of(problem, effects, held_out)
    clock.lap("compose")
    say("fitting the nominal model")
    nominal = nominal_fit(problem, composed, solution, store)
    angles = largest_angles(nominal)
    composed.effects = tuple(effect.expected(angles) for effect in composed.effects)
    clock.lap("nominal")
    free = composed.freeing(())
    series = residual_series(free)
    before = null_test(series, nominal.evaluation.residual, len(nominal.values), limits.level)
    held = held_out_test(nominal, limits.level)
    clock.lap("null_test")
    say(f"screening {len(effects)} candidates")
    point = linearise(composed, (), nominal.values)
    seen = visibility(point)
    ranked = score_all(point, series, seen)
    alike = confusability(point, ranked)
    clock.lap("screening")
    enough = before.degrees >= limits.samples_per_unknown * len(nominal.values)
    gap = has_gap(before, held, limits, ranked)
    fits: tuple[Fit, ...] = ()
    added: tuple[Added, ...] = ()
    smoothed = None
    if gap and enough:
        say("locating the gap")
        smoothed = smooth_fit(nominal)
        gap = not shapeless(smoothed, ranked, before, held, limits)
    clock.lap("localisation")
    if gap and enough and ranked:
        fits, added = compose(composed, nominal, ranked, alike, limits, say, store)
    clock.lap("refits")
    total = closure(nominal.loss, added[-1].fit.loss) if added else Closure(np.nan, np.nan, np.nan)
    verdict = decide(gap, seen, added, total, limits, enough, explained_part(nominal, added, smoothed))
    accepted = added if verdict in ("effect", "confusable") else ()
    last = accepted[-1].fit if accepted else nominal
    where = () if smoothed is None else localise(smoothed)
    remaining, rest_where = held, where
    if accepted:
        remaining = held_out_test(last, limits.level)
        after = null_test(series, last.evaluation.residual, len(last.values), limits.level)
        rest_where = localise(smooth_fit(last)) if has_gap(after, remaining, limits) else ()
        where = attributed(
            where, _closed(accepted), rest_where, merged([(w.begin, w.end) for w in before.windows if w.flagged])
        )
    clock.lap("remaining")
    unseen = [entry.effect.label for entry in seen if not entry.visible]
    return Finding(
        verdict,
        noise_floor(free),
        before,
        held,
        seen,
        alike,
        ranked,
        smoothed,
        where,
        nominal,
        fits,
        added,
        total,
        remaining,
        rest_where,
        absorption(nominal, last),
        next_experiment(verdict, accepted, where, unseen),
        tuple(episode.name for episode in composed.held_out),
        composed.blocks,
        _message(verdict, before, nominal, seen, limits),
        clock.laps,
    )


class _Clock:
    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.laps: dict[str, float] = {}

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now


def nominal_fit(
    problem: EstimationProblem, composed: CandidateProblem, solution: Solution | None = None, store: Store | None = None
) -> Fit:
    """The nominal model fitted and placed among the hypotheses.

    Raises
    ------
    SolverError
        The nominal model cannot be rolled out.
    """
    start: Mapping[str, float] = {}
    known = recalled(composed, (), store)
    if known is not None:
        return known
    if not composed.blocks:
        found = solution or solve(problem, GaussNewton(iterations=30))
        if found.evaluation is None:
            raise SolverError(f"the nominal model cannot be fitted: {found.message}", where="diagnosis")
        start = dict(zip(found.names, map(float, found.x), strict=True))
    elif solution is not None:
        start = dict(zip(solution.names, map(float, solution.x), strict=True))
    fit = refit(composed, (), start, store)
    if fit is None:
        raise SolverError("the nominal model cannot be rolled out at its fit", where="diagnosis")
    return fit


def largest_angles(fit: Fit) -> dict[str, float]:
    """How far the joints of each segment turn in the recordings that were fitted [rad]."""
    system = fit.problem.system
    found = {}
    for segment in system.segments:
        index = [system.mechanism.joint_index(joint) for link in segment.links for joint in link]
        found[segment.name] = max(float(np.abs(r.rollout.state[:, index]).max()) for r in fit.evaluation.episodes)
    return found


def held_out_test(fit: Fit, level: float) -> NullTest:
    """The null test of a model on the held-out recordings, in which nothing was fitted.

    Raises
    ------
    DataError
        A held-out recording cannot be predicted by the nominal model.
    """
    problem = fit.problem
    x = problem.unknowns(fit.values)
    residuals = []
    for episode, result in problem.validate(x):
        if isinstance(result, str):
            raise DataError(
                f"the held-out recording cannot be predicted: {result}",
                where=episode.name,
                hint="hold out a recording that the nominal model can follow",
            )
        for samples, predicted in zip(episode.samples, result.predicted, strict=True):
            keep = samples.weight > 0
            difference = np.where(keep, predicted - samples.value, 0.0)
            residuals.append((samples.weight * difference)[keep])
    return null_test(_held_series(problem), np.concatenate(residuals), 0, level)


def _held_series(problem: CandidateProblem) -> tuple[Series, ...]:
    swapped = problem.freeing(())
    swapped.episodes = problem.held_out
    return residual_series(swapped)


def shortlist(
    ranked: Sequence[Score], alike: Confusability, limits: Thresholds
) -> list[tuple[EffectBase, Mapping[str, float]]]:
    """The best candidates of the first pass, and those that can stand in for them."""
    best = list(ranked[: limits.refits])
    extra: list[Score] = []
    for score in best:
        names = alike.like(score.effect.label, limits.alike)
        extra += [s for s in ranked if s.effect.label in names and s not in best and s not in extra]
    extra.sort(key=lambda s: -s.decrease)
    return [(s.effect, s.step) for s in [*best, *extra[: limits.refits]]]


def compose(
    composed: CandidateProblem,
    nominal: Fit,
    ranked: Sequence[Score],
    alike: Confusability,
    limits: Thresholds,
    say: Progress,
    store: Store | None = None,
) -> tuple[tuple[Fit, ...], tuple[Added, ...]]:
    """Add effects one after the other while the held-out gap closes, then try without each.

    Returns
    -------
    fits : tuple of Fit
        Of the first round, the chosen one first, then by held-out loss.
    added : tuple of Added
    """
    series = residual_series(nominal.problem)
    current = nominal
    first: tuple[Fit, ...] = ()
    added: list[Added] = []
    while len(added) < limits.effects:
        base = [entry.effect for entry in added]
        if added:
            say(f"scoring what is left beside {', '.join(e.label for e in base)}")
            point = linearise(composed, base, current.values)
            ranked = score_all(point, series, visibility(point))
            alike = confusability(point, ranked)
        tried = shortlist([s for s in ranked if s.p_value < limits.level], alike, limits)
        if not tried:
            break
        fits = refit_all(composed, base, tried, current.values, say, store)
        if not fits:
            break
        near = within_reach(fits)
        chosen = near[0]
        if not added:
            others = sorted((fit for fit in fits if fit is not chosen), key=lambda fit: fit.loss.mean)
            first = (chosen, *others)
        gained, error = gain(current.loss, chosen.loss)
        if gained <= error or gained < limits.closure * current.loss.gap or current.loss.gap <= 0:
            break
        total = closure(nominal.loss, chosen.loss)
        added.append(Added(chosen.effects[-1], chosen, total, tuple(fit.effects[-1] for fit in near)))
        say(f"added {chosen.effects[-1].label}: {100 * total.value:.3g} % of the held-out gap closed")
        current = chosen
        if current.loss.mean < 1 + limits.smallest_gap:
            break
    return first, _pruned(composed, nominal, tuple(added), say, store)


def _pruned(
    composed: CandidateProblem, nominal: Fit, added: tuple[Added, ...], say: Progress, store: Store | None = None
) -> tuple[Added, ...]:
    """Leave out effects without which held-out recordings are predicted as well."""
    kept = list(added)
    for entry in added[:-1]:
        if len(kept) < 2:
            break
        rest = [other for other in kept if other is not entry]
        full = kept[-1].fit
        # it begins elsewhere than a refit of the same effects in an earlier round
        name = f"{describe(full.effects)} without {entry.effect.label}"
        without = refit(composed, [other.effect for other in rest], full.values, store, name)
        if without is None:
            continue
        gained, error = gain(without.loss, full.loss)
        if gained <= error:
            say(f"left {entry.effect.label} out again: the others do as well")
            kept = _again(composed, nominal, rest, without, store)
    return tuple(kept)


def _again(
    composed: CandidateProblem, nominal: Fit, rest: Sequence[Added], last: Fit, store: Store | None
) -> list[Added]:
    """Effects that were kept when another was left out, each with the fit of all up to it."""
    found = []
    for i, entry in enumerate(rest):
        effects = [other.effect for other in rest[: i + 1]]
        fit = last if i == len(rest) - 1 else refit(composed, effects, last.values, store, f"{describe(effects)} again")
        if fit is not None:
            found.append(Added(entry.effect, fit, closure(nominal.loss, fit.loss), entry.rivals))
    return found


def smooth_fit(fit: Fit) -> Smoothed:
    """The weak-constraint smoother about a fitted model."""
    return smooth(fit.problem, fit.problem.unknowns(fit.values), fit.evaluation)


def explained_part(nominal: Fit, added: Sequence[Added], smoothed: Smoothed | None) -> float:
    """Fall of r'r by the effects over that by the smoother, each less what it takes of the noise.

    Both are on the recordings to estimate on, so that the same noise stands in both.
    """
    if smoothed is None or not added:
        return 1.0
    last = added[-1].fit
    by_effects = 2 * (nominal.cost - last.cost) - last.size
    by_smoother = smoothed.before - smoothed.after - (smoothed.degrees_before - smoothed.degrees_after)
    return float(by_effects / by_smoother) if by_smoother > 0 else 1.0


def _closed(added: Sequence[Added]) -> dict[str, float]:
    """What the effects at every location close, of the whole gap, each by what it adds to those before it."""
    closed: dict[str, float] = {}
    before = 0.0
    for entry in added:
        closed[entry.effect.location] = closed.get(entry.effect.location, 0.0) + max(entry.closure.value - before, 0.0)
        before = max(entry.closure.value, before)
    return closed


def absorption(before: Fit, after: Fit) -> tuple[Absorbed, ...]:
    """How the nominal parameters move when the effects are added."""
    parameters = before.problem.system.parameters
    return tuple(
        Absorbed(name, parameters[name].unit, before.values[name], after.values[name], after.std[name])
        for name in before.problem.shared
    )


def _message(verdict: str, before: NullTest, nominal: Fit, seen: Sequence[Visibility], limits: Thresholds) -> str:
    if verdict != "insufficient_data":
        return ""
    if not any(entry.visible for entry in seen):
        return "no candidate of the size that one would expect would show in these recordings."
    need = limits.samples_per_unknown * len(nominal.values)
    return (
        f"{before.degrees:.0f} effective samples for {len(nominal.values)} unknowns, at least {need:.0f} are needed; "
        "record longer or free fewer parameters."
    )

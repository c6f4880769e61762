"""Step seven: which effects are added, one after the other, by what they close of the held-out gap.

1 - G_after/G_before of the held-out losses is what was closed; its interval comes from resampling blocks (Kuensch 1989,
doi:10.1214/aos/1176347265).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from yid_ocp.diagnosis.hypotheses import describe
from yid_ocp.diagnosis.refit import Fit, Loss, Search, refit, refit_all, refit_pairs
from yid_ocp.diagnosis.screening import Confusability, Pair, Score, Screened, best_of, screen
from yid_ocp.diagnosis.thresholds import DEFAULTS, Thresholds
from yid_ocp.effects import EffectBase
from yid_ocp.errors import SolverError
from yid_ocp.solvers.judgement import TWO_SIDED

RESAMPLES = 1000
"""Draws of held-out blocks for the interval of a closure."""


@dataclass(frozen=True)
class Closure:
    """Fraction of the held-out gap that a model closes, with its 95 % interval; NaN if there was no gap.

    `sure`: whether the likelihood ratio favours the model decisively, however small the gap; see `far_likelier`.
    """

    value: float
    low: float
    high: float
    sure: bool = False


@dataclass(frozen=True)
class Added:
    """An effect added by the selection, with the refitted model of its round.

    Attributes
    ----------
    effect : EffectBase
    fit : Fit
        With all effects up to this one.
    closure : Closure
        Of the whole gap by all effects up to this one.
    rivals : tuple of EffectBase
        Effects that the data cannot tell from this one, the chosen one first.
    """

    effect: EffectBase
    fit: Fit
    closure: Closure
    rivals: tuple[EffectBase, ...]


def closure(before: Loss, after: Loss, seed: int = 0, limits: Thresholds = DEFAULTS) -> Closure:
    """Return the fraction of the held-out gap closed from `before` to `after`, with a block-bootstrap interval."""
    sure = far_likelier(before, after, limits)
    if before.gap <= 0 or not np.isfinite(after.mean):
        return Closure(float("nan"), float("nan"), float("nan"), sure)
    rng = np.random.default_rng(seed)
    draws = rng.integers(0, len(before.counts), (RESAMPLES, len(before.counts)))
    n = before.counts[draws].sum(axis=1)
    g0 = np.maximum((before.squares[draws].sum(axis=1) + before.known) / n - 1.0, 0.0)
    g1 = np.maximum((after.squares[draws].sum(axis=1) + after.known) / n - 1.0, 0.0)
    ratio = 1 - g1[g0 > 0] / g0[g0 > 0]
    low, high = np.quantile(ratio, [0.025, 0.975]) if len(ratio) else (float("nan"), float("nan"))
    return Closure(1 - after.gap / before.gap, float(low), float(high), sure)


def far_likelier(before: Loss, after: Loss, limits: Thresholds = DEFAULTS) -> bool:
    """Whether the held-out log likelihood ratio favours `after` by more than `worth`, if both models leave only noise.

    Innovations that are noise are independent, and half the fall of their squares is a log likelihood ratio. What shows
    in a few of them only, as a constant error of a torque does at the start, differs too much from block to block for
    `gain` to be sure, and hardly moves chi2/n.
    """
    return _noise_is_left(limits, before, after) and _squares(before) - _squares(after) > 2 * limits.worth


def _noise_is_left(limits: Thresholds, *losses: Loss) -> bool:
    """Whether all of some models leave little but noise."""
    return max(loss.mean for loss in losses) < 1 + limits.smallest_gap


def _squares(loss: Loss) -> float:
    return float(np.sum(loss.squares)) + loss.known


def gain(before: Loss, after: Loss) -> tuple[float, float]:
    """Return the decrease of held-out chi2/n from `before` to `after`, and its standard error over blocks."""
    total = float(before.counts.sum())
    difference = before.squares - after.squares
    if not np.all(np.isfinite(difference)):
        return (-np.inf if np.isfinite(before.mean) else np.inf), 0.0
    count = len(difference)
    error = np.sqrt(count) * float(np.std(difference, ddof=1)) if count > 1 else np.inf
    return float(difference.sum() + before.known - after.known) / total, float(error) / total


def within_reach(fits: Sequence[Fit], limits: Thresholds = DEFAULTS) -> list[Fit]:
    """Models that predict the held-out recordings as well as the best one, the simplest first.

    Their loss is within one standard error of the best one's, or within `tie` of it, or all recordings together are as
    likely with them (`as_likely`): about 16 % of equally good models trail the best by more than one standard error.
    Models far less likely than the best are dropped (`less_likely`). Where model error dominates, simpler models are
    also accepted by BIC; see `outweighs`. An effect whose shape is far from what
    an engineer would expect (`out_of_shape`) counts only where no other comes near it: a solid that relaxes in a tenth
    of the shortest time expected is a damper. So does one that is not sure to be there. One whose amplitude is out of
    its range (`oversized`) comes last.
    """
    best = min(fits, key=lambda fit: fit.loss.mean)
    likely = [fit for fit in fits if not fit.effects or _likely(fit.effects[-1], fit, limits)]
    if likely and min(fit.loss.mean for fit in likely) <= (1 + limits.stand_in) * best.loss.mean:
        fits = likely
        best = min(fits, key=lambda fit: fit.loss.mean)
    near = []
    for fit in fits:
        lost, error = gain(fit.loss, best.loss)
        close = fit is best or lost <= max(error, limits.tie * best.loss.mean)
        if close or as_likely(fit, best, limits) or outweighs(fit, best, limits):
            near.append(fit)
    likeliest = min(near, key=lambda fit: behind(fit, best))
    near = [fit for fit in near if not less_likely(fit, likeliest, limits)]

    def order(fit: Fit) -> tuple[bool, int, float]:
        return bool(fit.effects) and oversized(fit.effects[-1], fit.values, limits), fit.size, behind(fit, likeliest)

    return sorted(near, key=order)


def as_likely(fit: Fit, other: Fit, limits: Thresholds = DEFAULTS) -> bool:
    """Whether the likelihood ratio of two models over all recordings is within its 95 % bound.

    Where more than noise is left, squares count errors of the model, and their differences say little.
    """
    return _noise_is_left(limits, fit.loss, other.loss) and behind(fit, other) <= TWO_SIDED


def less_likely(fit: Fit, other: Fit, limits: Thresholds = DEFAULTS) -> bool:
    """Whether the log likelihood ratio over all recordings rejects `fit` against `other` by more than `worth`."""
    return _noise_is_left(limits, fit.loss, other.loss) and behind(fit, other) > 2 * limits.worth


def behind(fit: Fit, other: Fit) -> float:
    """Return r'r of `fit` minus that of `other` over all recordings, fitted and held out, with parameter penalty.

    Every parameter counts as the one by which chance alone lowers r'r.
    """
    held = _squares(fit.loss) - _squares(other.loss)
    return held + 2 * (fit.cost - other.cost) + fit.size - other.size


def _likely(effect: EffectBase, fit: Fit, limits: Thresholds) -> bool:
    return stands_out(effect, fit, limits) and not out_of_shape(effect, fit.values, limits, fit.std)


def outweighs(fit: Fit, best: Fit, limits: Thresholds = DEFAULTS) -> bool:
    """Whether BIC prefers `fit` with fewer parameters over `best` when model error dominates.

    Residuals are then errors of the model, of unknown size and alike for the length of a block: blocks times the
    logarithm of the losses' ratio against parameters times that of the blocks (BIC, Schwarz 1978,
    doi:10.1214/aos/1176344136).
    """
    if best.loss.mean < limits.everywhere or not np.isfinite(fit.loss.mean):
        return False
    blocks, fewer = len(best.loss.counts), best.size - fit.size
    return fewer > 0 and blocks * math.log(fit.loss.mean / best.loss.mean) <= fewer * math.log(blocks)


def out_of_shape(
    effect: EffectBase,
    values: Mapping[str, float],
    limits: Thresholds = DEFAULTS,
    std: Mapping[str, float] | None = None,
) -> bool:
    """Whether a shape parameter lies outside its prior range by more than `shape_factor` or `range_widths` widths.

    One that may as well lie within, by `away` standard deviations, does not.
    """
    for name in effect.shapes:
        low, high = effect.prior_range[name]
        room = limits.range_widths * (high - low)
        factor = limits.shape_factor
        near, far = (low / factor, high * factor) if low > 0 else (low - room, high + room)
        unsure = limits.away * (std or {}).get(name, 0.0)
        if not near - unsure <= values[name] <= far + unsure:
            return True
    return False


def oversized(effect: EffectBase, values: Mapping[str, float], limits: Thresholds = DEFAULTS) -> bool:
    """Whether an amplitude lies outside its prior range by more than `range_widths` widths of that range."""
    for name in effect.amplitudes:
        low, high = effect.prior_range[name]
        room = limits.range_widths * (high - low)
        if not low - room <= values[name] <= high + room:
            return True
    return False


def stands_out(effect: EffectBase, fit: Fit, limits: Thresholds = DEFAULTS) -> bool:
    """Whether any amplitude is at least `away` standard deviations from neutral.

    The standard deviations hold the shape fixed; see `amplitude_std`.
    """
    neutral, std = effect.neutral, fit.amplitude_std
    return any(abs(fit.values[n] - neutral[n]) >= limits.away * std.get(n, 0.0) for n in effect.amplitudes)


def relevant(before: Loss, after: Loss, limits: Thresholds = DEFAULTS) -> bool:
    """Whether the held-out error, of all channels or of any one, is reduced by at least the fraction `relevance`.

    Held-out recordings that are far likelier need not show it: what tells of a constant error shows in few samples.
    """
    if far_likelier(before, after, limits) or not np.isfinite(before.mean):
        return True
    return fall(before, after) >= limits.relevance


def fall(before: Loss, after: Loss) -> float:
    """Return the relative reduction of the held-out RMSE: the larger of all channels together and the best channel."""
    pairs = [(np.sqrt(before.mean), np.sqrt(after.mean))]
    pairs += [(rmse, after.channels[name][0]) for name, (rmse, _) in before.channels.items() if name in after.channels]
    return float(max(1.0 - later / earlier if earlier > 0 else 0.0 for earlier, later in pairs))


# -- several effects --------------------------------------------------------------------------------------------------


def shortlist(
    scores: Sequence[Score], alike: Confusability, limits: Thresholds, places: Sequence[str] = ()
) -> list[tuple[EffectBase, Mapping[str, float]]]:
    """Choose the candidates to refit, with their start values.

    Of those that are significant, the best by what they promise; those that can stand in for them; the best by their
    statistic, which a promise made far from its end says little about. Beside any of these the best of every place
    where the gap lies is refitted whether significant or not: in a valley far from its end the linear model of a
    candidate may say nothing.
    """
    ranked = [score for score in scores if score.p_value < limits.level]
    if not ranked:
        return []
    best = list(ranked[: limits.refits])
    extra: list[Score] = []
    for score in best:
        names = alike.like(score.effect.label, limits.alike)
        extra += [s for s in ranked if s.effect.label in names and s not in best and s not in extra]
    extra.sort(key=lambda s: -s.decrease)
    chosen = [*best, *extra[: limits.refits]]
    surest = sorted(ranked, key=lambda s: (s.p_value, -s.statistic))[: limits.surest]
    there = [next((s for s in scores if s.effect.location == place), None) for place in places]
    for other in (*surest, *there):
        if other is not None and other not in chosen:
            chosen.append(other)
    return [(s.effect, s.step) for s in chosen]


def _from_before(search: Search) -> list[Fit]:
    """Candidates refitted from the earlier run's parameters: the nominal fit's stand in for what is missing."""
    try:
        screened = screen(search.problem, (), {}, search.limits)
    except SolverError:
        return []
    search.progress.stage("trying candidates from the earlier run's parameters")
    chosen = shortlist(screened.scores, screened.alike, search.limits)
    return refit_all(search, (), chosen, {}, "from the earlier run's parameters")


def _likelier(fits: Sequence[Fit], others: Sequence[Fit]) -> list[Fit]:
    """Of every effect the fit of least cost."""
    best: dict[str, Fit] = {}
    for fit in (*fits, *others):
        label = fit.effects[-1].label
        if label not in best or fit.cost < best[label].cost:
            best[label] = fit
    return list(best.values())


def compose(
    search: Search, nominal: Fit, screened: Screened, places: Sequence[str] = (), moved: bool = False
) -> tuple[tuple[Fit, ...], tuple[Added, ...]]:
    """Select effects by forward selection on the held-out gap, then try replacing and removing each.

    Parameters
    ----------
    search : Search
    nominal : Fit
        Without any effect.
    screened : Screened
        All candidates at that fit.
    places : sequence of str
        Where the smoother says that the gap lies.
    moved : bool
        Whether the nominal fit has left what an earlier run found; candidates are then tried from there as well.

    Returns
    -------
    fits : tuple of Fit
        Of single effects in the first round, the chosen one first, then by held-out loss; where one effect alone stays,
        its last fit first.
    added : tuple of Added
    """
    limits, alone = search.limits, screened
    current = nominal
    first: tuple[Fit, ...] = ()
    added: tuple[Added, ...] = ()
    paired = False
    while len(added) < limits.effects:
        base = tuple(entry.effect for entry in added)
        if added:
            search.progress.stage(f"scoring what is left beside {', '.join(e.label for e in base)}")
            screened = screen(search.problem, base, current.values, limits)
            # a rest that the residual as a whole does not show may show along a candidate, as a gap does
            if _little_is_left(current, limits) and best_of(screened.scores) >= limits.candidate_level:
                break
        # where the gap lay before anything was added asks for no more than the significant afterwards
        scores = [score for score in screened.scores if not added or score.p_value < limits.level]
        fits = refit_all(search, base, shortlist(scores, screened.alike, limits, places), current.values)
        if moved and not added:
            fits = _likelier(fits, _from_before(search))
        if len(added) == 1:
            pairs = likely_pairs(alone, limits, base[0])
            fits += [fit for fit in refit_pairs(search, pairs, nominal.values) if _firmly(fit.effects[0], fit, limits)]
        if added:
            fits = _of_a_size(fits, limits)
        if not fits:
            break
        near = within_reach(fits, limits)
        if not added:
            first = (near[0], *sorted((fit for fit in fits if fit is not near[0]), key=lambda fit: fit.loss.mean))
        chosen = next((fit for fit in near if _worth_adding(current, fit, limits)), None)
        if chosen is None:
            break
        paired = chosen.effects[:-1] != base
        total = closure(nominal.loss, chosen.loss, limits=limits)
        said = "" if np.isnan(total.value) else f": {100 * total.value:.3g} % of the held-out gap closed"
        if paired:
            search.progress.stage(f"put {describe(chosen.effects)} in the place of {describe(base)}{said}")
            both = [Added(effect, chosen, total, (effect,)) for effect in chosen.effects]
            added = _rebuilt(search, nominal, both, chosen)
        else:
            search.progress.stage(f"added {chosen.effects[-1].label}{said}")
            beside = [fit.effects[-1] for fit in near if fit is not chosen and fit.effects[:-1] == base]
            added = (*added, Added(chosen.effects[-1], chosen, total, (chosen.effects[-1], *beside)))
        current = chosen
    kept = _reconsidered(search, nominal, added, paired)
    if len(kept) == 1:
        # it may have ended elsewhere than where it was tried first
        [own] = kept
        first = (own.fit, *(fit for fit in first if fit.effects[0].label != own.effect.label))
    return first, kept


def likely_pairs(
    screened: Screened, limits: Thresholds, without: EffectBase
) -> list[tuple[tuple[EffectBase, EffectBase], Mapping[str, float]]]:
    """Choose the pairs of candidates to refit: best penalized decrease first, without confusable duplicates.

    Parameters
    ----------
    screened : Screened
        At the nominal fit.
    limits : Thresholds
    without : EffectBase
        The best effect alone, with which others are tried anyway: it is in no pair.

    Returns
    -------
    list of (pair of EffectBase, mapping of parameter to float)
        With the values at which both begin.
    """
    alike = screened.alike

    def same(one: EffectBase, other: EffectBase) -> bool:
        return one.label == other.label or other.label in alike.like(one.label, limits.alike)

    def covered(pair: Pair, by: Pair) -> bool:
        (a, b), (c, d) = pair.effects, by.effects
        return (same(a, c) and same(b, d)) or (same(a, d) and same(b, c))

    labels = [score.effect.label for score in screened.scores if score.effect.label != without.label]
    chosen: list[Pair] = []
    for pair in screened.together.pairs(labels):
        if len(chosen) == limits.pairs:
            break
        if not any(covered(pair, before) for before in chosen):
            chosen.append(pair)
    return [(pair.effects, pair.step) for pair in chosen]


def _firmly(effect: EffectBase, fit: Fit, limits: Thresholds) -> bool:
    """Whether an effect of a fit is there, with a shape and an amplitude to be expected."""
    return _likely(effect, fit, limits) and not oversized(effect, fit.values, limits)


def _of_a_size(fits: Sequence[Fit], limits: Thresholds) -> list[Fit]:
    """Fits whose last effect is of a size to be expected: beyond it, it mends what those before it do wrong."""
    return [fit for fit in fits if not oversized(fit.effects[-1], fit.values, limits)]


def _little_is_left(fit: Fit, limits: Thresholds) -> bool:
    """Whether the effects of a fit leave little but noise; a gap that is as little is one without any."""
    return bool(fit.effects) and _noise_is_left(limits, fit.loss)


def _worth_adding(current: Fit, chosen: Fit, limits: Thresholds) -> bool:
    """Whether the last effect of a fit closes a sure and relevant part of the gap, and is there at all.

    Where little but noise is left, only odds convince: a part of next to nothing is soon closed.
    """
    gained, error = gain(current.loss, chosen.loss)
    part = gained >= limits.closure * current.loss.gap and current.loss.gap > 0
    closes = not _little_is_left(current, limits) and gained > error and part
    if not closes and not far_likelier(current.loss, chosen.loss, limits):
        return False
    return stands_out(chosen.effects[-1], chosen, limits) and relevant(current.loss, chosen.loss, limits)


def _reconsidered(search: Search, nominal: Fit, added: Sequence[Added], paired: bool) -> tuple[Added, ...]:
    """Every effect tried for its place again beside the others: without it, and others instead of it.

    What was added first was chosen while the others were missing, and may be there in their stead. The last one, unless
    it came as one of a pair, was chosen beside all others, as one that was put in another's place: they need no second
    look until these change.
    """
    kept = tuple(added)
    seen = {_labels(kept)}
    tried = set() if paired else {_labels(kept[:-1])}
    while len(kept) > 1:
        others = [_labels(kept) - {entry.effect.label} for entry in kept]
        position = next((i for i, own in enumerate(others) if own not in tried), None)
        if position is None:
            break
        tried.add(others[position])
        revised = _revised(search, nominal, kept, position)
        if _labels(revised) == _labels(kept) or _labels(revised) not in seen:
            kept = revised
            seen.add(_labels(kept))
    return kept


def _labels(added: Sequence[Added]) -> frozenset[str]:
    return frozenset(entry.effect.label for entry in added)


def _revised(search: Search, nominal: Fit, kept: tuple[Added, ...], position: int) -> tuple[Added, ...]:
    """The effects without one of them, with another in its place, or as they are with what would do as well."""
    limits, full, entry = search.limits, kept[-1].fit, kept[position]
    rest = [other.effect for other in kept if other is not entry]
    # it begins elsewhere than a refit of the same effects in an earlier round
    without = _again(search, rest, full, f"{describe(full.effects)} without {entry.effect.label}")
    if without is None:
        return kept
    if not _needed(without, full, entry.effect, limits):
        search.progress.stage(f"left {entry.effect.label} out again: the others do as well")
        return _rebuilt(search, nominal, [other for other in kept if other is not entry], without)
    search.progress.stage(f"looking for others in the place of {entry.effect.label}")
    screened = screen(search.problem, rest, without.values, limits)
    tried = shortlist(screened.scores, screened.alike, limits)[: limits.refits]
    tried = [pair for pair in tried if pair[0].label != entry.effect.label]
    own = replace(full, effects=(*rest, entry.effect))
    others = refit_all(search, rest, tried, without.values)
    if not oversized(entry.effect, own.values, limits):
        others = _of_a_size(others, limits)
    near = within_reach([own, *others], limits)
    chosen = next((fit for fit in near if _needed(without, fit, fit.effects[-1], limits)), own)
    rivals = (chosen.effects[-1], *(fit.effects[-1] for fit in near if fit is not chosen))
    placed = [replace(e, effect=chosen.effects[-1], rivals=rivals) if e is entry else e for e in kept]
    if chosen is own:
        return tuple(placed)
    search.progress.stage(f"put {chosen.effects[-1].label} in the place of {entry.effect.label}")
    return _rebuilt(search, nominal, placed, replace(chosen, effects=tuple(e.effect for e in placed)))


def _needed(without: Fit, full: Fit, effect: EffectBase, limits: Thresholds) -> bool:
    """Whether held-out recordings are surely predicted worse without an effect, and it is there at all."""
    gained, error = gain(without.loss, full.loss)
    sure = gained > error or far_likelier(without.loss, full.loss, limits)
    return sure and stands_out(effect, full, limits) and relevant(without.loss, full.loss, limits)


def _rebuilt(search: Search, nominal: Fit, entries: Sequence[Added], last: Fit) -> tuple[Added, ...]:
    """Effects in their order, each with the fit of all up to it, or of all where that cannot be made."""
    found = []
    for i, entry in enumerate(entries):
        effects = [other.effect for other in entries[: i + 1]]
        part = None if i == len(entries) - 1 else _again(search, effects, last, f"{describe(effects)} again")
        fit = last if part is None else part
        found.append(replace(entry, fit=fit, closure=closure(nominal.loss, fit.loss, limits=search.limits)))
    return tuple(found)


def _again(search: Search, effects: Sequence[EffectBase], near: Fit, name: str) -> Fit | None:
    """A refit that begins where another one ended."""
    return refit(search.problem, effects, near.values, search.store, name, search.limits)

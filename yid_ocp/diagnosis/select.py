"""Step seven: which effects are added, one after the other, by what they close of the held-out gap.

1 - G_after/G_before of the held-out losses is what was closed; its interval comes from resampling blocks (Kuensch 1989,
doi:10.1214/aos/1176347265).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from yid_ocp.diagnosis.hypotheses import describe
from yid_ocp.diagnosis.refit import Fit, Loss, Search, refit, refit_all
from yid_ocp.diagnosis.screening import Confusability, Score, Screened, screen
from yid_ocp.diagnosis.thresholds import DEFAULTS, Thresholds
from yid_ocp.effects import EffectBase

RESAMPLES = 1000
"""Draws of held-out blocks for the interval of a closure."""


@dataclass(frozen=True)
class Closure:
    """Part of the held-out gap that a model closes, with a 95 % interval; NaN where there was no gap.

    `sure` says that the held-out recordings are far more likely with it, however small the gap; see `far_likelier`.
    """

    value: float
    low: float
    high: float
    sure: bool = False


@dataclass(frozen=True)
class Added:
    """An effect that was added, in its round.

    Attributes
    ----------
    effect : EffectBase
    fit : Fit
        With all effects up to this one.
    closure : Closure
        Of the whole gap by all effects up to this one.
    rivals : tuple of EffectBase
        That pass within one standard error, the chosen one first.
    """

    effect: EffectBase
    fit: Fit
    closure: Closure
    rivals: tuple[EffectBase, ...]


def closure(before: Loss, after: Loss, seed: int = 0, limits: Thresholds = DEFAULTS) -> Closure:
    """Part of the held-out gap that is closed, with a block-bootstrap interval."""
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
    """Whether held-out recordings are likelier with `after` by the odds of `worth`, where both leave little but noise.

    Innovations that are noise are independent, and half the fall of their squares is a log likelihood ratio. What shows
    in a few of them only, as a constant error of a torque does at the start, differs too much from block to block for
    `gain` to be sure, and hardly moves chi2/n.
    """
    if not max(before.mean, after.mean) < 1 + limits.smallest_gap:
        return False
    fall = np.sum(before.squares) + before.known - np.sum(after.squares) - after.known
    return float(fall) > 2 * limits.worth


def gain(before: Loss, after: Loss) -> tuple[float, float]:
    """Held-out chi2/n that `after` is better by, and its standard error over blocks."""
    total = float(before.counts.sum())
    difference = before.squares - after.squares
    if not np.all(np.isfinite(difference)):
        return (-np.inf if np.isfinite(before.mean) else np.inf), 0.0
    count = len(difference)
    error = np.sqrt(count) * float(np.std(difference, ddof=1)) if count > 1 else np.inf
    return float(difference.sum() + before.known - after.known) / total, float(error) / total


def within_reach(fits: Sequence[Fit], limits: Thresholds = DEFAULTS) -> list[Fit]:
    """Fits whose held-out loss is within one standard error of the best one's (or `tie` of it), the simplest first.

    An effect whose shape is far from what an engineer would expect (`out_of_shape`) counts only where no other comes
    near it: a solid that relaxes in a tenth of the shortest time expected is a damper. One whose amplitude is
    (`oversized`) comes last.
    """
    best = min(fits, key=lambda fit: fit.loss.mean)
    shapely = [fit for fit in fits if not (fit.effects and out_of_shape(fit.effects[-1], fit.values, limits))]
    if shapely and min(fit.loss.mean for fit in shapely) <= (1 + limits.stand_in) * best.loss.mean:
        fits = shapely
        best = min(fits, key=lambda fit: fit.loss.mean)
    near = []
    for fit in fits:
        lost, error = gain(fit.loss, best.loss)
        apart = far_likelier(fit.loss, best.loss, limits)
        if fit is best or (lost <= max(error, limits.tie * best.loss.mean) and not apart):
            near.append(fit)

    def order(fit: Fit) -> tuple[bool, int, float]:
        return bool(fit.effects) and oversized(fit.effects[-1], fit.values, limits), fit.size, fit.loss.mean

    return sorted(near, key=order)


def out_of_shape(effect: EffectBase, values: Mapping[str, float], limits: Thresholds = DEFAULTS) -> bool:
    """Whether a shape parameter lies outside its range by more than `shape_factor`, or `range_widths` widths of it."""
    for name in effect.shapes:
        low, high = effect.prior_range[name]
        room = limits.range_widths * (high - low)
        factor = limits.shape_factor
        near, far = (low / factor, high * factor) if low > 0 else (low - room, high + room)
        if not near <= values[name] <= far:
            return True
    return False


def oversized(effect: EffectBase, values: Mapping[str, float], limits: Thresholds = DEFAULTS) -> bool:
    """Whether an amplitude lies outside its range by more than `range_widths` widths of it."""
    for name in effect.amplitudes:
        low, high = effect.prior_range[name]
        room = limits.range_widths * (high - low)
        if not low - room <= values[name] <= high + room:
            return True
    return False


# -- several effects --------------------------------------------------------------------------------------------------


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


def compose(search: Search, nominal: Fit, screened: Screened) -> tuple[tuple[Fit, ...], tuple[Added, ...]]:
    """Add effects one after the other while the held-out gap closes, then try without each.

    Parameters
    ----------
    search : Search
    nominal : Fit
        Without any effect.
    screened : Screened
        All candidates at that fit.

    Returns
    -------
    fits : tuple of Fit
        Of the first round, the chosen one first, then by held-out loss.
    added : tuple of Added
    """
    limits = search.limits
    current = nominal
    first: tuple[Fit, ...] = ()
    added: list[Added] = []
    while len(added) < limits.effects:
        base = [entry.effect for entry in added]
        if added:
            search.progress(f"scoring what is left beside {', '.join(e.label for e in base)}")
            screened = screen(search.problem, base, current.values, limits)
        tried = shortlist([s for s in screened.scores if s.p_value < limits.level], screened.alike, limits)
        fits = refit_all(search, base, tried, current.values)
        if not fits:
            break
        near = within_reach(fits, limits)
        chosen = near[0]
        if not added:
            first = (chosen, *sorted((fit for fit in fits if fit is not chosen), key=lambda fit: fit.loss.mean))
        gained, error = gain(current.loss, chosen.loss)
        closes = gained > error and gained >= limits.closure * current.loss.gap and current.loss.gap > 0
        if not closes and not far_likelier(current.loss, chosen.loss, limits):
            break
        total = closure(nominal.loss, chosen.loss, limits=limits)
        added.append(Added(chosen.effects[-1], chosen, total, tuple(fit.effects[-1] for fit in near)))
        said = "" if np.isnan(total.value) else f": {100 * total.value:.3g} % of the held-out gap closed"
        search.progress(f"added {chosen.effects[-1].label}{said}")
        current = chosen
        if current.loss.mean < 1 + limits.smallest_gap:
            break
    return first, _pruned(search, nominal, tuple(added))


def _pruned(search: Search, nominal: Fit, added: tuple[Added, ...]) -> tuple[Added, ...]:
    """Leave out effects without which held-out recordings are predicted as well."""
    kept = list(added)
    for entry in added[:-1]:
        if len(kept) < 2:
            break
        rest = [other for other in kept if other.effect is not entry.effect]
        full = kept[-1].fit
        # it begins elsewhere than a refit of the same effects in an earlier round
        name = f"{describe(full.effects)} without {entry.effect.label}"
        without = _again(search, [other.effect for other in rest], full, name)
        if without is None:
            continue
        gained, error = gain(without.loss, full.loss)
        if gained <= error:
            search.progress(f"left {entry.effect.label} out again: the others do as well")
            kept = _rebuilt(search, nominal, rest, without)
    return tuple(kept)


def _rebuilt(search: Search, nominal: Fit, rest: Sequence[Added], last: Fit) -> list[Added]:
    """Effects that were kept when another was left out, each with the fit of all up to it."""
    found = []
    for i, entry in enumerate(rest):
        effects = [other.effect for other in rest[: i + 1]]
        fit = last if i == len(rest) - 1 else _again(search, effects, last, f"{describe(effects)} again")
        if fit is not None:
            found.append(Added(entry.effect, fit, closure(nominal.loss, fit.loss, limits=search.limits), entry.rivals))
    return found


def _again(search: Search, effects: Sequence[EffectBase], near: Fit, name: str) -> Fit | None:
    """A refit that begins where another one ended."""
    return refit(search.problem, effects, near.values, search.store, name, search.limits)

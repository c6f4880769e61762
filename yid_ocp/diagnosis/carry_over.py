"""Transfer check: whether the amplitudes of an effect agree between the estimation and the held-out recordings.

Two or three effects together imitate almost anything on the recordings on which they were fitted. What is true of the
robot comes out the same wherever it is fitted; what stands in for something else has to be something else for every
motion. The recordings that are held out are fitted in turn, with the same effects, and the values are compared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from yid_ocp.diagnosis.hypotheses import CandidateProblem
from yid_ocp.diagnosis.refit import Fit, Search, refit
from yid_ocp.diagnosis.thresholds import DEFAULTS, Thresholds
from yid_ocp.effects import EffectBase

APART = 2.0
"""Standard deviations beyond which two fits disagree."""


@dataclass(frozen=True)
class Carried:
    """One parameter of an effect, estimated on the estimation recordings and again on the held-out ones.

    Attributes
    ----------
    effect, name, unit : str
    value, std : float
        On the recordings to estimate on.
    again, again_std : float
        On the held-out ones.
    agrees : bool
    """

    effect: str
    name: str
    unit: str
    value: float
    std: float
    again: float
    again_std: float
    agrees: bool


def carried_over(search: Search, fit: Fit) -> tuple[Carried, ...]:
    """Refit the effects on the held-out recordings and compare every amplitude; empty if one recording is split.

    Nothing, too, where the model cannot be fitted there: no evidence against it.
    """
    if search.problem.blocks or not fit.effects:
        return ()
    search.progress.stage("fitting the held-out recordings with the same effects")
    problem = search.problem.problem
    turned = replace(search.problem, problem=problem.on(problem.held_out, problem.episodes))
    if problem.disturbed:
        turned = turned.weighted_at(fit.values)
    name = f"{' and '.join(effect.label for effect in fit.effects)} on the held-out recordings"
    again = refit(turned, fit.effects, _shared(turned, fit), search.store, name, search.limits)
    if again is None:
        return ()
    return tuple(entry for effect in fit.effects for entry in compared(effect, fit, again, search.limits))


def _shared(turned: CandidateProblem, fit: Fit) -> dict[str, float]:
    """Values of what both sets of recordings have in common: parameters, and nothing of single recordings' starts."""
    names = {*turned.nominal, *(name for effect in fit.effects for name in effect.parameters.names)}
    return {name: value for name, value in fit.values.items() if name in names}


def compared(effect: EffectBase, first: Fit, second: Fit, limits: Thresholds = DEFAULTS) -> list[Carried]:
    """Compare the amplitudes of one effect in two fits.

    They agree where they differ by no more than `carried_stds` standard deviations, those of both together, or than the
    part `carried` of the effect's size; sizes of several amplitudes are compared in widths of their ranges.
    """
    neutral, found = effect.neutral, []
    width = {name: high - low for name, (low, high) in effect.prior_range.items()}
    size = max(abs(fit.values[n] - neutral[n]) / width[n] for fit in (first, second) for n in effect.amplitudes)
    for name in effect.amplitudes:
        apart = abs(first.values[name] - second.values[name])
        spread = math.hypot(first.std[name], second.std[name])
        # what has no standard deviation says nothing against it
        sure = math.isfinite(spread) and apart > limits.carried_stds * spread
        agrees = not sure or apart <= limits.carried * size * width[name]
        parameter = effect.parameters[name]
        own = (first.values[name], first.std[name], second.values[name], second.std[name])
        found.append(Carried(effect.label, name.removeprefix(f"{effect.label}."), parameter.unit, *own, agrees))
    return found


def counting_both(fit: Fit, entries: Sequence[Carried]) -> Fit:
    """Return the fit with amplitude standard deviations inflated by the disagreement between the recordings.

    What a model misses of all of a recording its residual does not show: where two fits differ by more than `APART`
    standard deviations of both together, each is known to the spread of the two, their difference over the square root
    of two.
    """
    std = dict(fit.std)
    for entry in entries:
        apart = abs(entry.value - entry.again)
        if apart > APART * math.hypot(entry.std, entry.again_std):
            name = f"{entry.effect}.{entry.name}"
            std[name] = max(std[name], apart / math.sqrt(2.0))
    return replace(fit, std=std)


def disagreeing(entries: Sequence[Carried]) -> tuple[Carried, ...]:
    """Return the checks whose two estimates disagree."""
    return tuple(entry for entry in entries if not entry.agrees)

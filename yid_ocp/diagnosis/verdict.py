"""Step eight: whether there is a gap, and the verdict."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from yid_ocp.diagnosis.refit import Fit
from yid_ocp.diagnosis.screening import Score, Visibility, best_of
from yid_ocp.diagnosis.select import Added, Closure
from yid_ocp.diagnosis.smoother import Smoothed
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.problem.null_test import NullTest, more_than_noise

Reason = Literal["", "none", "unsure", "little", "stand_in"]
"""Why the verdict is unknown: no candidate helps, closure not significant, too little explained, no transfer."""


def has_gap(
    before: NullTest, held_out: NullTest, limits: Thresholds, ranked: Sequence[Score] = (), offsets: bool = False
) -> bool:
    """Whether the residual exceeds noise significantly and by a relevant amount.

    Either as a whole, or along what a candidate would do to it with some channel above noise: the sum over all channels
    does not notice what only a few samples show. A candidate alone has to be surer than that sum: it is the best of
    many, at the end of a tail that is known by asymptotics only. An offset of a torque beyond what was stated needs no
    such channel: it is one number among thousands, and all others follow it.

    Parameters
    ----------
    before, held_out : NullTest
    limits : Thresholds
    ranked : sequence of Score
        Of all visible candidates; their smallest p-value counts as the best of that many tries.
    offsets : bool
        Whether the size of torque offsets is stated.
    """
    if more_than_noise((before, held_out), limits.gap):
        return True
    stated = [score.p_value for score in ranked if score.effect.kind == "effort_offset"] if offsets else []
    if stated and min(stated) * len(ranked) < limits.candidate_level:
        return True
    best = best_of(ranked)
    largest = max((*before.channels.values(), *held_out.channels.values()), default=1.0)
    return best < limits.candidate_level and largest > 1 + limits.smallest_channel


def shapeless(
    smoothed: Smoothed | None, ranked: Sequence[Score], before: NullTest, held_out: NullTest, limits: Thresholds
) -> bool:
    """Whether an excess is barely significant and no unknown or candidate explains it, so that it counts as chance.

    A sure excess without shape stays a gap: stated noise that is too small looks like that.
    """
    best = best_of(ranked)
    barely = min(before.p_value, held_out.p_value) > limits.shapeless * limits.level
    return barely and best >= limits.level and (smoothed is None or smoothed.side == "none")


def decide(
    gap: bool,
    visible: Sequence[Visibility],
    added: Sequence[Added],
    total: Closure,
    limits: Thresholds,
    enough: bool,
    explained: float = 1.0,
    carried: bool = True,
) -> str:
    """Return the verdict: insufficient_data, no_gap, unknown, confusable or effect.

    Parameters
    ----------
    gap : bool
    visible : sequence of Visibility
    added : sequence of Added
        After composition.
    total : Closure
        Of all effects added.
    limits : Thresholds
    enough : bool
        Whether there are samples enough for the unknowns.
    explained : float
        What the effects explain over what unknown forces, offsets and biases explain.
    carried : bool
        Whether the effects come out alike on the held-out recordings.
    """
    if not enough or not any(entry.visible for entry in visible):
        return "insufficient_data"
    if not gap:
        return "no_gap"
    if why_unknown(added, total, limits, explained, carried):
        return "unknown"
    return "confusable" if len(added[0].rivals) > 1 else "effect"


def assumptions(added: Sequence[Added]) -> int:
    """Count independent assumptions: one law at several locations counts once, local effects count each."""
    return len({entry.effect.label if entry.effect.alone else entry.effect.kind for entry in added})


def needed(added: Sequence[Added], limits: Thresholds) -> float:
    """Return the fraction of the smoother's explained chi2 that the effects are required to explain."""
    return 1.0 - (1.0 - limits.explained) ** assumptions(added)


def why_unknown(
    added: Sequence[Added], total: Closure, limits: Thresholds, explained: float = 1.0, carried: bool = True
) -> Reason:
    """Return why a gap has no accepted effect; empty if it has one.

    Effects have to explain the part `needed` of what the smoother explains where the model was fitted. One that
    single assumption also passes if the lower 95 % bound of its held-out closure reaches `explained`. Of
    several each further assumption has to explain at least the part `explained` of what could be left: two or three
    together imitate almost anything, but only in part.
    """
    if not added:
        return "none"
    if not (total.low > limits.closure or total.sure):
        return "unsure"
    elsewhere = assumptions(added) == 1 and total.low >= limits.explained
    if explained < needed(added, limits) and not elsewhere:
        return "little"
    return "" if carried else "stand_in"


def explained_part(nominal: Fit, added: Sequence[Added], smoothed: Smoothed | None) -> float:
    """Return the decrease of r'r by the effects divided by that of the smoother, both corrected for degrees of freedom.

    Both are on the recordings to estimate on, so that the same noise stands in both. One where nothing was smoothed.
    """
    if smoothed is None or not added:
        return 1.0
    last = added[-1].fit
    by_effects = 2 * (nominal.cost - last.cost) - last.size
    by_smoother = smoothed.before - smoothed.after - (smoothed.degrees_before - smoothed.degrees_after)
    return float(by_effects / by_smoother) if by_smoother > 0 else 1.0

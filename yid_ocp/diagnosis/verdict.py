"""Step eight: whether there is a gap, and the verdict."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from yid_ocp.diagnosis.refit import RefitModel
from yid_ocp.diagnosis.screening import CandidateDetectability, CandidateScore, bonferroni_min_p_value
from yid_ocp.diagnosis.select import GapClosure, SelectedEffect
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.inference.null_test import NullTestResult, exceeds_noise
from yid_ocp.inference.smoother import SmootherResult

UnknownReason = Literal["", "none", "unsure", "little", "stand_in"]
"""Why the verdict is unknown: no candidate helps, closure not significant, too little explained, no transfer."""


def has_gap(
    before: NullTestResult,
    held_out: NullTestResult,
    limits: Thresholds,
    ranked: Sequence[CandidateScore] = (),
    offsets: bool = False,
) -> bool:
    """Whether the residual exceeds noise significantly and by a relevant amount.

    Either as a whole, or along what a candidate would do to it with some channel above noise: the sum over all channels
    does not notice what only a few samples show. A candidate alone has to be surer than that sum: it is the best of
    many, at the end of a tail that is known by asymptotics only. An offset of a torque beyond what was stated needs no
    such channel: it is one number among thousands, and all others follow it.

    Parameters
    ----------
    ranked : sequence of CandidateScore
        Of all visible candidates; their smallest p-value counts as the best of that many tries.
    offsets : bool
        Whether the size of torque offsets is stated.
    """
    if exceeds_noise((before, held_out), limits.gap_limits):
        return True
    stated = [score.p_value for score in ranked if score.effect.kind == "effort_offset"] if offsets else []
    if stated and min(stated) * len(ranked) < limits.candidate_significance_level:
        return True
    best = bonferroni_min_p_value(ranked)
    largest = max((*before.channel_chi2.values(), *held_out.channel_chi2.values()), default=1.0)
    return best < limits.candidate_significance_level and largest > 1 + limits.min_channel_excess_chi2


def is_chance_excess(
    smoothed: SmootherResult | None,
    ranked: Sequence[CandidateScore],
    before: NullTestResult,
    held_out: NullTestResult,
    limits: Thresholds,
) -> bool:
    """Whether an excess is barely significant and no unknown or candidate explains it, so that it counts as chance.

    A sure excess without shape stays a gap: stated noise that is too small looks like that.
    """
    best = bonferroni_min_p_value(ranked)
    barely = min(before.p_value, held_out.p_value) > limits.unexplained_p_factor * limits.significance_level
    return barely and best >= limits.significance_level and (smoothed is None or smoothed.gap_origin == "none")


def decide_verdict(
    gap: bool,
    visible: Sequence[CandidateDetectability],
    added: Sequence[SelectedEffect],
    total: GapClosure,
    limits: Thresholds,
    enough: bool,
    explained: float = 1.0,
    carried: bool = True,
) -> str:
    """Return the verdict: insufficient_data, no_gap, unknown, confusable or effect.

    Parameters
    ----------
    added : sequence of SelectedEffect
        After composition.
    total : GapClosure
        Of all effects added.
    enough : bool
        Whether there are samples enough for the unknowns.
    explained : float
        What the effects explain over what unknown forces, offsets and biases explain.
    carried : bool
        Whether the effects come out alike on the held-out recordings.
    """
    if not enough or not any(entry.is_detectable for entry in visible):
        return "insufficient_data"
    if not gap:
        return "no_gap"
    if find_unknown_reason(added, total, limits, explained, carried):
        return "unknown"
    return "confusable" if len(added[0].equivalent_effects) > 1 else "effect"


def assumption_count(added: Sequence[SelectedEffect]) -> int:
    """Count independent assumptions: one law at several locations counts once, local effects count each."""
    return len({entry.effect.label if entry.effect.is_local else entry.effect.kind for entry in added})


def required_explained_fraction(added: Sequence[SelectedEffect], limits: Thresholds) -> float:
    """Return the fraction of the smoother's explained chi2 that the effects are required to explain."""
    return 1.0 - (1.0 - limits.min_explained_fraction) ** assumption_count(added)


def find_unknown_reason(
    added: Sequence[SelectedEffect], total: GapClosure, limits: Thresholds, explained: float = 1.0, carried: bool = True
) -> UnknownReason:
    """Return why a gap has no accepted effect; empty if it has one.

    Effects have to explain the part `required_explained_fraction` of what the smoother explains where the model was
    fitted; a single assumption passes too where the lower 95 % bound of its held-out closure reaches
    `min_explained_fraction`. Each further assumption has to explain that part of what could be left: two or three
    together imitate almost anything, but only in part.
    """
    if not added:
        return "none"
    if not (total.ci_low > limits.min_gap_closed or total.is_decisive):
        return "unsure"
    elsewhere = assumption_count(added) == 1 and total.ci_low >= limits.min_explained_fraction
    if explained < required_explained_fraction(added, limits) and not elsewhere:
        return "little"
    return "" if carried else "stand_in"


def compute_explained_fraction(
    nominal: RefitModel, added: Sequence[SelectedEffect], smoothed: SmootherResult | None
) -> float:
    """Return the decrease of r'r by the effects divided by that of the smoother, both corrected for degrees of freedom.

    Both are on the recordings to estimate on, so that the same noise stands in both. One where nothing was smoothed.
    """
    if smoothed is None or not added:
        return 1.0
    last = added[-1].refitted_model
    by_effects = 2 * (nominal.cost - last.cost) - last.effect_parameter_count
    by_smoother = smoothed.chi2_before - smoothed.chi2_after - (smoothed.dof_before - smoothed.dof_after)
    return float(by_effects / by_smoother) if by_smoother > 0 else 1.0

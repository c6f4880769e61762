"""Step eight: whether there is a gap, whether the effects carry over to the held-out recordings, and the verdict.

Two or three effects together imitate almost anything on the recordings on which they were fitted. What is true of the
robot comes out the same wherever it is fitted; so the held-out recordings are fitted in turn, and values are compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from yid_ocp.diagnosis.refit import RefitContext, RefitStatistics
from yid_ocp.diagnosis.screening import (
    CandidateScore,
    DetectableAmplitudes,
    GapLocation,
    ScreeningResult,
    bonferroni_min_p_value,
    main_gap_locations,
)
from yid_ocp.diagnosis.select import (
    UNDEFINED_GAP_CLOSURE,
    GapClosure,
    SelectedEffect,
    select_effects,
    selection_without,
)
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.effects import EffectBase
from yid_ocp.inference.null_test import NullTestResult, residuals_exceed_noise

UnknownVerdictReason = Literal["", "none", "unsure", "little", "stand_in"]
"""Why the verdict is unknown: no candidate helps, closure not significant, too little explained, no transfer."""

_DISAGREEMENT_Z = 2.0  # standard deviations beyond which two fits disagree


@dataclass(frozen=True)
class EffectAmplitudeTransferCheck:
    """Comparison of one effect parameter's estimates from the estimation recordings and from the held-out ones."""

    effect_label: str
    parameter: str
    unit: str
    estimation_value: float
    estimation_std: float
    held_out_value: float
    held_out_std: float
    is_consistent: bool

    @property
    def both_estimates_text(self) -> str:
        """Text with both estimates, their standard deviations and unit."""
        here = f"{self.estimation_value:.3g} ± {self.estimation_std:.2g} {self.unit} on the recordings to estimate on"
        there = f"{self.held_out_value:.3g} ± {self.held_out_std:.2g} on the held-out ones"
        return f"{self.effect_label}.{self.parameter} is {here} and {there}"

    @property
    def estimate_difference_and_std(self) -> tuple[float, float]:
        """Absolute difference between the two estimates, and its standard deviation."""
        spread = math.hypot(self.estimation_std, self.held_out_std)
        return abs(self.estimation_value - self.held_out_value), spread


@dataclass(frozen=True)
class LocatedGap:
    """Location of the nominal model's gap by the smoother."""

    locations: tuple[GapLocation, ...]
    origin: str  # see `SmoothedUnknownsResult.plant_or_sensor_origin`
    chi2_decrease: float  # by unknown forces, offsets and biases, beyond what chance takes


@dataclass(frozen=True)
class NominalEvidence:
    """Evidence on a gap before the search for effects."""

    nominal_model: RefitStatistics
    nominal_test: NullTestResult  # on the recordings to estimate on
    nominal_held_out_test: NullTestResult
    screening: ScreeningResult
    are_offsets_stated: bool  # whether the size of torque offsets or of constant sensor errors is
    has_left_baseline: bool = False  # whether parameters are no more what an earlier run found

    def has_gap(self, limits: Thresholds) -> bool:
        """Whether the residual, as a whole or along a candidate's signature, exceeds noise by a relevant amount."""
        tests, ranked = (self.nominal_test, self.nominal_held_out_test), self.screening.candidate_scores
        return has_significant_gap(*tests, limits, ranked, self.are_offsets_stated)

    def has_enough_samples(self, limits: Thresholds) -> bool:
        """Whether there are enough effective samples for the unknowns."""
        enough = limits.min_samples_per_unknown * len(self.nominal_model.values)
        return self.nominal_test.degrees_of_freedom >= enough


@dataclass(frozen=True)
class Judgement:
    """What follows from the numbers of a diagnosis: verdict, effects, and the statistics on which they rest."""

    verdict: str  # effect, confusable, no_gap, unknown or insufficient_data
    unknown_reason: UnknownVerdictReason
    single_effect_models: tuple[RefitStatistics, ...]  # of the first round, best first
    selected_effects: tuple[SelectedEffect, ...]
    gap_closure: GapClosure
    explained_fraction: float  # what the effects explain over what the smoother explains
    transfer_checks: tuple[EffectAmplitudeTransferCheck, ...]

    @property
    def accepted(self) -> tuple[SelectedEffect, ...]:
        """The effects of an `effect` or `confusable` verdict, in the order they were added; empty for others."""
        return self.selected_effects if self.verdict in ("effect", "confusable") else ()

    @property
    def closure_by_location(self) -> dict[str, float]:
        """Part of the gap that the accepted effects at each location close beyond those added before."""
        closed: dict[str, float] = {}
        most = 0.0
        for entry in self.accepted:
            place, part = entry.effect.location, entry.cumulative_closure.fraction
            closed[place] = closed.get(place, 0.0) + max(part - most, 0.0)
            most = max(part, most)
        return closed


def judge(
    search: RefitContext,
    seen: NominalEvidence,
    locate: Callable[[], LocatedGap],
    finished: Callable[[str], None] = lambda _: None,
) -> Judgement:
    """Return the verdict that follows from what is known of the gap and from what a search for effects is answered.

    A function of numbers alone: refits, screenings and the smoother (`locate`) are asked for by name, and are answered
    from a record as well. `finished` is called with the name of each stage.
    """
    limits, scores = search.thresholds, seen.screening.candidate_scores
    seen_gap, enough = seen.has_gap(limits), seen.has_enough_samples(limits)
    moved = seen.has_left_baseline and not seen_gap
    gap, located, trusted = seen_gap or moved, None, None
    if gap and enough:
        located = locate()
        # it knows noise of torques by its spectrum only: too little for a verdict to rest on what it explains
        trusted = None if seen.nominal_model.has_process_noise else located
        gap = not is_barely_significant_and_unexplained(trusted, seen, limits)
    finished("localisation")
    fits: tuple[RefitStatistics, ...] = ()
    added: tuple[SelectedEffect, ...] = ()
    if gap and enough and scores and located is not None:
        places = [place.location for place in main_gap_locations(located.locations)]
        fits, added = select_effects(search, seen.nominal_model, seen.screening, places, seen.has_left_baseline)
    finished("refits")
    added, carried = _effects_with_transfer_checks(search, seen.nominal_model, added)
    finished("carry_over")
    total = added[-1].cumulative_closure if added else UNDEFINED_GAP_CLOSURE
    explained = fraction_of_smoother_chi2_decrease(seen.nominal_model, added, trusted)
    reason = find_unknown_verdict_reason(added, total, limits, explained, not failed_transfer_checks(carried))
    # what parameters explain by moving is no gap
    gap = gap and (bool(added) or not moved)
    verdict = decide_verdict(gap, enough, seen.screening.detectability, reason, added)
    return Judgement(verdict, reason if verdict == "unknown" else "", fits, added, total, explained, carried)


def _effects_with_transfer_checks(
    search: RefitContext, nominal: RefitStatistics, added: tuple[SelectedEffect, ...]
) -> tuple[tuple[SelectedEffect, ...], tuple[EffectAmplitudeTransferCheck, ...]]:
    """Return the selected effects, their standard deviations increased by disagreement, and their transfer checks.

    Effects of one place divide a torque between them as the noise happens to fall. Where they do not transfer, one of
    them is left out if the others transfer without it, the last one first.
    """
    if not added:
        return added, ()
    checks = _check_effect_amplitude_transfer(search, added[-1].refitted_model)
    places = [entry.effect.location for entry in added]
    shared = [entry for entry in reversed(added) if places.count(entry.effect.location) > 1]
    for entry in shared if failed_transfer_checks(checks) else ():
        fewer = selection_without(search, nominal, added, entry)
        own = _check_effect_amplitude_transfer(search, fewer[-1].refitted_model) if fewer else ()
        if own and not failed_transfer_checks(own):
            added, checks = fewer, own
            break
    if not checks:
        return added, ()
    last = _inflate_fit_stds_by_disagreement(added[-1].refitted_model, checks)
    return (*added[:-1], replace(added[-1], refitted_model=last)), checks


def _check_effect_amplitude_transfer(
    search: RefitContext, fit: RefitStatistics
) -> tuple[EffectAmplitudeTransferCheck, ...]:
    """Refit the effects on the held-out recordings and compare each amplitude with its estimate in `fit`.

    Empty if one recording is split, or if the model cannot be fitted there, which is no evidence against it.
    """
    again = search.refit_on_held_out(fit) if fit.effects else None
    if again is None:
        return ()
    return tuple(entry for effect in fit.effects for entry in _compare(effect, fit, again, search.thresholds))


def _compare(
    effect: EffectBase, first: RefitStatistics, second: RefitStatistics, limits: Thresholds
) -> list[EffectAmplitudeTransferCheck]:
    """The amplitudes of one effect in two fits."""
    neutral, found = effect.neutral_values, []
    width = {name: high - low for name, (low, high) in effect.prior_ranges.items()}
    size = max(abs(fit.values[n] - neutral[n]) / width[n] for fit in (first, second) for n in effect.amplitude_names)
    for name in effect.amplitude_names:
        own = (first.values[name], first.std[name], second.values[name], second.std[name])
        what = (effect.label, name.removeprefix(f"{effect.label}."), effect.parameters[name].unit)
        entry = EffectAmplitudeTransferCheck(*what, *own, True)
        apart, spread = entry.estimate_difference_and_std
        # what has no standard deviation says nothing against it
        sure = math.isfinite(spread) and apart > limits.transfer_z_max * spread
        found.append(replace(entry, is_consistent=not sure or apart <= limits.transfer_rtol * size * width[name]))
    return found


def _inflate_fit_stds_by_disagreement(
    fit: RefitStatistics, entries: Sequence[EffectAmplitudeTransferCheck]
) -> RefitStatistics:
    """Return the fit with standard deviations increased for amplitudes that disagree between the recordings.

    Where two fits differ by more than `_DISAGREEMENT_Z` standard deviations of both together, each is known to the
    spread of the two, the difference over the square root of two.
    """
    std = dict(fit.std)
    for entry in entries:
        (apart, spread), name = entry.estimate_difference_and_std, f"{entry.effect_label}.{entry.parameter}"
        if apart > _DISAGREEMENT_Z * spread:
            std[name] = max(std[name], apart / math.sqrt(2.0))
    return replace(fit, std=std)


def failed_transfer_checks(entries: Sequence[EffectAmplitudeTransferCheck]) -> tuple[EffectAmplitudeTransferCheck, ...]:
    """Return the checks whose two estimates disagree."""
    return tuple(entry for entry in entries if not entry.is_consistent)


def has_significant_gap(
    before: NullTestResult,
    held_out: NullTestResult,
    limits: Thresholds,
    ranked: Sequence[CandidateScore] = (),
    offsets: bool = False,
) -> bool:
    """Whether the residual, as a whole or along a candidate's signature, exceeds noise by a relevant amount.

    Along a candidate's signature some channel must be above noise too; the sum over all channels does not notice what
    only a few samples show. A candidate alone needs a smaller p-value than the sum. An offset of a torque beyond the
    stated one needs no such channel where `offsets` are stated: it is one number among thousands.
    """
    if residuals_exceed_noise((before, held_out), limits.null_test_limits):
        return True
    stated = [score.p_value for score in ranked if score.effect.is_torque_offset] if offsets else []
    if stated and min(stated) * len(ranked) < limits.gap_significance_level_by_candidate:
        return True
    best = bonferroni_min_p_value(ranked)
    largest = max((*before.channel_chi2.values(), *held_out.channel_chi2.values()), default=1.0)
    return best < limits.gap_significance_level_by_candidate and largest > 1 + limits.min_channel_excess_chi2_per_dof


def is_barely_significant_and_unexplained(
    located: LocatedGap | None, seen: NominalEvidence, limits: Thresholds
) -> bool:
    """Whether an excess counts as chance: barely significant, and explained by no unknown or candidate.

    A significant excess without shape stays a gap: understated noise looks like that.
    """
    best = bonferroni_min_p_value(seen.screening.candidate_scores)
    surest = min(seen.nominal_test.p_value, seen.nominal_held_out_test.p_value)
    barely = surest > limits.unexplained_p_factor * limits.significance_level
    has_no_place = located is None or located.origin == "none"
    return barely and best >= limits.significance_level and has_no_place


def decide_verdict(
    gap: bool,
    enough: bool,
    visible: Sequence[DetectableAmplitudes],
    reason: UnknownVerdictReason,
    added: Sequence[SelectedEffect],
) -> str:
    """Return the verdict of a diagnosis; `enough` states whether there are enough samples for the unknowns."""
    if not enough or not any(entry.is_detectable for entry in visible):
        return "insufficient_data"
    if not gap:
        return "no_gap"
    if reason:
        return "unknown"
    return "confusable" if len(added[0].equivalent_effects) > 1 else "effect"


def independent_assumption_count(added: Sequence[SelectedEffect]) -> int:
    """Number of independent assumptions in effects: one for each kind, but one for each local effect."""
    return len({entry.effect.label if entry.effect.is_local else entry.effect.kind for entry in added})


def required_fraction_of_smoother_chi2_decrease(added: Sequence[SelectedEffect], limits: Thresholds) -> float:
    """Return the fraction of the chi2 explained by the smoother that the effects are required to explain.

    Each further assumption has to explain that part of what could be left.
    """
    return 1.0 - (1.0 - limits.min_explained_fraction) ** independent_assumption_count(added)


def find_unknown_verdict_reason(
    added: Sequence[SelectedEffect], total: GapClosure, limits: Thresholds, explained: float, carried: bool
) -> UnknownVerdictReason:
    """Return the code of the reason why no effect is accepted for a gap; empty if one is accepted.

    Effects have to explain `required_fraction_of_smoother_chi2_decrease` of what the smoother explains where the
    model was fitted; a single assumption passes too where the lower 95 % bound of its held-out closure reaches
    `min_explained_fraction`.
    """
    if not added:
        return "none"
    if not (total.ci_low > limits.min_gap_closed or total.is_decisive):
        return "unsure"
    elsewhere = independent_assumption_count(added) == 1 and total.ci_low >= limits.min_explained_fraction
    if explained < required_fraction_of_smoother_chi2_decrease(added, limits) and not elsewhere:
        return "little"
    return "" if carried else "stand_in"


def fraction_of_smoother_chi2_decrease(
    nominal: RefitStatistics, added: Sequence[SelectedEffect], located: LocatedGap | None
) -> float:
    """Return the effects' decrease of r'r divided by the smoother's, each less degrees of freedom; 1 if undefined."""
    if located is None or not added or located.chi2_decrease <= 0:
        return 1.0
    last = added[-1].refitted_model
    return (2 * (nominal.cost - last.cost) - last.effect_parameter_count) / located.chi2_decrease

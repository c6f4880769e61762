"""The rules that decide whether there is a gap, whether effects transfer to held-out recordings, and the verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from yid_ocp.diagnosis import select
from yid_ocp.diagnosis.refit import RefitContext, RefitStatistics
from yid_ocp.diagnosis.screening import ScreeningResult, bonferroni_corrected_min_candidate_p_value
from yid_ocp.diagnosis.select import HeldOutGapClosure, SelectedEffect, select_effects
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.effects import EffectBase
from yid_ocp.inference.null_test import NullTestResult, residuals_exceed_noise
from yid_ocp.problem.options import ExcessResidualCriteria

_UnknownVerdictReason = Literal["", "none", "little", "stand_in"]
"""Why the verdict is unknown: no candidate helps, too little explained, no transfer."""

_LOGISTIC_OFFSET, _LOGISTIC_SLOPE = -0.2, 0.8  # of the log odds over the logarithm of what is unexplained
_MIN_UNEXPLAINED = 0.02  # fraction of the gap below which the rest is noise
_DISAGREEMENT_Z = 2.0  # standard deviations beyond which two fits disagree


@dataclass(frozen=True)
class EffectAmplitudeTransferCheck:
    """A comparison of two estimates of one effect parameter, from the estimation and the held-out recordings."""

    effect_label: str
    parameter: str
    unit: str
    estimation_value: float
    estimation_std: float
    held_out_value: float
    held_out_std: float
    neutral_value: float
    is_consistent: bool

    @property
    def disagreement_text(self) -> str:
        """A text with both estimates, their difference and the limits that it exceeds if they are inconsistent."""
        (apart, spread), unit = self._difference_and_std, f" {self.unit}".removesuffix(" 1")
        here = f"{self.estimation_value:.4g} ± {self.estimation_std:.2g}{unit} on the fitted recordings"
        there = f"{self.held_out_value:.4g} ± {self.held_out_std:.2g}{unit} on the held-out ones"
        size = abs(self.estimation_value - self.neutral_value) / math.sqrt(2.0)
        limits = f"2 std ({2 * spread:.2g}{unit}) and 70 % of the change from {self.neutral_value:g} ({size:.3g}{unit})"
        text = f"{self.effect_label}.{self.parameter} is {here} and {there}"
        return f"{text}, so the difference of {apart:.3g}{unit} exceeds {limits}"

    @property
    def _difference_and_std(self) -> tuple[float, float]:
        return abs(self.estimation_value - self.held_out_value), math.hypot(self.estimation_std, self.held_out_std)

    @property
    def significant_disagreement_as_std(self) -> float:
        """The difference of the estimates divided by sqrt(2) if it is significant, else 0."""
        apart, spread = self._difference_and_std
        return apart / math.sqrt(2.0) if apart > _DISAGREEMENT_Z * spread else 0.0


@dataclass(frozen=True)
class NominalModelGapEvidence:
    """The evidence for a gap that is known before the search for effects."""

    nominal_model: RefitStatistics
    nominal_test: NullTestResult  # test on the estimation recordings
    nominal_held_out_test: NullTestResult
    screening: ScreeningResult
    has_left_baseline: bool = False  # whether parameters have left the estimates of an earlier run
    discretisation_chi2: float = 0.0  # r'r that a finer discretisation may still remove

    def residual_exceeds_noise(self, limits: Thresholds) -> bool:
        """Check whether the residual as a whole exceeds noise by a relevant amount."""
        whole = ExcessResidualCriteria(limits.gap_significance_level, limits.min_excess_chi2_per_dof)
        return residuals_exceed_noise((self.nominal_test, self.nominal_held_out_test), whole)

    def may_have_gap(self, limits: Thresholds) -> bool:
        """Check whether the residual exceeds noise (in total or along a candidate) or parameters left the baseline.

        A gap that parameters close by leaving the estimates of an earlier run counts only if an effect explains it.
        """
        scores = self.screening.candidate_scores
        seen = [score for score in scores if score.predicted_chi2_decrease > self.discretisation_chi2]
        is_along_candidate = bonferroni_corrected_min_candidate_p_value(seen) < limits.gap_significance_level
        return self.has_left_baseline or is_along_candidate or self.residual_exceeds_noise(limits)

    @property
    def are_data_sufficient(self) -> bool:
        """Whether there are more effective samples than unknowns, and any candidate is detectable."""
        is_seen = any(entry.is_detectable for entry in self.screening.detectability)
        return is_seen and self.nominal_test.degrees_of_freedom > len(self.nominal_model.values)

    def warrants_effect_search(self, limits: Thresholds) -> bool:
        """Check whether there may be a gap and the data suffice to search for its cause."""
        return self.may_have_gap(limits) and self.are_data_sufficient


@dataclass(frozen=True)
class Judgement:
    """The verdict of a diagnosis and the effects that it selects, with the statistics that support them."""

    verdict: str  # effect, confusable, no_gap, unknown or insufficient_data
    unknown_reason: _UnknownVerdictReason
    single_effect_models: tuple[RefitStatistics, ...]  # refits of the first round, best first
    selected_effects: tuple[SelectedEffect, ...]
    explained_fraction: float  # decrease of r'r by the effects over its excess over noise
    transfer_checks: tuple[EffectAmplitudeTransferCheck, ...]
    probability: float  # that the selected effects, or effects that are equivalent to them, are the cause
    confusable_parameter_changes: tuple[str, ...]  # changes since a baseline that explain as much as the effects

    @property
    def closure_by_selected_effects(self) -> HeldOutGapClosure:
        """The fraction of the gap that all selected effects close together. Undefined without effects."""
        return select.total_gap_closure(self.selected_effects)

    @property
    def accepted_selected_effects(self) -> tuple[SelectedEffect, ...]:
        """The effects that a verdict `effect` or `confusable` accepts, in the order added; none for other verdicts."""
        return self.selected_effects if self.verdict in ("effect", "confusable") else ()

    def with_confusable_parameter_changes(self, names: Sequence[str], bic_difference: float) -> Judgement:
        """Return this judgement if changes explain as much, with the BIC of the changes minus that of the effects.

        The difference of the BIC is divided by the threshold (`select.bic_difference_per_threshold`).
        """
        share = select.relative_probability(bic_difference)
        rivals, probability = tuple(names), self.probability * share
        return replace(self, verdict="confusable", confusable_parameter_changes=rivals, probability=probability)

    @property
    def failed_transfer_checks(self) -> tuple[EffectAmplitudeTransferCheck, ...]:
        """The checks in which estimation and held-out recordings give different values of an effect parameter."""
        return tuple(entry for entry in self.transfer_checks if not entry.is_consistent)

    @property
    def accepted_effects_closure_by_location(self) -> dict[str, float]:
        """The fraction of the gap that accepted effects at each location close beyond the effects added before."""
        closed: dict[str, float] = {}
        most = 0.0
        for entry in self.accepted_selected_effects:
            place, part = entry.effect.location, entry.cumulative_closure.fraction
            closed[place] = closed.get(place, 0.0) + max(part - most, 0.0)
            most = max(part, most)
        return closed

    @property
    def selected_effect_and_equivalent_probabilities(self) -> dict[str, float]:
        """The probability that an effect is a cause, by label, for the selected effects and their equivalents."""
        return {
            effect.label: self.probability * share
            for entry in self.selected_effects
            for effect, share in zip(entry.equivalent_effects, entry.shares, strict=True)
        }

    @property
    def _largest_explained_fraction(self) -> float:
        """Explained fraction of the gap: fitted, or if larger the 95 % lower limit of the held-out closure."""
        return max(self.explained_fraction, self.closure_by_selected_effects.ci_low)

    def required_total_explained_fraction(self, limits: Thresholds) -> float:
        """Compute the fraction of the gap that the selected effects must explain to be accepted.

        For k independent effects (one per local effect and one per other kind) it is
        1 - (1 - `min_explained_fraction`)^k: each must explain that part of the remainder.
        """
        effects = (entry.effect for entry in self.selected_effects)
        independent = {effect.label if effect.is_local else effect.kind for effect in effects}
        return 1.0 - (1.0 - limits.min_explained_fraction) ** len(independent)


def _verdict(said: Judgement, exceeds: bool, suffice: bool, limits: Thresholds) -> tuple[str, _UnknownVerdictReason]:
    """The verdict, and the first reason why no effect is accepted. See `required_total_explained_fraction`.

    A gap that is seen only along a candidate's signature counts only with an accepted effect.
    """
    reasons: dict[_UnknownVerdictReason, bool] = {
        "none": not said.selected_effects,
        "little": said._largest_explained_fraction < said.required_total_explained_fraction(limits),
        "stand_in": bool(said.failed_transfer_checks),
    }
    reason: _UnknownVerdictReason = next((name for name, holds in reasons.items() if holds), "")
    if not suffice:
        return "insufficient_data", ""
    if reason:
        return ("unknown", reason) if exceeds else ("no_gap", "")
    return ("confusable" if len(said.selected_effects[0].equivalent_effects) > 1 else "effect"), ""


def judge(search: RefitContext, evidence: NominalModelGapEvidence) -> Judgement:
    """Search for effects if there is evidence for a gap, and decide the verdict.

    Refits and screenings are requested by name and can come from a record, so the verdict depends on numbers alone.
    """
    limits, nominal = search.thresholds, evidence.nominal_model
    fits, added = tuple[RefitStatistics, ...](), tuple[SelectedEffect, ...]()
    if evidence.warrants_effect_search(limits):
        fits, added = select_effects(search, nominal, evidence.screening, evidence.has_left_baseline)
    search.record_stage_end_time("refits")

    def judged(chosen: tuple[SelectedEffect, ...]) -> Judgement:
        carried, explained = tuple[EffectAmplitudeTransferCheck, ...](), 1.0
        if chosen:
            last = chosen[-1].refitted_model
            explained = _explained_fraction(nominal, last, limits)
            carried = _check_effect_amplitude_transfer(search, last)
            last = select.widen_refit_stds_by_model_error(chosen[-1], limits)
            least = {f"{e.effect_label}.{e.parameter}": e.significant_disagreement_as_std for e in carried}
            last = replace(last, std={name: max(std, least.get(name, 0.0)) for name, std in last.std.items()})
            chosen = (*chosen[:-1], replace(chosen[-1], refitted_model=last))
        said = Judgement("", "", fits, chosen, explained, carried, 0.0, ())
        verdict, reason = _verdict(said, evidence.residual_exceeds_noise(limits), evidence.are_data_sufficient, limits)
        return replace(said, verdict=verdict, unknown_reason=reason, probability=_probability(said, limits))

    said = judged(added)
    if said.verdict == "unknown" and len(added) > 1:
        # a further effect that only corrects errors of the first is no reason to doubt this one
        alone = judged((select.effect_with_its_equivalents(added[0], nominal, fits, limits),))
        said = alone if alone.verdict != "unknown" else said
    search.record_stage_end_time("transfer")
    return said


def _probability(said: Judgement, limits: Thresholds) -> float:
    """Probability that the selected effects are the cause, from how much they explain of what is required.

    A logistic curve fitted to a calibration ensemble; see `docs/design/verdicts.md`.
    """
    if not said.selected_effects:
        return 0.0
    explained = 0.0 if said.failed_transfer_checks else said._largest_explained_fraction
    unexplained = max(1.0 - explained, _MIN_UNEXPLAINED)
    margin = math.log((1.0 - said.required_total_explained_fraction(limits)) / unexplained)
    return 1.0 / (1.0 + math.exp(-_LOGISTIC_OFFSET - _LOGISTIC_SLOPE * margin))


def _explained_fraction(nominal: RefitStatistics, last: RefitStatistics, limits: Thresholds) -> float:
    """Decrease of r'r by effects over its excess over noise; 1 if only noise, or 2/3 of a small gap, is left.

    On held-out recordings alone, nothing is left where nothing was before.
    """
    before, left = nominal.held_out_loss, last.held_out_loss.excess_chi2_per_sample
    decrease = 2 * (nominal.cost - last.cost) - last.total_effect_parameter_count
    excess = max(2 * nominal.cost - nominal.residual_count, decrease, 1.0)
    least = max(before.excess_chi2_per_sample * 2 / 3, math.sqrt(2.0 / float(before.block_sample_counts.sum())))
    fits_to_noise = 2 * last.cost < (1 + limits.min_excess_chi2_per_dof) * last.residual_count
    return 1.0 if fits_to_noise and left < min(least, limits.min_excess_chi2_per_dof) else decrease / excess


def _check_effect_amplitude_transfer(
    search: RefitContext, fit: RefitStatistics
) -> tuple[EffectAmplitudeTransferCheck, ...]:
    """Refit the effects on the held-out recordings and compare each amplitude with its estimate in `fit`.

    Empty if one recording is split, or if the refit fails; neither is evidence against an effect.
    """
    again = search.refit_on_held_out(fit)
    return () if again is None else tuple(entry for effect in fit.effects for entry in _compare(effect, fit, again))


def _compare(effect: EffectBase, first: RefitStatistics, second: RefitStatistics) -> list[EffectAmplitudeTransferCheck]:
    """Comparison of the amplitudes of one effect in two fits.

    Recordings that disagree by as much as the effect differs from neutral do not determine it.
    """
    found, away = [], []
    for name in effect.amplitude_parameter_names:
        own = (first.values[name], first.std[name], second.values[name], second.std[name])
        what = (effect.label, name.removeprefix(f"{effect.label}."), effect.parameters[name].unit)
        entry = EffectAmplitudeTransferCheck(*what, *own, effect.neutral_values[name], True)
        least = _DISAGREEMENT_Z * entry.significant_disagreement_as_std
        away.append(abs(entry.estimation_value - entry.neutral_value) > least)
        found.append(entry)
    return [replace(entry, is_consistent=any(away)) for entry in found]

"""The rules that decide whether there is a gap, whether effects transfer to held-out recordings, and the verdict."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from yid_ocp.diagnosis.baseline import ParameterShift
from yid_ocp.diagnosis.refit import RefitContext, RefitStatistics
from yid_ocp.diagnosis.screening import ScreeningResult
from yid_ocp.diagnosis.select import SelectedEffect, select_effects, total_gap_closure
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.display import grouped
from yid_ocp.effects import EffectBase
from yid_ocp.inference import null_test
from yid_ocp.problem.options import ExcessResidualCriteria

_LOGISTIC_OFFSET, _LOGISTIC_SLOPE = -0.2, 0.8  # of the log odds over the logarithm of what is unexplained
_MIN_UNEXPLAINED = 0.02  # fraction of the gap below which the rest is noise
_DISAGREEMENT_Z = 2.0  # standard deviations beyond which two fits disagree


@dataclass(frozen=True)
class EffectAmplitudeTransferCheck:
    """A comparison of two estimates of one effect parameter, from the estimation and the held-out recordings."""

    effect: EffectBase
    parameter: str  # with the label of the effect
    fitted: tuple[float, float]  # value and standard deviation
    held_out: tuple[float, float]

    @property
    def text(self) -> str:
        """A text with both estimates."""
        unit = f" {self.effect.parameters[self.parameter].unit}".removesuffix(" 1")
        here, there = (f"{value:.4g} ± {std:.2g}{unit}" for value, std in (self.fitted, self.held_out))
        return f"{self.parameter} is {here} on the fitted recordings and {there} on the held-out ones"

    @property
    def significant_disagreement_as_std(self) -> float:
        """The difference of the estimates divided by sqrt(2) if it is significant, else 0."""
        (here, std), (there, other_std) = self.fitted, self.held_out
        apart, spread = abs(here - there), math.hypot(std, other_std)
        return apart / math.sqrt(2.0) if apart > _DISAGREEMENT_Z * spread else 0.0


@dataclass(frozen=True)
class NominalModelGapEvidence:
    """The evidence for a gap that is known before the search for effects."""

    nominal_model: RefitStatistics
    nominal_test: null_test.NullTestResult  # test on the estimation recordings
    nominal_held_out_test: null_test.NullTestResult
    screening: ScreeningResult
    has_left_baseline: bool = False  # whether parameters have left the estimates of an earlier run
    discretisation_chi2: float = 0.0  # r'r that a finer discretisation may still remove
    has_left_start: bool = False  # whether the nominal fit is far from its initial values or contradicts priors

    def residual_exceeds_noise(self, limits: Thresholds) -> bool:
        """Check whether the residual as a whole exceeds noise by a relevant amount."""
        whole = ExcessResidualCriteria(limits.gap_significance_level, limits.min_excess_chi2_per_dof)
        return null_test.residuals_exceed_noise((self.nominal_test, self.nominal_held_out_test), whole)

    def warrants_effect_search(self, limits: Thresholds) -> bool:
        """Check whether there may be a gap and the data suffice to search for its cause.

        The residual exceeds noise (in total or along a candidate), or parameters left the baseline. A gap that
        parameters close by leaving the estimates of an earlier run counts only if an effect explains it.
        """
        scores = self.screening.candidate_scores
        seen = [score.p_value for score in scores if score.predicted_chi2_decrease > self.discretisation_chi2]
        is_along_candidate = null_test.bonferroni_corrected_min_p_value(seen) < limits.gap_significance_level
        may_have_gap = self.has_left_baseline or is_along_candidate or self.residual_exceeds_noise(limits)
        return may_have_gap and self.are_data_sufficient

    @property
    def are_data_sufficient(self) -> bool:
        """Whether there are more effective samples than unknowns, and any candidate is detectable."""
        is_seen = any(entry.is_detectable for entry in self.screening.detectability)
        return is_seen and self.nominal_test.degrees_of_freedom > len(self.nominal_model.values)


@dataclass(frozen=True)
class Judgement:
    """The verdict of a diagnosis and the effects that it selects, with the statistics that support them."""

    verdict: str  # effect, confusable, no_gap, unknown or insufficient_data
    unknown_reason: str  # none (no candidate helps), little (is explained) or stand_in (the size is not known)
    single_effect_models: tuple[RefitStatistics, ...]  # refits of the first round, best first
    selected_effects: tuple[SelectedEffect, ...]
    explained_fraction: float  # decrease of r'r by the effects over its excess over noise
    transfer_checks: tuple[EffectAmplitudeTransferCheck, ...]
    probability: float  # that the selected effects, or effects that are equivalent to them, are the cause
    rival_shifts: tuple[ParameterShift, ...]  # since a baseline, which explain about as much as the effects
    rival_probability: float  # that these shifts are the cause

    @property
    def accepted_selected_effects(self) -> tuple[SelectedEffect, ...]:
        """The effects that a verdict `effect` or `confusable` accepts, in the order added; none for other verdicts."""
        return self.selected_effects if self.verdict in ("effect", "confusable") else ()

    def undetermined_sizes(self, limits: Thresholds) -> dict[str, list[str]]:
        """Both estimates, as texts, of the effects within `min_z` stds (which include the gap) of neutral, by label."""
        effects, fits = [e.effect for e in self.selected_effects], [e.refitted_model for e in self.selected_effects]
        unsure = [own.label for own in effects if not fits[-1].determines_size(own, limits.min_z)]
        texts = grouped((check.effect.label, check.text) for check in self.transfer_checks)
        return {label: texts.get(label, []) for label in unsure}

    @property
    def accepted_effects_closure_by_location(self) -> dict[str, float]:
        """The fraction of the gap that accepted effects at each location close beyond the effects added before."""
        closed, most = dict[str, float](), 0.0
        for entry in self.accepted_selected_effects:
            place, part = entry.effect.location, entry.cumulative_closure.fraction
            closed[place] = closed.get(place, 0.0) + max(part - most, 0.0)
            most = max(part, most)
        return closed

    def explained_and_required_fractions(self, limits: Thresholds) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the explained and the required fraction of the gap, of fitted r'r and of held-out errors.

        One of the two must suffice. Held-out errors count at the lower end of the closure's 95 % interval. If one
        effect must explain L, k independent ones (every local one, every other kind) must explain 1 - (1 - L)^k.
        """
        effects = (entry.effect for entry in self.selected_effects)
        count = len({effect.label if effect.is_local else effect.kind for effect in effects})
        closed = total_gap_closure(self.selected_effects).ci_low
        pairs = (self.explained_fraction, limits.min_explained_fraction), (closed, limits.min_closure)
        fitted, held_out = ((part, 1.0 - (1.0 - least) ** count) for part, least in pairs)
        return fitted, held_out


def judge(search: RefitContext, evidence: NominalModelGapEvidence) -> Judgement:
    """Search for effects if there is evidence for a gap, and decide the verdict.

    Refits and screenings are requested by name and can come from a record, so the verdict depends on numbers alone.
    """
    limits, nominal = search.thresholds, evidence.nominal_model
    fits, added, beside = tuple[RefitStatistics, ...](), tuple[SelectedEffect, ...](), dict[str, float]()
    if evidence.warrants_effect_search(limits):
        has_left = evidence.has_left_baseline, evidence.has_left_start
        fits, added, beside = select_effects(search, nominal, evidence.screening, *has_left)
    search.record_stage_end_time("refits")

    carried, explained = tuple[EffectAmplitudeTransferCheck, ...](), 1.0
    if added:
        last = added[-1].refitted_model
        explained = _explained_fraction(nominal, last, limits)
        carried = _check_effect_amplitude_transfer(search, last)
        apart = {own.parameter: own.significant_disagreement_as_std for own in carried}
        std = {name: max(std, beside.get(name, 0.0), apart.get(name, 0.0)) for name, std in last.std.items()}
        added = (*added[:-1], replace(added[-1], refitted_model=replace(last, std=std)))
    said = Judgement("", "", fits, added, explained, carried, 0.0, (), 0.0)
    reasons = _reasons_against(said, limits)
    reason = next((name for name, holds in reasons.items() if holds), "")
    # a gap that is seen only along a candidate's signature counts only with an accepted effect
    verdicts = {
        ("insufficient_data", ""): not evidence.are_data_sufficient,
        ("unknown", reason): bool(reason) and evidence.residual_exceeds_noise(limits),
        ("no_gap", ""): bool(reason),
        ("confusable", ""): any(len(entry.equivalent_effects) > 1 for entry in said.selected_effects[:1]),
        ("effect", ""): True,
    }
    verdict, told = next(pair for pair, holds in verdicts.items() if holds)
    search.record_stage_end_time("transfer")
    probability = 0.0 if reasons["none"] else _probability(said, reasons["stand_in"], limits)
    return replace(said, verdict=verdict, unknown_reason=told, probability=probability)


def _reasons_against(said: Judgement, limits: Thresholds) -> dict[str, bool]:
    """Whether each reason not to accept the selected effects holds; the first that does is told."""
    return {
        "none": not said.selected_effects,
        "little": not any(part >= least for part, least in said.explained_and_required_fractions(limits)),
        "stand_in": bool(said.undetermined_sizes(limits)),
    }


def _probability(said: Judgement, is_size_unknown: bool, limits: Thresholds) -> float:
    """Probability that the selected effects are the cause, from how much they explain of what is required.

    A logistic curve fitted to a calibration ensemble; see `docs/design/verdicts.md`.
    """
    (fitted, least), (closed, goal) = said.explained_and_required_fractions(limits)
    left = min(1.0 - fitted, (1.0 - closed) * (1.0 - least) / (1.0 - goal))  # the first if there is no closure
    unexplained = 1.0 if is_size_unknown else max(left, _MIN_UNEXPLAINED)
    return 1.0 / (1.0 + math.exp(-_LOGISTIC_OFFSET - _LOGISTIC_SLOPE * math.log((1.0 - least) / unexplained)))


def _explained_fraction(nominal: RefitStatistics, last: RefitStatistics, limits: Thresholds) -> float:
    """Decrease of r'r by effects over its excess over noise; 1 if only noise is left."""
    decrease = 2 * (nominal.cost - last.cost) - last.total_effect_parameter_count
    excess = max(nominal.excess_chi2, decrease, 1.0)
    is_left = (2 * last.cost / last.residual_count - 1, last.held_out_loss.excess_chi2_per_sample)
    return 1.0 if max(is_left) < limits.min_excess_chi2_per_dof else decrease / excess


def _check_effect_amplitude_transfer(
    search: RefitContext, fit: RefitStatistics
) -> tuple[EffectAmplitudeTransferCheck, ...]:
    """Compare amplitudes with those of a held-out refit; empty without one, which is no evidence against an effect."""
    if (again := search.refit_on_held_out(fit)) is None:
        return ()
    names = ((effect, name) for effect in fit.effects for name in effect.amplitude_parameter_names)
    return tuple(
        EffectAmplitudeTransferCheck(effect, name, *((own.values[name], own.std[name]) for own in (fit, again)))
        for effect, name in names
    )

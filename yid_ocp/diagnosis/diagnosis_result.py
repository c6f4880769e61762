"""The result of a diagnosis as a dataclass and in the format `yid-diagnosis/2`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from yid_ocp.diagnosis.baseline import EarlierRunsComparison, ErrorsWithEffectsRemovedAndAdded
from yid_ocp.diagnosis.events import NO_EVENTS, EventSet
from yid_ocp.diagnosis.hypotheses import TruncatedHeldOutRecording
from yid_ocp.diagnosis.law import GapLaw
from yid_ocp.diagnosis.refit import EffectSearchRecord, RefitStatistics, RefittedModel
from yid_ocp.diagnosis.screening import bonferroni_corrected_min_candidate_p_value
from yid_ocp.diagnosis.select import (
    GapClosure,
    bic_difference,
    held_out_gap_closure,
)
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.diagnosis.verdict import (
    GapLocalization,
    Judgement,
    NominalModelGapEvidence,
)
from yid_ocp.display import ReprLineAndTableRows, ReprMixin
from yid_ocp.effects import EffectBase
from yid_ocp.files import object_attributes_to_json_dict, to_json_types
from yid_ocp.inference.null_test import (
    AssumedChannelNoiseLevel,
    NullTestResult,
    bonferroni_corrected_min_test_p_value,
)
from yid_ocp.inference.smoother import GapLocation, SmoothedUnknownsResult

_FORMAT = "yid-diagnosis/2"


@dataclass(frozen=True)
class NominalParameterChange:
    """Value of one nominal parameter in the nominal model and in the model with the accepted effects."""

    name: str
    unit: str
    value_before: float
    value_after: float
    std_after: float


@dataclass(frozen=True, repr=False, kw_only=True)
class DiagnosisResult(NominalModelGapEvidence, Judgement, ReprMixin):
    """Result of a diagnosis: verdict, gap, locations, effects and the statistics behind them.

    `to_dict` returns it in the format of result.json, with a unit for every value.

    Attributes
    ----------
    verdict : str
        `effect`, `confusable`, `no_gap`, `unknown` or `insufficient_data`.
    gap_closure : GapClosure
        Fraction of the held-out gap that the accepted effects close [1], with its 95 % interval.
    explained_fraction : float
        Decrease of the sum of squared whitened residuals by the effects over its decrease by unknown forces [1].
    noise_floor : tuple of AssumedChannelNoiseLevel
        Root mean square error expected from noise alone, in the channel's unit (m, rad or N m).
    smoother_result : SmoothedUnknownsResult or None
        Means and standard deviations (J, nd) per recording of nd unknown forces [N m or N], offsets and biases [m] in J
        time intervals, in units of `reference_std` (nd,). None if there is no gap to locate.
    nominal_model, final_model : RefittedModel
        `values` and `std` by parameter, each in its own unit (`problem.system.parameters[name].unit`).
    nominal_changes : tuple of NominalParameterChange
        Nominal parameters without and with the accepted effects, in `unit`.
    stage_seconds, search_seconds : mapping of str to float, float
        Durations [s].
    """

    noise_floor: tuple[AssumedChannelNoiseLevel, ...]
    smoother_result: SmoothedUnknownsResult | None  # about the nominal model; None if there is no gap to locate
    gap_locations: tuple[GapLocation, ...]
    nominal_model: RefittedModel
    remaining_test: NullTestResult  # held-out, with the effects added
    remaining_gap_locations: tuple[GapLocation, ...]
    nominal_changes: tuple[NominalParameterChange, ...]  # when the accepted effects are added
    next_experiment: str
    held_out_names: tuple[str, ...]
    is_split_in_blocks: bool
    message: str  # why the data are insufficient; empty if they suffice
    thresholds: Thresholds
    stage_seconds: Mapping[str, float]
    baseline_comparison: EarlierRunsComparison | None = None
    counterfactual: ErrorsWithEffectsRemovedAndAdded | None = None
    summary: str = ""
    truncated_recordings: tuple[TruncatedHeldOutRecording, ...] = ()
    located_gap: GapLocalization | None = None
    record: EffectSearchRecord = field(default_factory=EffectSearchRecord)
    events: EventSet = NO_EVENTS  # events compensated or excluded before the rest was judged
    untried: tuple[str, ...] = ()  # steps skipped because of `Thresholds.budget`, best first; empty if all were done
    search_seconds: float = 0.0  # duration until the end of the search for effects
    # stated time step, and the step used if the error of the stated one was part of the gap [s]
    stated_and_finer_time_step: tuple[float, float] | None = None
    law: GapLaw | None = None  # law of the gap, or of the gap that the effects leave

    def _summary(self) -> ReprLineAndTableRows:
        effects, closed = ", ".join(effect.label for effect in self.accepted_effects), self.gap_closure.fraction
        said = f"{100 * closed:.3g} % of the held-out gap closed" if effects and math.isfinite(closed) else ""
        rows = [("candidate", "parameters", "closure alone", "p")]
        for entry in _ranked_candidates(self, self)[:8]:
            values = {name: own for name, own in entry["parameters"].items() if own["value"] is not None}
            known = ", ".join(f"{name} = {own['value']:.3g} {own['unit']}" for name, own in values.items())
            alone = "" if entry["closure"] is None else f"{100 * entry['closure']:.3g} %"
            rows.append((f"{entry['kind']}@{entry['location']}", known, alone, f"{entry['p_value']:.2g}"))
        return ReprLineAndTableRows(", ".join(filter(None, (self.verdict.replace("_", " "), effects, said))), rows)

    @property
    def accepted_effects(self) -> tuple[EffectBase, ...]:
        """Effects of an `effect` or `confusable` verdict, in the order added; empty for other verdicts."""
        return tuple(entry.effect for entry in self.accepted_selections)

    @property
    def final_model(self) -> RefittedModel:
        """The model with all accepted effects, or the nominal model if there are none."""
        last = self.accepted_selections[-1].refitted_model if self.accepted_selections else self.nominal_model
        assert isinstance(last, RefittedModel)
        return last

    @property
    def worst_held_out_channel_by_unit(self) -> dict[str, tuple[str, float]]:
        """By unit, the channel with the largest held-out error beyond noise in the final model, and that RMS."""
        noise = {own.channel: own.noise_rmse for own in self.noise_floor}
        found: dict[str, tuple[str, float]] = {}
        for channel, (error, unit) in self.final_model.held_out_loss.channel_rmse.items():
            size = math.sqrt(max(error**2 - noise.get(channel, 0.0) ** 2, 0.0))
            found[unit] = max(found.get(unit, ("", 0.0)), (channel, size), key=lambda own: own[1])
        return {unit: own for unit, own in found.items() if own[1] > 0}

    def to_dict(self) -> dict[str, Any]:
        """Convert the result to a JSON-compatible dictionary in the format `yid-diagnosis/2`."""
        smoothed, since, finer = self.smoother_result, self.baseline_comparison, self.stated_and_finer_time_step
        cuts = "recording kept=kept_duration whole=full_duration"
        carried = "effect=effect_label parameter value=estimation_value std=estimation_std again=held_out_value"
        carried += " again_std=held_out_std unit agrees=is_consistent"
        changes = "before=value_before after=value_after std=std_after unit"
        judged = judgement_to_dict(self, self, self.gap_locations)
        return {
            "format": _FORMAT,
            **judged,
            "gap": {
                **judged["gap"],
                "after": _state(self.final_model, self.remaining_test),
                "held_out": list(self.held_out_names),
                "finer_time_step": None if finer is None else finer[1],
                "cut": [object_attributes_to_json_dict(c, cuts) for c in self.truncated_recordings],
            },
            "remaining": {
                "p_value": self.remaining_test.p_value,
                "model_error": {
                    channel: {"rms": size, "unit": unit}
                    for unit, (channel, size) in self.worst_held_out_channel_by_unit.items()
                },
                "where": [object_attributes_to_json_dict(p, _PLACE) for p in self.remaining_gap_locations],
            },
            "reason": self.unknown_reason,
            "law": None if self.law is None else self.law.to_dict(),
            "rejected_candidates": _rejected_candidates(self),
            "carried_over": [object_attributes_to_json_dict(c, carried) for c in self.transfer_checks],
            "events": [event.to_dict() for event in self.events.disturbances],
            "not_judged": [
                object_attributes_to_json_dict(f, "recording joint from=start_time") for f in self.events.overspeeds
            ],
            "next_experiment": self.next_experiment,
            "side": None if smoothed is None else smoothed.plant_or_sensor_origin,
            "evidence": {} if smoothed is None else dict(smoothed.log_evidence),
            "explainable": None if smoothed is None else smoothed.explainable_gap_fraction,
            "statistics": diagnosis_decision_statistics(self),
            "summary": self.summary,
            "message": self.message,
            "held_out_in_blocks": self.is_split_in_blocks,
            "absorption": {a.name: object_attributes_to_json_dict(a, changes) for a in self.nominal_changes},
            "steps": [
                {
                    "added": entry.effect.label,
                    **_closure(entry.cumulative_closure),
                    "chi2_per_dof": entry.refitted_model.held_out_loss.chi2_per_sample,
                    "rmse": {n: e for n, (e, _) in entry.refitted_model.held_out_loss.channel_rmse.items()},
                }
                for entry in self.selected_effects
            ],
            "unseen": [v.effect.label for v in self.screening.detectability if not v.is_detectable],
            "noise": {
                f.channel: object_attributes_to_json_dict(f, "std=noise_std unit samples=n_samples")
                for f in self.noise_floor
            },
            "stopped": {"after": self.search_seconds, "next": list(self.untried)} if self.untried else None,
            "baseline": None if since is None else _baseline_to_json(since),
            "counterfactual": None if self.counterfactual is None else self.counterfactual.to_dict(),
            "seconds": dict(self.stage_seconds),
        }


def judgement_to_dict(judged: Judgement, seen: NominalModelGapEvidence, where: Sequence[GapLocation]) -> dict[str, Any]:
    """Convert the rule-based, scored part of a diagnosis to a JSON-compatible dictionary."""
    closed = judged.gap_closure if judged.accepted_selections else None
    rivals = [entry.equivalent_effects for entry in judged.accepted_selections if len(entry.equivalent_effects) > 1]
    return {
        "verdict": judged.verdict,
        "gap": {"before": _state(seen.nominal_model, seen.nominal_held_out_test), **_closure(closed)},
        "where": [object_attributes_to_json_dict(place, _PLACE) for place in where],
        "which": _ranked_candidates(judged, seen),
        "effects": [object_attributes_to_json_dict(entry.effect, _EFFECT) for entry in judged.accepted_selections],
        "confusable": [[object_attributes_to_json_dict(e, _EFFECT) for e in own] for own in rivals],
    }


def diagnosis_decision_statistics(result: DiagnosisResult) -> dict[str, Any]:
    """Statistics that are compared with `Thresholds`, as a JSON-compatible dictionary. Steps not reached are None.

    - `p_value`, `chi2_per_dof`: null test of the estimation and held-out residuals together
    - `largest_channel`: chi2/n of the channel with the largest chi2/n
    - `candidate`: Bonferroni-corrected p-value of the best candidate
    - `evidence`: rise of the log evidence by unknown forces, offsets and biases (None with process noise)
    - `closure`, `closure_low`: held-out gap closure of all selected effects, accepted or not, and its lower bound
    - `explained`: fraction of the smoother's decrease of r'r that the effects explain
    - `assumptions`: number of assumptions
    - `carried`: largest difference between estimation and held-out estimates [standard deviations]
    - `behind`: per single-effect refit, held-out chi2/n (`left`) and BIC difference to the first (`squares`)
    """
    tests = (result.nominal_test, result.nominal_held_out_test)
    added, seen, before = result.selected_effects, result.smoother_result, result.nominal_model
    differences = (entry.estimate_difference_and_std for entry in result.transfer_checks)
    apart, alone = [distance / std for distance, std in differences if std > 0], result.single_effect_models
    of_effects: dict[str, Any] = dict.fromkeys(("closure", "closure_low", "explained"))
    if added:
        own = (result.gap_closure.fraction, result.gap_closure.ci_low, result.explained_fraction)
        of_effects = dict(zip(of_effects, own, strict=True))
    found = {
        "p_value": bonferroni_corrected_min_test_p_value(tests),
        "chi2_per_dof": max(test.chi2_per_dof for test in tests),
        "largest_channel": max((value for test in tests for value in test.channel_chi2.values()), default=None),
        "candidate": min(1.0, bonferroni_corrected_min_candidate_p_value(result.screening.candidate_scores)),
        "evidence": None if seen is None or before.problem.has_process_noise else max(seen.log_evidence.values()),
        **of_effects,
        "assumptions": result.assumption_count,
        "carried": max(apart, default=None),
        "behind": {
            fit.effects[-1].label: {
                "left": fit.held_out_loss.chi2_per_sample,
                "squares": bic_difference(fit, alone[0]),
            }
            for fit in alone
        },
    }
    return {name: to_json_types(value) for name, value in found.items()}


_EFFECT = "kind location"
_PLACE = "location share=gap_share observable=is_observable windows=time_windows indistinguishable_from"


def _baseline_to_json(found: EarlierRunsComparison) -> dict[str, Any]:
    runs = "runs=baseline_runs explains=is_baseline_explained effects=baseline_effects chi2=between_runs_chi2"
    shift = "before=baseline_value before_std=baseline_std now=current_value now_std=current_std unit score=z_score"
    parameters = {
        e.name: object_attributes_to_json_dict(e, f"{shift} p_value changed=has_changed")
        for e in found.parameter_shifts
    }
    changed = [entry.name for entry in found.changed_parameters]
    known = object_attributes_to_json_dict(found, f"{runs} p_value=between_runs_p_value")
    return {**known, "parameters": parameters, "changed": changed}


def _state(fit: RefitStatistics, test: NullTestResult) -> dict[str, Any]:
    channels = fit.held_out_loss.channel_rmse
    return {
        "rmse": {name: value for name, (value, _) in channels.items()},
        "unit": {name: unit for name, (_, unit) in channels.items()},
        "chi2_per_dof": test.chi2_per_dof,
        "p_value": test.p_value,
    }


def _rejected_candidates(finding: DiagnosisResult) -> list[dict[str, Any]]:
    """Effects that imitate the gap but were rejected, each with its closure and the reason."""
    failed, listed = finding.failed_transfer_checks, []
    for entry in finding.selected_effects if finding.unknown_reason == "stand_in" else ():
        own = [check for check in failed if check.effect_label == entry.effect.label] or failed
        reason = "; ".join(check.both_estimates_text for check in own)
        closed = to_json_types(entry.cumulative_closure.fraction)
        listed.append({**object_attributes_to_json_dict(entry.effect, _EFFECT), "closure": closed, "reason": reason})
    return listed


def _closure(closed: GapClosure | None) -> dict[str, Any]:
    if closed is None:
        return {"closure": None, "closure_ci": None}
    return to_json_types({"closure": closed.fraction, "closure_ci": [closed.ci_low, closed.ci_high]})


def _ranked_candidates(judged: Judgement, seen: NominalModelGapEvidence) -> list[dict[str, Any]]:
    """All candidates: selected effects, then other refits by held-out loss, then the rest by score."""
    ranked, first = seen.screening.candidate_scores, judged.single_effect_models
    scores = {score.effect.label: score for score in ranked}
    alone = {fit.effects[0].label: fit for fit in first}
    entries: list[tuple[EffectBase, RefitStatistics | None]] = [
        *((entry.effect, judged.accepted_selections[-1].refitted_model) for entry in judged.accepted_selections),
        *((fit.effects[0], fit) for fit in first),
        *((score.effect, None) for score in ranked),
    ]
    listed: dict[str, dict[str, Any]] = {}
    for effect, fit in entries:
        if effect.label in listed:
            continue
        score, own = scores.get(effect.label), alone.get(effect.label)
        step = {} if score is None else score.predicted_values
        reported = effect.parameters_as_reported(step) if fit is None else fit.effect_parameters_as_reported(effect)
        before = seen.nominal_model.held_out_loss
        listed[effect.label] = {
            **object_attributes_to_json_dict(effect, _EFFECT),
            "parameters": {name: object_attributes_to_json_dict(r, "value std unit") for name, r in reported.items()},
            "score": 0.0 if score is None else score.lm_statistic,
            "p_value": 1.0 if score is None else score.p_value,
            **_closure(None if own is None else held_out_gap_closure(before, own.held_out_loss)),
        }
    return list(listed.values())

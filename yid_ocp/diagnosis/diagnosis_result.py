"""The result of a diagnosis as a dataclass, and in the format `yid-diagnosis/2`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from yid_ocp.diagnosis.baseline import CounterfactualPredictionErrors, ParameterShiftsSinceBaseline
from yid_ocp.diagnosis.events import NO_EVENTS, EventSet
from yid_ocp.diagnosis.gap_law import NonparametricLaw
from yid_ocp.diagnosis.hypotheses import HeldOutTruncation
from yid_ocp.diagnosis.refit import EffectSearchRecord, RefitStatistics, RefittedModel
from yid_ocp.diagnosis.screening import ScoreTestResult
from yid_ocp.diagnosis.select import bic_difference, total_gap_closure
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.diagnosis.verdict import Judgement, NominalModelGapEvidence
from yid_ocp.display import ReprMixin, ReprTexts, effect_entry_label
from yid_ocp.effects import EffectBase
from yid_ocp.files import attributes_to_dict, to_json_types
from yid_ocp.inference import null_test
from yid_ocp.inference.smoother import GapLocation, SmoothedUnknownsResult
from yid_ocp.problem.options import RefinementKind

_EFFECT_KEYS = "kind location"
_PLACE_KEYS = "location share=gap_share observable=is_observable windows=time_windows indistinguishable_from"


@dataclass(frozen=True, repr=False, kw_only=True)
class DiagnosisResult(ReprMixin, NominalModelGapEvidence, Judgement):
    """The result of a diagnosis: verdict, gap, locations and effects, with the statistics behind them.

    Values have the units of their parameters. `smoother_result` has means and standard deviations (J, nd) per recording
    of nd unknown forces [N m or N], offsets and biases [m] in J time intervals. `law` is the law of the gap, or of the
    part that effects leave. `events` are pushes and faults, compensated or excluded first. `next_steps` are texts.
    `untried` names steps skipped because of `Thresholds.budget`, best first. The two values of
    `stated_and_used_time_step` [s] differ if the stated step's error was part of the gap.
    """

    noise_floor: Mapping[str, float]  # rms error from noise alone by channel, in the channel's unit
    smoother_result: SmoothedUnknownsResult | None  # None if there is no gap to locate
    gap_locations: tuple[GapLocation, ...]
    nominal_model: RefittedModel
    remaining_test: null_test.NullTestResult  # held-out, with the effects added
    remaining_gap_locations: tuple[GapLocation, ...]
    is_split_in_blocks: bool
    thresholds: Thresholds
    stage_seconds: Mapping[str, float]  # duration of each stage [s]
    baseline_comparison: ParameterShiftsSinceBaseline | None = None
    counterfactual: CounterfactualPredictionErrors | None = None
    next_experiment: str = ""
    next_steps: tuple[str, ...] = ()  # what to do next, in order; the experiment comes last
    summary: str = ""
    truncated_recordings: tuple[HeldOutTruncation, ...] = ()
    record: EffectSearchRecord = field(default_factory=EffectSearchRecord)
    events: EventSet = NO_EVENTS
    untried: tuple[str, ...] = ()
    stated_and_used_time_step: tuple[float, float] = (0.0, 0.0)
    is_corrected_for_links: bool = False  # whether the data lack the error of the finite number of links
    errors_in_std: tuple[RefinementKind, ...] = ()  # of the discretisation, in the stds of the final model
    law: NonparametricLaw | None = None

    def _summary(self) -> ReprTexts:
        closed = total_gap_closure(self.accepted_selected_effects).text
        said = [self.verdict.replace("_", " "), *(e.label for e in self.accepted_effects), closed]
        rows = [("effect", "parameters", "removed error", "p-value")]
        for entry in judgement_to_dict(self, self, ())["which"][:8]:
            values = ((name, own["value"], own["unit"]) for name, own in entry["parameters"].items())
            known = ", ".join(f"{name} = {value:.3g} {unit}" for name, value, unit in values if value is not None)
            alone = "" if entry["closure"] is None else f"{100 * entry['closure']:.3g} %"
            rows.append((effect_entry_label(entry), known, alone, f"{entry['p_value']:.2g}"))
        return ReprTexts(", ".join(filter(None, said)), rows)

    @property
    def accepted_effects(self) -> tuple[EffectBase, ...]:
        """The effects that a verdict `effect` or `confusable` accepts, in the order added; none for other verdicts."""
        return tuple(entry.effect for entry in self.accepted_selected_effects)

    @property
    def final_model(self) -> RefittedModel:
        """The model with all accepted effects, or the nominal model if there are none."""
        last = [self.nominal_model, *(entry.refitted_model for entry in self.accepted_selected_effects)][-1]
        assert isinstance(last, RefittedModel)
        return last

    @property
    def nominal_parameters_before_and_after(self) -> dict[str, dict[str, Any]]:
        """The parameters of the nominal model before and after effects are added, with standard deviation and unit."""
        first, last, known = self.nominal_model, self.final_model, self.nominal_model.problem.system.parameters
        names, keys = first.problem.shared_parameters, ("before", "after", "std", "unit")
        values = ((first.values[name], last.values[name], last.std[name], known[name].unit) for name in names)
        return {name: dict(zip(keys, own, strict=True)) for name, own in zip(names, values, strict=True)}

    def to_dict(self) -> dict[str, Any]:
        """Convert the result to a JSON-compatible dictionary in the format `yid-diagnosis/2`."""
        judged = judgement_to_dict(self, self, self.gap_locations)
        after = _errors_to_dict(self.final_model) | attributes_to_dict(self.remaining_test, "chi2_per_dof p_value")
        left = [attributes_to_dict(place, _PLACE_KEYS) for place in self.remaining_gap_locations]
        problem = self.nominal_model.problem
        noise = {} if problem.has_process_noise else self.noise_floor
        reason = "; ".join(text for texts in self.undetermined_sizes(self.thresholds).values() for text in texts)
        held_out = [episode.name for episode in problem.held_out]
        optional = {"law": self.law, "baseline": self.baseline_comparison, "counterfactual": self.counterfactual}
        found = {
            "format": "yid-diagnosis/2",
            **judged,
            "gap": {**judged["gap"], "after": after, "held_out": held_out, "noise": noise},
            "remaining": {"p_value": after["p_value"], "where": left},
            "reason": self.unknown_reason,
            "rejected_candidates": [
                {**attributes_to_dict(e.effect, _EFFECT_KEYS), **e.cumulative_closure.to_dict(), "reason": reason}
                for e in self.selected_effects
                if self.unknown_reason == "stand_in"
            ],
            "events": [event.to_dict() for event in self.events.disturbances],
            "next_experiment": self.next_experiment,
            "next_steps": self.next_steps,
            "rival_changes": {
                "probability": self.rival_probability,
                "parameters": {shift.name: shift.to_dict() for shift in self.rival_shifts},
            },
            "statistics": diagnosis_decision_statistics(self),
            "summary": self.summary,
            "absorption": self.nominal_parameters_before_and_after,
            "steps": [{"added": e.effect.label, **_errors_to_dict(e.refitted_model)} for e in self.selected_effects],
            "unseen": self.screening.undetectable_labels,
            "untried": self.untried,
            **{name: part and part.to_dict() for name, part in optional.items()},
            "seconds": self.stage_seconds,
        }
        return dict(to_json_types(found))


def diagnosis_decision_statistics(result: DiagnosisResult) -> dict[str, Any]:
    """Return the statistics that are compared with `Thresholds`. None: not known."""
    tests, alone = (result.nominal_test, result.nominal_held_out_test), result.single_effect_models
    smoothed = None if result.nominal_model.problem.has_process_noise else result.smoother_result
    return {
        "p_value": null_test.bonferroni_corrected_min_p_value([test.p_value for test in tests]),
        "chi2_per_dof": max(test.chi2_per_dof for test in tests),
        "candidate": null_test.bonferroni_corrected_min_p_value([s.p_value for s in result.screening.candidate_scores]),
        "evidence": None if smoothed is None else max(smoothed.log_evidence.values()),
        "explained_fraction": result.explained_fraction,
        "single_effects": {
            fit.effects[-1].label: {
                "held_out_chi2_per_sample": fit.held_out_loss.chi2_per_sample,
                "bic_difference": bic_difference(fit, alone[0]),
            }
            for fit in alone
        },
    }


def judgement_to_dict(judged: Judgement, seen: NominalModelGapEvidence, where: Sequence[GapLocation]) -> dict[str, Any]:
    """Convert the verdict of a diagnosis and the evidence for it to a JSON-compatible dictionary."""
    added = judged.accepted_selected_effects
    test = attributes_to_dict(seen.nominal_held_out_test, "chi2_per_dof p_value")
    before = _errors_to_dict(seen.nominal_model) | test
    rivals = [entry.equivalent_effects for entry in added if len(entry.equivalent_effects) > 1]
    found = {
        "verdict": judged.verdict,
        "probability": judged.probability,
        "gap": {"before": before, **total_gap_closure(added).to_dict()},
        "where": [attributes_to_dict(place, _PLACE_KEYS) for place in where],
        "which": _ranked_candidates(judged, seen),
        "effects": [attributes_to_dict(entry.effect, _EFFECT_KEYS) for entry in added],
        "confusable": [[attributes_to_dict(effect, _EFFECT_KEYS) for effect in own] for own in rivals],
    }
    return dict(to_json_types(found))


def _errors_to_dict(fit: RefitStatistics) -> dict[str, Any]:
    """Held-out errors of a fit and their units, by channel."""
    channels = fit.held_out_loss.channel_rmse.items()
    return {"rmse": {name: rmse for name, (rmse, _) in channels}, "unit": {name: unit for name, (_, unit) in channels}}


def _ranked_candidates(judged: Judgement, seen: NominalModelGapEvidence) -> list[dict[str, Any]]:
    """All candidates: accepted effects, then other refits by held-out loss, then the rest by p-value."""
    added, alone = judged.accepted_selected_effects, judged.single_effect_models
    before = seen.nominal_model.held_out_loss
    closures = {fit.effects[0].label: null_test.held_out_gap_closure(before, fit.held_out_loss) for fit in alone}
    scores = {score.effect.label: score for score in seen.screening.candidate_scores}
    tried = sorted(scores.values(), key=lambda score: score.p_value)
    shares = {label: share for entry in judged.selected_effects for label, share in entry.shares.items()}
    fitted = [*((e.effect, added[-1].refitted_model) for e in added), *((fit.effects[0], fit) for fit in alone)]
    found = [(effect, effect.to_reported_parameters(fit.values, fit.std)) for effect, fit in fitted]
    found += [(s.effect, s.effect.to_reported_parameters(s.predicted_values)) for s in tried]
    listed: dict[str, dict[str, Any]] = {}
    for effect, reported in found:
        score = scores.get(effect.label, ScoreTestResult(effect, {}, 0.0, 0.0, 1.0))
        entry = {
            **attributes_to_dict(effect, _EFFECT_KEYS),
            "parameters": {name: attributes_to_dict(own, "value std unit") for name, own in reported.items()},
            **attributes_to_dict(score, "score=lm_statistic p_value"),
            "probability": judged.probability * shares.get(effect.label, 0.0),
            **closures.get(effect.label, null_test.UNDEFINED_GAP_CLOSURE).to_dict(),
        }
        listed.setdefault(effect.label, entry)
    return list(listed.values())

"""The result of a diagnosis: a dataclass, `yid-diagnosis/2`, and what is said of it and of the next experiment."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from yid_ocp.diagnosis.baseline import EarlierRunsComparison, ErrorsWithEffectsRemovedAndAdded
from yid_ocp.diagnosis.events import NO_EVENTS, EventSet, ForceOrFaultEvent
from yid_ocp.diagnosis.hypotheses import TruncatedHeldOutRecording
from yid_ocp.diagnosis.localise import GapLocation, main_gap_locations
from yid_ocp.diagnosis.refit import RefittedModel
from yid_ocp.diagnosis.screening import (
    CandidateScore,
    ConfusabilityMatrix,
    DetectableAmplitudes,
    bonferroni_min_p_value,
)
from yid_ocp.diagnosis.select import (
    GapClosure,
    SelectedEffect,
    held_out_gap_closure,
    held_out_improvement,
    largest_relative_rmse_reduction,
    penalized_chi2_difference,
)
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.diagnosis.verdict import (
    EffectAmplitudeTransferCheck,
    UnknownVerdictReason,
    failed_transfer_checks,
    independent_assumption_count,
    required_fraction_of_smoother_chi2_decrease,
)
from yid_ocp.display import ReprLineAndTableRows, ReprMixin
from yid_ocp.effects import EffectBase
from yid_ocp.effects.base import ORDERED_EXCITATION_DESCRIPTIONS
from yid_ocp.files import object_attributes_to_json_dict, to_json_types
from yid_ocp.inference.null_test import (
    AssumedChannelNoiseLevel,
    NullTestResult,
    min_bonferroni_p_value,
    residuals_exceed_noise,
)
from yid_ocp.inference.smoother import SmoothedUnknownsResult

_FORMAT = "yid-diagnosis/2"


@dataclass(frozen=True)
class NominalParameterChange:
    """Change of one nominal parameter: value in the nominal model and in the model with the accepted effects."""

    name: str
    unit: str
    value_before: float
    value_after: float
    std_after: float


@dataclass(frozen=True, repr=False)
class DiagnosisResult(ReprMixin):
    """Result of a diagnosis: verdict, gap, locations, effects and the statistics on which they are based."""

    verdict: str  # effect, confusable, no_gap, unknown or insufficient_data
    noise_floor: tuple[AssumedChannelNoiseLevel, ...]
    nominal_test: NullTestResult  # on the recordings to estimate on
    nominal_held_out_test: NullTestResult
    detectability: tuple[DetectableAmplitudes, ...]
    confusability: ConfusabilityMatrix
    candidate_scores: tuple[CandidateScore, ...]  # first pass, best first
    smoother_result: SmoothedUnknownsResult | None  # about the nominal model; None where there is no gap to locate
    gap_locations: tuple[GapLocation, ...]
    nominal_model: RefittedModel
    single_effect_models: tuple[RefittedModel, ...]  # of the first round, best first
    selected_effects: tuple[SelectedEffect, ...]
    gap_closure: GapClosure
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
    unknown_reason: UnknownVerdictReason = ""
    explained_fraction: float = 1.0  # what the effects explain over what the smoother explains
    transfer_checks: tuple[EffectAmplitudeTransferCheck, ...] = ()
    events: EventSet = NO_EVENTS  # taken out of the recordings before the rest was judged, as far as that can be done
    untried: tuple[str, ...] = ()  # what `Thresholds.budget` left no time for, best first; empty where all was done
    search_seconds: float = 0.0  # from the start to the end of the search for effects

    def _summary(self) -> ReprLineAndTableRows:
        effects, closed = ", ".join(effect.label for effect in self.accepted_effects), self.gap_closure.fraction
        said = f"{100 * closed:.3g} % of the held-out gap closed" if effects and math.isfinite(closed) else ""
        rows = [("candidate", "parameters", "closure alone", "p")]
        for entry in _ranked_candidates(self)[:8]:
            values = {name: own for name, own in entry["parameters"].items() if own["value"] is not None}
            known = ", ".join(f"{name} = {own['value']:.3g} {own['unit']}" for name, own in values.items())
            alone = "" if entry["closure"] is None else f"{100 * entry['closure']:.3g} %"
            rows.append((f"{entry['kind']}@{entry['location']}", known, alone, f"{entry['p_value']:.2g}"))
        return ReprLineAndTableRows(", ".join(filter(None, (self.verdict.replace("_", " "), effects, said))), rows)

    @property
    def accepted_effects(self) -> tuple[EffectBase, ...]:
        """Effects of an `effect` or `confusable` verdict, in the order they were added; empty for other verdicts."""
        named = self.verdict in ("effect", "confusable")
        return tuple(entry.effect for entry in self.selected_effects) if named else ()

    @property
    def final_model(self) -> RefittedModel:
        """The model with all accepted effects; the nominal model if there are none."""
        return self.selected_effects[-1].refitted_model if self.accepted_effects else self.nominal_model

    @property
    def model_error_by_unit(self) -> dict[str, tuple[str, float]]:
        """Channel with the largest held-out error that the final model leaves beyond noise, and its RMS, by unit."""
        noise = {own.channel: own.noise_rmse for own in self.noise_floor}
        found: dict[str, tuple[str, float]] = {}
        for channel, (error, unit) in self.final_model.held_out_loss.channel_rmse.items():
            size = math.sqrt(max(error**2 - noise.get(channel, 0.0) ** 2, 0.0))
            found[unit] = max(found.get(unit, ("", 0.0)), (channel, size), key=lambda own: own[1])
        return {unit: own for unit, own in found.items() if own[1] > 0}

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a JSON-compatible dictionary in the format `yid-diagnosis/2`."""
        smoothed, accepted, since = self.smoother_result, self.accepted_effects, self.baseline_comparison
        cuts = "recording kept=kept_duration whole=full_duration"
        carried = "effect=effect_label parameter value=estimation_value std=estimation_std again=held_out_value"
        carried += " again_std=held_out_std unit agrees=is_consistent"
        changes = "before=value_before after=value_after std=std_after unit"
        rivals = [entry.equivalent_effects for entry in self.selected_effects if len(entry.equivalent_effects) > 1]
        closed = self.gap_closure if accepted else None
        return {
            "format": _FORMAT,
            "verdict": self.verdict,
            "gap": {
                "before": _state(self.nominal_model, self.nominal_held_out_test),
                "after": _state(self.final_model, self.remaining_test),
                **_closure(closed),
                "held_out": list(self.held_out_names),
                "cut": [object_attributes_to_json_dict(c, cuts) for c in self.truncated_recordings],
            },
            "where": [object_attributes_to_json_dict(p, _PLACE) for p in self.gap_locations],
            "which": _ranked_candidates(self),
            "effects": [object_attributes_to_json_dict(e, _EFFECT) for e in accepted],
            "remaining": {
                "p_value": self.remaining_test.p_value,
                "model_error": {
                    channel: {"rms": size, "unit": unit} for unit, (channel, size) in self.model_error_by_unit.items()
                },
                "where": [object_attributes_to_json_dict(p, _PLACE) for p in self.remaining_gap_locations],
            },
            "reason": self.unknown_reason,
            "rejected_candidates": _rejected_candidates(self),
            "carried_over": [object_attributes_to_json_dict(c, carried) for c in self.transfer_checks],
            "confusable": [[object_attributes_to_json_dict(e, _EFFECT) for e in own] for own in rivals if accepted],
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
            "unseen": [v.effect.label for v in self.detectability if not v.is_detectable],
            "noise": {
                f.channel: object_attributes_to_json_dict(f, "std=noise_std unit samples=n_samples")
                for f in self.noise_floor
            },
            "stopped": {"after": self.search_seconds, "next": list(self.untried)} if self.untried else None,
            "baseline": None if since is None else _baseline_to_json(since),
            "counterfactual": None if self.counterfactual is None else self.counterfactual.to_dict(),
            "seconds": dict(self.stage_seconds),
        }


def diagnosis_decision_statistics(finding: DiagnosisResult) -> dict[str, Any]:
    """Return the statistics that are compared with `Thresholds` as a JSON-compatible dictionary, for calibration.

    `p_value` and `chi2_per_dof` of the null test (of both residuals together), `largest_channel` (chi2/n of the worst
    channel), `candidate` (p-value of the best, as the best of so many), `evidence` (rise of the log evidence by unknown
    forces, offsets and biases; not where noise drives the motion), `closure` and `closure_low` (held out, of all that
    was added, accepted or not), `fall` (part of the held-out error that they take away), `explained` (over what the
    smoother explains), `assumptions` (how many), `carried` (standard deviations between the values found and those on
    the held-out recordings, at most), `behind` (of every effect refitted alone, the held-out chi2/n that it leaves and
    how far it is behind the first: in held-out chi2/n with its standard error, and in r'r of all recordings). None
    where a step was not come to.
    """
    tests = (finding.nominal_test, finding.nominal_held_out_test)
    added, seen, before = finding.selected_effects, finding.smoother_result, finding.nominal_model
    differences = (entry.estimate_difference_and_std for entry in finding.transfer_checks)
    apart, alone = [distance / std for distance, std in differences if std > 0], finding.single_effect_models
    of_effects: dict[str, Any] = dict.fromkeys(("closure", "closure_low", "fall", "explained"))
    if added:
        fall = largest_relative_rmse_reduction(before.held_out_loss, added[-1].refitted_model.held_out_loss)
        own = (finding.gap_closure.fraction, finding.gap_closure.ci_low, fall, finding.explained_fraction)
        of_effects = dict(zip(of_effects, own, strict=True))
    found = {
        "p_value": min_bonferroni_p_value(tests),
        "chi2_per_dof": max(test.chi2_per_dof for test in tests),
        "largest_channel": max((value for test in tests for value in test.channel_chi2.values()), default=None),
        "candidate": min(1.0, bonferroni_min_p_value(finding.candidate_scores)),
        "evidence": None if seen is None or before.problem.has_process_noise else max(seen.log_evidence.values()),
        **of_effects,
        "assumptions": independent_assumption_count(added),
        "carried": max(apart, default=None),
        "behind": {fit.effects[-1].label: _behind(fit, alone[0]) for fit in alone},
    }
    return {name: to_json_types(value) for name, value in found.items()}


def _behind(fit: RefittedModel, first: RefittedModel) -> dict[str, float]:
    """How much worse a refit is than the first."""
    lost, error = held_out_improvement(fit.held_out_loss, first.held_out_loss)
    left, squares = fit.held_out_loss.chi2_per_sample, penalized_chi2_difference(fit, first)
    return {"left": left, "chi2_per_dof": lost, "error": error, "squares": squares}


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


def _state(fit: RefittedModel, test: NullTestResult) -> dict[str, Any]:
    channels = fit.held_out_loss.channel_rmse
    return {
        "rmse": {name: value for name, (value, _) in channels.items()},
        "unit": {name: unit for name, (_, unit) in channels.items()},
        "chi2_per_dof": test.chi2_per_dof,
        "p_value": test.p_value,
    }


def _rejected_candidates(finding: DiagnosisResult) -> list[dict[str, Any]]:
    """Effects that imitate the gap and are not its cause, each with the closure that it reaches and why it is none."""
    failed, listed = failed_transfer_checks(finding.transfer_checks), []
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


def _ranked_candidates(finding: DiagnosisResult) -> list[dict[str, Any]]:
    """All candidates ranked: added effects, then other refits by held-out loss, then the rest by score."""
    scores = {score.effect.label: score for score in finding.candidate_scores}
    alone = {fit.effects[0].label: fit for fit in finding.single_effect_models}
    entries: list[tuple[EffectBase, RefittedModel | None]] = [
        *((effect, finding.final_model) for effect in finding.accepted_effects),
        *((fit.effects[0], fit) for fit in finding.single_effect_models),
        *((score.effect, None) for score in finding.candidate_scores),
    ]
    listed: dict[str, dict[str, Any]] = {}
    for effect, fit in entries:
        if effect.label in listed:
            continue
        score, own = scores.get(effect.label), alone.get(effect.label)
        step = {} if score is None else score.predicted_values
        reported = effect.parameters_as_reported(step) if fit is None else fit.effect_parameters_as_reported(effect)
        before = finding.nominal_model.held_out_loss
        listed[effect.label] = {
            **object_attributes_to_json_dict(effect, _EFFECT),
            "parameters": {name: object_attributes_to_json_dict(r, "value std unit") for name, r in reported.items()},
            "score": 0.0 if score is None else score.lm_statistic,
            "p_value": 1.0 if score is None else score.p_value,
            **_closure(None if own is None else held_out_gap_closure(before, own.held_out_loss)),
        }
    return list(listed.values())


# -- what is said of it ------------------------------------------------------------------------------------------------

_MIN_RELATIVE_CHANGE = 0.1  # relative change from which a nominal parameter is named
_PRIOR_RANGE_TOLERANCE = 0.25  # part of its range by which an amplitude may leave it unnoticed
_GAP_ORIGIN_PHRASES = {
    "plant": ", in the mechanics rather than in what sensors read",
    "sensor": ", in what sensors read",
    "either": ", in the mechanics or in what the effort sensor reads, which efforts alone do not tell apart",
}
_RUNS_DIFFER_LEVEL = 0.01  # significance below which several runs of a baseline differ
_MAX_EVENTS_LISTED = 8  # maximum number of events listed one by one
_IMMOVABLE_LOCATIONS = ("world", "clock", "camera", "object", "base")  # locations that cannot be moved by themselves
_NEXT_EXPERIMENT_TEXTS = {
    "insufficient_data": "Record longer and larger motions; more of the object has to be seen.",
    "separate": "Vary {aspects} independently of each other, over a wide range, in one recording.",
    "places": "Move so that {places} work one at a time, or measure a point between them.",
    "vary": "Vary {aspects} over a wider range.",
    "other": "Record other motions, faster and larger.",
    "unknown": "Move {place} alone, slowly and fast, and hold it still in several postures.",
    "unseen": "None is needed; these motions could not have shown {unseen}.",
    "no_gap": "None is needed.",
    "effect": "Repeat with other motions to see whether the effect's parameters stay.",
}
"""Texts of the recommended next experiment, by situation."""
_UNKNOWN_REASON_TEXTS = {
    "nothing": "{no} explains it.",
    "none": "{no} explains it (the best, {best}, is not sure to be there and to close a part).",
    "unsure": "{names} close{s} {closure:.3g} % of it, but not surely: at least {low:.3g} %, where {least:.3g} % are "
    "asked.",
    "little": "{names} explain{s} {explained:.3g} % of what unknown forces, offsets and biases explain, and {sure}; "
    "{enough:.3g} % {asked}.",
    "stand_in": "{names} imitate{s} it ({closing}) and {are} not its cause: {apart}.",
    "no held-out gap": "{names} may explain it, but {sure}.",
}
"""Sentences on why the verdict is unknown, by `verdict.UnknownVerdictReason`."""


def _separating_experiment(rivals: Sequence[EffectBase]) -> str:
    """The experiment that separates indistinguishable effects, from what their equations depend on."""
    said = dict.fromkeys(effect.required_excitation for effect in rivals if effect.required_excitation)
    known = [aspect for aspect in ORDERED_EXCITATION_DESCRIPTIONS if aspect in said]
    aspects = [*known, *(aspect for aspect in said if aspect not in known)]
    places = list(dict.fromkeys(effect.location for effect in rivals))
    case = "separate" if len(aspects) > 1 else "places" if len(places) > 1 else "vary" if aspects else "other"
    return _NEXT_EXPERIMENT_TEXTS[case].format(aspects=" and ".join(aspects), places=" and ".join(places))


def recommended_experiment_text(
    verdict: str, added: Sequence[SelectedEffect], where: Sequence[GapLocation], seen: Sequence[DetectableAmplitudes]
) -> str:
    """Return a sentence that recommends the next recording, from verdict, gap location and confusable effects."""
    rivals = next((entry.equivalent_effects for entry in added if len(entry.equivalent_effects) > 1), ())
    if rivals and verdict != "insufficient_data":
        return _separating_experiment(rivals)
    unseen = [entry.effect.label for entry in seen if not entry.is_detectable]
    place = where[0].location if where and where[0].gap_share > 0 else ""
    case = verdict if verdict in _NEXT_EXPERIMENT_TEXTS else "effect"
    if verdict == "unknown" and place in ("", *_IMMOVABLE_LOCATIONS):
        case = "other"
    if verdict == "no_gap" and unseen:
        case = "unseen"
    listed = ", ".join(unseen[:4]) + (", ..." if len(unseen) > 4 else "")
    return _NEXT_EXPERIMENT_TEXTS[case].format(place=place, unseen=listed)


def insufficient_data_message(
    verdict: str, before: NullTestResult, unknowns: int, seen: Sequence[DetectableAmplitudes], limits: Thresholds
) -> str:
    """Return a message why the data are insufficient; the empty string if they suffice."""
    if verdict != "insufficient_data":
        return ""
    if not any(entry.is_detectable for entry in seen):
        return "no candidate of the size that one would expect would show in these recordings."
    needed = f"at least {limits.min_samples_per_unknown * unknowns:.0f} are needed"
    said = f"{before.degrees_of_freedom:.0f} effective samples for {unknowns} unknowns, {needed}"
    return f"{said}; record longer or free fewer parameters."


def held_out_truncation_message(cut: TruncatedHeldOutRecording) -> str:
    """Return a sentence on how far the nominal model follows a truncated held-out recording."""
    if cut.kept_duration == 0:
        return f"The nominal model cannot follow {cut.recording} at all, which is left out."
    part = f"{cut.kept_duration:.3g} of {cut.full_duration:.3g} s"
    return f"The nominal model follows {cut.recording} for {part} only; the rest is left out."


def diagnosis_summary_text(finding: DiagnosisResult) -> str:
    """Return a text that summarises a diagnosis: gap, locations, effects, events and the next experiment."""
    text = [_gap(finding)]
    if finding.verdict not in ("insufficient_data", "no_gap"):
        text.append(_places(finding))
    if finding.accepted_effects:
        text += _effects(finding)
    elif finding.verdict == "unknown":
        tests = (finding.nominal_test, finding.nominal_held_out_test)
        exceeds = residuals_exceed_noise(tests, finding.thresholds.null_test_limits)
        size = _model_error(finding) if exceeds else ""
        text += [_nameless(finding), f"What remains is model error{size}." if size else ""]
    if finding.untried:
        rest = ", ".join(finding.untried[:8]) + (", ..." if len(finding.untried) > 8 else "")
        text.append(f"The search stopped after {finding.search_seconds:.3g} s; it would go on with {rest}.")
    text += [held_out_truncation_message(cut) for cut in finding.truncated_recordings]
    if finding.baseline_comparison is not None:
        text += _since(finding.baseline_comparison, bool(finding.accepted_effects))
    if finding.counterfactual is not None:
        text += _counterfactual(finding.counterfactual)
    if finding.is_split_in_blocks:
        cut, whole = "No held-out recording is left", "Only one set of recordings was given"
        why = cut if finding.truncated_recordings else whole
        text.append(f"{why}: alternate blocks of what is estimated on were held out.")
    text += [_event_sentences(finding.events), f"Next experiment: {finding.next_experiment}"]
    return " ".join(filter(None, text))


def _gap(finding: DiagnosisResult) -> str:
    """Whether there is one."""
    held, first = finding.nominal_held_out_test, finding.nominal_test
    p, limits = min(first.p_value, held.p_value), finding.thresholds
    fitted, other = (f"{x:.3g}" if math.isfinite(x) else "not known" for x in (first.chi2_per_dof, held.chi2_per_dof))
    sizes = f"chi2 per degree of freedom {fitted}, held out {other}"
    if finding.verdict == "insufficient_data":
        return f"The data do not suffice: {finding.message}"
    if finding.verdict == "no_gap":
        return f"There is no gap to speak of ({sizes}; p = {p:.2g})."
    best = min(finding.candidate_scores, key=lambda score: score.p_value, default=None)
    if residuals_exceed_noise((first, held), limits.null_test_limits) or best is None:
        return f"The gap is real ({sizes}; p {_p_value_relation(p)})."
    small = _p_value_relation(min(1.0, best.p_value * len(finding.candidate_scores)))
    said = f"As a whole the recordings are explained to within their noise ({sizes})"
    return f"{said}, but not along what {best.effect.label} would do (p {small})."


def _p_value_relation(p_value: float) -> str:
    return f"= {p_value:.2g}" if p_value > 1e-12 else "< 1e-12"


def _places(finding: DiagnosisResult) -> str:
    """Where it lies, places that the data cannot tell apart together; empty where nothing says so."""
    where = main_gap_locations(finding.gap_locations)
    shares = [(" or ".join([p.location, *p.indistinguishable_from]), round(100 * p.gap_share)) for p in where]
    named = " and ".join(f"{place} ({percent} %)" for place, percent in shares if percent)
    side = (
        ""
        if finding.smoother_result is None
        else _GAP_ORIGIN_PHRASES.get(finding.smoother_result.plant_or_sensor_origin, "")
    )
    silent = "These data do not tell where it lies." if shares else ""
    return f"It lies in {named}{side}." if named else silent


def _nameless(finding: DiagnosisResult) -> str:
    """Why no effect is named, with the numbers that say so."""
    added, tried, reason = finding.selected_effects, finding.single_effect_models, finding.unknown_reason
    apart = [entry.both_estimates_text for entry in failed_transfer_checks(finding.transfer_checks)]
    count, closed = independent_assumption_count(added), finding.gap_closure
    is_closure_known = math.isfinite(closed.fraction) and math.isfinite(closed.ci_low)
    none = "held-out motions have no gap to close"
    sure = f"surely close{'s' if len(added) == 1 else ''} {100 * closed.ci_low:.3g} % on held-out motions"
    case = "no held-out gap" if reason == "unsure" and not is_closure_known else reason
    return _UNKNOWN_REASON_TEXTS[case if case != "none" or tried else "nothing"].format(
        sure=sure if is_closure_known else none,
        closing=f"closing {100 * closed.fraction:.3g} % on held-out motions" if is_closure_known else none,
        best=tried[0].effects[0].label if tried else "",
        names=" and ".join(entry.effect.label for entry in added),
        s="s" if len(added) == 1 else "",
        are="is" if len(added) == 1 else "are",
        closure=100 * finding.gap_closure.fraction,
        low=100 * finding.gap_closure.ci_low,
        least=100 * finding.thresholds.min_gap_closed,
        explained=100 * finding.explained_fraction,
        asked=f"of the former are asked of {count} assumptions" if count > 1 else "of either are asked",
        enough=100 * required_fraction_of_smoother_chi2_decrease(added, finding.thresholds),
        apart="; ".join(apart[:2]),
        no="No effect tried so far" if finding.untried else "No known effect",
    )


def _effects(finding: DiagnosisResult) -> list[str]:
    """What was added, what it closes, what it cannot be told from, and what remains."""
    last, total, rest = finding.final_model, finding.gap_closure, finding.remaining_test
    names = "; ".join(f"{e.label} with {_figures(e, last)}" for e in finding.accepted_effects)
    verb = "closes" if len(finding.accepted_effects) == 1 else "together close"
    odds = math.exp(finding.thresholds.min_log_bayes_factor)
    text = [
        f"{names} {verb} {100 * total.fraction:.3g} % of it on held-out motions "
        f"(95 % interval {100 * total.ci_low:.3g} to {100 * total.ci_high:.3g} %)."
        if total.ci_low > finding.thresholds.min_gap_closed
        else f"With {names} the held-out motions are far more likely (more than {odds:.0f} times), although so little "
        "of chi2 tells of it that no part of the gap can be given."
    ]
    for entry in finding.selected_effects:
        others = [r.label for r in entry.equivalent_effects if r.label != entry.effect.label]
        text += [f"Not separable from {entry.effect.label}: {', '.join(others)}."] if others else []
    odd = [said for effect in finding.accepted_effects for said in _out_of_range(effect, last)]
    if odd:
        text.append(f"Beyond what one would expect, and so perhaps standing in for something else: {', '.join(odd)}.")
    if rest.chi2_per_dof > 1 and rest.p_value < finding.thresholds.significance_level:
        mostly = "".join(f", most of it in {place.location}" for place in finding.remaining_gap_locations[:1])
        size = f"held-out chi2 per degree of freedom {rest.chi2_per_dof:.3g}"
        text.append(f"What remains is model error{_model_error(finding)} ({size}{mostly}).")
    else:
        text.append("What remains is noise.")
    moved = [
        f"{a.name} goes from {a.value_before:.3g} to {a.value_after:.3g}"
        for a in finding.nominal_changes
        if abs(a.value_after - a.value_before) > _MIN_RELATIVE_CHANGE * max(abs(a.value_before), 1e-9)
    ]
    return [*text, f"With it {', '.join(moved[:6])}."] if moved else text


def _model_error(finding: DiagnosisResult) -> str:
    sizes = finding.model_error_by_unit.items()
    said = " and ".join(f"{size:.2g} {unit} (rms) at {channel}" for unit, (channel, size) in sizes)
    return f" of {said}" if said else ""


def _figures(effect: EffectBase, fit: RefittedModel) -> str:
    text = []
    for name, r in fit.effect_parameters_as_reported(effect).items():
        known = f"= {r.value:.3g} ± {r.std:.2g} {r.unit}".strip().removesuffix(" 1")
        text.append(f"{name} {known if math.isfinite(r.std) else 'unknown'}")
    return ", ".join(text)


def _out_of_range(effect: EffectBase, fit: RefittedModel) -> list[str]:
    """Amplitudes beyond the range that an engineer would expect."""
    found = []
    for name in effect.amplitude_names:
        (low, high), value = effect.prior_ranges[name], fit.values[name]
        room = _PRIOR_RANGE_TOLERANCE * (high - low)
        if not low - room <= value <= high + room and effect.neutral_values[name] != value:
            found.append(f"{name} = {value:.3g} (range {low:.3g} to {high:.3g})")
    return found


def _since(found: EarlierRunsComparison, effects: bool) -> list[str]:
    """What has moved since the baseline, and what a baseline that explained little is worth."""
    several, p_value = len(found.baseline_runs), found.between_runs_p_value
    moved = [
        f"{e.name} is {e.current_value:.3g} ± {e.current_std:.2g} {e.unit} where it was "
        f"{e.baseline_value:.3g} ± {e.baseline_std:.2g}"
        for e in found.changed_parameters[:4]
    ]
    seen = any(entry.z_score is not None for entry in found.parameter_shifts)
    none = "no parameter has changed" if seen else "these recordings say nothing of the parameters"
    what = f"{'even with that ' if effects else ''}{', '.join(moved)}" if moved else none
    text = [f"Against the baseline{f' of {several} runs' if several > 1 else ''}, {what}."]
    if several > 1 and p_value < _RUNS_DIFFER_LEVEL:
        text.append(f"The runs of the baseline differ among themselves (p = {p_value:.2g}); their ± is wider for it.")
    if not found.is_baseline_explained:
        what = "The model did not explain the baseline's recordings"
        text.append(f"{what}, so its ± counts that misfit and may be too small.")
    return text


_COUNTERFACTUAL_TEXTS = (
    ("Taken away again, it predicts", "made without it", "as it was fitted without a diagnosis"),
    ("Added to what was known without it, it predicts", "made with it", "without it"),
)
"""Beginning, how the recordings were made, and what the prediction is compared with: effects removed, and added."""


def _counterfactual(found: ErrorsWithEffectsRemovedAndAdded) -> list[str]:
    """Whether taking the effects away predicts the world without them, and adding them the world with them."""
    text = []
    both = (found.effects_removed, found.effects_added)
    for part, (begin, made, rival) in zip(both, _COUNTERFACTUAL_TEXTS, strict=True):
        if part.failure_message:
            text.append(f"What was {made} could not be predicted ({part.failure_message}).")
            continue
        names = " and ".join(name.removesuffix(" (without)") for name in part.recordings[:2])
        names += " and others" if len(part.recordings) > 2 else ""
        plain, errors = (", ".join(f"{pair[i]:.2g} {unit}" for unit, pair in part.rmse_by_unit.items()) for i in (0, 1))
        text.append(f"{begin} {names}, {made}, to {errors} (rms), where the model {rival} has {plain}.")
        if not part.is_improved_by_counterfactual:
            text.append("That is no better, so it may stand in for something else.")
    return text


def _event_sentences(events: EventSet) -> str:
    """The sentences on all events: what, where, when; empty if there are none."""
    text, count = [], len(events.disturbances)
    if count:
        told = "; ".join(_said(event) for event in events.disturbances[:_MAX_EVENTS_LISTED])
        more = f"; and {count - _MAX_EVENTS_LISTED} more" if count > _MAX_EVENTS_LISTED else ""
        first = "One event stands" if count == 1 else f"{count} events stand"
        text.append(f"{first} beside all this, short and in one place: {told}{more}.")
    return " ".join([*text, *ignored_after_overspeed_messages(events)])


def ignored_after_overspeed_messages(events: EventSet) -> list[str]:
    """Return a sentence for each recording whose end is ignored because a joint exceeds `max_joint_speed`."""
    said, why = "s on nothing is judged in", "moves too fast for the model to follow."
    return [f"From {e.start_time:.3g} {said} {e.recording}, where {e.joint} {why}" for e in events.overspeeds]


def _said(event: ForceOrFaultEvent) -> str:
    if event.kind == "sample":
        when = f"at {0.5 * (event.start_time + event.end_time):.3f} s in {event.recording}"
        return f"{event.channel} is off by {event.peak_value:+.3g} {event.unit} {when}"
    return (
        f"{event.channel} is pushed by up to {event.peak_value:+.2g} {event.unit} "
        f"from {event.start_time:.2f} to {event.end_time:.2f} s in {event.recording} "
        f"({event.impulse:+.2g} ± {event.impulse_std:.1g} {event.unit} s)"
    )

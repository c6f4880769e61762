"""Write sentences on a diagnosis and the next experiment."""

from __future__ import annotations

import math
from collections.abc import Sequence

from yid_ocp.diagnosis.baseline import EarlierRunsComparison, ErrorsWithEffectsRemovedAndAdded
from yid_ocp.diagnosis.diagnosis_result import DiagnosisResult
from yid_ocp.diagnosis.events import EventSet, ForceOrFaultEvent
from yid_ocp.diagnosis.hypotheses import TruncatedHeldOutRecording
from yid_ocp.diagnosis.refit import RefitStatistics
from yid_ocp.diagnosis.screening import DetectableAmplitudes
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.diagnosis.verdict import (
    Judgement,
    NominalModelGapEvidence,
)
from yid_ocp.effects import EffectBase
from yid_ocp.effects.base import REQUIRED_EXCITATION_PHRASES
from yid_ocp.inference.null_test import residuals_exceed_noise
from yid_ocp.inference.smoother import GapLocation, main_gap_locations

_MIN_RELATIVE_CHANGE = 0.1  # relative change from which a nominal parameter is named
_PRIOR_RANGE_TOLERANCE = 0.25  # fraction of its range by which an amplitude may exceed the range without a message
_GAP_ORIGIN_PHRASES = {
    "plant": ", in the mechanics rather than in what sensors read",
    "sensor": ", in what sensors read",
    "either": ", in the mechanics or in what the effort sensor reads (efforts alone cannot distinguish them)",
}
_RUNS_DIFFER_LEVEL = 0.01  # significance below which several runs of a baseline differ
_MAX_EVENTS_LISTED = 8  # maximum number of events listed one by one
_IMMOVABLE_LOCATIONS = ("world", "clock", "camera", "object", "base")  # locations that cannot be moved by themselves
_NEXT_EXPERIMENT_TEXTS = {
    "insufficient_data": "Record longer and larger motions; more of the object must be visible.",
    "separate": "Vary {aspects} independently of each other, over a wide range, in one recording.",
    "places": "Move so that {places} work one at a time, or measure a point between them.",
    "vary": "Vary {aspects} over a wider range.",
    "other": "Record other motions, faster and larger.",
    "unknown": "Move {place} alone, slowly and fast, and hold it still in several configurations.",
    "unseen": "None needed: no relevant gap was found. These motions cannot reveal {unseen}.",
    "no_gap": "None needed: no relevant gap was found.",
    "effect": "Repeat with other motions and check that the effect's parameters stay the same.",
}
"""Texts of the recommended next experiment, by situation."""
_UNKNOWN_REASON_TEXTS = {
    "nothing": "{no} explains it.",
    "none": "{no} explains it (the best, {best}, is not significant or closes too little).",
    "unsure": "{names} close{s} {closure:.3g} % of it, but the lower 95 % bound is {low:.3g} %; {least:.3g} % is "
    "required.",
    "little": "{names} explain{s} {explained:.3g} % of what unknown forces, offsets and biases explain, and {sure}; "
    "{enough:.3g} % {asked}.",
    "stand_in": "{names} imitate{s} it ({closing}) and {are} not its cause: {apart}.",
    "no held-out gap": "{names} may explain it, but {sure}.",
}
"""Sentences on why the verdict is unknown, by `verdict.UnknownVerdictReason`."""


def _separating_experiment(rivals: Sequence[EffectBase]) -> str:
    """The experiment that separates confusable effects, from what their equations depend on."""
    said = dict.fromkeys(effect.required_excitation for effect in rivals if effect.required_excitation)
    known = [aspect for aspect in REQUIRED_EXCITATION_PHRASES if aspect in said]
    aspects = [*known, *(aspect for aspect in said if aspect not in known)]
    places = list(dict.fromkeys(effect.location for effect in rivals))
    case = "separate" if len(aspects) > 1 else "places" if len(places) > 1 else "vary" if aspects else "other"
    return _NEXT_EXPERIMENT_TEXTS[case].format(aspects=" and ".join(aspects), places=" and ".join(places))


def recommended_experiment_text(
    judgement: Judgement, where: Sequence[GapLocation], evidence: Sequence[DetectableAmplitudes]
) -> str:
    """Recommend the next recording in a sentence, from verdict, gap location and confusable effects."""
    verdict = judgement.verdict
    rivals = next(
        (entry.equivalent_effects for entry in judgement.accepted_selections if len(entry.equivalent_effects) > 1), ()
    )
    if rivals:
        return _separating_experiment(rivals)
    unseen = [entry.effect.label for entry in evidence if not entry.is_detectable]
    place = where[0].location if where and where[0].gap_share > 0 else ""
    case = verdict if verdict in _NEXT_EXPERIMENT_TEXTS else "effect"
    if verdict == "unknown" and place in ("", *_IMMOVABLE_LOCATIONS):
        case = "other"
    if verdict == "no_gap" and unseen:
        case = "unseen"
    listed = ", ".join(unseen[:4]) + (", ..." if len(unseen) > 4 else "")
    return _NEXT_EXPERIMENT_TEXTS[case].format(place=place, unseen=listed)


def insufficient_data_message(verdict: str, evidence: NominalModelGapEvidence, limits: Thresholds) -> str:
    """Explain why the data are insufficient. Empty if they suffice."""
    if verdict != "insufficient_data":
        return ""
    if not any(entry.is_detectable for entry in evidence.screening.detectability):
        return "no candidate of its expected size would be visible in these recordings."
    unknowns = len(evidence.nominal_model.values)
    needed = f"at least {limits.min_samples_per_unknown * unknowns:.0f} are needed"
    said = f"{evidence.nominal_test.degrees_of_freedom:.0f} effective samples for {unknowns} unknowns, {needed}"
    return f"{said}; record longer or free fewer parameters."


def held_out_truncation_message(cut: TruncatedHeldOutRecording) -> str:
    """Sentence on how far the nominal model follows a truncated held-out recording."""
    if cut.kept_duration == 0:
        return f"The nominal model cannot follow {cut.recording}; this recording is ignored."
    part = f"{cut.kept_duration:.3g} of {cut.full_duration:.3g} s"
    return f"The nominal model follows {cut.recording} for {part} only; the rest is ignored."


def diagnosis_summary_text(result: DiagnosisResult) -> str:
    """Summarise a diagnosis in a text on gap, locations, effects, events and the next experiment."""
    text = [_gap(result)]
    if result.stated_and_finer_time_step is not None:
        stated, used = (f"{step:.4g}" for step in result.stated_and_finer_time_step)
        used = f"this result is for {used} s (set problem.time_step: {used} for other commands)"
        text.append(f"The discretisation error of {stated} s steps looks like a gap: {used}.")
    if result.verdict not in ("insufficient_data", "no_gap"):
        text.append(_places(result))
    if result.accepted_effects:
        text += _effects(result)
    elif result.verdict == "unknown":
        tests = (result.nominal_test, result.nominal_held_out_test)
        exceeds = residuals_exceed_noise(tests, result.thresholds.null_test_limits)
        size = _model_error(result) if exceeds else ""
        text += [_nameless(result), _significant_locations(result)]
        text.append(f"What remains is model error{size}." if size else "")
    text.append("" if result.law is None else result.law.sentence)
    if result.untried:
        rest = ", ".join(result.untried[:8]) + (", ..." if len(result.untried) > 8 else "")
        text.append(f"The search stopped after {result.search_seconds:.3g} s; it would go on with {rest}.")
    text += [held_out_truncation_message(cut) for cut in result.truncated_recordings]
    if result.baseline_comparison is not None:
        text += _since(result.baseline_comparison, bool(result.accepted_effects))
    if result.counterfactual is not None:
        text += _counterfactual(result.counterfactual)
    if result.is_split_in_blocks:
        cut, whole = "No held-out recording is left", "Only one set of recordings was given"
        why = cut if result.truncated_recordings else whole
        text.append(f"{why}: alternate blocks of what is estimated on were held out.")
    text += [_event_sentences(result.events), f"Next experiment: {result.next_experiment}"]
    return " ".join(filter(None, text))


def _gap(finding: DiagnosisResult) -> str:
    """Sentence on whether there is a gap."""
    held, first = finding.nominal_held_out_test, finding.nominal_test
    p, limits = min(first.p_value, held.p_value), finding.thresholds
    fitted, other = (f"{x:.3g}" if math.isfinite(x) else "not known" for x in (first.chi2_per_dof, held.chi2_per_dof))
    sizes = f"chi2 per degree of freedom {fitted}, held out {other}"
    if finding.verdict == "insufficient_data":
        return f"The data are insufficient: {finding.message}"
    if finding.verdict == "no_gap":
        return f"There is no relevant gap ({sizes}; p = {p:.2g})."
    best = min(finding.screening.candidate_scores, key=lambda score: score.p_value, default=None)
    if residuals_exceed_noise((first, held), limits.null_test_limits) or best is None:
        return f"The gap is real ({sizes}; p {_p_value_relation(p)})."
    small = _p_value_relation(min(1.0, best.p_value * len(finding.screening.candidate_scores)))
    said = f"As a whole the recordings are explained to within their noise ({sizes})"
    return f"{said}, but not along what {best.effect.label} would do (p {small})."


def _p_value_relation(p_value: float) -> str:
    return f"= {p_value:.2g}" if p_value > 1e-12 else "< 1e-12"


def _places(finding: DiagnosisResult) -> str:
    """Sentence on the gap's locations, with inseparable locations together; empty if unknown."""
    where = main_gap_locations(finding.gap_locations)
    shares = [(" or ".join([p.location, *p.indistinguishable_from]), round(100 * p.gap_share)) for p in where]
    named = " and ".join(f"{place} ({percent} %)" for place, percent in shares if percent)
    side = (
        ""
        if finding.smoother_result is None
        else _GAP_ORIGIN_PHRASES.get(finding.smoother_result.plant_or_sensor_origin, "")
    )
    silent = "These data cannot locate it." if shares else ""
    return f"It lies in {named}{side}." if named else silent


def _nameless(finding: DiagnosisResult) -> str:
    """Sentence on why no effect is named, with its numbers."""
    added, tried, reason = finding.selected_effects, finding.single_effect_models, finding.unknown_reason
    apart = [entry.both_estimates_text for entry in finding.failed_transfer_checks]
    count, closed = finding.assumption_count, finding.gap_closure
    is_closure_known = math.isfinite(closed.fraction) and math.isfinite(closed.ci_low)
    none = "held-out motions have no gap to close"
    sure = (
        f"close{'s' if len(added) == 1 else ''} at least {100 * closed.ci_low:.3g} % of the held-out gap (95 % bound)"
    )
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
        asked=f"of the former is required for {count} assumptions" if count > 1 else "is required of both",
        enough=100 * finding.required_explained_fraction(finding.thresholds),
        apart="; ".join(apart[:2]),
        no="No effect tried so far" if finding.untried else "No known effect",
    )


def _significant_locations(finding: DiagnosisResult) -> str:
    """Sentence on the kind of the best effect, if it is significant at several locations."""
    ranked, best = finding.screening.candidate_scores, [fit.effects[0] for fit in finding.single_effect_models[:1]]
    level = finding.thresholds.gap_significance_level / max(len(ranked), 1)
    same = [s.effect for s in ranked if s.p_value < level and s.effect.kind in {effect.kind for effect in best}]
    if len(same) < 2 or same[0].is_local:
        return ""
    places, advice = ", ".join(effect.location for effect in same), "add it to the model at all of them"
    return f"{same[0].kind} is significant at {places}: {advice} (`model.effects`, or `yid-ocp friction` for friction)."


def _effects(finding: DiagnosisResult) -> list[str]:
    """Sentences on the accepted effects, their closure, confusable effects, and the residual gap."""
    last, total, rest = finding.final_model, finding.gap_closure, finding.remaining_test
    names = "; ".join(f"{e.label} with {_figures(e, last)}" for e in finding.accepted_effects)
    verb = "closes" if len(finding.accepted_effects) == 1 else "together close"
    odds = math.exp(finding.thresholds.min_log_bayes_factor)
    text = [
        f"{names} {verb} {100 * total.fraction:.3g} % of it on held-out motions "
        f"(95 % interval {100 * total.ci_low:.3g} to {100 * total.ci_high:.3g} %)."
        if total.ci_low > finding.thresholds.min_gap_closed
        else f"With {names} the held-out motions are far more likely (more than {odds:.0f} times), but it "
        "changes chi2 too little to state which part of the gap it closes."
    ]
    for entry in finding.selected_effects:
        others = [r.label for r in entry.equivalent_effects if r.label != entry.effect.label]
        text += [f"Not separable from {entry.effect.label}: {', '.join(others)}."] if others else []
    odd = [said for effect in finding.accepted_effects for said in _out_of_range(effect, last)]
    if odd:
        text.append(f"Outside the expected range, so possibly a substitute for another cause: {', '.join(odd)}.")
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
    sizes = finding.worst_held_out_channel_by_unit.items()
    said = " and ".join(f"{size:.2g} {unit} (rms) at {channel}" for unit, (channel, size) in sizes)
    return f" of {said}" if said else ""


def _figures(effect: EffectBase, fit: RefitStatistics) -> str:
    text = []
    for name, r in fit.effect_parameters_as_reported(effect).items():
        known = f"= {r.value:.3g} ± {r.std:.2g} {r.unit}".strip().removesuffix(" 1")
        text.append(f"{name} {known if math.isfinite(r.std) else 'unknown'}")
    return ", ".join(text)


def _out_of_range(effect: EffectBase, fit: RefitStatistics) -> list[str]:
    """Sentence on amplitudes beyond their expected range."""
    found = []
    for name in effect.amplitude_parameter_names:
        (low, high), value = effect.prior_ranges[name], fit.values[name]
        room = _PRIOR_RANGE_TOLERANCE * (high - low)
        if not low - room <= value <= high + room and effect.neutral_values[name] != value:
            found.append(f"{name} = {value:.3g} (range {low:.3g} to {high:.3g})")
    return found


def _since(found: EarlierRunsComparison, effects: bool) -> list[str]:
    """Sentences on changes since the baseline, and on a baseline that explained little."""
    several, p_value = len(found.baseline_runs), found.between_runs_p_value
    moved = [
        f"{e.name} is {e.current_value:.3g} ± {e.current_std:.2g} {e.unit} where it was "
        f"{e.baseline_value:.3g} ± {e.baseline_std:.2g}"
        for e in found.changed_parameters[:4]
    ]
    seen = any(entry.z_score is not None for entry in found.parameter_shifts)
    none = "no parameter has changed" if seen else "these recordings do not inform the parameters"
    what = f"{'even with that ' if effects else ''}{', '.join(moved)}" if moved else none
    text = [f"Against the baseline{f' of {several} runs' if several > 1 else ''}, {what}."]
    if several > 1 and p_value < _RUNS_DIFFER_LEVEL:
        text.append(f"The runs of the baseline differ among themselves (p = {p_value:.2g}); their ± includes this.")
    if not found.is_baseline_explained:
        what = "The model did not explain the baseline's recordings"
        text.append(f"{what}, so its ± includes that misfit and may be too small.")
    return text


_COUNTERFACTUAL_TEXTS = (
    ("Taken away again, it predicts", "made without it", "as it was fitted without a diagnosis"),
    ("Added to what was known without it, it predicts", "made with it", "without it"),
)
"""Beginning, how the recordings were made, and what the prediction is compared with: effects removed, and added."""


def _counterfactual(found: ErrorsWithEffectsRemovedAndAdded) -> list[str]:
    """Sentence on predictions with the effects removed from, and added to, the model."""
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
            text.append("That is no better, so the effect may be a substitute for another cause.")
    return text


def _event_sentences(events: EventSet) -> str:
    """Sentences on all events: what, where, when; empty if there are none."""
    text, count = [], len(events.disturbances)
    if count:
        told = "; ".join(_said(event) for event in events.disturbances[:_MAX_EVENTS_LISTED])
        more = f"; and {count - _MAX_EVENTS_LISTED} more" if count > _MAX_EVENTS_LISTED else ""
        first = "One brief local disturbance was" if count == 1 else f"{count} brief local disturbances were"
        text.append(f"{first} found and excluded: {told}{more}.")
    return " ".join([*text, *ignored_after_overspeed_messages(events)])


def ignored_after_overspeed_messages(events: EventSet) -> list[str]:
    """One sentence per recording whose end is ignored because a joint exceeds `max_joint_speed`."""
    said, why = "s are ignored in", "moves too fast for the model."
    return [f"Data after {e.start_time:.3g} {said} {e.recording}: {e.joint} {why}" for e in events.overspeeds]


def _said(event: ForceOrFaultEvent) -> str:
    if event.kind == "sample":
        when = f"at {0.5 * (event.start_time + event.end_time):.3f} s in {event.recording}"
        return f"{event.channel} is off by {event.peak_value:+.3g} {event.unit} {when}"
    return (
        f"{event.channel} is pushed by up to {event.peak_value:+.2g} {event.unit} "
        f"from {event.start_time:.2f} to {event.end_time:.2f} s in {event.recording} "
        f"({event.impulse:+.2g} ± {event.impulse_std:.1g} {event.unit} s)"
    )

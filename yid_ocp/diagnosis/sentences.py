"""The result of a diagnosis in sentences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from yid_ocp.diagnosis.diagnosis_result import DiagnosisResult
from yid_ocp.diagnosis.hypotheses import HeldOutTruncation
from yid_ocp.diagnosis.refit import RefitStatistics, RefittedModel
from yid_ocp.diagnosis.screening import bonferroni_corrected_min_candidate_p_value
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.display import abbreviated_names_text, count_with_noun, p_value_text, unseen_effects_sentence
from yid_ocp.effects import EffectBase
from yid_ocp.inference import null_test
from yid_ocp.inference.smoother import select_largest_gap_locations
from yid_ocp.inference.uncertainty import mask_of_priors_determining_unknown, value_and_uncertainty_text

MIN_GAP_SHARE = 0.005  # smallest share of the gap of a location that is named
_MIN_RELATIVE_CHANGE = 0.1  # relative change from which a nominal parameter is named
_MAX_NAMED = 5  # number of named parameters, the largest changes first, and of named events
_FEW_KINDS = 3  # most kinds of effects tried for which they are named, because more may exist
_FAULTY_RECORDING_ERROR_RATIO = 3  # error on a reference recording by any model, over that on the other recordings
_RUNS_DIFFER_LEVEL = 0.01  # significance below which several runs of a baseline differ
_IMMOVABLE_LOCATIONS = ("world", "clock", "camera", "object", "base")  # locations that do not move by themselves
GAP_ORIGIN_TEXTS = {
    "plant": "the mechanics, not a sensor",
    "sensor": "a sensor, not the mechanics",
    "either": "the mechanics or the effort sensor (recorded efforts alone do not show which)",
    "both": "both the mechanics and a sensor",
    "none": "neither the mechanics nor a constant error of a sensor, as far as these unknowns can show",
}


def recommended_experiment_text(result: DiagnosisResult) -> str:
    """Recommend the next recording in one sentence, based on verdict, gap location and confusable effects."""
    for rivals in (entry.equivalent_effects for entry in result.accepted_selected_effects):
        aspects = list(dict.fromkeys(effect.required_excitation for effect in rivals))
        places = list(dict.fromkeys(effect.location for effect in rivals))
        at = next((f" of {place}" for place in places if place not in _IMMOVABLE_LOCATIONS), "")
        advice = (
            (aspects, f"Record one motion{at} in which these vary independently and widely: {', '.join(aspects)}."),
            (places, f"Move {' and '.join(places)} one after the other, or measure a point between them."),
            (rivals, f"Record a motion in which {aspects[0]}{at} varies over a wider range."),
        )
        if told := [text for several, text in advice if len(several) > 1]:
            return f"{told[0]} This can separate these effects: {', '.join([effect.label for effect in rivals])}."
    still = {*_IMMOVABLE_LOCATIONS, *(own.channel.rpartition(".")[0] for own in result.noise_floor)}  # also sensors
    place = [p.location for p in result.gap_locations[:1] if p.gap_share > 0 and p.location not in still]
    mostly = _listed("Record slow and fast motions, with pauses, and most motion at ", place, " (where the gap is).")
    texts = {
        "insufficient_data": "Record longer and larger motions, with more points in view, or free fewer parameters.",
        "unknown": mostly or "Record faster and larger motions of all joints, which show more effects.",
        "no_gap": "None is needed: the model explains motions like these. Other motions may still show a gap.",
        "confusable": "Record faster motions and other postures, to separate the effects from changed parameters.",
        "effect": "Record and diagnose other motions. If the named cause is right, its estimates stay the same.",
    }
    repeat = "None yet. First repeat the diagnosis with the effect that is significant at several locations."
    return repeat if _several_places(result) else texts[result.verdict]


def diagnosis_summary_text(result: DiagnosisResult) -> str:
    """Summarise a diagnosis in lines: the gap, locations, effects, remaining error, events and next experiment."""
    stopped = f"The time limit (diagnosis.budget: {result.thresholds.budget} s) ended the search. Not tested: "
    untried = _listed(stopped, result.untried, ". To test them, raise this limit.")
    text = [" ".join([*_use(result), _gap(result)]), untried]
    if result.verdict not in ("insufficient_data", "no_gap"):
        (error, change), found = _remains(result), [gap_locations_sentence(result, has_origin=True), *_causes(result)]
        text += [*found, error, change] if result.accepted_effects else [error, *found, change]
    text += [] if result.law is None else [result.law.sentence]
    stated, used = (f"{step:.4g}" for step in result.stated_and_used_time_step)
    step = result.stated_and_used_time_step[1]
    text += [held_out_truncation_message(cut, step) for cut in result.truncated_recordings]
    text += [*_bound_by_priors(result), *_earlier_runs(result)]
    finer = f"Time steps of {stated} s are too long for these motions, so the diagnosis used {used} s"
    divided = result.nominal_model.problem.options.divided_links_model if result.is_corrected_for_links else None
    links = "The model has too few links. The resulting error is not part of these numbers. For other commands, set "
    blocks = "No recording could be held out (recordings.held_out), so every second block of time is held out."
    text += [f"{finer} (set problem.time_step: {used} for other commands)." * (stated != used)]
    text += [links + f"{divided.setting_text}." if divided else "", blocks * result.is_split_in_blocks]
    kinds, events = {"force": "push of", "sample": "wrong samples of"}, result.events.disturbances
    where = "{e.channel} at {e.start_time:.2f} to {e.end_time:.2f} s of '{e.recording}'"
    told = [f"{kinds[e.kind]} {where.format(e=e)}" for e in events]
    check = "If you did not push the arm on purpose, look at the recordings at these times."
    left = f"The tests leave out {count_with_noun(len(told), 'brief disturbance')}: "
    text += [_listed(left, told, f". {check}", max_entries=_MAX_NAMED)]
    text += [*overspeed_truncation_messages(result), f"Next experiment: {result.next_experiment}"]
    return "\n".join(filter(None, text))


def held_out_truncation_message(cut: HeldOutTruncation, time_step: float) -> str:
    """Return a sentence that states for how long the nominal model follows a truncated held-out recording."""
    used = f"Only {cut.kept_duration:.3g} of {cut.full_duration:.3g} s of held-out recording '{cut.recording}' are used"
    return f"{used}, because its simulation then fails. To use more, set problem.time_step: {time_step / 2:.4g}."


def overspeed_truncation_messages(result: DiagnosisResult) -> list[str]:
    """Return a sentence for each recording whose end is ignored because a joint exceeds `max_joint_speed`."""
    why = f"then moves faster than diagnosis.max_joint_speed ({result.thresholds.max_joint_speed:g} rad/s or m/s)."
    cut, cuts = "s are ignored, because joint", result.events.overspeeds
    return [f"Data of '{e.recording}' after {e.start_time:.3g} {cut} {e.joint} {why}" for e in cuts]


def _listed(beginning: str, names: Iterable[str], end: str = ".", **limit: int) -> str:
    """Sentence on names, similar ones merged. Empty if there are none."""
    text = abbreviated_names_text([*names], **limit)
    return f"{beginning}{text}{end}" if text else ""


def _short(number: float) -> str:
    return f"{number:.3g}" if number < 1000 else f"{number:.0f}"


def _use(result: DiagnosisResult) -> Iterator[str]:
    """Yield sentences on whether a model with a gap may be used, and on the most probable cause."""
    rivals = [[effect.label for effect in entry.equivalent_effects] for entry in result.accepted_selected_effects]
    if result.verdict == "unknown":
        yield "Do not use the estimates, because the cause of the model's error is unknown."
    elif result.verdict == "confusable":
        yield "Do not use the estimates yet, because several causes explain the model's error about equally well."
    elif result.verdict == "effect":
        is_left = result.remaining_test.p_value < result.thresholds.significance_level
        beyond = ", but expect errors beyond noise" * is_left
        names = abbreviated_names_text([effect.label for effect in result.accepted_effects])
        yield f"Use the model with {names}, not the nominal one{beyond}."
    if rivals:
        causes = " and ".join(f"{'one of ' * (len(own) > 1)}{abbreviated_names_text(own)}" for own in rivals)
        yield f"With {100 * result.probability:.0f} % probability, the true cause is {causes}."


def _gap(result: DiagnosisResult) -> str:
    """Sentence on whether there is a gap."""
    tests, scores = (result.nominal_test, result.nominal_held_out_test), result.screening.candidate_scores
    fitted, other = (_short(test.chi2_per_dof) for test in tests)
    sizes = f"chi2 per degree of freedom is {fitted} on fitted and {other} on held-out motions; noise alone gives 1"
    p_value = min(test.p_value for test in tests)
    unknowns, seen = len(result.nominal_model.values), [v.is_detectable for v in result.screening.detectability]
    chance = f"p {p_value_text(p_value, '= ')}: the probability that noise alone gives such an error"
    if result.verdict == "insufficient_data":
        dof, few = f"{tests[0].degrees_of_freedom:.0f}", f"more than {unknowns}, the number of unknowns, are needed"
        said = f"{dof} independent samples ({few}), and would show {sum(seen)} of {len(seen)} effects"
        return f"The model is not tested: the recordings have {said} (at least 1 is needed)."
    if result.verdict == "no_gap":
        said = (
            f"Use the model for motions like these. There is no relevant gap: {sizes} ({chance}). The recordings would "
        )
        said += f"show {sum(seen)} of {len(seen)} effects."
        return "\n".join(filter(None, [said, *_why_no_gap(result)]))
    if null_test.residuals_exceed_noise(tests, result.thresholds.null_test_excess_criteria):
        seen_in = [name for name, test in zip(("fitted", "held-out"), tests, strict=True) if test.chi2_per_dof > 1]
        only = f" on the {seen_in[0]} motions only" if len(seen_in) == 1 else ""
        return f"The nominal model has an error beyond noise (a gap){only}: {sizes} ({chance})."
    best, p_value = min(scores, key=lambda own: own.p_value), bonferroni_corrected_min_candidate_p_value(scores)
    small = f"But the error has the pattern of the effect {best.effect.label} (p {p_value_text(p_value, '= ')})"
    return f"In total the error of the nominal model is within noise: {sizes}. {small}."


def _why_no_gap(result: DiagnosisResult) -> list[str]:
    """Sentences on why a significant residual does not count as a gap, and on effects that could be overlooked."""
    limits, tests = result.thresholds, (result.nominal_test, result.nominal_held_out_test)
    scores, level = result.screening.candidate_scores, limits.gap_significance_level
    best = [own.effect.label for own in sorted(scores, key=lambda own: own.p_value)[:1]]
    along, least = bonferroni_corrected_min_candidate_p_value(scores), 1 + limits.min_excess_chi2_per_dof
    needs = f"chi2 per degree of freedom above {least:.4g} and p below {level / len(tests):.2g}"
    small = "The error is significantly larger than noise, but too small to count as a gap. "
    seen = f"The error has the pattern of {''.join(best)} (p {p_value_text(along, '= ')} if there is only noise)"
    is_significant = min(test.p_value for test in tests) < limits.significance_level
    narrow = f"{seen}, but this effect was not accepted as a cause, so there is no gap."
    unseen = [own.effect.label for own in result.screening.detectability if not own.is_detectable]
    return [f"{small * is_significant}A gap needs {needs}.", narrow * (along < level), unseen_effects_sentence(unseen)]


def gap_locations_sentence(result: DiagnosisResult, *, has_origin: bool = False) -> str:
    """Return a sentence on the gap's locations, with inseparable ones together, and if `has_origin` on its origin."""
    where = [place for place in select_largest_gap_locations(result.gap_locations) if place.gap_share >= MIN_GAP_SHARE]
    parts = [(p.gap_share, " or ".join([p.location, *p.indistinguishable_from])) for p in where]
    if not parts:
        return "The recordings do not show in which part of the model or in which sensor the error arises."
    assert result.smoother_result is not None  # it found the locations
    parts += [(rest, "elsewhere")] if (rest := 1 - sum(place.gap_share for place in where)) >= MIN_GAP_SHARE else []
    named = ", ".join(f"{100 * part:.0f} % from {place}" for part, place in parts).replace("% from", "% comes from", 1)
    origin = result.smoother_result.plant_or_sensor_origin
    side = f"; its origin is {GAP_ORIGIN_TEXTS[origin]}" * (has_origin and origin in ("plant", "sensor", "either"))
    return f"Of the error beyond noise that can be located, {named}{side}."


def _causes(result: DiagnosisResult) -> list[str]:
    """Sentences on the selected effects, and on why the verdict is unknown."""
    added, total = result.selected_effects, result.closure_by_selected_effects
    limits, text, s = result.thresholds, list[str](), "s" if len(added) == 1 else ""
    names = abbreviated_names_text([entry.effect.label for entry in added])
    if added:
        part = "an unknown part of the error beyond noise on held-out motions"
        if result.nominal_model.held_out_loss.excess_chi2_per_sample <= 0:
            part += ", because the nominal model's error there is within noise"
        if math.isfinite(total.ci_low):
            interval = f"95 % interval {100 * total.ci_low:.3g} to {100 * total.ci_high:.3g} %"
            part = f"{100 * total.fraction:.3g} % of the error beyond noise on held-out motions ({interval})"
        text += [f"{names} remove{s} {part}.", *(_named(e.effect, added[-1].refitted_model, limits) for e in added)]
    rivals = [[effect.label for effect in entry.equivalent_effects] for entry in result.accepted_selected_effects]
    text += [_listed(f"These recordings cannot distinguish {own} from ", others) for own, *others in rivals]
    (fitted, least), (closed, goal) = result.explained_and_required_fractions(limits)
    few = f"{100 * fitted:.3g} % of the error on fitted motions (needed: {100 * least:.3g} %)"
    end = f" and {100 * closed:.3g} % on held-out ones (lower end of the interval; needed: {100 * goal:.3g} %)"
    unsure = abbreviated_names_text([*(sizes := result.undetermined_sizes(limits))])
    size = f"the size of {unsure} is uncertain (less than {limits.min_z:g} ± from no effect, if ± includes the gap)"
    apart = "".join(f". {text}" for texts in sizes.values() for text in texts[:2])
    either = f"If {unsure} changed between the recordings, diagnose them separately. Otherwise another cause acts"
    none, kinds = "No cause is named, because", {own.effect.kind: None for own in result.screening.candidate_scores}
    is_narrow = (len(kinds) <= _FEW_KINDS) * (not result.untried)
    more = f" Tried: only {', '.join(kinds)}. To try more, leave out diagnosis.candidates, if it is set." * is_narrow
    reasons = {
        "none": f"{none} no effect that was tried explains the error well enough.{more}",
        "little": f"{none} {names} explain{s} only {few}{end * math.isfinite(closed)}.",
        "stand_in": f"{none} {size}{apart}. {either}.",
    }
    laws = abbreviated_names_text([entry.effect.label for entry in added if entry.effect.is_joint_friction])
    alone = f"The size of {laws} may contain other friction, such as viscous friction, that is not in the model. "
    alone += "`yid-ocp friction CONFIG` fits the friction laws side by side."
    reason = reasons.get(result.unknown_reason, "") * bool(result.single_effect_models or not result.untried)
    return [*text, reason, alone * bool(laws), _several_places(result)]


def _several_places(result: DiagnosisResult) -> str:
    """Sentence for an unknown cause: the places where the kind of the best single effect is significant, if several."""
    scores, level = result.screening.candidate_scores, result.thresholds.gap_significance_level
    best = [fit.effects[0].kind for fit in result.single_effect_models[:1]]
    alike = [s for s in scores if s.p_value * len(scores) < level and s.effect.kind in best and not s.effect.is_local]
    said = f"{''.join(best)} is significant at several locations (p below {level / max(len(scores), 1):.2g}): "
    said += abbreviated_names_text([s.effect.location for s in alike])
    advice = "Add it there under model.effects (friction: as `yid-ocp friction` advises), and repeat `yid-ocp diagnose`"
    return f"{said}. {advice}." if result.unknown_reason and len(alike) > 1 else ""


def _bound_by_priors(result: DiagnosisResult) -> list[str]:
    """One sentence per refitted effect whose amplitudes only the priors of nominal parameters determine."""
    text, remedy = [], "To determine the effect, measure these parameters and fix them (parameters.NAME.free: false)."
    for fit in result.single_effect_models:
        if not isinstance(fit, RefittedModel) or fit.evaluation.jacobian is None:
            continue
        names, rows, own = fit.problem.unknown_names, fit.problem.residual_rows, fit.effects[-1]
        data, priors = (fit.evaluation.jacobian[part] for part in (rows.data, rows.stated_priors))
        others: dict[str, None] = {}
        for name in own.amplitude_parameter_names:
            by = mask_of_priors_determining_unknown(data, priors, names.index(name))
            others |= dict.fromkeys(names[i] for i in np.flatnonzero(by) if names[i] in fit.problem.shared_parameters)
        text.append(_listed(f"These recordings cannot separate {own.label} from ", others, f". {remedy}"))
    return text


def _named(effect: EffectBase, fit: RefitStatistics, limits: Thresholds) -> str:
    """Line with an effect's estimates, and warnings if one is far outside its range or no size is determined."""
    values, odd, is_unsure = [], "", not fit.determines_size(effect, limits.min_z)
    for name, r in effect.to_reported_parameters(fit.values, fit.std).items():
        known = f"= {value_and_uncertainty_text(r.value, r.std, least_digits=3)} {r.unit}".removesuffix(" 1")
        values.append(f"{name} {known if math.isfinite(r.std) else '= unknown'}")
    for name in fit.implausible_parameters(effect, limits):
        low, high = effect.prior_ranges[name]
        odd = f" (far outside its expected range, {low:.3g} to {high:.3g}, so possibly a substitute for another cause)"
    return f"  {effect.label}: {', '.join(values)}{odd}{' (these recordings do not determine its size)' * is_unsure}"


def _remains(result: DiagnosisResult) -> list[str]:
    """Sentences on the error that remains on held-out motions, and on what the effects change in the model."""
    noise = {own.channel: own.noise_rmse for own in result.noise_floor}
    errors = result.final_model.held_out_loss.channel_rmse.items()
    beyond = sorted((max(rms**2 - noise.get(name, 0.0) ** 2, 0.0), name, unit) for name, (rms, unit) in errors)
    sizes = ((x, name, unit) if unit != "m" else (1e6 * x, name, "mm") for x, name, unit in beyond)
    worst = {unit: f"{math.sqrt(square):.2g} {unit} at {name}" for square, name, unit in sizes}
    effects, places = result.accepted_effects, [own.location for own in result.remaining_gap_locations]
    mostly = f". Most of this error comes from {places[0]}" if effects and places else ""
    who = "the model with the effects" if effects else "the nominal model"
    now = f". Its chi2 per degree of freedom there is {_short(result.remaining_test.chi2_per_dof)}" * bool(effects)
    said = f"On held-out motions, noise and the uncertainty of the parameters explain the whole error of {who}{now}."
    if result.remaining_test.p_value < result.thresholds.significance_level:
        size = f"{', '.join(worst.values())} (rms, noise subtracted)"
        said = f"On held-out motions, the error of {who} is {size}{now}{mostly}."
    changes = sorted(result.nominal_parameters_before_and_after.items(), key=lambda own: -_relative_change(own[1]))
    moved = [
        f"{name} from {own['before']:.3g} to {own['after']:.3g} {own['unit']}".removesuffix(" 1")
        for name, own in changes
        if _relative_change(own) > _MIN_RELATIVE_CHANGE
    ]
    return [said, _listed("With the effects in the model, these estimates change: ", moved, max_entries=_MAX_NAMED)]


def _relative_change(own: Mapping[str, Any]) -> float:
    return float(abs(own["after"] - own["before"]) / max(abs(own["before"]), 1e-9))


def _earlier_runs(result: DiagnosisResult) -> list[str]:
    """Sentences on changes since the baseline, and on recordings made without the effects, and with them."""
    since, swapped, text = result.baseline_comparison, result.counterfactual, list[str]()
    if since is not None:
        moved = []
        for own in since.significant_parameter_shifts:
            before = value_and_uncertainty_text(own.baseline_value, own.baseline_std, least_digits=3)
            now = value_and_uncertainty_text(own.current_value, own.current_std, least_digits=3)
            moved.append(f"{own.name} from {before} to {now} {own.unit}")
        changed = "Changed since the earlier runs by more than the ± (without common errors of links and time step): "
        same = "No parameter differs significantly from the baseline (the earlier runs)."
        rivals = result.confusable_parameter_changes
        end = ". If nothing was altered on purpose, find the cause before you use the values."
        text.append(_listed(changed, moved, end) or same * (not rivals))
        text.append(_listed("A change of ", rivals, " since the baseline explains about as much as the effects."))
        p = since.between_runs_p_value
        differ = f"The earlier runs differ from each other by more than their ± (p = {p:.2g} < {_RUNS_DIFFER_LEVEL:g})."
        small = "The model did not explain the recordings of the baseline, so the ± of the baseline may be too small."
        text += [f"{differ} The ± of the baseline includes this." * (p < _RUNS_DIFFER_LEVEL)]
        text += [small * (not since.is_baseline_explained)]
    parts = {} if swapped is None else {"without": swapped.effects_removed, "with": swapped.effects_added}
    other = {} if swapped is None else swapped.effects_added.rmse_by_unit
    for how, part in parts.items():
        names = abbreviated_names_text([name.removesuffix(" (without)") for name in part.recordings])
        made = f"Recordings made {how} the effects ({names})"
        plain, errors = (", ".join(f"{pair[i]:.2g} {unit}" for unit, pair in part.rmse_by_unit.items()) for i in (0, 1))
        if part.failure_message:
            text.append(f"{made} could not be predicted ({part.failure_message}), so they do not test the effects.")
            continue
        errors = f"{errors} (rms) by the model {how} the effects, and of {plain} by the model before the diagnosis"
        text.append(f"{made} are predicted with an error of {errors}.")
        ratios = [min(pair) / max(other[u]) for u, pair in part.rmse_by_unit.items() if u in other]
        if how == "without" and min(ratios, default=0.0) > _FAULTY_RECORDING_ERROR_RATIO:
            worse = f"over {_FAULTY_RECORDING_ERROR_RATIO} times those on the recordings with the effects"
            text.append(f"Both errors are {worse}, so {names} may be faulty. Check clock, units and setup.")
        elif not part.is_improved_by_counterfactual:
            same = " and ".join(unit for unit, (first, then) in part.rmse_by_unit.items() if then > 0.999 * first)
            text.append(f"The diagnosis does not lower the error in {same} on {names}, so it may be wrong.")
    return text

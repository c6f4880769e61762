"""The result of a diagnosis in sentences."""

from __future__ import annotations

import math

import numpy as np

from yid_ocp.diagnosis.diagnosis_result import DiagnosisResult
from yid_ocp.diagnosis.refit import RefitStatistics, RefittedModel
from yid_ocp.diagnosis.thresholds import NEED_TEST, Thresholds, is_provisional
from yid_ocp.display import abbreviated_names_text as listed
from yid_ocp.display import count_with_noun, p_value_text, unseen_effects_sentence
from yid_ocp.display import texts_that_hold as _said
from yid_ocp.effects import EffectBase
from yid_ocp.inference import null_test, uncertainty
from yid_ocp.inference.smoother import GapLocation
from yid_ocp.inference.uncertainty import mask_of_priors_determining_unknown, value_and_uncertainty_text

MIN_GAP_SHARE = 0.005  # smallest share of the gap of a location that is named
_MIN_RELATIVE_CHANGE = 0.1  # relative change from which a nominal parameter is named
_MAX_NAMED = 5  # number of named parameters, the most significant changes first, and of named events and places
_FEW_KINDS = 3  # most kinds of effects tried for which they are named, because more may exist
_IMMOVABLE_LOCATIONS = {"world", "clock", "camera", "object", "base"}  # locations that do not move by themselves
_LONGER_SEARCH = "To try the rest, remove diagnosis.budget, or raise it."
_ORIGIN_TEXTS = {
    "plant": "the mechanics (forces, stiffnesses, masses) or a recorded torque or angle that moves the model",
    "sensor": "a sensor, not the mechanics",
    "either": "the mechanics or the effort sensor (recorded efforts alone do not show which)",
}


def recommended_experiment_text(result: DiagnosisResult) -> str:
    """Recommend the next recording in one sentence, based on verdict, gap location and confusable effects."""
    rows = list[tuple[object, str]]()
    for rivals in (entry.equivalent_effects for entry in result.accepted_selected_effects):
        aspects = list(dict.fromkeys(effect.required_excitation for effect in rivals))
        places = list(dict.fromkeys(effect.location for effect in rivals))
        at = "".join([f" of {place}" for place in places if place not in _IMMOVABLE_LOCATIONS][:1])
        apart = f"Record one motion{at} in which these vary independently and widely: {', '.join(aspects)}."
        in_turn = f"Move {' and '.join(places)} one after the other, or measure a point between them."
        wider = f"Record a motion in which {aspects[0]}{at} varies over a wider range."
        end = f" This can separate these effects: {', '.join([effect.label for effect in rivals])}."
        rows += [(aspects[1:], apart + end), (places[1:], in_turn + end), (rivals[1:], wider + end)]
    sensors = {"camera", *(channel.rpartition(".")[0] for channel in result.noise_floor)}
    first = {name for place in _named_locations(result)[:1] for name in (place.location, *place.indistinguishable_from)}
    movable = ", ".join(sorted(first - sensors - _IMMOVABLE_LOCATIONS))
    faulty = ", ".join(sorted(first & sensors))
    check = f"Check stated noise, setup and clock of {faulty}. Faster and larger motions show more effects."
    most = f"Record slow and fast motions, with pauses, above all of {movable}."
    larger = "Check the stated noise. If it is right, record faster and larger motions, which show more effects."
    changed = "Find out what changed the parameters since the earlier runs."
    enough = "Nothing is needed for motions like these. Other motions may still show a gap."
    texts = {
        "insufficient_data": "Raise problem.duration if it is set, record longer motions, or free fewer parameters.",
        "unknown": _said((result.untried, _LONGER_SEARCH), (movable, most), (faulty, check), (True, larger))[0],
        "no_gap": _said((_changed(result), changed), (True, enough))[0],
        "confusable": "Record faster motions and other postures, to separate the effects from changed parameters.",
        "effect": "Record and diagnose other motions. The parameters of a right cause keep their values within ±.",
    }
    return _said(*rows, (True, texts[result.verdict]))[0]


def diagnosis_summary_text(result: DiagnosisResult) -> str:
    """Summarise a diagnosis in lines: may the model be used, is there a gap and why, and what else matters."""
    step, since = result.stated_and_used_time_step[1], result.baseline_comparison
    text = [_lead(result), *(found for found, _ in _pushes(result))]
    text += {"insufficient_data": [], "no_gap": _why_no_gap(result)}.get(result.verdict, _why_gap(result))
    text += [] if result.law is None else [result.law.sentence]
    text += [*(cut.sentence(step) for cut in result.truncated_recordings), *_bound_by_priors(result)]
    text += [] if since is None else since.sentences(has_rivals=bool(result.rival_shifts))
    text += [] if result.counterfactual is None else result.counterfactual.sentences
    text += [note for note, _ in _notes(result)]
    return "\n".join([*text, *result.events.overspeed_sentences(result.thresholds.max_joint_speed)])


def next_step_texts(result: DiagnosisResult) -> tuple[str, ...]:
    """Return what to do next, in order; the recommended experiment comes last."""
    advice = (step for _, step in (*_notes(result), *_pushes(result)))
    return tuple(dict.fromkeys([*filter(None, advice), result.next_experiment]))


def _changed(result: DiagnosisResult) -> bool:
    """Whether a parameter changed significantly since the earlier runs."""
    since = result.baseline_comparison
    return since is not None and bool(since.significant_parameter_shifts)


def _short(number: float) -> str:
    return f"{number:.3g}" if number < 1000 else f"{number:.0f}"


def _lead(result: DiagnosisResult) -> str:
    """Whether a model may be used, whether there is a gap, and the most probable cause."""
    tests, limits = (result.nominal_test, result.nominal_held_out_test), result.thresholds
    fitted, other = (_short(test.chi2_per_dof) for test in tests)
    sizes = f"chi2 per degree of freedom is {fitted} on fitted and {other} on held-out motions; noise alone gives 1"
    chance = f"p-value {p_value_text(min(test.p_value for test in tests), '= ')}"
    best, along = _best_candidate(result)
    large = f"Your model (the nominal model) has an error beyond noise (a gap): {sizes} ({chance})."
    small = f"In total the error of your model (the nominal model) is within noise: {sizes}. "
    small += f"But the error has the pattern of the effect {best} (p {p_value_text(along, '= ')})."
    gap = _said((null_test.residuals_exceed_noise(tests, limits.null_test_excess_criteria), large), (True, small))[0]
    unknowns, seen = len(result.nominal_model.values), [own.is_detectable for own in result.screening.detectability]
    shown = f"would reveal {sum(seen)} of {len(seen)} effects at their largest expected size"
    few = f"{tests[0].degrees_of_freedom:.0f} independent samples (more than {unknowns}, one per unknown, are needed)"
    beyond = ", but expect errors beyond noise" * (result.remaining_test.p_value < limits.significance_level)
    names = listed([effect.label for effect in result.accepted_effects])
    causes = " and ".join("".join(_said((own[1:], "one of "), (own, listed(own)))) for own in _rivals(result))
    probable = f"With {100 * result.probability:.0f} % probability, the true cause is {causes}."
    moved = listed([shift.text for shift in result.rival_shifts])
    since = f"With {100 * result.rival_probability:.0f} % probability, no effect is missing, but parameters have "
    since += f"changed since the baseline: {moved}."
    shares = sorted([(result.probability, probable), (result.rival_probability, since)], reverse=True)
    probable = " ".join(_said(*shares))
    use = "Use the model for motions like these."
    use = _said((_changed(result), "Parameters have changed since the earlier runs."), (True, use))[0]
    none = f"{use} There is no relevant gap: {sizes} ({chance}). The recordings {shown}."
    untested = {*result.untried}.intersection(*_rivals(result)[:1])
    why = _said(
        (untested, "the search ended before it had tested every probable cause"),
        (NEED_TEST in result.untried, "the search ended before it had tested whether every effect is needed"),
        (result.verdict == "effect", "the named cause is more likely wrong than right"),
        (True, "several causes explain the model's error about equally well"),
    )[0]
    not_yet = f"Do not use the estimates yet, because {why}."
    return {
        "insufficient_data": f"The model is not tested: the recordings have {few}, and {shown} (at least 1 is needed).",
        "no_gap": none + uncertainty.overstated_noise_sentence(*max((t.chi2_per_dof, t.p_value) for t in tests)),
        "unknown": f"Do not use the estimates, because the cause of the model's error is unknown. {gap}",
        "confusable": f"{not_yet} {probable} {gap}",
        "effect": _said((_is_provisional(result), not_yet), (True, f"Use the model with {names}{beyond}."))[0]
        + f" {probable} {gap}",
    }[result.verdict]


def _is_provisional(result: DiagnosisResult) -> bool:
    return is_provisional(result.verdict, result.probability, result.untried)


def _rivals(result: DiagnosisResult) -> list[list[str]]:
    return [[effect.label for effect in entry.equivalent_effects] for entry in result.accepted_selected_effects]


def _best_candidate(result: DiagnosisResult) -> tuple[str, float]:
    """Label of the candidate with the smallest p-value, and this value for as many tries as there are candidates."""
    scores = sorted(result.screening.candidate_scores, key=lambda own: own.p_value)
    best = "".join([score.effect.label for score in scores[:1]])
    return best, null_test.bonferroni_corrected_min_p_value([score.p_value for score in scores])


def _why_no_gap(result: DiagnosisResult) -> list[str]:
    """Sentences on why a significant residual does not count as a gap, and on effects that could be overlooked."""
    limits, tests = result.thresholds, (result.nominal_test, result.nominal_held_out_test)
    (best, along), least = _best_candidate(result), 1 + limits.min_excess_chi2_per_dof
    p_value = min(test.p_value for test in tests)
    level = limits.gap_significance_level / len(tests)
    small = (
        f"The error is larger than noise (p {p_value_text(p_value, '= ')}), but too small for a gap, which needs chi2 "
    )
    small += f"per degree of freedom above {least:.4g} and p below {level:.2g}."
    seen = f"The error has the pattern of {best} (p {p_value_text(along, '= ')} if there is only noise)"
    narrow = f"{seen}, but this effect was not accepted as a cause, so there is no gap."
    unseen = result.screening.undetectable_labels
    lines = _said((p_value < limits.significance_level, small)) + _hidden_changes(result)
    return lines + _said((along < limits.gap_significance_level, narrow), (unseen, unseen_effects_sentence(unseen)))


def _hidden_changes(result: DiagnosisResult) -> list[str]:
    """A line on found parameters that are wrong by more than 10 % beside an effect of a size that is not detectable."""
    fit, system, told = result.nominal_model, result.nominal_model.problem.system, list[tuple[float, str]]()
    offsets = {f"{frame}.{axis}" for frame in system.mechanism.frames for axis in "xyz"}
    for name in {*fit.problem.shared_parameters} - offsets:
        changes = ((own.hidden_changes.get(name, 0.0), own.effect.label) for own in result.screening.detectability)
        most, label = max(changes, default=(0.0, ""))
        size = abs(fit.values[name])  # beyond which a linear forecast of the change is meaningless
        limit = uncertainty.MAX_IDENTIFIABLE_RELATIVE_STD * size
        change = f"{name} by up to {_short(most)} {system.parameters[name].unit}".removesuffix(" 1")
        told += _said((fit.std[name] < limit < most < size, (limit / max(most, 1e-300), f"{change} ({label})")))
    hidden = "But an effect that is too small for these recordings to show may change found values by more than 10 %"
    return _said((told, f"{hidden}: {listed([text for _, text in sorted(told)], _MAX_NAMED)}."))


def _named_locations(result: DiagnosisResult) -> list[GapLocation]:
    return [place for place in result.gap_locations if place.gap_share >= MIN_GAP_SHARE][:_MAX_NAMED]


def _gap_locations_sentences(result: DiagnosisResult) -> str:
    """Sentences on the gap's locations, with inseparable ones together, and on its origin."""
    where = _named_locations(result)
    if not where:
        return "The recordings do not show in which part of the model or in which sensor the error arises."
    assert result.smoother_result is not None  # it found the locations
    origin = _ORIGIN_TEXTS.get(result.smoother_result.plant_or_sensor_origin, "")
    rest = 1 - sum(place.gap_share for place in where)
    groups = {channel.rpartition(".")[0] for channel in result.noise_floor}
    words = {group: f"the readings of {group}" for group in groups}
    alike = ([words.get(name, name) for name in (p.location, *p.indistinguishable_from)] for p in where)
    named = [f"{' or '.join(names)} ({100 * p.gap_share:.0f} %)" for p, names in zip(where, alike, strict=True)]
    named += _said((rest >= MIN_GAP_SHARE, f"elsewhere ({100 * rest:.0f} %)"))
    # the origin is said only if all places are on its side
    is_sensor = result.smoother_result.plant_or_sensor_origin == "sensor"
    sides = {name in {*groups, "camera", "clock"} for p in where for name in (p.location, *p.indistinguishable_from)}
    side = _said((origin and sides == {is_sensor}, f" Its origin is {origin}."))
    return f"The recordings attribute the error beyond noise to {', '.join(named)}.{''.join(side)}"


def _why_gap(result: DiagnosisResult) -> list[str]:
    """Sentences on where a gap lies, on the selected effects, and on the error that is left."""
    added, where = result.selected_effects, _gap_locations_sentences(result)
    if not added:
        return [where, *_remains(result)]
    names, total = listed([entry.effect.label for entry in added]), added[-1].cumulative_closure
    removed, of = f"Adding {names} removes", "of the error beyond noise on held-out motions"
    low, high = (f"{100 * end:.3g}" for end in (total.ci_low, total.ci_high))
    interval = f" (95 % interval {low} to {high} %)" * (low != high)
    unknown = f"{removed} an unknown part {of}, because the nominal model's error there is within noise."
    known = f"{removed} {100 * total.fraction:.3g} % {of}{interval}."
    closed = _said((math.isfinite(total.ci_low), known), (True, unknown))[0]
    sizes = [_named(entry.effect, added[-1].refitted_model, result.thresholds) for entry in added]
    return [where, closed, *sizes, *_remains(result)]


def _pushes(result: DiagnosisResult) -> list[tuple[str, str]]:
    """A sentence on brief disturbances, with one on what to do next, if there are any."""
    events = result.events.disturbances
    told = listed([event.text for event in events], max_entries=_MAX_NAMED)
    left_out = f"The tests leave out {count_with_noun(len(events), 'brief disturbance')}: {told}."
    check = "If you did not push the arm on purpose, look at the recordings at the times of the disturbances."
    return _said((events, (left_out, check * any(event.kind == "force" for event in events))))


def _notes(result: DiagnosisResult) -> list[tuple[str, str]]:
    """What limits the diagnosis, such as the reason to name no cause: sentences, each with one on what to do next."""
    scores, models = result.screening.candidate_scores, result.single_effect_models
    level = result.thresholds.gap_significance_level / max(len(scores), 1)
    kind = "".join([fit.effects[0].kind for fit in models[:1]])
    alike = [s.effect for s in scores if s.p_value < level and s.effect.kind == kind and not s.effect.is_local]
    places = listed([effect.location for effect in alike])
    several = f"{kind} is significant at several locations (p below {level:.2g}): {places}."
    add = f"Add {kind} at {places} under model.effects (friction: as `yid-ocp friction` advises), and repeat "
    limit = f"Not tried because of the time limit (diagnosis.budget: {result.thresholds.budget} s): "
    laws = listed([entry.effect.label for entry in result.selected_effects if entry.effect.is_joint_friction])
    other = f"The size of {laws} may contain other friction, such as viscous friction, that is not in the model."
    stated, used = (f"{step:.4g}" for step in result.stated_and_used_time_step)
    finer = f"Time steps of {stated} s are too long for these motions, so the diagnosis used {used} s."
    blocks = (
        "Every second block of time is held out, as recordings.held_out is empty. `solve` fits all: use its values."
    )
    links = "The model has too few links. The resulting error is not part of these numbers."
    fitted, problem = result.nominal_model.values, result.nominal_model.problem
    divided = problem.options.divided_links_model
    more_links = listed(divided.settings) if divided else ""
    channels = result.nominal_model.held_out_loss.channel_rmse, result.noise_floor
    tested, measured = (dict.fromkeys(name.rpartition(".")[0] for name in of) for of in channels)
    lost = listed([group for group in measured if group not in tested])
    other_channels = f"The held-out motions have no {lost}, so only {listed([*tested])} tests the model there."
    free = [(name, problem.system.parameters[name]) for name in problem.shared_parameters if fitted[name] != 0]
    at_bound = [name for name, entry in free if fitted[name] in (entry.lower, entry.upper)]
    ended = f"In the fit of the nominal model, {listed(at_bound)} ended at a bound. This can cause the error."
    widen = "Widen parameters.NAME.bounds of what ended at a bound, unless it is a physical limit, and repeat."
    return _said(
        (result.verdict != "no_gap" and at_bound, (ended, widen)),
        (result.unknown_reason, _reason(result)),
        (lost, (other_channels, f"Hold out a recording that has {lost}, too.")),
        (result.unknown_reason and alike[1:], (several, f"{add}`yid-ocp diagnose`.")),
        (result.untried, (f"{limit}{listed(result.untried)}.", _LONGER_SEARCH)),
        (laws, (other, "Compare friction laws by `yid-ocp friction`.")),
        (stated != used, (finer, f"For other commands, set problem.time_step: {used}.")),
        (result.is_split_in_blocks, (blocks, "")),
        (result.is_corrected_for_links, (links, f"For other commands, set {more_links}.")),
    )


def _reason(result: DiagnosisResult) -> tuple[str, str]:
    """Why no cause is named, and what to do about it."""
    limits, sizes = result.thresholds, result.undetermined_sizes(result.thresholds)
    (fitted, least), (closed, goal) = result.explained_and_required_fractions(limits)
    names, unsure = listed([entry.effect.label for entry in result.selected_effects]), listed([*sizes])
    few = f"{100 * fitted:.3g} % of the error on fitted motions (needed: {100 * least:.3g} %)"
    end = f" and {100 * closed:.3g} % on held-out ones (lower end of the interval; needed: {100 * goal:.3g} %)"
    stopped = "the time limit ended the search before the model was refitted with any effect"
    tried = f"no tried effect both has a size above {limits.min_z:g} times its ± and explains enough of the error"
    apart = "".join(f". By noise alone, {text}" for texts in sizes.values() for text in texts[:2])
    limit = f"with the remaining error in its ±, it is below {limits.min_z:g} times this ±"
    kinds = dict.fromkeys(score.effect.kind for score in result.screening.candidate_scores)
    more = f"Only these kinds could be tried: {', '.join(kinds)}. If diagnosis.candidates limits them, set it to all."
    more *= len(kinds) <= _FEW_KINDS
    again = f"If {unsure} changed between the recordings, diagnose them separately. Otherwise another cause acts."
    unlike = f"the error resembles no tried effect (the p-value of each is above {limits.significance_level:g})"
    failed = "every refit with an effect failed"
    alike = any(score.p_value < limits.significance_level for score in result.screening.candidate_scores)
    causes = (not alike, unlike), (result.untried, stopped), (True, failed)
    none = _said((result.single_effect_models, tried), *causes)[0]
    few += "".join(_said((math.isfinite(closed), end)))
    why, advice = {
        "none": (none, more),
        "little": (f"adding {names} explains only {few}", more),
        "stand_in": (f"the size of {unsure} is uncertain: {limit}{apart}", f"{again} {more}".strip()),
    }.get(result.unknown_reason, ("", ""))
    return f"No cause is named, because {why}.", advice


def _bound_by_priors(result: DiagnosisResult) -> list[str]:
    """A line on refitted effects whose amplitudes only the priors of nominal parameters determine, if there are any."""
    pairs, remedy = [], "To determine an effect, measure these parameters and fix them (parameters.NAME.free: false)."
    for fit in result.single_effect_models:
        assert isinstance(fit, RefittedModel)
        assert fit.evaluation.jacobian is not None
        at, own = fit.problem.residual_rows, fit.effects[-1]
        data, priors = (fit.evaluation.jacobian[part] for part in (at.data, at.stated_priors))
        names, shared = fit.problem.unknown_names, len(fit.problem.shared_parameters)  # which come first
        by = [mask_of_priors_determining_unknown(data, priors, names.index(n)) for n in own.amplitude_parameter_names]
        others = [*dict.fromkeys(names[i] for mask in by for i in np.flatnonzero(mask[:shared]))]
        pairs += _said((others, f"{own.label} from {listed(others)}"))
    return _said((pairs, f"These recordings cannot separate {'; '.join(pairs)}. {remedy}"))


def _named(effect: EffectBase, fit: RefitStatistics, limits: Thresholds) -> str:
    """Line with an effect's estimates, and warnings if one is far outside its range or no size is determined."""
    known = [*effect.to_reported_parameters(fit.values, fit.std).items()]
    texts = {name: f"{value_and_uncertainty_text(r.value, r.std, least_digits=3)} {r.unit}" for name, r in known}
    values = [f"{name} = {texts[name].removesuffix(' 1')}" for name, r in known if math.isfinite(r.std)]
    ranges = [effect.prior_ranges[name] for name in fit.implausible_parameters(effect, limits)[-1:] if values]
    far, so = "far outside the expected range of", "so possibly a substitute for another cause"
    odd = [f"{far} {low:.3g} to {high:.3g}, {so}" for low, high in ranges]
    unsure = _said((not fit.determines_size(effect, limits.min_z), "these recordings do not determine its size"))
    return f"  {effect.label}: {'; '.join([*filter(None, [', '.join(values)]), *odd, *unsure])}"


def _remains(result: DiagnosisResult) -> list[str]:
    """Sentences on the error that remains on held-out motions, and on what the effects change in the model."""
    noise = result.noise_floor
    errors = result.final_model.held_out_loss.channel_rmse.items()
    beyond = sorted((max(rms**2 - noise.get(name, 0.0) ** 2, 0.0), name, unit) for name, (rms, unit) in errors)
    shown = {"m": (1e3, "mm")}
    above = [own for own in beyond if own[0] > 0] or beyond
    sizes = ((*shown.get(unit, (1.0, unit)), math.sqrt(square), name) for square, name, unit in above)
    worst = {unit: f"{factor * size:.2g} {unit} at {name}" for factor, unit, size, name in sizes}
    effects, places = result.accepted_effects, [own.location for own in result.remaining_gap_locations[:1]]
    who = _said((effects, "the model with the effects"), (True, "the nominal model"))[0]
    is_left = result.remaining_test.p_value < result.thresholds.significance_level
    noisy = f"On held-out motions, noise and the uncertainty of the parameters explain the whole error of {who}."
    large = f"On held-out motions, the error of {who} is {', '.join(worst.values())} (rms, noise subtracted)."
    size = f"Its chi2 per degree of freedom there is {_short(result.remaining_test.chi2_per_dof)}."
    mostly = f"Most of this error comes from {''.join(places)}."
    said = _said((is_left, large), (not is_left, noisy), (effects, size), (is_left and effects and places, mostly))
    changes = list[tuple[float, str]]()
    for name, own in result.nominal_parameters_before_and_after.items():
        now = value_and_uncertainty_text(own["after"], own["std"], least_digits=3)
        text = f"{name} from {own['before']:.3g} to {now} {own['unit']}".removesuffix(" 1")
        least = max(own["std"], _MIN_RELATIVE_CHANGE * abs(own["before"]), 1e-9)
        changes.append((abs(own["after"] - own["before"]) / least, text))
    moved = listed([text for change, text in sorted(changes, key=lambda own: -own[0]) if change > 1], _MAX_NAMED)
    moved *= not _is_provisional(result)
    return [" ".join(said), *_said((moved, f"With the effects in the model, these estimates change: {moved}."))]

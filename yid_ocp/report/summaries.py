"""Summaries of the results of all commands, by result format, for the terminal and the HTML report."""

from __future__ import annotations

import math
import re
import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from yid_ocp.analysis.estimation import BASELINE_DESCRIPTIONS, channel_or_group_unit
from yid_ocp.display import abbreviated_names_text, count_with_noun, grouped
from yid_ocp.errors import FAILED_ROLLOUT_ADVICE
from yid_ocp.inference.uncertainty import (
    HOPELESS_CHI2,
    VERDICT_TABLE_TEXTS,
    goodness_of_fit_message,
    interval_text,
    percent_number_text,
    value_and_uncertainty_text,
)
from yid_ocp.report.terminal import (
    MAX_CHANNELS_SHOWN_SINGLY,
    MAX_NOISE_RATIO,
    SUMMARIES,
    SummaryBlockOrTextIterator,
    SummaryStatement,
    SummaryTable,
    TableRows,
    absent_parameters_sentence,
    advised_step,
    bound_range_text,
    copyable_estimates_blocks,
    discretisation_shift_sentences,
    is_at_bound,
    is_error,
    issue_descriptions,
    issue_summary_blocks,
    large_torque_offsets_sentence,
    misfit_summary_blocks,
    next_steps_table,
    scale_and_unit_with_metres_as_mm,
    setting_option,
    shown_unit,
    torque_offset_table,
    unused_efforts_sentence,
    value_text_and_display_unit,
)

_MAX_DIRECTIONS = 4  # combinations of parameters that `identifiability` lists; result.json has all
_MIN_NAMED_SHARE, _MAX_CHANGES = 0.1, 4  # of a combination: named parts over the largest one, and their number
_CLOSED_GAP = 1e-6  # largest distance of hand and object at a grasp that needs no words [m]


@SUMMARIES.register("yid-solve/1")
def _solve_summary(result: Mapping[str, Any]) -> SummaryBlockOrTextIterator:
    free = {name: entry for name, entry in result["parameters"].items() if entry["free"]}
    status, fit = result["status"], result["fit"]
    failed, converged = status == "failed", status == "converged"
    is_trusted, is_safe, mild = fit["data_trusted"], False, issue_descriptions(result, severe=False)
    yield from () if is_trusted else issue_summary_blocks(result)
    if converged:
        yield from misfit_summary_blocks(result, free)
        texts = [*result.get("refinement_notes", {}).values(), *_bound_sentences(free, fit["explains"])]
        if fit["explains"]:
            texts += _gap_sentences(result)
            is_safe = not texts
            said = goodness_of_fit_message(fit)
            causes = grouped((own["cause"], own["setting"] or "") for own in result.get("issues") or ())
            if "noise_overstated" in causes:
                said = "The stated noise is too large to test whether the model explains the recordings."
            still = " ".join(causes.get("weak_excitation", ()))
            texts += [*_found_and_lost(free, is_safe, mild, still), absent_parameters_sentence(free), said]
        yield from (SummaryStatement(text, "conclusion") for text in texts)
    else:
        said = "the fit failed" if failed else "the fit did not converge"
        chi2 = 0.0 if failed else (fit["chi2_per_dof"] or 0.0) * fit.get("noise_fraction", 1.0) ** 2
        is_hopeless = chi2 > HOPELESS_CHI2
        why = result["message"].partition(". Set solver.")[0] if is_hopeless else result["message"]
        said = f"Do not use the values, because {said}: {why.removesuffix('.')}."
        said += f" If a simulation failed, {FAILED_ROLLOUT_ADVICE}." * failed
        if is_hopeless:
            said += f" With {chi2:.0f} times the chi2 of the stated noise, first check units, signs and names."
        yield SummaryStatement(said, "conclusion")
    is_told = is_safe and any(entry["verdict"] == "identifiable" for entry in free.values())
    yield from issue_summary_blocks(result, with_verdict=not is_told) if is_trusted else ()
    heads = ("value" if converged else "last value", "± (std)", "95 % interval", "unit", "verdict", "bounds")
    rows: TableRows = [("parameter", *heads, "meaning")]
    for name, entry in free.items():
        verdict = entry["verdict"] if converged else ""
        value = value_and_uncertainty_text(entry["value"], entry["std"], least_digits=2).partition(" ±")[0]
        std = "infinite" if verdict == "weak" else ""
        if entry["std"] is not None:
            std = f"{entry['std']:.2g}"
        std *= verdict not in ("", "at_bound") and not is_at_bound(entry)
        interval = _interval_cell(entry, entry["std"]) if converged else ""
        value = "–" if verdict == "not_identifiable" or std == "infinite" else value
        said = VERDICT_TABLE_TEXTS[verdict] if converged else ""
        is_near_zero = verdict == "identifiable" and entry["std"] > 0.1 * abs(entry["value"])
        said += " (near zero)" * (converged and is_near_zero)
        more = (shown_unit(entry["unit"]), said, bound_range_text(entry, 4), entry.get("meaning", ""))
        rows.append((name, value, std, interval, *more))
    is_useless = not (converged or is_trusted)
    yield SummaryTable(rows, "Estimates of the free parameters", is_key_table=True, is_page_only=is_useless)
    yield from _fitted_error_blocks(result["residuals"], result["held_out"])
    yield from _held_out_blocks(result)
    yield torque_offset_table(result)
    yield large_torque_offsets_sentence(result)
    yield from discretisation_shift_sentences(result)[0]
    yield "" if failed else SummaryStatement(unused_efforts_sentence(result), "verdict")
    yield from copyable_estimates_blocks(result) if converged else ()
    yield result.get("safeguard", "")
    steps = count_with_noun(result["iterations"], "iteration") + " in all starts" * (status == "iteration_limit")
    yield next_steps_table(result, _steps_after_solve(result, free))
    ended = "the search converged" if converged else status.replace("_", " ")
    yield f"End of the fit: {ended} after {steps} ({result['seconds']:.1f} s)."


def _steps_after_solve(result: Mapping[str, Any], free: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Return the commands that help after a fit, by purpose."""
    if result["status"] != "converged":
        asked = re.search(r"Set (solver\.max_iterations): (\d+)", result["message"] * result["fit"]["data_trusted"])
        more = "estimate with more iterations"
        return advised_step(more, f"solve --set {asked[1]}={asked[2]}", result) if asked else {}
    issues, lost = result.get("issues") or (), _names_by_verdict(free)["not_identifiable"]
    notes, cures = result.get("refinement_notes", {}), discretisation_shift_sentences(result)[1]
    cures += (text for key, own in result.get("finer_settings", {}).items() if key in notes for text in own)
    finer = " ".join(["solve", *map(setting_option, dict.fromkeys(cures))])
    explains, is_trusted = result["fit"]["explains"], result["fit"]["data_trusted"]
    steps = {"estimate again with the finer model": finer} if cures and (explains or notes) else {}
    if any(own["severity"] != "warning" and "yid-ocp diagnose" in own["advice"] for own in issues):
        steps["find what the model lacks, as advised above"] = "diagnose"
    steps |= advised_step("estimate again", "solve", result) if any(map(is_error, issues)) else {}
    if is_trusted and not explains:
        steps["find the cause of the model's error"] = "diagnose"
    elif is_trusted and len(lost) < len(free):
        efforts = " --set sensors.joints.effort.use=true" * bool(result.get("unused_efforts"))
        steps["test whether the model lacks an effect"] = f"diagnose{efforts}"
    if lost and explains:
        steps["rank experiments that determine the missing parameters (takes minutes)"] = "identifiability --what-if"
    weak = [own for own in free.values() if own["verdict"] == "weak" and not own.get("prior_std")]
    if any(own["interval"] is None for own in weak):
        steps["compute the intervals exactly"] = "identifiability --intervals all"
    return steps


def _names_by_verdict(parameters: Mapping[str, Mapping[str, Any]]) -> dict[str, list[str]]:
    return {v: [name for name, own in parameters.items() if own["verdict"] == v] for v in VERDICT_TABLE_TEXTS}


def _interval_cell(entry: Mapping[str, Any], std: float | None) -> str:
    """Return the 95 % interval of an estimate as text, else value ± 1.96 std within its bounds, empty if unknown."""
    if entry["interval"] is not None:
        return interval_text(*entry["interval"])
    if std is None or entry["verdict"] == "not_identifiable":
        return ""
    lower, upper = (entry.get(key) for key in ("lower", "upper"))
    low, high = entry["value"] - 1.96 * std, entry["value"] + 1.96 * std
    return interval_text(low if lower is None else max(low, lower), high if upper is None else min(high, upper))


def _gap_sentences(result: Mapping[str, Any]) -> Iterator[str]:
    """Yield a sentence for each group of channels whose held-out error is over twice that of noise."""
    residuals = result["residuals"]
    advice = "run `yid-ocp diagnose`" if result["fit"]["data_trusted"] else "follow the advice on the issues"
    for group, channels in grouped((channel.rpartition(".")[0], channel) for channel in residuals).items():
        entries = [entry for entry in result["held_out"] if set(channels) <= set(entry["rmse"])]
        told = ([e[key][c] for e in entries for c in channels if c in e.get(key, {})] for key in ("rmse", "expected"))
        error, noise = map(_rms, told)
        if error and noise and error > MAX_NOISE_RATIO * noise:
            unit = residuals[channels[0]]["unit"]
            held, alone = (" ".join(value_text_and_display_unit(x, unit)) for x in (error, noise))
            text = f"{group} shows a gap: its held-out rms error is {held}, and noise alone gives {alone}."
            yield f"{text} Before you use any value, {advice}."


def _rms(values: Sequence[float]) -> float | None:
    return math.sqrt(statistics.fmean(x**2 for x in values)) if values else None


def _fitted_error_blocks(
    residuals: Mapping[str, Mapping[str, Any]], held_out: Sequence[Mapping[str, Any]]
) -> SummaryBlockOrTextIterator:
    """Yield fit errors of each channel, by the model, noise alone and baselines. `held_out` has errors of others."""
    guesses = (f"without model: {words}" for words in BASELINE_DESCRIPTIONS.values())
    rows: TableRows = [("channel", "model", "noise alone", *guesses, "unit", "used samples")]
    over_noise, over_guess = list[float](), list[float]()
    for name, entry in residuals.items():
        known = [entry.get("baselines", {}).get(guess) for guess in BASELINE_DESCRIPTIONS]
        sizes = entry["rmse"], entry.get("expected"), *known
        cells = (value_text_and_display_unit(size, entry["unit"])[0] * (size is not None) for size in sizes)
        rows.append((name, *cells, scale_and_unit_with_metres_as_mm(entry["unit"])[1], str(entry["n"])))
        over_noise += [entry["rmse"] / entry["expected"]] if entry.get("expected") else []
        over_guess += [entry["rmse"] / min(filter(None, known))] if any(known) else []
    is_aside = any(entry["rmse"] for entry in held_out)
    yield SummaryTable(rows, "Errors (rms) on fitted recordings; of points: of the distance", is_page_only=is_aside)
    said = [f"{max(over_noise):.2g} times that of noise alone"] if over_noise else []
    said += [f"{percent_number_text(max(over_guess))} % of that without a model"] if over_guess else []
    text = f"The model's error on fitted recordings is at most {' and '.join(said)}. No recording is held out "
    yield f"{text}(recordings.held_out), so errors on other motions are unknown." if said and not held_out else ""


def _held_out_blocks(result: Mapping[str, Any]) -> SummaryBlockOrTextIterator:
    """Yield held-out errors of each shown channel and recording, by the model, noise alone and baselines."""
    units = {channel: entry["unit"] for channel, entry in result["residuals"].items()}
    named = list(dict.fromkeys(name for entry in result["held_out"] for name, own in entry["baselines"].items() if own))
    guesses = (f"without model: {BASELINE_DESCRIPTIONS.get(name, name)}" for name in named)
    rows: TableRows = [("recording", "channel", "model", "noise alone", *guesses, "unit")]
    for entry in result["held_out"]:
        for channel in _shown_channels(entry["rmse"]):
            unit, noise = channel_or_group_unit(units, channel), entry.get("expected", {}).get(channel)
            errors = (entry["rmse"][channel], noise, *(entry["baselines"].get(name, {}).get(channel) for name in named))
            cells = (value_text_and_display_unit(error, unit)[0] for error in errors)
            rows.append((entry["recording"], channel, *cells, scale_and_unit_with_metres_as_mm(unit)[1]))
    failed = ((entry["recording"], entry["message"]) for entry in result["held_out"] if "message" in entry)
    do = f" If its motion grew, {FAILED_ROLLOUT_ADVICE}." * (result["status"] != "failed")
    yield from (f"The held-out recording '{name}' could not be predicted, because {why}.{do}" for name, why in failed)
    yield SummaryTable(rows, "Errors (rms) on held-out recordings, which the fit does not use")
    known = [(e["rmse"].get(c), x) for e in result["held_out"] for c, x in e.get("expected", {}).items()]
    said = "No error exceeds twice that of noise alone"
    said += ", so the model predicts them well." if result["status"] == "converged" else "."
    if not result["fit"]["explains"] or any(error > MAX_NOISE_RATIO * x for error, x in known if error and x):
        said = "An error above twice that of noise alone shows an error of the model"
        said += "." if result["status"] == "converged" else ", or of values whose search has not ended."
    said += " Noise alone includes expected errors of torques, sensors and clocks."
    levels = result.get("sensor_noise", {})
    moved = {c: x for e in result["held_out"] for c, x in e.get("expected", {}).items() if x > 2 * levels.get(c, x)}
    if moved:
        channel = max(moved, key=lambda name: moved[name] / levels[name])
        unit = channel_or_group_unit(units, channel)
        whole, own = (" ".join(value_text_and_display_unit(x[channel], unit)) for x in (moved, levels))
        said += " Errors of the recorded torques and angles carry the model away: "
        said += f"noise alone gives {whole} at {channel}, of which the sensor causes {own}."
    yield said if known else ""


def _shown_channels(errors: Mapping[str, float]) -> list[str]:
    """Return the channels to show: a large group as one entry, the members of a small group one by one."""
    hidden: set[str] = set()
    for group in errors:
        members = {channel for channel in errors if channel.startswith(f"{group}.")}
        if len(members) > MAX_CHANNELS_SHOWN_SINGLY:
            hidden |= members
        elif members:
            hidden.add(group)
    return [channel for channel in errors if channel not in hidden]


def _found_and_lost(free: Mapping[str, Mapping[str, Any]], is_safe: bool, mild: str, still: str) -> Iterator[str]:
    """Yield sentences on parameters by verdict. `still` has settings that fix parameters of joints that hardly move."""
    found, weak, lost = (_names_by_verdict(free)[v] for v in ("identifiable", "weak", "not_identifiable"))
    if found:
        names = abbreviated_names_text(found)
        text = f"{len(found)} of {len(free)} free parameters are found: their ± (one standard deviation) is at most "
        near = ", or of a typical value near zero" * any(free[n]["std"] > 0.1 * abs(free[n]["value"]) for n in found)
        text += f"10 % of the value{near}"
        once = f", once you have checked the issues below ({mild})" if mild else ""
        yield f"You can use these values{once}: {names}. {text}." if is_safe else f"{text} ({names})."
    if lost:
        none = "Use no value. " * (len(lost) == len(free))
        causes = [name + " (motion too weak)" * (f"parameters.{name}.free" in still) for name in lost]
        do = "`yid-ocp identifiability` shows why, and with --what-if it ranks experiments that do."
        yield f"{none}These recordings do not determine {abbreviated_names_text(causes)}. {do}"
    if weak:
        corrections = [name for name in weak if free[name].get("prior_std") and free[name]["initial"] == 0]
        others = [name for name in weak if name not in corrections]
        rough = ", which are rough" * any(free[name]["interval"] is None for name in others)
        text = f"Only weakly determined (± above 10 %): {abbreviated_names_text(others)}."
        yield f"{text} Use their 95 % intervals{rough}." if others else ""
        text = f"Corrections that are not known to within 10 %: {abbreviated_names_text(corrections)}."
        yield f"{text} The ± of the found values includes this." if corrections else ""


def _bound_sentences(free: Mapping[str, Mapping[str, Any]], explains: bool) -> Iterator[str]:
    """Yield a sentence for each bound at which estimates ended. Estimates at bounds of the same size share one.

    Without the estimates of `absent_parameters_sentence` if the model explains the recordings.
    """
    by_bound = dict[tuple[str, str], list[str]]()
    for name, entry in free.items():
        for side in ("lower", "upper"):
            if is_at_bound(entry, (side,)) and (entry[side] != 0 or not explains):
                bound = f"{side} bound of {entry[side]:.4g} {entry['unit']}".removesuffix(" 1")
                remedy = "Widen parameters.{0}.bounds, or fix {0} there if the bound is a physical limit."
                if entry[side] == 0:
                    remedy = "The model's error can be the cause."
                elif entry["verdict"] == "not_identifiable" and explains:
                    remedy = "Fix {0} at a known value, because these recordings do not determine it."
                by_bound.setdefault((bound, remedy), []).append(name)
    for (bound, remedy), names in by_bound.items():
        what, own = f"{abbreviated_names_text(names)} ended at the {bound}", names[0] if len(names) == 1 else "NAME"
        said = ", so values beyond it were not tried and the other values may be wrong" if explains else ""
        yield f"{what}{said}. {remedy.format(own)}"


@SUMMARIES.register("yid-identifiability/1")
def _identifiability_summary(result: Mapping[str, Any]) -> SummaryBlockOrTextIterator:
    parameters: Mapping[str, Any] = result["parameters"]
    if not parameters:
        said = f"There is nothing to analyse, because the fit ended as {result['status']} ({result['message']})."
        yield SummaryStatement(said, "verdict")
        return
    is_initial = result["at"] == "initial"
    interval_head = "95 % interval" if result["profiles"] else "95 % interval (approximate)"
    head = "initial value" if is_initial else "value"
    rows: TableRows = [("parameter", head, "unit", "± [% of the value]", interval_head, "verdict")]
    for name, entry in parameters.items():
        std = entry["std_relative"]
        spread, absolute = "infinite", None
        if std is not None:
            spread, absolute = f"{100 * std:.3g}" if std < 9.995 else "above 1000", entry["std"]
            spread = spread if entry["value"] else f"{absolute:.2g} {entry['unit']}"
        is_stopped = is_at_bound(entry) and not is_initial
        interval = _interval_cell(entry, None if is_initial or is_stopped else absolute)
        value = value_and_uncertainty_text(entry["value"], None, verdict=None if is_initial else entry["verdict"])
        spread *= not is_stopped
        said = "would be " * (is_initial and entry["verdict"] in ("identifiable", "weak"))
        said += VERDICT_TABLE_TEXTS[entry["verdict"]]
        rows.append((name, value, shown_unit(entry["unit"]), spread, interval, said))
    yield from () if result["fit"] is None else misfit_summary_blocks(result, parameters)
    found, weak, lost = (_names_by_verdict(parameters)[v] for v in ("identifiable", "weak", "not_identifiable"))
    verb = "are expected to be" if is_initial else "can be"
    said = f"{len(found)} of {len(parameters)} parameters {verb} determined by these recordings to within 10 %"
    said += f": {abbreviated_names_text(found)}" * bool(found)
    failed = "Do not use the values, because the fit did not converge. At these values, "
    failed *= result["status"] not in ("converged", "not_solved")
    start = "No fit was made: at the initial values, " * is_initial
    open_directions = [own for own in result["directions"] if own["verdict"] != "identifiable"]
    together = [(own, names) for own in open_directions if len(names := _changed_names(own)) > 1]
    told = [name for own, names in together if own["verdict"] == "not_identifiable" for name in names]
    rest = abbreviated_names_text([name for name in weak if name not in told])
    doubt = f" Only weakly determined (± above 10 %): {rest}." * bool(rest)
    yield SummaryStatement(f"{failed}{start}{said}.{doubt}", "conclusion")
    asked = result["what_if"]
    answer, *details = _what_if_blocks(asked, len(parameters)) if asked else ("",)
    yield answer
    allowed = ["unknown initial states"] * (result.get("start") == "unknown")
    if (std := result.get("grasp_std")) is not None:
        allowed.append(f"grasps that are displaced by {1e3 * std:g} mm (one standard deviation)")
    yield SummaryStatement(f"The ± and verdicts allow for {' and '.join(allowed)}." if allowed else "", "verdict")
    yield from issue_summary_blocks(result)
    hidden = [own for own in result["directions"] if own["verdict"] == "not_identifiable"]
    unobserved = {own["unobserved_parameter"] for own in hidden}
    unseen = [name for name in parameters if name in unobserved]
    yield f"Near these values, the readings hardly depend on {', '.join(unseen)}." if unseen else ""
    hidden = [own for own in hidden if not own["unobserved_parameter"]]  # the table has those of one parameter
    for cause, alike in grouped((own["hidden_by"] or own["words"], own) for own in hidden[:_MAX_DIRECTIONS]).items():
        changes = ", or ".join(own["hidden_change"] for own in alike)
        yield f"These recordings cannot distinguish {changes} from {cause}." if changes else f"{cause}."
    yield SummaryTable(rows, "Parameters (± is one standard deviation)", is_key_table=True)
    is_poor = result["fit"] is not None and not result["fit"]["explains"]
    loose = [(own, names[:_MAX_CHANGES]) for own, names in together if own["verdict"] == "weak"]
    said = "Some parameters can replace each other: the recordings hardly change if all parameters of a line change "
    said += "together, as stated in % of their values. Measure the first one in another way and fix it."
    yield said if loose else ""
    texts = (", ".join(_change_text(n, own, parameters[n]) for n in names) for own, names in loose[:_MAX_DIRECTIONS])
    rows = [("changes together (one standard deviation)",), *((text,) for text in texts)]
    yield SummaryTable(rows, "Changes that the recordings hardly show")
    if (left := len(hidden[_MAX_DIRECTIONS:]) + len(loose[_MAX_DIRECTIONS:])) > 0:
        yield f"{left} more combinations of parameters are in result.json (`directions`)."
    yield from (f"For {name}, {note}." for name, entry in result["profiles"].items() for note in entry["notes"])
    yield from details
    only_known = [name for name in found if parameters[name]["verdict_unknown"] != "identifiable"]
    said = f"With unknown initial states and grasps (if any), these would not be found: {', '.join(only_known)}."
    yield SummaryStatement(said if only_known else "", "verdict")
    flags = " --unknown-grasp" * (result.get("grasp_std") is not None)
    flags += " --unknown-start" * (result.get("start") == "unknown")
    steps = (
        {"fit first, and judge at the fit (without --initial)": f"identifiability{flags}"}
        if is_initial and (found or weak)
        else {}
    )
    steps |= {"find the cause of the model's error": "diagnose"} if is_poor and result["fit"]["data_trusted"] else {}
    more = {"compute exact intervals, which may be asymmetric": f"identifiability --intervals all{flags}"}
    steps |= {} if is_initial or result["profiles"] else more
    if weak or lost:
        if asked and asked["smallest"]:
            best = asked["smallest"][0]
            has_new_points = any(change.partition(":")[0] in ("camera", "arm") for change in best["changes"])
            points = result.get("groups_with_chosen_points", ()) if has_new_points else ()
            options = "".join(f" --set sensors.{group}.used_points=null" for group in points)
            why = f"estimate from FILE, a recording with {best['words']}"
            steps[why] = f"solve --set 'recordings.estimate=[FILE]'{options}"
        # springs in series need more markers
        elif result.get("can_plan_motion") and not any("springs in series" in own["words"] for own in hidden):
            steps["plan a motion that determines more"] = "plan --set plan.goal=information"
        for _, names in sorted(together, key=lambda pair: pair[0]["verdict"] != "weak")[:1]:  # a text asks to fix it
            options = f"--set parameters.{names[0]}.free=false --set parameters.{names[0]}.initial=VALUE"
            steps["fix a parameter whose VALUE is known"] = f"solve {options}"
        steps |= {} if asked else {"rank other experiments (takes minutes)": f"identifiability --what-if{flags}"}
    yield next_steps_table(result, steps)


def _what_if_blocks(asked: Mapping[str, Any], count: int) -> SummaryBlockOrTextIterator:
    """Yield a statement on the best change of an experiment with `count` parameters, a table of all and their notes."""
    base, smallest = asked["base"], asked["smallest"]
    changes = {own["words"]: own for own in (base, *smallest, *asked["singles"])}
    known = {} if base["gain"] is None else {n: e["gain"] for n, e in changes.items() if e["gain"] is not None}
    ratios = {n: percent_number_text(math.exp((base["gain"] - gain) / count)) for n, gain in known.items()}
    said = "No set of up to three changes makes it possible to find all parameters."
    if base in smallest:
        best = max(known, key=lambda words: known[words])
        said = f"The ± becomes smallest with: {best} (mean ± {ratios[best]} % of that now)."
    elif smallest:
        said = f"All parameters would be found with: {smallest[0]['words']}."
    yield SummaryStatement(said, "verdict")
    rows: TableRows = [("change", "parameters found", "mean ± [% of that now]")]
    for words, entry in changes.items():
        found = f"{entry['identifiable']} of {count}" if entry["gain"] is not None else "unknown"
        rows.append((words, found, ratios.get(words, "")))
    yield SummaryTable(rows, "What another experiment would find (each parameter is assumed known to 400 %)")
    yield from (f"Note on '{words}': {own['message']}." for words, own in changes.items() if own["message"])


def _changed_names(direction: Mapping[str, Any]) -> list[str]:
    """Return the parameters that change along a direction, the largest change first."""
    parts = direction["components"]
    order = sorted(parts, key=lambda name: -abs(parts[name]))
    return [name for name in order if abs(parts[name]) > _MIN_NAMED_SHARE * abs(parts[order[0]])]


def _change_text(name: str, direction: Mapping[str, Any], entry: Mapping[str, Any]) -> str:
    """Return a parameter's change along a direction in % of its value, or in its unit if the value is zero."""
    relative = direction["std_relative"] * direction["components"][name]
    if entry["value"] or entry["std"] is None:
        return f"{name} {100 * relative:+.3g} %{'' if entry['value'] else ' of its typical size'}"
    return f"{name} {relative * entry['std'] / entry['std_relative']:+.2g} {entry['unit']}"


@SUMMARIES.register("yid-plan/1")
def _plan_summary(result: Mapping[str, Any]) -> SummaryBlockOrTextIterator:
    message, is_usable = result["message"], result["goal"] == "information" or result["unfinished"]
    done = f"{message[0].upper()}{message[1:]}. trajectory.json has it for the robot."
    said = f"{'Not finished' if is_usable else 'Do not use this motion'}: {message}."
    said = done if result["status"] == "done" else said
    sought = result.get("parameters", {}).values()
    if is_hopeless := bool(sought) and all(own["verdict"] == "not_identifiable" for own in sought):
        said = "Do not use this motion, because none of the parameters can be found from it."
    yield SummaryStatement(said, "conclusion")
    parts = _information_parts(result) if result["goal"] == "information" else _place_parts(result)
    yield from (SummaryStatement(part, "verdict") if isinstance(part, str) else part for part in parts)
    rows: TableRows = [("joint", "travel [rad, or m]", "largest speed [% of limit]", "largest effort [% of limit]")]
    for name, own in result["joints"].items():
        travel = own["travel"] if own["travel"] > 1e-9 else 0.0
        shares = ("" if own[key] is None else percent_number_text(own[key]) for key in ("velocity", "effort"))
        rows.append((name, f"{travel:.3g}", *shares))
    yield SummaryTable(rows, "Motion and effort of the joints", is_key_table=True)
    steps = {"plan with estimated values (RUN: run folder of solve)": "plan --set plan.parameter_run_folder=RUN"}
    longer = {"try twice the duration": f"plan --set plan.duration={2 * result['duration']:g}"}
    record = {"estimate from FILE, a recording of this motion": "solve --set 'recordings.estimate=[FILE]'"}
    if result.get("distances"):
        record = {"diagnose FILE, a recording of this motion": "diagnose --set 'recordings.estimate=[FILE]'"}
    if is_hopeless:
        record = {"rank other experiments (takes minutes)": "identifiability --what-if"}
    steps = {} if result["from"]["run"] or is_hopeless else steps
    steps |= record if result["goal"] == "information" else {}
    yield next_steps_table(result, longer if not is_usable and result["status"] != "done" else steps)


def _place_parts(result: Mapping[str, Any]) -> SummaryBlockOrTextIterator:
    if result["error"] is None or result["swing"] is None:
        yield "Do not use this motion, because the model cannot simulate it to its end."
        return
    place, limit = ", ".join(f"{x:.4g}" for x in result["place"]), f"{1e3 * result['tolerance']:g}"
    near = (limit, "plan.position_tolerance", "mm")
    yield f"The point '{result['point']}' has the target ({place}) m in the world after {result['duration']:g} s."
    fastest = (f"{1e3 * result['speed_tolerance']:g}", "plan.point_rest_speed_tolerance", "mm/s")
    rows: TableRows = [("quantity", "predicted", "limit", "setting of the limit", "unit")]
    rows.append(("largest distance of the point from the target", f"{1e3 * result['error']:.3g}", *near))
    rows.append(("largest speed of any point of the object", f"{1e3 * result['swing']:.3g}", *fastest))
    if result["off_path"] is not None:
        rows.append(("largest distance from the path, in the motion", f"{1e3 * result['off_path']:.3g}", "", "", "mm"))
    for axis, std in zip("xyz", result["std"] or (), strict=False):
        rows.append((f"std of the position in {axis}, from uncertain parameters", f"{1e3 * std:.2g}", *near))
    yield SummaryTable(rows, f"Prediction of the model for the {result['settle']:g} s after the motion")
    if result["std"] is not None:
        miss = "The real object may miss the target, because the parameters are too uncertain."
        yield miss if max(result["std"]) > result["tolerance"] else ""
        if lost := result["from"]["uncertainty_unknown"]:
            yield f"This ignores parameters whose uncertainty is unknown: {', '.join(lost)}."
    elif result["from"]["run"] is None:
        yield "The real object may miss the target, because the plan uses initial values, not estimates."


def _information_parts(result: Mapping[str, Any]) -> SummaryBlockOrTextIterator:
    rows: TableRows = [("parameter", "from the recordings", "from this motion", "from both", "verdict of this motion")]
    for name, own in result["parameters"].items():
        stds = (own[f"std_relative_{when}"] for when in ("before", "after", "together"))
        cells = ("unknown" if std is None else f"{percent_number_text(std)} %" for std in stds)
        rows.append((name, *cells, VERDICT_TABLE_TEXTS[own["verdict"]]))
    found = [name for name, own in result["parameters"].items() if own["verdict"] == "identifiable"]
    count, names = f"{len(found)} of {len(result['parameters'])} parameters", abbreviated_names_text(found)
    said = f"would determine {count} to within 10 % of their value: {names}"
    said = said if found else "alone would determine no parameter to within 10 % of its value"
    small = {name for name, own in result["parameters"].items() if (own["std_relative_together"] or 1.0) <= 0.1}
    more = abbreviated_names_text(sorted(small.difference(found)))
    both = f" Together with the existing recordings, it would also determine {more}." if more else ""
    yield f"A recording of this motion {said}.{both}"
    yield SummaryTable(rows, "Expected standard deviation, in % of the value")
    rows = [("effect", "compared with", "difference in the recordings / noise", "difference in this motion / noise")]
    for own in result["distances"]:
        rows.append((own["effect"], own["explained_by"], *(f"{own[when]:.3g}" for when in ("before", "after"))))
    yield SummaryTable(rows, "How well two effects can be told apart")
    reached = [f"{k.partition(' [')[0]} of {', '.join(n)}" for k, n in result["limits_reached"].items()]
    text = f"these limits, and exceeds none: {', '.join(reached)}" if reached else "none of its limits"
    yield f"The motion reaches {text}."
    for words, unobserved in grouped((words, name) for name, words in result["unseen"].items()).items():
        yield f"No motion that was tried lets a sensor observe {', '.join(unobserved)}. For this, {words}."
    yield from (f"This motion leaves open: {words}." for words in result["open"])
    text = (
        "The forecast uses the initial values of the configuration. For estimates, set plan.parameter_run_folder: RUN."
    )
    yield text if result["from"]["run"] is None else ""


@SUMMARIES.register("yid-check/1")
def _check_summary(result: Mapping[str, Any]) -> SummaryBlockOrTextIterator:
    warnings, coarse = result["warnings"], result["convergence"]["warnings"]
    severe, mild = (issue_descriptions(result, severe=own) for own in (True, False))
    is_advised = bool(severe or result.get("issues") or warnings)
    ended, step = "No problem was found. `solve` can run.", "estimate the free parameters"
    if not result["recordings"]:
        ended = "No problem was found in the model. `solve` and `diagnose` need recordings (recordings.estimate)."
    if severe:
        ended = f"Do not run `solve` yet, because its values would be unusable: {severe}. Follow the advice below."
    elif is_advised:
        ended = (
            f"`solve` can run, but may fail or give wrong values. Read the {'issues' if mild else 'warnings'} below."
        )
    elif coarse:
        ended = "`solve` can run. The simulation may be too coarse (warnings below)."
    ended += " Because of `--strict`, they end `check` with exit code 2." * bool(result.get("refused"))
    yield SummaryStatement(ended, "conclusion")
    yield from issue_summary_blocks(result, with_verdict=False)
    alike = dict[str, list[str]]()  # names of the recordings by warning
    for text in (*coarse, *warnings):
        name, _, what = text.rpartition("', ") if text.startswith("in '") else ("", "", text)
        alike.setdefault(what, []).extend([name.removeprefix("in '")] * bool(name))
    texts = (f"in {abbreviated_names_text(own)}, {what}" if own else what for what, own in alike.items())
    yield from (SummaryStatement(f"warning: {text}.", "verdict") for text in texts)
    agreed = " and ".join(entry["of"] for entry in result["mechanics"].values() if entry["agrees"])
    yield f"The library Pinocchio computes the same masses, inertias and kinematics for {agreed}." if agreed else ""
    rows: TableRows = [("recording", "use", "group", "samples", "median rate", "longest gap")]
    noise = dict[Sequence[str], list[str]]()  # names of the recordings by noise of a channel
    apart = dict[str, list[str]]()  # names of the recordings by gaps of their grasps
    for entry in result["recordings"]:
        use = "held out" if entry["role"] == "held_out" else "estimate"
        for name, group in entry["groups"].items():
            taken = (str(group["samples"]), f"{group['rate']:.4g} Hz", f"{group['longest_gap']:.3g} s")
            rows.append((entry["recording"], use, name, *taken))
        for cells in _noise_cells(entry["noise"], entry.get("noise_fraction", 1.0)):
            noise.setdefault(cells, []).append(entry["recording"])
        gaps = [f"'{name}' by {1e3 * gap:.2g} mm" for name, gap in entry["grasp_gaps"].items() if gap > _CLOSED_GAP]
        apart.setdefault(", ".join(gaps), []).append(f"'{entry['recording']}'")
    yield SummaryTable(rows, "Recordings", is_key_table=True)
    rows = [("channel", "noise (std; of points: per axis)", "constant error (std)", "source", "recordings")]
    rows += [(*cells, ", ".join(own) * (len(own) < len(result["recordings"]))) for cells, own in noise.items()]
    yield SummaryTable(rows, "Noise of the readings")
    told = ((text, abbreviated_names_text(names)) for text, names in apart.items() if text)
    yield from (f"At the start of {names}, hand and object are apart at grasp {text}." for text, names in told)
    convergence = result["convergence"]
    for key, head in (("links", "number of links"), ("time_step", "time step [s]")):
        count = max((len(row["hertz"]) for row in convergence[key]), default=0)
        rows = [(head, *(f"mode {i + 1}" for i in range(count)), "remark")]
        for row in convergence[key]:
            hertz = [f"{f:.4g}" for f in row["hertz"]]
            rows.append((f"{row['value']:g}", *hertz, *[""] * (count - len(hertz)), row["message"]))
        yield SummaryTable(rows, f"Lowest natural frequencies [Hz] of the simulation, by {head}", is_page_only=True)
    yield convergence["message"]
    solve = "solve" + " --set output.checked_discretisation=both" * bool(coarse)
    steps = advised_step(step, solve, result, other_advice=bool(warnings))
    yield next_steps_table(result, steps if result["recordings"] and not severe else {})


def _noise_cells(noise: Mapping[str, Any], share: float) -> Iterator[Sequence[str]]:
    """Yield channel, std of its noise (`share` of the stated one), std of a constant error and source, as cells."""
    for channel, known in noise.items():
        std, offset = (" ".join(value_text_and_display_unit(known.get(k), known["unit"])) for k in ("std", "bias_std"))
        source = "estimated" if known.get("estimated") else "stated"
        stated = known["std"]
        if share < 1 and stated is not None and "estimated" not in known:  # readings, not inputs
            stated /= share
            size = " ".join(value_text_and_display_unit(stated, known["unit"]))
            source = f"{share:g} times the stated {size} (diagnosis.noise_fraction_of_stated_std)"
        recorded = known.get("recorded_std")
        if recorded is not None and not math.isclose(recorded, stated or 0.0, rel_tol=0.01):
            size = " ".join(value_text_and_display_unit(recorded, known["unit"]))
            source += f" {size}, low-pass filtered, with the noise of the angles"
        if known["std"] is not None:
            yield channel, std, offset * bool(known.get("bias_std")), source

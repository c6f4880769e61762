"""Summaries of a diagnosis, a blind test, and a batch, and of comparisons of methods or runs."""

from __future__ import annotations

import shlex
import statistics
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from yid_ocp.analysis.estimation import channel_or_group_unit
from yid_ocp.diagnosis.thresholds import is_provisional
from yid_ocp.display import (
    abbreviated_names_text,
    count_with_noun,
    effect_entry_label,
    grouped,
    p_value_text,
    unseen_effects_sentence,
)
from yid_ocp.effects import EFFECTS
from yid_ocp.inference.uncertainty import VERDICT_TABLE_TEXTS, value_and_uncertainty_text
from yid_ocp.report.terminal import (
    MAX_NOISE_RATIO,
    SUMMARIES,
    CodeBlock,
    SummaryBlockOrTextIterator,
    SummaryStatement,
    SummaryTable,
    TableRows,
    copyable_estimates_blocks,
    issue_summary_blocks,
    large_torque_offsets_sentence,
    misfit_summary_blocks,
    next_steps_table,
    scale_and_unit_with_metres_as_mm,
    shown_unit,
    torque_offset_table,
    unused_efforts_sentence,
    value_text_and_display_unit,
)

_MAX_TERMINAL_PARAMETERS = 6  # largest number of parameters with a column on a terminal; result.json has all
_FOUND_VERDICTS = ("identifiable", "weak")
"""Verdicts of parameters whose values are shown."""
_MIN_STATED_PROBABILITIES = 10  # number of them from which they are compared with the outcomes
_MIN_CONCLUSIVE_CASES = 30  # cases of a blind test from which its numbers are shown without a warning
_SIGNAL_TEXTS = {"camera": "points of a camera", "nominal_clock": "times that count samples instead of reading a clock"}
_MAX_RUN_DIFFERENCE = 2  # difference of two runs above which a parameter is named [std]


@SUMMARIES.register("yid-diagnosis/2")
def _diagnose_summary(result: Mapping[str, Any]) -> SummaryBlockOrTextIterator:
    verdict = result["verdict"].replace("_", " ")
    gap, *others = result["summary"].split("\n")
    is_severe = any(own["severity"] != "warning" for own in result.get("issues", ()))
    is_open = is_provisional(verdict, result.get("probability", 1.0), result.get("untried", ()))
    head = "Verdict" + " (in doubt: correct the issues above and repeat)" * is_severe + " (provisional)" * is_open
    kinds = dict.fromkeys(own["kind"] for own in result.get("effects", ()) if own["kind"] in EFFECTS)
    meant = " ".join(f"{kind}: {(EFFECTS[kind].__doc__ or '').partition(chr(10))[0]}" for kind in kinds)
    yield from issue_summary_blocks(result) if is_severe else ()
    parts = f"{head}: {verdict}. {gap}", *others, unused_efforts_sentence(result), meant * (not is_open)
    yield from (SummaryStatement(part, "verdict") for part in parts)
    yield from () if is_severe else issue_summary_blocks(result)
    before, steps, noise = result["gap"]["before"], result.get("steps", ()), result["gap"].get("noise")
    added = (f"+ {step['added']}" for step in steps)
    rows: TableRows = [("channel", "nominal model", *added, *["sensor noise"] * bool(noise), "unit")]
    for channel, error in before["rmse"].items():
        errors = [error, *(step["rmse"].get(channel) for step in steps), *([noise.get(channel)] if noise else [])]
        shown = [value_text_and_display_unit(value, before["unit"][channel]) for value in errors]
        rows.append((channel, *(text for text, _ in shown), shown[0][1]))
    yield SummaryTable(rows, "Errors (rms) on held-out recordings", is_key_table=True)
    rows = [("channel", "recording", "from [s]", "to [s]", "peak", "unit", "impulse", "unit of the impulse")]
    for own in result.get("events", ()):
        peak, impulse = ("–" if own[key] is None else f"{own[key]:.3g}" for key in ("peak", "impulse"))
        impulse += f" ± {own['std']:.2g}" if own["impulse"] is not None and own["std"] is not None else ""
        times = ("–" if own[key] is None else f"{own[key]:.4g}" for key in ("from", "to"))
        rows.append((own["channel"], own["recording"], *times, peak, own["unit"], impulse, f"{own['unit']} s"))
    yield SummaryTable(rows, "Pushes and wrong samples", is_page_only=True)
    fitted = _candidate_rows(result, is_open)
    yield SummaryTable(fitted, "Effects that were fitted, and the part of the held-out error beyond noise each removes")
    possible = "Possible: not accepted yet, because another cause may explain the error as well."
    yield possible if any("possible" in row for row in fitted) else ""
    yield unseen_effects_sentence(result.get("unseen", ())) if verdict != "no gap" else ""
    missing = result.get("not_candidates", {}).items()
    lacking = [f"{', '.join(kinds)} ({_SIGNAL_TEXTS.get(signals, signals)})" for signals, kinds in missing]
    yield f"Not testable, because no recording has the signals in brackets: {'; '.join(lacking)}." if lacking else ""
    beside = " (with the effects)" if result.get("rival_changes", {}).get("parameters") else ""
    rows = [("parameter", "baseline", f"now{beside}", "unit", "change / its std", "verdict")]
    for name, entry in (result.get("baseline") or {"parameters": {}})["parameters"].items():
        values = (value_and_uncertainty_text(entry[when], entry[f"{when}_std"], None) for when in ("before", "now"))
        moved = "no information" if entry["score"] is None else f"{entry['score']:+.2g}"
        rows.append((name, *values, shown_unit(entry["unit"]), moved, "changed" if entry["changed"] else ""))
    yield SummaryTable(rows, "Changes since the baseline")
    rows = [("channel", "recorded", "nominal model", "model with effects removed or added", "unit")]
    for key, made in (("removed", "without the effects"), ("added", "with the effects")):
        for channel, entry in (result.get("counterfactual") or {}).get(key, {"rmse": {}})["rmse"].items():
            sizes = (f"{entry[part]:.3g}" for part in ("without_diagnosis", "counterfactual"))
            rows.append((channel, made, *sizes, entry["unit"]))
    yield SummaryTable(rows, "Errors (rms) on recordings made without and with the effects")
    yield torque_offset_table(result)
    yield large_torque_offsets_sentence(result)
    yield from () if is_open else copyable_estimates_blocks(result)
    to_do = result.get("next_steps", ())
    yield SummaryStatement(f"Do next: {to_do[0]}" if len(to_do) == 1 else "Do next:" * bool(to_do), "verdict")
    yield from (SummaryStatement(f"{i}. {step}", "verdict") for i, step in enumerate(to_do, 1) if to_do[1:])
    if result["next_plan"] is not None:
        yield "To separate the effects which these recordings cannot distinguish, plan a motion by this command:"
        known = result["next_plan"].items()
        texts = {key: f"[{', '.join(value)}]" if isinstance(value, list) else value for key, value in known}
        settings = (word for key, text in texts.items() for word in ("--set", f"plan.{key}={text}"))
        file = Path(texts["parameter_run_folder"]) / "config.yaml"
        yield CodeBlock(shlex.join(["yid-ocp", "plan", str(file), *settings]))


def _candidate_rows(result: Mapping[str, Any], is_open: bool) -> TableRows:
    """Return table rows of the candidates that were fitted or are possible causes."""
    rows: TableRows = [("effect", "parameters", "removed error", "p-value of forecast", "verdict")]
    chosen = "accepted" if result["verdict"] == "effect" and not is_open else "possible"
    verdicts = {effect_entry_label(own): "possible" for alike in result.get("confusable", ()) for own in alike}
    added = {effect_entry_label(own): chosen for own in result.get("effects", ())}
    verdicts |= added
    for entry in result["which"]:
        values = []
        for name, own in entry["parameters"].items():
            unit, value = "" if own["unit"] == "1" else f" {own['unit']}", own["value"]
            if value is not None and own["std"] is not None:
                values.append(f"{name} = {value_and_uncertainty_text(value, own['std'], least_digits=3)}{unit}")
            elif value is not None:
                shown = f"= {round(value, 12):.3g}{unit}" if entry["closure"] is None else "unknown"
                values.append(f"{name} {shown}")
        label = effect_entry_label(entry)
        ends = (p_value_text(entry["p_value"]), verdicts.get(label, ""))
        if entry["closure"] is not None:
            percent = f"{100 * abs(entry['closure']):.3g} %" if entry["closure"] > -10 else "over 1000 %"
            rows.append((label, ", ".join(values), "adds " * (entry["closure"] < 0) + percent, *ends))
        elif label in verdicts:
            how = "fitted beside others only" if label in added else "not fitted alone (values: forecast)"
            rows.append((label, ", ".join(values), how, *ends))
    return rows


@SUMMARIES.register("yid-blind/1")
def _blind_summary(result: Mapping[str, Any]) -> SummaryBlockOrTextIterator:
    *rates, cases = _blind_tables(result)
    yield from (SummaryStatement(text, "verdict") for text in _blind_sentences(result))
    is_conclusive = len(result["marks"]) >= _MIN_CONCLUSIVE_CASES
    yield from (replace(t, is_key_table=t is rates[0], is_page_only=not is_conclusive) for t in rates)
    yield replace(cases, is_page_only=is_conclusive)


def _blind_sentences(result: Mapping[str, Any]) -> Iterator[str]:
    """Yield sentences on cases, right answers, false alarms, overlooked effects and probabilities of a blind test."""
    count = len(result["marks"])
    yield f"The blind test has {count_with_noun(count, 'synthetic case')} (seed {result['seed']})."
    text = f"Draw no conclusion from so few: repeat the command with --cases {_MIN_CONCLUSIVE_CASES} and another --out."
    yield text if 0 < count < _MIN_CONCLUSIVE_CASES else ""
    right, of = (sum(own["right"][key] for own in result["experiments"].values()) for key in ("count", "of"))
    alarms, seen = (result["intervals"][key] for key in ("false_alarms", "detected"))
    yield f"Right answers: {right} of {count_with_noun(of, 'case')} with a hidden cause." if of else ""
    said = f"False alarms: {alarms['count']} of {count_with_noun(alarms['of'], 'case')} without an effect."
    yield said if alarms["of"] else ""
    missed = f"{seen['of'] - seen['count']} of {count_with_noun(seen['of'], 'case')} with one effect"
    yield f"Overlooked (no gap was reported): {missed}." if seen["of"] else ""
    stated = [own for own in result["calibration"]["probabilities"] if own["of"]]
    if sum(own["of"] for own in stated) >= _MIN_STATED_PROBABILITIES:
        near = sum(own["low"] <= own["level"] <= own["high"] for own in stated)
        do = "agree with the outcomes" if near >= len(stated) - 1 else "disagree with the outcomes, so do not use them"
        yield f"Stated probabilities {do}: {near} of {len(stated)} are in the 95 % interval of the true share."
    unjudged, why = result.get("not_judged"), "because changed thresholds need further fits"
    yield f"{unjudged} more cases are not judged, {why}." if unjudged else ""
    yield "table.md has every case, and marks wrong answers by '(wrong)'." if count else ""


def blind_validation_markdown_lines(result: Mapping[str, Any]) -> list[str]:
    """Return the tables of a `yid-blind/1` result as lines of Markdown, separated by empty lines."""
    lines: list[str] = []
    for head, *rows in (table.rows for table in _blind_tables(result)):
        lines += ["", *(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows))]
    return lines[1:]


def _blind_tables(result: Mapping[str, Any]) -> list[SummaryTable]:
    """Return the tables of the score, detection by size, experiments, cases and, if calibrated, thresholds."""
    sure = {name: _rate(own) for name, own in result["intervals"].items()}
    error = result["calibration"]["expected_calibration_error"]
    measures: TableRows = [
        ("no effect: false alarms (a gap is reported)", sure["false_alarms"], "0 %"),
        ("one effect: a gap is reported", sure["detected"], "100 %"),
        ("- then the first candidate is the true effect", sure["kind_first"], "100 %"),
        ("- then the first reported place is that of the effect", sure["location_first"], "100 %"),
        ("- then the effect named first is the true one, or cannot be told from it", sure["sets_cover"], "100 %"),
        ("number of effects in the set that is named first", _number(result["set_size"], ".2f"), "1"),
        ("a cause that the diagnosis does not know: verdict unknown", sure["unknown_outside"], "100 %"),
        ("an effect that was removed from its candidates: verdict unknown", sure["unknown_left_out"], "100 %"),
        ("these two kinds, gap reported: the first reported place is true", sure["unknown_location"], "100 %"),
        ("two effects: both reported, each alone or in a set of three", sure["pairs_right"], "100 %"),
        ("removed part of the gap / part that the true effect removes", _share(result["closure_of_best"]), "100 %"),
        ("median error of the parameters of true effects", _share(result["parameter_error"], 1), "0 %"),
        ("95 % intervals of these parameters that contain the true value", sure["interval_coverage"], "95 %"),
        ("mean difference of stated probability and true share", _number(error, ".3f"), "0"),
        ("time of one diagnosis", _number(result["seconds"], ".0f", " s"), ""),
    ]
    marks = [("what", "value (cases, 95 % interval)", "good is"), *(row for row in measures if row[1] != "-")]
    seen: TableRows = [("size / detectable size", "cases", "gap reported", "true effect first", "true effect named")]
    for size, own in result["detection_intervals"].items():
        seen.append((size, str(own["gap"]["of"]), *(_rate(own[key]) for key in ("gap", "first", "right"))))
    tried: TableRows = [("experiment", "cases", "not judged", "false alarms", "right answers")]
    for name, own in result["experiments"].items():
        counts = (str(own["cases"]), str(own.get("not_judged") or ""))
        tried.append((name, *counts, _rate(own["false_alarms"]), _rate(own["right"])))
    sure_of: TableRows = [("stated probability of a named cause (mean of a fifth of the cases)", "true share")]
    sure_of += [(f"{own['level']:.2f}", _rate(own)) for own in result["calibration"]["probabilities"]]
    told = ("case", "experiment", "sort", "truth", "size", "verdict", "added")
    cases: TableRows = [(*told, "not separable", "place", "closure", "best", "time")]
    for entry in result["marks"]:
        wrong = "" if entry["right"] or entry["category"] == "finer_chain" else " (wrong)"
        kept = (entry[key] for key in ("case", "experiment", "category", "truth"))
        found = (_number(entry["multiple"], ".3g"), entry["verdict"] + wrong, entry["answer"])
        place = (", ".join(entry["confusable"]) or "-", "right" if entry["location_first"] else "-")
        shares = (_share(entry["closure"]), _share(entry["best"]))
        cases.append((*kept, *found, *place, *shares, _number(entry["seconds"], ".0f", " s")))
    tables = {"Score": marks, "Detection by size": seen, "Experiments": tried, "Probabilities": sure_of, "Cases": cases}
    if (rescored := result.get("rescored")) is not None:
        head = ("case", "truth", "then", "now")
        differ: TableRows = [head, *(tuple(own[key] for key in head) for own in rescored["changed"])]
        tables = {"Score": marks, "Judged otherwise": differ, **tables}
    if (calibration := result.get("calibration_of_thresholds")) is not None:
        # quantiles next to the present settings
        kinds = {"clean": "clean recordings", "named": "effects named right", "refitted": "effects refitted"}
        first = ("diagnosis.", "is", "advised", "what", "quantile", "coverage", "of", "effects beyond it, by size")
        thresholds: TableRows = [(*first, "strange ones beyond it")]
        for own in calibration["rules"].values():
            name, value = own["setting"], _number(own["quantile"], ".3g")
            beyond = ", ".join(f"{size}: {_rate(found)}" for size, found in own["effects_beyond"].items())
            cells = (f"{own['is']:.3g}", f"{calibration['settings'][name]:.3g}", own["statistic"], value)
            cases_of = (_share(own["coverage"]), f"{own['cases']} {kinds[own['of']]}", beyond or "-")
            thresholds.append((name, *cells, *cases_of, _rate(own["strange_beyond"])))
        tables["Thresholds"] = thresholds
    return [SummaryTable(rows, title) for title, rows in tables.items()]


def _number(value: float | None, form: str, unit: str = "") -> str:
    return "-" if value is None else f"{value:{form}}{unit}"


def _share(value: float | None, digits: int = 0) -> str:
    return "-" if value is None else f"{100 * value:.{digits}f} %"


def _rate(own: Mapping[str, Any]) -> str:
    if not own["of"]:
        return "-"
    return f"{_share(own['rate'])} ({own['count']} of {own['of']}, {_share(own['low'])} to {_share(own['high'])})"


@SUMMARIES.register("yid-batch/1")
def _batch_summary(result: Mapping[str, Any]) -> SummaryBlockOrTextIterator:
    runs = result["runs"]
    fitted = {entry["name"]: entry for entry in runs if entry["ok"]}
    told = ((n, e) for run in fitted.values() for n, e in run["parameters"].items() if e["value"] is not None)
    # runs of other models may have other units
    found = grouped(((n, e["unit"]), e["value"]) for n, e in told if e["verdict"] in _FOUND_VERDICTS)
    names = sorted(found, key=lambda name: -len(found[name]))
    heads = [(key, f"{key[0]} [{key[1]}]" if key[1] else key[0]) for key in names]
    links = {entry["name"]: f"{entry['folder']}/report.html" for entry in runs if entry["folder"]}
    ends = [entry["status"].replace("error", "stopped by an error").replace("_", " ") for entry in runs]
    poor = {n: f"{e['chi2_per_dof']:.3g}" for n, e in fitted.items() if e.get("explains") is False}
    text = f"Use no value of {abbreviated_names_text([*poor])}: the model does not explain the recordings (chi2 per "
    text += f"degree of freedom {', '.join(poor.values())}; noise alone: 1). Run `yid-ocp diagnose`."
    verdicts = {n: {own["verdict"] for own in e["parameters"].values()} for n, e in fitted.items()}
    lost = abbreviated_names_text([n for n, own in verdicts.items() if own == {"not_identifiable"}])
    said = [text] * bool(poor)
    said += [f"The recordings of {lost} determine no parameter. `yid-ocp identifiability` shows why."] * bool(lost)
    said += [f"{count_with_noun(len(runs), 'run')}: {', '.join(f'{n} {end}' for end, n in Counter(ends).items())}."]
    failed = ((end, run) for end, run in zip(ends, runs, strict=True) if not run["ok"])
    said += [f"{run['name']}: {end}: {run['message'].splitlines()[0].removesuffix('.')}." for end, run in failed]
    alike = result["history"]
    said += [] if alike is None else _history_sentences(alike)
    yield from (SummaryStatement(text, "verdict") for text in said)
    rows = [*_batch_rows(runs, dict(heads[:_MAX_TERMINAL_PARAMETERS]))]
    yield SummaryTable(rows, "Fit of each run (± is one standard deviation)", is_key_table=True, links=links)
    spread: TableRows = [("parameter", "runs with an estimate", "smallest", "median", "largest", "unit")]
    for (name, unit), values in found.items():
        if len(values) > 1:
            numbers = (min(values), statistics.median(values), max(values))
            spread.append((name, str(len(values)), *(f"{x:.4g}" for x in numbers), unit))
    yield SummaryTable(spread, "Spread of the estimates over all runs")
    if len(names) > _MAX_TERMINAL_PARAMETERS:
        rows = [*_batch_rows(runs, dict(heads))]
        yield SummaryTable(rows, "Runs with all parameters", is_page_only=True, links=links)


def _batch_rows(runs: Sequence[Mapping[str, Any]], heads: Mapping[tuple[str, str], str]) -> Iterator[Sequence[str]]:
    yield "run", "status", "chi2 per degree of freedom (noise alone: 1)", "effects", *heads.values(), "time"
    for entry in runs:
        cells = []
        for name, unit in heads:
            own = entry["parameters"].get(name, {"value": None})
            if own["value"] is None or own["unit"] != unit or not entry["ok"]:
                cells.append("")
            elif own["verdict"] in _FOUND_VERDICTS:
                cells.append(value_and_uncertainty_text(own["value"], own["std"], None))
            else:
                cells.append(VERDICT_TABLE_TEXTS[own["verdict"]])
        fit = "" if entry["chi2_per_dof"] is None else f"{entry['chi2_per_dof']:.3g}"
        time = "" if entry["seconds"] is None else f"{entry['seconds']:.1f} s"
        yield entry["name"], entry["status"].replace("_", " "), fit, ", ".join(entry["effects"]), *cells, time


@SUMMARIES.register("yid-compare/1")
def _compare_summary(result: Mapping[str, Any]) -> SummaryBlockOrTextIterator:
    known, judged = result["methods"], result["judged"]
    stopped = [m for m, e in known.items() if e["status"] == "stopped" and not e["iterations"]]  # no values
    methods = {method: entry for method, entry in known.items() if method not in stopped}
    if not methods and not result["disturbed"]:
        yield SummaryStatement("No method ended an iteration. Raise compare.total_time_budget.", "conclusion")
        return
    best = "best fit" if result["disturbed"] else f"{result['reference']} (reference)"
    others = {m: e for m, e in methods.items() if result["disturbed"] or m != result["reference"]}
    runs = others | {best: judged}
    beside = [key for key in ("published", "truth") if result[key]]
    rows: TableRows = [("parameter", *runs, *beside, "unit", "verdict")]
    free = {name: own for name, own in judged["parameters"].items() if own["free"]}
    for name, own in free.items():
        cells = []
        for method, entry in runs.items():
            found = entry["parameters"][name]
            # elsewhere, and without noise, the curvature is no measure of uncertainty
            ended = entry["status"] not in ("stalled", "failed") and not (result["disturbed"] and method in methods)
            std, interval = (found["std"], found["interval"]) if ended else (None, None)
            cells.append(value_and_uncertainty_text(found["value"], std, interval, verdict=own["verdict"]))
        told = [f"{result[key][name]:.4g}" if name in result[key] else "" for key in beside]
        rows.append((name, *cells, *told, shown_unit(own["unit"]), VERDICT_TABLE_TEXTS[own["verdict"]]))
    yield from misfit_summary_blocks(judged, free)
    agree = "All methods agree within their ± on the parameters that are found, so you can use any column. The "
    agree += f"verdicts are those of `{best}`."
    objections = [*_objections_to_agreement(result, methods, best)] or [agree]
    yield from (SummaryStatement(text, "conclusion") for text in objections)
    yield from issue_summary_blocks(result)
    verdicts = {own["verdict"] for own in free.values()}
    rows = rows if verdicts - {"not_identifiable"} or beside else []
    yield SummaryTable(rows, "Estimates by each method (± is one standard deviation)", is_key_table=True)
    yield SummaryTable([*_effort_rows(others | methods)], "Fit and computing time of each method")
    for name, entry in known.items():
        if entry["status"] != "converged":  # the message names the key of `solve`
            yield f"{name} did not converge: {entry['message'].replace('solver.', f'compare.methods.{name}.')}."
        else:
            yield from (f"{name} {sentence}." for sentence in entry["disagreements"])
    steps = {"estimate by one method, in more detail": "solve"} if verdicts & {"identifiable", "weak"} else {}
    if verdicts & {"weak", "not_identifiable"}:
        steps["rank experiments that determine more (takes minutes)"] = "identifiability --what-if"
    yield next_steps_table(result, steps)


def _objections_to_agreement(result: Mapping[str, Any], methods: Iterable[str], best: str) -> Iterator[str]:
    """Yield sentences on why the methods' estimates cannot be trusted; none if they agree and this is meaningful."""
    fit, judged = result["judged"]["fit"], result["judged"]["parameters"].values()
    if result["disturbed"]:
        words = "these methods ignore noise of the measured torques or angles that move the model"
        yield f"Do not use the columns {', '.join(methods)}, because {words}."
        yield "Use the column `best fit`, which includes this noise and has the verdicts."
    if not fit["explains"]:
        yield "The model does not explain the recordings, so agreement of methods does not confirm the values."
    elif not fit["data_trusted"]:
        yield "The recordings have issues, so agreement of methods does not confirm the values."
    elif not any(entry["verdict"] == "identifiable" for entry in judged):
        yield "Use 95 % intervals in place of values, because no ± is below 10 %. `yid-ocp identifiability` shows why."
    elif not result["agree"] and not result["disturbed"]:
        yield f"Use the column `{best}`. The reasons why other values differ are below."


def _effort_rows(methods: Mapping[str, Mapping[str, Any]]) -> Iterator[Sequence[str]]:
    entries = methods.values()
    yield "quantity", *methods
    yield "status", *("time limit" if e["status"] == "stopped" else e["status"].replace("_", " ") for e in entries)
    costs = ("failed" if (x := entry["whitened_cost"]) is None else f"{x:.6g}" for entry in entries)
    yield "cost (half the sum of (error/noise)^2)", *costs
    chi2 = "chi2 per degree of freedom (noise alone: 1)"
    yield chi2, *("unknown" if (x := e["fit"]["chi2_per_dof"]) is None else f"{x:.3g}" for e in entries)
    units = {c: own["unit"] for entry in entries for c, own in entry["residuals"].items()}
    for channel in sorted({c for e in entries for h in e["held_out"] for c in h.get("rmse", {})}):
        unit = channel_or_group_unit(units, channel)
        errors = [[h["rmse"][channel] for h in e["held_out"] if channel in h.get("rmse", {})] for e in entries]
        cells = (value_text_and_display_unit(sum(e) / len(e), unit)[0] if e else "failed" for e in errors)
        shown = f" [{scale_and_unit_with_metres_as_mm(unit)[1]}]" if unit else ""
        yield f"held-out rms error of {channel}{shown}", *cells
    yield "iterations", *(str(entry["iterations"]) for entry in entries)
    yield "time [s]", *(f"{entry['wall_seconds']:.2f}" for entry in entries)


@SUMMARIES.register("yid-friction/1")
def _friction_summary(result: Mapping[str, Any]) -> SummaryBlockOrTextIterator:
    unit, best = result["unit"], result["warranted"]
    chosen = result["laws"][best]
    fitted, friction, error = chosen["parameters"], result["friction_parameters"], f"{chosen['mean_error']:.3g} {unit}"
    joints, kinds = abbreviated_names_text(result["joints"]), ", ".join(result["kinds"])
    worst, noise = max(entry["mean_error"] for entry in result["laws"].values()), "; noise alone: 1" * (unit == "std")
    told = {n: (e["value"], e["std"], e["interval"]) for n, e in fitted.items()}
    shown = {n: value_and_uncertainty_text(*own, verdict=fitted[n]["verdict"]) for n, own in told.items()}
    lost = abbreviated_names_text([name for name in friction if shown[name] == "–"])
    is_absent = bool(friction) and all(shown[name] == "–" for name in friction)
    heads = ("rms error", "± (between motions)", f"beyond that of '{best}'", "± of this difference", "note")
    rows: TableRows = [("law", *heads)]
    keys = ("mean_error", "standard_error", "beyond_warranted", "beyond_warranted_standard_error")
    for law, entry in result["laws"].items():
        note = "chosen" * (law == best and not is_absent) + " (the fit did not converge)" * (not entry["converged"])
        rows.append((law, *(f"{entry[key]:.3g}" for key in keys), note))
    errors = f"held-out error {error}, worst law {worst:.3g}{noise}"
    reason = "it is the simplest law, and no other one predicts clearly better"
    if best != next(iter(result["laws"])):
        reason = "no simpler law predicts as well"
    is_poor = unit == "std" and chosen["mean_error"] > MAX_NOISE_RATIO
    text = f"Use the law '{best}' for these joints: {joints}, as {reason} ({errors})."
    if not chosen["converged"]:
        text = f"Use no friction law yet: raise solver.max_iterations, as the fit of '{best}' did not converge."
    elif is_poor:
        text = "Do not use the constants of friction yet, because no law explains these motions: even with the best "
        text += f"one, '{best}', the error is far larger than noise ({errors}). Run `yid-ocp diagnose`."
    elif is_absent:
        text = f"Use no friction law, because these recordings do not show friction of {joints}."
    elif lost:
        text += f" Do not use {lost}, which these recordings do not determine."
    yield SummaryStatement(f"{text} Each motion was held out in turn: {kinds}.", "conclusion")
    words = {name: _friction_constant_words(name, fitted[name]["unit"]) for name in friction}
    columns = dict.fromkeys(words.values())  # a prismatic joint has units, and so columns, of its own
    constants: TableRows = [("joint", *columns)]
    for joint in result["joints"]:
        known = {words[n]: shown[n] for n in friction if n.rpartition(".")[0].rpartition("@")[2] == joint}
        constants.append((joint, *(known.get(column, "") for column in columns)))
    yield SummaryTable(constants, f"Constants of the law '{best}' (± is one standard deviation)")
    scale = "standard deviations of the noise" if unit == "std" else unit
    yield SummaryTable(rows, f"Held-out error of each law [{scale}]", is_key_table=True)
    others = [(name, value, shown_unit(fitted[name]["unit"])) for name, value in shown.items() if name not in friction]
    yield SummaryTable([("parameter", "value", "unit"), *others], "Other parameters of this fit")
    yield "Values in brackets are 95 % intervals." if any("(" in value for value in shown.values()) else ""
    if chosen["converged"] and not result["to_use"] and not (is_absent or is_poor):
        yield "For a configuration of yid-ocp (the law without values):"
        yield CodeBlock(f"model:\n  friction: {{law: {best}, joints: [{', '.join(result['joints'])}]}}")
    yield from copyable_estimates_blocks(result)


def _friction_constant_words(name: str, unit: str) -> str:
    """Return meaning, symbol and unit of a constant of a friction law, such as `joint_coulomb@elbow.tau_c`."""
    kind, symbol = name.partition("@")[0], name.rpartition(".")[2]
    known = {own.name: own.description for own in EFFECTS[kind].declared_parameters} if kind in EFFECTS else {}
    return f"{known.get(symbol, 'viscous friction')} ({symbol}) [{unit}]".removesuffix(" [1]")


@SUMMARIES.register("yid-history/1")
def _history_summary(result: Mapping[str, Any]) -> SummaryBlockOrTextIterator:
    runs = [entry["name"] for entry in result["runs"]]
    rows: TableRows = [("parameter", *runs, "mean of all", "unit", "p-value of noise alone", "verdict")]
    for name, entry in result["parameters"].items():
        own = entry["values"]
        cells = (value_and_uncertainty_text(own[r]["value"], own[r]["std"], None) if r in own else "" for r in runs)
        p = "" if len(own) < 2 else p_value_text(entry["p_value"])
        together = "" if entry["drifted"] else value_and_uncertainty_text(entry["mean"], entry["mean_std"], None)
        rows.append((name, *cells, together, shown_unit(entry["unit"]), p, "differs" if entry["drifted"] else ""))
    yield from (SummaryStatement(text, "verdict") for text in _history_sentences(result))
    title = "Estimates of each run (± is one standard deviation, without the common errors of links and time step)"
    yield SummaryTable(rows, title, is_key_table=True)


def _history_sentences(result: Mapping[str, Any]) -> Iterator[str]:
    runs, p = result["runs"], p_value_text(result["p_value"], "= ")
    drifted = [name for name, entry in result["parameters"].items() if entry["drifted"]]
    wrong = [entry["name"] for entry in runs if entry["distrusted"]]
    poor = [entry["name"] for entry in runs if not entry["explains"]]
    doubtful = f" The model does not explain the recordings of {abbreviated_names_text(poor)}, so their ± is large."
    if not drifted and result["p_value"] >= result["level"]:
        yield f"All runs agree within their uncertainty (p-value {p}).{doubtful * bool(poor)}"
    elif not drifted:
        yield f"All parameters together differ between the runs (p-value {p}), but no single parameter does."
    for name in drifted:
        entry = result["parameters"][name]
        (low, first), *_, (high, last) = sorted((own["value"], run) for run, own in entry["values"].items())
        places = (f" in {first}", f" in {last}") if len(runs) > 2 else ("", "")
        said = f"{name} differs between the runs, from {low:.4g}{places[0]} to {high:.4g} {entry['unit']}{places[1]}"
        limit = f"below {result['level'] / len(result['parameters']):.2g} counts as a difference"
        yield f"{said} (p-value {p_value_text(entry['p_value'], '= ')}; {limit})."
    if wrong:
        names = " and ".join(wrong)
        rest = [entry["name"] for entry in runs if not entry["distrusted"]]
        said = f"Either the values changed before {names}, or the recording is faulty. Repeat it before you use them."
        if set(poor).intersection(rest):
            said = f"The model does not explain {abbreviated_names_text(poor)}, so it is open which run is faulty."
        yield f"The other runs ({abbreviated_names_text(rest)}) agree with each other much better than with {names}."
        yield said
    elif drifted:
        two = "Two runs that differ do not show which one is wrong. Add a third run."
        yield two if len(runs) == 2 else "The runs differ, whichever one is left out."
        names = abbreviated_names_text(poor)
        yield f"First run `yid-ocp diagnose` on {names}, whose recordings the model does not explain." if poor else ""


@SUMMARIES.register("yid-overlay/1")
def _overlay_summary(result: Mapping[str, Any]) -> SummaryBlockOrTextIterator:
    first, second = result["runs"]
    rows: TableRows = [("parameter", first, second, "difference", "difference / larger std", "unit")]
    differing, n_compared = list[str](), 0
    for name, entry in result["parameters"].items():
        apart, over = entry["difference"], entry["difference_in_std"]
        cells = [_overlaid_value(entry["values"].get(run)) for run in (first, second)]
        cells += ["" if size is None else f"{size:+.{digits}g}" for size, digits in ((apart, 3), (over, 2))]
        rows.append((name, *cells, shown_unit(entry["unit"])))
        n_compared += over is not None
        differing += [name] if over is not None and abs(over) > _MAX_RUN_DIFFERENCE else []
    differ = f"by more than {_MAX_RUN_DIFFERENCE} standard deviations"
    text = f"The two runs agree: no parameter differs {differ}."
    if not n_compared:
        text = "No parameter can be compared, because none has a usable value in both runs."
    elif differing:
        text = f"The two runs differ {differ} in these parameters: {abbreviated_names_text(differing)}."
    yield SummaryStatement(text, "verdict")
    yield f"The model did not explain the recordings of {', '.join(poor)}." if (poor := result.get("poor")) else ""
    said = "so a parameter may differ without a fault: the stiffness of a joint (not a rigidity) grows with the links"
    yield f"The models differ ({key}), {said}." if (key := result.get("model_difference")) else ""
    yield SummaryTable(rows, "Estimates of both runs (± is one standard deviation)", is_key_table=True)
    judged = [entry for entry in result["channels"] if entry["held_out"]] or result["channels"]
    where = f"{'held-out' if judged[0]['held_out'] else 'fitted'} recordings"
    for group, alike in grouped((entry["channel"].rpartition(".")[0], entry) for entry in judged).items():
        sizes = zip(*((*entry["rmse"].values(), entry["difference"]) for entry in alike), strict=True)
        means = [statistics.fmean(size**2 for size in own) ** 0.5 for own in sizes]
        texts = [" ".join(value_text_and_display_unit(mean, alike[0]["unit"])).rstrip() for mean in means]
        text = f"On {where}, the rms error of {group} is {texts[0]} in {first} and {texts[1]} in {second}"
        yield SummaryStatement(f"{text}. The predictions of the two runs differ by {texts[2]} (rms).", "conclusion")
    rows = [("recording", "channel", f"error of {first}", f"error of {second}", "difference of predictions", "unit")]
    for entry in result["channels"]:
        three = (*entry["rmse"].values(), entry["difference"])
        errors = [value_text_and_display_unit(size, entry["unit"]) for size in three]
        rows.append((entry["recording"], entry["channel"], *(text for text, _ in errors), errors[0][1]))
    yield SummaryTable(rows, "Errors of both runs, and difference of their predictions (rms)")


def _overlaid_value(entry: Mapping[str, Any] | None) -> str:
    if entry is not None and entry["free"]:
        return value_and_uncertainty_text(entry["value"], entry["std"], verdict=entry["verdict"])
    return "" if entry is None else f"{entry['value']:.4g} (fixed)"

"""Table rows and sentences used by the summaries."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from yid_ocp.data.issues import ISSUE_CAUSES
from yid_ocp.report.terminal import CodeBlock, SummaryBlock, SummaryStatement, SummaryTable, TableRows
from yid_ocp.solvers.fit_messages import VERDICT_WORDS

_MAX_ISSUES_PER_CAUSE = 3  # doubts of one kind
_MAX_OFFSET_RECORDINGS = 4  # recordings side by side
_MIN_GAP_SHARE, _MAX_WINDOWS = 0.005, 6  # of places that are listed
_MAX_SINGLE_CHANNELS = 4  # a group of more points is shown as a whole; result.json has every point


_BASELINE_DESCRIPTIONS = {
    "stays": "points stay where they were first seen",
    "zero": "an effort of zero",
    "moves_with_clamps": "points move with the mean of the clamps",
    "linear_carry": "the clamps' motion carried along the cable",
}
"""Predictions without a model."""


def display_scale_and_unit(unit: str) -> tuple[float, str]:
    """Scale factor and unit for display: metres become millimetres, other units stay."""
    return (1e3, "mm") if unit == "m" else (1.0, unit)


def format_error_and_unit(value: float | None, unit: str, digits: int = 3) -> tuple[str, str]:
    """Formatted value and display unit of an error; a dash for None."""
    factor, shown = display_scale_and_unit(unit)
    return ("–" if value is None else f"{factor * value:.{digits}g}"), shown


@dataclass(frozen=True)
class _IssueRow:
    """One issue of a recording; `limit_ratio` is the ratio of the statistic to its limit."""

    cause: str
    where: str
    confidence: str
    limit_ratio: float
    what: str
    advice: str
    setting: str


def _issue_rows(result: Mapping[str, Any]) -> list[_IssueRow]:
    rows: list[_IssueRow] = []
    for cause in dict.fromkeys(entry["cause"] for entry in result.get("doubts", ())):
        alike = [entry for entry in result["doubts"] if entry["cause"] == cause]
        for i, entry in enumerate(alike[:_MAX_ISSUES_PER_CAUSE]):
            last, more = i == _MAX_ISSUES_PER_CAUSE - 1, len(alike) - _MAX_ISSUES_PER_CAUSE
            where = entry["where"] + (f" and {more} more" if last and more > 0 else "")
            told = (entry["sure"], entry["evidence"], entry["what"], entry["advice"], entry["setting"])
            rows.append(_IssueRow(ISSUE_CAUSES[cause], where, *told))
    return rows


def issue_blocks(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks on issues of the recordings: a table and advice; empty without issues."""
    shown = _issue_rows(result)
    if not shown:
        return []
    rows: TableRows = [("in doubt", "where", "how sure", "times its limit")]
    rows += [(row.cause, row.where, row.confidence, f"{row.limit_ratio:.3g}") for row in shown]
    blocks: list[SummaryBlock] = [SummaryTable(rows, "In doubt")]
    for row in shown:
        blocks.append(SummaryStatement(f"{row.cause}: {row.what}; {row.advice}"))
        blocks += [CodeBlock(row.setting)] if row.setting else []
    if any(entry["weight"] != "warning" for entry in result["doubts"]):
        blocks.append(
            SummaryStatement("no number is said to be found while a recording of the run is in doubt", "verdict")
        )
    return blocks


@dataclass(frozen=True)
class _HeldOutErrorRow:
    """Held-out error of one channel or group of points, with the error of every baseline [unit]."""

    recording: str
    channel: str
    rmse: float
    unit: str
    baselines: Mapping[str, float]


def held_out_error_rows(result: Mapping[str, Any]) -> list[_HeldOutErrorRow]:
    """Held-out errors of a `yid-solve/1` result for display."""
    units = {channel: entry["unit"] for channel, entry in result["residuals"].items()}
    rows = []
    for entry in result["held_out"]:
        for channel, rmse in entry["rmse"].items():
            if channel in _hidden(entry["rmse"]):
                continue
            members = [unit for name, unit in units.items() if name == channel or name.startswith(f"{channel}.")]
            baselines = {name: errors[channel] for name, errors in entry["baselines"].items() if channel in errors}
            rows.append(_HeldOutErrorRow(entry["recording"], channel, rmse, members[0] if members else "", baselines))
    return rows


def _hidden(errors: Mapping[str, float]) -> set[str]:
    hidden: set[str] = set()
    for group in errors:
        members = {channel for channel in errors if channel.startswith(f"{group}.")}
        if len(members) > _MAX_SINGLE_CHANNELS:
            hidden |= members
        elif members:
            hidden.add(group)
    return hidden


def median_error_rows(rows: Sequence[_HeldOutErrorRow]) -> list[_HeldOutErrorRow]:
    """Median error over recordings of every channel that at least three of them have."""
    channels = dict.fromkeys(row.channel for row in rows)
    result = []
    for channel in channels:
        own = [row for row in rows if row.channel == channel]
        if len(own) > 2:
            names = [name for name in own[0].baselines if all(name in row.baselines for row in own)]
            baselines = {name: statistics.median(row.baselines[name] for row in own) for name in names}
            median = statistics.median(row.rmse for row in own)
            result.append(_HeldOutErrorRow(f"median of {len(own)}", channel, median, own[0].unit, baselines))
    return result


def baseline_legend(rows: Sequence[_HeldOutErrorRow]) -> str:
    """Legend that explains the model-free baselines; empty without any."""
    named = dict.fromkeys(name for row in rows for name in row.baselines)
    said = "; ".join(f"{name}, {_BASELINE_DESCRIPTIONS[name]}" for name in named if name in _BASELINE_DESCRIPTIONS)
    return f"without a model: {said}" if said else ""


def discretisation_sentences(result: Mapping[str, Any]) -> list[str]:
    """One sentence per refinement on the estimates that it shifts by more than their standard deviation."""
    said = []
    for key, words in (("links", "twice the links"), ("time_step", "half the time step")):
        tried = {name: own for name, own in result.get("discretisation", {}).items() if own[key] is not None}
        moved = {n: own for n, own in tried.items() if own["std"] is not None and abs(own[key]) > own["std"]}
        changes = [f"{name} by {own[key]:+.2g} (± {own['std']:.2g} from the data)" for name, own in moved.items()]
        if moved:
            said.append(f"with {words} these move by more than the data's standard deviation: {', '.join(changes)}")
        elif tried:
            said.append(f"with {words} no estimate moves by more than its standard deviation")
    return said


def torque_offset_rows(result: Mapping[str, Any]) -> TableRows:
    """Table rows of the torque offsets of a result, one per joint; empty without offsets."""
    offsets: Mapping[str, Mapping[str, Any]] = result.get("torque_offsets", {})
    if not offsets:
        return []
    shown = dict(list(offsets.items())[:_MAX_OFFSET_RECORDINGS])
    rows: TableRows = [("torque offset [N m]", *shown, "expected")]
    for joint in dict.fromkeys(joint for entry in shown.values() for joint in entry):
        own = [entry.get(joint) for entry in shown.values()]
        cells = ["" if known is None else f"{known['value']:.2f} ± {known['std']:.2f}" for known in own]
        priors = dict.fromkeys(f"± {known['prior_std']:.2g}" for known in own if known is not None)
        rows.append((joint, *cells, ", ".join(priors)))
    left = len(offsets) - len(shown)
    if left:
        rows.append((f"{left} more recordings are in result.json", *("" for _ in shown), ""))
    return rows


def worse_than_baseline_sentences(worse: Sequence[Mapping[str, Any]]) -> list[str]:
    """Sentences on channels that a model-free baseline predicts better than the model."""
    lines = []
    for entry in worse[:_MAX_SINGLE_CHANNELS]:
        own, other = (" ".join(format_error_and_unit(entry[key], entry["unit"])).rstrip() for key in ("rmse", "guess"))
        where = f"{entry['channel']} of {entry['recording']}"
        lines.append(f"worse than a guess without a model: {where}, {own} against {other} ({entry['baseline']})")
    if len(worse) > _MAX_SINGLE_CHANNELS:
        lines.append(f"and so for {len(worse) - _MAX_SINGLE_CHANNELS} more channels, in result.json")
    return lines


def blind_tables(result: Mapping[str, Any]) -> dict[str, TableRows]:
    """Tables of a `yid-blind/1` result by title: score, detection by size, experiments, cases."""

    def share(value: float | None, digits: int = 0) -> str:
        return "-" if value is None else f"{100 * value:.{digits}f} %"

    def rate(own: Mapping[str, Any]) -> str:
        if not own["of"]:
            return "-"
        return f"{share(own['rate'])} ({own['count']} of {own['of']}, {share(own['low'])} to {share(own['high'])})"

    sure = {name: rate(own) for name, own in result["intervals"].items()}
    marks: TableRows = [
        ("what", "value, and its binomial 95 % interval"),
        ("false alarms on clean data", sure["false_alarms"]),
        ("true kind and place first, of the gaps found", sure["kind_first"]),
        ("among the first two", sure["kind_in_two"]),
        ("place first", sure["location_first"]),
        ("what was named, alone or as not separable, holds the truth", sure["sets_cover"]),
        ("how many were named, on average", "-" if result["set_size"] is None else f"{result['set_size']:.2f}"),
        ("unknown said of effects that the library never had", sure["unknown_outside"]),
        ("unknown said of effects taken out of it", sure["unknown_left_out"]),
        ("place first of both", sure["unknown_location"]),
        ("both of a pair, each alone or in a set of three", sure["pairs_right"]),
        ("both of a pair, each alone", sure["pairs_named"]),
        ("closure over that of the true effect refitted", share(result["closure_of_best"])),
        ("median error of the effects' parameters", share(result["parameter_error"], 1)),
        ("their 95 % intervals that hold the truth", sure["interval_coverage"]),
        ("time of one diagnosis", "-" if result["seconds"] is None else f"{result['seconds']:.0f} s"),
    ]
    sizes: TableRows = [
        ("size / detectable", "cases", "gap seen", "kind and place first", "alone or in a set of three")
    ]
    for size, entry in result["detection"].items():
        own = result["detection_intervals"][size]
        sizes.append((size, str(entry["cases"]), *(rate(own[key]) for key in ("gap", "first", "right"))))
    experiments: TableRows = [("experiment", "cases", "false alarms", "right")]
    for name, own in result["experiments"].items():
        experiments.append((name, str(own["cases"]), rate(own["false_alarms"]), rate(own["right"])))
    told = ("case", "experiment", "sort", "truth", "size", "verdict", "added")
    cases: TableRows = [(*told, "not separable", "place", "closure", "best", "time")]
    for entry in result["marks"]:
        wrong = "" if entry["right"] or entry["category"] == "finer_chain" else " (wrong)"
        cases.append((
            entry["case"],
            entry["experiment"],
            entry["category"],
            entry["truth"],
            "-" if entry["multiple"] is None else f"{entry['multiple']:.3g}",
            entry["verdict"] + wrong,
            entry["answer"],
            ", ".join(entry["confusable"]) or "-",
            "right" if entry["location_first"] else "-",
            share(entry["closure"]),
            share(entry["best"]),
            "-" if entry["seconds"] is None else f"{entry['seconds']:.0f} s",
        ))  # fmt: skip
    tables = {"Score": marks, "Detection by size": sizes, "Experiments": experiments, "Cases": cases}
    known: Mapping[str, Any] | None = result.get("calibration_of_thresholds")
    if known is not None:
        tables["Thresholds"] = _threshold_rows(known, rate)
    return tables


def _threshold_rows(calibration: Mapping[str, Any], rate: Callable[[Mapping[str, Any]], str]) -> TableRows:
    """Quantiles of a `yid-calibration/1` beside what is set."""
    kinds = {"clean": "clean recordings", "named": "effects named right", "refitted": "effects refitted"}
    head = ("diagnosis.", "is", "advised", "what", "quantile", "coverage", "of", "effects beyond it, by size")
    rows: TableRows = [(*head, "strange ones beyond it")]
    for own in calibration["rules"].values():
        name, value = own["setting"], "-" if own["quantile"] is None else f"{own['quantile']:.3g}"
        sizes = ", ".join(f"{size}: {rate(found)}" for size, found in own["effects_beyond"].items())
        cells = (f"{own['is']:.3g}", f"{calibration['settings'][name]:.3g}", own["statistic"], value)
        cases = (f"{100 * own['coverage']:.0f} %", f"{own['cases']} {kinds[own['of']]}", sizes or "-")
        rows.append((name, *cells, *cases, rate(own["strange_beyond"])))
    return rows


def blind_markdown(result: Mapping[str, Any]) -> list[str]:
    """The tables of `blind_tables` as Markdown, an empty line between two."""
    lines: list[str] = []
    for head, *rows in blind_tables(result).values():
        cells = [head, ["---"] * len(head), *rows]
        lines += ["", *(f"| {' | '.join(row)} |" for row in cells)]
    return lines[1:]


def blind_sentences(result: Mapping[str, Any]) -> list[str]:
    """Sentences that summarise a `yid-blind/1` result."""
    cases, right, alarms = len(result["marks"]), result["intervals"]["kind_first"], result["intervals"]["false_alarms"]
    said = [f"{cases} {'case' if cases == 1 else 'cases'} of seed {result['seed']}, drawn for {result['purpose']}"]
    if right["of"]:
        said.append(f"of {right['of']} gaps found, {right['count']} were named right: kind and place first")
    if alarms["of"]:
        said.append(f"of {alarms['of']} clean recordings, {alarms['count']} gave a false alarm")
    return said


def gap_error_rows(result: Mapping[str, Any]) -> TableRows:
    """Table rows of held-out errors of a diagnosis: nominal model, and after each added effect."""
    before, steps = result["gap"]["before"], result.get("steps", ())
    rows: TableRows = [("held-out channel", "nominal", *(f"+ {step['added']}" for step in steps), "unit")]
    for channel, error in before["rmse"].items():
        unit = before["unit"][channel]
        later = (format_error_and_unit(step["rmse"].get(channel), unit)[0] for step in steps)
        rows.append((channel, format_error_and_unit(error, unit)[0], *later, display_scale_and_unit(unit)[1]))
    return rows


def gap_location_rows(result: Mapping[str, Any]) -> TableRows:
    """Table rows of gap locations with their share of the gap and time windows."""
    rows: TableRows = [("where", "share of the gap", "when [s]")]
    for place in result.get("where", ()):
        if place["share"] > _MIN_GAP_SHARE:
            when = ", ".join(f"{begin:.3g} to {end:.3g}" for begin, end in place["windows"][:_MAX_WINDOWS])
            more = ", …" if len(place["windows"]) > _MAX_WINDOWS else ""
            rows.append((place["location"], f"{100 * place['share']:.1f} %", when + more))
    return rows


def event_rows(result: Mapping[str, Any]) -> TableRows:
    """Table rows of the events of a diagnosis."""
    rows: TableRows = [("event", "recording", "from [s]", "to [s]", "peak", "impulse", "unit")]
    for own in result.get("events", ()):
        size = ("–" if own["peak"] is None else f"{own['peak']:.3g}", _impulse(own))
        times = ("–" if own[key] is None else f"{own[key]:.4g}" for key in ("from", "to"))
        rows.append((own["channel"], own["recording"], *times, *size, f"{own['unit']}, {own['unit']} s"))
    return rows


def _impulse(event: Mapping[str, Any]) -> str:
    if event["impulse"] is None:
        return "–"
    return f"{event['impulse']:.3g}" + ("" if event["std"] is None else f" ± {event['std']:.2g}")


def plan_joint_rows(result: Mapping[str, Any]) -> Sequence[tuple[str, ...]]:
    """Table rows of travel, velocity and effort that a plan requires of each joint."""

    def percent(share: float | None) -> str:
        return "" if share is None else f"{100 * share:.0f} %"

    rows = [("joint", "travel [rad or m]", "largest velocity, of its limit", "largest effort, of its limit")]
    for name, own in result["joints"].items():
        travel = own["travel"] if own["travel"] > 1e-9 else 0.0
        rows.append((name, f"{travel:.3g}", percent(own["velocity"]), percent(own["effort"])))
    return rows


def plan_sentences(result: Mapping[str, Any]) -> list[str]:
    """Sentences on the accuracy of the planned point at its target."""
    if result["error"] is None or result["swing"] is None:
        return [
            "the motion at which the search ended cannot be simulated to its end; nothing is known of where it leads"
        ]
    place = ", ".join(f"{x:.4g}" for x in result["place"])
    said = [
        f"in {result['duration']:g} s '{result['point']}' goes to ({place}) m; in the {result['settle']:g} s after "
        f"that it is at most {1e3 * result['error']:.3g} mm from there, and no point of the object is faster than "
        f"{1e3 * result['swing']:.3g} mm/s, as the model has it"
    ]
    if result["off_path"] is not None:
        said.append(f"on the way it is at most {1e3 * result['off_path']:.3g} mm from where its path is at that time")
    if result["std"] is not None:
        std = ", ".join(f"{1e3 * x:.2g}" for x in result["std"])
        said.append(f"what is not known of the parameters makes that uncertain by ({std}) mm, one standard deviation")
        lost = result["from"]["uncertainty_unknown"]
        said += [f"not counted, as their uncertainty is not known: {', '.join(lost)}"] if lost else []
    elif result["from"]["run"] is None:
        said.append("the parameters are those of the configuration, so nothing is said of how uncertain that is")
    return said


def parameter_information_rows(result: Mapping[str, Any]) -> Sequence[tuple[str, ...]]:
    """Table rows of the parameter stds that an informative motion is expected to give."""

    def percent(std: float | None) -> str:
        return "unknown" if std is None else f"± {100 * std:.2g} %"

    rows = [("parameter", "from the recordings", "from this motion", "from both", "verdict of this motion")]
    for name, own in result["parameters"].items():
        stds = (percent(own[f"std_relative_{when}"]) for when in ("before", "after", "together"))
        rows.append((name, *stds, VERDICT_WORDS[own["verdict"]]))
    return rows


def effect_distance_rows(result: Mapping[str, Any]) -> Sequence[tuple[str, ...]]:
    """Table rows of distances between effects before and after an informative motion [std]."""
    rows = [("effect", "beside what could be", "apart in the recordings", "apart in this motion")]
    for own in result["distances"]:
        rows.append((own["effect"], own["explained_by"], *(f"{own[when]:.3g} std" for when in ("before", "after"))))
    return rows


def information_sentences(result: Mapping[str, Any]) -> list[str]:
    """Sentences on the search for an informative motion and its active limits."""
    starts, best = result["starts"], result["starts"][result["best"]]
    gains = sorted((s["judged"] for s in starts if s["judged"] is not None), reverse=True)
    others = f"; {len(starts)} starts ended at {gains[0]:.3g} to {gains[-1]:.3g} nat" if len(gains) > 1 else ""
    said = [
        f"start {result['best'] + 1} of {len(starts)} tells most: {best['value'] - best['first']:.3g} nat more than "
        f"the random motion from which it came{others}"
    ]
    reached = [f"{what} of {', '.join(names)}" for what, names in result["limits_reached"].items()]
    said.append(f"what limits it: {'; '.join(reached)}" if reached else "it reaches no limit")
    said += [f"{name}: no motion, no sensor sees it to first order; {what}" for name, what in result["unseen"].items()]
    left = [words for words in result["open"] if not words.startswith(tuple(f"{name} is" for name in result["unseen"]))]
    said += [f"left open by this motion: {words}" for words in left]
    if result["from"]["run"] is None:
        said.append("the parameters are those of the configuration; where the true ones differ, so does what is told")
    return said

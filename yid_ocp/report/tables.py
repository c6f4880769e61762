"""Rows that the report and the command line show alike."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from yid_ocp.data.doubt import CAUSES
from yid_ocp.solvers.words import VERDICT_WORDS

MOST_ALIKE = 3  # doubts of one kind
MOST_OFFSETS = 4  # recordings side by side
MOST_POINTS = 4  # a group of more points is shown as a whole; result.json has every point


@dataclass(frozen=True)
class DoubtRow:
    """One doubt about a recording; `evidence` is how many times its limit was exceeded."""

    cause: str
    where: str
    sure: str
    evidence: float
    what: str
    advice: str
    setting: str


def doubt_rows(result: Mapping[str, Any]) -> list[DoubtRow]:
    """The doubts of a result that people want to see: those of one kind up to `MOST_ALIKE`, then how many more."""
    rows: list[DoubtRow] = []
    for cause in dict.fromkeys(entry["cause"] for entry in result.get("doubts", ())):
        alike = [entry for entry in result["doubts"] if entry["cause"] == cause]
        for i, entry in enumerate(alike[:MOST_ALIKE]):
            last, more = i == MOST_ALIKE - 1, len(alike) - MOST_ALIKE
            where = entry["where"] + (f" and {more} more" if last and more > 0 else "")
            told = (entry["sure"], entry["evidence"], entry["what"], entry["advice"], entry["setting"])
            rows.append(DoubtRow(CAUSES[cause], where, *told))
    return rows


def doubt_sentences(result: Mapping[str, Any]) -> list[str]:
    """What follows from the doubts of a result."""
    grave = [entry for entry in result.get("doubts", ()) if entry["weight"] != "warning"]
    if not grave:
        return []
    return ["no number is said to be found while a recording of the run is in doubt"]


@dataclass(frozen=True)
class HeldOutRow:
    """Error of one channel, or of a whole group of points, beside that of every baseline; [unit]."""

    recording: str
    channel: str
    rmse: float
    unit: str
    baselines: Mapping[str, float]


def held_out_rows(result: Mapping[str, Any]) -> list[HeldOutRow]:
    """Rows of the held-out recordings of a `yid-solve/1` result that people want to see."""
    units = {channel: entry["unit"] for channel, entry in result["residuals"].items()}
    rows = []
    for entry in result["held_out"]:
        for channel, rmse in entry["rmse"].items():
            if channel in _hidden(entry["rmse"]):
                continue
            members = [unit for name, unit in units.items() if name == channel or name.startswith(f"{channel}.")]
            baselines = {name: errors[channel] for name, errors in entry["baselines"].items() if channel in errors}
            rows.append(HeldOutRow(entry["recording"], channel, rmse, members[0] if members else "", baselines))
    return rows


def _hidden(errors: Mapping[str, float]) -> set[str]:
    hidden: set[str] = set()
    for group in errors:
        members = {channel for channel in errors if channel.startswith(f"{group}.")}
        if len(members) > MOST_POINTS:
            hidden |= members
        elif members:
            hidden.add(group)
    return hidden


def medians(rows: Sequence[HeldOutRow]) -> list[HeldOutRow]:
    """Median over recordings of every channel that several of them have."""
    channels = dict.fromkeys(row.channel for row in rows)
    result = []
    for channel in channels:
        own = [row for row in rows if row.channel == channel]
        if len(own) > 2:
            names = [name for name in own[0].baselines if all(name in row.baselines for row in own)]
            baselines = {name: statistics.median(row.baselines[name] for row in own) for name in names}
            median = statistics.median(row.rmse for row in own)
            result.append(HeldOutRow(f"median of {len(own)}", channel, median, own[0].unit, baselines))
    return result


def offset_rows(result: Mapping[str, Any]) -> list[Sequence[str]]:
    """Head and rows of the torque offsets of a result, joints below each other; empty where they are no part of it."""
    offsets: Mapping[str, Mapping[str, Any]] = result.get("torque_offsets", {})
    if not offsets:
        return []
    shown = dict(list(offsets.items())[:MOST_OFFSETS])
    rows: list[Sequence[str]] = [("torque offset [N m]", *shown, "expected")]
    for joint in dict.fromkeys(joint for entry in shown.values() for joint in entry):
        own = [entry.get(joint) for entry in shown.values()]
        cells = ["" if known is None else f"{known['value']:.2f} ± {known['std']:.2f}" for known in own]
        priors = dict.fromkeys(f"± {known['prior_std']:.2g}" for known in own if known is not None)
        rows.append((joint, *cells, ", ".join(priors)))
    left = len(offsets) - len(shown)
    if left:
        rows.append((f"{left} more recordings are in result.json", *("" for _ in shown), ""))
    return rows


def guess_sentences(worse: Sequence[Mapping[str, Any]]) -> list[str]:
    """Sentences on the channels of a `yid-solve/1` result that a guess without a model predicts better."""
    lines = []
    for entry in worse[:MOST_POINTS]:
        own, other = (f"{entry[key]:.3g} {entry['unit']}".rstrip() for key in ("rmse", "guess"))
        where = f"{entry['channel']} of {entry['recording']}"
        lines.append(f"worse than a guess without a model: {where}, {own} against {other} ({entry['baseline']})")
    if len(worse) > MOST_POINTS:
        lines.append(f"and so for {len(worse) - MOST_POINTS} more channels, in result.json")
    return lines


def blind_table(result: Mapping[str, Any]) -> list[str]:
    """The score and every case, as Markdown."""

    def share(value: float | None, digits: int = 0) -> str:
        return "-" if value is None else f"{100 * value:.{digits}f} %"

    def row(*cells: str) -> str:
        return f"| {' | '.join(cells)} |"

    def rate(own: Mapping[str, Any]) -> str:
        if not own["of"]:
            return "-"
        return f"{share(own['rate'])} ({own['count']} of {own['of']}, {share(own['low'])} to {share(own['high'])})"

    sure = {name: rate(own) for name, own in result["intervals"].items()}
    lines = [row("what", "value, and its binomial 95 % interval"), row("---", "---")]
    lines += [
        row("false alarms on clean data", sure["false_alarms"]),
        row("true kind and place first, of the gaps found", sure["kind_first"]),
        row("among the first two", sure["kind_in_two"]),
        row("place first", sure["location_first"]),
        row("sets named as not separable hold the truth", sure["confusable_covers"]),
        row("their size", "-" if result["confusable_size"] is None else f"{result['confusable_size']:.1f}"),
        row("unknown said of effects outside the library", sure["unknown_recall"]),
        row("their place", sure["unknown_location"]),
        row("pairs found", sure["pairs_right"]),
        row("closure over that of the true effect refitted", share(result["closure_of_best"])),
        row("median error of the effects' parameters", share(result["parameter_error"], 1)),
        row("their 95 % intervals that hold the truth", sure["interval_coverage"]),
        row("time of one diagnosis", "-" if result["seconds"] is None else f"{result['seconds']:.0f} s"),
    ]
    lines += ["", row("size / detectable", "cases", "gap seen", "right"), row(*["---"] * 4)]
    for size, entry in result["detection"].items():
        own = result["detection_intervals"][size]
        lines.append(row(size, str(entry["cases"]), rate(own["gap"]), rate(own["right"])))
    lines += ["", row("experiment", "cases", "false alarms", "right"), row(*["---"] * 4)]
    for name, own in result["experiments"].items():
        lines.append(row(name, str(own["cases"]), rate(own["false_alarms"]), rate(own["right"])))
    head = (
        "case",
        "experiment",
        "sort",
        "truth",
        "size",
        "verdict",
        "added",
        "not separable",
        "place",
        "closure",
        "best",
        "time",
    )
    lines += ["", row(*head), row(*["---"] * len(head))]
    for entry in result["marks"]:
        lines.append(
            row(
                entry["case"],
                entry["experiment"],
                entry["category"],
                entry["truth"],
                "-" if entry["multiple"] is None else f"{entry['multiple']:.3g}",
                entry["verdict"] + ("" if entry["right"] or entry["category"] == "finer_chain" else " (wrong)"),
                entry["answer"],
                ", ".join(entry["confusable"]) or "-",
                "right" if entry["location_first"] else "-",
                share(entry["closure"]),
                share(entry["best"]),
                "-" if entry["seconds"] is None else f"{entry['seconds']:.0f} s",
            )
        )
    return lines


def plan_rows(result: Mapping[str, Any]) -> Sequence[tuple[str, ...]]:
    """What a `yid-plan/1` asks of every joint, with a head."""

    def percent(share: float | None) -> str:
        return "" if share is None else f"{100 * share:.0f} %"

    rows = [("joint", "travel [rad or m]", "largest velocity, of its limit", "largest effort, of its limit")]
    for name, own in result["joints"].items():
        travel = own["travel"] if own["travel"] > 1e-9 else 0.0
        rows.append((name, f"{travel:.3g}", percent(own["velocity"]), percent(own["effort"])))
    return rows


def plan_sentences(result: Mapping[str, Any]) -> list[str]:
    """What a `yid-plan/1` says of the point in the end."""
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


def information_rows(result: Mapping[str, Any]) -> Sequence[tuple[str, ...]]:
    """What a `yid-plan/1` of goal information expects of every parameter, with a head."""

    def percent(std: float | None) -> str:
        return "unknown" if std is None else f"± {100 * std:.2g} %"

    rows = [("parameter", "from the recordings", "from this motion", "from both", "verdict of this motion")]
    for name, own in result["parameters"].items():
        stds = (percent(own[f"std_relative_{when}"]) for when in ("before", "after", "together"))
        rows.append((name, *stds, VERDICT_WORDS[own["verdict"]]))
    return rows


def distance_rows(result: Mapping[str, Any]) -> Sequence[tuple[str, ...]]:
    """How far effects lie apart in a `yid-plan/1` of goal information, with a head."""
    rows = [("effect", "beside what could be", "apart in the recordings", "apart in this motion")]
    for own in result["distances"]:
        rows.append((own["effect"], own["explained_by"], *(f"{own[when]:.3g} std" for when in ("before", "after"))))
    return rows


def information_sentences(result: Mapping[str, Any]) -> list[str]:
    """What a `yid-plan/1` of goal information says of its search and of what limits it."""
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

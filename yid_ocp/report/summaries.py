"""Summary of every command's result, by result format; shared by terminal and HTML report."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from yid_ocp.report.blocks import Block, Command, Rows, Statement, Table, filled, statements
from yid_ocp.report.earlier import baseline_rows, counterfactual_rows, history_rows, history_sentences, run_rows
from yid_ocp.report.fleet import SHOWN, batch_rows, batch_sentences, spread_rows
from yid_ocp.report.inspection import check_summary, inspect_summary, simulate_summary
from yid_ocp.report.tables import (
    blind_sentences,
    blind_tables,
    distance_rows,
    doubt_blocks,
    error_words,
    event_rows,
    gap_rows,
    guess_sentences,
    guess_words,
    held_out_rows,
    information_rows,
    information_sentences,
    medians,
    moved_sentences,
    offset_rows,
    place_rows,
    plan_rows,
    plan_sentences,
    readable,
)
from yid_ocp.solvers.words import VERDICT_WORDS, fit_words, interval_words, parameter_words, percent_words


def solve_summary(result: Mapping[str, Any]) -> list[Block]:
    """Summary blocks of a `yid-solve/1` result."""
    free = {name: entry for name, entry in result["parameters"].items() if entry["free"]}
    failed = result["status"] == "failed"
    blocks: list[Block] = [] if failed else _misfit(result["fit"])
    blocks += [*doubt_blocks(result), Table(_estimate_rows(free, failed), "Parameters", key=True)]
    rows: Rows = [("channel", "error (rms)", "unit", "samples")]
    rows += [(c, *error_words(e["rmse"], e["unit"]), str(e["n"])) for c, e in result["residuals"].items()]
    blocks += filled(Table(rows, "Errors where it was fitted"))
    for entry in result["held_out"]:
        if "message" in entry:
            text = f"held-out recording {entry['recording']} could not be predicted: {entry['message']}"
            blocks.append(Statement(text))
    rows = [("held-out recording", "channel", "error (rms)", "unit", "without a model")]
    predicted = held_out_rows(result)
    for row in [*predicted, *medians(predicted)]:
        error, unit = error_words(row.rmse, row.unit)
        without = ", ".join(f"{error_words(other, row.unit)[0]} ({name})" for name, other in row.baselines.items())
        rows.append((row.recording, row.channel, error, unit, without))
    blocks += filled(Table(rows, "Errors on held-out recordings, never touched by the fit"))
    blocks += statements([guess_words(predicted)])
    blocks += filled(Table(offset_rows(result), "How far the torques are off"))
    blocks += statements([*moved_sentences(result), *result.get("discretisation_notes", ())])
    if failed:
        said = "the values are the best point that was reached; nothing can be said about how sure they are"
        blocks.append(Statement(said, "verdict"))
    else:
        blocks += _unsure(free)
        if result["fit"]["explains"]:
            blocks.append(Statement(fit_words(result["fit"]["chi2_per_dof"], True), "conclusion"))
    blocks += statements([result.get("safeguard", "")])
    ended = f"{result['status']}: {result['message']} ({result['iterations']} iterations, {result['seconds']:.1f} s)"
    return [*blocks, Statement(ended, "note" if result["status"] == "converged" else "conclusion")]


def _estimate_rows(free: Mapping[str, Mapping[str, Any]], failed: bool) -> Rows:
    rows: Rows = [("parameter", "value", "± std", "95 % interval", "unit", "verdict", "start", "bounds")]
    for name, entry in free.items():
        known = not failed and entry["std"] is not None
        std = f"{entry['std']:.2g}" if known and entry["verdict"] != "at_bound" else ""
        interval = "" if failed or entry["interval"] is None else interval_words(*entry["interval"])
        verdict = "" if failed else VERDICT_WORDS[entry["verdict"]]
        low = "-inf" if entry["lower"] is None else f"{entry['lower']:.4g}"
        high = "inf" if entry["upper"] is None else f"{entry['upper']:.4g}"
        own = (f"{entry['value']:.4g}", std, interval, entry["unit"], verdict, f"{entry['initial']:.4g}")
        rows.append((name, *own, f"{low} to {high}"))
    return rows


def _misfit(fit: Mapping[str, Any]) -> list[Block]:
    """What has to be said before anything else: a guess does better, or the model does not explain the recordings."""
    said = guess_sentences(fit.get("worse_than_guess", ()))
    return statements([*said, *([] if fit["explains"] else [fit_words(fit["chi2_per_dof"], False)])], "conclusion")


def _unsure(free: Mapping[str, Mapping[str, Any]]) -> list[Block]:
    """Sentences on the parameters that are found, and on those that are not."""
    by = {v: [name for name, entry in free.items() if entry["verdict"] == v] for v in VERDICT_WORDS}
    found, weak, bound, lost = (by[v] for v in ("identifiable", "weak", "at_bound", "not_identifiable"))
    said = (
        [
            f"{len(found)} of {len(free)} free parameters are found to within 10 % of their value or, near zero, of "
            f"their usual size: {', '.join(found)}"
        ]
        if found
        else []
    )
    if lost:
        said.append(f"{VERDICT_WORDS['not_identifiable']} from these recordings: {', '.join(lost)}")
    if weak:
        said.append(f"only {VERDICT_WORDS['weak']}: {', '.join(weak)}")
        if any(free[name]["interval"] is None for name in weak):
            said.append("`yid-ocp identifiability` gives intervals that need not be symmetric")
    if bound:
        said.append(f"the search ended at a bound of {', '.join(bound)}: what is beyond it was not tried")
    return statements(said, "verdict")


def plan_summary(result: Mapping[str, Any]) -> list[Block]:
    """Summary blocks of a `yid-plan/1` result."""
    blocks: list[Block] = [Table(list(plan_rows(result)), "What it asks of the joints", key=True)]
    if result["goal"] == "information":
        told = (Table(list(information_rows(result)), "What it tells"), Table(list(distance_rows(result)), "Effects"))
        blocks += filled(*told)
        said = information_sentences(result)
    else:
        said = plan_sentences(result)
    ended = Statement(f"{result['status']}: {result['message']}", "conclusion")
    return [*blocks, *statements(said, "verdict"), ended]


def track_summary(result: Mapping[str, Any]) -> list[Block]:
    """Summary blocks of a `yid-track/1` result."""
    truth = result["truth_errors"]
    heads = ("error, median [mm]", "error, largest [mm]") if truth else ("", "")
    rows: Rows = [("point", "frames", "± std [mm]", *heads)]
    for name, entry in result["points"].items():
        cells = ["" if entry["std"] is None else f"{1e3 * entry['std']:.1f}"]
        cells += [f"{1e3 * truth[name][key]:.1f}" if name in truth else "" for key in ("median", "largest")]
        rows.append((name, str(entry["frames"]), *cells))
    good = sum(not frame["reason"] for frame in result["frames"])
    spent = 1e3 * result["fit_seconds"]
    said = f"{good} of {len(result['frames'])} frames are good, the fit took {spent:.0f} ms each"
    dropped = [f"dropped {number}: {reason}" for reason, number in result["dropped"].items()]
    if result["refused"]:
        said = result["refused"]
    return [
        *doubt_blocks(result),
        *([Table(rows, "Points", key=True)] if result["points"] else []),
        Statement(said, "verdict"),
        *statements([*dropped, result["camera"]["message"], *result["sizes"]["messages"]]),
        *statements([*([result["root"]] if result["root"] else []), *(thing["text"] for thing in result["things"])]),
    ]


def compare_summary(result: Mapping[str, Any]) -> list[Block]:
    """Summary blocks of a `yid-compare/1` result."""
    methods: dict[str, Any] = result["methods"]
    judged, disturbed = result["judged"], result["disturbed"]
    free = [name for name, entry in judged["parameters"].items() if entry["free"]]
    runs = methods | ({"all noise": judged} if disturbed else {})
    beside = [key for key in ("published", "truth") if result[key]]
    rows: Rows = [("parameter", *runs, *beside, "verdict")]
    for name in free:
        cells = []
        for entry in runs.values():
            found = entry["parameters"][name]
            # elsewhere a curvature tells nothing of how sure it is
            ended = entry["status"] not in ("stalled", "failed")
            known = (found["std"], found["interval"]) if ended else (None, None)
            cells.append(parameter_words(found["value"], *known))
        others = [f"{result[key][name]:.4g}" if name in result[key] else "" for key in beside]
        rows.append((name, *cells, *others, VERDICT_WORDS[judged["parameters"][name]["verdict"]]))
    said = [f"{n} did not converge: {e['message']}" for n, e in methods.items() if e["status"] != "converged"]
    said += [f"{name} differs: {sentence}" for name, entry in methods.items() for sentence in entry["disagreements"]]
    said += result["explained"]
    if disturbed:
        said.append(
            "the methods are compared by the sensors' noise alone; the column 'all noise' and the verdicts weigh the "
            "noise that drives the motion as well"
        )
    said += result["published_explained"]
    return [
        *_misfit(judged["fit"]),
        *doubt_blocks(result),
        Table(rows, "Parameters by method", key=True),
        Table(_efforts(methods), "What it took"),
        *statements(said),
        *statements(_agreement(result), "conclusion"),
    ]


def _agreement(result: Mapping[str, Any]) -> list[str]:
    judged, fit = result["judged"]["parameters"].values(), result["judged"]["fit"]
    if not fit["explains"]:
        return ["the model does not explain the recordings, so agreement of methods says nothing of the truth"]
    if not fit["believed"]:
        return ["the recordings are in doubt, so agreement of methods says nothing of the truth"]
    if not any(entry["verdict"] == "identifiable" for entry in judged if entry["free"]):
        return [
            "no parameter can be found from these recordings, so there is nothing to agree on",
            "`yid-ocp identifiability CONFIG --what-if` says what would have to be measured",
        ]
    if not result["agree"]:
        return ["the methods do not agree on the parameters that are found"]
    said = ["all methods agree within their uncertainty on the parameters that are found"]
    if result["disturbed"]:
        said.append("where the column 'all noise' is elsewhere, the torques' errors have misled them all alike")
    return said


def _efforts(methods: Mapping[str, Mapping[str, Any]]) -> Rows:
    """What every method reached and what it took."""
    entries = methods.values()
    costs = [entry["whitened_cost"] for entry in entries]
    rows: Rows = [("", *methods)]
    rows.append(("status", *(entry["status"] for entry in entries)))
    rows.append(("cost (whitened)", *("failed" if cost is None else f"{cost:.6g}" for cost in costs)))
    ratios = [entry["fit"]["chi2_per_dof"] for entry in entries]
    rows.append(("chi2 per degree of freedom", *("unknown" if r is None else f"{r:.3g}" for r in ratios)))
    units = {c: own["unit"] for entry in entries for c, own in entry["residuals"].items()}
    for channel in sorted({c for e in entries for h in e["held_out"] for c in h.get("rmse", {})}):
        members = [unit for name, unit in units.items() if name == channel or name.startswith(f"{channel}.")]
        unit = members[0] if members else ""
        errors = [[h["rmse"][channel] for h in e["held_out"] if channel in h.get("rmse", {})] for e in entries]
        cells = (error_words(sum(e) / len(e), unit)[0] if e else "failed" for e in errors)
        rows.append((f"held out: {channel} [{readable(unit)[1]}]" if unit else f"held out: {channel}", *cells))
    rows.append(("iterations", *(str(entry["iterations"]) for entry in entries)))
    rows.append(("evaluations", *(str(entry["evaluations"]) for entry in entries)))
    rows.append(("wall time [s]", *(f"{entry['wall_seconds']:.2f}" for entry in entries)))
    rows.append(("CPU time [s]", *(f"{entry['cpu_seconds']:.2f}" for entry in entries)))
    rows.append(("peak memory [MiB]", *(f"{entry['peak_memory_mib']:.0f}" for entry in entries)))
    return rows


def identifiability_summary(result: Mapping[str, Any]) -> list[Block]:
    """Summary blocks of a `yid-identifiability/1` result."""
    if not result["parameters"]:
        text = f"{result['status']}: {result['message']}; there is no point at which to judge"
        return [Statement(text, "verdict")]
    unsure = "± if start and grasps were unknown"
    rows: Rows = [("parameter", "value", "±", unsure, "± if all else were known", "95 % interval", "unit", "verdict")]
    for name, entry in result["parameters"].items():
        spread = (_percent(entry[key]) for key in ("std_relative", "std_relative_unknown", "std_alone"))
        interval = "" if entry["interval"] is None else interval_words(*entry["interval"])
        rows.append((name, f"{entry['value']:.4g}", *spread, interval, entry["unit"], VERDICT_WORDS[entry["verdict"]]))
    blocks: list[Block] = [] if result["fit"] is None else _misfit(result["fit"])
    blocks += [*doubt_blocks(result), Table(rows, "Parameters", key=True)]
    hidden = [entry["words"] for entry in result["directions"] if entry["verdict"] != "identifiable"]
    if len(hidden) > 8:
        hidden = [*hidden[:8], f"and {len(hidden) - 8} more directions, in result.json"]
    blocks += statements(hidden)
    if not result["profiles"]:
        blocks.append(
            Statement("intervals of parameters are worked out on request: --intervals NAME,NAME or --intervals all")
        )
    blocks += statements(f"{name}: {note}" for name, entry in result["profiles"].items() for note in entry["notes"])
    blocks += [] if result["what_if"] is None else _what_if(result["what_if"], list(result["parameters"]))
    found = [name for name, entry in result["parameters"].items() if entry["verdict"] == "identifiable"]
    said = f"{len(found) or 'none'} of {len(result['parameters'])} parameters can be found from these recordings"
    blocks.append(Statement(said, "conclusion"))
    lost = [name for name in found if result["parameters"][name]["verdict_unknown"] != "identifiable"]
    if lost:
        blocks.append(Statement(f"not found if start and grasps were unknown: {', '.join(lost)}", "verdict"))
    return blocks


def _what_if(asked: Mapping[str, Any], names: Sequence[str]) -> list[Block]:
    """Changes of the experiment, the best ones first."""
    rows: Rows = [("change", "found", "gain [nat]", "")]
    for entry in [asked["base"], *asked["singles"], *asked["smallest"]]:
        gain = "" if entry["gain"] is None else f"{entry['gain']:.1f}"
        rows.append((entry["words"], f"{entry['identifiable']} of {len(names)}", gain, entry["message"]))
    said = "with no set of up to three changes can all of them be found"
    if asked["smallest"]:
        said = f"fewest changes with which all of them can be found: {asked['smallest'][0]['words']}"
    return [Table(rows, "What another experiment would tell"), Statement(said, "verdict")]


def _percent(value: float | None) -> str:
    return "unknown" if value is None else f"{percent_words(value)} %" if value < 10 else f"{value:.2g} times"


def _known(name: str, quantity: Mapping[str, Any], refitted: bool) -> str:
    """A candidate's parameter; without a refit its value is a first step and has no standard deviation."""
    unit = "" if quantity["unit"] == "1" else f" {quantity['unit']}"
    if quantity["std"] is None:
        return f"{name} unknown" if refitted else f"{name} = {quantity['value']:.3g}{unit}"
    return f"{name} = {quantity['value']:.3g} ± {quantity['std']:.2g}{unit}"


CANDIDATES = 15
"""Candidates that are listed; result.json has them all."""


def diagnose_summary(result: Mapping[str, Any]) -> list[Block]:
    """Summary blocks of a `yid-diagnosis/1` result."""
    blocks = [*doubt_blocks(result), Statement(result["summary"], "verdict")]
    blocks += filled(Table(gap_rows(result), "Errors on held-out recordings", key=True))
    rows: Rows = [("candidate", "parameters", "closure alone", "score", "p")]
    for entry in result["which"][:CANDIDATES]:
        known = {name: q for name, q in entry["parameters"].items() if q["value"] is not None}
        values = ", ".join(_known(name, quantity, entry["closure"] is not None) for name, quantity in known.items())
        closed = "" if entry["closure"] is None else f"{100 * entry['closure']:.3g} %"
        label = f"{entry['kind']}@{entry['location']}"
        p = f"{entry['p_value']:.2g}" if entry["p_value"] > 1e-12 else "< 1e-12"
        rows.append((label, values, closed, f"{entry['score']:.3g}", p))
    blocks += filled(Table(place_rows(result), "Where"), Table(event_rows(result), "Events"), Table(rows, "Candidates"))
    left = len(result["which"]) - CANDIDATES
    said = [f"{left} more candidates are in result.json"] if left > 0 else []
    if result.get("unseen"):
        said.append(f"these recordings could not show: {', '.join(result['unseen'])}")
    blocks += statements(said)
    blocks += filled(
        Table(baseline_rows(result), "Since the baseline"),
        Table(counterfactual_rows(result), "Without the effects, and with them"),
        Table(offset_rows(result), "How far the torques are off"),
    )
    if result.get("doubts"):
        blocks.append(Statement("what is in doubt about the recordings may be what the verdict is about"))
    if result["next_plan"] is not None:
        blocks.append(Statement("to separate what looks alike, plan a motion:"))
        blocks.append(Command(planning_command(result["next_plan"])))
    ended = f"verdict: {result['verdict'].replace('_', ' ')} ({sum(result['seconds'].values()):.1f} s)"
    return [*blocks, Statement(ended)]


def history_summary(result: Mapping[str, Any]) -> list[Block]:
    """Summary blocks of a `yid-history/1` result."""
    return [
        Table(history_rows(result), "Parameters", key=True),
        Table(run_rows(result), "Runs"),
        *statements(history_sentences(result), "verdict"),
    ]


def planning_command(section: Mapping[str, Any]) -> str:
    """Shell command that plans the motion of a `plan` section with the configuration in its run folder."""
    words = ["yid-ocp", "plan", str(Path(section["run"]) / "config.yaml")]
    for key, value in section.items():
        text = f"[{', '.join(value)}]" if isinstance(value, list) else str(value)
        words += ["--set", f"plan.{key}={text}"]
    return shlex.join(words)


def blind_summary(result: Mapping[str, Any]) -> list[Block]:
    """Summary blocks of a `yid-blind/1` result."""
    score, *others, cases = (Table(rows, title) for title, rows in blind_tables(result).items())
    said = statements(blind_sentences(result), "verdict")
    return [replace(score, key=True), *filled(*others, replace(cases, long=True)), *said]


def batch_summary(result: Mapping[str, Any]) -> list[Block]:
    """Summary blocks of a `yid-batch/1` result."""
    links = {entry["name"]: f"{entry['folder']}/report.html" for entry in result["runs"] if entry["folder"]}
    blocks: list[Block] = [Table(batch_rows(result, SHOWN), "Runs", key=True, links=links)]
    blocks += filled(Table(spread_rows(result), "Parameters over all runs"))
    whole = batch_rows(result)
    if len(whole[0]) > len(batch_rows(result, SHOWN)[0]):
        blocks.append(Table(whole, "Runs with all parameters", long=True, links=links))
    if result["history"] is not None:
        blocks.append(Table(run_rows(result["history"]), "Each run against the others"))
    return [*blocks, *statements(batch_sentences(result), "verdict")]


def export_summary(manifest: Mapping[str, Any]) -> list[Block]:
    """Summary blocks of a `yid-export/1` manifest."""
    said = [*manifest["effects"].items(), *((f"grasp {name}", own) for name, own in manifest.get("grasps", {}).items())]
    effects = {name.rpartition(".")[0] for name in manifest["parameters"] if "@" in name}
    said += [
        (name, entry)
        for name, entry in manifest["parameters"].items()
        if entry["status"] != "native" and name.rpartition(".")[0] not in effects
    ]
    rows: Rows = [("of the model", "in the file", "how, or why not")]
    rows += [(name, entry["status"], entry["how"]) for name, entry in said]
    blocks = filled(Table(rows))
    gate = manifest["gate"]
    if gate is None:
        return blocks
    if gate["status"] != "done":
        return [*blocks, Statement(f"not replayed: {gate['reason']}")]
    rows = [("replayed channel", "nominal", "exported", "noise", "unit")]
    for name, entry in gate["channels"].items():
        sizes = (error_words(entry[key], entry["unit"])[0] for key in ("before", "after", "noise"))
        rows.append((name, *sizes, readable(entry["unit"])[1]))
    blocks.append(Table(rows))
    if gate["fall"] is not None:
        held = "held-out recordings" if gate["which"] == "held_out" else "the recordings that were fitted"
        blocks.append(
            Statement(f"replayed in MuJoCo, the error beyond noise on {held} falls by {100 * gate['fall']:.3g} %")
        )
    return blocks


SUMMARIES: Mapping[str, Callable[[Mapping[str, Any]], list[Block]]] = {
    "yid-solve/1": solve_summary,
    "yid-compare/1": compare_summary,
    "yid-identifiability/1": identifiability_summary,
    "yid-diagnosis/1": diagnose_summary,
    "yid-history/1": history_summary,
    "yid-plan/1": plan_summary,
    "yid-track/1": track_summary,
    "yid-check/1": check_summary,
    "yid-inspect/1": inspect_summary,
    "yid-simulate/1": simulate_summary,
    "yid-blind/1": blind_summary,
    "yid-batch/1": batch_summary,
}
"""By the format of a result, for what writes a page."""

"""Summary of every command's result, by result format; shared by terminal and HTML report."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from yid_ocp.report.model_summaries import check_summary, inspect_summary, simulate_summary
from yid_ocp.report.run_comparison_tables import (
    MAX_TERMINAL_PARAMETERS,
    baseline_rows,
    batch_rows,
    batch_sentences,
    counterfactual_rows,
    history_rows,
    history_sentences,
    parameter_spread_rows,
    run_consistency_rows,
)
from yid_ocp.report.tables import (
    baseline_legend,
    blind_sentences,
    blind_tables,
    discretisation_sentences,
    display_scale_and_unit,
    effect_distance_rows,
    event_rows,
    format_error_and_unit,
    gap_error_rows,
    gap_location_rows,
    held_out_error_rows,
    information_sentences,
    issue_blocks,
    median_error_rows,
    parameter_information_rows,
    plan_joint_rows,
    plan_sentences,
    torque_offset_rows,
    worse_than_baseline_sentences,
)
from yid_ocp.report.terminal import (
    CodeBlock,
    SummaryBlock,
    SummaryStatement,
    SummaryTable,
    TableRows,
    make_statements,
    nonempty_tables,
)
from yid_ocp.solvers.fit_messages import VERDICT_WORDS, fit_message, interval_text, parameter_text, percent_text


def solve_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-solve/1` result."""
    free = {name: entry for name, entry in result["parameters"].items() if entry["free"]}
    failed = result["status"] == "failed"
    blocks: list[SummaryBlock] = [] if failed else _misfit(result["fit"])
    blocks += [*issue_blocks(result), SummaryTable(_estimate_rows(free, failed), "Parameters", is_key_table=True)]
    rows: TableRows = [("channel", "error (rms)", "unit", "samples")]
    rows += [(c, *format_error_and_unit(e["rmse"], e["unit"]), str(e["n"])) for c, e in result["residuals"].items()]
    blocks += nonempty_tables(SummaryTable(rows, "Errors where it was fitted"))
    for entry in result["held_out"]:
        if "message" in entry:
            text = f"held-out recording {entry['recording']} could not be predicted: {entry['message']}"
            blocks.append(SummaryStatement(text))
    rows = [("held-out recording", "channel", "error (rms)", "unit", "without a model")]
    predicted = held_out_error_rows(result)
    for row in [*predicted, *median_error_rows(predicted)]:
        error, unit = format_error_and_unit(row.rmse, row.unit)
        without = ", ".join(
            f"{format_error_and_unit(other, row.unit)[0]} ({name})" for name, other in row.baselines.items()
        )
        rows.append((row.recording, row.channel, error, unit, without))
    blocks += nonempty_tables(SummaryTable(rows, "Errors on held-out recordings, never touched by the fit"))
    blocks += make_statements([baseline_legend(predicted)])
    blocks += nonempty_tables(SummaryTable(torque_offset_rows(result), "How far the torques are off"))
    blocks += make_statements([*discretisation_sentences(result), *result.get("discretisation_notes", ())])
    if failed:
        said = "the values are the best point that was reached; nothing can be said about how sure they are"
        blocks.append(SummaryStatement(said, "verdict"))
    else:
        blocks += _unsure(free)
        if result["fit"]["explains"]:
            blocks.append(SummaryStatement(fit_message(result["fit"]["chi2_per_dof"], True), "conclusion"))
    blocks += make_statements([result.get("safeguard", "")])
    ended = f"{result['status']}: {result['message']} ({result['iterations']} iterations, {result['seconds']:.1f} s)"
    return [*blocks, SummaryStatement(ended, "note" if result["status"] == "converged" else "conclusion")]


def _estimate_rows(free: Mapping[str, Mapping[str, Any]], failed: bool) -> TableRows:
    rows: TableRows = [("parameter", "value", "± std", "95 % interval", "unit", "verdict", "start", "bounds")]
    for name, entry in free.items():
        known = not failed and entry["std"] is not None
        std = f"{entry['std']:.2g}" if known and entry["verdict"] != "at_bound" else ""
        interval = "" if failed or entry["interval"] is None else interval_text(*entry["interval"])
        verdict = "" if failed else VERDICT_WORDS[entry["verdict"]]
        low = "-inf" if entry["lower"] is None else f"{entry['lower']:.4g}"
        high = "inf" if entry["upper"] is None else f"{entry['upper']:.4g}"
        own = (f"{entry['value']:.4g}", std, interval, entry["unit"], verdict, f"{entry['initial']:.4g}")
        rows.append((name, *own, f"{low} to {high}"))
    return rows


def _misfit(fit: Mapping[str, Any]) -> list[SummaryBlock]:
    """What has to be said before anything else: a guess does better, or the model does not explain the recordings."""
    said = worse_than_baseline_sentences(fit.get("worse_than_guess", ()))
    return make_statements(
        [*said, *([] if fit["explains"] else [fit_message(fit["chi2_per_dof"], False)])], "conclusion"
    )


def _unsure(free: Mapping[str, Mapping[str, Any]]) -> list[SummaryBlock]:
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
    return make_statements(said, "verdict")


def plan_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-plan/1` result."""
    blocks: list[SummaryBlock] = [
        SummaryTable(list(plan_joint_rows(result)), "What it asks of the joints", is_key_table=True)
    ]
    if result["goal"] == "information":
        told = (
            SummaryTable(list(parameter_information_rows(result)), "What it tells"),
            SummaryTable(list(effect_distance_rows(result)), "Effects"),
        )
        blocks += nonempty_tables(*told)
        said = information_sentences(result)
    else:
        said = plan_sentences(result)
    ended = SummaryStatement(f"{result['status']}: {result['message']}", "conclusion")
    return [*blocks, *make_statements(said, "verdict"), ended]


def track_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-track/1` result."""
    truth = result["truth_errors"]
    heads = ("error, median [mm]", "error, largest [mm]") if truth else ("", "")
    rows: TableRows = [("point", "frames", "± std [mm]", *heads)]
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
        *issue_blocks(result),
        *([SummaryTable(rows, "Points", is_key_table=True)] if result["points"] else []),
        SummaryStatement(said, "verdict"),
        *make_statements([*dropped, result["camera"]["message"], *result["sizes"]["messages"]]),
        *make_statements(
            [*([result["root"]] if result["root"] else []), *(thing["text"] for thing in result["things"])]
        ),
    ]


def compare_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-compare/1` result."""
    methods: dict[str, Any] = result["methods"]
    judged, disturbed = result["judged"], result["disturbed"]
    free = [name for name, entry in judged["parameters"].items() if entry["free"]]
    runs = methods | ({"all noise": judged} if disturbed else {})
    beside = [key for key in ("published", "truth") if result[key]]
    rows: TableRows = [("parameter", *runs, *beside, "verdict")]
    for name in free:
        cells = []
        for entry in runs.values():
            found = entry["parameters"][name]
            # elsewhere a curvature tells nothing of how sure it is
            ended = entry["status"] not in ("stalled", "failed")
            known = (found["std"], found["interval"]) if ended else (None, None)
            cells.append(parameter_text(found["value"], *known))
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
        *issue_blocks(result),
        SummaryTable(rows, "Parameters by method", is_key_table=True),
        SummaryTable(_efforts(methods), "What it took"),
        *make_statements(said),
        *make_statements(_agreement(result), "conclusion"),
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


def _efforts(methods: Mapping[str, Mapping[str, Any]]) -> TableRows:
    entries = methods.values()
    costs = [entry["whitened_cost"] for entry in entries]
    rows: TableRows = [("", *methods)]
    rows.append(("status", *(entry["status"] for entry in entries)))
    rows.append(("cost (whitened)", *("failed" if cost is None else f"{cost:.6g}" for cost in costs)))
    ratios = [entry["fit"]["chi2_per_dof"] for entry in entries]
    rows.append(("chi2 per degree of freedom", *("unknown" if r is None else f"{r:.3g}" for r in ratios)))
    units = {c: own["unit"] for entry in entries for c, own in entry["residuals"].items()}
    for channel in sorted({c for e in entries for h in e["held_out"] for c in h.get("rmse", {})}):
        members = [unit for name, unit in units.items() if name == channel or name.startswith(f"{channel}.")]
        unit = members[0] if members else ""
        errors = [[h["rmse"][channel] for h in e["held_out"] if channel in h.get("rmse", {})] for e in entries]
        cells = (format_error_and_unit(sum(e) / len(e), unit)[0] if e else "failed" for e in errors)
        rows.append(
            (f"held out: {channel} [{display_scale_and_unit(unit)[1]}]" if unit else f"held out: {channel}", *cells)
        )
    rows.append(("iterations", *(str(entry["iterations"]) for entry in entries)))
    rows.append(("evaluations", *(str(entry["evaluations"]) for entry in entries)))
    rows.append(("wall time [s]", *(f"{entry['wall_seconds']:.2f}" for entry in entries)))
    rows.append(("CPU time [s]", *(f"{entry['cpu_seconds']:.2f}" for entry in entries)))
    rows.append(("peak memory [MiB]", *(f"{entry['peak_memory_mib']:.0f}" for entry in entries)))
    return rows


def identifiability_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-identifiability/1` result."""
    if not result["parameters"]:
        text = f"{result['status']}: {result['message']}; there is no point at which to judge"
        return [SummaryStatement(text, "verdict")]
    unsure = "± if start and grasps were unknown"
    rows: TableRows = [
        ("parameter", "value", "±", unsure, "± if all else were known", "95 % interval", "unit", "verdict")
    ]
    for name, entry in result["parameters"].items():
        spread = (_percent(entry[key]) for key in ("std_relative", "std_relative_unknown", "std_alone"))
        interval = "" if entry["interval"] is None else interval_text(*entry["interval"])
        rows.append((name, f"{entry['value']:.4g}", *spread, interval, entry["unit"], VERDICT_WORDS[entry["verdict"]]))
    blocks: list[SummaryBlock] = [] if result["fit"] is None else _misfit(result["fit"])
    blocks += [*issue_blocks(result), SummaryTable(rows, "Parameters", is_key_table=True)]
    hidden = [entry["words"] for entry in result["directions"] if entry["verdict"] != "identifiable"]
    if len(hidden) > 8:
        hidden = [*hidden[:8], f"and {len(hidden) - 8} more directions, in result.json"]
    blocks += make_statements(hidden)
    if not result["profiles"]:
        blocks.append(
            SummaryStatement(
                "intervals of parameters are worked out on request: --intervals NAME,NAME or --intervals all"
            )
        )
    blocks += make_statements(
        f"{name}: {note}" for name, entry in result["profiles"].items() for note in entry["notes"]
    )
    blocks += [] if result["what_if"] is None else _what_if(result["what_if"], list(result["parameters"]))
    found = [name for name, entry in result["parameters"].items() if entry["verdict"] == "identifiable"]
    said = f"{len(found) or 'none'} of {len(result['parameters'])} parameters can be found from these recordings"
    blocks.append(SummaryStatement(said, "conclusion"))
    lost = [name for name in found if result["parameters"][name]["verdict_unknown"] != "identifiable"]
    if lost:
        blocks.append(SummaryStatement(f"not found if start and grasps were unknown: {', '.join(lost)}", "verdict"))
    return blocks


def _what_if(asked: Mapping[str, Any], names: Sequence[str]) -> list[SummaryBlock]:
    rows: TableRows = [("change", "found", "gain [nat]", "")]
    for entry in [asked["base"], *asked["singles"], *asked["smallest"]]:
        gain = "" if entry["gain"] is None else f"{entry['gain']:.1f}"
        rows.append((entry["words"], f"{entry['identifiable']} of {len(names)}", gain, entry["message"]))
    said = "with no set of up to three changes can all of them be found"
    if asked["smallest"]:
        said = f"fewest changes with which all of them can be found: {asked['smallest'][0]['words']}"
    return [SummaryTable(rows, "What another experiment would tell"), SummaryStatement(said, "verdict")]


def _percent(value: float | None) -> str:
    return "unknown" if value is None else f"{percent_text(value)} %" if value < 10 else f"{value:.2g} times"


def _known(name: str, quantity: Mapping[str, Any], refitted: bool) -> str:
    unit = "" if quantity["unit"] == "1" else f" {quantity['unit']}"
    if quantity["std"] is None:
        return f"{name} unknown" if refitted else f"{name} = {quantity['value']:.3g}{unit}"
    return f"{name} = {quantity['value']:.3g} ± {quantity['std']:.2g}{unit}"


_MAX_CANDIDATES = 15  # candidates that are listed; result.json has them all


def diagnose_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-diagnosis/2` result."""
    blocks = [*issue_blocks(result), SummaryStatement(result["summary"], "verdict")]
    blocks += nonempty_tables(SummaryTable(gap_error_rows(result), "Errors on held-out recordings", is_key_table=True))
    rows: TableRows = [("candidate", "parameters", "closure alone", "score", "p")]
    for entry in result["which"][:_MAX_CANDIDATES]:
        known = {name: q for name, q in entry["parameters"].items() if q["value"] is not None}
        values = ", ".join(_known(name, quantity, entry["closure"] is not None) for name, quantity in known.items())
        closed = "" if entry["closure"] is None else f"{100 * entry['closure']:.3g} %"
        label = f"{entry['kind']}@{entry['location']}"
        p = f"{entry['p_value']:.2g}" if entry["p_value"] > 1e-12 else "< 1e-12"
        rows.append((label, values, closed, f"{entry['score']:.3g}", p))
    blocks += nonempty_tables(
        SummaryTable(gap_location_rows(result), "Where"),
        SummaryTable(event_rows(result), "Events"),
        SummaryTable(rows, "Candidates"),
    )
    left = len(result["which"]) - _MAX_CANDIDATES
    said = [f"{left} more candidates are in result.json"] if left > 0 else []
    if result.get("unseen"):
        said.append(f"these recordings could not show: {', '.join(result['unseen'])}")
    blocks += make_statements(said)
    blocks += nonempty_tables(
        SummaryTable(baseline_rows(result), "Since the baseline"),
        SummaryTable(counterfactual_rows(result), "Without the effects, and with them"),
        SummaryTable(torque_offset_rows(result), "How far the torques are off"),
    )
    if result.get("doubts"):
        blocks.append(SummaryStatement("what is in doubt about the recordings may be what the verdict is about"))
    if result["next_plan"] is not None:
        blocks.append(SummaryStatement("to separate what looks alike, plan a motion:"))
        blocks.append(CodeBlock(_planning_command(result["next_plan"])))
    ended = f"verdict: {result['verdict'].replace('_', ' ')} ({sum(result['seconds'].values()):.1f} s)"
    return [*blocks, SummaryStatement(ended)]


def history_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-history/1` result."""
    return [
        SummaryTable(history_rows(result), "Parameters", is_key_table=True),
        SummaryTable(run_consistency_rows(result), "Runs"),
        *make_statements(history_sentences(result), "verdict"),
    ]


def _planning_command(section: Mapping[str, Any]) -> str:
    words = ["yid-ocp", "plan", str(Path(section["parameter_run"]) / "config.yaml")]
    for key, value in section.items():
        text = f"[{', '.join(value)}]" if isinstance(value, list) else str(value)
        words += ["--set", f"plan.{key}={text}"]
    return shlex.join(words)


def blind_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-blind/1` result."""
    score, *others, cases = (SummaryTable(rows, title) for title, rows in blind_tables(result).items())
    said = make_statements(blind_sentences(result), "verdict")
    return [replace(score, is_key_table=True), *nonempty_tables(*others, replace(cases, is_page_only=True)), *said]


def batch_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-batch/1` result."""
    links = {entry["name"]: f"{entry['folder']}/report.html" for entry in result["runs"] if entry["folder"]}
    blocks: list[SummaryBlock] = [
        SummaryTable(batch_rows(result, MAX_TERMINAL_PARAMETERS), "Runs", is_key_table=True, links=links)
    ]
    blocks += nonempty_tables(SummaryTable(parameter_spread_rows(result), "Parameters over all runs"))
    whole = batch_rows(result)
    if len(whole[0]) > len(batch_rows(result, MAX_TERMINAL_PARAMETERS)[0]):
        blocks.append(SummaryTable(whole, "Runs with all parameters", is_page_only=True, links=links))
    if result["history"] is not None:
        blocks.append(SummaryTable(run_consistency_rows(result["history"]), "Each run against the others"))
    return [*blocks, *make_statements(batch_sentences(result), "verdict")]


def export_summary(manifest: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-export/1` manifest."""
    said = [*manifest["effects"].items(), *((f"grasp {name}", own) for name, own in manifest.get("grasps", {}).items())]
    effects = {name.rpartition(".")[0] for name in manifest["parameters"] if "@" in name}
    said += [
        (name, entry)
        for name, entry in manifest["parameters"].items()
        if entry["status"] != "native" and name.rpartition(".")[0] not in effects
    ]
    rows: TableRows = [("of the model", "in the file", "how, or why not")]
    rows += [(name, entry["status"], entry["how"]) for name, entry in said]
    blocks = nonempty_tables(SummaryTable(rows))
    gate = manifest["gate"]
    if gate is None:
        return blocks
    if gate["status"] != "done":
        return [*blocks, SummaryStatement(f"not replayed: {gate['reason']}")]
    rows = [("replayed channel", "nominal", "exported", "noise", "unit")]
    for name, entry in gate["channels"].items():
        sizes = (format_error_and_unit(entry[key], entry["unit"])[0] for key in ("before", "after", "noise"))
        rows.append((name, *sizes, display_scale_and_unit(entry["unit"])[1]))
    blocks.append(SummaryTable(rows))
    if gate["fall"] is not None:
        held = "held-out recordings" if gate["which"] == "held_out" else "the recordings that were fitted"
        blocks.append(
            SummaryStatement(
                f"replayed in MuJoCo, the error beyond noise on {held} falls by {100 * gate['fall']:.3g} %"
            )
        )
    return blocks


SUMMARY_BY_FORMAT: Mapping[str, Callable[[Mapping[str, Any]], list[SummaryBlock]]] = {
    "yid-solve/1": solve_summary,
    "yid-compare/1": compare_summary,
    "yid-identifiability/1": identifiability_summary,
    "yid-diagnosis/2": diagnose_summary,
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

"""Tables and sentences with which a command ends, one function for each format of result."""

from __future__ import annotations

import math
import shlex
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from yid_ocp.data import Recording
from yid_ocp.data.readers import Contents
from yid_ocp.report.earlier import (
    baseline_rows,
    counterfactual_rows,
    history_rows,
    history_sentences,
    run_rows,
)
from yid_ocp.report.fleet import SHOWN, batch_rows, batch_sentences, spread_rows
from yid_ocp.report.tables import (
    blind_table,
    distance_rows,
    doubt_rows,
    doubt_sentences,
    guess_sentences,
    held_out_rows,
    information_rows,
    information_sentences,
    medians,
    offset_rows,
    plan_rows,
    plan_sentences,
)
from yid_ocp.solvers.words import VERDICT_WORDS, fit_words, interval_words, parameter_words, percent_words

Rows = list[Sequence[str]]


def solve_summary(result: Mapping[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-solve/1` result says."""
    free = {name: entry for name, entry in result["parameters"].items() if entry["free"]}
    failed = result["status"] == "failed"
    rows: Rows = [("parameter", "value", "± std", "95 % interval", "unit", "verdict", "start")]
    for name, entry in free.items():
        known = not failed and entry["std"] is not None
        std = f"{entry['std']:.2g}" if known and entry["verdict"] != "at_bound" else ""
        interval = "" if failed or entry["interval"] is None else interval_words(*entry["interval"])
        verdict = "" if failed else VERDICT_WORDS[entry["verdict"]]
        rows.append((name, f"{entry['value']:.4g}", std, interval, entry["unit"], verdict, f"{entry['initial']:.4g}"))
    lines = [*([] if failed else _misfit(result["fit"])), *_doubt_lines(result), *table(rows), ""]
    rows = [("channel", "error (rms)", "unit", "samples")]
    rows += [(c, f"{e['rmse']:.3g}", e["unit"], str(e["n"])) for c, e in result["residuals"].items()]
    if len(rows) > 1:
        lines += [*table(rows), ""]
    for entry in result["held_out"]:
        if "message" in entry:
            lines += [f"held-out recording {entry['recording']} could not be predicted: {entry['message']}", ""]
    rows = [("held-out recording", "channel", "error (rms)", "unit", "without a model")]
    predicted = held_out_rows(result)
    for row in [*predicted, *medians(predicted)]:
        without = ", ".join(f"{error:.3g} ({name})" for name, error in row.baselines.items())
        rows.append((row.recording, row.channel, f"{row.rmse:.3g}", row.unit, without))
    lines += [*table(rows), ""] if len(rows) > 1 else []
    lines += _offset_lines(result)
    lines += [*_moved_lines(result), *result.get("discretisation_notes", ())]
    if failed:
        lines.append("the values are the best point that was reached; nothing can be said about how sure they are")
    else:
        lines += _unsure(free)
        if result["fit"]["explains"]:
            lines.append(fit_words(result["fit"]["chi2_per_dof"], True))
    lines += [result["safeguard"]] if result.get("safeguard") else []
    lines.append(
        f"{result['status']}: {result['message']} ({result['iterations']} iterations, {result['seconds']:.1f} s)"
    )
    return lines


def _doubt_lines(result: Mapping[str, Any]) -> list[str]:
    """What is in doubt about the recordings, as one table, and what follows; nothing where nothing is."""
    shown = doubt_rows(result)
    if not shown:
        return []
    rows: Rows = [("in doubt", "where", "how sure", "times its limit")]
    rows += [(row.cause, row.where, row.sure, f"{row.evidence:.3g}") for row in shown]
    lines = [*table(rows), ""]
    for row in shown:
        lines += textwrap.wrap(f"{row.cause}: {row.what}; {row.advice}", 118, subsequent_indent="  ")
        lines += [f"  {row.setting}"] if row.setting else []
    return [*lines, *doubt_sentences(result), ""]


def _misfit(fit: Mapping[str, Any]) -> list[str]:
    """What has to be said before anything else: a guess does better, or the model does not explain the recordings."""
    lines = guess_sentences(fit.get("worse_than_guess", ()))
    if not fit["explains"]:
        lines.append(fit_words(fit["chi2_per_dof"], False))
    return [*lines, ""] if lines else []


def _unsure(free: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Sentences on parameters that are not found."""
    lost, weak, bound = (
        [name for name, entry in free.items() if entry["verdict"] == verdict]
        for verdict in ("not_identifiable", "weak", "at_bound")
    )
    lines = [f"{VERDICT_WORDS['not_identifiable']} from these recordings: {', '.join(lost)}"] if lost else []
    if weak:
        lines.append(f"only {VERDICT_WORDS['weak']}: {', '.join(weak)}")
        if any(free[name]["interval"] is None for name in weak):
            lines.append("`yid-ocp identifiability` gives intervals that need not be symmetric")
    if bound:
        lines.append(f"the search ended at a bound of {', '.join(bound)}: what is beyond it was not tried")
    return lines


def _moved_lines(result: Mapping[str, Any]) -> list[str]:
    """One sentence for each refinement: which estimates it moves by more than their standard deviation."""
    lines = []
    for key, words in (("links", "twice the links"), ("time_step", "half the time step")):
        tried = {name: own for name, own in result.get("discretisation", {}).items() if own[key] is not None}
        moved = {n: own for n, own in tried.items() if own["std"] is not None and abs(own[key]) > own["std"]}
        changes = [f"{name} by {own[key]:+.2g} (± {own['std']:.2g} from the data)" for name, own in moved.items()]
        if moved:
            lines.append(f"with {words} these move by more than the data's standard deviation: {', '.join(changes)}")
        elif tried:
            lines.append(f"with {words} no estimate moves by more than its standard deviation")
    return lines


def _offset_lines(result: Mapping[str, Any]) -> list[str]:
    rows = offset_rows(result)
    return [*table(rows), ""] if rows else []


def plan_summary(result: Mapping[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-plan/1` result says."""
    lines = [*table(list(plan_rows(result))), ""]
    if result["goal"] == "information":
        for rows in (information_rows(result), distance_rows(result)):
            lines += [*table(list(rows)), ""] if len(rows) > 1 else []
        said = information_sentences(result)
    else:
        said = plan_sentences(result)
    return [*lines, *said, f"{result['status']}: {result['message']}"]


def track_summary(result: Mapping[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-track/1` result says."""
    truth = result["truth_errors"]
    heads = ("error, median [mm]", "error, largest [mm]") if truth else ("", "")
    rows: Rows = [("point", "frames", "± std [mm]", *heads)]
    for name, entry in result["points"].items():
        cells = ["" if entry["std"] is None else f"{1e3 * entry['std']:.1f}"]
        cells += [f"{1e3 * truth[name][key]:.1f}" if name in truth else "" for key in ("median", "largest")]
        rows.append((name, str(entry["frames"]), *cells))
    lines = [*_doubt_lines(result), *table(rows), ""]
    good = sum(not frame["reason"] for frame in result["frames"])
    spent = 1e3 * result["fit_seconds"]
    lines.append(f"{good} of {len(result['frames'])} frames are good, the fit took {spent:.0f} ms each")
    lines += [f"dropped {number}: {reason}" for reason, number in result["dropped"].items()]
    lines.append(result["clock"]["message"])
    return lines


def compare_summary(result: Mapping[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-compare/1` result says."""
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
            ended = entry["status"] not in (
                "stalled",
                "failed",
            )  # elsewhere a curvature tells nothing of how sure it is
            known = (found["std"], found["interval"]) if ended else (None, None)
            cells.append(parameter_words(found["value"], *known))
        others = [f"{result[key][name]:.4g}" if name in result[key] else "" for key in beside]
        rows.append((name, *cells, *others, VERDICT_WORDS[judged["parameters"][name]["verdict"]]))
    fit = judged["fit"]
    lines = [*_misfit(fit), *_doubt_lines(result), *table(rows), "", *table(_efforts(methods)), ""]
    for name, entry in methods.items():
        if entry["status"] != "converged":
            lines.append(f"{name} did not converge: {entry['message']}")
        lines += [f"{name} differs: {sentence}" for sentence in entry["disagreements"]]
    lines += result["explained"]
    if disturbed:
        lines.append(
            "the methods are compared by the sensors' noise alone; the column 'all noise' and the verdicts weigh the "
            "noise that drives the motion as well"
        )
    lines += result["published_explained"]
    if not fit["explains"]:
        lines.append("the model does not explain the recordings, so agreement of methods says nothing of the truth")
    elif not fit["believed"]:
        lines.append("the recordings are in doubt, so agreement of methods says nothing of the truth")
    elif not any(judged["parameters"][name]["verdict"] == "identifiable" for name in free):
        lines.append("no parameter can be found from these recordings, so there is nothing to agree on")
        lines.append("`yid-ocp identifiability CONFIG --what-if` says what would have to be measured")
    elif result["agree"]:
        lines.append("all methods agree within their uncertainty on the parameters that are found")
        if disturbed:
            lines.append("where the column 'all noise' is elsewhere, the torques' errors have misled them all alike")
    return lines


def _efforts(methods: Mapping[str, Mapping[str, Any]]) -> Rows:
    """What every method reached and what it took."""
    entries = methods.values()
    costs = [entry["whitened_cost"] for entry in entries]
    rows: Rows = [("", *methods)]
    rows.append(("status", *(entry["status"] for entry in entries)))
    rows.append(("cost (whitened)", *("failed" if cost is None else f"{cost:.6g}" for cost in costs)))
    ratios = [entry["fit"]["chi2_per_dof"] for entry in entries]
    rows.append(("chi2 per degree of freedom", *("unknown" if r is None else f"{r:.3g}" for r in ratios)))
    for channel in sorted({c for e in entries for h in e["held_out"] for c in h.get("rmse", {})}):
        errors = [[h["rmse"][channel] for h in e["held_out"] if channel in h.get("rmse", {})] for e in entries]
        rows.append((f"held out: {channel}", *(f"{sum(e) / len(e):.3g}" if e else "failed" for e in errors)))
    rows.append(("iterations", *(str(entry["iterations"]) for entry in entries)))
    rows.append(("evaluations", *(str(entry["evaluations"]) for entry in entries)))
    rows.append(("wall time [s]", *(f"{entry['wall_seconds']:.2f}" for entry in entries)))
    rows.append(("CPU time [s]", *(f"{entry['cpu_seconds']:.2f}" for entry in entries)))
    rows.append(("peak memory [MiB]", *(f"{entry['peak_memory_mib']:.0f}" for entry in entries)))
    return rows


def identifiability_summary(result: Mapping[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-identifiability/1` result says."""
    if not result["parameters"]:
        return [f"{result['status']}: {result['message']}; there is no point at which to judge"]
    unsure = "± if start and grasps were unknown"
    rows: Rows = [("parameter", "value", "±", unsure, "95 % interval", "unit", "verdict")]
    for name, entry in result["parameters"].items():
        spread = (_percent(entry["std_relative"]), _percent(entry["std_relative_unknown"]))
        interval = "" if entry["interval"] is None else interval_words(*entry["interval"])
        rows.append((name, f"{entry['value']:.4g}", *spread, interval, entry["unit"], VERDICT_WORDS[entry["verdict"]]))
    lines = [] if result["fit"] is None else _misfit(result["fit"])
    lines += [*_doubt_lines(result), *table(rows), ""]
    hidden = [entry["words"] for entry in result["directions"] if entry["verdict"] != "identifiable"]
    if len(hidden) > 8:
        hidden = [*hidden[:8], f"and {len(hidden) - 8} more directions, in result.json"]
    lines += [*hidden, ""] if hidden else []
    if not result["profiles"]:
        lines.append("intervals of parameters are worked out on request: --intervals NAME,NAME or --intervals all")
    lines += [f"{name}: {note}" for name, entry in result["profiles"].items() for note in entry["notes"]]
    lines += [] if result["what_if"] is None else _what_if_lines(result["what_if"], len(result["parameters"]))
    found = [name for name, entry in result["parameters"].items() if entry["verdict"] == "identifiable"]
    lines.append(f"{len(found) or 'none'} of {len(result['parameters'])} parameters can be found from these recordings")
    lost = [name for name in found if result["parameters"][name]["verdict_unknown"] != "identifiable"]
    if lost:
        lines.append(f"not found if start and grasps were unknown: {', '.join(lost)}")
    return lines


def _what_if_lines(asked: Mapping[str, Any], total: int) -> list[str]:
    rows: Rows = [("what if", "found", "gain [nat]", "")]
    for entry in [asked["base"], *asked["singles"]]:
        gain = "" if entry["gain"] is None else f"{entry['gain']:.1f}"
        rows.append((entry["words"], f"{entry['identifiable']} of {total}", gain, entry["message"]))
    if not asked["smallest"]:
        return [*table(rows), "", "with no set of up to three changes can all of them be found"]
    return [*table(rows), "", f"fewest changes with which all of them can be found: {asked['smallest'][0]['words']}"]


def _percent(value: float | None) -> str:
    return "unknown" if value is None else f"{percent_words(value)} %" if value < 10 else f"{value:.2g} times"


def _known(name: str, quantity: Mapping[str, Any], refitted: bool) -> str:
    """A candidate's parameter; without a refit its value is a first step and has no standard deviation."""
    if quantity["std"] is None:
        return f"{name} unknown" if refitted else f"{name} = {quantity['value']:.3g} {quantity['unit']}"
    return f"{name} = {quantity['value']:.3g} ± {quantity['std']:.2g} {quantity['unit']}"


def diagnose_summary(result: Mapping[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-diagnosis/1` result says."""
    lines = [*_doubt_lines(result), *textwrap.wrap(result["summary"], 100), ""]
    before, after, units = (result["gap"][a][b] for a, b in (("before", "rmse"), ("after", "rmse"), ("before", "unit")))
    rows: Rows = [("held-out channel", "before", "after", "unit")]
    rows += [(c, f"{e:.3g}", f"{after[c]:.3g}" if c in after else "", units[c]) for c, e in before.items()]
    lines += [*table(rows), ""]
    rows = [("candidate", "parameters", "closure alone", "score", "p")]
    for entry in result["which"][:8]:
        known = {name: q for name, q in entry["parameters"].items() if q["value"] is not None}
        values = ", ".join(_known(name, quantity, entry["closure"] is not None) for name, quantity in known.items())
        closed = "" if entry["closure"] is None else f"{100 * entry['closure']:.3g} %"
        label = f"{entry['kind']}@{entry['location']}"
        p = f"{entry['p_value']:.2g}" if entry["p_value"] > 1e-12 else "< 1e-12"
        rows.append((label, values, closed, f"{entry['score']:.3g}", p))
    lines += [*table(rows), ""] if len(rows) > 1 else []
    for shown in (baseline_rows(result), counterfactual_rows(result)):
        lines += [*table(shown), ""] if len(shown) > 1 else []
    lines += _offset_lines(result)
    lines += ["what is in doubt about the recordings may be what the verdict is about"] if result.get("doubts") else []
    if result["next_plan"] is not None:
        lines += ["to separate what looks alike, plan a motion:", planning_command(result["next_plan"]), ""]
    return [*lines, f"verdict: {result['verdict']} ({sum(result['seconds'].values()):.1f} s)"]


def history_summary(result: Mapping[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-history/1` result says."""
    said = [line for text in history_sentences(result) for line in textwrap.wrap(text, 100)]
    return [*table(history_rows(result)), "", *table(run_rows(result)), "", *said]


def planning_command(section: Mapping[str, Any]) -> str:
    """The command that plans what a section `plan` says, with the configuration in the run folder that it names."""
    words = ["yid-ocp", "plan", str(Path(section["run"]) / "config.yaml")]
    for key, value in section.items():
        text = f"[{', '.join(value)}]" if isinstance(value, list) else str(value)
        words += ["--set", f"plan.{key}={text}"]
    return shlex.join(words)


def check_summary(result: Mapping[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-check/1` result says."""
    model = result["model"]
    lines = [
        f"model: {model['n']} coordinates, {model['m']} constraints, {model['nu']} driven, {model['nc']} prescribed, "
        f"{model['ntheta']} parameters",
        *(entry["words"] for entry in result["mechanics"].values() if entry["agrees"]),
        "",
    ]
    rows: Rows = [("recording", "use", "group", "samples", "rate", "longest gap", "noise (median)")]
    for entry in result["recordings"]:
        for name, group in entry["groups"].items():
            shown = _noise_words(entry["noise"], name)
            rows.append(
                (
                    entry["recording"],
                    "held out" if entry["role"] == "held_out" else "estimate",
                    name,
                    str(group["samples"]),
                    f"{group['rate']:.4g} Hz",
                    f"{group['longest_gap']:.3g} s",
                    shown,
                )
            )
    lines += [*table(rows), ""] if len(rows) > 1 else []
    for entry in result["recordings"]:
        gaps = [f"{name} {1e3 * gap:.2g} mm" for name, gap in entry["grasp_gaps"].items()]
        rest = entry.get("equilibrium")
        said = [] if rest is None else ["equilibrium found" if rest["found"] else f"no equilibrium: {rest['message']}"]
        if gaps or said:
            lines.append(
                f"{entry['recording']}: " + "; ".join([*said, *(["grasp gaps " + ", ".join(gaps)] if gaps else [])])
            )
    lines += _convergence_lines(result["convergence"])
    moved = _moved_lines(result)
    lines += ["", "if the initial values were the estimates:", *moved] if moved else []
    lines += ["", *_doubt_lines(result), *(f"warning: {text}" for text in result["warnings"])]
    if result.get("doubts"):
        lines.append("a run is possible; see what is in doubt")
    else:
        lines.append(
            "nothing stands in the way of a run" if not result["warnings"] else "a run is possible; see the warnings"
        )
    return lines


def _noise_words(noise: Mapping[str, Any], name: str) -> str:
    """Noise of a recorded group, or of what it holds; with the offset that is expected and whether it was estimated."""
    said = []
    for part in ("", ".effort", ".position"):
        known = noise.get(f"{name}{part}")
        if known is None or known["std"] is None:
            continue
        words = f"{known['std']:.3g} {known['unit']}"
        words += f", offset {known['bias_std']:.3g}" if known.get("bias_std") else ""
        said.append(words + (" (estimated)" if known.get("estimated") else ""))
    return "; ".join(said)


def _convergence_lines(convergence: Mapping[str, Any]) -> list[str]:
    lines: list[str] = []
    for key, head in (("links", "links"), ("time_step", "time step [s]")):
        rows: Rows = [(head, "lowest frequencies [Hz]", "")]
        for row in convergence[key]:
            remark = row["message"] or (f"{row['growing']} modes grow" if row["growing"] else "")
            rows.append((f"{row['value']:g}", ", ".join(f"{f:.4g}" for f in row["hertz"]), remark))
        lines += ["", *table(rows)] if len(rows) > 1 else []
    return [*lines, "", f"frequencies: {convergence['message']}"] if convergence["message"] else lines


MOST = 12  # free parameters of which `inspect` speaks in the terminal


def inspect_summary(result: Mapping[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-inspect/1` result says."""
    roles = [entry["role"] for entry in result["variables"]]
    counts = [f"{roles.count(role)} {role}" for role in ("driven", "prescribed", "free") if role in roles]
    equations = result["equations"]
    lines = [f"coordinates: {len(roles)} ({', '.join(counts)}), constraints: {equations['sizes']['m']}", ""]
    rows: Rows = [("parameter", "value", "unit", "bounds", "")]
    for name, entry in result["parameters"].items():
        low, high = ("inf" if entry[key] is None else f"{entry[key]:g}" for key in ("lower", "upper"))
        low = "-inf" if entry["lower"] is None else low
        rows.append((name, f"{entry['value']:.6g}", entry["unit"], f"{low} to {high}", "free" if entry["free"] else ""))
    lines += [*table(rows), ""]
    rows = [("function", "operations", "nonzeros")]
    rows += [(f["name"], str(f["operations"]), str(f["nonzeros"])) for f in equations["functions"]]
    lines += [*table(rows), "", *_block_lines(result["blocks"]), *_pattern_lines(result), ""]
    linear = result["linearisation"]
    lines.append(f"linearised at {linear['at']}: spectral radius of A {linear['spectral_radius']:.6g}")
    rows = [("matrix", "norm", "largest difference from finite differences")]
    rows += [
        (name, f"{norm:.4g}", f"{linear['finite_difference_errors'][name]:.1e}")
        for name, norm in linear["norms"].items()
    ]
    lines += [*table(rows), "matrices: linearisation.h5", ""]
    free = [entry for name, entry in result["dependence"].items() if result["parameters"][name]["free"]]
    asked = [result["dependence"][name] for name in result["asked"]]
    for entry in [*free[:MOST], *(entry for entry in asked if entry not in free[:MOST])]:
        lines += textwrap.wrap(entry["words"], 120, subsequent_indent="  ")
    if len(free) > MOST:
        lines.append(f"and {len(free) - MOST} more free parameters, in result.json")
    if free and any(entry["seen"] is None for entry in free):
        lines.append("what sensors see to first order is looked for about a rest, which this is not")
    lines.append("where every parameter enters: result.json; all equations and names: equations.txt")
    for entry in result["entries"]:
        lines += ["", *entry["lines"]]
        if not entry["zero"]:
            value = "unknown" if entry["value"] is None else f"{entry['value']:.6g}"
            lines.append(f"  which is {value} at {linear['at']}")
    if result["exported"]:
        lines += ["", f"exported: {', '.join(result['exported'])}"]
    return lines


def _block_lines(blocks: Mapping[str, Any]) -> list[str]:
    """Blocks of rows and columns with the name of their first entry."""
    lines: list[str] = []
    for kind, head in (("rows", "equations of a step"), ("columns", "variables of a step")):
        rows: Rows = [(head, "", "first", "")]
        rows += [(b["name"], str(len(b["names"])), b["names"][0], b["meaning"]) for b in blocks[kind]]
        lines += [*table(rows), ""]
    return lines


def _pattern_lines(result: Mapping[str, Any]) -> list[str]:
    """Sizes of matrices, and how many entries can and do differ from zero."""
    rows: Rows = [("matrix (sparsity.png)", "size", "can differ from zero", "do at this point")]
    for name, entry in result["patterns"].items():
        height, width = entry["shape"]
        if height and width:
            rows.append((name, f"{height} x {width}", str(entry["nonzeros"]), str(entry["at_point"])))
    nlp = result["nlp"]
    if nlp is None:
        return table(rows)
    size = nlp["variables"] + nlp["constraints"]
    text = f"KKT matrix of the NLP with a node at every step (kkt.png): {size} x {size}, {nlp['variables']} variables, "
    text += f"{nlp['constraints']} constraints; {nlp['jacobian_nonzeros']} entries of the constraints' Jacobian and "
    text += f"{nlp['hessian_nonzeros']} of their Hessian can differ from zero"
    text += f"; without {', '.join(nlp['left_out'])}" if nlp["left_out"] else ""
    return [*table(rows), *textwrap.wrap(text, 120)]


def simulate_summary(result: Mapping[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-simulate/1` result says."""
    if result["status"] == "failed":
        return [f"failed: {result['message']}"]
    rows: Rows = [("group", "samples")]
    rows += [(name, str(entry["samples"])) for name, entry in result["groups"].items()]
    return [*table(rows), "", f"{result['duration']:g} s in recording.h5"]


def blind_summary(result: Mapping[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-blind/1` result says: the score alone."""
    return [line.strip("| ").replace(" | ", ": ") for line in blind_table(result)[2:15]]


def batch_summary(result: Mapping[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-batch/1` result says."""
    spread = spread_rows(result)
    said = [line for text in batch_sentences(result) for line in textwrap.wrap(text, 100)]
    return [*table(batch_rows(result, SHOWN)), "", *(table(spread) if len(spread) > 1 else []), "", *said]


def export_summary(manifest: Mapping[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-export/1` manifest says."""
    said = [*manifest["effects"].items(), *((f"grasp {name}", own) for name, own in manifest.get("grasps", {}).items())]
    effects = {name.rpartition(".")[0] for name in manifest["parameters"] if "@" in name}
    said += [
        (name, entry)
        for name, entry in manifest["parameters"].items()
        if entry["status"] != "native" and name.rpartition(".")[0] not in effects
    ]
    rows: Rows = [("of the model", "in the file", "how, or why not")]
    rows += [(name, entry["status"], entry["how"]) for name, entry in said]
    lines = [*table(rows), ""] if len(rows) > 1 else []
    gate = manifest["gate"]
    if gate is None:
        return lines
    if gate["status"] != "done":
        return [*lines, f"not replayed: {gate['reason']}", ""]
    rows = [("replayed channel", "nominal", "exported", "noise", "unit")]
    for name, entry in gate["channels"].items():
        sizes = (f"{entry[key]:.3g}" for key in ("before", "after", "noise"))
        rows.append((name, *sizes, entry["unit"]))
    lines += [*table(rows), ""]
    if gate["fall"] is not None:
        held = "held-out recordings" if gate["which"] == "held_out" else "the recordings that were fitted"
        lines += [f"replayed in MuJoCo, the error beyond noise on {held} falls by {100 * gate['fall']:.3g} %", ""]
    return lines


def recording_summary(recording: Recording) -> list[str]:
    """Lines that tell a person what a recording holds."""
    rows: Rows = [("group", "samples", "names")]
    for group in recording.groups:
        rows.append((getattr(group, "name", "joints"), str(len(group.t)), ", ".join(group.names)))
    notes = ["", *(f"note: {note}" for note in recording.notes)] if recording.notes else []
    return [*table(rows), "", f"{recording.duration:g} s", *notes]


def contents_summary(contents: Contents) -> list[str]:
    """Lines that tell a person what a file of another tool holds."""
    rows: Rows = [("source", "type", "count", "Hz", "becomes", "note")]
    for source in contents.sources:
        rate = f"{source.rate:.4g}" if math.isfinite(source.rate) else ""
        rows.append((source.name, source.kind, str(source.count), rate, source.becomes or "-", source.note))
    return [*table(rows), *(["", *(f"note: {note}" for note in contents.notes)] if contents.notes else [])]


def table(rows: Rows) -> list[str]:
    """Rows as aligned lines, the first one as head; columns without an entry are left out."""
    kept = [i for i in range(len(rows[0])) if any(row[i] for row in rows)]
    widths = [max(len(row[i]) for row in rows) for i in kept]
    lines = ["  ".join(row[i].ljust(width) for i, width in zip(kept, widths, strict=True)).rstrip() for row in rows]
    return [lines[0], "  ".join("-" * width for width in widths), *lines[1:]]

"""Summary of every command's result, by result format; shared by terminal and HTML report."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping
from typing import Any

from yid_ocp.inference.uncertainty import (
    VERDICT_TABLE_TEXTS,
    goodness_of_fit_message,
    interval_text,
    percent_text,
    value_and_uncertainty_text,
)
from yid_ocp.report.diagnosis_summaries import batch_summary, blind_summary, diagnose_summary, history_summary
from yid_ocp.report.terminal import (
    MAX_CHANNELS_SHOWN_SINGLY,
    CodeBlock,
    SummaryBlock,
    SummaryStatement,
    SummaryTable,
    TableRows,
    channel_or_group_unit,
    discretisation_shift_sentences,
    display_scale_and_unit,
    format_error_value_and_unit,
    issue_summary_blocks,
    misfit_summary_blocks,
    nonempty_summary_statements,
    nonempty_tables,
    parameter_bounds_text,
    torque_offset_table_rows,
)

_BASELINE_DESCRIPTIONS = {
    "stays": "points stay where they were first seen",
    "zero": "an effort of zero",
    "moves_with_clamps": "points move with the mean of the clamps",
    "linear_carry": "the clamps' motion carried along the cable",
}
_MAX_DIRECTIONS = 8
_MAX_INSPECTED_PARAMETERS = 12  # free parameters of which `inspect` speaks; result.json has all


# -- solve and compare ------------------------------------------------------------------------------------------------


def solve_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-solve/1` result."""
    free = {name: entry for name, entry in result["parameters"].items() if entry["free"]}
    failed = result["status"] == "failed"
    blocks: list[SummaryBlock] = [] if failed else misfit_summary_blocks(result["fit"])
    blocks += [
        *issue_summary_blocks(result),
        SummaryTable(_estimate_rows(free, failed), "Parameters", is_key_table=True),
    ]
    rows: TableRows = [("channel", "error (rms)", "unit", "samples")]
    rows += [
        (c, *format_error_value_and_unit(e["rmse"], e["unit"]), str(e["n"])) for c, e in result["residuals"].items()
    ]
    blocks += nonempty_tables(SummaryTable(rows, "Errors where it was fitted"))
    blocks += _held_out_blocks(result)
    blocks += nonempty_tables(SummaryTable(torque_offset_table_rows(result), "How far the torques are off"))
    blocks += nonempty_summary_statements(
        [*discretisation_shift_sentences(result), *result.get("discretisation_notes", ())]
    )
    if failed:
        said = "the values are the best point that was reached; nothing can be said about how sure they are"
        blocks.append(SummaryStatement(said, "verdict"))
    else:
        blocks += nonempty_summary_statements(_found_and_lost(free), "verdict")
        if result["fit"]["explains"]:
            blocks.append(SummaryStatement(goodness_of_fit_message(result["fit"]["chi2_per_dof"], True), "conclusion"))
    blocks += nonempty_summary_statements([result.get("safeguard", "")])
    ended = f"{result['status']}: {result['message']} ({result['iterations']} iterations, {result['seconds']:.1f} s)"
    return [*blocks, SummaryStatement(ended, "note" if result["status"] == "converged" else "conclusion")]


def _estimate_rows(free: Mapping[str, Mapping[str, Any]], failed: bool) -> TableRows:
    rows: TableRows = [("parameter", "value", "± std", "95 % interval", "unit", "verdict", "start", "bounds")]
    for name, entry in free.items():
        known = not failed and entry["std"] is not None and entry["verdict"] != "at_bound"
        std = f"{entry['std']:.2g}" if known else ""
        interval = "" if failed or entry["interval"] is None else interval_text(*entry["interval"])
        verdict = "" if failed else VERDICT_TABLE_TEXTS[entry["verdict"]]
        own = (f"{entry['value']:.4g}", std, interval, entry["unit"], verdict, f"{entry['initial']:.4g}")
        rows.append((name, *own, parameter_bounds_text(entry, 4)))
    return rows


def _held_out_blocks(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Errors of each shown channel, in each recording and over three or more, with those of guesses without a model."""
    units = {channel: entry["unit"] for channel, entry in result["residuals"].items()}
    found: dict[str, list[tuple[str, float, dict[str, float]]]] = {}
    rows: TableRows = [("held-out recording", "channel", "error (rms)", "unit", "without a model")]

    def enter(recording: str, channel: str, rmse: float, guesses: Mapping[str, float]) -> None:
        unit = channel_or_group_unit(units, channel)
        without = (f"{format_error_value_and_unit(other, unit)[0]} ({name})" for name, other in guesses.items())
        rows.append((recording, channel, *format_error_value_and_unit(rmse, unit), ", ".join(without)))

    for entry in result["held_out"]:
        for channel in _shown_channels(entry["rmse"]):
            guesses = {name: errors[channel] for name, errors in entry["baselines"].items() if channel in errors}
            own = (entry["recording"], entry["rmse"][channel], guesses)
            found.setdefault(channel, []).append(own)
            enter(own[0], channel, *own[1:])
    for channel, own_errors in found.items():
        if len(own_errors) > 2:
            recordings, errors, guessed = zip(*own_errors, strict=True)
            shared = [name for name in guessed[0] if all(name in each for each in guessed)]
            medians = {name: statistics.median(each[name] for each in guessed) for name in shared}
            enter(f"median of {len(recordings)}", channel, statistics.median(errors), medians)
    named = dict.fromkeys(name for errors in found.values() for *_, guesses in errors for name in guesses)
    legend = "; ".join(f"{name}, {_BASELINE_DESCRIPTIONS[name]}" for name in named if name in _BASELINE_DESCRIPTIONS)
    lost = (entry for entry in result["held_out"] if "message" in entry)
    return [
        *nonempty_summary_statements(
            f"held-out recording {e['recording']} could not be predicted: {e['message']}" for e in lost
        ),
        *nonempty_tables(SummaryTable(rows, "Errors on held-out recordings, never touched by the fit")),
        *nonempty_summary_statements([f"without a model: {legend}" if legend else ""]),
    ]


def _shown_channels(errors: Mapping[str, float]) -> list[str]:
    """Groups of many members without their members, groups of few as their members."""
    hidden: set[str] = set()
    for group in errors:
        members = {channel for channel in errors if channel.startswith(f"{group}.")}
        hidden |= members if len(members) > MAX_CHANNELS_SHOWN_SINGLY else {group} if members else set()
    return [channel for channel in errors if channel not in hidden]


def _found_and_lost(free: Mapping[str, Mapping[str, Any]]) -> list[str]:
    by = {v: [name for name, entry in free.items() if entry["verdict"] == v] for v in VERDICT_TABLE_TEXTS}
    found, weak, bound, lost = (by[v] for v in ("identifiable", "weak", "at_bound", "not_identifiable"))
    said = []
    if found:
        said.append(
            f"{len(found)} of {len(free)} free parameters are found to within 10 % of their value or, near zero, of "
            f"their usual size: {', '.join(found)}"
        )
    if lost:
        said.append(f"{VERDICT_TABLE_TEXTS['not_identifiable']} from these recordings: {', '.join(lost)}")
    if weak:
        said.append(f"only {VERDICT_TABLE_TEXTS['weak']}: {', '.join(weak)}")
        if any(free[name]["interval"] is None for name in weak):
            said.append("`yid-ocp identifiability` gives intervals that need not be symmetric")
    if bound:
        said.append(f"the search ended at a bound of {', '.join(bound)}: what is beyond it was not tried")
    return said


def compare_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-compare/1` result."""
    methods: dict[str, Any] = result["methods"]
    judged, disturbed = result["judged"], result["disturbed"]
    runs = methods | ({"all noise": judged} if disturbed else {})
    beside = [key for key in ("published", "truth") if result[key]]
    rows: TableRows = [("parameter", *runs, *beside, "verdict")]
    for name, own in judged["parameters"].items():
        if own["free"]:
            cells = []
            for entry in runs.values():
                found = entry["parameters"][name]
                # elsewhere a curvature tells nothing of how sure it is
                ended = entry["status"] not in ("stalled", "failed")
                known = (found["std"], found["interval"]) if ended else (None, None)
                cells.append(value_and_uncertainty_text(found["value"], *known))
            others = [f"{result[key][name]:.4g}" if name in result[key] else "" for key in beside]
            rows.append((name, *cells, *others, VERDICT_TABLE_TEXTS[own["verdict"]]))
    said = [f"{n} did not converge: {e['message']}" for n, e in methods.items() if e["status"] != "converged"]
    said += [f"{name} differs: {sentence}" for name, entry in methods.items() for sentence in entry["disagreements"]]
    said += result["explained"]
    if disturbed:
        said.append(
            "the methods are compared by the sensors' noise alone; the column 'all noise' and the verdicts weigh the "
            "noise that drives the motion as well"
        )
    return [
        *misfit_summary_blocks(judged["fit"]),
        *issue_summary_blocks(result),
        SummaryTable(rows, "Parameters by method", is_key_table=True),
        SummaryTable(_efforts(methods), "What it took"),
        *nonempty_summary_statements([*said, *result["published_explained"]]),
        *nonempty_summary_statements(_agreement(result), "conclusion"),
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
    costs = (entry["whitened_cost"] for entry in entries)
    ratios = (entry["fit"]["chi2_per_dof"] for entry in entries)
    rows: TableRows = [
        ("", *methods),
        ("status", *(entry["status"] for entry in entries)),
        ("cost (whitened)", *("failed" if cost is None else f"{cost:.6g}" for cost in costs)),
        ("chi2 per degree of freedom", *("unknown" if r is None else f"{r:.3g}" for r in ratios)),
    ]
    units = {c: own["unit"] for entry in entries for c, own in entry["residuals"].items()}
    for channel in sorted({c for e in entries for h in e["held_out"] for c in h.get("rmse", {})}):
        unit = channel_or_group_unit(units, channel)
        errors = [[h["rmse"][channel] for h in e["held_out"] if channel in h.get("rmse", {})] for e in entries]
        cells = (format_error_value_and_unit(sum(e) / len(e), unit)[0] if e else "failed" for e in errors)
        rows.append((f"held out: {channel}" + (f" [{display_scale_and_unit(unit)[1]}]" if unit else ""), *cells))
    for words, key, form in (
        ("iterations", "iterations", "d"),
        ("evaluations", "evaluations", "d"),
        ("wall time [s]", "wall_seconds", ".2f"),
        ("CPU time [s]", "cpu_seconds", ".2f"),
        ("peak memory [MiB]", "peak_memory_mib", ".0f"),
    ):
        rows.append((words, *(f"{entry[key]:{form}}" for entry in entries)))
    return rows


# -- identifiability and plan -----------------------------------------------------------------------------------------


def identifiability_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-identifiability/1` result."""
    parameters: Mapping[str, Any] = result["parameters"]
    if not parameters:
        text = f"{result['status']}: {result['message']}; there is no point at which to judge"
        return [SummaryStatement(text, "verdict")]
    unsure = ("±", "± if start and grasps were unknown", "± if all else were known")
    rows: TableRows = [("parameter", "value", *unsure, "95 % interval", "unit", "verdict")]
    for name, entry in parameters.items():
        spread = (_relative(entry[key]) for key in ("std_relative", "std_relative_unknown", "std_alone"))
        interval = "" if entry["interval"] is None else interval_text(*entry["interval"])
        rows.append(
            (name, f"{entry['value']:.4g}", *spread, interval, entry["unit"], VERDICT_TABLE_TEXTS[entry["verdict"]])
        )
    blocks: list[SummaryBlock] = [] if result["fit"] is None else misfit_summary_blocks(result["fit"])
    blocks += [*issue_summary_blocks(result), SummaryTable(rows, "Parameters", is_key_table=True)]
    hidden = [entry["words"] for entry in result["directions"] if entry["verdict"] != "identifiable"]
    said = hidden[:_MAX_DIRECTIONS]
    if len(hidden) > _MAX_DIRECTIONS:
        said.append(f"and {len(hidden) - _MAX_DIRECTIONS} more directions, in result.json")
    if not result["profiles"]:
        said.append("intervals of parameters are worked out on request: --intervals NAME,NAME or --intervals all")
    said += [f"{name}: {note}" for name, entry in result["profiles"].items() for note in entry["notes"]]
    blocks += [*nonempty_summary_statements(said), *_what_if(result["what_if"], len(parameters))]
    found = [name for name, entry in parameters.items() if entry["verdict"] == "identifiable"]
    text = f"{len(found) or 'none'} of {len(parameters)} parameters can be found from these recordings"
    lost = [name for name in found if parameters[name]["verdict_unknown"] != "identifiable"]
    unknown = f"not found if start and grasps were unknown: {', '.join(lost)}" if lost else ""
    return [*blocks, SummaryStatement(text, "conclusion"), *nonempty_summary_statements([unknown], "verdict")]


def _what_if(asked: Mapping[str, Any] | None, count: int) -> list[SummaryBlock]:
    if asked is None:
        return []
    rows: TableRows = [("change", "found", "gain [nat]", "")]
    for entry in [asked["base"], *asked["singles"], *asked["smallest"]]:
        gain = "" if entry["gain"] is None else f"{entry['gain']:.1f}"
        rows.append((entry["words"], f"{entry['identifiable']} of {count}", gain, entry["message"]))
    said = "with no set of up to three changes can all of them be found"
    if asked["smallest"]:
        said = f"fewest changes with which all of them can be found: {asked['smallest'][0]['words']}"
    return [SummaryTable(rows, "What another experiment would tell"), SummaryStatement(said, "verdict")]


def _relative(value: float | None) -> str:
    return "unknown" if value is None else f"{percent_text(value)} %" if value < 10 else f"{value:.2g} times"


def friction_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-friction/1` result."""
    unit, best = result["unit"], result["warranted"]
    rows: TableRows = [("law", "error on kinds left out", "± standard error", f"beyond {best}", "±", "unit", "")]
    keys = ("mean_error", "standard_error", "beyond_warranted", "beyond_warranted_standard_error")
    for law, entry in result["laws"].items():
        sizes = (f"{entry[key]:.3g}" for key in keys)
        note = "warranted" if law == best else ""
        note += "" if entry["converged"] else " (the fit did not converge)"
        rows.append((law, *sizes, unit, note))
    own: TableRows = [("parameter", "value", "unit")]
    for name, entry in result["laws"][best]["parameters"].items():
        own.append((name, value_and_uncertainty_text(entry["value"], entry["std"], None), entry["unit"]))
    text = f"the law '{best}' is warranted: it is the simplest whose error is within one standard error of the least "
    text += f"({', '.join(result['kinds'])} left out in turn)"
    joints = ", ".join(result["joints"])
    return [
        SummaryTable(rows, "Friction laws", is_key_table=True),
        SummaryTable(own, f"Fit with the law '{best}'"),
        SummaryStatement(text, "conclusion"),
        CodeBlock(f"model:\n  friction: {{law: {best}, joints: [{joints}]}}"),
    ]


def plan_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-plan/1` result."""

    def percent(share: float | None) -> str:
        return "" if share is None else f"{100 * share:.0f} %"

    rows: TableRows = [("joint", "travel [rad or m]", "largest velocity, of its limit", "largest effort, of its limit")]
    for name, own in result["joints"].items():
        travel = own["travel"] if own["travel"] > 1e-9 else 0.0
        rows.append((name, f"{travel:.3g}", percent(own["velocity"]), percent(own["effort"])))
    ended = SummaryStatement(f"{result['status']}: {result['message']}", "conclusion")
    kind = _information_blocks if result["goal"] == "information" else _place_blocks
    return [SummaryTable(rows, "What it asks of the joints", is_key_table=True), *kind(result), ended]


def _place_blocks(result: Mapping[str, Any]) -> list[SummaryBlock]:
    if result["error"] is None or result["swing"] is None:
        text = "the motion at which the search ended cannot be simulated to its end; nothing is known of where it leads"
        return [SummaryStatement(text, "verdict")]
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
    return nonempty_summary_statements(said, "verdict")


def _information_blocks(result: Mapping[str, Any]) -> list[SummaryBlock]:
    rows: TableRows = [("parameter", "from the recordings", "from this motion", "from both", "verdict of this motion")]
    for name, own in result["parameters"].items():
        stds = (own[f"std_relative_{when}"] for when in ("before", "after", "together"))
        cells = ("unknown" if std is None else f"± {100 * std:.2g} %" for std in stds)
        rows.append((name, *cells, VERDICT_TABLE_TEXTS[own["verdict"]]))
    effects: TableRows = [("effect", "beside what could be", "apart in the recordings", "apart in this motion")]
    for own in result["distances"]:
        apart = (f"{own[when]:.3g} std" for when in ("before", "after"))
        effects.append((own["effect"], own["explained_by"], *apart))
    starts, best = result["starts"], result["starts"][result["best"]]
    gains = sorted((s["judged"] for s in starts if s["judged"] is not None), reverse=True)
    others = f"; {len(starts)} starts ended at {gains[0]:.3g} to {gains[-1]:.3g} nat" if len(gains) > 1 else ""
    reached = [f"{what} of {', '.join(names)}" for what, names in result["limits_reached"].items()]
    unseen = tuple(f"{name} is" for name in result["unseen"])
    said = [
        f"start {result['best'] + 1} of {len(starts)} tells most: {best['value'] - best['first']:.3g} nat more than "
        f"the random motion from which it came{others}",
        f"what limits it: {'; '.join(reached)}" if reached else "it reaches no limit",
        *(f"{name}: no motion, no sensor sees it to first order; {what}" for name, what in result["unseen"].items()),
        *(f"left open by this motion: {words}" for words in result["open"] if not words.startswith(unseen)),
    ]
    if result["from"]["run"] is None:
        said.append("the parameters are those of the configuration; where the true ones differ, so does what is told")
    tables = nonempty_tables(SummaryTable(rows, "What it tells"), SummaryTable(effects, "Effects"))
    return [*tables, *nonempty_summary_statements(said, "verdict")]


# -- models, recordings and frames ------------------------------------------------------------------------------------


def check_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-check/1` result."""
    model = result["model"]
    size = (
        f"model: {model['n']} coordinates, {model['m']} constraints, {model['nu']} driven, {model['nc']} prescribed, "
        f"{model['ntheta']} parameters"
    )
    rows: TableRows = [("recording", "use", "group", "samples", "rate", "longest gap", "noise (median)")]
    rests = []
    for entry in result["recordings"]:
        use = "held out" if entry["role"] == "held_out" else "estimate"
        for name, group in entry["groups"].items():
            taken = (str(group["samples"]), f"{group['rate']:.4g} Hz", f"{group['longest_gap']:.3g} s")
            rows.append((entry["recording"], use, name, *taken, _noise_words(entry["noise"], name)))
        rest = entry.get("equilibrium")
        said = [] if rest is None else ["equilibrium found" if rest["found"] else f"no equilibrium: {rest['message']}"]
        gaps = [f"{name} {1e3 * gap:.2g} mm" for name, gap in entry["grasp_gaps"].items()]
        said += ["grasp gaps " + ", ".join(gaps)] if gaps else []
        rests.append(f"{entry['recording']}: {'; '.join(said)}" if said else "")
    moved = discretisation_shift_sentences(result)
    ended = "nothing stands in the way of a run"
    if result.get("doubts") or result["warnings"]:
        ended = f"a run is possible; see {'what is in doubt' if result.get('doubts') else 'the warnings'}"
    return [
        *nonempty_summary_statements(
            [size, *(entry["words"] for entry in result["mechanics"].values() if entry["agrees"])]
        ),
        *nonempty_tables(SummaryTable(rows, "Recordings", is_key_table=True)),
        *nonempty_summary_statements(rests),
        *_convergence(result["convergence"]),
        *nonempty_summary_statements(["if the initial values were the estimates:", *moved] if moved else []),
        *issue_summary_blocks(result),
        *nonempty_summary_statements((f"warning: {text}" for text in result["warnings"]), "verdict"),
        SummaryStatement(ended, "conclusion"),
    ]


def _noise_words(noise: Mapping[str, Any], name: str) -> str:
    """Noise of a recorded group, or of its channels; with the expected offset and whether it was estimated."""
    said = []
    for part in ("", ".effort", ".position"):
        known = noise.get(f"{name}{part}")
        if known is not None and known["std"] is not None:
            words = " ".join(format_error_value_and_unit(known["std"], known["unit"]))
            words += f", offset {known['bias_std']:.3g}" if known.get("bias_std") else ""
            said.append(words + (" (estimated)" if known.get("estimated") else ""))
    return "; ".join(said)


def _convergence(convergence: Mapping[str, Any]) -> list[SummaryBlock]:
    blocks: list[SummaryBlock] = []
    for key, head in (("links", "links"), ("time_step", "time step [s]")):
        rows: TableRows = [(head, "lowest frequencies [Hz]", "")]
        for row in convergence[key]:
            remark = row["message"] or (f"{row['growing']} modes grow" if row["growing"] else "")
            rows.append((f"{row['value']:g}", ", ".join(f"{f:.4g}" for f in row["hertz"]), remark))
        blocks += nonempty_tables(SummaryTable(rows, f"Frequencies by {head}"))
    return [
        *blocks,
        *nonempty_summary_statements([f"frequencies: {convergence['message']}" if convergence["message"] else ""]),
    ]


def inspect_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-inspect/1` result."""
    roles = [entry["role"] for entry in result["variables"]]
    counts = [f"{roles.count(role)} {role}" for role in ("driven", "prescribed", "free") if role in roles]
    equations, linear = result["equations"], result["linearisation"]
    size = f"coordinates: {len(roles)} ({', '.join(counts)}), constraints: {equations['sizes']['m']}"
    parameters: TableRows = [("parameter", "value", "unit", "bounds", "")]
    for name, entry in result["parameters"].items():
        free = "free" if entry["free"] else ""
        parameters.append((name, f"{entry['value']:.6g}", entry["unit"], parameter_bounds_text(entry, 6), free))
    functions: TableRows = [("function", "operations", "nonzeros")]
    functions += [(f["name"], str(f["operations"]), str(f["nonzeros"])) for f in equations["functions"]]
    blocks: list[SummaryBlock] = [
        SummaryStatement(size, "verdict"),
        SummaryTable(parameters, "Parameters", is_key_table=True),
        SummaryTable(functions, "Functions"),
    ]
    for kind, head in (("rows", "equations of a step"), ("columns", "variables of a step")):
        rows: TableRows = [(head, "", "first", "")]
        rows += [(b["name"], str(len(b["names"])), b["names"][0], b["meaning"]) for b in result["blocks"][kind]]
        blocks.append(SummaryTable(rows, head.capitalize()))
    said = f"linearised at {linear['at']}: spectral radius of A {linear['spectral_radius']:.6g}"
    rows = [("matrix", "norm", "largest difference from finite differences")]
    for name, norm in linear["norms"].items():
        rows.append((name, f"{norm:.4g}", f"{linear['finite_difference_errors'][name]:.1e}"))
    blocks += [*_patterns(result), SummaryStatement(said, "verdict"), SummaryTable(rows, "Linearised step")]
    blocks += nonempty_summary_statements(["matrices: linearisation.h5", *_dependence(result)])
    for entry in result["entries"]:
        value = "unknown" if entry["value"] is None else f"{entry['value']:.6g}"
        blocks += [CodeBlock("\n".join(entry["lines"]))]
        blocks += [] if entry["zero"] else [CodeBlock(f"which is {value} at {linear['at']}")]
    return [
        *blocks,
        *nonempty_summary_statements([f"exported: {', '.join(result['exported'])}" if result["exported"] else ""]),
    ]


def _dependence(result: Mapping[str, Any]) -> list[str]:
    free = [entry for name, entry in result["dependence"].items() if result["parameters"][name]["free"]]
    shown, left = free[:_MAX_INSPECTED_PARAMETERS], len(free) - _MAX_INSPECTED_PARAMETERS
    asked = (result["dependence"][name] for name in result["asked"])
    said = [entry["words"] for entry in [*shown, *(entry for entry in asked if entry not in shown)]]
    said += [f"and {left} more free parameters, in result.json"] if left > 0 else []
    if any(entry["seen"] is None for entry in free):
        said.append("what sensors see to first order is looked for about a rest, which this is not")
    return [*said, "where every parameter enters: result.json; all equations and names: equations.txt"]


def _patterns(result: Mapping[str, Any]) -> list[SummaryBlock]:
    rows: TableRows = [("matrix (sparsity.png)", "size", "can differ from zero", "do at this point")]
    for name, entry in result["patterns"].items():
        height, width = entry["shape"]
        if height and width:
            rows.append((name, f"{height} x {width}", str(entry["nonzeros"]), str(entry["at_point"])))
    nlp, said = result["nlp"], ""
    if nlp is not None:
        size = nlp["variables"] + nlp["constraints"]
        said = (
            f"KKT matrix of the NLP with a node at every step (kkt.png): {size} x {size}, {nlp['variables']} "
            f"variables, {nlp['constraints']} constraints; {nlp['jacobian_nonzeros']} entries of the constraints' "
            f"Jacobian and {nlp['hessian_nonzeros']} of their Hessian can differ from zero"
        ) + (f"; without {', '.join(nlp['left_out'])}" if nlp["left_out"] else "")
    return [SummaryTable(rows, "Patterns"), *nonempty_summary_statements([said])]


def simulate_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-simulate/1` result."""
    if result["status"] == "failed":
        return [SummaryStatement(f"failed: {result['message']}", "verdict")]
    rows: TableRows = [("group", "samples")]
    rows += [(name, str(entry["samples"])) for name, entry in result["groups"].items()]
    said = SummaryStatement(f"{result['duration']:g} s in recording.h5", "verdict")
    return [SummaryTable(rows, "Recorded", is_key_table=True), said]


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
    said = result["refused"] or f"{good} of {len(result['frames'])} frames are good, the fit took {spent:.0f} ms each"
    dropped = (f"dropped {number}: {reason}" for reason, number in result["dropped"].items())
    notes = [*dropped, result["camera"]["message"], *result["sizes"]["messages"], result["root"]]
    return [
        *issue_summary_blocks(result),
        *nonempty_tables(SummaryTable(rows, "Points", is_key_table=True)),
        SummaryStatement(said, "verdict"),
        *nonempty_summary_statements([*notes, *(thing["text"] for thing in result["things"])]),
    ]


def export_summary(manifest: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-export/1` manifest."""
    rows: TableRows = [("of the model", "in the file", "how, or why not")]
    effects = {name.rpartition(".")[0] for name in manifest["parameters"] if "@" in name}
    changed = {
        name: entry
        for name, entry in manifest["parameters"].items()
        if entry["status"] != "native" and name.rpartition(".")[0] not in effects
    }
    grasps = {f"grasp {name}": entry for name, entry in manifest.get("grasps", {}).items()}
    for name, entry in (manifest["effects"] | grasps | changed).items():
        rows.append((name, entry["status"], entry["how"]))
    blocks, gate = nonempty_tables(SummaryTable(rows)), manifest["gate"]
    if gate is None:
        return blocks
    if gate["status"] != "done":
        return [*blocks, SummaryStatement(f"not replayed: {gate['reason']}")]
    rows = [("replayed channel", "nominal", "exported", "noise", "unit")]
    for name, entry in gate["channels"].items():
        sizes = (format_error_value_and_unit(entry[key], entry["unit"])[0] for key in ("before", "after", "noise"))
        rows.append((name, *sizes, display_scale_and_unit(entry["unit"])[1]))
    blocks.append(SummaryTable(rows))
    if gate["fall"] is not None:
        held = "held-out recordings" if gate["which"] == "held_out" else "the recordings that were fitted"
        text = f"replayed in MuJoCo, the error beyond noise on {held} falls by {100 * gate['fall']:.3g} %"
        blocks.append(SummaryStatement(text))
    return blocks


SUMMARY_BY_FORMAT: Mapping[str, Callable[[Mapping[str, Any]], list[SummaryBlock]]] = {
    "yid-solve/1": solve_summary,
    "yid-compare/1": compare_summary,
    "yid-identifiability/1": identifiability_summary,
    "yid-diagnosis/2": diagnose_summary,
    "yid-history/1": history_summary,
    "yid-friction/1": friction_summary,
    "yid-plan/1": plan_summary,
    "yid-track/1": track_summary,
    "yid-check/1": check_summary,
    "yid-inspect/1": inspect_summary,
    "yid-simulate/1": simulate_summary,
    "yid-blind/1": blind_summary,
    "yid-batch/1": batch_summary,
}
"""By the format of a result, for what writes a page."""

"""Summaries of the results of `inspect`, `export`, `track` and `simulate`, for the terminal and the HTML report."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from yid_ocp.data.channel_checks import QUALITY_LIMITS
from yid_ocp.display import abbreviated_names_text, count_with_noun, grouped, kind_of_part, names_by_kind_text
from yid_ocp.errors import FAILED_ROLLOUT_ADVICE
from yid_ocp.inference.uncertainty import percent_number_text
from yid_ocp.report import terminal

_MAX_ROW_NAMES_LENGTH = 60  # largest number of characters of a cell with names
_MAX_FORMULA_LINES = 30  # of a shown formula; result.json has longer ones
_MAX_REPRODUCED_ERROR = 3  # largest error of a replay that reproduces a recording [noise std]
_MIN_VISIBLE_CHANGE = 3  # of all readings by a change of a parameter, which noise then does not hide [std]
_NEGLIGIBLE_STDS = 1e-6  # in stds: smaller values are numerical errors of an equilibrium, accumulated over steps


@terminal.SUMMARIES.register("yid-inspect/1")
def _inspect_summary(result: Mapping[str, Any]) -> terminal.SummaryBlockOrTextIterator:
    roles = [entry["role"] for entry in result["variables"]]
    counts = [f"{roles.count(role)} {role}" for role in ("driven", "servo", "prescribed", "free") if role in roles]
    m, linear = result["equations"]["sizes"]["m"], result["linearisation"]
    asked, entries = result["asked"] or result["dependence"], result["entries"]
    is_formula_asked = bool(entries) and not result["asked"]
    changes = {n: own["along"] for n, own in result["dependence"].items() if own["along"] is not None and n in asked}
    hidden = [n for n, along in changes.items() if along * _shown_change(result["parameters"][n]) < _MIN_VISIBLE_CHANGE]
    which = abbreviated_names_text([*changes]) if result["asked"] else "every free parameter"
    text = f"The readings change visibly with {which}. `yid-ocp identifiability` tests whether they determine it."
    if hidden:
        text = f"At the initial values, the recordings can hardly determine {abbreviated_names_text(hidden)}, because "
        text += "noise hides the changes listed below. `yid-ocp identifiability` tests this after a fit."
    yield terminal.SummaryStatement(text if changes and not is_formula_asked else "", "conclusion")
    for entry in entries:
        value = "unknown" if entry["value"] is None else f"{entry['value']:.6g} (SI units)"
        yield terminal.SummaryStatement(f"The value of {entry['title']} at {linear['at']} is {value}.", "conclusion")
        is_long = (count := len(entry["lines"])) > _MAX_FORMULA_LINES
        yield terminal.CodeBlock("" if is_long else "\n".join(entry["lines"]))
        yield f"Its formula has {count} lines, which are in result.json (`entries`)." if is_long else ""
    size = f"{count_with_noun(len(roles), 'coordinate')} ({', '.join(counts)}) and {count_with_noun(m, 'constraint')}"
    yield terminal.SummaryStatement(f"The model has {size}.", "verdict")
    radius = linear["spectral_radius"]
    grown = f"grow by up to {percent_number_text(radius - 1)} % per step" if radius > 1 + 1e-6 else "do not grow"
    said = f"Near {linear['at']}, small deviations {grown} (spectral radius of the matrix A of a step: {radius:.6g})."
    said += " Growth is usual where torques move an arm, as the model has no controller." if radius > 1 + 1e-6 else ""
    yield terminal.SummaryStatement(said, "verdict")
    rows, equations = _dependence_rows(result)
    title = "How much a change of a parameter changes the recorded readings"
    yield terminal.SummaryTable(rows, title, is_key_table=True, is_page_only=is_formula_asked)
    title = "Equations of a step that contain the parameter (del: momentum balance, p1: momentum after the step)"
    yield terminal.SummaryTable(equations, title, is_page_only=not result["asked"])
    rows = [("parameter", "value", "unit", "bounds", "use", "meaning")]
    for name in result["asked"] or result["parameters"]:
        entry = result["parameters"][name]
        cells = (f"{entry['value']:.6g}", terminal.shown_unit(entry["unit"]), terminal.bound_range_text(entry, 6))
        rows.append((name, *cells, "free" if entry["free"] else "fixed", entry["description"]))
    title = "Parameters" if result["asked"] else "All parameters"
    yield terminal.SummaryTable(rows, title, is_page_only=is_formula_asked)
    files = ", ".join(("linearisation.h5 (A and other derivatives of the state after a step)", *result["exported"]))
    yield f"The folder has equations.txt (all equations and their names), {files}, and sparsity.png (pattern of zeros)."
    step = "test whether the recordings determine free parameters"
    yield terminal.next_steps_table(result, {step: "identifiability"} if changes and not is_formula_asked else {})


def _dependence_rows(result: Mapping[str, Any]) -> tuple[terminal.TableRows, terminal.TableRows]:
    """Return how a change of each named (else each free) parameter changes the readings, and the equations with it."""
    known: Mapping[str, Mapping[str, Any]] = result["dependence"]
    shown = [name for name in known if result["parameters"][name]["free"]]
    visible = f"visible (at least {_MIN_VISIBLE_CHANGE})"
    heads = ("effect on all readings / noise", visible, "most sensitive sensor")
    moved: terminal.TableRows = [("parameter", "change (10 % of value or bound)", *heads)]
    equations: terminal.TableRows = [("parameter", "equations", "of these, observed by sensors")]
    for name in dict.fromkeys(result["asked"] or shown):
        own, change = known[name], _shown_change(result["parameters"][name])
        rows, seen = own["rows"], own["seen"]
        observed = "all" if len(seen or ()) == len(rows) else _row_names_text(seen or ()) or "none"
        sight = "" if seen is None or not rows else observed
        along = is_visible = ""
        if own["along"] is not None:
            size = own["along"] * change
            along = f"{size:.3g}" if size > _NEGLIGIBLE_STDS else f"< {_NEGLIGIBLE_STDS:g}"
            along = f"{size:.0f}" if size > 999 else along
            is_visible = "yes" if size >= _MIN_VISIBLE_CHANGE else "no"
        best = own["best"] or "–" * (seen is not None)
        moved.append((name, f"{change:.3g} {own['unit']}".removesuffix(" 1"), along, is_visible, best))
        equations.append((name, _row_names_text(rows), sight))
    return moved, equations


def _shown_change(parameter: Mapping[str, Any]) -> float:
    """Return the change for which `inspect` shows the change of readings: 10 % of value or largest bound, or 1 unit."""
    limit = max(abs(parameter[key] or 0.0) for key in ("lower", "upper"))
    return abs(parameter["value"]) / 10 or limit / 10 or 1.0


def _row_names_text(names: Sequence[str]) -> str:
    """Return names of equations in one line, or only their number if that line would be too long."""
    text = abbreviated_names_text(names)
    return text if len(text) <= _MAX_ROW_NAMES_LENGTH else count_with_noun(len(names), "equation")


@terminal.SUMMARIES.register("yid-export/1")
def _export_summary(manifest: Mapping[str, Any]) -> terminal.SummaryBlockOrTextIterator:
    """Summarise an export: how the format expresses effects and estimates, and the errors of its replay in MuJoCo."""
    effects = {name.rpartition(".")[0] for name in manifest["parameters"] if "@" in name}
    shown = (n for n, own in manifest["parameters"].items() if own["estimated"] or own["status"] != "native")
    listed = {n: manifest["parameters"][n] for n in shown if n.rpartition(".")[0] not in effects}
    grasps = {f"grasp {name}": entry for name, entry in manifest.get("grasps", {}).items()}
    entries = (manifest["effects"] | grasps | listed).items()
    lost = [name for name, entry in entries if entry["status"] == "not representable"]
    said = f"The file lacks {names_by_kind_text(lost)}, so its predictions differ from those of the run."
    yield terminal.SummaryStatement(said if lost else "The file has all parts of the model.", "conclusion")
    unknown = [name for name in manifest["unknown"] if not {name, name.rpartition(".")[0]}.intersection(lost)]
    gate = manifest["gate"] or {}
    yield from (terminal.SummaryStatement(text, "conclusion") for text in _replay_sentences(gate, unknown))
    text = f"Do not rely on these values in the file, which the run did not find: {abbreviated_names_text(unknown)}."
    yield terminal.SummaryStatement(text if unknown else "", "verdict")
    gain_of = manifest.get("gain_of")
    text = f"The gains in the file are those of servos whose firmware has the gain stated in '{gain_of}'."
    yield terminal.SummaryStatement(text if gain_of else "", "verdict")
    kinds = {"native": "exact", "emulated": "approximated", "not representable": "missing"}
    alike = grouped(((kind_of_part(name), kinds[own["status"]], own["how"]), name) for name, own in entries)
    rows: terminal.TableRows = [("part of the model", "in the file", "how, or why not")]
    rows += [(names_by_kind_text(names), *cells) for (_, *cells), names in alike.items()]
    yield terminal.SummaryTable(rows, "Parts of the model in the file")
    rows = [("channel", "with initial values", "with exported values", "noise alone", "unit")]
    for name, entry in gate.get("channels", {}).items():
        errors = map(entry.__getitem__, ("before", "after", "noise"))
        sizes = (terminal.value_text_and_display_unit(error, entry["unit"])[0] for error in errors)
        rows.append((name, *sizes, terminal.scale_and_unit_with_metres_as_mm(entry["unit"])[1]))
    yield terminal.SummaryTable(rows, "Errors (rms) of the replay in MuJoCo")


def _replay_sentences(gate: Mapping[str, Any], unreliable: Sequence[str]) -> Iterator[str]:
    """Yield sentences on how well MuJoCo reproduces recordings with an exported file."""
    if "reason" in gate:
        yield f"The file is written, but was not tested by a replay in MuJoCo: {gate['reason']}."
    if "channels" not in gate:
        return
    held = "held-out recordings" if gate["which"] == "held_out" else "fitted recordings"
    noise = {name: own["noise"] for name, own in gate["channels"].items() if own["noise"]}
    if not noise:
        yield "A replay in MuJoCo does not tell whether the file is right, because no channel has a stated noise."
        return
    ratios, initial = ({n: gate["channels"][n][key] / noise[n] for n in noise} for key in ("after", "before"))
    worst = max(ratios, key=lambda name: ratios[name])
    is_bad = ratios[worst] > _MAX_REPRODUCED_ERROR
    text = f"In MuJoCo, the file {'does not reproduce' if is_bad else 'reproduces'} the {held}: the largest error (of "
    text += f"{worst}) is {ratios[worst]:.4g} times its noise (allowed: up to {_MAX_REPRODUCED_ERROR})."
    yield f"{text} With the initial values, the largest one of all channels is {max(initial.values()):.4g} times."
    yield "Unreliable values may be the cause." if is_bad and unreliable else ""


@terminal.SUMMARIES.register("yid-track/1")
def _track_summary(result: Mapping[str, Any]) -> terminal.SummaryBlockOrTextIterator:
    truth = result["truth_errors"]
    heads = ("median error [mm] (true value known)", "largest error [mm]") if truth else ("", "")
    rows: terminal.TableRows = [("point", "images", "± [mm]", *heads)]
    for name, entry in result["points"].items():
        cells = ["–" if entry["std"] is None else f"{1e3 * entry['std']:.1f}"]
        cells += [f"{1e3 * truth[name][key]:.1f}" if name in truth else "" for key in ("median", "largest")]
        rows.append((name, str(entry["frames"]), *cells))
    yield from terminal.issue_summary_blocks(result)
    used = f"{sum(not frame['reason'] for frame in result['frames'])} of {len(result['frames'])} images are used. "
    used += "recording.h5 has their points."
    used += " So few images determine little." * (len(result["frames"]) < QUALITY_LIMITS.min_samples)
    yield terminal.SummaryStatement(result["refused"] or used, "verdict")
    yield terminal.SummaryTable(rows, "Tracked points", is_key_table=True)
    for why, n in result["dropped"].items():
        of_kind = {own["name"]: own["reason"] for own in result["frames"] if own["reason"].partition(":")[0] == why}
        first = next(iter(of_kind.values()), why).replace(": ", ", for example: " if n > 1 else ": ", 1)
        yield f"{count_with_noun(n, 'image')} not used, because {first} ({abbreviated_names_text([*of_kind])})."
    yield from (result["camera"]["message"], *result["sizes"]["messages"], result["root"])
    yield from (thing["text"] for thing in result["things"])
    steps = {"estimate the parameters that the configuration frees": "solve --set 'recordings.estimate=[recording.h5]'"}
    yield terminal.next_steps_table(result, {} if result["refused"] else steps)


@terminal.SUMMARIES.register("yid-simulate/1")
def _simulate_summary(result: Mapping[str, Any]) -> terminal.SummaryBlockOrTextIterator:
    if result["status"] == "failed":
        said = f"The simulation failed: {result['message']}. If its motion grew, {FAILED_ROLLOUT_ADVICE}."
        yield terminal.SummaryStatement(said, "verdict")
        return
    said = f"The file recording.h5 has {result['duration']:g} s of simulated motion. {result['message']}".rstrip()
    yield terminal.SummaryStatement(said, "verdict")
    rows = [(name, str(entry["samples"])) for name, entry in result["groups"].items()]
    yield terminal.SummaryTable([("group of channels", "samples"), *rows], "Simulated readings", is_key_table=True)
    option = shlex.quote(f"recordings.estimate=[{result.get('file', 'recording.h5')}]")
    step = f"solve --set {option} --set 'recordings.held_out=[]'"
    yield terminal.next_steps_table(result, {"estimate parameters by the same model": step})

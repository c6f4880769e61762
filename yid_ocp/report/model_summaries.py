"""Summaries of `check`, `inspect` and `simulate`: models and recordings before estimation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.report.tables import discretisation_sentences, format_error_and_unit, issue_blocks
from yid_ocp.report.terminal import (
    CodeBlock,
    SummaryBlock,
    SummaryStatement,
    SummaryTable,
    TableRows,
    make_statements,
    nonempty_tables,
)


def check_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-check/1` result."""
    model = result["model"]
    size = (
        f"model: {model['n']} coordinates, {model['m']} constraints, {model['nu']} driven, {model['nc']} prescribed, "
        f"{model['ntheta']} parameters"
    )
    blocks = make_statements([size, *(entry["words"] for entry in result["mechanics"].values() if entry["agrees"])])
    rows: TableRows = [("recording", "use", "group", "samples", "rate", "longest gap", "noise (median)")]
    for entry in result["recordings"]:
        use = "held out" if entry["role"] == "held_out" else "estimate"
        for name, group in entry["groups"].items():
            taken = (str(group["samples"]), f"{group['rate']:.4g} Hz", f"{group['longest_gap']:.3g} s")
            rows.append((entry["recording"], use, name, *taken, _noise_words(entry["noise"], name)))
    blocks += nonempty_tables(SummaryTable(rows, "Recordings", is_key_table=True))
    for entry in result["recordings"]:
        rest = entry.get("equilibrium")
        said = [] if rest is None else ["equilibrium found" if rest["found"] else f"no equilibrium: {rest['message']}"]
        gaps = [f"{name} {1e3 * gap:.2g} mm" for name, gap in entry["grasp_gaps"].items()]
        said += ["grasp gaps " + ", ".join(gaps)] if gaps else []
        blocks += [SummaryStatement(f"{entry['recording']}: {'; '.join(said)}")] if said else []
    blocks += _convergence(result["convergence"])
    moved = discretisation_sentences(result)
    blocks += make_statements(["if the initial values were the estimates:", *moved]) if moved else []
    blocks += issue_blocks(result)
    blocks += make_statements((f"warning: {text}" for text in result["warnings"]), "verdict")
    if result.get("doubts"):
        ended = "a run is possible; see what is in doubt"
    elif result["warnings"]:
        ended = "a run is possible; see the warnings"
    else:
        ended = "nothing stands in the way of a run"
    return [*blocks, SummaryStatement(ended, "conclusion")]


def _noise_words(noise: Mapping[str, Any], name: str) -> str:
    """Noise of a recorded group, or of what it holds; with the offset that is expected and whether it was estimated."""
    said = []
    for part in ("", ".effort", ".position"):
        known = noise.get(f"{name}{part}")
        if known is None or known["std"] is None:
            continue
        words = " ".join(format_error_and_unit(known["std"], known["unit"]))
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
    return [*blocks, *make_statements([f"frequencies: {convergence['message']}" if convergence["message"] else ""])]


_MAX_SHOWN_PARAMETERS = 12  # free parameters of which `inspect` speaks; result.json has all


def inspect_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-inspect/1` result."""
    roles = [entry["role"] for entry in result["variables"]]
    counts = [f"{roles.count(role)} {role}" for role in ("driven", "prescribed", "free") if role in roles]
    equations, linear = result["equations"], result["linearisation"]
    size = f"coordinates: {len(roles)} ({', '.join(counts)}), constraints: {equations['sizes']['m']}"
    blocks: list[SummaryBlock] = [SummaryStatement(size, "verdict")]
    rows: TableRows = [("parameter", "value", "unit", "bounds", "")]
    for name, entry in result["parameters"].items():
        low, high = ("inf" if entry[key] is None else f"{entry[key]:g}" for key in ("lower", "upper"))
        low = "-inf" if entry["lower"] is None else low
        rows.append((name, f"{entry['value']:.6g}", entry["unit"], f"{low} to {high}", "free" if entry["free"] else ""))
    blocks.append(SummaryTable(rows, "Parameters", is_key_table=True))
    rows = [("function", "operations", "nonzeros")]
    rows += [(f["name"], str(f["operations"]), str(f["nonzeros"])) for f in equations["functions"]]
    blocks.append(SummaryTable(rows, "Functions"))
    for kind, head in (("rows", "equations of a step"), ("columns", "variables of a step")):
        rows = [(head, "", "first", "")]
        rows += [(b["name"], str(len(b["names"])), b["names"][0], b["meaning"]) for b in result["blocks"][kind]]
        blocks.append(SummaryTable(rows, head.capitalize()))
    blocks += _patterns(result)
    said = f"linearised at {linear['at']}: spectral radius of A {linear['spectral_radius']:.6g}"
    blocks.append(SummaryStatement(said, "verdict"))
    rows = [("matrix", "norm", "largest difference from finite differences")]
    rows += [
        (name, f"{norm:.4g}", f"{linear['finite_difference_errors'][name]:.1e}")
        for name, norm in linear["norms"].items()
    ]
    blocks += [SummaryTable(rows, "Linearised step"), SummaryStatement("matrices: linearisation.h5")]
    free = [entry for name, entry in result["dependence"].items() if result["parameters"][name]["free"]]
    asked = [result["dependence"][name] for name in result["asked"]]
    shown = [*free[:_MAX_SHOWN_PARAMETERS], *(entry for entry in asked if entry not in free[:_MAX_SHOWN_PARAMETERS])]
    blocks += make_statements(entry["words"] for entry in shown)
    if len(free) > _MAX_SHOWN_PARAMETERS:
        blocks.append(SummaryStatement(f"and {len(free) - _MAX_SHOWN_PARAMETERS} more free parameters, in result.json"))
    if free and any(entry["seen"] is None for entry in free):
        blocks.append(SummaryStatement("what sensors see to first order is looked for about a rest, which this is not"))
    blocks.append(SummaryStatement("where every parameter enters: result.json; all equations and names: equations.txt"))
    for entry in result["entries"]:
        value = "unknown" if entry["value"] is None else f"{entry['value']:.6g}"
        blocks += [CodeBlock("\n".join(entry["lines"]))]
        blocks += [] if entry["zero"] else [CodeBlock(f"which is {value} at {linear['at']}")]
    return [*blocks, *make_statements([f"exported: {', '.join(result['exported'])}" if result["exported"] else ""])]


def _patterns(result: Mapping[str, Any]) -> list[SummaryBlock]:
    rows: TableRows = [("matrix (sparsity.png)", "size", "can differ from zero", "do at this point")]
    for name, entry in result["patterns"].items():
        height, width = entry["shape"]
        if height and width:
            rows.append((name, f"{height} x {width}", str(entry["nonzeros"]), str(entry["at_point"])))
    blocks: list[SummaryBlock] = [SummaryTable(rows, "Patterns")]
    nlp = result["nlp"]
    if nlp is None:
        return blocks
    size = nlp["variables"] + nlp["constraints"]
    text = f"KKT matrix of the NLP with a node at every step (kkt.png): {size} x {size}, {nlp['variables']} variables, "
    text += f"{nlp['constraints']} constraints; {nlp['jacobian_nonzeros']} entries of the constraints' Jacobian and "
    text += f"{nlp['hessian_nonzeros']} of their Hessian can differ from zero"
    text += f"; without {', '.join(nlp['left_out'])}" if nlp["left_out"] else ""
    return [*blocks, SummaryStatement(text)]


def simulate_summary(result: Mapping[str, Any]) -> list[SummaryBlock]:
    """Summary blocks of a `yid-simulate/1` result."""
    if result["status"] == "failed":
        return [SummaryStatement(f"failed: {result['message']}", "verdict")]
    rows: TableRows = [("group", "samples")]
    rows += [(name, str(entry["samples"])) for name, entry in result["groups"].items()]
    return [
        SummaryTable(rows, "Recorded", is_key_table=True),
        SummaryStatement(f"{result['duration']:g} s in recording.h5", "verdict"),
    ]

"""Sections that show a result in words, tables and figures, whatever the command."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from yid_ocp.analysis.compare import MethodComparison
from yid_ocp.analysis.profile import CHI2_QUANTILE_95
from yid_ocp.report import categorical_charts, figures
from yid_ocp.report.figures import TimePlot, figure_html, lines_over_time_figure
from yid_ocp.report.sections.base import ReportData, joint_channel_unit, register_section
from yid_ocp.report.summaries import SUMMARY_BY_FORMAT
from yid_ocp.report.terminal import SummaryBlock, SummaryStatement, SummaryTable


@register_section("verdict", 0, "What was found")
def verdict_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: conclusions, verdicts and the blocks up to the key table."""
    blocks = _result_blocks(findings)
    if not blocks:
        return None
    told = [block for block in blocks if isinstance(block, SummaryStatement)]
    said = [block.text for weight in ("conclusion", "verdict") for block in told if block.kind == weight]
    return {"verdict": said, "blocks": _without_verdicts(blocks[: _end_of_key_table(blocks)])}


def _result_blocks(findings: ReportData) -> list[SummaryBlock]:
    """Summary blocks of a result; empty for an unknown format."""
    known = SUMMARY_BY_FORMAT.get(str(findings.result.get("format")))
    return [] if known is None else known(findings.result)


def _end_of_key_table(blocks: list[SummaryBlock]) -> int:
    """Index after the key table in a list of blocks; 0 without a key table."""
    return next((i + 1 for i, block in enumerate(blocks) if isinstance(block, SummaryTable) and block.is_key_table), 0)


def _without_verdicts(blocks: list[SummaryBlock]) -> list[SummaryBlock]:
    """The blocks without verdict and conclusion statements."""
    return [block for block in blocks if not (isinstance(block, SummaryStatement) and block.kind != "note")]


@register_section("numbers", 60, "In numbers")
def remaining_tables_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: summary blocks after the key table, without verdicts."""
    blocks = _result_blocks(findings)
    rest = _without_verdicts(blocks[_end_of_key_table(blocks) :])
    return {"blocks": rest} if rest else None


@register_section("estimates", 10, "Estimates")
def estimates_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: free parameters ± 2 std, untrusted ones marked; one figure per unit."""
    result = findings.result
    by_unit: dict[str, dict[str, tuple[float, float | None, float, bool]]] = {}
    for name, entry in result.get("parameters", {}).items():
        if entry.get("free") and "initial" in entry:
            found = entry["verdict"] not in ("not_identifiable", "not_trusted") and result["status"] != "failed"
            by_unit.setdefault(entry["unit"], {})[name] = (entry["value"], entry["std"], entry["initial"], found)
    if not by_unit:
        return None
    return {
        "pictures": [
            figures.figure_html(categorical_charts.estimates_figure(values, unit)) for unit, values in by_unit.items()
        ]
    }


@register_section("search", 40, "How it was found")
def solver_history_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: the solver's cost history."""
    solution = findings.solution
    if solution is None or len(solution.history) < 2:
        return None
    picture = figures.cost_history_figure([h.cost for h in solution.history], [h.note for h in solution.history])
    return {"solution": solution, "finite": math.isfinite(solution.cost), "picture": figures.figure_html(picture)}


@register_section("inputs", 90, "What it was made from")
def provenance_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: date, command line, input hashes, versions and notes on non-finite values."""
    result = findings.result
    if "versions" not in result:
        return None
    parts = {"date": "", "inputs": {}, "notes": []}
    known = {"versions": result["versions"], "command": result.get("again", result.get("command", ""))}
    return known | {name: result.get(name, empty) for name, empty in parts.items()}


@register_section("pictures", 50, "Pictures")
def pictures_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: the command's image files, base64-encoded."""
    files = findings.section_data.get("pictures", ())
    shown = [(path.name, base64.b64encode(path.read_bytes()).decode("ascii")) for path in files]
    return {"pictures": shown} if shown else None


@register_section("days", 10, "From run to run")
def parameter_history_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: parameter values ± 2 std per run, of a history or a batch of one model."""
    result = findings.result if findings.result.get("format") == "yid-history/1" else findings.result.get("history")
    if not result or result.get("format") != "yid-history/1":
        return None
    by_unit: dict[str, dict[str, dict[str, tuple[float, float | None]]]] = {}
    for name, entry in result["parameters"].items():
        told = {run: (own["value"], own["std"]) for run, own in entry["values"].items()}
        by_unit.setdefault(entry["unit"], {})[name] = told
    return {
        "pictures": [
            ("", figures.figure_html(categorical_charts.values_by_source_figure(rows, unit)))
            for unit, rows in by_unit.items()
        ]
    }


@register_section("methods", 10, "Methods")
def method_comparison_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: estimates of every method and its cost over time."""
    comparison: MethodComparison | None = findings.section_data.get("comparison")
    if comparison is None:
        return None
    judged = findings.result["judged"]["parameters"]
    by_unit: dict[str, dict[str, dict[str, tuple[float, float | None]]]] = {}
    for name, entry in judged.items():
        if entry["free"]:
            own = {m: e["parameters"][name] for m, e in findings.result["methods"].items()}
            told = {method: (found["value"], found["std"]) for method, found in own.items()}
            by_unit.setdefault(entry["unit"], {})[name] = told
    pictures = [
        ("Estimates", figures.figure_html(categorical_charts.values_by_source_figure(rows, unit)))
        for unit, rows in by_unit.items()
    ]
    fallen = {}
    for run in comparison.method_results:
        history = [entry for entry in run.solution.history if not entry.note]
        fallen[run.method] = ([entry.seconds for entry in history], [entry.cost for entry in history])
    pictures.append(("Cost over time", figures.figure_html(figures.cost_over_time_figure(fallen))))
    return {"pictures": pictures}


_CALIBRATION_LABELS = {"intervals": "intervals of effects' parameters", "p_values": "p-values of clean recordings"}


@register_section("proof", 10, "What was seen and named")
def blind_validation_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: detection rate by effect size, confusion matrix and calibration."""
    result = findings.result
    if result.get("format") != "yid-blind/1":
        return None
    pictures = []
    sizes = {
        label: {float(size): own[key] for size, own in result["detection_intervals"].items()}
        for key, label in (("gap", "gap seen"), ("right", "named right"))
    }
    if result["detection"]:
        picture = figures.rate_intervals_figure(sizes, "size over the detectable size", "part of the cases", log_x=True)
        pictures.append(("Detection by size, with binomial 95 % intervals", figures.figure_html(picture)))
    shown = result["confusion"]
    counts = np.array(shown["counts"], float).reshape(len(shown["true"]), len(shown["said"]))
    if counts.size:
        picture = categorical_charts.confusion_figure(shown["true"], shown["said"], counts, "true", "said first")
        pictures.append(("What was said of what", figures.figure_html(picture)))
    kept = {
        label: {entry["level"]: entry for entry in result["calibration"][key] if entry["of"]}
        for key, label in (
            ("intervals", "intervals of effects' parameters"),
            ("p_values", "p-values of clean recordings"),
        )
    }
    if any(kept.values()):
        picture = figures.rate_intervals_figure(kept, "promised", "kept", diagonal=True)
        pictures.append(("What is promised, and what is kept", figures.figure_html(picture)))
    return {"pictures": pictures} if pictures else None


@register_section("identifiability", 10, "What can be told")
def identifiability_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: profile likelihoods, and predicted parameter stds for every changed experiment."""
    result = findings.result
    if result.get("format") != "yid-identifiability/1":
        return None
    curves = {}
    for name, profile in result["profiles"].items():
        best = result["parameters"][name]["value"]
        if best > 0:
            curves[name] = ([value / best for value in profile["values"]], profile["delta_chi2"])
    picture = figures.figure_html(figures.profile_likelihood_figure(curves, CHI2_QUANTILE_95)) if curves else None
    asked, names = result["what_if"], list(result["parameters"])
    if picture is None and asked is None:
        return None
    changes = [] if asked is None else [asked["base"], *asked["singles"], *asked["smallest"]]
    return {"picture": picture, "changes": changes, "names": names}


@register_section("information", 10, "The motion that tells most")
def informative_motion_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: joint positions, velocities and efforts over time."""
    found = findings.section_data.get("information")
    if found is None:
        return None
    empty = np.zeros(0)
    unit = partial(joint_channel_unit, found.simulator.step.system, found.joint_names)
    courses = {
        f"joints, from the start [{unit('position')}]": found.joint_positions - found.joint_positions[0],
        f"velocity [{unit('velocity')}]": found.joint_velocities,
        f"effort [{unit('effort')}]": found.joint_efforts,
    }
    curves = [
        TimePlot(words, empty, empty, {name: (found.t, values[:, i]) for i, name in enumerate(found.joint_names)})
        for words, values in courses.items()
    ]
    return {"figures": [figure_html(lines_over_time_figure(curve)) for curve in curves]}


@register_section("plan", 10, "The planned motion")
def planned_motion_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: distance of the point from its target, and joints over time."""
    found = findings.section_data.get("plan")
    if found is None:
        return None
    where = found.point_trajectories.get(findings.result["point"])
    empty = np.zeros(0)
    unit = partial(joint_channel_unit, found.simulator.step.system, found.joint_names)
    curves = []
    if where is not None:
        off = 1e3 * (where - found.target_position)
        lines = {axis: (found.t, off[:, i]) for i, axis in enumerate("xyz")}
        curves.append(TimePlot("from the place [mm]", empty, empty, lines, 1e3 * findings.result["tolerance"]))
    moved = {
        name: (found.t, found.joint_positions[:, i] - found.joint_positions[0, i])
        for i, name in enumerate(found.joint_names)
    }
    curves.append(TimePlot(f"joints, from the start [{unit('position')}]", empty, empty, moved))
    curves.append(
        TimePlot(
            f"effort [{unit('effort')}]",
            empty,
            empty,
            {n: (found.t, found.joint_efforts[:, i]) for i, n in enumerate(found.joint_names)},
        )
    )
    return {"figures": [figure_html(lines_over_time_figure(curve)) for curve in curves]}

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
from yid_ocp.report import diagnosis_summaries, figures, summaries  # noqa: F401, they register
from yid_ocp.report.figures import TimePlotData, lines_over_time_figure
from yid_ocp.report.png_figures import BLIND_CALIBRATION_LABELS
from yid_ocp.report.sections import ReportData, figures_by_unit, joint_channel_unit, register_report_section
from yid_ocp.report.terminal import SUMMARY_BY_FORMAT, SummaryBlock, SummaryStatement, SummaryTable


@register_report_section("verdict", 0, "What was found")
def _verdict(findings: ReportData) -> Mapping[str, Any] | None:
    """Conclusions, verdicts and the blocks up to the key table."""
    blocks, end = _result_blocks(findings)
    told = [block for block in blocks if isinstance(block, SummaryStatement)]
    said = [block.text for kind in ("conclusion", "verdict") for block in told if block.kind == kind]
    return {"verdict": said, "blocks": _without_verdicts(blocks[:end])} if blocks else None


@register_report_section("numbers", 60, "In numbers")
def _remaining_tables(findings: ReportData) -> Mapping[str, Any] | None:
    """Blocks after the key table, without verdicts."""
    blocks, end = _result_blocks(findings)
    rest = _without_verdicts(blocks[end:])
    return {"blocks": rest} if rest else None


def _result_blocks(findings: ReportData) -> tuple[list[SummaryBlock], int]:
    """Summary blocks of a result, none for an unknown format, and the index after the key table, 0 without one."""
    known = SUMMARY_BY_FORMAT.get(str(findings.result.get("format")))
    blocks = [] if known is None else known(findings.result)
    ends = (i + 1 for i, block in enumerate(blocks) if isinstance(block, SummaryTable) and block.is_key_table)
    return blocks, next(ends, 0)


def _without_verdicts(blocks: list[SummaryBlock]) -> list[SummaryBlock]:
    return [block for block in blocks if not (isinstance(block, SummaryStatement) and block.kind != "note")]


@register_report_section("estimates", 10, "Estimates")
def _estimates(findings: ReportData) -> Mapping[str, Any] | None:
    """Free parameters ± 2 std, untrusted ones marked; one figure per unit."""
    result, lost = findings.result, ("not_identifiable", "not_trusted")
    rows = []
    for name, entry in result.get("parameters", {}).items():
        if entry.get("free") and "initial" in entry:
            found = entry["verdict"] not in lost and result["status"] != "failed"
            rows.append((name, entry["unit"], (entry["value"], entry["std"], entry["initial"], found)))
    return {"figures": figures_by_unit(rows, figures.estimates_figure)} if rows else None


@register_report_section("search", 40, "How it was found")
def _solver_history(findings: ReportData) -> Mapping[str, Any] | None:
    solution = findings.solution
    if solution is None or len(solution.history) < 2:
        return None
    figure = figures.cost_history_figure([h.cost for h in solution.history], [h.note for h in solution.history])
    return {"solution": solution, "finite": math.isfinite(solution.cost), "figure": figure}


@register_report_section("inputs", 90, "What it was made from")
def _provenance(findings: ReportData) -> Mapping[str, Any] | None:
    """Date, command line, input hashes, versions and notes on non-finite values."""
    result = findings.result
    if "versions" not in result:
        return None
    command = result.get("again", result.get("command", ""))
    return {"date": "", "inputs": {}, "notes": []} | {**result, "command": command}


@register_report_section("pictures", 50, "Pictures")
def _image_files(findings: ReportData) -> Mapping[str, Any] | None:
    files = findings.section_data.get("pictures", ())
    shown = [(path.name, base64.b64encode(path.read_bytes()).decode("ascii")) for path in files]
    return {"pictures": shown} if shown else None


@register_report_section("days", 10, "From run to run")
def _parameter_history(findings: ReportData) -> Mapping[str, Any] | None:
    """Parameter values ± 2 std per run, of a history or a batch of one model."""
    result = findings.result if findings.result.get("format") == "yid-history/1" else findings.result.get("history")
    if not result or result.get("format") != "yid-history/1":
        return None
    rows = [
        (name, entry["unit"], {run: (own["value"], own["std"]) for run, own in entry["values"].items()})
        for name, entry in result["parameters"].items()
    ]
    return {"figures": figures_by_unit(rows, figures.parameter_values_by_source_figure)}


@register_report_section("methods", 10, "Methods")
def _method_comparison(findings: ReportData) -> Mapping[str, Any] | None:
    """Estimates of every method and its cost over time."""
    comparison: MethodComparison | None = findings.section_data.get("comparison")
    if comparison is None:
        return None
    rows = []
    for name, entry in findings.result["judged"]["parameters"].items():
        if entry["free"]:
            own = {method: e["parameters"][name] for method, e in findings.result["methods"].items()}
            rows.append((name, entry["unit"], {method: (e["value"], e["std"]) for method, e in own.items()}))
    costs = {}
    for run in comparison.method_results:
        history = [entry for entry in run.solution.history if math.isfinite(entry.cost) and not entry.note]
        costs[run.method] = ([entry.seconds for entry in history], [entry.cost for entry in history])
    shown = figures_by_unit(rows, figures.parameter_values_by_source_figure, "Estimates")
    return {"figures": [*shown, ("Cost over time", figures.excess_cost_over_time_figure(costs))]}


@register_report_section("proof", 10, "What was seen and named")
def _blind_validation(findings: ReportData) -> Mapping[str, Any] | None:
    """Detection rate by effect size, confusion matrix and calibration."""
    result = findings.result
    if result.get("format") != "yid-blind/1":
        return None
    shown = []
    if result["detection"]:
        sizes = {
            label: {float(size): own[key] for size, own in result["detection_intervals"].items()}
            for key, label in (("gap", "gap seen"), ("right", "named right"))
        }
        figure = figures.rate_intervals_figure(sizes, "size over the detectable size", "part of the cases", False)
        shown.append(("Detection by size, with binomial 95 % intervals", figure))
    said = result["confusion"]
    counts = np.array(said["counts"], float).reshape(len(said["true"]), len(said["said"]))
    if counts.size:
        figure = figures.confusion_matrix_figure(said["true"], said["said"], counts)
        shown.append(("What was said of what", figure))
    kept = {
        label: {entry["level"]: entry for entry in result["calibration"][key] if entry["of"]}
        for key, label in BLIND_CALIBRATION_LABELS.items()
    }
    if any(kept.values()):
        figure = figures.rate_intervals_figure(kept, "promised", "kept", True)
        shown.append(("What is promised, and what is kept", figure))
    return {"figures": shown} if shown else None


@register_report_section("identifiability", 10, "What can be told")
def _identifiability(findings: ReportData) -> Mapping[str, Any] | None:
    """Profile likelihoods, and predicted parameter stds for every changed experiment."""
    result = findings.result
    if result.get("format") != "yid-identifiability/1":
        return None
    curves = {}
    for name, profile in result["profiles"].items():
        best = result["parameters"][name]["value"]
        if best > 0:
            curves[name] = ([value / best for value in profile["values"]], profile["delta_chi2"])
    figure = figures.profile_likelihood_figure(curves, CHI2_QUANTILE_95) if curves else None
    asked, names = result["what_if"], list(result["parameters"])
    changes = [] if asked is None else [asked["base"], *asked["singles"], *asked["smallest"]]
    return {"figure": figure, "changes": changes, "names": names} if figure is not None or changes else None


@register_report_section("friction", 10, "Friction torque of the data and of the law")
def _friction_torque(findings: ReportData) -> Mapping[str, Any] | None:
    """Friction torque over speed and over the load, from the measured motion and from the fitted law."""
    shown = []
    for cloud in findings.section_data.get("friction_clouds", ()):
        for words, along in (("speed [rad/s]", cloud.speed), ("torque through the gear [N m]", cloud.load)):
            figure = figures.scatter_figure(
                {"data": (along, cloud.measured), "law": (along, cloud.predicted)}, words, "friction [N m]"
            )
            shown.append((cloud.joint, figure))
    return {"figures": shown} if shown else None


@register_report_section("information", 10, "The motion that tells most")
def _informative_motion(findings: ReportData) -> Mapping[str, Any] | None:
    """Joint positions, velocities and efforts over time."""
    return _motion_figures(findings, "information")


@register_report_section("plan", 10, "The planned motion")
def _planned_motion(findings: ReportData) -> Mapping[str, Any] | None:
    """Distance of the point from its target, joint positions and efforts over time."""
    return _motion_figures(findings, "plan")


def _motion_figures(findings: ReportData, key: str) -> Mapping[str, Any] | None:
    found = findings.section_data.get(key)
    if found is None:
        return None
    unit = partial(joint_channel_unit, found.simulator.step.system, found.joint_names)
    curves = []
    if key == "plan" and (where := found.point_trajectories.get(findings.result["point"])) is not None:
        off = 1e3 * (where - found.target_position)
        lines = {axis: (found.t, off[:, i]) for i, axis in enumerate("xyz")}
        tolerance = 1e3 * findings.result["tolerance"]
        curves.append(TimePlotData("from the place [mm]", lines, band_half_height=tolerance))
    courses = {f"joints, from the start [{unit('position')}]": found.joint_positions - found.joint_positions[0]}
    if key == "information":
        courses[f"velocity [{unit('velocity')}]"] = found.joint_velocities
    courses[f"effort [{unit('effort')}]"] = found.joint_efforts
    for words, values in courses.items():
        curves.append(TimePlotData(words, {name: (found.t, values[:, i]) for i, name in enumerate(found.joint_names)}))
    return {"figures": [("", lines_over_time_figure(curve)) for curve in curves]}

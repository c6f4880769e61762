"""Section: estimates and convergence of the compared methods."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.analysis.compare import MethodComparison
from yid_ocp.report import categorical_charts, figures
from yid_ocp.report.sections.base import ReportData, register_section


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

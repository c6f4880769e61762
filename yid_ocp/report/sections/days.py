"""Section: parameters of several runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.report import categorical_charts, figures
from yid_ocp.report.sections.base import ReportData, register_section


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

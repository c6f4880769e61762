"""Section: estimates and their initial values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.report import categorical_charts, figures
from yid_ocp.report.sections.base import ReportData, register_section


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

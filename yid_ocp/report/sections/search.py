"""Section: convergence history of the solver."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from yid_ocp.report import figures
from yid_ocp.report.sections.base import ReportData, register_section


@register_section("search", 40, "How it was found")
def solver_history_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: the solver's cost history."""
    solution = findings.solution
    if solution is None or len(solution.history) < 2:
        return None
    picture = figures.cost_history_figure([h.cost for h in solution.history], [h.note for h in solution.history])
    return {"solution": solution, "finite": math.isfinite(solution.cost), "picture": figures.figure_html(picture)}

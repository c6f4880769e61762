"""Section: provenance of the run (date, command, input hashes, versions)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.report.sections.base import ReportData, register_section


@register_section("inputs", 90, "What it was made from")
def provenance_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: date, command line, input hashes, versions and notes on non-finite values."""
    result = findings.result
    if "versions" not in result:
        return None
    parts = {"date": "", "inputs": {}, "notes": []}
    known = {"versions": result["versions"], "command": result.get("again", result.get("command", ""))}
    return known | {name: result.get(name, empty) for name, empty in parts.items()}

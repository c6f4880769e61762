"""What the run was made from: when, by which command, inputs with hashes, versions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.report.sections.base import Findings, section


@section("inputs", 90, "What it was made from")
def prepare(findings: Findings) -> Mapping[str, Any] | None:
    """Date and command line, inputs with their hashes, versions, and notes on values that are not numbers."""
    result = findings.result
    if "versions" not in result:
        return None
    parts = {"date": "", "inputs": {}, "notes": []}
    known = {"versions": result["versions"], "command": result.get("again", result.get("command", ""))}
    return known | {name: result.get(name, empty) for name, empty in parts.items()}

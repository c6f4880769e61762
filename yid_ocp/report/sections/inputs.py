"""What the run was made from: hashes and versions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.report.sections.base import Findings, section


@section("inputs", 90, "What it was made from")
def prepare(findings: Findings) -> Mapping[str, Any] | None:
    """Inputs with their hashes, versions, and notes on values that are not numbers."""
    result = findings.result
    if "inputs" not in result:
        return None
    return {"inputs": result["inputs"], "versions": result["versions"], "notes": result.get("notes", [])}

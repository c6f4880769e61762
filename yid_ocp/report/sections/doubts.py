"""What is in doubt about the recordings of a run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.report.sections.base import Findings, section
from yid_ocp.report.tables import doubt_rows, doubt_sentences


@section("doubts", 5, "What is in doubt")
def prepare(findings: Findings) -> Mapping[str, Any] | None:
    """Every doubt with its place, how sure it is, and what to do."""
    rows = doubt_rows(findings.result)
    return {"rows": rows, "sentences": doubt_sentences(findings.result)} if rows else None

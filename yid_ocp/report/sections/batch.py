"""Many runs side by side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.report.earlier import run_rows
from yid_ocp.report.fleet import batch_rows, batch_sentences, spread_rows
from yid_ocp.report.sections.base import Findings, section


@section("batch", 5, "Runs")
def prepare(findings: Findings) -> Mapping[str, Any] | None:
    """Tables of `yid-batch/1`."""
    result = findings.result
    if result.get("format") != "yid-batch/1":
        return None
    tables = [("Runs", batch_rows(result)), ("Parameters over all runs", spread_rows(result))]
    if result["history"] is not None:
        tables.append(("Each run against the others", run_rows(result["history"])))
    return {"sentences": batch_sentences(result), "tables": [entry for entry in tables if len(entry[1]) > 1]}

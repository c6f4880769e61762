"""Other days: what moved since a baseline, the world without the effects, and runs side by side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.report.earlier import baseline_rows, counterfactual_rows, history_rows, history_sentences, run_rows
from yid_ocp.report.sections.base import Findings, section


@section("earlier", 6, "Other days")
def prepare(findings: Findings) -> Mapping[str, Any] | None:
    """Tables of `yid-diagnosis/1` with a baseline or a counterfactual, and of `yid-history/1`."""
    result = findings.result
    if result.get("format") == "yid-history/1":
        tables = [("Parameters", history_rows(result)), ("Runs", run_rows(result))]
        return {"sentences": history_sentences(result), "tables": tables}
    titles = ("Since the baseline", "Without the effects, and with them")
    tables = [
        (title, rows) for title, rows in zip(titles, (baseline_rows(result), counterfactual_rows(result)), strict=True)
    ]
    tables = [(title, rows) for title, rows in tables if len(rows) > 1]
    return {"sentences": [], "tables": tables} if tables else None

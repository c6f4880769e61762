"""Section: remaining tables and notes of a command's summary."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.report.sections.base import Findings, section
from yid_ocp.report.sections.verdict import key, summary, without_verdicts


@section("numbers", 60, "In numbers")
def prepare(findings: Findings) -> Mapping[str, Any] | None:
    """Template context: summary blocks after the key table, without verdicts."""
    blocks = summary(findings)
    rest = without_verdicts(blocks[key(blocks) :])
    return {"blocks": rest} if rest else None

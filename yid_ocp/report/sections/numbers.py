"""Section: remaining tables and notes of a command's summary."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.report.sections.base import ReportData, register_section
from yid_ocp.report.sections.verdict import end_of_key_table, result_blocks, without_verdicts


@register_section("numbers", 60, "In numbers")
def remaining_tables_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: summary blocks after the key table, without verdicts."""
    blocks = result_blocks(findings)
    rest = without_verdicts(blocks[end_of_key_table(blocks) :])
    return {"blocks": rest} if rest else None

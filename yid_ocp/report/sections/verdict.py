"""Section: verdict and key table of a command's summary."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.report.sections.base import ReportData, register_section
from yid_ocp.report.summaries import SUMMARY_BY_FORMAT
from yid_ocp.report.summary_blocks import SummaryBlock, SummaryStatement, SummaryTable


@register_section("verdict", 0, "What was found")
def verdict_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: conclusions, verdicts and the blocks up to the key table."""
    blocks = result_blocks(findings)
    if not blocks:
        return None
    told = [block for block in blocks if isinstance(block, SummaryStatement)]
    said = [block.text for weight in ("conclusion", "verdict") for block in told if block.kind == weight]
    return {"verdict": said, "blocks": without_verdicts(blocks[: end_of_key_table(blocks)])}


def result_blocks(findings: ReportData) -> list[SummaryBlock]:
    """Summary blocks of a result; empty for an unknown format."""
    known = SUMMARY_BY_FORMAT.get(str(findings.result.get("format")))
    return [] if known is None else known(findings.result)


def end_of_key_table(blocks: list[SummaryBlock]) -> int:
    """Index after the key table in a list of blocks; 0 without a key table."""
    return next((i + 1 for i, block in enumerate(blocks) if isinstance(block, SummaryTable) and block.is_key_table), 0)


def without_verdicts(blocks: list[SummaryBlock]) -> list[SummaryBlock]:
    """The blocks without verdict and conclusion statements."""
    return [block for block in blocks if not (isinstance(block, SummaryStatement) and block.kind != "note")]

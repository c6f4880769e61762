"""Section: verdict and key table of a command's summary."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.report.blocks import Block, Statement, Table
from yid_ocp.report.sections.base import Findings, section
from yid_ocp.report.summaries import SUMMARIES


@section("verdict", 0, "What was found")
def prepare(findings: Findings) -> Mapping[str, Any] | None:
    """Template context: conclusions, verdicts and the blocks up to the key table."""
    blocks = summary(findings)
    if not blocks:
        return None
    told = [block for block in blocks if isinstance(block, Statement)]
    said = [block.text for weight in ("conclusion", "verdict") for block in told if block.weight == weight]
    return {"verdict": said, "blocks": without_verdicts(blocks[: key(blocks)])}


def summary(findings: Findings) -> list[Block]:
    """Summary blocks of a result; empty for an unknown format."""
    known = SUMMARIES.get(str(findings.result.get("format")))
    return [] if known is None else known(findings.result)


def key(blocks: list[Block]) -> int:
    """Index after the key table in a list of blocks; 0 without a key table."""
    return next((i + 1 for i, block in enumerate(blocks) if isinstance(block, Table) and block.key), 0)


def without_verdicts(blocks: list[Block]) -> list[Block]:
    """The blocks without verdict and conclusion statements."""
    return [block for block in blocks if not (isinstance(block, Statement) and block.weight != "note")]

"""All else that a command said: its other tables and notes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.report.sections.base import Findings, section
from yid_ocp.report.sections.verdict import key, summary, without_verdicts


@section("numbers", 60, "In numbers")
def prepare(findings: Findings) -> Mapping[str, Any] | None:
    """What follows the key table, without the verdicts that the page began with."""
    blocks = summary(findings)
    rest = without_verdicts(blocks[key(blocks) :])
    return {"blocks": rest} if rest else None

"""Constant errors of the torques that drive the motion, where they are part of the model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.report.sections.base import Findings, section
from yid_ocp.report.tables import offset_rows


@section("torques", 30, "How far the torques are off")
def prepare(findings: Findings) -> Mapping[str, Any] | None:
    """One table of `torque_offsets`, whichever command found them."""
    head, *rows = offset_rows(findings.result) or [()]
    return {"head": head, "rows": rows} if rows else None

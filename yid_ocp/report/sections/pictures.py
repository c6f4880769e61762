"""Section: image files of the run folder."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any

from yid_ocp.report.sections.base import ReportData, register_section


@register_section("pictures", 50, "Pictures")
def pictures_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: the command's image files, base64-encoded."""
    files = findings.section_data.get("pictures", ())
    shown = [(path.name, base64.b64encode(path.read_bytes()).decode("ascii")) for path in files]
    return {"pictures": shown} if shown else None

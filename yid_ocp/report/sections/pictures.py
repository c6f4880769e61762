"""Section: image files of the run folder."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any

from yid_ocp.report.sections.base import Findings, section


@section("pictures", 50, "Pictures")
def prepare(findings: Findings) -> Mapping[str, Any] | None:
    """Template context: the command's image files, base64-encoded."""
    files = findings.more.get("pictures", ())
    shown = [(path.name, base64.b64encode(path.read_bytes()).decode("ascii")) for path in files]
    return {"pictures": shown} if shown else None

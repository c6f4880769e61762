"""What a diagnosis says: in words first, then the gap, the places and the candidates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.report.sections import Findings, section

LISTED = 12  # candidates; the rest is in result.json


@section("diagnosis", 5, "The gap and what makes it")
def prepare(findings: Findings) -> Mapping[str, Any] | None:
    """Words, held-out errors before and after each effect, places, candidates."""
    result = findings.result
    if result.get("format") != "yid-diagnosis/1":
        return None
    return {
        "result": result,
        "channels": list(result["gap"]["before"]["rmse"]),
        "which": result["which"][:LISTED],
        "more": max(len(result["which"]) - LISTED, 0),
        "places": [place for place in result["where"] if place["share"] > 0.005],
        "hidden": [place["location"] for place in result["where"] if not place["observable"]],
    }

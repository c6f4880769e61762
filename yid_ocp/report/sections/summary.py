"""What was found, in words and in a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.report import figures
from yid_ocp.report.sections import Findings, section

WORDS = {"identifiable": "found", "weak": "weakly determined", "not_identifiable": "cannot be found"}


@section("summary", 10, "What was found")
def prepare(findings: Findings) -> Mapping[str, Any] | None:
    """Free parameters with deviations and verdicts."""
    result = findings.result
    if not any("free" in entry for entry in result.get("parameters", {}).values()):
        return None
    free = {name: entry for name, entry in result["parameters"].items() if entry.get("free")}
    by_unit: dict[str, dict[str, tuple[float, float | None, float, bool]]] = {}
    for name, entry in free.items():
        found = entry["verdict"] != "not_identifiable" and result["status"] != "failed"
        by_unit.setdefault(entry["unit"], {})[name] = (entry["value"], entry["std"], entry["initial"], found)
    by_verdict = {word: [n for n, e in free.items() if e["verdict"] == key] for key, word in WORDS.items()}
    return {
        "result": result,
        "free": free,
        "words": WORDS,
        "by_verdict": by_verdict,
        "pictures": [figures.html(figures.estimates(values, unit)) for unit, values in by_unit.items()],
    }

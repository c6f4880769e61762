"""What was found, in words and in a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.report import figures
from yid_ocp.report.sections.base import Findings, section
from yid_ocp.report.tables import guess_sentences
from yid_ocp.solvers.words import VERDICT_WORDS, fit_words, interval_words


@section("summary", 10, "What was found")
def prepare(findings: Findings) -> Mapping[str, Any] | None:
    """Free parameters with standard deviations and verdicts."""
    result = findings.result
    if not any("free" in entry for entry in result.get("parameters", {}).values()):
        return None
    fit = result.get("fit") or {}
    free = {name: entry for name, entry in result["parameters"].items() if entry.get("free")}
    by_unit: dict[str, dict[str, tuple[float, float | None, float, bool]]] = {}
    for name, entry in free.items():
        found = entry["verdict"] != "not_identifiable" and result["status"] != "failed"
        by_unit.setdefault(entry["unit"], {})[name] = (entry["value"], entry["std"], entry["initial"], found)
    by_verdict = {verdict: [n for n, e in free.items() if e["verdict"] == verdict] for verdict in VERDICT_WORDS}
    return {
        "result": result,
        "free": free,
        "words": VERDICT_WORDS,
        "by_verdict": by_verdict,
        "interval": interval_words,
        "safeguard": result.get("safeguard", ""),
        "guesses": guess_sentences(fit.get("worse_than_guess", ())),
        "misfit": None if fit.get("explains", True) else fit_words(fit["chi2_per_dof"], False),
        "pictures": [figures.html(figures.estimates(values, unit)) for unit, values in by_unit.items()],
    }

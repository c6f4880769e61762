"""What the recordings can tell, and which experiment would tell more."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.analysis.profile import LEVEL
from yid_ocp.report import figures
from yid_ocp.report.sections.base import Findings, section
from yid_ocp.solvers.words import VERDICT_WORDS, fit_words, interval_words


@section("identifiability", 10, "What can be told")
def prepare(findings: Findings) -> Mapping[str, Any] | None:
    """Verdicts, directions that are not seen, profiles and ranked changes of the experiment."""
    result = findings.result
    if result.get("format") != "yid-identifiability/1":
        return None
    fit = result.get("fit") or {}
    curves = {}
    for name, profile in result["profiles"].items():
        best = result["parameters"][name]["value"]
        if best > 0:
            curves[name] = ([value / best for value in profile["values"]], profile["delta_chi2"])
    return {
        "result": result,
        "words": VERDICT_WORDS,
        "interval_words": interval_words,
        "misfit": None if fit.get("explains", True) else fit_words(fit["chi2_per_dof"], False),
        "hidden": [entry["words"] for entry in result["directions"] if entry["verdict"] != "identifiable"],
        "picture": figures.html(figures.profiles(curves, LEVEL)) if curves else None,
    }

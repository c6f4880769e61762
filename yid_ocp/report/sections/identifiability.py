"""Section: profile likelihoods and the effect of changed experiments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.analysis.profile import LEVEL
from yid_ocp.report import figures
from yid_ocp.report.sections.base import Findings, section


@section("identifiability", 10, "What can be told")
def prepare(findings: Findings) -> Mapping[str, Any] | None:
    """Template context: profile likelihoods, and predicted parameter stds for every changed experiment."""
    result = findings.result
    if result.get("format") != "yid-identifiability/1":
        return None
    curves = {}
    for name, profile in result["profiles"].items():
        best = result["parameters"][name]["value"]
        if best > 0:
            curves[name] = ([value / best for value in profile["values"]], profile["delta_chi2"])
    picture = figures.html(figures.profiles(curves, LEVEL)) if curves else None
    asked, names = result["what_if"], list(result["parameters"])
    if picture is None and asked is None:
        return None
    changes = [] if asked is None else [asked["base"], *asked["singles"], *asked["smallest"]]
    return {"picture": picture, "changes": changes, "names": names}

"""Section: profile likelihoods and the effect of changed experiments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.analysis.profile import CHI2_QUANTILE_95
from yid_ocp.report import figures
from yid_ocp.report.sections.base import ReportData, register_section


@register_section("identifiability", 10, "What can be told")
def identifiability_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: profile likelihoods, and predicted parameter stds for every changed experiment."""
    result = findings.result
    if result.get("format") != "yid-identifiability/1":
        return None
    curves = {}
    for name, profile in result["profiles"].items():
        best = result["parameters"][name]["value"]
        if best > 0:
            curves[name] = ([value / best for value in profile["values"]], profile["delta_chi2"])
    picture = figures.figure_html(figures.profile_likelihood_figure(curves, CHI2_QUANTILE_95)) if curves else None
    asked, names = result["what_if"], list(result["parameters"])
    if picture is None and asked is None:
        return None
    changes = [] if asked is None else [asked["base"], *asked["singles"], *asked["smallest"]]
    return {"picture": picture, "changes": changes, "names": names}

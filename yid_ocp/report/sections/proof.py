"""Section: detection rates, confusion matrix and calibration of a blind validation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from yid_ocp.report import categorical_charts, figures
from yid_ocp.report.sections.base import ReportData, register_section

_CALIBRATION_LABELS = {"intervals": "intervals of effects' parameters", "p_values": "p-values of clean recordings"}


@register_section("proof", 10, "What was seen and named")
def blind_validation_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: detection rate by effect size, confusion matrix and calibration."""
    result = findings.result
    if result.get("format") != "yid-blind/1":
        return None
    pictures = []
    sizes = {
        label: {float(size): own[key] for size, own in result["detection_intervals"].items()}
        for key, label in (("gap", "gap seen"), ("right", "named right"))
    }
    if result["detection"]:
        picture = figures.rate_intervals_figure(sizes, "size over the detectable size", "part of the cases", log_x=True)
        pictures.append(("Detection by size, with binomial 95 % intervals", figures.figure_html(picture)))
    shown = result["confusion"]
    counts = np.array(shown["counts"], float).reshape(len(shown["true"]), len(shown["said"]))
    if counts.size:
        picture = categorical_charts.confusion_figure(shown["true"], shown["said"], counts, "true", "said first")
        pictures.append(("What was said of what", figures.figure_html(picture)))
    kept = {
        label: {entry["level"]: entry for entry in result["calibration"][key] if entry["of"]}
        for key, label in (
            ("intervals", "intervals of effects' parameters"),
            ("p_values", "p-values of clean recordings"),
        )
    }
    if any(kept.values()):
        picture = figures.rate_intervals_figure(kept, "promised", "kept", diagonal=True)
        pictures.append(("What is promised, and what is kept", figures.figure_html(picture)))
    return {"pictures": pictures} if pictures else None

"""What a planned motion would tell, what limits it, and what it asks of the joints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from yid_ocp.report.figures import Curve, html, lines_over_time
from yid_ocp.report.sections.base import Findings, section
from yid_ocp.report.tables import distance_rows, information_rows, information_sentences, plan_rows


@section("information", 5, "The motion that tells most")
def prepare(findings: Findings) -> Mapping[str, Any] | None:
    """Sentences, tables of what is told and of joints, and figures of the joints."""
    found = findings.more.get("information")
    if found is None:
        return None
    empty = np.zeros(0)
    courses = {
        "joints, from the start [rad or m]": found.position - found.position[0],
        "velocity [rad/s or m/s]": found.velocity,
        "effort [N m or N]": found.effort,
    }
    curves = [
        Curve(words, empty, empty, {name: (found.t, values[:, i]) for i, name in enumerate(found.joints)})
        for words, values in courses.items()
    ]
    tables = [rows for rows in (information_rows(findings.result), distance_rows(findings.result)) if len(rows) > 1]
    return {
        "sentences": information_sentences(findings.result),
        "tables": [*tables, plan_rows(findings.result)],
        "figures": [html(lines_over_time(curve)) for curve in curves],
    }

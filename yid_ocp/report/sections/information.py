"""Section: the most informative motion over time."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from yid_ocp.report.figures import TimePlot, figure_html, lines_over_time_figure
from yid_ocp.report.sections.base import ReportData, joint_channel_unit, register_section


@register_section("information", 10, "The motion that tells most")
def informative_motion_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: joint positions, velocities and efforts over time."""
    found = findings.section_data.get("information")
    if found is None:
        return None
    empty = np.zeros(0)
    unit = partial(joint_channel_unit, found.simulator.step.system, found.joints)
    courses = {
        f"joints, from the start [{unit('position')}]": found.position - found.position[0],
        f"velocity [{unit('velocity')}]": found.velocity,
        f"effort [{unit('effort')}]": found.effort,
    }
    curves = [
        TimePlot(words, empty, empty, {name: (found.t, values[:, i]) for i, name in enumerate(found.joints)})
        for words, values in courses.items()
    ]
    return {"figures": [figure_html(lines_over_time_figure(curve)) for curve in curves]}

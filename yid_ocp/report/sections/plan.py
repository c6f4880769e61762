"""Section: a planned motion over time."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from yid_ocp.report.figures import TimePlot, figure_html, lines_over_time_figure
from yid_ocp.report.sections.base import ReportData, joint_channel_unit, register_section


@register_section("plan", 10, "The planned motion")
def planned_motion_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: distance of the point from its target, and joints over time."""
    found = findings.section_data.get("plan")
    if found is None:
        return None
    where = found.points.get(findings.result["point"])
    empty = np.zeros(0)
    unit = partial(joint_channel_unit, found.simulator.step.system, found.joints)
    curves = []
    if where is not None:
        off = 1e3 * (where - found.place)
        lines = {axis: (found.t, off[:, i]) for i, axis in enumerate("xyz")}
        curves.append(TimePlot("from the place [mm]", empty, empty, lines, 1e3 * findings.result["tolerance"]))
    moved = {name: (found.t, found.position[:, i] - found.position[0, i]) for i, name in enumerate(found.joints)}
    curves.append(TimePlot(f"joints, from the start [{unit('position')}]", empty, empty, moved))
    curves.append(
        TimePlot(
            f"effort [{unit('effort')}]",
            empty,
            empty,
            {n: (found.t, found.effort[:, i]) for i, n in enumerate(found.joints)},
        )
    )
    return {"figures": [figure_html(lines_over_time_figure(curve)) for curve in curves]}

"""Section: the most informative motion over time."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from yid_ocp.report.figures import Curve, html, lines_over_time
from yid_ocp.report.sections.base import Findings, joint_unit, section


@section("information", 10, "The motion that tells most")
def prepare(findings: Findings) -> Mapping[str, Any] | None:
    """Template context: joint positions, velocities and efforts over time."""
    found = findings.more.get("information")
    if found is None:
        return None
    empty = np.zeros(0)
    unit = partial(joint_unit, found.mover.step.system, found.joints)
    courses = {
        f"joints, from the start [{unit('position')}]": found.position - found.position[0],
        f"velocity [{unit('velocity')}]": found.velocity,
        f"effort [{unit('effort')}]": found.effort,
    }
    curves = [
        Curve(words, empty, empty, {name: (found.t, values[:, i]) for i, name in enumerate(found.joints)})
        for words, values in courses.items()
    ]
    return {"figures": [html(lines_over_time(curve)) for curve in curves]}

"""Section: recorded signals by group."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.model.system import System
from yid_ocp.report import figures
from yid_ocp.report.figures import TimePlot
from yid_ocp.report.sections.base import ReportData, joint_channel_unit, register_section

_MAX_RECORDINGS = 3  # recordings that are drawn
_MAX_POINTS = 6  # points of a group; more are in the recording
_SHOWN_CHANNELS = ("position", "velocity", "effort", "position_command")


@register_section("recorded", 30, "What was recorded")
def recorded_signals_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: recorded joint channels and points over time."""
    recordings: list[Recording] = findings.section_data.get("recordings", [])[:_MAX_RECORDINGS]
    system: System | None = findings.section_data.get("system")
    pictures = [
        (f"{title} of {recording.name}", figures.figure_html(figures.lines_over_time_figure(curve)))
        for recording in recordings
        for title, curve in _curves(recording, system)
    ]
    return {"pictures": pictures} if pictures else None


def _curves(recording: Recording, system: System | None) -> list[tuple[str, TimePlot]]:
    empty, found = np.zeros(0), []
    for group in recording.groups:
        if isinstance(group, JointGroup):
            for channel in _SHOWN_CHANNELS:
                unit = joint_channel_unit(system, group.names, channel)
                values = group.channels.get(channel)
                if values is not None:
                    lines = {name: (group.t, values[:, i]) for i, name in enumerate(group.names)}
                    title = f"{channel.replace('_', ' ')} [{unit}]"
                    found.append((f"Joints: {channel.replace('_', ' ')}", TimePlot(title, empty, empty, lines)))
            continue
        lines = {
            f"{name}.{axis}": (group.t, group.position[:, i, c])
            for i, name in enumerate(group.names[:_MAX_POINTS])
            for c, axis in enumerate("xyz")
        }
        found.append((f"Points: {group.name}", TimePlot("position [m]", empty, empty, lines)))
    return found

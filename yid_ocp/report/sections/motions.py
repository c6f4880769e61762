"""Sections on what moved and what was measured: animation, fitted channels, recorded channels."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.model.system import System
from yid_ocp.problem.episodes import Episode, EpisodePrediction
from yid_ocp.report import figures
from yid_ocp.report.animation import Animation, ModelTrajectory, make_animation
from yid_ocp.report.figures import TimePlot
from yid_ocp.report.sections.base import ReportData, joint_channel_unit, register_section
from yid_ocp.sensors import Sensor

_MAX_RECORDINGS = 4  # recordings; a page with more is slow to open
_ROLE_LABELS = {"estimate": "estimated on", "held_out": "held out"}


@register_section("scene", 3, "In motion")
def animation_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: the command's animations, else the predicted motion of each recording, held-out first."""
    scenes = [entry for entry in findings.animations or _predicted(findings) if len(entry.t) > 1]
    told = json.dumps([entry.to_dict() for entry in scenes[:_MAX_RECORDINGS]], separators=(",", ":")).replace(
        "<", "\\u003c"
    )
    both = any(
        len({motion.name for motion in entry.motions} - {"measured"}) < len(entry.motions) > 1 for entry in scenes
    )
    return {"scenes": told, "both": both} if scenes else None


def _predicted(findings: ReportData) -> Sequence[Animation]:
    problem, solution = findings.problem, findings.solution
    if problem is None or solution is None:
        return []
    result = []
    for role, episode, outcome in sorted(findings.predicted_episodes, key=lambda entry: entry[0] != "held_out")[
        :_MAX_RECORDINGS
    ]:
        theta, _ = problem.split(solution.x, problem.episodes.index(episode) if role == "estimate" else 0)
        own = problem.predictor.episode_theta(episode, theta)
        q = outcome.rollout.state[:, : problem.system.n_coordinates]
        told = ModelTrajectory("predicted", problem.system, own, episode.grid.node_times, q)
        result.append(make_animation(f"{episode.name} ({_ROLE_LABELS[role]})", [told], episode.recording))
    return result


_MAX_PICTURES = 24  # a page with more is too heavy to open; result.json and trajectories.h5 have them all


@register_section("fit", 20, "How well it fits")
def fit_quality_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: measured and predicted values with residuals over time, and a residual histogram."""
    if findings.problem is None or not findings.predicted_episodes:
        return None
    pictures: list[tuple[str, str]] = []
    left = 0
    for role, episode, outcome in findings.predicted_episodes:
        for title, curves in _pictures(findings, role, episode, outcome):
            if len(pictures) < _MAX_PICTURES:
                role_words = "held out" if role == "held_out" else "estimated on"
                pictures.append(
                    (
                        f"{title} in {episode.name} ({role_words})",
                        figures.figure_html(figures.time_plots_figure(curves)),
                    )
                )
            else:
                left += 1
    residuals = _whitened(findings)
    histogram = figures.figure_html(figures.residual_histogram_figure(residuals)) if residuals else None
    return {"pictures": pictures, "left": left, "histogram": histogram}


def _pictures(
    findings: ReportData, role: str, episode: Episode, outcome: EpisodePrediction
) -> list[tuple[str, list[TimePlot]]]:
    assert findings.problem is not None
    step = findings.problem.step.time_step
    found = []
    for samples, predicted in zip(episode.measurements, outcome.predicted_outputs, strict=True):
        t = episode.grid.start_time + step * (samples.node + samples.fraction)
        sensor, course = samples.sensor, None
        if sensor.outputs_per_channel == 3 and len(t) < episode.grid.steps / 2:
            course = _course(findings, role, episode, outcome, sensor)
        for c, channel in (
            enumerate(sensor.channel_names) if sensor.outputs_per_channel == 3 else [(0, sensor.group_name)]
        ):
            columns = (
                [3 * c + i for i in range(3)] if sensor.outputs_per_channel == 3 else range(len(sensor.channel_names))
            )
            curves: list[TimePlot] = []
            for i in columns:
                name = "xyz"[i % 3] if sensor.outputs_per_channel == 3 else sensor.channel_names[i].rsplit(".", 1)[1]
                told = (t, samples.value[:, i], samples.std[:, i], {"predicted": predicted[:, i]})
                smooth = None if course is None else (episode.grid.node_times, course[:, i])
                curves += figures.prediction_and_residual_plots(name, sensor.unit, *told, smooth)
            found.append((channel, curves))
    return found


def _course(
    findings: ReportData, role: str, episode: Episode, outcome: EpisodePrediction, sensor: Sensor
) -> np.ndarray:
    """What a sensor of points would have seen at every node, for one that looks seldom, shape (N + 1, k)."""
    problem, solution = findings.problem, findings.solution
    assert problem is not None
    assert solution is not None
    theta, _ = problem.split(solution.x, problem.episodes.index(episode) if role == "estimate" else 0)
    n, state = problem.system.n_coordinates, outcome.rollout.state
    efforts = np.zeros((len(state), n))
    own = problem.predictor.episode_theta(episode, theta)
    seen = problem.model_functions.compiled_sensor(sensor, ())(state[:, :n], state[:, 2 * n :], efforts, own)
    return np.asarray(seen[0][:, :, 0])


def _whitened(findings: ReportData) -> dict[str, np.ndarray]:
    found: dict[str, list[np.ndarray]] = {}
    for role, episode, outcome in findings.predicted_episodes:
        if role != "estimate":
            continue
        for samples, predicted in zip(episode.measurements, outcome.predicted_outputs, strict=True):
            ratio = (predicted - samples.value) / samples.std
            found.setdefault(samples.sensor.group_name, []).append(ratio[np.isfinite(ratio)])
    return {group: np.concatenate(parts) for group, parts in found.items() if sum(map(len, parts))}


_MAX_LISTED_RECORDINGS = 3  # recordings that are drawn
_MAX_POINTS = 6  # points of a group; more are in the recording
_SHOWN_CHANNELS = ("position", "velocity", "effort", "position_command")


@register_section("recorded", 30, "What was recorded")
def recorded_signals_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: recorded joint channels and points over time."""
    recordings: list[Recording] = findings.section_data.get("recordings", [])[:_MAX_LISTED_RECORDINGS]
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

"""Sections on what moved and what was measured: animation, fitted channels, recorded channels."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode, EpisodePrediction
from yid_ocp.report import figures
from yid_ocp.report.animation import Animation, ModelTrajectory, make_animation
from yid_ocp.report.figures import TimePlotData
from yid_ocp.report.sections import ReportData, joint_channel_unit, register_report_section
from yid_ocp.sensors import Sensor

_MAX_RECORDINGS = 4  # recordings; a page with more is slow to open
_MAX_PICTURES = 24  # a page with more is too heavy to open; result.json and trajectories.h5 have them all
_MAX_LISTED_RECORDINGS = 3  # recordings that are drawn
_MAX_POINTS = 6  # points of a group; more are in the recording
_SHOWN_CHANNELS = ("position", "velocity", "effort", "position_command")
_ROLE_LABELS = {"estimate": "estimated on", "held_out": "held out"}


@register_report_section("scene", 3, "In motion")
def _animation(findings: ReportData) -> Mapping[str, Any] | None:
    """The command's animations, else the predicted motion of each recording, held-out first."""
    scenes = [entry for entry in findings.animations or _predicted_motions(findings) if len(entry.t) > 1]
    told = json.dumps([entry.to_dict() for entry in scenes[:_MAX_RECORDINGS]], separators=(",", ":"))
    names = [[motion.name for motion in entry.motions] for entry in scenes]
    both = any("measured" in own and len(own) > 1 for own in names)
    return {"scenes": told.replace("<", "\\u003c"), "both": both} if scenes else None


def _predicted_motions(findings: ReportData) -> Sequence[Animation]:
    result = []
    episodes = sorted(findings.predicted_episodes, key=lambda entry: entry[0] != "held_out")
    for role, episode, outcome in episodes[:_MAX_RECORDINGS]:
        problem, own = _problem_and_theta(findings, role, episode)
        q = outcome.rollout.state[:, : problem.system.n_coordinates]
        told = ModelTrajectory("predicted", problem.system, own, episode.grid.node_times, q)
        result.append(make_animation(f"{episode.name} ({_ROLE_LABELS[role]})", [told], episode.recording))
    return result


def _problem_and_theta(findings: ReportData, role: str, episode: Episode) -> tuple[EstimationProblem, np.ndarray]:
    """The problem of a prediction, and the parameters (ntheta,) found for one of its recordings."""
    problem, solution = findings.problem, findings.solution
    assert problem is not None
    assert solution is not None
    theta, _ = problem.split(solution.x, problem.episodes.index(episode) if role == "estimate" else 0)
    return problem, problem.predictor.theta_with_episode_values(episode, theta)


@register_report_section("fit", 20, "How well it fits")
def _fit_quality(findings: ReportData) -> Mapping[str, Any] | None:
    """Measured and predicted values with residuals over time, and a residual histogram."""
    found: list[tuple[str, list[TimePlotData]]] = []
    whitened: dict[str, list[np.ndarray]] = {}
    for role, episode, outcome in findings.predicted_episodes if findings.problem is not None else ():
        for title, curves in _fitted_curves(findings, role, episode, outcome):
            found.append((f"{title} in {episode.name} ({_ROLE_LABELS[role]})", curves))
        for samples, predicted in zip(episode.measurements, outcome.predicted_outputs, strict=True):
            if role == "estimate":
                ratio = (predicted - samples.value) / samples.std
                whitened.setdefault(samples.sensor.group_name, []).append(ratio[np.isfinite(ratio)])
    if not found:
        return None
    residuals = {group: np.concatenate(parts) for group, parts in whitened.items() if any(map(len, parts))}
    return {
        "figures": [(title, figures.time_plots_figure(curves)) for title, curves in found[:_MAX_PICTURES]],
        "left": max(len(found) - _MAX_PICTURES, 0),
        "histogram": figures.whitened_residual_histogram_figure(residuals) if residuals else None,
    }


def _fitted_curves(
    findings: ReportData, role: str, episode: Episode, outcome: EpisodePrediction
) -> list[tuple[str, list[TimePlotData]]]:
    """Title and curves of each point, or of all joints of a group together."""
    found = []
    for samples, predicted in zip(episode.measurements, outcome.predicted_outputs, strict=True):
        sensor, grid, course = samples.sensor, episode.grid, None
        t = grid.start_time + grid.time_step * (samples.node + samples.fraction)
        width = sensor.outputs_per_channel
        if sensor.point_names and len(t) < grid.steps / 2:
            course = _course(findings, role, episode, outcome, sensor)
        names = sensor.channel_names
        parts = {name: range(width * c, width * (c + 1)) for c, name in enumerate(names)} if width > 1 else {}
        for title, columns in (parts or {sensor.group_name: range(len(names))}).items():
            curves: list[TimePlotData] = []
            for i in columns:
                name = sensor.output_names[i].rsplit(".", 1)[1]
                told = (t, samples.value[:, i], samples.std[:, i], {"predicted": predicted[:, i]})
                smooth = None if course is None else (grid.node_times, course[:, i])
                curves += figures.prediction_and_residual_plots(name, sensor.unit, *told, smooth)
            found.append((title, curves))
    return found


def _course(
    findings: ReportData, role: str, episode: Episode, outcome: EpisodePrediction, sensor: Sensor
) -> np.ndarray:
    """What a sensor of points would have seen at every node, for one that looks seldom, shape (N + 1, k)."""
    problem, own = _problem_and_theta(findings, role, episode)
    values = problem.predictor.node_values(outcome.rollout)
    return problem.model_functions.compiled_sensor_function(sensor)(values, own).output


@register_report_section("recorded", 30, "What was recorded")
def _recorded_signals(findings: ReportData) -> Mapping[str, Any] | None:
    """Recorded joint channels and points over time."""
    recordings: list[Recording] = findings.section_data.get("recordings", [])[:_MAX_LISTED_RECORDINGS]
    system: System | None = findings.section_data.get("system")
    shown = [
        (f"{title} of {recording.name}", figures.lines_over_time_figure(curve))
        for recording in recordings
        for title, curve in _recorded_curves(recording, system)
    ]
    return {"figures": shown} if shown else None


def _recorded_curves(recording: Recording, system: System | None) -> list[tuple[str, TimePlotData]]:
    found = []
    for group in recording.groups:
        if isinstance(group, JointGroup):
            for channel in _SHOWN_CHANNELS:
                values = group.channels.get(channel)
                if values is not None:
                    words, unit = channel.replace("_", " "), joint_channel_unit(system, group.names, channel)
                    lines = {name: (group.t, values[:, i]) for i, name in enumerate(group.names)}
                    found.append((f"Joints: {words}", TimePlotData(f"{words} [{unit}]", lines)))
        else:
            lines = {
                f"{name}.{axis}": (group.t, group.position[:, i, c])
                for i, name in enumerate(group.names[:_MAX_POINTS])
                for c, axis in enumerate("xyz")
            }
            found.append((f"Points: {group.name}", TimePlotData("position [m]", lines)))
    return found

"""Report sections that all commands share: conclusions, estimates, motion and measurements."""

from __future__ import annotations

import base64
import itertools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from yid_ocp.analysis.compare import MethodsComparisonResult
from yid_ocp.arrays import Array
from yid_ocp.data.recording import JOINT_CHANNEL_UNITS, JointGroup, Recording
from yid_ocp.inference.uncertainty import CHI2_95_TWO_SIDED, VERDICT_TABLE_TEXTS, EstimateChecksBeyondFit
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode, EpisodePrediction
from yid_ocp.problem.predictions import ChannelPrediction
from yid_ocp.report import diagnosis_summaries, figures, model_summaries, summaries, terminal  # noqa: F401, they register
from yid_ocp.report.animation import ConfigurationTrajectory, animation_of_trajectories, animations_to_dict
from yid_ocp.report.figures import TimePlotData, lines_over_time_figure
from yid_ocp.report.sections import ReportData, draw_figure_per_unit, register_report_section

_MAX_ANIMATIONS = 4  # a page with more is slow to open
_MAX_FIT_FIGURES = 24  # a page with more is too heavy to open; result.json and trajectories.h5 have them all
_MAX_LISTED_RECORDINGS = 3  # largest number of recordings that are drawn
_MAX_DRAWN_POINTS = 6  # largest number of points of a group that are drawn
_ESTIMATE_COLORS = {"start": figures.MEASURED_COLOR, "estimate": figures.LINE_PALETTE[0]}
_ESTIMATE_COLORS |= {"estimate that cannot be trusted": figures.LINE_PALETTE[1]}
_ESTIMATED, _HELD_OUT = "estimated on", "held out"
_JOINT_CHANNELS = ("position", "velocity", "effort", "position_command")


@register_report_section("verdict", 0, "What was found")
def _verdict(findings: ReportData) -> Mapping[str, Any] | None:
    said, first, _ = _result_blocks(findings)
    return {"verdict": said, "blocks": first} if said or first else None


@register_report_section("numbers", 60, "In numbers")
def _remaining_tables(findings: ReportData) -> Mapping[str, Any] | None:
    *_, rest = _result_blocks(findings)
    return {"blocks": rest} if rest else None


def _result_blocks(
    findings: ReportData,
) -> tuple[list[str], list[terminal.StatementTableOrCode], list[terminal.StatementTableOrCode]]:
    """Return conclusions and verdicts of a result, and its other blocks up to the key table and after it."""
    blocks = terminal.summary_blocks(findings.result)
    ends = (i + 1 for i, block in enumerate(blocks) if isinstance(block, terminal.SummaryTable) and block.is_key_table)
    end = next(ends, 0)
    told = [block for block in blocks if isinstance(block, terminal.SummaryStatement) and block.kind != "note"]
    said = [block.text for kind in ("conclusion", "verdict") for block in told if block.kind == kind]
    first, rest = ([block for block in part if block not in told] for part in (blocks[:end], blocks[end:]))
    return said, first, rest


@register_report_section("estimates", 10, "Estimates")
def _estimates(findings: ReportData) -> list[tuple[str, Any]]:
    result, lost = findings.result, ("not_identifiable", "not_trusted")
    rows = []
    for name, entry in result.get("parameters", {}).items():
        if entry.get("free") and "initial" in entry:
            found = entry["verdict"] not in lost and result["status"] != "failed"
            label = "estimate" if found else "estimate that cannot be trusted"
            values = {"start": (entry["initial"], None), label: (entry["value"], entry["std"])}
            rows.append((name, entry["unit"], values))
    return draw_figure_per_unit(rows, partial(figures.parameter_values_by_source_figure, colors=_ESTIMATE_COLORS))


@register_report_section("search", 40, "How it was found")
def _solver_history(findings: ReportData) -> Mapping[str, Any] | None:
    solution = findings.solution
    if solution is None or len(solution.history) < 2:
        return None
    steps = solution.history
    figure = figures.solution_cost_history_figure([h.cost for h in steps], [h.note for h in steps])
    return {"solution": solution, "finite": math.isfinite(solution.cost), "figure": figure}


@register_report_section("inputs", 90, "Inputs")
def _provenance(findings: ReportData) -> Mapping[str, Any] | None:
    result = findings.result
    if "versions" not in result:
        return None
    return {"date": "", "inputs": {}, "notes": [], **result, "command": result.get("again", result.get("command", ""))}


@register_report_section("pictures", 50, "Pictures")
def _image_files(findings: ReportData) -> Mapping[str, Any] | None:
    files = findings.section_data.get("pictures", ())
    shown = [(path.stem.replace("_", " "), base64.b64encode(path.read_bytes()).decode("ascii")) for path in files]
    return {"pictures": shown} if shown else None


@register_report_section("days", 10, "From run to run")
def _parameter_history(findings: ReportData) -> list[tuple[str, Any]]:
    formats, result = ("yid-history/1", "yid-overlay/1"), findings.result
    result = result if result.get("format") in formats else result.get("history") or {}
    rows, parameters = [], result.get("parameters", {})
    for name, entry in parameters.items():
        known = {r: own for r, own in entry["values"].items() if own.get("verdict") != "not_identifiable"}
        rows.append((name, entry["unit"], {run: (own["value"], own["std"]) for run, own in known.items()}))
    runs = dict.fromkeys(run for entry in parameters.values() for run in entry["values"])
    colors = dict(zip(runs, itertools.cycle(figures.LINE_PALETTE), strict=False))
    return draw_figure_per_unit(rows, partial(figures.parameter_values_by_source_figure, colors=colors))


@register_report_section("methods", 10, "Methods")
def _method_comparison(findings: ReportData) -> Iterator[tuple[str, Any]]:
    comparison: MethodsComparisonResult | None = findings.section_data.get("comparison")
    if comparison is None:
        return
    ended, rows = [run.method for run in comparison.method_results if run.has_values], []
    for name, entry in findings.result["judged"]["parameters"].items():
        if entry["free"] and entry["verdict"] != "not_identifiable":
            own = {method: findings.result["methods"][method]["parameters"][name] for method in ended}
            values = {m: (e["value"], None if comparison.has_process_noise else e["std"]) for m, e in own.items()}
            rows.append((name, entry["unit"], values | {"best fit": (entry["value"], entry["std"])}))
    yield from (("Estimates", own) for _, own in draw_figure_per_unit(rows, figures.parameter_values_by_source_figure))
    costs = {}
    for run in comparison.method_results:
        history = [entry for entry in run.solution.history if math.isfinite(entry.cost) and not entry.note]
        costs[run.method] = ([entry.seconds for entry in history], [entry.cost for entry in history])
    yield "Cost over time", figures.method_costs_over_wall_time_figure(costs)


@register_report_section("identifiability", 10, "Identifiable parameters")
def _identifiability(findings: ReportData) -> Mapping[str, Any] | None:
    result = findings.result
    if result.get("format") != "yid-identifiability/1":
        return None
    curves: dict[str, dict[str, tuple[list[float], list[float]]]] = {}  # by verdict, with a range of its own
    for name, profile in result["profiles"].items():
        best, verdict = (result["parameters"][name][key] for key in ("value", "verdict"))
        if best > 0:
            own = ([value / best for value in profile["values"]], profile["delta_chi2"])
            curves.setdefault(VERDICT_TABLE_TEXTS[verdict], {})[name] = own
    shown = {said: figures.profile_likelihood_figure(own, CHI2_95_TWO_SIDED) for said, own in curves.items()}
    asked, names = result["what_if"], list(result["parameters"])
    tried = [] if asked is None else [asked["base"], *asked["singles"], *asked["smallest"]]
    changes = {entry["words"]: entry for entry in tried}
    return {"figures": shown, "changes": changes, "names": names} if shown or changes else None


@register_report_section("friction", 10, "Friction torque of the data and of the law")
def _friction_torque(findings: ReportData) -> Iterator[tuple[str, Any]]:
    for cloud in findings.section_data.get("friction_clouds", ()):
        for words, along in (("speed [rad/s]", cloud.speed), ("torque through the gear [N m]", cloud.load)):
            points = {"data": (along, cloud.measured), "law": (along, cloud.predicted)}
            yield cloud.joint, figures.scatter_figure(points, words, "friction [N m]")


@register_report_section("plan", 10, "The planned motion")
def _planned_motion(findings: ReportData) -> Iterator[tuple[str, Any]]:
    """Yield plots over time: distance of a plan's point from its target; joint positions, velocities and efforts."""
    found = findings.section_data.get("plan")
    if found is None:
        return
    system, names = found.simulator.step.system, found.joint_names
    if (where := found.point_trajectories.get(findings.result.get("point"))) is not None:
        lines, tolerance = _lines(found.t, "xyz", 1e3 * (where - found.target_position)), findings.result["tolerance"]
        title = f"{findings.result['point']}, from its target [mm] (grey: tolerance)"
        yield "", lines_over_time_figure(TimePlotData(title, lines, band_half_height=1e3 * tolerance))
    for words, channel, values in (
        ("joint positions, from the start", "position", found.joint_positions - found.joint_positions[0]),
        ("joint velocities", "velocity", found.joint_velocities),
        ("joint efforts", "effort", found.joint_efforts),
    ):
        title = f"{words} [{_joint_channel_unit(system, names, channel)}]"
        yield "", lines_over_time_figure(TimePlotData(title, _lines(found.t, names, values)))


def _lines(t: Array, names: Sequence[str], values: Array) -> dict[str, tuple[Array, Array]]:
    return {name: (t, values[:, i]) for i, name in enumerate(names)}


def _joint_channel_unit(system: System | None, names: Sequence[str], channel: str) -> str:
    """Return the unit of a joint channel (two for mixed kinds). Joints unknown to the system count as revolute."""
    revolute = JOINT_CHANNEL_UNITS[channel]
    units = {} if system is None else {joint.name: joint.unit(revolute) for joint in system.mechanism.joints}
    return ", ".join(sorted({units.get(name, revolute) for name in names}, key=lambda unit: unit != revolute))


class _PredictedEpisode(NamedTuple):
    """A recording and its prediction with the parameters theta (ntheta,) that were estimated for it."""

    role: str
    problem: EstimationProblem
    theta: Array
    episode: Episode
    prediction: EpisodePrediction
    expected_errors: Mapping[str, float]  # rms by channel from noise of sensors and torques, of held-out recordings


def _predicted_episodes(findings: ReportData) -> Iterator[_PredictedEpisode]:
    """Yield every recording that could be predicted, fitted ones first, then held-out ones."""
    problem, solution = findings.problem, findings.solution
    if problem is None or solution is None:
        return
    checks = solution.checks or EstimateChecksBeyondFit()
    fitted = zip(problem.episodes, solution.episode_predictions, strict=False)
    entries = [(_ESTIMATED, i, *own) for i, own in enumerate(fitted)]
    for role, i, episode, prediction in entries + [(_HELD_OUT, 0, *own) for own in checks.held_out_predictions]:
        if not isinstance(prediction, str):
            shared, _ = problem.unpack_episode_unknowns(solution.x, i)
            theta = problem.predictor.theta_with_episode_values(episode, shared)
            expected = checks.expected_prediction_errors.get(episode.name, {})
            yield _PredictedEpisode(role, problem, theta, episode, prediction, expected)


@register_report_section("scene", 3, "In motion")
def _animation(findings: ReportData) -> Mapping[str, Any] | None:
    """Return the command's animations or, without any, the predicted motion of recordings, held-out ones first."""
    scenes = [*findings.animations]
    if not scenes:
        for own in sorted(_predicted_episodes(findings), key=lambda own: own.role != _HELD_OUT)[:_MAX_ANIMATIONS]:
            system, grid = own.problem.system, own.episode.grid
            q = own.prediction.rollout.state[:, : system.n_coordinates]
            told = ConfigurationTrajectory("predicted", system, own.theta, grid.node_times, q)
            scenes.append(animation_of_trajectories(f"{own.episode.name} ({own.role})", [told], own.episode.recording))
    scenes = [entry for entry in scenes if len(entry.t) > 1]
    text = json.dumps(animations_to_dict(scenes[:_MAX_ANIMATIONS], findings.robot), separators=(",", ":"))
    return {"scenes": text.replace("<", "\\u003c")} if scenes else None


@register_report_section("fit", 20, "How well it fits")
def _fit_quality(findings: ReportData) -> Mapping[str, Any] | None:
    found = []
    whitened: dict[str, list[Array]] = {}
    for own in _predicted_episodes(findings):
        share = own.problem.options.excess_residual_criteria.noise_fraction_of_stated_std
        found += [(f"{name} in {own.episode.name} ({own.role})", curves) for name, curves in _fitted_curves(own, share)]
        for samples, predicted in zip(own.episode.measurements, own.prediction.predicted_outputs, strict=True):
            if own.role == _ESTIMATED:
                ratio = (predicted - samples.value) / (share * samples.std)
                whitened.setdefault(samples.sensor.group_name, []).append(ratio[np.isfinite(ratio)])
    if not found:
        return None
    residuals = {group: np.concatenate(parts) for group, parts in whitened.items() if any(map(len, parts))}
    return {
        "figures": [(title, figures.time_plots_figure(curves)) for title, curves in found[:_MAX_FIT_FIGURES]],
        "left": max(len(found) - _MAX_FIT_FIGURES, 0),
        "histogram": figures.whitened_residual_histogram_figure(residuals) if residuals else None,
    }


@register_report_section("overlay", 20, "Both predictions over the measurements")
def _overlaid_predictions(findings: ReportData) -> Iterator[tuple[str, Any]]:
    pairs: Sequence[tuple[ChannelPrediction, ChannelPrediction]] = findings.section_data.get("overlay", ())
    for first, second in pairs[:_MAX_FIT_FIGURES]:
        own, other = findings.result["runs"]
        factor, shown = terminal.scale_and_unit_with_metres_as_mm(first.unit)
        apart, curves = second.predicted_at(first.t) - first.predicted, list[TimePlotData]()
        for i, name in enumerate("xyz" if apart.shape[1] == 3 else [first.channel.rpartition(".")[2]]):
            lines = {own: (first.t, first.predicted[:, i]), other: (second.t, second.predicted[:, i])}
            curves.append(TimePlotData(f"{name} [{first.unit}]", lines, first.t, first.measured[:, i]))
            band = 2 * factor * float(np.nanmedian(first.noise_std[:, i]))
            difference = {f"{other} minus {own}": (first.t, factor * apart[:, i])}
            title = f"difference, ± 2 stated std shaded [{shown}]"
            curves.append(TimePlotData(title, difference, band_half_height=band, is_low_row=True))
        yield f"{first.channel} in {first.recording}", figures.time_plots_figure(curves, figures.MEASURED_COLOR)


def _fitted_curves(own: _PredictedEpisode, noise_fraction: float) -> Iterator[tuple[str, list[TimePlotData]]]:
    """Yield title and curves of each point, or of all joints of a group together."""
    grid = own.episode.grid
    for samples, predicted in zip(own.episode.measurements, own.prediction.predicted_outputs, strict=True):
        sensor, course = samples.sensor, None
        t = grid.start_time + grid.time_step * (samples.node + samples.fraction)
        if len(t) == 0:
            continue
        if sensor.point_names and len(t) < grid.steps / 2:
            # readings of a slow sensor at every node
            values = own.problem.predictor.rollout_node_values(own.prediction.rollout)
            course = own.problem.model_functions.compiled_sensor_function(sensor)(values, own.theta).output
        names, width = sensor.channel_names, sensor.outputs_per_channel
        parts = {name: range(width * c, width * (c + 1)) for c, name in enumerate(names)} if width > 1 else {}
        by_sensor = np.sqrt(np.mean(samples.std**2, axis=0).reshape(-1, width).sum(axis=1))
        shares = [own.expected_errors.get(n, noise_fraction * s) / s for n, s in zip(names, by_sensor, strict=True)]
        for title, columns in (parts or {sensor.group_name: range(len(names))}).items():
            curves: list[TimePlotData] = []
            for i in columns:
                name, unit = sensor.output_names[i].rsplit(".", 1)[1], sensor.channel_units[i // width]
                std = shares[i // width] * samples.std[:, i]
                told = (t, samples.value[:, i], std, {"predicted": predicted[:, i]})
                smooth = None if course is None else (grid.node_times, course[:, i])
                curves += figures.channel_prediction_and_residual_plot_data(name, unit, *told, smooth)
            yield title, curves


@register_report_section("recorded", 30, "What was recorded")
def _recorded_signals(findings: ReportData) -> Iterator[tuple[str, Any]]:
    system: System | None = findings.section_data.get("system")
    recordings: Sequence[Recording] = findings.section_data.get("recordings", [])[:_MAX_LISTED_RECORDINGS]
    for recording, group in ((own, group) for own in recordings for group in own.joint_and_point_groups):
        if isinstance(group, JointGroup):
            for channel in _JOINT_CHANNELS:
                values = group.values_by_channel.get(channel)
                if values is not None:
                    words, unit = channel.replace("_", " "), _joint_channel_unit(system, group.names, channel)
                    curve = TimePlotData(f"{words} [{unit}]", _lines(group.t, group.names, values))
                    yield f"Joints: {words} of {recording.name}", lines_over_time_figure(curve)
        else:
            names = [f"{name}.{axis}" for name in group.names[:_MAX_DRAWN_POINTS] for axis in "xyz"]
            lines = _lines(group.t, names, group.position.reshape(len(group.t), -1))
            figure = lines_over_time_figure(TimePlotData("position [m]", lines))
            yield f"Points: {group.name} of {recording.name}", figure
    if (left := len(findings.section_data.get("recordings", ())) - len(recordings)) > 0:
        yield f"{left} more recordings are not drawn.", None

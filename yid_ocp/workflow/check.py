"""The command `check`: validate a run and its discretisation without solving."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.analysis import discretisation, step_diagnostics
from yid_ocp.analysis.pinocchio_comparison import compare_system_with_pinocchio, compare_urdf_with_pinocchio
from yid_ocp.arrays import Array
from yid_ocp.config.settings import RunSettings
from yid_ocp.data.channel_checks import QUALITY_LIMITS, median_sample_period
from yid_ocp.display import Progress, abbreviated_names_text, count_with_noun
from yid_ocp.files import check_input_file
from yid_ocp.integrator.step import Step
from yid_ocp.model.objects.base import MATERIAL_DENSITIES
from yid_ocp.model.system import System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.problem.options import SensorOptions
from yid_ocp.report.animation import AnimationData, animation_of_trajectories, measured_motion_animation
from yid_ocp.sensors import CHANNEL_KINDS, joints
from yid_ocp.workflow.build import build_step, build_system, link_division_parameter_scale, urdf_reader_arguments
from yid_ocp.workflow.build_problem import build_problem, issues_to_plain_data, min_grasp_gaps_at_start
from yid_ocp.workflow.command_runner import EXIT_FAILED, EXIT_WRONG_INPUT, CommandOutcome, make_command_function
from yid_ocp.workflow.prediction_outputs import predicted_configuration_trajectory
from yid_ocp.workflow.run_folder import atomic_run_folder
from yid_ocp.workflow.run_inputs import input_files_by_name

_FREQUENCY_TOLERANCE = 0.02  # fraction by which a frequency may move when links or steps are refined, without a warning
_N_MODES = 3
_STIFFNESS_UNITS = ("N m^2", "N m/rad", "N/m")


def run_and_return_exit_code(arguments: argparse.Namespace) -> int:
    """Run the command `check` and return its exit code."""
    code = make_command_function(_run_check)(arguments)
    return EXIT_WRONG_INPUT if code == EXIT_FAILED else code


def _run_check(run: RunSettings, out: str | Path | None, progress: Progress) -> CommandOutcome[None]:
    with atomic_run_folder(run, out, "check") as folder:
        folder.record_run_start(run, "check")
        warnings: list[str] = []
        progress.begin_stage("building the model")
        step, item = build_step(run), run.model.object
        if item is not None and (text := item.implausible_density_text):
            known = "{:g} to {:g}".format(*MATERIAL_DENSITIES)
            warnings.append(f"{text}, but materials have {known}. Correct its mass [kg] or sizes [m]")
        recordings, problem = [], None
        if run.recordings.estimate:
            progress.begin_stage("placing the recordings on the model")
            problem = build_problem(run, step)
            for role, episodes in (("estimate", problem.episodes), ("held_out", problem.held_out)):
                recordings += [_recording(problem, role, episode, warnings) for episode in episodes]
        progress.begin_stage("comparing masses and inertias with the library Pinocchio")
        mechanics = _mechanics(run, step, problem, warnings)
        progress.begin_stage("testing whether links and time step are fine enough")
        convergence = _frequency_convergence(run, problem, warnings)
        shown = {}
        if problem is not None:
            first = problem.evaluate(problem.initial_unknowns, derivatives=False)
            _warn_of_simulation_at_start(problem, first, warnings)
            taken = [episode.recording for episode in (*problem.episodes, *problem.held_out)]
            data = {"recordings": taken, "system": step.system}
            shown = {"animations": _scenes(problem, first), "section_data": data}
        is_refused = run.recordings.stop_on_any_issue and bool(warnings or convergence["warnings"])
        result = {
            "format": "yid-check/1",
            "refused": is_refused,
            "model": {"name": step.system.mechanism.name, **step.sizes},
            "mechanics": mechanics,
            "recordings": recordings,
            "convergence": convergence,
            "issues": [] if problem is None else issues_to_plain_data(problem.options.data_issues),
            "warnings": warnings,
        }
        written = folder.write_result_and_report(run, progress, result, **shown)
    return CommandOutcome(folder.path, written, None, not is_refused)


def _mechanics(run: RunSettings, step: Step, problem: EstimationProblem | None, warnings: list[str]) -> dict[str, Any]:
    system = step.system
    theta, posture = system.parameters.vector(), np.zeros(system.n_coordinates)
    if problem is not None:
        first = problem.episodes[0]
        theta = problem.predictor.theta_with_episode_values(first, theta)
        known = [*system.actuated_coordinate_indices, *system.prescribed_coordinate_indices]
        posture[known] = first.initial_known_coordinates
    found = {"built": compare_system_with_pinocchio(system, theta, posture)}
    path = input_files_by_name(run)[run.model.robot] if run.model.robot is not None else None
    if path is not None and b"<mujoco" not in check_input_file(path).read_bytes():
        # Pinocchio reads the URDF file itself, without changes by settings or effects
        read, gravity = urdf_reader_arguments(run), np.array(run.model.gravity, float)
        try:
            found["file"] = compare_urdf_with_pinocchio(path, read_urdf(path, **read), gravity, **read)
        except ValueError as error:
            warnings.append(f"{path.name} is not compared, because Pinocchio cannot read it: {error}. No run needs it")
    warnings += [entry.words for entry in found.values() if not entry.agrees_within_rounding]
    return {n: {**asdict(e), "agrees": e.agrees_within_rounding, "words": e.words} for n, e in found.items()}


def _recording(problem: EstimationProblem, role: str, episode: Episode, warnings: list[str]) -> dict[str, Any]:
    recording, system, arm = episode.recording, problem.system, episode.recording.joints
    noise_std_of = joints.joint_torque_noise_std
    noise, share = _input_noise(problem, episode), problem.options.excess_residual_criteria.noise_fraction_of_stated_std
    for samples in episode.measurements:
        known = samples.std[np.isfinite(samples.std)]
        noise[samples.sensor.group_name] = {
            "std": share * float(np.median(known)) if known.size else None,
            "unit": " or ".join(dict.fromkeys(samples.sensor.channel_units)),
        }
        group = samples.sensor.group_name
        if arm is not None and group == joints.JOINT_EFFORT_SENSOR_KEY:
            choice, names = problem.options.sensors.get(group, SensorOptions()), samples.sensor.effort_joints
            noise[group]["recorded_std"] = float(np.median(noise_std_of(arm, names, choice, episode.name)))
        if known.size and samples.sensor.unit == "m" and np.median(known) < QUALITY_LIMITS.min_noise:
            size = f"{1e3 * np.median(known):.2g} mm"
            said = f"the stated noise of {group} is {size}, less than any sensor of points has. "
            said += f"Set sensors.{group}.std to that of your sensor [m]"
            warnings.append(f"in '{episode.name}', {said}")
    groups, span = {}, problem.options.duration
    used = recording if span is None else recording.time_slice(-math.inf, episode.grid.start_time + span)
    for own in used.all_groups:
        period, gap = median_sample_period(own.t), float(np.max(np.diff(own.t), initial=0.0))
        counts = {"samples": len(own.t), "names": list(own.names)}
        groups[own.name] = counts | {"rate": 1.0 / period if period else 0.0, "longest_gap": gap}
    entry: dict[str, Any] = {"recording": episode.name, "role": role, "duration": used.duration}
    entry |= {"steps": episode.grid.steps, "groups": groups, "noise": noise, "noise_fraction": share}
    if arm is not None:
        moves = system.driven or any(samples.sensor.effort_joints for samples in episode.measurements)
        if moves and not system.servos and arm.effort is not None and arm.effort_kind is None:
            said = "efforts are taken as the torques at the times of the samples, because the recording does not say "
            said += "what they are. If they are means over the time between samples, or commanded torques, set "
            said += "sensors.joints.effort.effort_sampling_kind to mean or command"
            warnings.append(f"in '{episode.name}', {said}")
    rests = problem.options.initial_state != "fitted_to_points"
    if rests and (system.driven or system.prescribed or system.elastic_joints):
        torque = episode.torque[0] if system.driven else None
        theta = problem.predictor.theta_with_episode_values(episode, problem.theta)
        rest = problem.model_functions.equilibrium_solver.solve(episode.initial_known_coordinates, theta, torque)
        if not rest.is_converged:
            warnings.append(f"for '{episode.name}' with the initial parameters, {rest.message}")
    entry["grasp_gaps"] = min_grasp_gaps_at_start(problem, episode)
    return entry


def _input_noise(problem: EstimationProblem, episode: Episode) -> dict[str, Any]:
    arm, errors, noise = episode.recording.joints, episode.input_errors, {}
    if arm is None or errors is None:
        return {}
    effort, position = joints.JOINT_EFFORT_SENSOR_KEY, joints.JOINT_POSITION_GROUP_NAME
    for group, noise_std in ((effort, joints.joint_torque_noise_std), (position, joints.joint_angle_noise_std)):
        choice = problem.options.sensors.get(group, SensorOptions())
        units = problem.system.mechanism.units_at_joints(problem.system.driven, CHANNEL_KINDS[group].unit)
        noise[group] = {
            "std": float(np.median(noise_std(arm, problem.system.driven, choice, episode.name))),
            "unit": " or ".join(dict.fromkeys(units)),
            "estimated": not joints.is_noise_std_stated(arm, group, choice),
        }
    noise[effort]["bias_std"] = float(np.median(errors.torque_bias_std))
    return noise


def _scenes(problem: EstimationProblem, first: Evaluation) -> list[AnimationData]:
    """Animations of every estimation recording with the initial parameters, or of the recording alone."""
    scenes = []
    for i, episode in enumerate(problem.episodes):
        shared = problem.unpack_episode_unknowns(problem.initial_unknowns, i)[0]
        if first.ok:
            prediction = first.episode_predictions[i]
            told = predicted_configuration_trajectory("with the initial values", problem, episode, prediction, shared)
            scenes.append(animation_of_trajectories(episode.name, [told], episode.recording))
        else:
            theta = problem.predictor.theta_with_episode_values(episode, shared)
            scenes += measured_motion_animation(episode.name, problem.system, theta, episode.recording)
    return scenes


def _warn_of_simulation_at_start(problem: EstimationProblem, at_x: Evaluation, warnings: list[str]) -> None:
    growth = discretisation.alternating_error_growth_of_worst_recording(problem, problem.initial_unknowns)
    if growth is not None and not growth.keeps_errors_below_resolution:
        warnings.append(f"with the initial parameters {growth.stability_message}")
    if not at_x.ok:
        said = "the model cannot be simulated with the initial parameters, so `solve` may fail. Set larger stiffnesses "
        said += f"(parameters.NAME.initial) or problem.time_step: {problem.step.time_step / 2:g}"
        warnings.append(f"{said}. The reason: {at_x.message}")


def _frequency_convergence(run: RunSettings, problem: EstimationProblem | None, warnings: list[str]) -> dict[str, Any]:
    """Lowest natural frequencies with twice the links (`links`), and with half and a quarter of the `time_step`."""
    found: dict[str, Any] = {"links": [], "time_step": [], "message": "", "warnings": []}
    system = build_system(run)
    h = run.problem.time_step_or_10_ms if problem is None else problem.step.time_step
    names = (*system.driven, *system.prescribed)
    if names and problem is None:
        return found | {"message": "No natural frequencies are computed, because the posture comes from a recording."}
    theta, guess, posture = system.parameters.vector(), None, dict[str, float]()
    rule = (run.problem.force_split, run.problem.constraint_force_at)
    if problem is not None:
        first = problem.episodes[0]
        posture = dict(zip(names, map(float, first.initial_known_coordinates), strict=True)) if names else {}
        theta = problem.predictor.theta_with_episode_values(first, theta)
        guess = None if first.fixed_initial_state is None else first.fixed_initial_state.state[: system.n_coordinates]
    frequencies = step_diagnostics.step_map_natural_frequencies
    own = frequencies(system, posture, theta, h, *rule, guess)
    if own.message:
        return found | {"message": f"No natural frequencies were computed: {own.message}."}
    if own.n_unstable_modes:
        remedy = "problem.constraint_force_at: midpoint, " if rule[1] == "node" and system.grasps else ""
        grow = f"at the first posture, {count_with_noun(own.n_unstable_modes, 'vibration')} of the model would grow in "
        grow += f"every step, so the simulation is unstable. Set problem.time_step: {h / 2:g}, "
        warnings.append(f"{grow}{remedy}or a larger model.damping")
    found["time_step"] = steps = [_row(h, own)]
    steps += [_row(h / k, frequencies(system, posture, theta, h / k, *rule, guess)) for k in (2, 4)]
    warnings += _too_stiff_start_warnings(system, theta, h, *(row["hertz"][:1] for row in (steps[0], steps[-1])))
    step = f"problem.time_step: {_fine_time_step(h, max(steps[-1]['hertz'], default=0.0)):.2g} (for an error of 2 %)"
    _warn(found, "the time step is", f"the time step goes from {h:g} to {h / 4:g} s", step, steps)
    count = None if (item := run.model.object) is None else item.uniform_or_total_link_count
    if item is not None and count is not None:
        other = build_system(run, link_division=2)
        known = zip(system.parameters.names, theta, strict=True)
        values = {own: x * link_division_parameter_scale(run, own, 2) for own, x in known if own in other.parameters}
        finer = frequencies(other, posture, other.parameters.vector(values), h, *rule)
        found["links"] = rows = [_row(count, own), _row(2 * count, finer)]
        links = f"the number of links goes from {count} to {2 * count}"
        per_joint = [name for name in values if link_division_parameter_scale(run, name, 2) != 1]
        double = f" and double the initial values of {abbreviated_names_text(per_joint)}, as each segment is then half "
        double = f"{double}as long" * bool(per_joint)
        _warn(found, "the links are", links, f"{abbreviated_names_text(item.divided_links_settings)}{double}", rows)
    return found


def _too_stiff_start_warnings(
    system: System, theta: Array, h: float, stated: Sequence[float], finest: Sequence[float]
) -> list[str]:
    """Return a warning if the lowest frequency, with the time step `h` and a quarter of it, only follows the step."""
    if not finest or finest[0] < 1 / h:  # half of the highest frequency that a quarter of the step can hold
        return []
    known = [(system.parameters[name], x) for name, x in zip(system.parameters.names, theta, strict=True)]
    stiff = [f"{own.name} ({x:.3g} {own.unit})" for own, x in known if own.unit in _STIFFNESS_UNITS]
    said = f"the lowest natural frequency only follows the time step ({stated[0]:.3g} Hz with {h:g} s, {finest[0]:.3g} "
    said += f"Hz with {h / 4:g} s), so with the initial parameters the model is too stiff to be identified. Check size "
    return [f"{said}and unit of the initial values: {abbreviated_names_text(stiff)}"]


def _fine_time_step(h: float, hertz: float) -> float:
    """Return a step [s] with 2 % error of a vibration with `hertz` at the step `h` / 4, by the midpoint rule's atan."""
    return 0.45 / max(8 / h * math.tan(math.pi / 4 * min(hertz * h, 1.9)), 0.9 / h)


def _row(value: float, found: step_diagnostics.UndampedStepMapFrequencies) -> dict[str, Any]:
    hertz = found.frequencies_hz[:_N_MODES].tolist()
    return {"value": value, "hertz": hertz, "message": found.message}


def _warn(found: dict[str, Any], what: str, when: str, remedy: str, rows: list[dict[str, Any]]) -> None:
    """Warn of frequencies that differ between the first row and the last, finest row, or say that none does."""
    moved = [
        f"mode {i} from {a:.3g} to {b:.3g} Hz"
        for i, (a, b) in enumerate(zip(rows[0]["hertz"], rows[-1]["hertz"], strict=False), start=1)
        if b > 0 and abs(a - b) / b > _FREQUENCY_TOLERANCE
    ]
    change = f"by more than {100 * _FREQUENCY_TOLERANCE:g} % when {when}"
    said = f"at the initial values, natural frequencies change {change}: {', '.join(moved)}. Set {remedy}. `solve "
    said += "--set output.checked_discretisation=both` tests whether the estimates need this"
    found["warnings"] += [said] if moved else []
    fine = f"No natural frequency changes {change}, so {what} fine enough. "
    found["message"] += fine * (not moved and bool(rows[-1]["hertz"]))

"""The command `check`: validates a run without solving it and checks its discretisation."""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.analysis.discretisation import largest_error_growth
from yid_ocp.analysis.pinocchio_comparison import compare_system_with_pinocchio, compare_urdf_with_pinocchio
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import RunSettings
from yid_ocp.data.recording import Recording
from yid_ocp.integrator.step import Step
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.problem.options import SensorOptions
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.report.animation import Animation, ModelTrajectory, make_animation, recording_animation
from yid_ocp.report.summaries import check_summary
from yid_ocp.sensors.joints import (
    EFFORT_GROUP,
    POSITION_GROUP,
    is_noise_std_stated,
    joint_angle_noise_std,
    joint_torque_noise_std,
)
from yid_ocp.solvers.base import covariance_and_chi2, parameter_estimates
from yid_ocp.workflow.build import build_step
from yid_ocp.workflow.build_problem import build_problem, initial_grasp_gaps
from yid_ocp.workflow.command_runner import EXIT_FAILED, EXIT_WRONG_INPUT, CommandResult, run_and_print
from yid_ocp.workflow.discretisation_check import frequency_convergence, measure_discretisation_shifts
from yid_ocp.workflow.recording_issues import issues_result
from yid_ocp.workflow.run_folder import new_run_folder
from yid_ocp.workflow.run_inputs import input_files

_RESULT_FORMAT = "yid-check/1"


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    settings = load_config(arguments.config, arguments.overrides)
    code = run_and_print(arguments, lambda shown: run_check(settings, arguments.out, shown), check_summary)
    return EXIT_WRONG_INPUT if code == EXIT_FAILED else code


def run_check(run: RunSettings, out: str | Path | None = None, progress: Progress = NULL_PROGRESS) -> CommandResult:
    """Validate a run without solving it.

    Returns
    -------
    CommandResult
        `warnings` in its result lists what will work but should be looked at, `discretisation` how far every estimate
        would move with a finer model if it were the initial value.

    Raises
    ------
    ConfigError, DataError, ModelError, OutputError
        Whatever would stop `solve`.
    """
    with new_run_folder(run, out, "check") as folder:
        folder.begin_run(run, "check")
        warnings: list[str] = []
        progress.begin_stage("building the model")
        # the equations are the same compiled or not, and a check needs only a few steps
        plain = replace(run, problem=replace(run.problem, use_compiler=False))
        step = build_step(plain)
        model = {"name": step.system.mechanism.name, **step.sizes}
        recordings, problem = [], None
        if run.recordings.estimate:
            progress.begin_stage("placing the recordings on the model")
            problem = build_problem(plain, step)
            for role, episodes in (("estimate", problem.episodes), ("held_out", problem.held_out)):
                recordings += [_recording(problem, role, episode, warnings) for episode in episodes]
        progress.begin_stage("comparing the bodies with another library")
        mechanics = _mechanics(plain, step, problem, warnings)
        progress.begin_stage("refining links and time step")
        convergence = frequency_convergence(run, problem, warnings)
        first = None if problem is None else problem.evaluate(problem.initial_unknowns)
        moved = {} if problem is None or first is None else _moves(plain, problem, first, warnings, progress)
        result = {
            "format": _RESULT_FORMAT,
            "model": model,
            "mechanics": mechanics,
            "recordings": recordings,
            "convergence": convergence,
            "discretisation": moved,
            "doubts": [] if problem is None else issues_result(problem.options.data_issues),
            "warnings": warnings,
        }
        written = folder.write_result(result)
        if problem is not None and first is not None:
            taken = [episode.recording for episode in (*problem.episodes, *problem.held_out)]
            section_data = {"recordings": taken, "system": step.system}
            animations = _scenes(problem, first)
            folder.write_report_page(run, written, progress, animations=animations, section_data=section_data)
        else:
            folder.write_report_page(run, written, progress)
    passed = not (run.recordings.strict and warnings)
    return CommandResult(folder.path, written, is_successful=passed)


def _mechanics(
    run: RunSettings, step: Step, problem: EstimationProblem | None, warnings: list[str]
) -> dict[str, dict[str, Any]]:
    system, arms = step.system, run.model.arms
    theta = system.parameters.vector()
    posture = np.zeros(system.n_coordinates)
    if problem is not None:
        theta = problem.predictor.episode_theta(problem.episodes[0], theta)
        posture[[*system.driven_indices, *system.prescribed_indices]] = problem.episodes[0].initial_known_coordinates
    found = {"built": compare_system_with_pinocchio(system, theta, posture)}
    if run.model.robot is not None:
        # the file's own numbers, not those that settings or effects put in their place
        read: dict[str, Any] = {
            "joints": arms.joints,
            "locked": arms.locked_joints,
            "exclude_links": arms.exclude_links,
        }
        path = input_files(run)[run.model.robot]
        try:
            found["file"] = compare_urdf_with_pinocchio(
                path, read_urdf(path, **read), np.array(run.model.gravity, float), **read
            )
        except ValueError as error:
            warnings.append(f"{path.name} cannot be compared, Pinocchio does not read it: {error}")
    warnings += [entry.words for entry in found.values() if not entry.agrees]
    return {name: {**asdict(entry), "agrees": entry.agrees, "words": entry.words} for name, entry in found.items()}


def _recording(problem: EstimationProblem, role: str, episode: Episode, warnings: list[str]) -> dict[str, Any]:
    recording, system = episode.recording, problem.system
    entry: dict[str, Any] = {
        "recording": episode.name,
        "role": role,
        "duration": recording.duration,
        "steps": episode.grid.steps,
        "groups": _groups(recording),
    }
    noise = {}
    for samples in episode.measurements:
        known = samples.std[np.isfinite(samples.std)]
        noise[samples.sensor.group_name] = {
            "samples": int(np.sum(np.any(samples.weight > 0, axis=1))),
            "std": float(np.median(known)) if known.size else None,
            "unit": samples.sensor.unit,
        }
    entry["noise"] = _input_noise(problem, episode) | noise
    rate = 1.0 / problem.step.time_step
    joints = recording.joints
    if joints is not None:
        recorded = 1.0 / float(np.median(np.diff(joints.t)))
        if recorded < 0.5 * rate:
            warnings.append(f"{episode.name}: joints come at {recorded:.4g} Hz, the model steps at {rate:.4g} Hz")
        moves = system.driven or any(samples.sensor.effort_joints for samples in episode.measurements)
        if moves and not system.servos and joints.effort is not None and joints.effort_kind is None:
            warnings.append(
                f"{episode.name}: nothing says whether joints/effort is a sample, a mean or a command (attribute "
                f"effort_kind); it is taken as a {joints.effort_kind_or_default}"
            )
    if problem.options.initial_state != "fitted_to_points" and (
        system.driven or system.prescribed or system.elastic_joints
    ):
        torque = episode.torque[0] if system.driven else None
        rest = problem.model_functions.equilibrium_solver.solve(
            episode.initial_known_coordinates, problem.predictor.episode_theta(episode, problem.theta), torque
        )
        entry["equilibrium"] = {"found": rest.is_converged, "imbalance": rest.max_imbalance, "message": rest.message}
        if not rest.is_converged:
            warnings.append(f"{episode.name}: {rest.message} with the initial parameters")
    entry["grasp_gaps"] = initial_grasp_gaps(problem, episode)
    return entry


def _input_noise(problem: EstimationProblem, episode: Episode) -> dict[str, Any]:
    joints, errors = episode.recording.joints, episode.input_errors
    if joints is None or errors is None:
        return {}
    effort, position = (problem.options.sensors.get(group, SensorOptions()) for group in (EFFORT_GROUP, POSITION_GROUP))
    driven, where = problem.system.driven, episode.name
    levels = {
        EFFORT_GROUP: (joint_torque_noise_std(joints, driven, effort, where), effort, "N m"),
        POSITION_GROUP: (joint_angle_noise_std(joints, driven, position, where), position, "rad"),
    }
    noise: dict[str, Any] = {
        group: {
            "samples": len(joints.t),
            "std": float(np.median(std)),
            "unit": unit,
            "estimated": not is_noise_std_stated(joints, group, choice),
        }
        for group, (std, choice, unit) in levels.items()
    }
    noise[EFFORT_GROUP]["bias_std"] = float(np.median(errors.torque_bias_std))
    return noise


def _scenes(problem: EstimationProblem, first: Evaluation) -> list[Animation]:
    """What the initial parameters make of every recording that is estimated on, or what was recorded alone."""
    system, scenes = problem.system, []
    for i, episode in enumerate(problem.episodes):
        theta = problem.predictor.episode_theta(episode, problem.split(problem.initial_unknowns, i)[0])
        if first.ok:
            q = first.episode_predictions[i].rollout.state[:, : system.n_coordinates]
            told = [ModelTrajectory("with the initial values", system, theta, episode.grid.node_times, q)]
            scenes.append(make_animation(episode.name, told, episode.recording))
        else:
            alone = recording_animation(episode.name, system, theta, episode.recording)
            scenes += [] if alone is None else [alone]
    return scenes


def _moves(
    run: RunSettings, problem: EstimationProblem, at_x: Evaluation, warnings: list[str], progress: Progress
) -> dict[str, Any]:
    x = problem.initial_unknowns
    growth = largest_error_growth(problem, x)
    if growth is not None and not growth.is_stable:
        warnings.append(f"with the initial parameters {growth.description}")
    if not at_x.ok:
        warnings.append(f"the model cannot be rolled out with the initial parameters: {at_x.message}")
        return {}
    found = measure_discretisation_shifts(run, problem, x, at_x, ("links", "time_step"), progress, models_alone=True)
    warnings += found.notes
    # how poorly initial values fit says nothing of how sure the data will be of what fits
    covariance, _ = covariance_and_chi2(problem, replace(at_x, residual=np.zeros_like(at_x.residual)))
    std = parameter_estimates(problem, x, at_x, covariance, None)
    return found.to_result({name: std[name].std for name in found.estimate_shifts})


def _groups(recording: Recording) -> dict[str, dict[str, Any]]:
    result: dict[str, dict[str, Any]] = {}
    for group in recording.groups:
        name = getattr(group, "name", "joints")
        steps = np.diff(group.t)
        rate = 1.0 / float(np.median(steps)) if len(steps) else 0.0
        longest = float(np.max(steps)) if len(steps) else 0.0
        result[name] = {"samples": len(group.t), "rate": rate, "longest_gap": longest, "names": list(group.names)}
    return result

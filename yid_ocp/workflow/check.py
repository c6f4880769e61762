"""The command `check`: validates a run without solving it and checks its discretisation."""

from __future__ import annotations

import argparse
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.analysis.cross_check import check_file, check_system
from yid_ocp.analysis.stability import growth_of_fit
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import Run
from yid_ocp.data.recording import Recording
from yid_ocp.integrator.step import Step
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.problem.options import SensorOptions
from yid_ocp.progress import SILENT, Progress
from yid_ocp.report.scene import Scene, Told, recorded_scene, scene
from yid_ocp.report.summaries import check_summary
from yid_ocp.sensors.joints import EFFORT, POSITION, angle_std, is_stated, torque_std
from yid_ocp.solvers.base import estimates, uncertainty
from yid_ocp.workflow.build import build_problem, build_step, first_gaps, input_files
from yid_ocp.workflow.command import DONE, WRONG_INPUT, carry_out
from yid_ocp.workflow.doubts import doubts_result
from yid_ocp.workflow.folder import new_run_folder
from yid_ocp.workflow.refine import discretisation, refine

FORMAT = "yid-check/1"


@dataclass(frozen=True)
class CheckOutcome:
    """Result of `run_check`: the run folder and the contents of its result.json."""

    folder: Path
    result: dict[str, Any]


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    settings = load_config(arguments.config, arguments.overrides)
    outcome = carry_out(lambda shown: run_check(settings, arguments.out, shown), check_summary, arguments)
    return WRONG_INPUT if settings.recordings.strict and outcome.result["warnings"] else DONE


def run_check(run: Run, out: str | Path | None = None, progress: Progress = SILENT) -> CheckOutcome:
    """Validate a run without solving it.

    Parameters
    ----------
    run : Run
    out : str or Path, optional
    progress : Progress, optional

    Returns
    -------
    CheckOutcome
        `warnings` in its result lists what will work but should be looked at; `discretisation` says how far every
        estimate would move with a finer model if it were the initial value.

    Raises
    ------
    ConfigError, DataError, ModelError, OutputError
        Whatever would stop `solve`.
    """
    with new_run_folder(run, out, "check") as folder:
        folder.begin(run, "check")
        warnings: list[str] = []
        progress.stage("building the model")
        # the equations are the same compiled or not, and a check needs only a few steps
        plain = replace(run, problem=replace(run.problem, compiler=False))
        step = build_step(plain)
        model = {"name": step.system.mechanism.name, **step.sizes}
        recordings, problem = [], None
        if run.recordings.estimate:
            progress.stage("placing the recordings on the model")
            problem = build_problem(plain, step)
            for role, episodes in (("estimate", problem.episodes), ("held_out", problem.held_out)):
                recordings += [_recording(problem, role, episode, warnings) for episode in episodes]
        progress.stage("comparing the bodies with another library")
        mechanics = _mechanics(plain, step, problem, warnings)
        progress.stage("refining links and time step")
        convergence = refine(run, problem, warnings)
        first = None if problem is None else problem.evaluate(problem.start)
        moved = {} if problem is None or first is None else _moves(plain, problem, first, warnings, progress)
        result = {
            "format": FORMAT,
            "model": model,
            "mechanics": mechanics,
            "recordings": recordings,
            "convergence": convergence,
            "discretisation": moved,
            "doubts": [] if problem is None else doubts_result(problem.options.doubts),
            "warnings": warnings,
        }
        written = folder.finish(result)
        if problem is not None and first is not None:
            taken = [episode.recording for episode in (*problem.episodes, *problem.held_out)]
            folder.report(
                run,
                written,
                progress,
                scenes=_scenes(problem, first),
                more={"recordings": taken, "system": step.system},
            )
        else:
            folder.report(run, written, progress)
    return CheckOutcome(folder.path, written)


def _mechanics(
    run: Run, step: Step, problem: EstimationProblem | None, warnings: list[str]
) -> dict[str, dict[str, Any]]:
    """The robot's file as it was read, and the built model, beside Pinocchio's."""
    system, arms = step.system, run.model.arms
    theta = system.parameters.vector()
    posture = np.zeros(system.size)
    if problem is not None:
        theta = problem.predictor.own_theta(problem.episodes[0], theta)
        posture[[*system.driven_indices, *system.prescribed_indices]] = problem.episodes[0].posture
    found = {"built": check_system(system, theta, posture)}
    if run.model.robot is not None:
        # the file's own numbers, not those that settings or effects put in their place
        read: dict[str, Any] = {"joints": arms.joints, "locked": arms.locked, "exclude_links": arms.exclude_links}
        path = input_files(run)[run.model.robot]
        try:
            found["file"] = check_file(path, read_urdf(path, **read), np.array(run.model.gravity, float), **read)
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
    for samples in episode.samples:
        known = samples.std[np.isfinite(samples.std)]
        noise[samples.sensor.group] = {
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
        moves = system.driven or any(samples.sensor.efforts for samples in episode.samples)
        if moves and not system.servos and joints.effort is not None and joints.effort_kind is None:
            warnings.append(
                f"{episode.name}: nothing says whether joints/effort is a sample, a mean or a command (attribute "
                f"effort_kind); it is taken as a {joints.effort_taken_as}"
            )
    if problem.options.initial_state != "fitted_to_points" and (system.driven or system.prescribed or system.elastic):
        torque = episode.torque[0] if system.driven else None
        rest = problem.functions.statics.solve(
            episode.posture, problem.predictor.own_theta(episode, problem.theta), torque
        )
        entry["equilibrium"] = {"found": rest.converged, "imbalance": rest.error, "message": rest.message}
        if not rest.converged:
            warnings.append(f"{episode.name}: {rest.message} with the initial parameters")
    entry["grasp_gaps"] = first_gaps(problem, episode)
    return entry


def _input_noise(problem: EstimationProblem, episode: Episode) -> dict[str, Any]:
    """Noise of what drives the motion, and whether nobody stated it; medians over the driven joints."""
    joints, errors = episode.recording.joints, episode.errors
    if joints is None or errors is None:
        return {}
    effort, position = (problem.options.sensors.get(group, SensorOptions()) for group in (EFFORT, POSITION))
    driven, where = problem.system.driven, episode.name
    levels = {
        EFFORT: (torque_std(joints, driven, effort, where), effort, "N m"),
        POSITION: (angle_std(joints, driven, position, where), position, "rad"),
    }
    noise: dict[str, Any] = {
        group: {
            "samples": len(joints.t),
            "std": float(np.median(std)),
            "unit": unit,
            "estimated": not is_stated(joints, group, choice),
        }
        for group, (std, choice, unit) in levels.items()
    }
    noise[EFFORT]["bias_std"] = float(np.median(errors.bias_std))
    return noise


def _scenes(problem: EstimationProblem, first: Evaluation) -> list[Scene]:
    """What the initial parameters make of every recording that is estimated on, or what was recorded alone."""
    system, scenes = problem.system, []
    for i, episode in enumerate(problem.episodes):
        theta = problem.predictor.own_theta(episode, problem.split(problem.start, i)[0])
        if first.ok:
            q = first.episodes[i].rollout.state[:, : system.size]
            told = [Told("with the initial values", system, theta, episode.grid.times, q)]
            scenes.append(scene(episode.name, told, episode.recording))
        else:
            alone = recorded_scene(episode.name, system, theta, episode.recording)
            scenes += [] if alone is None else [alone]
    return scenes


def _moves(
    run: Run, problem: EstimationProblem, at_x: Evaluation, warnings: list[str], progress: Progress
) -> dict[str, Any]:
    """How far estimates would move with a finer model if they were the initial values, and by what they are known."""
    x = problem.start
    growth = growth_of_fit(problem, x)
    if growth is not None and not growth.stable:
        warnings.append(f"with the initial parameters {growth.words}")
    if not at_x.ok:
        warnings.append(f"the model cannot be rolled out with the initial parameters: {at_x.message}")
        return {}
    found = discretisation(run, problem, x, at_x, ("links", "time_step"), progress, models_alone=True)
    warnings += found.notes
    # how poorly initial values fit says nothing of how sure the data will be of what fits
    covariance, _ = uncertainty(problem, replace(at_x, residual=np.zeros_like(at_x.residual)))
    std = estimates(problem, x, at_x, covariance, None)
    return found.result({name: std[name].std for name in found.moves})


def _groups(recording: Recording) -> dict[str, dict[str, Any]]:
    result: dict[str, dict[str, Any]] = {}
    for group in recording.groups:
        name = getattr(group, "name", "joints")
        steps = np.diff(group.t)
        rate = 1.0 / float(np.median(steps)) if len(steps) else 0.0
        longest = float(np.max(steps)) if len(steps) else 0.0
        result[name] = {"samples": len(group.t), "rate": rate, "longest_gap": longest, "names": list(group.names)}
    return result

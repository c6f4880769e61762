"""The command `simulate`: simulate robot and sensors and write a recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.config.settings import RunSettings
from yid_ocp.data.recording import Recording
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.display import NULL_PROGRESS, Progress
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.predictions import recording_from_prediction
from yid_ocp.report.animation import AnimationData, animation_of_trajectories, measured_motion_animation
from yid_ocp.workflow.build import build_step, build_system
from yid_ocp.workflow.build_problem import make_problem_options
from yid_ocp.workflow.command_runner import CommandOutcome, make_command_function
from yid_ocp.workflow.prediction_outputs import predicted_configuration_trajectory
from yid_ocp.workflow.run_folder import atomic_run_folder
from yid_ocp.workflow.run_inputs import read_recordings_of_role

_Made = tuple[Recording | str, list[AnimationData]]
_DEFAULT_DURATION = 5.0  # default duration of a virtual experiment [s]


def run_simulate(
    run: RunSettings,
    out: str | Path | None = None,
    progress: Progress = NULL_PROGRESS,
    seed: int = 0,
    noise: bool = False,
) -> CommandOutcome[Recording | None]:
    """Simulate the model of a run, or a virtual experiment, and write `recording.h5`.

    With a recording under `recordings.estimate`, its torques or prescribed motion drive the model at the initial
    parameter values, and every sensor is predicted at its sample times. Without a recording, MuJoCo simulates a random
    motion of the driven arms, as a virtual experiment, which always has noise. If the rollout fails, no recording is
    written. `noise` adds noise with the recorded standard deviations. `seed` determines the motion and the noise.
    """
    with atomic_run_folder(run, out, "simulate") as folder:
        flags = [*(["--seed", str(seed)] if seed else []), *(["--noise"] if noise else [])]
        folder.record_run_start(run, "simulate", flags)
        system = build_system(run)
        if run.recordings.estimate:
            made, scenes = _predicted(run, system, progress, seed if noise else None)
        else:
            made, scenes = _virtual(run, system, progress, seed)
        result: dict[str, Any] = {"format": "yid-simulate/1", "status": "failed", "message": made, "seed": seed}
        recording = None if isinstance(made, str) else made
        if recording is not None:
            write_recording(recording, folder.path / "recording.h5")
            groups = {g.name: {"samples": len(g.t)} for g in recording.all_groups}
            is_short = (run.problem.duration or 0.0) > 1.01 * recording.duration
            is_noisy = noise or not run.recordings.estimate
            said = f"It has noise (seed {seed})." if is_noisy else "It has no noise. To add noise, write --noise."
            acting = [effect.label for effect in system.effects]
            said += f" Effects of the model that made it: {', '.join(acting)}." if acting else ""
            said += " The recorded motion is shorter than problem.duration." * is_short
            result |= {"status": "done", "message": said, "duration": recording.duration}
            result["file"] = str(folder.final_path / "recording.h5")
            result |= {"groups": groups, "truth": dict(recording.true_parameters)}
        more = {"recordings": [] if recording is None else [recording], "system": system}
        written = folder.write_result_and_report(run, progress, result, animations=scenes, section_data=more)
    return CommandOutcome(folder.path, written, recording, recording is not None)


run_and_return_exit_code = make_command_function(run_simulate, "seed", "noise")


def _virtual(run: RunSettings, system: System, progress: Progress, seed: int) -> _Made:
    from yid_ocp.virtual.experiment import VirtualExperimentSettings, run_virtual_experiment
    from yid_ocp.virtual.mujoco_simulation import SimulationOptions

    if not system.driven:
        allowed = "a recording with initial state, motion of prescribed joints or clamps, and sample times"
        hint = "list a recording, or set model.robot and model.arms.mode: driven for a virtual experiment"
        what = "no recording drives the model, and it has no driven joints"
        raise run.config_error(what, "recordings", "estimate", allowed=allowed, hint=hint)
    progress.begin_stage("simulating a virtual experiment in MuJoCo")
    simulation = SimulationOptions(run.problem.duration or _DEFAULT_DURATION)
    experiment = VirtualExperimentSettings(simulation=simulation, seed=seed, recording_name=run.name)
    made = run_virtual_experiment(system, None, replace(experiment, description=run.description))
    return made, measured_motion_animation("recorded", system, system.parameters.vector(), made)


def _predicted(run: RunSettings, system: System, progress: Progress, seed: int | None) -> _Made:
    progress.begin_stage("building the model and its compiled step")
    step, recordings = build_step(run, system), read_recordings_of_role(run, count=1)
    options = replace(make_problem_options(run, step.system, recordings), local_parameters=(), prior_stds={})
    problem = EstimationProblem(step, recordings, (), options)
    episode, theta = problem.episodes[0], problem.theta
    progress.begin_stage(f"simulating '{episode.name}' in {episode.grid.steps} steps")
    outcome = problem.predictor.predict_episode(episode, theta, np.zeros(len(problem.initial_unknowns)), False)
    if isinstance(outcome, str):
        return outcome, []
    made = recording_from_prediction(problem.predictor, episode, outcome, theta, seed, run.description)
    told = predicted_configuration_trajectory("simulated", problem, episode, outcome, theta)
    return made, [animation_of_trajectories("simulated", [told], episode.recording)]

"""The command `simulate`: simulates robot and sensors and writes a recording."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import RunSettings
from yid_ocp.data.recording import Recording
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.synthetic_recording import recording_from_prediction
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.report.animation import Animation, ModelTrajectory, make_animation, recording_animation
from yid_ocp.report.summaries import simulate_summary
from yid_ocp.workflow.build import build_step, build_system
from yid_ocp.workflow.build_problem import problem_options
from yid_ocp.workflow.command_runner import CommandResult, run_and_print
from yid_ocp.workflow.run_folder import new_run_folder
from yid_ocp.workflow.run_inputs import read_recordings

_RESULT_FORMAT = "yid-simulate/1"
_DEFAULT_DURATION = 5.0  # of a virtual experiment whose configuration does not say [s]
Array = NDArray[np.float64]


@dataclass(frozen=True)
class SimulateCommandResult(CommandResult):
    """Result of `run_simulate` with the recording, None where the rollout failed."""

    recording: Recording | None


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    settings = load_config(arguments.config, arguments.overrides)

    def simulated(shown: Progress) -> SimulateCommandResult:
        return run_simulate(settings, arguments.out, shown, arguments.seed, arguments.noise)

    return run_and_print(arguments, simulated, simulate_summary)


def run_simulate(
    run: RunSettings,
    out: str | Path | None = None,
    progress: Progress = NULL_PROGRESS,
    seed: int = 0,
    noise: bool = False,
) -> SimulateCommandResult:
    """Write `recording.h5`: the model moved by the inputs of the first recording, or a virtual experiment without one.

    With a recording under `recordings.estimate`, its torques or prescribed motion drive the model with the parameters'
    initial values, and every sensor is predicted at the times at which it measured. Without one, MuJoCo simulates a
    random motion of the driven arms.

    Parameters
    ----------
    seed : int
        Of the motion and the noise.
    noise : bool
        Whether noise of the recorded standard deviations is added to what the model predicts (a virtual experiment
        always has noise).

    Raises
    ------
    ConfigError, DataError, ModelError, OutputError
    """
    with new_run_folder(run, out, "simulate") as folder:
        folder.begin_run(run, "simulate", _flags(seed, noise))
        system = build_system(run)
        scenes: list[Animation] = []
        made: Recording | str
        if run.recordings.estimate:
            made, scenes = _predicted(run, system, progress, seed if noise else None)
        else:
            made, scenes = _virtual(run, system, progress, seed)
        result: dict[str, Any] = {"format": _RESULT_FORMAT, "status": "done", "message": "", "seed": seed}
        if isinstance(made, str):
            result |= {"status": "failed", "message": made}
            recording = None
        else:
            recording = made
            write_recording(recording, folder.path / "recording.h5")
            result |= {
                "duration": recording.duration,
                "groups": {getattr(g, "name", "joints"): {"samples": len(g.t)} for g in recording.groups},
                "truth": dict(recording.true_parameters),
            }
        written = folder.write_result(result)
        more = {"recordings": [] if recording is None else [recording], "system": system}
        folder.write_report_page(run, written, progress, animations=scenes, section_data=more)
    return SimulateCommandResult(folder.path, written, recording, is_successful=recording is not None)


def _flags(seed: int, noise: bool) -> list[str]:
    return [*(["--seed", str(seed)] if seed else []), *(["--noise"] if noise else [])]


def _virtual(run: RunSettings, system: System, progress: Progress, seed: int) -> tuple[Recording, list[Animation]]:
    from yid_ocp.virtual.experiment import VirtualExperiment, run_virtual_experiment
    from yid_ocp.virtual.mujoco_simulation import SimulationOptions

    if run.model.robot is None:
        allowed = "a recording whose start, clamps and times are taken over"
        hint = "list one, or set model.robot for a virtual experiment"
        raise run.config_error(
            "nothing moves an object without a robot by itself", "recordings", "estimate", allowed=allowed, hint=hint
        )
    progress.begin_stage("simulating a virtual experiment in MuJoCo")
    duration = run.problem.duration or _DEFAULT_DURATION
    experiment = VirtualExperiment(
        simulation=SimulationOptions(duration), seed=seed, recording_name=run.name, description=run.description
    )
    made = run_virtual_experiment(system, None, experiment)
    alone = recording_animation("recorded", system, system.parameters.vector(), made)
    return made, [] if alone is None else [alone]


def _predicted(
    run: RunSettings, system: System, progress: Progress, seed: int | None
) -> tuple[Recording | str, list[Animation]]:
    progress.begin_stage("building the model and its compiled step")
    step = build_step(run, system)
    first = replace(run, recordings=replace(run.recordings, estimate=run.recordings.estimate[:1]))
    recordings = read_recordings(first, "estimate")
    options = replace(problem_options(run, step.system, recordings), local_parameters=(), prior_stds={})
    problem = EstimationProblem(step, recordings, (), options)
    episode = problem.episodes[0]
    progress.begin_stage(f"rolling out {episode.grid.steps} steps")
    outcome = problem.predictor.predict_episode(episode, problem.theta, np.zeros(len(problem.initial_unknowns)), False)
    if isinstance(outcome, str):
        return outcome, []
    made = recording_from_prediction(problem.predictor, episode, outcome, problem.theta, seed, run.description)
    theta, q = (
        problem.predictor.episode_theta(episode, problem.theta),
        outcome.rollout.state[:, : step.system.n_coordinates],
    )
    told = ModelTrajectory("simulated", step.system, theta, episode.grid.node_times, q)
    return made, [make_animation("simulated", [told], episode.recording)]

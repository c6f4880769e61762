"""The command `simulate`: what the model says a robot and its sensors would record, written as a recording."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import Run
from yid_ocp.data.hdf5 import write_recording
from yid_ocp.data.recording import JointGroup, PointGroup, Recording, validate
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.options import SensorOptions
from yid_ocp.problem.prediction import EpisodeResult
from yid_ocp.report.terminal import simulate_summary
from yid_ocp.sensors.joints import EFFORT, POSITION, angle_std, by_joint, torque_bias_std, torque_std
from yid_ocp.workflow.build import build_step, build_system, problem_options, read_recordings
from yid_ocp.workflow.command import DONE, FAILED, carry_out
from yid_ocp.workflow.folder import new_run_folder
from yid_ocp.workflow.held import clamped_points
from yid_ocp.workflow.progress import SILENT, Progress

FORMAT = "yid-simulate/1"
DURATION = 5.0  # of a virtual experiment whose configuration does not say [s]
Array = NDArray[np.float64]


@dataclass(frozen=True)
class SimulateOutcome:
    """What `run_simulate` leaves.

    Attributes
    ----------
    folder : Path
    result : dict
        Contents of result.json.
    recording : Recording or None
        None where the rollout failed.
    """

    folder: Path
    result: dict[str, Any]
    recording: Recording | None

    @property
    def ok(self) -> bool:
        """Whether a recording was made."""
        return self.recording is not None


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    settings = load_config(arguments.config, arguments.overrides)

    def simulated(shown: Progress) -> SimulateOutcome:
        return run_simulate(settings, arguments.out, shown, arguments.seed, arguments.noise)

    outcome = carry_out(simulated, simulate_summary, arguments.quiet)
    return DONE if outcome.ok else FAILED


def run_simulate(
    run: Run, out: str | Path | None = None, progress: Progress = SILENT, seed: int = 0, noise: bool = False
) -> SimulateOutcome:
    """Write `recording.h5`: the model moved by the inputs of the first recording, or a virtual experiment without one.

    With a recording under `recordings.estimate`, its torques or prescribed motion drive the model with the parameters'
    initial values, and every sensor is predicted at the times at which it measured. Without one, MuJoCo simulates a
    random motion of the driven arms.

    Parameters
    ----------
    run : Run
    out : str or Path, optional
    progress : Progress, optional
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
        folder.begin(run, "simulate")
        if run.recordings.estimate:
            made = _predicted(run, progress, seed if noise else None)
        else:
            made = _virtual(run, progress, seed)
        result: dict[str, Any] = {"format": FORMAT, "status": "done", "message": "", "seed": seed}
        if isinstance(made, str):
            result |= {"status": "failed", "message": made}
            recording = None
        else:
            recording = made
            write_recording(recording, folder.path / "recording.h5")
            result |= {
                "duration": recording.duration,
                "groups": {getattr(g, "name", "joints"): {"samples": len(g.t)} for g in recording.groups},
                "truth": dict(recording.truth),
            }
        written = folder.finish(result)
    return SimulateOutcome(folder.path, written, recording)


def _virtual(run: Run, progress: Progress, seed: int) -> Recording:
    from yid_ocp.virtual.engine import Simulation
    from yid_ocp.virtual.experiment import VirtualExperiment, virtual_experiment

    system = build_system(run)
    if run.model.robot is None:
        raise run.refuse(
            "nothing moves an object without a robot by itself",
            "recordings",
            "estimate",
            allowed="a recording whose start, clamps and times are taken over",
            hint="list one, or set model.robot for a virtual experiment",
        )
    progress.stage("simulating a virtual experiment in MuJoCo")
    duration = run.problem.duration or DURATION
    experiment = VirtualExperiment(
        simulation=Simulation(duration), seed=seed, name=run.name, description=run.description
    )
    return virtual_experiment(system, None, experiment)


def _predicted(run: Run, progress: Progress, seed: int | None) -> Recording | str:
    progress.stage("building the model and its compiled step")
    step = build_step(run)
    first = replace(run, recordings=replace(run.recordings, estimate=run.recordings.estimate[:1]))
    recordings = read_recordings(first, "estimate")
    options = replace(problem_options(run, step.system, recordings), local=(), priors={})
    problem = EstimationProblem(step, recordings, (), options)
    episode = problem.episodes[0]
    progress.stage(f"rolling out {episode.grid.steps} steps")
    outcome = problem.predictor.run(episode, problem.theta, np.zeros(len(problem.start)), False)
    if isinstance(outcome, str):
        return outcome
    return validate(as_recording(run, problem, episode, outcome, seed))


def as_recording(
    run: Run, problem: EstimationProblem, episode: Episode, outcome: EpisodeResult, seed: int | None = None
) -> Recording:
    """The rollout of an episode as a recording with its sensors' clocks and noise levels.

    Parameters
    ----------
    run : Run
    problem : EstimationProblem
    episode : Episode
    outcome : EpisodeResult
    seed : int, optional
        Of noise as the estimation takes it: by recorded or configured standard deviations, of driven joints also those
        of torques that nobody states and of their constant offsets; none when absent.
    """
    rng = None if seed is None else np.random.default_rng(seed)
    system, source = problem.system, episode.recording
    groups = []
    for samples, predicted in zip(episode.samples, outcome.predicted, strict=True):
        if samples.sensor.points:
            t = episode.grid.start + problem.step.time_step * (samples.node + samples.fraction)
            shape = (len(t), len(samples.sensor.points), 3)
            std = np.where(np.isfinite(samples.std), samples.std, np.nanmedian(samples.std)).reshape(shape)
            position = np.where(samples.weight > 0, predicted, np.nan).reshape(shape)
            original = next(group for group in source.points if group.name == samples.sensor.group)
            groups.append(
                PointGroup(
                    original.name, samples.sensor.points, t, _noisy(position, std, rng), std,
                    original.sensor, original.frame, original.pose,
                )
            )  # fmt: skip
    groups = [_with_clamps(group, problem, source) for group in groups]
    theta = problem.predictor.own_theta(episode, problem.theta)
    truth = dict(zip(system.parameters.names, map(float, theta), strict=True))
    text = f"{run.description} Simulated with the inputs of {episode.name}.".strip()
    joints = _joints(problem, episode, outcome, rng)
    made = Recording(joints, tuple(groups), text, "yid_ocp simulate", "recording", truth=truth)
    return replace(made, straight=_straight(made, source))


def _with_clamps(group: PointGroup, problem: EstimationProblem, source: Recording) -> PointGroup:
    """A group with the points that clamps follow, as they were recorded: what moves the object, not what it does."""
    original = next(entry for entry in source.points if entry.name == group.name)
    followed = clamped_points(problem.options.clamps)
    names = tuple(name for name in followed if name in original.names and name not in group.names)
    if not names:
        return group
    at = [original.names.index(name) for name in names]
    near = np.searchsorted(original.t, group.t - 1e-9).clip(0, len(original.t) - 1)
    position = np.concatenate([group.position, original.position[near][:, at]], axis=1)
    assert group.std is not None
    std = np.concatenate([group.std, np.full((len(group.t), len(at), 3), np.median(group.std))], axis=1)
    return replace(group, names=(*group.names, *names), position=position, std=std)


def _straight(made: Recording, source: Recording) -> Array | None:
    """Where the points of the first group were while the object was held straight, where the source says it."""
    if source.straight is None or not made.points or made.points[0].name != source.points[0].name:
        return None
    return source.straight[[source.points[0].names.index(name) for name in made.points[0].names]]


def _joints(
    problem: EstimationProblem, episode: Episode, outcome: EpisodeResult, rng: np.random.Generator | None
) -> JointGroup | None:
    system, source = problem.system, episode.recording.joints
    if source is None or not (system.driven or system.prescribed):
        return None
    names = tuple(name for name in (*system.driven, *system.prescribed) if name in source.names)
    at = [system.mechanism.joint_index(name) for name in names]
    position = outcome.rollout.state[:, at]
    if system.servos:
        return _commanded(problem, episode, position, names, rng)
    held = {name: outcome.rollout.torque[:, i] for i, name in enumerate(system.driven)}
    held |= {name: outcome.rollout.effort[:, i] for i, name in enumerate(system.prescribed)}
    effort = np.stack([np.append(held[name], held[name][-1]) for name in names], axis=1)
    levels = _levels(problem, episode, names)
    position, effort = (
        _noisy(values, np.broadcast_to(0.0 if std is None else std, values.shape), rng)
        for values, std in ((position, levels.angle), (effort, levels.torque))
    )
    # constant over the recording, for every joint one draw
    bias = np.zeros(len(names)) if levels.bias is None else np.asarray(levels.bias)
    return JointGroup(
        names,
        episode.grid.times,
        position,
        effort=effort + _noisy(np.zeros(len(names)), bias, rng),
        position_std=levels.angle,
        effort_std=levels.torque,
        effort_bias_std=levels.bias,
        # of prescribed joints it is the effort at the nodes
        effort_kind="command" if system.driven else "sample",
    )


def _commanded(
    problem: EstimationProblem,
    episode: Episode,
    position: Array,
    names: tuple[str, ...],
    rng: np.random.Generator | None,
) -> JointGroup:
    """Joints of servos at every node, with what they were commanded there."""
    source, times = episode.recording.joints, episode.grid.times
    assert source is not None
    assert source.position_command is not None
    commands = source.position_command[:, [source.names.index(name) for name in names]]
    rows = np.clip(np.searchsorted(source.t, times + 1e-9) - 1, 0, len(source.t) - 1)
    between = np.stack([np.interp(times, source.t, column) for column in commands.T], axis=1)
    held = [problem.system.servos[name].commands == "held" for name in names]
    std = angle_std(source, names, problem.options.sensors.get(POSITION, SensorOptions()), episode.name)
    noisy = _noisy(position, np.broadcast_to(std, position.shape), rng)
    given = np.where(held, commands[rows], between)
    return JointGroup(names, times, noisy, position_command=given, position_std=std)


@dataclass(frozen=True)
class _Levels:
    """Standard deviations of what joints record, (nj,) each [rad], [N m]; None where nothing says so."""

    angle: Array | None
    torque: Array | None
    bias: Array | None


def _levels(problem: EstimationProblem, episode: Episode, names: tuple[str, ...]) -> _Levels:
    """Noise as the estimation takes it: of driven joints that of what drives the motion, else what is stated."""
    joints, driven = episode.recording.joints, problem.system.driven
    assert joints is not None
    effort, position = (problem.options.sensors.get(group, SensorOptions()) for group in (EFFORT, POSITION))
    joint_angles = joints.position_std if position.std is None else position.std
    torques = joints.effort_std if effort.std is None else effort.std
    if episode.errors is None:
        angle, torque = (
            None if given is None else by_joint(given, joints.names, names, f"sensors.{group}.std")
            for group, given in ((POSITION, joint_angles), (EFFORT, torques))
        )
        return _Levels(angle, torque, None)
    at, rest = [names.index(name) for name in driven], [i for i, name in enumerate(names) if name not in driven]
    other = tuple(names[i] for i in rest)
    angle, torque, bias = np.zeros((3, len(names)))
    angle[at] = angle_std(joints, driven, position, episode.name)
    torque[at] = torque_std(joints, driven, effort, episode.name)
    bias[at] = torque_bias_std(joints, driven, effort)
    if other:
        stated = ((angle, joint_angles, POSITION), (torque, torques, EFFORT))
        for target, std, group in stated:
            target[rest] = by_joint(0.0 if std is None else std, joints.names, other, f"sensors.{group}.std")
    return _Levels(angle, torque, bias)


def _noisy(values: Array, std: Array, rng: np.random.Generator | None) -> Array:
    return values if rng is None else values + np.where(np.isfinite(std), std, 0.0) * rng.standard_normal(values.shape)

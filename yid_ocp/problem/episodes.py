"""From recordings to episodes: everything about one recording placed on the nodes of a rollout."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from yid_ocp.data.recording import Recording
from yid_ocp.errors import ConfigError, DataError, nearest
from yid_ocp.integrator.step import Step
from yid_ocp.problem.grid import Grid, make_grid
from yid_ocp.problem.inputs import camera_pose, columns, held_torque, joint_loads, prescribed_path
from yid_ocp.problem.low_pass import LowPass
from yid_ocp.problem.measurements import Measurements, make_samples, paper_weighting, point_samples
from yid_ocp.problem.options import ProblemOptions, SensorOptions
from yid_ocp.sensors import EffortSensor, PointSensor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Episode:
    """One recording placed on the nodes of a rollout.

    Attributes
    ----------
    recording : Recording
    grid : Grid
    torque : ndarray, shape (N, nu)
    path : ndarray, shape (N + 1, nc)
    posture : ndarray, shape (nk,)
        Known coordinates (driven, then prescribed) at node 0.
    measured_arm : ndarray, shape (N + 1, nu)
        Measured angles of the driven joints at every node.
    samples : tuple of Measurements
    load : ndarray, shape (N + 1, nk)
        Recorded effort of driven, then prescribed joints, where an effect makes their true angle depend on it.
    """

    recording: Recording
    grid: Grid
    torque: Array
    path: Array
    posture: Array
    measured_arm: Array
    samples: tuple[Measurements, ...]
    load: Array

    @property
    def name(self) -> str:
        """Name of the recording."""
        return self.recording.name


def prepare_episode(
    step: Step, recording: Recording, options: ProblemOptions, theta: Array, with_loads: bool
) -> Episode:
    """Place a recording on the nodes: torques, paths, posture, samples.

    Parameters
    ----------
    step : Step
    recording : Recording
    options : ProblemOptions
    theta : ndarray, shape (ntheta,)
        Parameters at which encoder noise is turned into effort.
    with_loads : bool
        Whether an effect needs the smoothed effort at the joints.

    Raises
    ------
    DataError
        The recording does not fit the model, is too short, or states no noise level.
    """
    system = step.system
    grid = make_grid(recording, step.time_step, options.duration)
    if system.driven and recording.joints is None:
        raise DataError("the model's arms are driven but the recording has no joints", where=recording.name)
    smoother = LowPass(options.path_cutoff)
    path = prescribed_path(recording, system, grid, smoother, options.clamps)
    if recording.joints is not None and system.driven:
        joints = recording.joints
        torque = held_torque(joints, system.driven, grid, recording.name)
        angles = joints.position[:, columns(joints, system.driven, recording.name)]
        arm = np.stack([np.interp(grid.times, joints.t, column) for column in angles.T], axis=1)
    else:
        torque, arm = np.zeros((grid.steps, 0)), np.zeros((grid.steps + 1, 0))
    posture = np.concatenate([arm[0], path[0]])
    samples = tuple(_samples(step, recording, options, theta, grid, smoother))
    if not any(np.any(s.weight > 0) for s in samples):
        raise DataError(
            "the recording holds no measurement that the model could be compared with",
            where=recording.name,
            hint="check `sensors` and the names of the recorded points",
        )
    if options.weighting == "paper":
        samples = tuple(paper_weighting(s, grid) for s in samples)
    known = (*system.driven, *system.prescribed)
    load = np.zeros((grid.steps + 1, len(known)))
    if with_loads:
        load = joint_loads(recording, known, grid, smoother)
    return Episode(recording, grid, torque, path, posture, arm, samples, load)


def beginning(episode: Episode, steps: int) -> Episode:
    """The first steps of an episode, with what was measured in them."""
    steps = min(steps, episode.grid.steps)
    samples = []
    for entry in episode.samples:
        last = min(entry.span[1], steps - (episode.grid.steps - entry.span[1]))
        early = entry.node + entry.fraction <= last + 1e-9
        parts = {name: getattr(entry, name)[early] for name in ("node", "fraction", "value", "weight", "std")}
        samples.append(replace(entry, **parts, span=(entry.span[0], last)))
    return replace(
        episode,
        grid=replace(episode.grid, steps=steps),
        torque=episode.torque[:steps],
        path=episode.path[: steps + 1],
        measured_arm=episode.measured_arm[: steps + 1],
        samples=tuple(samples),
        load=episode.load[: steps + 1],
    )


def _samples(
    step: Step, recording: Recording, options: ProblemOptions, theta: Array, grid: Grid, smoother: LowPass
) -> list[Measurements]:
    system = step.system
    found: list[Measurements] = []
    for group in recording.points:
        choice = options.sensors.get(group.name, SensorOptions())
        if not choice.use:
            continue
        wanted = choice.points if choice.points is not None else group.names
        frames = {p: choice.frames.get(p, p) for p in wanted}
        known = tuple(p for p in wanted if frames[p] in system.mechanism.frames)
        if not known:
            raise DataError(
                f"none of the points of group '{group.name}' is a frame of the model",
                where=recording.name,
                allowed=", ".join(system.points),
                hint=f"name them under sensors.{group.name}.frames, or switch the group off",
            )
        sensor = PointSensor(group.name, known, tuple(frames[p] for p in known), camera_pose(group))
        std = choice.std
        if isinstance(std, Mapping):
            raise ConfigError("a group of points takes one std", where=f"sensors.{group.name}.std")
        found.append(point_samples(recording, group, sensor, known, grid, std))
    choice = options.sensors.get("joints.effort", SensorOptions())
    joints = recording.joints
    if joints is not None and joints.effort is not None and choice.use:
        names = tuple(name for name in system.prescribed if name in joints.names)
        if names:
            found.append(_effort_samples(step, recording, theta, grid, smoother, names, choice))
    return found


def _effort_samples(
    step: Step,
    recording: Recording,
    theta: Array,
    grid: Grid,
    smoother: LowPass,
    names: tuple[str, ...],
    choice: SensorOptions,
) -> Measurements:
    joints = recording.joints
    assert joints is not None
    assert joints.effort is not None
    at = columns(joints, names, recording.name)
    effort = smoother(joints.t, joints.effort[:, at])
    measured = np.stack([np.interp(grid.times, joints.t, column) for column in effort.T], axis=1)
    given = choice.std if choice.std is not None else joints.effort_std
    if given is None:
        raise DataError(
            "the noise level of the joint efforts is neither recorded nor given",
            where=recording.name,
            hint="set sensors.joints.effort.std [N m], from a stretch at rest or the data sheet",
        )
    std = _by_joint(given, joints.names, names, "sensors.joints.effort.std")
    period = float(np.median(np.diff(joints.t)))
    value_gain, _, second_gain = smoother.gains(period)
    known = choice.position_std if choice.position_std is not None else joints.position_std
    angle = _by_joint(0.0 if known is None else known, joints.names, names, "sensors.joints.effort.position_std")
    inertia = apparent_inertia(step, theta, names)
    total = np.sqrt((std * value_gain) ** 2 + (inertia * angle * second_gain) ** 2)
    # Smoothed values repeat their neighbours: only as many are kept as count as independent. Both ends are left out:
    # the filter sees one side alone there, the impulse at node 0 depends on the motion before the recording and that at
    # the last node on the motion after it.
    ends = max(1, math.ceil(smoother.settling / grid.time_step))
    kept = np.arange(ends, grid.steps + 1 - ends, smoother.stride(grid.time_step))
    if not len(kept):
        raise DataError(
            f"{grid.steps * grid.time_step:.3g} s of efforts are too short for a filter of {smoother.cutoff:g} Hz",
            where=recording.name,
            allowed=f"more than {2 * ends * grid.time_step:.3g} s",
            hint="use a longer recording, or raise problem.path_cutoff",
        )
    return make_samples(
        EffortSensor(names),
        grid.times[kept],
        measured[kept],
        np.broadcast_to(total, measured.shape)[kept],
        grid,
        f"{recording.name}: joints.effort",
        (1, grid.steps - 1),
    )


def apparent_inertia(step: Step, theta: Array, names: tuple[str, ...]) -> Array:
    """Diagonal of the mass matrix at zero for the named joints [kg m^2 or kg]."""
    sizes = step.sizes
    n, zero = sizes["n"], np.zeros
    state = [zero(n), zero(n), zero(n), zero(sizes["nz"]), zero(sizes["nz"]), zero(sizes["m"]), zero(sizes["nu"])]
    pairs = np.array(step.functions.linear(*state, theta, step.time_step)[0]).ravel()
    plus, _, lower, upper = (pairs[6 * n * i : 6 * n * (i + 1)].reshape(6, n) for i in range(4))
    mass = np.sum(plus * (upper - lower), axis=0) * step.time_step / 2
    return np.asarray(mass[[step.system.mechanism.joint_index(name) for name in names]])


def _by_joint(
    given: float | Array | Mapping[str, float], recorded: Sequence[str], names: Sequence[str], key: str
) -> Array:
    """One number for each of `names` from one for all, one for each recorded joint, or a mapping."""
    if isinstance(given, Mapping):
        for name in names:
            if name not in given:
                raise ConfigError(f"joint '{name}' has no value", where=key, hint=nearest(name, given))
        return np.array([float(given[name]) for name in names])
    wide = np.broadcast_to(np.asarray(given, float), (len(recorded),))
    return wide[[list(recorded).index(name) for name in names]]

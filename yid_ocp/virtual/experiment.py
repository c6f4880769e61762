"""Virtual experiments: a robot moves a flexible object in MuJoCo, recorded with known sensor noise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.data.recording import JointGroup, PointGroup, Recording, validate
from yid_ocp.errors import ConfigError
from yid_ocp.model.system import Grasp, System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.model.y_object import y_object
from yid_ocp.virtual.engine import EngineTerms, SimulatedRun, Simulation, simulate_in_mujoco
from yid_ocp.virtual.mjcf import mujoco_module
from yid_ocp.virtual.motion import Excitation, Motion, multisine
from yid_ocp.virtual.posture import BAXTER_JOINTS, initial_posture

Array = NDArray[np.float64]
Generators = Mapping[str, np.random.Generator]

# every sensor draws from a stream of its own, so that leaving one out changes no other; the order is part of the seed
_STREAMS = ("position", "velocity", "effort", "arm_points", "frames", "camera_points", "effort_bias")
_TRUE_QUANTITIES = ("bend", "twist", "damping", "twist_damping", "mass")


def paper_system(arms: int) -> System:
    """The paper's system: Baxter with one or two arms that hold the foam Y by point grasps.

    Parameters
    ----------
    arms : int
        1: the left arm holds the tip of T2 (43 coordinates); 2: the right one holds that of T3 as well (50).

    Returns
    -------
    System
        Every arm joint driven; viscous damping 0.05 N m s/rad on every coordinate.

    Raises
    ------
    ConfigError
        Another number of arms.
    """
    if arms not in (1, 2):
        raise ConfigError(f"arms = {arms}", where="paper_system", allowed="1 or 2")
    sides = ("left", "right")[:arms]
    names = [f"{side}_{joint}" for side in sides for joint in BAXTER_JOINTS]
    robot = read_urdf("package:baxter", joints=names)
    grasps = [Grasp(side, f"{side}_gripper", held) for side, held in zip(sides, ("w_T2", "w_T3"), strict=False)]
    return System.build(robot, objects=[(y_object(), None, None)], grasps=grasps, driven=names, damping=0.05)


@dataclass(frozen=True)
class ArmNoise:
    """Standard deviations of the noise on what the arm measures, drawn anew for every sample but for the bias.

    Attributes
    ----------
    position, velocity : float
        Standard deviation of a joint's reading [rad], [rad/s].
    effort, effort_bias : float or tuple of float, length nj
        Standard deviation of the white noise, and of the constant offset, of a recorded (not the applied) torque [N m].
    points : float
        Standard deviation of each coordinate of a grasped point [m].
    stated : bool
        Whether the recording states the standard deviation of torques; it always states the others.
    """

    position: float = 2e-4
    velocity: float = 5e-3
    effort: float | tuple[float, ...] = 0.0
    effort_bias: float | tuple[float, ...] = 0.0
    points: float = 1e-3
    stated: bool = True


@dataclass(frozen=True)
class PointCamera:
    """A slow camera that measures positions of the object's points.

    Attributes
    ----------
    points : tuple of str, optional
        Points it can see; all points that no arm holds where absent.
    std : float
        Standard deviation of the white noise on each coordinate of a point [m].
    rate : float
        Mean rate of frames [Hz]; periods vary by a quarter either way.
    gaps : bool
        Whether frames are lost for 1 to 1.5 s about once every 2.5 s of recording.
    missing : float
        Probability that a point is hidden in a frame (NaN).
    pose : array_like, shape (4, 4), optional
        Camera (x right, y down, z ahead) in the world; 2 m from the object, opposite the robot, where absent.
    """

    points: tuple[str, ...] | None = None
    std: float = 5e-3
    rate: float = 3.0
    gaps: bool = True
    missing: float = 0.1
    pose: ArrayLike | None = None


@dataclass(frozen=True)
class VirtualExperiment:
    """Settings of a virtual experiment: motion, simulation, sensors and noise.

    Attributes
    ----------
    motion : Motion, optional
        `multisine` with `seed` where absent.
    posture : mapping of str to float, optional
        Initial angles [rad or m]; `initial_posture` where absent.
    simulation : Simulation
        Duration, rate of joints and arm points, rate of the controller, step of the simulator.
    noise : ArmNoise
    camera : PointCamera, optional
        None for no camera.
    injected : EngineTerms, optional
        Forces and model changes that are not in the system's description.
    seed : int
        Seed of all noise; each sensor has its own stream, so that leaving one out changes no other.
    name, description : str
        Name and description of the recording; how it was made is appended to the description.
    play : mapping of joint to float
        Backlash of gears behind servos, full width [rad].
    """

    motion: Motion | None = None
    posture: Mapping[str, float] | None = None
    simulation: Simulation = field(default_factory=Simulation)
    noise: ArmNoise = field(default_factory=ArmNoise)
    camera: PointCamera | None = field(default_factory=PointCamera)
    injected: EngineTerms | None = None
    seed: int = 0
    name: str = "virtual"
    description: str = ""
    play: Mapping[str, float] = field(default_factory=dict)


def virtual_experiment(
    system: System, values: Mapping[str, float] | None = None, experiment: VirtualExperiment | None = None
) -> Recording:
    """Simulate a robot moving the object and return the recording of encoders, torques, points and camera.

    Parameters
    ----------
    system : System
    values : mapping of str to float, optional
        True parameter values; nominal where absent.
    experiment : VirtualExperiment, optional

    Returns
    -------
    Recording
        `joints`: index k is node k, `effort[k]` is what `effort_kind` says. `points_arm` at the same times, for the
        grasped points; `points_camera` with its own clock. `truth` holds all stiffness, damping and mass parameters.

    Raises
    ------
    ConfigError
        The camera is to see a point that the system does not have, or the torques' noise is that of other joints.
    ModelError, DataError
        As `simulate_in_mujoco`.
    """
    chosen = experiment or VirtualExperiment()
    seeds = np.random.SeedSequence(chosen.seed).spawn(len(_STREAMS))
    streams = {name: np.random.default_rng(seed) for name, seed in zip(_STREAMS, seeds, strict=True)}
    duration = chosen.simulation.duration
    posture = initial_posture(system, values) if chosen.posture is None else chosen.posture
    motion = chosen.motion
    if motion is None:
        excitation = Excitation(duration=duration)
        motion = multisine(system, values, seed=chosen.seed, posture=posture, excitation=excitation)
    held = tuple(dict.fromkeys(grasp.held for grasp in system.grasps if grasp.held in system.points))
    visible = () if chosen.camera is None else _visible(system, held, chosen.camera)
    times = np.empty(0)
    if chosen.camera is not None and visible:
        times = _frame_times(streams["frames"], duration, chosen.camera)
    run = simulate_in_mujoco(
        system,
        values,
        motion,
        chosen.simulation,
        posture=posture,
        frame_times=times,
        injected=chosen.injected,
        play=chosen.play,
    )
    groups = []
    if held:
        groups.append(_arm_points(system, held, run, chosen.noise, streams))
    if chosen.camera is not None and len(run.frame_t):
        groups.append(_camera_points(system, visible, run, chosen.camera, streams))
    theta = system.parameters.vector(values)
    names = system.parameters.names
    truth = {n: float(theta[i]) for i, n in enumerate(names) if n.rpartition(".")[2] in _TRUE_QUANTITIES}
    made = _how_it_was_made(chosen, system, seen=len(run.frame_t) > 0)
    joints = _joints(system, run, chosen, streams)
    text = f"{chosen.description} {made}".strip()
    source = "yid_ocp virtual experiment"
    return validate(Recording(joints, tuple(groups), text, source, chosen.name, truth=truth))


def _visible(system: System, held: tuple[str, ...], camera: PointCamera) -> tuple[str, ...]:
    if camera.points is None:
        return tuple(point for point in system.points if point not in held)
    for point in camera.points:
        if point not in system.points:
            raise ConfigError(f"the camera cannot see '{point}'", allowed=", ".join(system.points))
    return tuple(camera.points)


def _joints(system: System, run: SimulatedRun, experiment: VirtualExperiment, streams: Generators) -> JointGroup:
    driven, noise = list(system.driven_indices), experiment.noise
    white, bias = (
        _by_joint(std, len(driven), f"ArmNoise.{name}")
        for name, std in (("effort", noise.effort), ("effort_bias", noise.effort_bias))
    )
    offset = bias * streams["effort_bias"].standard_normal(len(driven))
    if system.servos:
        return JointGroup(
            names=tuple(system.driven),
            t=run.t,
            position=_noisy(run.q[:, driven], noise.position, streams["position"]),
            velocity=_noisy(run.v[:, driven], noise.velocity, streams["velocity"]),
            position_command=run.effort,
            position_std=noise.position,
            velocity_std=noise.velocity,
        )
    return JointGroup(
        names=tuple(system.driven),
        t=run.t,
        position=_noisy(run.q[:, driven], noise.position, streams["position"]),
        velocity=_noisy(run.v[:, driven], noise.velocity, streams["velocity"]),
        effort=_noisy(run.effort, white, streams["effort"]) + offset,
        position_std=noise.position,
        velocity_std=noise.velocity,
        effort_std=white if noise.stated else None,
        effort_bias_std=bias if noise.stated else None,
        effort_kind=experiment.simulation.effort_kind,
    )


def _by_joint(std: float | tuple[float, ...], joints: int, where: str) -> Array:
    if np.ndim(std) and np.size(std) != joints:
        raise ConfigError(f"{np.size(std)} standard deviations for {joints} joints", where=where, allowed="one or each")
    return np.asarray(std, dtype=float)


def _arm_points(
    system: System, held: tuple[str, ...], run: SimulatedRun, noise: ArmNoise, streams: Generators
) -> PointGroup:
    clean = run.points[:, [system.points.index(point) for point in held]]
    position = _noisy(clean, noise.points, streams["arm_points"])
    return PointGroup("points_arm", held, run.t, position, np.full(clean.shape, noise.points), sensor="arm")


def _camera_points(
    system: System, visible: tuple[str, ...], run: SimulatedRun, camera: PointCamera, streams: Generators
) -> PointGroup:
    rng = streams["camera_points"]
    clean = run.frame_points[:, [system.points.index(point) for point in visible]]
    position = _noisy(clean, camera.std, rng)
    position[rng.random(position.shape[:2]) < camera.missing] = np.nan
    pose = _camera_pose(run.points[0].mean(0)) if camera.pose is None else np.asarray(camera.pose, float)
    std = np.full(clean.shape, camera.std)
    return PointGroup("points_camera", visible, run.frame_t, position, std, "camera", pose=pose)


def _how_it_was_made(experiment: VirtualExperiment, system: System, seen: bool) -> str:
    simulation, noise, camera = experiment.simulation, experiment.noise, experiment.camera
    held, sampled = 1e3 / (simulation.rate * simulation.controller_periods), 1e3 / simulation.rate
    input_, efforts = f"commands of position servos held over each {held:g} ms, recorded every {sampled:g} ms", ""
    if not system.servos:
        input_ = f"torque held over each {held:g} ms and recorded as {simulation.effort_kind} every {sampled:g} ms"
        efforts = f"effort {_listed(noise.effort)} N m, "
    made = (
        f"Virtual experiment in MuJoCo {mujoco_module().__version__} (implicitfast, "
        f"{1e3 * simulation.time_step:g} ms inner step): multi-sine motion of {len(system.driven)} joints "
        f"from static equilibrium, {input_}, seed {experiment.seed}. White noise: "
        f"joint position {noise.position:g} rad, velocity {noise.velocity:g} rad/s, "
        f"{efforts}arm points {1e3 * noise.points:g} mm"
    )
    if not system.servos:
        made += f"; constant offset of the effort {_listed(noise.effort_bias)} N m"
    if camera is None or not seen:
        return made + "; no camera."
    return made + f", camera {1e3 * camera.std:g} mm at about {camera.rate:g} Hz."


def _listed(std: float | tuple[float, ...]) -> str:
    return ", ".join(f"{value:g}" for value in np.atleast_1d(std))


def _noisy(clean: Array, std: float | Array, rng: np.random.Generator) -> Array:
    return np.array(clean + std * rng.standard_normal(clean.shape))


def _frame_times(rng: np.random.Generator, duration: float, camera: PointCamera) -> Array:
    count = math.ceil(2 * duration * camera.rate) + 2
    times = np.cumsum(rng.uniform(0.75, 1.25, count) / camera.rate)
    times = times[times < duration]
    if camera.gaps:
        number = max(1, round(duration / 2.5))
        starts = duration / number * (np.arange(number) + rng.uniform(0.15, 0.45, number))
        lengths = rng.uniform(1.0, 1.5, number)
        lost = ((times[:, None] >= starts) & (times[:, None] <= starts + lengths)).any(1)
        times = times[~lost]
    return np.asarray(times)


def _camera_pose(target: Array) -> Array:
    away = np.array([0.93, 0.0, 0.37])
    away /= np.linalg.norm(away)
    right = np.cross(-away, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(-away, right), -away])
    pose[:3, 3] = target + 2.0 * away
    return pose

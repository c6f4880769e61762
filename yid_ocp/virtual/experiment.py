"""Virtual experiments, in which a robot moves a flexible object in MuJoCo with known noise and sensor errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from yid_ocp.arrays import Array
from yid_ocp.data.recording import JointGroup, PointGroup, Recording, validated_recording
from yid_ocp.effects.base import joint_names_by_arm
from yid_ocp.errors import ConfigError, ModelError
from yid_ocp.model.servos_and_springs import JOINT_SERVO_GAIN_FACTOR_PARAMETER_SUFFIX
from yid_ocp.model.system import System
from yid_ocp.options import OptionInfo
from yid_ocp.virtual import joint_motion
from yid_ocp.virtual.mjcf import CasadiEvaluator, import_mujoco
from yid_ocp.virtual.mujoco_simulation import (
    InjectedSimulatorTerms,
    SimulationOptions,
    SimulationResult,
    simulate_in_mujoco,
)
from yid_ocp.vision.frames import look_at_pose

_Generators = Mapping[str, np.random.Generator]

# each sensor has its own random stream, so removing one changes no other; the order is part of the seed
_RANDOM_STREAMS = ("position", "velocity", "effort", "arm_points", "frames", "camera_points", "effort_bias", "clock")
_CAMERA_DIRECTION = np.array([0.93, 0.0, 0.37])  # direction from the object to the camera
_TRUE_QUANTITIES = ("bend", "twist", "damping", "twist_damping", "mass")


@dataclass(frozen=True)
class ArmSensorNoise:
    """The standard deviations of the arm's sensor noise. Noise differs in each sample, effort bias in each recording.

    Noise of efforts is not in the applied torque. The recording states all stds, for efforts if `records_effort_std`.
    """

    position_std: float = 2e-4  # of joint angles [rad]
    velocity_std: float = 5e-3  # of joint velocities [rad/s]
    effort_std: float | tuple[float, ...] = 0.0  # one value, or one per joint [N m]
    effort_bias_std: float | tuple[float, ...] = 0.0  # one value, or one per joint [N m]
    point_std: float = 1e-3  # of each coordinate of a grasped point [m]
    records_effort_std: bool = True  # whether the recording also states `effort_std` and `effort_bias_std`
    position_resolution: float = 0.0  # step of the encoders, applied after the noise; zero: continuous [rad]
    lost_joint_sample_fraction: float = 0.0  # fraction of joint samples that are lost, never the first or last two


@dataclass(frozen=True, kw_only=True)
class VirtualArmImperfections:
    """The properties, such as friction, that arms have in virtual experiments of `blind` but not in their description.

    The nominal model of a diagnosis contains the friction law, with free amplitudes, and uncertain link masses.
    """

    friction_law: Annotated[
        Literal["none", "varied", "coulomb", "stribeck", "load", "load_stribeck"],
        OptionInfo("law of the joints' dry friction, which MuJoCo's solver simulates; varied: one law per experiment"),
    ] = "varied"
    max_relative_link_mass_error: Annotated[
        float, Ge(0), Le(0.2), OptionInfo("largest relative error of a link's mass; the smallest is three fifths of it")
    ] = 0.05
    encoder_counts_per_turn: Annotated[int, Ge(0), OptionInfo("encoder steps per turn; 0: continuous")] = 16384
    period_jitter_std: Annotated[
        float, Ge(0), Le(2e-3), OptionInfo("standard deviation of the controller's and recorder's tick times", "s")
    ] = 5e-4
    lost_joint_sample_fraction: Annotated[float, Ge(0), Le(0.2), OptionInfo("fraction of lost joint samples")] = 0.01


@dataclass(frozen=True)
class PointCamera:
    """A slow camera that measures positions of the object's points that no arm holds.

    By default the camera is 2 m from the object, opposite the robot.
    """

    point_std: float = 5e-3  # std of the white noise on each coordinate of a point [m]
    frame_rate: float = 3.0  # mean rate; periods vary by up to a quarter [Hz]
    has_dropouts: bool = True  # whether frames are lost for 1 to 1.5 s about once every 2.5 s of recording
    hidden_probability: float = 0.1  # probability that a point is hidden in a frame (position NaN)
    pose: ArrayLike | None = None  # pose of the camera in the world, (4, 4); axes x right, y down, z forward


@dataclass(frozen=True)
class VirtualExperimentSettings:
    """The settings of a virtual experiment: motion, simulation, sensors and noise.

    The noise of each sensor has its own random stream from `seed`, so removing a sensor changes no other noise.
    """

    motion: joint_motion.MultisineMotion | None = None  # default: `random_multisine_motion` with `seed`
    initial_joint_angles: Mapping[str, float] | None = None  # [rad or m]; default: `grasping_joint_angles`
    simulation: SimulationOptions = field(default_factory=SimulationOptions)
    arm_noise: ArmSensorNoise = field(default_factory=ArmSensorNoise)
    camera: PointCamera | None = field(default_factory=PointCamera)
    injected_terms: InjectedSimulatorTerms | None = None
    seed: int = 0
    recording_name: str = "virtual"
    description: str = ""  # how the recording was made is appended
    gear_play: Mapping[str, float] = field(default_factory=dict)  # full backlash of gears behind servos, by joint [rad]


def run_virtual_experiment(
    system: System, values: Mapping[str, float] | None = None, experiment: VirtualExperimentSettings | None = None
) -> Recording:
    """Simulate in MuJoCo a robot that moves the object, and return the recording of encoders, torques and points.

    The group `points_arm` holds the grasped points at the joints' sample times; `points_camera` has its own clock.
    `true_parameters` are all stiffness, damping and mass parameters of `values` (default: nominal). Raises
    `ConfigError` if torque noise does not match the joints; other errors are as in `simulate_in_mujoco`.
    """
    chosen = experiment or VirtualExperimentSettings()
    duration, posture = chosen.simulation.duration, chosen.initial_joint_angles
    posture = joint_motion.grasping_joint_angles(system, values) if posture is None else posture
    excitation = joint_motion.MultisineOptions(duration=duration)
    motion = chosen.motion or joint_motion.random_multisine_motion(
        system, values, seed=chosen.seed, initial_joint_angles=posture, excitation=excitation
    )
    times = np.empty(0)
    if chosen.camera is not None and _held_and_visible_points(system)[1]:
        times = _frame_times(_random_generators(chosen.seed)["frames"], duration, chosen.camera)
    options: dict[str, Any] = {"injected": chosen.injected_terms, "gear_play": chosen.gear_play, "frame_times": times}
    simulation = replace(chosen.simulation, jitter_seed=chosen.seed)
    run = simulate_in_mujoco(system, values, motion, simulation, initial_joint_angles=posture, **options)
    return recording_from_simulation(system, values, chosen, run)


def recording_from_simulation(
    system: System, values: Mapping[str, float] | None, experiment: VirtualExperimentSettings, run: SimulationResult
) -> Recording:
    """Make a recording of a finished simulation `run` with the experiment's sensors and noise."""
    chosen, streams = experiment, _random_generators(experiment.seed)
    held, visible = _held_and_visible_points(system)
    groups = []
    if held:
        clean = run.point_positions[:, [system.point_frames.index(point) for point in held]]
        position = _noisy(clean, chosen.arm_noise.point_std, streams["arm_points"])
        groups.append(PointGroup("points_arm", held, run.t, position, np.array(chosen.arm_noise.point_std), "arm"))
    if chosen.camera is not None and len(run.frame_times):
        groups.append(_camera_points(system, visible, run, chosen.camera, streams))
    theta = dict(zip(system.parameters.names, map(float, system.parameters.vector(values)), strict=True))
    truth = {name: value for name, value in theta.items() if name.rpartition(".")[2] in _TRUE_QUANTITIES}
    made, joints = _how_it_was_made(chosen, system), _joints(system, run, chosen, streams)
    gains = [f"{name}.{JOINT_SERVO_GAIN_FACTOR_PARAMETER_SUFFIX}" for name in system.driven]
    if {*gains} & {*theta}:  # the gain set in the firmware of servos
        joints = replace(joints, proportional_gain=np.array([theta.get(name, 1.0) for name in gains]))
    about = f"{chosen.description} {made}".strip(), "yid_ocp virtual experiment", chosen.recording_name
    return validated_recording(Recording(joints, tuple(groups), *about, true_parameters=truth))


def _random_generators(seed: int) -> _Generators:
    seeds = np.random.SeedSequence(seed).spawn(len(_RANDOM_STREAMS))
    return {name: np.random.default_rng(own) for name, own in zip(_RANDOM_STREAMS, seeds, strict=True)}


def _held_and_visible_points(system: System) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The system's points that grippers hold, and the other points, which a camera sees."""
    held = tuple(dict.fromkeys(grasp.held_frame for grasp in system.grasps if grasp.held_frame in system.point_frames))
    return held, tuple(point for point in system.point_frames if point not in held)


def _joints(
    system: System, run: SimulationResult, experiment: VirtualExperimentSettings, streams: _Generators
) -> JointGroup:
    driven, noise = list(system.actuated_coordinate_indices), experiment.arm_noise
    names = ("effort_std", "effort_bias_std")
    white, bias = (_by_joint(getattr(noise, name), len(driven), f"ArmSensorNoise.{name}") for name in names)
    offset = bias * streams["effort_bias"].standard_normal(len(driven))
    position = _noisy(run.q[:, driven], noise.position_std, streams["position"])
    velocity = _noisy(run.v[:, driven], noise.velocity_std, streams["velocity"])
    effort = _noisy(run.effort, 0.0 if system.servos else white, streams["effort"]) + offset
    kept = np.ones(len(run.t), bool)
    kept[2:-2] = streams["clock"].random(len(run.t) - 4) >= noise.lost_joint_sample_fraction
    joints = JointGroup(tuple(system.driven), run.t[kept], position[kept], velocity=velocity[kept])
    joints = replace(joints, position_std=noise.position_std, velocity_std=noise.velocity_std)
    if noise.position_resolution:
        counted = noise.position_resolution * np.rint(joints.position / noise.position_resolution)
        joints = replace(joints, position=counted, position_resolution=noise.position_resolution)
    if system.servos:
        return replace(joints, position_command=run.effort[kept])
    stds = (white, bias) if noise.records_effort_std else (None, None)
    joints = replace(joints, effort_std=stds[0], effort_bias_std=stds[1], effort_kind=experiment.simulation.effort_kind)
    return replace(joints, effort=effort[kept])


def _by_joint(std: float | tuple[float, ...], joints: int, where: str) -> Array:
    if np.ndim(std) and np.size(std) != joints:
        what, allowed = f"there are {np.size(std)} standard deviations for {joints} joints", f"1 or {joints} of them"
        raise ConfigError(what, where=where, allowed=allowed, hint="pass one number, or one for each driven joint")
    return np.asarray(std, dtype=float)


def _camera_points(
    system: System, visible: tuple[str, ...], run: SimulationResult, camera: PointCamera, streams: _Generators
) -> PointGroup:
    rng = streams["camera_points"]
    clean = run.frame_point_positions[:, [system.point_frames.index(point) for point in visible]]
    position = _noisy(clean, camera.point_std, rng)
    position[rng.random(position.shape[:2]) < camera.hidden_probability] = np.nan
    target = run.point_positions[0].mean(0)
    beside = target + 2.0 * _CAMERA_DIRECTION / np.linalg.norm(_CAMERA_DIRECTION)
    pose = look_at_pose(beside, target) if camera.pose is None else np.asarray(camera.pose, float)
    std = np.array(camera.point_std)
    return PointGroup("points_camera", visible, run.frame_times, position, std, "camera", camera_pose=pose)


def _how_it_was_made(experiment: VirtualExperimentSettings, system: System) -> str:
    simulation = experiment.simulation
    held = 1e3 / (simulation.sample_rate * simulation.controller_periods_per_sample)
    control = "commands of position servos" if system.servos else "torque"
    made = f"MuJoCo {import_mujoco().__version__} (implicitfast, {1e3 * simulation.time_step:g} ms inner step)"
    motion = f"multi-sine motion of {len(system.driven)} joints from static equilibrium"
    return f"Virtual experiment in {made}: {motion}, {control} held over each {held:g} ms, seed {experiment.seed}."


def _noisy(clean: Array, std: float | Array, rng: np.random.Generator) -> Array:
    return np.array(clean + std * rng.standard_normal(clean.shape))


def _frame_times(rng: np.random.Generator, duration: float, camera: PointCamera) -> Array:
    times = np.cumsum(rng.uniform(0.75, 1.25, math.ceil(2 * duration * camera.frame_rate) + 2) / camera.frame_rate)
    times = times[times < duration]
    if camera.has_dropouts:
        number = max(1, round(duration / 2.5))
        starts = duration / number * (np.arange(number) + rng.uniform(0.15, 0.45, number))
        times = times[~((times[:, None] >= starts) & (times[:, None] <= starts + rng.uniform(1.0, 1.5, number))).any(1)]
    return np.asarray(times)


# by kind of sensor effect: its channel, and the reading as a function of true position, true effort and parameters
_JOINT_SENSOR_ERRORS: Mapping[str, tuple[str, Callable[[Array, Array, Mapping[str, float]], Array]]] = {
    "effort_gain": ("effort", lambda q, u, size: u * size["scale"]),
    "effort_offset": ("effort", lambda q, u, size: u + size["offset"]),
    "encoder_offset": ("position", lambda q, u, size: q + size["offset"]),
    "series_elasticity": ("position", lambda q, u, size: q + u / size["stiffness"]),
    "backlash": ("position", lambda q, u, size: q + size["width"] / 2 * np.tanh(u / 0.2)),
}


def recording_with_sensor_error(
    recording: Recording, system: System, kind: str, location: str, values: Mapping[str, float]
) -> Recording:
    """Add a sensor error to a copy of a recording: the sensor effect `kind` at `location` with parameters `values`."""
    if kind.startswith("camera") or kind == "surface_offset":
        last = recording.duration
        seen = (g if g.camera_pose is None else _camera_error(g, system, kind, values, last) for g in recording.points)
        return replace(recording, points=tuple(seen))
    joints = recording.joints
    assert joints is not None
    if joints.effort is None:
        what = f"recording '{recording.name}' has no joint efforts, from which the effect {kind} is computed"
        where, allowed = f"{kind}@{location}", "recordings with joint efforts"
        raise ModelError(what, where=where, allowed=allowed, hint="pass a recording with efforts, or omit this effect")
    if kind == "effort_delay":
        effort = joints.effort.copy()
        # an effort acts only after the delay, so the recording contains it earlier
        for name in joint_names_by_arm(system)[location]:
            column = joints.names.index(name)
            effort[:, column] = np.interp(joints.t + values["delay"], joints.t, joints.effort[:, column])
        return replace(recording, joints=replace(joints, effort=effort))
    at, (channel, read) = joints.names.index(location), _JOINT_SENSOR_ERRORS[kind]
    wrong = {"position": joints.position.copy(), "effort": joints.effort.copy()}
    wrong[channel][:, at] = read(joints.position[:, at], joints.effort[:, at], values)
    return replace(recording, joints=replace(joints, position=wrong["position"], effort=wrong["effort"]))


def _camera_error(
    group: PointGroup, system: System, kind: str, size: Mapping[str, float], duration: float
) -> PointGroup:
    assert group.camera_pose is not None
    position, centre = group.position, np.asarray(group.camera_pose)[:3, 3]
    if kind == "camera_translation":
        return replace(group, position=position + np.array([size["x"], size["y"], size["z"]]))
    if kind == "camera_rotation":
        turn = Rotation.from_euler("xyz", [size["rx"], size["ry"], size["rz"]]).as_matrix()
        return replace(group, position=centre + (position - centre) @ turn.T)
    if kind == "camera_scale":
        return replace(group, position=centre + size["scale"] * (position - centre))
    if kind == "camera_latency":
        late = group.t + size["delay"]
        inside = late <= duration
        std = None if group.std is None else group.std[inside]
        return replace(group, t=late[inside], position=position[inside], std=std)
    value = CasadiEvaluator(system, {})
    radius = {s.name: float(value(s.radius)[0]) for s in system.segment_layouts}
    own = np.array([radius.get(name.removeprefix("w_").partition(":")[0], 0.0) for name in group.names])
    ray = centre - position
    away = ray / np.linalg.norm(ray, axis=2, keepdims=True)
    return replace(group, position=position + size["fraction"] * own[:, None] * away)

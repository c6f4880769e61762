"""Synthetic recordings: a problem's rollout at given parameters as its sensors would record it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.data.recording import ChannelGroup, JointGroup, PointGroup, Recording, validate_recording
from yid_ocp.errors import SolverError
from yid_ocp.model.servos_and_springs import MOTOR_OFF_COMMAND
from yid_ocp.problem.episode_prediction import EpisodePredictor
from yid_ocp.problem.episodes import Episode, EpisodePrediction
from yid_ocp.problem.options import SensorOptions
from yid_ocp.sensors.base import EffortKind, expand_to_joint_values
from yid_ocp.sensors.joints import (
    JOINT_EFFORT_GROUP_NAME,
    JOINT_POSITION_GROUP_NAME,
    joint_angle_noise_std,
    joint_torque_bias_std,
    joint_torque_noise_std,
)


def recording_from_prediction(
    predictor: EpisodePredictor,
    episode: Episode,
    outcome: EpisodePrediction,
    theta: Array,
    seed: int | None = None,
    description: str = "",
) -> Recording:
    """Convert an episode's rollout, predicted at `theta`, into a recording with its sensors' clocks and noise levels.

    `seed` is that of the noise that the estimation assumes, constant torque offsets included; no noise when absent.
    """
    rng = None if seed is None else np.random.default_rng(seed)
    system, source = predictor.system, episode.recording
    groups = []
    for samples, predicted in zip(episode.measurements, outcome.predicted_outputs, strict=True):
        if samples.sensor.point_names:
            t = episode.grid.start_time + predictor.step.time_step * (samples.node + samples.fraction)
            shape = (len(t), len(samples.sensor.point_names), 3)
            std = np.where(np.isfinite(samples.std), samples.std, np.nanmedian(samples.std)).reshape(shape)
            position = np.where(samples.weight > 0, predicted, np.nan).reshape(shape)
            original = next(group for group in source.points if group.name == samples.sensor.group_name)
            where = (original.sensor, original.frame, original.pose)
            noisy = _noisy(position, std, rng)
            groups.append(PointGroup(original.name, samples.sensor.point_names, t, noisy, std, *where))
    groups = [_with_clamps(group, predictor, source) for group in groups]
    own = predictor.theta_with_episode_values(episode, theta)
    truth = dict(zip(system.parameters.names, map(float, own), strict=True))
    text = f"{description} Simulated with the inputs of {episode.name}.".strip()
    joints = _joints(predictor, episode, outcome, rng)
    channels = _channel_groups(predictor, episode, outcome, own, rng)
    said = (text, "yid_ocp simulate", f"{episode.name}_simulated")
    made = Recording(joints, tuple(groups), *said, true_parameters=truth, channel_groups=channels)
    return validate_recording(replace(made, marker_reference_pose=_straight(made, source)))


def synthesize_recording(
    predictor: EpisodePredictor, episode: Episode, theta: Array, seed: int | None = None
) -> Recording:
    """Roll out an episode at theta and return it as a synthetic recording."""
    refit = predictor.options.initial_state == "fitted_to_points"
    fresh = predictor.with_fitted_initial_state(replace(episode, fixed_initial_state=None), theta) if refit else episode
    found = predictor.predict_episode(fresh, theta, np.zeros(len(predictor.unknowns.initial_state_names)), False)
    if isinstance(found, str):
        raise SolverError(f"the model cannot be rolled out: {found}", where=episode.name, hint="take other values")
    return recording_from_prediction(predictor, fresh, found, theta, seed)


def _channel_groups(
    predictor: EpisodePredictor,
    episode: Episode,
    outcome: EpisodePrediction,
    theta: Array,
    rng: np.random.Generator | None,
) -> tuple[ChannelGroup, ...]:
    """What sensors of declared channels read at every node."""
    made: dict[str, ChannelGroup] = {}
    for sensor in (samples.sensor for samples in episode.measurements):
        name, _, quantity = sensor.group_name.rpartition(".")
        original = next((group for group in episode.recording.channel_groups if group.name == name), None)
        if original is None:
            continue
        names = tuple(channel.removeprefix(f"{sensor.group_name}.") for channel in sensor.channel_names)
        choice = predictor.options.sensors.get(sensor.group_name, SensorOptions())
        stds: dict[str, Array] = {}
        for attribute, own in zip(sensor.channel.std_attribute_names, (choice.std, choice.bias_std), strict=True):
            given = own if own is not None else original.stds.get(attribute)
            if given is not None:
                stds[attribute] = expand_to_joint_values(given, original.names, names, f"sensors.{sensor.group_name}")
        function = predictor.model_functions.compiled_sensor_function(sensor)
        read = function(predictor.node_values(outcome.rollout), theta).output
        values = read.reshape(len(read), len(names), *([-1] if sensor.channel.components else []))
        std, bias = (stds.get(attribute, np.zeros(len(names))) for attribute in sensor.channel.std_attribute_names)
        widen = (slice(None), *[None] * (values.ndim - 2))
        values = _noisy(values, np.broadcast_to(std[widen], values.shape), rng)
        values = values + _noisy(np.zeros(values.shape[1:]), np.broadcast_to(bias[widen], values.shape[1:]), rng)
        before = made.get(name, ChannelGroup(name, names, episode.grid.node_times, {}))
        made[name] = replace(before, values={**before.values, quantity: values}, stds={**before.stds, **stds})
    return tuple(made.values())


def _with_clamps(group: PointGroup, predictor: EpisodePredictor, source: Recording) -> PointGroup:
    """A group with the points that clamps follow, as they were recorded: what moves the object, not what it does."""
    original = next(entry for entry in source.points if entry.name == group.name)
    clamps = predictor.options.clamp_paths
    followed = dict.fromkeys(point for clamp in clamps for point in (clamp.origin_point, clamp.z_axis_point))
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
    if source.marker_reference_pose is None or not made.points or made.points[0].name != source.points[0].name:
        return None
    return source.marker_reference_pose[[source.points[0].names.index(name) for name in made.points[0].names]]


def _joints(
    predictor: EpisodePredictor, episode: Episode, outcome: EpisodePrediction, rng: np.random.Generator | None
) -> JointGroup | None:
    system, source = predictor.system, episode.recording.joints
    if source is None or not (system.driven or system.prescribed):
        return None
    names = tuple(name for name in (*system.driven, *system.prescribed) if name in source.names)
    at = [system.mechanism.joint_index(name) for name in names]
    position = outcome.rollout.state[:, at]
    if system.servos:
        return _commanded(predictor, episode, position, names, rng)
    held = {name: outcome.rollout.torque[:, i] for i, name in enumerate(system.driven)}
    held |= {name: outcome.rollout.effort[:, i] for i, name in enumerate(system.prescribed)}
    effort = np.stack([np.append(held[name], held[name][-1]) for name in names], axis=1)
    angle_std, effort_std, bias_std = _levels(predictor, episode, names)
    position, effort = (
        _noisy(values, np.broadcast_to(0.0 if std is None else std, values.shape), rng)
        for values, std in ((position, angle_std), (effort, effort_std))
    )
    # constant over the recording, for every joint one draw
    bias = np.zeros(len(names)) if bias_std is None else bias_std
    effort = effort + _noisy(np.zeros(len(names)), bias, rng)
    levels: dict[str, Any] = {"position_std": angle_std, "effort_std": effort_std, "effort_bias_std": bias_std}
    # of prescribed joints it is the effort at the nodes
    kind: EffortKind = "command" if system.driven else "sample"
    return JointGroup(names, episode.grid.node_times, position, effort=effort, effort_kind=kind, **levels)


def _commanded(
    predictor: EpisodePredictor,
    episode: Episode,
    position: Array,
    names: tuple[str, ...],
    rng: np.random.Generator | None,
) -> JointGroup:
    """Joints of servos at every node, with what they were commanded there."""
    source, times = episode.recording.joints, episode.grid.node_times
    assert source is not None
    columns = [source.names.index(name) for name in names]
    commands = source.position[:, columns] if source.position_command is None else source.position_command[:, columns]
    rows = np.clip(np.searchsorted(source.t, times + 1e-9) - 1, 0, len(source.t) - 1)
    between = np.stack([np.interp(times, source.t, column) for column in commands.T], axis=1)
    held = [predictor.system.servos[name].command_interpolation == "held" for name in names]
    choice = predictor.options.sensors.get(JOINT_POSITION_GROUP_NAME, SensorOptions())
    std = joint_angle_noise_std(source, names, choice, episode.name)
    noisy = _noisy(position, np.broadcast_to(std, position.shape), rng)
    given = np.where(held, commands[rows], between)
    off = np.stack([episode.torque[:, predictor.system.driven.index(name)] >= MOTOR_OFF_COMMAND / 2 for name in names])
    enabled = None if not off.any() else np.append(~off, ~off[:, -1:], axis=1).T.astype(float)
    gain = None if source.proportional_gain is None else np.broadcast_to(source.proportional_gain, len(source.names))
    own_gain = None if gain is None else gain[columns]
    motors: dict[str, Any] = {"position_command": given, "torque_enable": enabled, "proportional_gain": own_gain}
    return JointGroup(names, times, noisy, position_std=std, **motors)


def _levels(
    predictor: EpisodePredictor, episode: Episode, names: tuple[str, ...]
) -> tuple[Array | None, Array | None, Array | None]:
    """Standard deviations of angle, torque and its constant error, (nj,) each, as the estimation takes them.

    Of driven joints those of what drives the motion, else what is stated; None where nothing says so.
    """
    joints, driven = episode.recording.joints, predictor.system.driven
    assert joints is not None
    effort, position = (
        predictor.options.sensors.get(group, SensorOptions())
        for group in (JOINT_EFFORT_GROUP_NAME, JOINT_POSITION_GROUP_NAME)
    )
    joint_angles = joints.position_std if position.std is None else position.std
    torques = joints.effort_std if effort.std is None else effort.std
    if episode.input_errors is None:
        angle, torque = (
            None if given is None else expand_to_joint_values(given, joints.names, names, f"sensors.{group}.std")
            for group, given in ((JOINT_POSITION_GROUP_NAME, joint_angles), (JOINT_EFFORT_GROUP_NAME, torques))
        )
        return angle, torque, None
    at, rest = [names.index(name) for name in driven], [i for i, name in enumerate(names) if name not in driven]
    other = tuple(names[i] for i in rest)
    angle, torque, bias = np.zeros((3, len(names)))
    angle[at] = joint_angle_noise_std(joints, driven, position, episode.name)
    torque[at] = joint_torque_noise_std(joints, driven, effort, episode.name)
    bias[at] = joint_torque_bias_std(joints, driven, effort)
    if other:
        stated = ((angle, joint_angles, JOINT_POSITION_GROUP_NAME), (torque, torques, JOINT_EFFORT_GROUP_NAME))
        for target, std, group in stated:
            own = 0.0 if std is None else std
            target[rest] = expand_to_joint_values(own, joints.names, other, f"sensors.{group}.std")
    return angle, torque, bias


def _noisy(values: Array, std: Array, rng: np.random.Generator | None) -> Array:
    return values if rng is None else values + np.where(np.isfinite(std), std, 0.0) * rng.standard_normal(values.shape)

"""Results of predictions: measured channels, baselines without a model, and synthetic recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.data.recording import JointGroup, PointGroup, Recording, SensorChannelGroup, validated_recording
from yid_ocp.display import ReprMixin, ReprTexts
from yid_ocp.errors import DataError, failed_rollout_error
from yid_ocp.model.objects.base import CableVertices
from yid_ocp.model.servos_and_springs import MOTOR_OFF_COMMAND
from yid_ocp.problem.episode_prediction import EpisodePredictor
from yid_ocp.problem.episodes import Episode, EpisodeAndPredictionOrFailure, EpisodePrediction
from yid_ocp.problem.options import SensorOptions
from yid_ocp.sensors import joints as joint_sensors
from yid_ocp.sensors.base import EffortSamplingKind, expand_to_joint_values
from yid_ocp.sensors.signal_filters import FirstOrderLag

_GIVEN_FRAMES = 2  # number of measured frames that predictions without a model use, like the fit of the initial state


def naive_cable_predictions(
    recording: Recording, cable: CableVertices, points: Sequence[str], knots: Sequence[str] | None = None
) -> dict[str, Array]:
    """Predict positions (M, len(points), 3) [m] of cable points without a model, from two frames and the clamps' paths.

    With `stays`, every point stays at its position in the second frame. With `moves_with_clamps`, it moves by the mean
    displacement of the clamped points since then. With `linear_carry`, displacements are interpolated along the arc
    length of the parent branch between its points `knots` (default: its two ends), and children move with their
    junction. The first two frames are as measured. Raises `DataError` if a point is not recorded or not measured in the
    second frame, or if there are fewer than three frames.
    """
    t, parent, held = recording.group_of_point(points[0]).t, cable.main_branch_vertex_names, cable.clamped_vertex_names
    start, chain = (_start_frame(recording, names, t) for names in (points, parent))
    arc = dict(zip(parent, [0.0, *np.cumsum(np.linalg.norm(np.diff(chain, axis=0), axis=1))], strict=True))
    junction = {point: branch[0] for branch in cable.child_branch_vertex_names.values() for point in branch[1:]}
    ends = sorted(knots or (parent[0], parent[-1]), key=arc.__getitem__)
    places, between = [arc[junction.get(point, point)] for point in points], [arc[point] for point in ends]
    shares = {
        "moves_with_clamps": (held, np.full((len(points), len(held)), 1.0 / len(held))),
        "linear_carry": (ends, np.stack([np.interp(places, between, row) for row in np.eye(len(ends))], axis=1)),
    }
    found = {"stays": recording.point_positions(points, t)}
    found["stays"][_GIVEN_FRAMES:] = start
    for name, (known, share) in shares.items():
        moved = recording.point_positions(known, t) - _start_frame(recording, known, t)
        found[name] = found["stays"].copy()
        found[name][_GIVEN_FRAMES:] += np.einsum("pk,mkx->mpx", share, moved)[_GIVEN_FRAMES:]
    return found


def _start_frame(recording: Recording, points: Sequence[str], t: Array) -> Array:
    """Measured positions (len(points), 3) [m] at the second time, from which predictions without a model start."""
    at, where = recording.point_positions(points, t), f"recording '{recording.name}'"
    if len(at) <= _GIVEN_FRAMES:
        what, allowed = f"{', '.join(points)} have {len(at)} samples only", f"{_GIVEN_FRAMES + 1} samples or more"
        raise DataError(what, where=where, allowed=allowed, hint="use a longer recording or problem.duration")
    start = np.asarray(at[_GIVEN_FRAMES - 1])
    if not np.all(np.isfinite(start)):
        hidden = points[int(np.argmin(np.isfinite(start).all(axis=1)))]
        what, allowed = f"point '{hidden}' is not seen in sample {_GIVEN_FRAMES}", "a sample with all points"
        hint = f"cut the recording so that it begins when all points are seen, or leave '{hidden}' out"
        raise DataError(what, where=where, allowed=allowed, hint=hint)
    return start


@dataclass(frozen=True, eq=False, repr=False)
class ChannelPrediction(ReprMixin):
    """The measured and predicted samples (M, w) of one channel; w is 3 for a point, 1 for a joint."""

    recording: str
    channel: str
    unit: str
    t: Array  # times on the channel's own clock, (M,) [s]
    measured: Array  # NaN if not measured, (M, w)
    predicted: Array
    noise_std: Array  # noise std of the sensor; NaN if unknown, (M, w)

    @property
    def predicted_minus_measured(self) -> Array:
        """The error (M, w) of the prediction, predicted minus measured."""
        return self.predicted - self.measured

    @property
    def rmse(self) -> float:
        """The root mean square error in the channel's unit; for a point, of the Euclidean distance."""
        return float(np.sqrt(np.nanmean(np.sum(self.predicted_minus_measured**2, axis=1))))

    def predicted_at(self, t: Array) -> Array:
        """Interpolate the prediction linearly to other times `t` (K,) [s]; NaN outside it. Returns shape (K, w)."""
        return np.stack([np.interp(t, self.t, column, np.nan, np.nan) for column in self.predicted.T], axis=1)

    def _summary(self) -> ReprTexts:
        samples = f"{len(self.t)} samples, rmse {self.rmse:.3g} {self.unit}"
        return ReprTexts(f"{self.channel} of '{self.recording}', {samples}")


def channel_predictions(episode: Episode, result: EpisodePrediction) -> tuple[ChannelPrediction, ...]:
    """Return the measured and predicted samples of an episode, one `ChannelPrediction` for each channel."""
    found = []
    for samples, predicted in zip(episode.measurements, result.predicted_outputs, strict=True):
        sensor = samples.sensor
        times = episode.grid.start_time + episode.grid.time_step * (samples.node + samples.fraction)
        width = sensor.outputs_per_channel
        for i, channel in enumerate(sensor.channel_names):
            at = slice(i * width, (i + 1) * width)
            t = times if times.ndim == 1 else times[:, i * width]
            own = (values[:, at] for values in (samples.value, predicted, samples.std))
            found.append(ChannelPrediction(episode.name, channel, sensor.channel_units[i], t, *own))
    return tuple(found)


def rmse_unit_count_dicts_by_channel(
    results: Sequence[EpisodePrediction], episodes: Sequence[Episode]
) -> dict[str, dict[str, Any]]:
    """Compute the root mean square error, unit and number of samples by channel, with the keys `rmse`, `unit`, `n`.

    For points, the error of a sample is the Euclidean distance.
    """
    squares, units = dict[str, list[float]](), dict[str, str]()
    for result, episode in zip(results, episodes, strict=True):
        for own in channel_predictions(episode, result):
            square = np.sum(own.predicted_minus_measured**2, axis=1)
            squares.setdefault(own.channel, []).extend(square[np.isfinite(square)].tolist())
            units[own.channel] = own.unit
    seen = ((channel, values) for channel, values in squares.items() if values)
    return {name: {"rmse": float(np.sqrt(np.mean(x))), "unit": units[name], "n": len(x)} for name, x in seen}


def held_out_rmse_and_unit_by_channel(found: Sequence[EpisodeAndPredictionOrFailure]) -> dict[str, tuple[float, str]]:
    """Return the root mean square error and unit of each channel over all predicted held-out recordings."""
    predicted = [(result, episode) for episode, result in found if not isinstance(result, str)]
    errors = rmse_unit_count_dicts_by_channel([own for own, _ in predicted], [episode for _, episode in predicted])
    return {name: (float(entry["rmse"]), str(entry["unit"])) for name, entry in errors.items()}


def recording_from_prediction(
    predictor: EpisodePredictor,
    episode: Episode,
    outcome: EpisodePrediction,
    theta: Array,
    seed: int | None = None,
    description: str = "",
) -> Recording:
    """Convert the prediction `outcome` of an episode to a recording with the sensors' clocks and noise levels.

    `theta` are the parameter values of the prediction, which become `true_parameters`. With a `seed`, random noise is
    added as the estimation assumes it, including constant torque offsets. Without a `seed` there is no noise.
    """
    rng = None if seed is None else np.random.default_rng(seed)
    system, source = predictor.system, episode.recording
    groups = []
    for samples, predicted in zip(episode.measurements, outcome.predicted_outputs, strict=True):
        if samples.sensor.point_names and len(samples.value):
            t = episode.grid.start_time + predictor.integrator_step.time_step * (samples.node + samples.fraction)
            shape = (len(t), len(samples.sensor.point_names), 3)
            std = np.where(np.isfinite(samples.std), samples.std, np.nanmedian(samples.std)).reshape(shape)
            position = np.where(samples.weight > 0, predicted, np.nan).reshape(shape)
            original = next(group for group in source.points if group.name == samples.sensor.group_name)
            where = (original.sensor_name, original.frame, original.camera_pose)
            noisy = _noisy(position, std, rng)
            groups.append(PointGroup(original.name, samples.sensor.point_names, t, noisy, std, *where))
    groups = [_with_clamps(group, predictor, source) for group in groups]
    own = predictor.theta_with_episode_values(episode, theta)
    truth = dict(zip(system.parameters.names, map(float, own), strict=True))
    text = f"{description} Simulated with the inputs of {episode.name}.".strip()
    joints = _joints(predictor, episode, outcome, own, rng)
    channels = _channel_groups(predictor, episode, outcome, own, rng)
    said = (text, "yid_ocp simulate", f"{episode.name}_simulated")
    made = Recording(joints, tuple(groups), *said, true_parameters=truth, channel_groups=channels)
    if source.marker_reference_pose is not None and groups and groups[0].name == source.points[0].name:
        at = [source.points[0].names.index(name) for name in groups[0].names]
        made = replace(made, marker_reference_pose=source.marker_reference_pose[at])
    return validated_recording(made)


def synthesize_recording(
    predictor: EpisodePredictor, episode: Episode, theta: Array, seed: int | None = None
) -> Recording:
    """Simulate an episode at `theta` and make a synthetic recording, with noise if a `seed` is given."""
    refit = predictor.options.initial_state == "fitted_to_points"
    bare = replace(episode, fixed_initial_state=None)
    fresh = predictor.episode_with_fitted_initial_state(bare, theta) if refit else episode
    found = predictor.predict_episode(fresh, theta, np.zeros(len(predictor.unknowns.initial_state_names)), False)
    if isinstance(found, str):
        raise failed_rollout_error(found, f"recording '{episode.name}'")
    return recording_from_prediction(predictor, fresh, found, theta, seed)


def _channel_groups(
    predictor: EpisodePredictor,
    episode: Episode,
    outcome: EpisodePrediction,
    theta: Array,
    rng: np.random.Generator | None,
) -> tuple[SensorChannelGroup, ...]:
    """Groups of predicted channels, other than joints and points, with readings at every node."""
    made: dict[str, SensorChannelGroup] = {}
    for sensor in (samples.sensor for samples in episode.measurements):
        name, _, quantity = sensor.group_name.rpartition(".")
        original = next((group for group in episode.recording.channel_groups if group.name == name), None)
        if original is None:
            continue
        names = tuple(channel.removeprefix(f"{sensor.group_name}.") for channel in sensor.channel_names)
        choice = predictor.options.sensors.get(sensor.group_name, SensorOptions())
        stds: dict[str, Array] = {}
        for attribute, own in zip(sensor.channel.std_attribute_names, (choice.std, choice.bias_std), strict=True):
            given = own if own is not None else original.noise_and_bias_stds_by_attribute.get(attribute)
            if given is not None:
                stds[attribute] = expand_to_joint_values(given, original.names, names, f"sensors.{sensor.group_name}")
        function = predictor.model_functions.compiled_sensor_function(sensor)
        read = function(predictor.rollout_node_values(outcome.rollout), theta).output
        values = read.reshape(len(read), len(names), *([-1] if sensor.channel.components else []))
        std, bias = (stds.get(attribute, np.zeros(len(names))) for attribute in sensor.channel.std_attribute_names)
        widen = (slice(None), *[None] * (values.ndim - 2))
        values = _noisy(values, np.broadcast_to(std[widen], values.shape), rng)
        values = values + _noisy(np.zeros(values.shape[1:]), np.broadcast_to(bias[widen], values.shape[1:]), rng)
        before = made.get(name, SensorChannelGroup(name, names, episode.grid.node_times, {}))
        by_quantity = {**before.values_by_quantity, quantity: values}
        by_attribute = {**before.noise_and_bias_stds_by_attribute, **stds}
        made[name] = replace(before, values_by_quantity=by_quantity, noise_and_bias_stds_by_attribute=by_attribute)
    return tuple(made.values())


def _with_clamps(group: PointGroup, predictor: EpisodePredictor, source: Recording) -> PointGroup:
    """The group, extended by the recorded points that clamps follow, which are inputs and are not predicted."""
    original = next(entry for entry in source.points if entry.name == group.name)
    clamps = predictor.options.clamp_pose_point_names
    followed = dict.fromkeys(point for clamp in clamps for point in (clamp.origin_point_name, clamp.z_axis_point_name))
    names = tuple(name for name in followed if name in original.names and name not in group.names)
    if not names:
        return group
    at = [original.names.index(name) for name in names]
    near = np.searchsorted(original.t, group.t - 1e-9).clip(0, len(original.t) - 1)
    position = np.concatenate([group.position, original.position[near][:, at]], axis=1)
    assert group.std is not None
    std = np.concatenate([group.std, np.full((len(group.t), len(at), 3), np.median(group.std))], axis=1)
    return replace(group, names=(*group.names, *names), position=position, std=std)


def _joints(
    predictor: EpisodePredictor,
    episode: Episode,
    outcome: EpisodePrediction,
    theta: Array,
    rng: np.random.Generator | None,
) -> JointGroup | None:
    system, source = predictor.system, episode.recording.joints
    if source is None or not (system.driven or system.prescribed):
        return None
    names = tuple(name for name in (*system.driven, *system.prescribed) if name in source.names)
    position, effort = _joint_readings(predictor, outcome, theta, names)
    if system.servos:
        return _commanded(predictor, episode, position, names, rng)
    angle_std, effort_std, bias_std = _levels(predictor, episode, names)
    position, effort = (
        _noisy(values, np.broadcast_to(0.0 if std is None else std, values.shape), rng)
        for values, std in ((position, angle_std), (effort, effort_std))
    )
    # constant over the recording, for every joint one draw
    effort = effort + _noisy(np.zeros(len(names)), np.zeros(1) if bias_std is None else bias_std, rng)
    levels: dict[str, Any] = {"position_std": angle_std, "effort_std": effort_std, "effort_bias_std": bias_std}
    if not system.driven and effort_std is None:
        return JointGroup(names, episode.grid.node_times, position, position_std=angle_std)  # no fit could use efforts
    # for prescribed joints, the effort at the nodes
    kind: EffortSamplingKind = "command" if system.driven else "sample"
    return JointGroup(names, episode.grid.node_times, position, effort=effort, effort_kind=kind, **levels)


def _joint_readings(
    predictor: EpisodePredictor, outcome: EpisodePrediction, theta: Array, names: tuple[str, ...]
) -> tuple[Array, Array]:
    """Angles and efforts (N + 1, nj) of joints at every node as recorded, with the errors that effects add."""
    functions, h, rollout = predictor.model_functions, predictor.integrator_step.time_step, outcome.rollout
    corrections, times = functions.input_corrections, h * np.arange(len(rollout.state))
    if (lag := corrections.joint_delays_or_lag_times("effort_lag", theta, ())) is not None:
        rollout = replace(rollout, effort=FirstOrderLag(*lag, h).lagged_node_values(rollout.effort, None)[0])
    if (lag := corrections.joint_delays_or_lag_times("torque_lag", theta, ())) is not None:
        # the applied torque lags behind the recorded one
        rollout = replace(rollout, torque=FirstOrderLag(-lag[0], lag[1], h).lagged_node_values(rollout.torque, None)[0])
    values, found = predictor.rollout_node_values(rollout), []
    for sensor in (joint_sensors.PositionSensor(names), joint_sensors.PrescribedJointEffortSensor(names)):
        read = functions.compiled_sensor_function(sensor)(values, theta).output
        shift, _ = corrections.sensor_delays_with_derivatives(sensor, theta, ()) or (np.zeros(len(names)), None)
        found.append(np.stack([np.interp(times - s, times, x) for x, s in zip(read.T, shift, strict=True)], axis=1))
    return found[0], found[1]


def _commanded(
    predictor: EpisodePredictor,
    episode: Episode,
    position: Array,
    names: tuple[str, ...],
    rng: np.random.Generator | None,
) -> JointGroup:
    """Joint group of servos at every node, with noisy angles, commands and gains."""
    source, times = episode.recording.joints, episode.grid.node_times
    assert source is not None
    columns = [source.names.index(name) for name in names]
    commands = source.position[:, columns] if source.position_command is None else source.position_command[:, columns]
    rows = np.clip(np.searchsorted(source.t, times + 1e-9) - 1, 0, len(source.t) - 1)
    between = np.stack([np.interp(times, source.t, column) for column in commands.T], axis=1)
    held = [predictor.system.servos[name].command_interpolation == "held" for name in names]
    choice = predictor.options.sensors.get(joint_sensors.JOINT_POSITION_GROUP_NAME, SensorOptions())
    std = joint_sensors.joint_angle_noise_std(source, names, choice, episode.name)
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
    """Standard deviations (nj,) of angle, torque and torque offset assumed by the estimation; None if not stated."""
    joints, driven = episode.recording.joints, predictor.system.driven
    assert joints is not None
    effort = predictor.options.sensors.get(joint_sensors.JOINT_EFFORT_SENSOR_KEY, SensorOptions())
    position = predictor.options.sensors.get(joint_sensors.JOINT_POSITION_GROUP_NAME, SensorOptions())
    kinds = (
        (joint_sensors.JOINT_POSITION_GROUP_NAME, position, joint_sensors.joint_angle_noise_std),
        (joint_sensors.JOINT_EFFORT_SENSOR_KEY, effort, joint_sensors.joint_torque_noise_std),
    )
    noisy, levels = () if episode.input_errors is None else driven, np.zeros((3, len(names)))
    at, found = [names.index(name) for name in noisy], list[Array | None]()
    for level, (group, choice, noise_std) in zip(levels[:2], kinds, strict=True):
        stated = joint_sensors.is_noise_std_stated(joints, group, choice)
        if stated or noisy:  # of joints that drive the model it is estimated if it is not stated
            level[slice(None) if stated else at] = noise_std(joints, names if stated else noisy, choice, episode.name)
        found.append(level if stated or noisy else None)
    levels[2, at] = joint_sensors.joint_torque_bias_std(joints, noisy, effort)
    return found[0], found[1], levels[2] if noisy else None


def _noisy(values: Array, std: Array, rng: np.random.Generator | None) -> Array:
    return values if rng is None else values + np.where(np.isfinite(std), std, 0.0) * rng.standard_normal(values.shape)

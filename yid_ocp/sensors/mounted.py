"""Sensors on a link's frame that read vectors along its axes: the base class, and inertial units."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import casadi as ca
import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.errors import DataError, unknown_name_error_arguments
from yid_ocp.model.system import NodeStateSymbols
from yid_ocp.sensors import base
from yid_ocp.sensors.joints import (
    JOINT_POSITION_GROUP_NAME,
    decorrelated_nodes_and_low_pass_values,
    is_noise_std_stated,
    joint_angle_noise_std,
)


@dataclass(frozen=True)
class MountedSensor(base.Sensor):
    """The base class of sensors that are mounted on frames. A reading has three components, along the frame's axes."""

    has_paper_weight = False
    point_names = ()
    names: tuple[str, ...]  # recorded names of the sensors
    signs: tuple[float, ...]  # sign of each sensor's reading, 1 or -1
    frame_names: tuple[str, ...]  # the model's frame that each sensor is mounted on
    group_name: str

    @property
    def channel_names(self) -> tuple[str, ...]:
        return tuple(f"{self.group_name}.{name}" for name in self.names)

    def bias_location_name_for_frame(self, frame: str) -> str:
        return f"{self.channel.group}:{frame}"

    def ideal_reading(self, state: NodeStateSymbols) -> ca.SX:
        frames = zip(self.signs, self.frame_names, strict=True)
        return ca.vertcat(*(sign * self._frame_reading(state, frame) for sign, frame in frames))

    def _frame_reading(self, state: NodeStateSymbols, frame: str) -> ca.SX:
        raise NotImplementedError


def register_class_of_mounted_sensor(kind: type[MountedSensor]) -> type[MountedSensor]:
    """Register the channel of a class of mounted sensors, and a reader that makes one `SensorData` for each group."""
    key = f"{kind.channel.group}.{kind.channel.quantity}"
    base.CHANNEL_KINDS.register(key)(kind.channel)
    base.SENSOR_READERS.register(key)(partial(_read_sensors, kind=kind))
    return kind


def _read_sensors(around: base.SensorDataInputs, kind: type[MountedSensor]) -> list[base.SensorData]:
    channel, found = kind.channel, []
    for group in around.recording.channel_groups:
        key = f"{group.name}.{channel.quantity}"
        held = channel.matches_group_name(group.name) and channel.quantity in group.values_by_quantity
        if held and around.sensor_usage(key).use is not False:
            found.append(_measured(around, kind, group, key))
    return found


def _measured(
    around: base.SensorDataInputs, kind: type[MountedSensor], group: base.RecordedExtraChannelsInterface, key: str
) -> base.SensorData:
    choice, tree = around.sensor_usage(key), around.system.mechanism
    where, channel, names = f"recording '{around.recording.name}': {group.name}", kind.channel, group.names
    frames = tuple(choice.frame_by_recorded_name.get(name, name) for name in names)
    for name, frame in zip(names, frames, strict=True):
        if not tree.has_frame(frame) or tree.frame(frame).joint_index < 0:
            moving = [known for known, entry in tree.frames.items() if entry.joint_index >= 0]
            why = "does not move" if tree.has_frame(frame) else "does not exist"
            what = f"sensor '{name}' is on the frame '{frame}', which {why}"
            hint = f"set sensors.{key}.frame_by_recorded_name: {{{name}: FRAME}}, or sensors.{key}.use: false"
            raise DataError(what, where=where, **(unknown_name_error_arguments(frame, moving) | {"hint": hint}))
    stated = [group.noise_and_bias_stds_by_attribute.get(attribute) for attribute in channel.std_attribute_names]
    std = stated[0] if choice.std is None else choice.std
    if std is None:
        raise base.missing_noise_level_error(channel.quantity, where, key, channel.unit)
    bias = next((given for given in (choice.bias_std, stated[1]) if given is not None), 0.0)
    by_output = [
        np.repeat(base.expand_to_joint_values(given, names, names, f"sensors.{key}.{setting}"), 3)
        for given, setting in ((std, "std"), (bias, "bias_std"))
    ]
    signs = base.expand_to_joint_values(choice.constants.get("sign", 1.0), names, names, f"sensors.{key}.constants")
    if not np.all(np.abs(signs) == 1):
        what, hint = f"the sign of {key} is {', '.join(f'{s:g}' for s in signs)}", "set -1 to reverse the readings"
        raise DataError(what, where=f"sensors.{key}.constants.sign", allowed="1 or -1", hint=hint)
    sensor = kind(names, tuple(signs.tolist()), frames, key)
    values = group.values_by_quantity[channel.quantity].reshape(len(group.t), -1)
    inner = (1, len(around.node_times) - 2)  # forces at both ends depend on the motion beyond the recording
    if not around.system.prescribed:
        last = around.node_times[list(inner)]
        kept = (group.t >= last[0] - 1e-9) & (group.t <= last[1] + 1e-9)
        own = np.broadcast_to(by_output[0], values[kept].shape)
        return base.SensorData(sensor, group.t[kept], values[kept], own, inner, by_output[1])
    nodes, measured = decorrelated_nodes_and_low_pass_values(around, group.t, values, key, like_path=True)
    times, period = around.node_times[nodes], float(np.median(np.diff(group.t)))
    own = by_output[0] * around.path_filter.noise_gains_of_value_and_rates(period)[0]
    total, correlation = _with_encoder_noise(around, sensor, own, times)
    more = (total, inner, by_output[1], correlation)
    return base.SensorData(sensor, times, measured, *more, smoothing_filter=around.path_filter)


def _with_encoder_noise(
    around: base.SensorDataInputs, sensor: MountedSensor, own: Array, times: Array
) -> tuple[Array, Array | None]:
    """Noise std (M, k) and correlation (M, k, k) of filtered readings minus predictions from noisy encoders.

    The derivatives by angles, velocities and accelerations are those at standstill. No correlation: no encoder noise.
    """
    joints, encoders = around.recording.joints, around.sensor_usage(JOINT_POSITION_GROUP_NAME)
    names = () if joints is None else tuple(name for name in around.system.prescribed if name in joints.names)
    alone = np.broadcast_to(own, (len(times), len(own)))
    if joints is None or not names or not is_noise_std_stated(joints, JOINT_POSITION_GROUP_NAME, encoders):
        return alone, None
    angle = joint_angle_noise_std(joints, names, encoders, around.recording.name)
    if not np.any(angle > 0):
        return alone, None
    system = around.system
    at, n = [system.mechanism.joint_index(name) for name in names], system.n_coordinates
    columns = [joints.names.index(name) for name in names]
    q = np.zeros((len(times), n))
    q[:, at] = np.stack([np.interp(times, joints.t, joints.position[:, column]) for column in columns], axis=1)
    function = base.sensor_function_with_jacobians(system, sensor, ())
    symbols = [ca.SX.sym(name, function.size1_in(name)) for name in ("q", "theta")]
    slopes = function(q=symbols[0], theta=symbols[1])
    gains = around.path_filter.noise_gains_of_value_and_rates(float(np.median(np.diff(joints.t))))
    pairs = ((slopes[name], gain) for name, gain in zip(("by_q", "by_v", "by_a"), gains, strict=True))
    parts = [ca.densify(slope[:, at]) @ ca.diag(ca.DM(angle * gain)) for slope, gain in pairs if slope.shape[1] == n]
    errors = ca.Function("errors", symbols, [ca.horzcat(*parts)]).map(len(times))
    theta = np.repeat(system.parameters.vector()[:, None], len(times), axis=1)
    spread = np.array(errors(q.T, theta)).reshape(len(own), len(times), -1).transpose(1, 0, 2)
    covariance = spread @ spread.transpose(0, 2, 1) + np.diag(own**2)
    total = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return total, covariance / (total[:, :, None] * total[:, None, :])


_XYZ = ("x", "y", "z")


@register_class_of_mounted_sensor
class _Gyroscope(MountedSensor):
    """Angular velocity of a frame relative to the world, along the frame's axes."""

    channel = base.RecordedChannelSpec("imu", "angular_velocity", "rad/s", _XYZ)

    def _frame_reading(self, state: NodeStateSymbols, frame: str) -> ca.SX:
        kinematics = state.kinematics
        return kinematics.frame_pose(frame).rotation.T @ (kinematics.angular_jacobian(frame) @ state.v)


@register_class_of_mounted_sensor
class _Accelerometer(MountedSensor):
    """Acceleration of a frame's origin minus gravity, along the frame's axes. At rest it is 9.81 m/s^2 upwards."""

    channel = base.RecordedChannelSpec("imu", "specific_force", "m/s^2", _XYZ)

    def _frame_reading(self, state: NodeStateSymbols, frame: str) -> ca.SX:
        kinematics = state.kinematics
        jacobian = kinematics.position_jacobian(frame)
        acceleration = jacobian @ state.a + ca.jtimes(jacobian @ state.v, state.q, state.v)
        return kinematics.frame_pose(frame).rotation.T @ (acceleration - state.system.gravity)

"""Sensors of the robot's joints: encoders of driven joints and efforts of prescribed joints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import casadi as ca
import numpy as np
import scipy.special

from yid_ocp.arrays import Array, BoolArray, IntArray
from yid_ocp.errors import ConfigError, DataError
from yid_ocp.model.system import NodeStateSymbols
from yid_ocp.sensors.base import (
    CHANNEL_KINDS,
    SENSOR_READERS,
    RecordedChannelSpec,
    RecordedJointsInterface,
    RecordedPointsInterface,
    Sensor,
    SensorData,
    SensorDataInputs,
    SensorOptions,
    expand_to_joint_values,
    missing_noise_level_error,
    recorded_joint_column_indices,
)

JOINT_EFFORT_SENSOR_KEY = "joints.effort"
JOINT_POSITION_GROUP_NAME = "joints.position"
_EFFORT = CHANNEL_KINDS.register(JOINT_EFFORT_SENSOR_KEY)(RecordedChannelSpec("joints", "effort", "N m"))
_POSITION = CHANNEL_KINDS.register(JOINT_POSITION_GROUP_NAME)(RecordedChannelSpec("joints", "position", "rad"))
_MAX_STEPS_PER_GAP = 0.1  # median gap between a quantized channel's values, in smallest gaps and per value
NOISE_ESTIMATE_DIFFERENCE_ORDER = 6  # of differences: they remove motion slower than the sampling


@dataclass(frozen=True)
class JointSensor(Sensor):
    """The base class of sensors of named joints. Each joint has one output."""

    frame_names = point_names = ()

    joint_names: tuple[str, ...]
    group_name: str
    joint_units: tuple[str, ...] = field(default=(), kw_only=True)  # those of revolute joints if empty

    @property
    def channel_units(self) -> tuple[str, ...]:
        return self.joint_units or super().channel_units

    @property
    def channel_names(self) -> tuple[str, ...]:
        return tuple(f"{self.group_name}.{joint}" for joint in self.joint_names)

    def select_sensor_joint_entries(self, values: ca.SX, state: NodeStateSymbols) -> ca.SX:
        """Select the sensor's joints from a column (n, 1) for all joints. The result is (nj, 1)."""
        return ca.vertcat(*(values[state.system.mechanism.joint_index(joint)] for joint in self.joint_names))


@dataclass(frozen=True)
class PositionSensor(JointSensor):
    """The encoders of named driven joints, which measure joint positions [rad or m]."""

    channel = _POSITION
    has_paper_weight = False
    group_name: str = JOINT_POSITION_GROUP_NAME

    @property
    def position_joints(self) -> tuple[str, ...]:
        return self.joint_names

    def ideal_reading(self, state: NodeStateSymbols) -> ca.SX:
        return self.select_sensor_joint_entries(state.q, state)


@dataclass(frozen=True)
class PrescribedJointEffortSensor(JointSensor):
    """A sensor of the efforts of named prescribed joints, predicted by discrete inverse dynamics."""

    channel = _EFFORT
    naive_prediction = "zero"
    group_name: str = JOINT_EFFORT_SENSOR_KEY

    @property
    def effort_joints(self) -> tuple[str, ...]:
        return self.joint_names

    def ideal_reading(self, state: NodeStateSymbols) -> ca.SX:
        return self.select_sensor_joint_entries(state.load, state)


def is_point_group_measured_by_arm(group: RecordedPointsInterface) -> bool:
    """Check whether the arm measured a point group, usually by its encoders and forward kinematics."""
    return "arm" in (group.sensor_name, group.name.rpartition("_")[2])


@SENSOR_READERS.register(JOINT_POSITION_GROUP_NAME)
def _read_joint_angles(around: SensorDataInputs) -> list[SensorData]:
    """Measured angles of driven joints, without the first sample, which defines the initial configuration."""
    joints, choice, system = around.recording.joints, around.sensor_usage(JOINT_POSITION_GROUP_NAME), around.system
    names = system.driven if joints is not None else ()
    arm = [group.name for group in around.recording.points if is_point_group_measured_by_arm(group)]
    arm = [name for name in arm if around.sensor_usage(name).use is not False]
    if joints is None or not names or choice.use is False or (choice.use is None and arm):
        return []
    if arm:
        both = f"the encoders and the points '{arm[0]}' on the arm are both used"
        what = f"{both}, but the points are computed from the encoders"
        allowed, hint = "encoders or points", f"set sensors.{arm[0]}.use: false, or sensors.joints.position.use: false"
        raise ConfigError(what, where="sensors.joints.position.use", allowed=allowed, hint=hint)
    where = around.recording.name
    later = (joints.t > around.node_times[0] + 1e-9) & (joints.t <= around.node_times[-1] + 1e-9)
    value = joints.position[later][:, recorded_joint_column_indices(joints, names, where)]
    std = np.broadcast_to(joint_angle_noise_std(joints, names, choice, where), value.shape)
    sensor = PositionSensor(names, joint_units=system.mechanism.units_at_joints(names, _POSITION.unit))
    return [SensorData(sensor, joints.t[later], value, std)]


@SENSOR_READERS.register(JOINT_EFFORT_SENSOR_KEY)
def _read_joint_efforts(around: SensorDataInputs) -> list[SensorData]:
    """Measured efforts of prescribed joints, low-pass filtered and thinned to independent samples."""
    joints, choice = around.recording.joints, around.sensor_usage(JOINT_EFFORT_SENSOR_KEY)
    names = () if joints is None else tuple(name for name in around.system.prescribed if name in joints.names)
    if joints is None or joints.effort is None or choice.use is False or not names:
        return []
    effort = joints.effort[:, recorded_joint_column_indices(joints, names, around.recording.name)]
    given = choice.std if choice.std is not None else joints.effort_std
    if given is None:
        where = f"recording '{around.recording.name}': joints, attribute effort_std"
        raise missing_noise_level_error("the joint efforts", where, JOINT_EFFORT_SENSOR_KEY, "N m")
    std = expand_to_joint_values(given, joints.names, names, f"sensors.{JOINT_EFFORT_SENSOR_KEY}.std")
    is_sample = joints.effort_sampling_kind_or_default == "sample"
    bias = joint_torque_bias_std(joints, names, choice)
    units = around.system.mechanism.units_at_joints(names, _EFFORT.unit)
    sensor = PrescribedJointEffortSensor(names, joint_units=units)
    return [filtered_effort_sensor_data(around, sensor, joints.t, effort, std, bias, is_sample=is_sample)]


def filtered_effort_sensor_data(
    inputs: SensorDataInputs, sensor: JointSensor, t: Array, values: Array, std: Array, bias: Array, *, is_sample: bool
) -> SensorData:
    """Low-pass filter an effort sensor's measurements, and thin them until their noise is nearly independent.

    `values` (M, k) are in the sensor's unit. `std` and `bias` (k,) are the standard deviations of white noise and of a
    constant error. With `is_sample`, a value is measured at its time, otherwise it is the mean until the next value's
    time. Raises `DataError` if the recording is too short for the filter.
    """
    # the mean of an interval belongs to its centre
    name, centres = sensor.group_name, not is_sample
    kept, measured = decorrelated_nodes_and_low_pass_values(inputs, t, values, name, at_centres=centres)
    measured[_may_stick(inputs, sensor.joint_names, inputs.node_times[kept])] = np.nan
    times, last = inputs.node_times[kept], len(inputs.node_times) - 1
    unit, period = sensor.effort_per_unit_reading, float(np.median(np.diff(t)))
    total, correlation = _smoothed_effort_noise(inputs, sensor.joint_names, std * np.abs(unit), period, times)
    if correlation is not None:
        correlation = correlation * np.outer(np.sign(unit), np.sign(unit))
    more = (total / np.abs(unit), (1, last - 1), bias, correlation)
    return SensorData(sensor, times, measured, *more, smoothing_filter=inputs.effort_filter)


def decorrelated_nodes_and_low_pass_values(
    inputs: SensorDataInputs, t: Array, values: Array, key: str, *, at_centres: bool = False, like_path: bool = False
) -> tuple[IntArray, Array]:
    """Low-pass filter values; return nodes (K,) at which their noise is nearly independent, and the values (K, k).

    `values` (M, k) belong to the times `t` [s] or, with `at_centres`, to the centres of the intervals from these times.
    `like_path` selects the path filter; the default is the effort filter, which is also applied to predictions. Raises
    `DataError`, which names the sensor's settings `key`, if there are too few samples for the filter.
    """
    low_pass, every = inputs.path_filter if like_path else inputs.effort_filter, inputs.sampling_stride
    times, step = inputs.node_times[::every], every * inputs.time_step
    # Neighbouring smoothed values are correlated: only nearly independent ones at samples are kept. Both ends are
    # omitted: there the filter has data on one side only, and impulses depend on motion outside the recording.
    steps, distorted = len(times) - 1, low_pass.end_distortion_duration
    period = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    apart = max(1, round(period / step))
    ends = apart * math.ceil(max(1, math.ceil(distorted / step)) / apart)
    kept = np.arange(ends, steps + 1 - ends, apart * math.ceil(low_pass.decorrelation_stride_for_step(step) / apart))
    kept = kept[(times[kept] > t[0] + distorted - step) & (times[kept] < t[-1] - distorted + step) & (len(t) > 1)]
    if not len(kept):
        length, allowed = min(steps * step, float(t[-1] - t[0])), f"more than {2 * ends * step:.3g} s"
        what = f"{length:.3g} s of {key} are too short for the low-pass filter of {low_pass.cutoff:g} Hz"
        hint = f"use a longer recording or problem.duration, raise problem.path_cutoff, or set sensors.{key}.use: false"
        raise DataError(what, where=f"recording '{inputs.recording.name}'", allowed=allowed, hint=hint)
    smooth, late = low_pass(t, values), 0.5 * period if at_centres else 0.0
    return every * kept, np.stack([np.interp(times[kept], t + late, column) for column in smooth.T], axis=1)


def is_noise_std_stated(joints: RecordedJointsInterface, group: str, choice: SensorOptions) -> bool:
    """Check whether the recording or settings give the noise of `group` (`joints.effort` or `joints.position`).

    A recorded encoder resolution also specifies the noise of joint positions.
    """
    names = [CHANNEL_KINDS[group].std_attribute_names[0]]
    names += ["position_resolution"] if group == JOINT_POSITION_GROUP_NAME else []
    return choice.std is not None or any(getattr(joints, name) is not None for name in names)


def quantization_step(values: Array) -> float:
    """Estimate a channel's quantization step from the gaps between sorted values. Zero if it is not quantized."""
    levels = np.unique(values)
    apart = np.diff(levels)
    step = float(np.min(apart[apart > 1e-9 * np.sum(apart)], initial=np.inf))
    if not math.isfinite(step):
        return 0.0
    count = apart / step
    # with few values, continuous data have a smallest gap far below the median gap
    if len(levels) >= 0.7 * values.size and np.median(count) > _MAX_STEPS_PER_GAP * len(levels):
        return 0.0
    return step if np.mean(np.abs(count - np.rint(count)) < 0.05 * np.maximum(count, 1)) > 0.95 else 0.0


def _joint_noise_std(
    joints: RecordedJointsInterface, names: Sequence[str], choice: SensorOptions, where: str, *, group: str
) -> Array:
    channel, columns = CHANNEL_KINDS[group], recorded_joint_column_indices(joints, tuple(names), where)
    values, given, step = getattr(joints, channel.quantity), choice.std, np.zeros(len(names))
    if given is None and group == JOINT_POSITION_GROUP_NAME:
        found = joints.position_resolution
        if found is None:
            step = np.array([quantization_step(column) for column in values[:, columns].T])
        else:
            step = expand_to_joint_values(found, joints.names, names, "position_resolution")
    step_std = step / math.sqrt(12)
    if given is None:
        given = getattr(joints, channel.std_attribute_names[0])
    if given is not None:
        return np.hypot(expand_to_joint_values(given, joints.names, names, f"sensors.{group}.std"), step_std)
    if is_noise_std_stated(joints, group, choice):
        return step_std
    return np.maximum(_estimated_noise_std(values[:, columns], where, group, channel.unit), step_std)


joint_angle_noise_std = partial(_joint_noise_std, group=JOINT_POSITION_GROUP_NAME)
"""Noise standard deviation of joints' encoders, stated or estimated, shape (len(names),) [rad].

Unless the settings give the noise, the encoder's resolution adds the variance step^2/12. The step is the recording's
`position_resolution` or, if not stated, is estimated from the gaps between values."""
joint_torque_noise_std = partial(_joint_noise_std, group=JOINT_EFFORT_SENSOR_KEY)
"""Noise standard deviation of driven joints' recorded torques, stated or estimated, shape (len(names),) [N m]."""


def joint_torque_bias_std(joints: RecordedJointsInterface, names: Sequence[str], choice: SensorOptions) -> Array:
    """Return the standard deviation of the recorded torques' constant errors, (len(names),) [N m]. Zero if unknown."""
    given = choice.bias_std if choice.bias_std is not None else joints.effort_bias_std
    key = f"sensors.{JOINT_EFFORT_SENSOR_KEY}.bias_std"
    return expand_to_joint_values(0.0 if given is None else given, joints.names, names, key)


def _estimated_noise_std(values: Array, where: str, group: str, unit: str) -> Array:
    """Noise std (k,) of channels (N, k) by high-order differences. Changes as fast as the sampling count as noise."""
    order = NOISE_ESTIMATE_DIFFERENCE_ORDER
    if len(values) <= order:
        what, allowed = f"{len(values)} samples are too few to estimate the noise of {group}", f"{order + 1} or more"
        raise DataError(what, where=f"recording '{where}'", allowed=allowed, hint=f"set sensors.{group}.std [{unit}]")
    mean_square = np.mean(np.diff(values, order, axis=0) ** 2, axis=0)
    return np.asarray(np.sqrt(mean_square / scipy.special.comb(2 * order, order)))


def _may_stick(inputs: SensorDataInputs, names: tuple[str, ...], times: Array) -> BoolArray:
    """Mask (K, k) of joints whose dry friction is unknown at `times` (K,), because they stop within the filter's reach.

    Dry friction can hold a joint at rest against any torque up to its size, so the effort says little about the model.
    """
    joints = inputs.recording.joints
    assert joints is not None
    limits = np.array([inputs.sticking_speeds.get(name, 0.0) for name in names])
    if not np.any(limits):
        return np.zeros((len(times), len(names)), bool)
    position = joints.position[:, recorded_joint_column_indices(joints, names, inputs.recording.name)]
    speed = np.gradient(inputs.path_filter(joints.t, position), joints.t, axis=0)
    step = inputs.sampling_stride * inputs.time_step
    reach = inputs.effort_filter.decorrelation_stride_for_step(step) * step
    first, last = np.searchsorted(joints.t, times - reach), np.searchsorted(joints.t, times + reach)
    windows = [speed[i : max(j, i + 1)] for i, j in zip(first, last, strict=True)]
    # the filter hides a short standstill at a reversal, so that only the sign of the speed shows it
    slowest = [np.maximum(np.maximum(own.min(axis=0), -own.max(axis=0)), 0.0) for own in windows]
    return np.asarray(np.array(slowest) < limits)


def _smoothed_effort_noise(
    around: SensorDataInputs, names: tuple[str, ...], std: Array, period: float, times: Array
) -> tuple[Array, Array | None]:
    """Noise std (M, k) and correlation (M, k, k) of filtered efforts at `times` (M,).

    An error of the acceleration of one joint, from encoder noise, changes the torques of all inertially coupled joints.
    With the mass matrix M the covariance is diag(s^2) + M diag(a^2) M. The correlation is None without encoder noise.
    """
    joints, encoders = around.recording.joints, around.sensor_usage(JOINT_POSITION_GROUP_NAME)
    assert joints is not None
    # motor currents and encoders have different clocks
    gains = around.effort_filter.noise_gains_of_value_and_rates
    value_gain, second_gain = gains(period)[0], gains(float(np.median(np.diff(joints.t))))[2]
    angle = np.zeros(len(names))
    if is_noise_std_stated(joints, JOINT_POSITION_GROUP_NAME, encoders):
        angle = joint_angle_noise_std(joints, names, encoders, around.recording.name)
    own = (std * value_gain) ** 2
    if not np.any(angle > 0):
        return np.broadcast_to(np.sqrt(own), (len(times), len(names))), None
    measured = joints.position[:, recorded_joint_column_indices(joints, names, around.recording.name)]
    angles = np.stack([np.interp(times, joints.t, column) for column in measured.T], axis=1)
    by_acceleration = around.joint_mass_matrices(names, angles) * (angle * second_gain)
    covariance = by_acceleration @ by_acceleration.transpose(0, 2, 1) + np.diag(own)
    total = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return total, covariance / (total[:, :, None] * total[:, None, :])

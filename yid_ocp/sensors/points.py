"""Sensors of point positions, such as cameras, motion capture, and an arm that measures the point that it holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.errors import ConfigError, DataError, nearest_name_question, unknown_name_error_arguments
from yid_ocp.model.mechanism import Placement
from yid_ocp.model.system import NodeStateSymbols
from yid_ocp.sensors import base
from yid_ocp.sensors.joints import is_point_group_measured_by_arm

_POINTS = base.CHANNEL_KINDS.register("points")(base.RecordedChannelSpec("points", "position", "m", ("x", "y", "z")))


@dataclass(frozen=True)
class PointSensor(base.Sensor):
    """A sensor of the world positions of named frames [m], such as motion capture or a camera."""

    channel = _POINTS
    group_name: str
    point_names: tuple[str, ...]
    frame_names: tuple[str, ...]
    camera_pose_matrix: tuple[tuple[float, ...], ...] | None = None  # 4x4, in the world; None for no camera

    @property
    def channel_names(self) -> tuple[str, ...]:
        return tuple(f"{self.group_name}.{point}" for point in self.point_names)

    @property
    def camera_pose(self) -> Placement | None:
        return None if self.camera_pose_matrix is None else Placement.from_matrix(self.camera_pose_matrix)

    def ideal_reading(self, state: NodeStateSymbols) -> ca.SX:
        return ca.vertcat(*(state.kinematics.frame_position(frame) for frame in self.frame_names))


@base.SENSOR_READERS.register("points")
def _read_point_groups(around: base.SensorDataInputs) -> list[base.SensorData]:
    groups = ((group, around.sensor_usage(group.name)) for group in around.recording.points)
    return [_points(around, group, choice) for group, choice in groups if choice.use is not False]


def _points(
    around: base.SensorDataInputs, group: base.RecordedPointsInterface, choice: base.SensorOptions
) -> base.SensorData:
    where = f"recording '{around.recording.name}': {group.name}"
    wanted = choice.used_points if choice.used_points is not None else group.names
    frames = {p: choice.frame_by_recorded_name.get(p, p) for p in wanted}
    mechanism = around.system.mechanism
    known = tuple(p for p in wanted if mechanism.has_frame(frames[p]))
    if lost := [point for point in wanted if point not in group.names]:
        what = f"recording '{around.recording.name}' has no point '{lost[0]}'"
        unused = [name for name in group.names if name not in wanted]
        hint = nearest_name_question(lost[0], unused) or "remove it from this list."
        hint += " `simulate` writes the points of its own list only"
        raise DataError(what, where=f"sensors.{group.name}.used_points", allowed=", ".join(group.names), hint=hint)
    for point in wanted:
        # points listed by name are used
        if point not in known and (choice.used_points is not None or point in choice.frame_by_recorded_name):
            what = f"the point '{point}' belongs to the frame '{frames[point]}', which the model does not have"
            hint = f"set frame_by_recorded_name: {{{point}: FRAME}}"
            said = unknown_name_error_arguments(frames[point], mechanism.frames, hint)
            raise DataError(what, where=f"sensors.{group.name}", **said)
    if not known:
        what = f"no recorded point ({', '.join(wanted)}) has the name of a frame of the model"
        own, point = f"sensors.{group.name}", ", ".join(wanted[:1])
        hint = f"set {own}.frame_by_recorded_name: {{{point}: FRAME}} or {own}.use: false"
        listed = unknown_name_error_arguments("", around.system.point_frames or mechanism.frames)["allowed"]
        allowed = f"{listed}, or a location along a segment, such as SEGMENT:40%"
        raise DataError(what, where=where, allowed=allowed, hint=hint)
    columns = [group.names.index(point) for point in known]
    inside = (group.t >= around.node_times[0] - 1e-9) & (group.t <= around.node_times[-1] + 1e-9)
    value = group.position[inside][:, columns].reshape(int(inside.sum()), 3 * len(columns))
    if isinstance(choice.std, Mapping):
        what, hint = "a point group has one standard deviation for all points, but several are set", "set one number"
        raise ConfigError(what, where=f"sensors.{group.name}.std", allowed="one number above 0 [m]", hint=hint)
    if choice.std is not None:
        std = np.full(value.shape, float(choice.std))
    elif group.std is not None:
        std = group.std[inside][:, columns].reshape(value.shape)
    else:
        raise base.missing_noise_level_error(f"group '{group.name}'", where, group.name, "m")
    sensor = PointSensor(group.name, known, tuple(frames[p] for p in known), camera_pose_of_point_group(group))
    change = _clock_offset_std(around, sensor, group, choice) * _rates(group.t[inside], value)
    return base.SensorData(sensor, group.t[inside], value, std, change_by_clock=change if np.any(change) else None)


def _clock_offset_std(
    around: base.SensorDataInputs, sensor: PointSensor, group: base.RecordedPointsInterface, choice: base.SensorOptions
) -> float:
    """Standard deviation [s] of the clock's offset: stated, recorded, else half a sample or (clock not free) zero."""
    stated = group.clock_offset_std if choice.clock_offset_std is None else choice.clock_offset_std
    if stated is not None:
        return stated
    seen = [(channel, sensor.camera_pose is not None) for channel in sensor.channel_names]
    late = (effect.added_channel_delay(*own) for effect in around.system.effects for own in seen)
    own = is_point_group_measured_by_arm(group) or around.recording.joints is None or not around.has_uncertain_clocks
    if own or not all(ca.SX(delay).is_zero() for delay in late):
        return 0.0
    return 0.5 * float(np.median(np.diff(group.t))) if len(group.t) > 1 else 0.0


def _rates(t: Array, values: Array) -> Array:
    """Rates of change (M, k) [1/s] of outputs, by central differences of the measurements. Zero if not measured."""
    rates = np.zeros(values.shape)
    for column, rate in zip(values.T, rates.T, strict=True):
        if np.count_nonzero(seen := np.isfinite(column)) > 1:
            rate[seen] = np.gradient(column[seen], t[seen])
    return rates


def camera_pose_of_point_group(group: base.RecordedPointsInterface) -> tuple[tuple[float, ...], ...] | None:
    """Return the pose (4, 4) of the camera that measured a point group. None if no camera measured it.

    A group was measured by a camera if it has a pose, or `camera` in its name or sensor. Default pose: the world's.
    """
    if group.camera_pose is not None:
        return tuple(tuple(float(x) for x in row) for row in group.camera_pose)
    if "camera" in group.name.lower() or "camera" in group.sensor_name.lower():
        return tuple(tuple(row) for row in np.eye(4).tolist())
    return None

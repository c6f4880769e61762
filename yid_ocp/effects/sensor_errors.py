"""Errors of cameras, clocks, wrist sensors and inertial units.

A group of points belongs to a camera if its sensor has a pose. Recorded points are in the world frame, and so are the
offsets and rotations here. Of the camera's pose, only position and viewing direction matter.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from yid_ocp.effects.base import EFFECTS, EffectBase, ParameterDefinition, moving_frame_names, segment_name_of_frame
from yid_ocp.model.mechanism import Placement, symbolic_rotation_from_rpy
from yid_ocp.model.system import NodeStateSymbols, System


def _camera(system: System) -> tuple[str, ...]:
    return ("camera",)


class _CameraEffect(EffectBase):
    """The base class of errors of points that cameras see. Readings of other sensors are unchanged."""

    required_excitation = "the camera's pose"
    required_sensors = frozenset({"camera"})
    possible_locations = _camera

    def _seen(self, point: ca.SX, camera: Placement, state: NodeStateSymbols) -> ca.SX:
        return point

    def reading_from_true_value(self, channel: str, output: ca.SX, state: NodeStateSymbols) -> ca.SX:
        return output if state.camera_pose is None else self._seen(output, state.camera_pose, state)


@EFFECTS.register("camera_translation")
class _CameraTranslation(_CameraEffect):
    """Constant offset of seen points along the world's axes: seen = true + (x, y, z)."""

    equation = "seen point = true + (x, y, z)"
    declared_parameters = tuple(
        ParameterDefinition(axis, "m", 0.0, -0.3, 0.3, (-0.03, 0.03), f"seen minus true {axis}") for axis in "xyz"
    )

    def _seen(self, point: ca.SX, camera: Placement, state: NodeStateSymbols) -> ca.SX:
        return point + ca.vertcat(self["x"], self["y"], self["z"])


@EFFECTS.register("camera_rotation")
class _CameraRotation(_CameraEffect):
    """Rotation of the seen points about the camera's origin by Rz(rz) Ry(ry) Rx(rx), in world axes."""

    equation = "seen point = c + R (true - c)"
    declared_parameters = tuple(
        ParameterDefinition(f"r{axis}", "rad", 0.0, -0.5, 0.5, (-0.06, 0.06), f"turn about {axis}") for axis in "xyz"
    )

    def _seen(self, point: ca.SX, camera: Placement, state: NodeStateSymbols) -> ca.SX:
        turn = symbolic_rotation_from_rpy(self["rx"], self["ry"], self["rz"])
        return camera.translation + turn @ (point - camera.translation)


@EFFECTS.register("camera_scale")
class _CameraScale(_CameraEffect):
    """Depth error: the vector from the camera to a point is scaled. The pixel of the point does not change."""

    equation = "seen point = c + scale (true - c)"
    declared_parameters = (ParameterDefinition("scale", "1", 1.0, 0.8, 1.2, (0.97, 1.03), "seen over true depth"),)

    def _seen(self, point: ca.SX, camera: Placement, state: NodeStateSymbols) -> ca.SX:
        return camera.translation + self["scale"] * (point - camera.translation)


@EFFECTS.register("surface_offset")
class _SurfaceOffset(_CameraEffect):
    """The camera sees the near surface: the seen point is a fraction of the tube's radius nearer than the axis."""

    equation = "seen point = true + fraction r (c - true)/|c - true|"
    possible_locations = lambda system: ("camera",) if system.segment_layouts else ()
    declared_parameters = (
        ParameterDefinition("fraction", "1", 0.0, 0.0, 1.5, (0.0, 1.0), "shift toward the camera over the radius"),
    )

    def _seen(self, point: ca.SX, camera: Placement, state: NodeStateSymbols) -> ca.SX:
        segment = None if state.marked_frame is None else segment_name_of_frame(state.system, state.marked_frame)
        if segment is None:
            return point
        ray = camera.translation - point
        return point + self["fraction"] * state.system.find_segment_layout(segment).radius * ray / ca.norm_2(ray)


@EFFECTS.register("camera_latency")
class _CameraLatency(_CameraEffect):
    """Latency of seen points, seen(t) = true(t - delay), of all cameras or of one group of points (by name).

    A negative delay of a group means that the joints' clock is late.
    """

    equation = "seen point(t) = true point(t - delay)"
    required_excitation = "the rate of its readings"
    required_sensors = frozenset()
    is_at_point_groups = True
    declared_parameters = (ParameterDefinition("delay", "s", 0.0, 0.0, 0.5, (0.0, 0.15), "delay of the seen points"),)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        own = cls.declared_parameters
        return own if location == "camera" else tuple(replace(d, lower=-0.2, prior_range=(-0.05, 0.15)) for d in own)

    def added_channel_delay(self, channel: str, camera: bool) -> ca.SX:
        is_late = camera if self.location == "camera" else channel.partition(".")[0] == self.location
        return self["delay"] if is_late else ca.SX(0)


@EFFECTS.register("clock_scale")
class _ClockScale(EffectBase):
    """Scale error of a nominal clock: recorded time = true time x scale."""

    equation = "recorded time = true x scale"
    required_excitation = "the rate of its readings"
    required_sensors = frozenset({"nominal_clock"})
    possible_locations = lambda system: ("clock",)
    declared_parameters = (ParameterDefinition("scale", "1", 1.0, 0.7, 1.4, (0.9, 1.1), "recorded over true time"),)

    def apply_to_system(self, system: System) -> System:
        return replace(system, recorded_time_scale=system.recorded_time_scale / self["scale"])


_MOUNTED_COMPONENTS = {
    "wrist": (("force", "N", 200.0, 5.0), ("torque", "N m", 20.0, 0.5)),
    "imu": (("angular_velocity", "rad/s", 1.0, 0.05), ("specific_force", "m/s^2", 10.0, 0.5)),
}
"""By group of a recording: quantity, unit, bound and expected size of a bias."""


class _MountedSensorEffect(EffectBase):
    """The base class of errors of a wrist sensor or an inertial unit, at the location `wrist:FRAME` or `imu:FRAME`."""

    required_excitation = "the orientation to gravity"
    is_at_recorded_sensor = True
    is_local = True
    possible_locations = lambda system: [f"{g}:{f}" for g in _MOUNTED_COMPONENTS for f in moving_frame_names(system)]

    def _read(self, quantity: str, output: ca.SX) -> ca.SX:
        return output

    def reading_from_true_value(self, channel: str, output: ca.SX, state: NodeStateSymbols) -> ca.SX:
        group, _, frame = self.location.partition(":")
        if state.marked_frame != frame or not channel.startswith((f"{group}.", f"{group}_")):
            return output
        quantity = next((q for q, *_ in _MOUNTED_COMPONENTS[group] if f".{q}." in channel), None)
        return output if quantity is None else self._read(quantity, output)


@EFFECTS.register("sensor_bias")
class _SensorBias(_MountedSensorEffect):
    """Constant error of each component of a wrist sensor or an inertial unit, along the axes of its frame."""

    equation = "measured component = true + bias"

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definitions of the bias of each component, such as `force_x` [N] or `specific_force_x` [m/s^2]."""
        return tuple(
            ParameterDefinition(f"{quantity}_{axis}", unit, 0.0, -most, most, (-usual, usual), "measured minus true")
            for quantity, unit, most, usual in _MOUNTED_COMPONENTS[location.partition(":")[0]]
            for axis in "xyz"
        )

    def _read(self, quantity: str, output: ca.SX) -> ca.SX:
        return output + ca.vertcat(*(self[f"{quantity}_{axis}"] for axis in "xyz"))


@EFFECTS.register("sensor_scale")
class _SensorScale(_MountedSensorEffect):
    """Scale factor on all readings of a wrist sensor or an inertial unit."""

    equation = "measured = scale x true"
    required_excitation = "the force at its ends"
    declared_parameters = (ParameterDefinition("scale", "1", 1.0, 0.5, 2.0, (0.9, 1.1), "measured over true"),)

    def _read(self, quantity: str, output: ca.SX) -> ca.SX:
        return self["scale"] * output

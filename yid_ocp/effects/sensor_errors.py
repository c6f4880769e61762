"""Errors of encoders, cameras and clocks.

A group of points is a camera's when its sensor has a pose. Points stand in the world frame in a recording, and so do
offsets and turns here; only the camera's place and where it looks matter of its pose.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import casadi as ca

from yid_ocp.effects.base import EFFECTS, EffectBase, ParameterDefinition, robot_joints, segment_of_frame
from yid_ocp.model.rotations import symbolic_rotation_from_rpy
from yid_ocp.model.system import NodeState, System

_CAMERA_SENSOR = frozenset({"camera"})


@EFFECTS.register("encoder_offset")
class EncoderOffset(EffectBase):
    """Measured angle = true angle + offset.

    The model's coordinate stays the true angle: prescribed paths, start postures and what a tracking filter follows are
    the readings less the offset.
    """

    equation = "measured angle = true + offset"
    required_excitation = "how it stands against gravity"
    required_sensors: ClassVar[frozenset[str]] = frozenset({"joints.position"})

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of arm joints that are driven or prescribed."""
        known = {*system.driven, *system.prescribed}
        return tuple(name for name in robot_joints(system) if name in known)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of the offset, measured minus true angle [rad]."""
        return (ParameterDefinition("offset", "rad", 0.0, -0.3, 0.3, (-0.035, 0.035), "measured less true angle"),)

    def distorted_reading(self, channel: str, output: ca.SX, state: NodeState) -> ca.SX:
        """The recorded angle: the true angle plus the offset."""
        return output + self["offset"] if channel == f"joints.position.{self.location}" else output

    def corrected_reading(self, channel: str, reading: ca.SX, effort: ca.SX) -> ca.SX:
        """The true angle: the recorded angle minus the offset."""
        return reading - self["offset"] if channel == f"joints.position.{self.location}" else reading


@EFFECTS.register("camera_translation")
class CameraTranslation(EffectBase):
    """Constant offset of seen points: seen = true + (x, y, z), along the world's axes."""

    equation = "seen point = true + (x, y, z)"
    required_excitation = "where the camera stands"
    required_sensors: ClassVar[frozenset[str]] = _CAMERA_SENSOR

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """`camera`, where the system has points."""
        return _camera(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definitions of the offsets x, y and z, seen minus true [m]."""
        return tuple(
            ParameterDefinition(axis, "m", 0.0, -0.3, 0.3, (-0.03, 0.03), f"seen less true {axis}") for axis in "xyz"
        )

    def distorted_reading(self, channel: str, output: ca.SX, state: NodeState) -> ca.SX:
        """The seen point: the true point plus (x, y, z); other sensors' readings are unchanged."""
        return output if state.camera_pose is None else output + ca.vertcat(*(self[axis] for axis in "xyz"))


@EFFECTS.register("camera_rotation")
class CameraRotation(EffectBase):
    """Seen points rotated about the camera's origin by Rz(rz) Ry(ry) Rx(rx), in the world's axes."""

    equation = "seen point = c + R (true - c)"
    required_excitation = "where the camera stands"
    required_sensors: ClassVar[frozenset[str]] = _CAMERA_SENSOR

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """`camera`, where the system has points."""
        return _camera(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definitions of the angles rx, ry and rz [rad]."""
        return tuple(
            ParameterDefinition(f"r{axis}", "rad", 0.0, -0.5, 0.5, (-0.06, 0.06), f"turn about {axis}")
            for axis in "xyz"
        )

    def distorted_reading(self, channel: str, output: ca.SX, state: NodeState) -> ca.SX:
        """The true point rotated about the camera's origin; other sensors' readings are unchanged."""
        if state.camera_pose is None:
            return output
        turn = symbolic_rotation_from_rpy(self["rx"], self["ry"], self["rz"])
        return state.camera_pose.translation + turn @ (output - state.camera_pose.translation)


@EFFECTS.register("camera_scale")
class CameraScale(EffectBase):
    """Depth error: the vector from the camera to the seen point is scaled, so that its pixel stays."""

    equation = "seen point = c + scale (true - c)"
    required_excitation = "where the camera stands"
    required_sensors: ClassVar[frozenset[str]] = _CAMERA_SENSOR

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """`camera`, where the system has points."""
        return _camera(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of scale, seen over true depth [1]."""
        return (ParameterDefinition("scale", "1", 1.0, 0.8, 1.2, (0.97, 1.03), "seen over true depth"),)

    def distorted_reading(self, channel: str, output: ca.SX, state: NodeState) -> ca.SX:
        """The point with its scaled vector from the camera; other sensors' readings are unchanged."""
        if state.camera_pose is None:
            return output
        return state.camera_pose.translation + self["scale"] * (output - state.camera_pose.translation)


@EFFECTS.register("camera_latency")
class CameraLatency(EffectBase):
    """Seen points are late: seen(t) = true(t - delay)."""

    equation = "seen point(t) = true point(t - delay)"
    required_excitation = "when it is read"
    required_sensors: ClassVar[frozenset[str]] = _CAMERA_SENSOR

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """`camera`, where the system has points."""
        return _camera(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of the delay of seen points [s]."""
        return (ParameterDefinition("delay", "s", 0.0, 0.0, 0.5, (0.0, 0.15), "how long ago the point was there"),)

    def added_delay(self, channel: str, camera: bool) -> ca.SX:
        """The delay for cameras, zero for other sensors [s]."""
        return self["delay"] if camera else ca.SX(0)


@EFFECTS.register("surface_offset")
class SurfaceOffset(EffectBase):
    """The camera sees the near surface: a fraction of the tube's radius from its axis towards the camera."""

    equation = "seen point = true + fraction r (c - true)/|c - true|"
    required_excitation = "where the camera stands"
    required_sensors: ClassVar[frozenset[str]] = _CAMERA_SENSOR

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """`camera`, where the system has points and segments."""
        return _camera(system) if system.segment_layouts else ()

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of fraction, distance from the tube's axis over its radius [1]."""
        return (
            ParameterDefinition("fraction", "1", 0.0, 0.0, 1.5, (0.0, 1.0), "distance from the axis over the radius"),
        )

    def distorted_reading(self, channel: str, output: ca.SX, state: NodeState) -> ca.SX:
        """The point shifted towards the camera by a fraction of the tube's radius; others are unchanged."""
        segment = None if state.marked_frame is None else segment_of_frame(state.system, state.marked_frame)
        if state.camera_pose is None or segment is None:
            return output
        ray = state.camera_pose.translation - output
        return output + self["fraction"] * state.system.segment_layout(segment).radius * ray / ca.norm_2(ray)


@EFFECTS.register("clock_scale")
class ClockScale(EffectBase):
    """Recorded time = true time x scale, for a recording with a nominal clock."""

    equation = "recorded time = true x scale"
    required_excitation = "when it is read"
    required_sensors: ClassVar[frozenset[str]] = frozenset({"nominal_clock"})

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """`clock`."""
        return ("clock",)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of scale, recorded over true time [1]."""
        return (ParameterDefinition("scale", "1", 1.0, 0.7, 1.4, (0.9, 1.1), "recorded over true time"),)

    def apply_to_system(self, system: System) -> System:
        """The system with its time step divided by scale."""
        return replace(system, recorded_time_scale=system.recorded_time_scale / self["scale"])


def _camera(system: System) -> tuple[str, ...]:
    return ("camera",) if system.point_frames else ()

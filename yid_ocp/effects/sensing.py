"""Encoders, cameras and clocks that read something else than what is.

A group of points is a camera's when its sensor has a pose. Points stand in the world frame in a recording, and so do
offsets and turns here; only the camera's place and where it looks matter of its pose.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import casadi as ca

from yid_ocp.effects.base import EFFECTS, EffectBase, Quantity, robot_joints, segment_of_frame, small_rotation
from yid_ocp.model.system import NodeState, System

CAMERA = frozenset({"camera"})


@EFFECTS.register("encoder_offset")
class EncoderOffset(EffectBase):
    """Measured angle = true angle + offset.

    The model's coordinate stays the true angle: prescribed paths, start postures and what a tracking filter follows are
    the readings less the offset.
    """

    equation = "measured angle = true + offset"
    depends_on = "how it stands against gravity"
    needs: ClassVar[frozenset[str]] = frozenset({"joints.position"})

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """Arm joints that are driven or prescribed."""
        known = {*system.driven, *system.prescribed}
        return tuple(name for name in robot_joints(system) if name in known)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """Offset [rad]."""
        return (Quantity("offset", "rad", 0.0, -0.3, 0.3, (-0.035, 0.035), "measured less true angle"),)

    def measure(self, channel: str, output: ca.SX, state: NodeState) -> ca.SX:
        """See the class."""
        return output + self["offset"] if channel == f"joints.position.{self.location}" else output

    def correct(self, channel: str, reading: ca.SX, effort: ca.SX) -> ca.SX:
        """See the class."""
        return reading - self["offset"] if channel == f"joints.position.{self.location}" else reading


@EFFECTS.register("camera_translation")
class CameraTranslation(EffectBase):
    """Seen point = true point + (x, y, z), along the world's axes."""

    equation = "seen point = true + (x, y, z)"
    depends_on = "where the camera stands"
    needs: ClassVar[frozenset[str]] = CAMERA

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """`camera`."""
        return _camera(system)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """x, y, z [m]."""
        return tuple(Quantity(axis, "m", 0.0, -0.3, 0.3, (-0.03, 0.03), f"seen less true {axis}") for axis in "xyz")

    def measure(self, channel: str, output: ca.SX, state: NodeState) -> ca.SX:
        """See the class."""
        return output if state.camera is None else output + ca.vertcat(*(self[axis] for axis in "xyz"))


@EFFECTS.register("camera_rotation")
class CameraRotation(EffectBase):
    """Seen point = true point turned about the camera's origin, by Rz(rz) Ry(ry) Rx(rx) in the world's axes."""

    equation = "seen point = c + R (true - c)"
    depends_on = "where the camera stands"
    needs: ClassVar[frozenset[str]] = CAMERA

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """`camera`."""
        return _camera(system)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """Rx, ry, rz [rad]."""
        return tuple(Quantity(f"r{axis}", "rad", 0.0, -0.5, 0.5, (-0.06, 0.06), f"turn about {axis}") for axis in "xyz")

    def measure(self, channel: str, output: ca.SX, state: NodeState) -> ca.SX:
        """See the class."""
        if state.camera is None:
            return output
        turn = small_rotation(self["rx"], self["ry"], self["rz"])
        return state.camera.translation + turn @ (output - state.camera.translation)


@EFFECTS.register("camera_scale")
class CameraScale(EffectBase):
    """Depth times scale: a pixel's ray stays, so that the whole vector from the camera to the point is scaled."""

    equation = "seen point = c + scale (true - c)"
    depends_on = "where the camera stands"
    needs: ClassVar[frozenset[str]] = CAMERA

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """`camera`."""
        return _camera(system)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """Scale [1]."""
        return (Quantity("scale", "1", 1.0, 0.8, 1.2, (0.97, 1.03), "seen over true depth"),)

    def measure(self, channel: str, output: ca.SX, state: NodeState) -> ca.SX:
        """See the class."""
        if state.camera is None:
            return output
        return state.camera.translation + self["scale"] * (output - state.camera.translation)


@EFFECTS.register("camera_latency")
class CameraLatency(EffectBase):
    """Seen point = where it was delay ago."""

    equation = "seen point(t) = true point(t - delay)"
    depends_on = "when it is read"
    needs: ClassVar[frozenset[str]] = CAMERA

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """`camera`."""
        return _camera(system)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """Delay [s]."""
        return (Quantity("delay", "s", 0.0, 0.0, 0.5, (0.0, 0.15), "how long ago the point was there"),)

    def delay(self, channel: str, camera: bool) -> ca.SX:
        """See the class."""
        return self["delay"] if camera else ca.SX(0)


@EFFECTS.register("surface_offset")
class SurfaceOffset(EffectBase):
    """The camera sees the near surface: a fraction of the tube's radius from its axis towards the camera."""

    equation = "seen point = true + fraction r (c - true)/|c - true|"
    depends_on = "where the camera stands"
    needs: ClassVar[frozenset[str]] = CAMERA

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """`camera`."""
        return _camera(system) if system.segments else ()

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """Fraction [1]."""
        return (Quantity("fraction", "1", 0.0, 0.0, 1.5, (0.0, 1.0), "distance from the axis over the radius"),)

    def measure(self, channel: str, output: ca.SX, state: NodeState) -> ca.SX:
        """See the class."""
        segment = None if state.frame is None else segment_of_frame(state.system, state.frame)
        if state.camera is None or segment is None:
            return output
        ray = state.camera.translation - output
        return output + self["fraction"] * state.system.segment(segment).radius * ray / ca.norm_2(ray)


@EFFECTS.register("clock_scale")
class ClockScale(EffectBase):
    """Recorded time = true time x scale, for a recording whose clock is only nominal."""

    equation = "recorded time = true x scale"
    depends_on = "when it is read"
    needs: ClassVar[frozenset[str]] = frozenset({"nominal_clock"})

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """`clock`."""
        return ("clock",)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """Scale [1]."""
        return (Quantity("scale", "1", 1.0, 0.7, 1.4, (0.9, 1.1), "recorded over true time"),)

    def modify(self, system: System) -> System:
        """See the class."""
        return replace(system, time_scale=system.time_scale / self["scale"])


def _camera(system: System) -> tuple[str, ...]:
    return ("camera",) if system.points else ()

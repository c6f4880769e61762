"""Sensors that see points: a camera, motion capture, or the arm that holds the point."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from yid_ocp.model.mechanism import Placement
from yid_ocp.model.system import NodeState


@dataclass(frozen=True)
class PointSensor:
    """Positions of named frames in the world.

    Attributes
    ----------
    group : str
        The recording's group, `points_camera` for example.
    points : tuple of str
        Names in the recording.
    frames : tuple of str
        Frames of the mechanism that they mark.
    pose : tuple of tuple of float, optional
        4x4 pose of the camera in the world; None for a sensor that is no camera.
    """

    group: str
    points: tuple[str, ...]
    frames: tuple[str, ...]
    pose: tuple[tuple[float, ...], ...] | None = None

    @property
    def channels(self) -> tuple[str, ...]:
        """`group.point` for every point."""
        return tuple(f"{self.group}.{point}" for point in self.points)

    @property
    def unit(self) -> str:
        """Metres."""
        return "m"

    @property
    def width(self) -> int:
        """Three coordinates."""
        return 3

    @property
    def camera(self) -> Placement | None:
        """Pose of the camera."""
        return None if self.pose is None else Placement.of(self.pose)

    def output(self, state: NodeState) -> ca.SX:
        """Positions one below the other, shape (3 np, 1) [m]."""
        return ca.vertcat(*(state.kinematics.position(frame) for frame in self.frames))

"""What is common to all frames of a sequence: where the camera stands, how long its metre is, and its clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yid_ocp.vision.clock import Clock, ClockOptions, estimate_clock
from yid_ocp.vision.filters import Cloud
from yid_ocp.vision.meshes import Surfaces

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Calibration:
    """The camera of a sequence.

    Attributes
    ----------
    pose : ndarray, shape (4, 4)
        Camera in the world.
    scale : float
        Factor on the camera's points.
    clock : Clock
    """

    pose: Array
    scale: float
    clock: Clock

    def world(self, points: Array) -> Array:
        """Points of the camera's frame in the world, both shape (N, 3) [m]."""
        return points @ (self.scale * self.pose[:3, :3]).T + self.pose[:3, 3]

    @property
    def camera(self) -> Array:
        """The camera's position, shape (3,) [m]."""
        return self.pose[:3, 3]


def as_given(pose: Array, options: ClockOptions, reason: str = "") -> Calibration:
    """The camera as the frames and the settings have it, where nothing can be estimated for a reason."""
    text = f"clock offset {1e3 * options.offset:.0f} ms as given" + (f": {reason}" if reason else "")
    return Calibration(pose, 1.0, Clock(options.offset, math.inf, False, np.zeros(3), 0.0, text))


def calibrate(
    robot: Surfaces | None,
    clouds: Sequence[Cloud],
    stamps: Array,
    pose: Array,
    posture: Callable[[float], Array],
    rng: np.random.Generator,
    options: ClockOptions,
) -> Calibration:
    """Estimate what is common to a sequence from some of its frames.

    Parameters
    ----------
    robot : Surfaces or None
        None where there is no robot, or nothing is known of its motion.
    clouds : sequence of Cloud
        In the world by the given pose, the robot's points among them.
    stamps : ndarray, shape (M,)
        [s]
    pose : ndarray, shape (4, 4)
        Camera in the world, as far as known.
    posture : callable
        From a time on the joints' clock to a configuration.
    rng : Generator
    options : ClockOptions

    Returns
    -------
    Calibration
    """
    if robot is None:
        return as_given(pose, options, "no robot to compare")
    return Calibration(pose, 1.0, estimate_clock(robot, clouds, stamps, posture, rng, options))

"""Brief unmodelled disturbances in MuJoCo: force pulses and temporary springs at one coordinate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class ForcePulse:
    """A force pulse on one coordinate: size sin^2(pi (t - begin)/(end - begin)).

    Attributes
    ----------
    joint : str
    start_time, end_time : float
        Since the motion's beginning [s].
    peak_force : float
        Largest value [N m or N].
    """

    joint: str
    start_time: float
    end_time: float
    peak_force: float

    @property
    def impulse(self) -> float:
        """Integral of the force over time [N m s or N s]."""
        return self.peak_force * (self.end_time - self.start_time) / 2


@dataclass(frozen=True)
class SnagSpring:
    """A temporary spring that holds one coordinate at its value when the spring sets in.

    Attributes
    ----------
    joint : str
    start_time, end_time : float
        Since the motion's beginning [s].
    stiffness : float
        [N m/rad or N/m]
    """

    joint: str
    start_time: float
    end_time: float
    stiffness: float


class DisturbanceTerms:
    """Disturbances as simulator terms (`mujoco_simulation.SimulatorTerms`).

    Parameters
    ----------
    force_pulses : sequence of Push
    snag_springs : sequence of Snag
    """

    def __init__(self, pushes: Sequence[ForcePulse] = (), snags: Sequence[SnagSpring] = ()) -> None:
        self.force_pulses, self.snag_springs = tuple(pushes), tuple(snags)
        self._start = 0.0
        self._caught: dict[SnagSpring, float] = {}

    def edit_model(self, model: Any) -> None:
        """Leave the model unchanged."""

    def start_motion(self, data: Any) -> None:
        """Set the time origin of all disturbances."""
        self._start = float(data.time)
        self._caught = {}

    def add_forces(self, model: Any, data: Any) -> None:
        """Add the forces acting now to `data.qfrc_passive`."""
        t = float(data.time) - self._start
        for push in self.force_pulses:
            if push.start_time < t < push.end_time:
                wave = math.sin(math.pi * (t - push.start_time) / (push.end_time - push.start_time)) ** 2
                data.qfrc_passive[model.joint(push.joint).id] += push.peak_force * wave
        for snag in self.snag_springs:
            if snag.start_time < t < snag.end_time:
                at = model.joint(snag.joint).id
                caught = self._caught.setdefault(snag, float(data.qpos[at]))
                data.qfrc_passive[at] -= snag.stiffness * (float(data.qpos[at]) - caught)

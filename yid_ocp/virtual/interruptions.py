"""Brief unmodelled disturbances in MuJoCo: force pulses and temporary springs at one coordinate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Push:
    """A force pulse on one coordinate: size sin^2(pi (t - begin)/(end - begin)).

    Attributes
    ----------
    joint : str
    begin, end : float
        Since the motion's beginning [s].
    size : float
        Largest value [N m or N].
    """

    joint: str
    begin: float
    end: float
    size: float

    @property
    def impulse(self) -> float:
        """Integral of the force over time [N m s or N s]."""
        return self.size * (self.end - self.begin) / 2


@dataclass(frozen=True)
class Snag:
    """A temporary spring that holds one coordinate at its value when the spring sets in.

    Attributes
    ----------
    joint : str
    begin, end : float
        Since the motion's beginning [s].
    stiffness : float
        [N m/rad or N/m]
    """

    joint: str
    begin: float
    end: float
    stiffness: float


class Interruptions:
    """Disturbances as simulator terms (`engine.EngineTerms`).

    Parameters
    ----------
    pushes : sequence of Push
    snags : sequence of Snag
    """

    def __init__(self, pushes: Sequence[Push] = (), snags: Sequence[Snag] = ()) -> None:
        self.pushes, self.snags = tuple(pushes), tuple(snags)
        self._start = 0.0
        self._caught: dict[Snag, float] = {}

    def prepare(self, model: Any) -> None:
        """Leave the model unchanged."""

    def begin(self, data: Any) -> None:
        """Set the time origin of all disturbances."""
        self._start = float(data.time)
        self._caught = {}

    def force(self, model: Any, data: Any) -> None:
        """Add the forces acting now to `data.qfrc_passive`."""
        t = float(data.time) - self._start
        for push in self.pushes:
            if push.begin < t < push.end:
                wave = math.sin(math.pi * (t - push.begin) / (push.end - push.begin)) ** 2
                data.qfrc_passive[model.joint(push.joint).id] += push.size * wave
        for snag in self.snags:
            if snag.begin < t < snag.end:
                at = model.joint(snag.joint).id
                caught = self._caught.setdefault(snag, float(data.qpos[at]))
                data.qfrc_passive[at] -= snag.stiffness * (float(data.qpos[at]) - caught)

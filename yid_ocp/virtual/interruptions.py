"""Pushes and snags in MuJoCo: what happens once, for a short time, and is in nobody's model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Push:
    """A force on one coordinate: size sin^2(pi (t - begin)/(end - begin)).

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
        """Its integral over time [N m s or N s]."""
        return self.size * (self.end - self.begin) / 2


@dataclass(frozen=True)
class Snag:
    """Something that holds one coordinate where it was caught, by a spring that is there for a while.

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
    """Pushes and snags as terms of the simulator; see `engine.EngineTerms`.

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
        """Nothing of the model changes."""

    def begin(self, data: Any) -> None:
        """Times count from here."""
        self._start = float(data.time)
        self._caught = {}

    def force(self, model: Any, data: Any) -> None:
        """Add what acts now to `data.qfrc_passive`."""
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

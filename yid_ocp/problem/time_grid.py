"""Time grid of a rollout."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.data.recording import Recording
from yid_ocp.errors import DataError

Array = NDArray[np.float64]


_MAX_STEPS = 200_000
"""Steps of a rollout: half an hour in steps of 10 ms; a clock in milliseconds or one that jumps asks for more."""

_MAX_STEPS_PER_SAMPLE = 500
"""Steps from one sample to the next, on average; a clock in milliseconds read as seconds asks for a thousand."""


@dataclass(frozen=True)
class TimeGrid:
    """Uniform time grid of a rollout: t_k = start + k time_step, k = 0..steps."""

    start_time: float
    time_step: float
    steps: int

    @property
    def node_times(self) -> Array:
        """Times of all nodes, shape (steps + 1,) [s]."""
        return np.asarray(self.start_time + self.time_step * np.arange(self.steps + 1), dtype=float)

    def node_and_fraction(self, t: ArrayLike) -> tuple[NDArray[np.int64], Array]:
        """Return the node before each time and the fraction of a step after it, to within 1e-6 of a step."""
        position = (np.asarray(t, float) - self.start_time) / self.time_step
        near = np.rint(position)
        position = np.where(np.abs(position - near) < 1e-6, near, position)
        node = np.clip(np.floor(position).astype(np.int64), 0, self.steps - 1)
        return node, position - node


def make_time_grid(recording: Recording, time_step: float, duration: float | None = None) -> TimeGrid:
    """Time grid that covers the recording's joint samples, or its first group of points where it has no joints.

    Raises
    ------
    DataError
        The recording is shorter than two steps, or longer than `_MAX_STEPS`, or has too few samples for its length.
    """
    t = recording.joints.t if recording.joints is not None else recording.points[0].t
    span = float(t[-1] - t[0]) if duration is None else min(duration, float(t[-1] - t[0]))
    steps = math.floor(span / time_step + 1e-6)
    if steps > _MAX_STEPS or steps > _MAX_STEPS_PER_SAMPLE * len(t):
        raise DataError(
            f"{span:.3g} s of data, {len(t)} samples, are {steps:.3g} time steps of {time_step:g} s",
            where=recording.name,
            allowed=f"at most {_MAX_STEPS}, and {_MAX_STEPS_PER_SAMPLE} from one sample to the next",
            hint="see whether times are in seconds and the clock does not jump; else cut the recording",
        )
    if steps < 2:
        raise DataError(
            f"{span:.3g} s of data are shorter than two time steps of {time_step:g} s",
            where=recording.name,
            hint="record longer, or choose a smaller time step",
        )
    return TimeGrid(float(t[0]), time_step, steps)

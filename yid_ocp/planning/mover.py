"""The system moved along joint paths: rollouts and their derivatives by the unknowns of the splines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.rollout import simulate
from yid_ocp.integrator.statics import Rest, Statics
from yid_ocp.integrator.step import Step
from yid_ocp.integrator.step_model import Directions, Rollout
from yid_ocp.planning.path import SplinePath

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Mover:
    """A system at rest whose prescribed joints are to move.

    Attributes
    ----------
    step : Step
        Every joint that moves is prescribed; nothing is driven.
    theta : ndarray, shape (ntheta,)
    start : Rest
        From which the motion begins.
    path : SplinePath
    settle : float
        How long the joints stand still in the end [s].
    """

    step: Step
    theta: Array
    start: Rest
    path: SplinePath
    settle: float

    @property
    def joints(self) -> list[int]:
        """Coordinates that are moved."""
        return list(self.step.system.prescribed_indices)

    @property
    def first(self) -> Array:
        """Where they start, shape (nc,)."""
        return np.asarray(self.start.state[self.joints])

    @cached_property
    def times(self) -> Array:
        """Nodes, shape (N + 1,) [s]."""
        moving = round(self.path.duration / self.step.time_step)
        standing = max(1, round(self.settle / self.step.time_step))
        return np.asarray(self.step.time_step * np.arange(moving + standing + 1))

    @cached_property
    def standing(self) -> NDArray[np.int64]:
        """Nodes at which the joints stand still in the end."""
        return np.flatnonzero(self.times >= self.path.duration - 1e-9)

    @cached_property
    def _basis(self) -> Array:
        return self.path.basis(self.times)

    def positions(self, w: Array) -> Array:
        """Moved joints at the nodes, shape (N + 1, nc), of unknowns (K, nc)."""
        return self.first + self._basis @ w

    def roll(self, w: Array, slopes: bool = False, names: Sequence[str] = ()) -> Rollout:
        """The motion of unknowns (K, nc); with derivatives by named parameters, then by the unknowns, row by row."""
        directions = None
        if slopes or names:
            size = w.size if slopes else 0
            nodes, nc = len(self.times), len(self.joints)
            by_path = np.zeros((nodes, nc, len(names) + size))
            start = np.zeros((len(self.start.state), len(names) + size))
            if slopes:
                by_path[:, :, len(names) :] = np.einsum("tk,ji->tjki", self._basis, np.eye(nc)).reshape(nodes, nc, size)
            if names:
                rest = Statics(self.step).solve(self.first, self.theta, guess=self.configuration, names=names)
                start[:, : len(names)] = rest.by_theta
            directions = Directions(tuple(names), start, None, by_path)
        steps = len(self.times) - 1
        return simulate(self.step, self.theta, self.start.state, steps, path=self.positions(w), directions=directions)

    @property
    def configuration(self) -> Array:
        """All coordinates at the start, shape (n,)."""
        return np.asarray(self.start.state[: self.step.system.size])

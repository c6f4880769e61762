"""Simulation of a system along spline joint paths, with derivatives by the spline coefficients."""

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
    """Simulator of a system, initially at rest, whose prescribed joints follow a spline path.

    Attributes
    ----------
    step : Step
        Every joint that moves is prescribed; nothing is driven.
    theta : ndarray, shape (ntheta,)
    start : Rest
        Equilibrium at which the motion begins.
    path : SplinePath
    settle : float
        Time for which the joints stand still at the end [s].
    """

    step: Step
    theta: Array
    start: Rest
    path: SplinePath
    settle: float

    @property
    def joints(self) -> list[int]:
        """Configuration indices of the moved joints."""
        return list(self.step.system.prescribed_indices)

    @property
    def first(self) -> Array:
        """Start positions of the moved joints, shape (nc,) [rad or m]."""
        return np.asarray(self.start.state[self.joints])

    @cached_property
    def times(self) -> Array:
        """Times of the nodes, shape (N + 1,) [s]."""
        moving = round(self.path.duration / self.step.time_step)
        standing = max(1, round(self.settle / self.step.time_step))
        return np.asarray(self.step.time_step * np.arange(moving + standing + 1))

    @cached_property
    def standing(self) -> NDArray[np.int64]:
        """Indices of the nodes at which the joints stand still at the end."""
        return np.flatnonzero(self.times >= self.path.duration - 1e-9)

    @cached_property
    def _basis(self) -> Array:
        return self.path.basis(self.times)

    def positions(self, w: Array) -> Array:
        """Positions of the moved joints at the nodes, shape (N + 1, nc), for coefficients (K, nc)."""
        return self.first + self._basis @ w

    def roll(self, w: Array, slopes: bool = False, names: Sequence[str] = ()) -> Rollout:
        """Simulate the path of coefficients (K, nc), with derivatives by named parameters, then by the coefficients."""
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
        """Configuration at the start, shape (n,)."""
        return np.asarray(self.start.state[: self.step.system.size])

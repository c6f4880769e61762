"""Simulation of a system along spline joint paths, with derivatives by the spline coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.rollout import simulate
from yid_ocp.integrator.statics import Equilibrium, EquilibriumSolver
from yid_ocp.integrator.step import Step
from yid_ocp.integrator.step_model import Rollout, SensitivityDirections
from yid_ocp.planning.spline_path import SplinePath

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PathSimulator:
    """Simulator of a system, initially at rest, whose prescribed joints follow a spline path.

    Attributes
    ----------
    step : Step
        Every joint that moves is prescribed; nothing is driven.
    theta : ndarray, shape (ntheta,)
    start_equilibrium : Rest
        Equilibrium at which the motion begins.
    path : SplinePath
    hold_duration : float
        Time for which the joints stand still at the end [s].
    """

    step: Step
    theta: Array
    start_equilibrium: Equilibrium
    path: SplinePath
    hold_duration: float

    @property
    def joint_indices(self) -> list[int]:
        """Configuration indices of the moved joints."""
        return list(self.step.system.prescribed_indices)

    @property
    def start_positions(self) -> Array:
        """Start positions of the moved joints, shape (nc,) [rad or m]."""
        return np.asarray(self.start_equilibrium.state[self.joint_indices])

    @cached_property
    def node_times(self) -> Array:
        """Times of the nodes, shape (N + 1,) [s]."""
        moving = round(self.path.duration / self.step.time_step)
        standing = max(1, round(self.hold_duration / self.step.time_step))
        return np.asarray(self.step.time_step * np.arange(moving + standing + 1))

    @cached_property
    def standstill_nodes(self) -> NDArray[np.int64]:
        """Indices of the nodes at which the joints stand still at the end."""
        return np.flatnonzero(self.node_times >= self.path.duration - 1e-9)

    @cached_property
    def _basis(self) -> Array:
        return self.path.basis_values(self.node_times)

    def joint_positions(self, w: Array) -> Array:
        """Positions of the moved joints at the nodes, shape (N + 1, nc), for coefficients (K, nc)."""
        return self.start_positions + self._basis @ w

    def simulate_path(self, w: Array, slopes: bool = False, names: Sequence[str] = ()) -> Rollout:
        """Simulate the path of coefficients (K, nc), with derivatives by named parameters, then by the coefficients."""
        directions = None
        if slopes or names:
            size = w.size if slopes else 0
            nodes, nc = len(self.node_times), len(self.joint_indices)
            by_path = np.zeros((nodes, nc, len(names) + size))
            start = np.zeros((len(self.start_equilibrium.state), len(names) + size))
            if slopes:
                by_path[:, :, len(names) :] = np.einsum("tk,ji->tjki", self._basis, np.eye(nc)).reshape(nodes, nc, size)
            if names:
                rest = EquilibriumSolver(self.step).solve(
                    self.start_positions, self.theta, guess=self.start_configuration, names=names
                )
                start[:, : len(names)] = rest.state_by_theta
            directions = SensitivityDirections(tuple(names), start, None, by_path)
        steps = len(self.node_times) - 1
        return simulate(
            self.step,
            self.theta,
            self.start_equilibrium.state,
            steps,
            path=self.joint_positions(w),
            directions=directions,
        )

    @property
    def start_configuration(self) -> Array:
        """Configuration at the start, shape (n,)."""
        return np.asarray(self.start_equilibrium.state[: self.step.system.n_coordinates])

"""Magnitude of the inverse dynamics terms, which bounds the torque error of a good model."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.rollout import applied_joint_torque
from yid_ocp.integrator.step import Step
from yid_ocp.integrator.step_model import Rollout
from yid_ocp.model.kinematics import forward_kinematics, mass_matrix, rigid_body_derivatives
from yid_ocp.model.system import MidpointState, System

Array = NDArray[np.float64]

_STANDSTILL_SPEED = 0.1
"""Speed below which static friction may act [rad/s or m/s]."""


@dataclass(frozen=True)
class TorqueTermSizes:
    """Magnitude of the inverse dynamics terms of every coordinate at some nodes of a rollout.

    Attributes
    ----------
    rss_torque : ndarray, shape (M, n)
        Root of the sum of squares of inertia (of every joint's acceleration by itself), Coriolis and centrifugal
        forces, gravity, springs, friction, effects' forces and the torque that was applied or needed [N m or N].
    torque_rate : ndarray, shape (M, n)
        Of the torque needed [N m/s or N/s].
    static_friction_limit : ndarray, shape (M, n)
        What friction may hold at rest, gone above `_STANDSTILL_SPEED` [N m or N].
    """

    rss_torque: Array
    torque_rate: Array
    static_friction_limit: Array


class InverseDynamicsModel:
    """Inverse dynamics M(q) a + c(q, v) + g(q) = tau of a model, built once for all recordings.

    Parameters
    ----------
    step : Step
    """

    def __init__(self, step: Step) -> None:
        self._step = step

    @cached_property
    def _function(self) -> ca.Function:
        return _function(self._step.system, self._step.time_step)

    def evaluate_term_sizes(self, theta: Array, rollout: Rollout, nodes: NDArray[np.int64]) -> TorqueTermSizes:
        """Return the term magnitudes along a rollout, accelerations from finite differences.

        Parameters
        ----------
        theta : ndarray, shape (ntheta,)
        rollout : Rollout
        nodes : ndarray of int, shape (M,)
            At which the terms are wanted, in order.
        """
        system, time_step = self._step.system, self._step.time_step
        n = system.n_coordinates
        q, z = rollout.state[:, :n], rollout.state[:, 2 * n :]
        v = np.gradient(q, time_step, axis=0)
        a = np.gradient(v, time_step, axis=0)
        function = self._function.map(len(nodes))
        squares, needed, held = (np.array(part).T for part in function(*(x[nodes].T for x in (q, v, a, z)), theta))
        applied = np.zeros((len(nodes), n))
        torque = applied_joint_torque(self._step, theta, rollout)
        for indices, effort in ((system.driven_indices, torque), (system.prescribed_indices, rollout.effort)):
            if indices:
                applied[:, list(indices)] = effort[np.minimum(nodes, len(effort) - 1)]
        rate = np.gradient(needed, time_step * nodes, axis=0) if len(nodes) > 1 else np.zeros_like(needed)
        return TorqueTermSizes(np.sqrt(squares + applied**2), np.asarray(rate), np.abs(held))


def _function(system: System, time_step: float) -> ca.Function:
    """(q, v, a, z, theta) to the sum of squares of all terms, the torque needed, and what friction may hold."""
    n, names = system.n_coordinates, tuple(system.internal_coordinates)
    q, v, a, z = (ca.SX.sym(name, size) for name, size in (("q", n), ("v", n), ("a", n), ("z", len(names))))
    kinematics = forward_kinematics(system.mechanism, q)
    moving = rigid_body_derivatives(kinematics, v, system.gravity)
    weight = rigid_body_derivatives(kinematics, ca.SX.zeros(n), system.gravity).lagrangian_by_q
    rest, u = ca.SX.zeros(len(names)), ca.SX.zeros(len(system.driven))
    pulls = ca.SX.zeros(system.n_constraints)
    rows = {name: i for i, name in enumerate(names)}
    state = MidpointState(system, kinematics, q, v, z, rest, u, pulls, rows, ca.SX(time_step))
    energy, viscous, others = -system.elastic_energy(q), system.viscous_force(v), ca.SX.zeros(n)
    for effect in system.effects:
        terms = effect.step_terms(state)
        energy += terms.lagrangian
        viscous += 0 if terms.dissipative_force is None else terms.dissipative_force
        others += 0 if terms.generalized_force is None else terms.generalized_force
        others += 0 if terms.force_with_derivatives is None else terms.force_with_derivatives.force
    mass = mass_matrix(moving, system.mechanism) + ca.hessian(energy, v)[0]
    coriolis = ca.jtimes(moving.lagrangian_by_v, q, v) - (moving.lagrangian_by_q - weight)
    springs = -ca.gradient(energy, q)
    columns = mass * ca.repmat(a.T, n, 1)
    squares = ca.sum2(columns**2) + coriolis**2 + weight**2 + springs**2 + viscous**2 + others**2
    needed = ca.sum2(columns) + coriolis - weight + springs - viscous - others
    faster, slower = (ca.substitute(viscous, v, v + sign * _STANDSTILL_SPEED) for sign in (1, -1))
    outputs = [ca.densify(x) for x in (squares, needed, (faster - slower) / 2)]
    if names:
        symbols = ca.vertcat(*system.internal_coordinates.values())
        outputs = [ca.substitute(x, symbols, z) for x in outputs]
    return ca.Function("torque_terms", [q, v, a, z, system.parameters.symbols], outputs)

"""Convergence with links and time step: natural frequencies about an equilibrium, and gaps of open grasps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from yid_ocp.integrator.discrete import ConstraintForcePlacement, ForceSplit
from yid_ocp.integrator.statics import Equilibrium, EquilibriumSolver
from yid_ocp.integrator.step import Step, compile_step
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.system import System

Array = NDArray[np.float64]

_DAMPING_PARAMETERS = ("damping", "twist_damping")


@dataclass(frozen=True)
class NaturalFrequencies:
    """Natural frequencies of one step map about an equilibrium, its robot held still.

    Attributes
    ----------
    frequencies_hz : ndarray, shape (k,)
        Undamped, ascending [Hz].
    n_unstable_modes : int
        Number of damped modes that still grow from step to step: the equilibrium is unstable, or the time step is too
        long for the tension that the grasps put on the object.
    message : str
        Why there are no frequencies, empty otherwise.
    """

    frequencies_hz: Array
    n_unstable_modes: int = 0
    message: str = ""


def _with_prescribed_joints(system: System) -> System:
    """The system with its driven joints prescribed."""
    return replace(system, driven=(), servos={}, prescribed=(*system.driven, *system.prescribed))


def natural_frequencies(
    system: System,
    posture: Mapping[str, float],
    theta: Array,
    time_step: float,
    force_split: ForceSplit = "symmetric",
    constraint_force: ConstraintForcePlacement = "midpoint",
    guess: Array | None = None,
) -> NaturalFrequencies:
    """Natural frequencies of a system's step map about an equilibrium, from the eigenvalues of A_k without damping.

    Parameters
    ----------
    system : System
        Driven joints are held still.
    posture : mapping of str to float
        Driven and prescribed coordinates [rad or m].
    theta : ndarray, shape (ntheta,)
    time_step : float
        h [s]; the midpoint rule lowers a frequency f to atan(pi f h)/(pi h).
    force_split, constraint_force : str
        As in `compile_step`; the split affects growth, not the undamped frequencies.
    guess : ndarray, shape (n,), optional
        Configuration from which rest is sought.
    """
    still = _with_prescribed_joints(system)
    if not still.free_indices:
        return NaturalFrequencies(np.zeros(0), message="every coordinate is prescribed, nothing can swing")
    step = compile_step(still, time_step, force_split, constraint_force, use_compiler=False)
    known = np.array([posture[name] for name in still.prescribed])
    rest = EquilibriumSolver(step).solve(known, theta, guess=guess)
    if not rest.is_converged:
        return NaturalFrequencies(np.zeros(0), message=rest.message)
    undamped = theta.copy()
    for i, name in enumerate(system.parameters.names):
        if name.rpartition(".")[2] in _DAMPING_PARAMETERS:
            undamped[i] = 0.0
    angles = np.sort(np.angle(_eigenvalues(step, rest, known, undamped)))
    turning = angles[(angles > 1e-7) & (angles < math.pi - 1e-7)]
    growing = int(np.sum(np.abs(_eigenvalues(step, rest, known, theta)) > 1 + 1e-6))
    return NaturalFrequencies(turning / (2 * math.pi * time_step), growing)


def _eigenvalues(step: Step, rest: Equilibrium, known: Array, theta: Array) -> Array:
    """Eigenvalues of A at rest that belong to motion, not to what the constraints take away."""
    n = step.system.n_coordinates
    q, p, z = rest.state[:n], rest.state[n : 2 * n], rest.state[2 * n :]
    a, _, _ = step.jacobians(q, p, np.zeros(0), theta, (known, known), z, names=())
    free = np.array(step.system.free_indices)
    rows = np.concatenate([free, n + free])
    values: Array = np.linalg.eigvals(a[np.ix_(rows, rows)])
    return values[np.abs(values) > 0.2]


def min_grasp_gaps(system: System, posture: Mapping[str, float], theta: Array) -> dict[str, float]:
    """Smallest remaining gap of each grasp [m], by name: the robot's joints are fixed, the object may bend.

    Parameters
    ----------
    system : System
    posture : mapping of str to float
        Driven and prescribed coordinates [rad or m].
    theta : ndarray, shape (ntheta,)
        Lengths are taken from it.
    """
    if not system.grasps:
        return {}
    q = ca.SX.sym("q", system.n_coordinates)
    kinematics = forward_kinematics(system.mechanism, q)
    symbols = ca.vertcat(system.parameters.symbols, *system.internal_coordinates.values())
    numbers = np.concatenate([theta, np.zeros(len(system.internal_coordinates))])
    ends = [grasp.constraint_residual(kinematics)[:3] for grasp in system.grasps]
    phi = ca.substitute(ca.vertcat(*ends), symbols, ca.SX(ca.DM(numbers)))
    known = [system.mechanism.joint_index(name) for name in posture]
    free = [i for i in range(system.n_coordinates) if i not in known]
    full = np.zeros(system.n_coordinates)
    full[known] = list(posture.values())
    function = ca.Function("phi", [q], [phi, ca.jacobian(phi, q)[:, free]])

    def at(x: Array) -> Array:
        full[free] = x
        return full

    best: Array | None = None
    for seed in range(4):
        start = np.random.default_rng(seed).normal(scale=0.1, size=len(free))
        # a little stiffness keeps the search from winding the object up
        found = scipy.optimize.least_squares(
            lambda x: np.concatenate([np.array(function(at(x))[0]).ravel(), 1e-4 * x]),
            start,
            lambda x: np.vstack([np.array(ca.densify(function(at(x))[1])), 1e-4 * np.eye(len(free))]),
            max_nfev=100,
        )
        gap = np.array(function(at(found.x))[0]).ravel()
        if best is None or np.linalg.norm(gap) < np.linalg.norm(best):
            best = gap
        if np.linalg.norm(best) < 1e-3:
            break
    assert best is not None
    distances = np.linalg.norm(best.reshape(-1, 3), axis=1)
    return {grasp.name: float(distance) for grasp, distance in zip(system.grasps, distances, strict=True)}

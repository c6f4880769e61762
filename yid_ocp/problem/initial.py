"""A start state from the first measured points, for recordings that begin in motion or away from rest."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.errors import DataError
from yid_ocp.integrator.rollout import momentum_of
from yid_ocp.integrator.step import Step
from yid_ocp.problem.residuals import Samples
from yid_ocp.sensors import PointSensor, sensor_function

Array = NDArray[np.float64]

# Deviation of the elastic prior: a bend of this size costs as much as one standard deviation of a measured point [rad].
BEND_STD = 0.5
CONSTRAINT_STD = 1e-5


def fit_start(
    step: Step, posture: Array, samples: Sequence[Samples], theta: Array, window: float, path: Array
) -> Array:
    """Configuration that fits the measured points at the first frames, and the momentum from their change.

    Minimises |(w(q) - wbar)/std|^2 + |q - q_rest|^2/BEND_STD^2 + |phi(q)/CONSTRAINT_STD|^2 by Gauss-Newton at the first
    and at the last frame of the window; the momentum is that of the velocity between the two.

    Parameters
    ----------
    step : Step
    posture : ndarray, shape (nk,)
        Driven, then prescribed coordinates at node 0.
    samples : sequence of Samples
        Only points are used.
    theta : ndarray, shape (ntheta,)
    window : float
        How far from the start frames may be used [s].
    path : ndarray, shape (N + 1, nc)
        Prescribed coordinates.

    Returns
    -------
    ndarray, shape (nx,)
        (q, p, z) at node 0.

    Raises
    ------
    DataError
        No point is seen within the window.
    """
    system = step.system
    last = max(round(window / step.time_step), 1)
    frames: dict[int, list[tuple[Samples, int]]] = {}
    for group in samples:
        if isinstance(group.sensor, PointSensor):
            for row, (node, fraction) in enumerate(zip(group.node, group.fraction, strict=True)):
                near = int(node + round(float(fraction)))
                if near <= last and np.any(group.weight[row] > 0):
                    frames.setdefault(near, []).append((group, row))
    if not frames:
        raise DataError(
            f"no point is seen in the first {window:g} s, so the start state cannot be fitted",
            hint="widen solver.start_window, or start from equilibrium",
        )
    nodes = sorted(frames)
    chosen = [nodes[0]] if len(nodes) == 1 else [nodes[0], nodes[-1]]
    fits = []
    guess = np.zeros(system.size)
    known = [*system.driven_indices, *system.prescribed_indices]
    for node in chosen:
        guess[known] = posture
        guess[list(system.prescribed_indices)] = path[node]
        guess = _fit_configuration(step, guess, frames[node], theta, known)
        fits.append(guess.copy())
    velocity = np.zeros(system.size)
    if len(fits) == 2:
        velocity = (fits[1] - fits[0]) / ((chosen[1] - chosen[0]) * step.time_step)
    q0 = fits[0] - velocity * chosen[0] * step.time_step
    q0[list(system.prescribed_indices)] = path[0]
    momentum = momentum_of(step, q0, velocity, theta)
    return np.concatenate([q0, momentum, np.zeros(step.sizes["nz"])])


def _fit_configuration(
    step: Step, guess: Array, measured: list[tuple[Samples, int]], theta: Array, known: Sequence[int]
) -> Array:
    system, e = step.system, step.equations
    free = [i for i in range(system.size) if i not in set(known)]
    functions = [sensor_function(system, group.sensor, ()) for group, _ in measured]
    phi = ca.Function(
        "phi",
        [e.q1, e.z1, e.lam, e.theta, e.time_step],
        [e.constraint, ca.jacobian(e.constraint, e.q1)],
    )
    nz, m = step.sizes["nz"], step.sizes["m"]
    q = guess.copy()
    rest = np.zeros(system.size)
    for _ in range(60):
        rows, residuals = [], []
        for function, (group, row) in zip(functions, measured, strict=True):
            y, by_q, *_ = function(q, np.zeros(nz), np.zeros(system.size), theta)
            weight = group.weight[row]
            value = np.where(weight > 0, group.value[row], 0.0)
            residuals.append(weight * (np.array(y).ravel() - value))
            rows.append(weight[:, None] * np.array(ca.densify(by_q))[:, free])
        if m:
            gap, by_q = phi(q, np.zeros(nz), np.zeros(m), theta, step.time_step)
            residuals.append(np.array(gap).ravel() / CONSTRAINT_STD)
            rows.append(np.array(ca.densify(by_q))[:, free] / CONSTRAINT_STD)
        residuals.append((q - rest)[free] / BEND_STD)
        rows.append(np.eye(len(free)) / BEND_STD)
        change = -np.linalg.lstsq(np.vstack(rows), np.concatenate(residuals), rcond=None)[0]
        size = float(np.max(np.abs(change), initial=0.0))
        q[free] += change * min(1.0, 0.5 / max(size, 1e-12))
        if size < 1e-9:
            break
    return q

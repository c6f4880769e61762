"""Levenberg-Marquardt for small dense fits: a start, a shape in a cloud, a calibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rows = Callable[[Array], tuple[Array, Array]]


@dataclass(frozen=True)
class SmallFit:
    """Where a small fit ended.

    Attributes
    ----------
    x : ndarray, shape (n,)
    cost : float
        Sum of squares there.
    jacobian : ndarray, shape (m, n)
    iterations : int
    converged : bool
    """

    x: Array
    cost: float
    jacobian: Array
    iterations: int
    converged: bool


def levenberg_marquardt(
    rows: Rows,
    start: Array,
    *,
    project: Callable[[Array], Array] | None = None,
    largest_step: float = 0.5,
    iterations: int = 200,
    step_tolerance: float = 1e-9,
    cost_tolerance: float = 1e-10,
) -> SmallFit:
    """Minimise |r(x)|^2 by damped Gauss-Newton steps, the damping in units of the columns' norms.

    Parameters
    ----------
    rows : callable
        From x to residual (m,) and Jacobian (m, n).
    start : ndarray, shape (n,)
    project : callable, optional
        Brings a trial point back to where it may be.
    largest_step : float
        No component moves by more in one step.
    iterations : int
    step_tolerance, cost_tolerance : float
        Converged when no component would move by more, or when the cost falls by less than this part.

    References
    ----------
    Nocedal and Wright (2006), Numerical Optimization, section 10.3, doi:10.1007/978-0-387-40065-5.
    """
    x = np.array(start, float)
    residual, jacobian = rows(x)
    cost, damping = float(residual @ residual), 1e-3
    for iteration in range(1, iterations + 1):
        scale = np.sqrt(damping) * np.maximum(np.linalg.norm(jacobian, axis=0), 1e-9)
        stacked = np.vstack([jacobian, np.diag(scale)])
        change = -np.linalg.lstsq(stacked, np.concatenate([residual, np.zeros(len(scale))]), rcond=None)[0]
        size = float(np.max(np.abs(change), initial=0.0))
        change *= min(1.0, largest_step / max(size, 1e-12))
        trial = x + change if project is None else project(x + change)
        new_residual, new_jacobian = rows(trial)
        new_cost = float(new_residual @ new_residual)
        if new_cost < cost:
            done = size < step_tolerance or cost - new_cost < cost_tolerance * cost
            x, residual, jacobian, cost = trial, new_residual, new_jacobian, new_cost
            damping = max(damping / 10, 1e-12)
            if done:
                return SmallFit(x, cost, jacobian, iteration, True)
        else:
            damping *= 10
            if size < step_tolerance or damping > 1e8:
                return SmallFit(x, cost, jacobian, iteration, size < step_tolerance)
    return SmallFit(x, cost, jacobian, iterations, False)

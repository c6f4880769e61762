"""Levenberg-Marquardt method for small dense least-squares problems (docs/design/solvers.md compares SciPy's)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import scipy.linalg.lapack

from yid_ocp.arrays import Array

_FIRST_DAMPING, _MOST_DAMPING = 1e-3, 1e8
_MAX_STEP = 0.5  # largest change of a component in one step


@dataclass(frozen=True)
class LocalQuadraticModel:
    """A quadratic model of a cost near one point: value, gradient (n,) and positive definite Hessian (n, n)."""

    cost: float
    gradient: Array
    hessian: Array

    def damped_step(self, damping: float) -> Array:
        """Compute the step (n,) that minimises the model, with the Hessian's diagonal multiplied by 1 + `damping`."""
        return np.asarray(-np.linalg.solve(self.hessian + damping * np.diag(np.diag(self.hessian)), self.gradient))


class _SumOfSquares:
    """Local model of |r|^2 from residual (m,) and Jacobian (m, n)."""

    def __init__(self, residual: Array, jacobian: Array) -> None:
        self.residual, self.jacobian = residual, jacobian
        self.cost = float(residual @ residual)

    def damped_step(self, damping: float) -> Array:
        scale = np.sqrt(damping) * np.maximum(np.linalg.norm(self.jacobian, axis=0), 1e-9)
        stacked, target = np.vstack([self.jacobian, np.diag(scale)]), np.append(self.residual, np.zeros(len(scale)))
        return np.asarray(-scipy.linalg.lapack.dgels(stacked, target)[1][: len(scale)])  # the damping gives full rank


_Model = TypeVar("_Model", LocalQuadraticModel, _SumOfSquares)


def levenberg_marquardt(
    residual_function: Callable[[Array], tuple[Array, Array]],
    initial_guess: Array,
    projection: Callable[[Array], Array] = lambda x: x,
) -> tuple[Array, _SumOfSquares]:
    """Minimise the sum of squares |r(x)|^2 by Gauss-Newton steps, with damping scaled by the Jacobian's column norms.

    The residual function returns r (m,) and its Jacobian (m, n). The projection maps a trial point to an admissible
    point (Nocedal and Wright 2006, Numerical Optimization, section 10.3, doi:10.1007/978-0-387-40065-5).
    """
    return minimize_by_damped_newton(
        lambda x: _SumOfSquares(*residual_function(x)), initial_guess, projection=projection, min_damping=1e-12
    )


def minimize_by_damped_newton(
    model_at: Callable[[Array], _Model],
    initial_guess: Array,
    *,
    projection: Callable[[Array], Array] = lambda x: x,
    max_iterations: int = 200,
    step_tolerance: float = 1e-9,
    cost_tolerance: float = 1e-10,
    min_damping: float = 1e-9,
) -> tuple[Array, _Model]:
    """Find the minimiser (n,) of a cost, and its local model, by damped Newton steps on the models of `model_at`.

    The search ends if no component would move by more than `step_tolerance`, or if the cost decreases by less than
    the fraction `cost_tolerance`. `min_damping` is the least damping; it keeps a search on a robust cost in its local
    minimum. The projection maps a trial point to an admissible point.
    """
    x = np.array(initial_guess, float)
    model, damping = model_at(x), _FIRST_DAMPING
    for _ in range(max_iterations):
        change = model.damped_step(damping)
        size = float(np.max(np.abs(change), initial=0.0))
        trial = projection(x + change * min(1.0, _MAX_STEP / max(size, 1e-12)))
        new = model_at(trial)
        if new.cost < model.cost:
            done = size < step_tolerance or model.cost - new.cost < cost_tolerance * model.cost
            x, model = trial, new
            damping = max(damping / 10, min_damping)
        else:
            damping *= 10
            done = size < step_tolerance or damping > _MOST_DAMPING
        if done:
            break
    return x, model

"""Levenberg-Marquardt for dense least-squares problems of some dozen coordinates: initial states and shapes of chains.

Measured against SciPy's: docs/design/solvers.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from yid_ocp.arrays import Array

_ResidualFunction = Callable[[Array], tuple[Array, Array]]
_Projection = Callable[[Array], Array]

_FIRST_DAMPING, _MOST_DAMPING = 1e-3, 1e8


@dataclass(frozen=True)
class _LeastSquaresResult:
    """Result of `levenberg_marquardt`: minimiser `x` (n,), sum of squares and Jacobian (m, n) there, convergence."""

    x: Array
    sum_of_squares: float
    jacobian: Array
    n_iterations: int
    has_converged: bool


@dataclass(frozen=True)
class LocalQuadraticModel:
    """A local quadratic model of a cost, for costs that are not a plain sum of squares or have many residuals.

    The Hessian (n, n) is positive definite, that of Gauss and Newton for example.
    """

    cost: float
    gradient: Array
    hessian: Array

    def damped_step(self, damping: float) -> Array:
        """The step that minimises the model with Levenberg-Marquardt damping, shape (n,)."""
        damped = self.hessian + damping * np.diag(np.diag(self.hessian))
        return np.asarray(-np.linalg.solve(damped, self.gradient))


@dataclass(frozen=True)
class _DampedNewtonResult:
    """Result of `minimize_by_damped_newton`: minimiser `x` (n,), the model there, iterations, convergence."""

    x: Array
    final_model: LocalQuadraticModel
    n_iterations: int
    has_converged: bool


def levenberg_marquardt(
    residual_function: _ResidualFunction,
    initial_guess: Array,
    *,
    projection: _Projection | None = None,
    max_step: float = 0.5,
    max_iterations: int = 200,
    step_tolerance: float = 1e-9,
    cost_tolerance: float = 1e-10,
) -> _LeastSquaresResult:
    """Minimise |r(x)|^2 by damped Gauss-Newton steps, the damping in units of the columns' norms.

    The residual function gives r (m,) and its Jacobian (m, n); a projection brings a trial point back to where it may
    be. No component moves by more than `max_step` in one step. It has converged when no component would move by more
    than `step_tolerance`, or when the cost falls by less than the part `cost_tolerance`.

    References
    ----------
    Nocedal and Wright (2006), Numerical Optimization, section 10.3, doi:10.1007/978-0-387-40065-5.
    """

    def model_at(x: Array) -> _SumOfSquares:
        return _SumOfSquares(*residual_function(x))

    limits = max_step, max_iterations, step_tolerance, cost_tolerance, 1e-12
    x, model, used, converged = _descend(model_at, initial_guess, projection, *limits)
    return _LeastSquaresResult(x, model.cost, model.jacobian, used, converged)


def minimize_by_damped_newton(
    quadratic_model: Callable[[Array], LocalQuadraticModel],
    initial_guess: Array,
    *,
    max_step: float = 0.5,
    max_iterations: int = 200,
    step_tolerance: float = 1e-9,
    cost_tolerance: float = 1e-10,
    min_damping: float = 1e-9,
) -> _DampedNewtonResult:
    """Minimise a cost given by local quadratic models, with the loop of `levenberg_marquardt`.

    No step is damped less than `min_damping`: some damping keeps a search on a robust cost from leaping out of its
    valley.
    """
    limits = max_step, max_iterations, step_tolerance, cost_tolerance, min_damping
    return _DampedNewtonResult(*_descend(quadratic_model, initial_guess, None, *limits))


class _SumOfSquares:
    """Local model of |r|^2 from residual (m,) and Jacobian (m, n)."""

    def __init__(self, residual: Array, jacobian: Array) -> None:
        self.residual, self.jacobian = residual, jacobian
        self.cost = float(residual @ residual)

    def damped_step(self, damping: float) -> Array:
        scale = np.sqrt(damping) * np.maximum(np.linalg.norm(self.jacobian, axis=0), 1e-9)
        stacked, target = np.vstack([self.jacobian, np.diag(scale)]), np.append(self.residual, np.zeros(len(scale)))
        return np.asarray(-np.linalg.lstsq(stacked, target, rcond=None)[0])


_Model = TypeVar("_Model", LocalQuadraticModel, _SumOfSquares)


def _descend(
    model_at: Callable[[Array], _Model],
    start: Array,
    project: _Projection | None,
    max_step: float,
    max_iterations: int,
    step_tolerance: float,
    cost_tolerance: float,
    min_damping: float,
) -> tuple[Array, _Model, int, bool]:
    """The minimiser, its model, iterations used, and whether it converged."""
    x = np.array(start, float)
    model, damping = model_at(x), _FIRST_DAMPING
    for iteration in range(1, max_iterations + 1):
        change = model.damped_step(damping)
        size = float(np.max(np.abs(change), initial=0.0))
        change = change * min(1.0, max_step / max(size, 1e-12))
        trial = x + change if project is None else project(x + change)
        new = model_at(trial)
        if new.cost < model.cost:
            done = size < step_tolerance or model.cost - new.cost < cost_tolerance * model.cost
            x, model = trial, new
            damping = max(damping / 10, min_damping)
            if done:
                return x, model, iteration, True
        else:
            damping *= 10
            if size < step_tolerance or damping > _MOST_DAMPING:
                return x, model, iteration, size < step_tolerance
    return x, model, max_iterations, False

"""Linear model of a residual about a point: bounded steps and the cost reduction that it predicts."""

from __future__ import annotations

import math

import numpy as np
import scipy.linalg
import scipy.optimize
from numpy.typing import NDArray

from yid_ocp.problem.estimation_problem import EstimationProblem
from yid_ocp.problem.evaluation import Evaluation

Array = NDArray[np.float64]

# A fit is at its end where no step promises more than this part of the cost, or this much of it in units of the noise.
_MAX_RELATIVE_REDUCTION, _MAX_NOISE_UNIT_REDUCTION = 1e-3, 1e-2


def residual_without_weak_priors(problem: EstimationProblem, evaluation: Evaluation) -> tuple[Array, Array]:
    """Return the noise-scaled residual (r,) and Jacobian (r, nx) of data and stated priors, without weak priors."""
    assert evaluation.jacobian is not None
    rows, unit = problem.residual_rows, problem.data_noise_unit
    residual, jacobian = evaluation.residual[rows.without_weak_priors], evaluation.jacobian[rows.without_weak_priors]
    if unit == 1.0:
        return residual, jacobian
    units = np.ones(len(residual))
    units[rows.data] = unit
    return residual / units, jacobian / units[:, None]


def bounded_least_squares_step(jacobian: Array, residual: Array, mu: float, lower: Array, upper: Array) -> Array:
    """Solve min |J d + r|^2 + mu c |d|^2 with lower <= d <= upper, c the largest squared column norm."""
    count = jacobian.shape[1]
    factor = scipy.linalg.qr(np.column_stack([jacobian, residual]), mode="r", check_finite=False)[0][: count + 1]
    small = np.zeros((count + 1, count + 1))
    small[: len(factor)] = factor
    weight = np.sqrt(mu * max(float(np.max(np.sum(jacobian**2, axis=0), initial=0.0)), 1e-300))
    matrix = np.vstack([small[:, :count], weight * np.eye(count)])
    target = np.concatenate([-small[:, count], np.zeros(count)])
    plain = np.linalg.lstsq(matrix, target, rcond=None)[0]
    if np.all(plain >= lower) and np.all(plain <= upper):
        return plain
    low, high = np.minimum(lower, 0.0), np.maximum(upper, 0.0)
    # the bounded solver wants room between the bounds
    closed = high - low < 1e-14
    step = np.zeros(count)
    if np.all(closed):
        return step
    free = ~closed
    result = scipy.optimize.lsq_linear(matrix[:, free], target, bounds=(low[free], high[free]), method="bvls")
    step[free] = result.x
    return step


def predicted_reduction(jacobian: Array, residual: Array, step: Array) -> float:
    """Reduction of 1/2 |r|^2 that the linear model predicts for a step."""
    return -float((jacobian.T @ residual) @ step) - 0.5 * float(np.sum((jacobian @ step) ** 2))


def is_stationary(problem: EstimationProblem, x: Array, evaluation: Evaluation) -> bool:
    """Whether a point is stationary: no step up to the unknowns' size predicts a relevant cost reduction.

    Parameters
    ----------
    x : ndarray, shape (nx,)
    evaluation : Evaluation
        At `x`, with its Jacobian.
    """
    worth = max(_MAX_RELATIVE_REDUCTION * evaluation.cost, _MAX_NOISE_UNIT_REDUCTION * problem.data_noise_unit**2)
    return achievable_reduction(problem, x, evaluation) <= worth


def achievable_reduction(problem: EstimationProblem, x: Array, evaluation: Evaluation) -> float:
    """Cost reduction that the linear model predicts for a step up to the unknowns' size; infinite without a Jacobian.

    The step is undamped and within the bounds; size is the larger of value and typical size. Parameters as of
    `is_stationary`.
    """
    if evaluation.jacobian is None:
        return math.inf
    if not len(x):
        return 0.0
    lower, upper = problem.bounds
    size = np.maximum(np.abs(x), problem.unknown_scales)
    scaled = evaluation.jacobian * size
    low, high = np.maximum((lower - x) / size, -1.0), np.minimum((upper - x) / size, 1.0)
    step = bounded_least_squares_step(scaled, evaluation.residual, 1e-14, low, high)
    return predicted_reduction(scaled, evaluation.residual, step)

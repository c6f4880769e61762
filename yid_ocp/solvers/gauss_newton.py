"""Gauss-Newton with forward sensitivities, bounds and Levenberg-Marquardt damping."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
import scipy.linalg
import scipy.optimize
from annotated_types import Ge, Gt
from numpy.typing import NDArray

from yid_ocp.options import About, check
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.problem.problem import EstimationProblem
from yid_ocp.solvers.base import SOLVERS, Callback, Outcome, Recorder, Status, projected_gradient

Array = NDArray[np.float64]


@SOLVERS.register("gauss_newton")
@dataclass(frozen=True)
class GaussNewton:
    """Minimise 1/2 |r(x)|^2 by bounded, damped linear least-squares steps.

    Every iteration solves  min |J d + r|^2 + mu |d/s|^2  with  lower <= x + d <= upper, and accepts d when the cost
    falls by a fair part of what the linear model promised.

    References
    ----------
    Nocedal and Wright (2006), Numerical Optimization, chapter 10, doi:10.1007/978-0-387-40065-5.
    """

    iterations: Annotated[int, Ge(1), About("limit on accepted steps")] = 60
    step_tolerance: Annotated[
        float, Gt(0), About("converged when no unknown moves by more than this fraction of its size")
    ] = 1e-5
    cost_tolerance: Annotated[
        float, Gt(0), About("converged when the promised relative reduction of the cost is below this")
    ] = 1e-8
    damping: Annotated[
        float, Gt(0), About("initial mu, in units of the largest diagonal entry of the scaled normal matrix")
    ] = 1e-6
    name: ClassVar[str] = "gauss_newton"
    carries_covariance: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check(self, f"solver {self.name}")

    def run(self, problem: EstimationProblem, start: Array, callback: Callback | None) -> Outcome:
        """See `Solver.run`."""
        lower, upper = problem.bounds
        scale = problem.scales
        recorder = Recorder(callback)
        x = start.copy()
        now = problem.evaluate(x)
        recorder.evaluations += 1
        if not now.ok or now.jacobian is None:
            return Outcome(Status.FAILED, now.message, x, (), recorder.evaluations)
        mu, rejected = self.damping, 0
        while True:
            jacobian, residual = now.jacobian, now.residual
            assert jacobian is not None
            gradient = jacobian.T @ residual
            size = np.maximum(np.abs(x), scale)
            if rejected == 0:
                recorder.accept(now.cost, x, projected_gradient(x, gradient, lower, upper, size))
            if len(recorder.history) > self.iterations:
                message = (
                    f"no convergence in {self.iterations} iterations; raise solver.iterations or free fewer parameters"
                )
                return self._end(Status.ITERATION_LIMIT, message, x, recorder, now)
            step = bounded_step(jacobian * size, residual, mu, (lower - x) / size, (upper - x) / size) * size
            promised = -float(gradient @ step) - 0.5 * float(np.sum((jacobian @ step) ** 2))
            if promised <= self.cost_tolerance * max(now.cost, 1e-300):
                return self._end(Status.CONVERGED, "the cost cannot be lowered any further", x, recorder, now)
            trial = problem.evaluate(np.clip(x + step, lower, upper), warm=now.warm)
            recorder.evaluations += 1
            gain = (now.cost - trial.cost) / promised if trial.ok else -1.0
            if gain > 1e-3:
                moved = float(np.max(np.abs(step) / size))
                x, now, rejected = np.clip(x + step, lower, upper), trial, 0
                mu = max(mu * (0.2 if gain > 0.5 else 1.0 if gain > 0.2 else 3.0), 1e-12)
                if moved < self.step_tolerance and now.jacobian is not None:
                    slope = projected_gradient(x, now.jacobian.T @ now.residual, lower, upper, size)
                    recorder.accept(now.cost, x, slope)
                    return self._end(Status.CONVERGED, "the step is below its tolerance", x, recorder, now)
                continue
            rejected += 1
            mu = max(mu * 8.0, 1e-6)
            if mu > 1e10 or rejected > 40:
                small = promised <= 1e-6 * max(now.cost, 1e-300)
                status = Status.CONVERGED if small else Status.STALLED
                message = (
                    "the cost cannot be lowered any further"
                    if small
                    else (
                        f"no step lowers the cost ({trial.message or 'the linear model does not hold'}); "
                        "start nearer, shorten the recording, or use multiple_shooting"
                    )
                )
                return self._end(status, message, x, recorder, now)

    def _end(self, status: Status, message: str, x: Array, recorder: Recorder, now: Evaluation) -> Outcome:
        return Outcome(status, message, x, tuple(recorder.history), recorder.evaluations, now.warm)


def bounded_step(jacobian: Array, residual: Array, mu: float, lower: Array, upper: Array) -> Array:
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

"""The source paper's solver: steepest descent projected on the bounds, with Armijo's rule."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from yid_ocp.errors import SolverError
from yid_ocp.problem.problem import EstimationProblem, Evaluation
from yid_ocp.solvers.base import SOLVERS, Callback, Outcome, Recorder, Status, projected_gradient

Array = NDArray[np.float64]


@SOLVERS.register("steepest_descent")
@dataclass(frozen=True)
class SteepestDescent:
    """x <- P(x - s g), P the projection on the bounds, s by backtracking until the cost falls enough.

    The gradient comes from the adjoint. Unscaled on purpose: this is what the paper did.

    Attributes
    ----------
    iterations : int
    gradient_tolerance : float
        Converged when the projected gradient, times the size of the unknowns and over the cost, is below this.
    sufficient_decrease : float
        Armijo's constant.
    shrink : float
        Backtracking factor.
    trial : "last" or "spectral"
        First length tried in an iteration: twice the last accepted one, as in the paper, or Barzilai and Borwein's from
        the change of the gradient, which needs far fewer iterations.
    memory : int
        Armijo's rule demands less than the largest of so many last costs: with 1 every step lowers the cost, as in the
        paper; spectral lengths, most of which pay only a few steps later, want about 10.

    References
    ----------
    Armijo (1966), Pacific J. Math. 16:1, doi:10.2140/pjm.1966.16.1.
    Bertsekas (1976), IEEE Trans. Automatic Control 21(2):174, doi:10.1109/TAC.1976.1101194 (projection).
    Birgin, Martinez, Raydan (2000), SIAM J. Optim. 10(4):1196, doi:10.1137/S1052623497330963 (spectral, memory).
    """

    iterations: int = 200
    gradient_tolerance: float = 1e-5
    sufficient_decrease: float = 1e-4
    shrink: float = 0.5
    trial: Literal["last", "spectral"] = "last"
    memory: int = 1
    name: str = "steepest_descent"

    def run(self, problem: EstimationProblem, start: Array, callback: Callback | None) -> Outcome:
        """See `Solver.run`."""
        if self.memory < 1:
            raise SolverError(f"memory = {self.memory}", where="steepest_descent", allowed="a whole number from 1")
        lower, upper = problem.bounds
        recorder = Recorder(callback)
        x = start.copy()
        cost, gradient, evaluation = problem.gradient(x)
        recorder.evaluations += 1
        if not evaluation.ok:
            return Outcome(Status.FAILED, evaluation.message, x, (), recorder.evaluations)
        # the first trial moves the unknowns by about a tenth of their size
        length = 0.1 * float(np.linalg.norm(problem.scales)) / max(float(np.linalg.norm(gradient)), 1e-300)
        for _ in range(self.iterations):
            size = np.maximum(np.abs(x), problem.scales)
            slope = projected_gradient(x, gradient, lower, upper, size)
            recorder.accept(cost, x, slope)
            reference = max(entry.cost for entry in recorder.history[-self.memory :])
            if slope <= self.gradient_tolerance * max(cost, 1e-300):
                return self._end(Status.CONVERGED, "the projected gradient vanishes", recorder, evaluation)
            while True:
                trial = np.clip(x - length * gradient, lower, upper)
                attempt = problem.evaluate(trial, False, evaluation.warm)
                recorder.evaluations += 1
                needed = self.sufficient_decrease * float(gradient @ (x - trial))
                if attempt.ok and attempt.cost <= reference - needed:
                    break
                length *= self.shrink
                if np.max(np.abs(length * gradient) / size) < 1e-12:
                    return self._end(Status.STALLED, "no step along the gradient lowers the cost", recorder, evaluation)
            before, slope_before = x, gradient
            x = trial
            cost, gradient, evaluation = problem.gradient(x, attempt)
            length /= self.shrink
            moved, turned = x - before, gradient - slope_before
            if self.trial == "spectral" and float(moved @ turned) > 0:
                length = float(moved @ moved) / float(moved @ turned)
        size = np.maximum(np.abs(x), problem.scales)
        recorder.accept(cost, x, projected_gradient(x, gradient, lower, upper, size))
        message = f"no convergence in {self.iterations} iterations, as is usual for this method; try gauss_newton"
        return self._end(Status.ITERATION_LIMIT, message, recorder, evaluation)

    def _end(self, status: Status, message: str, recorder: Recorder, last: Evaluation) -> Outcome:
        best = min(recorder.history, key=lambda entry: entry.cost)
        return Outcome(status, message, best.x, tuple(recorder.history), recorder.evaluations, last.warm)

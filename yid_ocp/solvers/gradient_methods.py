"""First-order methods on the adjoint's gradient: SciPy's L-BFGS-B, and the source paper's steepest descent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
import scipy.optimize
from annotated_types import Ge, Gt, Lt

from yid_ocp.arrays import Array
from yid_ocp.options import OptionInfo, check_option_bounds
from yid_ocp.problem.estimation_problem import EstimationProblem
from yid_ocp.solvers.base import (
    SOLVERS,
    IterationCallback,
    IterationRecorder,
    SolverResult,
    Status,
    projected_gradient_norm,
)


@SOLVERS.register("single_shooting")
@dataclass(frozen=True)
class SingleShooting:
    """Minimise the cost by SciPy's L-BFGS-B on unknowns scaled to order one.

    References
    ----------
    Zhu, Byrd, Lu, Nocedal (1997), ACM Trans. Math. Softw. 23(4):550, doi:10.1145/279232.279236.
    """

    max_iterations: Annotated[int, Ge(1), OptionInfo("limit on iterations")] = 200
    cost_tolerance: Annotated[
        float, Gt(0), OptionInfo("converged when the cost falls by less than this fraction in an iteration")
    ] = 1e-9
    name: ClassVar[str] = "single_shooting"

    def __post_init__(self) -> None:
        check_option_bounds(self, f"solver {self.name}")

    def minimize_cost(
        self, problem: EstimationProblem, start: Array, callback: IterationCallback | None
    ) -> SolverResult:
        """Minimize the problem's cost from `start` by L-BFGS-B."""
        (lower, upper), scale = problem.bounds, problem.unknown_scales
        recorder = IterationRecorder(callback)
        cost, gradient, first = problem.cost_and_gradient(start)
        recorder.n_evaluations += 1
        if not first.ok:
            return recorder.result(Status.FAILED, first.message, start)
        unit, warm = max(cost, 1e-300), first.equilibrium_guesses
        seen: dict[bytes, tuple[float, Array]] = {start.tobytes(): (cost, gradient)}

        def function(scaled: Array) -> tuple[float, Array]:
            x = scaled * scale
            key = x.tobytes()
            if key not in seen:
                cost, gradient, evaluation = problem.cost_and_gradient(x, equilibrium_guesses=warm)
                recorder.n_evaluations += 1
                # a failed rollout is a wall: the line search steps back from it
                seen[key] = (cost, gradient) if evaluation.ok else (1e3 * unit, np.zeros_like(x))
            cost, gradient = seen[key]
            return cost / unit, gradient * scale / unit

        def accepted(intermediate_result: scipy.optimize.OptimizeResult) -> None:
            x = intermediate_result.x * scale
            cost, gradient = seen.get(x.tobytes(), (np.nan, np.zeros_like(x)))
            recorder.record_iterate(cost, x, projected_gradient_norm(x, gradient, lower, upper, scale))

        accepted(scipy.optimize.OptimizeResult(x=start / scale))
        result = scipy.optimize.minimize(
            function,
            start / scale,
            jac=True,
            method="L-BFGS-B",
            bounds=scipy.optimize.Bounds(lower / scale, upper / scale),
            callback=accepted,
            options={"maxiter": self.max_iterations, "ftol": self.cost_tolerance, "gtol": 1e-9}
            | {"maxls": 40, "maxcor": 20},
        )
        best = min(recorder.history, key=lambda entry: entry.cost if np.isfinite(entry.cost) else np.inf)
        status = {0: Status.CONVERGED, 1: Status.ITERATION_LIMIT}.get(result.status, Status.STALLED)
        return recorder.result(status, str(result.message).lower(), best.x, warm)


@SOLVERS.register("steepest_descent")
@dataclass(frozen=True)
class SteepestDescent:
    """Projected steepest descent: x <- P(x - s g), P the projection on the bounds, s by Armijo backtracking.

    The gradient comes from the adjoint. Unscaled on purpose: this is what the paper did.

    The first length tried in an iteration is twice the last accepted one, as in the paper, or Barzilai and Borwein's
    from the change of the gradient (`spectral`), which needs far fewer iterations; most of these pay only a few steps
    later and want a `nonmonotone_memory` of about 10.

    References
    ----------
    Armijo (1966), Pacific J. Math. 16:1, doi:10.2140/pjm.1966.16.1.
    Bertsekas (1976), IEEE Trans. Automatic Control 21(2):174, doi:10.1109/TAC.1976.1101194 (projection).
    Birgin, Martinez, Raydan (2000), SIAM J. Optim. 10(4):1196, doi:10.1137/S1052623497330963 (spectral, memory).
    """

    max_iterations: Annotated[int, Ge(1), OptionInfo("limit on accepted steps")] = 200
    gradient_tolerance: Annotated[
        float,
        Gt(0),
        OptionInfo("converged when the projected gradient times the unknowns' size is below this part of the cost"),
    ] = 1e-5
    sufficient_decrease: Annotated[float, Gt(0), Lt(1), OptionInfo("Armijo's constant")] = 1e-4
    backtracking_factor: Annotated[float, Gt(0), Lt(1), OptionInfo("backtracking factor")] = 0.5
    first_trial_step: Annotated[
        Literal["last", "spectral"], OptionInfo("first length tried in an iteration; last is the paper's")
    ] = "last"
    nonmonotone_memory: Annotated[
        int, Ge(1), OptionInfo("the cost must fall below the largest of so many last ones; 1 is the paper's")
    ] = 1
    name: ClassVar[str] = "steepest_descent"

    def __post_init__(self) -> None:
        check_option_bounds(self, f"solver {self.name}")

    def minimize_cost(
        self, problem: EstimationProblem, start: Array, callback: IterationCallback | None
    ) -> SolverResult:
        """Minimize the problem's cost from `start` by projected steepest descent."""
        (lower, upper), recorder, x = problem.bounds, IterationRecorder(callback), start.copy()
        cost, gradient, evaluation = problem.cost_and_gradient(x)
        recorder.n_evaluations += 1
        if not evaluation.ok:
            return recorder.result(Status.FAILED, evaluation.message, x)

        def ended(status: Status, message: str) -> SolverResult:
            best = min(recorder.history, key=lambda entry: entry.cost)
            return recorder.result(status, message, best.x, evaluation.equilibrium_guesses)

        # the first trial moves the unknowns by about a tenth of their size
        length = 0.1 * float(np.linalg.norm(problem.unknown_scales)) / max(float(np.linalg.norm(gradient)), 1e-300)
        for _ in range(self.max_iterations):
            size = np.maximum(np.abs(x), problem.unknown_scales)
            slope = projected_gradient_norm(x, gradient, lower, upper, size)
            recorder.record_iterate(cost, x, slope)
            reference = max(entry.cost for entry in recorder.history[-self.nonmonotone_memory :])
            if slope <= self.gradient_tolerance * max(cost, 1e-300):
                return ended(Status.CONVERGED, "the projected gradient vanishes")
            while True:
                trial = np.clip(x - length * gradient, lower, upper)
                attempt = problem.evaluate(trial, False, evaluation.equilibrium_guesses)
                recorder.n_evaluations += 1
                needed = self.sufficient_decrease * float(gradient @ (x - trial))
                if attempt.ok and attempt.cost <= reference - needed:
                    break
                length *= self.backtracking_factor
                if np.max(np.abs(length * gradient) / size) < 1e-12:
                    return ended(Status.STALLED, "no step along the gradient lowers the cost")
            moved, before, x = trial - x, gradient, trial
            cost, gradient, evaluation = problem.cost_and_gradient(x, attempt)
            length /= self.backtracking_factor
            turned = gradient - before
            if self.first_trial_step == "spectral" and float(moved @ turned) > 0:
                length = float(moved @ moved) / float(moved @ turned)
        size = np.maximum(np.abs(x), problem.unknown_scales)
        recorder.record_iterate(cost, x, projected_gradient_norm(x, gradient, lower, upper, size))
        message = f"no convergence in {self.max_iterations} iterations, as is usual for this method; try gauss_newton"
        return ended(Status.ITERATION_LIMIT, message)

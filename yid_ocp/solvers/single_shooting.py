"""Single shooting: a quasi-Newton method with the adjoint gradient and bounds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
import scipy.optimize
from annotated_types import Ge, Gt
from numpy.typing import NDArray

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

Array = NDArray[np.float64]


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
        first = problem.cost_and_gradient(start)
        recorder.n_evaluations += 1
        if not first[2].ok:
            return recorder.result(Status.FAILED, first[2].message, start)
        unit = max(first[0], 1e-300)
        warm = first[2].equilibrium_guesses
        seen: dict[bytes, tuple[float, Array]] = {start.tobytes(): (first[0], first[1])}
        worst = 1e3

        def function(scaled: Array) -> tuple[float, Array]:
            x = scaled * scale
            key = x.tobytes()
            if key not in seen:
                cost, gradient, evaluation = problem.cost_and_gradient(x, equilibrium_guesses=warm)
                recorder.n_evaluations += 1
                # a failed rollout is a wall: the line search steps back from it
                seen[key] = (cost, gradient) if evaluation.ok else (worst * unit, np.zeros_like(x))
            cost, gradient = seen[key]
            return cost / unit, gradient * scale / unit

        def accepted(scaled: Array) -> None:
            x = scaled * scale
            cost, gradient = seen.get(x.tobytes(), (np.nan, np.zeros_like(x)))
            recorder.record_iterate(cost, x, projected_gradient_norm(x, gradient, lower, upper, scale))

        accepted(start / scale)
        result = scipy.optimize.minimize(
            function,
            start / scale,
            jac=True,
            method="L-BFGS-B",
            bounds=scipy.optimize.Bounds(lower / scale, upper / scale),
            callback=lambda intermediate_result: accepted(intermediate_result.x),
            options={
                "maxiter": self.max_iterations,
                "ftol": self.cost_tolerance,
                "gtol": 1e-9,
                "maxls": 40,
                "maxcor": 20,
            },
        )
        best = min(recorder.history, key=lambda entry: entry.cost if np.isfinite(entry.cost) else np.inf)
        status = {0: Status.CONVERGED, 1: Status.ITERATION_LIMIT}.get(result.status, Status.STALLED)
        return recorder.result(status, str(result.message).lower(), best.x, warm)

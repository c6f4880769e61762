"""Single shooting: a quasi-Newton method with the adjoint gradient and bounds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
import scipy.optimize
from annotated_types import Ge, Gt
from numpy.typing import NDArray

from yid_ocp.options import About, check
from yid_ocp.problem.problem import EstimationProblem
from yid_ocp.solvers.base import SOLVERS, Callback, Outcome, Recorder, Status, projected_gradient

Array = NDArray[np.float64]


@SOLVERS.register("single_shooting")
@dataclass(frozen=True)
class SingleShooting:
    """Minimise the cost by SciPy's L-BFGS-B on unknowns scaled to order one.

    References
    ----------
    Zhu, Byrd, Lu, Nocedal (1997), ACM Trans. Math. Softw. 23(4):550, doi:10.1145/279232.279236.
    """

    iterations: Annotated[int, Ge(1), About("limit on iterations")] = 200
    cost_tolerance: Annotated[
        float, Gt(0), About("converged when the cost falls by less than this fraction in an iteration")
    ] = 1e-9
    name: ClassVar[str] = "single_shooting"

    def __post_init__(self) -> None:
        check(self, f"solver {self.name}")

    def run(self, problem: EstimationProblem, start: Array, callback: Callback | None) -> Outcome:
        """Minimize the problem's cost from `start` by L-BFGS-B."""
        lower, upper = problem.bounds
        scale = problem.scales
        recorder = Recorder(callback)
        first = problem.gradient(start)
        recorder.evaluations += 1
        if not first[2].ok:
            return Outcome(Status.FAILED, first[2].message, start, (), recorder.evaluations)
        unit = max(first[0], 1e-300)
        warm = first[2].warm
        seen: dict[bytes, tuple[float, Array]] = {start.tobytes(): (first[0], first[1])}
        worst = 1e3

        def function(scaled: Array) -> tuple[float, Array]:
            x = scaled * scale
            key = x.tobytes()
            if key not in seen:
                cost, gradient, evaluation = problem.gradient(x, warm=warm)
                recorder.evaluations += 1
                # a failed rollout is a wall: the line search steps back from it
                seen[key] = (cost, gradient) if evaluation.ok else (worst * unit, np.zeros_like(x))
            cost, gradient = seen[key]
            return cost / unit, gradient * scale / unit

        def accepted(scaled: Array) -> None:
            x = scaled * scale
            cost, gradient = seen.get(x.tobytes(), (np.nan, np.zeros_like(x)))
            recorder.accept(cost, x, projected_gradient(x, gradient, lower, upper, scale))

        accepted(start / scale)
        result = scipy.optimize.minimize(
            function,
            start / scale,
            jac=True,
            method="L-BFGS-B",
            bounds=scipy.optimize.Bounds(lower / scale, upper / scale),
            callback=lambda intermediate_result: accepted(intermediate_result.x),
            options={"maxiter": self.iterations, "ftol": self.cost_tolerance, "gtol": 1e-9, "maxls": 40, "maxcor": 20},
        )
        best = min(recorder.history, key=lambda entry: entry.cost if np.isfinite(entry.cost) else np.inf)
        status = (
            Status.CONVERGED
            if result.status == 0
            else (Status.ITERATION_LIMIT if result.status == 1 else Status.STALLED)
        )
        return Outcome(status, str(result.message).lower(), best.x, tuple(recorder.history), recorder.evaluations, warm)

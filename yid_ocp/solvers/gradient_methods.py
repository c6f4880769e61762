"""Solvers that follow rollout gradients: Gauss-Newton, L-BFGS-B, and the published steepest descent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal

import numpy as np
import scipy.optimize
from annotated_types import Ge, Gt

from yid_ocp.arrays import Array
from yid_ocp.inference.linearized_residual import (
    achievable_cost_reduction,
    bounded_levenberg_marquardt_step,
    is_stationary_point,
    max_abs_projected_gradient,
    predicted_cost_reduction_by_step,
    triangular_factor,
)
from yid_ocp.inference.uncertainty import CHI2_95_TWO_SIDED, unknowns_covariance_and_reduced_chi2
from yid_ocp.options import OptionInfo
from yid_ocp.problem.estimation_problem import EstimationProblem
from yid_ocp.problem.evaluation import EvaluateFunction, Evaluation
from yid_ocp.solvers import base

# A positive unknown decreases by at most this factor in a step, until it reaches this fraction of its typical size.
_MAX_DECREASE_FACTOR, _NEAR_ZERO_FRACTION = 10.0, 1e-3
_INITIAL_DAMPING = 1e-6  # initial mu, in units of the largest diagonal entry of the scaled normal matrix
_ARMIJO_CONSTANT = 1e-4  # fraction of the predicted decrease of the cost that a step must reach
_BACKTRACKING_FACTOR = 0.5  # on a rejected step of the steepest descent
_LENGTH_AFTER_FAILURE = 0.25  # of the next step, over that of a rejected one whose trial had no prediction
# The search ends after this many steps (5 if coarse) that together lower the cost by at most this [units of noise] and
# move no unknown by more than this [std], if the predicted decrease is at most the cost of a 95 % interval.
_PATIENCE_STEPS, _NEGLIGIBLE_COST_REDUCTION, _NEGLIGIBLE_MOVE_STDS = (20, 5), 0.05, 0.1
_COARSE_STEP_TOLERANCE = 1e-3
_LOWEST = "the cost cannot be lowered any further"


@base.SOLVERS.register("gauss_newton")
@dataclass(frozen=True)
class GaussNewton(base.SolverWithCheckedSettings):
    """The Gauss-Newton method with bounded, damped linear least-squares steps on the cost 1/2 |r(x)|^2.

    Each iteration solves min |J d + r|^2 + mu |d/s|^2 for the step d, subject to lower <= x + d <= upper, with the
    Jacobian J, the damping mu and the scales s. The step is accepted if the cost falls by a sufficient part of the
    predicted decrease (Nocedal and Wright 2006, Numerical Optimization, chapter 10, doi:10.1007/978-0-387-40065-5). The
    search converges at a stationary point (`is_stationary_point`) or, on a cost with kinks (friction, fast waves),
    after several steps that together lower the cost negligibly compared with the noise (`stopped_at_noise_level`).
    """

    max_iterations: Annotated[int, Ge(1), OptionInfo("limit on accepted steps per start and per weighting")] = 100
    step_tolerance: Annotated[
        float,
        Gt(0),
        OptionInfo("converged if no unknown moves by more than this fraction of its size, at a stationary point"),
    ] = 1e-5
    cost_tolerance: Annotated[
        float, Gt(0), OptionInfo("converged if the predicted relative decrease of the cost is below this")
    ] = 1e-8
    name: ClassVar[str] = "gauss_newton"
    uses_process_noise_covariance: ClassVar[bool] = True

    @property
    def with_coarse_tolerances(self) -> GaussNewton:
        """This solver with looser step and cost tolerances, for preliminary searches."""
        steps, costs = max(self.step_tolerance, _COARSE_STEP_TOLERANCE), max(self.cost_tolerance, 1e-5)
        return replace(self, step_tolerance=steps, cost_tolerance=costs)

    def minimize_cost(
        self,
        problem: EstimationProblem,
        start: Array,
        callback: base.IterationCallback | None,
        evaluate: EvaluateFunction | None = None,
    ) -> base.SolverResult:
        """Minimize the cost from `start` by Gauss-Newton steps. `evaluate` replaces `problem.evaluate`."""
        evaluate = evaluate or problem.evaluate
        (lower, upper), scale = problem.bounds, problem.unknown_scales
        recorder, x = base.AcceptedIterateRecorder(callback), start.copy()
        now = evaluate(x)
        recorder.n_evaluations += 1
        if not now.ok or now.jacobian is None:
            return recorder.solver_result_with_iterates(base.Status.FAILED, now.message, x)

        def ended(status: base.Status, message: str) -> base.SolverResult:
            made = recorder.solver_result_with_iterates(status, message, x, now.equilibrium_guesses)
            return replace(made, evaluation=now)

        mu, rejected, longest = _INITIAL_DAMPING, False, np.inf
        while True:
            jacobian, residual = now.jacobian, now.residual
            assert jacobian is not None
            size = np.maximum(np.abs(x), scale)
            if not rejected:
                reduced = triangular_factor(jacobian, residual)
                reduced[:, :-1] *= size
                slope = max_abs_projected_gradient(x, jacobian.T @ residual, lower, upper, size)
                recorder.record_iterate(now.cost, x, slope)
                patience = _PATIENCE_STEPS[self.step_tolerance >= _COARSE_STEP_TOLERANCE]
                saved = _saved(problem, recorder.history, now, patience)
                if saved is not None:
                    last = f"the last {patience} steps together lowered the cost by only {saved:.2g} (one std: 0.5)"
                    message = f"{last}, and moved no estimated value by more than a tenth of its standard deviation"
                    return replace(ended(base.Status.CONVERGED, message), stopped_at_noise_level=True)
            if len(recorder.history) > self.max_iterations:
                return ended(base.Status.ITERATION_LIMIT, base.iteration_limit_message(self.max_iterations))
            # the linear model holds for a change by a factor, but not for a step to a bound at zero
            guarded = problem.positive_unknowns_mask & (x > _NEAR_ZERO_FRACTION * scale)
            low = (np.where(guarded, np.maximum(lower, x / _MAX_DECREASE_FACTOR), lower) - x) / size
            scaled, mu = _step_within_length(reduced, mu, low, (upper - x) / size, longest)
            step = size * scaled
            promised = predicted_cost_reduction_by_step(jacobian, residual, step)
            # damping makes any step promise little
            if promised <= self.cost_tolerance * max(now.cost, 1e-300) and is_stationary_point(problem, x, now):
                return ended(base.Status.CONVERGED, _LOWEST)
            tried = np.clip(x + step, lower, upper)
            trial = evaluate(tried, not rejected, equilibrium_guesses=now.equilibrium_guesses)
            if rejected and trial.cost < now.cost:
                trial = evaluate(tried, equilibrium_guesses=trial.equilibrium_guesses)
            recorder.n_evaluations += 1
            gain = (now.cost - trial.cost) / promised if trial.ok and promised > 0 else -1.0
            if gain > 1e-3:
                moved = float(np.max(np.abs(scaled)))
                longest = 2.0 * float(np.linalg.norm(scaled)) if rejected else np.inf
                x, now, rejected = tried, trial, False
                mu = max(mu * (0.2 if gain > 0.5 else 1.0 if gain > 0.2 else 3.0), 1e-12)
                if moved < self.step_tolerance and now.jacobian is not None and is_stationary_point(problem, x, now):
                    slope = max_abs_projected_gradient(x, now.jacobian.T @ now.residual, lower, upper, size)
                    recorder.record_iterate(now.cost, x, slope)
                    return ended(base.Status.CONVERGED, "the last step is below solver.step_tolerance")
                continue
            # the parabola through both costs with the slope of the first has its minimum at this fraction of the step
            slope = float(residual @ (jacobian @ step))
            fraction = -0.5 * slope / max(trial.cost - now.cost - slope, 1e-300) if trial.ok else _LENGTH_AFTER_FAILURE
            longest, rejected = float(np.clip(fraction, 0.1, 0.5) * np.linalg.norm(scaled)), True
            if np.max(np.abs(scaled)) < self.step_tolerance:
                if is_stationary_point(problem, x, now):
                    return ended(base.Status.CONVERGED, _LOWEST)
                message = f"no step lowers the cost ({trial.message or 'the linear model does not hold'}). "
                message += "Set other parameters.NAME.initial, shorten the recording, or use multiple_shooting"
                return ended(base.Status.STALLED, message)


def _step_within_length(reduced: Array, mu: float, low: Array, high: Array, longest: float) -> tuple[Array, float]:
    """Damped step within bounds, and its damping, which is raised until the step is at most `longest`."""
    while True:
        step = bounded_levenberg_marquardt_step(reduced[:, :-1], reduced[:, -1], mu, low, high)
        if not np.linalg.norm(step) > longest:
            return step, mu
        mu *= 3.0


def _saved(problem: EstimationProblem, history: Sequence[base.Iterate], now: Evaluation, steps: int) -> float | None:
    """Total decrease of the cost in the last steps if it is negligible, else None."""
    if len(history) <= steps:
        return None
    before, last, unit = history[-1 - steps], history[-1], problem.stated_rms_noise_of_data_residuals**2
    saved = before.cost - last.cost
    if saved > _NEGLIGIBLE_COST_REDUCTION * unit:
        return None
    if achievable_cost_reduction(problem, last.x, now) > 0.5 * CHI2_95_TWO_SIDED * unit:
        return None
    std = np.sqrt(np.maximum(np.diag(unknowns_covariance_and_reduced_chi2(problem, now)[0]), 0.0))
    return saved if np.all(np.abs(last.x - before.x) <= _NEGLIGIBLE_MOVE_STDS * std) else None


@base.SOLVERS.register("single_shooting")
@dataclass(frozen=True)
class SingleShooting(base.SolverWithCheckedSettings):
    """The single shooting method: SciPy's L-BFGS-B minimises the cost over unknowns that are scaled to order one.

    Zhu, Byrd, Lu, Nocedal (1997), ACM Trans. Math. Softw. 23(4):550, doi:10.1145/279232.279236.
    """

    max_iterations: Annotated[int, Ge(1), OptionInfo("limit on iterations")] = 200
    cost_tolerance: Annotated[
        float, Gt(0), OptionInfo("converged if the cost falls by less than this fraction in an iteration")
    ] = 1e-9
    name: ClassVar[str] = "single_shooting"

    def minimize_cost(
        self, problem: EstimationProblem, start: Array, callback: base.IterationCallback | None
    ) -> base.SolverResult:
        """Minimize the problem's cost from `start` by L-BFGS-B."""
        (lower, upper), scale = problem.bounds, problem.unknown_scales
        recorder = base.AcceptedIterateRecorder(callback)
        cost, gradient, first = problem.cost_and_gradient(start)
        recorder.n_evaluations += 1
        if not first.ok:
            return recorder.solver_result_with_iterates(base.Status.FAILED, first.message, start)
        unit, warm = max(cost, 1e-300), first.equilibrium_guesses
        seen: dict[bytes, tuple[float, Array]] = {start.tobytes(): (cost, gradient)}

        def function(scaled: Array) -> tuple[float, Array]:
            x = scaled * scale
            key = x.tobytes()
            if key not in seen:
                cost, gradient, evaluation = problem.cost_and_gradient(x, equilibrium_guesses=warm)
                recorder.n_evaluations += 1
                # a failed rollout has a large cost, from which the line search steps back
                seen[key] = (cost, gradient) if evaluation.ok else (1e3 * unit, np.zeros_like(x))
            cost, gradient = seen[key]
            return cost / unit, gradient * scale / unit

        def accepted(intermediate_result: scipy.optimize.OptimizeResult) -> None:
            x = intermediate_result.x * scale
            cost, gradient = seen.get(x.tobytes(), (np.nan, np.zeros_like(x)))
            recorder.record_iterate(cost, x, max_abs_projected_gradient(x, gradient, lower, upper, scale))

        accepted(scipy.optimize.OptimizeResult(x=start / scale))
        options = {"maxiter": self.max_iterations, "ftol": self.cost_tolerance, "gtol": 1e-9, "maxls": 40, "maxcor": 20}
        bounds = scipy.optimize.Bounds(lower / scale, upper / scale)
        result = scipy.optimize.minimize(
            function, start / scale, jac=True, method="L-BFGS-B", bounds=bounds, callback=accepted, options=options
        )
        best = min(recorder.history, key=lambda entry: entry.cost if np.isfinite(entry.cost) else np.inf)
        status = {0: base.Status.CONVERGED, 1: base.Status.ITERATION_LIMIT}.get(result.status, base.Status.STALLED)
        words = {0: "the cost no longer falls", 1: base.iteration_limit_message(self.max_iterations)}
        message = words.get(result.status, f"no minimum was found ({result.message}). Use gauss_newton")
        return recorder.solver_result_with_iterates(status, message, best.x, warm)


@base.SOLVERS.register("steepest_descent")
@dataclass(frozen=True)
class SteepestDescent(base.SolverWithCheckedSettings):
    """The steepest descent method with Armijo backtracking: x <- P(x - s g), where P projects onto the bounds.

    The gradient g comes from the adjoint method and is not scaled, as in the paper (Caldwell et al. 2014). The first
    trial step s of an iteration is twice the last accepted step (`last`, as in the paper), or the Barzilai-Borwein step
    (`spectral`). The spectral step needs far fewer iterations if the cost may rise in a few of them: with
    `nonmonotone_memory: 10`, a step must only lower the largest of the last 10 costs.

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
        OptionInfo("converged if the projected gradient times the unknowns' size is below this fraction of the cost"),
    ] = 1e-5
    first_trial_step_rule: Annotated[
        Literal["last", "spectral"], OptionInfo("first trial step length of an iteration; last: Caldwell et al. (2014)")
    ] = "last"
    nonmonotone_memory: Annotated[
        int, Ge(1), OptionInfo("the cost must fall below the largest of this many previous values; 1: monotone descent")
    ] = 1
    name: ClassVar[str] = "steepest_descent"

    def minimize_cost(
        self, problem: EstimationProblem, start: Array, callback: base.IterationCallback | None
    ) -> base.SolverResult:
        """Minimize the problem's cost from `start` by projected steepest descent."""
        (lower, upper), recorder, x = problem.bounds, base.AcceptedIterateRecorder(callback), start.copy()
        cost, gradient, evaluation = problem.cost_and_gradient(x)
        recorder.n_evaluations += 1
        if not evaluation.ok:
            return recorder.solver_result_with_iterates(base.Status.FAILED, evaluation.message, x)

        def ended(status: base.Status, message: str) -> base.SolverResult:
            best = min(recorder.history, key=lambda entry: entry.cost)
            return recorder.solver_result_with_iterates(status, message, best.x, evaluation.equilibrium_guesses)

        # the first trial moves the unknowns by about a tenth of their size
        length = 0.1 * float(np.linalg.norm(problem.unknown_scales)) / max(float(np.linalg.norm(gradient)), 1e-300)
        while True:
            size = np.maximum(np.abs(x), problem.unknown_scales)
            slope = max_abs_projected_gradient(x, gradient, lower, upper, size)
            recorder.record_iterate(cost, x, slope)
            if len(recorder.history) > self.max_iterations:
                limit = f"a start reached its limit of {self.max_iterations} iterations (solver.max_iterations)"
                return ended(base.Status.ITERATION_LIMIT, f"{limit}, as is usual for this method. Use gauss_newton")
            reference = max(entry.cost for entry in recorder.history[-self.nonmonotone_memory :])
            if slope <= self.gradient_tolerance * max(cost, 1e-300):
                return ended(base.Status.CONVERGED, "the projected gradient vanishes")
            while True:
                trial = np.clip(x - length * gradient, lower, upper)
                attempt = problem.evaluate(trial, False, evaluation.equilibrium_guesses)
                recorder.n_evaluations += 1
                if attempt.ok and attempt.cost <= reference - _ARMIJO_CONSTANT * float(gradient @ (x - trial)):
                    break
                length *= _BACKTRACKING_FACTOR
                if np.max(np.abs(length * gradient) / size) < 1e-12:
                    return ended(base.Status.STALLED, "no step along the gradient lowers the cost. Use gauss_newton")
            moved, before, x = trial - x, gradient, trial
            cost, gradient, evaluation = problem.cost_and_gradient(x, attempt)
            length /= _BACKTRACKING_FACTOR
            turned = gradient - before
            if self.first_trial_step_rule == "spectral" and float(moved @ turned) > 0:
                length = float(moved @ moved) / float(moved @ turned)

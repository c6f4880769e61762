"""The stepping kernel for machines without a C compiler, in CasADi and NumPy with a plain Newton method.

It shares only the `DiscreteEquations` with `kernel.c`, so that each kernel is a check of the other.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np
import scipy.linalg.lapack
from numpy.typing import NDArray

from yid_ocp.arrays import Array, IntArray
from yid_ocp.integrator import step_model
from yid_ocp.parallel import CasadiLockedCache

_PointEvaluator = Callable[[Array], list[Array]]


class InterpretedKernel:
    """A thread-safe stepping kernel that runs in CasADi's interpreter and NumPy, for machines without a compiler.

    It has the methods of `CompiledKernel`. A point is a column of all `DiscreteEquations.arguments`. The outputs at a
    point are the residuals of the balance, internal and constraint equations, then p1, then the prescribed efforts.
    """

    def __init__(self, model: step_model.StepEquationsAndFunctions) -> None:
        self._model = model
        self._functions: CasadiLockedCache[None, list[ca.Function]] = CasadiLockedCache(self._made)
        self._own = threading.local()
        system, sizes = model.system, model.sizes
        names = ("q0", "q1", "p0", "z0", "z1", "lam", "u", "theta", "time_step")
        ends = np.cumsum([0, *(argument.numel() for argument in model.equations.arguments)])
        self._at = {name: np.arange(*ends[i : i + 2]) for i, name in enumerate(names)}
        indices = system.unprescribed_coordinate_indices, system.prescribed_coordinate_indices
        free, fixed = (np.array(entries, int) for entries in indices)
        self._fixed, self._coordinates = self._at["q1"][fixed], len(free) + sizes["nz"]
        self._unknown = np.concatenate([self._at["q1"][free], self._at["z1"], self._at["lam"]])
        self._rows = sizes["n"] + sizes["nz"] + sizes["m"]
        self._residual = np.concatenate([free, np.arange(sizes["n"], self._rows)])
        self._square = np.ix_(self._residual, self._unknown)
        self._p1, self._effort = slice(self._rows, self._rows + sizes["n"]), slice(self._rows + sizes["n"], None)

    def make_kernel_sharing_code(self, model: step_model.StepEquationsAndFunctions) -> InterpretedKernel:
        """Create a kernel that reuses this kernel's functions for a `model` with the same equations."""
        other = InterpretedKernel(model)
        other._functions, other._own = self._functions, self._own
        return other

    def _evaluators(self) -> Sequence[_PointEvaluator]:
        """Evaluators, for this thread, of the outputs, the residual's Jacobian by the unknowns, and that of all."""
        if not hasattr(self._own, "evaluators"):
            self._own.evaluators = [dense_function_evaluator(f, kept=False) for f in self._functions(None)]
        return tuple(self._own.evaluators)

    def _made(self, _: None) -> list[ca.Function]:
        e, point = self._model.equations, ca.vertcat(*self._model.equations.arguments)
        effort = -e.momentum_balance[list(self._model.system.prescribed_coordinate_indices), 0] / e.h
        outputs = ca.cse(ca.vertcat(e.momentum_balance, e.internal_residual, e.constraint_residual, e.p1, effort))
        slope = ca.jacobian(outputs[self._residual.tolist()], e.newton_unknowns)
        return [ca.Function("f", [point], [ca.densify(x)]) for x in (outputs, slope, ca.jacobian(outputs, point))]

    def _point(self, theta: Array, before: Array, after: Array, lam: Array, u: Array) -> Array:
        n = self._model.sizes["n"]
        parts = (before[:n], after[:n], before[n : 2 * n], before[2 * n :], after[2 * n :], lam, u, theta)
        return np.concatenate([*parts, [self._model.time_step]])

    def _columns(self, names: Sequence[str]) -> IntArray:
        """Indices of parameters in a point."""
        return self._at["theta"][[self._model.system.parameters.index(name) for name in names]]

    def _newton(
        self, value: _PointEvaluator, slope: _PointEvaluator, point: Array, by_work: bool
    ) -> tuple[step_model.NewtonStatusCode, float, int]:
        """Solve for the unknowns in the point, by Newton's method with the line searches of kernel.c."""

        def largest(change: Array) -> float:
            return float(np.maximum.reduce(np.abs(change[: self._coordinates]), initial=0.0))

        tolerance, error, balance = self._model.tolerance, math.inf, slice(self._coordinates - self._model.sizes["nz"])
        if not len(self._unknown):  # all coordinates are prescribed
            return step_model.NewtonStatusCode.OK, 0.0, 1
        previous = math.inf
        for iteration in range(1, step_model.NEWTON_ITERATION_LIMIT + 1):
            residual = value(point)[0][self._residual, 0]
            if not np.isfinite(residual).all():
                return step_model.NewtonStatusCode.NOT_FINITE, error, iteration
            factors = _factorised(slope(point)[0])
            if factors is None:
                return step_model.NewtonStatusCode.SINGULAR, error, iteration
            change = -_solved(factors, residual)
            error = largest(change)
            if not math.isfinite(error):
                return step_model.NewtonStatusCode.NOT_FINITE, error, iteration
            is_near = error < 1e3 * tolerance
            if error <= tolerance or (is_near and error > 0.5 * previous):
                point[self._at["lam"]] += change[self._coordinates :]
                return step_model.NewtonStatusCode.OK, error, iteration
            work, start = float(residual[balance] @ change[balance]), point[self._unknown]
            if by_work and work == 0:
                return step_model.NewtonStatusCode.NOT_CONVERGED, error, iteration
            longest = min(1.0, 0.5 / error) * (-1.0 if by_work and work < 0 and not is_near else 1.0)
            low, low_left, high, part = 0.0, 1.0, 1.0, 1.0
            while True:
                point[self._unknown] = start + longest * part * change
                residual, left = value(point)[0][self._residual, 0], math.nan
                is_finite = bool(np.isfinite(residual).all())
                if by_work and is_finite:
                    left = float(residual[balance] @ change[balance]) / work
                    is_good = abs(left) <= 0.5 or (left > 0 and part == 1.0)
                else:
                    after = largest(_solved(factors, residual))
                    is_good = is_finite and not by_work and after <= (1 - 0.25 * longest * part) * error
                if is_good or is_near or (by_work and high - low < 1e-4):
                    break
                if high - low < 1e-4:
                    return step_model.NewtonStatusCode.NOT_CONVERGED, error, iteration
                if left > 0:
                    low, low_left = part, left
                else:
                    high = part
                root = low + (high - low) * low_left / (low_left - left) if left < 0 else 0.5 * (low + high)
                part = min(max(root, 0.9 * low + 0.1 * high), 0.1 * low + 0.9 * high)
            previous = error if longest * part == 1.0 else math.inf
        return step_model.NewtonStatusCode.NOT_CONVERGED, error, step_model.NEWTON_ITERATION_LIMIT

    @np.errstate(over="ignore", invalid="ignore")  # the status says what is not finite
    def rollout(self, inputs: step_model.RolloutInputs) -> step_model.Rollout:
        """Simulate one rollout step by step, with its derivatives."""
        theta, torque, path = inputs.theta, inputs.torque, inputs.prescribed_path
        feedback, wanted = inputs.feedback, inputs.directions
        (value, slope, slopes), n, lam = self._evaluators(), self._model.sizes["n"], np.zeros(self._model.sizes["m"])
        out = step_model.allocate_rollout(self._model.sizes, len(torque), None if wanted is None else wanted.count)
        state, by = out.state, [getattr(out, f"{name}_sensitivity") for name in ("state", "multipliers", "effort")]
        state[0] = inputs.initial_state
        if wanted is not None:
            by[0][0] = wanted.initial_state_tangents
        code, error, total, done = step_model.NewtonStatusCode.OK, 0.0, 0, 0
        for k, u in enumerate(torque):
            x = state[k]
            if feedback is not None:
                u = u - feedback.gain[k] @ (x[feedback.state_indices] - feedback.reference[k])
            guess = x if k == 0 else 2 * x - state[k - 1]
            if k > 1:
                guess[:n] += x[:n] - 2 * state[k - 1, :n] + state[k - 2, :n]
            attempts = (guess, lam, False), (x, 0 * lam, False), (x, 0 * lam, True)
            for i, (first, pull, by_work) in enumerate(attempts):
                point = self._point(theta, x, first, pull, u)
                point[self._fixed] = path[k + 1]
                end, error, spent = self._newton(value, slope, point, by_work)
                code = end if i == 0 or end == step_model.NewtonStatusCode.OK else code
                total += spent
                if code == step_model.NewtonStatusCode.OK:
                    break
            outputs, lam = value(point)[0][:, 0], point[self._at["lam"]]
            state[k + 1] = np.concatenate([point[self._at["q1"]], outputs[self._p1], point[self._at["z1"]]])
            if code != step_model.NewtonStatusCode.OK:
                break
            out.torque[k], out.multipliers[k], out.effort[k] = u, lam, outputs[self._effort]
            if wanted is not None:
                moved = self._moved(slopes(point)[0], wanted, feedback, by[0][k], k)
                if moved is None:
                    code = step_model.NewtonStatusCode.SINGULAR
                    break
                by[0][k + 1], by[1][k], by[2][k] = moved
            done = k + 1
        return step_model.attach_status_to_rollout(out, self._model.sizes, code, done, error, total)

    def _moved(
        self,
        slopes: Array,
        wanted: step_model.SensitivityDirections,
        feedback: step_model.TrackingFeedback | None,
        before: Array,
        k: int,
        loads: tuple[Array, Array] | None = None,
    ) -> tuple[Array, Array, Array] | None:
        """Derivatives of state, multipliers and effort after step k, by implicit differentiation; loads come last."""
        n, at, names = self._model.sizes["n"], self._at, wanted.parameter_names
        moved = np.zeros((slopes.shape[1], wanted.count))
        moved[at["q0"]], moved[at["p0"]], moved[at["z0"]] = before[:n], before[n : 2 * n], before[2 * n :]
        moved[self._columns(names), np.arange(len(names))] = 1.0
        if wanted.torque_tangents is not None:
            moved[at["u"]] = wanted.torque_tangents[k]
        if feedback is not None:
            moved[at["u"]] -= feedback.gain[k] @ before[feedback.state_indices]
        if wanted.prescribed_tangents is not None:
            moved[self._fixed] = wanted.prescribed_tangents[k + 1]
        change = slopes @ moved
        if loads is not None:
            last, fixed = slice(wanted.count - loads[0].shape[1], None), self._fixed - at["q1"][0]
            change[: self._rows, last] += loads[0]
            change[self._p1, last] += loads[1]
            # in the balance they add to the momentum
            change[self._effort, last] += slopes[self._effort, at["p0"][fixed]] @ loads[0][fixed]
        factors = _factorised(slopes[self._square])
        if factors is None:
            return None
        moved[self._unknown] = -_solved(factors, change[self._residual])
        change += slopes[:, self._unknown] @ moved[self._unknown]
        after = np.concatenate([moved[at["q1"]], change[self._p1], moved[at["z1"]]])
        return after, moved[at["lam"]], change[self._effort]

    def linearized_rollout_steps(
        self,
        theta: Array,
        along: step_model.Rollout,
        feedback: step_model.TrackingFeedback | None,
        inputs: Array,
        loads: tuple[Array, Array],
    ) -> tuple[Array, Array]:
        """Compute the derivatives of a rollout's steps, as `step.linearized_rollout_steps` describes them."""
        slopes, nx, extra = self._evaluators()[-1], along.state.shape[1], loads[0].shape[1]
        before = np.eye(nx, nx + inputs.shape[2] + extra)
        wanted = step_model.SensitivityDirections((), before, np.pad(inputs, ((0, 0), (0, 0), (nx, extra))))
        found = []
        for k, u in enumerate(along.torque):
            point = self._point(theta, along.state[k], along.state[k + 1], along.multipliers[k], u)
            moved = self._moved(slopes(point)[0], wanted, feedback, before, k, loads)
            if moved is None:
                raise np.linalg.LinAlgError("the equations of a time step have a singular Jacobian")
            found.append((moved[0], np.vstack([moved[2], moved[1] / self._model.time_step])))
        return np.array([one[0] for one in found]), np.array([one[1] for one in found])

    def rollout_batch(self, members: Sequence[step_model.RolloutInputs]) -> list[step_model.Rollout]:
        """Simulate several rollouts one after another."""
        return [self.rollout(member) for member in members]

    def adjoint_gradient(
        self,
        theta: Array,
        rollout: step_model.Rollout,
        feedback: step_model.TrackingFeedback | None,
        names: tuple[str, ...],
        by: step_model.CostDerivativesByRolloutOutputs,
    ) -> step_model.RolloutCostGradient:
        """Compute the gradient of a cost J along a rollout by the adjoint method. `by` holds J's partial derivatives.

        costate_N = dJ/dx_N, costate_k = costate_{k+1} A_k + dJ/dx_k, gradient = sum_k costate_{k+1} B_k.
        """
        by_state, by_multipliers, by_effort = by
        sizes, at, steps = self._model.sizes, self._at, len(rollout.torque)
        slopes, n = self._evaluators()[-1], sizes["n"]
        by_theta, by_torque = np.zeros(len(names)), np.zeros((steps, sizes["nu"]))
        by_path, costate = np.zeros((steps + 1, sizes["nc"])), by_state[steps].copy()
        for k in reversed(range(steps)):
            x, after = rollout.state[k], rollout.state[k + 1]
            jacobian = slopes(self._point(theta, x, after, rollout.multipliers[k], rollout.torque[k]))[0]
            weight = np.zeros(len(jacobian))
            weight[self._p1] = costate[n : 2 * n]
            weight[self._effort] = 0.0 if by_effort is None else by_effort[k]
            by_point = jacobian.T @ weight
            by_point[at["q1"]] += costate[:n]
            by_point[at["z1"]] += costate[2 * n :]
            by_point[at["lam"]] += 0.0 if by_multipliers is None else by_multipliers[k]
            factors = _factorised(jacobian[self._square].T)
            if factors is None:
                return step_model.RolloutCostGradient(
                    *(np.full_like(a, np.nan) for a in (by_theta, costate, by_torque, by_path))
                )
            by_point -= jacobian[self._residual].T @ _solved(factors, by_point[self._unknown])
            by_theta += by_point[self._columns(names)]
            by_torque[k], by_path[k + 1] = by_point[at["u"]], by_point[self._fixed]
            costate = np.concatenate([by_point[at[name]] for name in ("q0", "p0", "z0")]) + by_state[k]
            if feedback is not None:
                np.subtract.at(costate, feedback.state_indices, feedback.gain[k].T @ by_torque[k])
        by_path[0] = costate[list(self._model.system.prescribed_coordinate_indices)]
        return step_model.RolloutCostGradient(by_theta, costate, by_torque, by_path)

    def step_residuals_and_jacobians(
        self, theta: Array, state: Array, multipliers: Array, torque: Array, names: tuple[str, ...], derivatives: bool
    ) -> step_model.StepResidualsAndJacobians:
        """Evaluate the step residuals along any trajectory. Without `derivatives`, the Jacobians are empty."""
        (value, _, slopes), at = self._evaluators(), self._at
        out = step_model.allocate_step_linearizations(self._model.sizes, len(torque), len(names), derivatives)
        new, old = np.concatenate([at["q1"], at["z1"], at["lam"]]), np.concatenate([at["q0"], at["z0"]])
        columns = {"new": new, "old": old, "input": at["u"], "theta": self._columns(names)}
        for k, u in enumerate(torque):
            point = self._point(theta, state[k], state[k + 1], multipliers[k], u)
            outputs = value(point)[0][:, 0]
            out.residual[k], out.p1[k] = outputs[: self._rows], outputs[self._p1]
            if derivatives:
                jacobian = slopes(point)[0]
                for key, index in columns.items():
                    getattr(out, f"residual_by_{key}")[k] = jacobian[: self._rows, index]
                    getattr(out, f"p1_by_{key}")[k] = jacobian[self._p1, index]
        return out


def dense_function_evaluator(function: Any, kept: bool = True) -> Callable[[Array], list[Array]]:
    """Create a fast one-thread evaluator of a CasADi function of a vector. A call overwrites outputs unless `kept`."""
    point = np.zeros(function.numel_in(0))
    results = [np.zeros(function.size_out(i)[::-1]) for i in range(function.n_out())]
    run, views = function_bound_to_arrays(function, [point], results), [result.T for result in results]

    def evaluate(values: Array) -> list[Array]:
        point[:] = values
        run()
        return [view.copy() for view in views] if kept else views

    return evaluate


def function_bound_to_arrays(function: Any, inputs: Sequence[Array], outputs: Sequence[Array]) -> Callable[[], None]:
    """Return a function that evaluates a CasADi function from and into contiguous arrays (of nonzeros by column)."""
    buffer, run = function.buffer()
    for bind, arrays in ((buffer.set_arg, inputs), (buffer.set_res, outputs)):
        for i, array in enumerate(arrays):
            if array.size:
                bind(i, array.data)

    def evaluate() -> None:
        run()
        if buffer.ret():  # which also keeps the buffer alive
            raise RuntimeError(f"CasADi could not evaluate {function}")

    return evaluate


def _factorised(matrix: Array) -> tuple[Array, NDArray[np.int32]] | None:
    """LU factors by LAPACK, without warnings; None if the matrix is singular."""
    if not len(matrix):
        return matrix, np.zeros(0, np.int32)
    factors, pivots, info = scipy.linalg.lapack.dgetrf(matrix)
    return None if info else (factors, pivots)


def _solved(factors: tuple[Array, NDArray[np.int32]], right: Array) -> Array:
    solution: Array = scipy.linalg.lapack.dgetrs(*factors, right)[0] if right.size else right
    return solution

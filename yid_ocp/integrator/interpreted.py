"""The sweeps by CasADi's interpreter and SciPy's LU, for machines without a C compiler."""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from yid_ocp.integrator import codegen
from yid_ocp.integrator.step_model import (
    ITERATION_LIMIT,
    LINEARIZATION_MATRICES,
    Directions,
    Feedback,
    Gradient,
    Rollout,
    StepCode,
    StepLinearization,
    StepModel,
    empty_linearization,
    status_of,
)

Array = NDArray[np.float64]


@dataclass
class _Linearised:
    """Dense Jacobians of one converged step, as in `kernel.c`."""

    rows_new: Array
    rows_old: Array
    rows_input: Array
    p1_new: Array
    p1_old: Array
    p1_input: Array


class InterpretedKernel:
    """The same sweeps by CasADi's interpreter and SciPy's LU, for machines without a C compiler."""

    def __init__(self, model: StepModel) -> None:
        self._model = model
        n = model.system.size
        self._mask = np.zeros((n, n), bool)
        for j, chain in enumerate(model.structure.ancestors):
            self._mask[j, chain] = True
        self._theta_functions: dict[tuple[str, ...], ca.Function] = {}
        patterns = model.functions.patterns
        self._triplets = {
            key: tuple(np.array(part, np.intp) for part in s.get_triplet()) for key, s in patterns.items()
        }
        self._unknown = model.structure.unknown_row
        self._free = np.array(model.system.free_indices, np.intp)
        self._fixed = np.array(model.system.prescribed_indices, np.intp)

    def _scales(self, theta: Array) -> tuple[Array, float]:
        s = self._model.sizes
        zero = [np.zeros(s["n"])] * 3 + [np.zeros(s["nz"])] * 2 + [np.zeros(s["m"]), np.zeros(s["nu"])]
        scale, h = self._model.functions.scales(*zero, theta, self._model.time_step)
        return np.array(scale).ravel(), float(h)

    def _matrix(self, arguments: list[Array | float]) -> Array:
        s = self._model.sizes
        phi = np.zeros((s["m"], s["n"]))
        phi[self._triplets["matrix"]] = np.array(self._model.functions.matrix(*arguments)).ravel()
        return phi

    def _rows(self, arguments: list[Array | float], phi: Array, scale: Array) -> tuple[Array, Array]:
        balance, internal, constraint, p1 = (np.array(x).ravel() for x in self._model.functions.residual(*arguments))
        pull = phi.T @ np.asarray(arguments[5])
        return np.concatenate([balance - scale * pull, internal, constraint]), p1

    def _linearise(self, arguments: list[Array | float], phi: Array, scale: Array) -> _Linearised:
        s = self._model.sizes
        n, nz, m, nu = s["n"], s["nz"], s["m"], s["nu"]
        nt, nqz = n + nz + m, n + nz
        pairs, rest, rest_p, by_unknown = (np.array(x).ravel() for x in self._model.functions.linear(*arguments))
        plus, minus, lower, upper = (pairs[6 * n * i : 6 * n * (i + 1)].reshape(6, n) for i in range(4))
        turn, moment = (pairs[3 * n * i : 3 * n * (i + 1)].reshape(3, n) for i in (8, 9))
        weight = moment.T @ turn
        low, up = (
            np.where(self._mask, lower.T @ plus + weight, 0.0),
            np.where(self._mask, weight - upper.T @ minus, 0.0),
        )
        here = np.where(self._mask, weight - lower.T @ minus, 0.0)
        there = np.where(self._mask, weight + upper.T @ plus, 0.0)
        strict = np.tril(np.ones((n, n)), -1)

        def both(below: Array, above: Array) -> Array:
            diagonal = np.diag(np.diag(below))
            return below * strict + (above * strict).T + diagonal

        slope = both(low, up)
        rows_new, rows_old, rows_input = np.zeros((nt, nt)), np.zeros((nt, nqz)), np.zeros((nt, nu))
        p1_new, p1_old, p1_input = np.zeros((n, nt)), np.zeros((n, nqz)), np.zeros((n, nu))
        rows_new[:n, :n] = scale[:, None] * slope
        rows_old[:n, :n] = scale[:, None] * both(here, here)
        p1_new[:, :n], p1_old[:, :n] = scale[:, None] * both(there, there), scale[:, None] * slope.T
        if self._model.equations.closed is not None:
            along, turned = (pairs[6 * n * i : 6 * n * (i + 1)].reshape(6, n) for i in (5, 6))
            screw = (plus + minus) / 2
            by_rate, by_turn, by_posture = (
                np.where(self._mask, x.T @ y, 0.0) for x, y in ((along, screw), (along, plus - screw), (turned, screw))
            )
            for share, new, old in zip(
                self._model.equations.closed_shares, (rows_new, p1_new), (rows_old, p1_old), strict=True
            ):
                new[:n, :n] += share * scale[:, None] * both(by_turn + by_rate, by_posture + by_rate)
                old[:n, :n] += share * scale[:, None] * both(by_turn - by_rate, by_posture - by_rate)
        for key, values, blocks in (
            ("rest", rest, (rows_new, rows_old, rows_input)),
            ("rest_p", rest_p, (p1_new, p1_old, p1_input)),
        ):
            row, column = self._triplets[key]
            wide = np.zeros((blocks[0].shape[0], nt + nqz + nu))
            wide[row, column] = values
            for block, part in zip(blocks, np.split(wide, [nt, nt + nqz], axis=1), strict=True):
                block += part
        row, column = self._triplets["constraint"]
        rows_new[n + nz + row, column] += by_unknown
        rows_new[:n, n + nz :] -= scale[:, None] * phi.T
        if m:
            row, column = self._triplets["pull"]
            rows_old[row, column] -= scale[row] * np.array(self._model.functions.pull(*arguments)).ravel()
        return _Linearised(rows_new, rows_old, rows_input, p1_new, p1_old, p1_input)

    def _by_theta(self, names: tuple[str, ...], arguments: list[Array | float]) -> list[Array]:
        if names not in self._theta_functions:
            self._theta_functions[names] = codegen.theta_function(self._model.equations, names)
        return [np.array(ca.densify(out)) for out in self._theta_functions[names].call(arguments)]

    def _factorised(self, arguments: list[Array | float], phi: Array, scale: Array) -> list[Array] | None:
        """LU factors of the step's Jacobian, None where it is singular."""
        jacobian = self._linearise(arguments, phi, scale).rows_new[np.ix_(self._unknown, self._unknown)]
        *factors, singular = scipy.linalg.lapack.dgetrf(jacobian)
        return None if singular else factors

    def _newton(
        self, arguments: list[Array | float], phi: Array, scale: Array, kept: list[list[Array]]
    ) -> tuple[StepCode, float, Array, int]:
        """Newton with the factors in `kept` for as long as they contract, damped with fresh ones after that."""
        n, nz = self._model.sizes["n"], self._model.sizes["nz"]
        count = len(self._free) + nz
        q1, z1, lam = arguments[1], arguments[4], arguments[5]
        assert isinstance(q1, np.ndarray)
        assert isinstance(z1, np.ndarray)
        assert isinstance(lam, np.ndarray)
        previous, error, tolerance = math.inf, 0.0, self._model.tolerance
        for iteration in range(1, ITERATION_LIMIT + 1):
            rows, p1 = self._rows(arguments, phi, scale)
            if not np.all(np.isfinite(rows[self._unknown])):
                return StepCode.NOT_FINITE, error, p1, iteration
            if len(self._unknown) == 0:
                return StepCode.OK, 0.0, p1, iteration
            fresh = not kept
            if fresh:
                factors = self._factorised(arguments, phi, scale)
                if factors is None:
                    return StepCode.SINGULAR, error, p1, iteration
                kept[:] = [factors]
            delta = -scipy.linalg.lu_solve(kept[0], rows[self._unknown], check_finite=False)
            error = float(np.max(np.abs(delta[:count]), initial=0.0))
            if not math.isfinite(error):
                return StepCode.SINGULAR, error, p1, iteration
            if error <= tolerance or (error < 1e3 * tolerance and error > 0.5 * previous):
                lam += delta[count:]
                return StepCode.OK, error, p1, iteration
            if not fresh and (error > 0.1 * previous or error > 0.5):
                kept.clear()
                continue
            previous = error
            keep = q1.copy(), z1.copy(), lam.copy()
            factor = 0.5 / error if error > 0.5 else 1.0
            while True:
                q1[self._free] += factor * delta[: len(self._free)]
                z1 += factor * delta[len(self._free) : count]
                lam += factor * delta[count:]
                if not fresh:
                    break
                after = self._rows(arguments, phi, scale)[0][self._unknown]
                trial = scipy.linalg.lu_solve(kept[0], after, check_finite=False)
                if np.max(np.abs(trial[:count]), initial=0.0) <= (1 - 0.25 * factor) * error:
                    break
                if factor < 1e-4:
                    return StepCode.NOT_CONVERGED, error, p1, iteration
                q1[:], z1[:], lam[:] = keep
                factor *= 0.5
        return StepCode.NOT_CONVERGED, error, np.full(n, np.nan), ITERATION_LIMIT

    def rollout(
        self,
        theta: Array,
        start: Array,
        torque: Array,
        path: Array,
        feedback: Feedback | None,
        wanted: Directions | None,
    ) -> Rollout:
        """See `Kernel.rollout`."""
        s = self._model.sizes
        n, m, nx = s["n"], s["m"], s["nx"]
        steps, d = len(torque), 0 if wanted is None else wanted.count
        scale, h = self._scales(theta)
        state = np.full((steps + 1, nx), np.nan)
        state[0] = start
        multipliers, effort = np.full((steps, m), np.nan), np.full((steps, s["nc"]), np.nan)
        applied = np.full((steps, s["nu"]), np.nan)
        by_state, by_multipliers = np.full((steps + 1, nx, d), np.nan), np.full((steps, m, d), np.nan)
        by_effort = np.full((steps, s["nc"], d), np.nan)
        if wanted is not None:
            by_state[0] = wanted.start
        kept: list[list[Array]] = []
        total, code, error, k = 0, StepCode.OK, 0.0, 0
        lam = np.zeros(m)
        for k in range(steps):
            x = state[k]
            u = torque[k].copy()
            if feedback is not None:
                u -= feedback.gain[k] @ (x[feedback.index] - feedback.reference[k])
            guess = x if k == 0 else 2 * x - state[k - 1] if k == 1 else 3 * (x - state[k - 1]) + state[k - 2]
            q1, z1, lam = guess[:n].copy(), guess[2 * n :].copy(), lam.copy()
            q1[self._fixed] = path[k + 1]
            arguments: list[Array | float] = [
                x[:n],
                q1,
                x[n : 2 * n],
                x[2 * n :],
                z1,
                lam,
                u,
                theta,
                self._model.time_step,
            ]
            phi = self._matrix(arguments)
            code, error, p1, spent = self._newton(arguments, phi, scale, kept)
            if code != StepCode.OK:
                kept.clear()
                q1[self._free], z1[:], lam[:] = x[self._free], x[2 * n :], 0.0
                code, error, p1, more = self._newton(arguments, phi, scale, kept)
                spent += more
            total += spent
            state[k + 1] = np.concatenate([q1, p1, z1])
            if code != StepCode.OK:
                break
            applied[k], multipliers[k] = u, lam
            effort[k] = -self._rows(arguments, phi, scale)[0][self._fixed] / h
            if wanted is not None:
                by_state[k + 1], by_multipliers[k], by_effort[k] = self._sensitivity(
                    arguments, phi, scale, h, wanted, by_state[k], k, feedback
                )
        else:
            k = steps
        info = np.array([k, error, total, total], dtype=float)
        status = status_of(int(code), info, effort, state, s)
        some = wanted is not None
        return Rollout(
            state,
            multipliers,
            effort,
            applied,
            by_state if some else None,
            by_multipliers if some else None,
            by_effort if some else None,
            status,
        )

    def _sensitivity(
        self,
        arguments: list[Array | float],
        phi: Array,
        scale: Array,
        h: float,
        wanted: Directions,
        before: Array,
        k: int,
        feedback: Feedback | None,
    ) -> tuple[Array, Array, Array]:
        s = self._model.sizes
        n, nz, nt, d = s["n"], s["nz"], s["n"] + s["nz"] + s["m"], wanted.count
        matrices = self._linearise(arguments, phi, scale)
        old = np.concatenate([before[:n], before[2 * n :]])
        rows = matrices.rows_old @ old
        rows[:n] += before[n : 2 * n]
        change = np.zeros((s["nu"], d)) if wanted.torque is None else wanted.torque[k].copy()
        if feedback is not None:
            change -= feedback.gain[k] @ before[feedback.index]
        rows += matrices.rows_input @ change
        joined = np.zeros((nt, d))
        if wanted.path is not None:
            joined[self._fixed] = wanted.path[k + 1]
            rows += matrices.rows_new[:, self._fixed] @ wanted.path[k + 1]
        p1 = matrices.p1_input @ change
        by_effort = -rows[self._fixed] / h
        if wanted.names:
            width = len(wanted.names)
            by_rows, by_p1, partial = self._by_theta(wanted.names, arguments)
            rows[:, :width] += by_rows
            p1[:, :width] += by_p1
            by_effort[:, :width] += partial
        if len(self._unknown):
            jacobian = matrices.rows_new[np.ix_(self._unknown, self._unknown)]
            joined[self._unknown] = -np.linalg.solve(jacobian, rows[self._unknown])
        p1 += matrices.p1_old @ old + matrices.p1_new @ joined
        free = np.setdiff1d(np.arange(nt), self._fixed)
        by_effort -= matrices.rows_new[np.ix_(self._fixed, free)] @ joined[free] / h
        return np.concatenate([joined[:n], p1, joined[n : n + nz]]), joined[n + nz :], by_effort

    def adjoint(
        self,
        theta: Array,
        rollout: Rollout,
        feedback: Feedback | None,
        names: tuple[str, ...],
        by_state: Array,
        by_multipliers: Array | None,
        by_effort: Array | None,
    ) -> Gradient:
        """See `Kernel.adjoint`."""
        s = self._model.sizes
        n, nt = s["n"], s["n"] + s["nz"] + s["m"]
        scale, h = self._scales(theta)
        steps = len(rollout.multipliers)
        gradient, by_torque, by_path = np.zeros(len(names)), np.zeros((steps, s["nu"])), np.zeros((steps + 1, s["nc"]))
        costate = by_state[steps].copy()
        for k in reversed(range(steps)):
            x, after = rollout.state[k], rollout.state[k + 1]
            arguments: list[Array | float] = [
                x[:n],
                after[:n],
                x[n : 2 * n],
                x[2 * n :],
                after[2 * n :],
                rollout.multipliers[k],
                rollout.torque[k],
                theta,
                self._model.time_step,
            ]
            matrices = self._linearise(arguments, self._matrix(arguments), scale)
            weight = costate[n : 2 * n]
            effort = np.zeros(s["nc"]) if by_effort is None else by_effort[k]
            last = np.zeros(s["m"]) if by_multipliers is None else by_multipliers[k]
            outer = np.concatenate([costate[:n], costate[2 * n :], last]) + matrices.p1_new.T @ weight
            outer -= matrices.rows_new[self._fixed].T @ effort / h
            full = np.zeros(nt)
            if len(self._unknown):
                jacobian = matrices.rows_new[np.ix_(self._unknown, self._unknown)]
                full[self._unknown] = -np.linalg.solve(jacobian.T, outer[self._unknown])
            if names:
                by_rows, by_p1, partial = self._by_theta(names, arguments)
                gradient += full @ by_rows + weight @ by_p1 + effort @ partial
            by_path[k + 1] = outer[self._fixed] + full @ matrices.rows_new[:, self._fixed]
            full[self._fixed] = -effort / h
            old = matrices.rows_old.T @ full + matrices.p1_old.T @ weight
            by_torque[k] = matrices.rows_input.T @ full + matrices.p1_input.T @ weight
            costate = np.concatenate([old[:n], full[:n], old[n:]]) + by_state[k]
            if feedback is not None:
                np.subtract.at(costate, feedback.index, feedback.gain[k].T @ by_torque[k])
        by_path[0] = costate[self._fixed]
        return Gradient(gradient, costate, by_torque, by_path)

    def linearize(
        self,
        theta: Array,
        state: Array,
        multipliers: Array,
        torque: Array,
        names: tuple[str, ...],
        derivatives: bool,
    ) -> StepLinearization:
        """See `Kernel.linearize`."""
        s = self._model.sizes
        n = s["n"]
        scale, _ = self._scales(theta)
        stages = empty_linearization(s, len(torque), len(names), derivatives)
        for k, u in enumerate(torque):
            x, after = state[k], state[k + 1]
            arguments: list[Array | float] = [
                x[:n],
                after[:n],
                x[n : 2 * n],
                x[2 * n :],
                after[2 * n :],
                multipliers[k],
                u,
                theta,
                self._model.time_step,
            ]
            phi = self._matrix(arguments)
            stages.rows[k], stages.p1[k] = self._rows(arguments, phi, scale)
            if derivatives:
                matrices = self._linearise(arguments, phi, scale)
                for name in LINEARIZATION_MATRICES[:6]:
                    getattr(stages, name)[k] = getattr(matrices, name)
                if names:
                    stages.rows_theta[k], stages.p1_theta[k], _ = self._by_theta(names, arguments)
        return stages

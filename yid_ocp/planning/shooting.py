"""A plan's nonlinear program, the object's motion eliminated, solved by IPOPT with Gauss-Newton's Hessian."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.step_model import Rollout
from yid_ocp.planning.rows import Rows, Values, stacked
from yid_ocp.solvers.numeric import NumericFunction
from yid_ocp.solvers.program import SILENT

Array = NDArray[np.float64]

RIDGE = 1e-6  # added to the Hessian of the scaled cost: motions of the elbow that change nothing
FINISHED = {"Solve_Succeeded", "Solved_To_Acceptable_Level"}


@dataclass(frozen=True)
class Shot:
    """Where the search ended.

    Attributes
    ----------
    w : ndarray, shape (K, nc)
    cost : float
    finished : bool
    message : str
    iterations : int
    """

    w: Array
    cost: float
    finished: bool
    message: str
    iterations: int


@dataclass
class _Point:
    """The last unknowns that were asked for and what they give."""

    w: Array
    slopes: bool
    residual: Values
    limits: Values


class Shooting:
    """Residuals of several cases (the likely parameters, and others around them) and the limits of the first.

    Parameters
    ----------
    cases : sequence of Rows
    shape : (int, int)
        Of the unknowns, (K, nc).
    """

    def __init__(self, cases: Sequence[Rows], shape: tuple[int, int]) -> None:
        self._cases, self._shape = list(cases), shape
        self._last: _Point | None = None
        self._keep: list[NumericFunction] = []

    def at(self, x: Array, slopes: bool) -> tuple[Values, Values]:
        """Residual and limits, limits divided by their units; NaN where a rollout fails."""
        last = self._last
        if last is not None and np.array_equal(last.w, x) and (last.slopes or not slopes):
            return last.residual, last.limits
        w = x.reshape(self._shape)
        rollouts = [case.mover.roll(w, slopes) for case in self._cases]
        scale = 1.0 / np.sqrt(len(self._cases))
        parts = [case.residual(rollout, w) for case, rollout in zip(self._cases, rollouts, strict=True)]
        whole = stacked(parts)
        residual = Values(scale * whole.value, None if whole.slope is None else scale * whole.slope)
        limits = self._scaled(self._cases[0].limits(rollouts[0], w))
        self._last = _Point(np.array(x), slopes, residual, limits)
        return residual, limits

    @property
    def unit(self) -> Array:
        """Units of the limits' rows."""
        return np.concatenate([rows.unit for rows in self._cases[0].bounded])

    def _scaled(self, limits: Values) -> Values:
        unit = self.unit
        return Values(limits.value / unit, None if limits.slope is None else limits.slope / unit[:, None])

    def solve(self, start: Array, lower: Array, upper: Array, iterations: int) -> Shot:
        """The best motion from a start, all (K, nc), the unknowns within bounds."""
        x0 = start.ravel()
        residual, _ = self.at(x0, False)
        scale = 1.0 / max(0.5 * float(residual.value @ residual.value), 1.0)
        bounds = [np.concatenate([getattr(rows, side) for rows in self._cases[0].bounded]) / self.unit
                  for side in ("lower", "upper")]  # fmt: skip
        functions = self._functions(scale, len(bounds[0]))
        options = {
            **SILENT,
            "no_nlp_grad": True,
            "ipopt": {
                "print_level": 0,
                "sb": "yes",
                "max_iter": iterations,
                "tol": 1e-5,
                "nlp_scaling_method": "none",
                "mu_strategy": "adaptive",
                "bound_relax_factor": 0.0,
                "acceptable_tol": 1e-4,
                "acceptable_iter": 4,
                "acceptable_obj_change_tol": 1e-4,
            },
        }
        solver = ca.nlpsol("plan", "ipopt", functions.pop("nlp"), {**options, **functions})
        found = solver(x0=x0, lbx=lower.ravel(), ubx=upper.ravel(), lbg=bounds[0], ubg=bounds[1])
        x, stats = np.array(found["x"]).ravel(), solver.stats()
        x = x if np.all(np.isfinite(x)) else x0
        residual, _ = self.at(x, False)
        cost = 0.5 * float(residual.value @ residual.value)
        returned = stats["return_status"]
        return Shot(x.reshape(self._shape), cost, returned in FINISHED, f"IPOPT: {returned}", int(stats["iter_count"]))

    def _functions(self, scale: float, rows: int) -> dict[str, ca.Function]:
        size = self._shape[0] * self._shape[1]
        dense = ca.Sparsity.dense
        sparsity = {
            "x": dense(size, 1), "p": dense(0, 1), "f": dense(1, 1), "g": dense(rows, 1), "lam_f": dense(1, 1),
            "lam_g": dense(rows, 1), "grad_f": dense(size, 1), "jac_g": dense(rows, size),
            "hess_lag": ca.Sparsity.upper(size),
        }  # fmt: skip
        # upper triangle column by column, as CasADi stores it
        column, row = np.tril_indices(size)

        def values(x: Array, _: Array) -> list:
            residual, limits = self.at(x, False)
            return [scale * 0.5 * residual.value @ residual.value, limits.value]

        def gradient(x: Array, _: Array) -> list:
            residual, _limits = self.at(x, True)
            assert residual.slope is not None
            return [scale * 0.5 * residual.value @ residual.value, scale * residual.slope.T @ residual.value]

        def jacobian(x: Array, _: Array) -> list:
            _residual, limits = self.at(x, True)
            assert limits.slope is not None
            return [limits.value, limits.slope.ravel(order="F")]

        def curvature(x: Array, _: Array, lam_f: Array, __: Array) -> list:
            slope = self.at(x, True)[0].slope
            assert slope is not None
            matrix = float(lam_f[0]) * scale * slope.T @ slope + RIDGE * np.eye(size)
            return [matrix[row, column]]

        def made(name: str, inputs: Sequence[str], outputs: Sequence[str], compute: Callable[..., list]) -> ca.Function:
            self._keep.append(NumericFunction(name, inputs, outputs, sparsity, compute))
            return self._keep[-1]

        return {
            "nlp": made("nlp", ("x", "p"), ("f", "g"), values),
            "grad_f": made("grad_f", ("x", "p"), ("f", "grad_f"), gradient),
            "jac_g": made("jac_g", ("x", "p"), ("g", "jac_g"), jacobian),
            "hess_lag": made("hess_lag", ("x", "p", "lam_f", "lam_g"), ("hess_lag",), curvature),
        }


def failed(rollout: Rollout) -> bool:
    """Whether a rollout did not reach its end."""
    return not bool(np.all(np.isfinite(rollout.state)))

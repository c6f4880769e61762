"""Single shooting for a planned motion: least squares over spline coefficients, within limits.

Bounds of the unknowns are kept by the trust region, all other limits by an augmented Lagrangian: a row g <= u adds
rho/2 max(0, g - u + lam/rho)^2 to the cost, and lam is raised until no row is passed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from yid_ocp.integrator.step_model import Rollout
from yid_ocp.planning.plan_constraints import PlanResidualsAndLimits, ValueWithJacobian, stack_values

Array = NDArray[np.float64]

_INITIAL_PENALTY, _PENALTY_GROWTH, _MAX_PENALTY = 1e3, 10.0, 1e8
_LIMIT_TOLERANCE = 1e-4  # largest violation of a limit, in parts of it, that counts as none
_MAX_OUTER_ITERATIONS = 12
_FAILED_ROLLOUT_RESIDUAL = 1e4  # residual of a motion that cannot be stepped: the trust region shrinks


@dataclass(frozen=True)
class PlanShootingResult:
    """Result of the search for a planned motion.

    Attributes
    ----------
    w : ndarray, shape (K, nc)
    cost : float
    is_converged : bool
        Whether the search converged within the limits.
    message : str
    n_evaluations : int
    """

    w: Array
    cost: float
    is_converged: bool
    message: str
    n_evaluations: int


class PlanShooting:
    """Shooting problem with the residuals of several parameter cases and the limits of the first case.

    Parameters
    ----------
    cases : sequence of Rows
    shape : (int, int)
        Of the unknowns, (K, nc).
    """

    def __init__(self, cases: Sequence[PlanResidualsAndLimits], shape: tuple[int, int]) -> None:
        self._cases, self._shape = list(cases), shape
        self._last: tuple[Array, tuple[ValueWithJacobian, ValueWithJacobian]] | None = None
        rows = self._cases[0].limit_rows
        self._unit, lower, upper = (np.concatenate([getattr(b, k) for b in rows]) for k in ("unit", "lower", "upper"))
        self._lower, self._upper = lower / self._unit, upper / self._unit
        self.evaluations = 0

    def residual_and_limits(self, x: Array) -> tuple[ValueWithJacobian, ValueWithJacobian]:
        """Residual and scaled limit values with their Jacobians; not finite where a rollout fails."""
        if self._last is None or not np.array_equal(self._last[0], x):
            self.evaluations += 1
            w = x.reshape(self._shape)
            rollouts = [case.simulator.simulate_path(w, True) for case in self._cases]
            parts = [case.goal_residual(rollout, w) for case, rollout in zip(self._cases, rollouts, strict=True)]
            whole, scale = stack_values(parts), 1.0 / np.sqrt(len(self._cases))
            limits = self._cases[0].limit_values(rollouts[0], w)
            assert whole.jacobian is not None
            assert limits.jacobian is not None
            residual = ValueWithJacobian(scale * whole.value, scale * whole.jacobian)
            self._last = (
                np.array(x),
                (residual, ValueWithJacobian(limits.value / self._unit, limits.jacobian / self._unit[:, None])),
            )
        return self._last[1]

    def solve(self, start: Array, lower: Array, upper: Array, iterations: int) -> PlanShootingResult:
        """Optimise a motion from initial coefficients within bounds, all of shape (K, nc).

        References
        ----------
        Rockafellar (1973), Math. Programming 5:354, doi:10.1007/BF01580138.
        Branch, Coleman and Li (1999), SIAM J. Sci. Comput. 21(1):1, doi:10.1137/S1064827595289108.
        """
        low, high = lower.ravel(), upper.ravel()
        x = np.clip(start.ravel(), low + 1e-9, high - 1e-9)
        pull = np.zeros((2, len(self._unit)))
        penalty, before, ended = _INITIAL_PENALTY, np.inf, False
        for _ in range(_MAX_OUTER_ITERATIONS):
            found = least_squares(
                lambda x: self._penalised(x, pull, penalty)[0],  # noqa: B023
                x,
                jac=lambda x: self._penalised(x, pull, penalty)[1],  # noqa: B023
                bounds=(low, high),
                x_scale=1.0,
                max_nfev=iterations,
                ftol=1e-6,
                xtol=1e-7,
                gtol=1e-8,
            )
            x, ended = found.x, found.status > 0
            value = self.residual_and_limits(x)[1].value
            over = np.vstack([value - self._upper, self._lower - value])
            passed = float(np.max(over, initial=0.0))
            if passed <= _LIMIT_TOLERANCE or not np.isfinite(passed):
                break
            pull = np.maximum(0.0, pull + penalty * over)
            if passed > 0.25 * before:
                penalty = min(_PENALTY_GROWTH * penalty, _MAX_PENALTY)
            before = passed
        residual = self.residual_and_limits(x)[0].value
        finished = bool(ended and passed <= _LIMIT_TOLERANCE)
        if finished:
            message = "the motion was found"
        elif passed > _LIMIT_TOLERANCE:
            message = "no motion within the limits was found"
        else:
            message = f"the search was stopped after {iterations} evaluations; raise plan.max_iterations"
        cost = 0.5 * float(residual @ residual)
        return PlanShootingResult(x.reshape(self._shape), cost, finished, message, self.evaluations)

    def _penalised(self, x: Array, pull: Array, penalty: float) -> tuple[Array, Array]:
        residual, limits = self.residual_and_limits(x)
        assert residual.jacobian is not None
        assert limits.jacobian is not None
        root = np.sqrt(penalty)
        sides = ((1.0, limits.value - self._upper, pull[0]), (-1.0, self._lower - limits.value, pull[1]))
        # a one beside them: the search ends where the cost falls by little of what counts as reached
        values, slopes = [np.ones(1), residual.value], [np.zeros((1, len(x))), residual.jacobian]
        for sign, over, raised in sides:
            shifted = np.maximum(over + raised / penalty, 0.0)
            values.append(root * shifted)
            slopes.append(sign * root * np.where(shifted > 0, 1.0, 0.0)[:, None] * limits.jacobian)
        value, slope = np.concatenate(values), np.vstack(slopes)
        if np.all(np.isfinite(value)) and np.all(np.isfinite(slope)):
            return value, slope
        return np.full(len(value), _FAILED_ROLLOUT_RESIDUAL), np.zeros_like(slope)


def has_rollout_failed(rollout: Rollout) -> bool:
    """Whether a rollout failed before its end."""
    return not bool(np.all(np.isfinite(rollout.state)))

"""Rollouts of a system: initial states at rest, simulation, forward sensitivities and the adjoint gradient."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from yid_ocp.errors import ModelError
from yid_ocp.integrator.step import Directions, Feedback, Gradient, Step, Sweep, check_shape

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rest:
    """A static equilibrium.

    Attributes
    ----------
    state : ndarray, shape (nx,)
        (q, p, z); p is half a step's pull of the constraints, so that the next step stays at rest.
    torque : ndarray, shape (nu,)
        Motor torque that holds the posture [N m].
    constraint_force : ndarray, shape (m,)
        [N or N m]
    by_theta : ndarray, shape (nx, len(names))
        Derivative of `state` by the parameters asked for.
    by_posture : ndarray, shape (nx, nk)
        Derivative by the known coordinates.
    converged : bool
    error : float
        Largest remaining imbalance [N m] or constraint violation [m].
    message : str
    """

    state: Array
    torque: Array
    constraint_force: Array
    by_theta: Array
    by_posture: Array
    converged: bool
    error: float
    message: str


class Statics:
    """The equilibrium equations of a step's system, for postures in which some coordinates are known.

    Parameters
    ----------
    step : Step
    known : sequence of str, optional
        Joints whose coordinate is given; the driven and the prescribed ones when absent.
    """

    def __init__(self, step: Step, known: Sequence[str] | None = None) -> None:
        self.step = step
        system = step.system
        names = (*system.driven, *system.prescribed) if known is None else tuple(known)
        self.known = tuple(system.mechanism.joint_index(name) for name in names)
        self.unknown = tuple(i for i in range(system.size) if i not in set(self.known))
        e = step.equations
        h = e.h
        given, sought = ca.SX.sym("given", len(self.known)), ca.SX.sym("sought", len(self.unknown))
        z, force = ca.SX.sym("z", e.z0.numel()), ca.SX.sym("force", e.lam.numel())
        q = ca.SX(ca.DM.zeros(system.size))
        for row, index in enumerate(self.known):
            q[index] = given[row]
        for row, index in enumerate(self.unknown):
            q[index] = sought[row]
        u = ca.SX.sym("u", e.u.numel())

        def at_rest(*expressions: ca.SX) -> list[ca.SX]:
            old = [e.q0, e.q1, e.z0, e.z1, e.lam, e.u]
            return [ca.densify(x) for x in ca.substitute(list(expressions), old, [q, q, z, z, h * force, u])]

        p_rest, balance, internal, constraint = at_rest(e.p1, e.momentum_balance, e.internal, e.constraint)
        balance = ca.substitute(balance, e.p0, p_rest) / h
        driven = list(system.driven_indices)
        torque = u - balance[driven] if driven else ca.SX(0, 1)
        w = ca.vertcat(sought, z, force)
        residual = ca.vertcat(balance[list(self.unknown)], internal, constraint)
        inputs = [w, given, u, e.theta, e.time_step]
        self._residual = ca.Function("rest", inputs, [residual, ca.jacobian(residual, w)])
        self._torque = ca.Function("hold", inputs, [torque])
        state = ca.vertcat(q, p_rest, z)
        self._state = ca.Function("state", inputs, [ca.densify(state)])
        self._symbols = (w, given, u, e.theta, e.time_step, residual, state, torque)
        self._derivatives: dict[tuple[str, ...], ca.Function] = {}

    def solve(
        self,
        posture: ArrayLike,
        theta: ArrayLike,
        guess: ArrayLike | None = None,
        names: Sequence[str] = (),
        tolerance: float = 1e-10,
    ) -> Rest:
        """Find the equilibrium at a posture.

        Parameters
        ----------
        posture : array_like, shape (nk,)
            Known coordinates [rad or m].
        theta : array_like, shape (ntheta,)
        guess : array_like, shape (n,), optional
            Configuration to start from; the undeformed object when absent.
        names : sequence of str
            Parameters by which to differentiate.
        tolerance : float
            Largest imbalance [N m] and constraint violation [m] that counts as rest.

        Returns
        -------
        Rest
            `converged` is False, with the best point found, where Newton's iteration does not succeed.
        """
        step, system = self.step, self.step.system
        given = check_shape("posture", posture, (len(self.known),))
        theta = check_shape("theta", theta, (len(system.parameters),))
        nu, count = step.sizes["nu"], len(self.unknown) + step.sizes["nz"]
        w = np.zeros(count + step.sizes["m"])
        if guess is not None:
            w[: len(self.unknown)] = np.asarray(guess, float)[list(self.unknown)]
        u = np.zeros(nu)
        arguments = [given, u, theta, step.time_step]
        w, error, converged = _damped_newton(lambda x: self._residual(x, *arguments), w, count, tolerance)
        u = np.array(self._torque(w, *arguments)).ravel()
        arguments = [given, u, theta, step.time_step]
        state = np.array(self._state(w, *arguments)).ravel()
        by_theta, by_posture = self._differentiate(w, arguments, tuple(names))
        message = "at rest" if converged else self._explain(w, given, theta, error)
        return Rest(state, u, w[count:], by_theta, by_posture, converged, error, message)

    def _differentiate(self, w: Array, arguments: list, names: tuple[str, ...]) -> tuple[Array, Array]:
        if names not in self._derivatives:
            symbol, given, u, theta, time_step, residual, state, torque = self._symbols
            chosen = [self.step.system.parameters[name].symbol for name in names]
            other = ca.vertcat(*chosen, given)
            outputs = [ca.jacobian(f, x) for f in (residual, state, torque) for x in (symbol, other)]
            self._derivatives[names] = ca.Function(
                "by", [symbol, given, u, theta, time_step], [*outputs, ca.jacobian(state, u)]
            )
        values = [np.array(ca.densify(x)) for x in self._derivatives[names](w, *arguments)]
        r_w, r_o, s_w, s_o, t_w, t_o, s_u = values
        try:
            dw = -np.linalg.lstsq(r_w, r_o, rcond=None)[0] if len(w) else np.zeros((0, r_o.shape[1]))
        except np.linalg.LinAlgError:
            dw = np.zeros((len(w), r_o.shape[1]))
        # the residual's rows do not contain u, because only known coordinates are driven
        du = t_w @ dw + t_o
        total = s_w @ dw + s_o + s_u @ du
        return total[:, : len(names)], total[:, len(names) :]

    def _explain(self, w: Array, given: Array, theta: Array, error: float) -> str:
        system, step = self.step.system, self.step
        text = f"no equilibrium found (remaining imbalance {error:.2g})"
        if system.grasps and math.isfinite(error):
            q = np.zeros(system.size)
            q[list(self.known)] = given
            q[list(self.unknown)] = w[: len(self.unknown)]
            e = step.equations
            phi = ca.Function("phi", [e.q1, e.z1, e.lam, e.theta, e.time_step], [e.constraint])
            gap = np.array(phi(q, 0, 0, theta, step.time_step)).ravel()
            row = 0
            for grasp in system.grasps:
                distance = float(np.linalg.norm(gap[row : row + 3]))
                row += grasp.equations
                if distance > 1e-6:
                    text += f"; grasp '{grasp.name}' is out of reach by {1e3 * distance:.0f} mm"
        return text


def _damped_newton(function, w: Array, count: int, tolerance: float) -> tuple[Array, float, bool]:  # type: ignore[no-untyped-def]
    """Newton with the natural monotonicity test (Deuflhard 2011, section 3.3) on the first `count` unknowns."""
    if len(w) == 0:
        return w, 0.0, True

    def evaluate(x: Array) -> tuple[Array, Array]:
        residual, jacobian = function(x)
        return np.array(residual).ravel(), np.array(ca.densify(jacobian))

    residual, jacobian = evaluate(w)
    error = float(np.max(np.abs(residual)))
    for _ in range(200):
        if not math.isfinite(error):
            return w, error, False
        if error <= tolerance:
            return w, error, True
        try:
            factors = scipy.linalg.lu_factor(jacobian)
        except (ValueError, scipy.linalg.LinAlgError):
            return w, error, False
        delta = -scipy.linalg.lu_solve(factors, residual)
        size = float(np.max(np.abs(delta[:count]), initial=1e-300))
        if not math.isfinite(size):
            return w, error, False
        factor = min(1.0, 0.3 / size)
        while True:
            trial = w + factor * delta
            new_residual, new_jacobian = evaluate(trial)
            if np.all(np.isfinite(new_residual)):
                corrected = scipy.linalg.lu_solve(factors, new_residual)
                shrunk = float(np.max(np.abs(corrected[:count]), initial=0.0))
                if shrunk <= (1 - factor / 4) * size or np.max(np.abs(new_residual)) < tolerance:
                    break
            factor *= 0.5
            if factor < 1e-5:
                return w, error, error < 1e3 * tolerance
        w, residual, jacobian = trial, new_residual, new_jacobian
        error = float(np.max(np.abs(residual)))
    return w, error, False


def simulate(
    step: Step,
    theta: ArrayLike,
    start: ArrayLike,
    steps: int,
    torque: ArrayLike | None = None,
    path: ArrayLike | None = None,
    feedback: Feedback | None = None,
    directions: Directions | None = None,
) -> Sweep:
    """Roll a system out, with forward sensitivities where directions are given.

    Parameters
    ----------
    step : Step
    theta : array_like, shape (ntheta,)
    start : array_like, shape (nx,)
        Initial (q, p, z).
    steps : int
        N
    torque : array_like, shape (N, nu), optional
        Nominal motor torque of every step [N m]; zero when absent.
    path : array_like, shape (N + 1, nc), optional
        Prescribed coordinates at every node; held at their initial value when absent.
    feedback : Feedback, optional
    directions : Directions, optional

    Returns
    -------
    Sweep
        With NaN after the step at which Newton failed; `status` says so.

    Raises
    ------
    ModelError
        An array of the wrong shape.
    """
    sizes = step.sizes
    if steps < 1:
        raise ModelError(f"steps = {steps}", allowed="a whole number from 1")
    begin = check_shape("start", start, (sizes["nx"],)).copy()
    fixed = list(step.system.prescribed_indices)
    inputs = np.zeros((steps, sizes["nu"])) if torque is None else check_shape("torque", torque, (steps, sizes["nu"]))
    course = (
        np.tile(begin[fixed], (steps + 1, 1)) if path is None else check_shape("path", path, (steps + 1, sizes["nc"]))
    )
    begin[fixed] = course[0]
    if directions is not None:
        d = directions.count
        check_shape("directions.start", directions.start, (sizes["nx"], d))
        if directions.torque is not None:
            check_shape("directions.torque", directions.torque, (steps, sizes["nu"], d))
        if directions.path is not None:
            check_shape("directions.path", directions.path, (steps + 1, sizes["nc"], d))
            if fixed:
                first = directions.start.copy()
                first[fixed] = directions.path[0]
                directions = Directions(directions.names, first, directions.torque, directions.path)
    values = check_shape("theta", theta, (sizes["ntheta"],))
    return step.kernel.sweep(values, begin, inputs, course, feedback, directions)


def adjoint_gradient(
    step: Step,
    theta: ArrayLike,
    swept: Sweep,
    names: Sequence[str],
    by_state: ArrayLike,
    by_multipliers: ArrayLike | None = None,
    by_effort: ArrayLike | None = None,
    feedback: Feedback | None = None,
) -> Gradient:
    """Gradient of a cost along a finished rollout by the adjoint (the paper's Lemma 1).

    costate_N = dJ/dx_N, costate_k = costate_{k+1} A_k + dJ/dx_k, gradient = sum_k costate_{k+1} B_k.

    Parameters
    ----------
    step : Step
    theta : array_like, shape (ntheta,)
    swept : Sweep
        From `simulate` with the same theta and feedback.
    names : sequence of str
        Parameters by which to differentiate.
    by_state : array_like, shape (N + 1, nx)
        Partial derivatives of the cost by the state at every node.
    by_multipliers : array_like, shape (N, m), optional
    by_effort : array_like, shape (N, nc), optional
    feedback : Feedback, optional

    Returns
    -------
    Gradient
    """
    sizes, steps = step.sizes, len(swept.multipliers)
    outer = check_shape("by_state", by_state, (steps + 1, sizes["nx"]))
    last = None if by_multipliers is None else check_shape("by_multipliers", by_multipliers, (steps, sizes["m"]))
    effort = None if by_effort is None else check_shape("by_effort", by_effort, (steps, sizes["nc"]))
    values = check_shape("theta", theta, (sizes["ntheta"],))
    return step.kernel.adjoint(values, swept, feedback, tuple(names), outer, last, effort)


def momentum_of(step: Step, q: ArrayLike, v: ArrayLike, theta: ArrayLike) -> Array:
    """Generalized momentum dL/dv at (q, v), shape (n,) [N m s]."""
    e = step.equations
    half = np.asarray(v, float) * step.time_step / 2
    q = np.asarray(q, float)
    function = ca.Function("momentum", e.arguments, [e.rigid.by_v])
    s = step.sizes
    zero = np.zeros
    return np.array(
        function(q - half, q + half, zero(s["n"]), zero(s["nz"]), zero(s["nz"]), zero(s["m"]), zero(s["nu"]), theta, step.time_step)
    ).ravel()

"""Static equilibrium under gravity, springs and grasps, with its derivatives."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy.linalg
import scipy.linalg.lapack
from numpy.typing import ArrayLike, NDArray

from yid_ocp.integrator.step import Step, check_shape
from yid_ocp.parallel import SYMBOLIC, Once

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
        Derivative by the known coordinates (driven, then prescribed).
    by_torque : ndarray, shape (nx, nu)
        Derivative by the measured torque.
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
    by_torque: Array
    converged: bool
    error: float
    message: str


# Driven joints are held at their measured posture by a spring [N m/rad], so that an equilibrium exists also where
# encoder noise stretches the object by a hair beyond its reach. With a measured torque the spring is as soft as the
# ratio of torque error to encoder error; without one it is stiff enough to give less than an encoder's noise.
HOLD_STIFFNESS = 1e5
HOLD_STIFFNESS_WITH_TORQUE = 1e3

MOST_ITERATIONS = 300  # of the search for the lowest energy

# A holding spring that gives by more than this means that the posture does not fit the grasp [rad].
HOLD_LIMIT = 0.02


class Statics:
    """The equilibrium equations of a step's system at a known posture: driven joints held, prescribed ones given.

    Parameters
    ----------
    step : Step

    Attributes
    ----------
    known, unknown : tuple of int
        Coordinates that are given (driven, then prescribed), and those that are sought.
    inputs : list of casadi.SX
        (sought, internal, forces), given coordinates, held torque, holding spring's stiffness, theta, time step.
    residual : casadi.SX
        Zero at rest: balance of the coordinates sought [N m], internal equations, constraints [m].
    state : casadi.SX, shape (nx, 1)
        (q, p, z) at rest.
    """

    def __init__(self, step: Step) -> None:
        self.step = step
        system = step.system
        self.known = (*system.driven_indices, *system.prescribed_indices)
        self.unknown = system.free_indices
        e = step.equations
        h = e.h
        nu = e.u.numel()
        given, sought = ca.SX.sym("given", len(self.known)), ca.SX.sym("sought", len(self.unknown))
        z, force = ca.SX.sym("z", e.z0.numel()), ca.SX.sym("force", e.lam.numel())
        q = ca.SX(ca.DM.zeros(system.size))
        for row, index in enumerate(system.prescribed_indices):
            q[index] = given[nu + row]
        for row, index in enumerate(self.unknown):
            q[index] = sought[row]
        held, stiffness = ca.SX.sym("held", nu), ca.SX.sym("stiffness")
        give = given[:nu] - q[list(system.driven_indices)] if nu else ca.SX(0, 1)
        u = held + stiffness * give

        def at_rest(*expressions: ca.SX) -> list[ca.SX]:
            old = [e.q0, e.q1, e.z0, e.z1, e.lam, e.u]
            return [ca.densify(x) for x in ca.substitute(list(expressions), old, [q, q, z, z, h * force, u])]

        p_rest, balance, internal, constraint = at_rest(e.p1, e.momentum_balance, e.internal_at_rest, e.constraint)
        balance = ca.substitute(balance, e.p0, p_rest) / h
        w = ca.vertcat(sought, z, force)
        residual = ca.vertcat(balance[list(self.unknown), 0], internal, constraint)
        inputs = [w, given, held, stiffness, e.theta, e.time_step]
        weight = ca.substitute(e.rigid.potential, ca.vertcat(e.q0, e.q1), ca.vertcat(q, q))
        potential = system.elastic_energy(q) + weight
        potential += stiffness / 2 * ca.sumsqr(give) + ca.dot(held, give) if nu else 0
        state = ca.densify(ca.vertcat(q, p_rest, z))
        self._residual = ca.Function("rest", inputs, [residual, ca.jacobian(residual, w)])
        self._outcome = ca.Function("outcome", inputs, [state, u, potential, give])
        self.inputs, self.residual, self.state = inputs, residual, state
        self._derivatives: Once[tuple[str, ...], ca.Function] = Once(self._derivative)

    def solve(
        self,
        posture: ArrayLike,
        theta: ArrayLike,
        torque: ArrayLike | None = None,
        guess: ArrayLike | None = None,
        names: Sequence[str] = (),
        tolerance: float = 1e-10,
    ) -> Rest:
        """Find the equilibrium at a posture.

        Parameters
        ----------
        posture : array_like, shape (nk,)
            Known coordinates, driven then prescribed [rad or m].
        theta : array_like, shape (ntheta,)
        torque : array_like, shape (nu,), optional
            Measured torque at the posture [N m]; the holding spring then only makes up for noise.
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
        stiffness = HOLD_STIFFNESS if torque is None else HOLD_STIFFNESS_WITH_TORQUE
        held = np.zeros(step.sizes["nu"]) if torque is None else check_shape("torque", torque, (step.sizes["nu"],))
        arguments: list[Array | float] = [given, held, stiffness, theta, step.time_step]
        best: tuple[bool, float, float, Array] | None = None
        for start in self._guesses(given, guess):
            w, error, converged = _damped_newton(lambda x: self._residual.call([x, *arguments]), start, tolerance)
            energy = float(self._outcome(w, *arguments)[2])
            found = (not converged, energy if converged else error, error, w)
            if best is None or found[:2] < best[:2]:
                best = found
            if converged and guess is not None:
                break
        assert best is not None
        failed, _, error, w = best
        if failed and guess is None:
            lowest = self._lowest_energy(given, arguments)
            if lowest is not None:
                return self.solve(posture, theta, torque, lowest, names, tolerance)
        state, holding, _, give = (np.array(x).ravel() for x in self._outcome(w, *arguments))
        by_theta, by_posture = self._differentiate(w, arguments, tuple(names))
        message = self._explain(state, theta, error) if failed else "at rest"
        if not failed and np.max(np.abs(give), initial=0.0) > HOLD_LIMIT:
            joint = int(np.argmax(np.abs(give)))
            failed = True
            # with a torque given, any of the three may be wrong
            parts = "posture does not fit the grasp" if torque is None else "posture, torques and grasp do not balance"
            message = (
                f"the measured {parts} at rest: {system.driven[joint]} would have to move by {abs(give[joint]):.3g} rad"
            )
        count = len(self.unknown) + step.sizes["nz"]
        # torque and posture enter together, as the torque plus the holding spring's stiffness times the posture
        by_torque = by_posture[:, : step.sizes["nu"]] / stiffness
        return Rest(state, holding, w[count:], by_theta, by_posture, by_torque, not failed, error, message)

    def _guesses(self, given: Array, guess: ArrayLike | None) -> list[Array]:
        """Starts of the search: the given configuration or the undeformed object, then small bends of it.

        A straight chain at full stretch is a singular point of the grasp constraints, from which Newton cannot leave.
        """
        system = self.step.system
        size = len(self.unknown) + self.step.sizes["nz"] + self.step.sizes["m"]
        first = np.zeros(size)
        q = np.zeros(system.size)
        q[list(self.known)] = given
        if guess is not None:
            q[:] = np.asarray(guess, float)
        first[: len(self.unknown)] = q[list(self.unknown)]
        starts = [first]
        elastic = {system.mechanism.joint_index(spring.joint) for spring in system.elastic if spring.kind == "bend"}
        bendable = [row for row, index in enumerate(self.unknown) if index in elastic]
        for seed in range(4 if bendable and system.grasps else 0):
            bent = first.copy()
            bent[bendable] += np.random.default_rng(seed).normal(scale=0.05, size=len(bendable))
            starts.append(bent)
        return starts

    def _lowest_energy(self, given: Array, arguments: list[Array | float]) -> Array | None:
        """A configuration of lowest potential energy within the constraints, shape (n,); None where there is none.

        Newton's iteration leaves an object that is held far from its undeformed shape, as a cable between two clamps.

        References
        ----------
        Waechter and Biegler (2006), Math. Programming 106:25, doi:10.1007/s10107-004-0559-y.
        """
        size, m = len(self.unknown), self.step.sizes["m"]
        if not size or not m:
            return None
        with SYMBOLIC:
            x = ca.SX.sym("x", size)
            w = ca.vertcat(x, ca.SX(self.step.sizes["nz"] + m, 1))
            residual, _ = self._residual(w, *arguments)
            _, _, energy, _ = self._outcome(w, *arguments)
            scale = 1.0 / max(float(ca.norm_inf(self._residual(0, *arguments)[0])), 1e-6)
            search = {"print_level": 0, "sb": "yes", "max_iter": MOST_ITERATIONS, "tol": 1e-8}
            options: dict[str, Any] = {"print_time": False, "error_on_fail": False, "ipopt": search}
            program = {"x": x, "f": scale * energy, "g": residual[-m:]}
            solver = ca.nlpsol("lowest", "ipopt", program, options)
        for start in self._guesses(given, None):
            found = np.array(solver(x0=start[:size], lbg=0.0, ubg=0.0)["x"]).ravel()
            if solver.stats()["success"]:
                q = np.zeros(self.step.system.size)
                q[list(self.known)], q[list(self.unknown)] = given, found
                return q
        return None

    def _differentiate(self, w: Array, arguments: list, names: tuple[str, ...]) -> tuple[Array, Array]:
        r_w, r_o, s_w, s_o = (np.array(ca.densify(x)) for x in self._derivatives(names)(w, *arguments))
        change = -np.linalg.lstsq(r_w, r_o, rcond=None)[0] if len(w) else np.zeros((0, r_o.shape[1]))
        total = s_w @ change + s_o
        return total[:, : len(names)], total[:, len(names) :]

    def _derivative(self, names: tuple[str, ...]) -> ca.Function:
        inputs, residual, state = self.inputs, self.residual, self.state
        other = ca.vertcat(*(self.step.system.parameters[name].symbol for name in names), inputs[1])
        outputs = [ca.jacobian(f, x) for f in (residual, state) for x in (inputs[0], other)]
        return ca.Function("by", inputs, outputs)

    def _explain(self, state: Array, theta: Array, error: float) -> str:
        system, step = self.step.system, self.step
        text = f"no equilibrium found (remaining imbalance {error:.2g})"
        e, n = step.equations, system.size
        if not system.grasps or not np.all(np.isfinite(state)):
            return text
        with SYMBOLIC:
            phi = ca.Function("phi", [e.q1, e.z1, e.lam, e.theta, e.time_step], [e.closure])
        gap = np.array(phi(state[:n], state[2 * n :], 0, theta, step.time_step)).ravel()
        row = 0
        for grasp in system.grasps:
            distance = float(np.linalg.norm(gap[row : row + 3]))
            row += grasp.equations
            if distance > 1e-4:
                text += f"; grasp '{grasp.name}' is out of reach by {1e3 * distance:.3g} mm"
        return text


def _damped_newton(
    function: Callable[[Array], Sequence[ca.DM]], w: Array, tolerance: float
) -> tuple[Array, float, bool]:
    """Newton with step control: the natural monotonicity test (Deuflhard 2011, section 3.3) or a smaller residual."""
    if len(w) == 0:
        return w, 0.0, True

    def evaluate(x: Array) -> tuple[Array, Array]:
        residual, jacobian = function(x)
        return np.array(residual).ravel(), np.array(ca.densify(jacobian))

    residual, jacobian = evaluate(w)
    error = float(np.max(np.abs(residual)))
    for _ in range(100):
        if error <= tolerance or not math.isfinite(error):
            return w, error, error <= tolerance
        # LAPACK itself: SciPy's wrapper prints a warning where a trial point is singular
        triangles, pivots, info = scipy.linalg.lapack.dgetrf(jacobian)
        if info != 0:
            return w, error, False
        factors = (triangles, pivots)
        delta = -scipy.linalg.lu_solve(factors, residual)
        scale = np.maximum(np.abs(w), 1.0)
        size = float(np.max(np.abs(delta / scale)))
        if not math.isfinite(size):
            return w, error, False
        factor = min(1.0, 0.3 / size)
        while True:
            trial = w + factor * delta
            new_residual, new_jacobian = evaluate(trial)
            if np.all(np.isfinite(new_residual)):
                shrunk = float(np.max(np.abs(scipy.linalg.lu_solve(factors, new_residual) / scale)))
                if shrunk <= (1 - factor / 4) * size or np.max(np.abs(new_residual)) <= (1 - factor / 4) * error:
                    break
            factor *= 0.5
            if factor < 1e-6:
                return w, error, error < 1e2 * tolerance
        w, residual, jacobian = trial, new_residual, new_jacobian
        error = float(np.max(np.abs(residual)))
    return w, error, False


def relaxed(step: Step, q: ArrayLike, theta: ArrayLike) -> Array:
    """Internal coordinates of an object that has long been at a configuration, shape (nz,)."""
    e = step.equations
    nz = e.z0.numel()
    if nz == 0:
        return np.zeros(0)
    with SYMBOLIC:
        z, at = ca.SX.sym("z", nz), ca.SX.sym("q", e.q0.numel())
        old = ca.vertcat(e.q0, e.q1, e.z0, e.z1, e.p0, e.lam, e.u)
        still = ca.vertcat(at, at, z, z, ca.SX(ca.DM.zeros(e.p0.numel() + e.lam.numel() + e.u.numel())))
        residual = ca.substitute(e.internal_at_rest, old, still)
        function = ca.Function("relaxed", [z, at, e.theta, e.time_step], [residual, ca.jacobian(residual, z)])
    arguments = (np.asarray(q, float), np.asarray(theta, float), step.time_step)
    return _damped_newton(lambda x: function(x, *arguments), np.zeros(nz), 1e-12)[0]

"""Static equilibrium under gravity, springs and grasps, with its derivatives."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy.linalg.lapack
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array
from yid_ocp.integrator.codegen import rows_and_columns_of_nonzeros
from yid_ocp.integrator.discrete import RIGID_HOLD_STIFFNESS, EquilibriumEquations, equilibrium_equations
from yid_ocp.integrator.step import Step, float_array_with_checked_shape
from yid_ocp.model.servos_and_springs import MOTOR_OFF_COMMAND
from yid_ocp.model.system import System
from yid_ocp.parallel import CASADI_LOCK, CasadiLockedCache, CasadiLockedProperty


@dataclass(frozen=True)
class Equilibrium:
    """A static equilibrium with its state, holding torque, constraint reactions and derivatives."""

    state: Array  # (q, p, z), (nx,); p is half a step's constraint impulse, so that the next step stays at rest
    holding_torque: Array  # motor torque that holds the configuration [N m], or servo command [rad or m], (nu,)
    constraint_reactions: Array  # (m,) [N or N m]
    state_by_theta: Array  # derivative with respect to the named parameters, (nx, len(names))
    state_by_known_coordinates: Array  # derivative by driven, then prescribed coordinates, (nx, nk)
    state_by_torque: Array  # derivative by the measured torque, (nx, nu)
    is_converged: bool  # also False if a joint would have to leave its measured angle
    max_imbalance: float  # largest remaining imbalance [N m] or constraint violation [m]
    message: str


# A spring [N m/rad] holds each driven joint at its measured angle, so that an equilibrium exists even if encoder noise
# stretches the object slightly beyond its reach. With a measured torque, the stiffness is the ratio of torque error to
# encoder error. Without one, the spring is stiff (`RIGID_HOLD_STIFFNESS`).
_HOLD_STIFFNESS_WITH_TORQUE = 1e3

# A servo holds its joint at a known command. Not zero: derivatives by the command follow from those by the posture.
_HOLD_STIFFNESS_WITH_COMMAND = 1e-9

_NEWTON_ITERATION_LIMIT = 100
_NEAR_GUESS = 0.1  # beyond this distance from a guess [rad or m], it may be another equilibrium
_MAX_KNOWN_EQUILIBRIA = 8  # a problem asks for the same ones while it is built, checked and first evaluated
_REST_TOLERANCE = 1e-10  # allowed imbalance [N m] and constraint violation [m]
_ENERGY_ITERATION_LIMIT = 300  # iterations of the search for the lowest energy
_StaticSolution = tuple[bool, float, float, Array]  # whether a search failed, energy, error and (q, z, forces)
_MIN_RECIPROCAL_CONDITION = 1e-14  # smaller reciprocal condition numbers count as singular
_MAX_HOLD_DEFLECTION = 0.02  # larger deflections of a holding spring mean a posture unfit for the grasp [rad]


class EquilibriumSolver:
    """A Newton solver for the static equilibrium of a system with given positions of driven and prescribed joints.

    `known_coordinates` are the indices of these (driven, then prescribed), `free_coordinates` those of unknown ones.
    """

    def __init__(self, step: Step) -> None:
        self.step = step
        system, e = step.system, step.equations
        self.known_coordinates = (*system.actuated_coordinate_indices, *system.prescribed_coordinate_indices)
        self.free_coordinates = system.unprescribed_coordinate_indices
        rows = system.n_coordinates + e.z0.numel() + e.lam.numel()
        self._sought = [*self.free_coordinates, *range(system.n_coordinates, rows)]
        self._inner_slopes = CasadiLockedCache[None, ca.Function](
            lambda _: ca.Function("inner", e.arguments, [ca.jacobian(e.internal_residual_at_rest, e.theta)])
        )
        potential = system.elastic_energy(e.q0) + e.rigid_body_terms.potential_energy + _servo_energy(system, e.u, e.q0)
        self._least_energy: dict[bytes, _StaticSolution] = {}  # by the last searches without a guess
        self._potential = ca.Function("potential", [e.q0, e.q1, e.z0, e.z1, e.u, e.theta], [potential])

    @CasadiLockedProperty
    def symbolic_equations(self) -> EquilibriumEquations:
        """The symbolic equilibrium equations of the system."""
        return equilibrium_equations(self.step.equations)

    def solve(
        self,
        configuration: ArrayLike,
        theta: ArrayLike,
        torque: ArrayLike | None = None,
        guess: ArrayLike | None = None,
        names: Sequence[str] = (),
    ) -> Equilibrium:
        """Find the equilibrium for given driven and prescribed coordinates, or the best point if the search fails.

        Parameters
        ----------
        configuration : array_like, shape (nk,)
            Known coordinates, driven then prescribed [rad or m].
        torque : array_like, shape (nu,), optional
            Measured torque at this configuration [N m]; the spring that holds a driven joint then only compensates
            noise. With servos: their commands, and the search starts from `configuration`. A joint with
            `MOTOR_OFF_COMMAND` is held until the motion begins.
        guess : array_like, shape (n,), optional
            Configuration to start from; default: the undeformed object.
        names : sequence of str
            Parameters with respect to which the equilibrium is differentiated.
        """
        step, system = self.step, self.step.system
        given = float_array_with_checked_shape("configuration", configuration, (len(self.known_coordinates),))
        theta = float_array_with_checked_shape("theta", theta, (len(system.parameters),))
        stiffness = joint_hold_spring_stiffness(system, torque is not None)
        nu, nz, m = step.sizes["nu"], step.sizes["nz"], step.sizes["m"]
        held = np.zeros(nu) if torque is None else float_array_with_checked_shape("torque", torque, (nu,))
        is_motor_off = bool(system.servos) & (held >= MOTOR_OFF_COMMAND / 2)
        hold = _Hold(given, held, stiffness, np.where(is_motor_off, RIGID_HOLD_STIFFNESS, 0.0))
        count, h = len(self.free_coordinates) + nz, step.clock_scaled_time_step(theta)
        sought = b"" if guess is not None else np.concatenate([given, theta, held, [torque is None]]).tobytes()

        def equations(w: Array) -> tuple[Array, Array]:
            (value, by_point, *_), _ = self._rest_equations(w, theta, hold, h)
            return value[self._sought], by_point[np.ix_(self._sought, self._sought)]

        best = self._least_energy.get(sought)
        for start in () if best else self._guesses(given, guess):
            w, error, converged = self._near(equations, start) if guess is not None and m else (start, math.inf, False)
            if not converged:
                w, error, converged = _damped_newton(equations, start, _REST_TOLERANCE)
            if converged and guess is not None:
                best = (False, 0.0, error, w)
                break
            inner, placed = w[count - nz : count], ca.DM(self._configuration(w, given))
            energy = float(self._energy(placed, inner, hold, theta)) if converged else error
            if best is None or (not converged, energy) < best[:2]:
                best = (not converged, energy, error, w)
            # a displacement that changes no equation, as twist without stiffness, does so in bent copies too
            is_near = not converged and guess is not None and math.isfinite(error)
            if is_near and np.linalg.matrix_rank(equations(start)[1][:, :count]) < count:
                break
        assert best is not None
        failed, _, error, w = best
        if failed and guess is None:
            lowest = self._lowest_energy(theta, hold)
            if lowest is not None:
                return self.solve(configuration, theta, torque, lowest, names)
        if guess is None:
            self._least_energy = {**dict([*self._least_energy.items()][1 - _MAX_KNOWN_EQUILIBRIA :]), sought: best}
        give = hold.give(self._configuration(w, given), system)
        state, by_theta, by_posture = self._differentiate(w, theta, hold, h, tuple(names))
        message = self._explain(state, theta, error) if failed else "at rest"
        by_itself = bool(system.servos) and torque is not None
        if not failed and not by_itself and np.max(np.abs(give), initial=0.0) > _MAX_HOLD_DEFLECTION:
            joint, failed = int(np.argmax(np.abs(give))), True
            # with a torque, any of the three starts may lead to a wrong equilibrium
            cause = "the grasp" if torque is None else "the measured torques and the grasp"
            limit = f"at most {_MAX_HOLD_DEFLECTION:g} rad is tolerated"
            far = f"{abs(give[joint]):.3g} rad away from its measured angle at rest ({limit})"
            message = f"{cause} would move {system.driven[joint]} {far}. Check its torque, the payload and the grasp"
        # torque and posture enter only as torque + holding stiffness * posture
        by_torque = np.where(hold.by_hand > 0, 0.0, by_posture[:, :nu] / stiffness)
        derivatives, said = (by_theta, by_posture, by_torque), (not failed, error, message)
        return Equilibrium(state, held + stiffness * give, w[count:], *derivatives, *said)

    def _near(self, equations: Callable[[Array], tuple[Array, Array]], start: Array) -> tuple[Array, float, bool]:
        """Root near a start, its largest residual and convergence. A root far from the start does not count."""
        count = len(start) - self.step.sizes["m"]
        residual, slopes = equations(start)
        if not np.all(np.isfinite(residual)):
            return start, math.inf, False
        near = start.copy()
        near[count:] = -np.linalg.lstsq(slopes[:, count:], residual, rcond=None)[0]
        w, error, converged = _damped_newton(equations, near, _REST_TOLERANCE)
        return w, error, converged and float(np.max(np.abs(w - start)[:count])) < _NEAR_GUESS

    def _guesses(self, given: Array, guess: ArrayLike | None) -> Iterator[Array]:
        """Starts of the search: the given or undeformed shape, then bent copies (Newton fails for a straight chain)."""
        system = self.step.system
        first = np.zeros(len(self.free_coordinates) + self.step.sizes["nz"] + self.step.sizes["m"])
        q = np.zeros(system.n_coordinates)
        q[list(self.known_coordinates)] = given
        q = q if guess is None else np.asarray(guess, float)
        first[: len(self.free_coordinates)] = q[list(self.free_coordinates)]
        yield first
        bends = (spring.joint_name for spring in system.elastic_joints if spring.deformation == "bend")
        elastic = set(map(system.mechanism.joint_index, bends))
        bendable = [row for row, index in enumerate(self.free_coordinates) if index in elastic]
        for seed in range(4 if bendable and system.grasps else 0):
            bent = first.copy()
            bent[bendable] += np.random.default_rng(seed).normal(scale=0.05, size=len(bendable))
            yield bent

    def _configuration(self, w: Array, given: Array) -> Array:
        q = np.zeros(self.step.system.n_coordinates)
        q[list(self.known_coordinates)] = given
        q[list(self.free_coordinates)] = w[: len(self.free_coordinates)]
        return q

    def _energy(self, q: Any, z: Array, hold: _Hold, theta: Array) -> Any:
        give = hold.give(q, self.step.system)
        energy = self._potential(q, q, z, z, hold.held + hold.stiffness * give, theta)
        if not len(hold.held):
            return energy
        if self.step.system.servos:
            return energy + ca.dot(hold.by_hand, give**2) / 2
        return energy + hold.stiffness / 2 * ca.sumsqr(give) + ca.dot(hold.held, give)

    def _lowest_energy(self, theta: Array, hold: _Hold) -> Array | None:
        """Configuration (n,) of lowest energy by an interior-point method (doi:10.1007/s10107-004-0559-y), or None."""
        size, m, given = len(self.free_coordinates), self.step.sizes["m"], hold.given
        if not size or not m:
            return None
        with CASADI_LOCK:
            function = ca.Function("rest", self.symbolic_equations.inputs, [self.symbolic_equations.residual])
            known = (given, hold.held, hold.stiffness, theta, self.step.time_step)
            x = ca.SX.sym("x", size)
            residual = function(ca.vertcat(x, ca.SX(self.step.sizes["nz"] + m, 1)), *known)
            q = ca.SX(ca.DM(self._configuration(np.zeros(size), given)))
            q[list(self.free_coordinates)] = x
            scale = 1.0 / max(float(ca.norm_inf(function(0, *known))), 1e-6)
            search = {"print_level": 0, "sb": "yes", "max_iter": _ENERGY_ITERATION_LIMIT, "tol": 1e-8}
            options: dict[str, Any] = {"print_time": False, "error_on_fail": False, "ipopt": search}
            energy = self._energy(q, np.zeros(self.step.sizes["nz"]), hold, theta)
            solver = ca.nlpsol("lowest", "ipopt", {"x": x, "f": scale * energy, "g": residual[-m:]}, options)
        for start in self._guesses(given, None):
            found = np.array(solver(x0=start[:size], lbg=0.0, ubg=0.0)["x"]).ravel()
            if solver.stats()["success"]:
                return self._configuration(found, given)
        return None

    def _rest_equations(
        self, w: Array, theta: Array, hold: _Hold, h: float, names: tuple[str, ...] = ()
    ) -> tuple[list[Array], list[Array]]:
        """Residual at the unknowns `w`, and momentum, both with derivatives by (q, z, forces), torques and `names`."""
        step, system, free = self.step, self.step.system, len(self.free_coordinates)
        n, nz, m, nu = (step.sizes[key] for key in ("n", "nz", "m", "nu"))
        q, z, lam = self._configuration(w, hold.given), w[free : free + nz], h * w[free + nz :]
        none, u = np.zeros(n), hold.held + hold.stiffness * hold.give(q, system)
        driven = list(system.actuated_coordinate_indices)
        state = np.tile(np.concatenate([q, none, z]), (2, 1))
        found = step.kernel.step_residuals_and_jacobians(theta, state, lam[None], u[None], names, True)

        def by_point(new: Array, old: Array, push: Array) -> Array:
            """Derivatives by (q, z, lam), with equal nodes, and with the torques that follow from the angles."""
            whole = new[0]
            whole[:, : n + nz] += old[0]
            whole[:, driven] -= hold.stiffness * push[0]
            return whole

        by_rows = by_point(found.residual_by_new, found.residual_by_old, found.residual_by_input)
        by_p = by_point(found.p1_by_new, found.p1_by_old, found.p1_by_input)
        rows = [found.residual[0], by_rows, found.residual_by_input[0], found.residual_by_theta[0]]
        momentum = [found.p1[0], by_p, found.p1_by_input[0], found.p1_by_theta[0]]
        for part, of_p in zip(rows, momentum, strict=True):
            part[:n] += of_p
        if nz:
            inner, at = slice(n, n + nz), (q, q, none, z, z, lam, u, theta, step.time_step)
            residual, nonzeros = (np.array(x).ravel() for x in step.model.functions.function("resting")(*at))
            slopes = np.zeros((nz, n + nz + m + nu))
            slopes[rows_and_columns_of_nonzeros(step.model.functions.sparsity_patterns["resting"])] = nonzeros
            rows[0][inner], by_rows[inner], rows[2][inner] = residual, slopes[:, : n + nz + m], slopes[:, n + nz + m :]
            by_rows[inner, driven] -= hold.stiffness * rows[2][inner]
            if names:
                chosen = [system.parameters.index(name) for name in names]
                rows[3][inner] = np.array(ca.densify(self._inner_slopes(None)(*at)))[:, chosen]
        for part in rows:
            part[:n] /= h
        # the spring at a joint whose motor is off is released when the motion begins
        hand = hold.by_hand * hold.give(q, system)
        rows[0][driven] += hand
        by_rows[driven, driven] -= hold.by_hand
        momentum[0][driven] += h / 2 * hand
        by_p[driven, driven] -= h / 2 * hold.by_hand
        for slopes in (by_rows, by_p):
            slopes[:, n + nz :] *= h
        return rows, momentum

    def _differentiate(
        self, w: Array, theta: Array, hold: _Hold, h: float, names: tuple[str, ...]
    ) -> tuple[Array, Array, Array]:
        """State (q, p, z) at equilibrium, with derivatives by named parameters and by the known coordinates."""
        n, nz, nu = (self.step.sizes[key] for key in ("n", "nz", "nu"))
        free, fixed = len(self.free_coordinates), list(self.step.system.prescribed_coordinate_indices)
        (_, rows, push, others), (p, by_p, push_p, others_p) = self._rest_equations(w, theta, hold, h, names)
        driven = list(self.step.system.actuated_coordinate_indices)
        push, push_p = hold.stiffness * push, hold.stiffness * push_p
        push[driven, range(nu)] += hold.by_hand
        push_p[driven, range(nu)] += h / 2 * hold.by_hand
        by_other = np.hstack([others, push, rows[:, fixed]])[self._sought]
        change = -_solved(rows[np.ix_(self._sought, self._sought)], by_other)
        state = np.concatenate([self._configuration(w, hold.given), p, w[free : free + nz]])
        total = np.zeros((len(state), by_other.shape[1]))
        total[list(self.free_coordinates)] = change[:free]
        total[fixed, len(names) + nu + np.arange(len(fixed))] = 1.0
        total[n : 2 * n] = by_p[:, self._sought] @ change + np.hstack([others_p, push_p, by_p[:, fixed]])
        total[2 * n :] = change[free : free + nz]
        return state, total[:, : len(names)], total[:, len(names) :]

    def _explain(self, state: Array, theta: Array, error: float) -> str:
        system, step, e = self.step.system, self.step, self.step.equations
        text, n = f"no equilibrium was found (the remaining imbalance is {error:.2g} N m or m)", system.n_coordinates
        if not system.grasps or not np.all(np.isfinite(state)):
            return text
        with CASADI_LOCK:
            phi = ca.Function("phi", [e.q1, e.z1, e.lam, e.theta, e.time_step], [e.end_of_step_constraint_violation])
        gap = np.array(phi(state[:n], state[2 * n :], 0, theta, step.time_step)).ravel()
        for grasp in system.grasps:
            distance, gap = float(np.linalg.norm(gap[:3])), gap[grasp.n_constraint_equations :]
            if distance > 1e-4:
                text += f"; grasp '{grasp.name}' is out of reach by {1e3 * distance:.3g} mm"
        return text


def _servo_energy(system: System, u: ca.SX, q: ca.SX) -> ca.SX:
    """Sum of 1/2 gain (u - q)^2 over all servos [J]; limits and damping do not change the lowest equilibrium."""
    at = zip(system.driven, system.actuated_coordinate_indices, ca.vertsplit(u), strict=True) if system.servos else ()
    known = ((system.servos[name], part, q[i]) for name, i, part in at)
    energies = [0.5 * s.gain * s.position_error_beyond_dead_band(command, angle) ** 2 for s, command, angle in known]
    return sum(energies, ca.SX(0))


def joint_hold_spring_stiffness(system: System, known: bool) -> float:
    """Return the stiffness [N m/rad] of springs at measured angles. `known`: torques or servo commands are given."""
    if not known:
        return RIGID_HOLD_STIFFNESS
    return _HOLD_STIFFNESS_WITH_COMMAND if system.servos else _HOLD_STIFFNESS_WITH_TORQUE


@dataclass(frozen=True)
class _Hold:
    """Known coordinates `given`, and the torques `held` and springs that hold the driven coordinates."""

    given: Array
    held: Array
    stiffness: float
    by_hand: Array  # stiffness of the springs at joints whose motor is off, (nu,) [N m/rad]

    def give(self, q: Any, system: System) -> Any:
        """Distance of the driven joints from their targets."""
        driven = list(system.actuated_coordinate_indices)
        # casadi's q[[]] of a single coordinate is a row
        return self.given[: len(driven)] - q[driven] if driven else np.zeros(0)


def _damped_newton(
    function: Callable[[Array], tuple[Array, Array]], w: Array, tolerance: float
) -> tuple[Array, float, bool]:
    """Root, largest residual and success of Newton's method with a natural monotonicity test (Deuflhard 2011, 3.3)."""
    if len(w) == 0:
        return w, 0.0, True
    residual, jacobian = function(w)
    error = float(np.max(np.abs(residual)))
    for _ in range(_NEWTON_ITERATION_LIMIT):
        if error <= tolerance or not math.isfinite(error):
            break
        factors, pivots, singular = scipy.linalg.lapack.dgetrf(jacobian)
        if singular:
            return w, error, False
        delta = -scipy.linalg.lapack.dgetrs(factors, pivots, residual)[0]
        scale = np.maximum(np.abs(w), 1.0)
        size = float(np.max(np.abs(delta / scale)))
        if not math.isfinite(size):
            return w, error, False
        factor = min(1.0, 0.3 / size) if size else 1.0
        while True:
            trial = w + factor * delta
            left, slopes = function(trial)
            if np.all(np.isfinite(left)):
                shrunk = float(np.max(np.abs(scipy.linalg.lapack.dgetrs(factors, pivots, left)[0]) / scale))
                if shrunk <= (1 - factor / 4) * size or np.max(np.abs(left)) <= (1 - factor / 4) * error:
                    break
            factor *= 0.5
            if factor < 1e-6:
                return w, error, error < 1e2 * tolerance
        w, residual, jacobian = trial, left, slopes
        error = float(np.max(np.abs(residual)))
    return w, error, error <= tolerance


def _solved(matrix: Array, right: Array) -> Array:
    """Solution of a linear system; the least-squares solution if redundant grasps make the forces undetermined."""
    if not right.size:
        return np.zeros((matrix.shape[1], right.shape[1]))
    factors, pivots, info = scipy.linalg.lapack.dgetrf(matrix)
    norm = float(np.max(np.sum(np.abs(matrix), axis=0)))
    if info == 0 and scipy.linalg.lapack.dgecon(factors, norm)[0] > _MIN_RECIPROCAL_CONDITION:
        return np.asarray(scipy.linalg.lapack.dgetrs(factors, pivots, right)[0])
    return np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0])


def steady_effect_internal_coordinates(step: Step, q: ArrayLike, theta: ArrayLike) -> Array:
    """Compute the relaxed internal coordinates (nz,) of a system held at the configuration `q` for a long time."""
    e = step.equations
    nz = e.z0.numel()
    if nz == 0:
        return np.zeros(0)
    with CASADI_LOCK:
        z, at = ca.SX.sym("z", nz), ca.SX.sym("q", e.q0.numel())
        old = ca.vertcat(e.q0, e.q1, e.z0, e.z1, e.p0, e.lam, e.u)
        still = ca.vertcat(at, at, z, z, ca.SX(ca.DM.zeros(e.p0.numel() + e.lam.numel() + e.u.numel())))
        residual = ca.substitute(e.internal_residual_at_rest, old, still)
        function = ca.Function("relaxed", [z, at, e.theta, e.time_step], [residual, ca.jacobian(residual, z)])
    arguments = (np.asarray(q, float), np.asarray(theta, float), step.time_step)

    def equations(x: Array) -> tuple[Array, Array]:
        value, slope = function(x, *arguments)
        return np.array(value).ravel(), np.array(ca.densify(slope))

    return _damped_newton(equations, np.zeros(nz), 1e-12)[0]

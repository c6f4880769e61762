"""The tracking filter of driven arms, a feedback that keeps them near the measured motion.

The discrete momentum contains half the impulse of the previous step. An effect, or a torque other than the recorded
one, therefore changes the momentum that belongs to a given motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import scipy.linalg.lapack
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array
from yid_ocp.errors import ModelError
from yid_ocp.integrator.compiler import MappedFunction
from yid_ocp.integrator.step import Step, compile_step_like
from yid_ocp.integrator.step_model import NEWTON_ITERATION_LIMIT, TrackingFeedback
from yid_ocp.parallel import CasadiLockedCache

_Wanted = Sequence[tuple[int, int]]  # index of a derivative column, and index of its parameter
_NEWTON_ITERATIONS = 5  # for an implicit nonlinear equation of an internal coordinate
_ANGLE_STD, _RATE_STD, _TORQUE_STD = 0.02, 0.3, 1.0  # errors of equal weight in the LQR [rad], [rad/s], [N m]


def proportional_tracking_feedback(step: Step, measured: ArrayLike, gains: ArrayLike) -> TrackingFeedback:
    """Create a feedback that keeps driven joints near their measured angles, u_k = ubar_k - K (q_k - qbar_k).

    K is diagonal. `measured` holds the joint angles qbar at every node, (N + 1, nu) [rad]. `gains` [N m/rad] holds one
    gain, one for each joint of an arm, or nu gains. Raises `ModelError` for another number of gains or a negative gain.
    """
    reference, nu = np.asarray(measured, float), step.sizes["nu"]
    values = np.atleast_1d(np.asarray(gains, float))
    if values.size not in (1, nu) and nu % max(values.size, 1):
        what = f"the settings have {values.size} gains for {nu} driven joints"
        allowed = f"1 gain, {nu} gains or, of several equal arms, one gain for each joint of an arm"
        hint = f"give one gain for all joints, or {nu} gains, one for each joint in the order of the model"
        raise ModelError(what, where="problem.arm_proportional_gains", allowed=allowed, hint=hint)
    values = np.resize(values, nu)
    if np.any(values < 0):
        what, where = f"the tracking gain {values.min():g} N m/rad is negative", "problem.arm_proportional_gains"
        raise ModelError(what, where=where, allowed="0 or more [N m/rad]", hint="set gains of 0 or more, such as [10]")
    gain = np.broadcast_to(np.diag(values), (len(reference) - 1, nu, nu)).copy()
    return TrackingFeedback(np.array(step.system.actuated_coordinate_indices, np.int32), gain, reference[:-1])


def lqr_tracking_feedback(
    step: Step, measured: ArrayLike, torque: ArrayLike, theta: ArrayLike, arms: Step | None = None
) -> TrackingFeedback:
    """Compute a feedback with finite-horizon LQR gains that keeps the driven arms near their measured motion.

    The gains act on the arms' angles and momenta. They minimise the sum of |dq|^2/angle^2 + |M^-1 dp|^2/rate^2 +
    |du|^2/torque^2 over the recording, with fixed scales for angle, rate and torque (Anderson and Moore 1990, Optimal
    Control: Linear Quadratic Methods, section 2.4). The model contains the arms without the object and is linearised
    about the measured motion. The reference momentum follows from the measured angles (N + 1, nu) [rad] and torques (N,
    nu) [N m] by the arms' DEL equations, and is therefore comparable with the model's momentum. The angles must be
    smooth enough for numerical differentiation. `arms` is a result of `compile_driven_arms_only_step` (None: made).
    """
    reference, torques = np.asarray(measured, float), np.asarray(torque, float)
    system = step.system
    arm_step = compile_driven_arms_only_step(step) if arms is None else arms
    arm_theta = np.asarray(theta, float)[list(map(system.parameters.index, arm_step.system.parameters.names))]
    nu = len(system.driven)
    # p_k = D2 L_d(q_{k-1}, q_k) + f+ of the measured motion, (N + 1, nu), which starts from rest
    angles, pushes = np.vstack([reference[:1], reference]), np.vstack([torques[:1], torques])
    course = arm_theta, np.hstack([angles, np.zeros_like(angles)]), np.zeros((len(pushes), 0)), pushes
    momenta = arm_step.kernel.step_residuals_and_jacobians(*course, (), False).p1
    steps = len(reference) - 1

    weight_q, weight_u = (np.eye(nu) * (1.0 / std**2) for std in (_ANGLE_STD, _TORQUE_STD))
    gain = np.zeros((steps, nu, 2 * nu))
    states = np.hstack([reference, momenta])[:-1]
    by_state, by_torque = _one_step_each(arm_step, states, torques, reference[1:], arm_theta)
    rate, stages = by_state[:, :nu, nu:] / step.time_step, np.zeros((steps, 2 * nu, 2 * nu))
    stages[:, :nu, :nu], stages[:, nu:, nu:] = weight_q, rate.transpose(0, 2, 1) @ rate / _RATE_STD**2
    cost = stages[-1]
    for k in reversed(range(steps)):
        a, b, stage = by_state[k], by_torque[k], stages[k]
        pushed = b.T @ cost
        _, gain[k], failed = scipy.linalg.lapack.dposv(weight_u + pushed @ b, pushed @ a)
        gain[k] = np.nan if failed else gain[k]
        closed = a - b @ gain[k]
        cost = stage + closed.T @ cost @ closed + gain[k].T @ weight_u @ gain[k]
        cost = 0.5 * (cost + cost.T)
    driven = np.array(system.actuated_coordinate_indices)
    index = np.concatenate([driven, system.n_coordinates + driven])
    return TrackingFeedback(index.astype(np.int32), gain, np.hstack([reference[:-1], momenta[:-1]]))


def compile_driven_arms_only_step(step: Step) -> Step:
    """Compile the step of a system of the driven joints alone. Raises `ModelError` if other joints come before them."""
    system, mechanism = step.system, step.system.mechanism
    keep = [mechanism.joint_index(name) for name in system.driven]
    if sorted(keep) != list(range(len(keep))):
        what = "the LQR tracking filter cannot be used, because other joints of the model come before the driven ones"
        where, allowed = "problem.arm_tracking_feedback", "driven joints that are the first coordinates of the model"
        raise ModelError(what, where=where, allowed=allowed, hint="set problem.arm_tracking_feedback: proportional")
    frames = {name: frame for name, frame in mechanism.frames.items() if frame.joint_index < len(keep)}
    arms = replace(mechanism, joints=mechanism.joints[: len(keep)], frames=frames, link_chains={})
    damping = {name: value for name, value in system.joint_damping.items() if name in system.driven}
    without = replace(system, elastic_joints=(), grasps=(), prescribed=(), segment_layouts=(), point_frames=())
    arms_only = replace(without, mechanism=arms, joint_compliances={}, joint_damping=damping, effects=())
    return compile_step_like(step, arms_only)


def _one_step_each(arm_step: Step, start: Array, torque: Array, guess: Array, theta: Array) -> tuple[Array, Array]:
    """A_k (N, 2 nu, 2 nu), B_k (N, 2 nu, nu) of a step from each state to about `guess`; NaN if Newton fails."""
    count, nu = torque.shape
    # the kernel takes consecutive states: each start and its successor; the steps between these pairs are not used
    state, torques = np.repeat(start, 2, axis=0), np.repeat(torque, 2, axis=0)[:-1]
    state[1::2, :nu] = guess
    none = np.zeros((2 * count - 1, 0))
    own = slice(None, None, 2)
    try:
        for _ in range(NEWTON_ITERATION_LIMIT):
            found = arm_step.kernel.step_residuals_and_jacobians(theta, state, none, torques, (), True)
            change = np.linalg.solve(found.residual_by_new[own], found.residual[own, :, None])[:, :, 0]
            if not np.max(np.abs(change), initial=0.0) > arm_step.model.tolerance:
                break
            state[1::2, :nu] -= change
        else:
            raise np.linalg.LinAlgError
        known = np.broadcast_to(np.eye(nu), (count, nu, nu))
        by_known = np.concatenate([found.residual_by_old[own], known, found.residual_by_input[own]], axis=2)
        moved = -np.linalg.solve(found.residual_by_new[own], by_known)
    except np.linalg.LinAlgError:
        return np.full((count, 2 * nu, 2 * nu), np.nan), np.full((count, 2 * nu, nu), np.nan)
    momenta = np.concatenate([found.p1_by_old[own], 0 * known, found.p1_by_input[own]], axis=2)
    after = np.concatenate([moved, found.p1_by_new[own] @ moved + momenta], axis=1)
    return after[:, :, : 2 * nu], after[:, :, 2 * nu :]


@dataclass(frozen=True)
class RecordedMotionWithSensitivities:
    """The angles and torques of the driven joints over a recording, with their derivatives in d directions (..., d).

    The first of the d directions are parameters. A derivative is None if the quantity depends on no direction.
    """

    angles: Array  # at every node, (N + 1, nu) [rad]
    torque: Array  # held over every step, (N, nu) [N m]
    initial_internal: Array  # internal coordinates at the first node, (nz,)
    angles_sensitivity: Array | None = None
    torque_sensitivity: Array | None = None
    initial_internal_sensitivity: Array | None = None

    @property
    def _before_and_after(self) -> tuple[Array, Array]:
        """Angles one node earlier and at every node but the last. Before the first node, the joints are at rest."""
        return _one_before(self.angles[:-1]), self.angles[:-1]


class EffectMomentumCalculator:
    """A calculator of the momentum that effects add to the recorded motion, so that the feedback does not oppose it.

    `lqr_tracking_feedback` computes its reference momentum once, from recorded angles and torques without effects. An
    effect such as an armature, a fitted mass or damping of the arm, or a torque other than the recorded torque, changes
    the momentum of the motion. Without this shift the feedback would oppose the effect: by half at a joint whose
    momentum gain times h/2 is one. The momentum depends on the parameters `parameter_names` (at given torques).
    """

    def __init__(self, step: Step) -> None:
        e, system = step.equations, step.system
        driven = list(system.actuated_coordinate_indices)
        nu = len(driven)
        before, now = ca.SX.sym("before", nu), ca.SX.sym("now", nu)
        whole = []
        for arm in (before, now):
            q = ca.SX(ca.DM.zeros(system.n_coordinates))
            q[driven] = arm
            whole.append(q)
        self._kept = sorted({row % e.z0.numel() for row in _columns(e.p1[driven], ca.vertcat(e.z0, e.z1))})
        z0, z1 = (ca.SX(ca.DM.zeros(e.z0.numel())) for _ in range(2))
        if self._kept:
            z0[self._kept], z1[self._kept] = (x[self._kept] for x in (e.z0, e.z1))
        known = [*whole, z0, z1, ca.SX(ca.DM.zeros(e.lam.numel()))]
        wanted = [ca.densify(e.p1[driven]), e.internal_residual[self._kept]]
        [momentum, law] = ca.substitute(wanted, [e.q0, e.q1, e.z0, e.z1, e.lam], known)
        last, then = e.z0[self._kept], e.z1[self._kept]
        self._time_step = np.array([step.time_step])
        # the arm's own masses and damping count as effects do; an effect without neutral values keeps its parameters
        neutral = {p.name: p.value for p in system.parameters if p.name.rpartition(".")[0] in system.driven}
        for effect in system.effects:
            neutral |= getattr(effect, "neutral_values", {})
        at = {i: neutral[name] for i, name in enumerate(system.parameters.names) if name in neutral}
        columns = [i for i in _columns(ca.vertcat(momentum, law), e.theta) if i in at]
        self._columns, self._neutral = np.array(columns, int), np.array([at[i] for i in columns])
        self.parameter_names = tuple(system.parameters.names[i] for i in columns)
        inputs = [before, now, last, then, e.u, e.theta, e.time_step]
        by_theta = ca.jacobian(momentum, e.theta)[:, columns]

        def compiled(by_all: bool) -> MappedFunction:
            slopes = [ca.densify(ca.jacobian(momentum, x)) for x in (before, now, last, then)] if by_all else []
            function = ca.Function("momentum", inputs, [momentum, ca.densify(by_theta), *slopes])
            return MappedFunction(function, shared_inputs=(5, 6), use_compiler=step.is_compiled)

        self._maps: CasadiLockedCache[bool, MappedFunction] = CasadiLockedCache(compiled)
        self._impulse = ca.Function("impulse", inputs, [ca.densify(ca.jacobian(momentum, e.u))])
        at_row = {name: row for row, name in enumerate(system.effect_internal_coordinate_symbols)}
        symbols = [before, now, last, then, e.theta, e.time_step]
        self._memories: list[tuple[list[int], _InternalCoordinates]] = []
        for effect in system.effects:
            rows = [self._kept.index(at_row[x]) for x in effect.internal_coordinate_symbols if at_row[x] in self._kept]
            own = [i for i, name in enumerate(self.parameter_names) if name in effect.parameters.names]
            if rows:
                self._memories.append((own, _InternalCoordinates(step, symbols, law, rows, columns)))

    def momentum_derivative_by_previous_torque(self, theta: Array) -> Array:
        """Compute the derivative of the momentum with respect to the torques of the previous step, (nu, nu) [s]."""
        return np.array(self._impulse(*[np.zeros(self._impulse.numel_in(i)) for i in range(5)], theta, self._time_step))

    def effect_momentum_shifts_and_sensitivities(
        self,
        recorded: RecordedMotionWithSensitivities,
        true: RecordedMotionWithSensitivities,
        theta: Array,
        names: Sequence[str],
    ) -> tuple[Array, Array]:
        """Compute the momentum (N, nu) that effects add to the motion, at nodes 0..N-1, and its derivatives (N, nu, d).

        `recorded` is the recorded motion. `true` is the motion corrected for effects; only its derivatives are used.
        The first of the d directions are the parameters `names`.
        """
        steps, plain_theta = len(true.torque), self.parameter_values_with_neutral_effects(theta)
        still = np.zeros((steps, len(self._kept)))
        plain, *_ = self._maps(False)(
            *recorded._before_and_after, still, still, _one_before(recorded.torque), plain_theta, self._time_step
        )
        slopes = (true.angles_sensitivity, true.torque_sensitivity, true.initial_internal_sensitivity)
        width = max((len(names), *(x.shape[-1] for x in slopes if x is not None)))
        wanted = [(k, self.parameter_names.index(name)) for k, name in enumerate(names) if name in self.parameter_names]
        z, by_z = self._remembered(true, theta, wanted, width)
        value, by_theta, *by_all = self._maps(by_z is not None or true.angles_sensitivity is not None)(
            *true._before_and_after, _one_before(z), z, _one_before(true.torque), theta, self._time_step
        )
        total = np.zeros((*value.shape[:2], width))
        for column, own in wanted:
            total[:, :, column] = by_theta[:, :, own]
        if true.angles_sensitivity is not None:
            turned = true.angles_sensitivity[:-1]
            total[:, :, : turned.shape[2]] += by_all[0] @ _one_before(turned) + by_all[1] @ turned
        if by_z is not None:
            total += by_all[2] @ _one_before(by_z) + by_all[3] @ by_z
        if true.torque_sensitivity is not None:
            pushed = true.torque_sensitivity
            total[:, :, : pushed.shape[2]] += self.momentum_derivative_by_previous_torque(theta) @ _one_before(pushed)
        return (value - plain)[:, :, 0], total

    def _remembered(
        self, motion: RecordedMotionWithSensitivities, theta: Array, wanted: _Wanted, width: int
    ) -> tuple[Array, Array | None]:
        """Internal coordinates (N, nk) of joint effects at all nodes but the last, and derivatives (N, nk, d)."""
        steps = len(motion.torque)
        z, total = np.zeros((steps, len(self._kept))), np.zeros((steps, len(self._kept), width))
        freed, away = {own for _, own in wanted}, theta[self._columns] != self._neutral
        for own, memory in self._memories:
            if freed.isdisjoint(own) and not np.any(away[own]):
                continue
            rows = [self._kept[i] for i in memory.rows]
            z[:, memory.rows] = memory.along(motion, motion.initial_internal[rows], theta)
            total[:, memory.rows] = memory.slopes(motion, z[:, memory.rows], rows, theta, wanted, width)
        return z, total if np.any(total) else None

    def parameter_values_with_neutral_effects(self, theta: Array) -> Array:
        """Return a copy of theta with neutral effects and the arm as described, which defines the reference."""
        plain = theta.copy()
        plain[self._columns] = self._neutral
        return plain

    def changes_momentum(self, theta: Array, names: Sequence[str]) -> bool:
        """Check whether effects can change the momentum, given the parameter names `names` and the values `theta`."""
        return not set(names).isdisjoint(self.parameter_names) or bool(np.any(theta[self._columns] != self._neutral))


def applied_torque_derivative_by_torque_error(gain: Array, by_torque: Array) -> Array:
    """Compute the derivative (..., nu, nu) of the applied torque (recorded plus feedback) by the recorded torque.

    An error of the recorded torque also changes the reference momentum of the feedback. It is assumed to be the same in
    this step and the previous one. `gain` (..., nu, nb) is the feedback gain. `by_torque` (nu, nu) is the derivative of
    the reference momentum by the torque (`EffectMomentumCalculator.momentum_derivative_by_previous_torque`).
    """
    nu = len(by_torque)
    return np.eye(nu) + gain[..., nu:] @ by_torque[: gain.shape[-1] - nu]


class _InternalCoordinates:
    """Internal coordinates of one effect along a motion. `rows` are their indices among those in the momentum shift."""

    def __init__(self, step: Step, inputs: list[ca.SX], law: ca.SX, rows: list[int], columns: list[int]) -> None:
        before, now, last, then, theta, symbol = inputs
        self.rows, self._time_step = rows, np.array([step.time_step])
        old, new, own = last[rows], then[rows], law[rows]
        slope = ca.jacobian(own, new)
        after = old
        for _ in range(1 if ca.is_linear(own, new) else _NEWTON_ITERATIONS):
            row, by_new = ca.substitute([own, slope], [new], [after])
            after = after - ca.solve(by_new, row)
        by_theta = ca.jacobian(after, theta)[:, columns]
        advance = ca.Function("remembered", [old, before, now, theta, symbol], [after])
        self._many: CasadiLockedCache[int, ca.Function] = CasadiLockedCache(advance.mapaccum)
        outputs = [ca.densify(x) for x in (*(ca.jacobian(after, x) for x in (old, before, now)), by_theta)]
        function = ca.Function("remembering", [old, before, now, theta, symbol], outputs)
        compiled = step.is_compiled
        self._maps = CasadiLockedCache[None, MappedFunction](lambda _: MappedFunction(function, (3, 4), compiled))

    def along(self, motion: RecordedMotionWithSensitivities, start: Array, theta: Array) -> Array:
        """Return the effect's internal coordinates (N, k) along a motion from `start` (k,), without the last node."""
        before, now = motion._before_and_after
        found = [start]
        if len(now) > 1:
            repeated = np.tile(theta[:, None], len(now) - 1), np.tile(self._time_step[:, None], len(now) - 1)
            found += list(np.array(self._many(len(now) - 1)(start, before[1:].T, now[1:].T, *repeated)).T)
        return np.stack(found)

    def slopes(
        self,
        motion: RecordedMotionWithSensitivities,
        values: Array,
        start: list[int],
        theta: Array,
        columns: _Wanted,
        width: int,
    ) -> Array:
        """Return the derivatives (N, k, d) of the internal coordinates `values` (N, k) along d = `width` directions."""
        before, now = motion._before_and_after
        by_old, by_before, by_now, by_theta = self._maps(None)(_one_before(values), before, now, theta, self._time_step)
        total = np.zeros((*values.shape, width))
        for column, own in columns:
            total[1:, :, column] = by_theta[1:, :, own]
        if motion.angles_sensitivity is not None:
            turned = motion.angles_sensitivity[:-1]
            total[1:, :, : turned.shape[2]] += (by_before @ _one_before(turned) + by_now @ turned)[1:]
        if motion.initial_internal_sensitivity is not None:
            total[0] = motion.initial_internal_sensitivity[start]
        for k in range(1, len(total)):
            total[k] += by_old[k] @ total[k - 1]
        return total


def _columns(expression: ca.SX, theta: ca.SX) -> list[int]:
    """Indices of the entries of theta on which an expression depends."""
    return [int(i) for i in np.flatnonzero(np.array(ca.DM(ca.jacobian_sparsity(expression, theta), 1)).any(axis=0))]


def _one_before(values: Array) -> Array:
    """Entries delayed by one step; the first entry is repeated."""
    return np.concatenate([values[:1], values[:-1]])

"""Change of the discrete momentum of a known motion of the driven joints due to effects.

The discrete momentum contains half the impulse of the previous step, so a torque other than the recorded one, or an
effect, changes the momentum of the same motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.mapped_function import MappedFunction
from yid_ocp.integrator.step import Step
from yid_ocp.model.system import Effect
from yid_ocp.parallel import LockedCache

Array = NDArray[np.float64]
_NEWTON_ITERATIONS = 5
"""Newton iterations for a law of an internal coordinate that is nonlinear in its next value."""


@dataclass(frozen=True)
class DrivenJointMotion:
    """Angles and torques of the driven joints over the steps of a recording, with their derivatives.

    Attributes
    ----------
    angles : ndarray, shape (N + 1, nu)
        At every node [rad].
    torque : ndarray, shape (N, nu)
        Held over every step [N m].
    initial_internal : ndarray, shape (nz,)
        Internal coordinates at the first node.
    angles_sensitivity : ndarray, shape (N + 1, nu, d), or None
        Derivatives by d parameters and what follows these; None where nothing depends on them.
    torque_sensitivity : ndarray, shape (N, nu, d), or None
    initial_internal_sensitivity : ndarray, shape (nz, d), or None
    """

    angles: Array
    torque: Array
    initial_internal: Array
    angles_sensitivity: Array | None = None
    torque_sensitivity: Array | None = None
    initial_internal_sensitivity: Array | None = None

    @property
    def angles_before_and_after(self) -> tuple[Array, Array]:
        """Angles before and after the step to every node but the last; before the first node the joints are at rest."""
        return _one_before(self.angles[:-1]), self.angles[:-1]


class MomentumShift:
    """Difference between the momentum of a motion with effects and that of the recorded motion without them.

    `lqr_feedback` computes its reference once, from recorded angles and torques without effects. With a torque other
    than the recorded one, or an effect such as an armature, the same motion has another momentum, and the feedback
    would counteract the difference: at a wrist, whose gain by momentum times h/2 is near one, by half of the effect.

    Parameters
    ----------
    step : Step

    Attributes
    ----------
    parameter_names : tuple of str
        Names of effect parameters on which the momentum of a motion under known torques depends.
    """

    def __init__(self, step: Step) -> None:
        e, system = step.equations, step.system
        driven = list(system.driven_indices)
        nu = len(driven)
        before, now = ca.SX.sym("before", nu), ca.SX.sym("now", nu)
        whole = []
        for arm in (before, now):
            q = ca.SX(ca.DM.zeros(system.n_coordinates))
            q[driven] = arm
            whole.append(q)
        seen = _columns(e.p1[driven], ca.vertcat(e.z0, e.z1))
        self._kept = sorted({row % e.z0.numel() for row in seen})
        z0, z1 = (ca.SX(ca.DM.zeros(e.z0.numel())) for _ in range(2))
        z0[self._kept], z1[self._kept] = (x[self._kept] for x in (e.z0, e.z1))
        known = [*whole, z0, z1, ca.SX(ca.DM.zeros(e.lam.numel()))]
        [momentum, law] = ca.substitute(
            [ca.densify(e.p1[driven]), e.internal_residual[self._kept]], [e.q0, e.q1, e.z0, e.z1, e.lam], known
        )
        last, then = e.z0[self._kept], e.z1[self._kept]
        self._time_step = np.array([step.time_step])
        neutral = {name: value for effect in system.effects for name, value in _neutral(effect).items()}
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

        self._maps: LockedCache[bool, MappedFunction] = LockedCache(compiled)
        self._impulse = ca.Function("impulse", inputs, [ca.densify(ca.jacobian(momentum, e.u))])
        rows = {name: row for row, name in enumerate(system.internal_coordinates)}
        self._memories = tuple(
            (
                [i for i, name in enumerate(self.parameter_names) if name in effect.parameters.names],
                _Memory(step, [before, now, last, then, e.theta, e.time_step], law, own, columns),
            )
            for effect in system.effects
            if (
                own := [
                    self._kept.index(row) for name in effect.internal_coordinates if (row := rows[name]) in self._kept
                ]
            )
        )

    def momentum_by_torque(self, theta: Array) -> Array:
        """Derivative of the momentum by the torques of the previous step, shape (nu, nu) [s]."""
        arguments = [np.zeros(self._impulse.numel_in(i)) for i in range(5)]
        return np.array(self._impulse(*arguments, theta, self._time_step))

    def shift_and_derivatives(
        self, recorded: DrivenJointMotion, true: DrivenJointMotion, theta: Array, names: Sequence[str]
    ) -> tuple[Array, Array]:
        """Momentum with effects minus recorded, at every node but the last, (N, nu), and its derivatives, (N, nu, d).

        Parameters
        ----------
        recorded, true : Motion
            The recorded motion, and the motion corrected for effects; only the latter's derivatives are used.
        theta : ndarray, shape (ntheta,)
        names : sequence of str
            Parameters of the first of the d derivatives.
        """
        steps, plain_theta = len(true.torque), self.theta_without_effects(theta)
        still = np.zeros((steps, len(self._kept)))
        plain, *_ = self._maps(False)(
            *recorded.angles_before_and_after, still, still, _one_before(recorded.torque), plain_theta, self._time_step
        )
        slopes = (true.angles_sensitivity, true.torque_sensitivity, true.initial_internal_sensitivity)
        width = max((len(names), *(x.shape[-1] for x in slopes if x is not None)))
        wanted = [(k, self.parameter_names.index(name)) for k, name in enumerate(names) if name in self.parameter_names]
        z, by_z = self._remembered(true, theta, wanted, width)
        moved = by_z is not None or true.angles_sensitivity is not None
        value, by_theta, *by_all = self._maps(moved)(
            *true.angles_before_and_after, _one_before(z), z, _one_before(true.torque), theta, self._time_step
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
            total[:, :, : pushed.shape[2]] += self.momentum_by_torque(theta) @ _one_before(pushed)
        return (value - plain)[:, :, 0], total

    def _remembered(
        self, motion: DrivenJointMotion, theta: Array, wanted: Sequence[tuple[int, int]], width: int
    ) -> tuple[Array, Array | None]:
        """What joints remember at every node but the last, (N, nk), and its derivatives, (N, nk, d), or None."""
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

    def theta_without_effects(self, theta: Array) -> Array:
        """theta with these effects neutral, at which the feedback's reference is computed."""
        plain = theta.copy()
        plain[self._columns] = self._neutral
        return plain

    def is_active(self, theta: Array, names: Sequence[str]) -> bool:
        """Whether any effect shifts the momentum, or one of its parameters is in `names`."""
        return not set(names).isdisjoint(self.parameter_names) or bool(np.any(theta[self._columns] != self._neutral))


def torque_error_feedthrough(gain: Array, by_torque: Array) -> Array:
    """Derivative of the applied torque by an error of the recorded torque, feedback included, (nu, nu).

    The feedback's reference momenta follow from the recorded torque; the error is assumed equal in the previous step.

    Parameters
    ----------
    gain : ndarray, shape (nu, nb)
        Feedback gain of one step.
    by_torque : ndarray, shape (nu, nu)
        See `MomentumShift.momentum_by_torque`.
    """
    nu = len(by_torque)
    return np.eye(nu) + gain[:, nu:] @ by_torque if gain.shape[1] > nu else np.eye(nu)


class _Memory:
    """The internal coordinates of one effect of driven joints, along a motion.

    Attributes
    ----------
    rows : list of int
        Among all that the momentum depends on.
    """

    def __init__(
        self, step: Step, inputs: Sequence[ca.SX], law: ca.SX, rows: list[int], columns: Sequence[int]
    ) -> None:
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
        self._many: LockedCache[int, ca.Function] = LockedCache(advance.mapaccum)
        outputs = [ca.densify(x) for x in (*(ca.jacobian(after, x) for x in (old, before, now)), by_theta)]
        function = ca.Function("remembering", [old, before, now, theta, symbol], outputs)
        self._maps: LockedCache[None, MappedFunction] = LockedCache(
            lambda _: MappedFunction(function, shared_inputs=(3, 4), use_compiler=step.is_compiled)
        )

    def along(self, motion: DrivenJointMotion, start: Array, theta: Array) -> Array:
        """Values at every node but the last, shape (N, k)."""
        before, now = motion.angles_before_and_after
        found = [start]
        if len(now) > 1:
            repeated = np.tile(theta[:, None], len(now) - 1), np.tile(self._time_step[:, None], len(now) - 1)
            found += list(np.array(self._many(len(now) - 1)(start, before[1:].T, now[1:].T, *repeated)).T)
        return np.stack(found)

    def slopes(
        self,
        motion: DrivenJointMotion,
        values: Array,
        start: list[int],
        theta: Array,
        wanted: Sequence[tuple[int, int]],
        width: int,
    ) -> Array:
        """Derivatives of the values, shape (N, k, d)."""
        before, now = motion.angles_before_and_after
        by_old, by_before, by_now, by_theta = self._maps(None)(_one_before(values), before, now, theta, self._time_step)
        total = np.zeros((*values.shape, width))
        for column, own in wanted:
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
    """Which entries of theta an expression depends on."""
    pattern = np.array(ca.DM(ca.jacobian_sparsity(expression, theta), 1))
    return [int(i) for i in np.flatnonzero(pattern.any(axis=0))]


def _one_before(values: Array) -> Array:
    """Every entry but the last moved by one; the first stands twice."""
    return np.concatenate([values[:1], values[:-1]])


def _neutral(effect: Effect) -> Mapping[str, float]:
    """Values with which an effect is absent; one that does not say so is taken as it stands."""
    return dict(getattr(effect, "neutral_values", {}))

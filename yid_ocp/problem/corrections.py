"""What the model's effects say about recorded inputs: true torques, angles and times behind what was recorded."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.mapped import Mapped
from yid_ocp.integrator.step import Feedback
from yid_ocp.model.system import RecordedEffect, System
from yid_ocp.problem.inputs import held_torque, held_torque_slope
from yid_ocp.sensors import Sensor

if TYPE_CHECKING:
    from yid_ocp.problem.problem import Episode

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Inputs:
    """What drives a rollout, with derivatives by d parameters; a derivative is None where it is zero throughout.

    Attributes
    ----------
    torque : ndarray, shape (N, nu)
        [N m]
    first_torque : ndarray, shape (nu,)
        That which holds the first posture [N m].
    path : ndarray, shape (N + 1, nc)
    arm : ndarray, shape (N + 1, nu)
        Angles of the driven joints [rad].
    by_torque, by_first_torque, by_path, by_arm : ndarray, shape (..., d), or None
    momentum : ndarray, shape (N, nu), or None
        What effects add to that of the driven joints along their measured motion.
    by_momentum : ndarray, shape (N, nu, d), or None
    """

    torque: Array
    first_torque: Array
    path: Array
    arm: Array
    by_torque: Array | None = None
    by_first_torque: Array | None = None
    by_path: Array | None = None
    by_arm: Array | None = None
    momentum: Array | None = None
    by_momentum: Array | None = None

    @property
    def posture(self) -> Array:
        """Known coordinates (driven, then prescribed) at node 0, shape (nk,)."""
        return np.concatenate([self.arm[0], self.path[0]])

    def by_posture(self, width: int) -> Array:
        """Derivative of `posture`, shape (nk, d)."""
        parts = ((self.by_arm, self.arm), (self.by_path, self.path))
        return np.vstack([np.zeros((x.shape[1], width)) if by is None else by[0] for by, x in parts])

    def guided(self, feedback: Feedback | None, driven: tuple[int, ...], measured: Array) -> Feedback | None:
        """The tracking filter with the true angles in place of the measured ones, and the momenta of these effects."""
        if feedback is None or (self.by_arm is None and self.momentum is None):
            return feedback
        reference = feedback.reference.copy()
        for column, at in self._followed(feedback, driven, momenta=False):
            if self.by_arm is not None:
                reference[:, column] += (self.arm - measured)[: len(reference), at]
        for column, at in self._followed(feedback, driven, momenta=True):
            if self.momentum is not None:
                reference[:, column] += self.momentum[:, at]
        return Feedback(feedback.index, feedback.gain, reference)

    def torque_directions(self, feedback: Feedback | None, driven: tuple[int, ...]) -> Array | None:
        """Derivative of the nominal torque, that of the filter's reference included, shape (N, nu, d)."""
        total = self.by_torque
        for slope, momenta in ((self.by_arm, False), (self.by_momentum, True)):
            if feedback is None or slope is None:
                continue
            total = np.zeros((*self.torque.shape, slope.shape[2])) if total is None else total.copy()
            for column, at in self._followed(feedback, driven, momenta):
                total += feedback.gain[:, :, column, None] * slope[: len(total), at][:, None, :]
        return total

    def _followed(self, feedback: Feedback, driven: tuple[int, ...], momenta: bool) -> list[tuple[int, int]]:
        """Columns of a filter that follow angles, or momenta, and the driven joint of each."""
        rows = [int(row) for row in feedback.index]
        if not momenta:
            return [(column, driven.index(row)) for column, row in enumerate(rows) if row in driven]
        # momenta come after all coordinates, those of driven joints in the same order
        later = [column for column, row in enumerate(rows) if row not in driven]
        return list(zip(later, range(len(driven)), strict=False))


class InputCorrections:
    """Maps from recorded to true inputs and times, from `RecordedEffect.correct` and `.delay` of a system's effects.

    Parameters
    ----------
    system : System
    use_compiler : bool
    """

    def __init__(self, system: System, use_compiler: bool) -> None:
        self.system = system
        self._compiled = use_compiler
        self._effects = tuple(e for e in system.effects if isinstance(e, RecordedEffect))
        self.joints = (*system.driven, *system.prescribed)
        count = len(self.joints)
        self._angle, self._effort = ca.SX.sym("angle", count), ca.SX.sym("effort", count)
        angles, efforts = [], []
        for i, joint in enumerate(self.joints):
            effort, angle = self._effort[i], self._angle[i]
            # the last effect is the nearest to the reading
            for effect in reversed(self._effects):
                effort = effect.correct(f"joints.effort.{joint}", effort, effort)
            for effect in reversed(self._effects):
                angle = effect.correct(f"joints.position.{joint}", angle, effort)
            efforts.append(effort)
            angles.append(angle)
        self._true_angle = ca.vertcat(ca.SX(0, 1), *angles)
        self._true_effort = ca.vertcat(ca.SX(0, 1), *efforts)
        theta = system.parameters.symbols
        self.corrects_angles = self._depends(self._true_angle, theta)
        self.corrects_efforts = self._depends(self._true_effort, theta)
        self.angles_need_effort = self._depends(self._true_angle, self._effort)
        self._late = ca.vertcat(ca.SX(0, 1), *(self._delay(f"torque.{joint}", False) for joint in system.driven))
        self.delays_torque = self._depends(self._late, theta)
        self._maps: dict[tuple[str, ...], Mapped] = {}
        self._delays: dict[tuple[Sensor | None, tuple[str, ...]], ca.Function] = {}

    @property
    def active(self) -> bool:
        """Whether true inputs may differ from recorded ones."""
        return self.corrects_angles or self.delays_torque or (self.corrects_efforts and bool(self.system.driven))

    @staticmethod
    def _depends(expression: ca.SX, symbols: ca.SX) -> bool:
        return expression.numel() > 0 and symbols.numel() > 0 and bool(ca.depends_on(expression, symbols))

    def _delay(self, channel: str, camera: bool) -> ca.SX:
        total = sum((effect.delay(channel, camera) for effect in self._effects), ca.SX(0))
        # a delay is in true time, a recording in its own
        return total / self.system.time_scale

    def true(
        self, angle: Array, effort: Array, theta: Array, names: tuple[str, ...]
    ) -> tuple[Array, Array, Array, Array, Array]:
        """True angles and efforts of `joints` behind readings.

        Parameters
        ----------
        angle, effort : ndarray, shape (K, nj)
        theta : ndarray, shape (ntheta,)
        names : tuple of str
            Parameters by which to differentiate, d of them.

        Returns
        -------
        angle, effort : ndarray, shape (K, nj)
        angle_by_theta, effort_by_theta : ndarray, shape (K, nj, d)
        effort_by_reading : ndarray, shape (K, nj)
        """
        if names not in self._maps:
            chosen = self._chosen(names)
            slope = ca.vertcat(
                ca.SX(0, 1), *(ca.jacobian(self._true_effort[i], self._effort[i]) for i in range(len(self.joints)))
            )
            outputs = [
                self._true_angle,
                self._true_effort,
                ca.jacobian(self._true_angle, chosen),
                ca.jacobian(self._true_effort, chosen),
                ca.densify(slope),
            ]
            function = ca.Function("true", [self._angle, self._effort, self.system.parameters.symbols], outputs)
            self._maps[names] = Mapped(function, shared=(2,), use_compiler=self._compiled)
        a, e, a_theta, e_theta, e_reading = self._maps[names](angle, effort, theta)
        return a[:, :, 0], e[:, :, 0], a_theta, e_theta, e_reading[:, :, 0]

    def inputs(self, episode: Episode, theta: Array, names: tuple[str, ...]) -> Inputs:
        """What drives an episode's rollout: the recording, as far as no effect says that it reads something else.

        Parameters
        ----------
        episode : Episode
        theta : ndarray, shape (ntheta,)
        names : tuple of str
            Parameters by which to differentiate.
        """
        torque, arm, path = episode.torque, episode.measured_arm, episode.path
        nu, nc = torque.shape[1], path.shape[1]
        first = torque[0] if nu else np.zeros(0)
        by_torque = by_first = by_arm = by_path = None
        if nu and (self.delays_torque or self.corrects_efforts):
            joints = episode.recording.joints
            assert joints is not None
            where = (joints, self.system.driven, episode.grid, episode.name)
            delay, by_delay = self.torque_delay(theta, names)
            if self.delays_torque:
                torque = held_torque(*where, delay)
            readings = np.pad(np.vstack([torque, first]), ((0, 0), (0, nc)))
            _, true, _, by_theta, by_reading = self.true(np.zeros_like(readings), readings, theta, names)
            by_theta = by_theta[:, :nu].copy()
            if self.delays_torque and names:
                slope = by_reading[:-1, :nu] * held_torque_slope(*where, delay)
                by_theta[:-1] += slope[:, :, None] * by_delay
            torque, first, by_torque, by_first = true[:-1, :nu], true[-1, :nu], by_theta[:-1], by_theta[-1]
        if self.corrects_angles:
            true, _, by_angle, _, _ = self.true(np.hstack([arm, path]), episode.load, theta, names)
            arm, path, by_arm, by_path = true[:, :nu], true[:, nu:], by_angle[:, :nu], by_angle[:, nu:]
        return Inputs(torque, first, path, arm, by_torque, by_first, by_path, by_arm)

    def torque_delay(self, theta: Array, names: tuple[str, ...]) -> tuple[Array, Array]:
        """How long after it was recorded each driven joint's torque acts, shape (nu,) [s], and its derivative."""
        return self._evaluate(None, self._late, theta, names)

    def sensor_delay(self, sensor: Sensor, theta: Array, names: tuple[str, ...]) -> tuple[Array, Array] | None:
        """How long before its recorded time each output was true, shape (k,) [s], and its derivative; None if never."""
        if sensor not in self._late_sensors:
            camera = sensor.camera is not None
            late = [self._delay(channel, camera) for channel in sensor.channels for _ in range(sensor.width)]
            expression = ca.vertcat(ca.SX(0, 1), *late)
            moved = self._depends(expression, self.system.parameters.symbols)
            self._late_sensors[sensor] = expression if moved else None
        found = self._late_sensors[sensor]
        return None if found is None else self._evaluate(sensor, found, theta, names)

    @cached_property
    def _late_sensors(self) -> dict[Sensor, ca.SX | None]:
        return {}

    def _evaluate(
        self, key: Sensor | None, expression: ca.SX, theta: Array, names: tuple[str, ...]
    ) -> tuple[Array, Array]:
        if (key, names) not in self._delays:
            outputs = [expression, ca.jacobian(expression, self._chosen(names))]
            self._delays[key, names] = ca.Function("delay", [self.system.parameters.symbols], outputs)
        value, slope = self._delays[key, names](theta)
        return np.array(ca.densify(value)).ravel(), np.array(ca.densify(slope)).reshape(expression.numel(), len(names))

    def _chosen(self, names: tuple[str, ...]) -> ca.SX:
        return ca.vertcat(ca.SX(0, 1), *(self.system.parameters[name].symbol for name in names))

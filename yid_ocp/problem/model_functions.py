"""Compiled functions of a model, shared by many problems: sensors, equilibrium and input corrections."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import casadi as ca
import numpy as np

from yid_ocp.arrays import Array, IntArray
from yid_ocp.integrator.compiler import MappedFunction
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import Step, step_with_time_step
from yid_ocp.integrator.step_model import TrackingFeedback
from yid_ocp.integrator.tracking_feedback import (
    EffectMomentumCalculator,
    RecordedMotionWithSensitivities,
    compile_driven_arms_only_step,
)
from yid_ocp.model.mechanism import depends_on_symbols
from yid_ocp.model.system import System
from yid_ocp.parallel import CasadiLockedCache, CasadiLockedProperty
from yid_ocp.problem.initial_state_fit import InitialStateFitter
from yid_ocp.sensors import Sensor, sensor_function_with_jacobians


@dataclass(frozen=True)
class CorrectedInputs:
    """The true inputs of a rollout: recorded inputs corrected for effects. Sensitivities (..., d) of None are zero."""

    torque: Array  # (N, nu) [N m]
    first_torque: Array  # torque of the initial equilibrium, (nu,) [N m]
    prescribed_path: Array  # (N + 1, nc)
    driven_angles: Array  # angles of the driven joints at every node, (N + 1, nu) [rad]
    torque_sensitivity: Array | None = None
    first_torque_sensitivity: Array | None = None
    prescribed_path_sensitivity: Array | None = None
    driven_angles_sensitivity: Array | None = None
    momentum_shift: Array | None = None  # momentum that effects add to driven joints in the measured motion, (N, nu)
    momentum_shift_sensitivity: Array | None = None  # also by the initial state's unknowns, if requested

    @property
    def initial_known_coordinates(self) -> Array:
        """The coordinates (nk,) of the driven joints, then the prescribed joints, at node 0."""
        return np.concatenate([self.driven_angles[0], self.prescribed_path[0]])

    def initial_known_coordinate_sensitivities(self, width: int) -> Array:
        """The derivatives (nk, d) of `initial_known_coordinates` with respect to the parameters."""
        by_angles, by_path = self.driven_angles_sensitivity, self.prescribed_path_sensitivity
        parts = ((by_angles, self.driven_angles), (by_path, self.prescribed_path))
        return np.vstack([np.zeros((x.shape[1], width)) if by is None else by[0] for by, x in parts])

    def tracking_feedback_with_corrected_reference(
        self, feedback: TrackingFeedback | None, driven: tuple[int, ...], measured: Array
    ) -> TrackingFeedback | None:
        """Return `feedback` with its reference corrected to true angles, plus the momentum that effects cause."""
        turned = None if self.driven_angles_sensitivity is None else self.driven_angles - measured
        if feedback is None or (turned is None and self.momentum_shift is None):
            return feedback
        reference = feedback.reference.copy()
        for moved, momenta in ((turned, False), (self.momentum_shift, True)):
            if moved is not None:
                for column, at in self._followed(feedback, driven, momenta):
                    reference[:, column] += moved[: len(reference), at]
        return replace(feedback, reference=reference)

    def with_effect_momentum_in_reference(
        self,
        shift: EffectMomentumCalculator,
        recorded: RecordedMotionWithSensitivities,
        measured: Array,
        theta: Array,
        names: Sequence[str],
        by_internal: Array | None,
    ) -> CorrectedInputs:
        """Return a copy that stores the momentum which effects add to the tracking filter's reference in every step.

        `shift` computes it for `theta`, with derivatives in d directions, first by the parameters `names`. `recorded`
        has smoothed angles, `measured` (N + 1, nu) not. `by_internal` (nz, d): of the initial internal coordinates.
        """
        slopes = [x for x in (self.torque_sensitivity, self.driven_angles_sensitivity) if x is not None]
        read = np.array_equal(self.torque, recorded.torque) and np.array_equal(self.driven_angles, measured)
        if read and not any(np.any(x) for x in slopes) and not shift.changes_momentum(theta, names):
            return self
        smooth, by_angles = recorded.angles + self.driven_angles - measured, self.driven_angles_sensitivity
        remembered, by_torque = recorded.initial_internal, self.torque_sensitivity
        true = RecordedMotionWithSensitivities(smooth, self.torque, remembered, by_angles, by_torque, by_internal)
        momentum, slope = shift.effect_momentum_shifts_and_sensitivities(recorded, true, theta, names)
        return replace(self, momentum_shift=momentum, momentum_shift_sensitivity=slope if np.any(slope) else None)

    def torque_sensitivity_with_feedback_reference(
        self, feedback: TrackingFeedback | None, driven: tuple[int, ...], width: int
    ) -> Array | None:
        """Return the sensitivity (N, nu, width) of the sum: corrected torque plus feedback gain times its reference."""
        reached = [] if self.torque_sensitivity is None else [self.torque_sensitivity]
        for slope, momenta in ((self.driven_angles_sensitivity, False), (self.momentum_shift_sensitivity, True)):
            if feedback is not None and slope is not None:
                columns, own = (list(x) for x in zip(*self._followed(feedback, driven, momenta), strict=True))
                reached.append(feedback.gain[:, :, columns] @ slope[: len(self.torque), own])
        if not reached:
            return None
        return np.asarray(sum(np.pad(by, ((0, 0), (0, 0), (0, width - by.shape[2]))) for by in reached))

    def _followed(self, feedback: TrackingFeedback, driven: tuple[int, ...], momenta: bool) -> list[tuple[int, int]]:
        """Columns of a filter that feed back angles, or momenta, and the driven joint of each column."""
        rows = [int(row) for row in feedback.state_indices]
        if not momenta:
            return [(column, driven.index(row)) for column, row in enumerate(rows) if row in driven]
        # the momenta of driven joints follow all coordinates, in the same order
        later = [column for column, row in enumerate(rows) if row not in driven]
        return list(zip(later, range(len(driven)), strict=False))


class _InputCorrectionFunctions:
    """A set of compiled functions from recorded to true inputs and times, defined by the system's effects.

    `names` are the parameters for which derivatives are available. Methods return derivatives by some of them.
    """

    def __init__(self, system: System, names: tuple[str, ...], use_compiler: bool) -> None:
        self.system = system
        self._names = names
        self._effects = system.effects
        self.joint_names = (*system.driven, *system.prescribed)
        count = len(self.joint_names)
        angle, effort = ca.SX.sym("angle", count), ca.SX.sym("effort", count)
        true_angle, true_effort = self._corrected(angle, effort)
        theta = system.parameters.symbols
        self.corrects_angles = depends_on_symbols(true_angle, theta)
        self.corrects_efforts = depends_on_symbols(true_effort, theta)
        self.angles_depend_on_effort = depends_on_symbols(true_angle, effort)
        self._chosen = ca.vertcat(ca.SX(0, 1), *(system.parameters[name].symbol for name in names))
        self._times = {
            "torque_delay": self._with_jacobian([self._delay(f"torque.{joint}", False) for joint in system.driven]),
            "torque_lag": self._with_jacobian([self._lag(f"torque.{joint}") for joint in system.driven]),
            "effort_lag": self._with_jacobian([self._lag(f"joints.effort.{joint}") for joint in system.prescribed]),
        }
        slope = ca.vertcat(ca.SX(0, 1), *(ca.jacobian(true_effort[i], effort[i]) for i in range(count)))
        outputs, true = [true_angle, true_effort, ca.densify(slope)], ca.vertcat(true_angle, true_effort)
        self._correcting = [name for name in names if depends_on_symbols(true, system.parameters[name].symbol)]
        chosen = ca.vertcat(ca.SX(0, 1), *(system.parameters[name].symbol for name in self._correcting))

        def compiled(differentiated: bool) -> MappedFunction:
            slopes = [ca.jacobian(x, chosen) for x in outputs[:2]] if differentiated else []
            function = ca.Function("true", [angle, effort, theta], [*outputs, *slopes])
            return MappedFunction(function, shared_inputs=(2,), use_compiler=use_compiler)

        self._maps: CasadiLockedCache[bool, MappedFunction] = CasadiLockedCache(compiled)
        self._sensor_delays: CasadiLockedCache[Sensor, ca.Function | None] = CasadiLockedCache(self._sensor_delay)

    def _corrected(self, angle: ca.SX, effort: ca.SX) -> tuple[ca.SX, ca.SX]:
        angles, efforts = [], []
        for i, joint in enumerate(self.joint_names):
            true_effort, true_angle = effort[i], angle[i]  # the last effect is the nearest to the reading
            # a servo's command is a target of its encoder reading
            channel = "joints.position" if joint in self.system.servos else "joints.effort"
            for effect in reversed(self._effects):
                true_effort = effect.true_value_from_reading(f"{channel}.{joint}", true_effort, true_effort)
            for effect in reversed(self._effects):
                true_angle = effect.true_value_from_reading(f"joints.position.{joint}", true_angle, true_effort)
            efforts.append(true_effort)
            angles.append(true_angle)
        return ca.vertcat(ca.SX(0, 1), *angles), ca.vertcat(ca.SX(0, 1), *efforts)

    def _delay(self, channel: str, camera: bool) -> ca.SX:
        total = sum((effect.added_channel_delay(channel, camera) for effect in self._effects), ca.SX(0))
        kind, _, joint = channel.partition(".")
        if kind == "torque" and joint in self.system.servos:
            total += self.system.servos[joint].command_delay
        return total / self.system.recorded_time_scale  # delays are in true time, a recording has its own clock

    def _lag(self, channel: str) -> ca.SX:
        total = sum((effect.channel_lag_time_constant(channel) for effect in self._effects), ca.SX(0))
        return total / self.system.recorded_time_scale

    def true_angles_and_efforts(
        self, angle: Array, effort: Array, theta: Array, names: tuple[str, ...]
    ) -> tuple[Array, Array, Array, Array, Array]:
        """Compute true angles and efforts (K, nj) of `joint_names` from recorded values, with derivatives.

        Returns angles, efforts, their derivatives (K, nj, d) with respect to the d parameters `names`, and the
        derivative of the true effort with respect to the recorded effort.
        """
        a, e, e_reading, *slopes = self._maps(bool(names))(angle, effort, theta)
        a_theta, e_theta = by_theta = np.zeros((2, *a.shape[:2], len(names)))
        own = [name for name in self._correcting if name in names]  # few of many
        for full, slope in zip(by_theta, slopes, strict=False):
            full[:, :, [names.index(name) for name in own]] = slope[:, :, list(map(self._correcting.index, own))]
        return a[:, :, 0], e[:, :, 0], a_theta, e_theta, e_reading[:, :, 0]

    def joint_delays_or_lag_times(
        self, kind: Literal["torque_delay", "torque_lag", "effort_lag"], theta: Array, names: tuple[str, ...]
    ) -> tuple[Array, Array] | None:
        """Return the delays or lag times (nj,) [s] of driven joints' torques or of prescribed joints' efforts.

        Also returns their derivatives (nj, d) by the parameters `names`. None if no effect has a delay or lag.
        """
        return self._evaluate(self._times[kind], theta, names)

    def sensor_delays_with_derivatives(
        self, sensor: Sensor, theta: Array, names: tuple[str, ...]
    ) -> tuple[Array, Array] | None:
        """Return each output's delay, recorded minus true time (k,) [s], and its derivatives (k, d); None: no delay."""
        return self._evaluate(self._sensor_delays(sensor), theta, names)

    def _sensor_delay(self, sensor: Sensor) -> ca.Function | None:
        camera, width = sensor.camera_pose is not None, sensor.outputs_per_channel
        return self._with_jacobian([self._delay(c, camera) for c in sensor.channel_names for _ in range(width)])

    def _with_jacobian(self, entries: Sequence[ca.SX]) -> ca.Function | None:
        """Function of theta with its derivative by the chosen parameters; None if it is independent of theta."""
        expression, theta = ca.vertcat(ca.SX(0, 1), *entries), self.system.parameters.symbols
        if not depends_on_symbols(expression, theta):
            return None
        return ca.Function("times", [theta], [expression, ca.jacobian(expression, self._chosen)])

    def _evaluate(
        self, function: ca.Function | None, theta: Array, wanted: tuple[str, ...]
    ) -> tuple[Array, Array] | None:
        if function is None:
            return None
        value, slope = (np.array(ca.densify(x)) for x in function(theta))
        slope = slope.reshape(value.size, len(self._names))[:, [self._names.index(name) for name in wanted]]
        return (value.ravel(), slope) if value.any() or slope.any() else None


@dataclass(frozen=True)
class NodeStateValues:
    """The values at K nodes on which sensor readings depend, (K, n) unless stated otherwise."""

    q: Array  # coordinates
    v: Array  # velocities
    a: Array  # accelerations
    z: Array  # internal coordinates of effects, (K, nz)
    load: Array  # efforts at the coordinates
    lam: Array  # constraint forces, (K, m)

    @staticmethod
    def from_trajectory(
        step: Step, state: Array, load: Array | None = None, lam: Array | None = None
    ) -> NodeStateValues:
        """Compute the values at all nodes of a trajectory `state` (K, nx). Default load and constraint force: zero."""
        n, nodes = step.sizes["n"], np.arange(len(state))
        q, z = state[:, :n], state[:, 2 * n :]
        rates, h = (central_difference_velocity, second_difference_acceleration), step.time_step
        v, a = (rate(q, nodes, h) for rate in rates)
        lam = np.zeros((len(state), step.sizes["m"])) if lam is None else lam
        return NodeStateValues(q, v, a, z, np.zeros_like(q) if load is None else load, lam)

    def select_nodes(self, nodes: IntArray) -> NodeStateValues:
        """Select the values at the nodes with the given indices."""
        return NodeStateValues(*(values[nodes] for values in vars(self).values()))


def central_difference_velocity(q: Array, nodes: IntArray, time_step: float) -> Array:
    """Compute the velocity (len(nodes), ...) at `nodes` by central differences of the positions `q` (K, ...)."""
    before, after = np.maximum(nodes - 1, 0), np.minimum(nodes + 1, len(q) - 1)
    span = np.maximum(after - before, 1) * time_step
    return np.asarray((q[after] - q[before]) / span.reshape(-1, *[1] * (q.ndim - 1)))


def central_difference_velocity_adjoint(pull: Array, nodes: IntArray, count: int, time_step: float) -> Array:
    """Apply the transpose of the map `central_difference_velocity` to `pull` (len(nodes), n). Returns (count, n)."""
    before, after = np.maximum(nodes - 1, 0), np.minimum(nodes + 1, count - 1)
    scaled, result = pull / ((after - before) * time_step)[:, None], np.zeros((count, pull.shape[1]))
    np.add.at(result, after, scaled)
    np.subtract.at(result, before, scaled)
    return result


def second_difference_acceleration(q: Array, nodes: IntArray, time_step: float) -> Array:
    """Compute the acceleration (len(nodes), ...) at `nodes` by second differences of the positions `q` (K, ...)."""
    middle = _inner_nodes(nodes, len(q))
    return np.asarray((q[middle + 1] - 2 * q[middle] + q[middle - 1]) / time_step**2) if len(q) > 2 else 0 * q[nodes]


def second_difference_acceleration_adjoint(pull: Array, nodes: IntArray, count: int, time_step: float) -> Array:
    """Apply the transpose of the map `second_difference_acceleration` to `pull` (len(nodes), n). Returns (count, n)."""
    middle, result = _inner_nodes(nodes, count), np.zeros((count, pull.shape[1]))
    for shift, factor in ((-1, 1.0), (0, -2.0), (1, 1.0)):
        np.add.at(result, middle + shift, factor / time_step**2 * pull)
    return result


def _inner_nodes(nodes: IntArray, count: int) -> IntArray:
    return np.clip(nodes, 1, max(count - 2, 1))


class _SensorReadings(NamedTuple):
    """Readings (K, k) of a sensor's k outputs at K nodes, and derivatives (K, k, ...) by node values and parameters."""

    output: Array
    by_q: Array
    by_v: Array
    by_a: Array
    by_z: Array
    by_load: Array
    by_lam: Array
    by_theta: Array

    @property
    def needs_neighbours(self) -> bool:
        """Whether readings depend on velocities, accelerations or constraint forces, hence on neighbouring nodes."""
        return self.by_v.shape[2] + self.by_a.shape[2] + self.by_lam.shape[2] > 0


class ModelFunctions:
    """The compiled functions of a system: sensor readings, equilibrium, initial state fit and input corrections.

    `names` are the parameters for which derivatives are available; `start_parameters` those fitted with initial states.
    """

    def __init__(self, step: Step, names: tuple[str, ...], start_parameters: tuple[str, ...] = ()) -> None:
        self.step = step
        self.parameter_names, self._start_parameters = names, start_parameters
        self.input_corrections = _InputCorrectionFunctions(step.system, names, step.is_compiled)
        self._arms = CasadiLockedCache[None, Step](lambda _: compile_driven_arms_only_step(step))
        self._sensors: CasadiLockedCache[tuple[Sensor, bool], MappedFunction] = CasadiLockedCache(self._compiled)

    def with_time_step(self, time_step: float) -> ModelFunctions:
        """Return these functions for another time step [s]. Functions independent of the time step are shared."""
        made = ModelFunctions(step_with_time_step(self.step, time_step), self.parameter_names, self._start_parameters)
        made.input_corrections, made._sensors = self.input_corrections, self._sensors
        made._arms = CasadiLockedCache(lambda _: step_with_time_step(self.arms_only_integrator_step, time_step))
        return made

    @CasadiLockedProperty
    def equilibrium_solver(self) -> EquilibriumSolver:
        """The solver of the system's equilibrium equations."""
        return EquilibriumSolver(self.step)

    @CasadiLockedProperty
    def initial_state_fitter(self) -> InitialStateFitter:
        """The solver that fits an initial state to the first measured points."""
        return InitialStateFitter(self.step, self._start_parameters)

    @property
    def arms_only_integrator_step(self) -> Step:
        """The compiled step of a model of the driven arms alone, for the computation of the tracking filter's gains."""
        return self._arms(None)

    @CasadiLockedProperty
    def effect_momentum_calculator(self) -> EffectMomentumCalculator:
        """The calculator of the momentum that the model's effects add to the tracking feedback's reference."""
        return EffectMomentumCalculator(self.step)

    def compiled_sensor_function(
        self, sensor: Sensor, names: tuple[str, ...] = ()
    ) -> Callable[[NodeStateValues, Array], _SensorReadings]:
        """Return the compiled function of a sensor's readings at nodes, with derivatives by the parameters `names`."""
        function, columns = self._sensors((sensor, bool(names))), [self.parameter_names.index(name) for name in names]

        def read(at: NodeStateValues, theta: Array) -> _SensorReadings:
            output, *slopes = function(at.q, at.v, at.a, at.z, at.load, at.lam, theta)
            if names not in ((), self.parameter_names):
                slopes[-1] = slopes[-1][:, :, columns]
            return _SensorReadings._make([output[:, :, 0], *slopes])

        return read

    def _compiled(self, key: tuple[Sensor, bool]) -> MappedFunction:
        sensor, differentiated = key
        names = self.parameter_names if differentiated else ()
        function = sensor_function_with_jacobians(self.step.system, sensor, names)
        return MappedFunction(function, shared_inputs=(6,), use_compiler=self.step.is_compiled)

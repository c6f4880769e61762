"""Prediction of an episode's initial state, rollout and sensor readings, with derivatives."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.errors import DataError, SolverError
from yid_ocp.integrator.statics import Equilibrium
from yid_ocp.integrator.step import Step, checked_rollout_inputs
from yid_ocp.integrator.step_model import Rollout, RolloutInputs, SensitivityDirections
from yid_ocp.integrator.tracking_feedback import RecordedMotionWithSensitivities
from yid_ocp.model.system import System
from yid_ocp.parallel import map_in_threads
from yid_ocp.problem.episodes import Episode, EpisodePrediction, InitialStateWithSensitivity, truncate_episode
from yid_ocp.problem.evaluation import UnknownVectorLayout
from yid_ocp.problem.measurements import SensorMeasurements
from yid_ocp.problem.model_functions import (
    CorrectedInputs,
    ModelFunctions,
    NodeStateValues,
    central_difference_velocity,
    central_difference_velocity_adjoint,
    second_difference_acceleration,
    second_difference_acceleration_adjoint,
)
from yid_ocp.problem.options import ProblemOptions
from yid_ocp.problem.recorded_inputs import step_mean_input_delay_derivative, step_mean_inputs
from yid_ocp.sensors.signal_filters import FirstOrderLag, NodeValueSmoother, ZeroPhaseLowPassFilter, slow_effort_filter

# largest number of episodes rolled out at once, and largest memory of their states and derivatives [bytes]
_MAX_PARALLEL_ROLLOUTS, _MAX_ROLLOUT_MEMORY = 16, 2.0**26
_MAX_RESTING_TIME = 1.0  # latest time at which a point's first sample still shows the shape of the equilibrium [s]
# root mean square error of first points above which another equilibrium is sought [stds], and the part that may remain
_POOR_EQUILIBRIUM_RMSE, _MAX_REMAINING_ERROR_FRACTION = 5.0, 0.5


@dataclass(frozen=True)
class _Prepared:
    """An episode whose rollout can begin."""

    episode: Episode
    start: InitialStateWithSensitivity
    inputs: CorrectedInputs
    member: RolloutInputs
    wanted: tuple[str, ...]
    derivatives: bool


@dataclass(frozen=True)
class EpisodePredictor:
    """A stateless predictor of episodes: initial state, rollout and sensor readings, with derivatives by unknowns."""

    model_functions: ModelFunctions
    options: ProblemOptions
    unknowns: UnknownVectorLayout

    @property
    def integrator_step(self) -> Step:
        """The integrator step that simulates the episodes."""
        return self.model_functions.step

    @property
    def system(self) -> System:
        """The mechanical system whose motion is predicted."""
        return self.model_functions.step.system

    @property
    def estimated_initial_state_indices(self) -> tuple[int, ...]:
        """The indices of the estimated components of the initial state, in the order of `initial_state_names`."""
        joints, n = self.system.mechanism.joint_index, self.system.n_coordinates
        hidden, begin = list(self.system.effect_internal_coordinate_symbols), {"q": 0, "p": n, "z": 2 * n}
        split = (name.split(".", 1) for name in self.unknowns.initial_state_names)
        return tuple(begin[kind] + (hidden.index(name) if kind == "z" else joints(name)) for kind, name in split)

    def episode_with_fitted_initial_state(self, episode: Episode, theta: Array) -> Episode:
        """Return the episode; with a fitted initial state if `options.initial_state` is `fitted_to_points`."""
        if episode.fixed_initial_state is not None or self.options.initial_state != "fitted_to_points":
            return episode
        samples = episode.measurements
        if self.options.start_point_noise_std is not None:
            weight = 1.0 / self.options.start_point_noise_std
            samples = tuple(replace(s, weight=np.where(s.positive_weight_mask, weight, 0.0)) for s in samples)
        own, window = self._with(theta, episode.known_parameters), self.options.initial_state_fit_window
        start = self.model_functions.initial_state_fitter.fit_initial_state_to_points(
            episode.initial_known_coordinates, samples, own, window, episode.prescribed_path
        )
        return replace(episode, fixed_initial_state=start)

    def theta_with_episode_values(self, episode: Episode, theta: Array) -> Array:
        """Return a copy of `theta` with the values that are known for an episode or fitted with its initial state."""
        start = episode.fixed_initial_state
        return self._with(theta, {**episode.known_parameters, **({} if start is None else start.fitted_parameters)})

    def _with(self, theta: Array, values: Mapping[str, float]) -> Array:
        own = theta.copy()
        own[[self.system.parameters.index(name) for name in values]] = list(values.values())
        return own

    def initial_state_and_derivative(
        self,
        episode: Episode,
        theta: Array,
        offset: Array | float = 0.0,
        names: tuple[str, ...] | None = None,
        guess: Array | None = None,
        inputs: CorrectedInputs | None = None,
    ) -> InitialStateWithSensitivity:
        """Return the initial state of an episode and its derivatives with respect to `names` and `offset`.

        `theta` comes from `theta_with_episode_values`. `offset` is the estimated deviation from equilibrium. `names`
        are parameters (default: the free ones). `guess` (n,) is a configuration near the equilibrium (default:
        `Episode.equilibrium_guess`, else of least energy). `inputs` are the known corrected inputs.
        """
        names = self.unknowns.free_parameter_names if names is None else names
        nx, rows = self.integrator_step.sizes["nx"], list(self.estimated_initial_state_indices)
        by_offset = np.zeros((nx, len(rows)))
        by_offset[rows, np.arange(len(rows))] = 1.0
        rest: Equilibrium | None = None
        if episode.fixed_initial_state is not None:
            state, by_theta = episode.fixed_initial_state.state.copy(), np.zeros((nx, len(names)))
        else:
            inputs = inputs or self.corrected_inputs(episode, theta, names)
            first = inputs.first_torque if self.system.driven else None
            known, statics = inputs.initial_known_coordinates, self.model_functions.equilibrium_solver
            rest = statics.solve(known, theta, first, episode.equilibrium_guess if guess is None else guess, names)
            if not rest.is_converged:
                none = np.zeros((nx, len(names) + len(rows)))
                return InitialStateWithSensitivity(rest.state, none, rest, f"in '{episode.name}', {rest.message}")
            state = rest.state.copy()
            by_known = inputs.initial_known_coordinate_sensitivities(len(names))
            by_theta = rest.state_by_theta + rest.state_by_known_coordinates @ by_known
            if inputs.first_torque_sensitivity is not None:
                by_theta += rest.state_by_torque @ inputs.first_torque_sensitivity
        state[rows] += offset
        return InitialStateWithSensitivity(state, np.hstack([by_theta, by_offset]), rest, "")

    def are_input_corrections_neutral_and_fixed(self, episode: Episode, theta: Array) -> bool:
        """Return whether all effects on the episode's inputs, times and tracked reference are neutral and not free."""
        wanted = self.unknowns.free_parameter_names
        inputs = self.corrected_inputs(episode, theta, wanted)
        true = (inputs.torque, inputs.prescribed_path, inputs.driven_angles)
        recorded = (episode.torque, episode.prescribed_path, episode.measured_driven_angles)
        slopes = [inputs.torque_sensitivity, inputs.prescribed_path_sensitivity, inputs.driven_angles_sensitivity]
        if self._follows_momenta and self.model_functions.effect_momentum_calculator.changes_momentum(theta, wanted):
            return False
        slopes += self.model_functions.input_corrections.joint_delays_or_lag_times("effort_lag", theta, wanted) or ()
        for samples in episode.measurements:
            slopes += self._delay_in_steps(samples, theta, wanted) or ()
        return not any(x is not None and np.any(x) for x in slopes) and all(map(np.array_equal, true, recorded))

    @property
    def _follows_momenta(self) -> bool:
        """Whether the tracking filter of the driven joints feeds back momenta too."""
        return bool(self.system.driven) and not self.system.servos and self.options.arm_tracking_feedback == "lqr"

    def corrected_inputs_with_effect_momentum(
        self,
        episode: Episode,
        theta: Array,
        names: tuple[str, ...],
        state: Array,
        by_unknowns: Array | None = None,
        inputs: CorrectedInputs | None = None,
    ) -> CorrectedInputs:
        """Return an episode's corrected inputs, with the momentum that effects add to the tracking reference.

        `state` (nx,) is the initial state; `by_unknowns` (nx, d) is its derivative with respect to `names` and the
        state offset. `inputs` are the corrected inputs of `theta` and `names`, if known.
        """
        inputs = inputs or self.corrected_inputs(episode, theta, names)
        if not self._follows_momenta:
            return inputs
        rows = slice(2 * self.system.n_coordinates, None)
        recorded = RecordedMotionWithSensitivities(episode.smoothed_driven_angles, episode.torque, state[rows])
        by_internal = None if by_unknowns is None else by_unknowns[rows]
        shift, measured = self.model_functions.effect_momentum_calculator, episode.measured_driven_angles
        return inputs.with_effect_momentum_in_reference(shift, recorded, measured, theta, names, by_internal)

    def corrected_inputs(self, episode: Episode, theta: Array, names: tuple[str, ...]) -> CorrectedInputs:
        """Return recorded torques, angles and paths corrected for effects, with derivatives by parameters `names`."""
        corrections = self.model_functions.input_corrections
        torque, arm, path = episode.torque, episode.measured_driven_angles, episode.prescribed_path
        nu, nc, errors = torque.shape[1], path.shape[1], episode.input_errors
        first = torque[0] if nu else np.zeros(0)
        by_torque = by_first = by_arm = by_path = by_recorded = None
        late = corrections.joint_delays_or_lag_times("torque_delay", theta, names)
        if late is not None:
            joints, (delay, by_delay) = episode.recording.joints, late
            assert joints is not None
            where = (joints, self.system.driven, episode.grid, episode.name)
            torque = step_mean_inputs(*where, delay, self.system.servos)
            by_recorded = step_mean_input_delay_derivative(*where, delay, self.system.servos)[:, :, None] * by_delay
        if errors is not None:
            # otherwise effects that multiply or lag a reading would treat noise as torque and shrink to avoid it
            torque, first = torque - errors.recorded_torque_noise, first - errors.recorded_torque_noise[0]
        if nu and (late is not None or corrections.corrects_efforts):
            readings = np.pad(np.vstack([torque, first]), ((0, 0), (0, nc)))
            angles = np.zeros_like(readings)
            _, true, _, by_theta, by_reading = corrections.true_angles_and_efforts(angles, readings, theta, names)
            by_theta = by_theta[:, :nu].copy()
            if by_recorded is not None and names:
                by_theta[:-1] += by_reading[:-1, :nu, None] * by_recorded
            torque, first, by_torque, by_first = true[:-1, :nu], true[-1, :nu], by_theta[:-1], by_theta[-1]
        if (lag := corrections.joint_delays_or_lag_times("torque_lag", theta, names)) is not None:
            torque, by_torque = FirstOrderLag(*lag, self.integrator_step.time_step).lagged_step_means(torque, by_torque)
        if errors is not None:
            # what is still to be subtracted after effects on torques were applied
            left = errors.recorded_minus_true_torque - errors.transmitted_torque_noise
            torque, first = torque - left, first - left[0]
        if corrections.corrects_angles:
            angles, loads = np.hstack([arm, path]), episode.joint_loads
            true, _, by_angle, _, _ = corrections.true_angles_and_efforts(angles, loads, theta, names)
            arm, path, by_arm, by_path = true[:, :nu], true[:, nu:], by_angle[:, :nu], by_angle[:, nu:]
        return CorrectedInputs(torque, first, path, arm, by_torque, by_first, by_path, by_arm)

    def predict_episode(
        self, episode: Episode, theta: Array, offset: Array, derivatives: bool, guess: Array | None = None
    ) -> EpisodePrediction | str:
        """Simulate an episode and predict its samples. Returns an error message if the simulation fails."""
        return next(self.predict_episodes([(episode, theta, offset, guess)], derivatives))

    def predict_episodes(
        self, queries: Sequence[tuple[Episode, Array, Array, Array | None]], derivatives: bool
    ) -> Iterator[EpisodePrediction | str]:
        """Predict episodes, given as (episode, theta, offset, guess), a few at once. A failure gives a message."""

        def part(some: Sequence[tuple[Episode, Array, Array, Array | None]]) -> list[EpisodePrediction | str]:
            prepared = map_in_threads(lambda one: self._prepared(*one, derivatives), some)
            members = [p.member for p in prepared if not isinstance(p, str)]
            rollouts = iter(self.integrator_step.kernel.rollout_batch(members))
            pairs = [(p, None if isinstance(p, str) else next(rollouts)) for p in prepared]
            return map_in_threads(lambda pair: self._told(*pair), pairs)

        width = len(self.unknowns.free_parameter_names) + len(self.estimated_initial_state_indices)
        bytes_per_node = 8 * self.integrator_step.sizes["nx"] * (derivatives * width + 1)
        each = [(episode.grid.steps + 1) * bytes_per_node for episode, *_ in queries]
        done = 0
        while done < len(queries):
            held = np.cumsum(each[done:][:_MAX_PARALLEL_ROLLOUTS])
            count = max(int(np.searchsorted(held, _MAX_ROLLOUT_MEMORY, "right")), 1)
            yield from part(queries[done : done + count])
            done += count

    def _prepared(
        self, episode: Episode, theta: Array, offset: Array, guess: Array | None, derivatives: bool
    ) -> _Prepared | str:
        """Initial state and inputs of an episode's rollout, or an error message."""
        wanted = self.unknowns.free_parameter_names if derivatives else ()
        theta = self.theta_with_episode_values(episode, theta)
        inputs = self.corrected_inputs(episode, theta, wanted)
        start = self.initial_state_and_derivative(episode, theta, offset, wanted, guess, inputs)
        if start.failure_message:
            return start.failure_message
        by_start = start.state_sensitivity
        inputs = self.corrected_inputs_with_effect_momentum(episode, theta, wanted, start.state, by_start, inputs)
        feedback, driven = episode.tracking_feedback, self.system.actuated_coordinate_indices
        smoothed = None if episode.input_errors is None else episode.input_errors.smoothed_reference
        if feedback is not None and smoothed is not None:
            feedback = replace(feedback, reference=smoothed)
        directions = None
        if derivatives and by_start.shape[1]:
            width, by_path = by_start.shape[1], inputs.prescribed_path_sensitivity
            by_torque = inputs.torque_sensitivity_with_feedback_reference(feedback, driven, width)
            if by_path is not None and width > len(wanted):
                by_path = np.pad(by_path, ((0, 0), (0, 0), (0, width - len(wanted))))
            directions = SensitivityDirections(wanted, by_start, by_torque, by_path)
        feedback = inputs.tracking_feedback_with_corrected_reference(feedback, driven, episode.measured_driven_angles)
        given = (start.state, episode.grid.steps, inputs.torque, inputs.prescribed_path)
        member = checked_rollout_inputs(self.integrator_step, theta, *given, feedback, directions)
        # samples need no other derivatives, and they are large
        inputs = replace(inputs, prescribed_path_sensitivity=None, driven_angles_sensitivity=None)
        return _Prepared(episode, start, inputs, member, wanted, derivatives)

    def _told(self, prepared: _Prepared | str, rollout: Rollout | None) -> EpisodePrediction | str:
        """Prediction of the samples of one rollout, or an error message."""
        if isinstance(prepared, str) or rollout is None:
            return str(prepared)
        episode, start, inputs, wanted = prepared.episode, prepared.start, prepared.inputs, prepared.wanted
        theta, feedback, directions = prepared.member.theta, prepared.member.feedback, prepared.member.directions
        driven = self.system.actuated_coordinate_indices
        if not rollout.status.is_converged:
            return f"in '{episode.name}', {rollout.status.message}"
        by_applied = None
        if directions is not None and rollout.state_sensitivity is not None and driven:
            by_applied = np.zeros((*rollout.torque.shape, directions.count))
            if directions.torque_tangents is not None:
                by_applied += directions.torque_tangents
            if feedback is not None:
                by_applied -= feedback.gain @ rollout.state_sensitivity[:-1, feedback.state_indices]
        read = self._recorded(episode, rollout, theta, wanted)
        found = [self._predict(samples, read, by_applied, theta, wanted) for samples in episode.measurements]
        predicted, sensitivities = (tuple(own[k] for own in found) for k in range(2))
        correction = by_correction = None
        if episode.input_errors is not None and episode.input_errors.has_encoder_measurements and feedback is not None:
            correction = rollout.torque - inputs.torque
            by_correction = by_applied
            if by_applied is not None and inputs.torque_sensitivity is not None:
                by_correction = by_applied.copy()
                by_correction[:, :, : len(wanted)] -= inputs.torque_sensitivity
        # the derivatives of the states are the largest arrays, and samples no longer need them
        rollout = replace(rollout, state_sensitivity=None, multipliers_sensitivity=None, effort_sensitivity=None)
        guess = None if start.equilibrium is None else start.equilibrium.state[: self.system.n_coordinates]
        said = (rollout, start.equilibrium, predicted, sensitivities if prepared.derivatives else None)
        return EpisodePrediction(*said, guess, correction, by_correction)

    def readings_and_sensitivities(
        self, samples: SensorMeasurements, state: Array, by_state: Array, theta: Array
    ) -> tuple[Array, Array]:
        """Predict readings (M, k) and their derivatives (M, k, d) along a trajectory `state` (N + 1, nx).

        `by_state` (N + 1, nx, d) is the derivative of the trajectory; its first columns are the free parameters.
        """
        read = _Trajectory(NodeStateValues.from_trajectory(self.integrator_step, state), by_state, None, None, None)
        y, total = self._read(samples, read, theta, self.unknowns.free_parameter_names)
        return samples.interpolate_to_samples(y), samples.interpolate_to_samples(total)

    def rollout_node_values(self, rollout: Rollout) -> NodeStateValues:
        """Return the node values of a rollout for sensors. Loads: efforts of prescribed, torques of driven joints."""
        load = np.zeros((len(rollout.state), self.system.n_coordinates))
        load[:-1, list(self.system.prescribed_coordinate_indices)] = rollout.effort
        load[:-1, list(self.system.actuated_coordinate_indices)] = rollout.torque
        load[-1] = load[-2]
        lam = rollout.multipliers[np.minimum(np.arange(len(load)), len(load) - 2)] / self.integrator_step.time_step
        return NodeStateValues.from_trajectory(self.integrator_step, rollout.state, load, lam)

    def _delay_in_steps(
        self, samples: SensorMeasurements, theta: Array, wanted: tuple[str, ...]
    ) -> tuple[Array, Array] | None:
        """Delay of each output in steps (k,), and its derivative (k, d); None without delays."""
        found = self.model_functions.input_corrections.sensor_delays_with_derivatives(samples.sensor, theta, wanted)
        h = self.integrator_step.time_step
        return None if found is None else (found[0] / h, found[1] / h)

    def delay_corrected_measurements(self, samples: SensorMeasurements, theta: Array) -> SensorMeasurements:
        """Shift measurements earlier by the sensor's delay at `theta`, to the times of the true values."""
        late = self._delay_in_steps(samples, theta, ())
        return samples if late is None else samples.shifted_earlier_by_delays(late[0])

    def _recorded(self, episode: Episode, rollout: Rollout, theta: Array, wanted: tuple[str, ...]) -> Rollout:
        """The rollout with efforts of prescribed joints as sensors record them: with lag and smoothed."""
        effort, slope = rollout.effort, rollout.effort_sensitivity
        lag = self.model_functions.input_corrections.joint_delays_or_lag_times("effort_lag", theta, wanted)
        if lag is not None:
            effort, slope = self._effort_lag(episode, lag).lagged_node_values(effort, slope)
        if (smooth := self.predicted_effort_smoother(episode, theta)) is not None:
            effort, slope = smooth.smooth(effort), None if slope is None else smooth.smooth(slope)
        return replace(rollout, effort=effort, effort_sensitivity=slope)

    def _effort_lag(self, episode: Episode, lag: tuple[Array, Array]) -> FirstOrderLag:
        """The lag of the slow part of predicted efforts. A lag that amplified noise would be estimated too small."""
        h, count, cutoff = self.integrator_step.time_step, episode.grid.steps, self.options.path_cutoff
        is_filtered = math.isfinite(cutoff)
        slow = slow_effort_filter(cutoff).node_smoother(np.arange(count), count, h) if is_filtered else None
        return FirstOrderLag(*lag, h, slow)

    def predicted_effort_smoother(self, episode: Episode, theta: Array) -> NodeValueSmoother | None:
        """Make a smoother of predicted efforts that equals the filter of measured efforts. None without a filter."""
        compared = [samples for samples in episode.measurements if samples.sensor.effort_joints]
        if not math.isfinite(self.options.path_cutoff) or not compared:
            return None
        nodes = [self.delay_corrected_measurements(samples, theta).evaluation_node_indices for samples in compared]
        smooth, grid = ZeroPhaseLowPassFilter(self.options.path_cutoff), episode.grid
        return smooth.node_smoother(np.unique(np.concatenate(nodes)), grid.steps, self.integrator_step.time_step)

    def _predict(
        self,
        samples: SensorMeasurements,
        rollout: Rollout,
        by_applied: Array | None,
        theta: Array,
        wanted: tuple[str, ...],
    ) -> tuple[Array, Array]:
        unmoved, late = samples, self._delay_in_steps(samples, theta, wanted)
        if late is not None:
            samples = samples.shifted_earlier_by_delays(late[0])
        slopes_of = (rollout.state_sensitivity, rollout.effort_sensitivity, by_applied, rollout.multipliers_sensitivity)
        y, total = self._read(samples, _Trajectory(self.rollout_node_values(rollout), *slopes_of), theta, wanted)
        predicted, slopes = samples.interpolate_to_samples(y), samples.interpolate_to_samples(total)
        if late is not None and rollout.state_sensitivity is not None:
            slopes[:, :, : len(wanted)] -= samples.prediction_change_per_step(y, unmoved, late[0])[:, :, None] * late[1]
        return predicted, slopes

    def _read(
        self, samples: SensorMeasurements, along: _Trajectory, theta: Array, wanted: tuple[str, ...]
    ) -> tuple[Array, Array]:
        """Readings (nodes, k) at the samples' nodes, and their derivatives (nodes, k, d) in d directions."""
        n, nodes = self.system.n_coordinates, samples.evaluation_node_indices
        function = self.model_functions.compiled_sensor_function(samples.sensor, wanted)
        read = function(along.values.select_nodes(nodes), theta)
        if along.by_state is None:
            return read.output, np.zeros((*read.output.shape, 0))
        total = read.by_q @ along.by_state[nodes, :n]
        if read.by_z.shape[2]:
            total += read.by_z @ along.by_state[nodes, 2 * n :]
        for by_rate, rate in ((read.by_v, central_difference_velocity), (read.by_a, second_difference_acceleration)):
            if by_rate.shape[2]:
                total += by_rate @ rate(along.by_state[:, :n], nodes, self.integrator_step.time_step)
        prescribed, driven = self.system.prescribed_coordinate_indices, self.system.actuated_coordinate_indices
        for index, by_load_there in ((prescribed, along.by_effort), (driven, along.by_torque)):
            by_load = read.by_load[:, :, list(index)]
            if by_load_there is not None and np.any(by_load):
                total += by_load @ by_load_there[np.minimum(nodes, len(by_load_there) - 1)]
        if read.by_lam.shape[2]:
            if along.by_multipliers is None:
                raise sensor_not_predictable_at_nodes_error(samples.sensor.group_name)
            last = np.minimum(nodes, len(along.by_multipliers) - 1)
            total += read.by_lam @ along.by_multipliers[last] / self.integrator_step.time_step
        total[:, :, : len(wanted)] += read.by_theta
        return read.output, total

    def cost_gradient_by_adjoint(
        self, episode: Episode, result: EpisodePrediction, theta: Array, offset: Array, pulls: list[Array]
    ) -> Array:
        """Return the gradient of an episode's cost with respect to its unknowns (shared, local, initial state).

        `result` holds the predictions, `pulls` (M, k) the derivatives of the cost with respect to each prediction.
        """
        wanted, rollout = self.unknowns.free_parameter_names, result.rollout
        theta = self.theta_with_episode_values(episode, theta)
        pulled = {key: np.zeros_like(getattr(rollout, key)) for key in ("state", "effort", "torque", "multipliers")}
        total, read = np.zeros(len(wanted)), self.rollout_node_values(self._recorded(episode, rollout, theta, ()))
        for samples, pull in zip(episode.measurements, pulls, strict=True):
            total += self._pull(samples, pull, read, theta, pulled)
        by_state, by_effort, by_applied, by_multipliers = pulled.values()
        if (smooth := self.predicted_effort_smoother(episode, theta)) is not None:
            by_effort = smooth.smoothing_adjoint(by_effort)
        lag = self.model_functions.input_corrections.joint_delays_or_lag_times("effort_lag", theta, wanted)
        if lag is not None:
            by_effort, by_lag = self._effort_lag(episode, lag).lagged_node_values_adjoint(rollout.effort, by_effort)
            total += by_lag
        feedback = episode.tracking_feedback
        if feedback is not None:
            by_state[:-1, feedback.state_indices] -= np.einsum("kub,ku->kb", feedback.gain, by_applied)
        partials = (by_state, by_multipliers if np.any(by_multipliers) else None, by_effort)
        by_inputs = self.integrator_step.kernel.adjoint_gradient(theta, rollout, feedback, wanted, partials)
        inputs = self.corrected_inputs(episode, theta, wanted)
        start = self.initial_state_and_derivative(episode, theta, offset, wanted, result.equilibrium_guess, inputs)
        known = start.state, start.state_sensitivity, inputs
        inputs = self.corrected_inputs_with_effect_momentum(episode, theta, wanted, *known)
        own = np.concatenate([total + by_inputs.by_theta, np.zeros(len(self.unknowns.initial_state_names))])
        driven = self.system.actuated_coordinate_indices
        by_torque = inputs.torque_sensitivity_with_feedback_reference(feedback, driven, len(own))
        if by_torque is not None:
            own += np.einsum("ku,kuw->w", by_inputs.by_torque + by_applied, by_torque)
        if inputs.prescribed_path_sensitivity is not None:
            by_path = by_inputs.by_prescribed_path[1:]  # node 0 is part of the initial state
            own[: len(total)] += np.einsum("kc,kcw->w", by_path, inputs.prescribed_path_sensitivity[1:])
        return np.asarray(own + by_inputs.by_initial_state @ start.state_sensitivity)

    def _pull(
        self, samples: SensorMeasurements, pull: Array, values: NodeStateValues, theta: Array, pulled: dict[str, Array]
    ) -> Array:
        """Add the adjoint of one sensor's samples to `pulled`. Returns the direct derivative by the parameters."""
        n, wanted = self.system.n_coordinates, self.unknowns.free_parameter_names
        unmoved, late = samples, self._delay_in_steps(samples, theta, wanted)
        if late is not None:
            samples = samples.shifted_earlier_by_delays(late[0])
        at_nodes, nodes = samples.interpolation_adjoint(pull), samples.evaluation_node_indices
        read = self.model_functions.compiled_sensor_function(samples.sensor, wanted)(values.select_nodes(nodes), theta)
        direct = np.einsum("mk,mkq->q", at_nodes, read.by_theta)
        if late is not None:
            direct -= np.sum(pull * samples.prediction_change_per_step(read.output, unmoved, late[0]), axis=0) @ late[1]
        by_state = pulled["state"]
        by_state[nodes, :n] += np.einsum("mk,mkq->mq", at_nodes, read.by_q)
        by_state[nodes, 2 * n :] += np.einsum("mk,mkq->mq", at_nodes, read.by_z)
        last, h = np.minimum(nodes, len(by_state) - 2), self.integrator_step.time_step
        for by_rate, adjoint in (
            (read.by_v, central_difference_velocity_adjoint),
            (read.by_a, second_difference_acceleration_adjoint),
        ):
            if by_rate.shape[2]:
                by_state[:, :n] += adjoint(np.einsum("mk,mkq->mq", at_nodes, by_rate), nodes, len(by_state), h)
        if read.by_lam.shape[2]:
            np.add.at(pulled["multipliers"], last, np.einsum("mk,mkq->mq", at_nodes, read.by_lam) / h)
        prescribed, driven = self.system.prescribed_coordinate_indices, self.system.actuated_coordinate_indices
        for index, key in ((prescribed, "effort"), (driven, "torque")):
            if index:
                np.add.at(pulled[key], last, np.einsum("mk,mkq->mq", at_nodes, read.by_load[:, :, list(index)]))
        return np.asarray(direct)


@dataclass(frozen=True)
class _Trajectory:
    """Values at all nodes and derivatives of states, efforts, applied torques and multipliers."""

    values: NodeStateValues
    by_state: Array | None
    by_effort: Array | None
    by_torque: Array | None
    by_multipliers: Array | None


def episode_with_equilibrium_guess(predictor: EpisodePredictor, episode: Episode, theta: Array) -> Episode:
    """Return an episode with a guess of the equilibrium near its first points: that of least energy if it is near."""
    fitted = episode.fixed_initial_state is not None or predictor.options.initial_state == "fitted_to_points"
    early = None if fitted or not predictor.system.grasps else _until_first_points(episode)
    if early is None:
        return episode
    own, n = predictor.theta_with_episode_values(episode, theta), predictor.system.n_coordinates
    offset = np.zeros(len(predictor.unknowns.initial_state_names))
    least = predictor.initial_state_and_derivative(episode, own, offset, ()).state[:n]
    error = _first_points_error(predictor, early, theta)
    if not error > _POOR_EQUILIBRIUM_RMSE:
        return replace(episode, equilibrium_guess=least)
    elastic = [predictor.system.mechanism.joint_index(spring.joint_name) for spring in predictor.system.elastic_joints]
    shapes = [least.copy()]
    shapes[0][elastic] *= -1  # bent the other way, as a foam tube may hang on either side of its grippers
    with contextlib.suppress(DataError):
        at, fitter = episode.initial_known_coordinates, predictor.model_functions.initial_state_fitter
        seen = [s for s in early.measurements if s.node[0] * episode.grid.time_step <= _MAX_RESTING_TIME]
        seen = [replace(s, node=np.zeros(1, np.int64), fraction=np.zeros(1)) for s in seen]
        # an equilibrium near this configuration has the details
        begin = at, seen, own, _MAX_RESTING_TIME, episode.prescribed_path
        shapes.append(fitter.fit_initial_state_to_points(*begin, roughly=True).state[:n])
    others = [predictor.initial_state_and_derivative(episode, own, offset, (), shape).state[:n] for shape in shapes]
    errors = [_first_points_error(predictor, replace(early, equilibrium_guess=q), theta) for q in others]
    errors.append(_MAX_REMAINING_ERROR_FRACTION * error)
    best = int(np.argmin(errors))
    return replace(episode, equilibrium_guess=[*others, least][best]) if errors[best] < math.inf else episode


def _until_first_points(episode: Episode) -> Episode | None:
    """The episode until every point sensor has one sample, with these samples only; None without points."""
    first = []
    for samples in episode.measurements:
        rows = np.flatnonzero(samples.positive_weight_mask.any(axis=1))[:1]
        if samples.sensor.point_names and len(rows):
            parts = {name: getattr(samples, name)[rows] for name in ("node", "fraction", "value", "weight", "std")}
            change = None if samples.change_by_clock is None else samples.change_by_clock[rows]
            first.append(replace(samples, **parts, noise_correlation=None, change_by_clock=change))
    if not first:
        return None
    steps = max(int(samples.node[0]) for samples in first) + 2  # a sample may lie between two nodes
    return truncate_episode(replace(episode, measurements=tuple(first)), steps)


def _first_points_error(predictor: EpisodePredictor, early: Episode, theta: Array) -> float:
    """Root mean square error of the first points [stds], predicted from rest; infinite if that fails."""
    found = predictor.predict_episode(early, theta, np.zeros(len(predictor.unknowns.initial_state_names)), False)
    if isinstance(found, str):
        return math.inf
    pairs = zip(early.measurements, found.predicted_outputs, strict=True)
    squares = [samples.whitened_residual(read)[samples.positive_weight_mask] ** 2 for samples, read in pairs]
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def sensor_not_predictable_at_nodes_error(group: str) -> SolverError:
    """Make the `SolverError` for a sensor whose readings cannot be computed from the states at nodes."""
    what = f"multiple shooting cannot use '{group}', which is no sensor of positions"
    hint = f"set solver.name: gauss_newton, or sensors.{group}.use: false"
    allowed = "sensors of positions, such as points and encoders"
    return SolverError(what, where=f"sensors.{group}", allowed=allowed, hint=hint)

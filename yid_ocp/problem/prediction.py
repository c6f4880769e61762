"""Prediction of an episode: initial state, rollout, sensor readings and their derivatives."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.momentum import Motion
from yid_ocp.integrator.rollout import adjoint_gradient, rollout_member, simulate_all
from yid_ocp.integrator.statics import Rest
from yid_ocp.integrator.step import Directions, Rollout, Step
from yid_ocp.integrator.step_model import Member
from yid_ocp.model.system import System
from yid_ocp.parallel import map_threads
from yid_ocp.problem.constant_errors import without_constants
from yid_ocp.problem.corrections import Inputs
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.functions import ModelFunctions
from yid_ocp.problem.inputs import held_inputs, held_inputs_slope
from yid_ocp.problem.lag import Lag
from yid_ocp.problem.low_pass import LowPass, SmoothedNodes
from yid_ocp.problem.measurements import Measurements
from yid_ocp.problem.noise import Course, Innovations, InputErrors, innovations
from yid_ocp.problem.options import ProblemOptions
from yid_ocp.problem.outcome import EpisodeResult, Start
from yid_ocp.problem.unknowns import Unknowns

Array = NDArray[np.float64]
MOST_AT_ONCE, MOST_MEMORY = 16, 2.0**28
"""Largest number of episodes rolled out at once, and largest memory of their states and derivatives [bytes]."""

LEAST_GAIN = 0.1
"""Smallest ratio of acting to recorded torque at which errors of one are converted into errors of the other."""


@dataclass(frozen=True)
class _Prepared:
    """An episode whose rollout can begin."""

    episode: Episode
    start: Start
    inputs: Inputs
    member: Member
    wanted: tuple[str, ...]
    derivatives: bool


@dataclass(frozen=True)
class Predictor:
    """Predicts episodes: initial state, rollout, sensor readings and derivatives; stateless.

    Attributes
    ----------
    functions : ModelFunctions
    options : ProblemOptions
    unknowns : Unknowns
    """

    functions: ModelFunctions
    options: ProblemOptions
    unknowns: Unknowns

    @property
    def step(self) -> Step:
        """The compiled step."""
        return self.functions.step

    @property
    def system(self) -> System:
        """The step's system."""
        return self.functions.step.system

    # -- the start ----------------------------------------------------------------------------------------------------

    @property
    def start_rows(self) -> tuple[int, ...]:
        """Indices of the estimated components of the initial state, in the order of `Unknowns.start`."""
        joints, n = self.system.mechanism.joint_index, self.system.size
        hidden = list(self.system.internal)
        split = (name.split(".", 1) for name in self.unknowns.start)
        return tuple(
            2 * n + hidden.index(name) if kind == "z" else joints(name) + (n if kind == "p" else 0)
            for kind, name in split
        )

    def fitted(self, episode: Episode, theta: Array) -> Episode:
        """Episode with its initial state fitted to the first measured points, where the options ask for it."""
        if episode.start is not None or self.options.initial_state != "fitted_to_points":
            return episode
        samples = episode.samples
        if self.options.start_std is not None:
            weight = 1.0 / self.options.start_std
            samples = tuple(replace(s, weight=np.where(s.seen, weight, 0.0)) for s in samples)
        own, window = self._with(theta, episode.values), self.options.start_window
        start = self.functions.start_fit.solve(episode.posture, samples, own, window, episode.path)
        return replace(episode, start=start)

    def own_theta(self, episode: Episode, theta: Array) -> Array:
        """theta with the episode's own values: known ones, and those fitted along with its initial state."""
        fitted: Mapping[str, float] = {} if episode.start is None else episode.start.values
        return self._with(theta, {**episode.values, **fitted})

    def _with(self, theta: Array, values: Mapping[str, float]) -> Array:
        own = theta.copy()
        for name, value in values.items():
            own[self.system.parameters.index(name)] = value
        return own

    def start(
        self, episode: Episode, theta: Array, offset: Array, wanted: tuple[str, ...], guess: Array | None = None
    ) -> Start:
        """Initial state of an episode's rollout and its derivative by (wanted parameters, offset).

        Parameters
        ----------
        episode : Episode
        theta : ndarray, shape (ntheta,)
            From `own_theta`.
        offset : ndarray, shape (number of estimated rows,)
            Of an estimated initial state from equilibrium.
        wanted : tuple of str
            Parameters by which to differentiate.
        guess : ndarray, optional, shape (n,)
            Configuration near the equilibrium; `Episode.near`, else a search for least energy, when absent.
        """
        nx, rows = self.step.sizes["nx"], list(self.start_rows)
        by_offset = np.zeros((nx, len(rows)))
        by_offset[rows, np.arange(len(rows))] = 1.0
        rest: Rest | None = None
        if episode.start is not None:
            state, by_theta = episode.start.state.copy(), np.zeros((nx, len(wanted)))
        else:
            inputs = self.inputs(episode, theta, wanted)
            first = inputs.first_torque if self.system.driven else None
            near = episode.near if guess is None else guess
            rest = self.functions.rest(inputs.posture, theta, first, near, wanted)
            if not rest.converged:
                none = np.zeros((nx, len(wanted) + len(rows)))
                return Start(rest.state, none, rest, f"{episode.name}: {rest.message}")
            state = rest.state.copy()
            by_theta = rest.by_theta + rest.by_posture @ inputs.by_posture(len(wanted))
            if inputs.by_first_torque is not None:
                by_theta += rest.by_torque @ inputs.by_first_torque
        state[rows] += offset
        return Start(state, np.hstack([by_theta, by_offset]), rest, "")

    def as_recorded(self, episode: Episode, theta: Array) -> bool:
        """Whether no effect corrects the episode's inputs, times or tracked reference: none is free or non-neutral."""
        wanted = self.unknowns.parameters
        inputs = self.inputs(episode, theta, wanted)
        pairs = ((inputs.torque, episode.torque), (inputs.path, episode.path), (inputs.arm, episode.measured_arm))
        slopes = [x for x in (inputs.by_torque, inputs.by_path, inputs.by_arm) if x is not None]
        if self._follows_momenta and self.functions.momentum_shift.active(theta, wanted):
            return False
        slopes += self.functions.corrections.effort_lag(theta, wanted) or ()
        for samples in episode.samples:
            slopes += self.lateness(samples, theta, wanted) or ()
        return not any(np.any(x) for x in slopes) and all(np.array_equal(a, b) for a, b in pairs)

    @property
    def _follows_momenta(self) -> bool:
        """Whether a filter keeps the driven joints on their measured motion by their momenta too."""
        return bool(self.system.driven) and not self.system.servos and self.options.feedback == "lqr"

    # -- what drives the rollout --------------------------------------------------------------------------------------

    def tracked(
        self, episode: Episode, theta: Array, wanted: tuple[str, ...], state: Array, by_unknowns: Array | None = None
    ) -> Inputs:
        """Corrected inputs of an episode, with the momentum shift of its tracking filter's reference.

        Parameters
        ----------
        episode : Episode
        theta : ndarray, shape (ntheta,)
        wanted : tuple of str
        state : ndarray, shape (nx,)
            Initial state.
        by_unknowns : ndarray, optional, shape (nx, d)
            Derivative of the initial state by the parameters and its estimated components.
        """
        inputs = self.inputs(episode, theta, wanted)
        if not self._follows_momenta:
            return inputs
        rows = slice(2 * self.system.size, None)
        recorded = Motion(episode.smooth_arm, episode.torque, state[rows])
        by_internal = None if by_unknowns is None else by_unknowns[rows]
        return inputs.with_momenta(
            self.functions.momentum_shift, recorded, episode.measured_arm, theta, wanted, by_internal
        )

    def inputs(self, episode: Episode, theta: Array, wanted: tuple[str, ...]) -> Inputs:
        """True torques, angles and paths of an episode by the model's input effects, with derivatives by `wanted`."""
        corrections = self.functions.corrections
        torque, arm, path = episode.torque, episode.measured_arm, episode.path
        nu, nc, errors = torque.shape[1], path.shape[1], episode.errors
        first = torque[0] if nu else np.zeros(0)
        by_torque = by_first = by_arm = by_path = by_recorded = None
        if nu and corrections.delays_torque:
            joints = episode.recording.joints
            assert joints is not None
            where = (joints, self.system.driven, episode.grid, episode.name)
            delay, by_delay = corrections.torque_delay(theta, wanted)
            torque = held_inputs(*where, delay, self.system.servos)
            by_recorded = held_inputs_slope(*where, delay, self.system.servos)[:, :, None] * by_delay
        if errors is not None:
            # what multiplies or follows a reading would else take its noise for torque, and shrink to be rid of it
            torque, first = torque - errors.read, first - errors.read[0]
        if nu and (corrections.delays_torque or corrections.corrects_efforts):
            readings = np.pad(np.vstack([torque, first]), ((0, 0), (0, nc)))
            _, true, _, by_theta, by_reading = corrections.true(np.zeros_like(readings), readings, theta, wanted)
            by_theta = by_theta[:, :nu].copy()
            if by_recorded is not None and wanted:
                by_theta[:-1] += by_reading[:-1, :nu, None] * by_recorded
            torque, first, by_torque, by_first = true[:-1, :nu], true[-1, :nu], by_theta[:-1], by_theta[-1]
        lag = corrections.torque_lag(theta, wanted)
        if lag is not None:
            torque, by_torque = Lag(*lag, self.step.time_step).of_steps(torque, by_torque)
        if errors is not None:
            torque, first = torque - errors.after_effects, first - errors.after_effects[0]
        if corrections.corrects_angles:
            true, _, by_angle, _, _ = corrections.true(np.hstack([arm, path]), episode.load, theta, wanted)
            arm, path, by_arm, by_path = true[:, :nu], true[:, nu:], by_angle[:, :nu], by_angle[:, nu:]
        return Inputs(torque, first, path, arm, by_torque, by_first, by_path, by_arm)

    # -- the rollout and its readings ---------------------------------------------------------------------------------

    def run(
        self, episode: Episode, theta: Array, offset: Array, derivatives: bool, guess: Array | None = None
    ) -> EpisodeResult | str:
        """Roll out one episode and predict its samples; returns an error message where that fails."""
        return self.run_all([(episode, theta, offset, guess)], derivatives)[0]

    def run_all(
        self, asked: Sequence[tuple[Episode, Array, Array, Array | None]], derivatives: bool
    ) -> list[EpisodeResult | str]:
        """Roll out several episodes, each given as (episode, theta, offset, guess), and predict their samples."""

        def part(some: Sequence[tuple[Episode, Array, Array, Array | None]]) -> list[EpisodeResult | str]:
            prepared = map_threads(lambda one: self._prepared(*one, derivatives), some)
            rollouts = iter(simulate_all(self.step, [p.member for p in prepared if not isinstance(p, str)]))
            pairs = [(p, None if isinstance(p, str) else next(rollouts)) for p in prepared]
            return map_threads(lambda pair: self._told(*pair), pairs)

        width = len(self.unknowns.parameters) + len(self.start_rows) if derivatives else 0
        each = [8 * (episode.grid.steps + 1) * self.step.sizes["nx"] * (width + 1) for episode, *_ in asked]
        found: list[EpisodeResult | str] = []
        while len(found) < len(asked):
            held = np.cumsum(each[len(found) :][:MOST_AT_ONCE])
            count = max(int(np.searchsorted(held, MOST_MEMORY, "right")), 1)
            found += part(asked[len(found) : len(found) + count])
        return found

    def _prepared(
        self, episode: Episode, theta: Array, offset: Array, guess: Array | None, derivatives: bool
    ) -> _Prepared | str:
        """What an episode's rollout starts from and is driven by."""
        wanted = self.unknowns.parameters if derivatives else ()
        theta = self.own_theta(episode, theta)
        start = self.start(episode, theta, offset, wanted, guess)
        if start.message:
            return start.message
        by_start = start.by_unknowns
        inputs = self.tracked(episode, theta, wanted, start.state, by_start)
        feedback, driven = episode.tracking, self.system.driven_indices
        directions = None
        if derivatives and by_start.shape[1]:
            width, by_path = by_start.shape[1], inputs.by_path
            by_torque = inputs.torque_directions(feedback, driven, width)
            by_path = None if by_path is None else np.pad(by_path, ((0, 0), (0, 0), (0, width - len(wanted))))
            directions = Directions(wanted, by_start, by_torque, by_path)
        feedback = inputs.guided(feedback, driven, episode.measured_arm)
        member = rollout_member(
            self.step, theta, start.state, episode.grid.steps, inputs.torque, inputs.path, feedback, directions
        )
        return _Prepared(episode, start, inputs, member, wanted, derivatives)

    def _told(self, prepared: _Prepared | str, rollout: Rollout | None) -> EpisodeResult | str:
        """The samples of a rollout."""
        if isinstance(prepared, str) or rollout is None:
            return str(prepared)
        episode, start, inputs, wanted = prepared.episode, prepared.start, prepared.inputs, prepared.wanted
        theta, feedback, directions = prepared.member.theta, prepared.member.feedback, prepared.member.wanted
        driven = self.system.driven_indices
        if not rollout.status.ok:
            return f"{episode.name}: {rollout.status.message}"
        by_applied = None
        if directions is not None and rollout.by_state is not None and driven:
            by_applied = np.zeros((*rollout.torque.shape, directions.count))
            if directions.torque is not None:
                by_applied += directions.torque
            if feedback is not None:
                by_applied -= feedback.gain @ rollout.by_state[:-1, feedback.index]
        predicted, sensitivities, read = [], [], self._recorded(episode, rollout, theta, wanted)
        for samples in episode.samples:
            values, by_all = self._predict(samples, read, by_applied, theta, wanted)
            predicted.append(values)
            sensitivities.append(by_all)
        correction = by_correction = None
        if episode.errors is not None and episode.errors.encoders and feedback is not None:
            correction = rollout.torque - inputs.torque
            by_correction = by_applied
            if by_applied is not None and inputs.by_torque is not None:
                by_correction = by_applied.copy()
                by_correction[:, :, : len(wanted)] -= inputs.by_torque
        # states by all directions are the largest arrays of all, and what samples need of them has been taken
        rollout = replace(rollout, by_state=None, by_multipliers=None, by_effort=None)
        return EpisodeResult(
            rollout,
            start.rest,
            tuple(predicted),
            tuple(sensitivities) if prepared.derivatives else None,
            None if start.rest is None else start.rest.state[: self.system.size],
            correction,
            by_correction,
        )

    def weighted(
        self, episode: Episode, theta: Array, offset: Array, guess: Array | None, before: Innovations | None
    ) -> tuple[Episode, Innovations | None]:
        """Return the episode with its estimated input errors, and the filter that whitens its residual here.

        The filter is None without process noise, or where the rollout fails.

        Parameters
        ----------
        episode : Episode
        theta : ndarray, shape (ntheta,)
        offset : ndarray
            Of an estimated start.
        guess : ndarray, shape (n,), or None
            Configuration near the equilibrium.
        before : Innovations or None
            Filter that the episode has already; the new one is linearized about the motion that it smooths.
        """
        if episode.errors is None:
            return episode, None
        result = self.run(episode, theta, offset, False, guess)
        if before is not None and not isinstance(result, str):
            episode = self._about_smoothed(episode, theta, result, before)
            result = self.run(episode, theta, offset, False, guess)
        if isinstance(result, str) or episode.errors is None:
            return episode, None
        return episode, innovations(self.course(episode, result, theta), episode.errors)

    def _about_smoothed(self, episode: Episode, theta: Array, result: EpisodeResult, before: Innovations) -> Episode:
        """The episode about what all measurements say of its torques and, where encoders are among them, its motion."""
        errors, feedback = episode.errors, episode.feedback
        assert errors is not None
        found = before.smoothed(_plain(episode, result), result.push)
        own = self.own_theta(episode, theta)
        errors = self._behind_effects(episode, own, replace(errors, offset=found.offset, white=found.white))
        if errors.encoders and feedback is not None:
            inputs = self.tracked(episode, own, (), result.rollout.state[0])
            guided = inputs.guided(feedback, self.system.driven_indices, episode.measured_arm)
            assert guided is not None
            shift = guided.reference - feedback.reference
            true = (result.rollout.state - found.error)[:-1, feedback.index]
            errors = replace(errors, followed=true - shift)
        return replace(episode, errors=errors)

    def _behind_effects(self, episode: Episode, theta: Array, errors: InputErrors) -> InputErrors:
        """The same errors with what of the readings is noise: by which readings are multiplied, w is divided."""
        corrections, nu = self.functions.corrections, errors.white.shape[1]
        read = errors.white
        if corrections.corrects_efforts:
            readings = np.pad(episode.torque, ((0, 0), (0, episode.path.shape[1])))
            by_reading = corrections.true(np.zeros_like(readings), readings, theta, ())[4][:, :nu]
            # a reading of which hardly anything acts says nothing of what is wrong with it
            seen = np.abs(by_reading) > LEAST_GAIN
            read = np.where(seen, read, 0.0) / np.where(seen, by_reading, 1.0)
        none = replace(episode, errors=errors.as_recorded)
        without = replace(episode, errors=replace(errors.as_recorded, read=read))
        through = self.inputs(none, theta, ()).torque - self.inputs(without, theta, ()).torque
        return replace(errors, read=read, through=through)

    def torque_offset(self, episode: Episode, result: EpisodeResult, whitening: Innovations) -> Array:
        """Constant torque error of each driven joint, estimated from all measurements of an episode, (nu,) [N m]."""
        return whitening.whitened(_plain(episode, result)[:, None], result.push)[1][:, 0]

    def course(self, episode: Episode, result: EpisodeResult, theta: Array) -> Course:
        """Trajectory of an episode about which its input errors are linearized."""
        own, rollout = self.own_theta(episode, theta), result.rollout
        nx, nu = self.step.sizes["nx"], self.step.sizes["nu"]
        by_angles, by_torque = np.zeros((nx, nu)), np.zeros((nx, nu))
        if result.rest is not None:
            by_angles, by_torque = result.rest.by_posture[:, :nu], result.rest.by_torque
        return Course(
            self.functions,
            own,
            rollout,
            [self.placed(samples, own) for samples in episode.samples],
            episode.feedback,
            self.efforts(rollout),
            by_angles,
            by_torque,
        )

    def along(self, samples: Measurements, state: Array, by_state: Array, theta: Array) -> tuple[Array, Array]:
        """Sensor readings along a given trajectory and their derivatives.

        Parameters
        ----------
        samples : Measurements
        state : ndarray, shape (N + 1, nx)
        by_state : ndarray, shape (N + 1, nx, d)
            The first of the d directions are the free parameters.
        theta : ndarray, shape (ntheta,)

        Returns
        -------
        predicted : ndarray, shape (M, k)
        sensitivities : ndarray, shape (M, k, d)
        """
        effort = np.zeros((len(samples.nodes), self.system.size))
        read = _Trajectory(state, by_state, effort, None, None)
        y, total = self._read(samples, read, theta, self.unknowns.parameters)
        return samples.interpolate(y), samples.interpolate(total)

    def efforts(self, rollout: Rollout) -> Array:
        """Effort of prescribed joints and torque of driven ones along a rollout, zero elsewhere, shape (N + 1, n)."""
        steps = len(rollout.multipliers)
        effort = np.zeros((steps + 1, self.system.size))
        effort[:-1, list(self.system.prescribed_indices)] = rollout.effort
        effort[:-1, list(self.system.driven_indices)] = rollout.torque
        effort[-1] = effort[-2]
        return effort

    def lateness(self, samples: Measurements, theta: Array, wanted: tuple[str, ...]) -> tuple[Array, Array] | None:
        """Delay of each output in steps, shape (k,), and its derivative, (k, d); None without delays."""
        found = self.functions.corrections.sensor_delay(samples.sensor, theta, wanted)
        return None if found is None else (found[0] / self.step.time_step, found[1] / self.step.time_step)

    def placed(self, samples: Measurements, theta: Array) -> Measurements:
        """Measurements shifted to the times at which their readings were true."""
        late = self.lateness(samples, theta, ())
        return samples if late is None else samples.late(late[0])

    def _recorded(self, episode: Episode, rollout: Rollout, theta: Array, wanted: tuple[str, ...]) -> Rollout:
        """The rollout with efforts of prescribed joints as they are compared: as sensors follow them, and smoothed."""
        effort, slope = rollout.effort, rollout.by_effort
        if (lag := self.functions.corrections.effort_lag(theta, wanted)) is not None:
            effort, slope = Lag(*lag, self.step.time_step).of_nodes(effort, slope)
        if (smooth := self.smoothing(episode, theta)) is not None:
            effort, slope = smooth.of(effort), None if slope is None else smooth.of(slope)
        return replace(rollout, effort=effort, by_effort=slope)

    def smoothing(self, episode: Episode, theta: Array) -> SmoothedNodes | None:
        """Smoother of predicted efforts of prescribed joints, the filter of the measured ones; None if not compared."""
        compared = [samples for samples in episode.samples if samples.sensor.efforts]
        if not math.isfinite(self.options.path_cutoff) or not compared:
            return None
        nodes = np.unique(np.concatenate([self.placed(samples, theta).nodes for samples in compared]))
        return LowPass(self.options.path_cutoff).at(nodes, episode.grid.steps, self.step.time_step)

    def _predict(
        self, samples: Measurements, rollout: Rollout, by_applied: Array | None, theta: Array, wanted: tuple[str, ...]
    ) -> tuple[Array, Array]:
        unmoved, late = samples, self.lateness(samples, theta, wanted)
        if late is not None:
            samples = samples.late(late[0])
        effort = self.efforts(rollout)[samples.nodes]
        along = _Trajectory(rollout.state, rollout.by_state, effort, rollout.by_effort, by_applied)
        y, total = self._read(samples, along, theta, wanted)
        predicted, slopes = samples.interpolate(y), samples.interpolate(total)
        if late is not None and rollout.by_state is not None:
            slopes[:, :, : len(wanted)] -= samples.slope(y, unmoved, late[0])[:, :, None] * late[1]
        return predicted, slopes

    def _read(
        self, samples: Measurements, along: _Trajectory, theta: Array, wanted: tuple[str, ...]
    ) -> tuple[Array, Array]:
        """Readings at the samples' nodes, (nodes, k), and their derivatives by d directions, (nodes, k, d)."""
        n, nodes = self.system.size, samples.nodes
        q, z = along.state[nodes, :n], along.state[nodes, 2 * n :]
        y, by_q, by_z, by_load, by_theta = self.functions.sensor(samples.sensor, wanted)(q, z, along.effort, theta)
        if along.by_state is None:
            return y[:, :, 0], np.zeros((*y.shape[:2], 0))
        total = by_q @ along.by_state[nodes, :n]
        if z.shape[1]:
            total += by_z @ along.by_state[nodes, 2 * n :]
        loads = ((self.system.prescribed_indices, along.by_effort), (self.system.driven_indices, along.by_torque))
        for index, by_load_there in loads:
            if index and by_load_there is not None and np.any(by_load[:, :, list(index)]):
                total += by_load[:, :, list(index)] @ by_load_there[np.minimum(nodes, len(by_load_there) - 1)]
        total[:, :, : len(wanted)] += by_theta
        return y[:, :, 0], total

    # -- the adjoint --------------------------------------------------------------------------------------------------

    def pulled(self, episode: Episode, result: EpisodeResult, theta: Array, offset: Array, pulls: list[Array]) -> Array:
        """Gradient of a cost of an episode's predictions by its (shared, local, start) unknowns, by the adjoint.

        Parameters
        ----------
        episode : Episode
        result : EpisodeResult
            At the same unknowns.
        theta : ndarray, shape (ntheta,)
        offset : ndarray
            Of an estimated start.
        pulls : list of ndarray, shape (M, k) each
            Derivative of the cost by every prediction.
        """
        wanted, rollout = self.unknowns.parameters, result.rollout
        theta = self.own_theta(episode, theta)
        by_state = np.zeros((episode.grid.steps + 1, self.step.sizes["nx"]))
        by_effort, by_applied = np.zeros_like(rollout.effort), np.zeros_like(rollout.torque)
        total, read = np.zeros(len(wanted)), self._recorded(episode, rollout, theta, ())
        for samples, pull in zip(episode.samples, pulls, strict=True):
            total += self._pull(samples, pull, read, theta, _Pulls(by_state, by_effort, by_applied))
        if (smooth := self.smoothing(episode, theta)) is not None:
            by_effort = smooth.pulled(by_effort)
        if (lag := self.functions.corrections.effort_lag(theta, wanted)) is not None:
            by_effort, by_lag = Lag(*lag, self.step.time_step).pulled(rollout.effort, by_effort)
            total += by_lag
        feedback = episode.feedback
        if feedback is not None:
            by_state[:-1, feedback.index] -= np.einsum("kub,ku->kb", feedback.gain, by_applied)
        by_inputs = adjoint_gradient(self.step, theta, rollout, wanted, by_state, None, by_effort, feedback)
        start = self.start(episode, theta, offset, wanted, result.warm)
        inputs = self.tracked(episode, theta, wanted, start.state, start.by_unknowns)
        own = np.concatenate([total + by_inputs.by_theta, np.zeros(len(self.unknowns.start))])
        by_torque = inputs.torque_directions(feedback, self.system.driven_indices, len(own))
        if by_torque is not None:
            own += np.einsum("ku,kuw->w", by_inputs.by_torque + by_applied, by_torque)
        if inputs.by_path is not None:
            # node 0 is part of the start state
            own[: len(total)] += np.einsum("kc,kcw->w", by_inputs.by_path[1:], inputs.by_path[1:])
        return np.asarray(own + by_inputs.by_start @ start.by_unknowns)

    def _pull(self, samples: Measurements, pull: Array, rollout: Rollout, theta: Array, pulls: _Pulls) -> Array:
        """Spread the pull at one group's samples over states and efforts; the direct part by the parameters."""
        n, wanted = self.system.size, self.unknowns.parameters
        unmoved, late = samples, self.lateness(samples, theta, wanted)
        if late is not None:
            samples = samples.late(late[0])
        at_nodes, nodes = samples.distribute(pull), samples.nodes
        q, z = rollout.state[nodes, :n], rollout.state[nodes, 2 * n :]
        effort = self.efforts(rollout)[nodes]
        y, by_q, by_z, by_load, by_theta = self.functions.sensor(samples.sensor, wanted)(q, z, effort, theta)
        direct = np.einsum("mk,mkq->q", at_nodes, by_theta)
        if late is not None:
            direct -= np.sum(pull * samples.slope(y[:, :, 0], unmoved, late[0]), axis=0) @ late[1]
        pulls.by_state[nodes, :n] += np.einsum("mk,mkq->mq", at_nodes, by_q)
        pulls.by_state[nodes, 2 * n :] += np.einsum("mk,mkq->mq", at_nodes, by_z)
        last = np.minimum(nodes, len(rollout.effort) - 1)
        loads = ((self.system.prescribed_indices, pulls.by_effort), (self.system.driven_indices, pulls.by_torque))
        for index, by_load_there in loads:
            if index:
                np.add.at(by_load_there, last, np.einsum("mk,mkq->mq", at_nodes, by_load[:, :, list(index)]))
        return np.asarray(direct)


@dataclass(frozen=True)
class _Trajectory:
    """States at all nodes, efforts at the nodes that are read, and derivatives of states, efforts, applied torques."""

    state: Array
    by_state: Array | None
    effort: Array
    by_effort: Array | None
    by_torque: Array | None


@dataclass(frozen=True)
class _Pulls:
    """Derivatives of a cost by states, efforts of prescribed joints and applied torques, added up."""

    by_state: Array
    by_effort: Array
    by_torque: Array


def _plain(episode: Episode, result: EpisodeResult) -> Array:
    """Residual of an episode in units of the sensors' noise, their constant errors taken off."""
    samples = without_constants(episode.samples, result.predicted)
    return np.concatenate([s.rows(y).residual for s, y in zip(samples, result.predicted, strict=True)])

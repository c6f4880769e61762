"""The estimation problem: recordings, a step, what is free, and the residual with its derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.data.recording import Recording
from yid_ocp.errors import ConfigError, DataError, nearest
from yid_ocp.integrator.lqr import MomentumShift, lqr_filter, proportional_filter
from yid_ocp.integrator.mapped import Mapped
from yid_ocp.integrator.rollout import adjoint_gradient, simulate
from yid_ocp.integrator.statics import Rest, Statics
from yid_ocp.integrator.step import Directions, Feedback, Rollout, Step, check_shape
from yid_ocp.problem.corrections import InputCorrections, Inputs
from yid_ocp.problem.episodes import Episode as Episode
from yid_ocp.problem.episodes import apparent_inertia, beginning, prepare_episode
from yid_ocp.problem.low_pass import LowPass
from yid_ocp.problem.measurements import Measurements, huber
from yid_ocp.problem.options import ProblemOptions as ProblemOptions
from yid_ocp.problem.options import SensorOptions as SensorOptions
from yid_ocp.problem.start import FittedStart, StartFit
from yid_ocp.sensors import Sensor, sensor_function

Array = NDArray[np.float64]

HELD_OUT_START = 0.2
"""Time from which the start of a held-out recording is estimated, where starts are [s]."""
HELD_OUT_ITERATIONS = 3
"""Gauss-Newton steps of that estimate, which is nearly linear."""


@dataclass(frozen=True)
class EpisodeResult:
    """Rollout of one episode and its prediction of every sample.

    Attributes
    ----------
    rollout : Rollout
    rest : Rest or None
        The equilibrium at which it started.
    predicted : tuple of ndarray, shape (M, k) each
        Prediction of every sample, in the sensor's unit.
    sensitivities : tuple of ndarray, shape (M, k, d) each, or None
    """

    rollout: Rollout
    rest: Rest | None
    predicted: tuple[Array, ...]
    sensitivities: tuple[Array, ...] | None


@dataclass(frozen=True)
class Evaluation:
    """Residual of a problem at one point.

    Attributes
    ----------
    cost : float
        1/2 |r|^2, or the robust loss; infinite where the rollout failed.
    residual : ndarray, shape (nr,)
    jacobian : ndarray, shape (nr, nx), or None
    ok : bool
    message : str
    episodes : tuple of EpisodeResult
    """

    cost: float
    residual: Array
    jacobian: Array | None
    ok: bool
    message: str
    episodes: tuple[EpisodeResult, ...]


class EstimationProblem:
    """Find the free parameters that make the model's sensors agree with recordings.

    The unknown vector is (shared free parameters, local ones recording by recording, deviations of estimated initial
    states recording by recording).

    Parameters
    ----------
    step : Step
        Compiled step; its time step is the problem's.
    recordings : sequence of Recording
        To estimate on.
    free : sequence of str
        Names of free parameters.
    options : ProblemOptions, optional
    values : mapping of str to float, optional
        Initial values, and values of fixed parameters, where they differ from the model's.
    held_out : sequence of Recording
        Never touched by the fit; used by `validate`.

    Raises
    ------
    ConfigError
        Unknown or doubly named parameters, a value outside its bounds.
    DataError
        A recording that does not fit the model: missing joints or points, no noise level, too short.
    """

    def __init__(
        self,
        step: Step,
        recordings: Sequence[Recording],
        free: Sequence[str],
        options: ProblemOptions | None = None,
        values: Mapping[str, float] | None = None,
        held_out: Sequence[Recording] = (),
    ) -> None:
        self.step = step
        self.system = step.system
        self.options = options or ProblemOptions()
        self.free = tuple(free)
        parameters = self.system.parameters
        for name in [*self.free, *self.options.local, *self.options.priors]:
            parameters.index(name)
        if len(set(self.free)) != len(self.free):
            raise ConfigError("a free parameter is named twice", where=", ".join(self.free))
        for name in (*self.options.local, *self.options.priors):
            if name not in self.free:
                raise ConfigError(f"'{name}' is not free", hint=nearest(name, self.free), where="local or priors")
        self.theta = parameters.vector(values)
        self.shared = tuple(name for name in self.free if name not in self.options.local)
        self.local = tuple(name for name in self.free if name in self.options.local)
        self._columns = (*self.shared, *self.local)
        self._check_bounds()
        if not recordings:
            raise DataError("there is no recording to estimate on", hint="give at least one under recordings.estimate")
        self._statics: Statics | None = None
        self.readings = InputCorrections(self.system, step.compiled)
        self._functions: dict[tuple[Sensor, tuple[str, ...]], Mapped] = {}
        self.episodes = tuple(self.prepare(recording) for recording in recordings)
        self.held_out = tuple(self.prepare(recording) for recording in held_out)
        self._feedback: dict[int, Feedback | None] = {}
        self._starts: dict[int, Array] = {}
        self._fitted: dict[int, FittedStart] = {}
        self._beginnings: dict[int, Episode] = {}
        self._smoothed: dict[int, Array] = {}
        self._start_fit: StartFit | None = None

    # -- the unknown vector -------------------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all unknowns; local ones and initial states carry their recording's name."""
        names = list(self.shared)
        for episode in self.episodes:
            names += [f"{name}[{episode.name}]" for name in self.local]
            names += [f"start.{name}[{episode.name}]" for name in self._start_names]
        return tuple(names)

    @property
    def start(self) -> Array:
        """Initial guess of the unknown vector."""
        theta = self.theta
        index = self.system.parameters.index
        local = [theta[index(name)] for name in self.local] + [0.0] * self._start_size
        return np.array([theta[index(name)] for name in self.shared] + local * len(self.episodes))

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the unknown vector."""
        lower, upper = self.system.parameters.bounds(self.shared)
        low, high = self.system.parameters.bounds(self.local)
        wide = np.full(self._start_size, np.inf)
        count = len(self.episodes)
        return (
            np.concatenate([lower, *([low, -wide] * count)]),
            np.concatenate([upper, *([high, wide] * count)]),
        )

    @property
    def _start_size(self) -> int:
        return len(self._start_names)

    @property
    def _start_names(self) -> tuple[str, ...]:
        if self.options.initial_state != "estimated":
            return ()
        joints = self.system.mechanism.joint_names
        free = [joints[i] for i in self._start_rows]
        return (*(f"q.{name}" for name in free), *(f"p.{name}" for name in free))

    @property
    def _start_rows(self) -> tuple[int, ...]:
        known = set(self.system.driven_indices) | set(self.system.prescribed_indices)
        known |= {self.system.mechanism.joint_index(joint) for joint in self.system.compliant}
        return tuple(i for i in range(self.system.size) if i not in known)

    def split(self, x: ArrayLike, episode: int) -> tuple[Array, Array]:
        """theta and the start's deviation of one episode from the unknown vector."""
        x = np.asarray(x, float)
        index = self.system.parameters.index
        theta = self.theta.copy()
        for i, name in enumerate(self.shared):
            theta[index(name)] = x[i]
        at = len(self.shared) + episode * (len(self.local) + self._start_size)
        for i, name in enumerate(self.local):
            theta[index(name)] = x[at + i]
        at += len(self.local)
        return theta, x[at : at + self._start_size]

    # -- from recordings to episodes ----------------------------------------------------------------------------------

    def prepare(self, recording: Recording) -> Episode:
        """Place a recording on the nodes: torques, paths, posture, samples."""
        loads = self.readings.angles_need_effort
        return prepare_episode(self.step, recording, self.options, self.theta, loads)

    # -- evaluation ---------------------------------------------------------------------------------------------------

    def statics(self) -> Statics:
        """The equilibrium equations of the system, built once."""
        if self._statics is None:
            self._statics = Statics(self.step)
        return self._statics

    def feedback(self, episode: Episode) -> Feedback | None:
        """The tracking filter of an episode; its gains are worked out once, at the initial parameters."""
        key = id(episode)
        if key not in self._feedback:
            options, system = self.options, self.system
            result: Feedback | None = None
            if system.driven and options.feedback == "proportional":
                result = proportional_filter(self.step, episode.measured_arm, options.gains)
            elif system.driven and options.feedback == "lqr":
                theta = self._momentum_shift.without(self.theta)
                result = lqr_filter(self.step, self._smooth_arm(episode), episode.torque, theta)
            self._feedback[key] = result
        return self._feedback[key]

    def fitted_start(self, episode: Episode, theta: Array) -> FittedStart:
        """The fitted start of an episode; worked out once, at the first parameters that it is asked for with."""
        key = id(episode)
        if key not in self._fitted:
            if self._start_fit is None:
                self._start_fit = StartFit(self.step, self.options.start_parameters)
            samples: Sequence[Measurements] = episode.samples
            if self.options.start_std is not None:
                std = self.options.start_std
                samples = [replace(s, weight=np.where(s.weight > 0, 1.0 / std, 0.0)) for s in samples]
            window = self.options.start_window
            self._fitted[key] = self._start_fit.solve(episode.posture, samples, theta, window, episode.path)
        return self._fitted[key]

    def own_theta(self, episode: Episode, theta: Array) -> Array:
        """theta with the values that belong to one recording: known ones, and those fitted along with its start."""
        known = self.options.recording_values.get(episode.name, {})
        own = theta.copy()
        for name, value in known.items():
            own[self.system.parameters.index(name)] = value
        if self.options.initial_state == "fitted_to_points" and episode.name not in self.options.known_start:
            for name, value in self.fitted_start(episode, own).values.items():
                own[self.system.parameters.index(name)] = value
        return own

    def _begin(
        self, episode: Episode, theta: Array, deviation: Array, wanted: tuple[str, ...]
    ) -> tuple[Array, Array, Rest | None, str]:
        """Start state, its derivative by (wanted parameters, deviation), the equilibrium, and what went wrong."""
        nx, n = self.step.sizes["nx"], self.system.size
        rows = np.array(self._start_rows, int)
        chosen = np.concatenate([rows, n + rows]) if self._start_size else np.zeros(0, int)
        by_deviation = np.zeros((nx, len(chosen)))
        by_deviation[chosen, np.arange(len(chosen))] = 1.0
        key = id(episode)
        rest: Rest | None = None
        known = self.options.known_start.get(episode.name)
        if known is not None:
            state, by_theta = check_shape("known_start", known, (nx,)).copy(), np.zeros((nx, len(wanted)))
        elif self.options.initial_state == "fitted_to_points":
            state, by_theta = self.fitted_start(episode, theta).state.copy(), np.zeros((nx, len(wanted)))
        else:
            guess = self._starts.get(key)
            inputs = self.inputs(episode, theta, wanted)
            first = inputs.first_torque if self.system.driven else None
            rest = self.statics().solve(inputs.posture, theta, first, guess, wanted)
            if not rest.converged:
                return rest.state, np.zeros((nx, len(wanted) + len(chosen))), rest, f"{episode.name}: {rest.message}"
            self._starts[key] = rest.state[:n]
            state = rest.state.copy()
            by_theta = rest.by_theta + rest.by_posture @ inputs.by_posture(len(wanted))
            if inputs.by_first_torque is not None:
                by_theta += rest.by_torque @ inputs.by_first_torque
        state[chosen] += deviation
        return state, np.hstack([by_theta, by_deviation]), rest, ""

    @property
    def start_rows(self) -> tuple[int, ...]:
        """Rows of the initial state that are estimated: q and p of coordinates neither driven nor prescribed."""
        if not self._start_size:
            return ()
        return (*self._start_rows, *(self.system.size + row for row in self._start_rows))

    @property
    def start_deviations(self) -> Array:
        """Prior deviation of every estimated row of an initial state."""
        at = len(self.shared) + len(self.local)
        return self._prior_deviations[at : at + self._start_size]

    def start_state(self, episode: Episode, theta: Array, deviation: Array | None = None) -> tuple[Array, Array, str]:
        """Initial state of an episode, its derivative by (free parameters, deviation), and what went wrong.

        Parameters
        ----------
        episode : Episode
        theta : ndarray, shape (ntheta,)
        deviation : ndarray, optional
            Of an estimated start from rest.

        Returns
        -------
        state : ndarray, shape (nx,)
        by_unknowns : ndarray, shape (nx, number of free parameters and of estimated start rows)
        message : str
            Empty where all is well.
        """
        own = self.own_theta(episode, theta)
        none = np.zeros(self._start_size) if deviation is None else deviation
        state, by_all, _, message = self._begin(episode, own, none, self._columns)
        return state, by_all, message

    def predict_along(self, samples: Measurements, state: Array, by_state: Array, theta: Array) -> tuple[Array, Array]:
        """InputCorrections along a given trajectory and their derivatives.

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
        y, total = self._read(samples, state, by_state, effort, None, theta, self._columns)
        return samples.interpolate(y), samples.interpolate(total)

    def _read(
        self,
        samples: Measurements,
        state: Array,
        by_state: Array | None,
        effort: Array,
        by_effort: Array | None,
        theta: Array,
        wanted: tuple[str, ...],
    ) -> tuple[Array, Array]:
        """InputCorrections at the samples' nodes, (nodes, k), and their derivatives by d directions, (nodes, k, d).

        `effort` has a row for every node of the samples; `by_effort` is that of prescribed joints along the rollout.
        """
        n, nodes = self.system.size, samples.nodes
        q, z = state[nodes, :n], state[nodes, 2 * n :]
        y, by_q, by_z, by_load, by_theta = self.sensor(samples.sensor, wanted)(q, z, effort, theta)
        if by_state is None:
            return y[:, :, 0], np.zeros((*y.shape[:2], 0))
        total = by_q @ by_state[nodes, :n]
        if z.shape[1]:
            total += by_z @ by_state[nodes, 2 * n :]
        fixed = list(self.system.prescribed_indices)
        if fixed and by_effort is not None and np.any(by_load):
            total += by_load[:, :, fixed] @ by_effort[np.minimum(nodes, len(by_effort) - 1)]
        total[:, :, : len(wanted)] += by_theta
        return y[:, :, 0], total

    def sensor(self, sensor: Sensor, wanted: tuple[str, ...]) -> Mapped:
        """Compiled readings of a sensor, with derivatives by the named parameters."""
        key = (sensor, wanted)
        if key not in self._functions:
            function = sensor_function(self.system, sensor, wanted)
            self._functions[key] = Mapped(function, shared=(3,), use_compiler=self.step.compiled)
        return self._functions[key]

    def run(self, episode: Episode, theta: Array, deviation: Array, derivatives: bool) -> EpisodeResult | str:
        """Roll one episode out and predict its samples; a text says why where that is impossible."""
        wanted = self._columns if derivatives else ()
        theta = self.own_theta(episode, theta)
        state, by_start, rest, problem = self._begin(episode, theta, deviation, wanted)
        if problem:
            return problem
        inputs = self.inputs(episode, theta, wanted)
        feedback, driven = self.feedback(episode), self.system.driven_indices
        directions = None
        if derivatives and by_start.shape[1]:
            extra = ((0, 0), (0, 0), (0, by_start.shape[1] - len(wanted)))
            moved = (inputs.torque_directions(feedback, driven), inputs.by_path)
            by_torque, by_path = (None if by is None else np.pad(by, extra) for by in moved)
            directions = Directions(wanted, by_start, by_torque, by_path)
        feedback = inputs.guided(feedback, driven, episode.measured_arm)
        rollout = simulate(
            self.step, theta, state, episode.grid.steps, inputs.torque, inputs.path, feedback, directions
        )
        if not rollout.status.ok:
            return f"{episode.name}: {rollout.status.message}"
        predicted, sensitivities = [], []
        for samples in episode.samples:
            values, by_all = self._predict(samples, rollout, theta, wanted, derivatives)
            predicted.append(values)
            sensitivities.append(by_all)
        # states by all directions are the largest arrays of all, and what samples need of them has been taken
        rollout = replace(rollout, by_state=None, by_multipliers=None, by_effort=None)
        return EpisodeResult(rollout, rest, tuple(predicted), tuple(sensitivities) if derivatives else None)

    def efforts(self, rollout: Rollout) -> Array:
        """Effort of prescribed joints and torque of driven ones along a rollout, zero elsewhere, shape (N + 1, n)."""
        steps = len(rollout.multipliers)
        effort = np.zeros((steps + 1, self.system.size))
        effort[:-1, list(self.system.prescribed_indices)] = rollout.effort
        effort[:-1, list(self.system.driven_indices)] = rollout.torque
        effort[-1] = effort[-2]
        return effort

    def _predict(
        self, samples: Measurements, rollout: Rollout, theta: Array, wanted: tuple[str, ...], derivatives: bool
    ) -> tuple[Array, Array]:
        unmoved, late = samples, self.lateness(samples, theta, wanted)
        if late is not None:
            samples = samples.late(late[0])
        by_state = rollout.by_state if derivatives else None
        effort = self.efforts(rollout)[samples.nodes]
        y, total = self._read(samples, rollout.state, by_state, effort, rollout.by_effort, theta, wanted)
        predicted, slopes = samples.interpolate(y), samples.interpolate(total)
        if late is not None and by_state is not None:
            slopes[:, :, : len(wanted)] -= samples.slope(y, unmoved, late[0])[:, :, None] * late[1]
        return predicted, slopes

    def lateness(self, samples: Measurements, theta: Array, wanted: tuple[str, ...]) -> tuple[Array, Array] | None:
        """By how many steps each output is late, shape (k,), and its derivative, (k, d); None where none ever is."""
        found = self.readings.sensor_delay(samples.sensor, theta, wanted)
        return None if found is None else (found[0] / self.step.time_step, found[1] / self.step.time_step)

    @property
    def as_recorded(self) -> bool:
        """Whether no effect on recorded inputs or times is at work: none is free, and all others are neutral.

        What the tracking filter follows counts as such an input.
        """
        for episode in self.episodes:
            inputs = self.inputs(episode, self.theta, self._columns)
            pairs = ((inputs.torque, episode.torque), (inputs.path, episode.path), (inputs.arm, episode.measured_arm))
            slopes = [x for x in (inputs.by_torque, inputs.by_path, inputs.by_arm, inputs.by_momentum) if x is not None]
            if inputs.momentum is not None:
                return False
            for samples in episode.samples:
                slopes += self.lateness(samples, self.theta, self._columns) or ()
            if any(np.any(x) for x in slopes) or not all(np.array_equal(a, b) for a, b in pairs):
                return False
        return True

    def inputs(self, episode: Episode, theta: Array, wanted: tuple[str, ...]) -> Inputs:
        """What drives an episode's rollout: the recording, as far as no effect says that it reads something else.

        Parameters
        ----------
        episode : Episode
        theta : ndarray, shape (ntheta,)
        wanted : tuple of str
            Parameters by which to differentiate.
        """
        inputs = self.readings.inputs(episode, theta, wanted)
        if not self.system.driven or self.options.feedback != "lqr":
            return inputs
        shift = self._momentum_shift
        if not shift.active(theta, wanted):
            return inputs
        momentum, slope = shift.along(self._smooth_arm(episode), episode.torque, theta, wanted)
        return replace(inputs, momentum=momentum, by_momentum=slope if np.any(slope) else None)

    @cached_property
    def _momentum_shift(self) -> MomentumShift:
        return MomentumShift(self.step)

    def _smooth_arm(self, episode: Episode) -> Array:
        """Measured angles of the driven joints, smooth enough to be differenced, shape (N + 1, nu)."""
        key = id(episode)
        if key not in self._smoothed:
            self._smoothed[key] = LowPass(self.options.path_cutoff)(episode.grid.times, episode.measured_arm)
        return self._smoothed[key]

    def evaluate(self, x: ArrayLike, derivatives: bool = True) -> Evaluation:
        """Residual, cost and, where asked for, Jacobian at an unknown vector.

        Parameters
        ----------
        x : array_like, shape (nx,)
        derivatives : bool

        Returns
        -------
        Evaluation
            `ok` is False, with the reason, where an equilibrium or a rollout failed.
        """
        x = np.asarray(x, float)

        def one(i: int) -> EpisodeResult | str:
            return self.run(self.episodes[i], *self.split(x, i), derivatives)

        count = len(self.episodes)
        if count == 1:
            results = [one(0)]
        else:
            # gains and sensor functions are built once; threads must not race to build them
            for episode in self.episodes:
                self.feedback(episode)
            results = [one(0)]
            with ThreadPoolExecutor(max_workers=2) as pool:
                results += pool.map(one, range(1, count))
        failures = [result for result in results if isinstance(result, str)]
        if failures:
            return Evaluation(np.inf, np.zeros(0), None, False, failures[0], ())
        done = tuple(result for result in results if isinstance(result, EpisodeResult))
        cost, residuals, jacobians = 0.0, [], []
        for i, result in enumerate(done):
            for k, samples in enumerate(self.episodes[i].samples):
                difference = np.where(samples.weight > 0, result.predicted[k] - samples.value, 0.0)
                raw = samples.weight * difference
                part, factor = huber(raw, self.options.huber_threshold)
                cost += part
                keep = (samples.weight > 0).ravel()
                residuals.append((factor * raw).ravel()[keep])
                if derivatives and result.sensitivities is not None:
                    slope = (factor * samples.weight)[:, :, None] * result.sensitivities[k]
                    jacobians.append(self._placed(slope.reshape(-1, slope.shape[2])[keep], i, len(x)))
        done = tuple(replace(result, sensitivities=None) for result in done)
        prior_residual, prior_jacobian = self.prior(x)
        residual = np.concatenate([*residuals, prior_residual])
        cost += 0.5 * float(prior_residual @ prior_residual)
        jacobian = np.vstack([*jacobians, prior_jacobian]) if derivatives else None
        if not np.isfinite(cost):
            return Evaluation(np.inf, residual, None, False, "the cost is not finite", done)
        return Evaluation(cost, residual, jacobian, True, "", done)

    def _placed(self, block: Array, episode: int, width: int) -> Array:
        """Columns of one episode's directions moved to their places in the unknown vector."""
        wide = np.zeros((len(block), width))
        shared, own = len(self.shared), len(self.local) + self._start_size
        wide[:, :shared] = block[:, :shared]
        at = shared + episode * own
        wide[:, at : at + own] = block[:, shared:]
        return wide

    @cached_property
    def _prior_deviations(self) -> Array:
        """Deviation of every unknown's stated Gaussian prior about its start, infinite where there is none."""
        options = self.options
        deviations = []
        for name in self.names:
            base = name.split("[")[0]
            if base.startswith("start.q."):
                deviations.append(options.configuration_std)
            elif base.startswith("start.p."):
                inertia = float(apparent_inertia(self.step, self.theta, (base.removeprefix("start.p."),))[0])
                deviations.append(options.velocity_std * max(inertia, 1e-9))
            else:
                deviations.append(float(options.priors.get(base, np.inf)))
        return np.array(deviations)

    @cached_property
    def _tied(self) -> NDArray[np.int64]:
        """Unknowns under the weak prior."""
        if self.options.weighting == "paper" or self.options.weak_prior_factor <= 1:
            return np.zeros(0, int)
        return np.flatnonzero(self.positive & ~np.isfinite(self._prior_deviations))

    @property
    def positive(self) -> NDArray[np.bool_]:
        """Unknowns that are positive by nature and start above zero."""
        return (self.bounds[0] >= 0) & (self.start > 0)

    def forget_starts(self) -> None:
        """Look for the shape at rest anew instead of following the last one."""
        self._starts.clear()

    @property
    def stated_prior_rows(self) -> int:
        """Rows of initial states' and stated priors, which stand before the weak priors' at the end of the residual."""
        return int(np.isfinite(self._prior_deviations).sum())

    @property
    def weak_prior_rows(self) -> int:
        """Rows of the weak prior, the last of the residual."""
        return len(self._tied)

    @property
    def scales(self) -> Array:
        """Typical size of every unknown, for solvers: its start, its prior's deviation, or a tenth of its range."""
        lower, upper = self.bounds
        size = np.abs(self.start)
        width = np.where(np.isfinite(upper - lower), upper - lower, 10.0)
        stated = self._prior_deviations
        fallback = np.where(np.isfinite(stated), stated, 0.1 * width)
        return np.where(size > 0, size, fallback)

    @property
    def paper_noise(self) -> float:
        """Root mean square noise deviation of the measured points, which the paper's weighting does not use [m]."""
        found = [s.std[np.isfinite(s.std)] for episode in self.episodes for s in episode.samples]
        return float(np.sqrt(np.mean(np.concatenate(found) ** 2)))

    def prior(self, x: Array) -> tuple[Array, Array]:
        """Rows of the priors and of the weak prior, and their derivative by the unknowns."""
        stated, tied = np.flatnonzero(np.isfinite(self._prior_deviations)), self._tied
        rows = np.zeros((len(stated) + len(tied), len(x)))
        weight = 1.0 / self._prior_deviations[stated]
        rows[np.arange(len(stated)), stated] = weight
        start = self.start
        spread = np.log(max(self.options.weak_prior_factor, 1.0 + 1e-9))
        ratio = np.maximum(x[tied] / start[tied], 1e-9)
        rows[len(stated) + np.arange(len(tied)), tied] = 1.0 / (spread * ratio * start[tied])
        return np.concatenate([weight * (x - start)[stated], np.log(ratio) / spread]), rows

    def shortened(self, duration: float) -> EstimationProblem:
        """The same problem over the first seconds of every recording."""
        return EstimationProblem(
            self.step,
            [episode.recording for episode in self.episodes],
            self.free,
            replace(self.options, duration=duration),
            dict(zip(self.system.parameters.names, self.theta, strict=True)),
        )

    def gradient(self, x: ArrayLike, evaluation: Evaluation | None = None) -> tuple[float, Array, Evaluation]:
        """Cost and its gradient by the adjoint sweep.

        Parameters
        ----------
        x : array_like, shape (nx,)
        evaluation : Evaluation, optional
            At `x`, where it is known already: the rollout is most of the work.

        Returns
        -------
        cost : float
        gradient : ndarray, shape (nx,)
        evaluation : Evaluation
            Without a Jacobian.
        """
        x = np.asarray(x, float)
        if evaluation is None:
            evaluation = self.evaluate(x, derivatives=False)
        gradient = np.zeros(len(x))
        if not evaluation.ok:
            return evaluation.cost, gradient, evaluation
        n, nx = self.system.size, self.step.sizes["nx"]
        wanted = self._columns
        for i, result in enumerate(evaluation.episodes):
            episode = self.episodes[i]
            theta, deviation = self.split(x, i)
            theta = self.own_theta(episode, theta)
            rollout = result.rollout
            by_state, by_effort = np.zeros((episode.grid.steps + 1, nx)), np.zeros_like(rollout.effort)
            total = np.zeros(len(wanted))
            for k, samples in enumerate(episode.samples):
                raw = samples.weight * np.where(samples.weight > 0, result.predicted[k] - samples.value, 0.0)
                _, factor = huber(raw, self.options.huber_threshold)
                pull = factor**2 * raw * samples.weight
                unmoved, late = samples, self.lateness(samples, theta, wanted)
                if late is not None:
                    samples = samples.late(late[0])
                at_nodes = samples.distribute(pull)
                nodes = samples.nodes
                q, z = rollout.state[nodes, :n], rollout.state[nodes, 2 * n :]
                efforts = self.efforts(rollout)[nodes]
                y, by_q, by_z, by_e, by_theta = self.sensor(samples.sensor, wanted)(q, z, efforts, theta)
                if late is not None:
                    total -= np.sum(pull * samples.slope(y[:, :, 0], unmoved, late[0]), axis=0) @ late[1]
                by_state[nodes, :n] += np.einsum("mk,mkq->mq", at_nodes, by_q)
                by_state[nodes, 2 * n :] += np.einsum("mk,mkq->mq", at_nodes, by_z)
                total += np.einsum("mk,mkq->q", at_nodes, by_theta)
                fixed = list(self.system.prescribed_indices)
                if fixed:
                    last = np.minimum(nodes, len(rollout.effort) - 1)
                    np.add.at(by_effort, last, np.einsum("mk,mkq->mq", at_nodes, by_e[:, :, fixed]))
            feedback = self.feedback(episode)
            adjoint = adjoint_gradient(self.step, theta, rollout, wanted, by_state, None, by_effort, feedback)
            inputs = self.inputs(episode, theta, wanted)
            by_torque = inputs.torque_directions(feedback, self.system.driven_indices)
            if by_torque is not None:
                total += np.einsum("ku,kuw->w", adjoint.by_torque, by_torque)
            if inputs.by_path is not None:
                # node 0 is part of the start state
                total += np.einsum("kc,kcw->w", adjoint.by_path[1:], inputs.by_path[1:])
            _, by_start, _, _ = self._begin(episode, theta, deviation, wanted)
            own = np.concatenate([total + adjoint.by_theta, np.zeros(self._start_size)]) + adjoint.by_start @ by_start
            gradient += self._placed(own[None, :], i, len(x))[0]
        prior_residual, prior_jacobian = self.prior(x)
        return evaluation.cost, gradient + prior_jacobian.T @ prior_residual, evaluation

    # -- reports ------------------------------------------------------------------------------------------------------

    def channel_errors(
        self, results: Sequence[EpisodeResult], episodes: Sequence[Episode]
    ) -> dict[str, dict[str, Any]]:
        """Root mean square error of every channel: {channel: {rmse, unit, n}}.

        For points the error of a sample is the Euclidean distance.
        """
        squares: dict[str, list[float]] = {}
        units: dict[str, str] = {}
        for result, episode in zip(results, episodes, strict=True):
            for predicted, samples in zip(result.predicted, episode.samples, strict=True):
                width = samples.sensor.width
                difference = (predicted - samples.value).reshape(len(predicted), len(samples.sensor.channels), width)
                for c, channel in enumerate(samples.sensor.channels):
                    square = np.sum(difference[:, c] ** 2, axis=1)
                    squares.setdefault(channel, []).extend(square[np.isfinite(square)].tolist())
                    units[channel] = samples.sensor.unit
        return {
            channel: {"rmse": float(np.sqrt(np.mean(values))), "unit": units[channel], "n": len(values)}
            for channel, values in squares.items()
            if values
        }

    def validate(self, x: ArrayLike) -> list[tuple[Episode, EpisodeResult | str]]:
        """Predict the held-out recordings with the shared parameters of `x`; local ones stay at their initial value.

        An `estimated` start is found from each recording's first `HELD_OUT_START` seconds and its prior.
        """
        theta, _ = self.split(x, 0)
        for name in self.local:
            theta[self.system.parameters.index(name)] = self.theta[self.system.parameters.index(name)]
        return [
            (episode, self.run(episode, theta, self.held_out_start(i, theta, np.asarray(x, float)), derivatives=False))
            for i, episode in enumerate(self.held_out)
        ]

    def held_out_start(self, i: int, theta: Array, x: Array) -> Array:
        """Deviation of a held-out recording's start from rest, shape (number of estimated rows,)."""
        episode = self.held_out[i]
        deviation = np.zeros(self._start_size)
        if not self._start_size:
            return deviation
        key = id(episode)
        if key not in self._beginnings:
            short = beginning(episode, max(round(HELD_OUT_START / self.step.time_step), 2))
            whole = self.feedback(episode)
            steps = short.grid.steps
            self._smoothed[id(short)] = self._smooth_arm(episode)[: steps + 1]
            self._feedback[id(short)] = (
                None if whole is None else Feedback(whole.index, whole.gain[:steps], whole.reference[:steps])
            )
            self._beginnings[key] = short
        short, weight = self._beginnings[key], 1.0 / self.start_deviations
        for _ in range(HELD_OUT_ITERATIONS):
            result = self.run(short, theta, deviation, derivatives=True)
            if isinstance(result, str) or result.sensitivities is None:
                return np.zeros(self._start_size)
            rows, slopes = [weight * deviation], [np.diag(weight)]
            for k, samples in enumerate(short.samples):
                seen = samples.weight > 0
                rows.append((samples.weight * np.where(seen, result.predicted[k] - samples.value, 0.0))[seen])
                by_start = result.sensitivities[k][:, :, len(self._columns) :]
                slopes.append((samples.weight[:, :, None] * by_start)[seen])
            deviation = deviation - np.linalg.lstsq(np.vstack(slopes), np.concatenate(rows), rcond=None)[0]
        return deviation

    def with_options(self, options: ProblemOptions) -> EstimationProblem:
        """The same problem with other options; recordings, step and free parameters are shared."""
        return EstimationProblem(
            self.step,
            [episode.recording for episode in self.episodes],
            self.free,
            options,
            dict(zip(self.system.parameters.names, self.theta, strict=True)),
            [episode.recording for episode in self.held_out],
        )

    def with_free(self, free: Sequence[str], values: Mapping[str, float] | None = None) -> EstimationProblem:
        """The same problem with other free parameters; recordings, step and options are shared."""
        merged = dict(zip(self.system.parameters.names, self.theta, strict=True)) | dict(values or {})
        keep = set(free)
        options = replace(
            self.options,
            local=tuple(name for name in self.options.local if name in keep),
            priors={name: std for name, std in self.options.priors.items() if name in keep},
        )
        return EstimationProblem(
            self.step,
            [episode.recording for episode in self.episodes],
            free,
            options,
            merged,
            [episode.recording for episode in self.held_out],
        )

    def _check_bounds(self) -> None:
        for name in self.free:
            entry = self.system.parameters[name]
            value = self.theta[self.system.parameters.index(name)]
            if not entry.lower <= value <= entry.upper:
                raise ConfigError(
                    f"initial value {value:g} {entry.unit} of {name} lies outside its bounds",
                    where=f"parameters.{name}",
                    allowed=f"{entry.lower:g} to {entry.upper:g} {entry.unit}",
                )
            if not entry.lower < entry.upper:
                raise ConfigError(
                    f"the bounds of {name} leave no room",
                    where=f"parameters.{name}",
                    allowed="lower below upper",
                    hint="fix the parameter instead of closing its bounds",
                )

"""The estimation problem: a model and recordings, its unknowns, and the residual with its derivatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.data.recording import Recording
from yid_ocp.errors import DataError
from yid_ocp.integrator.step import Step
from yid_ocp.model.system import System
from yid_ocp.parallel import map_threads
from yid_ocp.problem.episodes import Episode, apparent_inertia, prepare_episode
from yid_ocp.problem.evaluation import Evaluation, ResidualRows, WarmStart, residual_rows
from yid_ocp.problem.functions import ModelFunctions
from yid_ocp.problem.held_out_start import held_out_offset
from yid_ocp.problem.measurements import Rows, huber
from yid_ocp.problem.noise import Innovations, InputErrors
from yid_ocp.problem.options import ProblemOptions
from yid_ocp.problem.outcome import EpisodeResult, Start
from yid_ocp.problem.prediction import Predictor
from yid_ocp.problem.preparation import prepared
from yid_ocp.problem.simulated import simulated
from yid_ocp.problem.torque_offsets import filters_about, with_errors
from yid_ocp.problem.unknowns import (
    Unknowns,
    check_bounds,
    check_free,
    replaced,
    soft_logarithm,
    start_limits,
    start_names,
    stated_rows,
    stated_std,
)
from yid_ocp.shown import Shown, Summary, counted

Array = NDArray[np.float64]


class EstimationProblem(Shown):
    """Estimation of free parameters from recordings: residual, cost and derivatives; immutable and thread-safe.

    Methods evaluate the cost, predict held-out recordings, derive problems with other parameters, data or options,
    whiten residuals, and pack and split the unknown vector.

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
        Not used by the fit, only predicted by `validate`.
    may_free : sequence of str, optional
        Further parameters that `freeing` may be asked for; the model's functions are differentiated by them as well.

    Attributes
    ----------
    free : tuple of str
    theta : ndarray, shape (ntheta,)
        Initial values of free parameters and values of fixed ones.
    unknowns : Unknowns
        Layout of the unknown vector.
    episodes, held_out : tuple of Episode
    rows : ResidualRows
        Layout of the residual.
    innovations : tuple of Innovations or None
        Filter that whitens each recording's residual; None where sensor noise is the only noise, see `weighted_at`.
    held_out_innovations : tuple of Innovations or None
        The same for held-out recordings, see `held_out_weighted_at`.

    Raises
    ------
    ConfigError
        Unknown or doubly named parameters, a value outside its bounds.
    DataError
        A recording that does not fit the model: missing joints or points, no noise level, too short.
    """

    functions: ModelFunctions
    options: ProblemOptions
    free: tuple[str, ...]
    theta: Array
    episodes: tuple[Episode, ...]
    held_out: tuple[Episode, ...]
    unknowns: Unknowns
    predictor: Predictor
    rows: ResidualRows
    innovations: tuple[Innovations | None, ...]
    held_out_innovations: tuple[Innovations | None, ...]

    def __init__(
        self,
        step: Step,
        recordings: Sequence[Recording],
        free: Sequence[str],
        options: ProblemOptions | None = None,
        values: Mapping[str, float] | None = None,
        held_out: Sequence[Recording] = (),
        may_free: Sequence[str] = (),
    ) -> None:
        options = options or ProblemOptions()
        check_free(step.system, free, options)
        if not recordings:
            raise DataError("there is no recording to estimate on", hint="give at least one under recordings.estimate")
        theta = step.system.parameters.vector(values)
        names = (*free, *(name for name in may_free if name not in free))
        functions = ModelFunctions(step, names, options.start_parameters)
        check_bounds(step.system, free, theta)
        episodes, others = (
            tuple(prepare_episode(functions, recording, options, theta) for recording in group)
            for group in (recordings, held_out)
        )
        self._set(functions, options, tuple(free), theta, episodes, others)
        fitted = (self.predictor.fitted(episode, theta) for episode in episodes)
        ready, other = (tuple(prepared(self.predictor, e, theta) for e in group) for group in (fitted, others))
        self._set(functions, options, tuple(free), theta, ready, other)

    def _set(
        self,
        functions: ModelFunctions,
        options: ProblemOptions,
        free: tuple[str, ...],
        theta: Array,
        episodes: tuple[Episode, ...],
        held_out: tuple[Episode, ...],
        innovations: tuple[Innovations | None, ...] = (),
        held_out_innovations: tuple[Innovations | None, ...] = (),
    ) -> None:
        theta.setflags(write=False)
        self.innovations = innovations or (None,) * len(episodes)
        self.held_out_innovations = held_out_innovations or (None,) * len(held_out)
        self.functions, self.options, self.free, self.theta = functions, options, free, theta
        self.episodes, self.held_out = episodes, held_out
        self.unknowns = Unknowns(
            tuple(name for name in free if name not in options.local),
            tuple(name for name in free if name in options.local),
            start_names(functions.step.system, options, free, theta),
            tuple(episode.name for episode in episodes),
        )
        self.predictor = Predictor(functions, options, self.unknowns)
        inertia = partial(apparent_inertia, functions.step, theta)
        self._prior_std = stated_std(self.unknowns, options, functions.step.system, inertia)
        bare = options.weighting == "paper" or options.weak_prior_factor <= 1
        weak = np.zeros(len(self.names), bool) if bare else self.positive & ~np.isfinite(self._prior_std)
        self._weak: NDArray[np.int64] = np.flatnonzero(weak)
        self._stated = stated_rows(self.unknowns, options, self._prior_std)
        self.rows = ResidualRows.of(episodes, len(self._stated), len(self._weak))

    def _changed(self, **changes: Any) -> EstimationProblem:
        """Changed problem that shares the compiled functions; episodes are not prepared again."""
        made = object.__new__(EstimationProblem)
        kept = ("functions", "options", "free", "theta", "episodes", "held_out")
        same = {name: getattr(self, name) for name in (*kept, "innovations", "held_out_innovations")}
        made._set(**{**same, **changes})
        return made

    def _summary(self) -> Summary:
        free = f"{len(self.free)} of {counted(len(self.system.parameters), 'parameter')} free"
        seen = sum(int(samples.seen.sum()) for episode in self.episodes for samples in episode.samples)
        used, held = (counted(len(entries), "recording") for entries in (self.episodes, self.held_out))
        rows: list[tuple[str, ...]] = [("unknown", "start", "lower", "upper")]
        rows += [(n, *(f"{v:.4g}" for v in own)) for n, *own in zip(self.names, self.start, *self.bounds, strict=True)]
        return Summary(f"{self.system.mechanism.name}, {free}, {seen} values of {used}, {held} held out", rows)

    # -- what it is made of -------------------------------------------------------------------------------------------

    @property
    def step(self) -> Step:
        """The compiled step."""
        return self.functions.step

    @property
    def system(self) -> System:
        """The step's system."""
        return self.functions.step.system

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all unknowns; local ones and initial states carry their recording's name."""
        return self.unknowns.names

    @property
    def shared(self) -> tuple[str, ...]:
        """Free parameters with one value for all recordings."""
        return self.unknowns.shared

    @property
    def local(self) -> tuple[str, ...]:
        """Free parameters with a value of their own in every recording."""
        return self.unknowns.local

    @property
    def start(self) -> Array:
        """Initial guess of the unknown vector, shape (nx,)."""
        index = self.system.parameters.index
        shared, local = ([self.theta[index(name)] for name in part] for part in (self.shared, self.local))
        return self.unknowns.spread(shared, local, np.zeros(len(self.unknowns.start)))

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the unknown vector."""
        shared, local = (self.system.parameters.bounds(part) for part in (self.shared, self.local))
        wide = start_limits(self.system, self.unknowns.start)
        lower, upper = (
            self.unknowns.spread(shared[side], local[side], wide * (-1 if side == 0 else 1)) for side in (0, 1)
        )
        return lower, upper

    @property
    def scales(self) -> Array:
        """Typical size of each unknown: its initial value, its prior's standard deviation, or a tenth of its range."""
        lower, upper = self.bounds
        size = np.abs(self.start)
        width = np.where(np.isfinite(upper - lower), upper - lower, 10.0)
        fallback = np.where(np.isfinite(self._prior_std), self._prior_std, 0.1 * width)
        return np.where(size > 0, size, fallback)

    @property
    def positive(self) -> NDArray[np.bool_]:
        """Mask of unknowns that must be positive and have a positive initial value, shape (nx,)."""
        return (self.bounds[0] >= 0) & (self.start > 0)

    @property
    def noise(self) -> float:
        """Noise unit of the data residuals: 1 where they are whitened, else the points' root mean square noise [m]."""
        if self.options.weighting != "paper":
            return 1.0
        found = [s.std[np.isfinite(s.std)] for episode in self.episodes for s in episode.samples]
        return float(np.sqrt(np.mean(np.concatenate(found) ** 2)))

    @property
    def start_std(self) -> Array:
        """Prior standard deviation of each estimated component of an initial state."""
        at = len(self.unknowns.parameters)
        return self._prior_std[at : at + len(self.unknowns.start)]

    @property
    def as_recorded(self) -> bool:
        """Whether no effect corrects recorded inputs, times or the tracked reference: none is free or non-neutral."""
        return all(self.predictor.as_recorded(episode, self.theta) for episode in self.episodes)

    # -- the unknown vector -------------------------------------------------------------------------------------------

    def split(self, x: ArrayLike, episode: int) -> tuple[Array, Array]:
        """Return theta and the initial state offset of one episode from the unknown vector."""
        return self.unknowns.split(x, episode, self.theta, self.system)

    def vector(self, values: Mapping[str, float]) -> Array:
        """Initial unknown vector with named entries replaced, clipped to the bounds, shape (nx,)."""
        return np.clip(replaced(self.start, self.names, values), *self.bounds)

    def named(self, x: Array) -> dict[str, float]:
        """Unknown vector as a dictionary of name to value."""
        return dict(zip(self.names, map(float, x), strict=True))

    # -- evaluation ---------------------------------------------------------------------------------------------------

    def evaluate(self, x: ArrayLike, derivatives: bool = True, warm: WarmStart | None = None) -> Evaluation:
        """Residual, cost and, where asked for, Jacobian at an unknown vector.

        Parameters
        ----------
        x : array_like, shape (nx,)
        derivatives : bool
        warm : WarmStart, optional
            `Evaluation.warm` of a nearby point; without it the equilibrium of least energy is searched, which takes
            longer.

        Returns
        -------
        Evaluation
            `ok` is False, with the reason, where an equilibrium or a rollout failed.
        """
        x = np.asarray(x, float)
        pairs = zip(self.episodes, warm or (None,) * len(self.episodes), strict=True)
        asked = [(e, *self.split(x, i), guess) for i, (e, guess) in enumerate(pairs)]
        results = self.predictor.run_all(asked, derivatives)
        failures = [result for result in results if isinstance(result, str)]
        if failures:
            return Evaluation(np.inf, np.zeros(0), None, False, failures[0], ())
        done = tuple(result for result in results if isinstance(result, EpisodeResult))
        cost, residuals, jacobians = 0.0, [], []
        for i, result in enumerate(done):
            part = residual_rows(self.episodes[i], self.innovations[i], result, self.options.huber_threshold)
            cost += part.cost
            residuals.append(part.residual)
            if part.jacobian is not None:
                jacobians.append(self.unknowns.placed(part.jacobian, i))
        done = tuple(replace(result, sensitivities=None, by_correction=None) for result in done)
        prior_residual, prior_jacobian = self.prior(x)
        residual = np.concatenate([*residuals, prior_residual])
        cost += 0.5 * float(prior_residual @ prior_residual)
        jacobian = np.vstack([*jacobians, prior_jacobian]) if derivatives else None
        if not np.isfinite(cost):
            return Evaluation(np.inf, residual, None, False, "the cost is not finite", done)
        return Evaluation(cost, residual, jacobian, True, "", done)

    def torque_offsets(self, x: ArrayLike) -> list[tuple[Array, Array] | None]:
        """Estimate each recording's constant torque errors at `x`: values and standard deviations (nu,) [N m].

        None where torques are taken as exact, or where no whitening filter is set (`weighted_at`).
        """
        x = np.asarray(x, float)
        found: list[tuple[Array, Array] | None] = []
        for i, (episode, whitening) in enumerate(zip(self.episodes, self.innovations, strict=True)):
            result = "" if whitening is None else self.predictor.run(episode, *self.split(x, i), False)
            if whitening is None or isinstance(result, str):
                found.append(None)
            else:
                found.append((self.predictor.torque_offset(episode, result, whitening), whitening.bias_std))
        return found

    def gradient(
        self, x: ArrayLike, evaluation: Evaluation | None = None, warm: WarmStart | None = None
    ) -> tuple[float, Array, Evaluation]:
        """Return the cost and its gradient by the adjoint; with process noise by forward sensitivities.

        Parameters
        ----------
        x : array_like, shape (nx,)
        evaluation : Evaluation, optional
            At `x`, where it is known already: the rollout is most of the work.
        warm : WarmStart, optional
            As in `evaluate`.

        Returns
        -------
        cost : float
        gradient : ndarray, shape (nx,)
        evaluation : Evaluation
            Without a Jacobian.
        """
        x = np.asarray(x, float)
        weighted = any(own is not None for own in self.innovations)
        weighted |= any(episode.has_constant_errors for episode in self.episodes)
        if evaluation is None or (weighted and evaluation.jacobian is None):
            evaluation = self.evaluate(x, weighted, warm)
        gradient = np.zeros(len(x))
        if not evaluation.ok:
            return evaluation.cost, gradient, evaluation
        if weighted and evaluation.jacobian is not None:
            return evaluation.cost, evaluation.jacobian.T @ evaluation.residual, replace(evaluation, jacobian=None)
        for i, result in enumerate(evaluation.episodes):
            pulls = []
            for k, samples in enumerate(self.episodes[i].samples):
                raw = samples.whitened(result.predicted[k])
                _, factor = huber(raw, self.options.huber_threshold)
                pulls.append(samples.pulled(factor**2 * raw))
            own = self.predictor.pulled(self.episodes[i], result, *self.split(x, i), pulls)
            gradient += self.unknowns.placed(own[None, :], i)[0]
        prior_residual, prior_jacobian = self.prior(x)
        return evaluation.cost, gradient + prior_jacobian.T @ prior_residual, evaluation

    def prior(self, x: Array) -> tuple[Array, Array]:
        """Return the residual of the stated and weak priors, and its Jacobian by the unknowns."""
        stated, weak, start = self._stated, self._weak, self.start
        rows = np.vstack([stated, np.zeros((len(weak), len(x)))])
        spread = np.log(max(self.options.weak_prior_factor, 1.0 + 1e-9))
        value, slope = soft_logarithm(x[weak] / start[weak])
        rows[len(stated) + np.arange(len(weak)), weak] = slope / (spread * start[weak])
        return np.concatenate([stated @ (x - start), value / spread]), rows

    def informing(self, evaluation: Evaluation) -> tuple[Array, Array]:
        """Return the noise-scaled residual (r,) and Jacobian (r, nx) of data and stated priors, without weak priors."""
        assert evaluation.jacobian is not None
        residual, jacobian = evaluation.residual[self.rows.informing], evaluation.jacobian[self.rows.informing]
        if self.noise == 1.0:
            return residual, jacobian
        unit = np.ones(len(residual))
        unit[self.rows.data] = self.noise
        return residual / unit, jacobian / unit[:, None]

    def start_state(
        self, episode: Episode, theta: Array, offset: Array | None = None, guess: Array | None = None
    ) -> Start:
        """Initial state of an episode with its derivative by (free parameters, offset).

        Parameters
        ----------
        episode : Episode
        theta : ndarray, shape (ntheta,)
        offset : ndarray, optional
            Of an estimated start from rest.
        guess : ndarray, optional, shape (n,)
            Configuration near the equilibrium.
        """
        own = self.predictor.own_theta(episode, theta)
        none = np.zeros(len(self.unknowns.start)) if offset is None else offset
        return self.predictor.start(episode, own, none, self.unknowns.parameters, guess)

    # -- held-out recordings ------------------------------------------------------------------------------------------

    def validate(self, x: ArrayLike, derivatives: bool = False) -> list[tuple[Episode, EpisodeResult | str]]:
        """Predict the held-out recordings with the shared parameters of `x`; local ones keep their initial value.

        Returns each episode, with its fitted initial state where it has one, and its prediction or an error message.
        An `estimated` initial state is found from the first `HELD_OUT_START` seconds and its prior. Derivatives are by
        (free parameters, initial state offset), the initial state held.
        """
        x = np.asarray(x, float)
        theta = self._held_out_theta(x)

        def one(held: Episode) -> tuple[Episode, EpisodeResult | str]:
            episode = self._held_out_episode(held, theta)
            return episode, self.predictor.run(episode, theta, self._held_out_offset(episode, theta, x), derivatives)

        return [one(episode) for episode in self.held_out]

    def _held_out_episode(self, held: Episode, theta: Array) -> Episode:
        if held.shares_start_of is not None:
            return replace(held, start=self.episodes[held.shares_start_of].start)
        return self.predictor.fitted(held, theta)

    def held_out_offset(self, i: int, x: ArrayLike) -> Array:
        """Offset of a held-out recording's initial state from equilibrium at `x`, shape (number of estimated rows,)."""
        x = np.asarray(x, float)
        theta = self._held_out_theta(x)
        return self._held_out_offset(self._held_out_episode(self.held_out[i], theta), theta, x)

    def _held_out_theta(self, x: Array) -> Array:
        """theta with the shared parameters of `x`, local ones at their initial value."""
        theta, _ = self.split(x, 0)
        for name in self.local:
            theta[self.system.parameters.index(name)] = self.theta[self.system.parameters.index(name)]
        return theta

    def _held_out_offset(self, episode: Episode, theta: Array, x: Array) -> Array:
        if episode.shares_start_of is not None:
            return self.split(x, episode.shares_start_of)[1]
        return held_out_offset(self.predictor, episode, theta, self.start_std)

    # -- without data -------------------------------------------------------------------------------------------------

    def simulate(
        self, values: Mapping[str, float] | None = None, recording: int = 0, seed: int | None = None
    ) -> Recording:
        """Simulate a synthetic recording with other parameters and the inputs of one of the recordings.

        Parameters
        ----------
        values : mapping of str to float, optional
            Parameters that differ from the problem's own values (`theta`), free or not, such as `{"cable.bend": 0.09}`.
        recording : int
            Which recording's start, motion or torques and times of samples are taken.
        seed : int, optional
            Of noise with the standard deviations of the sensors; none when absent.

        Raises
        ------
        ConfigError, SolverError
            There is no such parameter; the model cannot be rolled out.
        """
        return simulated(self.predictor, self.episodes[recording], self.at(values or {}).theta, seed)

    # -- problems like this one ---------------------------------------------------------------------------------------

    def freeing(self, names: Sequence[str]) -> EstimationProblem:
        """The same problem with other free parameters among `free` and `may_free`; shares the compiled functions."""
        return self._changed(free=tuple(names))

    def at(self, values: Mapping[str, float]) -> EstimationProblem:
        """The same problem with other parameter values; filters and initial states are unchanged."""
        theta = self.theta.copy()
        for name, value in values.items():
            theta[self.system.parameters.index(name)] = value
        return self._changed(theta=theta)

    def on(self, episodes: Sequence[Episode], held_out: Sequence[Episode]) -> EstimationProblem:
        """The same problem on other episodes of its model, whitened by sensor noise alone."""
        return self._changed(
            episodes=tuple(episodes), held_out=tuple(held_out), innovations=(), held_out_innovations=()
        )

    @property
    def disturbed(self) -> bool:
        """Whether errors of recorded torques or angles act as process noise in any recording."""
        return any(episode.errors is not None for episode in self.episodes)

    def weighted_at(self, x: ArrayLike, warm: WarmStart | None = None, rounds: int = 1) -> EstimationProblem:
        """The same problem with residuals whitened by sensor and process noise, linearized at `x`.

        Returns the problem itself without process noise, or where the rollout fails at `x`. Where it is whitened
        already, the new filter is linearized about the smoothed motion and torques of the old one.

        Parameters
        ----------
        x : array_like, shape (nx,)
        warm : WarmStart, optional
            As in `evaluate`.
        rounds : int
            Number of relinearizations; 2 at a fit.
        """
        x = np.asarray(x, float)
        guesses = warm or (None,) * len(self.episodes)

        def one(i: int) -> tuple[Episode, Innovations | None]:
            return self.predictor.weighted(self.episodes[i], *self.split(x, i), guesses[i], self.innovations[i])

        if not self.disturbed:
            return self
        episodes, made = zip(*map_threads(one, range(len(self.episodes))), strict=True)
        if any(m is None and e.errors is not None for m, e in zip(made, episodes, strict=True)):
            return self
        made_of = self._changed(episodes=episodes, innovations=made, held_out_innovations=())
        return made_of if rounds < 2 else made_of.weighted_at(x, warm, rounds - 1)

    def weighted_by_sensors(self) -> EstimationProblem:
        """The same problem whitened by sensor noise alone, with the torque offsets estimated so far."""
        return self._with_errors(lambda errors: errors.as_recorded)

    def without_input_errors(self) -> EstimationProblem:
        """The same problem with the recorded torques and angles taken as exact."""
        return self._with_errors(lambda errors: None)

    def _with_errors(self, changed: Callable[[InputErrors], InputErrors | None]) -> EstimationProblem:
        groups = (self.episodes, self.held_out)
        return self.on(*([replace(e, errors=e.errors and changed(e.errors)) for e in group] for group in groups))

    def held_out_weighted_at(self, x: ArrayLike) -> EstimationProblem:
        """The same problem with held-out residuals whitened by all noise at `x` as well, for `held_out_rows`.

        A recording whose rollout fails is whitened by sensor noise alone.
        """
        x, episodes, made = np.asarray(x, float), [], []
        theta = self._held_out_theta(x)
        for held in self.held_out:
            episode, whitening = self._held_out_episode(held, theta), None
            offset = self._held_out_offset(episode, theta, x)
            for _ in range(2):
                episode, whitening = self.predictor.weighted(episode, theta, offset, None, whitening)
            episodes.append(replace(held, errors=episode.errors))
            made.append(whitening)
        return self._changed(held_out=tuple(episodes), held_out_innovations=tuple(made))

    def about_torques_at(self, x: Array, frozen: Array) -> EstimationProblem:
        """The same problem, its filters relinearized from the torque offsets estimated at `frozen` to those at `x`."""
        at = [(e, *self.split(x, i), self.split(frozen, i)[0]) for i, e in enumerate(self.episodes)]
        made = filters_about(self.predictor, self.innovations, at)
        return self._changed(episodes=with_errors(self.episodes, made), innovations=made)

    def held_out_about_torques_at(self, x: Array, frozen: Array) -> EstimationProblem:
        """The same problem with held-out filters relinearized from the torque offsets at `frozen` to those at `x`."""
        theta, before = self._held_out_theta(x), self._held_out_theta(frozen)
        own = (self._held_out_episode(e, theta) for e in self.held_out)
        at = [(e, theta, self._held_out_offset(e, theta, x), before) for e in own]
        made = filters_about(self.predictor, self.held_out_innovations, at)
        return self._changed(held_out=with_errors(self.held_out, made), held_out_innovations=made)

    def held_out_rows(self, i: int, episode: Episode, result: EpisodeResult) -> Rows:
        """Whitened residual of held-out recording `i` from its prediction by `validate`, without a robust loss.
        """
        return residual_rows(episode, self.held_out_innovations[i], result, np.inf)

    def shortened(self, duration: float) -> EstimationProblem:
        """The same problem on the first `duration` seconds of each recording, rebuilt without held-out recordings."""
        return self._prepared(options=replace(self.options, duration=duration), held_out=())

    def with_options(self, options: ProblemOptions) -> EstimationProblem:
        """The same problem rebuilt with other options."""
        return self._prepared(options=options)

    def with_free(self, free: Sequence[str], values: Mapping[str, float] | None = None) -> EstimationProblem:
        """The same problem rebuilt with other free parameters and values."""
        keep = set(free)
        options = replace(
            self.options,
            local=tuple(name for name in self.options.local if name in keep),
            priors={name: std for name, std in self.options.priors.items() if name in keep},
            joint_prior=self.options.joint_prior.of(free),
        )
        nominal = dict(zip(self.system.parameters.names, self.theta, strict=True))
        return self._prepared(free=free, options=options, values=nominal | dict(values or {}))

    def _prepared(self, **changes: Any) -> EstimationProblem:
        same = {
            "step": self.step,
            "recordings": [episode.recording for episode in self.episodes],
            "free": self.free,
            "options": self.options,
            "values": dict(zip(self.system.parameters.names, self.theta, strict=True)),
            "held_out": [episode.recording for episode in self.held_out],
        }
        return EstimationProblem(**{**same, **changes})

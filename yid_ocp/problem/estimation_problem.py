"""The estimation problem of a model and recordings: unknowns, residual and derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array, BoolArray, IntArray
from yid_ocp.data.recording import Recording
from yid_ocp.display import ReprMixin, ReprTexts, count_with_noun
from yid_ocp.effects import EffectBase
from yid_ocp.errors import DataError
from yid_ocp.integrator.step import Step
from yid_ocp.problem.episode_prediction import EpisodePredictor, episode_with_equilibrium_guess
from yid_ocp.problem.episodes import (
    Episode,
    EpisodePrediction,
    InitialStateWithSensitivity,
    PredictedEpisodeOrFailure,
    mass_matrix_diagonal_at_zero,
    prepare_episode,
    truncate_episode,
)
from yid_ocp.problem.evaluation import (
    EquilibriumGuesses,
    Evaluation,
    ProcessNoiseWhitener,
    ResidualVectorLayout,
    UnknownVectorLayout,
    check_free_parameter_names,
    check_initial_values_and_bounds,
    check_no_known_value_of_free_parameters,
    check_unique_recording_names,
    estimated_initial_state_names,
    max_abs_initial_internal_state_offsets,
    soft_logarithm_and_slope,
    stated_prior_jacobian,
    stated_prior_stds_of_unknowns,
    whitened_prediction_residual,
)
from yid_ocp.problem.measurements import ResidualAndJacobian, huber_loss_and_sqrt_weights
from yid_ocp.problem.model_functions import ModelFunctions
from yid_ocp.problem.options import MultivariateGaussianPrior, ProblemOptions
from yid_ocp.problem.predictions import synthesize_recording
from yid_ocp.problem.recorded_inputs import select_path_cutoff

_HELD_OUT_START_WINDOW = 0.2
"""Duration of a sensor's first samples from which a held-out recording's initial state is estimated [s]."""
_HELD_OUT_ITERATIONS = 3  # Gauss-Newton iterations of this nearly linear estimate


class EstimationProblem(ReprMixin):
    """An immutable, thread-safe problem of estimating free parameters from recordings.

    It evaluates the cost, predicts held-out recordings, and derives problems with other parameters, data, options or
    whitening filters (made by `inference.whitening`). Raises `ConfigError` if a parameter is unknown, listed twice,
    outside its bounds, or free although a recording has a known value of it, or if two recordings have the same name,
    and `DataError` if a recording lacks joints, points or a noise level, or is too short.

    Parameters
    ----------
    step : Step
        Compiled step. It defines the time step of the problem.
    recordings : sequence of Recording
        Recordings used by the fit.
    free : sequence of str
        Names of free parameters.
    values : mapping of str to float, optional
        Initial values of free parameters and values of fixed parameters. Default: the values of the model.
    held_out : sequence of Recording
        Recordings not used by the fit, only predicted by `predict_held_out`.
    may_free : sequence of str, optional
        Further parameters that `with_free_parameters_without_recompiling` can free.

    Attributes
    ----------
    unknown_names : tuple of str
        Names of all unknowns. Local parameters and initial states include the recording's name.
    shared_parameters, local_parameters : tuple of str
        Free parameters with one value for all recordings, and with one value per recording.
    theta : ndarray, shape (ntheta,)
        Initial values of free parameters and values of fixed parameters.
    unknowns, residual_rows : UnknownVectorLayout, ResidualVectorLayout
        Layouts of the unknown vector and of the residual.
    whitening_filters, held_out_whitening_filters : tuple of ProcessNoiseWhitener or None
        Filter that whitens each recording's residual, or None if sensor noise is the only noise.
    """

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
        if not options.path_cutoff:
            options = replace(options, path_cutoff=select_path_cutoff([*recordings, *held_out], step.system.prescribed))
        check_free_parameter_names(step.system, free, options)
        if not recordings:
            what, hint = "there is no recording to estimate from", "add a recording under recordings.estimate"
            raise DataError(what, where="recordings.estimate", allowed="one recording or more", hint=hint)
        theta = step.system.parameters.vector(values)
        names = (*free, *(name for name in may_free if name not in free))
        functions = ModelFunctions(step, names, options.initial_state_fit_parameters)
        check_initial_values_and_bounds(step.system, free, theta)
        prepare = partial(prepare_episode, functions, options=options, theta=theta, free=free)
        episodes, others = (tuple(map(prepare, group)) for group in (recordings, held_out))
        self._set(functions, options, tuple(free), theta, episodes, others)
        fitted = (self.predictor.episode_with_fitted_initial_state(episode, theta) for episode in episodes)
        finish = partial(episode_with_equilibrium_guess, self.predictor, theta=theta)
        ready, other = (tuple(map(finish, group)) for group in (fitted, others))
        check_unique_recording_names([episode.name for episode in ready])
        check_no_known_value_of_free_parameters((*ready, *other), free)
        self._set(functions, options, tuple(free), theta, ready, other)

    def _set(
        self,
        model_functions: ModelFunctions,
        options: ProblemOptions,
        free: tuple[str, ...],
        theta: Array,
        episodes: tuple[Episode, ...],
        held_out: tuple[Episode, ...],
        whitening_filters: tuple[ProcessNoiseWhitener | None, ...] = (),
        held_out_whitening_filters: tuple[ProcessNoiseWhitener | None, ...] = (),
    ) -> None:
        theta.setflags(write=False)
        self.whitening_filters = whitening_filters or (None,) * len(episodes)
        self.held_out_whitening_filters = held_out_whitening_filters or (None,) * len(held_out)
        self.model_functions, self.options, self.free, self.theta = model_functions, options, free, theta
        self.episodes, self.held_out = episodes, held_out
        self.step, self.system = model_functions.step, model_functions.step.system
        self.shared_parameters = tuple(name for name in free if name not in options.local_parameters)
        self.local_parameters = tuple(name for name in free if name in options.local_parameters)
        starts, names = estimated_initial_state_names(self.system, options, free, theta), (e.name for e in episodes)
        self.unknowns = UnknownVectorLayout(self.shared_parameters, self.local_parameters, starts, tuple(names))
        self.unknown_names = self.unknowns.unknown_names
        self.predictor = EpisodePredictor(model_functions, options, self.unknowns)
        inertia = partial(mass_matrix_diagonal_at_zero, model_functions.step, theta)
        self._prior_std = stated_prior_stds_of_unknowns(self.unknowns, options, model_functions.step.system, inertia)
        has_weak_priors = options.weighting != "paper" and options.weak_prior_geometric_std > 1
        weak = self.positive_unknowns_mask & ~np.isfinite(self._prior_std) & has_weak_priors
        self._weak: IntArray = np.flatnonzero(weak)
        self._stated = stated_prior_jacobian(self.unknowns, options, self._prior_std)
        self.residual_rows = ResidualVectorLayout.from_episodes(episodes, len(self._stated), len(self._weak))

    def _changed(self, **changes: Any) -> EstimationProblem:
        """Changed copy of the problem that shares the compiled functions and the prepared episodes."""
        made = object.__new__(EstimationProblem)
        kept = ("model_functions", "options", "free", "theta", "episodes", "held_out")
        same = {name: getattr(self, name) for name in (*kept, "whitening_filters", "held_out_whitening_filters")}
        made._set(**{**same, **changes})
        return made

    def _summary(self) -> ReprTexts:
        free = f"{len(self.free)} of {count_with_noun(len(self.system.parameters), 'parameter')} free"
        seen = sum(samples.n_residuals for episode in self.episodes for samples in episode.measurements)
        used, held = (count_with_noun(len(entries), "recording") for entries in (self.episodes, self.held_out))
        rows: list[tuple[str, ...]] = [("unknown", "start", "lower", "upper")]
        table = zip(self.unknown_names, self.initial_unknowns, *self.bounds, strict=True)
        rows += [(name, *(f"{value:.4g}" for value in own)) for name, *own in table]
        return ReprTexts(f"{self.system.mechanism.name}, {free}, {seen} values of {used}, {held} held out", rows)

    @property
    def initial_unknowns(self) -> Array:
        """The initial unknown vector (nx,): initial parameter values, and zero offsets of initial states."""
        index, parts = self.system.parameters.index, (self.shared_parameters, self.local_parameters)
        shared, local = ([self.theta[index(name)] for name in part] for part in parts)
        offset = np.zeros(len(self.unknowns.initial_state_names))
        return self.unknowns.pack_same_for_all_recordings(shared, local, offset)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """The lower and upper bounds of the unknown vector, (nx,) each."""
        parts = (self.shared_parameters, self.local_parameters)
        (low, high), (own_low, own_high) = (self.system.parameters.lower_and_upper_bounds(part) for part in parts)
        wide = max_abs_initial_internal_state_offsets(self.system, self.unknowns.initial_state_names)
        pack = self.unknowns.pack_same_for_all_recordings
        return pack(low, own_low, -wide), pack(high, own_high, wide)

    @property
    def unknown_scales(self) -> Array:
        """Typical sizes (nx,) of unknowns: |initial value|; if it is 0, the prior's std; else a tenth of the range."""
        lower, upper = self.bounds
        size = np.abs(self.initial_unknowns)
        width = np.where(np.isfinite(upper - lower), upper - lower, 10.0)
        return np.where(size > 0, size, np.where(np.isfinite(self._prior_std), self._prior_std, 0.1 * width))

    @property
    def positive_unknowns_mask(self) -> BoolArray:
        """The mask (nx,) of nonnegative unknowns that start above zero, except amplitudes that may become zero.

        An amplitude may become zero unless its effect has shape parameters, which would then lose their influence.
        """
        effects = [e for e in self.system.effects if isinstance(e, EffectBase) and not e.shape_parameter_names]
        vanishing = {name for e in effects for name in e.amplitude_parameter_names if e.neutral_values[name] == 0}
        parts = (self.shared_parameters, self.local_parameters)
        shared, local = ([float(name in vanishing) for name in part] for part in parts)
        offset = np.zeros(len(self.unknowns.initial_state_names))
        may_vanish = self.unknowns.pack_same_for_all_recordings(shared, local, offset) > 0
        return (self.bounds[0] >= 0) & (self.initial_unknowns > 0) & ~may_vanish

    @property
    def stated_rms_noise_of_data_residuals(self) -> float:
        """The RMS noise of all data residuals: 1 for whitened residuals, else the noise of the points [m]."""
        if self.options.weighting != "paper":
            return 1.0
        found = [s.std[np.isfinite(s.std)] for episode in self.episodes for s in episode.measurements]
        return float(np.sqrt(np.mean(np.concatenate(found) ** 2)))

    @property
    def initial_state_prior_std(self) -> Array:
        """The prior standard deviations of estimated initial state components, ordered as `initial_state_names`."""
        at = len(self.unknowns.free_parameter_names)
        return self._prior_std[at : at + len(self.unknowns.initial_state_names)]

    @property
    def are_input_corrections_neutral_and_fixed(self) -> bool:
        """Whether all effects on recorded inputs, times and tracked references are neutral and fixed."""
        neutral_and_fixed = self.predictor.are_input_corrections_neutral_and_fixed
        return all(neutral_and_fixed(episode, self.theta) for episode in self.episodes)

    def unpack_episode_unknowns(self, x: ArrayLike, episode: int) -> tuple[Array, Array]:
        """Extract theta and the initial state offset of the episode with index `episode` from the unknown vector."""
        return self.unknowns.unpack_episode_unknowns(x, episode, self.theta, self.system)

    def unknown_vector(self, values: Mapping[str, float]) -> Array:
        """Return a copy (nx,) of the initial unknown vector with the named `values`, clipped to the bounds."""
        start = self.named_values(self.initial_unknowns)
        return np.clip([values.get(name, value) for name, value in start.items()], *self.bounds)

    def named_values(self, x: Array) -> dict[str, float]:
        """Return the values of the unknown vector `x` by unknown name."""
        return dict(zip(self.unknown_names, map(float, x), strict=True))

    def evaluate(
        self, x: ArrayLike, derivatives: bool = True, equilibrium_guesses: EquilibriumGuesses | None = None
    ) -> Evaluation:
        """Compute residual and cost at the unknown vector `x`, and the Jacobian if `derivatives` is True.

        If an equilibrium or a rollout fails, `ok` is False and `message` holds the reason. `equilibrium_guesses` from
        the evaluation at a nearby point shorten the search for the equilibrium of least energy.
        """
        x = np.asarray(x, float)
        pairs = zip(self.episodes, equilibrium_guesses or (None,) * len(self.episodes), strict=True)
        asked = [(e, *self.unpack_episode_unknowns(x, i), guess) for i, (e, guess) in enumerate(pairs)]
        results = self.predictor.predict_episodes(asked, derivatives)
        failures = [result for result in results if isinstance(result, str)]
        if failures:
            return Evaluation(np.inf, np.zeros(0), None, False, failures[0], ())
        done = tuple(result for result in results if isinstance(result, EpisodePrediction))
        cost, residuals, jacobians = 0.0, [], []
        threshold = self.options.huber_threshold
        for i, result in enumerate(done):
            part = whitened_prediction_residual(self.episodes[i], self.whitening_filters[i], result, threshold)
            cost += part.cost
            residuals.append(part.residual)
            if part.jacobian is not None:
                jacobians.append(self.unknowns.scatter_to_unknown_columns(part.jacobian, i))
        done = tuple(replace(result, output_sensitivities=None, torque_correction_sensitivity=None) for result in done)
        prior, prior_jacobian = self.prior_residual_and_jacobian(x)
        residual = np.concatenate([*residuals, prior])
        cost += 0.5 * float(prior @ prior)
        jacobian = np.vstack([*jacobians, prior_jacobian]) if derivatives else None
        if not np.isfinite(cost):
            return Evaluation(np.inf, residual, None, False, "the cost is not finite", done)
        if jacobian is not None and not np.all(np.isfinite(jacobian)):
            return Evaluation(np.inf, residual, None, False, "the derivatives are not finite", done)
        return Evaluation(cost, residual, jacobian, True, "", done)

    def cost_and_gradient(
        self, x: ArrayLike, evaluation: Evaluation | None = None, equilibrium_guesses: EquilibriumGuesses | None = None
    ) -> tuple[float, Array, Evaluation]:
        """Return the cost, its gradient (nx,) and the evaluation at `x`, without its Jacobian.

        The gradient comes from the adjoint method, or from the Jacobian if residuals are whitened by more than sensor
        noise. A known `evaluation` at `x` saves the rollout, which is most of the work.
        """
        x = np.asarray(x, float)
        weighted = any(own is not None for own in self.whitening_filters)
        weighted |= any(episode.has_biases_treated_as_noise for episode in self.episodes)
        if evaluation is None or (weighted and evaluation.jacobian is None):
            evaluation = self.evaluate(x, weighted, equilibrium_guesses)
        gradient = np.zeros(len(x))
        if not evaluation.ok:
            return evaluation.cost, gradient, evaluation
        if weighted and evaluation.jacobian is not None:
            return evaluation.cost, evaluation.jacobian.T @ evaluation.residual, replace(evaluation, jacobian=None)
        for i, result in enumerate(evaluation.episode_predictions):
            pulls = []
            for k, samples in enumerate(self.episodes[i].measurements):
                raw = samples.whitened_residual(result.predicted_outputs[k])
                _, factor = huber_loss_and_sqrt_weights(raw, self.options.huber_threshold)
                pulls.append(samples.whitened_residual_adjoint(factor**2 * raw))
            theta, offset = self.unpack_episode_unknowns(x, i)
            own = self.predictor.cost_gradient_by_adjoint(self.episodes[i], result, theta, offset, pulls)
            gradient += self.unknowns.scatter_to_unknown_columns(own[None, :], i)[0]
        prior, prior_jacobian = self.prior_residual_and_jacobian(x)
        return evaluation.cost, gradient + prior_jacobian.T @ prior, evaluation

    def prior_residual_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Return the residual of the stated and weak priors, and its Jacobian with respect to the unknowns."""
        stated, weak, start = self._stated, self._weak, self.initial_unknowns
        rows = np.vstack([stated, np.zeros((len(weak), len(x)))])
        spread = np.log(max(self.options.weak_prior_geometric_std, 1.0 + 1e-9))
        value, slope = soft_logarithm_and_slope(x[weak] / start[weak])
        rows[len(stated) + np.arange(len(weak)), weak] = slope / (spread * start[weak])
        return np.concatenate([stated @ (x - start), value / spread]), rows

    def initial_state_and_derivative(
        self, episode: Episode, theta: Array, offset: Array | None = None, guess: Array | None = None
    ) -> InitialStateWithSensitivity:
        """Return an episode's initial state and its derivatives by the free parameters and the equilibrium offset.

        `guess` (n,) is a configuration near the equilibrium.
        """
        own = self.predictor.theta_with_episode_values(episode, theta)
        none = np.zeros(len(self.unknowns.initial_state_names)) if offset is None else offset
        names = self.unknowns.free_parameter_names
        return self.predictor.initial_state_and_derivative(episode, own, none, names, guess)

    def predict_held_out(self, x: ArrayLike, derivatives: bool = False) -> list[PredictedEpisodeOrFailure]:
        """Predict the held-out recordings with the parameters of `held_out_parameter_vector`.

        Returns each episode with its prediction or an error message. An `estimated` initial state is computed from its
        prior and the first measurements. With `derivatives`, predictions hold derivatives with respect to the free
        parameters (at a fixed initial state) and to an offset of the initial state.
        """
        predict = self.predictor.predict_episode
        return [(asked[0], predict(*asked, derivatives)) for asked in self.held_out_prediction_inputs(x)]

    def held_out_prediction_inputs(self, x: ArrayLike) -> list[tuple[Episode, Array, Array]]:
        """Return the inputs of each held-out prediction: episode, parameter vector theta and initial state offset."""
        x, found = np.asarray(x, float), []
        for held in self.held_out:
            theta, shared = self.held_out_parameter_vector(x, held), held.initial_state_shared_with
            if shared is not None:
                episode = replace(held, fixed_initial_state=self.episodes[shared].fixed_initial_state)
                found.append((episode, theta, self.unpack_episode_unknowns(x, shared)[1]))
                continue
            episode = self.predictor.episode_with_fitted_initial_state(held, theta)
            std = self.initial_state_prior_std
            found.append((episode, theta, _estimated_initial_state_offset(self.predictor, episode, theta, std)))
        return found

    def held_out_parameter_vector(self, x: Array, held: Episode) -> Array:
        """Return the parameter vector theta (ntheta,) of a held-out recording, with the shared parameters in `x`.

        Local parameters have the values in `x` if `held` is part of an estimation recording, else initial values.
        """
        whole = held.initial_state_shared_with
        theta, _ = self.unpack_episode_unknowns(x, whole or 0)
        for name in self.local_parameters if whole is None else ():
            theta[self.system.parameters.index(name)] = self.theta[self.system.parameters.index(name)]
        return theta

    def simulate_synthetic_recording(
        self, values: Mapping[str, float] | None = None, recording: int = 0, seed: int | None = None
    ) -> Recording:
        """Simulate a synthetic recording with the inputs of an existing recording.

        Raises `ConfigError` if a parameter does not exist, and `SolverError` if the rollout fails.

        Parameters
        ----------
        values : mapping of str to float, optional
            Parameters that differ from `theta`, free or not, such as `{"cable.bend": 0.09}`.
        recording : int
            Index of the recording that defines initial state, motion or torques, and sample times.
        seed : int, optional
            Random seed of noise with the sensors' standard deviations. Default: no noise.
        """
        theta = self.with_parameter_values(values or {}).theta
        return synthesize_recording(self.predictor, self.episodes[recording], theta, seed)

    def with_free_parameters_without_recompiling(self, names: Sequence[str]) -> EstimationProblem:
        """Return a problem with other free parameters, from `free` and `may_free`. It shares the compiled functions."""
        return self._changed(free=tuple(names))

    def with_parameter_values(self, values: Mapping[str, float]) -> EstimationProblem:
        """Return a problem with other fixed values and other initial values of free parameters. Filters are kept."""
        theta = self.theta.copy()
        theta[[self.system.parameters.index(name) for name in values]] = list(values.values())
        return self._changed(theta=theta)

    def with_model_functions(self, functions: ModelFunctions) -> EstimationProblem:
        """Return a problem with the same episodes and other model functions, of all free and some fixed parameters."""
        index, names = self.system.parameters.index, functions.step.system.parameters.names
        return self._changed(model_functions=functions, theta=self.theta[[index(name) for name in names]])

    def with_episodes(
        self,
        episodes: Sequence[Episode],
        held_out: Sequence[Episode],
        whitening_filters: Sequence[ProcessNoiseWhitener | None] = (),
        held_out_whitening_filters: Sequence[ProcessNoiseWhitener | None] = (),
    ) -> EstimationProblem:
        """Return a problem with other episodes. Without filters, residuals are whitened by sensor noise alone."""
        filters = {"whitening_filters": whitening_filters, "held_out_whitening_filters": held_out_whitening_filters}
        changes = {"episodes": episodes, "held_out": held_out, **filters}
        return self._changed(**{name: tuple(value) for name, value in changes.items()})

    @property
    def has_process_noise(self) -> bool:
        """Whether errors of recorded torques or angles are treated as process noise in at least one recording."""
        return any(episode.input_errors is not None for episode in self.episodes)

    def whitened_held_out_residual_and_jacobian(
        self, i: int, episode: Episode, result: EpisodePrediction
    ) -> ResidualAndJacobian:
        """Return the whitened residual of held-out recording `i`, without robust loss, for its prediction `result`."""
        return whitened_prediction_residual(episode, self.held_out_whitening_filters[i], result, np.inf)

    def truncated_to_duration(self, duration: float) -> EstimationProblem:
        """Return a problem with only the first `duration` [s] of each recording, without held-out recordings."""
        return self._prepared(options=replace(self.options, duration=duration), held_out=())

    def with_time_step(self, time_step: float) -> EstimationProblem:
        """Return a problem with another time step [s], without whitening filters and held-out recordings.

        Initial states, guesses of equilibria and gear loads are copied from this problem.
        """
        functions = self.model_functions.with_time_step(time_step)

        def placed(episode: Episode) -> Episode:
            made = prepare_episode(functions, episode.recording, self.options, self.theta, self.free)
            loads, times = made.joint_loads.copy(), (made.grid.node_times, episode.grid.node_times)
            for column, known in zip(loads.T, episode.joint_loads.T, strict=True):
                column[:] = np.interp(*times, known)
            start = {name: getattr(episode, name) for name in ("fixed_initial_state", "equilibrium_guess")}
            return replace(made, joint_loads=loads, **start)

        return self._changed(model_functions=functions).with_episodes(list(map(placed, self.episodes)), ())

    def with_options(self, options: ProblemOptions) -> EstimationProblem:
        """Return a problem with other options, prepared anew from its recordings."""
        return self._prepared(options=options)

    def with_multivariate_prior(self, prior: MultivariateGaussianPrior) -> EstimationProblem:
        """Return a problem with another multivariate prior. Filters are kept."""
        return self._changed(options=replace(self.options, multivariate_prior=prior))

    def _prepared(self, **changes: Any) -> EstimationProblem:
        known = dict(zip(self.system.parameters.names, self.theta, strict=True))
        estimated, held_out = ([episode.recording for episode in group] for group in (self.episodes, self.held_out))
        same = {"recordings": estimated, "free": self.free, "options": self.options, "held_out": held_out}
        return EstimationProblem(self.step, values=known, **{**same, **changes})


def _estimated_initial_state_offset(predictor: EpisodePredictor, episode: Episode, theta: Array, std: Array) -> Array:
    """Offset of the initial state from equilibrium, estimated from the first measurements and its prior `std`."""
    offset = np.zeros(len(predictor.unknowns.initial_state_names))
    if not len(offset):
        return offset
    short = _beginning(episode, max(round(_HELD_OUT_START_WINDOW / predictor.integrator_step.time_step), 2))
    weight = 1.0 / std
    guess: Array | None = None
    limit = max_abs_initial_internal_state_offsets(predictor.system, predictor.unknowns.initial_state_names)
    for _ in range(_HELD_OUT_ITERATIONS):
        result = predictor.predict_episode(short, theta, offset, True, guess)
        if isinstance(result, str) or result.output_sensitivities is None:
            return np.zeros(len(predictor.unknowns.initial_state_names))
        guess = result.equilibrium_guess
        rows, slopes = [weight * offset], [np.diag(weight)]
        for k, samples in enumerate(short.measurements):
            by_start = result.output_sensitivities[k][:, :, len(predictor.unknowns.free_parameter_names) :]
            part = samples.residual_and_jacobian(result.predicted_outputs[k], by_start)
            rows.append(part.residual)
            slopes += [] if part.jacobian is None else [part.jacobian]
        offset = offset - np.linalg.lstsq(np.vstack(slopes), np.concatenate(rows), rcond=None)[0]
        offset = np.clip(offset, -limit, limit)
    return offset


def _beginning(episode: Episode, steps: int) -> Episode:
    """The first `steps` steps of each sensor's measurements. Filtered ones need as many nodes after as before them."""
    firsts = [int(samples.node.min(initial=episode.grid.steps)) for samples in episode.measurements]
    short, made = truncate_episode(episode, max((2 * first + steps for first in firsts), default=steps)), []
    for samples, first in zip(short.measurements, firsts, strict=True):
        is_early = samples.node.reshape(len(samples.node), -1) <= first + steps
        made.append(replace(samples, weight=np.where(is_early, samples.weight, 0.0)))
    return replace(short, measurements=tuple(made))

"""The estimation problem of a model and recordings: unknowns, residual and derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array
from yid_ocp.data.recording import Recording
from yid_ocp.display import ReprMixin, ReprTexts, abbreviated_names_text, count_with_noun
from yid_ocp.errors import ConfigError, DataError, failed_rollout_error
from yid_ocp.integrator.step import Step
from yid_ocp.model.parameters import Parameter
from yid_ocp.problem.episode_prediction import EpisodePredictor, episode_with_equilibrium_guess
from yid_ocp.problem.episodes import (
    Episode,
    EpisodeAndPredictionOrFailure,
    EpisodePrediction,
    mass_matrix_diagonal_at_zero,
    prepare_episode,
    truncate_episode,
)
from yid_ocp.problem.evaluation import (
    EquilibriumGuesses,
    Evaluation,
    PriorResiduals,
    ProcessNoiseWhitener,
    ResidualVectorLayout,
    UnknownVectorLayout,
    check_free_parameter_names,
    check_initial_values_and_bounds,
    check_no_known_value_of_free_parameters,
    check_unique_recording_names,
    episode_residual_and_jacobian,
    estimated_initial_state_names,
    initial_unknown_vector_and_bounds,
    max_abs_initial_internal_offsets,
    positive_unknowns_mask,
    stated_prior_stds_of_unknowns,
    stated_rms_noise_of_data_residuals,
)
from yid_ocp.problem.measurements import ResidualAndJacobian, huber_loss_and_sqrt_weights
from yid_ocp.problem.model_functions import ModelFunctions
from yid_ocp.problem.options import MultivariateGaussianPrior, ProblemOptions
from yid_ocp.problem.predictions import synthesize_recording
from yid_ocp.problem.recorded_inputs import select_path_cutoff

_HELD_OUT_START_WINDOW = 0.2  # of a sensor's first samples, which give a held-out recording's initial state [s]
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
    like : EstimationProblem, optional
        A problem of the same arms, at the same values. What it knows of the same recordings is not computed again.

    Attributes
    ----------
    unknown_names : tuple of str
        Names of all unknowns. Local parameters and initial states include the recording's name.
    shared_parameters, local_parameters : tuple of str
        Free parameters with one value for all recordings, and with one value per recording.
    theta : ndarray, shape (ntheta,)
        Initial values of free parameters and values of fixed parameters.
    initial_unknowns : ndarray, shape (nx,)
        Initial unknown vector: initial parameter values, and zero offsets of initial states.
    bounds : tuple of ndarray, shape (nx,)
        Lower and upper bounds of the unknown vector.
    unknown_scales : ndarray, shape (nx,)
        Typical sizes of unknowns: |initial value|; if it is 0, the prior's std; else a tenth of the range.
    positive_unknowns_mask : ndarray of bool, shape (nx,)
        Nonnegative unknowns that start above zero, except amplitudes that may become zero.
    unknowns, residual_rows : UnknownVectorLayout, ResidualVectorLayout
        Layouts of the unknown vector and of the residual.
    priors : PriorResiduals
        Priors of the unknowns.
    stated_rms_noise_of_data_residuals : float
        RMS noise of all data residuals: 1 for whitened residuals, else the noise of the points [m].
    has_process_noise : bool
        Whether errors of recorded torques or angles are treated as process noise in at least one recording.
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
        like: EstimationProblem | None = None,
    ) -> None:
        options = options or ProblemOptions()
        if not options.path_cutoff:
            options = replace(options, path_cutoff=select_path_cutoff([*recordings, *held_out], step.system.prescribed))
        check_free_parameter_names(step.system, free, options)
        if not recordings:
            what, hint = "there is no recording to estimate from", "pass recordings, or list one in recordings.estimate"
            raise DataError(what, where="recordings.estimate", allowed="one recording or more", hint=hint)
        theta = step.system.parameters.vector(values)
        names = (*free, *(name for name in may_free if name not in free))
        functions = ModelFunctions(step, names, options.initial_state_fit_parameters)
        check_initial_values_and_bounds(step.system, free, theta)
        known = {} if like is None else {own.name: own for own in (*like.episodes, *like.held_out)}
        episodes, others = (
            tuple(prepare_episode(functions, own, options, theta, free, known.get(own.name)) for own in group)
            for group in (recordings, held_out)
        )
        self._set(functions, options, tuple(free), theta, episodes, others)
        fitted = (self.predictor.episode_with_fitted_initial_state(episode, theta) for episode in episodes)

        systems = (like or self).system, self.system
        links = [[segment.link_joints for segment in system.segment_layouts] for system in systems]

        def finish(episode: Episode) -> Episode:
            own, q0 = known.get(episode.name) if links[0] == links[1] else None, episode.initial_known_coordinates
            if own is None or own.equilibrium_guess is None or not np.array_equal(own.initial_known_coordinates, q0):
                return episode_with_equilibrium_guess(self.predictor, episode, theta)
            guess = np.zeros(self.system.n_coordinates)  # joints of neutral effects are at rest
            guess[[*map(self.system.mechanism.joint_index, systems[0].mechanism.joint_names)]] = own.equilibrium_guess
            return replace(episode, equilibrium_guess=guess)

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
        start, low, high = initial_unknown_vector_and_bounds(self.unknowns, self.system, theta)
        inertia = partial(mass_matrix_diagonal_at_zero, model_functions.step, theta)
        stds = stated_prior_stds_of_unknowns(self.unknowns, options, self.system, inertia)
        range_or_prior = np.where(np.isfinite(stds), stds, 0.1 * np.where(np.isfinite(high - low), high - low, 10.0))
        self.initial_unknowns, self.bounds = start, (low, high)
        self.unknown_scales = np.where(start != 0, np.abs(start), range_or_prior)
        self.positive_unknowns_mask = positive = positive_unknowns_mask(self.unknowns, self.system, low, start)
        for constant in (start, low, high, self.unknown_scales, positive):
            constant.setflags(write=False)
        self.priors = PriorResiduals.from_options(self.unknowns, options, start, stds, positive)
        counts = len(self.priors.stated_jacobian), len(self.priors.weak)
        self.residual_rows = ResidualVectorLayout.from_episodes(episodes, *counts)
        self.stated_rms_noise_of_data_residuals = stated_rms_noise_of_data_residuals(episodes, options)
        self.has_process_noise = any(episode.input_errors is not None for episode in episodes)

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

    def unpack_episode_unknowns(self, x: ArrayLike, episode: int) -> tuple[Array, Array]:
        """Extract theta and the initial state offset of the episode with index `episode` from the unknown vector."""
        return self.unknowns.unpack_episode_unknowns(x, episode, self.theta, self.system)

    def theta_of_episode(self, x: ArrayLike, i: int) -> Array:
        """Return theta at `x` with the values that are known for episode `i` or fitted with its initial state."""
        return self.predictor.theta_with_episode_values(self.episodes[i], self.unpack_episode_unknowns(x, i)[0])

    def pack_unknowns(self, values: Mapping[str, float]) -> Array:
        """Return a copy (nx,) of the initial unknown vector with the named `values`, clipped to the bounds."""
        start = zip(self.unknown_names, self.initial_unknowns, strict=True)
        return np.clip([values.get(name, value) for name, value in start], *self.bounds)

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
        layout, threshold = self.residual_rows, self.options.huber_threshold
        prior, prior_jacobian = self.priors.residual_and_jacobian(x)
        cost, residuals, done = 0.0, list[Array](), list[EpisodePrediction]()
        jacobian = np.zeros((layout.weak_priors.stop, len(x))) if derivatives else None
        for i, result in enumerate(self.predictor.predict_episodes(asked, derivatives)):
            if isinstance(result, str):
                return Evaluation(np.inf, np.zeros(0), None, False, result, ())
            part = episode_residual_and_jacobian(self.episodes[i], self.whitening_filters[i], result, threshold)
            cost += part.cost
            residuals.append(part.residual)
            if jacobian is not None and part.jacobian is not None:
                rows, columns = layout.measurements[i], self.unknowns.unknown_indices_affecting_recording(i)
                jacobian[rows[0].start : rows[-1].stop, columns] = part.jacobian
            done.append(replace(result, output_sensitivities=None, torque_correction_sensitivity=None))  # large arrays
        residual = np.concatenate([*residuals, prior])
        cost += 0.5 * float(prior @ prior)
        if jacobian is not None:
            jacobian[layout.data.stop :] = prior_jacobian
        if not np.isfinite(cost):
            return Evaluation(np.inf, residual, None, False, "the cost is not finite", tuple(done))
        if jacobian is not None and not np.all(np.isfinite(jacobian)):
            return Evaluation(np.inf, residual, None, False, "the derivatives are not finite", tuple(done))
        return Evaluation(cost, residual, jacobian, True, "", tuple(done))

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
        prior, prior_jacobian = self.priors.residual_and_jacobian(x)
        return evaluation.cost, gradient + prior_jacobian.T @ prior, evaluation

    def predict_held_out(self, x: ArrayLike, derivatives: bool = False) -> list[EpisodeAndPredictionOrFailure]:
        """Predict every held-out recording at the unknowns `x` of a fit to the estimation recordings.

        Returns each episode with its prediction or an error message. An `estimated` initial state is computed from its
        prior and the first measurements. With `derivatives`, predictions hold derivatives with respect to the free
        parameters (at a fixed initial state) and to an offset of the initial state.
        """
        predict = self.predictor.predict_episode
        return [(asked[0], predict(*asked, derivatives)) for asked in held_out_prediction_arguments(self, x)]

    def held_out_residuals(self, predicted: Sequence[EpisodeAndPredictionOrFailure]) -> list[ResidualAndJacobian]:
        """Whiten the residual of each held-out recording, as predicted. Raises `SolverError` if a prediction failed."""
        found = []
        for (episode, result), whitening in zip(predicted, self.held_out_whitening_filters, strict=True):
            if isinstance(result, str):
                raise failed_rollout_error(result, f"held-out recording '{episode.name}'")
            found.append(episode_residual_and_jacobian(episode, whitening, result))
        return found

    def simulate_synthetic_recording(
        self, values: Mapping[str, float] | None = None, recording: int = 0, seed: int | None = None
    ) -> Recording:
        """Simulate a synthetic recording with the inputs of an existing recording.

        Raises `ConfigError` if a parameter does not exist or exceeds a bound, and `SolverError` if the rollout fails.

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
        """Return a problem with other fixed values and other initial values of free parameters. Filters are kept.

        Raises `ConfigError` for an unknown name or a value beyond its bounds.
        """
        theta = self.theta.copy()
        self.system.parameters.with_nominal_values(values)  # checks names and bounds
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

    def with_time_step(self, time_step: float) -> EstimationProblem:
        """Return a problem with another time step [s], without whitening filters and held-out recordings.

        Initial states, guesses of equilibria and gear loads are copied from this problem. A fraction of the time step
        keeps the samples of filtered signals.
        """
        functions = self.model_functions.with_time_step(time_step)
        options = replace(self.options, sampling_time_step=max(self.options.sampling_time_step, self.step.time_step))

        def placed(episode: Episode) -> Episode:
            made = prepare_episode(functions, episode.recording, options, self.theta, self.free)
            loads, times = made.joint_loads.copy(), (made.grid.node_times, episode.grid.node_times)
            for column, known in zip(loads.T, episode.joint_loads.T, strict=True):
                column[:] = np.interp(*times, known)
            start = {name: getattr(episode, name) for name in ("fixed_initial_state", "equilibrium_guess")}
            return replace(made, joint_loads=loads, **start)

        made = self._changed(model_functions=functions, options=options)
        return made.with_episodes(list(map(placed, self.episodes)), ())

    def with_equilibria_near_first_points(self, values: Mapping[str, float]) -> EstimationProblem:
        """Return a problem in which searches begin in the equilibria that first points show at these parameters."""
        x, filters = self.pack_unknowns(values), (self.whitening_filters, self.held_out_whitening_filters)
        thetas = (self.unpack_episode_unknowns(x, i)[0] for i in range(len(self.episodes)))
        episodes = map(partial(episode_with_equilibrium_guess, self.predictor), self.episodes, thetas)
        return self.with_episodes(list(episodes), self.held_out, *filters)

    def with_options(self, options: ProblemOptions) -> EstimationProblem:
        """Return a problem with other options, prepared anew from its recordings."""
        known = dict(zip(self.system.parameters.names, self.theta, strict=True))
        estimated, held_out = ([episode.recording for episode in group] for group in (self.episodes, self.held_out))
        return EstimationProblem(self.step, estimated, self.free, options, known, held_out)

    def with_replaced_multivariate_prior(self, prior: MultivariateGaussianPrior) -> EstimationProblem:
        """Return a problem with another multivariate prior. Filters are kept."""
        return self._changed(options=replace(self.options, multivariate_prior=prior))


def held_out_prediction_arguments(problem: EstimationProblem, x: ArrayLike) -> list[tuple[Episode, Array, Array]]:
    """Return the inputs of each held-out prediction: episode, parameter vector theta and initial state offset."""
    x, predictor, found = np.asarray(x, float), problem.predictor, []
    for held in problem.held_out:
        theta, shared = held_out_parameter_vector(problem, x, held), held.initial_state_shared_with
        if shared is not None:
            episode = replace(held, fixed_initial_state=problem.episodes[shared].fixed_initial_state)
            found.append((episode, theta, problem.unpack_episode_unknowns(x, shared)[1]))
            continue
        episode = predictor.episode_with_fitted_initial_state(held, theta)
        # an object that the fit made softer may rest on the other side of its grippers
        episode = episode_with_equilibrium_guess(predictor, episode, theta)
        std = problem.priors.initial_state_stds
        found.append((episode, theta, _estimated_initial_state_offset(predictor, episode, theta, std)))
    return found


def checked_unknowns(problem: EstimationProblem, values: ArrayLike, where: str) -> Array:
    """Return an unknown vector (nx,). Raises `ConfigError` for another number of values, or one beyond its bounds."""
    x, names, known = np.array(values, float).ravel(), problem.unknown_names, problem.system.parameters
    if len(x) != len(names):
        what = f"{len(x)} values are given for {len(names)} unknowns"
        hint = "pass problem.pack_unknowns({NAME: VALUE}), which adds the others"
        raise ConfigError(what, where=where, allowed=f"a value of each of {abbreviated_names_text(names)}", hint=hint)
    for name, value, lower, upper in zip(names, x.tolist(), *problem.bounds, strict=True):
        shared = name.partition("[")[0]
        try:
            Parameter(name, value, known[shared].unit if shared in known else "1", lower, upper)
        except ConfigError as error:
            error.where, error.hint = where, f"change the value of {name}, or its bounds in the configuration"
            raise
    return x


def held_out_parameter_vector(problem: EstimationProblem, x: Array, held: Episode) -> Array:
    """Return the parameter vector theta (ntheta,) of a held-out recording, with the shared parameters in `x`.

    Local parameters have the values in `x` if `held` is part of an estimation recording, else initial values.
    """
    whole, index = held.initial_state_shared_with, problem.system.parameters.index
    theta, _ = problem.unpack_episode_unknowns(x, whole or 0)
    for name in problem.local_parameters if whole is None else ():
        theta[index(name)] = problem.theta[index(name)]
    return theta


def _estimated_initial_state_offset(predictor: EpisodePredictor, episode: Episode, theta: Array, std: Array) -> Array:
    """Offset of the initial state from equilibrium, estimated from the first measurements and its prior `std`."""
    offset = np.zeros(len(predictor.unknowns.initial_state_names))
    if not len(offset):
        return offset
    short = _beginning(episode, max(round(_HELD_OUT_START_WINDOW / predictor.integrator_step.time_step), 2))
    weight = 1.0 / std
    guess: Array | None = None
    limit = max_abs_initial_internal_offsets(predictor.system, predictor.unknowns.initial_state_names)
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

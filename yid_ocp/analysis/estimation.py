"""Parameter estimation with uncertainties and checks, as the command `solve` performs it."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from yid_ocp.analysis import discretisation
from yid_ocp.analysis.clock_checks import clock_and_noise_issues_from_residuals
from yid_ocp.analysis.profile import solution_with_profile_intervals
from yid_ocp.arrays import Array
from yid_ocp.data.channel_checks import LIMIT_VIOLATION_RATIO_CAP, QUALITY_LIMITS, Issue
from yid_ocp.display import NULL_PROGRESS, Progress, count_with_noun, grouped
from yid_ocp.errors import ConfigError
from yid_ocp.files import attributes_to_dict
from yid_ocp.inference import uncertainty
from yid_ocp.inference.linearized_residual import size_limited_damped_step
from yid_ocp.inference.null_test import (
    encoders_move_object,
    episode_with_noisier_motion,
    unknowns_without_encoder_noise_bias,
)
from yid_ocp.model.objects.base import CableVertices
from yid_ocp.model.objects.cable import INITIAL_RMS_SPEED_PARAMETER, SHAPE_MEMORY_HALVING_SPEED_PARAMETER_NAME
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode, EpisodeAndPredictionOrFailure, EpisodePrediction
from yid_ocp.problem.estimation_problem import (
    checked_unknowns,
    held_out_parameter_vector,
    held_out_prediction_arguments,
)
from yid_ocp.problem.measurements import SensorMeasurements, measurements_minus_sensor_error_estimates
from yid_ocp.problem.predictions import naive_cable_predictions, rmse_unit_count_dicts_by_channel
from yid_ocp.sensors.base import Sensor
from yid_ocp.solvers import GaussNewton, Solution, Status
from yid_ocp.solvers import base as solvers
from yid_ocp.solvers.base import IterationCallback, Solver

_ERROR_TEXTS = {"links": "from the number of links", "time_step": "from the time step"}


def solve(
    problem: EstimationProblem,
    solver: Solver | None = None,
    initial_unknowns: Sequence[float] | None = None,
    callback: IterationCallback | None = None,
    progress: Progress = NULL_PROGRESS,
) -> Solution:
    """Solve an estimation problem and return the estimates, uncertainty and verdicts that the command `solve` reports.

    The steps are: the best fit of several starts (`fit_problem`); a refit without cable memory if the recordings do
    not support it; profile-likelihood intervals of weakly determined parameters; the errors of the discretisations in
    `problem.options.checked_discretisations`, which are added to the standard deviations. Verdicts are `not_trusted` if
    clocks drift, or if a prediction without a model has a smaller error than the model. An unstable step is `stalled`.

    Parameters
    ----------
    solver : Solver, optional
        Default: `GaussNewton()`, regardless of the configuration file.
    initial_unknowns : sequence of float, optional
        Default: the initial unknowns of the problem. Raises `ConfigError` for another number, or beyond a bound.
    callback : callable, optional
        Receives every `Iterate`.

    Returns
    -------
    Solution
        Estimates in their own units. A search that does not converge raises no error: see `status` and `message`.
    """
    if not isinstance(problem, EstimationProblem):
        what, hint = f"the problem is {problem!r}", "build it with yid_ocp.load_problem(CONFIG.yaml)"
        raise ConfigError(what, where="problem", allowed="an EstimationProblem", hint=hint)
    if isinstance(solver, str):
        what, allowed = f"the solver is the text '{solver}'", "a solver object, such as yid_ocp.GaussNewton()"
        raise ConfigError(what, where="solver", allowed=allowed, hint="leave it out for Gauss-Newton")
    if initial_unknowns is not None:
        checked_unknowns(problem, initial_unknowns, "initial_unknowns")
    solver, limits = solver or GaussNewton(), problem.options.excess_residual_criteria
    steps = sum(episode.grid.steps for episode in problem.episodes)
    small = min(max(steps / 500 * (problem.system.n_coordinates / 50) ** 1.7, 0.1), 1.0)
    text = f"solving for {count_with_noun(len(problem.initial_unknowns), 'unknown')} by {solver.name}"
    if problem.options.weighting != "paper":
        noise_cost = limits.noise_fraction_of_stated_std**2 * problem.residual_rows.data.stop / 2
        text += f" (noise alone gives a cost near {noise_cost:.4g})"
    progress.begin_stage(text, 5 * small, 9.5 * small + 1.5)
    found = solvers.fit_problem(problem, solver, initial_unknowns, callback, limits)
    problem, found, message = choose_fit_with_or_without_shape_memory(problem, solver, found)
    solution = add_intervals_and_checks(problem, found, progress)
    checks = replace(solution.checks or uncertainty.EstimateChecksBeyondFit(), cable_memory_message=message)
    return replace(solution, checks=checks)


def add_intervals_and_checks(
    problem: EstimationProblem, solution: Solution, progress: Progress = NULL_PROGRESS
) -> Solution:
    """Return the fit with intervals, discretisation errors, held-out predictions and data checks, as `solve` does."""
    start, problem = problem, solution.problem or problem
    filters = problem.whitening_filters, problem.held_out_whitening_filters
    if solution.evaluation is not None:
        episodes = _with_equilibrium_guesses(problem.episodes, solution.evaluation.episode_predictions)
        problem = problem.with_episodes(episodes, problem.held_out, *filters)
    solution, stability = _checked_solution_and_step_stability(start, problem, solution)
    solution = solution_with_profile_intervals(problem, solution, progress)
    data_std = solution.std
    solution, checks = add_discretisation_errors(problem, solution, progress)
    progress.begin_stage("predicting the held-out recordings" if problem.held_out else "checking the fit", 1.2, 1.5)
    held_out, expected = _predict_held_out_with_expected_errors(problem, solution.x)
    others = _with_equilibrium_guesses(problem.held_out, [outcome for _, outcome in held_out])
    problem = problem.with_episodes(problem.episodes, others, *filters)
    solution, issues = _checked_solution_and_issues(problem, solution, held_out)
    checks = replace(checks, data_std=data_std, data_issues=issues, step_stability=stability)
    checks = replace(checks, held_out_predictions=tuple(held_out), expected_prediction_errors=expected)
    return replace(solution, checks=checks, problem=problem)


def _with_equilibrium_guesses(
    episodes: Sequence[Episode], predictions: Sequence[EpisodePrediction | str]
) -> list[Episode]:
    """Return the episodes, whose later searches for equilibria start from the equilibria of the given predictions."""
    pairs = zip(episodes, predictions, strict=True)
    known = [(e, None if isinstance(own, str) else own.equilibrium_guess) for e, own in pairs]
    return [e if guess is None else replace(e, equilibrium_guess=guess) for e, guess in known]


def add_discretisation_errors(
    problem: EstimationProblem, solution: Solution, progress: Progress = NULL_PROGRESS
) -> tuple[Solution, uncertainty.EstimateChecksBeyondFit]:
    """Return the solution with standard deviations that include the discretisation error, and the shifts with notes."""
    if solution.evaluation is None:
        return solution, uncertainty.EstimateChecksBeyondFit()
    kinds = problem.options.checked_discretisations
    fit = solution.x, solution.evaluation
    shifts, notes = discretisation.parameter_shifts_at_finer_discretisation(problem, *fit, kinds, progress)
    sizes = uncertainty.typical_parameter_magnitudes(problem, solution.x)
    inflated = discretisation.estimates_widened_by_discretisation_error(solution.parameters, shifts, sizes)
    checked = {kind for own in shifts.values() for kind in kinds if getattr(own, kind) is not None}
    uncounted = uncounted_error_texts(problem, checked)
    notes = {**(solution.checks or uncertainty.EstimateChecksBeyondFit()).notes, **notes}
    checks = uncertainty.EstimateChecksBeyondFit(discretisation_shifts=shifts, notes=notes)
    return replace(solution, parameters=inflated), replace(checks, uncounted_errors=uncounted)


def uncounted_error_texts(problem: EstimationProblem, counted: Collection[str]) -> tuple[str, ...]:
    """Return the errors of the discretisation that standard deviations leave out. `counted` has the counted ones.

    Links that can be divided, but are not refined by `checked_discretisations`, are not named.
    """
    can_divide, chosen = bool(problem.options.divided_links_model), problem.options.checked_discretisations
    without = {"links"} if not problem.system.segment_layouts or (can_divide and "links" not in chosen) else set()
    return tuple(words for kind, words in _ERROR_TEXTS.items() if kind not in {*counted, *without})


def _checked_solution_and_issues(
    problem: EstimationProblem, solution: Solution, held_out: Sequence[EpisodeAndPredictionOrFailure]
) -> tuple[Solution, tuple[Issue, ...]]:
    """Return the solution (`not_trusted` if issues are serious) and the issues of the data and of a converged fit."""
    if solution.evaluation is None or solution.status != Status.CONVERGED:
        return solution, problem.options.data_issues
    errors, units, _ = prediction_errors_units_and_fit_rmse(problem, solution, held_out)
    found = clock_and_noise_issues_from_residuals(problem, solution.x, solution.evaluation)
    if solution.goodness_of_fit.data_trusted:  # wrong data make a model worse than a guess
        found += _worse_than_baseline_issues(errors, units)
    found += _contradicted_prior_issues(problem, solution) if solution.goodness_of_fit.explains else []
    if any(issue.severity != "warning" for issue in found):
        untrusted = replace(solution.goodness_of_fit, data_trusted=False)
        marked = uncertainty.mark_free_estimates_not_trusted(solution.parameters)
        solution = replace(solution, goodness_of_fit=untrusted, parameters=marked)
    return solution, (*problem.options.data_issues, *found)


def _checked_solution_and_step_stability(
    start: EstimationProblem, problem: EstimationProblem, solution: Solution
) -> tuple[Solution, dict[str, Any]]:
    """Return the solution, marked as stalled if the time step is unstable, and stability data for result.json."""
    growth = discretisation.alternating_error_growth_of_worst_recording
    begin = growth(start, start.initial_unknowns) if solution.status == Status.FAILED else None
    growths = {"estimate": growth(problem, solution.x), "start": begin}
    names = "recording=recording_name decades=growth_decades factor=max_step_factor time=max_growth_time time_step"
    found = {place: own and attributes_to_dict(own, names) for place, own in reversed(growths.items())}
    for place, own in growths.items():
        if own is not None and not own.keeps_errors_below_resolution:
            status = Status.STALLED if solution.status == Status.CONVERGED else solution.status
            said = f"the simulation is unstable at the {place}, because {own.stability_message}"
            return replace(solution, status=status, message=f"{said}. Solver: {solution.message}"), found
    return solution, found


_MEMORY_SUFFIX = ".memory"
_MEMORY_WORDS = "shape memory (the rest shape of the cable keeps a part of its first shape)"
_MAX_REST_SPEED = 0.01  # a recording whose points move more slowly at its start starts at rest [m/s]
_MIN_MOVING_RECORDINGS = 2  # minimum for leave-one-out predictions


def choose_fit_with_or_without_shape_memory(
    problem: EstimationProblem, solver: Solver, solution: Solution
) -> tuple[EstimationProblem, Solution, str]:
    """Decide whether to keep the cable's shape memory in the fit, if the cable already moves when a recording starts.

    What loaded such a cable before is unknown, so its motion can be mistaken for memory. Leave-one-out prediction
    decides: each such recording is predicted from all others, with and without memory (by one Gauss-Newton step from
    the fit of all). The memory is kept if its total error is smaller; it is dropped if only one recording moves.

    Returns the chosen problem, its fit and the reason, empty if none is needed.
    """
    starts = [episode.fixed_initial_state for episode in problem.episodes]
    speeds = [0.0 if s is None else s.fitted_parameters.get(INITIAL_RMS_SPEED_PARAMETER, 0.0) for s in starts]
    moving = [i for i, speed in enumerate(speeds) if speed > _MAX_REST_SPEED]
    if not _memory_parameters(problem) or not moving or solution.evaluation is None:
        return problem, solution, ""
    without, limits = problem_without_shape_memory(problem), problem.options.excess_residual_criteria
    known = dict(zip(solution.unknown_names, solution.x, strict=True))
    other = solvers.fit_problem(without, solver, without.pack_unknowns(known).tolist(), limits=limits)
    if other.evaluation is None:
        return problem, solution, ""
    if len(moving) < _MIN_MOVING_RECORDINGS:
        words = f"The estimates are without {_MEMORY_WORDS}. To test it, add a second recording that starts in motion."
        return without, other, words
    kept, dropped = (_left_out(p, s, moving) for p, s in ((problem, solution), (without, other)))
    errors = f"{_MEMORY_WORDS}. Recordings, each predicted from the others, have an rms error of {kept:.3g} times the "
    errors += f"noise with this memory and {dropped:.3g} times without."
    if kept < dropped:
        return problem, solution, f"The estimates include {errors}"
    return without, other, f"The estimates are without {errors}"


def problem_without_shape_memory(problem: EstimationProblem) -> EstimationProblem:
    """Return the problem with the shape memory of all cable segments (`SEGMENT.memory`) fixed at zero."""
    memory = _memory_parameters(problem)
    free = tuple(name for name in problem.free if name not in (*memory, SHAPE_MEMORY_HALVING_SPEED_PARAMETER_NAME))
    return problem.with_free_parameters_without_recompiling(free).with_parameter_values(dict.fromkeys(memory, 0.0))


def _memory_parameters(problem: EstimationProblem) -> list[str]:
    return [name for name in problem.shared_parameters if name.endswith(_MEMORY_SUFFIX)]


def _left_out(problem: EstimationProblem, solution: Solution, moving: list[int]) -> float:
    """Return the rms whitened residual of the recordings `moving`, each predicted with parameters from all others."""
    guesses = None if solution.evaluation is None else solution.evaluation.equilibrium_guesses
    fitted = problem.evaluate(solution.x, equilibrium_guesses=guesses)
    assert fitted.jacobian is not None
    total, count = 0.0, 0
    for i in moving:
        own = np.concatenate([np.arange(rows.start, rows.stop) for rows in problem.residual_rows.measurements[i]])
        kept = np.setdiff1d(np.arange(len(fitted.residual)), own)
        step = size_limited_damped_step(problem, solution.x, fitted.jacobian[kept], fitted.residual[kept], 1e-10)
        parts = problem.unpack_episode_unknowns(np.clip(solution.x + step, *problem.bounds), i)
        found = problem.predictor.predict_episode(problem.episodes[i], *parts, False)
        if isinstance(found, str):
            return np.inf
        for samples, predicted in zip(problem.episodes[i].measurements, found.predicted_outputs, strict=True):
            total += float(np.sum(samples.whitened_residual(predicted) ** 2))
            count += samples.n_residuals
    return float(np.sqrt(total / max(count, 1)))


BASELINE_DESCRIPTIONS = {
    "stays": "constant readings",
    "zero": "no efforts",
    "moves_with_clamps": "points move like the mean of the clamps",
    "linear_carry": "points on lines between the clamps",
}
_WORSE_RATIO = 1.05  # two errors nearer than that are alike
_MAX_STDS_FROM_PRIOR = 5.0  # a stated prior that is farther from the estimate is wrong
_N_ERROR_DRAWS = 8  # motions with errors drawn from the noise of torques, or of encoders
_MAX_OFFSET_IN_STDS = 3.0  # of a constant error or clock that counts as noise


def channel_or_group_unit(units: Mapping[str, str], channel: str) -> str:
    """Return the unit of a channel, or of the first channel of a group, from `units` by channel. Empty if unknown."""
    return next((unit for name, unit in units.items() if name == channel or name.startswith(f"{channel}.")), "")


def prediction_errors_units_and_fit_rmse(
    problem: EstimationProblem, solution: Solution, held_out: Sequence[EpisodeAndPredictionOrFailure]
) -> tuple[list[dict[str, Any]], dict[str, str], Mapping[str, Any]]:
    """Return prediction errors of every recording (held-out first), units by channel, and fit errors with baselines."""
    residuals: Mapping[str, Any] = {}
    pairs = list(held_out)
    if solution.evaluation is not None:
        fitted = list(zip(problem.episodes, solution.episode_predictions, strict=True))
        able = [(result, episode) for episode, result in fitted if not isinstance(result, str)]
        episodes = [episode for _, episode in able]
        residuals = rmse_unit_count_dicts_by_channel([result for result, _ in able], episodes)
        pairs += fitted
        cable = problem.options.cable_vertices
        for name in BASELINE_DESCRIPTIONS:
            outputs = ([_baselines(e, s, cable).get(name, s.value * np.nan) for s in e.measurements] for e in episodes)
            guesses = [replace(own, predicted_outputs=(*made,)) for (own, _), made in zip(able, outputs, strict=True)]
            for channel, errors in rmse_unit_count_dicts_by_channel(guesses, episodes).items():
                residuals[channel].setdefault("baselines", {})[name] = errors["rmse"]
    units = {channel: entry["unit"] for channel, entry in residuals.items()}
    return [_prediction_error_entry(problem, *pair) for pair in pairs], units, residuals


def _prediction_error_entry(
    problem: EstimationProblem, episode: Episode, outcome: EpisodePrediction | str
) -> dict[str, Any]:
    """Return a recording's rms errors (groups without frames that fixed the start), of the model and each baseline."""
    entry: dict[str, Any] = {"recording": episode.name, "rmse": {}, "baselines": {}}
    options = problem.options
    window = options.initial_state_fit_window / problem.step.time_step
    fixed = window if options.initial_state == "fitted_to_points" else -1.0
    if isinstance(outcome, str):
        entry["message"] = outcome
    else:
        for samples, predicted in zip(episode.measurements, outcome.predicted_outputs, strict=True):
            entry["rmse"] |= _errors(samples, predicted, fixed)
    for samples in episode.measurements:
        for name, predicted in _baselines(episode, samples, options.cable_vertices).items():
            if errors := _errors(samples, predicted, fixed):
                entry["baselines"].setdefault(name, {}).update(errors)
    return entry


def _predict_held_out_with_expected_errors(
    problem: EstimationProblem, x: Array
) -> tuple[list[EpisodeAndPredictionOrFailure], dict[str, dict[str, float]]]:
    """Predict held-out recordings, and compute by channel the rms errors by noise of sensors, torques and encoders."""
    predict, rng = problem.predictor.predict_episode, np.random.default_rng(0)
    unbiased = unknowns_without_encoder_noise_bias(problem, x) if problem.held_out else x
    pairs, expected = list[EpisodeAndPredictionOrFailure](), dict[str, dict[str, float]]()
    share = problem.options.excess_residual_criteria.noise_fraction_of_stated_std
    for episode, theta, offset in held_out_prediction_arguments(problem, x):
        outcome = predict(episode, theta, offset, False)
        pairs.append((episode, outcome))
        if isinstance(outcome, str):
            continue
        drawn: list[EpisodePrediction | str] = []
        if (errors := episode.input_errors) is not None:
            for _ in range(_N_ERROR_DRAWS):
                samples = rng.standard_normal((int(errors.sample_of_step[-1]) + 1, len(errors.torque_std)))
                white = errors.torque_std * samples[errors.sample_of_step]
                bias = errors.torque_bias + errors.torque_bias_std * rng.standard_normal(len(errors.torque_std))
                moved = replace(errors, torque_bias=bias, torque_noise=errors.torque_noise + white)
                other = replace(episode, input_errors=moved)
                drawn.append(predict(other, theta, offset, False, outcome.equilibrium_guess))
        changes = _prediction_changes(outcome, drawn)
        # stated errors of efforts contain the noise of encoders already
        kept = [not samples.sensor.effort_joints for samples in episode.measurements]
        if any(kept) and encoders_move_object(problem):
            theta = held_out_parameter_vector(problem, unbiased, episode)
            noisy = (episode_with_noisier_motion(episode, problem, rng) for _ in range(_N_ERROR_DRAWS))
            base, *drawn = (predict(own, theta, offset, False, outcome.equilibrium_guess) for own in (episode, *noisy))
            moves = [] if isinstance(base, str) else _prediction_changes(base, drawn)
            changes += [[change * own for change, own in zip(move, kept, strict=True)] for move in moves]
        errors_of_stated_stds = _expected_errors(episode, outcome, changes).items()
        expected[episode.name] = {channel: share * rms for channel, rms in errors_of_stated_stds}
    return pairs, expected


def _prediction_changes(base: EpisodePrediction, drawn: Sequence[EpisodePrediction | str]) -> list[list[Array]]:
    """Changes of the outputs of each sensor by each draw of an error, divided by the root of the number of draws."""
    able = [own.predicted_outputs for own in drawn if not isinstance(own, str)]
    pairs = (zip(own, base.predicted_outputs, strict=True) for own in able)
    return [[(after - before) / math.sqrt(len(able)) for after, before in own] for own in pairs]


def _expected_errors(
    episode: Episode, outcome: EpisodePrediction, changes: Sequence[Sequence[Array]]
) -> dict[str, float]:
    found: dict[str, float] = {}
    without = measurements_minus_sensor_error_estimates(episode.measurements, outcome.predicted_outputs)
    for k, (samples, corrected) in enumerate(zip(episode.measurements, without, strict=True)):
        square = np.where(np.isfinite(samples.value), samples.std, np.nan) ** 2
        # by constant errors and the clock's offset, but no larger ones than expected
        most = _MAX_OFFSET_IN_STDS**2 * np.sum(samples.output_changes_per_bias_and_clock_std**2, axis=2)
        square = square + np.minimum((samples.value - corrected.value) ** 2, most)
        square = square + sum(own[k] ** 2 for own in changes)
        found |= _rms_by_channel(samples.sensor, square)[0]
    return found


def _rms_by_channel(sensor: Sensor, square: Array) -> tuple[dict[str, float], Array]:
    """Return rms values by channel with finite samples, and the sums (M, channels) of squared outputs (M, outputs)."""
    # a slow camera may have no frame, for which reshape cannot infer an axis
    summed = square.reshape(len(square), len(sensor.channel_names), sensor.outputs_per_channel).sum(axis=2)
    seen = ((name, own[np.isfinite(own)]) for name, own in zip(sensor.channel_names, summed.T, strict=True))
    return {name: float(np.sqrt(np.mean(own))) for name, own in seen if len(own)}, summed


def _worse_than_baseline_issues(entries: Sequence[Mapping[str, Any]], units: Mapping[str, str]) -> list[Issue]:
    """Return an issue for each sensor that the best baseline predicts better than the model, over all its channels."""
    found = []
    for entry in entries:
        single = (channel for channel in entry["rmse"] if channel in units)  # not the sum over a group
        for group, channels in grouped((channel.rpartition(".")[0], channel) for channel in single).items():
            rms = {
                name: float(np.sqrt(np.mean([errors[channel] ** 2 for channel in channels])))
                for name, errors in {"": entry["rmse"], **entry["baselines"]}.items()
                if set(channels) <= set(errors)
            }
            error = rms.pop("")
            best = min(rms, key=rms.__getitem__, default="")
            guess, unit = rms.get(best, np.inf), units[channels[0]]
            if error > _WORSE_RATIO * guess:
                what = f"the model's rms error is {error:.3g} {unit}, that of '{BASELINE_DESCRIPTIONS[best]}' only "
                what += f"{guess:.3g} {unit} (up to {_WORSE_RATIO:g} times this is tolerated)"
                evidence = error / (_WORSE_RATIO * guess) if guess > 0 else LIMIT_VIOLATION_RATIO_CAP
                advice = "look at the residuals in the report, and run `yid-ocp diagnose` to find what the model lacks"
                at = (entry["recording"], *group.partition(".")[::2])
                found.append(Issue("worse_than_guess", what, "not_trusted", evidence, advice, *at))
    return found


def _contradicted_prior_issues(problem: EstimationProblem, solution: Solution) -> list[Issue]:
    """Return an issue for each estimate that is far from its stated prior."""
    found = []
    for name, entry in solution.parameters.items():
        std = problem.options.prior_stds.get(name.split("[")[0], math.inf)
        stds = abs(entry.value - entry.initial) / std
        if stds > _MAX_STDS_FROM_PRIOR:
            what = f"the estimate of {name} is {entry.value:.4g} {entry.unit}, but its prior is {entry.initial:.4g} ± "
            what += f"{std:.2g} (up to {_MAX_STDS_FROM_PRIOR:g} times this ± is tolerated)"
            advice = f"correct parameters.{name}.initial, or remove its prior_std, because it makes the values wrong"
            ratio, place = stds / _MAX_STDS_FROM_PRIOR, ("", f"parameters.{name}")
            found.append(Issue("contradicted_prior", what, "not_trusted", ratio, advice, *place))
    return found


def _errors(samples: SensorMeasurements, predicted: Array, fixed: float) -> dict[str, float]:
    sensor = samples.sensor
    result, square = _rms_by_channel(sensor, (predicted - samples.value) ** 2)
    if len(sensor.point_names) > 1:
        later = square[samples.node + samples.fraction > fixed + 1e-6]
        if np.any(np.isfinite(later)):
            result[sensor.group_name] = float(np.sqrt(np.nanmean(later)))
    return result


def _baselines(episode: Episode, samples: SensorMeasurements, cable: CableVertices | None) -> dict[str, Array]:
    sensor = samples.sensor
    if sensor.naive_prediction == "zero":
        return {"zero": np.zeros_like(samples.value)}
    if cable is not None and sensor.point_names and set(sensor.point_names) <= set(cable.vertex_names):
        group = next(group for group in episode.recording.points if group.name == sensor.group_name)
        inside = (group.t >= episode.grid.start_time - 1e-9) & (group.t <= episode.grid.node_times[-1] + 1e-9)
        arrays = naive_cable_predictions(episode.recording, cable, sensor.point_names)
        return {name: array[inside].reshape(len(samples.value), -1) for name, array in arrays.items()}
    if len(samples.value) < QUALITY_LIMITS.min_samples:  # a comparison of fewer errors depends on chance
        return {}
    at = np.isfinite(samples.value).argmax(axis=0)[None]
    guess = np.broadcast_to(np.take_along_axis(samples.value, at, axis=0), samples.value.shape).copy()
    np.put_along_axis(guess, at, np.nan, axis=0)  # a guess is not judged by the sample that made it
    return {"stays": guess}

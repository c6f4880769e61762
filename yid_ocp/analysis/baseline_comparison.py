"""Prediction errors of a model on recordings, beside those of baselines that need no model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.data.issues import MAX_EVIDENCE_RATIO, Issue
from yid_ocp.model.objects.base import CableTopology
from yid_ocp.problem import EstimationProblem, predictions
from yid_ocp.problem.episodes import Episode, EpisodePrediction
from yid_ocp.problem.measurements import SensorMeasurements
from yid_ocp.problem.predictions import rmse_unit_and_count_by_channel
from yid_ocp.sensors.base import Sensor
from yid_ocp.solvers import Solution

_WORSE_RATIO = 1.05  # two errors nearer than that are alike
_N_TORQUE_ERROR_DRAWS = 8  # motions with errors drawn from the noise of the torques
_START_FRAMES = 2  # frames from which the baselines of a cable start, as its own start state does


def channel_or_group_unit(units: Mapping[str, str], channel: str) -> str:
    """Unit of a channel, or of the first member of a group; an empty text if it is unknown."""
    return next((unit for name, unit in units.items() if name == channel or name.startswith(f"{channel}.")), "")


def prediction_errors_and_units(
    problem: EstimationProblem, solution: Solution, held_out: Sequence[tuple[Episode, EpisodePrediction | str]]
) -> tuple[list[dict[str, Any]], dict[str, str], Mapping[str, Any]]:
    """Errors beside baselines of recordings held out and then of those fitted, units, and errors of channels fitted."""
    residuals: Mapping[str, Any] = {}
    pairs = list(held_out)
    if solution.evaluation is not None:
        fitted = list(zip(problem.episodes, solution.episode_predictions, strict=True))
        able = [(result, episode) for episode, result in fitted if not isinstance(result, str)]
        residuals = rmse_unit_and_count_by_channel([result for result, _ in able], [episode for _, episode in able])
        pairs += fitted
    units = {channel: entry["unit"] for channel, entry in residuals.items()}
    return [_prediction_error_entry(problem, *pair) for pair in pairs], units, residuals


def _prediction_error_entry(
    problem: EstimationProblem, episode: Episode, outcome: EpisodePrediction | str
) -> dict[str, Any]:
    """Prediction errors of one recording: RMSE per channel for the model and for every baseline.

    A group of several points has an entry of its own beside its channels: the square root of the mean squared distance
    over all its points and frames but those that fixed the start. `outcome` is a prediction or why there is none.
    """
    entry: dict[str, Any] = {"recording": episode.name, "rmse": {}, "baselines": {}}
    options = problem.options
    fixed = (
        options.initial_state_fit_window / problem.step.time_step
        if options.initial_state == "fitted_to_points"
        else -1.0
    )
    if isinstance(outcome, str):
        entry["message"] = outcome
    else:
        for samples, predicted in zip(episode.measurements, outcome.predicted_outputs, strict=True):
            entry["rmse"] |= _errors(samples, predicted, fixed)
    for samples in episode.measurements:
        for name, predicted in _baselines(episode, samples, options.cable_topology).items():
            if errors := _errors(samples, predicted, fixed):
                entry["baselines"].setdefault(name, {}).update(errors)
    return entry


def predict_held_out_with_expected_errors(
    problem: EstimationProblem, x: Array
) -> tuple[list[tuple[Episode, EpisodePrediction | str]], dict[str, dict[str, float]]]:
    """Held-out predictions as of `predict_held_out`, and the error that noise makes of each, by recording and channel.

    Root mean square of what sensors add and of what torque errors as large as stated do to the motion, drawn a few
    times. `x` is the unknown vector, shape (nx,).
    """
    predict, rng = problem.predictor.predict_episode, np.random.default_rng(0)
    pairs: list[tuple[Episode, EpisodePrediction | str]] = []
    expected: dict[str, dict[str, float]] = {}
    for episode, theta, offset in problem.held_out_prediction_inputs(x):
        outcome = predict(episode, theta, offset, False)
        pairs.append((episode, outcome))
        if isinstance(outcome, str):
            continue
        drawn: list[EpisodePrediction | str] = []
        if (errors := episode.input_errors) is not None:
            for _ in range(_N_TORQUE_ERROR_DRAWS):
                samples = rng.standard_normal((int(errors.sample_of_step[-1]) + 1, len(errors.torque_std)))
                white = errors.torque_std * samples[errors.sample_of_step]
                bias = errors.torque_bias + errors.torque_bias_std * rng.standard_normal(len(errors.torque_std))
                moved = replace(errors, torque_bias=bias, torque_noise=errors.torque_noise + white)
                drawn.append(predict(replace(episode, input_errors=moved), theta, offset, False))
        expected[episode.name] = _expected_errors(episode, outcome, drawn)
    return pairs, expected


def _expected_errors(
    episode: Episode, outcome: EpisodePrediction, drawn: Sequence[EpisodePrediction | str]
) -> dict[str, float]:
    found = {}
    able = [own for own in drawn if not isinstance(own, str)]
    for k, samples in enumerate(episode.measurements):
        square = np.where(np.isfinite(samples.value), samples.std, np.nan) ** 2
        for own in able:
            square = square + (own.predicted_outputs[k] - outcome.predicted_outputs[k]) ** 2 / len(able)
        found |= _rms_by_channel(samples.sensor, square)[0]
    return found


def _rms_by_channel(sensor: Sensor, square: Array) -> tuple[dict[str, float], Array]:
    """Root mean square by channel that has finite samples, and sums (M, channels), of squared outputs (M, outputs)."""
    # a slow camera may see nothing, and then no axis can be left to reshape
    summed = square.reshape(len(square), len(sensor.channel_names), sensor.outputs_per_channel).sum(axis=2)
    found = {}
    for c, channel in enumerate(sensor.channel_names):
        seen = summed[np.isfinite(summed[:, c]), c]
        if len(seen):
            found[channel] = float(np.sqrt(np.mean(seen)))
    return found, summed


def _clearly_better_baseline(entry: Mapping[str, Any], channels: Sequence[str]) -> tuple[str, float, float] | None:
    """The best baseline that all channels have, its error and the model's (rms); None where the model is as good."""
    rms = {
        name: float(np.sqrt(np.mean([errors[channel] ** 2 for channel in channels])))
        for name, errors in {"": entry["rmse"], **entry["baselines"]}.items()
        if set(channels) <= set(errors)
    }
    error = rms.pop("")
    best = min(rms, key=rms.__getitem__, default=None)
    return (best, rms[best], error) if best is not None and error > _WORSE_RATIO * rms[best] else None


def channels_worse_than_naive_guess(
    entries: Sequence[Mapping[str, Any]], units: Mapping[str, str]
) -> list[dict[str, Any]]:
    """Channels of prediction error entries that a baseline without a model predicts clearly better."""
    worse = []
    for entry in entries:
        for channel in entry["rmse"]:
            if better := _clearly_better_baseline(entry, [channel]):
                said = {"recording": entry["recording"], "channel": channel}
                said |= {"unit": channel_or_group_unit(units, channel)}
                worse.append(said | dict(zip(("baseline", "guess", "rmse"), better, strict=True)))
    return worse


def worse_than_baseline_issues(entries: Sequence[Mapping[str, Any]], units: Mapping[str, str]) -> list[Issue]:
    """Issues for sensors that a model-free baseline predicts better than the model, over all their channels.

    Single channels that say little of what the model is about may well be worse; see `channels_worse_than_naive_guess`.
    """
    found = []
    for entry in entries:
        groups: dict[str, list[str]] = {}
        for channel in entry["rmse"]:
            if channel in units:  # not the sum over a group
                groups.setdefault(channel.rpartition(".")[0], []).append(channel)
        for group, channels in groups.items():
            if better := _clearly_better_baseline(entry, channels):
                best, guess, error = better
                unit = units[channels[0]]
                what = f"the model is off by {error:.3g} {unit} (rms), the guess '{best}' without a model by"
                evidence = error / (_WORSE_RATIO * guess) if guess > 0 else MAX_EVIDENCE_RATIO
                advice = "look at the residuals, and let `yid-ocp diagnose` say what the model lacks"
                sensor, _, channel = group.partition(".")
                at = (entry["recording"], sensor, channel)
                what = f"{what} {guess:.3g} {unit}"
                found.append(Issue("worse_than_guess", what, "not_trusted", evidence, advice, *at))
    return found


def _errors(samples: SensorMeasurements, predicted: Array, fixed: float) -> dict[str, float]:
    sensor = samples.sensor
    result, square = _rms_by_channel(sensor, (predicted - samples.value) ** 2)
    if len(sensor.point_names) > 1:
        later = square[samples.node + samples.fraction > fixed + 1e-6]
        if np.any(np.isfinite(later)):
            result[sensor.group_name] = float(np.sqrt(np.nanmean(later)))
    return result


def _baselines(episode: Episode, samples: SensorMeasurements, cable: CableTopology | None) -> dict[str, Array]:
    sensor = samples.sensor
    if sensor.naive_prediction == "zero":
        return {"zero": np.zeros_like(samples.value)}
    if cable is not None and sensor.point_names and set(sensor.point_names) <= set(cable.vertex_names):
        recording, held, points = episode.recording, cable.clamped_vertex_names, sensor.point_names
        group = next(group for group in recording.points if group.name == sensor.group_name)
        inside = (group.t >= episode.grid.start_time - 1e-9) & (group.t <= episode.grid.node_times[-1] + 1e-9)
        parents, children = cable.parent_branch_vertex_names, cable.vertex_names_by_child_branch
        carried = predictions.interpolated_displacement_position_baseline
        arrays = {
            "stays": predictions.constant_position_baseline(recording, points, _START_FRAMES),
            "moves_with_clamps": predictions.mean_clamp_displacement_baseline_prediction(
                recording, points, held, _START_FRAMES
            ),
            "linear_carry": carried(recording, points, parents, children, given=_START_FRAMES),
        }
        return {name: array[inside].reshape(len(samples.value), -1) for name, array in arrays.items()}
    if not len(samples.value):
        return {}
    at = np.isfinite(samples.value).argmax(axis=0)[None]
    guess = np.broadcast_to(np.take_along_axis(samples.value, at, axis=0), samples.value.shape).copy()
    np.put_along_axis(guess, at, np.nan, axis=0)  # a guess is not judged by the sample that made it
    return {"stays": guess}

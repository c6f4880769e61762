"""Prediction errors of recordings, compared with model-free baselines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yid_ocp.data.issues import MAX_LIMIT_RATIO, Issue
from yid_ocp.model.cable import CableTopology
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.measurements import Measurements
from yid_ocp.problem.prediction_errors import (
    clamp_displacement_baseline,
    constant_position_baseline,
    interpolated_displacement_baseline,
)
from yid_ocp.problem.prediction_result import EpisodePrediction

Array = NDArray[np.float64]

_WORSE_RATIO = 1.05  # two errors nearer than that are alike
_START_FRAMES = 2  # frames from which the baselines of a cable start, as its own start state does


def prediction_error_entry(
    problem: EstimationProblem, episode: Episode, outcome: EpisodePrediction | str, cable: CableTopology | None = None
) -> dict[str, Any]:
    """Prediction errors of one recording: RMSE per channel for the model and for every baseline.

    A group of several points has an entry of its own beside its channels: the square root of the mean squared distance
    over all its points and frames but those that fixed the start.

    Parameters
    ----------
    outcome : EpisodePrediction or str
        Prediction, or why there is none.
    cable : CableTopology, optional
        For the baselines that only a cable held by clamps has.
    """
    entry: dict[str, Any] = {"recording": episode.name, "rmse": {}, "baselines": {}}
    fixed = _start_end(problem, episode)
    if isinstance(outcome, str):
        entry["message"] = outcome
    else:
        for samples, predicted in zip(episode.measurements, outcome.predicted_outputs, strict=True):
            entry["rmse"] |= _errors(samples, predicted, fixed)
    for samples in episode.measurements:
        for name, predicted in _baselines(episode, samples, cable).items():
            errors = _errors(samples, predicted, fixed)
            if errors:
                entry["baselines"].setdefault(name, {}).update(errors)
    return entry


def channels_worse_than_baseline(
    entries: Sequence[Mapping[str, Any]], units: Mapping[str, str]
) -> list[dict[str, Any]]:
    """Channels that a model-free baseline predicts clearly better than the model, from `prediction_error_entry` entries."""
    worse = []
    for entry in entries:
        for channel, error in entry["rmse"].items():
            guesses = {name: errors[channel] for name, errors in entry["baselines"].items() if channel in errors}
            best = min(guesses, key=guesses.__getitem__, default=None)
            if best is not None and error > _WORSE_RATIO * guesses[best]:
                said = {
                    "recording": entry["recording"],
                    "channel": channel,
                    "rmse": error,
                    "unit": _unit(channel, units),
                }
                worse.append(said | {"baseline": best, "guess": guesses[best]})
    return worse


def worse_than_baseline_issues(entries: Sequence[Mapping[str, Any]], units: Mapping[str, str]) -> list[Issue]:
    """Issues for sensors that a model-free baseline predicts better than the model, over all their channels.

    Single channels that say little of what the model is about may well be worse; see `channels_worse_than_baseline`.
    """
    found = []
    for entry in entries:
        groups: dict[str, list[str]] = {}
        for channel in entry["rmse"]:
            if channel in units:  # not the sum over a group
                groups.setdefault(channel.rpartition(".")[0], []).append(channel)
        for group, channels in groups.items():
            error = _together(entry["rmse"], channels)
            known = {name: errors for name, errors in entry["baselines"].items() if set(channels) <= set(errors)}
            guesses = {name: _together(errors, channels) for name, errors in known.items()}
            best = min(guesses, key=guesses.__getitem__, default=None)
            if best is None or not error > _WORSE_RATIO * guesses[best]:
                continue
            unit = _unit(channels[0], units)
            found.append(
                Issue(
                    "worse_than_guess",
                    f"the model is off by {error:.3g} {unit} (rms), the guess '{best}' without a model by "
                    f"{guesses[best]:.3g} {unit}",
                    "not_trusted",
                    error / (_WORSE_RATIO * guesses[best]) if guesses[best] > 0 else MAX_LIMIT_RATIO,
                    "look at the residuals, and let `yid-ocp diagnose` say what the model lacks",
                    entry["recording"],
                    group.partition(".")[0],
                    group.partition(".")[2],
                )
            )
    return found


def _together(errors: Mapping[str, float], channels: Sequence[str]) -> float:
    """Root mean square over channels."""
    return float(np.sqrt(np.mean([errors[channel] ** 2 for channel in channels])))


def _unit(channel: str, units: Mapping[str, str]) -> str:
    """Unit of a channel, or of the first channel of a group."""
    return next((unit for name, unit in units.items() if name == channel or name.startswith(f"{channel}.")), "")


def _start_end(problem: EstimationProblem, episode: Episode) -> float:
    """Node up to which measured points were used to fix the start, -1 where none were."""
    options = problem.options
    return options.start_fit_window / problem.step.time_step if options.initial_state == "fitted_to_points" else -1.0


def _errors(samples: Measurements, predicted: Array, fixed: float) -> dict[str, float]:
    sensor = samples.sensor
    shape = (len(predicted), len(sensor.channel_names), sensor.outputs_per_channel)
    square = np.sum((predicted - samples.value).reshape(shape) ** 2, axis=2)
    result = {}
    for c, channel in enumerate(sensor.channel_names):
        seen = square[np.isfinite(square[:, c]), c]
        if len(seen):
            result[channel] = float(np.sqrt(np.mean(seen)))
    if len(sensor.point_names) > 1:
        later = square[samples.node + samples.fraction > fixed + 1e-6]
        if np.any(np.isfinite(later)):
            result[sensor.group_name] = float(np.sqrt(np.nanmean(later)))
    return result


def _baselines(episode: Episode, samples: Measurements, cable: CableTopology | None) -> dict[str, Array]:
    sensor = samples.sensor
    if sensor.naive_prediction == "zero":
        return {"zero": np.zeros_like(samples.value)}
    if cable is not None and sensor.point_names and set(sensor.point_names) <= set(cable.vertices):
        recording, held, points = episode.recording, cable.clamped_vertices, sensor.point_names
        group = next(group for group in recording.points if group.name == sensor.group_name)
        inside = (group.t >= episode.grid.start_time - 1e-9) & (group.t <= episode.grid.node_times[-1] + 1e-9)
        arrays = {
            "stays": constant_position_baseline(recording, points, _START_FRAMES),
            "moves_with_clamps": clamp_displacement_baseline(recording, points, held, _START_FRAMES),
            "linear_carry": interpolated_displacement_baseline(
                recording, points, cable.parent_vertices, cable.child_vertices, given=_START_FRAMES
            ),
        }
        return {name: array[inside].reshape(len(samples.value), -1) for name, array in arrays.items()}
    first = np.full(samples.value.shape[1], np.nan)
    for column in range(len(first)):
        seen = samples.value[np.isfinite(samples.value[:, column]), column]
        first[column] = seen[0] if len(seen) else np.nan
    return {"stays": np.broadcast_to(first, samples.value.shape)}

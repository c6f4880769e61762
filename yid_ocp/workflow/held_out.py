"""Prediction errors of recordings, compared with model-free baselines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yid_ocp.data.doubt import MOST, Doubt
from yid_ocp.model.cable import Cable
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.measurements import Measurements
from yid_ocp.problem.outcome import EpisodeResult
from yid_ocp.problem.validation import linear_carry, move_with_clamps, stay

Array = NDArray[np.float64]

CLEARLY = 1.05  # two errors nearer than that are alike
GIVEN = 2  # frames from which the baselines of a cable start, as its own start state does


def held_out_entry(
    problem: EstimationProblem, episode: Episode, outcome: EpisodeResult | str, cable: Cable | None = None
) -> dict[str, Any]:
    """Prediction errors of one recording: RMSE per channel for the model and for every baseline.

    A group of several points has an entry of its own beside its channels: the square root of the mean squared distance
    over all its points and frames but those that fixed the start.

    Parameters
    ----------
    problem : EstimationProblem
    episode : Episode
    outcome : EpisodeResult or str
        Prediction, or why there is none.
    cable : Cable, optional
        For the baselines that only a cable held by clamps has.
    """
    entry: dict[str, Any] = {"recording": episode.name, "rmse": {}, "baselines": {}}
    fixed = _start_end(problem, episode)
    if isinstance(outcome, str):
        entry["message"] = outcome
    else:
        for samples, predicted in zip(episode.samples, outcome.predicted, strict=True):
            entry["rmse"] |= _errors(samples, predicted, fixed)
    for samples in episode.samples:
        for name, predicted in _baselines(episode, samples, cable).items():
            errors = _errors(samples, predicted, fixed)
            if errors:
                entry["baselines"].setdefault(name, {}).update(errors)
    return entry


def worse_than_guess(entries: Sequence[Mapping[str, Any]], units: Mapping[str, str]) -> list[dict[str, Any]]:
    """Channels that a model-free baseline predicts clearly better than the model, from `held_out_entry` entries."""
    worse = []
    for entry in entries:
        for channel, error in entry["rmse"].items():
            guesses = {name: errors[channel] for name, errors in entry["baselines"].items() if channel in errors}
            best = min(guesses, key=guesses.__getitem__, default=None)
            if best is not None and error > CLEARLY * guesses[best]:
                said = {
                    "recording": entry["recording"],
                    "channel": channel,
                    "rmse": error,
                    "unit": _unit(channel, units),
                }
                worse.append(said | {"baseline": best, "guess": guesses[best]})
    return worse


def guess_doubts(entries: Sequence[Mapping[str, Any]], units: Mapping[str, str]) -> list[Doubt]:
    """Issues for sensors that a model-free baseline predicts better than the model, over all their channels.

    Single channels that say little of what the model is about may well be worse; see `worse_than_guess`.
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
            if best is None or not error > CLEARLY * guesses[best]:
                continue
            unit = _unit(channels[0], units)
            found.append(
                Doubt(
                    "worse_than_guess",
                    f"the model is off by {error:.3g} {unit} (rms), the guess '{best}' without a model by "
                    f"{guesses[best]:.3g} {unit}",
                    "not_trusted",
                    error / (CLEARLY * guesses[best]) if guesses[best] > 0 else MOST,
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
    return options.start_window / problem.step.time_step if options.initial_state == "fitted_to_points" else -1.0


def _errors(samples: Measurements, predicted: Array, fixed: float) -> dict[str, float]:
    sensor = samples.sensor
    shape = (len(predicted), len(sensor.channels), sensor.width)
    square = np.sum((predicted - samples.value).reshape(shape) ** 2, axis=2)
    result = {}
    for c, channel in enumerate(sensor.channels):
        seen = square[np.isfinite(square[:, c]), c]
        if len(seen):
            result[channel] = float(np.sqrt(np.mean(seen)))
    if len(sensor.points) > 1:
        later = square[samples.node + samples.fraction > fixed + 1e-6]
        if np.any(np.isfinite(later)):
            result[sensor.group] = float(np.sqrt(np.nanmean(later)))
    return result


def _baselines(episode: Episode, samples: Measurements, cable: Cable | None) -> dict[str, Array]:
    sensor = samples.sensor
    if sensor.baseline == "zero":
        return {"zero": np.zeros_like(samples.value)}
    if cable is not None and sensor.points and set(sensor.points) <= set(cable.vertices):
        recording, held, points = episode.recording, cable.held, sensor.points
        group = next(group for group in recording.points if group.name == sensor.group)
        inside = (group.t >= episode.grid.start - 1e-9) & (group.t <= episode.grid.times[-1] + 1e-9)
        arrays = {
            "stays": stay(recording, points, GIVEN),
            "moves_with_clamps": move_with_clamps(recording, points, held, GIVEN),
            "linear_carry": linear_carry(recording, points, cable.parent, cable.children, given=GIVEN),
        }
        return {name: array[inside].reshape(len(samples.value), -1) for name, array in arrays.items()}
    first = np.full(samples.value.shape[1], np.nan)
    for column in range(len(first)):
        seen = samples.value[np.isfinite(samples.value[:, column]), column]
        first[column] = seen[0] if len(seen) else np.nan
    return {"stays": np.broadcast_to(first, samples.value.shape)}

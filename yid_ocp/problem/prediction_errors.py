"""Prediction errors, and baseline predictions without a model: points stay or move with the clamps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.data.recording import PointGroup, Recording
from yid_ocp.display import ReprMixin, ReprSummary
from yid_ocp.errors import DataError, nearest_name_hint
from yid_ocp.problem.episodes import Episode, EpisodePrediction


def _group_with_points(recording: Recording, points: Sequence[str]) -> PointGroup:
    """Point group of a recording that contains all given points; raises `DataError` where there is none."""
    for group in recording.points:
        if set(points) <= set(group.names):
            return group
    what, hint = "the points stand in several groups", "put points of one object in one group"
    if missing := [point for point in points if point not in recording.point_names]:
        what, hint = f"point '{missing[0]}' is not recorded", nearest_name_hint(missing[0], recording.point_names)
    raise DataError(what, where=recording.name, hint=hint)


def constant_position_baseline(recording: Recording, points: Sequence[str], given: int = 2) -> Array:
    """Baseline prediction: every point stays where it was in the last given frame.

    The `given` first frames are as measured; shape (M, len(points), 3) [m]. Raises `DataError` for a point that is not
    recorded or not seen in the last given frame, or too few frames.
    """
    return _carried(recording, points, (), given, np.zeros((len(points), 0)))


def clamp_displacement_baseline(
    recording: Recording, points: Sequence[str], clamped: Sequence[str], given: int = 2
) -> Array:
    """Baseline prediction: every point moves by the clamped points' mean displacement since the last given frame.

    Shape and errors as in `constant_position_baseline`; the path of the points `clamped` is known throughout.
    """
    share = np.full((len(points), len(clamped)), 1.0 / max(len(clamped), 1))
    return _carried(recording, points, clamped, given, share)


def interpolated_displacement_baseline(
    recording: Recording,
    points: Sequence[str],
    parent: Sequence[str],
    children: Mapping[str, Sequence[str]] | None = None,
    clamped: Sequence[str] | None = None,
    given: int = 2,
) -> Array:
    """Baseline prediction: displacement interpolated in arc length along the parent; children move with their junction.

    Shape and errors as in `constant_position_baseline`, and for a point of no branch. `parent` has its points from end
    to end, of which `clamped` are those between which is interpolated, its two ends when absent; each child begins with
    the parent's point at which it leaves.
    """
    known = tuple(clamped) if clamped is not None else (parent[0], parent[-1])
    at = _given_frame(recording, parent, given)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(at, axis=0), axis=1))])
    place = dict(zip(parent, arc, strict=True))
    knots = sorted(known, key=lambda point: place[point])
    positions = [place[point] for point in knots]
    leaves = {point: branch[0] for branch in (children or {}).values() for point in branch[1:]}

    def weights(point: str) -> Array:
        carrier = leaves.get(point, point)
        if carrier not in place:
            raise DataError(f"point '{point}' belongs to no branch", hint=nearest_name_hint(point, [*place, *leaves]))
        return np.array([np.interp(place[carrier], positions, row) for row in np.eye(len(knots))])

    share = np.array([weights(point) for point in points])
    return _carried(recording, points, knots, given, share)


def position_rmse(predicted: Array, measured: Array, given: int = 2) -> float:
    """Square root of the mean squared Euclidean error over points and frames [m]; NaN where none is left to compare.

    Given frames and those in which a point was not measured do not count; shapes are (M, np, 3), `DataError` where the
    two differ.
    """
    if predicted.shape != measured.shape:
        raise DataError(f"prediction {predicted.shape} and measurement {measured.shape} differ in shape")
    square = np.sum((predicted - measured)[given:] ** 2, axis=2)
    seen = np.isfinite(measured[given:]).all(axis=2)
    return float(np.sqrt(np.mean(square[seen]))) if np.any(seen) else float("nan")


def measured_point_positions(recording: Recording, points: Sequence[str]) -> Array:
    """Measured positions of some points of one group, shape (M, len(points), 3) [m]."""
    group = _group_with_points(recording, points)
    return group.position[:, [group.names.index(point) for point in points]]


def _given_frame(recording: Recording, points: Sequence[str], given: int) -> Array:
    at = measured_point_positions(recording, points)
    if not 1 <= given < len(at):
        raise DataError(f"given = {given} frames", where=recording.name, allowed=f"1 to {len(at) - 1}")
    if not np.all(np.isfinite(at[given - 1])):
        hidden = points[int(np.argmin(np.isfinite(at[given - 1]).all(axis=1)))]
        raise DataError(f"point '{hidden}' is not seen in the last given frame", where=recording.name)
    return np.asarray(at[given - 1])


def _carried(recording: Recording, points: Sequence[str], known: Sequence[str], given: int, share: Array) -> Array:
    """Given frames as measured, then the last one plus each point's share of the known points' displacement."""
    here = _given_frame(recording, points, given)
    result = np.array(measured_point_positions(recording, points))
    moved = np.zeros((len(result), len(points), 3))
    if known:
        paths = measured_point_positions(recording, known)
        moved = np.einsum("pk,mkx->mpx", share, paths - _given_frame(recording, known, given))
    result[given:] = here + moved[given:]
    return result


@dataclass(frozen=True, eq=False, repr=False)
class ChannelPrediction(ReprMixin):
    """Measured and predicted samples of one channel of one recording; w is 3 for a point and 1 for a joint."""

    recording: str
    channel: str
    unit: str
    t: Array  # on the channel's own clock, (M,) [s]
    measured: Array  # NaN where nothing was measured, (M, w)
    predicted: Array
    noise_std: Array  # of the sensor; NaN where it is not known, (M, w)

    @property
    def residual(self) -> Array:
        """Predicted minus measured, shape (M, w)."""
        return self.predicted - self.measured

    @property
    def rmse(self) -> float:
        """Root mean square error; for a point, of the Euclidean distance."""
        return float(np.sqrt(np.nanmean(np.sum(self.residual**2, axis=1))))

    def _summary(self) -> ReprSummary:
        samples = f"{len(self.t)} samples, rmse {self.rmse:.3g} {self.unit}"
        return ReprSummary(f"{self.channel} of '{self.recording}', {samples}")


def channel_predictions(episode: Episode, result: EpisodePrediction) -> tuple[ChannelPrediction, ...]:
    """Measured and predicted samples of every channel of an episode."""
    found = []
    for samples, predicted in zip(episode.measurements, result.predicted_outputs, strict=True):
        sensor = samples.sensor
        times = episode.grid.start_time + episode.grid.time_step * (samples.node + samples.fraction)
        width = sensor.outputs_per_channel
        for i, channel in enumerate(sensor.channel_names):
            at = slice(i * width, (i + 1) * width)
            t = times if times.ndim == 1 else times[:, i * width]
            own = (values[:, at] for values in (samples.value, predicted, samples.std))
            found.append(ChannelPrediction(episode.name, channel, sensor.unit, t, *own))
    return tuple(found)


def rmse_by_channel(results: Sequence[EpisodePrediction], episodes: Sequence[Episode]) -> dict[str, dict[str, Any]]:
    """Root mean square error of every channel: {channel: {rmse, unit, n}}.

    For points the error of a sample is the Euclidean distance.
    """
    squares: dict[str, list[float]] = {}
    units: dict[str, str] = {}
    for result, episode in zip(results, episodes, strict=True):
        for predicted, samples in zip(result.predicted_outputs, episode.measurements, strict=True):
            shape = (len(predicted), len(samples.sensor.channel_names), samples.sensor.outputs_per_channel)
            square = np.sum((predicted - samples.value).reshape(shape) ** 2, axis=2)
            for c, channel in enumerate(samples.sensor.channel_names):
                squares.setdefault(channel, []).extend(square[np.isfinite(square[:, c]), c].tolist())
                units[channel] = samples.sensor.unit
    return {
        channel: {"rmse": float(np.sqrt(np.mean(values))), "unit": units[channel], "n": len(values)}
        for channel, values in squares.items()
        if values
    }

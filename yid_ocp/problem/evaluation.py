"""The residual of an estimation problem: its layout, and its value and derivative at one point."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yid_ocp.problem.constant_errors import ConstantErrors, slopes_by_constants
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.measurements import Measurements, Rows, huber
from yid_ocp.problem.noise import Innovations
from yid_ocp.problem.outcome import EpisodeResult
from yid_ocp.shown import Shown, Summary, counted

Array = NDArray[np.float64]
WarmStart = tuple[Array | None, ...]
"""For each recording, a configuration near the equilibrium from which it starts; None where it is not known."""


@dataclass(frozen=True)
class ResidualRows:
    """Slices of the residual vector: measurements of all episodes, then stated priors, then weak priors.

    Attributes
    ----------
    measurements : tuple of tuple of slice
        Rows of every group of measurements of every episode, those without a measurement left out.
    data, stated_priors, weak_priors : slice
    """

    measurements: tuple[tuple[slice, ...], ...]
    data: slice
    stated_priors: slice
    weak_priors: slice

    @property
    def informing(self) -> slice:
        """Slice of the data and the stated priors, without the weak priors."""
        return slice(0, self.stated_priors.stop)

    @staticmethod
    def of(episodes: Sequence[Episode], stated: int, weak: int) -> ResidualRows:
        """Layout from the episodes' measurements and the numbers of stated and weak priors."""
        at, groups = 0, []
        for episode in episodes:
            own = []
            for samples in episode.samples:
                own.append(slice(at, at + samples.count))
                at += samples.count
            groups.append(tuple(own))
        return ResidualRows(tuple(groups), slice(0, at), slice(at, at + stated), slice(at + stated, at + stated + weak))


@dataclass(frozen=True, repr=False)
class Evaluation(Shown):
    """Cost, residual and optional Jacobian of an estimation problem at one unknown vector.

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

    def _summary(self) -> Summary:
        slopes = "" if self.jacobian is None else f", by {counted(self.jacobian.shape[1], 'unknown')}"
        said = f"cost {self.cost:.6g} of {counted(len(self.residual), 'residual')}{slopes}"
        return Summary(said if self.ok else f"failed, {self.message}")

    @property
    def warm(self) -> WarmStart:
        """Guesses of the initial equilibria for evaluating a nearby point."""
        return tuple(result.warm for result in self.episodes)


def joined(measurements: Sequence[Measurements], result: EpisodeResult, threshold: float = math.inf) -> Rows:
    """Residual of one recording in units of the sensors' noise, group after group."""
    slopes = result.sensitivities or (None,) * len(measurements)
    parts = [
        samples.rows(predicted, by_unknowns, threshold)
        for samples, predicted, by_unknowns in zip(measurements, result.predicted, slopes, strict=True)
    ]
    jacobians = [part.jacobian for part in parts if part.jacobian is not None]
    return Rows(
        sum(part.cost for part in parts),
        np.concatenate([part.residual for part in parts]),
        np.vstack(jacobians) if jacobians else None,
        np.concatenate([part.factor for part in parts]),
    )


def residual_rows(episode: Episode, whitening: Innovations | None, result: EpisodeResult, threshold: float) -> Rows:
    """Whitened residual of one episode: by sensor noise, or by the frozen Kalman filter where one is given.

    Constant sensor errors count as noise, see `ConstantErrors`.
    """
    by_constants = slopes_by_constants(episode.samples)
    if whitening is None and not by_constants.shape[1]:
        return joined(episode.samples, result, threshold)
    plain = joined(episode.samples, result)
    columns = plain.residual[:, None]
    if plain.jacobian is not None:
        columns = np.hstack([columns, plain.jacobian])
    if whitening is not None:
        columns, by_constants = _innovations(whitening, columns, by_constants, result.push)
    if by_constants.shape[1]:
        columns = ConstantErrors.of(by_constants).whitened(columns)
    cost, factor = huber(columns[:, 0], threshold)
    columns = factor[:, None] * columns
    return Rows(cost, columns[:, 0], None if plain.jacobian is None else columns[:, 1:], factor)


def _innovations(
    whitening: Innovations, columns: Array, by_constants: Array, push: Array | None
) -> tuple[Array, Array]:
    """Columns and slopes by constant errors of sensors, which drive nothing, turned into innovations."""
    kept, more = columns.shape[1], by_constants.shape[1]
    if push is not None:
        push = np.pad(push, ((0, 0), (0, 0), (0, more)))
    made = whitening.whitened(np.hstack([columns, by_constants]), push)[0]
    return made[:, :kept], made[:, kept:]

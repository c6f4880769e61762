"""The residual of an estimation problem: its layout, and its value and derivative at one point."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.display import ReprLineAndTableRows, ReprMixin, count_with_noun
from yid_ocp.problem.episodes import Episode, EpisodePrediction, InputErrorModel
from yid_ocp.problem.measurements import (
    ResidualAndJacobian,
    SensorMeasurements,
    huber_loss_and_residual_factors,
    whitened_for_sensor_biases,
    whitened_measurement_sensitivities_to_biases,
)

EquilibriumGuesses = tuple[Array | None, ...]
"""For each recording, a configuration near the equilibrium from which it starts; None where it is not known."""


class ProcessNoiseWhitener(Protocol):
    """Interface of a Kalman filter with fixed gains that whitens one recording's residual, with process noise."""

    @property
    def input_error_model(self) -> InputErrorModel:
        """Standard deviations of torque and angle errors, and the errors about which the filter is linearized."""
        ...

    def whiten_and_estimate_torque_bias(self, rows: Array, push: Array | None) -> tuple[Array, Array]:
        """Whiten residual and derivatives; return them (r, c) and estimated constant torque errors (nu, c) [N m].

        Of `rows` (r, c), a residual in units of the sensors' noise and columns of its derivative, and `push`
        (N, nu, c), the tracking filter's correction of the torque and its derivative [N m].
        """
        ...


@dataclass(frozen=True)
class ResidualVectorLayout:
    """Slices of the residual vector: measurements of all episodes, then stated priors, then weak priors."""

    measurements: tuple[tuple[slice, ...], ...]  # slices by episode and sensor group
    data: slice
    stated_priors: slice
    weak_priors: slice

    @property
    def slice_without_weak_priors(self) -> slice:
        """Slice of the residual vector with data and stated priors, without weak priors."""
        return slice(0, self.stated_priors.stop)

    @staticmethod
    def from_episodes(episodes: Sequence[Episode], stated: int, weak: int) -> ResidualVectorLayout:
        """Build the layout from the episodes' measurements and the numbers of stated and weak priors."""
        at, groups = 0, []
        for episode in episodes:
            own = []
            for samples in episode.measurements:
                own.append(slice(at, at + samples.n_residuals))
                at += samples.n_residuals
            groups.append(tuple(own))
        last = at + stated
        return ResidualVectorLayout(tuple(groups), slice(0, at), slice(at, last), slice(last, last + weak))


@dataclass(frozen=True, repr=False)
class Evaluation(ReprMixin):
    """Result of evaluating an estimation problem at one unknown vector: cost, residual, Jacobian, predictions."""

    cost: float  # 1/2 |r|^2, or the robust loss; infinite where the rollout failed
    residual: Array  # (nr,)
    jacobian: Array | None  # (nr, nx)
    ok: bool
    message: str
    episode_predictions: tuple[EpisodePrediction, ...]

    def _summary(self) -> ReprLineAndTableRows:
        slopes = "" if self.jacobian is None else f", by {count_with_noun(self.jacobian.shape[1], 'unknown')}"
        said = f"cost {self.cost:.6g} of {count_with_noun(len(self.residual), 'residual')}{slopes}"
        return ReprLineAndTableRows(said if self.ok else f"failed, {self.message}")

    @property
    def equilibrium_guesses(self) -> EquilibriumGuesses:
        """Initial equilibrium of each episode, as a guess for evaluating a nearby point."""
        return tuple(result.equilibrium_guess for result in self.episode_predictions)


EvaluateFunction = Callable[..., Evaluation]
"""Evaluates a problem at an unknown vector, with the arguments of `EstimationProblem.evaluate`."""


def _sensor_whitened_residual(
    measurements: Sequence[SensorMeasurements], result: EpisodePrediction, threshold: float = math.inf
) -> ResidualAndJacobian:
    """Residual of one recording in units of the sensors' noise, group after group."""
    slopes = result.output_sensitivities or (None,) * len(measurements)
    groups = zip(measurements, result.predicted_outputs, slopes, strict=True)
    parts = [samples.residual_and_jacobian(y, slope, threshold) for samples, y, slope in groups]
    jacobians = [part.jacobian for part in parts if part.jacobian is not None]
    return ResidualAndJacobian(
        sum(part.cost for part in parts),
        np.concatenate([part.residual for part in parts]),
        np.vstack(jacobians) if jacobians else None,
        np.concatenate([part.robust_factor for part in parts]),
    )


def whitened_episode_residual(
    episode: Episode, whitening: ProcessNoiseWhitener | None, result: EpisodePrediction, threshold: float
) -> ResidualAndJacobian:
    """Whitened residual of one episode, by sensor noise or by the Kalman filter `whitening` if it is given.

    Constant sensor errors count as noise, see `whitened_for_sensor_biases`.
    """
    by_constants = whitened_measurement_sensitivities_to_biases(episode.measurements)
    if whitening is None and not by_constants.shape[1]:
        return _sensor_whitened_residual(episode.measurements, result, threshold)
    plain = _sensor_whitened_residual(episode.measurements, result)
    columns = plain.residual[:, None]
    if plain.jacobian is not None:
        columns = np.hstack([columns, plain.jacobian])
    if whitening is not None:
        kept, push = columns.shape[1], result.torque_correction_and_sensitivity
        # constant errors of sensors drive nothing
        push = None if push is None else np.pad(push, ((0, 0), (0, 0), (0, by_constants.shape[1])))
        innovations, _ = whitening.whiten_and_estimate_torque_bias(np.hstack([columns, by_constants]), push)
        columns, by_constants = innovations[:, :kept], innovations[:, kept:]
    if by_constants.shape[1]:
        columns = whitened_for_sensor_biases(by_constants, columns)
    cost, factor = huber_loss_and_residual_factors(columns[:, 0], threshold)
    columns = factor[:, None] * columns
    return ResidualAndJacobian(cost, columns[:, 0], None if plain.jacobian is None else columns[:, 1:], factor)

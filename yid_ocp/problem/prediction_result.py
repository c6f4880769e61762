"""Results of predicting an episode: its initial state, rollout and predicted sensor readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.statics import Equilibrium
from yid_ocp.integrator.step import Rollout

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EpisodePrediction:
    """Rollout of one episode, its predicted sensor readings and their sensitivities.

    Attributes
    ----------
    equilibrium : Rest or None
        Equilibrium from which the rollout starts.
    predicted_outputs : tuple of ndarray, shape (M, k) each
        Prediction of every sample, in the sensor's unit.
    output_sensitivities : tuple of ndarray, shape (M, k, d) each, or None
    equilibrium_guess : ndarray, shape (n,), or None
        Configuration at `equilibrium`, the initial guess for similar parameters.
    torque_correction : ndarray, shape (N, nu), or None
        Torque that the tracking filter adds to the recorded one [N m], where encoders are measurements.
    torque_correction_sensitivity : ndarray, shape (N, nu, d), or None
        Its derivative, with `output_sensitivities`.
    """

    rollout: Rollout
    equilibrium: Equilibrium | None
    predicted_outputs: tuple[Array, ...]
    output_sensitivities: tuple[Array, ...] | None
    equilibrium_guess: Array | None = None
    torque_correction: Array | None = None
    torque_correction_sensitivity: Array | None = None

    @property
    def torque_correction_columns(self) -> Array | None:
        """`torque_correction` followed by the columns of its derivative where it is known, shape (N, nu, 1 + d)."""
        if self.torque_correction is None:
            return None
        known = self.torque_correction[:, :, None]
        return (
            known
            if self.torque_correction_sensitivity is None
            else np.concatenate([known, self.torque_correction_sensitivity], axis=2)
        )


@dataclass(frozen=True)
class InitialState:
    """Initial state of a rollout with its derivative.

    Attributes
    ----------
    state : ndarray, shape (nx,)
        (q, p, z)
    state_sensitivity : ndarray, shape (nx, d)
        Derivative by (wanted parameters, offset of the start).
    equilibrium : Rest or None
        The equilibrium, where it is one.
    failure_message : str
        What went wrong; empty where all is well.
    """

    state: Array
    state_sensitivity: Array
    equilibrium: Equilibrium | None
    failure_message: str

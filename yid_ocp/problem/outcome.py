"""Results of predicting an episode: its initial state, rollout and predicted sensor readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.statics import Rest
from yid_ocp.integrator.step import Rollout

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EpisodeResult:
    """Rollout of one episode, its predicted sensor readings and their sensitivities.

    Attributes
    ----------
    rollout : Rollout
    rest : Rest or None
        Equilibrium from which the rollout starts.
    predicted : tuple of ndarray, shape (M, k) each
        Prediction of every sample, in the sensor's unit.
    sensitivities : tuple of ndarray, shape (M, k, d) each, or None
    warm : ndarray, shape (n,), or None
        Configuration at `rest`, the initial guess for similar parameters.
    correction : ndarray, shape (N, nu), or None
        Torque that the tracking filter adds to the recorded one [N m], where encoders are measurements.
    by_correction : ndarray, shape (N, nu, d), or None
        Its derivative, with `sensitivities`.
    """

    rollout: Rollout
    rest: Rest | None
    predicted: tuple[Array, ...]
    sensitivities: tuple[Array, ...] | None
    warm: Array | None = None
    correction: Array | None = None
    by_correction: Array | None = None

    @property
    def push(self) -> Array | None:
        """`correction` followed by the columns of its derivative where it is known, shape (N, nu, 1 + d)."""
        if self.correction is None:
            return None
        known = self.correction[:, :, None]
        return known if self.by_correction is None else np.concatenate([known, self.by_correction], axis=2)


@dataclass(frozen=True)
class Start:
    """Initial state of a rollout with its derivative.

    Attributes
    ----------
    state : ndarray, shape (nx,)
        (q, p, z)
    by_unknowns : ndarray, shape (nx, d)
        Derivative by (wanted parameters, offset of the start).
    rest : Rest or None
        The equilibrium, where it is one.
    message : str
        What went wrong; empty where all is well.
    """

    state: Array
    by_unknowns: Array
    rest: Rest | None
    message: str

"""What predicting an episode leaves: where it begins, and what its sensors would have read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.statics import Rest
from yid_ocp.integrator.step import Rollout

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EpisodeResult:
    """Rollout of one episode and its prediction of every sample.

    Attributes
    ----------
    rollout : Rollout
    rest : Rest or None
        The equilibrium at which it started.
    predicted : tuple of ndarray, shape (M, k) each
        Prediction of every sample, in the sensor's unit.
    sensitivities : tuple of ndarray, shape (M, k, d) each, or None
    warm : ndarray, shape (n,), or None
        Configuration at `rest`, from which that of similar parameters is found quickly.
    correction : ndarray, shape (N, nu), or None
        What the tracking filter added to the recorded torque [N m], where encoders are measurements.
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
        """`correction` and, after it, its derivative where that is known, shape (N, nu, 1 + d)."""
        if self.correction is None:
            return None
        known = self.correction[:, :, None]
        return known if self.by_correction is None else np.concatenate([known, self.by_correction], axis=2)


@dataclass(frozen=True)
class Start:
    """Where a rollout begins.

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

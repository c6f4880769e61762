"""One step of a linear Kalman filter with its smoother, and a run of steps in compiled code.

References
----------
Bryson and Frazier (1963), Smoothing for linear and nonlinear dynamic systems, Aeronautical Systems Division report
TDR-63-119. Anderson and Moore (1979), Optimal Filtering, chapters 3 and 5.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.linalg.lapack
from numpy.typing import NDArray

from yid_ocp.arrays import Array
from yid_ocp.integrator.compiler import compile_and_load_library
from yid_ocp.integrator.step_model import out_of_memory_error


@dataclass(frozen=True)
class FilterStateTransition:
    """State transition x' = (M (s, p1 + ... + pg), f p) of a filter; x = (s, p) with g parameter groups p1 to pg."""

    state_rows: Array  # M, shape (ns, ns + m)
    decay: Array  # f, shape (nx - ns,), nx - ns = g m

    @property
    def _shape(self) -> tuple[int, int]:
        m = self.state_rows.shape[1] - len(self.state_rows)
        return len(self.decay) // m if m else 0, m

    def propagate_state(self, columns: Array) -> Array:
        """States (nx, c) after the step, from the states (nx, c) before it; each column is a state."""
        ns, rows, own = len(self.state_rows), self.state_rows, columns[len(self.state_rows) :]
        together = own.reshape(*self._shape, own.shape[1]).sum(axis=0)
        return np.vstack([rows[:, :ns] @ columns[:ns] + rows[:, ns:] @ together, self.decay[:, None] * own])

    def _propagate_costate_back(self, costate: Array) -> Array:
        """Costates before the step, from those after it, by the transposed map, as columns (nx, c)."""
        ns = len(self.state_rows)
        earlier = self.state_rows.T @ costate[:ns]
        apart = np.tile(earlier[ns:], (self._shape[0], 1)) + self.decay[:, None] * costate[ns:]
        return np.vstack([earlier[:ns], apart])


@dataclass(frozen=True)
class KalmanStepMatrices:
    """One step of a linear Kalman filter with fixed gains: a measurement update, then a state transition.

    A state x = (s, p) of s and parameters p is measured by y = H x + e with noise e of unit covariance, and goes on by
    x' = (M x, f p) + process noise. With the covariance P before the measurement and S = I + H P H', the normalized
    innovations S^(-1/2) (y - H mean) of all steps are independent, of unit variance.
    """

    observation: Array  # H, shape (r, nx)
    whitening: Array  # S^(-1/2), shape (r, r)
    projected_covariance: Array  # S^(-1/2) H P, shape (r, nx)
    transition: FilterStateTransition

    def normalized_innovations_and_next_mean(self, mean: Array, measured: Array) -> tuple[Array, Array]:
        """Normalized innovations (r, c) of the measurements (r, c), and the state means (nx, c) after the step."""
        white = self.whitening @ (measured - self.observation @ mean)
        return white, self.transition.propagate_state(mean + self.projected_covariance.T @ white)

    def smoothed_measurement_noise_and_costate(self, white: Array, costate: Array) -> tuple[Array, Array]:
        """Smoothed measurement noise (r, c), and the costate (nx, c) before the step, from the costate after it.

        The smoothed state is the filter's prediction + P costate.
        """
        pulled = self.transition._propagate_costate_back(costate)
        noise = self.whitening.T @ (white - self.projected_covariance @ pulled)
        return noise, pulled + self.observation.T @ noise

    def costate_covariance_before_step(self, information: Array) -> Array:
        """Covariance (nx, nx) of the costate before the step, from its covariance `information` after the step."""
        shaped, projected = self.whitening @ self.observation, self.projected_covariance
        pulled = self.transition._propagate_costate_back(self.transition._propagate_costate_back(information).T)
        pulled -= (pulled @ projected.T) @ shaped
        found = shaped.T @ shaped + pulled - shaped.T @ (projected @ pulled)
        return (found + found.T) / 2


def kalman_matrices_and_next_covariance(
    covariance: Array, observation: Array, transition: FilterStateTransition
) -> tuple[KalmanStepMatrices, Array, float]:
    """A filter step with fixed gains, the state covariance after it without process noise, and log det S.

    `covariance` is P (nx, nx) before the measurement by H (r, nx). The determinant is infinite, and S counts by its
    diagonal alone, where covariances differ by so many decades that rounding shows.
    """
    cross = observation @ covariance
    whitening, log_determinant = np.zeros((0, 0)), 0.0
    if len(observation):
        factor, failed = scipy.linalg.lapack.dpotrf(cross @ observation.T + np.eye(len(observation)), lower=1)
        if failed:
            factor = np.diag(np.sqrt(1.0 + np.maximum(np.sum(cross * observation, axis=1), 0.0)))
        whitening = scipy.linalg.lapack.dtrtri(factor, lower=1)[0]
        log_determinant = math.inf if failed else 2 * float(np.sum(np.log(np.diag(factor))))
    projected = whitening @ cross
    later = transition.propagate_state(transition.propagate_state(covariance - projected.T @ projected).T)
    return KalmanStepMatrices(observation, whitening, projected, transition), later, log_determinant


@cache
def _library() -> ctypes.CDLL | None:
    source = resources.files("yid_ocp.inference").joinpath("kalman.c").read_text(encoding="utf-8")
    return compile_and_load_library(source, level="-O2")


def kalman_matrices_and_final_covariance(
    covariance: Array,
    observation: Array,
    row_start: Sequence[int],
    moves: Array,
    noises: int,
    decay: Array,
    variance: Array,
) -> tuple[list[KalmanStepMatrices], Array]:
    """Successive filter steps with fixed gains, and the state covariance after the last; in compiled code if possible.

    `moves` (k, ns, ns + m + c) are the state rows of k steps' transitions and, beside them, what c unit `noises` add to
    the states; `decay` (k, nx - ns) is that of the parameters, `variance` (k, nx - ns) that of their process noise.
    Rows of the observation (r, nx) stand in the order of the steps, those of step j from `row_start[j]` to the next.
    """
    na, ns, library, steps = len(covariance), moves.shape[1], _library(), list[KalmanStepMatrices]()
    spans, known = [slice(*ends) for ends in pairwise(row_start)], moves.shape[2] - noises
    transitions = [FilterStateTransition(move[:, :known], own) for move, own in zip(moves, decay, strict=True)]
    if library is None:
        parameters = np.arange(ns, na)
        for k, (span, transition) in enumerate(zip(spans, transitions, strict=True)):
            step, covariance, _ = kalman_matrices_and_next_covariance(covariance, observation[span], transition)
            steps.append(step)
            covariance[parameters, parameters] += variance[k]
            covariance[:ns, :ns] += moves[k, :, known:] @ moves[k, :, known:].T
            covariance = 0.5 * (covariance + covariance.T)
        return steps, covariance
    size, squares = np.array([*moves.shape, na, known], np.int32), [(span.stop - span.start) ** 2 for span in spans]
    white, projected, covariance = np.empty(sum(squares)), np.empty_like(observation), covariance.copy()
    arrays: list[NDArray[Any]] = [size, np.array(row_start, np.int32)]
    arrays += [*map(np.ascontiguousarray, (moves, decay, variance, observation)), white, projected, covariance]
    if not library.yid_kalman_steps((ctypes.c_void_p * len(arrays))(*(array.ctypes.data for array in arrays))):
        raise out_of_memory_error("the work on one step of a filter", 4 * covariance.nbytes)
    for span, root, transition in zip(spans, np.split(white, np.cumsum(squares)[:-1]), transitions, strict=True):
        own = observation[span]
        steps.append(KalmanStepMatrices(own, root.reshape(len(own), len(own)), projected[span], transition))
    return steps, covariance

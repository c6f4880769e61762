"""Linear Kalman filter and fixed-interval smoother along frozen steps: whitening and weak constraints both use it.

A state x = (s, p) of s and parameters p is measured by y = H x + e with noise e of unit covariance, and goes on by
x' = (M x, f p) + process noise. With the covariance P before the measurement and S = I + H P H', the normalized
innovations S^(-1/2) (y - H mean) of all steps are independent, of unit variance.

References
----------
Anderson and Moore (1979), Optimal Filtering, chapters 3 and 5. Bryson and Frazier (1963), Smoothing for linear and
nonlinear dynamic systems, Aeronautical Systems Division report TDR-63-119. de Jong (1989), doi:10.2307/2290075.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.linalg.lapack

from yid_ocp.arrays import Array


@dataclass(frozen=True)
class FilterStateTransition:
    """Transition x' = (M x, f p) of the state x = (s, p), M (ns, nx) as `state_rows` and f (nx - ns,) as `decay`."""

    state_rows: Array
    decay: Array

    def propagate_state(self, columns: Array) -> Array:
        """States after the step, from those before it, as columns (nx, c)."""
        return np.vstack([self.state_rows @ columns, self.decay[:, None] * columns[len(self.state_rows) :]])

    def propagate_costate_back(self, costate: Array) -> Array:
        """Costates before the step, from those after it, by the transposed map, as columns (nx, c)."""
        ns = len(self.state_rows)
        earlier = self.state_rows.T @ costate[:ns]
        earlier[ns:] += self.decay[:, None] * costate[ns:]
        return earlier


@dataclass(frozen=True)
class KalmanStep:
    """Measurement update with fixed gains, and transition, of one step of a Kalman filter.

    They are H (r, nx) as `observation`, S^(-1/2) (r, r) as `whitening` and S^(-1/2) H P (r, nx) as
    `projected_covariance`.
    """

    observation: Array
    whitening: Array
    projected_covariance: Array
    transition: FilterStateTransition

    @property
    def normalized_observation_matrix(self) -> Array:
        """Measurement matrix H in units of the innovations' standard deviation, S^(-1/2) H, shape (r, nx)."""
        return self.whitening @ self.observation

    def update(self, mean: Array, measured: Array) -> tuple[Array, Array]:
        """Normalized innovations (r, c) of measured columns (r, c), and the mean (nx, c) after the step."""
        white = self.whitening @ (measured - self.observation @ mean)
        return white, self.transition.propagate_state(mean + self.projected_covariance.T @ white)

    def smooth_backward(self, white: Array, costate: Array) -> tuple[Array, Array]:
        """Smoothed measurement noise (r, c), and the costate (nx, c) before the step from that after it.

        The smoothed state is the filter's prediction + P costate.
        """
        pulled = self.transition.propagate_costate_back(costate)
        noise = self.whitening.T @ (white - self.projected_covariance @ pulled)
        return noise, pulled + self.observation.T @ noise

    def costate_covariance_before_step(self, information: Array) -> Array:
        """Covariance of the costate before the step, shape (nx, nx), from that after it."""
        shaped, projected = self.normalized_observation_matrix, self.projected_covariance
        pulled = self.transition.propagate_costate_back(self.transition.propagate_costate_back(information).T)
        pulled -= (pulled @ projected.T) @ shaped
        found = shaped.T @ shaped + pulled - shaped.T @ (projected @ pulled)
        return (found + found.T) / 2


def kalman_step_and_covariance(
    covariance: Array, observation: Array, transition: FilterStateTransition
) -> tuple[KalmanStep, Array, float]:
    """One filter step with fixed gains, the covariance after it (without process noise), and log det S.

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
    return KalmanStep(observation, whitening, projected, transition), later, log_determinant

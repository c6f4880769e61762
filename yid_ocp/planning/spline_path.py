"""Joint paths as splines with few coefficients that start and end at rest.

A spline of degree 5 with clamped ends lies within the hull of its control points, and so do its derivatives: limits on
these hold at all times, not at nodes alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

Array = NDArray[np.float64]

_SPLINE_DEGREE = 5
_N_REST_CONTROL_POINTS = 3  # control points alike at either end: no velocity and no acceleration there


@dataclass(frozen=True)
class SplinePath:
    """Spline path of joints from rest to rest: q(t) = first + sum_k basis_k(t) w_k, constant after `duration`.

    Attributes
    ----------
    duration : float
        [s]
    n_coefficients : int
        K, coefficients of each joint; the last one is its displacement at the end.
    """

    duration: float
    n_coefficients: int

    @property
    def knots(self) -> Array:
        """Knot vector of the spline [s]."""
        inner = np.linspace(0.0, self.duration, self._controls - _SPLINE_DEGREE + 1)
        return np.concatenate([np.zeros(_SPLINE_DEGREE), inner, np.full(_SPLINE_DEGREE, self.duration)])

    @property
    def _controls(self) -> int:
        return 2 * _N_REST_CONTROL_POINTS + self.n_coefficients - 1

    def control_point_matrix(self, order: int = 0) -> Array:
        """Matrix from the coefficients to the control points of a derivative, shape (..., K)."""
        spread = np.zeros((self._controls, self.n_coefficients))
        spread[_N_REST_CONTROL_POINTS : _N_REST_CONTROL_POINTS + self.n_coefficients - 1, :-1] = np.eye(
            self.n_coefficients - 1
        )
        spread[-_N_REST_CONTROL_POINTS:, -1] = 1.0
        knots = self.knots
        for i in range(order):
            degree = _SPLINE_DEGREE - i
            width = knots[degree + 1 + i : len(knots) - 1 - i] - knots[1 + i : len(knots) - degree - 1 - i]
            spread = degree * np.diff(spread, axis=0) / width[:, None]
        return spread

    def basis_values(self, t: Array, order: int = 0) -> Array:
        """Values of the basis functions, or of a derivative of them, at times, shape (N, K)."""
        knots = self.knots
        own = knots[order : len(knots) - order]
        inside = np.minimum(np.asarray(t, float), self.duration)
        values = BSpline(own, self.control_point_matrix(order), _SPLINE_DEGREE - order)(inside)
        return np.asarray(np.where((np.asarray(t) > self.duration)[:, None] & (order > 0), 0.0, values))

    def straight_line_coefficients(self, change: Array) -> Array:
        """Coefficients of a straight line in joint space with displacement `change` (nj,), shape (K, nj)."""
        t = np.linspace(0.0, self.duration, 200)
        s = t / self.duration
        smooth = s**3 * (10 - 15 * s + 6 * s**2)
        share = np.linalg.lstsq(self.basis_values(t)[:, :-1], smooth - self.basis_values(t)[:, -1], rcond=None)[0]
        return np.append(share, 1.0)[:, None] * np.asarray(change, float)[None, :]

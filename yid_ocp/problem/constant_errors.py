"""Sensor errors that are constant over a recording, as correlated noise of all its samples.

With U the residual's slopes by such errors of unit variance, its covariance is I + U U', and

    r' (I + U U')^(-1) r = |r - Q (1 - (1 + S^2)^(-1/2)) Q' r|^2,    U = Q S V'.

The same map whitens the Jacobian (generalised least squares), equivalent to estimating the errors with their priors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from yid_ocp.problem.measurements import Measurements

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ConstantErrors:
    """Noise model of constant sensor errors: SVD of the residual's sensitivities to errors of unit variance.

    Attributes
    ----------
    basis : ndarray, shape (r, m)
        Q
    size : ndarray, shape (m,)
        S
    turn : ndarray, shape (m, m)
        V'
    """

    basis: Array
    size: Array
    turn: Array

    @staticmethod
    def of(slopes: Array) -> ConstantErrors:
        """Model from the sensitivities of residuals of unit variance, shape (r, m)."""
        return ConstantErrors(*np.linalg.svd(slopes, full_matrices=False))

    def whitened(self, columns: Array) -> Array:
        """Whiten columns (a residual, its derivatives) by sensor noise and constant errors, shape (r, c)."""
        along = self.basis.T @ columns
        return np.asarray(columns - self.basis @ ((1 - 1 / np.sqrt(1 + self.size**2))[:, None] * along))

    def estimated(self, residual: Array) -> Array:
        """Estimate the errors, measured minus true, from a residual, prediction minus measurement, shape (m,)."""
        return np.asarray(-self.turn.T @ ((self.size / (1 + self.size**2)) * (self.basis.T @ residual)))


def slopes_by_constants(samples: Sequence[Measurements]) -> Array:
    """Sensitivities of whitened measurements to constant sensor errors [standard deviations], shape (r, m).

    Those of the residual, prediction minus measurement, have the opposite sign.
    """
    parts = [(s.weight * s.bias_std)[:, :, None] * np.eye(len(s.bias_std))[:, s.bias_std > 0] for s in samples]
    count, before = sum(part.shape[2] for part in parts), 0
    found = np.zeros((sum(s.count for s in samples), count))
    rows = 0
    for s, part in zip(samples, parts, strict=True):
        own = s.independent(part[s.seen])
        found[rows : rows + s.count, before : before + own.shape[1]] = own
        rows, before = rows + s.count, before + own.shape[1]
    return found


def without_constants(samples: Sequence[Measurements], predicted: Sequence[Array]) -> tuple[Measurements, ...]:
    """Measurements minus their constant errors as estimated from a prediction, with zero `bias_std`.

    Parameters
    ----------
    samples : sequence of Measurements
    predicted : sequence of ndarray, shape (M, k) each
    """
    slopes = slopes_by_constants(samples)
    if not slopes.shape[1]:
        return tuple(samples)
    residual = np.concatenate([s.whitened(y)[s.seen] for s, y in zip(samples, predicted, strict=True)])
    left = ConstantErrors.of(slopes).estimated(residual)
    made = []
    for s in samples:
        error, own = s.bias_std.copy(), s.bias_std > 0
        error[own] *= left[: np.count_nonzero(own)]
        left = left[np.count_nonzero(own) :]
        made.append(replace(s, value=s.value - error, bias_std=np.zeros_like(error)))
    return tuple(made)

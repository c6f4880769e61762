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
class ConstantErrorModel:
    """Noise model of constant sensor errors: SVD of the residual's sensitivities to errors of unit variance.

    Attributes
    ----------
    left_vectors : ndarray, shape (r, m)
        Q
    singular_values : ndarray, shape (m,)
        S
    right_vectors : ndarray, shape (m, m)
        V'
    """

    left_vectors: Array
    singular_values: Array
    right_vectors: Array

    @staticmethod
    def from_sensitivities(slopes: Array) -> ConstantErrorModel:
        """Model from the sensitivities of residuals of unit variance, shape (r, m)."""
        return ConstantErrorModel(*np.linalg.svd(slopes, full_matrices=False))

    def whiten(self, columns: Array) -> Array:
        """Whiten columns (a residual, its derivatives) by sensor noise and constant errors, shape (r, c)."""
        along = self.left_vectors.T @ columns
        return np.asarray(
            columns - self.left_vectors @ ((1 - 1 / np.sqrt(1 + self.singular_values**2))[:, None] * along)
        )

    def estimate_errors(self, residual: Array) -> Array:
        """Estimate the errors, measured minus true, from a residual, prediction minus measurement, shape (m,)."""
        return np.asarray(
            -self.right_vectors.T
            @ ((self.singular_values / (1 + self.singular_values**2)) * (self.left_vectors.T @ residual))
        )


def constant_error_sensitivities(samples: Sequence[Measurements]) -> Array:
    """Sensitivities of whitened measurements to constant sensor errors [standard deviations], shape (r, m).

    Those of the residual, prediction minus measurement, have the opposite sign.
    """
    parts = [(s.weight * s.bias_std)[:, :, None] * np.eye(len(s.bias_std))[:, s.bias_std > 0] for s in samples]
    count, before = sum(part.shape[2] for part in parts), 0
    found = np.zeros((sum(s.n_residuals for s in samples), count))
    rows = 0
    for s, part in zip(samples, parts, strict=True):
        own = s.decorrelate(part[s.is_used])
        found[rows : rows + s.n_residuals, before : before + own.shape[1]] = own
        rows, before = rows + s.n_residuals, before + own.shape[1]
    return found


def subtract_estimated_biases(samples: Sequence[Measurements], predicted: Sequence[Array]) -> tuple[Measurements, ...]:
    """Measurements minus their constant errors as estimated from a prediction, with zero `bias_std`.

    Parameters
    ----------
    predicted : sequence of ndarray, shape (M, k) each
    """
    slopes = constant_error_sensitivities(samples)
    if not slopes.shape[1]:
        return tuple(samples)
    residual = np.concatenate([s.whitened_residual(y)[s.is_used] for s, y in zip(samples, predicted, strict=True)])
    left = ConstantErrorModel.from_sensitivities(slopes).estimate_errors(residual)
    made = []
    for s in samples:
        error, own = s.bias_std.copy(), s.bias_std > 0
        error[own] *= left[: np.count_nonzero(own)]
        left = left[np.count_nonzero(own) :]
        made.append(replace(s, value=s.value - error, bias_std=np.zeros_like(error)))
    return tuple(made)

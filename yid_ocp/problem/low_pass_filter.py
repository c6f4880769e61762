"""The zero-phase low-pass filter of recorded paths and efforts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.interpolate
import scipy.signal
import scipy.sparse
import scipy.special
from numpy.typing import NDArray

from yid_ocp.errors import DataError

Array = NDArray[np.float64]

_MIN_CUTOFF_FRACTION = 1e-4  # of half the sampling rate; below it the filter's sections are singular to rounding
_FILTER_ORDER = 4
_MIN_RELATIVE_WEIGHT = 1e-4
"""Fraction of the largest weight below which weights are dropped in the filter's matrix."""


@dataclass(frozen=True)
class LowPassFilter:
    """Zero-phase low-pass filter (Butterworth of order 4, forward and backward) on an even clock.

    Attributes
    ----------
    cutoff : float
        Frequency at which the amplitude is halved in power twice over [Hz]; infinite for no filter.
    passes : int
        How many times the filter is applied.
    """

    cutoff: float
    passes: int = 1

    def __call__(self, t: Array, values: Array) -> Array:
        """Smoothed values at the same times; an uneven clock is resampled to its median step in between.

        Parameters
        ----------
        t : ndarray, shape (M,)
        values : ndarray, shape (M, k)
        """
        if not math.isfinite(self.cutoff):
            return values
        step = float(np.median(np.diff(t)))
        even = t[0] + step * np.arange(round((t[-1] - t[0]) / step) + 1)
        sections = self._sections(step)
        resampled = scipy.interpolate.interp1d(t, values, axis=0, bounds_error=False, fill_value="extrapolate")(even)
        pad = min(len(even) - 1, max(15, int(3 / (self.cutoff * step))))
        smooth = resampled
        for _ in range(self.passes):
            smooth = scipy.signal.sosfiltfilt(sections, smooth, axis=0, padlen=pad)
        return np.asarray(scipy.interpolate.CubicSpline(even, smooth, axis=0)(np.clip(t, even[0], even[-1])))

    def decorrelation_stride(self, step: float) -> int:
        """Number of samples, `step` [s] apart, after which filtered white noise is about uncorrelated: 1/(2 f step)."""
        return max(1, round(1 / (2 * self.cutoff * step))) if math.isfinite(self.cutoff) else 1

    @property
    def settling_time(self) -> float:
        """Settling time of the filter, during which ends of a record distort it: decay to a thousandth [s]."""
        decay = 2 * math.pi * self.cutoff * math.sin(math.pi / (2 * _FILTER_ORDER))
        return float(scipy.special.gammainccinv(self.passes, 1e-3)) / decay

    def noise_gains(self, step: float) -> tuple[float, float, float]:
        """Factors from white noise's std to that of the value, its rate [1/s] and its second rate [1/s^2]."""
        if not math.isfinite(self.cutoff):
            return 1.0, math.sqrt(0.5) / step, math.sqrt(6.0) / step**2
        response = self._response(step)
        rate = np.gradient(response, step)
        second = np.zeros_like(response)
        second[1:-1] = (response[2:] - 2 * response[1:-1] + response[:-2]) / step**2
        return float(np.linalg.norm(response)), float(np.linalg.norm(rate)), float(np.linalg.norm(second))

    def node_smoother(self, nodes: NDArray[np.int64], count: int, step: float) -> NodeSmoother:
        """Filter as a matrix for some of `count` nodes, `step` apart [s]; nodes beyond are left out.

        Values before node 1 and after the last node are taken as constant.
        """
        nodes = nodes[nodes < count]
        weight = _weights(self, step)
        reach = len(weight) // 2
        column = np.clip(nodes[:, None] + np.arange(-reach, reach + 1), 1, count - 1)
        row = np.broadcast_to(np.arange(len(nodes))[:, None], column.shape)
        values = np.broadcast_to(weight, column.shape)
        entries = scipy.sparse.coo_array((values.ravel(), (row.ravel(), column.ravel())), (len(nodes), count))
        return NodeSmoother(nodes, entries.tocsr())

    def _response(self, step: float) -> Array:
        """To an impulse in the middle, at an odd number of samples."""
        length = 2 * int(5 * self.passes / (self.cutoff * step)) + 101
        response = np.zeros(length)
        response[length // 2] = 1.0
        for _ in range(self.passes):
            response = scipy.signal.sosfiltfilt(self._sections(step), response)
        return np.asarray(response)

    def _sections(self, step: float) -> Array:
        nyquist = 0.5 / step
        least = _MIN_CUTOFF_FRACTION * nyquist
        if not least < self.cutoff < nyquist:
            raise DataError(
                f"path_cutoff = {self.cutoff:g} Hz",
                allowed=f"above {least:.2g} and below {nyquist:g} Hz for this recording",
            )
        return np.asarray(scipy.signal.butter(_FILTER_ORDER, self.cutoff / nyquist, output="sos"))


@dataclass(frozen=True)
class NodeSmoother:
    """Matrix that smooths values at chosen nodes and leaves the others unchanged.

    Attributes
    ----------
    nodes : ndarray of int, shape (M,)
    matrix : sparse array, shape (M, N)
        From values at all nodes.
    """

    nodes: NDArray[np.int64]
    matrix: scipy.sparse.csr_array

    def smooth(self, values: Array) -> Array:
        """Smooth values at all nodes, shape (N, ...)."""
        smooth = values.copy()
        smooth[self.nodes] = (self.matrix @ values.reshape(len(values), -1)).reshape(len(self.nodes), *values.shape[1:])
        return smooth

    def smoothing_adjoint(self, pull: Array) -> Array:
        """Adjoint of `smooth`: cost derivative by the input values from that by the smoothed ones, shape (N, k)."""
        passed = pull.copy()
        passed[self.nodes] = 0.0
        return np.asarray(passed + self.matrix.T @ pull[self.nodes])


@lru_cache(maxsize=16)
def _weights(low_pass: LowPassFilter, step: float) -> Array:
    """Of the samples about each, an odd number of them, which add up to one."""
    response = low_pass._response(step)
    middle = len(response) // 2
    reach = int(np.abs(np.flatnonzero(np.abs(response) > _MIN_RELATIVE_WEIGHT * response[middle]) - middle).max())
    weight = response[middle - reach : middle + reach + 1]
    return np.asarray(weight / weight.sum())


def effort_filter(cutoff: float) -> LowPassFilter:
    """Filter of measured and predicted efforts: two passes of the filter that smooths prescribed paths."""
    return LowPassFilter(cutoff, 2)

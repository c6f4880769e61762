"""A zero-phase low-pass filter and first-order lags of recorded and predicted signals."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.interpolate
import scipy.linalg.lapack
import scipy.sparse
import scipy.special

from yid_ocp.arrays import Array, IntArray
from yid_ocp.errors import DataError

_MIN_CUTOFF_FRACTION = 1e-4  # of half the sampling rate; below it, the filter's sections are numerically singular
_FILTER_ORDER = 4
_SLOW_EFFORT_CUTOFF_FRACTION = 0.25  # of the path cutoff
_MIN_RELATIVE_WEIGHT = 1e-4  # fraction of the largest weight below which weights are dropped in the filter's matrix


@dataclass(frozen=True)
class ZeroPhaseLowPassFilter:
    """A zero-phase low-pass filter for evenly spaced samples: Butterworth of order 4, run forward and backward."""

    cutoff: float  # frequency at which each pass halves the amplitude [Hz]; infinite for no filter
    passes: int = 1  # a pass is one run forward and one backward

    def __call__(self, t: Array, values: Array) -> Array:
        """Return smoothed `values` (M, k) at the times `t` (M,) [s]. Uneven times are resampled internally."""
        if not math.isfinite(self.cutoff):
            return values
        step = float(np.median(np.diff(t)))
        even = t[0] + step * np.arange(round((t[-1] - t[0]) / step) + 1)
        sections = self._sections(step)
        resampled = scipy.interpolate.interp1d(t, values, axis=0, bounds_error=False, fill_value="extrapolate")(even)
        pad = min(len(even) - 1, max(15, int(3 / (self.cutoff * step))))
        smooth = resampled
        for _ in range(self.passes):
            smooth = _filtered_both_ways(sections, smooth, pad)
        return np.asarray(scipy.interpolate.CubicSpline(even, smooth, axis=0)(np.clip(t, even[0], even[-1])))

    def decorrelation_stride_for_step(self, step: float) -> int:
        """Return the number of samples, `step` [s] apart, after which filtered white noise is nearly uncorrelated."""
        return max(1, round(1 / (2 * self.cutoff * step))) if math.isfinite(self.cutoff) else 1

    @property
    def end_distortion_duration(self) -> float:
        """The time [s] from the ends of a record at which their distortion has decayed to a thousandth."""
        decay = 2 * math.pi * self.cutoff * math.sin(math.pi / (2 * _FILTER_ORDER))
        return float(scipy.special.gammainccinv(self.passes, 1e-3)) / decay

    def noise_gains_of_value_and_rates(self, step: float) -> tuple[float, float, float]:
        """Compute the stds of filtered unit white noise and of its first [1/s] and second [1/s^2] derivatives."""
        if not math.isfinite(self.cutoff):
            return 1.0, math.sqrt(0.5) / step, math.sqrt(6.0) / step**2
        response = self._response(step)
        rate, second = np.gradient(response, step), np.zeros_like(response)
        second[1:-1] = (response[2:] - 2 * response[1:-1] + response[:-2]) / step**2
        return float(np.linalg.norm(response)), float(np.linalg.norm(rate)), float(np.linalg.norm(second))

    def node_smoother(self, nodes: IntArray, count: int, step: float) -> NodeValueSmoother:
        """Make a matrix filter that gives smoothed values at `nodes`, from values at `count` nodes `step` [s] apart.

        The filter does not use the value at node 0. The signal is constant before node 1 and after the last node.
        """
        nodes = nodes[nodes < count]
        return NodeValueSmoother(nodes, _smoothing_matrix(self, tuple(nodes.tolist()), count, step))

    def _response(self, step: float) -> Array:
        """Response to an impulse in the middle of an odd number of samples."""
        length = 2 * int(5 * self.passes / (self.cutoff * step)) + 101
        response = np.zeros((length, 1))
        response[length // 2] = 1.0
        for _ in range(self.passes):
            response = _filtered_both_ways(self._sections(step), response, 0)
        return response[:, 0]

    def _sections(self, step: float) -> Array:
        """Gain and the two feedback factors of every section, shape (order / 2, 3), by the bilinear transformation."""
        nyquist = 0.5 / step
        least = _MIN_CUTOFF_FRACTION * nyquist
        if not least < self.cutoff < nyquist:
            allowed = f"above {least:.2g} and below {nyquist:g} Hz (half the rate of these samples)"
            what = f"samples {step:.3g} s apart cannot be low-pass filtered at {self.cutoff:g} Hz"
            hint = f"set a problem.path_cutoff above {least:.2g} Hz"
            if self.cutoff >= nyquist:
                hint = f"set a problem.path_cutoff below {nyquist:g} Hz, or a smaller problem.time_step"
            raise DataError(what, where="problem.path_cutoff", allowed=allowed, hint=hint)
        warped = math.tan(math.pi / 2 * self.cutoff / nyquist)
        damping = 2 * warped * np.sin(np.pi / (2 * _FILTER_ORDER) * np.arange(1, _FILTER_ORDER, 2))
        scale = 1 + damping + warped**2
        return np.stack([warped**2 / scale, 2 * (warped**2 - 1) / scale, (1 - damping + warped**2) / scale], axis=1)


@dataclass(frozen=True)
class NodeValueSmoother:
    """A linear filter that smooths values at M of N nodes with a matrix (M, N) and keeps the others unchanged."""

    nodes: IntArray
    matrix: scipy.sparse.csr_array

    def smooth(self, values: Array) -> Array:
        """Smooth the values (N, ...), which are given at all nodes."""
        smooth = values.copy()
        smooth[self.nodes] = (self.matrix @ values.reshape(len(values), -1)).reshape(len(self.nodes), *values.shape[1:])
        return smooth

    def smoothing_adjoint(self, pull: Array) -> Array:
        """Convert a cost's gradient with respect to smoothed values to one with respect to inputs, both (N, k)."""
        passed = pull.copy()
        passed[self.nodes] = 0.0
        return np.asarray(passed + self.matrix.T @ pull[self.nodes])


@lru_cache(maxsize=16)
def _weights(low_pass: ZeroPhaseLowPassFilter, step: float) -> Array:
    """Filter weights of a sample and its neighbours, an odd number of weights whose sum is one."""
    response = low_pass._response(step)
    middle = len(response) // 2
    reach = int(np.abs(np.flatnonzero(np.abs(response) > _MIN_RELATIVE_WEIGHT * response[middle]) - middle).max())
    weight = response[middle - reach : middle + reach + 1]
    return np.asarray(weight / weight.sum())


@lru_cache(maxsize=16)  # two for each of eight recordings
def _smoothing_matrix(
    low_pass: ZeroPhaseLowPassFilter, nodes: tuple[int, ...], count: int, step: float
) -> scipy.sparse.csr_array:
    weight = _weights(low_pass, step)
    reach = len(weight) // 2
    column = np.clip(np.array(nodes, int)[:, None] + np.arange(-reach, reach + 1), 1, count - 1)
    row = np.broadcast_to(np.arange(len(nodes))[:, None], column.shape)
    values = np.broadcast_to(weight, column.shape)
    return scipy.sparse.coo_array((values.ravel(), (row.ravel(), column.ravel())), (len(nodes), count)).tocsr()


def zero_phase_effort_filter(cutoff: float) -> ZeroPhaseLowPassFilter:
    """Make the low-pass filter of measured and predicted efforts: two passes of the zero-phase filter of paths."""
    return ZeroPhaseLowPassFilter(cutoff, 2)


def slow_effort_filter(cutoff: float) -> ZeroPhaseLowPassFilter:
    """Make the filter of the slow part of efforts, whose faster part has much noise of accelerations.

    Where a joint moves as measured, its gear gives way to the slow part only, and only the slow part lags.
    """
    return ZeroPhaseLowPassFilter(_SLOW_EFFORT_CUTOFF_FRACTION * cutoff)


@dataclass(frozen=True)
class FirstOrderLag:
    """The first-order lags of k channels from input x to output z, T dz/dt = x - z, with derivatives by the T.

    With the time step h, E = exp(-h/T) and f = T/h (1 - E). At T = 0, E and f are zero, and z equals x. The methods for
    node values also allow a negative time constant T: then z leads x, with z = x - T dx/dt.
    """

    time_constant: Array  # T, (k,) [s]
    time_constant_sensitivity: Array  # (k, d)
    time_step: float  # h [s]
    slow_part: NodeValueSmoother | None = None  # what lags of the node values; None if all does

    def lagged_step_means(self, value: Array, slope: Array | None) -> tuple[Array, Array]:
        """Compute the lag's mean output z in each step, with derivatives, for inputs x (N, k) held over a step.

        The mean of step k is x_k + (z_k - x_k) f, where z_{k+1} = x_k + (z_k - x_k) E and z_0 = x_0, with E and f of
        the class. `slope` (N, k, d) is the derivative of x.
        """
        decay, share, decay_slope, share_slope = self._factors()
        gap = self._following(value, np.zeros(value.shape), decay) - value
        by_value = np.zeros((*value.shape, self.time_constant_sensitivity.shape[1])) if slope is None else slope
        by_time = self._following(np.zeros(value.shape), decay_slope * gap, decay)
        mean_by_time = (gap * share_slope + share * by_time)[:, :, None] * self.time_constant_sensitivity
        followed = self._following(by_value, np.zeros(by_value.shape), decay[:, None])
        return value + share * gap, by_value + share[:, None] * (followed - by_value) + mean_by_time

    def lagged_node_values(self, value: Array, slope: Array | None) -> tuple[Array, Array | None]:
        """Compute the lag's output at the nodes, with derivatives, for an input x (N, k) that is linear between nodes.

        The lag starts at node 1. The output is z_{k+1} = E z_k + (f - E) x_k + (1 - f) x_{k+1} or, for negative T, x -
        T dx/dt by central differences. `slope` (N, k, d) is dx, first by those of `time_constant_sensitivity`. With
        `slow_part`, x is what this smoother keeps, and the rest of the value is added to the output.
        """
        decay, share, _, _ = self._factors()
        lead, rates = np.minimum(self.time_constant, 0.0), _rates(len(value), self.time_step)
        slow = self._slow(value)
        followed = self._straight(slow, decay, share) - lead * (rates @ slow)
        if slope is None:
            return followed + (value - slow), None
        slow_slope = self._slow(slope)
        total = self._straight(slow_slope, decay[:, None], share[:, None]) + (slope - slow_slope)
        if np.any(lead):
            total -= lead[:, None] * (rates @ slow_slope.reshape(len(slope), -1)).reshape(slope.shape)
        width = self.time_constant_sensitivity.shape[1]
        total[:, :, :width] += self._by_time(slow, followed)[:, :, None] * self.time_constant_sensitivity
        return followed + (value - slow), total

    def lagged_node_values_adjoint(self, value: Array, pull: Array) -> tuple[Array, Array]:
        """Convert a cost's gradient `pull` (N, k) by lagged values to its gradients by the input and by parameters."""
        decay, share, _, _ = self._factors()
        lead, rates = np.minimum(self.time_constant, 0.0), _rates(len(value), self.time_step)
        slow = self._slow(value)
        by_time = self._by_time(slow, self._straight(slow, decay, share))
        direct = np.sum(pull * by_time, axis=0) @ self.time_constant_sensitivity
        back = pull.copy()
        back[1:] = _filtered(pull[:0:-1], decay)[::-1]
        passed = back.copy()
        passed[2:] *= 1 - share
        passed[1:-1] += (share - decay) * back[2:]
        passed -= rates.T @ (lead * pull)
        if self.slow_part is not None:
            passed = pull + self.slow_part.smoothing_adjoint(passed - pull)
        return passed, direct

    def _slow(self, value: Array) -> Array:
        return value if self.slow_part is None else self.slow_part.smooth(value)

    def _factors(self) -> tuple[Array, Array, Array, Array]:
        ratio = np.maximum(self.time_constant, 0.0) / self.time_step
        inverse = 1.0 / np.maximum(ratio, 1e-3)  # beyond it exp(-1/ratio) is zero
        decay = np.where(ratio > 1e-3, np.exp(-inverse), 0.0)
        decay_slope = decay * inverse**2 / self.time_step
        return decay, ratio * (1 - decay), decay_slope, (1 - decay - decay * inverse) / self.time_step

    def _by_time(self, value: Array, followed: Array) -> Array:
        """Derivative (N, k) of `lagged_node_values` by each channel's time constant."""
        decay, _, decay_slope, share_slope = self._factors()
        driven = np.zeros_like(value)
        driven[2:] = decay_slope * (followed[1:-1] - value[1:-1]) - share_slope * (value[2:] - value[1:-1])
        return np.where(self.time_constant < 0, -(_rates(len(value), self.time_step) @ value), _filtered(driven, decay))

    @staticmethod
    def _following(value: Array, extra: Array, decay: Array) -> Array:
        """z_k with z_{k+1} = x_k + (z_k - x_k) E + extra_k, z_0 = x_0."""
        driven = np.empty_like(value)
        driven[0] = value[0]
        driven[1:] = (1 - decay) * value[:-1] + extra[:-1]
        return _filtered(driven, decay)

    @staticmethod
    def _straight(value: Array, decay: Array, share: Array) -> Array:
        driven = value.copy()
        driven[2:] = (share - decay) * value[1:-1] + (1 - share) * value[2:]
        driven[1:] = _filtered(driven[1:], decay)
        return driven


def _filtered(driven: Array, decay: Array) -> Array:
    """z_k = E z_{k-1} + driven_k along the first axis, with each channel's E."""
    result = np.empty_like(driven)
    for i, factor in enumerate(np.ravel(decay)):
        result[:, i] = _with_feedback(driven[:, i], -factor)
    return result


def _with_feedback(driven: Array, *factors: float) -> Array:
    """z with z_k + sum_i factors_i z_{k-i} = driven_k along the first axis, from rest."""
    if not driven.size:  # LAPACK writes beyond arrays without columns
        return driven
    band = np.tile(np.array([[1.0], *([factor] for factor in factors)]), len(driven))
    return np.asarray(scipy.linalg.lapack.dtbtrs(band, driven, uplo="L")[0])


def _filtered_both_ways(sections: Array, values: Array, pad: int) -> Array:
    """Values (M, k) filtered forward and backward, after mirror extension by `pad` samples at each end."""
    smooth = np.concatenate([2 * values[0] - values[pad:0:-1], values, 2 * values[-1] - values[-2 : -2 - pad : -1]])
    for _ in range(2):
        start, smooth = smooth[0], smooth - smooth[0]
        for gain, *feedback in sections:
            smooth[2:] += 2 * smooth[1:-1] + smooth[:-2]
            smooth = _with_feedback(gain * smooth, *feedback)
        smooth = (smooth + start)[::-1]
    return smooth[pad : len(smooth) - pad]


@lru_cache(maxsize=16)
def _rates(count: int, time_step: float) -> scipy.sparse.csr_array:
    before, after = (np.clip(np.arange(count) + shift, 1, count - 1) for shift in (-1, 1))
    width = np.maximum(after - before, 1) * time_step
    width[0] = np.inf
    entries = np.concatenate([-1 / width, 1 / width])
    at = (np.tile(np.arange(count), 2), np.concatenate([before, after]))
    return scipy.sparse.coo_array((entries, at), shape=(count, count)).tocsr()

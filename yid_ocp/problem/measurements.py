"""The measurements of one sensor on rollout nodes: time grid, interpolation, whitening and constant errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.special
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array, BoolArray, IntArray
from yid_ocp.data.recording import Recording
from yid_ocp.errors import DataError
from yid_ocp.sensors import Sensor, SensorData
from yid_ocp.sensors.signal_filters import ZeroPhaseLowPassFilter

_MAX_STEPS = 200_000  # half an hour in steps of 10 ms; exceeded by a clock in milliseconds or with jumps
_MAX_STEPS_PER_SAMPLE = 500  # on average; a clock in milliseconds read as seconds needs a thousand


@dataclass(frozen=True)
class TimeGrid:
    """A uniform time grid of a rollout, t_k = start_time + k time_step [s] for k = 0..steps."""

    start_time: float
    time_step: float
    steps: int

    @property
    def node_times(self) -> Array:
        """The times of all nodes, shape (steps + 1,) [s]."""
        return np.asarray(self.start_time + self.time_step * np.arange(self.steps + 1), dtype=float)

    def preceding_node_and_fraction(self, t: ArrayLike) -> tuple[IntArray, Array]:
        """Find the node before each time, and the time since it as a fraction of a step (rounded within 1e-6 steps)."""
        position = (np.asarray(t, float) - self.start_time) / self.time_step
        near = np.rint(position)
        position = np.where(np.abs(position - near) < 1e-6, near, position)
        node = np.clip(np.floor(position).astype(np.int64), 0, self.steps - 1)
        return node, position - node


def rollout_time_grid(recording: Recording, time_step: float, duration: float | None = None) -> TimeGrid:
    """Make a time grid that spans the joint samples or, in a recording without joints, the first group.

    Raises `DataError` if the span has fewer than two steps, more than `_MAX_STEPS`, or too many steps per sample.
    """
    t = recording.all_groups[0].t
    span = float(t[-1] - t[0]) if duration is None else min(duration, float(t[-1] - t[0]))
    steps = math.floor(span / time_step + 1e-6)
    if steps > _MAX_STEPS or steps > _MAX_STEPS_PER_SAMPLE * len(t):
        what = f"{span:.3g} s of data with {len(t)} samples need {steps:.3g} time steps of {time_step:g} s, too many"
        allowed = f"at most {_MAX_STEPS} time steps, and {_MAX_STEPS_PER_SAMPLE} per sample"
        hint = "check that times are in seconds and do not jump, or set a larger problem.time_step or smaller duration"
        raise DataError(what, where=f"problem.time_step, recording '{recording.name}'", allowed=allowed, hint=hint)
    if steps < 2:
        what = f"{span:.3g} s of data are shorter than two time steps of {time_step:g} s"
        longer = "set a longer problem.duration" if span < t[-1] - t[0] else "record longer"
        hint = f"{longer}, or set problem.time_step: {span / 3:.2g}" if 0 < span == t[-1] - t[0] else longer
        allowed = f"at least {2 * time_step:g} s of data"
        raise DataError(what, where=f"recording '{recording.name}'", allowed=allowed, hint=hint)
    return TimeGrid(float(t[0]), time_step, steps)


ResidualWeightingName = Literal["whitened", "paper"]


@dataclass(frozen=True)
class ResidualAndJacobian:
    """A block of the residual vector, with its cost, Jacobian and robust loss factors."""

    cost: float  # half the sum of squares, or Huber's loss
    residual: Array  # (nr,)
    jacobian: Array | None  # (nr, d)
    robust_factor: Array  # already multiplied into residual and Jacobian, (nr,)


@dataclass(frozen=True)
class SensorMeasurements:
    """The M samples of a sensor's k outputs, located between rollout nodes, with weights and noise levels."""

    sensor: Sensor
    node: IntArray  # node before each sample, (M,), or (M, k) if outputs have different delays
    fraction: Array  # fraction of a step after `node`; predictions are interpolated linearly between nodes
    value: Array  # measured outputs, NaN if missing, (M, k)
    weight: Array  # factor from a difference to a residual, zero without measurement, (M, k)
    std: Array  # standard deviation of the noise, in the sensor's unit; NaN if unknown, (M, k)
    predictable_nodes: tuple[int, int]  # first and last node at which the sensor can be predicted
    bias_std: Array  # standard deviation of a constant error of every output, or zero, (k,)
    noise_correlation: Array | None = None  # noise correlation of a sample's outputs, if not independent, (M, k, k)
    change_by_clock: Array | None = None  # change of the outputs by one std of the clock offset, (M, k)
    smoothing_filter: ZeroPhaseLowPassFilter | None = None  # of the values, if their noise is autocorrelated by it

    @property
    def output_changes_per_bias_and_clock_std(self) -> Array:
        """The change (M, k, m) of the outputs that one std of each constant error or of the clock offset causes."""
        own = self.bias_std * np.eye(len(self.bias_std))[self.bias_std > 0]
        constant = np.broadcast_to(own.T, (len(self.value), *own.T.shape))
        return constant if self.change_by_clock is None else np.dstack([constant, self.change_by_clock])

    @property
    def channel_name_per_output(self) -> tuple[str, ...]:
        """The name of the channel to which each of the k outputs belongs."""
        return tuple(channel for channel in self.sensor.channel_names for _ in range(self.sensor.outputs_per_channel))

    @cached_property
    def evaluation_node_indices(self) -> IntArray:
        """The sorted indices of the nodes at which the sensor is predicted, for interpolation to the samples."""
        if self.node.ndim > 1:
            # including the neighbours needed for derivatives
            low = int(self.node.min(initial=self.predictable_nodes[1]))
            high = int(self.node.max(initial=self.predictable_nodes[0]))
            return np.arange(max(low - 1, self.predictable_nodes[0]), min(high + 2, self.predictable_nodes[1] + 1))
        return np.unique(np.concatenate([self.node, self.node[self.fraction > 0] + 1]))

    @property
    def positive_weight_mask(self) -> BoolArray:
        """The mask of measured outputs with positive weight, shape (M, k)."""
        return self.weight > 0

    @property
    def n_residuals(self) -> int:
        """The number of scalar residuals, which is the number of outputs with positive weight."""
        return int(np.count_nonzero(self.weight > 0))

    @cached_property
    def residual_decorrelation_matrix(self) -> scipy.sparse.csr_array | None:
        """The matrix R^(-1/2) (nr, nr) that decorrelates the nr normalised residuals. None if outputs are independent.

        R is the correlation matrix of the noise; only outputs of one sample are correlated. The whitening is zero-phase
        (ZCA; Kessy, Lewin and Strimmer 2018, doi:10.1080/00031305.2016.1277159).
        """
        if self.noise_correlation is None:
            return None
        seen = self.positive_weight_mask
        together = seen[:, :, None] & seen[:, None, :]
        size, turn = np.linalg.eigh(np.where(together, self.noise_correlation, np.eye(seen.shape[1])))
        blocks = (turn / np.sqrt(np.maximum(size, 1e-12))[:, None, :]) @ turn.transpose(0, 2, 1)
        place = np.cumsum(seen).reshape(seen.shape) - 1
        row, column = (np.broadcast_to(p, blocks.shape)[together] for p in (place[:, :, None], place[:, None, :]))
        return scipy.sparse.csr_array((blocks[together], (row, column)), shape=(self.n_residuals, self.n_residuals))

    def decorrelate_residual_rows(self, rows: Any) -> Any:
        """Decorrelate rows (nr,) or (nr, d), dense or sparse, that are in units of their standard deviations."""
        return rows if self.residual_decorrelation_matrix is None else self.residual_decorrelation_matrix @ rows

    def whitened_residual(self, predicted: Array) -> Array:
        """Compute the whitened residual (M, k), prediction minus measurement. It is zero where nothing was measured."""
        seen = self.positive_weight_mask
        plain = np.asarray(self.weight * np.where(seen, predicted - self.value, 0.0))
        plain[seen] = self.decorrelate_residual_rows(plain[seen])
        return plain

    def whitened_residual_adjoint(self, pull: Array) -> Array:
        """Convert a cost's gradient with respect to the residual to one with respect to the prediction, both (M, k)."""
        if self.residual_decorrelation_matrix is not None:
            pull = pull.copy()
            pull[self.positive_weight_mask] = self.residual_decorrelation_matrix.T @ pull[self.positive_weight_mask]
        return np.asarray(pull * self.weight)

    def residual_and_jacobian(
        self, predicted: Array, slopes: Array | None = None, threshold: float = math.inf
    ) -> ResidualAndJacobian:
        """Compute residuals with Huber weights, and the Jacobian if `slopes` (M, k, d) of the prediction are given."""
        raw = self.whitened_residual(predicted)
        cost, factor = huber_loss_and_sqrt_weights(raw, threshold)
        seen, jacobian = self.positive_weight_mask, None
        robust = factor[seen]
        if slopes is not None:
            jacobian = robust[:, None] * self.decorrelate_residual_rows(self.weight[seen][:, None] * slopes[seen])
        return ResidualAndJacobian(cost, robust * raw[seen], jacobian, robust)

    def shifted_earlier_by_delays(self, steps: Array) -> SensorMeasurements:
        """Shift samples earlier by each output's delay `steps` (k,), clipped to the predictable nodes."""
        position = np.clip((self.node + self.fraction)[:, None] - steps, *self.predictable_nodes)
        near = np.rint(position)
        position = np.where(np.abs(position - near) < 1e-9, near, position)
        first, last = self.predictable_nodes
        node = np.minimum(np.floor(position), max(last - 1, first)).astype(np.int64)
        return replace(self, node=node, fraction=position - node)

    def prediction_change_per_step(self, at_nodes: Array, unmoved: SensorMeasurements, steps: Array) -> Array:
        """Return the change of a prediction during one time step at each delayed sample, (M, k).

        For a sample at a node, it is the mean of the adjacent steps. `at_nodes` (len(nodes), k) is the prediction at
        `evaluation_node_indices`. `unmoved` are the measurements before their shift by `steps` (k,).
        """
        nodes, column = self.evaluation_node_indices, np.arange(at_nodes.shape[1])
        if not len(nodes):  # a short part may hold no sample of a slow sensor
            return np.zeros((0, at_nodes.shape[1]))
        place = self.node - nodes[0]

        def at(index: IntArray) -> Array:
            return np.asarray(at_nodes[np.clip(index, 0, len(nodes) - 1), column])

        on = np.isclose(self.fraction, np.rint(self.fraction), rtol=0, atol=1e-9)
        middle = place + np.rint(self.fraction).astype(np.int64)
        rate = np.where(on, (at(middle + 1) - at(middle - 1)) / 2, at(place + 1) - at(place))
        position, (first, last) = (unmoved.node + unmoved.fraction)[:, None] - steps, self.predictable_nodes
        return np.where((position < first - 1e-9) | (position > last + 1e-9), 0.0, rate)

    def interpolate_to_samples(self, at_nodes: Array) -> Array:
        """Interpolate values (len(nodes), ...) linearly from `evaluation_node_indices` to the samples, (M, ...)."""
        nodes = self.evaluation_node_indices
        column = () if self.node.ndim == 1 else (np.arange(at_nodes.shape[1]),)
        before = at_nodes[(np.searchsorted(nodes, self.node), *column)]
        after = at_nodes[(np.minimum(np.searchsorted(nodes, self.node + 1), len(nodes) - 1), *column)]
        fraction = self.fraction.reshape(*self.fraction.shape, *([1] * (at_nodes.ndim - self.fraction.ndim)))
        return np.where(fraction > 0, (1 - fraction) * before + fraction * after, before)

    def interpolation_adjoint(self, at_samples: Array) -> Array:
        """Apply the transpose of `interpolate_to_samples` to values (M, ...). The result is (len(nodes), ...)."""
        nodes = self.evaluation_node_indices
        result = np.zeros((len(nodes), *at_samples.shape[1:]))
        fraction = self.fraction.reshape(*self.fraction.shape, *([1] * (at_samples.ndim - self.fraction.ndim)))
        between = self.fraction > 0
        column = () if self.node.ndim == 1 else (np.broadcast_to(np.arange(self.node.shape[1]), self.node.shape),)
        np.add.at(result, (np.searchsorted(nodes, self.node), *column), (1 - fraction) * at_samples)
        after = np.searchsorted(nodes, self.node[between] + 1), *(own[between] for own in column)
        np.add.at(result, after, (fraction * at_samples)[between])
        return result


def measurements_located_on_grid(data: SensorData, grid: TimeGrid, where: str) -> SensorMeasurements:
    """Locate a sensor's samples between rollout nodes. Raises `DataError` if a noise level is not positive."""
    seen = np.isfinite(data.value)
    if np.any(seen & ~(data.std > 0)):
        key, allowed = data.sensor.group_name, f"numbers above 0 [{data.sensor.unit}]"
        what = f"{np.sum(seen & ~(data.std > 0))} of {np.sum(seen)} noise stds of {key} are zero or missing"
        at, hint = f"recording '{where}': {key}", f"set sensors.{key}.std: NUMBER"
        raise DataError(what, where=at, allowed=allowed, hint=hint)
    weight = np.where(seen, 1.0 / np.where(data.std > 0, data.std, 1.0), 0.0)
    node, fraction = grid.preceding_node_and_fraction(data.t)
    std = np.where(seen, data.std, np.nan)
    bias = np.zeros(data.value.shape[1]) if data.bias_std is None else data.bias_std
    span = data.predictable_nodes or (0, grid.steps)
    more = data.noise_correlation, data.change_by_clock, data.smoothing_filter
    return SensorMeasurements(data.sensor, node, fraction, data.value, weight, std, span, bias, *more)


def measurements_with_paper_weights(samples: SensorMeasurements, grid: TimeGrid) -> SensorMeasurements:
    """Weight measurements at the nearest nodes as Caldwell (2014) did: 0 at k = 0, 2 at the last node, else 1.

    The cost is sum_{k=1..N} 1/2 sigma_k |w_k - wbar_k|^2 + 1/2 |w_N - wbar_N|^2 for measured points wbar_k [m].
    """
    nearest_node = samples.node + (samples.fraction >= 0.5)
    weight = np.where(np.isfinite(samples.value), 1.0, 0.0)
    weight[nearest_node == 0] = 0.0
    weight[nearest_node == grid.steps] *= np.sqrt(2.0)
    none, exact = np.zeros(len(samples.bias_std)), np.zeros(len(nearest_node))
    made = replace(samples, node=nearest_node, fraction=exact, weight=weight, bias_std=none)
    return replace(made, noise_correlation=None, change_by_clock=None)


def huber_loss_and_sqrt_weights(residual: Array, scale: float) -> tuple[float, Array]:
    """Return the Huber loss, sum rho(r) of whitened residuals, and the least-squares factors sqrt(rho'(r)/r).

    Beyond `scale` [standard deviations] the loss is linear. An infinite `scale` gives plain least squares.
    """
    size = np.abs(residual)
    factor = np.where(size <= scale, 1.0, np.sqrt(scale / np.maximum(size, 1e-300)))
    return float(np.sum(scipy.special.huber(scale, residual))), factor


def whiten_with_extra_errors(columns: Array, spread: Array) -> Array:
    """Return (I + F F')^(-1/2) X, which whitens rows X of unit covariance for k further, independent errors.

    X (nr,) or (nr, c) is `columns`, a residual and its derivatives. F (nr, k) is `spread`; column j, if finite, is the
    change of the residual by one std of error j.
    """
    left, sizes, _ = np.linalg.svd(spread[:, np.isfinite(spread).all(axis=0)], full_matrices=False)
    return np.asarray(columns + (left * (1 / np.hypot(1.0, sizes) - 1)) @ (left.T @ columns))


def whitened_measurement_sensitivities_to_sensor_errors(samples: Sequence[SensorMeasurements]) -> Array:
    """Return derivatives (r, m) of whitened measurements with respect to sensor and clock errors of unit variance.

    Derivatives of the residual, prediction minus measurement, have the opposite sign.
    """
    parts = ((s, s.weight[:, :, None] * s.output_changes_per_bias_and_clock_std) for s in samples)
    blocks = (s.decorrelate_residual_rows(part[s.positive_weight_mask]) for s, part in parts)
    return np.asarray(scipy.linalg.block_diag(np.zeros((0, 0)), *blocks))


def measurements_minus_sensor_error_estimates(
    samples: Sequence[SensorMeasurements], predicted: Sequence[Array]
) -> tuple[SensorMeasurements, ...]:
    """Subtract from measurements the constant errors and clock offsets that predictions (M, k), one a sensor, show."""
    slopes = whitened_measurement_sensitivities_to_sensor_errors(samples)
    if not slopes.shape[1]:
        return tuple(samples)
    pairs = zip(samples, predicted, strict=True)
    residual = np.concatenate([s.whitened_residual(y)[s.positive_weight_mask] for s, y in pairs])
    columns, size, right = np.linalg.svd(slopes, full_matrices=False)
    left = -right.T @ ((size / (1 + size**2)) * (columns.T @ residual))  # errors, measured minus true, in stds
    made = []
    for s in samples:
        directions = s.output_changes_per_bias_and_clock_std
        own, left = left[: directions.shape[2]], left[directions.shape[2] :]
        none = np.zeros_like(s.bias_std)
        made.append(replace(s, value=s.value - directions @ own, bias_std=none, change_by_clock=None))
    return tuple(made)

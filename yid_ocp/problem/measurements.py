"""Measurements of one sensor on the nodes of a rollout: interpolation, weights, whitening, robust loss."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from yid_ocp.errors import DataError
from yid_ocp.problem.time_grid import TimeGrid
from yid_ocp.sensors import Sensor, SensorData

Array = NDArray[np.float64]
ResidualWeighting = Literal["whitened", "paper"]


@dataclass(frozen=True)
class ResidualBlock:
    """One block of a residual: robust cost, weighted residual and Jacobian.

    Attributes
    ----------
    cost : float
        Loss: half the sum of squares, or Huber's.
    residual : ndarray, shape (nr,)
    jacobian : ndarray, shape (nr, d), or None
    robust_factor : ndarray, shape (nr,)
        Robust weights, already multiplied into residual and Jacobian.
    """

    cost: float
    residual: Array
    jacobian: Array | None
    robust_factor: Array


@dataclass(frozen=True)
class Measurements:
    """Samples of one sensor, located between the nodes of a rollout, with weights and noise levels.

    Attributes
    ----------
    node : ndarray of int, shape (M,), or (M, k) where outputs are late by different times
        Node before each sample.
    fraction : ndarray, shape of `node`
        Fraction of a step beyond it; predictions are interpolated linearly between the two nodes.
    value : ndarray, shape (M, k)
        Measured outputs, NaN where there is none.
    weight : ndarray, shape (M, k)
        Factor that turns a difference into a residual, zero where there is no measurement.
    std : ndarray, shape (M, k)
        Standard deviation of the noise, in the sensor's unit; NaN where it is not known.
    predictable_nodes : (int, int)
        First and last node at which the sensor can be predicted.
    bias_std : ndarray, shape (k,)
        Standard deviation of a constant error of every output, in the sensor's unit; zero where there is none.
    noise_correlation : ndarray, shape (M, k, k), or None
        Of the noise of the outputs of one sample; None where they are independent.
    """

    sensor: Sensor
    node: NDArray[np.int64]
    fraction: Array
    value: Array
    weight: Array
    std: Array
    predictable_nodes: tuple[int, int]
    bias_std: Array
    noise_correlation: Array | None = None

    @property
    def channel_of_column(self) -> tuple[str, ...]:
        """Channel name of each of the k outputs."""
        return tuple(channel for channel in self.sensor.channel_names for _ in range(self.sensor.outputs_per_channel))

    @property
    def evaluation_nodes(self) -> NDArray[np.int64]:
        """Nodes at which the sensor function must be evaluated, sorted."""
        if self.node.ndim > 1:
            # with the neighbours that a slope needs
            low, high = (
                int(self.node.min(initial=self.predictable_nodes[1])),
                int(self.node.max(initial=self.predictable_nodes[0])),
            )
            return np.arange(max(low - 1, self.predictable_nodes[0]), min(high + 2, self.predictable_nodes[1] + 1))
        after = self.node[self.fraction > 0] + 1
        return np.unique(np.concatenate([self.node, after]))

    @property
    def is_used(self) -> NDArray[np.bool_]:
        """Mask of measured outputs with positive weight, shape (M, k)."""
        return self.weight > 0

    @property
    def n_residuals(self) -> int:
        """Number of residuals that the measurements yield."""
        return int(np.count_nonzero(self.weight > 0))

    @cached_property
    def decorrelation_matrix(self) -> scipy.sparse.csr_array | None:
        """Matrix R^(-1/2) that decorrelates normalized residuals, shape (nr, nr); None without correlation.

        R is the noise correlation of one sample's outputs; zero-phase (ZCA) whitening (Kessy, Lewin and Strimmer 2018,
        doi:10.1080/00031305.2016.1277159).
        """
        if self.noise_correlation is None:
            return None
        seen = self.is_used
        together = seen[:, :, None] & seen[:, None, :]
        size, turn = np.linalg.eigh(np.where(together, self.noise_correlation, np.eye(seen.shape[1])))
        blocks = (turn / np.sqrt(np.maximum(size, 1e-12))[:, None, :]) @ turn.transpose(0, 2, 1)
        place = np.cumsum(seen).reshape(seen.shape) - 1
        row, column = (np.broadcast_to(p, blocks.shape)[together] for p in (place[:, :, None], place[:, None, :]))
        return scipy.sparse.csr_array((blocks[together], (row, column)), shape=(self.n_residuals, self.n_residuals))

    def decorrelate(self, rows: Any) -> Any:
        """Decorrelate rows normalized by their standard deviations, shape (nr,) or (nr, d), dense or sparse."""
        return rows if self.decorrelation_matrix is None else self.decorrelation_matrix @ rows

    def whitened_residual(self, predicted: Array) -> Array:
        """Whitened residual, prediction minus measurement, zero where nothing was measured, shape (M, k)."""
        plain = np.asarray(self.weight * np.where(self.weight > 0, predicted - self.value, 0.0))
        if self.decorrelation_matrix is not None:
            plain[self.is_used] = self.decorrelation_matrix @ plain[self.is_used]
        return plain

    def whitening_adjoint(self, pull: Array) -> Array:
        """Adjoint of `whitened_residual`: derivative of a cost by the prediction from that by the residual, shape (M, k)."""
        if self.decorrelation_matrix is not None:
            pull = pull.copy()
            pull[self.is_used] = self.decorrelation_matrix.T @ pull[self.is_used]
        return np.asarray(pull * self.weight)

    def residual_block(
        self, predicted: Array, slopes: Array | None = None, threshold: float = math.inf
    ) -> ResidualBlock:
        """Residual block of these measurements with robust weights and, with slopes, its Jacobian.

        Parameters
        ----------
        predicted : ndarray, shape (M, k)
        slopes : ndarray, optional, shape (M, k, d)
            Derivative of the prediction by d directions.
        threshold : float
            Of Huber's loss [standard deviations].
        """
        raw = self.whitened_residual(predicted)
        cost, factor = huber_loss(raw, threshold)
        seen, jacobian = self.is_used, None
        robust = factor[seen]
        if slopes is not None:
            jacobian = robust[:, None] * self.decorrelate(self.weight[seen][:, None] * slopes[seen])
        return ResidualBlock(cost, robust * raw[seen], jacobian, robust)

    def delayed_by(self, steps: Array) -> Measurements:
        """The same samples shifted back by a delay of each output [steps], within the span.

        Parameters
        ----------
        steps : ndarray, shape (k,)
        """
        position = np.clip((self.node + self.fraction)[:, None] - steps, *self.predictable_nodes)
        near = np.rint(position)
        position = np.where(np.abs(position - near) < 1e-9, near, position)
        node = np.minimum(np.floor(position), max(self.predictable_nodes[1] - 1, self.predictable_nodes[0])).astype(
            np.int64
        )
        return replace(self, node=node, fraction=position - node)

    def prediction_rate(self, at_nodes: Array, unmoved: Measurements, steps: Array) -> Array:
        """Rate of change of a prediction per step for delayed samples, shape (M, k); at a node the mean of both sides.

        Parameters
        ----------
        at_nodes : ndarray, shape (len(nodes), k)
        unmoved : Measurements
            The measurements before the delay.
        steps : ndarray, shape (k,)
        """
        nodes, column = self.evaluation_nodes, np.arange(at_nodes.shape[1])
        if not len(nodes):  # a short piece may hold no sample of a slow sensor
            return np.zeros((0, at_nodes.shape[1]))
        place = self.node - nodes[0]

        def at(index: NDArray[np.int64]) -> Array:
            return np.asarray(at_nodes[np.clip(index, 0, len(nodes) - 1), column])

        on = np.isclose(self.fraction, np.rint(self.fraction), rtol=0, atol=1e-9)
        middle = place + np.rint(self.fraction).astype(np.int64)
        rate = np.where(on, (at(middle + 1) - at(middle - 1)) / 2, at(place + 1) - at(place))
        position = (unmoved.node + unmoved.fraction)[:, None] - steps
        return np.where(
            (position < self.predictable_nodes[0] - 1e-9) | (position > self.predictable_nodes[1] + 1e-9), 0.0, rate
        )

    def interpolate(self, at_nodes: Array) -> Array:
        """Interpolate values at `evaluation_nodes`, shape (len(nodes), ...), to the samples, shape (M, ...)."""
        nodes = self.evaluation_nodes
        column = () if self.node.ndim == 1 else (np.arange(at_nodes.shape[1]),)
        before = at_nodes[(np.searchsorted(nodes, self.node), *column)]
        after = at_nodes[(np.minimum(np.searchsorted(nodes, self.node + 1), len(nodes) - 1), *column)]
        fraction = self.fraction.reshape(*self.fraction.shape, *([1] * (at_nodes.ndim - self.fraction.ndim)))
        return np.where(fraction > 0, (1 - fraction) * before + fraction * after, before)

    def interpolation_adjoint(self, at_samples: Array) -> Array:
        """Transpose of `interpolate`, shape (M, ...) to (len(nodes), ...)."""
        nodes = self.evaluation_nodes
        result = np.zeros((len(nodes), *at_samples.shape[1:]))
        fraction = self.fraction.reshape(*self.fraction.shape, *([1] * (at_samples.ndim - self.fraction.ndim)))
        between = self.fraction > 0
        place = np.searchsorted(nodes, self.node)
        if self.node.ndim == 1:
            np.add.at(result, place, (1 - fraction) * at_samples)
            np.add.at(result, np.searchsorted(nodes, self.node[between] + 1), (fraction * at_samples)[between])
            return result
        column = np.broadcast_to(np.arange(self.node.shape[1]), self.node.shape)
        np.add.at(result, (place, column), (1 - fraction) * at_samples)
        np.add.at(result, (place[between] + 1, column[between]), (fraction * at_samples)[between])
        return result


def place_on_grid(data: SensorData, grid: TimeGrid, where: str) -> Measurements:
    """Locate a sensor's data on the nodes of a rollout; raises `DataError` where a noise level is not positive."""
    seen = np.isfinite(data.value)
    if np.any(seen & ~(data.std > 0)):
        raise DataError(
            "a noise level is zero or missing",
            where=f"{where}: {data.sensor.group_name}",
            allowed="a positive standard deviation",
            hint="set it under `sensors`",
        )
    weight = np.where(seen, 1.0 / np.where(data.std > 0, data.std, 1.0), 0.0)
    node, fraction = grid.node_and_fraction(data.t)
    std = np.where(seen, data.std, np.nan)
    bias = np.zeros(data.value.shape[1]) if data.bias_std is None else data.bias_std
    return Measurements(
        data.sensor,
        node,
        fraction,
        data.value,
        weight,
        std,
        data.predictable_nodes or (0, grid.steps),
        bias,
        data.noise_correlation,
    )


def with_paper_weights(samples: Measurements, grid: TimeGrid) -> Measurements:
    """Measurements with the source paper's weights: 1 at the nearest node, 0 at k = 0, the last node counted twice.

    J = sum_{k=1..N} 1/2 sigma_k |w_k - wbar_k|^2 + 1/2 |w_N - wbar_N|^2 for measured points [m^2].
    """
    nearest_node = samples.node + (samples.fraction >= 0.5)
    weight = np.where(np.isfinite(samples.value), 1.0, 0.0)
    weight[nearest_node == 0] = 0.0
    weight[nearest_node == grid.steps] *= np.sqrt(2.0)
    none, exact = np.zeros(len(samples.bias_std)), np.zeros(len(nearest_node))
    return replace(samples, node=nearest_node, fraction=exact, weight=weight, bias_std=none, noise_correlation=None)


def huber_loss(residual: Array, scale: float) -> tuple[float, Array]:
    """Return Huber's loss of whitened residuals and the factors that turn residuals into a weighted least squares.

    Parameters
    ----------
    residual : ndarray, shape (nr,)
    scale : float
        Residual beyond which the loss grows linearly [standard deviations]; infinite for plain squares.

    Returns
    -------
    cost : float
        sum of rho(r)
    factor : ndarray, shape (nr,)
        Square root of rho'(r)/r.
    """
    size = np.abs(residual)
    inside = size <= scale
    with np.errstate(invalid="ignore"):
        cost = np.where(inside, 0.5 * residual**2, scale * (size - 0.5 * scale) if np.isfinite(scale) else 0.0)
    factor = np.where(inside, 1.0, np.sqrt(scale / np.maximum(size, 1e-300)))
    return float(np.sum(cost)), factor

"""Trajectory about which a recording's residual is linearized, and the residual's slopes by its states and efforts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.step import Rollout, TrackingFeedback
from yid_ocp.problem.episode_prediction import EpisodePredictor
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.measurements import Measurements
from yid_ocp.problem.model_functions import ModelFunctions
from yid_ocp.problem.prediction_result import EpisodePrediction

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NominalTrajectory:
    """Nominal trajectory of an episode and its measurements, about which residuals are linearized.

    Attributes
    ----------
    theta : ndarray, shape (ntheta,)
    measurements : sequence of Measurements
        Shifted by their delays to the times at which they were true.
    joint_efforts : ndarray, shape (N + 1, n)
        Of prescribed and driven joints.
    initial_state_by_angles, initial_state_by_torque : ndarray, shape (nx, nu)
        Derivatives of the start by the first angles and the first torque of the driven joints, zero where it does not
        follow from them.
    """

    model_functions: ModelFunctions
    theta: Array
    rollout: Rollout
    measurements: Sequence[Measurements]
    tracking_feedback: TrackingFeedback | None
    joint_efforts: Array
    initial_state_by_angles: Array
    initial_state_by_torque: Array


def nominal_trajectory(
    predictor: EpisodePredictor, episode: Episode, result: EpisodePrediction, theta: Array
) -> NominalTrajectory:
    """Trajectory of an episode about which its residual is linearized."""
    own, rest, sizes = predictor.episode_theta(episode, theta), result.equilibrium, predictor.step.sizes
    by_angles = by_torque = np.zeros((sizes["nx"], sizes["nu"]))
    if rest is not None:
        by_angles, by_torque = rest.state_by_known_coordinates[:, : sizes["nu"]], rest.state_by_torque
    return NominalTrajectory(
        predictor.model_functions,
        own,
        result.rollout,
        [predictor.measurements_at_true_times(samples, own) for samples in episode.measurements],
        episode.tracking_feedback,
        predictor.joint_efforts(result.rollout),
        by_angles,
        by_torque,
    )


@dataclass(frozen=True)
class ResidualSlopes:
    """Slopes of a recording's residual, in units of the sensors' noise, at the two nodes about each of its r rows.

    Attributes
    ----------
    node : ndarray of int, shape (r,)
        Node before the row.
    before, after : ndarray, shape (r, nx)
        By the states of that node and of the next, their shares of the interpolation included.
    by_effort_before, by_effort_after : ndarray, shape (r, nc)
        By the efforts of prescribed joints there.
    """

    node: NDArray[np.int64]
    before: Array
    after: Array
    by_effort_before: Array
    by_effort_after: Array

    @staticmethod
    def along(course: NominalTrajectory) -> ResidualSlopes:
        """From the sensors' own derivatives along the trajectory."""
        step, theta, state = course.model_functions.step, course.theta, course.rollout.state
        n, nx, fixed = step.sizes["n"], step.sizes["nx"], list(step.system.prescribed_indices)
        found: list[NDArray[np.int64]] = []
        parts: list[tuple[Array, ...]] = []
        for samples in course.measurements:
            used = samples.evaluation_nodes
            function = course.model_functions.compiled_sensor(samples.sensor, ())
            _, by_q, by_z, by_load, _ = function(
                state[used, :n], state[used, 2 * n :], course.joint_efforts[used], theta
            )
            slopes = np.zeros((len(used), by_q.shape[1], nx))
            slopes[:, :, :n], slopes[:, :, 2 * n :] = by_q, by_z
            sample, column = np.nonzero(samples.is_used)
            at = (sample, column) if samples.node.ndim > 1 else (sample,)
            node, fraction, weight = samples.node[at], samples.fraction[at], samples.weight[sample, column]
            place = np.searchsorted(used, node)
            later, shares = np.minimum(place + 1, len(used) - 1), (weight * (1 - fraction), weight * fraction)
            nodes = ((place, shares[0]), (later, shares[1]))
            by_state = (samples.decorrelate(share[:, None] * slopes[k, column]) for k, share in nodes)
            by_effort = (samples.decorrelate(share[:, None] * by_load[k, column][:, fixed]) for k, share in nodes)
            found.append(np.minimum(node, len(course.rollout.torque)))
            parts.append((*by_state, *by_effort))
        arrays = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        return ResidualSlopes(np.concatenate(found), *arrays)

    @property
    def visible_states(self) -> NDArray[np.bool_]:
        """States that a residual depends on, shape (nx,)."""
        return np.any(self.before != 0, axis=0) | np.any(self.after != 0, axis=0)

    def by_some_states(self, kept: NDArray[np.int64]) -> ResidualSlopes:
        """The slopes by some of the states alone."""
        return replace(self, before=self.before[:, kept], after=self.after[:, kept])

    def some_rows(self, rows: NDArray[np.int64]) -> ResidualSlopes:
        """Some of the rows alone."""
        slopes = (self.before, self.after, self.by_effort_before, self.by_effort_after)
        return ResidualSlopes(self.node[rows], *(array[rows] for array in slopes))

    def response(self, by_node: Array, effort: Array, first: int) -> Array:
        """Slopes of the rows by d directions, shape (r, d).

        Parameters
        ----------
        by_node : ndarray, shape (K, nx, d)
            Slopes of the states of K nodes from `first` on; a row beyond them is read at the last.
        effort : ndarray, shape (K, nc, d)
            Of the efforts of prescribed joints.
        """
        found = np.zeros((len(self.node), by_node.shape[2]))
        pairs = ((0, self.before, self.by_effort_before), (1, self.after, self.by_effort_after))
        for shift, by_state, by_effort in pairs:
            used = np.flatnonzero(by_state.any(axis=1) | by_effort.any(axis=1))
            local = np.minimum(self.node[used] + shift - first, len(by_node) - 1)
            found[used] += np.einsum("rx,rxd->rd", by_state[used], by_node[local])
            if effort.shape[1]:
                found[used] += np.einsum("rx,rxd->rd", by_effort[used], effort[local])
        return found

    def rows_by_node(self, last: int) -> list[NDArray[np.int64]]:
        """Rows of each node from 0 to `last`."""
        order = np.argsort(self.node, kind="stable")
        return np.split(order, np.searchsorted(self.node[order], np.arange(1, last + 1)))

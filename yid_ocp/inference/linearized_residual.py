"""A linear model of the residual along a trajectory, with bounded steps and predicted cost reductions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize

from yid_ocp.arrays import Array, IntArray
from yid_ocp.errors import DataError
from yid_ocp.integrator.step_model import Rollout, TrackingFeedback
from yid_ocp.problem.episode_prediction import EpisodePredictor
from yid_ocp.problem.episodes import Episode, EpisodePrediction
from yid_ocp.problem.estimation_problem import EstimationProblem
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.problem.measurements import SensorMeasurements
from yid_ocp.problem.model_functions import ModelFunctions, NodeStateValues


@dataclass(frozen=True)
class NominalTrajectory:
    """The simulated trajectory of a recording about which its residual is linearized, with the measurements.

    Measurements are shifted by their delays to the times at which they were true. `initial_state_by_angles` and
    `initial_state_by_torque` (nx, nu) are derivatives of the initial state with respect to the driven joints' first
    angles and torques. They are zero if the initial state does not depend on these.
    """

    model_functions: ModelFunctions
    theta: Array
    rollout: Rollout
    measurements: Sequence[SensorMeasurements]
    tracking_feedback: TrackingFeedback | None
    rollout_node_values: NodeStateValues
    initial_state_by_angles: Array
    initial_state_by_torque: Array


def nominal_trajectory_from_prediction(
    predictor: EpisodePredictor, episode: Episode, result: EpisodePrediction, theta: Array
) -> NominalTrajectory:
    """Create the nominal trajectory of a recording from its prediction at the parameters `theta`."""
    own = predictor.theta_with_episode_values(episode, theta)
    rest = result.equilibrium
    sizes = predictor.integrator_step.sizes
    by_angles = by_torque = np.zeros((sizes["nx"], sizes["nu"]))
    if rest is not None:
        by_angles, by_torque = rest.state_by_known_coordinates[:, : sizes["nu"]], rest.state_by_torque
    samples = [predictor.delay_corrected_measurements(samples, own) for samples in episode.measurements]
    about = samples, episode.tracking_feedback, predictor.rollout_node_values(result.rollout)
    return NominalTrajectory(predictor.model_functions, own, result.rollout, *about, by_angles, by_torque)


@dataclass(frozen=True)
class ResidualDerivativesByStateAndEffort:
    """The derivatives of r residuals with respect to the states and efforts at the nodes around each sample.

    Residuals are in units of sensor noise. Each is interpolated between two nodes, and depends on two or four nodes.
    """

    node: IntArray  # first of each row's nodes, shape (r,)
    by_state: Array  # derivatives by the states of this and the next nodes, shape (2 or 4, r, nx)
    by_effort: Array  # by efforts of prescribed joints (and constraint forces if 4), (2 or 4, r, ne)

    @staticmethod
    def from_nominal_trajectory(
        trajectory: NominalTrajectory, *, with_neighbours: bool = False
    ) -> ResidualDerivativesByStateAndEffort:
        """Compute the residual derivatives from the derivatives of the sensors along a nominal trajectory.

        `with_neighbours` is required for a sensor of velocities, accelerations or constraint forces, which depends on
        four nodes (the first one is before the sample's node). Raises `DataError` without it.
        """
        step, theta = trajectory.model_functions.step, trajectory.theta
        n, nx, fixed = step.sizes["n"], step.sizes["nx"], list(step.system.prescribed_coordinate_indices)
        found, parts = list[IntArray](), list[tuple[Array, ...]]()
        readings = []
        for samples in trajectory.measurements:
            read_sensor = trajectory.model_functions.compiled_sensor_function(samples.sensor)
            values = trajectory.rollout_node_values.select_nodes(samples.evaluation_node_indices)
            readings.append(read_sensor(values, theta))
        n_forces, width = (step.sizes["m"], 4) if any(read.needs_neighbours for read in readings) else (0, 2)
        for samples, read in zip(trajectory.measurements, readings, strict=True):
            used = samples.evaluation_node_indices
            if read.needs_neighbours and not with_neighbours:
                name = samples.sensor.group_name
                message = f"the Kalman filter for noisy torques cannot use '{name}', because it measures no positions"
                allowed = "sensors of positions, such as points and encoders"
                hint = f"set sensors.{name}.use: false, or model.arms.mode: prescribed"
                raise DataError(message, where=f"sensors.{name}", allowed=allowed, hint=hint)
            # derivatives of each reading by the states and efforts of the previous node, its own and the next
            before = 1 if read.needs_neighbours else 0
            slopes = np.zeros((2 * before + 1, *read.output.shape, nx))
            slopes[before, :, :, :n], slopes[before, :, :, 2 * n :] = read.by_q, read.by_z
            for order, by_rate, stencil in ((1, read.by_v, (-0.5, 0.0, 0.5)), (2, read.by_a, (1.0, -2.0, 1.0))):
                if by_rate.shape[2]:
                    slopes[:, :, :, :n] += np.multiply.outer(np.array(stencil) / step.time_step**order, by_rate)
            efforts = np.zeros((*read.output.shape, len(fixed) + n_forces))
            efforts[:, :, : len(fixed)] = read.by_load[:, :, fixed]
            if read.by_lam.shape[2]:
                efforts[:, :, len(fixed) :] = read.by_lam
            sample, column = np.nonzero(samples.positive_weight_mask)
            at = (sample, column) if samples.node.ndim > 1 else (sample,)
            node, fraction, weight = samples.node[at], samples.fraction[at], samples.weight[sample, column]
            place = np.searchsorted(used, node)
            nodes = ((place, weight * (1 - fraction)), (np.minimum(place + 1, len(used) - 1), weight * fraction))
            by_state, by_effort = np.zeros((width, len(node), nx)), np.zeros((width, len(node), efforts.shape[2]))
            for shift, (k, share) in enumerate(nodes):
                by_effort[shift + before] = samples.decorrelate_residual_rows(share[:, None] * efforts[k, column])
                for there, slope in enumerate(slopes):
                    by_state[shift + there] += samples.decorrelate_residual_rows(share[:, None] * slope[k, column])
            found.append(np.minimum(node, len(trajectory.rollout.torque)) - before)
            parts.append((by_state, by_effort))
        arrays = (np.concatenate(arrays, axis=1) for arrays in zip(*parts, strict=True))
        return ResidualDerivativesByStateAndEffort(np.concatenate(found), *arrays)

    def select_states(self, kept: IntArray) -> ResidualDerivativesByStateAndEffort:
        """Return a copy with only the derivatives with respect to the states at the indices `kept`."""
        return replace(self, by_state=self.by_state[:, :, kept])

    def select_residual_rows(self, rows: IntArray) -> ResidualDerivativesByStateAndEffort:
        """Return a copy with only the derivatives of the residuals at the indices `rows`."""
        return ResidualDerivativesByStateAndEffort(self.node[rows], self.by_state[:, rows], self.by_effort[:, rows])

    def directional_residual_derivatives(self, by_node: Array, effort: Array, first: int) -> Array:
        """Compute the residuals' derivatives (r, d) along d directions, from those of states and efforts at K nodes.

        `by_node` (K, nx, d) holds the derivatives of the states, `effort` (K, nc, d) the derivatives of the efforts.
        The K nodes begin with node `first`. A residual beyond them uses the last node.
        """
        found = np.zeros((len(self.node), by_node.shape[2]))
        for shift, (by_state, by_effort) in enumerate(zip(self.by_state, self.by_effort, strict=True)):
            used = np.flatnonzero(by_state.any(axis=1) | by_effort.any(axis=1))
            local = np.minimum(self.node[used] + shift - first, len(by_node) - 1)
            for node in np.unique(local):
                rows = used[local == node]
                found[rows] += by_state[rows] @ by_node[node] + by_effort[rows] @ effort[node]
        return found


# A fit is complete if no step predicts a larger cost reduction than this part of the cost, or this in noise units.
_MAX_RELATIVE_REDUCTION, _MAX_NOISE_UNIT_REDUCTION = 1e-3, 1e-2
_FACTORED_ROWS = 8192  # of a Jacobian that are factored at once, since factoring copies them


def residual_and_jacobian_with_stated_priors(problem: EstimationProblem, evaluation: Evaluation) -> tuple[Array, Array]:
    """Return the noise-scaled residual (r,) and Jacobian (r, nx) of data and stated priors, without weak priors."""
    assert evaluation.jacobian is not None
    kept, noise = problem.residual_rows.slice_of_data_and_stated_priors, problem.stated_rms_noise_of_data_residuals
    residual, jacobian = evaluation.residual[kept], evaluation.jacobian[kept]
    if noise == 1.0:  # no copy, which may be large
        return residual, jacobian
    units = np.where(np.arange(len(residual)) < problem.residual_rows.data.stop, noise, 1.0)
    return residual / units, jacobian / units[:, None]


def orthonormal_basis_and_coefficients(matrix: Array, columns: Array) -> tuple[Array, Array]:
    """Return an orthonormal basis of the columns of `matrix` (n, m), and coefficients (m, k) of their fit to `columns`.

    Directions with less than 1e-7 of the largest singular value, of columns of unit length, are left out.
    """
    size = np.linalg.norm(matrix, axis=0)
    scale = np.where(size > 0, size, 1.0)
    u, singular, vt = np.linalg.svd(matrix / scale, full_matrices=False)
    kept = singular > 1e-7 * max(singular.max(initial=0.0), 1e-300)
    basis = np.asarray(u[:, kept])
    return basis, (vt[kept].T / singular[kept]) @ (basis.T @ columns) / scale[:, None]


def triangular_factor(jacobian: Array, residual: Array) -> Array:
    """Return R (n + 1, n + 1) with |J d + r| = |R (d, 1)| for all d (n,), for J and r of any number of rows."""
    factor = np.zeros((jacobian.shape[1] + 1,) * 2)
    for i in range(0, len(residual), _FACTORED_ROWS):
        rows = np.column_stack([part[i : i + _FACTORED_ROWS] for part in (jacobian, residual)])
        factor = np.asarray(np.linalg.qr(np.vstack([factor, rows]), mode="r"))
    return factor


def bounded_levenberg_marquardt_step(jacobian: Array, residual: Array, mu: float, lower: Array, upper: Array) -> Array:
    """Return d in [lower, upper] that minimises |J d + r|^2 + mu c |d|^2; c is the largest squared column norm of J."""
    count, small = jacobian.shape[1], triangular_factor(jacobian, residual)
    weight = np.sqrt(mu * max(float(np.max(np.sum(small[:, :count] ** 2, axis=0), initial=0.0)), 1e-300))
    matrix = np.vstack([small[:, :count], weight * np.eye(count)])
    target = np.concatenate([-small[:, count], np.zeros(count)])
    plain = np.linalg.lstsq(matrix, target, rcond=None)[0]
    if np.all(plain >= lower) and np.all(plain <= upper):
        return plain
    low, high = np.minimum(lower, 0.0), np.maximum(upper, 0.0)
    # the bounded solver wants room between the bounds
    free, step = high - low >= 1e-14, np.zeros(count)
    if np.any(free):
        step[free] = scipy.optimize.lsq_linear(matrix[:, free], target, (low[free], high[free]), method="bvls").x
    return step


def predicted_cost_reduction_by_step(jacobian: Array, residual: Array, step: Array) -> float:
    """Compute the reduction of the cost 1/2 |r|^2 that the linear model predicts for a step."""
    return -float((jacobian.T @ residual) @ step) - 0.5 * float(np.sum((jacobian @ step) ** 2))


def is_stationary_point(problem: EstimationProblem, x: Array, evaluation: Evaluation) -> bool:
    """Check whether no step from `x` promises a relevant cost reduction. Returns False without a Jacobian."""
    noise = problem.stated_rms_noise_of_data_residuals**2
    worth = max(_MAX_RELATIVE_REDUCTION * evaluation.cost, _MAX_NOISE_UNIT_REDUCTION * noise)
    return achievable_cost_reduction(problem, x, evaluation) <= worth


def achievable_cost_reduction(problem: EstimationProblem, x: Array, evaluation: Evaluation) -> float:
    """Predict the cost reduction by a nearly undamped `size_limited_damped_step`. It is infinite without a Jacobian."""
    if evaluation.jacobian is None:
        return math.inf
    if not len(x):
        return 0.0
    reduced = triangular_factor(evaluation.jacobian, evaluation.residual)
    step = size_limited_damped_step(problem, x, reduced[:, :-1], reduced[:, -1], 1e-14)
    return predicted_cost_reduction_by_step(evaluation.jacobian, evaluation.residual, step)


def size_limited_damped_step(
    problem: EstimationProblem, x: Array, jacobian: Array, residual: Array, mu: float
) -> Array:
    """Return the damped least-squares step d (nx,) within the bounds, with |d_i| <= max(|x_i|, typical size of x_i)."""
    lower, upper = problem.bounds
    size = np.maximum(np.abs(x), problem.unknown_scales)
    low, high = np.maximum((lower - x) / size, -1.0), np.minimum((upper - x) / size, 1.0)
    return size * bounded_levenberg_marquardt_step(jacobian * size, residual, mu, low, high)


def max_abs_projected_gradient(x: Array, gradient: Array, lower: Array, upper: Array, scale: Array) -> float:
    """Return the largest absolute entry of the scaled gradient, except entries that push against an active bound."""
    free = ~(((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0)))
    return float(np.max(np.abs(scale * gradient)[free], initial=0.0))


def step_norm_in_stds(evaluation: Evaluation | None, moved: Array) -> float:
    """Return the norm |J d| of a step d (nx,), an upper bound on all |d_i|/std_i. It is infinite without a Jacobian."""
    slopes = evaluation.jacobian if evaluation is not None and evaluation.ok else None
    return math.inf if slopes is None else float(np.linalg.norm(slopes @ moved))

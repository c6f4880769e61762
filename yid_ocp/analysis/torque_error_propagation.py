"""Low-rank model of how torque and encoder errors change all readings of a motion.

Torques have an error in every recorded sample and a constant error; angles that a tracking filter follows have an error
in every step. A recording has some thousands of these unknown errors, but they change its readings only smoothly. The
matrix G maps the errors to all readings, in units of the smallest noise. Its left singular vectors with large singular
values represent G; they are computed from random samples (Halko, Martinsson and Tropp 2011, SIAM Review 53:2,
doi:10.1137/090771806). The neglected rest adds less than `_NEGLIGIBLE_STD` squared to the variance of any reading.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import scipy.linalg

from yid_ocp.arrays import Array
from yid_ocp.errors import failed_rollout_error
from yid_ocp.inference.whitening import NominalTrajectory, nominal_trajectory_from_prediction
from yid_ocp.integrator.step import linearized_rollout_steps
from yid_ocp.integrator.tracking_feedback import applied_torque_derivative_by_torque_error
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import TorqueAndAngleErrorModel
from yid_ocp.problem.evaluation import Evaluation

_NEGLIGIBLE_STD = 0.1  # standard deviation of a reading that may be neglected, in units of its noise
_INITIAL_RANDOM_SAMPLES, _MAX_RANDOM_SAMPLES = 128, 512  # random samples of all errors, doubled while too few


def point_jacobians_and_joint_information(
    problem: EstimationProblem,
    evaluation: Evaluation,
    x: Array,
    i: int,
    finest: Mapping[str, float],
    encoders: EstimationProblem | None = None,
) -> tuple[dict[tuple[str, str], Array], Array]:
    """Compute how point positions in recording `i` depend on unknowns and input errors, and what joint sensors inform.

    In `problem` every point is seen at every node with unit standard deviation. `evaluation` is the evaluation at the
    unknowns `x` (nx,). `finest` is the smallest standard deviation of each group [m]. `encoders` is the problem with
    encoders of driven joints as measurements. The errors of torques and encoders are represented by q unknowns.

    Returns
    -------
    slopes : dict of (group, frame) to ndarray, shape (N + 1, 3, nx + q)
        Derivatives of positions at N + 1 nodes by the nx unknowns, then by the q unknowns of the errors.
    information : ndarray, shape (nx + q, nx + q)
        Fisher information of joint measurements, and of the unit prior of the q unknowns.
    """
    assert evaluation.jacobian is not None
    episode, result = problem.episodes[i], evaluation.episode_predictions[i]
    driving = episode if encoders is None else encoders.episodes[i]
    shown, told = [], []
    for samples, rows in zip(episode.measurements, problem.residual_rows.measurements[i], strict=True):
        block = evaluation.jacobian[rows]
        if samples.sensor.point_names:
            shown.append((samples.sensor, block.reshape(len(samples.value), -1, len(x))))
        else:
            told.append(block)
    theta, _ = problem.unpack_episode_unknowns(x, i)
    course = nominal_trajectory_from_prediction(problem.predictor, episode, result, theta)
    units = [finest[sensor.group_name] for sensor, block in shown for _ in range(block.shape[1])]
    by_state = []
    for sensor, _ in shown:
        read = course.model_functions.compiled_sensor_function(sensor)(course.rollout_node_values, course.theta)
        by_state.append(np.concatenate([read.by_q, np.zeros_like(read.by_q), read.by_z], axis=2))
    if driving.input_errors is None:
        blur = np.zeros((len(result.rollout.state), len(units), 0))
    else:
        if encoders is not None:
            nodes, nx = course.rollout.state.shape
            angles = np.zeros((nodes, len(driving.input_errors.angle_std), nx))
            angles[:, np.arange(angles.shape[1]), list(problem.system.actuated_coordinate_indices)] = 1.0
            by_state.append(angles)
            units += list(driving.input_errors.angle_std)
        scale = np.array(units)[:, None]
        whole = np.concatenate(by_state, axis=1) / scale
        blur = scale * _low_rank_error_sensitivity(course, driving.input_errors, whole)
    slopes: dict[tuple[str, str], Array] = {}
    *blurs, of_angles = np.split(blur, np.cumsum([block.shape[1] for _, block in shown], dtype=int), axis=1)
    for (sensor, block), own in zip(shown, blurs, strict=True):
        parts = np.concatenate([block, own], axis=2)
        parts = parts.reshape(len(parts), -1, 3, parts.shape[2])
        slopes |= {(sensor.group_name, frame): parts[:, k] for k, frame in enumerate(sensor.frame_names)}
    information = np.diag(np.repeat([0.0, 1.0], [len(x), blur.shape[2]]))
    if encoders is not None:
        told.append(_read_angles(encoders, x, i, of_angles))
    for block in told:
        width = block.shape[1]
        information[:width, :width] += block.T @ block
    return slopes, information


def _read_angles(encoders: EstimationProblem, x: Array, i: int, blur: Array) -> Array:
    """Return derivatives (r, nx + q) of encoder readings, in units of their noise, by the unknowns and the errors."""
    evaluation = encoders.evaluate(x)
    if not evaluation.ok or evaluation.jacobian is None:
        raise failed_rollout_error(evaluation.message, "the experiment with measured angles of driven joints")
    for samples, rows in zip(encoders.episodes[i].measurements, encoders.residual_rows.measurements[i], strict=True):
        if samples.sensor.position_joints:
            read = samples.interpolate_to_samples(blur[samples.evaluation_node_indices])
            own = samples.residual_and_jacobian(np.zeros(samples.value.shape), read).jacobian
            assert own is not None
            return np.hstack([evaluation.jacobian[rows], own])
    return np.zeros((0, len(x) + blur.shape[2]))


def _low_rank_error_sensitivity(course: NominalTrajectory, errors: TorqueAndAngleErrorModel, slopes: Array) -> Array:
    """Return sensitivities (N + 1, k, q) of k readings to q unit-variance unknowns that represent all input errors."""
    motion, rng = _Motion(course, errors), np.random.default_rng(0)
    shape, most = slopes.shape[:2], min(_MAX_RANDOM_SAMPLES, motion.size, slopes.shape[0] * slopes.shape[1])
    count = min(_INITIAL_RANDOM_SAMPLES, most)
    while True:
        back = rng.standard_normal((motion.size, count))
        for _ in range(2):
            moved = motion.moved(back, slopes).reshape(-1, count)
            basis, _ = scipy.linalg.qr(moved, mode="economic", overwrite_a=True, check_finite=False)
            back = motion.pulled(basis.reshape(*shape, count), slopes)
        squares, vectors = np.linalg.eigh(back.T @ back)
        sizes = np.sqrt(np.maximum(squares, 0.0))
        # a third, because the missed part is somewhat larger than the smallest found
        if count == most or sizes[0] < _NEGLIGIBLE_STD / 3:
            break
        count = min(2 * count, most)
    kept = sizes > _NEGLIGIBLE_STD / 3
    return (basis @ (vectors[:, kept] * sizes[kept])).reshape(*shape, -1)


class _Motion:
    """The linear map G from errors of unit standard deviation (initial, constant, by sample, by step) to readings."""

    def __init__(self, course: NominalTrajectory, errors: TorqueAndAngleErrorModel) -> None:
        step, feedback = course.model_functions.step, course.tracking_feedback
        correction = course.model_functions.effect_momentum_calculator
        momentum = correction.momentum_derivative_by_previous_torque(course.theta)
        self.by_state, self.by_torque, self.by_angles = list[Array](), list[Array](), list[Array]()
        nu, count = len(errors.torque_std), len(errors.sample_of_step)
        known, pulled = np.tile(np.eye(nu), (count, 1, 1)), np.zeros((count, nu, nu))
        if feedback is not None:
            known = applied_torque_derivative_by_torque_error(feedback.gain, momentum)
            pulled = feedback.gain[:, :, :nu] * errors.angle_std * np.sqrt(errors.encoder_noise_steps)
        inputs = np.concatenate([known, pulled], axis=2)
        for state, _ in linearized_rollout_steps(step, course.theta, course.rollout, inputs, feedback):
            self.by_state += [*state[:, :, : -2 * nu]]
            self.by_torque += [*state[:, :, -2 * nu : -nu]]
            self.by_angles += [*state[:, :, -nu:]]
        self.start_by_angles = course.initial_state_by_angles * errors.angle_std
        self.start_by_torque = course.initial_state_by_torque
        self.torque_std, self.bias_std = errors.torque_std[:, None], errors.torque_bias_std[:, None]
        self.sample = np.unique(errors.sample_of_step, return_inverse=True)[1]
        self.samples = int(self.sample[-1]) + 1
        self.size = len(self.torque_std) * (2 + self.samples + len(self.by_torque))

    def _parts(self, errors: Array) -> tuple[Array, Array, Array, Array]:
        """Split errors into those of initial angles, constants, errors of samples and of steps, each (..., nu, c)."""
        parts = errors.reshape(-1, len(self.torque_std), errors.shape[1])
        return parts[0], parts[1], parts[2 : 2 + self.samples], parts[2 + self.samples :]

    def moved(self, errors: Array, slopes: Array) -> Array:
        """Compute the readings G e (N + 1, k, c) of errors e (size, c). `slopes` (N + 1, k, nx): readings by state."""
        angles, constant, white, followed = self._parts(errors)
        constant, white = self.bias_std * constant, self.torque_std * white
        state = self.start_by_angles @ angles + self.start_by_torque @ (constant + white[0])
        found = np.empty((*slopes.shape[:2], errors.shape[1]))
        found[0] = slopes[0] @ state
        for k, sample in enumerate(self.sample):
            state = self.by_state[k] @ state + self.by_torque[k] @ (constant + white[sample])
            state += self.by_angles[k] @ followed[k]
            found[k + 1] = slopes[k + 1] @ state
        return found

    def pulled(self, readings: Array, slopes: Array) -> Array:
        """Compute the transposed map G' y (size, c) of readings y (N + 1, k, c)."""
        result = np.zeros((self.size, readings.shape[2]))
        angles, constant, white, followed = self._parts(result)
        costate = slopes[-1].T @ readings[-1]
        for k in reversed(range(len(self.sample))):
            torque = self.by_torque[k].T @ costate
            constant += torque
            white[self.sample[k]] += torque
            followed[k] = self.by_angles[k].T @ costate
            costate = self.by_state[k].T @ costate + slopes[k].T @ readings[k]
        first = self.start_by_torque.T @ costate
        angles += self.start_by_angles.T @ costate
        constant += first
        white[0] += first
        constant *= self.bias_std
        white *= self.torque_std
        return result

"""Noise that drives the motion: from the residual of one recording to the innovations of a Kalman filter.

Recorded torques of driven joints are wrong by w, white from recorded sample to recorded sample, and by b, constant over
a recording; encoders by v. Along a rollout the error d of its state, model less truth, obeys to first order

    d_{k+1} = A_k d_k + B_k (w_k + b) + B_k du_k                 where encoders are measurements,
    d_{k+1} = (A_k - B_k K_k) d_k + B_k (w_k + b - K_k v_k)      where they are not,

with the correction du_k that the tracking filter K_k added to the recorded torque. In the first form du is known, and
the outcome does not depend on the filter; in the second the filter is part of the model, as its reference is no
measurement. Residuals are r = H d + v, so that with the filter's prediction m of (d, w, b)

    innovations = S^(-1/2) (r - H m),    |innovations|^2 = r' Sigma^-1 r,

Sigma the covariance of all residuals. The map is linear and frozen at the point where it was worked out: the same for
residual and Jacobian, which is generalised least squares.

References
----------
Anderson and Moore (1979), Optimal Filtering, chapters 3 and 5. Ljung (1999), System Identification, section 7.4.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from yid_ocp.data.recording import Recording
from yid_ocp.integrator.linear import LinearStep, linear_steps
from yid_ocp.integrator.step import Feedback, Rollout
from yid_ocp.model.system import System
from yid_ocp.problem.functions import ModelFunctions
from yid_ocp.problem.grid import Grid
from yid_ocp.problem.measurements import Measurements
from yid_ocp.problem.options import SensorOptions
from yid_ocp.sensors.joints import EFFORT, POSITION, PositionSensor, angle_std, is_stated, torque_bias_std, torque_std

log = logging.getLogger(__name__)
Array = NDArray[np.float64]
Rows = NDArray[np.int64]

TORQUE_FLOOR = 1e-3
"""Least error of a torque beside encoders, in parts of how far it varies: nothing that is computed follows them for
seconds without correction."""


@dataclass(frozen=True)
class InputErrors:
    """What is known of the errors of what drives one recording.

    Attributes
    ----------
    torque_std, bias_std, angle_std : ndarray, shape (nu,)
        Of w in a step and of b [N m], of v [rad].
    sample : ndarray of int, shape (N,)
        Recorded sample that each step's torque comes from: w is the same in all its steps.
    spread : float
        Steps over which the noise of one encoder sample reaches through interpolation.
    encoders : bool
        Whether the encoders are measurements.
    offset : ndarray, shape (nu,)
        Value of b that is taken off the recorded torque [N m], so that what is linearised is small.
    """

    torque_std: Array
    bias_std: Array
    angle_std: Array
    sample: Rows
    spread: float
    encoders: bool
    offset: Array


def input_errors(
    recording: Recording,
    system: System,
    grid: Grid,
    sensors: Mapping[str, SensorOptions],
    samples: Sequence[Measurements],
) -> InputErrors | None:
    """Errors of the torques and angles that drive a recording's rollout; None where there are none.

    Parameters
    ----------
    recording : Recording
    system : System
    grid : Grid
    sensors : mapping of group to SensorOptions
    samples : sequence of Measurements
        Of the recording.
    """
    joints, driven = recording.joints, system.driven
    if joints is None or joints.effort is None or not driven:
        return None
    effort, position = (sensors.get(group, SensorOptions()) for group in (EFFORT, POSITION))
    std = torque_std(joints, driven, effort, recording.name)
    bias = torque_bias_std(joints, driven, effort)
    encoders = any(isinstance(entry.sensor, PositionSensor) for entry in samples)
    if not encoders and not np.any(std > 0) and not np.any(bias > 0):
        return None
    angle = angle_std(joints, driven, position, recording.name)
    for group, choice, level, unit in ((EFFORT, effort, std, "N m"), (POSITION, position, angle, "rad")):
        if not is_stated(joints, group, choice):
            words = "%s: the noise of %s is neither recorded nor configured; %.2g to %.2g %s estimated from its fastest"
            log.warning(words + " changes", recording.name, group, level.min(), level.max(), unit)
    if encoders:
        columns = [joints.names.index(name) for name in driven]
        std = np.maximum(std, TORQUE_FLOOR * np.maximum(np.std(joints.effort[:, columns], axis=0), 1e-3))
    period = float(np.median(np.diff(joints.t)))
    middle = grid.times[:-1] + grid.time_step / 2
    sample = np.clip(np.searchsorted(joints.t, middle, "right") - 1, 0, len(joints.t) - 1)
    return InputErrors(
        # a step that spans several samples averages them
        std * min(1.0, np.sqrt(period / grid.time_step)),
        bias,
        angle,
        sample.astype(np.int64),
        max(1.0, period / grid.time_step),
        encoders,
        np.zeros(len(driven)),
    )


@dataclass(frozen=True)
class _FilterStep:
    """One step of a frozen filter: its rows, and the matrices by which they and the prediction m are turned over."""

    rows: Rows
    observe: Array
    whiten: Array
    gain: Array
    transition: Array
    ahead: Array
    push: Array


@dataclass(frozen=True)
class Innovations:
    """A frozen Kalman filter along one rollout.

    Attributes
    ----------
    steps : tuple of _FilterStep
        One for every node.
    offset : ndarray, shape (nu,)
        Value of b about which it is linearised [N m].
    bias_std : ndarray, shape (nu,)
        Standard deviation of b after all measurements [N m].
    """

    steps: tuple[_FilterStep, ...]
    offset: Array
    bias_std: Array

    def whitened(self, rows: Array, push: Array | None) -> tuple[Array, Array]:
        """Innovations in units of their standard deviation.

        Parameters
        ----------
        rows : ndarray, shape (r, c)
            A residual in units of the sensors' noise, then columns of its derivative.
        push : ndarray, shape (N, nu, c), or None
            The tracking filter's correction of the torque, and its derivative [N m].

        Returns
        -------
        innovations : ndarray, shape (r, c)
        bias : ndarray, shape (nu, c)
            Estimate of b from all rows [N m], and its derivative.
        """
        result = np.empty_like(rows)
        mean = np.zeros((len(self.steps[0].transition), rows.shape[1]))
        last = len(mean) - len(self.offset)
        mean[last:, 0] = -self.offset
        for k, step in enumerate(self.steps):
            own = rows[step.rows]
            gap = own - step.observe @ mean
            mean = step.transition @ mean + step.gain @ own
            if push is not None and k < len(push):
                gap -= step.ahead @ push[k]
                mean += step.push @ push[k]
            result[step.rows] = step.whiten @ gap
        mean[last:, 0] += self.offset
        return result, mean[last:]


@dataclass(frozen=True)
class Course:
    """A rollout about which errors are small, and what was measured along it.

    Attributes
    ----------
    functions : ModelFunctions
    theta : ndarray, shape (ntheta,)
    rollout : Rollout
    samples : sequence of Measurements
        Where they are late, moved to when they were true.
    feedback : Feedback or None
    effort : ndarray, shape (N + 1, n)
        Of prescribed and driven joints.
    start_by_angles, start_by_torque : ndarray, shape (nx, nu)
        Derivatives of the start by the first angles and the first torque of the driven joints, zero where it does not
        follow from them.
    """

    functions: ModelFunctions
    theta: Array
    rollout: Rollout
    samples: Sequence[Measurements]
    feedback: Feedback | None
    effort: Array
    start_by_angles: Array
    start_by_torque: Array


def innovations(course: Course, errors: InputErrors) -> Innovations:
    """Work out the Kalman filter along a rollout.

    Parameters
    ----------
    course : Course
    errors : InputErrors

    Returns
    -------
    Innovations
    """
    step = course.functions.step
    nx, nu, count = step.sizes["nx"], step.sizes["nu"], len(course.rollout.torque)
    readings = _Readings.of(course)
    unit = np.vstack(
        [
            np.hstack([course.start_by_angles, course.start_by_torque, course.start_by_torque]),
            np.eye(2 * nu, 3 * nu, nu),
        ]
    ) * np.concatenate([errors.angle_std, errors.torque_std, errors.bias_std])
    covariance = unit @ unit.T
    made, linear = [], linear_steps(step, course.theta, course.rollout)
    for k in range(count + 1):
        here = next(linear, None)
        if here is None:
            turn = _Turn(np.eye(len(covariance)), np.zeros((len(covariance), nu)), np.zeros_like(covariance), None)
        else:
            fresh = k + 1 < count and errors.sample[k + 1] != errors.sample[k]
            turn = _turn(here, course.feedback, errors, k, fresh)
        rows, observe, ahead = readings.at(k, turn)
        cross = observe @ covariance
        try:
            factor = np.linalg.cholesky(cross @ observe.T + np.eye(len(rows)))
        except np.linalg.LinAlgError:
            # rounding beside covariances that differ by many decades
            factor = np.diag(np.sqrt(1.0 + np.maximum(np.sum(cross * observe, axis=1), 0.0)))
        whiten = scipy.linalg.solve_triangular(factor, np.eye(len(rows)), lower=True)
        known = whiten @ cross
        gain = turn.transition @ known.T @ whiten
        kept = turn.transition - gain @ observe
        made.append(_FilterStep(rows, observe, whiten, gain, kept, ahead, turn.push - gain @ ahead))
        covariance = turn.transition @ (covariance - known.T @ known) @ turn.transition.T + turn.noise
        covariance = 0.5 * (covariance + covariance.T)
    return Innovations(tuple(made), errors.offset, np.sqrt(np.maximum(np.diag(covariance)[nx + nu :], 0.0)))


@dataclass(frozen=True)
class _Turn:
    """How (d, w, b) comes through one step.

    Attributes
    ----------
    transition : ndarray, shape (na, na)
    push : ndarray, shape (na, nu)
        By a known correction of the torque.
    noise : ndarray, shape (na, na)
        Covariance that comes in.
    effort : ndarray, shape (nc, na), or None
        Of prescribed coordinates at the node before; None after the last step.
    """

    transition: Array
    push: Array
    noise: Array
    effort: Array | None


def _turn(here: LinearStep, feedback: Feedback | None, errors: InputErrors, k: int, fresh: bool) -> _Turn:
    nx, nu = here.by_torque.shape
    size = nx + 2 * nu
    transition, push, noise = np.eye(size), np.zeros((size, nu)), np.zeros((size, size))
    transition[:nx] = np.hstack([here.by_state, here.by_torque, here.by_torque])
    effort = np.hstack([here.effort_by_state, here.effort_by_torque, here.effort_by_torque])
    if errors.encoders:
        push[:nx] = here.by_torque
    elif feedback is not None:
        pulled = here.by_torque @ feedback.gain[k]
        transition[:nx, feedback.index] -= pulled
        effort[:, feedback.index] -= here.effort_by_torque @ feedback.gain[k]
        # an error of the angles that the filter follows; that of the momenta, their slope, averages out
        angles = pulled[:, :nu] * errors.angle_std * np.sqrt(errors.spread)
        noise[:nx, :nx] = angles @ angles.T
    if fresh:
        torque = np.arange(nx, nx + nu)
        transition[torque, torque] = 0.0
        noise[torque, torque] = errors.torque_std**2
    return _Turn(transition, push, noise, effort)


@dataclass(frozen=True)
class _Readings:
    """Slopes of all residuals of a recording, sorted by the node before them.

    Attributes
    ----------
    order : ndarray of int, shape (r,)
    first : ndarray of int, shape (N + 2,)
        Where the rows of every node begin.
    fraction : ndarray, shape (r,)
        Of a step beyond the node.
    before, after : ndarray, shape (r, nx)
        By the states of the two nodes, their shares of the interpolation included.
    effort : ndarray, shape (r, nc)
        By the effort of prescribed joints, as at the node before.
    """

    order: Rows
    first: Rows
    before: Array
    after: Array
    effort: Array

    @staticmethod
    def of(course: Course) -> _Readings:
        """From the sensors' own derivatives along the rollout."""
        step = course.functions.step
        n, nx, fixed = step.sizes["n"], step.sizes["nx"], list(step.system.prescribed_indices)
        nodes, before, after, effort = [], [], [], []
        state, last = course.rollout.state, len(course.rollout.torque)
        for samples in course.samples:
            used = samples.nodes
            function = course.functions.sensor(samples.sensor, ())
            q, z = state[used, :n], state[used, 2 * n :]
            _, by_q, by_z, by_load, _ = function(q, z, course.effort[used], course.theta)
            slopes = np.zeros((len(used), by_q.shape[1], nx))
            slopes[:, :, :n], slopes[:, :, 2 * n :] = by_q, by_z
            sample, column = np.nonzero(samples.seen)
            wide = samples.node.ndim > 1
            node, fraction = (
                array[sample, column] if wide else array[sample] for array in (samples.node, samples.fraction)
            )
            weight = samples.weight[sample, column]
            place = np.searchsorted(used, node)
            later = np.minimum(place + 1, len(used) - 1)
            before.append((weight * (1 - fraction))[:, None] * slopes[place, column])
            after.append(
                (weight * fraction)[:, None] * np.where(fraction > 0, 1.0, 0.0)[:, None] * slopes[later, column]
            )
            effort.append(weight[:, None] * by_load[place, column][:, fixed])
            nodes.append(np.minimum(node, last))
        at = np.concatenate(nodes)
        order = np.argsort(at, kind="stable")
        first = np.searchsorted(at[order], np.arange(last + 2))
        return _Readings(order, first, np.vstack(before), np.vstack(after), np.vstack(effort))

    def at(self, k: int, turn: _Turn) -> tuple[Rows, Array, Array]:
        """Rows of node k, their slopes by (d, w, b), and by a known correction of the torque over the step."""
        rows = self.order[self.first[k] : self.first[k + 1]]
        before, after, nx = self.before[rows], self.after[rows], self.before.shape[1]
        observe = after @ turn.transition[:nx]
        observe[:, :nx] += before
        if turn.effort is not None:
            observe += self.effort[rows] @ turn.effort
        return rows, observe, after @ turn.push[:nx]

"""Noise that drives the motion: from the residual of one recording to the innovations of a Kalman filter.

Recorded torques of driven joints are wrong by w, white from recorded sample to recorded sample, and by b, constant over
a recording; encoders by v. Along a rollout the error d of its state, model less truth, obeys to first order

    d_{k+1} = A_k d_k + B_k (w_k + b) + B_k du_k                 where encoders are measurements,
    d_{k+1} = (A_k - B_k K_k) d_k + B_k (G_k (w_k + b) - K_k v_k)      where they are not,

with the correction du_k that the tracking filter K_k added to the recorded torque, and G_k what an error of the torque
comes to with the momentum that the filter follows (`torque_error_feedthrough`). In the first form du is known, and
the outcome does not depend on the filter; in the second the filter is part of the model, as its reference is no
measurement. Residuals are r = H d + v, so that with the filter's prediction m of (d, w, b)

    innovations = S^(-1/2) (r - H m),    |innovations|^2 = r' Sigma^-1 r,

Sigma the covariance of all residuals. The map is linear and frozen at the point where it was worked out: the same for
residual and Jacobian, which is generalised least squares.

Recorded torques are regressors with errors: along a rollout under them the derivatives share their noise with the
residual, and whatever stands beside accelerations, inertias above all, comes out biased. Where a filter is known
already, the next one is therefore about the smoothed motion, w and b taken off the torques; then the derivatives are
those of the sum of squares that is least over w and b (Golub and Pereyra).

References
----------
Golub and Pereyra (1973), SIAM J. Numerical Analysis 10:2, doi:10.1137/0710036. Bryson and Frazier (1963), Smoothing
for linear and nonlinear dynamic systems, Aeronautical Systems Division report TDR-63-119.
Anderson and Moore (1979), Optimal Filtering, chapters 3 and 5. Ljung (1999), System Identification, section 7.4.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.linalg.lapack
from numpy.typing import NDArray

from yid_ocp.data.recording import Recording
from yid_ocp.integrator.linearized_steps import LinearizedStep, active_state_mask, linearized_steps
from yid_ocp.integrator.momentum_shift import torque_error_feedthrough
from yid_ocp.integrator.step import Rollout, TrackingFeedback
from yid_ocp.model.system import System
from yid_ocp.problem.measurements import Measurements
from yid_ocp.problem.model_functions import ModelFunctions
from yid_ocp.problem.options import SensorOptions
from yid_ocp.problem.time_grid import TimeGrid
from yid_ocp.sensors.joints import (
    EFFORT_GROUP,
    POSITION_GROUP,
    PositionSensor,
    is_noise_std_stated,
    joint_angle_noise_std,
    joint_torque_bias_std,
    joint_torque_noise_std,
)

log = logging.getLogger(__name__)
Array = NDArray[np.float64]
_RowIndices = NDArray[np.int64]

_MIN_TORQUE_ERROR_FRACTION = 1e-3
"""Least error of a torque beside encoders, in parts of how far it varies: nothing that is computed follows them for
seconds without correction."""


@dataclass(frozen=True)
class InputErrors:
    """Noise levels and current estimates of the torque and angle errors that drive one recording's rollout.

    Attributes
    ----------
    torque_std, torque_bias_std, angle_std : ndarray, shape (nu,)
        Of w in a step and of b [N m], of v [rad].
    sample_of_step : ndarray of int, shape (N,)
        Recorded sample that each step's torque comes from: w is the same in all its steps.
    encoder_noise_steps : float
        Number of steps that share one encoder sample's noise through interpolation.
    has_encoder_measurements : bool
        Whether the encoders are measurements.
    torque_bias : ndarray, shape (nu,)
        Value of b that is subtracted from the recorded torque [N m].
    torque_noise : ndarray, shape (N, nu)
        Value of w that is subtracted in every step [N m].
    recorded_torque_noise : ndarray, shape (N, nu)
        Noise of the recorded torque that w implies, subtracted before effects on torques apply [N m].
    transmitted_torque_noise : ndarray, shape (N, nu)
        Part of w that subtracting `recorded_torque_noise` already removes from the acting torque [N m].
    smoothed_reference : ndarray, shape (N, nb), or None
        Smoothed reference of the tracking filter in place of the measured motion.
    """

    torque_std: Array
    torque_bias_std: Array
    angle_std: Array
    sample_of_step: _RowIndices
    encoder_noise_steps: float
    has_encoder_measurements: bool
    torque_bias: Array
    torque_noise: Array
    recorded_torque_noise: Array
    transmitted_torque_noise: Array
    smoothed_reference: Array | None = None

    @property
    def total_torque_error(self) -> Array:
        """Total error subtracted from the torque of every step, b + w, shape (N, nu) [N m]."""
        return self.torque_bias + self.torque_noise

    @property
    def remaining_torque_error(self) -> Array:
        """Error still to be subtracted after effects on torques, shape (N, nu) [N m]."""
        return self.total_torque_error - self.transmitted_torque_noise

    @property
    def with_bias_only(self) -> InputErrors:
        """The same errors with the constant offset alone; torques and angles otherwise as recorded."""
        none = np.zeros_like(self.torque_noise)
        return replace(
            self, torque_noise=none, recorded_torque_noise=none, transmitted_torque_noise=none, smoothed_reference=None
        )

    def first_steps(self, steps: int) -> InputErrors:
        """The errors of the first `steps` steps."""
        first = {
            name: getattr(self, name)[:steps]
            for name in ("sample_of_step", "torque_noise", "recorded_torque_noise", "transmitted_torque_noise")
        }
        return replace(
            self,
            **first,
            smoothed_reference=None if self.smoothed_reference is None else self.smoothed_reference[:steps],
        )


def recorded_input_errors(
    recording: Recording,
    system: System,
    grid: TimeGrid,
    sensors: Mapping[str, SensorOptions],
    samples: Sequence[Measurements],
) -> InputErrors | None:
    """Error levels of the torques and angles that drive a recording's rollout; None where there are none.

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
    if joints is None or joints.effort is None or not driven or system.servos:
        return None
    effort, position = (sensors.get(group, SensorOptions()) for group in (EFFORT_GROUP, POSITION_GROUP))
    std = joint_torque_noise_std(joints, driven, effort, recording.name)
    bias = joint_torque_bias_std(joints, driven, effort)
    encoders = any(isinstance(entry.sensor, PositionSensor) for entry in samples)
    if not encoders and not np.any(std > 0) and not np.any(bias > 0):
        return None
    angle = joint_angle_noise_std(joints, driven, position, recording.name)
    for group, choice, level, unit in ((EFFORT_GROUP, effort, std, "N m"), (POSITION_GROUP, position, angle, "rad")):
        if not is_noise_std_stated(joints, group, choice):
            words = "%s: the noise of %s is neither recorded nor configured; %.2g to %.2g %s estimated from its fastest"
            log.warning(words + " changes", recording.name, group, level.min(), level.max(), unit)
    if encoders:
        columns = [joints.names.index(name) for name in driven]
        std = np.maximum(std, _MIN_TORQUE_ERROR_FRACTION * np.maximum(np.std(joints.effort[:, columns], axis=0), 1e-3))
    period = float(np.median(np.diff(joints.t)))
    middle = grid.node_times[:-1] + grid.time_step / 2
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
        *(np.zeros((grid.steps, len(driven))) for _ in range(3)),
    )


@dataclass(frozen=True)
class _FilterStep:
    """One step of a frozen filter, by which rows and the prediction m of (d, w, b) are turned over.

    Attributes
    ----------
    rows : ndarray of int, shape (r,)
    observe : ndarray, shape (r, na)
        H
    whiten : ndarray, shape (r, r)
        S^(-1/2)
    gain : ndarray, shape (na, r)
        Of the prediction a step later.
    ahead : ndarray, shape (r, nu)
        Rows by a known correction of the torque over the step.
    move : ndarray, shape (ns, na)
        d after the step by (d, w, b): A_k, less B_k K_k where the tracking filter is part of the model, and B_k twice.
    held : bool
        Whether w stays what it is.
    """

    rows: _RowIndices
    observe: Array
    whiten: Array
    gain: Array
    ahead: Array
    move: Array
    held: bool

    def over(self, mean: Array, own: Array, push: Array | None) -> tuple[Array, Array]:
        """What the rows say beyond the prediction, and the prediction a step later.

        Only what d becomes is as large as (d, w, b) squared, so that the whole is not kept as one matrix.
        """
        ns, kept, gap = len(self.move), self._kept, own - self.observe @ mean
        if push is not None:
            gap -= self.ahead @ push
        later = self.gain @ gap
        later[:ns] += self.move @ mean
        later[kept:] += mean[kept:]
        if push is not None:
            later[:ns] += self.move[:, ns : ns + len(push)] @ push
        return gap, later

    def back(self, costate: Array) -> Array:
        """The transposed map of (d, w, b) over the step, without what the rows tell."""
        ns, kept = len(self.move), self._kept
        earlier = self.move.T @ costate[:ns]
        earlier[kept:] += costate[kept:]
        return earlier

    @property
    def _kept(self) -> int:
        """Where in (d, w, b) that begins which stays what it is."""
        ns, na = self.move.shape
        return ns if self.held else (ns + na) // 2


@dataclass(frozen=True)
class _SmoothedInputErrors:
    """Smoothed torque errors and state errors of a recording, from all its measurements.

    Attributes
    ----------
    torque_bias : ndarray, shape (nu,)
        b [N m]
    torque_noise : ndarray, shape (N, nu)
        w in every step [N m].
    state_error : ndarray, shape (N + 1, nx)
        State of the rollout less the true one; where encoders are measurements.
    """

    torque_bias: Array
    torque_noise: Array
    state_error: Array


@dataclass(frozen=True)
class WhiteningFilter:
    """Kalman filter, linearized along one rollout, that whitens the residual of a recording.

    Attributes
    ----------
    filter_steps : tuple of _FilterStep
        One for every node.
    input_errors : InputErrors
        With the values of b and w about which it is linearised.
    initial_covariance : ndarray, shape (na, na)
        Covariance of (d, w, b) before all measurements.
    state_mask : ndarray of bool, shape (nx,)
        Those that d is made up of.
    torque_bias_std : ndarray, shape (nu,)
        Standard deviation of b after all measurements [N m].
    """

    filter_steps: tuple[_FilterStep, ...]
    input_errors: InputErrors
    initial_covariance: Array
    state_mask: NDArray[np.bool_]
    torque_bias_std: Array

    def whiten(self, rows: Array, push: Array | None) -> tuple[Array, Array]:
        """Whiten a residual and its derivatives: normalized innovations of the Kalman filter.

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
        result, mean = np.empty_like(rows), self._expected(rows.shape[1])
        for k, step in enumerate(self.filter_steps):
            gap, mean = self._over(k, mean, rows[step.rows], push)
            result[step.rows] = step.whiten @ gap
        bias = mean[-len(self.input_errors.torque_bias) :]
        bias[:, 0] += self.input_errors.torque_bias
        return result, bias

    def smooth(self, rows: Array, push: Array | None) -> _SmoothedInputErrors:
        """Smooth torque and state errors from all measurements (Bryson and Frazier 1963).

        Parameters
        ----------
        rows : ndarray, shape (r,)
            A residual in units of the sensors' noise.
        push : ndarray, shape (N, nu, 1), or None
            As in `whiten`.
        """
        errors, last = self.input_errors, len(self.filter_steps) - 1
        nu, ns = len(errors.torque_bias), int(np.count_nonzero(self.state_mask))
        torque = slice(ns, ns + nu)
        column, noise = rows[:, None], np.zeros((len(rows), 1))
        mean = self._expected(1)
        for k, step in enumerate(self.filter_steps):
            gap, mean = self._over(k, mean, column[step.rows], push)
            noise[step.rows] = step.whiten.T @ (step.whiten @ gap)
        offset = mean[-nu:, 0] + errors.torque_bias
        white, costate = np.zeros_like(errors.torque_noise), np.zeros_like(mean)
        for k in range(last, -1, -1):
            step = self.filter_steps[k]
            if not step.held:
                white[k + 1] = errors.torque_std**2 * costate[torque, 0]
            noise[step.rows] -= step.gain.T @ costate
            costate = step.back(costate) + step.observe.T @ noise[step.rows]
        mean = self._expected(1) + self.initial_covariance @ costate
        white[0] = errors.torque_noise[0] + mean[torque, 0]
        error = np.zeros((last + 1, len(self.state_mask)))
        for k, step in enumerate(self.filter_steps):
            error[k, self.state_mask] = mean[:ns, 0]
            # without the sensors' noise there is no innovation; what rounding makes of one keeps the error bounded
            _, mean = self._over(k, mean, column[step.rows] - noise[step.rows], push)
            if k + 1 < last:
                white[k + 1] = white[k] if step.held else white[k + 1]
                mean[torque, 0] = white[k + 1] - errors.torque_noise[k + 1]
        return _SmoothedInputErrors(offset, white, error)

    def _expected(self, columns: int) -> Array:
        """Mean of (d, w, b) before all measurements; no derivative in further columns, shape (na, columns)."""
        mean = np.zeros((len(self.initial_covariance), columns))
        mean[len(mean) - 2 * len(self.input_errors.torque_bias) :, 0] = -np.concatenate(
            [self.input_errors.torque_noise[0], self.input_errors.torque_bias]
        )
        return mean

    def _over(self, k: int, mean: Array, own: Array, push: Array | None) -> tuple[Array, Array]:
        """Step k, and the mean of another w after it."""
        gap, later = self.filter_steps[k].over(mean, own, None if push is None or k >= len(push) else push[k])
        if not self.filter_steps[k].held:
            nu = len(self.input_errors.torque_bias)
            later[len(later) - 2 * nu : len(later) - nu, 0] -= self.input_errors.torque_noise[k + 1]
        return gap, later


@dataclass(frozen=True)
class NominalTrajectory:
    """Nominal trajectory of an episode and its measurements, about which the Kalman filter is linearized.

    Attributes
    ----------
    model_functions : ModelFunctions
    theta : ndarray, shape (ntheta,)
    rollout : Rollout
    measurements : sequence of Measurements
        Shifted by their delays to the times at which they were true.
    tracking_feedback : Feedback or None
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


def build_whitening_filter(course: NominalTrajectory, errors: InputErrors) -> WhiteningFilter:
    """Build the whitening Kalman filter along a trajectory.

    Parameters
    ----------
    course : Course
    errors : InputErrors

    Returns
    -------
    Innovations
    """
    step, nu, count = course.model_functions.step, len(errors.torque_bias_std), len(course.rollout.torque)
    linear = partial(linearized_steps, step, course.theta, course.rollout)
    readings = _Readings.of(course)
    ends = [*linear(chosen=slice(0, 1)), *linear(chosen=slice(count - 1, count))]
    live = active_state_mask(step, ends, readings.seen)
    kept = np.flatnonzero(live)
    readings = replace(readings, before=readings.before[:, kept], after=readings.after[:, kept])
    start = np.hstack([course.initial_state_by_angles, course.initial_state_by_torque, course.initial_state_by_torque])[
        kept
    ]
    unit = np.vstack([start, np.eye(2 * nu, 3 * nu, nu)])
    unit *= np.concatenate([errors.angle_std, errors.torque_std, errors.torque_bias_std])
    covariance = first = unit @ unit.T
    made, steps, momentum = [], linear(), course.model_functions.momentum_shift.momentum_by_torque(course.theta)
    for k in range(count + 1):
        fresh = k + 1 < count and errors.sample_of_step[k + 1] != errors.sample_of_step[k]
        here = next(steps, None)
        turn = (
            _last_turn(len(kept), nu)
            if here is None
            else _turn(here, kept, course.tracking_feedback, momentum, errors, k, fresh)
        )
        rows, observe, ahead = readings.at(k, turn)
        cross = observe @ covariance
        try:
            factor = np.linalg.cholesky(cross @ observe.T + np.eye(len(rows)))
        except np.linalg.LinAlgError:
            # rounding beside covariances that differ by many decades
            factor = np.diag(np.sqrt(1.0 + np.maximum(np.sum(cross * observe, axis=1), 0.0)))
        whiten = scipy.linalg.lapack.dtrtri(factor, lower=1)[0] if len(rows) else factor
        known = whiten @ cross
        gain = turn.over(known.T @ whiten)
        made.append(_FilterStep(rows, observe, whiten, gain, ahead, turn.move, not turn.fresh))
        covariance = turn.over(turn.over(covariance - known.T @ known).T)
        if turn.shaken is not None:
            covariance[: len(kept), : len(kept)] += turn.shaken @ turn.shaken.T
        if turn.fresh:
            torque = np.arange(len(kept), len(kept) + nu)
            covariance[torque, torque] += errors.torque_std**2
        covariance = 0.5 * (covariance + covariance.T)
    spread = np.sqrt(np.maximum(np.diag(covariance)[len(kept) + nu :], 0.0))
    return WhiteningFilter(tuple(made), errors, first, live, spread)


@dataclass(frozen=True)
class _Turn:
    """How (d, w, b) comes through one step.

    Attributes
    ----------
    move : ndarray, shape (ns, na)
        d after it.
    fresh : bool
        Whether w is another one after it.
    shaken : ndarray, shape (ns, s), or None
        By unit noises of its own that come to d.
    effort : ndarray, shape (nc, na), or None
        Of prescribed coordinates at the node before; None after the last step, and where there are none.
    """

    move: Array
    fresh: bool
    shaken: Array | None
    effort: Array | None

    def over(self, columns: Array) -> Array:
        """Columns (na, c) after the step."""
        (ns, na), later = self.move.shape, columns.copy()
        later[:ns] = self.move @ columns
        if self.fresh:
            later[ns : (ns + na) // 2] = 0.0
        return later


def _last_turn(ns: int, nu: int) -> _Turn:
    return _Turn(np.eye(ns, ns + 2 * nu), False, None, None)


def _turn(
    here: LinearizedStep,
    kept: _RowIndices,
    feedback: TrackingFeedback | None,
    momentum: Array,
    errors: InputErrors,
    k: int,
    fresh: bool,
) -> _Turn:
    """Step k; `momentum` (nu, nu) is what torques of the step before add to the momenta that the filter follows."""
    by_state, effort_by_state, shaken = here.state_by_state, here.effort_by_state, None
    by_error, effort_by_error = here.state_by_torque[kept], here.effort_by_torque
    if feedback is not None and not errors.has_encoder_measurements:
        by_state, effort_by_state = by_state.copy(), effort_by_state.copy()
        by_state[:, feedback.state_indices] -= here.state_by_torque @ feedback.gain[k]
        effort_by_state[:, feedback.state_indices] -= here.effort_by_torque @ feedback.gain[k]
        nu = by_error.shape[1]
        # an error of the angles that the filter follows; that of the momenta as their slope averages out
        shaken = by_error @ feedback.gain[k][:, :nu] * errors.angle_std * np.sqrt(errors.encoder_noise_steps)
        # that as half the impulse of the step before does not
        known = torque_error_feedthrough(feedback.gain[k], momentum)
        by_error, effort_by_error = by_error @ known, effort_by_error @ known
    effort = None
    if len(effort_by_state):
        effort = np.hstack([effort_by_state[:, kept], effort_by_error, effort_by_error])
    return _Turn(np.hstack([by_state[np.ix_(kept, kept)], by_error, by_error]), fresh, shaken, effort)


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
    before, after : ndarray, shape (r, nx), or of some of the states alone
        By the states of the two nodes, their shares of the interpolation included.
    effort : ndarray, shape (r, nc)
        By the effort of prescribed joints, as at the node before.
    """

    order: _RowIndices
    first: _RowIndices
    before: Array
    after: Array
    effort: Array

    @staticmethod
    def of(course: NominalTrajectory) -> _Readings:
        """From the sensors' own derivatives along the rollout."""
        step = course.model_functions.step
        n, nx, fixed = step.sizes["n"], step.sizes["nx"], list(step.system.prescribed_indices)
        nodes, before, after, effort = [], [], [], []
        state, last = course.rollout.state, len(course.rollout.torque)
        for samples in course.measurements:
            used = samples.evaluation_nodes
            function = course.model_functions.compiled_sensor(samples.sensor, ())
            q, z = state[used, :n], state[used, 2 * n :]
            _, by_q, by_z, by_load, _ = function(q, z, course.joint_efforts[used], course.theta)
            slopes = np.zeros((len(used), by_q.shape[1], nx))
            slopes[:, :, :n], slopes[:, :, 2 * n :] = by_q, by_z
            sample, column = np.nonzero(samples.is_used)
            wide = samples.node.ndim > 1
            node, fraction = (
                array[sample, column] if wide else array[sample] for array in (samples.node, samples.fraction)
            )
            weight = samples.weight[sample, column]
            place = np.searchsorted(used, node)
            later = np.minimum(place + 1, len(used) - 1)
            early = (weight * (1 - fraction))[:, None] * slopes[place, column]
            late = (weight * fraction)[:, None] * np.where(fraction > 0, 1.0, 0.0)[:, None] * slopes[later, column]
            before.append(samples.decorrelate(early))
            after.append(samples.decorrelate(late))
            effort.append(samples.decorrelate(weight[:, None] * by_load[place, column][:, fixed]))
            nodes.append(np.minimum(node, last))
        at = np.concatenate(nodes)
        order = np.argsort(at, kind="stable")
        first = np.searchsorted(at[order], np.arange(last + 2))
        return _Readings(order, first, np.vstack(before), np.vstack(after), np.vstack(effort))

    @property
    def seen(self) -> NDArray[np.bool_]:
        """States that a residual depends on, shape (nx,)."""
        return np.any(self.before != 0, axis=0) | np.any(self.after != 0, axis=0)

    def at(self, k: int, turn: _Turn) -> tuple[_RowIndices, Array, Array]:
        """Rows of node k, their slopes by (d, w, b), and by a known correction of the torque over the step."""
        rows = self.order[self.first[k] : self.first[k + 1]]
        before, after = self.before[rows], self.after[rows]
        observe = after @ turn.move
        ns, na = turn.move.shape
        ahead = observe[:, ns : (ns + na) // 2].copy()
        observe[:, :ns] += before
        if turn.effort is not None:
            observe += self.effort[rows] @ turn.effort
        return rows, observe, ahead

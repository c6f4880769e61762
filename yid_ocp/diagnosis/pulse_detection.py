"""Detection of short force pulses on a background that changes slowly or with the load.

The likelihood of the force's values f is log p(data | f) = g'f - f'L f / 2. f is a sum of pulses and a Gaussian
background with the covariance

    cov f(s), f(t) = e(s) e(t) (delta(s, t) + exp(-|s - t|/a))/2 + s^2 exp(-|s - t|/b),   e^2 = (c m)^2 + w^2 + h^2/3,

where m is the assumed model error, h the torque that friction can hold, and a and b are correlation times. c >= 1, w
and s are chosen for the largest evidence, with and without a pulse, so that a dominant model error causes no events.
Pulses are added one by one, largest rise of the evidence first. This is the search for shocks by auxiliary residuals
(de Jong and Penzer 1998, doi:10.1080/01621459.1998.10473717), with pulses in place of impulses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import product
from typing import Any

import casadi as ca
import numpy as np
import scipy.linalg
import scipy.sparse

from yid_ocp.arrays import Array, BoolArray, IntArray
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.integrator.step import Step, actuated_joint_torques_of_rollout
from yid_ocp.integrator.step_model import Rollout
from yid_ocp.model.kinematics import forward_kinematics, lagrangian_first_derivatives, mass_matrix
from yid_ocp.model.system import MidpointStateSymbols, System
from yid_ocp.sensors.signal_filters import zero_phase_effort_filter

_STANDSTILL_SPEED = 0.1  # speed below which friction can stick [rad/s or m/s]


class CompiledInverseDynamics:
    """The inverse dynamics of a system, M(q) a + c(q, v) + g(q) = tau, compiled once for all recordings."""

    def __init__(self, step: Step) -> None:
        self._step = step

    @cached_property
    def _function(self) -> ca.Function:
        return _function(self._step.system, self._step.time_step)

    def torque_magnitude_rate_and_static_friction(
        self, theta: Array, rollout: Rollout, nodes: IntArray
    ) -> tuple[Array, Array, Array]:
        """Return magnitude, rate and static friction (M, n) of torques at nodes (M,), also repeated ones.

        The magnitude is the root sum of squares of inertia (of every joint's acceleration by itself), Coriolis and
        centrifugal forces, gravity, springs, friction, effects' forces and the applied or required torque [N m or N].
        The rate is the time derivative of the required torque. The limit of static friction is zero above
        `_STANDSTILL_SPEED`. Speeds and accelerations are finite differences.
        """
        system, time_step = self._step.system, self._step.time_step
        nodes, repeated = np.unique(nodes, return_inverse=True)
        n = system.n_coordinates
        q, z = rollout.state[:, :n], rollout.state[:, 2 * n :]
        v = np.gradient(q, time_step, axis=0)
        a = np.gradient(v, time_step, axis=0)
        function = self._function.map(len(nodes))
        squares, needed, held = (np.array(part).T for part in function(*(x[nodes].T for x in (q, v, a, z)), theta))
        applied = np.zeros((len(nodes), n))
        torque = actuated_joint_torques_of_rollout(self._step, theta, rollout)
        driven, prescribed = system.actuated_coordinate_indices, system.prescribed_coordinate_indices
        for indices, effort in ((driven, torque), (prescribed, rollout.effort)):
            if indices:
                applied[:, list(indices)] = effort[np.minimum(nodes, len(effort) - 1)]
        rate = np.gradient(needed, time_step * nodes, axis=0) if len(nodes) > 1 else np.zeros_like(needed)
        return np.sqrt(squares + applied**2)[repeated], np.asarray(rate)[repeated], np.abs(held)[repeated]


def _function(system: System, time_step: float) -> ca.Function:
    """Return the function (q, v, a, z, theta) -> (sum of squared terms, required torque, limit of static friction)."""
    n, names = system.n_coordinates, tuple(system.effect_internal_coordinate_symbols)
    q, v, a, z = (ca.SX.sym(name, size) for name, size in (("q", n), ("v", n), ("a", n), ("z", len(names))))
    kinematics = forward_kinematics(system.mechanism, q)
    moving = lagrangian_first_derivatives(kinematics, v, system.gravity)
    weight = lagrangian_first_derivatives(kinematics, ca.SX.zeros(n), system.gravity).lagrangian_by_q
    rest, u = ca.SX.zeros(len(names)), ca.SX.zeros(len(system.driven))
    pulls = ca.SX.zeros(system.n_constraints)
    rows = {name: i for i, name in enumerate(names)}
    state = MidpointStateSymbols(system, kinematics, q, v, z, rest, u, pulls, rows, ca.SX(time_step))
    energy, viscous, others = -system.elastic_energy(q), system.viscous_force(v), ca.SX.zeros(n)
    for effect in system.effects:
        terms = effect.step_terms(state)
        energy += terms.lagrangian
        viscous += 0 if terms.dissipative_force is None else terms.dissipative_force
        others += 0 if terms.generalized_force is None else terms.generalized_force
        others += 0 if terms.force_with_derivatives is None else terms.force_with_derivatives.force
    mass = mass_matrix(moving, system.mechanism) + ca.hessian(energy, v)[0]
    coriolis = ca.jtimes(moving.lagrangian_by_v, q, v) - (moving.lagrangian_by_q - weight)
    springs = -ca.gradient(energy, q)
    columns = mass * ca.repmat(a.T, n, 1)
    squares = ca.sum2(columns**2) + coriolis**2 + weight**2 + springs**2 + viscous**2 + others**2
    needed = ca.sum2(columns) + coriolis - weight + springs - viscous - others
    faster, slower = (ca.substitute(viscous, v, v + sign * _STANDSTILL_SPEED) for sign in (1, -1))
    outputs = [ca.densify(x) for x in (squares, needed, (faster - slower) / 2)]
    if names:
        symbols = ca.vertcat(*system.effect_internal_coordinate_symbols.values())
        outputs = [ca.substitute(x, symbols, z) for x in outputs]
    return ca.Function("torque_terms", [q, v, a, z, system.parameters.symbols], outputs)


_SparseMatrix = Any  # scipy.sparse.csc_array or, of few profiles, ndarray; the former has no types

_MODEL_ERROR_TIME, _SLOW_FORCE_TIME = 0.3, 2.0
"""Correlation times a of the model error and b of the slow background [s] (see the module)."""
_MODEL_ERROR_FACTORS, _NOISE_FLOOR_FACTORS, _SLOW_FORCE_FACTORS = (1.0, 2.0, 4.0), (0.0, 0.5, 1.0), (0.25, 1.0)
"""Values tried for c, for w / robust spread of the history, and for s / root mean square of the history."""
_MIN_PULSE_POINTS = 2.5  # duration of the shortest pulse, in time points of the history
_WINDOW_GROWTH = 1.25  # ratio of successive window lengths
_FLAT_RAMP_FRACTION = 0.5  # fraction of a flat-topped pulse's duration in which it rises or falls
_MAX_PROFILES = 12  # largest number of pulses and similar profiles in one history
MAX_EVENT_TIME_FRACTION = 1 / 3  # of the time; more short forces are model error, not events
_SAMPLES_PER_BLOCK = 4096  # of profiles that are filtered at once
_MIN_PROMINENCE_RATIO = 1.5  # smallest ratio of a pulse's size to the median size at all times; above that of a sine
_MAX_PULSE_RANGE_RATIO = 1.5  # largest ratio of a pulse to the range of the history around it


@dataclass(frozen=True)
class ForceEstimate:
    """An estimate of an unknown force f over time at one location, as its log likelihood g'f - f'L f / 2."""

    recording: str
    location: str
    coordinate: str
    unit: str
    t: Array  # shape (M,): since the start of the recording, evenly spaced [s]
    score: Array  # shape (M,): g
    information: Array  # shape (M, M): L
    model_error_std: Array  # shape (M,): m, in `unit`
    friction_limit: Array  # shape (M,): h, in `unit`
    # cutoff of the filter applied to the force [Hz]; infinite for none
    filter_cutoff: float = math.inf

    @property
    def time_spacing(self) -> float:
        """The median time between neighbouring points [s]."""
        return float(np.median(np.diff(self.t)))

    def subset_at_time_indices(self, keep: IntArray) -> ForceEstimate:
        """Return the estimate at only the time points with the indices `keep`."""
        information = self.information[np.ix_(keep, keep)]
        parts = {name: getattr(self, name)[keep] for name in ("t", "score", "model_error_std", "friction_limit")}
        return replace(self, information=information, **parts)

    @property
    def assumed_model_error(self) -> Array:
        """The assumed model error (M,) of the force at every time point, in `unit`."""
        return np.hypot(self.model_error_std, self.friction_limit)

    @property
    def most_likely_force_signal(self) -> Array:
        """The maximum-likelihood force (M,) at every time point, in `unit`."""
        least = 1e-6 * max(float(np.mean(np.diag(self.information))), 1e-300)
        return np.asarray(np.linalg.solve(self.information + least * np.eye(len(self.t)), self.score))


@dataclass(frozen=True)
class DetectedForcePulse:
    """A force pulse that begins and ends at zero, with time window, peak, shape and p-value."""

    start_time: float  # [s]
    end_time: float
    peak_value: float  # largest signed value, in the history's unit
    is_flat_topped: bool  # whether the force is at its peak for half of the time; otherwise it is a squared sine
    peak_std: float  # standard deviation of the peak, including the background
    p_value: float  # probability that chance raises the evidence as much in one window

    @property
    def impulse_per_unit_peak(self) -> float:
        """The time integral [s] of the pulse divided by its peak."""
        return (self.end_time - self.start_time) * (1 - _FLAT_RAMP_FRACTION / 2 if self.is_flat_topped else 0.5)

    @property
    def impulse(self) -> float:
        """The signed time integral of the pulse, in the force's unit times s."""
        return self.peak_value * self.impulse_per_unit_peak

    def filtered_force_at(self, t: Array, cutoff: float = math.inf) -> Array:
        """Return the force of the pulse at increasing times `t` (M,), after a low-pass filter with the cutoff [Hz]."""
        window = _Windows(*map(np.atleast_1d, (self.start_time, self.end_time, self.is_flat_topped)))
        return self.peak_value * _Filter.of(cutoff)(window, t)[:, 0]


@dataclass(frozen=True)
class _Windows:
    """Pulse shapes with peak one: starts [s], ends [s], and whether they are flat-topped, (k,) each."""

    begin: Array
    end: Array
    flat: BoolArray

    def at(self, t: Array) -> Array:
        """Return values (M, k) at times (M, 1), or (k,) at one time (k,) for each pulse."""
        part = np.clip((t - self.begin) / (self.end - self.begin), 0.0, 1.0)
        ramp = np.where(self.flat, _FLAT_RAMP_FRACTION / 2, 0.5)
        return np.asarray(np.sin(np.pi / 2 * np.minimum(np.minimum(part, 1 - part) / ramp, 1.0)) ** 2)

    def __getitem__(self, chosen: Any) -> _Windows:
        return _Windows(self.begin[chosen], self.end[chosen], self.flat[chosen])


@dataclass(frozen=True)
class _Filter:
    """A zero-phase filter, given by L weights at delays [s]."""

    delay: Array
    weight: Array

    @staticmethod
    def of(cutoff: float) -> _Filter:
        if not math.isfinite(cutoff):
            return _Filter(np.zeros(1), np.ones(1))
        length = 30
        delay = np.asarray(0.1 / cutoff * np.arange(-length, length + 1), float)
        impulse = np.zeros((len(delay), 1))
        impulse[length] = 1.0
        weight = zero_phase_effort_filter(cutoff)(delay, impulse)[:, 0]
        return _Filter(delay, weight / weight.sum())

    def __call__(self, windows: _Windows, t: Array) -> Array:
        """Return filtered pulse shapes (M, k) at increasing times (M,)."""
        return np.asarray(self.of_many(windows, t).toarray())

    def of_many(self, windows: _Windows, t: Array) -> _SparseMatrix:
        """Return filtered pulse shapes (M, k) as a sparse matrix, for windows that are short beside the history."""
        reach = float(self.delay[-1])
        first, last = (np.searchsorted(t, ends) for ends in (windows.begin - reach, windows.end + reach))
        count = last - first
        column = np.repeat(np.arange(len(count)), count)
        row = np.arange(len(column)) - np.repeat(np.cumsum(count) - count - first, count)
        parts = np.array_split(np.arange(len(row)), len(row) // _SAMPLES_PER_BLOCK + 1)
        seen = np.concatenate([self._seen(windows[column[part]], t[row[part]]) for part in parts])
        return scipy.sparse.csc_array((seen, (row, column)), shape=(len(t), len(count)))

    def _seen(self, windows: _Windows, t: Array) -> Array:
        return np.asarray(windows[..., None].at(t[..., None] - self.delay) @ self.weight)


@dataclass(frozen=True)
class _Rest:
    """Data y whose background has the covariance Sigma: Sigma^-1 (M, M), Sigma^-1 y (M,) and log evidence."""

    precision: Array
    scored: Array
    evidence: float
    lost: Array

    @staticmethod
    def of(history: ForceEstimate, error: float, floor: float, slow: float) -> _Rest:
        apart = np.abs(history.t[:, None] - history.t)
        quick = np.sqrt((error * history.model_error_std) ** 2 + floor**2 + history.friction_limit**2 / 3)
        covariance = np.outer(quick, quick) * (np.eye(len(apart)) + np.exp(-apart / _MODEL_ERROR_TIME)) / 2
        covariance += slow**2 * np.exp(-apart / _SLOW_FORCE_TIME)
        covariance[np.diag_indices_from(covariance)] += 1e-9 * np.trace(covariance) / len(covariance)
        factor = np.linalg.cholesky(covariance)
        seen = history.information @ factor
        inner = np.linalg.cholesky(np.eye(len(factor)) + factor.T @ seen)
        half = scipy.linalg.solve_triangular(inner, seen.T, lower=True)
        told = scipy.linalg.solve_triangular(inner, factor.T @ history.score, lower=True)
        evidence = 0.5 * float(told @ told) - float(np.sum(np.log(np.diag(inner))))
        none = np.zeros((len(factor), 0))
        return _Rest(history.information - half.T @ half, history.score - half.T @ told, evidence, none)

    def beside(self, taken: Array) -> _Rest:
        """Return the data beside profiles `taken` (M, k), whose sizes are free."""
        if not taken.shape[1]:
            return self
        seen = self.precision @ taken
        inner = np.linalg.cholesky(taken.T @ seen + 1e-12 * np.eye(taken.shape[1]))
        lost = scipy.linalg.solve_triangular(inner, seen.T, lower=True).T
        told = scipy.linalg.solve_triangular(inner, taken.T @ self.scored, lower=True)
        evidence = self.evidence + 0.5 * float(told @ told)
        return _Rest(self.precision - lost @ lost.T, self.scored - lost @ told, evidence, lost)

    def information(self, profiles: _SparseMatrix) -> Array:
        """Return u' Sigma^-1 u (k,) for each of the profiles u (M, k)."""
        product = self.precision @ profiles
        if scipy.sparse.issparse(profiles):
            return np.asarray(profiles.multiply(product).sum(axis=0)).ravel()
        return np.asarray(np.sum(profiles * product, axis=0))

    def gains(self, profiles: _SparseMatrix, bare: Array | None = None) -> Array:
        """Return the rise (k,) of the log evidence by each profile (M, k) of best size. `bare`: from `information`."""
        told, sure = self._sizes(profiles, bare)
        return np.where(sure > 0, 0.5 * told**2 / np.where(sure > 0, sure, 1.0), 0.0)

    def sizes(self, profiles: Array) -> Array:
        """Return the best size (k,) of each profile (M, k); zero if the data have no information about it."""
        told, sure = self._sizes(profiles)
        return np.where(sure > 0, told / np.where(sure > 0, sure, 1.0), 0.0)

    def _sizes(self, profiles: _SparseMatrix, bare: Array | None = None) -> tuple[Array, Array]:
        sure = self.information(profiles) if bare is None else bare - np.sum((profiles.T @ self.lost) ** 2, axis=1)
        squares = profiles.power(2).sum(axis=0) if scipy.sparse.issparse(profiles) else np.sum(profiles**2, axis=0)
        seen = np.asarray(squares).ravel() * max(float(np.trace(self.precision)) / len(self.scored), 1e-300)
        return np.asarray(profiles.T @ self.scored), np.where(sure > 1e-6 * seen, sure, 0.0)


def detect_force_pulses(history: ForceEstimate, limits: Thresholds) -> tuple[list[DetectedForcePulse], float]:
    """Return the force pulses in a force estimate, largest evidence first, and the number of windows searched.

    The p-value of a pulse refers to a single window, so it must be corrected for the number of windows. Disjoint
    windows are counted; lengths within a factor of two count as one.
    """
    windows, tries, profiles = _looked_at(history.t.tobytes(), history.filter_cutoff, limits.max_event_duration)
    if not len(windows.begin):
        return [], 0.0
    seen = _Filter.of(history.filter_cutoff)
    rests = _rests(history)
    bare = [rest.information(profiles) for rest in rests]
    taken = np.zeros((len(history.t), 0))
    found: list[tuple[_Windows, float]] = []
    free = np.ones(len(windows.begin), bool)
    while taken.shape[1] < _MAX_PROFILES and np.any(free):
        beside = [rest.beside(taken) for rest in rests]
        gains = [free * rest.gains(profiles, known) for rest, known in zip(beside, bare, strict=True)]
        totals = [rest.evidence + float(gain.max()) for rest, gain in zip(beside, gains, strict=True)]
        best = int(np.argmax(totals))
        rest, gain = beside[best], gains[best]
        rise = max(totals) - max(rest.evidence for rest in beside)
        if rise < limits.min_log_bayes_factor:
            break
        window = _refined(history, rest, windows[[int(gain.argmax())]], seen, limits)
        own = seen(window, history.t)
        rise += float(rest.gains(own)[0] - gain.max())
        other = _other(history, rest, window, seen)
        if other is None and not _stands_out(history, rests[best], rest, window, seen, limits.max_event_duration):
            other = own
        taken = np.column_stack([taken, own if other is None else other])
        if other is None:
            found.append((window, rise))
        free &= (windows.end <= window.begin) | (windows.begin >= window.end)
    covered = sum(float(window.end[0] - window.begin[0]) for window, _ in found)
    if covered > MAX_EVENT_TIME_FRACTION * float(history.t[-1] - history.t[0]):
        return [], tries
    return _sized(history, rests, found, taken, seen), tries


@lru_cache(maxsize=8)
def _looked_at(times: bytes, cutoff: float, longest: float) -> tuple[_Windows, float, _SparseMatrix]:
    """Return windows to search, the number of disjoint ones, and profiles; cached for all joints of a recording."""
    t = np.frombuffer(times)
    spacing, first, last = float(np.median(np.diff(t))), float(t[0]), float(t[-1])
    lengths = [_MIN_PULSE_POINTS * spacing]
    while lengths[-1] * _WINDOW_GROWTH <= longest:
        lengths.append(lengths[-1] * _WINDOW_GROWTH)
    begins = [np.arange(first + spacing, last - spacing - length + 1e-9, spacing) for length in lengths]
    begin = np.concatenate(begins)
    windows = _both_shapes(begin, begin + np.repeat(lengths, [len(b) for b in begins]))
    # windows of similar length are not independent: lengths within a factor of two count as one
    tries = math.log2(_WINDOW_GROWTH) * sum((last - first) / length for length in lengths if length <= last - first)
    return windows, tries, _Filter.of(cutoff).of_many(windows, t)


def _both_shapes(begin: Array, end: Array) -> _Windows:
    """Return the windows twice, with rounded and with flat-topped profiles."""
    return _Windows(np.tile(begin, 2), np.tile(end, 2), np.repeat([False, True], len(begin)))


def _rests(history: ForceEstimate) -> list[_Rest]:
    values = history.most_likely_force_signal
    least = 1e-9 + float(np.median(history.model_error_std))
    spread = max(1.4826 * float(np.median(np.abs(values - np.median(values)))), least)
    slowest = max(float(np.sqrt(np.mean(values**2))), spread)
    grid = product(_MODEL_ERROR_FACTORS, _NOISE_FLOOR_FACTORS, _SLOW_FORCE_FACTORS)
    return [_Rest.of(history, error, floor * spread, slow * slowest) for error, floor, slow in grid]


def _refined(history: ForceEstimate, rest: _Rest, window: _Windows, seen: _Filter, limits: Thresholds) -> _Windows:
    """Return the window with start, end and shape changed for the largest evidence."""
    spacing = history.time_spacing
    first, last, shortest = history.t[0] + spacing, history.t[-1] - spacing, _MIN_PULSE_POINTS * spacing
    gain = float(rest.gains(seen(window, history.t))[0])
    moves = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j])
    for step in spacing / np.array([2.0, 4.0, 8.0]):
        while True:
            begin, end = window.begin + moves[:, 0] * step, window.end + moves[:, 1] * step
            inside = (begin >= first) & (end <= last) & (end - begin >= shortest)
            inside &= end - begin <= limits.max_event_duration
            tried = _both_shapes(begin[inside], end[inside])
            gains = rest.gains(seen(tried, history.t)) if np.any(inside) else np.zeros(1)
            if not float(gains.max()) > gain + 1e-3:
                break
            gain, window = float(gains.max()), tried[[int(gains.argmax())]]
    return window


def _other(history: ForceEstimate, rest: _Rest, window: _Windows, seen: _Filter) -> Array | None:
    """Return a step or biphasic profile (M,) that explains as much as the pulse, which is then no event; else None."""
    t, begin, end = history.t, float(window.begin[0]), float(window.end[0])
    length, gain = end - begin, float(rest.gains(seen(window, t))[0])
    steps = np.arange(begin - length / 2, end + length / 2, history.time_spacing)
    rising = [step for step in (np.asarray(t > at, float) for at in steps) if 1 < step.sum() < len(t) - 1]
    middles = (begin, begin + length / 4, (begin + end) / 2, end - length / 4, end)
    places = product(length * np.array([0.75, 1.0]), middles)
    swings = [np.sin(2 * np.pi * np.clip((t - middle) / wide, -0.5, 0.5)) for wide, middle in places]
    profiles = np.stack([*rising, *swings], axis=1)
    gains = rest.gains(profiles)
    best = int(gains.argmax())
    return profiles[:, best] if gains[best] >= gain else None


def _stands_out(
    history: ForceEstimate, bare: _Rest, rest: _Rest, window: _Windows, seen: _Filter, longest: float
) -> bool:
    """Return whether a pulse has an allowed length, fits the measured range, and exceeds the rest of the history."""
    t, begin, end = history.t, float(window.begin[0]), float(window.end[0])
    length, own = end - begin, seen(window, t)
    # a length at a bound is no pulse's: jumps of friction are shorter, model errors longer
    if not 1.02 * _MIN_PULSE_POINTS * history.time_spacing < length < 0.98 * longest:
        return False
    size = abs(float(rest.sizes(own)[0]))
    near = history.most_likely_force_signal[(t > begin - length) & (t < end + length)]
    if size * float(np.abs(own).max()) > _MAX_PULSE_RANGE_RATIO * float(np.ptp(near)):
        return False
    begins = np.arange(float(t[0]), float(t[-1]) - length, history.time_spacing)
    everywhere = _Windows(begins, begins + length, np.repeat(window.flat, len(begins)))
    return size > _MIN_PROMINENCE_RATIO * float(np.median(np.abs(bare.sizes(seen(everywhere, t)))))


def _sized(
    history: ForceEstimate, rests: Sequence[_Rest], found: Sequence[tuple[_Windows, float]], taken: Array, seen: _Filter
) -> list[DetectedForcePulse]:
    """Return the pulses with their sizes, which are estimated together on the background of largest evidence."""
    if not found:
        return []
    rest = max(rests, key=lambda one: one.beside(taken).evidence)
    spread = np.linalg.pinv(taken.T @ rest.precision @ taken, hermitian=True)
    size = spread @ (taken.T @ rest.scored)
    result = []
    for window, rise in found:
        at = int(np.argmin(np.sum((taken - seen(window, history.t)) ** 2, axis=0)))
        std, p_value = math.sqrt(max(float(spread[at, at]), 0.0)), math.erfc(math.sqrt(max(rise, 0.0)))
        begin, end, flat = float(window.begin[0]), float(window.end[0]), bool(window.flat[0])
        # at standstill, friction can change by twice its sliding torque
        stuck = np.max(history.friction_limit[(history.t >= begin) & (history.t <= end)], initial=0.0)
        if abs(float(size[at])) > 2 * float(stuck):
            result.append(DetectedForcePulse(begin, end, float(size[at]), flat, std, p_value))
    return result

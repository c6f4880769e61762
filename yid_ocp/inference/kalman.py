"""Linear Kalman filter and smoother, step by step or in compiled code.

References
----------
Bryson and Frazier (1963), Smoothing for linear and nonlinear dynamic systems, Aeronautical Systems Division report
TDR-63-119. Anderson and Moore (1979), Optimal Filtering, chapters 3 and 5.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import resources
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.linalg.lapack
from numpy.typing import NDArray

from yid_ocp.arrays import Array
from yid_ocp.integrator.compiler import compile_and_load_library
from yid_ocp.integrator.step_model import out_of_memory_error


@dataclass(frozen=True)
class StateTransition:
    """The transition of a filter's state x = (s, p) in one step: s' = M (s, sum of the groups p_i of p), p' = f p."""

    state_rows: Array  # M, shape (ns, ns + m); s has ns entries and p has g groups of m parameters
    decay: Array  # f, a factor for each parameter, shape (nx - ns,) = (g m,)

    @property
    def _shape(self) -> tuple[int, int]:
        m = self.state_rows.shape[1] - len(self.state_rows)
        return len(self.decay) // m if m else 0, m

    def propagate_state(self, columns: Array) -> Array:
        """Return c states (nx, c) after the step, from the states `columns` (nx, c) before it."""
        ns, own = len(self.state_rows), columns[len(self.state_rows) :]
        if self._shape[0] != 1:
            columns = np.vstack([columns[:ns], own.reshape(*self._shape, own.shape[1]).sum(axis=0)])
        return np.vstack([self.state_rows @ columns, self.decay[:, None] * own])

    def _propagate_costate_back(self, costate: Array) -> Array:
        """Costates (nx, c) before the step, from the costates (nx, c) after the step, by the transposed transition."""
        ns = len(self.state_rows)
        earlier = self.state_rows.T @ costate[:ns]
        apart = np.tile(earlier[ns:], (self._shape[0], 1)) + self.decay[:, None] * costate[ns:]
        return np.vstack([earlier[:ns], apart])


@dataclass(frozen=True)
class KalmanStepMatrices:
    """The matrices of one Kalman filter step with fixed gains. A measurement update precedes a state transition.

    The state x = (s, p) consists of dynamic states s and parameters p. It is measured by y = H x + e, where the noise e
    has unit covariance, and becomes x' = (M x, f p) + process noise, with the transition M and the decay f. P is the
    covariance before the measurement, and S = I + H P H'. The normalized innovations S^(-1/2) (y - H mean) of all steps
    are independent and have unit variance.
    """

    observation: Array  # H, shape (r, nx)
    whitening: Array  # S^(-1/2), shape (r, r)
    projected_covariance: Array  # S^(-1/2) H P, shape (r, nx)
    transition: StateTransition

    @cached_property
    def closed_loop(self) -> tuple[Array, Array]:
        """S^(-1/2) H (r, nx) and the transition of the error of the filter's mean in this step, (nx, nx)."""
        shaped = self.whitening @ self.observation
        return shaped, self.transition.propagate_state(np.eye(shaped.shape[1]) - self.projected_covariance.T @ shaped)

    def normalized_innovations_and_next_mean(self, mean: Array, measured: Array) -> tuple[Array, Array]:
        """Compute normalized innovations of `measured` (r, c) and next state means (nx, c). Columns are independent."""
        white = self.whitening @ (measured - self.observation @ mean)
        return white, self.transition.propagate_state(mean + self.projected_covariance.T @ white)

    def smoothed_measurement_noise_and_costate(self, white: Array, costate: Array) -> tuple[Array, Array]:
        """Compute smoothed measurement noise (r, c) and the costate (nx, c) before the step, backwards in time.

        `white` (r, c) are the normalized innovations and `costate` (nx, c) is the costate after the step. The smoothed
        state before the step is mean + P costate, with the filter's prediction (mean) and its covariance P.
        """
        pulled = self.transition._propagate_costate_back(costate)
        noise = self.whitening.T @ (white - self.projected_covariance @ pulled)
        return noise, pulled + self.observation.T @ noise

    def costate_covariances_before(self, information: Array, other: Array, seen: Array) -> tuple[Array, Array, Array]:
        """Compute covariances of the costate before the step, also of the costates of m parameters of any variance.

        `information` (nx, nx) is that of the state's costate after the step. `other` (m, nx) is that of the parameters'
        costates, already before the transition, with it. `seen` (r, m) is S^(-1/2) times the measurement's derivatives
        by them. Returns both before the step, and what the measurement adds to the parameters' variances (m,).
        """
        shaped, closed = self.closed_loop
        drive = self.transition.propagate_state(self.projected_covariance.T @ seen)
        pushed = information @ drive
        found = closed.T @ information @ closed + shaped.T @ shaped
        added = np.sum(seen**2, axis=0) + np.sum(drive * (pushed - 2 * other.T), axis=0)
        return (found + found.T) / 2, (other - pushed.T) @ closed + seen.T @ shaped, added


def kalman_covariance_step(
    covariance: Array, observation: Array, transition: StateTransition
) -> tuple[KalmanStepMatrices, Array, float]:
    """Compute the gains of a filter step, the next state covariance without process noise, and log det S.

    `covariance` is P (nx, nx) before the measurement, `observation` is H (r, nx), and S = I + H P H' is the covariance
    of the innovation. If rounding makes S indefinite, only its diagonal is used, and log det S is returned as infinity.
    """
    cross = observation @ covariance
    whitening, log_determinant = np.zeros((0, 0)), 0.0
    if len(observation):
        factor, failed = scipy.linalg.lapack.dpotrf(cross @ observation.T + np.eye(len(observation)), lower=1)
        if failed:
            factor = np.diag(np.sqrt(1.0 + np.maximum(np.sum(cross * observation, axis=1), 0.0)))
        whitening = scipy.linalg.lapack.dtrtri(factor, lower=1)[0]
        log_determinant = math.inf if failed else 2 * float(np.sum(np.log(np.diag(factor))))
    projected = whitening @ cross
    later = transition.propagate_state(transition.propagate_state(covariance - projected.T @ projected).T)
    return KalmanStepMatrices(observation, whitening, projected, transition), later, log_determinant


@cache
def _library() -> ctypes.CDLL | None:
    source = resources.files("yid_ocp.inference").joinpath("kalman.c").read_text(encoding="utf-8")
    return compile_and_load_library(source, level="-O3")


@dataclass(frozen=True)
class PrecomputedKalmanFilter:
    """A sequence of k steps of a linear Kalman filter with fixed gains, in compiled code if possible.

    The r rows of the matrices of all steps (see `KalmanStepMatrices`) are stacked. Step j begins at row `row_start[j]`.
    """

    row_start: Sequence[int]
    moves: Array  # state rows of k steps' transitions and, beside them, noise of the states, (k, ns, ns + m + noises)
    noises: int
    decay: Array  # decay of the parameters, shape (k, nx - ns)
    observation: Array  # shape (r, nx)
    whitening: Array  # shape (sum of squared row counts,)
    projected_covariance: Array  # shape (r, nx)

    @property
    def _spans(self) -> list[slice]:
        return [slice(*ends) for ends in pairwise(self.row_start)]

    @property
    def _transitions(self) -> list[StateTransition]:
        known = self.moves.shape[2] - self.noises
        return [StateTransition(move[:, :known], own) for move, own in zip(self.moves, self.decay, strict=True)]

    def _single_steps(self) -> list[tuple[slice, KalmanStepMatrices]]:
        roots = np.split(self.whitening, np.cumsum([(span.stop - span.start) ** 2 for span in self._spans])[:-1])
        found = []
        for span, root, transition in zip(self._spans, roots, self._transitions, strict=True):
            own, count = self.observation[span], span.stop - span.start
            step = KalmanStepMatrices(own, root.reshape(count, count), self.projected_covariance[span], transition)
            found.append((span, step))
        return found

    def normalized_innovations_and_next_mean(
        self, mean: Array, measured: Array, shift: Array, push: Array | None = None, keep_means: bool = False
    ) -> tuple[Array, Array, Array | None]:
        """Filter all steps, and return the normalized innovations (r, c) and the final state means (nx, c).

        With `keep_means`, the means before each step (k, nx, c) are returned too. `mean` is the mean before all steps,
        `measured` (r, c) the measurements. `push` (k, m, c) is added to the sum of the parameter groups in the
        transition of each step. `shift` (k, nx - ns) is added to the parameters of the first column after each step.
        """
        if (library := _library()) is not None:
            seen = np.empty((len(self.moves), *mean.shape)) if keep_means else None
            return *self._compiled_columns(library, measured, mean, seen, push, shift), seen
        white, before, ns = np.empty_like(measured), list[Array](), self.moves.shape[1]
        for span, step in self._single_steps():
            k = len(before)
            before.append(mean)
            white[span], mean = step.normalized_innovations_and_next_mean(mean, measured[span])
            if push is not None:
                mean[:ns] += step.transition.state_rows[:, ns:] @ push[k]
            mean[ns:, 0] += shift[k]
        return white, mean, np.array(before) if keep_means else None

    def smoothed_measurement_noise_and_costate(self, white: Array, costate: Array) -> tuple[Array, Array, Array]:
        """Smooth all steps backwards in time. `costate` (nx, c) is the costate after the last step.

        Returns the smoothed measurement noise (r, c), the costate before the first step (nx, c) and the costates after
        each step (k, nx, c). `white` (r, c) are the normalized innovations.
        """
        seen = np.empty((len(self.moves), *costate.shape))
        if (library := _library()) is not None:
            return *self._compiled_columns(library, white, costate, seen), seen
        noise = np.empty_like(white)
        for k, (span, step) in reversed(list(enumerate(self._single_steps()))):
            seen[k] = costate
            noise[span], costate = step.smoothed_measurement_noise_and_costate(white[span], costate)
        return noise, costate, seen

    def _compiled_columns(
        self, library: ctypes.CDLL, rows: Array, state: Array, seen: Array | None, *inputs: Array | None
    ) -> tuple[Array, Array]:
        """Rows and state after the compiled recursion of the mean (with `inputs` push and shift) or of the costate."""
        rows, state = rows.copy(), state.copy()
        size = np.array([*self.moves.shape, len(state), self.moves.shape[2] - self.noises], np.int32)
        steps: list[NDArray[Any] | None] = [size, np.array(self.row_start, np.int32), self.moves, self.decay, None]
        steps += [self.observation, self.whitening, self.projected_covariance, None]
        given = [None if a is None else np.ascontiguousarray(a) for a in inputs or (None, None)]
        columns: list[NDArray[Any] | None] = [np.array(state.shape[1:], np.int32), rows, state, seen, *given]
        if not library.yid_kalman_columns(_addresses(steps), _addresses(columns), ctypes.c_int(not inputs)):
            raise out_of_memory_error("one step of a Kalman filter", 4 * state.nbytes)
        return rows, state


def _addresses(arrays: Sequence[NDArray[Any] | None]) -> ctypes.Array[ctypes.c_void_p]:
    """A C struct of the addresses of contiguous arrays. The caller keeps the arrays alive. None is a null pointer."""
    return (ctypes.c_void_p * len(arrays))(*(None if array is None else array.ctypes.data for array in arrays))


def precompute_kalman_filter(
    covariance: Array,
    observation: Array,
    row_start: Sequence[int],
    moves: Array,
    noises: int,
    decay: Array,
    variance: Array,
) -> tuple[PrecomputedKalmanFilter, Array]:
    """Compute k successive steps of a Kalman filter. Returns the steps and the state covariance (nx, nx) after them.

    The last `noises` columns of `moves` (k, ns, ns + m + noises) are the effect of unit noises on the states. After
    each step, `variance` (k, nx - ns) adds to the parameters' variance. Other arguments: see `PrecomputedKalmanFilter`.
    """
    count, library, covariance = np.diff(row_start), _library(), covariance.copy()
    white, projected = np.empty(int(np.sum(count**2))), np.empty_like(observation)
    moves, decay, variance, observation = map(np.ascontiguousarray, (moves, decay, variance, observation))
    found = PrecomputedKalmanFilter(row_start, moves, noises, decay, observation, white, projected)
    ns, known = moves.shape[1], moves.shape[2] - noises
    if library is None:
        roots, parameters = np.split(white, np.cumsum(count**2)[:-1]), np.arange(ns, len(covariance))
        for k, (span, transition) in enumerate(zip(found._spans, found._transitions, strict=True)):
            step, covariance, _ = kalman_covariance_step(covariance, observation[span], transition)
            roots[k][:], projected[span] = step.whitening.ravel(), step.projected_covariance
            covariance[parameters, parameters] += variance[k]
            covariance[:ns, :ns] += moves[k, :, known:] @ moves[k, :, known:].T
            covariance = 0.5 * (covariance + covariance.T)
        return found, covariance
    size = np.array([*moves.shape, len(covariance), known], np.int32)
    arrays: list[NDArray[Any] | None] = [size, np.array(row_start, np.int32), moves, decay, variance, observation]
    arrays += [white, projected, covariance]
    if not library.yid_kalman_steps(_addresses(arrays)):
        raise out_of_memory_error("one step of a Kalman filter", 4 * covariance.nbytes)
    return found, covariance

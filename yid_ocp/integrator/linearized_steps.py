"""Linearized single steps along a rollout: derivatives of the next state by state, torque and loads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.step import Step
from yid_ocp.integrator.step_model import Rollout

Array = NDArray[np.float64]

_STEPS_PER_CHUNK = 50
"""Number of steps linearised at once, limited because their matrices are dense."""

_MIN_SLOPE = 1e-12
"""Smallest derivative by an internal state that is not regarded as rounding error."""

_ALL_STEPS = slice(None)


@dataclass(frozen=True)
class LinearizedStep:
    """Jacobians A_k, B_k, E_k of one step by the implicit function theorem, at the applied torque.

    Attributes
    ----------
    state_by_state : ndarray, shape (nx, nx)
        A_k = dx_{k+1}/dx_k
    state_by_torque : ndarray, shape (nx, nu)
        B_k = dx_{k+1}/du_k
    state_by_load : ndarray, shape (nx, e)
        E_k = dx_{k+1}/d(additional loads)
    effort_by_state : ndarray, shape (nc, nx)
        Of the effort that the prescribed coordinates need at node k.
    effort_by_torque : ndarray, shape (nc, nu)
    effort_by_load : ndarray, shape (nc, e)
    """

    state_by_state: Array
    state_by_torque: Array
    state_by_load: Array
    effort_by_state: Array
    effort_by_torque: Array
    effort_by_load: Array


@dataclass(frozen=True)
class AdditionalLoads:
    """First-order effect of e additional loads on the equations of every step, one column each.

    Attributes
    ----------
    residual : ndarray, shape (nt, e)
        Added to the balance, internal and constraint equations.
    next_momentum : ndarray, shape (n, e)
        Added to p_{k+1}.
    """

    residual: Array
    next_momentum: Array


def active_state_mask(
    step: Step, steps: Sequence[LinearizedStep], seen: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Mask of the states that move and that affect others, efforts or sensors, shape (nx,).

    Internal states of a neutral effect are excluded.

    Parameters
    ----------
    step : Step
    steps : sequence of LinearStep
        A representative sample.
    seen : ndarray of bool, shape (nx,), optional
        Those that sensors depend on.
    """
    by_state = np.max([np.abs(one.state_by_state) for one in steps], axis=0)
    by_input = np.max([np.abs(np.hstack([one.state_by_torque, one.state_by_load])) for one in steps], axis=0)
    moved = np.any(by_state > 0, axis=1) | np.any(by_input > 0, axis=1)
    moved[list(step.system.prescribed_indices)] = False
    felt = np.arange(len(moved)) < 2 * step.sizes["n"]
    felt |= False if seen is None else seen
    felt |= np.any([np.any(np.abs(one.effort_by_state) > _MIN_SLOPE, axis=0) for one in steps], axis=0)
    while np.any(more := ~felt & np.any(by_state[felt] > _MIN_SLOPE, axis=0)):
        felt |= more
    return moved & felt


def linearized_steps(
    step: Step, theta: Array, rollout: Rollout, loads: AdditionalLoads | None = None, chosen: slice = _ALL_STEPS
) -> Iterator[LinearizedStep]:
    """Iterate over the linearized steps of a finished rollout, with prescribed coordinates unchanged.

    Parameters
    ----------
    step : Step
    theta : ndarray, shape (ntheta,)
    rollout : Rollout
    loads : Loads, optional
    chosen : slice
        Steps in a row; all by default.
    """
    sizes = step.sizes
    if loads is None:
        loads = AdditionalLoads(np.zeros((sizes["n"] + sizes["nz"] + sizes["m"], 0)), np.zeros((sizes["n"], 0)))
    begin, end, _ = chosen.indices(len(rollout.torque))
    for first in range(begin, end, _STEPS_PER_CHUNK):
        yield from _chunk(step, theta, rollout, loads, slice(first, min(first + _STEPS_PER_CHUNK, end)))


def _chunk(step: Step, theta: Array, rollout: Rollout, loads: AdditionalLoads, span: slice) -> list[LinearizedStep]:
    nx, nu = step.sizes["nx"], step.sizes["nu"]
    state = rollout.state[span.start : span.stop + 1]
    along = (theta, state, rollout.multipliers[span], rollout.torque[span])
    after, effort = step.kernel.step_jacobians(*along, loads.residual, loads.next_momentum)
    parts = (slice(0, nx), slice(nx, nx + nu), slice(nx + nu, after.shape[2]))
    return [
        LinearizedStep(*(a[:, part] for part in parts), *(e[:, part] for part in parts))
        for a, e in zip(after, effort, strict=True)
    ]

"""Single steps along a rollout, linearised: what a small change of state or torque does one step later."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.step import Step
from yid_ocp.integrator.step_model import Rollout

Array = NDArray[np.float64]

CHUNK = 50
"""Steps that are linearised at once: their matrices are dense."""


@dataclass(frozen=True)
class LinearStep:
    """The derivatives of one step by the implicit function theorem, with the torque as it was applied.

    Attributes
    ----------
    by_state : ndarray, shape (nx, nx)
        A_k = dx_{k+1}/dx_k
    by_torque : ndarray, shape (nx, nu)
        B_k = dx_{k+1}/du_k
    effort_by_state : ndarray, shape (nc, nx)
        Of the effort that the prescribed coordinates need at node k.
    effort_by_torque : ndarray, shape (nc, nu)
    """

    by_state: Array
    by_torque: Array
    effort_by_state: Array
    effort_by_torque: Array


def linear_steps(step: Step, theta: Array, rollout: Rollout) -> Iterator[LinearStep]:
    """Derivatives of every step of a finished rollout, in order; prescribed coordinates stay as they are.

    Parameters
    ----------
    step : Step
    theta : ndarray, shape (ntheta,)
    rollout : Rollout
    """
    for first in range(0, len(rollout.torque), CHUNK):
        yield from _chunk(step, theta, rollout, slice(first, min(first + CHUNK, len(rollout.torque))))


def _chunk(step: Step, theta: Array, rollout: Rollout, span: slice) -> list[LinearStep]:
    sizes, h = step.sizes, step.time_step
    n, nz, nu, nx = sizes["n"], sizes["nz"], sizes["nu"], sizes["nx"]
    nt, count = n + nz + sizes["m"], span.stop - span.start
    free, fixed = (np.array(index, int) for index in (step.system.free_indices, step.system.prescribed_indices))
    state = rollout.state[span.start : span.stop + 1]
    found = step.kernel.linearize(theta, state, rollout.multipliers[span], rollout.torque[span], (), True)
    top, bottom = np.zeros((count, nt, nx + nu)), np.zeros((count, n, nx + nu))
    for target, old, push in ((top, found.rows_old, found.rows_input), (bottom, found.p1_old, found.p1_input)):
        target[:, :, :n], target[:, :, 2 * n : nx], target[:, :, nx:] = old[:, :, :n], old[:, :, n:], push
    top[:, np.arange(n), n + np.arange(n)] += 1.0
    solved = np.concatenate([free, np.arange(n, nt)])
    moved = -np.linalg.solve(found.rows_new[:, solved[:, None], solved], top[:, solved])
    after = np.zeros((count, nx, nx + nu))
    after[:, free] = moved[:, : len(free)]
    after[:, n : 2 * n] = bottom + found.p1_new[:, :, solved] @ moved
    after[:, 2 * n :] = moved[:, len(free) : len(free) + nz]
    effort = -(top[:, fixed] + found.rows_new[:, fixed[:, None], solved] @ moved) / h
    return [LinearStep(a[:, :nx], a[:, nx:], e[:, :nx], e[:, nx:]) for a, e in zip(after, effort, strict=True)]

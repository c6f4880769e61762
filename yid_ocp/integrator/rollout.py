"""Rollouts of a system: simulation, forward sensitivities, the adjoint gradient, and their single steps linearized."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array, BoolArray
from yid_ocp.errors import ModelError
from yid_ocp.integrator.step import Step, checked_float_array
from yid_ocp.integrator.step_model import CostGradient, Rollout, RolloutInputs, SensitivityDirections, TrackingFeedback
from yid_ocp.parallel import CASADI_LOCK

_STEPS_PER_CHUNK = 50  # linearised at once, few because their matrices are dense
_MIN_SLOPE = 1e-12  # derivatives by an internal state up to here are rounding
_ALL_STEPS = slice(None)


def simulate(
    step: Step,
    theta: ArrayLike,
    start: ArrayLike,
    steps: int,
    torque: ArrayLike | None = None,
    path: ArrayLike | None = None,
    feedback: TrackingFeedback | None = None,
    directions: SensitivityDirections | None = None,
) -> Rollout:
    """Simulate a system, with forward sensitivities if directions are given; `simulate_batch` is faster for many.

    Parameters
    ----------
    start : array_like, shape (nx,)
        Initial (q, p, z).
    steps : int
        N
    torque : array_like, shape (N, nu), optional
        Nominal motor torque of every step [N m]; zero when absent.
    path : array_like, shape (N + 1, nc), optional
        Prescribed coordinates at every node; held at their initial value when absent.

    Returns
    -------
    Rollout
        With NaN after the step at which Newton failed; `status` says so.

    Raises
    ------
    ModelError
        An array of the wrong shape.
    """
    return simulate_batch(
        step, [checked_rollout_inputs(step, theta, start, steps, torque, path, feedback, directions)]
    )[0]


def simulate_batch(step: Step, members: Sequence[RolloutInputs]) -> list[Rollout]:
    """Simulate several `checked_rollout_inputs`, in batches where faster; equal to `simulate` but for rounding."""
    return step.kernel.rollout_batch(members)


def checked_rollout_inputs(
    step: Step,
    theta: ArrayLike,
    start: ArrayLike,
    steps: int,
    torque: ArrayLike | None = None,
    path: ArrayLike | None = None,
    feedback: TrackingFeedback | None = None,
    directions: SensitivityDirections | None = None,
) -> RolloutInputs:
    """`RolloutInputs` of one rollout, with shapes checked; arguments and errors as in `simulate`."""
    sizes, check = step.sizes, checked_float_array
    nx, nu, nc = sizes["nx"], sizes["nu"], sizes["nc"]
    if steps < 1:
        raise ModelError(f"steps = {steps}", allowed="a whole number from 1")
    begin = check("start", start, (nx,)).copy()
    fixed = list(step.system.prescribed_coordinate_indices)
    inputs = np.zeros((steps, nu)) if torque is None else check("torque", torque, (steps, nu))
    course = np.tile(begin[fixed], (steps + 1, 1)) if path is None else check("path", path, (steps + 1, nc))
    begin[fixed] = course[0]
    if directions is not None:
        d, along = directions.count, directions.prescribed_tangents
        check("directions.start", directions.initial_state_tangents, (nx, d))
        if directions.torque_tangents is not None:
            check("directions.torque", directions.torque_tangents, (steps, nu, d))
        if along is not None:
            check("directions.path", along, (steps + 1, nc, d))
            first = directions.initial_state_tangents.copy()
            first[fixed] = along[0]
            directions = replace(directions, initial_state_tangents=first)
    values = check("theta", theta, (sizes["ntheta"],))
    return RolloutInputs(values, begin, inputs, course, feedback, directions)


def applied_joint_torque(step: Step, theta: ArrayLike, rollout: Rollout) -> Array:
    """Torque at driven joints in every step, shape (N, nu) [N m]: the input, or the torque of position servos."""
    system, h = step.system, step.time_step
    if not system.servos:
        return rollout.torque
    e, driven = step.equations, list(system.driven_coordinate_indices)
    q = rollout.state[:, : system.n_coordinates]
    with CASADI_LOCK:
        force = ca.densify(system.input_force(e.u, e.q0, e.q1)[driven])
        function = ca.Function("applied", [e.u, e.q0, e.q1, e.theta], [force])
    middle, rate = (q[1:] + q[:-1]) / 2, np.diff(q, axis=0) / h
    return np.array(function.map(len(rate))(rollout.torque.T, middle.T, rate.T, np.asarray(theta, float))).T


def adjoint_gradient(
    step: Step,
    theta: ArrayLike,
    rollout: Rollout,
    names: Sequence[str],
    by_state: ArrayLike,
    by_multipliers: ArrayLike | None = None,
    by_effort: ArrayLike | None = None,
    feedback: TrackingFeedback | None = None,
) -> CostGradient:
    """Gradient of a cost along a finished rollout by the adjoint (the paper's Lemma 1).

    costate_N = dJ/dx_N, costate_k = costate_{k+1} A_k + dJ/dx_k, gradient = sum_k costate_{k+1} B_k.

    Parameters
    ----------
    rollout : Rollout
        From `simulate` with the same theta and feedback.
    names : sequence of str
        Parameters by which to differentiate.
    by_state, by_multipliers, by_effort : array_like, shape (N + 1, nx), (N, m) and (N, nc)
        Partial derivatives of the cost.
    """
    sizes, steps, check = step.sizes, len(rollout.multipliers), checked_float_array
    outer = check("by_state", by_state, (steps + 1, sizes["nx"]))
    last = None if by_multipliers is None else check("by_multipliers", by_multipliers, (steps, sizes["m"]))
    effort = None if by_effort is None else check("by_effort", by_effort, (steps, sizes["nc"]))
    values = check("theta", theta, (sizes["ntheta"],))
    return step.kernel.adjoint_gradient(values, rollout, feedback, tuple(names), outer, last, effort)


def generalized_momentum(step: Step, q: ArrayLike, v: ArrayLike, theta: ArrayLike) -> Array:
    """Generalized momentum dL/dv at (q, v) [N m s], of a compliant coordinate times its compliance, shape of q.

    `q` and `v` have the shape (n,) or (K, n).
    """
    e, s = step.equations, step.sizes
    half = np.atleast_2d(np.asarray(v, float)) * step.time_step / 2
    middle = np.atleast_2d(np.asarray(q, float))
    with CASADI_LOCK:
        function = ca.Function("momentum", e.arguments, [e.row_scale * e.rigid_body_terms.lagrangian_by_v])
    none = [np.zeros(s[key]) for key in ("n", "nz", "nz", "m", "nu")]
    last, pairs = (np.asarray(theta, float), step.time_step), zip(middle, half, strict=True)
    rows = [np.array(function(m - d, m + d, *none, *last)).ravel() for m, d in pairs]
    return np.array(rows).reshape(np.shape(q))


@dataclass(frozen=True)
class LinearizedStep:
    """Derivatives of a step's next state and prescribed effort by state, torque and loads, at the applied torque.

    A_k = dx_{k+1}/dx_k (nx, nx), B_k = dx_{k+1}/du_k (nx, nu), E_k = dx_{k+1}/d(additional loads) (nx, e), and the same
    of the effort that the prescribed coordinates need at node k (nc, ...).
    """

    state_by_state: Array
    state_by_torque: Array
    state_by_load: Array
    effort_by_state: Array
    effort_by_torque: Array
    effort_by_load: Array


@dataclass(frozen=True)
class AdditionalLoadDerivatives:
    """Derivatives of a step's equations (nt, e) and next momentum (n, e) by e loads, equal in all steps."""

    residual: Array
    next_momentum: Array


def active_state_mask(step: Step, steps: Sequence[LinearizedStep], seen: BoolArray | None = None) -> BoolArray:
    """Mask of the states that move and that affect others, efforts or sensors, shape (nx,).

    Internal states of a neutral effect are excluded. `steps` are a representative sample, `seen` (nx,) says which
    states sensors depend on.
    """
    by_state = np.max([np.abs(one.state_by_state) for one in steps], axis=0)
    by_input = np.max([np.abs(np.hstack([one.state_by_torque, one.state_by_load])) for one in steps], axis=0)
    moved = np.any(by_state > 0, axis=1) | np.any(by_input > 0, axis=1)
    moved[list(step.system.prescribed_coordinate_indices)] = False
    felt = np.arange(len(moved)) < 2 * step.sizes["n"]
    felt |= False if seen is None else seen
    felt |= np.any([np.any(np.abs(one.effort_by_state) > _MIN_SLOPE, axis=0) for one in steps], axis=0)
    while np.any(more := ~felt & np.any(by_state[felt] > _MIN_SLOPE, axis=0)):
        felt |= more
    return moved & felt


def linearized_steps(
    step: Step,
    theta: Array,
    rollout: Rollout,
    loads: AdditionalLoadDerivatives | None = None,
    chosen: slice = _ALL_STEPS,
) -> Iterator[LinearizedStep]:
    """Iterate over the linearized steps of a finished rollout, with prescribed coordinates unchanged.

    `chosen` is a slice of steps in a row; all by default.
    """
    sizes = step.sizes
    if loads is None:
        loads = AdditionalLoadDerivatives(
            np.zeros((sizes["n"] + sizes["nz"] + sizes["m"], 0)), np.zeros((sizes["n"], 0))
        )
    begin, end, _ = chosen.indices(len(rollout.torque))
    for first in range(begin, end, _STEPS_PER_CHUNK):
        yield from _chunk(step, theta, rollout, loads, slice(first, min(first + _STEPS_PER_CHUNK, end)))


def _chunk(
    step: Step, theta: Array, rollout: Rollout, loads: AdditionalLoadDerivatives, span: slice
) -> list[LinearizedStep]:
    """Some steps by the implicit function theorem; `numpy.linalg.LinAlgError` where their equations are singular."""
    n, nz, nx, nu = (step.sizes[key] for key in ("n", "nz", "nx", "nu"))
    system, state = step.system, rollout.state[span.start : span.stop + 1]
    free, fixed = list(system.unprescribed_coordinate_indices), list(system.prescribed_coordinate_indices)
    found = step.kernel.linearize(theta, state, rollout.multipliers[span], rollout.torque[span], (), True)
    loaded, count = loads.residual.shape[1], len(found.p1)
    top, bottom = (np.zeros((count, rows, nx + nu + loaded)) for rows in (found.residual.shape[1], n))
    for target, old, push, load in (
        (top, found.residual_by_old, found.residual_by_input, loads.residual),
        (bottom, found.p1_by_old, found.p1_by_input, loads.next_momentum),
    ):
        target[:, :, :n], target[:, :, 2 * n : nx] = old[:, :, :n], old[:, :, n:]
        target[:, :, nx : nx + nu], target[:, :, nx + nu :] = push, load
    top[:, np.arange(n), n + np.arange(n)] += 1.0
    solved = step.model.index_tables.unknown_rows
    moved = -np.linalg.solve(found.residual_by_new[:, solved[:, None], solved], top[:, solved])
    after = np.zeros((count, nx, top.shape[2]))
    after[:, free] = moved[:, : len(free)]
    after[:, n : 2 * n] = bottom + found.p1_by_new[:, :, solved] @ moved
    after[:, 2 * n :] = moved[:, len(free) : len(free) + nz]
    effort = top[:, fixed] + found.residual_by_new[:, np.array(fixed, int)[:, None], solved] @ moved
    effort /= -step.equation_time_step(theta)
    parts = (slice(0, nx), slice(nx, nx + nu), slice(nx + nu, None))
    return [
        LinearizedStep(*(a[:, part] for part in parts), *(e[:, part] for part in parts))
        for a, e in zip(after, effort, strict=True)
    ]

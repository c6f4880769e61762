"""Rollouts of a system: simulation, forward sensitivities and the adjoint gradient."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.errors import ModelError
from yid_ocp.integrator.step import Step, float_array_of_shape
from yid_ocp.integrator.step_model import CostGradient, Rollout, RolloutInputs, SensitivityDirections, TrackingFeedback
from yid_ocp.parallel import CASADI_LOCK

Array = NDArray[np.float64]


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
    """Simulate a system, with forward sensitivities if directions are given.

    For many parameters, initial states or inputs `simulate_batch` is faster.

    Parameters
    ----------
    step : Step
    theta : array_like, shape (ntheta,)
    start : array_like, shape (nx,)
        Initial (q, p, z).
    steps : int
        N
    torque : array_like, shape (N, nu), optional
        Nominal motor torque of every step [N m]; zero when absent.
    path : array_like, shape (N + 1, nc), optional
        Prescribed coordinates at every node; held at their initial value when absent.
    feedback : Feedback, optional
    directions : Directions, optional

    Returns
    -------
    Rollout
        With NaN after the step at which Newton failed; `status` says so.

    Raises
    ------
    ModelError
        An array of the wrong shape.
    """
    return simulate_batch(step, [rollout_inputs(step, theta, start, steps, torque, path, feedback, directions)])[0]


def simulate_batch(step: Step, members: Sequence[RolloutInputs]) -> list[Rollout]:
    """Simulate several rollouts, in batches where that is faster; equal to `simulate` of each but for rounding.

    Parameters
    ----------
    step : Step
    members : sequence of Member
        From `rollout_inputs`.

    Returns
    -------
    list of Rollout
    """
    return step.kernel.rollout_batch(members)


def rollout_inputs(
    step: Step,
    theta: ArrayLike,
    start: ArrayLike,
    steps: int,
    torque: ArrayLike | None = None,
    path: ArrayLike | None = None,
    feedback: TrackingFeedback | None = None,
    directions: SensitivityDirections | None = None,
) -> RolloutInputs:
    """The inputs of one rollout with checked shapes; arguments and errors as in `simulate`."""
    sizes = step.sizes
    if steps < 1:
        raise ModelError(f"steps = {steps}", allowed="a whole number from 1")
    begin = float_array_of_shape("start", start, (sizes["nx"],)).copy()
    fixed = list(step.system.prescribed_indices)
    inputs = (
        np.zeros((steps, sizes["nu"]))
        if torque is None
        else float_array_of_shape("torque", torque, (steps, sizes["nu"]))
    )
    course = (
        np.tile(begin[fixed], (steps + 1, 1))
        if path is None
        else float_array_of_shape("path", path, (steps + 1, sizes["nc"]))
    )
    begin[fixed] = course[0]
    if directions is not None:
        d = directions.count
        float_array_of_shape("directions.start", directions.initial_state_tangents, (sizes["nx"], d))
        if directions.torque_tangents is not None:
            float_array_of_shape("directions.torque", directions.torque_tangents, (steps, sizes["nu"], d))
        if directions.prescribed_tangents is not None:
            float_array_of_shape("directions.path", directions.prescribed_tangents, (steps + 1, sizes["nc"], d))
            if fixed:
                first = directions.initial_state_tangents.copy()
                first[fixed] = directions.prescribed_tangents[0]
                directions = SensitivityDirections(
                    directions.parameter_names, first, directions.torque_tangents, directions.prescribed_tangents
                )
    values = float_array_of_shape("theta", theta, (sizes["ntheta"],))
    return RolloutInputs(values, begin, inputs, course, feedback, directions)


def applied_joint_torque(step: Step, theta: ArrayLike, rollout: Rollout) -> NDArray[np.float64]:
    """Torque at driven joints in every step, shape (N, nu) [N m]: the input, or the torque of position servos."""
    system, h = step.system, step.time_step
    if not system.servos:
        return rollout.torque
    e, driven = step.equations, list(system.driven_indices)
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
    step : Step
    theta : array_like, shape (ntheta,)
    rollout : Rollout
        From `simulate` with the same theta and feedback.
    names : sequence of str
        Parameters by which to differentiate.
    by_state : array_like, shape (N + 1, nx)
        Partial derivatives of the cost by the state at every node.
    by_multipliers : array_like, shape (N, m), optional
    by_effort : array_like, shape (N, nc), optional
    feedback : Feedback, optional

    Returns
    -------
    Gradient
    """
    sizes, steps = step.sizes, len(rollout.multipliers)
    outer = float_array_of_shape("by_state", by_state, (steps + 1, sizes["nx"]))
    last = (
        None if by_multipliers is None else float_array_of_shape("by_multipliers", by_multipliers, (steps, sizes["m"]))
    )
    effort = None if by_effort is None else float_array_of_shape("by_effort", by_effort, (steps, sizes["nc"]))
    values = float_array_of_shape("theta", theta, (sizes["ntheta"],))
    return step.kernel.adjoint_gradient(values, rollout, feedback, tuple(names), outer, last, effort)


def generalized_momentum(step: Step, q: ArrayLike, v: ArrayLike, theta: ArrayLike) -> Array:
    """Generalized momentum dL/dv at (q, v) [N m s], of a compliant coordinate times its compliance.

    Parameters
    ----------
    step : Step
    q, v : array_like, shape (n,) or (K, n)
        Configurations and velocities.
    theta : array_like, shape (ntheta,)

    Returns
    -------
    ndarray, of the shape of q
    """
    e, s = step.equations, step.sizes
    half = np.atleast_2d(np.asarray(v, float)) * step.time_step / 2
    middle = np.atleast_2d(np.asarray(q, float))
    with CASADI_LOCK:
        function = ca.Function("momentum", e.arguments, [e.row_scale * e.rigid_body_terms.lagrangian_by_v])
    none = [np.zeros(s[key]) for key in ("n", "nz", "nz", "m", "nu")]
    values = np.asarray(theta, float)
    rows = [
        np.array(function(m - d, m + d, *none, values, step.time_step)).ravel()
        for m, d in zip(middle, half, strict=True)
    ]
    return np.array(rows).reshape(np.shape(q))

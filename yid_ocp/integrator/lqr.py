"""The tracking filter of driven arms: feedback about the measured motion, with gains from a finite-horizon LQR."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from yid_ocp.errors import ModelError
from yid_ocp.integrator.step import Step, compile_step_like
from yid_ocp.integrator.step_model import NEWTON_ITERATION_LIMIT, TrackingFeedback
from yid_ocp.model.system import System

Array = NDArray[np.float64]


def proportional_feedback(step: Step, measured: ArrayLike, gains: ArrayLike) -> TrackingFeedback:
    """Feedback u_k = ubar_k - K (q_k - qbar_k) with a constant diagonal K on the driven joints.

    Parameters
    ----------
    step : Step
    measured : array_like, shape (N + 1, nu)
        Measured angles qbar of the driven joints at every node [rad].
    gains : array_like, shape (nu,) or scalar
        [N m/rad]

    Raises
    ------
    ModelError
        A negative gain, or a number of gains that is neither one nor nu.
    """
    reference = np.asarray(measured, float)
    nu = step.sizes["nu"]
    values = np.atleast_1d(np.asarray(gains, float))
    if values.size not in (1, nu) and nu % max(values.size, 1):
        raise ModelError(f"{values.size} gains for {nu} driven joints", allowed=f"one, {nu}, or one arm's worth")
    values = np.resize(values, nu)
    if np.any(values < 0):
        raise ModelError(f"a tracking gain is negative: {values.min():g} N m/rad", allowed="0 or more")
    steps = len(reference) - 1
    gain = np.broadcast_to(np.diag(values), (steps, nu, nu)).copy()
    return TrackingFeedback(np.array(step.system.driven_indices, np.int32), gain, reference[:-1])


def lqr_feedback(
    step: Step,
    measured: ArrayLike,
    torque: ArrayLike,
    theta: ArrayLike,
    angle_std: ArrayLike = 0.02,
    rate_std: float = 0.3,
    torque_std: ArrayLike = 1.0,
    arms: Step | None = None,
) -> TrackingFeedback:
    """Feedback of a finite-horizon LQR of the driven arms, linearised about their measured motion.

    Minimises the sum of |dq|^2/angle_std^2 + |M^-1 dp|^2/rate_std^2 + |du|^2/torque_std^2 over the recording for the
    arms without the object; the gains act on the arms' angles and momenta. The reference momentum follows from the
    measured angles and torques by the arms' own DEL equations, so that it means the same as the model's.

    Parameters
    ----------
    step : Step
    measured : array_like, shape (N + 1, nu)
        Angles of the driven joints at every node [rad], smooth enough to be differenced.
    torque : array_like, shape (N, nu)
        Measured torques [N m].
    theta : array_like, shape (ntheta,)
    angle_std, rate_std, torque_std : float or array_like
        Standard deviations that weigh the same [rad], [rad/s], [N m].
    arms : Step, optional
        From `arms_only_step`; made when absent.

    References
    ----------
    Anderson and Moore (1990), Optimal Control: Linear Quadratic Methods, section 2.4.
    """
    reference, torques = np.asarray(measured, float), np.asarray(torque, float)
    system = step.system
    arm_step = arms_only_step(step) if arms is None else arms
    values = dict(zip(system.parameters.names, np.asarray(theta, float), strict=True))
    parameters = arm_step.system.parameters
    arm_theta = parameters.vector({name: values[name] for name in parameters.names})
    nu = len(system.driven)
    momenta = _reference_momentum(arm_step, reference, torques, arm_theta)
    steps = len(reference) - 1

    weight_u = np.diag(1.0 / np.broadcast_to(np.asarray(torque_std, float), (nu,)) ** 2)
    weight_q = np.diag(1.0 / np.broadcast_to(np.asarray(angle_std, float), (nu,)) ** 2)
    gain = np.zeros((steps, nu, 2 * nu))
    cost: Array | None = None
    states = np.hstack([reference, momenta])[:-1]
    by_state, by_torque = _one_step_each(arm_step, states, torques, reference[1:], arm_theta)
    for k in reversed(range(steps)):
        a, b = by_state[k], by_torque[k]
        rate = a[:nu, nu:] / step.time_step
        stage = scipy.linalg.block_diag(weight_q, rate.T @ rate / rate_std**2)
        cost = stage if cost is None else cost
        inner = weight_u + b.T @ cost @ b
        gain[k] = np.linalg.solve(inner, b.T @ cost @ a)
        closed = a - b @ gain[k]
        cost = stage + closed.T @ cost @ closed + gain[k].T @ weight_u @ gain[k]
        cost = 0.5 * (cost + cost.T)
    n = system.n_coordinates
    index = np.concatenate([np.array(system.driven_indices), n + np.array(system.driven_indices)])
    return TrackingFeedback(index.astype(np.int32), gain, np.hstack([reference[:-1], momenta[:-1]]))


def arms_only_step(step: Step) -> Step:
    """The step of a system of the driven joints only, without the object and everything else.

    Raises
    ------
    ModelError
        The driven joints do not come first in the configuration.
    """
    return compile_step_like(step, _arms_only(step.system))


def _arms_only(system: System) -> System:
    mechanism = system.mechanism
    keep = [mechanism.joint_index(name) for name in system.driven]
    if sorted(keep) != list(range(len(keep))):
        raise ModelError(
            "the LQR filter needs the driven joints to come first in the configuration",
            where=", ".join(system.driven),
            hint="use proportional gains instead",
        )
    frames = {name: frame for name, frame in mechanism.frames.items() if frame.joint_index < len(keep)}
    arms = replace(mechanism, joints=mechanism.joints[: len(keep)], frames=frames, link_chains={})
    wanted: Sequence[str] = system.driven
    return replace(
        system,
        mechanism=arms,
        elastic_joints=(),
        grasps=(),
        prescribed=(),
        joint_compliances={},
        segment_layouts=(),
        point_frames=(),
        effects=(),
        joint_damping={name: value for name, value in system.joint_damping.items() if name in wanted},
    )


def _reference_momentum(arm_step: Step, measured: Array, torque: Array, theta: Array) -> Array:
    """p_k = D2 L_d(q_{k-1}, q_k) + f+ of the measured motion, shape (N + 1, nu); the first from a standing start."""
    angles, torques = np.vstack([measured[:1], measured]), np.vstack([torque[:1], torque])
    state = np.hstack([angles, np.zeros_like(angles)])
    none = np.zeros((len(torques), 0))
    return arm_step.kernel.linearize(theta, state, none, torques, (), False).p1


def _one_step_each(arm_step: Step, start: Array, torque: Array, guess: Array, theta: Array) -> tuple[Array, Array]:
    """A_k (N, 2 nu, 2 nu) and B_k (N, 2 nu, nu) of one step from each state, by Newton's iteration of all at once.

    `guess` (N, nu) says where about the steps lead; NaN where that has no answer.
    """
    count, nu = torque.shape
    # the kernel takes states in a row: each start and what follows it; the steps between them mean nothing
    state, torques = np.repeat(start, 2, axis=0), np.repeat(torque, 2, axis=0)[:-1]
    state[1::2, :nu] = guess
    none, own = np.zeros((2 * count - 1, 0)), slice(None, None, 2)
    try:
        for _ in range(NEWTON_ITERATION_LIMIT):
            found = arm_step.kernel.linearize(theta, state, none, torques, (), True)
            change = np.linalg.solve(found.residual_by_new[own], found.residual[own, :, None])[:, :, 0]
            if not np.max(np.abs(change), initial=0.0) > arm_step.model.tolerance:
                break
            state[1::2, :nu] -= change
        else:
            raise np.linalg.LinAlgError
        known = np.broadcast_to(np.eye(nu), (count, nu, nu))
        moved = -np.linalg.solve(
            found.residual_by_new[own],
            np.concatenate([found.residual_by_old[own], known, found.residual_by_input[own]], axis=2),
        )
    except np.linalg.LinAlgError:
        return np.full((count, 2 * nu, 2 * nu), np.nan), np.full((count, 2 * nu, nu), np.nan)
    momenta = np.concatenate([found.p1_by_old[own], 0 * known, found.p1_by_input[own]], axis=2)
    after = np.concatenate([moved, found.p1_by_new[own] @ moved + momenta], axis=1)
    return after[:, :, : 2 * nu], after[:, :, 2 * nu :]

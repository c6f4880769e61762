"""What a user of MuJoCo writes around a tool: parameters set in a model, arms that follow their encoders.

An arm that is driven by recorded torques in open loop drifts away within a second. So it follows its smoothed encoders
by stiff actuators here, and the torque that this takes is compared with the recorded one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, filtfilt

from yid_ocp.data.recording import JointGroup

BANDWIDTH = 100.0  # of the actuators [rad/s]
CUTOFF = 10.0  # of the smoothing of encoders [Hz]
AT_ENDS = 0.3  # of a recording where the smoothing is wrong [s]
KEPT = 3.0  # of torques, beyond which arms shake and encoders tell little [Hz]
PRE_ROLL = 1.0  # in which what the arm holds comes to rest [s]


def set_foam_stiffness(spec: mujoco.MjSpec, name: str, value: float) -> None:
    tube, kind = name.split(".")
    axes = "xy" if kind == "bend" else "z"
    for joint in spec.joints:
        if joint.name.startswith(f"{tube}_") and joint.name[-1] in axes:
            joint.stiffness[0] = value  # MuJoCo 4 has three numbers, of a polynomial


def set_payload(spec: mujoco.MjSpec, name: str, value: float) -> None:
    # moments are kept as places times the mass, whatever is set first
    body, quantity = spec.body("payload"), name.rpartition(".")[2]
    moment = np.array(body.ipos) * body.mass
    if quantity == "mass":
        body.mass = value
    else:
        moment["xyz".index(quantity[1])] = value
    body.ipos = moment / body.mass


def set_spring(spec: mujoco.MjSpec, name: str, value: float) -> None:
    spec.joint(name.split(".")[0]).stiffness[0] = value


def set_link(spec: mujoco.MjSpec, name: str, value: float) -> None:
    joint, quantity = name.removeprefix("link_mass@").split(".")
    if quantity == "damping":
        spec.joint(joint).damping[0] = value
        return
    body = spec.body(f"{joint}_body")
    nominal = {"shoulder": (1.0, (0.0208, 0.0208, 0.0002)), "elbow": (0.6, (0.008, 0.008, 0.0001))}[joint]
    body.mass, body.fullinertia[:3] = value * nominal[0], value * np.array(nominal[1])


SETTERS = {
    "foam": set_foam_stiffness,
    "foam_noise": set_foam_stiffness,
    "payload": set_payload,
    "springs": set_spring,
    "scaled_torque": set_link,
}


@dataclass(frozen=True)
class Following:
    """Actuators that make joints follow: columns of joints in qpos, stiffness, damping and inertia of each (nj,)."""

    columns: Any
    stiffness: Any
    damping: Any
    inertia: Any

    def controls(self, joints: JointGroup, names: Sequence[str], step: float) -> tuple[Any, Any]:
        """Times from -`PRE_ROLL` on, shape (K,) [s], and generalized forces before feedback, shape (K, nj)."""
        t = joints.t - joints.t[0]
        measured = joints.position[:, [joints.names.index(name) for name in names]]
        numerator, denominator = butter(4, 2 * CUTOFF * np.median(np.diff(t)))
        path = CubicSpline(t, filtfilt(numerator, denominator, measured, axis=0))
        times = np.arange(-PRE_ROLL, t[-1] + step, step)
        moving = (times >= 0)[:, None]
        position, velocity, acceleration = (path(np.clip(times, 0, t[-1]), k) for k in range(3))
        force = self.stiffness * position
        if joints.effort is None:
            return times, force + moving * (self.damping * velocity + self.inertia * acceleration)
        # with the recorded torque the actuators have little left to do, and the arm does not sag
        effort = joints.effort[:, [joints.names.index(name) for name in names]]
        carried = CubicSpline(t, filtfilt(numerator, denominator, effort, axis=0))(np.clip(times, 0, t[-1]))
        return times, force + moving * self.damping * velocity + carried

    def torques(self, controls: Any, states: Any, nq: int) -> Any:
        """Torques that acted in each step, shape (K, nj), of states *after* each step; damping acts implicitly."""
        q = states[:, 1 + self.columns]
        before = np.vstack([q[:1], q[:-1]])
        v = states[:, 1 + nq + self.columns]
        return controls[: len(states)] - self.stiffness * before - self.damping * v


def follow(spec: mujoco.MjSpec, names: Sequence[str], posture: Any) -> Following:
    """Add an actuator to each joint, as stiff as its inertia at the posture allows."""
    model = spec.compile()
    data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    columns = np.array([model.joint(name).id for name in names])
    data.qpos[columns] = posture
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, mass)
    inertia = np.diag(mass)[columns]
    for name, own in zip(names, inertia, strict=True):
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.gainprm[0] = 1.0
        actuator.biasprm[1], actuator.biasprm[2] = -(BANDWIDTH**2) * own, -2 * BANDWIDTH * own
    return Following(columns, BANDWIDTH**2 * inertia, 2 * BANDWIDTH * inertia, inertia)


def settled_state(model: mujoco.MjModel, columns: Any, posture: Any, shape: Mapping[str, float]) -> Any:
    """Full state after the arm has stood at its first posture for two seconds, with much damping and short steps."""
    data, damping, step = mujoco.MjData(model), model.dof_damping.copy(), model.opt.timestep
    data.qpos[[model.joint(name).id for name in shape]] = list(shape.values())
    data.qpos[columns] = posture
    stiffness = -model.actuator_biasprm[:, 1]
    data.ctrl[:] = stiffness * posture
    model.dof_damping[:], model.opt.timestep = 10 * damping, 1e-4
    mujoco.mj_step(model, data, nstep=20_000)
    model.dof_damping[:], model.opt.timestep = damping, step
    data.qvel[:], data.time = 0.0, -PRE_ROLL
    state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    return state


def at_samples(times: Any, torques: Any, joints: JointGroup) -> Any:
    """Torques as they are recorded: at each sample, or their mean until the next where a command is held."""
    t = joints.t - joints.t[0]
    if joints.effort_kind == "sample":
        return np.array([np.interp(t, times[: len(torques)], column) for column in torques.T]).T
    total = np.vstack([np.zeros(torques.shape[1]), np.cumsum(torques, axis=0)])
    edges = np.searchsorted(times, t - 1e-9)
    return np.diff(total[edges], axis=0) / np.diff(edges)[:, None]


def torque_residual(predicted: Any, joints: JointGroup, names: Sequence[str]) -> Any:
    """Recorded minus predicted torque, low-passed and decimated; where recordings state offsets, without its mean."""
    columns = [joints.names.index(name) for name in names]
    assert joints.effort is not None
    t = joints.t[: len(predicted)]
    rate = 1 / np.median(np.diff(t))
    residual = filtfilt(*butter(4, 2 * KEPT / rate), joints.effort[: len(t), columns] - predicted, axis=0)
    inside = np.flatnonzero((t > joints.t[0] + AT_ENDS) & (t < joints.t[-1] - AT_ENDS))
    residual = residual[inside[:: int(rate / (2 * KEPT))]]
    white, bias = (None if std is None else np.atleast_1d(std) for std in (joints.effort_std, joints.effort_bias_std))
    if bias is not None and bias.any():
        residual = residual - residual.mean(axis=0)
    return residual / white[columns] if white is not None and white.all() else residual


def intervals(residual: Any, jacobian: Any) -> Any:
    """Half widths of 95 % intervals, shape (n,), from a Jacobian, if what is left is white noise of one size."""
    dof = residual.size - jacobian.shape[1]
    size, axes = np.linalg.eigh(jacobian.T @ jacobian)
    variance = (axes**2 / np.maximum(size, 1e-15 * size[-1])).sum(axis=1)
    return 1.96 * np.sqrt(variance * (residual @ residual) / dof)


def named(values: Any, unknowns: Mapping[str, Any]) -> dict[str, float]:
    return dict(zip(unknowns, map(float, values), strict=True))

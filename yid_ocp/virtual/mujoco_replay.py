"""Replay of a recording by an exported model in MuJoCo, with the deviation from the recorded signals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from yid_ocp.arrays import Array
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.errors import ModelError
from yid_ocp.model.system import System
from yid_ocp.virtual.mjcf import import_mujoco, mujoco_model_from_mjcf
from yid_ocp.virtual.mujoco_simulation import (
    MujocoScene,
    TrackingController,
    initialize_actuator_history,
    settle_to_equilibrium,
    settle_under_servo_commands,
)

REPLAY_FEEDBACK_BANDWIDTH = 5.0  # against drift of driven joints; low, so that recorded torque dominates [rad/s]
_SMOOTHING_SAMPLES = 2.0  # samples over which recorded angles are smoothed before they are followed
_START = 5  # samples of which the first posture is the mean
_AT_ENDS = 0.2  # of a recording in which what moves prescribed joints is not compared [s]: it begins anew there
_INERTIA_EVERY = 20  # steps; an arm's inertia hardly changes meanwhile


@dataclass(frozen=True)
class ReplayErrorAgainstRecording:
    """RMS error of a replayed model against the recording in one channel or group; for points, of the distance.

    `noise_rms` is expected from sensor noise alone, zero if the recording does not state it.
    """

    rmse: float
    noise_rms: float
    unit: str

    @property
    def rmse_beyond_noise(self) -> float:
        """Root mean square deviation in excess of the noise, zero if noise explains all."""
        return float(np.sqrt(max(self.rmse**2 - self.noise_rms**2, 0.0)))


def replay_mismatch_by_channel(
    text: str, system: System, recording: Recording
) -> dict[str, ReplayErrorAgainstRecording]:
    """Replay a recording with a system's MJCF text (`mujoco_xml` with actuators) and return the deviations by channel.

    Driven joints get the recorded torque as the control of their actuators, and beside it a weak pull to the recorded
    angles (`REPLAY_FEEDBACK_BANDWIDTH`), without which any error of a torque lets an arm drift away. Position servos
    get what they were commanded and nothing else. Prescribed joints follow the recorded angles; the torque that this
    takes is compared with the recorded one.

    Returns `joints.position` of driven joints [rad] or `joints.effort` of prescribed ones [N m], all joints together,
    and `GROUP.POINT` of every point of the model [m]. `ModelError` where nothing moves the model as recorded, it does
    not come to rest, or it diverges; `DataError` where MuJoCo is not installed.
    """
    mujoco, model = import_mujoco(), mujoco_model_from_mjcf(text)
    moved = system.driven or system.prescribed
    joints = recording.joints
    if joints is None or not moved or not set(moved) <= set(joints.names):
        what = f"'{recording.name}' does not say how the joints moved"
        raise ModelError(what, where="replay", allowed="recorded angles of all driven or prescribed joints")
    columns = [joints.names.index(name) for name in moved]
    if system.servos and joints.position_command is None:
        raise ModelError(f"'{recording.name}' has no commands", where="replay", allowed="recorded commanded positions")
    if system.driven and not system.servos and joints.effort is None:
        raise ModelError(f"'{recording.name}' has no torques", where="replay", allowed="recorded torques")
    t, position = joints.t - joints.t[0], joints.position[:, columns]
    effort = None if joints.effort is None else joints.effort[:, columns]
    scene = MujocoScene.from_compiled_model(system, mujoco, model)
    scene.data.qpos[:] = model.qpos_spring
    scene.data.qpos[scene.moved_joint_ids] = position[:_START].mean(axis=0)
    if system.servos:
        assert joints.position_command is not None
        commanded = _commanded(scene, system, t, joints.position_command[:, columns])
        return _errors(system, recording, joints, columns, commanded)
    balance = settle_to_equilibrium(scene, np.array(model.dof_damping))
    noisy = joints.position_std is not None and bool(np.any(np.asarray(joints.position_std) > 0))
    path = _Path(moved, t, position, _SMOOTHING_SAMPLES if noisy else 0.0)
    if system.driven:
        return _errors(system, recording, joints, columns, _driven(scene, path, t, effort))
    controller = TrackingController(scene, path, balance)
    scene.data.qvel[scene.moved_joint_ids] = path.offset_and_derivatives(0.0)[1]  # a recording may begin in motion
    played = _played(scene, t[-1], lambda k, now: controller.apply_input(now))
    return _errors(system, recording, joints, columns, played)


class _Path:
    """Recorded angles, smoothed over some samples, as a motion from the first of them."""

    def __init__(self, joints: tuple[str, ...], t: Array, position: Array, smoothed: float) -> None:
        self.joints, self._start, self._last = joints, position[:_START].mean(axis=0), float(t[-1])
        spline = CubicSpline(t, gaussian_filter1d(position, smoothed, axis=0) if smoothed else position)
        self._values = [spline, spline.derivative(1), spline.derivative(2)]

    def offset_and_derivatives(self, t: float) -> tuple[Array, Array, Array]:
        angle, velocity, acceleration = (np.asarray(value(min(t, self._last))) for value in self._values)
        return angle - self._start, velocity, acceleration


@dataclass(frozen=True)
class _Played:
    """Times of all steps, shape (K,), angles or torques of the moved joints (K, nj), points (K, np, 3)."""

    t: Array
    values: Array
    points: Array


def _step_times(scene: MujocoScene, end: float) -> Array:
    step = scene.model.opt.timestep
    return np.asarray(np.arange(round(end / step)) * step)


def _played(scene: MujocoScene, end: float, control: Callable[[int, float], Array | None]) -> _Played:
    """Step to a time; `control` sets inputs at a step and its time, and may return the values of the moved joints."""
    mujoco, model, data, at = scene.mujoco, scene.model, scene.data, scene.moved_joint_ids
    times = _step_times(scene, end)
    values, points = np.empty((len(times), len(at))), np.empty((len(times), len(scene.point_site_ids), 3))
    for k, t in enumerate(times):
        mujoco.mj_kinematics(model, data)
        values[k], points[k] = data.qpos[at], data.site_xpos[scene.point_site_ids]
        own = control(k, t)
        if own is not None:
            values[k] = own
        mujoco.mj_step(model, data)
    return _Played(times, values, points)


def _driven(scene: MujocoScene, path: _Path, t: Array, effort: Array | None) -> _Played:
    assert effort is not None
    mujoco, model, data, at = scene.mujoco, scene.model, scene.data, scene.moved_joint_ids
    start = np.array(data.qpos[at])
    if model.na:  # torques that follow are what they were before
        data.act[:] = effort[0][np.array(model.actuator_actnum) > 0]
    initialize_actuator_history(scene, effort[0])
    inertia = np.zeros((model.nv, model.nv))

    def control(k: int, now: float) -> None:
        if k % _INERTIA_EVERY == 0:
            mujoco.mj_forward(model, data)
            _full_inertia(mujoco, model, data, inertia)
        offset, velocity, _ = path.offset_and_derivatives(now)
        demand = REPLAY_FEEDBACK_BANDWIDTH**2 * (start + offset - data.qpos[at])
        demand += 2 * REPLAY_FEEDBACK_BANDWIDTH * (velocity - data.qvel[at])
        data.ctrl[:] = effort[np.searchsorted(t, now + 1e-9, side="right") - 1]
        data.qfrc_applied[at] = inertia[np.ix_(at, at)] @ demand

    return _played(scene, t[-1], control)


def _commanded(scene: MujocoScene, system: System, t: Array, commands: Array) -> _Played:
    settle_under_servo_commands(scene, np.array(scene.model.dof_damping), commands[0])
    times = _step_times(scene, t[-1])
    held = commands[np.searchsorted(t, times + 1e-9, side="right") - 1]
    is_held = [system.servos[name].command_interpolation == "held" for name in system.driven]
    given = np.where(is_held, held, _at(times, t, commands))

    def control(k: int, now: float) -> None:
        scene.data.ctrl[:] = given[k]

    return _played(scene, t[-1], control)


def _full_inertia(mujoco: Any, model: Any, data: Any, full: Array) -> None:
    """The mass matrix; MuJoCo changed the order of the arguments."""
    try:
        mujoco.mj_fullM(model, data, full)
    except TypeError:
        mujoco.mj_fullM(model, full, data.qM)


def _errors(
    system: System, recording: Recording, joints: JointGroup, columns: list[int], played: _Played
) -> dict[str, ReplayErrorAgainstRecording]:
    if not (np.isfinite(played.values).all() and np.isfinite(played.points).all()):
        raise ModelError("the replay diverged", where=recording.name, hint="take a shorter time step")
    found: dict[str, ReplayErrorAgainstRecording] = {}
    t = joints.t - joints.t[0]
    inside = t <= played.t[-1] + 1e-9
    if not system.driven:
        inside &= (t >= _AT_ENDS) & (t <= t[-1] - _AT_ENDS)
    name, unit = ("joints.position", "rad") if system.driven else ("joints.effort", "N m")
    said, noise = (getattr(joints, name.removeprefix("joints.") + part) for part in ("", "_std"))
    if said is not None and inside.any():
        model = _at(t[inside], played.t, played.values)
        error = float(np.sqrt(np.mean((model - said[inside][:, columns]) ** 2)))
        level = np.zeros(1) if noise is None else np.broadcast_to(noise, (len(joints.names),))[columns]
        found[name] = ReplayErrorAgainstRecording(error, float(np.sqrt(np.mean(level**2))), unit)
    for group in recording.points:
        for i, point in enumerate(group.names):
            if point in system.point_frames:
                own = _point_error(group, i, joints.t[0], played, system.point_frames.index(point))
                found |= {} if own is None else {f"{group.name}.{point}": own}
    return found


def _point_error(
    group: PointGroup, i: int, start: float, played: _Played, column: int
) -> ReplayErrorAgainstRecording | None:
    t = group.t - start
    seen = (t >= 0) & (t <= played.t[-1]) & np.isfinite(group.position[:, i]).all(axis=1)
    if not seen.any():
        return None
    model = _at(t[seen], played.t, played.points[:, column])
    square = np.sum((model - group.position[seen, i]) ** 2, axis=1)
    noise = 0.0 if group.std is None else float(np.sqrt(np.nanmean(np.sum(group.std[seen, i] ** 2, axis=1))))
    return ReplayErrorAgainstRecording(float(np.sqrt(square.mean())), noise, "m")


def _at(t: Array, known: Array, values: Array) -> Array:
    """Values at other times, linear in between, shape (len(t), width)."""
    return np.stack([np.interp(t, known, column) for column in values.T], axis=1)

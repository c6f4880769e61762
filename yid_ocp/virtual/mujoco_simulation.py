"""Simulation in MuJoCo of a controller that moves driven joints along a motion, or of a replayed recording.

Simulator and estimator share only the description of the system. Equations, integrator and grasps are MuJoCo's, so that
errors of the estimator's own equations show in tests.
"""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from yid_ocp.arrays import Array, IntArray
from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.errors import ConfigError, ModelError, require_known_names
from yid_ocp.model.system import System
from yid_ocp.sensors.base import EffortSamplingKind
from yid_ocp.virtual.joint_motion import JointOffsetMotion, grasping_joint_angles
from yid_ocp.virtual.mjcf import import_mujoco, mujoco_model_from_mjcf_text, mujoco_xml

DEFAULT_SIMULATOR_TIME_STEP = 1e-4  # [s]
_TRACKING_BANDWIDTH = 25.0  # bandwidth of the joint controller [rad/s]; a 10 ms hold leaves it well damped
_REPLAY_BANDWIDTH = 100.0  # the same for replays, whose controller acts at every step [rad/s]
_HOLD_STIFFNESS = 2e3  # of driven joints while settling; explicit integration is stable on the lightest wrist [N m/rad]
_HOLD_DAMPING = 60.0  # [N m s/rad]
_SETTLING_FACTOR = 10.0  # on the object's damping: shortens settling without changing the equilibrium
_SETTLING_LIMIT = 60.0  # [s]
_POSTURE_TOLERANCE = 1e-6  # [rad]
_REST = 1e-7  # [rad/s]
# warnings after which MuJoCo resets its state and continues; their numbers depend on its version
_INSTABILITY_WARNINGS = ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC")


class InjectedSimulatorTerms(Protocol):
    """The interface of forces and model changes in MuJoCo that the system's description lacks."""

    def edit_model(self, model: Any) -> None:
        """Change the compiled `mujoco.MjModel`."""

    def begin_motion(self, data: Any) -> None:
        """Prepare for a motion that starts at equilibrium. Called once for each motion."""

    def add_forces(self, model: Any, data: Any) -> None:
        """Add generalized forces to `data.qfrc_passive`. Called at every inner step."""


@dataclass(frozen=True)
class SimulationOptions:
    """The duration [s], rates [Hz] and time step [s] of a simulation."""

    duration: float = 5.0
    sample_rate: float = 100.0
    time_step: float = DEFAULT_SIMULATOR_TIME_STEP  # must divide the controller's period
    # rate at which torques are computed and held, a multiple of `sample_rate` (the default)
    controller_rate: float | None = None
    effort_kind: EffortSamplingKind = "command"  # of recorded efforts; `command` needs controller_rate = sample_rate
    period_jitter_std: float = 0.0  # std of the controller's tick times; deviations end at a third of a period [s]
    jitter_seed: int = 0

    def __post_init__(self) -> None:
        controller, periods = self._controller_rate, self.controller_periods_per_sample
        inner = self._steps_per_period
        if periods < 1 or abs(periods * self.sample_rate / controller - 1.0) > 1e-9:
            what = f"controller_rate = {controller:g} Hz is not a multiple of sample_rate = {self.sample_rate:g} Hz"
            allowed, hint = "k * sample_rate, k = 1, 2, ...", f"pass {max(periods, 1) * self.sample_rate:g} for example"
            raise ConfigError(what, where="controller_rate", allowed=allowed, hint=hint)
        if inner < 1 or abs(inner * self.time_step * controller - 1.0) > 1e-9:
            what = f"time_step = {self.time_step:g} s does not divide the period of {controller:g} Hz"
            allowed, hint = "1 / (k * controller_rate), k = 1, 2, ...", f"pass 1 / {max(inner, 1) * controller:g}"
            raise ConfigError(what, where="time_step", allowed=allowed, hint=hint)
        require_known_names([self.effort_kind], get_args(EffortSamplingKind), "kind", "effort_kind", ConfigError)
        if self.effort_kind == "command" and periods > 1:
            what = f"the controller ({controller:g} Hz) changes commands within a sample ({self.sample_rate:g} Hz), so "
            what += "effort_kind='command' (the default) has no single value per sample"
            allowed = f"sample, or mean (of each sample); command with controller_rate = {self.sample_rate:g} Hz"
            raise ConfigError(what, where="effort_kind", allowed=allowed, hint="pass effort_kind='mean'")

    @property
    def _controller_rate(self) -> float:
        return self.sample_rate if self.controller_rate is None else self.controller_rate

    @property
    def controller_periods_per_sample(self) -> int:
        """The number of controller periods between two recorded samples."""
        return round(self._controller_rate / self.sample_rate)

    @property
    def _steps_per_period(self) -> int:
        return round(1.0 / (self._controller_rate * self.time_step))

    def _tick_steps(self) -> IntArray:
        """Inner steps before every tick of the controller, (ticks + 1,); the first and last tick are on time."""
        ticks = round(self.duration * self.sample_rate) * self.controller_periods_per_sample
        inner = self._steps_per_period
        late = np.random.default_rng(self.jitter_seed).normal(0.0, self.period_jitter_std / self.time_step, ticks - 1)
        steps = inner * np.arange(ticks + 1)
        steps[1:-1] += np.rint(np.clip(late, -inner / 3, inner / 3)).astype(int)
        return np.asarray(steps)


@dataclass(frozen=True)
class SimulationResult:
    """The noise-free result of a simulation: q, v, efforts and points at times `t`, and points at camera frame times.

    `effort` is the torque [N m] of the driven joints at t_k (with `effort_kind` mean: its mean from t_k to t_{k+1}), or
    the servo command at t_k. Its last row was computed but not applied. Points are `system.point_frames` in the world.
    """

    t: Array  # sample times, (N + 1,) [s]
    q: Array  # joint positions in the order of the system, (N + 1, n) [rad or m]
    v: Array  # joint velocities, (N + 1, n) [rad/s or m/s]
    effort: Array  # (N + 1, nu)
    point_positions: Array  # shape (N + 1, np, 3) [m]
    frame_times: Array  # the camera's, rounded to the simulator's step, shape (M,) [s]
    frame_point_positions: Array  # points at the frame times, (M, np, 3) [m]


def simulate_in_mujoco(
    system: System,
    values: Mapping[str, float] | None,
    motion: JointOffsetMotion,
    simulation: SimulationOptions | None = None,
    *,
    initial_joint_angles: Mapping[str, float] | None = None,
    frame_times: ArrayLike = (),
    injected: InjectedSimulatorTerms | None = None,
    gear_play: Mapping[str, float] | None = None,
) -> SimulationResult:
    """Simulate a system in MuJoCo while a controller moves its driven joints along a motion, from equilibrium.

    Position servos are MuJoCo actuators, whose commands follow the motion. Parameters without an entry in `values` are
    nominal. Raises `ModelError` if MuJoCo cannot express or simulate the system.

    Parameters
    ----------
    motion : JointOffsetMotion
        Motion of exactly the driven joints.
    initial_joint_angles : mapping of str to float, optional
        Initial angles [rad or m]. Default: `grasping_joint_angles`.
    frame_times : array_like, shape (M,)
        Increasing times of camera frames in [0, duration] [s].
    injected : InjectedSimulatorTerms, optional
        Forces and model changes beyond the system's description. MuJoCo has one callback for the whole process, so no
        other simulation may run at the same time in another thread.
    gear_play : mapping of joint to float, optional
        Full backlash width of gears behind servos [rad].
    """
    chosen = simulation or SimulationOptions()
    if tuple(motion.joints) != tuple(system.driven) or not system.driven or system.prescribed:
        what = f"the motion has {', '.join(motion.joints) or 'no joints'}"
        what = f"{', '.join(system.prescribed)} are prescribed, not driven joints" if system.prescribed else what
        allowed = f"a motion of {', '.join(system.driven) or 'driven joints'} in this order, and no prescribed joint"
        hint = "make the motion for `system.driven`, of a system with model.arms.mode: driven or servo"
        raise ModelError(what, where="motion.joints and system", allowed=allowed, hint=hint)
    mujoco = import_mujoco()
    model = mujoco_model_from_mjcf_text(mujoco_xml(system, values, time_step=chosen.time_step, gear_play=gear_play))
    nominal_damping = np.array(model.dof_damping)
    with contextlib.ExitStack() as held:
        if injected is not None:
            injected.edit_model(model)
            mujoco.set_mjcb_passive(injected.add_forces)
            held.callback(mujoco.set_mjcb_passive, None)
        scene = MujocoModelAndState(system, model)
        start = grasping_joint_angles(system, values) if initial_joint_angles is None else initial_joint_angles
        scene.data.qpos[:] = model.qpos_spring
        scene.data.qpos[[model.joint(name).id for name in start]] = list(start.values())
        if system.servos:
            control = _servo_command_function(scene, motion)
            _settle_under_servo_commands(scene, nominal_damping, control(0.0))
        else:
            balance = settle_and_return_holding_torques(scene, nominal_damping)
            control = TrackingController(scene, motion, balance).apply_and_return_control_input
        if injected is not None:
            injected.begin_motion(scene.data)
        frames = np.round(np.asarray(frame_times, float) / chosen.time_step).astype(int)
        result = _play(scene, control, chosen, frames)
        lost = _lost(scene)
    if lost or not (np.isfinite(result.q).all() and np.isfinite(result.effort).all()):
        hint = f"pass a time_step below {chosen.time_step:g} s, or a slower motion"
        where = f"MuJoCo, {lost or 'efforts'}"
        raise ModelError("the simulation diverged", where=where, allowed="finite positions and efforts", hint=hint)
    return result


class MujocoModelAndState:
    """A compiled MuJoCo model (`mujoco.MjModel`) with a new state, and the MuJoCo ids of a system's joints and points.

    `joint_ids` are in the order of the system's coordinates, `point_site_ids` in the order of `system.point_frames`.
    `moved_joint_ids` are those of the driven joints, or of the prescribed joints if none is driven.
    """

    def __init__(self, system: System, model: Any) -> None:
        self.mujoco, self.model = import_mujoco(), model
        self.data = self.mujoco.MjData(model)
        # Every joint has one coordinate, so positions, velocities and joints share their addresses.
        self.joint_ids: IntArray = np.array([model.joint(name).id for name in system.mechanism.joint_names])
        moved = system.actuated_coordinate_indices or system.prescribed_coordinate_indices
        self.moved_joint_ids = self.joint_ids[list(moved)]
        self.point_site_ids = [model.site(name).id for name in system.point_frames]


def settle_and_return_holding_torques(scene: MujocoModelAndState, damping: Array) -> Array:
    """Bring the scene to equilibrium with the moved joints held, and return their holding torques (nj,) [N m].

    Joints settle with an increased `damping`, which can decide which of several equilibria is found.
    """
    data, driven, held = scene.data, scene.moved_joint_ids, _settling_model(scene, damping)
    target = data.qpos[driven].copy()
    held.dof_damping[driven] += _HOLD_DAMPING
    held.jnt_stiffness[driven] += _HOLD_STIFFNESS
    held.qpos_spring[driven] = target
    for calm in _calming(scene, held):
        error = target - data.qpos[driven]
        if np.abs(error).max() > _POSTURE_TOLERANCE:
            held.qpos_spring[driven] += error
        elif calm < _REST:
            break
    balance = _HOLD_STIFFNESS * (held.qpos_spring[driven] - data.qpos[driven])
    data.qvel[:], data.qacc_warmstart[:], data.time = 0.0, 0.0, 0.0
    return balance


def _settling_model(scene: MujocoModelAndState, damping: Array) -> Any:
    """A copy of the model with more damping of the joints that are not driven."""
    held = copy.copy(scene.model)
    held.dof_damping[:] = damping
    held.dof_damping[np.setdiff1d(np.arange(held.nv), scene.moved_joint_ids)] *= _SETTLING_FACTOR
    return held


def _lost(scene: MujocoModelAndState) -> str:
    """The joint at which the simulation became unstable, as in "joint 'elbow'". Empty if it did not."""
    kinds = scene.mujoco.mjtWarning
    found = (scene.data.warning[int(getattr(kinds, name))] for name in _INSTABILITY_WARNINGS)
    return next((f"joint '{scene.model.joint(own.lastinfo).name}'" for own in found if own.number > 0), "")


class TrackingController:
    """A computed-torque controller that keeps the driven joints on a motion.

    The torque is the inverse dynamics along the motion, plus the load of the grasps at equilibrium, plus feedback.
    Before the motion the scene is at equilibrium, held by the torques `balance` (nu,) [N m].
    """

    def __init__(
        self,
        scene: MujocoModelAndState,
        motion: JointOffsetMotion,
        balance: Array,
        bandwidth: float = _TRACKING_BANDWIDTH,
    ) -> None:
        self._scene, self._motion, self._bandwidth = scene, motion, bandwidth
        self._free = copy.copy(scene.model)
        self._free.opt.disableflags |= int(scene.mujoco.mjtDisableBit.mjDSBL_EQUALITY)
        self._shadow = scene.mujoco.MjData(self._free)
        self._rest = scene.data.qpos.copy()
        zero = np.zeros(len(scene.moved_joint_ids))
        self._load = balance - self._arm_torque(self._rest[scene.moved_joint_ids], zero, zero)

    def apply_and_return_control_input(self, t: float) -> Array:
        """Compute the torques (nu,) [N m] at time t [s] from the scene's present state, apply and return them."""
        data, driven = self._scene.data, self._scene.moved_joint_ids
        offset, velocity, acceleration = self._motion.offset_and_derivatives(t)
        reference = self._rest[driven] + offset
        demand = acceleration + 2 * self._bandwidth * (velocity - data.qvel[driven])
        demand += self._bandwidth**2 * (reference - data.qpos[driven])
        torque = np.asarray(self._load + self._arm_torque(reference, velocity, demand))
        data.qfrc_applied[driven] = torque
        return torque

    def _arm_torque(self, q: Array, v: Array, a: Array) -> Array:
        shadow, driven = self._shadow, self._scene.moved_joint_ids
        shadow.qpos[:], shadow.qvel[:], shadow.qacc[:] = self._rest, 0.0, 0.0
        shadow.qpos[driven], shadow.qvel[driven], shadow.qacc[driven] = q, v, a
        self._scene.mujoco.mj_inverse(self._free, shadow)
        return np.array(shadow.qfrc_inverse[driven])


def _servo_command_function(scene: MujocoModelAndState, motion: JointOffsetMotion) -> Callable[[float], Array]:
    """Function of time that commands position servos along a motion from the present angles, and returns commands."""
    start = scene.data.qpos[scene.moved_joint_ids].copy()

    def control(t: float) -> Array:
        scene.data.ctrl[:] = commands = start + motion.offset_and_derivatives(t)[0]
        return np.asarray(commands)

    return control


def _initialize_actuator_history(scene: MujocoModelAndState, commands: Array) -> None:
    """Set the commands of all actuators and fill the history of delayed actuators with them."""
    model, data = scene.model, scene.data
    data.ctrl[:] = commands
    for i in map(int, np.flatnonzero(np.asarray(model.actuator_delay))):
        before = np.full((int(model.actuator_history[i, 0]), 1), commands[i])
        scene.mujoco.mj_initCtrlHistory(model, data, i, None, before)


def _settle_under_servo_commands(scene: MujocoModelAndState, damping: Array, commands: Array) -> None:
    """Bring the scene to equilibrium under constant servo commands. Joints meanwhile have a multiple of `damping`."""
    model, data = scene.model, scene.data
    data.ctrl[:] = commands
    held = _settling_model(scene, damping)
    held.actuator_delay[:] = 0.0
    next(calm for calm in _calming(scene, held) if calm < _REST)
    posture = data.qpos.copy()
    scene.mujoco.mj_resetData(model, data)
    data.qpos[:] = posture
    _initialize_actuator_history(scene, commands)


def _calming(scene: MujocoModelAndState, held: Any) -> Iterator[float]:
    """Let a scene settle with the model `held`, and yield its largest velocity [rad/s] every 0.1 s.

    With short steps, a gripper that starts beside its grasped point can accelerate a fine chain so much that the
    simulation diverges. The scene then restarts, with softer grasps in the first 0.1 s.
    """
    data, step = scene.data, scene.mujoco.mj_step
    start, commands = data.qpos.copy(), data.ctrl.copy()
    block = max(1, round(0.1 / held.opt.timestep))
    step(held, data, nstep=block)
    if _lost(scene):
        scene.mujoco.mj_resetData(held, data)
        data.qpos[:], data.ctrl[:] = start, commands
        firm = held.eq_solref.copy()
        held.eq_solref[:, 0] = np.maximum(firm[:, 0], 2 * DEFAULT_SIMULATOR_TIME_STEP)
        step(held, data, nstep=block)
        held.eq_solref[:] = firm
    every = block * held.opt.timestep
    for done in range(1, 1 + math.ceil(_SETTLING_LIMIT / every)):
        if lost := _lost(scene):
            what = "the simulation diverged before the motion began, "
            what += f"within {done * every:.3g} s of settling with time steps of {held.opt.timestep:g} s"
            hint = "simulate with a shorter time step"
            hint += ", or begin nearer to the grasp (initial_joint_angles)" * bool(held.neq)
            raise ModelError(what, where=f"MuJoCo, {lost}", allowed="finite positions and velocities", hint=hint)
        yield (calm := float(np.abs(data.qvel).max()))
        step(held, data, nstep=block)
    what = f"the object still moves at {calm:.2g} rad/s after {_SETTLING_LIMIT:g} s of settling (limit {_REST:g} rad/s)"
    hint = "give every joint of the object more damping, and enough stiffness to carry the weight"
    raise ModelError(what, where="settling before the motion", allowed="an object that comes to rest", hint=hint)


def _play(
    scene: MujocoModelAndState, control: Callable[[float], Array], simulation: SimulationOptions, frames: IntArray
) -> SimulationResult:
    """Simulate one controller period after another, with constant inputs in each. `frames`: steps of camera frames.

    `control(t)` applies and returns the inputs from time t [s] on.
    """
    mujoco, model, data = scene.mujoco, scene.model, scene.data
    periods, ticks = simulation.controller_periods_per_sample, simulation._tick_steps()
    steps_per_second = simulation._steps_per_period * periods * simulation.sample_rate
    q, v, torques, points, seen = [], [], [], [], []
    for tick, done in enumerate(ticks.tolist()):
        end = done if tick == len(ticks) - 1 else int(ticks[tick + 1])
        mujoco.mj_kinematics(model, data)
        torques.append(control(done / steps_per_second))
        if tick % periods == 0:
            q.append(data.qpos[scene.joint_ids])
            v.append(data.qvel[scene.joint_ids])
            points.append(data.site_xpos[scene.point_site_ids])
        # at the last tick, points are those of this tick
        for frame in frames[(frames >= done) & (frames < max(end, done + 1))]:
            if frame > done:
                mujoco.mj_step(model, data, nstep=int(frame - done))
                mujoco.mj_kinematics(model, data)
            seen.append(data.site_xpos[scene.point_site_ids])
            done = int(frame)
        if end > done:
            mujoco.mj_step(model, data, nstep=end - done)
    effort, weights = np.array(torques[::periods]), np.diff(ticks).reshape(-1, periods, 1)
    if simulation.effort_kind == "mean":
        effort[:-1] = (weights * np.array(torques[:-1]).reshape(*weights.shape[:2], -1)).sum(1) / weights.sum(1)
    t = ticks[::periods] / steps_per_second
    frame_times = simulation.time_step * frames[: len(seen)].astype(float)
    frame_points = np.array(seen).reshape(len(seen), len(scene.point_site_ids), 3)
    return SimulationResult(t, np.array(q), np.array(v), effort, np.array(points), frame_times, frame_points)


_SMOOTHING_SAMPLES = 2.0  # samples over which recorded angles are smoothed before they are followed
_START = 5  # samples of which the first posture is the mean
_AT_ENDS = 0.2  # duration at both ends of the replay in which efforts are not compared [s]


@dataclass(frozen=True)
class ReplayErrorAgainstRecording:
    """The error of a replay: the difference between the replayed model and the recording in one channel or group."""

    rmse: float  # root mean square difference; for a point, of the distance
    noise_rms: float  # root mean square difference that sensor noise alone causes; zero if the noise is not recorded
    unit: str


def replay_mismatch_by_channel(
    text: str, system: System, recording: Recording
) -> dict[str, ReplayErrorAgainstRecording]:
    """Replay a recording in MuJoCo and return the errors of the replay by channel. `text` is the model in MJCF.

    `text` comes from `mujoco_xml`, `standalone`. Position servos get their recorded commands only. Other joints follow
    the recorded angles, and the torque that this requires is compared with the recorded torque.

    Keys: `joints.position` (all position servos) [rad] or `joints.effort` (all other moved joints) [N m], and
    `GROUP.POINT` for every point [m]. Raises `ModelError` if channels are missing or the simulation fails, and
    `DataError` if MuJoCo is not installed.
    """
    model = mujoco_model_from_mjcf_text(text)
    moved, joints = system.driven or system.prescribed, recording.joints
    missing = set(moved).difference(() if joints is None else joints.names)
    if joints is None or missing or not moved:
        names = f"{', '.join(sorted(missing)) or 'a joint'}, of the {len(moved)} joints that are driven or prescribed"
        what, hint = f"the recording has no angles of {names}", "import it again from a file with these joints"
        allowed = "angles of all driven and prescribed joints"
        raise ModelError(what, where=f"recording '{recording.name}': joints", allowed=allowed, hint=hint)
    columns = [joints.names.index(name) for name in moved]
    quantity, words = ("position_command", "commanded positions") if system.servos else ("effort", "efforts")
    if system.driven and getattr(joints, quantity) is None:
        what, where = f"the recording has no {words} of the driven joints", f"recording '{recording.name}': joints"
        raise ModelError(what, where=where, allowed=f"the channel {quantity}", hint=f"import it again with {words}")
    t, position = joints.t - joints.t[0], joints.position[:, columns]
    scene = MujocoModelAndState(system, model)
    scene.data.qpos[:] = model.qpos_spring
    scene.data.qpos[scene.moved_joint_ids] = position[:_START].mean(axis=0)
    if system.servos:
        assert joints.position_command is not None
        commanded = _commanded(scene, system, t, joints.position_command[:, columns])
        return _errors(system, recording, joints, columns, commanded)
    balance = settle_and_return_holding_torques(scene, np.array(model.dof_damping))
    noisy = joints.position_std is None or bool(np.any(np.asarray(joints.position_std) > 0))
    path = _Path(moved, t, position, _SMOOTHING_SAMPLES if noisy else 0.0)
    return _errors(system, recording, joints, columns, _followed(scene, path, balance, joints, columns))


class _Path:
    """Motion along recorded angles, smoothed with a Gaussian of `smoothed` samples, relative to the first angles."""

    def __init__(self, joints: tuple[str, ...], t: Array, position: Array, smoothed: float) -> None:
        from scipy.ndimage import gaussian_filter1d  # slow to import

        def spline(values: Array) -> CubicSpline:
            return CubicSpline(t, gaussian_filter1d(values, smoothed, axis=0) if smoothed else values)

        self.joints, self._start, self._last = joints, position[:_START].mean(axis=0), float(t[-1])
        path = spline(position)
        self._values = [path, path.derivative(1), path.derivative(2)]
        one = np.eye(1, len(t), len(t) // 2)[0]
        # std of the second derivative if white noise of std 1 is in the angles [1/s^2]
        self.acceleration_per_noise = float(np.linalg.norm(spline(one).derivative(2)(t)))

    def offset_and_derivatives(self, t: float) -> tuple[Array, Array, Array]:
        angle, velocity, acceleration = (np.asarray(value(min(t, self._last))) for value in self._values)
        return angle - self._start, velocity, acceleration


@dataclass(frozen=True)
class _Played:
    """Times (K,) of all steps, angles or torques (K, nj) of the moved joints, and points (K, np, 3)."""

    t: Array
    values: Array
    points: Array
    diverged_at: str
    value_std: Array | float = 0.0  # of the values, from the noise of recorded angles; shape (nj,) or scalar


def _step_times(scene: MujocoModelAndState, end: float) -> Array:
    step = scene.model.opt.timestep
    return np.asarray(np.arange(round(end / step)) * step)


def _played(scene: MujocoModelAndState, end: float, control: Callable[[int, float], Array | None]) -> _Played:
    """Simulate up to the time `end`. `control(step, time)` sets inputs; values that it returns replace the angles."""
    mujoco, model, data, at = scene.mujoco, scene.model, scene.data, scene.moved_joint_ids
    times = _step_times(scene, end)
    values, points = np.empty((len(times), len(at))), np.empty((len(times), len(scene.point_site_ids), 3))
    for k, t in enumerate(times):
        mujoco.mj_kinematics(model, data)
        values[k], points[k] = data.qpos[at], data.site_xpos[scene.point_site_ids]
        if (own := control(k, t)) is not None:
            values[k] = own
        mujoco.mj_step(model, data)
    is_finite = np.isfinite(values).all() and np.isfinite(points).all()
    return _Played(times, values, points, _lost(scene) or ("" if is_finite else "efforts"))


def _followed(
    scene: MujocoModelAndState, path: _Path, balance: Array, joints: JointGroup, columns: list[int]
) -> _Played:
    """Replay of the recorded angles. Its values are the torques that this requires, as recorded at each joint.

    What actuators of the model make of recorded efforts (gains, lags and delays) is taken from the torque, and the
    efforts are added.
    """
    model, data, at, t = scene.model, scene.data, scene.moved_joint_ids, joints.t - joints.t[0]
    controller = TrackingController(scene, path, balance, _REPLAY_BANDWIDTH)
    data.qvel[at] = path.offset_and_derivatives(0.0)[1]  # a recording may begin in motion
    inertia = np.zeros((model.nv, model.nv))
    for column, unit in zip(inertia, np.eye(model.nv), strict=True):
        scene.mujoco.mj_mulM(model, data, column, unit)
    acceleration_std = path.acceleration_per_noise * _stds_of_columns(joints.position_std, joints, columns)
    value_std = np.sqrt(inertia[np.ix_(at, at)] ** 2 @ acceleration_std**2)
    effort = joints.effort[:, columns] if model.nu and joints.effort is not None else None
    if effort is not None:
        if model.na:  # lagging torques start at the first recorded value
            data.act[:] = effort[0][np.array(model.actuator_actnum) > 0]
        _initialize_actuator_history(scene, effort[0])

    def control(k: int, now: float) -> Array:
        if effort is None:
            return controller.apply_and_return_control_input(now)
        data.ctrl[:] = effort[np.searchsorted(t, now + 1e-9, side="right") - 1]
        missing = controller.apply_and_return_control_input(now) - data.qfrc_actuator[at]
        data.qfrc_applied[at] = missing
        return np.asarray(data.ctrl + missing)

    return replace(_played(scene, t[-1], control), value_std=value_std)


def _stds_of_columns(std: float | Array | None, joints: JointGroup, columns: list[int]) -> Array:
    """Standard deviations of some joints, zero if they are not recorded."""
    return np.broadcast_to(0.0 if std is None else std, len(joints.names))[columns]


def _commanded(scene: MujocoModelAndState, system: System, t: Array, commands: Array) -> _Played:
    _settle_under_servo_commands(scene, np.array(scene.model.dof_damping), commands[0])
    times = _step_times(scene, t[-1])
    held = commands[np.searchsorted(t, times + 1e-9, side="right") - 1]
    is_held = [system.servos[name].command_interpolation == "held" for name in system.driven]
    given = np.where(is_held, held, _at(times, t, commands))

    def control(k: int, now: float) -> None:
        scene.data.ctrl[:] = given[k]

    return _played(scene, t[-1], control)


def _errors(
    system: System, recording: Recording, joints: JointGroup, columns: list[int], played: _Played
) -> dict[str, ReplayErrorAgainstRecording]:
    if played.diverged_at:
        what, hint = "the replay in MuJoCo diverged", "set a smaller `timestep` under `option` in the MJCF text"
        where = f"recording '{recording.name}', {played.diverged_at}"
        raise ModelError(what, where=where, allowed="finite positions and efforts", hint=hint)
    found, t = dict[str, ReplayErrorAgainstRecording](), joints.t - joints.t[0]
    inside = t <= played.t[-1] + 1e-9
    if not system.servos:
        inside &= (t >= _AT_ENDS) & (t <= t[-1] - _AT_ENDS)
    name, unit = ("joints.position", "rad") if system.servos else ("joints.effort", "N m")
    said, *stds = (getattr(joints, name.removeprefix("joints.") + part, None) for part in ("", "_std", "_bias_std"))
    if said is not None and inside.any():
        error = float(np.sqrt(np.mean((_at(t[inside], played.t, played.values) - said[inside][:, columns]) ** 2)))
        variances = [_stds_of_columns(std, joints, columns) ** 2 for std in stds]
        noise_rms = float(np.sqrt(np.mean(np.sum(variances, axis=0) + played.value_std**2)))
        found[name] = ReplayErrorAgainstRecording(error, noise_rms, unit)
    for group in recording.points:
        t = group.t - joints.t[0]
        for i, point in enumerate(group.names):
            seen = (t >= 0) & (t <= played.t[-1]) & np.isfinite(group.position[:, i]).all(axis=1)
            if point in system.point_frames and seen.any():
                model = _at(t[seen], played.t, played.points[:, system.point_frames.index(point)])
                square = np.sum((model - group.position[seen, i]) ** 2, axis=1).mean()
                variance = 0.0 if group.std is None else np.nanmean(np.sum(group.std[seen, i] ** 2, axis=1))
                rms, noise_rms = float(np.sqrt(square)), float(np.sqrt(variance))
                found[f"{group.name}.{point}"] = ReplayErrorAgainstRecording(rms, noise_rms, "m")
    return found


def _at(t: Array, known: Array, values: Array) -> Array:
    return np.stack([np.interp(t, known, column) for column in values.T], axis=1)

"""Virtual experiments: a robot moves the flexible object in MuJoCo, and sensors with known noise record it.

The simulator shares the description of the system with the estimator and nothing else: its equations, its integrator
and its treatment of the grasps are MuJoCo's own, so that an estimate is never checked against its own mistakes.
"""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from yid_ocp.data.recording import JointGroup, PointGroup, Recording, validate
from yid_ocp.errors import ConfigError, ModelError
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.mechanism import Placement
from yid_ocp.model.system import Grasp, System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.model.y_object import y_object
from yid_ocp.virtual.mjcf import Evaluator, compiled_model, mujoco_module
from yid_ocp.virtual.mjcf import mujoco_xml as mujoco_xml

Array = NDArray[np.float64]

BAXTER_JOINTS = ("s0", "s1", "e0", "e1", "w0", "w1", "w2")
ELBOW_UP: Mapping[str, float] = {
    f"{side}_{joint}": sign * value if joint in ("s0", "e0", "w0", "w2") else value
    for side, sign in (("left", 1.0), ("right", -1.0))
    for joint, value in zip(BAXTER_JOINTS, (-0.40, -1.13, -0.15, 1.19, -0.08, 1.13, 0.0), strict=True)
}
"""Where the search for Baxter's initial posture starts [rad]: elbow above the hand, the right arm mirrored."""

INNER_STEP = 1e-4
"""Step of the simulator in `virtual_experiment` [s]."""

_PULL = 1e-5  # [m/rad]; moves the gripper by less than 1e-9 m
_BANDWIDTH = 25.0  # of the joint controller [rad/s]; a 10 ms hold leaves it well damped
_HOLD_STIFFNESS = 2e3  # [N m/rad] while settling; stable explicitly on the lightest wrist
_HOLD_DAMPING = 60.0  # [N m s/rad]
_SETTLING_FACTOR = 10.0  # on the object's damping: equilibrium does not depend on it, time to get there does
_SETTLING_LIMIT = 60.0  # [s]
_POSTURE_TOLERANCE = 1e-6  # [rad]
_REST = 1e-7  # [rad/s]


def paper_system(arms: int) -> System:
    """Baxter with one or two arms holding the foam Y by point grasps.

    Parameters
    ----------
    arms : int
        1: the left arm holds the tip of T2 (43 coordinates); 2: the right one holds that of T3 as well (50).

    Returns
    -------
    System
        Every arm joint driven; viscous damping 0.05 N m s/rad on every coordinate.

    Raises
    ------
    ConfigError
        Another number of arms.
    """
    if arms not in (1, 2):
        raise ConfigError(f"arms = {arms}", where="paper_system", allowed="1 or 2")
    sides = ("left", "right")[:arms]
    names = [f"{side}_{joint}" for side in sides for joint in BAXTER_JOINTS]
    robot = read_urdf("package:baxter", joints=names)
    grasps = [Grasp(side, f"{side}_gripper", held) for side, held in zip(sides, ("w_T2", "w_T3"), strict=False)]
    return System.build(robot, objects=[(y_object(), None, None)], grasps=grasps, driven=names, damping=0.05)


def initial_posture(
    system: System,
    values: Mapping[str, float] | None = None,
    *,
    seed: Mapping[str, float] | None = None,
    offsets: Mapping[str, ArrayLike] | None = None,
) -> dict[str, float]:
    """Arm joint angles with which every gripper meets the end of the undeformed object, or a point beside it.

    Only positions are asked for; of the solutions the search takes one near its start.

    Parameters
    ----------
    system : System
        Those joints are sought that carry a grasp's holder and are not elastic.
    values : mapping of str to float, optional
        Parameter values; nominal where absent.
    seed : mapping of str to float, optional
        Start of the search by joint name [rad or m]. Where absent: `ELBOW_UP` for Baxter, else the middle of the
        joint's range (zero when it has none).
    offsets : mapping of grasp to array_like, shape (3,), optional
        Where each gripper stands beside the undeformed tube end, in the world [m]. Two arms that hold a straight Y are
        at its full stretch, a singular posture: moving them towards it makes the start well defined.

    Returns
    -------
    dict of str to float
        Angle of every driven joint and every joint sought [rad or m], in configuration order.

    Raises
    ------
    ModelError
        The grasped points cannot be reached within the joint limits.
    """
    tree = replace(system.mechanism, parameters=system.parameters).numeric(values)
    value = Evaluator(system, values)
    posture = np.zeros(system.size)
    for spring in system.elastic:
        posture[tree.joint_index(spring.joint)] = value(spring.rest)[0]
    elastic = {spring.joint for spring in system.elastic}
    holding = {j for grasp in system.grasps for j in tree.ancestors(tree.frame(grasp.holder).joint)}
    sought = [j for j, joint in enumerate(tree.joints) if j in holding and joint.name not in elastic]
    start = {**ELBOW_UP, **(seed or {})}
    for j, joint in enumerate(tree.joints):
        if joint.name not in elastic:
            bounded = math.isfinite(joint.lower) and math.isfinite(joint.upper)
            middle = 0.5 * (joint.lower + joint.upper) if bounded else 0.0
            posture[j] = np.clip(start.get(joint.name, middle), joint.lower, joint.upper)

    if sought:
        q = ca.SX.sym("q", system.size)
        kinematics = forward_kinematics(tree, q)
        gaps = []
        for grasp in system.grasps:
            offset = Placement(ca.SX(ca.DM.eye(3)), ca.SX(ca.DM(value(grasp.offset))))
            beside = ca.DM(np.asarray((offsets or {}).get(grasp.name, np.zeros(3)), float))
            held = kinematics.position(grasp.held) + beside
            gaps.append((kinematics.pose(grasp.holder) @ offset).translation - held)
        gap = ca.vertcat(*gaps)
        function = ca.Function("gap", [q], [gap, ca.jacobian(gap, q)[:, sought]])

        def at(x: Array) -> Array:
            full = posture.copy()
            full[sought] = x
            return full

        lower = np.array([tree.joints[j].lower for j in sought])
        upper = np.array([tree.joints[j].upper for j in sought])
        near = np.clip(posture[sought], lower + 1e-6, upper - 1e-6)
        # The pull towards the start keeps joints that do not move the gripper where they are.
        result = least_squares(
            lambda x: np.append(np.array(function(at(x))[0]), _PULL * (x - near)),
            near,
            jac=lambda x: np.vstack([np.array(ca.densify(function(at(x))[1])), _PULL * np.eye(len(x))]),
            bounds=(lower, upper),
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
        )
        miss = np.abs(result.fun[: gap.numel()]).max()
        if miss > 1e-7:
            raise ModelError(
                f"the arms miss the grasped points by {1e3 * miss:.3g} mm",
                where=", ".join(f"{grasp.holder} -> {grasp.held}" for grasp in system.grasps),
                allowed="grasps within reach and within the joint limits",
                hint="move the object, or give another seed",
            )
        posture = at(result.x)
    wanted = sorted(set(sought) | set(system.driven_indices))
    return {tree.joints[j].name: float(posture[j]) for j in wanted}


@dataclass(frozen=True)
class Motion:
    """A smooth motion of the driven joints about their initial posture, starting at rest.

    offset_j(t) = r(t) sum_i amplitude_ji sin(2 pi frequency_ji t + phase_ji), with the ramp
    r = 10 s^3 - 15 s^4 + 6 s^5, s = min(t / ramp, 1), twice continuously differentiable.

    Attributes
    ----------
    joints : tuple of str, length nj
    amplitude, frequency, phase : ndarray, shape (nj, nf)
        [rad or m], [Hz], [rad]
    ramp : float
        Duration of the ramp [s].
    """

    joints: tuple[str, ...]
    amplitude: Array
    frequency: Array
    phase: Array
    ramp: float = 1.0

    def at(self, t: float) -> tuple[Array, Array, Array]:
        """Offset, velocity and acceleration at time t [s], three arrays of shape (nj,)."""
        omega = 2 * math.pi * self.frequency
        angle = omega * t + self.phase
        sine, cosine = self.amplitude * np.sin(angle), self.amplitude * np.cos(angle)
        wave, rate, bend = sine.sum(1), (omega * cosine).sum(1), -(omega**2 * sine).sum(1)
        s = min(t / self.ramp, 1.0)
        r = s**3 * (10 - 15 * s + 6 * s**2)
        dr = 30 * s**2 * (1 - s) ** 2 / self.ramp
        ddr = 60 * s * (1 - s) * (1 - 2 * s) / self.ramp**2
        return r * wave, dr * wave + r * rate, ddr * wave + 2 * dr * rate + r * bend

    @staticmethod
    def multisine(
        system: System,
        values: Mapping[str, float] | None = None,
        *,
        seed: int,
        posture: Mapping[str, float] | None = None,
        travel: float = 0.11,
        speed: float = 1.4,
        components: int = 3,
        band: tuple[float, float] = (0.2, 2.0),
        ramp: float = 1.0,
        duration: float = 5.0,
    ) -> Motion:
        """Draw a motion at random and scale it to the wanted travel of the grippers.

        Parameters
        ----------
        system : System
        values : mapping of str to float, optional
            Parameter values; nominal where absent.
        seed : int
            Of the random draw of frequencies and phases.
        posture : mapping of str to float, optional
            Initial angles; `initial_posture` where absent.
        travel : float
            Largest distance of a gripper from its start [m]; every arm is scaled to it by itself. Much more than the
            default, on two arms, lets the foam Y snap from one shape to another.
        speed : float
            No joint is asked to be faster [rad/s]; an arm that would be is slowed by travelling less.
        components : int
            Sines per joint, one in each of as many equal parts (in log frequency) of `band`.
        band : (float, float)
            Lowest and highest frequency [Hz].
        ramp, duration : float
            [s]

        Returns
        -------
        Motion
            Amplitudes fall in inverse proportion to the frequency and towards the base.
        """
        rng = np.random.default_rng(seed)
        nj = len(system.driven)
        edges = np.linspace(math.log(band[0]), math.log(band[1]), components + 1)
        frequency = np.exp(rng.uniform(edges[:-1], edges[1:], (nj, components)))
        phase = rng.uniform(0.0, 2 * math.pi, (nj, components))
        amplitude = rng.uniform(0.7, 1.3, (nj, components)) / frequency
        tree = replace(system.mechanism, parameters=system.parameters).numeric(values)
        start = initial_posture(system, values) if posture is None else posture
        q0 = np.zeros(system.size)
        q0[[tree.joint_index(name) for name in start]] = list(start.values())
        holders = [tree.frame(grasp.holder) for grasp in system.grasps]
        arms = [[i for i, j in enumerate(system.driven_indices) if j in tree.ancestors(f.joint)] for f in holders]
        for arm in arms:  # the same angle near the base moves the hand further
            amplitude[arm] *= np.linspace(0.5, 1.0, len(arm))[:, None]
        q = ca.SX.sym("q", system.size)
        kinematics = forward_kinematics(tree, q)
        times = np.linspace(0.0, duration, 251)
        for frame, arm in zip(holders, arms, strict=True):
            tip = ca.Function("tip", [q], [kinematics.position(frame)]).map(len(times))
            unit = Motion(system.driven, amplitude, frequency, phase, ramp)
            waves = np.array([unit.at(t)[:2] for t in times])
            columns = [system.driven_indices[i] for i in arm]

            def distance(scale: float, tip: Any = tip, w: Array = waves, a: Any = arm, c: Any = columns) -> float:
                path = np.tile(q0, (len(w), 1))
                path[:, c] += scale * w[:, 0, a]
                positions = np.array(tip(path.T))
                return float(np.linalg.norm(positions - positions[:, :1], axis=0).max())

            low, high = 0.0, speed / float(np.abs(waves[:, 1, arm]).max())
            if distance(high) > travel:
                for _ in range(40):
                    middle = 0.5 * (low + high)
                    low, high = (middle, high) if distance(middle) < travel else (low, middle)
            amplitude[arm] *= high
        if not holders:
            unit = Motion(system.driven, amplitude, frequency, phase, ramp)
            amplitude *= speed / max(float(np.abs(unit.at(t)[1]).max()) for t in times)
        return Motion(system.driven, amplitude, frequency, phase, ramp)


class EngineTerms(Protocol):
    """Terms that the simulator has and the system's description has not."""

    def prepare(self, model: Any) -> None:
        """Edit the compiled `mujoco.MjModel`."""
        ...

    def begin(self, data: Any) -> None:
        """Told when the motion begins, at rest."""
        ...

    def force(self, model: Any, data: Any) -> None:
        """Add generalized forces to `data.qfrc_passive`; called at every inner step."""
        ...


@dataclass(frozen=True)
class SimulatedRun:
    """What happened in the simulator, free of noise.

    Attributes
    ----------
    t : ndarray, shape (N + 1,)
        [s]
    q, v : ndarray, shape (N + 1, n)
        In configuration order [rad or m].
    effort : ndarray, shape (N + 1, nu)
        Torque held from t_k to t_{k+1} [N m]; the last row was computed and not applied.
    points : ndarray, shape (N + 1, np, 3)
        Of `system.points` in the world [m].
    frame_t : ndarray, shape (M,)
        Times of the camera's frames, rounded to the simulator's step [s].
    frame_points : ndarray, shape (M, np, 3)
        [m]
    grasp_error : ndarray, shape (N + 1, number of grasps)
        Distance between the two ends of each grasp [m].
    """

    t: Array
    q: Array
    v: Array
    effort: Array
    points: Array
    frame_t: Array
    frame_points: Array
    grasp_error: Array


def simulate_in_mujoco(
    system: System,
    values: Mapping[str, float] | None,
    motion: Motion,
    *,
    duration: float = 5.0,
    rate: float = 100.0,
    time_step: float = INNER_STEP,
    posture: Mapping[str, float] | None = None,
    frame_times: ArrayLike = (),
    injected: EngineTerms | None = None,
) -> SimulatedRun:
    """Let the controller follow a motion in MuJoCo, from static equilibrium at the initial posture.

    The torque is that of the arms' inverse dynamics along the motion, plus the load of the grasps at rest, plus
    feedback of position and velocity; it is computed `rate` times a second and held in between.

    Parameters
    ----------
    system : System
    values : mapping of str to float or None
        Parameter values; nominal where absent.
    motion : Motion
        Of exactly the driven joints.
    duration : float
        [s]
    rate : float
        Of controller and samples [Hz].
    time_step : float
        Of the simulator [s]; must divide 1 / rate.
    posture : mapping of str to float, optional
        Initial angles; `initial_posture` where absent.
    frame_times : array_like, shape (M,)
        When a camera looks [s], increasing, in [0, duration].
    injected : EngineTerms, optional
        What is at work beside the system's description. MuJoCo knows one such callback for the whole process: no other
        simulation may run meanwhile in another thread.

    Returns
    -------
    SimulatedRun

    Raises
    ------
    ConfigError
        Steps or joints that do not fit.
    ModelError
        The system cannot be expressed (`mujoco_xml`), has prescribed or no driven joints, does not come to rest, or
        diverges.
    DataError
        MuJoCo is not installed.
    """
    inner = round(1.0 / (rate * time_step))
    if inner < 1 or abs(inner * time_step * rate - 1.0) > 1e-9:
        raise ConfigError(
            f"time_step = {time_step:g} s does not divide the period of {rate:g} Hz", allowed="1/(rate k), k whole"
        )
    if tuple(motion.joints) != tuple(system.driven) or not system.driven or system.prescribed:
        raise ModelError(
            "the motion is not one of the driven joints",
            where=f"motion of {', '.join(motion.joints) or 'nothing'}",
            allowed=f"the driven joints ({', '.join(system.driven) or 'none'}), nothing prescribed",
        )
    mujoco = mujoco_module()
    model = compiled_model(mujoco_xml(system, values, time_step=time_step))
    nominal_damping = np.array(model.dof_damping)
    with _at_work(mujoco, model, injected):
        data = mujoco.MjData(model)
        # Every joint has one coordinate, so positions, velocities and joints share their addresses.
        order = np.array([model.joint(name).id for name in system.mechanism.joint_names])
        driven = order[list(system.driven_indices)]
        start = initial_posture(system, values) if posture is None else posture
        data.qpos[:] = model.qpos_spring
        data.qpos[[model.joint(name).id for name in start]] = list(start.values())
        balance = _settle(mujoco, model, data, driven, nominal_damping)
        if injected is not None:
            injected.begin(data)

        free = copy.copy(model)
        free.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EQUALITY)
        shadow = mujoco.MjData(free)
        rest = data.qpos.copy()

        def arm_torque(q: Array, v: Array, a: Array) -> Array:
            shadow.qpos[:], shadow.qvel[:], shadow.qacc[:] = rest, 0.0, 0.0
            shadow.qpos[driven], shadow.qvel[driven], shadow.qacc[driven] = q, v, a
            mujoco.mj_inverse(free, shadow)
            return np.array(shadow.qfrc_inverse[driven])

        zero = np.zeros(len(driven))
        load = balance - arm_torque(rest[driven], zero, zero)
        sites = [model.site(name).id for name in system.points]
        ends = [[model.site(f"grasp_{g.name}_{end}").id for end in ("holder", "held")] for g in system.grasps]
        frames = np.round(np.asarray(frame_times, float) / time_step).astype(int)
        steps = round(duration * rate)
        q, v, effort, points, error, seen = [], [], [], [], [], []
        for k in range(steps + 1):
            mujoco.mj_kinematics(model, data)
            offset, velocity, acceleration = motion.at(k / rate)
            reference = rest[driven] + offset
            demand = acceleration + 2 * _BANDWIDTH * (velocity - data.qvel[driven])
            demand += _BANDWIDTH**2 * (reference - data.qpos[driven])
            torque = load + arm_torque(reference, velocity, demand)
            q.append(data.qpos[order])
            v.append(data.qvel[order])
            effort.append(torque)
            points.append(data.site_xpos[sites])
            error.append([np.linalg.norm(data.site_xpos[a] - data.site_xpos[b]) for a, b in ends])
            data.qfrc_applied[driven] = torque
            done = k * inner
            for frame in frames[(frames >= done) & (frames < done + inner)]:
                if frame > done:
                    mujoco.mj_step(model, data, nstep=int(frame - done))
                    mujoco.mj_kinematics(model, data)
                seen.append(data.site_xpos[sites])
                done = int(frame)
            if k < steps:
                mujoco.mj_step(model, data, nstep=(k + 1) * inner - done)
        result = SimulatedRun(
            np.arange(steps + 1) / rate,
            np.array(q),
            np.array(v),
            np.array(effort),
            np.array(points),
            frames[: len(seen)] * time_step,
            np.array(seen).reshape(len(seen), len(sites), 3),
            np.array(error).reshape(steps + 1, len(ends)),
        )
        if (
            not (np.isfinite(result.q).all() and np.isfinite(result.effort).all())
            or data.warning[_BAD_ACCELERATION].number
        ):
            raise ModelError(
                "the simulation diverged", where="MuJoCo", hint="take a shorter time_step or a calmer motion"
            )
        return result


@contextlib.contextmanager
def _at_work(mujoco: ModuleType, model: Any, injected: EngineTerms | None) -> Iterator[None]:
    """Let injected terms act inside MuJoCo while the block runs."""
    if injected is None:
        yield
        return
    injected.prepare(model)
    mujoco.set_mjcb_passive(injected.force)
    try:
        yield
    finally:
        mujoco.set_mjcb_passive(None)


_BAD_ACCELERATION = 6  # mjWARN_BADQACC: MuJoCo then resets its state and goes on


def virtual_experiment(
    system: System,
    values: Mapping[str, float] | None = None,
    *,
    motion: Motion | None = None,
    duration: float = 5.0,
    rate: float = 100.0,
    seed: int = 0,
    vision: bool = True,
    joint_noise: float = 2e-4,
    velocity_noise: float = 5e-3,
    effort_noise: float = 0.0,
    arm_point_noise: float = 1e-3,
    camera_noise: float = 5e-3,
    camera_rate: float = 3.0,
    camera_gaps: bool = True,
    camera_points: Sequence[str] | None = None,
    camera_missing: float = 0.1,
    camera_pose: ArrayLike | None = None,
    time_step: float = INNER_STEP,
    posture: Mapping[str, float] | None = None,
    injected: EngineTerms | None = None,
    name: str = "virtual",
    description: str = "",
) -> Recording:
    """Record a virtual robot moving the object: joint encoders, torques, grasped points and a slow camera.

    Parameters
    ----------
    system : System
    values : mapping of str to float, optional
        True parameter values; nominal where absent.
    motion : Motion, optional
        `Motion.multisine` with `seed` where absent.
    duration : float
        [s]
    rate : float
        Of controller, joints and arm points [Hz].
    seed : int
        Of all noise; each sensor has its own stream, so that leaving one out changes no other.
    vision : bool
        Whether there is a camera.
    joint_noise, velocity_noise, effort_noise : float
        Standard deviation of the noise on position [rad], velocity [rad/s] and recorded (not applied) torque [N m].
    arm_point_noise, camera_noise : float
        Standard deviation of the white noise on each coordinate of a point [m].
    camera_rate : float
        Mean rate of frames [Hz]; periods vary by a quarter either way.
    camera_gaps : bool
        Whether frames are lost for 1 to 1.5 s about once every 2.5 s of recording.
    camera_points : sequence of str, optional
        What the camera can see; all points that no arm holds where absent.
    camera_missing : float
        Probability that a point is hidden in a frame (NaN).
    camera_pose : array_like, shape (4, 4), optional
        Camera (x right, y down, z ahead) in the world; 2 m from the object, opposite the robot, where absent.
    time_step : float
        Of the simulator [s].
    posture : mapping of str to float, optional
        Initial angles; `initial_posture` where absent.
    injected : EngineTerms, optional
        What is at work beside the system's description.
    name, description : str
        Of the recording; how it was made is appended to the description.

    Returns
    -------
    Recording
        `joints`: index k is node k, `effort[k]` is held from t_k to t_{k+1}. `points_arm` at the same times, for the
        grasped points; `points_camera` with its own clock. `truth` holds all stiffness, damping and mass parameters.

    Raises
    ------
    ConfigError, ModelError, DataError
        As `simulate_in_mujoco`.
    """
    streams = [np.random.default_rng(entry) for entry in np.random.SeedSequence(seed).spawn(6)]
    start = initial_posture(system, values) if posture is None else posture
    if motion is None:
        motion = Motion.multisine(system, values, seed=seed, posture=start, duration=duration)
    held = tuple(dict.fromkeys(grasp.held for grasp in system.grasps if grasp.held in system.points))
    visible = tuple(point for point in system.points if point not in held) if camera_points is None else camera_points
    for point in visible:
        if point not in system.points:
            raise ConfigError(f"the camera cannot see '{point}'", allowed=", ".join(system.points))
    times = _frame_times(streams[4], duration, camera_rate, camera_gaps) if vision and visible else np.empty(0)
    run = simulate_in_mujoco(
        system,
        values,
        motion,
        duration=duration,
        rate=rate,
        time_step=time_step,
        posture=start,
        frame_times=times,
        injected=injected,
    )

    driven = list(system.driven_indices)
    joints = JointGroup(
        names=tuple(system.driven),
        t=run.t,
        position=_noisy(run.q[:, driven], joint_noise, streams[0]),
        velocity=_noisy(run.v[:, driven], velocity_noise, streams[1]),
        effort=_noisy(run.effort, effort_noise, streams[2]),
        position_std=joint_noise,
        velocity_std=velocity_noise,
        effort_std=effort_noise,
    )
    groups = []
    if held:
        clean = run.points[:, [system.points.index(point) for point in held]]
        position = _noisy(clean, arm_point_noise, streams[3])
        std = np.full(clean.shape, arm_point_noise)
        groups.append(PointGroup("points_arm", held, run.t, position, std, sensor="arm"))
    if len(run.frame_t):
        columns = [system.points.index(point) for point in visible]
        clean = run.frame_points[:, columns]
        position = _noisy(clean, camera_noise, streams[5])
        position[streams[5].random(position.shape[:2]) < camera_missing] = np.nan
        pose = _camera_pose(run.points[0].mean(0)) if camera_pose is None else np.asarray(camera_pose, float)
        std = np.full(clean.shape, camera_noise)
        groups.append(PointGroup("points_camera", tuple(visible), run.frame_t, position, std, "camera", pose=pose))

    made = (
        f"Virtual experiment in MuJoCo {mujoco_module().__version__} "
        f"(implicitfast, {1e3 * time_step:g} ms inner step): multi-sine motion of {len(driven)} joints "
        f"from static equilibrium, torque held over each {1e3 / rate:g} ms, "
        f"seed {seed}. White noise: joint position {joint_noise:g} rad, velocity {velocity_noise:g} rad/s, "
        f"effort {effort_noise:g} N m, arm points {1e3 * arm_point_noise:g} mm"
    )
    made += f", camera {1e3 * camera_noise:g} mm at about {camera_rate:g} Hz." if len(run.frame_t) else "; no camera."
    quantities = ("bend", "twist", "damping", "twist_damping", "mass")
    theta = system.parameters.vector(values)
    truth = {n: float(theta[i]) for i, n in enumerate(system.parameters.names) if n.rpartition(".")[2] in quantities}
    text = f"{description} {made}".strip()
    source = "yid_ocp virtual experiment"
    return validate(Recording(joints, tuple(groups), text, source, name, truth=truth))


def _settle(mujoco: ModuleType, model: Any, data: Any, driven: Array, damping: Array) -> Array:
    """Bring `data` to static equilibrium with the driven joints where they are; return their torques [N m].

    On the way there joints damp as `damping` says: of several shapes that an object can rest in, it must not depend on
    its own damping which is found.
    """
    held = copy.copy(model)
    target = data.qpos[driven].copy()
    others = np.setdiff1d(np.arange(model.nv), driven)
    held.dof_damping[:] = damping
    held.dof_damping[others] *= _SETTLING_FACTOR
    held.dof_damping[driven] += _HOLD_DAMPING
    held.jnt_stiffness[driven] += _HOLD_STIFFNESS
    held.qpos_spring[driven] = target
    block = max(1, round(0.1 / model.opt.timestep))
    for _ in range(math.ceil(_SETTLING_LIMIT / (block * model.opt.timestep))):
        mujoco.mj_step(held, data, nstep=block)
        calm, error = float(np.abs(data.qvel).max()), target - data.qpos[driven]
        if np.abs(error).max() > _POSTURE_TOLERANCE:
            held.qpos_spring[driven] += error
        elif calm < _REST:
            break
    else:
        raise ModelError(
            f"the object does not come to rest in {_SETTLING_LIMIT:g} s (largest velocity {calm:.2g} rad/s)",
            where="settling before the motion",
            hint="give every coordinate some damping and enough stiffness to stand",
        )
    balance = _HOLD_STIFFNESS * (held.qpos_spring[driven] - data.qpos[driven])
    data.qvel[:], data.qacc_warmstart[:], data.time = 0.0, 0.0, 0.0
    return balance


def _noisy(clean: Array, std: float, rng: np.random.Generator) -> Array:
    return np.array(clean + std * rng.standard_normal(clean.shape))


def _frame_times(rng: np.random.Generator, duration: float, rate: float, gaps: bool) -> Array:
    count = math.ceil(2 * duration * rate) + 2
    times = np.cumsum(rng.uniform(0.75, 1.25, count) / rate)
    times = times[times < duration]
    if gaps:
        number = max(1, round(duration / 2.5))
        starts = duration / number * (np.arange(number) + rng.uniform(0.15, 0.45, number))
        lengths = rng.uniform(1.0, 1.5, number)
        lost = ((times[:, None] >= starts) & (times[:, None] <= starts + lengths)).any(1)
        times = times[~lost]
    return np.asarray(times)


def _camera_pose(target: Array) -> Array:
    away = np.array([0.93, 0.0, 0.37])
    away /= np.linalg.norm(away)
    right = np.cross(-away, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(-away, right), -away])
    pose[:3, 3] = target + 2.0 * away
    return pose

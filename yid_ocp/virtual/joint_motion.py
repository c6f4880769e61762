"""Random multisine motions of the driven joints, and start angles at which the grippers meet the object."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from yid_ocp.arrays import Array
from yid_ocp.errors import ModelError
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.mechanism import Mechanism, Placement
from yid_ocp.model.system import System
from yid_ocp.virtual.mjcf import CasadiEvaluator

BAXTER_JOINT_NAMES_WITHOUT_SIDE = ("s0", "s1", "e0", "e1", "w0", "w1", "w2")
_ELBOW_UP_ANGLES: Mapping[str, float] = {
    f"{side}_{joint}": sign * value if joint in ("s0", "e0", "w0", "w2") else value
    for side, sign in (("left", 1.0), ("right", -1.0))
    for joint, value in zip(BAXTER_JOINT_NAMES_WITHOUT_SIDE, (-0.40, -1.13, -0.15, 1.19, -0.08, 1.13, 0.0), strict=True)
}  # initial guess for Baxter [rad]: elbow above the hand, the right arm mirrored
_SECOND_HARMONIC = 0.35  # amplitude relative to the first harmonic
_PULL = 1e-5  # weight of the distance from the start angles; moves the gripper by less than 1e-9 m [m/rad]


class JointOffsetMotion(Protocol):
    """The interface of a motion of the driven joints about their initial angles that starts from standstill."""

    @property
    def joints(self) -> tuple[str, ...]:
        """The names of the nj joints that the motion moves."""

    def offset_and_derivatives(self, t: float) -> tuple[Array, Array, Array]:
        """Return the offset (nj,) from the initial angles at time t [s], with its first and second time derivative."""


@dataclass(frozen=True)
class MultisineMotion:
    """A multisine motion of the driven joints about their initial angles that starts from standstill.

    The offset of joint j is r(t) sum_i amplitude_ji sin(2 pi frequency_ji t + phase_ji). The ramp r = 10 s^3 - 15 s^4 +
    6 s^5 with s = min(t / ramp_time, 1) is twice continuously differentiable.
    """

    joints: tuple[str, ...]
    amplitude: Array  # shape (nj, nf) [rad or m]
    frequency: Array  # shape (nj, nf) [Hz]
    phase: Array  # shape (nj, nf) [rad]
    ramp_time: float = 1.0  # [s]

    def offset_and_derivatives(self, t: float) -> tuple[Array, Array, Array]:
        """Return the offset (nj,) from the initial angles at time t [s], with its first and second time derivative."""
        omega = 2 * math.pi * self.frequency
        angle = omega * t + self.phase
        sine, cosine = self.amplitude * np.sin(angle), self.amplitude * np.cos(angle)
        wave, rate, bend = sine.sum(1), (omega * cosine).sum(1), -(omega**2 * sine).sum(1)
        s = min(t / self.ramp_time, 1.0)
        r, dr = s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2 / self.ramp_time
        ddr = 60 * s * (1 - s) * (1 - 2 * s) / self.ramp_time**2
        return r * wave, dr * wave + r * rate, ddr * wave + 2 * dr * rate + r * bend


@dataclass(frozen=True)
class MultisineOptions:
    """The amplitude, speed and frequency limits of a random multisine motion.

    The motion of each arm is scaled separately to `gripper_travel`. With two arms, much more travel than the default
    makes the foam Y snap between shapes. A frequency band is divided into parts of equal width in log frequency, with
    one sine in each part.
    """

    gripper_travel: float = 0.11  # largest distance of a gripper from its start [m]
    max_joint_speed: float = 1.4  # limit on all joints; an arm that would exceed it travels less [rad/s]
    sines_per_joint: int = 3
    frequency_band: tuple[float, float] = (0.2, 2.0)  # [Hz]
    ramp_time: float = 1.0  # [s]
    duration: float = 5.0  # [s]
    has_second_harmonic: bool = False  # whether each sine comes with a second one at twice its frequency


def random_multisine_motion(
    system: System,
    values: Mapping[str, float] | None = None,
    *,
    seed: int,
    initial_joint_angles: Mapping[str, float] | None = None,
    excitation: MultisineOptions | None = None,
) -> MultisineMotion:
    """Draw a random multisine motion of the driven joints, scaled to the requested travel of the grippers.

    Amplitudes decrease with frequency (as 1/frequency) and towards the base. Defaults: `values` are nominal, initial
    angles [rad or m] come from `grasping_joint_angles`. Without grasps, joints reach `max_joint_speed`.
    """
    chosen, rng = excitation or MultisineOptions(), np.random.default_rng(seed)
    shape = len(system.driven), chosen.sines_per_joint
    frequency, phase = _drawn_frequencies(chosen.frequency_band, shape, rng), rng.uniform(0.0, 2 * math.pi, shape)
    amplitude = rng.uniform(0.7, 1.3, shape) / frequency
    if chosen.has_second_harmonic:
        amplitude = np.hstack([amplitude, _SECOND_HARMONIC * amplitude])
        frequency, phase = np.hstack([frequency, 2 * frequency]), np.hstack([phase, 2 * phase])
    motion = MultisineMotion(system.driven, amplitude, frequency, phase, chosen.ramp_time)
    times = np.linspace(0.0, chosen.duration, 251)
    start = grasping_joint_angles(system, values) if initial_joint_angles is None else initial_joint_angles
    tree, q0 = system.mechanism_with_values(values), np.zeros(system.n_coordinates)
    q0[[tree.joint_index(name) for name in start]] = list(start.values())
    holders = [tree.frame(grasp.holder_frame) for grasp in system.grasps]
    chains = [tree.ancestor_joint_indices(frame.joint_index) for frame in holders]
    arms = [[i for i, j in enumerate(system.actuated_coordinate_indices) if j in chain] for chain in chains]
    for arm in arms:  # the same angle near the base moves the hand further
        motion = _scaled(motion, arm, np.linspace(0.5, 1.0, len(arm)))
    q = ca.SX.sym("q", system.n_coordinates)
    kinematics = forward_kinematics(tree, q)
    for frame, arm in zip(holders, arms, strict=True):
        tip = ca.Function("tip", [q], [kinematics.frame_position(frame)]).map(len(times))
        waves = np.array([motion.offset_and_derivatives(t)[:2] for t in times])[:, :, arm]
        scale = _scale(chosen, tip, q0, [system.actuated_coordinate_indices[i] for i in arm], waves)
        motion = _scaled(motion, arm, np.full(len(arm), scale))
    if not holders:
        fastest = max(float(np.abs(motion.offset_and_derivatives(t)[1]).max()) for t in times)
        joints = range(len(motion.joints))
        motion = _scaled(motion, joints, np.full(len(joints), chosen.max_joint_speed / fastest))
    return motion


def _scaled(motion: MultisineMotion, joints: Sequence[int], factors: Array) -> MultisineMotion:
    amplitude = motion.amplitude.copy()
    amplitude[list(joints)] *= factors[:, None]
    return replace(motion, amplitude=amplitude)


def _drawn_frequencies(band: tuple[float, float], shape: tuple[int, int], rng: np.random.Generator) -> Array:
    """One random frequency in each of equal parts, in log frequency, of a band."""
    edges = np.linspace(math.log(band[0]), math.log(band[1]), shape[1] + 1)
    return np.exp(rng.uniform(edges[:-1], edges[1:], shape))


def _scale(excitation: MultisineOptions, tip: ca.Function, q0: Array, columns: Sequence[int], waves: Array) -> float:
    """Factor on an arm's `waves` (N, 2, nj), offsets and velocities, with which `tip` reaches the requested travel."""

    def distance(scale: float) -> float:
        path = np.tile(q0, (len(waves), 1))
        path[:, columns] += scale * waves[:, 0]
        positions = np.array(tip(path.T))
        return float(np.linalg.norm(positions - positions[:, :1], axis=0).max())

    low, high = 0.0, excitation.max_joint_speed / float(np.abs(waves[:, 1]).max())
    if distance(high) > excitation.gripper_travel:
        for _ in range(40):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if distance(middle) < excitation.gripper_travel else (low, middle)
    return high


def grasping_joint_angles(
    system: System,
    values: Mapping[str, float] | None = None,
    *,
    start_angles: Mapping[str, float] | None = None,
    offsets: Mapping[str, ArrayLike] | None = None,
) -> dict[str, float]:
    """Find arm joint angles at which every gripper meets the end of the undeformed object, or a point near it.

    Returns the angles [rad or m], in configuration order, of all driven joints and of all non-elastic joints that carry
    a gripper. Only positions are matched. Of several solutions the one nearest to the start is taken. Raises
    `ModelError` if the grasped points cannot be reached within the joint limits.

    Parameters
    ----------
    values : mapping of str to float, optional
        Parameter values. Default: nominal.
    start_angles : mapping of str to float, optional
        Start of the search by joint [rad or m]. Default: elbow up for Baxter, else the middle of the joint's range, or
        zero if the joint is unlimited.
    offsets : mapping of grasp to array_like, shape (3,), optional
        Position of each gripper relative to the grasped point of the undeformed object, in the world [m]. Two arms that
        hold the undeformed Y are fully stretched, a singular posture. Offsets that bring the grippers closer avoid it.
    """
    tree, value = system.mechanism_with_values(values), CasadiEvaluator(system, values)
    posture = _undeformed(system, tree, value, {**_ELBOW_UP_ANGLES, **(start_angles or {})})
    elastic = {spring.joint_name for spring in system.elastic_joints}
    holders = (tree.frame(grasp.holder_frame).joint_index for grasp in system.grasps)
    holding = {j for holder in holders for j in tree.ancestor_joint_indices(holder)}
    sought = [j for j, joint in enumerate(tree.joints) if j in holding and joint.name not in elastic]
    if sought:
        posture = _reached(system, tree, posture, sought, _gap_function(system, tree, value, offsets or {}, sought))
    wanted = sorted(set(sought) | set(system.actuated_coordinate_indices))
    return {tree.joints[j].name: float(posture[j]) for j in wanted}


def _undeformed(system: System, tree: Mechanism, value: CasadiEvaluator, start: Mapping[str, float]) -> Array:
    """Configuration (n,) with an undeformed object and the other joints at the start of the search."""
    posture, elastic = np.zeros(system.n_coordinates), {spring.joint_name for spring in system.elastic_joints}
    for spring in system.elastic_joints:
        posture[tree.joint_index(spring.joint_name)] = value(spring.rest_angle)[0]
    for j, joint in enumerate(tree.joints):
        if joint.name not in elastic:
            bounded = math.isfinite(joint.lower_limit) and math.isfinite(joint.upper_limit)
            middle = 0.5 * (joint.lower_limit + joint.upper_limit) if bounded else 0.0
            posture[j] = np.clip(start.get(joint.name, middle), joint.lower_limit, joint.upper_limit)
    return posture


def _gap_function(
    system: System, tree: Mechanism, value: CasadiEvaluator, offsets: Mapping[str, ArrayLike], sought: Sequence[int]
) -> ca.Function:
    """Function of q: gaps [m] between grippers and the held points, and their derivatives by the searched joints."""
    q = ca.SX.sym("q", system.n_coordinates)
    kinematics, gaps = forward_kinematics(tree, q), []
    for grasp in system.grasps:
        offset = Placement(ca.SX(ca.DM.eye(3)), ca.SX(ca.DM(value(grasp.holder_offset))))
        beside = ca.DM(np.asarray(offsets.get(grasp.name, np.zeros(3)), float))
        held = kinematics.frame_position(grasp.held_frame) + beside
        gaps.append((kinematics.frame_pose(grasp.holder_frame) @ offset).translation - held)
    gap = ca.vertcat(*gaps)
    return ca.Function("gap", [q], [gap, ca.jacobian(gap, q)[:, list(sought)]])


def _reached(system: System, tree: Mechanism, posture: Array, sought: Sequence[int], gap: ca.Function) -> Array:

    def at(x: Array) -> Array:
        full = posture.copy()
        full[sought] = x
        return full

    lower = np.array([tree.joints[j].lower_limit for j in sought])
    upper = np.array([tree.joints[j].upper_limit for j in sought])
    near = np.clip(posture[sought], lower + 1e-6, upper - 1e-6)
    # The pull towards the start keeps joints that do not move the gripper at their angles.
    result = least_squares(
        lambda x: np.append(np.array(gap(at(x))[0]), _PULL * (x - near)),
        near,
        jac=lambda x: np.vstack([np.array(ca.densify(gap(at(x))[1])), _PULL * np.eye(len(x))]),
        bounds=(lower, upper),
        **dict.fromkeys(("xtol", "ftol", "gtol"), 1e-15),
    )
    miss = np.abs(result.fun[: gap.numel_out(0)]).max()
    if miss > 1e-7:
        worst = system.grasps[int(np.abs(result.fun[: gap.numel_out(0)]).argmax()) // 3]
        where, size = f"model.grasp.{worst.name}", f"{miss:.3g} m" if miss >= 1 else f"{1e3 * miss:.3g} mm"
        what = f"{worst.holder_frame} cannot reach {worst.held_frame}: {size} are missing at the best angles found"
        hint = "set model.object.mount.xyz nearer to the robot, or grasp another point; for a motion from given angles "
        hint += "(plan.start_joint_positions), use `yid-ocp plan`"
        raise ModelError(what, where=where, allowed="grasps within reach and within the joint limits", hint=hint)
    return at(result.x)

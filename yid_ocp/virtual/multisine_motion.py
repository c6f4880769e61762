"""Multisine motions of the driven joints with a smooth start, scaled to a given travel of the grippers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.model.kinematics import forward_kinematics, mass_matrix, rigid_body_derivatives
from yid_ocp.model.system import System
from yid_ocp.virtual.inverse_kinematics import grasping_joint_angles

Array = NDArray[np.float64]


class JointMotion(Protocol):
    """Interface of a motion of the driven joints about their initial angles, from rest."""

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""
        ...

    def offset_and_derivatives(self, t: float) -> tuple[Array, Array, Array]:
        """Offset from the initial angles, velocity and acceleration at time t [s], three arrays of shape (nj,)."""
        ...


@dataclass(frozen=True)
class MultisineMotion:
    """A multisine motion of the driven joints about their initial angles, starting at rest.

    offset_j(t) = r(t) sum_i amplitude_ji sin(2 pi frequency_ji t + phase_ji), with the ramp
    r = 10 s^3 - 15 s^4 + 6 s^5, s = min(t / ramp, 1), twice continuously differentiable.

    Attributes
    ----------
    joints : tuple of str, length nj
    amplitude, frequency, phase : ndarray, shape (nj, nf)
        [rad or m], [Hz], [rad]
    ramp_time : float
        Duration of the ramp [s].
    """

    joints: tuple[str, ...]
    amplitude: Array
    frequency: Array
    phase: Array
    ramp_time: float = 1.0

    def offset_and_derivatives(self, t: float) -> tuple[Array, Array, Array]:
        """Offset from the initial angles, velocity and acceleration at time t [s], three arrays of shape (nj,)."""
        omega = 2 * math.pi * self.frequency
        angle = omega * t + self.phase
        sine, cosine = self.amplitude * np.sin(angle), self.amplitude * np.cos(angle)
        wave, rate, bend = sine.sum(1), (omega * cosine).sum(1), -(omega**2 * sine).sum(1)
        s = min(t / self.ramp_time, 1.0)
        r = s**3 * (10 - 15 * s + 6 * s**2)
        dr = 30 * s**2 * (1 - s) ** 2 / self.ramp_time
        ddr = 60 * s * (1 - s) * (1 - 2 * s) / self.ramp_time**2
        return r * wave, dr * wave + r * rate, ddr * wave + 2 * dr * rate + r * bend


@dataclass(frozen=True)
class MultisineOptions:
    """Amplitude, speed and frequency limits of a random multisine motion.

    Attributes
    ----------
    gripper_travel : float
        Largest distance of a gripper from its start [m]; every arm is scaled to it by itself. Much more than the
        default, on two arms, lets the foam Y snap from one shape to another.
    max_joint_speed : float
        Largest joint speed [rad/s]; an arm that would exceed it travels less.
    sines_per_joint : int
        Sines per joint, one in each of as many equal parts (in log frequency) of `frequency_band`, and as many that shake.
    frequency_band : (float, float)
        Lowest and highest frequency [Hz].
    ramp_time, duration : float
        [s]
    shake_torque_rms : float
        Root mean square of the torque that each joint's own inertia takes beside its travel [N m], in sines of equal
        torque of the band `shake_frequency_band`, none faster than `max_shake_speed`. Zero leaves torques as gentle as the travel.
    shake_frequency_band : (float, float)
        [Hz]; well below half the rate of what records the torque.
    max_shake_speed : float
        Largest velocity of one of these sines [rad/s]; what light wrists reach first.
    """

    gripper_travel: float = 0.11
    max_joint_speed: float = 1.4
    sines_per_joint: int = 3
    frequency_band: tuple[float, float] = (0.2, 2.0)
    ramp_time: float = 1.0
    duration: float = 5.0
    shake_torque_rms: float = 0.0
    shake_frequency_band: tuple[float, float] = (4.0, 9.0)
    max_shake_speed: float = 0.15


def random_multisine(
    system: System,
    values: Mapping[str, float] | None = None,
    *,
    seed: int,
    initial_joint_angles: Mapping[str, float] | None = None,
    excitation: MultisineOptions | None = None,
) -> MultisineMotion:
    """Draw a random multisine motion, scaled to the requested travel of the grippers.

    Parameters
    ----------
    system : System
    values : mapping of str to float, optional
        Parameter values; nominal where absent.
    seed : int
        Of the random draw of frequencies and phases.
    initial_joint_angles : mapping of str to float, optional
        Initial angles [rad or m]; `grasping_joint_angles` where absent.
    excitation : Excitation, optional

    Returns
    -------
    Motion
        Amplitudes fall in inverse proportion to the frequency and towards the base.
    """
    chosen = excitation or MultisineOptions()
    rng = np.random.default_rng(seed)
    motion = _drawn(system, chosen, rng)
    times = np.linspace(0.0, chosen.duration, 251)
    start = grasping_joint_angles(system, values) if initial_joint_angles is None else initial_joint_angles
    tree = replace(system.mechanism, parameters=system.parameters).with_numeric_values(values)
    q0 = np.zeros(system.n_coordinates)
    q0[[tree.joint_index(name) for name in start]] = list(start.values())
    holders = [tree.frame(grasp.holder_frame) for grasp in system.grasps]
    arms = [
        [i for i, j in enumerate(system.driven_indices) if j in tree.ancestor_joints(f.joint_index)] for f in holders
    ]
    for arm in arms:  # the same angle near the base moves the hand further
        motion = _scaled(motion, arm, np.linspace(0.5, 1.0, len(arm)))
    q = ca.SX.sym("q", system.n_coordinates)
    kinematics = forward_kinematics(tree, q)
    for frame, arm in zip(holders, arms, strict=True):
        tip = ca.Function("tip", [q], [kinematics.frame_position(frame)]).map(len(times))
        waves = np.array([motion.offset_and_derivatives(t)[:2] for t in times])[:, :, arm]
        scale = _scale(chosen, tip, q0, [system.driven_indices[i] for i in arm], waves)
        motion = _scaled(motion, arm, np.full(len(arm), scale))
    if not holders:
        fastest = max(float(np.abs(motion.offset_and_derivatives(t)[1]).max()) for t in times)
        joints = range(len(motion.joints))
        motion = _scaled(motion, joints, np.full(len(joints), chosen.max_joint_speed / fastest))
    if chosen.shake_torque_rms == 0.0:
        return motion
    rigid = rigid_body_derivatives(kinematics, ca.SX(ca.DM.zeros(system.n_coordinates)), ca.SX(ca.DM.zeros(3)))
    inertia = np.diag(np.array(ca.densify(ca.Function("M", [q], [mass_matrix(rigid, tree)])(q0))))
    return _shaken(motion, chosen, inertia[list(system.driven_indices)], rng)


def _scaled(motion: MultisineMotion, joints: Sequence[int], factors: Array) -> MultisineMotion:
    amplitude = motion.amplitude.copy()
    amplitude[list(joints)] *= factors[:, None]
    return replace(motion, amplitude=amplitude)


def _drawn(system: System, excitation: MultisineOptions, rng: np.random.Generator) -> MultisineMotion:
    """Frequencies, phases and relative amplitudes at random."""
    nj, components = len(system.driven), excitation.sines_per_joint
    lowest, highest = excitation.frequency_band
    edges = np.linspace(math.log(lowest), math.log(highest), components + 1)
    frequency = np.exp(rng.uniform(edges[:-1], edges[1:], (nj, components)))
    phase = rng.uniform(0.0, 2 * math.pi, (nj, components))
    amplitude = rng.uniform(0.7, 1.3, (nj, components)) / frequency
    return MultisineMotion(system.driven, amplitude, frequency, phase, excitation.ramp_time)


def _shaken(
    motion: MultisineMotion, excitation: MultisineOptions, inertia: Array, rng: np.random.Generator
) -> MultisineMotion:
    """The motion with fast sines added; `joint_mass_matrices` of the driven joints, shape (nj,) [kg m^2]."""
    nj, components = motion.frequency.shape
    lowest, highest = excitation.shake_frequency_band
    edges = np.linspace(math.log(lowest), math.log(highest), components + 1)
    frequency = np.exp(rng.uniform(edges[:-1], edges[1:], (nj, components)))
    omega = 2 * math.pi * frequency
    torque = excitation.shake_torque_rms * math.sqrt(2.0 / components)
    amplitude = np.minimum(torque / (inertia[:, None] * omega**2), excitation.max_shake_speed / omega)
    phase = rng.uniform(0.0, 2 * math.pi, (nj, components))
    return replace(
        motion,
        amplitude=np.hstack([motion.amplitude, amplitude]),
        frequency=np.hstack([motion.frequency, frequency]),
        phase=np.hstack([motion.phase, phase]),
    )


def _scale(excitation: MultisineOptions, tip: ca.Function, q0: Array, columns: Sequence[int], waves: Array) -> float:
    """Factor with which an arm's waves (N, 2, nj), offset and velocity, take the tip as far as wanted."""

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

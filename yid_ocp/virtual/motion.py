"""Multisine motions of the driven joints with a smooth start, scaled to a given travel of the grippers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.model.kinematics import forward_kinematics, mass_matrix, rigid_body
from yid_ocp.model.system import System
from yid_ocp.virtual.posture import initial_posture

Array = NDArray[np.float64]


class Movement(Protocol):
    """Interface of a motion of the driven joints about their initial angles, from rest."""

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""
        ...

    def at(self, t: float) -> tuple[Array, Array, Array]:
        """Offset from the initial angles, velocity and acceleration at time t [s], three arrays of shape (nj,)."""
        ...


@dataclass(frozen=True)
class Motion:
    """A multisine motion of the driven joints about their initial angles, starting at rest.

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
        """Offset from the initial angles, velocity and acceleration at time t [s], three arrays of shape (nj,)."""
        omega = 2 * math.pi * self.frequency
        angle = omega * t + self.phase
        sine, cosine = self.amplitude * np.sin(angle), self.amplitude * np.cos(angle)
        wave, rate, bend = sine.sum(1), (omega * cosine).sum(1), -(omega**2 * sine).sum(1)
        s = min(t / self.ramp, 1.0)
        r = s**3 * (10 - 15 * s + 6 * s**2)
        dr = 30 * s**2 * (1 - s) ** 2 / self.ramp
        ddr = 60 * s * (1 - s) * (1 - 2 * s) / self.ramp**2
        return r * wave, dr * wave + r * rate, ddr * wave + 2 * dr * rate + r * bend


@dataclass(frozen=True)
class Excitation:
    """Amplitude, speed and frequency limits of a random multisine motion.

    Attributes
    ----------
    travel : float
        Largest distance of a gripper from its start [m]; every arm is scaled to it by itself. Much more than the
        default, on two arms, lets the foam Y snap from one shape to another.
    speed : float
        Largest joint speed [rad/s]; an arm that would exceed it travels less.
    components : int
        Sines per joint, one in each of as many equal parts (in log frequency) of `band`, and as many that shake.
    band : (float, float)
        Lowest and highest frequency [Hz].
    ramp, duration : float
        [s]
    shake : float
        Root mean square of the torque that each joint's own inertia takes beside its travel [N m], in sines of equal
        torque of the band `shake_band`, none faster than `shake_speed`. Zero leaves torques as gentle as the travel.
    shake_band : (float, float)
        [Hz]; well below half the rate of what records the torque.
    shake_speed : float
        Largest velocity of one of these sines [rad/s]; what light wrists reach first.
    """

    travel: float = 0.11
    speed: float = 1.4
    components: int = 3
    band: tuple[float, float] = (0.2, 2.0)
    ramp: float = 1.0
    duration: float = 5.0
    shake: float = 0.0
    shake_band: tuple[float, float] = (4.0, 9.0)
    shake_speed: float = 0.15


def multisine(
    system: System,
    values: Mapping[str, float] | None = None,
    *,
    seed: int,
    posture: Mapping[str, float] | None = None,
    excitation: Excitation | None = None,
) -> Motion:
    """Draw a random multisine motion, scaled to the requested travel of the grippers.

    Parameters
    ----------
    system : System
    values : mapping of str to float, optional
        Parameter values; nominal where absent.
    seed : int
        Of the random draw of frequencies and phases.
    posture : mapping of str to float, optional
        Initial angles [rad or m]; `initial_posture` where absent.
    excitation : Excitation, optional

    Returns
    -------
    Motion
        Amplitudes fall in inverse proportion to the frequency and towards the base.
    """
    chosen = excitation or Excitation()
    rng = np.random.default_rng(seed)
    motion = _drawn(system, chosen, rng)
    times = np.linspace(0.0, chosen.duration, 251)
    start = initial_posture(system, values) if posture is None else posture
    tree = replace(system.mechanism, parameters=system.parameters).numeric(values)
    q0 = np.zeros(system.size)
    q0[[tree.joint_index(name) for name in start]] = list(start.values())
    holders = [tree.frame(grasp.holder) for grasp in system.grasps]
    arms = [[i for i, j in enumerate(system.driven_indices) if j in tree.ancestors(f.joint)] for f in holders]
    for arm in arms:  # the same angle near the base moves the hand further
        motion = _scaled(motion, arm, np.linspace(0.5, 1.0, len(arm)))
    q = ca.SX.sym("q", system.size)
    kinematics = forward_kinematics(tree, q)
    for frame, arm in zip(holders, arms, strict=True):
        tip = ca.Function("tip", [q], [kinematics.position(frame)]).map(len(times))
        waves = np.array([motion.at(t)[:2] for t in times])[:, :, arm]
        scale = _scale(chosen, tip, q0, [system.driven_indices[i] for i in arm], waves)
        motion = _scaled(motion, arm, np.full(len(arm), scale))
    if not holders:
        fastest = max(float(np.abs(motion.at(t)[1]).max()) for t in times)
        joints = range(len(motion.joints))
        motion = _scaled(motion, joints, np.full(len(joints), chosen.speed / fastest))
    if chosen.shake == 0.0:
        return motion
    rigid = rigid_body(kinematics, ca.SX(ca.DM.zeros(system.size)), ca.SX(ca.DM.zeros(3)))
    inertia = np.diag(np.array(ca.densify(ca.Function("M", [q], [mass_matrix(rigid, tree)])(q0))))
    return _shaken(motion, chosen, inertia[list(system.driven_indices)], rng)


def _scaled(motion: Motion, joints: Sequence[int], factors: Array) -> Motion:
    amplitude = motion.amplitude.copy()
    amplitude[list(joints)] *= factors[:, None]
    return replace(motion, amplitude=amplitude)


def _drawn(system: System, excitation: Excitation, rng: np.random.Generator) -> Motion:
    """Frequencies, phases and relative amplitudes at random."""
    nj, components = len(system.driven), excitation.components
    lowest, highest = excitation.band
    edges = np.linspace(math.log(lowest), math.log(highest), components + 1)
    frequency = np.exp(rng.uniform(edges[:-1], edges[1:], (nj, components)))
    phase = rng.uniform(0.0, 2 * math.pi, (nj, components))
    amplitude = rng.uniform(0.7, 1.3, (nj, components)) / frequency
    return Motion(system.driven, amplitude, frequency, phase, excitation.ramp)


def _shaken(motion: Motion, excitation: Excitation, inertia: Array, rng: np.random.Generator) -> Motion:
    """The motion with fast sines added; `inertia` of the driven joints, shape (nj,) [kg m^2]."""
    nj, components = motion.frequency.shape
    lowest, highest = excitation.shake_band
    edges = np.linspace(math.log(lowest), math.log(highest), components + 1)
    frequency = np.exp(rng.uniform(edges[:-1], edges[1:], (nj, components)))
    omega = 2 * math.pi * frequency
    torque = excitation.shake * math.sqrt(2.0 / components)
    amplitude = np.minimum(torque / (inertia[:, None] * omega**2), excitation.shake_speed / omega)
    phase = rng.uniform(0.0, 2 * math.pi, (nj, components))
    return replace(
        motion,
        amplitude=np.hstack([motion.amplitude, amplitude]),
        frequency=np.hstack([motion.frequency, frequency]),
        phase=np.hstack([motion.phase, phase]),
    )


def _scale(excitation: Excitation, tip: ca.Function, q0: Array, columns: Sequence[int], waves: Array) -> float:
    """Factor with which an arm's waves (N, 2, nj), offset and velocity, take the tip as far as wanted."""

    def distance(scale: float) -> float:
        path = np.tile(q0, (len(waves), 1))
        path[:, columns] += scale * waves[:, 0]
        positions = np.array(tip(path.T))
        return float(np.linalg.norm(positions - positions[:, :1], axis=0).max())

    low, high = 0.0, excitation.speed / float(np.abs(waves[:, 1]).max())
    if distance(high) > excitation.travel:
        for _ in range(40):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if distance(middle) < excitation.travel else (low, middle)
    return high

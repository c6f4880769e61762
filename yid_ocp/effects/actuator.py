"""Effects between a motor and its recorded signals: elastic gears, backlash, effort sensing errors, late torque.

Recorded torques drive the model and recorded angles prescribe or guide it, so that these effects reach a driven joint,
or the angle of a prescribed one, through `corrected_reading`; the effort that a prescribed joint needs is compared with
the recorded one through `measure`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import casadi as ca

from yid_ocp.effects.base import (
    EFFECTS,
    EffectBase,
    ParameterDefinition,
    force_on_joint,
    joints_by_arm,
    relative_effort_limit,
    robot_joints,
)
from yid_ocp.model.system import MidpointState, NodeState, StepTerms, System

_PLAY_TORQUE = 0.2
"""Torque at which three quarters of the backlash are taken up [N m]."""


@EFFECTS.register("series_elasticity")
class SeriesElasticity(EffectBase):
    """An elastic gear with the encoder on the motor's side: measured angle = q + effort/stiffness.

    The effort is the joint's own where the model knows it, else the recorded one.
    """

    equation = "measured angle = q + effort/stiffness"
    required_excitation = "how hard it pulls at its ends"
    required_sensors: ClassVar[frozenset[str]] = frozenset({"joints.position", "joints.effort"})

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of arm joints that are driven or prescribed."""
        return _recorded(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of the gear's compliance [rad/(N m)], reported as stiffness [N m/rad]."""
        text, reported = "compliance of the gear", "stiffness N m/rad"
        return (
            ParameterDefinition(
                "compliance", "rad/(N m)", 0.0, 0.0, 0.02, (1 / 2000, 1 / 100), text, reported_reciprocal=reported
            ),
        )

    def distorted_reading(self, channel: str, output: ca.SX, state: NodeState) -> ca.SX:
        """The encoder's reading: the joint angle plus the gear's deflection under the effort."""
        return output + self._give(channel, _effort(state, self.location))

    def corrected_reading(self, channel: str, reading: ca.SX, effort: ca.SX) -> ca.SX:
        """The joint angle: the encoder's reading minus the gear's deflection under the effort."""
        return reading - self._give(channel, effort)

    def _give(self, channel: str, effort: ca.SX) -> ca.SX:
        return self["compliance"] * effort if channel == f"joints.position.{self.location}" else ca.SX(0)


@EFFECTS.register("backlash")
class Backlash(EffectBase):
    """A gear with backlash, encoder on the motor's side: measured angle = q + width/2 tanh(effort/`_PLAY_TORQUE`).

    A servo acts on what its encoder reads: there the play z that is taken up solves z = width/2 tanh(torque(q + z)/
    `_PLAY_TORQUE`) in every step, an internal coordinate without a memory.
    """

    equation = "measured angle = q + width/2 tanh(effort/0.2 N m)"
    required_excitation = "how hard it pulls at its ends"
    required_sensors: ClassVar[frozenset[str]] = frozenset({"joints.position"})

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of arm joints that are driven or prescribed; of joints with a servo where there are none."""
        return _recorded(system) or tuple(name for name in robot_joints(system) if name in system.servos)

    @classmethod
    def internal_coordinate_names(cls, location: str, system: System) -> tuple[str, ...]:
        """`play`, the taken-up backlash, for a joint with a servo; none otherwise."""
        return ("play",) if location in system.servos else ()

    def step_terms(self, state: MidpointState) -> StepTerms:
        """The equation of the taken-up backlash and the servo torque change that it causes; nothing without a servo."""
        if not self.internal_coordinates:
            return StepTerms()
        [name] = self.internal_coordinates
        row, index = state.internal_rows[name], state.system.mechanism.joint_index(self.location)
        # its value after the step: a mean over the step would have it ring
        play = state.z[row] + state.h / 2 * state.z_rate[row]
        if self.location not in state.system.servos:  # the joint is held for a while, and nothing takes the play up
            return StepTerms(internal_equations={name: play})
        servo, command = state.system.servos[self.location], state.u[state.system.driven.index(self.location)]
        free, geared = (servo.torque(command, state.q[index] + give, state.v[index]) for give in (0, play))
        taken = play - self["width"] / 2 * ca.tanh(geared / _PLAY_TORQUE)
        return StepTerms(
            generalized_force=force_on_joint(state.system, self.location, geared - free),
            internal_equations={name: taken},
        )

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of the backlash width [rad]."""
        return (ParameterDefinition("width", "rad", 0.0, 0.0, 0.1, (0.0, 0.01), "play of the gear"),)

    def distorted_reading(self, channel: str, output: ca.SX, state: NodeState) -> ca.SX:
        """The encoder's reading: the joint angle plus the taken-up backlash."""
        for name in self.internal_coordinates if channel == f"joints.position.{self.location}" else ():
            return output + state.z[state.internal_rows[name]]
        return output + self._give(channel, _effort(state, self.location))

    def corrected_reading(self, channel: str, reading: ca.SX, effort: ca.SX) -> ca.SX:
        """The joint angle: the encoder's reading minus the taken-up backlash; unchanged for a joint with a servo."""
        # a servo's coordinate follows from the motion, and its command is of the motor's side
        return reading if self.internal_coordinates else reading - self._give(channel, effort)

    def _give(self, channel: str, effort: ca.SX) -> ca.SX:
        if channel != f"joints.position.{self.location}":
            return ca.SX(0)
        return self["width"] / 2 * ca.tanh(effort / _PLAY_TORQUE)


@EFFECTS.register("effort_gain")
class EffortGain(EffectBase):
    """Measured effort = scale x true effort; a negative scale is a flipped sign.

    Kept inside as 1/scale, by which a recorded torque is multiplied, so that a driven joint's may go through zero.
    """

    equation = "measured effort = scale x true"
    required_excitation = "how it stands against gravity"
    required_sensors: ClassVar[frozenset[str]] = frozenset({"joints.effort"})

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of arm joints that are driven or prescribed."""
        return _recorded(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of 1/scale [1], reported as scale."""
        text, expected = "true over measured effort", (1 / 1.2, 1 / 0.8)
        return (ParameterDefinition("inverse", "1", 1.0, -1.5, 3.0, expected, text, reported_reciprocal="scale 1"),)

    def alternative_start(self, start: Mapping[str, float]) -> Mapping[str, float] | None:
        """A start with the opposite sign of scale where the estimate of 1/scale is at least 1 away from 1; else None.

        Compared efforts are linear in scale, torques that drive in 1/scale: a flipped sign is two away either way.
        """
        [name] = self.parameters.names
        value = start.get(name, 1.0)
        if abs(value - 1) < 1:
            return None
        return {name: 1.0 if value < 0 else -1.0}

    def distorted_reading(self, channel: str, output: ca.SX, state: NodeState) -> ca.SX:
        """The recorded effort: the true effort times scale."""
        return output / self["inverse"] if channel == f"joints.effort.{self.location}" else output

    def corrected_reading(self, channel: str, reading: ca.SX, effort: ca.SX) -> ca.SX:
        """The true effort: the recorded effort divided by scale."""
        return reading * self["inverse"] if channel == f"joints.effort.{self.location}" else reading


@EFFECTS.register("effort_offset")
class EffortOffset(EffectBase):
    """Measured effort = true effort + offset."""

    equation = "measured effort = true + offset"
    required_excitation = "how it stands against gravity"
    required_sensors: ClassVar[frozenset[str]] = frozenset({"joints.effort"})

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of arm joints that are driven or prescribed."""
        return _recorded(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of the offset, measured minus true effort [N m]."""
        bound, width = (size * relative_effort_limit(system, location) for size in (10.0, 1.5))
        return (ParameterDefinition("offset", "N m", 0.0, -bound, bound, (-width, width), "measured less true effort"),)

    def distorted_reading(self, channel: str, output: ca.SX, state: NodeState) -> ca.SX:
        """The recorded effort: the true effort plus the offset."""
        return output + self["offset"] if channel == f"joints.effort.{self.location}" else output

    def corrected_reading(self, channel: str, reading: ca.SX, effort: ca.SX) -> ca.SX:
        """The true effort: the recorded effort minus the offset."""
        return reading - self["offset"] if channel == f"joints.effort.{self.location}" else reading


@EFFECTS.register("effort_delay")
class EffortDelay(EffectBase):
    """Torque acts late: what acts at t was recorded at t - delay, interpolated between samples.

    For a prescribed arm the recorded effort at t is what the motion needs at t + delay; a negative delay means that the
    effort is recorded late.
    """

    equation = "the torque that acts at t was recorded at t - delay"
    required_excitation = "when it is read"
    required_sensors: ClassVar[frozenset[str]] = frozenset({"joints.effort"})

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of arms with a driven or prescribed joint."""
        known = set(_recorded(system))
        return tuple(name for name, joints in joints_by_arm(system).items() if known & set(joints))

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of the delay from recorded to acting torque [s]."""
        return (ParameterDefinition("delay", "s", 0.0, -0.2, 0.2, (0.0, 0.1), "how late recorded torque acts"),)

    @classmethod
    def arm_joints_at_location(cls, location: str, system: System) -> tuple[str, ...]:
        """Names of the arm's joints."""
        return joints_by_arm(system)[location]

    def added_delay(self, channel: str, camera: bool) -> ca.SX:
        """The delay for torques that drive the arm's joints, its negative for their measured efforts, else zero [s]."""
        quantity, _, joint = channel.partition(".") if channel.startswith("torque.") else channel.rpartition(".")
        if joint not in self.arm_joints:
            return ca.SX(0)
        return {"torque": self["delay"], "joints.effort": -self["delay"]}.get(quantity, ca.SX(0))


@EFFECTS.register("effort_lag")
class EffortLag(EffectBase):
    """Torque follows its command: time_constant dz/dt = command - z, z the torque that acts.

    The recorded torque is the command, of a prescribed joint too: the effort that its motion needs follows the recorded
    one. A negative time constant there means that the recorded effort follows the one that is needed, as one behind a
    sensor's filter does. Before a recording begins both are what they are at its start.
    """

    equation = "time_constant dz/dt = command - z"
    required_excitation = "when it is read"
    required_sensors: ClassVar[frozenset[str]] = frozenset({"joints.effort"})

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of arm joints that are driven or prescribed."""
        return _recorded(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of time_constant [s]; negative values are allowed for prescribed joints."""
        text = "with which torque follows its command"
        least = -0.5 if location in system.prescribed else 0.0
        return (ParameterDefinition("time_constant", "s", 0.0, least, 0.5, (0.0, 0.05), text),)

    def lag_time_constant(self, channel: str) -> ca.SX:
        """The time constant for the joint's driving torque, its negative for its measured effort, else zero [s]."""
        quantity, _, joint = channel.rpartition(".")
        if joint != self.location:
            return ca.SX(0)
        return {"torque": self["time_constant"], "joints.effort": -self["time_constant"]}.get(quantity, ca.SX(0))


def _recorded(system: System) -> tuple[str, ...]:
    known = {*system.driven, *system.prescribed} - set(system.servos)
    return tuple(name for name in robot_joints(system) if name in known)


def _effort(state: NodeState, joint: str) -> ca.SX:
    return state.effort[state.system.mechanism.joint_index(joint)]

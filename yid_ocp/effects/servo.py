"""Position servos that deviate from their data sheet: gain, delay, torque limit."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import casadi as ca

from yid_ocp.effects.base import EFFECTS, EffectBase, ParameterDefinition, robot_joints
from yid_ocp.model.servos_and_springs import TORQUE_LIMIT_POWER, UNLIMITED_EFFORT, PositionServo
from yid_ocp.model.system import System

_POSITION_SENSOR = frozenset({"joints.position"})
_DEFAULT_EFFORT_LIMIT = 10.0
"""Assumed effort limit of a joint that has none [N m or N]."""
_MIN_LIMIT_FRACTION = 0.1
"""Smallest torque limit that is searched, as a fraction of the joint's effort limit."""


@EFFECTS.register("servo_gain")
class ServoGain(EffectBase):
    """A servo's demanded torque multiplied by scale: another gain, supply voltage or motor."""

    equation = "demand = scale (gain (u - q) - damping v)"
    required_excitation = "how hard it accelerates"
    required_sensors: ClassVar[frozenset[str]] = _POSITION_SENSOR

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of joints with a servo."""
        return _commanded(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of scale, true over nominal servo torque [1]."""
        return (
            ParameterDefinition("scale", "1", 1.0, 0.05, 20.0, (0.3, 3.0), "true over nominal torque of the servo"),
        )

    def apply_to_system(self, system: System) -> System:
        """The system with the servo's gain and damping multiplied by scale."""
        servo, scale = system.servos[self.location], self["scale"]
        return _with(system, self.location, replace(servo, gain=servo.gain * scale, damping=servo.damping * scale))


@EFFECTS.register("servo_delay")
class ServoDelay(EffectBase):
    """Commands act later than the nominal servo delay."""

    equation = "the command that acts at t was given at t - servo_delay - delay"
    required_excitation = "when it is read"
    required_sensors: ClassVar[frozenset[str]] = _POSITION_SENSOR

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of joints with a servo."""
        return _commanded(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of the delay in addition to the nominal servo delay [s]."""
        return (
            ParameterDefinition(
                "delay", "s", 0.0, -0.2, 0.5, (0.0, 0.2), "how late commands act beyond the servo's delay"
            ),
        )

    def added_delay(self, channel: str, camera: bool) -> ca.SX:
        """The added delay for the joint's command, zero for other channels [s]."""
        return self["delay"] if channel == f"torque.{self.location}" else ca.SX(0)


@EFFECTS.register("servo_saturation")
class ServoSaturation(EffectBase):
    """An additional torque limit of a servo: demand / (1 + |demand/limit|^16)^(1/16).

    Kept inside as limit^-16, which adds to the model's own limit, is neutral at zero and has a slope there: of the
    largest torques first. From a tenth beside the limit on it is within 1.2 % of a clip.
    """

    equation = "torque = demand / (1 + (demand/limit)^16)^(1/16)"
    required_excitation = "how hard it accelerates"
    required_sensors: ClassVar[frozenset[str]] = _POSITION_SENSOR

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of joints with a servo."""
        return _commanded(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of tightness = limit^-16, reported as limit, from `_MIN_LIMIT_FRACTION` of the effort limit."""
        joint = system.mechanism.joints[system.mechanism.joint_index(location)]
        known = joint.effort_limit if 0 < joint.effort_limit < UNLIMITED_EFFORT else _DEFAULT_EFFORT_LIMIT
        torque = "N m" if joint.coordinate_unit == "rad" else "N"
        highest, text = (
            (_MIN_LIMIT_FRACTION * known) ** -TORQUE_LIMIT_POWER,
            "largest torque of the servo, to the power -16",
        )
        reported = f"limit {torque}"
        return (
            ParameterDefinition(
                "tightness",
                f"({torque})^-16",
                0.0,
                0.0,
                highest,
                (0.0, highest),
                text,
                reported_reciprocal=reported,
                reciprocal_power=TORQUE_LIMIT_POWER,
            ),
        )

    def apply_to_system(self, system: System) -> System:
        """The system with the tighter torque limit of the servo."""
        servo = system.servos[self.location]
        return _with(
            system,
            self.location,
            replace(servo, torque_limit_tightness=servo.torque_limit_tightness + self["tightness"]),
        )


def _commanded(system: System) -> tuple[str, ...]:
    return tuple(name for name in robot_joints(system) if name in system.servos)


def _with(system: System, joint: str, servo: PositionServo) -> System:
    return replace(system, servos={**system.servos, joint: servo})

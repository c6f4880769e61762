"""Springs, dampers and position servos on the joints of a robot."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import casadi as ca

from yid_ocp.model.mechanism import Joint, Mechanism
from yid_ocp.model.parameters import Parameter
from yid_ocp.options import OptionInfo

CommandInterpolation = Literal["held", "interpolated"]
TORQUE_SATURATION_EXPONENT = 16
"""Exponent p of a servo's smooth torque limit, demand / (1 + |demand/limit|^p)^(1/p)."""
UNLIMITED_EFFORT_THRESHOLD = 2e4
"""Effort limits from this value on mean that there is none [N m or N]."""
_DEFAULT_FULL_TORQUE_ERROR = 0.05  # at which a servo of unknown gain reaches its torque limit [rad or m]
_DEFAULT_GAIN = 50.0  # of a servo without an effort limit [N m/rad or N/m]
_DEFAULT_DAMPING_TIME = 0.1  # a servo's damping over its gain [s]
_MAX_COMMAND_DELAY = 0.5  # [s]


@dataclass(frozen=True)
class RobotJointSpring:
    """A spring 1/2 stiffness (q - rest)^2 on one robot joint [N m/rad, rad; N/m, m for a prismatic joint]."""

    stiffness: float
    rest_position: float = 0.0


@dataclass(frozen=True)
class PositionServoOptions:
    """How position servos process commands; gains and limits are parameters such as JOINT.servo_gain."""

    command_interpolation: Annotated[
        CommandInterpolation,
        OptionInfo("what a servo follows between two commands: the last one held, or straight lines"),
    ] = "held"
    has_gravity_compensation: Annotated[
        bool, OptionInfo("whether the controller carries the robot's own weight, so that the servos need not")
    ] = False


@dataclass(frozen=True)
class PositionServo:
    """A position servo on one joint, whose input is the commanded coordinate u.

        demand = gain (u(t - delay) - q) - damping dq/dt       torque = demand / (1 + tightness demand^p)^(1/p)

    with p = `TORQUE_SATURATION_EXPONENT` and tightness = limit^-p, to which further limits add.

    Attributes
    ----------
    gain, damping, command_delay, torque_limit_tightness : casadi.SX
        [N m/rad or N/m], [N m s/rad or N s/m], [s], [(N m)^-p]
    """

    gain: ca.SX
    damping: ca.SX
    command_delay: ca.SX
    torque_limit_tightness: ca.SX
    command_interpolation: CommandInterpolation = "held"

    def torque(self, command: ca.SX, q: ca.SX, v: ca.SX) -> ca.SX:
        """The servo's torque for a command, a coordinate and its rate [N m or N]."""
        demand = self.gain * (command - q) - self.damping * v
        return demand / (1 + self.torque_limit_tightness * demand**TORQUE_SATURATION_EXPONENT) ** (
            1 / TORQUE_SATURATION_EXPONENT
        )

    @property
    def coefficients(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """Gain, damping, command delay and torque limit tightness (limit^-p)."""
        return self.gain, self.damping, self.command_delay, self.torque_limit_tightness


def joint_damping_parameters(tree: Mechanism, wanted: Mapping[str, float]) -> dict[str, Parameter]:
    """Parameters `JOINT.damping` of the named joints, by joint."""
    for joint in wanted:
        tree.joint_index(joint)
    return {
        joint: Parameter(f"{joint}.damping", value, "N m s/rad", 0.0, math.inf, f"viscous damping of {joint}")
        for joint, value in wanted.items()
    }


def joint_spring_parameters(tree: Mechanism, joint: str, spring: RobotJointSpring) -> tuple[Parameter, Parameter]:
    """Stiffness and rest position parameters of a spring on a robot joint."""
    unit = tree.joints[tree.joint_index(joint)].coordinate_unit
    per = "N m/rad" if unit == "rad" else "N/m"
    return (
        Parameter(f"{joint}.stiffness", spring.stiffness, per, 0.0, math.inf, f"spring on {joint}"),
        Parameter(f"{joint}.rest", spring.rest_position, unit, description=f"where the spring on {joint} is relaxed"),
    )


def build_joint_servos(
    tree: Mechanism, joints: Sequence[str], commands: CommandInterpolation = "held"
) -> tuple[dict[str, PositionServo], list[Parameter]]:
    """A servo on every named joint, and their parameters `JOINT.servo_gain`, `servo_damping`, ...

    Values are those of a servo that gives its joint's effort limit at an error of `_DEFAULT_FULL_TORQUE_ERROR`.
    """
    servos, entries = {}, []
    for joint in joints:
        at = tree.joints[tree.joint_index(joint)]
        own = _servo_parameters(at)
        gain, damping, delay, limit = (entry.symbol for entry in own)
        servos[joint] = PositionServo(gain, damping, delay, limit**-TORQUE_SATURATION_EXPONENT, commands)
        entries += own
    return servos, entries


def _servo_parameters(joint: Joint) -> list[Parameter]:
    known = 0 < joint.effort_limit < UNLIMITED_EFFORT_THRESHOLD
    limit = joint.effort_limit if known else UNLIMITED_EFFORT_THRESHOLD
    gain = limit / _DEFAULT_FULL_TORQUE_ERROR if known else _DEFAULT_GAIN
    torque, per = ("N m", "N m/rad") if joint.coordinate_unit == "rad" else ("N", "N/m")
    rate = per.replace("/", " s/")
    rows: tuple[tuple[str, float, str, float, float, str], ...] = (
        ("gain", gain, per, 0.0, math.inf, "torque per error of the angle"),
        ("damping", _DEFAULT_DAMPING_TIME * gain, rate, 0.0, math.inf, "torque against the rate"),
        ("delay", 0.0, "s", 0.0, _MAX_COMMAND_DELAY, "from a command to its torque"),
        ("torque_limit", limit, torque, 1e-3, math.inf, "largest torque"),
    )
    return [
        Parameter(f"{joint.name}.servo_{name}", value, unit, lower, upper, f"{text}, servo of {joint.name}")
        for name, value, unit, lower, upper, text in rows
    ]


def without_gravity(tree: Mechanism) -> Mechanism:
    """The robot without gravity on its bodies, as when its controller compensates its own weight."""
    joints = tuple(
        replace(joint, bodies=tuple(replace(body, gravity_fraction=ca.SX(0)) for body in joint.bodies))
        for joint in tree.joints
    )
    return replace(tree, joints=joints)

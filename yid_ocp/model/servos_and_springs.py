"""Springs, dampers and position servos at the joints of a robot."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import casadi as ca

from yid_ocp.errors import ConfigError
from yid_ocp.model.mechanism import Joint, Mechanism
from yid_ocp.model.parameters import Parameter
from yid_ocp.options import OptionInfo

_CommandInterpolation = Literal["held", "interpolated"]
TORQUE_SATURATION_EXPONENT = 16  # p of a servo's smooth torque limit, demand / (1 + |demand/limit|^p)^(1/p)
UNLIMITED_EFFORT_THRESHOLD = 2e4  # larger effort limits mean that there is no limit [N m or N]
_DEFAULT_FULL_TORQUE_ERROR = 0.05  # error at which a servo of unknown gain reaches its torque limit [rad or m]
_DEFAULT_GAIN = 50.0  # of a servo without an effort limit [N m/rad or N/m]
_DEFAULT_DAMPING_TIME = 0.1  # a servo's damping over its gain [s]
_MAX_COMMAND_DELAY = 0.5  # [s]
_MAX_DEAD_BAND = 0.2  # [rad or m]
MOTOR_OFF_COMMAND = 1e6  # input of a servo whose motor is off; from half of it on there is no torque [rad or m]
_DEAD_BAND_ROUNDING = 1e-4  # smoothing range at the ends of a servo's dead band [rad or m]
# parameter by which a recording states the proportional gain of a firmware
JOINT_SERVO_GAIN_FACTOR_PARAMETER_SUFFIX = "servo_gain_factor"

_MotorKind = Literal["ideal", "dc"]
_MotorPreset = Literal["xl330", "xl320", "mx64", "mx106", "sts3215"]
_FirmwareTerm = Literal["integral", "derivative", "dead_band"]


@dataclass(frozen=True)
class _MotorFrictionData:
    """Motor and friction constants that were identified together for one friction law, and are valid for this only."""

    torque_constant: float  # kt [N m/A]
    resistance: float  # R [ohm]
    coulomb: float  # [N m]
    viscous: float  # [N m s/rad]
    load_share: float = 0.0  # friction per torque through the gear; zero if the law has no such term
    stribeck: float = 0.0  # friction at low speed [N m]
    stribeck_speed: float = 0.0  # speed beyond which it vanishes [rad/s]


@dataclass(frozen=True)
class _DcMotorData:
    """Published data of a geared DC servo, used as initial values.

    From Duclusaud et al. (2024), Extended friction models for the physics simulation of servo actuators,
    arXiv:2410.08650, and the data published with it (Rhoban/bam, Apache-2.0).
    """

    supply_voltage: float  # [V]
    duty_per_gain: float  # duty per unit of the firmware's proportional gain and per error of the angle [1/rad]
    duty_limit: float  # largest duty [-]
    armature: float  # inertia of rotor and gear at the output shaft [kg m^2]
    plain: _MotorFrictionData  # constants with Coulomb and viscous friction
    load_dependent: _MotorFrictionData | None = None  # constants with load-dependent friction, if published

    def servo_values(self, constants: _MotorFrictionData) -> dict[str, float]:
        """Servo parameters by name, from torque = kt/R (duty V - kt speed) [N m/rad, N m s/rad, N m]."""
        stall = constants.torque_constant * self.supply_voltage / constants.resistance
        drag = constants.torque_constant**2 / constants.resistance
        gain, limit = self.duty_per_gain * stall, self.duty_limit * stall
        return {"servo_gain": gain, "servo_damping": drag, "servo_torque_limit": limit}


def _as_motor_data(found: dict[str, Any]) -> Any:
    return _DcMotorData(**found) if "plain" in found else _MotorFrictionData(**found) if "coulomb" in found else found


_PRESETS_FILE = Path(__file__).with_name("motor_presets.json")
MOTOR_PRESETS: Mapping[_MotorPreset, _DcMotorData] = json.loads(_PRESETS_FILE.read_text(), object_hook=_as_motor_data)
"""Motors of desk-top arms by preset name; `STS3215` at 7.4 V."""


@dataclass(frozen=True)
class MotorKindAndPreset:
    """The settings of a servo's motor. The kind is `ideal` or `dc`; a preset holds published data of a dc motor."""

    kind: Annotated[
        _MotorKind,
        OptionInfo(
            "ideal: torque = clip(gain * error - damping * speed); dc: torque = clip(gain * error) - damping * speed: "
            "the duty cycle limits the first term, and the back-EMF is the damping. If recordings state the gain of "
            "the firmware (`proportional_gain`), gain is per unit of it. See dc_motor.md"
        ),
    ] = "ideal"
    preset: Annotated[_MotorPreset | None, OptionInfo("dc motor with published initial values and priors")] = None

    def __post_init__(self) -> None:
        if self.preset is not None and self.kind != "dc":
            what = f"the preset '{self.preset}' is for a dc motor, but the motor has kind: {self.kind}"
            hint = "set model.arms.servo.motor.kind: dc, or leave the preset out"
            raise ConfigError(what, where="model.arms.servo.motor.preset", allowed="preset with kind: dc", hint=hint)


@dataclass(frozen=True)
class StiffnessAndRest:
    """A spring on a robot joint, with its stiffness [N m/rad or N/m] and rest position [rad or m]."""

    stiffness: float
    rest_position: float = 0.0


@dataclass(frozen=True)
class ServoModelOptions:
    """The model settings that all position servos share. Their gains are parameters, not settings."""

    command_interpolation: Annotated[
        _CommandInterpolation,
        OptionInfo("input between two commands: the last command is held, or interpolation is linear"),
    ] = "held"
    has_gravity_compensation: Annotated[
        bool, OptionInfo("whether the controller compensates the robot's weight, so that the servos need not")
    ] = False
    motor: Annotated[MotorKindAndPreset, OptionInfo("motor of every servo")] = MotorKindAndPreset()
    extra_controller_terms: Annotated[
        tuple[_FirmwareTerm, ...],
        OptionInfo(
            "further terms of the firmware, with parameters that start at zero: integral (JOINT.servo_integral: time "
            "integral of the error from the start of the recording), derivative (JOINT.servo_derivative, kind dc: a "
            "damping inside clip; JOINT.servo_damping is outside), dead_band (JOINT.servo_dead_band: smaller errors "
            "are ignored); see dc_motor.md"
        ),
    ] = ()

    def __post_init__(self) -> None:
        if "derivative" in self.extra_controller_terms and self.motor.kind == "ideal":
            what = "an ideal motor has a derivative term (JOINT.servo_damping), so `derivative` cannot be added"
            hint = "leave derivative out, or set model.arms.servo.motor.kind: dc"
            where = "model.arms.servo.extra_controller_terms"
            raise ConfigError(what, where=where, allowed="derivative only with kind: dc", hint=hint)


@dataclass(frozen=True)
class PositionServo:
    """A position servo on one joint, which converts the commanded coordinate u into a torque.

        ideal:  torque = clip(gain (e + integral z) - damping dq/dt)
        dc:     torque = clip(gain (e + integral z) - derivative dq/dt) - damping dq/dt

    with the error e = u(t - delay) - q beyond the dead band, dz/dt = e, clip(x) = x / (1 + tightness x^p)^(1/p) and p =
    `TORQUE_SATURATION_EXPONENT`. The tightness is limit^-p, summed over all limits. For a DC motor the duty cycle is
    limited, and the damping is the back-EMF (torque = kt/R (duty V - kt dq/dt), with torque constant kt, resistance R
    and voltage V). `current_limit_tightness` clips the resulting torque. At `MOTOR_OFF_COMMAND` the torque is zero.
    """

    gain: ca.SX  # includes the firmware's gain if known [N m/rad or N/m]
    damping: ca.SX  # [N m s/rad or N s/m]
    command_delay: ca.SX  # [s]
    torque_limit_tightness: ca.SX  # [(N m)^-p]
    command_interpolation: _CommandInterpolation = "held"
    motor_kind: _MotorKind = "ideal"
    integral: ca.SX = field(default_factory=lambda: ca.SX(0))  # [1/s], in a system times z [rad or m]
    derivative: ca.SX = field(default_factory=lambda: ca.SX(0))  # derivative gain of a dc motor's firmware [N m s/rad]
    dead_band: ca.SX = field(default_factory=lambda: ca.SX(0))  # half width [rad or m]
    current_limit_tightness: ca.SX = field(default_factory=lambda: ca.SX(0))  # [A^-p]
    torque_constant: float | None = None  # published one of a dc motor [N m/A]

    def torque(self, command: ca.SX, q: ca.SX, v: ca.SX) -> ca.SX:
        """Compute the servo torque [N m] or force [N] from the commanded coordinate, coordinate q and rate v."""
        on = command < MOTOR_OFF_COMMAND / 2
        error, drag = self.position_error_beyond_dead_band(command, q), self.damping * v
        error = error if self.integral.is_zero() else error + self.integral
        if self.motor_kind == "ideal":
            return ca.if_else(on, _clipped(self.gain * error - drag, self.torque_limit_tightness), 0)
        torque = _clipped(self.gain * error - self.derivative * v, self.torque_limit_tightness) - drag
        if self.torque_constant is not None and not self.current_limit_tightness.is_zero():
            torque = self.torque_constant * _clipped(torque / self.torque_constant, self.current_limit_tightness)
        return ca.if_else(on, torque, 0)

    def position_error_beyond_dead_band(self, command: ca.SX, q: ca.SX) -> ca.SX:
        """Return the position error beyond the dead band [rad or m]. It is zero while the motor is off."""
        error = ca.if_else(command < MOTOR_OFF_COMMAND / 2, command, q) - q
        if self.dead_band.is_zero():
            return error
        near, far = (ca.sqrt((error + w) ** 2 + _DEAD_BAND_ROUNDING**2) for w in (-self.dead_band, self.dead_band))
        return error + (near - far) / 2


def _clipped(x: ca.SX, tightness: ca.SX) -> ca.SX:
    p = TORQUE_SATURATION_EXPONENT
    return x / (1 + tightness * x**p) ** (1 / p)


def stiffness_and_rest_parameters(tree: Mechanism, joint: str, spring: StiffnessAndRest) -> tuple[Parameter, Parameter]:
    """Make the parameters `JOINT.stiffness` and `JOINT.rest` for the spring of a robot joint."""
    unit, rest = tree.joint(joint).unit, f"where the spring on {joint} is relaxed"
    return (
        Parameter(f"{joint}.stiffness", spring.stiffness, unit("N m/rad"), 0.0, math.inf, f"stiffness of {joint}"),
        Parameter(f"{joint}.rest", spring.rest_position, unit("rad"), description=rest),
    )


def build_joint_servos(
    tree: Mechanism, joints: Sequence[str], options: ServoModelOptions
) -> tuple[dict[str, PositionServo], list[Parameter]]:
    """Build a servo for every named joint. Returns the servos and their parameters, such as `JOINT.servo_gain`.

    With the initial gain, an error of `_DEFAULT_FULL_TORQUE_ERROR` requests the joint's effort limit. For a DC motor,
    `JOINT.servo_gain_factor` multiplies the gain; recordings may state this factor, the gain set in the firmware.
    """
    servos, entries = {}, []
    for joint in joints:
        at = tree.joint(joint)
        own = _servo_parameters(at)
        gain, damping, delay, limit = (entry.symbol for entry in own)
        if options.motor.kind == "dc":
            words = f"the firmware's proportional gain, servo of {joint}"
            own.append(Parameter(f"{joint}.{JOINT_SERVO_GAIN_FACTOR_PARAMETER_SUFFIX}", 1.0, "1", 0.0, math.inf, words))
            gain = gain * own[-1].symbol
        tightness = limit**-TORQUE_SATURATION_EXPONENT
        further = _firmware_parameters(at, options.extra_controller_terms)
        preset = None if options.motor.preset is None else MOTOR_PRESETS[options.motor.preset]
        more: dict[str, Any] = {term: parameter.symbol for term, parameter in further.items()}
        more["torque_constant"] = None if preset is None else preset.plain.torque_constant
        how = options.command_interpolation, options.motor.kind
        servos[joint] = PositionServo(gain, damping, delay, tightness, *how, **more)
        entries += [*own, *further.values()]
    return servos, entries


def _servo_parameters(joint: Joint) -> list[Parameter]:
    known = 0 < joint.effort_limit < UNLIMITED_EFFORT_THRESHOLD
    limit = joint.effort_limit if known else UNLIMITED_EFFORT_THRESHOLD
    gain = limit / _DEFAULT_FULL_TORQUE_ERROR if known else _DEFAULT_GAIN
    rows: tuple[tuple[str, float, str, float, float, str], ...] = (
        ("gain", gain, joint.unit("N m/rad"), 0.0, math.inf, "torque per error of the angle"),
        ("damping", _DEFAULT_DAMPING_TIME * gain, joint.unit("N m s/rad"), 0.0, math.inf, "damping of the motion"),
        ("delay", 0.0, "s", 0.0, _MAX_COMMAND_DELAY, "delay from a command to its torque"),
        ("torque_limit", limit, joint.unit("N m"), 1e-3, math.inf, "largest torque"),
    )
    return [
        Parameter(f"{joint.name}.servo_{name}", value, unit, lower, upper, f"{text}, servo of {joint.name}")
        for name, value, unit, lower, upper, text in rows
    ]


def _firmware_parameters(joint: Joint, terms: Sequence[_FirmwareTerm]) -> dict[_FirmwareTerm, Parameter]:
    words = f"servo of {joint.name}"
    known = {
        "integral": ("1/s", 0.0, math.inf, f"integral over proportional gain, {words}"),
        "derivative": (joint.unit("N m s/rad"), 0.0, math.inf, f"damping within the limit of the duty cycle, {words}"),
        "dead_band": (joint.unit("rad"), 0.0, _MAX_DEAD_BAND, f"error that is ignored, {words}"),
    }
    return {term: Parameter(f"{joint.name}.servo_{term}", 0.0, *known[term]) for term in dict.fromkeys(terms)}

"""Effects between a motor and its recorded signals, such as backlash, encoder offsets and delays.

`true_value_from_reading` corrects the recorded inputs of the model (torques and angles of driven joints, angles of
prescribed joints). `reading_from_true_value` predicts the recorded efforts of prescribed joints.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import casadi as ca

from yid_ocp.effects import base
from yid_ocp.effects.base import EFFECTS, EffectBase, ParameterDefinition
from yid_ocp.model.servos_and_springs import TORQUE_SATURATION_EXPONENT, UNLIMITED_EFFORT_THRESHOLD, PositionServo
from yid_ocp.model.system import EffectStepTerms, MidpointStateSymbols, NodeStateSymbols, System

_PLAY_TORQUE = 0.2  # torque at which tanh reaches three quarters [N m]
_DEFAULT_EFFORT_LIMIT = 10.0  # for a joint without an effort limit [N m or N]
_MIN_LIMIT_FRACTION = 0.1  # smallest torque limit of the search, over the joint's effort limit
_MIN_LIMIT_CURRENT = 0.1  # smallest current limit of the search [A]


def _recorded_joints(system: System) -> tuple[str, ...]:
    return tuple(name for name in base.arm_joint_names(system) if name in (*system.driven, *system.prescribed))


def _effort_joints(system: System) -> tuple[str, ...]:
    return tuple(name for name in _recorded_joints(system) if name not in system.servos)


def _dc_motor_joints(system: System) -> tuple[str, ...]:
    return tuple(name for name in base.servo_joint_names(system) if system.servos[name].motor_kind == "dc")


def _limit_definition(lowest: float, unit: str, text: str) -> ParameterDefinition:
    """Definition of the parameter `tightness` = limit^-16. Reports show the limit, at least `lowest`, in `unit`."""
    highest, inverse = lowest**-TORQUE_SATURATION_EXPONENT, f"({unit})^-16"
    words = f"{text}, to the power -16"
    tightness = ParameterDefinition("tightness", inverse, 0.0, 0.0, highest, (0.0, highest), words)
    return replace(tightness, reported_reciprocal=f"limit {unit}", reciprocal_power=TORQUE_SATURATION_EXPONENT)


def _effort_arms(system: System) -> tuple[str, ...]:
    known = set(_effort_joints(system))
    return tuple(name for name, joints in base.joint_names_by_arm(system).items() if known & set(joints))


class _DistortedReading(EffectBase):
    """The base class of additive errors of one joint's recorded angle or effort."""

    quantity: ClassVar[str] = "joints.position"
    required_sensors = frozenset({"joints.position"})
    possible_locations = _effort_joints

    def _error(self, effort: ca.SX) -> ca.SX:
        """Measured minus true value, as a function of the joint's effort (modelled if available, else recorded)."""
        raise NotImplementedError

    def _is_own(self, channel: str) -> bool:
        return channel == f"{self.quantity}.{self.location}"

    def reading_from_true_value(self, channel: str, output: ca.SX, state: NodeStateSymbols) -> ca.SX:
        if not self._is_own(channel):
            return output
        return output + self._error(state.load[state.system.mechanism.joint_index(self.location)])

    def true_value_from_reading(self, channel: str, reading: ca.SX, effort: ca.SX) -> ca.SX:
        return reading - self._error(effort) if self._is_own(channel) else reading


@EFFECTS.register("encoder_offset")
class _EncoderOffset(_DistortedReading):
    """Constant offset of a joint's measured angle. Prescribed, initial and tracked angles are corrected for it."""

    equation = "measured angle = true + offset"
    required_excitation = "the orientation to gravity"
    moves_prescribed_joint = True
    possible_locations = _recorded_joints
    declared_parameters = (ParameterDefinition("offset", "rad", 0.0, -0.3, 0.3, (-0.035, 0.035), "measured - true"),)

    def _error(self, effort: ca.SX) -> ca.SX:
        return self["offset"]


@EFFECTS.register("series_elasticity")
class _SeriesElasticity(_DistortedReading):
    """Elastic gear with the encoder on the motor side. At joint angle q, the measured angle is q + effort/stiffness."""

    equation = "measured angle = q + effort/stiffness"
    required_excitation = "the force at its ends"
    required_sensors = frozenset({"joints.position", "joints.effort"})
    declared_parameters = (base.compliance_parameter_definition("rad/(N m)", 0.02, (5e-4, 0.01), "gear", "N m/rad"),)

    def _error(self, effort: ca.SX) -> ca.SX:
        return self["compliance"] * effort


@EFFECTS.register("backlash")
class _Backlash(_DistortedReading):
    """The backlash of a gear with its encoder on the motor side, so that the measured angle depends on the effort.

    A position servo controls the measured angle, so its torque depends on the play z between motor and joint. For a
    joint with a servo, z is an internal coordinate without memory: z = width/2 tanh(torque(q + z)/`_PLAY_TORQUE`).
    """

    equation = "measured angle = q + width/2 tanh(effort/0.2 N m)"
    required_excitation = "the force at its ends"
    possible_locations = lambda system: _effort_joints(system) or base.servo_joint_names(system)
    declared_parameters = (ParameterDefinition("width", "rad", 0.0, 0.0, 0.1, (0.0, 0.01), "play of the gear"),)

    @classmethod
    def internal_coordinate_names(cls, location: str, system: System) -> tuple[str, ...]:
        """Return the name `play` (current backlash) for a joint with a servo, and no name for other joints."""
        return ("play",) if location in system.servos else ()

    def step_terms(self, state: MidpointStateSymbols) -> EffectStepTerms:
        if not self.internal_coordinate_symbols:
            return EffectStepTerms()
        [name] = self.internal_coordinate_symbols
        row, index = state.internal_rows[name], state.system.mechanism.joint_index(self.location)
        # value after the step, because a mean over the step would oscillate
        play = state.z[row] + state.h / 2 * state.z_rate[row]
        if self.location not in state.system.servos:  # the joint is held for a while, and nothing takes the play up
            return EffectStepTerms(internal_equations={name: play})
        servo, command = state.system.servos[self.location], state.u[state.system.driven.index(self.location)]
        free, geared = (servo.torque(command, state.q[index] + give, state.v[index]) for give in (0, play))
        taken = play - self["width"] / 2 * ca.tanh(geared / _PLAY_TORQUE)
        force = base.one_joint_generalized_force(state.system, self.location, geared - free)
        return EffectStepTerms(generalized_force=force, internal_equations={name: taken})

    def _error(self, effort: ca.SX) -> ca.SX:
        return self["width"] / 2 * ca.tanh(effort / _PLAY_TORQUE)

    def reading_from_true_value(self, channel: str, output: ca.SX, state: NodeStateSymbols) -> ca.SX:
        for name in self.internal_coordinate_symbols if self._is_own(channel) else ():
            return output + state.z[state.internal_rows[name]]
        return super().reading_from_true_value(channel, output, state)

    def true_value_from_reading(self, channel: str, reading: ca.SX, effort: ca.SX) -> ca.SX:
        # a servo's joint angle is not an input, and its command refers to the motor side
        true = super().true_value_from_reading(channel, reading, effort)
        return reading if self.internal_coordinate_symbols else true


class _DistortedEffort(_DistortedReading):
    """The base class of errors of one joint's recorded effort."""

    quantity = "joints.effort"
    required_excitation = "the orientation to gravity"
    required_sensors = frozenset({"joints.effort"})


@EFFECTS.register("effort_gain")
class _EffortGain(_DistortedEffort):
    """Scale error of a joint's effort: measured effort = scale x true effort. A negative scale is a flipped sign.

    The internal parameter is 1/scale. It multiplies the recorded torque of a driven joint and may pass through zero.
    """

    equation = "measured effort = scale x true"
    declared_parameters = (
        replace(
            ParameterDefinition("inverse", "1", 1.0, -1.5, 3.0, (1 / 1.2, 1 / 0.8), "true effort over measured effort"),
            reported_reciprocal="scale 1",
        ),
    )

    def alternative_start(self, start: Mapping[str, float]) -> Mapping[str, float] | None:
        # efforts are linear in scale, driving torques in 1/scale: in both cases a flipped sign is a distance of two
        [name] = self.parameters.names
        value = start.get(name, 1.0)
        return None if abs(value - 1) < 1 else {name: 1.0 if value < 0 else -1.0}

    def reading_from_true_value(self, channel: str, output: ca.SX, state: NodeStateSymbols) -> ca.SX:
        return output / self["inverse"] if self._is_own(channel) else output

    def true_value_from_reading(self, channel: str, reading: ca.SX, effort: ca.SX) -> ca.SX:
        return reading * self["inverse"] if self._is_own(channel) else reading


@EFFECTS.register("effort_offset")
class _EffortOffset(_DistortedEffort):
    """Constant offset of a joint's recorded effort."""

    equation = "measured effort = true + offset"
    declared_parameters = (
        replace(
            ParameterDefinition("offset", "N m", 0.0, -10.0, 10.0, (-1.5, 1.5), "measured minus true effort"),
            range_scale=base.effort_limit_ratio_to_baxter,
        ),
    )

    def _error(self, effort: ca.SX) -> ca.SX:
        return self["offset"]


class _LateTorque(EffectBase):
    """The base class of torques that act later than recorded. At a prescribed joint, the recorded effort is early."""

    required_excitation = "the rate of its readings"
    required_sensors = frozenset({"joints.effort"})

    def _lateness(self, channel: str, joints: tuple[str, ...], size: ca.SX) -> ca.SX:
        """`size` if the channel is a driving torque of the joints, -`size` if it is their recorded effort, else 0."""
        signs = {f"{name}.{joint}": sign for name, sign in (("torque", 1), ("joints.effort", -1)) for joint in joints}
        return signs.get(channel, 0) * size


@EFFECTS.register("effort_delay")
class _EffortDelay(_LateTorque):
    """Delay of an arm's torques: the torque that acts at time t was recorded at t - delay.

    At prescribed joints, the effort recorded at t belongs to the motion at t + delay (negative if recorded late).
    """

    equation = "the torque that acts at t was recorded at t - delay"
    possible_locations = _effort_arms
    declared_parameters = (ParameterDefinition("delay", "s", 0.0, -0.2, 0.2, (0.0, 0.1), "delay of the torque"),)

    def added_channel_delay(self, channel: str, camera: bool) -> ca.SX:
        return self._lateness(channel, self.arm_joints, self["delay"])


@EFFECTS.register("effort_lag")
class _EffortLag(_LateTorque):
    """First-order lag of a joint's torque z behind its command: time_constant dz/dt = command - z.

    At a driven joint, the recorded torque is the command and the applied torque lags behind it. At a prescribed joint,
    the torque that the motion requires lags behind the recorded torque. A negative time constant, allowed only at
    prescribed joints, means that the recorded torque lags, as with a filtered sensor. Before node 0 both are constant.
    """

    equation = "time_constant dz/dt = command - z"
    possible_locations = _effort_joints

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of the parameter `time_constant` [s]. Only prescribed joints allow negative values."""
        least, text = -0.5 if location in system.prescribed else 0.0, "time constant of torque after command"
        return (ParameterDefinition("time_constant", "s", 0.0, least, 0.5, (0.0, 0.05), text),)

    def channel_lag_time_constant(self, channel: str) -> ca.SX:
        return self._lateness(channel, (self.location,), self["time_constant"])


class _ServoChange(EffectBase):
    """The base class of differences between a position servo and its nominal model."""

    required_excitation = "the acceleration"
    required_sensors = frozenset({"joints.position"})
    possible_locations = base.servo_joint_names

    def _changes(self, servo: PositionServo) -> dict[str, Any]:
        return {}

    def apply_to_system(self, system: System) -> System:
        servo = system.servos[self.location]
        return replace(system, servos={**system.servos, self.location: replace(servo, **self._changes(servo))})


@EFFECTS.register("servo_gain")
class _ServoGain(_ServoChange):
    """Scale factor on a servo's gain and, for an ideal motor, on its damping. Gain, voltage or motor are different."""

    equation = "demand = scale (gain (u - q) - damping v)"
    declared_parameters = (
        ParameterDefinition("scale", "1", 1.0, 0.05, 20.0, (0.3, 3.0), "true torque of the servo over the nominal one"),
    )

    def _changes(self, servo: PositionServo) -> dict[str, Any]:
        changed = {"gain": servo.gain * self["scale"]}
        # back-EMF depends on the motor, not on the gain
        return changed if servo.motor_kind == "dc" else changed | {"damping": servo.damping * self["scale"]}


@EFFECTS.register("supply_voltage")
class _SupplyVoltage(_ServoChange):
    """Scale factor on a DC motor's supply voltage. It scales the torque per duty cycle and the torque limit."""

    equation = "torque = clip(scale gain (u - q), scale limit) - damping v"
    possible_locations = _dc_motor_joints
    declared_parameters = (ParameterDefinition("scale", "1", 1.0, 0.2, 5.0, (0.5, 1.5), "true/nominal voltage"),)

    def _changes(self, servo: PositionServo) -> dict[str, Any]:
        tightness = servo.torque_limit_tightness * self["scale"] ** -TORQUE_SATURATION_EXPONENT
        scaled = {name: getattr(servo, name) * self["scale"] for name in ("gain", "derivative")}
        return scaled | {"torque_limit_tightness": tightness}


@EFFECTS.register("back_emf")
class _BackEmf(_ServoChange):
    """Scale factor on a DC motor's back-EMF damping kt^2/R, its braking torque per speed."""

    equation = "torque = clip(gain (u - q)) - scale damping v"
    required_excitation = "the speed"
    possible_locations = _dc_motor_joints
    declared_parameters = (
        ParameterDefinition("scale", "1", 1.0, 0.0, 20.0, (0.0, 3.0), "true torque per speed over the nominal one"),
    )

    def _changes(self, servo: PositionServo) -> dict[str, Any]:
        return {"damping": servo.damping * self["scale"]}


@EFFECTS.register("current_limit")
class _CurrentLimit(_ServoChange):
    """Current limit of a DC motor, where current = motor torque / published torque constant kt.

    Unlike the duty limit, it also limits braking torque. The internal parameter is limit^-16; zero means no limit.
    """

    equation = "torque = kt clip(torque/kt, limit)"
    possible_locations = lambda system: tuple(j for j in _dc_motor_joints(system) if system.servos[j].torque_constant)
    declared_parameters = (_limit_definition(_MIN_LIMIT_CURRENT, "A", "largest current"),)

    def _changes(self, servo: PositionServo) -> dict[str, Any]:
        return {"current_limit_tightness": servo.current_limit_tightness + self["tightness"]}


@EFFECTS.register("servo_delay")
class _ServoDelay(_ServoChange):
    """Delay of a servo's commands, added to its nominal delay."""

    equation = "the command that acts at t was given at t - servo_delay - delay"
    required_excitation = "the rate of its readings"
    declared_parameters = (ParameterDefinition("delay", "s", 0.0, -0.2, 0.5, (0.0, 0.2), "delay beyond servo_delay"),)

    def added_channel_delay(self, channel: str, camera: bool) -> ca.SX:
        return self["delay"] if channel == f"torque.{self.location}" else ca.SX(0)


@EFFECTS.register("servo_saturation")
class _ServoSaturation(_ServoChange):
    """Additional smooth torque limit of a servo, with torque = demand / (1 + |demand/limit|^16)^(1/16).

    The internal parameter, limit^-16, is added to that of the model. Zero means no further limit.
    """

    equation = "torque = demand / (1 + (demand/limit)^16)^(1/16)"

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of limit^-16. Reports show `limit`, at least `_MIN_LIMIT_FRACTION` x effort limit of the joint."""
        joint = system.mechanism.joint(location)
        known = joint.effort_limit if 0 < joint.effort_limit < UNLIMITED_EFFORT_THRESHOLD else _DEFAULT_EFFORT_LIMIT
        return (_limit_definition(_MIN_LIMIT_FRACTION * known, joint.unit("N m"), "largest torque of the servo"),)

    def _changes(self, servo: PositionServo) -> dict[str, Any]:
        return {"torque_limit_tightness": servo.torque_limit_tightness + self["tightness"]}

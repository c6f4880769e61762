"""Effects of friction and springs in the joints of arms."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import casadi as ca

from yid_ocp.effects import base
from yid_ocp.effects.base import EFFECTS, EffectBase, ParameterDefinition, effort_scaled_parameter_definition
from yid_ocp.model.system import Effect, EffectStepTerms, MidpointStateSymbols, System

SIGN_SMOOTHING_SPEED = 0.02  # v_s in sgn(v) = tanh(v/v_s) [rad/s]
TORQUE_DRIVEN_SIGN_SMOOTHING_SPEED = 1e-3
"""v_s of joints driven by torques [rad/s]. With a larger v_s they would creep by mm before they break loose."""
_LOAD_SIGN_SMOOTHING_SPEED = 0.005  # for load-dependent friction, which must hold its load at rest [rad/s]
_SMOOTHING_TORQUE = 1e-3  # smoothing range of |torque| [N m]
_ABS_SMOOTHING_ANGLE = 1e-7  # smoothing range of |d| in Dahl's law, angle per step [rad]
_SERIES_MAX_ANGLE_RATIO = 1e-2  # step angle over yield angle; below it a series replaces the exponential

FrictionLawName = Literal["viscous", "coulomb", "stribeck", "presliding", "load", "load_stribeck"]
EFFECT_KINDS_BY_FRICTION_LAW: Mapping[FrictionLawName, tuple[str, ...]] = {
    "viscous": (),
    "coulomb": ("joint_coulomb",),
    "stribeck": ("joint_coulomb", "joint_stribeck"),
    "presliding": ("joint_presliding",),
    "load": ("joint_coulomb", "joint_load_friction"),
    "load_stribeck": ("joint_coulomb", "joint_load_friction", "joint_stribeck"),
}
"""Friction laws in order of complexity, each with its effects at a joint in addition to `JOINT.damping`."""


@dataclass(frozen=True)
class _JointFriction(EffectBase):
    """Friction of an arm joint as a function of its speed."""

    sign_smoothing_speed: float = SIGN_SMOOTHING_SPEED  # v_s [rad/s]

    required_excitation = "the speed"
    is_joint_friction = True
    possible_locations = base.arm_joint_names

    @property
    def max_sticking_speed(self) -> float:
        """The speed 3 v_s [rad/s], at which tanh(v/v_s) is 0.995."""
        return 3 * self.sign_smoothing_speed

    def _sign(self, v: ca.SX) -> ca.SX:
        return ca.tanh(v / self.sign_smoothing_speed)

    def _friction(self, v: ca.SX) -> ca.SX:
        """Torque opposite to the speed v."""
        raise NotImplementedError

    def step_terms(self, state: MidpointStateSymbols) -> EffectStepTerms:
        v = state.v[state.system.mechanism.joint_index(self.location)]
        force = base.one_joint_generalized_force(state.system, self.location, -self._friction(v))
        return EffectStepTerms(dissipative_force=force)


def effect_with_sign_smoothing_speed(effect: Effect, speed: float | None) -> Effect:
    """Return a joint friction with the smoothing speed v_s = `speed` [rad/s]. Other effects are returned unchanged."""
    if speed is None or not isinstance(effect, _JointFriction):
        return effect
    return replace(effect, sign_smoothing_speed=speed)


def lower_smoothing_speed_to_joint_min(effect: EffectBase, system: System) -> EffectBase:
    """Return a joint friction with the lowest smoothing speed of all at its joint. Other effects are unchanged."""
    if not isinstance(effect, _JointFriction):
        return effect
    known = (own for own in system.effects if isinstance(own, _JointFriction) and own.location == effect.location)
    speeds = [own.sign_smoothing_speed for own in known]
    return replace(effect, sign_smoothing_speed=min([effect.sign_smoothing_speed, *speeds]))


@EFFECTS.register("joint_viscous")
class _JointViscous(_JointFriction):
    """Viscous friction F = -b v of an arm joint, in addition to the model's damping."""

    equation = "F = -b v"
    declared_parameters = (effort_scaled_parameter_definition("b", "N m s/rad", 10.0, 2.0, "viscous friction"),)

    max_sticking_speed = 0.0

    def _friction(self, v: ca.SX) -> ca.SX:
        return self["b"] * v


@EFFECTS.register("joint_coulomb")
class _JointCoulomb(_JointFriction):
    """Coulomb friction F = -tau_c tanh(v/v_s) of an arm joint, smoothed below v_s."""

    equation = "F = -tau_c tanh(v/v_s)"
    declared_parameters = (effort_scaled_parameter_definition("tau_c", "N m", 10.0, 2.0, "sliding friction"),)

    def _friction(self, v: ca.SX) -> ca.SX:
        return self["tau_c"] * self._sign(v)


@EFFECTS.register("joint_stribeck")
class _JointStribeck(_JointFriction):
    """Stribeck friction F = -tau_s exp(-(v/v_stribeck)^2) tanh(v/v_s), added to Coulomb friction with the same v_s."""

    equation = "F = -tau_s exp(-(v/v_stribeck)^2) tanh(v/v_s)"
    declared_parameters = (
        effort_scaled_parameter_definition("tau_s", "N m", 10.0, 2.0, "friction at low speed added to tau_c"),
        ParameterDefinition("v_stribeck", "rad/s", 0.1, 5e-3, 2.0, (0.01, 0.3), "speed above which it vanishes", True),
    )

    def _friction(self, v: ca.SX) -> ca.SX:
        return self["tau_s"] * ca.exp(-((v / self["v_stribeck"]) ** 2)) * self._sign(v)


@EFFECTS.register("joint_load_friction")
class _JointLoadFriction(_JointFriction):
    """Load-dependent friction of a gear: F = -share |motor torque - external torque| sgn(v).

    The external torque is that of weights and grasps beyond the joint. The sign of the speed is smoothed below v_s,
    at most `_LOAD_SIGN_SMOOTHING_SPEED`, the magnitude of the torque below `_SMOOTHING_TORQUE`. From Duclusaud et al.
    (2024), Extended friction models for the physics simulation of servo actuators, arXiv:2410.08650.
    """

    equation = "F = -share |tau_motor - tau_outside| tanh(v/v_s)"
    candidate_locations = base.servo_joint_names  # recorded torques leave no room for what a gear takes of them
    declared_parameters = (ParameterDefinition("share", "1", 0.0, 0.0, 2.0, (0.0, 0.5), "friction per gear torque"),)

    def step_terms(self, state: MidpointStateSymbols) -> EffectStepTerms:
        system, index = state.system, state.system.mechanism.joint_index(self.location)
        if self.location in system.driven:
            load = system.friction_load_of_gear(state, index)
        else:  # its motor is assumed to balance the external torque
            load = -2 * system.gravity_and_grasp_force_on_coordinate(state, index)
        size = ca.sqrt(load**2 + _SMOOTHING_TORQUE**2) - _SMOOTHING_TORQUE
        smoothing_speed = min(self.sign_smoothing_speed, _LOAD_SIGN_SMOOTHING_SPEED)
        friction = self["share"] * size * ca.tanh(state.v[index] / smoothing_speed)
        # it dissipates energy, but is not a dissipative force of the speed alone: its size depends on weight and motor
        return EffectStepTerms(generalized_force=base.one_joint_generalized_force(system, self.location, -friction))


@EFFECTS.register("joint_presliding")
class _JointPresliding(EffectBase):
    """Presliding friction of Dahl with stiction: F = -tau_c s with the state ds/dt = (v - |v| s) / yield_angle.

    s depends on the path of the angle, not on time. Over a step of d = h v

        s_{k+1} = sgn(d) (1 - e) + s_k e,  F = -tau_c (sgn(d) (1 - m) + s_k m),  e = exp(-x), m = (1 - e)/x

    at x = |d|/yield_angle is the exact solution and its mean, for a motion that does not reverse within the step. s
    stays within -1 and 1, and the friction dissipates energy for any step; a midpoint rule would oscillate at steps
    longer than the yield angle. |d| in the terms with s_k is smoothed below `_ABS_SMOOTHING_ANGLE`. A loaded joint
    creeps slightly instead of resting if its arm vibrates on the friction's stiffness tau_c/yield_angle faster than the
    steps resolve, like any vibrated Dahl friction; shorter steps prevent it. The initial s of every recording is
    unknown and estimated. From Dahl (1968), A solid friction model, Aerospace Corporation TOR-158(3107-18).
    """

    equation = "F = -tau_c s, ds/dt = (v - |v| s) / yield_angle"
    required_excitation = "the speed"
    is_joint_friction = True
    possible_locations = base.arm_joint_names
    declared_parameters = (
        effort_scaled_parameter_definition("tau_c", "N m", 10.0, 2.0, "sliding friction"),
        ParameterDefinition("yield_angle", "rad", 5e-3, 1e-5, 0.5, (1e-4, 0.05), "angle until it slides", True),
    )
    declared_internal_coordinate_names = ("s",)  # the fraction of tau_c that acts, from -1 to 1

    @property
    def max_abs_initial_internal_coordinates(self) -> Mapping[str, float]:
        """The bound 1 on |s| at the start. The initial internal coordinate s of every recording is estimated."""
        return dict.fromkeys(self.internal_coordinate_symbols, 1.0)

    def step_terms(self, state: MidpointStateSymbols) -> EffectStepTerms:
        [name] = self.internal_coordinate_symbols
        row, index = state.internal_rows[name], state.system.mechanism.joint_index(self.location)
        s, rate, width = state.z[row], state.z_rate[row], self["yield_angle"]
        turned = state.h * state.v[index]
        before = s - state.h / 2 * rate
        x = ca.fabs(turned) / width
        rounded = (ca.sqrt(turned**2 + _ABS_SMOOTHING_ANGLE**2) - _ABS_SMOOTHING_ANGLE) / width
        # e^-x by its remainder over x^2, to avoid cancellation near zero, where an arm at rest stays
        change = turned / width * (1 - x * _left(x)) - before * rounded * (1 - rounded * _left(rounded))
        mean = turned / width * _left(x) + before * (1 - rounded * _left(rounded))
        force = base.one_joint_generalized_force(state.system, self.location, -self["tau_c"] * mean)
        equations = {name: state.h * rate - change}
        return EffectStepTerms(generalized_force=force, internal_equations=equations, static_equations={name: s})


def _left(x: ca.SX) -> ca.SX:
    """Series remainder (exp(-x) - 1 + x)/x^2 for x >= 0."""
    far = ca.fmax(x, _SERIES_MAX_ANGLE_RATIO)
    series = 1 / 2 - x / 6 + x**2 / 24 - x**3 / 120
    return ca.if_else(x < _SERIES_MAX_ANGLE_RATIO, series, (ca.exp(-far) - 1 + far) / far**2)


@EFFECTS.register("joint_spring")
class _JointSpring(EffectBase):
    """Spring on an arm joint. It adds the elastic energy V += 1/2 stiffness (q - rest_angle)^2."""

    equation = "V += 1/2 stiffness (q - rest_angle)^2"
    required_excitation = "the angle"
    possible_locations = base.arm_joint_names
    declared_parameters = (
        effort_scaled_parameter_definition("stiffness", "N m/rad", 300.0, 60.0, "stiffness of the spring"),
        ParameterDefinition("rest_angle", "rad", 0.0, -math.pi, math.pi, (-2.0, 2.0), "angle without torque", True),
    )

    def step_terms(self, state: MidpointStateSymbols) -> EffectStepTerms:
        stretch = state.q[state.system.mechanism.joint_index(self.location)] - self["rest_angle"]
        return EffectStepTerms(lagrangian=-self["stiffness"] / 2 * stretch**2)

"""A system and its effects in terms of a rigid-body engine: springs, dampers, friction, actuators.

Nothing here depends on a format. An effect is classified by the parts of the description it changes and by its
equations, so kinds from outside the package are treated like those of the library.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.system import Effect, MidpointState, RecordingErrorEffect, System

Array = NDArray[np.float64]

MODEL_ASPECTS: Mapping[str, str] = {
    "stiffness": "stiffness of joints",
    "rest": "angles at which springs are relaxed",
    "damping": "viscous damping of joints",
    "geometry": "places of joints and points",
    "inertia": "masses and inertias",
    "weight": "weight that is not mass times gravity",
    "gravity": "the gravity vector",
    "grasp": "where and how a grasp holds",
    "grasp_compliance": "springs in place of a rigid grasp",
    "sprung_joint": "joints with springs where the nominal model is rigid",
    "armature": "rotor inertia at a joint",
    "dry_friction": "dry friction at a joint",
    "cubic_stiffness": "springs that stiffen with the cube of the angle",
    "torque_gain": "true over recorded torque",
    "torque_offset": "constant part of a recorded torque that does not act",
    "torque_delay": "torque that acts later than recorded",
    "torque_lag": "torque that follows its record",
    "servo": "gain, damping, delay and limit of position servos",
    "clock": "a clock that runs fast or slow",
    "reading": "what a sensor reads; the motion does not depend on it",
    "memory": "forces with a memory",
    "force": "forces that no joint, spring or damper makes",
}
"""Aspects of a model that an engine may or may not represent, with their descriptions."""

_DRY_FRICTION_PARAMETERS: Mapping[str, str] = {"joint_coulomb": "tau_c", "joint_presliding": "tau_c"}
"""Kinds that are smoothed dry friction, and the parameter with their friction torque [N m]."""

_POINTS = 3  # at which equations are compared
_ROUNDING = 1e-9


@dataclass(frozen=True)
class JointDynamics:
    """Spring, damping, inertia and friction at one joint, in SI units of its coordinate.

    Attributes
    ----------
    stiffness, constant_force : float
        Force -stiffness q + pull.
    cubic_stiffness, damping, armature, dry_friction : float
        Force -cubic q^3, force -damping v, inertia, dry friction.
    """

    stiffness: float = 0.0
    constant_force: float = 0.0
    cubic_stiffness: float = 0.0
    damping: float = 0.0
    armature: float = 0.0
    dry_friction: float = 0.0

    def __add__(self, other: JointDynamics) -> JointDynamics:
        return JointDynamics(*(getattr(self, name) + getattr(other, name) for name in vars(self)))


@dataclass(frozen=True)
class ActuatorResponse:
    """Applied torque of a driven joint from the recorded one: gain x recorded - offset, delay [s], first-order lag [s].

    With a position servo it is the commanded position instead.
    """

    gain: float = 1.0
    subtracted_offset: float = 0.0
    delay: float = 0.0
    lag_time: float = 0.0


class ParameterEvaluator:
    """Evaluator of expressions in a system's parameters; values are flattened column by column.

    Parameters
    ----------
    system : System
    values : mapping of str to float, optional
        Parameter values by name; nominal where absent.
    """

    def __init__(self, system: System, values: Mapping[str, float] | None = None) -> None:
        self._symbols, self._theta = system.parameters.symbols, system.parameters.vector(values)

    def __call__(self, expression: ca.SX) -> Array:
        """Values of an expression that depends on parameters only."""
        return np.array(ca.densify(ca.Function("value", [self._symbols], [expression])(self._theta))).ravel(order="F")

    def is_zero(self, expression: ca.SX) -> bool:
        """Whether an expression is zero for all values of its other symbols."""
        return bool(ca.sparsify(self.with_parameter_values(expression)).is_zero())

    def with_parameter_values(self, expression: ca.SX) -> ca.SX:
        """The expression with parameters replaced by their values."""
        return ca.substitute(expression, self._symbols, ca.DM(self._theta))


def aspects_of_parameters(system: System, symbols: ca.SX) -> set[str]:
    """Keys of `MODEL_ASPECTS` for the parts of the description that depend on given parameters."""
    tree = system.mechanism
    bodies = [body for joint in tree.joints for body in joint.bodies]
    held = system.grasps
    entered: Mapping[str, Iterable[ca.SX]] = {
        "stiffness": (spring.stiffness for spring in system.elastic_joints),
        "rest": (spring.rest_angle for spring in system.elastic_joints),
        "damping": (*(spring.damping for spring in system.elastic_joints), *system.joint_damping.values()),
        "geometry": (
            *(part for joint in tree.joints for part in (joint.placement.rotation, joint.placement.translation)),
            *(
                part
                for frame in tree.frames.values()
                for part in (frame.placement.rotation, frame.placement.translation)
            ),
        ),
        "inertia": (part for body in bodies for part in (body.mass, body.center_of_mass, body.inertia_about_com)),
        "weight": (body.gravity_fraction for body in bodies if body.gravity_fraction is not None),
        "gravity": (system.gravity,),
        "grasp": (part for grasp in held for part in (grasp.held_orientation, grasp.holder_offset, grasp.axial_slip)),
        "grasp_compliance": (
            *(grasp.compliance for grasp in held),
            *(grasp.relaxation_time for grasp in held if grasp.relaxation_time is not None),
        ),
        "sprung_joint": system.joint_compliances.values(),
        "servo": (part for servo in system.servos.values() for part in servo.coefficients),
        "clock": (system.recorded_time_scale,),
    }
    return {name for name, parts in entered.items() if any(_depends(part, symbols) for part in parts)}


def effect_terms_and_aspects(
    system: System, effect: Effect, value: ParameterEvaluator
) -> tuple[dict[str, JointDynamics], set[str]]:
    """Joint terms and aspects of an effect in a rigid-body engine.

    Parameters
    ----------
    system : System
        That has the effect.
    effect : Effect
    value : Evaluator

    Returns
    -------
    terms : dict of joint name to JointTerms
        Terms that its equations add at single joints.
    aspects : set of str
        Keys of `MODEL_ASPECTS` of everything it changes.
    """
    aspects = aspects_of_parameters(system, effect.parameters.symbols)
    terms: dict[str, JointDynamics] = {}
    if effect.kind in _DRY_FRICTION_PARAMETERS:
        size = effect.parameters[f"{effect.kind}@{effect.location}.{_DRY_FRICTION_PARAMETERS[effect.kind]}"].symbol
        terms = {effect.location: JointDynamics(dry_friction=float(value(size)[0]))}
        aspects.add("dry_friction")
    elif effect.internal_coordinates:
        aspects.add("memory")
    else:
        found = _joint_terms(system, effect, value)
        if found is None:
            aspects.add("force")
        else:
            terms = found
            for entry in terms.values():
                sizes = {"cubic_stiffness": entry.cubic_stiffness, "damping": entry.damping, "armature": entry.armature}
                sizes |= {"stiffness": entry.stiffness, "rest": entry.constant_force}
                aspects |= {name for name, size in sizes.items() if size}
    for joint in system.driven:
        own = _actuation(system, (effect,), joint, value)
        changed = {
            "torque_gain": own.gain != 1,
            "torque_offset": own.subtracted_offset != 0,
            "torque_lag": own.lag_time != 0,
        }
        changed |= {"torque_delay": own.delay > 0, "reading": own.delay < 0}
        aspects |= {name for name, does in changed.items() if does}
    return terms, aspects or {"reading"}


def joint_dynamics(system: System, value: ParameterEvaluator) -> dict[str, JointDynamics]:
    """Springs, dampers, rotor inertia and friction by joint, from the description and from effects.

    Of other effects only these parts are included; the aspects of `effect_terms_and_aspects` show what is missing.
    """
    found: dict[str, JointDynamics] = {}

    def add(joint: str, own: JointDynamics) -> None:
        found[joint] = found.get(joint, JointDynamics()) + own

    for joint, coefficient in system.joint_damping.items():
        add(joint, JointDynamics(damping=float(value(coefficient)[0])))
    for spring in system.elastic_joints:
        stiffness, rest, damping = (float(value(x)[0]) for x in (spring.stiffness, spring.rest_angle, spring.damping))
        add(spring.joint_name, JointDynamics(stiffness, stiffness * rest, damping=damping))
    for joint, compliance in system.joint_compliances.items():
        if not value.is_zero(compliance):
            stiffness = 1 / float(value(compliance)[0])
            add(joint, JointDynamics(stiffness, damping=system.joint_relaxation_times.get(joint, 0.0) * stiffness))
    for effect in system.effects:
        for joint, own in effect_terms_and_aspects(system, effect, value)[0].items():
            add(joint, own)
    return found


def actuator_responses(system: System, value: ParameterEvaluator) -> dict[str, ActuatorResponse]:
    """Relation between the recorded and the applied torque, by driven joint."""
    return {joint: _actuation(system, system.effects, joint, value) for joint in system.driven}


def _actuation(system: System, effects: Iterable[Effect], joint: str, value: ParameterEvaluator) -> ActuatorResponse:
    """As the estimation has it: the last effect is the nearest to the reading."""
    reading, known = ca.SX.sym("reading"), [e for e in effects if isinstance(e, RecordingErrorEffect)]
    true, servo = reading, system.servos.get(joint)
    channel = f"joints.{'effort' if servo is None else 'position'}.{joint}"
    for effect in reversed(known):
        true = effect.corrected_reading(channel, true, true)
    late = sum((effect.added_delay(f"torque.{joint}", False) for effect in known), ca.SX(0))
    lag = sum((effect.lag_time_constant(f"torque.{joint}") for effect in known), ca.SX(0))
    gain = ca.jacobian(true, reading)
    numbers = [ca.substitute(part, reading, 0) for part in (gain, true)] + [late, lag]
    one, none, delay, constant = (float(value(number)[0]) for number in numbers)
    return ActuatorResponse(one, -none, delay, constant)


def _joint_terms(system: System, effect: Effect, value: ParameterEvaluator) -> dict[str, JointDynamics] | None:
    """Springs, dampers and rotors that an effect's equations are, by joint; None where they are something else."""
    n = system.n_coordinates
    q, v = ca.SX.sym("q", n), ca.SX.sym("v", n)
    u, reaction = ca.SX.sym("u", len(system.driven)), ca.SX.sym("reaction", system.n_constraints)
    none, h = ca.SX(0, 1), ca.SX.sym("h")
    terms = effect.step_terms(
        MidpointState(system, forward_kinematics(system.mechanism, q), q, v, none, none, u, reaction, {}, h)
    )
    energy = value.with_parameter_values(terms.lagrangian)
    force = ca.gradient(energy, q)
    for part in (
        terms.generalized_force,
        terms.dissipative_force,
        None if terms.force_with_derivatives is None else terms.force_with_derivatives.force,
    ):
        if part is not None:
            force += value.with_parameter_values(ca.densify(part))
    if ca.sparsify(ca.vertcat(energy, force)).is_zero():
        return {}
    momentum = ca.gradient(energy, v)
    if _depends(ca.vertcat(force, momentum), ca.vertcat(u, reaction, h)):
        return None
    ones = ca.SX.ones(n)
    by_q, by_v, inertia = ca.jacobian(force, q), ca.jacobian(force, v), ca.jacobian(momentum, v)
    second = ca.jtimes(ca.diag(by_q), q, ones)
    third = ca.jtimes(second, q, ones)
    slopes = [ca.diag(by_v), ca.diag(inertia), third]
    mixed = [ca.jacobian(momentum, q), *(full - ca.diag(ca.diag(full)) for full in (by_q, by_v, inertia))]
    at = ca.Function("at", [q, v], [ca.densify(x) for x in (force, ca.diag(by_q), second, *slopes, *mixed)])
    rng = np.random.default_rng(0)
    found = [[np.array(x) for x in at(*rng.uniform(-1.0, 1.0, (2, n)))] for _ in range(_POINTS)]
    rest = [np.array(x).ravel() for x in at(np.zeros(n), np.zeros(n))[:6]]
    pull, slope, curve, damping, armature, twisted = rest
    scale = _ROUNDING * max(1.0, *(float(np.abs(x).max(initial=0.0)) for x in rest))
    constant = all(
        np.abs(entry[3 + i].ravel() - rest[3 + i]).max() <= scale for entry in found for i in range(len(slopes))
    )
    apart = all(np.abs(x).max(initial=0.0) <= scale for entry in found for x in entry[6:])
    springs = np.abs(curve).max() <= scale and damping.max() <= scale and armature.min() >= -scale
    loose = (np.abs(slope) <= scale) & (np.abs(pull) > scale)  # a constant torque is no spring
    if not (constant and apart and springs) or np.any(loose):
        return None
    joints = system.mechanism.joint_names
    made = {
        joint: JointDynamics(-slope[i], pull[i], -twisted[i] / 6, -damping[i], armature[i])
        for i, joint in enumerate(joints)
        if np.any(np.abs([slope[i], pull[i], twisted[i], damping[i], armature[i]]) > scale)
    }
    return made


def _depends(expression: ca.SX, symbols: ca.SX) -> bool:
    return expression.numel() > 0 and symbols.numel() > 0 and bool(ca.depends_on(expression, symbols))

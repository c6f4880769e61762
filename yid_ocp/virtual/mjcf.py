"""A conversion of a system to the terms of a rigid-body engine, and to a MuJoCo model (MJCF).

Effects are classified by their equations and by the parts of the description that they change, not by their kinds.
Effects from plug-ins are therefore treated like those of the library.
"""

from __future__ import annotations

import functools
import logging
import math
import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import casadi as ca
import numpy as np
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from yid_ocp.arrays import Array
from yid_ocp.errors import ModelError, import_optional
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.mechanism import Frame, Inertia, Joint, Mechanism, Placement, depends_on_symbols, merge_inertias
from yid_ocp.model.servos_and_springs import TORQUE_SATURATION_EXPONENT, UNLIMITED_EFFORT_THRESHOLD
from yid_ocp.model.system import Effect, MidpointStateSymbols, System

_DRY_FRICTION_KINDS = ("joint_coulomb", "joint_presliding")  # smoothed, of friction torque tau_c [N m]

_N_COMPARED_STATES = 3  # number of random states at which an effect's equations are compared with joint terms
_ROUNDING_TOLERANCE = 1e-9
MUJOCO_APPROXIMATED_ASPECTS = frozenset({"dry_friction", "grasp_compliance"})
_INEXPRESSIBLE_ASPECTS = frozenset({"servo_firmware", "clock", "memory", "force"})  # of the mechanics

_JOINTS_PER_BODY = 6  # MuJoCo's limit
_ROTOR_INERTIA = 5e-4  # [kg m^2] of a motor behind play, as small as stability at a stop allows
_AXIS_LEVER = 0.1  # [m] between the two points that keep two axes parallel


@functools.cache
def elements_by_aspect_and_file_format() -> Mapping[str, Mapping[str, str]]:
    """Return, for each model aspect that an engine may lack, its description (`is`) and elements by file format."""
    return dict(YAML(typ="safe").load(Path(__file__).with_name("aspects.yaml")))


@dataclass(frozen=True)
class JointDynamicsTerms:
    """The stiffness, damping, dry friction, armature (rotor inertia) and constant force of one joint, in SI units.

    Its force is constant_force - stiffness q - cubic_stiffness q^3 - damping v - dry friction.
    """

    stiffness: float = 0.0
    constant_force: float = 0.0
    cubic_stiffness: float = 0.0
    damping: float = 0.0
    armature: float = 0.0
    dry_friction: float = 0.0

    def __add__(self, other: JointDynamicsTerms) -> JointDynamicsTerms:
        return JointDynamicsTerms(*(getattr(self, name) + getattr(other, name) for name in vars(self)))


class CasadiEvaluator:
    """An evaluator of CasADi expressions at parameter `values` (default: nominal). It flattens matrices by columns."""

    def __init__(self, system: System, values: Mapping[str, float] | None = None) -> None:
        self._symbols, self._theta = system.parameters.symbols, system.parameters.vector(values)
        self._values = dict(zip(system.parameters.names, self._theta, strict=True))

    def __call__(self, expression: ca.SX) -> Array:
        """Values of an expression that depends on parameters only."""
        is_constant = expression.is_constant()  # no function then, which costs far more than its value
        made = expression if is_constant else ca.Function("value", [self._symbols], [expression])(self._theta)
        return np.array(ca.densify(ca.DM(made))).ravel(order="F")

    def is_effect_neutral(self, effect: Effect) -> bool:
        """Whether an effect changes nothing, because all its amplitudes have their neutral values."""
        names, neutral = getattr(effect, "amplitude_parameter_names", ()), getattr(effect, "neutral_values", {})
        return bool(names) and all(self._values[name] == neutral[name] for name in names)

    def _is_zero_at_parameter_values(self, expression: ca.SX) -> bool:
        """Whether an expression, at the parameter values, is zero for all values of its other symbols."""
        return bool(ca.sparsify(self._substitute_parameter_values(expression)).is_zero())

    def _substitute_parameter_values(self, expression: ca.SX) -> ca.SX:
        return ca.substitute(expression, self._symbols, ca.DM(self._theta))


def model_aspects_depending_on_symbols(system: System, symbols: ca.SX) -> set[str]:
    """Find the model aspects (keys of `elements_by_aspect_and_file_format`) whose expressions depend on `symbols`."""
    tree, held = system.mechanism, system.grasps
    bodies = [body for joint in tree.joints for body in joint.bodies]
    placements = [*(joint.placement for joint in tree.joints), *(frame.placement for frame in tree.frames.values())]
    entered: Mapping[str, Iterable[ca.SX]] = {
        "stiffness": (spring.stiffness for spring in system.elastic_joints),
        "rest": (spring.rest_angle for spring in system.elastic_joints),
        "damping": (*(spring.damping for spring in system.elastic_joints), *system.joint_damping.values()),
        "geometry": (part for placement in placements for part in (placement.rotation, placement.translation)),
        "inertia": (part for body in bodies for part in (body.mass, body.center_of_mass, body.inertia_about_com)),
        "weight": (body.gravity_fraction for body in bodies),
        "gravity": (system.gravity,),
        "grasp": (part for grasp in held for part in (grasp.held_orientation, grasp.holder_offset, grasp.axial_slip)),
        "grasp_compliance": (part for grasp in held for part in (grasp.compliance, grasp.relaxation_time)),
        "sprung_joint": system.joint_compliances.values(),
        "servo": (
            part
            for s in system.servos.values()
            for part in (s.gain, s.damping, s.command_delay, s.torque_limit_tightness, s.derivative)
        ),
        "servo_firmware": (p for s in system.servos.values() for p in (s.dead_band, s.current_limit_tightness)),
        "clock": (system.recorded_time_scale,),
    }
    return {name for name, parts in entered.items() if any(depends_on_symbols(part, symbols) for part in parts)}


def effect_joint_terms_and_changed_aspects(
    system: System, effect: Effect, value: CasadiEvaluator
) -> tuple[dict[str, JointDynamicsTerms], set[str]]:
    """Find the terms that an effect adds to each joint, and the model aspects that it changes, by key."""
    aspects = model_aspects_depending_on_symbols(system, effect.parameters.symbols)
    terms: dict[str, JointDynamicsTerms] = {}
    if effect.kind in _DRY_FRICTION_KINDS:
        size = effect.parameters[f"{effect.label}.tau_c"].symbol
        terms = {effect.location: JointDynamicsTerms(dry_friction=float(value(size)[0]))}
        aspects.add("dry_friction")
    elif effect.internal_coordinate_symbols:
        aspects.add("memory")
    elif (found := _joint_terms(system, effect, value)) is None:
        aspects.add("force")
    else:
        terms = found
        # an aspect has the name of the term, except for the rest angle of a spring
        sizes = ((name, size) for entry in terms.values() for name, size in vars(entry).items())
        aspects |= {"rest" if name == "constant_force" else name for name, size in sizes if size}
    for joint in system.driven:
        gain, offset, delay, lag = _actuation(system, (effect,), joint, value)
        changed = {"torque_gain": gain != 1, "torque_offset": offset != 0, "torque_lag": lag != 0}
        changed |= {"torque_delay": delay > 0, "reading": delay < 0}
        aspects |= {name for name, does in changed.items() if does}
    return terms, aspects or {"reading"}


def system_joint_dynamics_terms(system: System, value: CasadiEvaluator) -> dict[str, JointDynamicsTerms]:
    """Return the springs, dampers, rotor inertia and friction of each joint, from description and joint effects."""
    found = defaultdict[str, JointDynamicsTerms](JointDynamicsTerms)
    for joint, coefficient in system.joint_damping.items():
        found[joint] += JointDynamicsTerms(damping=float(value(coefficient)[0]))
    for joint, servo in system.servos.items():
        if servo.motor_kind == "dc":  # the limit of its duty cycle does not limit the counter-voltage
            found[joint] += JointDynamicsTerms(damping=float(value(servo.damping)[0]))
    for spring in system.elastic_joints:
        stiffness, rest, damping = (float(value(x)[0]) for x in (spring.stiffness, spring.rest_angle, spring.damping))
        found[spring.joint_name] += JointDynamicsTerms(stiffness, stiffness * rest, damping=damping)
    for joint, compliance in system.joint_compliances.items():
        if not value._is_zero_at_parameter_values(compliance):
            stiffness, relaxation = 1 / float(value(compliance)[0]), system.joint_relaxation_times.get(joint, 0.0)
            found[joint] += JointDynamicsTerms(stiffness, damping=relaxation * stiffness)
    for effect in (own for own in system.effects if not value.is_effect_neutral(own)):
        for joint, own in effect_joint_terms_and_changed_aspects(system, effect, value)[0].items():
            found[joint] += own
    return found


def _actuation(
    system: System, effects: Sequence[Effect], joint: str, value: CasadiEvaluator
) -> tuple[float, float, float, float]:
    """Gain, offset, delay [s], lag [s] of a joint's torque or servo command: true = gain x recorded - offset."""
    true = reading = ca.SX.sym("reading")
    channel = f"joints.{'position' if joint in system.servos else 'effort'}.{joint}"
    for effect in reversed(effects):
        true = effect.true_value_from_reading(channel, true, true)
    late = sum((effect.added_channel_delay(f"torque.{joint}", False) for effect in effects), ca.SX(0))
    lag = sum((effect.channel_lag_time_constant(f"torque.{joint}") for effect in effects), ca.SX(0))
    numbers = [ca.substitute(part, reading, 0) for part in (ca.jacobian(true, reading), -true)]
    gain, offset, delay, time_constant = (float(value(number)[0]) for number in (*numbers, late, lag))
    return gain, offset, delay, time_constant


def _joint_terms(system: System, effect: Effect, value: CasadiEvaluator) -> dict[str, JointDynamicsTerms] | None:
    """Springs, dampers and rotors that are equivalent to an effect's equations, by joint. None if none are."""
    n = system.n_coordinates
    q, v = ca.SX.sym("q", n), ca.SX.sym("v", n)
    u, reaction = ca.SX.sym("u", len(system.driven)), ca.SX.sym("reaction", system.n_constraints)
    none, h = ca.SX(0, 1), ca.SX.sym("h")
    kinematics = forward_kinematics(system.mechanism, q)
    terms = effect.step_terms(MidpointStateSymbols(system, kinematics, q, v, none, none, u, reaction, {}, h))
    energy, closed = value._substitute_parameter_values(terms.lagrangian), terms.force_with_derivatives
    force = ca.gradient(energy, q)
    for part in (terms.generalized_force, terms.dissipative_force, None if closed is None else closed.force):
        if part is not None:
            force += value._substitute_parameter_values(ca.densify(part))
    if ca.sparsify(ca.vertcat(energy, force)).is_zero():
        return {}
    momentum = ca.gradient(energy, v)
    if depends_on_symbols(ca.vertcat(force, momentum), ca.vertcat(u, reaction, h)):
        return None
    by_q, ones = ca.diag(ca.jacobian(force, q)), ca.SX.ones(n)
    third = ca.jtimes(ca.jtimes(by_q, q, ones), q, ones)
    slopes = by_q, third, ca.diag(ca.jacobian(force, v)), ca.diag(ca.jacobian(momentum, v))
    at = ca.Function("at", [q, v], [ca.densify(x) for x in (force, momentum, *slopes)])
    pull, _, *rest = (np.array(x).ravel() for x in at(np.zeros(n), np.zeros(n)))
    slope, twisted, damping, armature = rest
    scale = _ROUNDING_TOLERANCE * max(1.0, float(np.abs([pull, *rest]).max()))
    for x, rate in np.random.default_rng(0).uniform(-1.0, 1.0, (_N_COMPARED_STATES, 2, n)):
        likely = [pull + slope * x + twisted / 6 * x**3 + damping * rate, armature * rate]
        if not np.abs(np.squeeze(at(x, rate)[:2], 2) - likely).max() <= scale:  # also if it is not a number
            return None
    loose = (np.abs(slope) <= scale) & (np.abs(pull) > scale)  # a constant torque is not a spring
    if damping.max() > scale or armature.min() < -scale or np.any(loose):
        return None
    return {
        joint: JointDynamicsTerms(-slope[i], pull[i], -twisted[i] / 6, -damping[i], armature[i])
        for i, joint in enumerate(system.mechanism.joint_names)
        if np.any(np.abs([slope[i], pull[i], twisted[i], damping[i], armature[i]]) > scale)
    }


def mujoco_xml(
    system: System,
    values: Mapping[str, float] | None = None,
    *,
    time_step: float = 5e-4,
    standalone: bool = False,
    gear_play: Mapping[str, float] | None = None,
) -> str:
    """Return a system as a MuJoCo model in MJCF, an XML text.

    Joints keep their names. Consecutive massless joints at one location become one body with several joints, which is
    kinematically equivalent. Every point and grasp end is a site: points under their own name, grasps as
    `grasp_NAME_holder` and `grasp_NAME_held`. There are no contacts or limits. Everything is inside one fixed body
    `world_base`, because some readers require a single root. Raises `ModelError` if MuJoCo cannot express the system.

    Parameters
    ----------
    time_step : float
        Time step of the simulator [s]. Grasps are constraints with a time constant of two steps.
    standalone : bool
        Whether the model is for use without this package. Approximations are then allowed: sticking for smoothed dry
        friction, a tendon for a compliant point grasp. Otherwise a system that needs them raises an error. Each driven
        joint then has an actuator of its name, whose control is the recorded torque, and whose gain, offset, delay and
        lag give the applied torque. Otherwise, apply true torques as `qfrc_applied`. A servo always is an actuator,
        whose control is the command.
    gear_play : mapping of joint name to float, optional
        Full backlash width of gears [rad]. The joint is then the motor side, followed by a joint `NAME_play`.
    """
    tree, weights = _weighed(system.mechanism_with_values(values))
    value = CasadiEvaluator(system, values)
    _refuse_inexpressible(system, value, standalone)

    root = Element("mujoco", model=tree.name)
    SubElement(root, "compiler", angle="radian", autolimits="false", inertiafromgeom="false")
    # the Newton solver of MuJoCo 4.0 does not converge on fine chains in its sparse form
    search = {"iterations": "100", "tolerance": "1e-14", "jacobian": "dense"}
    # the twist of a thin tube has a damping time of some 10 us, which an explicit rule cannot follow
    rules = {"timestep": format_xml_numbers([time_step]), "integrator": "implicitfast"}
    rules["gravity"] = format_xml_numbers(value(system.gravity))
    SubElement(SubElement(root, "option", {**rules, **search}), "flag", contact="disable")
    sites = _sites(system, tree, value)
    base = SubElement(SubElement(root, "worldbody"), "body", name="world_base")
    SubElement(base, "inertial", pos="0 0 0", mass="0", diaginertia="0 0 0")  # required by Pinocchio
    stops = {"solreflimit": format_xml_numbers([5 * time_step, 1.0]), "solimplimit": "0.99 0.999 0.0001 0.5 2"}
    ranges = {name: format_xml_numbers([-width / 2, width / 2]) for name, width in (gear_play or {}).items()}
    gears = {name: {"limited": "true", "range": ends, **stops} for name, ends in ranges.items()}
    elements = _bodies(tree, weights, system_joint_dynamics_terms(system, value), sites, base, gears)
    for name, frame in sites:
        SubElement(elements[frame.joint_index], "site", {"name": name, **_pose(frame.placement)})
    _add_grasps(system, value, root, time_step)
    if standalone or system.servos:
        _add_actuators(system, value, SubElement(root, "actuator"), time_step)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _bodies(
    tree: Mechanism,
    weights: Mapping[str, float],
    terms: Mapping[str, JointDynamicsTerms],
    sites: list[tuple[str, Frame]],
    world: Element,
    gears: Mapping[str, Mapping[str, str]],
) -> dict[int, Element]:
    """Add bodies with joints, masses and `gears`. Returns the body element of each joint index (-1: the world)."""
    carried = {frame.joint_index: name for name, frame in reversed(sites)}
    elements: dict[int, Element] = {-1: world}
    for j, joint in enumerate(tree.joints):
        if _shares_body(tree, j):
            elements[j] = elements[joint.parent_index]
            if joint.parent_index in carried:
                what = f"the frame '{carried[joint.parent_index]}' is on a joint without mass, which MuJoCo cannot hold"
                where, hint = f"joint '{joint.name}'", "give a mass to the link that carries the frame"
                raise ModelError(what, where=where, allowed="frames on links with mass", hint=hint)
        else:
            place = {"name": f"{joint.name}_body", **_pose(joint.placement)}
            elements[j] = SubElement(elements[joint.parent_index], "body", place)
        attributes = _joint_attributes(joint, terms.get(joint.name, JointDynamicsTerms()))
        moved = SubElement(elements[j], "joint", attributes)
        if joint.name in gears:
            motor, name = elements[j], joint.name
            motor.set("name", f"{name}_motor")
            moved.attrib.setdefault("armature", format_xml_numbers([_ROTOR_INERTIA]))
            SubElement(motor, "inertial", pos="0 0 0", mass="1e-6", diaginertia="1e-9 1e-9 1e-9")
            elements[j] = SubElement(motor, "body", {"name": f"{name}_body"})
            kind = {"name": f"{name}_play", "type": attributes["type"], "axis": attributes["axis"]}
            SubElement(elements[j], "joint", {**kind, **gears[name]})
        if len(elements[j].findall("joint")) > _JOINTS_PER_BODY:
            names = ", ".join(own.get("name", "") for own in elements[j].findall("joint"))
            what, hint = f"seven joints in series have no mass between them: {names}", "give one of the links a mass"
            allowed = "up to six joints in series, with a mass on the link of the last one"
            raise ModelError(what, where=f"joint '{joint.name}'", allowed=allowed, hint=hint)
        body = merge_inertias(joint.bodies)
        if body is not None:
            if joint.name in weights:
                elements[j].set("gravcomp", format_xml_numbers([1 - weights[joint.name]]))
            SubElement(elements[j], "inertial", _inertial(body))
        elif not any(_shares_body(tree, k) and tree.joints[k].parent_index == j for k in range(len(tree.joints))):
            what, hint = f"MuJoCo needs a mass on the link of '{joint.name}'", "give the link a mass, or lock the joint"
            raise ModelError(what, where=f"joint '{joint.name}'", allowed="joints whose link has a mass", hint=hint)
    return elements


def _weighed(tree: Mechanism) -> tuple[Mechanism, dict[str, float]]:
    """The tree with bodies of full weight, and the gravity fraction of bodies with another weight, by joint."""
    weights: dict[str, float] = {}
    for joint in tree.joints:
        shares = {float(body.gravity_fraction) for body in joint.bodies}
        if len(shares) > 1:
            said = ", ".join(f"{share:.4g}" for share in sorted(shares))
            what, where = f"bodies of one joint have {said} times the weight of their mass", f"joint '{joint.name}'"
            hint = "leave out one of the effects that change weights (model.effects)"
            raise ModelError(what, where=where, allowed="one factor for all bodies of a joint", hint=hint)
        weights |= dict.fromkeys([joint.name] if shares - {1.0} else [], next(iter(shares), 1.0))
    return tree.with_gravity_fraction(ca.SX(1)), weights


def _joint_attributes(joint: Joint, terms: JointDynamicsTerms) -> dict[str, str]:
    axis, damping = format_xml_numbers(joint.axis), format_xml_numbers([terms.damping])
    attributes = {"name": joint.name, "axis": axis, "damping": damping}
    attributes["type"] = "hinge" if joint.kind == "revolute" else "slide"
    numbers: dict[str, list[float]] = {}
    if terms.stiffness > 0:
        numbers |= {"stiffness": [terms.stiffness], "springref": [terms.constant_force / terms.stiffness]}
    if terms.cubic_stiffness:
        if terms.constant_force:
            what, allowed = f"the spring at '{joint.name}' has a cubic part and a rest angle", "one of these two only"
            hint = "remove the cubic part or the rest angle: MuJoCo cannot express both at one joint"
            raise ModelError(what, where=f"joint '{joint.name}'", allowed=allowed, hint=hint)
        numbers["stiffness"] = [terms.stiffness, 0.0, terms.cubic_stiffness]
    others = {"armature": [terms.armature], "frictionloss": [terms.dry_friction]}
    numbers |= {name: size for name, size in others.items() if any(size)}
    return attributes | {name: format_xml_numbers(values) for name, values in numbers.items()}


def _add_grasps(system: System, value: CasadiEvaluator, root: Element, time_step: float) -> None:
    equality = SubElement(root, "equality")
    firm = {"solref": format_xml_numbers([2 * time_step, 1.0]), "solimp": "0.9999 0.9999 0.001 0.5 2"}
    for grasp in system.grasps:
        ends = [f"grasp_{grasp.name}_{end}" for end in ("holder", "held")]
        compliance = float(value(grasp.compliance)[0])
        if compliance > 0:
            # a tendon of no length pulls with its stiffness, and damps, along the line between both ends
            relaxation = float(value(grasp.relaxation_time)[0])
            tendons = root.find("tendon")
            tendons = SubElement(root, "tendon") if tendons is None else tendons
            spring = SubElement(tendons, "spatial", name=f"grasp_{grasp.name}", springlength="0")
            for key, size in (("stiffness", 1 / compliance), ("damping", relaxation / compliance)):
                spring.set(key, format_xml_numbers([size]))
            for end in ends:
                SubElement(spring, "site", site=end)
            continue
        kind = "weld" if grasp.kind == "weld" else "connect"
        for suffix in ("", "_ahead") if grasp.kind == "axis" else ("",):
            sites = {"site1": ends[0] + suffix, "site2": ends[1] + suffix}
            SubElement(equality, kind, {"name": f"grasp_{grasp.name}{suffix}", **sites, **firm})


def _add_actuators(system: System, value: CasadiEvaluator, actuator: Element, time_step: float) -> None:
    for joint in system.driven:
        gain, offset, delay, lag = _actuation(system, system.effects, joint, value)
        attributes, servo = {"name": joint, "joint": joint}, system.servos.get(joint)
        bias, between = [-offset, 0.0, 0.0], "linear"
        if servo is not None:
            rate = servo.derivative if servo.motor_kind == "dc" else servo.damping
            parts = servo.gain, rate, servo.command_delay, servo.torque_limit_tightness
            own, damping, late, tightness = (float(value(x)[0]) for x in parts)
            gain, bias, delay = own * gain, [own * bias[0], -own, -damping], delay + late
            between = "zoh" if servo.command_interpolation == "held" else "linear"
            limit = tightness ** (-1 / TORQUE_SATURATION_EXPONENT) if tightness > 0 else math.inf
            if limit < UNLIMITED_EFFORT_THRESHOLD:
                attributes |= {"forcelimited": "true", "forcerange": format_xml_numbers([-limit, limit])}
        attributes["gainprm"] = format_xml_numbers([gain])
        if any(bias):
            attributes |= {"biastype": "affine", "biasprm": format_xml_numbers(bias)}
        if lag > 0:
            attributes |= {"dyntype": "filterexact", "dynprm": format_xml_numbers([lag])}
        if delay > 0:
            samples = math.ceil(delay / time_step) + 1
            attributes |= {"delay": format_xml_numbers([delay]), "nsample": str(samples), "interp": between}
        SubElement(actuator, "general", attributes)


def import_mujoco(what: str = "virtual experiments need MuJoCo") -> ModuleType:
    """Import the mujoco package. Raises `DataError` with the text `what` if it is not installed."""
    mujoco = import_optional("mujoco", "blind", what)
    mujoco.set_mju_user_warning(logging.getLogger(__name__).info)  # else on the terminal and in MUJOCO_LOG.TXT
    return mujoco


def mujoco_model_from_mjcf_text(text: str) -> Any:
    """Compile MJCF text to a `mujoco.MjModel`. Raises `ModelError` if MuJoCo rejects it."""
    try:
        return import_mujoco().MjModel.from_xml_string(text)
    except ValueError as error:
        what, hint = f"MuJoCo does not accept the model: {error}", "correct the named element of the model"
        raise ModelError(what, where="MJCF text", allowed="MJCF that MuJoCo compiles", hint=hint) from error


def _refuse_inexpressible(system: System, value: CasadiEvaluator, standalone: bool) -> None:
    lacking = _INEXPRESSIBLE_ASPECTS if standalone else _INEXPRESSIBLE_ASPECTS | MUJOCO_APPROXIMATED_ASPECTS
    for effect in system.effects:
        if aspects := effect_joint_terms_and_changed_aspects(system, effect, value)[1] & lacking:
            changed = elements_by_aspect_and_file_format()[min(aspects)]["is"]
            what = f"MuJoCo cannot express what the effect changes: {changed}"
            where, allowed = f"effect '{effect.label}'", "effects that docs/howto/export.md lists"
            hint = "leave the effect out of model.effects or model.friction"
            raise ModelError(what, where=where, allowed=allowed, hint=hint)
    for grasp in system.grasps:
        if not value._is_zero_at_parameter_values(grasp.compliance) and not (standalone and grasp.kind == "point"):
            allowed = "rigid grasps" if not standalone else "rigid grasps, or compliant grasps of the kind point"
            what = f"MuJoCo has no {'exact ' * (not standalone)}term for a compliant grasp of the kind {grasp.kind}"
            hint = f"leave out the effect grasp_compliance@{grasp.name}"
            raise ModelError(what, where=f"grasp '{grasp.name}'", allowed=allowed, hint=hint)
    for joint, compliance in system.joint_compliances.items():
        if value._is_zero_at_parameter_values(compliance):
            what = f"the compliance of joint '{joint}' is zero, an infinite stiffness, which MuJoCo cannot express"
            hint = "leave out the effect that adds the compliance (model.effects)"
            raise ModelError(what, where=f"joint '{joint}'", allowed="a compliance above zero", hint=hint)
    for joint, servo in system.servos.items():
        if not value._is_zero_at_parameter_values(servo.dead_band):
            key, what = f"parameters.{joint}.servo_dead_band.initial", f"servo '{joint}' has a dead band, MuJoCo none"
            raise ModelError(what, where=key, allowed="0", hint=f"add --set {key}=0")


def _shares_body(tree: Mechanism, j: int) -> bool:
    """Whether joint j shares a body with its parent joint: same location, and a massless link without other joints."""
    joint = tree.joints[j]
    if joint.parent_index < 0 or merge_inertias(tree.joints[joint.parent_index].bodies) is not None:
        return False
    alone = sum(other.parent_index == joint.parent_index for other in tree.joints) == 1
    return alone and bool(np.array_equal(np.array(ca.DM(joint.placement.homogeneous_matrix())), np.eye(4)))


def _sites(system: System, tree: Mechanism, value: CasadiEvaluator) -> list[tuple[str, Frame]]:
    sites = [(name, tree.frame(name)) for name in system.point_frames]
    for grasp in system.grasps:
        holder, held = tree.frame(grasp.holder_frame), tree.frame(grasp.held_frame)
        rotation = value(grasp.held_orientation).reshape(3, 3, order="F")
        ends = {
            "holder": (holder, Placement(ca.SX(ca.DM(rotation)), ca.SX(ca.DM(value(grasp.holder_offset))))),
            "held": (held, _along(-value(grasp.axial_slip)[0])),
        }
        for end, (frame, local) in ends.items():
            name, placement = f"grasp_{grasp.name}_{end}", frame.placement @ local
            sites.append((name, Frame(frame.joint_index, placement)))
            if grasp.kind == "axis":
                sites.append((f"{name}_ahead", Frame(frame.joint_index, placement @ _along(_AXIS_LEVER))))
    return sites


def _along(z: float) -> Placement:
    return Placement(ca.SX(ca.DM.eye(3)), ca.SX(ca.DM([0.0, 0.0, float(z)])))


def _pose(placement: Placement) -> dict[str, str]:
    x, y, z, w = Rotation.from_matrix(np.array(ca.DM(placement.rotation))).as_quat()
    place = np.array(ca.DM(placement.translation)).ravel()
    return {"pos": format_xml_numbers(place), "quat": format_xml_numbers([w, x, y, z])}


def _inertial(body: Inertia) -> dict[str, str]:
    tensor = np.array(ca.DM(body.inertia_about_com))
    full = [tensor[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    com = np.array(ca.DM(body.center_of_mass)).ravel().tolist()
    numbers = {"pos": com, "mass": [float(body.mass)], "fullinertia": full}
    return {name: format_xml_numbers(values) for name, values in numbers.items()}


def format_xml_numbers(numbers: Iterable[float]) -> str:
    """Format numbers with all their digits, separated by spaces, for an XML attribute."""
    return " ".join(f"{float(number):.17g}" for number in numbers)

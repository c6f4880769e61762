"""A system as a MuJoCo model (MJCF), for virtual experiments and for export."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping
from dataclasses import replace
from types import ModuleType
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from yid_ocp.errors import ConfigError, DataError, ModelError
from yid_ocp.model.mechanism import Frame, Inertia, Joint, Mechanism, Placement, merge_bodies
from yid_ocp.model.servos_and_springs import TORQUE_LIMIT_POWER, UNLIMITED_EFFORT
from yid_ocp.model.system import System
from yid_ocp.virtual.rigid_body_terms import (
    MODEL_ASPECTS,
    JointDynamics,
    ParameterEvaluator,
    actuator_responses,
    effect_terms_and_aspects,
    joint_dynamics,
)

Array = NDArray[np.float64]

_NATIVE_ASPECTS = frozenset(
    {
        *("stiffness", "rest", "damping", "geometry", "inertia", "weight"),
        *("gravity", "grasp", "sprung_joint", "armature", "cubic_stiffness", "servo"),
    }
)
"""Aspects of an effect for which MuJoCo has an equivalent term."""
EMULATED_ASPECTS = frozenset({"dry_friction", "grasp_compliance"})
"""Aspects that MuJoCo can only approximate."""
_IGNORED_ASPECTS = frozenset({"reading", "torque_gain", "torque_offset", "torque_delay", "torque_lag"})
"""Aspects of sensors and recorded torques that do not enter the mechanics."""

_JOINTS_PER_BODY = 6  # as many as MuJoCo allows
_ROTOR = 5e-4  # [kg m^2] of a motor behind play, as little as lets it rest at a stop
_AXIS_LEVER = 0.1  # [m] between the two points that keep two axes parallel


def mujoco_xml(
    system: System,
    values: Mapping[str, float] | None = None,
    *,
    time_step: float = 5e-4,
    integrator: str = "implicitfast",
    emulate: bool = False,
    actuators: bool = False,
    gear_play: Mapping[str, float] | None = None,
) -> str:
    """The MJCF text of a system.

    Joints keep their names. Consecutive joints that carry no mass and sit at one place become one body with several
    joints, which is the same kinematics. Every point and every end of a grasp is a site: points under their own name,
    grasps as `grasp_NAME_holder` and `grasp_NAME_held`. There are no contacts or limits. All stands in one body
    `world_base` that does not move, since some readers take no more than one root.

    Parameters
    ----------
    system : System
    values : mapping of str to float, optional
        Parameter values by name; nominal where absent.
    time_step : float
        Of the simulator [s]; grasps are held with a time constant of two steps.
    integrator : str
        `implicitfast`, `implicit`, `Euler` or `RK4`; the twist of a thin tube has a damping time of some 10 us,
        which an explicit one cannot follow.
    emulate : bool
        Whether approximations are allowed: sticking dry friction for a smoothed one, a tendon for a compliant point
        grasp. Refused otherwise.
    actuators : bool
        Whether every driven joint has an actuator of its name whose control is the recorded torque, with gain, offset,
        delay and lag between that and the torque that acts; without, true torques go in as `qfrc_applied`. A servo
        always is an actuator, whose control is the command.
    gear_play : mapping of joint name to float, optional
        Backlash of gears, full width [rad]: the joint is then the motor's side, and a joint `NAME_play` follows it.

    Returns
    -------
    str
        XML text.

    Raises
    ------
    ModelError
        What MuJoCo cannot express: a moving body without mass, more than six massless joints at one place, a frame on
        one of them, a compliant grasp, a cubic spring beside a rest angle, an effect beyond `_NATIVE_ASPECTS`.
    ConfigError
        Unknown parameter, or `time_step` not positive.
    """
    if not time_step > 0:
        raise ConfigError(f"time_step = {time_step}", where="mujoco_xml", allowed="a positive number of seconds")
    tree, weights = _weighed(replace(system.mechanism, parameters=system.parameters).with_numeric_values(values))
    value = ParameterEvaluator(system, values)
    _refuse_inexpressible(system, value, emulate)

    root = ElementTree.Element("mujoco", model=tree.name)
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="false", inertiafromgeom="false")
    option = ElementTree.SubElement(
        root,
        "option",
        timestep=_text([time_step]),
        integrator=integrator,
        gravity=_text(value(system.gravity)),
        iterations="100",
        tolerance="1e-14",
        jacobian="dense",  # the Newton solver of MuJoCo 4.0 does not converge on fine chains in its sparse form
    )
    ElementTree.SubElement(option, "flag", contact="disable")
    sites = _sites(system, tree, value)
    base = ElementTree.SubElement(ElementTree.SubElement(root, "worldbody"), "body", name="world_base")
    ElementTree.SubElement(base, "inertial", pos="0 0 0", mass="0", diaginertia="0 0 0")  # Pinocchio asks for one
    gears = {name: _play_attributes(width, time_step) for name, width in (gear_play or {}).items()}
    elements = _bodies(tree, weights, joint_dynamics(system, value), sites, base, gears)
    for name, frame in sites:
        ElementTree.SubElement(elements[frame.joint_index], "site", {"name": name, **_pose(frame.placement)})
    _add_grasps(system, value, root, time_step)
    if actuators or system.servos:
        _add_actuators(system, value, ElementTree.SubElement(root, "actuator"), time_step)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _bodies(
    tree: Mechanism,
    weights: Mapping[str, float],
    terms: Mapping[str, JointDynamics],
    sites: list[tuple[str, Frame]],
    world: ElementTree.Element,
    gears: Mapping[str, Mapping[str, str]],
) -> dict[int, ElementTree.Element]:
    """Add bodies with their joints and masses; the body of every joint by its index, -1 for the world.

    `gears` has attributes of the joint between a motor and what it moves, by the motor's joint.
    """
    carried = {frame.joint_index: name for name, frame in reversed(sites)}
    elements: dict[int, ElementTree.Element] = {-1: world}
    for j, joint in enumerate(tree.joints):
        if _shares_body(tree, j):
            elements[j] = elements[joint.parent_index]
            if joint.parent_index in carried:
                what = f"frame '{carried[joint.parent_index]}' sits on a joint that carries no mass"
                raise ModelError(what, where=f"joint {joint.name}")
        else:
            elements[j] = ElementTree.SubElement(
                elements[joint.parent_index], "body", {"name": f"{joint.name}_body", **_pose(joint.placement)}
            )
        attributes = _joint_attributes(joint, terms.get(joint.name, JointDynamics()))
        moved = ElementTree.SubElement(elements[j], "joint", attributes)
        if joint.name in gears:
            motor, name = elements[j], joint.name
            motor.set("name", f"{name}_motor")
            moved.attrib.setdefault("armature", _text([_ROTOR]))
            ElementTree.SubElement(motor, "inertial", pos="0 0 0", mass="1e-6", diaginertia="1e-9 1e-9 1e-9")
            elements[j] = ElementTree.SubElement(motor, "body", {"name": f"{name}_body"})
            kind = {"name": f"{name}_play", "type": attributes["type"], "axis": attributes["axis"]}
            ElementTree.SubElement(elements[j], "joint", {**kind, **gears[name]})
        if len(elements[j].findall("joint")) > _JOINTS_PER_BODY:
            raise ModelError(
                "more than six joints without mass sit at one place",
                where=f"joint {joint.name}",
                allowed="up to six; a body with mass on the last of them",
            )
        body = merge_bodies(joint.bodies)
        if body is not None:
            if joint.name in weights:
                elements[j].set("gravcomp", _text([1 - weights[joint.name]]))
            ElementTree.SubElement(elements[j], "inertial", _inertial(body))
        elif not any(_shares_body(tree, k) and tree.joints[k].parent_index == j for k in range(len(tree.joints))):
            raise ModelError(
                f"nothing that '{joint.name}' moves has a mass",
                where=f"joint {joint.name}",
                allowed="a body with mass on every joint, or several joints at one place with a body on the last",
            )
    return elements


def _weighed(tree: Mechanism) -> tuple[Mechanism, dict[str, float]]:
    """The tree with bodies of their whole weight, and by joint the part of it that those have which have not all."""
    weights: dict[str, float] = {}
    for joint in tree.joints:
        shares = {1.0 if body.gravity_fraction is None else float(body.gravity_fraction) for body in joint.bodies}
        if len(shares) > 1:
            what = f"bodies on '{joint.name}' have different parts of their weight"
            raise ModelError(what, where="mujoco_xml", allowed="one part of its weight for all that a joint carries")
        weights |= dict.fromkeys([joint.name] if shares - {1.0} else [], next(iter(shares), 1.0))
    joints = tuple(replace(j, bodies=tuple(replace(b, gravity_fraction=None) for b in j.bodies)) for j in tree.joints)
    return replace(tree, joints=joints), weights


def _joint_attributes(joint: Joint, terms: JointDynamics) -> dict[str, str]:
    attributes = {"name": joint.name, "axis": _text(joint.axis), "damping": _text([terms.damping])}
    attributes["type"] = "hinge" if joint.kind == "revolute" else "slide"
    if terms.stiffness > 0:
        attributes["stiffness"] = _text([terms.stiffness])
        attributes["springref"] = _text([terms.constant_force / terms.stiffness])
    if terms.cubic_stiffness:
        if terms.constant_force or not hasattr(import_mujoco().MjModel, "jnt_stiffnesspoly"):
            what = f"the spring at '{joint.name}' has a cubic part"
            allowed = "none beside a rest angle, and MuJoCo with polynomial stiffness (3.6 or newer)"
            raise ModelError(what, where="mujoco_xml", allowed=allowed)
        attributes["stiffness"] = _text([terms.stiffness, 0.0, terms.cubic_stiffness])
    if terms.armature:
        attributes["armature"] = _text([terms.armature])
    if terms.dry_friction:
        attributes["frictionloss"] = _text([terms.dry_friction])
    return attributes


def _play_attributes(width: float, time_step: float) -> dict[str, str]:
    """A joint with stops at half the width either way."""
    ends = {"limited": "true", "range": _text([-width / 2, width / 2])}
    return {**ends, "solreflimit": _text([5 * time_step, 1.0]), "solimplimit": "0.99 0.999 0.0001 0.5 2"}


def _add_grasps(system: System, value: ParameterEvaluator, root: ElementTree.Element, time_step: float) -> None:
    equality = ElementTree.SubElement(root, "equality")
    firm = {"solref": _text([2 * time_step, 1.0]), "solimp": "0.9999 0.9999 0.001 0.5 2"}
    for grasp in system.grasps:
        ends = [f"grasp_{grasp.name}_{end}" for end in ("holder", "held")]
        compliance = float(value(grasp.compliance)[0])
        if compliance > 0:
            # a tendon of no length pulls with its stiffness, and damps, along the line between both ends
            relaxation = 0.0 if grasp.relaxation_time is None else float(value(grasp.relaxation_time)[0])
            sizes = {"stiffness": _text([1 / compliance]), "damping": _text([relaxation / compliance])}
            tendons = root.find("tendon")
            tendons = ElementTree.SubElement(root, "tendon") if tendons is None else tendons
            spring = ElementTree.SubElement(
                tendons, "spatial", {"name": f"grasp_{grasp.name}", "springlength": "0", **sizes}
            )
            for end in ends:
                ElementTree.SubElement(spring, "site", site=end)
            continue
        kind = "weld" if grasp.kind == "weld" else "connect"
        for suffix in ("", "_ahead") if grasp.kind == "axis" else ("",):
            sites = {"site1": ends[0] + suffix, "site2": ends[1] + suffix}
            ElementTree.SubElement(equality, kind, {"name": f"grasp_{grasp.name}{suffix}", **sites, **firm})


def _add_actuators(system: System, value: ParameterEvaluator, actuator: ElementTree.Element, time_step: float) -> None:
    """Actuators from recorded torques to those that act, and position servos."""
    for joint, found in actuator_responses(system, value).items():
        attributes, servo = {"name": joint, "joint": joint}, system.servos.get(joint)
        gain, bias, delay, between = found.gain, [-found.subtracted_offset, 0.0, 0.0], found.delay, "linear"
        if servo is not None:
            own, damping, late, tightness = (float(value(x)[0]) for x in servo.coefficients)
            gain, bias, delay = own * gain, [own * bias[0], -own, -damping], delay + late
            between = "zoh" if servo.command_interpolation == "held" else "linear"
            limit = tightness ** (-1 / TORQUE_LIMIT_POWER) if tightness > 0 else math.inf
            if limit < UNLIMITED_EFFORT:
                attributes |= {"forcelimited": "true", "forcerange": _text([-limit, limit])}
        attributes["gainprm"] = _text([gain])
        if any(bias):
            attributes |= {"biastype": "affine", "biasprm": _text(bias)}
        if found.lag_time > 0:
            attributes |= {"dyntype": "filterexact", "dynprm": _text([found.lag_time])}
        if delay > 0:
            if not hasattr(import_mujoco().MjModel, "actuator_delay"):
                what, allowed = f"the torque of '{joint}' acts late", "MuJoCo with delays of actuators (3.5 or newer)"
                raise ModelError(what, where="mujoco_xml", allowed=allowed)
            samples = math.ceil(delay / time_step) + 1
            attributes |= {"delay": _text([delay]), "nsample": str(samples), "interp": between}
        ElementTree.SubElement(actuator, "general", attributes)


def import_mujoco() -> ModuleType:
    """The imported mujoco package; `DataError` if it is not installed."""
    try:
        import mujoco
    except ImportError as error:
        raise DataError(
            "virtual experiments need MuJoCo, which is not installed", hint="pip install 'yid-ocp[blind]'"
        ) from error
    return mujoco


def compile_mjcf(text: str) -> Any:
    """A `mujoco.MjModel` compiled from MJCF text; `ModelError` if MuJoCo rejects it."""
    try:
        return import_mujoco().MjModel.from_xml_string(text)
    except ValueError as error:
        raise ModelError(f"MuJoCo does not accept the model: {error}", where="mujoco_xml") from error


def _refuse_inexpressible(system: System, value: ParameterEvaluator, emulate: bool) -> None:
    able = _NATIVE_ASPECTS | EMULATED_ASPECTS if emulate else _NATIVE_ASPECTS
    for effect in system.effects:
        for aspect in sorted(effect_terms_and_aspects(system, effect, value)[1] - able - _IGNORED_ASPECTS):
            raise ModelError(
                f"effect '{effect.kind}@{effect.location}' has what MuJoCo cannot express: {MODEL_ASPECTS[aspect]}",
                where="mujoco_xml",
                allowed="effects that change "
                + ", ".join(MODEL_ASPECTS[name] for name in MODEL_ASPECTS if name in able),
            )
    for grasp in system.grasps:
        if not value.is_zero(grasp.compliance) and not (emulate and grasp.kind == "point"):
            allowed = "rigid grasps" if not emulate else "rigid grasps, and springs in place of point grasps"
            raise ModelError(f"grasp '{grasp.name}' is compliant", where="mujoco_xml", allowed=allowed)
    for joint, compliance in system.joint_compliances.items():
        if value.is_zero(compliance):
            allowed, hint = "a compliance above zero", "leave the effect out"
            raise ModelError(f"joint '{joint}' is rigid", where="mujoco_xml", allowed=allowed, hint=hint)
    if not value.is_zero(system.recorded_time_scale - 1):
        raise ModelError("the clock is scaled", where="mujoco_xml", allowed="a clock that tells the true time")


def _shares_body(tree: Mechanism, j: int) -> bool:
    """Whether joint j turns at the same place as its parent, which carries nothing but it."""
    joint = tree.joints[j]
    if joint.parent_index < 0 or merge_bodies(tree.joints[joint.parent_index].bodies) is not None:
        return False
    alone = sum(other.parent_index == joint.parent_index for other in tree.joints) == 1
    return alone and bool(np.array_equal(np.array(ca.DM(joint.placement.homogeneous_matrix())), np.eye(4)))


def _sites(system: System, tree: Mechanism, value: ParameterEvaluator) -> list[tuple[str, Frame]]:
    sites = [(name, tree.frame(name)) for name in system.point_frames]
    for grasp in system.grasps:
        holder, held = tree.frame(grasp.holder_frame), tree.frame(grasp.held_frame)
        rotation = value(grasp.held_orientation).reshape(3, 3, order="F")
        ends = {
            "holder": (holder, Placement(ca.SX(ca.DM(rotation)), ca.SX(ca.DM(value(grasp.holder_offset))))),
            "held": (held, _along(-value(grasp.axial_slip)[0])),
        }
        for end, (frame, local) in ends.items():
            placement = frame.placement @ local
            sites.append((f"grasp_{grasp.name}_{end}", Frame(frame.joint_index, placement)))
            if grasp.kind == "axis":
                sites.append(
                    (f"grasp_{grasp.name}_{end}_ahead", Frame(frame.joint_index, placement @ _along(_AXIS_LEVER)))
                )
    return sites


def _along(z: float) -> Placement:
    return Placement(ca.SX(ca.DM.eye(3)), ca.SX(ca.DM([0.0, 0.0, float(z)])))


def _pose(placement: Placement) -> dict[str, str]:
    x, y, z, w = Rotation.from_matrix(np.array(ca.DM(placement.rotation))).as_quat()
    return {"pos": _text(np.array(ca.DM(placement.translation)).ravel()), "quat": _text([w, x, y, z])}


def _inertial(body: Inertia) -> dict[str, str]:
    tensor = np.array(ca.DM(body.inertia_about_com))
    full = [tensor[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    com = np.array(ca.DM(body.center_of_mass)).ravel()
    return {"pos": _text(com), "mass": _text([float(body.mass)]), "fullinertia": _text(full)}


def _text(numbers: Iterable[float]) -> str:
    return " ".join(f"{float(number):.17g}" for number in numbers)

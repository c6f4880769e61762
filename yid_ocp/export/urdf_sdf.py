"""Export of a system's kinematic tree as URDF or SDF: links, joints with their dynamics, inertias, frames."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping
from dataclasses import replace

import casadi as ca
import numpy as np

from yid_ocp.model.mechanism import Inertia, Joint, Mechanism, Placement, merge_bodies
from yid_ocp.model.rotations import rpy_from_rotation
from yid_ocp.model.system import System
from yid_ocp.model.urdf import mechanism_to_urdf
from yid_ocp.virtual.rigid_body_terms import JointDynamics, ParameterEvaluator, joint_dynamics

_MIN_LINK_MASS, _MIN_LINK_INERTIA = 1e-9, 1e-12
"""Mass [kg] and inertia [kg m^2] given to massless links, for engines that require them."""


def system_to_urdf(system: System, values: Mapping[str, float]) -> str:
    """The URDF text of a system: joints with damping and friction, links with inertias; no springs, no grasps.

    A `mujoco` element gives MuJoCo the least masses that it asks for; others read over it.

    Parameters
    ----------
    system : System
    values : mapping of parameter name to value

    Returns
    -------
    str
        XML text.
    """
    tree, terms = _tree(system, values)
    root = ElementTree.fromstring(mechanism_to_urdf(tree))
    mujoco = ElementTree.Element("mujoco")
    sizes = {"boundmass": _text([_MIN_LINK_MASS]), "boundinertia": _text([_MIN_LINK_INERTIA]), "fusestatic": "false"}
    ElementTree.SubElement(mujoco, "compiler", sizes)
    root.insert(0, mujoco)
    for joint in root.findall("joint"):
        own = terms.get(joint.get("name", ""))
        if own is not None and joint.get("type") != "fixed":
            ElementTree.SubElement(
                joint, "dynamics", {"damping": _text([own.damping]), "friction": _text([own.dry_friction])}
            )
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def system_to_sdf(system: System, values: Mapping[str, float]) -> str:
    """The SDF world text of a system: joints with springs, damping, friction, links with inertias; no grasps.

    Parameters
    ----------
    system : System
    values : mapping of parameter name to value

    Returns
    -------
    str
        XML text of SDF 1.10.
    """
    tree, terms = _tree(system, values)
    root = ElementTree.Element("sdf", version="1.10")
    world = ElementTree.SubElement(root, "world", name="world")
    gravity = ElementTree.SubElement(world, "gravity")
    gravity.text = _text(ParameterEvaluator(system, values)(system.gravity))
    model = ElementTree.SubElement(world, "model", name="model")
    for i, joint in enumerate(tree.joints):
        _sdf_link(model, tree, i)
        _sdf_joint(model, tree, joint, terms.get(joint.name, JointDynamics()))
    for name, frame in tree.frames.items():
        on = "world" if frame.joint_index < 0 else f"{tree.joints[frame.joint_index].name}_link"
        # what stands in the world is placed from the model, which stands at its origin
        attached = {} if frame.joint_index < 0 else {"attached_to": on}
        element = ElementTree.SubElement(model, "frame", {"name": f"frame_{name}", **attached})
        _sdf_pose(element, frame.placement)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _tree(system: System, values: Mapping[str, float]) -> tuple[Mechanism, dict[str, JointDynamics]]:
    """The tree in numbers, its bodies without weights of their own, and what its joints have."""
    tree = replace(system.mechanism, parameters=system.parameters).with_numeric_values(values)
    joints = tuple(
        replace(joint, bodies=tuple(replace(body, gravity_fraction=None) for body in joint.bodies))
        for joint in tree.joints
    )
    return replace(tree, joints=joints), joint_dynamics(system, ParameterEvaluator(system, values))


def _sdf_link(model: ElementTree.Element, tree: Mechanism, index: int) -> None:
    joint = tree.joints[index]
    link = ElementTree.SubElement(model, "link", name=f"{joint.name}_link")
    above = {} if joint.parent_index < 0 else {"relative_to": f"{tree.joints[joint.parent_index].name}_link"}
    _sdf_pose(link, joint.placement, above)
    body = merge_bodies(joint.bodies)
    if body is None:
        body = Inertia.from_values(_MIN_LINK_MASS, np.zeros(3), _MIN_LINK_INERTIA * np.eye(3))
    inertial = ElementTree.SubElement(link, "inertial")
    _sdf_pose(inertial, Placement(ca.SX(ca.DM.eye(3)), body.center_of_mass))
    _sdf_number(inertial, "mass", float(body.mass))
    tensor, inertia = np.array(ca.DM(body.inertia_about_com)), ElementTree.SubElement(inertial, "inertia")
    for key, at in {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}.items():
        _sdf_number(inertia, key, tensor[at])


def _sdf_joint(model: ElementTree.Element, tree: Mechanism, joint: Joint, terms: JointDynamics) -> None:
    element = ElementTree.SubElement(model, "joint", name=joint.name, type=joint.kind)
    parent = "world" if joint.parent_index < 0 else f"{tree.joints[joint.parent_index].name}_link"
    for tag, text in (("parent", parent), ("child", f"{joint.name}_link")):
        ElementTree.SubElement(element, tag).text = text
    axis = ElementTree.SubElement(element, "axis")
    ElementTree.SubElement(axis, "xyz").text = _text(joint.axis)
    limit = ElementTree.SubElement(axis, "limit")
    sizes = {
        "lower": joint.lower_limit,
        "upper": joint.upper_limit,
        "effort": joint.effort_limit,
        "velocity": joint.velocity_limit,
    }
    for key, size in sizes.items():
        if math.isfinite(size):
            _sdf_number(limit, key, size)
    dynamics = ElementTree.SubElement(axis, "dynamics")
    _sdf_number(dynamics, "damping", terms.damping)
    _sdf_number(dynamics, "friction", terms.dry_friction)
    if terms.stiffness > 0:
        _sdf_number(dynamics, "spring_reference", terms.constant_force / terms.stiffness)
        _sdf_number(dynamics, "spring_stiffness", terms.stiffness)


def _sdf_pose(element: ElementTree.Element, placement: Placement, attributes: Mapping[str, str] | None = None) -> None:
    turn, at = np.array(ca.DM(placement.rotation)), np.array(ca.DM(placement.translation)).ravel()
    pose = ElementTree.SubElement(element, "pose", dict(attributes or {}))
    pose.text = _text([*at, *rpy_from_rotation(turn)])


def _sdf_number(element: ElementTree.Element, tag: str, value: float) -> None:
    ElementTree.SubElement(element, tag).text = _text([value])


def _text(numbers: Iterable[float]) -> str:
    return " ".join(f"{float(number):.17g}" for number in numbers)

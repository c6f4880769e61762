"""Export of a system's kinematic tree as URDF or SDF: links, joints with their dynamics, inertias, frames."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping
from dataclasses import replace

import casadi as ca
import numpy as np

from yid_ocp.model.mechanism import Inertia, Joint, Mechanism, Placement, merged
from yid_ocp.model.rotations import angles_of
from yid_ocp.model.system import System
from yid_ocp.model.urdf import urdf_text
from yid_ocp.virtual.terms import Evaluator, JointTerms, joint_terms

LEAST_MASS, LEAST_INERTIA = 1e-9, 1e-12
"""Mass [kg] and inertia [kg m^2] given to massless links, for engines that require them."""


def urdf_model(system: System, values: Mapping[str, float]) -> str:
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
    root = ElementTree.fromstring(urdf_text(tree))
    mujoco = ElementTree.Element("mujoco")
    sizes = {"boundmass": _text([LEAST_MASS]), "boundinertia": _text([LEAST_INERTIA]), "fusestatic": "false"}
    ElementTree.SubElement(mujoco, "compiler", sizes)
    root.insert(0, mujoco)
    for joint in root.findall("joint"):
        own = terms.get(joint.get("name", ""))
        if own is not None and joint.get("type") != "fixed":
            ElementTree.SubElement(
                joint, "dynamics", {"damping": _text([own.damping]), "friction": _text([own.friction])}
            )
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def sdf_model(system: System, values: Mapping[str, float]) -> str:
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
    gravity.text = _text(Evaluator(system, values)(system.gravity))
    model = ElementTree.SubElement(world, "model", name="model")
    for i, joint in enumerate(tree.joints):
        _sdf_link(model, tree, i)
        _sdf_joint(model, tree, joint, terms.get(joint.name, JointTerms()))
    for name, frame in tree.frames.items():
        on = "world" if frame.joint < 0 else f"{tree.joints[frame.joint].name}_link"
        # what stands in the world is placed from the model, which stands at its origin
        attached = {} if frame.joint < 0 else {"attached_to": on}
        element = ElementTree.SubElement(model, "frame", {"name": f"frame_{name}", **attached})
        _sdf_pose(element, frame.placement)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _tree(system: System, values: Mapping[str, float]) -> tuple[Mechanism, dict[str, JointTerms]]:
    """The tree in numbers, its bodies without weights of their own, and what its joints have."""
    tree = replace(system.mechanism, parameters=system.parameters).numeric(values)
    joints = tuple(
        replace(joint, bodies=tuple(replace(body, gravity_fraction=None) for body in joint.bodies))
        for joint in tree.joints
    )
    return replace(tree, joints=joints), joint_terms(system, Evaluator(system, values))


def _sdf_link(model: ElementTree.Element, tree: Mechanism, index: int) -> None:
    joint = tree.joints[index]
    link = ElementTree.SubElement(model, "link", name=f"{joint.name}_link")
    above = {} if joint.parent < 0 else {"relative_to": f"{tree.joints[joint.parent].name}_link"}
    _sdf_pose(link, joint.placement, above)
    body = merged(joint.bodies)
    if body is None:
        body = Inertia.of(LEAST_MASS, np.zeros(3), LEAST_INERTIA * np.eye(3))
    inertial = ElementTree.SubElement(link, "inertial")
    _sdf_pose(inertial, Placement(ca.SX(ca.DM.eye(3)), body.com))
    _sdf_number(inertial, "mass", float(body.mass))
    tensor, inertia = np.array(ca.DM(body.about_com)), ElementTree.SubElement(inertial, "inertia")
    for key, at in {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}.items():
        _sdf_number(inertia, key, tensor[at])


def _sdf_joint(model: ElementTree.Element, tree: Mechanism, joint: Joint, terms: JointTerms) -> None:
    element = ElementTree.SubElement(model, "joint", name=joint.name, type=joint.kind)
    parent = "world" if joint.parent < 0 else f"{tree.joints[joint.parent].name}_link"
    for tag, text in (("parent", parent), ("child", f"{joint.name}_link")):
        ElementTree.SubElement(element, tag).text = text
    axis = ElementTree.SubElement(element, "axis")
    ElementTree.SubElement(axis, "xyz").text = _text(joint.axis)
    limit = ElementTree.SubElement(axis, "limit")
    sizes = {"lower": joint.lower, "upper": joint.upper, "effort": joint.effort_limit, "velocity": joint.velocity_limit}
    for key, size in sizes.items():
        if math.isfinite(size):
            _sdf_number(limit, key, size)
    dynamics = ElementTree.SubElement(axis, "dynamics")
    _sdf_number(dynamics, "damping", terms.damping)
    _sdf_number(dynamics, "friction", terms.friction)
    if terms.stiffness > 0:
        _sdf_number(dynamics, "spring_reference", terms.pull / terms.stiffness)
        _sdf_number(dynamics, "spring_stiffness", terms.stiffness)


def _sdf_pose(element: ElementTree.Element, placement: Placement, attributes: Mapping[str, str] | None = None) -> None:
    turn, at = np.array(ca.DM(placement.rotation)), np.array(ca.DM(placement.translation)).ravel()
    pose = ElementTree.SubElement(element, "pose", dict(attributes or {}))
    pose.text = _text([*at, *angles_of(turn)])


def _sdf_number(element: ElementTree.Element, tag: str, value: float) -> None:
    ElementTree.SubElement(element, tag).text = _text([value])


def _text(numbers: Iterable[float]) -> str:
    return " ".join(f"{float(number):.17g}" for number in numbers)

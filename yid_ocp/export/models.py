"""Export of a system as URDF or SDF, and how well a format supports its parameters and effects."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args
from xml.etree.ElementTree import Element, SubElement

import casadi as ca
import numpy as np

from yid_ocp.model.mechanism import Inertia, Joint, Mechanism, Placement, merge_inertias, rpy_from_rotation
from yid_ocp.model.system import System
from yid_ocp.model.urdf import INERTIA_TENSOR_KEYS, mechanism_to_urdf
from yid_ocp.virtual import mjcf

EXPORT_MANIFEST_FORMAT = "yid-export/1"
_SupportStatus = Literal["native", "emulated", "not representable"]
_MIN_LINK_MASS, _MIN_LINK_INERTIA = 1e-9, 1e-12
"""Mass [kg] and inertia [kg m^2] given to massless links, for engines that require them."""


def system_to_urdf(system: System, values: Mapping[str, float]) -> str:
    """Convert a system with parameter `values` by name to URDF text. Springs and grasps are omitted.

    A `mujoco` element sets the minimum masses that MuJoCo requires. Other readers of URDF ignore it.
    """
    tree, terms = _tree(system, values)
    root = ElementTree.fromstring(mechanism_to_urdf(tree))
    sizes = {"boundmass": _MIN_LINK_MASS, "boundinertia": _MIN_LINK_INERTIA}
    mujoco = Element("mujoco")
    limits = {key: mjcf.format_xml_numbers([value]) for key, value in sizes.items()}
    SubElement(mujoco, "compiler", {**limits, "fusestatic": "false"})
    root.insert(0, mujoco)
    for joint in root.findall("joint"):
        own = terms.get(joint.get("name", ""))
        if own is not None and joint.get("type") != "fixed":
            sizes = {"damping": own.damping, "friction": own.dry_friction}
            SubElement(joint, "dynamics", {key: mjcf.format_xml_numbers([value]) for key, value in sizes.items()})
    return _xml_text(root)


def system_to_sdf(system: System, values: Mapping[str, float]) -> str:
    """Convert a system to an SDF 1.10 world with springs, damping and friction in the joints. Grasps are omitted."""
    tree, terms = _tree(system, values)
    root = Element("sdf", version="1.10")
    world = SubElement(root, "world", name="world")
    SubElement(world, "gravity").text = mjcf.format_xml_numbers(mjcf.CasadiEvaluator(system, values)(system.gravity))
    model = SubElement(world, "model", name="model")
    for i, joint in enumerate(tree.joints):
        _sdf_link(model, tree, i)
        _sdf_joint(model, tree, joint, terms.get(joint.name, mjcf.JointDynamicsTerms()))
    for name, frame in tree.frames.items():
        # frames of the world are placed in the model frame, which is at the world's origin
        attached = {} if frame.joint_index < 0 else {"attached_to": f"{tree.joints[frame.joint_index].name}_link"}
        _sdf_pose(SubElement(model, "frame", {"name": f"frame_{name}", **attached}), frame.placement)
    return _xml_text(root)


def _xml_text(root: Element) -> str:
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _tree(system: System, values: Mapping[str, float]) -> tuple[Mechanism, dict[str, mjcf.JointDynamicsTerms]]:
    """Return the mechanism with numbers and without separate weights of bodies, and the dynamics of its joints."""
    tree = system.mechanism_with_values(values).with_gravity_fraction(ca.SX(1))
    return tree, mjcf.system_joint_dynamics_terms(system, mjcf.CasadiEvaluator(system, values))


def _sdf_link(model: Element, tree: Mechanism, index: int) -> None:
    joint = tree.joints[index]
    link = SubElement(model, "link", name=f"{joint.name}_link")
    above = {} if joint.parent_index < 0 else {"relative_to": f"{tree.joints[joint.parent_index].name}_link"}
    _sdf_pose(link, joint.placement, above)
    body = merge_inertias(joint.bodies)
    if body is None:
        body = Inertia.from_values(_MIN_LINK_MASS, np.zeros(3), _MIN_LINK_INERTIA * np.eye(3))
    inertial = SubElement(link, "inertial")
    _sdf_pose(inertial, Placement(ca.SX(ca.DM.eye(3)), body.center_of_mass))
    _add_numbers(inertial, {"mass": float(body.mass)})
    tensor = np.array(ca.DM(body.inertia_about_com))
    _add_numbers(SubElement(inertial, "inertia"), {key: tensor[at] for key, at in INERTIA_TENSOR_KEYS.items()})


def _sdf_joint(model: Element, tree: Mechanism, joint: Joint, terms: mjcf.JointDynamicsTerms) -> None:
    element = SubElement(model, "joint", name=joint.name, type=joint.kind)
    parent = "world" if joint.parent_index < 0 else f"{tree.joints[joint.parent_index].name}_link"
    for tag, text in (("parent", parent), ("child", f"{joint.name}_link")):
        SubElement(element, tag).text = text
    axis = SubElement(element, "axis")
    SubElement(axis, "xyz").text = mjcf.format_xml_numbers(joint.axis)
    limits = {key: getattr(joint, f"{key}_limit") for key in ("lower", "upper", "effort", "velocity")}
    _add_numbers(SubElement(axis, "limit"), {key: size for key, size in limits.items() if math.isfinite(size)})
    sizes = {"damping": terms.damping, "friction": terms.dry_friction}
    if terms.stiffness > 0:
        sizes |= {"spring_reference": terms.constant_force / terms.stiffness, "spring_stiffness": terms.stiffness}
    _add_numbers(SubElement(axis, "dynamics"), sizes)


def _sdf_pose(element: Element, placement: Placement, attributes: Mapping[str, str] | None = None) -> None:
    turn, at = np.array(ca.DM(placement.rotation)), np.array(ca.DM(placement.translation)).ravel()
    SubElement(element, "pose", dict(attributes or {})).text = mjcf.format_xml_numbers([*at, *rpy_from_rotation(turn)])


def _add_numbers(element: Element, values: Mapping[str, float]) -> None:
    for tag, value in values.items():
        SubElement(element, tag).text = mjcf.format_xml_numbers([value])


@dataclass(frozen=True)
class FeatureExportSupport:
    """How a format supports a parameter or effect: the status, and the element that holds it or the reason."""

    status: _SupportStatus
    how: str

    @property
    def loses_motion_or_force(self) -> bool:
        """True if the format omits a feature that changes motion or forces. Effects on sensor readings do not count."""
        return self.status == "not representable" and self != _READING


def _worst(parts: Sequence[FeatureExportSupport]) -> FeatureExportSupport:
    """Return the worst status of several parts, with the explanations of the parts that have it."""
    status = max((part.status for part in parts), key=get_args(_SupportStatus).index)
    return FeatureExportSupport(status, "; ".join(dict.fromkeys(part.how for part in parts if part.status == status)))


def _aspect_support(aspect: str, form: str) -> FeatureExportSupport:
    known = mjcf.elements_by_aspect_and_file_format()[aspect]
    if aspect == "reading":
        return _READING
    if form not in known:
        return FeatureExportSupport("not representable", f"{form.upper()} has no element for {known['is']}")
    return FeatureExportSupport("emulated" if aspect in mjcf.MUJOCO_APPROXIMATED_ASPECTS else "native", known[form])


_READING = FeatureExportSupport(
    "not representable", f"{mjcf.elements_by_aspect_and_file_format()['reading']['is']}. Correct the readings instead"
)
NEUTRAL_EFFECT_SUPPORT = FeatureExportSupport("native", "it changes nothing at this value, so the file omits it")
_UNUSED = FeatureExportSupport("native", "no motion or force of this model depends on it, so nothing is lost")


def export_support_by_effect(system: System, values: Mapping[str, float], form: str) -> dict[str, FeatureExportSupport]:
    """Return by label `kind@location` how well the format `form` (`mjcf`, `urdf` or `sdf`) supports each effect."""
    value, found = mjcf.CasadiEvaluator(system, values), dict[str, FeatureExportSupport]()
    for effect in system.effects:
        if value.is_effect_neutral(effect):
            found[effect.label] = NEUTRAL_EFFECT_SUPPORT
        else:
            _, aspects = mjcf.effect_joint_terms_and_changed_aspects(system, effect, value)
            found[effect.label] = _worst([_aspect_support(x, form) for x in sorted(aspects)])
    return found


def support_in_export_format_by_parameter(
    system: System, effects: Mapping[str, FeatureExportSupport], form: str
) -> dict[str, FeatureExportSupport]:
    """Return how well the format `form` supports each parameter. Parameters of effects share the entry in `effects`."""
    found = {}
    for entry in system.parameters:
        owner = entry.name.rpartition(".")[0]
        aspects = mjcf.model_aspects_depending_on_symbols(system, entry.symbol)
        parts = [_aspect_support(aspect, form) for aspect in sorted(aspects)] or [_UNUSED]
        found[entry.name] = effects[owner] if owner in effects else _worst(parts)
    return found

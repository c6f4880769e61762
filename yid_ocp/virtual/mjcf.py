"""A system as a MuJoCo model, for virtual experiments in an engine that is not ours."""

from __future__ import annotations

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
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.mechanism import Frame, Inertia, Joint, Mechanism, Placement, merged
from yid_ocp.model.system import Effect, MidpointState, System

Array = NDArray[np.float64]

_JOINTS_PER_BODY = 6  # as many as MuJoCo allows
_AXIS_LEVER = 0.1  # [m] between the two points that keep two axes parallel


def mujoco_xml(
    system: System,
    values: Mapping[str, float] | None = None,
    *,
    time_step: float = 5e-4,
    integrator: str = "implicitfast",
) -> str:
    """The system as a MuJoCo model (MJCF).

    Joints keep their names. Consecutive joints that carry no mass and sit at one place become one body with several
    joints, which is the same kinematics. Every point and every end of a grasp is a site: points under their own name,
    grasps as `grasp_NAME_holder` and `grasp_NAME_held`. There are no contacts, limits or actuators: torques go in as
    `qfrc_applied`.

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

    Returns
    -------
    str
        XML text.

    Raises
    ------
    ModelError
        What MuJoCo cannot express: a moving body without mass, more than six massless joints at one place, a frame on
        one of them, a compliant grasp or coordinate, an effect that adds forces.
    ConfigError
        Unknown parameter, or `time_step` not positive.
    """
    if not time_step > 0:
        raise ConfigError(f"time_step = {time_step}", where="mujoco_xml", allowed="a positive number of seconds")
    tree = replace(system.mechanism, parameters=system.parameters).numeric(values)
    value = Evaluator(system, values)
    _refuse_inexpressible(system, value)

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
    )
    ElementTree.SubElement(option, "flag", contact="disable")
    sites = _sites(system, tree, value)
    elements = _bodies(system, tree, value, sites, ElementTree.SubElement(root, "worldbody"))
    for name, frame in sites:
        ElementTree.SubElement(elements[frame.joint], "site", {"name": name, **_pose(frame.placement)})
    _add_grasps(system, ElementTree.SubElement(root, "equality"), time_step)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _bodies(
    system: System,
    tree: Mechanism,
    value: Evaluator,
    sites: list[tuple[str, Frame]],
    world: ElementTree.Element,
) -> dict[int, ElementTree.Element]:
    """Add bodies with their joints and masses; the body of every joint by its index, -1 for the world."""
    springs: dict[str, list[tuple[float, float]]] = {}
    damping = {joint: float(value(coefficient)[0]) for joint, coefficient in system.damping.items()}
    for entry in system.elastic:
        springs.setdefault(entry.joint, []).append((float(value(entry.stiffness)[0]), float(value(entry.rest)[0])))
        damping[entry.joint] = damping.get(entry.joint, 0.0) + float(value(entry.damping)[0])
    carried = {frame.joint: name for name, frame in reversed(sites)}
    elements: dict[int, ElementTree.Element] = {-1: world}
    for j, joint in enumerate(tree.joints):
        if _shares_body(tree, j):
            elements[j] = elements[joint.parent]
            if joint.parent in carried:
                what = f"frame '{carried[joint.parent]}' sits on a joint that carries no mass"
                raise ModelError(what, where=f"joint {joint.name}")
        else:
            elements[j] = ElementTree.SubElement(
                elements[joint.parent], "body", {"name": f"{joint.name}_body", **_pose(joint.placement)}
            )
        attributes = _joint_attributes(joint, damping.get(joint.name, 0.0), springs.get(joint.name, []))
        ElementTree.SubElement(elements[j], "joint", attributes)
        if len(elements[j].findall("joint")) > _JOINTS_PER_BODY:
            raise ModelError(
                "more than six joints without mass sit at one place",
                where=f"joint {joint.name}",
                allowed="up to six; a body with mass on the last of them",
            )
        body = merged(joint.bodies)
        if body is not None:
            ElementTree.SubElement(elements[j], "inertial", _inertial(body))
        elif not any(_shares_body(tree, k) and tree.joints[k].parent == j for k in range(len(tree.joints))):
            raise ModelError(
                f"nothing that '{joint.name}' moves has a mass",
                where=f"joint {joint.name}",
                allowed="a body with mass on every joint, or several joints at one place with a body on the last",
            )
    return elements


def _joint_attributes(joint: Joint, damping: float, springs: list[tuple[float, float]]) -> dict[str, str]:
    attributes = {"name": joint.name, "axis": _text(joint.axis), "damping": _text([damping])}
    attributes["type"] = "hinge" if joint.kind == "revolute" else "slide"
    stiffness = sum(k for k, _ in springs)
    if stiffness > 0:
        attributes["stiffness"] = _text([stiffness])
        attributes["springref"] = _text([sum(k * rest for k, rest in springs) / stiffness])
    return attributes


def _add_grasps(system: System, equality: ElementTree.Element, time_step: float) -> None:
    firm = {"solref": _text([2 * time_step, 1.0]), "solimp": "0.9999 0.9999 0.001 0.5 2"}
    for grasp in system.grasps:
        kind = "weld" if grasp.kind == "weld" else "connect"
        for end in ("", "_ahead") if grasp.kind == "axis" else ("",):
            ends = {"site1": f"grasp_{grasp.name}_holder{end}", "site2": f"grasp_{grasp.name}_held{end}"}
            ElementTree.SubElement(equality, kind, {"name": f"grasp_{grasp.name}{end}", **ends, **firm})


class Evaluator:
    """Numbers of expressions in a system's parameters, each flattened column by column.

    Parameters
    ----------
    system : System
    values : mapping of str to float, optional
        Parameter values by name; nominal where absent.
    """

    def __init__(self, system: System, values: Mapping[str, float] | None = None) -> None:
        self._symbols, self._theta = system.parameters.symbols, system.parameters.vector(values)

    def __call__(self, expression: ca.SX) -> Array:
        """Values of an expression in nothing but parameters."""
        return np.array(ca.densify(ca.Function("value", [self._symbols], [expression])(self._theta))).ravel(order="F")

    def vanishes(self, expression: ca.SX) -> bool:
        """Whether an expression, of other symbols as well, is zero whatever these are."""
        return bool(ca.sparsify(ca.substitute(expression, self._symbols, ca.DM(self._theta))).is_zero())


def mujoco_module() -> ModuleType:
    """The mujoco package; `DataError` where it is not installed."""
    try:
        import mujoco
    except ImportError as error:
        raise DataError(
            "virtual experiments need MuJoCo, which is not installed", hint="pip install 'yid-ocp[blind]'"
        ) from error
    return mujoco


def compiled_model(text: str) -> Any:
    """A `mujoco.MjModel` from MJCF text; `ModelError` where MuJoCo does not accept it."""
    try:
        return mujoco_module().MjModel.from_xml_string(text)
    except ValueError as error:
        raise ModelError(f"MuJoCo does not accept the model: {error}", where="mujoco_xml") from error


def _refuse_inexpressible(system: System, value: Evaluator) -> None:
    for effect in system.effects:
        if effect.internal or not value.vanishes(_own_terms(system, effect)):
            raise ModelError(
                f"effect '{effect.kind}@{effect.location}' adds forces of its own",
                where="mujoco_xml",
                allowed="effects that change masses, lengths, stiffness, damping, gravity or grasps",
            )
    for grasp in system.grasps:
        if not value.vanishes(grasp.compliance):
            raise ModelError(f"grasp '{grasp.name}' is compliant", where="mujoco_xml", allowed="rigid grasps")
    for joint, compliance in system.compliant.items():
        if not value.vanishes(compliance):
            raise ModelError(f"joint '{joint}' is compliant", where="mujoco_xml", allowed="compliance zero")
    if not value.vanishes(system.time_scale - 1):
        raise ModelError("the clock is scaled", where="mujoco_xml", allowed="a clock that tells the true time")


def _own_terms(system: System, effect: Effect) -> ca.SX:
    q, v = ca.SX.sym("q", system.size), ca.SX.sym("v", system.size)
    u, reaction = ca.SX.sym("u", len(system.driven)), ca.SX.sym("reaction", system.constraint_count)
    none = ca.SX(0, 1)
    kinematics = forward_kinematics(system.mechanism, q)
    terms = effect.terms(MidpointState(system, kinematics, q, v, none, none, u, reaction, {}, ca.SX.sym("h")))
    forces = (terms.force, terms.viscous, None if terms.closed is None else terms.closed.force)
    return ca.vertcat(terms.lagrangian, *(none if force is None else force for force in forces))


def _shares_body(tree: Mechanism, j: int) -> bool:
    """Whether joint j turns at the same place as its parent, which carries nothing but it."""
    joint = tree.joints[j]
    if joint.parent < 0 or merged(tree.joints[joint.parent].bodies) is not None:
        return False
    alone = sum(other.parent == joint.parent for other in tree.joints) == 1
    return alone and bool(np.array_equal(np.array(ca.DM(joint.placement.matrix())), np.eye(4)))


def _sites(system: System, tree: Mechanism, value: Evaluator) -> list[tuple[str, Frame]]:
    sites = [(name, tree.frame(name)) for name in system.points]
    for grasp in system.grasps:
        holder, held = tree.frame(grasp.holder), tree.frame(grasp.held)
        rotation = value(grasp.rotation).reshape(3, 3, order="F")
        ends = {
            "holder": (holder, Placement(ca.SX(ca.DM(rotation)), ca.SX(ca.DM(value(grasp.offset))))),
            "held": (held, _along(-value(grasp.slip)[0])),
        }
        for end, (frame, local) in ends.items():
            placement = frame.placement @ local
            sites.append((f"grasp_{grasp.name}_{end}", Frame(frame.joint, placement)))
            if grasp.kind == "axis":
                sites.append((f"grasp_{grasp.name}_{end}_ahead", Frame(frame.joint, placement @ _along(_AXIS_LEVER))))
    return sites


def _along(z: float) -> Placement:
    return Placement(ca.SX(ca.DM.eye(3)), ca.SX(ca.DM([0.0, 0.0, float(z)])))


def _pose(placement: Placement) -> dict[str, str]:
    x, y, z, w = Rotation.from_matrix(np.array(ca.DM(placement.rotation))).as_quat()
    return {"pos": _text(np.array(ca.DM(placement.translation)).ravel()), "quat": _text([w, x, y, z])}


def _inertial(body: Inertia) -> dict[str, str]:
    tensor = np.array(ca.DM(body.about_com))
    full = [tensor[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    com = np.array(ca.DM(body.com)).ravel()
    return {"pos": _text(com), "mass": _text([float(body.mass)]), "fullinertia": _text(full)}


def _text(numbers: Iterable[float]) -> str:
    return " ".join(f"{float(number):.17g}" for number in numbers)

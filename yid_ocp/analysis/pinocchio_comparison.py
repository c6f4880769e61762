"""Comparison of a model with the library Pinocchio: mass matrix, gravity forces and inverse dynamics.

Pinocchio gets the robot in two ways: it reads the URDF file itself, or it is given the built system joint by joint,
including object and effects. The first reveals errors in reading the file, the second errors in the mechanics.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin

from yid_ocp.arrays import Array
from yid_ocp.files import MAX_TEXT_BYTES, check_input_file
from yid_ocp.model.kinematics import (
    forward_kinematics,
    lagrangian_first_derivatives,
    lagrangian_second_derivatives,
    mass_matrix,
)
from yid_ocp.model.mechanism import Mechanism
from yid_ocp.model.system import System

_RELATIVE_TOLERANCE = 1e-8  # relative to the largest entry; placements are rounded to 1e-11
_N_RANDOM_CONFIGURATIONS = 3  # configurations compared in addition to the given one


@dataclass(frozen=True)
class _PinocchioComparison:
    """Largest differences between a model and Pinocchio's model of the same bodies, over the largest entry."""

    of: str  # words for the compared model
    mass: float  # difference of mass matrices
    weight: float  # difference of gravity forces
    motion: float  # difference of inverse dynamics

    @property
    def agrees_within_rounding(self) -> bool:
        """True if all three quantities agree within rounding (1e-8 of the largest entry)."""
        return all(size <= _RELATIVE_TOLERANCE for size in (self.mass, self.weight, self.motion))

    @property
    def words(self) -> str:
        """One sentence, which says that the model agrees with Pinocchio, or what differs and by how much."""
        parts = {"mass matrix": self.mass, "weight": self.weight, "inverse dynamics": self.motion}
        if self.agrees_within_rounding:
            said = f"{self.of}: mass matrix, weight and inverse dynamics agree with those of the library Pinocchio"
            return f"{said}, except for rounding errors ({max(parts.values()):.1g} of the largest entry)"
        wrong = [f"{name} by {100 * size:.2g} %" for name, size in parts.items() if not size <= _RELATIVE_TOLERANCE]
        tolerated = f"of the largest entry ({100 * _RELATIVE_TOLERANCE:g} % is tolerated)"
        return f"{self.of} differs from Pinocchio's: {', '.join(wrong)} {tolerated}. Find the cause before you use it"


def compare_system_with_pinocchio(system: System, theta: Array, posture: Array) -> _PinocchioComparison:
    """Compare a system with parameters `theta` with Pinocchio's model, at `posture` (n,) and random configurations."""
    internal = ca.vertcat(ca.SX(0, 1), *system.effect_internal_coordinate_symbols.values())
    symbols = ca.vertcat(system.parameters.symbols, internal)
    values = np.concatenate([theta, np.zeros(internal.numel())])
    built = system.map_expressions(lambda x: ca.SX(ca.densify(ca.Function("number", [symbols], [x])(values))))
    gravity = np.array(ca.DM(built.gravity)).ravel()
    inert, heavy = (_assembled(built.mechanism, gravity, weight) for weight in (False, True))
    return _compared("this model", built.mechanism, gravity, inert, heavy, posture)


def compare_urdf_with_pinocchio(
    path: Path,
    mechanism: Mechanism,
    gravity: Array,
    joints: Sequence[str] | None = None,
    locked: Mapping[str, float] | None = None,
    exclude_links: Sequence[str] = (),
) -> _PinocchioComparison:
    """Compare this package's model of a URDF robot with Pinocchio's model of the same file.

    `mechanism` is the result of `read_urdf` for this file and the same `joints` (movable joints, default all), `locked`
    (positions of the other joints [rad or m]) and `exclude_links` (links removed with their subtrees). `gravity` (3,)
    is in m/s^2. Raises ValueError if Pinocchio cannot read the file.
    """
    model, locked = pin.buildModelFromXML(_without(path, exclude_links)), locked or {}
    if joints is not None:
        at = pin.neutral(model)
        for i, name in enumerate(model.names):
            if i and name not in joints:
                joint, value = model.joints[i], 0.0
                if joint.nq == 1:  # default: zero or the nearest limit
                    limits = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
                    value = float(np.clip(0.0, *limits))
                _place(at, joint, locked.get(name, value))
        model = pin.buildReducedModel(model, [i for i in range(1, model.njoints) if model.names[i] not in joints], at)
    model.gravity.linear = gravity
    posture = np.zeros(len(mechanism.joints))
    return _compared(f"the file {path.name}", mechanism.with_numeric_values(), gravity, model, model, posture)


def _without(path: Path, links: Sequence[str]) -> str:
    root, waiting = ElementTree.parse(check_input_file(path, MAX_TEXT_BYTES)).getroot(), list(links)
    while waiting:
        link = waiting.pop()
        waiting += [end.attrib["link"] for end in root.findall(f"joint/parent[@link='{link}']/../child")]
        for part in [*root.findall(f"link[@name='{link}']"), *root.findall(f"joint/child[@link='{link}']/..")]:
            root.remove(part)
    return ElementTree.tostring(root, encoding="unicode")


def _place(configuration: Array, joint: Any, value: float) -> None:
    """Set a joint in a configuration of Pinocchio, in which a cosine and a sine represent a continuous joint."""
    configuration[joint.idx_q : joint.idx_q + joint.nq] = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]


def _assembled(mechanism: Mechanism, gravity: Array, weight: bool) -> Any:
    """Make Pinocchio's model of a numeric mechanism. With `weight`, gravity acts, with masses by effective weight."""
    model = pin.Model()
    model.gravity.linear = gravity if weight else np.zeros(3)
    # Pinocchio's mass matrix requires depth-first order of the joints
    placed: dict[int, int] = {-1: 0}
    for j in sorted(range(len(mechanism.joints)), key=mechanism.ancestor_joint_indices):
        joint = mechanism.joints[j]
        placement = pin.SE3(_number(joint.placement.rotation), _number(joint.placement.translation).ravel())
        kind = pin.JointModelRevoluteUnaligned if joint.kind == "revolute" else pin.JointModelPrismaticUnaligned
        index = model.addJoint(placed[joint.parent_index], kind(*joint.axis), placement, joint.name)
        placed[j] = index
        for body in joint.bodies:
            fraction = float(body.gravity_fraction) if weight else 1.0
            # gravity forces do not depend on the inertia about the centre of mass
            place, tensor = _number(body.center_of_mass).ravel(), _number(body.inertia_about_com)
            model.appendBodyToJoint(index, pin.Inertia(float(body.mass) * fraction, place, tensor), pin.SE3.Identity())
    return model


def _number(expression: ca.SX) -> Array:
    return np.array(ca.DM(ca.densify(expression)))


def _compared(
    of: str, mechanism: Mechanism, gravity: Array, inert: Any, heavy: Any, posture: Array
) -> _PinocchioComparison:
    """Compare with Pinocchio's models `inert` (mass matrix, inverse dynamics) and `heavy` (gravity), random motions."""
    n = len(mechanism.joints)
    q, v, a = (ca.SX.sym(name, n) for name in "qva")
    kinematics = forward_kinematics(mechanism, q)
    rigid = lagrangian_first_derivatives(kinematics, v, ca.SX(ca.DM(gravity)))
    still = lagrangian_first_derivatives(kinematics, ca.SX.zeros(n), ca.SX(ca.DM(gravity))).lagrangian_by_q
    mass, by_qv = mass_matrix(rigid, mechanism), lagrangian_second_derivatives(rigid, mechanism)[1]
    ours = ca.Function("ours", [q, v, a], [mass, -still, mass @ a + by_qv.T @ v - rigid.lagrangian_by_q])
    rng = np.random.default_rng(0)
    joints = [inert.joints[inert.getJointId(name)] for name in mechanism.joint_names]
    columns = [joint.idx_v for joint in joints]
    worst, data, weights = np.zeros(3), inert.createData(), heavy.createData()
    for at in (posture, *rng.uniform(-1.0, 1.0, (_N_RANDOM_CONFIGURATIONS, n))):
        speed, acceleration = rng.normal(size=(2, n))
        theirs_q, theirs_v, theirs_a = pin.neutral(inert), np.zeros(inert.nv), np.zeros(inert.nv)
        for joint, value in zip(joints, at, strict=True):
            _place(theirs_q, joint, float(value))
        theirs_v[columns], theirs_a[columns] = speed, acceleration
        upper = np.triu(pin.crba(inert, data, theirs_q))
        whole = (upper + np.triu(upper, 1).T)[np.ix_(columns, columns)]
        weight = pin.computeGeneralizedGravity(heavy, weights, theirs_q)[columns].copy()
        moving = pin.rnea(inert, data, theirs_q, theirs_v, theirs_a)[columns].copy()
        if inert is not heavy:
            moving += weight
        expected_parts = whole, weight[:, None], moving[:, None]
        for i, (found, expected) in enumerate(zip(ours(at, speed, acceleration), expected_parts, strict=True)):
            size = float(np.max(np.abs(expected), initial=0.0))
            difference = float(np.max(np.abs(np.array(ca.densify(found)) - expected), initial=0.0))
            worst[i] = max(worst[i], difference / size if size > 0 else difference)
    return _PinocchioComparison(of, *map(float, worst))

"""Effects of compliant mounts and junctions of the object, and of displaced, compliant or slipping grasps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca

from yid_ocp.effects import base
from yid_ocp.effects.base import EFFECTS, EffectBase, ParameterDefinition
from yid_ocp.model.flexible import AXIS_UNIT_VECTORS
from yid_ocp.model.mechanism import Joint, Placement
from yid_ocp.model.system import EffectStepTerms, Grasp, MidpointStateSymbols, System

_SPRING_RELAXATION_TIME = 5e-3  # for mount and junction springs: too short to damp visible motion [s]


def _root_joints_by_base(system: System) -> dict[str, tuple[str, ...]]:
    """First joints of all segments without a parent, by their carrier: the name of a clamp, or `base`."""
    tree, clamps = system.mechanism, base.clamp_names(system)
    found: dict[str, tuple[str, ...]] = {}
    for first in (s.link_joints[0][0] for s in system.segment_layouts if s.parent_segment is None):
        above = tree.ancestor_joint_indices(tree.joint_index(first))[:-1]
        place = next((clamp for clamp in clamps if tree.joint_index(f"{clamp}_rz") in above), "base")
        found[place] = (*found.get(place, ()), first)
    return found


def _branch_joints_by_junction(system: System) -> dict[str, tuple[str, ...]]:
    """First joints of the branches at every junction: `w_PARENT` at a parent's tip, else `junction_BRANCH`."""
    tree = system.mechanism
    found: dict[str, tuple[str, ...]] = {}
    for segment in (s for s in system.segment_layouts if s.parent_segment is not None):
        first, tip = segment.link_joints[0][0], f"w_{segment.parent_segment}"
        at_tip = tree.frame(tip).joint_index in tree.ancestor_joint_indices(tree.joint_index(first))
        place = tip if at_tip else f"junction_{segment.name}"
        found[place] = (*found.get(place, ()), first)
    return found


class _JointInsertion(EffectBase):
    """The base class of massless two-axis springs at rigid connections. They relax in `_SPRING_RELAXATION_TIME`."""

    required_excitation = "the force at its ends"
    declared_parameters = (
        base.compliance_parameter_definition("rad/(N m)", 1.0, (1 / 500, 1 / 5), "two-axis spring", "N m/rad"),
    )

    def _sprung(self, system: System, hung: tuple[str, ...], at: Placement | None, label: str) -> System:
        """The system with joints `LABEL_x` and `LABEL_y` inserted before some joints, at a placement in the parent."""
        tree = system.mechanism
        first = min(tree.joint_index(joint) for joint in hung)
        carrier = tree.joints[first].parent_index
        place, inverse = tree.joints[first].placement, Placement.identity()
        if at is not None:
            place, inverse = at, Placement(at.rotation.T, -(at.rotation.T @ at.translation))
        chain = [
            Joint(f"{label}_x", "revolute", carrier, place, AXIS_UNIT_VECTORS["x"]),
            Joint(f"{label}_y", "revolute", carrier, Placement.identity(), AXIS_UNIT_VECTORS["y"]),
        ]
        tree = tree.with_joint_chain_added_at_index(first, chain)
        joints = list(tree.joints)
        for index in (tree.joint_index(name) for name in hung):
            rest = Placement.identity() if at is None else inverse @ joints[index].placement
            joints[index] = replace(joints[index], parent_index=first + 1, placement=rest)
        names = [joint.name for joint in chain]
        return replace(
            system,
            mechanism=replace(tree, joints=tuple(joints)),
            joint_compliances={**system.joint_compliances, **dict.fromkeys(names, self["compliance"])},
            joint_relaxation_times={**system.joint_relaxation_times, **dict.fromkeys(names, _SPRING_RELAXATION_TIME)},
        )


@EFFECTS.register("mount_compliance")
class _MountCompliance(_JointInsertion):
    """Massless rotational spring between the object and its base or clamp, about x and y of the first link."""

    equation = "two joints with V = 1/2 stiffness q^2 before the first link"
    possible_locations = _root_joints_by_base

    def apply_to_system(self, system: System) -> System:
        for number, first in enumerate(_root_joints_by_base(system)[self.location]):
            system = self._sprung(system, (first,), None, f"{self.label}_{number}" if number else self.label)
        return system


@EFFECTS.register("junction_compliance")
class _JunctionCompliance(_JointInsertion):
    """Massless two-axis rotational spring between a segment and the branches that leave it at a junction.

    At `w_PARENT` all branches rotate together about x and y of the parent's last link, at `junction_BRANCH` one alone.
    """

    equation = "two joints with V = 1/2 stiffness q^2 before the branches"
    possible_locations = _branch_joints_by_junction

    def apply_to_system(self, system: System) -> System:
        at = system.mechanism.frame(self.location).placement if self.location.startswith("w_") else None
        return self._sprung(system, _branch_joints_by_junction(system)[self.location], at, self.label)


class _GraspChange(EffectBase):
    """The base class of effects that change one grasp."""

    required_excitation = "the force at its ends"
    possible_locations = base.grasp_names

    def _changes(self, grasp: Grasp) -> dict[str, Any]:
        raise NotImplementedError

    def apply_to_system(self, system: System) -> System:
        changed = (replace(g, **self._changes(g)) if g.name == self.location else g for g in system.grasps)
        return replace(system, grasps=tuple(changed))


@EFFECTS.register("grasp_offset")
class _GraspOffset(_GraspChange):
    """Displacement (dx, dy, dz) of the grasped point from its nominal position, in the gripper's frame."""

    equation = "phi = (holder + R (dx, dy, dz)) - held"
    declared_parameters = tuple(
        ParameterDefinition(f"d{axis}", "m", 0.0, -0.1, 0.1, (-0.02, 0.02), f"shift along the gripper's {axis}")
        for axis in "xyz"
    )

    def _changes(self, grasp: Grasp) -> dict[str, Any]:
        return {"holder_offset": grasp.holder_offset + ca.vertcat(self["dx"], self["dy"], self["dz"])}


@EFFECTS.register("grasp_compliance")
class _GraspCompliance(_GraspChange):
    """Spring-damper instead of a rigid grasp: f = phi/C + damping dphi/dt with phi = gripper - object.

    A step solves phi(q_{k+1}) + C damping (phi(q_{k+1}) - phi(q_k))/h = C lam_k/h, which is the rigid grasp at C = 0.
    phi is evaluated at the end of the step, which damps fast motions. All rows have the same C.
    """

    equation = "phi + C damping dphi/dt = C force"
    declared_parameters = (
        base.compliance_parameter_definition("m/N", 0.1, (1e-4, 1e-2), "grasp", "N/m"),
        ParameterDefinition("damping", "N s/m", 0.0, 0.0, 100.0, (0.1, 20.0), "damping of the grasp", True),
    )

    def _changes(self, grasp: Grasp) -> dict[str, Any]:
        relaxation = grasp.relaxation_time + self["compliance"] * self["damping"]
        return {"compliance": grasp.compliance + self["compliance"], "relaxation_time": relaxation}


@EFFECTS.register("grasp_slip")
class _GraspSlip(_GraspChange):
    """Slip of a grasp along a tube. The grasped point creeps in the direction in which the gripper pulls.

    d(offset)/dt = slip_per_load x axial load, both along the object's z axis (`Grasp.axial_slip`: the other sign).
    """

    equation = "d(offset)/dt = slip_per_load x axial load"
    required_excitation = "the holding time"
    declared_parameters = (
        ParameterDefinition("slip_per_load", "m/(N s)", 0.0, 0.0, 0.1, (0.0, 0.01), "speed of creep per axial load"),
    )
    declared_internal_coordinate_names = ("offset",)  # the slipped distance along the tube [m]

    def _changes(self, grasp: Grasp) -> dict[str, Any]:
        return {"axial_slip": grasp.axial_slip - self.internal_coordinate_symbols[f"{self.label}.offset"]}

    def step_terms(self, state: MidpointStateSymbols) -> EffectStepTerms:
        [name] = self.internal_coordinate_symbols
        row, grasps = state.internal_rows[name], state.system.grasps
        at = base.grasp_names(state.system).index(self.location)
        first = sum(grasp.n_constraint_equations for grasp in grasps[:at])
        axis = state.kinematics.frame_pose(grasps[at].held_frame).rotation[:, 2]
        creep = state.z_rate[row] - self["slip_per_load"] * ca.dot(axis, state.constraint_force[first : first + 3])
        return EffectStepTerms(internal_equations={name: creep}, static_equations={name: state.z[row]})

"""Effects of gravity and air drag."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from yid_ocp.effects.base import (
    EFFECTS,
    EffectBase,
    ParameterDefinition,
    object_joint_names,
    segment_names,
    with_changed_joint_bodies,
)
from yid_ocp.model.kinematics import Kinematics, cross_product, motion_cross_force_product, motion_cross_motion_product
from yid_ocp.model.mechanism import Inertia
from yid_ocp.model.rotations import symbolic_rotation_from_rpy
from yid_ocp.model.system import ForceWithDerivatives, MidpointState, StepTerms, System

_AIR_DENSITY = 1.2
"""Density of air [kg/m^3]."""
_ABS_SMOOTHING_SPEED = 1e-3
"""Speed below which |v_n| in the drag is smoothed [m/s]."""


@EFFECTS.register("aerodynamic_drag")
class AerodynamicDrag(EffectBase):
    """Air drag on a segment's links: F = -J_c' 1/2 rho_air cd 2 r l |v_n| v_n.

    v_n is the velocity of a link's centre normal to the link, r its radius, l its length; |v_n| is rounded off below
    `_ABS_SMOOTHING_SPEED`.
    """

    equation = "F = -J_c' 1/2 rho_air cd 2 r l |v_n| v_n"
    required_excitation = "how fast it moves"
    possible_locations = segment_names
    declared_parameters = (ParameterDefinition("cd", "1", 0.0, 0.0, 20.0, (0.0, 3.0), "drag coefficient"),)

    def step_terms(self, state: MidpointState) -> StepTerms:
        system, kinematics = state.system, state.kinematics
        tree, segment = system.mechanism, system.segment_layout(self.location)
        velocity = _velocities(kinematics, state.v)
        wrenches, slopes = {}, {}
        for link, length in zip(segment.link_joints, segment.link_lengths, strict=True):
            j = tree.joint_index(link[-1])
            along = kinematics.joint_rotations[j][:, 2]
            centre = kinematics.joint_origins[j] + along * length / 2
            v = velocity[j][3:] + cross_product(velocity[j][:3], centre)
            normal = v - along * ca.dot(along, v)
            speed = ca.sqrt(ca.dot(normal, normal) + _ABS_SMOOTHING_SPEED**2)
            factor = self["cd"] * _AIR_DENSITY * segment.radius * length
            push = -factor * speed * normal
            slope = -factor * (speed * (ca.SX.eye(3) - along @ along.T) + normal @ normal.T / speed)
            wrenches[j] = ca.vertcat(cross_product(centre, push), push)
            reach = ca.horzcat(-ca.skew(centre), ca.SX.eye(3))
            slopes[j] = reach.T @ slope @ reach
        return StepTerms(force_with_derivatives=_on_bodies(kinematics, velocity, wrenches, slopes))


def _object(system: System) -> tuple[str, ...]:
    """`object`, where there is one."""
    return ("object",) if system.segment_layouts else ()


def _world(system: System) -> tuple[str, ...]:
    return ("world",)


@EFFECTS.register("gravity_scale")
class GravityScale(EffectBase):
    """A fraction of the object's full weight added to its weight in the model; inertia is unchanged."""

    equation = "V += -fraction x sum of m g.x over the object"
    required_excitation = "how it stands against gravity"
    possible_locations = _object
    declared_parameters = (
        ParameterDefinition("fraction", "1", 0.0, -2.0, 2.0, (-1.0, 1.0), "weight added over full weight"),
    )

    def apply_to_system(self, system: System) -> System:

        def scaled(body: Inertia) -> Inertia:
            nominal = 1 if body.gravity_fraction is None else body.gravity_fraction
            return replace(body, gravity_fraction=nominal + self["fraction"])

        return with_changed_joint_bodies(system, object_joint_names(system), lambda bodies: map(scaled, bodies))


@EFFECTS.register("gravity_tilt")
class GravityTilt(EffectBase):
    """The gravity vector rotated by rx about the world's x axis, then by ry about its y axis."""

    equation = "g = Ry(ry) Rx(rx) g_0"
    required_excitation = "how it stands against gravity"
    possible_locations = _world
    declared_parameters = tuple(
        ParameterDefinition(f"r{axis}", "rad", 0.0, -0.5, 0.5, (-0.05, 0.05), f"turn about {axis}") for axis in "xy"
    )

    def apply_to_system(self, system: System) -> System:
        return replace(system, gravity=symbolic_rotation_from_rpy(self["rx"], self["ry"]) @ system.gravity)


def _velocities(kinematics: Kinematics, v: ca.SX) -> list[ca.SX]:
    """Spatial velocity of each joint's moving side, shape (6, 1) each."""
    result: list[ca.SX] = []
    for j, joint in enumerate(kinematics.mechanism.joints):
        own = kinematics.joint_screws[j] * v[j]
        result.append(own if joint.parent_index < 0 else result[joint.parent_index] + own)
    return result


def _on_bodies(
    kinematics: Kinematics, velocity: list[ca.SX], wrenches: dict[int, ca.SX], slopes: dict[int, ca.SX]
) -> ForceWithDerivatives:
    """Generalized force of wrenches that depend only on their body's motion, with its derivatives.

    With W_j and K_j the sum of wrenches, and of their slopes by the bodies' spatial velocity, over all that joint j
    moves, S_j its screw and D_j = V_parent(j) x S_j, for i an ancestor of j or j itself:

        F_j = S_j . W_j         dF_j/dv_i = dF_i/dv_j = S_i . K_j S_j
        dF_j/dq_i = D_i . K_j S_j       dF_i/dq_j = S_i . (K_j D_j + S_j x* W_j)

    because turning joint i turns a body and its wrench together, up to the velocity D_i that the turn adds; hence the A
    and T of `ForceWithDerivatives`.

    By joint index, `wrenches`, shape (6, 1), are about the world origin and must turn with the body and its velocity;
    `slopes`, shape (6, 6), are symmetric.
    """
    tree = kinematics.mechanism
    n, screws = len(tree.joints), kinematics.joint_screws
    zero = ca.SX(ca.DM.zeros(6))
    force, along, turned = ca.SX(n, 1), [zero] * n, [zero] * n
    for j in reversed(range(n)):
        if j not in wrenches:
            continue
        parent = tree.joints[j].parent_index
        if parent >= 0:
            for sums in (wrenches, slopes):
                sums[parent] = sums[parent] + sums[j] if parent in sums else sums[j]
        force[j] = ca.dot(screws[j], wrenches[j])
        along[j] = slopes[j] @ screws[j]
        added = motion_cross_motion_product(velocity[parent], screws[j]) if parent >= 0 else zero
        turned[j] = slopes[j] @ added + motion_cross_force_product(screws[j], wrenches[j])
    return ForceWithDerivatives(ca.densify(force), ca.horzcat(*along), ca.horzcat(*turned))

"""Gravity and air."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from yid_ocp.effects.base import (
    EFFECTS,
    EffectBase,
    Quantity,
    object_joints,
    segment_names,
    small_rotation,
    with_bodies,
)
from yid_ocp.model.kinematics import Kinematics, cross, force_cross, motion_cross
from yid_ocp.model.system import ClosedForce, MidpointState, System, Terms

AIR_DENSITY = 1.2
"""[kg/m^3]"""
STILL = 1e-3
"""Speed below which the drag's absolute value is rounded off [m/s]."""


@EFFECTS.register("aerodynamic_drag")
class AerodynamicDrag(EffectBase):
    """Drag of a segment's links: F = -J_c' 1/2 rho_air cd 2 r l |v_n| v_n.

    v_n is the velocity of a link's centre normal to the link, r its radius, l its length; |v_n| is rounded off below
    `STILL`.
    """

    equation = "F = -J_c' 1/2 rho_air cd 2 r l |v_n| v_n"
    depends_on = "how fast it moves"

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """Segments."""
        return segment_names(system)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """Drag coefficient cd [1]."""
        return (Quantity("cd", "1", 0.0, 0.0, 20.0, (0.0, 3.0), "drag coefficient"),)

    def terms(self, state: MidpointState) -> Terms:
        """See the class."""
        system, kinematics = state.system, state.kinematics
        tree, segment = system.mechanism, system.segment(self.location)
        velocity = _velocities(kinematics, state.v)
        wrenches, slopes = {}, {}
        for link, length in zip(segment.links, segment.lengths, strict=True):
            j = tree.joint_index(link[-1])
            along = kinematics.rotations[j][:, 2]
            centre = kinematics.origins[j] + along * length / 2
            v = velocity[j][3:] + cross(velocity[j][:3], centre)
            normal = v - along * ca.dot(along, v)
            speed = ca.sqrt(ca.dot(normal, normal) + STILL**2)
            factor = self["cd"] * AIR_DENSITY * segment.radius * length
            push = -factor * speed * normal
            slope = -factor * (speed * (ca.SX.eye(3) - along @ along.T) + normal @ normal.T / speed)
            wrenches[j] = ca.vertcat(cross(centre, push), push)
            reach = ca.horzcat(-ca.skew(centre), ca.SX.eye(3))
            slopes[j] = reach.T @ slope @ reach
        return Terms(closed=_on_bodies(kinematics, velocity, wrenches, slopes))


@EFFECTS.register("gravity_scale")
class GravityScale(EffectBase):
    """A fraction of the object's full weight added to what the model has, the inertia unchanged."""

    equation = "V += -fraction x sum of m g.x over the object"
    depends_on = "how it stands against gravity"

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """`object`."""
        return ("object",) if system.segments else ()

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """Fraction [1]."""
        return (Quantity("fraction", "1", 0.0, -2.0, 2.0, (-1.0, 1.0), "weight added over full weight"),)

    def modify(self, system: System) -> System:
        """See the class."""
        tree, bodies = system.mechanism, {}
        for joint in object_joints(system):
            bodies[joint] = [
                replace(
                    body,
                    gravity_fraction=(1 if body.gravity_fraction is None else body.gravity_fraction) + self["fraction"],
                )
                for body in tree.joints[tree.joint_index(joint)].bodies
            ]
        return with_bodies(system, bodies)


@EFFECTS.register("gravity_tilt")
class GravityTilt(EffectBase):
    """The gravity vector turned by rx about x, then by ry about y of the world."""

    equation = "g = Ry(ry) Rx(rx) g_0"
    depends_on = "how it stands against gravity"

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """`world`."""
        return ("world",)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """Rx and ry [rad]."""
        return tuple(Quantity(f"r{axis}", "rad", 0.0, -0.5, 0.5, (-0.05, 0.05), f"turn about {axis}") for axis in "xy")

    def modify(self, system: System) -> System:
        """See the class."""
        return replace(system, gravity=small_rotation(self["rx"], self["ry"]) @ system.gravity)


def _velocities(kinematics: Kinematics, v: ca.SX) -> list[ca.SX]:
    """Spatial velocity of what each joint moves."""
    result: list[ca.SX] = []
    for j, joint in enumerate(kinematics.mechanism.joints):
        own = kinematics.screws[j] * v[j]
        result.append(own if joint.parent < 0 else result[joint.parent] + own)
    return result


def _on_bodies(
    kinematics: Kinematics, velocity: list[ca.SX], wrenches: dict[int, ca.SX], slopes: dict[int, ca.SX]
) -> ClosedForce:
    """Generalized force of wrenches on bodies, that depend on nothing but their bodies' motion, and its slopes.

    With W_j and K_j the sum of wrenches, and of their slopes by the bodies' spatial velocity, over all that joint j
    moves, S_j its screw and D_j = V_parent(j) x S_j, for i an ancestor of j or j itself:

        F_j = S_j . W_j         dF_j/dv_i = dF_i/dv_j = S_i . K_j S_j
        dF_j/dq_i = D_i . K_j S_j       dF_i/dq_j = S_i . (K_j D_j + S_j x* W_j)

    because turning joint i turns a body and its wrench together, up to the velocity D_i that the turn adds; hence the A
    and T of `ClosedForce`.

    Parameters
    ----------
    kinematics : Kinematics
    velocity : list of casadi.SX, shape (6, 1) each
    wrenches : dict of joint index to casadi.SX, shape (6, 1)
        About the world origin; must turn with the body and its velocity.
    slopes : dict of joint index to casadi.SX, shape (6, 6)
        Symmetric.
    """
    tree = kinematics.mechanism
    n, screws = len(tree.joints), kinematics.screws
    zero = ca.SX(ca.DM.zeros(6))
    force, along, turned = ca.SX(n, 1), [zero] * n, [zero] * n
    wrenches, slopes = dict(wrenches), dict(slopes)
    for j in reversed(range(n)):
        if j not in wrenches:
            continue
        parent = tree.joints[j].parent
        if parent >= 0:
            wrenches[parent] = wrenches[parent] + wrenches[j] if parent in wrenches else wrenches[j]
            slopes[parent] = slopes[parent] + slopes[j] if parent in slopes else slopes[j]
        force[j] = ca.dot(screws[j], wrenches[j])
        along[j] = slopes[j] @ screws[j]
        added = motion_cross(velocity[parent], screws[j]) if parent >= 0 else zero
        turned[j] = slopes[j] @ added + force_cross(screws[j], wrenches[j])
    return ClosedForce(ca.densify(force), ca.horzcat(*along), ca.horzcat(*turned))

"""Masses, inertias and lengths that differ from the nominal ones."""

from __future__ import annotations

import casadi as ca

from yid_ocp.effects.base import (
    EFFECTS,
    EffectBase,
    Quantity,
    arm_tips,
    robot_joints,
    segment_names,
    segment_of_frame,
    substituted,
    with_bodies,
)
from yid_ocp.model.mechanism import Inertia
from yid_ocp.model.system import MidpointState, System, Terms


@EFFECTS.register("density")
class Density(EffectBase):
    """All masses and inertias of a segment times a factor."""

    equation = "masses and inertias times scale"
    depends_on = "how hard it accelerates"

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """Segments."""
        return segment_names(system)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """Scale [1]."""
        return (Quantity("scale", "1", 1.0, 0.2, 3.0, (0.7, 1.3), "factor on masses and inertias"),)

    def modify(self, system: System) -> System:
        """See the class."""
        return _scaled(system, [joint for link in system.segment(self.location).links for joint in link], self["scale"])


@EFFECTS.register("link_mass")
class LinkMass(EffectBase):
    """Mass and inertia of what an arm joint carries, up to the next joint, times a factor."""

    equation = "mass and inertia of the child link times scale"
    depends_on = "how hard it accelerates"

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """Arm joints that carry mass."""
        tree = system.mechanism
        return tuple(name for name in robot_joints(system) if tree.joints[tree.joint_index(name)].bodies)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """Scale [1]."""
        return (Quantity("scale", "1", 1.0, 0.2, 3.0, (0.8, 1.2), "factor on mass and inertia"),)

    def modify(self, system: System) -> System:
        """See the class."""
        return _scaled(system, [self.location], self["scale"])


@EFFECTS.register("point_mass")
class PointMass(EffectBase):
    """A point of some mass fixed to a frame: T += 1/2 mass |v|^2, V += -mass g.x."""

    equation = "T += 1/2 mass |v|^2, V -= mass g.x"
    depends_on = "how hard it accelerates"

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """All named points that move."""
        return tuple(name for name, frame in system.mechanism.frames.items() if frame.joint >= 0)

    @classmethod
    def likely(cls, system: System) -> tuple[str, ...]:
        """Tips of segments, junctions, and the end of every arm that holds nothing."""
        tree = system.mechanism
        ends = (f"{prefix}_{s.name}" for s in system.segments for prefix in ("w", "junction"))
        return (*(name for name in ends if name in tree.frames), *arm_tips(system))

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """Mass [kg]; much less is expected on the object than on a gripper."""
        light = segment_of_frame(system, location) is not None
        upper, expected = (0.5, 0.05) if light else (10.0, 3.0)
        return (Quantity("mass", "kg", 0.0, 0.0, upper, (0.0, expected), "mass of the point"),)

    def modify(self, system: System) -> System:
        """See the class."""
        frame = system.mechanism.frame(self.location)
        joint = system.mechanism.joints[frame.joint]
        point = Inertia(self["mass"], frame.placement.translation, ca.SX(ca.DM.zeros(3, 3)))
        return with_bodies(system, {joint.name: (*joint.bodies, point)})


@EFFECTS.register("length_scale")
class LengthScale(EffectBase):
    """Link lengths of a segment times a factor; its mass stays."""

    equation = "link lengths times scale"
    depends_on = "how long it is"

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """Segments whose length is a parameter."""
        return tuple(name for name in segment_names(system) if _lengths(system, name))

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """Scale [1]."""
        return (Quantity("scale", "1", 1.0, 0.8, 1.2, (0.97, 1.03), "factor on link lengths"),)

    def modify(self, system: System) -> System:
        """See the class."""
        old = [system.parameters[name].symbol for name in _lengths(system, self.location)]
        return substituted(system, old, [symbol * self["scale"] for symbol in old])


@EFFECTS.register("rotor_inertia")
class RotorInertia(EffectBase):
    """Inertia of a motor's rotor, seen at its joint: T += 1/2 armature v^2."""

    equation = "T += 1/2 armature v^2"
    depends_on = "how hard it accelerates"

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """Arm joints."""
        return robot_joints(system)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """Armature [kg m^2]."""
        return (Quantity("armature", "kg m^2", 0.0, 0.0, 5.0, (0.0, 1.0), "inertia of the rotor at the joint"),)

    def terms(self, state: MidpointState) -> Terms:
        """See the class."""
        v = state.v[state.system.mechanism.joint_index(self.location)]
        return Terms(lagrangian=self["armature"] / 2 * v**2)


def _scaled(system: System, joints: list[str], factor: ca.SX) -> System:
    tree = system.mechanism
    bodies = {name: tree.joints[tree.joint_index(name)].bodies for name in joints}
    return with_bodies(system, {name: [body.scaled(factor) for body in entry] for name, entry in bodies.items()})


def _lengths(system: System, segment: str) -> list[str]:
    return [
        name for name in system.parameters.names if name == f"{segment}.length" or name.startswith(f"{segment}.length_")
    ]

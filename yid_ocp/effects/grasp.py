"""Grasps that sit elsewhere, give way or slip."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from yid_ocp.effects.base import EFFECTS, EffectBase, Quantity, grasp_names, with_grasp
from yid_ocp.model.system import Grasp, MidpointState, System, Terms


@EFFECTS.register("grasp_offset")
class GraspOffset(EffectBase):
    """The grasped point sits at (dx, dy, dz) beside its nominal place in the gripper's frame."""

    equation = "phi = (holder + R (dx, dy, dz)) - held"
    depends_on = "how hard it pulls at its ends"

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """Grasps."""
        return grasp_names(system)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """dx, dy, dz [m]."""
        return tuple(
            Quantity(f"d{axis}", "m", 0.0, -0.1, 0.1, (-0.02, 0.02), f"shift along the gripper's {axis}")
            for axis in "xyz"
        )

    def modify(self, system: System) -> System:
        """See the class."""
        grasp = _grasp(system, self.location)
        shift = ca.vertcat(*(self[f"d{axis}"] for axis in "xyz"))
        return with_grasp(system, replace(grasp, offset=grasp.offset + shift))


@EFFECTS.register("grasp_compliance")
class GraspCompliance(EffectBase):
    """A spring and a damper in place of the constraint: f = phi/C + damping dphi/dt, phi = gripper - object.

    In a step: phi(q_{k+1}) + C damping (phi(q_{k+1}) - phi(q_k))/h = C lam_k/h, regular at C = 0, where it is the rigid
    grasp. The stretch is taken at the end of the step, which by itself damps what is fast against it. Every row of the
    grasp has the same C; in rows of orientation it counts in rad/(N m).
    """

    equation = "phi + C damping dphi/dt = C force"
    depends_on = "how hard it pulls at its ends"

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """Grasps."""
        return grasp_names(system)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """Compliance [m/N], reported as stiffness [N/m], and damping [N s/m]."""
        text = "compliance of the grasp"
        return (
            Quantity("compliance", "m/N", 0.0, 0.0, 0.1, (1e-4, 1e-2), text, reciprocal="stiffness N/m"),
            Quantity("damping", "N s/m", 0.0, 0.0, 100.0, (0.1, 20.0), "damping of the grasp", shape=True),
        )

    def modify(self, system: System) -> System:
        """See the class."""
        grasp = _grasp(system, self.location)
        compliance = grasp.compliance + self["compliance"]
        own = self["compliance"] * self["damping"]
        relaxation = own if grasp.relaxation is None else grasp.relaxation + own
        return with_grasp(system, replace(grasp, compliance=compliance, relaxation=relaxation))


@EFFECTS.register("grasp_slip")
class GraspSlip(EffectBase):
    """The grasped point creeps along the tube in the direction in which the gripper pulls.

    d(offset)/dt = slip_per_load x axial load, both along the object's z axis; `Grasp.slip` counts the other way. At the
    start of a recording nothing has slipped.
    """

    equation = "d(offset)/dt = slip_per_load x axial load"
    depends_on = "how long it is held"

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """Grasps."""
        return grasp_names(system)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """slip_per_load [m/(N s)]."""
        text = "creep rate per axial load"
        return (Quantity("slip_per_load", "m/(N s)", 0.0, 0.0, 0.1, (0.0, 0.01), text),)

    @classmethod
    def internal_names(cls, location: str, system: System) -> tuple[str, ...]:
        """The offset along the tube."""
        return ("offset",)

    def modify(self, system: System) -> System:
        """See the class."""
        grasp = _grasp(system, self.location)
        return with_grasp(system, replace(grasp, slip=grasp.slip - self.internal[f"{self.label}.offset"]))

    def terms(self, state: MidpointState) -> Terms:
        """See the class."""
        name = f"{self.label}.offset"
        row, at = state.internal[name], 0
        for grasp in state.system.grasps:
            if grasp.name == self.location:
                break
            at += grasp.equations
        axis = state.kinematics.pose(grasp.held).rotation[:, 2]
        load = ca.dot(axis, state.constraint_force[at : at + 3])
        return Terms(internal={name: state.z_rate[row] - self["slip_per_load"] * load}, at_rest={name: state.z[row]})


def _grasp(system: System, name: str) -> Grasp:
    return next(grasp for grasp in system.grasps if grasp.name == name)

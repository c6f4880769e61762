"""Grasps that are displaced, compliant or slipping."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from yid_ocp.effects.base import EFFECTS, EffectBase, Quantity, grasp_names, with_grasp
from yid_ocp.model.system import Grasp, MidpointState, System, Terms


@EFFECTS.register("grasp_offset")
class GraspOffset(EffectBase):
    """The grasped point displaced by (dx, dy, dz) from its nominal position, in the gripper's frame."""

    equation = "phi = (holder + R (dx, dy, dz)) - held"
    depends_on = "how hard it pulls at its ends"

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """Names of the grasps."""
        return grasp_names(system)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """Definitions of dx, dy and dz [m]."""
        return tuple(
            Quantity(f"d{axis}", "m", 0.0, -0.1, 0.1, (-0.02, 0.02), f"shift along the gripper's {axis}")
            for axis in "xyz"
        )

    def modify(self, system: System) -> System:
        """The system with the displaced grasp."""
        grasp = _grasp(system, self.location)
        shift = ca.vertcat(*(self[f"d{axis}"] for axis in "xyz"))
        return with_grasp(system, replace(grasp, offset=grasp.offset + shift))


@EFFECTS.register("grasp_compliance")
class GraspCompliance(EffectBase):
    """A spring-damper in place of the rigid constraint: f = phi/C + damping dphi/dt, phi = gripper - object.

    In a step: phi(q_{k+1}) + C damping (phi(q_{k+1}) - phi(q_k))/h = C lam_k/h, regular at C = 0, where it is the rigid
    grasp. The stretch is taken at the end of the step, which by itself damps what is fast against it. Every row of the
    grasp has the same C; in rows of orientation it counts in rad/(N m).
    """

    equation = "phi + C damping dphi/dt = C force"
    depends_on = "how hard it pulls at its ends"

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """Names of the grasps."""
        return grasp_names(system)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """Definitions of compliance [m/N], reported as stiffness [N/m], and damping [N s/m]."""
        text = "compliance of the grasp"
        return (
            Quantity("compliance", "m/N", 0.0, 0.0, 0.1, (1e-4, 1e-2), text, reciprocal="stiffness N/m"),
            Quantity("damping", "N s/m", 0.0, 0.0, 100.0, (0.1, 20.0), "damping of the grasp", shape=True),
        )

    def modify(self, system: System) -> System:
        """The system with the compliant grasp."""
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
        """Names of the grasps."""
        return grasp_names(system)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """Definition of slip_per_load [m/(N s)]."""
        text = "creep rate per axial load"
        return (Quantity("slip_per_load", "m/(N s)", 0.0, 0.0, 0.1, (0.0, 0.01), text),)

    @classmethod
    def internal_names(cls, location: str, system: System) -> tuple[str, ...]:
        """`offset`, the slipped distance along the tube."""
        return ("offset",)

    def modify(self, system: System) -> System:
        """The system with the slipped distance as the grasp's slip."""
        grasp = _grasp(system, self.location)
        return with_grasp(system, replace(grasp, slip=grasp.slip - self.internal[f"{self.label}.offset"]))

    def terms(self, state: MidpointState) -> Terms:
        """The creep equation of the slipped distance."""
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

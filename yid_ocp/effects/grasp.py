"""Grasps that are displaced, compliant or slipping."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from yid_ocp.effects.base import EFFECTS, EffectBase, ParameterDefinition, grasp_names, with_grasp
from yid_ocp.model.system import Grasp, MidpointState, StepTerms, System


@EFFECTS.register("grasp_offset")
class GraspOffset(EffectBase):
    """The grasped point displaced by (dx, dy, dz) from its nominal position, in the gripper's frame."""

    equation = "phi = (holder + R (dx, dy, dz)) - held"
    required_excitation = "how hard it pulls at its ends"

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of the grasps."""
        return grasp_names(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definitions of dx, dy and dz [m]."""
        return tuple(
            ParameterDefinition(f"d{axis}", "m", 0.0, -0.1, 0.1, (-0.02, 0.02), f"shift along the gripper's {axis}")
            for axis in "xyz"
        )

    def apply_to_system(self, system: System) -> System:
        """The system with the displaced grasp."""
        grasp = _grasp(system, self.location)
        shift = ca.vertcat(*(self[f"d{axis}"] for axis in "xyz"))
        return with_grasp(system, replace(grasp, holder_offset=grasp.holder_offset + shift))


@EFFECTS.register("grasp_compliance")
class GraspCompliance(EffectBase):
    """A spring-damper in place of the rigid constraint: f = phi/C + damping dphi/dt, phi = gripper - object.

    In a step: phi(q_{k+1}) + C damping (phi(q_{k+1}) - phi(q_k))/h = C lam_k/h, regular at C = 0, where it is the rigid
    grasp. The stretch is taken at the end of the step, which by itself damps what is fast against it. Every row of the
    grasp has the same C; in rows of orientation it counts in rad/(N m).
    """

    equation = "phi + C damping dphi/dt = C force"
    required_excitation = "how hard it pulls at its ends"

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of the grasps."""
        return grasp_names(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definitions of compliance [m/N], reported as stiffness [N/m], and damping [N s/m]."""
        text = "compliance of the grasp"
        return (
            ParameterDefinition(
                "compliance", "m/N", 0.0, 0.0, 0.1, (1e-4, 1e-2), text, reported_reciprocal="stiffness N/m"
            ),
            ParameterDefinition(
                "damping", "N s/m", 0.0, 0.0, 100.0, (0.1, 20.0), "damping of the grasp", is_shape_parameter=True
            ),
        )

    def apply_to_system(self, system: System) -> System:
        """The system with the compliant grasp."""
        grasp = _grasp(system, self.location)
        compliance = grasp.compliance + self["compliance"]
        own = self["compliance"] * self["damping"]
        relaxation = own if grasp.relaxation_time is None else grasp.relaxation_time + own
        return with_grasp(system, replace(grasp, compliance=compliance, relaxation_time=relaxation))


@EFFECTS.register("grasp_slip")
class GraspSlip(EffectBase):
    """The grasped point creeps along the tube in the direction in which the gripper pulls.

    d(offset)/dt = slip_per_load x axial load, both along the object's z axis; `Grasp.axial_slip` counts the other way.
    At the start of a recording nothing has slipped.
    """

    equation = "d(offset)/dt = slip_per_load x axial load"
    required_excitation = "how long it is held"

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of the grasps."""
        return grasp_names(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of slip_per_load [m/(N s)]."""
        text = "creep rate per axial load"
        return (ParameterDefinition("slip_per_load", "m/(N s)", 0.0, 0.0, 0.1, (0.0, 0.01), text),)

    @classmethod
    def internal_coordinate_names(cls, location: str, system: System) -> tuple[str, ...]:
        """`offset`, the slipped distance along the tube."""
        return ("offset",)

    def apply_to_system(self, system: System) -> System:
        """The system with the slipped distance as the grasp's slip."""
        grasp = _grasp(system, self.location)
        return with_grasp(
            system, replace(grasp, axial_slip=grasp.axial_slip - self.internal_coordinates[f"{self.label}.offset"])
        )

    def step_terms(self, state: MidpointState) -> StepTerms:
        """The creep equation of the slipped distance."""
        name = f"{self.label}.offset"
        row, at = state.internal_rows[name], 0
        for grasp in state.system.grasps:
            if grasp.name == self.location:
                break
            at += grasp.n_equations
        axis = state.kinematics.frame_pose(grasp.held_frame).rotation[:, 2]
        load = ca.dot(axis, state.constraint_force[at : at + 3])
        return StepTerms(
            internal_equations={name: state.z_rate[row] - self["slip_per_load"] * load},
            static_equations={name: state.z[row]},
        )


def _grasp(system: System, name: str) -> Grasp:
    return next(grasp for grasp in system.grasps if grasp.name == name)

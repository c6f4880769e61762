"""Energy losses inside the object: material damping, stress relaxation, hysteresis."""

from __future__ import annotations

import casadi as ca

from yid_ocp.effects.base import (
    EFFECTS,
    EffectBase,
    ParameterDefinition,
    mean_bending_stiffness,
    segment_names,
    segment_springs,
)
from yid_ocp.model.system import MidpointState, StepTerms, System

_ABS_SMOOTHING_SPEED = 1e-3
"""Speed below which |v| in Dahl's law is smoothed [rad/s]."""


@EFFECTS.register("kelvin_voigt")
class KelvinVoigt(EffectBase):
    """Damping in proportion to stiffness: F = -tau kappa v on all joints of a segment, beside the model's damping."""

    equation = "F = -tau kappa v"
    required_excitation = "how fast it moves"

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of the object's segments."""
        return segment_names(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of tau, damping over stiffness [s]."""
        return (ParameterDefinition("tau", "s", 0.0, 0.0, 1.0, (0.005, 0.2), "damping over stiffness"),)

    def step_terms(self, state: MidpointState) -> StepTerms:
        """The damping force -tau kappa v on the segment's elastic joints."""
        force = ca.SX(state.system.n_coordinates, 1)
        for spring in segment_springs(state.system, self.location):
            index = state.system.mechanism.joint_index(spring.joint_name)
            force[index] = -self["tau"] * spring.stiffness * state.v[index]
        return StepTerms(dissipative_force=force)


@EFFECTS.register("standard_linear_solid")
class StandardLinearSolid(EffectBase):
    """A spring and a damper in series, parallel to every spring of a segment (bend and twist).

    V += 1/2 ratio kappa (q - z)^2 with the massless z creeping after q: (q - z) = relaxation_time dz/dt.
    """

    equation = "V += 1/2 ratio kappa (q - z)^2, q - z = relaxation_time dz/dt"
    required_excitation = "how long it is held"

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of the object's segments."""
        return segment_names(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definitions of ratio [1] and relaxation_time [s]."""
        return (
            ParameterDefinition(
                "ratio", "1", 0.0, 0.0, 5.0, (0.05, 1.0), "stiffness of the branch over that of the spring"
            ),
            ParameterDefinition(
                "relaxation_time", "s", 0.5, 1e-3, 100.0, (0.05, 10.0), "of the branch", is_shape_parameter=True
            ),
        )

    @classmethod
    def internal_coordinate_names(cls, location: str, system: System) -> tuple[str, ...]:
        """Names of the segment's elastic joints."""
        return _elastic_joint_names(system, location)

    def step_terms(self, state: MidpointState) -> StepTerms:
        """The energy of the additional springs and the relaxation equations of their internal coordinates."""
        energy, equations = ca.SX(0), {}
        for spring in segment_springs(state.system, self.location):
            name = f"{self.label}.{spring.joint_name}"
            row = state.internal_rows[name]
            stretch = state.q[state.system.mechanism.joint_index(spring.joint_name)] - state.z[row]
            energy += self["ratio"] * spring.stiffness * stretch**2 / 2
            equations[name] = stretch - self["relaxation_time"] * state.z_rate[row]
        return StepTerms(lagrangian=-energy, internal_equations=equations)


@EFFECTS.register("hysteresis")
class Hysteresis(EffectBase):
    """A Dahl friction element parallel to every spring of a segment (bend and twist).

    F = -stiffness z, dz/dt = v - |v| z / yield_angle, with |v| rounded off below `_ABS_SMOOTHING_SPEED`. At the start
    of a recording z = 0: what came before is not known.

    References
    ----------
    Dahl (1968), A solid friction model, Aerospace Corporation TOR-158(3107-18).
    """

    equation = "F = -stiffness z, dz/dt = v - |v| z / yield_angle"
    required_excitation = "how long it is held"

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of the object's segments."""
        return segment_names(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definitions of stiffness [N m/rad], 0.05 to 1 times the bending stiffness, and yield_angle [rad]."""
        kappa = mean_bending_stiffness(system, location)
        text = "stiffness of the element before it yields"
        return (
            ParameterDefinition("stiffness", "N m/rad", 0.0, 0.0, 50 * kappa, (0.05 * kappa, kappa), text),
            ParameterDefinition(
                "yield_angle",
                "rad",
                0.15,
                5e-3,
                5.0,
                (0.05, 0.5),
                "angle over which it yields",
                is_shape_parameter=True,
            ),
        )

    @classmethod
    def internal_coordinate_names(cls, location: str, system: System) -> tuple[str, ...]:
        """Names of the segment's elastic joints."""
        return _elastic_joint_names(system, location)

    def step_terms(self, state: MidpointState) -> StepTerms:
        """The forces of the Dahl elements and the equations of their internal coordinates."""
        force, equations, start = ca.SX(state.system.n_coordinates, 1), {}, {}
        for joint in _elastic_joint_names(state.system, self.location):
            name = f"{self.label}.{joint}"
            row, index = state.internal_rows[name], state.system.mechanism.joint_index(joint)
            v, z = state.v[index], state.z[row]
            speed = ca.sqrt(v**2 + _ABS_SMOOTHING_SPEED**2) - _ABS_SMOOTHING_SPEED
            force[index] = -self["stiffness"] * z
            equations[name] = state.z_rate[row] - v + speed * z / self["yield_angle"]
            start[name] = z
        return StepTerms(generalized_force=force, internal_equations=equations, static_equations=start)


def _elastic_joint_names(system: System, segment: str) -> tuple[str, ...]:
    """Names of a segment's joints that have a spring."""
    return tuple(spring.joint_name for spring in segment_springs(system, segment))

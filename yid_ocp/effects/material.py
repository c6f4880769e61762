"""Material effects of the object: losses, stress relaxation, hysteresis, and errors of the nominal springs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import casadi as ca
import numpy as np

from yid_ocp.effects import base
from yid_ocp.effects.base import EFFECTS, EffectBase, ParameterDefinition, elastic_joints_of_segment
from yid_ocp.model.flexible import ElasticJoint
from yid_ocp.model.system import EffectStepTerms, MidpointStateSymbols, System

_ABS_SMOOTHING_SPEED = 1e-3  # smoothing range of |v| in Dahl's law [rad/s]
_REFERENCE_ANGLE = 0.5  # largest angle assumed for the range of k3 without data [rad]
_MIN_LARGEST_ANGLE = 0.02  # minimum of that angle [rad]


def _bending_stiffness(system: System, segment: str) -> float:
    """Mean nominal bending stiffness of a segment's joints, at least 1e-6 [N m/rad]."""
    stiffness = [*base.nominal_bend_stiffness_by_joint_of_segment(system, segment).values()]
    return max(float(np.mean(stiffness)), 1e-6) if stiffness else 1.0


class _SegmentEffect(EffectBase):
    """The base class of effects on every elastic joint of a segment."""

    possible_locations = base.flexible_segment_names

    def _springs(self, state: MidpointStateSymbols) -> list[tuple[ElasticJoint, int]]:
        index = state.system.mechanism.joint_index
        return [(spring, index(spring.joint_name)) for spring in elastic_joints_of_segment(state.system, self.location)]


class _SegmentMemory(_SegmentEffect):
    """The base class of effects with one internal coordinate for every elastic joint of a segment."""

    required_excitation = "the holding time"

    @classmethod
    def internal_coordinate_names(cls, location: str, system: System) -> tuple[str, ...]:
        return tuple(spring.joint_name for spring in elastic_joints_of_segment(system, location))


class _SpringChange(_SegmentEffect):
    """The base class of effects that change the springs of a segment."""

    required_excitation = "the angle"

    def _changed(self, spring: ElasticJoint) -> ElasticJoint:
        raise NotImplementedError

    def apply_to_system(self, system: System) -> System:
        springs = (self._changed(s) if s.segment_name == self.location else s for s in system.elastic_joints)
        return replace(system, elastic_joints=tuple(springs))


@EFFECTS.register("kelvin_voigt")
class _KelvinVoigt(_SegmentEffect):
    """Kelvin-Voigt damping on all joints of a segment: F = -tau kappa v (joint stiffness kappa, speed v)."""

    equation = "F = -tau kappa v"
    required_excitation = "the speed"
    declared_parameters = (ParameterDefinition("tau", "s", 0.0, 0.0, 1.0, (0.005, 0.2), "damping over stiffness"),)

    def step_terms(self, state: MidpointStateSymbols) -> EffectStepTerms:
        force = ca.SX(state.system.n_coordinates, 1)
        for spring, index in self._springs(state):
            force[index] = -self["tau"] * spring.stiffness * state.v[index]
        return EffectStepTerms(dissipative_force=force)


@EFFECTS.register("standard_linear_solid")
class _StandardLinearSolid(_SegmentMemory):
    """Standard linear solid of a segment. A spring and a damper in series are parallel to every bend and twist spring.

    V += 1/2 ratio kappa (q - z)^2, where the massless coordinate z follows q: (q - z) = relaxation_time dz/dt.
    """

    equation = "V += 1/2 ratio kappa (q - z)^2, q - z = relaxation_time dz/dt"
    declared_parameters = (
        ParameterDefinition("ratio", "1", 0.0, 0.0, 5.0, (0.05, 1.0), "relaxing over lasting stiffness"),
        ParameterDefinition("relaxation_time", "s", 0.5, 1e-3, 100.0, (0.05, 10.0), "relaxation time", True),
    )

    def step_terms(self, state: MidpointStateSymbols) -> EffectStepTerms:
        energy, equations = ca.SX(0), {}
        for spring, index in self._springs(state):
            name = f"{self.label}.{spring.joint_name}"
            row = state.internal_rows[name]
            stretch = state.q[index] - state.z[row]
            energy += self["ratio"] * spring.stiffness * stretch**2 / 2
            equations[name] = stretch - self["relaxation_time"] * state.z_rate[row]
        return EffectStepTerms(lagrangian=-energy, internal_equations=equations)


@EFFECTS.register("hysteresis")
class _Hysteresis(_SegmentMemory):
    """Hysteresis of a segment. A Dahl friction element is parallel to every bend and twist spring.

    F = -stiffness z, dz/dt = v - |v| z / yield_angle, with |v| smoothed below `_ABS_SMOOTHING_SPEED`. The unknown
    history is ignored: z = 0 at the start of a recording. From Dahl (1968), as in `joint_presliding`.
    """

    equation = "F = -stiffness z, dz/dt = v - |v| z / yield_angle"
    declared_parameters = (
        replace(
            ParameterDefinition(
                "stiffness", "N m/rad", 0.0, 0.0, 50.0, (0.05, 1.0), "stiffness of the element before it yields"
            ),
            range_scale=_bending_stiffness,
        ),
        ParameterDefinition("yield_angle", "rad", 0.15, 5e-3, 5.0, (0.05, 0.5), "angle over which it yields", True),
    )

    def step_terms(self, state: MidpointStateSymbols) -> EffectStepTerms:
        force, equations, start = ca.SX(state.system.n_coordinates, 1), {}, {}
        for spring, index in self._springs(state):
            name = f"{self.label}.{spring.joint_name}"
            row = state.internal_rows[name]
            v, z = state.v[index], state.z[row]
            speed = ca.sqrt(v**2 + _ABS_SMOOTHING_SPEED**2) - _ABS_SMOOTHING_SPEED
            force[index] = -self["stiffness"] * z
            equations[name] = state.z_rate[row] - v + speed * z / self["yield_angle"]
            start[name] = z
        return EffectStepTerms(generalized_force=force, internal_equations=equations, static_equations=start)


@EFFECTS.register("cubic_stiffness")
class _CubicStiffness(_SegmentEffect):
    """Springs of a segment that stiffen or soften with the angle, by the sign of k3. Each joint adds V += 1/4 k3 q^4.

    The prior range of k3 is -0.5 to 1 times stiffness / (largest angle)^2. The largest angle is `_REFERENCE_ANGLE`
    until `with_prior_ranges_for_largest_angles` sets the one of the data.
    """

    equation = "V += 1/4 k3 q^4"
    required_excitation = "the angle"
    declared_parameters = (
        replace(
            ParameterDefinition("k3", "N m/rad^3", 0.0, -10.0, 50.0, (-0.5, 1.0), "cubic stiffness of every joint"),
            range_scale=lambda system, segment: _bending_stiffness(system, segment) / _REFERENCE_ANGLE**2,
        ),
    )

    def with_prior_ranges_for_largest_angles(self, largest: Mapping[str, float]) -> _CubicStiffness:
        """Return the effect with the prior range of its cubic stiffness scaled by 1 / (segment's largest angle)^2."""
        if self.location not in largest:
            return self
        factor = (_REFERENCE_ANGLE / max(largest[self.location], _MIN_LARGEST_ANGLE)) ** 2
        [k3] = self.definitions
        low, high = k3.prior_range
        return replace(self, definitions=(replace(k3, prior_range=(factor * low, factor * high)),))

    def step_terms(self, state: MidpointStateSymbols) -> EffectStepTerms:
        quartic = sum((state.q[i] ** 4 for _, i in self._springs(state)), ca.SX(0))
        return EffectStepTerms(lagrangian=-self["k3"] / 4 * quartic)


@EFFECTS.register("rest_curvature")
class _RestCurvature(_SpringChange):
    """Rest curvature of a segment, with equal rest angles at all joints: V = 1/2 kappa (q - q_rest)^2."""

    equation = "V = 1/2 kappa (q - q_rest)^2"

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definitions of qx and qy [rad], which add to the rest angles of bends about x and y."""
        axes = {spring.axis for spring in elastic_joints_of_segment(system, location)}
        text = "rest angle of every joint about"
        return tuple(
            ParameterDefinition(f"q{axis}", "rad", 0.0, -1.0, 1.0, (-0.3, 0.3), f"{text} {axis}")
            for axis in "xy"
            if axis in axes
        )

    def _changed(self, spring: ElasticJoint) -> ElasticJoint:
        if spring.deformation != "bend":
            return spring
        return replace(spring, rest_angle=spring.rest_angle + self[f"q{spring.axis}"])


def _doubly_bending_segments(system: System) -> tuple[str, ...]:
    bent = {(spring.segment_name, spring.axis) for spring in system.elastic_joints}
    return tuple(name for name in base.flexible_segment_names(system) if {(name, "x"), (name, "y")} <= bent)


@EFFECTS.register("bend_anisotropy")
class _BendAnisotropy(_SpringChange):
    """Anisotropic bending of a segment. The stiffnesses about y and x differ: kappa_y = kappa_x (1 + ratio)."""

    equation = "kappa_y = kappa_x (1 + ratio)"
    possible_locations = _doubly_bending_segments
    declared_parameters = (
        ParameterDefinition("ratio", "1", 0.0, -0.9, 3.0, (-0.3, 0.3), "stiffness about y over that about x, minus 1"),
    )

    def _changed(self, spring: ElasticJoint) -> ElasticJoint:
        return replace(spring, stiffness=spring.stiffness * (1 + self["ratio"])) if spring.axis == "y" else spring

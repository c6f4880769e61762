"""Errors of the nominal springs, and springs where the nominal model is rigid."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import casadi as ca

from yid_ocp.effects.base import (
    EFFECTS,
    EffectBase,
    ParameterDefinition,
    branch_joints_by_junction,
    inverse_placement,
    mean_bending_stiffness,
    relative_effort_limit,
    robot_joints,
    root_joints_by_base,
    segment_names,
    segment_springs,
    with_elastic_joints,
)
from yid_ocp.model.flexible import UNIT_AXES
from yid_ocp.model.mechanism import Joint, Placement
from yid_ocp.model.system import MidpointState, StepTerms, System

_REFERENCE_ANGLE = 0.5
"""Default for the largest angle in the data, on which the range of k3 depends [rad]."""
_MIN_LARGEST_ANGLE = 0.02
"""Lower limit of the largest angle from which the range of k3 is computed [rad]."""
_SPRING_RELAXATION_TIME = 5e-3
"""Relaxation time of mount and junction springs [s]: too short to damp any visible motion."""

_SPRING = ParameterDefinition(
    "compliance",
    "rad/(N m)",
    0.0,
    0.0,
    1.0,
    (1 / 500, 1 / 5),
    "compliance of the two-axis spring",
    reported_reciprocal="stiffness N m/rad",
)


@EFFECTS.register("cubic_stiffness")
class CubicStiffness(EffectBase):
    """Springs of a segment that stiffen (k3 > 0) or soften (k3 < 0) with angle: V += 1/4 k3 q^4 on every joint."""

    equation = "V += 1/4 k3 q^4"
    required_excitation = "how far it bends"

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of the object's segments."""
        return segment_names(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of k3 [N m/rad^3], expected within -0.5 to 1 times stiffness over the squared largest angle.

        The largest angle is `_REFERENCE_ANGLE` until `with_expected_ranges` is given the one in the data.
        """
        unit = mean_bending_stiffness(system, location) / _REFERENCE_ANGLE**2
        text = "cubic stiffness of every joint"
        return (ParameterDefinition("k3", "N m/rad^3", 0.0, -10 * unit, 50 * unit, (-0.5 * unit, unit), text),)

    def with_expected_ranges(self, largest: Mapping[str, float]) -> CubicStiffness:
        """The effect with the expected range of k3 scaled to the segment's largest angle in the data."""
        if self.location not in largest:
            return self
        factor = (_REFERENCE_ANGLE / max(largest[self.location], _MIN_LARGEST_ANGLE)) ** 2
        [k3] = self.definitions
        low, high = k3.prior_range
        return replace(self, definitions=(replace(k3, prior_range=(factor * low, factor * high)),))

    def step_terms(self, state: MidpointState) -> StepTerms:
        """The energy of the cubic springs."""
        index = state.system.mechanism.joint_index
        angles = [state.q[index(spring.joint_name)] for spring in segment_springs(state.system, self.location)]
        return StepTerms(lagrangian=-self["k3"] / 4 * sum((q**4 for q in angles), ca.SX(0)))


@EFFECTS.register("rest_curvature")
class RestCurvature(EffectBase):
    """A segment that is bent at rest: V = 1/2 kappa (q - q_rest)^2 with equal rest angles at all its joints."""

    equation = "V = 1/2 kappa (q - q_rest)^2"
    required_excitation = "how far it bends"

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of the object's segments."""
        return segment_names(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definitions of the rest angles qx and qy [rad] that are added at every joint that bends about x or y."""
        axes = {spring.axis for spring in segment_springs(system, location)}
        return tuple(
            ParameterDefinition(
                f"q{axis}", "rad", 0.0, -1.0, 1.0, (-0.3, 0.3), f"rest angle of every joint about {axis}"
            )
            for axis in "xy"
            if axis in axes
        )

    def apply_to_system(self, system: System) -> System:
        """The system with shifted rest angles of the segment's bending springs."""
        changed = {
            spring.joint_name: replace(spring, rest_angle=spring.rest_angle + self[f"q{spring.axis}"])
            for spring in segment_springs(system, self.location)
            if spring.deformation == "bend"
        }
        return with_elastic_joints(system, changed)


@EFFECTS.register("bend_anisotropy")
class BendAnisotropy(EffectBase):
    """A segment whose bending stiffness differs between x and y: kappa_y = kappa_x (1 + ratio)."""

    equation = "kappa_y = kappa_x (1 + ratio)"
    required_excitation = "how far it bends"

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of segments that bend about both x and y."""
        bent = {(spring.segment_name, spring.axis) for spring in system.elastic_joints}
        return tuple(name for name in segment_names(system) if {(name, "x"), (name, "y")} <= bent)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of ratio, the relative excess of the bending stiffness about y [1]."""
        return (
            ParameterDefinition("ratio", "1", 0.0, -0.9, 3.0, (-0.3, 0.3), "excess of the bending stiffness about y"),
        )

    def apply_to_system(self, system: System) -> System:
        """The system with the segment's stiffness about y multiplied by 1 + ratio."""
        changed = {
            spring.joint_name: replace(spring, stiffness=spring.stiffness * (1 + self["ratio"]))
            for spring in segment_springs(system, self.location)
            if spring.axis == "y"
        }
        return with_elastic_joints(system, changed)


@EFFECTS.register("joint_spring")
class JointSpring(EffectBase):
    """A spring across an arm joint: V += 1/2 stiffness (q - rest_angle)^2."""

    equation = "V += 1/2 stiffness (q - rest_angle)^2"
    required_excitation = "how far it bends"

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of the arms' joints."""
        return robot_joints(system)

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definitions of stiffness [N m/rad] and rest_angle [rad]."""
        size = relative_effort_limit(system, location)
        return (
            ParameterDefinition(
                "stiffness", "N m/rad", 0.0, 0.0, 300.0 * size, (0.0, 60.0 * size), "stiffness of the spring"
            ),
            ParameterDefinition(
                "rest_angle", "rad", 0.0, -math.pi, math.pi, (-2.0, 2.0), "where it is relaxed", is_shape_parameter=True
            ),
        )

    def step_terms(self, state: MidpointState) -> StepTerms:
        """The energy of the spring."""
        stretch = state.q[state.system.mechanism.joint_index(self.location)] - self["rest_angle"]
        return StepTerms(lagrangian=-self["stiffness"] / 2 * stretch**2)


@EFFECTS.register("mount_compliance")
class MountCompliance(EffectBase):
    """A massless two-axis rotational spring under the object's foot, about x and y of the first link.

    It has the relaxation time `_SPRING_RELAXATION_TIME`.
    """

    equation = "two joints with V = 1/2 stiffness q^2 before the first link"
    required_excitation = "how hard it pulls at its ends"

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """`base`, or the clamp in which the object stands."""
        return tuple(root_joints_by_base(system))

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of the compliance [rad/(N m)], reported as stiffness [N m/rad]."""
        return (_SPRING,)

    def apply_to_system(self, system: System) -> System:
        """The system with two compliant joints before the object's first link."""
        for number, first in enumerate(root_joints_by_base(system)[self.location]):
            suffix = "" if number == 0 else f"_{number}"
            system = _sprung(system, (first,), None, f"{self.label}{suffix}", self["compliance"])
        return system


@EFFECTS.register("junction_compliance")
class JunctionCompliance(EffectBase):
    """A massless two-axis rotational spring between a segment and the branches that leave it at one junction.

    At `w_PARENT` all branches turn together about x and y of the parent's last link, at `junction_BRANCH` one turns
    about its own. It has the relaxation time `_SPRING_RELAXATION_TIME`.
    """

    equation = "two joints with V = 1/2 stiffness q^2 before the branches"
    required_excitation = "how hard it pulls at its ends"

    @classmethod
    def possible_locations(cls, system: System) -> tuple[str, ...]:
        """Names of the junctions."""
        return tuple(branch_joints_by_junction(system))

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of the compliance [rad/(N m)], reported as stiffness [N m/rad]."""
        return (_SPRING,)

    def apply_to_system(self, system: System) -> System:
        """The system with two compliant joints before the junction's branches."""
        branches = branch_joints_by_junction(system)[self.location]
        at = system.mechanism.frame(self.location).placement if self.location.startswith("w_") else None
        return _sprung(system, branches, at, self.label, self["compliance"])


def _sprung(system: System, hung: tuple[str, ...], at: Placement | None, label: str, compliance: ca.SX) -> System:
    """Two massless joints `LABEL_x`, `LABEL_y` between some joints and what they hang on.

    They sit at the placement `at` of the carrier, at that of the only joint hung where there is none.
    """
    tree = system.mechanism
    first = min(tree.joint_index(joint) for joint in hung)
    carrier = tree.joints[first].parent_index
    place = tree.joints[first].placement if at is None else at
    chain = [
        Joint(f"{label}_{axis}", "revolute", carrier, place if axis == "x" else Placement.identity(), UNIT_AXES[axis])
        for axis in "xy"
    ]
    tree = tree.with_inserted_joints(first, chain)
    joints = list(tree.joints)
    for name in hung:
        index = tree.joint_index(name)
        rest = Placement.identity() if at is None else inverse_placement(place) @ joints[index].placement
        joints[index] = replace(joints[index], parent_index=first + 1, placement=rest)
    compliant = {**system.joint_compliances, **{joint.name: compliance for joint in chain}}
    relaxing = {**system.joint_relaxation_times, **{joint.name: _SPRING_RELAXATION_TIME for joint in chain}}
    return replace(
        system,
        mechanism=replace(tree, joints=tuple(joints)),
        joint_compliances=compliant,
        joint_relaxation_times=relaxing,
    )

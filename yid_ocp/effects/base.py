"""Base class of all effects, definitions of their parameters, and locations where effects can act in a system."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import casadi as ca
import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.model.flexible import ElasticJoint
from yid_ocp.model.mechanism import Inertia
from yid_ocp.model.servos_and_springs import UNLIMITED_EFFORT_THRESHOLD
from yid_ocp.model.system import Effect, System
from yid_ocp.registry import Registry

_BAXTER_EFFORT_LIMIT = 50.0  # reference of the ranges of arm effects, which scale with the limit [N m]
_SAME_POINT_DISTANCE = 1e-6  # points of arms nearer than this in all configurations count as one [m]
_CLAMP_AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class ParameterDefinition:
    """The definition of an effect parameter: unit, neutral value, bounds, prior range and reported form."""

    name: str
    unit: str
    neutral_value: float  # value without effect; for a shape parameter the start of a search
    lower: float  # physical bounds
    upper: float
    prior_range: tuple[float, float]  # range (low, high) that an engineer would expect
    description: str
    is_shape_parameter: bool = False  # without influence while amplitudes are neutral (a relaxation time)
    # name and unit, such as `stiffness N m/rad`, of the reciprocal that reports show instead of the value, if any; p in
    # value = reported value^-p
    reported_reciprocal: str = ""
    reciprocal_power: int = 1
    # factor on bounds and range at a location; 1 if absent
    range_scale: Callable[[System, str], float] | None = None

    def _at_location(self, system: System, location: str) -> ParameterDefinition:
        """The definition with bounds and range scaled for a location, and the unit of a prismatic joint there."""
        joint = next((joint for joint in system.mechanism.joints if joint.name == location), None)
        unit = self.unit if joint is None else joint.unit(self.unit)
        scale = 1.0 if self.range_scale is None else self.range_scale(system, location)
        low, high = self.prior_range
        lower, upper, prior = self.lower * scale, self.upper * scale, (low * scale, high * scale)
        return replace(self, unit=unit, lower=lower, upper=upper, prior_range=prior, range_scale=None)

    @property
    def reported_name_and_unit(self) -> tuple[str, str]:
        """The name and unit of the parameter in reports. For a compliance they are those of the stiffness."""
        name, _, unit = self.reported_reciprocal.partition(" ")
        return (name, unit) if self.reported_reciprocal else (self.name, self.unit)

    def internal_from_reported_value(self, value: float) -> float:
        """Convert a nonzero reported value to the value used internally, for example a stiffness to a compliance."""
        return value**-self.reciprocal_power if self.reported_reciprocal else value


@dataclass(frozen=True)
class ReportedParameterValue:
    """The value, standard deviation and unit of an effect parameter, as shown in reports."""

    value: float
    std: float
    unit: str


@dataclass(frozen=True)
class EffectBase(Effect):
    """The base class of all effects. A subclass overrides the methods for the parts of the model that it changes."""

    definitions: tuple[ParameterDefinition, ...] = ()  # definitions of `parameters`, scaled for the location
    arm_joints: tuple[str, ...] = ()  # names of the arm's joints where `location` is an arm

    equation: ClassVar[str] = ""  # equation that the kind adds, as text
    # what a motion must vary to distinguish the kind from others, a noun phrase such as "the speed"
    required_excitation: ClassVar[str] = "the motion"
    required_sensors: ClassVar[frozenset[str]] = frozenset()  # signals without which the effect is not observable
    # whether the effect at one location implies nothing about other locations, as for a mass (unlike friction)
    is_local: ClassVar[bool] = False
    is_load: ClassVar[bool] = False  # whether it is carried mass
    moves_prescribed_joint: ClassVar[bool] = False  # whether it changes the motion of a prescribed joint
    is_joint_friction: ClassVar[bool] = False  # whether the command `friction` compares it with other laws
    # whether a location is a sensor `GROUP:FRAME`, which a diagnosis tries if recordings contain it
    is_at_recorded_sensor: ClassVar[bool] = False
    # whether a location may also be the name of a point group, which a diagnosis tries if recordings contain it
    is_at_point_groups: ClassVar[bool] = False
    # names of all locations where the effect can act, and of those that a diagnosis tries (default: all)
    possible_locations: ClassVar[Callable[[System], Collection[str]]]
    candidate_locations: ClassVar[Callable[[System], Collection[str]] | None] = None
    declared_parameters: ClassVar[tuple[ParameterDefinition, ...]] = ()  # put at a location by `parameter_definitions`
    declared_internal_coordinate_names: ClassVar[tuple[str, ...]] = ()  # the same at every location

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Return the definitions of the effect's parameters, with bounds and prior ranges scaled for the location."""
        return tuple(definition._at_location(system, location) for definition in cls.declared_parameters)

    @classmethod
    def internal_coordinate_names(cls, location: str, system: System) -> tuple[str, ...]:
        """Return the names of the effect's own states, in addition to the joints' motion."""
        return cls.declared_internal_coordinate_names

    @property
    def max_abs_initial_internal_coordinates(self) -> Mapping[str, float]:
        """The bound on the absolute initial value of each internal coordinate whose initial value is estimated."""
        return {}

    def alternative_start(self, start: Mapping[str, float]) -> Mapping[str, float] | None:
        """Return parameter values for a second starting point, in addition to `start`. None if one start is enough."""
        return None

    def __getitem__(self, parameter: str) -> ca.SX:
        return self.parameters[f"{self.label}.{parameter}"].symbol

    @property
    def neutral_values(self) -> dict[str, float]:
        """The parameter values at which the effect vanishes, by parameter name."""
        return {f"{self.label}.{q.name}": q.neutral_value for q in self.definitions}

    @property
    def amplitude_parameter_names(self) -> tuple[str, ...]:
        """The names of the parameters that set the strength of the effect. It vanishes if they are neutral."""
        return tuple(f"{self.label}.{q.name}" for q in self.definitions if not q.is_shape_parameter)

    @property
    def shape_parameter_names(self) -> tuple[str, ...]:
        """The names of shape parameters (such as a relaxation time), which have no influence at neutral amplitudes."""
        return tuple(f"{self.label}.{q.name}" for q in self.definitions if q.is_shape_parameter)

    @property
    def max_sticking_speed(self) -> float:
        """The joint speed [rad/s] below which this friction can hold the joint. It is 0 if it cannot hold a joint."""
        return 0.0

    @property
    def prior_ranges(self) -> dict[str, tuple[float, float]]:
        """The lowest and highest expected value of every parameter, by name, in the parameter's unit."""
        return {f"{self.label}.{q.name}": q.prior_range for q in self.definitions}

    def to_reported_parameters(
        self, values: Mapping[str, float] | None = None, stds: Mapping[str, float] | None = None
    ) -> dict[str, ReportedParameterValue]:
        """Convert the parameters to the form used in reports. For example, a compliance is reported as a stiffness.

        Missing `values` are nominal, missing `stds` NaN. The std of a reported C^(-1/p) is C^(-1/p) std(C)/(p C).
        """
        result = {}
        for definition, entry in zip(self.definitions, self.parameters, strict=True):
            value = float((values or {}).get(entry.name, entry.value))
            std = float((stds or {}).get(entry.name, math.nan))
            name, unit = definition.reported_name_and_unit
            if definition.reported_reciprocal:
                power, internal = definition.reciprocal_power, value
                value = math.inf if not value else 1 / value if power == 1 else value ** (-1 / power)
                std = abs(value * std / (power * internal)) if internal else math.nan
            result[name] = ReportedParameterValue(value, std, unit)
        return result

    def with_prior_ranges_for_largest_angles(self, largest: Mapping[str, float]) -> EffectBase:
        """Return the effect with prior ranges adapted to the largest joint angle of each segment in the data [rad]."""
        return self


EFFECTS: Registry[type[EffectBase]] = Registry("effect")


def flexible_segment_names(system: System) -> tuple[str, ...]:
    """Return the names of the object's flexible segments, such as the branches of a cable."""
    return tuple(segment.name for segment in system.segment_layouts)


def object_joint_names(system: System) -> tuple[str, ...]:
    """Return the names of the joints in all segments of the flexible object."""
    return tuple(joint for segment in system.segment_layouts for link in segment.link_joints for joint in link)


def moving_frame_names(system: System) -> tuple[str, ...]:
    """Return the names of all frames that a joint moves."""
    return tuple(name for name, frame in system.mechanism.frames.items() if frame.joint_index >= 0)


def clamp_names(system: System) -> tuple[str, ...]:
    """Return the names of all floating clamps. A clamp NAME has the six joints `NAME_x` to `NAME_rz`."""
    names = set(system.mechanism.joint_names)
    found = [name.removesuffix("_rz") for name in system.mechanism.joint_names if name.endswith("_rz")]
    return tuple(clamp for clamp in found if all(f"{clamp}_{axis}" in names for axis in _CLAMP_AXES))


def arm_joint_names(system: System) -> tuple[str, ...]:
    """Return the names of all joints that belong neither to the object nor to a clamp or compliant mount."""
    clamps = {f"{clamp}_{axis}" for clamp in clamp_names(system) for axis in _CLAMP_AXES}
    other = {*object_joint_names(system), *system.joint_compliances, *clamps}
    return tuple(name for name in system.mechanism.joint_names if name not in other)


def servo_joint_names(system: System) -> tuple[str, ...]:
    """Return the names of the arm joints that have a servo."""
    return tuple(name for name in arm_joint_names(system) if name in system.servos)


def grasp_names(system: System) -> tuple[str, ...]:
    """Return the names of all grasps, including the grasps of clamps."""
    return tuple(grasp.name for grasp in system.grasps)


def joint_names_by_arm(system: System) -> dict[str, tuple[str, ...]]:
    """Return joint names by arm. An arm's name is its grasp, else its joints' `left` or `right`, else `gripper`."""
    joints, tree = arm_joint_names(system), system.mechanism
    found: dict[str, tuple[str, ...]] = {}
    for grasp in system.grasps:
        chain = {tree.joints[i].name for i in tree.ancestor_joint_indices(tree.frame(grasp.holder_frame).joint_index)}
        if held := tuple(name for name in joints if name in chain):
            found[grasp.name] = held
    left = tuple(name for name in joints if not any(name in arm for arm in found.values()))
    for side in ("left", "right"):
        if side not in found and (own := tuple(name for name in left if name.startswith(f"{side}_"))):
            found[side] = own
    if not found and (loose := tuple(name for name in left if not name.startswith(("left_", "right_")))):
        found["gripper"] = loose
    return found


def _arm_tip_frames(system: System) -> tuple[str, ...]:
    """Names of one frame at the end of every arm without a grasp, preferably that of a gripper or hand."""
    tree, tips = system.mechanism, []
    for name, joints in joint_names_by_arm(system).items():
        if name in grasp_names(system):
            continue
        last = max(tree.joint_index(joint) for joint in joints)
        frames = [frame for frame, entry in tree.frames.items() if entry.joint_index == last]
        named = [f for word in ("gripper", "tcp", "hand", "tool") for f in frames if f.endswith(word)]
        tips += (named or frames[-1:])[:1]
    return tuple(tips)


def effort_limit_ratio_to_baxter(system: System, joint: str) -> float:
    """Return a joint's effort limit divided by that of Baxter's joints, at least 1. It is 1 for unlimited joints."""
    limit = system.mechanism.joint(joint).effort_limit
    return max(1.0, limit / _BAXTER_EFFORT_LIMIT) if limit < UNLIMITED_EFFORT_THRESHOLD else 1.0


def frame_names_at_arm_link_ends(system: System) -> tuple[str, ...]:
    """Return the names of frames at the ends of the arm links, without fixed frames and without coincident ones."""
    tree = system.mechanism
    own = {tree.joint_index(name) for name in arm_joint_names(system)}
    # the frame of a link is at the end of the previous link
    first = {f.joint_index: name for name, f in list(tree.frames.items())[::-1] if f.joint_index in own}
    names = (*_arm_tip_frames(system), *(first[joint] for joint in sorted(first)))
    held = [end for grasp in system.grasps for end in (grasp.holder_frame, grasp.held_frame)]
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (3, system.n_coordinates))
    paths = dict(zip((*names, *held), frame_positions(system, {}, (*names, *held), q).swapaxes(0, 1), strict=True))
    known = [path for name, path in paths.items() if name in held]
    found = []
    for name in dict.fromkeys(names):
        path = paths[name]
        moves = np.ptp(path, axis=0).max() > _SAME_POINT_DISTANCE
        if moves and not any(np.abs(path - other).max() < _SAME_POINT_DISTANCE for other in known):
            found.append(name)
            known.append(path)
    return tuple(found)


def one_frame_name_per_arm_link(system: System) -> tuple[str, ...]:
    """Choose one frame for every arm link with mass: at a grasp, else at a gripper, else the first frame of the link.

    A finger (a prismatic joint without child joints) counts as part of the link that carries it.
    """
    tree = system.mechanism
    preferred = [*(grasp.holder_frame for grasp in system.grasps), *_arm_tip_frames(system)]
    parents, found = {joint.parent_index for joint in tree.joints}, []
    for name in arm_joint_names(system):
        index = tree.joint_index(name)
        joint = tree.joints[index]
        finger = joint.kind == "prismatic" and index not in parents and joint.parent_index >= 0
        frames = [frame for frame, entry in tree.frames.items() if entry.joint_index == index]
        if not finger and frames and joint.bodies:
            found.append(next((frame for frame in preferred if frame in frames), frames[0]))
    return tuple(found)


def frame_positions(system: System, values: Mapping[str, float], frames: Sequence[str], q: Array) -> Array:
    """Compute the positions (N, nf, 3) [m] of frames at the configurations `q` (N, n), with parameter `values`."""
    symbol, kinematics = system.symbols_and_kinematics
    at = ca.vertcat(ca.SX(0, 1), *(kinematics.frame_position(name) for name in frames))
    function = ca.Function("at", [symbol, system.parameters.symbols], [ca.densify(at)])
    theta = system.parameters.vector(values)
    return np.array([function(row, theta) for row in q]).reshape(len(q), len(frames), 3)


def segment_name_of_frame(system: System, frame: str) -> str | None:
    """Return the name of the segment that contains the frame, or None."""
    index = system.mechanism.frame(frame).joint_index
    if index < 0:
        return None
    name = system.mechanism.joints[index].name
    return next((s.name for s in system.segment_layouts if any(name in link for link in s.link_joints)), None)


def elastic_joints_of_segment(system: System, segment: str) -> tuple[ElasticJoint, ...]:
    """Return the elastic joints of one segment."""
    return tuple(spring for spring in system.elastic_joints if spring.segment_name == segment)


def nominal_bend_stiffness_by_joint_of_segment(system: System, segment: str) -> dict[str, float]:
    """Return the nominal stiffness [N m/rad] of the joints that bend a segment, or of all its joints if none bends."""
    springs = elastic_joints_of_segment(system, segment)
    chosen = [spring for spring in springs if spring.deformation == "bend"] or springs
    function = ca.Function("stiffness", [system.parameters.symbols], [s.stiffness for s in chosen])
    return {s.joint_name: float(k) for s, k in zip(chosen, function.call([system.parameters.vector()]), strict=True)}


def effort_scaled_parameter_definition(
    name: str, unit: str, upper: float, expected: float, description: str
) -> ParameterDefinition:
    """Define a joint parameter that is neutral at 0. `effort_limit_ratio_to_baxter` scales `upper` and `expected`."""
    prior, scale = (0.0, expected), effort_limit_ratio_to_baxter
    return ParameterDefinition(name, unit, 0.0, 0.0, upper, prior, description, range_scale=scale)


def compliance_parameter_definition(
    unit: str, upper: float, prior: tuple[float, float], part: str, reported: str
) -> ParameterDefinition:
    """Define the compliance parameter of `part`, from 0 (rigid) to `upper`. `reported` is its reciprocal's unit."""
    text, said = f"compliance of the {part}", f"stiffness {reported}"
    return ParameterDefinition("compliance", unit, 0.0, 0.0, upper, prior, text, reported_reciprocal=said)


def one_joint_generalized_force(system: System, joint: str, value: ca.SX) -> ca.SX:
    """Return the generalized force vector (n, 1) that is `value` at one joint and zero at all others."""
    force = ca.SX(system.n_coordinates, 1)
    force[system.mechanism.joint_index(joint)] = value
    return force


def system_with_changed_bodies(
    system: System, joints: Collection[str], change: Callable[[tuple[Inertia, ...]], Iterable[Inertia]]
) -> System:
    """Return a copy of the system in which `change` was applied to the rigid bodies of the named joints."""
    tree = system.mechanism
    changed = tuple(replace(j, bodies=tuple(change(j.bodies))) if j.name in joints else j for j in tree.joints)
    return replace(system, mechanism=replace(tree, joints=changed))

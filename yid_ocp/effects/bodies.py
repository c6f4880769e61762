"""Effects on the mass, inertia, length and weight of bodies, and air drag."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import casadi as ca
import numpy as np

from yid_ocp.effects import base
from yid_ocp.effects.base import EFFECTS, EffectBase, ParameterDefinition, ReportedParameterValue
from yid_ocp.model.kinematics import Kinematics, motion_cross_force_product
from yid_ocp.model.mechanism import Inertia, merge_inertias, symbolic_rotation_from_rpy
from yid_ocp.model.parameters import Parameter
from yid_ocp.model.system import EffectStepTerms, ForceWithFactoredDerivatives, MidpointStateSymbols, System

_MAX_PAYLOAD_DISTANCE = 0.5  # distance of a payload's centre from its frame [m]
_MAX_COM_SHIFT = 0.05  # shift of a link's centre of mass without added mass [m]
_MAX_REMOVED_MASS_FRACTION = 0.9  # fraction of a link's mass that a negative payload may remove
_POINT_INERTIA_DISTANCE = 2.0  # beyond it a payload does not have the inertia of a point [m]
_POINT_INERTIA_MIN_MASS = 1e-2  # lighter payloads have no inertia of their own [kg]
_UNLIMITED_MOMENT_FRACTION = 0.95  # ratio of limited to given moments above which the limit is negligible
_MIN_LINK_EXTENT = 1e-3  # root mean square [m]
_AIR_DENSITY = 1.2  # [kg/m^3]
_ABS_SMOOTHING_SPEED = 1e-3  # smoothing range of |v_n| in the drag [m/s]


class _CarriedBody(NamedTuple):
    mass: float  # [kg]
    center_of_mass: np.ndarray  # [m]
    second_moment: np.ndarray  # integral of r r' dm about it [kg m^2]


def _carried_body(system: System, joint: int) -> _CarriedBody:
    """Nominal mass properties of the bodies on a joint's moving side, in its frame. Without bodies the mass is zero."""
    whole = merge_inertias([replace(body, gravity_fraction=ca.SX(1)) for body in system.mechanism.joints[joint].bodies])
    if whole is None:
        return _CarriedBody(0.0, np.zeros(3), np.zeros((3, 3)))
    parameters = system.parameters
    function = ca.Function("carried", [parameters.symbols], [whole.mass, whole.center_of_mass, whole.inertia_about_com])
    mass, com, tensor = (np.array(ca.densify(x)) for x in function(parameters.vector()))
    return _CarriedBody(float(mass[0, 0]), com.ravel(), np.trace(tensor) / 2 * np.eye(3) - tensor)


class _ScaledBodies(EffectBase):
    """Masses and inertias of a segment, or of the link that an arm joint moves, multiplied by a factor."""

    required_excitation = "the acceleration"

    def apply_to_system(self, system: System) -> System:
        links = {s.name: s.link_joints for s in system.segment_layouts}.get(self.location, ((self.location,),))
        joints, scale = {joint for link in links for joint in link}, self["scale"]
        return base.system_with_changed_bodies(system, joints, lambda bodies: (b.scaled_by(scale) for b in bodies))


@EFFECTS.register("density")
class _Density(_ScaledBodies):
    """Scale factor on all masses and inertias of a segment."""

    equation = "masses and inertias times scale"
    possible_locations = base.flexible_segment_names
    declared_parameters = (ParameterDefinition("scale", "1", 1.0, 0.2, 3.0, (0.7, 1.3), "factor on mass and inertia"),)


def _joints_with_mass(system: System) -> tuple[str, ...]:
    tree = system.mechanism
    return tuple(name for name in base.arm_joint_names(system) if tree.joint(name).bodies)


@EFFECTS.register("link_mass")
class _LinkMass(_ScaledBodies):
    """Scale factor on mass and inertia of the link that an arm joint moves."""

    equation = "mass and inertia of the child link times scale"
    is_local = True
    possible_locations = _joints_with_mass
    declared_parameters = (ParameterDefinition("scale", "1", 1.0, 0.2, 3.0, (0.8, 1.2), "factor on mass and inertia"),)


def system_with_mass_scale_parameters(system: System, name: str) -> System:
    """Return a copy with a parameter `JOINT.name` for each arm link, which scales the link's mass and inertia."""
    tree, text = system.mechanism, "mass and inertia of the link on {} over those of the URDF"
    factors = {j: Parameter(f"{j}.{name}", 1.0, "1", 0.2, 3.0, text.format(j)) for j in _joints_with_mass(system)}
    joints = tuple(
        replace(j, bodies=tuple(b.scaled_by(factors[j.name].symbol) for b in j.bodies)) if j.name in factors else j
        for j in tree.joints
    )
    parameters = system.parameters.with_added(factors.values())
    return replace(system, mechanism=replace(tree, joints=joints), parameters=parameters)


def _tips_and_link_ends(system: System) -> tuple[str, ...]:
    """Names of segment tips, junctions and ends of arm links."""
    ends = (f"{prefix}_{s.name}" for s in system.segment_layouts for prefix in ("w", "junction"))
    return (*(name for name in ends if name in system.mechanism.frames), *base.frame_names_at_arm_link_ends(system))


@EFFECTS.register("point_mass")
class _PointMass(EffectBase):
    """Point mass fixed to a frame. It adds the energies T += 1/2 mass |v|^2 and V += -mass g.x."""

    equation = "T += 1/2 mass |v|^2, V -= mass g.x"
    required_excitation = "the acceleration"
    is_local = is_load = True
    possible_locations = base.moving_frame_names
    candidate_locations = _tips_and_link_ends

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Definition of `mass` [kg]. The upper bound is the object's mass or, on an arm, the arm's payload limit."""
        upper, expected = _bearable(system, location)
        return (ParameterDefinition("mass", "kg", 0.0, 0.0, upper, (0.0, expected), "mass added at the point"),)

    def apply_to_system(self, system: System) -> System:
        frame = system.mechanism.frame(self.location)
        point = Inertia(self["mass"], frame.placement.translation, ca.SX(ca.DM.zeros(3, 3)))
        joint = system.mechanism.joints[frame.joint_index].name
        return base.system_with_changed_bodies(system, [joint], lambda bodies: (*bodies, point))


@EFFECTS.register("payload")
class _Payload(EffectBase):
    """A point mass fixed to a frame, with first moments m = (mx, my, mz) about the frame. A negative mass removes mass.

    Let the bodies that move with the joint have mass M, centre C, and second-moment matrix Sigma, the integral of r r'
    dm about C. The payload adds `mass`, the first moment e = s + mass (frame - C) about C, and the second moment about
    C

        K = e e' (1/(M + mass) + c h),  c = w M/(M + mass),
        w = mass^3/(mass^4 + (|e|/`_POINT_INERTIA_DISTANCE`)^4 + `_POINT_INERTIA_MIN_MASS`^4).

    These terms equal those of a point mass (s = m, w = 1/mass, h = 1, K = e e'/mass), except in three cases:

    - Large moments are limited smoothly at L = sqrt((`_MAX_PAYLOAD_DISTANCE` mass)^2 + (`_MAX_COM_SHIFT` M)^2), with M
      at least 1 kg: s = m (1 + (|m|/L)^8)^(-1/8). s is also the reported moment.
    - Near mass zero, and beyond `_POINT_INERTIA_DISTANCE`, w goes smoothly to zero, because 1/mass diverges.
    - For a removed mass h = (1 + a^4)^(-1/4), with a = c e' Sigma^-1 e. The second moment of the link about its new
      centre, Sigma + c h e e', thus stays positive. h is almost 1 if the mass was part of the link.
    """

    equation = "a mass at (mx, my, mz)/mass, moving with the frame"
    required_excitation = "the orientation to gravity"
    is_local = is_load = True
    possible_locations = base.moving_frame_names
    # payloads at two frames of one link are equivalent
    candidate_locations = base.one_frame_name_per_arm_link

    @classmethod
    def parameter_definitions(cls, location: str, system: System) -> tuple[ParameterDefinition, ...]:
        """Define the payload's mass and moments. It removes at most `_MAX_REMOVED_MASS_FRACTION` of the link's mass."""
        upper, expected = _bearable(system, location)
        lower = -_MAX_REMOVED_MASS_FRACTION * _carried_body(system, system.mechanism.frame(location).joint_index).mass
        far, near = (_MAX_PAYLOAD_DISTANCE * mass for mass in (upper, expected))
        moments = (
            ParameterDefinition(f"m{axis}", "kg m", 0.0, -far, far, (-near, near), f"mass times its place along {axis}")
            for axis in "xyz"
        )
        mass = ParameterDefinition("mass", "kg", 0.0, lower, upper, (lower, expected), "mass added to the link")
        return (mass, *moments)

    def alternative_start(self, start: Mapping[str, float]) -> Mapping[str, float] | None:
        # near zero mass, no second moment distinguishes the two signs
        mass, *moments = (start.get(f"{self.label}.{quantity.name}", 0.0) for quantity in self.definitions)
        opposite = -math.copysign(np.linalg.norm(moments) / _MAX_PAYLOAD_DISTANCE, mass)
        other = float(np.clip(opposite, self.definitions[0].lower, self.definitions[0].upper))
        return {f"{self.label}.mass": other} if other * mass < 0 else None

    def to_reported_parameters(
        self, values: Mapping[str, float] | None = None, stds: Mapping[str, float] | None = None
    ) -> dict[str, ReportedParameterValue]:
        """Return the mass and the limited first moments for reports. Moments at their limit have the std NaN."""
        found = super().to_reported_parameters(values, stds)
        mass, *moments = (found[quantity.name].value for quantity in self.definitions)
        own = -self.definitions[0].lower / _MAX_REMOVED_MASS_FRACTION
        kept = float(_kept(ca.SX(mass), ca.SX(ca.DM(moments)), own))
        for name in ("mx", "my", "mz"):
            std = found[name].std if kept > _UNLIMITED_MOMENT_FRACTION else math.nan
            found[name] = replace(found[name], value=kept * found[name].value, std=std)
        return found

    def apply_to_system(self, system: System) -> System:
        frame = system.mechanism.frame(self.location)
        joint, link = system.mechanism.joints[frame.joint_index], _carried_body(system, frame.joint_index)
        mass, centre = self["mass"], ca.SX(ca.DM(link.center_of_mass))
        moment = ca.vertcat(*(self[f"m{axis}"] for axis in "xyz"))
        first = frame.placement.rotation @ (moment * _kept(mass, moment, link.mass))
        first += mass * (frame.placement.translation - centre)
        second = ca.densify(first @ first.T) * _spread(mass, first, link) - first @ first.T
        tensor = (second[0, 0] + second[1, 1] + second[2, 2]) * ca.SX.eye(3) - second
        # two bodies, one of 1 kg, to avoid a division by the mass
        one = Inertia(ca.SX(1), centre + first, ca.densify(tensor))
        other = Inertia(mass - 1, centre, ca.SX(ca.DM.zeros(3, 3)))
        return base.system_with_changed_bodies(system, [joint.name], lambda bodies: (*bodies, one, other))


def _kept(mass: ca.SX, moment: ca.SX, own: float) -> ca.SX:
    """Ratio of limited to given first moments; see `_Payload`."""
    most = (_MAX_PAYLOAD_DISTANCE * mass) ** 2 + (_MAX_COM_SHIFT * max(own, 1.0)) ** 2
    return (1 + (ca.dot(moment, moment) / most) ** 4) ** (-1 / 8)


def _spread(mass: ca.SX, first: ca.SX, link: _CarriedBody) -> ca.SX:
    """Factor of e e' in K, 1/mass for a point; see `_Payload`."""
    far = ca.dot(first, first) / _POINT_INERTIA_DISTANCE**2
    inverse = mass**3 / (mass**4 + far**2 + _POINT_INERTIA_MIN_MASS**4)
    if link.mass == 0:
        return inverse
    whole = link.mass + mass
    beyond = inverse * link.mass / whole
    size, axes = np.linalg.eigh(link.second_moment)
    stretch = ca.SX(ca.DM(axes / np.sqrt(np.maximum(size, link.mass * _MIN_LINK_EXTENT**2)))).T @ first
    taken = ca.fmin(beyond, 0) * ca.dot(stretch, stretch)
    return 1 / whole + beyond / ca.sqrt(ca.sqrt(1 + taken**4))


def _bearable(system: System, frame: str) -> tuple[float, float]:
    """Upper bound, and largest expected value, of an added mass at a frame [kg]."""
    tree = system.mechanism
    joint = tree.frame(frame).joint_index
    if base.segment_name_of_frame(system, frame) is not None:
        whole = sum(_carried_body(system, tree.joint_index(name)).mass for name in base.object_joint_names(system))
        return max(0.5, whole), max(0.05, whole)
    moving = set(base.arm_joint_names(system)) & {tree.joints[i].name for i in tree.ancestor_joint_indices(joint)}
    size = max((base.effort_limit_ratio_to_baxter(system, name) for name in moving), default=1.0)
    return 10.0 * size, 3.0 * size


def _length_names(system: System, segment: str) -> list[str]:
    own = f"{segment}.length"
    return [name for name in system.parameters.names if name == own or name.startswith(f"{own}_")]


@EFFECTS.register("length_scale")
class _LengthScale(EffectBase):
    """Scale factor on the link lengths of a segment. Its mass is unchanged."""

    equation = "link lengths times scale"
    required_excitation = "the posture"
    possible_locations = lambda system: [s for s in base.flexible_segment_names(system) if _length_names(system, s)]
    declared_parameters = (ParameterDefinition("scale", "1", 1.0, 0.8, 1.2, (0.97, 1.03), "factor on link lengths"),)

    def apply_to_system(self, system: System) -> System:
        lengths = ca.vertcat(*(system.parameters[name].symbol for name in _length_names(system, self.location)))
        return system.map_expressions(lambda expression: ca.substitute(expression, lengths, lengths * self["scale"]))


@EFFECTS.register("rotor_inertia")
class _RotorInertia(EffectBase):
    """Rotor inertia of a motor, reflected to its joint. It adds the kinetic energy 1/2 armature v^2."""

    equation = "T += 1/2 armature v^2"
    required_excitation = "the acceleration"
    possible_locations = base.arm_joint_names
    declared_parameters = (
        base.effort_scaled_parameter_definition("armature", "kg m^2", 5.0, 1.0, "rotor inertia at the joint"),
    )

    def step_terms(self, state: MidpointStateSymbols) -> EffectStepTerms:
        v = state.v[state.system.mechanism.joint_index(self.location)]
        return EffectStepTerms(lagrangian=self["armature"] / 2 * v**2)


@EFFECTS.register("aerodynamic_drag")
class _AerodynamicDrag(EffectBase):
    """Quadratic air drag on a segment's links, F = -J_c' 1/2 rho_air cd 2 r l |v_n| v_n.

    v_n is the velocity of a link's centre (with Jacobian J_c) normal to the link; |v_n| is smoothed below
    `_ABS_SMOOTHING_SPEED`. cd is the drag coefficient, r the link's radius and l its length.
    """

    equation = "F = -J_c' 1/2 rho_air cd 2 r l |v_n| v_n"
    required_excitation = "the speed"
    possible_locations = base.flexible_segment_names
    declared_parameters = (ParameterDefinition("cd", "1", 0.0, 0.0, 20.0, (0.0, 3.0), "drag coefficient"),)

    def step_terms(self, state: MidpointStateSymbols) -> EffectStepTerms:
        system, kinematics = state.system, state.kinematics
        tree, segment = system.mechanism, system.find_segment_layout(self.location)
        velocity, screw_rates = kinematics.joint_velocities_and_screw_rates(state.v)
        wrenches, slopes = {}, {}
        for link, length in zip(segment.link_joints, segment.link_lengths, strict=True):
            j = tree.joint_index(link[-1])
            along = kinematics.joint_rotations[j][:, 2]
            centre = kinematics.joint_origins[j] + along * length / 2
            v = velocity[j][3:] + ca.cross(velocity[j][:3], centre)
            normal = v - along * ca.dot(along, v)
            speed = ca.sqrt(ca.dot(normal, normal) + _ABS_SMOOTHING_SPEED**2)
            factor = self["cd"] * _AIR_DENSITY * segment.radius * length
            push = -factor * speed * normal
            slope = -factor * (speed * (ca.SX.eye(3) - along @ along.T) + normal @ normal.T / speed)
            wrenches[j] = ca.vertcat(ca.cross(centre, push), push)
            reach = ca.horzcat(-ca.skew(centre), ca.SX.eye(3))
            slopes[j] = reach.T @ slope @ reach
        return EffectStepTerms(force_with_derivatives=_on_bodies(kinematics, screw_rates, wrenches, slopes))


@EFFECTS.register("gravity_scale")
class _GravityScale(EffectBase):
    """Additional weight of the object as a fraction of its full weight. Its inertia is unchanged."""

    equation = "V += -fraction x sum of m g.x over the object"
    required_excitation = "the orientation to gravity"
    possible_locations = lambda system: ("object",) if system.segment_layouts else ()
    declared_parameters = (ParameterDefinition("fraction", "1", 0.0, -2.0, 2.0, (-1.0, 1.0), "added weight"),)

    def apply_to_system(self, system: System) -> System:

        def scaled(bodies: tuple[Inertia, ...]) -> Iterator[Inertia]:
            return (replace(body, gravity_fraction=body.gravity_fraction + self["fraction"]) for body in bodies)

        return base.system_with_changed_bodies(system, base.object_joint_names(system), scaled)


@EFFECTS.register("gravity_tilt")
class _GravityTilt(EffectBase):
    """Rotation of gravity by rx about the world's x axis, then by ry about its y axis."""

    equation = "g = Ry(ry) Rx(rx) g_0"
    required_excitation = "the orientation to gravity"
    possible_locations = lambda system: ("world",)
    declared_parameters = tuple(
        ParameterDefinition(f"r{axis}", "rad", 0.0, -0.5, 0.5, (-0.05, 0.05), f"turn about {axis}") for axis in "xy"
    )

    def apply_to_system(self, system: System) -> System:
        return replace(system, gravity=symbolic_rotation_from_rpy(self["rx"], self["ry"]) @ system.gravity)


def _on_bodies(
    kinematics: Kinematics, screw_rates: list[ca.SX], wrenches: dict[int, ca.SX], slopes: dict[int, ca.SX]
) -> ForceWithFactoredDerivatives:
    """Generalized force of wrenches that depend only on their body's motion, with its derivatives.

    `wrenches` (6, 1), by joint index, are about the world origin and must rotate with the body and its velocity.
    `slopes` (6, 6) are their symmetric derivatives by the spatial velocity. W_j and K_j are the sums of both over all
    bodies that joint j moves. S_j is its screw, D_j = V_parent(j) x S_j and F_j = S_j . W_j. The columns of
    `ForceWithFactoredDerivatives` are A_j = K_j S_j and T_j = K_j D_j + S_j x* W_j, because a rotation of joint i
    rotates body and wrench together, except for the velocity D_i that it adds.
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
        turned[j] = slopes[j] @ screw_rates[j] + motion_cross_force_product(screws[j], wrenches[j])
    return ForceWithFactoredDerivatives(ca.densify(force), ca.horzcat(*along), ca.horzcat(*turned))

"""A round rod, such as a fishing rod or a branch, whose radius changes linearly along its length."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import casadi as ca
from annotated_types import Ge, Gt, Le

from yid_ocp.model.flexible import FlexibleObject, FlexibleSegment
from yid_ocp.model.mechanism import Inertia, Joint
from yid_ocp.model.objects import base
from yid_ocp.model.objects.base import OBJECT_KINDS, InitialObjectSettings, InitObjectFactory, MountedObjectBuilder
from yid_ocp.model.parameters import Parameter
from yid_ocp.options import OptionInfo

_SEGMENT = "rod"
_FURTHER_NUMBERS = {"tip_radius": "the radius of its tip [m]"}


def _init_object(numbers: Mapping[str, Any], links: int) -> InitialObjectSettings:
    length, mass, radius, tip = base.extract_required_object_numbers(
        "a tapered rod", numbers, base.SIZE_AND_MASS_DESCRIPTIONS | _FURTHER_NUMBERS
    )
    item = _TaperedRod(length=length, mass=mass, base_radius=radius, tip_radius=tip, links=links, joint_axes="xy")
    return InitialObjectSettings(item, base.initial_parameters_with_comments(item.segment_definitions(), 1.0))


@OBJECT_KINDS.register("tapered_rod")
@dataclass(frozen=True, kw_only=True)
class _TaperedRod(MountedObjectBuilder):
    """A solid round rod whose radius changes linearly from the clamped base to the tip. The segment is named `rod`.

    `rod.bend` and `rod.twist` [N m^2] and `rod.damping` [N m^2 s] are the values at the base. At radius r they are
    multiplied by (r / base radius)^4. `rod.taper` is tip radius / base radius.
    """

    default_link_refinement = True
    init_templates: ClassVar[Mapping[str, InitObjectFactory]] = {
        "tapered_rod": InitObjectFactory(8, _init_object, _FURTHER_NUMBERS)
    }

    kind: Annotated[Literal["tapered_rod"], OptionInfo("kind of object")] = "tapered_rod"
    length: Annotated[float, Gt(0), Le(50), OptionInfo("length from base to tip", "m")]
    mass: Annotated[float, Gt(0), OptionInfo("mass of the whole rod", "kg")]
    base_radius: Annotated[float, Gt(0), Le(5), OptionInfo("radius at the base", "m")]
    tip_radius: Annotated[float, Gt(0), Le(5), OptionInfo("radius at the tip", "m")]
    links: Annotated[int, Ge(1), Le(64), OptionInfo("number of equal links")] = 8
    joint_axes: Annotated[str, OptionInfo("rotation axes, base to tip; others are rigid (no z: no twist)")] = "xyz"

    def segment_definitions(self, damping: float = 0.0, link_division: int = 1) -> list[FlexibleSegment]:
        """Define the rod as one segment with the radius of its base. `build` then tapers the links."""
        sizes = self.length, self.mass, self.base_radius, self.links * link_division
        rod = FlexibleSegment(_SEGMENT, *sizes, damping=damping, values_given_as_rigidities=True, clamped_at_base=True)
        return [replace(rod, joint_axes=self.joint_axes)]

    def build(self, damping: float, link_division: int = 1) -> FlexibleObject:
        return _tapered(super().build(damping, link_division), self.tip_radius / self.base_radius)


def _tapered(plain: FlexibleObject, ratio: float) -> FlexibleObject:
    """The object with the parameter `rod.taper`, on which masses, inertias, springs and dampers of links depend."""
    tree, [layout] = plain.mechanism, plain.segment_layouts
    taper = Parameter(f"{_SEGMENT}.taper", ratio, "1", 1e-3, math.inf, "radius of the tip over that of the base")
    n, links = len(layout.link_joints), layout.link_joints

    def radius_at(fraction: float) -> ca.SX:
        return 1 + (taper.symbol - 1) * fraction

    def carried(joint: Joint) -> Joint:
        i = next(i for i, names in enumerate(links) if joint.name in names)
        ends, sizes = (radius_at(i / n), radius_at((i + 1) / n), taper.symbol), (layout.link_lengths[i], layout.radius)
        return replace(joint, bodies=tuple(_frustum(body, *ends, *sizes) for body in joint.bodies))

    # a joint represents half of each adjacent link, the first joint half of its own link
    factors = {name: radius_at(i / n if i else 0.25 / n) ** 4 for i, names in enumerate(links) for name in names}
    springs = tuple(
        replace(s, stiffness=s.stiffness * factors[s.joint_name], damping=s.damping * factors[s.joint_name])
        for s in plain.elastic_joints
    )
    made = replace(tree, joints=tuple(map(carried, tree.joints)), parameters=tree.parameters.with_added([taper]))
    return replace(plain, mechanism=made, elastic_joints=springs)


def _frustum(body: Inertia, a: ca.SX, b: ca.SX, taper: ca.SX, length: ca.SX, radius: ca.SX) -> Inertia:
    """Body of a link whose radius changes from `a` to `b` times the base radius, by exact integrals."""
    area, whole = (a**2 + a * b + b**2) / 3, (1 + taper + taper**2) / 3
    first = (a**2 + 2 * a * b + 3 * b**2) / 12 / area
    second = (a**2 + 3 * a * b + 6 * b**2) / 30 / area
    fourth = (a**4 + a**3 * b + a**2 * b**2 + a * b**3 + b**4) / 5 / area
    mass = body.mass * area / whole
    across = length**2 * (second - first**2) + radius**2 / 4 * fourth
    moments = ca.vertcat(across, across, radius**2 / 2 * fourth)
    return Inertia(mass, ca.vertcat(0, 0, first * length), ca.diag(moments) * mass, body.gravity_fraction)

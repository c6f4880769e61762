"""Flexible branched objects as chains of rigid links with elastic joints: tubes, beams, cables."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.display import ReprMixin, ReprSummary, count_with_noun
from yid_ocp.errors import ModelError, nearest_name_hint
from yid_ocp.model.mechanism import Frame, Inertia, Joint, LinkChain, Mechanism, Placement
from yid_ocp.model.parameters import Parameter, Parameters
from yid_ocp.model.rotations import axis_angle_rotation, snap_to_unit_entries

UNIT_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class Segment:
    """Description of one tube, branch or beam.

    Attributes
    ----------
    name : str
    length : float
        [m]; ignored when `link_lengths` is given.
    mass : float
        Of the whole segment, spread along its length [kg].
    radius : float, optional
        [m]; of the solid cylinder that gives each link's inertia. None where `cross_section` is given.
    links : int
        Number of equal links.
    link_lengths : sequence of float, optional
        Unequal links [m], base to tip.
    parent : str, optional
        Segment on which it grows; None for the root.
    parent_link_index : int, optional
        It leaves at the tip of this link of the parent (0-based); the last one when absent.
    rest_rotation : (3, 3) array_like, optional
        Of its first link at rest in the frame of the parent's link (of the root's frame for the root).
    link_rest_rotations : sequence of (3, 3) array_like, optional
        Rest rotation of every later link in the frame of the one before (a measured undeformed shape).
    bend, twist : float
        Nominal stiffness of every joint [N m/rad], or rigidity [N m^2] when `stiffness_per_curvature` is set.
    damping : float
        Viscous damping of every coordinate [N m s/rad] ([N m^2 s] when `stiffness_per_curvature` is set).
    twist_damping : float, optional
        Damping of the twists where it differs from that of the bends.
    stiffness_per_curvature : bool
        Whether bend, twist and damping are per curvature: a joint between links of length a and b then has
        2/(a + b) times the value, and the first joint of a clamped segment 2/a.
    clamped_at_base : bool
        Whether the first joint turns about the tip of a rigid wall or clamp (only matters with
        `stiffness_per_curvature`); otherwise it sits between the parent's link and the first one.
    joint_axes : str
        Axes of the turns at each joint, base to tip; about those left out the segment is rigid.
    cross_section : (float, float), optional
        Extents of a rectangular cross section along the links' x and y axes [m], in place of `radius`.
    link_length_parameters : bool
        Whether every link has a length parameter of its own (`SEGMENT.length_0`, ...) in place of `SEGMENT.length`,
        for markers that sit elsewhere in every recording; masses do not follow them.
    clamped_edge_length : float, optional
        Length of a flexible edge that a clamp keeps straight before a root segment; with `stiffness_per_curvature` its
        first joint then counts half of it [m].
    """

    name: str
    length: float
    mass: float
    radius: float | None = None
    links: int = 4
    link_lengths: Sequence[float] | None = None
    parent: str | None = None
    parent_link_index: int | None = None
    rest_rotation: ArrayLike | None = None
    link_rest_rotations: Sequence[ArrayLike] | None = None
    bend: float = 3.0
    twist: float = 3.0
    damping: float = 0.05
    twist_damping: float | None = None
    stiffness_per_curvature: bool = False
    clamped_at_base: bool = False
    joint_axes: str = "xyz"
    cross_section: tuple[float, float] | None = None
    link_length_parameters: bool = False
    clamped_edge_length: float | None = None


@dataclass(frozen=True)
class ElasticJoint:
    """A spring 1/2 stiffness (q - rest)^2 and a damper -damping v on one joint; the values may be symbolic."""

    joint_name: str
    segment_name: str
    deformation: Literal["bend", "twist"]
    axis: str
    stiffness: ca.SX
    damping: ca.SX
    rest_angle: ca.SX


@dataclass(frozen=True)
class SegmentLayout:
    """A segment's joint names link by link, link lengths [m], radius [m] and mass [kg] in the mechanism.

    The radius of a rectangular section is half its diagonal.
    """

    name: str
    link_joints: tuple[tuple[str, ...], ...]
    link_lengths: tuple[ca.SX, ...]
    radius: ca.SX
    mass: ca.SX
    parent_segment: str | None


@dataclass(frozen=True, repr=False)
class FlexibleObject(ReprMixin):
    """A generated flexible object: its mechanism, elastic joints and segments.

    Frames: `SEGMENT` tip as `w_SEGMENT`, tip of link i as `SEGMENT_i_tip`, the root frame `object_root`, and points by
    arc length, independent of the number of links, as `SEGMENT:40%`.
    """

    mechanism: Mechanism
    elastic_joints: tuple[ElasticJoint, ...]
    segment_layouts: tuple[SegmentLayout, ...]

    def _summary(self) -> ReprSummary:
        names, tree = ", ".join(segment.name for segment in self.segment_layouts), self.mechanism
        return ReprSummary(
            f"{names}, {count_with_noun(len(tree.joints), 'joint')}", tree.parameters._summary().table_rows
        )

    def segment_layout(self, name: str) -> SegmentLayout:
        """Layout of a segment by name; `ModelError` where there is none."""
        return find_segment_layout(self.segment_layouts, name)


def find_segment_layout(layouts: Sequence[SegmentLayout], name: str) -> SegmentLayout:
    """Layout of a segment by name; `ModelError` with the nearest name where there is none."""
    found = {layout.name: layout for layout in layouts}
    if name not in found:
        raise ModelError(f"there is no segment '{name}'", hint=nearest_name_hint(name, found))
    return found[name]


def flexible_object(
    segments: Sequence[Segment],
    root_placement: ArrayLike | None = None,
    name: str = "object",
    gravity_fraction: float = 1.0,
) -> FlexibleObject:
    """A flexible object of rigid links with an elastic joint before each.

    Parameters
    ----------
    segments : sequence of Segment
        Parents first.
    root_placement : array_like, shape (4, 4), optional
        Placement of the root; the origin when absent.
    name : str
        Name of the mechanism.
    gravity_fraction : float
        Part of its weight that the object has, its inertia unchanged; less than one where something else bears it.

    Returns
    -------
    FlexibleObject
        Joints are named `SEGMENT_LINK_AXIS` (`T1_0_x`), parameters `SEGMENT.length` (or `.length_0`, ...), `.mass`,
        `.radius` (or `.size_x` and `.size_y`), `.bend`, `.twist`, `.damping` (and `.twist_damping` where given).

    Raises
    ------
    ModelError
        Unknown parent, parent after child, non-positive length, mass or radius, links that do not fit.
    """
    root = Placement.identity() if root_placement is None else Placement.from_matrix(root_placement)
    parts = _Parts(frames={"object_root": Frame(-1, root)})
    fraction = None if gravity_fraction == 1 else ca.SX(gravity_fraction)
    for segment in segments:
        _check(segment, parts.layouts)
        _add_segment(parts, segment, root, fraction)
    lines = {segment.name: _line(segment) for segment in segments}
    mechanism = Mechanism(name, tuple(parts.joints), parts.frames, Parameters(parts.parameters), lines)
    return FlexibleObject(mechanism, tuple(parts.elastic), tuple(parts.layouts.values()))


@dataclass(frozen=True)
class _Parts:
    """An object under construction."""

    frames: dict[str, Frame]
    parameters: list[Parameter] = field(default_factory=list)
    joints: list[Joint] = field(default_factory=list)
    elastic: list[ElasticJoint] = field(default_factory=list)
    layouts: dict[str, SegmentLayout] = field(default_factory=dict)


def _add_segment(parts: _Parts, segment: Segment, root: Placement, gravity_fraction: ca.SX | None) -> None:
    """Append a segment's links to the object."""
    own = _segment_parameters(segment)
    parts.parameters.extend(own.values())
    mass, cross = own["mass"].symbol, _cross_section(own)
    shares = _shares(segment)
    if segment.link_length_parameters:
        lengths = tuple(own[f"length_{i}"].symbol for i in range(len(shares)))
    else:
        lengths = tuple(own["length"].symbol * float(share) for share in shares)
    later: Sequence[ArrayLike | None] = (
        [None] * (len(shares) - 1) if segment.link_rest_rotations is None else segment.link_rest_rotations
    )
    rotations = [_rotation(entry) for entry in (segment.rest_rotation, *later)]
    before: ca.SX | None
    if segment.parent is None:
        carrier = Frame(-1, root)
        before = (
            None
            if segment.clamped_edge_length is None or segment.clamped_at_base
            else ca.SX(segment.clamped_edge_length)
        )
    else:
        above = parts.layouts[segment.parent]
        at = len(above.link_joints) - 1 if segment.parent_link_index is None else segment.parent_link_index
        carrier = parts.frames[f"{segment.parent}_{at}_tip"]
        before = None if segment.clamped_at_base else above.link_lengths[at]
    links: list[tuple[str, ...]] = []
    for i, length in enumerate(lengths):
        along = ca.vertcat(0, 0, length)
        slender = length**2 / 12
        squares = ca.vertcat(slender + cross.y, slender + cross.x, cross.x + cross.y)
        share = mass * float(shares[i])
        body = Inertia(share, along / 2, ca.diag(squares) * share, gravity_fraction)
        turned = carrier.placement @ Placement(ca.SX(ca.DM(rotations[i])), ca.SX(ca.DM.zeros(3)))
        names = tuple(f"{segment.name}_{i}_{axis}" for axis in segment.joint_axes)
        _add_link(parts, segment, names, Frame(carrier.joint_index, turned), body)
        parts.elastic.extend(_springs(segment, names, own, _per_joint(segment, length, before)))
        links.append(names)
        carrier = Frame(len(parts.joints) - 1, Placement(ca.SX(ca.DM.eye(3)), along))
        parts.frames[f"{segment.name}_{i}_tip"] = carrier
        before = length
    parts.frames[f"w_{segment.name}"] = carrier
    layout = SegmentLayout(segment.name, tuple(links), lengths, cross.radius, mass, segment.parent)
    parts.layouts[segment.name] = layout


def _add_link(parts: _Parts, segment: Segment, names: Sequence[str], at: Frame, body: Inertia) -> None:
    """Append the joints before a link, the last of which carries its body."""
    parent, placement = at.joint_index, at.placement
    for name, axis in zip(names, segment.joint_axes, strict=True):
        bodies = (body,) if name == names[-1] else ()
        parts.joints.append(Joint(name, "revolute", parent, placement, UNIT_AXES[axis], bodies))
        parent, placement = len(parts.joints) - 1, Placement.identity()


def _springs(
    segment: Segment, names: Sequence[str], own: Mapping[str, Parameter], factor: ca.SX
) -> Iterator[ElasticJoint]:
    """Springs and dampers of the joints before a link; `factor` converts rigidities to stiffnesses."""
    for name, axis in zip(names, segment.joint_axes, strict=True):
        kind: Literal["bend", "twist"] = "twist" if axis == "z" else "bend"
        damping = own.get("twist_damping", own["damping"]) if kind == "twist" else own["damping"]
        yield ElasticJoint(name, segment.name, kind, axis, own[kind].symbol * factor, damping.symbol * factor, ca.SX(0))


def polyline_rotations(vertices: ArrayLike, initial_frame: ArrayLike | None = None) -> list[NDArray[np.float64]]:
    """Rotation from each edge's frame to the next one's by the smallest angle (no twist).

    Parameters
    ----------
    vertices : array_like, shape (k, 3)
        Undeformed centre line [m].
    initial_frame : array_like, shape (3, 3), optional
        Frame before the first edge, whose z axis is the direction it continues; the world's when absent.

    Returns
    -------
    list of ndarray, shape (3, 3)
        One for every edge, to be used as `Segment.rest_rotation` and `Segment.link_rest_rotations`.

    Raises
    ------
    ModelError
        Fewer than two vertices, not three coordinates each, or two that coincide.
    """
    points = np.asarray(vertices, float)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
        raise ModelError(f"vertices have shape {points.shape}", where="polyline", allowed="(k, 3) with k from 2")
    edges = np.diff(points, axis=0)
    if not np.all(np.linalg.norm(edges, axis=1) > 0):
        raise ModelError("two neighbouring vertices coincide or are not finite", where="polyline")
    frame = np.eye(3) if initial_frame is None else np.asarray(initial_frame, float)
    rotations = []
    for edge in edges:
        local = frame.T @ (edge / np.linalg.norm(edge))
        rotations.append(_shortest_turn(local))
        frame = frame @ rotations[-1]
    return rotations


def _shortest_turn(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    axis = np.cross([0.0, 0.0, 1.0], direction)
    sine, cosine = float(np.linalg.norm(axis)), float(direction[2])
    if sine < 1e-12:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    return axis_angle_rotation(axis / sine, sine, cosine)


def _rotation(matrix: ArrayLike | None) -> NDArray[np.float64]:
    return np.eye(3) if matrix is None else snap_to_unit_entries(np.asarray(matrix, float))


def _shares(segment: Segment) -> NDArray[np.float64]:
    if segment.link_lengths is None:
        return np.full(segment.links, 1.0 / segment.links)
    lengths = np.asarray(segment.link_lengths, float)
    return lengths / lengths.sum()


def _line(segment: Segment) -> LinkChain:
    parts = tuple(map(float, _shares(segment)))
    return LinkChain(tuple(f"{segment.name}_{i}_tip" for i in range(len(parts))), parts)


def _per_joint(segment: Segment, length: ca.SX, before: ca.SX | None) -> ca.SX:
    if not segment.stiffness_per_curvature:
        return ca.SX(1)
    if before is None:
        return 2 / length if segment.clamped_at_base else 1 / length
    return 2 / (length + before)


@dataclass(frozen=True)
class _CrossSection:
    """Mean squares of x and y over a section [m^2], and its equivalent radius [m]."""

    x: ca.SX
    y: ca.SX
    radius: ca.SX


def _cross_section(own: Mapping[str, Parameter]) -> _CrossSection:
    if "radius" in own:
        radius = own["radius"].symbol
        return _CrossSection(radius**2 / 4, radius**2 / 4, radius)
    x, y = own["size_x"].symbol, own["size_y"].symbol
    return _CrossSection(x**2 / 12, y**2 / 12, ca.sqrt(x**2 + y**2) / 2)


def _segment_parameters(segment: Segment) -> dict[str, Parameter]:
    per, rate = ("N m^2", "N m^2 s") if segment.stiffness_per_curvature else ("N m/rad", "N m s/rad")
    length = float(np.sum(segment.link_lengths)) if segment.link_lengths is not None else segment.length
    small = 1e-9
    entries = {
        **(
            {
                f"length_{i}": (length * float(share), "m", small, f"length of link {i}")
                for i, share in enumerate(_shares(segment))
            }
            if segment.link_length_parameters
            else {"length": (length, "m", small, "length of the segment")}
        ),
        "mass": (segment.mass, "kg", small, "mass of the segment"),
        **(
            {"radius": (segment.radius, "m", small, "radius of the solid cylinder")}
            if segment.radius is not None
            else {
                f"size_{axis}": (size, "m", small, f"extent of the section along {axis}")
                for axis, size in zip("xy", segment.cross_section or (), strict=True)
            }
        ),
        "bend": (segment.bend, per, 0.0, "bending stiffness of every joint, about x and y"),
        "twist": (segment.twist, per, 0.0, "twisting stiffness of every joint, about z"),
        "damping": (segment.damping, rate, 0.0, "viscous damping of every coordinate"),
    }
    if segment.twist_damping is not None:
        entries["twist_damping"] = (segment.twist_damping, rate, 0.0, "viscous damping of the twists")
    return {
        key: Parameter(f"{segment.name}.{key}", value, unit, lower, math.inf, text)
        for key, (value, unit, lower, text) in entries.items()
    }


def _check(segment: Segment, known: dict[str, SegmentLayout]) -> None:
    where = f"segment {segment.name}"
    if segment.name in known:
        raise ModelError(f"two segments are called '{segment.name}'", where=where)
    if segment.parent is not None and segment.parent not in known:
        raise ModelError(
            f"parent '{segment.parent}' of segment '{segment.name}' does not come before it",
            where=where,
            hint=nearest_name_hint(segment.parent, known),
        )
    if (segment.radius is None) == (segment.cross_section is None):
        raise ModelError(
            "a segment needs a radius or a section",
            where=where,
            allowed="one of the two",
            hint="cross_section: [0.001, 0.08]",
        )
    sizes = {"mass": segment.mass}
    if segment.link_lengths is None:
        sizes["length"] = segment.length
    sizes |= {"radius": segment.radius} if segment.radius is not None else {}
    sizes |= {f"cross_section[{i}]": size for i, size in enumerate(segment.cross_section or ())}
    for quantity, value in sizes.items():
        if not (math.isfinite(value) and value > 0):
            raise ModelError(f"{quantity} = {value}", where=where, allowed="a positive number in SI units")
    if segment.link_lengths is None and segment.links < 1:
        raise ModelError(f"links = {segment.links}", where=where, allowed="a whole number from 1")
    if segment.link_lengths is not None and not min(segment.link_lengths, default=0.0) > 0:
        raise ModelError("a link has no length", where=where, allowed="positive lengths [m]")
    count = len(segment.link_lengths) if segment.link_lengths is not None else segment.links
    if segment.link_rest_rotations is not None and len(segment.link_rest_rotations) != count - 1:
        raise ModelError(
            f"{len(segment.link_rest_rotations)} link rotations for {count} links", where=where, allowed=f"{count - 1}"
        )
    if segment.parent_link_index is not None and segment.parent is not None:
        links = len(known[segment.parent].link_joints)
        if not 0 <= segment.parent_link_index < links:
            raise ModelError(
                f"parent_link_index = {segment.parent_link_index}", where=where, allowed=f"0 to {links - 1}"
            )
    axes = segment.joint_axes
    if not axes or len(set(axes)) < len(axes) or not set(axes) <= set(UNIT_AXES):
        raise ModelError(f"joint_axes = '{axes}'", where=where, allowed="letters of x, y, z, each at most once")

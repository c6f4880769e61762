"""Models of flexible branched objects (tubes, beams, cables) as chains of rigid links with elastic joints."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NoReturn

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array
from yid_ocp.display import ReprMixin, ReprTexts, count_with_noun
from yid_ocp.errors import ModelError, unknown_name_error_arguments
from yid_ocp.model.mechanism import (
    ArcLengthChain,
    Frame,
    Inertia,
    Joint,
    Mechanism,
    Placement,
    numeric_axis_sin_cos_rotation,
    snap_near_integer_entries,
    symbolic_rotation_from_rpy,
)
from yid_ocp.model.parameters import Parameter, Parameters

ROOT_ROTATION_PARAMETERS = ("mount.rx", "mount.ry")
AXIS_UNIT_VECTORS = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class FlexibleSegment:
    """One segment of a flexible object, such as a tube [m, kg]. `flexible_object` raises `ModelError` for a fault."""

    name: str
    length: float
    """Length [m]; ignored if `link_lengths` is given."""
    mass: float
    """Mass of the whole segment, distributed along its length [kg]."""
    radius: float | None = None
    """Radius of the solid cylinder that gives each link's inertia [m]. Alternative: `cross_section_size`."""
    links: int = 4
    link_lengths: Sequence[float] | None = None
    """Lengths of unequal links, base to tip [m]."""
    parent: str | None = None
    """Segment to which it is attached; None for the root."""
    parent_link_index: int | None = None
    """Link of the parent to whose tip it is attached; default: the last one."""
    rest_rotation: ArrayLike | None = None
    """Rest rotation of its first link relative to the parent's link (for the root: the root frame), shape (3, 3)."""
    link_rest_rotations: Sequence[ArrayLike] | None = None
    """Rest rotation of each later link relative to the previous link (a measured undeformed shape)."""
    bend: float = 3.0
    """Bending stiffness of every joint [N m/rad]; N m^2 (damping: N m^2 s) if `values_given_as_rigidities`."""
    twist: float = 3.0
    damping: float = 0.05
    """Damping of every joint [N m s/rad]."""
    twist_damping: float | None = None
    """Damping of the twists; default: `damping`."""
    values_given_as_rigidities: bool = False
    """Whether stiffness = 2/(a + b) times the value, for a joint between links of lengths a and b (2/a if clamped)."""
    clamped_at_base: bool = False
    """Whether it starts at a rigid wall or clamp, not a parent's link; matters if `values_given_as_rigidities`."""
    joint_axes: str = "xyz"
    """Rotation axes of each joint, base to tip. About the other axes the segment is rigid."""
    cross_section_size: tuple[float, float] | None = None
    """Side lengths of a rectangular cross-section along the links' x and y axes [m]."""
    has_length_parameter_per_link: bool = False
    """Whether each link has a length parameter, for markers that move between recordings; masses do not change."""
    clamped_edge_length: float | None = None
    """Length of a flexible edge that a clamp keeps straight before a root segment [m]. With
    `values_given_as_rigidities`, the first joint includes half of it."""


@dataclass(frozen=True)
class ElasticJoint:
    """A spring and damper on one joint, with the energy 1/2 stiffness (q - rest_angle)^2 and the torque -damping v."""

    joint_name: str
    segment_name: str
    deformation: Literal["bend", "twist"]
    axis: str
    stiffness: ca.SX
    damping: ca.SX
    rest_angle: ca.SX


@dataclass(frozen=True)
class SingleSegmentLayout:
    """The layout of one segment in the mechanism: joints, link lengths, radius, mass and parent segment."""

    name: str
    link_joints: tuple[tuple[str, ...], ...]  # names, link by link
    link_lengths: tuple[ca.SX, ...]  # [m]
    radius: ca.SX  # half the diagonal of a rectangular section [m]
    mass: ca.SX  # [kg]
    parent_segment: str | None


@dataclass(frozen=True, repr=False)
class FlexibleObject(ReprMixin):
    """A model of a flexible object that consists of rigid links with elastic joints.

    Its frames are `object_root`, the segment tips `w_SEGMENT`, the link tips `SEGMENT_i_tip`, and points by arc length
    such as `SEGMENT:40%`, which do not depend on the number of links.
    """

    mechanism: Mechanism
    elastic_joints: tuple[ElasticJoint, ...]
    segment_layouts: tuple[SingleSegmentLayout, ...]

    def with_root_rotation_parameters(self) -> FlexibleObject:
        """Return a copy with the parameters of `ROOT_ROTATION_PARAMETERS`: angles [rad] about x and y of the root."""
        text, limit = "rotation of the object about {} of its mount", math.pi / 2
        angles = [Parameter(p, 0.0, "rad", -limit, limit, text.format(p[-1])) for p in ROOT_ROTATION_PARAMETERS]
        rotation = symbolic_rotation_from_rpy(*(angle.symbol for angle in angles))
        frame = Frame(-1, Placement(rotation, ca.SX(3, 1)))
        tree = Mechanism("mount", (), {"mount": frame}).with_attached_mechanism(self.mechanism, "mount")
        frames = {name: frame for name, frame in tree.frames.items() if name != "mount"}
        parameters = tree.parameters.with_added(angles)
        return replace(self, mechanism=replace(tree, frames=frames, parameters=parameters))

    def _summary(self) -> ReprTexts:
        names, tree = ", ".join(segment.name for segment in self.segment_layouts), self.mechanism
        count = count_with_noun(len(tree.joints), "joint")
        return ReprTexts(f"{names}, {count}", tree.parameters._summary().table_rows)


def flexible_object(
    segments: Sequence[FlexibleSegment],
    root_placement: ArrayLike | None = None,
    name: str = "object",
    gravity_fraction: float = 1.0,
) -> FlexibleObject:
    """Build a flexible object from chains of rigid links, with elastic joints before each link.

    Joints are named `SEGMENT_LINK_AXIS` (`T1_0_x`). Parameters are `SEGMENT.length` (or `.length_0`, ...), `.mass`,
    `.radius` (or `.size_x` and `.size_y`), `.bend`, `.twist`, `.damping` (and `.twist_damping` if given). Raises
    `ModelError` for an unknown or later parent, a length, mass or radius that is not positive, or inconsistent links.

    Parameters
    ----------
    segments : sequence of FlexibleSegment
        Parents first.
    root_placement : array_like, shape (4, 4), optional
        Pose of the root; default: identity.
    gravity_fraction : float
        Factor on the object's weight, not on its inertia; below one if something else supports it.
    """
    root = Placement.identity() if root_placement is None else Placement.from_matrix(root_placement)
    parts = _Parts(frames={"object_root": Frame(-1, root)})
    for segment in segments:
        _check(segment, parts.layouts)
        _add_segment(parts, segment, root, ca.SX(gravity_fraction))
    tree = Mechanism(name, tuple(parts.joints), parts.frames, Parameters(parts.parameters), parts.chains)
    return FlexibleObject(tree, tuple(parts.elastic), tuple(parts.layouts.values()))


@dataclass(frozen=True)
class _Parts:
    frames: dict[str, Frame]
    parameters: list[Parameter] = field(default_factory=list)
    joints: list[Joint] = field(default_factory=list)
    elastic: list[ElasticJoint] = field(default_factory=list)
    layouts: dict[str, SingleSegmentLayout] = field(default_factory=dict)
    chains: dict[str, ArcLengthChain] = field(default_factory=dict)


def _add_segment(parts: _Parts, segment: FlexibleSegment, root: Placement, gravity_fraction: ca.SX) -> None:
    own = _segment_parameters(segment)
    parts.parameters.extend(own.values())
    mass, shares = own["mass"].symbol, _length_shares(segment)
    # mean squares of x and of y over a cross-section, and its equivalent radius
    if "radius" in own:
        radius = own["radius"].symbol
        square_x = square_y = radius**2 / 4
    else:
        x, y = own["size_x"].symbol, own["size_y"].symbol
        square_x, square_y, radius = x**2 / 12, y**2 / 12, ca.sqrt(x**2 + y**2) / 2
    if segment.has_length_parameter_per_link:
        lengths = tuple(own[f"length_{i}"].symbol for i in range(len(shares)))
    else:
        lengths = tuple(own["length"].symbol * share for share in shares)
    edge, carrier = segment.clamped_edge_length, Frame(-1, root)
    before = None if edge is None else ca.SX(edge)
    if segment.parent is not None:
        above = parts.layouts[segment.parent]
        at = len(above.link_joints) - 1 if segment.parent_link_index is None else segment.parent_link_index
        carrier, before = parts.frames[f"{segment.parent}_{at}_tip"], above.link_lengths[at]
    before = None if segment.clamped_at_base else before
    later = segment.link_rest_rotations
    rotations = [segment.rest_rotation, *([None] * (len(shares) - 1) if later is None else later)]
    links: list[tuple[str, ...]] = []
    for i, (length, rotation) in enumerate(zip(lengths, rotations, strict=True)):
        along, slender = ca.vertcat(0, 0, length), length**2 / 12
        squares = ca.vertcat(slender + square_y, slender + square_x, square_x + square_y)
        share = mass * shares[i]
        body = Inertia(share, along / 2, ca.diag(squares) * share, gravity_fraction)
        turn = np.eye(3) if rotation is None else snap_near_integer_entries(np.asarray(rotation, float))
        turned = Placement(ca.SX(ca.DM(turn)), ca.SX(ca.DM.zeros(3)))
        parent, placement = carrier.joint_index, carrier.placement @ turned
        # rigidities are converted to stiffnesses
        factor = ca.SX(1)
        if segment.values_given_as_rigidities:
            both = length if before is None else length + before
            factor = (2 if before is not None or segment.clamped_at_base else 1) / both
        links.append(tuple(f"{segment.name}_{i}_{axis}" for axis in segment.joint_axes))
        for name, axis in zip(links[-1], segment.joint_axes, strict=True):
            bodies = (body,) if name == links[-1][-1] else ()
            parts.joints.append(Joint(name, "revolute", parent, placement, AXIS_UNIT_VECTORS[axis], bodies))
            parent, placement = len(parts.joints) - 1, Placement.identity()
            kind: Literal["bend", "twist"] = "twist" if axis == "z" else "bend"
            damping = own.get("twist_damping", own["damping"]) if kind == "twist" else own["damping"]
            stiffness = own[kind].symbol * factor
            spring = ElasticJoint(name, segment.name, kind, axis, stiffness, damping.symbol * factor, ca.SX(0))
            parts.elastic.append(spring)
        carrier, before = Frame(parent, Placement(ca.SX(ca.DM.eye(3)), along)), length
        parts.frames[f"{segment.name}_{i}_tip"] = carrier
    parts.frames[f"w_{segment.name}"] = carrier
    parts.chains[segment.name] = ArcLengthChain(tuple(f"{segment.name}_{i}_tip" for i in range(len(shares))), shares)
    parts.layouts[segment.name] = SingleSegmentLayout(segment.name, tuple(links), lengths, radius, mass, segment.parent)


def edge_to_edge_rotations_from_vertices(vertices: ArrayLike, initial_frame: ArrayLike | None = None) -> list[Array]:
    """Return how each edge of a polyline is rotated from the previous edge, without twist, as k - 1 matrices (3, 3).

    They are a segment's `rest_rotation` and `link_rest_rotations`. `vertices` (k, 3) are the undeformed centre line
    [m]. The first rotation starts from `initial_frame` (3, 3), whose z axis is along the line before the first vertex;
    default: the world frame. Raises `ModelError` if neighbouring vertices coincide or the shape is wrong.
    """
    points = np.asarray(vertices, float)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
        what, hint = f"the vertices have shape {points.shape}, not (k, 3)", "pass for example [[0, 0, 0], [0, 0, 0.1]]"
        raise ModelError(what, where="vertices of the polyline", allowed="(k, 3) with k of 2 or more", hint=hint)
    edges = np.diff(points, axis=0)
    if not np.all(np.linalg.norm(edges, axis=1) > 0):
        index = int(np.argmin(np.linalg.norm(edges, axis=1) > 0))
        what, hint = f"vertices {index} and {index + 1} coincide or are not finite", "remove or correct one of them"
        what += f": {points[index]} and {points[index + 1]}"
        raise ModelError(what, where="vertices of the polyline", allowed="distinct, finite vertices", hint=hint)
    frame = np.eye(3) if initial_frame is None else np.asarray(initial_frame, float)
    rotations = []
    for edge in edges:
        local = frame.T @ (edge / np.linalg.norm(edge))
        axis, cosine = np.cross([0.0, 0.0, 1.0], local), float(local[2])
        sine = float(np.linalg.norm(axis))
        if sine < 1e-12:
            rotations.append(np.diag([1.0, math.copysign(1.0, cosine), math.copysign(1.0, cosine)]))
        else:
            rotations.append(numeric_axis_sin_cos_rotation(axis / sine, sine, cosine))
        frame = frame @ rotations[-1]
    return rotations


def _length_shares(segment: FlexibleSegment) -> tuple[float, ...]:
    if segment.link_lengths is None:
        return (1.0 / segment.links,) * segment.links
    lengths = np.asarray(segment.link_lengths, float)
    return tuple(map(float, lengths / lengths.sum()))


def _segment_parameters(segment: FlexibleSegment) -> dict[str, Parameter]:
    per, rate, sizes = "N m/rad", "N m s/rad", ("{}ing stiffness of each joint", "of every coordinate")
    if segment.values_given_as_rigidities:
        per, rate, sizes = "N m^2", "N m^2 s", ("{}ing rigidity", "of a joint times its length")
    length = segment.length if segment.link_lengths is None else float(np.sum(segment.link_lengths))
    small, shares = 1e-9, enumerate(_length_shares(segment))
    rows = [("length", length, "m", small, "length of the segment")]
    if segment.has_length_parameter_per_link:
        rows = [(f"length_{i}", length * share, "m", small, f"length of link {i}") for i, share in shares]
    rows.append(("mass", segment.mass, "kg", small, "mass of the segment"))
    if segment.radius is not None:
        rows.append(("radius", segment.radius, "m", small, "radius of the solid cylinder"))
    for axis, size in zip("xy", segment.cross_section_size or (), strict=False):
        rows.append((f"size_{axis}", size, "m", small, f"extent of the section along {axis}"))
    rows += [
        ("bend", segment.bend, per, 0.0, f"{sizes[0].format('bend')}, about x and y"),
        ("twist", segment.twist, per, 0.0, f"{sizes[0].format('twist')}, about z"),
        ("damping", segment.damping, rate, 0.0, f"viscous damping {sizes[1]}"),
    ]
    if segment.twist_damping is not None:
        rows.append(("twist_damping", segment.twist_damping, rate, 0.0, "viscous damping of the twists"))
    return {
        key: Parameter(f"{segment.name}.{key}", value, unit, lower, math.inf, text)
        for key, value, unit, lower, text in rows
    }


def _check(segment: FlexibleSegment, known: Mapping[str, SingleSegmentLayout]) -> None:
    parent, at, axes = segment.parent, segment.parent_link_index, segment.joint_axes
    section, lengths, turns = segment.cross_section_size, segment.link_lengths, segment.link_rest_rotations
    count = segment.links if lengths is None else len(lengths)

    def refuse(what: str, allowed: str, hint: str) -> NoReturn:
        raise ModelError(what, where=f"segment {segment.name}", allowed=allowed, hint=hint)

    if segment.name in known:
        refuse(f"two segments are called '{segment.name}'", "a name of its own for each", "rename one of them")
    if parent is not None and parent not in known:
        what = f"the parent '{parent}' is not a segment that is listed before segment '{segment.name}'"
        refuse(what, **unknown_name_error_arguments(parent, known, f"list '{parent}' first, or leave parent out"))
    if (segment.radius is None) == (section is None):
        found = "both radius and cross_section_size" if section else "neither radius nor cross_section_size"
        refuse(f"the segment has {found}", "one of the two", "set one, such as radius: 0.004, and remove the other")
    sizes = {"mass": segment.mass, **({"length": segment.length} if lengths is None else {})}
    sizes |= {} if segment.radius is None else {"radius": segment.radius}
    for quantity, value in (sizes | {f"cross_section_size[{i}]": size for i, size in enumerate(section or ())}).items():
        if not (math.isfinite(value) and value > 0):
            what, unit = f"{quantity} is {value}, but must be above 0", "kg" if quantity == "mass" else "m"
            refuse(what, f"a number above 0 [{unit}]", f"set {quantity} to 0.05, for example")
    if lengths is None and count < 1:
        refuse(f"links is {count}, but must be 1 or more", "a whole number from 1", "set links: 4, for example")
    if lengths is not None and not min(lengths, default=0.0) > 0:
        allowed, hint = "one or more numbers above 0 [m]", "set link_lengths: [0.2, 0.3], or length and links"
        refuse(f"link_lengths is {list(lengths)}, but must have lengths above 0", allowed, hint)
    if turns is not None and len(turns) != count - 1:
        what, allowed = f"{count} links have {len(turns)} link_rest_rotations, but need {count - 1}", "matrices (3, 3)"
        refuse(what, allowed, "pass one rotation matrix for each link after the first")
    if at is not None and parent is not None and not 0 <= at < (links := len(known[parent].link_joints)):
        what, allowed = f"parent_link_index is {at}, but '{parent}' has {links} links", f"0 to {links - 1}"
        refuse(what, allowed, f"set parent_link_index: {links - 1}, or leave it out for the last link")
    if not axes or len(set(axes)) < len(axes) or not set(axes) <= set(AXIS_UNIT_VECTORS):
        what, allowed = f"joint_axes is '{axes}', which does not name axes", "letters x, y, z, each at most once"
        refuse(what, allowed, "set joint_axes: xyz (all rotations) or xy (no twist)")

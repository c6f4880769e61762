"""The model of a branched cable held by two clamps, built from measured vertices.

The parent branch runs from one clamp to the other, which hold its first and last edge. Child branches start at vertices
of the parent. Every edge is a rigid link. The joint before each link bends about x and y and twists about z:

    M = rigidity x (angle - rest angle) x 2/(length before + length after)

The first edge is fixed to `clamp_start`, whose six coordinates follow two measured points. `clamp_end` holds the last
edge with five equations (position and direction, free roll) or six.

Motion capture measures neither force nor mass, so every result is relative to the nominal linear density rho: a
bending rigidity of B means B/rho [N m^2 per kg/m].
"""

from __future__ import annotations

import csv
import operator
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Annotated, Literal

import casadi as ca
import numpy as np
from annotated_types import Ge, Gt, Le, Len

from yid_ocp.arrays import Array, Vector3
from yid_ocp.errors import DataError, ModelError, require_known_names
from yid_ocp.files import read_input_text
from yid_ocp.model import flexible
from yid_ocp.model.mechanism import ArcLengthChain, Frame, Mechanism, Placement, symbolic_rotation_from_axis_angle
from yid_ocp.model.objects.base import END_CLAMP, OBJECT_KINDS, START_CLAMP, CableVertices, ObjectBuilder
from yid_ocp.model.parameters import Parameter, Parameters
from yid_ocp.model.system import Grasp, System, SystemBuildArguments, six_joint_floating_mechanism
from yid_ocp.options import OptionInfo

SHAPE_MEMORY_HALVING_SPEED_PARAMETER_NAME = "start.speed_scale"
_MIN_STIFFNESS = 1e-9  # keeps load/stiffness finite where a stiffness is zero [N m/rad]
_START_EDGE_FRAME, _LAST_EDGE_FRAME = f"{START_CLAMP}_edge", "last_edge"
# Parameters of a joint whose rest angle follows from the start: its angle [rad] and torque [N m] there.
INITIAL_ANGLE_AND_TORQUE_SUFFIXES = ("start", "load")
# Parameter set to the root mean square speed of the measured points at the start [m/s].
INITIAL_RMS_SPEED_PARAMETER = "start.speed"


@dataclass(frozen=True)
class CableBranchRigidityDampingAndDensity:
    """The nominal rigidities [N m^2], damping [N m^2 s] and mass per length [kg/m] of one cable branch."""

    bend_rigidity: float = 1.5e-3  # a configuration sets this and the next two under `parameters`
    twist_rigidity: float = 1.0e-3
    bend_damping: float = 5e-5
    has_separate_twist_damping: Annotated[bool, OptionInfo("whether twists have their own damping parameter")] = False
    linear_density: Annotated[float, Gt(0), OptionInfo("mass per length; results scale with it", "kg/m")] = 0.05


@dataclass(frozen=True)
class CableOptions:
    """The settings of a cable's model.

    `shape_memory_fraction` models a cable that partly keeps the shape in which it was held before the recording. The
    rest angle of each joint is then (1 - memory) x undeformed + memory x (start angle - load/stiffness), where load is
    the joint's torque in equilibrium at the start. The fraction becomes the parameter `SEGMENT.memory`. If a recording
    starts in motion, memory is multiplied by 1/(1 + (start speed/`start.speed_scale`)^2). Branches without an entry in
    `branch_properties_by_name` have the `default_branch`. `gravity` is in m/s^2.
    """

    branch_properties_by_name: Annotated[
        Mapping[str, CableBranchRigidityDampingAndDensity],
        OptionInfo("by name of the branch; the main one is `parent`"),
    ] = field(default_factory=dict)
    default_branch: CableBranchRigidityDampingAndDensity = field(default_factory=CableBranchRigidityDampingAndDensity)
    radius: Annotated[float, Gt(0), Le(1), OptionInfo("radius of the cylinders for the links' inertia", "m")] = 0.005
    end_clamp_grasp_kind: Annotated[
        Literal["axis", "weld"],
        OptionInfo("axis: the roll at the end clamp is free; weld: it is held at the parameter clamp_end.roll"),
    ] = "axis"
    shape_memory_fraction: Annotated[
        float | None,
        Ge(0),
        Le(1),
        OptionInfo("fraction of the recording's first shape that the rest shape keeps; default: none"),
    ] = None
    has_rest_angle_parameters: Annotated[
        bool,
        OptionInfo("whether every bend has a parameter JOINT.rest, its rest angle relative to the undeformed shape"),
    ] = False
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)


def read_vertex_positions_by_name(path: str | Path) -> dict[str, Array]:
    """Read vertex positions [m] from a CSV table with columns point, x, y, z. Raises `DataError` for another format."""
    try:
        rows = csv.DictReader(read_input_text(Path(path)).splitlines())
        return {row["point"]: np.array([float(row[axis]) for axis in "xyz"]) for row in rows}
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        allowed = "columns point, x, y, z with numbers in metres"
        is_lost = isinstance(error, KeyError)
        what = f"the table of vertices has no column {error}" if is_lost else f"a coordinate is not a number ({error})"
        raise DataError(what, where=str(path), allowed=allowed, hint="write rows such as p0,0.1,0.0,0.25") from error


def length_parameters_from_edges(cable: CableVertices, lengths: Mapping[tuple[str, str], float]) -> dict[str, float]:
    """Compute the values of a cable's length parameters from its edge lengths [m]."""
    values = {f"{START_CLAMP}.length": lengths[cable.main_branch_vertex_names[0], cable.main_branch_vertex_names[1]]}
    for name, chain in cable.vertex_names_by_branch.items():
        for i, edge in enumerate(pairwise(chain[1:] if name == cable.parent_segment else chain)):
            values[f"{name}.length_{i}"] = lengths[edge]
    return values


def clamped_cable_system(
    lengths: Mapping[tuple[str, str], float], cable: CableVertices, options: CableOptions | None = None
) -> System:
    """Build the model of a cable that two clamps hold. `lengths` gives the length [m] of each edge (vertex, vertex).

    The six coordinates of each clamp, `clamp_start` and `clamp_end`, are prescribed. Frames are all vertices,
    `junction_CHILD` and `last_edge`. Parameters are those of each segment (`parent.bend`, ...), the length of the first
    edge `clamp_start.length` [m], its roll angle `clamp_start.roll` [rad] and, if the end clamp is a weld, the roll of
    the last edge `clamp_end.roll` [rad]. Raises `ModelError` if the cable is inconsistent.
    """
    options = options or CableOptions()
    item = flexible.flexible_object(_segments(cable, lengths, options), name="cable")
    if options.has_rest_angle_parameters:
        item = _with_rest_angles(item)
    if options.shape_memory_fraction is not None:
        item = _with_memory(item, options.shape_memory_fraction)
    clamps = _start_clamp(lengths[cable.main_branch_vertex_names[0], cable.main_branch_vertex_names[1]], cable)
    clamps = clamps.with_attached_mechanism(six_joint_floating_mechanism(END_CLAMP))
    rotation = ca.SX(ca.DM.eye(3))
    if options.end_clamp_grasp_kind == "weld":
        text = "roll of the end clamp about the last edge"
        end_roll = Parameter(f"{END_CLAMP}.roll", 0.0, "rad", -np.pi, np.pi, text)
        clamps = replace(clamps, parameters=clamps.parameters.with_added([end_roll]))
        rotation = symbolic_rotation_from_axis_angle(flexible.AXIS_UNIT_VECTORS["z"], end_roll.symbol)
    hung = (_with_vertices(item, cable, lengths), _START_EDGE_FRAME, None)
    held = Grasp(END_CLAMP, END_CLAMP, _LAST_EDGE_FRAME, options.end_clamp_grasp_kind, rotation)
    known: SystemBuildArguments = {"objects": [hung], "grasps": [held], "prescribed": clamps.joint_names, "damping": {}}
    known |= {"gravity": options.gravity, "point_frames": cable.vertex_names}
    return System.build(clamps, **known)


def _with_rest_angles(item: flexible.FlexibleObject) -> flexible.FlexibleObject:
    text = "rest angle relative to the undeformed shape's"
    bends = (spring.joint_name for spring in item.elastic_joints if spring.deformation == "bend")
    rest = {name: Parameter(f"{name}.rest", 0.0, "rad", -np.pi, np.pi, text) for name in bends}
    added = {name: parameter.symbol for name, parameter in rest.items()}
    elastic = (replace(s, rest_angle=s.rest_angle + added.get(s.joint_name, 0)) for s in item.elastic_joints)
    return _with_parameters(item, rest.values(), elastic)


def _with_parameters(
    item: flexible.FlexibleObject, entries: Iterable[Parameter], elastic: Iterable[flexible.ElasticJoint]
) -> flexible.FlexibleObject:
    tree = replace(item.mechanism, parameters=item.mechanism.parameters.with_added(entries))
    return replace(item, mechanism=tree, elastic_joints=tuple(elastic))


def _with_memory(item: flexible.FlexibleObject, memory: float) -> flexible.FlexibleObject:
    text = "share of the start's shape in the rest shape"
    shares = {s.name: Parameter(f"{s.name}.memory", memory, "1", 0.0, 1.0, text) for s in item.segment_layouts}
    text = "speed of the vertices at the recording's start"
    speed = Parameter(INITIAL_RMS_SPEED_PARAMETER, 0.0, "m/s", 0.0, np.inf, text)
    text = "start speed at which the memory counts half"
    scale = Parameter(SHAPE_MEMORY_HALVING_SPEED_PARAMETER_NAME, 0.3, "m/s", 1e-3, np.inf, text)
    trust = 1 / (1 + (speed.symbol / scale.symbol) ** 2)
    entries, elastic = [*shares.values(), speed, scale], []
    for spring in item.elastic_joints:
        names = [f"{spring.joint_name}.{suffix}" for suffix in INITIAL_ANGLE_AND_TORQUE_SUFFIXES]
        angle = Parameter(names[0], 0.0, "rad", description="angle at the recording's start")
        load = Parameter(names[1], 0.0, "N m", description="torque borne at the recording's start")
        entries += [angle, load]
        shift = angle.symbol - load.symbol / (spring.stiffness + _MIN_STIFFNESS)
        share = trust * shares[spring.segment_name].symbol
        elastic.append(replace(spring, rest_angle=spring.rest_angle + share * (shift - spring.rest_angle)))
    return _with_parameters(item, entries, elastic)


def _with_vertices(
    item: flexible.FlexibleObject, cable: CableVertices, lengths: Mapping[tuple[str, str], float]
) -> flexible.FlexibleObject:
    """The object with its vertices as frames. Arc lengths along the parent branch are measured from clamp to clamp."""
    tree = item.mechanism
    frames = dict(tree.frames)
    for name, chain in cable.vertex_names_by_branch.items():
        first = 2 if name == cable.parent_segment else 1
        frames |= {vertex: frames[f"{name}_{i}_tip"] for i, vertex in enumerate(chain[first:])}
        if name != cable.parent_segment:
            frames[f"junction_{name}"] = frames[chain[0]]
    last = tree.joint_index(item.segment_layouts[0].link_joints[-1][-1])
    frames[_LAST_EDGE_FRAME] = Frame(last, Placement.identity())
    edges = np.array([lengths[edge] for edge in pairwise(cable.main_branch_vertex_names)])
    frames_along = (cable.main_branch_vertex_names[1], *tree.link_chains[cable.parent_segment].tip_frames)
    whole = ArcLengthChain(frames_along, tuple(map(float, edges / edges.sum())))
    lines = {**tree.link_chains, cable.parent_segment: whole}
    return replace(item, mechanism=replace(tree, frames=frames, link_chains=lines))


def _start_clamp(length: float, cable: CableVertices) -> Mechanism:
    clamp = six_joint_floating_mechanism(START_CLAMP)
    roll = Parameter(f"{START_CLAMP}.roll", 0.0, "rad", -np.pi, np.pi, "roll of the start clamp about the first edge")
    edge = Parameter(f"{START_CLAMP}.length", length, "m", 1e-9, np.inf, "length of the first edge")
    carrier = clamp.frame(START_CLAMP)
    turn = symbolic_rotation_from_axis_angle(flexible.AXIS_UNIT_VECTORS["z"], roll.symbol)
    tip = Frame(carrier.joint_index, Placement(turn, ca.vertcat(0, 0, edge.symbol)))
    first, second = cable.main_branch_vertex_names[:2]
    frames = {**clamp.frames, first: carrier, second: tip, _START_EDGE_FRAME: tip}
    return Mechanism(START_CLAMP, clamp.joints, frames, Parameters([roll, edge]))


def _segments(
    cable: CableVertices, lengths: Mapping[tuple[str, str], float], options: CableOptions
) -> list[flexible.FlexibleSegment]:
    parent = cable.main_branch_vertex_names
    turns = flexible.edge_to_edge_rotations_from_vertices(cable.undeformed_polyline(parent))
    # rest frame of every parent edge, from which children's directions are measured
    carried, segments = list(accumulate(turns, operator.matmul)), []
    for name, chain in cable.vertex_names_by_branch.items():
        branch = options.branch_properties_by_name.get(name, options.default_branch)
        if name == cable.parent_segment:
            chain, at, own, before = chain[1:], None, turns[1:], lengths[parent[0], parent[1]]
        else:
            junction = parent.index(chain[0])
            own = flexible.edge_to_edge_rotations_from_vertices(cable.undeformed_polyline(chain), carried[junction - 1])
            before = None
            at = junction - 2
        edges = [lengths[edge] for edge in pairwise(chain)]
        segment = flexible.FlexibleSegment(
            name,
            sum(edges),
            branch.linear_density * sum(edges),
            options.radius,
            link_lengths=edges,
            bend=branch.bend_rigidity,
            twist=branch.twist_rigidity,
            damping=branch.bend_damping,
            twist_damping=branch.bend_damping if branch.has_separate_twist_damping else None,
            values_given_as_rigidities=True,
            has_length_parameter_per_link=True,
        )
        segment = replace(segment, parent=None if at is None else cable.parent_segment, parent_link_index=at)
        segments.append(replace(segment, rest_rotation=own[0], link_rest_rotations=own[1:], clamped_edge_length=before))
    return segments


@OBJECT_KINDS.register("cable")
@dataclass(frozen=True, kw_only=True)
class _ClampedCable(CableOptions, ObjectBuilder):
    """A cable (with branches or without) between two clamps that follow measured points, without a robot."""

    kind: Annotated[Literal["cable"], OptionInfo("kind of object")] = "cable"
    main_branch_vertex_names: Annotated[
        tuple[str, ...], Len(5), OptionInfo("points from clamp to clamp, two held at each end")
    ]
    child_branch_vertex_names: Annotated[
        Mapping[str, tuple[str, ...]],
        OptionInfo("points of every child branch; the first one is the point of the parent at which it leaves"),
    ] = field(default_factory=dict)
    undeformed_shape_file: Annotated[
        str,
        OptionInfo("a file, relative to the configuration", is_path=True),
        OptionInfo("CSV table with the columns point, x, y, z [m]"),
    ]

    def clamped_cable_vertices(self) -> CableVertices:
        undeformed = read_vertex_positions_by_name(self.undeformed_shape_file)
        found = CableVertices(self.main_branch_vertex_names, dict(self.child_branch_vertex_names), undeformed)
        for name in self.branch_properties_by_name:
            where = f"model.object.branch_properties_by_name.{name}"
            require_known_names([name], found.vertex_names_by_branch, "branch", where, ModelError)
        return found

    def build_system_with_clamps(self, edge_lengths: Mapping[tuple[str, str], float], gravity: Vector3) -> System:
        return clamped_cable_system(edge_lengths, self.clamped_cable_vertices(), replace(self, gravity=gravity))

    def edge_length_parameter_values(self, edge_lengths: Mapping[tuple[str, str], float]) -> dict[str, float]:
        return length_parameters_from_edges(self.clamped_cable_vertices(), edge_lengths)

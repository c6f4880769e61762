"""Search for initial shapes of the shape fit, from the object's centerline in the cloud.

The nearest-neighbour graph of a cloud is cut into slices of equal geodesic distance from one end. Touching parts of
neighbouring slices form a Reeb graph, whose cycles are loops of the object. Its ends are assigned to the root and the
tips of the object in every way that agrees with the path lengths between them. Each assignment gives an initial shape.

References
----------
Verroust & Lazarus (2000), Extracting skeletal curves from 3D scattered data, doi:10.1007/PL00007210.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import NamedTuple

import casadi as ca
import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra, minimum_spanning_tree
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from yid_ocp.arrays import Array, IntArray
from yid_ocp.integrator.interpreted import dense_function_evaluator
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.mechanism import Mechanism
from yid_ocp.model.system import System, six_joint_floating_mechanism
from yid_ocp.vision.frames import dropped_frame_error
from yid_ocp.vision.point_cloud import CloudSkeleton, WeightedCloud, indices_among_kept

_N_NEIGHBOURS = 10
_MAX_LINK_SPACINGS = 3.0  # in usual spacings; points further apart are not connected
_MIN_PART_FRACTION = 0.05  # of the points; smaller parts are not the object
_MIN_LOOP_RATIO = 3.0  # a cycle this many times longer than around the object is a loop of it
_MAX_TWIG_DIAMETERS = 1.5  # in diameters; a shorter branch is roughness
_END_DIRECTION_SLICES = 4.0  # widths of slices over which the direction at an end is taken
_MAX_CLOUD_POINTS = 2500  # points


@dataclass(frozen=True, eq=False)
class _Centerline:
    """Centerline of an object in a cloud, as a tree of nodes."""

    nodes: Array  # (K, 3) [m]
    edges: IntArray  # (E, 2), indices of connected nodes
    loop_positions: Array  # (., 3), positions at which the object closes a loop [m]
    slice_width: float  # distance along the object that one node represents [m]

    @property
    def to_skeleton(self) -> CloudSkeleton:
        """Skeleton with the same nodes and edges, without points."""
        return CloudSkeleton(self.nodes, np.empty(0, dtype=np.int64), self.edges)

    def outward_direction(self, end: int) -> Array:
        """Unit vector (3,) along the object at one of its ends, away from it."""
        far, _ = self.path_lengths_from(end)
        most = max(_END_DIRECTION_SLICES * self.slice_width, float(far[far > 0].min()))
        way = self.nodes[end] - self.nodes[(far > 0) & (far <= most)].mean(axis=0)
        return np.asarray(way / max(float(np.linalg.norm(way)), 1e-12))

    def path_lengths_from(self, start: int) -> tuple[Array, IntArray]:
        """Path length [m] from a node to every other node, and the predecessor of each."""
        far, before = dijkstra(_graph(self.nodes, self.edges), directed=False, indices=start, return_predecessors=True)
        return np.asarray(far), np.asarray(before, dtype=np.int64)

    def path_between(self, start: int, end: int) -> Array:
        """Positions (., 3) [m] of the nodes on the path between two nodes."""
        _, before = self.path_lengths_from(start)
        way = [end]
        while way[-1] != start:
            way.append(int(before[way[-1]]))
        return self.nodes[way[::-1]]


def cloud_centerline_tree(cloud: WeightedCloud, diameter: float, gap: float, rng: np.random.Generator) -> _Centerline:
    """Compute the centerline of the object in a cloud: a tree of nodes, and positions of loops.

    `diameter` [m] is the diameter of the thickest tube. Parts of the cloud more than `gap` [m] apart are not connected.
    """
    points = cloud.points
    if len(points) > _MAX_CLOUD_POINTS:
        points = points[np.sort(rng.choice(len(points), _MAX_CLOUD_POINTS, replace=False))]
    points, graph = _connected(points, gap)
    far = int(np.argmax(dijkstra(graph, directed=False, indices=0)))
    away = np.asarray(dijkstra(graph, directed=False, indices=far))
    width = max(diameter, 2.0 * float(np.median(graph.data)))
    nodes, edges = _slices(points, graph, np.floor(away / width).astype(np.int64))
    tree, loops = _tree(nodes, edges, _MIN_LOOP_RATIO * np.pi * diameter)
    return _pruned(_Centerline(nodes, tree, loops, width), _MAX_TWIG_DIAMETERS * diameter)


def _graph(nodes: Array, edges: IntArray) -> csr_matrix:
    lengths = np.maximum(np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1), 1e-9)
    return coo_matrix((lengths, (edges[:, 0], edges[:, 1])), shape=(len(nodes),) * 2).tocsr()


def _connected(points: Array, gap: float) -> tuple[Array, csr_matrix]:
    """The points of large parts within `gap` [m] of each other, and the graph that connects them."""
    distance, index = cKDTree(points).query(points, k=_N_NEIGHBOURS + 1)
    rows = np.repeat(np.arange(len(points)), _N_NEIGHBOURS)
    columns, lengths = index[:, 1:].ravel(), distance[:, 1:].ravel()
    near = lengths <= _MAX_LINK_SPACINGS * float(np.median(distance[:, 1 : _N_NEIGHBOURS // 2]))
    edges = np.column_stack([rows[near], columns[near]])
    _, part = connected_components(_graph(points, edges), directed=False)
    size = np.bincount(part)
    large = np.flatnonzero(size >= _MIN_PART_FRACTION * len(points))
    bridges, joined = [], [int(large[np.argmax(size[large])])]
    while len(joined) < len(large):
        own = np.flatnonzero(np.isin(part, joined))
        other = np.flatnonzero(np.isin(part, np.setdiff1d(large, joined)))
        apart, nearest = cKDTree(points[own]).query(points[other])
        k = int(np.argmin(apart))
        if apart[k] > gap:
            break
        bridges.append((int(own[nearest[k]]), int(other[k])))
        joined.append(int(part[other[k]]))
    kept = np.flatnonzero(np.isin(part, joined))
    every = indices_among_kept(kept, len(points))[np.concatenate([edges, np.array(bridges, np.int64).reshape(-1, 2)])]
    return points[kept], _graph(points[kept], np.unique(np.sort(every[(every >= 0).all(axis=1)], axis=1), axis=0))


def _slices(points: Array, graph: csr_matrix, slices: IntArray) -> tuple[Array, IntArray]:
    """Centres (K, 3) of the connected parts of every slice, and the pairs of parts that touch."""
    links = graph.tocoo()
    same = slices[links.row] == slices[links.col]
    within = coo_matrix((np.ones(int(same.sum())), (links.row[same], links.col[same])), shape=graph.shape)
    count, owner = connected_components(within.tocsr(), directed=False)
    size = np.bincount(owner, minlength=count)
    nodes = np.stack([np.bincount(owner, points[:, axis], minlength=count) for axis in range(3)], axis=1)
    pairs = np.column_stack([owner[links.row], owner[links.col]])[~same]
    return nodes / size[:, None], np.unique(np.sort(pairs, axis=1), axis=0).astype(np.int64)


def _tree(nodes: Array, edges: IntArray, loop: float) -> tuple[IntArray, Array]:
    """Shortest edges that connect all nodes, and positions of omitted edges that close loops over `loop` [m]."""
    forest = minimum_spanning_tree(_graph(nodes, edges)).tocoo()
    tree = np.column_stack([forest.row, forest.col]).astype(np.int64)
    one, other = edges.T
    along = np.asarray(dijkstra(_graph(nodes, tree), directed=False))[one, other]
    across = np.linalg.norm(nodes[one] - nodes[other], axis=1)  # straight distance; `along`: through the tree
    return tree, (0.5 * (nodes[one] + nodes[other]))[along > np.maximum(loop, 1.001 * across)]


def _pruned(trace: _Centerline, twig: float) -> _Centerline:
    """The centerline without branches shorter than `twig` [m], shortest removed first. A chain is not shortened."""
    nodes, edges = trace.nodes, trace.edges
    while len(edges):
        count = np.bincount(edges.ravel(), minlength=len(nodes))
        branches = [_branch(nodes, edges, count, int(end)) for end in np.flatnonzero(count == 1)]
        short = [(length, way) for length, way in branches if length < twig and count[way[-1]] > 2]
        if not short:
            break
        edges = edges[~np.isin(edges, np.array(min(short, key=lambda found: found[0])[1][:-1])).any(axis=1)]
    used = np.unique(edges)
    return replace(trace, nodes=nodes[used], edges=indices_among_kept(used, len(nodes))[edges])


def _branch(nodes: Array, edges: IntArray, count: IntArray, end: int) -> tuple[float, list[int]]:
    """Length [m] of the branch from an end to the next junction, and its nodes, the junction last."""
    order, _ = breadth_first_order(_graph(nodes, edges), end, directed=False)
    way, length = [end], 0.0
    for node in order[1:]:
        length += float(np.linalg.norm(nodes[node] - nodes[way[-1]]))
        way.append(int(node))
        if count[node] != 2:
            break
    return length, way


_FREE_ROOT_PREFIX = "found_root"  # prefix of the joints added by `add_free_root_joints`
_MAX_ENDS = 7  # of a centerline; more ends are clutter and give too many assignments
_TRIED_MATCH_RATIO = 1.3  # assignments with distance errors up to this multiple of the best one are tried
_WHOLE_OBJECT_TOLERANCE = 0.08  # relative length error of a centerline that shows the whole object


@dataclass(frozen=True, eq=False)
class ObservedObjectEnd:
    """The observed position of one end of an object, measured along the object's axis there."""

    link_end_index: int  # index in the list of start and end of link 0, start and end of link 1, ...
    direction: Array  # (3,), unit vector along the object
    position: Array  # (3,), point of the plane across the object that contains the end [m]
    position_std: float  # standard deviation of the position along `direction` [m]


class InitialShape(NamedTuple):
    """Initial shape of a fit: configuration (n,), root position (3,) [m] and observed ends."""

    q: Array
    root_position: Array
    end_anchors: tuple[ObservedObjectEnd, ...]


def add_free_root_joints(system: System, values: Mapping[str, float] | None = None) -> tuple[System, tuple[str, ...]]:
    """Make a system without grasps, whose object has six named free root joints (position [m], x-y-z angles)."""
    tree, q = system.mechanism_with_values(values), ca.SX.sym("q", system.n_coordinates)
    base = tree.joint_index(next(s for s in system.segment_layouts if s.parent_segment is None).link_joints[0][0])
    place = ca.Function("root", [q], [forward_kinematics(tree, q).joint_origins[base]])(np.zeros(system.n_coordinates))
    under = np.eye(4)
    under[:3, 3] = -np.array(place).ravel()
    carrier = six_joint_floating_mechanism(_FREE_ROOT_PREFIX)
    carried = carrier.with_attached_mechanism(system.mechanism, _FREE_ROOT_PREFIX, under)
    return replace(system, mechanism=carried, grasps=()), carrier.joint_names


class _Link(NamedTuple):
    joints: tuple[int, ...]
    begin: float
    end: float
    tip: int


class ShapeGuessFinder:
    """A finder of initial shapes, which bends joints from `rest` (n,) along a centerline. `lengths`: of links [m]."""

    def __init__(
        self, system: System, tree: Mechanism, rest: Array, bends: Sequence[int], lengths: Mapping[str, Sequence[float]]
    ) -> None:
        self._rest, self._bends = rest, frozenset(bends)
        self._root = [tree.joint_index(name) for name in six_joint_floating_mechanism(_FREE_ROOT_PREFIX).joint_names]
        self._axis = [np.array(joint.axis, float) for joint in tree.joints]
        q = ca.SX.sym("q", len(tree.joints))
        turned = ca.densify(ca.horzcat(*forward_kinematics(tree, q).joint_rotations))
        self._rotations = dense_function_evaluator(ca.Function("rotations", [q], [turned]))
        chains = [tuple(map(tree.joint_index, names)) for own in system.segment_layouts for names in own.link_joints]
        sizes = [float(length) for own in system.segment_layouts for length in lengths[own.name]]
        # the root and the ends of all links are the nodes of a tree
        ends = {chain[-1]: node for node, chain in enumerate(chains, start=1)}
        starts = [ends.get(tree.joints[chain[0]].parent_index, 0) for chain in chains]
        graph = coo_matrix((sizes, (starts, list(ends.values()))), shape=(1 + len(chains),) * 2)
        far = np.asarray(dijkstra(graph.tocsr(), directed=False))
        tips = [node for node in ends.values() if node not in starts]
        self._corners = [0, *(2 * tip - 1 for tip in tips)]
        self._root_to_tip_lengths, self._end_distances = far[0, tips], far[np.ix_([0, *tips], [0, *tips])]
        ways = [tree.ancestor_joint_indices(chains[tip - 1][-1]) for tip in tips]
        behind = [next(k for k, way in enumerate(ways) if chain[-1] in way) for chain in chains]
        reaches = zip(chains, far[0, starts], far[0, 1:], behind, strict=True)
        self._links = [_Link(chain, float(begin), float(end), tip) for chain, begin, end, tip in reaches]

    def shape_guesses_along_centerline(self, trace: _Centerline) -> list[InitialShape]:
        """Find initial shapes that follow a centerline whose path lengths between ends match the object's lengths.

        Raises `DataError` for other ends or lengths: part of the object is hidden, or another body touches it.
        """
        edges_of_node = np.bincount(trace.edges.ravel(), minlength=len(trace.nodes))
        leaves, n_ends = np.flatnonzero(edges_of_node <= 1), len(self._end_distances)
        if not n_ends <= len(leaves) <= _MAX_ENDS:
            counts = f"its cloud has {len(leaves)} free ends, but the object has {n_ends}"
            raise dropped_frame_error(f"the object cannot be followed from end to end: {counts}")
        # the middles of the last slices are half a slice from the ends
        along = np.array([trace.path_lengths_from(int(leaf))[0][leaves] for leaf in leaves]) + trace.slice_width
        np.fill_diagonal(along, 0.0)
        ways = [
            (float(np.abs(along[np.ix_(chosen, chosen)] - self._end_distances).max()), chosen)
            for chosen in permutations(range(len(leaves)), n_ends)
        ]
        best, nearest = min(ways)
        if best > max(_WHOLE_OBJECT_TOLERANCE * float(self._root_to_tip_lengths.max()), trace.slice_width):
            own = self._end_distances[0, 1]
            lengths = f"{along[nearest[0], nearest[1]]:.2f} m from end to end, but the object has {own:.2f} m"
            raise dropped_frame_error(f"the object cannot be followed from end to end: the cloud has {lengths}")
        limit = max(_TRIED_MATCH_RATIO * best, trace.slice_width)
        kept = [chosen for off, chosen in sorted(ways) if off <= limit][: 2 * n_ends]
        return [self._along(trace, [int(leaves[k]) for k in chosen]) for chosen in kept]

    def _along(self, trace: _Centerline, ends: Sequence[int]) -> InitialShape:
        """The initial shape whose root and tips, in this order, are at the nodes `ends` of the centerline."""
        reaches = zip(ends[1:], self._root_to_tip_lengths, strict=True)
        courses = [_Course(trace.path_between(ends[0], end), reach) for end, reach in reaches]
        q, first = self._rest.copy(), self._links[0]
        aim = courses[first.tip].direction(first.begin, first.end)
        carry = Rotation.align_vectors(aim, self._orientation(q, first.joints[-1])[:, 2])[0].as_matrix()
        for link in self._links[1:]:
            self._bend(q, link.joints, carry.T @ courses[link.tip].direction(link.begin, link.end))
        place = courses[first.tip].at(0.0)
        q[self._root[:3]] = place
        q[self._root[3:]] = Rotation.from_matrix(carry).as_euler("XYZ")
        anchors, width = [], trace.slice_width
        for corner, end in zip(self._corners, ends, strict=True):
            ahead = trace.outward_direction(end)
            middle = trace.nodes[end] + 0.5 * width * ahead
            anchors.append(ObservedObjectEnd(corner, ahead, middle, width / np.sqrt(12.0)))
        return InitialShape(q, place, tuple(anchors))

    def _orientation(self, q: Array, joint: int) -> Array:
        """Orientation (3, 3) of a joint's moving frame in the world."""
        return self._rotations(q)[0][:, 3 * joint : 3 * joint + 3]

    def _bend(self, q: Array, joints: Sequence[int], aim: Array) -> None:
        """Set the bends in `q` of a link so that its long axis z has the direction `aim`."""
        bends, ahead = [j for j in joints if j in self._bends], np.array([0.0, 0.0, 1.0])
        if not bends:
            return
        q[bends[0]] = 0.0
        local, axis = self._orientation(q, bends[0]).T @ aim, self._axis[bends[0]]
        if len(bends) > 1:  # turns about the first axis leave what lies along it
            other = self._axis[bends[1]]
            rate = float(np.cross(other, ahead) @ axis)
            q[bends[1]] = np.arcsin(np.clip(rate * float(local @ axis), -1.0, 1.0))
            ahead = Rotation.from_rotvec(q[bends[1]] * other).apply(ahead)
        level = float(local @ ahead) - float(local @ axis) * float(ahead @ axis)
        q[bends[0]] = np.arctan2(float(local @ np.cross(axis, ahead)), level)


class _Course:
    """A path through a cloud as a polyline, parameterised by length and scaled to the object's length."""

    def __init__(self, nodes: Array, length: float) -> None:
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(nodes, axis=0), axis=1))])
        self.nodes, self.along = nodes, along * (length / max(float(along[-1]), 1e-9))

    def at(self, length: float) -> Array:
        return np.array([np.interp(length, self.along, column) for column in self.nodes.T])

    def direction(self, begin: float, end: float) -> Array:
        way = self.at(end) - self.at(begin)
        return np.asarray(way / max(float(np.linalg.norm(way)), 1e-9))

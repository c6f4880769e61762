"""Centerline of a thin object in a cloud, without knowing where the object begins.

The graph of a cloud's nearest points is cut into slices of equal distance along it from one end. Connected parts of
neighbouring slices that touch make a graph of their own (Reeb's), in which a branch is a chain, a branching a vertex of
three, and a loop that the object closes by touching or crossing itself a cycle.

References
----------
Verroust & Lazarus (2000), Extracting skeletal curves from 3D scattered data, The Visual Computer 16:15,
doi:10.1007/PL00007210.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra, minimum_spanning_tree
from scipy.spatial import cKDTree

from yid_ocp.vision.filters import WeightedCloud
from yid_ocp.vision.skeleton import CloudSkeleton

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_NEIGHBOURS = 10
_SPACINGS = 3.0  # points further apart than so many of their usual distance do not hang together
_LEAST_SHARE = 0.05  # of the points; smaller parts are not the object
_LOOP = 3.0  # a cycle this many times longer than around the object is a loop of it
_TWIG = 1.5  # a branch no longer than so many diameters is roughness
_OUTWARD = 4.0  # widths of slices over which the direction at an end is taken
_MOST = 2500  # points


@dataclass(frozen=True, eq=False)
class Centerline:
    """Centerline of an object in a cloud, as a tree of nodes.

    Attributes
    ----------
    nodes : ndarray, shape (V, 3)
        Means of connected slices [m].
    edges : ndarray of int, shape (V - 1, 2)
        A tree.
    loop_positions : ndarray, shape (L, 3)
        Where cycles that were cut open closed, which are too long to be the object's surface [m].
    slice_width : float
        Of a slice [m].
    """

    nodes: Array
    edges: Integers
    loop_positions: Array
    slice_width: float

    @property
    def end_nodes(self) -> Integers:
        """Nodes at which only one edge ends."""
        count = np.bincount(self.edges.ravel(), minlength=len(self.nodes))
        return np.flatnonzero(count <= 1)

    @property
    def to_skeleton(self) -> CloudSkeleton:
        """Skeleton with the same nodes and edges, without points."""
        count = len(self.nodes)
        none = np.empty(0, dtype=np.int64)
        return CloudSkeleton(self.nodes, np.ones(count), none, self.edges, np.zeros(count, dtype=np.int64))

    def outward_direction(self, end: int) -> Array:
        """Unit vector along the object at one of its ends, away from it, shape (3,)."""
        far, _ = self.path_lengths_from(end)
        near = np.flatnonzero((far > 0) & (far <= max(_OUTWARD * self.slice_width, float(far[far > 0].min()))))
        way = self.nodes[end] - self.nodes[near].mean(axis=0)
        return np.asarray(way / max(float(np.linalg.norm(way)), 1e-12))

    def path_lengths_from(self, start: int) -> tuple[Array, Integers]:
        """Path length from a node to every other one [m], and the predecessor of each."""
        far, before = dijkstra(_graph(self.nodes, self.edges), directed=False, indices=start, return_predecessors=True)
        return np.asarray(far), np.asarray(before, dtype=np.int64)

    def path_between(self, start: int, end: int) -> Array:
        """Positions of the nodes on the path between two nodes, shape (., 3) [m]."""
        _, before = self.path_lengths_from(start)
        way = [end]
        while way[-1] != start:
            way.append(int(before[way[-1]]))
        return self.nodes[way[::-1]]


def trace_centerline(cloud: WeightedCloud, diameter: float, gap: float, rng: np.random.Generator) -> Centerline:
    """Trace the centerline of an object in a cloud.

    Parameters
    ----------
    cloud : Cloud
        The object's points.
    diameter : float
        Of its thickest tube [m].
    gap : float
        Parts further apart do not hang together [m].
    rng : Generator
        For the choice among many points.

    Returns
    -------
    Trace
        Without nodes where the cloud has too few points.
    """
    points = cloud.points
    if len(points) > _MOST:
        points = points[np.sort(rng.choice(len(points), _MOST, replace=False))]
    nothing = Centerline(np.empty((0, 3)), np.empty((0, 2), dtype=np.int64), np.empty((0, 3)), diameter)
    if len(points) <= _NEIGHBOURS:
        return nothing
    points, graph = _connected(points, gap)
    if len(points) <= _NEIGHBOURS:
        return nothing
    far = int(np.argmax(dijkstra(graph, directed=False, indices=0)))
    away = np.asarray(dijkstra(graph, directed=False, indices=far))
    spacing = float(np.median(graph.data))
    width = max(diameter, 2.0 * spacing)
    slices = np.floor(away / width).astype(np.int64)
    nodes, edges = _slices(points, graph, slices)
    tree, loops = _tree(nodes, edges, _LOOP * np.pi * diameter)
    return _pruned(Centerline(nodes, tree, loops, width), _TWIG * diameter)


def _graph(nodes: Array, edges: Integers) -> csr_matrix:
    lengths = np.maximum(np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1), 1e-9)
    return coo_matrix((lengths, (edges[:, 0], edges[:, 1])), shape=(len(nodes),) * 2).tocsr()


def _connected(points: Array, gap: float) -> tuple[Array, csr_matrix]:
    """The points of parts that are large and near enough, and the graph that joins them."""
    distance, index = cKDTree(points).query(points, k=_NEIGHBOURS + 1)
    rows = np.repeat(np.arange(len(points)), _NEIGHBOURS)
    columns, lengths = index[:, 1:].ravel(), distance[:, 1:].ravel()
    near = lengths <= _SPACINGS * float(np.median(distance[:, 1 : _NEIGHBOURS // 2]))
    edges = np.column_stack([rows[near], columns[near]])
    _, part = connected_components(_graph(points, edges), directed=False)
    size = np.bincount(part)
    large = np.flatnonzero(size >= _LEAST_SHARE * len(points))
    bridges = []
    joined, rest = [int(large[np.argmax(size[large])])], [int(k) for k in large]
    rest.remove(joined[0])
    while rest:
        own = np.flatnonzero(np.isin(part, joined))
        tree = cKDTree(points[own])
        best = min(((*_closest(tree, points, part, k), k) for k in rest), key=lambda found: found[0])
        if best[0] > gap:
            break
        bridges.append((int(own[best[1]]), best[2]))
        joined.append(best[3])
        rest.remove(best[3])
    kept = np.flatnonzero(np.isin(part, joined))
    renamed = np.full(len(points), -1)
    renamed[kept] = np.arange(len(kept))
    every = np.concatenate([edges, np.array(bridges, dtype=np.int64).reshape(-1, 2)])
    every = renamed[every]
    every = every[(every >= 0).all(axis=1)]
    both = np.unique(np.sort(every, axis=1), axis=0)
    return points[kept], _graph(points[kept], both)


def _closest(tree: cKDTree, points: Array, part: Integers, number: int) -> tuple[float, int, int]:
    """Distance from a part to the points of a tree, and the two points."""
    mine = np.flatnonzero(part == number)
    distance, other = tree.query(points[mine])
    k = int(np.argmin(distance))
    return float(distance[k]), int(other[k]), int(mine[k])


def _slices(points: Array, graph: csr_matrix, slices: Integers) -> tuple[Array, Integers]:
    """Connected parts of every slice, and which of them touch."""
    links = graph.tocoo()
    same = slices[links.row] == slices[links.col]
    within = coo_matrix((np.ones(int(same.sum())), (links.row[same], links.col[same])), shape=graph.shape)
    count, owner = connected_components(within.tocsr(), directed=False)
    size = np.bincount(owner, minlength=count)
    nodes = np.stack([np.bincount(owner, points[:, axis], minlength=count) for axis in range(3)], axis=1)
    pairs = np.column_stack([owner[links.row], owner[links.col]])[~same]
    edges = np.unique(np.sort(pairs, axis=1), axis=0)
    return nodes / size[:, None], edges.astype(np.int64)


def _tree(nodes: Array, edges: Integers, loop: float) -> tuple[Integers, Array]:
    """Shortest edges that join all nodes, and where an edge left out closes a longer way than `loop` [m]."""
    if not len(edges):
        return edges, np.empty((0, 3))
    graph = _graph(nodes, edges)
    forest = minimum_spanning_tree(graph).tocoo()
    tree = np.column_stack([forest.row, forest.col]).astype(np.int64)
    kept = {(int(min(a, b)), int(max(a, b))) for a, b in tree}
    left = [(int(a), int(b)) for a, b in edges if (int(a), int(b)) not in kept]
    if not left:
        return tree, np.empty((0, 3))
    starts = sorted({a for a, _ in left})
    far = dijkstra(_graph(nodes, tree), directed=False, indices=starts)
    closing = [(a, b) for a, b in left if far[starts.index(a), b] > loop]
    places = [0.5 * (nodes[a] + nodes[b]) for a, b in closing]
    return tree, np.array(places).reshape(-1, 3)


def _pruned(trace: Centerline, twig: float) -> Centerline:
    """The trace without branches that are shorter than `twig` [m], the shortest first, and chains kept whole."""
    nodes, edges = trace.nodes, trace.edges
    while len(edges):
        count = np.bincount(edges.ravel(), minlength=len(nodes))
        branches = [_branch(nodes, edges, count, int(end)) for end in np.flatnonzero(count == 1)]
        short = [(length, way) for length, way in branches if length < twig and count[way[-1]] > 2]
        if not short:
            break
        gone = np.array(min(short, key=lambda found: found[0])[1][:-1])
        edges = edges[~np.isin(edges, gone).any(axis=1)]
    used = np.unique(edges)
    renamed = np.full(len(nodes), -1)
    renamed[used] = np.arange(len(used))
    return Centerline(nodes[used], renamed[edges], trace.loop_positions, trace.slice_width)


def _branch(nodes: Array, edges: Integers, count: Integers, end: int) -> tuple[float, list[int]]:
    """Length of the branch from an end to where another one leaves [m], and its nodes with that one last."""
    order, before = breadth_first_order(_graph(nodes, edges), end, directed=False)
    del before
    way, length = [end], 0.0
    for node in order[1:]:
        length += float(np.linalg.norm(nodes[node] - nodes[way[-1]]))
        way.append(int(node))
        if count[node] != 2:
            break
    return length, way

"""Skeleton of a cloud: nodes along the tubes, and the graph that joins them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

from yid_ocp.options import OptionInfo, check_option_bounds
from yid_ocp.vision.filters import WeightedCloud

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class SkeletonOptions:
    """Settings of the skeleton extraction."""

    segment_neighbours: Annotated[int, Ge(2), OptionInfo("points of a segment, k1 in the source paper")] = 50
    neighbour_radius: Annotated[
        float,
        Gt(0),
        OptionInfo("points further away are no neighbours; somewhat more than the thickest tube's diameter", "m"),
    ] = 0.07
    min_segment_points: Annotated[int, Ge(1), OptionInfo("a segment of fewer points gives no node")] = 15
    node_neighbours: Annotated[int, Ge(1), OptionInfo("neighbours of a node in the graph")] = 4
    max_edge_length: Annotated[float, Gt(0), OptionInfo("nodes further apart are not joined", "m")] = 0.15
    min_component_fraction: Annotated[
        float,
        Ge(0),
        Le(1),
        OptionInfo("a connected part of the graph that holds a smaller fraction of the points is not the object"),
    ] = 0.04

    def __post_init__(self) -> None:
        check_option_bounds(self, "walk options")


@dataclass(frozen=True, eq=False)
class CloudSkeleton:
    """Nodes of a cloud and the graph between them.

    Attributes
    ----------
    nodes : ndarray, shape (K, 3)
        Centroids of the kept segments, in the order of the walk [m].
    node_weights : ndarray, shape (K,)
        Points (weights) of each segment.
    node_of_point : ndarray of int, shape (N,)
        Node to which each point of the cloud belongs, -1 for none.
    edges : ndarray of int, shape (E, 2)
        Minimum spanning forest of the graph of nearest neighbours.
    component_of_node : ndarray of int, shape (K,)
        Connected part of each node, the one with most points first.
    """

    nodes: Array
    node_weights: Array
    node_of_point: Integers
    edges: Integers
    component_of_node: Integers

    @property
    def has_node(self) -> NDArray[np.bool_]:
        """Whether each point of the cloud belongs to a node, shape (N,)."""
        return self.node_of_point >= 0


def _thin_to_nodes(
    cloud: WeightedCloud,
    rng: np.random.Generator,
    options: SkeletonOptions | None = None,
    down: ArrayLike = (0.0, 0.0, -1.0),
) -> tuple[Array, Array, Integers]:
    """Thin a cloud to nodes, segment by segment.

    The seed is the lowest point. Its k1 nearest neighbours have a centroid; the k1 nearest neighbours of that centroid
    are the centred segment, whose centroid becomes a node where the segment has points enough. The segment is removed.
    The remaining point that is nearest to its centre is the next seed; where none is within the radius, a point drawn
    at random. It ends when no point is left.

    Parameters
    ----------
    cloud : Cloud
    rng : Generator
        For the points drawn at random.
    options : WalkOptions, optional
    down : array_like, shape (3,)
        Direction of gravity in the frame of the points.

    Returns
    -------
    nodes : ndarray, shape (K, 3)
        [m]
    size : ndarray, shape (K,)
        Weight of each node's points.
    label : ndarray of int, shape (N,)
        Node of every point, -1 where its segment gave none.
    """
    chosen = options or SkeletonOptions()
    label = np.full(len(cloud), -1)
    alive = np.arange(len(cloud))
    points, weight = cloud.points, cloud.point_weights
    nodes: list[Array] = []
    size: list[float] = []
    seed = points[int(np.argmax(points @ np.asarray(down, float)))] if len(points) else np.zeros(3)

    while len(alive):
        first = _near(points, seed, chosen)
        centred = _near(points, np.average(points[first], axis=0, weights=weight[first]), chosen)
        if not len(centred):  # a ring about its own centre: take the segment itself, or the walk would not go on
            centred = first
        centre = np.average(points[centred], axis=0, weights=weight[centred])
        if len(centred) >= chosen.min_segment_points:
            label[alive[centred]] = len(nodes)
            nodes.append(centre)
            size.append(float(weight[centred].sum()))
        stays = np.ones(len(alive), bool)
        stays[centred] = False
        alive, points, weight = alive[stays], points[stays], weight[stays]
        if not len(alive):
            break
        away = points - centre
        square = np.einsum("ij,ij->i", away, away)
        following = int(np.argmin(square))
        if square[following] > chosen.neighbour_radius**2:
            following = int(rng.integers(len(alive)))
        seed = points[following]
    return np.array(nodes).reshape(-1, 3), np.array(size), label


def _near(points: Array, centre: Array, options: SkeletonOptions) -> Integers:
    """The nearest points of a centre within the radius, no more than a segment has."""
    away = points - centre
    square = np.einsum("ij,ij->i", away, away)
    within = options.neighbour_radius**2
    if len(square) > options.segment_neighbours:
        found = np.argpartition(square, options.segment_neighbours - 1)[: options.segment_neighbours]
        return np.asarray(found[square[found] <= within])
    return np.flatnonzero(square <= within)


def _spanning_forest(nodes: Array, options: SkeletonOptions | None = None) -> tuple[Integers, Integers]:
    """Join nodes to their nearest neighbours and keep the shortest edges that connect them.

    Parameters
    ----------
    nodes : ndarray, shape (K, 3)
        [m]
    options : WalkOptions, optional

    Returns
    -------
    edges : ndarray of int, shape (E, 2)
        Minimum spanning forest.
    part : ndarray of int, shape (K,)
        Connected part of each node.
    """
    chosen = options or SkeletonOptions()
    count = len(nodes)
    if count < 2:
        return np.empty((0, 2), dtype=np.int64), np.zeros(count, dtype=np.int64)
    k = min(chosen.node_neighbours + 1, count)
    distance, index = cKDTree(nodes).query(nodes, k=k, distance_upper_bound=chosen.max_edge_length)
    rows = np.repeat(np.arange(count), k)
    columns, lengths = index.ravel(), distance.ravel()
    good = np.isfinite(lengths) & (columns != rows)
    # a length of zero would be no edge to scipy
    entries = (np.maximum(lengths[good], 1e-9), (rows[good], columns[good]))
    forest = minimum_spanning_tree(coo_matrix(entries, shape=(count, count)).tocsr()).tocoo()
    part = connected_components(forest, directed=False)[1]
    return np.column_stack([forest.row, forest.col]).astype(np.int64), part.astype(np.int64)


def extract_skeleton(
    cloud: WeightedCloud,
    rng: np.random.Generator,
    options: SkeletonOptions | None = None,
    down: ArrayLike = (0.0, 0.0, -1.0),
) -> CloudSkeleton:
    """Skeleton of a cloud, without connected parts that hold too few points.

    Parameters
    ----------
    cloud : Cloud
    rng : Generator
    options : WalkOptions, optional
    down : array_like, shape (3,)

    Returns
    -------
    Skeleton
        Without nodes where the cloud has nowhere enough points.
    """
    chosen = options or SkeletonOptions()
    nodes, size, label = _thin_to_nodes(cloud, rng, chosen, down)
    _, part = _spanning_forest(nodes, chosen)
    if not len(nodes):
        return CloudSkeleton(nodes, size, label, np.empty((0, 2), dtype=np.int64), part)
    held = np.bincount(part, size)
    order = np.argsort(-held, kind="stable")
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    keep = held[part] >= chosen.min_component_fraction * size.sum()
    renamed = np.full(len(nodes) + 1, -1)
    renamed[:-1][keep] = np.arange(int(keep.sum()))
    edges, _ = _spanning_forest(nodes[keep], chosen)
    return CloudSkeleton(nodes[keep], size[keep], renamed[label], edges, rank[part[keep]])

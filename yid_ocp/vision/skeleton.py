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

from yid_ocp.options import About, check
from yid_ocp.vision.filters import Cloud

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class WalkOptions:
    """Settings of the skeleton extraction."""

    neighbours: Annotated[int, Ge(2), About("points of a segment, k1 in the source paper")] = 50
    radius: Annotated[
        float,
        Gt(0),
        About("points further away are no neighbours; somewhat more than the thickest tube's diameter", "m"),
    ] = 0.07
    least: Annotated[int, Ge(1), About("a segment of fewer points gives no node")] = 15
    links: Annotated[int, Ge(1), About("neighbours of a node in the graph")] = 4
    link_length: Annotated[float, Gt(0), About("nodes further apart are not joined", "m")] = 0.15
    least_share: Annotated[
        float,
        Ge(0),
        Le(1),
        About("a connected part of the graph that holds a smaller fraction of the points is not the object"),
    ] = 0.04

    def __post_init__(self) -> None:
        check(self, "walk options")


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Nodes of a cloud and the graph between them.

    Attributes
    ----------
    nodes : ndarray, shape (K, 3)
        Centroids of the kept segments, in the order of the walk [m].
    size : ndarray, shape (K,)
        Points (weights) of each segment.
    label : ndarray of int, shape (N,)
        Node to which each point of the cloud belongs, -1 for none.
    edges : ndarray of int, shape (E, 2)
        Minimum spanning forest of the graph of nearest neighbours.
    part : ndarray of int, shape (K,)
        Connected part of each node, the one with most points first.
    """

    nodes: Array
    size: Array
    label: Integers
    edges: Integers
    part: Integers

    @property
    def connected(self) -> NDArray[np.bool_]:
        """Whether each point of the cloud belongs to a node, shape (N,)."""
        return self.label >= 0


def walk(
    cloud: Cloud, rng: np.random.Generator, options: WalkOptions | None = None, down: ArrayLike = (0.0, 0.0, -1.0)
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
    chosen = options or WalkOptions()
    label = np.full(len(cloud), -1)
    alive = np.arange(len(cloud))
    points, weight = cloud.points, cloud.weight
    nodes: list[Array] = []
    size: list[float] = []
    seed = points[int(np.argmax(points @ np.asarray(down, float)))] if len(points) else np.zeros(3)

    while len(alive):
        first = _near(points, seed, chosen)
        centred = _near(points, np.average(points[first], axis=0, weights=weight[first]), chosen)
        if not len(centred):  # a ring about its own centre: take the segment itself, or the walk would not go on
            centred = first
        centre = np.average(points[centred], axis=0, weights=weight[centred])
        if len(centred) >= chosen.least:
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
        if square[following] > chosen.radius**2:
            following = int(rng.integers(len(alive)))
        seed = points[following]
    return np.array(nodes).reshape(-1, 3), np.array(size), label


def _near(points: Array, centre: Array, options: WalkOptions) -> Integers:
    """The nearest points of a centre within the radius, no more than a segment has."""
    away = points - centre
    square = np.einsum("ij,ij->i", away, away)
    within = options.radius**2
    if len(square) > options.neighbours:
        found = np.argpartition(square, options.neighbours - 1)[: options.neighbours]
        return np.asarray(found[square[found] <= within])
    return np.flatnonzero(square <= within)


def connect(nodes: Array, options: WalkOptions | None = None) -> tuple[Integers, Integers]:
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
    chosen = options or WalkOptions()
    count = len(nodes)
    if count < 2:
        return np.empty((0, 2), dtype=np.int64), np.zeros(count, dtype=np.int64)
    k = min(chosen.links + 1, count)
    distance, index = cKDTree(nodes).query(nodes, k=k, distance_upper_bound=chosen.link_length)
    rows = np.repeat(np.arange(count), k)
    columns, lengths = index.ravel(), distance.ravel()
    good = np.isfinite(lengths) & (columns != rows)
    # a length of zero would be no edge to scipy
    entries = (np.maximum(lengths[good], 1e-9), (rows[good], columns[good]))
    forest = minimum_spanning_tree(coo_matrix(entries, shape=(count, count)).tocsr()).tocoo()
    part = connected_components(forest, directed=False)[1]
    return np.column_stack([forest.row, forest.col]).astype(np.int64), part.astype(np.int64)


def skeleton(
    cloud: Cloud, rng: np.random.Generator, options: WalkOptions | None = None, down: ArrayLike = (0.0, 0.0, -1.0)
) -> Skeleton:
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
    chosen = options or WalkOptions()
    nodes, size, label = walk(cloud, rng, chosen, down)
    _, part = connect(nodes, chosen)
    if not len(nodes):
        return Skeleton(nodes, size, label, np.empty((0, 2), dtype=np.int64), part)
    held = np.bincount(part, size)
    order = np.argsort(-held, kind="stable")
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    keep = held[part] >= chosen.least_share * size.sum()
    renamed = np.full(len(nodes) + 1, -1)
    renamed[:-1][keep] = np.arange(int(keep.sum()))
    edges, _ = connect(nodes[keep], chosen)
    return Skeleton(nodes[keep], size[keep], renamed[label], edges, rank[part[keep]])

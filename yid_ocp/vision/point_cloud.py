"""Filters that keep the object's points in a cloud, and the computation of the cloud's skeleton."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated

import casadi as ca
import numpy as np
from annotated_types import Ge, Le
from numpy.typing import ArrayLike
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

from yid_ocp.arrays import Array, BoolArray, IntArray
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.system import System
from yid_ocp.options import OptionInfo, PositiveFloat, check_option_bounds
from yid_ocp.vision.surface_meshes import model_link_lengths_and_radius_by_segment

XyzTuple = tuple[float, float, float]
_ColourComponent = Annotated[float, Ge(0), Le(255)]
_RgbColour = tuple[_ColourComponent, _ColourComponent, _ColourComponent]

_SPACING_SAMPLE_POINTS = 3000  # smallest number of points that estimate the usual spacing
_MAX_COLOUR_ANGLE = 0.2  # angle to a colour of the object, as directions of linear light [rad]
_OUTLIER_NEIGHBOURS, _OUTLIER_Z_MAX = 12, 4.0  # neighbours of an isolated point; robust stds of their mean distance
_REACH_MARGIN = 0.1  # beyond the longest branch, from the object's root [m]
_FLOOR_MARGIN_ABOVE_OBJECT_FOOT = 0.05  # the floor and points that it scatters are lower [m]
_MAX_CLOUD_POINTS_PER_NODE = 50  # points per segment of the skeleton, k1 in Caldwell et al.
_MIN_NEIGHBOUR_RADIUS, _NEIGHBOUR_RADIUS_IN_DIAMETERS = 0.07, 1.05  # neighbours: more than across a tube [m], [-]
MAX_EDGE_LENGTH = 0.15  # largest distance of connected nodes of the skeleton [m]
_MIN_SEGMENT_POINTS = 15  # a segment of the skeleton with fewer points gives no node
_NODE_NEIGHBOURS = 4  # of a node in the skeleton's graph
_MIN_COMPONENT_FRACTION = 0.04  # of the points; a smaller connected part is not part of the object
MAD_TO_STD = 1.4826  # median absolute deviation to std of a normal distribution


@dataclass(frozen=True, eq=False)
class WeightedCloud:
    """A point cloud with weights. A weight is the number of camera points that a point represents."""

    points: Array  # (N, 3), in the world [m]
    point_weights: Array  # (N,), number of camera points that each point represents

    def __len__(self) -> int:
        return len(self.points)

    def select(self, mask: BoolArray | IntArray) -> WeightedCloud:
        """Select points by a mask or a list of indices."""
        return WeightedCloud(self.points[mask], self.point_weights[mask])


@dataclass(frozen=True)
class CloudFilterOptions:
    """The settings of the filters that select the object's points."""

    voxel_size: Annotated[PositiveFloat, OptionInfo("edge of the cubes in which points are averaged", "m")] = 0.008
    robot_padding: Annotated[
        PositiveFloat,
        OptionInfo("points this close to the robot belong to it; about five standard deviations of the depth", "m"),
    ] = 0.03
    box_lower: Annotated[
        XyzTuple | None, OptionInfo("lower corner of a box in the world; points outside are removed", "m")
    ] = None
    box_upper: Annotated[XyzTuple | None, OptionInfo("upper corner of this box", "m")] = None
    floor_height: Annotated[
        float | None,
        OptionInfo(
            "points below this height are removed; default: points less than 5 cm above the foot of an object that "
            "stands on one",
            "m",
        ),
    ] = None
    max_depth_behind_robot_base: Annotated[
        float | None,
        OptionInfo(
            "points further from the camera than the robot's base by more than this, measured horizontally, are "
            "removed; null keeps them",
            "m",
        ),
    ] = 0.0
    object_colours: Annotated[
        tuple[_RgbColour, ...],
        OptionInfo(
            "colours of the object (red, green, blue, 0 to 255); points of other colours are removed, if the clouds "
            "have colours; empty: all colours"
        ),
    ] = ()

    def __post_init__(self) -> None:
        check_option_bounds(self, "filter options")


class ReachableObjectRegion:
    """The region that the object's branches can reach above the floor. With `anywhere`, only the options limit it."""

    def __init__(
        self,
        system: System,
        options: CloudFilterOptions,
        values: Mapping[str, float] | None = None,
        *,
        anywhere: bool = False,
    ) -> None:
        tree, sizes = system.mechanism_with_values(values), model_link_lengths_and_radius_by_segment(system, values)
        reach = {"": 0.0}
        for segment in system.segment_layouts:
            reach[segment.name] = float(sizes[segment.name][0].sum()) + reach[segment.parent_segment or ""]
        radius = max(own for _, own in sizes.values())
        first = next(s for s in system.segment_layouts if s.parent_segment is None)
        self._radius = np.inf if anywhere else max(reach.values()) + radius + _REACH_MARGIN
        base = tree.joint_index(first.link_joints[0][0])
        q = ca.SX.sym("q", system.n_coordinates)
        kinematics = forward_kinematics(tree, q)
        self._root = ca.Function("root", [q], [kinematics.joint_origins[base]])
        tips = [kinematics.frame_position(f"w_{name}") for name in sizes if f"w_{name}" in tree.frames]
        low = -np.inf if options.floor_height is None else options.floor_height
        if options.floor_height is None and tree.joints[base].parent_index < 0 and tips and not anywhere:
            rest = np.zeros(system.n_coordinates)
            root = float(self._root(rest)[2])
            if np.array(ca.Function("tips", [q], [ca.horzcat(*tips)])(rest))[2].min() > root:
                low = root + _FLOOR_MARGIN_ABOVE_OBJECT_FOOT
        self._lower = np.full(3, -np.inf) if options.box_lower is None else np.array(options.box_lower, float)
        self._upper = np.full(3, np.inf) if options.box_upper is None else np.array(options.box_upper, float)
        self._lower[2] = max(self._lower[2], low)
        self._behind = options.max_depth_behind_robot_base
        elastic = {entry.joint_name for entry in system.elastic_joints}
        roots = [j for j in tree.joints if j.parent_index < 0 and j.name not in elastic and not anywhere]
        bases = [np.array(ca.DM(joint.placement.translation)).ravel() for joint in roots]
        self._base = np.mean(bases, axis=0) if bases else None

    def membership_mask_function_at(self, q: ArrayLike, camera: ArrayLike) -> Callable[[Array], BoolArray]:
        """Return a function that marks world points (N, 3) in the region at `q`, seen from the position `camera`."""
        centre = np.array(self._root(np.asarray(q, float))).ravel()
        ahead, limit = np.zeros(3), 0.0
        if self._behind is not None and self._base is not None:
            ahead = (self._base - np.asarray(camera, float)) * [1.0, 1.0, 0.0]
            ahead /= float(np.linalg.norm(ahead)) or 1.0
            limit = float(ahead @ self._base) + self._behind

        def contains(points: Array) -> BoolArray:
            inside = np.ones(len(points), bool)
            for axis in range(3):  # column by column, which is faster on large clouds
                inside &= (points[:, axis] >= self._lower[axis]) & (points[:, axis] <= self._upper[axis])
            rest = np.flatnonzero(inside)
            near = _square_distances(points[rest], centre) <= self._radius**2
            inside[rest] = near & (points[rest] @ ahead <= limit)
            return inside

        return contains


def _square_distances(points: Array, place: Array) -> Array:
    away = points - place
    return np.asarray(np.einsum("ij,ij->i", away, away))


def voxel_averages(points: Array, size: float) -> WeightedCloud:
    """Return the mean of the points (N, 3) in each voxel of edge `size` [m], weighted by the number of these points."""
    cell = np.floor((points - points.min(0)) / size).astype(np.int64)
    extent = cell.max(0) + 1
    key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
    _, index, count = np.unique(key, return_inverse=True, return_counts=True)
    total = np.stack([np.bincount(index, points[:, axis]) for axis in range(3)], axis=1)
    return WeightedCloud(total / count[:, None], count.astype(np.float64))


def statistical_inlier_mask(cloud: WeightedCloud, mask: BoolArray | None = None) -> BoolArray:
    """Return a mask (N,) of the points of a cloud that are not statistical outliers. False outside the mask `mask`.

    A point is an inlier if the mean distance d to its nearest neighbours satisfies d <= median(d) + 4 s, where s is
    the median absolute deviation scaled to a standard deviation. Median and s are computed from the whole cloud, with
    weights, so that outliers, each alone in its voxel, have little influence.
    """
    if len(cloud) <= _OUTLIER_NEIGHBOURS:
        return np.zeros(len(cloud), bool)
    tree = cKDTree(cloud.points, compact_nodes=False, balanced_tree=False)

    def apart(index: IntArray) -> Array:
        return np.asarray(tree.query(cloud.points[index], k=_OUTLIER_NEIGHBOURS + 1)[0][:, 1:].mean(axis=1))

    some = np.arange(0, len(cloud), max(1, len(cloud) // _SPACING_SAMPLE_POINTS))
    distance = apart(some)
    middle = weighted_median(distance, cloud.point_weights[some])
    spread = MAD_TO_STD * weighted_median(np.abs(distance - middle), cloud.point_weights[some])
    index = np.flatnonzero(np.ones(len(cloud), bool) if mask is None else mask)
    stays = np.zeros(len(cloud), bool)
    stays[index] = apart(index) <= middle + _OUTLIER_Z_MAX * spread
    return stays


def wanted_colour_mask(colours: ArrayLike, wanted: ArrayLike) -> BoolArray:
    """Check for each point whether it has one of the wanted colours, (N,).

    `colours` (N, 3) and `wanted` (C, 3) are red, green and blue, 0 to 255 (sRGB). Matching colours are within 0.2 rad
    as directions of linear light, which do not depend on brightness.
    """
    seen, asked = (_light_directions(np.asarray(entry, float) / 255.0) for entry in (colours, wanted))
    return np.asarray((seen @ asked.T).max(axis=1) >= math.cos(_MAX_COLOUR_ANGLE))


def _light_directions(colours: Array) -> Array:
    """Unit directions of linear light; black is treated as grey."""
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    linear = np.maximum(linear, 1e-6)
    return np.asarray(linear / np.linalg.norm(linear, axis=1)[:, None])


def weighted_median(values: Array, weight: Array) -> float:
    """Return the weighted median: the smallest value up to which the weights sum to at least half of the total."""
    return float(np.quantile(values, 0.5, weights=weight, method="inverted_cdf"))


@dataclass(frozen=True, eq=False)
class CloudSkeleton:
    """The skeleton of a cloud: nodes, edges that connect them without cycles, and the node of each point."""

    nodes: Array  # (K, 3), centroids of the kept segments, in order of extraction [m]
    node_of_point: IntArray  # (N,), node to which each point of the cloud belongs, -1 for none
    edges: IntArray  # (E, 2), minimum spanning forest of the nodes' nearest-neighbour graph


def _thin_to_nodes(
    cloud: WeightedCloud, rng: np.random.Generator, neighbour_radius: float
) -> tuple[Array, Array, IntArray]:
    """Thin a cloud to nodes, segment by segment. Returns nodes (K, 3), their weights (K,), and points' nodes (N,)."""
    label, alive = np.full(len(cloud), -1), np.arange(len(cloud))
    points, weight = cloud.points, cloud.point_weights
    nodes, size = list[Array](), list[float]()
    seed = points[int(np.argmin(points[:, 2]))] if len(points) else np.zeros(3)

    while len(alive):
        first = _near(points, seed, neighbour_radius)
        centred = _near(points, np.average(points[first], axis=0, weights=weight[first]), neighbour_radius)
        if not len(centred):  # a ring around its own centre: use the segment itself to continue
            centred = first
        centre = np.average(points[centred], axis=0, weights=weight[centred])
        if len(centred) >= _MIN_SEGMENT_POINTS:
            label[alive[centred]] = len(nodes)
            nodes.append(centre)
            size.append(float(weight[centred].sum()))
        stays = np.ones(len(alive), bool)
        stays[centred] = False
        alive, points, weight = alive[stays], points[stays], weight[stays]
        if len(alive):
            square = _square_distances(points, centre)
            nearest = int(np.argmin(square))
            seed = points[nearest if square[nearest] <= neighbour_radius**2 else rng.integers(len(alive))]
    return np.array(nodes).reshape(-1, 3), np.array(size), label


def _near(points: Array, centre: Array, neighbour_radius: float) -> IntArray:
    """Indices of the points nearest to a centre, within `neighbour_radius`, at most `_MAX_CLOUD_POINTS_PER_NODE`."""
    square, within = _square_distances(points, centre), neighbour_radius**2
    if len(square) > _MAX_CLOUD_POINTS_PER_NODE:
        found = np.argpartition(square, _MAX_CLOUD_POINTS_PER_NODE - 1)[:_MAX_CLOUD_POINTS_PER_NODE]
        return np.asarray(found[square[found] <= within])
    return np.flatnonzero(square <= within)


def _spanning_forest(nodes: Array) -> tuple[IntArray, IntArray]:
    """Edges (E, 2) of the shortest forest that connects near nodes, and the connected part (K,) of each node."""
    count, k = len(nodes), _NODE_NEIGHBOURS + 1
    distance, index = cKDTree(nodes).query(nodes, k=k, distance_upper_bound=MAX_EDGE_LENGTH)
    rows = np.repeat(np.arange(count), k)
    columns, lengths = index.ravel(), distance.ravel()
    good = np.isfinite(lengths) & (columns != rows)
    # a length of zero would be no edge to scipy
    entries = (np.maximum(lengths[good], 1e-9), (rows[good], columns[good]))
    forest = minimum_spanning_tree(coo_matrix(entries, shape=(count, count)).tocsr()).tocoo()
    part = connected_components(forest, directed=False)[1]
    return np.column_stack([forest.row, forest.col]).astype(np.int64), part.astype(np.int64)


def extract_skeleton_graph(cloud: WeightedCloud, rng: np.random.Generator, diameter: float) -> CloudSkeleton:
    """Extract the skeleton of a cloud, which is thinned from its lowest point on. Small connected parts are omitted.

    `diameter` [m] is that of the thickest tube.
    """
    neighbour_radius = max(_MIN_NEIGHBOUR_RADIUS, _NEIGHBOUR_RADIUS_IN_DIAMETERS * diameter)
    nodes, size, label = _thin_to_nodes(cloud, rng, neighbour_radius)
    edges, part = _spanning_forest(nodes)
    held = np.bincount(part, size)
    keep = held[part] >= _MIN_COMPONENT_FRACTION * size.sum()
    renamed = indices_among_kept(np.flatnonzero(keep), len(nodes) + 1)  # the last entry is that of points without node
    return CloudSkeleton(nodes[keep], renamed[label], renamed[edges[keep[edges[:, 0]]]])


def indices_among_kept(kept: IntArray, count: int) -> IntArray:
    """Return the index of each of `count` entries among the entries `kept`, -1 for the others."""
    numbers = np.full(count, -1)
    numbers[kept] = np.arange(len(kept))
    return numbers

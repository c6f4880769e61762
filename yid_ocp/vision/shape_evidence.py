"""Assessment of a shape by a frame's cloud: own points, foreign points, and links without points.

Points away from the tubes' surface form a foreign cluster if they are connected and as many as on a piece of tube as
long as its diameter. Where a cluster touches the shape, points within two tube radii are contested and not used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from yid_ocp.arrays import Array, BoolArray, IntArray
from yid_ocp.vision.frames import OcclusionMap
from yid_ocp.vision.point_cloud import MAD_TO_STD, indices_among_kept, weighted_median
from yid_ocp.vision.shape_guesses import ObservedObjectEnd

_HIDDEN_SIDE_COSINE = -0.5  # cosine of normal and sight beyond which a point cannot be on the side that the camera sees
_MIN_LINK_STATIONS = 6  # fewest stations per link at which coverage is tested
_ON_SURFACE_STDS = 3.0  # distance from the surface within which a point lies on it
_MAX_LINK_SPACINGS = 3.0  # times the usual spacing, within which two points are connected
_MIN_THING_POINTS = 12  # points of a thing
_FOREIGN_SURFACE_FRACTION = 0.5  # foreign fraction of the surface around a point, at which a thing continues there
_MAX_THINGS = 8  # largest number of foreign clusters kept per frame
_FILLED_SLICE_FRACTION = 0.3  # of the usual number of points, at which a slice of a tube counts as covered
_SURROUNDING_RADII = 3.0  # radius around a node in which the width of the surface is measured
_MAX_SHORT_FRACTION = 0.5  # of a tube's length; largest shortening at which its end is still found
_RIM_RADIUS_FRACTION = 0.85  # of the radius to either side, within which a tube's depth is compared


@dataclass(frozen=True, eq=False)
class TubeLinks:
    """The links of a shape as cylinders in the world."""

    link_ends: Array  # (K, 2, 3), start and end of every link's centre line [m]
    radius: Array  # (K,) [m]
    free_end_links: tuple[int, ...]  # links with a free end
    tube_lengths: Array  # (K,), length of the tube of each link [m]


def nearest_link_axis_projections(
    corners: Array, radius: Array, points: Array, share: float = 1.0
) -> tuple[IntArray, Array, Array, Array]:
    """Project points (N, 3) on the axis of the nearest link. Axes have ends `corners` (K, 2, 3), radii are (K,) [m].

    The nearest link has the smallest distance minus `share` times its radius. Returns its index (N,), the position
    along it from 0 to 1 (N,), unit vectors from the axis to the point (N, 3), and distances from the axis (N,) [m].
    """
    start, edge = corners[:, 0], corners[:, 1] - corners[:, 0]
    square = np.einsum("ij,ij->i", edge, edge)
    # (p - a).d and |p - a|^2 for all points and links, by matrix products
    ahead = points @ edge.T - np.einsum("ij,ij->i", start, edge)
    t = np.clip(ahead / square, 0.0, 1.0)
    own = np.einsum("ij,ij->i", points, points)[:, None] + np.einsum("ij,ij->i", start, start)
    apart = own - 2.0 * (points @ start.T) + t * (t * square - 2.0 * ahead)
    link = np.argmin(np.sqrt(np.maximum(apart, 0.0)) - share * radius, axis=1)
    along = t[np.arange(len(points)), link]
    normal = points - start[link] - along[:, None] * edge[link]
    distance = np.sqrt(np.einsum("ij,ij->i", normal, normal))
    return link, along, normal / np.maximum(distance, 1e-9)[:, None], distance


def unit_link_axes(link_ends: Array) -> Array:
    """Return unit vectors (K, 3) along the links with the ends `link_ends` (K, 2, 3)."""
    edge = link_ends[:, 1] - link_ends[:, 0]
    return np.asarray(edge / np.linalg.norm(edge, axis=1)[:, None])


def link_normals_perpendicular_to_sight(link_ends: Array, camera: Array) -> Array:
    """Compute unit vectors (K, 3) perpendicular to links (K, 2, 3) and to the camera's lines of sight."""
    across = np.cross(link_ends[:, 1] - link_ends[:, 0], link_ends.mean(axis=1) - camera)
    return np.asarray(across / np.maximum(np.linalg.norm(across, axis=1), 1e-12)[:, None])


def _faces_away_from_camera(normal: Array, sight: Array) -> BoolArray:
    return np.asarray(np.einsum("ij,ij->i", normal, sight) > -_HIDDEN_SIDE_COSINE * np.linalg.norm(sight, axis=1))


@dataclass(frozen=True, eq=False)
class ForeignCluster:
    """A cluster of points that belong to no tube."""

    centre: Array  # (3,), median of its points in the world [m]
    extent: Array  # (3,), extents along the world's axes [m]
    n_points: int


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapeFitQuality:
    """The quality of a shape's fit to a frame: noise, distances, link coverage, end offsets, foreign clusters."""

    noise_std: float  # standard deviation of the points on the shape from its surface [m]
    mean_distance: float  # mean distance from the surface of nearby points that are not foreign [m]
    # (K,), fractions of each link's length with own points, and visibly without points
    covered_fraction: Array
    visibly_empty_fraction: Array
    # (E,), offset of each free tube's end beyond the fitted shape, NaN if unseen [m]
    end_offsets: Array
    foreign_clusters: tuple[ForeignCluster, ...]  # foreign clusters near the shape, the largest first

    def covered_fraction_of_visible_length(self, lengths: Array) -> float:
        """Return the fraction of the links' visible length on which points were measured; 0 if no link is visible."""
        filled, empty = float(lengths @ self.covered_fraction), float(lengths @ self.visibly_empty_fraction)
        return filled / max(filled + empty, 1e-12)


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapeFitQualityAndPointClasses(ShapeFitQuality):
    """The fit quality of a shape, and the class of each of the frame's points: own, contested or foreign."""

    # (N,), masks of the shape's own points, of points on it that may be foreign, and of foreign points
    is_own: BoolArray
    is_contested: BoolArray
    is_foreign: BoolArray
    excess_variance: Array  # (K,), variance across each link in excess of its tube [m^2]


@dataclass(frozen=True, eq=False)
class ProcessedFrameCloud:
    """The filtered points and skeleton nodes of one frame, with camera position and occlusion map."""

    points: Array  # (N, 3), surface points in the world [m]
    point_weights: Array  # (N,)
    skeleton_nodes: Array  # (K, 3), nodes of the points' skeleton [m]
    camera_position: Array  # (3,) [m]
    occlusion_map: OcclusionMap  # of all measured points
    is_filtered_out: Callable[[Array], BoolArray]  # positions (S, 3) removed by filters
    end_anchors: Sequence[ObservedObjectEnd] = ()  # ends of the object that were seen

    @cached_property
    def _point_tree(self) -> cKDTree:
        return cKDTree(self.points)

    @cached_property
    def _point_spacing(self) -> float:
        return max(float(np.median(self._point_tree.query(self.points, k=2)[0][:, 1])), 1e-4)

    def _is_hidden_or_filtered(self, places: Array, radius: Array, margin: float) -> BoolArray:
        """Mask (S,) of the positions (S, 3) that are hidden from the camera or in a region that the filters remove."""
        return self.occlusion_map.occluded_position_mask(places, radius, margin) | self.is_filtered_out(places)


def fit_quality_and_point_classes(
    tubes: TubeLinks, seen: ProcessedFrameCloud, near: float
) -> ShapeFitQualityAndPointClasses:
    """Classify a frame's points by a fitted shape, and assess the fit by points within `near` [m] of its surface."""
    link, along, normal, distance = nearest_link_axis_projections(tubes.link_ends, tubes.radius, seen.points)
    away = _faces_away_from_camera(normal, seen.points - seen.camera_position)
    size = np.abs(np.where(away, -distance, distance) - tubes.radius[link])
    close = size < near
    tree, spacing = seen._point_tree, seen._point_spacing
    noise = near / _ON_SURFACE_STDS
    if close.any():
        noise = MAD_TO_STD * weighted_median(size[close], seen.point_weights[close])
    # positions are not known better than the spacing of the points
    noise = max(noise, spacing / math.sqrt(12.0))
    gate = min(_ON_SURFACE_STDS * noise, near)
    on_shape = size < gate
    beyond, ends = np.zeros(len(on_shape), bool), np.full(len(tubes.free_end_links), np.nan)
    for i, k in enumerate(tubes.free_end_links):
        ends[i], behind_tip = _end_offset(tubes, k, seen, gate)
        beyond |= behind_tip
    least = 4 * float(tubes.radius.min()) ** 2 / spacing**2
    part = _things(tree, ~on_shape & ~beyond, _MAX_LINK_SPACINGS * spacing, least)
    foreign = part >= 0
    contact = _contacts(tree, seen, on_shape | beyond, foreign, _MAX_LINK_SPACINGS * spacing)
    contested = np.zeros(len(on_shape), bool)
    if contact.any():
        touching = cKDTree(seen.points[contact])
        contested = (on_shape | beyond) & (touching.query(seen.points)[0] < 2 * (tubes.radius[link] + gate))
        for i, k in enumerate(tubes.free_end_links):
            # points at the end are contested, so its position is unknown
            end = tubes.link_ends[k, 1] + ends[i] * unit_link_axes(tubes.link_ends)[k]
            if np.isfinite(ends[i]) and touching.query(end)[0] < 2 * (tubes.radius[k] + gate):
                ends[i] = np.nan
    own = on_shape & ~contested
    filled, empty = _coverage(tubes, seen, own, link, along, gate)
    counted = close & ~foreign
    mean = float(np.average(size[counted], weights=seen.point_weights[counted])) if counted.any() else math.inf
    clusters = [seen.points[part == number] for number in range(min(_MAX_THINGS, int(part.max(initial=-1)) + 1))]
    return ShapeFitQualityAndPointClasses(
        is_own=own,
        is_contested=contested,
        is_foreign=foreign,
        noise_std=noise,
        mean_distance=mean,
        covered_fraction=filled,
        visibly_empty_fraction=empty,
        end_offsets=ends,
        excess_variance=_swath(tubes, seen, counted & ~contested, link, normal * distance[:, None]),
        foreign_clusters=tuple(ForeignCluster(np.median(x, axis=0), np.ptp(x, axis=0), len(x)) for x in clusters),
    )


def tube_like_node_and_point_masks(cloud: ProcessedFrameCloud, radius: float) -> tuple[BoolArray, BoolArray]:
    """Find skeleton nodes (K,) and points (N,) where the cloud is as narrow as a tube of radius r = `radius`.

    Around a tube, points have a large spread in one direction and r/sqrt(3) across; on a wall or body in two.
    """
    within = _SURROUNDING_RADII * radius
    thin = np.zeros(len(cloud.skeleton_nodes), bool)
    for i, around in enumerate(cloud._point_tree.query_ball_point(cloud.skeleton_nodes, within)):
        if len(around) > 3:
            away = cloud.points[around] - cloud.points[around].mean(axis=0)
            second = float(np.linalg.eigvalsh(away.T @ away / len(around))[1])
            # halfway between a tube, r/sqrt(3), and a disc, within/2
            thin[i] = math.sqrt(max(second, 0.0)) < 0.5 * (radius / math.sqrt(3.0) + 0.5 * within)
    return thin, thin[cKDTree(cloud.skeleton_nodes).query(cloud.points)[1]]


def _things(tree: cKDTree, chosen: BoolArray, within: float, least: float) -> IntArray:
    """Index (N,) of the large connected part of each chosen point, 0 for the largest part; -1 for all other points."""
    part, index = np.full(len(chosen), -1), np.flatnonzero(chosen)
    pairs = cKDTree(tree.data[index]).query_pairs(within, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(index),) * 2)
    owner = connected_components(graph, directed=False)[1]
    count = np.bincount(owner)
    order = np.argsort(-count, kind="stable")
    kept = order[count[order] >= max(least, _MIN_THING_POINTS)]
    part[index] = indices_among_kept(kept, len(count))[owner]
    return part


def _contacts(
    tree: cKDTree, seen: ProcessedFrameCloud, shape: BoolArray, foreign: BoolArray, within: float
) -> BoolArray:
    """Mask of the shape's points that touch foreign points: these are at least half as dense within `within` [m]."""
    contact = np.zeros(len(shape), bool)
    close = cKDTree(seen.points[foreign]).query(seen.points[shape], distance_upper_bound=within)[0]
    for i in np.flatnonzero(shape)[np.isfinite(close)]:
        around = np.asarray(tree.query_ball_point(seen.points[i], within), dtype=np.int64)
        theirs = float(seen.point_weights[around[foreign[around]]].sum())
        contact[i] = theirs >= _FOREIGN_SURFACE_FRACTION * float(seen.point_weights[around[shape[around]]].sum())
    return contact


def _coverage(
    tubes: TubeLinks, seen: ProcessedFrameCloud, own: BoolArray, link: IntArray, along: Array, gate: float
) -> tuple[Array, Array]:
    """Fractions (K,) of each link's length that have own points, and that are visible without own points."""
    lengths = np.linalg.norm(tubes.link_ends[:, 1] - tubes.link_ends[:, 0], axis=1)
    count = np.maximum(_MIN_LINK_STATIONS, np.ceil(lengths / (2 * tubes.radius))).astype(np.int64)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    station = first[link] + np.minimum((along * count[link]).astype(np.int64), count[link] - 1)
    filled = np.bincount(station[own], minlength=int(count.sum())) > 0
    owner, bare = np.repeat(np.arange(len(count)), count), np.flatnonzero(~filled)
    on = owner[bare]
    share = (bare - first[on] + 0.5) / count[on]
    places = tubes.link_ends[on, 0] + share[:, None] * (tubes.link_ends[on, 1] - tubes.link_ends[on, 0])
    empty = np.zeros(len(filled), bool)
    empty[bare] = ~seen._is_hidden_or_filtered(places, tubes.radius[on], gate)
    return np.bincount(owner, filled) / count, np.bincount(owner, empty) / count


def _swath(tubes: TubeLinks, seen: ProcessedFrameCloud, counted: BoolArray, link: IntArray, offset: Array) -> Array:
    """Variance (K,) [m^2] of points across each link, in the camera's view, in excess of a tube of its radius."""
    across, count = link_normals_perpendicular_to_sight(tubes.link_ends, seen.camera_position), len(tubes.link_ends)
    square = np.einsum("ij,ij->i", offset, across[link]) ** 2
    weight = np.bincount(link[counted], seen.point_weights[counted], minlength=count)
    total = np.bincount(link[counted], (seen.point_weights * square)[counted], minlength=count)
    # the picture of a tube is evenly filled from one side to the other
    return np.maximum(total / np.maximum(weight, 1e-12) - tubes.radius**2 / 3, 0.0)


def _end_offset(tubes: TubeLinks, link: int, seen: ProcessedFrameCloud, gate: float) -> tuple[float, BoolArray]:
    """Offset [m] of a tube's last point beyond its tip (NaN if unseen), and the mask of the points between them."""
    (start, tip), radius, axis = tubes.link_ends[link], float(tubes.radius[link]), unit_link_axes(tubes.link_ends)[link]
    thick = max(radius, 2 * seen._point_spacing)
    behind = max(3, int(float(np.linalg.norm(tip - start)) / thick))
    edges = thick * np.arange(-behind, max(3, int(_MAX_SHORT_FRACTION * tubes.tube_lengths[link] / thick)) + 1.0)
    away = seen.points - tip
    along = away @ axis
    about = np.einsum("ij,ij->i", away, away) - along**2 < (radius + gate) ** 2
    mine = about & (along > edges[0]) & (along <= edges[-1])
    count, _ = np.histogram(along[mine], edges, weights=seen.point_weights[mine])
    nothing = math.nan, np.zeros(len(along), bool)
    if not (count[edges[1:] <= 0] > 0).any():
        return nothing
    filled = count > _FILLED_SLICE_FRACTION * float(np.median(count[count > 0]))
    middles = tip + 0.5 * (edges[1:] + edges[:-1])[:, None] * axis
    hidden = seen._is_hidden_or_filtered(middles, np.full(len(middles), radius), gate) & ~filled
    score = np.concatenate([[0.0], np.cumsum(np.where(hidden, 0.0, np.where(filled, 0.5, -0.5)))])
    last = int(np.argmax(score))
    if last == 0 or last == len(count) or hidden[last]:
        return nothing
    inside = along[mine & (along > edges[last - 1]) & (along <= edges[last])]
    end = float(inside.max()) if len(inside) else float(edges[last])
    return end, about & (along > 0.0) & (along <= end)


class _SurfaceResiduals(NamedTuple):
    """Signed distances [m] of points from the tubes' surface, with derivatives by the link's ends and radius."""

    point_indices: IntArray
    link_indices: IntArray
    signed_distance: Array
    jacobian_by_link_ends: Array
    derivative_by_radius: Array


def nearest_surface_residuals(
    corners: Array, radius: Array, points: Array, camera: Array, share: float = 1.0
) -> _SurfaceResiduals:
    """Return distances of points p (N, 3) from tube surfaces: e = |p - c| - f r, with the nearest axis point c.

    f = `share` scales the radius r. Axis ends `corners` are (K, 2, 3), radii (K,), `camera` (3,) [m]. A point on the
    far side of a tube, which the camera cannot see, is compared with the near side: e = -|p - c| - f r.
    """
    link, along, normal, distance = nearest_link_axis_projections(corners, radius, points, share)
    sign = np.where(_faces_away_from_camera(normal, points - camera), -1.0, 1.0)
    error = sign * distance - share * radius[link]
    # e falls as the centre line moves along the normal: de = -n'((1 - t) da + t db)
    direction = -sign[:, None] * normal
    rows = np.concatenate([direction * (1 - along)[:, None], direction * along[:, None]], axis=1)
    return _SurfaceResiduals(np.arange(len(points)), link, error, rows, np.full(len(points), -share))


def surface_residuals_along_sight(corners: Array, radius: Array, points: Array, camera: Array) -> _SurfaceResiduals:
    """Return the distances of points from the tubes along the line of sight. Arguments: `nearest_surface_residuals`.

    At a distance u from the axis across the line of sight, the surface of a tube of radius r is sqrt(r^2 - u^2) nearer
    to the camera than the axis. Errors along the surface normal would give the same tube position, but a radius too
    small by several times noise^2/r. Points near the rim, where depth is not informative, are omitted.
    """
    link, along, normal, distance = nearest_link_axis_projections(corners, radius, points)
    axis = unit_link_axes(corners)[link]
    sight = camera - points
    front = sight - np.einsum("ij,ij->i", sight, axis)[:, None] * axis
    front /= np.maximum(np.linalg.norm(front, axis=1), 1e-12)[:, None]
    side = np.cross(axis, front)
    offset = normal * distance[:, None]
    across = np.einsum("ij,ij->i", offset, side)
    index = np.flatnonzero((np.abs(across) < _RIM_RADIUS_FRACTION * radius[link]) & (along > 0) & (along < 1))
    link, along, front, side, across = link[index], along[index], front[index], side[index], across[index]
    deep = np.sqrt(radius[link] ** 2 - across**2)
    error = np.einsum("ij,ij->i", offset[index], front) - deep
    direction = -front - (across / deep)[:, None] * side
    rows = np.concatenate([direction * (1 - along)[:, None], direction * along[:, None]], axis=1)
    return _SurfaceResiduals(index, link, error, rows, -radius[link] / deep)


@dataclass(frozen=True, eq=False)
class QuadraticTubeDimensionCost:
    """The cost g'x + x'Sx/2 of tube dimensions x in one frame, minimised over the joint angles.

    x (2 s,) holds the logarithms of the lengths of all s segments, then of all radii, relative to the fit's dimensions.
    g is the gradient and S the Hessian.
    """

    gradient: Array  # (2 s,)
    hessian: Array  # (2 s, 2 s)
    point_jacobian: Array  # (np, 3, 2 s), derivatives of the system's points by x [m]


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameShapeFit(ShapeFitQuality):
    """The fitted shape of one frame, with the uncertainty of its points and the quality of the fit."""

    q: Array  # (n,), configuration with zero twists
    point_positions: Array  # (np, 3), positions of the system's points [m]
    point_std: Array  # (np, 3), standard deviation of each coordinate [m]
    is_point_seen: BoolArray  # (np,), whether a gripper holds the point or a link beside it has enough own points
    grasp_gaps: Array  # (grasps, 3), vector between the held frame and the gripper of each grasp [m]
    dimension_equations: QuadraticTubeDimensionCost  # cost of lengths and radii in this frame
    link_ends: Array  # (K, 2, 3), start and end of every link [m]

    @property
    def visible_length_coverage(self) -> float:
        """The fraction of the shape's visible length that has points."""
        lengths = np.linalg.norm(self.link_ends[:, 1] - self.link_ends[:, 0], axis=1)
        return self.covered_fraction_of_visible_length(lengths)

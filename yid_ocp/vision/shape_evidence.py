"""Assessment of a shape by a frame's cloud: own points, foreign points, and links without points.

Points within three standard deviations of the tubes' surface lie on the shape. Of the others, those that hang together
and are as many as a piece of tube as long as it is wide would have are a thing. Where a thing's surface goes on from
the shape's, nobody can tell whose the points are: within two tubes' reach of there they are contested and say nothing.
A station of a tube that no own point lies on is hidden, or it is empty although the camera sees it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from yid_ocp.vision.frames import OcclusionMap
from yid_ocp.vision.initial_shapes import EndAnchor
from yid_ocp.vision.point_cloud import weighted_median

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]
_FilteredOutTest = Callable[[Array], Mask]

_AWAY = -0.5  # cosine of normal and sight beyond which a point cannot be on the side that the camera sees
_STATIONS = 6  # per link at least, where it is asked whether points are near
_SIGMAS = 3.0  # from the surface, within which a point lies on it
_TO_SIGMA = 1.4826  # from the median absolute deviation of a normal distribution to its standard deviation
_LINKED = 3.0  # times the usual distance of neighbours, within which two points hang together
_FEWEST = 12  # points of a thing
_MATCH = 0.5  # of a piece of surface about a point that must be foreign for it to go on there
_MOST_THINGS = 8  # of a frame, that are remembered
_FILLED = 0.3  # of the usual number of points, with which a slice of a tube counts as filled
_SURROUNDINGS = 3.0  # radii about a node, in which it is asked how wide the surface is there
_AHEAD = 0.5  # of its length, by which a tube may be too short and its end still be found


@dataclass(frozen=True, eq=False)
class TubeLinks:
    """Links of a shape as cylinders in the world."""

    link_ends: Array  # (K, 2, 3), start and end of every link's centre line [m]
    radius: Array  # (K,) [m]
    free_end_links: tuple[int, ...]  # links whose end nothing holds and nothing grows on
    tube_lengths: Array  # (K,), length of the whole tube that a link belongs to [m]

    @property
    def link_lengths(self) -> Array:
        """Length of each link, shape (K,) [m]."""
        return np.asarray(np.linalg.norm(self.link_ends[:, 1] - self.link_ends[:, 0], axis=1))


def nearest_on_tubes(
    corners: Array, radius: Array, points: Array, share: float = 1.0
) -> tuple[Integers, Array, Array, Array]:
    """Nearest place on tubes for each point.

    Parameters
    ----------
    corners : ndarray, shape (K, 2, 3)
        Start and end of every link [m].
    radius : ndarray, shape (K,) [m]
    points : ndarray, shape (N, 3) [m]
    share : float
        Of the radius, at which points lie from the centre line.

    Returns
    -------
    link : ndarray of int, shape (N,)
    along : ndarray, shape (N,)
        From the link's start, 0, to its end, 1.
    normal : ndarray, shape (N, 3)
        Unit vector from the centre line to the point.
    distance : ndarray, shape (N,)
        From the centre line [m].
    """
    start, edge = corners[:, 0], corners[:, 1] - corners[:, 0]
    square = np.einsum("ij,ij->i", edge, edge)
    # (p - a).d and |p - a|^2 for all points and links at once, by products of matrices
    ahead = points @ edge.T - np.einsum("ij,ij->i", start, edge)
    t = np.clip(ahead / square, 0.0, 1.0)
    own = np.einsum("ij,ij->i", points, points)[:, None] + np.einsum("ij,ij->i", start, start)
    apart = own - 2.0 * (points @ start.T) + t * (t * square - 2.0 * ahead)
    link = np.argmin(np.sqrt(np.maximum(apart, 0.0)) - share * radius, axis=1)
    along = t[np.arange(len(points)), link]
    normal = points - start[link] - along[:, None] * edge[link]
    distance = np.sqrt(np.einsum("ij,ij->i", normal, normal))
    return link, along, normal / np.maximum(distance, 1e-9)[:, None], distance


def _faces_away_from_camera(normal: Array, sight: Array) -> Mask:
    """Whether surface normals (N, 3) face away from the camera, by lines of sight (N, 3)."""
    return np.asarray(np.einsum("ij,ij->i", normal, sight) > -_AWAY * np.linalg.norm(sight, axis=1))


@dataclass(frozen=True, eq=False)
class ForeignCluster:
    """Cluster of points that belong to no tube."""

    centre: Array  # (3,), median of its points in the world [m]
    extent: Array  # (3,), extents along the world's axes [m]
    n_points: int


@dataclass(frozen=True, eq=False)
class ShapeEvidence:
    """Classification of a frame's points by a shape, and how much of the shape they cover."""

    # (N,), points on the shape that are surely its own; points there that may be a thing's; points of things
    is_own: Mask
    is_contested: Mask
    is_foreign: Mask
    noise_std: float  # standard deviation of their distances from the surface [m]
    mean_distance: float  # mean distance from the surface of points near it that are no thing's [m]
    # (K,), share of each link's length on which there are own points, and on which the camera sees that there are
    # none
    covered_fraction: Array
    visibly_empty_fraction: Array
    # (E,), by how much each free tube's end lies further along than the shape has it, NaN where that cannot be seen
    # [m]
    end_offsets: Array
    excess_variance: Array  # (K,), variance across each link beyond that of its tube [m^2]
    foreign_clusters: tuple[ForeignCluster, ...]  # the largest first

    @property
    def visible_coverage(self) -> Array:
        """Share of each link's visible length that has own points, shape (K,); 0 where nothing of it is visible."""
        visible = self.covered_fraction + self.visibly_empty_fraction
        return np.asarray(self.covered_fraction / np.maximum(visible, 1e-12))


@dataclass(frozen=True, eq=False)
class CloudObservation:
    """Processed points of one frame with the camera and occlusion that they were seen with."""

    points: Array  # (N, 3), surface points in the world [m]
    point_weights: Array  # (N,)
    skeleton_nodes: Array  # (K, 3), of their skeleton [m]
    camera_position: Array  # (3,) [m]
    occlusion_map: OcclusionMap | None = None  # everything that the camera saw; without it no place counts as hidden
    is_filtered_out: _FilteredOutTest | None = None  # which places, shape (S, 3), lie where filters leave no points
    end_anchors: Sequence[EndAnchor] = ()  # ends of the object that were seen

    @cached_property
    def point_tree(self) -> cKDTree:
        """Search tree of the points."""
        return cKDTree(self.points)

    @cached_property
    def point_spacing(self) -> float:
        """Usual distance of a point from its nearest neighbour [m]."""
        if len(self.points) < 2:
            return math.inf
        return max(float(np.median(self.point_tree.query(self.points, k=2)[0][:, 1])), 1e-4)

    def is_hidden(self, places: Array, radius: Array, margin: float) -> Mask:
        """Whether places are hidden from the camera or removed by filters, shape (S,)."""
        hidden = np.zeros(len(places), bool)
        if self.occlusion_map is not None:
            hidden |= self.occlusion_map.is_hidden(places, radius, margin)
        if self.is_filtered_out is not None:
            hidden |= self.is_filtered_out(places)
        return hidden


def assess_shape(tubes: TubeLinks, seen: CloudObservation, near: float) -> ShapeEvidence:
    """Assess a shape by a frame's points.

    Parameters
    ----------
    near : float
        Distance from the surface beyond which a point says nothing of the shape [m].
    """
    link, along, normal, distance = nearest_on_tubes(tubes.link_ends, tubes.radius, seen.points)
    away = _faces_away_from_camera(normal, seen.points - seen.camera_position)
    error = np.where(away, -distance, distance) - tubes.radius[link]
    size = np.abs(error)
    close = size < near
    tree, spacing = seen.point_tree, seen.point_spacing
    noise = _TO_SIGMA * weighted_median(size[close], seen.point_weights[close]) if close.any() else near / _SIGMAS
    # where points lie in between others is not known better than from one to the next
    noise = max(noise, spacing / math.sqrt(12.0))
    gate = min(_SIGMAS * noise, near)
    on_shape = size < gate
    slices = [_Slices.of(tubes, k, spacing) for k in tubes.free_end_links]
    beyond = np.zeros(len(on_shape), bool)
    ends = np.full(len(slices), np.nan)
    for i, cut in enumerate(slices):
        ends[i] = cut.end(seen, gate)
        if ends[i] > 0:
            beyond |= cut.within(seen.points, gate, 0.0, ends[i])
    part = _parts(tree, ~on_shape & ~beyond, _LINKED * spacing)
    part = _large(part, 4 * float(tubes.radius.min()) ** 2 / spacing**2)
    foreign = part >= 0
    contact = _contacts(tree, seen, on_shape | beyond, foreign, _LINKED * spacing)
    widest = 2 * (tubes.radius[link] + gate)
    contested = np.zeros(len(on_shape), bool)
    if contact.any():
        touching = cKDTree(seen.points[contact])
        contested = (on_shape | beyond) & (touching.query(seen.points)[0] < widest)
        for i, cut in enumerate(slices):
            # whose the points at the end are is not known, so neither is where it is
            if np.isfinite(ends[i]) and touching.query(cut.place(ends[i]))[0] < 2 * (cut.radius + gate):
                ends[i] = np.nan
    own = on_shape & ~contested
    filled, empty = _coverage(tubes, seen, own, link, along, gate)
    counted = close & ~foreign
    mean = float(np.average(size[counted], weights=seen.point_weights[counted])) if counted.any() else math.inf
    swath, things = _swath(tubes, seen, counted & ~contested, link, normal * distance[:, None]), _things(part, seen)
    return ShapeEvidence(own, contested, foreign, noise, mean, filled, empty, ends, swath, things)


def tube_like_nodes_and_points(sight: CloudObservation, radius: float) -> tuple[Mask, Mask]:
    """Whether nodes and points lie where the surface is as narrow as a tube.

    About a tube points spread by its length in one direction and by r/sqrt(3) across; on a table, a wall or a body they
    spread as far in two.

    Parameters
    ----------
    radius : float
        Of the thickest tube [m].

    Returns
    -------
    nodes : ndarray of bool, shape (K,)
    points : ndarray of bool, shape (N,)
        Those whose nearest node is among them.
    """
    within = _SURROUNDINGS * radius
    thin = np.zeros(len(sight.skeleton_nodes), bool)
    for i, around in enumerate(sight.point_tree.query_ball_point(sight.skeleton_nodes, within)):
        if len(around) > 3:
            away = sight.points[around] - sight.points[around].mean(axis=0)
            second = float(np.linalg.eigvalsh(away.T @ away / len(around))[1])
            # halfway between a tube, r/sqrt(3), and a disc, within/2
            thin[i] = math.sqrt(max(second, 0.0)) < 0.5 * (radius / math.sqrt(3.0) + 0.5 * within)
    return thin, thin[cKDTree(sight.skeleton_nodes).query(sight.points)[1]]


def _parts(tree: cKDTree, chosen: Mask, within: float) -> Integers:
    """Connected parts of some of the points, -1 for the others."""
    part = np.full(len(chosen), -1)
    index = np.flatnonzero(chosen)
    if not len(index):
        return part
    pairs = cKDTree(tree.data[index]).query_pairs(within, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(index),) * 2)
    part[index] = connected_components(graph, directed=False)[1]
    return part


def _large(part: Integers, least: float) -> Integers:
    """Parts with so many points, numbered by their size, the largest first; -1 for the others."""
    if (part < 0).all():
        return part
    count = np.bincount(part[part >= 0])
    order = np.argsort(-count, kind="stable")
    number = np.full(len(count), -1)
    kept = order[count[order] >= max(least, _FEWEST)]
    number[kept] = np.arange(len(kept))
    return np.where(part >= 0, number[np.maximum(part, 0)], -1)


def _contacts(tree: cKDTree, seen: CloudObservation, shape: Mask, foreign: Mask, within: float) -> Mask:
    """Points of the shape from which a thing's surface goes on, nearly as dense as the shape's."""
    contact = np.zeros(len(shape), bool)
    if not foreign.any():
        return contact
    close = cKDTree(seen.points[foreign]).query(seen.points[shape], distance_upper_bound=within)[0]
    for i in np.flatnonzero(shape)[np.isfinite(close)]:
        around = np.asarray(tree.query_ball_point(seen.points[i], within), dtype=np.int64)
        theirs = float(seen.point_weights[around[foreign[around]]].sum())
        contact[i] = theirs >= _MATCH * float(seen.point_weights[around[shape[around]]].sum())
    return contact


def _coverage(
    tubes: TubeLinks, seen: CloudObservation, own: Mask, link: Integers, along: Array, gate: float
) -> tuple[Array, Array]:
    """Shares of each link that have own points, and that visibly have none."""
    lengths = tubes.link_lengths
    count = np.maximum(_STATIONS, np.ceil(lengths / (2 * tubes.radius))).astype(np.int64)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    station = first[link] + np.minimum((along * count[link]).astype(np.int64), count[link] - 1)
    filled = np.bincount(station[own], minlength=int(count.sum())) > 0
    owner = np.repeat(np.arange(len(count)), count)
    bare = np.flatnonzero(~filled)
    share = (bare - first[owner[bare]] + 0.5) / count[owner[bare]]
    places = tubes.link_ends[owner[bare], 0] + share[:, None] * (
        tubes.link_ends[owner[bare], 1] - tubes.link_ends[owner[bare], 0]
    )
    empty = np.zeros(len(filled), bool)
    empty[bare] = ~seen.is_hidden(places, tubes.radius[owner[bare]], gate)
    return np.bincount(owner, filled) / count, np.bincount(owner, empty) / count


def _swath(tubes: TubeLinks, seen: CloudObservation, counted: Mask, link: Integers, offset: Array) -> Array:
    """Variance of points across each link, seen from the camera, beyond that of a tube of its radius."""
    edge = tubes.link_ends[:, 1] - tubes.link_ends[:, 0]
    across = np.cross(edge, tubes.link_ends.mean(axis=1) - seen.camera_position)
    across /= np.maximum(np.linalg.norm(across, axis=1), 1e-12)[:, None]
    square = np.einsum("ij,ij->i", offset, across[link]) ** 2
    weight = np.bincount(link[counted], seen.point_weights[counted], minlength=len(edge))
    total = np.bincount(link[counted], (seen.point_weights * square)[counted], minlength=len(edge))
    # the picture of a tube is evenly filled from one side to the other
    return np.maximum(total / np.maximum(weight, 1e-12) - tubes.radius**2 / 3, 0.0)


def _things(part: Integers, seen: CloudObservation) -> tuple[ForeignCluster, ...]:
    found = []
    for number in range(min(_MOST_THINGS, int(part.max(initial=-1)) + 1)):
        mine = part == number
        points = seen.points[mine]
        found.append(ForeignCluster(np.median(points, axis=0), np.ptp(points, axis=0), int(mine.sum())))
    return tuple(found)


@dataclass(frozen=True, eq=False)
class _Slices:
    """A free tube's last link and where it would go on, cut across."""

    tip: Array
    axis: Array
    radius: float
    edges: Array

    @staticmethod
    def of(tubes: TubeLinks, link: int, spacing: float) -> _Slices:
        start, tip = tubes.link_ends[link]
        length = float(np.linalg.norm(tip - start))
        thick = max(float(tubes.radius[link]), 2 * spacing)
        behind, ahead = max(3, int(length / thick)), max(3, int(_AHEAD * tubes.tube_lengths[link] / thick))
        return _Slices(tip, (tip - start) / length, float(tubes.radius[link]), thick * np.arange(-behind, ahead + 1.0))

    def place(self, along: float) -> Array:
        return np.asarray(self.tip + along * self.axis)

    def within(self, points: Array, gate: float, low: float, high: float) -> Mask:
        """Points about the axis, between two places along it from the tip."""
        away = points - self.tip
        along = away @ self.axis
        across = np.einsum("ij,ij->i", away, away) - along**2
        return np.asarray((along > low) & (along <= high) & (across < (self.radius + gate) ** 2))

    def end(self, seen: CloudObservation, gate: float) -> float:
        """Where the points end along the axis, from the tip [m]; NaN where that cannot be seen."""
        edges = self.edges
        mine = self.within(seen.points, gate, edges[0], edges[-1])
        along = (seen.points[mine] - self.tip) @ self.axis
        count, _ = np.histogram(along, edges, weights=seen.point_weights[mine])
        behind = count[edges[1:] <= 0]
        usual = float(np.median(count[count > 0])) if (behind > 0).any() else 0.0
        if not usual:
            return math.nan
        filled = count > _FILLED * usual
        middles = self.tip + 0.5 * (edges[1:] + edges[:-1])[:, None] * self.axis
        hidden = seen.is_hidden(middles, np.full(len(middles), self.radius), gate) & ~filled
        score = np.concatenate([[0.0], np.cumsum(np.where(hidden, 0.0, np.where(filled, 0.5, -0.5)))])
        last = int(np.argmax(score))
        if last == 0 or last == len(count) or hidden[last]:
            return math.nan
        inside = along[(along > edges[last - 1]) & (along <= edges[last])]
        return float(inside.max()) if len(inside) else float(edges[last])


_RIM = 0.85  # of the radius to either side, within which a tube's depth is compared


@dataclass(frozen=True, eq=False)
class _SurfaceResiduals:
    """Signed distances of points from the tubes' surface, with derivatives."""

    point_indices: Integers
    link_indices: Integers
    signed_distance: Array
    jacobian_by_link_ends: Array
    derivative_by_radius: Array


def nearest_surface_residuals(
    corners: Array, radius: Array, points: Array, camera: Array, share: float = 1.0
) -> _SurfaceResiduals:
    """Residuals along the nearest way to the surface,  e = |p - c| - f r.

    Parameters
    ----------
    corners : ndarray, shape (K, 2, 3) [m]
    radius : ndarray, shape (K,) [m]
    points : ndarray, shape (N, 3) [m]
    camera : ndarray, shape (3,)
        [m]; a point that only the far side of a tube is near to counts from the near side.
    share : float
        f, of the radius, at which points lie.
    """
    link, along, normal, distance = nearest_on_tubes(corners, radius, points, share)
    sign = np.where(_faces_away_from_camera(normal, points - camera), -1.0, 1.0)
    error = sign * distance - share * radius[link]
    # e falls as the centre line moves along the normal: de = -n'((1 - t) da + t db)
    direction = -sign[:, None] * normal
    rows = np.concatenate([direction * (1 - along)[:, None], direction * along[:, None]], axis=1)
    return _SurfaceResiduals(np.arange(len(points)), link, error, rows, np.full(len(points), -share))


def line_of_sight_residuals(corners: Array, radius: Array, points: Array, camera: Array) -> _SurfaceResiduals:
    """Residuals along the lines of sight, where the camera's noise is; parameters as of `nearest_surface_residuals`.

    Across the sight a point stands where its pixel does, by u from the axis; towards the camera the surface lies at
    sqrt(r^2 - u^2). The nearest way turns with the noise, which does little to where a tube is found, but makes it
    appear thinner by several times noise^2/r. Points near the rim, where depth says little, are not compared.
    """
    link, along, normal, distance = nearest_on_tubes(corners, radius, points)
    edge = corners[:, 1] - corners[:, 0]
    axis = (edge / np.linalg.norm(edge, axis=1)[:, None])[link]
    sight = camera - points
    front = sight - np.einsum("ij,ij->i", sight, axis)[:, None] * axis
    front /= np.maximum(np.linalg.norm(front, axis=1), 1e-12)[:, None]
    side = np.cross(axis, front)
    offset = normal * distance[:, None]
    across = np.einsum("ij,ij->i", offset, side)
    index = np.flatnonzero((np.abs(across) < _RIM * radius[link]) & (along > 0) & (along < 1))
    link, along, front, side, across = link[index], along[index], front[index], side[index], across[index]
    deep = np.sqrt(radius[link] ** 2 - across**2)
    error = np.einsum("ij,ij->i", offset[index], front) - deep
    direction = -front - (across / deep)[:, None] * side
    rows = np.concatenate([direction * (1 - along)[:, None], direction * along[:, None]], axis=1)
    return _SurfaceResiduals(index, link, error, rows, -radius[link] / deep)


@dataclass(frozen=True, eq=False)
class DimensionEquations:
    """Quadratic cost of the tubes' dimensions in one frame, minimised over the bends.

    The sizes are the logarithms of all lengths and then of all radii, segment by segment, relative to the values of the
    fit. About these the least cost is  g'x + x'Sx/2.
    """

    gradient: Array  # (2 s,)
    hessian: Array  # (2 s, 2 s)
    point_jacobian: Array  # (np, 3, 2 s), how the system's points move with them [m]


@dataclass(frozen=True, eq=False)
class FrameShapeFit:
    """Fitted shape of one frame with its uncertainty and quality."""

    q: Array  # (n,), configuration, twists at rest
    point_positions: Array  # (np, 3), the system's points there [m]
    point_std: Array  # (np, 3), standard deviation of each coordinate by the curvature of the cost [m]
    mean_distance: float  # mean of |e_i| over the points near the shape that belong to no other thing [m]
    noise_std: float  # standard deviation of e_i of the points on the shape [m]
    # (K,), share of each link's length on which there are points, and on which the camera sees that there are none
    covered_fraction: Array
    visibly_empty_fraction: Array
    # (np,), whether there are points enough about each of the system's points, or a gripper that holds it
    is_point_seen: NDArray[np.bool_]
    grasp_gaps: Array  # (grasps, 3), from what each gripper holds to the gripper [m]
    # (E,), by how much each free tube's end lies further along than the shape has it, NaN where that is not seen [m]
    end_offsets: Array
    # share of the points on the shape that may belong to a thing which touches it; they are left out
    contested_fraction: float
    foreign_clusters: tuple[ForeignCluster, ...]  # what else there is
    dimension_equations: DimensionEquations  # what the frame says of lengths and radii
    n_iterations: int
    link_ends: Array  # (K, 2, 3), start and end of every link [m]

    @property
    def visible_coverage(self) -> float:
        """Fraction of the shape's visible length that has points."""
        lengths = np.linalg.norm(self.link_ends[:, 1] - self.link_ends[:, 0], axis=1)
        there, bare = float(lengths @ self.covered_fraction), float(lengths @ self.visibly_empty_fraction)
        return there / max(there + bare, 1e-12)

"""Filters that keep the object's points: pass-through, voxel grid, robot self-filter, statistical outliers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import casadi as ca
import numpy as np
from annotated_types import Ge, Gt, Le
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.system import System
from yid_ocp.options import About, check
from yid_ocp.vision.meshes import Surfaces, numeric_mechanism

Array = NDArray[np.float64]
Triple = tuple[float, float, float]
Mask = NDArray[np.bool_]
Part = Annotated[float, Ge(0), Le(255)]
Colour = tuple[Part, Part, Part]

_USUAL = 3000  # points, at least, that tell how far neighbours usually are
_TO_SIGMA = 1.4826  # from the median absolute deviation of a normal distribution to its standard deviation


@dataclass(frozen=True, eq=False)
class Cloud:
    """Point cloud with weights.

    Attributes
    ----------
    points : ndarray, shape (N, 3)
        In the world [m].
    weight : ndarray, shape (N,)
        How many of the camera's points each one stands for.
    """

    points: Array
    weight: Array

    def __len__(self) -> int:
        return len(self.points)

    def keep(self, mask: NDArray[np.bool_] | NDArray[np.int64]) -> Cloud:
        """The points that a mask or a list of indices selects."""
        return Cloud(self.points[mask], self.weight[mask])


@dataclass(frozen=True)
class FilterOptions:
    """Settings of the filters that select the object's points."""

    voxel: Annotated[float, Gt(0), About("edge of the cubes in which points are averaged", "m")] = 0.008
    padding: Annotated[
        float,
        Gt(0),
        About("points this near to the robot's surface belong to it; about five standard deviations of the depth", "m"),
    ] = 0.03
    lower: Annotated[Triple | None, About("corner of a box in the world outside of which points are left out", "m")] = (
        None
    )
    upper: Annotated[Triple | None, About("the opposite corner", "m")] = None
    floor: Annotated[
        float | None,
        About(
            "points below this height are left out; when absent, those below floor_margin above the foot of an object "
            "that stands on one",
            "m",
        ),
    ] = None
    floor_margin: Annotated[float, About("height above the foot of an object", "m")] = 0.05
    reach_margin: Annotated[
        float,
        Gt(0),
        About("points further from the object's root than its longest branch reaches, plus this, are left out", "m"),
    ] = 0.1
    behind: Annotated[
        float | None,
        About(
            "points that are further from the camera than the robot's base by more than this, seen in the horizontal, "
            "are behind the robot and left out; null to keep them",
            "m",
        ),
    ] = 0.0
    colours: Annotated[
        tuple[Colour, ...],
        About(
            "of the object: red, green and blue, 0 to 255; points of other colours are left out, where the clouds have "
            "colours; all are kept when empty"
        ),
    ] = ()
    colour_angle: Annotated[
        float,
        Gt(0),
        Le(math.pi / 2),
        About(
            "between a point's and the object's colour as directions, by which light and shade change nothing", "rad"
        ),
    ] = 0.2
    neighbours: Annotated[int, Ge(1), About("of every point, whose mean distance tells whether it is alone")] = 12
    outlier_ratio: Annotated[
        float,
        Gt(0),
        About("a point is an outlier where that distance exceeds the median by so many (robust) standard deviations"),
    ] = 4.0
    least: Annotated[int, Ge(0), About("a frame with fewer points left is of no use")] = 150
    most: Annotated[
        int, Ge(1), About("of more points left, so many are drawn at random, to bound the time that a frame takes")
    ] = 6000

    def __post_init__(self) -> None:
        check(self, "filter options")


@dataclass(frozen=True, eq=False)
class Region:
    """Bounds of the region that the object can reach.

    Attributes
    ----------
    lower, upper : ndarray, shape (3,)
        Box in the world [m].
    centre : ndarray, shape (3,)
        The object's root [m].
    radius : float
        How far it reaches from there [m].
    ahead : ndarray, shape (3,)
        Horizontal direction from the camera to the robot, zero where nothing is behind it.
    limit : float
        Points with  ahead . p > limit  are behind the robot [m].
    """

    lower: Array
    upper: Array
    centre: Array
    radius: float
    ahead: Array
    limit: float

    def contains(self, points: Array) -> Mask:
        """Whether points, shape (N, 3), lie inside, shape (N,)."""
        inside = np.ones(len(points), bool)
        for axis in range(3):  # column by column, which is quicker than whole rows on large clouds
            inside &= (points[:, axis] >= self.lower[axis]) & (points[:, axis] <= self.upper[axis])
        rest = np.flatnonzero(inside)
        inside[rest] = points[rest] @ self.ahead <= self.limit
        rest = np.flatnonzero(inside)
        away = points[rest] - self.centre
        inside[rest] = np.einsum("ij,ij->i", away, away) <= self.radius**2
        return inside


class ObjectRegion:
    """Region that the object can reach, from the length of its branches and the floor.

    Parameters
    ----------
    system : System
    options : FilterOptions
    values : mapping of str to float, optional
        Parameter values; nominal where absent.
    anywhere : bool
        Whether its root may be anywhere; only the box and the floor of the options bound it then.
    """

    def __init__(
        self,
        system: System,
        options: FilterOptions,
        values: Mapping[str, float] | None = None,
        *,
        anywhere: bool = False,
    ) -> None:
        tree = numeric_mechanism(system, values)
        symbols, theta = system.parameters.symbols, system.parameters.vector(values)
        lengths = {
            s.name: float(sum(float(ca.Function("l", [symbols], [length])(theta)) for length in s.lengths))
            for s in system.segments
        }
        radius = max(float(ca.Function("r", [symbols], [s.radius])(theta)) for s in system.segments)
        reach: dict[str, float] = {}
        for segment in system.segments:
            reach[segment.name] = lengths[segment.name] + (reach[segment.parent] if segment.parent else 0.0)
        first = next(s for s in system.segments if s.parent is None)
        self._radius = np.inf if anywhere else max(reach.values()) + radius + options.reach_margin
        base = tree.joint_index(first.links[0][0])
        q = ca.SX.sym("q", system.size)
        kinematics = forward_kinematics(tree, q)
        self._root = ca.Function("root", [q], [kinematics.origins[base]])
        tips = [kinematics.position(f"w_{name}") for name in lengths if f"w_{name}" in tree.frames]
        low = -np.inf if options.floor is None else options.floor
        if options.floor is None and tree.joints[base].parent < 0 and tips and not anywhere:
            rest = np.zeros(system.size)
            root = float(np.array(self._root(rest))[2, 0])
            heights = np.array(ca.Function("tips", [q], [ca.horzcat(*tips)])(rest))[2]
            if heights.min() > root:
                low = root + options.floor_margin
        self._lower = np.full(3, -np.inf) if options.lower is None else np.asarray(options.lower, float)
        self._upper = np.full(3, np.inf) if options.upper is None else np.asarray(options.upper, float)
        self._lower = self._lower.copy()
        self._lower[2] = max(self._lower[2], low)
        self._behind = options.behind
        elastic = {entry.joint for entry in system.elastic}
        roots = [j for j in tree.joints if j.parent < 0 and j.name not in elastic and not anywhere]
        bases = [np.array(ca.DM(joint.placement.translation)).ravel() for joint in roots]
        self._base = np.mean(bases, axis=0) if bases else None

    def at(self, q: ArrayLike, camera: ArrayLike) -> Region:
        """The region with the robot at a configuration, shape (n,), seen from a camera's position, shape (3,) [m]."""
        centre = np.array(self._root(np.asarray(q, float))).ravel()
        ahead, limit = np.zeros(3), 0.0
        if self._behind is not None and self._base is not None:
            ahead = (self._base - np.asarray(camera, float)) * [1.0, 1.0, 0.0]
            length = float(np.linalg.norm(ahead))
            ahead = ahead / length if length > 0 else np.zeros(3)
            limit = float(ahead @ self._base) + self._behind
        return Region(self._lower, self._upper, centre, self._radius, ahead, limit)


def voxel_grid(points: Array, size: float) -> Cloud:
    """Mean of the points in every cube of a grid.

    Parameters
    ----------
    points : ndarray, shape (N, 3)
        [m]
    size : float
        Edge of the cubes [m].

    Returns
    -------
    Cloud
        One point for every cube that is not empty, weighted by how many were in it.
    """
    if not len(points):
        return Cloud(np.empty((0, 3)), np.empty(0))
    cell = np.floor((points - points.min(0)) / size).astype(np.int64)
    extent = cell.max(0) + 1
    key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
    _, index, count = np.unique(key, return_inverse=True, return_counts=True)
    total = np.stack([np.bincount(index, points[:, axis]) for axis in range(3)], axis=1)
    return Cloud(total / count[:, None], count.astype(np.float64))


def without_robot(cloud: Cloud, robot: Surfaces, q: ArrayLike, padding: float) -> Mask:
    """Whether points are further than `padding` [m] from the robot's surface, shape (N,)."""
    return ~robot.within(cloud.points, q, padding)


def without_outliers(cloud: Cloud, neighbours: int, ratio: float, asked: Mask | None = None) -> Mask:
    """Whether points are inliers of statistical outlier removal.

    A point stays where the mean distance d to its nearest neighbours satisfies  d <= median(d) + ratio s,  with s the
    median absolute deviation turned into a standard deviation. Both are weighted, so that wrong points, each alone in
    its voxel, count for little; unlike mean and standard deviation themselves they hardly move with the outliers.

    Parameters
    ----------
    cloud : Cloud
    neighbours : int
        Of every point.
    ratio : float
    asked : ndarray, shape (N,), optional
        Points to judge; all when absent. What is usual is told by points all over the cloud, whichever are asked.

    Returns
    -------
    ndarray, shape (N,)
        True for points that stay; False for those that are not asked.
    """
    if len(cloud) <= neighbours:
        return np.zeros(len(cloud), bool)
    tree = cKDTree(cloud.points, compact_nodes=False, balanced_tree=False)

    def apart(index: NDArray[np.int64]) -> Array:
        return np.asarray(tree.query(cloud.points[index], k=neighbours + 1)[0][:, 1:].mean(axis=1))

    some = np.arange(0, len(cloud), max(1, len(cloud) // _USUAL))
    distance = apart(some)
    middle = weighted_median(distance, cloud.weight[some])
    spread = _TO_SIGMA * weighted_median(np.abs(distance - middle), cloud.weight[some])
    index = np.flatnonzero(np.ones(len(cloud), bool) if asked is None else asked)
    stays = np.zeros(len(cloud), bool)
    stays[index] = apart(index) <= middle + ratio * spread
    return stays


def of_colours(colours: ArrayLike, wanted: ArrayLike, angle: float) -> Mask:
    """Whether points have one of the given colours.

    Parameters
    ----------
    colours : array_like, shape (N, 3)
        Red, green and blue, 0 to 255 (sRGB).
    wanted : array_like, shape (C, 3)
    angle : float
        Largest angle between two colours as directions of linear light, which brightness does not change [rad].

    Returns
    -------
    ndarray, shape (N,)
    """
    seen, asked = (_light(np.asarray(entry, float)) for entry in (colours, wanted))
    return np.asarray((seen @ asked.T).max(axis=1) >= math.cos(angle))


def _light(colours: Array) -> Array:
    """Unit directions of linear light; black, which has none, is grey."""
    share = colours / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    linear = np.maximum(linear, 1e-6)
    return np.asarray(linear / np.linalg.norm(linear, axis=1)[:, None])


def weighted_median(values: Array, weight: Array) -> float:
    """Weighted median of values."""
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])

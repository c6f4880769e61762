"""The estimates that all frames of a sequence share: camera, background, foreign objects and dimensions.

x are the logarithms of tube lengths and radii relative to the model. The minimum over the bends of the cost of frame f
is g_f'x + x'S_f x/2 (`QuadraticTubeDimensionCost`). With a wide prior P, frames refitted at every x, and sums g and S:

    x = -(S + P)^-1 g,    cov x = (S + P)^-1 + (S + P)^-1 (sum_f r_f r_f') (S + P)^-1 + diag(b^2),    r_f = g_f + S_f x

The second term is the scatter between frames. b is the error shared by all frames: end positions shift with the
camera's pose, and depth noise changes a radius by its square over the radius.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import casadi as ca
import numpy as np
from scipy.spatial import cKDTree

from yid_ocp.arrays import Array, BoolArray
from yid_ocp.model.system import System
from yid_ocp.vision.calibration import CameraCalibration
from yid_ocp.vision.point_cloud import MAD_TO_STD
from yid_ocp.vision.shape_evidence import ForeignCluster, FrameShapeFit, TubeLinks, nearest_link_axis_projections
from yid_ocp.vision.surface_meshes import model_link_lengths_and_radius_by_segment

_BACKGROUND_NOISE_STDS = 3.0  # stds of a point within which it belongs to the background
# fraction of the frames in which what stands still must be seen: arm and object hide it from time to time
_MIN_STILL_FRAME_FRACTION = 0.5
_SAME_THING_DISTANCE = 1.0  # of a cluster's size; closer clusters in other frames are the same object
_MAX_STILL_WANDER = 0.3  # of its size; largest motion of the centre of a static object
_MAX_FOLLOWING_WANDER = 0.5  # of its motion in the world, below which an object moves with a link
_MIN_REPORTED_FRAMES = 2  # frames in which a thing is worth a word


@dataclass(frozen=True, eq=False)
class BackgroundPoints:
    """The points of the static scene. Cloud points within `match_distance` of them are removed as background."""

    points: Array = field(default_factory=lambda: np.empty((0, 3)))  # (N, 3), in the world [m]
    match_distance: float = 0.0  # distance at which a point belongs to it [m]

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points)

    def near_background_mask(self, points: Array, beyond: float = 0.0) -> BoolArray:
        """Check which points (N, 3) lie within `match_distance + beyond` [m] of the background, (N,)."""
        return np.asarray(np.isfinite(self._tree.query(points, distance_upper_bound=self.match_distance + beyond)[0]))

    @staticmethod
    def from_point_clouds(
        clouds: Sequence[Array], voxel: float, noise: float, shapes: Sequence[TubeLinks] | None = None, near: float = 0
    ) -> BackgroundPoints:
        """Find the points of the background in clouds [m] in world coordinates.

        The background is all points of an empty scene or, with fitted `shapes`, points that are static in most frames
        and off the shapes. Points are counted in cubes of edge `voxel` and have the standard deviation `noise`. Points
        that were ever nearer than `near` to a tube's surface can belong to the object and are excluded.
        """
        if not clouds or (shapes is not None and not shapes):
            return BackgroundPoints()
        cells = [np.unique(np.floor(cloud / voxel).astype(np.int64), axis=0) for cloud in clouds]
        place, count = np.unique(np.concatenate(cells), axis=0, return_counts=True)
        often = 1.0 if shapes is None else max(2.0, _MIN_STILL_FRAME_FRACTION * len(clouds))
        points: Array = np.asarray((place[count >= often] + 0.5) * voxel)
        for tubes in shapes or ():
            link, _, _, distance = nearest_link_axis_projections(tubes.link_ends, tubes.radius, points)
            points = points[distance > tubes.radius[link] + near]
        return BackgroundPoints(points, _BACKGROUND_NOISE_STDS * noise + 0.5 * math.sqrt(3.0) * voxel)


@dataclass(frozen=True, eq=False)
class ForeignObject:
    """An object seen in several frames that is neither the robot nor the modelled object."""

    centre: Array  # (3,), in the world, in the median frame [m]
    size: Array  # (3,) [m]
    frames: int  # number of frames with this object
    moving: bool
    link: str  # robot link that carries it; empty for none
    text: str  # location and advice


def foreign_clusters_to_objects(
    clusters: Sequence[tuple[float, Sequence[ForeignCluster]]],
    noise: float,
    box: tuple[Array, Array],
    links: Callable[[float], Mapping[str, Array]],
    coloured: bool,
    background: bool = False,
) -> tuple[ForeignObject, ...]:
    """Group clusters of foreign points from several frames into objects. Rarely seen objects are omitted.

    `noise` is a point's standard deviation, `box` the corners (3,) of the region of the object in all frames [m].
    `links` gives the poses (4, 4) of the robot's links at a time. With `background`, static points are removed already.
    """
    groups: list[list[tuple[float, ForeignCluster]]] = []
    for t, thing in ((t, thing) for t, seen in clusters for thing in seen):
        home = min(groups, key=lambda group: _apart(group[-1][1], thing), default=None)
        if home is not None and home[-1][0] < t and _apart(home[-1][1], thing) < 1.0:
            home.append((t, thing))
        else:
            groups.append([(t, thing)])
    groups = [group for group in groups if len(group) >= min(_MIN_REPORTED_FRAMES, len(clusters))]
    groups.sort(key=lambda group: -sum(thing.n_points for _, thing in group))
    found = []
    for group in groups:
        places, extents = np.array([thing.centre for _, thing in group]), [thing.extent for _, thing in group]
        centre, size = np.median(places, axis=0), np.median(extents, axis=0)
        # arm and object hide parts of a static object, so the centre of the visible part moves within it
        still = np.maximum(2 * _BACKGROUND_NOISE_STDS * noise, _MAX_STILL_WANDER * np.max(extents, axis=0))
        moving = bool((np.ptp(places, axis=0) > still).any())
        poses = [links(t) for t, _ in group]
        link = _carrying_link(places, poses) if moving else ""
        low, high = places.min(axis=0) - 0.5 * size, places.max(axis=0) + 0.5 * size
        beside = bool(((low > box[1]) | (high < box[0])).any())
        how = f"moving with {link}" if link else "moving" if moving else "static"
        big, where = (mark.join(f"{x:.2f}" for x in of) for mark, of in ((" x ", size), (", ", centre)))
        text = f"A foreign object of {big} m is at ({where}) m ({how}, in {len(group)} of {len(clusters)} images). "
        text += "To remove its points, "
        boxed = "set track.options.filters.box_lower and box_upper so that it is outside"
        if link:
            text += f"give its shape under model.surfaces_missing_from_urdf with parent_frame: {link}"
        elif moving:
            text += boxed if beside else "take it out of view"
            text += ", or give the object's colour under track.options.filters.object_colours" if coloured else ""
        else:
            text += "" if background else "set track.options.background_estimation: frames, or "
            text += "record the scene without object and robot for track.background_frames_path"
            text += f", or {boxed}" if beside else ""
            text += ". If it is another arm, lock its joints (model.arms.locked_joints)" if poses[0] else ""
        found.append(ForeignObject(centre, size, len(group), moving, link, text))
    return tuple(found)


def _apart(one: ForeignCluster, other: ForeignCluster) -> float:
    """Distance of two clusters, relative to the distance at which they count as the same object."""
    size = max(float(np.linalg.norm(one.extent)), float(np.linalg.norm(other.extent)), 1e-6)
    return float(np.linalg.norm(one.centre - other.centre)) / (_SAME_THING_DISTANCE * size)


def _carrying_link(places: Array, poses: Sequence[Mapping[str, Array]]) -> str:
    """Name of the link relative to which the positions move much less than in the world; empty if there is none."""

    def wandering(own: Array) -> float:
        return MAD_TO_STD * float(np.median(np.linalg.norm(own - np.median(own, axis=0), axis=1)))

    inside = {"": math.inf}
    for name in poses[0]:
        pose = np.array([at[name] for at in poses])
        inside[name] = wandering(np.einsum("fij,fi->fj", pose[:, :3, :3], places - pose[:, :3, 3]))
    best = min(inside, key=lambda name: inside[name])
    return best if inside[best] < _MAX_FOLLOWING_WANDER * wandering(places) else ""


TubeDimensionKind = Literal["length", "radius"]
_DIMENSION_KINDS: tuple[TubeDimensionKind, ...] = ("length", "radius")
_LOG_DIMENSION_PRIOR_STD = (0.2, 0.4)  # standard deviations of the logarithms of lengths and radii
_DOUBTED_STDS = 3.0  # deviation from the model's value beyond which the value is contradicted
_CLEAR_STDS = 2.0  # deviation within which a first estimate finds no contradiction
_MAX_KNOWN_LOG_STD = 0.1  # std of a logarithm above which a dimension is not determined
_MAX_DIMENSION_ITERATIONS, _STEP_TOLERANCE, _MAX_STEP = 8, 0.004, 0.15
_MIN_FRAMES = 3
_OUTLIER_END_STDS = 3.0  # robust standard deviations from the other frames' ends, at which a frame's end is a wrong one


@dataclass(frozen=True, eq=False)
class TubeDimensionEstimates:
    """The tube lengths and radii estimated from frames, compared with the model."""

    names: tuple[str, ...]  # `T1.length` and so on: lengths of all segments, then their radii
    model_values: Array  # (2 s,), the model's values [m]
    log_ratio: Array  # (2 s,), logarithm of the value that fits over the model's
    covariance: Array  # (2 s, 2 s), of `log_ratio`
    estimated_dimension_mask: tuple[bool, ...]  # dimensions that the fit uses in place of the model's
    n_frames: int  # number of frames used; 0 if nothing was estimated

    @property
    def dimension_log_ratio_std(self) -> Array:
        """The standard deviation (2 s,) of the logarithm of each dimension's estimate divided by the model's value."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def determined_dimension_mask(self) -> BoolArray:
        """The mask (2 s,) of the dimensions that the frames determine: lengths, then radii, of s tubes."""
        return np.asarray((self.dimension_log_ratio_std < _MAX_KNOWN_LOG_STD) & (self.n_frames > 0))

    @property
    def contradicted_model_value_mask(self) -> BoolArray:
        """The mask (2 s,) of the model dimensions that the frames contradict: lengths, then radii, of s tubes."""
        off = np.abs(self.log_ratio) > _DOUBTED_STDS * self.dimension_log_ratio_std
        return np.asarray(self.determined_dimension_mask & off)

    @property
    def contradiction_message(self) -> str:
        """A text on model dimensions that contradict the frames and are not estimated. Empty if there are none."""
        values, fitting = 1e3 * self.model_values, 1e3 * self.model_values * np.exp(self.log_ratio)
        wrong = [
            f"{self.names[i]} is {values[i]:.4g} mm in the model, {fitting[i]:.4g} mm by the fit"
            for i in np.flatnonzero(self.contradicted_model_value_mask & ~np.array(self.estimated_dimension_mask))
        ]
        return f"the object's dimensions contradict the model ({'; '.join(wrong)})" if wrong else ""

    @property
    def messages(self) -> tuple[str, ...]:
        """A message for each contradicted or estimated dimension, with the fitting value and its interval."""
        lines = []
        for i, name in enumerate(self.names):
            value = 1e3 * self.model_values[i] * math.exp(self.log_ratio[i])
            two = 2 * value * self.dimension_log_ratio_std[i]
            found = f"{value:.4g} mm (95 %: {value - two:.4g} to {value + two:.4g} mm) fits {self.n_frames} images, "
            found += f"but the model has {1e3 * self.model_values[i]:.4g} mm"
            if self.estimated_dimension_mask[i]:
                lines.append(f"{name} is estimated: {found}")
            elif self.contradicted_model_value_mask[i]:
                remedy = f"set track.options.estimated_dimensions: [{name.rpartition('.')[2]}] to estimate it"
                lines.append(f"{name} seems to be wrong: {found}. Measure it again, or {remedy}")
        return tuple(lines)

    def point_std_from_dimensions(self, points: Array) -> Array:
        """Compute the standard deviations (np, 3) [m] of points due to wrong or uncertain tube dimensions.

        `points` (np, 3, 2 s) are the derivatives of the points by the 2 s dimensions of s segments. An estimated
        dimension adds its standard deviation, a contradicted one that is not estimated its whole displacement.
        """
        used = np.array(self.estimated_dimension_mask)
        wrong = np.where(self.contradicted_model_value_mask & ~used, self.log_ratio, 0.0)
        chosen = points[..., used]
        spread = np.einsum("ijk,kl,ijl->ij", chosen, self.covariance[np.ix_(used, used)], chosen)
        return np.asarray(np.sqrt((points @ wrong) ** 2 + np.maximum(spread, 0.0)))

    def parameters_with_fitted_dimensions(self, system: System, given: Mapping[str, float] | None) -> dict[str, float]:
        """Return the parameter values, with estimated dimensions in place of the model's dimensions."""
        return _changed(system, given, np.where(self.estimated_dimension_mask, self.log_ratio, 0.0))


def estimate_and_check_tube_dimensions(
    system: System,
    given: Mapping[str, float] | None,
    estimate: Sequence[TubeDimensionKind],
    std: tuple[float, float],
    fitted: Callable[[Mapping[str, float], Sequence[Array]], list[FrameShapeFit]],
) -> TubeDimensionEstimates:
    """Estimate the tubes' dimensions from some frames and compare them with the model.

    `std` holds the standard deviations [m] of a point's distance from the surface and of the position error shared by
    all frames. `fitted` returns the frames' fits for given parameter values and the configurations of the last round.
    """
    sizes = model_link_lengths_and_radius_by_segment(system, given).values()
    told = np.array([*(lengths.sum() for lengths, _ in sizes), *(radius for _, radius in sizes)])
    count, many = len(told), len(told) // 2
    names = tuple(f"{s.name}.{kind}" for kind in _DIMENSION_KINDS for s in system.segment_layouts)
    prior = np.diag(np.repeat(1.0 / np.square(_LOG_DIMENSION_PRIOR_STD), many))
    change, starts = np.zeros(count), list[Array]()
    nothing = TubeDimensionEstimates(names, told, change, np.asarray(np.linalg.inv(prior)), (False,) * count, 0)
    wanted = np.array([kind in estimate for kind in _DIMENSION_KINDS for _ in range(many)])
    shared = np.concatenate([math.hypot(*std) / told[:many], std[0] ** 2 / (2 * told[many:] ** 2)])
    for turn in range(_MAX_DIMENSION_ITERATIONS):
        fits = fitted(_changed(system, given, change), starts)
        chosen = _believed(fits)
        if len(chosen) < _MIN_FRAMES:
            return nothing
        starts, frames = [fit.q for fit in fits], len(chosen)
        gradient = np.array([fit.dimension_equations.gradient for fit in chosen])
        curvature = np.array([fit.dimension_equations.hessian for fit in chosen])
        inverse = np.linalg.inv(curvature.sum(axis=0) + prior)
        step = -inverse @ (gradient.sum(axis=0) + prior @ change)
        left = gradient + curvature @ step
        scatter = inverse @ (left.T @ left) @ inverse * frames / (frames - 1)
        covariance = np.asarray(inverse + scatter + np.diag(shared**2))
        change = change + np.clip(step, -_MAX_STEP, _MAX_STEP)
        if turn == 0 and not wanted.any() and (np.abs(change) < _CLEAR_STDS * np.sqrt(np.diag(covariance))).all():
            break  # no contradiction
        if np.abs(step).max() < _STEP_TOLERANCE:
            break
    known = np.sqrt(np.diag(covariance)) < _MAX_KNOWN_LOG_STD
    return TubeDimensionEstimates(names, told, change, covariance, tuple(bool(x) for x in wanted & known), frames)


def _believed(fits: Sequence[FrameShapeFit]) -> list[FrameShapeFit]:
    """Fits whose free ends are where most other fits have them, relative to the fitted shape."""
    if not fits:
        return []
    ends, noise = np.array([fit.end_offsets for fit in fits]), float(np.median([fit.noise_std for fit in fits]))
    keep = np.ones(len(fits), bool)
    for column in ends[:, np.isfinite(ends).any(axis=0)].T:
        off = np.abs(column - np.nanmedian(column))
        keep &= np.isnan(column) | (off < _OUTLIER_END_STDS * max(MAD_TO_STD * float(np.nanmedian(off)), noise))
    return [fit for fit, good in zip(fits, keep, strict=True) if good]


def _changed(system: System, given: Mapping[str, float] | None, change: Array) -> dict[str, float]:
    """Parameter values with dimensions changed by the logarithms (2 s,)."""
    values = dict(zip(system.parameters.names, system.parameters.vector(given).tolist(), strict=True))
    lengths, radii = zip(*((ca.vertcat(*s.link_lengths), s.radius) for s in system.segment_layouts), strict=True)
    for entry, by in zip((*lengths, *radii), change, strict=True):
        for symbol in ca.symvar(entry):
            values[symbol.name()] *= math.exp(float(by))
    return values


@dataclass(frozen=True, eq=False)
class SequenceEstimates:
    """The estimates that all frames of a sequence share: camera calibration, tube dimensions and background."""

    camera_calibration: CameraCalibration  # the camera's pose, its depth error and its clock
    dimensions: TubeDimensionEstimates  # the object's lengths and radii by the frames
    background: BackgroundPoints  # static points in all frames

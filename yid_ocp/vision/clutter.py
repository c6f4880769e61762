"""Clutter around the object: removal of the known background, and a list of other foreign objects.

Known are the robot, meshes fixed to its links or to the world (`ExtraMesh`), and a background: what an empty scene
showed, or what stood still through most frames away from every shape that was fitted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from yid_ocp.errors import ConfigError, ModelError, nearest_name_hint
from yid_ocp.files import is_file
from yid_ocp.model.mechanism import Mechanism
from yid_ocp.model.rotations import homogeneous_transform, rotation_from_rpy
from yid_ocp.vision.shape_evidence import ForeignCluster, TubeLinks
from yid_ocp.vision.shape_evidence import nearest_on_tubes as nearest_place
from yid_ocp.vision.surface_meshes import ExtraMesh, TriangleMesh, load_mesh_file

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SIGMAS = 3.0  # of a point, within which it is the background's
_MOST = 0.5  # of the frames, in which what stands still must be seen: arm and object hide it from time to time
_ALIKE = 1.0  # of a thing's size, within which it is the same thing in another frame
_STILL = 0.3  # of its size, by which a still thing's middle wanders at most
_FOLLOWS = 0.5  # of how far it wanders in the world, below which it moves with a link
_FEWEST = 2  # frames in which a thing is worth a word
_TO_SIGMA = 1.4826


@dataclass(frozen=True, eq=False)
class BackgroundPoints:
    """Background points that do not belong to the object.

    Attributes
    ----------
    points : ndarray, shape (N, 3)
        In the world [m].
    match_distance : float
        Distance at which a point belongs to it [m].
    """

    points: Array = field(default_factory=lambda: np.empty((0, 3)))
    match_distance: float = 0.0

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points)

    def contains(self, points: Array, beyond: float = 0.0) -> Mask:
        """Whether points, shape (N, 3), lie within `within + beyond` [m] of the background, shape (N,)."""
        if not len(self.points) or not len(points):
            return np.zeros(len(points), bool)
        reach = self.match_distance + beyond
        return np.asarray(np.isfinite(self._tree.query(points, distance_upper_bound=reach)[0]))

    @staticmethod
    def from_empty_scene(clouds: Sequence[Array], voxel: float, noise: float) -> BackgroundPoints:
        """Background from clouds of the scene without robot and object, in the world [m]."""
        if not clouds:
            return BackgroundPoints()
        cells = np.unique(np.floor(np.concatenate(clouds) / voxel).astype(np.int64), axis=0)
        return BackgroundPoints(np.asarray((cells + 0.5) * voxel), _SIGMAS * noise + 0.5 * math.sqrt(3.0) * voxel)

    @staticmethod
    def from_static_points(
        clouds: Sequence[Array], shapes: Sequence[TubeLinks], voxel: float, noise: float, near: float
    ) -> BackgroundPoints:
        """Background from points that stay in most frames away from every fitted shape.

        Parameters
        ----------
        clouds : sequence of ndarray, each (N, 3)
            In the world, without the robot [m].
        shapes : sequence of Tubes
            All that were fitted.
        voxel : float
            Edge of the cubes that are counted [m].
        noise : float
            Standard deviation of a point [m].
        near : float
            From the tubes' surface; what ever was so near may be the object's [m].
        """
        if not clouds or not shapes:
            return BackgroundPoints()
        cells = [np.unique(np.floor(cloud / voxel).astype(np.int64), axis=0) for cloud in clouds]
        place, count = np.unique(np.concatenate(cells), axis=0, return_counts=True)
        points: Array = np.asarray((place[count >= max(2.0, _MOST * len(clouds))] + 0.5) * voxel)
        for tubes in shapes:
            if len(points):
                link, _, _, distance = nearest_place(tubes.link_ends, tubes.radius, points)
                points = points[distance > tubes.radius[link] + near]
        return BackgroundPoints(points, _SIGMAS * noise + 0.5 * math.sqrt(3.0) * voxel)


def extra_meshes_by_joint(extra: Sequence[ExtraMesh], mechanism: Mechanism) -> dict[int, list[TriangleMesh]]:
    """Meshes that the URDF does not have, by the index of the joint that carries them, -1 for the world.

    Raises
    ------
    ConfigError
        No such link, or not exactly one shape.
    ModelError
        A file that cannot be read.
    """
    made: dict[int, list[TriangleMesh]] = {}
    for number, entry in enumerate(extra):
        where = f"model: extra_meshes: {number}"
        mesh = _shape(entry, where)
        pose = homogeneous_transform(rotation_from_rpy(*entry.rpy), entry.xyz)
        joint = -1
        if entry.parent_frame is not None:
            if entry.parent_frame not in mechanism.frames:
                hint = nearest_name_hint(entry.parent_frame, list(mechanism.frames))
                raise ConfigError(f"there is no link '{entry.parent_frame}'", where=where, hint=hint)
            frame = mechanism.frames[entry.parent_frame]
            joint, pose = frame.joint_index, np.array(ca.DM(frame.placement.homogeneous_matrix())) @ pose
        made.setdefault(joint, []).append(mesh.transformed(pose))
    return made


def _shape(entry: ExtraMesh, where: str) -> TriangleMesh:
    given = [kind for kind in ("mesh", "box", "cylinder", "sphere") if getattr(entry, kind) is not None]
    if len(given) != 1:
        found = " and ".join(given) or "no shape"
        raise ConfigError(f"there is {found}", where=where, allowed="one of mesh, box, cylinder, sphere")
    if entry.box is not None:
        return TriangleMesh.box(entry.box)
    if entry.cylinder is not None:
        radius, length = entry.cylinder
        return TriangleMesh.cylinder(radius, -0.5 * length, 0.5 * length)
    if entry.sphere is not None:
        return TriangleMesh.sphere(entry.sphere)
    path = Path(str(entry.mesh))
    if not is_file(path):
        raise ModelError(
            f"there is no mesh '{path}'", where=where, hint="give a file that trimesh reads: STL, OBJ, DAE"
        )
    return load_mesh_file(path)


@dataclass(frozen=True, eq=False)
class ForeignObject:
    """Foreign object seen in several frames.

    Attributes
    ----------
    centre : ndarray, shape (3,)
        In the world, in the median frame [m].
    size : ndarray, shape (3,)
        [m]
    frames : int
        In which it was seen.
    moving : bool
    link : str
        Of the robot, with which it moves; empty for none.
    text : str
        Where it is and what helps.
    """

    centre: Array
    size: Array
    frames: int
    moving: bool
    link: str
    text: str


def group_foreign_objects(
    things: Sequence[tuple[float, Sequence[ForeignCluster]]],
    total: int,
    noise: float,
    box: tuple[Array, Array],
    links: Callable[[float], Mapping[str, Array]],
    coloured: bool,
    background: bool = False,
) -> tuple[ForeignObject, ...]:
    """Group the foreign clusters of all frames into foreign objects, each with advice.

    Parameters
    ----------
    things : sequence of (float, sequence of Thing)
        Of each frame: its time on the joints' clock [s] and what it saw.
    total : int
        Number of frames.
    noise : float
        Standard deviation of a point [m].
    box : (ndarray, ndarray), each (3,)
        In which the object ever was: lower and upper corner [m].
    links : callable
        From a time to the poses of the robot's links in the world, shape (4, 4) each.
    coloured : bool
        Whether clouds have colours.
    background : bool
        Whether what stands still in the frames is left out already.
    """
    groups: list[list[tuple[float, ForeignCluster]]] = []
    for t, seen in things:
        for thing in seen:
            home = min(groups, key=lambda group: _apart(group[-1][1], thing), default=None)
            if home is not None and home[-1][0] < t and _apart(home[-1][1], thing) < 1.0:
                home.append((t, thing))
            else:
                groups.append([(t, thing)])
    groups = [group for group in groups if len(group) >= min(_FEWEST, total)]
    groups.sort(key=lambda group: -sum(thing.n_points for _, thing in group))
    return tuple(_named(group, total, noise, box, links, coloured, background) for group in groups)


def _apart(one: ForeignCluster, other: ForeignCluster) -> float:
    """Distance of two things, in shares of their size in which they pass for the same."""
    size = max(float(np.linalg.norm(one.extent)), float(np.linalg.norm(other.extent)), 1e-6)
    return float(np.linalg.norm(one.centre - other.centre)) / (_ALIKE * size)


def _wandering(places: Array) -> float:
    return _TO_SIGMA * float(np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1)))


def _named(
    group: Sequence[tuple[float, ForeignCluster]],
    total: int,
    noise: float,
    box: tuple[Array, Array],
    links: Callable[[float], Mapping[str, Array]],
    coloured: bool,
    background: bool,
) -> ForeignObject:
    places = np.array([thing.centre for _, thing in group])
    centre = np.median(places, axis=0)
    size = np.median([thing.extent for _, thing in group], axis=0)
    far = _wandering(places)
    # as arm and object hide parts of a still thing, the middle of the rest wanders within it
    span = np.ptp(places, axis=0)
    moving = bool((span > np.maximum(2 * _SIGMAS * noise, _STILL * np.max([x.extent for _, x in group], axis=0))).any())
    link = ""
    if moving:
        poses = [links(t) for t, _ in group]
        inside = {
            name: _wandering(
                np.array([(p - at[name][:3, 3]) @ at[name][:3, :3] for p, at in zip(places, poses, strict=True)])
            )
            for name in poses[0]
        }
        if inside:
            best = min(inside, key=lambda name: inside[name])
            link = best if inside[best] < _FOLLOWS * far else ""
    low, high = places.min(axis=0) - 0.5 * size, places.max(axis=0) + 0.5 * size
    beside = bool(((low > box[1]) | (high < box[0])).any())
    where = ", ".join(f"{value:.2f}" for value in centre)
    big = " x ".join(f"{value:.2f}" for value in size)
    how = f"moving with {link}" if link else "moving" if moving else "still"
    text = f"something of {big} m at ({where}) m is not the object, {how}, in {len(group)} of {total} frames: "
    if link:
        text += f"give its shape under model.extra_meshes with parent_frame: {link}"
    elif moving:
        text += (
            "take it out of view" if not beside else "leave it out with track.options.filters.box_lower and box_upper"
        )
        text += ", or give the object's colour under track.options.filters.object_colours" if coloured else ""
    else:
        text += "" if background else "set track.options.background_estimation: frames, or "
        text += "film the scene without object and robot for track.background_frames"
        text += "; or leave it out with track.options.filters.box_lower and box_upper" if beside else ""
        text += "; if it is another arm, lock its joints (model.arms.locked_joints)" if links(group[0][0]) else ""
    return ForeignObject(centre, size, len(group), moving, link, text)

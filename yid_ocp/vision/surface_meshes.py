"""Surfaces of the robot and of the tubes, each fixed to a joint's moving frame, and queries against them.

Every joint keeps one scene in its own frame: rays and points are brought there, so that nothing is rebuilt as the robot
moves.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import casadi as ca
import numpy as np
from annotated_types import Gt
from numpy.typing import ArrayLike, NDArray

from yid_ocp.errors import DataError, ModelError
from yid_ocp.files import is_file
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.mechanism import Mechanism
from yid_ocp.model.system import System
from yid_ocp.model.urdf import resolve_urdf_path
from yid_ocp.options import OptionInfo, PositiveFloat
from yid_ocp.vision.frames import CameraIntrinsics, import_open3d

Array = NDArray[np.float64]
MeshKind = Literal["visual", "collision"]
_Triple = tuple[float, float, float]

_FACETS = 48  # of a tube: the surface is then within 0.2 % of the radius
_TOUCHING = 5e-4  # [m]
_CELL = 0.01  # [m]
_HALF_CELL = 0.5 * math.sqrt(3.0) * _CELL + 1e-5  # the furthest of a cell from its centre, and rounding [m]
_CELLS = 1 << 20  # along each axis, more than any robot needs
_NEAR = 0.05  # [m]; closer than this a box is not projected but taken to fill the image


@dataclass(frozen=True)
class ExtraMesh:
    """Mesh that the robot's URDF does not have, such as a gripper's body, a table or a camera stand."""

    parent_frame: Annotated[str | None, OptionInfo("link of the robot that carries it; null for the world")] = None
    mesh: Annotated[str | None, OptionInfo("file that trimesh reads, in metres: STL, OBJ, DAE", is_path=True)] = None
    box: Annotated[
        tuple[PositiveFloat, PositiveFloat, PositiveFloat] | None,
        OptionInfo("in place of a file: edges along x, y, z", "m"),
    ] = None
    cylinder: Annotated[
        tuple[PositiveFloat, PositiveFloat] | None, OptionInfo("the same: radius and length along z", "m")
    ] = None
    sphere: Annotated[float | None, Gt(0), OptionInfo("the same: radius", "m")] = None
    xyz: Annotated[_Triple, OptionInfo("of its middle in the link", "m")] = (0.0, 0.0, 0.0)
    rpy: Annotated[_Triple, OptionInfo("roll, pitch and yaw in the link", "rad")] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class CameraScene:
    """Robot and object that a camera looks at."""

    system: System
    # file of the robot, for its meshes (`package:baxter`); None for the object alone
    robot_urdf: str | Path | None = None
    # parameter values (lengths, radii, relative stiffnesses); nominal where absent
    parameter_values: Mapping[str, float] | None = None
    extra_meshes: Sequence[ExtraMesh] = ()  # what stands about that is neither


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangles: `vertices` (V, 3) [m], `faces` (F, 3) indices."""

    vertices: Array
    faces: NDArray[np.int64]

    def transformed(self, pose: ArrayLike) -> TriangleMesh:
        """Mesh transformed by a pose, shape (4, 4)."""
        matrix = np.asarray(pose, float)
        return TriangleMesh(self.vertices @ matrix[:3, :3].T + matrix[:3, 3], self.faces)

    @staticmethod
    def concatenate(parts: Sequence[TriangleMesh]) -> TriangleMesh:
        """Several meshes as one."""
        shifts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
        faces = [part.faces + shift for part, shift in zip(parts, shifts, strict=True)]
        return TriangleMesh(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))

    @staticmethod
    def box(size: ArrayLike) -> TriangleMesh:
        """A box about the origin; `size` (3,) [m]."""
        corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        faces = [triangle for a, b, c, d in sides for triangle in ((a, b, c), (a, c, d))]
        return TriangleMesh(corners * np.asarray(size, float), np.array(faces))

    @staticmethod
    def cylinder(radius: float, low: float, high: float) -> TriangleMesh:
        """A closed cylinder about z from `low` to `high` [m]."""
        angle = 2 * np.pi * np.arange(_FACETS) / _FACETS
        ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
        levels = [np.column_stack([ring, np.full(_FACETS, z)]) for z in (low, high)]
        vertices = np.concatenate([*levels, [[0, 0, low], [0, 0, high]]])
        i, j = np.arange(_FACETS), (np.arange(_FACETS) + 1) % _FACETS
        sides = [np.column_stack([i, j, j + _FACETS]), np.column_stack([i, j + _FACETS, i + _FACETS])]
        caps = [np.column_stack([j, i, np.full(_FACETS, 2 * _FACETS)])]
        caps += [np.column_stack([i + _FACETS, j + _FACETS, np.full(_FACETS, 2 * _FACETS + 1)])]
        return TriangleMesh(vertices, np.concatenate([*sides, *caps]))

    @staticmethod
    def sphere(radius: float) -> TriangleMesh:
        """A sphere about the origin."""
        rings = _FACETS // 2
        polar = np.pi * np.arange(1, rings) / rings
        angle = 2 * np.pi * np.arange(_FACETS) / _FACETS
        around = np.column_stack([np.cos(angle), np.sin(angle)])
        shell = [np.column_stack([np.sin(p) * around, np.full(_FACETS, np.cos(p))]) for p in polar]
        vertices = radius * np.concatenate([*shell, [[0, 0, 1.0], [0, 0, -1.0]]])
        top, bottom = len(vertices) - 2, len(vertices) - 1
        i, j = np.arange(_FACETS), (np.arange(_FACETS) + 1) % _FACETS
        faces = [np.column_stack([i, j, np.full(_FACETS, top)])]
        for k in range(rings - 2):
            a, b = k * _FACETS, (k + 1) * _FACETS
            faces += [np.column_stack([i + a, i + b, j + b]), np.column_stack([i + a, j + b, j + a])]
        last = (rings - 2) * _FACETS
        faces.append(np.column_stack([j + last, i + last, np.full(_FACETS, bottom)]))
        return TriangleMesh(vertices, np.concatenate(faces))


class _Cells:
    """Distances to a surface at the centres of cells, worked out when a cell is asked for."""

    def __init__(self, scene: Any, origin: Array) -> None:
        self._scene, self._origin = scene, origin
        self._keys, self._away = np.empty(0, dtype=np.int64), np.empty(0)

    def distance(self, points: Array) -> Array:
        """Distance of points of the part's frame to its surface, shape (N,) [m]."""
        query = import_open3d().core.Tensor(np.ascontiguousarray(points, dtype=np.float32))
        return np.asarray(self._scene.compute_distance(query, nthreads=1).numpy().astype(np.float64))

    def within(self, points: Array, reach: float) -> NDArray[np.bool_]:
        """Which points are no further than `reach` [m], shape (N,)."""
        cell = np.floor((points - self._origin) / _CELL).astype(np.int64) + _CELLS // 2
        key = (cell[:, 0] * _CELLS + cell[:, 1]) * _CELLS + cell[:, 2]
        every, index = np.unique(key, return_inverse=True)
        new = np.setdiff1d(every, self._keys, assume_unique=True)
        if len(new):
            place = np.stack([new // _CELLS**2, new // _CELLS % _CELLS, new % _CELLS], axis=1)
            away = self.distance(self._origin + (place - _CELLS // 2 + 0.5) * _CELL)
            keys, values = np.append(self._keys, new), np.append(self._away, away)
            order = np.argsort(keys)
            self._keys, self._away = keys[order], values[order]
        away = self._away[np.searchsorted(self._keys, every)][index]
        close = away + _HALF_CELL < reach
        unsure = np.flatnonzero(~close & (away - _HALF_CELL < reach))
        if len(unsure):
            close[unsure] = self.distance(points[unsure]) <= reach
        return np.asarray(close)


class ArticulatedSurfaces:
    """Meshes on the joints of a mechanism, with ray and distance queries.

    Parameters
    ----------
    mechanism : Mechanism
        With numbers in place of its parameters (`Mechanism.with_numeric_values`).
    meshes : mapping of int to Mesh
        By joint index (-1: fixed to the world), in the joint's moving frame.
    """

    def __init__(self, mechanism: Mechanism, meshes: Mapping[int, TriangleMesh]) -> None:
        o3d = import_open3d()
        self.mechanism = mechanism
        self.part_joints = tuple(sorted(meshes))
        self._scenes: list[Any] = []
        self._low, self._high = [], []
        self._cells: list[_Cells] = []
        for joint in self.part_joints:
            mesh = meshes[joint]
            scene = o3d.t.geometry.RaycastingScene(nthreads=1)
            vertices = o3d.core.Tensor(np.ascontiguousarray(mesh.vertices, dtype=np.float32))
            scene.add_triangles(vertices, o3d.core.Tensor(np.ascontiguousarray(mesh.faces, dtype=np.uint32)))
            self._scenes.append(scene)
            self._low.append(mesh.vertices.min(0))
            self._high.append(mesh.vertices.max(0))
            self._cells.append(_Cells(scene, self._low[-1]))
        q = ca.SX.sym("q", len(mechanism.joints))
        kinematics = forward_kinematics(mechanism, q)
        poses, last = [], ca.SX(ca.DM([[0.0, 0.0, 0.0, 1.0]]))
        for joint in self.part_joints:
            turned = None if joint < 0 else (kinematics.joint_rotations[joint], kinematics.joint_origins[joint])
            poses.append(ca.SX.eye(4) if turned is None else ca.vertcat(ca.horzcat(*turned), last))
        self._poses = ca.Function("poses", [q], [ca.densify(ca.horzcat(*poses))])

    def part_poses_at(self, q: ArrayLike) -> Array:
        """Pose of every part in the world at a configuration, shape (len(joints), 4, 4)."""
        stacked = np.array(self._poses(np.asarray(q, float)))
        return np.asarray(stacked.reshape(4, len(self.part_joints), 4).transpose(1, 0, 2))

    def distance_to_surface(self, points: Array, q: ArrayLike, within: float, *, moving_only: bool = False) -> Array:
        """Distance of points to the nearest surface.

        Parameters
        ----------
        points : ndarray, shape (N, 3)
            In the world [m].
        q : array_like, shape (n,)
            Configuration of the mechanism.
        within : float
            Distances beyond this one are not worked out [m].
        moving_only : bool
            Whether what is fixed to the world is left out.

        Returns
        -------
        ndarray, shape (N,)
            Unsigned [m]; infinite beyond `is_within_distance`.
        """
        result = np.full(len(points), np.inf)
        for part, _, near, local in self._near_parts(points, q, within, moving_only):
            result[near] = np.minimum(result[near], self._cells[part].distance(local))
        return np.where(result <= within, result, np.inf)

    def _near_parts(
        self, points: Array, q: ArrayLike, within: float, moving_only: bool
    ) -> Iterator[tuple[int, Array, NDArray[np.int64], Array]]:
        """Parts with points near their boxes: part, pose, indices of these points, and they in the part's frame."""
        for part, pose in enumerate(self.part_poses_at(q)):
            if moving_only and self.part_joints[part] < 0:
                continue
            local = (points - pose[:3, 3]) @ pose[:3, :3]
            near = np.flatnonzero(self._inside(local, part, within))
            if len(near):
                yield part, pose, near, local[near]

    def _inside(self, local: Array, part: int, margin: float) -> NDArray[np.bool_]:
        """Which points of a part's frame lie in its box, widened by a margin [m], shape (N,)."""
        inside = np.ones(len(local), bool)
        for axis in range(3):  # column by column, which is quicker than whole rows
            inside &= local[:, axis] > self._low[part][axis] - margin
            inside &= local[:, axis] < self._high[part][axis] + margin
        return inside

    def is_within_distance(self, points: Array, q: ArrayLike, reach: float) -> NDArray[np.bool_]:
        """Whether points lie within `reach` [m] of a surface, shape (N,); faster than `distance_to_surface`.

        No distance differs from that of a place by more than the way there: the cell in which a point lies, whose
        centre's distance is kept, mostly tells.

        Parameters
        ----------
        points : ndarray, shape (N, 3)
            In the world [m].
        q : array_like, shape (n,)
        """
        result = np.zeros(len(points), bool)
        for part, pose in enumerate(self.part_poses_at(q)):
            asked = np.flatnonzero(~result)
            local = (points[asked] - pose[:3, 3]) @ pose[:3, :3]
            near = np.flatnonzero(self._inside(local, part, reach))
            if len(near):
                result[asked[near]] = self._cells[part].within(local[near], reach)
        return result

    def nearest_moving_surface(
        self, points: Array, q: ArrayLike, within: float
    ) -> tuple[Array, Array, NDArray[np.int64]]:
        """Distance, normal and part of the nearest moving surface for each point.

        Parameters
        ----------
        points : ndarray, shape (N, 3)
            In the world [m].
        q : array_like, shape (n,)
        within : float
            Surfaces further away are not looked for [m].

        Returns
        -------
        distance : ndarray, shape (N,)
            Infinite beyond `is_within_distance` [m].
        normal : ndarray, shape (N, 3)
            Unit vector from the surface to the point; zero beyond `is_within_distance`.
        part : ndarray of int, shape (N,)
            Index into `part_joints`, -1 beyond `is_within_distance`.
        """
        o3d = import_open3d()
        distance, normal = np.full(len(points), np.inf), np.zeros((len(points), 3))
        owner = np.full(len(points), -1)
        for part, pose, near, local in self._near_parts(points, q, within, True):
            query = np.ascontiguousarray(local, dtype=np.float32)
            answer = self._scenes[part].compute_closest_points(o3d.core.Tensor(query), nthreads=1)
            away = query - answer["points"].numpy()
            length = np.linalg.norm(away, axis=1).astype(np.float64)
            # the way to a surface that is all but touched is rounding: its own normal is better
            flat = answer["primitive_normals"].numpy()
            flat = flat * np.where((flat * away).sum(1) < 0, -1.0, 1.0)[:, None]
            unit = np.where(length[:, None] > _TOUCHING, away / np.maximum(length, 1e-12)[:, None], flat)
            better = (length < distance[near]) & (length <= within)
            chosen = near[better]
            distance[chosen], owner[chosen] = length[better], part
            normal[chosen] = unit[better] @ pose[:3, :3].T
        return distance, normal, owner

    def render_depth_image(
        self, pinhole: CameraIntrinsics, pose: ArrayLike, q: ArrayLike
    ) -> tuple[Array, Array, NDArray[np.int64]]:
        """Noise-free depth image, cosine of incidence and surface part of each pixel.

        Parameters
        ----------
        pose : array_like, shape (4, 4)
            Camera in the world.
        q : array_like, shape (n,)

        Returns
        -------
        depth : ndarray, shape (height, width)
            Along the optical axis [m]; infinite where there is nothing.
        cosine : ndarray, shape (height, width)
            Of the angle between ray and surface normal.
        part : ndarray of int, shape (height, width)
            Index into `part_joints`, -1 where there is nothing.
        """
        rays, camera = pinhole.pixel_rays, np.asarray(pose, float)
        size = rays.shape[:2]
        depth, cosine, owner = np.full(size, np.inf), np.zeros(size), np.full(size, -1)
        for part, placed in enumerate(self.part_poses_at(q)):
            rotation = placed[:3, :3].T @ camera[:3, :3]
            origin = placed[:3, :3].T @ (camera[:3, 3] - placed[:3, 3])
            window = self._window(pinhole, rotation, origin, part)
            if window is None:
                continue
            rows, columns = window
            directions = rays[rows, columns] @ rotation.T
            hit, normals = self._cast(part, origin, directions)
            square = np.abs((normals * directions).sum(-1)) / np.linalg.norm(directions, axis=-1)
            nearer = hit < depth[rows, columns]
            depth[rows, columns] = np.where(nearer, hit, depth[rows, columns])
            cosine[rows, columns] = np.where(nearer, square, cosine[rows, columns])
            owner[rows, columns] = np.where(nearer, part, owner[rows, columns])
        return depth, cosine, owner

    def intersect_rays(self, origin: Array, directions: Array, q: ArrayLike) -> tuple[Array, Array, NDArray[np.int64]]:
        """First intersection of rays with moving or fixed surfaces.

        Parameters
        ----------
        origin : ndarray, shape (3,)
            Of all rays, in the world [m].
        directions : ndarray, shape (N, 3)
        q : array_like, shape (n,)

        Returns
        -------
        distance : ndarray, shape (N,)
            In lengths of the directions; infinite for rays that meet nothing.
        normal : ndarray, shape (N, 3)
            Unit vector of the surface, towards the origin.
        part : ndarray of int, shape (N,)
            Index into `part_joints`, -1 for nothing.
        """
        distance, normal = np.full(len(directions), np.inf), np.zeros((len(directions), 3))
        owner = np.full(len(directions), -1)
        for part, pose in enumerate(self.part_poses_at(q)):
            local = directions @ pose[:3, :3]
            hit, normals = self._cast(part, (origin - pose[:3, 3]) @ pose[:3, :3], local)
            nearer = hit < distance
            distance[nearer], owner[nearer] = hit[nearer], part
            normal[nearer] = normals[nearer] @ pose[:3, :3].T
        away = np.einsum("ij,ij->i", normal, directions) > 0
        return distance, np.where(away[:, None], -normal, normal), owner

    def _cast(self, part: int, origin: Array, directions: Array) -> tuple[Array, Array]:
        """Distances in lengths of the directions, and normals, where rays of a part's frame meet it."""
        packed = np.concatenate([np.broadcast_to(origin, directions.shape), directions], axis=-1)
        rays = import_open3d().core.Tensor(np.ascontiguousarray(packed, dtype=np.float32))
        answer = self._scenes[part].cast_rays(rays, nthreads=1)
        return answer["t_hit"].numpy().astype(np.float64), answer["primitive_normals"].numpy()

    def _window(
        self, pinhole: CameraIntrinsics, rotation: Array, origin: Array, part: int
    ) -> tuple[slice, slice] | None:
        low, high = self._low[part], self._high[part]
        corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        seen = (corners - origin) @ rotation
        if (seen[:, 2] < _NEAR).all():
            return None
        if (seen[:, 2] < _NEAR).any() or pinhole.has_distortion:
            return slice(0, pinhole.height), slice(0, pinhole.width)
        u = pinhole.fx * seen[:, 0] / seen[:, 2] + pinhole.cx
        v = pinhole.fy * seen[:, 1] / seen[:, 2] + pinhole.cy
        left, right = max(0, math.floor(u.min())), min(pinhole.width, math.ceil(u.max()) + 1)
        top, bottom = max(0, math.floor(v.min())), min(pinhole.height, math.ceil(v.max()) + 1)
        return (slice(top, bottom), slice(left, right)) if left < right and top < bottom else None


def load_robot_meshes(urdf: str | Path, mechanism: Mechanism, kind: MeshKind = "visual") -> dict[int, TriangleMesh]:
    """Meshes of a robot's links by the joint that carries them.

    Parameters
    ----------
    urdf : str or Path
        The URDF file, or `package:baxter`.
    mechanism : Mechanism
        That was read from it, alone or joined with others; numeric.

    Returns
    -------
    dict of int to Mesh
        In the frame of the joint, -1 for what does not move.

    Raises
    ------
    ModelError
        No such file, a mesh that is missing or cannot be read, or no mesh at all.
    """
    import yourdfpy

    path = resolve_urdf_path(urdf)
    if not is_file(path):
        raise ModelError(f"there is no URDF file '{path}'", hint="give a path, or package:NAME")
    try:
        robot = yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False, load_collision_meshes=False)
    except Exception as error:  # yourdfpy and lxml raise many kinds for a malformed file
        raise ModelError(f"the URDF cannot be read: {error}", where=str(path)) from error
    parts: dict[int, list[TriangleMesh]] = {}
    for link in robot.robot.links:
        if link.name not in mechanism.frames:
            continue
        frame = mechanism.frames[link.name]
        placement = np.array(ca.DM(frame.placement.homogeneous_matrix()))
        for shape in link.visuals if kind == "visual" else link.collisions:
            origin = np.eye(4) if shape.origin is None else np.asarray(shape.origin, float)
            mesh = _shape_mesh(shape.geometry, path)
            if mesh is not None:
                parts.setdefault(frame.joint_index, []).append(mesh.transformed(placement @ origin))
    if not parts:
        raise ModelError(f"the URDF has no {kind} meshes", where=str(path), hint="choose the other kind")
    return {joint: TriangleMesh.concatenate(entries) for joint, entries in parts.items()}


def _shape_mesh(geometry: Any, urdf: Path) -> TriangleMesh | None:
    if geometry.box is not None:
        return TriangleMesh.box(geometry.box.size)
    if geometry.cylinder is not None:
        half = 0.5 * geometry.cylinder.length
        return TriangleMesh.cylinder(geometry.cylinder.radius, -half, half)
    if geometry.sphere is not None:
        return TriangleMesh.sphere(geometry.sphere.radius)
    if geometry.mesh is None:
        return None
    scale = np.ones(3) if geometry.mesh.scale is None else np.asarray(geometry.mesh.scale, float)
    loaded = load_mesh_file(_resolve_mesh_path(geometry.mesh.filename, urdf))
    return replace(loaded, vertices=loaded.vertices * scale)


@lru_cache(maxsize=64)
def load_mesh_file(file: Path) -> TriangleMesh:
    """Triangles of a file; `ModelError` where it cannot be read."""
    import trimesh

    try:
        loaded: Any = trimesh.load(file, force="mesh")
        return TriangleMesh(np.asarray(loaded.vertices, float), np.asarray(loaded.faces, np.int64))
    except Exception as error:  # trimesh's readers raise many kinds
        raise ModelError(f"the mesh cannot be read: {error}", where=str(file)) from error


def _resolve_mesh_path(name: str, urdf: Path) -> Path:
    """Path of a mesh file named in a URDF: `package://`, `file://`, absolute or beside the URDF."""
    bare = name.removeprefix("file://")
    package = bare.removeprefix("package://")
    candidates = [Path(bare), urdf.parent / bare]
    if package != bare:
        # the package's folder is the URDF's own or one above it, whether or not it still has its name
        parts = Path(package).parts
        candidates = [above / Path(*rest) for above in urdf.parents for rest in (parts, parts[1:]) if rest]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise ModelError(f"the mesh '{name}' is not there", where=str(urdf), hint="keep meshes beside the URDF's package")


def tube_meshes_by_joint(system: System, values: Mapping[str, float] | None = None) -> dict[int, TriangleMesh]:
    """Cylinders along the links of the object's tubes, with balls at the joints between them.

    Parameters
    ----------
    values : mapping of str to float, optional
        Parameter values (lengths, radii); nominal where absent.

    Returns
    -------
    dict of int to Mesh
        By joint index, in the joint's frame.

    Raises
    ------
    DataError
        The system has no tubes.
    """
    if not system.segment_layouts:
        raise DataError("the model has no object to see", hint="give it segments")
    symbols, theta = system.parameters.symbols, system.parameters.vector(values)

    def number(expression: ca.SX) -> float:
        return float(ca.Function("number", [symbols], [expression])(theta))

    meshes: dict[int, TriangleMesh] = {}
    for segment in system.segment_layouts:
        radius = number(segment.radius)
        for i, (names, length) in enumerate(zip(segment.link_joints, segment.link_lengths, strict=True)):
            parts = [TriangleMesh.cylinder(radius, 0.0, number(length))]
            if i or segment.parent_segment is not None:
                parts.append(TriangleMesh.sphere(radius))
            meshes[system.mechanism.joint_index(names[-1])] = TriangleMesh.concatenate(parts)
    return meshes


def numeric_mechanism(system: System, values: Mapping[str, float] | None = None) -> Mechanism:
    """A system's mechanism with numbers in place of all of the system's parameters."""
    return replace(system.mechanism, parameters=system.parameters).with_numeric_values(values)

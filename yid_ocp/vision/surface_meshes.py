"""Surface meshes of robot, tubes and surroundings, and a virtual depth camera that renders them.

Each surface is in a joint's moving frame. The structured-light camera has uniform noise and quantization dd of the
disparity d = f b/z [pixels], with focal length f [pixels], baseline b and depth z. In depth they are dz = z^2/(f b) dd.

References
----------
Khoshelham & Elberink (2012), Sensors 12:1437, doi:10.3390/s120201437, equations (5) and (10).
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import casadi as ca
import numpy as np
from annotated_types import Gt
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from yid_ocp.arrays import Array, BoolArray, IntArray
from yid_ocp.errors import ConfigError, DataError, ModelError, require_known_names
from yid_ocp.files import check_input_file, file_sha256, is_file, json_sha256, read_input_text
from yid_ocp.integrator.interpreted import dense_function_evaluator
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.mechanism import Mechanism, homogeneous_transform, rotation_from_rpy
from yid_ocp.model.system import System
from yid_ocp.model.urdf import urdf_path_from_robot_name
from yid_ocp.options import OptionInfo, PositiveFloat
from yid_ocp.vision import frames

_Triple = tuple[float, float, float]

_MAX_MESH_BYTES = 1 << 28
_EXTRA_MESH_SHAPES = ("mesh_file", "box_size", "cylinder_radius_and_length", "sphere_radius")
_TUBE_FACETS = 48  # facets of a tube, whose surface is then within 0.2 % of the radius
_MAX_JOINED_DISTANCE = 5e-4  # [m]
_MIN_PROJECTED_DISTANCE = 0.05  # [m]; closer than this a box is not projected but taken to fill the image


@dataclass(frozen=True)
class ExtraMesh:
    """A mesh missing from the robot's URDF, such as a gripper's body, a table or a camera stand."""

    parent_frame: Annotated[str | None, OptionInfo("link of the robot that carries it; null for the world")] = None
    mesh_file: Annotated[str | None, OptionInfo("file for trimesh, in metres: STL, OBJ, DAE", is_path=True)] = None
    box_size: Annotated[
        tuple[PositiveFloat, PositiveFloat, PositiveFloat] | None,
        OptionInfo("instead of a file, a box: edges along x, y, z", "m"),
    ] = None
    cylinder_radius_and_length: Annotated[
        tuple[PositiveFloat, PositiveFloat] | None, OptionInfo("or a cylinder: radius and length along z", "m")
    ] = None
    sphere_radius: Annotated[float | None, Gt(0), OptionInfo("or a sphere: radius", "m")] = None
    xyz: Annotated[_Triple, OptionInfo("position of the centre in the link", "m")] = (0.0, 0.0, 0.0)
    rpy: Annotated[_Triple, OptionInfo("roll, pitch and yaw in the link", "rad")] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class SceneDescription:
    """The contents of a camera's scene: system, robot URDF, parameter values and extra meshes."""

    system: System
    robot_urdf: str | Path | None = None  # URDF with the robot's meshes (`package:baxter`); None for the object alone
    parameter_values: Mapping[str, float] | None = None  # includes lengths and radii; default nominal
    surfaces_missing_from_urdf: Sequence[ExtraMesh] = ()  # meshes other than robot and object


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A mesh of triangles, with vertices (V, 3) [m] and vertex indices of each face (F, 3)."""

    vertices: Array
    faces: IntArray

    def transformed(self, pose: ArrayLike) -> TriangleMesh:
        """Return the mesh transformed by a pose (4, 4)."""
        matrix = np.asarray(pose, float)
        return TriangleMesh(self.vertices @ matrix[:3, :3].T + matrix[:3, 3], self.faces)

    @staticmethod
    def concatenate(parts: Sequence[TriangleMesh]) -> TriangleMesh:
        """Join several meshes into one."""
        shifts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
        faces = [part.faces + shift for part, shift in zip(parts, shifts, strict=True)]
        return TriangleMesh(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))

    @staticmethod
    def _of(found: Any) -> TriangleMesh:
        return TriangleMesh(np.asarray(found.vertices, float), np.asarray(found.faces, np.int64))

    @staticmethod
    def box(size: ArrayLike) -> TriangleMesh:
        """Make a box of `size` (3,) about the origin [m]."""
        from trimesh import creation

        return TriangleMesh._of(creation.box(np.asarray(size, float)))

    @staticmethod
    def cylinder(radius: float, low: float, high: float) -> TriangleMesh:
        """Make a closed cylinder along the z axis from `low` to `high` [m]."""
        from trimesh import creation

        middle = homogeneous_transform(np.eye(3), (0.0, 0.0, 0.5 * (low + high)))
        return TriangleMesh._of(creation.cylinder(radius, high - low, _TUBE_FACETS, transform=middle))

    @staticmethod
    def sphere(radius: float) -> TriangleMesh:
        """Make a sphere about the origin."""
        from trimesh import creation

        polar = np.linspace(0.0, np.pi, _TUBE_FACETS // 2 + 1)
        outline = radius * np.column_stack([np.sin(polar), np.cos(polar)])
        outline[[0, -1], 0] = 0.0
        return TriangleMesh._of(creation.revolve(outline, sections=_TUBE_FACETS))


class ArticulatedSurfaces:
    """The surface meshes on the joints of a numeric mechanism, with ray and distance queries. Joint -1 is the world.

    Each joint has a scene in its own frame. Rays and points are transformed to it, so motion needs no new scene.
    """

    def __init__(self, mechanism: Mechanism, meshes: Mapping[int, TriangleMesh]) -> None:
        o3d = frames.import_open3d()
        self.part_joints = tuple(sorted(meshes))
        self._scenes, self._boxes = list[Any](), list[Array]()
        for mesh in (meshes[joint] for joint in self.part_joints):
            scene = o3d.t.geometry.RaycastingScene(nthreads=1)
            faces = o3d.core.Tensor(np.ascontiguousarray(mesh.faces, dtype=np.uint32))
            scene.add_triangles(_tensor(mesh.vertices), faces)
            self._scenes.append(scene)
            self._boxes.append(np.array([mesh.vertices.min(0), mesh.vertices.max(0)]))
        q = ca.SX.sym("q", len(mechanism.joints))
        kinematics = forward_kinematics(mechanism, q)
        poses = [ca.SX.eye(4) for _ in self.part_joints]
        for joint, pose in zip(self.part_joints, poses, strict=True):
            if joint >= 0:
                pose[:3, :] = ca.horzcat(kinematics.joint_rotations[joint], kinematics.joint_origins[joint])
        self._poses = dense_function_evaluator(ca.Function("poses", [q], [ca.densify(ca.horzcat(*poses))]))

    def part_poses_at_configuration(self, q: ArrayLike) -> Array:
        """Return the world poses (parts, 4, 4) of all parts at a configuration."""
        [stacked] = self._poses(np.asarray(q, float))
        return np.asarray(stacked.reshape(4, len(self.part_joints), 4).transpose(1, 0, 2))

    def _near(self, points: Array, part: int, pose: Array, margin: float) -> tuple[IntArray, Array]:
        """Indices of the world points in a part's box, widened by `margin` [m], and their positions in its frame."""
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        (low, high), inside = self._boxes[part], np.ones(len(local), bool)
        for axis in range(3):  # column by column, which is faster
            inside &= (local[:, axis] > low[axis] - margin) & (local[:, axis] < high[axis] + margin)
        near = np.flatnonzero(inside)
        return near, local[near]

    def within_surface_distance_mask(
        self, points: Array, q: ArrayLike, reach: float, *, moving_only: bool = False
    ) -> BoolArray:
        """Return the mask of world points (N, 3) within `reach` [m] of a surface; `moving_only`: of a moving one."""
        result = np.zeros(len(points), bool)
        for part, pose in enumerate(self.part_poses_at_configuration(q)):
            asked = np.flatnonzero(~result)
            near, local = self._near(points[asked], part, pose, reach)
            if len(near) and not (moving_only and self.part_joints[part] < 0):
                distance = self._scenes[part].compute_distance(_tensor(local), nthreads=1).numpy()
                result[asked[near]] = distance.astype(np.float64) <= reach
        return result

    def nearest_moving_surfaces(self, points: Array, q: ArrayLike, within: float) -> tuple[Array, Array, IntArray]:
        """Return distance [m], normal (to the point), index of the nearest moving part; inf, 0, -1 beyond `within`."""
        distance, normal = np.full(len(points), np.inf), np.zeros((len(points), 3))
        owner = np.full(len(points), -1)
        for part, pose in enumerate(self.part_poses_at_configuration(q)):
            near, local = self._near(points, part, pose, within)
            if self.part_joints[part] < 0 or not len(near):
                continue
            query = np.ascontiguousarray(local, dtype=np.float32)
            answer = self._scenes[part].compute_closest_points(_tensor(query), nthreads=1)
            away = query - answer["points"].numpy()
            length = np.linalg.norm(away, axis=1).astype(np.float64)
            # for a nearly touched surface the difference vector is rounding noise: use the surface normal
            flat = answer["primitive_normals"].numpy()
            flat = flat * np.where((flat * away).sum(1) < 0, -1.0, 1.0)[:, None]
            unit = np.where(length[:, None] > _MAX_JOINED_DISTANCE, away / np.maximum(length, 1e-12)[:, None], flat)
            better = (length < distance[near]) & (length <= within)
            chosen = near[better]
            distance[chosen], owner[chosen] = length[better], part
            normal[chosen] = unit[better] @ pose[:3, :3].T
        return distance, normal, owner

    def render_depth_incidence_and_part(
        self, pinhole: frames.CameraIntrinsics, pose: ArrayLike, q: ArrayLike
    ) -> tuple[Array, Array, IntArray]:
        """Render depth along the optical axis [m], cosine of incidence and surface part of each pixel, without noise.

        All have shape (height, width), with inf, 0 and -1 where there is no surface. `pose` (4, 4) is in the world.
        """
        rays, camera = pinhole.pixel_rays_at_unit_depth, np.asarray(pose, float)
        size = rays.shape[:2]
        depth, cosine, owner = np.full(size, np.inf), np.zeros(size), np.full(size, -1)
        for part, placed in enumerate(self.part_poses_at_configuration(q)):
            rotation = placed[:3, :3].T @ camera[:3, :3]
            origin = placed[:3, :3].T @ (camera[:3, 3] - placed[:3, 3])
            window = self._window(pinhole, rotation, origin, part)
            if window is None:
                continue
            directions = rays[window] @ rotation.T
            hit, normals = self._cast(part, origin, directions)
            square = np.abs((normals * directions).sum(-1)) / np.linalg.norm(directions, axis=-1)
            nearer = hit < depth[window]
            for image, own in ((depth, hit), (cosine, square), (owner, part)):
                image[window] = np.where(nearer, own, image[window])
        return depth, cosine, owner

    def intersect_rays(self, origin: Array, directions: Array, q: ArrayLike) -> tuple[Array, Array, IntArray]:
        """Find where rays, from `origin` (3,) in the world along `directions` (N, 3), first meet a surface.

        Returns distances (N,) as multiples of the direction vectors, unit normals (N, 3) that face the origin, and part
        indices (N,). A ray without intersection has distance inf, normal zero and part -1.
        """
        distance, normal = np.full(len(directions), np.inf), np.zeros((len(directions), 3))
        owner = np.full(len(directions), -1)
        for part, pose in enumerate(self.part_poses_at_configuration(q)):
            hit, normals = self._cast(part, (origin - pose[:3, 3]) @ pose[:3, :3], directions @ pose[:3, :3])
            nearer = hit < distance
            distance[nearer], owner[nearer] = hit[nearer], part
            normal[nearer] = normals[nearer] @ pose[:3, :3].T
        return distance, np.where((np.einsum("ij,ij->i", normal, directions) > 0)[:, None], -normal, normal), owner

    def _cast(self, part: int, origin: Array, directions: Array) -> tuple[Array, Array]:
        """Distances, in multiples of `directions`, and normals at the intersections of rays in a part's frame."""
        packed = np.concatenate([np.broadcast_to(origin, directions.shape), directions], axis=-1)
        answer = self._scenes[part].cast_rays(_tensor(packed), nthreads=1)
        return answer["t_hit"].numpy().astype(np.float64), answer["primitive_normals"].numpy()

    def _window(
        self, pinhole: frames.CameraIntrinsics, rotation: Array, origin: Array, part: int
    ) -> tuple[slice, slice] | None:
        """Rows and columns of the image that can show a part; None if the part is out of view."""
        seen = (np.array(list(product(*self._boxes[part].T))) - origin) @ rotation
        if (seen[:, 2] < _MIN_PROJECTED_DISTANCE).all():
            return None
        if (seen[:, 2] < _MIN_PROJECTED_DISTANCE).any() or pinhole.has_distortion:
            return slice(0, pinhole.height), slice(0, pinhole.width)
        u = pinhole.fx * seen[:, 0] / seen[:, 2] + pinhole.cx
        v = pinhole.fy * seen[:, 1] / seen[:, 2] + pinhole.cy
        left, right = max(0, math.floor(u.min())), min(pinhole.width, math.ceil(u.max()) + 1)
        top, bottom = max(0, math.floor(v.min())), min(pinhole.height, math.ceil(v.max()) + 1)
        return (slice(top, bottom), slice(left, right)) if left < right and top < bottom else None


def _tensor(values: NDArray[Any]) -> Any:
    return frames.import_open3d().core.Tensor(np.ascontiguousarray(values, dtype=np.float32))


def load_robot_meshes_by_joint(urdf: str | Path, mechanism: Mechanism) -> dict[int, TriangleMesh]:
    """Load the visual meshes of a robot's links by joint index, in the joint's frame. Index -1 is the fixed base.

    `urdf` is a file or `package:baxter`. `mechanism` (numeric) contains this robot, alone or within a larger mechanism.
    Raises `ModelError` if the file or a mesh is missing or unreadable, or if there is no mesh at all.
    """
    import yourdfpy

    path = urdf_path_from_robot_name(urdf)
    bare = {"build_scene_graph": False, "load_meshes": False, "load_collision_meshes": False}
    try:
        robot = yourdfpy.URDF.load(str(check_input_file(path)), **bare)
    except Exception as error:  # yourdfpy and lxml raise many kinds for a malformed file
        reason = f"an element has no {error}" if isinstance(error, KeyError) else getattr(error, "what", error)
        what, hint = f"the URDF cannot be read: {reason}", "check it with check_urdf, or export it again"
        raise ModelError(what, where=str(path), allowed="a URDF file with links and joints", hint=hint) from error
    parts: dict[int, list[TriangleMesh]] = {}
    for link in robot.robot.links:
        if link.name not in mechanism.frames:
            continue
        for shape in link.visuals:
            geometry, origin = shape.geometry, np.eye(4) if shape.origin is None else np.asarray(shape.origin, float)
            tube = geometry.cylinder and (geometry.cylinder.radius, geometry.cylinder.length)
            mesh = _solid(geometry.box and geometry.box.size, tube, geometry.sphere and geometry.sphere.radius)
            if mesh is None and geometry.mesh is not None:
                mesh = _load_mesh_file(_resolve_mesh_path(geometry.mesh.filename, path))
                if geometry.mesh.scale is not None:
                    mesh = replace(mesh, vertices=mesh.vertices * np.asarray(geometry.mesh.scale, float))
            if mesh is not None:
                joint, placement = _carrier(mechanism, link.name)
                parts.setdefault(joint, []).append(mesh.transformed(placement @ origin))
    if not parts:
        what, hint = "the URDF has no visual shapes", "add visual meshes or primitive shapes to its links"
        raise ModelError(what, where=str(path), allowed="a URDF with meshes or primitive shapes", hint=hint)
    return {joint: TriangleMesh.concatenate(entries) for joint, entries in parts.items()}


def mesh_sources_sha256(urdf: str | Path, mechanism: Mechanism) -> str:
    """Compute a SHA-256 hash of the files and link poses from which a robot's visual meshes are built."""
    path = urdf_path_from_robot_name(urdf)
    robot = ElementTree.fromstring(read_input_text(path))
    links = [name for entry in robot.iter("link") if (name := entry.get("name", "")) in mechanism.frames]
    carried = [(name, joint, pose.tolist()) for name in links for joint, pose in [_carrier(mechanism, name)]]
    meshes = {str(mesh.get("filename")) for mesh in robot.iterfind("link/visual/geometry/mesh")}
    files = (Path(__file__), path, *(_resolve_mesh_path(name, path) for name in sorted(meshes)))
    return json_sha256([carried, list(map(file_sha256, files))])


def _carrier(mechanism: Mechanism, frame: str) -> tuple[int, Array]:
    """Index of the joint that carries a frame (-1: the world), and the frame's pose (4, 4) relative to the joint."""
    found = mechanism.frames[frame]
    return found.joint_index, np.array(ca.DM(found.placement.homogeneous_matrix()))


def _solid(box: ArrayLike | None, cylinder: tuple[float, float] | None, sphere: float | None) -> TriangleMesh | None:
    """A box of a size, a cylinder of radius and length, or a sphere of a radius, centred at the origin; else None."""
    if box is not None:
        return TriangleMesh.box(box)
    if cylinder is not None:
        return TriangleMesh.cylinder(cylinder[0], -0.5 * cylinder[1], 0.5 * cylinder[1])
    return None if sphere is None else TriangleMesh.sphere(sphere)


def extra_meshes_by_joint_index(extra: Sequence[ExtraMesh], mechanism: Mechanism) -> dict[int, list[TriangleMesh]]:
    """Load meshes that the URDF lacks, by joint index (-1: the world).

    Raises `ConfigError` for an unknown link or an entry that is not one shape, `ModelError` for an unreadable file.
    """
    made: dict[int, list[TriangleMesh]] = {}
    for number, entry in enumerate(extra):
        where = f"model.surfaces_missing_from_urdf, entry {number + 1}"
        given = [kind for kind in _EXTRA_MESH_SHAPES if getattr(entry, kind) is not None]
        if len(given) != 1:
            what, hint = f"the entry has {' and '.join(given) or 'no shape'}, not one shape", "set one of these keys"
            raise ConfigError(what, where=where, allowed=f"one of {', '.join(_EXTRA_MESH_SHAPES)}", hint=hint)
        mesh = _solid(entry.box_size, entry.cylinder_radius_and_length, entry.sphere_radius)
        if entry.mesh_file is not None:
            if not is_file(Path(entry.mesh_file)):
                what, allowed = f"there is no mesh file '{entry.mesh_file}'", "an STL, OBJ or DAE file"
                raise ModelError(what, where=where, allowed=allowed, hint="set mesh_file to an existing file")
            mesh = _load_mesh_file(Path(entry.mesh_file))
        assert mesh is not None
        joint, placement = -1, np.eye(4)
        if entry.parent_frame is not None:
            require_known_names([entry.parent_frame], mechanism.frames, "link", where, ConfigError)
            joint, placement = _carrier(mechanism, entry.parent_frame)
        pose = placement @ homogeneous_transform(rotation_from_rpy(*entry.rpy), entry.xyz)
        made.setdefault(joint, []).append(mesh.transformed(pose))
    return made


def _load_mesh_file(file: Path) -> TriangleMesh:
    return _mesh_of_file(file, file.stat().st_mtime_ns if is_file(file) else 0)


@lru_cache(maxsize=64)
def _mesh_of_file(file: Path, changed: int) -> TriangleMesh:
    """The mesh of a file. It is cached for the path and for the time [ns] at which the file was last changed."""
    import trimesh

    try:
        return TriangleMesh._of(trimesh.load(check_input_file(file, _MAX_MESH_BYTES), force="mesh"))
    except Exception as error:  # trimesh's readers raise many kinds
        reason = f"{file.suffix} files are not supported" if isinstance(error, ImportError) else error
        what, hint = f"the mesh {file.name} cannot be read: {reason}", "export the mesh again as STL or OBJ"
        raise ModelError(what, where=str(file), allowed="an STL, OBJ or DAE file", hint=hint) from error


def _resolve_mesh_path(name: str, urdf: Path) -> Path:
    """Path of a mesh file named in a URDF: `package://`, `file://`, absolute or relative to the URDF."""
    bare = name.removeprefix("file://")
    package, candidates = bare.removeprefix("package://"), [Path(bare), urdf.parent / bare]
    if package != bare:
        # the package's folder is the URDF's own or one above it, whether or not it still has its name
        parts = Path(package).parts
        candidates = [above / Path(*rest) for above in urdf.parents for rest in (parts, parts[1:]) if rest]
    if found := next((candidate for candidate in candidates if candidate.is_file()), None):
        return found
    what, allowed = f"the mesh file '{name}' does not exist", "mesh files at the paths that the URDF states"
    raise ModelError(what, where=str(urdf), allowed=allowed, hint="copy the meshes into the URDF's package folder")


def model_link_lengths_and_radius_by_segment(
    system: System, values: Mapping[str, float] | None = None
) -> dict[str, tuple[Array, float]]:
    """Return the link lengths and radius [m] of every tube, by segment name."""
    segments, theta = system.segment_layouts, system.parameters.vector(values)
    sizes = [ca.densify(ca.vertcat(*segment.link_lengths, segment.radius)) for segment in segments]
    found = ca.Function("sizes", [system.parameters.symbols], sizes).call([theta])
    numbers = [np.array(entry).ravel() for entry in found]
    return {s.name: (entry[:-1], float(entry[-1])) for s, entry in zip(segments, numbers, strict=True)}


def _tube_meshes_by_joint(system: System, values: Mapping[str, float] | None = None) -> dict[int, TriangleMesh]:
    """Meshes of the object's links by joint index: cylinders, joined by balls, in joint frames. `DataError` if none."""
    if not system.segment_layouts:
        what, hint = "the model has no object that a camera could see", "set model.object, such as kind: foam_y"
        raise DataError(what, where="model.object", allowed="an object of segments", hint=hint)
    meshes, sizes = dict[int, TriangleMesh](), model_link_lengths_and_radius_by_segment(system, values)
    for segment in system.segment_layouts:
        lengths, radius = sizes[segment.name]
        for i, (names, length) in enumerate(zip(segment.link_joints, lengths, strict=True)):
            parts = [TriangleMesh.cylinder(radius, 0.0, float(length))]
            if i or segment.parent_segment is not None:
                parts.append(TriangleMesh.sphere(radius))
            meshes[system.mechanism.joint_index(names[-1])] = TriangleMesh.concatenate(parts)
    return meshes


# edges and middles of thin boxes [m]
_FLOOR_AND_WALL = (([8.0, 8.0, 0.02], [1.0, 0.0, -0.94]), ([0.02, 8.0, 3.0], [-0.61, 0.0, 0.5]))
_PERIOD_JITTER = 0.25  # largest variation of a period, as a fraction of the mean


@dataclass(frozen=True)
class DepthCameraModel:
    """A structured-light depth camera with its noise and lost pixels. The defaults represent an Asus Xtion Pro Live."""

    intrinsics: frames.CameraIntrinsics = frames.XTION_INTRINSICS
    baseline: float = 0.075  # between projector and camera, along x [m]
    # range of depths that it measures [m]
    min_depth: float = 0.8
    max_depth: float = 3.5
    disparity_std: float = 1 / 16  # standard deviation of the disparity [pixels]; 1/16 gives 6 mm at 2 m
    disparity_step: float = 1 / 8  # step of the disparity [pixels]; 1/8 gives 12 mm at 2 m
    noise_correlation_length: float = 0.7  # correlation length of errors of neighbouring pixels [pixels]
    # cosine of ray and normal below which no depth is measured; up to twice this value it is sometimes measured
    min_incidence_cosine: float = 0.12
    min_relative_edge_depth: float = 0.02  # difference of neighbouring pixels that makes an edge, relative to depth
    # probability that a pixel at an edge is lost, or lies anywhere between front and back
    edge_loss_probability: float = 0.6
    edge_mixing_probability: float = 0.05
    loss_probability: float = 0.01  # probability that any pixel is lost
    # probability that a pixel's pattern is matched wrongly: its depth is then anywhere within `outlier_depth_range`
    outlier_probability: float = 0.0
    outlier_depth_range: float = 0.4  # [m], to either side of the true depth

    def _simulate_depth_image(self, depth: Array, cosine: Array, rng: np.random.Generator) -> Array:
        """Measured depth [m] (NaN: none) from true depth (inf: none) and the cosine between ray and normal."""
        from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter  # slow to import

        scale, shape = self.intrinsics.fx * self.baseline, depth.shape
        white = gaussian_filter(rng.standard_normal(shape), self.noise_correlation_length, mode="wrap")
        white /= white.std()
        chance, far = rng.random((4, *shape)), np.where(np.isfinite(depth), depth, 1e3)
        front, back = minimum_filter(far, size=3), maximum_filter(far, size=3)
        edge = back - front > self.min_relative_edge_depth * front
        mixed = edge & (chance[0] < self.edge_mixing_probability) & (back < self.max_depth)
        true = np.where(mixed, front + rng.random(shape) * (back - front), far)
        wrong = chance[1] < self.outlier_probability
        true = np.where(wrong, true + self.outlier_depth_range * rng.uniform(-1.0, 1.0, shape), true)
        disparity = scale / np.maximum(true, 1e-3) + self.disparity_std * white
        if self.disparity_step > 0:
            disparity = np.rint(disparity / self.disparity_step) * self.disparity_step
        measured = scale / np.maximum(disparity, 1e-6)
        lost = (np.minimum(far, measured) < self.min_depth) | (np.maximum(far, measured) > self.max_depth)
        lost |= cosine < self.min_incidence_cosine * (1.0 + chance[2])
        lost |= edge & ~mixed & (chance[0] > 1.0 - self.edge_loss_probability)
        lost |= chance[3] < self.loss_probability
        lost |= self._shadow(far)
        return np.where(lost, np.nan, measured)

    def _shadow(self, depth: Array) -> BoolArray:
        """Pixels not lit by the projector, on the camera's left, because another surface of the image row is nearer."""
        disparity = self.intrinsics.fx * self.baseline / depth
        height, width = depth.shape
        margin = math.ceil(float(disparity.max())) + 1
        # the projector is at x = -baseline, so its image of a pixel is shifted right by the disparity
        column = np.rint(np.arange(width) + disparity).astype(np.int64)
        flat = np.arange(height)[:, None] * (width + margin + 1) + np.minimum(column, width + margin)
        nearest = np.zeros(height * (width + margin + 1))
        np.maximum.at(nearest, flat.ravel(), disparity.ravel())
        return np.asarray(disparity < nearest[flat] - 1.0)


@dataclass(frozen=True, eq=False)
class VirtualFramesWithTruth:
    """The frame sequence of a virtual camera, with the true capture times and the true motion."""

    sequence: frames.FrameSequence
    capture_times: Array  # (M,), time of every picture on the simulator's clock [s]
    true_configuration_at: Callable[[float], Array]  # function of time: configuration (n,)


@dataclass(frozen=True, eq=False)
class VirtualCameraSetup:
    """A virtual depth camera, described by pose, sensor model, frame rate, dropped frames and errors of time stamps."""

    pose: ArrayLike | None  # (4, 4), camera in the world (x right, y down, z ahead) [m]
    sensor_model: DepthCameraModel = field(default_factory=DepthCameraModel)  # default: an Asus Xtion Pro Live
    mean_rate: float = 3.0  # [Hz]
    dropped_frame_fraction: float = 0.0  # fraction of frames that never arrive
    latency: float = 0.0  # stamp minus capture time, camera clock offset included [s]
    latency_std: float = 0.0  # standard deviation of the latency from frame to frame [s]
    seed: int = 0  # seed of all random draws

    def _sample_times_and_stamps(self, start: float, stop: float, rng: np.random.Generator) -> tuple[Array, Array]:
        """Times (M,) [s] of the frames that arrive, and their stamps (M,) [s]."""
        count = math.ceil((stop - start) * self.mean_rate / (1 - _PERIOD_JITTER)) + 2
        taken = start + np.cumsum(rng.uniform(1 - _PERIOD_JITTER, 1 + _PERIOD_JITTER, count) / self.mean_rate)
        taken = taken[taken < stop]
        taken = taken[rng.random(len(taken)) >= self.dropped_frame_fraction]
        return taken, taken + self.latency + self.latency_std * rng.standard_normal(len(taken))


def render_virtual_frames(
    scene: SceneDescription, t: ArrayLike, q: ArrayLike, camera: VirtualCameraSetup
) -> VirtualFramesWithTruth:
    """Return the frames that a virtual camera takes of a motion. A frame is rendered when it is loaded, reproducibly.

    The configurations `q` (N, n) at times `t` (N,) [s] can come from any simulator; a cubic spline interpolates them.
    In a scene with a robot, a floor under the foam Y and a wall behind Baxter are added.
    """
    lens, pose = camera.sensor_model.intrinsics, frames.validated_camera_pose(camera.pose, "sequence")
    times, rng = np.asarray(t, float), np.random.default_rng(camera.seed)
    taken, stamps = camera._sample_times_and_stamps(float(times[0]), float(times[-1]), rng)
    course = CubicSpline(times, np.asarray(q, float), axis=0)
    configuration = np.asarray(course(taken))
    tree = scene.system.mechanism_with_values(scene.parameter_values)
    meshes = _tube_meshes_by_joint(scene.system, scene.parameter_values)
    robot = load_robot_meshes_by_joint(scene.robot_urdf, tree) if scene.robot_urdf is not None else {}
    around = [TriangleMesh.box(size).transformed(homogeneous_transform(np.eye(3), at)) for size, at in _FLOOR_AND_WALL]
    still = [*(around if robot else []), *([robot.pop(-1)] if -1 in robot else [])]
    surfaces = ArticulatedSurfaces(tree, meshes | robot | ({-1: TriangleMesh.concatenate(still)} if still else {}))

    def cloud(index: int) -> Array:
        depth, cosine, _ = surfaces.render_depth_incidence_and_part(lens, pose, configuration[index])
        rng = np.random.default_rng([camera.seed, index])
        return lens.points_from_depth(camera.sensor_model._simulate_depth_image(depth, cosine, rng))

    names = tuple(f"frame {i}" for i in range(len(taken)))
    made = frames.FrameSequence(stamps, names, pose, cloud, lens, "virtual camera")
    return VirtualFramesWithTruth(made, taken, lambda at: np.asarray(course(at)))

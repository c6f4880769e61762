"""Clouds of smooth bent rods and of things about them, with known truth: nothing here is the model's chain of capsules.

A rod is an arc: its curvature turns its direction evenly along its length. Its surface is a swept circle, seen by rays;
depth has noise that grows with the square of the distance, and some pixels at edges mix front and back.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from yid_ocp import vision
from yid_ocp.model.mechanism import homogeneous_transform
from yid_ocp.vision.frames import import_open3d
from yid_ocp.vision.surface_meshes import TriangleMesh
from yid_ocp.vision.track import track_object

PINHOLE = vision.CameraIntrinsics.from_field_of_view(320, 240, np.radians(50.0))
EYE, TARGET = (2.6, 0.0, 0.3), (0.85, 0.0, -0.15)
FOOT = np.array([0.85, 0.0, -0.93])
LEAN = np.radians(45.0)
Y_LENGTHS = {"T1": 0.813, "T2": 0.610, "T3": 0.737}
Y_RADII = {"T1": 0.032, "T2": 0.025, "T3": 0.019}
NOISE = 0.006  # [m] at 2 m
COARSE = vision.CloudFilterOptions(voxel_size=0.014)  # a third of the points, where radii do not matter


def arc(start, direction, length, curvature, count=60):
    """Centre line and directions of a rod that bends evenly by `curvature` (a vector across it) [rad/m]."""
    s = np.linspace(0.0, length, count)
    turns = Rotation.from_rotvec(s[:, None] * np.asarray(curvature, float))
    tangents = turns.apply(np.asarray(direction, float) / np.linalg.norm(direction))
    steps = 0.5 * (tangents[1:] + tangents[:-1]) * np.diff(s)[:, None]
    return np.vstack([start, start + np.cumsum(steps, axis=0)]), tangents, turns


def swept(line, tangents, radius, facets=24):
    """Tube about a centre line, with flat ends."""
    across = np.cross(tangents, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across, axis=1)[:, None]
    other = np.cross(tangents, across)
    angle = 2 * np.pi * np.arange(facets) / facets
    ring = np.cos(angle)[None, :, None] * across[:, None] + np.sin(angle)[None, :, None] * other[:, None]
    vertices = np.vstack([(line[:, None] + radius * ring).reshape(-1, 3), line[0], line[-1]])
    k, j = np.meshgrid(np.arange(len(line) - 1), np.arange(facets), indexing="ij")
    a, b = k * facets + j, k * facets + (j + 1) % facets
    faces = [np.stack([a, b, b + facets], -1).reshape(-1, 3), np.stack([a, b + facets, a + facets], -1).reshape(-1, 3)]
    first, last, i = len(vertices) - 2, len(vertices) - 1, np.arange(facets)
    faces.append(np.column_stack([np.full(facets, first), (i + 1) % facets, i]))
    top = (len(line) - 1) * facets
    faces.append(np.column_stack([np.full(facets, last), top + i, top + (i + 1) % facets]))
    return TriangleMesh(vertices, np.concatenate(faces))


def box(centre, size):
    """A box with its middle somewhere."""
    return TriangleMesh.box(size).transformed(homogeneous_transform(np.eye(3), centre))


def pole(foot, length, radius):
    """An upright cylinder."""
    return TriangleMesh.cylinder(radius, 0.0, length).transformed(homogeneous_transform(np.eye(3), foot))


@dataclass
class SmoothY:
    """The paper's Y as three smooth rods; `bends` are curvatures about world x and y of each rod [rad/m]."""

    lengths: dict[str, float] = field(default_factory=lambda: dict(Y_LENGTHS))
    radii: dict[str, float] = field(default_factory=lambda: dict(Y_RADII))

    def rods(self, bends):
        """Meshes and tips [m] at one moment."""
        meshes, tips = [], {}
        line, tangents, turns = arc(FOOT, [0.0, 0.0, 1.0], self.lengths["T1"], [*bends["T1"], 0.0])
        meshes.append(swept(line, tangents, self.radii["T1"]))
        tips["w_T1"] = line[-1]
        for name, lean in (("T2", -LEAN), ("T3", LEAN)):
            away = turns[-1].apply([0.0, -np.sin(lean), np.cos(lean)])
            branch, along, _ = arc(line[-1], away, self.lengths[name], [*bends[name], 0.0])
            meshes.append(swept(branch, along, self.radii[name]))
            tips[f"w_{name}"] = branch[-1]
        return meshes, tips


def swaying(k, size=0.35):
    """Bends of frame k: each rod sways at its own pace [rad/m]."""
    phases = {"T1": (0.31, 0.5), "T2": (0.43, 1.9), "T3": (0.37, 3.2)}
    return {
        name: (size * np.sin(rate * 2 * k + phase), size * np.cos(rate * 1.5 * k + 2 * phase))
        for name, (rate, phase) in phases.items()
    }


def seen(meshes: Sequence[TriangleMesh], seed, *, pose=None, pinhole=PINHOLE, noise=NOISE, flying=0.3):
    """Cloud of meshes in the camera's frame, shape (N, 3)."""
    o3d = import_open3d()
    camera = vision.look_at_pose(EYE, TARGET) if pose is None else pose
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    mesh = TriangleMesh.concatenate(list(meshes))
    corners, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)
    scene.add_triangles(o3d.core.Tensor(corners), o3d.core.Tensor(faces))
    directions = pinhole.pixel_rays_at_unit_depth @ camera[:3, :3].T
    packed = np.concatenate([np.broadcast_to(camera[:3, 3], directions.shape), directions], axis=-1)
    depth = scene.cast_rays(o3d.core.Tensor(packed.astype(np.float32)), nthreads=1)["t_hit"].numpy().astype(float)
    rng = np.random.default_rng(seed)
    beside = np.roll(depth, rng.choice([-1, 1]), axis=1)
    edge = np.isfinite(depth) & np.isfinite(beside) & (np.abs(beside - depth) > 0.04)
    mixed = edge & (rng.random(depth.shape) < flying)
    depth = np.where(mixed, depth + rng.random(depth.shape) * (beside - depth), depth)
    depth = depth + noise * (depth / 2.0) ** 2 * rng.standard_normal(depth.shape)
    return pinhole.points_from_depth(np.where(depth < 4.0, depth, np.nan))


def floor_and_wall():
    """A floor under the Y's foot and a wall well behind it."""
    return [box([1.0, 0.0, -0.94], [8.0, 8.0, 0.02]), box([-1.2, 0.0, 0.5], [0.02, 8.0, 3.0])]


def nowhere(places, *_):
    """No position is hidden or filtered out."""
    return np.zeros(len(places), bool)


def frames_of(t, clouds, pose):
    """A sequence of clouds in the camera's frame, with their stamps."""
    names = tuple(f"frame {i}" for i in range(len(clouds)))
    return vision.FrameSequence(np.asarray(t, float), names, pose, clouds.__getitem__)


def filmed(object_: SmoothY, frames, things=lambda k: [], *, seed=0, rate=4.0, background=True, still=None):
    """A sequence with its truth: tips of every frame, each (3, 3) in the order w_T1, w_T2, w_T3 [m]."""
    pose = vision.look_at_pose(EYE, TARGET)
    clouds, truth = [], []
    for k in range(frames):
        meshes, tips = object_.rods(swaying(k) if still is None else still)
        around = floor_and_wall() if background else []
        clouds.append(seen([*meshes, *around, *things(k)], [seed, k]))
        truth.append([tips[name] for name in ("w_T1", "w_T2", "w_T3")])
    return frames_of(np.arange(frames) / rate, clouds, pose), np.array(truth)


def measured(alone, sequence, truth, extra=(), empty=None, **options):
    """A track of a filmed sequence, and its errors [m]."""
    chosen = vision.TrackOptions(tracked_points=alone.point_frames, **options)
    scene = vision.SceneDescription(alone, surfaces_missing_from_urdf=extra)
    found = track_object(scene, None, sequence, chosen, empty=empty)
    good = [frame.index for frame in found.frame_reports if frame.is_good]
    order = [("w_T1", "w_T2", "w_T3").index(name) for name in found.point_names]
    return found, found.position - truth[good][:, order]

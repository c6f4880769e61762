"""What `track_object` makes of cameras and objects that are not as it is told: one row a disturbance.

    python benchmarks/vision_table.py [ROW ...] [--arms 1 2] [--seeds 0 1] [--frames 14] [--motions FOLDER]

The camera is independent of the own one: MuJoCo moves a chain, twice as fine as the fitted one with one arm, each tube
is a smooth rod (a circle swept along a spline through its joints), the robot its own meshes where MuJoCo puts
them, all in one scene of Open3D's ray caster. Depth errors grow with z^2 and are alike in neighbouring pixels, edges
fly, depth is quantised, holes are blobs; exposed for longer, a pixel sees one of several instants or their mean. What
`track_object` is told of the camera's pose, its clock, the object and the surroundings is wrong as the row says.

A row: median error of the accepted points, share of frames accepted, accepted frames in which a point is more than
40 mm off, share of coordinates within two standard deviations, median standard deviation; or the refusal.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation

from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.errors import YidError
from yid_ocp.model.objects.foam_y import foam_y_object
from yid_ocp.model.system import Grasp, System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.report.terminal import aligned_table_lines
from yid_ocp.virtual.joint_motion import (
    BAXTER_JOINT_NAMES_WITHOUT_SIDE,
    MultisineOptions,
    grasping_joint_angles,
    random_multisine_motion,
)
from yid_ocp.virtual.mjcf import mujoco_model_from_mjcf_text, mujoco_xml
from yid_ocp.virtual.mujoco_simulation import SimulationOptions, simulate_in_mujoco
from yid_ocp.vision import CameraIntrinsics, FrameSequence, SceneDescription, TrackOptions, TrackResult, look_at_pose
from yid_ocp.vision.frames import import_open3d
from yid_ocp.vision.surface_meshes import TriangleMesh, load_robot_meshes_by_joint
from yid_ocp.vision.track import track_object

Array = NDArray[np.float64]

TRUTH = {"T1.bend": 22.0, "T1.twist": 13.6, "T2.bend": 10.7, "T2.twist": 8.2, "T3.bend": 11.5, "T3.twist": 9.7}
"""Stiffness of every joint of a tube of four links [N m/rad]."""

POSE = look_at_pose([2.6, 0.0, 0.45], [0.85, 0.0, -0.1])
LENS = CameraIntrinsics.from_field_of_view(424, 318, math.radians(58.0))
WRONG = 0.04  # [m]; an accepted frame with a point that is further off is the worst that can happen
SIDES = 32  # of a rod's cross section
INSTANTS = 6  # that an exposure mixes
TRAVEL = {1: 0.15, 2: 0.11}  # [m]
LINKS = {1: 8, 2: 4}  # of a tube in MuJoCo, whose chains of eight between two arms are not stable at a usable step


@dataclass(frozen=True)
class Noise:
    """Errors of the depth; [m] at 1 m grow with the square of the distance."""

    std: float = 0.0018
    alike: float = 1.5  # [pixels]
    step: float = 0.0009  # of the depth
    flying: float = 0.35  # share of the pixels at edges that lie anywhere between front and back
    holes: float = 0.04  # share of all pixels, in blobs
    grazing: float = 0.15  # cosine of ray and normal below which nothing comes back


@dataclass(frozen=True)
class Row:
    """One disturbance: what is true, and what is told that is not."""

    turn: float = 0.0  # of the told pose against the true one, about the camera [degrees]
    shift: float = 0.0  # of the told pose [m]
    scale: float = 1.0  # seen over true depth
    latency: float = 0.0  # stamp minus time of the picture [s]
    drift: float = 0.0  # of the camera's clock
    exposure: float = 0.0  # [s]
    clutter: str = ""
    length: float = 1.0  # told over true, of all tubes
    radius: float = 1.0  # told over true, of all tubes
    duration: float = 5.0  # [s]
    travel: float = 1.0  # of the arms, over the usual
    noise: Noise = field(default_factory=Noise)
    options: Mapping[str, Any] = field(default_factory=dict)  # of `track_object`


ROWS: dict[str, Row] = {
    "none": Row(),
    "pose 1": Row(turn=1.0, shift=0.01),
    "pose 2": Row(turn=2.0, shift=0.02),
    "pose 4": Row(turn=4.0, shift=0.04),
    "scale +2 %": Row(scale=1.02),
    "scale -2 %": Row(scale=0.98),
    "scale +4 %": Row(scale=1.04),
    "scale -4 %": Row(scale=0.96),
    "pose 4, scale +4 %": Row(turn=4.0, shift=0.04, scale=1.04),
    "latency 100 ms": Row(latency=0.1),
    "latency 200 ms": Row(latency=0.2),
    "latency 400 ms": Row(latency=0.4),
    "pose 4, latency 400 ms": Row(turn=4.0, shift=0.04, latency=0.4),
    "drift 0.1 %": Row(drift=1e-3, duration=60.0),
    "exposure 100 ms": Row(exposure=0.1, travel=1.3),
    "exposure 100 ms, told": Row(exposure=0.1, travel=1.3, options={"exposure_time": 0.1}),
    "person": Row(clutter="person"),
    "table": Row(clutter="table"),
    "pole": Row(clutter="pole"),
    "box": Row(clutter="box"),
    "wall": Row(clutter="wall"),
    "gripper": Row(clutter="gripper"),
    "lengths -10 %": Row(length=0.9),
    "lengths +10 %": Row(length=1.1),
    "radii -30 %": Row(radius=0.7),
    "radii +30 %": Row(radius=1.3),
}


def y_system(arms: int, links: int, damping: float = 0.05) -> System:
    """Baxter with one or two arms holding the foam Y, of so many links a tube."""
    sides = ("left", "right")[:arms]
    names = [f"{side}_{joint}" for side in sides for joint in BAXTER_JOINT_NAMES_WITHOUT_SIDE]
    grasps = [Grasp(side, f"{side}_gripper", held) for side, held in zip(sides, ("w_T2", "w_T3"), strict=False)]
    robot = read_urdf("package:baxter", joints=names)
    return System.build(
        robot, objects=[(foam_y_object(links), None, None)], grasps=grasps, driven=names, damping=damping
    )


@dataclass(frozen=True, eq=False)
class Played:
    """A motion that MuJoCo has played: the system, its parameter values, times, configurations, torques, points."""

    arms: int
    system: System
    values: Mapping[str, float]
    t: Array
    q: Array
    effort: Array
    points: Array

    @property
    def course(self) -> CubicSpline:
        """From a time to the configuration."""
        return CubicSpline(self.t, self.q, axis=0)

    def joints(self, seed: int) -> JointGroup:
        """What the encoders recorded."""
        driven = list(self.system.actuated_coordinate_indices)
        noise = 2e-4 * np.random.default_rng([seed, 5]).standard_normal((len(self.t), len(driven)))
        position = self.q[:, driven] + noise
        stated = {"position_std": 2e-4, "effort_std": 0.0, "effort_kind": "command"}
        return JointGroup(self.system.driven, self.t, position, effort=self.effort, **stated)

    def arm_points(self, seed: int) -> PointGroup:
        """What the arms know of the points that they hold."""
        names = tuple(grasp.held_frame for grasp in self.system.grasps)
        seen = self.points[:, [self.system.point_frames.index(name) for name in names]]
        noise = 1e-3 * np.random.default_rng([seed, 6]).standard_normal(seen.shape)
        return PointGroup("points_arm", names, self.t, seen + noise, 1e-3, sensor_name="arm")


def played(
    arms: int,
    seed: int,
    duration: float,
    travel: float = 1.0,
    links: int | None = None,
    folder: Path | None = None,
    truth: Mapping[str, float] | None = None,
    step: float = 2.5e-4,
) -> Played:
    """A motion in MuJoCo; kept in a folder, where one is given, as numbers."""
    links = links or LINKS[arms]
    system = y_system(arms, links)
    values = {name: value * links / 4 for name, value in (truth or TRUTH).items()}
    name = f"{arms}-{links}-{seed}-{duration:g}-{travel:g}{'' if truth is None else '-own'}.npz"
    kept = None if folder is None or truth is not None else folder / name
    if kept is not None and kept.is_file():
        with np.load(kept) as file:
            return Played(arms, system, values, file["t"], file["q"], file["effort"], file["points"])
    posture = grasping_joint_angles(system, values)
    excitation = MultisineOptions(gripper_travel=TRAVEL[arms] * travel, duration=duration)
    motion = random_multisine_motion(system, values, seed=seed, initial_joint_angles=posture, excitation=excitation)
    run = simulate_in_mujoco(
        system, values, motion, SimulationOptions(duration, time_step=step), initial_joint_angles=posture
    )
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        np.savez(kept, t=run.t, q=run.q, effort=run.effort, points=run.point_positions)
    return Played(arms, system, values, run.t, run.q, run.effort, run.point_positions)


class Stage:
    """All that rays can meet at a time: rods, robot, surroundings, clutter."""

    def __init__(self, play: Played, clutter: str, seed: int) -> None:
        self.play, self.course = play, play.course
        system = play.system
        self.model = mujoco_model_from_mjcf_text(mujoco_xml(system, play.values))
        self.data = mujoco.MjData(self.model)
        names = system.mechanism.joint_names
        self.order = [self.model.joint(name).id for name in names]
        tree = system.mechanism_with_values(play.values)
        self.robot = load_robot_meshes_by_joint("package:baxter", tree)
        theta = dict(zip(system.parameters.names, system.parameters.vector(play.values), strict=True))
        self.rods = []
        for segment in system.segment_layouts:
            bodies = [int(self.model.jnt_bodyid[self.model.joint(links[0]).id]) for links in segment.link_joints]
            site = self.model.site(f"w_{segment.name}").id
            self.rods.append((bodies, site, theta[f"{segment.name}.radius"]))
        self.clutter = clutter
        self.gripper = self.model.site("grasp_left_holder").id
        self.draw = np.random.default_rng([seed, 3])
        self.still = [_slab([8.0, 8.0, 0.02], [1.0, 0.0, -0.94]), _slab([0.02, 8.0, 3.0], [-0.61, 0.0, 0.5])]
        self.still += _clutter(clutter)

    def place(self, t: float) -> Array:
        """The true points at a time, shape (np, 3) [m]."""
        self._pose(t)
        return np.array([self.data.site_xpos[self.model.site(name).id] for name in self.play.system.point_frames])

    def _pose(self, t: float) -> None:
        self.data.qpos[self.order] = self.course(float(np.clip(t, self.play.t[0], self.play.t[-1])))
        mujoco.mj_kinematics(self.model, self.data)

    def meshes(self, t: float) -> list[TriangleMesh]:
        """Everything in the world at a time."""
        self._pose(t)
        data, found = self.data, list(self.still)
        for joint, mesh in self.robot.items():
            pose = np.eye(4)
            if joint >= 0:
                body = int(self.model.jnt_bodyid[self.model.joint(self.play.system.mechanism.joint_names[joint]).id])
                pose[:3, :3], pose[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
            found.append(mesh.transformed(pose))
        for bodies, site, radius in self.rods:
            found.append(swept(np.vstack([data.xpos[bodies], data.site_xpos[site]]), radius))
        if self.clutter == "gripper":
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = data.site_xmat[self.gripper].reshape(3, 3), data.site_xpos[self.gripper]
            found.append(TriangleMesh.box([0.09, 0.14, 0.12]).transformed(pose))
        if self.clutter == "person":
            found += _person(t)
        return found


def swept(joints: Array, radius: float) -> TriangleMesh:
    """A closed tube about a spline through points, shape (K, 3) [m]."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(joints, axis=0), axis=1))])
    line = CubicSpline(along, joints, axis=0)
    at = np.linspace(0.0, along[-1], 6 * len(joints))
    centre, tangent = line(at), line(at, 1)
    tangent = tangent / np.linalg.norm(tangent, axis=1)[:, None]
    side = np.cross(tangent[0], [1.0, 0.3, 0.2])
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    rings = []
    for point, ahead in zip(centre, tangent, strict=True):
        side = side - (side @ ahead) * ahead  # carried along without a turn
        side = side / np.linalg.norm(side)
        other = np.cross(ahead, side)
        rings.append(point + radius * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other))
    vertices = np.concatenate([*rings, centre[:1], centre[-1:]])
    i, j = np.arange(SIDES), (np.arange(SIDES) + 1) % SIDES
    faces = []
    for k in range(len(rings) - 1):
        a, b = k * SIDES, (k + 1) * SIDES
        faces += [np.column_stack([i + a, i + b, j + b]), np.column_stack([i + a, j + b, j + a])]
    foot, last = len(rings) * SIDES, (len(rings) - 1) * SIDES
    faces += [np.column_stack([i, j, np.full(SIDES, foot)])]
    faces += [np.column_stack([j + last, i + last, np.full(SIDES, foot + 1)])]
    return TriangleMesh(vertices, np.concatenate(faces))


def _slab(size: Sequence[float], at: Sequence[float], turn: float = 0.0) -> TriangleMesh:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("z", turn).as_matrix(), at
    return TriangleMesh.box(list(size)).transformed(pose)


def _limb(start: Sequence[float], stop: Sequence[float], radius: float) -> TriangleMesh:
    return swept(np.linspace(start, stop, 4), radius)


def _person(t: float) -> list[TriangleMesh]:
    """Somebody beside the object, swaying, with an arm stretched out towards it."""
    sway = 0.04 * math.sin(1.7 * t)
    x, y = 1.0 + sway, -1.1
    legs = [_limb([x, y + s, -0.93], [x, y + s, -0.1], 0.08) for s in (-0.1, 0.1)]
    arm = _limb([x, y + 0.15, 0.35], [x + 0.05, y + 0.6 + sway, 0.0], 0.05)
    return [*legs, _limb([x, y, -0.15], [x, y, 0.5], 0.17), _limb([x, y, 0.55], [x, y, 0.75], 0.1), arm]


def _clutter(kind: str) -> list[TriangleMesh]:
    """What stands still within the object's reach and is told to nobody."""
    return {
        "table": [_slab([0.6, 0.9, 0.04], [1.05, 0.55, -0.45], 0.2), _slab([0.05, 0.05, 0.46], [1.3, 0.9, -0.7])],
        "pole": [_limb([0.95, -0.32, -0.93], [0.95, -0.32, 0.9], 0.02)],
        "box": [_slab([0.3, 0.25, 0.4], [0.9, -0.35, -0.73], 0.5)],
        "wall": [_slab([0.03, 1.2, 1.6], [0.62, -0.75, -0.1])],
    }.get(kind, [])


def cast(meshes: Sequence[TriangleMesh], pose: Array) -> tuple[Array, Array]:
    """Depth along the axis [m], infinite for nothing, and the cosine of ray and normal; shapes (height, width)."""
    o3d = import_open3d()
    scene, whole = o3d.t.geometry.RaycastingScene(nthreads=1), TriangleMesh.concatenate(meshes)
    scene.add_triangles(
        o3d.core.Tensor(np.ascontiguousarray(whole.vertices, dtype=np.float32)),
        o3d.core.Tensor(np.ascontiguousarray(whole.faces, dtype=np.uint32)),
    )
    directions = LENS.pixel_rays_at_unit_depth @ pose[:3, :3].T
    rays = np.concatenate([np.broadcast_to(pose[:3, 3], directions.shape), directions], axis=-1)
    answer = scene.cast_rays(o3d.core.Tensor(np.ascontiguousarray(rays, dtype=np.float32)), nthreads=1)
    normals = answer["primitive_normals"].numpy()
    square = np.abs((normals * directions).sum(-1)) / np.linalg.norm(directions, axis=-1)
    return answer["t_hit"].numpy().astype(np.float64), square


def measured(depths: Sequence[Array], cosines: Sequence[Array], noise: Noise, rng: np.random.Generator) -> Array:
    """What the sensor makes of one or several instants of an exposure, NaN for nothing."""
    stack, square = np.array(depths), np.array(cosines)
    shape = stack.shape[1:]
    true, cosine = stack[0], square[0]
    if len(stack) > 1:
        middle = np.median(stack, axis=0)
        same = np.abs(stack - middle) < 0.05
        with np.errstate(invalid="ignore"):
            mean = np.where(same, stack, 0.0).sum(axis=0) / np.maximum(same.sum(axis=0), 1)
        pick = rng.integers(len(stack), size=shape)
        rows, columns = np.indices(shape)
        true = np.where(same.all(axis=0) | (rng.random(shape) < 0.5), mean, stack[pick, rows, columns])
        cosine = square[pick, rows, columns]
    far = np.where(np.isfinite(true) & (true > 0), true, 9.0)
    front, back = minimum_filter(far, size=3), maximum_filter(far, size=3)
    edge = back - front > 0.03 * front
    flies = edge & (rng.random(shape) < noise.flying)
    depth = np.where(flies, front + rng.random(shape) * (back - front), far)
    white = gaussian_filter(rng.standard_normal(shape), noise.alike, mode="wrap")
    depth = depth + noise.std * depth**2 * white / white.std()
    step = noise.step * depth**2
    depth = np.rint(depth / step) * step
    blobs = gaussian_filter(rng.standard_normal(shape), 4.0, mode="wrap")
    lost = (blobs > np.quantile(blobs, 1 - noise.holes)) | (cosine < noise.grazing) | (far > 6.0) | (depth > 6.0)
    return np.where(lost, np.nan, depth)


@dataclass(frozen=True, eq=False)
class Film:
    """What `track_object` is given, and what was true."""

    scene: SceneDescription
    recording: Recording
    sequence: FrameSequence
    place: Callable[[float], Array]
    taken: Array


def told_system(arms: int, row: Row) -> tuple[System, dict[str, float]]:
    """The system of four links that `track_object` and `solve` know, and its values where they are not true."""
    system = y_system(arms, 4)
    theta = dict(zip(system.parameters.names, system.parameters.vector(), strict=True))
    values = dict(TRUTH)
    for segment in system.segment_layouts:
        values[f"{segment.name}.length"] = row.length * float(theta[f"{segment.name}.length"])
        values[f"{segment.name}.radius"] = row.radius * float(theta[f"{segment.name}.radius"])
    return system, values


def film(play: Played, row: Row, seed: int, frames: int) -> Film:
    """Frames of a motion under a disturbance; each is drawn when it is asked for, the same every time."""
    rng = np.random.default_rng([seed, 1])
    begin, end = play.t[0] + 0.5 + row.latency, play.t[-1] - 0.2
    gap = (end - begin) / frames
    taken = begin + gap * (np.arange(frames) + rng.uniform(0.1, 0.9, frames))
    stamps = taken + row.latency + row.drift * (taken - play.t[0]) + 0.002 * rng.standard_normal(frames)
    stage = Stage(play, row.clutter, seed)
    told = POSE.copy()
    axis, way = rng.standard_normal((2, 3))
    turn = Rotation.from_rotvec(math.radians(row.turn) * axis / np.linalg.norm(axis)).as_matrix()
    told[:3, :3] = turn @ POSE[:3, :3]
    told[:3, 3] += row.shift * way / np.linalg.norm(way)

    @lru_cache(maxsize=frames)
    def load(index: int) -> Array:
        spread = np.linspace(-0.5, 0.5, INSTANTS) * row.exposure if row.exposure > 0 else np.zeros(1)
        seen = [cast(stage.meshes(float(taken[index]) + s), POSE) for s in spread]
        depth = measured([d for d, _ in seen], [c for _, c in seen], row.noise, np.random.default_rng([seed, 2, index]))
        return LENS.points_from_depth(depth * row.scale)

    system, values = told_system(play.arms, row)
    names = tuple(f"frame {i}" for i in range(frames))
    sequence = FrameSequence(stamps, names, told, load, LENS, "independent camera")
    recording = Recording(play.joints(seed), (play.arm_points(seed),), source="MuJoCo", name="table")
    return Film(SceneDescription(system, "package:baxter", values), recording, sequence, stage.place, taken)


@dataclass(frozen=True, eq=False)
class Outcome:
    """Errors [m] of the points written down and in units of their standard deviations; frames; why it was refused."""

    error: Array
    relative: Array
    std: Array
    accepted: int
    frames: int
    refusal: str
    seconds: float
    clock: str
    dropped: Mapping[str, int]

    @property
    def wrong(self) -> int:
        """Accepted frames in which a point is worse than `WRONG`."""
        return int((np.nan_to_num(self.error) > WRONG).any(axis=1).sum()) if len(self.error) else 0


def tracked(made: Film, options: TrackOptions) -> tuple[TrackResult | None, Outcome]:
    """Track a film and compare with the truth."""
    count = len(made.sequence)
    for i in range(count):
        made.sequence.load_cloud(i)
    drawn = time.process_time()
    nothing = np.empty((0, 1))
    try:
        found = track_object(made.scene, made.recording, made.sequence, options)
    except YidError as error:
        spent = time.process_time() - drawn
        return None, Outcome(nothing, nothing, nothing, 0, count, error.what, spent, "", {})
    columns = [made.scene.system.point_frames.index(name) for name in found.point_names]
    truth = np.array([made.place(float(t))[columns] for t in found.t])
    apart = found.position - truth
    error = np.linalg.norm(apart, axis=2)
    size = np.linalg.norm(found.std, axis=2) / math.sqrt(3)
    spent = time.process_time() - drawn
    return found, Outcome(
        error,
        apart / found.std,
        size,
        len(found.t),
        count,
        "",
        spent,
        found.camera_calibration.message,
        found.frame_drop_reason_counts,
    )


def summary(outcomes: Sequence[Outcome]) -> tuple[str, ...]:
    """A row's cells from all its seeds."""
    frames = sum(o.frames for o in outcomes)
    refused = [o.refusal for o in outcomes if o.refusal]
    good = [o for o in outcomes if not o.refusal]
    if not good:
        return ("-", "0 %", "0", "-", "-", refused[0])
    error = np.concatenate([o.error.ravel() for o in good])
    relative = np.concatenate([o.relative.ravel() for o in good])
    std = np.concatenate([o.std.ravel() for o in good])
    within = np.mean(np.abs(relative[np.isfinite(relative)]) <= 2)
    text = f"{len(refused)} of {len(outcomes)} refused: {refused[0]}" if refused else ""
    return (
        f"{1e3 * np.nanmedian(error):.1f}",
        f"{100 * sum(o.accepted for o in good) / frames:.0f} %",
        str(sum(o.wrong for o in good)),
        f"{100 * within:.0f} %",
        f"{1e3 * np.nanmedian(std):.1f}",
        text,
    )


def main() -> int:
    """Film, track and print one table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("rows", metavar="ROW", nargs="*", help=f"of {', '.join(ROWS)}")
    parser.add_argument("--arms", type=int, nargs="+", default=[1], choices=[1, 2])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--frames", type=int, default=14)
    parser.add_argument("--motions", type=Path, help="folder in which motions are kept for the next time")
    parser.add_argument("--told", action="store_true", help="print what was said of every film")
    given = parser.parse_args()
    unknown = sorted(set(given.rows) - set(ROWS))
    if unknown:
        parser.error(f"no such row: {', '.join(unknown)} (rows: {', '.join(ROWS)})")
    head = ("arms", "disturbance", "median [mm]", "accepted", "> 40 mm", "within 2 std", "std [mm]", "refused")
    rows = [head]
    for arms in given.arms:
        for name in given.rows or ROWS:
            row, outcomes = ROWS[name], []
            for seed in given.seeds:
                play = played(arms, seed, row.duration, row.travel, folder=given.motions)
                _, outcome = tracked(film(play, row, seed, given.frames), replace(TrackOptions(), **row.options))
                outcomes.append(outcome)
                if given.told:
                    worst = 1e3 * np.nanmax(outcome.error) if len(outcome.error) else math.nan
                    print(f"{arms} {name} seed {seed}: worst {worst:.0f} mm, {outcome.seconds:.1f} s; {outcome.clock}")
                    print(f"    {outcome.dropped} {outcome.refusal}", flush=True)
            rows.append((str(arms), name, *summary(outcomes)))
            print("  ".join(rows[-1]), file=sys.stderr, flush=True)
    print("\n".join(aligned_table_lines(rows)))
    return 0


if __name__ == "__main__":
    sys.exit(main())

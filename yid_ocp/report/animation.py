"""Data for animations of measured and predicted motion: sticks, points, robot meshes and applied forces."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from yid_ocp.arrays import Array, BoolArray
from yid_ocp.data.channel_checks import median_sample_period
from yid_ocp.data.recording import Recording
from yid_ocp.errors import OutputError, YidError
from yid_ocp.files import file_sha256, json_sha256, read_input_text, write_text
from yid_ocp.integrator.compiler import MappedFunction, private_cache_folder
from yid_ocp.model.system import System
from yid_ocp.model.urdf import urdf_path_from_robot_name
from yid_ocp.vision.surface_meshes import TriangleMesh, load_robot_meshes_by_joint, mesh_sources_sha256

_MAX_FRAMES = 150  # largest number of frames of an animation; the page interpolates linearly between them
_PUSHED_POINT = "75%"  # location on a segment at which an unknown push is drawn
_ARM_RADIUS = 0.03  # radius with which an arm is drawn [m]
_POSITION_SCALE = 1e4  # from [m] to integers in 0.1 mm
_MAX_MESH_FACES = {True: 6000, False: 4000}  # largest number of triangles on a page, for moving and fixed links
_FIRST_MESH_CELL, _CELL_GROWTH = 0.004, 1.3  # edge of the cubes in which vertices are merged [m], and its growth factor
_QUATERNION_SCALE = 1e4
_MIN_STICK_LENGTH, _TIME_TOLERANCE = 1e-6, 1e-9  # shortest stick [m], and tolerance of equal times [s]
_MAX_ORDINARY_GAP = 1.5  # largest gap between measurements that is interpolated [median sample periods]


@dataclass(frozen=True)
class _Stick:
    end_indices: tuple[int, int]
    radius: float
    is_object_part: bool


@dataclass(frozen=True)
class _AnimatedMotion:
    """Motion of one stick figure over F frames, measured or predicted.

    `positions` (F, K, 3) [m] are NaN where unknown. `point_indices` are the points that a sensor measures by name;
    `is_new_measurement` (F, points) is False where an earlier measurement is still shown. `acting` lists applied forces
    as (label, point index or -1, unit, values (F, k)). `arm` is (system, parameters, configurations (F, n)) for meshes.
    """

    name: str
    sticks: Sequence[_Stick]
    positions: Array
    point_indices: Mapping[str, int]
    is_new_measurement: BoolArray | None = None
    acting: Sequence[tuple[str, int, str, Array]] = ()
    arm: tuple[System, Array, Array] | None = None

    def to_dict(self) -> dict[str, Any]:
        fresh, places = self.is_new_measurement, self.positions.reshape(len(self.positions), -1)
        acting = [(*own, [[float(f"{x:.3g}") for x in row] for row in values.tolist()]) for *own, values in self.acting]
        return {
            "name": self.name,
            "sticks": [[*own.end_indices, round(own.radius, 4), int(own.is_object_part)] for own in self.sticks],
            "points": dict(self.point_indices),
            "fresh": None if fresh is None else fresh.astype(int).tolist(),
            "acting": acting,
            "places": [[round(_POSITION_SCALE * x) if isfinite(x) else None for x in row] for row in places.tolist()],
        }


@dataclass(frozen=True)
class AnimationData:
    """The data of one animation: several motions at common times t (F,) [s]."""

    title: str
    t: Array
    motions: tuple[_AnimatedMotion, ...]


def animations_to_dict(scenes: Sequence[AnimationData], robot: str | None = None) -> dict[str, Any]:
    """Convert scenes to data for JSON, with meshes by joint. Positions are integers in 0.1 mm, null if unknown.

    The meshes of the URDF `robot` follow the arm of a scene's last model or, in a scene without a model, the measured
    motion of the arm. If no mesh can be read, the arm is drawn as sticks.
    """
    meshes: dict[str, list[list[int]]] | None = None
    made = []
    for scene in scenes:
        motions = [motion.to_dict() for motion in scene.motions]
        arms = [(i, motion.arm) for i, motion in enumerate(scene.motions) if motion.arm is not None]
        models = [entry for entry in arms if scene.motions[entry[0]].name != "measured"]
        for i, (system, theta, q) in (models or arms)[-1:]:
            meshes = _thinned_robot_meshes(robot, system) if meshes is None else meshes
            motions[i]["poses"] = _joint_poses(system, theta, q, [name for name in meshes if name])
        t = [round(float(t), 4) for t in scene.t]
        made.append({"title": scene.title, "t": t, "scale": _POSITION_SCALE, "motions": motions})
    return {"scenes": made, "meshes": meshes or {}}


def _thinned_robot_meshes(robot: str | None, system: System) -> dict[str, list[list[int]]]:
    """Vertices and faces of thinned robot meshes, cached, by the joint that carries them ("": fixed parts)."""
    with contextlib.suppress(OSError, YidError, SyntaxError):  # the last of a damaged URDF
        if robot is None or "<visual" not in read_input_text(urdf_path_from_robot_name(robot)):
            return {}
        mechanism = system.mechanism_with_values()
        told = (file_sha256(Path(__file__)), mesh_sources_sha256(robot, mechanism), system.mechanism.joint_names)
        file: Path | None = None
        with contextlib.suppress(YidError):  # a page has its meshes without a cache, too
            file = private_cache_folder() / f"meshes-{json_sha256(told)[:32]}.json"
        if file and file.is_file():
            with contextlib.suppress(ValueError):
                return dict(json.loads(file.read_text(encoding="utf-8")))
        found = load_robot_meshes_by_joint(robot, mechanism)
        names = (*system.mechanism.joint_names, "")
        whole = {j: (np.rint(_POSITION_SCALE * m.vertices).astype(int), m.faces) for j, m in _thinned(found).items()}
        made = {names[j]: [array.ravel().tolist() for array in arrays] for j, arrays in whole.items()}
        with contextlib.suppress(OutputError):
            if file:
                write_text(file, json.dumps(made, separators=(",", ":")))
        return made
    return {}


def _thinned(found: dict[int, TriangleMesh]) -> dict[int, TriangleMesh]:
    """Return meshes by joint with merged vertices, so that moving and fixed meshes have few enough faces each."""
    for moving, most in _MAX_MESH_FACES.items():
        own, cell = {j: mesh for j, mesh in found.items() if (j >= 0) == moving}, _FIRST_MESH_CELL
        while sum(len(mesh.faces) for mesh in own.values()) > most:
            own = {j: _with_merged_vertices(mesh, cell) for j, mesh in own.items()}
            cell *= _CELL_GROWTH
        found = found | own
    return found


def _with_merged_vertices(mesh: TriangleMesh, cell: float) -> TriangleMesh:
    """Return a mesh whose vertices in each cube of edge `cell` [m] become their mean, without degenerate faces."""
    cubes = np.floor((mesh.vertices - mesh.vertices.min(0)) / cell).astype(np.int64)
    _, index = np.unique(cubes @ np.cumprod([1, *(cubes.max(0)[:2] + 1)]), return_inverse=True)
    means = np.column_stack([np.bincount(index, x) for x in mesh.vertices.T]) / np.bincount(index)[:, None]
    corners = np.sort(faces := index[mesh.faces], axis=1)
    whole = np.flatnonzero((np.diff(corners, axis=1) > 0).all(axis=1))
    kept = whole[np.unique(corners[whole] @ [1, len(means), len(means) ** 2], return_index=True)[1]]
    return TriangleMesh(means, faces[kept])


def _joint_poses(system: System, theta: Array, q: Array, names: Sequence[str]) -> list[list[int]]:
    """Return scaled integer positions and quaternions (x, y, z, w) of joints at configurations q (F, n), by frame."""
    if not names:
        return []
    (symbols, moved), index = system.symbols_and_kinematics, system.mechanism.joint_index
    parts = [ca.horzcat(moved.joint_rotations[index(name)], moved.joint_origins[index(name)]) for name in names]
    function = ca.Function("poses", [symbols, system.parameters.symbols], [ca.densify(ca.horzcat(*parts))])
    found = MappedFunction(function, shared_inputs=(1,), use_compiler=False)(q, theta)[0]
    poses = found.reshape(len(q), 3, len(names), 4).transpose(0, 2, 1, 3)
    turned = Rotation.from_matrix(poses[..., :3].reshape(-1, 3, 3)).as_quat().reshape(*poses.shape[:2], 4)
    rows = np.concatenate([_POSITION_SCALE * poses[..., 3], _QUATERNION_SCALE * turned], axis=2)
    return np.rint(rows).astype(int).reshape(len(q), -1).tolist()


@dataclass(frozen=True)
class ConfigurationTrajectory:
    """A trajectory of a model: parameters theta, configurations q (N, n) at times t (N,) [s].

    `acting` lists the applied forces and effects to draw: label, location (joint, segment, grasp or frame), unit and
    values (N, k). Values are vectors in world axes (k = 3) or scalars (k = 1). For an effect k is 0.
    """

    name: str
    system: System
    theta: Array
    t: Array
    q: Array
    acting: Sequence[tuple[str, str, str, Array]] = ()

    def _q_at(self, t: Array) -> Array:
        """Return configurations (F, n) at other times t (F,), interpolated linearly."""
        return np.stack([np.interp(t, self.t, column) for column in self.q.T], axis=1)


def _model_motion(told: ConfigurationTrajectory, t: Array, q: Array) -> _AnimatedMotion:
    """Return joints, tips and points of a system at configurations q (F, n), and the sticks between them."""
    system, tree = told.system, told.system.mechanism
    (symbols, kinematics), names = system.symbols_and_kinematics, tree.joint_names
    owned, origins = _link_radii(system, told.theta), list(kinematics.joint_origins)
    pairs = [(joint.parent_index, j, names[j] in owned) for j, joint in enumerate(tree.joints)]
    points: dict[str, int] = {}
    acting = [_acting_place(system, location) for _, location, *_ in told.acting]
    indices: dict[str | int, int] = {j: j for j in range(len(origins))}
    shown = _shown_frames(system)
    for name in dict.fromkeys([*shown, *(place for place in acting if isinstance(place, str))]):
        frame = tree.frame(name)
        indices[name] = len(origins)
        origins.append(kinematics.frame_position(frame))
        points |= {name: len(origins) - 1} if name in system.point_frames else {}
        if frame.joint_index >= 0 and (name not in acting or name in shown):
            pairs.append((frame.joint_index, len(origins) - 1, names[frame.joint_index] in owned))
    base, inputs = len(origins), [symbols, system.parameters.symbols]
    places = MappedFunction(ca.Function("places", inputs, [ca.horzcat(*origins, ca.SX(3, 1))]), (1,), False)

    def positions(q: Array) -> Array:
        return places(q, told.theta)[0].transpose(0, 2, 1)

    # joints of one link share a position: those that coincide at two configurations
    both = positions(np.stack([np.zeros(system.n_coordinates), np.linspace(0.3, 1.1, system.n_coordinates)]))
    apart = np.linalg.norm(both[:, :, None] - both[:, None], axis=3).max(axis=0)
    first = np.argmax(apart < _MIN_STICK_LENGTH, axis=1).tolist()
    # a robot stands on its base, an object on the ground or in a hand
    known: dict[tuple[int, int], tuple[float, bool]] = {}
    for a, b, own in pairs:
        ends = (first[base if a < 0 else a], first[b])
        if (a >= 0 or not own) and ends[0] != ends[1]:
            # an effect may have added joints between two links
            child = owned.get(names[b] if b < len(names) else names[a], _ARM_RADIUS)
            known[ends] = (owned.get(names[a], child) if own else _ARM_RADIUS, own)
    marked = [-1 if place is None else first[indices[place]] for place in acting]
    kept = sorted({k for ends in known for k in ends} | {first[k] for k in points.values()} | {*marked} - {-1})
    at = {k: i for i, k in enumerate(kept)}
    sticks = [_Stick((at[a], at[b]), radius, own) for (a, b), (radius, own) in known.items()]
    near = np.clip(np.searchsorted(told.t, t, "right") - 1, 0, None)
    acts = zip(told.acting, marked, strict=True)
    marks = [(label, at.get(k, -1), unit, values[near]) for (label, _, unit, values), k in acts]
    named = {name: at[first[k]] for name, k in points.items()}
    return _AnimatedMotion(told.name, sticks, positions(q)[:, kept], named, acting=marks, arm=(system, told.theta, q))


def _acting_place(system: System, location: str) -> str | int | None:
    """Return the joint's index or the frame's name at which a location is drawn, or None if it has no position."""
    if location in system.mechanism.joint_names:
        return system.mechanism.joint_index(location)
    held = {grasp.name: grasp.held_frame for grasp in system.grasps}
    pushed = {layout.name: f"{layout.name}:{_PUSHED_POINT}" for layout in system.segment_layouts}
    for name in (held.get(location), pushed.get(location), location, location.partition(":")[2]):
        with contextlib.suppress(YidError):
            if name:
                system.mechanism.frame(name)
                return name
    return None


def _link_radii(system: System, theta: Array) -> dict[str, float]:
    """Return the radius [m] of the links that each joint of the object carries."""
    tree, layouts = system.mechanism, system.segment_layouts
    evaluate = ca.Function("radii", [system.parameters.symbols], [ca.vertcat(*(layout.radius for layout in layouts))])
    radii = np.array(evaluate(theta)).ravel().tolist() if layouts else []
    carried = [(layout.link_joints, radius) for layout, radius in zip(layouts, radii, strict=True)]
    owned = {joint: radius for links, radius in carried for link in links for joint in link}
    # an effect's frame below the object belongs to it, the robot's hand that carries it does not
    for j, name in reversed(list(enumerate(tree.joint_names))):
        children = [tree.joint_names[k] for k, joint in enumerate(tree.joints) if joint.parent_index == j]
        if "@" in name and children and all(child in owned for child in children):
            owned[name] = owned[children[0]]
    return owned


def _shown_frames(system: System) -> list[str]:
    """Return the frames to draw: tips of links, points of sensors, both sides of grasps, and end frames of arms."""
    tree = system.mechanism
    tips = [f"{layout.name}_{i}_tip" for layout in system.segment_layouts for i in range(len(layout.link_joints))]
    sides = [frame for grasp in system.grasps for frame in (grasp.holder_frame, grasp.held_frame)]
    shown = [*tips, *system.point_frames, *sides]
    busy = {joint.parent_index for joint in tree.joints} | {tree.frame(name).joint_index for name in shown} | {-1}
    hands = [name for name, frame in tree.frames.items() if frame.joint_index not in busy]
    return list(dict.fromkeys([*shown, *hands]))


def animation_of_trajectories(
    title: str,
    trajectories: Sequence[ConfigurationTrajectory],
    recording: Recording | None = None,
    goal: Array | None = None,
) -> AnimationData:
    """Return the animation of model trajectories, of a recording and of a `goal` position (3,) [m], if given.

    The first trajectory sets the times (at most `_MAX_FRAMES`). Recorded points and arms are drawn, too.
    """
    t = _frame_times(trajectories[0].t)
    motions = [_model_motion(entry, t, entry._q_at(t)) for entry in trajectories]
    if goal is not None:
        motions.insert(0, _AnimatedMotion("goal", (), np.tile(goal, (len(t), 1, 1)), {"goal": 0}))
    if recording is not None:
        motions.append(_measured_motion(trajectories[0], recording, t))
    return AnimationData(title, t, tuple(motions))


def measured_motion_animation(
    title: str, system: System, theta: Array, recording: Recording, has_straight_object: bool = False
) -> list[AnimationData]:
    """Return a list with the animation of a recording without predictions, empty if the recording has no positions.

    With `has_straight_object`, the model at the recorded angles is drawn, too, with an undeformed object.
    """
    clock = max((group.t for group in recording.joint_and_point_groups), key=len)
    told = ConfigurationTrajectory("measured", system, theta, clock, np.zeros((len(clock), system.n_coordinates)))
    motion = _measured_motion(told, recording, t := _frame_times(clock))
    if not (motion.sticks or motion.point_indices):
        return []
    if not has_straight_object:
        return [AnimationData(title, t, (motion,))]
    unbent = replace(told, name="undeformed model at the recorded angles")
    return [AnimationData(title, t, (_model_motion(unbent, t, _with_recorded_angles(told, recording, t)), motion))]


def _with_recorded_angles(told: ConfigurationTrajectory, recording: Recording, t: Array) -> Array:
    """Return configurations (F, n) at times t (F,), with the recorded joint angles."""
    q, joints = told._q_at(t), recording.joints
    if joints is not None:
        for name in [name for name in joints.names if name in told.system.mechanism.joint_names]:
            column = joints.position[:, joints.names.index(name)]
            q[:, told.system.mechanism.joint_index(name)] = np.interp(t, joints.t, column)
    return q


def _measured_motion(told: ConfigurationTrajectory, recording: Recording, t: Array) -> _AnimatedMotion:
    """Return recorded arms and points at times t (F,). A point is shown up to half a sample period from its sample."""
    system, joints = told.system, recording.joints
    moved, sticks = {*system.driven, *system.prescribed}, list[_Stick]()
    places, arm = np.full((len(t), 0, 3), np.nan), None
    if joints is not None and joints.position is not None and moved and moved <= {*joints.names}:
        moved_arms = _model_motion(replace(told, acting=()), t, _with_recorded_angles(told, recording, t))
        sticks, places = [own for own in moved_arms.sticks if not own.is_object_part], moved_arms.positions
        arm = moved_arms.arm
    seen, fresh = dict[str, Array](), dict[str, BoolArray]()
    for group in recording.points:
        near = np.ceil(np.interp(t, group.t, np.arange(len(group.t))) - 0.5).astype(int)
        period, own_period = median_sample_period(t), median_sample_period(group.t)
        apart = np.abs(group.t[near] - t) - _TIME_TOLERANCE
        after = np.searchsorted(group.t, t).clip(max=len(group.t) - 1)
        is_ordinary = group.t[after] - group.t[after - 1] <= _MAX_ORDINARY_GAP * own_period
        for i, name in enumerate(group.names):
            own = np.where((apart <= max(own_period, period) / 2)[:, None], group.position[near, i], np.nan)
            now = (apart <= period / 2) & np.isfinite(own).all(axis=1)
            # a frame between two measurements compares the model with the motion between them
            between = np.stack([np.interp(t, group.t, column) for column in group.position[:, i].T], axis=1)
            own = np.where((now & is_ordinary)[:, None] & np.isfinite(between), between, own)
            fresh[name] = now | fresh.get(name, False)
            seen[name] = own if name not in seen else np.where(np.isfinite(seen[name]), seen[name], own)
    indices = {name: places.shape[1] + i for i, name in enumerate(seen)}
    places = np.concatenate([places, *(own[:, None] for own in seen.values())], axis=1)
    now_measured = np.stack(list(fresh.values()), axis=1) if fresh else None
    return _AnimatedMotion("measured", sticks, places, indices, now_measured, arm=arm)


def _frame_times(t: Array) -> Array:
    return t[np.unique(np.linspace(0, len(t) - 1, min(len(t), _MAX_FRAMES)).round().astype(np.int64))]

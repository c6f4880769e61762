"""Animation data: stick figures and points of arms and object over time, measured and predicted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any

import casadi as ca
import numpy as np

from yid_ocp.arrays import Array, BoolArray
from yid_ocp.data.recording import Recording
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.system import System

_MAX_FRAMES = 150  # moments of a motion that a page holds; between two it goes straight
_ARM_RADIUS = 0.03  # how thick an arm is drawn [m]
_POSITION_SCALE = 1e4  # places are kept as whole numbers of a tenth of a millimetre
_MIN_STICK_LENGTH, _TIME_TOLERANCE = 1e-6, 1e-9  # what counts as one place [m], as one time [s]


@dataclass(frozen=True)
class _Stick:
    """A straight line between two positions, of an arm or of the object; its radius in m."""

    end_indices: tuple[int, int]
    radius: float
    is_object_part: bool


@dataclass(frozen=True)
class _AnimatedMotion:
    """Motion of one stick figure, measured or predicted.

    `positions` (F, K, 3) [m] are NaN where nothing is known; `point_indices` names those that a sensor sees;
    `is_new_measurement` (F, number of points) tells those measured at that moment from those held until the next one.
    """

    name: str
    sticks: Sequence[_Stick]
    positions: Array
    point_indices: Mapping[str, int]
    is_new_measurement: BoolArray | None = None

    def to_dict(self) -> dict[str, Any]:
        fresh, places = self.is_new_measurement, self.positions.reshape(len(self.positions), -1)
        return {
            "name": self.name,
            "sticks": [[*own.end_indices, round(own.radius, 4), int(own.is_object_part)] for own in self.sticks],
            "points": dict(self.point_indices),
            "fresh": None if fresh is None else fresh.astype(int).tolist(),
            "places": [[round(_POSITION_SCALE * x) if isfinite(x) else None for x in row] for row in places.tolist()],
        }


@dataclass(frozen=True)
class Animation:
    """Several motions on a common time axis t (F,) [s], for one animation."""

    title: str
    t: Array
    motions: tuple[_AnimatedMotion, ...]

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready data for the page's script: integers in units of 0.1 mm, null where unknown."""
        t = [round(float(t), 4) for t in self.t]
        motions = [motion.to_dict() for motion in self.motions]
        return {"title": self.title, "t": t, "scale": _POSITION_SCALE, "motions": motions}


@dataclass(frozen=True)
class ConfigurationTrajectory:
    """Trajectory of a model: configurations q (N, n) at times t (N,) [s]."""

    name: str
    system: System
    theta: Array
    t: Array
    q: Array

    def _q_at(self, t: Array) -> Array:
        """Configurations (F, n) at other times, on straight lines between the known ones."""
        return np.stack([np.interp(t, self.t, column) for column in self.q.T], axis=1)


def _model_motion(told: ConfigurationTrajectory, q: Array) -> _AnimatedMotion:
    """Joints, tips and points of a system at configurations q (F, n), and the lines between them."""
    system, tree = told.system, told.system.mechanism
    symbols, names, owned = ca.SX.sym("q", system.n_coordinates), tree.joint_names, _link_radii(system, told.theta)
    kinematics = forward_kinematics(tree, symbols)
    origins = list(kinematics.joint_origins)
    pairs = [(joint.parent_index, j, names[j] in owned) for j, joint in enumerate(tree.joints)]
    points: dict[str, int] = {}
    for name in _shown_frames(system):
        frame = tree.frame(name)
        origins.append(kinematics.frame_position(frame))
        points |= {name: len(origins) - 1} if name in system.point_frames else {}
        if frame.joint_index >= 0:
            pairs.append((frame.joint_index, len(origins) - 1, names[frame.joint_index] in owned))
    base = len(origins)
    places = ca.Function("places", [symbols, system.parameters.symbols], [ca.horzcat(*origins, ca.SX(3, 1))])

    def positions(q: Array) -> Array:
        stacked = np.array(places.map(len(q))(q.T, np.tile(told.theta[:, None], (1, len(q)))))
        return stacked.T.reshape(len(q), -1, 3)

    # joints of one link share a place: those that are together at two postures
    both = positions(np.stack([np.zeros(system.n_coordinates), np.linspace(0.3, 1.1, system.n_coordinates)]))
    apart = np.linalg.norm(both[:, :, None] - both[:, None], axis=3).max(axis=0)
    first = np.argmax(apart < _MIN_STICK_LENGTH, axis=1).tolist()
    # a robot stands on its base, an object on the ground or in a hand
    known: dict[tuple[int, int], tuple[float, bool]] = {}
    for a, b, own in pairs:
        ends = (first[base if a < 0 else a], first[b])
        if (a >= 0 or not own) and ends[0] != ends[1]:
            # an effect may have put joints between two links
            child = owned.get(names[b] if b < len(names) else names[a], _ARM_RADIUS)
            known[ends] = (owned.get(names[a], child) if own else _ARM_RADIUS, own)
    kept = sorted({k for ends in known for k in ends} | {first[k] for k in points.values()})
    at = {k: i for i, k in enumerate(kept)}
    sticks = [_Stick((at[a], at[b]), radius, own) for (a, b), (radius, own) in known.items()]
    return _AnimatedMotion(told.name, sticks, positions(q)[:, kept], {name: at[first[k]] for name, k in points.items()})


def _link_radii(system: System, theta: Array) -> dict[str, float]:
    """Radius of what each joint of the object carries [m]."""
    tree, layouts = system.mechanism, system.segment_layouts
    evaluate = ca.Function("radii", [system.parameters.symbols], [ca.vertcat(*(layout.radius for layout in layouts))])
    radii = np.array(evaluate(theta)).ravel().tolist() if layouts else []
    carried = [(layout.link_joints, radius) for layout, radius in zip(layouts, radii, strict=True)]
    owned = {joint: radius for links, radius in carried for link in links for joint in link}
    # what an effect put below the object is part of it, a robot's hand that carries it is not
    for j, name in reversed(list(enumerate(tree.joint_names))):
        children = [tree.joint_names[k] for k, joint in enumerate(tree.joints) if joint.parent_index == j]
        if "@" in name and children and all(child in owned for child in children):
            owned[name] = owned[children[0]]
    return owned


def _shown_frames(system: System) -> list[str]:
    """Tips of links, points of sensors, both sides of grasps, and frames at the ends of the arms."""
    tree = system.mechanism
    tips = [f"{layout.name}_{i}_tip" for layout in system.segment_layouts for i in range(len(layout.link_joints))]
    sides = [frame for grasp in system.grasps for frame in (grasp.holder_frame, grasp.held_frame)]
    shown = [*tips, *system.point_frames, *sides]
    busy = {joint.parent_index for joint in tree.joints} | {tree.frame(name).joint_index for name in shown} | {-1}
    hands = [name for name, frame in tree.frames.items() if frame.joint_index not in busy]
    return list(dict.fromkeys([*shown, *hands]))


def animation_of_trajectories(
    title: str, told: Sequence[ConfigurationTrajectory], recording: Recording | None = None
) -> Animation:
    """Animation of model trajectories and of the recorded motion; the first trajectory sets the times and joints.

    Of a recording its points are shown, and its arms where it recorded their angles; at most `_MAX_FRAMES` frames.
    """
    t = _frame_times(told[0].t)
    motions = [_model_motion(entry, entry._q_at(t)) for entry in told]
    if recording is not None:
        motions.append(_measured_motion(told[0], recording, t))
    return Animation(title, t, tuple(motions))


def recording_animation(
    title: str, system: System, theta: Array, recording: Recording, has_straight_object: bool = False
) -> Animation | None:
    """Animation of a recording alone; None where it holds no positions.

    With `has_straight_object` beside it the model on the recorded angles, its object and marked frames as unbent.
    """
    clock = max((group.t for group in recording.joint_and_point_groups), key=len)
    told = ConfigurationTrajectory("measured", system, theta, clock, np.zeros((len(clock), system.n_coordinates)))
    motion = _measured_motion(told, recording, t := _frame_times(clock))
    if not (motion.sticks or motion.point_indices):
        return None
    if not has_straight_object:
        return Animation(title, t, (motion,))
    unbent = replace(told, name="model on the recorded angles, nothing bent")
    return Animation(title, t, (_model_motion(unbent, _with_recorded_angles(told, recording, t)), motion))


def _with_recorded_angles(told: ConfigurationTrajectory, recording: Recording, t: Array) -> Array:
    """Configurations (F, n) at times t, with the angles that were recorded."""
    q, joints = told._q_at(t), recording.joints
    for name, column in () if joints is None else zip(joints.names, joints.position.T, strict=True):
        if name in told.system.mechanism.joint_names:
            assert joints is not None
            q[:, told.system.mechanism.joint_index(name)] = np.interp(t, joints.t, column)
    return q


def _measured_motion(told: ConfigurationTrajectory, recording: Recording, t: Array) -> _AnimatedMotion:
    """Recorded arms and points at times t; a point stays for half a period after it was measured."""
    system, joints = told.system, recording.joints
    moved = {*system.driven, *system.prescribed}
    sticks: list[_Stick] = []
    places = np.full((len(t), 0, 3), np.nan)
    if joints is not None and joints.position is not None and moved and moved <= {*joints.names}:
        moved_arms = _model_motion(told, _with_recorded_angles(told, recording, t))
        sticks, places = [own for own in moved_arms.sticks if not own.is_object_part], moved_arms.positions
    seen: dict[str, Array] = {}
    fresh: dict[str, BoolArray] = {}
    for group in recording.points:
        near = np.ceil(np.interp(t, group.t, np.arange(len(group.t))) - 0.5).astype(int)
        apart, period = np.abs(group.t[near] - t) - _TIME_TOLERANCE, max(_spacing(group.t), _spacing(t))
        for i, name in enumerate(group.names):
            own = np.where((apart <= period / 2)[:, None], group.position[near, i], np.nan)
            now = (apart <= _spacing(t) / 2) & np.isfinite(own).all(axis=1)
            fresh[name] = now | fresh.get(name, False)
            seen[name] = own if name not in seen else np.where(np.isfinite(seen[name]), seen[name], own)
    indices = {name: places.shape[1] + i for i, name in enumerate(seen)}
    places = np.concatenate([places, *(own[:, None] for own in seen.values())], axis=1)
    now_measured = np.stack(list(fresh.values()), axis=1) if fresh else None
    return _AnimatedMotion("measured", sticks, places, indices, now_measured)


def _spacing(t: Array) -> float:
    return float(np.median(np.diff(t))) if len(t) > 1 else 0.0


def _frame_times(t: Array) -> Array:
    return t[np.unique(np.linspace(0, len(t) - 1, min(len(t), _MAX_FRAMES)).round().astype(np.int64))]

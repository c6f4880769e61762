"""Animation data: stick figures and points of arms and object over time, measured and predicted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.system import System

Array = NDArray[np.float64]
_MAX_FRAMES = 150  # moments of a motion that a page holds; between two it goes straight
_ARM_RADIUS = 0.03  # how thick an arm is drawn [m]
_POSITION_SCALE = 1e4  # places are kept as whole numbers of a tenth of a millimetre
_MIN_STICK_LENGTH, _TIME_TOLERANCE = 1e-6, 1e-9  # what counts as one place [m], as one time [s]


@dataclass(frozen=True)
class Stick:
    """A straight line between two positions of a stick figure.

    Attributes
    ----------
    radius : float
        [m]
    is_object_part : bool
        Whether it belongs to the object, not to an arm.
    """

    end_indices: tuple[int, int]
    radius: float
    is_object_part: bool


@dataclass(frozen=True)
class AnimatedMotion:
    """Motion of one stick figure, measured or predicted.

    Attributes
    ----------
    name : str
        `measured`, `predicted`, ...
    positions : ndarray, shape (F, K, 3)
        [m]; NaN where nothing is known.
    point_indices : mapping of str to int
        Places that a sensor sees.
    is_new_measurement : ndarray, shape (F, number of points)
        Whether a point was measured at that moment, and is not only held until the next measurement.
    """

    name: str
    sticks: tuple[Stick, ...]
    positions: Array
    point_indices: Mapping[str, int] = field(default_factory=dict)
    is_new_measurement: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class Animation:
    """Several motions on a common time axis, for one animation.

    Attributes
    ----------
    t : ndarray, shape (F,)
        [s]
    """

    title: str
    t: Array
    motions: tuple[AnimatedMotion, ...]

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready data for the page's script: integers in units of 0.1 mm, null where unknown."""
        return {
            "title": self.title,
            "t": [round(float(t), 4) for t in self.t],
            "scale": _POSITION_SCALE,
            "motions": [
                {
                    "name": motion.name,
                    "sticks": [
                        [*stick.end_indices, round(stick.radius, 4), int(stick.is_object_part)]
                        for stick in motion.sticks
                    ],
                    "points": dict(motion.point_indices),
                    "fresh": None
                    if motion.is_new_measurement is None
                    else motion.is_new_measurement.astype(int).tolist(),
                    "places": [_whole(places) for places in motion.positions],
                }
                for motion in self.motions
            ],
        }


class StickFigure:
    """Stick figure of a system: positions of joints, tips and points, and the lines between them.

    Parameters
    ----------
    theta : ndarray, shape (ntheta,)
    """

    def __init__(self, system: System, theta: Array) -> None:
        tree = system.mechanism
        q = ca.SX.sym("q", system.n_coordinates)
        kinematics = forward_kinematics(tree, q)
        origins, names = list(kinematics.joint_origins), list(tree.joint_names)
        radii = [float(x) for x in _numbers(system, [layout.radius for layout in system.segment_layouts], theta)]
        owned = {
            joint: r
            for layout, r in zip(system.segment_layouts, radii, strict=True)
            for link in layout.link_joints
            for joint in link
        }
        # what an effect put below the object is part of it, a robot's hand that carries it is not
        for j in reversed(range(len(names))):
            children = [names[k] for k, joint in enumerate(tree.joints) if joint.parent_index == j]
            if "@" in names[j] and children and all(child in owned for child in children):
                owned[names[j]] = owned[children[0]]
        pairs = [(joint.parent_index, j, names[j] in owned) for j, joint in enumerate(tree.joints)]
        ends = [f"{layout.name}_{i}_tip" for layout in system.segment_layouts for i in range(len(layout.link_joints))]
        shown = [
            *ends,
            *system.point_frames,
            *(frame for grasp in system.grasps for frame in (grasp.holder_frame, grasp.held_frame)),
        ]
        carried = {joint.parent_index for joint in tree.joints}
        last = {frame.joint_index for name in shown for frame in (tree.frame(name),)}
        hands = [
            n for n, frame in tree.frames.items() if frame.joint_index not in carried | last and frame.joint_index >= 0
        ]
        points: dict[str, int] = {}
        for name in dict.fromkeys([*shown, *hands]):
            frame = tree.frame(name)
            origins.append(kinematics.frame_position(frame))
            points |= {name: len(origins) - 1} if name in system.point_frames else {}
            if frame.joint_index >= 0:
                pairs.append((frame.joint_index, len(origins) - 1, names[frame.joint_index] in owned))
        base = len(origins)
        origins.append(ca.SX(3, 1))
        places = ca.Function("places", [q, system.parameters.symbols], [ca.horzcat(*origins)])
        # joints of one link share a place: those that are together at two postures
        both = [np.array(places(posture, theta)) for posture in (0.0, np.linspace(0.3, 1.1, system.n_coordinates))]
        same = np.linalg.norm(both[0][:, :, None] - both[0][:, None], axis=0)
        same = np.maximum(same, np.linalg.norm(both[1][:, :, None] - both[1][:, None], axis=0))
        first = np.argmax(same < _MIN_STICK_LENGTH, axis=1)
        # a robot stands on its base, an object on the ground or in a hand
        known = {}
        for a, b, own in pairs:
            if a >= 0 or not own:
                # an effect may have put joints between two links
                child = owned.get(names[b] if b < len(names) else names[a], _ARM_RADIUS)
                radius = owned.get(names[a], child) if own else _ARM_RADIUS
                known[int(first[base if a < 0 else a]), int(first[b])] = (radius, own)
        known = {ends: told for ends, told in known.items() if ends[0] != ends[1]}
        kept = sorted({*(k for ends in known for k in ends), *(int(first[k]) for k in points.values())})
        at = {k: i for i, k in enumerate(kept)}
        self.point_indices = {name: at[int(first[k])] for name, k in points.items()}
        self.sticks = tuple(Stick((at[a], at[b]), radius, own) for (a, b), (radius, own) in known.items())
        self._theta = theta
        self._places = ca.Function("kept", [q, system.parameters.symbols], [ca.horzcat(*(origins[k] for k in kept))])

    def positions_at(self, q: Array) -> Array:
        """Positions of all end points at configurations q (F, n), shape (F, K, 3) [m]."""
        stacked = np.array(self._places.map(len(q))(q.T, np.tile(self._theta[:, None], (1, len(q)))))
        return stacked.T.reshape(len(q), -1, 3)

    @property
    def arm_sticks(self) -> tuple[Stick, ...]:
        """The sticks of the robot arms."""
        return tuple(stick for stick in self.sticks if not stick.is_object_part)


@dataclass(frozen=True)
class ModelTrajectory:
    """Trajectory of a model: configurations q (N, n) at times t (N,) [s]."""

    name: str
    system: System
    theta: Array
    t: Array
    q: Array


def make_animation(title: str, told: Sequence[ModelTrajectory], recording: Recording | None = None) -> Animation:
    """Animation of model trajectories and the recorded motion, with at most `_MAX_FRAMES` frames.

    Parameters
    ----------
    told : sequence of ModelTrajectory
        At least one; the first fixes the clock and the joints.
    recording : Recording, optional
        Its points, and its arms where it recorded their angles.
    """
    first = told[0]
    t = first.t[_chosen(len(first.t))]
    motions = []
    for entry in told:
        skeleton = StickFigure(entry.system, entry.theta)
        q = np.stack([np.interp(t, entry.t, column) for column in entry.q.T], axis=1)
        motions.append(AnimatedMotion(entry.name, skeleton.sticks, skeleton.positions_at(q), skeleton.point_indices))
    if recording is not None:
        motions.append(_measured(first, recording, t))
    return Animation(title, t, tuple(motions))


def recording_animation(title: str, system: System, theta: Array, recording: Recording) -> Animation | None:
    """Animation of a recording alone; None where it holds no positions."""
    clock = recording.groups[0].t
    for group in recording.groups:
        clock = group.t if len(group.t) > len(clock) else clock
    told = ModelTrajectory("measured", system, theta, clock, np.zeros((len(clock), system.n_coordinates)))
    t = clock[_chosen(len(clock))]
    motion = _measured(told, recording, t)
    return Animation(title, t, (motion,)) if motion.sticks or motion.point_indices else None


def _measured(told: ModelTrajectory, recording: Recording, t: Array) -> AnimatedMotion:
    """Recorded arms and points at times t."""
    system, joints = told.system, recording.joints
    recorded = [] if joints is None else [name for name in joints.names if name in system.mechanism.joint_names]
    moved = {*system.driven, *system.prescribed}
    skeleton, places = StickFigure(system, told.theta), np.full((len(t), 0, 3), np.nan)
    sticks: tuple[Stick, ...] = ()
    if joints is not None and moved and moved <= {*recorded} and joints.position is not None:
        q = np.stack([np.interp(t, told.t, column) for column in told.q.T], axis=1)
        for name in recorded:
            q[:, system.mechanism.joint_index(name)] = _at(joints, name, t)
        sticks, places = skeleton.arm_sticks, skeleton.positions_at(q)
    seen: dict[str, Array] = {}
    fresh: dict[str, NDArray[np.bool_]] = {}
    for group in recording.points:
        near, apart = _nearest(group.t, t)
        longest = (
            max(float(np.median(np.diff(group.t))) if len(group.t) > 1 else 0.0, _spacing(t)) / 2 + _TIME_TOLERANCE
        )
        for i, name in enumerate(group.names):
            own = np.where((apart <= longest)[:, None], group.position[near, i], np.nan)
            now = (apart <= _spacing(t) / 2 + _TIME_TOLERANCE) & np.isfinite(own).all(axis=1)
            fresh[name] = now | fresh.get(name, np.zeros(len(t), bool))
            seen[name] = own if name not in seen else np.where(np.isfinite(seen[name]), seen[name], own)
    first = places.shape[1]
    if seen:
        places = np.concatenate([places, np.stack(list(seen.values()), axis=1)], axis=1)
    known = np.stack(list(fresh.values()), axis=1) if fresh else None
    return AnimatedMotion("measured", sticks, places, {name: first + i for i, name in enumerate(seen)}, known)


def _at(joints: JointGroup, name: str, t: Array) -> Array:
    return np.interp(t, joints.t, joints.position[:, joints.names.index(name)])


def _nearest(clock: Array, t: Array) -> tuple[NDArray[np.int64], Array]:
    """Index of the sample nearest to each time, and how far it is."""
    after = np.searchsorted(clock, t).clip(1, max(len(clock) - 1, 1))
    before = after - 1
    near = np.where(np.abs(clock[np.minimum(after, len(clock) - 1)] - t) < np.abs(clock[before] - t), after, before)
    near = np.minimum(near, len(clock) - 1)
    return near, np.abs(clock[near] - t)


def _spacing(t: Array) -> float:
    return float(np.median(np.diff(t))) if len(t) > 1 else 0.0


def _chosen(count: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, count - 1, min(count, _MAX_FRAMES)).round().astype(np.int64))


def _numbers(system: System, expressions: Sequence[ca.SX], theta: Array) -> Array:
    if not expressions:
        return np.zeros(0)
    evaluate = ca.Function("numbers", [system.parameters.symbols], [ca.vertcat(*expressions)])
    return np.array(evaluate(theta)).ravel()


def _whole(places: Array) -> list[int | None]:
    return [round(_POSITION_SCALE * float(x)) if np.isfinite(x) else None for x in places.ravel()]

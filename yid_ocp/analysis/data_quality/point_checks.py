"""Checks of measured points against a model: mirrored, exchanged, scaled, delayed or out of reach."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import scipy.interpolate
from numpy.typing import NDArray

from yid_ocp.analysis.data_quality.clock_synchronization import (
    PositionFunction,
    check_held_point_clock,
    search_clock_error,
    timestamp_correction,
)
from yid_ocp.analysis.data_quality.recorded_joints import RecordedJointsModel, effect_setting_line
from yid_ocp.data.issues import Issue, Severity, median_sample_period
from yid_ocp.data.recording import PointGroup, Recording
from yid_ocp.model.objects.base import CableTopology
from yid_ocp.model.system import System
from yid_ocp.problem.episodes import Episode, EpisodePrediction
from yid_ocp.sensors.base import SensorUsage

Array = NDArray[np.float64]
_SensorChoices = Callable[[str], SensorUsage]

_HELD_POINT_TOLERANCE = 0.01
"""How far a point may be from where the arm holds it: what calibration and a tool's measures leave [m]."""
_MAX_OBJECT_ERROR_FRACTION = 0.25
"""Part of the object's length by which points may be elsewhere than a model with unknown stiffness says."""
_MAX_REMAINING_FRACTION = 0.5
"""A change explains points where it leaves less than this part of their distance."""
_UNIT_SCALES = (1e-3, 1e-2, 0.0254, 0.1, 0.3048, 1 / 0.3048, 10.0, 1 / 0.0254, 100.0, 1e3)
"""By what lengths are wrong that are in another unit, or read so, and a power of ten for what was typed wrongly."""
_MIN_CLOCK_OFFSET = 0.05
"""Offset between two clocks that explains points far from where they should be [s]."""
_PATH_SAMPLE_RATE = 50.0
"""Rate at which the way of the held points is worked out; splines join what lies between [Hz]."""
_LENGTH_RTOL = 0.2
"""Part by which lengths that cannot change may seem to."""


@dataclass(frozen=True)
class _Change:
    """What would have to be done to measured points, and how far they then are from the model [m]."""

    cause: str
    words: str
    advice: str
    error: float
    setting: str = ""
    channel: str = ""


# -- points that the arm holds ----------------------------------------------------------------------------------------


def _held_point_frames(system: System, group: PointGroup, choice: SensorUsage) -> dict[str, str]:
    """Model frame that each point of a group marks; for a grasped point, the frame of the arm that holds it."""
    holders = {grasp.held_frame: grasp.holder_frame for grasp in system.grasps}
    wanted = group.names if choice.points is None else choice.points
    frames = {name: choice.frames.get(name, name) for name in wanted if name in group.names}
    frames = {name: holders.get(frame, frame) for name, frame in frames.items()}
    return {name: frame for name, frame in frames.items() if system.mechanism.has_frame(frame)}


def check_held_points(arm: RecordedJointsModel, recording: Recording, choice: _SensorChoices) -> Iterator[Issue]:
    """Issues of points whose positions disagree with the forward kinematics of the recorded angles."""
    joints = recording.joints
    if joints is None or median_sample_period(joints.t) <= 0:
        return
    for group in recording.points:
        frames = {
            name: frame
            for name, frame in _held_point_frames(arm.system, group, choice(group.name)).items()
            if arm.is_frame_determined(frame)
            and arm.system.mechanism.ancestor_joints(arm.system.mechanism.frame(frame).joint_index)
        }
        inside = (group.t >= joints.t[0]) & (group.t <= joints.t[-1])
        if not frames or inside.sum() < 3:
            continue
        rows = np.flatnonzero(inside)[:: max(1, int(inside.sum()) // 200)]
        columns = [group.names.index(name) for name in frames]
        seen, t = group.position[rows][:, columns], group.t[rows]
        course = scipy.interpolate.CubicSpline(
            joints.t, joints.position[:, [joints.names.index(n) for n in arm.joint_names]], axis=0
        )
        place, by_angle = arm.frame_positions(tuple(frames.values()), course(t))
        error = _rms(seen - place)
        noise = _noise(group)
        knots = float(joints.t[0]), float(joints.t[-1])
        dense = np.linspace(*knots, int(np.clip(_PATH_SAMPLE_RATE * (knots[1] - knots[0]), 400, 20_000)))
        path = scipy.interpolate.CubicSpline(
            dense, arm.frame_positions(tuple(frames.values()), course(dense))[0], axis=0
        )
        if not error > max(_HELD_POINT_TOLERANCE, 5 * noise):
            for doubt in check_held_point_clock(joints, group, t, seen, by_angle, noise, path):
                yield replace(doubt, recording=recording.name)
            continue
        changes = [
            *_changed_lengths(seen, place),
            *_changed_names(seen, place, tuple(frames)),
            *_changed_times(path, knots, t, seen),
            *_changed_zeros(arm, tuple(frames.values()), course(t), seen, (place, by_angle)),
            *_moved(seen, place),
        ]
        yield _explained(
            changes, error, max(_HELD_POINT_TOLERANCE, 5 * noise), recording.name, group.name, "point_unlike"
        )


def _explained(
    changes: Sequence[_Change], error: float, allowed: float, recording: str, group: str, otherwise: str
) -> Issue:
    """The doubt that the change which explains most stands for; the first of those that do equally well."""
    best = min((change.error for change in changes), default=math.inf)
    chosen = next(
        (c for c in changes if c.error <= max(1.3 * best, allowed) and c.error < _MAX_REMAINING_FRACTION * error), None
    )
    weight: Severity = "not_trusted"
    if chosen is None:
        what = f"points are {error:.3g} m (rms) from where the model has them, and no simple change explains it"
        advice = "check the frame of the points, their names and the robot's description"
        return Issue(otherwise, what, weight, error / allowed, advice, recording, group)
    what = f"points are {error:.3g} m (rms) from where the model has them; {chosen.words} it is {chosen.error:.2g} m"
    return Issue(
        chosen.cause,
        what,
        weight,
        error / allowed,
        chosen.advice,
        recording,
        "joints" if chosen.channel else group,
        chosen.channel,
        setting=chosen.setting,
    )


def _noise(group: PointGroup) -> float:
    """Typical standard deviation that the recording gives to its points [m]."""
    known = np.zeros(0) if group.std is None else group.std[np.isfinite(group.std)]
    return float(np.median(known)) if len(known) else 0.0


def _rms(difference: Array) -> float:
    """Root mean square distance of points, of those that were seen; NaN for none."""
    square = np.sum(difference**2, axis=-1)
    return float(np.sqrt(np.nanmean(square))) if np.any(np.isfinite(square)) else math.nan


def _changed_lengths(seen: Array, place: Array) -> Iterator[_Change]:
    """Another unit, axes exchanged or turned, about the origin of the world; and both."""
    for scale in _UNIT_SCALES:
        words = f"divided by {scale:g}"
        yield _Change("point_scale", words, f"divide positions by {scale:g}", _rms(seen / scale - place))
    best: dict[float, _Change] = {}
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            axes = ", ".join(("" if s > 0 else "-") + "xyz"[i] for i, s in zip(order, signs, strict=True))
            if axes == "x, y, z":
                continue
            turned = seen[..., list(order)] * np.array(signs)
            mirror = np.linalg.det(np.eye(3)[list(order)] * np.array(signs)[:, None]) < 0
            words = f"with ({axes}) for (x, y, z){', a mirror image,' if mirror else ''}"
            error = _rms(turned - place)
            best[error] = _Change("point_mirrored", words, f"use ({axes}) for (x, y, z)", error)
    yield best[min(best)]


def _changed_names(seen: Array, place: Array, names: Sequence[str]) -> Iterator[_Change]:
    for i, j in itertools.combinations(range(len(names)), 2):
        order = list(range(len(names)))
        order[i], order[j] = j, i
        words = f"with {names[i]} and {names[j]} exchanged"
        advice = f"exchange the names of {names[i]} and {names[j]}"
        yield _Change("point_swapped", words, advice, _rms(seen[:, order] - place))


def _changed_times(path: PositionFunction, knots: tuple[float, float], t: Array, seen: Array) -> Iterator[_Change]:
    """Points recorded earlier or later than the angles, or by a clock that runs faster or more slowly."""
    before, middle = _rms(seen - path(t)), 0.5 * (t[0] + t[-1])

    def left(late: float, drift: float) -> float:
        at = t - late - drift * (t - middle)
        inside = (at >= knots[0]) & (at <= knots[1])
        return _rms(seen[inside] - path(at[inside]))

    late, _ = search_clock_error(path, knots, t, seen)
    error = left(late, 0.0)
    # of a search over so many times some always fits better
    if abs(late) >= _MIN_CLOCK_OFFSET and error < 0.5 * _MAX_REMAINING_FRACTION * before:
        words, advice = f"taken {late:+.3g} s from the joints", f"subtract {late:.3g} s from their times"
        yield _Change("clock_offset", words, advice, error)
        return
    late, drift = search_clock_error(path, knots, t, seen, drifts=True)
    error = left(late, drift)
    if abs(drift) * (t[-1] - t[0]) >= _MIN_CLOCK_OFFSET and error < 0.5 * _MAX_REMAINING_FRACTION * before:
        words = f"taken {late:+.3g} s from the joints, by a clock that runs {1e3 * drift:+.3g} parts per thousand fast,"
        yield _Change("clock_drift", words, timestamp_correction(late, drift, middle), error)


def _changed_zeros(
    arm: RecordedJointsModel, frames: tuple[str, ...], q: Array, seen: Array, here: tuple[Array, Array]
) -> Iterator[_Change]:
    """One joint whose zero is off, by Gauss and Newton."""
    found = []
    for j, name in enumerate(arm.joint_names):
        offset, (place, by_angle) = 0.0, here
        for _ in range(3):
            slope, left = by_angle[..., j], seen - place
            good = np.isfinite(left)
            power = float(np.sum(slope[good] ** 2))
            if power < 1e-12:
                break
            offset += float(np.sum(slope[good] * left[good])) / power
            moved = q.copy()
            moved[:, j] += offset
            place, by_angle = arm.frame_positions(frames, moved)
        else:
            setting = effect_setting_line("encoder_offset", name, "offset", -offset)
            words, advice = f"with {offset:+.3g} rad more at {name}", f"set the zero of {name}, or let it be estimated"
            found.append(_Change("encoder_offset", words, advice, _rms(seen - place), setting, f"position.{name}"))
    yield from sorted(found, key=lambda change: change.error)[:1]


def _moved(seen: Array, place: Array) -> Iterator[_Change]:
    """Another frame: a shift, then a turn as well (Kabsch, Acta Cryst. A32:922, doi:10.1107/S0567739476001873)."""
    good = np.isfinite(seen).all(axis=-1)
    a, b = seen[good], place[good]
    if len(a) < 4:
        return
    shift = b.mean(axis=0) - a.mean(axis=0)
    words = "shifted by ({:.3g}, {:.3g}, {:.3g}) m".format(*shift)
    yield _Change("point_frame", words, f"give positions in the robot's frame: {words}", _rms(a + shift - b))
    u, _, v = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
    turn = (u * [1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v
    left = _rms((a - a.mean(axis=0)) @ turn + b.mean(axis=0) - b)
    angle = math.degrees(math.acos(float(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    words = f"turned by {angle:.3g} degrees and shifted"
    yield _Change("point_frame", words, f"give positions in the robot's frame: {words}", left)


# -- points of the object ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Way:
    """From a frame down its chain: distance to every joint's origin, as far as the chain is neither known nor fixed.

    `root` is the last of these joints; its origin is fixed in the world, or on the arm.
    """

    distance: Mapping[int, float]
    root: int


def _way(arm: RecordedJointsModel | None, system: System, theta: Array, frame: str) -> _Way | None:
    """None for a frame that is fixed or known, or that slides."""
    mechanism, known = system.mechanism, set() if arm is None else set(arm.joint_indices)
    entry = mechanism.frame(frame)
    chain = [i for i in mechanism.ancestor_joints(entry.joint_index) if i not in known]
    if not chain or any(mechanism.joints[i].kind == "prismatic" for i in chain):
        return None
    steps = [entry.placement.translation, *(mechanism.joints[i].placement.translation for i in reversed(chain[1:]))]
    function = ca.Function("steps", [system.parameters.symbols], [ca.norm_2(step) for step in steps])
    try:
        lengths = [float(x) for x in function.call([theta])]
    except RuntimeError:  # an effect's internal coordinate
        return None
    total = np.cumsum(lengths)
    return _Way({i: float(d) for i, d in zip(reversed(chain), total, strict=True)}, chain[0])


def check_point_distances(
    arm: RecordedJointsModel | None, system: System, theta: Array, recording: Recording, choice: _SensorChoices
) -> Iterator[Issue]:
    """Issues of object points that are farther from the root or from each other than the length along the object.

    The object bends but does not stretch.
    """
    mechanism = system.mechanism
    for group in recording.points:
        said = choice(group.name)
        frames = {n: said.frames.get(n, n) for n in (said.points or group.names) if n in group.names}
        ways = {n: _way(arm, system, theta, f) for n, f in frames.items() if mechanism.has_frame(f)}
        noise = _noise(group)
        worst, words, ratio = 0.0, "", 1.0
        places = {n: group.position[:, group.names.index(n)] for n in ways}
        pairs: list[tuple[str, Array, float]] = []
        for name, way in ways.items():
            if way is not None and mechanism.joints[way.root].parent_index < 0:
                root = np.array(_fixed(system, theta, way.root))
                pairs.append((f"{name} from the object's root", places[name] - root, way.distance[way.root]))
        for (one, a), (two, b) in itertools.combinations(ways.items(), 2):
            if a is not None and b is not None and a.root == b.root:
                both = [i for i in a.distance if i in b.distance]
                bound = min(a.distance[i] + b.distance[i] for i in both)
                pairs.append((f"{one} from {two}", places[one] - places[two], bound))
        for said_as, apart, bound in pairs:
            size = np.linalg.norm(apart, axis=1)
            if not np.isfinite(size).any():
                continue
            far = float(np.nanmedian(size))
            allowed = (1 + _LENGTH_RTOL) * bound + 6 * noise + _HELD_POINT_TOLERANCE
            if far / allowed > worst:
                # a point at the very root tells nothing of a scale
                worst, ratio = far / allowed, far / bound if bound > 0 else 1.0
                words = f"{said_as} is {far:.3g} m, {bound:.3g} m along the object"
        if worst > 1:
            unit = ratio > 5
            yield Issue(
                "point_scale" if unit else "point_reach",
                words,
                "not_trusted",
                worst,
                f"check the unit of positions (they are {ratio:.2g} times too far)"
                if unit
                else "check the frame of the points, the camera's pose and their names",
                recording.name,
                group.name,
            )


def _fixed(system: System, theta: Array, joint: int) -> list[float]:
    at = system.mechanism.joints[joint].placement.translation
    return [float(x) for x in np.array(ca.Function("at", [system.parameters.symbols], [ca.densify(at)])(theta)).ravel()]


def check_object_points(episode: Episode, result: EpisodePrediction, size: float) -> Iterator[Issue]:
    """Issues of object points that disagree grossly with a rollout at the parameters' initial values.

    Gross errors, such as a mirror image, show even where the stiffnesses are wrong.

    Parameters
    ----------
    episode : Episode
    result : EpisodeResult
        Of a rollout.
    size : float
        Of the object [m].
    """
    for samples, predicted in zip(episode.measurements, result.predicted_outputs, strict=True):
        names = samples.sensor.point_names
        if not names or not size > 0:
            continue
        shape = (len(predicted), len(names), 3)
        seen, place = samples.value.reshape(shape), predicted.reshape(shape)
        error = _rms(seen - place)
        allowed = _MAX_OBJECT_ERROR_FRACTION * size
        if not error > allowed:
            continue
        changes = [*_changed_lengths(seen, place), *_changed_names(seen, place, names)]
        if samples.sensor.camera_pose is not None:
            changes += _changed_pose(seen, place, np.array(ca.DM(samples.sensor.camera_pose.homogeneous_matrix())))
        best = min(changes, key=lambda change: change.error)
        # a rollout with unknown stiffness is no yardstick for less than a clear answer
        if best.error < _MAX_REMAINING_FRACTION * error and best.error < allowed:
            yield _explained([best], error, allowed, episode.name, samples.sensor.group_name, "point_unlike")


def _changed_pose(seen: Array, place: Array, pose: Array) -> Iterator[_Change]:
    """Points in the camera's frame, or with the pose applied the wrong way round."""
    back = np.linalg.inv(pose)

    def moved(by: Array) -> Array:
        return seen @ by[:3, :3].T + by[:3, 3]

    frame = "with the camera's pose applied"
    yield _Change(
        "point_frame", frame, "give positions in the world, not in the camera's frame", _rms(moved(pose) - place)
    )
    turned = "with the camera's pose the other way round"
    yield _Change(
        "point_frame", turned, "the pose is of the camera in the world: invert it", _rms(moved(pose @ pose) - place)
    )
    for i, axis in enumerate("xyz"):
        flip = np.eye(4)
        flip[i, i] = -1
        words = f"with the camera's {axis} axis turned round"
        yield _Change("point_mirrored", words, words, _rms(moved(pose @ flip @ back) - place))


# -- a cable's points -------------------------------------------------------------------------------------------------


def check_cable_points(cable: CableTopology, recording: Recording, gravity: Array) -> Iterator[Issue]:
    """Issues of cable points whose edge lengths differ from the undeformed shape, or that lie above the clamps."""
    for group in recording.points:
        at = {name: group.position[:, group.names.index(name)] for name in cable.vertices if name in group.names}
        edges = [edge for edge in cable.edges if edge[0] in at and edge[1] in at]
        if len(edges) < 3:
            continue
        rest = {name: np.asarray(cable.undeformed_positions[name], float) for name in at}

        def lengths(where: Mapping[str, Array], pairs: Sequence[tuple[str, str]] = tuple(edges)) -> Array:
            return np.array([np.nanmedian(np.linalg.norm(where[a] - where[b], axis=-1)) for a, b in pairs])

        measured, known = lengths(at), lengths(rest)
        ratio = measured / known
        typical = float(np.median(ratio))
        if abs(typical - 1) > _LENGTH_RTOL:
            yield Issue(
                "point_scale",
                f"edges between points are {typical:.3g} times as long as in the undeformed shape",
                "not_trusted",
                abs(math.log(typical)) / math.log(1 + _LENGTH_RTOL),
                f"divide positions by {typical:.3g}",
                recording.name,
                group.name,
            )
        else:
            yield from _exchanged(at, rest, edges, ratio, lengths, recording.name, group.name)
        yield from _upside_down(cable, at, rest, gravity, recording.name, group.name)


def _exchanged(
    at: Mapping[str, Array],
    rest: Mapping[str, Array],
    edges: Sequence[tuple[str, str]],
    ratio: Array,
    lengths: Callable[[Mapping[str, Array]], Array],
    recording: str,
    group: str,
) -> Iterator[Issue]:
    """Points whose edges have the right length once two of them are exchanged."""
    off = np.abs(np.log(ratio)) > math.log(1.6)
    if not off.any():
        return
    known = lengths(rest)
    suspects = sorted({name for edge, bad in zip(edges, off, strict=True) if bad for name in edge})
    best, least = ("", ""), int(off.sum())
    for one, two in itertools.combinations(suspects, 2):
        swapped = {**at, one: at[two], two: at[one]}
        left = int(np.sum(np.abs(np.log(lengths(swapped) / known)) > math.log(1.6)))
        if left < least:
            best, least = (one, two), left
    worst = int(np.argmax(np.abs(np.log(ratio))))
    what = f"the edge {edges[worst][0]} to {edges[worst][1]} is {ratio[worst]:.3g} times as long as undeformed"
    swap = least < 0.5 * off.sum()
    yield Issue(
        "point_swapped" if swap else "point_reach",
        what + (f"; with {best[0]} and {best[1]} exchanged, {int(off.sum()) - least} edges are right" if swap else ""),
        "not_trusted",
        float(abs(math.log(ratio[worst]))) / math.log(1.6),
        f"exchange {best[0]} and {best[1]}" if swap else "check the names of the points",
        recording,
        group,
    )


def _upside_down(
    cable: CableTopology, at: Mapping[str, Array], rest: Mapping[str, Array], gravity: Array, recording: str, group: str
) -> Iterator[Issue]:
    """A cable that rises between its clamps by more than its own shape does: gravity points the other way."""
    pull = float(np.linalg.norm(gravity))
    free = [name for name in cable.free_vertices if name in at]
    ends = [name for name in (cable.parent_vertices[0], cable.parent_vertices[-1]) if name in at]
    if pull == 0 or len(ends) < 2 or not free:
        return
    up = -gravity / pull

    def rise(where: Mapping[str, Array]) -> float:
        chord = 0.5 * (where[ends[0]] + where[ends[1]])
        return float(np.nanmean([np.nanmean((where[name] - chord) @ up) for name in free]))

    span = sum(float(np.linalg.norm(rest[a] - rest[b])) for a, b in cable.edges if a in rest and b in rest)
    own = abs(rise(rest))
    height = rise(at) / span
    if height > 0.05 + own / span:
        yield Issue(
            "point_mirrored",
            f"the cable's points are on average {height * span:.3g} m above its clamps, against gravity",
            "not_trusted",
            height / (0.05 + own / span),
            "check which axis points up, or set model.gravity",
            recording,
            group,
            setting="model.gravity",
        )

"""Checks of measured points against a model, to find mirrored, exchanged, wrongly scaled or delayed points."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import casadi as ca
import numpy as np
import scipy.interpolate

from yid_ocp.analysis import clock_checks
from yid_ocp.analysis.joint_checks import RecordedJointsModel, known_effect_config_line
from yid_ocp.arrays import Array
from yid_ocp.data.channel_checks import Issue, median_sample_period
from yid_ocp.data.recording import PointGroup, Recording
from yid_ocp.model.objects.base import CableVertices
from yid_ocp.model.system import System
from yid_ocp.problem.episodes import Episode, EpisodePrediction
from yid_ocp.sensors import SensorOptions

_Choices = Callable[[str], SensorOptions]

_HELD_POINT_TOLERANCE = 0.01  # allowed distance from the position by forward kinematics (calibration, tool) [m]
_MAX_OBJECT_ERROR_FRACTION = 0.25  # of the object's length, to a model with unknown stiffness
_MAX_REMAINING_FRACTION = 0.5  # a correction explains an error if less than this fraction of it remains
# Factors of lengths in a wrong unit, and powers of ten for typing errors.
_UNIT_SCALES = (1e-3, 1e-2, 0.0254, 0.1, 0.3048, 1 / 0.3048, 10.0, 1 / 0.0254, 100.0, 1e3)
_MIN_CLOCK_OFFSET = 0.05  # smallest clock offset that is tried as the cause of large position errors [s]
_PATH_SAMPLE_RATE = 50.0  # rate at which paths of held points are computed, with splines in between [Hz]
_LENGTH_RTOL = 0.2  # allowed relative error of lengths that cannot change
_MAX_EDGE_RATIO = 1.6  # ratio of a cable edge's measured and undeformed length, above which points are exchanged


class _Change(NamedTuple):
    """A tried correction of measured points: issue cause, words, advice, and the rms distance [m] that remains."""

    cause: str
    words: str
    advice: str
    error: float
    setting: str = ""
    channel: str = ""


def point_frame_names(system: System, group: PointGroup, choice: SensorOptions) -> dict[str, str]:
    """Return the model's frame of each recorded point that the settings `choice` use and the model has."""
    wanted = group.names if choice.used_points is None else choice.used_points
    frames = {name: choice.frame_by_recorded_name.get(name, name) for name in wanted if name in group.names}
    return {name: frame for name, frame in frames.items() if system.mechanism.has_frame(frame)}


def forward_kinematics_issues(arm: RecordedJointsModel, recording: Recording, options: _Choices) -> Iterator[Issue]:
    """Yield issues about points on the arm that contradict forward kinematics. `options`(group): its settings."""
    joints, tree = recording.joints, arm.system.mechanism
    if joints is None or median_sample_period(joints.t) <= 0:
        return
    holders = {grasp.held_frame: grasp.holder_frame for grasp in arm.system.grasps}
    for group in recording.points:
        # for a grasped point, the frame of the arm that holds it
        marked = point_frame_names(arm.system, group, options(group.name))
        held = {name: holders.get(frame, frame) for name, frame in marked.items()}
        known = filter(arm.is_frame_determined_by_angles, dict.fromkeys(held.values()))
        moved = {frame for frame in known if tree.ancestor_joint_indices(tree.frame(frame).joint_index)}
        frames = {name: frame for name, frame in held.items() if frame in moved}
        inside = (group.t >= joints.t[0]) & (group.t <= joints.t[-1])
        if not frames or inside.sum() < 3:
            continue
        rows = np.flatnonzero(inside)[:: max(1, int(inside.sum()) // 200)]
        seen, t = group.position[rows][:, [group.names.index(name) for name in frames]], group.t[rows]
        angles = joints.position[:, [joints.names.index(name) for name in arm.joint_names]]
        course, places = scipy.interpolate.CubicSpline(joints.t, angles, axis=0), tuple(frames.values())
        place, by_angle = arm.frame_positions_and_jacobians(places, course(t))
        error, noise = _rms(seen - place), _noise(group)
        knots = float(joints.t[0]), float(joints.t[-1])
        dense = np.linspace(*knots, int(np.clip(_PATH_SAMPLE_RATE * (knots[1] - knots[0]), 400, 20_000)))
        path = scipy.interpolate.CubicSpline(dense, arm.frame_positions_and_jacobians(places, course(dense))[0], axis=0)
        allowed = max(_HELD_POINT_TOLERANCE, 5 * noise)
        if not error > allowed:
            found = clock_checks.robot_held_point_clock_issues(joints, group, t, seen, by_angle, noise, path)
            yield from (replace(issue, recording=recording.name) for issue in found)
            continue
        changes = [
            *_changed_lengths(seen, place),
            *_changed_names(seen, place, tuple(frames)),
            *_changed_times(path, knots, t, seen),
            *_changed_zeros(arm, places, course(t), seen, (place, by_angle)),
            *_moved(seen, place),
        ]
        yield _explained(changes, seen - place, tuple(frames), allowed, recording.name, group.name)


def _explained(
    changes: Sequence[_Change], apart: Array, names: Sequence[str], allowed: float, recording: str, group: str
) -> Issue:
    """Return the issue for the correction that explains most (the first of equally good ones), with the far points."""
    error, far = _rms(apart), ", ".join(name for i, name in enumerate(names) if _rms(apart[:, i]) > allowed)
    best = min((change.error for change in changes), default=math.inf)
    good = (c for c in changes if c.error <= max(1.3 * best, allowed) and c.error < _MAX_REMAINING_FRACTION * error)
    words = f"points ({far or 'all'}) are {error:.3g} m (rms) from the model ({allowed:.2g} m is tolerated)"
    for chosen in good:
        words = f"{words}, but only {chosen.error:.2g} m {chosen.words}"
        place = recording, "joints" if chosen.channel else group, chosen.channel
        return Issue(chosen.cause, words, "not_trusted", error / allowed, chosen.advice, *place, setting=chosen.setting)
    words = f"{words}, and no change of unit, axes, names, frame, clock or joint zero explains this"
    advice = "check the frame and the names of the points, and the URDF of the robot"
    return Issue("point_unlike", words, "not_trusted", error / allowed, advice, recording, group)


def _noise(group: PointGroup) -> float:
    known = np.zeros(0) if group.std is None else group.std[np.isfinite(group.std)]
    return float(np.median(known)) if len(known) else 0.0


def _rms(difference: Array) -> float:
    square = np.sum(difference**2, axis=-1)
    return float(np.sqrt(np.nanmean(square))) if np.any(np.isfinite(square)) else math.nan


def _changed_lengths(seen: Array, place: Array) -> Iterator[_Change]:
    """Yield corrections: another unit of length, or axes exchanged or flipped about the world's origin."""
    for scale in _UNIT_SCALES:
        words = f"if positions are divided by {scale:g}"
        yield _Change("point_scale", words, f"divide positions in the file by {scale:g}", _rms(seen / scale - place))
    turns = itertools.product(itertools.permutations(range(3)), itertools.product((1.0, -1.0), repeat=3))
    errors = {turn: _rms(seen[..., list(turn[0])] * np.array(turn[1]) - place) for turn in list(turns)[1:]}
    # the last of several equally good ones
    order, signs = min(reversed(errors), key=lambda turn: errors[turn])
    axes = ", ".join(("" if s > 0 else "-") + "xyz"[i] for i, s in zip(order, signs, strict=True))
    mirror = np.linalg.det(np.eye(3)[list(order)] * np.array(signs)[:, None]) < 0
    words = f"if (x, y, z) is replaced by ({axes}){' (a mirror image)' if mirror else ''}"
    yield _Change("point_mirrored", words, f"write {axes} as x, y, z of the points in the file", errors[order, signs])


def _changed_names(seen: Array, place: Array, names: Sequence[str]) -> Iterator[_Change]:
    for i, j in itertools.combinations(range(len(names)), 2):
        order = list(range(len(names)))
        order[i], order[j] = j, i
        words = f"if {names[i]} and {names[j]} are exchanged"
        advice = f"exchange the names of {names[i]} and {names[j]} in the file"
        yield _Change("point_swapped", words, advice, _rms(seen[:, order] - place))


def _changed_times(
    path: clock_checks.PositionsAtTimesFunction, knots: tuple[float, float], t: Array, seen: Array
) -> Iterator[_Change]:
    """Yield corrections of the clock: an offset relative to the joints or, if none explains the points, a drift."""
    before, middle = _rms(seen - path(t)), 0.5 * (t[0] + t[-1])
    late, _, error = clock_checks.point_clock_offset_drift_and_rms_error(path, knots, t, seen)
    # a search over so many times always finds some improvement
    if abs(late) >= _MIN_CLOCK_OFFSET and error < 0.5 * _MAX_REMAINING_FRACTION * before:
        words = f"if {-late:+.3g} s are added to their times"
        again = f"import again with --clock-offset FILE={-late:.3g}"
        yield _Change("clock_offset", words, f"add {-late:+.3g} s to their times ({again})", error)
        return
    late, drift, error = clock_checks.point_clock_offset_drift_and_rms_error(path, knots, t, seen, drifts=True)
    if abs(drift) * (t[-1] - t[0]) >= _MIN_CLOCK_OFFSET and error < 0.5 * _MAX_REMAINING_FRACTION * before:
        words = f"if their clock is corrected by {-late:+.3g} s and {-100 * drift:+.3g} %"
        yield _Change("clock_drift", words, clock_checks.timestamp_correction_advice(late, drift, middle), error)


def _changed_zeros(
    arm: RecordedJointsModel, frames: tuple[str, ...], q: Array, seen: Array, here: tuple[Array, Array]
) -> Iterator[_Change]:
    """Yield the best correction of the zero of one joint, found by Gauss-Newton."""
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
            place, by_angle = arm.frame_positions_and_jacobians(frames, moved)
        else:
            setting = known_effect_config_line("encoder_offset", name, "offset", -offset)
            words, advice = f"if {offset:+.3g} rad are added to {name}", f"correct this, or model the offset of {name}"
            found.append(_Change("encoder_offset", words, advice, _rms(seen - place), setting, f"position.{name}"))
    yield from sorted(found, key=lambda change: change.error)[:1]


def _moved(seen: Array, place: Array) -> Iterator[_Change]:
    """Yield corrections of the frame: a shift, then also a rotation (Kabsch 1976, doi:10.1107/S0567739476001873)."""
    good = np.isfinite(seen).all(axis=-1)
    a, b = seen[good], place[good]
    if len(a) < 4:
        return
    shift = b.mean(axis=0) - a.mean(axis=0)
    words, advice = "({:.3g}, {:.3g}, {:.3g}) m".format(*shift), "to the positions, to have them in the robot's frame"
    yield _Change("point_frame", f"if shifted by {words}", f"add {words} {advice}", _rms(a + shift - b))
    u, _, v = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
    turn = (u * [1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v
    left = _rms((a - a.mean(axis=0)) @ turn + b.mean(axis=0) - b)
    angle = math.degrees(math.acos(float(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    words, advice = f"if turned by {angle:.3g} degrees and shifted", "transform the positions to the robot's frame"
    yield _Change("point_frame", words, advice, left)


def _distances(arm: RecordedJointsModel | None, system: System, theta: Array, frame: str) -> dict[int, float] | None:
    """Return distances along the chain from a frame to its joints with unknown angle, root first; None without any."""
    mechanism, known = system.mechanism, set() if arm is None else set(arm.system_configuration_indices)
    entry = mechanism.frame(frame)
    chain = [i for i in mechanism.ancestor_joint_indices(entry.joint_index) if i not in known]
    if not chain or any(mechanism.joints[i].kind == "prismatic" for i in chain):
        return None
    steps = [entry.placement.translation, *(mechanism.joints[i].placement.translation for i in reversed(chain[1:]))]
    function = ca.Function("steps", [system.parameters.symbols], [ca.norm_2(step) for step in steps])
    try:
        lengths = [float(x) for x in function.call([theta])]
    except RuntimeError:  # an effect's internal coordinate
        return None
    return dict(zip(chain, np.cumsum(lengths)[::-1].tolist(), strict=True))


def points_too_distant_issues(
    arm: RecordedJointsModel | None, system: System, theta: Array, recording: Recording, options: _Choices
) -> Iterator[Issue]:
    """Yield issues about points that are farther apart, or farther from the root, than the object is long."""
    mechanism = system.mechanism
    for group in recording.points:
        frames = point_frame_names(system, group, options(group.name))
        found = {name: _distances(arm, system, theta, frame) for name, frame in frames.items()}
        ways = {name: way for name, way in found.items() if way is not None}
        noise = _noise(group)
        worst, words, ratio = 0.0, "", 1.0
        places = {name: group.position[:, group.names.index(name)] for name in ways}
        pairs: list[tuple[tuple[str, str], Array, float]] = []
        for name, way in ways.items():
            root = next(iter(way))
            if mechanism.joints[root].parent_index < 0:
                at = ca.densify(mechanism.joints[root].placement.translation)
                fixed = np.array(ca.Function("at", [system.parameters.symbols], [at])(theta)).ravel()
                pairs.append(((name, "the object's root (first end)"), places[name] - fixed, way[root]))
        for (one, a), (two, b) in itertools.combinations(ways.items(), 2):
            if next(iter(a)) == next(iter(b)):
                bound = min(a[i] + b[i] for i in a.keys() & b.keys())
                pairs.append(((one, two), places[one] - places[two], bound))
        for (one, two), apart, bound in pairs:
            size = np.linalg.norm(apart, axis=1)
            if not np.isfinite(size).any():
                continue
            far = float(np.nanmedian(size))
            allowed = (1 + _LENGTH_RTOL) * bound + 6 * noise + _HELD_POINT_TOLERANCE
            if far / allowed > worst:
                # a point at the root has no information on a scale
                worst, ratio = far / allowed, far / bound if bound > 0 else 1.0
                words = f"{one} is measured {far:.3g} m from {two}, but along the object they are {bound:.3g} m apart"
                words += f" (with allowances, {allowed:.3g} m is tolerated)"
        if worst > 1:
            cause, advice = "point_reach", "check model.object.mount, names and frame of the points, and the camera"
            if ratio > 5:
                cause, advice = "point_scale", f"check the unit of positions (the factor is {ratio:.2g} or more)"
            yield Issue(cause, words, "not_trusted", worst, advice, recording.name, group.name)


def correctable_object_point_issues(episode: Episode, result: EpisodePrediction, size: float) -> Iterator[Issue]:
    """Yield issues about points that a simple correction moves to the rollout `result` of an object of `size` [m]."""
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
        # a rollout with unknown stiffness only supports a clear correction
        if best.error < _MAX_REMAINING_FRACTION * error and best.error < allowed:
            yield _explained([best], seen - place, names, allowed, episode.name, samples.sensor.group_name)


def _changed_pose(seen: Array, place: Array, pose: Array) -> Iterator[_Change]:
    """Yield corrections for points in the camera's frame, transformed with its inverse pose, or with a flipped axis."""
    back = np.linalg.inv(pose)

    def moved(by: Array) -> Array:
        return seen @ by[:3, :3].T + by[:3, 3]

    advice = "give positions in the world, not in the camera's frame"
    yield _Change("point_frame", "if the camera's pose is applied", advice, _rms(moved(pose) - place))
    turned, advice = "if the camera's pose is inverted", "invert the pose, which must be from camera to world"
    yield _Change("point_frame", turned, advice, _rms(moved(pose @ pose) - place))
    for i, axis in enumerate("xyz"):
        flip = np.eye(4)
        flip[i, i] = -1
        words = f"if the camera's {axis} axis is reversed"
        advice = f"reverse the sign of {axis} of these points in the camera's frame"
        yield _Change("point_mirrored", words, advice, _rms(moved(pose @ flip @ back) - place))


def cable_point_geometry_issues(cable: CableVertices, recording: Recording, gravity: Array) -> Iterator[Issue]:
    """Yield issues about cable points that lie too high above the clamps, are exchanged, or have wrong distances."""
    for group in recording.points:
        at = {name: group.position[:, group.names.index(name)] for name in cable.vertex_names if name in group.names}
        edges = [edge for edge in cable.edge_vertex_names if edge[0] in at and edge[1] in at]
        if len(edges) < 3:
            continue
        rest = {name: np.asarray(cable.undeformed_positions[name], float) for name in at}
        typical = float(np.median(_lengths(at, edges) / _lengths(rest, edges)))
        low, high = 1 - _LENGTH_RTOL, 1 + _LENGTH_RTOL
        found: list[Issue | None] = [_exchanged(at, rest, edges), _upside_down(cable, at, rest, gravity)]
        if typical < low or typical > high:
            words = f"distances of neighbouring points are {typical:.3g} times those of the undeformed cable"
            words, depth = f"{words} ({low:g} to {high:g} times is tolerated)", max(typical / high, low / typical)
            advice = f"divide the positions in the file by {typical:.3g}"
            found[0] = Issue("point_scale", words, "not_trusted", depth, advice, "")
        yield from (replace(own, recording=recording.name, group=group.name) for own in found if own is not None)


def _lengths(where: Mapping[str, Array], edges: Sequence[tuple[str, str]]) -> Array:
    return np.array([np.nanmedian(np.linalg.norm(where[a] - where[b], axis=-1)) for a, b in edges])


def _exchanged(at: Mapping[str, Array], rest: Mapping[str, Array], edges: Sequence[tuple[str, str]]) -> Issue | None:
    """Return the issue for an edge of wrong length, and whether exchanging two points corrects the lengths."""
    known, most = _lengths(rest, edges), math.log(_MAX_EDGE_RATIO)
    ratio = _lengths(at, edges) / known
    off = np.abs(np.log(ratio)) > most
    if not off.any():
        return None
    suspects = sorted({name for edge, bad in zip(edges, off, strict=True) if bad for name in edge})
    best, least = ("", ""), int(off.sum())
    for one, two in itertools.combinations(suspects, 2):
        left = int(np.sum(np.abs(np.log(_lengths({**at, one: at[two], two: at[one]}, edges) / known)) > most))
        if left < least:
            best, least = (one, two), left
    worst = int(np.argmax(np.abs(np.log(ratio))))
    words = f"the neighbours {edges[worst][0]} and {edges[worst][1]} are {ratio[worst]:.3g} times as far apart as "
    words += f"in the undeformed object ({1 / _MAX_EDGE_RATIO:.3g} to {_MAX_EDGE_RATIO:g} times is tolerated)"
    cause, advice = "point_reach", "check the names of the points"
    if least < 0.5 * off.sum():
        words += f". If {best[0]} and {best[1]} are exchanged, {int(off.sum()) - least} more such distances are right"
        cause, advice = "point_swapped", f"exchange the names of {best[0]} and {best[1]} in the file"
    return Issue(cause, words, "not_trusted", max(ratio[worst], 1 / ratio[worst]) / _MAX_EDGE_RATIO, advice, "")


def _upside_down(
    cable: CableVertices, at: Mapping[str, Array], rest: Mapping[str, Array], gravity: Array
) -> Issue | None:
    """Return the issue for a cable that rises between its clamps by more than its undeformed shape, or None."""
    pull = float(np.linalg.norm(gravity))
    free = [name for name in cable.unclamped_vertex_names if name in at]
    ends = [name for name in (cable.main_branch_vertex_names[0], cable.main_branch_vertex_names[-1]) if name in at]
    if pull == 0 or len(ends) < 2 or not free:
        return None
    up = -gravity / pull

    def rise(where: Mapping[str, Array]) -> float:
        chord = 0.5 * (where[ends[0]] + where[ends[1]])
        return float(np.nanmean([np.nanmean((where[name] - chord) @ up) for name in free]))

    span = sum(float(np.linalg.norm(rest[a] - rest[b])) for a, b in cable.edge_vertex_names if a in rest and b in rest)
    height, allowed = rise(at) / span, 0.05 + abs(rise(rest)) / span
    if not height > allowed:
        return None
    words = f"the cable's points are on average {height * span:.3g} m above its clamps ({allowed * span:.2g} m is "
    words += "tolerated), although gravity pulls down"
    advice = "check which axis of the recording points up. If it is the opposite one, reverse gravity"
    line = f"model.gravity: [{', '.join(f'{x:g}' for x in 0.0 - gravity)}]"
    return Issue("point_mirrored", words, "not_trusted", height / allowed, advice, "", setting=line)

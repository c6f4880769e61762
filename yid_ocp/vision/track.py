"""From a frame sequence and the joints' recording to measured points: filter, thin, fit, judge, and write them down.

Every frame ends as a fitted shape or with the reason why it was dropped; nothing in one frame stops the sequence.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from yid_ocp.data.recording import PointGroup, Recording, validate
from yid_ocp.errors import ConfigError, DataError, ModelError, nearest
from yid_ocp.model.system import System
from yid_ocp.options import About, check
from yid_ocp.vision.clock import Clock, ClockOptions, estimate_clock
from yid_ocp.vision.filters import Cloud, FilterOptions, ObjectRegion, voxel_grid, without_outliers, without_robot
from yid_ocp.vision.fit import Fit, FitOptions, ShapeFit, Sight
from yid_ocp.vision.frames import FrameSequence
from yid_ocp.vision.meshes import MeshKind, Scene, Surfaces, numeric_mechanism, robot_meshes
from yid_ocp.vision.skeleton import Skeleton, WalkOptions, skeleton

Array = NDArray[np.float64]
Progress = Callable[[int, int, str], None]

GROUP = "points_camera"
_LARGEST = 50.0  # [m]; a depth camera sees no further, a cloud in millimetres always does
_SAME_TIME = 1e-6  # [s]


@dataclass(frozen=True)
class TrackOptions:
    """How a frame sequence is turned into measured points, and which of its frames are good."""

    filters: Annotated[FilterOptions, About("what counts as the object")] = field(default_factory=FilterOptions)
    walk: Annotated[WalkOptions, About("how a cloud is thinned")] = field(default_factory=WalkOptions)
    fit: Annotated[FitOptions, About("how a shape is fitted")] = field(default_factory=FitOptions)
    clock: Annotated[ClockOptions, About("how the camera's clock is compared with the joints'")] = field(
        default_factory=ClockOptions
    )
    d_max: Annotated[
        float, Gt(0), About("a frame whose points are further from the fitted shape on average is dropped", "m")
    ] = 0.012
    largest_bend: Annotated[
        float, Gt(0), About("a frame whose shape has a joint that is bent further is dropped", "rad")
    ] = 1.2
    worse: Annotated[
        float, Gt(0), About("a frame whose distance is so many times the median of all good frames is dropped")
    ] = 1.7
    gap_max: Annotated[
        float,
        Gt(0),
        About(
            "a frame in which an end is further from the gripper that holds it than usual by more is dropped: its time "
            "is not what its stamp says",
            "m",
        ),
    ] = 0.008
    least_inliers: Annotated[
        float, Ge(0), Le(1), About("a frame of which a smaller fraction of the points lies on the shape is dropped")
    ] = 0.6
    point_std_max: Annotated[
        float, Gt(0), About("a point that is known less well in a frame counts as not seen there", "m")
    ] = 0.02
    std_floor: Annotated[
        float,
        Gt(0),
        About("standard deviation that no fit is better than: of the camera's pose and of straight links", "m"),
    ] = 0.003
    stamp_std: Annotated[
        float, Ge(0), About("standard deviation of a frame's time stamp, beyond the common offset", "s")
    ] = 0.003
    points: Annotated[
        tuple[str, ...] | None,
        About("points to write down; those that no arm holds when absent, as arms know theirs better"),
    ] = None
    mesh: Annotated[MeshKind, About("meshes of the robot's self-filter")] = "visual"
    seed: Annotated[int, Ge(0), About("of the walk's random points and of all subsampling")] = 0

    def __post_init__(self) -> None:
        check(self, "track options")


@dataclass(frozen=True, eq=False)
class FrameReport:
    """What became of one frame.

    Attributes
    ----------
    index : int
        Of the sequence.
    name : str
    stamp : float
        As the camera gave it [s].
    t : float
        On the joints' clock [s].
    reason : str
        Why it was dropped; empty for a good one.
    raw, filtered, nodes : int
        Points of the cloud, points left by the filters, nodes of the skeleton.
    delay : float
        Of its stamp beyond the common offset, NaN where it cannot be told [s].
    seconds : float
        Processor time from the filtered cloud to the fitted points [s].
    fit : Fit or None
    """

    index: int
    name: str
    stamp: float
    t: float
    reason: str
    raw: int
    filtered: int
    nodes: int
    delay: float
    seconds: float
    fit: Fit | None

    @property
    def good(self) -> bool:
        """Whether it was used."""
        return not self.reason


@dataclass(frozen=True, eq=False)
class Stages:
    """One frame on its way, for pictures.

    Attributes
    ----------
    name : str
    cloud, filtered : ndarray, shape (N, 3)
        In the world [m].
    skeleton : Skeleton
    fit : Fit
    camera : ndarray, shape (3,)
        [m]
    """

    name: str
    cloud: Array
    filtered: Array
    skeleton: Skeleton
    fit: Fit
    camera: Array


@dataclass(frozen=True, eq=False)
class Track:
    """Shapes and points of the good frames.

    Attributes
    ----------
    names : tuple of str
        Points written down.
    t : ndarray, shape (M,)
        Times of the good frames on the joints' clock [s].
    q : ndarray, shape (M, n)
        Configurations, twists at rest.
    position, std : ndarray, shape (M, np, 3)
        [m]; NaN where a point was not seen well enough.
    frames : tuple of FrameReport
        All of them, by time stamp.
    clock : Clock
    stages : tuple of Stages
        Of the frames that were asked for and turned out well.
    """

    names: tuple[str, ...]
    t: Array
    q: Array
    position: Array
    std: Array
    frames: tuple[FrameReport, ...]
    clock: Clock
    stages: tuple[Stages, ...]
    _system_points: tuple[str, ...]
    _place: Callable[[Array], Array]
    _pose: Array

    def shape(self, t: float) -> Array:
        """Configuration at any time between the good frames, by a cubic spline through theirs, shape (n,).

        Beyond the first and the last frame it stays as it was there.
        """
        at = float(np.clip(t, self.t[0], self.t[-1]))
        return self.q[0].copy() if len(self.t) < 2 else np.asarray(CubicSpline(self.t, self.q, axis=0)(at))

    def points(self, t: float) -> Array:
        """The written points at any time, by the kinematics of `shape`, shape (np, 3) [m]."""
        return self._place(self.shape(t))[[self._system_points.index(name) for name in self.names]]

    @property
    def dropped(self) -> dict[str, int]:
        """How often each reason dropped a frame; numbers in the reasons are left out."""
        reasons = (frame.reason.partition(":")[0] for frame in self.frames if not frame.good)
        return dict(Counter(reasons).most_common())

    def group(self) -> PointGroup:
        """The points as a group of a recording, called `points_camera`."""
        return PointGroup(
            GROUP, self.names, self.t, self.position, self.std, "depth camera, fitted shape", pose=self._pose
        )

    def recording(self, recording: Recording) -> Recording:
        """A recording with these points in place of any `points_camera` that it had; `DataError` as `validate`."""
        others = tuple(group for group in recording.points if group.name != GROUP)
        text = f"{recording.description} Points of {len(self.t)} of {len(self.frames)} frames; {self.clock.message}."
        made = replace(recording, points=(*others, self.group()), description=text.strip(), sha256=None)
        # the positions of a straight object belong to the group that a file lists first
        if not others or others[0] is not recording.points[0] or others[0].name > GROUP:
            made = replace(made, straight=None)
        return validate(made)


def track(
    scene: Scene,
    recording: Recording,
    sequence: FrameSequence,
    options: TrackOptions | None = None,
    *,
    stages: Sequence[int] = (),
    progress: Progress | None = None,
) -> Track:
    """Measure the object's points in a sequence.

    Parameters
    ----------
    scene : Scene
        Robot and object; joints that are not elastic must be in the recording. Without a URDF file there is no
        self-filter and no clock offset.
    recording : Recording
        Joint angles, for the self-filter, the grasps and the clock.
    sequence : FrameSequence
    options : TrackOptions, optional
    stages : sequence of int
        Frames of the frame sequence of which all stages are kept for pictures.
    progress : callable, optional
        Called with frames done, frames in all and what is being done.

    Returns
    -------
    Track

    Raises
    ------
    DataError
        No joint angles, time stamps of another clock, or not one good frame; the error lists the reasons.
    ConfigError
        A point that the system does not have.
    ModelError
        Meshes that cannot be read.
    """
    tracker = _Tracker(scene, recording, sequence, options or TrackOptions())
    return tracker.run(frozenset(stages), progress or (lambda done, total, text: None))


@dataclass(frozen=True, eq=False)
class _Reading:
    """A frame that was read: its cloud where the object can be, None with a reason; how many points it had."""

    index: int
    cloud: Cloud | None
    raw: int = 0
    reason: str = ""


class _Tracker:
    """The state of one call of `track`."""

    def __init__(self, scene: Scene, recording: Recording, sequence: FrameSequence, options: TrackOptions) -> None:
        system, values = scene.system, scene.values
        self.system, self.sequence, self.options = system, sequence, options
        self.shape = ShapeFit(system, options.fit, values)
        self.names = _chosen_points(system, options.points)
        self.region = ObjectRegion(system, options.filters, values)
        self.camera = sequence.pose[:3, 3]
        self.span, self.angles = _joint_angles(system, recording, self.shape.known)
        tree = numeric_mechanism(system, values)
        self.robot: Surfaces | None = None
        if scene.urdf is not None:
            meshes = robot_meshes(scene.urdf, tree, options.mesh)
            if all(joint < 0 for joint in meshes):
                raise ModelError("no link of the robot moves with the model's joints", where=str(scene.urdf))
            self.robot = Surfaces(tree, meshes)
        self.rng = np.random.default_rng(options.seed)

    def posture(self, t: float) -> Array:
        """Configuration at a time on the joints' clock, the object at rest; it stays at the recording's ends beyond."""
        q = self.shape.rest.copy()
        if self.angles is not None:
            q[[self.system.mechanism.joint_index(name) for name in self.shape.known]] = self.angles(t)
        return q

    def run(self, wanted: frozenset[int], progress: Progress) -> Track:
        """Both passes over the sequence."""
        total = 2 * len(self.sequence)
        readings = self._readings(progress)
        stamps = self.sequence.t[[reading.index for reading in readings]]
        progress(len(self.sequence), total, "comparing the clocks")
        clock = self._clock([reading.cloud for reading in readings], stamps)
        frames: list[FrameReport] = []
        kept: list[Stages] = []
        last: tuple[Array, float] | None = None
        for k in range(len(readings)):
            reading = readings[k]
            readings[k] = replace(reading, cloud=None)  # a long sequence would fill the memory
            progress(len(self.sequence) + k, total, f"fitting {self.sequence.names[reading.index]}")
            report, stage = self._frame(reading, clock, k, last)
            frames.append(report)
            if report.good and report.fit is not None:
                last = report.fit.q, report.t
            if stage is not None and report.good and reading.index in wanted:
                kept.append(stage())
        progress(total, total, "done")
        fits = [frame.fit for frame in frames if frame.good and frame.fit is not None]
        if fits:
            usual = float(np.median([fit.distance for fit in fits]))
            gap = np.median([fit.gap for fit in fits], axis=0)
            frames = [self._compared(frame, usual, gap) for frame in frames]
        return self._track(frames, clock, kept)

    def _readings(self, progress: Progress) -> list[_Reading]:
        """All frames by their stamps, filtered as far as that needs no clock."""
        order, reasons = _sorted_frames(self.sequence.t)
        self._check_clock([i for i in order if i not in reasons])
        readings = []
        for done, i in enumerate(order):
            progress(done, 2 * len(order), f"reading {self.sequence.names[i]}")
            reading = _Reading(i, None, reason=reasons.get(i, ""))
            if i not in reasons:
                try:
                    cloud, raw = self._read(i)
                    reading = _Reading(i, cloud, raw)
                except DataError as error:
                    reading = _Reading(i, None, reason=error.what)
            readings.append(reading)
        return readings

    def _check_clock(self, usable: Sequence[int]) -> None:
        if self.span is None or not usable:
            return
        options, stamps = self.options.clock, self.sequence.t[list(usable)]
        first, last = float(stamps.min()) - options.offset, float(stamps.max()) - options.offset
        if first > self.span[1] + options.search or last < self.span[0] - options.search:
            raise DataError(
                f"the frames run from {first:.3f} s to {last:.3f} s, the joints from {self.span[0]:.3f} s to"
                f" {self.span[1]:.3f} s: their clocks are not the same",
                where=self.sequence.source,
                hint=f"give the clock offset (stamp minus joint time): {first + options.offset - self.span[0]:.3f} s if"
                " both started together",
            )

    def _read(self, index: int) -> tuple[Cloud, int]:
        points = self.sequence.world(index)
        count = len(points)
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            raise DataError("the cloud is empty")
        far = float(np.median(np.abs(points).max(axis=1)))
        if far > _LARGEST:
            raise DataError(f"the cloud is not in metres: half of its points are {far:.0f} m away (millimetres?)")
        filters = self.options.filters
        q = self.posture(float(self.sequence.t[index]) - self.options.clock.offset)
        inside = self.region.at(q, self.camera).contains(points)
        if not inside.any():
            raise DataError("no point lies where the object can be: check the camera's pose")
        cloud = voxel_grid(points[inside], filters.voxel)
        # before the robot is taken out: among all surfaces, wrong points are few
        return cloud.keep(without_outliers(cloud, filters.neighbours, filters.outlier_ratio)), count

    def _clock(self, clouds: Sequence[Cloud | None], stamps: Array) -> Clock:
        options = self.options.clock
        if self.robot is None or self.span is None:
            nothing = np.full(len(stamps), np.nan)
            text = f"clock offset {1e3 * options.offset:.0f} ms as given: no robot to compare"
            return Clock(options.offset, math.inf, False, nothing, nothing, np.zeros(3), text)
        return estimate_clock(self.robot, clouds, stamps, self.posture, self.rng, options)

    def _frame(
        self, reading: _Reading, clock: Clock, row: int, last: tuple[Array, float] | None
    ) -> tuple[FrameReport, Callable[[], Stages] | None]:
        """What became of a frame, and its stages if it has a shape; `last`: shape and time of the good frame before."""
        options, index, cloud = self.options, reading.index, reading.cloud
        stamp = float(self.sequence.t[index])
        t, delay = stamp - clock.offset, float(clock.delay[row])
        name = self.sequence.names[index]
        report = FrameReport(index, name, stamp, t, reading.reason, reading.raw, 0, 0, delay, 0.0, None)
        if reading.reason or cloud is None:
            return report, None
        if self.span is not None and not self.span[0] <= t <= self.span[1]:
            return replace(report, reason="there are no joint angles at its time"), None
        if abs(delay) > max(options.clock.late, 4 * float(clock.delay_std[row])):
            return replace(report, reason=f"its stamp is late: by {1e3 * delay:.0f} ms"), None
        q = self.posture(t)
        if self.robot is not None:
            cloud = cloud.keep(without_robot(cloud, self.robot, q, options.filters.padding))
        if len(cloud) < options.filters.least:
            return replace(report, filtered=len(cloud), reason=f"too few points of the object: {len(cloud)} left"), None
        if len(cloud) > options.filters.most:
            cloud = cloud.keep(np.sort(self.rng.choice(len(cloud), options.filters.most, replace=False)))
        begun = time.process_time()
        found = skeleton(cloud, self.rng, options.walk)
        report = replace(report, filtered=len(cloud), nodes=len(found.nodes))
        if not len(found.nodes):
            return replace(report, reason="no part of the cloud is dense enough for a skeleton"), None
        rest = cloud.keep(found.connected)
        part = found.part[found.label[found.connected]]
        sight = Sight(rest.points, rest.weight, part, found.nodes, self.camera)
        before = () if last is None else (last[0],)
        fit = self.shape.solve(sight, q, before, None if last is None else (last[0], t - last[1]))
        spent = time.process_time() - begun
        report = replace(report, fit=fit, reason=self._judge(fit), seconds=spent)
        return report, lambda: Stages(name, self.sequence.world(index), rest.points, found, fit, self.camera)

    def _judge(self, fit: Fit) -> str:
        options = self.options
        if not np.isfinite(fit.q).all():
            return "the fit failed"
        if fit.distance > options.d_max:
            limit = 1e3 * options.d_max
            return f"the shape does not fit: {1e3 * fit.distance:.1f} mm off on average, d_max is {limit:g} mm"
        bend = float(np.abs((fit.q - self.shape.rest)[list(self.shape.free)]).max())
        if bend > options.largest_bend:
            return f"the shape is folded: a joint is bent by {math.degrees(bend):.0f} degrees"
        if fit.inliers < options.least_inliers:
            return f"the shape does not fit: only {100 * fit.inliers:.0f} % of the points lie on it"
        return ""

    def _compared(self, frame: FrameReport, usual: float, gap: Array) -> FrameReport:
        if not frame.good or frame.fit is None:
            return frame
        if frame.fit.distance > self.options.worse * usual:
            off = f"{1e3 * frame.fit.distance:.1f} mm off on average, {1e3 * usual:.1f} mm are usual"
            return replace(frame, reason=f"the shape fits worse than in other frames: {off}")
        apart = float(np.linalg.norm(frame.fit.gap - gap, axis=1).max(initial=0.0))
        if apart > self.options.gap_max:
            off = f"{1e3 * apart:.0f} mm more than usual (a late stamp?)"
            return replace(frame, reason=f"an end is not where its gripper is: {off}")
        return frame

    def _track(self, frames: Sequence[FrameReport], clock: Clock, kept: Sequence[Stages]) -> Track:
        good = [frame for frame in frames if frame.good]
        if not good:
            count = Counter(frame.reason for frame in frames).most_common(3)
            listed = "; ".join(f"{reason} ({number} of {len(frames)})" for reason, number in count)
            hint = (
                "check the camera's pose, the unit of the clouds and the filters, and look at the pictures of a frame"
            )
            if "metres" in listed:
                hint = "say in camera.json that the unit is mm"
            raise DataError(f"not one frame could be used: {listed}", where=self.sequence.source, hint=hint)
        fits = [frame.fit for frame in good if frame.fit is not None]
        t = np.array([frame.t for frame in good])
        columns = [self.system.points.index(name) for name in self.names]
        position = np.array([fit.points[columns] for fit in fits])
        std = np.hypot(np.array([fit.std[columns] for fit in fits]), self.options.std_floor)
        # where the arm seems displaced, so may the object be
        std = np.hypot(std, np.abs(clock.shift))
        uncertain = math.hypot(self.options.stamp_std, clock.std if clock.estimated else 0.0)
        if len(t) > 1:
            velocity = np.asarray(CubicSpline(t, position, axis=0)(t, 1))
            std = np.hypot(std, np.abs(velocity) * uncertain)
        unseen = np.linalg.norm(std, axis=2) > math.sqrt(3.0) * self.options.point_std_max
        unseen |= ~np.array([fit.seen[columns] for fit in fits])
        if unseen.all():
            best = 1e3 * float(np.sqrt((std**2).mean(axis=2)).min())
            raise DataError(
                f"no point is known well enough in any frame: the best within {best:.0f} mm,"
                f" point_std_max is {1e3 * self.options.point_std_max:g} mm",
                where=self.sequence.source,
                hint=f"check the camera's pose and clock ({clock.message}), or look at the pictures of a frame",
            )
        return Track(
            self.names,
            t,
            np.array([fit.q for fit in fits]),
            np.where(unseen[..., None], np.nan, position),
            np.where(unseen[..., None], np.nan, std),
            tuple(frames),
            clock,
            tuple(kept),
            self.system.points,
            self.shape.place,
            self.sequence.pose,
        )


def _chosen_points(system: System, wanted: tuple[str, ...] | None) -> tuple[str, ...]:
    if wanted is None:
        held = {grasp.held for grasp in system.grasps}
        return tuple(name for name in system.points if name not in held) or system.points
    for name in wanted:
        if name not in system.points:
            hint = nearest(name, system.points)
            raise ConfigError(f"there is no point '{name}'", where="track options: points", hint=hint)
    return wanted


def _joint_angles(
    system: System, recording: Recording, known: Sequence[str]
) -> tuple[tuple[float, float] | None, Callable[[float], Array] | None]:
    """Time span of the joints and their angles in the order of `known`, None without a robot."""
    if not known:
        return None, None
    joints = recording.joints
    if joints is None:
        raise DataError(
            "the recording has no joint angles, which the self-filter and the grasps need", where=recording.name
        )
    for name in known:
        if name not in joints.names:
            raise DataError(
                f"joint '{name}' of the model is not recorded",
                where=f"{recording.name}: joints",
                hint=nearest(name, joints.names),
            )
    columns = [joints.names.index(name) for name in known]
    t, position = joints.t, joints.position[:, columns]

    def angles(at: float) -> Array:
        after = int(np.clip(np.searchsorted(t, at), 1, len(t) - 1)) if len(t) > 1 else 0
        if len(t) == 1:
            return np.array(position[0])
        share = float(np.clip((at - t[after - 1]) / (t[after] - t[after - 1]), 0.0, 1.0))
        return np.asarray((1 - share) * position[after - 1] + share * position[after])

    return (float(t[0]), float(t[-1])), angles


def _sorted_frames(stamps: Array) -> tuple[list[int], dict[int, str]]:
    """Frames by time stamp, and why some of them cannot be used: no time, or the time of the one before."""
    reasons = {int(i): "its time stamp is not a number" for i in np.flatnonzero(~np.isfinite(stamps))}
    order = sorted(range(len(stamps)), key=lambda i: (math.inf if i in reasons else float(stamps[i]), i))
    before = -math.inf
    for i in order:
        if i not in reasons:
            if stamps[i] - before < _SAME_TIME:
                reasons[i] = "its time stamp is that of the frame before: a duplicate"
            else:
                before = float(stamps[i])
    return order, reasons

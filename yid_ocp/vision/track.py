"""Tracking of an object's points in a frame sequence: filter, skeleton, shape fit and selection of frames.

A first pass over some frames finds what is common to the sequence (`calibration`). A second one takes frame by frame
and keeps no cloud; every frame ends as a fitted shape or with the reason why it was dropped, and nothing in one frame
stops the sequence. What is left is small and judged in the end (`judgement`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from yid_ocp.data.recording import Recording
from yid_ocp.errors import ConfigError, DataError, ModelError, nearest
from yid_ocp.model.system import System
from yid_ocp.vision.calibration import Calibration, as_given, calibrate
from yid_ocp.vision.clock import is_late, own_offset
from yid_ocp.vision.clutter import Background, Foreign, extra_meshes, foreign
from yid_ocp.vision.common import Common
from yid_ocp.vision.doubt import Sizes, ask_sizes
from yid_ocp.vision.ends import told, touching
from yid_ocp.vision.evidence import Sight
from yid_ocp.vision.filters import Cloud, ObjectRegion, of_colours, voxel_grid, without_outliers, without_robot
from yid_ocp.vision.fit import ShapeFit
from yid_ocp.vision.fitted import Fit
from yid_ocp.vision.frames import FrameSequence
from yid_ocp.vision.judgement import judged, measured, unfit
from yid_ocp.vision.meshes import Mesh, Scene, Surfaces, numeric_mechanism, robot_meshes
from yid_ocp.vision.options import TrackOptions
from yid_ocp.vision.registration import Arm, Glimpse
from yid_ocp.vision.results import FrameReport, Stages, Track
from yid_ocp.vision.skeleton import Skeleton, skeleton
from yid_ocp.vision.starts import Starts, loosened
from yid_ocp.vision.trace import traced
from yid_ocp.vision.view import View

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Progress = Callable[[int, int, str], None]
_Given = tuple[Array, View, Callable[[Array], Mask]]

_ASKED = 8  # frames, at most, that are asked about the object's sizes
_SOME = 2000  # points that tell how far away a cloud is
_LARGEST = 50.0  # [m]; a depth camera sees no further, a cloud in millimetres always does
_SAME_TIME = 1e-6  # [s]
_AS_GOOD = 1.2  # times the distance of the best shape, up to which another one may be the right one
_GRIP = 0.06  # about a grasp, beyond the tube's radius, a point may be the object's [m]


def track(
    scene: Scene,
    recording: Recording | None,
    sequence: FrameSequence,
    options: TrackOptions | None = None,
    *,
    stages: Sequence[int] = (),
    empty: FrameSequence | None = None,
    progress: Progress | None = None,
) -> Track:
    """Track the object's points in a frame sequence.

    Parameters
    ----------
    scene : Scene
        Robot and object; joints that are not elastic must be in the recording. Without a URDF file there is no
        self-filter and no clock offset.
    recording : Recording or None
        Joint angles, for the self-filter, the grasps and the clock; None where the model has no robot.
    sequence : FrameSequence
    options : TrackOptions, optional
    stages : sequence of int
        Frames of the frame sequence of which all stages are kept for pictures, as far as they can be read.
    empty : FrameSequence, optional
        Frames of the scene without robot and object, by the same camera: a background.
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
    tracker = Tracker(scene, recording, sequence, options or TrackOptions(), empty)
    told = progress or (lambda done, total, text: None)
    total = len(tracker.sample) + len(tracker.order)
    common = tracker.common(lambda done, text: told(done, total, text))
    frames = []
    for done, i in enumerate(tracker.order, start=len(tracker.sample)):
        told(done, total, f"fitting {sequence.names[i]}")
        frames.append(tracker.frame(i, common))
    told(total, total, "done")
    found = tracker.finished(*tracker.judged(frames), common)
    drawn = (tracker.stages(frame, common) for frame in found.frames if frame.index in stages)
    return replace(found, stages=tuple(entry for entry in drawn if entry is not None))


@dataclass(eq=False)
class _Work:
    """A frame while it is worked on: its report so far and what is left of its cloud."""

    report: FrameReport
    filtered: Cloud | None = None
    skeleton: Skeleton | None = None

    def dropped(self, reason: str) -> _Work:
        self.report = replace(self.report, reason=reason)
        return self


@dataclass(frozen=True, eq=False)
class _Look:
    """What a frame shows, once for every way in which it may, the robot's configuration, and where searches begin."""

    sights: tuple[Sight, ...]
    q: Array
    starts: tuple[tuple[Array, ...], ...]


class Tracker:
    """Tracker of single frames of a sequence, in any process.

    Parameters
    ----------
    scene, recording, sequence, options, empty
        As `track`.

    Attributes
    ----------
    order : tuple of int
        All frames by their stamps.
    sample : tuple of int
        Frames from which what is common to all of them is found.
    """

    def __init__(
        self,
        scene: Scene,
        recording: Recording | None,
        sequence: FrameSequence,
        options: TrackOptions,
        empty: FrameSequence | None = None,
    ) -> None:
        system, values = scene.system, scene.values
        self._loose: tuple[str, ...] = ()
        anywhere = options.root != "model"
        if anywhere:
            if scene.urdf is not None:
                hint = "set track.options.root to model, or model.robot to null"
                raise ConfigError(
                    "a robot holds the object: its root is where the model has it", where="root", hint=hint
                )
            system, self._loose = loosened(system, values)
        self.system, self.values, self.sequence, self.options, self.empty = system, values, sequence, options, empty
        self.shape = self._shape_of(values)
        self.starts = self.shape.starts() if anywhere else None
        self.names = _chosen_points(system, options.points)
        self.region = ObjectRegion(system, options.filters, values, anywhere=anywhere)
        # of a root that is sought nothing that was recorded is needed
        self.span, self.angles = _joint_angles(system, recording, () if anywhere else self.shape.known)
        tree = numeric_mechanism(system, values)
        meshes: dict[int, Mesh] = {}
        if scene.urdf is not None:
            meshes = robot_meshes(scene.urdf, tree, options.mesh)
            if all(joint < 0 for joint in meshes):
                raise ModelError("no link of the robot moves with the model's joints", where=str(scene.urdf))
        for joint, extra in extra_meshes(scene.extra, tree).items():
            meshes[joint] = Mesh.joined([*([meshes[joint]] if joint in meshes else []), *extra])
        self.robot = Surfaces(tree, meshes) if meshes else None
        self.arm: Arm | None = None
        if self.robot is not None and self.span is not None and scene.urdf is not None:
            self.arm = Arm(self.robot, self.posture, self.shape.grips, float(self.shape.radius.max()) + _GRIP)
        self.order, self._reasons = _by_stamp(sequence.t)
        usable = [i for i in self.order if i not in self._reasons]
        self._check_clock(usable)
        if options.filters.colours and sequence.colours is None:
            hint = "leave track.options.filters.colours out, or record clouds with colours"
            raise DataError("the clouds have no colours", where=sequence.source, hint=hint)
        self._asked = _spread(usable, _ASKED)
        self._shapes: dict[tuple[float, ...], ShapeFit] = {(): self.shape}
        self.sample = _spread(usable, options.calibration.frames) if self.arm is not None else []

    def posture(self, t: float) -> Array:
        """Configuration at a time on the joints' clock with the object at rest; constant beyond the recording."""
        q = self.shape.rest.copy()
        if self.angles is not None:
            q[[self.system.mechanism.joint_index(name) for name in self.shape.known]] = self.angles(t)
        return q

    def common(self, progress: Callable[[int, str], None] = lambda done, text: None) -> Common:
        """Calibration shared by the sequence, estimated from some of its frames."""
        calibration = self._calibration(progress)
        progress(len(self.sample), "comparing the object's sizes")
        background = Background()
        filters, noise = self.options.filters, self.options.fit.noise
        if self.empty is not None:
            clouds = [calibration.state.world(self._finite(self.empty, i)[0]) for i in range(len(self.empty))]
            background = Background.empty_scene(clouds, filters.voxel, noise)
        looks = [look for i in self._asked if (look := self._look(i, calibration, background)) is not None]
        last: list[tuple[ShapeFit, Fit]] = []

        def fitted(values: Mapping[str, float], starts: Sequence[Array]) -> list[Fit]:
            shape = self._shape_of(values)
            before: list[Array | None] = list(starts) if len(starts) == len(looks) else [None] * len(looks)
            last[:] = [
                (shape, shape.solve(look.sights[0], look.q, look.starts[0] if start is None else (start,)))
                for look, start in zip(looks, before, strict=True)
            ]
            return [fit for _, fit in last]

        shared = 0.0
        if looks:
            places = self.shape.place(looks[0].q)
            still = np.zeros(places.shape)
            shared = float(calibration.common_std(places, still, np.zeros(len(places))).max())
        sizes = ask_sizes(self.system, self.values, self.options.estimate, (noise, shared), fitted)
        if self.options.background == "frames":
            shapes = [shape.tubes(fit.q) for shape, fit in last if not unfit(fit, shape, self.options)]
            clouds = [look.sights[0].points for look in looks]
            found = Background.still(clouds, shapes, 2 * filters.voxel, noise, self.shape.near)
            points = np.concatenate([found.points, background.points])
            background = Background(points, max(found.within, background.within))
        return Common(calibration, sizes, background)

    def _calibration(self, progress: Callable[[int, str], None]) -> Calibration:
        options = self.options
        if self.arm is None:
            return as_given(self.sequence.pose, options.clock, "no robot to compare")
        glimpses = []
        for done, i in enumerate(self.sample):
            progress(done, f"reading {self.sequence.names[i]}")
            try:
                points = self._points(i)
            except DataError:
                continue  # the second pass says why
            glimpses.append(Glimpse(float(self.sequence.t[i]), voxel_grid(points, options.filters.voxel).points))
        progress(len(self.sample), "calibrating the camera by the arm")
        rng = np.random.default_rng(options.seed)
        pose, source = self.sequence.pose, self.sequence.source
        return calibrate(self.arm, glimpses, pose, rng, options.calibration, options.clock, source)

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

    def _shape(self, sizes: Sizes) -> ShapeFit:
        """The object with the sizes that were estimated."""
        key = tuple(np.where(sizes.used, sizes.change, 0.0).tolist()) if any(sizes.used) else ()
        if key not in self._shapes:
            self._shapes[key] = self._shape_of(sizes.values(self.system, self.values))
        return self._shapes[key]

    def _shape_of(self, values: Mapping[str, float] | None) -> ShapeFit:
        return ShapeFit(self.system, self.options.fit, values, self._loose)

    def _removed(self, q: Array, calibration: Calibration, background: Background) -> Callable[[Array], Mask]:
        """Which places the filters leave no points of, the robot at a configuration."""
        region, padding = self.region.at(q, calibration.camera), self.options.filters.padding
        within = padding + float(self.shape.radius.max())

        def removed(places: Array) -> Mask:
            gone = ~region.contains(places)
            if self.robot is not None:
                gone |= self.robot.within(places, q, within)
            return gone | background.contains(places, float(self.shape.radius.max()))

        return removed

    def _points(self, index: int) -> Array:
        """A frame's finite points in the camera's frame."""
        return self._finite(self.sequence, index)[0]

    @staticmethod
    def _finite(sequence: FrameSequence, index: int) -> tuple[Array, Mask]:
        """A frame's finite points in the camera's frame, and which of all its points they are."""
        points = sequence.load(index)
        finite: Mask = np.isfinite(points[:, 0] + points[:, 1] + points[:, 2])
        points = points if finite.all() else points[finite]
        if not len(points):
            raise DataError("the cloud is empty")
        far = float(np.median(np.abs(points[:: 1 + len(points) // _SOME]).max(axis=1)))
        if far > _LARGEST:
            raise DataError(f"the cloud is not in metres: half of its points are {far:.0f} m away (millimetres?)")
        return points, finite

    def _read(self, index: int, calibration: Calibration) -> tuple[Cloud, Array]:
        """A frame's cloud in the world where the object can be, the robot's points among them, and all its points."""
        found, finite = self._finite(self.sequence, index)
        points = calibration.state.world(found)
        filters = self.options.filters
        q = self.posture(float(calibration.state.time(self.sequence.t[index])))
        inside = self.region.at(q, calibration.camera).contains(points)
        if not inside.any():
            raise DataError("no point lies where the object can be: check the camera's pose")
        if filters.colours and self.sequence.colours is not None:
            colours = self.sequence.colours(index)
            if colours is None:
                raise DataError("the cloud has no colours")
            inside[inside] = of_colours(colours[finite][inside], filters.colours, filters.colour_angle)
            if not inside.any():
                raise DataError("no point has one of the object's colours: check filters.colours")
        return voxel_grid(points[inside], filters.voxel), points

    def frame(self, index: int, common: Common) -> FrameReport:
        """Report of one frame, independent of other frames."""
        return self._work(index, common).report

    def stages(self, frame: FrameReport, common: Common) -> Stages | None:
        """Processing stages of a frame, for figures; None if its cloud cannot be read."""
        try:
            cloud = common.calibration.state.world(self.sequence.load(frame.index))
        except DataError:
            return None
        work = self._work(frame.index, common)
        filtered = None if work.filtered is None else work.filtered.points
        return Stages(
            frame.name, frame.reason, common.calibration.camera, cloud, filtered, work.skeleton, work.report.fit
        )

    def unread(self, index: int, calibration: Calibration, reason: str) -> FrameReport:
        """Report of a frame before processing, with the reason if it is dropped."""
        stamp = float(self.sequence.t[index])
        t = float(calibration.state.time(stamp))
        return FrameReport(index, self.sequence.names[index], stamp, t, reason, 0, 0, 0, math.nan, 0.0, None)

    def judged(self, frames: Sequence[FrameReport]) -> tuple[list[FrameReport], str]:
        """Frames with outlying ones dropped, and how the root end was chosen."""
        rooted, note = told(frames, self.options)
        return judged(rooted, self.options), note

    def finished(self, frames: Sequence[FrameReport], note: str, common: Common) -> Track:
        """Tracking result of the frames; `DataError` if none is good."""
        columns = [self.system.points.index(name) for name in self.names]
        things = self.things(frames)
        points = measured(frames, columns, common, things, self.options, self.sequence.source)
        return Track(
            self.names,
            points.t,
            points.q,
            points.position,
            points.std,
            points.common,
            tuple(frames),
            common.calibration,
            common.sizes,
            things,
            note,
            (),
            self.system.points,
            self._shape(common.sizes).place,
        )

    def things(self, frames: Sequence[FrameReport]) -> tuple[Foreign, ...]:
        """Foreign objects seen in the fitted frames."""
        fitted = [(frame.t, frame.fit) for frame in frames if frame.fit is not None]
        if not fitted:
            return ()
        corners = np.concatenate([fit.centre_line.reshape(-1, 3) for _, fit in fitted])
        radius = float(self.shape.radius.max())
        box = corners.min(axis=0) - radius, corners.max(axis=0) + radius
        seen, noise = [(t, fit.things) for t, fit in fitted], self.options.fit.noise
        coloured, still = self.sequence.colours is not None, self.options.background == "frames"
        return foreign(seen, len(fitted), noise, box, self._links, coloured, still)

    def _links(self, t: float) -> dict[str, Array]:
        """Poses of what moves with the robot at a time, by the names of the joints."""
        if self.robot is None:
            return {}
        poses = self.robot.poses(self.posture(t))
        names = self.system.mechanism.joint_names
        return {
            _link_of(self.system, names[j]): pose for j, pose in zip(self.robot.joints, poses, strict=True) if j >= 0
        }

    def _work(self, index: int, common: Common) -> _Work:
        work = _Work(self.unread(index, common.calibration, self._reasons.get(index, "")))
        look = self._prepared(work, common.calibration, common.background)
        if look is None:
            return work
        begun = time.process_time()
        shape = self._shape(common.sizes)
        fits = [shape.solve(sight, look.q, starts) for sight, starts in zip(look.sights, look.starts, strict=True)]
        fits.sort(key=lambda fit: fit.distance)
        reason = unfit(fits[0], shape, self.options)
        if self.starts is not None and not reason and touching(fits[0].centre_line, shape.radius):
            reason = "the object crosses or touches itself"
        other = fits[1] if len(fits) > 1 and fits[1].distance < _AS_GOOD * fits[0].distance else None
        spent = work.report.seconds + time.process_time() - begun
        work.report = replace(work.report, fit=fits[0], other=other, reason=reason, seconds=spent)
        return work

    def _look(self, index: int, calibration: Calibration, background: Background) -> _Look | None:
        """A frame that can be fitted; None for others."""
        return self._prepared(
            _Work(self.unread(index, calibration, self._reasons.get(index, ""))), calibration, background
        )

    def _prepared(self, work: _Work, calibration: Calibration, background: Background) -> _Look | None:
        """What a frame shows of the object, None with the reason in its report."""
        options, index, stamp, t = self.options, work.report.index, work.report.stamp, work.report.t
        if work.report.reason:
            return None
        try:
            cloud, raw = self._read(index, calibration)
        except DataError as error:
            work.dropped(error.what)
            return None
        work.report = replace(work.report, raw=len(raw))
        if self.span is not None and not self.span[0] <= t <= self.span[1]:
            work.dropped("there are no joint angles at its time")
            return None
        rng = np.random.default_rng([options.seed, index])
        usual = calibration.usual
        if self.arm is not None and usual is not None:
            own = own_offset(self.arm, calibration.state, stamp, cloud.points, rng, usual.misfit)
            if own is not None and math.isfinite(own.std):
                work.report = replace(work.report, delay=own.delay)
                if is_late(own, options.clock):
                    work.dropped(f"its stamp is late: by {1e3 * own.delay:.0f} ms")
                    return None
        q = self.posture(t)
        filters, kept = options.filters, np.ones(len(cloud), bool)
        if self.robot is not None:
            kept = without_robot(cloud, self.robot, q, filters.padding)
        kept[kept] = ~background.contains(cloud.points[kept])
        # beside the robot's points: among all surfaces, wrong points are few
        cloud = cloud.keep(without_outliers(cloud, filters.neighbours, filters.outlier_ratio, kept))
        work.filtered, work.report = cloud, replace(work.report, filtered=len(cloud))
        if len(cloud) < options.filters.least:
            work.dropped(f"too few points of the object: {len(cloud)} left")
            return None
        if len(cloud) > options.filters.most:
            cloud = cloud.keep(np.sort(rng.choice(len(cloud), options.filters.most, replace=False)))
            work.report = replace(work.report, filtered=len(cloud))
        begun = time.process_time()
        view = View(raw, calibration.state.pose, self.sequence.intrinsics, cloud.points)
        given = calibration.camera, view, self._removed(q, calibration, background)
        try:
            look = (
                self._held(work, cloud, q, rng, given)
                if self.starts is None
                else self._anywhere(self.starts, work, cloud, rng, given)
            )
        except DataError as error:
            work.dropped(error.what)
            return None
        work.report = replace(work.report, seconds=time.process_time() - begun)
        return look

    def _held(self, work: _Work, cloud: Cloud, q: Array, rng: np.random.Generator, given: _Given) -> _Look:
        """What is seen of an object whose root is where the model has it."""
        found = skeleton(cloud, rng, self.options.walk)
        work.skeleton, work.report = found, replace(work.report, nodes=len(found.nodes))
        if not len(found.nodes):
            raise DataError("no part of the cloud is dense enough for a skeleton")
        rest = cloud.keep(found.connected)
        work.filtered = rest
        return _Look((Sight(rest.points, rest.weight, found.nodes, *given),), q, ((),))

    def _anywhere(self, starts: Starts, work: _Work, cloud: Cloud, rng: np.random.Generator, given: _Given) -> _Look:
        """What is seen of an object whose root is sought, with the ends that it may have where."""
        diameter, options = 2.0 * float(self.shape.radius.max()), self.options
        course = traced(cloud, diameter, options.walk.link_length, rng)
        work.skeleton, work.report = course.skeleton, replace(work.report, nodes=len(course.nodes))
        if len(course.loops):
            raise DataError("the object crosses or touches itself: its cloud closes a loop")
        found = starts.of(course)
        if options.root_near is not None:
            place = np.array(options.root_near)
            near = min(found, key=lambda start: float(np.linalg.norm(start.root - place))).root
            found = [start for start in found if np.array_equal(start.root, near)]
        own = cKDTree(course.nodes).query(cloud.points)[0] < 2.0 * diameter
        rest = cloud.keep(own)
        work.filtered = rest
        sights = tuple(Sight(rest.points, rest.weight, course.nodes, *given, anchors=start.anchors) for start in found)
        return _Look(sights, self.shape.rest, tuple((start.q,) for start in found))


def _link_of(system: System, joint: str) -> str:
    """Name of a frame that stands still beside a joint's moving side: its link, as far as the model has it."""
    index = system.mechanism.joint_index(joint)
    return next((name for name, frame in system.mechanism.frames.items() if frame.joint == index), joint)


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
    system: System, recording: Recording | None, known: Sequence[str]
) -> tuple[tuple[float, float] | None, Callable[[float], Array] | None]:
    """Time span of the joints and their angles in the order of `known`, None without a robot."""
    if not known:
        return None, None
    need = "which the self-filter and the grasps need"
    if recording is None:
        hint = "list the recording that was made with the frames under recordings.estimate, or set model.robot to null"
        raise DataError(f"there is no recording with the joint angles, {need}", where="track", hint=hint)
    joints = recording.joints
    if joints is None:
        raise DataError(f"the recording has no joint angles, {need}", where=recording.name)
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


def _by_stamp(stamps: Array) -> tuple[tuple[int, ...], dict[int, str]]:
    """Frames by time stamp, and why some are of no use: they have none, or that of the one before."""
    reasons = {int(i): "its time stamp is not a number" for i in np.flatnonzero(~np.isfinite(stamps))}
    order = sorted(range(len(stamps)), key=lambda i: (math.inf if i in reasons else float(stamps[i]), i))
    before = -math.inf
    for i in order:
        if i not in reasons:
            if stamps[i] - before < _SAME_TIME:
                reasons[i] = "its time stamp is that of the frame before: a duplicate"
            else:
                before = float(stamps[i])
    return tuple(order), reasons


def _spread(indices: Sequence[int], most: int) -> tuple[int, ...]:
    """So many of the indices at most, evenly spread."""
    if len(indices) <= most:
        return tuple(indices)
    return tuple(indices[int(k)] for k in np.linspace(0, len(indices) - 1, most).round())

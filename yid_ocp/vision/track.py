"""Tracking of an object's points in a frame sequence, from filtering to shape fit and frame selection.

A first pass over some frames estimates the calibration shared by the sequence. A second pass processes each frame and
keeps no cloud. Each frame gets a fitted shape or a reason why it was dropped.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from yid_ocp.arrays import Array, BoolArray
from yid_ocp.data.recording import Recording
from yid_ocp.errors import ConfigError, DataError, ModelError, require_known_names
from yid_ocp.model.system import System
from yid_ocp.sensors.base import recorded_joint_column_indices
from yid_ocp.vision import frame_selection, point_cloud, sequence_calibration, surface_meshes
from yid_ocp.vision.calibration import (
    CameraCalibration,
    calibrate_camera,
    calibration_without_estimation,
    stamp_delay_beyond_clock_offset,
)
from yid_ocp.vision.camera_registration import MovingArmSurface, StampedCloud
from yid_ocp.vision.fit import MAX_INFORMATIVE_SURFACE_DISTANCE, ShapeFitter
from yid_ocp.vision.frame_selection import TrackOptions
from yid_ocp.vision.frames import FrameSequence, OcclusionMap, dropped_frame_error
from yid_ocp.vision.point_cloud import CloudSkeleton, ReachableObjectRegion, WeightedCloud
from yid_ocp.vision.sequence_calibration import BackgroundPoints, SequenceEstimates
from yid_ocp.vision.shape_evidence import FrameShapeFit, ProcessedFrameCloud
from yid_ocp.vision.shape_guesses import InitialShape, add_free_root_joints, cloud_centerline_tree
from yid_ocp.vision.surface_meshes import ArticulatedSurfaces, SceneDescription, TriangleMesh
from yid_ocp.vision.track_result import FrameReport, SingleFrameStages, TrackResult

_MIN_POINTS, _MAX_POINTS = 150, 6000  # of an object in a frame: fewer are too few, of more a random subset is used
_MAX_SIZED_FRAMES = 8  # largest number of frames used to estimate the object's dimensions
_DISTANCE_SAMPLE_POINTS = 2000  # points that estimate the distance of a cloud
_MAX_DISTANCE = 50.0  # [m]; a depth camera sees no further, a cloud in millimetres always does
_SAME_TIME_TOLERANCE = 1e-6  # [s]
_RIVAL_SHAPE_RATIO = 1.2  # times the distance of the best shape, up to which another one may be the right one
_GRASP_MARGIN = 0.06  # about a grasp, beyond the tube's radius, a point may be the object's [m]


def track_object(
    scene: SceneDescription,
    recording: Recording | None,
    sequence: FrameSequence,
    options: TrackOptions | None = None,
    *,
    empty: FrameSequence | None = None,
) -> TrackResult:
    """Track the object's points in a frame sequence.

    `recording` must contain all non-elastic joints, for the self-filter, the grasps and the clock; it is None if the
    model has no robot. Without a URDF file, there is no self-filter and no clock offset. `empty` holds frames of the
    background without robot and object, by the same camera.

    Raises `DataError` if the data do not fit or no frame is good (with the reasons), `ConfigError` if a point does not
    exist in the system, and `ModelError` if meshes cannot be read.
    """
    tracker = SingleFrameTracker(scene, recording, sequence, options or TrackOptions(), empty)
    common = tracker.estimate_shared_values()
    frames = [tracker.process_one_frame(i, common) for i in tracker.frame_order]
    return tracker.track_result_from_frame_reports(*tracker.align_root_ends_and_mark_outlying_frames(frames), common)


class _Look(NamedTuple):
    """Data of a frame for the shape fit: its cloud with each assignment of ends, configuration, and initial shapes."""

    sights: Sequence[ProcessedFrameCloud]
    q: Array
    starts: Sequence[Sequence[Array]]


class SingleFrameTracker:
    """A tracker that processes frames one by one, in any process. Arguments are as in `track_object`.

    `frame_order` lists all frames by time stamp, `calibration_frames` the frames used to calibrate the camera.
    """

    def __init__(
        self,
        scene: SceneDescription,
        recording: Recording | None,
        sequence: FrameSequence,
        options: TrackOptions,
        empty: FrameSequence | None = None,
    ) -> None:
        system, values = scene.system, scene.parameter_values
        loose: tuple[str, ...] = ()
        anywhere = options.root_placement != "model"
        if anywhere and scene.robot_urdf is not None:
            hint = "set track.options.root_placement: model; to track the object without a robot, model.robot: null"
            what = f"root_placement is '{options.root_placement}', but the robot determines the place of the object"
            raise ConfigError(what, where="track.options.root_placement", allowed="model", hint=hint)
        if anywhere:
            system, loose = add_free_root_joints(system, values)
        self.system, self.parameter_values = system, values
        self.sequence, self.options, self.empty_scene = sequence, options, empty
        self.shape_fitter = ShapeFitter(system, values, loose, options.surface_noise_std)
        self.make_shape_guess_finder = self.shape_fitter.make_shape_guess_finder() if anywhere else None
        self.point_names = _chosen_points(system, options.tracked_points)
        self.object_region = ReachableObjectRegion(system, options.filters, values, anywhere=anywhere)
        # a root to be found needs no recorded joints
        known = () if anywhere else self.shape_fitter.recorded_joint_names
        self.joint_time_span, self.joint_angles_at = _joint_angles(recording, known)
        tree = system.mechanism_with_values(values)
        meshes = surface_meshes.extra_meshes_by_joint_index(scene.surfaces_missing_from_urdf, tree)
        if scene.robot_urdf is not None:
            robot = surface_meshes.load_robot_meshes_by_joint(scene.robot_urdf, tree)
            if all(joint < 0 for joint in robot):
                what, where = "no link that the model's joints move has a mesh in this URDF", str(scene.robot_urdf)
                allowed = "a URDF with meshes of moved links, by which `track` removes the arm from the clouds"
                hint = "set model.robot to a URDF with meshes, or correct model.arms.joints"
                raise ModelError(what, where=where, allowed=allowed, hint=hint)
            meshes |= {joint: [mesh, *meshes.get(joint, ())] for joint, mesh in robot.items()}
        whole = {joint: TriangleMesh.concatenate(parts) for joint, parts in meshes.items()}
        self.robot_surfaces = ArticulatedSurfaces(tree, whole) if whole else None
        self.arm_surface: MovingArmSurface | None = None
        self._widest = float(self.shape_fitter.link_radii.max())
        if self.robot_surfaces is not None and self.joint_time_span is not None and scene.robot_urdf is not None:
            held = self.shape_fitter.gripper_positions_at_configuration, self._widest + _GRASP_MARGIN
            self.arm_surface = MovingArmSurface(self.robot_surfaces, self._configuration_at_rest, *held)
        self.frame_order, self._reasons = _by_stamp(sequence.stamps)
        usable = [i for i in self.frame_order if i not in self._reasons]
        self._check_clock(usable)
        if options.filters.object_colours and sequence.load_colours is None:
            hint = "leave track.options.filters.object_colours out, or record clouds with colours"
            raise DataError("the clouds have no colours", where=sequence.source, allowed="coloured clouds", hint=hint)
        self._asked = _spread(usable, _MAX_SIZED_FRAMES)
        self._shapes: dict[tuple[float, ...], ShapeFitter] = {}
        self.calibration_frames = _spread(usable, options.calibration.n_frames) if self.arm_surface is not None else ()

    def _configuration_at_rest(self, t: float) -> Array:
        """Configuration (n,) at a time of the joints' clock, with an undeformed object; constant beyond the joints."""
        q = self.shape_fitter.rest_configuration.copy()
        if self.joint_angles_at is not None:
            q[self.shape_fitter.recorded_joint_indices] = self.joint_angles_at(t)
        return q

    def estimate_shared_values(self) -> SequenceEstimates:
        """Estimate camera calibration, tube dimensions and background, which all frames share, from some frames."""
        calibration = self._calibration()
        filters, noise = self.options.filters, self.options.surface_noise_std
        scene, to_world = self.empty_scene, calibration.camera_state.measured_to_world_points
        clouds = [] if scene is None else [to_world(self._finite(scene, i)[0]) for i in range(len(scene))]
        background = BackgroundPoints.from_point_clouds(clouds, filters.voxel_size, noise)
        looks = [look for i in self._asked if (look := self._look(i, calibration, background)[1]) is not None]
        last: list[tuple[ShapeFitter, FrameShapeFit]] = []

        def fitted(values: Mapping[str, float], starts: Sequence[Array]) -> list[FrameShapeFit]:
            shape = self.shape_fitter.with_parameter_values(values)
            begun = [(q,) for q in starts] if len(starts) == len(looks) else [look.starts[0] for look in looks]
            fits = [shape.fit_frame(look.sights[0], look.q, q) for look, q in zip(looks, begun, strict=True)]
            last[:] = [(shape, fit) for fit in fits]
            return fits

        shared = 0.0
        if looks:
            places = self.shape_fitter.point_positions_at_configuration(looks[0].q)
            shared = float(calibration.point_std_from_calibration(places, 0 * places, np.zeros(len(places))).max())
        of = self.system, self.parameter_values, self.options.estimated_dimensions
        sizes = sequence_calibration.estimate_and_check_tube_dimensions(*of, (noise, shared), fitted)
        if self.options.background_estimation == "frames":
            good = (pair for pair in last if not frame_selection.frame_rejection_reason(pair[1], pair[0], self.options))
            shapes = [shape.tube_links_at_configuration(fit.q) for shape, fit in good]
            clouds = [look.sights[0].points for look in looks]
            reach = MAX_INFORMATIVE_SURFACE_DISTANCE
            found = BackgroundPoints.from_point_clouds(clouds, 2 * filters.voxel_size, noise, shapes, reach)
            points = np.concatenate([found.points, background.points])
            background = BackgroundPoints(points, max(found.match_distance, background.match_distance))
        return SequenceEstimates(calibration, sizes, background)

    def _calibration(self) -> CameraCalibration:
        options, pose = self.options, self.sequence.camera_pose
        if self.arm_surface is None:
            return calibration_without_estimation(pose, options.clock_offset_search, "there is no robot to compare")
        glimpses, failed = list[StampedCloud](), list[DataError]()
        for i in self.calibration_frames:
            try:
                points, _ = self._finite(self.sequence, i)
            except DataError as error:
                failed.append(error)  # the second pass reports the reasons of all frames
                continue
            thinned = point_cloud.voxel_averages(points, options.filters.voxel_size).points
            glimpses.append(StampedCloud(float(self.sequence.stamps[i]), thinned))
        rng = np.random.default_rng(options.seed)
        source, clock = self.sequence.source, options.clock_offset_search
        if failed and not glimpses and (clock.search_half_width > 0 or not options.calibration.fix_pose):
            what = f"none of {len(failed)} frames can be used to calibrate the camera. In the first, {failed[0].what}"
            raise DataError(what, where=failed[0].where, allowed=failed[0].allowed, hint=failed[0].hint)
        return calibrate_camera(self.arm_surface, glimpses, pose, rng, options.calibration, clock, source)

    def _check_clock(self, usable: Sequence[int]) -> None:
        if self.joint_time_span is None or not usable:
            return
        stamps, search = self.sequence.stamps[list(usable)], self.options.clock_offset_search
        offset, reach = search.initial_stamp_minus_joint_time, search.search_half_width
        first, last = float(stamps.min()) - offset, float(stamps.max()) - offset
        begin, end = self.joint_time_span
        if first > end + reach or last < begin - reach:
            spans = f"the frames run from {first:.3f} s to {last:.3f} s, the joints from {begin:.3f} s to {end:.3f} s"
            hint = "set track.options.clock_offset_search.initial_stamp_minus_joint_time: "
            hint += f"{first + offset - begin:.3f} if frames and joints started together"
            what, allowed = f"the clocks differ: {spans}", f"times that overlap if shifted by up to {reach:g} s"
            raise DataError(what, where=self.sequence.source, allowed=allowed, hint=hint)

    def _shape(self, sizes: sequence_calibration.TubeDimensionEstimates) -> ShapeFitter:
        """The shape fitter with the estimated dimensions of the object."""
        values = sizes.parameters_with_fitted_dimensions(self.system, self.parameter_values)
        key = tuple(values.values())
        if key not in self._shapes:
            self._shapes[key] = self.shape_fitter.with_parameter_values(values)
        return self._shapes[key]

    def _removed(
        self, q: Array, calibration: CameraCalibration, background: BackgroundPoints, beyond: float
    ) -> Callable[[Array], BoolArray]:
        """Function that returns the mask of the positions (S, 3) that the filters remove, for the robot at `q`.

        Positions up to `beyond` [m] further from the robot and the background than its distance are removed as well.
        """
        is_inside = self.object_region.membership_mask_function_at(q, calibration.camera_position)
        within = self.options.filters.robot_padding + beyond

        def removed(places: Array) -> BoolArray:
            gone = ~is_inside(places) | background.near_background_mask(places, beyond)
            if self.robot_surfaces is not None:
                gone |= self.robot_surfaces.within_surface_distance_mask(places, q, within)
            return gone

        return removed

    @staticmethod
    def _finite(sequence: FrameSequence, index: int) -> tuple[Array, BoolArray]:
        """A frame's finite points in the camera's frame, and their indices among all its points."""
        points, where = sequence.load_cloud(index), f"{sequence.source}: {sequence.frame_names[index]}"
        finite: BoolArray = np.isfinite(points[:, 0] + points[:, 1] + points[:, 2])
        points = points if finite.all() else points[finite]
        if not len(points):
            what, allowed, hint = "the cloud has no finite points", "finite x y z", "export it again"
            raise DataError(what, where=where, allowed=allowed, hint=hint)
        far = float(np.median(np.abs(points[:: 1 + len(points) // _DISTANCE_SAMPLE_POINTS]).max(axis=1)))
        if far > _MAX_DISTANCE:
            what = f"the cloud is not in metres: half of its points are {far:.0f} m away or more"
            hint = "if the cloud is in mm, set track.point_cloud_unit: mm, or unit: mm in camera.json"
            raise DataError(what, where=where, allowed=f"points within {_MAX_DISTANCE:.0f} m", hint=hint)
        return points, finite

    def _read(self, index: int, calibration: CameraCalibration) -> tuple[WeightedCloud, Array]:
        """A frame's averaged world points in the region that the object can reach, and all its world points."""
        found, finite = self._finite(self.sequence, index)
        state, filters = calibration.camera_state, self.options.filters
        points = state.measured_to_world_points(found)
        q = self._configuration_at_rest(float(state.stamps_to_joint_clock(self.sequence.stamps[index])))
        inside = self.object_region.membership_mask_function_at(q, calibration.camera_position)(points)
        if not inside.any():
            raise dropped_frame_error("no point lies in the region that the object can reach: check track.camera_pose")
        if filters.object_colours and self.sequence.load_colours is not None:
            colours = self.sequence.load_colours(index)
            if colours is None:
                raise dropped_frame_error("the cloud has no colours: leave track.options.filters.object_colours out")
            inside[inside] = point_cloud.wanted_colour_mask(colours[finite][inside], filters.object_colours)
            if not inside.any():
                raise dropped_frame_error("no point has a colour of track.options.filters.object_colours")
        return point_cloud.voxel_averages(points[inside], filters.voxel_size), points

    def process_one_frame(self, index: int, common: SequenceEstimates) -> FrameReport:
        """Process one frame, independent of other frames, and return its report."""
        work, look = self._look(index, common.camera_calibration, common.background)
        if look is None:
            return work.report
        begun, shape = time.process_time(), self._shape(common.dimensions)
        fits = [shape.fit_frame(sight, look.q, starts) for sight, starts in zip(look.sights, look.starts, strict=True)]
        fits.sort(key=lambda fit: fit.mean_distance)
        reason = frame_selection.frame_rejection_reason(fits[0], shape, self.options)
        anywhere = self.make_shape_guess_finder is not None
        if anywhere and not reason and frame_selection.is_shape_self_touching(fits[0].link_ends, shape.link_radii):
            reason = "the object crosses or touches itself"
        is_rival = len(fits) > 1 and fits[1].mean_distance < _RIVAL_SHAPE_RATIO * fits[0].mean_distance
        other = fits[1] if is_rival else None
        spent = work.report.cpu_seconds + time.process_time() - begun
        work.update_report(shape_fit=fits[0], alternative_fit=other, cpu_seconds=spent, drop_reason=reason or "")
        return work.report

    def frame_clouds_and_skeleton(self, frame: FrameReport, common: SequenceEstimates) -> SingleFrameStages | None:
        """Return a frame's raw cloud, filtered cloud and skeleton for figures. None if its cloud cannot be read."""
        calibration = common.camera_calibration
        try:
            cloud = calibration.camera_state.measured_to_world_points(self.sequence.load_cloud(frame.index))
        except DataError:
            return None
        stages, _ = self._look(frame.index, calibration, common.background)
        stages.report, stages.raw_points = frame, cloud
        return stages

    def frame_report_before_processing(self, index: int, calibration: CameraCalibration, reason: str) -> FrameReport:
        """Return a frame's report before its processing. `reason` says why the frame is dropped; empty if it is not."""
        stamp = float(self.sequence.stamps[index])
        t = float(calibration.camera_state.stamps_to_joint_clock(stamp))
        return FrameReport(index, self.sequence.frame_names[index], stamp, t, reason, 0, 0, 0, math.nan, 0.0, None)

    def align_root_ends_and_mark_outlying_frames(self, frames: Sequence[FrameReport]) -> tuple[list[FrameReport], str]:
        """Choose one root end for all frames, and mark outlying frames as dropped. Returns frames and a root note."""
        rooted, note = frame_selection.choose_root_end_of_frames(frames, self.options)
        grasped = [grasp.held_frame for grasp in self.system.grasps]
        return frame_selection.mark_outlying_frames_as_dropped(rooted, grasped), note

    def track_result_from_frame_reports(
        self, frames: Sequence[FrameReport], note: str, common: SequenceEstimates
    ) -> TrackResult:
        """Make the tracking result from frame reports. Raises `DataError` if no frame is good."""
        columns = [self.system.point_frames.index(name) for name in self.point_names]
        things = self.find_foreign_objects(frames)
        of = common, things, self.options, self.sequence.source
        measured = frame_selection.times_configurations_points_of_good_frames(frames, columns, *of)
        place = self._shape(common.dimensions).point_positions_at_configuration
        return TrackResult(
            self.point_names,
            *measured,
            frame_reports=tuple(frames),
            camera_calibration=common.camera_calibration,
            dimensions=common.dimensions,
            foreign_objects=things,
            root_note=note,
            _place=lambda q: place(q)[columns],
        )

    def find_foreign_objects(self, frames: Sequence[FrameReport]) -> tuple[sequence_calibration.ForeignObject, ...]:
        """Return what is near the tracked object and neither it nor the robot, one entry for each foreign object."""
        fitted = [(frame.joint_time, frame.shape_fit) for frame in frames if frame.shape_fit is not None]
        if not fitted:
            return ()
        corners = np.concatenate([fit.link_ends.reshape(-1, 3) for _, fit in fitted])
        box = corners.min(axis=0) - self._widest, corners.max(axis=0) + self._widest
        seen, noise = [(t, fit.foreign_clusters) for t, fit in fitted], self.options.surface_noise_std
        coloured, still = self.sequence.load_colours is not None, self.options.background_estimation == "frames"
        return sequence_calibration.foreign_clusters_to_objects(seen, noise, box, self._links, coloured, still)

    def _links(self, t: float) -> dict[str, Array]:
        if self.robot_surfaces is None:
            return {}
        poses = self.robot_surfaces.part_poses_at_configuration(self._configuration_at_rest(t))
        tree, found = self.system.mechanism, {}
        for joint, pose in zip(self.robot_surfaces.part_joints, poses, strict=True):
            if joint >= 0:  # a frame on the joint's moving side has the name of its link, if the model has it
                frames = (name for name, frame in tree.frames.items() if frame.joint_index == joint)
                found[next(frames, tree.joint_names[joint])] = pose
        return found

    def _look(
        self, index: int, calibration: CameraCalibration, background: BackgroundPoints
    ) -> tuple[SingleFrameStages, _Look | None]:
        """The work on a frame, and its data for the shape fit; None, with a reason in the report, if it is dropped."""
        report = self.frame_report_before_processing(index, calibration, self._reasons.get(index, ""))
        work = SingleFrameStages(report, calibration.camera_position)
        try:
            return work, None if work.report.drop_reason else self._prepared(work, calibration, background)
        except DataError as error:
            work.update_report(drop_reason=error.what)
            return work, None

    def _prepared(self, work: SingleFrameStages, calibration: CameraCalibration, background: BackgroundPoints) -> _Look:
        """Prepare a frame's data for the shape fit. Raises `DataError` with the reason if the frame is dropped."""
        index, stamp, t = work.report.index, work.report.stamp, work.report.joint_time
        options, state = self.options, calibration.camera_state
        cloud, raw = self._read(index, calibration)
        work.update_report(n_raw_points=len(raw))
        if self.joint_time_span is not None and not self.joint_time_span[0] <= t <= self.joint_time_span[1]:
            raise dropped_frame_error("no joint angles were recorded at the time of the image")
        rng = np.random.default_rng([options.seed, index])
        typical = calibration.usual_square_distance
        if self.arm_surface is not None and typical is not None:
            own = stamp_delay_beyond_clock_offset(self.arm_surface, state, stamp, cloud.points, rng, typical)
            if own is not None and math.isfinite(own.std):
                work.update_report(stamp_delay=own.delay)
                if own.is_significant:
                    late = f"the image's time stamp is {'late' if own.delay > 0 else 'early'}"
                    raise dropped_frame_error(f"{late}: it is {1e3 * abs(own.delay):.0f} ms off the camera's clock")
        q = self._configuration_at_rest(t)
        kept = ~self._removed(q, calibration, background, 0.0)(cloud.points)
        # relative to the robot's points: among all surfaces, outliers are few
        cloud = cloud.select(point_cloud.statistical_inlier_mask(cloud, kept))
        work.filtered_points = cloud.points
        work.update_report(n_filtered_points=len(cloud))
        if len(cloud) < _MIN_POINTS:
            raise dropped_frame_error(f"too few points of the object are left: {len(cloud)} of {_MIN_POINTS} needed")
        if len(cloud) > _MAX_POINTS:
            cloud = cloud.select(np.sort(rng.choice(len(cloud), _MAX_POINTS, replace=False)))
            work.update_report(n_filtered_points=len(cloud))
        begun = time.process_time()
        removed = self._removed(q, calibration, background, self._widest)
        view = OcclusionMap(raw, state.pose, self.sequence.intrinsics, cloud.points)
        skeleton, mask, guesses = self._trace(work, cloud, rng)
        cloud = cloud.select(mask)
        work.filtered_points = cloud.points
        seen = cloud.points, cloud.point_weights, skeleton.nodes, work.camera_position, view, removed
        sights = [ProcessedFrameCloud(*seen, guess.end_anchors) for guess in guesses] or [ProcessedFrameCloud(*seen)]
        work.update_report(cpu_seconds=time.process_time() - begun)
        return _Look(sights, q, [(guess.q,) for guess in guesses] or [()])

    def _trace(
        self, work: SingleFrameStages, cloud: WeightedCloud, rng: np.random.Generator
    ) -> tuple[CloudSkeleton, BoolArray, list[InitialShape]]:
        """The skeleton of an object in a cloud, the mask of its points, and initial shapes if its root is to be found.

        There is one initial shape for each assignment of the object's ends. Raises `DataError` for an unusable cloud.
        """
        diameter, nearest = 2.0 * self._widest, self.options.approximate_root_position
        if self.make_shape_guess_finder is None:
            work.skeleton = found = point_cloud.extract_skeleton_graph(cloud, rng, diameter)
            work.update_report(n_skeleton_nodes=len(found.nodes))
            if not len(found.nodes):
                raise dropped_frame_error("the points are nowhere dense enough to trace the object")
            return found, found.node_of_point >= 0, []
        course = cloud_centerline_tree(cloud, diameter, point_cloud.MAX_EDGE_LENGTH, rng)
        work.skeleton = course.to_skeleton
        work.update_report(n_skeleton_nodes=len(course.nodes))
        if len(course.loop_positions):
            raise dropped_frame_error("the object crosses or touches itself: its cloud closes a loop")
        starts = self.make_shape_guess_finder.shape_guesses_along_centerline(course)
        if nearest is not None:
            near = min(starts, key=lambda start: math.dist(start.root_position, nearest)).root_position
            starts = [start for start in starts if np.array_equal(start.root_position, near)]
        return work.skeleton, cKDTree(course.nodes).query(cloud.points)[0] < 2.0 * diameter, starts


def _chosen_points(system: System, wanted: tuple[str, ...] | None) -> tuple[str, ...]:
    held = {grasp.held_frame for grasp in system.grasps}
    require_known_names(wanted or (), system.point_frames, "point", "track.options.tracked_points", ConfigError)
    free = tuple(name for name in system.point_frames if name not in held) or system.point_frames
    return free if wanted is None else wanted


def _joint_angles(
    recording: Recording | None, known: Sequence[str]
) -> tuple[tuple[float, float] | None, Callable[[float], Array] | None]:
    """Time span of the joints and their angles in the order of `known`; None without a robot."""
    if not known:
        return None, None
    need = "which the self-filter and the grasps need"
    if recording is None:
        hint = "set recordings.estimate: [FILE.h5] to the recording of the same time, or model.robot: null"
        what, allowed = f"there is no recording with the joint angles, {need}", "the joint angles during the frames"
        raise DataError(what, where="recordings.estimate", allowed=allowed, hint=hint)
    joints = recording.joints
    if joints is None:
        what, where = f"the recording has no joint angles, {need}", f"recording '{recording.name}'"
        hint = "set recordings.estimate: [FILE.h5] to a recording with joints, or model.robot: null"
        raise DataError(what, where=where, allowed="a recording with the group `joints`", hint=hint)
    t, position = joints.t, joints.position[:, recorded_joint_column_indices(joints, tuple(known), recording.name)]
    return (float(t[0]), float(t[-1])), lambda at: np.array([np.interp(at, t, column) for column in position.T])


def _by_stamp(stamps: Array) -> tuple[tuple[int, ...], dict[int, str]]:
    """Indices of the frames by time stamp, and why frames without a stamp or with a repeated stamp are dropped."""
    times = np.where(np.isfinite(stamps), stamps, np.nan)
    order = np.argsort(times, kind="stable")  # NaN come last
    again = order[np.diff(times[order], prepend=-np.inf) < _SAME_TIME_TOLERANCE]
    reasons = dict.fromkeys(np.flatnonzero(np.isnan(times)).tolist(), "the image's time stamp is not a number")
    why = "the image's time stamp equals that of another image, so it is a duplicate"
    return tuple(order.tolist()), reasons | dict.fromkeys(again.tolist(), why)


def _spread(indices: Sequence[int], most: int) -> tuple[int, ...]:
    """At most `most` of the indices, evenly spread over them."""
    return tuple(indices[int(k)] for k in np.linspace(0, len(indices) - 1, min(len(indices), most)).round())

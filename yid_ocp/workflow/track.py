"""The command `track`: track points of the object in depth-camera frames, in parallel, and write a recording."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from yid_ocp import files
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import OutputSettings, RecordingsSettings, RunSettings, config_yaml_with_defaults
from yid_ocp.data.recording import Recording
from yid_ocp.data.recording_hdf5 import read_recording, write_recording
from yid_ocp.display import Progress
from yid_ocp.errors import DataError, YidError
from yid_ocp.model.system import System
from yid_ocp.parallel import InlineExecutor, Task, TaskResult, WorkerConfig, require_task_values, run_tasks
from yid_ocp.report.animation import ConfigurationTrajectory, animation_of_trajectories
from yid_ocp.vision import surface_meshes, track_result
from yid_ocp.vision.fit import ShapeFitter
from yid_ocp.vision.frame_folder import write_frame_folder
from yid_ocp.vision.frame_reading import read_frames
from yid_ocp.vision.frames import FrameSequence, import_open3d, look_at_pose
from yid_ocp.vision.sequence_calibration import ForeignObject, SequenceEstimates
from yid_ocp.vision.surface_meshes import SceneDescription, VirtualFramesWithTruth
from yid_ocp.vision.track import SingleFrameTracker
from yid_ocp.vision.track_result import FrameReport, TrackResult
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.build_problem import data_quality_issues_of_recording, issues_to_plain_data
from yid_ocp.workflow.command_runner import CommandOutcome, make_command_function, worker_config_from_arguments
from yid_ocp.workflow.run_folder import RunFolder, atomic_run_folder
from yid_ocp.workflow.run_inputs import add_setting_location_to_errors, check_names_in_setting, resolve_recording_path

_CONFIG_FILE, _RESULTS_FOLDER = "config.yaml", "done"
_FRAME_KEYS = (
    "name stamp t=joint_time reason=drop_reason raw_points=n_raw_points object_points=n_filtered_points "
    "nodes=n_skeleton_nodes delay=stamp_delay seconds=cpu_seconds"
)


def run_and_return_exit_code(arguments: argparse.Namespace) -> int:
    """Run the command `track` and return its exit code."""
    return make_command_function(partial(_run_track, workers=worker_config_from_arguments(arguments)))(arguments)


def _run_track(
    run: RunSettings, out: str | Path | None, progress: Progress, workers: WorkerConfig | None
) -> CommandOutcome[None]:
    """Track the frames of `track.frames_path` or of a virtual camera. Results of an interrupted run are reused."""
    settings = run.track
    import_open3d()
    with atomic_run_folder(run, out, "track") as folder:
        folder.record_run_start(run, "track")
        system = build_system(run)
        tasks, made = _frame_tasks(run, system, folder, progress)
        found, refused = None, None
        try:
            with add_setting_location_to_errors(run, "track"):
                tracker, recording = _frame_tracker(tasks.work_folder / _CONFIG_FILE), _read_joints(tasks.settings)
                issues = [] if recording is None else data_quality_issues_of_recording(run, system, recording)
                progress.begin_stage("finding what all images share: camera, clock and dimensions (can take minutes)")
                common = tasks.estimate_shared_values()
                progress.begin_stage("fitting the object in every image")
                done = tasks.track_frames(tracker, common, workers or InlineExecutor(), progress)
                frames, note = tracker.align_root_ends_and_mark_outlying_frames(done)
                try:
                    found = tracker.track_result_from_frame_reports(frames, note, common)
                except DataError as error:
                    refused = error
        except YidError as error:
            folder.delete_resume_data(*tasks.resume_files)
            if made is not None and str(folder.resume_folder) in error.where:  # rendered frames, which are not kept
                error.where = run.setting_location("track", "virtual_frames")
            raise
        progress.begin_stage("drawing pictures")
        for frame in _drawn(frames, settings.n_drawn_frames):
            stages = tracker.frame_clouds_and_skeleton(frame, common)
            if stages is not None:
                track_result.draw_frame_processing_stages(stages, folder.path / "pictures")
        result = _track_result(frames, common, tracker.find_foreign_objects(frames), found) | {"root": note}
        told = []
        if found is not None:
            track_result.write_tracked_points_plot(found, folder.path / "track.png")
            tracked = found.recording_with_points(recording)
            write_recording(tracked, folder.path / "recording.h5")
            # tracked points can be out of the object's reach if the model defines its position
            if settings.options.root_placement == "model":
                own = data_quality_issues_of_recording(run, system, tracked)
                issues += [issue for issue in own if issue.cause.startswith("point_")]
            theta = system.parameters.vector()
            shape = ConfigurationTrajectory("fitted shape", tracker.system, theta, found.t, found.configurations)
            told = [animation_of_trajectories("tracked", [shape], tracked)]
            result["truth_errors"] = {} if made is None else _truth_errors(system, found, made)
        result |= {"issues": issues_to_plain_data(issues), "refused": "" if refused is None else refused.what}
        drawn = [folder.path / "track.png", *sorted((folder.path / "pictures").glob("*.png"))]
        more = {"pictures": [path for path in drawn if path.exists()]}
        written = folder.write_result_and_report(run, progress, result, animations=told, section_data=more)
        folder.delete_resume_data(*tasks.resume_files)
    if refused is not None:
        hint = f"{refused.hint}. All reasons, and pictures of readable frames, are in {folder.path}"
        where = refused.where if made is None else run.setting_location("track", "virtual_frames")
        raise DataError(refused.what, where=where, allowed=refused.allowed, hint=hint)
    return CommandOutcome(folder.path, written, None)


def _drawn(frames: Sequence[FrameReport], count: int) -> list[FrameReport]:
    """Return frames to draw: `count` evenly spread ones, and up to `count` dropped ones with different reasons."""
    chosen = {int(i) for i in np.linspace(0, len(frames) - 1, count + 2)[1:-1]}
    reasons = [frames[k].drop_reason.partition(":")[0] for k in sorted(chosen)]
    for k, frame in enumerate(frames):
        kind = frame.drop_reason.partition(":")[0]
        if kind and kind not in reasons and len(chosen) < 2 * count:
            chosen.add(k)
            reasons.append(kind)
    return [frames[k] for k in sorted(chosen)]


def _track_result(
    frames: Sequence[FrameReport], common: SequenceEstimates, things: Sequence[ForeignObject], found: TrackResult | None
) -> dict[str, Any]:
    """Return a `yid-track/1` result without issues, inputs and versions. `found` is None if no frame is good."""
    return {
        "format": "yid-track/1",
        "camera": asdict(common.camera_calibration),
        "sizes": asdict(common.dimensions) | {"messages": list(common.dimensions.messages)},
        "things": [asdict(thing) for thing in things],
        "points": {} if found is None else _points(found),
        "truth_errors": {},
        "dropped": track_result.count_dropped_frames_by_reason(frames),
        "frames": [files.attributes_to_dict(frame, _FRAME_KEYS) for frame in frames],
    }


def _points(found: TrackResult) -> dict[str, Any]:
    points = {}
    for i, name in enumerate(found.point_names):
        seen = np.isfinite(found.position[:, i]).all(axis=1)
        stds = {"std": found.std[seen, i], "common_std": found.shared_std[seen, i]}
        own = {key: float(np.median(std)) if seen.any() else None for key, std in stds.items()}
        points[name] = {"frames": int(seen.sum()), **own}
    return points


def _truth_errors(
    system: System, found: TrackResult, made: VirtualFramesWithTruth
) -> Mapping[str, Mapping[str, float]]:
    shape, columns = ShapeFitter(system), [system.point_frames.index(name) for name in found.point_names]
    truth = np.array([shape.point_positions_at_configuration(made.true_configuration_at(t))[columns] for t in found.t])
    apart = np.linalg.norm(found.position - truth, axis=2)
    return {
        name: {"median": float(np.nanmedian(apart[:, i])), "largest": float(np.nanmax(apart[:, i]))}
        for i, name in enumerate(found.point_names)
        if np.isfinite(apart[:, i]).any()
    }


def _simulate_recording_and_camera_frames(run: RunSettings, system: System) -> tuple[Recording, VirtualFramesWithTruth]:
    """Return recording and camera frames of a virtual experiment, whose truth are the initial parameter values."""
    from yid_ocp.virtual.experiment import VirtualExperimentSettings, recording_from_simulation
    from yid_ocp.virtual.joint_motion import MultisineOptions, grasping_joint_angles, random_multisine_motion
    from yid_ocp.virtual.mujoco_simulation import SimulationOptions, simulate_in_mujoco

    if not system.driven:
        what = "there are no camera frames: track.frames_path is missing"
        hint = "set track.frames_path: PATH. Without it, frames are simulated, which needs model.arms.mode: driven"
        raise run.config_error(what, "track", "frames_path", allowed="a file or folder of camera frames", hint=hint)
    settings, grasps = run.track.virtual_frames, [grasp.name for grasp in system.grasps]
    offsets, key = settings.gripper_start_offset_from_object_end, "gripper_start_offset_from_object_end"
    check_names_in_setting(run, "grasp", offsets, grasps, "track", "virtual_frames", key)
    with add_setting_location_to_errors(run, "track", "virtual_frames"):
        posture = grasping_joint_angles(system, offsets=offsets)
        simulation = SimulationOptions(settings.duration)
        excitation = MultisineOptions(gripper_travel=settings.max_gripper_travel, duration=settings.duration)
        seed = settings.seed
        motion = random_multisine_motion(system, seed=seed, initial_joint_angles=posture, excitation=excitation)
        named: dict[str, Any] = {"recording_name": run.name, "description": run.description}
        experiment = VirtualExperimentSettings(simulation=simulation, camera=None, seed=seed, **named)
        truth = simulate_in_mujoco(system, None, motion, simulation, initial_joint_angles=posture)
        recording = recording_from_simulation(system, None, experiment, truth)
        pose = look_at_pose(settings.camera_position, settings.camera_target)
        timing = files.attributes_to_dict(settings, "mean_rate=frame_rate dropped_frame_fraction latency latency_std")
        camera = surface_meshes.VirtualCameraSetup(pose, seed=seed, **timing)
        made = surface_meshes.render_virtual_frames(_camera_scene(run, system), truth.t, truth.q, camera)
    return recording, made


def _camera_scene(run: RunSettings, system: System) -> SceneDescription:
    return SceneDescription(system, run.model.robot, surfaces_missing_from_urdf=run.model.surfaces_missing_from_urdf)


def _read_frames(run: RunSettings, key: Literal["frames_path", "background_frames_path"]) -> FrameSequence:
    own = run.track
    with add_setting_location_to_errors(run, "track", key):
        return read_frames(getattr(own, key), pose=own.camera_pose, unit=own.point_cloud_unit, topic=own.frame_topic)


def _read_joints(run: RunSettings) -> Recording | None:
    if not run.recordings.estimate:
        return None
    with add_setting_location_to_errors(run, "recordings", "estimate", 0):
        path = resolve_recording_path(run.recordings.estimate[0])
        return replace(read_recording(path, allow_nan_effort=True), name=path.stem)


def _frame_tracker(config: Path) -> SingleFrameTracker:
    """Return the tracker of the frames in files. A process makes it once while the configuration has the same text."""
    return _tracker(config.absolute(), files.read_input_text(config))


@lru_cache(maxsize=1)  # another configuration replaces it, because frames take much memory
def _tracker(config: Path, text: str) -> SingleFrameTracker:
    del text
    run = load_config(config)
    sequence, scene = _read_frames(run, "frames_path"), _camera_scene(run, build_system(run))
    background = None if run.track.background_frames_path is None else _read_frames(run, "background_frames_path")
    return SingleFrameTracker(scene, _read_joints(run), sequence, run.track.options, background)


@dataclass(frozen=True, eq=False)
class _FrameTasks:
    settings: RunSettings
    work_folder: Path
    input_hashes: dict[str, str]
    resume_files: tuple[Path, ...]  # to delete at the end

    def estimate_shared_values(self) -> SequenceEstimates:
        [found] = require_task_values(self._run(_calibrate_sequence_task, {"what is common": {}}, InlineExecutor()))
        if "refused" in found:
            raise DataError(**found["refused"])
        return files.dataclass_from_plain_data(SequenceEstimates, found)

    def track_frames(
        self,
        tracker: SingleFrameTracker,
        common: SequenceEstimates,
        workers: WorkerConfig | Executor,
        progress: Progress,
    ) -> list[FrameReport]:
        names, told = tracker.sequence.frame_names, files.to_lossless_plain_data(common)
        tasks = {names[i]: {"common": told, "index": i} for i in tracker.frame_order}
        results = self._run(_track_frame_task, tasks, workers, progress.report_parts_done)
        require_task_values([result for result in results if "abruptly" not in result.error])
        return [
            tracker.frame_report_before_processing(i, common.camera_calibration, f"its process failed: {result.error}")
            if "abruptly" in result.error
            else files.dataclass_from_plain_data(FrameReport, result.value)
            for i, result in zip(tracker.frame_order, results, strict=True)
        ]

    def _run(
        self,
        function: Callable[..., Any],
        tasks: Mapping[str, Mapping[str, Any]],
        workers: WorkerConfig | Executor,
        report: Callable[[int, int, str], None] | None = None,
    ) -> list[TaskResult]:
        common = {"config": self.work_folder / _CONFIG_FILE, "inputs": self.input_hashes}
        listed = [Task(name, {**common, **own}) for name, own in tasks.items()]
        return run_tasks(function, listed, self.work_folder / _RESULTS_FOLDER, workers, report)


def _frame_tasks(
    run: RunSettings, system: System, folder: RunFolder, progress: Progress
) -> tuple[_FrameTasks, VirtualFramesWithTruth | None]:
    """Return the tracking tasks, and the true motion if a virtual camera renders the frames (which are written)."""
    said, work, made, own_files = run.track, folder.resume_folder, None, tuple[Path, ...]()
    joints = resolve_recording_path(run.recordings.estimate[0]) if run.recordings.estimate else None
    if said.background_frames_path is not None:
        _read_frames(run, "background_frames_path")
    if said.frames_path is not None:
        _read_joints(run)
        _read_frames(run, "frames_path")  # raises errors about the files with the names of the settings
        frames = Path(said.frames_path)
    else:
        progress.begin_stage("simulating a virtual experiment in MuJoCo")
        recording, made = _simulate_recording_and_camera_frames(run, system)
        progress.begin_stage("rendering its depth images")
        work.mkdir(parents=True, exist_ok=True)
        frames, joints = own_files = work / "frames", work / f"{run.name}.h5"
        write_frame_folder(made.sequence, frames)
        write_recording(recording, joints)
    recordings = RecordingsSettings(estimate=() if joints is None else (str(joints),))
    track = replace(said, frames_path=str(frames), n_drawn_frames=0)
    own = replace(run, track=track, recordings=recordings, output=OutputSettings(), name="", description="")
    sources = {"frames": frames, "joints": joints, "background": said.background_frames_path}
    with add_setting_location_to_errors(run, "track", "frames_path"):
        inputs = {key: files.file_sha256(Path(path)) for key, path in sources.items() if path is not None}
        text = config_yaml_with_defaults(own)
        work_folder = work / files.json_sha256([text, inputs])[:16]
        files.make_folder(work_folder)
        files.write_text(work_folder / _CONFIG_FILE, text)
    if said.frames_path is not None:
        folder.input_hashes[said.frames_path] = inputs["frames"]
    return _FrameTasks(own, work_folder, inputs, (*own_files, work_folder)), made


def _calibrate_sequence_task(config: Path, inputs: Mapping[str, str]) -> dict[str, Any]:
    """Task: calibrate the sequence. Returns the values common to all frames as plain data, or the error."""
    del inputs  # part of the key of the result
    try:
        return dict(files.to_lossless_plain_data(_frame_tracker(config).estimate_shared_values()))
    except DataError as error:
        return {"refused": files.attributes_to_dict(error, "what where allowed hint")}


def _track_frame_task(config: Path, inputs: Mapping[str, str], common: Mapping[str, Any], index: int) -> dict[str, Any]:
    del inputs
    found = _frame_tracker(config).process_one_frame(index, files.dataclass_from_plain_data(SequenceEstimates, common))
    return dict(files.to_lossless_plain_data(found))

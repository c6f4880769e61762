"""The command `track`: points in depth-camera frames, frame by frame on workers, written to a recording."""

from __future__ import annotations

import argparse
import contextlib
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import OutputSettings, RecordingSettings, RunSettings, VirtualFramesSettings, dump_config
from yid_ocp.data.recording import Recording
from yid_ocp.data.recording_hdf5 import read_recording, write_recording
from yid_ocp.errors import DataError, OutputError, YidError
from yid_ocp.files import file_sha256, from_plain_data, json_sha256, os_error_reason, to_plain_data, write_text
from yid_ocp.model.system import System
from yid_ocp.parallel import InlineExecutor, Task, WorkerConfig, require_task_values, run_tasks
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.report.animation import ModelTrajectory, make_animation
from yid_ocp.report.summaries import track_summary
from yid_ocp.vision.calibration import CameraCalibration
from yid_ocp.vision.camera_registration import (
    CLOCK_DRIFT_INDEX,
    CLOCK_OFFSET_INDEX,
    DEPTH_OFFSET_INDEX,
    DEPTH_SCALE_INDEX,
    ROTATION_SLICE,
    TRANSLATION_SLICE,
)
from yid_ocp.vision.fit import ShapeFitter
from yid_ocp.vision.frame_folder import write_frame_folder
from yid_ocp.vision.frame_reading import read_frames
from yid_ocp.vision.frames import FrameSequence, look_at_pose
from yid_ocp.vision.sequence_calibration import DimensionCheck, ForeignObject, SequenceCalibration
from yid_ocp.vision.surface_meshes import CameraScene
from yid_ocp.vision.track import FrameTracker
from yid_ocp.vision.track_result import FrameReport, TrackResult, count_drop_reasons, draw_frame_stages, draw_track
from yid_ocp.vision.virtual_camera import DepthCamera, FrameTiming, VirtualCamera, VirtualFrames, render_virtual_frames
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.command_runner import CommandResult, run_and_print, workers_from_arguments
from yid_ocp.workflow.recording_issues import issues_result, single_recording_issues
from yid_ocp.workflow.run_folder import RunFolder, new_run_folder
from yid_ocp.workflow.run_inputs import locate_errors, recording_path

_RESULT_FORMAT = "yid-track/1"
Array = NDArray[np.float64]


@dataclass(frozen=True)
class TrackCommandResult(CommandResult):
    """Result of `run_track` with the track, and the joints' recording with the group `points_camera`."""

    track: TrackResult
    recording: Recording


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    overrides = (*arguments.overrides, *(["track.options.calibration.fix_pose=true"] if arguments.fix_pose else ()))
    settings = load_config(arguments.config, overrides)
    workers = workers_from_arguments(arguments)
    return run_and_print(arguments, lambda shown: run_track(settings, arguments.out, shown, workers), track_summary)


def run_track(
    run: RunSettings,
    out: str | Path | None = None,
    progress: Progress = NULL_PROGRESS,
    workers: WorkerConfig | Executor | None = None,
) -> TrackCommandResult:
    """Track the frames of `track.frames_path`, or of a virtual camera where there are none.

    The joint angles are those of the first recording under `recordings.estimate`; a virtual frame sequence has its own,
    and an object without a robot needs none. Frames are done one by one; what an interrupted run did of them is used
    by the next one of the same settings and files.

    Parameters
    ----------
    workers : WorkerConfig or Executor, optional
        Who works on the frames; this process alone when absent.

    Raises
    ------
    DataError
        Among others: not one frame is good. The run folder is there then, with the reason of every frame and pictures.
    ConfigError, ModelError, OutputError, WorkerError
    """
    settings = run.track
    with new_run_folder(run, out, "track") as folder:
        folder.begin_run(run, "track")
        system = build_system(run)
        filmed = _filmed(run, system, folder, progress)
        refused: DataError | None = None
        try:
            with locate_errors(run, "track"):
                tracker, recording = _frame_tracker(filmed.tasks.settings, system)
                doubts = [] if recording is None else single_recording_issues(run, system, recording)
                progress.begin_stage("finding what is common to the frames")
                common = filmed.tasks.calibrate_sequence()
                progress.begin_stage("tracking")
                frames, note = tracker.reject_outlying_frames(
                    filmed.tasks.track_frames(tracker, common, workers, progress)
                )
                found: TrackResult | None = None
                try:
                    found = tracker.to_track_result(frames, note, common)
                except DataError as error:
                    refused = error
        except YidError:
            filmed.clear()
            raise
        progress.begin_stage("drawing")
        for frame in _drawn(frames, settings.n_drawn_frames):
            stages = tracker.frame_stages(frame, common)
            if stages is not None:
                draw_frame_stages(stages, folder.path / "pictures")
        result = _track_result(frames, common, tracker.foreign_objects(frames), found) | {"root": note}
        told, tracked = [], None
        if found is not None:
            draw_track(found, folder.path / "track.png")
            tracked = found.to_recording(recording)
            write_recording(tracked, folder.path / "recording.h5")
            # what was tracked may be elsewhere than the object reaches, where the model says where it stands
            if settings.options.root_placement == "model":
                own = single_recording_issues(run, system, tracked)
                doubts += [doubt for doubt in own if doubt.cause.startswith("point_")]
            theta = system.parameters.vector()
            shape = ModelTrajectory("fitted shape", tracker.system, theta, found.t, found.configurations)
            told = [make_animation("tracked", [shape], tracked)]
            if filmed.made is not None:
                result["truth_errors"] = _truth_errors(system, found, filmed.made)
        result |= {"doubts": issues_result(doubts), "refused": "" if refused is None else refused.what}
        written = folder.write_result(result)
        files = [folder.path / "track.png", *sorted((folder.path / "pictures").glob("*.png"))]
        more = {"pictures": [path for path in files if path.exists()]}
        folder.write_report_page(run, written, progress, animations=told, section_data=more)
        filmed.clear()
    if refused is not None or found is None or tracked is None:
        raise _with_folder(refused, folder.path)
    return TrackCommandResult(folder.path, written, found, tracked)


@dataclass(frozen=True, eq=False)
class _Filmed:
    """The frames of a run as files, and the truth of virtual ones; `own`: what was made for it."""

    tasks: _FrameTasks
    made: VirtualFrames | None = None
    own: tuple[Path, ...] = ()

    def clear(self) -> None:
        """Remove what stands beside the run folder."""
        for path in self.own:
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
        self.tasks.delete_results()


def _filmed(run: RunSettings, system: System, folder: RunFolder, progress: Progress) -> _Filmed:
    settings = run.track
    if settings.frames_path is not None:
        _open_frames(run)  # says in words of the settings what is wrong with the files
        joints = recording_path(run.recordings.estimate[0]) if run.recordings.estimate else None
        with locate_errors(run, "track", "frames_path"):
            tasks = _FrameTasks.from_run(run, Path(settings.frames_path), joints, folder.resume_folder)
        folder.input_hashes[settings.frames_path] = tasks.input_hashes["frames"]
        return _Filmed(tasks)
    progress.begin_stage("simulating a virtual experiment in MuJoCo")
    recording, made = simulate_frames(run, system, settings.virtual_frames)
    progress.begin_stage("filming it")
    folder.resume_folder.mkdir(parents=True, exist_ok=True)
    frames, joints = folder.resume_folder / "frames", folder.resume_folder / f"{run.name}.h5"
    write_frame_folder(made.sequence, frames)
    write_recording(recording, joints)
    if settings.keep_frames:
        shutil.copytree(frames, folder.path / "frames")
    return _Filmed(_FrameTasks.from_run(run, frames, joints, folder.resume_folder), made, (frames, joints))


def _drawn(frames: Sequence[FrameReport], count: int) -> list[FrameReport]:
    """Frames to draw: some of all, evenly spread, and as many of those that were dropped, each for another reason."""
    chosen = {int(i) for i in np.linspace(0, len(frames) - 1, count + 2)[1:-1]}
    reasons = [frames[k].drop_reason.partition(":")[0] for k in sorted(chosen)]
    for k, frame in enumerate(frames):
        kind = frame.drop_reason.partition(":")[0]
        if kind and kind not in reasons and len(chosen) < 2 * count:
            chosen.add(k)
            reasons.append(kind)
    return [frames[k] for k in sorted(chosen)]


def _with_folder(refused: DataError | None, folder: Path) -> DataError:
    assert refused is not None
    hint = f"{refused.hint}; {folder} has the reason of every frame and pictures"
    return DataError(refused.what, where=refused.where, allowed=refused.allowed, hint=hint)


def _track_result(
    frames: Sequence[FrameReport],
    common: SequenceCalibration,
    things: Sequence[ForeignObject],
    found: TrackResult | None,
) -> dict[str, Any]:
    """`yid-track/1` without doubts, inputs and versions; `found` is None where no frame is good."""
    spent = [frame.cpu_seconds for frame in frames if frame.shape_fit is not None]
    return {
        "format": _RESULT_FORMAT,
        "camera": _camera_result(common.camera_calibration),
        "sizes": _sizes_result(common.dimensions),
        "things": [asdict(thing) for thing in things],
        "points": {} if found is None else _points(found),
        "truth_errors": {},
        "dropped": count_drop_reasons(frames),
        "fit_seconds": float(np.mean(spent)) if spent else 0.0,
        "frames": [
            {
                "name": frame.name,
                "stamp": frame.stamp,
                "t": frame.joint_time,
                "reason": frame.drop_reason,
                "raw_points": frame.n_raw_points,
                "object_points": frame.n_filtered_points,
                "nodes": frame.n_skeleton_nodes,
                "delay": None if np.isnan(frame.stamp_delay) else frame.stamp_delay,
                "distance": None if frame.shape_fit is None else frame.shape_fit.mean_distance,
                "covered": None if frame.shape_fit is None else frame.shape_fit.visible_coverage,
                "contested": None if frame.shape_fit is None else frame.shape_fit.contested_fraction,
                "seconds": frame.cpu_seconds,
            }
            for frame in frames
        ],
    }


def _sizes_result(sizes: DimensionCheck) -> dict[str, Any]:
    fits = sizes.model_values * np.exp(sizes.log_ratio)
    return {
        "frames": sizes.n_frames,
        "messages": list(sizes.messages),
        "of": {
            name: {
                "model": sizes.model_values[i],
                "fits": fits[i] if sizes.is_determined[i] else None,
                "std": fits[i] * sizes.log_ratio_std[i] if sizes.is_determined[i] else None,
                "doubted": bool(sizes.is_contradicted[i]),
                "used": sizes.is_estimated[i],
            }
            for i, name in enumerate(sizes.names)
        },
    }


def _camera_result(calibration: CameraCalibration) -> dict[str, Any]:
    state, told, change = (
        calibration.camera_state,
        calibration.prior_state,
        calibration.camera_state.difference_from(calibration.prior_state),
    )
    std = np.sqrt(np.diag(calibration.state_covariance))
    return {
        "message": calibration.message,
        "estimated": calibration.n_frames > 0,
        "frames": calibration.n_frames,
        "pose": state.pose,
        "told_pose": told.pose,
        "turned": float(np.linalg.norm(change[ROTATION_SLICE])),
        "turn_std": std[ROTATION_SLICE],
        "shifted": float(np.linalg.norm(change[TRANSLATION_SLICE])),
        "shift_std": std[TRANSLATION_SLICE],
        "depth_factor": state.depth_scale,
        "depth_factor_std": std[DEPTH_SCALE_INDEX],
        "depth_offset": state.depth_offset,
        "depth_offset_std": std[DEPTH_OFFSET_INDEX],
        "clock_offset": state.clock_offset,
        "clock_offset_std": std[CLOCK_OFFSET_INDEX],
        "clock_about": state.clock_reference_stamp,
        "clock_drift": state.clock_drift,
        "clock_drift_std": std[CLOCK_DRIFT_INDEX],
        "presence": None if calibration.arm_visibility is None else asdict(calibration.arm_visibility),
    }


def _points(found: TrackResult) -> dict[str, Any]:
    seen = np.asarray(np.isfinite(found.position).all(axis=2))
    return {
        name: {
            "frames": int(seen[:, i].sum()),
            "std": float(np.median(found.std[seen[:, i], i])) if seen[:, i].any() else None,
            "common_std": float(np.median(found.shared_std[seen[:, i], i])) if seen[:, i].any() else None,
        }
        for i, name in enumerate(found.point_names)
    }


def _truth_errors(system: System, found: TrackResult, made: VirtualFrames) -> Mapping[str, Mapping[str, float]]:
    shape = ShapeFitter(system)
    columns = [system.point_frames.index(name) for name in found.point_names]
    truth = np.array([shape.points_at(made.true_configuration_at(t))[columns] for t in found.t])
    apart = np.linalg.norm(found.position - truth, axis=2)
    return {
        name: {"median": float(np.nanmedian(apart[:, i])), "largest": float(np.nanmax(apart[:, i]))}
        for i, name in enumerate(found.point_names)
        if np.isfinite(apart[:, i]).any()
    }


def simulate_frames(
    run: RunSettings, system: System, settings: VirtualFramesSettings
) -> tuple[Recording, VirtualFrames]:
    """Recording and camera frames of a virtual experiment, with initial parameter values as truth.

    Raises
    ------
    ConfigError, DataError, ModelError
    """
    from yid_ocp.virtual.experiment import VirtualExperiment, run_virtual_experiment
    from yid_ocp.virtual.joint_motion import MultisineOptions, grasping_joint_angles, random_multisine
    from yid_ocp.virtual.mujoco_simulation import SimulationOptions, simulate_in_mujoco

    for name in settings.grasp_start_offsets:
        if name not in [grasp.name for grasp in system.grasps]:
            known = ", ".join(grasp.name for grasp in system.grasps)
            where = ("track", "virtual_frames", "grasp_start_offsets", name)
            raise run.config_error(f"there is no grasp '{name}'", *where, allowed=known)
    with locate_errors(run, "track", "virtual_frames"):
        posture = grasping_joint_angles(system, offsets=settings.grasp_start_offsets)
        simulation = SimulationOptions(settings.duration)
        excitation = MultisineOptions(gripper_travel=settings.max_gripper_travel, duration=settings.duration)
        motion = random_multisine(system, seed=settings.seed, initial_joint_angles=posture, excitation=excitation)
        experiment = VirtualExperiment(
            motion=motion,
            initial_joint_angles=posture,
            simulation=simulation,
            camera=None,
            seed=settings.seed,
            recording_name=run.name,
            description=run.description,
        )
        recording = run_virtual_experiment(system, None, experiment)
        # the same once more, for the shape that a recording does not hold
        truth = simulate_in_mujoco(system, None, motion, simulation, initial_joint_angles=posture)
        timing = FrameTiming(
            settings.frame_rate,
            dropped_fraction=settings.dropped_fraction,
            latency=settings.latency,
            latency_std=settings.latency_std,
        )
        pose = look_at_pose(settings.camera_position, settings.camera_target)
        camera = VirtualCamera(
            pose, DepthCamera(outlier_probability=settings.outlier_fraction), timing, seed=settings.seed
        )
        made = render_virtual_frames(camera_scene(run, system), truth.t, truth.q, camera)
    return recording, made


_CONFIG_FILE, _RESULTS_FOLDER = "config.yaml", "done"


@dataclass(frozen=True, eq=False)
class _FrameTasks:
    """Tracking tasks of one run: settings, work folder and input hashes."""

    settings: RunSettings
    work_folder: Path
    input_hashes: dict[str, str]

    @staticmethod
    def from_run(run: RunSettings, frames: Path, joints: Path | None, partial: Path) -> _FrameTasks:
        """Tracking tasks for frames and joints stored in files."""
        recordings = RecordingSettings(estimate=() if joints is None else (str(joints),))
        track = replace(run.track, frames_path=str(frames), n_drawn_frames=0, keep_frames=False)
        own = replace(run, track=track, recordings=recordings, output=OutputSettings(), name="", description="")
        inputs = {"frames": file_sha256(frames)}
        if joints is not None:
            inputs["joints"] = file_sha256(joints)
        if run.track.background_frames is not None:
            inputs["background"] = file_sha256(Path(run.track.background_frames))
        text = dump_config(own)
        folder = partial / json_sha256([text, inputs])[:16]
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"the folder cannot be made ({os_error_reason(error)})", where=str(folder)) from error
        write_text(folder / _CONFIG_FILE, text)
        return _FrameTasks(own, folder, inputs)

    def calibrate_sequence(self) -> SequenceCalibration:
        """Sequence calibration common to all frames, computed in this process."""
        task = Task("what is common", {"config": self.work_folder / _CONFIG_FILE, "inputs": self.input_hashes})
        [found] = require_task_values(
            run_tasks(_calibrate_sequence_task, [task], self.work_folder / _RESULTS_FOLDER, InlineExecutor())
        )
        if "refused" in found:
            raise DataError(**found["refused"])
        return from_plain_data(SequenceCalibration, found)

    def track_frames(
        self,
        tracker: FrameTracker,
        common: SequenceCalibration,
        workers: WorkerConfig | Executor | None = None,
        progress: Progress = NULL_PROGRESS,
    ) -> list[FrameReport]:
        """Tracking results of all frames, ordered by stamp; computed in this process without workers."""
        common_to_all = {
            "config": self.work_folder / _CONFIG_FILE,
            "inputs": self.input_hashes,
            "common": to_plain_data(common),
        }
        names = tracker.sequence.frame_names
        tasks = [Task(names[i], {**common_to_all, "index": i}) for i in tracker.frame_order]
        executor = InlineExecutor() if workers is None else workers
        results = run_tasks(
            _track_frame_task, tasks, self.work_folder / _RESULTS_FOLDER, executor, progress.report_parts_done
        )
        ended = [k for k, result in enumerate(results) if "abruptly" in result.error]
        others = require_task_values([result for k, result in enumerate(results) if k not in ended])
        found = {
            i: from_plain_data(FrameReport, value)
            for i, value in zip(_but(tracker.frame_order, ended), others, strict=True)
        }
        for k in ended:
            i = tracker.frame_order[k]
            found[i] = tracker.unprocessed_report(
                i, common.camera_calibration, f"work on it failed: {results[k].error}"
            )
        return [found[i] for i in tracker.frame_order]

    def delete_results(self) -> None:
        """Delete the stored results of a complete run."""
        shutil.rmtree(self.work_folder, ignore_errors=True)
        with contextlib.suppress(OSError):
            self.work_folder.parent.rmdir()


def _but(entries: tuple[int, ...], without: list[int]) -> list[int]:
    return [entry for k, entry in enumerate(entries) if k not in without]


def _open_frames(run: RunSettings) -> tuple[FrameSequence, Recording | None]:
    """Frame sequence of `track.frames_path` and its recording, None where none is listed."""
    assert run.track.frames_path is not None
    recording = None
    if run.recordings.estimate:
        with locate_errors(run, "recordings", "estimate", 0):
            path = recording_path(run.recordings.estimate[0])
            recording = replace(read_recording(path, allow_nan_effort=True), name=path.stem)
    with locate_errors(run, "track", "frames_path"):
        settings = run.track
        seen = read_frames(
            run.track.frames_path, pose=settings.camera_pose, unit=settings.length_unit, topic=settings.frame_topic
        )
    return seen, recording


def camera_scene(run: RunSettings, system: System) -> CameraScene:
    """The scene seen by the camera: system, robot meshes and extra meshes."""
    return CameraScene(system, run.model.robot, extra_meshes=run.model.extra_meshes)


def _read_background_frames(run: RunSettings) -> FrameSequence | None:
    """Background frames without robot and object; None where the settings have none."""
    if run.track.background_frames is None:
        return None
    with locate_errors(run, "track", "background_frames"):
        pose = run.track.camera_pose
        unit = run.track.length_unit
        return read_frames(run.track.background_frames, pose=pose, unit=unit, topic=run.track.frame_topic)


def _calibrate_sequence_task(config: Path, inputs: Mapping[str, str]) -> dict[str, Any]:
    """Task: sequence calibration of a run as plain data, or the reason why it failed."""
    del inputs  # they belong to what the result depends on
    try:
        made: dict[str, Any] = to_plain_data(_tracker(config.read_text(encoding="utf-8"), config).calibrate_sequence())
    except DataError as error:
        return {"refused": {"what": error.what, "where": error.where, "allowed": error.allowed, "hint": error.hint}}
    return made


def _track_frame_task(config: Path, inputs: Mapping[str, str], common: Mapping[str, Any], index: int) -> dict[str, Any]:
    """Task: tracking result of one frame as plain data."""
    del inputs
    tracker = _tracker(config.read_text(encoding="utf-8"), config)
    made: dict[str, Any] = to_plain_data(tracker.track_frame(index, from_plain_data(SequenceCalibration, common)))
    return made


@lru_cache(maxsize=1)
def _tracker(text: str, config: Path) -> FrameTracker:
    """One for all frames that a process works on; the text makes another one of it when the file has changed."""
    del text
    run = load_config(config)
    return _frame_tracker(run, build_system(run))[0]


def _frame_tracker(run: RunSettings, system: System) -> tuple[FrameTracker, Recording | None]:
    sequence, recording = _open_frames(run)
    scene, background = camera_scene(run, system), _read_background_frames(run)
    return FrameTracker(scene, recording, sequence, run.track.options, background), recording

"""Frame tracking as tasks: sequence calibration and each frame are stored as soon as they are done."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import OutputSettings, RecordingSettings, RunSettings, dump_config
from yid_ocp.data.recording import Recording
from yid_ocp.data.recording_hdf5 import read_recording
from yid_ocp.errors import DataError, OutputError
from yid_ocp.files import file_sha256, json_sha256, os_error_reason, write_text
from yid_ocp.model.system import System
from yid_ocp.parallel import InlineExecutor, Task, WorkerConfig, require_task_values, run_tasks
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.vision.frame_reading import read_frames
from yid_ocp.vision.frames import FrameSequence
from yid_ocp.vision.sequence_calibration import SequenceCalibration
from yid_ocp.vision.serialization import from_plain_data, to_plain_data
from yid_ocp.vision.surface_meshes import CameraScene
from yid_ocp.vision.track import FrameTracker
from yid_ocp.vision.track_result import FrameReport
from yid_ocp.workflow.build import build_system, locate_errors, recording_path

_CONFIG_FILE, _RESULTS_FOLDER = "config.yaml", "done"


@dataclass(frozen=True, eq=False)
class FrameTasks:
    """Tracking tasks of one run: settings, work folder and input hashes.

    Attributes
    ----------
    settings : RunSettings
        Settings on which frames depend, with files for the frames and the joints.
    work_folder : Path
        Of what is done; another one for other settings, frames or joints.
    input_hashes : dict of str to str
        SHA-256 of frames and joints.
    """

    settings: RunSettings
    work_folder: Path
    input_hashes: dict[str, str]

    @staticmethod
    def from_run(run: RunSettings, frames: Path, joints: Path | None, partial: Path) -> FrameTasks:
        """Tracking tasks for frames and joints stored in files.

        Raises
        ------
        DataError, OutputError
            A file that cannot be read, a folder that cannot be made.
        """
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
        return FrameTasks(own, folder, inputs)

    def calibrate_sequence(self) -> SequenceCalibration:
        """Sequence calibration common to all frames, computed in this process."""
        task = Task("what is common", {"config": self.work_folder / _CONFIG_FILE, "inputs": self.input_hashes})
        [found] = require_task_values(
            run_tasks(calibrate_sequence_task, [task], self.work_folder / _RESULTS_FOLDER, InlineExecutor())
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
        """Tracking results of all frames, ordered by stamp; computed in this process without workers.

        One that ended the process that worked on it is dropped.
        """
        common_to_all = {
            "config": self.work_folder / _CONFIG_FILE,
            "inputs": self.input_hashes,
            "common": to_plain_data(common),
        }
        names = tracker.sequence.frame_names
        tasks = [Task(names[i], {**common_to_all, "index": i}) for i in tracker.frame_order]
        executor = InlineExecutor() if workers is None else workers
        results = run_tasks(
            track_frame_task, tasks, self.work_folder / _RESULTS_FOLDER, executor, progress.report_parts_done
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


def open_frames(run: RunSettings) -> tuple[FrameSequence, Recording | None]:
    """Frame sequence of `track.frames_path` and its recording, None where none is listed.

    Raises
    ------
    ConfigError, DataError
    """
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


def read_background_frames(run: RunSettings) -> FrameSequence | None:
    """Background frames without robot and object; None where the settings have none."""
    if run.track.background_frames is None:
        return None
    with locate_errors(run, "track", "background_frames"):
        return read_frames(
            run.track.background_frames,
            pose=run.track.camera_pose,
            unit=run.track.length_unit,
            topic=run.track.frame_topic,
        )


def calibrate_sequence_task(config: Path, inputs: Mapping[str, str]) -> dict[str, Any]:
    """Task: sequence calibration of a run as plain data, or the reason why it failed."""
    del inputs  # they belong to what the result depends on
    try:
        made: dict[str, Any] = to_plain_data(_tracker(config.read_text(encoding="utf-8"), config).calibrate_sequence())
    except DataError as error:
        return {"refused": {"what": error.what, "where": error.where, "allowed": error.allowed, "hint": error.hint}}
    return made


def track_frame_task(config: Path, inputs: Mapping[str, str], common: Mapping[str, Any], index: int) -> dict[str, Any]:
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
    sequence, recording = open_frames(run)
    return FrameTracker(
        camera_scene(run, build_system(run)), recording, sequence, run.track.options, read_background_frames(run)
    )

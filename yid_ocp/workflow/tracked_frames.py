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
from yid_ocp.config.settings import OutputSettings, RecordingSettings, Run, dump_config
from yid_ocp.data.hdf5 import read_recording
from yid_ocp.data.recording import Recording
from yid_ocp.errors import DataError, OutputError
from yid_ocp.files import content_hash, file_sha256, reason, write_text
from yid_ocp.model.system import System
from yid_ocp.parallel import Task, ThisProcess, Workers, run_tasks, values_of
from yid_ocp.progress import SILENT, Progress
from yid_ocp.vision.common import Common
from yid_ocp.vision.frames import FrameSequence
from yid_ocp.vision.meshes import Scene
from yid_ocp.vision.plain import plain, remade
from yid_ocp.vision.reading import read_frames
from yid_ocp.vision.results import FrameReport
from yid_ocp.vision.track import Tracker
from yid_ocp.workflow.build import build_system, located, recording_file

CONFIG, DONE = "config.yaml", "done"


@dataclass(frozen=True, eq=False)
class FrameTasks:
    """Tracking tasks of one run: settings, work folder and input hashes.

    Attributes
    ----------
    run : Run
        Settings on which frames depend, with files for the frames and the joints.
    folder : Path
        Of what is done; another one for other settings, frames or joints.
    inputs : dict of str to str
        SHA-256 of frames and joints.
    """

    run: Run
    folder: Path
    inputs: dict[str, str]

    @staticmethod
    def of(run: Run, frames: Path, joints: Path | None, partial: Path) -> FrameTasks:
        """Tracking tasks for frames and joints stored in files.

        Raises
        ------
        DataError, OutputError
            A file that cannot be read, a folder that cannot be made.
        """
        recordings = RecordingSettings(estimate=() if joints is None else (str(joints),))
        track = replace(run.track, frames=str(frames), pictures=0, keep_frames=False)
        own = replace(run, track=track, recordings=recordings, output=OutputSettings(), name="", description="")
        inputs = {"frames": file_sha256(frames)}
        if joints is not None:
            inputs["joints"] = file_sha256(joints)
        if run.track.background is not None:
            inputs["background"] = file_sha256(Path(run.track.background))
        text = dump_config(own)
        folder = partial / content_hash([text, inputs])[:16]
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"the folder cannot be made ({reason(error)})", where=str(folder)) from error
        write_text(folder / CONFIG, text)
        return FrameTasks(own, folder, inputs)

    def common(self) -> Common:
        """Sequence calibration common to all frames, computed in this process."""
        task = Task("what is common", {"config": self.folder / CONFIG, "inputs": self.inputs})
        [found] = values_of(run_tasks(found_common, [task], self.folder / DONE, ThisProcess()))
        if "refused" in found:
            raise DataError(**found["refused"])
        return remade(Common, found)

    def frames(
        self,
        tracker: Tracker,
        common: Common,
        workers: Workers | Executor | None = None,
        progress: Progress = SILENT,
    ) -> list[FrameReport]:
        """Tracking results of all frames, ordered by stamp; computed in this process without workers.

        One that ended the process that worked on it is dropped.
        """
        common_to_all = {"config": self.folder / CONFIG, "inputs": self.inputs, "common": plain(common)}
        names = tracker.sequence.names
        tasks = [Task(names[i], {**common_to_all, "index": i}) for i in tracker.order]
        executor = ThisProcess() if workers is None else workers
        results = run_tasks(one_frame, tasks, self.folder / DONE, executor, progress.advance)
        ended = [k for k, result in enumerate(results) if "abruptly" in result.error]
        others = values_of([result for k, result in enumerate(results) if k not in ended])
        found = {i: remade(FrameReport, value) for i, value in zip(_but(tracker.order, ended), others, strict=True)}
        for k in ended:
            i = tracker.order[k]
            found[i] = tracker.unread(i, common.calibration, f"work on it failed: {results[k].error}")
        return [found[i] for i in tracker.order]

    def clear(self) -> None:
        """Delete the stored results of a complete run."""
        shutil.rmtree(self.folder, ignore_errors=True)
        with contextlib.suppress(OSError):
            self.folder.parent.rmdir()


def _but(entries: tuple[int, ...], without: list[int]) -> list[int]:
    return [entry for k, entry in enumerate(entries) if k not in without]


def opened(run: Run) -> tuple[FrameSequence, Recording | None]:
    """Frame sequence of `track.frames` and its recording, None where none is listed.

    Raises
    ------
    ConfigError, DataError
    """
    assert run.track.frames is not None
    recording = None
    if run.recordings.estimate:
        with located(run, "recordings", "estimate", 0):
            path = recording_file(run.recordings.estimate[0])
            recording = replace(read_recording(path, allow_nan_effort=True), name=path.stem)
    with located(run, "track", "frames"):
        settings = run.track
        seen = read_frames(run.track.frames, pose=settings.pose, unit=settings.unit, topic=settings.topic)
    return seen, recording


def scene_of(run: Run, system: System) -> Scene:
    """The scene seen by the camera: system, robot meshes and extra meshes."""
    return Scene(system, run.model.robot, extra=run.model.extra_meshes)


def empty_scene(run: Run) -> FrameSequence | None:
    """Background frames without robot and object; None where the settings have none."""
    if run.track.background is None:
        return None
    with located(run, "track", "background"):
        return read_frames(run.track.background, pose=run.track.pose, unit=run.track.unit, topic=run.track.topic)


def found_common(config: Path, inputs: Mapping[str, str]) -> dict[str, Any]:
    """Task: sequence calibration of a run as plain data, or the reason why it failed."""
    del inputs  # they belong to what the result depends on
    try:
        made: dict[str, Any] = plain(_tracker(config.read_text(encoding="utf-8"), config).common())
    except DataError as error:
        return {"refused": {"what": error.what, "where": error.where, "allowed": error.allowed, "hint": error.hint}}
    return made


def one_frame(config: Path, inputs: Mapping[str, str], common: Mapping[str, Any], index: int) -> dict[str, Any]:
    """Task: tracking result of one frame as plain data."""
    del inputs
    tracker = _tracker(config.read_text(encoding="utf-8"), config)
    made: dict[str, Any] = plain(tracker.frame(index, remade(Common, common)))
    return made


@lru_cache(maxsize=1)
def _tracker(text: str, config: Path) -> Tracker:
    """One for all frames that a process works on; the text makes another one of it when the file has changed."""
    del text
    run = load_config(config)
    sequence, recording = opened(run)
    return Tracker(scene_of(run, build_system(run)), recording, sequence, run.track.options, empty_scene(run))

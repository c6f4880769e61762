"""The command `track`: tracks points in depth-camera frames and writes them to a recording."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import Run, VirtualFramesSettings
from yid_ocp.data.hdf5 import write_recording
from yid_ocp.data.recording import Recording
from yid_ocp.errors import DataError, YidError
from yid_ocp.model.system import System
from yid_ocp.parallel import Workers
from yid_ocp.progress import SILENT, Progress
from yid_ocp.report.scene import Told
from yid_ocp.report.scene import scene as moving
from yid_ocp.report.summaries import track_summary
from yid_ocp.vision.calibration import Calibration
from yid_ocp.vision.camera import DepthCamera, FrameTiming, VirtualCamera, VirtualFrames, virtual_frames
from yid_ocp.vision.clutter import Foreign
from yid_ocp.vision.common import Common
from yid_ocp.vision.doubt import Sizes
from yid_ocp.vision.fit import ShapeFit
from yid_ocp.vision.folders import write_frames
from yid_ocp.vision.frames import look_at
from yid_ocp.vision.pictures import draw_stages, draw_track
from yid_ocp.vision.registration import CLOCK, DEPTH, DRIFT, SCALE, SHIFT, TURN
from yid_ocp.vision.results import FrameReport, Track, dropped
from yid_ocp.vision.track import Tracker
from yid_ocp.workflow.build import build_system, located, recording_file
from yid_ocp.workflow.command import DONE, carry_out, given_workers
from yid_ocp.workflow.doubts import doubts_result, of_one
from yid_ocp.workflow.folder import RunFolder, new_run_folder
from yid_ocp.workflow.tracked_frames import FrameTasks, empty_scene, opened, scene_of

FORMAT = "yid-track/1"
Array = NDArray[np.float64]


@dataclass(frozen=True)
class TrackOutcome:
    """Result of `run_track`.

    Attributes
    ----------
    folder : Path
        With recording.h5, result.json, track.png and the pictures.
    result : dict
        Contents of result.json.
    track : Track
    recording : Recording
        The joints' recording with the group `points_camera`.
    """

    folder: Path
    result: dict[str, Any]
    track: Track
    recording: Recording


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    overrides = (*arguments.overrides, *(["track.options.calibration.fix_pose=true"] if arguments.fix_pose else ()))
    settings = load_config(arguments.config, overrides)
    workers = given_workers(arguments)
    carry_out(lambda shown: run_track(settings, arguments.out, shown, workers), track_summary, arguments)
    return DONE


def run_track(
    run: Run,
    out: str | Path | None = None,
    progress: Progress = SILENT,
    workers: Workers | Executor | None = None,
) -> TrackOutcome:
    """Track the frames of `track.frames`, or of a virtual camera where there are none.

    The joint angles are those of the first recording under `recordings.estimate`; a virtual frame sequence has its own,
    and an object without a robot needs none. Frames are done one by one; what an interrupted run did of them is used
    by the next one of the same settings and files.

    Parameters
    ----------
    run : Run
    out : str or Path, optional
    progress : Progress, optional
    workers : Workers or Executor, optional
        Who works on the frames; this process alone when absent.

    Returns
    -------
    TrackOutcome

    Raises
    ------
    DataError
        Among others: not one frame is good. The run folder is there then, with the reason of every frame and pictures.
    ConfigError, ModelError, OutputError, WorkerError
    """
    settings = run.track
    with new_run_folder(run, out, "track") as folder:
        folder.begin(run, "track")
        system = build_system(run)
        filmed = _filmed(run, system, folder, progress)
        refused: DataError | None = None
        try:
            with located(run, "track"):
                seen, recording = opened(filmed.tasks.run)
                tracker = Tracker(scene_of(run, system), recording, seen, settings.options, empty_scene(run))
                doubts = [] if recording is None else of_one(run, system, recording)
                progress.stage("finding what is common to the frames")
                common = filmed.tasks.common()
                progress.stage("tracking")
                frames, note = tracker.judged(filmed.tasks.frames(tracker, common, workers, progress))
                found: Track | None = None
                try:
                    found = tracker.finished(frames, note, common)
                except DataError as error:
                    refused = error
        except YidError:
            filmed.clear()
            raise
        progress.stage("drawing")
        for frame in _drawn(frames, settings.pictures):
            stages = tracker.stages(frame, common)
            if stages is not None:
                draw_stages(stages, folder.path / "pictures")
        result = track_result(frames, common, tracker.things(frames), found) | {"root": note}
        told, tracked = [], None
        if found is not None:
            draw_track(found, folder.path / "track.png")
            tracked = found.recording(recording)
            write_recording(tracked, folder.path / "recording.h5")
            # what was tracked may be elsewhere than the object reaches, where the model says where it stands
            if settings.options.root == "model":
                doubts += [doubt for doubt in of_one(run, system, tracked) if doubt.cause.startswith("point_")]
            shape = Told("fitted shape", tracker.system, system.parameters.vector(), found.t, found.q)
            told = [moving("tracked", [shape], tracked)]
            if filmed.made is not None:
                result["truth_errors"] = truth_errors(system, found, filmed.made)
        result |= {"doubts": doubts_result(doubts), "refused": "" if refused is None else refused.what}
        written = folder.finish(result)
        files = [folder.path / "track.png", *sorted((folder.path / "pictures").glob("*.png"))]
        more = {"pictures": [path for path in files if path.exists()]}
        folder.report(run, written, progress, scenes=told, more=more)
        filmed.clear()
    if refused is not None or found is None or tracked is None:
        raise _with_folder(refused, folder.path)
    return TrackOutcome(folder.path, written, found, tracked)


@dataclass(frozen=True, eq=False)
class _Filmed:
    """The frames of a run as files, and the truth of virtual ones; `own`: what was made for it."""

    tasks: FrameTasks
    made: VirtualFrames | None = None
    own: tuple[Path, ...] = ()

    def clear(self) -> None:
        """Remove what stands beside the run folder."""
        for path in self.own:
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
        self.tasks.clear()


def _filmed(run: Run, system: System, folder: RunFolder, progress: Progress) -> _Filmed:
    settings = run.track
    if settings.frames is not None:
        opened(run)  # says in words of the settings what is wrong with the files
        joints = recording_file(run.recordings.estimate[0]) if run.recordings.estimate else None
        with located(run, "track", "frames"):
            tasks = FrameTasks.of(run, Path(settings.frames), joints, folder.partial)
        folder.inputs[settings.frames] = tasks.inputs["frames"]
        return _Filmed(tasks)
    progress.stage("simulating a virtual experiment in MuJoCo")
    recording, made = simulated_frames(run, system, settings.virtual)
    progress.stage("filming it")
    folder.partial.mkdir(parents=True, exist_ok=True)
    frames, joints = folder.partial / "frames", folder.partial / f"{run.name}.h5"
    write_frames(made.sequence, frames)
    write_recording(recording, joints)
    if settings.keep_frames:
        shutil.copytree(frames, folder.path / "frames")
    return _Filmed(FrameTasks.of(run, frames, joints, folder.partial), made, (frames, joints))


def _drawn(frames: Sequence[FrameReport], count: int) -> list[FrameReport]:
    """Frames to draw: some of all, evenly spread, and as many of those that were dropped, each for another reason."""
    chosen = {int(i) for i in np.linspace(0, len(frames) - 1, count + 2)[1:-1]}
    reasons = [frames[k].reason.partition(":")[0] for k in sorted(chosen)]
    for k, frame in enumerate(frames):
        kind = frame.reason.partition(":")[0]
        if kind and kind not in reasons and len(chosen) < 2 * count:
            chosen.add(k)
            reasons.append(kind)
    return [frames[k] for k in sorted(chosen)]


def _with_folder(refused: DataError | None, folder: Path) -> DataError:
    assert refused is not None
    hint = f"{refused.hint}; {folder} has the reason of every frame and pictures"
    return DataError(refused.what, where=refused.where, allowed=refused.allowed, hint=hint)


def track_result(
    frames: Sequence[FrameReport], common: Common, things: Sequence[Foreign], found: Track | None
) -> dict[str, Any]:
    """`yid-track/1` without doubts, inputs and versions; `found` is None where no frame is good."""
    spent = [frame.seconds for frame in frames if frame.fit is not None]
    return {
        "format": FORMAT,
        "camera": camera_result(common.calibration),
        "sizes": sizes_result(common.sizes),
        "things": [asdict(thing) for thing in things],
        "points": {} if found is None else _points(found),
        "truth_errors": {},
        "dropped": dropped(frames),
        "fit_seconds": float(np.mean(spent)) if spent else 0.0,
        "frames": [
            {
                "name": frame.name,
                "stamp": frame.stamp,
                "t": frame.t,
                "reason": frame.reason,
                "raw_points": frame.raw,
                "object_points": frame.filtered,
                "nodes": frame.nodes,
                "delay": None if np.isnan(frame.delay) else frame.delay,
                "distance": None if frame.fit is None else frame.fit.distance,
                "covered": None if frame.fit is None else frame.fit.covered,
                "contested": None if frame.fit is None else frame.fit.contested,
                "seconds": frame.seconds,
            }
            for frame in frames
        ],
    }


def sizes_result(sizes: Sizes) -> dict[str, Any]:
    """Lengths and radii as plain data: model value, value fitted to the frames, and its standard deviation."""
    fits = sizes.told * np.exp(sizes.change)
    return {
        "frames": sizes.frames,
        "messages": list(sizes.messages),
        "of": {
            name: {
                "model": sizes.told[i],
                "fits": fits[i] if sizes.known[i] else None,
                "std": fits[i] * sizes.std[i] if sizes.known[i] else None,
                "doubted": bool(sizes.doubted[i]),
                "used": sizes.used[i],
            }
            for i, name in enumerate(sizes.names)
        },
    }


def camera_result(calibration: Calibration) -> dict[str, Any]:
    """Camera calibration as plain data: estimated and specified pose, depth and clock, with stds."""
    state, told, change = calibration.state, calibration.told, calibration.state.minus(calibration.told)
    std = np.sqrt(np.diag(calibration.covariance))
    return {
        "message": calibration.message,
        "estimated": calibration.frames > 0,
        "frames": calibration.frames,
        "pose": state.pose,
        "told_pose": told.pose,
        "turned": float(np.linalg.norm(change[TURN])),
        "turn_std": std[TURN],
        "shifted": float(np.linalg.norm(change[SHIFT])),
        "shift_std": std[SHIFT],
        "depth_factor": state.factor,
        "depth_factor_std": std[SCALE],
        "depth_offset": state.depth,
        "depth_offset_std": std[DEPTH],
        "clock_offset": state.offset,
        "clock_offset_std": std[CLOCK],
        "clock_about": state.about,
        "clock_drift": state.drift,
        "clock_drift_std": std[DRIFT],
        "presence": None if calibration.presence is None else asdict(calibration.presence),
    }


def _points(found: Track) -> dict[str, Any]:
    seen = np.asarray(np.isfinite(found.position).all(axis=2))
    return {
        name: {
            "frames": int(seen[:, i].sum()),
            "std": float(np.median(found.std[seen[:, i], i])) if seen[:, i].any() else None,
            "common_std": float(np.median(found.common[seen[:, i], i])) if seen[:, i].any() else None,
        }
        for i, name in enumerate(found.names)
    }


def truth_errors(system: System, found: Track, made: VirtualFrames) -> Mapping[str, Mapping[str, float]]:
    """Median and largest error of every tracked point against the simulated truth [m]."""
    shape = ShapeFit(system)
    columns = [system.points.index(name) for name in found.names]
    truth = np.array([shape.place(made.course(t))[columns] for t in found.t])
    apart = np.linalg.norm(found.position - truth, axis=2)
    return {
        name: {"median": float(np.nanmedian(apart[:, i])), "largest": float(np.nanmax(apart[:, i]))}
        for i, name in enumerate(found.names)
        if np.isfinite(apart[:, i]).any()
    }


def simulated_frames(run: Run, system: System, settings: VirtualFramesSettings) -> tuple[Recording, VirtualFrames]:
    """Recording and camera frames of a virtual experiment, with initial parameter values as truth.

    Raises
    ------
    ConfigError, DataError, ModelError
    """
    from yid_ocp.virtual.engine import Simulation, simulate_in_mujoco
    from yid_ocp.virtual.experiment import VirtualExperiment, virtual_experiment
    from yid_ocp.virtual.motion import Excitation, multisine
    from yid_ocp.virtual.posture import initial_posture

    for name in settings.offsets:
        if name not in [grasp.name for grasp in system.grasps]:
            known = ", ".join(grasp.name for grasp in system.grasps)
            raise run.refuse(f"there is no grasp '{name}'", "track", "virtual", "offsets", name, allowed=known)
    with located(run, "track", "virtual"):
        posture = initial_posture(system, offsets=settings.offsets)
        simulation = Simulation(settings.duration)
        excitation = Excitation(travel=settings.travel, duration=settings.duration)
        motion = multisine(system, seed=settings.seed, posture=posture, excitation=excitation)
        experiment = VirtualExperiment(
            motion=motion,
            posture=posture,
            simulation=simulation,
            camera=None,
            seed=settings.seed,
            name=run.name,
            description=run.description,
        )
        recording = virtual_experiment(system, None, experiment)
        # the same once more, for the shape that a recording does not hold
        truth = simulate_in_mujoco(system, None, motion, simulation, posture=posture)
        timing = FrameTiming(
            settings.rate,
            dropped=settings.dropped,
            latency=settings.latency,
            latency_std=settings.latency_std,
        )
        pose = look_at(settings.eye, settings.target)
        camera = VirtualCamera(pose, DepthCamera(outliers=settings.outliers), timing, seed=settings.seed)
        made = virtual_frames(scene_of(run, system), truth.t, truth.q, camera)
    return recording, made

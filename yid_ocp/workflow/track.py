"""The command `track`: points measured in a depth camera's frames, written into a recording that `solve` reads."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import Run, VirtualFramesSettings
from yid_ocp.data.hdf5 import read_recording, write_recording
from yid_ocp.data.recording import Recording
from yid_ocp.errors import ConfigError
from yid_ocp.files import file_sha256
from yid_ocp.model.system import System
from yid_ocp.progress import SILENT, Progress
from yid_ocp.report.scene import Told
from yid_ocp.report.scene import scene as moving
from yid_ocp.report.summaries import track_summary
from yid_ocp.vision.camera import DepthCamera, FrameTiming, VirtualCamera, VirtualFrames, virtual_frames
from yid_ocp.vision.fit import ShapeFit
from yid_ocp.vision.frames import FrameSequence, look_at, read_frames, write_frames
from yid_ocp.vision.meshes import Scene
from yid_ocp.vision.pictures import draw_stages, draw_track
from yid_ocp.vision.results import Track
from yid_ocp.vision.track import track
from yid_ocp.workflow.build import build_system, located, recording_file
from yid_ocp.workflow.command import DONE, carry_out
from yid_ocp.workflow.doubts import doubts_result, of_one
from yid_ocp.workflow.folder import new_run_folder

FORMAT = "yid-track/1"
Array = NDArray[np.float64]


@dataclass(frozen=True)
class TrackOutcome:
    """What `run_track` leaves.

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
    """The command."""
    settings = load_config(arguments.config, arguments.overrides)
    carry_out(lambda shown: run_track(settings, arguments.out, shown), track_summary, arguments)
    return DONE


def run_track(run: Run, out: str | Path | None = None, progress: Progress = SILENT) -> TrackOutcome:
    """Track the frames of `track.frames`, or of a virtual camera where there are none.

    The joint angles are those of the first recording under `recordings.estimate`; a virtual frame sequence has its own.

    Parameters
    ----------
    run : Run
    out : str or Path, optional
    progress : Progress, optional

    Returns
    -------
    TrackOutcome

    Raises
    ------
    ConfigError, DataError, ModelError, OutputError
    """
    settings = run.track
    with new_run_folder(run, out, "track") as folder:
        folder.begin(run, "track")
        system = build_system(run)
        made: VirtualFrames | None = None
        if settings.frames is None:
            progress.stage("simulating a virtual experiment in MuJoCo")
            recording, made = simulated_frames(run, system, settings.virtual)
            seen = made.sequence
            if settings.keep_frames:
                write_frames(seen, folder.path / "frames")
        else:
            recording, seen = _recorded(run, settings.frames)
            folder.inputs[settings.frames] = file_sha256(Path(settings.frames))
        doubts = of_one(run, system, recording)
        progress.stage("tracking")
        drawn = sorted({int(i) for i in np.linspace(0, len(seen) - 1, settings.pictures + 2)[1:-1]})
        with located(run, "track"):
            scene = Scene(system, run.model.robot)
            found = track(scene, recording, seen, settings.options, stages=drawn, progress=progress.advance)
        progress.stage("drawing")
        for stages in found.stages:
            draw_stages(stages, folder.path / "pictures")
        draw_track(found, folder.path / "track.png")
        tracked = found.recording(recording)
        write_recording(tracked, folder.path / "recording.h5")
        # what was tracked may be elsewhere than the object reaches
        doubts += [doubt for doubt in of_one(run, system, tracked) if doubt.cause.startswith("point_")]
        result = track_result(found) | {
            "doubts": doubts_result(doubts),
            "truth_errors": {} if made is None else truth_errors(system, found, made),
        }
        written = folder.finish(result)
        told = Told("fitted shape", system, system.parameters.vector(), found.t, found.q)
        files = [folder.path / "track.png", *sorted((folder.path / "pictures").glob("*.png"))]
        more = {"pictures": [path for path in files if path.exists()]}
        folder.report(run, written, progress, scenes=[moving("tracked", [told], tracked)], more=more)
    return TrackOutcome(folder.path, written, found, tracked)


def track_result(found: Track) -> dict[str, Any]:
    """`yid-track/1` without the errors of a virtual frame sequence, inputs and versions."""
    seen = np.asarray(np.isfinite(found.position).all(axis=2))
    spent = [frame.seconds for frame in found.frames if frame.fit is not None]
    clock = found.clock
    return {
        "format": FORMAT,
        "clock": {
            "offset": clock.offset,
            "std": clock.std if clock.estimated else None,
            "estimated": clock.estimated,
            "shift": clock.shift,
            "message": clock.message,
        },
        "points": {
            name: {
                "frames": int(seen[:, i].sum()),
                "std": float(np.median(found.std[seen[:, i], i])) if seen[:, i].any() else None,
            }
            for i, name in enumerate(found.names)
        },
        "dropped": found.dropped,
        "fit_seconds": float(np.mean(spent)),
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
                "inliers": None if frame.fit is None else frame.fit.inliers,
                "seconds": frame.seconds,
            }
            for frame in found.frames
        ],
    }


def truth_errors(system: System, found: Track, made: VirtualFrames) -> Mapping[str, Mapping[str, float]]:
    """Median and largest distance of every point from where it really was at the time written down [m]."""
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
    """A virtual experiment with the parameters' initial values as the truth, and its frames by a virtual camera.

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
        made = virtual_frames(Scene(system, run.model.robot), truth.t, truth.q, camera)
    return recording, made


def _recorded(run: Run, frames: str) -> tuple[Recording, FrameSequence]:
    if not run.recordings.estimate:
        raise ConfigError(
            "there is no recording with the joint angles",
            where=run.where("recordings", "estimate"),
            hint="list the recording that was made with the frames",
        )
    with located(run, "recordings", "estimate", 0):
        path = recording_file(run.recordings.estimate[0])
        recording = read_recording(path, allow_nan_effort=True)
    with located(run, "track", "frames"):
        seen = read_frames(frames, pose=run.track.pose, unit=run.track.unit)
    return replace(recording, name=path.stem), seen

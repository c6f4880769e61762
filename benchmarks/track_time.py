"""Processor time of a frame of `track`, memory of a long film, and what becomes of a run that is killed.

    python benchmarks/track_time.py [CONFIG ...]
    python benchmarks/track_time.py --long 1000 [--folder DIR] [CONFIG]

The first line: the shipped configurations of one and two arms, whose virtual cameras film MuJoCo, when none is named;
from the file of a frame to its points six frames a second on one core are wanted. What is common to a film is found
from some of its frames, whatever its length, and stands apart.

The second line: a film of so many frames, the virtual one over and over, is tracked without a break, then by a run that
is killed half-way and started again. Said are the most memory that either had resident at once, workers and all, and
whether the two found the same to the last bit; under 1 GiB and the same are wanted.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import RunSettings
from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.report.terminal import aligned_table_lines
from yid_ocp.vision.frame_folder import read_frame_folder, write_frame_folder
from yid_ocp.vision.frames import import_open3d
from yid_ocp.vision.track import SingleFrameTracker
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.track import _camera_scene, _simulate_recording_and_camera_frames

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
SHIPPED = (CONFIGS / "track_single_arm.yaml", CONFIGS / "track_dual_arm.yaml")
PAUSE = 0.2  # [s]


def main() -> int:
    """Track and print one table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("configs", metavar="CONFIG", nargs="*", type=Path, default=SHIPPED)
    parser.add_argument("--long", metavar="FRAMES", type=int, help="memory and resumption of a film of so many frames")
    parser.add_argument("--workers", type=int, default=1, help="of the run that is not interrupted")
    parser.add_argument("--folder", type=Path, help="where the film and the runs stay; a temporary folder when absent")
    said = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        place = said.folder or Path(folder)
        if said.long:
            return _long(said.configs[0], said.long, said.workers, place)
        rows = [("configuration", "frames", "good", "common [s]", "a frame [s]", "fit alone [s]", "frames/s")]
        rows += [_speed(config, place / config.stem) for config in said.configs]
    print("\n".join(aligned_table_lines(rows)))
    return 0


def _film(run: RunSettings, folder: Path, count: int = 0) -> Recording:
    """Write a virtual film as depth images, over and over until it has so many frames; the joints' recording."""
    recording, made = _simulate_recording_and_camera_frames(run, build_system(run))
    write_frame_folder(made.sequence, folder)
    joints, lens, o3d = recording.joints, made.sequence.intrinsics, import_open3d()
    assert joints is not None
    assert lens is not None
    rows = [(f"{i:06d}.png", float(t)) for i, t in enumerate(made.sequence.stamps)]
    for i, (name, _) in enumerate(rows):
        x, y, z = made.sequence.load_cloud(i).T
        image = np.zeros((lens.height, lens.width), np.uint16)
        row, column = np.rint(lens.fy * y / z + lens.cy), np.rint(lens.fx * x / z + lens.cx)
        image[row.astype(int), column.astype(int)] = np.rint(1e3 * z)
        o3d.io.write_image(str(folder / name), o3d.geometry.Image(image))
        (folder / f"{i:06d}.ply").unlink()
    times = max(1, -(-count // len(rows)))
    length = float(joints.t[-1] - joints.t[0]) + float(np.diff(joints.t).mean())
    with (folder / "timestamps.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["file", "t"])
        many = [(name, t + k * length) for k in range(times) for name, t in rows]
        writer.writerows([name, repr(t)] for name, t in many[: count or len(rows)])
    t = np.concatenate([joints.t + k * length for k in range(times)])
    long = JointGroup(joints.names, t, np.tile(joints.position, (times, 1)), position_std=joints.position_std)
    return Recording(long, name="film", source="MuJoCo")


def _speed(config: Path, folder: Path) -> tuple[str, ...]:
    run = load_config(config)
    recording = _film(run, folder)
    tracker = SingleFrameTracker(
        _camera_scene(run, build_system(run)), recording, read_frame_folder(folder), run.track.options
    )
    begun = time.process_time()
    common = tracker.estimate_shared_values()
    shared, begun = time.process_time() - begun, time.process_time()
    frames = [tracker.process_one_frame(i, common) for i in tracker.frame_order]
    each = (time.process_time() - begun) / len(frames)
    fits = [frame.cpu_seconds for frame in frames if frame.shape_fit is not None]
    good = sum(frame.is_good for frame in frames)
    numbers = (f"{shared:.1f}", f"{each:.3f}", f"{np.mean(fits):.3f}", f"{1 / each:.1f}")
    return config.stem, str(len(frames)), str(good), *numbers


def _long(config: Path, count: int, workers: int, folder: Path) -> int:
    film = folder / "film"
    if not (film / "timestamps.csv").exists():
        write_recording(_film(load_config(config), film, count), folder / "film.h5")
    settings = [f"track.frames_path={film}", f"recordings.estimate=[{folder / 'film.h5'}]", "track.n_drawn_frames=0"]
    command = [sys.executable, "-m", "yid_ocp", "track", str(config), "--quiet"]
    command += [word for said in (*settings, "output.write_report=false") for word in ("--set", said)]
    whole = [*command, "--out", str(folder / "whole"), "--workers", str(workers)]
    most, seconds = _watched(whole if workers > 1 else whole[:-2], count)
    broken = [*command, "--out", str(folder / "broken")]
    first, _ = _watched(broken, count // 2)
    second, rest = _watched(broken, 2 * count)
    same = _found(folder / "whole") == _found(folder / "broken")
    rows = [("film", "frames", "largest [MiB]", "without a break [s]", "after the kill [s]", "the same")]
    memory = max(most, first, second) / 2**20
    rows.append((config.stem, str(count), f"{memory:.0f}", f"{seconds:.0f}", f"{rest:.0f}", "yes" if same else "NO"))
    print("\n".join(aligned_table_lines(rows)))
    return 0 if same and memory < 1024 else 1


def _watched(command: Sequence[str], until: int) -> tuple[float, float]:
    """Run a command, kill it once so many frames are done; the most memory resident at once [bytes], and the time."""
    folder, begun, most = Path(command[command.index("--out") + 1]), time.monotonic(), 0.0
    process = subprocess.Popen(command, start_new_session=True)
    while process.poll() is None:
        most = max(most, _resident(process.pid))
        done = sum(1 for _ in folder.with_name(f"{folder.name}.partial").glob("*/done/*.json"))
        if "broken" in folder.name and done >= until:
            os.killpg(process.pid, signal.SIGKILL)
        time.sleep(PAUSE)
    return most, time.monotonic() - begun


def _resident(session: int) -> float:
    """Memory that the processes of a session have resident, what they share counted once [bytes]."""
    total = 0.0
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if os.getsid(int(entry.name)) == session:
                lines = (entry / "smaps_rollup").read_text().splitlines()
                total += sum(1024.0 * int(line.split()[1]) for line in lines if line.startswith("Pss:"))
        except (OSError, ValueError):
            continue
    return total


def _found(folder: Path) -> dict[str, Any]:
    """What a run found, without what depends on when and where."""
    result = json.loads((folder / "result.json").read_text())
    for key in ("date", "command"):
        result.pop(key)
    for frame in result["frames"]:
        frame.pop("seconds")
    return dict(result)


if __name__ == "__main__":
    sys.exit(main())

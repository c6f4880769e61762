"""Damaged inputs of every kind, each read by a process of its own: whether anything crashes, hangs or leaks out.

    python benchmarks/fuzz.py [KIND ...] [--inputs 20000] [--seconds 3600] [--jobs 2] [--first 0]
    python benchmarks/fuzz.py KIND --only SEED --keep FOLDER

An input is a valid file (configuration, setting, recording, table, bag, dataset, robot, camera frames) that was damaged
by a rule and a seed: bits, blocks, lines, numbers, names, datasets, attributes, types. It is read as the program reads
it, by previews and whole commands too; some inputs are odd environments, and signals at random times. Sound is what it
takes, and what it refuses with an error of four parts; anything else is printed with the kind and the seed that make it
again: an exception of another kind, a signal, more than 20 s, more than 2 GiB, a file left where the process stands, a
command that goes on when it was asked to end. Exit code 1 where there is anything to print.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import math
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from yid_ocp.cli import main as command
from yid_ocp.config.reader import load_config
from yid_ocp.data import JointGroup, PointGroup, Recording, read_recording, write_recording
from yid_ocp.data.readers import read_any
from yid_ocp.errors import YidError
from yid_ocp.model.system import System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.vision import FrameSequence, look_at_pose, write_frame_folder
from yid_ocp.vision.frame_reading import read_frames

PATIENCE = 20.0  # [s]
LATE = "not done after"
MEMORY = 2 << 30
REPOSITORY = Path(__file__).resolve().parents[1]

Random = np.random.Generator
Array = npt.NDArray[np.float64]

CONFIG = """\
description: A double pendulum, moved as measured.
model:
  robot: {urdf}
  arms: {{mode: prescribed}}
  joint_springs:
    shoulder: {{stiffness: 1.0, rest_position: 0.2}}
recordings:
  estimate: [recording.h5]
  held_out: []
parameters:
  shoulder.stiffness: {{free: true, bounds: [0.0, 100.0]}}
  elbow.damping: {{free: true}}
problem: {{path_cutoff: 20, use_compiler: false, time_step: 0.01}}
solver: {{name: gauss_newton, max_iterations: 2}}
output: {{write_report: false}}
"""

NUMBERS = (
    *("0", "-1", "1e308", "-1e308", "1e-308", "1e-9", "1e400", "2000000000", "3.0000001", "0x10", "1_000", "1:30"),
    *("1,5", "0.1.2", "+", "nan", ".nan", "inf", ".inf", "-.inf", "one", "true", "null", "[1]", "{a: 1}", ""),
    *("9" * 40, "9" * 5000),
)
ODD_JSON: Sequence[Any] = (
    *(None, True, "", "text", "{episode_index.foo}", "{episode_index:>9999999999}", "{}", "../{episode_index}", "v3.0"),
    *(0, -1, 0.5, 1e308, 10**400, [], [[1]], ["a", "a"], [None], {}, {"names": 5}, {"dtype": [1]}),
)
PIECES = (
    *("\0", "\t", "\ufeff", "é" * 300, "---\n", "\n\n", "<<: ", "{" * 60, "[" * 60),
    *["*a", "&a", "!!set", "'", '"', "..", "/"],
)
SETTINGS = (
    "problem.time_step",
    "problem.path_cutoff",
    "model.joint_springs.shoulder.stiffness",
    "model.robot",
    "model.locked",
    "solver.max_iterations",
    "parameters.elbow.damping.bounds",
    "recordings.estimate",
    "sensors.joints.std",
)


# -- what is damaged --------------------------------------------------------------------------------------------------


def made_recording(phase: float = 0.0) -> Recording:
    """Two joints and a point for a second."""
    t: Array = 0.01 * np.arange(101, dtype=np.float64)
    position: Array = 0.4 * np.stack([np.sin(5 * t + phase), np.cos(4 * t)], axis=1)
    effort = 0.2 + 0.1 * position
    joints = JointGroup(("shoulder", "elbow"), t, position, effort=effort, effort_std=0.01, position_std=1e-4)
    seen: Array = np.stack([position[:, :1], position[:, 1:], position[:, :1]], axis=2)
    points = PointGroup("points_arm", ("tip",), t, seen, np.full(seen.shape, 1e-3), "mocap", "world")
    return Recording(joints, (points,), "a second", "made up", "recording")


def originals(folder: Path) -> None:
    """Write one valid input of every kind."""
    write_recording(made_recording(), folder / "recording.h5")
    shutil.copy(REPOSITORY / "models" / "urdf" / "double_pendulum.urdf", folder / "robot.urdf")
    (folder / "config.yaml").write_text(CONFIG.format(urdf="robot.urdf"), encoding="utf-8")
    rows = ["t,q_shoulder,q_elbow,effort_shoulder,effort_elbow,tip_x,tip_y,tip_z"]
    rows += [",".join(f"{value:.6g}" for value in (0.01 * i, *np.sin(np.arange(7) + 0.1 * i))) for i in range(40)]
    (folder / "table.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    cloud = np.random.default_rng(0).normal((0.0, 0.0, 2.0), size=(30, 3))
    pose = look_at_pose([2, 0, 0], [0, 0, 0])
    write_frame_folder(FrameSequence(np.array([0.1, 0.2]), ("a", "b"), pose, lambda i: cloud), folder / "frames")
    write_bag(folder / "bag")
    write_dataset(folder / "arm")


def write_dataset(folder: Path) -> None:
    """A LeRobot dataset of two episodes."""
    import pyarrow
    from pyarrow import parquet

    entry = {"dtype": "float32", "shape": [2], "names": ["shoulder.pos", "elbow.pos"]}
    numbers = {name: {"dtype": "int64", "shape": [1], "names": None} for name in ("frame_index", "episode_index")}
    info = {"codebase_version": "v2.1", "fps": 30, "total_episodes": 2, "robot_type": "so101", "chunks_size": 1000}
    info |= {"data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"}
    info |= {"features": {"observation.state": entry, "action": entry, **numbers}}
    for path in ("meta", "data/chunk-000"):
        (folder / path).mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info, indent=1), encoding="utf-8")
    for episode in range(2):
        values = [[0.1 * i, 0.2 + episode] for i in range(9)]
        table = {"observation.state": values, "action": values, "frame_index": list(range(9))}
        file = folder / "data" / "chunk-000" / f"episode_{episode:06d}.parquet"
        parquet.write_table(pyarrow.table({**table, "episode_index": [episode] * 9}), file)


def write_bag(folder: Path) -> None:
    """A short MCAP with joint states."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds: Any = store.types
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        kind = "sensor_msgs/msg/JointState"
        connection = writer.add_connection("/joint_states", kind, typestore=store)
        for i in range(20):
            stamp = kinds["builtin_interfaces/msg/Time"](sec=1, nanosec=10_000_000 * i)
            head = kinds["std_msgs/msg/Header"](stamp=stamp, frame_id="")
            values = [np.array([0.1 * i, 0.2]) for _ in range(3)]
            message = kinds[kind](head, ["shoulder", "elbow"], *values)
            writer.write(connection, 10**9 + 10_000_000 * i, store.serialize_cdr(message, kind))


# -- how it is damaged ------------------------------------------------------------------------------------------------


def damaged_bytes(data: bytes, rng: Random) -> bytes:
    """Flip, zero, cut, repeat or insert, once or a few times."""
    work = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        if not work:
            break
        at, size = int(rng.integers(len(work))), int(2 ** rng.uniform(0, 9))
        match int(rng.integers(6)):
            case 0 | 1:
                work[at] ^= 1 << int(rng.integers(8))
            case 2:
                work[at : at + size] = bytes(len(work[at : at + size]))
            case 3:
                del work[at if rng.random() < 0.5 else len(work) - size :]
            case 4:
                work[at:at] = work[at : at + size]
            case _:
                work[at : at + size] = rng.bytes(len(work[at : at + size]))
    return bytes(work)


def damaged_text(text: str, rng: Random) -> str:
    """Change numbers, words and lines, once or a few times."""
    for _ in range(int(rng.integers(1, 4))):
        lines = text.splitlines(keepends=True) or [""]
        line = int(rng.integers(len(lines)))
        match int(rng.integers(8)):
            case 0 | 1 | 2:
                found = list(re.finditer(r"-?\d+\.?\d*(?:e-?\d+)?", text))
                if found:
                    one = found[int(rng.integers(len(found)))]
                    text = text[: one.start()] + str(rng.choice(NUMBERS)) + text[one.end() :]
                continue
            case 3:
                words = list(re.finditer(r"[A-Za-z_.]+", text))
                if len(words) > 1:
                    one, other = (words[int(i)] for i in rng.integers(len(words), size=2))
                    text = text[: one.start()] + other[0] + text[one.end() :]
                continue
            case 4:
                at = int(rng.integers(len(text) + 1))
                text = text[:at] + str(rng.choice(PIECES)) + text[at:]
                continue
            case 5:
                lines.insert(line, lines[int(rng.integers(len(lines)))])
            case 6:
                del lines[line]
            case _:
                return damaged_bytes(text.encode(), rng).decode(errors="surrogateescape")
        text = "".join(lines)
    return text


def write_damaged(path: Path, rng: Random) -> None:
    """Damage a text file."""
    text = damaged_text(path.read_text(encoding="utf-8"), rng)
    path.write_bytes(text.encode(errors="surrogateescape"))


def damage_hdf5(path: Path, rng: Random) -> None:
    """Damage the bytes of a recording, or what it holds."""
    if rng.random() < 0.5:
        path.write_bytes(damaged_bytes(path.read_bytes(), rng))
        return
    with h5py.File(path, "a") as file:
        sets: list[str] = []
        file.visit(lambda name: sets.append(name) if isinstance(file[name], h5py.Dataset) else None)
        name = sets[int(rng.integers(len(sets)))]
        values = np.array(file[name])
        match int(rng.integers(9)):
            case 0:
                values.flat[int(rng.integers(values.size))] = float(rng.choice([math.nan, math.inf, 1e300, -1e9, 0.0]))
                file[name][...] = values
            case 1:
                del file[name]
                file[name] = values[: int(rng.integers(len(values)))]
            case 2:
                del file[name]
                file[name] = values.astype(str(rng.choice(["f2", "i1", "c16", "S5", "?"])))
            case 3:
                del file[name]
                file.create_dataset(name, (10 ** int(rng.integers(3, 12)), *values.shape[1:]), "f8", chunks=True)
            case 4:
                del file[name]
                file[name] = h5py.ExternalLink("/etc/passwd", "x") if rng.random() < 0.5 else h5py.SoftLink(f"/{name}")
            case 5:
                file[name][...] = values * 10.0 ** rng.integers(-12, 13)
            case 6:
                owner = file[name].parent if rng.random() < 0.5 else file
                keys = list(owner.attrs)
                if keys:
                    owner.attrs[keys[int(rng.integers(len(keys)))]] = rng.choice(
                        np.array([math.nan, "", b"\xff", 10**12, "a: b"], dtype=object)
                    )
            case 7:
                group = file[name].parent
                if "t" in group and group["t"].size:
                    group["t"][...] = np.array(group["t"]) * float(rng.choice([1e3, 1e9, -1.0, 0.0])) + float(
                        rng.choice([0.0, 1.7e9])
                    )
            case _:
                file.move(name, f"{name}_{rng.integers(10)}" if rng.random() < 0.5 else f"extra/{name}")


def damage_folder(folder: Path, rng: Random) -> None:
    """Damage one of a folder's files, or take it away."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    file = files[int(rng.integers(len(files)))]
    if rng.random() < 0.1:
        file.unlink()
    elif file.suffix in (".json", ".csv", ".yaml") and rng.random() < 0.7:
        write_damaged(file, rng)
    else:
        head, tail = file.read_bytes()[:300], file.read_bytes()[300:]
        if file.suffix == ".ply" and rng.random() < 0.5:  # its head is text
            head = damaged_text(head.decode("latin-1"), rng).encode("latin-1", errors="replace")
            file.write_bytes(head + tail)
        else:
            file.write_bytes(damaged_bytes(head + tail, rng))


# -- how it is read ---------------------------------------------------------------------------------------------------


def probe_yaml(folder: Path, rng: Random) -> None:
    """A configuration, and what `check` says of those that can be read."""
    write_damaged(folder / "config.yaml", rng)
    load_config(folder / "config.yaml")
    if rng.random() < 0.5:
        checked(folder)


def probe_set(folder: Path, rng: Random) -> None:
    """A setting of the command line."""
    value = damaged_text(str(rng.choice([*NUMBERS, "[0.1, 0.2]", "{a: [1, 2]}", "text"])), rng)
    setting = f"{rng.choice(SETTINGS)}={value}".replace("\0", "")
    load_config(folder / "config.yaml", [setting])
    if rng.random() < 0.5:
        checked(folder, "--set", setting)


def probe_hdf5(folder: Path, rng: Random) -> None:
    """A recording, and what `check` says of those that can be read."""
    damage_hdf5(folder / "recording.h5", rng)
    read_recording(folder / "recording.h5")
    checked(folder)


def probe_csv(folder: Path, rng: Random) -> None:
    """A table."""
    write_damaged(folder / "table.csv", rng)
    read_any(folder / "table.csv")


def probe_bag(folder: Path, rng: Random) -> None:
    """A bag."""
    damage_folder(folder / "bag", rng)
    read_any(folder / "bag" if rng.random() < 0.5 else next((folder / "bag").glob("*.mcap"), folder / "bag"))


def probe_urdf(folder: Path, rng: Random) -> None:
    """A robot, and the system that is built of it."""
    write_damaged(folder / "robot.urdf", rng)
    System.build(read_urdf(folder / "robot.urdf"))


def probe_frames(folder: Path, rng: Random) -> None:
    """Camera frames."""
    damage_folder(folder / "frames", rng)
    sequence = read_frames(folder / "frames")
    for index in range(len(sequence)):
        sequence.load_cloud(index)


def probe_dataset(folder: Path, rng: Random) -> None:
    """A LeRobot dataset whose metadata have other types or values, or whose table is damaged."""
    if rng.random() < 0.3:
        damage_folder(folder / "arm", rng)
    else:
        file = folder / "arm" / "meta" / "info.json"
        info = json.loads(file.read_text())
        for _ in range(int(rng.integers(1, 3))):
            owner: Any = info
            while isinstance(owner, dict) and owner and rng.random() < 0.7:
                key = sorted(owner)[int(rng.integers(len(owner)))]
                if not isinstance(owner[key], dict) or rng.random() < 0.4:
                    owner[key] = ODD_JSON[int(rng.integers(len(ODD_JSON)))]
                    break
                owner = owner[key]
        file.write_text(json.dumps(info))
    if rng.random() < 0.5:
        run_in_process("import", str(folder / "arm"), "--preview")
    read_any(folder / "arm")


def probe_preview(folder: Path, rng: Random) -> None:
    """A preview of a table, or of what is none."""
    file = folder / "table.csv"
    if rng.random() < 0.3:
        whole = [path for path in folder.rglob("*") if path.is_file()]
        file.write_bytes(whole[int(rng.integers(len(whole)))].read_bytes())
    lines = file.read_bytes().split(b"\n")
    file.write_bytes(b"\n".join(lines[: int(rng.integers(1, len(lines) + 1))]))
    if rng.random() < 0.7:
        file.write_bytes(damaged_bytes(file.read_bytes(), rng))
    run_in_process("import", str(file), "--preview")


def probe_command(folder: Path, rng: Random) -> None:
    """A whole command on an odd configuration that can be read."""
    text = (folder / "config.yaml").read_text(encoding="utf-8")
    found = list(re.finditer(r"(?<=[ \[])-?\d+\.?\d*", text))
    one = found[int(rng.integers(len(found)))]
    value = float(rng.choice([0, -1, 1e-9, 1e-3, 3, 1e3, 1e12, 1e300])) * float(rng.choice([1, rng.random()]))
    (folder / "config.yaml").write_text(f"{text[: one.start()]}{value!r}{text[one.end() :]}", encoding="utf-8")
    name = str(rng.choice(["solve", "simulate", "identifiability", "check", "inspect"]))
    quick = ["--set", "problem.duration=0.2", "--set", "output.checked_discretisation=none"]
    more = ["--intervals", "none"] if name == "identifiability" else []
    run_in_process(name, str(folder / "config.yaml"), "--out", str(folder / "run"), *quick, *more)


def probe_environment(folder: Path, rng: Random) -> None:
    """A command where streams, home, encoding or what its files are is odd."""
    home, config = folder / "home", folder / "config.yaml"
    home.write_text("a file, where no folder can be made")
    line = f"{sys.executable} -m yid_ocp simulate {config} --out {folder / 'run'}"
    case, allowed = int(rng.integers(9)), (0,)
    if case >= 6:
        target = (config, folder / "recording.h5", folder / "robot.urdf")[int(rng.integers(3))]
        target.unlink()
        os.mkfifo(target) if case == 6 else target.symlink_to("/dev/zero" if case == 7 else folder)
        allowed = (2,)
    tail = ("2>&-", "2>/dev/full", ">&-", "", "", "")[case] if case < 6 else ""
    own = {3: {"HOME": str(home), "XDG_CACHE_HOME": ""}, 4: {"PYTHONIOENCODING": "ascii"}, 5: {"LC_ALL": "C"}}
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), **own.get(case, {})}
    if case == 3:
        environment.pop("YID_OCP_CACHE", None)
    done = subprocess.run(
        ["sh", "-c", f"{line} {tail}"], env=environment, capture_output=True, text=True, errors="replace", check=False
    )
    if done.returncode not in allowed:
        raise UnsoundError(f"environment {case}: exit code {done.returncode}: {done.stderr[-300:]}")
    if done.returncode == 2:
        judged(2, done.stderr)


def probe_signal(folder: Path, rng: Random) -> None:
    """A command that is asked to end at a random time."""
    line = [sys.executable, "-m", "yid_ocp", "solve", str(folder / "config.yaml"), "--out", str(folder / "run")]
    number = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)[int(rng.integers(3))]

    def plain() -> None:
        for each in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(each, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)

    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    process = subprocess.Popen(line, env=environment, stdout=-3, stderr=-3, preexec_fn=plain)
    try:
        process.wait(float(rng.uniform(0.1, 4.0)))
    except subprocess.TimeoutExpired:
        asked = time.monotonic()
        process.send_signal(number)
        code = process.wait()
        late = code in (0, 1) and time.monotonic() - asked > 0.5  # else it was past listening
        if late or code not in (0, 1, -number, 128 + number):
            raise UnsoundError(f"{number.name}: exit code {code}") from None
        if code and [path for path in folder.iterdir() if path.name in ("run", ".run.partial")] and code > 0:
            raise UnsoundError(f"{number.name}: something is left") from None


KINDS: Mapping[str, Callable[[Path, Random], None]] = {
    "yaml": probe_yaml,
    "set": probe_set,
    "hdf5": probe_hdf5,
    "csv": probe_csv,
    "bag": probe_bag,
    "urdf": probe_urdf,
    "frames": probe_frames,
    "dataset": probe_dataset,
    "preview": probe_preview,
    "command": probe_command,
    "environment": probe_environment,
    "signal": probe_signal,
}
SHARES = {"yaml": 60, "set": 60, "hdf5": 60, "csv": 80, "bag": 60, "urdf": 80, "frames": 40}
SHARES |= {"dataset": 60, "preview": 60, "command": 20, "environment": 1, "signal": 1}


class UnsoundError(Exception):
    """What the program did that it should not do."""


def checked(folder: Path, *settings: str) -> None:
    """Run the command `check`."""
    shutil.rmtree(folder / "run", ignore_errors=True)
    run_in_process("check", str(folder / "config.yaml"), "--quiet", "--out", str(folder / "run"), *settings)


def run_in_process(*arguments: str) -> None:
    """Run a command and judge how it ended."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        code = command(list(arguments))
    judged(code, said.getvalue())


def judged(code: int, said: str) -> None:
    """Whether a command ended as it may: refused with four parts, or done."""
    if code not in (0, 1, 2):
        raise UnsoundError(f"exit code {code}: {said[-300:]}")
    error = said.rpartition("error: ")[2]
    if code == 2 and not (all(f"\n  {part}: " in error for part in ("where", "allowed", "try")) and len(error) < 620):
        raise UnsoundError(f"an error without its four parts, or too long: {error[:700]}")


# -- workers ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """An input: its kind, and the seed of its damage."""

    kind: str
    seed: int


def tried(case: Case, originals_folder: Path, work: Path) -> str:
    """What is wrong with how an input was taken; nothing where it was refused in words or read."""
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(originals_folder, work)
    stand = work.parent / "stand"
    stand.mkdir(exist_ok=True)
    os.chdir(stand)
    rng = np.random.default_rng([sorted(KINDS).index(case.kind), case.seed])
    begun = time.monotonic()
    try:
        KINDS[case.kind](work, rng)
    except YidError as error:
        if "" in error.message_parts().values() or "Traceback" in str(error) or len(str(error)) > 600:
            return f"an error without words, or with too many: {error!r}"
    except UnsoundError as error:
        return str(error)
    except Exception as error:  # whatever else comes up is what is looked for
        return f"{type(error).__name__}: {error}"[:500]
    if time.monotonic() - begun > PATIENCE:
        return f"{LATE} {time.monotonic() - begun:.1f} s"
    if left := [path.name for path in stand.iterdir()]:
        return f"left where the process stands: {left}"
    peak = peak_memory()
    return f"{peak / 2**30:.1f} GiB" if peak > MEMORY else ""


def peak_memory() -> int:
    """Largest memory of this process so far [bytes]; `ru_maxrss` begins with what the process that started it had."""
    status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    return 1024 * next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM:"))


def serve(there: Connection, originals_folder: str, work: str) -> None:
    """Try inputs until told to end."""
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    room = Path(work)
    room.mkdir(parents=True)
    os.environ["TMPDIR"] = str(room)
    while (case := there.recv()) is not None:
        there.send(tried(case, Path(originals_folder), room / "work"))


@dataclass
class Worker:
    """A process that tries inputs."""

    process: BaseProcess
    pipe: Connection
    case: Case | None = None
    since: float = 0.0


def hunt(cases: Iterator[Case], seconds: float, jobs: int) -> tuple[int, list[tuple[Case, str]]]:
    """Try inputs until they or the time end; returns how many were tried, and those taken wrongly.

    What was late is tried once more: the machine may have been busy with something else.
    """
    context = multiprocessing.get_context("spawn")
    found: list[tuple[Case, str]] = []
    late: list[Case] = []
    count, begun, number = 0, time.monotonic(), 0
    with tempfile.TemporaryDirectory(prefix="yid-fuzz-") as folder:
        valid = Path(folder) / "valid"
        valid.mkdir()
        originals(valid)

        def started() -> Worker:
            nonlocal number
            number += 1
            here, there = context.Pipe()
            work = str(Path(folder) / f"worker_{number}")
            process = context.Process(target=serve, args=(there, str(valid), work), daemon=True)
            process.start()
            there.close()
            return Worker(process, here)

        workers = [started() for _ in range(jobs)]
        going = True
        while True:
            for worker in (each for each in workers if each.case is None):
                case = next(cases, None) if going and time.monotonic() - begun < seconds else None
                going = going and case is not None
                if case is not None:
                    worker.case, worker.since = case, time.monotonic()
                    worker.pipe.send(case)
            busy = [(i, worker) for i, worker in enumerate(workers) if worker.case is not None]
            if not busy:
                break
            wait([worker.pipe for _, worker in busy], timeout=0.2)
            for i, worker in busy:
                assert worker.case is not None
                said: str | None = None
                if worker.pipe.poll():
                    try:
                        said = worker.pipe.recv()
                    except EOFError:
                        worker.process.join()
                        said = f"its process ended with {worker.process.exitcode}"
                elif time.monotonic() - worker.since > 1.5 * PATIENCE + (30 if count < jobs else 0):
                    said = f"{LATE} {1.5 * PATIENCE:g} s"
                if said is None:
                    continue
                if not (again := said.startswith(LATE) and worker.case not in late):
                    count += 1
                    if count % 5000 == 0:
                        print(f"{count} inputs, {len(found)} found, {time.monotonic() - begun:.0f} s", flush=True)
                else:
                    late.append(worker.case)
                if said and not again:
                    found.append((worker.case, said))
                    print(f"{worker.case.kind} --only {worker.case.seed}: {said}", flush=True)
                worker.case = worker.case if again else None
                if said.startswith(("its process", LATE)) or "GiB" in said:
                    worker.process.kill()
                    worker.process.join()
                    worker = workers[i] = replace(started(), case=worker.case)
                if worker.case is not None:
                    worker.since = time.monotonic()
                    worker.pipe.send(worker.case)
        for worker in workers:
            worker.process.kill()
            worker.process.join()
    return count, found


def drawn(kinds: Sequence[str], inputs: int, first: int = 0) -> Iterator[Case]:
    """So many inputs, more of those kinds that take less time."""
    order = np.random.default_rng(0).permutation([kind for kind in kinds for _ in range(SHARES[kind])]).tolist()
    for seed in range(first, first + inputs):
        yield Case(order[seed % len(order)], seed)


def main(argv: Sequence[str] | None = None) -> int:
    """Hunt, or make one input again and read it with its traceback."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--inputs", type=int, default=20_000)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--first", type=int, default=0, help="seed to begin with")
    parser.add_argument("--only", type=int, metavar="SEED", help="read this input alone, with its traceback")
    parser.add_argument("--keep", type=Path, default=Path("fuzz"), help="folder for the files of --only")
    given = parser.parse_args(argv)
    kinds = given.kinds or list(KINDS)
    if unknown := [kind for kind in kinds if kind not in KINDS]:
        parser.error(f"there is no kind '{unknown[0]}'; known: {', '.join(KINDS)}")
    if given.only is not None:
        given.keep.mkdir(parents=True)
        originals(given.keep)
        rng = np.random.default_rng([sorted(KINDS).index(kinds[0]), given.only])
        KINDS[kinds[0]](given.keep, rng)
        return 0
    begun = time.monotonic()
    count, found = hunt(drawn(kinds, given.inputs, given.first), given.seconds, given.jobs)
    print(json.dumps({"inputs": count, "found": len(found), "seconds": round(time.monotonic() - begun, 1)}))
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())

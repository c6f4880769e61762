"""Runs that are killed, run side by side, or meet a full disk: whether anything finished is lost or looks whole.

    python benchmarks/kills.py [--kills 200] [--pairs 20] [--disks 40] [--caches 10] [--seed 0]

Commands run on a double pendulum, whose runs take seconds (solve, compare, diagnose, check, simulate, and a blind proof
of two cases), and on three frames of a camera (track); they take turns. A run is ended by a random signal at a random
moment; two runs share one second or one `--out`; files cannot grow beyond a random size, as on a full disk; compiled
code in the cache is damaged. Afterwards every folder that bears a name has to be whole, only a killed process may leave
its hidden folder, no process may go on, no run that was asked to end may go on to its end, no exit code may say that it
was our mistake, and running again has to give the numbers of an undisturbed run. A blind proof goes on in the folder
that it left, until it ends with the numbers of an undisturbed one. Exit code 1 where something does not hold.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from fuzz import CONFIG, REPOSITORY, made_recording, originals

from yid_ocp.data import read_recording, write_recording
from yid_ocp.errors import YidError

COMMANDS = {
    **dict.fromkeys(("solve", "compare", "diagnose", "check", "simulate"), ("pendulum.yaml",)),
    "track": ("track.yaml",),
    "blind": ("driven.yaml", "--cases", "2", "--seed", "3"),
}
"""Arguments of each command."""
PROOF = "blind"
"""The command that goes on in the folder it finds, instead of taking a hidden one."""
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
FULL = (50_000.0, 3_000.0)  # geometric mean and least of the sizes of a file on a full disk [bytes]
LATE = 0.1  # [s] by which a result may still get its name after a signal
LINGER = 20.0
"""How long what a run started may go on when it has ended [s]."""
TRACK = """\
model:
  robot: package:baxter
  arms: {{joints: [left_s0, left_s1, left_e0, left_e1, left_w0, left_w1, left_w2]}}
  object: {{kind: foam_y}}
  grasp: {{left: {{holder_frame: left_gripper, held_frame: w_T2}}}}
recordings: {{estimate: [{data}/joints.h5]}}
track:
  frames_path: {data}/frames
  n_drawn_frames: 1
  options: {{calibration: {{fix_pose: true}}, clock_offset: {{search_half_width: 0}}}}
"""
Random = np.random.Generator


@dataclass
class Room:
    """A folder with a configuration, its runs, and what was found wrong.

    Attributes
    ----------
    folder : Path
    usual : dict of str to (numbers, seconds)
        What an undisturbed run of each command leaves, and how long it takes.
    wrong : list of str
    """

    folder: Path
    usual: dict[str, tuple[Any, float]] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)

    def start(self, command: str, *arguments: str, limit: int | None = None) -> subprocess.Popen[bytes]:
        """Begin a run; `limit` is the largest size of a file [bytes]."""

        def limited() -> None:
            for number in SIGNALS[1:]:  # a shell in the background has them ignored
                signal.signal(number, signal.SIG_DFL)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            if limit is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

        line = [sys.executable, "-m", "yid_ocp", command, *COMMANDS[command], *arguments]
        environment = {**os.environ, "YID_OCP_CACHE": str(self.folder / "cache"), "PYTHONPATH": str(REPOSITORY)}
        with (self.folder / "said.txt").open("wb") as said:
            return subprocess.Popen(
                line,
                cwd=self.folder,
                env=environment,
                stdout=said,
                stderr=said,
                preexec_fn=limited,
                start_new_session=True,
            )

    def alone(self, process: subprocess.Popen[bytes], after: str) -> None:
        """Whether nothing that a run started goes on when it has ended."""
        begun = time.monotonic()
        while time.monotonic() - begun < LINGER:
            known = subprocess.run(["ps", "-A", "-o", "pgid=,stat="], capture_output=True, text=True, check=True)
            states = [line.split() for line in known.stdout.splitlines()]
            if not any(group == str(process.pid) and not state.startswith("Z") for group, state in states):
                return
            time.sleep(0.2)
        os.killpg(process.pid, signal.SIGKILL)
        self.wrong.append(f"after {after}, a process of it goes on for more than {LINGER:g} s")

    def run(self, command: str, *arguments: str) -> Any:
        """Run to the end; returns the numbers that it left."""
        begun = time.monotonic()
        process = self.start(command, *arguments, "--out", "whole")
        code = process.wait(timeout=600)
        if code not in (0, 1):
            raise RuntimeError(f"{command} {arguments} ended with {code}: {self.said()}")
        found = numbers(json.loads((self.folder / "whole" / "result.json").read_text()))
        subprocess.run(["rm", "-r", str(self.folder / "whole")], check=True)
        self.usual.setdefault(command, (found, time.monotonic() - begun))
        return found

    def again(self, command: str, after: str) -> None:
        """Whether a run gives the numbers of an undisturbed one."""
        if self.run(command) != self.usual[command][0]:
            self.wrong.append(f"after {after}, {command} gives other numbers")

    def say(self, before: int) -> None:
        """Print what was found wrong since then."""
        print("\n".join(self.wrong[before:]), end="\n" if self.wrong[before:] else "", flush=True)

    def said(self) -> str:
        return (self.folder / "said.txt").read_text(errors="replace")[-600:]

    def newest_result(self) -> float:
        """When the newest result got its name [s since the epoch]; a named folder's status changes with its name."""
        named = [*self.folder.glob("runs/[!.]*"), *self.folder.glob("driven-blind-*/result.json")]
        return max((path.stat().st_ctime for path in named if not path.name.endswith(".partial")), default=0.0)

    def look(self, after: str, hidden: bool) -> None:
        """Whether what stands in the room is whole; `hidden`: whether a killed run may have left its hidden folder."""
        for path in self.folder.iterdir():
            if path.name.startswith(".") and path.is_dir() and not hidden:
                self.wrong.append(f"after {after}, {path.name} is left")
        runs = [*self.folder.glob("runs/*"), *self.folder.glob("mine*")]
        for path in runs:
            if (path / "sealed").exists():
                continue  # a proof, see `proof`
            if path.name.endswith(".partial"):
                if path.name.startswith(".") and not hidden:
                    self.wrong.append(f"after {after}, {path.name} is left")
                continue
            try:
                json.loads((path / "result.json").read_text())
            except (OSError, ValueError) as error:
                self.wrong.append(f"after {after}, {path.name} looks whole: {error}")
        subprocess.run(["rm", "-rf", *map(str, runs), str(self.folder / "runs")], check=True)

    def proof(self, after: str, done: bool) -> None:
        """Whether all that stands in a blind proof is whole; what is `done` has its numbers and is taken away."""
        for folder in (*self.folder.glob("driven-blind-*"), *self.folder.glob("mine*")):
            for path in folder.rglob("*.*"):
                if path.name.startswith("."):
                    continue
                try:
                    if path.suffix == ".json":
                        json.loads(path.read_text())
                    if path.suffix == ".h5":
                        read_recording(path)
                except (OSError, ValueError, YidError) as error:
                    self.wrong.append(f"after {after}, {path.name} of a proof looks whole: {error}")
            if done:
                result = folder / "result.json"
                if not result.exists() or numbers(json.loads(result.read_text())) != self.usual[PROOF][0]:
                    self.wrong.append(f"after {after}, a proof that went on has other numbers, or none")
                subprocess.run(["rm", "-r", str(folder)], check=True)

    def finished_proof(self, after: str) -> None:
        """Go on with the proof that was left, to its end."""
        if not [*self.folder.glob("driven-blind-*")]:
            return
        code = self.start(PROOF).wait(timeout=600)
        if code:
            self.wrong.append(f"after {after}, a proof ends with {code}: {self.said()}")
        self.proof(after, done=True)


def numbers(result: Mapping[str, Any]) -> Any:
    """What has to be the same in two runs: all but times, places and versions."""
    dropped = ("seconds", "inputs", "versions", "folder", "peak_memory", "cpu", "memory")

    def kept(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: kept(entry) for key, entry in value.items() if not any(word in key for word in dropped)}
        if isinstance(value, list):
            return [kept(entry) for entry in value]
        return None if isinstance(value, str) else value

    return kept(result)


def killed(room: Room, rng: Random, command: str) -> str:
    """End a run at a random moment."""
    number = SIGNALS[int(rng.integers(len(SIGNALS)))]
    delay = float(rng.uniform(0.0, 1.1 * room.usual[command][1]))
    process = room.start(command)
    time.sleep(delay)
    asked = time.time() if process.poll() is None else None
    process.send_signal(number)
    what = f"{command} and {number.name} after {delay:.2f} s"
    try:
        code = process.wait(timeout=30)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        room.wrong.append(f"{what}: no end within 30 s")
        return what
    if asked is not None and code in (0, 1) and (later := room.newest_result() - asked) > LATE:
        room.wrong.append(f"{what}: went on for {later:.2f} s, to its end with {code}")
    if code not in (0, 1, -number, 128 + number):
        room.wrong.append(f"{what}: ended with {code}: {room.said()}")
    room.alone(process, what)
    if command == PROOF:
        room.proof(what, done=code == 0)
    room.look(what, hidden=code == -number)
    return what


def pair(room: Room, rng: Random, command: str) -> str:
    """Two runs at once, with names of their own or one `--out`."""
    named = bool(rng.random() < 0.5)
    arguments = ("--out", "mine") if named else ()
    both = [room.start(command, *arguments) for _ in range(2)]
    codes = sorted(process.wait(timeout=600) for process in both)
    what = f"two runs of {command} {' '.join(arguments)}"
    if command == PROOF:
        if codes != [0, 0]:
            room.wrong.append(f"{what}: exit codes {codes}: {room.said()}")
        room.proof(what, done=True)
        return what
    runs = [path for path in (*room.folder.glob("runs/*"), *room.folder.glob("mine*")) if not path.name.startswith(".")]
    runs = [path for path in runs if not path.name.endswith(".partial")]
    finished = sum(code in (0, 1) for code in codes)
    if len(runs) != finished or any(code not in (0, 1, 2) for code in codes) or (not named and finished != 2):
        room.wrong.append(f"{what}: exit codes {codes}, folders {[path.name for path in runs]}: {room.said()}")
    room.look(what, hidden=False)
    return what


def full(room: Room, rng: Random, command: str) -> str:
    """A run whose files cannot grow."""
    limit = int(max(FULL[1], FULL[0] * np.exp(rng.normal())))
    process = room.start(command, limit=limit)
    code = process.wait(timeout=600)
    what = f"{command} with files of at most {limit} bytes"
    if code not in (0, 1, 2):
        room.wrong.append(f"{what}: ended with {code}: {room.said()}")
    if code == 2 and ".partial/" in room.said():
        room.wrong.append(f"{what}: an error names the unfinished folder: {room.said()}")
    room.alone(process, what)
    if command == PROOF:
        room.proof(what, done=code == 0)
    room.look(what, hidden=False)
    return what


def damaged(room: Room, rng: Random, command: str) -> str:
    """Compiled code with a block of zeros, cut off, or unreadable."""
    libraries = sorted((room.folder / "cache").glob("*.so"))
    if libraries:
        one = libraries[int(rng.integers(len(libraries)))]
        data = one.read_bytes()
        at = int(rng.integers(len(data)))
        one.unlink()
        one.write_bytes(data[:at] if rng.random() < 0.5 else data[:at] + bytes(4096) + data[at + 4096 :])
    what = "damage of compiled code"
    room.again("solve", what)
    return what


def main(argv: Sequence[str] | None = None) -> int:
    """Disturb runs, print what does not hold."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--disks", type=int, default=40)
    parser.add_argument("--caches", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(argv)
    rng = np.random.default_rng(given.seed)
    with tempfile.TemporaryDirectory(prefix="yid-kills-") as folder:
        room = Room(Path(folder))
        originals(room.folder)
        write_recording(made_recording(1.0), room.folder / "held_out.h5")
        text = CONFIG.format(urdf="robot.urdf").replace("compiler: false", "compiler: true")
        driven = text.replace("mode: prescribed", "mode: driven")
        (room.folder / "driven.yaml").write_text(driven + "diagnosis: {candidates: [joint_viscous]}\n")
        (room.folder / "track.yaml").write_text(TRACK.format(data=REPOSITORY / "tests" / "vision" / "data"))
        text += "compare: {methods: {gauss_newton: {}, steepest_descent: {max_iterations: 20}}}\n"
        (room.folder / "pendulum.yaml").write_text(text.replace("held_out: []", "held_out: [held_out.h5]"))
        for command in COMMANDS:
            room.run(command)
            room.again(command, "nothing")
        room.say(0)
        tests: Sequence[tuple[int, Callable[[Room, Random, str], str]]] = (
            (given.kills, killed),
            (given.pairs, pair),
            (given.disks, full),
            (given.caches, damaged),
        )
        for count, disturb in tests:
            for i in range(count):
                before = len(room.wrong)
                what = disturb(room, rng, list(COMMANDS)[i % len(COMMANDS)])
                print(f"{i + 1} of {count}: {what}", file=sys.stderr, flush=True)
                room.say(before)
            before = len(room.wrong)
            room.again("solve", f"{count} times '{disturb.__name__}'")
            room.finished_proof(f"{count} times '{disturb.__name__}'")
            room.say(before)
        print(json.dumps({"kills": given.kills, "pairs": given.pairs, "disks": given.disks, "wrong": len(room.wrong)}))
        return 1 if room.wrong else 0


if __name__ == "__main__":
    sys.exit(main())

"""Run folders: written under a temporary name, renamed when complete, never half there."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import platform
import secrets
import shutil
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any, TextIO

from yid_ocp.config.settings import Run, dump_config
from yid_ocp.errors import OutputError
from yid_ocp.files import file_sha256, jsonable, write_text
from yid_ocp.workflow.build import input_files


@dataclass
class RunFolder:
    """A folder of results in the making.

    Attributes
    ----------
    target : Path
        Its name when complete.
    path : Path
        Where it is now; the same as `target` in the end.
    partial : Path
        Where an interrupted run may leave what the next one with the same name, or none, can use; not made here.
    inputs : dict of str to str
        SHA-256 of every file that the run reads, by name; see `begin`.
    """

    target: Path
    path: Path
    partial: Path
    _log: TextIO = field(repr=False)
    inputs: dict[str, str] = field(default_factory=dict)
    _begun: float = field(default_factory=time.perf_counter, repr=False)

    def begin(self, run: Run, command: str) -> None:
        """Write config.yaml, hash what the run reads and log the start; errors as `input_files`."""
        self.write("config.yaml", dump_config(run))
        self.inputs |= {name: file_sha256(path) for name, path in input_files(run).items()}
        self.log("start", command=command, versions=versions(), inputs=self.inputs)

    def finish(self, result: Mapping[str, Any]) -> dict[str, Any]:
        """Write result.json with inputs and versions; returns what was written."""
        return self.write_json("result.json", {**result, "inputs": self.inputs, "versions": versions()})

    def log(self, event: str, **entries: Any) -> None:
        """Add a line to log.jsonl."""
        line = {"seconds": round(time.perf_counter() - self._begun, 4), "event": event, **entries}
        self._log.write(json.dumps(jsonable(line), allow_nan=False) + "\n")
        self._log.flush()

    def write(self, name: str, text: str) -> None:
        """Write a text file."""
        write_text(self.path / name, text)

    def write_json(self, name: str, data: Mapping[str, Any]) -> dict[str, Any]:
        """Write JSON without infinities: they become null, and `notes` says where; returns what was written."""
        notes: list[str] = []
        clean = jsonable(data, notes)
        if notes:
            clean["notes"] = _grouped(notes)
        self.write(name, json.dumps(clean, indent=1, allow_nan=False) + "\n")
        return dict(clean)


class _Lines(logging.Handler):
    def __init__(self, folder: RunFolder) -> None:
        super().__init__(logging.INFO)
        self._folder = folder

    def emit(self, record: logging.LogRecord) -> None:
        self._folder.log("message", level=record.levelname, source=record.name, text=record.getMessage())


def _grouped(notes: list[str]) -> list[str]:
    """Notes on the same key of many entries as one."""
    groups: dict[str, list[str]] = {}
    for note in notes:
        groups.setdefault(note.rpartition(".")[2], []).append(note)
    result: list[str] = []
    for tail, texts in groups.items():
        result += [f"{tail} ({len(texts)} times)"] if len(texts) > 3 else texts
    return result


@contextlib.contextmanager
def new_run_folder(run: Run, out: str | Path | None = None, command: str = "") -> Iterator[RunFolder]:
    """Make a run folder that appears under its name when the block ends, and not at all when it is left by an error.

    Parameters
    ----------
    run : Run
    out : str or Path, optional
        Its name; `NAME-YYYYmmdd-HHMMSS` in `output.folder` when absent.
    command : str
        Enters the name: `NAME-COMMAND-...`.

    Yields
    ------
    RunFolder

    Raises
    ------
    OutputError
        The folder exists and is not empty, or cannot be made or written to.
    """
    target = _target(run, out, command)
    made = [parent for parent in (target.parent, *target.parent.parents) if not parent.exists()]
    temporary = target.parent / f".{target.name}.{secrets.token_hex(4)}.partial"
    try:
        temporary.mkdir(parents=True)
        log = (temporary / "log.jsonl").open("w", encoding="utf-8")
    except OSError as error:
        _clear(temporary, made)
        raise _refusal("made", error, target, "choose a writable folder with --out") from error
    partial = target.with_name(f"{_stem(run, command) if out is None else target.name}.partial")
    folder = RunFolder(target, temporary, partial, log)
    try:
        with _logged(folder):
            yield folder
        log.close()
        if target.is_dir():
            target.rmdir()
        os.replace(temporary, target)
        folder.path = target
    except OSError as error:
        log.close()
        _clear(temporary, made)
        raise _refusal("written", error, target, "choose a folder on a disk with room, with --out") from error
    except BaseException:
        log.close()
        _clear(temporary, made)
        raise


@contextlib.contextmanager
def _logged(folder: RunFolder) -> Iterator[None]:
    """Enter the library's messages in log.jsonl while the block runs."""
    lines, logger = _Lines(folder), logging.getLogger("yid_ocp")
    level = logger.level
    logger.addHandler(lines)
    logger.setLevel(min(logger.getEffectiveLevel(), logging.INFO))
    try:
        yield
    finally:
        logger.removeHandler(lines)
        logger.setLevel(level)


def _refusal(what: str, error: OSError, target: Path, hint: str) -> OutputError:
    return OutputError(f"the run folder cannot be {what}: {error.strerror or error}", where=str(target), hint=hint)


def _target(run: Run, out: str | Path | None, command: str) -> Path:
    if out is not None:
        target = Path(out).expanduser().absolute()
        if target.is_dir() and any(target.iterdir()):
            raise OutputError(
                "the run folder exists and is not empty",
                where=str(target),
                allowed="a new name, or an empty folder",
                hint="choose another name with --out, or leave it out for a numbered one",
            )
        if target.exists() and not target.is_dir():
            raise OutputError("the run folder's name is that of a file", where=str(target), hint="choose another --out")
        return target
    parent = Path(run.output.folder) if run.output.folder is not None else Path.cwd() / "runs"
    stem = _stem(run, command, time.strftime("%Y%m%d-%H%M%S"))
    names = (stem, *(f"{stem}-{i}" for i in range(2, 1000)))
    return next(parent / name for name in names if not (parent / name).exists())


def _stem(run: Run, *parts: str) -> str:
    return "-".join(part for part in (run.name, *parts) if part)


def _clear(temporary: Path, made: list[Path]) -> None:
    shutil.rmtree(temporary, ignore_errors=True)
    for parent in made:
        with contextlib.suppress(OSError):
            parent.rmdir()


def versions() -> dict[str, str]:
    """Versions of Python, this package and what its numbers depend on."""
    result = {"python": platform.python_version(), "platform": f"{platform.system()} {platform.machine()}"}
    for package in ("yid-ocp", "casadi", "numpy", "scipy", "h5py"):
        try:
            result[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            result[package] = "not installed"
    return result

"""Run folders, which are written under a temporary name and renamed when they are complete."""

from __future__ import annotations

import contextlib
import itertools
import json
import logging
import os
import shlex
import shutil
import stat
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, TextIO

from filelock import FileLock, Timeout

from yid_ocp import interruption
from yid_ocp.config.settings import RunSettings, config_yaml_with_defaults
from yid_ocp.display import Progress, grouped
from yid_ocp.errors import OutputError, YidError
from yid_ocp.files import file_sha256, folder_error, os_error_reason, to_json_types, write_text
from yid_ocp.report.html import write_report
from yid_ocp.report.sections import ReportData
from yid_ocp.version import installed_versions
from yid_ocp.workflow.run_inputs import input_files_by_name, installed_plugin_versions

log = logging.getLogger(__name__)
_UNFINISHED, _LOCK, _NAMES = ".partial", "yid-ocp.lock", 1000
_FULL_HINT = "choose a folder on a disk with room, with --out"


@dataclass
class RunFolder:
    """A run folder that is being written, with its paths, log and hashes of inputs."""

    final_path: Path  # name of the complete folder
    path: Path  # present path
    resume_folder: Path  # where an interrupted run leaves data for the next run with this name; not created here
    _log: TextIO = field(repr=False)
    input_hashes: dict[str, str] = field(default_factory=dict)  # SHA-256 of every file that the run reads, by name
    _command_line: str = ""
    _begun: float = field(default_factory=time.perf_counter, repr=False)

    def record_run_start(self, run: RunSettings, command: str, flags: Sequence[str] = ()) -> str:
        """Write and return config.yaml, hash the inputs, and log a command's start. Errors: `input_files_by_name`."""
        write_text(self.path / "config.yaml", text := config_yaml_with_defaults(run))
        self.input_hashes |= {name: file_sha256(path) for name, path in input_files_by_name(run).items()}
        origins, said = list(run.key_locations.values()), [run.config_file]
        if any(origin.startswith(("embedded default", "--set")) for origin in origins):
            near = os.path.relpath(self.final_path)
            said = [str((self.final_path if near.startswith("..") else Path(near)) / "config.yaml")]
        self.log_command_start([command, *said, *flags])
        return text

    def log_command_start(self, words: Sequence[str]) -> None:
        """Log the start of a command and its inputs. The command line `yid-ocp` with `words` reproduces its result."""
        self._command_line = shlex.join(["yid-ocp", *words])
        self.log_event("start", command=words[0], versions=software_and_plugin_versions(), inputs=self.input_hashes)

    def write_result(self, result: Mapping[str, Any], name: str = "result.json") -> dict[str, Any]:
        """Write a result with command, date, inputs and versions. Infinities become null and are listed in `notes`."""
        made = {"command": self._command_line, "date": current_local_time_text(), "inputs": self.input_hashes}
        notes: list[str] = []
        clean: dict[str, Any] = to_json_types({**result, **made, "versions": software_and_plugin_versions()}, notes)
        if notes:  # many of one key are one note
            groups = grouped((note.rpartition(".")[2], note) for note in notes)
            shown = ([f"{tail} ({len(own)} times)"] if len(own) > 3 else own for tail, own in groups.items())
            clean["notes"] = [*itertools.chain.from_iterable(shown)]
        write_text(self.path / name, json.dumps(clean, indent=1, allow_nan=False) + "\n")
        return clean

    def write_result_and_report(
        self, run: RunSettings, shown: Progress, result: Mapping[str, Any], name: str = "result.json", /, **known: Any
    ) -> dict[str, Any]:
        """Write result.json and, if the settings ask for it, report.html. `known`: more attributes of `ReportData`."""
        written = self.write_result(result, name)
        if run.output.write_report:
            shown.begin_stage("writing the report", 1.5)
            known = {"robot": run.model.robot} | known
            write_report(self.path / "report.html", ReportData(run.name, run.description, written, **known))
        return written

    def log_event(self, event: str, **entries: Any) -> None:
        """Add a line to log.jsonl."""
        line = {"seconds": round(time.perf_counter() - self._begun, 4), "event": event, **entries}
        with _refusing("written", self.final_path, _FULL_HINT):
            self._log.write(json.dumps(to_json_types(line), allow_nan=False) + "\n")
            self._log.flush()

    def delete_resume_data(self, *paths: Path) -> None:
        """Delete files and folders of `resume_folder`, and this folder if nothing else is in it."""
        with contextlib.suppress(OSError):
            for path in paths:
                if path.is_dir():
                    shutil.rmtree(path)
                else:
                    path.unlink(missing_ok=True)
            self.resume_folder.rmdir()


class _Lines(logging.Handler):
    def __init__(self, folder: RunFolder) -> None:
        super().__init__(logging.INFO)
        self._folder = folder

    def emit(self, record: logging.LogRecord) -> None:
        self._folder.log_event("message", level=record.levelname, source=record.name, text=record.getMessage())


@contextlib.contextmanager
def atomic_run_folder(run: RunSettings, out: str | Path | None = None, command: str = "") -> Iterator[RunFolder]:
    """Context manager that yields a run folder, which appears under its name only if the block succeeds.

    The name is `out`, or `NAME-COMMAND-YYYYmmdd-HHMMSS` in `output.runs_folder`. The name is reserved first, so that
    two runs never write to one folder. Remains of killed runs next to the folder are deleted. Raises `OutputError` if
    the folder exists and is not empty, is being written by another run, or cannot be created or written to.
    """
    stem = "-".join(filter(None, (run.name, command)))
    targets = _targets(run, out, stem)
    made = [parent for parent in targets[0].parents if not parent.exists()]
    with interruption.defer_interruption():  # every new folder gets an owner
        try:
            with _refusing("created", targets[0], "choose a writable folder with --out"):
                target, lock = _reserved(targets)
                temporary = Path(lock.lock_file).parent
                lines = (temporary / "log.jsonl").open("w", encoding="utf-8")
        except OutputError as error:
            if isinstance(error.__cause__, OSError):
                _clear(None, made)
            raise
    partial = target.with_name(f"{stem if out is None else target.name}.partial")
    folder = RunFolder(target, temporary, partial, lines)
    with contextlib.ExitStack() as held:
        held.callback(lock.release)
        held.enter_context(interruption.remove_folder_on_forced_exit(temporary))
        try:
            with _logged(folder):
                yield folder
            interruption.raise_if_interrupted()
            with interruption.defer_interruption():
                _publish(folder, lock)
        except BaseException as error:
            if not Path(lock.lock_file).exists():  # the run is complete
                raise
            with interruption.defer_interruption(), contextlib.suppress(OSError):
                lines.close()
            _clear(temporary, made)
            if isinstance(error, YidError):
                key = tuple(error.where.split("."))
                error.where = run.setting_location(*key) if key in run.key_locations else error.where
                _name_requested_folder(error, target, temporary, partial)
            raise


def _name_requested_folder(error: YidError, target: Path, *hidden: Path) -> None:
    """Replace the hidden folder by the requested folder `target` in the texts of an error."""
    for path in map(str, hidden):
        if path in error.what + error.where:
            error.what, error.where = (text.replace(path, str(target)) for text in (error.what, error.where))
            error.hint = _FULL_HINT if isinstance(error, OutputError) else error.hint


def _publish(folder: RunFolder, lock: FileLock) -> None:
    """Rename the complete folder to its final name, or to the next free one if another run took that name."""
    temporary, target = folder.path, folder.final_path
    with _refusing("written", target, _FULL_HINT):
        folder._log.close()
    Path(lock.lock_file).unlink(missing_ok=True)
    for number in itertools.count(2):
        try:
            if target.is_dir():
                target.rmdir()
            os.replace(temporary, target)
            break
        except OSError as error:
            if not os.path.lexists(target) or number > _NAMES:
                what = f"the run is complete, but its folder cannot get its name: {os_error_reason(error)}"
                raise OutputError(what, where=str(target), hint=f"rename {temporary}, which has the results") from error
            target = folder.final_path.with_name(f"{folder.final_path.name}-{number}")
    if target != folder.final_path:
        log.warning("another run created %s in the meantime, so the results are in %s", folder.final_path, target)
    folder.path = target


def _reserved(targets: Sequence[Path]) -> tuple[Path, FileLock]:
    """Return the first of `targets` that no other run uses, and its lock, a file in the hidden unfinished folder."""
    parent = targets[0].parent
    for temporary in parent.glob(f".*{_UNFINISHED}") if parent.is_dir() else ():  # left by killed runs
        with contextlib.suppress(OSError):
            if (temporary / _LOCK).exists() and _is_of_a_run(temporary):  # without lock: complete except for its name
                lock = _locked(temporary)
                if lock is not None:
                    _clear(temporary, [])
                    lock.release()
    for target in targets:
        if len(targets) > 1 and os.path.lexists(target):
            continue
        temporary = target.parent / f".{target.name}{_UNFINISHED}"
        temporary.mkdir(parents=True, exist_ok=True)
        if not _is_of_a_run(temporary):
            allowed = "no folder of this name, or the folder of an interrupted run"
            what = "the hidden folder that this run would write into has files that are not from a run"
            raise OutputError(what, where=str(temporary), allowed=allowed, hint="rename it, or choose another --out")
        lock = _locked(temporary)
        if lock is None:
            continue
        if len(targets) > 1 and os.path.lexists(target):  # another run completed meanwhile
            _clear(temporary, [])
            lock.release()
            continue
        _remove_all_but_lock(temporary)
        return target, lock
    hint, allowed = "choose another name with --out, or wait for the other run", "a folder that no other run writes"
    raise OutputError("another run is writing this folder", where=str(targets[0]), allowed=allowed, hint=hint)


def _is_of_a_run(temporary: Path) -> bool:
    """Return whether a hidden folder may be emptied: no link, owned by this user, and empty or with a run's lock."""
    lock = temporary / _LOCK
    try:
        info = temporary.lstat()
        if not stat.S_ISDIR(info.st_mode) or (hasattr(os, "getuid") and info.st_uid != os.getuid()):
            return False
        return (lock.is_file() and not lock.is_symlink()) or not any(temporary.iterdir())
    except FileNotFoundError:  # the other run is ending and its lock is gone
        return True


def _remove_all_but_lock(temporary: Path) -> None:
    for entry in temporary.iterdir():
        if entry.name != _LOCK:
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            else:
                entry.unlink()


def _locked(temporary: Path) -> FileLock | None:
    """Return the acquired lock of an unfinished folder. None if another process holds it or deletes the folder."""
    lock = FileLock(temporary / _LOCK, is_singleton=False, thread_local=False)
    try:
        lock.acquire(timeout=0)
    except (Timeout, FileNotFoundError):
        return None
    if Path(lock.lock_file).exists():
        return lock
    lock.release()
    return None


@contextlib.contextmanager
def _logged(folder: RunFolder) -> Iterator[None]:
    lines, logger = _Lines(folder), logging.getLogger("yid_ocp")
    level = logger.level
    logger.addHandler(lines)
    logger.setLevel(min(logger.getEffectiveLevel(), logging.INFO))
    try:
        yield
    finally:
        logger.removeHandler(lines)
        logger.setLevel(level)


@contextlib.contextmanager
def _refusing(what: str, target: Path, hint: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise folder_error(error, target, f"the run folder cannot be {what}", hint) from error


def _targets(run: RunSettings, out: str | Path | None, stem: str) -> list[Path]:
    if out is None:
        parent = Path(run.output.runs_folder) if run.output.runs_folder is not None else Path.cwd() / "runs"
        stem = f"{stem}-{time.strftime('%Y%m%d-%H%M%S')}"
        return [parent / name for name in (stem, *(f"{stem}-{i}" for i in range(2, _NAMES)))]
    allowed = "a new name, or an empty folder"
    if not str(out).strip() or "\0" in str(out):
        what, hint = f"{str(out)!r} is not a valid folder name", "write for example --out runs/first"
        raise OutputError(what, where="--out", allowed=allowed, hint=hint)
    try:
        target = Path(out).expanduser().absolute()
        is_link, is_folder = target.is_symlink(), target.is_dir()
        target = target.resolve() if ".." in target.parts and not is_link else target
        filled, is_existing_file = is_folder and any(target.iterdir()), not is_folder and target.exists()
    except (OSError, ValueError, RuntimeError) as error:  # too long, a null character, or an unknown user's home
        raise folder_error(error, Path(str(out)[:200]), "this path cannot be a run folder") from error
    for found, what, hint in (
        (filled, "exists and is not empty", "choose another name with --out, or leave it out for one with the date"),
        (is_link, "is a symbolic link", "give the folder that the link points to, or choose another --out"),
        (is_existing_file, "is an existing file", f"choose another --out, or rename {target.name}"),
    ):
        if found:
            raise OutputError(f"the run folder {what}", where=str(target), allowed=allowed, hint=hint)
    return [target]


def _clear(temporary: Path | None, made: Sequence[Path]) -> None:
    with interruption.defer_interruption():
        if temporary is not None:
            with contextlib.suppress(OSError):  # delete the lock last: the rest would have no owner without it
                _remove_all_but_lock(temporary)
            shutil.rmtree(temporary, ignore_errors=True)
        for parent in made:
            with contextlib.suppress(OSError):
                parent.rmdir()


def current_local_time_text() -> str:
    """Return the local date and time with UTC offset, as text such as 2026-01-31 12:00:00+01:00."""
    return datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")


def software_and_plugin_versions() -> dict[str, str]:
    """Return versions of Python, this package, its numerical dependencies, and packages whose plug-ins are in use."""
    return installed_versions() | installed_plugin_versions()

"""Run folders: written under a temporary name and renamed when complete."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shlex
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, TextIO

from filelock import FileLock, Timeout

from yid_ocp import interruption
from yid_ocp.config.settings import RunSettings, dump_config
from yid_ocp.errors import OutputError
from yid_ocp.files import file_sha256, os_error_reason, to_json_types, write_text
from yid_ocp.progress import Progress
from yid_ocp.report.html import write_report
from yid_ocp.report.sections import ReportData
from yid_ocp.version import installed_versions
from yid_ocp.workflow.run_inputs import input_files, plugin_versions

log = logging.getLogger(__name__)
_UNFINISHED, _LOCK, _NAMES = ".partial", "lock", 1000


@dataclass
class RunFolder:
    """A run folder while it is being written.

    Attributes
    ----------
    final_path : Path
        Its name when complete.
    path : Path
        Where it is now; the same as `final_path` in the end.
    resume_folder : Path
        Where an interrupted run may leave what the next one with the same name, or none, can use; not made here.
    input_hashes : dict of str to str
        SHA-256 of every file that the run reads, by name; see `begin_run`.
    command_line : str
        What gives its result again; see `begin_run`.
    """

    final_path: Path
    path: Path
    resume_folder: Path
    _log: TextIO = field(repr=False)
    input_hashes: dict[str, str] = field(default_factory=dict)
    command_line: str = ""
    _begun: float = field(default_factory=time.perf_counter, repr=False)

    def begin_run(self, run: RunSettings, command: str, flags: Sequence[str] = ()) -> None:
        """Write config.yaml, hash what the run reads and log the start; errors as `input_files`.

        Parameters
        ----------
        flags : sequence of str
            That the command was given beside its configuration.
        """
        self.write_text_file("config.yaml", dump_config(run))
        self.input_hashes |= {name: file_sha256(path) for name, path in input_files(run).items()}
        self.command_line = _reproducing_command(run, self.final_path, command, flags)
        self.log_event("start", command=command, versions=software_versions(), inputs=self.input_hashes)

    def write_result(self, result: Mapping[str, Any]) -> dict[str, Any]:
        """Write result.json with command, date, inputs and versions; returns what was written."""
        made = {
            "command": self.command_line,
            "date": local_time_text(),
            "inputs": self.input_hashes,
            "versions": software_versions(),
        }
        return self.write_json_file("result.json", {**result, **made})

    def write_report_page(self, run: RunSettings, result: Mapping[str, Any], progress: Progress, **known: Any) -> None:
        """Write report.html, unless the settings want none.

        Parameters
        ----------
        result : mapping
            As it was written.
        **known
            What the page can show beside it, by the attributes of `ReportData`.
        """
        if run.output.write_report:
            progress.begin_stage("writing the report")
            write_report(self.path / "report.html", ReportData(run.name, run.description, result, **known))

    def log_event(self, event: str, **entries: Any) -> None:
        """Add a line to log.jsonl."""
        line = {"seconds": round(time.perf_counter() - self._begun, 4), "event": event, **entries}
        try:
            self._log.write(json.dumps(to_json_types(line), allow_nan=False) + "\n")
            self._log.flush()
        except OSError as error:
            hint = "choose a folder on a disk with room, with --out"
            raise _refusal("written", error, self.final_path, hint) from error

    def write_text_file(self, name: str, text: str) -> None:
        """Write a text file."""
        write_text(self.path / name, text)

    def write_json_file(self, name: str, data: Mapping[str, Any]) -> dict[str, Any]:
        """Write JSON without infinities: they become null, and `notes` says where; returns what was written."""
        notes: list[str] = []
        clean = to_json_types(data, notes)
        if notes:
            clean["notes"] = _grouped(notes)
        self.write_text_file(name, json.dumps(clean, indent=1, allow_nan=False) + "\n")
        return dict(clean)


class _Lines(logging.Handler):
    def __init__(self, folder: RunFolder) -> None:
        super().__init__(logging.INFO)
        self._folder = folder

    def emit(self, record: logging.LogRecord) -> None:
        self._folder.log_event("message", level=record.levelname, source=record.name, text=record.getMessage())


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
def new_run_folder(run: RunSettings, out: str | Path | None = None, command: str = "") -> Iterator[RunFolder]:
    """Make a run folder that appears under its name when the block ends, and not at all when it is left by an error.

    The name is reserved first: two runs never write to one folder, and a run that ends finds its name free. What
    killed runs left beside it is cleared away.

    Parameters
    ----------
    out : str or Path, optional
        Its name; `NAME-YYYYmmdd-HHMMSS` in `output.runs_folder` when absent.
    command : str
        Enters the name: `NAME-COMMAND-...`.

    Raises
    ------
    OutputError
        The folder exists and is not empty, another run is making it, or it cannot be made or written to.
    """
    targets = _targets(run, out, command)
    made = [parent for parent in targets[0].parents if not parent.exists()]
    with interruption.defer_interruption():  # no folder without anybody who knows of it
        try:
            target, lock = _reserved(targets)
            temporary = Path(lock.lock_file).parent
            lines = (temporary / "log.jsonl").open("w", encoding="utf-8")
        except OSError as error:
            _clear(None, made)
            raise _refusal("made", error, targets[0], "choose a writable folder with --out") from error
    partial = target.with_name(f"{_stem(run, command) if out is None else target.name}.partial")
    folder = RunFolder(target, temporary, partial, lines)
    with contextlib.ExitStack() as held:
        held.callback(lock.release)
        held.enter_context(interruption.remove_on_forced_exit(temporary))
        try:
            with _logged(folder):
                yield folder
            with interruption.defer_interruption():
                _publish(folder, lock)
        except BaseException as error:
            if not Path(lock.lock_file).exists():  # the run is complete
                raise
            with interruption.defer_interruption(), contextlib.suppress(OSError):
                lines.close()
            _clear(temporary, made)
            if isinstance(error, OutputError) and str(temporary) in error.where:
                raise _in_words_of(error, temporary, target) from error
            raise


def _publish(folder: RunFolder, lock: FileLock) -> None:
    """Give the complete folder its name, or the next free one where somebody took it: nothing finished is lost."""
    temporary, number = folder.path, 1
    try:
        folder._log.close()
    except OSError as error:
        hint = "choose a folder on a disk with room, with --out"
        raise _refusal("written", error, folder.final_path, hint) from error
    Path(lock.lock_file).unlink(missing_ok=True)
    target = folder.final_path
    while True:
        try:
            if target.is_dir():
                target.rmdir()
            os.replace(temporary, target)
            break
        except OSError as error:
            if not os.path.lexists(target) or number > _NAMES:
                what = f"the run is complete but its folder cannot be renamed: {os_error_reason(error)}"
                raise OutputError(what, where=str(target), hint=f"its results stay in {temporary}") from error
            number += 1
            target = folder.final_path.with_name(f"{folder.final_path.name}-{number}")
    if target != folder.final_path:
        log.warning("%s was taken while the run went on: its folder is %s", folder.final_path, target)
    folder.path = target


def _in_words_of(error: OutputError, temporary: Path, target: Path) -> OutputError:
    """An error on a file of the unfinished folder with the name that its reader knows."""
    where = error.where.replace(str(temporary), str(target))
    hint = "choose a folder on a disk with room, with --out"
    return OutputError(error.what, where=where, allowed=error.allowed, hint=hint)


def _reserved(targets: Sequence[Path]) -> tuple[Path, FileLock]:
    """The first name that no other run has or makes, and the lock that keeps it; it stands in the unfinished folder."""
    _clear_left(targets[0].parent)
    for target in targets:
        if len(targets) > 1 and os.path.lexists(target):
            continue
        temporary = target.parent / f".{target.name}{_UNFINISHED}"
        temporary.mkdir(parents=True, exist_ok=True)
        lock = _locked(temporary)
        if lock is None:
            continue
        if len(targets) > 1 and os.path.lexists(target):  # its run ended meanwhile
            _clear(temporary, [])
            lock.release()
            continue
        for entry in temporary.iterdir():
            if entry.name != _LOCK:
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
        return target, lock
    hint = "choose another name with --out, or wait for the other run"
    raise OutputError(
        "another run is making this folder", where=str(targets[0]), allowed="a name of its own for every run", hint=hint
    )


def _locked(temporary: Path) -> FileLock | None:
    """The lock of an unfinished folder, None where another process holds it or clears the folder away."""
    lock = FileLock(temporary / _LOCK, is_singleton=False, thread_local=False)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return None
    except FileNotFoundError:
        return None
    if not Path(lock.lock_file).exists():
        lock.release()
        return None
    return lock


def _clear_left(parent: Path) -> None:
    for temporary in parent.glob(f".*{_UNFINISHED}") if parent.is_dir() else ():
        if not (temporary / _LOCK).is_file():  # not ours, or complete but for its name
            continue
        with contextlib.suppress(OSError):
            lock = _locked(temporary)
            if lock is not None:
                _clear(temporary, [])
                lock.release()


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
    return OutputError(f"the run folder cannot be {what}: {os_error_reason(error)}", where=str(target), hint=hint)


def _targets(run: RunSettings, out: str | Path | None, command: str) -> list[Path]:
    if out is None:
        parent = Path(run.output.runs_folder) if run.output.runs_folder is not None else Path.cwd() / "runs"
        stem = _stem(run, command, time.strftime("%Y%m%d-%H%M%S"))
        return [parent / name for name in (stem, *(f"{stem}-{i}" for i in range(2, _NAMES)))]
    if not str(out).strip() or "\0" in str(out):
        raise OutputError("this is no name of a folder", where="--out", allowed="a new name, or an empty folder")
    try:
        target = Path(out).expanduser().absolute()
        is_folder = target.is_dir()
        filled = is_folder and any(target.iterdir())
        is_file = not is_folder and target.exists()
    except (OSError, ValueError, RuntimeError) as error:  # too long, a NUL, an unknown user's home
        what = f"this cannot be a run folder: {os_error_reason(error)}"
        raise OutputError(what, where=str(out)[:200], hint="choose a writable folder with --out") from error
    if filled:
        hint = "choose another name with --out, or leave it out for a numbered one"
        problem_text = "the run folder exists and is not empty"
        raise OutputError(problem_text, where=str(target), allowed="a new name, or an empty folder", hint=hint)
    if is_file:
        raise OutputError("the run folder's name is that of a file", where=str(target), hint="choose another --out")
    return [target]


def _stem(run: RunSettings, *parts: str) -> str:
    return "-".join(part for part in (run.name, *parts) if part)


def _clear(temporary: Path | None, made: Sequence[Path]) -> None:
    with interruption.defer_interruption():
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
        for parent in made:
            with contextlib.suppress(OSError):
                parent.rmdir()


def local_time_text() -> str:
    """Local date and time with UTC offset, as text."""
    return datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")


def _reproducing_command(run: RunSettings, folder: Path, command: str, flags: Sequence[str] = ()) -> str:
    origins = list(run.key_locations.values())
    if any(origin.startswith("--set") for origin in origins):
        near = os.path.relpath(folder)
        said = [str((folder if near.startswith("..") else Path(near)) / "config.yaml")]
    else:
        said = [] if any(origin.startswith("embedded default") for origin in origins) else [run.config_file]
    return shlex.join(["yid-ocp", command, *said, *flags])


def software_versions() -> dict[str, str]:
    """Versions of Python, this package, what its numbers depend on, and packages whose plug-ins are in use."""
    return installed_versions() | plugin_versions()

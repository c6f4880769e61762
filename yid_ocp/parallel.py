"""The one place that starts threads and processes: maps over shared memory, and tasks that keep what they finished.

A task is a function at the top of a module with plain data and paths. Its result is one JSON file, written whole by
whoever worked it out, under a name that is the hash of the function's name, the package's version and the arguments; a
path counts by its file's name and content, wherever it stands. So a task that is done is never done again, whatever
became of the run that did it, and any `concurrent.futures.Executor` whose workers see the same files will do.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from yid_ocp.errors import OutputError
from yid_ocp.files import content_hash, file_sha256, reason, write_json
from yid_ocp.version import package_version

FORMAT = "yid-task/1"
log = logging.getLogger(__name__)
Item = TypeVar("Item")
Result = TypeVar("Result")
Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")
Function = Callable[..., Any]
Progress = Callable[[int, int, str], None]
"""Told how many of how many tasks are done, and which one was last."""


def map_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Results in the order of the items, worked out by as many threads as there are processors.

    Compiled code runs outside Python's lock, so that threads share memory and still work side by side.
    """
    entries = list(items)
    workers = min(len(entries), os.cpu_count() or 1)
    if workers < 2:
        return [function(entry) for entry in entries]
    with ThreadPoolExecutor(max_workers=workers) as pool:
        return list(pool.map(function, entries))


# CasADi marks the nodes of expressions while it differentiates them: two threads at once on expressions that share
# symbols give wrong derivatives. Evaluating finished functions is safe.
SYMBOLIC = threading.RLock()
"""Held by whoever builds or differentiates expressions that others may hold too."""


class Once(Generic[Key, Value]):
    """Values that are worked out once, whichever thread asks first, one thread at a time in the whole program.

    For what is made of CasADi's expressions, which threads must not work on side by side.

    Parameters
    ----------
    make : callable
        From the key to the value; must depend on nothing else.
    """

    def __init__(self, make: Callable[[Key], Value]) -> None:
        self._make = make
        self._known: dict[Key, Value] = {}

    def __call__(self, key: Key) -> Value:
        """The value for a key."""
        if key not in self._known:
            with SYMBOLIC:
                if key not in self._known:
                    self._known[key] = self._make(key)
        return self._known[key]


# -- tasks ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Task:
    """One call of a function.

    Attributes
    ----------
    name : str
        For people; it does not count for what is resumed.
    arguments : mapping of str to Any
        By keyword: text, numbers, None, lists and mappings of them, and `Path` for files and folders that are read.
    """

    name: str
    arguments: Mapping[str, Any]


@dataclass(frozen=True)
class TaskResult:
    """What became of a task.

    Attributes
    ----------
    name : str
        The task's.
    value : Any
        What the function returned, as read back from its file; None where it failed.
    error : str
        Why it failed, empty where it did not.
    seconds : float
        Time that the function took.
    resumed : bool
        Whether an earlier run did it.
    """

    name: str
    value: Any = None
    error: str = ""
    seconds: float = 0.0
    resumed: bool = False


def run_tasks(
    function: Function,
    tasks: Sequence[Task],
    folder: Path,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> list[TaskResult]:
    """Run a function on every task whose result is not in the folder yet.

    A task that raises leaves `HASH.error.json` and a warning, and the others go on; the next run tries it again. An
    interruption leaves the results that are finished.

    Parameters
    ----------
    function : callable
        At the top of an importable module; returns what JSON can hold.
    tasks : sequence of Task
    folder : Path
        Of results; made where absent.
    executor : concurrent.futures.Executor, optional
        As many processes as there are processors when absent. Those stop at once when the run is interrupted, and a
        process that dies takes no task with it but the one that killed it.
    progress : callable, optional

    Returns
    -------
    list of TaskResult
        In the order of the tasks.

    Raises
    ------
    DataError
        A task's file cannot be read.
    OutputError
        The folder cannot be made.
    """
    jobs = [_Job(function, task, task_input(function, task), folder) for task in tasks]
    unique = {job.key: job for job in reversed(jobs)}
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"the folder of results cannot be made ({reason(error)})", where=str(folder)) from error
    kept = {key: job.kept() for key, job in unique.items()}
    found = {key: replace(result, resumed=True) for key, result in kept.items() if result is not None}
    if found and progress is not None:
        progress(len(found), len(unique), f"{len(found)} done before")

    def finished(job: _Job, result: TaskResult) -> None:
        found[job.key] = result
        if result.error:
            log.warning("%s failed: %s", result.name, result.error)
        if progress is not None:
            progress(len(found), len(unique), result.name)

    waiting = list(dict.fromkeys(unique[job.key] for job in jobs if job.key not in found))
    if executor is None:
        _in_own_processes(waiting, finished)
    else:
        lost, never = _drain(executor, waiting, len(waiting), finished)
        for job in (*lost, *never):
            finished(job, job.kept() or TaskResult(job.task.name, error="the executor broke"))
    return [replace(found[job.key], name=job.task.name) for job in jobs]


def task_input(function: Function, task: Task) -> dict[str, Any]:
    """What a task's result depends on, as plain data: function, version, arguments, and hashes of files.

    Raises
    ------
    ValueError, TypeError
        A function that another process could not import, an argument that is neither plain data nor a path.
    DataError
        A file that cannot be read.
    """
    if "<" in function.__qualname__:
        raise ValueError(f"{function.__qualname__} does not stand at the top of a module")
    name = f"{function.__module__}.{function.__qualname__}"
    return {"function": name, "version": package_version(), "arguments": _described(task.arguments)}


def _described(value: Any) -> Any:
    if isinstance(value, Path):
        return {"file": value.name, "sha256": file_sha256(value)}
    if isinstance(value, Mapping):
        return {str(key): _described(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_described(entry) for entry in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"a task takes plain data and paths, not {type(value).__name__}")


@dataclass(frozen=True, eq=False)
class _Job:
    """A task and the file of its result."""

    function: Function
    task: Task
    input: Mapping[str, Any]
    folder: Path

    @property
    def key(self) -> str:
        return content_hash(self.input)

    @property
    def file(self) -> Path:
        return self.folder / f"{self.key}.json"

    def kept(self) -> TaskResult | None:
        """The result that stands in the file, None where there is none that is whole and this task's."""
        try:
            held = json.loads(self.file.read_text(encoding="utf-8"))
            if held["format"] == FORMAT and content_hash(held["input"]) == self.key:
                return TaskResult(self.task.name, held["value"], seconds=float(held["seconds"]))
        except (OSError, ValueError, LookupError, TypeError):
            pass
        return None


def _perform(function: Function, task: Task, described: Mapping[str, Any], file: Path) -> str:
    """Work a task out and write its result, in whatever process or machine; returns why that failed, or nothing."""
    begun = time.perf_counter()
    entry = {"format": FORMAT, "name": task.name, "input": described}
    failed = file.with_suffix(".error.json")
    try:
        value = function(**task.arguments)
        write_json(file, {**entry, "seconds": time.perf_counter() - begun, "value": value})
    except Exception as error:
        text = f"{type(error).__name__}: {error}"
        with contextlib.suppress(OutputError):
            write_json(failed, {**entry, "error": text})
        return text
    finally:
        _give_back()
    with contextlib.suppress(OSError):
        failed.unlink(missing_ok=True)
    return ""


def _give_back() -> None:
    """Return freed memory to the system: the C library of Linux keeps it, half a gigabyte after a solve."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)


def _drain(
    executor: Executor, jobs: Sequence[_Job], at_once: int, finished: Callable[[_Job, TaskResult], None]
) -> tuple[list[_Job], list[_Job]]:
    """Run jobs, so many at once; returns those that were lost when the executor broke, and those that never began."""
    queue, running, lost = deque(jobs), dict[Future[str], _Job](), list[_Job]()
    try:
        while (queue and not lost) or running:
            while queue and not lost and len(running) < at_once:
                job = queue[0]
                try:
                    future = executor.submit(_perform, job.function, job.task, job.input, job.file)
                except BrokenExecutor:
                    lost.append(queue.popleft())
                else:
                    running[future] = queue.popleft()
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                job = running.pop(future)
                error = future.exception()
                if isinstance(error, BrokenExecutor):
                    lost.append(job)
                    continue
                text = future.result() if error is None else f"{type(error).__name__}: {error}"
                result = None if text else job.kept()
                finished(job, result or TaskResult(job.task.name, error=text or "it left no result"))
    except BaseException:
        for future in running:
            future.cancel()
        raise
    return lost, list(queue)


# -- processes --------------------------------------------------------------------------------------------------------


def process_pool(workers: int | None = None) -> ProcessPoolExecutor:
    """Fresh processes, as many as there are processors when not said; they leave interruptions to their parent.

    They are started anew instead of forked: a fork copies the locks of threads that it does not copy.
    """
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers or os.cpu_count() or 1, mp_context=context, initializer=_begin_worker)


def _begin_worker() -> None:
    for name in ("SIGINT", "SIGHUP"):  # a terminal sends them to all; the parent says when to end
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A worker whose parent was killed would wait for tasks for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _in_own_processes(jobs: Sequence[_Job], finished: Callable[[_Job, TaskResult], None]) -> None:
    """Run jobs in processes of their own, in spite of those that end their process."""
    rest = list(jobs)
    while rest:
        suspects, rest = _with_pool(min(len(rest), os.cpu_count() or 1), rest, finished)
        # one of those that ran together ended its process; alone, each shows whether it is the one
        for job in suspects:
            kept = job.kept()
            if kept is not None:
                finished(job, kept)
            elif _with_pool(1, [job], finished)[0]:
                finished(job, TaskResult(job.task.name, error="its process ended abruptly"))


def _with_pool(
    workers: int, jobs: Sequence[_Job], finished: Callable[[_Job, TaskResult], None]
) -> tuple[list[_Job], list[_Job]]:
    others = set(multiprocessing.active_children())
    pool = process_pool(workers)
    try:
        return _drain(pool, jobs, workers, finished)
    except BaseException:
        for child in set(multiprocessing.active_children()) - others:
            child.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)

"""Tasks that run in local processes or on a scheduler's workers, with stored results.

A task is a call of a module-level function with plain data and paths. Its result is one JSON file, which its worker
writes in one operation. The name of this file is a hash of the function's name, of the sources that it depends on, and
of the arguments (of a path: file name and content, without folder). A task whose result file exists is not run again,
also after an interruption. Any `concurrent.futures.Executor` is suitable if its workers share the file system.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import json
import logging
import multiprocessing
import os
import socket
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from yid_ocp.errors import ConfigError, DataError, OutputError, ParallelWorkError, YidError, import_optional
from yid_ocp.files import file_sha256, json_sha256, make_folder, read_input_json, write_strict_json
from yid_ocp.parallel.threads_and_processes import InlineExecutor, available_processor_count, process_pool
from yid_ocp.version import package_source_hash, software_fingerprint, software_fingerprint_differences

_TASK_FORMAT = "yid-task/1"
_RESULT_FILE_TIMEOUT = 60.0  # time limit for a file of another machine to become visible [s]
_WORKER_CHECK_INTERVAL = 60.0  # time without a finished task after which the scheduler's workers are checked [s]
_CONNECT_TIMEOUT = 15.0  # timeout for the connection to a scheduler [s]
_MAX_CLIENT_STARTS = 3  # number of attempts to start a client's event loop
log = logging.getLogger(__name__)
_TaskFunction = Callable[..., Any]


@dataclass(frozen=True)
class Task:
    """The arguments for one call of a task function, and a name for display."""

    name: str  # for display only, without influence on the reuse of results
    arguments: Mapping[str, Any]  # text, numbers, None, lists and mappings of them, and a `Path` for each file read


@dataclass(frozen=True)
class TaskResult:
    """The return value of a task, read from its file, or the reason why the task failed."""

    name: str
    value: Any = None
    error: str = ""
    seconds: float = 0.0  # run time of the function
    was_resumed: bool = False  # whether the result is that of an earlier run


@dataclass(frozen=True)
class WorkerConfig:
    """The workers of a run: local processes, or those of a Dask scheduler. `ConfigError` if both are given."""

    n_processes: int | None = None  # number of local processes; default: one per processor
    scheduler_address: str = ""  # HOST:PORT, or the path of a scheduler file

    def __post_init__(self) -> None:
        if self.n_processes is not None and self.n_processes < 1:
            what, hint = f"{self.n_processes} workers are requested, but 1 is needed", "set --workers 1, or omit it"
            raise ConfigError(what, where="--workers", allowed="a whole number from 1", hint=hint)
        if self.n_processes is not None and self.scheduler_address:
            what, where = "the number of workers is given together with a scheduler", "--workers and --scheduler"
            hint = "remove --workers: the scheduler knows how many workers it has"
            raise ConfigError(what, where=where, allowed="one of the two", hint=hint)

    def check_scheduler_available(self) -> None:
        """Raise `ParallelWorkError` if a scheduler is given and does not answer, or has an unsuitable worker."""
        if self.scheduler_address:
            with _dask_executor(self.scheduler_address):
                pass


LOCAL_WORKER_CONFIG = WorkerConfig()  # one process per processor of this machine


def run_tasks(
    function: _TaskFunction,
    tasks: Sequence[Task],
    folder: Path,
    workers: WorkerConfig | Executor = LOCAL_WORKER_CONFIG,
    progress: Callable[[int, int, str], None] | None = None,  # finished tasks, all tasks, name of the last finished one
    code: str | None = None,
) -> list[TaskResult]:
    """Run a function for all tasks and return the results in the same order. Results stored in `folder` are reused.

    A task that raises writes `HASH.error.json` and a warning. The other tasks continue, and the next run repeats the
    failed task. After an interruption, finished results are kept. Workers whose sources differ from this process do not
    run tasks. Raises `DataError` if a task's file cannot be read, `OutputError` if the folder cannot be made, and
    `ParallelWorkError` if no scheduler answers or a worker is unsuitable.

    Parameters
    ----------
    function : callable
        Module-level function; returns data that JSON can represent.
    workers : WorkerConfig or concurrent.futures.Executor
        Local processes stop at once if the run is interrupted. If a process crashes, only its own task is lost. Workers
        of a scheduler finish their current task.
    code : str, optional
        Hash of the sources that results depend on; default: the whole package. See `version.sha256_of_folder_sources`.
    """
    own, maker = package_source_hash() if code is None else code, software_fingerprint()
    # paths are absolute, because a worker may run in another folder
    anywhere = [replace(task, arguments=_mapped(task.arguments, Path.absolute)) for task in tasks]
    jobs = [_Job(function, task, _task_input(function, task, own), folder.absolute(), maker) for task in anywhere]
    unique = {job.key: job for job in reversed(jobs)}
    make_folder(folder, "the folder of results")
    kept = {key: job.kept() for key, job in unique.items()}
    found = {key: replace(result, was_resumed=True) for key, result in kept.items() if result is not None}
    if found and progress is not None:
        progress(len(found), len(unique), f"{len(found)} done before")

    def finished(job: _Job, result: TaskResult) -> None:
        found[job.key] = result
        if result.error:
            log.warning("%s failed. The others go on; the same command tries it again. %s", result.name, result.error)
        if progress is not None:
            progress(len(found), len(unique), result.name)

    waiting = list(dict.fromkeys(unique[job.key] for job in jobs if job.key not in found))
    if waiting:
        _done_by(workers, waiting, finished)
    return [replace(found[job.key], name=job.task.name) for job in jobs]


def require_task_values(results: Sequence[TaskResult]) -> list[Any]:
    """Return the values of all tasks. Raises `ParallelWorkError` if one failed for a known cause, or `RuntimeError`."""
    failed = [entry for entry in results if entry.error]
    if not failed:
        return [entry.value for entry in results]
    first, _, rest = failed[0].error.partition("\n")
    what = f"{len(failed)} of {len(results)} tasks failed; the first failure is that of {failed[0].name}: {first}"
    if "\n  where: " in failed[0].error:
        told = dict(line.strip().partition(": ")[::2] for line in rest.splitlines())  # as `YidError.__str__` writes it
        where = f"task '{failed[0].name}': {told.get('where', 'its arguments')}"
        hint = f"{told.get('try', 'correct this cause')}. Then repeat this command: only the failed tasks run again"
        raise ParallelWorkError(what, where=where, allowed=told.get("allowed", "tasks without errors"), hint=hint)
    raise RuntimeError(f"{what}; the same command tries them again")


def _done_by(workers: WorkerConfig | Executor, jobs: Sequence[_Job], finished: _TaskFinishedCallback) -> None:
    if isinstance(workers, WorkerConfig) and not workers.scheduler_address:
        _in_own_processes(jobs, finished, workers.n_processes or available_processor_count())
        return
    with contextlib.ExitStack() as held:
        executor, look = workers, None
        if isinstance(executor, WorkerConfig):
            cluster = _dask_executor(executor.scheduler_address, jobs[0].function, jobs[0].folder)
            executor, look = held.enter_context(cluster)
        lost, never = _drain(executor, jobs, 1 if isinstance(executor, InlineExecutor) else len(jobs), finished, look)
        for job in (*lost, *never):
            finished(job, job.kept() or TaskResult(job.task.name, error="the workers were lost"))


def _task_input(function: _TaskFunction, task: Task, code: str) -> dict[str, Any]:
    """All inputs of a task as plain data: function, source hash, arguments, file hashes. Their hash is the key."""
    if "<" in function.__qualname__:
        raise ValueError(f"{function.__qualname__} is not defined at the top of a module, so workers cannot import it")
    name = f"{function.__module__}.{function.__qualname__}"
    described = _mapped(task.arguments, lambda path: {"file": path.name, "sha256": file_sha256(path)})
    return {"function": name, "code": code, "arguments": json.loads(json.dumps(described))}


def _mapped(value: Any, change: Callable[[Path], Any]) -> Any:
    if isinstance(value, Path):
        return change(value)
    if isinstance(value, Mapping):
        return {key: _mapped(entry, change) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_mapped(entry, change) for entry in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"a task has an argument of type {type(value).__name__}, which is neither plain data nor a Path")


@dataclass(frozen=True, eq=False)
class _Job:
    """A task with its result file and the required fingerprint of its worker."""

    function: _TaskFunction
    task: Task
    input: Mapping[str, Any]
    folder: Path
    maker: Mapping[str, str]

    @property
    def key(self) -> str:
        return json_sha256(self.input)

    @property
    def file(self) -> Path:
        return self.folder / f"{self.key}.json"

    def kept(self) -> TaskResult | None:
        """The stored result; None if there is no complete result of this task."""
        with contextlib.suppress(DataError, LookupError, TypeError):
            held = read_input_json(self.file)
            if held["format"] == _TASK_FORMAT and json_sha256(held["input"]) == self.key:
                return TaskResult(self.task.name, held["value"], seconds=float(held["seconds"]))
        return None


_TaskFinishedCallback = Callable[[_Job, TaskResult], None]


def _perform(job: _Job) -> str:
    """Run a task and write its result file; returns the error message, empty on success."""
    if unlike := software_fingerprint_differences(job.maker, software_fingerprint()):
        return str(_unfit(socket.gethostname(), unlike))
    begun = time.perf_counter()
    entry = {"format": _TASK_FORMAT, "name": job.task.name, "input": job.input}
    failed = job.file.with_suffix(".error.json")
    try:
        value = job.function(**job.task.arguments)
        write_strict_json(job.file, {**entry, "seconds": time.perf_counter() - begun, "value": value})
    except Exception as error:
        text = str(error) if isinstance(error, YidError) else f"{type(error).__name__}: {error}"
        with contextlib.suppress(OutputError):
            write_strict_json(failed, {**entry, "error": text})
        return text
    finally:
        gc.collect()
        return_freed_memory()
    with contextlib.suppress(OSError):
        failed.unlink(missing_ok=True)
    return ""


def return_freed_memory() -> None:
    """Return freed memory to the system, because Linux's C library keeps half a gigabyte after a solve."""
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def _drain(
    executor: Executor,
    jobs: Sequence[_Job],
    at_once: int,
    finished: _TaskFinishedCallback,
    look: Callable[[], None] | None = None,
) -> tuple[list[_Job], list[_Job]]:
    """Run jobs, at most `at_once` at a time. Returns jobs lost with a broken executor, and jobs that never started."""
    queue, running, lost = deque(jobs), dict[Future[str], _Job](), list[_Job]()
    try:
        while (queue and not lost) or running:
            while queue and not lost and len(running) < at_once:
                job = queue.popleft()
                try:
                    running[executor.submit(_perform, job)] = job
                except BrokenExecutor:
                    lost.append(job)
            done = wait(running, None if look is None else _WORKER_CHECK_INTERVAL, FIRST_COMPLETED).done
            if not done and look is not None:
                look()
            for future in done:
                job = running.pop(future)
                try:
                    text = future.result()
                except (BrokenExecutor, CancelledError):  # raised by Dask if its scheduler is lost
                    lost.append(job)
                    continue
                except Exception as error:  # the executor gave the task up
                    name = type(error).__name__
                    text = "every worker that tried it ended abruptly" if name == "KilledWorker" else f"{name}: {error}"
                result = None if text else _arrived(job, look is not None)
                finished(job, result or TaskResult(job.task.name, error=text or "its worker left no result file"))
    except BaseException:
        for future in running:
            future.cancel()
        raise
    return lost, list(queue)


def _arrived(job: _Job, elsewhere: bool) -> TaskResult | None:
    """The stored result. Waits for the file if another machine may have written it."""
    until = time.monotonic() + (_RESULT_FILE_TIMEOUT if elsewhere else 0.0)
    while (found := job.kept()) is None and time.monotonic() < until:
        os.listdir(job.folder)  # makes a network's file system look again
        time.sleep(0.5)
    return found


def _in_own_processes(jobs: Sequence[_Job], finished: _TaskFinishedCallback, count: int) -> None:
    """Run jobs in processes, and repeat those that were lost when a process crashed."""
    rest = list(jobs)
    while rest:
        suspects, rest = _with_pool(min(len(rest), count), rest, finished)
        # one of these jobs ended its process; each is run alone to find out which
        for job in suspects:
            kept = job.kept()
            if kept is not None:
                finished(job, kept)
            elif _with_pool(1, [job], finished)[0]:
                finished(job, TaskResult(job.task.name, error="its process ended abruptly"))


def _with_pool(workers: int, jobs: Sequence[_Job], finished: _TaskFinishedCallback) -> tuple[list[_Job], list[_Job]]:
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


@contextlib.contextmanager
def _dask_executor(
    scheduler: str, function: _TaskFunction | None = None, folder: Path | None = None
) -> Iterator[tuple[Executor, Callable[[], None]]]:
    """Executor on a Dask scheduler's workers, and a function that warns if there are no workers."""
    what = "the option --scheduler needs the package dask"
    distributed = import_optional("distributed", "cluster", what, ParallelWorkError)
    path = Path(scheduler).expanduser()
    where = {"scheduler_file": str(path)} if path.is_file() else {"address": scheduler}
    refusal: ParallelWorkError | None = None
    try:
        client = _client(distributed, where)
    except AssertionError:
        what = f"the event loop of Dask did not start within {10 * _MAX_CLIENT_STARTS} s"
        hint = "close other programs, or wait until they end; then repeat this command"
        refusal = ParallelWorkError(what, where=scheduler, allowed="a machine with free processors", hint=hint)
    except (OSError, ValueError, TypeError, LookupError) as error:  # TimeoutError is an OSError
        what = f"no scheduler answers: {next(iter(str(error).splitlines()), type(error).__name__)}"
        allowed = "HOST:PORT of a running `dask scheduler`, or the path of its scheduler file"
        hint = "state the port, or start `dask scheduler` and `dask worker HOST:PORT --nthreads 1`"
        refusal = ParallelWorkError(what, where=scheduler, allowed=allowed, hint=hint)
    if refusal is not None:
        gc.collect()  # a half-built client that is finalized while another one starts makes both wait for ever
        raise refusal

    def look() -> None:
        if not client.nthreads():
            log.warning("no worker is ready, so the tasks wait: start `dask worker %s --nthreads 1`", scheduler)

    with client:
        look()
        _refuse_unfit(client, function, folder)
        # if the function counted as pure, Dask would take an earlier failed task for done
        yield client.get_executor(pure=False), look


def _client(distributed: Any, where: dict[str, str]) -> Any:
    """A Dask client; several attempts, because a busy machine may not start its event loop within ten seconds."""
    settings = {**where, "timeout": _CONNECT_TIMEOUT, "set_as_default": False}
    for _ in range(_MAX_CLIENT_STARTS - 1):
        with contextlib.suppress(AssertionError):
            return distributed.Client(**settings)
        log.info("Dask's event loop did not start; it is tried again")
        gc.collect()
    return distributed.Client(**settings)


def _refuse_unfit(client: Any, function: _TaskFunction | None, folder: Path | None) -> None:
    """Raise `ParallelWorkError` if a worker has other versions or several threads, or lacks the package or `folder`."""
    for address, count in client.nthreads().items():
        if count > 1:
            what, allowed = f"a worker runs {count} tasks at once in one process", "one task at a time in every process"
            hint = "start workers with `--nthreads 1 --nworkers N`, where N is the machine's number of processors"
            raise ParallelWorkError(what, where=address, allowed=allowed, hint=hint)
    here = software_fingerprint()
    for address, entry in client.get_versions()["workers"].items():
        said = ".".join(str(entry["host"]["python"]).split(".")[:2])
        if said != here["python"]:  # functions do not travel between these
            raise _unfit(address, [f"python {said} instead of {here['python']}"])
    module = "" if function is None or function.__module__ == "__main__" else function.__module__
    with contextlib.ExitStack() as held:
        probe = folder and held.enter_context(tempfile.NamedTemporaryFile(dir=folder, prefix=".", suffix=".probe")).name
        found = client.run(_question(module, probe or ""))
    for address, said in found.items():
        if isinstance(said, str):
            allowed = "workers that import the same modules and see the same folders as this process"
            hint = "install yid-ocp where the workers run, and choose --out on a file system that all of them share"
            raise ParallelWorkError(f"a worker cannot do the tasks: {said}", where=address, allowed=allowed, hint=hint)
        if unlike := software_fingerprint_differences(here, said):
            raise _unfit(address, unlike)


def _question(module: str, probe: str) -> Callable[[], Any]:
    """A function that returns a worker's fingerprint, or a text if the worker is unsuitable."""

    def asked() -> Any:
        import os

        try:
            made = importlib.import_module("yid_ocp.version").software_fingerprint()
            if module:
                importlib.import_module(module)
        except Exception as error:
            return f"{type(error).__name__}: {error}"
        return f"it does not see {os.path.dirname(probe)}" if probe and not os.path.exists(probe) else made

    return asked


def _unfit(worker: str, unlike: Sequence[str]) -> ParallelWorkError:
    allowed = "workers of the same versions and sources as this process"
    hint = "install the same version there, and start the workers again"
    what = f"the worker {worker} is of another version: {', '.join(unlike)}"
    return ParallelWorkError(what, where=worker, allowed=allowed, hint=hint)

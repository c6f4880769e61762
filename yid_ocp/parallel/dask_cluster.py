"""A Dask cluster as an executor, after a check that its workers can do the tasks."""

from __future__ import annotations

import contextlib
import gc
import importlib
import logging
import secrets
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

from yid_ocp.errors import WorkerError
from yid_ocp.version import software_fingerprint, software_fingerprint_differences

_CONNECT_TIMEOUT = 15.0  # timeout for the connection to a scheduler [s]
_MAX_CLIENT_STARTS = 3  # number of attempts to start a client's event loop
_TaskFunction = Callable[..., Any]
log = logging.getLogger(__name__)


@contextlib.contextmanager
def dask_executor(
    scheduler: str, function: _TaskFunction | None = None, folder: Path | None = None
) -> Iterator[tuple[Executor, Callable[[], None]]]:
    """Context manager for an executor on a Dask scheduler's workers, and a function that warns if there are none.

    Raises
    ------
    WorkerError
        Dask is not installed, no scheduler answers, or a worker cannot do the function or does not see the folder.
    """
    try:
        distributed = importlib.import_module("distributed")
    except ImportError as error:
        hint = "pip install 'yid-ocp[cluster]', or leave --scheduler out for processes on this machine"
        what = "a scheduler needs Dask, which is not installed"
        raise WorkerError(what, where="--scheduler", hint=hint) from error
    path = Path(scheduler).expanduser()
    where = {"scheduler_file": str(path)} if path.is_file() else {"address": scheduler}
    refusal: WorkerError | None = None
    try:
        client = _client(distributed, where)
    except AssertionError:
        what = f"Dask's event loop did not start in {_MAX_CLIENT_STARTS} times ten seconds"
        hint = "run it again once this machine is less busy"
        refusal = WorkerError(what, where=scheduler, allowed="a machine that has time for it", hint=hint)
    except (OSError, ValueError, TypeError, LookupError) as error:  # TimeoutError is an OSError
        what = f"no scheduler answers: {next(iter(str(error).splitlines()), type(error).__name__)}"
        allowed = "HOST:PORT of a running `dask scheduler`, or the path of its scheduler file"
        hint = "start one with `dask scheduler` and workers with `dask worker HOST:PORT --nthreads 1`"
        refusal = WorkerError(what, where=scheduler, allowed=allowed, hint=hint)
    if refusal is not None:
        gc.collect()  # a half-built client that is finalized while another one starts makes both wait for ever
        raise refusal

    def look() -> None:
        if not client.nthreads():
            log.warning("the scheduler at %s has no workers; tasks wait for them", scheduler)

    with client:
        look()
        _refuse_unfit(client, function, folder)
        # Dask would take a task that failed before for done where the function counted as pure
        yield client.get_executor(pure=False), look


def _client(distributed: Any, where: dict[str, str]) -> Any:
    """A Dask client; several attempts, because a busy machine may not start its event loop within ten seconds."""
    for attempt in range(1, _MAX_CLIENT_STARTS + 1):
        try:
            return distributed.Client(**where, timeout=_CONNECT_TIMEOUT, set_as_default=False)
        except AssertionError:
            if attempt == _MAX_CLIENT_STARTS:
                raise
            log.info("Dask's event loop did not start; it is tried again")
        gc.collect()
    return None


def _refuse_unfit(client: Any, function: _TaskFunction | None, folder: Path | None) -> None:
    """Refuse workers with other versions, with several threads, or without access to the same files.

    What they are asked travels whole, not by name: a worker without this package could not even read the name of a
    function of it, and would be lost for its scheduler.
    """
    for address, count in client.nthreads().items():
        if count > 1:
            what, allowed = (
                f"a worker would do {count} tasks at once in one process",
                "one task at a time in every process",
            )
            hint = "start workers with --nthreads 1, and --nworkers for as many as the machine has processors"
            raise WorkerError(what, where=address, allowed=allowed, hint=hint)
    here = software_fingerprint()
    for address, entry in client.get_versions()["workers"].items():
        said = str(entry["host"]["python"])
        if said.split(".")[:2] != here["python"].split("."):  # functions do not travel between these
            raise _unfit(address, [f"python {said} instead of {here['python']}"])
    module = "" if function is None or function.__module__ == "__main__" else function.__module__
    probes = [] if folder is None else [folder / f".{secrets.token_hex(8)}.probe"]
    try:
        for probe in probes:
            probe.write_text("", encoding="utf-8")
        found = client.run(_question(module, "".join(map(str, probes))))
    finally:
        for probe in probes:
            probe.unlink(missing_ok=True)
    for address, said in found.items():
        if isinstance(said, str):
            allowed = "workers that import the same modules and see the same folders as this process"
            hint = "install yid-ocp where the workers run, and choose --out on a file system that all of them share"
            raise WorkerError(f"a worker cannot do the tasks: {said}", where=address, allowed=allowed, hint=hint)
        if unlike := software_fingerprint_differences(here, said):
            raise _unfit(address, unlike)


def _question(module: str, probe: str) -> Callable[[], Any]:
    """A function that returns a worker's fingerprint, or a text where it cannot do the tasks."""

    def asked() -> Any:
        import importlib
        import os

        try:
            made = importlib.import_module("yid_ocp.version").software_fingerprint()
            if module:
                importlib.import_module(module)
        except Exception as error:
            return f"{type(error).__name__}: {error}"
        if probe and not os.path.exists(probe):
            return f"it does not see {os.path.dirname(probe)}"
        return made

    return asked


def _unfit(worker: str, unlike: Sequence[str]) -> WorkerError:
    allowed = "workers of the same versions and sources as this process"
    hint = "install the same version there, and start the workers again"
    return WorkerError(version_mismatch_message(worker, unlike), where=worker, allowed=allowed, hint=hint)


def version_mismatch_message(worker: str, unlike: Sequence[str]) -> str:
    """Error message for a worker with other versions; `unlike` comes from `software_fingerprint_differences`."""
    return f"the worker {worker} is of another version: {', '.join(unlike)}"

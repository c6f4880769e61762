"""Threads and processes on this machine: how many, parallel maps, values shared between threads, pools."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Hashable, Iterable
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from typing import Any, Generic, TypeVar

from yid_ocp.errors import ConfigError

_THREADS_VARIABLE = "YID_OCP_THREADS"  # number of threads per process; by default that of processors
_SHARE = threading.local()
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_Key = TypeVar("_Key", bound=Hashable)
_Value = TypeVar("_Value")


def map_in_threads(function: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
    """Results in the order of the items, computed in as many threads as the process may use.

    Compiled code runs outside Python's lock, so that threads share memory and still work side by side.
    """
    entries = list(items)
    workers = min(len(entries), max_threads())
    if workers < 2:
        return [function(entry) for entry in entries]
    own = max_threads() // workers
    with ThreadPoolExecutor(max_workers=workers, initializer=limit_max_threads, initargs=(own,)) as pool:
        return list(pool.map(function, entries))


def available_processor_count() -> int:
    """Number of processors available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def max_threads() -> int:
    """Number of threads that the caller may use: the process's limit, or its share within `map_in_threads`.

    Raises
    ------
    ConfigError
        `YID_OCP_THREADS` is no number of threads.
    """
    said = os.environ.get(_THREADS_VARIABLE, "")
    if said and not (said.isdecimal() and int(said)):
        raise ConfigError(f"{_THREADS_VARIABLE} is '{said}'", where="environment", allowed="a whole number from 1")
    own = int(said) if said else available_processor_count()
    return min(own, getattr(_SHARE, "count", own))


def limit_max_threads(count: int) -> None:
    """Limit the number of threads that the current thread may use."""
    _SHARE.count = count


# CasADi marks the nodes of expressions while it differentiates them: two threads at once on expressions that share
# symbols give wrong derivatives. Evaluating finished functions is safe.
CASADI_LOCK = threading.RLock()
"""Lock to be held while shared CasADi expressions are built or differentiated."""


class CasadiLockedCache(Generic[_Key, _Value]):
    """Cached values by key, each computed once under the CasADi lock.

    For what is made of CasADi's expressions, which threads must not work on side by side. `compute_value` may depend on
    the key alone.
    """

    def __init__(self, compute_value: Callable[[_Key], _Value]) -> None:
        self._make = compute_value
        self._known: dict[_Key, _Value] = {}

    def __call__(self, key: _Key) -> _Value:
        """The value for a key."""
        if key not in self._known:
            with CASADI_LOCK:
                if key not in self._known:
                    self._known[key] = self._make(key)
        return self._known[key]


# -- processes --------------------------------------------------------------------------------------------------------


class InlineExecutor(Executor):
    """An executor that runs each call at once in the calling process, for work too small for a process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """A completed future."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def process_pool(workers: int | None = None) -> ProcessPoolExecutor:
    """A pool of spawned processes, by default one per processor; they ignore interrupt signals.

    They are started anew instead of forked: a fork copies the locks of threads that it does not copy. Together they use
    as many threads as this process might.
    """
    count = workers or available_processor_count()
    context = multiprocessing.get_context("spawn")
    each = max(1, max_threads() // count)
    return ProcessPoolExecutor(count, mp_context=context, initializer=_begin_worker, initargs=(each,))


def _begin_worker(threads: int) -> None:
    os.environ[_THREADS_VARIABLE] = str(threads)
    for name in ("SIGINT", "SIGHUP"):  # a terminal sends them to all; the parent says when to end
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Exit when the parent process ends, because the worker would wait for tasks forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)

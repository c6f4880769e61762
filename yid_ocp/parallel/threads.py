"""Parallel maps in threads, and cached values shared between threads."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Hashable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Generic, TypeVar

from yid_ocp.errors import ConfigError

THREADS_VARIABLE = "YID_OCP_THREADS"
"""Environment variable with the number of threads per process; by default the number of processors."""
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
    with ThreadPoolExecutor(max_workers=workers, initializer=limit_threads, initargs=(own,)) as pool:
        return list(pool.map(function, entries))


def processor_count() -> int:
    """Number of processors available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def max_threads() -> int:
    """Number of threads that the caller may use: the process's limit, or its share within `map_in_threads`.

    Raises
    ------
    ConfigError
        `YID_OCP_THREADS` is no number of threads.
    """
    said = os.environ.get(THREADS_VARIABLE, "")
    if said and not (said.isdecimal() and int(said)):
        raise ConfigError(f"{THREADS_VARIABLE} is '{said}'", where="environment", allowed="a whole number from 1")
    own = int(said) if said else processor_count()
    return min(own, getattr(_SHARE, "count", own))


def limit_threads(count: int) -> None:
    """Limit the number of threads that the current thread may use."""
    _SHARE.count = count


# CasADi marks the nodes of expressions while it differentiates them: two threads at once on expressions that share
# symbols give wrong derivatives. Evaluating finished functions is safe.
CASADI_LOCK = threading.RLock()
"""Lock to be held while shared CasADi expressions are built or differentiated."""


class LockedCache(Generic[_Key, _Value]):
    """Cached values by key, each computed once under the CasADi lock.

    For what is made of CasADi's expressions, which threads must not work on side by side.

    Parameters
    ----------
    make : callable
        From the key to the value; must depend on nothing else.
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

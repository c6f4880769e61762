"""The one place that starts threads, and what they must do one at a time."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Hashable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Generic, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")

# CasADi marks the nodes of expressions while it differentiates them: two threads at once on expressions that share
# symbols give wrong derivatives. Evaluating finished functions is safe.
_SYMBOLIC = threading.RLock()


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
            with _SYMBOLIC:
                if key not in self._known:
                    self._known[key] = self._make(key)
        return self._known[key]

"""The one place that starts threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


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

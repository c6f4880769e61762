"""Processes on this machine that ignore interrupt signals and end with their parent."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from typing import Any

from yid_ocp.parallel.threads import THREADS_VARIABLE, max_threads, processor_count


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
    count = workers or processor_count()
    context = multiprocessing.get_context("spawn")
    each = max(1, max_threads() // count)
    return ProcessPoolExecutor(count, mp_context=context, initializer=_begin_worker, initargs=(each,))


def _begin_worker(threads: int) -> None:
    os.environ[THREADS_VARIABLE] = str(threads)
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

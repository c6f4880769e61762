"""Processes of this machine that leave interruptions to their parent and end with it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from typing import Any

from yid_ocp.parallel.threads import THREADS, processors, threads


class ThisProcess(Executor):
    """Does what it is given at once, in the process that asks: for work that is less than what a process costs."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """A future that is done."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def process_pool(workers: int | None = None) -> ProcessPoolExecutor:
    """Fresh processes, as many as there are processors when not said; they leave interruptions to their parent.

    They are started anew instead of forked: a fork copies the locks of threads that it does not copy. Together they use
    as many threads as this process might.
    """
    count = workers or processors()
    context = multiprocessing.get_context("spawn")
    each = max(1, threads() // count)
    return ProcessPoolExecutor(count, mp_context=context, initializer=_begin_worker, initargs=(each,))


def _begin_worker(threads: int) -> None:
    os.environ[THREADS] = str(threads)
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

"""Threads and processes on this machine: parallel maps, merged calls, shared caches and process pools.

Merged calls: items run in parallel until each of them waits for a function, which one call then evaluates for all.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Hashable, Iterable, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from yid_ocp.display import grouped
from yid_ocp.errors import ConfigError

_THREADS_VARIABLE = "YID_OCP_THREADS"  # number of threads per process; default: the number of processors
_MAX_CONCURRENT_ITEMS = 8  # largest number of concurrent items, equal to the largest batch size
_THREAD_SHARE = threading.local()
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_Key = TypeVar("_Key", bound=Hashable)
_Value = TypeVar("_Value")


def map_in_threads(function: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
    """Apply a function to items in parallel, in all available threads. Returns the results in the items' order."""
    entries = list(items)
    workers = min(len(entries), _max_threads())
    if workers < 2:
        return [function(entry) for entry in entries]
    own = _max_threads() // workers
    with ThreadPoolExecutor(max_workers=workers, initializer=setattr, initargs=(_THREAD_SHARE, "count", own)) as pool:
        return list(pool.map(function, entries))


def available_processor_count() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _max_threads() -> int:
    """Number of threads that the caller may use: the limit of the process, or a share within `map_in_threads`."""
    said = os.environ.get(_THREADS_VARIABLE, "")
    if said and not (said.isdecimal() and int(said)):
        where, hint = f"the environment variable {_THREADS_VARIABLE}", "unset the variable, or set a whole number"
        raise ConfigError(f"the number of threads is '{said}'", where=where, allowed="a whole number from 1", hint=hint)
    own = int(said) if said else available_processor_count()
    return min(own, getattr(_THREAD_SHARE, "count", own))


# CasADi marks the nodes of expressions during differentiation: two threads that differentiate expressions with shared
# symbols get wrong derivatives. Evaluating finished functions is safe.
CASADI_LOCK = threading.RLock()  # held by the thread that builds or differentiates shared CasADi expressions


class CasadiLockedCache(Generic[_Key, _Value]):
    """A cache that computes the value of each key once, under the CasADi lock, with `compute_value`."""

    def __init__(self, compute_value: Callable[[_Key], _Value]) -> None:
        self._make = compute_value
        self._known: dict[_Key, _Value] = {}

    def __call__(self, key: _Key) -> _Value:
        """Return the value for a key, computed at the first call."""
        if key not in self._known:
            with CASADI_LOCK:
                if key not in self._known:
                    self._known[key] = self._make(key)
        return self._known[key]


class CasadiLockedProperty(cached_property[_Value]):
    """A cached property that one thread computes under the CasADi lock while other threads wait."""

    if not TYPE_CHECKING:  # the type is that of `cached_property`

        def __get__(self, instance: object, owner: type | None = None) -> _Value:
            with CASADI_LOCK:
                return super().__get__(instance, owner)


class _Abandoned(BaseException):
    """Raised in an item whose answer will not come because the map was aborted."""


@dataclass(eq=False)
class _Request:
    """A call of one function by one item, which waits to be merged with calls of other items."""

    rank: int  # index of the item
    function: Callable[[list[Any]], list[Any]]
    questions: list[Any]  # arguments, one for each answer
    answers: Future[list[Any]] = field(default_factory=Future)


@dataclass(eq=False)
class _March:
    """The state of one `map_with_merged_calls`: its threads and their pending requests."""

    live: int  # number of threads that have not finished
    running: threading.Semaphore  # limits the number of items that run at the same time
    changed: threading.Condition = field(default_factory=threading.Condition)
    waiting: list[_Request] = field(default_factory=list)
    abandoned: bool = False

    def ask(self, request: _Request) -> list[Any]:
        """Submit a request to `answer_until_done` and return its answers. While this thread waits, another may run."""
        self.running.release()
        try:
            with self.changed:
                if self.abandoned:
                    raise _Abandoned
                self.waiting.append(request)
                self.changed.notify_all()
            return request.answers.result()
        finally:
            self.running.acquire()

    def leave(self) -> None:
        with self.changed:
            self.live -= 1
            self.changed.notify_all()

    def answer_until_done(self) -> None:
        """Answer the requests of all threads together each time all threads wait, until all threads have finished."""
        while True:
            with self.changed:
                self.waiting = [request for request in self.waiting if not request.answers.done()]
                self.changed.wait_for(lambda: len(self.waiting) == self.live)
                if not self.live:
                    return
                ordered = sorted(self.waiting, key=lambda request: request.rank)
            for group in grouped((request.function, request) for request in ordered).values():
                _answer(group)

    def abandon(self) -> None:
        """Raise `_Abandoned` in all items that wait for answers, and in items that submit requests later."""
        with self.changed:
            self.abandoned = True
            for request in self.waiting:
                if not request.answers.done():
                    request.answers.set_exception(_Abandoned())


def _answer(requests: Sequence[_Request]) -> None:
    try:
        found = iter(requests[0].function([question for request in requests for question in request.questions]))
    except Exception as error:
        for request in requests:
            request.answers.set_exception(error)
        return
    for request in requests:
        request.answers.set_result(list(islice(found, len(request.questions))))


def call_merged_with_other_threads(
    function: Callable[[list[_Item]], list[_Result]], questions: list[_Item]
) -> list[_Result]:
    """Return `function(questions)`, computed in one call together with other items of `map_with_merged_calls`."""
    march = getattr(_THREAD_SHARE, "march", None)
    if march is None:
        return function(questions)
    found: list[_Result] = march.ask(_Request(_THREAD_SHARE.rank, function, questions))
    return found


def map_with_merged_calls(
    function: Callable[[_Item], _Result], items: Iterable[_Item], questions_per_item: int = 1
) -> list[_Result]:
    """Apply a function to items, at most as many at once as there are threads, and return the results in order.

    Calls of `call_merged_with_other_threads` by different items become one call. Which calls are merged depends only on
    the items. An item must not hold a lock during such a call. Waiting items keep their memory, so no more are at work
    than fill two batches, with `questions_per_item` in each call.
    """
    entries = list(items)
    if len(entries) < 2 or getattr(_THREAD_SHARE, "march", None) is not None:
        return [function(entry) for entry in entries]
    live = min(_MAX_CONCURRENT_ITEMS, len(entries), 1 + 2 * _MAX_CONCURRENT_ITEMS // questions_per_item)
    march = _March(live, threading.Semaphore(_max_threads()))
    queue, guard = iter(range(len(entries))), threading.Lock()
    results, errors = dict[int, _Result](), dict[int, BaseException]()

    def work() -> None:
        _THREAD_SHARE.march, _THREAD_SHARE.count = march, 1
        try:
            while not march.abandoned and not errors:
                with guard:
                    index = next(queue, None)
                if index is None:
                    break
                _THREAD_SHARE.rank = index
                try:
                    with march.running:
                        results[index] = function(entries[index])
                except _Abandoned:
                    break
                except BaseException as error:
                    errors[index] = error
        finally:
            march.leave()

    with ThreadPoolExecutor(live) as team:
        try:
            for _ in range(live):
                team.submit(work)
            march.answer_until_done()
        finally:
            march.abandon()
    if errors:
        raise errors[min(errors)]
    return [results[index] for index in range(len(entries))]


class InlineExecutor(Executor):
    """An executor for small work that runs each call at once in the calling process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run a call and return a completed future with its result or exception."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def process_pool(workers: int) -> ProcessPoolExecutor:
    """Make a pool of `workers` processes that ignore interrupt signals.

    The limit on the threads of this process is divided among them, with at least one thread for each.
    """
    context = multiprocessing.get_context("spawn")  # a fork copies the locks of threads that it does not copy
    each = max(1, _max_threads() // workers)
    return ProcessPoolExecutor(workers, mp_context=context, initializer=_begin_worker, initargs=(each,))


def _begin_worker(threads: int) -> None:
    os.environ[_THREADS_VARIABLE] = str(threads)
    for name in ("SIGINT", "SIGHUP"):  # a terminal sends them to all; the parent says when to end
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Exit when the parent process ends. Otherwise the worker would wait for tasks forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)

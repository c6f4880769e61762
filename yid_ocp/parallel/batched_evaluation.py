"""Batched evaluation: items run in parallel until all wait for a function, which is then called once for all."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, TypeVar

from yid_ocp.parallel.threads_and_processes import limit_max_threads, max_threads

_MAX_CONCURRENT_ITEMS = 8  # largest number of concurrent items, equal to the largest batch size
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_Query = TypeVar("_Query")
_Answer = TypeVar("_Answer")


class _Abandoned(BaseException):
    """Raised in an item that waits for an answer that will not come."""


@dataclass(eq=False)
class _Request:
    """Arguments of one item for one function, and what becomes of them."""

    rank: int
    function: Callable[[list[Any]], list[Any]]
    questions: list[Any]
    answers: Future[list[Any]] = field(default_factory=Future)


@dataclass(eq=False)
class _March:
    """Running items and their pending requests."""

    live: int
    running: threading.Semaphore
    changed: threading.Condition = field(default_factory=threading.Condition)
    waiting: list[_Request] = field(default_factory=list)
    abandoned: bool = False

    def ask(self, request: _Request) -> list[Any]:
        """Wait for the answers to a request, and let another item run meanwhile."""
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
        """Register that one thread has no more items."""
        with self.changed:
            self.live -= 1
            self.changed.notify_all()

    def answer_until_done(self) -> None:
        """Answer all requests whenever all threads wait, until no thread is left."""
        while True:
            with self.changed:
                self.waiting = [request for request in self.waiting if not request.answers.done()]
                self.changed.wait_for(lambda: len(self.waiting) == self.live)
                if not self.live:
                    return
                groups: dict[Any, list[_Request]] = {}
                for request in sorted(self.waiting, key=lambda request: request.rank):
                    groups.setdefault(request.function, []).append(request)
            for group in groups.values():
                _answer(group)

    def abandon(self) -> None:
        """End all items that wait, now or later."""
        with self.changed:
            self.abandoned = True
            for request in self.waiting:
                if not request.answers.done():
                    request.answers.set_exception(_Abandoned())


def _answer(requests: Sequence[_Request]) -> None:
    """Call one function for several requests and distribute its results."""
    try:
        found = iter(requests[0].function([question for request in requests for question in request.questions]))
    except Exception as error:
        for request in requests:
            request.answers.set_exception(error)
        return
    for request in requests:
        request.answers.set_result(list(islice(found, len(request.questions))))


_HERE = threading.local()


def batched_call(function: Callable[[list[_Query]], list[_Answer]], questions: list[_Query]) -> list[_Answer]:
    """Results of a function of many arguments, in one call with those of other `map_with_batched_calls` items.

    `function` answers any number of questions; equal functions are asked together.
    """
    march = getattr(_HERE, "march", None)
    if march is None:
        return function(questions)
    found: list[_Answer] = march.ask(_Request(_HERE.rank, function, questions))
    return found


def map_with_batched_calls(function: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
    """Results of a function for all items, run concurrently so that their `batched_call` calls are batched.

    As many run as there are threads to use; they wait for each other wherever one calls `batched_call`, so that all are
    answered at once.
    Which questions meet depends on the items alone. No item may hold a lock that others want while it asks.
    """
    entries = list(items)
    if len(entries) < 2 or getattr(_HERE, "march", None) is not None:
        return [function(entry) for entry in entries]
    march = _March(min(_MAX_CONCURRENT_ITEMS, len(entries)), threading.Semaphore(max_threads()))
    queue, guard = iter(range(len(entries))), threading.Lock()
    results: dict[int, _Result] = {}
    errors: dict[int, BaseException] = {}

    def work() -> None:
        _HERE.march = march
        limit_max_threads(1)
        try:
            while not march.abandoned and not errors:
                with guard:
                    index = next(queue, None)
                if index is None:
                    break
                _HERE.rank = index
                try:
                    with march.running:
                        results[index] = function(entries[index])
                except _Abandoned:
                    break
                except BaseException as error:
                    errors[index] = error
        finally:
            march.leave()

    team = [threading.Thread(target=work, daemon=True) for _ in range(march.live)]
    try:
        for thread in team:
            thread.start()
        march.answer_until_done()
    finally:
        march.abandon()
        for thread in team:
            if thread.ident is not None:
                thread.join()
    if errors:
        raise errors[min(errors)]
    return [results[index] for index in range(len(entries))]

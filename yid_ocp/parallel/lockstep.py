"""Work that goes on side by side until all of it waits for the same kind of answer, which is then given at once."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from yid_ocp.parallel.threads import share_of_threads, threads

MOST = 8
"""Items at work at once: as many as the widest batch has members."""
Item = TypeVar("Item")
Result = TypeVar("Result")
Question = TypeVar("Question")
Answer = TypeVar("Answer")


class _Abandoned(BaseException):
    """Raised where an item waits for an answer that nobody will give any more."""


@dataclass(eq=False)
class _Request:
    """Questions of one item to one function."""

    rank: int
    function: Callable[[list[Any]], list[Any]]
    questions: list[Any]
    answers: list[Any] | None = None
    error: BaseException | None = None


@dataclass(eq=False)
class _March:
    """Items that are at work, and what they wait for."""

    live: int
    running: threading.Semaphore
    changed: threading.Condition = field(default_factory=threading.Condition)
    waiting: list[_Request] = field(default_factory=list)
    abandoned: bool = False

    def ask(self, request: _Request) -> list[Any]:
        """Wait for the answers to a request, and meanwhile let another item run."""
        self.running.release()
        try:
            return self._answers(request)
        finally:
            self.running.acquire()

    def _answers(self, request: _Request) -> list[Any]:
        with self.changed:
            self.waiting.append(request)
            self.changed.notify_all()
            while request.answers is None and request.error is None:
                if self.abandoned:
                    raise _Abandoned
                self.changed.wait()
        if request.error is not None:
            raise request.error
        assert request.answers is not None
        return request.answers

    def leave(self) -> None:
        """One thread has no more items."""
        with self.changed:
            self.live -= 1
            self.changed.notify_all()

    def answer_until_done(self) -> None:
        """Answer whenever all threads wait, until none is left."""
        while True:
            with self.changed:
                self.changed.wait_for(lambda: len(self.waiting) == self.live)
                if not self.live:
                    return
                requests, self.waiting = sorted(self.waiting, key=lambda request: request.rank), []
            for group in _by_function(requests):
                _answer(group)
            with self.changed:
                self.changed.notify_all()


_HERE = threading.local()


def ask_together(function: Callable[[list[Question]], list[Answer]], questions: list[Question]) -> list[Answer]:
    """Answers of a function to some questions, asked along with those of all other items of a `map_in_step`.

    Parameters
    ----------
    function : callable
        From any number of questions to their answers; equal functions are asked together.
    questions : list
    """
    march = getattr(_HERE, "march", None)
    if march is None:
        return function(questions)
    found: list[Answer] = march.ask(_Request(_HERE.rank, function, questions))
    return found


def map_in_step(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Results in the order of the items, some of which are at work side by side, in threads of their own.

    As many run as there are threads to use; they wait for each other wherever one calls `ask_together`, so that all are
    answered at once.
    Which questions meet depends on the items alone. No item may hold a lock that others want while it asks.
    """
    entries = list(items)
    if len(entries) < 2 or getattr(_HERE, "march", None) is not None:
        return [function(entry) for entry in entries]
    march = _March(min(MOST, len(entries)), threading.Semaphore(threads()))
    queue, guard = iter(range(len(entries))), threading.Lock()
    results: dict[int, Result] = {}
    errors: dict[int, BaseException] = {}

    def work() -> None:
        _HERE.march = march
        share_of_threads(1)
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
        with march.changed:
            march.abandoned = True
            march.changed.notify_all()
        for thread in team:
            if thread.ident is not None:
                thread.join()
    if errors:
        raise errors[min(errors)]
    return [results[index] for index in range(len(entries))]


def _by_function(requests: Sequence[_Request]) -> list[list[_Request]]:
    groups: dict[Any, list[_Request]] = {}
    for request in requests:
        groups.setdefault(request.function, []).append(request)
    return list(groups.values())


def _answer(requests: Sequence[_Request]) -> None:
    """Ask one function all that it is asked, and deal out what it says."""
    try:
        answers = requests[0].function([question for request in requests for question in request.questions])
    except Exception as error:
        for request in requests:
            request.error = error
        return
    at = 0
    for request in requests:
        request.answers = answers[at : at + len(request.questions)]
        at += len(request.questions)

"""Signals that end a command: they raise an exception, again if it is lost, and after 10 s they end the process."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

_RERAISE_INTERVAL = 2.0  # time after which a suppressed interruption is raised again [s]
_FORCED_EXIT_DELAY = 10.0  # time after which a process that does not end is killed [s]
_TERMINATION_SIGNALS = [number for number in signal.Signals if number.name in ("SIGINT", "SIGTERM", "SIGHUP")]


class InterruptedBySignal(KeyboardInterrupt):
    """An exception that is raised when SIGINT, SIGTERM or SIGHUP requests the end of the command."""

    def __init__(self, signal_number: int) -> None:
        super().__init__(signal.Signals(signal_number).name)
        self.signal_number = signal_number


@dataclass
class _SignalState:
    """State of this process: the received signal, nesting of deferring blocks, folders to remove on a forced exit."""

    asked: int | None = None
    deferring: int = 0
    unfinished: set[Path] = field(default_factory=set)


_STATE = _SignalState()


def raise_if_interrupted() -> None:
    """Raise `InterruptedBySignal` if a signal asked the command to end, but a library suppressed the signal."""
    if _STATE.asked is not None:
        raise InterruptedBySignal(_STATE.asked)


@contextlib.contextmanager
def defer_interruption() -> Iterator[None]:
    """Delay the exception for a termination signal until the `with` block has ended. The block should be short."""
    _STATE.deferring += 1
    before = _STATE.asked
    try:
        yield
    finally:
        _STATE.deferring -= 1
    if not _STATE.deferring and _STATE.asked is not None and before is None:
        raise InterruptedBySignal(_STATE.asked)


@contextlib.contextmanager
def remove_folder_on_forced_exit(folder: Path) -> Iterator[None]:
    """Remove a folder if the process has to be ended by force inside a `with` block."""
    _STATE.unfinished.add(folder)
    try:
        yield
    finally:
        _STATE.unfinished.discard(folder)


@contextlib.contextmanager
def raise_on_termination_signals() -> Iterator[None]:
    """Raise `InterruptedBySignal` when SIGINT, SIGTERM or SIGHUP arrives inside a `with` block.

    The exception is raised again every `_RERAISE_INTERVAL` seconds, because it can be lost in garbage collection, in
    callbacks of libraries, or in a call that does not return. After `_FORCED_EXIT_DELAY` seconds the process is ended
    with the exit code that shells expect; before, only the folders of `remove_folder_on_forced_exit` are removed.
    Signals that the parent process ignores (`nohup`) stay ignored. Outside the main thread the block has no effect.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in _TERMINATION_SIGNALS}
    taken = {number: handler for number, handler in before.items() if handler not in (signal.SIG_IGN, None)}
    told, tell = socket.socketpair()
    tell.setblocking(False)
    ended = threading.Event()
    _STATE.asked = None
    wakeup = signal.set_wakeup_fd(tell.fileno(), warn_on_full_buffer=False)
    for number in taken:
        signal.signal(number, _raise)
    watcher = threading.Thread(target=_watch, args=(told, ended, threading.get_ident()), daemon=True)
    watcher.start()
    try:
        yield
    finally:
        _STATE.deferring += 1  # a signal that the watcher has just sent still finds this handler
        ended.set()
        signal.set_wakeup_fd(wakeup)
        tell.close()
        watcher.join()
        told.close()
        for number, handler in taken.items():
            signal.signal(number, handler)
        _STATE.asked = None
        _STATE.deferring -= 1


def _raise(number: int, frame: FrameType | None) -> None:
    _STATE.asked = number
    if not _STATE.deferring:
        raise InterruptedBySignal(number)


def _watch(told: socket.socket, ended: threading.Event, main: int) -> None:
    """Wait in a thread for a signal, then send it to the thread `main` again and again until the process ends."""
    number = None
    while number is None:
        received = told.recv(64)
        if not received:
            return
        number = next((int(entry) for entry in _TERMINATION_SIGNALS if entry in received), None)
    waited = 0.0
    while not ended.wait(_RERAISE_INTERVAL):
        waited += _RERAISE_INTERVAL
        if waited >= _FORCED_EXIT_DELAY or not hasattr(signal, "pthread_kill"):
            for folder in tuple(_STATE.unfinished):
                shutil.rmtree(folder, ignore_errors=True)
            os._exit(128 + number)
        signal.pthread_kill(main, number)

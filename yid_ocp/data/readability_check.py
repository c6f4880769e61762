"""Trial reads in another process, because damaged files can crash or hang some libraries."""

from __future__ import annotations

import contextlib
import faulthandler
import os
import select
import signal
import warnings
from collections.abc import Callable
from pathlib import Path

from yid_ocp.errors import DataError

_READ_TIMEOUT = 10.0
"""Time limit for reading a whole file [s]."""


def check_readable_in_fork(path: Path, complaint: Callable[[Path], str], noun: str) -> None:
    """Check in a forked process that a file can be read.

    A fork, as a new process would take a second and a process of a pool may have no children.

    Parameters
    ----------
    path : Path
    complaint : callable
        Reads the file and says what stands against it; nothing where all of it can be read.
    noun : str
        The format, for messages.

    Raises
    ------
    DataError
        What the trial said, or how it ended.
    """
    if not hasattr(os, "fork"):
        return
    here, there = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of threads, none of which the fork needs
        child = os.fork()
    if child == 0:
        try:
            faulthandler.disable()
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # allocators print before they abort
            os.write(there, f".{complaint(path)}".encode(errors="replace")[:2000])
        finally:
            os._exit(0)
    os.close(there)
    try:
        ready, _, _ = select.select([here], [], [], _READ_TIMEOUT)
        said = os.read(here, 4000).decode(errors="replace") if ready else None
    finally:
        os.close(here)
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
    if said is None:
        what = f"the {noun} file cannot be read within {_READ_TIMEOUT:g} s: it is damaged, or far too large"
    elif not said:
        number = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
        how = signal.Signals(number).name if number else "an exit"
        what = f"the {noun} file is damaged (it ends the {noun} library with {how})"
    else:
        what = said[1:]
    if what:
        raise DataError(what, where=str(path), hint="copy or record it again, as one file of its own")

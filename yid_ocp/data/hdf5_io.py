"""Safe HDF5 access: atomic writes, and reads only after another process has read the file without a crash.

The HDF5 library ends the process that meets a full disk while it writes, or certain damage while it reads, and takes
links into other files for its own. None of this can be caught, so it is kept away from the process that does the
work.
"""

from __future__ import annotations

import contextlib
import faulthandler
import os
import select
import signal
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py

from yid_ocp.errors import DataError
from yid_ocp.files import MAX_INPUT_NUMBERS, atomic_write, check_input_file, limited_memory, os_error_reason

_READ_TIMEOUT = 10.0
"""Time limit for reading a whole file [s]."""


def check_readable_in_fork(path: Path, complaint: Callable[[Path], str], noun: str) -> None:
    """Check in a forked process that a file can be read.

    A fork, as a new process would take a second and a process of a pool may have no children.

    Parameters
    ----------
    complaint : callable
        Reads the file and says what stands against it; nothing where all of it can be read.
    noun : str
        The format, for messages.

    Raises
    ------
    DataError
        The file is no regular one, what the trial said, or how it ended.
    """
    check_input_file(path)
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
            with limited_memory():
                said = complaint(path)
            os.write(there, f".{said}".encode(errors="replace")[:2000])
        finally:
            os._exit(0)
    os.close(there)
    try:
        ready, _, _ = select.select([here], [], [], _READ_TIMEOUT)
        answer = os.read(here, 4000).decode(errors="replace") if ready else None
    finally:
        os.close(here)
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
    if answer is None:
        what = f"the {noun} file cannot be read within {_READ_TIMEOUT:g} s: it is damaged, or far too large"
    elif not answer:
        number = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
        how = signal.Signals(number).name if number else "an exit"
        what = f"the {noun} file is damaged (it ends the {noun} library with {how})"
    else:
        what = answer[1:]
    if what:
        raise DataError(what, where=str(path), hint="copy or record it again, as one file of its own")


_MAX_GROUP_DEPTH = 10
"""Largest nesting depth of groups."""


@contextlib.contextmanager
def create_hdf5_atomically(path: str | os.PathLike[str]) -> Iterator[h5py.File]:
    """Context manager of a new HDF5 file in memory, written atomically when the block ends without error.

    Raises
    ------
    OutputError
        The file cannot be written; one that was there before is left as it was.
    """
    with atomic_write(Path(path)) as temporary:
        with h5py.File(str(temporary), "w", driver="core", backing_store=False) as file:
            yield file
            file.flush()
            image = file.id.get_file_image()
        temporary.write_bytes(image)


@contextlib.contextmanager
def open_checked_hdf5(path: str | os.PathLike[str]) -> Iterator[h5py.File]:
    """Context manager of an HDF5 file, opened after another process has checked that it can be read.

    Raises
    ------
    DataError
        The file is damaged, holds more than `MAX_INPUT_NUMBERS`, takes too long to read, or refers to other
        files, whose contents no hash of this one covers; errors of the library in the block, too.
    """
    check_readable_in_fork(Path(path), _complaint, "HDF5")
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:  # all of them come from h5py
        what = f"the HDF5 file is truncated or damaged ({os_error_reason(error)})"
        raise DataError(what, where=str(path), hint="copy or record it again") from error


def _complaint(path: Path) -> str:
    """What stands against reading a file; nothing where all of it can be read."""
    try:
        with h5py.File(path, "r") as file:
            complaint = _foreign(file) or _excess(file)
            if not complaint:
                dict(file.attrs)
                file.visititems(_read)
            return complaint
    except Exception as error:  # whatever h5py says of damaged files
        return f"the HDF5 file is truncated or damaged ({os_error_reason(error)})"


def _read(name: str, item: h5py.Group | h5py.Dataset) -> None:
    dict(item.attrs)
    if isinstance(item, h5py.Dataset):
        item[()]


def _foreign(group: h5py.Group, depth: int = 0) -> str:
    """Which entry stands in another file."""
    for name in group:
        link = group.get(name, getlink=True)
        item = None if isinstance(link, h5py.ExternalLink) else group.get(name)
        if item is None:
            return f"'{name}' in the HDF5 file is a link into another file, or into nowhere"
        if isinstance(item, h5py.Dataset) and (item.is_virtual or item.external):
            return f"the values of '{name}' in the HDF5 file stand in another file"
        if isinstance(item, h5py.Group):
            found = (
                _foreign(item, depth + 1)
                if depth < _MAX_GROUP_DEPTH
                else "groups in the HDF5 file stand in one another"
            )
            if found:
                return found
    return ""


def _excess(file: h5py.File) -> str:
    """Whether a file declares more than can be meant, whatever its types and its compression make of it in the file."""
    numbers = 0.0

    def count(name: str, item: h5py.Group | h5py.Dataset) -> None:
        nonlocal numbers
        if isinstance(item, h5py.Dataset) and item.shape is not None:
            numbers += max(1.0, item.dtype.itemsize / 8) * item.size

    file.visititems(count)
    meant = f"{MAX_INPUT_NUMBERS / 1e6:.0f} million are the most that can be meant"
    return f"the HDF5 file declares {numbers / 1e6:.0f} million numbers; {meant}" if numbers > MAX_INPUT_NUMBERS else ""

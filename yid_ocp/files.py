"""Atomic file writing, hashes of files and data, conversion to JSON types."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import secrets
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.errors import DataError, OutputError


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Context manager that writes a file atomically: the yielded temporary file replaces `path` on success.

    Raises
    ------
    OutputError
        If the folder is missing or the file cannot be written.
    """
    if path.is_dir() or not path.parent.is_dir():
        what = "the name of the file is that of a folder" if path.is_dir() else "the folder to write to does not exist"
        raise OutputError(what, where=str(path), hint="make the folder first, or choose another name")
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except (OSError, RuntimeError) as error:
        hint = "choose a writable folder on a disk with room"
        what = f"the file cannot be written ({os_error_reason(error)})"
        raise OutputError(what, where=str(path), hint=hint) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file atomically; errors as `atomic_write`."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, data: Any) -> None:
    """Write plain data as indented JSON atomically; errors as `atomic_write`, and ValueError for infinities and NaN."""
    write_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n")


def is_file(path: Path) -> bool:
    """Whether there is a file of that name; False for names that are too long or invalid."""
    return os.path.isfile(path)


def file_sha256(path: Path) -> str:
    """SHA-256 of a file, or of all files in a folder in the order of their names; 64 hexadecimal digits.

    Raises
    ------
    DataError
        If it is missing or cannot be read.
    """
    digest = hashlib.sha256()
    try:
        for entry in sorted(item for item in path.rglob("*") if item.is_file()) if path.is_dir() else [path]:
            with entry.open("rb") as file:
                while block := file.read(1 << 20):
                    digest.update(block)
    except FileNotFoundError as error:
        raise DataError("there is no such file", where=str(path), hint="check the path") from error
    except OSError as error:
        raise DataError(f"the file cannot be read ({os_error_reason(error)})", where=str(path)) from error
    return digest.hexdigest()


def json_sha256(data: Any) -> str:
    """SHA-256 of plain data as JSON, independent of key order; 64 hexadecimal digits."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def to_json_types(value: Any, notes: list[str] | None = None, path: str = "") -> Any:
    """A value converted to JSON types; numbers that are not finite become None, with a line in `notes`."""
    if isinstance(value, Mapping):
        return {str(k): to_json_types(v, notes, f"{path}.{k}" if path else str(k)) for k, v in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [to_json_types(v, notes, f"{path}[{i}]") for i, v in enumerate(value)]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        if notes is not None:
            notes.append(f"{path} is {'not known' if math.isnan(value) else 'infinite'}")
        return None
    return value if value is None or isinstance(value, (bool, int, float, str)) else str(value)


def os_error_reason(error: Exception) -> str:
    """Reason of an error of the operating system or HDF5, in words."""
    number = getattr(error, "errno", None)
    return os.strerror(number) if number else str(error).strip("'\"")

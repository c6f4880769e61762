"""Safe reading of input files, atomic writing, hashes, and conversion to and from JSON."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import os
import secrets
import stat
import types
import typing
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from yid_ocp.errors import DataError, OutputError, nearest_file_question

_DataclassType = TypeVar("_DataclassType")

MAX_INPUT_NUMBERS = 50_000_000  # in one input file; as float64 with copies (40 bytes each) they take 2 GB
MAX_TEXT_BYTES = 1 << 26  # largest size of a file that is read as one text
_MEMORY_OF_READING = 7 << 28  # address space for a library that reads a file [bytes]


def check_input_file(path: Path, max_bytes: int | None = None) -> Path:
    """Check an input file and return its path. Raises `DataError` unless it is a regular file of at most `max_bytes`.

    Every file that this package did not write or ship is checked, so pipes and devices are refused before reading.
    """
    allowed = "the path of an existing, readable file"
    try:
        info, readable = path.stat(), os.access(path, os.R_OK)
    except (OSError, ValueError) as error:  # a NUL in the name is a ValueError
        absent = isinstance(error, FileNotFoundError)
        what = "there is no such file" if absent else f"the file cannot be read ({os_error_reason(error)})"
        if isinstance(error, ValueError):
            what, allowed = "the path contains a null character", "a path without null characters"
        hint = f"`ls {path.parent}` lists names" if os.path.isdir(path.parent) else f"there is no folder {path.parent}"
        hint = (absent and nearest_file_question(path)) or f"correct the path: {hint}"
        raise DataError(what, where=str(path), allowed=allowed, hint=hint) from None
    if not readable:
        hint = f"allow reading by `chmod u+r {path}`, or copy the file to a folder of your own"
        raise DataError("the file cannot be read (Permission denied)", where=str(path), allowed=allowed, hint=hint)
    if not stat.S_ISREG(info.st_mode):
        noun = "folder" if stat.S_ISDIR(info.st_mode) else "pipe or a device"
        hint = f"use the path of a file, such as {path / 'NAME'}" if path.is_dir() else "copy its output into a file"
        raise DataError(f"this is a {noun}, but must be a file", where=str(path), allowed=allowed, hint=hint)
    if max_bytes is not None and info.st_size > max_bytes:
        most = f"{max_bytes / 2**20:.3g} MiB"
        what, hint = f"the file has {info.st_size / 2**20:.3g} MiB, more than {most}", "give another or a smaller file"
        raise DataError(what, where=str(path), allowed=f"at most {most}", hint=hint)
    return path


@contextlib.contextmanager
def limit_process_memory() -> Iterator[None]:
    """Limit the additional memory of this process to 1.75 GiB inside a `with` block (on Linux only).

    A library that needs more memory to unpack an input file gets a MemoryError. An existing limit stays unchanged.
    """
    before = None
    with contextlib.suppress(ImportError, OSError):
        import resource

        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        if soft == resource.RLIM_INFINITY:  # else there is an outer one, or the user's own
            held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (held + _MEMORY_OF_READING, hard))
            before = soft, hard
    try:
        yield
    finally:
        if before is not None:
            resource.setrlimit(resource.RLIMIT_AS, before)


def check_not_too_many_numbers(count: int, where: str) -> None:
    """Raise `DataError` if an input file contains or declares more than `MAX_INPUT_NUMBERS` numbers."""
    if count > MAX_INPUT_NUMBERS:
        allowed = f"at most {MAX_INPUT_NUMBERS / 1e6:.0f} million numbers"
        hint = "cut it into several shorter recordings"
        raise DataError("the file holds too many numbers", where=where, allowed=allowed, hint=hint)


def read_input_text(path: Path, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Read an input file as text. Raises the errors of `check_input_file`, and `DataError` if it is not UTF-8."""
    check_input_file(path, max_bytes)
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = os_error_reason(error) if isinstance(error, OSError) else "it is not UTF-8 text"
        hint = "copy it again from its source" if isinstance(error, OSError) else "save it again as UTF-8 text"
        what, allowed = f"the file cannot be read ({reason})", "readable text in UTF-8"
        raise DataError(what, where=str(path), allowed=allowed, hint=hint) from None


def read_input_json(path: Path) -> Any:
    """Read a JSON input file. Raises the errors of `read_input_text`, and `DataError` if it is not valid JSON."""
    text = read_input_text(path)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        what, hint = f"the file is not valid JSON ({error})", "correct this place, or copy the file from its source"
        raise DataError(what, where=str(path), allowed="a JSON file", hint=hint) from None


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Write a file completely or not at all, in a `with` block. The yielded temporary file replaces `path` on success.

    Raises `OutputError` if the folder is missing or the file cannot be written.
    """
    if path.is_dir() or not path.parent.is_dir():
        what, allowed = "the folder to write to does not exist", "a file in an existing folder"
        hint = f"create the folder by `mkdir -p {path.parent}`, or correct the path"
        if path.is_dir():
            what, allowed, hint = "this path is a folder", "the name of a file", f"use {path / 'NAME'}{path.suffix}"
        raise OutputError(what, where=str(path), allowed=allowed, hint=hint)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except (OSError, RuntimeError) as error:
        what = f"the file cannot be written ({os_error_reason(error)})"
        raise OutputError(what, where=str(path), hint="free disk space, or write to another folder") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file atomically. Raises the errors of `atomic_write`."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_strict_json(path: Path, data: Any) -> None:
    """Write plain data as JSON atomically. Raises ValueError for infinity and NaN, and the errors of `atomic_write`."""
    write_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n")


def make_folder(folder: str | os.PathLike[str], what: str = "the folder") -> Path:
    """Create a folder and its missing parents, and return its path. Raises `OutputError`, which calls it `what`."""
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise folder_error(error, path, f"{what} cannot be made", "choose a writable folder") from error
    return path


def folder_error(error: Exception, folder: Path, what: str, hint: str = "choose a writable --out") -> OutputError:
    """Make an `OutputError` with the reason why a folder cannot be used, such as a file in its path."""
    if (file := next((path for path in (folder, *folder.parents) if is_file(path)), None)) is not None:
        what, hint = f"{what}, because {file} is a file", f"{hint}, or rename {file.name}"
        return OutputError(what, where=str(folder), allowed="a path of folders, without a file among them", hint=hint)
    return OutputError(f"{what}: {os_error_reason(error)}", where=str(folder), hint=hint)


def is_file(path: Path) -> bool:
    """Check whether the path is an existing file. For a name that is too long or invalid, return False."""
    return os.path.isfile(path)


def file_sha256(path: Path) -> str:
    """Compute the SHA-256 (hexadecimal) of a file or all files in a folder. Raises `DataError` if one is unreadable."""
    digest = hashlib.sha256()
    for entry in sorted(item for item in path.rglob("*") if item.is_file()) if path.is_dir() else [path]:
        with check_input_file(entry).open("rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def json_sha256(data: Any) -> str:
    """Compute the SHA-256 of plain data as JSON, 64 hexadecimal digits. The order of keys has no influence."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def to_json_types(value: Any, notes: list[str] | None = None, path: str = "") -> Any:
    """Convert a value to JSON types. A number that is not finite becomes None, and its path is added to `notes`."""
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


def to_lossless_plain_data(value: Any) -> Any:
    """Convert nested dataclasses, containers and arrays to JSON data without loss. NaN and infinities become text."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {entry.name: to_lossless_plain_data(getattr(value, entry.name)) for entry in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return {"shape": list(value.shape), "values": to_lossless_plain_data(value.ravel().tolist())}
    if isinstance(value, Mapping):
        return {str(key): to_lossless_plain_data(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_lossless_plain_data(entry) for entry in value]
    if isinstance(value, np.generic):
        value = value.item()
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def attributes_to_dict(value: Any, names: str) -> dict[str, Any]:
    """Return attributes of `value` as a dictionary. `names` are separated by blanks. `key=name` stores one as `key`."""
    return {key: getattr(value, name or key) for key, _, name in [name.partition("=") for name in names.split()]}


def dataclass_from_plain_data(kind: type[_DataclassType], data: Mapping[str, Any]) -> _DataclassType:
    """Restore a dataclass instance from data that `to_lossless_plain_data` returned."""
    hints = _type_hints(typing.cast(typing.Hashable, kind))
    return kind(**{name: _value(hint, data[name]) for name, hint in hints.items() if name in data})


_type_hints = cache(typing.get_type_hints)


def _value(hint: Any, value: Any) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return None if value is None else _value(next(own for own in arguments if own is not type(None)), value)
    if origin is np.ndarray:
        return np.array(value["values"], dtype=typing.get_args(arguments[1])[0]).reshape(value["shape"])
    if origin is tuple:
        inner = [arguments[0]] * len(value) if arguments[-1] is Ellipsis else arguments
        return tuple(_value(entry, item) for entry, item in zip(inner, value, strict=True))
    if origin in (dict, Mapping):
        return {key: _value(arguments[1], entry) for key, entry in value.items()}
    if dataclasses.is_dataclass(hint):
        return dataclass_from_plain_data(typing.cast(type, hint), value)
    return float(value) if hint is float else value


def os_error_reason(error: Exception) -> str:
    """Return the reason for an operating system or HDF5 error as text."""
    if isinstance(error, NotADirectoryError):
        return "a part of its path is a file, not a folder"
    number = getattr(error, "errno", None)
    return os.strerror(number) if number else str(error).strip("'\"")

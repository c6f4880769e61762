"""Atomic file writing, hashes of files and data, conversion to JSON and back."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import os
import secrets
import types
import typing
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from yid_ocp.errors import DataError, OutputError

_DataclassType = TypeVar("_DataclassType")


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


def make_folder(folder: str | os.PathLike[str], what: str = "the folder") -> Path:
    """Make a folder and those above it where they are absent; OutputError where that is refused."""
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{what} cannot be made ({os_error_reason(error)})", where=str(path)) from error
    return path


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


def to_lossless_plain_data(value: Any) -> Any:
    """Nested dataclasses, containers and arrays as JSON data without loss; NaN and infinities become text.

    JSON has no infinities: what is not finite becomes text.
    """
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


def attributes_to_json(value: Any, names: str) -> dict[str, Any]:
    """Some attributes of an object as JSON data, by name or as `key=name`, separated by blanks."""
    pairs = [name.partition("=") for name in names.split()]
    return {key: json_with_nonfinite_as_none(getattr(value, name or key)) for key, _, name in pairs}


def json_with_nonfinite_as_none(value: Any) -> Any:
    """Numbers, texts and their containers as JSON data; NaN and infinities become None."""
    if isinstance(value, Mapping):
        return {key: json_with_nonfinite_as_none(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_with_nonfinite_as_none(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def dataclass_from_plain_data(kind: type[_DataclassType], data: Mapping[str, Any]) -> _DataclassType:
    """Dataclass instance restored from the data that `to_lossless_plain_data` returned."""
    return kind(**{name: _value(hint, data[name]) for name, hint in _hints(typing.cast(typing.Hashable, kind)).items()})


@cache
def _hints(kind: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(kind)
    return {entry.name: hints[entry.name] for entry in dataclasses.fields(kind)}


def _value(hint: Any, value: Any) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None:
            return None
        return _value(next(entry for entry in arguments if entry is not type(None)), value)
    if origin is np.ndarray:
        kind = typing.get_args(arguments[1])[0]
        return np.array(value["values"], dtype=kind).reshape(value["shape"])
    if origin is tuple:
        inner = [arguments[0]] * len(value) if arguments[-1] is Ellipsis else arguments
        return tuple(_value(entry, item) for entry, item in zip(inner, value, strict=True))
    if origin in (dict, Mapping):
        return {key: _value(arguments[1], entry) for key, entry in value.items()}
    if dataclasses.is_dataclass(hint):
        return dataclass_from_plain_data(typing.cast(type, hint), value)
    return float(value) if hint is float else value


def os_error_reason(error: Exception) -> str:
    """Reason of an error of the operating system or HDF5, in words."""
    number = getattr(error, "errno", None)
    return os.strerror(number) if number else str(error).strip("'\"")

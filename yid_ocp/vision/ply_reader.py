"""Points of a PLY file, read without a library in C: damage must not end the process.

Format: Turk (1994), The PLY polygon file format, Stanford University.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from yid_ocp.errors import DataError

Array = NDArray[np.float64]

_HEAD = 100_000
"""A longer head is none [bytes]."""
_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2"},
    **{"uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_AXIS_PROPERTIES, _COLOUR_PROPERTIES = ("x", "y", "z"), ("red", "green", "blue")
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class _Element:
    """A table of a PLY file: its name, its number of rows, its columns with NumPy's names of their types."""

    name: str
    count: int
    columns: tuple[tuple[str, str], ...]


def read_ply_points(path: Path) -> Array:
    """Positions of the vertices, shape (N, 3), in the file's unit; other properties and later elements are left out.

    Parameters
    ----------
    path : Path

    Raises
    ------
    DataError
        No PLY file, a damaged one, or one whose vertices have no x, y and z.
    """
    return _columns(path, _AXIS_PROPERTIES)


def read_ply_colours(path: Path) -> NDArray[np.uint8] | None:
    """Red, green and blue of the vertices, shape (N, 3), None where they have none; errors as `read_ply_points`."""
    colours = _columns(path, _COLOUR_PROPERTIES)
    return colours.astype(np.uint8) if colours.shape[1] else None


def _columns(path: Path, wanted: Sequence[str]) -> Array:
    """Columns of the vertices, shape (N, number of them), or (N, 0) where the file does not have all of them."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"the cloud cannot be read ({error.strerror})", where=str(path)) from error
    head, end, body = data.partition(b"end_header")
    line, _, body = body.partition(b"\n")
    if not end or len(head) > _HEAD or line.strip() or not head.startswith(b"ply"):
        raise _damaged(path, "it has no head")
    order, elements = _head(path, head.decode("latin-1"))
    for element in elements:
        if element.name == "vertex":
            return _vertices(path, element, order, body, wanted)
        body = _rest(path, element, order, body)
    raise _damaged(path, "it has no vertices")


def _damaged(path: Path, why: str) -> DataError:
    return DataError(f"the cloud is empty or cannot be read: {why}", where=str(path), hint="copy or record it again")


def _head(path: Path, text: str) -> tuple[str, list[_Element]]:
    """Byte order (empty for ASCII), and the elements in the order of the file."""
    order: str | None = None
    found: list[_Element] = []
    for line in text.splitlines()[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, _] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) <= 18:
                found.append(_Element(name, int(count), ()))
            case ["property", "list", _, _, name] if found:
                found[-1] = _Element(found[-1].name, found[-1].count, (*found[-1].columns, (name, "")))
            case ["property", kind, name] if found and kind in _TYPES:
                found[-1] = _Element(found[-1].name, found[-1].count, (*found[-1].columns, (name, _TYPES[kind])))
            case _:
                raise _damaged(path, f"its head says {line[:60]!r}")
    if order is None:
        raise _damaged(path, "its head does not say the format")
    return order, found


def _rest(path: Path, element: _Element, order: str, body: bytes) -> bytes:
    """What follows an element; in a list's rows there is no telling how far they go."""
    if any(not kind for _, kind in element.columns):
        raise _damaged(path, f"lists of '{element.name}' stand before the vertices")
    if order:
        return body[element.count * sum(np.dtype(kind).itemsize for _, kind in element.columns) :]
    return b"\n".join(body.split(b"\n")[min(element.count, len(body)) :])


def _vertices(path: Path, element: _Element, order: str, body: bytes, wanted: Sequence[str]) -> Array:
    names = [name for name, _ in element.columns]
    kinds = [kind for _, kind in element.columns]
    if len(set(names)) < len(names) or not set(_AXIS_PROPERTIES) <= set(names) or "" in kinds:
        raise _damaged(path, "its vertices have no x, y and z, or lists")
    size = sum(np.dtype(kind).itemsize for kind in kinds) if order else 2 * len(names)
    if element.count * size > len(body) + (not order):  # the last line of a text may end without a newline
        raise DataError(
            f"the cloud is damaged: it declares {element.count:.3g} points in {len(body)} bytes",
            where=str(path),
            hint="copy or record it again",
        )
    if not element.count:
        raise _damaged(path, "it has no vertices")
    if not set(wanted) <= set(names):
        return np.empty((element.count, 0))
    if order:
        rows = np.frombuffer(body, [(n, order + k) for n, k in element.columns], element.count)
        return np.stack([rows[name].astype(np.float64) for name in wanted], axis=1)
    try:
        lines = [line.split() for line in body.split(b"\n", element.count)[: element.count]]
        values = np.array([[float(row[names.index(name)]) for name in wanted] for row in lines])
    except (ValueError, IndexError) as error:
        raise _damaged(path, f"a vertex is not what its head says ({error})") from error
    if len(values) < element.count:
        raise _damaged(path, "vertices are missing")
    return values

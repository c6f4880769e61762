"""Tables of text (CSV): one header row, one row per time."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.data.readers.base import READERS
from yid_ocp.data.recording import (
    JOINT_CHANNELS,
    Array,
    Clock,
    JointGroup,
    PointGroup,
    Recording,
    validate,
)
from yid_ocp.errors import DataError, nearest
from yid_ocp.files import file_sha256

_TO_SI: Mapping[str, Mapping[str, float]] = {
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "rad": {"rad": 1.0, "deg": math.pi / 180},
    "rad/s": {"rad/s": 1.0, "deg/s": math.pi / 180, "rpm": 2 * math.pi / 60},
    "N m": {"N m": 1.0, "N mm": 1e-3, "mN m": 1e-3},
}
_QUANTITIES: Mapping[str, str] = {"t": "s", **JOINT_CHANNELS, "points": "m"}
_PREFIXES = {"q_": "position", **{f"{channel}_": channel for channel in JOINT_CHANNELS}}
_AXES = ("x", "y", "z")


@READERS.register(".csv")
def read_csv(
    path: str | os.PathLike[str],
    *,
    columns: Mapping[str, str | Sequence[str] | None] | None = None,
    units: Mapping[str, str] | None = None,
    clock: Clock = "recorded",
    sensor: str = "unknown",
    frame: str = "world",
    delimiter: str = ",",
    description: str = "",
) -> Recording:
    """Read a table with one header row and one row per time.

    Columns are understood by their names: `t` or `time`; a channel and a joint, `q_<joint>`, `position_<joint>`,
    `velocity_<joint>`, `effort_<joint>` and so on; else a point and an axis, `<point>_x`, `<point>_y`, `<point>_z`. An
    empty cell is NaN. Where a table has joints and points, a row in which all cells of one of them are empty is a time
    at which only the other was measured.

    Parameters
    ----------
    path : path-like
        The table.
    columns : mapping, optional
        Column to its meaning, where its name does not say: `"t"`, (channel, joint), (axis, point), or None to leave
        it out.
    units : mapping, optional
        Unit of `t`, of a joint channel or of `points`, where it is not SI: s, ms, us, ns; rad, deg; rad/s, deg/s, rpm;
        N m, N mm, mN m; m, cm, mm. Converted here and nowhere else.
    clock : {'recorded', 'nominal'}
        Whether the times were measured.
    sensor, frame : str
        What saw the points, and their frame of reference.
    delimiter : str
        One character between cells.
    description : str
        What was recorded.

    Returns
    -------
    Recording
        The checked recording, in SI units, its points in one group called `points`.

    Raises
    ------
    DataError
        If the file, a column, a cell, an option or a unit cannot be understood, or as `validate`.
    """
    path = Path(path)
    digest = file_sha256(path)
    factors = _factors(units or {}, str(path))
    meanings, table = _read_table(path, delimiter, columns or {})
    t = factors["t"] * table[:, meanings.index(("t", ""))]
    joint_names, channels = _joint_columns(meanings, table, str(path))
    point_names, position = _point_columns(meanings, table, str(path))
    joint_rows = point_rows = np.arange(len(t))
    if joint_names and point_names:
        joint_rows = np.flatnonzero(~np.isnan(np.hstack(list(channels.values()))).all(axis=1))
        point_rows = np.flatnonzero(~np.isnan(position).all(axis=(1, 2)))
    joints, points = None, []
    if joint_names:
        si: dict[str, Any] = {name: factors[name] * values[joint_rows] for name, values in channels.items()}
        joints = JointGroup(joint_names, t[joint_rows], clock=clock, **si)
    if point_names:
        seen = factors["points"] * position[point_rows]
        points = [PointGroup("points", point_names, t[point_rows], seen, None, sensor, frame, None, clock)]
    return validate(Recording(joints, tuple(points), description, path.name, path.stem, digest))


def _factors(units: Mapping[str, str], where: str) -> dict[str, float]:
    factors = dict.fromkeys(_QUANTITIES, 1.0)
    for quantity, unit in units.items():
        if quantity not in _QUANTITIES:
            raise DataError(
                f"a unit is given for '{quantity}', which is no quantity",
                where=where,
                allowed=", ".join(_QUANTITIES),
                hint=nearest(quantity, _QUANTITIES),
            )
        known = _TO_SI[_QUANTITIES[quantity]]
        if unit not in known:
            what = f"'{unit}' is not a unit of '{quantity}'"
            raise DataError(what, where=where, allowed=", ".join(known), hint=nearest(unit, known))
        factors[quantity] = known[unit]
    return factors


def _read_table(
    path: Path, delimiter: str, columns: Mapping[str, str | Sequence[str] | None]
) -> tuple[list[tuple[str, str]], Array]:
    """Read the columns that mean something: their meanings and the table, shape (rows, columns), in its own units."""
    if len(delimiter) != 1:
        raise DataError(f"the delimiter is {delimiter!r}", where=str(path), allowed="one character")
    rows: list[list[float]] = []
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = csv.reader(file, delimiter=delimiter, skipinitialspace=True)
            header = [cell.strip() for cell in next(lines, [])]
            _check_header(header, path, delimiter)
            meanings = _meanings(header, columns, f"{path}, line 1")
            for cells in lines:
                if cells:
                    rows.append(_numbers(cells, header, meanings, f"{path}, line {lines.line_num}"))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        what = f"the file is not a table of text ({error})"
        raise DataError(what, where=str(path), allowed="CSV with one header row, in UTF-8") from error
    if not rows:
        raise DataError("the table has no rows", where=str(path), allowed="one header row, then one row per time")
    return [meaning for meaning in meanings if meaning], np.array(rows)


def _check_header(header: Sequence[str], path: Path, delimiter: str) -> None:
    allowed = "one header row with names such as t, q_<joint>, effort_<joint>, <point>_x"
    if not any(header):
        raise DataError("the table is empty", where=str(path), allowed=allowed)
    if all(_is_number(cell) for cell in header):
        raise DataError("the table has no header row", where=f"{path}, line 1", allowed=allowed)
    if len(header) == 1:
        others = [repr(mark) for mark in ";\t, " if mark in header[0] and mark != delimiter]
        hint = f"set delimiter={others[0]}" if others else ""
        raise DataError(f"the table has one column, '{header[0]}'", where=str(path), allowed=allowed, hint=hint)
    repeated = [name for name in header if header.count(name) > 1]
    if repeated:
        raise DataError(f"two columns are called '{repeated[0]}'", where=f"{path}, line 1")


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _numbers(
    cells: Sequence[str], header: Sequence[str], meanings: Sequence[tuple[str, str] | None], where: str
) -> list[float]:
    if len(cells) != len(header):
        raise DataError(f"the row has {len(cells)} cells", where=where, allowed=f"{len(header)} cells, as the header")
    numbers = []
    for cell, name, meaning in zip(cells, header, meanings, strict=True):
        if meaning:
            try:
                numbers.append(float(cell) if cell.strip() else math.nan)
            except ValueError as error:
                allowed = "a number with a decimal point, or nothing where there was no measurement"
                raise DataError(f"column '{name}' holds '{cell}'", where=where, allowed=allowed) from error
    return numbers


def _meanings(
    header: Sequence[str], columns: Mapping[str, str | Sequence[str] | None], where: str
) -> list[tuple[str, str] | None]:
    """Say for each column: ("t", ""), (channel, joint), (axis, point), or None for one to leave out."""
    for name in columns:
        if name not in header:
            what = f"there is no column '{name}'"
            raise DataError(what, where=where, allowed=", ".join(header), hint=nearest(name, header))
    meanings: list[tuple[str, str] | None] = []
    for name in header:
        meaning = _given_meaning(name, columns[name], where) if name in columns else _conventional_meaning(name)
        if meaning is None and name not in columns:
            raise DataError(
                f"the meaning of column '{name}' is not known",
                where=where,
                allowed="t, "
                + ", ".join(f"{prefix}<joint>" for prefix in _PREFIXES)
                + ", <point>_x, <point>_y, <point>_z",
                hint=f"rename it, or set columns={{'{name}': ('position', 'joint')}}, or None to leave it out",
            )
        if meaning and meaning in meanings:
            other = header[meanings.index(meaning)]
            raise DataError(f"columns '{other}' and '{name}' mean the same, {' '.join(meaning).strip()}", where=where)
        meanings.append(meaning)
    if ("t", "") not in meanings:
        raise DataError(
            "the table has no column of times", where=where, allowed="t or time", hint="columns={'...': 't'}"
        )
    return meanings


def _conventional_meaning(column: str) -> tuple[str, str] | None:
    if column in ("t", "time"):
        return "t", ""
    for prefix in sorted(_PREFIXES, key=len, reverse=True):
        if column.startswith(prefix) and column != prefix:
            return _PREFIXES[prefix], column.removeprefix(prefix)
    point, _, axis = column.rpartition("_")
    return (axis, point) if point and axis in _AXES else None


def _given_meaning(column: str, given: str | Sequence[str] | None, where: str) -> tuple[str, str] | None:
    if given is None:
        return None
    words = (given, "") if isinstance(given, str) else tuple(given)
    if words == ("t", ""):
        return "t", ""
    known = (*JOINT_CHANNELS, *_AXES)
    if len(words) != 2 or not words[1] or words[0] not in known:
        raise DataError(
            f"column '{column}' is given the meaning {given!r}",
            where=where,
            allowed=f"'t', or a pair of one of {', '.join(known)} and the name of the joint or point, or None",
            hint=nearest(str(words[0]), known) if words and words[0] not in known else "",
        )
    return str(words[0]), str(words[1])


def _joint_columns(
    meanings: Sequence[tuple[str, str]], table: Array, where: str
) -> tuple[tuple[str, ...], dict[str, Array]]:
    found = [meaning for meaning in meanings if meaning[0] in JOINT_CHANNELS]
    names = tuple(dict.fromkeys(joint for _, joint in found))
    used = dict.fromkeys(["position", *(channel for channel, _ in found)]) if found else {}
    return names, {channel: _gather(meanings, table, [(channel, name) for name in names], where) for channel in used}


def _point_columns(meanings: Sequence[tuple[str, str]], table: Array, where: str) -> tuple[tuple[str, ...], Array]:
    names = tuple(dict.fromkeys(point for axis, point in meanings if axis in _AXES))
    wanted = [(axis, name) for name in names for axis in _AXES]
    return names, _gather(meanings, table, wanted, where).reshape(len(table), len(names), 3)


def _gather(meanings: Sequence[tuple[str, str]], table: Array, wanted: Sequence[tuple[str, str]], where: str) -> Array:
    for meaning in wanted:
        if meaning not in meanings:
            what = f"there is no column for {meaning[0]} of '{meaning[1]}'"
            allowed = "every channel for all joints, position always; x, y and z of every point"
            raise DataError(what, where=where, allowed=allowed)
    return table[:, [meanings.index(meaning) for meaning in wanted]]

"""Tables of text that motion capture exports: Motive (OptiTrack) and Nexus (Vicon) as CSV, QTM (Qualisys) as TSV."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.data.recording import PointGroup
from yid_ocp.errors import DataError

_Rows = Iterable[tuple[int, list[str]]]
_VICON_SECTIONS = ("Trajectories", "Devices", "Model Outputs", "Joints", "Segments")
_UNITS = {"mm": "mm", "millimeters": "mm", "cm": "cm", "centimeters": "cm", "m": "m", "meters": "m"}
_ALLOWED = "an export with its header as the program writes it"


_MocapTable = tuple[PointGroup, str, tuple[str, ...]]
"""Points of a motion capture export in its own unit, that unit (mm, cm or m), and what a user should know."""


def mocap_table_reader(first_row: Sequence[str]) -> Callable[[_Rows, str], _MocapTable] | None:
    """Function that reads a motion capture export from its rows, by its first row; None where the table is none."""
    first = first_row[0].strip() if first_row else ""
    if first == "Format Version":
        return _read_motive
    if first == "NO_OF_FRAMES":
        return _read_qualisys
    return _read_vicon if first in _VICON_SECTIONS else None


def _read_motive(rows: _Rows, where: str) -> _MocapTable:
    """Positions of rigid bodies and markers; rotations and errors of fits are left out."""
    head: list[list[str]] = []
    body: list[list[str]] = []
    for _, cells in rows:
        (body if head and head[-1][:1] == ["Frame"] else head).append([cell.strip() for cell in cells])
    said = dict(zip(head[0][::2], head[0][1::2], strict=False))
    by_label = {(row[1] if len(row) > 1 else ""): row for row in head[1:]}
    axes, kinds, names = head[-1], by_label.get("Type", []), by_label.get("Name", [])
    quantities = next((row for row in head[1:-1] if "Position" in row), [])
    if axes[:1] != ["Frame"] or not (kinds and names and quantities):
        raise _broken(where, "rows Type, Name, Rotation or Position, then Frame, Time (Seconds)")
    columns: dict[str, range] = {}
    for i in range(2, len(axes) - 2):
        if quantities[i : i + 3] == ["Position"] * 3 and axes[i : i + 3] == ["X", "Y", "Z"] and names[i]:
            columns.setdefault(names[i], range(i, i + 3))
    table = _numbers(body, len(axes), where)
    unit = _UNITS.get(said.get("Length Units", "Meters").lower(), "m")
    notes = [
        "Motive's y axis points up unless the export said otherwise: `pose` or model.frames turn it to the robot's z"
    ]
    if len({names[i] for i in range(2, min(len(names), len(axes)))} - {""}) > len(columns):
        notes.append("what has no position was left out")
    return _made(table[:, 1], columns, table, unit, "OptiTrack", notes, where)


def _read_vicon(rows: _Rows, where: str) -> _MocapTable:
    """Markers of the section `Trajectories`."""
    lines = [[cell.strip() for cell in cells] for _, cells in rows]
    begin = next((i for i, cells in enumerate(lines) if cells[:1] == ["Trajectories"]), None)
    if begin is None or len(lines) < begin + 6:
        raise _broken(where, "a section Trajectories with rate, names, Frame, Sub Frame, X, Y, Z and units")
    rate, named, axes, units, *body = lines[begin + 1 :]
    end = next((i for i, cells in enumerate(body) if cells[0] in _VICON_SECTIONS or not any(cells)), len(body))
    table = _numbers(body[:end], len(axes), where)
    columns: dict[str, range] = {}
    for i, name in enumerate(named):
        if name and [axis.upper() for axis in axes[i : i + 3]] == ["X", "Y", "Z"]:
            columns[name] = range(i, i + 3)
    short = {name.rpartition(":")[2]: at for name, at in columns.items()}
    columns = short if len(short) == len(columns) else columns
    unit = _UNITS.get(next((cell for cell in units if cell), "mm").lower(), "mm")
    try:
        frequency = float(rate[0])
    except ValueError as error:
        raise _broken(where, "the rate in Hz in the line below Trajectories") from error
    return _made((table[:, 0] - table[0, 0]) / frequency, columns, table, unit, "Vicon", [], where)


def _read_qualisys(rows: _Rows, where: str) -> _MocapTable:
    """Markers; three zeros stand for one that was not seen."""
    said: dict[str, list[str]] = {}
    body: list[list[str]] = []
    head: list[str] = []
    for _, cells in rows:
        row = [cell.strip() for cell in cells]
        if not body and row[0] and not _is_number(row[0]):
            said.setdefault(row[0], row[1:])
            head = row if row[0] == "Frame" else head
        else:
            body.append(row)
    names = [name for name in said.get("MARKER_NAMES", []) if name]
    first = 2 if head else 0  # frame and time
    table = _numbers(body, max(map(len, body), default=0), where)
    try:
        frequency = float(said["FREQUENCY"][0])
    except (KeyError, IndexError, ValueError) as error:
        raise _broken(where, "FREQUENCY and MARKER_NAMES in the header") from error
    if not names or table.shape[1] < first + 3 * len(names):
        raise _broken(where, "MARKER_NAMES and three columns for each")
    columns = {name: range(first + 3 * i, first + 3 * i + 3) for i, name in enumerate(names)}
    for at in columns.values():
        own = table[:, at]
        table[np.ix_((own == 0).all(axis=1), list(at))] = math.nan
    t = table[:, 1] if head else np.arange(len(table)) / frequency
    return _made(t, columns, table, "mm", "Qualisys", [], where)


def _made(
    t: Array, columns: dict[str, range], table: Array, unit: str, program: str, notes: list[str], where: str
) -> _MocapTable:
    if not columns or not len(table):
        raise _broken(where, "markers or rigid bodies with positions")
    position = np.stack([table[:, list(at)] for at in columns.values()], axis=1)
    position[np.isnan(position).any(axis=2)] = math.nan
    group = PointGroup("points", tuple(columns), t, position, None, program, clock="nominal")
    return group, unit, (f"an export of {program}: {len(columns)} points in {unit}", *notes)


def _numbers(rows: Sequence[Sequence[str]], n_columns: int, where: str) -> Array:
    """Numbers of rows, NaN where a cell is empty or missing."""
    table = np.full((len(rows), n_columns), math.nan)
    for i, row in enumerate(rows):
        for j, cell in enumerate(row[:n_columns]):
            if cell and cell.upper() != "NULL":
                if not _is_number(cell):
                    raise _broken(f"{where}, row {i + 1} of the data", f"numbers in place of '{cell}'")
                table[i, j] = float(cell)
    return table


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _broken(where: str, allowed: str) -> DataError:
    what = "the motion capture export cannot be understood"
    return DataError(what, where=where, allowed=f"{_ALLOWED}: {allowed}", hint="export it again with its header")

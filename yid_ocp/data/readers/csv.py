"""Reader of CSV tables with one row per time, with or without a header row."""

from __future__ import annotations

import csv
import math
import os
import re
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from yid_ocp.arrays import Array, IntArray
from yid_ocp.data.channel_checks import mean_sample_rate
from yid_ocp.data.foreign_formats import (
    AXES,
    COUNTER_WORDS,
    UNIT_BY_WORD,
    ColumnMeaning,
    column_meanings,
    select_mocap_table_reader,
)
from yid_ocp.data.readers import base
from yid_ocp.data.recording import (
    JOINT_CHANNEL_UNITS,
    JointGroup,
    PointGroup,
    Recording,
    SensorChannelGroup,
    TimestampKind,
    raise_data_error_unless,
)
from yid_ocp.display import count_with_noun
from yid_ocp.errors import DataError, nearest_name_question, unknown_name_error_arguments
from yid_ocp.files import check_input_file, check_not_too_many_numbers, file_sha256, os_error_reason
from yid_ocp.sensors import CHANNEL_KINDS

_VECTORS = [kind for kind in CHANNEL_KINDS.values() if kind.components and kind.group != "points"]
_COMPONENTS = tuple(f"{channel.quantity}_{axis}" for channel in _VECTORS for axis in channel.components)
"""Components of vectors measured by sensors on a link, such as `force_x`."""
_MOST_BAD = 0.5  # fraction of bad lines above which the table is refused
_MAX_COLUMNS, _MAX_LINE_LENGTH = 5000, 1 << 20  # columns; characters
_LINE_COST = 16  # overhead of a line, in cells
_TIME_STAMP = re.compile(r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d:\d\d(?:[.,]\d{1,9})?) ?(Z|[+-]\d\d:?\d\d)?")


@dataclass(frozen=True)
class _CsvOptions(base.JointPointAndUnitOptions):
    """Options of CSV files: meaning of columns, columns to keep, delimiter, header and clock.

    `column_meanings` maps names of columns that are not recognised to meanings: `t`, `channel:joint`,
    `axis:point`, or `skip`. A `*` in a name matches a text that replaces `*` in the meaning (`*_pos`: `position:*`).
    """

    column_meanings: Mapping[str, str] | None = None
    has_header: bool = True  # whether the first row has names; if not, columns are called `1`, `2` and so on
    skip_bad_lines: bool = False  # omit lines that are not rows of numbers, and count them in `notes`
    delimiter: str = ""  # one character between cells; empty: found in the first line
    timestamp_kind: TimestampKind = "recorded"  # whether the times were measured
    point_sensor_name: str = "unknown"  # sensor of the points
    point_frame: str = "world"  # reference frame of the points
    description: str = ""  # what was recorded


_DEFAULTS = _CsvOptions()


def _read_csv(path: str | os.PathLike[str], options: _CsvOptions = _DEFAULTS) -> Recording:
    """Read a recording from a CSV table with one row per time. Its points become one group `points`.

    docs/reference/import_formats.md has the names of columns and the forms of numbers. Exports of Motive, Nexus and QTM
    are recognised by their headers. The joints, the points or a sensor have no sample at a time if all their cells in
    this row are empty. Raises `DataError` if anything cannot be understood, or `validated_recording` refuses it.
    """
    path = Path(path)
    said = options.description, path.name, path.stem, file_sha256(path)
    if (capture := _mocap_table(path)) is not None:
        what = "--columns is given, but the file is a motion capture export, whose header gives the meanings"
        allowed, hint = "no --columns", "leave --columns out, and choose markers by --points MARKER=POINT"
        raise_data_error_unless(not options.column_meanings, what, str(path), allowed, hint)
        seen, unit, remarks = capture
        sensor = seen.sensor_name if options.point_sensor_name == "unknown" else options.point_sensor_name
        group = replace(seen, sensor_name=sensor, frame=options.point_frame)
        made, units = Recording(None, (group,), *said, notes=remarks), {"points": unit}
    else:
        meanings, units, table, notes = _read_table(path, options)
        raw = _raw(meanings, table, str(path), options)
        made = Recording(raw.joints, raw.points, *said, notes=notes, channel_groups=raw.channel_groups)
    return base.convert_to_si_and_validate(made, str(path), replace(options, units={**units, **(options.units or {})}))


def _mocap_table(path: Path) -> tuple[PointGroup, str, tuple[str, ...]] | None:
    delimiter = _delimiter(path)
    read = select_mocap_table_reader(next(_rows(path, delimiter), (1, []))[1])
    return None if read is None else read(_rows(path, delimiter), str(path))


def _delimiter(path: Path) -> str:
    """Delimiter of the first line with several cells; a comma if there is none."""
    _, first = next(_rows(path, ","), (1, []))
    if len(first) == 1:
        return next((mark for mark in "\t; " if mark in first[0].strip()), ",")
    line = ",".join(first)  # of numbers with decimal commas, if the table has no header
    return next((mark for mark in "\t;" if mark in line and all(map(_is_number, line.split(mark)))), ",")


def _raw(meanings: Sequence[tuple[str, str]], table: Array, where: str, options: _CsvOptions = _DEFAULTS) -> Recording:
    """Recording with the joints, points and other sensors of the table, in the units of the table."""
    t = table[:, meanings.index(("t", ""))]
    found = [meaning for meaning in meanings if meaning[0] in JOINT_CHANNEL_UNITS]
    joint_names = tuple(dict.fromkeys(joint for _, joint in found))
    used = dict.fromkeys(["position", *(channel for channel, _ in found)]) if found else {}
    channels = {name: _gather(meanings, table, [(name, joint) for joint in joint_names], where) for name in used}
    point_names = tuple(dict.fromkeys(point for axis, point in meanings if axis in AXES))
    wanted = [(axis, name) for name in point_names for axis in AXES]
    position = _gather(meanings, table, wanted, where).reshape(len(table), len(point_names), 3)
    mounted = _mounted_sensors(meanings, table, where)
    has_points_only = not joint_names and not mounted

    def measured(values: Sequence[Array]) -> IntArray:
        """Indices of the rows in which not all `values` are NaN; of all rows if the table has points only."""
        flat = np.hstack([entry.reshape(len(table), -1) for entry in values])
        return np.arange(len(t)) if has_points_only else np.flatnonzero(~np.isnan(flat).all(axis=1))

    joints, points, sensors = None, list[PointGroup](), list[SensorChannelGroup]()
    if joint_names:
        rows = measured(list(channels.values()))
        own: dict[str, Any] = {name: values[rows] for name, values in channels.items()}
        joints = JointGroup(joint_names, t[rows], clock=options.timestamp_kind, **own)
    if point_names:
        rows = measured([position])
        said = options.point_sensor_name, options.point_frame, None, options.timestamp_kind
        points.append(PointGroup("points", point_names, t[rows], position[rows], None, *said))
    for name, (names, parts) in mounted.items():
        rows = measured(list(parts.values()))
        kept = {quantity: values[rows] for quantity, values in parts.items()}
        sensors.append(SensorChannelGroup(name, names, t[rows], kept, clock=options.timestamp_kind))
    return Recording(joints, tuple(points), channel_groups=tuple(sensors))


def _mounted_sensors(
    meanings: Sequence[tuple[str, str]], table: Array, where: str
) -> dict[str, tuple[tuple[str, ...], dict[str, Array]]]:
    """For each recording group: the names of its sensors on links, and their values (M, k, components) by quantity."""
    found: dict[str, tuple[tuple[str, ...], dict[str, Array]]] = {}
    for channel in _VECTORS:
        parts = [f"{channel.quantity}_{axis}" for axis in channel.components]
        if not any(kind in parts for kind, _ in meanings):
            continue
        of_group = [f"{c.quantity}_{axis}" for c in _VECTORS if c.group == channel.group for axis in c.components]
        names = tuple(dict.fromkeys(name for kind, name in meanings if kind in of_group))
        values = _gather(meanings, table, [(part, name) for name in names for part in parts], where)
        held = found.setdefault(channel.group, (names, {}))[1]
        held[channel.quantity] = values.reshape(len(table), len(names), len(parts))
    return found


def _preview_csv(path: str | os.PathLike[str]) -> base.FilePreview:
    path = Path(path)
    if (capture := _mocap_table(path)) is not None:
        group, _, remarks = capture
        count, rate = np.isfinite(group.position).all(axis=2).sum(axis=0), mean_sample_rate(group.t)
        listed = zip(group.names, count, strict=True)
        kept = (base.TopicOrColumnSummary(name, "marker", int(n), rate, f"point {name}") for name, n in listed)
        return base.FilePreview(tuple(kept), {}, remarks)
    options, delimiter = dict[str, Any](), _delimiter(path)
    lines = _table_rows(path, delimiter)
    names = [cell.strip() for cell in next(lines, (1, []))[1]]
    head = next(lines, None)
    if len(names) < 2 or head is None:  # the error of reading such a file
        _read_table(path, _CsvOptions(delimiter=delimiter))
    n_lines, numbers, blank = 0, array("d"), bytearray()
    first_lines = [head] if head else []
    if all(_is_number(cell) for cell in names):
        options["has_header"] = False
        first_lines.insert(0, (1, names))
        names = [str(i + 1) for i in range(len(names))]
    for _, cells in chain(first_lines, lines):
        n_lines += 1
        if len(cells) == len(names):
            numbers.extend(map(_number, cells))
            blank.extend(cell.strip().lower() in ("", "nan") for cell in cells)
    if head and not numbers:  # every row has more or fewer cells: the error of reading the first one
        _numbers(head[1], names, [None] * len(names), set(), f"{path}, line {head[0]}")
    table = np.array(numbers).reshape(-1, len(names))
    is_blank = np.array(blank, bool).reshape(table.shape)  # a sensor that has no sample in this row
    numeric = np.isfinite(table).sum(axis=0) > _MOST_BAD * (~is_blank).sum(axis=0)
    hint = "set the character between its columns, such as --delimiter ';' (--preview shows the columns)"
    raise_data_error_unless(numeric.any(), "the table has no column of numbers", str(path), _ALLOWED, hint)
    text = ~np.isfinite(table) & ~is_blank
    bad = int(np.sum(text[:, numeric].any(axis=1))) + n_lines - len(table)
    if bad:
        options["skip_bad_lines"] = True
    meanings, own_units = column_meanings(names, _COMPONENTS)
    stated = [*dict.fromkeys(own for own in map(_quantity_and_unit, meanings, own_units) if own)]
    if "has_header" in options and len(table) > 1 and np.all(np.diff(table[:, 0]) > 0):
        meanings[0] = ("t", "")
    meanings = [m if m not in meanings[:i] else None for i, m in enumerate(meanings)]  # the first of two equal ones
    unclear = (name for name, meaning in zip(names, meanings, strict=True) if name and not meaning)
    unknown = dict.fromkeys(unclear, base.SKIP_COLUMN_KEYWORD)
    if "has_header" in options and meanings[0]:
        unknown = {names[0]: "t", **unknown}
    if unknown:
        options["column_meanings"] = unknown
    known = [(m, i) for i, m in enumerate(meanings) if m and numeric[i]]
    has_times = any(m == ("t", "") for m, _ in known)
    t = table[:, next((i for m, i in known if m == ("t", "")), 0)]
    notes = [f"{bad} of {n_lines} lines are not rows of numbers. --skip-bad-lines leaves them out"] if bad else []
    clean = table[np.isfinite(t)]
    try:
        units, why = base.guess_non_si_units(_raw([m for m, _ in known], clean[:, [i for _, i in known]], str(path)))
    except (DataError, ValueError):  # a channel that is not complete: its meaning has to be given first
        units, why = {}, ()
    notes += [f"the header states {quantity} in {unit}" for quantity, unit in stated]
    guessed = [own for own in zip(units.items(), why, strict=True) if own[0][0] not in dict(stated)]
    if guessed:
        options["units"] = dict(own for own, _ in guessed)
    sources, second = [], base.factor_to_si_by_quantity({**units, **dict(stated)}, str(path))["t"]
    for name, meaning, ok, column in zip(names, meanings, numeric, table.T, strict=True):
        kind, count = "numbers" if ok else "text", int(np.isfinite(column).sum())
        becomes = ":".join(filter(None, meaning or ()))
        rate = mean_sample_rate(second * t[np.isfinite(column + t)]) if ok and has_times else math.nan
        sources.append(base.TopicOrColumnSummary(name, kind, count, rate, becomes))
    return base.FilePreview(tuple(sources), options, (*notes, *(reason for _, reason in guessed)))


for _suffix in (".csv", ".tsv", ".txt"):
    base.READERS.register(_suffix)(_read_csv)
    base.FILE_PREVIEWERS.register(_suffix)(_preview_csv)

_ALLOWED = "one header row with names such as t, q_<joint>, effort_<joint>, <point>_x"
_OR_SKIP = ", or skip such lines with --skip-bad-lines"


def _rows(path: Path, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Line number and cells of every nonempty line."""
    what, hint = f"the delimiter is {delimiter!r}, but must be one character", "leave --delimiter out, to detect it"
    raise_data_error_unless(len(delimiter) == 1, what, str(path), "one character, such as ';' or $'\\t' (tab)", hint)
    try:
        with check_input_file(path).open(encoding="utf-8-sig", newline="") as file:
            lines = csv.reader(_limited_lines(file, path), delimiter=delimiter, skipinitialspace=True)
            count = 0
            for cells in lines:
                count += len(cells) + _LINE_COST
                check_not_too_many_numbers(count, str(path))
                if len(cells) > _MAX_COLUMNS:
                    what, hint = f"the table has {len(cells)} columns, more than {_MAX_COLUMNS}", "set --delimiter ';'"
                    raise DataError(what, where=str(path), allowed=f"at most {_MAX_COLUMNS} columns", hint=hint)
                # `sep=` tells Excel the delimiter
                if any(map(str.strip, cells)) and not cells[0].lstrip().startswith(("#", "sep=")):
                    yield lines.line_num, cells
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        what, hint = f"the file is not a table in UTF-8 text ({error})", "export the file again as CSV in UTF-8"
        if isinstance(error, OSError):
            what, hint = f"the file cannot be read ({os_error_reason(error)})", "copy it again from its source"
        raise DataError(what, where=str(path), allowed="CSV with one header row, in UTF-8", hint=hint) from error


def _table_rows(path: Path, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Rows of the table. If the second row has nothing but units, they are added to the names in the first row."""
    rows = _rows(path, delimiter)
    head, second = next(rows, None), next(rows, None)
    if head and second and len(head[1]) == len(second[1]):
        units = [cell.strip(" []()") for cell in second[1]]
        if all(not unit or unit.lower() in UNIT_BY_WORD for unit in units):
            names = [f"{name.strip()} [{unit}]" if unit else name for name, unit in zip(head[1], units, strict=True)]
            head, second = (head[0], names), None
    yield from filter(None, (head, second))
    yield from rows


def _limited_lines(file: TextIO, path: Path) -> Iterator[str]:
    """Lines of a file. Raises `DataError` for a line longer than the limit."""
    for number, line in enumerate(iter(lambda: file.readline(_MAX_LINE_LENGTH + 1), ""), start=1):
        if len(line) > _MAX_LINE_LENGTH:
            what, where = f"the line has more than {_MAX_LINE_LENGTH} characters", f"{path}, line {number}"
            hint = "export the measurements again as CSV"
            raise DataError(what, where=where, allowed="one row of numbers per line", hint=hint)
        yield line


def _read_table(
    path: Path, options: _CsvOptions
) -> tuple[list[tuple[str, str]], dict[str, str], Array, tuple[str, ...]]:
    """Meanings of the columns that have one, units in the header, values (rows, columns), and notes on bad lines."""
    lines = _table_rows(path, options.delimiter or _delimiter(path))
    number, first = next(lines, (1, []))
    names = [cell.strip() for cell in first]
    _check_header(names, path, options)
    numbers, bad, marks = array("d"), dict[int, str](), set[str]()
    columns = options.column_meanings or {}
    if not options.has_header:
        names = [str(i + 1) for i in range(len(first))]
        lines = chain([(number, first)], lines)
    elif [*columns] == [str(i + 1) for i in range(len(columns))]:  # meanings in the order of the columns
        superfluous = [*columns][len(names) :]  # are refused below
        columns = dict(zip([*names, *superfluous], columns.values(), strict=False))
    meanings, own_units = _meanings(names, columns, f"{path}, line {number}")
    units, scales = _units_and_scales([m for m in zip(meanings, own_units, strict=True) if m[0]], options, str(path))
    for line, cells in lines:
        try:
            numbers.extend(_numbers(cells, names, meanings, marks, f"{path}, line {line}"))
        except DataError as error:
            if not options.skip_bad_lines:
                raise
            bad[line] = error.what
    table = np.array(numbers).reshape(-1, len(scales)) * scales
    allowed, hint = "one header row, then one row per time", "export the measurements again, with their rows"
    raise_data_error_unless(len(table), "the table has no rows below its header", str(path), allowed, hint)
    n_lines = len(table) + len(bad)
    if len(bad) > _MOST_BAD * n_lines:
        at, why = next(iter(bad.items()))
        what = f"{len(bad)} of {n_lines} lines are not rows of {len(names)} numbers. In the first of them, {why}"
        where = f"{path}, line {at}" + (" and later lines" if len(bad) > 1 else "")
        hint = "leave a column of text out, as in --columns NAME=skip, or set the delimiter, as in --delimiter ';'"
        raise DataError(what, where=where, allowed=f"at most {_MOST_BAD:.0%} of the lines", hint=hint)
    notes: tuple[str, ...] = ()
    if bad:
        at, why = next(iter(bad.items()))
        said = f"{len(bad)} of {n_lines} lines are left out, because they are not rows of numbers"
        notes = (f"{said}. In line {at}, {why}",)
    return [meaning for meaning in meanings if meaning], units, table, notes


def _check_header(header: Sequence[str], path: Path, options: _CsvOptions) -> None:
    what, where = "the table is empty", f"{path}, line 1"
    raise_data_error_unless(any(header), what, str(path), _ALLOWED, "export the measurements again: it has no text")
    is_lost = options.has_header and all(_is_number(cell) for cell in header)
    hint = "add --no-header --columns t,position:JOINT,... with a meaning (or skip) for every column"
    raise_data_error_unless(not is_lost, "the table has no header row", where, _ALLOWED, hint)
    others = [repr(mark) for mark in ";\t, " if mark in header[0] and mark != options.delimiter]
    hint = f"set --delimiter {others[0]}" if others else "set the character between columns, such as --delimiter '|'"
    raise_data_error_unless(len(header) > 1, f"the table has one column, '{header[0]}'", str(path), _ALLOWED, hint)
    name, count = Counter(header).most_common(1)[0] if options.has_header else ("", 1)
    allowed, hint = "different names for all columns", f"rename one of them to '{name}_2' in the header"
    raise_data_error_unless(count == 1, f"{count} columns are called '{name}'", where, allowed, hint)


def _is_number(cell: str) -> bool:
    return math.isfinite(_number(cell)) or cell.strip().lower() in ("nan", "inf", "-inf")


def _number(cell: str) -> float:
    try:
        return _parsed_number(cell)
    except ValueError:
        return math.nan


def _parsed_number(cell: str) -> float:
    """Number with a decimal point or comma, or seconds since 1970 of a time stamp. Raises `ValueError`."""
    try:
        return float(cell)
    except ValueError:
        if (stamp := _TIME_STAMP.fullmatch(cell.strip())) is None:
            return float(cell.replace(",", ".", 1))
    date, clock, zone = stamp.groups()
    late = 0 if zone in (None, "Z") else int(f"{zone[0]}1") * (60 * int(zone[1:3]) + int(zone[-2:]))
    return float(np.datetime64(f"{date}T{clock.replace(',', '.')}", "ns").astype(float)) * 1e-9 - 60.0 * late


def _numbers(
    cells: Sequence[str], header: Sequence[str], meanings: Sequence[ColumnMeaning], marks: set[str], where: str
) -> list[float]:
    if len(cells) != len(header):
        what = f"the row has {count_with_noun(len(cells), 'cell')}, but the header has {len(header)}"
        allowed = "as many as the header"
        hint = f"correct the row{_OR_SKIP}"
        if len(cells) > len(header):
            hint += "; numbers with decimal commas need semicolons or tabs between the cells: export the table again"
        raise DataError(what, where=where, allowed=allowed, hint=hint)
    values = [cell for cell, meaning in zip(cells, meanings, strict=True) if meaning and meaning != ("t", "")]
    own = marks.union(mark for mark in ",." if any(mark in cell for cell in values))
    if len(own) > 1:
        what, allowed = "the table has numbers with commas and numbers with points", "decimal commas or decimal points"
        raise DataError(what, where=where, allowed=allowed, hint=f"export it without thousands separators{_OR_SKIP}")
    marks |= own
    numbers = []
    for cell, name, meaning in zip(cells, header, meanings, strict=True):
        if meaning:
            try:
                numbers.append(_parsed_number(cell) if cell.strip() else math.nan)
            except ValueError as error:
                allowed = "a number; empty cells if no joint, or the whole point or sensor, was measured at this time"
                allowed = "seconds, or a time stamp such as 2025-03-04T10:20:30.5Z" if meaning[0] == "t" else allowed
                what = f"the cell '{cell}' in column '{name}' is not a number"
                hint = f"correct the cell{_OR_SKIP}"
                hint += f", or leave the column out: --columns '{name}=skip'" if meaning[0] != "t" else ""
                raise DataError(what, where=where, allowed=allowed, hint=hint) from error
    return numbers


def column_pattern(key: str) -> re.Pattern[str]:
    """Return the pattern of the column names that a key of `column_meanings` selects."""
    return re.compile(re.escape(key).replace(r"\*", "(.*)"))


def _meanings(header: Sequence[str], columns: Mapping[str, str], where: str) -> tuple[list[ColumnMeaning], list[str]]:
    """Meaning of every column (None: left out), and the unit that its name states (empty: none)."""
    given: dict[str, str] = {}
    for key, meaning in sorted(columns.items(), key=lambda item: "*" not in item[0]):  # what is exact overrides
        found = {name: match for name in header if (match := column_pattern(key).fullmatch(name))}
        if not found:
            hint = "give COLUMN=MEANING for each column, or their meanings in order, such as t,position:JOINT,skip"
            said = unknown_name_error_arguments(key, header, hint)
            raise DataError(f"there is no column '{key}'", where=where, **said)
        given |= {name: meaning.replace("*", own.group(1)) if "*" in key else meaning for name, own in found.items()}
    meanings, meant = dict[str, ColumnMeaning](), dict[tuple[str, str], str]()
    by_name, units = column_meanings(header, _COMPONENTS)
    unknown = list[str]()
    for name, conventional in zip(header, by_name, strict=True):
        own = _given_meaning(name, given[name], where) if name in given else conventional
        if own is None and name and name not in given and name.lower() not in COUNTER_WORDS:
            unknown.append(name)
        if own and meant.setdefault(own, name) != name:
            what = f"columns '{meant[own]}' and '{name}' have the same meaning, {' '.join(own).strip()}"
            hint = f"leave one out (--columns {name}={base.SKIP_COLUMN_KEYWORD}), or name each: 'PREFIX_*=position:*'"
            raise DataError(what, where=where, allowed="one column for every meaning", hint=hint)
        meanings[name] = own
    if ("t", "") not in meant:
        what = f"the table has no column of times; its columns are {', '.join(header)}"
        hint = "name the column of times, as in --columns 'COLUMN=t', or add times to the file"
        raise DataError(what, where=where, allowed="a column named t or time, in seconds", hint=hint)
    if unknown:
        what = f"columns whose meaning is not known: {', '.join(unknown)}"
        pattern, meaning = re.sub(r"(?i).+(?=_current$)", "*", unknown[-1]), "position:JOINT"
        if "current" in pattern.lower():
            meaning = f"effort:{'*' if '*' in pattern else 'JOINT'}' --units effort=A --torque-constants '*=N_M_PER_A"
        hint = f"name each, as in --columns '{pattern}={meaning}' (or x:POINT, force_x:SENSOR), or '{unknown[-1]}=skip'"
        raise DataError(what, where=where, allowed=f"{_ALLOWED}, and a unit if it is not SI: q_elbow [deg]", hint=hint)
    return list(meanings.values()), units


def _quantity_and_unit(meaning: ColumnMeaning, unit: str) -> tuple[str, str] | None:
    """A column's quantity, in the words of `--units`, and its unit. None if it states none, or a sensor's SI unit."""
    if meaning is None or not unit or (meaning[0] in _COMPONENTS and unit in ("N", "N m", "rad/s")):
        return None
    return "points" if meaning[0] in AXES else meaning[0], unit


def _units_and_scales(
    columns: Sequence[tuple[ColumnMeaning, str]], options: _CsvOptions, where: str
) -> tuple[dict[str, str], list[float]]:
    """The first unit that a column of each quantity states, and the factor from every column's own unit to that one."""
    units, scales = dict[str, str](), list[float]()
    for meaning, unit in columns:
        stated = _quantity_and_unit(meaning, unit)
        scales.append(1.0)
        if stated and stated[0] not in (options.units or {}):
            first = units.setdefault(*stated)
            own, of_first = (base.factor_to_si_by_quantity({stated[0]: u}, where)[stated[0]] for u in (unit, first))
            scales[-1] = own / of_first
    return units, scales


def _given_meaning(column: str, given: str, where: str) -> ColumnMeaning:
    if given == base.SKIP_COLUMN_KEYWORD:
        return None
    if given == "t":
        return "t", ""
    kind, _, name = given.partition(":")
    known = (*JOINT_CHANNEL_UNITS, *AXES, *_COMPONENTS)
    if not name or kind not in known:
        what = f"the meaning '{given}' of column '{column}' is unknown"
        allowed = f"t, {base.SKIP_COLUMN_KEYWORD}, or KIND:NAME with the name of a joint, point or sensor and the "
        allowed += f"kind {', '.join((*JOINT_CHANNEL_UNITS, *AXES))} or a component such as {_COMPONENTS[0]}"
        meant = (kind, "NAME") if kind in known else column_meanings([given], _COMPONENTS)[0][0]  # `torque:elbow`
        hint = "" if meant else nearest_name_question(kind, ("t", base.SKIP_COLUMN_KEYWORD, *known))
        example = ":".join(meant or ("position", "JOINT")).strip(":")
        hint = hint or f"write for example --columns '{column}={example}'"
        raise DataError(what, where=where, allowed=allowed, hint=hint)
    return kind, name


def _gather(meanings: Sequence[tuple[str, str]], table: Array, wanted: Sequence[tuple[str, str]], where: str) -> Array:
    places = {meaning: i for i, meaning in enumerate(meanings)}
    for meaning in wanted:
        if meaning not in places:
            what, skip = f"the table has no column for {meaning[0]} of '{meaning[1]}'", base.SKIP_COLUMN_KEYWORD
            allowed, rest = "every channel for all joints, with their position", "same channel of other joints"
            if meaning[0][-1] in AXES:
                allowed, rest = "x, y and z for every point and sensor", "other axes"
            hint = f"add the column, or leave out the columns of the {rest}: --columns NAME={skip}"
            names = [name for _, name in meanings]  # a misspelt one has a single column
            lone = [name for name in names if names.count(name) == 1 and name != meaning[1]]
            raise DataError(what, where=where, allowed=allowed, hint=nearest_name_question(meaning[1], lone) or hint)
    return table[:, [places[meaning] for meaning in wanted]]

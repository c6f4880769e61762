"""Read and write recordings as HDF5 files (format `yid-recording/1`), with safe access to any HDF5 file.

The HDF5 library follows links into other files. It ends the process if the disk is full or a file is damaged in certain
ways, and this cannot be caught. A file is therefore built in memory before it is written, and first read by a fork.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import re
import select
import signal
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from yid_ocp import files
from yid_ocp.arrays import Array
from yid_ocp.data.recording import (
    JOINT_CHANNEL_UNITS,
    JOINT_NOISE_AND_SERVO_CONSTANT_NAMES,
    POINT_GROUP_NAME_PATTERN,
    JointGroup,
    PointGroup,
    Recording,
    SensorChannelGroup,
    raise_data_error_unless,
    read_only_copy,
    validated_recording,
)
from yid_ocp.errors import DataError, nearest_name_question, unknown_name_error_arguments
from yid_ocp.sensors import CHANNEL_KINDS
from yid_ocp.sensors.base import channel_specs_for_group_name

_RECORDING_FORMAT = "yid-recording/1"

_STRAIGHT = "straight"
_GAIN = "proportional_gain"
_JOINT_UNITS = {"t": "s", **JOINT_CHANNEL_UNITS}
_POINT_UNITS = {"t": "s", "position": "m", "std": "m"}
_JOINT_ATTRIBUTES = ("names", "clock", "effort_kind", *JOINT_NOISE_AND_SERVO_CONSTANT_NAMES)
_POINT_ATTRIBUTES = ("names", "sensor", "frame", "pose", "clock", "clock_offset_std", "std")


def read_recording(path: str | os.PathLike[str], *, allow_nan_effort: bool = False) -> Recording:
    """Read a recording from an HDF5 file (`yid-recording/1`) and check it. Efforts may be NaN with `allow_nan_effort`.

    Raises `DataError` if the file is missing, not HDF5, damaged or of another format, if a group, dataset, attribute or
    unit is unknown or missing, or if `validated_recording` refuses the recording.
    """
    path = Path(path)
    digest, allowed = files.file_sha256(path), f"HDF5 in the format {_RECORDING_FORMAT}"
    what, hint = "the file is not an HDF5 file", f"convert it by `yid-ocp import {path} --out RECORDING.h5`"
    if path.suffix == ".h5":
        hint = "give a file of another format its usual ending, such as .csv, and convert it by `yid-ocp import`"
    elif path.suffix == ".yaml":
        what, hint = "this is a configuration", f"give the run folder that `yid-ocp solve {path}` makes, or a recording"
    raise_data_error_unless(h5py.is_hdf5(path), what, str(path), allowed, hint)
    with open_hdf5_after_read_check(path) as file:
        recording = _from_file(file, path, digest)
    return validated_recording(recording, allow_nan_effort=allow_nan_effort, where=str(path))


def write_recording(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Check a recording, and write it atomically to an HDF5 file (`yid-recording/1`). Efforts may contain NaN.

    Raises `DataError` as in `validated_recording`, and `OutputError` if writing fails; an older file is then kept.
    """
    validated_recording(recording, allow_nan_effort=True)
    with create_hdf5_atomically(path) as file:
        file.attrs.update(format=_RECORDING_FORMAT, description=recording.description, source=recording.source)
        if recording.notes:
            file.attrs["notes"] = json.dumps(recording.notes)
        if recording.true_parameters:
            file.attrs["truth"] = json.dumps({key: float(value) for key, value in recording.true_parameters.items()})
        if recording.joints is not None:
            _write_group(file.create_group("joints"), vars(recording.joints), _JOINT_UNITS, _JOINT_ATTRIBUTES)
        for group in recording.points:
            attributes = [name for name in _POINT_ATTRIBUTES if name != "std"]
            content = {**vars(group), "sensor": group.sensor_name, "pose": group.camera_pose}
            _write_group(file.create_group(group.name), content, _POINT_UNITS, attributes)
        for channels in recording.channel_groups:
            units = {"t": "s"} | {c.quantity: c.unit for c in channel_specs_for_group_name(channels.name)}
            content, stds = {**vars(channels), **channels.values_by_quantity}, channels.noise_and_bias_stds_by_attribute
            _write_group(file.create_group(channels.name), {**content, **stds}, units, ("names", "clock", *stds))
        if recording.marker_reference_pose is not None:
            file.create_dataset(_STRAIGHT, data=recording.marker_reference_pose).attrs["unit"] = "m"


def _write_group(
    target: h5py.Group, content: Mapping[str, Any], units: Mapping[str, str], attributes: Iterable[str]
) -> None:
    for name, unit in units.items():
        if content.get(name) is not None:
            target.create_dataset(name, data=content[name]).attrs["unit"] = unit
    for name in attributes:
        if (own := content[name]) is not None:
            target.attrs[name] = np.array(own, dtype=h5py.string_dtype()) if name == "names" else own


def _from_file(file: h5py.File, path: Path, digest: str) -> Recording:
    origin = str(path)
    texts = {
        key: _text(file.attrs[key], f"{origin}, attribute {key}") if key in file.attrs else ""
        for key in ("format", "description", "source", "truth", "notes")
    }
    form, where = texts["format"], f"{origin}, attribute format"
    what = f"the format of the file is '{form}'" if form else "the file has no format"
    hint = "update yid_ocp if a newer version wrote the file; otherwise import the original data again"
    raise_data_error_unless(form == _RECORDING_FORMAT, what, where, _RECORDING_FORMAT, hint)
    joints, points, straight, channels, gain = None, [], None, [], {}
    if _GAIN in file.attrs:  # of all joints alike
        gain = {_GAIN: read_only_copy(file.attrs[_GAIN], f"{origin}, attribute {_GAIN}")}
    further = sorted({kind.group for kind in CHANNEL_KINDS.values()} - {"joints", "points"})
    allowed = ", ".join(["joints, points, points_<name>", *(f"{name}, {name}_<name>" for name in further), _STRAIGHT])
    for name in map(str, file):
        where, declared = f"{origin}: {name}", channel_specs_for_group_name(name)
        legal = name in ("joints", _STRAIGHT) or POINT_GROUP_NAME_PATTERN.fullmatch(name) or declared
        hint = "" if legal else nearest_name_question(name, ("joints", "points", *further, _STRAIGHT))
        what, hint = f"the file has an unknown group, '{name}'", hint or f"rename or delete the group '{name}'"
        raise_data_error_unless(legal, what, origin, allowed, hint)
        if name == _STRAIGHT:
            straight = _read_dataset(file[name], where, "m")
            continue
        group = file[name]
        what, hint = f"'{name}' is a dataset, but must be a group", f"store the values as a dataset in '{name}'"
        raise_data_error_unless(isinstance(group, h5py.Group), what, where, "a group with t, position, ...", hint)
        if name == "joints":
            joints = JointGroup(**gain | _read_group(group, where, _JOINT_UNITS, _JOINT_ATTRIBUTES, ("names",)))
        elif declared:
            units = {c.quantity: c.unit for c in declared}
            fields = tuple(entry for c in declared for entry in c.std_attribute_names)
            known = ("names", "clock", *fields)
            found = _read_group(group, where, {"t": "s", **units}, known, ("names",), needed={"t"})
            parts = ({key: found[key] for key in keys if key in found} for keys in (units, fields, ("clock",)))
            values, stds, clock = parts
            channels.append(SensorChannelGroup(name, found["names"], found["t"], values, stds, **clock))
        else:
            own = _read_group(group, where, _POINT_UNITS, _POINT_ATTRIBUTES, ("names", "sensor", "frame"))
            points.append(PointGroup(name, sensor_name=own.pop("sensor"), camera_pose=own.pop("pose", None), **own))
    where, allowed = f"{origin}, attribute truth", '{"name": number, ...}'
    truth, hint = _json(texts["truth"] or "{}", where, allowed), "correct the attribute, or delete it"
    raise_data_error_unless(isinstance(truth, dict), "the JSON text is not an object of numbers", where, allowed, hint)
    where, allowed = f"{origin}, attribute notes", '["sentence", ...]'
    notes = _json(texts["notes"] or "[]", where, allowed)
    good = isinstance(notes, list) and all(isinstance(note, str) for note in notes)
    raise_data_error_unless(good, "the JSON text is not a list of sentences", where, allowed, hint)
    said = texts["description"], texts["source"], path.stem, digest, truth, straight, tuple(notes)
    return Recording(joints, tuple(points), *said, tuple(channels))


def _read_group(
    group: h5py.Group,
    where: str,
    units: Mapping[str, str],
    attributes: Sequence[str],
    required: Iterable[str],
    needed: Set[str] = frozenset({"t", "position"}),
) -> dict[str, Any]:
    for noun, found, known, wanted in (
        ("dataset", set(map(str, group)), tuple(units), needed),
        ("attribute", set(map(str, group.attrs)), attributes, set(required)),
    ):
        for name in sorted(found - set(known)):
            what, hint = f"the group has an unknown {noun}, '{name}'", f"rename or delete the {noun} '{name}'"
            raise DataError(what, where=where, **unknown_name_error_arguments(name, known, hint))
        for name in sorted(wanted - found):
            what, hint = f"the {noun} '{name}' is missing in {group.name}", "add it, or leave the group out"
            raise DataError(what, where=where, allowed=f"a group with {noun}s {', '.join(sorted(wanted))}", hint=hint)
    what, is_twice = "`std` is both a dataset and an attribute", "std" in group and "std" in group.attrs
    raise_data_error_unless(not is_twice, what, where, "a dataset or an attribute", "delete one of the two `std`")
    values: dict[str, Any] = {name: _read_dataset(group[name], f"{where}/{name}", units[name]) for name in group}
    for name, value in group.attrs.items():
        place = f"{where}, attribute {name}"
        if name == "names":
            values[name] = tuple(_text(entry, place) for entry in np.atleast_1d(np.asarray(value, dtype=object)))
        elif name in ("clock", "effort_kind", "sensor", "frame"):
            values[name] = _text(value, place)
        else:
            values[name] = read_only_copy(value, place)[()]
    return values


def _read_dataset(dataset: Any, where: str, unit: str) -> Array:
    good = isinstance(dataset, h5py.Dataset) and dataset.dtype.kind in "fiu" and dataset.shape is not None
    what, allowed = "the entry is not a dataset of real numbers", "a dataset of the type float or integer"
    raise_data_error_unless(good, what, where, allowed, "write it again as float64, not as text, complex or a group")
    found = _text(dataset.attrs["unit"], f"{where}, attribute unit") if "unit" in dataset.attrs else unit
    hint = f"convert the values to {unit}, and write this unit (a recording is never converted when it is read)"
    raise_data_error_unless(found == unit, f"the unit is '{found}', but must be '{unit}'", where, unit, hint)
    return np.asarray(dataset[()], dtype=np.float64)


def _text(value: object, where: str) -> str:
    if isinstance(value, h5py.Empty):
        return ""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(()).item()
    if isinstance(value, bytes):
        try:
            return value.decode("utf-8")
        except UnicodeDecodeError as error:
            hint = "write the attribute again as UTF-8"
            raise DataError("the attribute is not UTF-8 text", where=where, allowed="UTF-8 text", hint=hint) from error
    raise_data_error_unless(isinstance(value, str), f"the value {value} is not text", where, "text", "write it as text")
    return str(value)


def _json(text: str, where: str, allowed: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DataError("the attribute is not JSON", where=where, allowed=allowed, hint="correct it") from error


_READ_TIMEOUT = 10.0  # for reading a whole file [s]
_MAX_GROUP_DEPTH = 10


def check_readable_in_child_process(path: Path, complaint: Callable[[Path], str], noun: str) -> None:
    """Check in a forked process that a file of the format `noun` can be read. A crash then ends only that process.

    `complaint` reads the file in the fork and returns a description of the error, empty on success. Raises `DataError`
    with this description, if `path` is not a regular file, or if the fork crashes or takes longer than `_READ_TIMEOUT`.
    A new Python process in place of the fork would take a second, and the processes of a pool may not start one.
    """
    files.check_input_file(path)
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
            with files.limit_process_memory():
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
        what = f"the {noun} file cannot be read within {_READ_TIMEOUT:g} s, so it is damaged or far too large"
    elif not answer:
        number = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
        how = signal.Signals(number).name if number else "an exit"
        what = f"the {noun} file is damaged: the {noun} library crashes when it reads the file ({how})"
    else:
        what = answer[1:]
    if what:
        most = f"{files.MAX_INPUT_NUMBERS / 1e6:.0f} million numbers"
        allowed = f"an undamaged {noun} file with at most {most} in total, without links to other files"
        hint = "if it is damaged, copy it again from its source; otherwise export or import the original data again"
        raise DataError(what, where=str(path), allowed=allowed, hint=hint)


@contextlib.contextmanager
def create_hdf5_atomically(path: str | os.PathLike[str]) -> Iterator[h5py.File]:
    """Create an HDF5 file in memory, and write it to `path` if the `with` block succeeds. Errors: `atomic_write`."""
    with files.atomic_write(Path(path)) as temporary:
        with h5py.File(str(temporary), "w", driver="core", backing_store=False) as file:
            yield file
            file.flush()
            image = file.id.get_file_image()
        temporary.write_bytes(image)


@contextlib.contextmanager
def open_hdf5_after_read_check(path: str | os.PathLike[str]) -> Iterator[h5py.File]:
    """Open an HDF5 file after another process has checked that it can be read (context manager).

    Raises `DataError` if the file is damaged, contains more than `MAX_INPUT_NUMBERS`, takes too long to read, or refers
    to other files, which its hash does not cover. Errors of the library within the block are raised as `DataError` too.
    """
    check_readable_in_child_process(Path(path), _complaint, "HDF5")
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:  # all of them come from h5py
        hint = "copy it again from its source, or import the original data again"
        raise DataError(_damage(error), where=str(path), allowed="an undamaged HDF5 file", hint=hint) from error


def _damage(error: Exception) -> str:
    """Description of a file's damage from an error of h5py, with the actual and expected sizes if it is truncated."""
    sizes = re.search(r"eof = (\d+), .*stored_eof = (\d+)", str(error))
    return "the HDF5 file is truncated or damaged" + (f": it has {sizes[1]} of {sizes[2]} bytes" if sizes else "")


def _complaint(path: Path) -> str:
    try:
        with h5py.File(path, "r") as file:
            complaint = _foreign(file) or _excess(file)
            if not complaint:
                dict(file.attrs)
                file.visititems(_read)
            return complaint
    except Exception as error:  # whatever h5py says of damaged files
        return _damage(error)


def _read(name: str, item: h5py.Group | h5py.Dataset) -> None:
    dict(item.attrs)
    if isinstance(item, h5py.Dataset):
        item[()]


def _foreign(group: h5py.Group, depth: int = 0) -> str:
    """Description of an entry that refers to another file, is a broken link or is nested too deeply. Empty if none."""
    for name in group:
        item = None if isinstance(group.get(name, getlink=True), h5py.ExternalLink) else group.get(name)
        if item is None:
            return f"'{name}' in the HDF5 file is a link to another file, or a broken link"
        if isinstance(item, h5py.Dataset) and (item.is_virtual or item.external):
            return f"the values of '{name}' in the HDF5 file are stored in another file"
        if isinstance(item, h5py.Group):
            endless = f"groups in the HDF5 file are nested more than {_MAX_GROUP_DEPTH} levels deep"
            if found := _foreign(item, depth + 1) if depth < _MAX_GROUP_DEPTH else endless:
                return found
    return ""


def _excess(file: h5py.File) -> str:
    """Description of a file that declares too many numbers, counted without compression. Empty for other files."""
    numbers = 0.0

    def count(name: str, item: h5py.Group | h5py.Dataset) -> None:
        nonlocal numbers
        if isinstance(item, h5py.Dataset) and item.shape is not None:
            numbers += max(1.0, item.dtype.itemsize / 8) * item.size

    file.visititems(count)
    what = f"the HDF5 file declares {numbers / 1e6:.0f} million numbers"
    return f"{what}; the limit is {files.MAX_INPUT_NUMBERS / 1e6:.0f} million" * (numbers > files.MAX_INPUT_NUMBERS)

"""Reading and writing of recordings as HDF5 files (`yid-recording/1`), with strict checks and atomic writes."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence, Set
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.data.hdf5_io import create_hdf5_atomically, open_checked_hdf5
from yid_ocp.data.recording import (
    JOINT_CHANNEL_UNITS,
    JOINT_CONSTANT_NAMES,
    POINT_GROUP_NAME_PATTERN,
    ChannelGroup,
    JointGroup,
    PointGroup,
    Recording,
    raise_data_error_unless,
    read_only_array,
    validate_recording,
)
from yid_ocp.errors import DataError, nearest_name_hint, unknown_name_details
from yid_ocp.files import file_sha256
from yid_ocp.sensors import CHANNEL_KINDS
from yid_ocp.sensors.base import declared_channel_kinds

_RECORDING_FORMAT = "yid-recording/1"

_STRAIGHT = "straight"
_GAIN = "proportional_gain"
_JOINT_UNITS = {"t": "s", **JOINT_CHANNEL_UNITS}
_POINT_UNITS = {"t": "s", "position": "m", "std": "m"}
_JOINT_ATTRIBUTES = ("names", "clock", "effort_kind", *JOINT_CONSTANT_NAMES)
_POINT_ATTRIBUTES = ("names", "sensor", "frame", "pose", "clock", "std")


def read_recording(path: str | os.PathLike[str], *, allow_nan_effort: bool = False) -> Recording:
    """Read and check a `yid-recording/1` file.

    Parameters
    ----------
    allow_nan_effort : bool
        Whether `effort` and `external_effort` may hold NaN.

    Raises
    ------
    DataError
        If the file is missing, not HDF5 or damaged, of another format, has a group, dataset, attribute or unit that
        the format does not know, lacks one that it needs, or fails `validate_recording`.
    """
    path = Path(path)
    digest = file_sha256(path)
    hint = "read other formats (CSV, rosbag, MCAP) with `yid-ocp import` or yid_ocp.data.read_any"
    raise_data_error_unless(
        h5py.is_hdf5(path), "the file is not an HDF5 file", str(path), f"HDF5 in the format {_RECORDING_FORMAT}", hint
    )
    with open_checked_hdf5(path) as file:
        recording = _from_file(file, path, digest)
    return validate_recording(recording, allow_nan_effort=allow_nan_effort, where=str(path))


def write_recording(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Check a recording, whose efforts may hold NaN, and write it as `yid-recording/1`, whole or not at all.

    Raises
    ------
    DataError
        As `validate_recording`.
    OutputError
        The file cannot be written; one that was there before is left as it was.
    """
    validate_recording(recording, allow_nan_effort=True)
    with create_hdf5_atomically(path) as file:
        file.attrs.update(format=_RECORDING_FORMAT, description=recording.description, source=recording.source)
        if recording.notes:
            file.attrs["notes"] = json.dumps(recording.notes)
        if recording.true_parameters:
            file.attrs["truth"] = json.dumps({key: float(value) for key, value in recording.true_parameters.items()})
        if recording.joints is not None:
            _write_group(file.create_group("joints"), recording.joints, _JOINT_UNITS, _JOINT_ATTRIBUTES)
        for group in recording.points:
            attributes = [name for name in _POINT_ATTRIBUTES if name != "std"]
            _write_group(file.create_group(group.name), group, _POINT_UNITS, attributes)
        for channels in recording.channel_groups:
            target, declared = file.create_group(channels.name), declared_channel_kinds(channels.name)
            units = {"t": "s"} | {c.quantity: c.unit for c in declared}
            for name, values in {"t": channels.t, **channels.values}.items():
                target.create_dataset(name, data=values).attrs["unit"] = units[name]
            names = np.array(channels.names, dtype=h5py.string_dtype())
            target.attrs.update(names=names, clock=channels.clock, **channels.stds)
        if recording.marker_reference_pose is not None:
            file.create_dataset(_STRAIGHT, data=recording.marker_reference_pose).attrs["unit"] = "m"


def _write_group(
    target: h5py.Group, group: JointGroup | PointGroup, units: Mapping[str, str], attributes: Iterable[str]
) -> None:
    for name, unit in units.items():
        if getattr(group, name) is not None:
            target.create_dataset(name, data=getattr(group, name)).attrs["unit"] = unit
    for name in attributes:
        if getattr(group, name) is not None:
            value = getattr(group, name)
            target.attrs[name] = np.array(value, dtype=h5py.string_dtype()) if name == "names" else value


def _from_file(file: h5py.File, path: Path, digest: str) -> Recording:
    origin = str(path)
    texts = {
        key: _text(file.attrs[key], f"{origin}, attribute {key}") if key in file.attrs else ""
        for key in ("format", "description", "source", "truth", "notes")
    }
    what = f"the format of the file is '{texts['format']}'" if texts["format"] else "the file does not say its format"
    raise_data_error_unless(
        texts["format"] == _RECORDING_FORMAT, what, f"{origin}, attribute format", _RECORDING_FORMAT
    )
    joints, points, straight, channels = None, [], None, []
    gain = {}
    if _GAIN in file.attrs:  # of all joints alike
        gain = {_GAIN: read_only_array(file.attrs[_GAIN], f"{origin}, attribute {_GAIN}")}
    further = sorted({CHANNEL_KINDS[kind].group for kind in CHANNEL_KINDS} - {"joints", "points"})
    allowed = ", ".join(["joints, points, points_<name>", *(f"{name}, {name}_<name>" for name in further), _STRAIGHT])
    for name in map(str, file):
        where, declared = f"{origin}: {name}", declared_channel_kinds(name)
        legal = name in ("joints", _STRAIGHT) or POINT_GROUP_NAME_PATTERN.fullmatch(name) is not None or bool(declared)
        hint = "" if legal else nearest_name_hint(name, ("joints", "points", *further, _STRAIGHT))
        raise_data_error_unless(legal, f"the format has no group '{name}'", origin, allowed, hint)
        if name == _STRAIGHT:
            straight = _read_dataset(file[name], where, "m")
            continue
        raise_data_error_unless(
            isinstance(file[name], h5py.Group), f"'{name}' is not a group", where, "a group of datasets"
        )
        if name == "joints":
            found = _read_group(file[name], where, _JOINT_UNITS, _JOINT_ATTRIBUTES, ("names",))
            joints = JointGroup(**gain | found)
        elif declared:
            units = {c.quantity: c.unit for c in declared}
            fields = tuple(entry for c in declared for entry in c.std_attribute_names)
            found = _read_group(
                file[name], where, {"t": "s", **units}, ("names", "clock", *fields), ("names",), needed={"t"}
            )
            parts = ({key: found[key] for key in keys if key in found} for keys in (units, fields, ("clock",)))
            values, stds, clock = parts
            channels.append(ChannelGroup(name, found["names"], found["t"], values, stds, **clock))
        else:
            required = ("names", "sensor", "frame")
            values = _read_group(file[name], where, _POINT_UNITS, _POINT_ATTRIBUTES, required)
            points.append(PointGroup(name=name, **values))
    truth = _truth(texts["truth"], f"{origin}, attribute truth") if texts["truth"] else {}
    notes = _notes(texts["notes"], f"{origin}, attribute notes") if texts["notes"] else ()
    return Recording(
        joints,
        tuple(points),
        texts["description"],
        texts["source"],
        path.stem,
        digest,
        truth,
        straight,
        notes,
        tuple(channels),
    )


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
            what = f"the format has no {noun} '{name}' here"
            raise DataError(what, where=where, **unknown_name_details(name, known))
        for name in sorted(wanted - found):
            raise DataError(f"the {noun} '{name}' is missing", where=where, allowed=", ".join(known))
    both = "std" in group and "std" in group.attrs
    raise_data_error_unless(not both, "`std` is both a dataset and an attribute", where, "one of the two")
    values: dict[str, Any] = {name: _read_dataset(group[name], f"{where}/{name}", units[name]) for name in group}
    for name, value in group.attrs.items():
        place = f"{where}, attribute {name}"
        if name == "names":
            values[name] = tuple(_text(entry, place) for entry in np.atleast_1d(np.asarray(value, dtype=object)))
        elif name in ("clock", "effort_kind", "sensor", "frame"):
            values[name] = _text(value, place)
        else:
            values[name] = read_only_array(value, place)
    return values


def _read_dataset(dataset: Any, where: str, unit: str) -> Array:
    numeric = isinstance(dataset, h5py.Dataset) and dataset.dtype.kind in "fiu" and dataset.shape is not None
    raise_data_error_unless(numeric, "not a dataset of real numbers", where, "floating point or integer numbers")
    found = _text(dataset.attrs["unit"], f"{where}, attribute unit") if "unit" in dataset.attrs else unit
    hint = f"convert the values to {unit}: recordings are never converted silently"
    raise_data_error_unless(found == unit, f"the unit is '{found}'", where, unit, hint)
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
            raise DataError("the text is not UTF-8", where=where) from error
    raise_data_error_unless(isinstance(value, str), f"found {value!r}", where, "text")
    return str(value)


def _json(text: str, where: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        what, hint = f"the text is not JSON ({error})", "write the recording again"
        raise DataError(what, where=where, allowed="a list in JSON", hint=hint) from error


def _notes(text: str, where: str) -> tuple[str, ...]:
    notes = _json(text, where)
    if not isinstance(notes, list) or not all(isinstance(note, str) for note in notes):
        raise DataError("the JSON text is not a list of text", where=where, allowed='["sentence", ...]')
    return tuple(notes)


def _truth(text: str, where: str) -> dict[str, float]:
    truth = _json(text, where)
    if not isinstance(truth, dict):
        raise DataError("the JSON text is not an object", where=where, allowed='{"name": number, ...}')
    return truth

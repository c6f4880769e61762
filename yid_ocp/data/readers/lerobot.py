"""Reader of joint measurements and commands from one episode of a LeRobot dataset (version 2.0, 2.1 or 3.0)."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from yid_ocp.arrays import Array
from yid_ocp.data.readers import base
from yid_ocp.data.recording import JointGroup, Recording, raise_data_error_unless
from yid_ocp.display import count_with_noun
from yid_ocp.errors import DataError, import_optional
from yid_ocp.files import check_input_file, check_not_too_many_numbers, file_sha256, read_input_json

_STATE, _ACTION = "observation.state", "action"
_CHANNELS = {
    "observation.velocity": "velocity",
    "observation.effort": "effort",
    "observation.state.velocity": "velocity",
    "observation.state.effort": "effort",
}
"""Features besides state and action that some robots record, with one number per joint."""
_SUFFIXES = {"pos": "position", "vel": "velocity", "torque": "effort", "effort": "effort", "current": "effort"}
_VERSIONS = ("v2.0", "v2.1", "v3.0")
_BOOKKEEPING = ("timestamp", "frame_index", "episode_index", "index", "task_index")  # numbers of frames and tasks
_NEVER_RADIANS = re.compile(r"(so_?100|so_?101|koch|lekiwi|omx|hope_?jr)", re.IGNORECASE)
"""Types of robots that LeRobot records in degrees or in normalised units, -100 to 100 of the calibrated range."""
_EPISODE_PATH = re.compile(r"(?![/\\])([^{}]|\{episode_(chunk|index)(:0?\d\d?d)?\})+")  # without a leading slash
_MAX_RADIANS, _MAX_NORMALISED = 2.1 * math.pi, 100.5
_PERCENT = "recorded as 0 to 100 % of its calibrated range, not as an angle"


class _Feature(BaseModel):
    dtype: str = ""
    names: Any = None


class _Info(BaseModel):
    codebase_version: str
    fps: float = Field(gt=0, allow_inf_nan=False, description="a number above 0 [Hz]")
    features: dict[str, _Feature] = Field(description="an object with {dtype, names} for every feature")
    total_episodes: int = Field(default=0, ge=0, description="a whole number from 0")
    data_path: str = ""
    chunks_size: int | None = Field(default=None, gt=0, description="a whole number from 1")
    robot_type: str | None = None


@base.READERS.register("LeRobot dataset")
def _read_lerobot_episode(
    path: str | os.PathLike[str],
    *,
    episode: int = 0,
    joints: Sequence[str] | None = None,
    units: Mapping[str, str] | None = None,
    torque_constants: Mapping[str, float] | None = None,
    gear_ratios: Mapping[str, float] | None = None,
    description: str = "",
) -> Recording:
    """Read one episode, counted from zero, from the folder of a LeRobot dataset.

    docs/reference/import_formats.md has the features and their units. Times are frame index / frame rate, a nominal
    clock. `notes` lists images and other features. Options are those of `JointPointAndUnitOptions`. Raises `DataError`
    without `pyarrow`, for an unknown dataset or episode, or if `validated_recording` refuses the result.
    """
    folder, info = Path(path), _info(Path(path))
    table, file = _episode(folder, info, episode)
    names, channels, left = _channels(folder, info, table)
    t, source = _times(info, table), f"{folder.name}, episode {episode}"
    where = f"{folder}, episode {episode}"
    if (units or {}).get("position") == "deg":
        advice = "if the model has this joint, set model.arms.locked_joints"
        left |= {name: f"{_PERCENT}; {advice}: {{{name}: ANGLE}} [rad]" for name in _grippers(names)}
        kept = [i for i, name in enumerate(names) if name not in left]
        names, channels = tuple(names[i] for i in kept), {key: values[:, kept] for key, values in channels.items()}
    group = JointGroup(names, t - t[0], clock="nominal", **channels)
    own = source, f"{folder.name}_{episode:06d}", file_sha256(file)
    notes = tuple(f"{name} was left out ({why})" for name, why in left.items())
    raw = Recording(group, (), description, *own, notes=notes)
    if "position" not in (units or {}):
        _check_are_radians(group, info, where)
    options = base.JointPointAndUnitOptions(joints, None, units, torque_constants, gear_ratios)
    return base.convert_to_si_and_validate(raw, where, options)


@base.FILE_PREVIEWERS.register("LeRobot dataset")
def _preview_lerobot(path: str | os.PathLike[str]) -> base.FilePreview:
    folder, info = Path(path), _info(Path(path))
    table, _ = _episode(folder, info, 0)
    names, channels, left = _channels(folder, info, table)
    group = JointGroup(names, _times(info, table), clock="nominal", **channels)
    sources, (units, guesses) = [], base.guess_non_si_units(Recording(group))
    grippers = _grippers(names) if "position" in units or _NEVER_RADIANS.search(info.robot_type or "") else []
    names = tuple(name for name in names if name not in grippers)
    by_name = {_ACTION: "position_command", _STATE: f"joints {', '.join(names)}"}
    for name, feature in info.features.items():
        note = f"without {', '.join(grippers)}: {_PERCENT}" if name == _STATE and grippers else ""
        own = ("", left[name]) if name in left else (by_name.get(name, _CHANNELS.get(name, "")), note)
        if name == "frame_index":
            own = ("t", "")
        elif name in _BOOKKEEPING:
            own = ("", "numbers frames and tasks")
        sources.append(base.TopicOrColumnSummary(name, feature.dtype, len(group.t), info.fps, *own))
    if "position" in units and _widest(group) <= _MAX_NORMALISED:  # degrees or normalised: reading asks which
        del units["position"]
        guesses = tuple(guess for guess in guesses if not guess.startswith("angles"))
    options: dict[str, Any] = {"episode": 0, "joints": list(names)}
    if units:
        options["units"] = units | ({"position_command": units["position"]} if "position" in units else {})
    said = f"{count_with_noun(info.total_episodes, 'episode')} at {info.fps:g} Hz, {info.codebase_version}"
    robot = info.robot_type
    return base.FilePreview(tuple(sources), options, (said + (f", recorded on {robot}" if robot else ""), *guesses))


def _grippers(names: Sequence[str]) -> list[str]:
    """Joints that LeRobot records in per cent even if the arm is in degrees."""
    return [name for name in names if "gripper" in name.lower()]


def _widest(group: JointGroup) -> float:
    """Largest recorded angle, without grippers."""
    arm = [i for i, name in enumerate(group.names) if name not in _grippers(group.names)]
    return float(np.nanmax(np.abs(group.position[:, arm]), initial=0.0))


def _check_are_radians(group: JointGroup, info: _Info, where: str) -> None:
    """Raise `DataError` if angles are in degrees or normalised units, or the robot is never recorded in radians."""
    widest, robot = _widest(group), info.robot_type or ""
    of = f", and LeRobot does not record a {robot} in radians" if _NEVER_RADIANS.search(robot) else ""
    if widest <= _MAX_RADIANS and not of:
        return
    what = f"the unit of the joint positions is unknown; the largest absolute value is {widest:.3g}{of}"
    allowed, hint = "--units deg" if of else "--units deg, or --units position=rad", "add --units deg"
    if widest <= _MAX_NORMALISED:
        hint = "add --units deg only if the robot was recorded with use_degrees=true. If not, the values are from -100 "
        hint += "to 100 of the range and cannot be converted, so record again with use_degrees=true"
    raise DataError(what, where=where, allowed=allowed, hint=hint)


def _info(folder: Path) -> _Info:
    file = folder / "meta" / "info.json"
    where, hint = str(file), "convert the dataset again with the conversion script of LeRobot"
    try:
        info = _Info.model_validate(read_input_json(file))
    except ValidationError as error:
        wrong = error.errors()[0]
        key, allowed = ".".join(map(str, wrong["loc"])), "an object with codebase_version, fps and features"
        if key:
            allowed = _Info.model_fields[str(wrong["loc"][0])].description or "text"
        what = f"{key or 'the content'} is {json.dumps(wrong['input'])[:60]}, which is not allowed"
        what = f"the key '{key}' is missing" if wrong["type"] == "missing" else what
        raise DataError(what, where=f"{where}: {key}" if key else where, allowed=allowed, hint=hint) from error
    version, place = info.codebase_version, f"{where}: codebase_version"
    what = f"the dataset has the version {version}, which cannot be read"
    raise_data_error_unless(version in _VERSIONS, what, place, ", ".join(_VERSIONS), hint)
    what, hint = f"the dataset has no {_STATE} (measured joint positions)", "record it with the state of the robot"
    raise_data_error_unless(_STATE in info.features, what, f"{where}: features", f"features with {_STATE}", hint)
    return info


def _episode(folder: Path, info: _Info, episode: int) -> tuple[Mapping[str, Array], Path]:
    """Columns of one episode, shape (frames, numbers of a frame), and its file."""
    names = "pyarrow", "pyarrow.parquet"
    arrow, parquet = (import_optional(name, "lerobot", "reading LeRobot datasets needs pyarrow") for name in names)
    where = f"{folder}, episode {episode}"
    last = info.total_episodes - 1
    allowed = f"0 to {last}" if last >= 0 else "an episode that was recorded"
    is_known, hint = episode >= 0 and (last < 0 or episode <= last), f"choose for example --episode {max(last, 0)}"
    raise_data_error_unless(is_known, f"there is no episode {episode}", str(folder), allowed, hint)
    wanted = [name for name in (_STATE, _ACTION, *_CHANNELS) if name in info.features]
    columns = [*wanted, "frame_index", "episode_index"]
    for file in _files(folder, info, episode):
        try:
            held = parquet.ParquetFile(check_input_file(file))
            _check_size(held.metadata, columns, str(file))
            _check_types(held.schema_arrow, columns, str(file))
            table = parquet.read_table(file, columns=columns, filters=[("episode_index", "=", episode)])
            found = {name: _matrix(table[name].combine_chunks(), name, folder) for name in columns}
        except (arrow.ArrowException, OSError, KeyError, ValueError) as error:
            what = "the table of the episode cannot be read, because it is damaged or not a parquet file"
            hint, allowed = "download or copy the file again", f"a parquet file with {', '.join(columns)}"
            raise DataError(what, where=str(file), allowed=allowed, hint=hint) from error
        if len(found["frame_index"]):
            return found, file
    what, hint = f"no file of the dataset has episode {episode}", "download the whole dataset, with all episodes"
    raise DataError(what, where=where, allowed="an episode whose file is in the folder", hint=hint)


def _files(folder: Path, info: _Info, episode: int) -> list[Path]:
    """Tables that may contain an episode: its own one in version 2, any in version 3."""
    pattern, chunk = info.data_path, episode // (info.chunks_size or 1000)
    if "episode_index" not in pattern:
        return sorted(folder.glob("data/*/*.parquet"))
    if _EPISODE_PATH.fullmatch(pattern) and ".." not in pattern:
        return [folder / pattern.format(episode_chunk=chunk, episode_index=episode)]
    where = f"{folder / 'meta' / 'info.json'}: data_path"
    allowed = "a path in the dataset with {episode_chunk:03d} and {episode_index:06d}"
    hint = "write data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    what = f"data_path is '{pattern}', which does not lead to the file of an episode"
    raise DataError(what, where=where, allowed=allowed, hint=hint)


def _check_size(metadata: Any, columns: Sequence[str], where: str) -> None:
    """Raise `DataError` if the wanted columns of a parquet file declare implausibly many numbers."""
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    held = (group.column(i) for group in groups for i in range(group.num_columns))
    count = sum(column.num_values for column in held if column.path_in_schema.split(".list.")[0] in columns)
    check_not_too_many_numbers(count + 3 * metadata.num_rows, where)  # a row is a list of its own


def _check_types(schema: Any, columns: Sequence[str], where: str) -> None:
    """Raise `DataError` if a column of a parquet file contains anything except numbers or lists of numbers."""
    from pyarrow.types import is_floating, is_integer

    for name in columns:
        kind = schema.field(name).type
        while hasattr(kind, "value_field"):
            kind = kind.value_type
        is_numeric = is_integer(kind) or is_floating(kind)
        what = f"the column {name} contains {kind} instead of numbers"
        hint = f"convert or record the dataset again, with numbers in {name}"
        raise_data_error_unless(is_numeric, what, where, "numbers, or lists of numbers", hint)


def _times(info: _Info, table: Mapping[str, Array]) -> Array:
    return table["frame_index"][:, 0] / info.fps


def _channels(
    folder: Path, info: _Info, table: Mapping[str, Array]
) -> tuple[tuple[str, ...], dict[str, Any], dict[str, str]]:
    """Names of the joints, arrays (frames, joints) by channel, and the reason for every omitted feature."""
    state = table[_STATE]
    entries = [_entry(name) for name in _names(info, _STATE, state.shape[1])]
    joints = tuple(dict.fromkeys(joint for joint, channel in entries if channel == "position"))
    channels: dict[str, Any] = {}
    for channel in dict.fromkeys(channel for _, channel in entries):
        at = [entries.index((joint, channel)) for joint in joints if (joint, channel) in entries]
        lacking = ", ".join(joint for joint in joints if (joint, channel) not in entries)
        what = f"{_STATE} has the {channel} of only {len(at)} of {len(joints)} joints; it lacks {lacking}"
        allowed, hint = "every channel for all joints", f"record the {channel} of all joints, or of none"
        raise_data_error_unless(len(at) == len(joints), what, f"{folder}: {_STATE}", allowed, hint)
        channels[channel] = state[:, at]
    left = {}
    for name in info.features:
        if name == _STATE or name in _BOOKKEEPING:
            continue
        target = "position_command" if name == _ACTION else _CHANNELS.get(name)
        if target is None:
            left[name] = f"type '{info.features[name].dtype or 'unknown'}'; only values of joints are imported"
            continue
        values = table[name]
        named = [_entry(entry)[0] for entry in _names(info, name, values.shape[1])]
        if set(joints) <= set(named):
            channels.setdefault(target, values[:, [named.index(joint) for joint in joints]])
        else:
            left[name] = f"its {len(named)} entries do not include all joints of {_STATE}"
    return joints, channels, left


def _matrix(column: Any, name: str, folder: Path) -> Array:
    from pyarrow import compute

    rows, lengths = len(column), list[int]()
    while hasattr(column.type, "value_field"):
        lengths = max(lengths, compute.unique(compute.list_value_length(column)).to_pylist(), key=len)
        column = column.flatten()
    what = f"the lists of column '{name}' differ in length ({', '.join(map(str, lengths))} values)"
    allowed = "lists of equal length in all frames"
    hint = f"remove the frames in which {name} has another length, or convert the dataset again"
    raise_data_error_unless(len(lengths) < 2 and len(column) >= rows, what, str(folder), allowed, hint)
    return column.to_numpy(zero_copy_only=False).astype(float).reshape(rows, len(column) // max(rows, 1))


def _names(info: _Info, feature: str, count: int) -> list[str]:
    said = info.features[feature].names
    if isinstance(said, Mapping):
        parts = [list(part) if isinstance(part, (list, tuple)) else [key] for key, part in said.items()]
        said = [name for part in parts for name in part]
    names = [str(name) for name in said] if isinstance(said, (list, tuple)) else []
    return names if len(names) == count and len(set(names)) == count else [f"joint_{i}" for i in range(count)]


def _entry(name: str) -> tuple[str, str]:
    joint, _, suffix = name.rpartition(".")
    return (joint, _SUFFIXES[suffix]) if joint and suffix in _SUFFIXES else (name, "position")

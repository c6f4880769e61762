"""Readers of recordings in all known formats. A new format is one file in this folder with one registration."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable
from dataclasses import fields, replace
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

from yid_ocp.data.channel_checks import mean_sample_rate
from yid_ocp.data.readers.base import FILE_PREVIEWERS, FilePreview, TopicOrColumnSummary
from yid_ocp.data.readers.base import READERS as READERS
from yid_ocp.data.recording import Recording
from yid_ocp.data.recording_hdf5 import read_recording
from yid_ocp.display import NULL_PROGRESS, Progress
from yid_ocp.errors import DataError, unknown_name_error_arguments
from yid_ocp.files import check_input_file

for _suffix in (".h5", ".hdf5"):
    READERS.register(_suffix)(read_recording)
# every file of this folder registers its formats when it is imported
for _format in iter_modules(__path__):
    import_module(f"{__name__}.{_format.name}")


def read_any(path: str | os.PathLike[str], *, progress: Progress = NULL_PROGRESS, **options: Any) -> Recording:
    """Read and check a recording in any known format. The path's suffix selects the reader.

    Formats: HDF5 recording, CSV file, rosbag, MCAP file, ROS 2 bag folder, C3D file, LeRobot dataset. `options` are
    those of the reader in `READERS`. Raises `DataError` for an unknown format or option, or if the reader raises it.
    """
    path = Path(path)
    known_as = _format_of(path)
    reader, known = READERS[known_as], reader_option_names_for_file(path)
    parameters = inspect.signature(reader).parameters
    default = parameters["options"].default if "options" in parameters else None
    for name in options:
        if name not in known:
            what, hint = f"the reader of '{known_as}' files has no option '{name}'", f"leave the option '{name}' out"
            raise DataError(what, where=str(path), **unknown_name_error_arguments(name, known, hint))
    return reader(path, **({"options": replace(default, **options)} if default else options), **_told(reader, progress))


def reader_option_names_for_file(path: str | os.PathLike[str]) -> list[str]:
    """Names of the options of `read_any` for a file or folder of this format. Raises the errors of `read_any`."""
    parameters = inspect.signature(READERS[_format_of(Path(path))]).parameters
    names = [entry.name for entry in fields(parameters["options"].default)] if "options" in parameters else parameters
    return [name for name in names if name not in ("path", "progress")]


def preview_file(path: str | os.PathLike[str], progress: Progress = NULL_PROGRESS) -> FilePreview:
    """List the data sources of a file in any known format, and suggest options of `read_any` to import it."""
    path = Path(path)
    known_as = _format_of(path)
    if known_as in FILE_PREVIEWERS:
        return FILE_PREVIEWERS[known_as](path, **_told(FILE_PREVIEWERS[known_as], progress))
    recording = read_any(path)
    sources = (
        TopicOrColumnSummary(g.name, "group", len(g.t), mean_sample_rate(g.t), ", ".join(g.names))
        for g in recording.all_groups
    )
    return FilePreview(tuple(sources), {}, ("the file is already a recording", *recording.notes))


def _told(reader: Callable[..., Any], progress: Progress) -> dict[str, Any]:
    """The argument `progress` for a reader that has this parameter, else no argument."""
    return {"progress": progress} if "progress" in inspect.signature(reader).parameters else {}


def _format_of(path: Path) -> str:
    key = path.suffix.lower()
    if path.is_dir():
        key = "LeRobot dataset" if (path / "meta" / "info.json").is_file() else "folder"
    if key not in READERS:
        if not path.exists():
            check_input_file(path)
        what, hint = f"there is no reader for '{key}' files", "export CSV with columns t, q_JOINT, ..."
        if key in (".urdf", ".xml"):
            what, hint = "this is a robot, not a recording", f"give the robot to `init`: yid-ocp init {path} RECORDING"
        raise DataError(what, where=str(path), allowed=", ".join(READERS), hint=hint)
    return key

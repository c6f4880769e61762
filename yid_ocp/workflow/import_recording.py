"""The command `import`: converts files of other tools to a recording, or previews their contents."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import ImportSettings
from yid_ocp.data import Recording, preview_file, read_any, write_recording
from yid_ocp.data.readers import FileContents
from yid_ocp.data.readers.base import parse_units
from yid_ocp.errors import ConfigError
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.report.terminal import file_contents_lines, recording_summary_lines
from yid_ocp.workflow.command_runner import EXIT_DONE, print_json, print_lines, print_result, show_progress

_RESULT_FORMAT = "yid-import/1"
_LISTS = {"joint_topics": "--joint-topic", "joints": "--joints"}
_MAPPINGS: Mapping[str, tuple[str, Callable[[str], Any]]] = {
    "points": ("--points", str),
    "columns": ("--columns", str),
    "torque_constants": ("--torque-constants", float),
    "gears": ("--gears", float),
}
_SINGLE = ("command_topic", "pose_axes", "header", "skip_bad_lines", "delimiter", "episode", "clock", "sensor", "frame")
_SWITCHES = {("header", False): "--no-header", ("skip_bad_lines", True): "--skip-bad-lines"}


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    if arguments.preview:
        with show_progress(arguments) as progress:
            progress.begin_stage(f"reading {arguments.file}")
            contents = preview_file(arguments.file, progress)
        options = {**contents.reader_options, **reader_options_from_arguments(arguments)}
        lines = file_contents_lines(contents)
        if not is_recording_file(arguments.file):
            lines += ["", "to import it:", f"  {_import_command_line(arguments.file, options)}"]
        if arguments.json:
            print_json({"format": _RESULT_FORMAT, "recording": None, **_preview_result(contents)})
        else:
            print_lines(lines)
        return EXIT_DONE
    if arguments.out is None:
        allowed = "--out RECORDING.h5, or --preview to look only"
        raise ConfigError("nothing says where to write the recording", where="--out", allowed=allowed)
    settings = load_config(arguments.config).import_ if arguments.config else ImportSettings()
    with show_progress(arguments) as progress:
        recording = read_foreign_recording(
            arguments.file, _reader_options_from_settings(settings) | reader_options_from_arguments(arguments), progress
        )
        write_recording(recording, arguments.out)
    result = {"format": _RESULT_FORMAT, "recording": arguments.out, **recording_contents(recording)}
    print_result(
        arguments, result, lambda: recording_summary_lines(recording), f"recording: {arguments.out}", arguments.out
    )
    return EXIT_DONE


def recording_contents(recording: Recording) -> dict[str, Any]:
    """Contents of a recording as plain data: duration, groups and notes."""
    return {
        "duration": recording.duration,
        "groups": {
            getattr(group, "name", "joints"): {"samples": len(group.t), "names": list(group.names)}
            for group in recording.groups
        },
        "notes": list(recording.notes),
    }


def _preview_result(contents: FileContents) -> dict[str, Any]:
    sources = [
        {"name": own.name, "kind": own.kind, "count": own.n_samples, "rate": own.mean_rate, "becomes": own.imported_as}
        | {"note": own.note}
        for own in contents.sources
    ]
    return {"sources": sources, "options": contents.reader_options, "notes": contents.notes}


def read_foreign_recording(
    file: str | Path, options: Mapping[str, Any], progress: Progress = NULL_PROGRESS
) -> Recording:
    """Recording read from a file of another tool, with the file's hash in `source`.

    Parameters
    ----------
    options : mapping of str to object
        Named options of its reader.

    Raises
    ------
    DataError
        As `read_any`.
    """
    progress.begin_stage(f"reading {file}")
    recording = read_any(file, progress=progress, **options)
    if recording.sha256 is None or is_recording_file(file):
        return recording
    return replace(recording, source=f"{recording.source} (SHA-256 {recording.sha256})")


def is_recording_file(file: str | Path) -> bool:
    """Whether a file is a recording of this package, judged by its suffix."""
    return Path(file).suffix.lower() in (".h5", ".hdf5")


def _reader_options_from_settings(settings: ImportSettings) -> dict[str, Any]:
    said = ((entry.name, getattr(settings, entry.name)) for entry in fields(settings))
    return {name: value for name, value in said if value is not None}


def reader_options_from_arguments(arguments: argparse.Namespace) -> dict[str, Any]:
    """Reader options from the command-line flags.

    Raises
    ------
    ConfigError, DataError
        A flag that cannot be understood.
    """
    options = {name: getattr(arguments, name) for name in _SINGLE if getattr(arguments, name) is not None}
    for key in _LISTS:
        entries = _split(getattr(arguments, key))
        if entries:
            options[key] = tuple(entries)
    for key, (flag, kind) in _MAPPINGS.items():
        entries = _split(getattr(arguments, key))
        if entries:
            options[key] = _pairs(entries, flag, kind, numbered=key == "columns")
    units = parse_units(_split(arguments.units))
    return options | ({"units": units} if units else {})


def _split(given: Sequence[str]) -> list[str]:
    return [part.strip() for entry in given for part in entry.split(",") if part.strip()]


def _pairs(entries: Sequence[str], flag: str, kind: Callable[[str], Any], numbered: bool) -> dict[str, Any]:
    """`KEY=VALUE` each; of columns also values alone, in their order."""
    if numbered and not any("=" in entry for entry in entries):
        return {str(i + 1): entry for i, entry in enumerate(entries)}
    pairs: dict[str, Any] = {}
    for entry in entries:
        key, equals, value = (part.strip() for part in entry.rpartition("="))
        try:
            pairs[key] = kind(value)
        except ValueError as error:
            raise ConfigError(f"'{value}' is no number", where=f"{flag} {entry}", allowed="KEY=NUMBER") from error
        if not (key and equals and value):
            raise ConfigError(f"'{entry}' is no pair", where=flag, allowed="KEY=VALUE,KEY=VALUE", hint="quote it whole")
    return pairs


def _import_command_line(file: str | Path, options: Mapping[str, Any]) -> str:
    """Shell command that imports a file with the given reader options."""
    words = ["yid-ocp", "import", str(file)]
    for key, value in options.items():
        if isinstance(value, bool):
            words += [_SWITCHES[key, value]] if (key, value) in _SWITCHES else []
        elif key in _LISTS:
            words += [_LISTS[key], ",".join(value)]
        elif key == "columns" and options.get("header") is False:
            words += ["--columns", ",".join(value[name] for name in sorted(value, key=int))]
        elif isinstance(value, Mapping):
            words += [f"--{key.replace('_', '-')}", ",".join(f"{name}={entry}" for name, entry in value.items())]
        else:
            words += [f"--{key.replace('_', '-')}", str(value)]
    return shlex.join([*words, "--out", f"{Path(file).stem}.h5"])

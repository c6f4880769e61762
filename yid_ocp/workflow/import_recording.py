"""The command `import`: converts files of other tools to a recording, or previews their contents."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import ImportSettings
from yid_ocp.data import Recording, preview_file, read_any, write_recording
from yid_ocp.data.readers.base import parse_quantity_units
from yid_ocp.errors import ConfigError
from yid_ocp.files import named_attributes
from yid_ocp.progress import Progress
from yid_ocp.report.terminal import recording_summary_lines, third_party_file_summary_lines
from yid_ocp.workflow.command_runner import EXIT_DONE, print_json, print_result, stderr_progress_display

_RESULT_FORMAT = "yid-import/1"
_LISTS = ("joint_topics", "joints")
_MAPPINGS: Mapping[str, type] = {"points": str, "columns": str, "torque_constants": float, "gears": float}
_SINGLE = (
    "command_topic",
    "pose_axis_point_distance",
    "header",
    "skip_bad_lines",
    "delimiter",
    "episode",
    "clock",
    "point_sensor_name",
    "frame",
)
_FLAGS = {"joint_topics": "--joint-topic"}  # of options whose flag is not their name
_SWITCHES = {("header", False): "--no-header", ("skip_bad_lines", True): "--skip-bad-lines"}


def run_from_arguments(arguments: argparse.Namespace) -> int:
    """Run the command `import` and return its exit code."""
    file, asked = arguments.file, reader_options_from_arguments(arguments)
    if arguments.preview:
        with stderr_progress_display(arguments) as progress:
            progress.begin_stage(f"reading {file}")
            contents = preview_file(file, progress)
        if arguments.json:
            keys = "name kind count=n_samples rate=mean_rate becomes=imported_as note"
            sources = [named_attributes(own, keys) for own in contents.sources]
            told = {"sources": sources, "options": contents.reader_options, "notes": contents.notes}
            print_json({"format": _RESULT_FORMAT, "recording": None, **told})
            return EXIT_DONE
        lines = third_party_file_summary_lines(contents)
        if not has_native_recording_suffix(file):
            lines += ["", "to import it:", f"  {_import_command_line(file, {**contents.reader_options, **asked})}"]
        print("\n".join(lines))
        return EXIT_DONE
    if arguments.out is None:
        allowed = "--out RECORDING.h5, or --preview to look only"
        raise ConfigError("nothing says where to write the recording", where="--out", allowed=allowed)
    settings = load_config(arguments.config).import_ if arguments.config else ImportSettings()
    said = {entry.name: getattr(settings, entry.name) for entry in fields(settings)}
    with stderr_progress_display(arguments) as progress:
        options = {name: value for name, value in said.items() if value is not None} | asked
        recording = read_third_party_recording(file, options, progress)
        write_recording(recording, arguments.out)
    out = arguments.out
    result = {"format": _RESULT_FORMAT, "recording": out, **recording_contents_summary(recording)}
    print_result(arguments, result, lambda: recording_summary_lines(recording), f"recording: {out}", out)
    return EXIT_DONE


def recording_contents_summary(recording: Recording) -> dict[str, Any]:
    """Contents of a recording as plain data: duration, groups and notes."""
    groups = {group.name: {"samples": len(group.t), "names": list(group.names)} for group in recording.all_groups}
    return {"duration": recording.duration, "groups": groups, "notes": list(recording.notes)}


def read_third_party_recording(file: str | Path, options: Mapping[str, Any], progress: Progress) -> Recording:
    """Recording read from a file of another tool, the file's hash in `source`; options and errors as `read_any`."""
    progress.begin_stage(f"reading {file}")
    recording = read_any(file, progress=progress, **options)
    if recording.sha256 is None or has_native_recording_suffix(file):
        return recording
    return replace(recording, source=f"{recording.source} (SHA-256 {recording.sha256})")


def has_native_recording_suffix(file: str | Path) -> bool:
    """Whether a file is a recording of this package, judged by its suffix."""
    return Path(file).suffix.lower() in (".h5", ".hdf5")


def reader_options_from_arguments(arguments: argparse.Namespace) -> dict[str, Any]:
    """Reader options from the command-line flags; `ConfigError` or `DataError` for one that cannot be understood."""
    options = {name: getattr(arguments, name) for name in _SINGLE if getattr(arguments, name) is not None}
    for key in (*_LISTS, *_MAPPINGS):
        if entries := _split(getattr(arguments, key)):
            options[key] = tuple(entries) if key in _LISTS else _pairs(entries, key)
    units = parse_quantity_units(_split(arguments.units))
    return options | ({"units": units} if units else {})


def _split(given: Sequence[str]) -> list[str]:
    return [part.strip() for entry in given for part in entry.split(",") if part.strip()]


def _flag(key: str) -> str:
    return _FLAGS.get(key, f"--{key.replace('_', '-')}")


def _pairs(entries: Sequence[str], option: str) -> dict[str, Any]:
    """`KEY=VALUE` each; of columns also values alone, in their order."""
    if option == "columns" and not any("=" in entry for entry in entries):
        return {str(i + 1): entry for i, entry in enumerate(entries)}
    pairs: dict[str, Any] = {}
    for entry in entries:
        key, equals, value = (part.strip() for part in entry.rpartition("="))
        try:
            pairs[key] = _MAPPINGS[option](value)
        except ValueError as error:
            where = f"{_flag(option)} {entry}"
            raise ConfigError(f"'{value}' is no number", where=where, allowed="KEY=NUMBER") from error
        if not (key and equals and value):
            allowed = "KEY=VALUE,KEY=VALUE"
            raise ConfigError(f"'{entry}' is no pair", where=_flag(option), allowed=allowed, hint="quote it whole")
    return pairs


def _import_command_line(file: str | Path, options: Mapping[str, Any]) -> str:
    words = ["yid-ocp", "import", str(file)]
    for key, value in options.items():
        if isinstance(value, bool):
            words += [_SWITCHES[key, value]] if (key, value) in _SWITCHES else []
            continue
        text = str(value)
        if key in _LISTS:
            text = ",".join(value)
        elif key == "columns" and options.get("header") is False:
            text = ",".join(value[name] for name in sorted(value, key=int))
        elif isinstance(value, Mapping):
            text = ",".join(f"{name}={entry}" for name, entry in value.items())
        words += [_flag(key), text]
    return shlex.join([*words, "--out", f"{Path(file).stem}.h5"])

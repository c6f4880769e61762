"""The command `import`: convert files of other tools to a recording, merge several, or preview their contents."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import ImportSettings
from yid_ocp.data import Recording, write_recording
from yid_ocp.data.checks import recording_quality_issues
from yid_ocp.data.merge import merge_recordings
from yid_ocp.data.readers import base, preview_file, read_any, reader_option_names_for_file
from yid_ocp.data.readers.csv import column_pattern
from yid_ocp.display import Progress, grouped
from yid_ocp.errors import ConfigError, DataError, unknown_name_error_arguments
from yid_ocp.files import attributes_to_dict
from yid_ocp.options import class_options_by_key, mapping_value_type
from yid_ocp.report.terminal import importable_file_contents_lines, recording_summary_lines
from yid_ocp.sensors import SensorOptions
from yid_ocp.workflow.command_runner import EXIT_DONE, print_json, print_result, stderr_progress_display

_RESULT_FORMAT = "yid-import/1"
_AGAIN = "repeat this command with --units {}"
DO_NOT_USE = "{} has the values as read: do not use it before the advice above is followed"
_LISTS = ("joint_topics", "joints")
_KINDS = {name: mapping_value_type(entry.type_hint) for name, entry in class_options_by_key(ImportSettings).items()}
_MAPPINGS = {name: kind for name, kind in _KINDS.items() if kind is not None and name != "units"}
_SINGLE = [name for name, kind in _KINDS.items() if kind is None and name not in _LISTS]
_FLAGS = {
    "joint_topics": "--joint-topic",
    "file_clock_offsets": "--clock-offset",
    "message_fields": "--field",
    "column_meanings": "--columns",
    "point_names": "--points",
    "has_header": "--no-header",
}  # options whose flag has another name
_SWITCHES = {("has_header", False): "--no-header", ("skip_bad_lines", True): "--skip-bad-lines"}


def run_and_return_exit_code(arguments: argparse.Namespace) -> int:
    """Run the command `import` and return its exit code."""
    files, out, asked = arguments.files, arguments.out, reader_options_from_arguments(arguments)
    if arguments.preview:
        return _preview(arguments, asked)
    if out is None or not has_native_recording_suffix(out):
        name, where = out or Path(files[0]).name, "--out"
        what = "the option --out is missing" if out is None else f"'{name}' does not end in .h5"
        hint = f"write --out {Path(name).with_suffix('.h5')}"
        raise ConfigError(what, where=where, allowed="NAME.h5, or --preview", hint=hint)
    settings = load_config(arguments.config).import_ if arguments.config else ImportSettings()
    said = {entry.name: getattr(settings, entry.name) for entry in fields(settings)}
    with stderr_progress_display(arguments) as progress:
        options = {name: value for name, value in said.items() if value is not None} | asked
        recording = _read(files, options, progress)
        recording = replace(recording, name=Path(out).stem) if len(files) > 1 else recording
        replaced = [f"note: {out} existed and was replaced"] if Path(out).exists() else []
        write_recording(recording, out)
    issues, is_severe = recording_issue_lines(recording)
    result = {"format": _RESULT_FORMAT, "recording": out, **recording_summary_dict(recording), "issues": issues}
    then = f"next: yid-ocp init ROBOT.urdf {out} --out CONFIG.yaml, with your other recordings and the options of the "
    then += f"object (yid-ocp init --help). If there is a configuration already, add {out} to its recordings.estimate"
    then = DO_NOT_USE.format(out) if is_severe else then
    lines = [*issues, *recording_summary_lines(recording), "", *replaced, then]
    print_result(arguments, result, lambda: lines, f"recording: {out}", out)
    return EXIT_DONE


def _preview(arguments: argparse.Namespace, asked: Mapping[str, Any]) -> int:
    """Print the contents of files, the recordings they would become, and the command that imports them."""
    found, said, are_importable = list[dict[str, Any]](), list[str](), True
    for file in arguments.files:
        with stderr_progress_display(arguments) as progress:
            progress.begin_stage(f"listing the contents of {file}")
            contents = preview_file(file, progress)
            keys = "name kind count=n_samples rate=mean_rate becomes=imported_as note"
            sources = [attributes_to_dict(own, keys) for own in contents.sources]
            options = {**contents.reader_options, **asked}
            found.append({"sources": sources, "options": contents.reader_options, "notes": contents.notes})
            lines = importable_file_contents_lines(contents)
            if not has_native_recording_suffix(file):
                proposal, is_importable = _proposal_lines([file], options, progress)
                lines, are_importable = lines + proposal, are_importable and is_importable
        said += [*([f"{file}:"] if len(arguments.files) > 1 else []), *lines, ""]
    if len(arguments.files) > 1:
        options = _combined([*(own["options"] for own in found), asked])
        with stderr_progress_display(arguments) as progress:
            said += _proposal_lines(arguments.files, options, progress, are_importable)[0]
    if arguments.json:
        more = found[0] if len(found) == 1 else {"files": dict(zip(arguments.files, found, strict=True))}
        print_json({"format": _RESULT_FORMAT, "recording": None, **more})
    else:
        print("\n".join(said).rstrip())
    return EXIT_DONE


def _combined(proposals: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Merge the reader options of several files. Entries of mappings and lists are concatenated."""
    combined: dict[str, Any] = {}
    for name, value in ((name, value) for options in proposals for name, value in options.items()):
        held = combined.get(name)
        if isinstance(value, Mapping):
            combined[name] = {**(held or {}), **value}
        elif isinstance(value, (list, tuple)):
            combined[name] = [*(held or ()), *(entry for entry in value if entry not in (held or ()))]
        else:
            combined[name] = value
    return combined


def _proposal_lines(
    files: Sequence[str], options: Mapping[str, Any], progress: Progress, are_importable: bool = False
) -> tuple[list[str], bool]:
    """Return lines with a command that imports the files and issues found, and True; or what is missing, and False.

    Nothing is missing if each of the files can be imported alone (`are_importable`).
    """
    try:
        recording = _read(files, options, progress)
    except DataError as error:
        if are_importable:
            return ["", f"the files are not parts of one recording: {error.what}"], False
        more = [f"  {word}: {text}" for word, text in (("allowed", error.allowed), ("try", error.hint)) if text]
        return ["", f"the import needs more information: {error.what}", *more], False
    what = "it" if len(files) == 1 else "them as one recording"
    issues, command = recording_issue_lines(recording)[0], import_command_line(files, options)
    return ["", *issues, f"to import {what}:", f"  {command}"], True


def recording_issue_lines(recording: Recording, again: str = _AGAIN) -> tuple[list[str], bool]:
    """Return lines about issues that show without a model, and whether one is severe. `again` states the cure `{}`."""
    units, reasons = base.guess_non_si_units(recording)
    found = recording_quality_issues(recording, lambda group: SensorOptions())
    found = [issue for issue in found if not (issue.cause == "time_unit" and "t" in units)]
    kinds = {"warning": "warning", "not_trusted": "issue", "refused": "issue"}
    said = []
    cures = ((own.advice + f" (in CONFIG.yaml: {own.setting})" * bool(own.setting), own) for own in found)
    for cure, alike in grouped(cures).items():
        told = (f"{kinds[own.severity]} ({own.certainty_word}): {own.what}\n" for own in alike)
        said.append(f"{''.join(told)}  try: {cure}")
    for (quantity, unit), reason in zip(units.items(), reasons, strict=True):
        said.append(f"issue (likely): {reason}\n  try: {again.format(f'{quantity}={unit}')}")
    is_severe = bool(units) or any(own.severity != "warning" for own in found)
    return [*said, ""] if said else [], is_severe


def _read(files: Sequence[str], given: Mapping[str, Any], progress: Progress) -> Recording:
    """Return one recording from one or more files. An option applies to every file whose format has it."""
    if len(files) == 1:
        _option_names_by_file(files, given)
        return read_third_party_recording(files[0], given, progress)
    options: dict[str, Any] = {**given}
    offsets = options.pop("file_clock_offsets", None)
    known = _option_names_by_file(files, options)
    late = {k: v for k, v in options.items() if k in ("joints", "point_names", "torque_constants", "gear_ratios")}
    units = dict(options.get("units") or {})
    if units.get("effort") in base.MOTOR_CURRENT_UNITS:
        late["units"] = {"effort": units.pop("effort")}
    columns, matched, present = options.get("column_meanings") or {}, set[str](), set[str]()
    options_by_file = dict[str, Mapping[str, Any]]()
    for file in files:
        own = {name: value for name, value in options.items() if name in known[file] and name not in late}
        own |= {"units": units} if units and "units" in known[file] else {}
        if columns and "column_meanings" in known[file]:
            names = [source.name for source in preview_file(file).sources]
            known_here = (key for key in columns if any(map(column_pattern(key).fullmatch, names)))
            own["column_meanings"] = {key: columns[key] for key in known_here}
            matched, present = matched | set(own["column_meanings"]), present.union(names)
        options_by_file[file] = own
    if missing := set(columns) - matched:
        said = unknown_name_error_arguments(min(missing), sorted(present), "write COLUMN=MEANING for each column")
        raise DataError(f"no file has a column '{min(missing)}'", where="--columns", **said)
    parts = [read_third_party_recording(file, own, progress) for file, own in options_by_file.items()]
    stems = [Path(file).stem for file in files]
    if len(set(stems)) < len(stems):
        what = f"two files have the name '{max(stems, key=stems.count)}', apart from folder and ending"
        raise DataError(what, where=", ".join(files), allowed="files with different names", hint="rename one of them")
    merged = merge_recordings([replace(part, name=stem) for part, stem in zip(parts, stems, strict=True)], offsets)
    return base.convert_to_si_and_validate(merged, ", ".join(files), base.JointPointAndUnitOptions(**late))


def _option_names_by_file(files: Sequence[str], options: Mapping[str, Any]) -> Mapping[str, Sequence[str]]:
    """Return the option names of each file's reader. Raises `DataError` if none of them has one of `options`."""
    known = {file: () if has_native_recording_suffix(file) else reader_option_names_for_file(file) for file in files}
    for name in options:
        if not any(name in own for own in known.values()):
            what = f"{_flag(name)} does not apply to {'this file' if len(files) == 1 else 'files of these formats'}"
            allowed = ", ".join(sorted(map(_flag, _KINDS.keys() & set().union(*known.values())))) or "no options"
            others = ", or name all files of the recording, one with this offset" * (name == "file_clock_offsets")
            raise DataError(what, where=_flag(name), allowed=allowed, hint=f"leave {_flag(name)} out{others}")
    return known


def recording_summary_dict(recording: Recording) -> dict[str, Any]:
    """Summarise a recording's duration, groups and notes as plain data."""
    groups = {group.name: {"samples": len(group.t), "names": list(group.names)} for group in recording.all_groups}
    return {"duration": recording.duration, "groups": groups, "notes": list(recording.notes)}


def read_third_party_recording(file: str | Path, options: Mapping[str, Any], progress: Progress) -> Recording:
    """Read a recording from another tool's file, with the file's hash in `source`. Options and errors: `read_any`."""
    progress.begin_stage(f"reading {file}")
    recording = read_any(file, progress=progress, **options)
    if recording.sha256 is None or has_native_recording_suffix(file):
        return recording
    return replace(recording, source=f"{recording.source} (SHA-256 {recording.sha256})")


def has_native_recording_suffix(file: str | Path) -> bool:
    """Check whether a file has the suffix of this package's recordings."""
    return Path(file).suffix.lower() in (".h5", ".hdf5")


def reader_options_from_arguments(arguments: argparse.Namespace) -> dict[str, Any]:
    """Read reader options from command-line flags. Raises `ConfigError` or `DataError` if a flag is invalid."""
    options = {name: getattr(arguments, name) for name in _SINGLE if getattr(arguments, name) is not None}
    for key in (*_LISTS, *_MAPPINGS):
        if entries := _split(getattr(arguments, key)):
            options[key] = tuple(entries) if key in _LISTS else _pairs(entries, key)
    units = base.parse_quantity_units(_split(arguments.units))
    return options | ({"units": units} if units else {})


def _split(given: Sequence[str]) -> list[str]:
    return [part.strip() for entry in given for part in entry.split(",") if part.strip()]


def _flag(key: str) -> str:
    return _FLAGS.get(key, f"--{key.replace('_', '-')}")


def _pairs(entries: Sequence[str], option: str) -> dict[str, Any]:
    """Return `KEY=VALUE` entries as a mapping. Columns may have values only, in order; `POINT` means `POINT=POINT`."""
    if option == "column_meanings" and not any("=" in entry for entry in entries):
        return {str(i + 1): entry for i, entry in enumerate(entries)}
    pairs: dict[str, Any] = {}
    for entry in entries:
        text = f"{entry}={entry}" if option == "point_names" and "=" not in entry else entry
        key, equals, value = (part.strip() for part in text.rpartition("="))
        try:
            pairs[key] = _MAPPINGS[option](value)
        except ValueError as error:
            where, hint = f"{_flag(option)} {entry}", f"write a number after =, for example {key}=0.5"
            raise ConfigError(f"'{value}' is not a number", where=where, allowed="NAME=NUMBER", hint=hint) from error
        if not (key and equals and value):
            what, hint = f"'{entry}' is not NAME=VALUE", "write NAME=VALUE, in quotes if it has spaces or *"
            raise ConfigError(what, where=_flag(option), allowed="NAME=VALUE,NAME=VALUE", hint=hint)
    return pairs


def import_command_line(files: Sequence[str], options: Mapping[str, Any]) -> str:
    """Return the command that imports the files as one recording with these options."""
    words = ["yid-ocp", "import", *map(str, files)]
    for key, value in options.items():
        if isinstance(value, bool):
            words += [_SWITCHES[key, value]] if (key, value) in _SWITCHES else []
            continue
        text = str(value)
        if key in _LISTS:
            text = ",".join(value)
        elif key == "column_meanings" and options.get("has_header") is False:
            text = ",".join(value[name] for name in sorted(value, key=int))
        elif isinstance(value, Mapping):
            text = ",".join(f"{name}={entry}" for name, entry in value.items())
        words += [_flag(key), text]
    return shlex.join([*words, "--out", f"{Path(files[0]).stem}{'_merged' if len(files) > 1 else ''}.h5"])

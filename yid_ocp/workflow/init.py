"""The command `init`: writes a commented configuration from robot, recordings and object dimensions."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from yid_ocp.config.reader import load_config
from yid_ocp.config.schema import config_json_schema
from yid_ocp.data import Recording, read_recording, write_recording
from yid_ocp.errors import ConfigError, DataError, OutputError, unknown_name_details
from yid_ocp.files import atomic_write, write_text
from yid_ocp.model.objects.base import InitObject, comma_separated_numbers, init_templates
from yid_ocp.model.urdf import read_urdf
from yid_ocp.progress import Progress
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.command_runner import EXIT_DONE, print_result, show_progress
from yid_ocp.workflow.commented_config import commented_config_text
from yid_ocp.workflow.config_proposal import (
    ConfigProposal,
    propose_config,
    relative_posix_path,
    rest_split_time,
)
from yid_ocp.workflow.import_recording import is_recording_file, read_foreign_recording, reader_options_from_arguments

_RESULT_FORMAT = "yid-init/1"
_SCHEMA_FILE = "yid-ocp.schema.json"


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    out = Path(arguments.out)
    if out.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"the configuration is called '{out.name}'", where="--out", allowed="NAME.yaml")
    read_urdf(arguments.robot)
    item = _object_from_arguments(arguments)
    with show_progress(arguments) as progress:
        made = _recordings(arguments, out, progress)
    recordings = [recording or read_recording(file) for file, recording in made.items()]
    proposal = propose_config(
        arguments.robot,
        recordings,
        item.settings.model_segments(),
        holder=arguments.holder,
        grasps=_grasps(arguments.grasp),
        standing=item.stands_in_world,
    )
    made = _split(made, recordings, proposal, out)
    _refuse_existing([out, *(file for file, raw in made.items() if raw is not None)], arguments.replace)
    imports = reader_options_from_arguments(arguments)
    robot = arguments.robot
    where = robot if robot.startswith(("package:", "default:")) else relative_posix_path(robot, out.parent)
    files = [relative_posix_path(file, out.parent) for file in made]
    text = commented_config_text(where, arguments.object, item, proposal, files, imports, _SCHEMA_FILE)
    _write(out, text, {file: raw for file, raw in made.items() if raw is not None})
    result = {"format": _RESULT_FORMAT, "configuration": str(out), "recordings": files, "proposal": proposal.to_dict()}
    print_result(arguments, result, lambda: _summary_lines(proposal, out), f"configuration: {out}", str(out))
    return EXIT_DONE


# -- what was asked ---------------------------------------------------------------------------------------------------


def _object_from_arguments(arguments: argparse.Namespace) -> InitObject:
    """The described object; `ConfigError` for a number that is missing or impossible, which names its option."""
    templates, word = init_templates(), arguments.object
    if word not in templates:
        said = unknown_name_details(word, templates)
        raise ConfigError(f"there is no choice of --object '{word}'", where="yid-ocp init", **said)
    template = templates[word]
    links = template.default_links if arguments.links is None else arguments.links
    if not 1 <= links <= 64:
        raise ConfigError(f"the object has {links} links", where="--links", allowed="1 to 64")
    numbers = {name: getattr(arguments, name) for name in ("length", "mass", "radius")}
    for text in arguments.number:
        name, equals, value = text.partition("=")
        if name not in template.further_numbers or not equals:
            allowed = ", ".join(f"{key}=NUMBER, {words}" for key, words in template.further_numbers.items())
            what = f"'{text}' is no further number of a {word}"
            raise ConfigError(what, where="--number", allowed=allowed or "none", hint="leave it out")
        numbers[name] = comma_separated_numbers(value, 1, "--number")[0]
    for name, number in numbers.items():
        if number is not None and not 0 < number < float("inf"):
            raise ConfigError(f"the {name} is {number:g}", where=f"--{name}", allowed="a number above 0")
    given = {**numbers, **{name: getattr(arguments, name) for name in ("section", "branch", "branches")}}
    if given["branch"] and not template.has_branches:
        raise ConfigError(f"a {word} has no branches", where="--branch", allowed="--object tree")
    return template.build({name: value for name, value in given.items() if value}, links)


def _grasps(given: Sequence[str]) -> dict[str, str]:
    grasps = {}
    for text in given:
        frame, equals, point = text.partition("=")
        if not (frame and equals and point):
            raise ConfigError(f"'{text}' is no grasp", where="--grasp", allowed="FRAME=POINT, such as tool0=w_cable")
        grasps[frame] = point
    return grasps


# -- files ------------------------------------------------------------------------------------------------------------


def _recordings(arguments: argparse.Namespace, out: Path, progress: Progress) -> dict[Path, Recording | None]:
    options = reader_options_from_arguments(arguments)
    made: dict[Path, Recording | None] = {}
    for name in arguments.files:
        file = Path(name)
        if is_recording_file(file):
            if options:
                flags = ", ".join(options)
                raise ConfigError(f"{file.name} is a recording already", where=flags, hint="leave these options out")
            made[file] = None
        else:
            recording = read_foreign_recording(file, options, progress)
            made[out.parent / f"{recording.name}.h5"] = recording
    if len(made) < len(arguments.files):
        raise DataError("two of the files would become one recording", where=", ".join(arguments.files))
    return made


def _split(
    made: dict[Path, Recording | None], recordings: Sequence[Recording], proposal: ConfigProposal, out: Path
) -> dict[Path, Recording | None]:
    """A single recording in two files where it comes to rest in between, the second one to be held out."""
    if len(recordings) > 1:
        return made
    [whole] = recordings
    time = rest_split_time(whole, proposal.joints)
    if time is None:
        return made
    first, last = (min(g.t[0] for g in whole.groups), max(g.t[-1] for g in whole.groups))
    note = f"of {whole.source or whole.name}, from {{:.6g}} s to {{:.6g}} s"
    parts = {"estimate": (first, time), "held_out": (time, last)}
    return {
        out.parent / f"{whole.name}_{name}.h5": replace(
            whole.time_slice(*span), name=f"{whole.name}_{name}", notes=(*whole.notes, note.format(*span))
        )
        for name, span in parts.items()
    }


def _refuse_existing(files: Sequence[Path], allowed: bool) -> None:
    for file in files:
        if file.exists() and not allowed:
            raise OutputError("the file is there already", where=str(file), hint="choose another --out, or --replace")


def _write(out: Path, text: str, made: Mapping[Path, Recording]) -> None:
    """The recordings, the configuration, which is loaded before it gets its name, and its schema; all or nothing."""
    before = {file for file in made if file.exists()}
    try:
        for file, recording in made.items():
            write_recording(recording, file)
        with atomic_write(out) as temporary:
            temporary.write_text(text, encoding="utf-8")
            build_system(load_config(temporary))
    except BaseException:
        for file in set(made) - before:
            file.unlink(missing_ok=True)
        raise
    write_text(out.parent / _SCHEMA_FILE, json.dumps(config_json_schema(), indent=1) + "\n")


def _summary_lines(proposal: ConfigProposal, out: Path) -> list[str]:
    held = ", ".join(dict.fromkeys([proposal.holder_frame, *proposal.grasps]))
    lines = [
        f"joints: {', '.join(proposal.joints)}",
        f"held by: {held}",
        f"mode: {proposal.arm_mode}: {proposal.arm_mode_reason}",
        f"start: {proposal.initial_state}: {proposal.initial_state_reason}",
    ]
    for group, places in proposal.point_placements.items():
        lines += [f"{group}: {place.point} at {place.frame or '?'}, {place.reason}" for place in places]
    lines += ["", f"next: yid-ocp check {out}, then yid-ocp solve {out}", ""]
    return lines

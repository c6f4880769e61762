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
from yid_ocp.errors import ConfigError, DataError, OutputError
from yid_ocp.files import atomic_write, write_text
from yid_ocp.model.urdf import read_urdf
from yid_ocp.progress import Progress
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.command_runner import EXIT_DONE, print_result, show_progress
from yid_ocp.workflow.commented_config import ObjectDescription, commented_config_text
from yid_ocp.workflow.config_proposal import (
    BranchDescription,
    ConfigProposal,
    propose_config,
    relative_posix_path,
    rest_split_time,
)
from yid_ocp.workflow.import_recording import is_recording_file, read_foreign_recording, reader_options_from_arguments

_RESULT_FORMAT = "yid-init/1"
_SCHEMA_FILE = "yid-ocp.schema.json"
_DEFAULT_LINKS = {"cable": 8, "beam": 6, "tree": 4, "foam_y": 4}
_REQUIRED_OPTIONS = {"cable": ("length", "mass", "radius"), "beam": ("length", "mass"), "tree": (), "foam_y": ()}
_OPTION_MEANINGS = {"length": "its length [m]", "mass": "its mass [kg]", "radius": "its radius [m]"}


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
        item.branches,
        holder=arguments.holder,
        grasps=_grasps(arguments.grasp),
        standing=item.kind == "foam_y",
    )
    made = _split(made, recordings, proposal, out)
    _refuse_existing([out, *(file for file, raw in made.items() if raw is not None)], arguments.replace)
    imports = reader_options_from_arguments(arguments)
    robot = arguments.robot
    where = robot if robot.startswith(("package:", "default:")) else relative_posix_path(robot, out.parent)
    files = [relative_posix_path(file, out.parent) for file in made]
    text = commented_config_text(where, item, proposal, files, imports, _SCHEMA_FILE)
    _write(out, text, {file: raw for file, raw in made.items() if raw is not None})
    result = {"format": _RESULT_FORMAT, "configuration": str(out), "recordings": files, "proposal": proposal.to_dict()}
    print_result(arguments, result, lambda: _summary_lines(proposal, out), f"configuration: {out}", str(out))
    return EXIT_DONE


# -- what was asked ---------------------------------------------------------------------------------------------------


def _object_from_arguments(arguments: argparse.Namespace) -> ObjectDescription:
    """Object description from the command-line options."""
    kind = arguments.object
    links = _DEFAULT_LINKS[kind] if arguments.links is None else arguments.links
    if not 1 <= links <= 64:
        raise ConfigError(f"the object has {links} links", where="--links", allowed="1 to 64")
    if kind == "foam_y":
        return ObjectDescription(kind, (), links)
    for name in ("length", "mass", "radius"):
        value = getattr(arguments, name)
        if value is not None and not 0 < value < float("inf"):
            raise ConfigError(f"the {name} is {value:g}", where=f"--{name}", allowed="a number above 0")
    if arguments.branch:
        if kind != "tree":
            raise ConfigError(f"a {kind} has no branches", where="--branch", allowed="--object tree")
        return ObjectDescription(kind, _grown([_branch(text) for text in arguments.branch]), links)
    needed = ("length", "mass", "radius") if kind == "tree" and arguments.branches else _REQUIRED_OPTIONS[kind]
    section = _numbers(arguments.section, 2, "--section") if arguments.section else None
    for name in needed:
        if getattr(arguments, name) is None:
            what = f"each branch of a tree needs a {name}" if kind == "tree" else f"a {kind} needs a {name}"
            raise ConfigError(what, where=f"--{name}", allowed=_OPTION_MEANINGS[name], hint=f"add --{name} NUMBER")
    if kind == "tree" and not arguments.branches:
        allowed = "--branch NAME=LENGTH,MASS,RADIUS[,ROLL,PITCH,YAW] for each, or --branches NUMBER of equal ones"
        advice = "--branches 4 --length 0.4 --mass 0.03 --radius 0.008"
        raise ConfigError("a tree needs branches", where="--branch", allowed=allowed, hint=advice)
    if kind == "beam" and section is None and arguments.radius is None:
        hint = "add --radius NUMBER, or --section WIDTH,HEIGHT"
        raise ConfigError(
            "a beam needs a radius or a section", where="--radius", allowed=_OPTION_MEANINGS["radius"], hint=hint
        )
    size = None if section is None else (section[0], section[1])
    if kind != "tree":
        radius = None if size else arguments.radius
        return ObjectDescription(
            kind, (BranchDescription(kind, arguments.length, arguments.mass, radius, size),), links
        )
    return ObjectDescription(kind, _star(arguments.branches, arguments.length, arguments.mass, arguments.radius), links)


def _star(count: int, length: float, mass: float, radius: float) -> tuple[BranchDescription, ...]:
    """Equal branches across the z axis of what holds them, the first one along its x axis."""
    if not 1 <= count <= 16:
        raise ConfigError(f"the tree has {count} branches", where="--branches", allowed="1 to 16")
    quarter = 1.5707963
    return tuple(
        BranchDescription(f"b{i + 1}", length, mass, radius, rpy=(0.0, quarter, round(4 * quarter * i / count, 7)))
        for i in range(count)
    )


def _grown(branches: Sequence[BranchDescription]) -> tuple[BranchDescription, ...]:
    """The branches, each with a name of its own and on one that comes before it."""
    names: list[str] = []
    for branch in branches:
        if branch.name in names:
            raise ConfigError(f"two branches are called '{branch.name}'", where="--branch", allowed="a name for each")
        if branch.parent is not None and branch.parent not in names:
            what = f"branch '{branch.name}' grows on '{branch.parent}', which does not come before it"
            raise ConfigError(what, where="--branch", allowed=", ".join(names) or "the holder alone")
        names.append(branch.name)
    return tuple(branches)


def _branch(text: str) -> BranchDescription:
    said, equals, numbers = text.partition("=")
    name, at, parent = said.partition("@")
    shape = "NAME=LENGTH,MASS,RADIUS, or with ROLL,PITCH,YAW; NAME@PARENT grows on the end of PARENT"
    count = len(numbers.split(","))
    if not (name and equals) or (at and not parent) or count not in (3, 6):
        raise ConfigError(f"'{text}' describes no branch", where="--branch", allowed=shape)
    values = _numbers(numbers, count, "--branch")
    if min(values[:3]) <= 0:
        raise ConfigError(f"'{text}' has a size that is not above 0", where="--branch", allowed=shape)
    turn = (values[3], values[4], values[5]) if count == 6 else (0.0, 0.0, 0.0)
    return BranchDescription(name, values[0], values[1], values[2], rpy=turn, parent=parent or None)


def _numbers(text: str, count: int, flag: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(abs(value) < float("inf") for value in values):
        raise ConfigError(f"'{text}' is not {count} numbers", where=flag, allowed=f"{count} numbers with commas")
    return values


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

"""The command `init`: write a commented configuration from robot, recordings and object dimensions."""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import shlex
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

from yid_ocp.config.reader import load_config
from yid_ocp.config.schema import config_json_schema, option_info_from_annotation
from yid_ocp.data import Recording, read_recording, write_recording
from yid_ocp.data.foreign_formats import ESTIMATED_WRENCH_GROUP_NAME
from yid_ocp.data.readers import READERS
from yid_ocp.display import Progress, abbreviated_names_text
from yid_ocp.errors import ConfigError, DataError, OutputError, nearest_name_question, unknown_name_error_arguments
from yid_ocp.files import atomic_write, write_text
from yid_ocp.model.objects.base import (
    MATERIAL_DENSITIES,
    InitialObjectSettings,
    object_factories_for_init,
    parse_comma_separated_numbers,
)
from yid_ocp.model.servos_and_springs import MOTOR_PRESETS
from yid_ocp.model.urdf import read_urdf
from yid_ocp.options import class_options_by_key
from yid_ocp.report.animation import measured_motion_animation
from yid_ocp.report.html import write_report
from yid_ocp.report.sections import ReportData
from yid_ocp.report.terminal import TableRows, aligned_table_lines
from yid_ocp.version import package_version
from yid_ocp.workflow import import_recording
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.command_runner import EXIT_DONE, print_result, stderr_progress_display
from yid_ocp.workflow.config_proposal import ProposedConfigChoices, held_out_split_time, propose_config_choices

_SCHEMA_FILE = "yid-ocp.schema.json"


def run_and_return_exit_code(arguments: argparse.Namespace) -> int:
    """Run the command `init` and return its exit code."""
    out, robot = Path(arguments.out), arguments.robot
    if out.suffix not in (".yaml", ".yml"):
        hint = f"write --out {out.parent / (out.stem + '.yaml')}"
        raise ConfigError(f"'{out.name}' does not end in .yaml", where="--out", allowed=".yaml or .yml", hint=hint)
    if Path(robot).suffix.lower() in READERS:
        robots = (f for f in arguments.files if f.startswith("package:") or f.endswith((".urdf", ".xml")))
        first = next(robots, "ROBOT.urdf")
        order = shlex.join([first, robot, *(file for file in arguments.files if file != first)])
        what, allowed = f"{Path(robot).name} is a recording, not a robot", "a URDF or MJCF file, or package:NAME"
        hint = f"give the robot first: yid-ocp init {order} --out {out}"
        raise ConfigError(what, where=f"yid-ocp init {robot}", allowed=allowed, hint=hint)
    read_urdf(robot)
    item = _object_from_arguments(arguments)
    with stderr_progress_display(arguments) as progress:
        made = _recordings(arguments, out, progress)
    recordings = [recording or read_recording(file) for file, recording in made.items()]
    options = import_recording.reader_options_from_arguments(arguments)
    lines, is_severe = _issue_lines(arguments.files, options, made.values(), recordings)
    segments, grasps = [] if item is None else item.settings.segment_definitions(), _grasps(arguments.grasp)
    asked = {"holder": arguments.holder, "grasps": grasps, "standing": item is not None and item.stands_in_world}
    proposal = propose_config_choices(robot, recordings, segments, **asked)
    made = _split(made, recordings, proposal, out)
    written = {file: raw for file, raw in made.items() if raw is not None}
    for file in (out, out.with_suffix(".html"), *written):
        if file.exists() and not arguments.replace:
            hint = "add --replace to overwrite it, or choose another --out"
            allowed = "files that do not exist yet, or --replace"
            hint = f"to use it again, give {file} as the recording; or {hint}" if file in written else hint
            what = f"{file.name} already exists, and `init` would write it"
            raise OutputError(what, where=str(file), allowed=allowed, hint=hint)

    def near(path: str | Path) -> str:
        return Path(os.path.relpath(Path(path).resolve(), out.parent.resolve())).as_posix()

    files, where = list(map(near, made)), robot if robot.startswith(("package:", "default:")) else near(robot)
    about = f"{'An arm of position servos' if proposal.arm_mode == 'servo' else 'The arm'}, {where}, with a payload."
    about = about if item is None else f"A {arguments.object.replace('_', ' ')} moved by {where}."
    _write(out, _config_text(where, about, item, proposal, files, options), written)
    result: dict[str, Any] = {"format": "yid-init/1", "configuration": str(out), "recordings": files}
    result["proposal"] = asdict(proposal)
    result["picture"] = _write_picture(out, _with_points_at_frames(recordings[0], proposal), result)
    lines += _summary_lines(proposal, out, recordings, result["picture"] is not None, is_severe)
    end = f"configuration: {out}{''.join(f', recording: {file}' for file in written)}"
    print_result(arguments, result, lambda: lines, end, str(out))
    return EXIT_DONE


def _object_from_arguments(arguments: argparse.Namespace) -> InitialObjectSettings | None:
    """Return the object that the options describe, None without --object. Raises `ConfigError` for invalid numbers."""
    templates, word = object_factories_for_init(), arguments.object
    if word is None:
        for name in ("length", "mass", "radius", "section", "links", "number", "branch", "branches", "grasp"):
            if getattr(arguments, name):
                what, hint = f"--{name} needs --object", f"add --object cable or another kind, or leave --{name} out"
                raise ConfigError(what, where=f"--{name}", allowed=f"with --object {', '.join(templates)}", hint=hint)
        return None
    if (template := templates.get(word)) is None:
        hint = "write cable for a rope, beam for a rod (a configuration calls it `segments`), or leave --object out"
        said = unknown_name_error_arguments(word, templates, hint)
        raise ConfigError(f"there is no object '{word}'", where="--object", **said)
    links = template.default_links if arguments.links is None else arguments.links
    if not 1 <= links <= 64:
        what, hint = f"--links is {links}, but must be from 1 to 64", f"leave --links out for {template.default_links}"
        raise ConfigError(what, where="--links", allowed="a whole number from 1 to 64", hint=hint)
    numbers, known = {name: getattr(arguments, name) for name in ("length", "mass", "radius")}, template.further_numbers
    for text in arguments.number:
        name, equals, value = text.partition("=")
        if name not in known or not equals:
            allowed = ", ".join(f"{key}=NUMBER, {words}" for key, words in known.items())
            what = f"--number is '{text}', which is not a NAME=NUMBER of the object '{word}'"
            hint = f"write {name}=0.1" if name in known else nearest_name_question(name, known) or "leave it out"
            raise ConfigError(what, where="--number", allowed=allowed or "none", hint=hint)
        numbers[name] = parse_comma_separated_numbers(value, 1, "--number")[0]
    for name, number in ((n, x) for n, x in numbers.items() if x is not None and not 0 < x < math.inf):
        unit = "kg" if name == "mass" else "m" if name in ("length", "radius") else "SI unit"
        what, flag = f"the {name} is {number:g}, not above 0", f"--number {name}=" if name in known else f"--{name} "
        allowed, hint = f"a number above 0 [{unit}]", f"measure it, and write {flag}NUMBER"
        raise ConfigError(what, where=flag.strip(" ="), allowed=allowed, hint=hint)
    given = {**numbers, **{name: getattr(arguments, name) for name in ("section", "branch", "branches")}}
    if given["radius"] and given["section"]:
        what, hint = "--radius and --section are both given", "leave --radius out for a rectangular cross section"
        raise ConfigError(what, where="--radius, --section", allowed="one of the two", hint=hint)
    if given["branch"] and not template.has_branches:
        what, hint = f"the object '{word}' has no branches", "write --object tree, or leave --branch out"
        raise ConfigError(what, where="--branch", allowed="--branch with --object tree", hint=hint)
    item = template.build({name: value for name, value in given.items() if value}, links)
    if what := item.settings.implausible_density_text:
        allowed = "{:g} (foam) to {:g} kg/m^3 (tungsten)".format(*MATERIAL_DENSITIES)
        hint = "give the mass in kg, and lengths and radii in m"
        raise ConfigError(what, where="--mass, --length, --radius", allowed=allowed, hint=hint)
    return item


def _grasps(given: Sequence[str]) -> dict[str, str]:
    grasps = {}
    for text in given:
        frame, equals, point = text.partition("=")
        if not (frame and equals and point):
            hint, allowed = "write for example --grasp tool0=w_cable", "a frame of the robot = a point of the object"
            raise ConfigError(f"'{text}' is not FRAME=POINT", where="--grasp", allowed=allowed, hint=hint)
        grasps[frame] = point
    return grasps


def _recordings(arguments: argparse.Namespace, out: Path, progress: Progress) -> dict[Path, Recording | None]:
    options, made = import_recording.reader_options_from_arguments(arguments), dict[Path, Recording | None]()
    for file in map(Path, arguments.files):
        if not import_recording.has_native_recording_suffix(file):
            recording = import_recording.read_third_party_recording(file, options, progress)
            made[out.parent / f"{recording.name}.h5"] = recording
        elif options:
            what = f"{file.name} is a recording already, so options of the import do not apply to it"
            where, allowed = ", ".join(map(import_recording._flag, options)), "options with files of other formats"
            raise ConfigError(what, where=where, allowed=allowed, hint="give the original file in place of this one")
        else:
            made[file] = None
    if len(made) < len(arguments.files):
        what, where = "two of the files have the same name, apart from folder and ending", ", ".join(arguments.files)
        raise DataError(what, where=where, allowed="files with different names", hint="rename one of the two files")
    return made


def _issue_lines(
    files: Sequence[str], options: Mapping[str, Any], new: Iterable[Recording | None], recordings: Sequence[Recording]
) -> tuple[list[str], bool]:
    """Lines on issues, and whether one is severe. `new` is not None for files of other tools. All must have joints."""
    lines, is_severe = list[str](), False
    joints = next((file for file, own in zip(files, recordings, strict=True) if own.joints is not None), "JOINTS")
    for file, made, recording in zip(files, new, recordings, strict=True):
        if recording.joints is None:
            what, allowed = f"recording '{recording.name}' has no joint angles", "recordings with joint states"
            command = import_recording.import_command_line([joints, file], options)
            hint = f"merge it with the joints of its run, and give `init` the result: {command}"
            raise ConfigError(what, where=file, allowed=allowed, hint=hint)
        hint = "import the original file again with --units {}, and give the result in place of this one"
        hint = hint if made is None else "repeat this command with --units {} --replace"
        own, is_own_severe = import_recording.recording_issue_lines(recording, hint)
        lines, is_severe = [*lines, *filter(None, own)], is_severe or is_own_severe
    return lines, is_severe


def _split(
    made: dict[Path, Recording | None], recordings: Sequence[Recording], proposal: ProposedConfigChoices, out: Path
) -> dict[Path, Recording | None]:
    """Split a single recording at a standstill into a part to estimate on and a held-out part, with their files."""
    time = held_out_split_time(recordings[0], proposal.joints) if len(recordings) == 1 else None
    if time is None:
        return made
    [whole] = recordings
    clocks = [group.t for group in whole.joint_and_point_groups]
    first, last = min(t[0] for t in clocks), max(t[-1] for t in clocks)
    parts: dict[Path, Recording | None] = {}
    for role, begin, end in (("estimate", first, time), ("held_out", time, last)):
        name, note = f"{whole.name}_{role}", f"of {whole.source or whole.name}, from {begin:.6g} s to {end:.6g} s"
        parts[out.parent / f"{name}.h5"] = replace(whole.time_slice(begin, end), name=name, notes=(*whole.notes, note))
    return parts


def _write(out: Path, text: str, made: Mapping[Path, Recording]) -> None:
    """Write recordings, configuration and schema. If the configuration cannot be loaded, none of them remains."""
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


def _summary_lines(
    proposal: ProposedConfigChoices, out: Path, recordings: Sequence[Recording], has_picture: bool, is_severe: bool
) -> list[str]:
    held = list(dict.fromkeys([proposal.holder_frame, *proposal.grasps]))
    others = [frame for frame in proposal.arms[0].tool_frames if frame not in held][:8]
    carried = "object" if proposal.has_object else "payload (estimated, as no --object is given)"
    unused = {"recorded, but not used": proposal.unused_joints, "not recorded": proposal.unrecorded_joints}
    rest = "; ".join(f"{words}: {abbreviated_names_text(names)}" for words, names in unused.items() if names)
    rows: TableRows = [
        ("setting", "choice", "reason, or other choices"),
        ("model.arms.joints", abbreviated_names_text(proposal.joints, math.inf), rest),
        (f"frame of the {carried}", ", ".join(held), f"other choices for --holder: {', '.join(others)}" * bool(others)),
        ("model.arms.mode", proposal.arm_mode, proposal.arm_mode_reason),
        ("problem.initial_state", proposal.initial_state, proposal.initial_state_reason),
    ]
    if damping := proposal.urdf_joint_damping:
        reason = f"of {abbreviated_names_text([*damping], math.inf)}, as the robot file states"
        rows.append(("model.damping", f"{_number_or_numbers_by_name(damping, 4)} N m s/rad", reason))
    lines = aligned_table_lines(rows)
    told = [f"sensors.{group}: {s}" for group, own in proposal.point_placements.items() for s in _place_sentences(own)]
    lost = [f"warning: {text}" for text in told if "`init` leaves out" in text or "too far" in text]
    for group, own in proposal.point_placements.items() if proposal.has_object else ():
        if "." not in group and own and {place.frame for place in own} <= {"", proposal.holder_frame}:
            frames, use = f"sensors.{group}.frame_by_recorded_name: {{POINT: FRAME}}", f"sensors.{group}.use: false"
            said = f"no point of the group {group} is on the object. If its places are right, set {frames} or {use}"
            lost.append(f"warning: {said}")
    where = f" in the picture {out.with_suffix('.html')}" * has_picture
    head = f"`init` chose these settings. Check them{where}:"
    lines = [*lost, head, *(f"  {text}" for text in lines + told if f"warning: {text}" not in lost)]
    lines += dict.fromkeys(f"note: {note}" for recording in recordings for note in recording.notes)
    has_efforts, quoted = "joints.effort" in proposal.noise_by_group, shlex.quote(str(out))
    is_left_out = has_efforts and proposal.arm_mode == "prescribed" and not proposal.is_identified_from_efforts_only
    unseen = "Recorded torques are not used. To let `diagnose` find friction and payload of the arm too, set "
    lines += [f"{unseen}sensors.joints.effort.use: true."] * is_left_out
    then = f"next: {'follow the warnings, then ' * bool(lost)}yid-ocp check {quoted}, then yid-ocp solve {quoted}"
    lines += ["", import_recording.DO_NOT_USE.format(out) if is_severe else then]
    if (has_efforts or proposal.arm_mode == "servo") and len(recordings) > 1 and not is_severe:
        more = " --set sensors.joints.effort.use=true" * is_left_out
        lines.append(f"to estimate the friction of the arm's joints: yid-ocp friction {quoted}{more}")
    return [*lines, ""]


def _place_sentences(places: Iterable[Any]) -> list[str]:
    """Return a sentence on the frame of points, or of sensors. Those with the same frame and reason share it."""
    points = dict[tuple[str, str], list[str]]()
    for own in sorted(places, key=lambda place: bool(place.frame)):
        place = f" to the frame {own.frame} of the model" if own.frame else ""
        words = " to the frame of the same name" if own.frame == own.point else f"{place}, because {own.reason}"
        points.setdefault(("assigns" if own.frame else "leaves out", words), []).append(own.point)
    named = ((does, words, abbreviated_names_text(own, math.inf)) for (does, words), own in points.items())
    return [f"`init` {does} recorded {names}{words}" for does, words, names in named]


def _with_points_at_frames(recording: Recording, proposal: ProposedConfigChoices) -> Recording:
    """Return the recording with points renamed to the frames at which they probably are."""
    points = []
    for group in recording.points:
        placed = proposal.point_placements.get(group.name, ())
        places = {place.point: place.model_frame or place.point for place in placed}
        names = tuple(places.get(name, name) for name in group.names)
        points.append(replace(group, names=names) if len(set(names)) == len(names) else group)
    return replace(recording, points=tuple(points))


def _write_picture(out: Path, recording: Recording, result: Mapping[str, Any]) -> str | None:
    """Write a page with the recorded motion, undeformed object, frames and points. Returns its path if there is one."""
    run, page = load_config(out), out.with_suffix(".html")
    values = (system := build_system(run)).parameters.vector()
    scenes = measured_motion_animation(recording.name, system, values, recording, has_straight_object=True)
    if not scenes:
        return None
    title = f"{out.stem}: what init guessed"
    data = ReportData(title, run.description, result, animations=scenes, robot=run.model.robot)
    return str(page) if write_report(page, data) else None


_PLAIN_TEXT = re.compile(r"[A-Za-z_/][\w./@-]*")  # text that YAML reads unchanged
_YAML_KEYWORDS = ("true", "false", "null", "yes", "no", "on", "off")
_COMMENT_MARK, _COMMENT_COLUMN = "  ## ", 44
_ALWAYS_WRITTEN_SETTINGS = ("kind", "links")


def _config_text(
    robot: str,
    about: str,
    item: InitialObjectSettings | None,
    proposal: ProposedConfigChoices,
    recordings: Sequence[str],
    imports: Mapping[str, Any],
) -> str:
    """Return the configuration as YAML text, with a comment on the line of every setting or above it."""
    import jinja2  # slow to import

    loader = jinja2.PackageLoader("yid_ocp.workflow")
    environment = jinja2.Environment(loader=loader, undefined=jinja2.StrictUndefined, trim_blocks=True)
    environment.filters |= {"yaml": _value, "wrapped": _wrapped_list, "number": _number}
    environment.filters["sentences"] = _place_sentences
    environment.filters["settings"] = lambda settings: "\n".join(_settings_lines("    ", settings))
    known: dict[str, Any] = {"about": about, "robot": robot, "item": item, "files": recordings, "imports": imports}
    known |= {"p": proposal, "sensors": _sensors(proposal), "motors": list(MOTOR_PRESETS)}
    known |= {"schema": _SCHEMA_FILE, "version": package_version()}
    known |= {} if item is None else _of_object(item, proposal)
    text, width = environment.get_template("init.yaml.jinja").render(known), _COMMENT_COLUMN - 2
    parts = (line.partition(_COMMENT_MARK) for line in text.splitlines())
    lines = (f"{own.rstrip():<{width}}  # {comment}" if comment else own.rstrip() for own, _, comment in parts)
    return "".join(f"{line}\n" for line in lines)


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{_value(str(k))}: {_value(v)}' for k, v in value.items())}}}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_value, value))}]"
    if not isinstance(value, str):
        return json.dumps(value)
    plain = _PLAIN_TEXT.fullmatch(value) and value.lower() not in _YAML_KEYWORDS
    return value if plain else json.dumps(value, ensure_ascii=False).replace(_COMMENT_MARK, "  \\u0023# ")


def _number(value: float) -> str:
    text = f"{value:.2g}"
    return text if "e" not in text or "." in text.partition("e")[0] else text.replace("e", ".0e")


def _number_or_numbers_by_name(value: float | Mapping[str, float], digits: int = 2) -> str:
    """Return one number if all are equal to so many digits, else a mapping."""
    if not isinstance(value, Mapping):
        return _number(value)
    rounded = {name: float(f"{number:.{digits}g}") for name, number in value.items()}
    return _value(rounded) if len(set(rounded.values())) > 1 else _number(next(iter(rounded.values())))


def _wrapped_list(values: Iterable[str], column: int) -> str:
    """Return a YAML list; a long one has several lines, which begin at `column`."""
    rows = textwrap.wrap(", ".join(map(_value, values)), 91, break_long_words=False, break_on_hyphens=False)
    return "[" + f"\n{' ' * column}".join(rows) + "]"


def _of_object(item: InitialObjectSettings, proposal: ProposedConfigChoices) -> dict[str, Any]:
    """Return values for the template: dampings of the object, frames of uncertain points, and all measured frames."""
    tips = [f"w_{segment.name}" for segment in item.settings.segment_definitions()]
    of_points = [places for group, places in proposal.point_placements.items() if "." not in group]
    marked = [place for places in of_points for place in places if place.frame]
    wanted = dict.fromkeys([*tips, *(place.model_frame for place in marked), *proposal.grasps.values()])
    unsure = [(place, float(f"{place.position_std:.2g}")) for place in marked if place.position_std > 0]
    uncertain = {
        place.point: {"parent_frame": place.frame} | ({"xyz": place.xyz} if place.xyz else {}) | {"position_std": std}
        for place, std in unsure
    }
    dampings = [value for name, (value, _) in item.start_values.items() if name.endswith(".damping")]
    return {"dampings": dampings, "uncertain": uncertain, "points": wanted if set(wanted) > set(tips) else ()}


def _settings_lines(indent: str, settings: Any) -> Iterator[str]:
    """Yield YAML lines of the settings that differ from their defaults (and of a few others), with descriptions."""
    for key, option in class_options_by_key(cast(Any, type(settings))).items():
        value = getattr(settings, option.field_name)
        if key == "mount" or (value == option.default_value and key not in _ALWAYS_WRITTEN_SETTINGS):
            continue
        if isinstance(value, Mapping):
            yield f"{indent}{key}:"
            for name, entry in value.items():
                yield f"{indent}  {_value(name)}:"
                yield from _settings_lines(f"{indent}    ", entry)
            continue
        about = option_info_from_annotation(option.type_hint)
        comment = about.description + (f" [{about.unit}]" if about.unit else "")
        numbers = [float(f"{x:.8g}") for x in value] if isinstance(value, tuple) else value
        yield f"{indent}{key}: {f'{value:g}' if isinstance(value, float) else _value(numbers)}{_COMMENT_MARK}{comment}"


def _sensors(proposal: ProposedConfigChoices) -> Iterator[tuple[str, list[str], str, Sequence[Any]]]:
    """Yield every sensor group with its settings as YAML, their reason, and the places of its points."""
    for group, noise in proposal.noise_by_group.items():
        places, entries, unused = proposal.point_placements.get(group, ()), list[str](), ""
        said = f"noise {noise.reason}"
        if noise.std is not None:
            size = "each joint" if isinstance(noise.std, Mapping) else f"{noise.std:.2g} {noise.unit}"
            entries, said = [f"std: {_number_or_numbers_by_name(noise.std)}"], f"noise of {size}, {noise.reason}"
        elsewhere = (place for place in places if place.model_frame not in ("", place.point))
        if frames := {place.point: place.frame for place in elsewhere}:
            entries.append(f"frame_by_recorded_name: {_value(frames)}")
        if group == "joints.effort":
            if proposal.torque_bias_std and not proposal.is_identified_from_efforts_only:
                entries.append(f"bias_std: {_number_or_numbers_by_name(proposal.torque_bias_std)}")
                said += ". bias_std is the expected constant error of a torque (a guess: 1 % of its limit in the robot "
                said += "file, but at most 20 % of the largest recorded one; without a limit 5 % of it)"
            if proposal.arm_mode == "prescribed" and not proposal.is_identified_from_efforts_only:
                unused = f"false: the object is estimated without torques; true: friction is found, too; {said}"
        is_mounted = places and "." in group
        if places and not (proposal.has_object or is_mounted or any(place.frame for place in places)):
            unused = "not used, because the frames of its points are unknown. To use it, set "
            unused += "{frame_by_recorded_name: {POINT: FRAME}, use: true}"
        if is_mounted and (proposal.arm_mode == "driven" or not all(place.frame for place in places)):
            why = "torques with noise move the arm. To use it, set model.arms.mode: prescribed and use: true here"
            unused = f"not used, because {why if proposal.arm_mode == 'driven' else 'its frame is unknown, see below'}"
        elif group.startswith(ESTIMATED_WRENCH_GROUP_NAME):
            unused = "not used: the robot's driver computes it from joint torques. Use it only in place of efforts"
        yield group, ["use: false"] * bool(unused) + entries, unused or said, places

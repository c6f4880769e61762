"""The command `init`: write a commented configuration from robot, recordings and object dimensions."""

from __future__ import annotations

import argparse
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from yid_ocp.config.reader import load_config
from yid_ocp.config.schema import config_json_schema
from yid_ocp.data import Recording, read_recording, write_recording
from yid_ocp.data.foreign_formats import ESTIMATED_WRENCH_GROUP_NAME
from yid_ocp.display import Progress
from yid_ocp.errors import ConfigError, DataError, OutputError, unknown_name_error_arguments
from yid_ocp.files import atomic_write, write_text
from yid_ocp.model.objects.base import InitCommandObject, init_command_object_factories, parse_comma_separated_numbers
from yid_ocp.model.servos_and_springs import MOTOR_PRESETS
from yid_ocp.model.urdf import read_urdf
from yid_ocp.options import OptionInfo, dataclass_options, split_annotated
from yid_ocp.problem.recorded_inputs import effect_kinds_without_recorded_signals
from yid_ocp.report.animation import recording_animation
from yid_ocp.report.html import write_report
from yid_ocp.report.sections import ReportData
from yid_ocp.version import package_version
from yid_ocp.workflow import import_recording
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.command_runner import EXIT_DONE, print_result, stderr_progress_display
from yid_ocp.workflow.config_proposal import ProposedConfigChoices, held_out_split_time, propose_config_choices

_SCHEMA_FILE = "yid-ocp.schema.json"


def run_from_arguments(arguments: argparse.Namespace) -> int:
    """Run the command `init` and return its exit code."""
    out, robot = Path(arguments.out), arguments.robot
    if out.suffix not in (".yaml", ".yml"):
        hint = f"write --out {out.stem}.yaml"
        raise ConfigError(f"the file name is '{out.name}'", where="--out", allowed="NAME.yaml", hint=hint)
    read_urdf(robot)
    item = _object_from_arguments(arguments)
    with stderr_progress_display(arguments) as progress:
        made = _recordings(arguments, out, progress)
    recordings = [recording or read_recording(file) for file, recording in made.items()]
    segments, grasps = [] if item is None else item.settings.build_segments(), _grasps(arguments.grasp)
    asked = {"holder": arguments.holder, "grasps": grasps, "standing": item is not None and item.stands_in_world}
    proposal = propose_config_choices(robot, recordings, segments, **asked)
    made = _split(made, recordings, proposal, out)
    written = {file: raw for file, raw in made.items() if raw is not None}
    for file in (out, out.with_suffix(".html"), *written):
        if file.exists() and not arguments.replace:
            hint = "choose another --out, or add --replace"
            raise OutputError("the file already exists", where=str(file), allowed="a new file", hint=hint)

    def near(path: str | Path) -> str:
        return Path(os.path.relpath(Path(path).resolve(), out.parent.resolve())).as_posix()

    files, where = list(map(near, made)), robot if robot.startswith(("package:", "default:")) else near(robot)
    options = import_recording.reader_options_from_arguments(arguments)
    about = f"{'An arm of position servos' if proposal.arm_mode == 'servo' else 'The arm'}, {where}, with a payload."
    about = about if item is None else f"A {arguments.object.replace('_', ' ')} moved by {where}."
    lines = _config_lines(where, about, item, proposal, files, options)
    _write(out, "\n".join(lines) + "\n", written)
    result: dict[str, Any] = {
        "format": "yid-init/1",
        "configuration": str(out),
        "recordings": files,
        "proposal": proposal.to_dict(),
    }
    result["picture"] = _write_picture(out, _with_points_at_frames(recordings[0], proposal), result)
    doubts = [line for own in recordings for line in import_recording.recording_issue_lines(own) if line]
    print_result(
        arguments,
        result,
        lambda: [*_summary_lines(proposal, out, recordings, result["picture"] is not None), *doubts],
        f"configuration: {out}",
        str(out),
    )
    return EXIT_DONE


def _object_from_arguments(arguments: argparse.Namespace) -> InitCommandObject | None:
    """The described object, if any. `ConfigError`, with the option, if a number is missing or impossible."""
    templates, word = init_command_object_factories(), arguments.object
    if word is None:
        for name in ("length", "mass", "radius", "section", "links", "number", "branch", "branches", "grasp"):
            if getattr(arguments, name):
                what, hint = f"--{name} needs --object", f"add --object KIND, or leave --{name} out"
                raise ConfigError(what, where=f"--{name}", allowed=f"with --object {', '.join(templates)}", hint=hint)
        return None
    if word not in templates:
        said = unknown_name_error_arguments(word, templates)
        raise ConfigError(f"there is no object '{word}'", where="--object", **said)
    template = templates[word]
    links = template.default_links if arguments.links is None else arguments.links
    if not 1 <= links <= 64:
        raise ConfigError(f"the object has {links} links", where="--links", allowed="a whole number from 1 to 64")
    numbers = {name: getattr(arguments, name) for name in ("length", "mass", "radius")}
    for text in arguments.number:
        name, equals, value = text.partition("=")
        if name not in template.further_numbers or not equals:
            allowed = ", ".join(f"{key}=NUMBER, {words}" for key, words in template.further_numbers.items())
            what = f"'{text}' is not an additional number of a {word}"
            raise ConfigError(what, where="--number", allowed=allowed or "none", hint="leave it out")
        numbers[name] = parse_comma_separated_numbers(value, 1, "--number")[0]
    for name, number in numbers.items():
        if number is not None and not 0 < number < float("inf"):
            unit = "kg" if name == "mass" else "m" if name in ("length", "radius") else "SI unit"
            raise ConfigError(f"the {name} is {number:g}", where=f"--{name}", allowed=f"a number above 0 [{unit}]")
    given = {**numbers, **{name: getattr(arguments, name) for name in ("section", "branch", "branches")}}
    if given["branch"] and not template.has_branches:
        what, hint = f"a {word} has no branches", "set --object tree, or leave --branch out"
        raise ConfigError(what, where="--branch", allowed="with --object tree", hint=hint)
    return template.build({name: value for name, value in given.items() if value}, links)


def _grasps(given: Sequence[str]) -> dict[str, str]:
    grasps = {}
    for text in given:
        frame, equals, point = text.partition("=")
        if not (frame and equals and point):
            hint = "write for example --grasp tool0=w_cable"
            raise ConfigError(f"'{text}' is not FRAME=POINT", where="--grasp", allowed="FRAME=POINT", hint=hint)
        grasps[frame] = point
    return grasps


def _recordings(arguments: argparse.Namespace, out: Path, progress: Progress) -> dict[Path, Recording | None]:
    options = import_recording.reader_options_from_arguments(arguments)
    made: dict[Path, Recording | None] = {}
    for file in map(Path, arguments.files):
        if not import_recording.has_native_recording_suffix(file):
            recording = import_recording.read_third_party_recording(file, options, progress)
            made[out.parent / f"{recording.name}.h5"] = recording
        elif options:
            what = f"{file.name} is already a recording, which takes no options of readers"
            where, allowed = ", ".join(map(import_recording._flag, options)), "options with files of other formats"
            raise ConfigError(what, where=where, allowed=allowed, hint="leave these options out")
        else:
            made[file] = None
    if len(made) < len(arguments.files):
        what, where = "two of the files have the same name", ", ".join(arguments.files)
        raise DataError(what, where=where, allowed="a name of its own for each", hint="rename one of them")
    return made


def _split(
    made: dict[Path, Recording | None], recordings: Sequence[Recording], proposal: ProposedConfigChoices, out: Path
) -> dict[Path, Recording | None]:
    """A single recording split in two files at an intermediate standstill; the second file is held out."""
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
    """Write recordings, configuration (loaded as a check before it gets its name) and schema; all or nothing."""
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
    proposal: ProposedConfigChoices, out: Path, recordings: Sequence[Recording], has_picture: bool
) -> list[str]:
    held = ", ".join(dict.fromkeys([proposal.holder_frame, *proposal.grasps]))
    lines = [
        f"joints: {', '.join(proposal.joints)}",
        f"held by: {held}",
        f"mode: {proposal.arm_mode}: {proposal.arm_mode_reason}",
        f"start: {proposal.initial_state}: {proposal.initial_state_reason}",
    ]
    for group, places in proposal.point_placements.items():
        lines += [f"{group}: {place.point} at {place.frame or '?'}, {place.reason}" for place in places]
    picture = [f"picture of the guesses: {out.with_suffix('.html')}"] if has_picture else []
    for signals, kinds in effect_kinds_without_recorded_signals(recordings).items():
        lines.append(f"diagnose does not try {', '.join(kinds)}: nothing was recorded of {signals}")
    lines += [*picture, "", f"next: yid-ocp check {out}, then yid-ocp solve {out}"]
    has_efforts = "joints.effort" in proposal.noise_by_group
    if (has_efforts or proposal.arm_mode == "servo") and len(recordings) > 1:
        is_left_out = has_efforts and proposal.arm_mode == "prescribed" and not proposal.is_identified_from_efforts
        more = " --set sensors.joints.effort.use=true" if is_left_out else ""
        lines.append(f"friction of the arm's joints: yid-ocp friction {out}{more}")
    return [*lines, ""]


def _with_points_at_frames(recording: Recording, proposal: ProposedConfigChoices) -> Recording:
    """The recording with points renamed to the frames at which they probably are."""
    points = []
    for group in recording.points:
        placed = proposal.point_placements.get(group.name, ())
        places = {place.point: place.model_frame or place.point for place in placed}
        names = tuple(places.get(name, name) for name in group.names)
        points.append(replace(group, names=names) if len(set(names)) == len(names) else group)
    return replace(recording, points=tuple(points))


def _write_picture(out: Path, recording: Recording, result: Mapping[str, Any]) -> str | None:
    """Page with the recorded arm motion, the undeformed object, marked frames and points. Returns its path, if any."""
    run, page = load_config(out), out.with_suffix(".html")
    system = build_system(run)
    scene = recording_animation(recording.name, system, system.parameters.vector(), recording, has_straight_object=True)
    if scene is None:
        return None
    known: dict[str, Any] = {"animations": [scene], "robot": run.model.robot}
    data = ReportData(f"{out.stem}: what init guessed", run.description, result, **known)
    return str(page) if write_report(page, data) else None


_PLAIN_TEXT = re.compile(r"[A-Za-z_/][\w./@-]*")  # text that YAML reads unchanged
_YAML_KEYWORDS = ("true", "false", "null", "yes", "no", "on", "off")
_COMMENT_COLUMN = 44
_ALWAYS_WRITTEN_SETTINGS = ("kind", "links")


def _config_lines(
    robot: str,
    about: str,
    item: InitCommandObject | None,
    proposal: ProposedConfigChoices,
    recordings: Sequence[str],
    imports: Mapping[str, Any],
) -> Iterator[str]:
    """Commented YAML lines; every setting has a comment on its line or the line above."""
    yield f"# yaml-language-server: $schema={_SCHEMA_FILE}"
    yield f"# Written by `yid-ocp init` {package_version()}. All may be changed; keys: docs/reference/settings.md."
    yield "# Each line ends with its evidence. Next: `yid-ocp check` on this file, then `yid-ocp solve`."
    yield _line("", "description", _text(about), "one sentence for the report")
    yield ""
    yield "model:"
    yield _line("  ", "robot", _text(robot), "URDF file, or package:NAME of example-robot-data")
    yield from _arms(proposal)
    if item is not None:
        yield from _object(item, proposal)
    yield from _friction(proposal)
    yield from _effects(proposal)
    yield ""
    yield from _recording_lines(recordings, imports)
    yield ""
    yield from _sensors(proposal)
    yield ""
    yield from _parameters(item, proposal)
    yield ""
    yield "problem:"
    step, cutoff = f"{proposal.time_step:g}", f"{proposal.path_cutoff:.3g}"
    yield _line("  ", "time_step", step, "[s]; `check` reports the effect of half of it")
    yield _line("  ", "initial_state", proposal.initial_state, proposal.initial_state_reason)
    yield _line("  ", "path_cutoff", cutoff, "low-pass of prescribed motion [Hz], above what the arm does")
    yield ""
    yield "solver:"
    yield _line("  ", "name", "gauss_newton", "multiple_shooting where it does not converge")


def _line(indent: str, key: str, value: str, comment: str = "") -> str:
    text = f"{indent}{key}: {value}".rstrip()
    return f"{text:<{_COMMENT_COLUMN - 2}}  # {comment}" if comment else text


def _text(value: str) -> str:
    plain = _PLAIN_TEXT.fullmatch(value) and value.lower() not in _YAML_KEYWORDS
    return value if plain else json.dumps(value, ensure_ascii=False)


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{_text(str(k))}: {_value(v)}' for k, v in value.items())}}}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_value, value))}]"
    return _text(value) if isinstance(value, str) else json.dumps(value)


def _number(value: float) -> str:
    text = f"{value:.2g}"
    return text if "e" not in text or "." in text.partition("e")[0] else text.replace("e", ".0e")


def _listed(indent: str, key: str, values: Iterable[str], comment: str) -> list[str]:
    """A key with a list, on several lines if one line is too long."""
    rows, row = [], ""
    for value in map(_text, values):
        if row and len(row) + len(value) > 90:
            rows.append(row)
            row = ""
        row += f"{value}, "
    rows.append(row)
    text = f",\n{indent}  {' ' * len(key)} ".join(entry.rstrip(", ") for entry in rows)
    return [f"{indent}# {comment}", f"{indent}{key}: [{text}]"]


def _arms(proposal: ProposedConfigChoices) -> Iterator[str]:
    unused, mode = proposal.unused_joints, proposal.arm_mode
    yield "  arms:"
    yield from _listed("    ", "joints", proposal.joints, "recorded joints that move the object")
    if unused:
        yield f"    # recorded too, but not needed for what holds the object: {', '.join(unused)}"
    if unused or not set(proposal.unrecorded_joints) <= set(proposal.joints):
        yield "    # all other joints of the URDF stay at zero; another value: locked_joints: {JOINT: VALUE} [rad or m]"
    yield _line("    ", "mode", mode, proposal.arm_mode_reason)
    other = "prescribed: the arm follows its encoders"
    if mode == "prescribed":
        other = "driven: its efforts move the arm, with a tracking filter; for reliable efforts"
    yield f"{' ' * _COMMENT_COLUMN}# {other}"
    if mode == "servo":
        yield _line("    ", "servo", "", "their gains, dampings, delays and limits are parameters, below")
        held = "until the next; interpolated: straight lines in between"
        yield _line("      ", "command_interpolation", "held", held)
        carried = "true if the controller compensates the arm's weight"
        yield _line("      ", "has_gravity_compensation", "false", carried)
        known = f"{{kind: dc, preset: {proposal.motor_preset or next(iter(MOTOR_PRESETS))}}}"
        words = "published figures to begin with"
        yield _line(
            "      ",
            "motor" if proposal.motor_preset else "# motor",
            known,
            f"{words}; one of {', '.join(MOTOR_PRESETS)}",
        )


def _object(item: InitCommandObject, proposal: ProposedConfigChoices) -> Iterator[str]:
    holder, grasps = proposal.holder_frame, proposal.grasps
    yield "  object:"
    if item.stands_in_world:
        yield "    # `mount: {parent_frame: FRAME, xyz: [x, y, z], rpy: [r, p, y]}` sets its place"
    else:
        frames = [name for arm in proposal.arms[:1] for name in arm.tool_frames if name != holder]
        yield "    # its root sits in this frame and leaves it along z, unless xyz [m] and rpy [rad] say else"
        yield f"    # other frames there: {', '.join(frames[:8]) or 'none'}"
        yield f"    mount: {{parent_frame: {_text(holder)}, xyz: [0.0, 0.0, 0.0], rpy: [0.0, 0.0, 0.0]}}"
    yield from _settings_lines("    ", item.settings)
    if grasps:
        yield _line("  ", "grasp", "", "further grasp: point 3, axis 5, weld 6 equations")
    for i, (frame, point) in enumerate(grasps.items()):
        yield f"    grasp_{i + 1}: {{holder_frame: {_text(frame)}, held_frame: {_text(point)}, kind: point}}"
    dampings = [value for name, (value, _) in item.start_values.items() if name.endswith(".damping")]
    if dampings:
        yield _line("  ", "damping", f"{{object: {max(dampings):.2g}}}", "initial value of the search [N m^2 s]")
    else:
        yield _line("  ", "damping", "0.05", "viscous, of every coordinate [N m s/rad]")
    tips = [f"w_{segment.name}" for segment in item.settings.build_segments()]
    of_points = [places for group, places in proposal.point_placements.items() if "." not in group]
    marked = [place for places in of_points for place in places if place.frame]
    wanted = dict.fromkeys([*tips, *(place.model_frame for place in marked), *grasps.values()])
    if uncertain := {place.point: place for place in marked if place.position_std > 0}:
        yield _line("  ", "frames", "", "where points sit [m]; NAME.x, .y and .z there are estimated, 0 ± position_std")
    for name, place in uncertain.items():
        there = {"parent_frame": place.frame, "position_std": float(f"{place.position_std:.2g}")}
        yield f"    {_text(name)}: {_value(there)}"
    if set(wanted) > set(tips):
        yield from _listed("  ", "measured_points", wanted, "frames for sensors; NAME:40% along a segment")


def _settings_lines(indent: str, settings: Any) -> Iterator[str]:
    """Settings that differ from their defaults or concern every reader, with their descriptions."""
    for key, option in dataclass_options(cast(Any, type(settings))).items():
        value = getattr(settings, option.field_name)
        if key == "mount" or (value == option.default_value and key not in _ALWAYS_WRITTEN_SETTINGS):
            continue
        if isinstance(value, Mapping):
            yield f"{indent}{key}:"
            for name, entry in value.items():
                yield f"{indent}  {_text(name)}:"
                yield from _settings_lines(f"{indent}    ", entry)
            continue
        about = next(m for m in reversed(split_annotated(option.type_hint)[1]) if isinstance(m, OptionInfo))
        comment = about.description + (f" [{about.unit}]" if about.unit else "")
        numbers = [float(f"{x:.8g}") for x in value] if isinstance(value, tuple) else value
        yield _line(indent, key, f"{value:g}" if isinstance(value, float) else _value(numbers), comment)


def _friction(proposal: ProposedConfigChoices) -> Iterator[str]:
    about = "of geared arms, its sizes free; `yid-ocp friction` tries every law of the ladder"
    moving = [name for name in proposal.joints if name not in proposal.still_joints]
    has_efforts = "joints.effort" in proposal.noise_by_group
    law = {"law": "load" if proposal.motor_preset else "coulomb"} | (
        {"joints": moving} if proposal.still_joints else {}
    )
    uses_efforts = has_efforts and (proposal.arm_mode == "driven" or proposal.is_identified_from_efforts)
    if proposal.motor_preset or (moving and uses_efforts):
        yield _line("  ", "friction", _value(law), about)
    elif proposal.arm_mode == "servo" or has_efforts:
        yield _line("  ", "# friction", "{law: coulomb}", about)


def _effects(proposal: ProposedConfigChoices) -> Iterator[str]:
    kinds: dict[str, str] = {}
    if proposal.arm_mode == "servo" or (proposal.is_identified_from_efforts and not proposal.has_object):
        kinds["rotor_inertia"] = "inertia of the rotors after their gears"
    if proposal.is_identified_from_efforts and "joints.effort" in proposal.noise_by_group:
        kinds["effort_offset"] = "the zero of every torque sensor"
    if not kinds:
        return
    yield _line("  ", "effects", "", f"{', '.join(kinds.values())}, free below")
    for kind in kinds:
        for joint in proposal.joints:
            if kind == "effort_offset" or proposal.arm_mode == "servo" or joint not in proposal.still_joints:
                yield f"    - {{kind: {kind}, location: {_text(joint)}}}"
    if not proposal.has_object:
        yield f"    - {{kind: payload, location: {_text(proposal.holder_frame)}}}   # what the arm holds"


def _recording_lines(files: Sequence[str], imports: Mapping[str, Any]) -> Iterator[str]:
    held = max(1, len(files) // 4) if len(files) > 1 else 0
    yield "recordings:"
    yield from _listed("  ", "estimate", files[: len(files) - held], "to estimate on")
    if held:
        yield from _listed("  ", "held_out", files[-held:], "only predicted, to test the model")
    else:
        yield "  # record a second motion and list it here: it tests whether the model is right"
        yield "  held_out: []"
    if imports:
        yield ""
        yield _line("", "import", "", "how files were read: `yid-ocp import FILE --config THIS`")
    for key, value in imports.items():
        yield f"  {key}: {_value(value)}"


def _sensors(proposal: ProposedConfigChoices) -> Iterator[str]:
    if proposal.noise_by_group or proposal.clock_descriptions:
        yield "sensors:"
    for group, noise in proposal.noise_by_group.items():
        places, entries, said = proposal.point_placements.get(group, ()), [], f"noise: {noise.reason}"
        if noise.std is not None:
            entries, said = [f"std: {_number(noise.std)}"], f"{noise.std:.2g} {noise.unit}, {noise.reason}"
        elsewhere = (place for place in places if place.model_frame not in ("", place.point))
        if frames := {place.point: place.frame for place in elsewhere}:
            entries.append(f"frame_by_recorded_name: {_value(frames)}")
        told_by_points = proposal.arm_mode == "prescribed" and not proposal.is_identified_from_efforts
        if group == "joints.effort":
            if proposal.torque_bias_std and not proposal.is_identified_from_efforts:
                biases = {joint: float(f"{std:.2g}") for joint, std in proposal.torque_bias_std.items()}
                values = _number(next(iter(biases.values()))) if len(set(biases.values())) == 1 else _value(biases)
                entries.append(f"bias_std: {values}")
                said += "; bias_std of its constant error: a guess, 1 % of the effort limit"
            if told_by_points:
                entries = ["use: false", *entries]
                said = "use: true looks for friction and payload of the arm; bias_std: 1 % of the effort limit"
        is_mounted = places and "." in group
        if is_mounted and (proposal.arm_mode == "driven" or not all(place.frame for place in places)):
            why = "torques with noise move the arms: set mode: prescribed to use it"
            entries = ["use: false", *entries]
            said = why if proposal.arm_mode == "driven" else "its frame is not known"
        elif group.startswith(ESTIMATED_WRENCH_GROUP_NAME):
            entries = ["use: false", *entries]
            said = "an estimate from joint torques, less the loads that the driver knows: in place of efforts only"
        # a comment, if there is no setting
        yield _line("  ", group, f"{{{', '.join(entries)}}}", said) if entries else f"  # {group}: {said}"
        for place in places:
            yield f"  #   {place.point} at {place.frame or '?'}: {place.reason}"
    for group, clock in proposal.clock_descriptions.items():
        yield f"  # {group} come at {clock}"


def _parameters(item: InitCommandObject | None, proposal: ProposedConfigChoices) -> Iterator[str]:
    free, preset = "{free: true}", proposal.motor_preset
    if item is None:
        yield _line("", "parameters", "", "`yid-ocp inspect` lists all that there are")
        payload = f'"payload@{proposal.holder_frame}.*"'
        yield _line("  ", payload, free, "mass [kg] and first moments [kg m]; {free: false} where it holds nothing")
    else:
        yield _line("", "parameters", "", item.parameters_comment)
        for name, (value, comment) in item.start_values.items():
            yield _line("  ", name, f"{{free: true, initial: {_number(value)}}}", comment)
    if proposal.arm_mode == "servo":
        start = f"published figure of the {preset}" if preset else ""
        if proposal.firmware_gain is not None:
            known = f"{{initial: {proposal.firmware_gain:g}}}"
            said = "the firmware's, as LeRobot sets it; or attribute proportional_gain of the recordings"
            yield _line("  ", '"*.servo_gain_factor"', known, said)
        yield _line("  ", '"*.servo_gain"', free, start or "begins at a twentieth of a radian for the effort limit")
        yield _line("  ", '"*.servo_damping"', free, start or "begins at a tenth of a second times the gain")
        late = "{free: true, initial: 0.075}" if preset else free
        yield _line("  ", '"*.servo_delay"', late, "from a command to its torque [s]")
        yield _line("  ", '"rotor_inertia@*.armature"', free, "of the servos' motors, at the joint [kg m^2]")
        if preset:
            yield _line("  ", '"*.servo_torque_limit"', free, "at full duty [N m]")
            for joint in proposal.still_joints:
                yield _line("  ", f'"{joint}.*"', "{free: false}", "it hardly turns")
                yield _line("  ", f"rotor_inertia@{joint}.armature", "{free: false}")
        else:
            yield '  # "*.servo_torque_limit": {initial: 3.0}   # the URDF\'s effort limit where nothing is said'
    if proposal.is_identified_from_efforts:
        if not proposal.has_object and set(proposal.joints) > set(proposal.still_joints):
            yield _line("  ", '"rotor_inertia@*.armature"', free, "of the motors, at the joint [kg m^2]")
        for joint in proposal.joints:
            said, why = "{free: true, initial: 0.1, bounds: [0.0, 50.0]}", "viscous friction of the arm [N m s/rad]"
            if joint in proposal.still_joints:
                said, why = "{initial: 0.1}", "it hardly turns"
            yield _line("  ", f"{joint}.damping", said, why)
        if "joints.effort" in proposal.noise_by_group:
            yield _line("  ", '"effort_offset@*"', free, "zeros of the torque sensors [N m]")

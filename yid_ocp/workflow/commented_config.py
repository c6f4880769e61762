"""Text of a generated configuration file with a comment on every line."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, cast

from yid_ocp.model.objects.base import InitObject
from yid_ocp.options import OptionInfo, dataclass_options, split_annotated
from yid_ocp.version import package_version
from yid_ocp.workflow.config_proposal import ConfigProposal

_PLAIN_TEXT = re.compile(r"[A-Za-z_/][\w./@-]*")  # text that YAML reads as it stands
_YAML_KEYWORDS = ("true", "false", "null", "yes", "no", "on", "off")
_COMMENT_COLUMN = 44
_ALWAYS_WRITTEN_SETTINGS = ("kind", "links")


def commented_config_text(
    robot: str,
    noun: str,
    item: InitObject,
    proposal: ConfigProposal,
    recordings: Sequence[str],
    imports: Mapping[str, Any],
    schema: str,
) -> str:
    """Commented YAML text of a configuration file.

    Parameters
    ----------
    robot : str
        As the file is to name it.
    noun : str
        What the object is.
    item : InitObject
    recordings : sequence of str
        Files, as the configuration is to name them.
    imports : mapping
        How the recordings were imported, as the section `import` says it.
    schema : str
        File of the JSON Schema.
    """
    lines = [
        f"# yaml-language-server: $schema={schema}",
        f"# Written by `yid-ocp init` {package_version()}. Everything may be changed; docs/settings.md has all keys.",
        "# What the recordings say stands beside each line. Next: `yid-ocp check` on this file, then `yid-ocp solve`.",
        _line("", "description", _text(f"A {noun.replace('_', ' ')} moved by {robot}."), "one sentence for the report"),
        "",
        "model:",
        _line("  ", "robot", _text(robot), "URDF file, or package:NAME of example-robot-data"),
        "  arms:",
        *_listed("    ", "joints", proposal.joints, "recorded joints that move the object"),
        *_others(proposal),
        _line("    ", "mode", proposal.arm_mode, proposal.arm_mode_reason),
        *_mode_words(proposal),
        *_servos(proposal),
        *_object(item, proposal),
        *_grasps(proposal),
        *_damping(item),
        *_points(item, proposal),
        *_effects(proposal),
        "",
        *_recordings(recordings),
        *_imports(imports),
        "",
        *_sensors(proposal),
        "",
        *_parameters(item, proposal),
        "",
        "problem:",
        _line("  ", "time_step", f"{proposal.time_step:g}", "[s]; `check` says how far estimates move with half of it"),
        _line("  ", "initial_state", proposal.initial_state, proposal.initial_state_reason),
        _line(
            "  ",
            "path_cutoff",
            f"{proposal.path_cutoff:.3g}",
            "low-pass of prescribed motion [Hz], above what the arm does",
        ),
        "",
        "solver:",
        _line("  ", "name", "gauss_newton", "multiple_shooting where it does not converge"),
    ]
    return "\n".join(lines) + "\n"


def _line(indent: str, key: str, value: str, comment: str = "") -> str:
    text = f"{indent}{key}: {value}".rstrip()
    return f"{text:<{_COMMENT_COLUMN - 2}}  # {comment}" if comment else text


def _text(value: str) -> str:
    return (
        value
        if _PLAIN_TEXT.fullmatch(value) and value.lower() not in _YAML_KEYWORDS
        else json.dumps(value, ensure_ascii=False)
    )


def _listed(indent: str, key: str, values: Iterable[str], comment: str) -> list[str]:
    """A key with a list, on several lines where one is too long."""
    rows, row = [], ""
    for value in map(_text, values):
        if row and len(row) + len(value) > 90:
            rows.append(row)
            row = ""
        row += f"{value}, "
    rows.append(row)
    text = f",\n{indent}  {' ' * len(key)} ".join(entry.rstrip(", ") for entry in rows)
    return [f"{indent}# {comment}", f"{indent}{key}: [{text}]"]


# -- model ------------------------------------------------------------------------------------------------------------


def _others(proposal: ConfigProposal) -> list[str]:
    lines = []
    if proposal.unused_joints:
        lines.append(
            f"    # recorded too, but not needed for what holds the object: {', '.join(proposal.unused_joints)}"
        )
    stay = [name for name in proposal.unrecorded_joints if name not in proposal.joints]
    if stay or proposal.unused_joints:
        lines.append(
            "    # all other joints of the URDF stay at zero; another value: locked_joints: {JOINT: VALUE} [rad or m]"
        )
    return lines


def _mode_words(proposal: ConfigProposal) -> list[str]:
    other = (
        "driven moves the arm by its efforts instead, under a tracking filter: for efforts one trusts"
        if proposal.arm_mode == "prescribed"
        else "prescribed moves it as its encoders say"
    )
    return [f"{' ' * _COMMENT_COLUMN}# {other}"]


def _servos(proposal: ConfigProposal) -> list[str]:
    if proposal.arm_mode != "servo":
        return []
    return [
        "    servo:                                  # their gains, dampings, delays and limits are parameters, below",
        _line(
            "      ",
            "command_interpolation",
            "held",
            "until the next; interpolated: straight lines in between",
        ),
        _line("      ", "has_gravity_compensation", "false", "true where the controller carries the arm's own weight"),
    ]


def _object(item: InitObject, proposal: ConfigProposal) -> list[str]:
    said = item.settings
    lines = ["  object:"]
    if item.stands_in_world:
        lines.append("    # `mount: {parent_frame: FRAME, xyz: [x, y, z], rpy: [r, p, y]}` says where it stands")
    else:
        frames = [name for arm in proposal.arms[:1] for name in arm.tool_frames if name != proposal.holder_frame]
        lines += [
            "    # its root sits in this frame and leaves it along z, unless xyz [m] and rpy [rad] say else",
            f"    # other frames there: {', '.join(frames[:8]) or 'none'}",
            f"    mount: {{parent_frame: {_text(proposal.holder_frame)}, xyz: [0.0, 0.0, 0.0], rpy: [0.0, 0.0, 0.0]}}",
        ]
    return [*lines, *_settings_lines("    ", said)]


def _settings_lines(indent: str, settings: Any) -> list[str]:
    """Settings that differ from their defaults, and those that every reader asks for, with their descriptions."""
    lines, kind = [], cast(Any, type(settings))
    for key, option in dataclass_options(kind).items():
        value = getattr(settings, option.field_name)
        if key == "mount" or (value == option.default_value and key not in _ALWAYS_WRITTEN_SETTINGS):
            continue
        if isinstance(value, Mapping):
            lines.append(f"{indent}{key}:")
            for name, entry in value.items():
                lines += [f"{indent}  {_text(name)}:", *_settings_lines(f"{indent}    ", entry)]
            continue
        about = next(m for m in reversed(split_annotated(option.type_hint)[1]) if isinstance(m, OptionInfo))
        comment = about.description + (f" [{about.unit}]" if about.unit else "")
        numbers = [float(f"{x:.8g}") for x in value] if isinstance(value, tuple) else value
        lines.append(_line(indent, key, f"{value:g}" if isinstance(value, float) else _value(numbers), comment))
    return lines


def _grasps(proposal: ConfigProposal) -> list[str]:
    if not proposal.grasps:
        return []
    lines = ["  grasp:                                    # what else holds it: point 3, axis 5, weld 6 equations"]
    for i, (frame, point) in enumerate(proposal.grasps.items()):
        lines.append(f"    grasp_{i + 1}: {{holder_frame: {_text(frame)}, held_frame: {_text(point)}, kind: point}}")
    return lines


def _damping(item: InitObject) -> list[str]:
    dampings = [value for name, (value, _) in item.start_values.items() if name.endswith(".damping")]
    if not dampings:
        return [_line("  ", "damping", "0.05", "viscous, of every coordinate [N m s/rad]")]
    said = f"{{object: {max(dampings):.2g}}}"
    return [_line("  ", "damping", said, "where the search for it starts [N m^2 s]")]


def _points(item: InitObject, proposal: ConfigProposal) -> list[str]:
    tips = [f"w_{segment.name}" for segment in item.settings.model_segments()]
    wanted = list(dict.fromkeys([*proposal.marked_frames, *proposal.grasps.values()]))
    if set(wanted) <= set(tips):
        return []
    return _listed(
        "  ", "points", dict.fromkeys([*tips, *wanted]), "frames that sensors may see; NAME:40% along a segment"
    )


def _by_effort(proposal: ConfigProposal) -> bool:
    """Whether efforts of arms that move as measured are all that shows the object."""
    return proposal.arm_mode == "prescribed" and not proposal.point_placements


def _effects(proposal: ConfigProposal) -> list[str]:
    if proposal.arm_mode == "servo":
        kind, words = "rotor_inertia", "what rotors add through their gears, free below"
    elif _by_effort(proposal):
        kind, words = "effort_offset", "the zero of every torque sensor, free below"
    else:
        return []
    lines = [f"  effects:                                  # {words}"]
    return [*lines, *(f"    - {{kind: {kind}, location: {_text(joint)}}}" for joint in proposal.joints)]


# -- data -------------------------------------------------------------------------------------------------------------


def _recordings(files: Sequence[str]) -> list[str]:
    held = max(1, len(files) // 4) if len(files) > 1 else 0
    kept = files[: len(files) - held]
    lines = ["recordings:", *_listed("  ", "estimate", kept, "to estimate on")]
    if held:
        return [*lines, *_listed("  ", "held_out", files[-held:], "only predicted, to see whether the model is right")]
    return [
        *lines,
        "  # record a second motion and list it here: without one nothing shows whether the model is right",
        "  held_out: []",
    ]


def _imports(imports: Mapping[str, Any]) -> list[str]:
    if not imports:
        return []
    lines = [
        "",
        "import:                                     # how files were read: `yid-ocp import FILE --config THIS`",
    ]
    for key, value in imports.items():
        if isinstance(value, Mapping):
            lines.append(f"  {key}: {{{', '.join(f'{_text(str(k))}: {_value(v)}' for k, v in value.items())}}}")
        else:
            lines.append(f"  {key}: {_value(value)}")
    return lines


def _value(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_value, value))}]"
    return _text(value) if isinstance(value, str) else json.dumps(value)


def _sensors(proposal: ConfigProposal) -> list[str]:
    lines = ["sensors:"]
    for group, noise in proposal.noise_by_group.items():
        entries = []
        said = f"{noise.std:.2g} {noise.unit}, {noise.reason}" if noise.std is not None else f"noise: {noise.reason}"
        if noise.std is not None:
            entries.append(f"std: {_number(noise.std)}")
        frames = {p.point: p.frame for p in proposal.point_placements.get(group, ()) if p.frame and p.frame != p.point}
        if frames:
            entries.append(f"frames: {{{', '.join(f'{_text(p)}: {_text(f)}' for p, f in frames.items())}}}")
        if group == "joints.effort" and proposal.arm_mode == "prescribed" and not _by_effort(proposal):
            entries, said = ["use: false", *entries], "true once friction and payload of the arm are in the model"
        lines += _group(group, entries, said)
        lines += _group_places(group, proposal)
    for group, clock in proposal.clock_descriptions.items():
        lines.append(f"  # {group} come at {clock}")
    return lines if len(lines) > 1 else []


def _group(group: str, entries: Sequence[str], said: str) -> list[str]:
    """The line of a group of sensors; without a setting of its own, a comment."""
    if not entries:
        return [f"  # {group}: {said}"]
    return [_line("  ", group, f"{{{', '.join(entries)}}}", said)]


def _group_places(group: str, proposal: ConfigProposal) -> list[str]:
    return [
        f"  #   {place.point} at {place.frame or '?'}: {place.reason}"
        for place in proposal.point_placements.get(group, ())
    ]


def _number(value: float) -> str:
    text = f"{value:.2g}"
    return text if "e" not in text or "." in text.partition("e")[0] else text.replace("e", ".0e")


# -- parameters -------------------------------------------------------------------------------------------------------


def _parameters(item: InitObject, proposal: ConfigProposal) -> list[str]:
    lines = [f"parameters:                                 # {item.parameters_comment}"]
    for name, (value, comment) in item.start_values.items():
        lines.append(_line("  ", name, f"{{free: true, initial: {_number(value)}}}", comment))
    if proposal.arm_mode == "servo":
        said = "{free: true}"
        lines.append(_line("  ", '"*.servo_gain"', said, "begins at a twentieth of a radian for the effort limit"))
        lines.append(_line("  ", '"*.servo_damping"', said, "begins at a tenth of a second times the gain"))
        lines.append(_line("  ", '"*.servo_delay"', said, "from a command to its torque [s]"))
        lines.append(_line("  ", '"rotor_inertia@*.armature"', said, "of the servos' motors, at the joint [kg m^2]"))
        lines.append('  # "*.servo_torque_limit": {initial: 3.0}   # the URDF\'s effort limit where nothing is said')
    if _by_effort(proposal):
        for joint in proposal.joints:
            still = joint in proposal.still_joints
            said = "{initial: 0.1}" if still else "{free: true, initial: 0.1, bounds: [0.0, 50.0]}"
            why = "it hardly turns" if still else "viscous friction of the arm [N m s/rad]"
            lines.append(_line("  ", f"{joint}.damping", said, why))
        lines.append(_line("  ", '"effort_offset@*"', "{free: true}", "zeros of the torque sensors [N m]"))
    return lines

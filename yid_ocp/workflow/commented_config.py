"""Text of a generated configuration file with a comment on every line."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from yid_ocp.version import package_version
from yid_ocp.workflow.config_proposal import STANDARD_GRAVITY, BranchDescription, ConfigProposal

_PLAIN_TEXT = re.compile(r"[A-Za-z_/][\w./@-]*")  # text that YAML reads as it stands
_YAML_KEYWORDS = ("true", "false", "null", "yes", "no", "on", "off")
_RIGIDITY_RATIO = {"cable": 0.01, "beam": 1.0, "tree": 0.1}
"""Where the search for a bending rigidity starts, over weight times length squared."""
_DAMPING_TIME = 0.02  # damping over rigidity, where the search for it starts [s]
_COMMENT_COLUMN = 44


@dataclass(frozen=True)
class ObjectDescription:
    """User's description of the object: kind (cable, beam, tree or y), branches, and links per branch."""

    kind: str
    branches: tuple[BranchDescription, ...]
    links_per_branch: int


def commented_config_text(
    robot: str,
    item: ObjectDescription,
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
        _line("", "description", _text(f"A {item.kind} moved by {robot}."), "one sentence for the report"),
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
            "until the next one; interpolated where the controller goes in between",
        ),
        _line("      ", "has_gravity_compensation", "false", "true where the controller carries the arm's own weight"),
    ]


def _object(item: ObjectDescription, proposal: ConfigProposal) -> list[str]:
    if item.kind == "foam_y":
        return [
            "  # the foam Y of the source paper; `mount` moves its foot, which stands at (0.85, 0, -0.93) m",
            f"  object: {{kind: foam_y, links: {item.links_per_branch}}}",
        ]
    frames = [name for arm in proposal.arms[:1] for name in arm.tool_frames if name != proposal.holder_frame]
    lines = [
        "  object:",
        _line("    ", "kind", "segments", "chains of rigid links with elastic joints"),
        "    # its root sits in this frame of the robot and leaves it along z, unless xyz [m] and rpy [rad] say else",
        f"    # other frames there: {', '.join(frames[:8]) or 'none'}",
        f"    mount: {{parent_frame: {_text(proposal.holder_frame)}, xyz: [0.0, 0.0, 0.0], rpy: [0.0, 0.0, 0.0]}}",
        "    segments:",
    ]
    for branch in item.branches:
        lines += [f"      {_text(branch.name)}:", *_segment(branch, item.links_per_branch)]
    return lines


def _segment(branch: BranchDescription, links: int) -> list[str]:
    at = "        "
    lines = [
        _line(at, "length", f"{branch.length:g}", "[m], from the grip to the end"),
        _line(at, "mass", f"{branch.mass:g}", "[kg], spread along it"),
    ]
    if branch.cross_section is not None:
        lines.append(
            _line(
                at, "cross_section", f"[{branch.cross_section[0]:g}, {branch.cross_section[1]:g}]", "along x and y [m]"
            )
        )
    if branch.radius is not None:
        lines.append(_line(at, "radius", f"{branch.radius:g}", "[m]"))
    if branch.parent is not None:
        lines.append(_line(at, "parent", _text(branch.parent), "on whose end it grows"))
    if any(branch.rpy):
        lines.append(
            _line(at, "rpy", str([float(f"{turn:.8g}") for turn in branch.rpy]), "turn against what holds it [rad]")
        )
    order, why = "xy", "bends both ways; xyz where it twists as well"
    if branch.cross_section is not None:
        # a turn about y bends it along x
        order, why = (
            "y" if branch.cross_section[0] <= branch.cross_section[1] else "x",
            "it bends across its thinner side alone",
        )
    return [
        *lines,
        _line(at, "links", str(links), "rigid links; `check` says how far estimates move with more"),
        _line(at, "joint_axes", order, why),
        _line(at, "stiffness_per_curvature", "true", "parameters per curvature, whatever the number of links"),
        _line(
            at, "clamped_at_base", "true" if branch.parent is None else "false", "whether the grip holds its direction"
        ),
    ]


def _grasps(proposal: ConfigProposal) -> list[str]:
    if not proposal.grasps:
        return []
    lines = ["  grasp:                                    # what else holds it: point 3, axis 5, weld 6 equations"]
    for i, (frame, point) in enumerate(proposal.grasps.items()):
        lines.append(f"    grasp_{i + 1}: {{holder_frame: {_text(frame)}, held_frame: {_text(point)}, kind: point}}")
    return lines


def _damping(item: ObjectDescription) -> list[str]:
    if item.kind == "foam_y":
        return [_line("  ", "damping", "0.05", "viscous, of every coordinate [N m s/rad]")]
    start = max(_DAMPING_TIME * _rigidity(branch, item.kind) for branch in item.branches)
    return [_line("  ", "damping", f"{{object: {start:.2g}}}", "where the search for it starts [N m^2 s]")]


def _points(item: ObjectDescription, proposal: ConfigProposal) -> list[str]:
    tips = ["w_T1", "w_T2", "w_T3"] if item.kind == "foam_y" else [f"w_{branch.name}" for branch in item.branches]
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


def _rigidity(branch: BranchDescription, kind: str) -> float:
    return _RIGIDITY_RATIO[kind] * branch.mass * STANDARD_GRAVITY * branch.length**2


def _parameters(item: ObjectDescription, proposal: ConfigProposal) -> list[str]:
    lines = ["parameters:                                 # `yid-ocp inspect` lists all that there are"]
    if item.kind == "foam_y":
        names = [f"{tube}.{quantity}" for tube in ("T1", "T2", "T3") for quantity in ("bend", "twist")]
        lines[0] = "parameters:                                 # stiffness of every joint of a tube [N m/rad]"
        return [*lines, *(f"  {name}: {{free: true, initial: 3.0}}" for name in names)]
    for branch in item.branches:
        bend = _rigidity(branch, item.kind)
        said = f"{{free: true, initial: {_number(bend)}}}"
        lines.append(_line("  ", f"{branch.name}.bend", said, "bending rigidity [N m^2], where the search starts"))
        said = f"{{free: true, initial: {_number(_DAMPING_TIME * bend)}}}"
        lines.append(_line("  ", f"{branch.name}.damping", said, "[N m^2 s]"))
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

"""Registries of readers and previews, and steps that readers share: selection, renaming and unit conversion."""

from __future__ import annotations

import fnmatch
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any

import numpy as np

from yid_ocp.arrays import Array, BoolArray
from yid_ocp.data.channel_checks import median_sample_period
from yid_ocp.data.foreign_formats import UNIT_BY_WORD
from yid_ocp.data.recording import JOINT_CHANNEL_UNITS, JointGroup, PointGroup, Recording, validated_recording
from yid_ocp.display import abbreviated_names_text, count_with_noun
from yid_ocp.errors import DataError, require_known_names, unknown_name_error_arguments
from yid_ocp.registry import Registry


@dataclass(frozen=True)
class TopicOrColumnSummary:
    """One topic, column or marker of a file to import, with its sample count, rate and name after the import."""

    # name in the file, and type
    name: str
    kind: str
    n_samples: int  # messages or values
    mean_rate: float  # mean rate [Hz]; NaN where it has none
    imported_as: str = ""  # imported name of the source; empty if it is omitted
    note: str = ""  # reason for the omission, or advice


@dataclass(frozen=True)
class FilePreview:
    """Preview of a file to import: data sources, suggested reader options and notes."""

    sources: tuple[TopicOrColumnSummary, ...]
    reader_options: Mapping[str, Any] = field(default_factory=dict)  # named options of the reader
    notes: tuple[str, ...] = ()  # remarks for the user, such as guesses of units


READERS: Registry[Callable[..., Recording]] = Registry("recording format")
"""Readers by file suffix, or by a word for formats stored as a folder. Each takes a path, then named options."""

FILE_PREVIEWERS: Registry[Callable[..., FilePreview]] = Registry("recording format with a preview")
"""Functions that list a file's contents without importing it, by the keys of `READERS`. Each takes a path."""

SKIP_COLUMN_KEYWORD = "skip"  # column meaning that omits the column

_TO_SI: Mapping[str, Mapping[str, float]] = {
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "rad": {"rad": 1.0, "deg": math.pi / 180, "rev": 2 * math.pi, "m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "rad/s": {"rad/s": 1.0, "deg/s": math.pi / 180, "rpm": 2 * math.pi / 60, "m/s": 1.0, "mm/s": 1e-3},
    "N m": {"N m": 1.0, "N mm": 1e-3, "mN m": 1e-3, "N": 1.0, "A": 1.0, "mA": 1e-3},
}
MOTOR_CURRENT_UNITS = ("A", "mA")  # units of `effort` for motor currents
_QUANTITIES: Mapping[str, str] = {"t": "s", **JOINT_CHANNEL_UNITS, "points": "m"}
_MAX_PLAUSIBLE_VALUES = {"position": 2.1 * math.pi, "points": 20.0}  # [rad], [m]; larger: degrees, millimetres
_MIN_LARGE_FRACTION = 0.01  # of the samples, which look like degrees; fewer large ones are wrong samples


def parse_quantity_units(words: Iterable[str]) -> dict[str, str]:
    """Parse units by quantity from words such as `deg` or `velocity=rpm`. Raises `DataError` if one is invalid."""
    units, exact = dict[str, str](), dict[str, str]()
    for word in words:
        quantity, equals, unit = word.rpartition("=")
        unit = UNIT_BY_WORD.get(unit.strip().lower(), unit.strip())
        if equals:
            _set_unit(exact, quantity.strip(), unit)
            continue
        of = next((si for si, known in _TO_SI.items() if unit in known), None)
        if of is None:
            every = ", ".join(dict.fromkeys(chain(*_TO_SI.values())))  # metres are units of two quantities
            hint = "write the units of the file's values, such as --units deg,mm, or convert the values"
            raise DataError(f"the unit '{word}' is unknown", where="--units", allowed=every, hint=hint)
        own = [q for q, si in _QUANTITIES.items() if si == of and (q == "effort" or unit not in MOTOR_CURRENT_UNITS)]
        for quantity in own:
            _set_unit(units, quantity, unit)
    return units | exact


def _set_unit(units: dict[str, str], quantity: str, unit: str) -> None:
    if units.setdefault(quantity, unit) != unit:
        what, hint = f"'{quantity}' has two units, {units[quantity]} and {unit}", f"keep one, such as {quantity}={unit}"
        raise DataError(what, where="--units", allowed="one unit for every quantity", hint=hint)


def factor_to_si_by_quantity(units: Mapping[str, str], where: str) -> dict[str, float]:
    """Return the factor from the file's unit to the SI unit for every quantity; to ampere for a motor current."""
    factors = dict.fromkeys(_QUANTITIES, 1.0)
    for quantity, unit in units.items():
        if quantity not in _QUANTITIES:
            what = f"a unit is given for '{quantity}', which is not the name of a quantity"
            fitting = ", ".join(name for name, kind in _QUANTITIES.items() if unit in _TO_SI.get(kind, ()))
            hint = f"name the quantity: '{unit}' fits {fitting}" if fitting else "write for example position=deg"
            said = unknown_name_error_arguments(quantity, _QUANTITIES, hint)
            raise DataError(what, where=f"--units, for {where}", **said)
        known, plain = _TO_SI.get(_QUANTITIES[quantity], {}), UNIT_BY_WORD.get(unit.lower(), unit)
        if plain not in known:
            what = f"'{unit}' is not a unit of '{quantity}'"
            raise DataError(what, where=where, **unknown_name_error_arguments(unit, known))
        factors[quantity] = known[plain]
    return factors


def parse_old_to_new_joint_names(entries: Iterable[str], known: Iterable[str], where: str) -> dict[str, str]:
    """Return new names by `known` joint, from `name` or `recorded=name`; `*`: any text. `DataError` if not unique."""
    pairs, found = list[tuple[str, str, str]](), dict[str, str]()
    for entry in entries:
        recorded, equals, name = (part.strip() for part in entry.partition("="))
        name = name if equals else recorded
        pattern = re.compile(re.escape(recorded).replace(r"\*", "(.*)", 1))
        is_pattern = recorded.count("*") == name.count("*") == 1
        matches = [own for own in map(pattern.fullmatch, known) if own] if is_pattern else []
        pairs += [(entry, own[0], name.replace("*", own[1])) for own in matches] or [(entry, recorded, name)]
    for entry, recorded, name in pairs:
        if not recorded or not name:
            allowed, hint = "NAME, or RECORDED=NAME of a joint", "write for example --joints q1=shoulder,q2=elbow"
            raise DataError(f"the entry '{entry}' lacks the name of a joint", where=where, allowed=allowed, hint=hint)
        if recorded in found or name in found.values():
            what, allowed = f"the joint '{recorded if recorded in found else name}' is chosen twice", "every joint once"
            raise DataError(what, where=where, allowed=allowed, hint="remove one of its two entries in --joints")
        found[recorded] = name
    return found


@dataclass(frozen=True)
class JointPointAndUnitOptions:
    """Options that readers share: selection and names of joints and points, and the file's units."""

    joints: Sequence[str] | None = None  # entries `name` or `recorded=name`, in this order; None: all joints
    point_names: Mapping[str, str] | None = None  # new names by recorded name; None: all points
    units: Mapping[str, str] | None = None  # unit of `t`, a joint channel or `points`, if not SI
    # for motor currents, by joint or pattern: torque per current [N m/A], and motor turns per joint turn (default 1)
    torque_constants: Mapping[str, float] | None = None
    gear_ratios: Mapping[str, float] | None = None


def convert_to_si_and_validate(raw: Recording, where: str, options: JointPointAndUnitOptions) -> Recording:
    """Convert the recording `raw` to SI units, select joints and points, and validate the result.

    Raises `DataError` for an unknown joint, point, quantity or unit, for a current without torque constants, or if
    `validated_recording` refuses the result.
    """
    factors, group = factor_to_si_by_quantity(options.units or {}, where), raw.joints
    if group is not None:
        names = {name: name for name in group.names}
        if options.joints is not None:
            names = parse_old_to_new_joint_names(options.joints, group.names, where)
            require_known_names(names, group.names, "joint", f"--joints, {where}", DataError)
        at, recorded = [group.names.index(name) for name in names], group.values_by_channel.items()
        channels: dict[str, Any] = {name: factors[name] * values[:, at] for name, values in recorded}
        if "effort" in channels:
            channels["effort"] = channels["effort"] * _torque_factors(tuple(names.values()), options, where)
        elif options.torque_constants or options.gear_ratios:
            what = "torque constants or gear ratios are given, but the file has no efforts"
            hint = "leave them out, or give the columns of currents: --columns COLUMN=effort:JOINT"
            raise DataError(what, where=where, allowed="torque constants and gear ratios with efforts", hint=hint)
        group = replace(group, names=tuple(names.values()), t=factors["t"] * group.t, **channels)
    seen, chosen, notes = list[PointGroup](), options.point_names, list(raw.notes)
    for entry in raw.points if chosen is None else _chosen_points(raw.points, chosen, where):
        std = None if entry.std is None else factors["points"] * entry.std
        t, position = factors["t"] * entry.t, factors["points"] * entry.position
        lost = (position == 0).all(axis=2)
        lost &= ~lost.all(axis=0)
        if lost.any():  # motion capture systems write zeros for markers that they lost
            text = abbreviated_names_text([name for name, own in zip(entry.names, lost.T, strict=True) if own.any()])
            many = count_with_noun(int(lost.sum()), "position")
            notes.append(f"not measured: {many} of {text} that the file states as 0, 0, 0")
            position = np.where(lost[:, :, None], np.nan, position)
        seen.append(replace(entry, t=t, position=position, std=std))
    others = tuple(replace(entry, t=factors["t"] * entry.t) for entry in raw.channel_groups)
    made = replace(raw, joints=group, points=tuple(seen), channel_groups=others, notes=tuple(notes))
    return validated_recording(made, where=where)


def _chosen_points(groups: Sequence[PointGroup], chosen: Mapping[str, str], where: str) -> tuple[PointGroup, ...]:
    require_known_names(chosen, [name for group in groups for name in group.names], "point", where, DataError)
    check_unique_point_names(chosen, where)
    kept = []
    for group in groups:
        own = [name for name in chosen if name in group.names]
        at = [group.names.index(name) for name in own]
        if own:
            std = None if group.std is None else group.std[:, at]
            names = tuple(chosen[name] for name in own)
            kept.append(replace(group, names=names, position=group.position[:, at], std=std))
    return tuple(kept)


def check_unique_point_names(chosen: Mapping[str, str], where: str) -> None:
    """Raise `DataError` if `chosen` maps two data sources to the same point name."""
    names = list(chosen.values())
    if shared := [source for source, name in chosen.items() if names.count(name) > 1]:
        what = f"points have the same name ({', '.join(f'{source} as {chosen[source]}' for source in shared)})"
        hint = ",".join(f"{source}=NAME{i + 1}" for i, source in enumerate(shared[:4])) + ",..." * (len(shared) > 4)
        raise DataError(what, where=where, allowed="one name for each point", hint=f"rename them: --points {hint}")


def _torque_factors(names: Sequence[str], options: JointPointAndUnitOptions, where: str) -> Array:
    """Factors from recorded efforts to joint torques, [N m] per recorded unit, shape (nj,)."""
    constants, gear_ratios, factors = options.torque_constants or {}, options.gear_ratios or {}, np.ones(len(names))
    for word, given in (("torque constant", constants), ("gear ratio", gear_ratios)):
        for pattern, value in given.items():
            if not fnmatch.filter(names, pattern):
                what = f"a {word} is given for '{pattern}', but no joint has this name"
                raise DataError(what, where=where, **unknown_name_error_arguments(pattern, names))
            if not (math.isfinite(value) and value != 0):
                what, allowed = f"the {word} of '{pattern}' is {value:g}", "a finite number that is not zero"
                raise DataError(what, where=where, allowed=allowed, hint=f"write for example {pattern}=0.1")
    if (options.units or {}).get("effort") not in MOTOR_CURRENT_UNITS:
        if constants or gear_ratios:
            what = "torque constants or gear ratios are given, but the unit of the efforts is not a unit of current"
            allowed = "torque constants and gear ratios with --units effort=A or effort=mA"
            raise DataError(what, where=where, allowed=allowed, hint="add --units effort=A, or leave them out")
        return factors
    for j, name in enumerate(names):
        own = [value for pattern, value in constants.items() if fnmatch.fnmatchcase(name, pattern)]
        if not own:
            what = f"the effort of '{name}' is a current, but its torque constant is not given"
            hint = f"add --torque-constants {name}=0.1, or '*=0.1' for all joints"
            raise DataError(what, where=where, allowed="a torque constant for every joint [N m/A]", hint=hint)
        ratio = [value for pattern, value in gear_ratios.items() if fnmatch.fnmatchcase(name, pattern)]
        factors[j] = own[-1] * (ratio[-1] if ratio else 1.0)
    return factors


def guess_non_si_units(recording: Recording) -> tuple[dict[str, str], tuple[str, ...]]:
    """Guess the units of values that cannot be in SI units. Returns units by quantity, and the reasons as sentences."""
    units, notes, joints = dict[str, str](), list[str](), recording.joints
    if joints is not None and joints.position.size:
        counts = np.sum(np.abs(joints.position) > (limit := _MAX_PLAUSIBLE_VALUES["position"]), axis=0)
        if counts.max() > _MIN_LARGE_FRACTION * len(joints.t):
            units["position"], j = "deg", int(counts.argmax())
            many = f"{counts[j]} of {len(joints.t)} samples of {joints.names[j]} would exceed {limit:.2g} rad"
            notes.append(f"{many}, so angles seem to be in degrees")
    farthest = max((float(np.nanmax(np.abs(g.position), initial=0.0)) for g in recording.points), default=0.0)
    if farthest > _MAX_PLAUSIBLE_VALUES["points"]:
        units["points"] = "mm"
        notes.append(f"coordinates of points would reach {farthest:.3g} m, so they seem to be in millimetres")
    for group in recording.joint_and_point_groups:
        period = median_sample_period(group.t)
        unit = next((unit for unit, least in (("ns", 1e4), ("us", 200.0), ("ms", 0.5)) if period > least), "")
        slow = isinstance(group, PointGroup) and unit == "ms" and period < 30  # a slow camera, in seconds
        if unit and not slow and "t" not in units:
            units["t"] = unit
            notes.append(f"the time between samples would be {period:.3g} s, so the times seem to be in {unit}")
    return units, tuple(notes)


_MAX_INTERPOLATED_PERIODS = 5.0  # longest interpolated gap in periods of its source


def joints_on_fastest_clock(
    groups: Sequence[tuple[str, JointGroup]], where: str, hint: str
) -> tuple[JointGroup, tuple[str, ...]]:
    """Merge joint groups of named sources at the times of the one with the highest rate. Returns group and notes.

    Values of the other sources are interpolated linearly. A time is omitted if a source has a gap of more than five of
    its periods around it. Raises `DataError` (with `hint`) if sources share a joint or no time, or differ in channels.
    """
    if len(groups) == 1:
        return groups[0][1], ()
    _check_separate(groups, where, hint)
    name, clock = max(groups, key=lambda source: len(source[1].t) / max(np.ptp(source[1].t), 1e-12))
    kept = np.all([_can_interpolate(group.t, clock.t) for _, group in groups], axis=0)
    if not kept.any():
        listed = ", ".join(f"{name} from {group.t[0]:.6g} to {group.t[-1]:.6g} s" for name, group in groups)
        what = f"the joints were never recorded at the same time ({listed})"
        raise DataError(what, where=where, allowed="joints whose times overlap", hint=hint)
    t = clock.t[kept]

    def joined(channel: str) -> Array:
        columns = ((group.t, column) for _, group in groups for column in group.values_by_channel[channel].T)
        return np.stack([np.interp(t, known, column) for known, column in columns], axis=1)

    channels: dict[str, Any] = {channel: joined(channel) for channel in clock.values_by_channel}
    notes = []
    if moved := [source for source, group in groups if not np.isin(t, group.t).all()]:
        notes.append(f"the joint states of {', '.join(moved)} were interpolated to the times of {name}")
    if len(t) < len(clock.t):
        said = f"{len(clock.t) - len(t)} of {len(clock.t)} samples of {name}"
        notes.append(f"{said} were left out, because another source has a gap or no data there")
    names = tuple(joint for _, group in groups for joint in group.names)
    return replace(clock, names=names, t=t, **channels), tuple(notes)


def joints_and_command_topic(states: Iterable[tuple[str, Sequence[str]]]) -> tuple[dict[str, set[str]], str | None]:
    """Return the joints of each topic, and the topic with "command" in its name, if others have the same joints."""
    joints: dict[str, set[str]] = {}
    for topic, names in states:
        joints.setdefault(topic, set()).update(names)
    called = [topic for topic in joints if "command" in topic.lower()]
    others = set[str]().union(*(names for topic, names in joints.items() if topic not in called))
    return joints, called[0] if len(called) == 1 and joints[called[0]] == others else None


def _can_interpolate(known: Array, t: Array) -> BoolArray:
    """Mask of the times `t` that are in `known` or lie between two times of `known` that are near enough together."""
    after, before = np.searchsorted(known, t), np.searchsorted(known, t, side="right") - 1
    inside, period = (after < len(known)) & (before >= 0), median_sample_period(known)
    gap = known[np.minimum(after, len(known) - 1)] - known[np.maximum(before, 0)]
    return np.asarray(inside & (gap <= _MAX_INTERPOLATED_PERIODS * period + 1e-12))


def _check_separate(groups: Sequence[tuple[str, JointGroup]], where: str, hint: str) -> None:
    owner: dict[str, str] = {}
    for source, joint in ((source, joint) for source, group in groups for joint in group.names):
        if owner.setdefault(joint, source) != source:
            what = f"the joint '{joint}' is in {owner[joint]} and in {source}"
            raise DataError(what, where=where, allowed="every joint in one source only", hint=hint)
    every = {channel for _, group in groups for channel in group.values_by_channel}
    for source, group in groups:
        if lacking := sorted(every - set(group.values_by_channel)):
            what, allowed = f"{source} has no {lacking[0]}, but another source has it", "equal channels in all sources"
            raise DataError(what, where=where, allowed=allowed, hint=hint)

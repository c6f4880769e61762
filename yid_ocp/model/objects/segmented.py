"""Flexible objects, such as cables, beams and trees, that the settings describe segment by segment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Gt, Le

from yid_ocp.arrays import Vector3
from yid_ocp.errors import ConfigError, ModelError, nearest_name_question
from yid_ocp.files import attributes_to_dict
from yid_ocp.model.flexible import FlexibleSegment
from yid_ocp.model.mechanism import rotation_from_rpy
from yid_ocp.model.objects import base
from yid_ocp.model.objects.base import OBJECT_KINDS, InitialObjectSettings, InitObjectFactory, MountedObjectBuilder
from yid_ocp.options import OptionInfo

_NO_TURN = (0.0, 0.0, 0.0)
_RIGIDITY_RATIO = {"cable": 0.01, "beam": 1.0, "tree": 0.1}
_BRANCH_SHAPE = "NAME=LENGTH,MASS,RADIUS [m, kg, m], also with ,ROLL,PITCH,YAW; NAME@PARENT grows on the end of PARENT"


@dataclass(frozen=True, kw_only=True)
class _SegmentGeometry:
    """The settings of one segment of rigid links. Stiffness and damping are set in `parameters`."""

    length: Annotated[float | None, Gt(0), Le(50), OptionInfo("length; not needed with link_lengths", "m")] = None
    mass: Annotated[float, Gt(0), OptionInfo("mass of the whole segment", "kg")]
    radius: Annotated[
        float | None, Gt(0), Le(5), OptionInfo("radius of the solid cylinder; alternative: cross_section_size", "m")
    ] = None
    cross_section_size: Annotated[
        tuple[Annotated[float, Gt(0)], Annotated[float, Gt(0)]] | None,
        OptionInfo("side lengths of a rectangular cross section along the links' x and y axes", "m"),
    ] = None
    links: Annotated[int, Ge(1), Le(64), OptionInfo("number of equal links")] = 4
    link_lengths: Annotated[
        tuple[Annotated[float, Gt(0)], ...] | None, OptionInfo("lengths of unequal links, base to tip", "m")
    ] = None
    parent: Annotated[str | None, OptionInfo("segment to which it is attached; default: the mount")] = None
    parent_link_index: Annotated[
        int | None, Ge(0), OptionInfo("link of the parent to whose tip it is attached; default: the last")
    ] = None
    rpy: Annotated[Vector3, OptionInfo("rest rotation relative to the parent's link or mount", "rad")] = _NO_TURN
    has_separate_twist_damping: Annotated[bool, OptionInfo("whether twists have their own damping parameter")] = False
    values_given_as_rigidities: Annotated[bool, OptionInfo("whether stiffness and damping are rigidities")] = False
    clamped_at_base: Annotated[bool, OptionInfo("whether its first end is clamped by a rigid wall or gripper")] = False
    joint_axes: Annotated[str, OptionInfo("rotation axes, base to tip; others are rigid (no z: no twist)")] = "xyz"

    def _build_segment(self, name: str, damping: float, link_division: int) -> FlexibleSegment:
        """Build the segment `name`. Each link is divided into `link_division` links. The segment's stiffness stays."""
        if self.length is None and self.link_lengths is None:
            what, hint = f"segment '{name}' has no length", "set its length: 0.5, or link_lengths: [0.2, 0.3]"
            where = f"model.object.named_segments.{name}"
            raise ModelError(what, where=where, allowed="length or link_lengths [m]", hint=hint)
        n = link_division
        # a rigidity does not depend on the number of links, a stiffness per joint does
        factor = 1 if self.values_given_as_rigidities else n
        lengths, index = self.link_lengths, self.parent_link_index
        same = "mass radius parent values_given_as_rigidities clamped_at_base joint_axes cross_section_size"
        return FlexibleSegment(
            name,
            self.length if self.length is not None else float(sum(lengths or ())),
            **attributes_to_dict(self, same),
            links=self.links * n,
            link_lengths=None if lengths is None else [length / n for length in lengths for _ in range(n)],
            parent_link_index=None if index is None else (index + 1) * n - 1,  # a child stays where it is on its parent
            rest_rotation=rotation_from_rpy(*self.rpy),
            bend=FlexibleSegment.bend * factor,
            twist=FlexibleSegment.twist * factor,
            damping=damping * factor,
            twist_damping=damping * factor if self.has_separate_twist_damping else None,
        )


def _init_segment(links: int, length: float, mass: float, radius: float | None, **more: Any) -> _SegmentGeometry:
    """A segment for `init`. If its cross-section is rectangular, it bends only across its thinner side."""
    section = more.get("cross_section_size")
    axes = "xy" if section is None else "y" if section[0] <= section[1] else "x"
    more |= {"length": length, "mass": mass, "radius": radius, "links": links, "joint_axes": axes}
    return _SegmentGeometry(values_given_as_rigidities=True, clamped_at_base=more.get("parent") is None, **more)


def _init_object(word: str, segments: Mapping[str, _SegmentGeometry]) -> InitialObjectSettings:
    item = _SegmentedObject(named_segments=segments)
    start = base.initial_parameters_with_comments(item.segment_definitions(), _RIGIDITY_RATIO[word])
    return InitialObjectSettings(item, start)


def _cable(numbers: Mapping[str, Any], links: int) -> InitialObjectSettings:
    length, mass, radius = base.extract_required_object_numbers("a cable", numbers, base.SIZE_AND_MASS_DESCRIPTIONS)
    section = _section(numbers)
    segment = _init_segment(links, length, mass, None if section else radius, cross_section_size=section)
    return _init_object("cable", {"cable": segment})


def _beam(numbers: Mapping[str, Any], links: int) -> InitialObjectSettings:
    sizes = {name: base.SIZE_AND_MASS_DESCRIPTIONS[name] for name in ("length", "mass")}
    length, mass = base.extract_required_object_numbers("a beam", numbers, sizes)
    section = _section(numbers)
    if section is None and "radius" not in numbers:
        what, hint = "a beam needs a radius or a section", "add --radius NUMBER, or --section WIDTH,HEIGHT"
        raise ConfigError(what, where="--radius", allowed=base.SIZE_AND_MASS_DESCRIPTIONS["radius"], hint=hint)
    radius = None if section else float(numbers["radius"])
    return _init_object("beam", {"beam": _init_segment(links, length, mass, radius, cross_section_size=section)})


def _tree(numbers: Mapping[str, Any], links: int) -> InitialObjectSettings:
    if numbers.get("branch"):
        return _init_object("tree", _grown([_branch(text, links) for text in numbers["branch"]]))
    if not numbers.get("branches"):
        allowed = "--branch NAME=LENGTH,MASS,RADIUS[,ROLL,PITCH,YAW] for each, or --branches NUMBER of equal ones"
        hint = "for 4 equal branches (m, kg, m of each): --branches 4 --length 0.4 --mass 0.03 --radius 0.008"
        raise ConfigError("a tree needs branches", where="--branch", allowed=allowed, hint=hint)
    wanted = base.SIZE_AND_MASS_DESCRIPTIONS
    length, mass, radius = base.extract_required_object_numbers("each branch of a tree", numbers, wanted)
    count, quarter = numbers["branches"], 1.5707963
    if not 1 <= count <= 16:
        what = f"the tree has {count} branches, but must have 1 to 16"
        raise ConfigError(what, where="--branches", allowed="a whole number", hint="set --branches 4, for example")
    # perpendicular to the holder's z axis, the first one along its x axis
    turns = [(0.0, quarter, round(4 * quarter * i / count, 7)) for i in range(count)]
    branches = enumerate((_init_segment(links, length, mass, radius, rpy=turn) for turn in turns), 1)
    return _init_object("tree", {f"b{i}": branch for i, branch in branches})


def _section(numbers: Mapping[str, Any]) -> tuple[float, float] | None:
    if not numbers.get("section"):
        return None
    x, y = base.parse_comma_separated_numbers(numbers["section"], 2, "--section")
    return x, y


def _grown(branches: Sequence[tuple[str, _SegmentGeometry]]) -> dict[str, _SegmentGeometry]:
    """Branches by name, after a check for unique names and for parents that precede their children."""
    made: dict[str, _SegmentGeometry] = {}
    for name, branch in branches:
        if name in made:
            what, allowed = f"two branches are called '{name}'", "a name of its own for each branch"
            raise ConfigError(what, where="--branch", allowed=allowed, hint=f"rename one of them to '{name}_2'")
        if branch.parent is not None and branch.parent not in made:
            what = f"branch '{name}' grows on '{branch.parent}', which is not an earlier branch"
            others = [other for other, _ in branches if other != name]
            is_later, question = branch.parent in others, nearest_name_question(branch.parent, others)
            hint = f"put the --branch of '{branch.parent}' before it" if is_later else question or "correct the parent"
            allowed = f"@ and a branch before it ({', '.join(made) or 'none'}), or no @: then it begins at the root"
            raise ConfigError(what, where="--branch", allowed=allowed, hint=hint)
        made[name] = branch
    return made


def _branch(text: str, links: int) -> tuple[str, _SegmentGeometry]:
    said, equals, numbers = text.partition("=")
    name, at, parent = said.partition("@")
    count, hint = len(numbers.split(",")), "write for example --branch left=0.4,0.03,0.008"
    if not (name and equals) or (at and not parent) or count not in (3, 6):
        raise ConfigError(f"'{text}' does not describe a branch", where="--branch", allowed=_BRANCH_SHAPE, hint=hint)
    values = base.parse_comma_separated_numbers(numbers, count, "--branch")
    if min(values[:3]) <= 0:
        what, allowed = f"'{text}' has a size that is not above 0", "length [m], mass [kg] and radius [m] above 0"
        raise ConfigError(what, where="--branch", allowed=allowed, hint=hint)
    turn = (values[3], values[4], values[5]) if count == 6 else _NO_TURN
    return name, _init_segment(links, values[0], values[1], values[2], rpy=turn, parent=parent or None)


@OBJECT_KINDS.register("segments")
@dataclass(frozen=True, kw_only=True)
class _SegmentedObject(MountedObjectBuilder):
    """A flexible object built from segments (cable, beam, tube with branches), on a robot or fixed in the world."""

    default_link_refinement = True
    segment_key = "model.object.named_segments.{}"
    init_templates: ClassVar[Mapping[str, InitObjectFactory]] = {
        "cable": InitObjectFactory(8, _cable),
        "beam": InitObjectFactory(12, _beam),
        "tree": InitObjectFactory(4, _tree, has_branches=True),
    }

    kind: Annotated[Literal["segments"], OptionInfo("kind of object")] = "segments"
    mount: Annotated[base.ObjectMountSettings, OptionInfo("pose of the root")] = field(
        default_factory=base.ObjectMountSettings
    )
    named_segments: Annotated[Mapping[str, _SegmentGeometry], OptionInfo("segments by name, parents first")] = field(
        default_factory=dict
    )

    def segment_definitions(self, damping: float = 0.0, link_division: int = 1) -> list[FlexibleSegment]:
        return [s._build_segment(name, damping, link_division) for name, s in self.named_segments.items()]

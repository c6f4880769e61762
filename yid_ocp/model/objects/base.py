"""The interface of a kind of flexible object: settings, geometry, refinement, clamps and `init` templates."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array, Vector3
from yid_ocp.errors import ConfigError, ModelError, require_known_names
from yid_ocp.model.flexible import FlexibleObject, FlexibleSegment, flexible_object
from yid_ocp.model.mechanism import transform_from_xyz_rpy
from yid_ocp.model.system import System
from yid_ocp.options import OptionInfo, class_options_by_key, split_annotated
from yid_ocp.registry import Registry

START_CLAMP, END_CLAMP = "clamp_start", "clamp_end"
_STANDARD_GRAVITY = 9.81
_DAMPING_TIME = 0.02  # initial ratio of damping to rigidity [s]
SIZE_AND_MASS_DESCRIPTIONS = {"length": "its length [m]", "mass": "its mass [kg]", "radius": "its radius [m]"}
_PER_JOINT_QUANTITIES = ("bend", "twist", "damping", "twist_damping")


@dataclass(frozen=True, kw_only=True)
class MountSettings:
    """The parent frame of an object, and the pose of the object's root in this frame."""

    parent_frame: Annotated[str | None, OptionInfo("frame in which xyz and rpy are given; default: world")] = None
    xyz: Annotated[Vector3, OptionInfo("position in the parent frame", "m")] = (0.0, 0.0, 0.0)
    rpy: Annotated[Vector3, OptionInfo("roll, pitch, yaw in the parent frame", "rad")] = (0.0, 0.0, 0.0)

    @property
    def pose(self) -> Array:
        """The pose of the object's root in the parent frame, a homogeneous matrix (4, 4)."""
        return transform_from_xyz_rpy(self.xyz, self.rpy)


@dataclass(frozen=True, kw_only=True)
class ObjectMountSettings(MountSettings):
    """The mount of an object, whose direction may be uncertain."""

    rotation_std: Annotated[
        float,
        Ge(0),
        OptionInfo(
            "standard deviation of its angles about x and y; above 0, mount.rx and mount.ry are estimated", "rad"
        ),
    ] = 0.0


@dataclass(frozen=True)
class ClampPosePointNames:
    """The names of two measured points that define a clamp's pose: the origin, and a second point on the z axis.

    Two points do not determine the roll angle about z. The model sets it to zero at the start (x axis perpendicular to
    world y), and the clamp then never rotates about its own z axis.
    """

    clamp_name: str
    origin_point_name: str
    z_axis_point_name: str


@dataclass(frozen=True)
class CableVertices:
    """The vertices of a branched cable, in order along each branch, and their undeformed positions."""

    # parent, from clamp to clamp; clamps hold the first and last two vertices
    main_branch_vertex_names: tuple[str, ...]
    child_branch_vertex_names: Mapping[str, tuple[str, ...]]  # the first is the parent's where the child leaves
    undeformed_positions: Mapping[str, ArrayLike]  # position of every unloaded vertex, in any frame, shape (3,) [m]
    parent_segment: str = "parent"

    def __post_init__(self) -> None:
        free = self.main_branch_vertex_names[2:-2]
        if not free:
            what = f"the main branch has {len(self.main_branch_vertex_names)} vertices, but must have 5 or more"
            allowed, hint = "two vertices at each end, and one or more between them", "add vertices between the ends"
            raise ModelError(what, where="cable: main_branch_vertex_names", allowed=allowed, hint=hint)
        for name, vertices in self.child_branch_vertex_names.items():
            if len(vertices) < 2 or vertices[0] not in free:
                why = f"begins at '{vertices[0]}', not on the main branch" if vertices[1:] else "has only one vertex"
                allowed = f"two or more vertices, the first of them one of {', '.join(free)}"
                where, hint = f"cable: child_branch_vertex_names.{name}", f"begin the list with {free[0]}, for example"
                raise ModelError(f"branch '{name}' {why}", where=where, allowed=allowed, hint=hint)
        known = self.undeformed_positions
        require_known_names(self.vertex_names, known, "undeformed position of vertex", "cable", ModelError)
        if len(set(self.vertex_names)) != len(self.vertex_names):
            twice = max(self.vertex_names, key=self.vertex_names.count)
            branches = " and ".join(name for name, own in self.vertex_names_by_branch.items() if twice in own)
            what, hint = f"vertex '{twice}' is listed twice, in {branches}", "remove it at one of the places"
            raise ModelError(what, where="cable", allowed="every vertex in one branch", hint=hint)

    @property
    def vertex_names(self) -> tuple[str, ...]:
        """The names of all vertices, those of the parent branch first."""
        return (
            *self.main_branch_vertex_names,
            *(vertex for chain in self.child_branch_vertex_names.values() for vertex in chain[1:]),
        )

    @property
    def clamped_vertex_names(self) -> tuple[str, ...]:
        """The names of the four clamped vertices: the first two and last two of the parent branch."""
        return (*self.main_branch_vertex_names[:2], *self.main_branch_vertex_names[-2:])

    @property
    def unclamped_vertex_names(self) -> tuple[str, ...]:
        """The names of the vertices that no clamp holds, at which predictions are evaluated."""
        return tuple(vertex for vertex in self.vertex_names if vertex not in self.clamped_vertex_names)

    @property
    def vertex_names_by_branch(self) -> dict[str, tuple[str, ...]]:
        """The vertex names of every branch, by segment name. The parent branch comes first."""
        return {self.parent_segment: self.main_branch_vertex_names, **self.child_branch_vertex_names}

    @property
    def edge_vertex_names(self) -> tuple[tuple[str, str], ...]:
        """The two vertex names of every edge, ordered by branch."""
        return tuple(pair for chain in self.vertex_names_by_branch.values() for pair in pairwise(chain))

    @property
    def clamp_pose_point_names(self) -> tuple[ClampPosePointNames, ClampPosePointNames]:
        """The names of the points that define the poses of the start clamp and the end clamp."""
        a, b, *_, y, z = self.main_branch_vertex_names
        return ClampPosePointNames(START_CLAMP, a, b), ClampPosePointNames(END_CLAMP, y, z)

    def undeformed_polyline(self, chain: Sequence[str]) -> Array:
        """Return the undeformed positions of the vertices in `chain`, shape (len(chain), 3) [m]."""
        return np.array([self.undeformed_positions[vertex] for vertex in chain], float)


@dataclass(frozen=True)
class InitialObjectSettings:
    """The settings of an object that the options of `yid-ocp init` describe, with initial values of its parameters."""

    settings: ObjectBuilder  # without its mount
    start_values: Mapping[str, tuple[float, str]]  # initial value of each free parameter, with a comment
    parameters_comment: str = "`yid-ocp inspect` lists all parameters"
    # whether its root is fixed in the world and arms hold its ends; otherwise a robot frame carries its root
    stands_in_world: bool = False


@dataclass(frozen=True)
class InitObjectFactory:
    """The default link number and the builder of an object that `yid-ocp init --object` can name.

    `build` makes the object's settings from numbers by name (from options such as `--length`, or `--number`) and the
    number of links per segment. It raises `ConfigError` if a number is missing.
    """

    default_links: int  # per segment
    build: Callable[[Mapping[str, Any], int], InitialObjectSettings]
    # further names that `--number NAME=VALUE` accepts, with their meanings
    further_numbers: Mapping[str, str] = field(default_factory=dict)
    has_branches: bool = False


def extract_required_object_numbers(noun: str, numbers: Mapping[str, Any], meanings: Mapping[str, str]) -> list[float]:
    """Return the numbers that an object requires, in the order of `meanings`. Raises `ConfigError` if one is absent."""
    for name, meaning in meanings.items():
        if name not in numbers:
            has_own_flag = name in SIZE_AND_MASS_DESCRIPTIONS
            flag, value = (f"--{name}", " NUMBER") if has_own_flag else ("--number", f" {name}=NUMBER")
            raise ConfigError(f"{noun} needs a {name}", where=flag, allowed=meaning, hint=f"add {flag}{value}")
    return [float(numbers[name]) for name in meanings]


def parse_comma_separated_numbers(text: str, count: int, flag: str) -> list[float]:
    """Parse the comma-separated numbers of a flag. Raises `ConfigError` unless there are `count` finite numbers."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        noun = f"{count} numbers" if count > 1 else "a number"
        allowed = f"{noun} with commas between" if count > 1 else noun
        hint = f"write for example {flag} {','.join(['0.1'] * count)}"
        raise ConfigError(f"'{text}' is not {noun}", where=flag, allowed=allowed, hint=hint)
    return values


def initial_parameters_with_comments(
    segments: Sequence[FlexibleSegment], rigidity_ratio: float
) -> dict[str, tuple[float, str]]:
    """Return each segment's initial rigidity (`rigidity_ratio` x weight x length^2) and damping, with comments."""
    found: dict[str, tuple[float, str]] = {}
    for s in segments:
        bend = rigidity_ratio * s.mass * _STANDARD_GRAVITY * s.length**2
        found[f"{s.name}.bend"] = bend, "bending rigidity [N m^2], initial value of the fit"
        found[f"{s.name}.damping"] = _DAMPING_TIME * bend, "viscous damping [N m^2 s], initial value of the fit"
    return found


MATERIAL_DENSITIES = 5.0, 20_000.0  # of foam and of tungsten [kg/m^3]


@dataclass(frozen=True, kw_only=True)
class ObjectBuilder:
    """The base class of all kinds of flexible objects in `OBJECT_KINDS`. Its fields are the object's settings.

    A subclass overrides `kind`, and `segment_definitions` or `build`. A kind that forms a whole system with its clamps,
    such as a cable, overrides `clamped_cable_vertices` and the two methods after it.
    """

    # whether `solve` repeats the estimate with twice the links; not if the links are part of the object's definition
    default_link_refinement: ClassVar[bool] = False
    segment_key: ClassVar[str] = "model.object"  # of the settings of a segment, with {} for its name
    init_templates: ClassVar[Mapping[str, InitObjectFactory]] = {}  # words of `init --object`

    kind: Annotated[str, OptionInfo("kind of object")]

    def segment_definitions(self, damping: float = 0.0, link_division: int = 1) -> list[FlexibleSegment]:
        """Return the segments, parents first, with the damping `damping` and `link_division` links for each one."""
        return []

    def build(self, damping: float, link_division: int = 1) -> FlexibleObject:
        """Build the flexible object without placing it. Each link is divided into `link_division` links."""
        return flexible_object(self.segment_definitions(damping, link_division))

    @property
    def parent_frame_and_root_pose(self) -> tuple[str | None, Array | None]:
        """The frame that holds the object's root (None: world), and the root's pose (4, 4) in it (None: zero)."""
        return None, None

    @property
    def root_rotation_std(self) -> float:
        """The standard deviation [rad] of the root's angles `ROOT_ROTATION_PARAMETERS`. 0: there are none."""
        return 0.0

    @property
    def is_root_fixed_in_world(self) -> bool:
        """Whether the object's root is fixed in the world and not to a robot frame or clamp."""
        return False

    @property
    def uniform_or_total_link_count(self) -> int | None:
        """The number of links in each segment, or the total number if segments differ. None without segments."""
        counts = [s.links if s.link_lengths is None else len(s.link_lengths) for s in self.segment_definitions()]
        return None if not counts else counts[0] if len(set(counts)) == 1 else sum(counts)

    @property
    def divided_links_settings(self) -> tuple[str, ...]:
        """The settings, with whole keys, that divide each link in two."""
        halved = self.segment_definitions(link_division=2)
        counts = [f"links: {s.links}" if s.link_lengths is None else f"link_lengths: {s.link_lengths}" for s in halved]
        texts = [f"{self.segment_key.format(s.name)}.{count}" for s, count in zip(halved, counts, strict=True)]
        return tuple(dict.fromkeys(texts))

    @property
    def implausible_density_text(self) -> str:
        """The name and the density of a segment, as text, if no material is as light or as heavy. Otherwise empty."""
        for own in self.segment_definitions():
            width, height = own.cross_section_size or (math.sqrt(math.pi) * (own.radius or math.nan),) * 2
            density = own.mass / (own.length * width * height)
            if not MATERIAL_DENSITIES[0] <= density <= MATERIAL_DENSITIES[1]:
                return f"'{own.name}' has the density {density:.2g} kg/m^3"
        return ""

    def link_division_parameter_factor(self, parameter: str, link_division: int) -> int:
        """Return the factor on a parameter that keeps its segment as stiff and damped if each link is divided."""
        owner, _, quantity = parameter.rpartition(".")
        per_joint = {segment.name for segment in self.segment_definitions() if not segment.values_given_as_rigidities}
        return link_division if quantity in _PER_JOINT_QUANTITIES and owner in per_joint else 1

    def clamped_cable_vertices(self) -> CableVertices | None:
        """Return the object's vertices and the clamps that hold it at measured points. None for other objects.

        Raises `DataError` or `ModelError` if they are inconsistent.
        """
        return None

    def build_system_with_clamps(self, edge_lengths: Mapping[tuple[str, str], float], gravity: Vector3) -> System:
        """Build the system of object and clamps from measured edge lengths [m] and gravity [m/s^2]."""
        raise NotImplementedError

    def edge_length_parameter_values(self, edge_lengths: Mapping[tuple[str, str], float]) -> dict[str, float]:
        """Return length parameters from one recording's edge lengths [m]. Empty if all recordings share the lengths."""
        return {}

    def input_file_paths(self) -> dict[str, str]:
        """Return the paths of the input files in the object's settings, by settings key."""
        own: Any = type(self)
        return {
            key: getattr(self, option.field_name)
            for key, option in class_options_by_key(own).items()
            if any(isinstance(m, OptionInfo) and m.is_path for m in split_annotated(option.type_hint)[1])
        }

    def with_file_names_instead_of_paths(self) -> ObjectBuilder:
        """Return a copy with file names in place of paths, so that the objects of different runs can be compared."""
        return replace(self, **{key: Path(file).name for key, file in self.input_file_paths().items()})


@dataclass(frozen=True, kw_only=True)
class MountedObjectBuilder(ObjectBuilder):
    """The base class of objects whose root is fixed to a frame of a robot or clamp, or in the world."""

    gravity_fraction: Annotated[
        float, Ge(0), Le(1), OptionInfo("factor on the weight of the object, not on its inertia")
    ] = 1.0
    mount: Annotated[ObjectMountSettings | None, OptionInfo("pose of the root; default: the world's origin")] = None

    def build(self, damping: float, link_division: int = 1) -> FlexibleObject:
        return flexible_object(self.segment_definitions(damping, link_division), gravity_fraction=self.gravity_fraction)

    @property
    def parent_frame_and_root_pose(self) -> tuple[str | None, Array | None]:
        return (None, None) if self.mount is None else (self.mount.parent_frame, self.mount.pose)

    @property
    def root_rotation_std(self) -> float:
        return 0.0 if self.mount is None else self.mount.rotation_std

    @property
    def is_root_fixed_in_world(self) -> bool:
        return self.mount is None or not self.mount.parent_frame


OBJECT_KINDS: Registry[type[ObjectBuilder]] = Registry("kind")


def object_factories_for_init() -> dict[str, InitObjectFactory]:
    """Return the templates of flexible objects, by the value of `init --object` that selects each."""
    return {word: template for kind in OBJECT_KINDS for word, template in OBJECT_KINDS[kind].init_templates.items()}

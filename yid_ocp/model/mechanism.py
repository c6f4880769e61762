"""Kinematic trees of rigid bodies, and operations that change or combine the trees."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array
from yid_ocp.display import ReprMixin, ReprTexts, count_with_noun
from yid_ocp.errors import ModelError, require_known_names, unknown_name_error_arguments
from yid_ocp.model.parameters import Parameters

# unit of a quantity at a prismatic joint, by its unit at a revolute joint
_PRISMATIC_UNITS = {"rad": "m", "rad/s": "m/s", "N m": "N", "N m/rad": "N/m", "N m s/rad": "N s/m", "kg m^2": "kg"}


@dataclass(frozen=True)
class Placement:
    """A symbolic rigid transform from a child frame to its parent: rotation (3, 3) and translation (3, 1) [m]."""

    rotation: ca.SX
    translation: ca.SX

    @staticmethod
    def from_matrix(matrix: ArrayLike) -> Placement:
        """Make a placement from a numeric homogeneous matrix (4, 4)."""
        array = snap_near_integer_entries(np.asarray(matrix, dtype=float))
        return Placement(ca.SX(ca.DM(array[:3, :3])), ca.SX(ca.DM(array[:3, 3])))

    @staticmethod
    def identity() -> Placement:
        """Make the identity placement, which neither rotates nor translates."""
        return Placement.from_matrix(np.eye(4))

    def __matmul__(self, other: Placement) -> Placement:
        return Placement(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def homogeneous_matrix(self) -> ca.SX:
        """Convert the placement to a homogeneous matrix, shape (4, 4)."""
        return ca.vertcat(ca.horzcat(self.rotation, self.translation), ca.SX(ca.DM([[0.0, 0.0, 0.0, 1.0]])))


@dataclass(frozen=True)
class Inertia:
    """The mass [kg], centre of mass [m] and inertia tensor about that centre [kg m^2] of a body, in its joint's frame.

    `gravity_fraction` multiplies the weight of the body, not its inertia.
    """

    mass: ca.SX
    center_of_mass: ca.SX
    inertia_about_com: ca.SX
    gravity_fraction: ca.SX = field(default_factory=lambda: ca.SX(1))

    @staticmethod
    def from_values(mass: float, com: ArrayLike, about_com: ArrayLike) -> Inertia:
        """Make an inertia from mass [kg], centre of mass (3,) [m] and tensor about that centre (3, 3) [kg m^2]."""
        return Inertia(ca.SX(mass), ca.SX(ca.DM(np.asarray(com, float))), ca.SX(ca.DM(np.asarray(about_com, float))))

    def scaled_by(self, factor: ca.SX) -> Inertia:
        """Return a copy whose mass and inertia tensor are multiplied by `factor`."""
        return replace(self, mass=self.mass * factor, inertia_about_com=self.inertia_about_com * factor)

    def transformed_by(self, placement: Placement) -> Inertia:
        """Express the inertia in another frame. `placement` is the pose of the present frame in the other frame."""
        rotation = placement.rotation
        com = rotation @ self.center_of_mass + placement.translation
        return replace(self, center_of_mass=com, inertia_about_com=rotation @ self.inertia_about_com @ rotation.T)


@dataclass(frozen=True)
class Joint:
    """A revolute or prismatic joint with its limits and the bodies on its moving side."""

    name: str
    kind: Literal["revolute", "prismatic"]
    parent_index: int  # index of the parent joint, -1 for the world
    placement: Placement  # pose of this joint's frame at coordinate zero in the parent's joint frame
    axis: tuple[float, float, float]  # unit vector in the joint frame
    bodies: tuple[Inertia, ...] = ()
    lower_limit: float = -math.inf  # [rad or m]
    upper_limit: float = math.inf
    effort_limit: float = math.inf  # [N m or N]
    velocity_limit: float = math.inf  # [rad/s or m/s]

    def unit(self, revolute: str) -> str:
        """Return the unit of a quantity of this joint, which is `revolute` for a revolute joint (N instead of N m)."""
        return revolute if self.kind == "revolute" else _PRISMATIC_UNITS.get(revolute, revolute)


@dataclass(frozen=True)
class Frame:
    """A named frame fixed to the link that a joint moves. `joint_index` is -1 for the world.

    `proximal_bodies` (in the joint's frame) and `proximal_names` (frames and joints) are parts of the same link. If the
    mechanism is cut at this frame, they stay with the joint. Other bodies and frames of the link are beyond the cut.
    """

    joint_index: int
    placement: Placement
    proximal_bodies: tuple[Inertia, ...] = ()
    proximal_names: frozenset[str] = frozenset()


@dataclass(frozen=True)
class ArcLengthChain:
    """A chain of straight links on which a point is located by its fraction of the arc length."""

    tip_frames: tuple[str, ...]  # frame at the end of every link, base to tip
    length_fractions: tuple[float, ...]  # fraction of the nominal arc length of each link; the sum is one

    def _locate(self, length_fraction: float) -> tuple[str, float]:
        """Tip frame of the link at a fraction of the arc length (0 to 1), and the position on it as a fraction."""
        before = 0.0
        for tip, own in zip(self.tip_frames, self.length_fractions, strict=True):
            # the end of a link belongs to this link, not to the next one
            if length_fraction <= before + own * (1 + 1e-9) or tip == self.tip_frames[-1]:
                break
            before += own
        return tip, min((length_fraction - before) / own, 1.0)


@dataclass(frozen=True, repr=False)
class Mechanism(ReprMixin):
    """A kinematic tree of joints with bodies, named frames and parameters. Parents precede children.

    Placements and inertias depend on `parameters`. The frame `NAME:40%` is at 40 % of the arc length of a chain.
    """

    name: str
    joints: tuple[Joint, ...]
    frames: Mapping[str, Frame]
    parameters: Parameters = field(default_factory=Parameters)
    link_chains: Mapping[str, ArcLengthChain] = field(default_factory=dict)

    def _summary(self) -> ReprTexts:
        carriers = ("the world", *self.joint_names)
        rows = [("joint", "type", "moves with"), *((j.name, j.kind, carriers[j.parent_index + 1]) for j in self.joints)]
        joints, frames = count_with_noun(len(self.joints), "joint"), count_with_noun(len(self.frames), "frame")
        return ReprTexts(f"{self.name}, {joints} and {frames}", rows)

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """The names of the joints, in the order of the configuration vector."""
        return tuple(joint.name for joint in self.joints)

    def joint_index(self, name: str) -> int:
        """Return the index of a joint. Raises `ModelError`, with the nearest name, if there is no such joint."""
        names = self.joint_names
        require_known_names([name], names, "joint", f"model '{self.name}'", ModelError)
        return names.index(name)

    def joint(self, name: str) -> Joint:
        """Return a joint by name. Raises `ModelError`, with the nearest name, if there is no such joint."""
        return self.joints[self.joint_index(name)]

    def units_at_joints(self, names: Iterable[str], revolute: str) -> tuple[str, ...]:
        """Return the unit of a quantity at each named joint, which is `revolute` at a revolute joint."""
        return tuple(self.joint(name).unit(revolute) for name in names)

    def has_frame(self, name: str) -> bool:
        """Check whether a frame of this name exists. `T1:40%` exists if there is a segment `T1`."""
        return name in self.frames or (":" in name and name.partition(":")[0] in self.link_chains)

    def frame(self, name: str, where: str = "") -> Frame:
        """Return a frame by name. `T1:40%` is the point of segment `T1` at 40 % of its nominal arc length.

        Such a point is fixed to the straight link that contains it. Raises `ModelError` if there is no such frame (with
        the nearest name), or if the percentage is not from 0 to 100. `where` is the place of the name, for the error.
        """
        if name in self.frames:
            return self.frames[name]
        line, _, said = name.partition(":")
        if not self.has_frame(name):
            known = (*(f"{entry}:{said or '50%'}" for entry in self.link_chains), *self.frames)
            hint = "use one of these frames" + ", or add one to model.frames" * bool(where)
            choice = unknown_name_error_arguments(name, known, hint)
            raise ModelError(f"there is no frame '{name}'", where=where or f"model '{self.name}'", **choice)
        tip, part = self.link_chains[line]._locate(_fraction(name, said))
        end = self.frames[tip]
        return replace(end, placement=Placement(end.placement.rotation, part * end.placement.translation))

    def ancestor_joint_indices(self, index: int) -> tuple[int, ...]:
        """Return the indices of the joints from the root to joint `index`, inclusive. Empty for the world (-1)."""
        chain = []
        while index >= 0:
            chain.append(index)
            index = self.joints[index].parent_index
        return tuple(reversed(chain))

    def with_attached_mechanism(
        self, other: Mechanism, frame: str | None = None, placement: ArrayLike | None = None
    ) -> Mechanism:
        """Return a copy with another mechanism attached at the pose `placement` (4, 4) in `frame` (None: the world)."""
        root = Placement.identity() if placement is None else Placement.from_matrix(placement)
        at = -1
        if frame is not None:
            carrier = self.frame(frame)
            at, root = carrier.joint_index, carrier.placement @ root
        shift = len(self.joints)
        clash = sorted((set(self.joint_names) & set(other.joint_names)) | (set(self.frames) & set(other.frames)))
        if clash:
            what = f"two parts of the model use the name '{clash[0]}'"
            where = f"models '{self.name}' and '{other.name}'"
            hint = "rename the joint, frame or segment in one of them"
            raise ModelError(what, where=where, allowed="a name of its own for every joint and frame", hint=hint)

        def moved(index: int, local: Placement) -> tuple[int, Placement]:
            return (index + shift, local) if index >= 0 else (at, root @ local)

        joints = list(self.joints)
        for joint in other.joints:
            parent, local = moved(joint.parent_index, joint.placement)
            joints.append(replace(joint, parent_index=parent, placement=local))
        added = {}
        for name, entry in other.frames.items():
            carrier_index, local = moved(entry.joint_index, entry.placement)
            added[name] = replace(entry, joint_index=carrier_index, placement=local)
        both, chains = self.parameters.with_added(other.parameters), {**self.link_chains, **other.link_chains}
        name = f"{self.name}+{other.name}" if self.joints else other.name
        return Mechanism(name, tuple(joints), {**self.frames, **added}, both, chains)

    def with_added_frame(self, name: str, frame: str | None, placement: ArrayLike) -> Mechanism:
        """Return a copy with a new frame `name` at a fixed pose (4, 4) in `frame` (None: world)."""
        if name in self.frames:
            what, hint = f"there is already a frame '{name}'", f"call the added frame '{name}_2', for example"
            raise ModelError(what, where=f"model '{self.name}'", allowed="a name that no frame has", hint=hint)
        carrier = Frame(-1, Placement.identity()) if frame is None else self.frame(frame)
        added = replace(carrier, placement=carrier.placement @ Placement.from_matrix(placement))
        return replace(self, frames={**self.frames, name: added})

    def with_gravity_fraction(self, fraction: ca.SX) -> Mechanism:
        """Return a copy in which the weight of every body is multiplied by `fraction`."""
        bodies = [tuple(replace(b, gravity_fraction=fraction) for b in joint.bodies) for joint in self.joints]
        joints = tuple(replace(joint, bodies=own) for joint, own in zip(self.joints, bodies, strict=True))
        return replace(self, joints=joints)

    def with_numeric_values(self, values: Mapping[str, float] | None = None) -> Mechanism:
        """Return a copy in which numbers replace all parameters: those in `values`, else the nominal values."""
        symbols, theta = self.parameters.symbols, self.parameters.vector(values)
        symbolic = list[ca.SX]()

        def gathered(expression: ca.SX) -> ca.SX:
            if not expression.is_constant():
                symbolic.append(ca.densify(expression))
            return expression

        map_expressions(self, gathered)
        # one function of all expressions: each is quick to evaluate but slow to set up
        numbers = iter(ca.Function("numbers", [symbols], symbolic).call([theta]))

        def number(expression: ca.SX) -> ca.SX:
            return ca.densify(expression) if expression.is_constant() else ca.SX(next(numbers))

        mapped: Mechanism = map_expressions(self, number)
        return replace(mapped, parameters=Parameters())

    def with_joint_chain_added_at_index(self, index: int, chain: Sequence[Joint]) -> Mechanism:
        """Return a copy with a chain of joints inserted at list index `index`. Other joints keep their parents.

        The first joint's parent must precede `index`. The parent of each further joint is the joint before it.
        """
        count = len(chain)

        def moved(joint: int) -> int:
            return joint + count if joint >= index else joint

        joints = [replace(joint, parent_index=moved(joint.parent_index)) for joint in self.joints]
        later = [replace(joint, parent_index=i) for i, joint in enumerate(chain[1:], index)]
        joints[index:index] = [*chain[:1], *later]
        frames = {name: replace(frame, joint_index=moved(frame.joint_index)) for name, frame in self.frames.items()}
        return replace(self, joints=tuple(joints), frames=frames)


def depends_on_symbols(expression: ca.SX, symbols: ca.SX) -> bool:
    """Return whether an expression depends on one of the symbols. Both may be empty."""
    return expression.numel() > 0 and symbols.numel() > 0 and bool(ca.depends_on(expression, symbols))


def map_expressions(description: Any, change: Callable[[ca.SX], ca.SX]) -> Any:
    """Return a model description in which `change` was applied to every symbolic expression except the parameters."""
    if isinstance(description, ca.SX):
        return change(description)
    if isinstance(description, tuple):
        return tuple(map_expressions(part, change) for part in description)
    if isinstance(description, Mapping):
        return {name: map_expressions(part, change) for name, part in description.items()}
    if not is_dataclass(description) or isinstance(description, type):
        return description
    parts = {own.name: map_expressions(getattr(description, own.name), change) for own in fields(description)}
    return replace(description, **parts)


def _fraction(name: str, said: str) -> float:
    try:
        value = float(said.strip().removesuffix("%")) if said.strip().endswith("%") else math.nan
    except ValueError:
        value = math.nan
    if not 0.0 <= value <= 100.0:
        line, allowed = name.partition(":")[0], "a percentage of the length from 0% (base) to 100% (tip)"
        what, hint = f"'{said}' is not a position along '{line}'", f"write a percentage, such as {line}:40%"
        raise ModelError(what, where=name, allowed=allowed, hint=hint)
    return value / 100.0


def merge_inertias(bodies: Iterable[Inertia]) -> Inertia | None:
    """Combine rigidly connected bodies into one body. Returns None if there are no bodies or their mass is zero."""
    entries = list(bodies)
    mass = sum((b.mass for b in entries), ca.SX(0))
    if mass.is_zero():
        return None
    if not all(body.gravity_fraction.is_one() for body in entries):
        what = "the weight of a body is not its mass times gravity, so the body cannot be merged or written to a file"
        hint = "leave out effects that change weights but not masses, and set model.object.gravity_fraction: 1"
        raise ModelError(what, where="effects of the model", allowed="bodies with weight = mass * gravity", hint=hint)
    if len(entries) == 1:
        return Inertia(mass, entries[0].center_of_mass, ca.densify(entries[0].inertia_about_com))
    com = sum((b.mass * b.center_of_mass for b in entries), ca.SX(ca.DM.zeros(3))) / mass
    inertia = ca.SX(ca.DM.zeros(3, 3))
    for body in entries:
        offset = body.center_of_mass - com
        inertia += body.inertia_about_com + body.mass * (ca.dot(offset, offset) * ca.SX.eye(3) - offset @ offset.T)
    return Inertia(mass, com, ca.densify(inertia))


# URDF files contain pi rounded to a dozen digits; entries this close to 0 and 1 are set to these values.
_SNAP_TOLERANCE = 1e-11


def snap_near_integer_entries(matrix: Array) -> Array:
    """Round each matrix entry that lies within `_SNAP_TOLERANCE` of -1, 0 or 1 to that number."""
    result = np.array(matrix, dtype=float)
    for exact in (-1.0, 0.0, 1.0):
        result[np.abs(result - exact) < _SNAP_TOLERANCE] = exact
    return result


def homogeneous_transform(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Build a homogeneous matrix (4, 4) from a rotation (3, 3) and a translation (3,) [m]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.asarray(rotation, float), np.asarray(translation, float)
    return matrix


def rotation_from_rpy(roll: float, pitch: float, yaw: float) -> Array:
    """Compute a rotation matrix (3, 3) from roll, pitch, yaw [rad] as in URDF: Rz(yaw) Ry(pitch) Rx(roll)."""
    cr, sr, cp, sp, cy, sy = (f(angle) for angle in (roll, pitch, yaw) for f in (math.cos, math.sin))
    x = [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr]
    return np.array([x, [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], [-sp, cp * sr, cp * cr]])


def rpy_from_rotation(rotation: Array) -> tuple[float, float, float]:
    """Compute roll, pitch and yaw [rad] from a rotation matrix (inverse of `rotation_from_rpy`)."""
    # roll is computed after removing yaw and pitch, which also works at and near pitch = 90 degrees
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    pitch = math.atan2(-rotation[2, 0], math.hypot(rotation[0, 0], rotation[1, 0]))
    c, s = math.cos(yaw), math.sin(yaw)
    return math.atan2(s * rotation[0, 2] - c * rotation[1, 2], c * rotation[1, 1] - s * rotation[0, 1]), pitch, yaw


def numeric_axis_sin_cos_rotation(axis: ArrayLike, sine: float, cosine: float) -> Array:
    """Compute the rotation matrix (3, 3) from a unit axis (3,) and the angle's sine and cosine (Rodrigues' formula)."""
    skew = _skew(np.asarray(axis, float))
    return np.eye(3) + sine * skew + (1 - cosine) * skew @ skew


def symbolic_rotation_from_axis_angle(axis: Sequence[float], angle: ca.SX) -> ca.SX:
    """Compute the rotation matrix (3, 3) of a numeric unit axis and a symbolic angle [rad]."""
    c, s = ca.cos(angle), ca.sin(angle)
    for k in range(3):
        if abs(abs(axis[k]) - 1.0) < 1e-15:
            s = s * axis[k]
            a, b = (k + 1) % 3, (k + 2) % 3
            matrix = ca.SX(ca.DM.eye(3))
            matrix[a, a], matrix[a, b], matrix[b, a], matrix[b, b] = c, -s, s, c
            return ca.densify(matrix)
    u = np.asarray(axis)
    along = np.outer(u, u)
    return ca.SX(ca.DM(along)) + c * ca.SX(ca.DM(np.eye(3) - along)) + s * ca.SX(ca.DM(_skew(u)))


def symbolic_rotation_from_rpy(roll: ca.SX, pitch: ca.SX, yaw: ca.SX | None = None) -> ca.SX:
    """Compute the rotation matrix (3, 3) of symbolic roll, pitch, yaw (default 0) [rad]: Rz(yaw) Ry(pitch) Rx(roll)."""
    about_x = symbolic_rotation_from_axis_angle((1.0, 0.0, 0.0), roll)
    turned = symbolic_rotation_from_axis_angle((0.0, 1.0, 0.0), pitch) @ about_x
    return ca.densify(turned if yaw is None else symbolic_rotation_from_axis_angle((0.0, 0.0, 1.0), yaw) @ turned)


def _skew(u: Array) -> Array:
    return np.array([[0, -u[2], u[1]], [u[2], 0, -u[0]], [-u[1], u[0], 0]])


def transform_from_xyz_rpy(xyz: ArrayLike = (0.0, 0.0, 0.0), rpy: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """Build a homogeneous matrix (4, 4) from a translation [m] and the angles roll, pitch, yaw [rad]."""
    return homogeneous_transform(rotation_from_rpy(*np.asarray(rpy, float)), xyz)

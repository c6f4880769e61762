"""Trees of rigid bodies: read from URDF, locked, merged, joined and written back."""

from __future__ import annotations

import contextlib
import io
import math
import site
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.errors import ModelError, nearest
from yid_ocp.model.parameters import Parameter, Parameters

Matrix = NDArray[np.float64]

# URDF writers round pi to a dozen digits; entries this close to 0 and 1 are meant to be exactly that.
SNAP = 1e-11
# Stands for no limit where URDF asks for a number.
UNLIMITED = 1e9


@dataclass(frozen=True)
class Placement:
    """A rigid transform whose entries may depend on parameters.

    Attributes
    ----------
    rotation : casadi.SX, shape (3, 3)
    translation : casadi.SX, shape (3, 1)
        [m]
    """

    rotation: ca.SX
    translation: ca.SX

    @staticmethod
    def of(matrix: ArrayLike) -> Placement:
        """Placement from a numeric 4x4 homogeneous matrix."""
        array = snapped(np.asarray(matrix, dtype=float))
        return Placement(ca.SX(ca.DM(array[:3, :3])), ca.SX(ca.DM(array[:3, 3])))

    @staticmethod
    def identity() -> Placement:
        """No displacement."""
        return Placement.of(np.eye(4))

    def __matmul__(self, other: Placement) -> Placement:
        return Placement(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def mapped(self, change: Callable[[ca.SX], ca.SX]) -> Placement:
        """Both expressions replaced by what `change` makes of them."""
        return Placement(change(self.rotation), change(self.translation))

    def matrix(self) -> ca.SX:
        """The 4x4 homogeneous matrix."""
        return ca.vertcat(ca.horzcat(self.rotation, self.translation), ca.SX(ca.DM([[0.0, 0.0, 0.0, 1.0]])))


@dataclass(frozen=True)
class Inertia:
    """Mass, centre of mass [m] and inertia about it [kg m^2], in the frame of the joint that carries the body.

    `weight` multiplies the pull of gravity on the body, not its inertia; None means 1.
    """

    mass: ca.SX
    com: ca.SX
    about_com: ca.SX
    weight: ca.SX | None = None

    @staticmethod
    def of(mass: float, com: ArrayLike, about_com: ArrayLike) -> Inertia:
        """Inertia from numbers."""
        return Inertia(ca.SX(mass), ca.SX(ca.DM(np.asarray(com, float))), ca.SX(ca.DM(np.asarray(about_com, float))))

    def scaled(self, factor: ca.SX) -> Inertia:
        """Mass and inertia multiplied by `factor`, the centre kept."""
        return replace(self, mass=self.mass * factor, about_com=self.about_com * factor)

    def moved(self, placement: Placement) -> Inertia:
        """The same body seen from the frame in which its own frame has `placement`."""
        rotation = placement.rotation
        com = rotation @ self.com + placement.translation
        return replace(self, com=com, about_com=rotation @ self.about_com @ rotation.T)

    def mapped(self, change: Callable[[ca.SX], ca.SX]) -> Inertia:
        """Every expression replaced by what `change` makes of it."""
        weight = None if self.weight is None else change(self.weight)
        return Inertia(change(self.mass), change(self.com), change(self.about_com), weight)


@dataclass(frozen=True)
class Joint:
    """One degree of freedom and the bodies that move with it.

    Attributes
    ----------
    name : str
    kind : "revolute" or "prismatic"
    parent : int
        Index of the parent joint, -1 for the world.
    placement : Placement
        From the parent's joint frame to this joint's frame at zero.
    axis : tuple of float
        Unit vector in the joint frame.
    bodies : tuple of Inertia
        Everything rigidly attached to the moving side.
    lower, upper : float
        Range [rad or m].
    effort_limit, velocity_limit : float
        [N m or N], [rad/s or m/s]
    """

    name: str
    kind: Literal["revolute", "prismatic"]
    parent: int
    placement: Placement
    axis: tuple[float, float, float]
    bodies: tuple[Inertia, ...] = ()
    lower: float = -math.inf
    upper: float = math.inf
    effort_limit: float = math.inf
    velocity_limit: float = math.inf

    @property
    def unit(self) -> str:
        """Unit of the coordinate."""
        return "rad" if self.kind == "revolute" else "m"


@dataclass(frozen=True)
class Frame:
    """A named frame fixed to a joint's moving side (`joint` = -1: to the world)."""

    joint: int
    placement: Placement


@dataclass(frozen=True)
class Mechanism:
    """A tree of joints in an order in which parents come first.

    Attributes
    ----------
    name : str
    joints : tuple of Joint
    frames : mapping of str to Frame
    parameters : Parameters
        Those on which placements and inertias depend.
    """

    name: str
    joints: tuple[Joint, ...]
    frames: Mapping[str, Frame]
    parameters: Parameters = field(default_factory=Parameters)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, in configuration order."""
        return tuple(joint.name for joint in self.joints)

    @property
    def parents(self) -> tuple[int, ...]:
        """Parent index of every joint, -1 for the world."""
        return tuple(joint.parent for joint in self.joints)

    def joint_index(self, name: str) -> int:
        """Index of a joint by name; `ModelError` with the nearest name where there is none."""
        names = self.joint_names
        if name not in names:
            raise ModelError(f"there is no joint '{name}'", where=self.name, hint=nearest(name, names))
        return names.index(name)

    def frame(self, name: str) -> Frame:
        """A frame by name; `ModelError` with the nearest name where there is none."""
        if name not in self.frames:
            raise ModelError(f"there is no frame '{name}'", where=self.name, hint=nearest(name, self.frames))
        return self.frames[name]

    def ancestors(self, index: int) -> tuple[int, ...]:
        """Indices from the root to joint `index`, itself included; empty for the world."""
        chain = []
        while index >= 0:
            chain.append(index)
            index = self.joints[index].parent
        return tuple(reversed(chain))

    def joined(self, other: Mechanism, frame: str | None = None, placement: ArrayLike | None = None) -> Mechanism:
        """Hang another mechanism on a frame of this one.

        Parameters
        ----------
        other : Mechanism
            Its joint and frame names must differ from this one's.
        frame : str, optional
            Where its root goes; the world when absent.
        placement : array_like, shape (4, 4), optional
            Of its root in that frame.
        """
        root = Placement.identity() if placement is None else Placement.of(placement)
        at = -1
        if frame is not None:
            carrier = self.frame(frame)
            at, root = carrier.joint, carrier.placement @ root
        shift = len(self.joints)
        clash = sorted((set(self.joint_names) & set(other.joint_names)) | (set(self.frames) & set(other.frames)))
        if clash:
            raise ModelError(f"two parts of the model use the name '{clash[0]}'", where=f"{self.name} + {other.name}")

        def moved(index: int, local: Placement) -> tuple[int, Placement]:
            return (index + shift, local) if index >= 0 else (at, root @ local)

        joints = list(self.joints)
        for joint in other.joints:
            parent, local = moved(joint.parent, joint.placement)
            joints.append(replace(joint, parent=parent, placement=local))
        frames = dict(self.frames)
        for name, entry in other.frames.items():
            index, local = moved(entry.joint, entry.placement)
            frames[name] = Frame(index, local)
        return Mechanism(
            f"{self.name}+{other.name}" if self.joints else other.name,
            tuple(joints),
            frames,
            self.parameters.joined(other.parameters),
        )

    def with_frame(self, name: str, frame: str | None, placement: ArrayLike) -> Mechanism:
        """The mechanism with one more frame.

        Parameters
        ----------
        name : str
            Not that of another frame.
        frame : str or None
            What it is fixed to; the world for None.
        placement : array_like, shape (4, 4)
            Of the new frame in that one.
        """
        if name in self.frames:
            raise ModelError(f"there is a frame '{name}' already", where=self.name)
        carrier = Frame(-1, Placement.identity()) if frame is None else self.frame(frame)
        added = Frame(carrier.joint, carrier.placement @ Placement.of(placement))
        return replace(self, frames={**self.frames, name: added})

    def numeric(self, values: Mapping[str, float] | None = None) -> Mechanism:
        """The mechanism with numbers in place of its parameters."""
        return self._evaluated(self.parameters.symbols, self.parameters.vector(values))

    def _evaluated(self, symbols: ca.SX, theta: NDArray[np.float64]) -> Mechanism:
        def number(expression: ca.SX) -> ca.SX:
            function = ca.Function("number", [symbols], [expression])
            return ca.SX(ca.densify(function(theta)))

        return replace(self.mapped(number), parameters=Parameters())

    def mapped(self, change: Callable[[ca.SX], ca.SX]) -> Mechanism:
        """The mechanism with every expression in placements and inertias replaced by what `change` makes of it."""
        joints = tuple(
            replace(
                joint, placement=joint.placement.mapped(change), bodies=tuple(b.mapped(change) for b in joint.bodies)
            )
            for joint in self.joints
        )
        frames = {name: Frame(frame.joint, frame.placement.mapped(change)) for name, frame in self.frames.items()}
        return replace(self, joints=joints, frames=frames)

    def inserted(self, index: int, chain: Sequence[Joint]) -> Mechanism:
        """Put a chain of joints into the tree at a place in its order; what shall hang on it is then yet to be told.

        Parameters
        ----------
        index : int
            Index of the first new joint; it and what follows move back.
        chain : sequence of Joint
            The first one's parent stands before `index`, every other one's is the one before it whatever it says.
        """
        count = len(chain)

        def moved(joint: int) -> int:
            return joint + count if joint >= index else joint

        joints = [replace(joint, parent=moved(joint.parent)) for joint in self.joints]
        joints[index:index] = [
            joint if i == 0 else replace(joint, parent=index + i - 1) for i, joint in enumerate(chain)
        ]
        frames = {name: Frame(moved(frame.joint), frame.placement) for name, frame in self.frames.items()}
        return replace(self, joints=tuple(joints), frames=frames)

    @staticmethod
    def from_urdf(
        path: str | Path,
        joints: Sequence[str] | None = None,
        locked: Mapping[str, float] | None = None,
        name: str | None = None,
        parametric: bool = True,
        without: Sequence[str] = (),
    ) -> Mechanism:
        """Read a URDF; keep the chosen joints, lock the others, merge what is then fixed together.

        Parameters
        ----------
        path : str or Path
            A URDF file; `package:baxter` (or any robot folder of example-robot-data) finds that package's file.
        joints : sequence of str, optional
            Names of the joints to keep as degrees of freedom, which are then ordered as given as far as parents come
            first; all movable ones when absent.
        locked : mapping of str to float, optional
            Value at which a joint that is not kept is locked [rad or m]; zero, or the nearest bound, when absent.
        name : str, optional
            Name of the mechanism; that of the robot in the file when absent.
        parametric : bool
            Whether each kept joint's bodies get the parameter `joint.mass` [kg] (inertia in proportion).
        without : sequence of str
            Links to leave out with all that hangs on them, such as a tool that is not mounted.

        Returns
        -------
        Mechanism
            Links without a kept joint above them are fixed to the world. Every link is a frame of its name.

        Raises
        ------
        ModelError
            Missing or malformed file, unknown joint, joint type that is not revolute, continuous, prismatic or fixed.
        """
        return _from_urdf(Path(str(path)), joints, dict(locked or {}), name, parametric, without)

    def to_urdf(self, values: Mapping[str, float] | None = None) -> str:
        """The mechanism as URDF text: one link per joint, named frames as links on fixed joints.

        Bodies are merged into one inertial per link. Placements keep full precision. Reading the text back with
        `from_urdf(..., parametric=False)` gives the same numbers to 1e-12.
        """
        return _to_urdf(self.numeric(values))


def merged(bodies: Iterable[Inertia]) -> Inertia | None:
    """One rigid body equal to several, None for no body or no mass."""
    entries = list(bodies)
    if not entries:
        return None
    mass = sum((b.mass for b in entries), ca.SX(0))
    if mass.is_zero():
        return None
    if not all(b.weight is None or b.weight.is_one() for b in entries):
        raise ModelError("a body whose weight is not its mass times gravity cannot be merged or written to a file")
    com = sum((b.mass * b.com for b in entries), ca.SX(ca.DM.zeros(3))) / mass
    inertia = ca.SX(ca.DM.zeros(3, 3))
    for body in entries:
        offset = body.com - com
        inertia += body.about_com + body.mass * (ca.dot(offset, offset) * ca.SX.eye(3) - offset @ offset.T)
    return Inertia(mass, com, ca.densify(inertia))


def snapped(matrix: Matrix) -> Matrix:
    """Replace entries within `SNAP` of -1, 0 and 1 by these."""
    result = np.array(matrix, dtype=float)
    for exact in (-1.0, 0.0, 1.0):
        result[np.abs(result - exact) < SNAP] = exact
    return result


def robot_description_file(robot: str) -> Path:
    """Path of a URDF that the example-robot-data package installed.

    Parameters
    ----------
    robot : str
        `baxter`, `panda`, `ur5`, or `folder/file.urdf` below the package's robots folder.

    Raises
    ------
    ModelError
        The package is not installed, or has no such robot.
    """
    roots = [Path(p) / "cmeel.prefix/share/example-robot-data/robots" for p in [*sys.path, *site.getsitepackages()]]
    roots += [Path(sys.prefix) / "share/example-robot-data/robots"]
    folder = next((root for root in roots if root.is_dir()), None)
    if folder is None:
        raise ModelError("example-robot-data is not installed", hint="pip install example-robot-data")
    files = {str(path.relative_to(folder)): path for path in folder.rglob("*.urdf")}
    short = {"ur5": "ur_description/urdf/ur5_robot.urdf", "ur10": "ur_description/urdf/ur10_robot.urdf"}
    wanted = short.get(robot, robot)
    for candidate in (wanted, f"{wanted}_description/urdf/{wanted}.urdf"):
        if candidate in files:
            return files[candidate]
    stems = {path.stem for path in files.values()}
    raise ModelError(f"example-robot-data has no robot '{robot}'", hint=nearest(robot, stems))


def transform(rotation: ArrayLike, translation: ArrayLike) -> Matrix:
    """Homogeneous 4x4 matrix from a rotation (3, 3) and a translation (3,) [m]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.asarray(rotation, float), np.asarray(translation, float)
    return matrix


def roll_pitch_yaw(roll: float, pitch: float, yaw: float) -> Matrix:
    """Rotation matrix Rz(yaw) Ry(pitch) Rx(roll), the URDF convention [rad]."""
    cr, sr, cp, sp, cy, sy = *_cs(roll), *_cs(pitch), *_cs(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _cs(angle: float) -> tuple[float, float]:
    return math.cos(angle), math.sin(angle)


def _from_urdf(
    path: Path,
    chosen: Sequence[str] | None,
    locked: dict[str, float],
    name: str | None,
    parametric: bool,
    without: Sequence[str],
) -> Mechanism:
    import yourdfpy

    text = str(path)
    if text.startswith("package:"):
        path = robot_description_file(text.removeprefix("package:"))
    if not path.is_file():
        raise ModelError(f"there is no URDF file '{path}'", hint="give a path, or package:NAME for example-robot-data")
    try:
        ElementTree.parse(path)  # yourdfpy would read what it can of a broken file and say nothing
        with contextlib.redirect_stderr(io.StringIO()):
            robot = yourdfpy.URDF.load(
                str(path), build_scene_graph=False, load_meshes=False, load_collision_meshes=False
            ).robot
    except Exception as error:  # yourdfpy and lxml raise many kinds for a malformed file
        raise ModelError(f"the URDF cannot be read: {error}", where=str(path)) from error

    movable = {"revolute", "continuous", "prismatic"}
    for joint in robot.joints:
        if joint.type not in movable | {"fixed"}:
            raise ModelError(
                f"joint '{joint.name}' has type '{joint.type}'",
                where=str(path),
                allowed="revolute, continuous, prismatic, fixed",
            )
        if joint.type in movable and joint.axis is not None and np.linalg.norm(joint.axis) < 1e-9:
            raise ModelError(f"joint '{joint.name}' has a zero axis", where=str(path))
    known = [joint.name for joint in robot.joints if joint.type in movable]
    for wanted in [*(chosen or ()), *locked]:
        if wanted not in known:
            raise ModelError(f"there is no movable joint '{wanted}'", where=str(path), hint=nearest(wanted, known))
    kept = set(known if chosen is None else chosen)

    links = {link.name: link for link in robot.links}
    children: dict[str, list] = {}
    for joint in robot.joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                raise ModelError(
                    f"joint '{joint.name}' names a link '{link}' that is not there",
                    where=str(path),
                    hint=nearest(str(link), links),
                )
        children.setdefault(joint.parent, []).append(joint)
    below = [joint.child for joint in robot.joints]
    roots = [link for link in links if link not in below]
    if len(roots) != 1:
        raise ModelError(f"the URDF has {len(roots)} root links", where=str(path), allowed="exactly one")
    for kind, names in (
        ("links are called", [link.name for link in robot.links]),
        ("joints are called", [joint.name for joint in robot.joints]),
        ("joints carry the link", below),
    ):
        twice = sorted({entry for entry in names if names.count(entry) > 1})
        if twice:
            raise ModelError(f"two {kind} '{twice[0]}'", where=str(path), allowed="a tree with unique names")
    dropped = _with_all_below(without, links, children, str(path))
    for joint in robot.joints:
        if joint.child in dropped and joint.name in (*(chosen or ()), *locked):
            raise ModelError(f"joint '{joint.name}' carries a link that is left out", where=str(path))
    rank = {joint: i for i, joint in enumerate(chosen if chosen is not None else known)}

    collected: dict[str, tuple[str | None, Matrix, Any]] = {}
    bodies: dict[str | None, list[Inertia]] = {}
    frames: dict[str, tuple[str | None, Matrix]] = {}
    stack: list[tuple[str, str | None, Matrix]] = [(roots[0], None, np.eye(4))]
    while stack:
        link, carrier, at = stack.pop()
        frames[link] = (carrier, at)
        inertial = links[link].inertial
        if inertial is not None and inertial.mass:
            origin = np.eye(4) if inertial.origin is None else np.asarray(inertial.origin, float)
            tensor = np.zeros((3, 3)) if inertial.inertia is None else np.asarray(inertial.inertia, float)
            body = Inertia.of(float(inertial.mass), np.zeros(3), tensor)
            bodies.setdefault(carrier, []).append(body.moved(Placement.of(at @ origin)))
        for joint in children.get(link, ()):
            if joint.child in dropped:
                continue
            origin = np.eye(4) if joint.origin is None else np.asarray(joint.origin, float)
            if joint.name in kept:
                collected[joint.name] = (carrier, at @ origin, joint)
                stack.append((joint.child, joint.name, np.eye(4)))
            else:
                stack.append((joint.child, carrier, at @ origin @ _locked_motion(joint, locked)))
    loose = sorted(set(links) - set(frames) - dropped)
    if loose:
        raise ModelError(f"link '{loose[0]}' does not hang on '{roots[0]}'", where=str(path), allowed="one tree")

    order: list[str] = []
    waiting = sorted(collected, key=lambda entry: rank[entry])
    while waiting:
        ready = next(entry for entry in waiting if collected[entry][0] is None or collected[entry][0] in order)
        order.append(ready)
        waiting.remove(ready)

    parameters: list[Parameter] = []
    joints: list[Joint] = []
    for entry in order:
        carrier, at, source = collected[entry]
        carried = merged(bodies.get(entry, ()))
        if carried is not None and parametric:
            mass = float(carried.mass)
            parameter = Parameter(f"{entry}.mass", mass, "kg", 0.0, math.inf, f"mass of what {entry} carries")
            parameters.append(parameter)
            carried = replace(carried.scaled(parameter.symbol / mass), mass=parameter.symbol)
        limit = source.limit
        axis = snapped(_unit_axis(source))
        continuous = source.type == "continuous" or limit is None

        def bound(value: float | None, otherwise: float) -> float:
            return otherwise if value is None or abs(value) >= UNLIMITED else float(value)

        joints.append(
            Joint(
                entry,
                "prismatic" if source.type == "prismatic" else "revolute",
                order.index(carrier) if carrier is not None else -1,
                Placement.of(at),
                (float(axis[0]), float(axis[1]), float(axis[2])),
                () if carried is None else (carried,),
                -math.inf if continuous else bound(limit.lower, -math.inf),
                math.inf if continuous else bound(limit.upper, math.inf),
                math.inf if limit is None else bound(limit.effort, math.inf),
                math.inf if limit is None else bound(limit.velocity, math.inf),
            )
        )
    named = {
        link: Frame(-1 if carrier is None else order.index(carrier), Placement.of(at))
        for link, (carrier, at) in frames.items()
    }
    return Mechanism(name or robot.name, tuple(joints), named, Parameters(parameters))


def _locked_motion(joint: Any, locked: Mapping[str, float]) -> Matrix:
    if joint.type == "fixed":
        return np.eye(4)
    limit = joint.limit
    low = -math.inf if limit is None or limit.lower is None else float(limit.lower)
    high = math.inf if limit is None or limit.upper is None else float(limit.upper)
    if joint.type == "continuous" or low > high:
        low, high = -math.inf, math.inf
    value = locked.get(joint.name, min(max(0.0, low), high))
    axis = _unit_axis(joint)
    if joint.type == "prismatic":
        return transform(np.eye(3), value * axis)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return transform(np.eye(3) + math.sin(value) * cross + (1 - math.cos(value)) * cross @ cross, np.zeros(3))


def _with_all_below(
    without: Sequence[str], links: Mapping[str, Any], children: Mapping[str, Sequence[Any]], where: str
) -> set[str]:
    found: set[str] = set()
    waiting = list(without)
    while waiting:
        link = waiting.pop()
        if link not in links:
            raise ModelError(f"there is no link '{link}' to leave out", where=where, hint=nearest(link, links))
        found.add(link)
        waiting += [joint.child for joint in children.get(link, ())]
    return found


def _unit_axis(joint: Any) -> NDArray[np.float64]:
    axis = np.asarray([1.0, 0.0, 0.0] if joint.axis is None else joint.axis, float)
    return axis / np.linalg.norm(axis)


def _angles(rotation: Matrix) -> tuple[float, float, float]:
    # the roll is taken in the frame that yaw and pitch leave, which holds at and near pitch = 90 degrees too
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    pitch = math.atan2(-rotation[2, 0], math.hypot(rotation[0, 0], rotation[1, 0]))
    c, s = _cs(yaw)
    return math.atan2(s * rotation[0, 2] - c * rotation[1, 2], c * rotation[1, 1] - s * rotation[0, 1]), pitch, yaw


def _to_urdf(mechanism: Mechanism) -> str:
    def text(values: Iterable[float]) -> str:
        return " ".join(f"{0.0 if abs(v) < 1e-16 else v:.17g}" for v in values)

    def origin(element: ElementTree.Element, placement: Placement) -> None:
        rotation = np.array(ca.DM(placement.rotation))
        translation = np.array(ca.DM(placement.translation)).ravel()
        ElementTree.SubElement(element, "origin", xyz=text(translation), rpy=text(_angles(rotation)))

    def link_name(wanted: str, joint: int) -> str:
        frame = mechanism.frames.get(wanted)
        if frame is None:
            return wanted
        same = frame.joint == joint and np.array_equal(np.array(ca.DM(frame.placement.matrix())), np.eye(4))
        return wanted if same else link_name(f"{wanted}_", joint)

    def bounded(value: float) -> float:
        return max(-UNLIMITED, min(value, UNLIMITED))

    robot = ElementTree.Element("robot", name=mechanism.name)
    links = [link_name("world", -1)] + [link_name(f"{joint.name}_link", i) for i, joint in enumerate(mechanism.joints)]
    ElementTree.SubElement(robot, "link", name=links[0])
    for i, joint in enumerate(mechanism.joints):
        link = ElementTree.SubElement(robot, "link", name=links[i + 1])
        body = merged(joint.bodies)
        if body is not None:
            inertial = ElementTree.SubElement(link, "inertial")
            ElementTree.SubElement(inertial, "origin", xyz=text(np.array(ca.DM(body.com)).ravel()), rpy="0 0 0")
            ElementTree.SubElement(inertial, "mass", value=text([float(body.mass)]))
            tensor = np.array(ca.DM(body.about_com))
            keys = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
            ElementTree.SubElement(inertial, "inertia", {k: text([tensor[ij]]) for k, ij in keys.items()})
        limits = {
            key: text([bounded(value)])
            for key, value in (
                ("lower", joint.lower),
                ("upper", joint.upper),
                ("effort", joint.effort_limit),
                ("velocity", joint.velocity_limit),
            )
        }
        kind: str = joint.kind
        if kind == "revolute" and math.isinf(joint.lower) and math.isinf(joint.upper):
            kind, limits = "continuous", {key: limits[key] for key in ("effort", "velocity")}
        element = ElementTree.SubElement(robot, "joint", name=joint.name, type=kind)
        origin(element, joint.placement)
        ElementTree.SubElement(element, "parent", link=links[joint.parent + 1])
        ElementTree.SubElement(element, "child", link=links[i + 1])
        ElementTree.SubElement(element, "axis", xyz=text(joint.axis))
        if kind != "continuous" or math.isfinite(joint.effort_limit) or math.isfinite(joint.velocity_limit):
            ElementTree.SubElement(element, "limit", limits)
    for name, frame in mechanism.frames.items():
        if name in links:
            continue
        ElementTree.SubElement(robot, "link", name=name)
        fixed = f"{name}_fixed"
        while fixed in mechanism.joint_names:
            fixed += "_"
        element = ElementTree.SubElement(robot, "joint", name=fixed, type="fixed")
        origin(element, frame.placement)
        ElementTree.SubElement(element, "parent", link=links[frame.joint + 1])
        ElementTree.SubElement(element, "child", link=name)
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode") + "\n"

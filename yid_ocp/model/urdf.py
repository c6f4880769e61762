"""Reading and writing mechanisms as URDF."""

from __future__ import annotations

import contextlib
import io
import logging
import math
import site
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.errors import ModelError, nearest_name_hint
from yid_ocp.files import is_file
from yid_ocp.model.mechanism import Frame, Inertia, Joint, Mechanism, Placement, merge_bodies
from yid_ocp.model.parameters import Parameter, Parameters
from yid_ocp.model.rotations import (
    Matrix,
    axis_angle_rotation,
    homogeneous_transform,
    rpy_from_rotation,
    snap_to_unit_entries,
)

# Stands for no limit where URDF asks for a number.
_UNLIMITED_VALUE = 1e9

# Of metres, radians, kilograms and kg m^2; squares of more would not be finite for long.
_MAX_NUMBER = 1e12

# Of digits in the file: how far principal moments may miss what they have to be.
_PRINCIPAL_MOMENT_RTOL = 1e-2

log = logging.getLogger(__name__)

_MOVABLE_JOINT_TYPES = {"revolute", "continuous", "prismatic"}


def example_robot_urdf(robot: str) -> Path:
    """Path of a robot's URDF file in the installed example-robot-data package.

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
    raise ModelError(f"example-robot-data has no robot '{robot}'", hint=nearest_name_hint(robot, stems))


def resolve_urdf_path(robot: str | Path) -> Path:
    """Path of a robot's URDF file from its name in the settings; the file need not exist.

    Parameters
    ----------
    robot : str or Path
        A URDF file, `package:NAME` for one of example-robot-data, or `default:NAME.urdf` for a small mechanism that
        ships with this package.

    Raises
    ------
    ModelError
        The package has no such robot.
    """
    scheme, _, name = str(robot).partition(":")
    if scheme == "package":
        return example_robot_urdf(name)
    if scheme != "default":
        return Path(robot)
    known = _shipped()
    if name not in known:
        raise ModelError(f"no URDF '{name}' ships with yid_ocp", where=str(robot), hint=nearest_name_hint(name, known))
    return known[name]


def _shipped() -> dict[str, Path]:
    """URDF files of this package by name: from the repository or from the installed wheel."""
    folder = Path(__file__).resolve().parents[2] / "models" / "urdf"
    if folder.is_dir():
        return {path.name: path for path in folder.glob("*.urdf")}
    with contextlib.suppress(metadata.PackageNotFoundError):
        files = metadata.files("yid-ocp") or ()
        return {entry.name: Path(str(entry.locate())) for entry in files if entry.suffix == ".urdf"}
    return {}


def read_urdf(
    path: str | Path,
    joints: Sequence[str] | None = None,
    locked: Mapping[str, float] | None = None,
    name: str | None = None,
    parametric: bool = True,
    exclude_links: Sequence[str] = (),
) -> Mechanism:
    """A mechanism from a URDF file with the chosen joints kept and the others locked.

    Parameters
    ----------
    path : str or Path
        As `resolve_urdf_path`: a URDF file, `package:baxter` (any folder of example-robot-data), `default:NAME.urdf`.
    joints : sequence of str, optional
        Names of the joints to keep as degrees of freedom, which are then ordered as given as far as parents come
        first; all movable ones when absent.
    locked : mapping of str to float, optional
        Value at which a joint that is not kept is locked [rad or m]; zero, or the nearest bound, when absent.
    name : str, optional
        Name of the mechanism; that of the robot in the file when absent.
    parametric : bool
        Whether each kept joint's bodies get the parameter `joint.mass` [kg] (inertia in proportion).
    exclude_links : sequence of str
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
    kept, locked = joints, dict(locked or {})
    file = _file(path)
    robot = _parsed(file)
    links = _checked(robot, file, (*(kept or ()), *locked))
    dropped = _with_all_below(exclude_links, links, str(file))
    for joint in robot.joints:
        if joint.child in dropped and joint.name in (*(kept or ()), *locked):
            raise ModelError(f"joint '{joint.name}' carries a link that is left out", where=str(file))
    following = _mimicked(robot, kept, locked, str(file))
    movable = [
        joint.name for joint in robot.joints if joint.type in _MOVABLE_JOINT_TYPES and joint.name not in following
    ]
    found = _walk(links, dropped, movable if kept is None else kept, locked, str(file))
    order = _parents_first(found.joints, movable if kept is None else kept)

    parameters: list[Parameter] = []
    made: list[Joint] = []
    for entry in order:
        carrier, at, source = found.joints[entry]
        carried = merge_bodies(found.bodies.get(entry, ()))
        if carried is not None and parametric:
            mass = float(carried.mass)
            parameter = Parameter(f"{entry}.mass", mass, "kg", 0.0, math.inf, f"mass of what {entry} carries")
            parameters.append(parameter)
            carried = replace(carried.scaled_by(parameter.symbol / mass), mass=parameter.symbol)
        parent = order.index(carrier) if carrier is not None else -1
        made.append(_joint(source, parent, Placement.from_matrix(at), () if carried is None else (carried,)))
    named = {
        link: Frame(-1 if carrier is None else order.index(carrier), Placement.from_matrix(at))
        for link, (carrier, at) in found.frames.items()
    }
    return Mechanism(name or robot.name, tuple(made), named, Parameters(parameters))


@dataclass(frozen=True)
class _Link:
    """A link of the file with the joints that leave it."""

    name: str
    inertial: Any
    joints: tuple[Any, ...]


@dataclass(frozen=True)
class _Found:
    """Carrier joint (None: the world) and placement in its frame of every kept joint, body and link.

    Attributes
    ----------
    joints : mapping of joint name to (carrier, placement (4, 4), the file's joint)
    bodies : mapping of carrier to bodies in its frame
    frames : mapping of link name to (carrier, placement (4, 4))
    """

    joints: dict[str, tuple[str | None, Matrix, Any]] = field(default_factory=dict)
    bodies: dict[str | None, list[Inertia]] = field(default_factory=dict)
    frames: dict[str, tuple[str | None, Matrix]] = field(default_factory=dict)


def _file(path: str | Path) -> Path:
    file = resolve_urdf_path(path)
    if not is_file(file):
        raise ModelError(f"there is no URDF file '{file}'", hint="give a path, or package:NAME for example-robot-data")
    return file


def _parsed(file: Path) -> Any:
    import yourdfpy

    try:
        _check_numbers(ElementTree.parse(file).getroot(), str(file))  # yourdfpy reads what it can and says nothing
        with contextlib.redirect_stderr(io.StringIO()):
            return yourdfpy.URDF.load(
                str(file), build_scene_graph=False, load_meshes=False, load_collision_meshes=False
            ).robot
    except ModelError:
        raise
    except Exception as error:  # yourdfpy and lxml raise many kinds for a malformed file
        raise ModelError(f"the URDF cannot be read: {error}", where=str(file)) from error


def _check_numbers(robot: ElementTree.Element, where: str) -> None:
    """Refuse missing, surplus or invalid numbers, which the URDF reader would silently replace."""
    for owner in robot:
        if owner.tag not in ("link", "joint"):
            continue
        name = f"{owner.tag} '{owner.get('name')}'"
        inertials = owner.findall("inertial")
        if len(inertials) > 1:
            raise ModelError(f"{name} has {len(inertials)} inertials", where=where, allowed="one, or none")
        parts = (*owner.findall("origin"), *owner.findall("axis"), *owner.findall("inertial/origin"))
        for part in parts:
            for key in {"xyz", "rpy"} & set(part.attrib):
                _numbers(part.attrib[key], 3, f"{name}: {part.tag} {key}", where)
        for limit in owner.findall("limit"):
            for key, text in limit.attrib.items():
                _numbers(text, 1, f"{name}: limit {key}", where, infinite=True)
        for inertial in inertials:
            mass = inertial.find("mass")
            if mass is None or _numbers(mass.get("value", ""), 1, f"{name}: mass", where)[0] < 0:
                what = "has an inertial without a mass" if mass is None else "has a negative mass"
                raise ModelError(f"{name} {what}", where=where, allowed="a mass of zero or more [kg]")
            tensor = inertial.find("inertia")
            if tensor is not None:
                for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"):
                    _numbers(tensor.get(key, ""), 1, f"{name}: inertia {key}", where)


def _numbers(text: str, count: int, what: str, where: str, infinite: bool = False) -> list[float]:
    words = text.split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    wrong = any(math.isnan(value) or (abs(value) > _MAX_NUMBER and not infinite) for value in numbers)
    if len(numbers) != count or wrong:
        allowed = "one number" if count == 1 else f"{count} numbers"
        raise ModelError(
            f"{what} is '{text[:60]}'", where=where, allowed=f"{allowed}, at most {_MAX_NUMBER:g}, with blanks between"
        )
    return numbers


def _check_bodies(link: str, tensor: Matrix, where: str) -> None:
    """Refuse negative moments of inertia; warn of moments that no mass distribution has."""
    least, middle, most = np.linalg.eigvalsh(0.5 * (tensor + tensor.T))
    values = ", ".join(f"{value:.3g}" for value in (least, middle, most))
    if least < -_PRINCIPAL_MOMENT_RTOL * max(most, -least):
        raise ModelError(
            f"link '{link}' has a negative moment of inertia (principal moments {values} kg m^2)",
            where=where,
            allowed="three that are zero or more",
            hint="correct the inertia, or leave the link out",
        )
    if least + middle < (1 - _PRINCIPAL_MOMENT_RTOL) * most:
        log.warning(
            "%s: link '%s' has principal moments of inertia of %s kg m^2, which no body has: the largest is at most "
            "the sum of the others",
            where,
            link,
            values,
        )


def _mimicked(robot: Any, wanted: Collection[str] | None, locked: dict[str, float], where: str) -> set[str]:
    """Names of joints that follow others (mimic), which are locked because couplings are not modelled."""
    joints = {joint.name: joint for joint in robot.joints}
    following = {name: joint.mimic for name, joint in joints.items() if joint.mimic is not None}
    for name, mimic in following.items():
        if wanted is not None and name in wanted:
            raise ModelError(
                f"joint '{name}' follows '{mimic.joint}' (mimic) and cannot move on its own",
                where=where,
                hint=f"leave it out of the joints; it is locked then, at the place that belongs to '{mimic.joint}'",
            )
        if mimic.joint not in joints:
            raise ModelError(
                f"joint '{name}' follows a joint '{mimic.joint}' that is not there",
                where=where,
                hint=nearest_name_hint(str(mimic.joint), joints),
            )
        if name in locked:
            continue
        if wanted is None or mimic.joint in wanted:
            log.warning(
                "%s: joint '%s' follows '%s'; couplings are not modelled, so it is locked", where, name, mimic.joint
            )
        factor = 1.0 if mimic.multiplier is None else float(mimic.multiplier)
        offset = 0.0 if mimic.offset is None else float(mimic.offset)
        locked[name] = factor * _locked_value(joints[mimic.joint], locked) + offset
    return set(following)


def _checked(robot: Any, file: Path, wanted: Sequence[str]) -> dict[str, _Link]:
    """The links by name, the root first, after a check of all joints and links."""
    where = str(file)
    for joint in robot.joints:
        if joint.type not in _MOVABLE_JOINT_TYPES | {"fixed"}:
            allowed = "revolute, continuous, prismatic, fixed"
            raise ModelError(f"joint '{joint.name}' has type '{joint.type}'", where=where, allowed=allowed)
        if joint.type in _MOVABLE_JOINT_TYPES and joint.axis is not None and np.linalg.norm(joint.axis) < 1e-9:
            raise ModelError(f"joint '{joint.name}' has a zero axis", where=where)
    known = [joint.name for joint in robot.joints if joint.type in _MOVABLE_JOINT_TYPES]
    for name in wanted:
        if name not in known:
            raise ModelError(f"there is no movable joint '{name}'", where=where, hint=nearest_name_hint(name, known))
    names = [link.name for link in robot.links]
    for joint in robot.joints:
        for link in (joint.parent, joint.child):
            if link not in names:
                raise ModelError(
                    f"joint '{joint.name}' names a link '{link}' that is not there",
                    where=where,
                    hint=nearest_name_hint(str(link), names),
                )
    below = [joint.child for joint in robot.joints]
    roots = [name for name in dict.fromkeys(names) if name not in below]
    if len(roots) != 1:
        raise ModelError(f"the URDF has {len(roots)} root links", where=where, allowed="exactly one")
    for kind, entries in (
        ("links are called", names),
        ("joints are called", [joint.name for joint in robot.joints]),
        ("joints carry the link", below),
    ):
        repeated = sorted({entry for entry in entries if entries.count(entry) > 1})
        if repeated:
            raise ModelError(f"two {kind} '{repeated[0]}'", where=where, allowed="a tree with unique names")
    links = {
        link.name: _Link(link.name, link.inertial, tuple(j for j in robot.joints if j.parent == link.name))
        for link in robot.links
    }
    return {roots[0]: links[roots[0]], **links}


def _walk(
    links: Mapping[str, _Link], dropped: Set[str], kept: Collection[str], locked: Mapping[str, float], where: str
) -> _Found:
    """Collect joints, bodies and frames from the root on, and merge what is fixed together."""
    root = next(iter(links))
    found = _Found()
    stack: list[tuple[str, str | None, Matrix]] = [(root, None, np.eye(4))]
    while stack:
        link, carrier, at = stack.pop()
        found.frames[link] = (carrier, at)
        inertial = links[link].inertial
        if inertial is not None and inertial.mass:
            origin = np.eye(4) if inertial.origin is None else np.asarray(inertial.origin, float)
            tensor = np.zeros((3, 3)) if inertial.inertia is None else np.asarray(inertial.inertia, float)
            if carrier is not None:
                _check_bodies(link, tensor, where)
            body = Inertia.from_values(float(inertial.mass), np.zeros(3), tensor)
            found.bodies.setdefault(carrier, []).append(body.transformed_by(Placement.from_matrix(at @ origin)))
        for joint in links[link].joints:
            if joint.child in dropped:
                continue
            origin = np.eye(4) if joint.origin is None else np.asarray(joint.origin, float)
            if joint.name in kept:
                found.joints[joint.name] = (carrier, at @ origin, joint)
                stack.append((joint.child, joint.name, np.eye(4)))
            else:
                stack.append((joint.child, carrier, at @ origin @ _locked_motion(joint, locked)))
    loose = sorted(set(links) - set(found.frames) - dropped)
    if loose:
        raise ModelError(f"link '{loose[0]}' does not hang on '{root}'", where=where, allowed="one tree")
    return found


def _parents_first(joints: Mapping[str, tuple[str | None, Matrix, Any]], wanted: Sequence[str]) -> list[str]:
    """The joints in the wanted order, parents before children."""
    order: list[str] = []
    waiting = [name for name in dict.fromkeys(wanted) if name in joints]
    while waiting:
        ready = next(name for name in waiting if joints[name][0] is None or joints[name][0] in order)
        order.append(ready)
        waiting.remove(ready)
    return order


def _joint(source: Any, parent: int, placement: Placement, bodies: tuple[Inertia, ...]) -> Joint:
    """The file's joint with its limits, infinite where there are none."""
    limit = source.limit
    axis = snap_to_unit_entries(_unit_axis(source))
    continuous = source.type == "continuous" or limit is None

    def bound(value: float | None, otherwise: float) -> float:
        return otherwise if value is None or abs(value) >= _UNLIMITED_VALUE else float(value)

    return Joint(
        source.name,
        "prismatic" if source.type == "prismatic" else "revolute",
        parent,
        placement,
        (float(axis[0]), float(axis[1]), float(axis[2])),
        bodies,
        -math.inf if continuous else bound(limit.lower, -math.inf),
        math.inf if continuous else bound(limit.upper, math.inf),
        math.inf if limit is None else bound(limit.effort, math.inf),
        math.inf if limit is None else bound(limit.velocity, math.inf),
    )


def _locked_motion(joint: Any, locked: Mapping[str, float]) -> Matrix:
    if joint.type == "fixed":
        return np.eye(4)
    value = _locked_value(joint, locked)
    axis = _unit_axis(joint)
    if joint.type == "prismatic":
        return homogeneous_transform(np.eye(3), value * axis)
    return homogeneous_transform(axis_angle_rotation(axis, math.sin(value), math.cos(value)), np.zeros(3))


def _locked_value(joint: Any, locked: Mapping[str, float]) -> float:
    """Coordinate at which a joint is locked: as given, else zero or the nearest bound."""
    limit = joint.limit
    low = -math.inf if limit is None or limit.lower is None else float(limit.lower)
    high = math.inf if limit is None or limit.upper is None else float(limit.upper)
    if joint.type == "continuous" or low > high:
        low, high = -math.inf, math.inf
    return locked.get(joint.name, min(max(0.0, low), high))


def _with_all_below(without: Sequence[str], links: Mapping[str, _Link], where: str) -> set[str]:
    found: set[str] = set()
    waiting = list(without)
    while waiting:
        link = waiting.pop()
        if link not in links:
            raise ModelError(
                f"there is no link '{link}' to leave out", where=where, hint=nearest_name_hint(link, links)
            )
        found.add(link)
        waiting += [joint.child for joint in links[link].joints]
    return found


def _unit_axis(joint: Any) -> NDArray[np.float64]:
    axis = np.asarray([1.0, 0.0, 0.0] if joint.axis is None else joint.axis, float)
    return axis / np.linalg.norm(axis)


def mechanism_to_urdf(mechanism: Mechanism, values: Mapping[str, float] | None = None) -> str:
    """URDF text of a mechanism: one link per joint, named frames as links on fixed joints.

    Bodies are merged into one inertial per link. Placements keep full precision. Reading the text back with
    `read_urdf(..., parametric=False)` gives the same numbers to 1e-12.
    """
    mechanism = mechanism.with_numeric_values(values)
    robot = ElementTree.Element("robot", name=mechanism.name)

    def link_name(wanted: str, joint: int) -> str:
        frame = mechanism.frames.get(wanted)
        if frame is None:
            return wanted
        same = frame.joint_index == joint and np.array_equal(
            np.array(ca.DM(frame.placement.homogeneous_matrix())), np.eye(4)
        )
        return wanted if same else link_name(f"{wanted}_", joint)

    links = [link_name("world", -1)] + [link_name(f"{joint.name}_link", i) for i, joint in enumerate(mechanism.joints)]
    ElementTree.SubElement(robot, "link", name=links[0])
    for i, joint in enumerate(mechanism.joints):
        _write_link(robot, links[i + 1], joint)
        _write_joint(robot, joint, links[joint.parent_index + 1], links[i + 1])
    for name, frame in mechanism.frames.items():
        if name in links:
            continue
        ElementTree.SubElement(robot, "link", name=name)
        fixed = f"{name}_fixed"
        while fixed in mechanism.joint_names:
            fixed += "_"
        element = ElementTree.SubElement(robot, "joint", name=fixed, type="fixed")
        _connect(element, frame.placement, links[frame.joint_index + 1], name)
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode") + "\n"


def _write_link(robot: ElementTree.Element, name: str, joint: Joint) -> None:
    """The link that a joint moves, with the joint's bodies merged."""
    link = ElementTree.SubElement(robot, "link", name=name)
    body = merge_bodies(joint.bodies)
    if body is None:
        return
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=_digits(np.array(ca.DM(body.center_of_mass)).ravel()), rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=_digits([float(body.mass)]))
    tensor = np.array(ca.DM(body.inertia_about_com))
    keys = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    ElementTree.SubElement(inertial, "inertia", {key: _digits([tensor[ij]]) for key, ij in keys.items()})


def _write_joint(robot: ElementTree.Element, joint: Joint, parent: str, child: str) -> None:
    values = {
        "lower": joint.lower_limit,
        "upper": joint.upper_limit,
        "effort": joint.effort_limit,
        "velocity": joint.velocity_limit,
    }
    limits = {key: _digits([max(-_UNLIMITED_VALUE, min(value, _UNLIMITED_VALUE))]) for key, value in values.items()}
    kind: str = joint.kind
    if kind == "revolute" and math.isinf(joint.lower_limit) and math.isinf(joint.upper_limit):
        kind, limits = "continuous", {key: limits[key] for key in ("effort", "velocity")}
    element = ElementTree.SubElement(robot, "joint", name=joint.name, type=kind)
    _connect(element, joint.placement, parent, child)
    ElementTree.SubElement(element, "axis", xyz=_digits(joint.axis))
    if kind != "continuous" or math.isfinite(joint.effort_limit) or math.isfinite(joint.velocity_limit):
        ElementTree.SubElement(element, "limit", limits)


def _connect(element: ElementTree.Element, placement: Placement, parent: str, child: str) -> None:
    rotation, translation = np.array(ca.DM(placement.rotation)), np.array(ca.DM(placement.translation)).ravel()
    ElementTree.SubElement(element, "origin", xyz=_digits(translation), rpy=_digits(rpy_from_rotation(rotation)))
    ElementTree.SubElement(element, "parent", link=parent)
    ElementTree.SubElement(element, "child", link=child)


def _digits(values: Iterable[float]) -> str:
    return " ".join(f"{0.0 if abs(v) < 1e-16 else v:.17g}" for v in values)

"""Functions that read and write mechanisms as URDF."""

from __future__ import annotations

import contextlib
import functools
import logging
import math
import site
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterable, Mapping, Sequence, Set
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import casadi as ca
import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.errors import ModelError, require_known_names, unknown_name_error_arguments
from yid_ocp.files import MAX_TEXT_BYTES, check_input_file, is_file
from yid_ocp.model.mechanism import (
    Frame,
    Inertia,
    Joint,
    Mechanism,
    Placement,
    merge_inertias,
    rpy_from_rotation,
    snap_near_integer_entries,
    transform_from_xyz_rpy,
)
from yid_ocp.model.mjcf_robot import joint_displacement_transform, mjcf_joint_constants, read_mjcf_robot_description
from yid_ocp.model.parameters import Parameter, Parameters

_UNLIMITED_VALUE = 1e9  # represents "no limit" where URDF requires a number
_MIN_MASS = 1e-9  # [kg]; avoids overflow in divisions
_MAX_NUMBER = 1e12  # in m, rad, kg and kg m^2; avoids overflow of squares
_PRINCIPAL_MOMENT_RTOL = 1e-2  # tolerance for rounding in the file
_PRINCIPAL_MOMENT_ATOL = 1e-12  # likewise, for point masses [kg m^2]
_MOVABLE_JOINT_TYPES = {"revolute", "continuous", "prismatic"}
INERTIA_TENSOR_KEYS = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}

_LIMITS = {"lower": -math.inf, "upper": math.inf, "effort": math.inf, "velocity": math.inf}  # without a limit

_Carrier = str | None
log = logging.getLogger(__name__)


def _example_robot_urdf(robot: str) -> Path:
    """Path of a robot in the installed example-robot-data, by file stem (any case) or by `folder/file.urdf`."""
    roots = [Path(p) / "cmeel.prefix/share/example-robot-data/robots" for p in [*sys.path, *site.getsitepackages()]]
    roots += [Path(sys.prefix) / "share/example-robot-data/robots"]
    folder = next((root for root in roots if root.is_dir()), None)
    if folder is None:
        what, hint = "the package example-robot-data is not installed", "pip install example-robot-data"
        raise ModelError(what, where=f"package:{robot}", allowed="package:NAME if it is installed", hint=hint)
    files, stem = _urdf_files(folder), robot.lower().removesuffix(".urdf")
    short = {"ur5": "ur5_robot", "ur10": "ur10_robot"}
    stem = short.get(stem, stem)
    found = [robot] if robot in files else [name for name, path in files.items() if path.stem.lower() == stem]
    found = [name for name in found if name == f"{stem}_description/urdf/{stem}.urdf"] or found
    if len(found) == 1:
        return files[found[0]]
    where = f"package:{robot}"
    if found:
        what = f"example-robot-data has {len(found)} robots '{robot}'"
        allowed = ", ".join(f"package:{n}" for n in found)
        raise ModelError(what, where=where, allowed=allowed, hint=f"choose one of them, such as package:{found[0]}")
    what, stems = f"example-robot-data has no robot '{robot}'", sorted({*short, *(p.stem for p in files.values())})
    hint = f"set the path of your robot's URDF or MJCF file, or choose one of the robots below {folder}"
    said = unknown_name_error_arguments(robot, stems, hint)
    raise ModelError(what, where=where, **said)


@functools.cache
def _urdf_files(folder: Path) -> Mapping[str, Path]:
    """URDF files of a folder by their paths in it. A run asks for its robot five times."""
    return {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*.urdf"))}


def urdf_path_from_robot_name(robot: str | Path) -> Path:
    """Return the URDF path for a robot's name in the settings. The file need not exist.

    The name is a path, `package:NAME` for a robot of example-robot-data, or `default:NAME.urdf` for a small mechanism
    that ships with this package. Raises `ModelError` if there is no such robot.
    """
    scheme, _, name = str(robot).partition(":")
    if scheme == "package":
        return _example_robot_urdf(name)
    if scheme != "default":
        return Path(robot)
    known = _shipped()
    if name not in known:
        said = unknown_name_error_arguments(name, known, "give the path of a file of your own, without `default:`")
        raise ModelError(f"no URDF '{name}' ships with yid_ocp", where=str(robot), **said)
    return known[name]


def _shipped() -> dict[str, Path]:
    """URDF files of this package by name, from the repository or the installed wheel."""
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
    exclude_links: Sequence[str] = (),
) -> Mechanism:
    """Read a mechanism from a URDF or MJCF file. The chosen joints can move, and all others are locked.

    Each movable joint has the parameter `JOINT.mass` [kg], which also scales the inertia of its bodies. Links without a
    movable joint before them are fixed to the world. Every link is a frame of the same name. Raises `ModelError` for a
    missing or malformed file, MJCF without `mujoco`, an unknown or repeated joint, or one that does not move.

    Parameters
    ----------
    path : str or Path
        Path or name, as for `urdf_path_from_robot_name`.
    joints : sequence of str, optional
        Movable joints, in this order except that parents come first; default: all that are not locked.
    locked : mapping of str to float, optional
        Positions of locked joints [rad or m]; default: zero or the nearest limit.
    exclude_links : sequence of str
        Links to remove together with their subtrees, such as a tool that is not mounted.
    """
    file = urdf_path_from_robot_name(path)
    locked = dict(locked or {})
    if not is_file(file):
        hint = "correct the path, or use a known robot, such as package:ur5"
        with contextlib.suppress(ModelError):
            _example_robot_urdf(str(path))
            hint = f"did you mean package:{path}?"
        allowed = "the path of a file; package:NAME (of example-robot-data); default:NAME.urdf (of yid_ocp)"
        raise ModelError(f"there is no URDF file '{file}'", where=str(path), allowed=allowed, hint=hint)
    robot, where, chosen = _parsed(file), str(file), list(joints or ())
    named = (*chosen, *locked)
    root = _check_tree(robot, where, named)
    if len(set(named)) < len(named):
        twice = max(named, key=named.count)
        both = " (in joints and in locked joints)" * (twice in locked)
        what, hint = f"joint '{twice}' is listed twice{both}", f"delete one '{twice}'"
        raise ModelError(what, where=where, allowed="each joint once", hint=hint)
    dropped = _with_all_below(exclude_links, robot, where)
    for joint in robot.joints:
        if joint.child in dropped and joint.name in named:
            what = f"joint '{joint.name}' is to be used, but carries the excluded link '{joint.child}'"
            hint = f"leave the link out of exclude_links, or '{joint.name}' out of joints and locked joints"
            raise ModelError(what, where=where, allowed="joints whose links are not excluded", hint=hint)
    _lock_mimics(robot, joints, locked, where)
    if joints is None:
        joints = [j.name for j in robot.joints if j.type in _MOVABLE_JOINT_TYPES and j.name not in locked]
    placed, bodies, frames = _walk(robot, root, dropped, joints, locked, where)
    order: list[str] = []
    waiting = [name for name in dict.fromkeys(joints) if name in placed]
    while waiting:  # parents before children
        order.append(next(name for name in waiting if placed[name][0] is None or placed[name][0] in order))
        waiting.remove(order[-1])

    parameters, made = list[Parameter](), list[Joint]()
    for entry in order:
        carrier, at, source = placed[entry]
        own = {link: bodies[link] for link, (at_joint, *_) in frames.items() if at_joint == entry and link in bodies}
        carried = merge_inertias(own.values())
        if carried is not None:
            mass = float(carried.mass)
            parameter = Parameter(f"{entry}.mass", mass, "kg", 0.0, math.inf, f"mass of the link behind {entry}")
            parameters.append(parameter)
            carried = replace(carried.scaled_by(parameter.symbol / mass), mass=parameter.symbol)
            bodies |= {link: body.scaled_by(parameter.symbol / mass) for link, body in own.items()}
        parent = order.index(carrier) if carrier is not None else -1
        made.append(_joint(source, parent, Placement.from_matrix(at), () if carried is None else (carried,)))
    parents = {name: source.parent for name, (_, _, source) in placed.items()}
    links = {}
    for link, (carrier, at, _) in frames.items():
        near = {} if carrier is None else _proximal_links(link, frames)
        names = frozenset((*near, *(joint for joint, parent in parents.items() if parent in near)))
        index, rest = -1 if carrier is None else order.index(carrier), tuple(bodies[n] for n in near if n in bodies)
        links[link] = Frame(index, Placement.from_matrix(at), rest, names)
    return Mechanism(robot.name, tuple(made), links, Parameters(parameters))


def _proximal_links(link: str, frames: Mapping[str, tuple[_Carrier, Array, str]]) -> dict[str, None]:
    """Links fixed to the same joint as a link, but not in its subtree."""
    beyond, carrier = {link}, frames[link][0]
    for name, (own, _, parent) in frames.items():  # parents before children
        if own == carrier and parent in beyond:
            beyond.add(name)
    return {name: None for name, (own, *_) in frames.items() if own == carrier and name not in beyond}


def _parsed(file: Path) -> SimpleNamespace:
    """Name, links and joints of a URDF or MJCF file that a mechanism needs."""
    try:
        robot = ElementTree.parse(check_input_file(file, MAX_TEXT_BYTES)).getroot()
        if robot.tag == "mujoco":
            return read_mjcf_robot_description(file)
        _check_numbers(robot, str(file))
        links = [
            SimpleNamespace(name=link.attrib["name"], inertial=_read_inertial(link.find("inertial")))
            for link in robot.findall("link")
        ]
        joints = [_read_joint(joint) for joint in robot.findall("joint")]
        return SimpleNamespace(name=robot.attrib["name"], links=links, joints=joints)
    except ModelError:
        raise
    except Exception as error:  # a malformed file raises many kinds
        reason = f"an element has no {error}" if isinstance(error, KeyError) else getattr(error, "what", error)
        allowed, hint = "a URDF file with links and joints", f"find the place by `check_urdf {file}`, and correct it"
        raise ModelError(f"the URDF cannot be read: {reason}", where=str(file), allowed=allowed, hint=hint) from error


def joint_damping_and_friction(robot: str | Path) -> tuple[dict[str, float], dict[str, float]]:
    """Return the damping [N m s/rad] of a URDF or MJCF file and the friction [N m] of a URDF, by joint, if above 0."""
    file = urdf_path_from_robot_name(robot)
    root = ElementTree.parse(check_input_file(file, MAX_TEXT_BYTES)).getroot()
    parts = [(joint.attrib["name"], part) for joint in root.findall("joint") for part in joint.iter("dynamics")]

    def stated(key: str) -> dict[str, float]:
        texts = ((name, part.get(key, "0"), f"joint '{name}': dynamics {key}") for name, part in parts)
        values = {name: _numbers(text, 1, where, str(robot))[0] for name, text, where in texts}
        return {name: value for name, value in values.items() if value > 0}

    constants = mjcf_joint_constants(file).items()
    return stated("damping") | {name: own["damping"] for name, own in constants if "damping" in own}, stated("friction")


def _read_inertial(element: ElementTree.Element | None) -> SimpleNamespace | None:
    if element is None:
        return None
    moments = element.find("inertia")
    tensor = np.zeros((3, 3))
    if moments is not None:
        for key, (i, j) in INERTIA_TENSOR_KEYS.items():
            tensor[i, j] = tensor[j, i] = float(moments.attrib[key])
    mass = float(_part(element, "mass").attrib["value"])
    return SimpleNamespace(mass=mass, inertia=tensor, origin=_read_origin(element))


def _read_joint(element: ElementTree.Element) -> SimpleNamespace:
    axis, limit, mimic = element.find("axis"), element.find("limit"), element.find("mimic")
    names = {tag: _part(element, tag).attrib["link"] for tag in ("parent", "child")}
    said = {} if limit is None else limit.attrib
    bounds = {key: float(said.get(key, value)) for key, value in _LIMITS.items()}
    follows = None
    if mimic is not None:
        law = {key: float(mimic.get(key, value)) for key, value in (("multiplier", 1.0), ("offset", 0.0))}
        follows = SimpleNamespace(joint=mimic.get("joint"), **law)
    return SimpleNamespace(
        name=element.attrib["name"],
        type=element.get("type"),
        origin=_read_origin(element),
        axis=np.array((axis.get("xyz", "1 0 0") if axis is not None else "1 0 0").split(), float),
        limit=SimpleNamespace(**bounds),
        mimic=follows,
        **names,
    )


def _read_origin(element: ElementTree.Element) -> Array:
    origin = element.find("origin")
    given = {} if origin is None else origin.attrib
    return transform_from_xyz_rpy(*([float(x) for x in given.get(key, "0 0 0").split()] for key in ("xyz", "rpy")))


def _part(element: ElementTree.Element, tag: str) -> ElementTree.Element:
    if (part := element.find(tag)) is None:
        raise KeyError(tag)
    return part


def _check_numbers(robot: ElementTree.Element, where: str) -> None:
    if any("xacro}" in part.tag for part in robot.iter()):
        hint = f"expand the macros by `xacro {where} > robot.urdf`, and use robot.urdf"
        raise ModelError("the file has unexpanded xacro macros", where=where, allowed="URDF without macros", hint=hint)
    for owner in robot:
        if owner.tag not in ("link", "joint"):
            continue
        name = f"{owner.tag} '{owner.get('name')}'"
        inertials = owner.findall("inertial")
        if len(inertials) > 1:
            what, hint = f"{name} has {len(inertials)} elements <inertial>", "delete all but one of them in the URDF"
            raise ModelError(what, where=where, allowed="at most one <inertial>", hint=hint)
        for part in (*owner.findall("origin"), *owner.findall("axis"), *owner.findall("inertial/origin")):
            for key in {"xyz", "rpy"} & set(part.attrib):
                _numbers(part.attrib[key], 3, f"{name}: {part.tag} {key}", where)
        for part in (*owner.findall("limit"), *owner.findall("mimic")):
            for key in set(part.attrib) - {"joint"}:
                _numbers(part.attrib[key], 1, f"{name}: {part.tag} {key}", where, infinite=part.tag == "limit")
        for inertial in inertials:
            mass, tensor = inertial.find("mass"), inertial.find("inertia")
            value = 0.0 if mass is None else _numbers(mass.get("value", ""), 1, f"{name}: mass", where)[0]
            if mass is None or value < 0 or 0 < value < _MIN_MASS:
                what = "an inertial without a mass" if mass is None else f"a mass of {value:g} kg"
                allowed = f"a mass of zero, or of {_MIN_MASS:g} kg and more"
                hint = "correct the mass, or delete the <inertial>"
                raise ModelError(f"{name} has {what}", where=where, allowed=allowed, hint=hint)
            if tensor is not None:
                for key in INERTIA_TENSOR_KEYS:
                    _numbers(tensor.get(key, ""), 1, f"{name}: inertia {key}", where)


def _numbers(text: str, count: int, what: str, where: str, infinite: bool = False) -> list[float]:
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    wrong = any(math.isnan(value) or (abs(value) > _MAX_NUMBER and not infinite) for value in numbers)
    if len(numbers) != count or wrong:
        noun = "one number" if count == 1 else f"{count} numbers with blanks between"
        allowed, hint = f"{noun}, of at most {_MAX_NUMBER:g}", f"write '{' '.join(['0.1'] * count)}', for example"
        raise ModelError(f"{what} is '{text[:60]}', but must be {noun}", where=where, allowed=allowed, hint=hint)
    return numbers


def _check_bodies(link: str, tensor: Array, where: str) -> None:
    """Refuse negative moments of inertia, and warn of moments that no mass distribution has."""
    least, middle, most = np.linalg.eigvalsh(0.5 * (tensor + tensor.T))
    values = ", ".join(f"{value:.3g}" for value in (least, middle, most))
    if least < -max(_PRINCIPAL_MOMENT_RTOL * max(most, -least), _PRINCIPAL_MOMENT_ATOL):
        what = f"link '{link}' has a negative moment of inertia (principal moments {values} kg m^2)"
        hint = "correct the <inertia> of the link: a wrong sign, or ixy in place of ixx, are usual causes"
        raise ModelError(what, where=where, allowed="principal moments of 0 or more", hint=hint)
    if least + middle < (1 - _PRINCIPAL_MOMENT_RTOL) * most:
        what = f"{Path(where).name}: link '{link}' has principal moments of inertia of {values} kg m^2, but in any body"
        log.warning("%s the largest is at most the sum of the others. They are used unchanged. Check <inertia>", what)


def _lock_mimics(robot: Any, wanted: Collection[str] | None, locked: dict[str, float], where: str) -> None:
    """Add the joints that follow others (`mimic`) to `locked`, because couplings are not modelled."""
    joints = {joint.name: joint for joint in robot.joints}
    following, still = {name: joint.mimic for name, joint in joints.items() if joint.mimic is not None}, list[str]()
    for name, mimic in following.items():
        if wanted is not None and name in wanted:
            what = f"joint '{name}' follows '{mimic.joint}' (mimic) and cannot move on its own"
            hint = f"leave it out of the joints; it is then locked where '{mimic.joint}' is locked"
            raise ModelError(what, where=where, allowed="joints without <mimic>", hint=hint)
        if mimic.joint not in joints:
            what = f"joint '{name}' follows (mimic) a joint '{mimic.joint}' that does not exist"
            raise ModelError(what, where=where, **unknown_name_error_arguments(str(mimic.joint), joints))
        if name in locked:
            continue
        still += [f"'{name}' follows '{mimic.joint}'"] if wanted is None or mimic.joint in wanted else []
        locked[name] = mimic.multiplier * _locked_value(joints[mimic.joint], locked) + mimic.offset
    if still:
        what = "couplings of joints (mimic) are not modelled, so the first of each pair does not move in the model"
        log.warning("%s: %s: %s", Path(where).name, what, ", ".join(still))


def _check_tree(robot: Any, where: str, wanted: Sequence[str]) -> str:
    """Name of the root link, after a check of all joints and links and of the names of wanted joints."""
    for joint in robot.joints:
        if joint.type not in _MOVABLE_JOINT_TYPES | {"fixed"}:
            what, hint = f"joint '{joint.name}' has the unknown type '{joint.type}'", "set type fixed, for example"
            raise ModelError(what, where=where, allowed="revolute, continuous, prismatic, fixed", hint=hint)
        if joint.type in _MOVABLE_JOINT_TYPES and np.linalg.norm(joint.axis) < 1e-9:
            what, hint = f"the axis of joint '{joint.name}' is 0 0 0", "write for example 0 0 1, or set type fixed"
            raise ModelError(what, where=where, allowed="an axis other than 0 0 0", hint=hint)
    known = [joint.name for joint in robot.joints if joint.type in _MOVABLE_JOINT_TYPES]
    require_known_names(wanted, known, "movable joint", where, ModelError)
    names, below = [link.name for link in robot.links], [joint.child for joint in robot.joints]
    for joint in robot.joints:
        for link in (joint.parent, joint.child):
            if link not in names:
                what = f"joint '{joint.name}' connects a link '{link}' that does not exist"
                raise ModelError(what, where=where, **unknown_name_error_arguments(str(link), names))
    roots = [name for name in dict.fromkeys(names) if name not in below]
    if len(roots) != 1:
        what = f"the URDF has {len(roots)} root links" + (f": {', '.join(map(str, roots[:4]))}" if roots else "")
        hint = "connect them by a joint of type fixed" if roots else "delete the joint that closes a loop"
        raise ModelError(what, where=where, allowed="exactly one link without a parent", hint=hint)
    kinds = {"links are called": names, "joints are called": [joint.name for joint in robot.joints]}
    for kind, entries in (kinds | {"joints carry the link": below}).items():
        if repeated := sorted({entry for entry in entries if entries.count(entry) > 1}):
            hint = ("delete" if entries is below else "rename") + " one of the two in the URDF"
            allowed = "a tree in which every name is unique and every link has one parent"
            raise ModelError(f"two {kind} '{repeated[0]}'", where=where, allowed=allowed, hint=hint)
    return str(roots[0])


def _walk(
    robot: Any, root: str, dropped: Set[str], kept: Collection[str], locked: Mapping[str, float], where: str
) -> tuple[dict[str, tuple[_Carrier, Array, Any]], dict[str, Inertia], dict[str, tuple[_Carrier, Array, str]]]:
    """Kept joints, bodies by link, and for each link its carrier (kept joint or None), pose (4, 4) and parent link."""
    links = {link.name: link.inertial for link in robot.links}
    joints, bodies = dict[str, tuple[_Carrier, Array, Any]](), dict[str, Inertia]()
    frames: dict[str, tuple[_Carrier, Array, str]] = {}
    stack: list[tuple[str, _Carrier, Array, str]] = [(root, None, np.eye(4), "")]
    while stack:
        link, carrier, at, parent = stack.pop()
        frames[link] = (carrier, at, parent)
        inertial = links[link]
        if inertial is not None and carrier is not None and not inertial.mass and inertial.inertia.any():
            log.warning("%s: link '%s' has moments of inertia, but no mass. They are not used", Path(where).name, link)
        if inertial is not None and inertial.mass:
            if carrier is not None:
                _check_bodies(link, inertial.inertia, where)
            body = Inertia.from_values(inertial.mass, np.zeros(3), inertial.inertia)
            bodies[link] = body.transformed_by(Placement.from_matrix(at @ inertial.origin))
        for joint in robot.joints:
            if joint.parent != link or joint.child in dropped:
                continue
            if joint.name in kept:
                joints[joint.name] = (carrier, at @ joint.origin, joint)
                stack.append((joint.child, joint.name, np.eye(4), ""))
            else:
                motion = np.eye(4)
                if joint.type != "fixed":
                    motion = joint_displacement_transform(_unit_axis(joint), _locked_value(joint, locked), joint.type)
                stack.append((joint.child, carrier, at @ joint.origin @ motion, link))
    if loose := sorted(set(links) - set(frames) - dropped):
        what = f"link '{loose[0]}' is not connected to the root link '{root}'"
        raise ModelError(what, where=where, allowed="one tree of links", hint="connect it by a joint, or delete it")
    return joints, bodies, frames


def _joint(source: Any, parent: int, placement: Placement, bodies: tuple[Inertia, ...]) -> Joint:
    x, y, z = map(float, snap_near_integer_entries(_unit_axis(source)))
    stated = vars(source.limit) | ({"lower": -math.inf, "upper": math.inf} if source.type == "continuous" else {})
    bounds = ((key, _LIMITS[key] if abs(stated[key]) >= _UNLIMITED_VALUE else float(stated[key])) for key in _LIMITS)
    limits = {f"{key}_limit": bound for key, bound in bounds}
    kind: Literal["revolute", "prismatic"] = "prismatic" if source.type == "prismatic" else "revolute"
    return Joint(source.name, kind, parent, placement, (x, y, z), bodies, **limits)


def _locked_value(joint: Any, locked: Mapping[str, float]) -> float:
    """Position at which a joint is locked: the given value, else zero or the nearest limit."""
    low, high = joint.limit.lower, joint.limit.upper
    if joint.type == "continuous" or low > high:
        low, high = -math.inf, math.inf
    return locked.get(joint.name, min(max(0.0, low), high))


def _with_all_below(excluded: Sequence[str], robot: Any, where: str) -> set[str]:
    found, waiting, links = set[str](), list(excluded), [link.name for link in robot.links]
    while waiting:
        link = waiting.pop()
        require_known_names([link], links, "link", f"{where}: exclude_links", ModelError)
        found.add(link)
        waiting += [joint.child for joint in robot.joints if joint.parent == link]
    return found


def _unit_axis(joint: Any) -> Array:
    return np.asarray(joint.axis / np.linalg.norm(joint.axis))


def mechanism_to_urdf(mechanism: Mechanism, values: Mapping[str, float] | None = None) -> str:
    """Return a mechanism as URDF text. The bodies of a joint become one link, and each frame a link on a fixed joint.

    Parameters have the numbers in `values`, else nominal ones. `read_urdf` reads the same numbers back to 1e-12.
    """
    mechanism = mechanism.with_numeric_values(values)
    robot = ElementTree.Element("robot", name=mechanism.name)

    def link_name(wanted: str, joint: int) -> str:
        frame = mechanism.frames.get(wanted)
        if frame is None:
            return wanted
        place = np.array(ca.DM(frame.placement.homogeneous_matrix()))
        same = frame.joint_index == joint and np.array_equal(place, np.eye(4))
        return wanted if same else link_name(f"{wanted}_", joint)

    links = [link_name("world", -1)] + [link_name(f"{joint.name}_link", i) for i, joint in enumerate(mechanism.joints)]
    ElementTree.SubElement(robot, "link", name=links[0])
    for i, joint in enumerate(mechanism.joints):
        link, body = ElementTree.SubElement(robot, "link", name=links[i + 1]), merge_inertias(joint.bodies)
        if body is not None:
            inertial = ElementTree.SubElement(link, "inertial")
            tensor = np.array(ca.DM(body.inertia_about_com))
            com = _digits(np.array(ca.DM(body.center_of_mass)).ravel())
            ElementTree.SubElement(inertial, "origin", xyz=com, rpy="0 0 0")
            ElementTree.SubElement(inertial, "mass", value=_digits([float(body.mass)]))
            moments = {key: _digits([tensor[ij]]) for key, ij in INERTIA_TENSOR_KEYS.items()}
            ElementTree.SubElement(inertial, "inertia", moments)
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


def _write_joint(robot: ElementTree.Element, joint: Joint, parent: str, child: str) -> None:
    values = {key: getattr(joint, f"{key}_limit") for key in _LIMITS}
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

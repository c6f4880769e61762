"""Mechanisms from URDF files and back."""

from __future__ import annotations

import contextlib
import io
import math
import site
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.errors import ModelError, nearest
from yid_ocp.model.mechanism import Frame, Inertia, Joint, Mechanism, Placement, merged
from yid_ocp.model.parameters import Parameter, Parameters
from yid_ocp.model.rotations import Matrix, angles_of, snapped, transform, turn

# Stands for no limit where URDF asks for a number.
UNLIMITED = 1e9


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


def read_urdf(
    path: str | Path,
    joints: Sequence[str] | None = None,
    locked: Mapping[str, float] | None = None,
    name: str | None = None,
    parametric: bool = True,
    exclude_links: Sequence[str] = (),
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
    import yourdfpy

    path, chosen, locked, without = Path(str(path)), joints, dict(locked or {}), exclude_links

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
    made: list[Joint] = []
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

        made.append(
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
    return Mechanism(name or robot.name, tuple(made), named, Parameters(parameters))


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
    return transform(turn(axis, math.sin(value), math.cos(value)), np.zeros(3))


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


def urdf_text(mechanism: Mechanism, values: Mapping[str, float] | None = None) -> str:
    """The mechanism as URDF text: one link per joint, named frames as links on fixed joints.

    Bodies are merged into one inertial per link. Placements keep full precision. Reading the text back with
    `read_urdf(..., parametric=False)` gives the same numbers to 1e-12.
    """
    mechanism = mechanism.numeric(values)

    def text(values: Iterable[float]) -> str:
        return " ".join(f"{0.0 if abs(v) < 1e-16 else v:.17g}" for v in values)

    def origin(element: ElementTree.Element, placement: Placement) -> None:
        rotation = np.array(ca.DM(placement.rotation))
        translation = np.array(ca.DM(placement.translation)).ravel()
        ElementTree.SubElement(element, "origin", xyz=text(translation), rpy=text(angles_of(rotation)))

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

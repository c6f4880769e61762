"""A reader of robots in MJCF files. MuJoCo compiles a file; its bodies and joints become links and joints of a URDF."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from yid_ocp.arrays import Array
from yid_ocp.errors import ModelError, import_optional
from yid_ocp.files import check_input_file
from yid_ocp.model.mechanism import homogeneous_transform, numeric_axis_sin_cos_rotation

log = logging.getLogger(__name__)
_JOINT_TYPE_NAMES = {2: "prismatic", 3: "revolute"}
_JOINT_EQUALITY, _WELD_EQUALITY, _SITE_OBJECT, _FREE_JOINT, _WORLD = 2, 1, 6, 0, "world"


def read_mjcf_robot_description(file: Path) -> SimpleNamespace:
    """Read the name, links and joints of an MJCF file, in the form that `read_urdf` uses. Omitted elements are logged.

    Each body becomes a link, and each site a frame. The inertia of a body is its `inertial` element or, without this
    element, computed by MuJoCo from the geoms. Coordinates are as in MuJoCo, including `ref`. A joint that a linear
    equality constraint couples to another joint is treated like a URDF `mimic` joint. A free body that a weld attaches
    to another body is fixed to that body; other free objects are omitted. Raises `ModelError` if `mujoco` is not
    installed, if it cannot compile the file, or if the robot has a free or ball joint.
    """
    model = _compiled(file, file.stat().st_mtime_ns)
    follows, welds, loose = _followed_joints(model), _welded_free_bodies(model), _bodies_of_free_objects(model)
    made = [_body(model, i, follows, welds, str(file)) for i in range(1, model.nbody) if i not in loose]
    links = [SimpleNamespace(name=_WORLD, inertial=None), *(link for own, _ in made for link in own)]
    joints = [joint for _, own in made for joint in own]
    for i in (i for i in range(model.nsite) if int(model.site_bodyid[i]) not in loose):
        name = model.site(i).name
        if name and name not in {link.name for link in links}:
            links.append(SimpleNamespace(name=name, inertial=None))
            at = _pose(model.site_pos[i], model.site_quat[i])
            joints.append(_fixed(f"{name}_site", _body_name(model, model.site_bodyid[i]), name, at))
    return SimpleNamespace(name=file.stem, links=links, joints=joints)


def mjcf_joint_constants(file: Path) -> dict[str, dict[str, float]]:
    """Read the constants of the joints that an MJCF file states, by joint and name. Empty for other file formats.

    Names are `armature` [kg m^2], `damping` [N m s/rad] and `frictionloss` [N m]. A position actuator gives
    `servo_gain` [N m/rad] and `servo_damping` [N m s/rad]. Errors are as in `read_mjcf_robot_description`.
    """
    if file.suffix.lower() == ".urdf" or b"<mujoco" not in check_input_file(file).read_bytes():
        return {}
    model = _compiled(file, file.stat().st_mtime_ns)
    found: dict[str, dict[str, float]] = {_joint_name(model, j): {} for j in range(model.njnt)}
    for j in range(model.njnt):
        dof, own = int(model.jnt_dofadr[j]), found[_joint_name(model, j)]
        for name in ("armature", "damping", "frictionloss"):
            value = float(np.ravel(getattr(model, f"dof_{name}")[dof])[0])
            own |= {name: value} if value > 0 else {}
    for i in filter(lambda i: _is_position_actuator(model, i), range(model.nu)):
        gain, damping = float(model.actuator_gainprm[i, 0]), -float(model.actuator_biasprm[i, 2])
        found[_joint_name(model, int(model.actuator_trnid[i, 0]))] |= {"servo_gain": gain, "servo_damping": damping}
    return {name: own for name, own in found.items() if own}


def _is_position_actuator(model: Any, i: int) -> bool:
    """Whether an actuator is a position servo of a joint with equal gains for command and measurement."""
    alike = float(model.actuator_biasprm[i, 1]) == -float(model.actuator_gainprm[i, 0]) != 0
    return alike and int(model.actuator_trntype[i]) == 0 and float(model.actuator_gear[i, 0]) == 1.0


def _is_motor(model: Any, i: int) -> bool:
    constant = int(model.actuator_gaintype[i]) == int(model.actuator_biastype[i]) == int(model.actuator_dyntype[i]) == 0
    return constant and int(model.actuator_trntype[i]) == 0


@functools.lru_cache(maxsize=4)
def _compiled(file: Path, changed: int) -> Any:
    """Compiled model of a file version; omitted elements are logged once."""
    mujoco = import_optional("mujoco", "blind", f"reading {file} needs the package mujoco", ModelError)
    try:
        model = mujoco.MjModel.from_xml_path(str(check_input_file(file)))
    except Exception as error:  # MuJoCo raises ValueError, and others for files that are missing
        what = f"MuJoCo cannot read the file ({str(error).splitlines()[0] if str(error) else type(error).__name__})"
        hint = "correct the file until `python -m mujoco.viewer --mjcf=FILE` opens it; copy its meshes beside it"
        raise ModelError(what, where=str(file), allowed="MJCF that MuJoCo compiles", hint=hint) from error
    for sentence in _left_out(model):
        log.warning("%s: %s", file.name, sentence)
    return model


def _body(
    model: Any, i: int, follows: dict[str, SimpleNamespace], welds: dict[int, tuple[int, Array]], where: str
) -> tuple[list[SimpleNamespace], list[SimpleNamespace]]:
    """Links and joints of one body: one link for each joint but the last, and one for the body itself."""
    name, parent = _body_name(model, i), _body_name(model, model.body_parentid[i])
    mass, inertial = float(model.body_mass[i]), None
    if mass > 0:
        turn = _pose(model.body_ipos[i], model.body_iquat[i])
        inertial = SimpleNamespace(mass=mass, inertia=np.diag(model.body_inertia[i]), origin=turn)
    links, joints = [SimpleNamespace(name=name, inertial=inertial)], []
    if i in welds:
        carrier, at = welds[i]
        return links, [_fixed(f"{name}_weld", _body_name(model, carrier), name, at)]
    # pose of the next joint's frame in the previous link
    at, last = _pose(model.body_pos[i], model.body_quat[i]), np.zeros(3)
    first, count = int(model.body_jntadr[i]), int(model.body_jntnum[i])
    for j in range(first, first + count):
        label, kind = _joint_name(model, j), _JOINT_TYPE_NAMES.get(int(model.jnt_type[j]))
        if kind is None:
            what = f"joint '{label}' has the type {'ball' if model.jnt_type[j] else 'free'}, which is not modelled"
            hint = "replace a ball joint by three hinges; delete a free joint, so that its body is fixed"
            raise ModelError(what, where=where, allowed="hinge, slide", hint=hint)
        place, axis, ref = model.jnt_pos[j], model.jnt_axis[j], float(model.qpos0[model.jnt_qposadr[j]])
        origin = at @ _shift(place - last) @ joint_displacement_transform(axis, -ref, kind)
        carried = name if j == first + count - 1 and not np.any(place) else f"{label}_link"
        if carried != name:
            links.append(SimpleNamespace(name=carried, inertial=None))
        urdf_type = kind if model.jnt_limited[j] or kind == "prismatic" else "continuous"
        made = {"axis": np.array(axis), "limit": _limits(model, j), "mimic": follows.get(label)}
        joints.append(SimpleNamespace(name=label, type=urdf_type, origin=origin, parent=parent, child=carried, **made))
        parent, at, last = carried, np.eye(4), place
    if parent != name:
        joints.append(_fixed(f"{name}_fixed", parent, name, at @ _shift(-last)))
    return links, joints


def _limits(model: Any, j: int) -> SimpleNamespace:
    """Limits of a joint. The effort limit is `actuatorfrcrange` or follows from the forces of its actuators."""
    lower, upper = model.jnt_range[j] if model.jnt_limited[j] else (-math.inf, math.inf)
    efforts = [float(np.abs(model.jnt_actfrcrange[j]).max())] if model.jnt_actfrclimited[j] else []
    for i in (i for i in range(model.nu) if model.actuator_trntype[i] == 0 and model.actuator_trnid[i, 0] == j):
        if model.actuator_forcelimited[i]:
            efforts.append(float(np.abs(model.actuator_forcerange[i] * model.actuator_gear[i, 0]).max()))
        if _is_motor(model, i) and model.actuator_ctrllimited[i]:
            gain = model.actuator_gear[i, 0] * model.actuator_gainprm[i, 0]
            efforts.append(float(np.abs(model.actuator_ctrlrange[i] * gain).max()))
    return SimpleNamespace(lower=lower, upper=upper, effort=min(efforts, default=math.inf), velocity=math.inf)


def _followed_joints(model: Any) -> dict[str, SimpleNamespace]:
    """For each joint coupled by an active linear equality: the joint that it follows, multiplier and offset."""
    found = {}
    for i in range(model.neq):
        first, second = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
        linear = not np.any(model.eq_data[i, 2:5])
        if int(model.eq_type[i]) == _JOINT_EQUALITY and second >= 0 and linear and model.eq_active0[i]:
            refs = [float(model.qpos0[model.jnt_qposadr[j]]) for j in (first, second)]
            offset, factor = float(model.eq_data[i, 0]), float(model.eq_data[i, 1])
            law = {"multiplier": factor, "offset": offset + refs[0] - factor * refs[1]}
            found[_joint_name(model, first)] = SimpleNamespace(joint=_joint_name(model, second), **law)
    return found


def _welded_free_bodies(model: Any) -> dict[int, tuple[int, Array]]:
    """Indices of free bodies that an active weld holds, with the index of the other body and the pose (4, 4) in it."""
    found: dict[int, tuple[int, Array]] = {}
    for i in (i for i in range(model.neq) if int(model.eq_type[i]) == _WELD_EQUALITY and model.eq_active0[i]):
        first, second, data = int(model.eq_obj1id[i]), int(model.eq_obj2id[i]), model.eq_data[i]
        if int(model.eq_objtype[i]) == _SITE_OBJECT:
            sites = (_pose(model.site_pos[site], model.site_quat[site]) for site in (first, second))
            pose = next(sites) @ np.linalg.inv(next(sites))
            first, second = int(model.site_bodyid[first]), int(model.site_bodyid[second])
        else:
            pose = _pose(data[3:6], data[6:10]) @ _shift(-data[:3])
        for carrier, carried, at in ((first, second, pose), (second, first, np.linalg.inv(pose))):
            joint = int(model.body_jntadr[carried])
            if joint >= 0 and int(model.jnt_type[joint]) == _FREE_JOINT and carried not in found:
                found[carried] = carrier, at
                break
    return found


def _bodies_of_free_objects(model: Any) -> set[int]:
    """Indices of the bodies of objects beside the robot: their only joint is a free one, and no weld holds them."""
    roots, welds = model.body_rootid[model.jnt_bodyid].tolist(), _welded_free_bodies(model)
    free = [i for i in model.jnt_bodyid[model.jnt_type == _FREE_JOINT] if roots.count(i) == 1 and i not in welds]
    return {i for i in range(1, model.nbody) if model.body_rootid[i] in free}


def _left_out(model: Any) -> Iterator[str]:
    """Sentences on elements of the file that the mechanism omits."""
    taken = len(_followed_joints(model)) + len(_welded_free_bodies(model))
    others_than_servos = [i for i in range(model.nu) if not _is_position_actuator(model, i)]
    motors, lacking = sum(_is_motor(model, i) for i in others_than_servos), "Predicted efforts lack their forces"
    others = {
        "motors": (motors, "Efforts count as torques at the joint, and the motors' limits are kept"),
        "actuators other than motors and position servos": (len(others_than_servos) - motors, lacking),
        "equalities": (model.neq - taken, "For a weld or connect that closes a loop, set model.grasp"),
        "springs of joints": (int(np.sum(model.jnt_stiffness > 0)), "To add them to efforts, set model.joint_springs"),
        "tendons": (model.ntendon, lacking),
        "bodies of free objects": (len(_bodies_of_free_objects(model)), "Contacts are not modelled"),
        "gravity compensation of bodies": (int(np.sum(np.asarray(model.body_gravcomp) > 0)), lacking),
    }
    for noun, (count, remedy) in ((noun, own) for noun, own in others.items() if own[0]):
        yield f"the model leaves out {noun} ({count} in the file). {remedy}"


def _body_name(model: Any, i: int) -> str:
    return model.body(int(i)).name or f"body{int(i)}" if i else _WORLD


def _joint_name(model: Any, j: int) -> str:
    """Name of a joint; without one, that of its body, with a number if the body has several joints."""
    body = int(model.jnt_bodyid[j])
    number = j - int(model.body_jntadr[body]) + 1 if model.body_jntnum[body] > 1 else ""
    return model.joint(j).name or f"{_body_name(model, body)}_joint{number}"


def _fixed(name: str, parent: str, child: str, origin: Array) -> SimpleNamespace:
    limit = SimpleNamespace(lower=-math.inf, upper=math.inf, effort=math.inf, velocity=math.inf)
    own = {"axis": np.array([1.0, 0, 0]), "limit": limit, "mimic": None, "parent": parent, "child": child}
    return SimpleNamespace(name=name, type="fixed", origin=origin, **own)


def _pose(position: Array, quaternion: Array) -> Array:
    return homogeneous_transform(Rotation.from_quat(np.roll(quaternion, -1)).as_matrix(), position)


def _shift(translation: Array) -> Array:
    return homogeneous_transform(np.eye(3), translation)


def joint_displacement_transform(axis: Array, amount: float, kind: str) -> Array:
    """Compute the pose (4, 4) of a prismatic or revolute joint with unit axis (3,) at position `amount` [m or rad]."""
    if kind == "prismatic":
        return _shift(amount * axis)
    return homogeneous_transform(numeric_axis_sin_cos_rotation(axis, math.sin(amount), math.cos(amount)), np.zeros(3))

"""Unmodelled effects added to a virtual experiment in MuJoCo's own terms, independently of `yid_ocp.effects`.

Whatever MuJoCo has a term of its own for (joint damping, armature, inertias, sites) is set in its model; other forces
are worked out here in NumPy at every inner step; errors of sensors and clocks are put into the finished recording. None
of the equations of `yid_ocp.effects` take part, except for effects that only change the description of the system
(masses, lengths, rest angles, gravity, where a grasp sits).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.effects import make_effect
from yid_ocp.effects.base import joints_by_arm, object_joints
from yid_ocp.errors import ConfigError, ModelError, unknown_name_details
from yid_ocp.model.system import System
from yid_ocp.virtual.experiment import VirtualExperiment, run_virtual_experiment
from yid_ocp.virtual.mjcf import import_mujoco
from yid_ocp.virtual.out_of_library_effects import OUT_OF_LIBRARY_EFFECTS, EffectContext, ForceCallback
from yid_ocp.virtual.rigid_body_terms import ParameterEvaluator

Array = NDArray[np.float64]

_AIR_DENSITY = 1.2
"""[kg/m^3]"""
_FRICTION_SMOOTHING_SPEED = 0.02
"""v_s of dry friction [rad/s]."""
_MAX_PAYLOAD_DISTANCE = 1.0
"""Distance of a payload's mass from its frame [m]."""

# a change of the system's description; servos are MuJoCo's own actuators, which delay and clip
_DESCRIPTION_KINDS: tuple[str, ...] = (
    "density",
    "point_mass",
    "length_scale",
    "link_mass",
    "rest_curvature",
    "bend_anisotropy",
    "gravity_tilt",
    "grasp_offset",
    "servo_gain",
    "servo_delay",
    "servo_saturation",
)
# a term that MuJoCo's own model has
_MUJOCO_MODEL_KINDS: tuple[str, ...] = ("kelvin_voigt", "joint_viscous", "rotor_inertia", "payload")
# a force that is worked out here
_FORCE_KINDS: tuple[str, ...] = (
    "cubic_stiffness",
    "standard_linear_solid",
    "hysteresis",
    "aerodynamic_drag",
    "gravity_scale",
    "joint_spring",
    "joint_coulomb",
    "joint_stribeck",
    "joint_presliding",
    "effort_lag",
)
# an error of a sensor or clock
_SENSOR_ERROR_KINDS: tuple[str, ...] = (
    "effort_gain",
    "effort_offset",
    "effort_delay",
    "encoder_offset",
    "series_elasticity",
    "backlash",
    "camera_translation",
    "camera_rotation",
    "camera_scale",
    "camera_latency",
    "surface_offset",
)
INJECTABLE_KINDS = (*_DESCRIPTION_KINDS, *_MUJOCO_MODEL_KINDS, *_FORCE_KINDS, *_SENSOR_ERROR_KINDS)
"""Effect kinds of the library that can be simulated in MuJoCo."""


@dataclass(frozen=True)
class InjectedEffect:
    """An effect present in the data and absent from the model.

    Attributes
    ----------
    kind : str
        Of `INJECTABLE_KINDS` or `OUT_OF_LIBRARY_EFFECTS`.
    location : str
    values : mapping of quantity to float
        As in the vocabulary; for those outside it `size`, in the unit of the force that it makes.
    """

    kind: str
    location: str
    values: Mapping[str, float] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """`kind@location`."""
        return f"{self.kind}@{self.location}"


def run_injected_experiment(
    system: System,
    values: Mapping[str, float],
    effects: Sequence[InjectedEffect],
    experiment: VirtualExperiment | None = None,
) -> Recording:
    """Simulate a virtual experiment with effects that are absent from the system's description.

    Parameters
    ----------
    system : System
        Nominal, with driven joints.
    values : mapping of str to float
        True parameter values.
    effects : sequence of InjectedEffect
    experiment : VirtualExperiment, optional
        Its own `injected` is replaced.

    Returns
    -------
    Recording
        `truth` is that of the nominal parameters.

    Raises
    ------
    ConfigError
        A kind that cannot be done here.
    ModelError
        A payload that is too far off, or takes away what is not there.
    ConfigError, ModelError, DataError
        As `run_virtual_experiment`.
    """
    known = (*INJECTABLE_KINDS, *OUT_OF_LIBRARY_EFFECTS)
    for effect in effects:
        if effect.kind not in known:
            raise ConfigError(
                f"{effect.kind} cannot be done in MuJoCo here",
                where=effect.label,
                **unknown_name_details(effect.kind, known),
            )
    described = [make_effect(e.kind, e.location, system, e.values) for e in effects if e.kind in _DESCRIPTION_KINDS]
    changed = system.with_effects(described) if described else system
    # a servo acts on what its encoder reads: gears with play are part of the mechanics
    play = {e.location: e.values["width"] for e in effects if e.kind == "backlash" and e.location in system.servos}
    inner = [e for e in effects if e.kind not in _DESCRIPTION_KINDS and e.kind not in _SENSOR_ERROR_KINDS]
    injected = _InjectedTerms(changed, values, inner) if inner else None
    chosen = replace(experiment or VirtualExperiment(), injected_terms=injected, gear_play=play)
    made = run_virtual_experiment(changed, values, chosen)
    for effect in effects:
        if effect.kind in _SENSOR_ERROR_KINDS and effect.location not in play:
            made = _with_sensor_error(made, system, effect)
    return made


class _InjectedTerms:
    """Effects as MuJoCo terms: `edit_model` edits the model, MuJoCo calls `add_forces` at every step.

    Parameters
    ----------
    system : System
    values : mapping of str to float
    effects : sequence of InjectedEffect
        Of `_MUJOCO_MODEL_KINDS`, `_FORCE_KINDS` or `OUT_OF_LIBRARY_EFFECTS`.
    """

    def __init__(self, system: System, values: Mapping[str, float], effects: Sequence[InjectedEffect]) -> None:
        self._system, self._effects = system, tuple(effects)
        self._value = value = ParameterEvaluator(system, values)
        self._scene = EffectContext(
            system,
            {s.joint_name: float(value(s.stiffness)[0]) for s in system.elastic_joints},
            {s.joint_name: float(value(s.rest_angle)[0]) for s in system.elastic_joints},
        )
        self._shape = {
            s.name: (float(value(s.radius)[0]), [float(value(x)[0]) for x in s.link_lengths])
            for s in system.segment_layouts
        }
        self._forces: list[ForceCallback] = []

    def edit_model(self, model: Any) -> None:
        """Edit a compiled `mujoco.MjModel` and work out the forces."""
        for effect in self._effects:
            size, place = effect.values, effect.location
            if effect.kind == "kelvin_voigt":
                at, stiffness, _ = self._scene.segment_springs(model, place)
                model.dof_damping[at] += size["tau"] * stiffness
            elif effect.kind == "joint_viscous":
                model.dof_damping[model.joint(place).id] += size["b"]
            elif effect.kind == "rotor_inertia":
                model.dof_armature[model.joint(place).id] += size["armature"]
            elif effect.kind in OUT_OF_LIBRARY_EFFECTS:
                self._forces.append(OUT_OF_LIBRARY_EFFECTS[effect.kind](self._scene, model, place, size["size"]))
            elif effect.kind == "payload":
                self._weigh(model, place, size)
            else:
                self._forces.append(getattr(self, f"_{effect.kind}")(model, place, size))

    def start_motion(self, data: Any) -> None:
        """Start the memory of effects that have one."""
        self._scene.has_motion_begun = True

    def add_forces(self, model: Any, data: Any) -> None:
        """Add the forces to `qfrc_passive`."""
        for push in self._forces:
            push(model, data)

    # -- effects of the vocabulary ------------------------------------------------------------------------------------

    def _cubic_stiffness(self, model: Any, place: str, size: Mapping[str, float]) -> ForceCallback:
        at, _, rest = self._scene.segment_springs(model, place)
        k3 = size["k3"]

        def push(_: Any, data: Any) -> None:
            data.qfrc_passive[at] -= k3 * (data.qpos[at] - rest) ** 3

        return push

    def _standard_linear_solid(self, model: Any, place: str, size: Mapping[str, float]) -> ForceCallback:
        at, stiffness, _ = self._scene.segment_springs(model, place)
        branch, time = size["ratio"] * stiffness, size["relaxation_time"]
        state: dict[str, Any] = {"z": None, "t": 0.0}

        def push(_: Any, data: Any) -> None:
            if not self._scene.has_motion_begun:
                return
            q = np.array(data.qpos[at])
            if state["z"] is None:
                state["z"], state["t"] = q.copy(), float(data.time)
            step = float(data.time) - state["t"]
            if step > 0:
                state["z"] = q + (state["z"] - q) * math.exp(-step / time)
                state["t"] = float(data.time)
            data.qfrc_passive[at] -= branch * (q - state["z"])

        return push

    def _hysteresis(self, model: Any, place: str, size: Mapping[str, float]) -> ForceCallback:
        at, _, _ = self._scene.segment_springs(model, place)
        stiffness, angle = size["stiffness"], size["yield_angle"]
        state: dict[str, Any] = {"z": np.zeros(len(at)), "t": 0.0}

        def push(_: Any, data: Any) -> None:
            if not self._scene.has_motion_begun:
                return
            v = np.array(data.qvel[at])
            step = float(data.time) - state["t"]
            if step > 0:
                state["z"] = state["z"] + step * (v - np.abs(v) * state["z"] / angle)
                state["t"] = float(data.time)
            data.qfrc_passive[at] -= stiffness * state["z"]

        return push

    def _aerodynamic_drag(self, model: Any, place: str, size: Mapping[str, float]) -> ForceCallback:
        mujoco = import_mujoco()
        segment = self._system.segment_layout(place)
        bodies = [int(model.jnt_bodyid[model.joint(link[-1]).id]) for link in segment.link_joints]
        radius, lengths = self._shape[place]
        factor = [_AIR_DENSITY * size["cd"] * radius * length for length in lengths]
        found = np.zeros(6)

        def push(model: Any, data: Any) -> None:
            for body, scale in zip(bodies, factor, strict=True):
                mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, found, 0)
                along = data.xmat[body].reshape(3, 3)[:, 2]
                normal = found[3:] - along * (along @ found[3:])
                drag = -scale * np.linalg.norm(normal) * normal
                mujoco.mj_applyFT(model, data, drag, np.zeros(3), data.xipos[body], body, data.qfrc_passive)

        return push

    def _gravity_scale(self, model: Any, place: str, size: Mapping[str, float]) -> ForceCallback:
        mujoco = import_mujoco()
        bodies = sorted({int(model.jnt_bodyid[model.joint(joint).id]) for joint in object_joints(self._system)})
        weights = [size["fraction"] * model.body_mass[body] * np.array(model.opt.gravity) for body in bodies]

        def push(model: Any, data: Any) -> None:
            for body, weight in zip(bodies, weights, strict=True):
                mujoco.mj_applyFT(model, data, weight, np.zeros(3), data.xipos[body], body, data.qfrc_passive)

        return push

    def _joint_spring(self, model: Any, place: str, size: Mapping[str, float]) -> ForceCallback:
        # not MuJoCo's own spring, whose rest angle the search for the equilibrium uses to hold the arm
        at = model.joint(place).id

        def push(_: Any, data: Any) -> None:
            data.qfrc_passive[at] -= size["stiffness"] * (data.qpos[at] - size["rest_angle"])

        return push

    def _joint_coulomb(self, model: Any, place: str, size: Mapping[str, float]) -> ForceCallback:
        at = model.joint(place).id

        def push(_: Any, data: Any) -> None:
            data.qfrc_passive[at] -= size["tau_c"] * math.tanh(data.qvel[at] / _FRICTION_SMOOTHING_SPEED)

        return push

    def _joint_stribeck(self, model: Any, place: str, size: Mapping[str, float]) -> ForceCallback:
        at = model.joint(place).id

        def push(_: Any, data: Any) -> None:
            v = float(data.qvel[at])
            fall = math.exp(-((v / size["v_stribeck"]) ** 2))
            data.qfrc_passive[at] -= size["tau_s"] * fall * math.tanh(v / _FRICTION_SMOOTHING_SPEED)

        return push

    def _joint_presliding(self, model: Any, place: str, size: Mapping[str, float]) -> ForceCallback:
        at = model.joint(place).id
        state = {"s": 0.0, "t": 0.0}

        def push(_: Any, data: Any) -> None:
            if not self._scene.has_motion_begun:
                return
            v, step = float(data.qvel[at]), float(data.time) - state["t"]
            if step > 0:
                way = math.copysign(1.0, v)
                state["s"] = way + (state["s"] - way) * math.exp(-abs(v) * step / size["yield_angle"])
                state["t"] = float(data.time)
            data.qfrc_passive[at] -= size["tau_c"] * state["s"]

        return push

    def _effort_lag(self, model: Any, place: str, size: Mapping[str, float]) -> ForceCallback:
        at, apart = model.joint(place).id, int(import_mujoco().mjtDisableBit.mjDSBL_EQUALITY)
        state: dict[str, Any] = {"z": None, "command": 0.0, "t": 0.0}

        def push(model: Any, data: Any) -> None:
            # the controller works with a model of its own, whose grasps are off: there no torque is applied
            if not self._scene.has_motion_begun or model.opt.disableflags & apart:
                return
            command, step = float(data.qfrc_applied[at]), float(data.time) - state["t"]
            if state["z"] is None:
                state["z"] = command
            elif step > 0:
                # until now the command was the one before
                held = state["command"]
                state["z"] = held + (state["z"] - held) * math.exp(-step / size["time_constant"])
            state["t"], state["command"] = float(data.time), command
            data.qfrc_passive[at] += state["z"] - command

        return push

    def _weigh(self, model: Any, place: str, size: Mapping[str, float]) -> None:
        """Put a point of some mass, or take it, at (mx, my, mz)/mass in a frame."""
        mujoco, value, where = import_mujoco(), self._value, f"payload@{place}"
        frame, reach = self._system.mechanism.frame(place), np.array([size.get(f"m{a}", 0.0) for a in "xyz"])
        body = int(model.jnt_bodyid[model.joint(self._system.mechanism.joints[frame.joint_index].name).id])
        turn = value(frame.placement.rotation).reshape(3, 3, order="F")
        mass = size["mass"]
        if not np.linalg.norm(reach) <= _MAX_PAYLOAD_DISTANCE * abs(mass):
            raise ModelError(
                "its mass sits too far from its frame", where=where, allowed=f"within {_MAX_PAYLOAD_DISTANCE:g} m"
            )
        point = value(frame.placement.translation) + turn @ reach / mass
        own, centre = float(model.body_mass[body]), np.array(model.body_ipos[body])
        w, x, y, z = model.body_iquat[body]
        axes = Rotation.from_quat([x, y, z, w]).as_matrix()
        apart = point - centre
        tensor = axes @ np.diag(model.body_inertia[body]) @ axes.T
        tensor += own * mass / (own + mass) * (apart @ apart * np.eye(3) - np.outer(apart, apart))
        moments, axes = np.linalg.eigh(tensor)
        if own + mass <= 0 or moments[0] <= 0:
            raise ModelError("more is taken away than the link has there", where=where, hint="less mass, or nearer by")
        axes[:, 2] *= np.linalg.det(axes)
        x, y, z, w = Rotation.from_matrix(axes).as_quat()
        model.body_mass[body] = own + mass
        model.body_ipos[body] = (own * centre + mass * point) / (own + mass)
        model.body_inertia[body], model.body_iquat[body] = moments, [w, x, y, z]
        mujoco.mj_setConst(model, mujoco.MjData(model))


# -- sensors and clocks -----------------------------------------------------------------------------------------------


def _with_sensor_error(recording: Recording, system: System, effect: InjectedEffect) -> Recording:
    """The recording as sensors with one given error would have measured it.

    Parameters
    ----------
    recording : Recording
    system : System
    effect : InjectedEffect
        Of `_SENSOR_ERROR_KINDS`.
    """
    if effect.kind.startswith("camera") or effect.kind == "surface_offset":
        points = tuple(
            g if g.pose is None else _camera_error(g, system, effect, recording.duration) for g in recording.points
        )
        return replace(recording, points=points)
    joints = recording.joints
    assert joints is not None
    if joints.effort is None:
        raise ModelError("the recording has no efforts", where=effect.label, allowed="arms that torques move")
    return replace(recording, joints=_joint_error(joints, system, effect))


def _joint_error(joints: JointGroup, system: System, effect: InjectedEffect) -> JointGroup:
    assert joints.effort is not None
    position, effort = joints.position.copy(), joints.effort.copy()
    size = effect.values
    if effect.kind == "effort_delay":
        # what is recorded now acts only after the delay
        for name in joints_by_arm(system)[effect.location]:
            column = joints.names.index(name)
            effort[:, column] = np.interp(joints.t + size["delay"], joints.t, joints.effort[:, column])
        return replace(joints, effort=effort)
    at = joints.names.index(effect.location)
    if effect.kind == "effort_gain":
        effort[:, at] *= size["scale"]
    elif effect.kind == "effort_offset":
        effort[:, at] += size["offset"]
    elif effect.kind == "encoder_offset":
        position[:, at] += size["offset"]
    elif effect.kind == "series_elasticity":
        position[:, at] += joints.effort[:, at] / size["stiffness"]
    elif effect.kind == "backlash":
        position[:, at] += size["width"] / 2 * np.tanh(joints.effort[:, at] / 0.2)
    return replace(joints, position=position, effort=effort)


def _camera_error(group: PointGroup, system: System, effect: InjectedEffect, duration: float) -> PointGroup:
    assert group.pose is not None
    size, position = effect.values, group.position
    centre = np.asarray(group.pose)[:3, 3]
    if effect.kind == "camera_translation":
        return replace(group, position=position + np.array([size["x"], size["y"], size["z"]]))
    if effect.kind == "camera_rotation":
        turn = Rotation.from_euler("xyz", [size["rx"], size["ry"], size["rz"]]).as_matrix()
        return replace(group, position=centre + (position - centre) @ turn.T)
    if effect.kind == "camera_scale":
        return replace(group, position=centre + size["scale"] * (position - centre))
    if effect.kind == "camera_latency":
        late = group.t + size["delay"]
        inside = late <= duration
        std = None if group.std is None else group.std[inside]
        return replace(group, t=late[inside], position=position[inside], std=std)
    value = ParameterEvaluator(system, {})
    radius = {s.name: float(value(s.radius)[0]) for s in system.segment_layouts}
    own = np.array([radius.get(name.removeprefix("w_").partition(":")[0], 0.0) for name in group.names])
    ray = centre - position
    away = ray / np.linalg.norm(ray, axis=2, keepdims=True)
    return replace(group, position=position + size["fraction"] * own[:, None] * away)

"""Effects that a virtual experiment in MuJoCo has but the model lacks, implemented independently of `yid_ocp.effects`.

Effects for which MuJoCo has a term (joint damping, armature, inertias, sites) are set in its model. Other forces are
computed here in NumPy at every inner step. Sensor and clock errors are applied to the finished recording. The equations
of `yid_ocp.effects` are not used, except for effects that only change the description of the system (masses, lengths,
rest angles, gravity, grasp positions, servos). Effects outside the library exist only here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from yid_ocp.arrays import Array
from yid_ocp.data.recording import Recording
from yid_ocp.effects import make_effect
from yid_ocp.effects.base import EffectBase, object_joint_names
from yid_ocp.errors import ConfigError, ModelError, unknown_name_error_arguments
from yid_ocp.model.system import System
from yid_ocp.virtual.experiment import VirtualExperimentSettings, recording_with_sensor_error, run_virtual_experiment
from yid_ocp.virtual.mjcf import CasadiEvaluator, import_mujoco

_ForceCallback = Callable[[Any, Any], None]  # function of MuJoCo's model and data that adds to `qfrc_passive`
_Values = Mapping[str, float]

_AIR_DENSITY = 1.2  # [kg/m^3]
_FRICTION_SMOOTHING_SPEED = 0.02  # v_s of dry friction [rad/s]
_NO_FRICTION = 1e-9  # friction before the motion starts; MuJoCo's constraint must exist from the start [N m]
_FRICTION_TIME_STEPS = 10  # time constant of MuJoCo's constraint that holds a joint by friction [inner steps]
_MAX_INJECTED_PAYLOAD_DISTANCE = 1.0  # largest distance of a payload's mass from its frame [m]
_CREASED_LINK, _CREASE_ANGLE = 1, 0.03  # link before which a tube has a crease; angle beyond which it softens [rad]
_CORD_LENGTH = 0.3  # length of a tether [m]
_MAGNET_DISTANCE, _MAGNET_POLE_SIZE = 0.06, 0.04  # distance from the tip at equilibrium, size of the pole [m]
_DRIFT_TIME = 5.0  # time in which a drifting stiffness decreases by its size [s]
_SLIP_TIMES, _SLIP_DURATION = (1.5, 3.5), 0.05  # times and duration of a grasp's slips [s]
_LOAD_SLIDE_ANGLE, _LOAD_SLIDE_TIME = 0.02, 0.2  # joint angle after which a loose load slides [rad], time constant [s]
_WALL_DISTANCE = 0.01  # distance of a soft wall from the tip at equilibrium [m]
_WARM_UP_TIME = 1.5  # time constant with which a cold gear loses its friction [s]

# effects that change the system's description; servos are MuJoCo's actuators, which delay commands and limit torques
_DESCRIPTION_KINDS = (
    *("density", "point_mass", "length_scale", "link_mass", "rest_curvature", "bend_anisotropy", "gravity_tilt"),
    *("grasp_offset", "servo_gain", "servo_delay", "servo_saturation"),
)
# effects that are a term of MuJoCo's own model
_MUJOCO_MODEL_KINDS = ("kelvin_voigt", "joint_viscous", "rotor_inertia", "payload")
# effects that are an error of a sensor or clock
_SENSOR_ERROR_KINDS = (
    *("effort_gain", "effort_offset", "effort_delay", "encoder_offset", "series_elasticity", "backlash"),
    *("camera_translation", "camera_rotation", "camera_scale", "camera_latency", "surface_offset"),
)


class _EffectContext:
    """The system, its numerical stiffnesses, and whether the motion has begun (before, the object settles)."""

    def __init__(self, system: System, values: Mapping[str, float]) -> None:
        self.system, self.has_motion_begun = system, False
        self.value, springs = CasadiEvaluator(system, values), system.elastic_joints
        self.joint_stiffness = {s.joint_name: float(self.value(s.stiffness)[0]) for s in springs}  # [N m/rad]
        self.rest_angles = {s.joint_name: float(self.value(s.rest_angle)[0]) for s in springs}  # [rad]

    def segment_springs(self, model: Any, segment: str) -> tuple[Array, Array, Array]:
        """MuJoCo ids, stiffnesses [N m/rad] and rest angles [rad] of a segment's elastic joints."""
        links = self.system.find_segment_layout(segment).link_joints
        joints = [joint for link in links for joint in link if joint in self.joint_stiffness]
        stiffness, rest = (np.array([of[j] for j in joints]) for of in (self.joint_stiffness, self.rest_angles))
        return np.array([model.joint(j).id for j in joints]), stiffness, rest

    def bend_joint_ids(self, model: Any, segment: str) -> Array:
        """MuJoCo ids of the joints that bend a segment about x, then of those that bend it about y."""
        links = self.system.find_segment_layout(segment).link_joints
        return np.array([model.joint(link[axis]).id for axis in (0, 1) for link in links])

    def link_body_ids(self, model: Any, segment: str) -> list[int]:
        """MuJoCo ids of the bodies of a segment's links, in the order of the links."""
        links = self.system.find_segment_layout(segment).link_joints
        return [int(model.jnt_bodyid[model.joint(link[-1]).id]) for link in links]

    def end_body_id(self, model: Any, place: str) -> int:
        """MuJoCo id of the last body of a segment, or of the body that an arm's joint carries."""
        named = {segment.name: segment.link_joints[-1][-1] for segment in self.system.segment_layouts}
        return int(model.jnt_bodyid[model.joint(named.get(place, place)).id])


_ORDINARY_FRICTION: Mapping[str, tuple[float, float]] = {
    "joint_coulomb": (0.004, 0.016),
    "joint_stribeck": (0.0008, 0.0032),
    # the torque through a gear counts outside forces twice: a hundredth of it is 0.4 N m at a shoulder
    "joint_load_friction": (0.01, 0.04),
}
"""Smallest and largest amplitude of ordinary dry friction by kind: over the effort limit, or (load friction) itself."""
_MAX_RATED_EFFORT = 100.0  # larger effort limits are not a motor's rating [N m]


def typical_friction_amplitude_range(effect: EffectBase, system: System) -> tuple[float, float]:
    """Return the smallest and largest amplitude of ordinary dry friction at a joint, in the unit of the amplitude."""
    low, high = _ORDINARY_FRICTION[effect.kind]
    if effect.definitions[0].unit == "1":
        return low, high
    rated = min(system.mechanism.joint(effect.location).effort_limit, _MAX_RATED_EFFORT)
    return low * rated, high * rated


_ForceBuilder = Callable[[_EffectContext, Any, str, Any], _ForceCallback]  # arguments: context, model, location, size


def _joint_force(at: Any, law: Callable[[Any, Any, float], Any]) -> _ForceCallback:
    """Callback that adds the force law(q, v, t) to the joints `at`, with their angles, velocities and the time."""

    def push(_: Any, data: Any) -> None:
        data.qfrc_passive[at] += law(data.qpos[at], data.qvel[at], data.time)

    return push


def _joint_law(law: Callable[[Any, float, float, float], float]) -> _ForceBuilder:
    """Builder of an effect with the force law(size, q, v, t) of one joint."""
    return lambda scene, model, joint, size: _joint_force(model.joint(joint).id, lambda q, v, t: law(size, q, v, t))


def _spring_law(law: Callable[[Any, Array, Array, float], Array]) -> _ForceBuilder:
    """Builder of an effect with the force law(size, angles from rest, stiffnesses, t) of a segment's elastic joints."""

    def made(scene: _EffectContext, model: Any, segment: str, size: Any) -> _ForceCallback:
        at, stiffness, rest = scene.segment_springs(model, segment)
        return _joint_force(at, lambda q, v, t: law(size, q - rest, stiffness, t))

    return made


def _bend_law(law: Callable[[float, Array], Array]) -> _ForceBuilder:
    """Builder of an effect with the force law(size, q) of a segment's bending joints, those about x first."""
    return lambda scene, model, of, size: _joint_force(scene.bend_joint_ids(model, of), lambda q, v, t: law(size, q))


def _body_forces(forces: Mapping[int, Callable[[Any], Array]]) -> _ForceCallback:
    """Callback that adds forces [N] in the world at centres of mass of bodies, given as functions of MuJoCo data."""
    mujoco = import_mujoco()

    def push(model: Any, data: Any) -> None:
        for body, force in forces.items():
            mujoco.mj_applyFT(model, data, force(data), np.zeros(3), data.xipos[body], body, data.qfrc_passive)

    return push


def _attached(offset: Sequence[float], pull: Callable[[float, Array], Array]) -> _ForceBuilder:
    """Builder of an effect with the force pull(size, way) on a segment's tip or an arm's link.

    `way` [m] leads to an anchor, which is the start position plus `offset` for a tip, minus `offset` for a link.
    """

    def made(scene: _EffectContext, model: Any, place: str, size: float) -> _ForceCallback:
        body, anchors = scene.end_body_id(model, place), list[Array]()
        is_tip = any(segment.name == place for segment in scene.system.segment_layouts)

        def force(data: Any) -> Array:
            at = np.array(data.xipos[body])
            if not anchors:
                anchors.append(at + np.array(offset) if is_tip else at - np.array(offset))
            return pull(size, anchors[0] - at)

        return _body_forces({body: force})

    return made


def _in_motion(build: _ForceBuilder) -> _ForceBuilder:
    """Builder of the same effect as `build`, but absent until the motion begins."""

    def made(scene: _EffectContext, model: Any, place: str, size: Any) -> _ForceCallback:
        push = build(scene, model, place, size)
        return lambda model, data: push(model, data) if scene.has_motion_begun else None

    return made


def _memory_law(
    start: Callable[[Any], Any], advance: Callable[..., Any], law: Callable[[Any, Any, Any, Any], Any]
) -> _ForceBuilder:
    """Builder of an effect with the force law(size, stiffnesses, q, z) of a segment's elastic joints, or of one joint.

    The internal state z is start(q) at the start of the motion, then advance(size, z, q, v, step) after each step.
    """

    def made(scene: _EffectContext, model: Any, place: str, size: Any) -> _ForceCallback:
        is_tube = any(segment.name == place for segment in scene.system.segment_layouts)
        at, stiffness, _ = scene.segment_springs(model, place) if is_tube else (model.joint(place).id, None, None)
        state: dict[str, Any] = {}

        def push(_: Any, data: Any) -> None:
            q, v, now = np.array(data.qpos[at]), np.array(data.qvel[at]), float(data.time)
            if not state:
                state.update(z=start(q), t=now)
            step = now - state["t"]
            if step > 0:
                state.update(z=advance(size, state["z"], q, v, step), t=now)
            data.qfrc_passive[at] += law(size, stiffness, q, state["z"])

        return push

    return _in_motion(made)


def _aerodynamic_drag(scene: _EffectContext, model: Any, place: str, size: _Values) -> _ForceCallback:
    mujoco, segment = import_mujoco(), scene.system.find_segment_layout(place)
    radius = float(scene.value(segment.radius)[0])

    def drag(body: int, length: float) -> Callable[[Any], Array]:
        scale, found = _AIR_DENSITY * size["cd"] * radius * length, np.zeros(6)

        def force(data: Any) -> Array:
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, found, 0)
            along = data.xmat[body].reshape(3, 3)[:, 2]
            normal = found[3:] - along * (along @ found[3:])
            return np.asarray(-scale * np.linalg.norm(normal) * normal)

        return force

    lengths = [float(scene.value(x)[0]) for x in segment.link_lengths]
    return _body_forces({link[0]: drag(*link) for link in zip(scene.link_body_ids(model, place), lengths, strict=True)})


def _gravity_scale(scene: _EffectContext, model: Any, place: str, size: _Values) -> _ForceCallback:
    bodies = sorted({int(model.jnt_bodyid[model.joint(joint).id]) for joint in object_joint_names(scene.system)})
    gravity = np.array(model.opt.gravity)

    def lifted(mass: float) -> Callable[[Any], Array]:
        force = size["fraction"] * mass * gravity
        return lambda data: force

    return _body_forces({body: lifted(model.body_mass[body]) for body in bodies})


def _slid(size: _Values, s: float, q: float, v: float, step: float) -> float:
    """Friction after a step, as a fraction of its largest value."""
    way = math.copysign(1.0, v)
    return way + (s - way) * math.exp(-abs(v) * step / size["yield_angle"])


def _held_friction(scene: _EffectContext, model: Any, effects: Sequence[InjectedEffect]) -> _ForceCallback:
    """Dry friction of joints as `frictionloss` of MuJoCo, whose largest torque is updated at every inner step.

    This torque is tau_c + tau_s exp(-(v/v_stribeck)^2) + share |load|, with the torque through the gear as load.
    """
    at = np.array([model.joint(effect.location).id for effect in effects])
    tau_c, tau_s, share = (np.array([e.values.get(key, 0.0) for e in effects]) for key in ("tau_c", "tau_s", "share"))
    speeds = np.array([effect.values.get("v_stribeck", 1.0) for effect in effects])
    # as stiff as the inner step allows
    model.dof_frictionloss[at] = _NO_FRICTION
    model.dof_solref[at, 0], model.dof_solimp[at, :2] = _FRICTION_TIME_STEPS * model.opt.timestep, 0.999
    gear_load = _gear_load(scene, model, at) if np.any(share) else None
    apart = int(import_mujoco().mjtDisableBit.mjDSBL_EQUALITY)

    def hold(model: Any, data: Any) -> None:
        # the controller's model has no grasps and no friction
        if model.opt.disableflags & apart or not scene.has_motion_begun:
            return
        size = tau_c + tau_s * np.exp(-((data.qvel[at] / speeds) ** 2))
        if gear_load is not None:
            size += share * np.abs(gear_load(data))
        model.dof_frictionloss[at] = np.maximum(np.bincount(at, size)[at], _NO_FRICTION)

    return hold


def _gear_load(scene: _EffectContext, model: Any, at: Array) -> Callable[[Any], Array]:
    """Function of the torque through gears of joints [N m]: motor torque minus that of weights and grasps beyond."""
    value, servos, drag = scene.value, scene.system.servos, np.zeros(len(at))
    for i, joint in enumerate(at):
        servo = servos.get(model.joint(int(joint)).name)
        if servo is not None and servo.motor_kind == "dc":  # its counter-voltage is a damper of the joint
            drag[i] = float(value(servo.damping)[0])
    body, others = model.jnt_bodyid[at], np.array([model.joint(name).id for name in object_joint_names(scene.system)])

    def gear_load(data: Any) -> Array:
        reach = data.subtree_com[body] - data.xanchor[at]
        weight = model.body_subtreemass[body, None] * model.opt.gravity
        outside = np.einsum("ij,ij->i", data.xaxis[at], np.cross(reach, weight))
        if data.ne and len(others):
            # the forces of grasps follow from the object's joints, which have no friction
            rows = data.efc_J.reshape(-1, model.nv)[: data.ne]
            outside += rows[:, at].T @ np.linalg.lstsq(rows[:, others].T, data.qfrc_constraint[others], rcond=None)[0]
        return np.asarray(data.qfrc_actuator[at] + data.qfrc_applied[at] - drag * data.qvel[at] - outside)

    return gear_load


def _effort_lag(scene: _EffectContext, model: Any, place: str, size: _Values) -> _ForceCallback:
    at, apart = model.joint(place).id, int(import_mujoco().mjtDisableBit.mjDSBL_EQUALITY)
    state: list[float] = []

    def push(model: Any, data: Any) -> None:
        # the controller's model has no grasps and applies no torque
        if model.opt.disableflags & apart:
            return
        command, now = float(data.qfrc_applied[at]), float(data.time)
        z, held, since = state or (command, command, now)  # until now the command was the one before
        if now > since:
            z = held + (z - held) * math.exp(-(now - since) / size["time_constant"])
        state[:] = z, command, now
        data.qfrc_passive[at] += z - command

    return push


def _weigh(scene: _EffectContext, model: Any, place: str, size: _Values) -> None:
    """Add a point mass, possibly negative, at the position (mx, my, mz)/mass in the frame `place`."""
    mujoco, value, where = import_mujoco(), scene.value, f"payload@{place}"
    frame, reach = scene.system.mechanism.frame(place), np.array([size.get(f"m{a}", 0.0) for a in "xyz"])
    body = int(model.jnt_bodyid[model.joint(scene.system.mechanism.joints[frame.joint_index].name).id])
    turn, mass = value(frame.placement.rotation).reshape(3, 3, order="F"), size["mass"]
    if not np.linalg.norm(reach) <= _MAX_INJECTED_PAYLOAD_DISTANCE * abs(mass):
        what = f"the added mass is too far, {np.linalg.norm(reach) / max(abs(mass), 1e-300):.3g} m from its frame"
        allowed = f"a distance |(mx, my, mz)/mass| of at most {_MAX_INJECTED_PAYLOAD_DISTANCE:g} m"
        raise ModelError(what, where=where, allowed=allowed, hint="give smaller mx, my, mz, or a larger mass")
    point = value(frame.placement.translation) + turn @ reach / mass
    own, centre = float(model.body_mass[body]), np.array(model.body_ipos[body])
    axes = Rotation.from_quat(np.roll(model.body_iquat[body], -1)).as_matrix()
    apart = point - centre
    tensor = axes @ np.diag(model.body_inertia[body]) @ axes.T
    tensor += own * mass / (own + mass) * (apart @ apart * np.eye(3) - np.outer(apart, apart))
    moments, axes = np.linalg.eigh(tensor)
    if own + mass <= 0 or moments[0] <= 0:
        what = f"the effect, with mass {mass:.3g} kg, removes more mass or inertia than the link has ({own:.3g} kg)"
        hint = "give a less negative mass, or one nearer to the link's centre of mass"
        raise ModelError(what, where=where, allowed="a positive mass and inertia of the link", hint=hint)
    axes[:, 2] *= np.linalg.det(axes)
    model.body_mass[body] = own + mass
    model.body_ipos[body] = (own * centre + mass * point) / (own + mass)
    model.body_inertia[body], model.body_iquat[body] = moments, np.roll(Rotation.from_matrix(axes).as_quat(), 1)
    mujoco.mj_setConst(model, mujoco.MjData(model))


_FORCES: Mapping[str, _ForceBuilder] = {  # effects of the library
    "cubic_stiffness": _spring_law(lambda size, angle, stiffness, t: -size["k3"] * angle**3),
    "standard_linear_solid": _memory_law(
        np.copy,
        lambda size, z, q, v, step: q + (z - q) * math.exp(-step / size["relaxation_time"]),
        lambda size, stiffness, q, z: -(size["ratio"] * stiffness) * (q - z),
    ),
    "hysteresis": _memory_law(
        np.zeros_like,
        lambda size, z, q, v, step: z + step * (v - np.abs(v) * z / size["yield_angle"]),
        lambda size, stiffness, q, z: -size["stiffness"] * z,
    ),
    "aerodynamic_drag": _aerodynamic_drag,
    "gravity_scale": _gravity_scale,
    # not MuJoCo's own spring, whose rest angle holds the arm in the search for equilibrium
    "joint_spring": _joint_law(lambda size, q, v, t: -size["stiffness"] * (q - size["rest_angle"])),
    "joint_coulomb": _joint_law(lambda size, q, v, t: -size["tau_c"] * math.tanh(v / _FRICTION_SMOOTHING_SPEED)),
    "joint_stribeck": _joint_law(
        lambda size, q, v, t: (
            -size["tau_s"] * math.exp(-((v / size["v_stribeck"]) ** 2)) * math.tanh(v / _FRICTION_SMOOTHING_SPEED)
        )
    ),
    "joint_presliding": _memory_law(lambda q: 0.0, _slid, lambda size, stiffness, q, s: -size["tau_c"] * s),
    "effort_lag": _in_motion(_effort_lag),
}
INJECTABLE_EFFECT_KINDS = (*_DESCRIPTION_KINDS, *_MUJOCO_MODEL_KINDS, *_FORCES, *_SENSOR_ERROR_KINDS)


def _gusts(scene: _EffectContext, model: Any, segment: str, size: float) -> _ForceCallback:
    rng = np.random.default_rng(int(1e6 * abs(size)) % 2**32)
    rates, phases = rng.uniform(0.4, 1.6, 3), rng.uniform(0, 2 * math.pi, 3)
    bodies = scene.link_body_ids(model, segment)

    def wind(data: Any) -> Array:
        gust = size * float(np.sum(np.sin(2 * math.pi * rates * data.time + phases)))
        return np.array([gust, 0.5 * gust, 0.0]) / len(bodies)

    return _body_forces(dict.fromkeys(bodies, wind))


def _crease(scene: _EffectContext, model: Any, segment: str, size: float) -> _ForceCallback:
    joints = scene.system.find_segment_layout(segment).link_joints[_CREASED_LINK][:2]
    at, rest = np.array([model.joint(j).id for j in joints]), np.array([scene.rest_angles.get(j, 0.0) for j in joints])

    def law(q: Array, v: Array, t: float) -> Array:
        angle = float(np.linalg.norm(q - rest))
        return size * (angle - _CREASE_ANGLE) * (q - rest) / angle if angle > _CREASE_ANGLE else 0 * q

    return _joint_force(at, law)


def _cord(size: float, way: Array) -> Array:
    distance = float(np.linalg.norm(way))
    return size * max(distance - _CORD_LENGTH, 0.0) * way / distance


def _one_way_damping(scene: _EffectContext, model: Any, segment: str, size: float) -> _ForceCallback:
    # as MuJoCo's own damping, which is integrated implicitly: with explicit damping a light branch becomes unstable
    both = scene.bend_joint_ids(model, segment)
    usual = model.dof_damping[both].copy()

    def push(_: Any, data: Any) -> None:
        now = usual + size * (data.qvel[both] > 0)
        data.qfrc_passive[both] -= (now - model.dof_damping[both]) * data.qvel[both]
        model.dof_damping[both] = now

    return push


def _saturating_drive(scene: _EffectContext, model: Any, joint: str, size: float) -> _ForceCallback:
    at = model.joint(joint).id

    def push(_: Any, data: Any) -> None:
        torque = float(data.qfrc_applied[at])
        data.qfrc_passive[at] -= torque - float(np.clip(torque, -size, size))

    return push


def _load_shifted(size: float, memory: Array, q: float, v: float, step: float) -> Array:
    begin, s = memory
    return np.array([begin, s + step / _LOAD_SLIDE_TIME * (math.tanh((q - begin) / _LOAD_SLIDE_ANGLE) - s)])


def _slipping_grasp(scene: _EffectContext, model: Any, grasp: str, size: float) -> _ForceCallback:
    site = model.site(f"grasp_{grasp}_held").id
    begin = np.array(model.site_pos[site])

    def push(model: Any, data: Any) -> None:
        done = sum(float(np.clip((data.time - t) / _SLIP_DURATION, 0.0, 1.0)) for t in _SLIP_TIMES)
        model.site_pos[site] = begin - np.array([0.0, 0.0, size * done])

    return push


OUT_OF_LIBRARY_FORCE_BUILDERS: Mapping[str, _ForceBuilder] = {
    "torque_ripple": _joint_law(lambda size, q, v, t: size * math.sin(60.0 * q)),  # with the joint's angle [N m]
    "cross_stiffness": _bend_law(lambda size, q: -size * np.roll(q, len(q) // 2)),  # couples the two [N m/rad]
    "quadratic_stiffness": _bend_law(lambda size, q: -size * q**2),  # stiffer in one direction [N m/rad^2]
    "gusts": _in_motion(_gusts),  # varying wind, spread over a segment's links [N]
    "crease": _crease,  # a tube that creases at one location: stiffness lost beyond an angle [N m/rad]
    # a cord from the floor side to a tip, or from above to an arm's link, taut beyond its length [N/m]
    "tether": _attached((0.0, 0.0, -_CORD_LENGTH), _cord),
    "magnet": _attached(  # a pole near the tip whose attraction grows as the distance shrinks [N]
        (_MAGNET_DISTANCE, 0.0, 0.0),
        lambda size, way: size * _MAGNET_POLE_SIZE * way / (float(way @ way) + _MAGNET_POLE_SIZE**2),
    ),
    "wall": _attached(  # a soft wall that the tip runs into [N/m]
        (0.0, _WALL_DISTANCE, 0.0), lambda size, way: np.array([0.0, -size * max(-way[1], 0.0), 0.0])
    ),
    # springs that soften while the motion lasts, by this fraction in all
    "stiffness_drift": _in_motion(_spring_law(lambda size, angle, k, t: size * t / _DRIFT_TIME * k * angle)),
    "one_way_damping": _one_way_damping,  # bends that are damped in one direction only [N m s/rad]
    "saturating_drive": _saturating_drive,  # limits the torque, whatever the command and the record [N m]
    # viscous friction that fades while the gear warms up [N m s/rad]
    "warming_gear": _in_motion(_joint_law(lambda size, q, v, t: -size * math.exp(-t / _WARM_UP_TIME) * v)),
    # a loose load that slides to the other side once the joint has turned [N m]
    "shifting_load": _memory_law(
        lambda q: np.array([q, 0.0]), _load_shifted, lambda size, stiffness, q, memory: size * memory[1]
    ),
    # a grasp that holds, lets the tube slip along its axis, and holds again [m per slip]
    "slipping_grasp": _in_motion(_slipping_grasp),
}
"""Effects outside the library, by kind: builders of forces from context, MuJoCo model, location and size."""


@dataclass(frozen=True)
class InjectedEffect:
    """An effect that is present in simulated data but not in the model, with kind, location and parameter values.

    `values` are the effect's parameters by quantity. A kind outside the library has one, `size`, in the unit of its
    entry in `OUT_OF_LIBRARY_FORCE_BUILDERS`.
    """

    kind: str
    location: str
    values: Mapping[str, float] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """The label of the effect, `kind@location`."""
        return f"{self.kind}@{self.location}"


def run_experiment_with_injected_effects(
    system: System,
    values: Mapping[str, float],
    effects: Sequence[InjectedEffect],
    experiment: VirtualExperimentSettings | None = None,
    ordinary_friction: Sequence[InjectedEffect] | None = None,
) -> Recording:
    """Record a virtual experiment with effects that the system's description lacks.

    `system` is the nominal system, with driven joints. The recording stores `values` as `true_parameters`. The
    experiment's `injected_terms` are replaced. If `ordinary_friction` is None, dry friction of joints in `effects` is a
    smooth force. If it is given (it can be empty), MuJoCo's constraint solver simulates it and the dry friction in
    `effects`, including sticking. Raises `ConfigError` if an effect kind cannot be simulated, `ModelError` if a payload
    is impossible. Other errors: `run_virtual_experiment`.
    """
    known = (*INJECTABLE_EFFECT_KINDS, *OUT_OF_LIBRARY_FORCE_BUILDERS)
    known = known if ordinary_friction is None else tuple(dict.fromkeys((*known, *_ORDINARY_FRICTION)))
    for effect in (*effects, *(ordinary_friction or ())):
        if effect.kind not in known:
            what = f"the effect {effect.kind} cannot be simulated in MuJoCo"
            raise ConfigError(what, where=effect.label, **unknown_name_error_arguments(effect.kind, known))
    described = [make_effect(e.kind, e.location, system, e.values) for e in effects if e.kind in _DESCRIPTION_KINDS]
    changed = system.with_effects(described) if described else system
    # a servo acts on its encoder reading: gears with play are part of the mechanics
    play = {e.location: e.values["width"] for e in effects if e.kind == "backlash" and e.location in system.servos}
    inner = [e for e in effects if e.kind not in _DESCRIPTION_KINDS and e.kind not in _SENSOR_ERROR_KINDS]
    held = [] if ordinary_friction is None else [e for e in inner if e.kind in _ORDINARY_FRICTION]
    inner = [e for e in inner if e not in held]
    held += ordinary_friction or ()
    injected = _InjectedTerms(_EffectContext(changed, values), inner, held) if inner or held else None
    chosen = replace(experiment or VirtualExperimentSettings(), injected_terms=injected, gear_play=play)
    made = run_virtual_experiment(changed, values, chosen)
    for effect in effects:
        if effect.kind in _SENSOR_ERROR_KINDS and effect.location not in play:
            made = recording_with_sensor_error(made, system, effect.kind, effect.location, effect.values)
    return made


@dataclass
class _InjectedTerms:
    """The injected effects as `InjectedSimulatorTerms`. The amplitudes of `held_frictions` at the same joint add up."""

    scene: _EffectContext
    effects: Sequence[InjectedEffect]
    held_frictions: Sequence[InjectedEffect]
    _forces: list[_ForceCallback] = field(default_factory=list)

    def edit_model(self, model: Any) -> None:
        if self.held_frictions:
            self._forces.append(_held_friction(self.scene, model, self.held_frictions))
        for effect in self.effects:
            size, place, scene = effect.values, effect.location, self.scene
            if effect.kind == "kelvin_voigt":
                at, stiffness, _ = scene.segment_springs(model, place)
                model.dof_damping[at] += size["tau"] * stiffness
            elif effect.kind == "joint_viscous":
                model.dof_damping[model.joint(place).id] += size["b"]
            elif effect.kind == "rotor_inertia":
                model.dof_armature[model.joint(place).id] += size["armature"]
            elif effect.kind == "payload":
                _weigh(scene, model, place, size)
            elif effect.kind in _FORCES:
                self._forces.append(_FORCES[effect.kind](scene, model, place, size))
            else:
                self._forces.append(OUT_OF_LIBRARY_FORCE_BUILDERS[effect.kind](scene, model, place, size["size"]))

    def begin_motion(self, data: Any) -> None:
        self.scene.has_motion_begun = True

    def add_forces(self, model: Any, data: Any) -> None:
        for push in self._forces:
            push(model, data)

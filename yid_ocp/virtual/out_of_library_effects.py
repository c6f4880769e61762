"""Effects outside the library, implemented in MuJoCo, whose correct verdict is `unknown`.

Each is a function of the scene, MuJoCo's model, a place and a size that gives the force it adds at every inner step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yid_ocp.model.system import System
from yid_ocp.virtual.mjcf import import_mujoco

Array = NDArray[np.float64]
ForceCallback = Callable[[Any, Any], None]

_CREASED_LINK, _CREASE_ANGLE = 1, 0.03
"""Index of the link before which a tube is creased, and the angle beyond which it softens [rad]."""
_CORD_LENGTH = 0.3
"""Length of a tether's cord [m]."""
_MAGNET_DISTANCE, _MAGNET_POLE_SIZE = 0.06, 0.04
"""Distance of a magnet from the tip at rest, and the size of its pole [m]."""
_DRIFT_TIME = 5.0
"""Time over which a drifting stiffness decreases [s]."""
_SLIP_TIMES, _SLIP_DURATION = (1.5, 3.5), 0.05
"""Times at which a grasp slips, and the duration of a slip [s]."""
_LOAD_SLIDE_ANGLE, _LOAD_SLIDE_TIME = 0.02, 0.2
"""Joint angle after which a loose load slides [rad], and the time constant of sliding [s]."""
_WALL_DISTANCE = 0.01
"""Distance of a soft wall from the tip at rest [m]."""
_WARM_UP_TIME = 1.5
"""Time constant with which a cold gear loses its friction [s]."""


@dataclass
class EffectContext:
    """State of the experiment that out-of-library effects read.

    Attributes
    ----------
    system : System
    joint_stiffness, rest_angles : mapping of joint to float
        [N m/rad, rad]
    has_motion_begun : bool
        Whether the motion has begun; before it the object comes to rest.
    """

    system: System
    joint_stiffness: Mapping[str, float]
    rest_angles: Mapping[str, float]
    has_motion_begun: bool = False

    def segment_springs(self, model: Any, segment: str) -> tuple[Array, Array, Array]:
        """Ids, stiffnesses and rest angles of a segment's elastic joints."""
        links = self.system.segment_layout(segment).link_joints
        joints = [joint for link in links for joint in link if joint in self.joint_stiffness]
        return (
            np.array([model.joint(j).id for j in joints]),
            np.array([self.joint_stiffness[j] for j in joints]),
            np.array([self.rest_angles[j] for j in joints]),
        )

    def bend_joint_ids(self, model: Any, segment: str) -> tuple[Array, Array]:
        """Ids of the joints that bend a segment about x and about y."""
        links = self.system.segment_layout(segment).link_joints
        return (
            np.array([model.joint(link[0]).id for link in links]),
            np.array([model.joint(link[1]).id for link in links]),
        )

    def end_body_id(self, model: Any, place: str) -> int:
        """Id of the body at the end of a segment, or of the body on an arm's joint."""
        named = {segment.name: segment.link_joints[-1][-1] for segment in self.system.segment_layouts}
        return int(model.jnt_bodyid[model.joint(named.get(place, place)).id])


def torque_ripple(scene: EffectContext, model: Any, joint: str, size: float) -> ForceCallback:
    """Torque that ripples with the joint's angle [N m]."""
    at = model.joint(joint).id

    def push(_: Any, data: Any) -> None:
        data.qfrc_passive[at] += size * math.sin(60.0 * data.qpos[at])

    return push


def cross_stiffness(scene: EffectContext, model: Any, segment: str, size: float) -> ForceCallback:
    """A spring that couples the two bends [N m/rad]."""
    x, y = scene.bend_joint_ids(model, segment)

    def push(_: Any, data: Any) -> None:
        qx, qy = np.array(data.qpos[x]), np.array(data.qpos[y])
        data.qfrc_passive[x] -= size * qy
        data.qfrc_passive[y] -= size * qx

    return push


def quadratic_stiffness(scene: EffectContext, model: Any, segment: str, size: float) -> ForceCallback:
    """Springs that are stiffer one way than the other [N m/rad^2]."""
    both = np.concatenate(scene.bend_joint_ids(model, segment))

    def push(_: Any, data: Any) -> None:
        data.qfrc_passive[both] -= size * data.qpos[both] ** 2

    return push


def gusts(scene: EffectContext, model: Any, segment: str, size: float) -> ForceCallback:
    """Wind that comes and goes, spread over the segment's links [N]."""
    mujoco = import_mujoco()
    links = scene.system.segment_layout(segment).link_joints
    bodies = [int(model.jnt_bodyid[model.joint(link[-1]).id]) for link in links]
    rng = np.random.default_rng(int(1e6 * abs(size)) % 2**32)
    rates, phases = rng.uniform(0.4, 1.6, 3), rng.uniform(0, 2 * math.pi, 3)

    def push(model: Any, data: Any) -> None:
        if not scene.has_motion_begun:
            return
        gust = size * float(np.sum(np.sin(2 * math.pi * rates * data.time + phases)))
        for body in bodies:
            wind = np.array([gust, 0.5 * gust, 0.0]) / len(bodies)
            mujoco.mj_applyFT(model, data, wind, np.zeros(3), data.xipos[body], body, data.qfrc_passive)

    return push


def crease(scene: EffectContext, model: Any, segment: str, size: float) -> ForceCallback:
    """A tube that gives way at one place once it is bent there: stiffness lost beyond an angle [N m/rad]."""
    joints = scene.system.segment_layout(segment).link_joints[_CREASED_LINK][:2]
    at, rest = np.array([model.joint(j).id for j in joints]), np.array([scene.rest_angles.get(j, 0.0) for j in joints])

    def push(_: Any, data: Any) -> None:
        bent = np.array(data.qpos[at]) - rest
        angle = float(np.linalg.norm(bent))
        if angle > _CREASE_ANGLE:
            data.qfrc_passive[at] += size * (angle - _CREASE_ANGLE) * bent / angle

    return push


def tether(scene: EffectContext, model: Any, place: str, size: float) -> ForceCallback:
    """A cord from the floor side to a tip, or from above to an arm's link, that is taut beyond its length [N/m]."""
    body = scene.end_body_id(model, place)
    above = all(segment.name != place for segment in scene.system.segment_layouts)
    hung = np.array([0.0, 0.0, _CORD_LENGTH if above else -_CORD_LENGTH])

    def pull(at: Array, anchor: Array) -> Array:
        distance = float(np.linalg.norm(at - anchor))
        return size * max(distance - _CORD_LENGTH, 0.0) * (anchor - at) / distance

    return _attached(body, hung, pull)


def magnet(scene: EffectContext, model: Any, segment: str, size: float) -> ForceCallback:
    """A pole beside the tip that draws it, the more the nearer it is [N]."""

    def pull(at: Array, anchor: Array) -> Array:
        away = anchor - at
        return size * _MAGNET_POLE_SIZE * away / (float(away @ away) + _MAGNET_POLE_SIZE**2)

    return _attached(scene.end_body_id(model, segment), np.array([_MAGNET_DISTANCE, 0.0, 0.0]), pull)


def wall(scene: EffectContext, model: Any, segment: str, size: float) -> ForceCallback:
    """A soft wall that the tip runs into [N/m]."""

    def pull(at: Array, anchor: Array) -> Array:
        return np.array([0.0, -size * max(at[1] - anchor[1], 0.0), 0.0])

    return _attached(scene.end_body_id(model, segment), np.array([0.0, _WALL_DISTANCE, 0.0]), pull)


def _attached(body: int, offset: Array, pull: Callable[[Array, Array], Array]) -> ForceCallback:
    """A force on a body's centre by where it is and a point of the world, `offset` from where the body began."""
    mujoco = import_mujoco()
    anchors: list[Array] = []

    def push(model: Any, data: Any) -> None:
        at = np.array(data.xipos[body])
        if not anchors:
            anchors.append(at + offset)
        force = pull(at, anchors[0])
        mujoco.mj_applyFT(model, data, force, np.zeros(3), data.xipos[body], body, data.qfrc_passive)

    return push


def stiffness_drift(scene: EffectContext, model: Any, segment: str, size: float) -> ForceCallback:
    """Springs that soften while the motion lasts, by this fraction in all."""
    at, stiffness, rest = scene.segment_springs(model, segment)

    def push(_: Any, data: Any) -> None:
        if scene.has_motion_begun:
            data.qfrc_passive[at] += size * data.time / _DRIFT_TIME * stiffness * (data.qpos[at] - rest)

    return push


def one_way_damping(scene: EffectContext, model: Any, segment: str, size: float) -> ForceCallback:
    """Bends that are damped one way only [N m s/rad].

    The engine is told of it as its own damping, which it integrates implicitly: a light branch under so much explicit
    damping bursts.
    """
    both = np.concatenate(scene.bend_joint_ids(model, segment))
    usual = model.dof_damping[both].copy()

    def push(_: Any, data: Any) -> None:
        now = usual + size * (data.qvel[both] > 0)
        data.qfrc_passive[both] -= (now - model.dof_damping[both]) * data.qvel[both]
        model.dof_damping[both] = now

    return push


def saturating_drive(scene: EffectContext, model: Any, joint: str, size: float) -> ForceCallback:
    """A drive that gives no more torque than this, whatever is commanded and recorded [N m]."""
    at = model.joint(joint).id

    def push(_: Any, data: Any) -> None:
        torque = float(data.qfrc_applied[at])
        data.qfrc_passive[at] -= torque - float(np.clip(torque, -size, size))

    return push


def warming_gear(scene: EffectContext, model: Any, joint: str, size: float) -> ForceCallback:
    """Viscous friction that fades while the gear warms up [N m s/rad]."""
    at = model.joint(joint).id

    def push(_: Any, data: Any) -> None:
        if scene.has_motion_begun:
            data.qfrc_passive[at] -= size * math.exp(-data.time / _WARM_UP_TIME) * data.qvel[at]

    return push


def shifting_load(scene: EffectContext, model: Any, joint: str, size: float) -> ForceCallback:
    """A loose load that slides to the other side once the joint has turned [N m]."""
    at = model.joint(joint).id
    state = {"s": 0.0, "t": 0.0, "begin": math.nan}

    def push(_: Any, data: Any) -> None:
        if not scene.has_motion_begun:
            return
        angle, now = float(data.qpos[at]), float(data.time)
        if math.isnan(state["begin"]):
            state["begin"] = angle
        if now > state["t"]:
            goal = math.tanh((angle - state["begin"]) / _LOAD_SLIDE_ANGLE)
            state["s"] += (now - state["t"]) / _LOAD_SLIDE_TIME * (goal - state["s"])
            state["t"] = now
        data.qfrc_passive[at] += size * state["s"]

    return push


def slipping_grasp(scene: EffectContext, model: Any, grasp: str, size: float) -> ForceCallback:
    """A grasp that holds, lets the tube slip along itself, and holds again [m a slip]."""
    site = model.site(f"grasp_{grasp}_held").id
    begin = np.array(model.site_pos[site])

    def push(model: Any, data: Any) -> None:
        if scene.has_motion_begun:
            done = sum(float(np.clip((data.time - t) / _SLIP_DURATION, 0.0, 1.0)) for t in _SLIP_TIMES)
            model.site_pos[site] = begin - np.array([0.0, 0.0, size * done])

    return push


OUT_OF_LIBRARY_EFFECTS: Mapping[str, Callable[[EffectContext, Any, str, float], ForceCallback]] = {
    made.__name__: made
    for made in (
        torque_ripple,
        cross_stiffness,
        quadratic_stiffness,
        gusts,
        crease,
        tether,
        magnet,
        wall,
        stiffness_drift,
        one_way_damping,
        saturating_drive,
        warming_gear,
        shifting_load,
        slipping_grasp,
    )
}
"""Effects outside the library, by kind."""

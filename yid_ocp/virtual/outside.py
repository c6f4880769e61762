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
from yid_ocp.virtual.mjcf import mujoco_module

Array = NDArray[np.float64]
Force = Callable[[Any, Any], None]

CREASED_LINK, CREASE_ANGLE = 1, 0.03
"""Index of the link before which a tube is creased, and the angle beyond which it softens [rad]."""
CORD = 0.3
"""Length of a tether's cord [m]."""
MAGNET_AT, MAGNET_SIZE = 0.06, 0.04
"""Distance of a magnet from the tip at rest, and the size of its pole [m]."""
DRIFT_TIME = 5.0
"""Time over which a drifting stiffness decreases [s]."""
SLIPS, SLIP_TIME = (1.5, 3.5), 0.05
"""Times at which a grasp slips, and the duration of a slip [s]."""
LOAD_ANGLE, LOAD_TIME = 0.02, 0.2
"""Joint angle after which a loose load slides [rad], and the time constant of sliding [s]."""
WALL_AT = 0.01
"""Distance of a soft wall from the tip at rest [m]."""
WARM = 1.5
"""Time constant with which a cold gear loses its friction [s]."""


@dataclass
class Scene:
    """State of the experiment that out-of-library effects read.

    Attributes
    ----------
    system : System
    stiffness, rest : mapping of joint to float
        [N m/rad, rad]
    running : bool
        Whether the motion has begun; before it the object comes to rest.
    """

    system: System
    stiffness: Mapping[str, float]
    rest: Mapping[str, float]
    running: bool = False

    def springs(self, model: Any, segment: str) -> tuple[Array, Array, Array]:
        """Ids, stiffnesses and rest angles of a segment's elastic joints."""
        links = self.system.segment(segment).links
        joints = [joint for link in links for joint in link if joint in self.stiffness]
        return (
            np.array([model.joint(j).id for j in joints]),
            np.array([self.stiffness[j] for j in joints]),
            np.array([self.rest[j] for j in joints]),
        )

    def bends(self, model: Any, segment: str) -> tuple[Array, Array]:
        """Ids of the joints that bend a segment about x and about y."""
        links = self.system.segment(segment).links
        return (
            np.array([model.joint(link[0]).id for link in links]),
            np.array([model.joint(link[1]).id for link in links]),
        )

    def last_body(self, model: Any, place: str) -> int:
        """Id of the body at the end of a segment, or of the body on an arm's joint."""
        named = {segment.name: segment.links[-1][-1] for segment in self.system.segments}
        return int(model.jnt_bodyid[model.joint(named.get(place, place)).id])


def torque_ripple(scene: Scene, model: Any, joint: str, size: float) -> Force:
    """Torque that ripples with the joint's angle [N m]."""
    at = model.joint(joint).id

    def push(_: Any, data: Any) -> None:
        data.qfrc_passive[at] += size * math.sin(60.0 * data.qpos[at])

    return push


def cross_stiffness(scene: Scene, model: Any, segment: str, size: float) -> Force:
    """A spring that couples the two bends [N m/rad]."""
    x, y = scene.bends(model, segment)

    def push(_: Any, data: Any) -> None:
        qx, qy = np.array(data.qpos[x]), np.array(data.qpos[y])
        data.qfrc_passive[x] -= size * qy
        data.qfrc_passive[y] -= size * qx

    return push


def quadratic_stiffness(scene: Scene, model: Any, segment: str, size: float) -> Force:
    """Springs that are stiffer one way than the other [N m/rad^2]."""
    both = np.concatenate(scene.bends(model, segment))

    def push(_: Any, data: Any) -> None:
        data.qfrc_passive[both] -= size * data.qpos[both] ** 2

    return push


def gusts(scene: Scene, model: Any, segment: str, size: float) -> Force:
    """Wind that comes and goes, spread over the segment's links [N]."""
    mujoco = mujoco_module()
    links = scene.system.segment(segment).links
    bodies = [int(model.jnt_bodyid[model.joint(link[-1]).id]) for link in links]
    rng = np.random.default_rng(int(1e6 * abs(size)) % 2**32)
    rates, phases = rng.uniform(0.4, 1.6, 3), rng.uniform(0, 2 * math.pi, 3)

    def push(model: Any, data: Any) -> None:
        if not scene.running:
            return
        gust = size * float(np.sum(np.sin(2 * math.pi * rates * data.time + phases)))
        for body in bodies:
            wind = np.array([gust, 0.5 * gust, 0.0]) / len(bodies)
            mujoco.mj_applyFT(model, data, wind, np.zeros(3), data.xipos[body], body, data.qfrc_passive)

    return push


def crease(scene: Scene, model: Any, segment: str, size: float) -> Force:
    """A tube that gives way at one place once it is bent there: stiffness lost beyond an angle [N m/rad]."""
    joints = scene.system.segment(segment).links[CREASED_LINK][:2]
    at, rest = np.array([model.joint(j).id for j in joints]), np.array([scene.rest.get(j, 0.0) for j in joints])

    def push(_: Any, data: Any) -> None:
        bent = np.array(data.qpos[at]) - rest
        angle = float(np.linalg.norm(bent))
        if angle > CREASE_ANGLE:
            data.qfrc_passive[at] += size * (angle - CREASE_ANGLE) * bent / angle

    return push


def tether(scene: Scene, model: Any, place: str, size: float) -> Force:
    """A cord from the floor side to a tip, or from above to an arm's link, that is taut beyond its length [N/m]."""
    body = scene.last_body(model, place)
    above = all(segment.name != place for segment in scene.system.segments)
    hung = np.array([0.0, 0.0, CORD if above else -CORD])

    def pull(at: Array, anchor: Array) -> Array:
        distance = float(np.linalg.norm(at - anchor))
        return size * max(distance - CORD, 0.0) * (anchor - at) / distance

    return _attached(body, hung, pull)


def magnet(scene: Scene, model: Any, segment: str, size: float) -> Force:
    """A pole beside the tip that draws it, the more the nearer it is [N]."""

    def pull(at: Array, anchor: Array) -> Array:
        away = anchor - at
        return size * MAGNET_SIZE * away / (float(away @ away) + MAGNET_SIZE**2)

    return _attached(scene.last_body(model, segment), np.array([MAGNET_AT, 0.0, 0.0]), pull)


def wall(scene: Scene, model: Any, segment: str, size: float) -> Force:
    """A soft wall that the tip runs into [N/m]."""

    def pull(at: Array, anchor: Array) -> Array:
        return np.array([0.0, -size * max(at[1] - anchor[1], 0.0), 0.0])

    return _attached(scene.last_body(model, segment), np.array([0.0, WALL_AT, 0.0]), pull)


def _attached(body: int, offset: Array, pull: Callable[[Array, Array], Array]) -> Force:
    """A force on a body's centre by where it is and a point of the world, `offset` from where the body began."""
    mujoco = mujoco_module()
    anchors: list[Array] = []

    def push(model: Any, data: Any) -> None:
        at = np.array(data.xipos[body])
        if not anchors:
            anchors.append(at + offset)
        force = pull(at, anchors[0])
        mujoco.mj_applyFT(model, data, force, np.zeros(3), data.xipos[body], body, data.qfrc_passive)

    return push


def stiffness_drift(scene: Scene, model: Any, segment: str, size: float) -> Force:
    """Springs that soften while the motion lasts, by this fraction in all."""
    at, stiffness, rest = scene.springs(model, segment)

    def push(_: Any, data: Any) -> None:
        if scene.running:
            data.qfrc_passive[at] += size * data.time / DRIFT_TIME * stiffness * (data.qpos[at] - rest)

    return push


def one_way_damping(scene: Scene, model: Any, segment: str, size: float) -> Force:
    """Bends that are damped one way only [N m s/rad].

    The engine is told of it as its own damping, which it integrates implicitly: a light branch under so much explicit
    damping bursts.
    """
    both = np.concatenate(scene.bends(model, segment))
    usual = model.dof_damping[both].copy()

    def push(_: Any, data: Any) -> None:
        now = usual + size * (data.qvel[both] > 0)
        data.qfrc_passive[both] -= (now - model.dof_damping[both]) * data.qvel[both]
        model.dof_damping[both] = now

    return push


def saturating_drive(scene: Scene, model: Any, joint: str, size: float) -> Force:
    """A drive that gives no more torque than this, whatever is commanded and recorded [N m]."""
    at = model.joint(joint).id

    def push(_: Any, data: Any) -> None:
        torque = float(data.qfrc_applied[at])
        data.qfrc_passive[at] -= torque - float(np.clip(torque, -size, size))

    return push


def warming_gear(scene: Scene, model: Any, joint: str, size: float) -> Force:
    """Viscous friction that fades while the gear warms up [N m s/rad]."""
    at = model.joint(joint).id

    def push(_: Any, data: Any) -> None:
        if scene.running:
            data.qfrc_passive[at] -= size * math.exp(-data.time / WARM) * data.qvel[at]

    return push


def shifting_load(scene: Scene, model: Any, joint: str, size: float) -> Force:
    """A loose load that slides to the other side once the joint has turned [N m]."""
    at = model.joint(joint).id
    state = {"s": 0.0, "t": 0.0, "begin": math.nan}

    def push(_: Any, data: Any) -> None:
        if not scene.running:
            return
        angle, now = float(data.qpos[at]), float(data.time)
        if math.isnan(state["begin"]):
            state["begin"] = angle
        if now > state["t"]:
            goal = math.tanh((angle - state["begin"]) / LOAD_ANGLE)
            state["s"] += (now - state["t"]) / LOAD_TIME * (goal - state["s"])
            state["t"] = now
        data.qfrc_passive[at] += size * state["s"]

    return push


def slipping_grasp(scene: Scene, model: Any, grasp: str, size: float) -> Force:
    """A grasp that holds, lets the tube slip along itself, and holds again [m a slip]."""
    site = model.site(f"grasp_{grasp}_held").id
    begin = np.array(model.site_pos[site])

    def push(model: Any, data: Any) -> None:
        if scene.running:
            done = sum(float(np.clip((data.time - t) / SLIP_TIME, 0.0, 1.0)) for t in SLIPS)
            model.site_pos[site] = begin - np.array([0.0, 0.0, size * done])

    return push


OUTSIDE: Mapping[str, Callable[[Scene, Any, str, float], Force]] = {
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

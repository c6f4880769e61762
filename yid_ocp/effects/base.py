"""What all effects share: their quantities, the neutral behaviour that each overrides in part, where they can sit."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import casadi as ca
import numpy as np

from yid_ocp.errors import ConfigError, nearest
from yid_ocp.model.drives import NO_LIMIT
from yid_ocp.model.flexible import ElasticJoint
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.mechanism import Inertia, Mechanism, Placement, merged
from yid_ocp.model.parameters import Parameter, Parameters
from yid_ocp.model.system import Grasp, MidpointState, NodeState, System, Terms
from yid_ocp.registry import Registry

SMOOTHING = 0.02
"""v_s in sgn(v) = tanh(v/v_s) [rad/s]."""
ASPECTS = (
    "how fast it moves",
    "how long it is held",
    "how hard it accelerates",
    "how far it bends",
    "how it stands against gravity",
    "how hard it pulls at its ends",
    "when it is read",
    "where the camera stands",
    "how long it is",
)
"""What equations of the library depend on, in the order in which sentences name it."""
BAXTER_LIMIT = 50.0
"""Effort limit of the joints that the ranges of arms are about [N m]; they grow with that of a stronger joint."""
SAME_PLACE = 1e-6
"""Points of arms that are nearer to each other than this wherever the arm stands are one [m]."""


@dataclass(frozen=True)
class Quantity:
    """One number of an effect.

    Attributes
    ----------
    name : str
    unit : str
    neutral : float
        Value at which the effect is absent; for a `shape`, any value, from which a search may start.
    lower, upper : float
        Physical bounds.
    prior_range : (float, float)
        Where an engineer would expect it.
    description : str
    shape : bool
        Whether it says nothing while the others are neutral (a relaxation time, a yield angle).
    reciprocal : str
        `name unit` under which 1/value is reported, for a stiffness whose neutral value is infinite, or a factor that
        goes through infinity when it changes its sign.
    power : int
        p where the value is that of the reported one to the power -p.
    """

    name: str
    unit: str
    neutral: float
    lower: float
    upper: float
    prior_range: tuple[float, float]
    description: str
    shape: bool = False
    reciprocal: str = ""
    power: int = 1

    @property
    def reported(self) -> tuple[str, str]:
        """Name and unit in reports."""
        name, _, unit = self.reciprocal.partition(" ")
        return (name, unit) if self.reciprocal else (self.name, self.unit)

    def turned(self, value: float) -> float:
        """The reported value behind a value that is not zero; the same as it is without a reciprocal."""
        if not self.reciprocal:
            return value
        return 1 / value if self.power == 1 else value ** (-1 / self.power)

    def kept(self, value: float) -> float:
        """The value behind a reported one that is not zero; the same as it is without a reciprocal."""
        return value**-self.power if self.reciprocal else value


@dataclass(frozen=True)
class Reported:
    """A quantity as people read it: value, standard deviation and unit."""

    value: float
    std: float
    unit: str


@dataclass(frozen=True)
class EffectBase(ABC):
    """An effect that changes nothing; every kind overrides what it needs.

    Attributes
    ----------
    kind, location : str
    quantities : tuple of Quantity
        At this location; in the order of `parameters`.
    parameters : Parameters
        Named `kind@location.quantity`.
    internal : mapping of str to casadi.SX
        Internal coordinates, named `kind@location.joint`.
    joints : tuple of str
        Joints that an arm's name stands for.
    equation : str
        What the kind adds, as people read it.
    depends_on : str
        What has to vary in a motion for the kind to be told from others: one of `ASPECTS`, or words that continue
        "vary ...".
    needs : frozenset of str
        Sensors without which nothing shows it.
    alone : bool
        Whether it is a thing in one place, so that one place says nothing of others; a law such as friction is not.
    """

    kind: str
    location: str
    quantities: tuple[Quantity, ...]
    parameters: Parameters
    internal: Mapping[str, ca.SX] = field(default_factory=dict)
    joints: tuple[str, ...] = ()

    equation: ClassVar[str] = ""
    depends_on: ClassVar[str] = ""
    needs: ClassVar[frozenset[str]] = frozenset()
    alone: ClassVar[bool] = False

    @classmethod
    @abstractmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """Where in the system the effect can sit."""

    @classmethod
    def likely(cls, system: System) -> tuple[str, ...]:
        """Which of these places a diagnosis tries."""
        return cls.locations(system)

    @classmethod
    @abstractmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """Its quantities; bounds and ranges may depend on the place."""

    @classmethod
    def internal_names(cls, location: str, system: System) -> tuple[str, ...]:
        """What each of its internal coordinates belongs to, a joint for example."""
        return ()

    @classmethod
    def joints_at(cls, location: str, system: System) -> tuple[str, ...]:
        """Joints that it must know by name, where a location stands for several."""
        return ()

    @property
    def unknown_at_start(self) -> Mapping[str, float]:
        """Internal coordinates whose value at the start of a recording nothing tells: name to their largest size."""
        return {}

    def elsewhere(self, start: Mapping[str, float]) -> Mapping[str, float] | None:
        """Another place from which a search that begins at `start` should begin as well; None where one is enough."""
        return None

    def __getitem__(self, quantity: str) -> ca.SX:
        return self.parameters[f"{self.kind}@{self.location}.{quantity}"].symbol

    @property
    def label(self) -> str:
        """`kind@location`."""
        return f"{self.kind}@{self.location}"

    @property
    def neutral(self) -> dict[str, float]:
        """Value of every parameter with which the effect is absent."""
        return {f"{self.label}.{q.name}": q.neutral for q in self.quantities}

    @property
    def amplitudes(self) -> tuple[str, ...]:
        """Parameters whose neutral value alone makes the effect vanish."""
        return tuple(f"{self.label}.{q.name}" for q in self.quantities if not q.shape)

    @property
    def shapes(self) -> tuple[str, ...]:
        """Parameters that say nothing while the amplitudes are neutral."""
        return tuple(f"{self.label}.{q.name}" for q in self.quantities if q.shape)

    @property
    def prior_range(self) -> dict[str, tuple[float, float]]:
        """Where an engineer would expect every parameter, in the parameter's unit."""
        return {f"{self.label}.{q.name}": q.prior_range for q in self.quantities}

    def reported(
        self, values: Mapping[str, float] | None = None, stds: Mapping[str, float] | None = None
    ) -> dict[str, Reported]:
        """The quantities as people read them, a compliance as the stiffness that it is the reciprocal of.

        The standard deviation of C^(-1/p) is C^(-1/p) std(C)/(p C) (delta method).

        Parameters
        ----------
        values : mapping of parameter name to value, optional
            Nominal where absent; entries of other effects are skipped.
        stds : mapping of parameter name to standard deviation, optional
            NaN where absent.

        Returns
        -------
        dict of quantity name to Reported
        """
        result = {}
        for quantity, entry in zip(self.quantities, self.parameters, strict=True):
            value = float((values or {}).get(entry.name, entry.value))
            std = float((stds or {}).get(entry.name, math.nan))
            name, unit = quantity.reported
            if quantity.reciprocal:
                known = bool(value)
                turned = quantity.turned(value) if known else math.inf
                value, std = turned, abs(turned * std / (quantity.power * value)) if known else math.nan
            result[name] = Reported(value, std, unit)
        return result

    def expected(self, largest: Mapping[str, float]) -> EffectBase:
        """The effect with the ranges to expect where the joints of each segment turn so far in the data [rad]."""
        return self

    def modify(self, system: System) -> System:
        """The system with the effect's changes of description."""
        return system

    def terms(self, state: MidpointState) -> Terms:
        """What the effect adds to the step's equations."""
        return Terms()

    def measure(self, channel: str, output: ca.SX, state: NodeState) -> ca.SX:
        """What a sensor reads where it would have read `output`."""
        return output

    def correct(self, channel: str, reading: ca.SX, effort: ca.SX) -> ca.SX:
        """The true value behind the reading of an input."""
        return reading

    def delay(self, channel: str, camera: bool) -> ca.SX:
        """How long before its recorded time a reading was true [s]."""
        return ca.SX(0)

    def lag(self, channel: str) -> ca.SX:
        """Time constant with which an effort follows its command, or a reading an effort [s]."""
        return ca.SX(0)


EFFECTS: Registry[type[EffectBase]] = Registry("effect")


def build(kind: str, location: str, system: System, values: Mapping[str, float] | None = None) -> EffectBase:
    """An effect of a registered kind at a location that fits; see `make_effect`."""
    cls = EFFECTS[kind]
    label = f"{kind}@{location}"
    quantities = cls.quantities_at(location, system)
    names = {q.name: q for q in quantities} | {q.reported[0]: q for q in quantities}
    given: dict[str, float] = {}
    for name, value in (values or {}).items():
        if name not in names:
            raise ConfigError(f"{kind} has no quantity '{name}'", where=label, hint=nearest(name, names))
        quantity = names[name]
        if name != quantity.name:
            signed = quantity.lower < 0
            if not (value > 0 or (signed and value < 0)):
                kind_of = "a number other than zero" if signed else "a positive number"
                raise ConfigError(f"{name} = {value}", where=label, allowed=f"{kind_of} {quantity.reported[1]}")
            value = quantity.kept(value)
        given[quantity.name] = float(value)
    entries = (
        Parameter(f"{label}.{q.name}", given.get(q.name, q.neutral), q.unit, q.lower, q.upper, q.description)
        for q in quantities
    )
    internal = {f"{label}.{name}": ca.SX.sym(f"{label}.{name}") for name in cls.internal_names(location, system)}
    return cls(kind, location, quantities, Parameters(entries), internal, cls.joints_at(location, system))


# -- where effects can sit --------------------------------------------------------------------------------------------


def segment_names(system: System) -> tuple[str, ...]:
    """The object's segments."""
    return tuple(segment.name for segment in system.segments)


def object_joints(system: System) -> tuple[str, ...]:
    """Joints of the object's segments."""
    return tuple(joint for segment in system.segments for link in segment.links for joint in link)


def clamp_names(system: System) -> tuple[str, ...]:
    """Floating clamps: six joints NAME_x ... NAME_rz."""
    names = set(system.mechanism.joint_names)
    found = [name.removesuffix("_rz") for name in system.mechanism.joint_names if name.endswith("_rz")]
    return tuple(c for c in found if all(f"{c}_{part}" in names for part in ("x", "y", "z", "rx", "ry")))


def robot_joints(system: System) -> tuple[str, ...]:
    """Joints of arms: all but those of the object, of clamps, and of springs that effects put in."""
    other = set(object_joints(system)) | set(system.compliant)
    for clamp in clamp_names(system):
        other |= {f"{clamp}_{part}" for part in ("x", "y", "z", "rx", "ry", "rz")}
    return tuple(name for name in system.mechanism.joint_names if name not in other)


def grasp_names(system: System) -> tuple[str, ...]:
    """All grasps, clamps' included."""
    return tuple(grasp.name for grasp in system.grasps)


def arms(system: System) -> dict[str, tuple[str, ...]]:
    """Joints of every arm: by grasp, else by the prefix left_ or right_, else all as `gripper`."""
    joints = robot_joints(system)
    tree = system.mechanism
    found: dict[str, tuple[str, ...]] = {}
    for grasp in system.grasps:
        chain = {tree.joints[i].name for i in tree.ancestors(tree.frame(grasp.holder).joint)}
        held = tuple(name for name in joints if name in chain)
        if held:
            found[grasp.name] = held
    left = tuple(name for name in joints if not any(name in arm for arm in found.values()))
    for side in ("left", "right"):
        own = tuple(name for name in left if name.startswith(f"{side}_"))
        if own and side not in found:
            found[side] = own
    loose = tuple(name for name in left if not name.startswith(("left_", "right_")))
    if loose and not found:
        found["gripper"] = loose
    return found


def arm_tips(system: System) -> tuple[str, ...]:
    """A frame at the end of every arm that grasps nothing, the one named after a gripper or hand where there is one."""
    tree = system.mechanism
    tips = []
    for name, joints in arms(system).items():
        if name in grasp_names(system):
            continue
        last = max(tree.joint_index(joint) for joint in joints)
        frames = [frame for frame, entry in tree.frames.items() if entry.joint == last]
        named = [f for word in ("gripper", "tcp", "hand", "tool") for f in frames if f.endswith(word)]
        tips += (named or frames[-1:])[:1]
    return tuple(tips)


def strength(system: System, joint: str) -> float:
    """How much stronger a joint is than Baxter's, by its effort limit; 1 for a weaker one and where there is none."""
    limit = system.mechanism.joints[system.mechanism.joint_index(joint)].effort_limit
    return max(1.0, limit / BAXTER_LIMIT) if limit < NO_LIMIT else 1.0


@dataclass(frozen=True)
class Carried:
    """What a joint carries, as the nominal parameters have it, in its own frame.

    Attributes
    ----------
    mass : float
        [kg]
    com : ndarray, shape (3,)
        Centre of mass [m]; the joint's origin where it carries none.
    spread : ndarray, shape (3, 3)
        Integral of r r' dm about the centre of mass [kg m^2].
    """

    mass: float
    com: np.ndarray
    spread: np.ndarray


def carried(system: System, joint: int) -> Carried:
    """What one joint carries, up to the next joints."""
    bodies = [replace(body, gravity_fraction=None) for body in system.mechanism.joints[joint].bodies]
    whole = merged(bodies)
    if whole is None:
        return Carried(0.0, np.zeros(3), np.zeros((3, 3)))
    parameters = system.parameters
    function = ca.Function("carried", [parameters.symbols], [whole.mass, whole.com, whole.about_com])
    mass, com, tensor = (np.array(ca.densify(x)) for x in function(parameters.vector()))
    return Carried(float(mass[0, 0]), com.ravel(), np.trace(tensor) / 2 * np.eye(3) - tensor)


def link_ends(system: System) -> tuple[str, ...]:
    """Where an arm's links end: a frame at the next joint, or at the tip; of frames that move alike the first one.

    A frame stands for the place where it is, whichever of two links that meet there carries it. A place on an axis that
    no other joint moves is none.
    """
    tree = system.mechanism
    if not robot_joints(system):
        return ()
    own = {tree.joint_index(name) for name in robot_joints(system)}
    # a link's own frame is where the link before it ends
    first: dict[int, str] = {}
    for name, frame in tree.frames.items():
        if frame.joint in own:
            first.setdefault(frame.joint, name)
    names = (*arm_tips(system), *(first[joint] for joint in sorted(first)))
    held = [end for grasp in system.grasps for end in (grasp.holder, grasp.held)]
    paths = _paths(system, tree, (*names, *held))
    known = [path for name, path in paths.items() if name in held]
    found = []
    for name in dict.fromkeys(names):
        path = paths[name]
        moves = np.ptp(path, axis=0).max() > SAME_PLACE
        if moves and not any(np.abs(path - other).max() < SAME_PLACE for other in known):
            found.append(name)
            known.append(path)
    return tuple(found)


def link_frames(system: System) -> tuple[str, ...]:
    """One frame on every link of an arm that carries mass: where a grasp holds, else a gripper's, else the first.

    What slides on a link and carries nothing else, a finger for example, counts as part of that link.
    """
    tree = system.mechanism
    preferred = [*(grasp.holder for grasp in system.grasps), *arm_tips(system)]
    parents = {joint.parent for joint in tree.joints}
    found = []
    for name in robot_joints(system):
        index = tree.joint_index(name)
        finger = tree.joints[index].kind == "prismatic" and index not in parents and tree.joints[index].parent >= 0
        frames = [frame for frame, entry in tree.frames.items() if entry.joint == index]
        if not finger and frames and tree.joints[index].bodies:
            found.append(next((frame for frame in preferred if frame in frames), frames[0]))
    return tuple(found)


def _paths(system: System, tree: Mechanism, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Where frames are in some postures of the arms, shape (postures, 3) each [m]."""
    if not names:
        return {}
    q = ca.SX.sym("q", len(tree.joints))
    kinematics = forward_kinematics(tree, q)
    places = ca.horzcat(*(kinematics.position(name) for name in names))
    function = ca.Function("places", [q, system.parameters.symbols], [places])
    rng, theta = np.random.default_rng(0), system.parameters.vector()
    at = [np.array(ca.densify(function(rng.uniform(-1.0, 1.0, len(tree.joints)), theta))) for _ in range(3)]
    return {name: np.stack([place[:, i] for place in at]) for i, name in enumerate(names)}


def roots(system: System) -> dict[str, tuple[str, ...]]:
    """First joint of every segment that grows from no other, by what it stands on: its clamp, else `base`."""
    tree, clamps = system.mechanism, clamp_names(system)
    found: dict[str, tuple[str, ...]] = {}
    for segment in system.segments:
        if segment.parent is not None:
            continue
        first = segment.links[0][0]
        below = {tree.joints[i].name for i in tree.ancestors(tree.joints[tree.joint_index(first)].parent)}
        place = next((clamp for clamp in clamps if f"{clamp}_rz" in below), "base")
        found[place] = (*found.get(place, ()), first)
    return found


def junctions(system: System) -> dict[str, tuple[str, ...]]:
    """First joints of the branches at every junction: `w_PARENT` at a parent's tip, else `junction_BRANCH`."""
    tree = system.mechanism
    found: dict[str, tuple[str, ...]] = {}
    for segment in system.segments:
        if segment.parent is None:
            continue
        first = segment.links[0][0]
        tip = tree.frame(f"w_{segment.parent}").joint
        place = f"w_{segment.parent}" if tip in tree.ancestors(tree.joint_index(first)) else f"junction_{segment.name}"
        found[place] = (*found.get(place, ()), first)
    return found


def segment_of_frame(system: System, frame: str) -> str | None:
    """The segment whose link carries a frame."""
    index = system.mechanism.frame(frame).joint
    if index < 0:
        return None
    name = system.mechanism.joints[index].name
    return next((s.name for s in system.segments if any(name in link for link in s.links)), None)


# -- helpers for the kinds --------------------------------------------------------------------------------------------


def segment_springs(system: System, segment: str) -> tuple[ElasticJoint, ...]:
    """Elastic joints of a segment."""
    return tuple(spring for spring in system.elastic if spring.segment == segment)


def with_springs(system: System, changed: Mapping[str, ElasticJoint]) -> System:
    """The system with some elastic joints replaced, by joint name."""
    return replace(system, elastic=tuple(changed.get(spring.joint, spring) for spring in system.elastic))


def typical_stiffness(system: System, segment: str) -> float:
    """Mean bending stiffness of a segment's joints at the parameters' nominal values, above zero [N m/rad]."""
    springs = segment_springs(system, segment)
    chosen = [s.stiffness for s in springs if s.kind == "bend"] or [s.stiffness for s in springs]
    if not chosen:
        return 1.0
    parameters = system.parameters
    function = ca.Function("stiffness", [parameters.symbols], [ca.vertcat(*chosen)])
    return max(float(np.mean(np.array(function(parameters.vector())))), 1e-6)


def on_joint(system: System, joint: str, value: ca.SX) -> ca.SX:
    """A generalized force on one joint alone, shape (n, 1)."""
    force = ca.SX(system.size, 1)
    force[system.mechanism.joint_index(joint)] = value
    return force


def with_bodies(system: System, changed: Mapping[str, Sequence[Inertia]]) -> System:
    """The system with other bodies on some joints, by joint name."""
    tree = system.mechanism
    joints = tuple(replace(j, bodies=tuple(changed[j.name])) if j.name in changed else j for j in tree.joints)
    return replace(system, mechanism=replace(tree, joints=joints))


def with_grasp(system: System, changed: Grasp) -> System:
    """The system with one grasp replaced, by its name."""
    return replace(system, grasps=tuple(changed if g.name == changed.name else g for g in system.grasps))


def substituted(system: System, old: Collection[ca.SX], new: Collection[ca.SX]) -> System:
    """The system with symbols replaced everywhere in its description."""
    before, after = ca.vertcat(*old), ca.vertcat(*new)
    return system.mapped(lambda expression: ca.substitute(expression, before, after))


def inverse(placement: Placement) -> Placement:
    """The placement that undoes another."""
    back = placement.rotation.T
    return Placement(back, -(back @ placement.translation))

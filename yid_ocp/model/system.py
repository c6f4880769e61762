"""The mechanical system: mechanism, springs, dampers, grasps and inputs, and the interface of effects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, Protocol, runtime_checkable

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from yid_ocp.errors import ModelError, nearest
from yid_ocp.model.drives import PositionServos, Servo, Spring, joint_dampers, joint_servos, joint_spring, weightless
from yid_ocp.model.flexible import AXES, ElasticJoint, FlexibleObject, SegmentLayout
from yid_ocp.model.kinematics import Kinematics
from yid_ocp.model.mechanism import Frame, Joint, Mechanism, Placement
from yid_ocp.model.parameters import Parameters
from yid_ocp.shown import Shown, Summary, counted

GraspKind = Literal["point", "axis", "weld"]
EQUATIONS: dict[str, tuple[str, ...]] = {
    "point": ("x", "y", "z"),
    "axis": ("x", "y", "z", "tilt_x", "tilt_y"),
    "weld": ("x", "y", "z", "turn_x", "turn_y", "turn_z"),
}
"""Names of a grasp's constraint equations, by its kind."""


@dataclass(frozen=True)
class Grasp:
    """A holonomic constraint between a frame of the robot (or a clamp) and a frame of the object.

    Attributes
    ----------
    name : str
        `left`, `right`, `gripper`, or a clamp's name.
    holder, held : str
        Frames; their origins coincide.
    kind : "point", "axis" or "weld"
        3 equations (positions), 5 (and the direction of the z axes), 6 (and the orientation).
    rotation : casadi.SX, shape (3, 3)
        Orientation of `held` in `holder` for `axis` and `weld`.
    offset : casadi.SX, shape (3, 1)
        Where the grasped point sits in the holder's frame [m].
    slip : casadi.SX
        How far the grasped point has crept along the object's z axis [m].
    compliance : casadi.SX
        C in phi(q_{k+1}) = C lam_k / h [m/N]; zero for a rigid grasp.
    relaxation : casadi.SX, optional
        T in phi(q_{k+1}) + T (phi(q_{k+1}) - phi(q_k)) / h = C lam_k / h, damping over stiffness of the grasp [s].
    """

    name: str
    holder: str
    held: str
    kind: GraspKind = "point"
    rotation: ca.SX = field(default_factory=lambda: ca.SX(ca.DM.eye(3)))
    offset: ca.SX = field(default_factory=lambda: ca.SX(ca.DM.zeros(3)))
    slip: ca.SX = field(default_factory=lambda: ca.SX(0))
    compliance: ca.SX = field(default_factory=lambda: ca.SX(0))
    relaxation: ca.SX | None = None

    @property
    def equations(self) -> int:
        """Number of scalar constraint equations."""
        return len(EQUATIONS[self.kind])

    @property
    def equation_names(self) -> tuple[str, ...]:
        """Names of the equations: `left.x`, ..., then tilts for `axis` or rotations for `weld`."""
        return tuple(f"{self.name}.{part}" for part in EQUATIONS[self.kind])

    def mapped(self, change: Callable[[ca.SX], ca.SX]) -> Grasp:
        """The grasp with `change` applied to every expression."""
        return replace(
            self,
            rotation=change(self.rotation),
            offset=change(self.offset),
            slip=change(self.slip),
            compliance=change(self.compliance),
            relaxation=None if self.relaxation is None else change(self.relaxation),
        )

    def residual(self, kinematics: Kinematics) -> ca.SX:
        """Constraint residual phi(q), shape (equations, 1): positions [m], then direction or orientation [rad]."""
        holder = kinematics.pose(self.holder) @ Placement(self.rotation, self.offset)
        held = kinematics.pose(self.held)
        point = held.translation - held.rotation[:, 2] * self.slip
        rows = [holder.translation - point]
        if self.kind == "axis":
            rows.append(holder.rotation[:, :2].T @ held.rotation[:, 2])
        elif self.kind == "weld":
            error = holder.rotation.T @ held.rotation
            pairs = ((2, 1), (0, 2), (1, 0))
            rows.append(0.5 * ca.vertcat(*(error[i, j] - error[j, i] for i, j in pairs)))
        return ca.vertcat(*rows)

    def alignment(self, kinematics: Kinematics) -> ca.SX:
        """Differences between the axes that the grasp aligns, shape (0, 3 or 9; 1).

        Redundant beside `residual`, but not zero where axes point in opposite ways: for a search that starts far off.
        """
        if self.kind == "point":
            return ca.SX(0, 1)
        difference = kinematics.pose(self.holder).rotation @ self.rotation - kinematics.pose(self.held).rotation
        return difference[:, 2] if self.kind == "axis" else ca.vec(difference)


@dataclass(frozen=True)
class MidpointState:
    """Symbols of one step's midpoint, on which energies and forces may depend.

    Attributes
    ----------
    system : System
    kinematics : Kinematics
        At `q`.
    q, v : casadi.SX, shape (n, 1)
        (q_k + q_{k+1})/2 and (q_{k+1} - q_k)/h.
    z, z_rate : casadi.SX, shape (nz, 1)
        The same of all internal coordinates.
    u : casadi.SX, shape (nu, 1)
        Motor torques held over the step [N m], or what servos are commanded [rad or m].
    constraint_force : casadi.SX, shape (m, 1)
        lam_k / h [N or N m].
    internal : mapping of str to int
        Row of each internal coordinate in `z`, by name.
    h : casadi.SX
        Length of the step [s].
    """

    system: System
    kinematics: Kinematics
    q: ca.SX
    v: ca.SX
    z: ca.SX
    z_rate: ca.SX
    u: ca.SX
    constraint_force: ca.SX
    internal: Mapping[str, int]
    h: ca.SX


@dataclass(frozen=True)
class NodeState:
    """Symbols of one trajectory node, on which measurements may depend.

    Attributes
    ----------
    system : System
    kinematics : Kinematics
        At `q`.
    q : casadi.SX, shape (n, 1)
    z : casadi.SX, shape (nz, 1)
    effort : casadi.SX, shape (n, 1)
        Torque at every joint that has one: the motor torque where driven, the predicted effort where prescribed.
    internal : mapping of str to int
        Row of each internal coordinate in `z`, by name.
    camera : Placement or None
        Pose in the world of the camera that measures; None for any other sensor.
    frame : str or None
        Frame of the mechanism that the channel marks; None for a joint.
    """

    system: System
    kinematics: Kinematics
    q: ca.SX
    z: ca.SX
    effort: ca.SX
    internal: Mapping[str, int]
    camera: Placement | None = None
    frame: str | None = None


@dataclass(frozen=True)
class ClosedForce:
    """A dissipative generalized force F(q, v) of wrenches on bodies, with its derivatives in closed form.

    With S_j and D_j as in `RigidBody`, for i an ancestor of joint j or j itself:

        dF_j/dv_i = dF_i/dv_j = S_i . A_j       dF_j/dq_i = D_i . A_j       dF_i/dq_j = S_i . T_j

    Attributes
    ----------
    force : casadi.SX, shape (n, 1)
        [N m or N]
    A, T : casadi.SX, shape (6, n)
    """

    force: ca.SX
    A: ca.SX
    T: ca.SX


@dataclass(frozen=True)
class Terms:
    """Energy, forces and equations that one effect adds to a step.

    Attributes
    ----------
    lagrangian : casadi.SX
        Scalar added to L(q, v) [J].
    force : casadi.SX, optional, shape (n, 1)
        Generalized force F(q, v, u, z) [N m or N].
    viscous : casadi.SX, optional, shape (n, 1)
        The part of the force that only takes energy out, in proportion to velocity [N m or N].
    internal : mapping of str to casadi.SX
        Equation (= 0) of each internal coordinate that the term owns, at the midpoint.
    at_rest : mapping of str to casadi.SX
        Equation (= 0) that takes its place in a static equilibrium, where its own says nothing or cannot hold.
    closed : ClosedForce, optional
        A dissipative force on bodies whose slopes are given, because differentiating it would cost too much.
    """

    lagrangian: ca.SX = field(default_factory=lambda: ca.SX(0))
    force: ca.SX | None = None
    viscous: ca.SX | None = None
    internal: Mapping[str, ca.SX] = field(default_factory=dict)
    at_rest: Mapping[str, ca.SX] = field(default_factory=dict)
    closed: ClosedForce | None = None


@runtime_checkable
class Effect(Protocol):
    """Interface of an unmodelled effect or another addition to the nominal model.

    `modify` changes the description (masses, lengths, grasps, gravity, added joints); `terms` adds energy, force and
    equations of internal coordinates. At neutral parameters both must leave the nominal model unchanged.
    """

    @property
    def kind(self) -> str:
        """Name under which the effect's class is registered."""
        ...

    @property
    def location(self) -> str:
        """Name of the place where the effect acts."""
        ...

    @property
    def parameters(self) -> Parameters:
        """The effect's parameters, named `kind@location.quantity`."""
        ...

    @property
    def internal(self) -> Mapping[str, ca.SX]:
        """The effect's internal coordinates (without momentum): name to the symbol that `modify` uses."""
        ...

    def modify(self, system: System) -> System:
        """The system with the effect's changes of masses, lengths, grasps, gravity or joints."""
        ...

    def terms(self, state: MidpointState) -> Terms:
        """Energy, forces and internal equations that the effect adds to one step."""
        ...

    def measure(self, channel: str, output: ca.SX, state: NodeState) -> ca.SX:
        """What a sensor reads instead of `output`; `channel` is `group.point` or `joints.quantity.JOINT`."""
        ...


@runtime_checkable
class RecordedEffect(Effect, Protocol):
    """Interface of an effect on recorded inputs and times.

    Recorded torques drive the model, recorded angles prescribe it or are followed: there the reading is known and the
    true value is sought, the opposite of `measure`.
    """

    def correct(self, channel: str, reading: ca.SX, effort: ca.SX) -> ca.SX:
        """The true value for a recorded `joints.position.JOINT` or `joints.effort.JOINT`, at the true `effort`."""
        ...

    def delay(self, channel: str, camera: bool) -> ca.SX:
        """How long before its recorded time a sample was true [s].

        `channel` is as in `measure`, or `torque.JOINT` for a recorded torque that drives the model: it then acts so
        much later than it was recorded.
        """
        ...

    def lag(self, channel: str) -> ca.SX:
        """Time constant with which a torque follows the recorded one, or a recorded effort the true one [s].

        `channel` is `torque.JOINT` or `joints.effort.JOINT`.
        """
        ...


@dataclass(frozen=True, repr=False)
class System(Shown):
    """A mechanism with springs, dampers, grasps, inputs and effects.

    Attributes
    ----------
    mechanism : Mechanism
        Arms first (left, then right), then the object.
    parameters : Parameters
        Fixes the order of theta.
    elastic : tuple of ElasticJoint
    damping : mapping of joint name to casadi.SX
        Viscous coefficients of joints that are not elastic [N m s/rad].
    grasps : tuple of Grasp
    driven : tuple of str
        Joints with an input, in the order of u: a motor torque, or what a servo is commanded.
    servos : mapping of joint name to Servo
        Of all driven joints, or of none.
    prescribed : tuple of str
        Joints whose coordinate is known, in the order of s.
    gravity : casadi.SX, shape (3, 1)
        [m/s^2], in the world frame.
    time_scale : casadi.SX
        Factor on the recorded time step.
    compliant : mapping of joint name to casadi.SX
        Coordinates held by a spring of this compliance [rad/(N m)], zero meaning rigid; their equations and momentum
        are multiplied by it so that they stay regular at zero.
    relaxing : mapping of joint name to float
        Relaxation time T of some compliant coordinates [s]: q + T dq/dt = compliance x torque. A massless one needs it
        to forget a start that does not fit its load.
    segments : tuple of SegmentLayout
    points : tuple of str
        Frames that a sensor may see.
    effects : tuple of Effect
    """

    mechanism: Mechanism
    parameters: Parameters
    elastic: tuple[ElasticJoint, ...] = ()
    damping: Mapping[str, ca.SX] = field(default_factory=dict)
    grasps: tuple[Grasp, ...] = ()
    driven: tuple[str, ...] = ()
    servos: Mapping[str, Servo] = field(default_factory=dict)
    prescribed: tuple[str, ...] = ()
    gravity: ca.SX = field(default_factory=lambda: ca.SX(ca.DM([0.0, 0.0, -9.81])))
    time_scale: ca.SX = field(default_factory=lambda: ca.SX(1))
    compliant: Mapping[str, ca.SX] = field(default_factory=dict)
    relaxing: Mapping[str, float] = field(default_factory=dict)
    segments: tuple[SegmentLayout, ...] = ()
    points: tuple[str, ...] = ()
    effects: tuple[Effect, ...] = ()

    @staticmethod
    def build(
        mechanism: Mechanism | None = None,
        *,
        objects: Sequence[tuple[FlexibleObject, str | None, ArrayLike | None]] = (),
        grasps: Sequence[Grasp] = (),
        driven: Sequence[str] = (),
        prescribed: Sequence[str] = (),
        damping: float | Mapping[str, float] = 0.0,
        gravity: ArrayLike = (0.0, 0.0, -9.81),
        points: Sequence[str] | None = None,
        effects: Sequence[Effect] = (),
        springs: Mapping[str, Spring] | None = None,
        servos: PositionServos | None = None,
    ) -> System:
        """A system from a robot, objects, grasps and effects.

        Parameters
        ----------
        mechanism : Mechanism, optional
            The robot; none for an object alone.
        objects : sequence of (FlexibleObject, frame, placement)
            Each hung on a frame of what came before (None: the world) at a 4x4 placement (None: identity).
        grasps : sequence of Grasp
        driven, prescribed : sequence of str
            Joint names; no joint may be both.
        damping : float or mapping
            Viscous damping of the robot's joints [N m s/rad]; becomes the parameters `JOINT.damping`.
        gravity : array_like, shape (3,)
            [m/s^2]
        points : sequence of str, optional
            Frames that sensors may see, points along a segment as `T1:40%`; the segments' tips `w_*` when absent.
        effects : sequence of Effect
        springs : mapping of str to Spring, optional
            By joint of the robot; become the parameters `JOINT.stiffness` and `JOINT.rest`.
        servos : PositionServos, optional
            What the inputs of driven joints command; adds the parameters `JOINT.servo_gain`, `servo_damping`,
            `servo_delay` and `servo_torque_limit`.

        Returns
        -------
        System

        Raises
        ------
        ModelError
            A name that does not exist or is used twice, no joint at all, a joint both driven and prescribed.
        """
        acceleration = np.asarray(gravity, float)
        if acceleration.shape != (3,) or not np.all(np.isfinite(acceleration)):
            raise ModelError(f"gravity = {acceleration}", allowed="three numbers [m/s^2]")
        tree = mechanism if mechanism is not None else Mechanism("system", (), {})
        wanted = dict(damping) if isinstance(damping, Mapping) else dict.fromkeys(tree.joint_names, float(damping))
        dampers = joint_dampers(tree, wanted)
        entries = list(dampers.values())
        elastic: list[ElasticJoint] = []
        for joint, spring in (springs or {}).items():
            stiffness, rest = joint_spring(tree, joint, spring)
            entries += [stiffness, rest]
            elastic.append(ElasticJoint(joint, joint, "bend", "", stiffness.symbol, ca.SX(0), rest.symbol))
        moved, own = ({}, []) if servos is None else joint_servos(tree, driven, servos.commands)
        entries += own
        tree = weightless(tree) if servos is not None and servos.gravity_compensation else tree
        segments: list[SegmentLayout] = []
        for item, frame, placement in objects:
            tree = tree.joined(item.mechanism, frame, placement)
            elastic += item.elastic
            segments += item.segments
        seen = tuple(points) if points is not None else tuple(name for name in tree.frames if name.startswith("w_"))
        _check_names(tree, grasps, driven, prescribed, seen)
        system = System(
            tree,
            tree.parameters.joined(entries),
            tuple(elastic),
            {joint: parameter.symbol for joint, parameter in dampers.items()},
            tuple(grasps),
            tuple(driven),
            moved,
            tuple(prescribed),
            ca.SX(ca.DM(acceleration)),
            segments=tuple(segments),
            points=seen,
        )
        return system.with_effects(effects)

    def with_effects(self, effects: Sequence[Effect]) -> System:
        """This system with additional effects, whose parameters are appended to theta in the order given."""
        system = self
        for effect in effects:
            system = replace(system, parameters=system.parameters.joined(effect.parameters))
            system = effect.modify(system)
            system = replace(system, effects=(*system.effects, effect))
        return system

    def _summary(self) -> Summary:
        kinds = {"driven": len(self.driven), "prescribed": len(self.prescribed)}
        kinds["passive"] = self.size - sum(kinds.values())
        moved = ", ".join(f"{count} {kind}" for kind, count in kinds.items() if count)
        parts = [f"{counted(self.size, 'coordinate')} ({moved})", counted(self.constraint_count, "constraint")]
        parts += [f"{effect.kind}@{effect.location}" for effect in self.effects]
        return Summary(f"{self.mechanism.name}, {', '.join(parts)}", self.parameters._summary().rows)

    @property
    def size(self) -> int:
        """n, the number of configuration variables."""
        return len(self.mechanism.joints)

    @property
    def constraint_count(self) -> int:
        """m, the number of scalar constraints."""
        return sum(grasp.equations for grasp in self.grasps)

    @cached_property
    def driven_indices(self) -> tuple[int, ...]:
        """Configuration index of each input."""
        return tuple(self.mechanism.joint_index(name) for name in self.driven)

    @cached_property
    def prescribed_indices(self) -> tuple[int, ...]:
        """Configuration index of each prescribed coordinate."""
        return tuple(self.mechanism.joint_index(name) for name in self.prescribed)

    @cached_property
    def free_indices(self) -> tuple[int, ...]:
        """Configuration indices that are not prescribed."""
        return tuple(i for i in range(self.size) if i not in self.prescribed_indices)

    @property
    def internal(self) -> dict[str, ca.SX]:
        """Internal coordinates in the order of z: name to the symbol that stands for it in grasps and placements."""
        return {name: symbol for effect in self.effects for name, symbol in effect.internal.items()}

    def segment(self, name: str) -> SegmentLayout:
        """Layout of a segment by name; `ModelError` with the nearest name where there is none."""
        for entry in self.segments:
            if entry.name == name:
                return entry
        raise ModelError(f"there is no segment '{name}'", hint=nearest(name, [s.name for s in self.segments]))

    def mapped(self, change: Callable[[ca.SX], ca.SX]) -> System:
        """The system with `change` applied to every expression of its description."""
        elastic = tuple(
            replace(e, stiffness=change(e.stiffness), damping=change(e.damping), rest=change(e.rest))
            for e in self.elastic
        )
        segments = tuple(
            replace(s, lengths=tuple(change(x) for x in s.lengths), radius=change(s.radius), mass=change(s.mass))
            for s in self.segments
        )
        return replace(
            self,
            mechanism=self.mechanism.mapped(change),
            elastic=elastic,
            damping={joint: change(value) for joint, value in self.damping.items()},
            servos={joint: servo.mapped(change) for joint, servo in self.servos.items()},
            grasps=tuple(grasp.mapped(change) for grasp in self.grasps),
            gravity=change(self.gravity),
            time_scale=change(self.time_scale),
            compliant={joint: change(value) for joint, value in self.compliant.items()},
            segments=segments,
        )

    def elastic_energy(self, q: ca.SX) -> ca.SX:
        """Elastic energy, the sum of 1/2 stiffness (q - rest)^2 over the elastic joints [J]."""
        energy = ca.SX(0)
        for spring in self.elastic:
            deflection = q[self.mechanism.joint_index(spring.joint)] - spring.rest
            energy += 0.5 * spring.stiffness * deflection**2
        return energy

    def viscous_force(self, v: ca.SX) -> ca.SX:
        """Generalized force of all viscous dampers, shape (n, 1) [N m]."""
        force = [ca.SX(0)] * self.size
        for spring in self.elastic:
            index = self.mechanism.joint_index(spring.joint)
            force[index] = force[index] - spring.damping * v[index]
        for joint, coefficient in self.damping.items():
            index = self.mechanism.joint_index(joint)
            force[index] = force[index] - coefficient * v[index]
        return ca.vertcat(*force)

    def input_force(self, u: ca.SX, q: ca.SX, v: ca.SX) -> ca.SX:
        """Generalized force of motor torques and servos, shape (n, 1) [N m]."""
        force = [ca.SX(0)] * self.size
        for row, (joint, index) in enumerate(zip(self.driven, self.driven_indices, strict=True)):
            servo = self.servos.get(joint)
            force[index] = u[row] if servo is None else servo.torque(u[row], q[index], v[index])
        return ca.vertcat(*force)

    def constraints(self, kinematics: Kinematics) -> ca.SX:
        """Constraint residual phi(q) of all grasps, shape (m, 1)."""
        return ca.vertcat(*(grasp.residual(kinematics) for grasp in self.grasps)) if self.grasps else ca.SX(0, 1)

    def constraint_relaxation(self) -> ca.SX | None:
        """Relaxation times T in phi + T dphi/dt = C lam / h, shape (m, 1) [s]; None where no grasp has one."""
        if all(grasp.relaxation is None for grasp in self.grasps):
            return None
        zero = ca.SX(0)
        return ca.vertcat(
            *(zero if g.relaxation is None else g.relaxation for g in self.grasps for _ in range(g.equations))
        )

    def constraint_compliance(self) -> ca.SX:
        """Diagonal of C in phi(q_{k+1}) = C lam_k / h, shape (m, 1)."""
        rows = [grasp.compliance for grasp in self.grasps for _ in range(grasp.equations)]
        return ca.vertcat(*rows) if rows else ca.SX(0, 1)


def _check_names(
    tree: Mechanism, grasps: Sequence[Grasp], driven: Sequence[str], prescribed: Sequence[str], points: Sequence[str]
) -> None:
    """Raise `ModelError` for a name that does not exist or is used twice, or a tree without joints."""
    if not tree.joints:
        raise ModelError("the system has no joint", hint="give a robot, an object, or both")
    for joint in [*driven, *prescribed]:
        tree.joint_index(joint)
    for kind, names in (
        ("driven joints", list(driven)),
        ("prescribed joints", list(prescribed)),
        ("grasps", [grasp.name for grasp in grasps]),
    ):
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ModelError(f"'{repeated[0]}' is named twice among the {kind}", allowed="each name once")
    if both := sorted(set(driven) & set(prescribed)):
        raise ModelError(f"joint '{both[0]}' is both driven and prescribed", allowed="one of the two")
    for grasp in grasps:
        tree.frame(grasp.holder)
        tree.frame(grasp.held)
    for point in points:
        tree.frame(point)


def floating_clamp(name: str, frame: str | None = None) -> Mechanism:
    """A massless mechanism of one frame with six coordinates (x, y, z, then rotations about x, y, z).

    Parameters
    ----------
    name : str
        Joints become `NAME_x`, `NAME_y`, `NAME_z`, `NAME_rx`, `NAME_ry`, `NAME_rz`; the moving frame is `NAME`.
    frame : str, optional
        Another name for the moving frame.
    """
    kinds: tuple[tuple[str, Literal["revolute", "prismatic"]], ...] = (("", "prismatic"), ("r", "revolute"))
    joints = tuple(
        Joint(f"{name}_{prefix}{letter}", kind, 3 * block + a - 1, Placement.identity(), axis)
        for block, (prefix, kind) in enumerate(kinds)
        for a, (letter, axis) in enumerate(AXES.items())
    )
    return Mechanism(name, joints, {frame or name: Frame(5, Placement.identity())})

"""The mechanical system of robot and object, and the base class of effects."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations, product
from typing import TYPE_CHECKING, Literal, TypedDict

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from yid_ocp.display import ReprMixin, ReprTexts, count_with_noun
from yid_ocp.errors import ModelError, require_known_names
from yid_ocp.model import servos_and_springs
from yid_ocp.model.flexible import AXIS_UNIT_VECTORS, ElasticJoint, FlexibleObject, SingleSegmentLayout
from yid_ocp.model.kinematics import Kinematics, forward_kinematics
from yid_ocp.model.mechanism import Frame, Joint, Mechanism, Placement, map_expressions
from yid_ocp.model.parameters import Parameter, Parameters

if TYPE_CHECKING:
    from typing import Unpack  # Python 3.11

_GraspKind = Literal["point", "axis", "weld"]
_GRASP_EQUATION_NAMES = {
    "point": ("x", "y", "z"),
    "axis": ("x", "y", "z", "tilt_x", "tilt_y"),
    "weld": ("x", "y", "z", "turn_x", "turn_y", "turn_z"),
}


@dataclass(frozen=True)
class Grasp:
    """A grasp that keeps a point of the object at one of its holder. `System.build` raises `ModelError` for a fault."""

    name: str
    """`left`, `right`, `gripper`, or a clamp's name."""
    holder_frame: str
    held_frame: str
    kind: _GraspKind = "point"
    """`point` has 3 equations (position), `axis` 5 (and direction of the z axes), `weld` 6 (and orientation)."""
    held_orientation: ca.SX = field(default_factory=lambda: ca.SX(ca.DM.eye(3)))
    """Orientation of `held_frame` in `holder_frame` for `axis` and `weld`, shape (3, 3)."""
    holder_offset: ca.SX = field(default_factory=lambda: ca.SX(ca.DM.zeros(3)))
    """Position of the grasped point in the holder's frame, shape (3, 1) [m]."""
    axial_slip: ca.SX = field(default_factory=lambda: ca.SX(0))
    """Distance by which the grasped point has slipped along the object's z axis [m]."""
    compliance: ca.SX = field(default_factory=lambda: ca.SX(0))
    """C in phi(q_{k+1}) + T (phi(q_{k+1}) - phi(q_k)) / h = C lam_k / h [m/N]; zero if rigid."""
    relaxation_time: ca.SX = field(default_factory=lambda: ca.SX(0))
    """T in the equation of `compliance` [s]."""

    @property
    def n_constraint_equations(self) -> int:
        """The number of scalar constraint equations of the grasp."""
        return len(_GRASP_EQUATION_NAMES[self.kind])

    @property
    def constraint_equation_names(self) -> tuple[str, ...]:
        """The names of the constraint equations: positions such as `left.x`, then tilts or rotations."""
        return tuple(f"{self.name}.{part}" for part in _GRASP_EQUATION_NAMES[self.kind])

    def grasped_point_frames(self, mechanism: Mechanism) -> tuple[Frame, Frame]:
        """Return the frames of holder and held link whose origins coincide in the grasp, and whose axes it aligns."""
        slipped = Placement(ca.SX(ca.DM.eye(3)), ca.vertcat(0, 0, -self.axial_slip))
        holder, held = mechanism.frame(self.holder_frame), mechanism.frame(self.held_frame)
        local = Placement(self.held_orientation, self.holder_offset)
        return Frame(holder.joint_index, holder.placement @ local), Frame(held.joint_index, held.placement @ slipped)

    def orientation_products(self, kinematics: Kinematics) -> list[list[tuple[ca.SX, ca.SX]]]:
        """Return for each orientation equation the pairs of vectors (of holder, held) whose dot products sum to it."""
        frames = self.grasped_point_frames(kinematics.mechanism)
        a, b = (ca.horzsplit(kinematics.frame_pose(frame).rotation) for frame in frames)
        if self.kind == "axis":
            return [[(a[0], b[2])], [(a[1], b[2])]]
        turns = ((2, 1), (0, 2), (1, 0)) if self.kind == "weld" else ()
        return [[(0.5 * a[i], b[j]), (-0.5 * a[j], b[i])] for i, j in turns]

    def constraint_residual(self, kinematics: Kinematics) -> ca.SX:
        """Return the constraint residual phi(q), holder minus held, a column: position [m], then orientation [rad]."""
        holder, held = map(kinematics.frame_position, self.grasped_point_frames(kinematics.mechanism))
        rows = (sum((ca.dot(a, b) for a, b in pairs), ca.SX(0)) for pairs in self.orientation_products(kinematics))
        return ca.vertcat(holder - held, *rows)

    def holder_minus_held_axis_directions(self, kinematics: Kinematics) -> ca.SX:
        """Return the holder's axes minus the held axes (0, 3 or 9 rows), which is not zero for opposite axes."""
        if self.kind == "point":
            return ca.SX(0, 1)
        holder, held = (kinematics.frame_pose(name).rotation for name in (self.holder_frame, self.held_frame))
        difference = holder @ self.held_orientation - held
        return difference[:, 2] if self.kind == "axis" else ca.vec(difference)


@dataclass(frozen=True)
class MidpointStateSymbols:
    """The symbols at the midpoint of one time step, on which energies and forces may depend.

    Coordinates q and internal coordinates z are means of the two nodes; v and z_rate are their differences over h.
    """

    system: System
    kinematics: Kinematics  # at q
    q: ca.SX  # (q_k + q_{k+1})/2, shape (n, 1)
    v: ca.SX  # (q_{k+1} - q_k)/h, shape (n, 1)
    z: ca.SX  # shape (nz, 1)
    z_rate: ca.SX  # shape (nz, 1)
    u: ca.SX  # motor torques held over the step [N m], or servo commands [rad or m], shape (nu, 1)
    constraint_force: ca.SX  # lam_k/h, shape (m, 1) [N or N m]
    internal_rows: Mapping[str, int]  # row of each internal coordinate in z, by name
    h: ca.SX  # length of the step [s]


@dataclass(frozen=True)
class NodeStateSymbols:
    """The symbols at one node of a trajectory, on which measurements may depend.

    The velocity `v` is the mean of the midpoint velocities (q_{k+1} - q_k)/h of the steps before and after the node.
    The acceleration `a` is their difference over h. The errors are of order h^2. At the first and last node, `v` is the
    velocity of the adjacent step, and `a` is the acceleration at the neighbouring node (errors of order h). `load` and
    `lam` belong to the step after the node, or at the last node to the last step.
    """

    system: System
    kinematics: Kinematics  # at q
    q: ca.SX  # shape (n, 1)
    v: ca.SX  # shape (n, 1) [rad/s or m/s]
    a: ca.SX  # shape (n, 1) [rad/s^2 or m/s^2]
    z: ca.SX  # internal coordinates, shape (nz, 1)
    load: ca.SX  # motor torque where driven, predicted effort where prescribed, shape (n, 1) [N m or N]
    lam: ca.SX  # constraint forces lam_k/h, shape (m, 1) [N or N m]
    internal_rows: Mapping[str, int]  # row of each internal coordinate in z, by name
    camera_pose: Placement | None = None  # pose of the measuring camera in the world; None for other sensors
    marked_frame: str | None = None  # frame of the mechanism that the channel measures; None for a joint


@dataclass(frozen=True)
class ForceWithFactoredDerivatives:
    """A dissipative generalized force F(q, v) from wrenches on bodies, with its derivatives, (n, 1) [N m or N].

    S_j and D_j are as in `LagrangianFirstDerivatives`. A_j and T_j are the columns of A and T (6, n). For i an
    ancestor of joint j or j itself:

        dF_j/dv_i = dF_i/dv_j = S_i . A_j       dF_j/dq_i = D_i . A_j       dF_i/dq_j = S_i . T_j
    """

    force: ca.SX
    A: ca.SX
    T: ca.SX


@dataclass(frozen=True)
class EffectStepTerms:
    """The energy, generalized forces (n, 1) [N m or N] and internal equations that an effect adds to one step."""

    lagrangian: ca.SX = field(default_factory=lambda: ca.SX(0))  # scalar added to L(q, v) [J]
    generalized_force: ca.SX | None = None  # F(q, v, u, z)
    dissipative_force: ca.SX | None = None  # part of the force that depends on velocity and dissipates energy
    # equation (= 0) of each internal coordinate at the midpoint, and its replacement at rest if it cannot hold there
    internal_equations: Mapping[str, ca.SX] = field(default_factory=dict)
    static_equations: Mapping[str, ca.SX] = field(default_factory=dict)
    # a dissipative force on bodies with given derivatives, because automatic differentiation would be too expensive
    force_with_derivatives: ForceWithFactoredDerivatives | None = None


@dataclass(frozen=True)
class Effect:
    """The base class of effects, such as friction, that extend the nominal model. The base class changes nothing.

    With neutral parameters a subclass leaves the nominal model unchanged. `reading_from_true_value` computes a sensor
    reading. Its inverse, `true_value_from_reading`, is for recorded inputs (driving torques, given angles).
    """

    kind: str  # name under which its class is registered
    location: str  # name of the location where it acts
    parameters: Parameters  # named `kind@location.parameter`
    # symbols that `apply_to_system` uses, by name `kind@location.joint`; they have no momentum
    internal_coordinate_symbols: Mapping[str, ca.SX] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """The label of the effect, `kind@location`."""
        return f"{self.kind}@{self.location}"

    def apply_to_system(self, system: System) -> System:
        """Return the system with this effect, which may change masses, lengths, springs, grasps, gravity or joints."""
        return system

    def step_terms(self, state: MidpointStateSymbols) -> EffectStepTerms:
        """Return the energy, forces and internal equations that this effect adds to a time step at its midpoint."""
        return EffectStepTerms()

    def reading_from_true_value(self, channel: str, output: ca.SX, state: NodeStateSymbols) -> ca.SX:
        """Predict a sensor reading from its error-free value. `channel` is `group.point` or `joints.quantity.JOINT`."""
        return output

    def true_value_from_reading(self, channel: str, reading: ca.SX, effort: ca.SX) -> ca.SX:
        """Return the true value of a recorded `joints.position.JOINT` or `joints.effort.JOINT`, given `effort`."""
        return reading

    def added_channel_delay(self, channel: str, camera: bool) -> ca.SX:
        """Return the delay [s] that this effect adds to a channel: the recorded minus the true time of a sample.

        `camera` is True for points of a camera. For a driving torque, `torque.JOINT`, it is action minus recorded time.
        """
        return ca.SX(0)

    def channel_lag_time_constant(self, channel: str) -> ca.SX:
        """Return the time constant [s] of a channel's first-order lag.

        For `torque.JOINT` the applied torque lags, for `joints.effort.JOINT` the recorded effort.
        """
        return ca.SX(0)


class _ServoIntegral(Effect):
    """Time integral z of a position servo's error, dz/dt = error. It is zero at the start of a recording."""

    @classmethod
    def of_joint(cls, joint: str) -> _ServoIntegral:
        name = f"servo_integral@{joint}.z"
        return cls("servo_integral", joint, Parameters(()), {name: ca.SX.sym(name)})

    def apply_to_system(self, system: System) -> System:
        servo, [z] = system.servos[self.location], self.internal_coordinate_symbols.values()
        return replace(system, servos={**system.servos, self.location: replace(servo, integral=servo.integral * z)})

    def step_terms(self, state: MidpointStateSymbols) -> EffectStepTerms:
        [name], system = self.internal_coordinate_symbols, state.system
        row, rate = state.internal_rows[name], state.z_rate[state.internal_rows[name]]
        if self.location in system.servos:  # not while the joint is held
            command = state.u[system.driven.index(self.location)]
            angle = state.q[system.mechanism.joint_index(self.location)]
            rate -= system.servos[self.location].position_error_beyond_dead_band(command, angle)
        return EffectStepTerms(internal_equations={name: rate}, static_equations={name: state.z[row]})


class SystemBuildArguments(TypedDict, total=False):
    """The keyword arguments of `System.build`, such as objects, grasps and driven joints."""

    objects: Sequence[tuple[FlexibleObject, str | None, ArrayLike | None]]
    """Each object with its parent frame among the previous parts (None: world) and its pose (4, 4) in this frame."""
    grasps: Sequence[Grasp]
    driven: Sequence[str]
    prescribed: Sequence[str]
    """Names of joints. A joint cannot be both driven and prescribed."""
    damping: float | Mapping[str, float]
    """Viscous damping of the robot's joints [N m s/rad]; becomes the parameters `JOINT.damping`."""
    gravity: ArrayLike
    """Shape (3,) [m/s^2]; default: 9.81 along -z."""
    point_frames: Sequence[str] | None
    """Frames that sensors may measure, or points of a segment such as `T1:40%`; default: the segment tips `w_*`."""
    springs: Mapping[str, servos_and_springs.StiffnessAndRest]
    """Springs by robot joint; they become the parameters `JOINT.stiffness` and `JOINT.rest`."""
    servos: servos_and_springs.ServoModelOptions | None
    """Servos whose commands are the inputs of driven joints; adds `JOINT.servo_gain`, `JOINT.servo_damping`, ..."""


@dataclass(frozen=True, repr=False)
class System(ReprMixin):
    """The model of robot and object: coordinates q (n,) [rad or m], parameters theta (ntheta,), inputs u (nu,)."""

    mechanism: Mechanism
    parameters: Parameters
    """Parameters, in the order of theta."""
    elastic_joints: tuple[ElasticJoint, ...] = ()
    joint_damping: Mapping[str, ca.SX] = field(default_factory=dict)
    """Viscous coefficients by joint, for joints that are not elastic [N m s/rad]."""
    grasps: tuple[Grasp, ...] = ()
    driven: tuple[str, ...] = ()
    """Joints with an input, in the order of u (motor torques or servo commands)."""
    servos: Mapping[str, servos_and_springs.PositionServo] = field(default_factory=dict)
    """Servos by joint: for all driven joints, or empty."""
    prescribed: tuple[str, ...] = ()
    """Joints with a prescribed coordinate, in the order of the prescribed coordinates."""
    gravity: ca.SX = field(default_factory=lambda: ca.SX(ca.DM([0.0, 0.0, -9.81])))
    """Gravity in the world frame, shape (3, 1) [m/s^2]."""
    recorded_time_scale: ca.SX = field(default_factory=lambda: ca.SX(1))
    """Factor on the recorded time step."""
    joint_compliances: Mapping[str, ca.SX] = field(default_factory=dict)
    """Compliances of coordinates held by a spring, by joint [rad/(N m)]; zero means rigid. Their equations and momentum
    are multiplied by them, which keeps these regular at zero."""
    joint_relaxation_times: Mapping[str, float] = field(default_factory=dict)
    """T of some compliant coordinates in q + T dq/dt = compliance x torque [s]. Without mass, a coordinate needs it to
    forget an initial value that does not fit its load."""
    segment_layouts: tuple[SingleSegmentLayout, ...] = ()
    point_frames: tuple[str, ...] = ()
    """Frames that a sensor may measure."""
    effects: tuple[Effect, ...] = ()

    @staticmethod
    def build(
        mechanism: Mechanism | None = None, *, effects: Sequence[Effect] = (), **options: Unpack[SystemBuildArguments]
    ) -> System:
        """Build a system from the robot `mechanism` (None: no robot), effects, and objects and other `options`.

        Raises `ModelError` for unknown or repeated names, no joint, a driven and prescribed joint, or equal grasps.
        """
        gravity = np.asarray(options.get("gravity", (0.0, 0.0, -9.81)), float)
        if gravity.shape != (3,) or not np.all(np.isfinite(gravity)):
            what, hint = f"gravity is {gravity.tolist()}, but must be 3 finite numbers", "pass (0.0, 0.0, -9.81)"
            raise ModelError(what, where="gravity", allowed="x, y, z in the world frame [m/s^2]", hint=hint)
        tree = mechanism if mechanism is not None else Mechanism("system", (), {})
        driven, prescribed = tuple(options.get("driven", ())), tuple(options.get("prescribed", ()))
        damping, servos = options.get("damping", 0.0), options.get("servos")
        wanted = damping if isinstance(damping, Mapping) else dict.fromkeys(tree.joint_names, float(damping))
        damped = {name: tree.joint(name) for name in wanted}  # unknown joints raise `ModelError`
        dampers = {
            n: Parameter(f"{n}.damping", wanted[n], joint.unit("N m s/rad"), 0.0, math.inf, f"damping of {n}")
            for n, joint in damped.items()
        }
        entries, elastic, segments = list(dampers.values()), list[ElasticJoint](), list[SingleSegmentLayout]()
        for joint, spring in options.get("springs", {}).items():
            stiffness, rest = servos_and_springs.stiffness_and_rest_parameters(tree, joint, spring)
            entries += [stiffness, rest]
            elastic.append(ElasticJoint(joint, joint, "bend", "", stiffness.symbol, ca.SX(0), rest.symbol))
        moved, own = ({}, []) if servos is None else servos_and_springs.build_joint_servos(tree, driven, servos)
        if servos is not None and servos.has_gravity_compensation:
            tree = tree.with_gravity_fraction(ca.SX(0))
        for item, frame, placement in options.get("objects", ()):
            tree = tree.with_attached_mechanism(item.mechanism, frame, placement)
            elastic += item.elastic_joints
            segments += item.segment_layouts
        seen, grasps = options.get("point_frames"), tuple(options.get("grasps", ()))
        seen = tuple((name for name in tree.frames if name.startswith("w_")) if seen is None else seen)
        _check_names(tree, grasps, driven, prescribed, seen)
        parameters = tree.parameters.with_added(entries, own)
        known = ({joint: p.symbol for joint, p in dampers.items()}, grasps, driven, moved, prescribed)
        system = System(tree, parameters, tuple(elastic), *known, ca.SX(ca.DM(gravity)), point_frames=seen)
        integrals = [_ServoIntegral.of_joint(name) for name, servo in moved.items() if not servo.integral.is_zero()]
        return replace(system, segment_layouts=tuple(segments)).with_effects([*integrals, *effects])

    def with_effects(self, effects: Sequence[Effect]) -> System:
        """Return a copy with added effects. Their parameters are appended to theta in the given order."""
        system = self
        for effect in effects:
            system = effect.apply_to_system(replace(system, parameters=system.parameters.with_added(effect.parameters)))
            system = replace(system, effects=(*system.effects, effect))
        return system

    def _summary(self) -> ReprTexts:
        kinds = {"driven": len(self.driven), "prescribed": len(self.prescribed)}
        kinds |= {"passive": self.n_coordinates - sum(kinds.values())}
        moved = ", ".join(f"{count} {kind}" for kind, count in kinds.items() if count)
        counts = f"{count_with_noun(self.n_coordinates, 'coordinate')} ({moved})"
        parts = [self.mechanism.name, counts, count_with_noun(self.n_constraints, "constraint")]
        parts += [effect.label for effect in self.effects]
        return ReprTexts(", ".join(parts), self.parameters._summary().table_rows)

    @property
    def n_coordinates(self) -> int:
        """The number n of generalized coordinates."""
        return len(self.mechanism.joints)

    @property
    def n_constraints(self) -> int:
        """The total number m of scalar constraint equations of all grasps."""
        return sum(grasp.n_constraint_equations for grasp in self.grasps)

    @cached_property
    def actuated_coordinate_indices(self) -> tuple[int, ...]:
        """The indices in q of the joints that the inputs u drive, in the order of `driven`."""
        return tuple(self.mechanism.joint_index(name) for name in self.driven)

    @cached_property
    def prescribed_coordinate_indices(self) -> tuple[int, ...]:
        """The indices in q of the joints whose motion is prescribed."""
        return tuple(self.mechanism.joint_index(name) for name in self.prescribed)

    @cached_property
    def unprescribed_coordinate_indices(self) -> tuple[int, ...]:
        """The indices in q of the joints whose motion is not prescribed."""
        return tuple(i for i in range(self.n_coordinates) if i not in self.prescribed_coordinate_indices)

    @cached_property
    def symbols_and_kinematics(self) -> tuple[ca.SX, Kinematics]:
        """The symbols q (n, 1) of a configuration and the kinematics at q, which several functions share."""
        q = ca.SX.sym("q", self.n_coordinates)
        return q, forward_kinematics(self.mechanism, q)

    @property
    def effect_internal_coordinate_symbols(self) -> dict[str, ca.SX]:
        """The symbols of effects' internal coordinates by name, in the order of z. Grasps and placements use them."""
        return {name: symbol for effect in self.effects for name, symbol in effect.internal_coordinate_symbols.items()}

    def find_segment_layout(self, name: str) -> SingleSegmentLayout:
        """Return the layout of a segment. Raises `ModelError`, with the nearest name, if there is no such segment."""
        found = {layout.name: layout for layout in self.segment_layouts}
        require_known_names([name], found, "segment", "segments of the model", ModelError)
        return found[name]

    def map_expressions(self, change: Callable[[ca.SX], ca.SX]) -> System:
        """Apply `change` to every symbolic expression of the system except those of its effects."""
        mapped: System = map_expressions(replace(self, effects=()), change)
        return replace(mapped, effects=self.effects)

    def mechanism_with_values(self, values: Mapping[str, float] | None = None) -> Mechanism:
        """Return the mechanism with a number for each parameter: its entry in `values`, or else its nominal value."""
        key, last = tuple(self.parameters.vector(values).tolist()), self._last_numeric_mechanism
        if key not in last:
            last.clear()
            last[key] = replace(self.mechanism, parameters=self.parameters).with_numeric_values(values)
        return last[key]

    @cached_property
    def _last_numeric_mechanism(self) -> dict[tuple[float, ...], Mechanism]:
        """A cache of the last numeric mechanism, by its parameter values, which are often requested several times."""
        return {}

    def elastic_energy(self, q: ca.SX) -> ca.SX:
        """Return the elastic energy of all elastic joints [J], the sum of 1/2 stiffness (q - rest)^2."""
        index = self.mechanism.joint_index
        terms = (0.5 * s.stiffness * (q[index(s.joint_name)] - s.rest_angle) ** 2 for s in self.elastic_joints)
        return sum(terms, ca.SX(0))

    def viscous_force(self, v: ca.SX) -> ca.SX:
        """Return the generalized force of all viscous dampers at velocity v, shape (n, 1) [N m]."""
        force, index = [ca.SX(0)] * self.n_coordinates, self.mechanism.joint_index
        dampers = [(spring.joint_name, spring.damping) for spring in self.elastic_joints]
        for joint, coefficient in (*dampers, *self.joint_damping.items()):
            force[index(joint)] = force[index(joint)] - coefficient * v[index(joint)]
        return ca.vertcat(*force)

    def input_force(self, u: ca.SX, q: ca.SX, v: ca.SX) -> ca.SX:
        """Return the generalized force (n, 1) [N m] of motor torques or servo commands u, at position q and rate v."""
        force = [ca.SX(0)] * self.n_coordinates
        for row, (joint, index) in enumerate(zip(self.driven, self.actuated_coordinate_indices, strict=True)):
            servo = self.servos.get(joint)
            force[index] = u[row] if servo is None else servo.torque(u[row], q[index], v[index])
        return ca.vertcat(*force)

    def gravity_and_grasp_force_on_coordinate(self, state: MidpointStateSymbols, index: int) -> ca.SX:
        """Return the force [N m or N] that grasps and the weight of moved bodies exert on coordinate `index`."""
        kinematics, tree = state.kinematics, self.mechanism
        screw, force = kinematics.joint_screws[index], ca.SX(0)
        for j, joint in enumerate(tree.joints):
            for body in joint.bodies if index in tree.ancestor_joint_indices(j) else ():
                com = kinematics.joint_rotations[j] @ body.center_of_mass + kinematics.joint_origins[j]
                heavy = body.mass * body.gravity_fraction
                force += heavy * ca.dot(ca.vertcat(ca.cross(com, self.gravity), self.gravity), screw)
        if self.n_constraints:
            force -= ca.dot(ca.jacobian(self.constraint_residual(kinematics), state.q[index]), state.constraint_force)
        return force

    def friction_load_of_gear(self, state: MidpointStateSymbols, index: int) -> ca.SX:
        """Return the torque [N m or N] through the gear of a driven joint: input minus forces of weight and grasps."""
        outside = self.gravity_and_grasp_force_on_coordinate(state, index)
        return self.input_force(state.u, state.q, state.v)[index] - outside

    def constraint_residual(self, kinematics: Kinematics) -> ca.SX:
        """Return the constraint residual phi(q) of all grasps, shape (m, 1)."""
        return ca.vertcat(ca.SX(0, 1), *(grasp.constraint_residual(kinematics) for grasp in self.grasps))


def _check_names(
    tree: Mechanism, grasps: Sequence[Grasp], driven: Sequence[str], prescribed: Sequence[str], points: Sequence[str]
) -> None:
    """Raise `ModelError` for a wrong or repeated name, for a tree without joints, and for two equal grasps."""
    if not tree.joints:
        what, hint = "the model has no joint", "set model.robot (with movable joints), model.object, or both"
        raise ModelError(what, where=f"model '{tree.name}'", allowed="one joint or more", hint=hint)
    for joint in [*driven, *prescribed]:
        tree.joint_index(joint)
    named = {"driven joints": driven, "prescribed joints": prescribed, "grasps": [grasp.name for grasp in grasps]}
    for kind, names in named.items():
        if repeated := sorted({name for name in names if names.count(name) > 1}):
            what, allowed = f"'{repeated[0]}' is listed twice among the {kind}", "each name once"
            raise ModelError(what, where=kind, allowed=allowed, hint=f"delete one '{repeated[0]}' from the list")
    if both := sorted(set(driven) & set(prescribed)):
        what, hint = f"joint '{both[0]}' is both driven and prescribed", f"leave '{both[0]}' out of one of the lists"
        raise ModelError(what, where="driven and prescribed joints", allowed="one of the two", hint=hint)
    for grasp, key in product(grasps, ("holder_frame", "held_frame")):
        tree.frame(getattr(grasp, key), f"model.grasp.{grasp.name}.{key}")
    for point in points:
        tree.frame(point, "model.measured_points")
    for one, two in combinations([grasp for grasp in grasps if grasp.compliance.is_zero()], 2):
        if {one.holder_frame, one.held_frame} == {two.holder_frame, two.held_frame}:
            frames = f"the same two frames, {two.holder_frame} and {two.held_frame}"
            what, hint = f"the grasps '{one.name}' and '{two.name}' constrain {frames}", f"remove '{two.name}'"
            raise ModelError(what, where="grasps", allowed="one rigid grasp for two frames", hint=hint)


def six_joint_floating_mechanism(name: str) -> Mechanism:
    """Build a massless mechanism of six joints `NAME_x` to `NAME_rz` that move a frame `NAME`."""
    kinds: tuple[tuple[str, Literal["revolute", "prismatic"]], ...] = (("", "prismatic"), ("r", "revolute"))
    joints = tuple(
        Joint(f"{name}_{prefix}{letter}", kind, 3 * block + a - 1, Placement.identity(), axis)
        for block, (prefix, kind) in enumerate(kinds)
        for a, (letter, axis) in enumerate(AXIS_UNIT_VECTORS.items())
    )
    return Mechanism(name, joints, {name: Frame(5, Placement.identity())})

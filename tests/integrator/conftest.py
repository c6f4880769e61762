"""Small systems that together use every feature of a step, and effects that bring these features in."""

import ctypes
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from yid_ocp.errors import InsufficientMemoryError
from yid_ocp.integrator.step import Step, compile_step, compile_step_like
from yid_ocp.integrator.step_model import NewtonStatusCode, RolloutInputs, TrackingFeedback
from yid_ocp.model import (
    FlexibleSegment,
    Grasp,
    Mechanism,
    Parameter,
    Parameters,
    System,
    flexible_object,
    forward_kinematics,
)
from yid_ocp.model.kinematics import Kinematics, motion_cross_force_product, motion_cross_motion_product
from yid_ocp.model.mechanism import Placement
from yid_ocp.model.system import Effect, EffectStepTerms, ForceWithFactoredDerivatives, six_joint_floating_mechanism
from yid_ocp.model.urdf import read_urdf


@dataclass(frozen=True)
class Added(Effect):
    """An effect made of functions."""

    change: Callable = lambda effect, system: system
    add: Callable = lambda effect, state: EffectStepTerms()

    def apply_to_system(self, system):
        return self.change(self, system)

    def step_terms(self, state):
        return self.add(self, state)


def _parameters(kind, location, **values):
    return Parameters(Parameter(f"{kind}@{location}.{name}", value, "SI") for name, value in values.items())


def maxwell_branch(joint: str, stiffness: float, relaxation_time: float) -> Added:
    """V += 1/2 k1 (q - z)^2 with (q - z) = relaxation_time dz/dt."""
    parameters = _parameters("maxwell", joint, k1=stiffness, tau=relaxation_time)
    name = f"maxwell@{joint}.z"

    def add(effect, state):
        k1, tau = effect.parameters.symbols[0], effect.parameters.symbols[1]
        row = state.internal_rows[name]
        stretch = state.q[state.system.mechanism.joint_index(joint)] - state.z[row]
        equation = stretch - tau * state.z_rate[row]
        return EffectStepTerms(lagrangian=-0.5 * k1 * stretch**2, internal_equations={name: equation})

    return Added("maxwell", joint, parameters, {name: ca.SX.sym(name)}, add=add)


def soft_joint(joint: str, compliance: float) -> Added:
    """The joint's spring replaced by a compliance."""
    parameters = _parameters("soft", joint, compliance=compliance)

    def change(effect, system):
        elastic = tuple(spring for spring in system.elastic_joints if spring.joint_name != joint)
        compliant = {**system.joint_compliances, joint: effect.parameters.symbols[0]}
        return replace(system, elastic_joints=elastic, joint_compliances=compliant)

    return Added("soft", joint, parameters, change=change)


def soft_grasp(grasp: str, compliance: float, relaxation: float | None = None) -> Added:
    """phi(q_{k+1}) + T (phi(q_{k+1}) - phi(q_k)) / h = C lam / h."""
    values = {"compliance": compliance} | ({} if relaxation is None else {"relaxation": relaxation})
    parameters = _parameters("soft_grasp", grasp, **values)

    def change(effect, system):
        names = ("compliance", "relaxation_time")
        values = {name: p.symbol for name, p in zip(names, effect.parameters, strict=False)}
        return changed_grasp(system, grasp, **values)

    return Added("soft_grasp", grasp, parameters, change=change)


def changed_grasp(system, name, **values):
    return replace(system, grasps=tuple(replace(g, **values) if g.name == name else g for g in system.grasps))


def changed_joint(system, name, **values):
    joints = list(system.mechanism.joints)
    index = system.mechanism.joint_index(name)
    joints[index] = replace(joints[index], **values)
    return replace(system, mechanism=replace(system.mechanism, joints=tuple(joints)))


def creeping_grasp(grasp: str, rate: float) -> Added:
    """The grasped point creeps along the object: dz/dt = rate x axial load."""
    parameters = _parameters("creep", grasp, rate=rate)
    name = f"creep@{grasp}.z"
    internal = {name: ca.SX.sym(name)}

    def change(effect, system):
        return changed_grasp(system, grasp, axial_slip=effect.internal_coordinate_symbols[name])

    def add(effect, state):
        held = next(g.held_frame for g in state.system.grasps if g.name == grasp)
        load = ca.dot(state.kinematics.frame_pose(held).rotation[:, 2], state.constraint_force[:3])
        row, rate = state.internal_rows[name], effect.parameters.symbols[0]
        # where it has long stood, as far as the load would have it creep in a second
        at_rest = {name: state.z[row] - rate * load}
        return EffectStepTerms(internal_equations={name: state.z_rate[row] - rate * load}, static_equations=at_rest)

    return Added("creep", grasp, parameters, internal, change, add)


def growing_link(joint: str, length: float, time: float) -> Added:
    """The joint's placement moves along its x axis by z, which tends to `length`."""
    parameters = _parameters("growth", joint, length=length, time=time)
    name = f"growth@{joint}.z"
    internal = {name: ca.SX.sym(name)}

    def change(effect, system):
        placement = system.mechanism.joint(joint).placement
        shift = Placement(ca.SX(ca.DM.eye(3)), ca.vertcat(effect.internal_coordinate_symbols[name], 0, 0))
        return changed_joint(system, joint, placement=placement @ shift)

    def add(effect, state):
        target, tau = effect.parameters.symbols[0], effect.parameters.symbols[1]
        row = state.internal_rows[name]
        return EffectStepTerms(internal_equations={name: target - state.z[row] - tau * state.z_rate[row]})

    return Added("growth", joint, parameters, internal, change, add)


def thick_air(joint: str, coefficient: float, viscosity: float, buoyancy: float) -> Added:
    """A cubic drag on one link with given slopes, a viscous drag, and this link weighs less than its mass."""
    parameters = _parameters("air", joint, coefficient=coefficient, viscosity=viscosity, buoyancy=buoyancy)

    def change(effect, system):
        bodies = system.mechanism.joint(joint).bodies
        lighter = tuple(replace(body, gravity_fraction=1 - effect.parameters.symbols[2]) for body in bodies)
        return changed_joint(system, joint, bodies=lighter)

    def add(effect, state):
        c, b, v = effect.parameters.symbols[0], effect.parameters.symbols[1], state.v
        tree, kinematics = state.system.mechanism, state.kinematics
        chain, screws = tree.ancestor_joint_indices(tree.joint_index(joint)), kinematics.joint_screws
        along = {-1: ca.SX(ca.DM.zeros(6))}
        for j in chain:
            along[j] = along[tree.joints[j].parent_index] + screws[j] * v[j]
        link = chain[-1]
        own = kinematics.joint_rotations[link] @ tree.joints[link].bodies[0].center_of_mass
        reach = ca.horzcat(-ca.skew(own + kinematics.joint_origins[link]), ca.SX.eye(3))
        speed = reach @ along[link]
        wrench = reach.T @ (-c * ca.sumsqr(speed) * speed)
        slope = reach.T @ (-c * (ca.sumsqr(speed) * ca.SX.eye(3) + 2 * speed @ speed.T)) @ reach
        force, by_rate, by_turn = ca.SX(len(screws), 1), ca.SX(6, len(screws)), ca.SX(6, len(screws))
        for j in chain:
            added = motion_cross_motion_product(along[tree.joints[j].parent_index], screws[j])
            force[j] = ca.dot(screws[j], wrench)
            by_rate[:, j] = slope @ screws[j]
            by_turn[:, j] = slope @ added + motion_cross_force_product(screws[j], wrench)
        closed = ForceWithFactoredDerivatives(force, by_rate, by_turn)
        return EffectStepTerms(dissipative_force=-b * v, force_with_derivatives=closed)

    return Added("air", joint, parameters, change=change, add=add)


def cable_object(**changes):
    """Three links, nine coordinates."""
    options = {"mass": 0.3, "radius": 0.05, "links": 3, "bend": 2.0, "twist": 1.0, "damping": 0.01, **changes}
    return flexible_object([FlexibleSegment("C", 0.6, **options)], name="cable")


def cable(**options) -> System:
    """The cable, standing on the ground."""
    return System.build(objects=[(cable_object(), None, None)], **options)


def tip(mechanism: Mechanism, frame: str, q: np.ndarray) -> np.ndarray:
    """4x4 pose of a frame at nominal parameters."""
    kinematics: Kinematics = forward_kinematics(mechanism.with_numeric_values(), ca.SX(ca.DM(q)))
    return np.array(ca.DM(kinematics.frame_pose(frame).homogeneous_matrix()))


def clamped_cable(kind: str, effects=()) -> tuple[System, np.ndarray]:
    """The cable, bent, its end held by a clamp whose six coordinates are prescribed; with its configuration."""
    bent = np.array([0.3, -0.2, 0.1, 0.4, 0.2, -0.1, 0.2, 0.3, 0.15])
    pose = tip(cable().mechanism, "w_C", bent)
    clamp = six_joint_floating_mechanism("clamp")
    grasp = Grasp("clamp", "clamp", "w_C", kind, held_orientation=ca.SX(ca.DM(pose[:3, :3])))
    objects = [(cable_object(), None, None)]
    system = System.build(
        clamp, objects=objects, grasps=[grasp], prescribed=clamp.joint_names, driven=["C_1_x", "C_2_z"], effects=effects
    )
    return system, np.concatenate([pose[:3, 3], np.zeros(3), bent])


def soft_clamp(relaxation: float | None = None) -> tuple[System, np.ndarray]:
    return clamped_cable("point", [creeping_grasp("clamp", 0.05), soft_grasp("clamp", 1e-4, relaxation)])


@dataclass(frozen=True)
class Case:
    """A step with a motion over a few steps."""

    step: Step
    theta: np.ndarray
    start: np.ndarray
    torque: np.ndarray
    path: np.ndarray
    feedback: TrackingFeedback

    @cached_property
    def interpreted_step(self) -> Step:
        return compile_step_like(self.step, self.step.system, use_compiler=False)

    def rollout(self, theta=None, start=None, torque=None, path=None, feedback=None, directions=None, step=None):
        chosen = [self.theta, self.start, self.torque, self.path]
        given = [theta, start, torque, path]
        values = [old if new is None else new for old, new in zip(chosen, given, strict=True)]
        return (step or self.step).kernel.rollout(RolloutInputs(*values, feedback, directions))


def make_case(
    system: System, q: np.ndarray, time_step=2e-3, steps=10, rule=("symmetric", "midpoint"), strength=1.0
) -> Case:
    # finite differences magnify what Newton leaves undone
    step = compile_step(system, time_step, *rule, tolerance=1e-14)
    sizes = step.sizes
    rng = np.random.default_rng(5)
    theta = system.parameters.vector()
    start = np.concatenate([q, np.zeros(sizes["n"]), 0.01 * rng.normal(size=sizes["nz"])])
    torque = strength * rng.normal(size=(steps, sizes["nu"]))
    time = np.arange(steps + 1)[:, None] * time_step
    speed = 0.1 * rng.normal(size=sizes["nc"])
    path = q[list(system.prescribed_coordinate_indices)] + speed * time + 4.0 * rng.normal(size=sizes["nc"]) * time**2
    index = rng.choice(sizes["nx"], size=5, replace=False).astype(np.int32)
    gain = strength * rng.normal(size=(steps, sizes["nu"], 5))
    feedback = TrackingFeedback(index, gain, start[index] + 0.01 * rng.normal(size=(steps, 5)))
    return Case(step, theta, start, torque, path, feedback)


def closed_loop(urdf_folder, effects=()) -> tuple[System, np.ndarray]:
    """mixed_joints with its two branches joined at a point: two joints driven, one prescribed."""
    robot = read_urdf(urdf_folder / "mixed_joints.urdf")
    q = np.zeros(len(robot.joints))
    for name, value in {"slide": 0.1, "spin": 0.4, "hinge": -0.5, "extend": 0.15, "swing": 0.3, "nod": 0.7}.items():
        q[robot.joint_index(name)] = value
    holder, held = tip(robot, "tool", q), tip(robot, "nose", q)
    grasp = Grasp("loop", "tool", "nose", holder_offset=ca.SX(ca.DM(np.linalg.solve(holder, held)[:3, 3])))
    driven, prescribed = ["spin", "extend"], ["swing"]
    system = System.build(robot, grasps=[grasp], driven=driven, prescribed=prescribed, damping=0.3, effects=effects)
    return system, q


BUILDERS = {
    "closed_loop": lambda f: make_case(*closed_loop(f)),
    "closed_loop_left": lambda f: make_case(*closed_loop(f), rule=("left", "node")),
    "welded_cable": lambda f: make_case(*clamped_cable("weld"), strength=0.05),
    "aligned_cable": lambda f: make_case(*clamped_cable("axis"), strength=0.05),
    "creeping_cable": lambda f: make_case(*soft_clamp(), time_step=5e-4, strength=0.05, rule=("symmetric", "node")),
    "relaxing_cable": lambda f: make_case(*soft_clamp(2e-3), time_step=5e-4, strength=0.05, rule=("left", "midpoint")),
    "thick_air": lambda f: make_case(*closed_loop(f, [thick_air("nod", 0.05, 0.2, 0.4)]), rule=("left", "node")),
    "thick_air_symmetric": lambda f: make_case(*closed_loop(f, [thick_air("slide", 0.05, 0.2, -0.4)])),
    "soft_cable": lambda f: make_case(
        cable(
            driven=["C_2_x", "C_1_z"],
            effects=[maxwell_branch("C_0_x", 3.0, 0.02), soft_joint("C_1_y", 0.2), soft_joint("C_1_z", 0.0)],
        ),
        np.array([0.2, -0.1, 0.1, 0.15, 0.1, 0.0, 0.1, -0.2, 0.05]),
        strength=0.05,
    ),
    "growing": lambda f: make_case(
        System.build(
            read_urdf(f / "mixed_joints.urdf"),
            driven=["spin", "nod"],
            damping=0.2,
            effects=[growing_link("nod", 0.1, 0.01), growing_link("hinge", -0.2, 0.02)],
        ),
        np.array([0.1, 0.4, -0.5, 0.15, 0.3, 0.7]),
    ),
}


@pytest.fixture(scope="session", params=list(BUILDERS))
def case(request, urdf_folder) -> Case:
    return BUILDERS[request.param](urdf_folder)


def close(actual, expected, tolerance):
    scale = max(1.0, np.max(np.abs(expected), initial=0.0))
    assert actual.shape == expected.shape
    assert np.all(np.isfinite(actual))
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance * scale)


def assert_kernels_agree(steps, inputs, conditioning=1.0, tolerance=1e-10):
    """Two steps: rollouts with derivatives, and the gradients of a cost of all that they give."""
    one, two = (step.kernel.rollout(inputs) for step in steps)
    assert one.status.code == two.status.code == NewtonStatusCode.OK
    close(one.state, two.state, tolerance)
    for key in ("multipliers", "effort", "torque"):
        close(getattr(one, key), getattr(two, key), tolerance * conditioning)
    for key in ("state_sensitivity", "multipliers_sensitivity", "effort_sensitivity"):
        close(getattr(one, key), getattr(two, key), 1e-9 * conditioning)
    for key in ("internal_coordinates", "prescribed_effort"):
        close(getattr(one.status, key), getattr(two.status, key), 1e-9 * conditioning)
    rng, names = np.random.default_rng(2), inputs.directions.parameter_names
    cost = [rng.normal(size=values.shape) for values in (one.state, one.multipliers, one.effort)]
    back = [step.kernel.adjoint_gradient(inputs.theta, one, inputs.feedback, names, cost) for step in steps]
    for key in vars(back[0]):
        close(getattr(back[0], key), getattr(back[1], key), 1e-9 * conditioning)


@pytest.fixture(scope="session")
def parts():
    """The builders above, for tests that need a system of their own."""
    own = (Added, maxwell_branch, soft_joint, soft_grasp, thick_air, creeping_grasp, cable, cable_object, clamped_cable)
    made = {function.__name__: function for function in (*own, closed_loop, make_case, tip, assert_kernels_agree)}
    return SimpleNamespace(**made, builders=BUILDERS)


# An allocator that gives out `yid_grants` pieces of memory and then none, and counts those that were not given back.
POOR = """
#include <stdlib.h>
long yid_grants = 0, yid_held = 0;
static void *poor_allocate(size_t count, size_t size) {
    if (yid_grants <= 0) return NULL;
    yid_grants--;
    yid_held++;
    return calloc(count, size);
}
static void poor_free(void *memory) {
    if (memory) yid_held--;
    free(memory);
}
#define YID_ALLOCATE poor_allocate
#define YID_FREE poor_free
"""


class Poor:
    """That allocator, in the library that is watched."""

    source = POOR

    def watch(self, library):
        self.grants, self.held = (ctypes.c_long.in_dll(library, name) for name in ("yid_grants", "yid_held"))

    def grants_needed(self, action) -> int:
        """How many pieces an action asks for; every smaller number must end in an error and leave nothing behind."""
        messages = []
        for grants in range(20):
            self.grants.value = grants
            try:
                action()
            except InsufficientMemoryError as error:
                messages.append(str(error))
            else:
                assert all("not enough memory: " in m and " MB" in m and "fewer parameters" in m for m in messages)
                return grants
            finally:
                assert self.held.value == 0
        raise AssertionError("never enough")


@pytest.fixture
def poor() -> Poor:
    """An allocator that runs out of memory."""
    return Poor()

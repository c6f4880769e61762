"""A small robot with a small Y, driven or prescribed, and what every test of effects does with it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from yid_ocp.data.channel_checks import typical_point_pair_distances
from yid_ocp.data.recording import PointGroup, Recording
from yid_ocp.effects import EffectBase, candidate_kinds_and_locations, make_effect
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import Step, compile_step, simulate
from yid_ocp.integrator.step_model import Rollout, SensitivityDirections
from yid_ocp.model import FlexibleSegment, Grasp, Mechanism, System, flexible_object, forward_kinematics
from yid_ocp.model.mechanism import Frame, Inertia, Joint, Placement, homogeneous_transform, rotation_from_rpy
from yid_ocp.model.objects.base import CableVertices
from yid_ocp.model.objects.cable import CableOptions, clamped_cable_system
from yid_ocp.sensors import PointSensor, PrescribedJointEffortSensor, Sensor, sensor_function_with_jacobians

POSTURE = np.array([0.3, 0.8, 0.9])
H = 0.01
POSE = ((0.0, 0.0, -1.0, 2.0), (1.0, 0.0, 0.0, 0.3), (0.0, -1.0, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0))


def arm() -> Mechanism:
    """Three joints, 0.3 m links of 1 kg, each turned from the one before."""
    along = Placement.from_matrix(homogeneous_transform(np.eye(3), [0.0, 0.0, 0.3]))
    axes = ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0))
    body = Inertia.from_values(1.0, [0.01, 0.02, 0.15], np.diag([8e-3, 7e-3, 2e-3]))
    places = (Placement.identity(), along, along)
    joints = (Joint(f"left_{n}", "revolute", i - 1, places[i], axes[i], (body,)) for i, n in enumerate("abc"))
    return Mechanism("arm", tuple(joints), {"left_gripper": Frame(2, along)})


def small_y(foot: np.ndarray):
    """Three segments of one link each."""
    turn = [rotation_from_rpy(lean, 0.2, 0.0) for lean in (-0.8, 0.8)]
    segments = (
        FlexibleSegment("T1", 0.4, 0.08, 0.03, 1, damping=0.02),
        FlexibleSegment("T2", 0.25, 0.04, 0.02, 1, parent="T1", rest_rotation=turn[0], damping=0.02),
        FlexibleSegment("T3", 0.3, 0.05, 0.02, 1, parent="T1", rest_rotation=turn[1], damping=0.02),
    )
    return flexible_object(segments, foot)


def position(mechanism: Mechanism, frame: str, q: np.ndarray) -> np.ndarray:
    """Origin of a frame at nominal parameters."""
    kinematics = forward_kinematics(mechanism.with_numeric_values(), ca.SX(ca.DM(q)))
    return np.array(ca.DM(kinematics.frame_position(frame))).ravel()


def build(prescribed: bool = False) -> System:
    """The arm at `POSTURE` holding the tip of T2 of the undeformed object, 2 cm beside it."""
    robot, item = arm(), small_y(np.eye(4))
    gap = position(robot, "left_gripper", POSTURE) - position(item.mechanism, "w_T2", np.zeros(9))
    foot = homogeneous_transform(np.eye(3), gap + np.array([0.01, -0.02, -0.015]))
    moved = {"prescribed" if prescribed else "driven": robot.joint_names}
    objects, grasps = [(small_y(foot), None, None)], [Grasp("left", "left_gripper", "w_T2")]
    return System.build(robot, objects=objects, grasps=grasps, damping=0.05, **moved)


@dataclass(frozen=True)
class Run:
    """A rollout from rest under the bench's motion."""

    step: Step
    theta: np.ndarray
    start: np.ndarray
    rollout: Rollout


class Bench:
    """A system's short, lively rollouts by the interpreter."""

    posture, pose = POSTURE, POSE

    def __init__(self, system: System, steps: int = 8) -> None:
        self.system = system
        self.steps = steps
        self.plain = compile_step(system, H, use_compiler=False)
        self.rest = EquilibriumSolver(self.plain).solve(POSTURE, system.parameters.vector())
        assert self.rest.is_converged, self.rest.message
        t = H * np.arange(steps + 1)[:, None]
        size = np.array([1.0, -2.0, 0.7][: len(system.driven)])
        self.torque = self.rest.holding_torque + size * np.sin(30 * t[:-1] + 1)
        self.path = POSTURE + 0.03 * np.sin(25 * t + np.arange(3)) - 0.03 * np.sin(np.arange(3))
        self.path = self.path[:, : len(system.prescribed)]
        self.kick = 1e-3 * np.random.default_rng(3).normal(size=system.n_coordinates)

    def step(self, *effects: EffectBase) -> Step:
        return compile_step(self.system.with_effects(effects), H, use_compiler=False)

    def start(self, step: Step) -> np.ndarray:
        """The nominal rest in a system that may have more coordinates, internal ones relaxed at zero stretch."""
        names, sizes = step.system.mechanism.joint_names, step.sizes
        at = [names.index(name) for name in self.system.mechanism.joint_names]
        state, n = np.zeros(sizes["nx"]), sizes["n"]
        state[at] = self.rest.state[: len(at)]
        state[[n + i for i in at]] = self.rest.state[len(at) : 2 * len(at)] + self.kick
        for row, name in enumerate(step.system.effect_internal_coordinate_symbols):
            joint = name.rpartition(".")[2]
            if joint in names and not name.startswith("hysteresis"):
                state[2 * n + row] = state[names.index(joint)]
        return state

    def run(self, step: Step, values: Mapping[str, float] | None = None, names=(), start=None, steps=None) -> Run:
        theta = step.system.parameters.vector(values)
        begin = self.start(step) if start is None else start
        directions = SensitivityDirections(tuple(names), np.zeros((len(begin), len(names)))) if names else None
        count = steps or self.steps
        inputs = self.torque[:count], self.path[: count + 1]
        return Run(step, theta, begin, simulate(step, theta, begin, count, *inputs, directions=directions))

    def nominal_part(self, run: Run) -> np.ndarray:
        """Coordinates and momenta of the joints that the nominal model has."""
        names, n = run.step.system.mechanism.joint_names, run.step.sizes["n"]
        at = [names.index(name) for name in self.system.mechanism.joint_names]
        return np.hstack([run.rollout.state[:, at], run.rollout.state[:, [n + i for i in at]]])

    def reading(self, run: Run, sensor: Sensor) -> np.ndarray:
        """What a sensor reads at every node but the last."""
        n, rollout, system = run.step.sizes["n"], run.rollout, run.step.system
        function = sensor_function_with_jacobians(system, sensor, ())
        effort = np.zeros((len(rollout.state) - 1, n))
        effort[:, list(system.prescribed_coordinate_indices)] = rollout.effort
        effort[:, list(system.actuated_coordinate_indices)] = rollout.torque
        rows = zip(rollout.state[:-1], effort, strict=True)
        return np.array([np.array(function(q=x[:n], z=x[2 * n :], load=e, theta=run.theta)["y"]) for x, e in rows])


PARENT = tuple(f"p{i}" for i in range(7))


def made_cable() -> tuple[CableVertices, Recording]:
    """A cable of six edges with a branch of two, and a recording in which its clamps sway."""
    where = {name: [0.1 * i, 0.0, 1.0] for i, name in enumerate(PARENT)}
    where |= {"c1": [0.3, 0.1, 1.0], "c2": [0.3, 0.2, 1.0]}
    layout = CableVertices(PARENT, {"a": ("p3", "c1", "c2")}, where)
    t = H * np.arange(9)
    points = np.tile(np.array([where[name] for name in layout.vertex_names]), (len(t), 1, 1))
    points[:, :, 2] -= 0.02 * np.sin(np.pi * points[0, :, 0] / 0.6)
    points[:, -4:, 1] += 0.01 * np.sin(9 * t)[:, None]
    group = PointGroup("points", layout.vertex_names, t, points, np.array(0.01), "motion capture", clock="nominal")
    return layout, Recording(points=(group,), name="sway")


CAMERA = PointSensor("points_camera", ("w_T1", "w_T3"), ("w_T1", "w_T3"), POSE)


@pytest.fixture(scope="session")
def driven() -> Bench:
    return Bench(build())


@pytest.fixture(scope="session")
def prescribed() -> Bench:
    return Bench(build(prescribed=True))


@pytest.fixture(scope="session")
def cable() -> tuple[CableVertices, Recording, System]:
    layout, recording = made_cable()
    lengths = typical_point_pair_distances(layout.edge_vertex_names, [recording])
    return layout, recording, clamped_cable_system(lengths, layout, CableOptions())


@pytest.fixture(scope="session")
def all_effects() -> Callable[[System], list[EffectBase]]:
    """Every kind at the last of the places where it can be in a system."""

    def every(system: System) -> list[EffectBase]:
        recorded = ("joints.position", "joints.effort", "camera", "nominal_clock")
        places = dict(candidate_kinds_and_locations(system, recorded))
        return [make_effect(kind, place, system) for kind, place in places.items()]

    return every


@pytest.fixture(scope="session")
def sensors() -> SimpleNamespace:
    arm = PointSensor("points_arm", ("w_T2",), ("w_T2",))
    effort = PrescribedJointEffortSensor(("left_a", "left_b", "left_c"))
    return SimpleNamespace(camera=CAMERA, arm=arm, effort=effort)

"""Small experiments to be judged, and the paper's four as the golden trajectories have them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from made_recordings import chain_of_motors, twin_recording

from yid_ocp.data import Recording
from yid_ocp.data.recording import JointGroup, PointGroup
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import FlexibleSegment, Grasp, System, flexible_object
from yid_ocp.model.servos_and_springs import StiffnessAndRest
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.workflow.build_problem import load_problem

STIFFNESSES = ("T1.bend", "T1.twist", "T2.bend", "T2.twist", "T3.bend", "T3.twist")
PENDULUM = {"elbow.stiffness": 4.0, "elbow.damping": 0.15, "elbow.rest": 0.3}


@pytest.fixture(scope="session")
def golden_problem(request, golden, paper_systems):
    """golden_problem("single", vision): arm points 1 mm at 100 Hz, vision 5 mm at every 33rd step, start known."""

    def build(name: str, vision: bool) -> EstimationProblem:
        trep, system = golden(name), paper_systems[name]
        count = len(system.driven)
        t = 0.01 * np.arange(len(trep.q))
        joints = JointGroup(
            system.driven, t, trep.q[:, :count], effort=np.vstack([trep.u, trep.u[-1:]]), effort_kind="command"
        )
        held = [1] if name == "single" else [1, 2]
        free = [i for i in range(3) if i not in held]
        groups = [PointGroup("points_arm", [f"w_T{i + 1}" for i in held], t[1:], trep.w[:, held], 1e-3, "arm")]
        if vision:
            at = np.arange(33, len(t), 33)
            names, seen = [f"w_T{i + 1}" for i in free], trep.w[at - 1][:, free]
            groups.append(PointGroup("points_camera", names, t[at], seen, 5e-3, "camera", camera_pose=np.eye(4)))
        start = np.concatenate([trep.q[0], trep.p[0]])
        options = ProblemOptions(
            arm_tracking_feedback="proportional", known_initial_states={"golden": start}, path_cutoff=math.inf
        )
        values = dict(zip(STIFFNESSES, map(float, trep.rho), strict=True))
        recording = Recording(joints, tuple(groups), name="golden")
        return EstimationProblem(request.getfixturevalue(f"{name}_step"), [recording], STIFFNESSES, options, values)

    return build


@pytest.fixture(scope="session")
def springs(repository):
    """springs(name, *settings): problem of a spring example."""

    def build(name: str, *settings: str) -> EstimationProblem:
        return load_problem(repository / "configs" / f"springs_{name}.yaml", settings)

    return build


@pytest.fixture(scope="session")
def twin():
    """twin(problem, x, seed): the problem's recording as the model itself would measure it, with the sensors' noise."""

    return twin_recording


@pytest.fixture(scope="session")
def pendulum(robot):
    """pendulum(recording=None): a shoulder moved as measured, a springy elbow, the tip seen to 2 mm at 25 Hz."""
    system = System.build(
        robot, prescribed=["shoulder"], springs={"elbow": StiffnessAndRest(3.0, 0.0)}, damping=0.1, point_frames=["tip"]
    )
    step = compile_step(system, 0.01)
    t = 0.01 * np.arange(201)
    path = 0.6 * np.sin(2 * np.pi * 0.7 * t) * np.sin(np.pi * t / 2) ** 2
    camera = PointGroup("points_camera", ["tip"], t[::4], np.zeros((51, 1, 3)), 2e-3, "camera", camera_pose=np.eye(4))
    empty = Recording(JointGroup(["shoulder"], t, path[:, None], position_std=0.0), (camera,), name="twin")

    def build(recording: Recording | None = None, values: dict[str, float] | None = None) -> EstimationProblem:
        options = ProblemOptions(path_cutoff=math.inf)
        return EstimationProblem(step, [recording or empty], tuple(PENDULUM), options, values or PENDULUM)

    return build


@pytest.fixture(scope="session")
def held_tube(tmp_path_factory):
    """A standing tube of three links. A hand of three motors moves and measures its tip, a camera sees its middle."""
    motors = {"x": ("prismatic", "1 0 0"), "z": ("prismatic", "0 0 1"), "turn": ("continuous", "0 0 1")}
    robot = chain_of_motors(tmp_path_factory.mktemp("hand"), **motors)
    tube = flexible_object([FlexibleSegment("T1", 0.6, 0.1, 0.02, links=3, bend=4.0, twist=3.0)])
    # a hand without a y motor meets the tip all the same: the tube bends in one plane
    grasps = [Grasp("hand", "hand", "w_T1", "point")]
    names = ["x", "z", "turn"]
    system = System.build(robot, objects=[(tube, None, None)], grasps=grasps, prescribed=names, damping=0.05)
    step = compile_step(system, 0.02, use_compiler=False)
    t = 0.02 * np.arange(101)
    ramp = np.sin(np.pi * t / 4) ** 2
    path = np.stack([0.15 * ramp, 0.58 - 0.06 * ramp, 0.8 * np.sin(np.pi * t / 2) * ramp], axis=1)
    how = {"sensor_name": "camera", "camera_pose": np.eye(4)}
    camera = PointGroup("points_camera", ["T1_0_tip"], t[::5], np.zeros((21, 1, 3)), 2e-3, **how)
    recording = Recording(JointGroup(names, t, path, position_std=0.0), (camera,), name="tube")
    options = ProblemOptions(path_cutoff=math.inf, initial_state="equilibrium")
    return EstimationProblem(step, [recording], ("T1.bend", "T1.twist"), options)

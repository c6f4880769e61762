"""A cable on an arm, played by another engine with a finer chain: a model too coarse must not be trusted."""

from __future__ import annotations

import numpy as np
import pytest

from yid_ocp.integrator.step import compile_step
from yid_ocp.model.flexible import Segment, flexible_object
from yid_ocp.model.system import System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.solvers import GaussNewton, Status, solve
from yid_ocp.virtual.experiment import PointCamera, VirtualExperiment, run_virtual_experiment
from yid_ocp.virtual.joint_motion import MultisineOptions, random_multisine_motion
from yid_ocp.virtual.mujoco_simulation import SimulationOptions

pytest.importorskip("mujoco")

JOINTS = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")
POSTURE = dict(zip(JOINTS, (0.0, -1.2, 1.2, -1.6, -1.57, 0.0), strict=True))
TRUTH = {"cable.bend": 0.06, "cable.damping": 2e-3}
FINE, COARSE, DURATION = 12, 5, 3.0


def arm_with_cable(links: int, mode: str) -> System:
    """A UR5 that carries 1 m of cable, bending alone."""
    how = {
        "bend": TRUTH["cable.bend"],
        "damping": TRUTH["cable.damping"],
        "stiffness_per_curvature": True,
        "clamped_at_base": True,
    }
    cable = flexible_object([Segment("cable", 1.0, 0.1, 0.006, links=links, joint_axes="xy", **how)], name="cable")
    robot = read_urdf("package:ur5", joints=list(JOINTS))
    parts = {"objects": [(cable, "tool0", None)], "point_frames": ("w_cable",), "damping": dict.fromkeys(JOINTS, 1.0)}
    return System.build(robot, **parts, **{mode: list(JOINTS)})


@pytest.fixture(scope="module")
def recording():
    system = arm_with_cable(FINE, "driven")
    excitation = MultisineOptions(duration=DURATION, gripper_travel=0.15)
    motion = random_multisine_motion(system, None, seed=3, initial_joint_angles=POSTURE, excitation=excitation)
    simulation = SimulationOptions(duration=DURATION, time_step=1e-3)
    camera = PointCamera(frame_rate=30.0, point_std=1e-3, has_dropouts=False)
    how = VirtualExperiment(motion=motion, initial_joint_angles=POSTURE, simulation=simulation, camera=camera, seed=3)
    return run_virtual_experiment(system, None, how)


def solved(recording, links):
    step = compile_step(arm_with_cable(links, "prescribed"), 0.01)
    options = ProblemOptions(sensors={"joints.effort": SensorOptions(use=False)})
    problem = EstimationProblem(step, [recording], tuple(TRUTH), options, {"cable.bend": 0.1, "cable.damping": 1e-3})
    return solve(problem, GaussNewton())


def test_what_a_chain_too_coarse_gives_is_not_to_be_trusted(recording):
    solution = solved(recording, COARSE)
    assert solution.status == Status.CONVERGED
    assert solution.goodness_of_fit.chi2_per_dof > 2
    assert not solution.goodness_of_fit.explains
    assert {solution.parameters[name].verdict for name in TRUTH} == {"not_trusted"}
    bend = solution.parameters["cable.bend"]
    assert abs(bend.value - TRUTH["cable.bend"]) > 3 * bend.std, "so far off that trust would mislead"


@pytest.mark.slow
def test_with_as_many_links_as_there_are_it_is_found(recording):
    solution = solved(recording, FINE)
    assert solution.goodness_of_fit.explains
    for name, truth in TRUTH.items():
        entry = solution.parameters[name]
        assert entry.verdict == "identifiable", name
        assert abs(entry.value - truth) < max(4 * entry.std, 0.05 * truth), name
    assert np.all(np.isfinite(list(solution.std.values())))

"""A branched cable whose stiffnesses are far from their start: a search that stalls at a bound of zero fails here."""

import numpy as np
import pytest

from yid_ocp.data import JointGroup, PointGroup, Recording
from yid_ocp.integrator.step import compile_step
from yid_ocp.model.flexible import FlexibleSegment, flexible_object
from yid_ocp.model.mechanism import rotation_from_rpy
from yid_ocp.model.system import System, six_joint_floating_mechanism
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.solvers import GaussNewton, Status, fit_problem
from yid_ocp.virtual.experiment import PointCamera, VirtualExperimentSettings, run_virtual_experiment
from yid_ocp.virtual.joint_motion import MultisineOptions, random_multisine_motion
from yid_ocp.virtual.mujoco_simulation import SimulationOptions

CLAMP = tuple(f"clamp_{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz"))
POINTS = ("w_a", "w_b", "w_c")
TRUTH = {"a.bend": 1.2e-3, "a.twist": 8e-4, "b.bend": 5e-4, "b.twist": 6e-4, "c.bend": 2e-4, "c.twist": 2e-4}
SEEN = ("a.bend", "b.bend", "c.bend")
STD, H, STEPS = 1e-3, 0.01, 200


@pytest.fixture(scope="module")
def cable():
    """Makes the problem from a start, the same for all free stiffnesses [N m^2]; recorded by the model at the truth."""
    how = {"radius": 0.005, "values_given_as_rigidities": True, "damping": 2e-4}
    segments = [
        FlexibleSegment("a", 0.3, 0.03, links=4, clamped_at_base=True, **how),
        FlexibleSegment("b", 0.2, 0.02, links=3, parent="a", rest_rotation=rotation_from_rpy(0.64, 0.0, 0.0), **how),
        FlexibleSegment("c", 0.15, 0.01, links=3, parent="a", rest_rotation=rotation_from_rpy(0.0, 0.64, 0.0), **how),
    ]
    item = flexible_object(segments, name="cable")
    system = System.build(
        six_joint_floating_mechanism("clamp"), objects=[(item, "clamp", None)], prescribed=CLAMP, damping={}
    )
    step = compile_step(system, H)
    t = H * np.arange(STEPS + 1)
    s = np.clip(t, 0, 1)
    waves = (0.08, 4.0, 0.0), (0.05, 6.0, 1.0), (0.0, 1.0, 0.0), (0.4, 5.0, 0.0), (0.3, 3.0, 0.0), (0.5, 4.5, 0.0)
    path = np.stack([a * np.sin(f * t + b) * s**2 * (3 - 2 * s) for a, f, b in waves], axis=1)
    path[:, 4] += 1.6  # the cable hangs sideways
    rng = np.random.default_rng(0)

    def recording(position):
        group = PointGroup("points", POINTS, t, position, np.full(position.shape, STD))
        return Recording(JointGroup(CLAMP, t, path, position_std=0.0), (group,), name="twin")

    def problem(values, position):
        options = ProblemOptions(path_cutoff=np.inf)
        return EstimationProblem(step, [recording(position)], tuple(TRUTH), options, dict(values))

    true = problem(TRUTH, np.zeros((STEPS + 1, 3, 3)))
    [prediction] = true.evaluate(true.initial_unknowns, derivatives=False).episode_predictions
    exact = prediction.predicted_outputs[0].reshape(STEPS + 1, 3, 3)
    measured = exact + STD * rng.standard_normal(exact.shape)
    return lambda start: problem(dict.fromkeys(TRUTH, start), measured)


@pytest.mark.parametrize("start", [4.5e-4, 1.5e-2, 7.5e-2])
def test_stiffnesses_are_found_from_starts_far_below_and_above(cable, start):
    problem = cable(start)
    outcome = GaussNewton().minimize_cost(problem, problem.initial_unknowns, None)
    assert outcome.status == Status.CONVERGED
    found = problem.evaluate(outcome.x)
    assert found.cost < 0.6 * len(found.residual), "the noise's half a unit for each of the samples"
    assert not any(np.any(entry.x == 0.0) for entry in outcome.history), "none is clipped to its bound on the way"
    assert outcome.history[-1].gradient_norm < 1e-2 * found.cost


def test_what_is_found_is_true_and_what_the_tips_hardly_see_is_not_called_found(cable):
    solution = fit_problem(cable(4.5e-4), GaussNewton())
    assert solution.goodness_of_fit.explains
    for name, truth in TRUTH.items():
        entry = solution.parameters[name]
        if name in SEEN or entry.verdict == "identifiable":
            assert abs(entry.value - truth) < 4 * entry.std, name
    assert {solution.parameters[name].verdict for name in SEEN} == {"identifiable"}
    assert solution.parameters["c.twist"].verdict != "identifiable"


pytest.importorskip("mujoco")

JOINTS = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")
POSTURE = dict(zip(JOINTS, (0.0, -1.2, 1.2, -1.6, -1.57, 0.0), strict=True))
CABLE_TRUTH = {"cable.bend": 0.06, "cable.damping": 2e-3}
FINE, COARSE, DURATION = 12, 5, 3.0


def arm_with_cable(links: int, mode: str) -> System:
    """A UR5 that carries 1 m of cable, bending alone."""
    how = {"values_given_as_rigidities": True, "clamped_at_base": True}
    how |= {name: CABLE_TRUTH[f"cable.{name}"] for name in ("bend", "damping")}
    cable = flexible_object(
        [FlexibleSegment("cable", 1.0, 0.1, 0.006, links=links, joint_axes="xy", **how)], name="cable"
    )
    robot = read_urdf("package:ur5", joints=list(JOINTS))
    parts = {"objects": [(cable, "tool0", None)], "point_frames": ("w_cable",), "damping": dict.fromkeys(JOINTS, 1.0)}
    return System.build(robot, **parts, **{mode: list(JOINTS)})


@pytest.fixture(scope="module")
def coarse_recording():
    system = arm_with_cable(FINE, "driven")
    excitation = MultisineOptions(duration=DURATION, gripper_travel=0.15)
    motion = random_multisine_motion(system, None, seed=3, initial_joint_angles=POSTURE, excitation=excitation)
    simulation = SimulationOptions(duration=DURATION, time_step=1e-3)
    camera = PointCamera(frame_rate=30.0, point_std=1e-3, has_dropouts=False)
    how = VirtualExperimentSettings(
        motion=motion, initial_joint_angles=POSTURE, simulation=simulation, camera=camera, seed=3
    )
    return run_virtual_experiment(system, None, how)


def solved(coarse_recording, links):
    step = compile_step(arm_with_cable(links, "prescribed"), 0.01)
    options = ProblemOptions(sensors={"joints.effort": SensorOptions(use=False)})
    start = {"cable.bend": 0.1, "cable.damping": 1e-3}
    problem = EstimationProblem(step, [coarse_recording], tuple(CABLE_TRUTH), options, start)
    return fit_problem(problem, GaussNewton())


def test_what_a_chain_too_coarse_gives_is_not_to_be_trusted(coarse_recording):
    solution = solved(coarse_recording, COARSE)
    assert solution.status == Status.CONVERGED
    assert solution.goodness_of_fit.chi2_per_dof > 2
    assert not solution.goodness_of_fit.explains
    assert {solution.parameters[name].verdict for name in CABLE_TRUTH} == {"not_trusted"}
    bend = solution.parameters["cable.bend"]
    assert abs(bend.value - CABLE_TRUTH["cable.bend"]) > 3 * bend.std, "so far off that trust would mislead"


@pytest.mark.slow
def test_with_as_many_links_as_there_are_it_is_found(coarse_recording):
    solution = solved(coarse_recording, FINE)
    assert solution.goodness_of_fit.explains
    for name, truth in CABLE_TRUTH.items():
        entry = solution.parameters[name]
        assert entry.verdict == "identifiable", name
        assert abs(entry.value - truth) < max(4 * entry.std, 0.05 * truth), name
    assert np.all(np.isfinite(list(solution.std.values())))

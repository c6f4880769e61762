"""Effects that begin at their neutral value are found all the same, such as a spring relaxed elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from yid_ocp.data import JointGroup, Recording
from yid_ocp.effects import make_effect
from yid_ocp.integrator.step import compile_step, simulate
from yid_ocp.model import System
from yid_ocp.model.servos_and_springs import RobotJointSpring
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.solvers import GaussNewton, Status, solve
from yid_ocp.solvers.initial_guess import unknowns_with_active_effects

H, STEPS, STD = 0.01, 150, 0.02
JOINTS = ("shoulder", "elbow")


@pytest.fixture(scope="module")
def moved(urdf_folder):
    """A double pendulum moved as measured, with an effect's values at its elbow; what its joints need is seen."""

    def make(kind, truth, free, seed=0):
        robot = read_urdf(urdf_folder / "double_pendulum.urdf")
        plain = System.build(robot, springs={"shoulder": RobotJointSpring(6.0, 0.1)}, prescribed=JOINTS)
        system = plain.with_effects([make_effect(kind, "elbow", plain)])
        step = compile_step(system, H, use_compiler=False)
        t = H * np.arange(STEPS + 1)
        path = np.stack([0.6 * np.sin(2.1 * t), 0.9 + 0.3 * np.sin(3.3 * t + 0.4)], axis=1)
        theta = system.parameters.vector({f"{kind}@elbow.{name}": value for name, value in truth.items()})
        sizes = step.sizes
        begin = np.concatenate([path[0], np.zeros(sizes["nx"] - 2)])
        effort = simulate(step, theta, begin, STEPS, np.zeros((STEPS, 0)), path).effort
        noise = np.random.default_rng(seed).normal(scale=STD, size=(STEPS + 1, 2))
        recorded = np.vstack([effort, effort[-1]]) + noise
        group = JointGroup(JOINTS, t, path, effort=recorded, effort_std=STD, position_std=0.0)
        options = ProblemOptions(path_cutoff=np.inf)
        names = [f"{kind}@elbow.{name}" for name in free]
        return EstimationProblem(step, [Recording(group, name="twin")], ["shoulder.stiffness", *names], options)

    return make


@pytest.mark.parametrize(("stiffness", "rest_angle"), [(8.0, -1.5), (25.0, 0.3)])
def test_a_spring_relaxed_elsewhere_is_found_from_its_neutral_value(moved, stiffness, rest_angle):
    problem = moved("joint_spring", {"stiffness": stiffness, "rest_angle": rest_angle}, ("stiffness", "rest_angle"))
    assert problem.initial_unknowns[1] == 0.0
    solution = solve(problem, GaussNewton())
    assert solution.status == Status.CONVERGED
    for name, truth in (("stiffness", stiffness), ("rest_angle", rest_angle)):
        entry = solution.parameters[f"joint_spring@elbow.{name}"]
        assert entry.verdict == "identifiable", name
        assert abs(entry.value - truth) < 4 * entry.std, name


def test_from_its_neutral_value_a_spring_that_would_have_to_push_stays_at_zero(moved):
    """What the start off neutral is for: relaxed at zero, the spring would need a stiffness below zero."""
    problem = moved("joint_spring", {"stiffness": 8.0, "rest_angle": 1.8}, ("stiffness", "rest_angle"))
    held = GaussNewton().minimize_cost(problem, problem.initial_unknowns, None)
    assert held.x[1] == 0.0


def test_an_amplitude_seen_at_its_neutral_value_begins_there(moved):
    problem = moved("joint_viscous", {"b": 0.3}, ("b",))
    np.testing.assert_array_equal(
        unknowns_with_active_effects(problem, problem.initial_unknowns), problem.initial_unknowns
    )
    fixed = moved("joint_spring", {"stiffness": 8.0, "rest_angle": 1.4}, ())
    np.testing.assert_array_equal(unknowns_with_active_effects(fixed, fixed.initial_unknowns), fixed.initial_unknowns)


def test_an_effect_that_was_given_a_value_begins_there(moved):
    problem = moved("joint_spring", {"stiffness": 8.0, "rest_angle": 1.4}, ("stiffness", "rest_angle"))
    begun = problem.with_parameter_values({"joint_spring@elbow.stiffness": 2.0})
    np.testing.assert_array_equal(unknowns_with_active_effects(begun, begun.initial_unknowns), begun.initial_unknowns)


def test_a_start_that_cannot_be_rolled_out_is_drawn_back(moved, monkeypatch):
    problem = moved("joint_spring", {"stiffness": 8.0, "rest_angle": 1.4}, ("stiffness", "rest_angle"))
    whole, plain = unknowns_with_active_effects(problem, problem.initial_unknowns), problem.evaluate

    def stiff(x, derivatives=True, warm=None):
        found = plain(x, derivatives, warm)
        return found if x[1] < 0.6 * whole[1] else type(found)(np.inf, found.residual, None, False, "it snaps", ())

    monkeypatch.setattr(problem, "evaluate", stiff)
    drawn = unknowns_with_active_effects(problem, problem.initial_unknowns)
    assert drawn[1] == pytest.approx(0.5 * whole[1])

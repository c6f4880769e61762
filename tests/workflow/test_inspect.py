"""Where the command `inspect` looks."""

from __future__ import annotations

import math

import numpy as np
import pytest

from yid_ocp.analysis.step_symbols import StepSymbols
from yid_ocp.data.recording import PointGroup, Recording
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import Grasp, Segment, System, flexible_object
from yid_ocp.model.rotations import homogeneous_transform, rotation_from_rpy
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.workflow import inspect

TIMES = 0.01 * np.arange(31)


@pytest.fixture(scope="module")
def hanging():
    """hanging(start): a rod of two links under the ceiling, an eighth of a radian aside; the ends of both are seen."""
    rod = flexible_object([Segment("T1", 0.6, 0.1, 0.02, links=2, bend=4.0, twist=3.0)])
    down = homogeneous_transform(rotation_from_rpy(math.pi, 0.0, 0.0), np.zeros(3))
    step = compile_step(System.build(objects=[(rod, None, down)]), 0.01, use_compiler=False)
    aside = 0.3 * np.array([math.sin(0.125), 0.0, -math.cos(0.125)])
    place = np.tile(np.stack([aside, 2 * aside]), (len(TIMES), 1, 1))
    camera = PointGroup("points_camera", ["T1_0_tip", "w_T1"], TIMES, place, 1e-3, sensor="camera", pose=np.eye(4))

    def build(start):
        options = ProblemOptions(initial_state=start)
        return EstimationProblem(step, [Recording(None, (camera,), name="aside")], ("T1.bend",), options)

    return build


def said(problem):
    point = inspect._point(problem.step, problem)
    symbols = StepSymbols.from_equations(problem.step.equations)
    rows = inspect._linearised(problem.step, point)[1]
    return point, {entry.parameter: entry for entry in inspect._dependence(problem.step, symbols, problem, point, rows)}


def test_a_recording_that_starts_at_rest(hanging):
    point, found = said(hanging("equilibrium"))
    assert point.description == "rest at the first posture of aside"
    assert point.is_equilibrium
    np.testing.assert_allclose(point.state[:6], 0.0, atol=1e-9)
    assert found["T1.bend"].seen == found["T1.bend"].rows
    assert found["T1.bend"].moved is not None


def test_a_recording_whose_start_is_fitted(hanging):
    problem = hanging("fitted_to_points")
    point, found = said(problem)
    assert point.description == "the start that was fitted to the first points of aside"
    assert not point.is_equilibrium
    np.testing.assert_allclose(point.state, problem.episodes[0].fixed_initial_state.state)
    assert abs(point.state[1]) == pytest.approx(0.125, abs=0.01)
    # about a motion nothing is said of what is seen, but the recordings tell
    assert found["T1.bend"].seen is None
    assert found["T1.bend"].moved is None
    assert found["T1.bend"].along > 0
    assert found["T1.mass"].along is None
    assert "to first order" in found["T1.bend"].words
    at = inspect._columns_at(problem.step, point)
    symbols = StepSymbols.from_equations(problem.step.equations)
    assert at[symbols._column_index("q0[T1_0_y]")] == point.state[1]
    # the step is taken: its equation holds
    left = symbols.equation_entry("del[T1_0_y]").numeric_value(symbols.column_symbols, at)
    assert left == pytest.approx(0.0, abs=1e-10)


def test_what_has_no_rest_is_looked_at_where_all_is_zero(urdf_folder):
    """A rod whose end is a metre away from the hand that should hold it."""
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    rod = flexible_object([Segment("T1", 0.3, 0.1, 0.02, links=2, bend=4.0, twist=3.0)])
    far = homogeneous_transform(np.eye(3), (2.0, 0.0, 0.0))
    grasps = [Grasp("hand", "tip", "w_T1")]
    system = System.build(robot, objects=[(rod, None, far)], grasps=grasps, driven=["shoulder", "elbow"])
    step = compile_step(system, 0.01, use_compiler=False)
    point = inspect._point(step, None)
    assert point.description.startswith("zero, since there is no rest: ")
    assert not point.is_equilibrium
    assert not np.any(point.state)

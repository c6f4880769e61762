"""Errors that alternate from step to step: which modes count, how far they grow, what is said."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_models import estimate as estimated
from made_models import solution
from made_recordings import places

from yid_ocp.analysis.discretisation import (
    _MAX_GROWTH_DECADES,
    _N_CHECKED_NODES,
    AlternatingErrorGrowth,
    _error_growth_along,
    largest_alternating_error_growth,
)
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import compile_step, simulate
from yid_ocp.integrator.step_model import TrackingFeedback
from yid_ocp.model import Grasp, Segment, System, flexible_object
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.solvers import GaussNewton, Status, solve
from yid_ocp.workflow import solve as solve_command
from yid_ocp.workflow.solve import stability_checked_solution

H = 0.01


def made(matrices, *, by_torque=None, fixed=(), finite=None):
    """A step whose A is given node by node, of two coordinates, and a rollout that stays where it is."""
    count = len(matrices)
    step = SimpleNamespace(
        system=SimpleNamespace(n_coordinates=2, prescribed_coordinate_indices=fixed),
        sizes={"nx": 4},
        time_step=H,
        jacobians=lambda q, p, u, theta, prescribed, z, names: (
            np.array(matrices[int(u[0])], float),
            np.zeros((4, 1)) if by_torque is None else np.array(by_torque, float)[:, None],
            None,
        ),
    )
    state = np.zeros((count + 1, 4))
    if finite is not None:
        state[finite:] = np.nan
    return step, SimpleNamespace(state=state, torque=np.arange(count, dtype=float)[:, None])


def growth(step, rollout, feedback=None):
    return _error_growth_along(step, np.zeros(0), rollout, feedback, "motion", _N_CHECKED_NODES)


def diagonal(*values):
    return np.diag(np.array(values, float))


def turned(size, degrees):
    """Two modes of a magnitude that turn by an angle in every step, beside two that do not move."""
    a, c, s = np.zeros((4, 4)), np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    a[:2, :2] = size * np.array([[c, -s], [s, c]])
    return a


@pytest.mark.parametrize(
    ("matrix", "factor"),
    [
        (diagonal(-1.3, 0.5, 1, 0), 1.3),
        (diagonal(1.3, 0.5, 1, 0), 0.0),
        (diagonal(1.5, -0.9, -0.2, 0), 0.9),
        (turned(1.2, 170), 1.2),
        (turned(1.2, 91), 1.2),
        (turned(1.2, 89), 0.0),
    ],
    ids=["alternates", "falls over", "dies out", "nearly alternates", "turns back", "swings"],
)
def test_only_what_turns_back_at_every_step_is_the_methods_own(matrix, factor):
    found = growth(*made([matrix] * 10))
    assert found.max_step_factor == pytest.approx(factor)
    assert found.growth_decades == pytest.approx(10 * np.log10(factor) if factor > 1 else 0.0)
    assert found.time_step == H


def test_prescribed_coordinates_do_not_count():
    step, rollout = made([diagonal(-3.0, -1.1, -5.0, 0.3)] * 4, fixed=(0,))
    assert growth(step, rollout).max_step_factor == pytest.approx(1.1)


def test_the_tracking_filter_is_part_of_the_loop():
    """Gains too high for the time step alternate by themselves, others calm what would."""
    matrix = diagonal(0.9, 0.5, -1.2, 0.0)
    step, rollout = made([matrix] * 4, by_torque=[1.0, 0.0, 0.0, 0.0])
    feedback = TrackingFeedback(np.array([0], np.int32), np.full((4, 1, 1), 2.4), np.zeros((4, 1)))
    assert growth(step, rollout).max_step_factor == pytest.approx(1.2)
    assert growth(step, rollout, feedback).max_step_factor == pytest.approx(1.5)
    calm = replace(feedback, state_indices=np.array([2], np.int32), gain=np.full((4, 1, 1), -0.4))
    step, rollout = made([matrix] * 4, by_torque=[0.0, 0.0, 1.0, 0.0])
    assert growth(step, rollout, calm).max_step_factor == pytest.approx(0.8)


def test_growth_is_that_of_the_worst_stretch():
    """Ten steps of ten percent, five that calm it down, three of fifty percent."""
    sizes = [1.1] * 10 + [0.1] * 5 + [1.5] * 3
    found = growth(*made([diagonal(-size, 0, 0, 0) for size in sizes]))
    assert found.growth_decades == pytest.approx(max(10 * np.log10(1.1), 3 * np.log10(1.5)))
    assert found.max_step_factor == pytest.approx(1.5)
    assert found.max_growth_time == pytest.approx(15 * H)
    joined = growth(*made([diagonal(-size, 0, 0, 0) for size in [1.1] * 10 + [0.9] + [1.5] * 3]))
    assert joined.growth_decades == pytest.approx(10 * np.log10(1.1) + np.log10(0.9) + 3 * np.log10(1.5))


def test_a_rollout_that_failed_counts_as_far_as_it_got():
    step, rollout = made([diagonal(-1.2, 0, 0, 0)] * 20, finite=8)
    assert growth(step, rollout).growth_decades == pytest.approx(7 * np.log10(1.2))
    step, rollout = made([diagonal(-1.2, 0, 0, 0)] * 20, finite=1)
    assert growth(step, rollout) == AlternatingErrorGrowth("motion", 0.0, 0.0, 0.0, H)
    broken = [diagonal(-1.2, 0, 0, 0)] * 5 + [np.full((4, 4), np.nan)] * 5
    assert growth(*made(broken)).growth_decades == pytest.approx(5 * np.log10(1.2))


@pytest.mark.parametrize(
    ("decades", "stable"), [(0.0, True), (_MAX_GROWTH_DECADES, True), (_MAX_GROWTH_DECADES + 0.1, False)]
)
def test_what_is_said(decades, stable):
    said = AlternatingErrorGrowth("run", decades, 1.29, 0.35, 0.005)
    assert said.is_stable is stable
    if stable:
        assert said.description == "run: the step of 0.005 s is stable along the motion"
    else:
        assert said.description == (
            "run: the step of 0.005 s is not stable: an error that alternates from step to step grows by 29 % in a "
            "step at 0.35 s; take a shorter problem.time_step (0.0025 s, say)"
        )


def test_a_recording_is_judged_by_its_name(pendulum):
    problem = pendulum()
    assert largest_alternating_error_growth(problem, problem.initial_unknowns).is_stable
    assert largest_alternating_error_growth(problem, problem.initial_unknowns).recording_name == "twin"


# -- a light cable between two hands ----------------------------------------------------------------------------------


HANDS = """<robot name="hands"><link name="wall"/>
<joint name="x" type="prismatic"><parent link="wall"/><child link="a"/><axis xyz="1 0 0"/>
  <limit lower="-1" upper="2" effort="100" velocity="5"/></joint>
<link name="a"><inertial><mass value="0.5"/><inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/>
  </inertial></link>
<joint name="z" type="prismatic"><parent link="a"/><child link="hand"/><axis xyz="0 0 1"/>
  <limit lower="-1" upper="2" effort="100" velocity="5"/></joint>
<link name="hand"><inertial><mass value="0.5"/><inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/>
  </inertial></link></robot>
"""


NODE = ("symmetric", "node")
"""The rule under which the constraints pull at the nodes, which is what does not bear a light cable's tension."""


@pytest.fixture(scope="module")
def light(tmp_path_factory):
    """light(stiffness, time_step): the step of twenty grams on a metre; `path(time_step)` moves its hands."""
    file = tmp_path_factory.mktemp("hands") / "hands.urdf"
    file.write_text(HANDS)
    robot = read_urdf(file)

    def build(stiffness, time_step):
        segment = Segment("cable", 1.0, 0.02, 0.003, links=8, bend=stiffness, twist=stiffness, damping=1e-4)
        grasps = [Grasp("hand", "hand", "w_cable")]
        objects = [(flexible_object([segment]), None, None)]
        system = System.build(
            robot, objects=objects, grasps=grasps, prescribed=["x", "z"], point_frames=["cable:30%", "cable:60%"]
        )
        return compile_step(system, time_step, *NODE, use_compiler=False)

    return build


def moved(step, duration):
    """Times, the hands' path and the rollout from rest."""
    t = step.time_step * np.arange(round(duration / step.time_step) + 1)
    ramp = np.minimum(t / 0.3, 1.0) ** 2
    path = np.stack([0.35 + 0.1 * ramp * np.sin(6 * t), 0.75 + 0.08 * ramp * np.sin(9 * t)], axis=1)
    theta = step.system.parameters.vector()
    rest = EquilibriumSolver(step).solve(path[0], theta)
    return t, path, simulate(step, theta, rest.state, len(t) - 1, path=path)


@pytest.mark.parametrize(("stiffness", "time_step", "stable"), [(0.5, 0.005, False), (0.5, 0.0025, True)])
def test_a_light_cable_between_two_hands(light, stiffness, time_step, stable):
    """The rollout converges at every step all the same."""
    step = light(stiffness, time_step)
    _, _, rollout = moved(step, 0.4)
    assert rollout.status.is_converged
    found = _error_growth_along(step, step.system.parameters.vector(), rollout, None, "light", _N_CHECKED_NODES)
    assert found.is_stable is stable
    assert (found.max_step_factor > 1.1) is not stable


@pytest.fixture(scope="module")
def light_recording(light):
    """The cable as a step of a millisecond moves it, its points seen to a millimetre at 100 Hz."""
    fine = light(0.5, 0.001)
    t, path, rollout = moved(fine, 0.8)
    seen = np.array(
        [places(fine.system, fine.system.point_frames, q) for q in rollout.state[::10, : fine.system.n_coordinates]]
    )
    seen += 1e-3 * np.random.default_rng(0).standard_normal(seen.shape)
    points = PointGroup("points", fine.system.point_frames, t[::10], seen, 1e-3)
    return Recording(JointGroup(["x", "z"], t[::5], path[::5], position_std=0.0), (points,), name="light")


@pytest.mark.slow
@pytest.mark.parametrize(("time_step", "status"), [(0.005, Status.STALLED), (0.0025, Status.CONVERGED)])
def test_a_fit_that_walked_away_from_an_unstable_truth_has_not_converged(light, light_recording, time_step, status):
    """At 5 ms it ends, with every sign of success, thousands of standard deviations from the truth."""
    options = ProblemOptions(path_cutoff=np.inf)
    problem = EstimationProblem(light(0.3, time_step), [light_recording], ("cable.bend",), options)
    found = solve(problem, GaussNewton())
    assert found.status == Status.CONVERGED
    entry = found.parameters["cable.bend"]
    assert (abs(entry.value - 0.5) > 100 * entry.std) == (status == Status.STALLED)
    judged, said = stability_checked_solution(problem, found)
    assert judged.status == status
    assert set(said) == {"start", "estimate"}
    if status == Status.STALLED:
        assert judged.message.startswith("at the estimate light: the step of 0.005 s is not stable")
        assert found.message in judged.message
    else:
        assert abs(entry.value - 0.5) < 3 * entry.std
        assert judged == found


@pytest.mark.parametrize(
    ("before", "start", "estimate", "after"),
    [
        (Status.CONVERGED, 0.0, 0.0, Status.CONVERGED),
        (Status.CONVERGED, 9.0, 0.0, Status.CONVERGED),
        (Status.CONVERGED, 0.0, 9.0, Status.STALLED),
        (Status.ITERATION_LIMIT, 0.0, 9.0, Status.ITERATION_LIMIT),
        (Status.FAILED, 9.0, 0.0, Status.FAILED),
        (Status.FAILED, 0.0, 0.0, Status.FAILED),
    ],
)
def test_a_search_may_begin_but_not_end_where_the_step_is_not_stable(monkeypatch, before, start, estimate, after):
    grown = {
        0.0: AlternatingErrorGrowth("run", start, 1.3, 0.1, H),
        1.0: AlternatingErrorGrowth("run", estimate, 1.3, 0.1, H),
    }
    monkeypatch.setattr(solve_command, "largest_alternating_error_growth", lambda problem, x: grown[float(x[0])])
    found = replace(solution(status=before, a=estimated(1.0)), message="done")
    judged, said = stability_checked_solution(SimpleNamespace(initial_unknowns=np.zeros(1)), found)
    assert judged.status == after
    assert (said["start"]["decades"], said["estimate"]["decades"]) == (start, estimate)
    named = "at the estimate run" if estimate else "at the start run" if start and before == Status.FAILED else "done"
    assert judged.message.startswith(named)
    assert "done" in judged.message
    monkeypatch.setattr(solve_command, "largest_alternating_error_growth", lambda problem, x: None)
    assert stability_checked_solution(SimpleNamespace(initial_unknowns=np.zeros(1)), found) == (
        found,
        {"start": None, "estimate": None},
    )

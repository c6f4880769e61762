"""The weak-constraint smoother: against the nonlinear rollout, on twins, and what pushes amount to."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import casadi as ca
import numpy as np
import pytest

from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.diagnosis.localise import (
    localise_gap,
    smoothed_unknown_z_scores,
)
from yid_ocp.inference import smoother_model
from yid_ocp.inference.smoother import select_and_smooth_unknowns
from yid_ocp.inference.smoother_model import (
    _FORCE_POINT,
    _generalized_forces_per_newton,
    _IntervalModel,
    _segment_weights,
    linear_residual_models,
)
from yid_ocp.integrator.step import compile_step, simulate
from yid_ocp.model import System
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.solvers import GaussNewton, solve
from yid_ocp.virtual.experiment import baxter_foam_y_system

# -- a pendulum with a motor, seen from outside ------------------------------------------------------------------------


TIME_STEP = 0.01


@pytest.fixture(scope="module")
def driven(urdf_folder) -> System:
    tree = read_urdf(str(urdf_folder / "double_pendulum.urdf"))
    return System.build(tree, driven=("shoulder", "elbow"), damping={"shoulder": 0.3, "elbow": 0.3})


def recorded(system: System, pushed: dict[int, tuple[float, float, float]], seed: int) -> Recording:
    """Points under a torque that is not in the recording: joint index to (torque, begin, end)."""
    step = compile_step(system, TIME_STEP)
    steps = 200
    t = TIME_STEP * np.arange(steps + 1)
    torque = np.zeros((steps, 2))
    torque[:, 0] = 1.5 * np.sin(2 * np.pi * 0.7 * t[:-1])
    extra = torque.copy()
    for joint, (size, begin, end) in pushed.items():
        extra[(t[:-1] >= begin) & (t[:-1] < end), joint] += size
    swept = simulate(step, system.parameters.vector(), np.zeros(step.sizes["nx"]), steps, extra)
    assert swept.status.is_converged
    known = list(system.mechanism.frames)[-2:]
    q = ca.SX.sym("q", system.n_coordinates)
    kinematics = forward_kinematics(system.mechanism, q)
    place = ca.Function("p", [q], [ca.horzcat(*(kinematics.frame_position(f) for f in known))])
    position = np.stack([np.array(place(x[:2])).T for x in swept.state])
    noise = np.random.default_rng(seed).standard_normal(position.shape)
    points = PointGroup("points", tuple(known), t, position + 1e-3 * noise, std=np.full(position.shape, 1e-3))
    joints = JointGroup(
        ("shoulder", "elbow"),
        t,
        swept.state[:, :2],
        effort=np.vstack([torque, torque[-1:]]),
        effort_std=0.0,
        effort_kind="command",
    )
    return Recording(joints, (points,), name="push")


def problem_of(system: System, recording: Recording, feedback: Literal["none", "lqr"] = "none") -> EstimationProblem:
    return EstimationProblem(
        compile_step(system, TIME_STEP),
        [recording],
        ("shoulder.damping",),
        ProblemOptions(
            initial_state="equilibrium", feedback=feedback, sensors={"joints.position": SensorOptions(use=False)}
        ),
    )


def said_of(problem: EstimationProblem):
    """What the smoother says about the fit of a problem."""
    solution = solve(problem, GaussNewton())
    return select_and_smooth_unknowns(problem, np.array(solution.x), solution.evaluation)


@pytest.mark.parametrize("feedback", ["none", "lqr"])
def test_the_linear_model_predicts_what_a_small_push_does(driven, monkeypatch, feedback):
    """Whatever keeps the arm on its measured motion, whose momentum has the push in it."""

    def as_they_are(observed, by_state, by_unknown, transition, drive):
        none = np.zeros((observed.shape[1], observed.shape[1]))
        return _IntervalModel(observed, by_state, by_unknown, transition, drive, none, len(observed))

    monkeypatch.setattr(smoother_model, "_compressed", as_they_are)
    recording = recorded(driven, {}, 1)
    problem = problem_of(driven, recording, feedback)
    x = problem.initial_unknowns
    evaluation = problem.evaluate(x)
    model = linear_residual_models(problem, x, evaluation)[0]
    column = model.unknown_names.index("elbow")
    size = 1e-4 / model.reference_std[column]
    state, moved = np.zeros(len(model.initial_state_std)), []
    for j, interval in enumerate(model.intervals):
        unknown = np.zeros(len(model.unknown_names))
        unknown[column] = size if 5 <= j < 9 else 0.0
        moved.append(interval.state_jacobian @ state + interval.unknown_jacobian @ unknown)
        state = interval.state_transition @ state + interval.unknown_input_matrix @ unknown
    joints = recording.joints
    assert joints is not None
    assert joints.effort is not None
    effort = joints.effort.copy()
    effort[50:90, 1] += 1e-4
    changed = problem_of(driven, replace(recording, joints=replace(joints, effort=effort)), feedback)
    difference = changed.evaluate(x, False).residual - evaluation.residual
    rows = np.concatenate(moved)
    # with one sensor the residual's order is that of time, interval after interval
    assert len(rows) == problem.residual_rows.data.stop
    difference = difference[: len(rows)]
    if feedback == "none":
        assert rows == pytest.approx(difference, rel=1e-3, abs=1e-4 * np.abs(difference).max())
    else:
        # a step late where the push begins and ends
        assert np.linalg.norm(rows - difference) < 0.03 * np.linalg.norm(difference)


def test_clean_data_have_no_place(driven):
    found = said_of(problem_of(driven, recorded(driven, {}, 2)))
    assert found.log_evidence["both"] == 0
    assert found.gap_origin == "none"
    assert all(place.gap_share == 0 for place in localise_gap(found))
    assert any(place.is_observable for place in localise_gap(found))


@pytest.mark.parametrize(("joint", "name", "push"), [(0, "shoulder", 0.3), (1, "elbow", 0.03)])
def test_a_push_is_found_where_and_when_it_was(driven, joint, name, push):
    found = said_of(problem_of(driven, recorded(driven, {joint: (push, 0.8, 1.3)}, 3)))
    places = localise_gap(found)
    assert places[0].location == name
    assert places[0].gap_share > 0.5
    assert found.log_evidence["plant"] > found.log_evidence["sensor"] + 10
    assert any(begin < 1.2 and end > 0.9 for begin, end in places[0].time_windows)
    trace = found.smoothed_unknowns[0]
    column = trace.unknown_names.index(name)
    middle = (trace.interval_edges[:-1] >= 0.9) & (trace.interval_edges[1:] <= 1.25)
    size = trace.reference_std[column] * trace.posterior_mean[middle, column]
    assert np.abs(size).mean() == pytest.approx(push, rel=0.35)
    edges, names, values = smoothed_unknown_z_scores(found)
    assert values.shape == (len(edges) - 1, len(names))
    assert np.isfinite(values[:, names.index(name)]).any()


def test_a_sensor_that_reads_wrong_is_told_from_a_push(driven):
    recording = recorded(driven, {}, 4)
    group = recording.points[0]
    moved = group.position.copy()
    moved[80:130, 1] += [0.0, 0.02, 0.0]
    wrong = replace(recording, points=(replace(group, position=moved),))
    found = said_of(problem_of(driven, wrong))
    assert found.gap_origin == "sensor"
    assert localise_gap(found)[0].location == "points"


def test_efforts_of_prescribed_joints_say_which(bench):
    recording = bench.recording({"joint_coulomb@elbow": {"tau_c": 0.3}}, 1, duration=2.0)
    found = said_of(bench.problem([recording]))
    places = localise_gap(found)
    assert places[0].location == "elbow"
    assert places[0].gap_share > 0.8
    assert found.explainable_gap_fraction > 0.5
    assert found.gap_origin == "either", "a force at a measured joint and its sensor's bias are the same"


# -- pushes on segments ------------------------------------------------------------------------------------------------

SYSTEM = baxter_foam_y_system(1)
THETA = np.array([parameter.value for parameter in SYSTEM.parameters])


def test_a_push_is_what_virtual_work_says():
    q = 0.3 * np.random.default_rng(3).standard_normal((2, SYSTEM.n_coordinates))
    found = _generalized_forces_per_newton(SYSTEM, THETA, q, ("T1", "T3"))
    assert found.shape == (2, SYSTEM.n_coordinates, 6)
    symbol = ca.SX.sym("q", SYSTEM.n_coordinates)
    at = ca.vertcat(
        *(forward_kinematics(SYSTEM.mechanism, symbol).frame_position(f"{s}:{_FORCE_POINT}") for s in ("T1", "T3"))
    )
    place = ca.Function("place", [symbol, SYSTEM.parameters.symbols], [at])
    for k, row in enumerate(q):
        for i in range(SYSTEM.n_coordinates):
            step = np.zeros(SYSTEM.n_coordinates)
            step[i] = 1e-6
            moved = (np.array(place(row + step, THETA)) - np.array(place(row - step, THETA))).ravel() / 2e-6
            assert found[k, i] == pytest.approx(moved, abs=1e-8)


def test_pushes_are_measured_by_the_weight_of_their_segment():
    found = _segment_weights(SYSTEM, THETA)
    assert found == pytest.approx({"T1": 9.81 * 0.064, "T2": 9.81 * 0.015, "T3": 9.81 * 0.016})

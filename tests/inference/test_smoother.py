"""The weak-constraint smoother: against dense linear algebra, against the nonlinear rollout, and on twins."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import casadi as ca
import numpy as np
import pytest

from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.diagnosis.localise import (
    GapLocation,
    attribute_gap_to_effects,
    informed_z_scores,
    localise_gap,
    merge_intervals,
)
from yid_ocp.inference import smoother_model
from yid_ocp.inference.smoother import _filter, _run, _scores, force_likelihood_terms, run_smoother
from yid_ocp.inference.smoother_model import IntervalModel, LinearResidualModel, UnknownGroup, linear_residual_models
from yid_ocp.integrator.rollout import simulate
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import System
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.solvers import GaussNewton, solve

FORCE, BIAS = UnknownGroup("here", "force"), UnknownGroup("camera", "bias")


def random_model(seed: int, states=3, unknowns=2, parameters=2, count=4, rows=5) -> LinearResidualModel:
    rng = np.random.default_rng(seed)
    intervals = tuple(
        IntervalModel(
            rng.standard_normal((rows, 1 + parameters)),
            rng.standard_normal((rows, states)),
            rng.standard_normal((rows, unknowns)),
            0.6 * rng.standard_normal((states, states)),
            rng.standard_normal((states, unknowns)),
            np.zeros((1 + parameters, 1 + parameters)),
            rows,
        )
        for _ in range(count)
    )
    sources = (FORCE,) * (unknowns - 1) + (BIAS,)
    return LinearResidualModel(
        "run",
        intervals,
        0.1 * np.arange(count + 1),
        tuple(f"u{i}" for i in range(unknowns)),
        sources,
        np.ones(unknowns),
        rng.standard_normal((states, unknowns)),
        0.3 * np.ones(states),
        0.7,
        np.zeros(unknowns),
    )


def dense(model: LinearResidualModel, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Design (rows, all disturbances), their covariance, and the unknowns by them."""
    ns, nd, count = len(model.initial_state_std), len(variance), len(model.intervals)
    width = ns + nd * count
    gain = np.sqrt(1 - model.interval_correlation**2)
    unknown = np.zeros((count, nd, width))
    for j in range(count):
        if j:
            unknown[j] = model.interval_correlation * unknown[j - 1]
        unknown[j][:, ns + nd * j : ns + nd * (j + 1)] += np.eye(nd) * (gain if j else 1.0)
    state = np.zeros((ns, width))
    state[:, :ns] = np.eye(ns)
    state += model.initial_state_jacobian @ unknown[0]
    rows = []
    for j, interval in enumerate(model.intervals):
        rows.append(interval.state_jacobian @ state + interval.unknown_jacobian @ unknown[j])
        state = interval.state_transition @ state + interval.unknown_input_matrix @ unknown[j]
    return np.vstack(rows), np.concatenate([model.initial_state_std**2, np.tile(variance, count)]), unknown


@pytest.mark.parametrize("seed", range(3))
def test_the_filter_gives_the_evidence_and_the_posterior_of_dense_algebra(seed):
    model = random_model(seed)
    variance = np.array([0.8, 2.5])
    design, prior, unknown = dense(model, variance)
    observed = np.vstack([i.negative_residual_jacobian for i in model.intervals])
    total = design @ np.diag(prior) @ design.T + np.eye(len(design))
    done = _filter(model, variance, True)
    assert done.products == pytest.approx(observed.T @ np.linalg.solve(total, observed), rel=1e-9)
    assert done.log_determinant == pytest.approx(np.linalg.slogdet(total)[1], rel=1e-9)
    gain = np.diag(prior) @ design.T @ np.linalg.inv(total)
    mean = unknown @ gain @ observed
    covariance = np.diag(prior) - gain @ design @ np.diag(prior)
    assert done.mean == pytest.approx(mean, rel=1e-8, abs=1e-10)
    expected = np.einsum("jdw,wv,jdv->jd", unknown, covariance, unknown)
    assert done.covariance == pytest.approx(expected, rel=1e-8, abs=1e-10)
    left = np.linalg.solve(total, observed)
    assert np.vstack(done.left) == pytest.approx(left, rel=1e-8, abs=1e-10)


@pytest.mark.parametrize("unknown", [0, 1])
def test_what_is_said_of_one_unknowns_history_is_that_of_dense_algebra(unknown):
    model = random_model(5)
    variance = {FORCE: 0.8, BIAS: 2.5}
    design, prior, _ = dense(model, np.array([variance[source] for source in model.unknown_groups]))
    observed = np.vstack([i.negative_residual_jacobian for i in model.intervals])
    # parameters have a prior of three of their sizes
    total = design @ np.diag(prior) @ design.T + np.eye(len(design)) + 9 * observed[:, 1:] @ observed[:, 1:].T
    columns = []
    for at in range(len(model.intervals)):
        state, rows = np.zeros(len(model.initial_state_std)), []
        for j, interval in enumerate(model.intervals):
            value = float(j == at)
            rows.append(interval.state_jacobian @ state + interval.unknown_jacobian[:, unknown] * value)
            state = interval.state_transition @ state + interval.unknown_input_matrix[:, unknown] * value
        columns.append(np.concatenate(rows))
    response = np.stack(columns, axis=1)
    score, information = force_likelihood_terms(model, variance, unknown)
    assert score == pytest.approx(response.T @ np.linalg.solve(total, observed[:, 0]), rel=1e-7, abs=1e-9)
    assert information == pytest.approx(response.T @ np.linalg.solve(total, response), rel=1e-7, abs=1e-9)


def test_the_scores_are_the_slope_of_the_evidence():
    model = random_model(4)
    at = {FORCE: 0.9, BIAS: 0.4}
    state = _run([model], at)
    for source, (up, down) in _scores([model], state).items():
        step = 1e-5
        slope = (
            _run([model], at | {source: at[source] + step}).log_evidence
            - _run([model], at | {source: at[source] - step}).log_evidence
        ) / (2 * step)
        assert slope == pytest.approx((up - down) / 2, rel=1e-4)


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


@pytest.mark.parametrize("feedback", ["none", "lqr"])
def test_the_linear_model_predicts_what_a_small_push_does(driven, monkeypatch, feedback):
    """Whatever keeps the arm on its measured motion, whose momentum has the push in it."""

    def as_they_are(observed, by_state, by_unknown, transition, drive):
        none = np.zeros((observed.shape[1], observed.shape[1]))
        return IntervalModel(observed, by_state, by_unknown, transition, drive, none, len(observed))

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
    problem = problem_of(driven, recorded(driven, {}, 2))
    solution = solve(problem, GaussNewton())
    found = run_smoother(problem, np.array(solution.x), solution.evaluation)
    assert found.log_evidence["both"] == 0
    assert found.gap_origin == "none"
    assert all(place.gap_share == 0 for place in localise_gap(found))
    assert any(place.is_observable for place in localise_gap(found))


@pytest.mark.parametrize(("joint", "name", "push"), [(0, "shoulder", 0.3), (1, "elbow", 0.03)])
def test_a_push_is_found_where_and_when_it_was(driven, joint, name, push):
    problem = problem_of(driven, recorded(driven, {joint: (push, 0.8, 1.3)}, 3))
    solution = solve(problem, GaussNewton())
    found = run_smoother(problem, np.array(solution.x), solution.evaluation)
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
    edges, names, values = informed_z_scores(found)
    assert values.shape == (len(edges) - 1, len(names))
    assert np.isfinite(values[:, names.index(name)]).any()


def test_a_sensor_that_reads_wrong_is_told_from_a_push(driven):
    recording = recorded(driven, {}, 4)
    group = recording.points[0]
    moved = group.position.copy()
    moved[80:130, 1] += [0.0, 0.02, 0.0]
    wrong = replace(recording, points=(replace(group, position=moved),))
    problem = problem_of(driven, wrong)
    solution = solve(problem, GaussNewton())
    found = run_smoother(problem, np.array(solution.x), solution.evaluation)
    assert found.gap_origin == "sensor"
    assert localise_gap(found)[0].location == "points"


def test_efforts_of_prescribed_joints_say_which(bench):
    recording = bench.recording({"joint_coulomb@elbow": {"tau_c": 0.3}}, 1, duration=2.0)
    problem = bench.problem([recording])
    solution = solve(problem, GaussNewton())
    found = run_smoother(problem, np.array(solution.x), solution.evaluation)
    places = localise_gap(found)
    assert places[0].location == "elbow"
    assert places[0].gap_share > 0.8
    assert found.explainable_fraction > 0.5
    assert found.gap_origin == "either", "a force at a measured joint and its sensor's bias are the same"


def test_effects_take_the_share_that_they_close():
    before = (GapLocation("T1", 0.9, True, ((0.0, 1.0),)), GapLocation("T2", 0.1, True, ()))
    found = attribute_gap_to_effects(before, {"world": 0.8}, (GapLocation("T2", 1.0, True, ()),), ((0.5, 1.0),))
    assert [(p.location, round(p.gap_share, 3)) for p in found] == [("world", 0.8), ("T2", 0.2), ("T1", 0.0)]
    assert found[0].time_windows == ((0.5, 1.0),)


def test_touching_spans_are_one():
    assert merge_intervals([(1.0, 1.5), (0.0, 0.5), (0.5, 1.0), (3.0, 4.0)]) == ((0.0, 1.5), (3.0, 4.0))

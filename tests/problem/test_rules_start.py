"""Starts fitted to the first measured points, or at rest in the shape that these show; errors of predictions."""

import math
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import scipy.optimize
from scipy.spatial.transform import Rotation
from small_problems import H, efforts, elbow, joints, measured, pendulum_step, points, recording, seen, taken, tip

from yid_ocp.errors import DataError, ModelError
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import FlexibleSegment, Grasp, System, flexible_object
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.problem.initial_state_fit import InitialStateFitter, _speed
from yid_ocp.problem.predictions import rmse_unit_count_dicts_by_channel
from yid_ocp.sensors import sensor_function_with_jacobians
from yid_ocp.sensors.points import PointSensor

NAN = math.nan


@pytest.fixture(scope="module")
def step(urdf_folder):
    return pendulum_step(urdf_folder)


def at(node, q, std=1e-3, both=True, **more):
    """The elbow and the tip seen at some nodes."""
    value = np.array([np.concatenate([elbow(row), tip(row)]) if both else tip(row) for row in np.atleast_2d(q)])
    names = ("lower", "tip") if both else ("tip",)
    node = np.atleast_1d(node)
    return measured(points(*names), node, np.zeros(len(node)), value, np.full(value.shape, 1 / std), **more)


def solved(step, samples, window=0.02, posture=(), path=None, **values):
    theta = step.system.parameters.vector(values)
    path = np.zeros((30, len(step.system.prescribed))) if path is None else path
    return InitialStateFitter(step).fit_initial_state_to_points(np.array(posture), samples, theta, window, path)


def momentum_at(step, momentum, q, v):
    return momentum(step, np.asarray(q), np.asarray(v), step.system.parameters.vector())


@pytest.mark.parametrize(("std", "soft"), [(0.2, 1.0), (1.0, 1.0), (1.0, 0.1)])
def test_what_the_points_leave_open_has_the_least_elastic_energy(step, std, soft):
    """Springs of 6 and 3 N m/rad, a mean of 4.5: their prior is of half a radian at the mean stiffness."""
    target = np.array([0.6, -0.9])
    sample = at(0, target, std=std, both=False)

    def rows(q):
        prior = np.sqrt(np.array([6.0, 3.0]) / 4.5) / 0.5 * (q - 0.1)
        return np.concatenate([(tip(q) - tip(target)) / std, prior])

    best = scipy.optimize.least_squares(rows, [0.1, 0.1], xtol=1e-12)
    found = solved(step, [sample], **{"shoulder.stiffness": 6.0 * soft, "elbow.stiffness": 3.0 * soft})
    np.testing.assert_allclose(found.state[:2], best.x, atol=1e-4)


def test_known_joints_stay_where_they_are_known_to_be(urdf_folder):
    found = solved(pendulum_step(urdf_folder, driven=("shoulder",)), [at(0, [0.5, -0.4])], posture=[0.5])
    np.testing.assert_allclose(found.state[:2], [0.5, -0.4], atol=1e-4)
    prescribed = pendulum_step(urdf_folder, prescribed=("shoulder",))
    later = solved(prescribed, [at(2, [0.7, -0.4])], posture=[0.5], path=0.5 + 0.1 * np.arange(30.0)[:, None])
    np.testing.assert_allclose(later.state[1], -0.4, atol=1e-4)
    assert later.state[0] == 0.5, "the path's first value, whenever the points were seen"


def test_a_joint_without_a_spring_is_held_a_little(urdf_folder):
    loose = pendulum_step(urdf_folder, driven=("elbow",))
    hidden = measured(points("lower"), [0], [0.0], [elbow([0.3, 0.0])], np.full((1, 3), 1e3))
    np.testing.assert_allclose(solved(loose, [hidden], posture=[0.7]).state[:2], [0.3, 0.7], atol=1e-4)


def test_two_frames_give_a_velocity_and_the_start_before_the_first(step, momentum):
    q, v = np.array([0.6, -0.9]), np.array([0.8, -1.5])
    found = solved(step, [at([1, 2], [q + v * H, q + 2 * v * H], std=1e-4)], window=0.02)
    np.testing.assert_allclose(found.state[:2], q, atol=2e-3)
    np.testing.assert_allclose(found.state[2:], momentum_at(step, momentum, q, v), rtol=2e-2)


def test_only_frames_within_the_window_count_and_only_the_first_and_last(step, momentum):
    q, v = np.array([0.6, -0.9]), np.array([0.8, -1.5])
    nodes = np.array([0, 1, 2, 3])
    turned = np.array([q, q + 0.3, q + 2 * v * H, q + 0.5])
    found = solved(step, [at(nodes, turned, std=1e-4)], window=0.02)
    np.testing.assert_allclose(found.state[:2], q, atol=1e-4)
    np.testing.assert_allclose(found.state[2:], momentum_at(step, momentum, q, v), rtol=2e-2)
    one = solved(step, [at(nodes, turned, std=1e-4)], window=0.004)
    np.testing.assert_allclose(one.state[:2], q, atol=1e-4)
    assert np.linalg.norm(one.state[2:]) > np.linalg.norm(found.state[2:]), "at least one step"


def test_frames_count_at_their_nearest_node_and_hidden_ones_do_not(step):
    q = np.array([0.6, -0.9])
    made = at([0, 1, 2], [q + 9, q, q + 0.2])
    weight = made.weight.copy()
    weight[0] = 0.0
    late = replace(made, node=np.array([0, 0, 2]), fraction=np.array([0.0, 0.6, 0.0]), weight=weight)
    found = solved(step, [late], window=0.01)
    np.testing.assert_allclose(found.state[:2], q, atol=1e-4)
    assert not found.state[2:].any()
    assert found.fitted_parameters == {}


def test_a_rate_that_points_leave_open_is_small(step, momentum):
    """Three radians a second are one standard deviation."""
    q = np.array([0.6, -0.9])
    found = solved(step, [at([0, 2], [q, q + 0.1], std=0.05)])
    rows = [at(0, q, std=0.05), at(0, q + 0.1, std=0.05)]
    first = solved(step, rows[:1]).state[:2]

    def fit(x):
        seen_there = (np.concatenate([elbow(x), tip(x)]) - rows[1].value[0]) / 0.05
        return np.concatenate([seen_there, (x - first) / (3.0 * 2 * H)])

    then = scipy.optimize.least_squares(fit, first, xtol=1e-12).x
    np.testing.assert_allclose(found.state[2:], momentum_at(step, momentum, first, (then - first) / (2 * H)), rtol=1e-3)


def test_other_sensors_say_nothing_of_a_start_and_some_point_must(step):
    q = np.array([0.6, -0.9])
    effort = measured(efforts("shoulder"), [0], [0.0], [[9.0]], [[1e6]])
    np.testing.assert_allclose(solved(step, [effort, at(0, q)]).state[:2], q, atol=1e-4)
    with pytest.raises(DataError, match=r"no point is seen in the first 0\.02 s"):
        solved(step, [effort, at(3, q)])


TURN = "camera_rotation@camera.rx"


def test_parameters_are_fitted_along_with_the_start(urdf_folder):
    """The camera is turned: an arm that sees the same points tells by how much, up to the bounds."""
    step = pendulum_step(urdf_folder, (("camera_rotation", "camera", {}),))
    q, pose = np.array([0.6, -0.9]), tuple(map(tuple, np.eye(4).tolist()))
    lower, upper = step.system.parameters.lower_and_upper_bounds((TURN,))
    assert np.all(np.isfinite([*lower, *upper]))
    sharp = np.full((1, 6), 1e3)
    here = at(0, q)
    for turn in (0.0, 0.03, -0.05):
        value = np.concatenate([elbow(q), tip(q)]).reshape(2, 3)
        turned = value @ Rotation.from_rotvec([turn, 0, 0]).as_matrix().T
        camera = measured(points("lower", "tip", pose=pose, group="camera"), [0], [0.0], turned.reshape(1, 6), sharp)
        fitter, theta = InitialStateFitter(step, (TURN,)), step.system.parameters.vector()
        found = fitter.fit_initial_state_to_points(np.zeros(0), [here, camera], theta, 0.02, np.zeros((30, 0)))
        assert found.fitted_parameters[TURN] == pytest.approx(turn, abs=1e-4)
        np.testing.assert_allclose(found.state[:2], q, atol=1e-4)


def swung(step, seed=4, std=0.02):
    return taken(step, seed, camera=False)


def test_a_problem_fits_its_starts_once_at_its_own_parameters(step):
    options = ProblemOptions(initial_state="fitted_to_points", initial_state_fit_window=0.01)
    problem = EstimationProblem(step, [swung(step)], ("elbow.stiffness",), options, held_out=[swung(step, 5)])
    expected = solved(step, problem.episodes[0].measurements, 0.01)
    np.testing.assert_allclose(problem.episodes[0].fixed_initial_state.state, expected.state)
    moved = problem.evaluate([9.0], False)
    np.testing.assert_allclose(moved.episode_predictions[0].rollout.state[0], expected.state)
    assert moved.equilibrium_guesses == (None,)
    assert problem.held_out[0].fixed_initial_state is None
    [(held, result)] = problem.predict_held_out([9.0])
    own = solved(step, problem.held_out[0].measurements, 0.01, **{"elbow.stiffness": 9.0})
    np.testing.assert_allclose(held.fixed_initial_state.state, own.state)
    np.testing.assert_allclose(result.rollout.state[0], own.state)


def test_the_points_of_a_start_may_have_a_noise_of_their_own(step):
    usual = ProblemOptions(initial_state="fitted_to_points", initial_state_fit_window=0.01)
    sharp = replace(usual, start_point_noise_std=1e-4)
    states = []
    for options in (usual, sharp):
        problem = EstimationProblem(step, [swung(step)], ("elbow.stiffness",), options)
        states.append(problem.episodes[0].fixed_initial_state.state[:2])
        assert problem.episodes[0].measurements[0].weight[0, 0] == pytest.approx(50.0)
    misses = [np.linalg.norm(tip(q) - problem.episodes[0].measurements[0].value[0]) for q in states]
    assert misses[1] < misses[0]
    again = EstimationProblem(step, [swung(step)], ("elbow.stiffness",), sharp)
    exact = replace(again.episodes[0].measurements[0], weight=np.full((25, 3), 1e4))
    np.testing.assert_allclose(states[1], solved(step, [exact], 0.01).state[:2], atol=1e-9)


def test_known_starts_and_values_are_taken_as_they_are(step):
    state = np.array([0.3, 0.2, 0.05, -0.02])
    options = ProblemOptions(
        initial_state="fitted_to_points",
        known_initial_states={"run_4": state},
        parameters_by_recording={"run_4": {"elbow.rest": 0.5}},
    )
    problem = EstimationProblem(step, [swung(step)], ("elbow.stiffness",), options)
    np.testing.assert_array_equal(problem.evaluate([4.0], False).episode_predictions[0].rollout.state[0], state)
    theta = problem.predictor.theta_with_episode_values(problem.episodes[0], problem.theta)
    assert theta[problem.system.parameters.index("elbow.rest")] == 0.5
    assert problem.theta[problem.system.parameters.index("elbow.rest")] == 0.1
    start = problem.predictor.initial_state_and_derivative(problem.episodes[0], problem.theta)
    np.testing.assert_array_equal(start.state, state)
    assert (start.state_sensitivity.shape, start.equilibrium, start.failure_message) == ((4, 1), None, "")
    assert not start.state_sensitivity.any()
    short = replace(options, known_initial_states={"run_4": state[:3]})
    with pytest.raises(ModelError, match="known_start"):
        EstimationProblem(step, [swung(step)], ("elbow.stiffness",), short)


def test_an_estimated_start_is_offset_from_a_known_one(step):
    state = np.array([0.3, 0.2, 0.05, -0.02])
    options = ProblemOptions(initial_state="estimated", known_initial_states={"run_4": state})
    problem = EstimationProblem(step, [swung(step)], ("elbow.stiffness",), options)
    offset = np.array([0.01, 0.02, 0.003, 0.004])
    rollout = problem.evaluate(np.concatenate([[3.0], offset]), False).episode_predictions[0].rollout
    np.testing.assert_allclose(rollout.state[0], state + offset)
    start = problem.predictor.initial_state_and_derivative(problem.episodes[0], problem.theta, offset)
    np.testing.assert_allclose(start.state, state + offset)
    np.testing.assert_array_equal(start.state_sensitivity, np.hstack([np.zeros((4, 1)), np.eye(4)]))


def test_a_start_at_rest_that_does_not_exist_is_said(step):
    problem = EstimationProblem(step, [swung(step)], ("elbow.rest",), ProblemOptions())
    theta = problem.system.parameters.vector() * 1.0
    theta[problem.system.parameters.index("elbow.rest")] = 1e8
    start = problem.predictor.initial_state_and_derivative(problem.episodes[0], theta)
    assert start.failure_message.startswith("in 'run_4', no equilibrium")
    assert start.state_sensitivity.shape == (4, 1)
    assert not start.equilibrium.is_converged


@pytest.mark.parametrize(
    ("value", "span", "speed"),
    [
        ([[0, 0, 0, 0, 0, 0], [3, 4, 0, 0, 0, 0]], 0.5, math.sqrt(25 / 2) / 0.5),
        ([[0, 0, 0, 0, 0, 0], [3, 4, 0, NAN, 0, 0]], 0.5, 10.0),
        ([[0, 0, 0, 0, 0, 0], [3, 4, 0, 0, 0, 0]], 0.0, 0.0),
        ([[NAN] * 6, [0.0] * 6], 0.5, 0.0),
    ],
    ids=["two points", "one seen twice", "one frame", "none seen twice"],
)
def test_the_speed_of_a_start_is_that_of_points_seen_in_both_frames(value, span, speed):
    made = measured(points("a", "b"), [0, 1], [0.0, 0.0], value)
    other = measured(points("a", "b"), [0, 1], [0.0, 0.0], np.full((2, 6), 9.0))
    assert _speed([(made, 0)], [(made, 1), (other, 1)], span) == pytest.approx(speed)
    assert _speed([(made, 0)], [(other, 1)], span) == 0.0


def test_errors_are_euclidean_for_points_and_plain_for_efforts():
    tips = measured(points("a", "b"), [0, 1], [0.0, 0.0], [[0, 0, 0, 0, 0, 0], [0, 0, 0, NAN, 0, 0]])
    loads = measured(efforts("j"), [0, 1, 2], [0.0] * 3, [[1.0], [2.0], [NAN]])
    result = SimpleNamespace(
        predicted_outputs=(np.array([[3.0, 4, 0, 1, 0, 0], [0, 0, 1, 5, 5, 5]]), np.array([[4.0], [6.0], [9.0]]))
    )
    run = {"name": "run", "grid": SimpleNamespace(start_time=0.0, time_step=0.1)}
    found = rmse_unit_count_dicts_by_channel([result, result], [SimpleNamespace(**run, measurements=(tips, loads))] * 2)
    assert found == {
        "points.a": {"rmse": pytest.approx(math.sqrt(13.0)), "unit": "m", "n": 4},
        "points.b": {"rmse": 1.0, "unit": "m", "n": 2},
        "joints.effort.j": {"rmse": pytest.approx(math.sqrt(12.5)), "unit": "N m", "n": 4},
    }
    hidden = SimpleNamespace(**run, measurements=(measured(efforts("j"), [0], [0.0], [[NAN]]),))
    assert rmse_unit_count_dicts_by_channel([SimpleNamespace(predicted_outputs=(np.zeros((1, 1)),))], [hidden]) == {}


POSTURE = (0.5, 0.5)
TIP, GAP = (0.0, 0.576, 0.545), 0.55  # where the hand is, how far below the 0.6 m of rod begin [m]
MIDDLE = "T1:50%"


@pytest.fixture(scope="module")
def buckled(robot):
    """The step, and the state of the shape of least energy and of its mirror image."""
    rod = flexible_object([FlexibleSegment("T1", 0.6, 0.1, 0.02, links=3, bend=4.0, twist=3.0)])
    placement = np.eye(4)
    placement[:3, 3] = np.array(TIP) - [0.0, 0.0, GAP]
    system = System.build(
        robot,
        objects=[(rod, None, placement)],
        grasps=[Grasp("hand", "tip", "w_T1", "point")],
        prescribed=["shoulder", "elbow"],
        point_frames=["w_T1", MIDDLE],
    )
    step = compile_step(system, 0.01, use_compiler=False)
    statics, theta = EquilibriumSolver(step), system.parameters.vector()
    least = statics.solve(POSTURE, theta)
    across = least.state[: system.n_coordinates].copy()
    across[2:] *= -1.0
    mirrored = statics.solve(POSTURE, theta, None, across)
    assert least.is_converged
    assert mirrored.is_converged
    assert np.abs(least.state - mirrored.state).max() > 0.5
    return step, least.state, mirrored.state


def rod_problem(step, state, first=0.1, std=1e-3, **options):
    """A recording of the rod at rest, its middle seen from `first` seconds on."""
    n, t = step.system.n_coordinates, 0.01 * np.arange(int(100 * (first + 0.3)))
    sensor = PointSensor("points_camera", (MIDDLE,), (MIDDLE,), None)
    function = sensor_function_with_jacobians(step.system, sensor, ())
    place = np.array(function(q=state[:n], theta=step.system.parameters.vector())["y"])
    late = t[t >= first - 1e-9]
    place = np.tile(place.ravel(), (len(late), 1, 1))
    camera = seen([MIDDLE], late, place, "points_camera", std=np.full(place.shape, std))
    made = recording(joints(["shoulder", "elbow"], t, np.tile(POSTURE, (len(t), 1))), camera)
    settings = ProblemOptions(weak_prior_geometric_std=0.0, path_cutoff=np.inf, **options)
    return EstimationProblem(step, [made], ("T1.bend",), settings, held_out=[made])


@pytest.mark.parametrize("which", [1, 2], ids=["least_energy", "mirrored"])
def test_a_recording_starts_in_the_shape_that_its_first_points_show(buckled, which, monkeypatch):
    step, *states = buckled
    problem = rod_problem(step, states[which - 1])
    assert np.abs(problem.evaluate(problem.initial_unknowns).residual).max() < 0.05
    np.testing.assert_allclose(problem.episodes[0].equilibrium_guess, states[which - 1][:11], atol=1e-6)
    [(_, held)] = problem.predict_held_out(problem.initial_unknowns)
    np.testing.assert_allclose(held.rollout.state[0], states[which - 1], atol=1e-6)
    # a shape found with other parameters may be on the wrong side at these
    wrong = [replace(problem.episodes[0], equilibrium_guess=states[2 - which][:11])]
    wrong = problem.with_episodes(wrong, wrong)
    assert np.ptp(wrong.predict_held_out(problem.initial_unknowns)[0][1].rollout.state[0] - states[which - 1]) < 1e-5
    right = wrong.with_equilibria_near_first_points({}).episodes[0].equilibrium_guess
    np.testing.assert_allclose(right, states[which - 1][:11], atol=1e-6)
    if which == 2:  # its mirror image is tried, too, where no shape can be fitted; and it stays with other stiffnesses
        fitted = Mock(side_effect=DataError("no shape", hint=""))
        monkeypatch.setattr(InitialStateFitter, "fit_initial_state_to_points", fitted)
        assert np.ptp(rod_problem(step, states[1]).episodes[0].equilibrium_guess - states[1][:11]) < 1e-6
        assert [int(samples.node[0]) for samples in fitted.call_args.args[1]] == [0]  # where the prescribed path begins
        moved = problem.evaluate(2.0 * problem.initial_unknowns)
        np.testing.assert_allclose(moved.episode_predictions[0].rollout.state[0][:5], states[1][:5], atol=0.05)


def test_points_that_come_late_decide_too_and_a_small_error_of_them_does_not(buckled):
    step, least, mirrored = buckled
    for state in (mirrored, least):
        found = rod_problem(step, state, first=1.1).episodes[0].equilibrium_guess
        np.testing.assert_allclose(found, state[:11], atol=1e-6)
    found = rod_problem(step, mirrored, std=0.2).episodes[0].equilibrium_guess
    np.testing.assert_allclose(found, least[:11], atol=1e-6)
    assert rod_problem(step, least, first=0.0, initial_state="fitted_to_points").held_out[0].equilibrium_guess is None

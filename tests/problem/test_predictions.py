"""What the sensors would have recorded, channels measured beside predicted, and baselines without a model."""

import math
from dataclasses import replace

import numpy as np
import pytest
from small_problems import PENDULUM, H, pendulum_step, taken

import yid_ocp as yid
from yid_ocp.data.recording import PointGroup, Recording
from yid_ocp.errors import ConfigError, DataError
from yid_ocp.model.objects.base import CableVertices
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.problem.predictions import _noisy, naive_cable_predictions, rmse_unit_count_dicts_by_channel

FREE = ["elbow.stiffness", "elbow.damping"]


@pytest.fixture(scope="module")
def problem(urdf_folder):
    step = pendulum_step(urdf_folder, prescribed=("shoulder",))
    return EstimationProblem(step, [taken(step, 1)], FREE, ProblemOptions(path_cutoff=np.inf))


def test_what_is_simulated_is_what_is_found(problem):
    truth = {"elbow.stiffness": 4.2, "elbow.damping": 0.31}
    made = problem.simulate_synthetic_recording(truth)
    assert made.name == "run_1_simulated"
    assert {name: made.true_parameters[name] for name in FREE} == truth
    assert np.array_equal(made.points[0].t, problem.episodes[0].recording.points[0].t)
    again = EstimationProblem(problem.step, [made], FREE, problem.options)
    solution, at_truth = yid.solve(again), again.evaluate(again.pack_unknowns(truth), derivatives=False)
    assert np.abs(at_truth.residual[again.residual_rows.data]).max() < 1e-9
    for name, value in truth.items():
        # but for the weak prior
        assert solution.parameters[name].value == pytest.approx(value, rel=0.02)


def test_its_own_values_without_any_and_noise_by_its_seed(problem):
    plain, first, same, other = (problem.simulate_synthetic_recording(seed=seed) for seed in (None, 3, 3, 4))
    own = problem.evaluate(problem.initial_unknowns, derivatives=False).episode_predictions[0]
    [samples] = [s for s in problem.episodes[0].measurements if s.sensor.group_name == plain.points[0].name]
    predicted = own.predicted_outputs[problem.episodes[0].measurements.index(samples)]
    where = samples.positive_weight_mask
    assert np.allclose(plain.points[0].position.reshape(predicted.shape)[where], predicted[where], atol=1e-12)
    assert np.array_equal(first.points[0].position, same.points[0].position, equal_nan=True)
    assert not np.array_equal(first.points[0].position, other.points[0].position, equal_nan=True)
    spread = np.nanstd(first.points[0].position - plain.points[0].position)
    assert spread == pytest.approx(float(np.nanmedian(samples.std)), rel=0.3)


READ = {
    "effort_offset@shoulder.offset": 0.7,
    "effort_gain@elbow.inverse": 0.8,
    "effort_delay@gripper.delay": 0.023,
    "effort_lag@elbow.time_constant": 0.03,
    "encoder_offset@shoulder.offset": 0.05,
}


@pytest.mark.parametrize("how", ["prescribed", "driven"])
def test_simulated_joints_are_read_with_the_errors_of_the_effects(urdf_folder, how):
    effects = [(*name.rpartition(".")[0].split("@"), {}) for name in READ]
    step = pendulum_step(urdf_folder, effects, **{how: PENDULUM})
    own = {"arm_tracking_feedback": "none", "sensors": {"joints.effort": SensorOptions(std=0.01)}}
    options, source = ProblemOptions(path_cutoff=np.inf, **own), taken(step, 1, steps=200, camera=how == "driven")
    made = EstimationProblem(step, [source], list(READ), options).simulate_synthetic_recording(READ)
    again = EstimationProblem(step, [made], list(READ), options)
    costs = [again.evaluate(again.pack_unknowns(values), derivatives=False).cost for values in (READ, {})]
    assert costs[0] < 1e-3 * costs[1]


def test_points_outside_the_duration_are_not_simulated(urdf_folder):
    step = pendulum_step(urdf_folder)
    recorded = taken(step, 1)
    arm, camera = recorded.points
    late = replace(recorded, points=(arm, replace(camera, t=camera.t + 10.0)))
    made = EstimationProblem(step, [late], ["elbow.damping"]).simulate_synthetic_recording(seed=1)
    assert [group.name for group in made.points] == [arm.name]


def test_simulated_joints_without_efforts_may_have_stated_noise(urdf_folder):
    step = pendulum_step(urdf_folder, prescribed=PENDULUM)
    bare = replace(bare := taken(step, 1, efforts=False), joints=replace(bare.joints, effort_std=None))
    for std in (0.3, None):  # a fit cannot use efforts whose noise is not stated
        options = ProblemOptions(path_cutoff=20.0, sensors={"joints.effort": SensorOptions(std=std)})
        made = EstimationProblem(step, [bare], ["elbow.damping"], options).simulate_synthetic_recording(seed=1).joints
        assert (made.effort is None) == (std is None)
        assert np.all(made.effort_std == std)


@pytest.mark.parametrize("how", [{"prescribed": PENDULUM}, {"driven": ("shoulder",), "prescribed": ("elbow",)}])
def test_simulated_joints_are_as_noisy_as_was_stated(urdf_folder, how):
    step = pendulum_step(urdf_folder, **how)
    source = replace(source := taken(step, 1), joints=replace(source.joints, effort_bias_std=0.5))
    problem = EstimationProblem(step, [source], ("elbow.mass",), ProblemOptions(path_cutoff=np.inf))
    plain, *many = (problem.simulate_synthetic_recording(seed=seed).joints for seed in (None, *range(40)))
    angle, effort = (np.array([getattr(one, name) for one in many]) for name in ("position", "effort"))
    angle, effort = angle - plain.position, effort - plain.effort
    np.testing.assert_allclose(np.std(angle, axis=(0, 1)), 1e-3, rtol=0.1)
    constant = effort.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(np.std(effort - constant, axis=(0, 1)), 0.3, rtol=0.1)
    # of what drives the motion one constant a recording
    stated = np.array([0.5, 0.0] if "driven" in how else [0.0, 0.0])
    np.testing.assert_allclose(np.std(constant, axis=(0, 1)), np.hypot(stated, 0.3 / 5), rtol=0.3)
    levels = plain.position_std, plain.effort_std, 0.0 if plain.effort_bias_std is None else plain.effort_bias_std
    np.testing.assert_allclose(np.array(np.broadcast_arrays(*levels, stated)[:3]), [[1e-3] * 2, [0.3] * 2, stated])
    assert np.array_equal(plain.effort[-1], plain.effort[-2])
    assert plain.effort_kind == ("command" if "driven" in how else "sample")


def test_what_has_no_stated_noise_is_simulated_without(urdf_folder):
    step = pendulum_step(urdf_folder, prescribed=PENDULUM)
    source = replace(source := taken(step, 1), joints=replace(source.joints, position_std=None))
    problem = EstimationProblem(step, [source], ("elbow.mass",), ProblemOptions(path_cutoff=np.inf))
    plain, noisy = (problem.simulate_synthetic_recording(seed=seed).joints for seed in (None, 1))
    np.testing.assert_array_equal(noisy.position, plain.position)
    assert np.std(noisy.effort - plain.effort) == pytest.approx(0.3, rel=0.3)


def test_noise_that_is_not_finite_is_none():
    std, rng = np.array([[0.5, np.nan, np.inf]]), np.random.default_rng(0)
    moved = _noisy(np.zeros((200, 3)), np.broadcast_to(std, (200, 3)), rng)
    assert np.std(moved[:, 0]) == pytest.approx(0.5, rel=0.2)
    assert not moved[:, 1:].any()


def test_a_parameter_that_is_not_there_or_beyond_a_bound_is_named(problem):
    with pytest.raises(ConfigError, match=r"(?s)no parameter 'elbow\.stifness'.*did you mean 'elbow\.stiffness'\?"):
        problem.simulate_synthetic_recording({"elbow.stifness": 1.0})
    with pytest.raises(ConfigError, match=r'-3 N m/rad lies below its lower bound of 0[^"]*allowed: at least 0 N'):
        problem.simulate_synthetic_recording({"elbow.stiffness": -3})


def test_residuals_are_those_of_the_result(problem):
    solution = yid.solve(problem, yid.GaussNewton())
    errors = rmse_unit_count_dicts_by_channel(solution.episode_predictions, problem.episodes)
    found = solution.channel_measurements_and_predictions()
    assert {entry.channel: entry.rmse for entry in found} == pytest.approx({k: v["rmse"] for k, v in errors.items()})
    for entry in found:
        assert entry.unit == errors[entry.channel]["unit"]
        assert entry.t.shape == (len(entry.measured),)
        assert entry.measured.shape == entry.predicted.shape == entry.noise_std.shape
        assert np.array_equal(entry.predicted_minus_measured, entry.predicted - entry.measured, equal_nan=True)
    tip = next(entry for entry in found if entry.channel.endswith(".tip"))
    group = problem.episodes[0].recording.points[0]
    assert np.allclose(tip.t, group.t)
    assert np.allclose(tip.measured, group.position[:, group.names.index("tip")], equal_nan=True)


@pytest.fixture(scope="module")
def solution(problem):
    return yid.solve(problem)


def test_the_method_that_is_not_named_is_gauss_newton(problem, solution):
    assert solution.solver_name == "gauss_newton"
    assert np.array_equal(solution.x, yid.solve(problem, yid.GaussNewton()).x)
    with pytest.raises(ConfigError, match=r"(?s)the text 'gauss_newton'.*yid_ocp\.GaussNewton\(\)"):
        yid.solve(problem, "gauss_newton")


def test_a_value_that_cannot_be_found_is_not_shown(solution):
    for entry in solution.parameters.values():
        assert repr(entry).startswith("<ParameterEstimate: –") == (entry.verdict == "not_identifiable")


PARENT = ("p0", "p1", "p2", "p3", "p4")
NAMES = (*PARENT, "c1", "c2")
CHILDREN = {"c": ("p2", "c1", "c2")}


@pytest.fixture
def recording():
    """A straight chain along x with a child; its left end rises by 1 mm a frame, its right end by 3 mm."""
    frames = 11
    at = np.zeros((frames, len(NAMES), 3))
    at[:, :5, 0] = [0.0, 0.1, 0.2, 0.4, 0.5]
    at[:, 5:] = [[0.2, 0.1, 0.0], [0.2, 0.2, 0.0]]
    rise = 1e-3 * np.arange(frames)
    at[:, 0, 2], at[:, 4, 2] = rise, 3 * rise
    return Recording(points=(PointGroup("points", NAMES, 0.01 * np.arange(frames), at),), name="made")


CABLE = CableVertices(PARENT, CHILDREN, dict.fromkeys(NAMES, (0.0, 0.0, 0.0)))


def test_stay_repeats_the_last_given_frame(recording):
    predicted = naive_cable_predictions(recording, CABLE, NAMES)["stays"]
    np.testing.assert_array_equal(predicted[:2], recording.point_positions(NAMES)[:2])
    np.testing.assert_array_equal(predicted[2:], np.broadcast_to(predicted[1], (9, 7, 3)))


def test_all_points_move_with_the_mean_of_the_clamps(recording):
    predicted = naive_cable_predictions(recording, CABLE, ("p2", "c1"))["moves_with_clamps"]
    # the clamps hold p0, p1, p3 and p4
    np.testing.assert_allclose(predicted[-1, :, 2], 1e-3 * 9)
    np.testing.assert_allclose(predicted[-1, :, :2], [[0.2, 0.0], [0.2, 0.1]])


def test_linear_carry_interpolates_along_the_arc_and_children_follow_their_junction(recording):
    predicted = naive_cable_predictions(recording, CABLE, ("p1", "p2", "p3", "c1", "c2"))["linear_carry"]
    # arc length as in the last given frame; the ends' heights differ by 2 mm there, which lengthens the chain by 1e-5
    np.testing.assert_allclose(predicted[-1, :, 2] / 9e-3, [1.4, 1.8, 2.6, 1.8, 1.8], rtol=1e-3)


def test_linear_carry_between_inner_points_holds_the_ends_beyond_them(recording):
    predicted = naive_cable_predictions(recording, CABLE, ("p2",), ("p0", "p1", "p4"))["linear_carry"]
    np.testing.assert_allclose(predicted[-1, 0, 2], 3 * 9e-3 * 0.25, rtol=1e-3)


def test_baselines_never_look_at_free_points_after_the_given_frames(recording):
    seen = recording.points[0].position.copy()
    seen[2:, 2] += 7.0
    seen[2:, 5:] += 7.0
    other = Recording(points=(PointGroup("points", NAMES, recording.points[0].t, seen),), name="other")
    free = ("p2", "c1", "c2")
    found, expected = (naive_cable_predictions(which, CABLE, free) for which in (other, recording))
    assert set(found) == {"stays", "moves_with_clamps", "linear_carry"}
    for name, predicted in found.items():
        np.testing.assert_array_equal(predicted[2:], expected[name][2:])


def test_points_of_another_group_are_taken_at_the_times_of_the_predicted_ones(recording):
    [group] = recording.points
    fast = PointGroup("points_p", NAMES[:5], group.t, group.position[:, :5])
    slow = PointGroup("points_c", NAMES[5:], group.t[::2], group.position[::2, 5:])
    found = naive_cable_predictions(Recording(points=(fast, slow), name="two"), CABLE, NAMES[5:])
    np.testing.assert_allclose(found["moves_with_clamps"][-1, :, 2], 1e-3 * 8)
    np.testing.assert_allclose(found["linear_carry"][-1, :, 2] / 8e-3, 1.8, rtol=1e-3)


def test_what_cannot_be_predicted_is_said(recording):
    with pytest.raises(DataError, match="there is no point"):
        naive_cable_predictions(recording, CABLE, ("p9",))
    seen, t = recording.points[0].position.copy(), recording.points[0].t
    short = Recording(points=(PointGroup("points", NAMES, t[:2], seen[:2]),), name="short")
    with pytest.raises(DataError, match="have 2 samples only"):
        naive_cable_predictions(short, CABLE, ("p2",))
    seen[1, 2] = np.nan
    hidden = Recording(points=(PointGroup("points", NAMES, t, seen),), name="hidden")
    with pytest.raises(DataError, match="'p2' is not seen"):
        naive_cable_predictions(hidden, CABLE, ("p2",))


@pytest.fixture
def driven(urdf_folder):
    """driven(steps): a pendulum whose shoulder is driven, and what is recorded of it."""
    step = pendulum_step(urdf_folder, driven=("shoulder",))
    return lambda steps=24: (step, taken(step, 3, steps=steps))


def sprung(step, recording, **options):
    made = ProblemOptions(arm_tracking_feedback="proportional", arm_proportional_gains=(9.0,), **options)
    return EstimationProblem(step, [recording], ("elbow.stiffness",), made)


@pytest.mark.parametrize(
    ("arm", "use", "expected"), [(True, None, False), (False, None, True), (False, False, False), (False, True, True)]
)
def test_encoders_are_measurements_where_no_point_of_the_arm_is(driven, arm, use, expected):
    step, made = driven()
    group = replace(made.points[0], sensor_name="arm")
    made = replace(made, points=(group, made.points[1]) if arm else made.points[1:])
    problem = sprung(step, made, sensors={} if use is None else {"joints.position": SensorOptions(use=use)})
    found = [s for s in problem.episodes[0].measurements if s.sensor.group_name == "joints.position"]
    assert bool(found) == expected
    assert problem.episodes[0].input_errors.has_encoder_measurements == expected
    if expected:
        # the first angle is where the rollout starts
        assert found[0].node[0] == 1
        np.testing.assert_allclose(found[0].std, 1e-3)


def test_encoders_beside_points_of_the_arm_are_refused(driven):
    step, made = driven()
    made = replace(made, points=(replace(made.points[0], sensor_name="arm"),))
    with pytest.raises(ConfigError, match=r"points_arm.*both") as caught:
        sprung(step, made, sensors={"joints.position": SensorOptions(use=True)})
    assert "sensors.points_arm.use: false" in caught.value.hint


@pytest.mark.parametrize("said", [0.02, None])
def test_noise_that_nobody_states_is_read_from_the_recording(driven, said, caplog):
    (step, made), rng = driven(400), np.random.default_rng(1)
    noisy = made.joints.effort + 0.02 * rng.standard_normal(made.joints.effort.shape)
    with caplog.at_level("WARNING"):
        problem = sprung(step, replace(made, joints=replace(made.joints, effort=noisy, effort_std=said)))
    assert problem.episodes[0].input_errors.torque_std[0] == pytest.approx(0.02, rel=0.15)
    assert ("neither recorded nor configured" in caplog.text) == (said is None)


def test_torques_beside_encoders_are_never_exact_and_steps_average_their_samples(driven):
    step, made = driven()
    problem = sprung(step, replace(made, joints=replace(made.joints, effort_std=0.0), points=made.points[1:]))
    assert problem.episodes[0].input_errors.torque_std[0] == pytest.approx(1e-3 * np.std(made.joints.effort))
    step, made = driven(48)
    problem = sprung(step, replace(made, joints=replace(made.joints, t=1.0 + 0.5 * (made.joints.t - 1.0))))
    errors = problem.episodes[0].input_errors
    assert errors.torque_std[0] == pytest.approx(0.3 * math.sqrt(0.5))
    assert problem.episodes[0].grid.time_step == H
    assert len(np.unique(errors.sample_of_step)) == problem.episodes[0].grid.steps


@pytest.mark.parametrize("late", [0.03, -0.012])
def test_a_late_or_early_group_of_points_is_found_by_its_name(urdf_folder, late):
    """Motion capture beside encoders, on clocks that differ: by what it sees, whichever of them is the late one."""
    latency = "camera_latency@points_mocap"
    step = pendulum_step(urdf_folder, [("camera_latency", "points_mocap", {})], prescribed=("shoulder",))
    source = taken(step, 1, camera=False, steps=150)
    [group] = source.points
    source = replace(source, points=(replace(group, name="points_mocap", sensor_name="mocap", std=1e-3),))
    options, free = ProblemOptions(path_cutoff=np.inf), ("elbow.damping", f"{latency}.delay")
    true = EstimationProblem(step, [source], free, options).simulate_synthetic_recording(seed=3)
    [seen] = true.points
    made = replace(true, points=(replace(seen, t=seen.t + late),))
    solution = yid.solve(EstimationProblem(step, [made], free, options))
    entry = solution.parameters[f"{latency}.delay"]
    assert abs(entry.value - late) < 3 * entry.std < 0.01
    damping = solution.parameters["elbow.damping"]
    assert abs(damping.value - 0.2) < 3 * damping.std
    assert solution.goodness_of_fit.explains

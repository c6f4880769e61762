"""Errors of efforts and clocks that are constant over a recording are noise of all its samples together."""

import math
from dataclasses import replace

import numpy as np
import pytest
from small_problems import H, pendulum_step, taken

from yid_ocp.analysis import estimation
from yid_ocp.inference.whitening import problem_with_whitening_at
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.problem.evaluation import episode_residual_and_jacobian
from yid_ocp.problem.measurements import (
    measurements_minus_sensor_error_estimates,
    whiten_with_extra_errors,
    whitened_measurement_sensitivities_to_sensor_errors,
)
from yid_ocp.problem.options import SensorOptions
from yid_ocp.solvers import GaussNewton, MultipleShooting, fit_problem

BIAS = {"shoulder": 0.4, "elbow": 0.2}  # [N m]
OFFSETS = {f"effort_offset@{joint}.offset": std for joint, std in BIAS.items()}


def options(bias=None, **more):
    # accelerations of an unsmoothed path would drown the constants, were the encoders any worse
    sensors = {"joints.effort": SensorOptions(bias_std=bias), "joints.position": SensorOptions(std=1e-4)}
    return ProblemOptions(path_cutoff=math.inf, weak_prior_geometric_std=0.0, sensors=sensors, **more)


def arm(folder, bias, free, recordings=2, **how):
    """A double pendulum of which recordings say no constant error, stated as noise or free beside its prior."""
    step = pendulum_step(folder, [("effort_offset", joint, {}) for joint in BIAS], **how)
    recorded = [taken(step, seed) for seed in range(recordings)]
    if bias is not None:
        return EstimationProblem(step, recorded, free, options(bias), held_out=[taken(step, 9)])
    local = options(local_parameters=tuple(OFFSETS), prior_stds=OFFSETS)
    return EstimationProblem(step, recorded, (*free, *OFFSETS), local)


def least(problem, x):
    """The least cost over the offsets, in which it is square, and where."""
    own = [i for i, name in enumerate(problem.unknown_names) if name.startswith("effort_offset")]
    for _ in range(2):
        found = problem.evaluate(x)
        x = x.copy()
        x[own] -= np.linalg.lstsq(found.jacobian[:, own], found.residual, rcond=None)[0]
    return problem.evaluate(x, derivatives=False).cost, x


def test_the_map_is_that_of_generalised_least_squares():
    rng = np.random.default_rng(3)
    slopes, columns = rng.standard_normal((40, 3)) * [0.1, 2.0, 30.0], rng.standard_normal((40, 5))
    covariance = np.eye(40) + slopes @ slopes.T
    made = whiten_with_extra_errors(columns, slopes)
    np.testing.assert_allclose(made.T @ made, columns.T @ np.linalg.solve(covariance, columns), rtol=1e-9)


def test_a_stated_constant_is_what_an_offset_of_every_recording_beside_its_prior_would_be(urdf_folder):
    free = ("shoulder.damping", "elbow.mass")
    stated, spelt = (arm(urdf_folder, bias, free, prescribed=tuple(BIAS)) for bias in (BIAS, None))
    found, other = (fit_problem(problem, GaussNewton(), restarts=False) for problem in (stated, spelt))
    assert found.cost == pytest.approx(other.cost, rel=1e-9)
    for name in free:
        assert found.parameters[name].value == pytest.approx(other.parameters[name].value, rel=1e-3)
    shot = fit_problem(stated, MultipleShooting(max_iterations=1), restarts=False)
    assert "ignore constant errors" in shot.message
    plain = fit_problem(arm(urdf_folder, 0.0, free, prescribed=tuple(BIAS)), GaussNewton(), restarts=False)
    assert plain.cost > found.cost + 10.0


def test_beside_noise_that_drives_other_joints_too(urdf_folder):
    """One joint driven, the other prescribed: the filter's rows and the constants of the other's efforts together."""
    how = {"driven": ("shoulder",), "prescribed": ("elbow",)}
    step = pendulum_step(urdf_folder, [("effort_offset", "elbow", {})], **how)
    name = "effort_offset@elbow.offset"
    recorded = [taken(step, 4, camera=False)]
    sensors = {"joints.effort": SensorOptions(std=0.05, bias_std={"shoulder": 0.1, "elbow": 0.5})}
    given = ProblemOptions(path_cutoff=math.inf, weak_prior_geometric_std=0.0, sensors=sensors)
    stated = EstimationProblem(step, recorded, ("elbow.mass",), given)
    bare = replace(given, sensors={"joints.effort": SensorOptions(std=0.05, bias_std={"shoulder": 0.1, "elbow": 0.0})})
    spelt = EstimationProblem(step, recorded, ("elbow.mass", name), replace(bare, prior_stds={name: 0.5}))
    assert stated.episodes[0].has_biases_treated_as_noise
    assert not spelt.episodes[0].has_biases_treated_as_noise
    weighted, beside = (problem_with_whitening_at(problem, problem.initial_unknowns) for problem in (stated, spelt))
    assert weighted.whitening_filters[0] is not None
    expected, _ = least(beside, spelt.initial_unknowns)
    assert weighted.evaluate(stated.initial_unknowns).cost == pytest.approx(expected, rel=1e-6)


def test_the_gradient_is_that_of_the_cost(urdf_folder):
    problem = arm(urdf_folder, BIAS, ("shoulder.damping", "elbow.mass"), prescribed=tuple(BIAS))
    x = problem.initial_unknowns * 1.1
    _, gradient, _ = problem.cost_and_gradient(x)
    for i, size in enumerate(1e-5 * np.abs(x)):
        moved = size * np.eye(len(x))[i]
        rise = problem.evaluate(x + moved, False).cost - problem.evaluate(x - moved, False).cost
        assert gradient[i] == pytest.approx(rise / (2 * size), rel=1e-5)


def test_what_is_known_of_constants_is_taken_off_the_samples(urdf_folder):
    problem = arm(urdf_folder, BIAS, ("shoulder.damping",), prescribed=tuple(BIAS))
    spelt = arm(urdf_folder, None, ("shoulder.damping",), prescribed=tuple(BIAS))
    _, x = least(spelt, spelt.initial_unknowns)
    found = problem.evaluate(problem.initial_unknowns, derivatives=False)
    for i, (episode, result) in enumerate(zip(problem.episodes, found.episode_predictions, strict=True)):
        corrected = measurements_minus_sensor_error_estimates(episode.measurements, result.predicted_outputs)
        pairs = zip(episode.measurements, corrected, strict=True)
        [(before, after)] = [pair for pair in pairs if pair[0].sensor.effort_joints]
        offsets = [x[spelt.unknown_names.index(f"effort_offset@{joint}.offset[{episode.name}]")] for joint in BIAS]
        np.testing.assert_allclose(before.value - after.value, np.broadcast_to(offsets, before.value.shape), rtol=1e-6)
        assert not np.any(after.bias_std), i


def test_held_out_rows_count_it_and_rows_without_a_constant_stay(urdf_folder):
    problem = arm(urdf_folder, BIAS, ("shoulder.damping",), prescribed=tuple(BIAS))
    [(episode, result)] = problem.predict_held_out(problem.initial_unknowns)
    counted = episode_residual_and_jacobian(episode, problem.held_out_whitening_filters[0], result).residual
    pairs = zip(episode.measurements, result.predicted_outputs, strict=True)
    plain = np.concatenate([samples.residual_and_jacobian(y).residual for samples, y in pairs])
    slopes = whitened_measurement_sensitivities_to_sensor_errors(episode.measurements)
    rows = np.any(slopes != 0, axis=1)
    np.testing.assert_allclose(counted[~rows], plain[~rows], rtol=1e-14)
    covariance = np.eye(len(plain)) + slopes @ slopes.T
    assert counted @ counted == pytest.approx(plain @ np.linalg.solve(covariance, plain), rel=1e-9)


@pytest.mark.parametrize(
    ("free", "effects", "clock_offset_std", "group", "expected"),
    [
        ("elbow.damping", (), None, "points_mocap", H / 2),
        ("elbow.mass", (), None, "points_mocap", None),
        ("elbow.damping", (), None, "points_arm", None),
        ("elbow.damping", (), 0.0, "points_mocap", None),
        ("elbow.mass", (), 0.01, "points_mocap", 0.01),
        ("elbow.damping", (("camera_latency", "points_mocap", {}),), None, "points_mocap", None),
    ],
    ids=["half a sample", "no damper is free", "the arm's", "one clock", "as stated", "an effect of the model says it"],
)
def test_a_clock_is_uncertain_where_dampers_are_free(urdf_folder, free, effects, clock_offset_std, group, expected):
    step = pendulum_step(urdf_folder, effects, prescribed=tuple(BIAS))
    clock = SensorOptions(clock_offset_std=clock_offset_std)
    sensors = {"joints.position": SensorOptions(std=1e-4), "points_mocap": clock}
    told = ProblemOptions(sensors=sensors, has_uncertain_point_clocks=True)
    made = taken(step, 3, efforts=False, camera=False)
    made = replace(made, points=(replace(made.points[0], name=group),))
    problem = EstimationProblem(step, [made], (free,), told)
    [samples] = [own for own in problem.episodes[0].measurements if own.sensor.group_name == group]
    assert (samples.change_by_clock is None) is (expected is None)
    if expected is not None:
        rates = np.gradient(samples.value, H, axis=0)
        np.testing.assert_allclose(samples.change_by_clock, expected * rates, rtol=1e-6)


@pytest.mark.parametrize(("late", "std"), [(0.0, 0.1), (0.03, 0.1), (0.03, 0.001)])
def test_the_error_to_expect_contains_the_offset_of_a_clock_that_the_data_show(urdf_folder, late, std):
    """But no offset beyond three of its standard deviations."""
    step = pendulum_step(urdf_folder, prescribed=tuple(BIAS))
    sensors = {"joints.position": SensorOptions(std=1e-4), "points_mocap": SensorOptions(std=1e-4)}
    sensors["joints.effort"] = SensorOptions(use=False)
    made = taken(step, 3, efforts=False, camera=False)
    mocap = replace(made.points[0], name="points_mocap", std=None)
    first = EstimationProblem(step, [replace(made, points=(mocap,))], ("elbow.mass",), ProblemOptions(sensors=sensors))
    exact = first.simulate_synthetic_recording(seed=1)
    mocap = replace(exact.points[0], t=exact.points[0].t + late, clock_offset_std=std)
    exact = replace(exact, name="exact", points=(mocap,))
    problem = EstimationProblem(step, [made], ("elbow.mass",), ProblemOptions(sensors=sensors), held_out=[exact])
    [(_, outcome)], expected = estimation._predict_held_out_with_expected_errors(problem, problem.initial_unknowns)
    [samples] = problem.held_out[0].measurements
    error = np.sqrt(np.nanmean(np.sum((outcome.predicted_outputs[0] - samples.value) ** 2, axis=1)))
    assert (error > 3e-3) == (late > 0)
    assert expected["exact"]["points_mocap.tip"] == pytest.approx(error * min(1.0, 3 * std / max(late, std)), rel=0.15)

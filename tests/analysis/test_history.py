"""Runs side by side: means, drifts and the run to distrust, against closed forms and drawn estimates."""

import json
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import scipy.stats
from small_problems import PENDULUM, joints, pendulum_step, recording, seen

from yid_ocp.analysis.friction_law_comparison import (
    CrossValidatedFrictionLawFit,
    cross_validate_law_by_motion_kind,
    mean_and_std_error_over_motion_kinds,
    measured_and_predicted_friction_torques,
    recording_names_by_name_stem,
    simplest_fit_within_one_std_error,
)
from yid_ocp.analysis.run_estimates import (
    RunEstimates,
    assess_drift_and_outlier_runs,
    nearby_positive_definite_covariance,
    pool_estimates_and_chi2,
)
from yid_ocp.inference.uncertainty import value_and_uncertainty_text
from yid_ocp.model.servos_and_springs import ServoModelOptions
from yid_ocp.problem import EstimationProblem
from yid_ocp.solvers import GaussNewton, fit_problem

COVARIANCE = np.array([[4.0, 1.5], [1.5, 1.0]]) * 1e-4


def run(name, values, covariance=COVARIANCE, names=("a", "b")):
    return RunEstimates(name, names, np.asarray(values, float), np.asarray(covariance, float), {"a": "m", "b": "kg"})


def drawn(rng, mean, count):
    return [run(f"day{i}", rng.multivariate_normal(mean, COVARIANCE)) for i in range(count)]


def drifted(found):
    return [entry.name for entry in found.parameter_drift_tests if entry.has_drifted]


def outliers(found):
    return [entry.run_name for entry in found.run_outlier_tests if entry.is_outlier]


def test_two_runs_together_are_their_weighted_mean_also_without_full_rank():
    other = np.array([[1.0, -0.3], [-0.3, 2.0]]) * 1e-4
    first, second = run("x", [1.0, 2.0]), run("y", [1.003, 2.002], other)
    mean, chi2, degrees = pool_estimates_and_chi2([first, second])
    sum_of = np.linalg.inv(np.linalg.inv(COVARIANCE) + np.linalg.inv(other))
    expected = sum_of @ (np.linalg.inv(COVARIANCE) @ first.values + np.linalg.inv(other) @ second.values)
    apart = first.values - second.values
    assert mean.values == pytest.approx(expected, rel=1e-10)
    assert mean.covariance == pytest.approx(sum_of, rel=1e-8)
    assert chi2 == pytest.approx(apart @ np.linalg.solve(COVARIANCE + other, apart), rel=1e-8)
    assert (degrees, mean.run_name) == (2, "2 runs")
    alone, chi2, degrees = pool_estimates_and_chi2([first])
    assert (alone.run_name, chi2, degrees) == ("x", pytest.approx(0.0, abs=1e-20), 0)
    assert alone.covariance == pytest.approx(COVARIANCE, rel=1e-8)
    flat = np.array([[1.0, 1.0], [1.0, 1.0]]) * np.outer([1e-3, 1e4], [1e-3, 1e4])
    found = nearby_positive_definite_covariance(flat)
    assert np.sqrt(np.diag(found)) == pytest.approx([1e-3, 1e4], rel=1e-9)
    assert np.all(np.isfinite(np.linalg.cholesky(found)))
    tiny = COVARIANCE * 1e-16
    assert nearby_positive_definite_covariance(tiny) == pytest.approx(tiny, rel=1e-9, abs=0.0)
    assert np.diag(nearby_positive_definite_covariance(np.array([[4.0, 3.0], [3.0, 1.0]]))) == pytest.approx([4.0, 1.0])


def test_runs_that_differ_widen_the_mean_and_a_parameter_counts_where_it_is():
    mean, chi2, degrees = pool_estimates_and_chi2([run("x", [1.0, 2.0]), run("y", [1.5, 2.0])])
    assert chi2 > 50
    assert mean.std == pytest.approx(np.sqrt(np.diag(COVARIANCE) / 2 * chi2 / degrees), rel=1e-8)
    mean, _, degrees = pool_estimates_and_chi2([run("x", [1.0, 2.0]), run("y", [1.0], [[1e-4]], ("a",))])
    assert mean.parameter_names == ("a", "b")
    assert degrees == 1
    assert mean.std[0] < 0.01
    both, _, _ = pool_estimates_and_chi2([run("x", [1.0, 2.0]), replace(run("y", [1.0, 2.0]), is_fit_adequate=False)])
    assert (mean.is_fit_adequate, both.is_fit_adequate) == (True, False)


def test_without_drift_chi2_is_distributed_as_it_should_and_alarms_stay_at_their_level():
    rng = np.random.default_rng(3)
    found = [assess_drift_and_outlier_runs(drawn(rng, [1.0, 2.0], 3)).p_value for _ in range(40)]
    assert scipy.stats.kstest(found, "uniform").pvalue > 1e-3
    rng = np.random.default_rng(4)
    found = [assess_drift_and_outlier_runs(drawn(rng, [1.0, 2.0], 4), level=0.05) for _ in range(40)]
    assert np.mean([bool(drifted(entry)) for entry in found]) < 0.16
    assert np.mean([bool(outliers(entry)) for entry in found]) < 0.16


def test_each_run_is_tested_against_all_others_at_its_share_of_the_level():
    values = np.array([[1.0, 2.0], [1.03, 2.01], [0.98, 2.03]])
    runs = [run(f"day{i}", own) for i, own in enumerate(values)]
    found = assess_drift_and_outlier_runs(runs)
    assert (found.significance_level, found.degrees_of_freedom) == (0.01, 4)
    for i, entry in enumerate(found.run_outlier_tests):
        one, other = np.delete(values, i, axis=0)
        birge = max(1.0, (one - other) @ np.linalg.solve(2 * COVARIANCE, one - other) / 2)
        apart = values[i] - (one + other) / 2
        expected = apart @ np.linalg.solve(COVARIANCE * (1 + birge / 2), apart)
        assert (entry.chi2, entry.degrees_of_freedom) == (pytest.approx(expected, rel=1e-6), 2)
        assert entry.p_value == pytest.approx(scipy.stats.chi2.sf(expected, 2), rel=1e-5)
    for i, entry in enumerate(found.parameter_drift_tests):
        chi2 = np.sum((values[:, i] - values[:, i].mean()) ** 2) / COVARIANCE[i, i]
        assert (entry.chi2, entry.p_value) == pytest.approx((chi2, scipy.stats.chi2.sf(chi2, 2)), rel=1e-6)
        std = np.sqrt(COVARIANCE[i, i] / 3 * max(1, chi2 / 2))
        assert (entry.mean, entry.mean_std) == pytest.approx((values[:, i].mean(), std), rel=1e-6)
        shares = [assess_drift_and_outlier_runs(runs, level=share * entry.p_value) for share in (1.9, 2.1)]
        assert [drifted(share).count(entry.name) for share in shares] == [0, 1]
    strange = assess_drift_and_outlier_runs([*runs, run("z", [1.0], [[1.0]], ("c",))]).run_outlier_tests[-1]
    assert (strange.chi2, strange.degrees_of_freedom, strange.p_value) == (0.0, 0, 1.0)


def test_the_run_that_stands_apart_is_the_one_to_distrust():
    runs = drawn(np.random.default_rng(5), [1.0, 2.0], 4)
    runs[2] = run("day2", runs[2].values + np.array([0.2, 0.0]))
    found = assess_drift_and_outlier_runs(runs)
    assert (outliers(found), drifted(found)) == (["day2"], ["a"])


def test_a_steady_drift_and_two_runs_that_differ_make_no_outlier():
    found = assess_drift_and_outlier_runs([run(f"day{i}", [1.0, 2.0 + 0.05 * i]) for i in range(5)])
    assert ("b" in drifted(found), outliers(found)) == (True, [])
    found = assess_drift_and_outlier_runs([run("x", [1.0, 2.0]), run("y", [2.0, 2.0])])
    assert (drifted(found), outliers(found)) == (["a"], [])
    # the others differ too, but far less than from that one
    runs = [run(f"day{i}", [value, 2.0]) for i, value in enumerate((1.0, 1.1, 9.0, 1.2))]
    assert outliers(assess_drift_and_outlier_runs(runs)) == ["day2"]
    three = [run("x", [1.0, 2.0]), run("y", [1.08, 2.0]), run("z", [1.001, 2.0])]
    found = assess_drift_and_outlier_runs(three)
    assert outliers(found) == ["y"]
    p = next(entry.p_value for entry in found.run_outlier_tests if entry.is_outlier)
    assert [outliers(assess_drift_and_outlier_runs(three, level=share * p)) for share in (2.9, 3.1)] == [[], ["y"]]


KINDS = {"a": ("a_1", "a_2"), "b": ("b_1",), "c": ("c_1",)}


def fit_of(law: str, *errors: float) -> CrossValidatedFrictionLawFit:
    return CrossValidatedFrictionLawFit(law, dict(zip(("a_1", "a_2", "b_1", "c_1"), errors, strict=True)), "rad", True)


def test_kinds_weigh_alike_and_the_simplest_law_near_the_best_is_warranted():
    mean, error = mean_and_std_error_over_motion_kinds({"a_1": 1.0, "a_2": 3.0, "b_1": 5.0, "c_1": 8.0}, KINDS)
    assert mean == pytest.approx(5.0)
    assert error == pytest.approx(np.std([2.0, 5.0, 8.0], ddof=1) / np.sqrt(3))
    rough, good, best = fit_of("viscous", 9, 9, 8, 9), fit_of("coulomb", 3, 3, 2, 4), fit_of("stribeck", 2.8, 2.8, 2, 4)
    assert simplest_fit_within_one_std_error([rough, good, best], KINDS) is good
    far = fit_of("stribeck", 1, 1, 1.1, 0.9)
    assert simplest_fit_within_one_std_error([rough, good, far], KINDS) is far
    # the best has by chance the same error everywhere; the difference from it is less sure
    even, uneven = fit_of("stribeck", 2, 2, 2, 2), fit_of("coulomb", 1.7, 1.7, 2.1, 2.4)
    assert simplest_fit_within_one_std_error([rough, uneven, even], KINDS) is uneven
    # a small advantage in every kind counts although the kinds differ by more
    worse, better = fit_of("viscous", 9.1, 9.1, 5.1, 1.15), fit_of("coulomb", 9, 9, 5, 1)
    assert simplest_fit_within_one_std_error([worse, better], KINDS) is better
    assert simplest_fit_within_one_std_error([rough, fit_of("coulomb", float("nan"), 1, 1, 1), far], KINDS) is far


TRUTH = {
    "shoulder.servo_gain": 60.0, "shoulder.servo_damping": 4.0, "shoulder.servo_torque_limit": 9.0,
    "elbow.servo_gain": 25.0, "elbow.servo_damping": 1.5, "elbow.servo_torque_limit": 3.0,
    "joint_coulomb@shoulder.tau_c": 1.2,
}  # fmt: skip


@pytest.fixture(scope="module")
def dry(urdf_folder) -> EstimationProblem:
    """Three kinds of motion of an arm with dry friction, as its own model has them, and one with motors off."""
    step = pendulum_step(urdf_folder, [("joint_coulomb", "shoulder", {})], driven=PENDULUM, servos=ServoModelOptions())
    made = []
    t = 0.01 * np.arange(81)
    for name, rate in (("slow_1", 4.0), ("slow_2", 5.0), ("fast_1", 11.0), ("turn_1", 7.0)):
        command = 0.4 * np.sin(rate * t[:, None] + [0.0, 1.0]) + (0.5 * t[:, None] if name == "turn_1" else 0.0)
        group = joints(PENDULUM, t, command, position_command=command, position_std=1e-3)
        source = EstimationProblem(step, [recording(group, name=name)], ["shoulder.servo_gain"], None, TRUTH)
        made.append(source.simulate_synthetic_recording(seed=len(made)))
    off = joints(PENDULUM, t, np.zeros((81, 2)), effort=np.zeros((81, 2)), position_std=1e-3)
    names = ["joint_coulomb@shoulder.tau_c", "shoulder.servo_gain"]
    known = TRUTH | {"joint_coulomb@shoulder.tau_c": 0.6}
    found = [recording(m.joints, name=n) for m, n in zip(made, ("slow_1", "slow_2", "fast_1", "turn_1"), strict=True)]
    return EstimationProblem(step, [*found, recording(off, name="drop")], names, None, known)


def test_kinds_go_by_name_and_a_true_law_predicts_each_from_the_others_and_shows_in_the_torques(dry, monkeypatch):
    assert recording_names_by_name_stem(dry) == {"slow": ("slow_1", "slow_2"), "fast": ("fast_1",), "turn": ("turn_1",)}
    driven, folds, search = dry.with_episodes(dry.episodes[:-1], ()), [], GaussNewton.minimize_cost

    def searched(self, problem, start, callback):
        folds.append(tuple({e.name for e in group} for group in (problem.episodes, problem.held_out)))
        return search(self, problem, start, callback)

    solution = fit_problem(driven, GaussNewton(), restarts=False)
    monkeypatch.setattr(GaussNewton, "minimize_cost", searched)
    fit = cross_validate_law_by_motion_kind("coulomb", driven, solution, recording_names_by_name_stem(driven), Mock())
    names = {"slow_1", "slow_2", "fast_1", "turn_1"}
    assert folds == [(names - own, own) for own in ({"slow_1", "slow_2"}, {"fast_1"}, {"turn_1"})]
    assert (set(fit.left_out_errors), fit.unit) == (names, "rad")
    assert all(error < 1.3e-3 for error in fit.left_out_errors.values())
    assert solution.parameters["joint_coulomb@shoulder.tau_c"].value == pytest.approx(1.2, abs=0.05)
    [cloud] = measured_and_predicted_friction_torques(driven, solution, ["joint_coulomb@shoulder.tau_c"])
    assert (cloud.joint, cloud.speed.shape, cloud.load.shape) == ("shoulder", (4 * 79,), (4 * 79,))
    assert len(np.unique(cloud.speed)) == 4 * 79, "every point of the motion once"
    moving = np.abs(cloud.speed) > 0.5
    # friction is against the motion, in the data as in the law
    assert np.median(cloud.measured[moving] * np.sign(cloud.speed[moving])) == pytest.approx(1.2, abs=0.15)
    assert np.median(cloud.predicted[moving] * np.sign(cloud.speed[moving])) == pytest.approx(1.2, abs=0.05)


def test_laws_of_an_arm_that_moves_as_measured_are_judged_by_its_efforts(urdf_folder):
    step, made = pendulum_step(urdf_folder, [("joint_coulomb", "elbow", {})], prescribed=PENDULUM), []
    law, t = "joint_coulomb@elbow.tau_c", 0.01 * np.arange(201)
    for seed, rate in enumerate((4.0, 5.0)):
        angle, known = 0.4 * np.sin(rate * t[:, None] + [0.0, 1.0]), {"effort_std": 0.01, "effort_kind": "sample"}
        group = joints(PENDULUM, t, angle, effort=0 * angle, position_std=0.0, **known)
        problem = EstimationProblem(step, [recording(group)], [law], None, {law: 0.4})
        drawn = problem.simulate_synthetic_recording(seed=seed)
        moved = replace(drawn.joints, effort=drawn.joints.effort + 0.3, effort_bias_std=1.0)
        far = seen(["tip"], t, np.full((201, 1, 3), 9.0), std=np.full((201, 1, 3), 1e-3))
        made.append(recording(moved, far, name=f"run {seed}"))
    problem, kinds = EstimationProblem(step, made, [law]), {"one": ("run 0",), "other": ("run 1",)}
    fit = cross_validate_law_by_motion_kind("coulomb", problem, fit_problem(problem, restarts=False), kinds, Mock())
    assert (fit.unit, fit.left_out_errors) == ("std", pytest.approx({"run 0": 1.1, "run 1": 1.1}, abs=0.2))


def test_the_command_says_which_law_a_real_servo_warrants(cli, repository, shared, tmp_path: Path) -> None:
    folder = shared / "recordings" / "servo_pendulum"
    if not folder.is_dir():
        pytest.skip("the real recordings are not here (shared/recordings beside the project)")
    files = ", ".join(str(folder / f"{kind}_400.h5") for kind in ("sines", "sweep", "lift", "drop"))
    settings = ("problem.duration=0.8", "problem.time_step=0.04", "sensors.joints.position.std=0.01")
    settings = (*settings, "recordings={held_out: []}", f"recordings.estimate=[{files}]")
    more = [part for setting in settings for part in ("--set", setting)]
    done = cli("friction", repository / "configs" / "servo_pendulum.yaml", "--out", tmp_path / "run", *more)
    assert done.code in (0, 1), done.err
    assert "24 of 24, law 'load_stribeck' fitted to the other motions" in done.err, "six laws, four fits each"
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert set(result["kinds"]) == {"sines", "sweep", "lift"}
    assert set(result["laws"]) == {"viscous", "coulomb", "stribeck", "presliding", "load", "load_stribeck"}
    assert f"friction: {{law: {result['warranted']}, joints: [joint]}}" in done.out
    assert result["laws"]["load"]["mean_error"] < result["laws"]["viscous"]["mean_error"]
    gain, use = result["laws"][result["warranted"]]["parameters"]["joint.servo_gain"], result["to_use"]
    told = f"joint.servo_gain = {value_and_uncertainty_text(gain['value'], gain['std'], least_digits=2)} N m/rad"
    assert (told in use["values"], use["uncounted_errors"]) == (True, []), "± counts the error of the time step"

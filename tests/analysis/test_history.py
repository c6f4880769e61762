"""Runs side by side: means, drifts and the run to distrust, against closed forms and drawn estimates."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from yid_ocp.analysis.estimate_history import (
    RunEstimates,
    assess_drift,
    nearby_positive_definite_covariance,
    pool_estimates,
)

COVARIANCE = np.array([[4.0, 1.5], [1.5, 1.0]]) * 1e-4


def run(name, values, covariance=COVARIANCE, names=("a", "b")):
    return RunEstimates(name, names, np.asarray(values, float), np.asarray(covariance, float), {"a": "m", "b": "kg"})


def drawn(rng, mean, count):
    return [run(f"day{i}", rng.multivariate_normal(mean, COVARIANCE)) for i in range(count)]


def drifted(found):
    return [entry.name for entry in found.parameter_drifts if entry.has_drifted]


def outliers(found):
    return [entry.run_name for entry in found.run_consistencies if entry.is_outlier]


def test_two_runs_together_are_their_weighted_mean_with_whole_covariances():
    other = np.array([[1.0, -0.3], [-0.3, 2.0]]) * 1e-4
    first, second = run("x", [1.0, 2.0]), run("y", [1.003, 2.002], other)
    mean, chi2, degrees = pool_estimates([first, second])
    sum_of = np.linalg.inv(np.linalg.inv(COVARIANCE) + np.linalg.inv(other))
    expected = sum_of @ (np.linalg.inv(COVARIANCE) @ first.values + np.linalg.inv(other) @ second.values)
    apart = first.values - second.values
    assert mean.values == pytest.approx(expected, rel=1e-10)
    assert mean.covariance == pytest.approx(sum_of, rel=1e-8)
    assert chi2 == pytest.approx(apart @ np.linalg.solve(COVARIANCE + other, apart), rel=1e-8)
    assert degrees == 2


def test_runs_that_differ_widen_the_mean_by_birges_ratio():
    mean, chi2, degrees = pool_estimates([run("x", [1.0, 2.0]), run("y", [1.5, 2.0])])
    assert chi2 > 50
    assert mean.std == pytest.approx(np.sqrt(np.diag(COVARIANCE) / 2 * chi2 / degrees), rel=1e-8)


def test_a_parameter_that_one_run_lacks_still_counts_where_it_is():
    mean, _, degrees = pool_estimates([run("x", [1.0, 2.0]), run("y", [1.0], [[1e-4]], ("a",))])
    assert mean.parameter_names == ("a", "b")
    assert degrees == 1
    assert mean.std[0] < 0.01


def test_chi2_of_runs_without_drift_is_distributed_as_it_should():
    rng = np.random.default_rng(3)
    found = [assess_drift(drawn(rng, [1.0, 2.0], 3)).p_value for _ in range(40)]
    assert scipy.stats.kstest(found, "uniform").pvalue > 1e-3


def test_false_alarms_of_drift_and_distrust_stay_at_their_level():
    rng = np.random.default_rng(4)
    found = [assess_drift(drawn(rng, [1.0, 2.0], 4), level=0.05) for _ in range(40)]
    assert np.mean([bool(drifted(entry)) for entry in found]) < 0.16
    assert np.mean([bool(outliers(entry)) for entry in found]) < 0.16


def test_the_run_that_stands_apart_is_the_one_to_distrust():
    rng = np.random.default_rng(5)
    runs = drawn(rng, [1.0, 2.0], 4)
    runs[2] = run("day2", runs[2].values + np.array([0.2, 0.0]))
    found = assess_drift(runs)
    assert outliers(found) == ["day2"]
    assert drifted(found) == ["a"]
    assert next(entry.worst_parameter for entry in found.run_consistencies if entry.run_name == "day2") == "a"


def test_a_steady_drift_names_the_parameter_and_no_run():
    runs = [run(f"day{i}", [1.0, 2.0 + 0.05 * i]) for i in range(5)]
    found = assess_drift(runs)
    assert "b" in drifted(found)
    assert outliers(found) == []


def test_of_two_runs_that_differ_neither_is_distrusted():
    found = assess_drift([run("x", [1.0, 2.0]), run("y", [2.0, 2.0])])
    assert drifted(found) == ["a"]
    assert outliers(found) == []


def test_a_covariance_without_full_rank_can_be_inverted_and_keeps_its_standard_deviations():
    flat = np.array([[1.0, 1.0], [1.0, 1.0]]) * np.outer([1e-3, 1e4], [1e-3, 1e4])
    found = nearby_positive_definite_covariance(flat)
    assert np.sqrt(np.diag(found)) == pytest.approx([1e-3, 1e4], rel=1e-9)
    assert np.all(np.isfinite(np.linalg.cholesky(found)))

"""What the sensors would have recorded, and channels measured beside predicted."""

from __future__ import annotations

import math

import numpy as np
import pytest
from small_problems import pendulum_step, taken

import yid_ocp as yid
from yid_ocp.errors import ConfigError
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.problem.predictions import rmse_by_channel

FREE = ["elbow.stiffness", "elbow.damping"]


@pytest.fixture(scope="module")
def problem(urdf_folder):
    step = pendulum_step(urdf_folder, prescribed=("shoulder",))
    return EstimationProblem(step, [taken(step, 1)], FREE, ProblemOptions(path_cutoff=np.inf))


def test_what_is_simulated_is_what_is_found(problem):
    truth = {"elbow.stiffness": 4.2, "elbow.damping": 0.31}
    made = problem.simulate_recording(truth)
    assert made.name == "run_1_simulated"
    assert {name: made.true_parameters[name] for name in FREE} == truth
    assert np.array_equal(made.points[0].t, problem.episodes[0].recording.points[0].t)
    again = EstimationProblem(problem.step, [made], FREE, problem.options)
    solution = yid.solve(again)
    at_truth = again.evaluate(again.vector(truth), derivatives=False)
    assert np.abs(at_truth.residual[again.residual_rows.data]).max() < 1e-9
    for name, value in truth.items():
        # but for the weak prior
        assert solution.parameters[name].value == pytest.approx(value, rel=0.02)


def test_its_own_values_without_any_and_noise_by_its_seed(problem):
    plain, first, same, other = (problem.simulate_recording(seed=seed) for seed in (None, 3, 3, 4))
    own = problem.evaluate(problem.initial_unknowns, derivatives=False).episode_predictions[0]
    [samples] = [s for s in problem.episodes[0].measurements if s.sensor.group_name == plain.points[0].name]
    predicted = own.predicted_outputs[problem.episodes[0].measurements.index(samples)]
    where = samples.used_output_mask
    assert np.allclose(plain.points[0].position.reshape(predicted.shape)[where], predicted[where], atol=1e-12)
    assert np.array_equal(first.points[0].position, same.points[0].position, equal_nan=True)
    assert not np.array_equal(first.points[0].position, other.points[0].position, equal_nan=True)
    spread = np.nanstd(first.points[0].position - plain.points[0].position)
    assert spread == pytest.approx(float(np.nanmedian(samples.std)), rel=0.3)


def test_a_parameter_that_is_not_there_is_named(problem):
    with pytest.raises(ConfigError, match=r"there is no parameter 'elbow\.stifness'") as caught:
        problem.simulate_recording({"elbow.stifness": 1.0})
    assert caught.value.hint == "did you mean 'elbow.stiffness'?"


def test_residuals_are_those_of_the_result(problem):
    solution = yid.solve(problem, yid.GaussNewton())
    errors = rmse_by_channel(solution.episode_predictions, problem.episodes)
    found = solution.channel_measurements_and_predictions()
    assert {entry.channel: entry.rmse for entry in found} == pytest.approx({k: v["rmse"] for k, v in errors.items()})
    for entry in found:
        assert entry.unit == errors[entry.channel]["unit"]
        assert entry.t.shape == (len(entry.measured),)
        assert entry.measured.shape == entry.predicted.shape == entry.noise_std.shape
        assert np.array_equal(entry.residual, entry.predicted - entry.measured, equal_nan=True)
    tip = next(entry for entry in found if entry.channel.endswith(".tip"))
    group = problem.episodes[0].recording.points[0]
    assert np.allclose(tip.t, group.t)
    assert np.allclose(tip.measured, group.position[:, group.names.index("tip")], equal_nan=True)


def test_the_method_that_is_not_named_is_gauss_newton(problem):
    assert yid.solve(problem).solver_name == "gauss_newton"
    assert np.array_equal(yid.solve(problem).x, yid.solve(problem, yid.GaussNewton()).x)


def test_a_frame_has_every_parameter_and_its_interval(problem, monkeypatch):
    pytest.importorskip("pandas")
    solution = yid.solve(problem)
    frame = solution.to_dataframe()
    assert set(frame.index[:2]) == set(FREE)
    assert set(frame.index) == set(solution.parameters)
    assert list(frame.columns) == ["value", "std", "lower", "upper", "unit", "verdict", "free", "initial"]
    for name, entry in solution.parameters.items():
        row = frame.loc[name]
        assert (row["value"], row["std"], row["verdict"]) == (entry.value, entry.std, entry.verdict)
        if entry.interval is None:
            assert row["upper"] - row["lower"] == pytest.approx(2 * 1.96 * entry.std)
        else:
            ends = [math.inf if end is None else abs(end) for end in entry.interval]
            assert [abs(row["lower"]), abs(row["upper"])] == ends
    monkeypatch.setitem(__import__("sys").modules, "pandas", None)
    with pytest.raises(ConfigError, match="pandas is not installed") as caught:
        solution.to_dataframe()
    assert "yid-ocp[pandas]" in caught.value.hint

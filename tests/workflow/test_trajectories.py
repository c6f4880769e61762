"""Trajectories as HDF5: what stands where, and what a disk that refuses is called."""

from __future__ import annotations

from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from yid_ocp.diagnosis.events import NO_EVENTS
from yid_ocp.errors import OutputError
from yid_ocp.solvers import GaussNewton, solve
from yid_ocp.workflow.build_problem import load_problem
from yid_ocp.workflow.prediction_outputs import (
    prediction_error_entry,
    write_diagnosis_trajectories,
    write_solve_trajectories,
)


@pytest.fixture
def solved(pendulum):
    problem = load_problem(pendulum)
    solution = solve(problem, GaussNewton())
    return problem, solution, problem.predict_held_out(solution.x)


def test_a_solution_with_its_predictions(solved, tmp_path):
    problem, solution, held_out = solved
    unpredicted = [(held_out[0][0], "step 3 did not converge")]
    write_solve_trajectories(tmp_path / "t.h5", problem, solution, unpredicted)
    with h5py.File(tmp_path / "t.h5") as file:
        assert file.attrs["format"] == "yid-trajectories/1"
        assert list(file["unknowns"].attrs["names"]) == list(solution.unknown_names)
        np.testing.assert_array_equal(file["unknowns/x"], solution.x)
        np.testing.assert_array_equal(file["unknowns/covariance"], solution.covariance)
        made, missing = file["recordings/estimate"], file["recordings/held_out"]
        assert (made.attrs["role"], missing.attrs["role"]) == ("estimate", "held_out")
        assert missing.attrs["message"] == "step 3 did not converge"
        assert list(missing) == []
        episode, outcome = problem.episodes[0], solution.episode_predictions[0]
        n = problem.system.n_coordinates
        np.testing.assert_array_equal(made["t"], episode.grid.node_times)
        np.testing.assert_array_equal(made["q"], outcome.rollout.state[:, :n])
        np.testing.assert_array_equal(made["p"], outcome.rollout.state[:, n : 2 * n])
        np.testing.assert_array_equal(made["effort"], outcome.rollout.effort)
        assert {"multipliers", "torque"} < set(made)
        sensor, samples = made["joints.effort"], episode.measurements[0]
        assert list(sensor.attrs["channels"]) == list(samples.sensor.channel_names)
        assert sensor.attrs["unit"] == "N m"
        np.testing.assert_array_equal(sensor["measured"], samples.value)
        np.testing.assert_array_equal(sensor["predicted"], outcome.predicted_outputs[0])
        np.testing.assert_array_equal(sensor["std"], samples.std)
        inside = np.min(np.abs(sensor["t"][()][:, None] - episode.recording.joints.t[None, :]), axis=1)
        assert np.max(inside) < 0.5 * problem.step.time_step


def test_a_diagnosis_without_a_gap_has_predictions_alone(solved, tmp_path):
    ((episode, outcome),) = solved[2]
    other = SimpleNamespace(predicted_outputs=[2 * array for array in outcome.predicted_outputs])
    finding = SimpleNamespace(smoother_result=None, events=NO_EVENTS)
    write_diagnosis_trajectories(tmp_path / "t.h5", finding, [(episode, outcome, other)])
    with h5py.File(tmp_path / "t.h5") as file:
        assert file.attrs["format"] == "yid-diagnosis-trajectories/1"
        assert list(file) == ["held_out"]
        group = file["held_out/joints.effort"]
        np.testing.assert_array_equal(group["before"], outcome.predicted_outputs[0])
        np.testing.assert_array_equal(group["after"], 2 * outcome.predicted_outputs[0])
        assert group["t"].shape == (len(group["measured"]),)


def test_a_file_that_cannot_be_written(solved, tmp_path):
    with pytest.raises(OutputError, match="does not exist"):
        write_solve_trajectories(tmp_path / "no" / "t.h5", *solved)


def test_a_held_out_recording_beside_a_guess_without_a_model(solved):
    problem, _, held_out = solved
    entry = prediction_error_entry(problem, *held_out[0])
    assert entry["recording"] == "held_out"
    samples = held_out[0][0].measurements[0]
    for i, channel in enumerate(samples.sensor.channel_names):
        error = held_out[0][1].predicted_outputs[0][:, i] - samples.value[:, i]
        assert entry["rmse"][channel] == pytest.approx(np.sqrt(np.nanmean(error**2)))
        assert entry["baselines"]["zero"][channel] == pytest.approx(np.sqrt(np.nanmean(samples.value[:, i] ** 2)))
    failed = prediction_error_entry(problem, held_out[0][0], "step 3 did not converge")
    assert failed["message"] == "step 3 did not converge"
    assert failed["rmse"] == {}
    assert failed["baselines"] == entry["baselines"]

"""What wrong torques do to readings: few unknowns that stand for all errors, and what-if experiments under them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from yid_ocp.analysis import experiment_design, torque_error_propagation
from yid_ocp.analysis.experiment_design import BaseExperiment, CandidateExperimentBuilder
from yid_ocp.analysis.identifiability import identifiability
from yid_ocp.analysis.torque_error_propagation import _NEGLIGIBLE_STD, _low_rank_error_sensitivity
from yid_ocp.analysis.what_if import WhatIfOptions, what_if
from yid_ocp.data.recording import PointGroup
from yid_ocp.inference.linearized_residual import residual_without_weak_priors
from yid_ocp.inference.whitening import whitened_at, without_input_errors
from yid_ocp.problem import EstimationProblem
from yid_ocp.workflow.build_problem import load_problem

STEPS, NX, NU, READINGS = 30, 4, 2, 3


@pytest.fixture
def driven():
    """A made-up motion of two driven joints, torques recorded every other step."""
    rng = np.random.default_rng(3)
    mix = [0.9 * np.linalg.qr(rng.standard_normal((NX, NX)))[0] for _ in range(STEPS)]
    return torque_error_propagation._Motion(
        np.array(mix),
        rng.standard_normal((STEPS, NX, NU)),
        0.3 * rng.standard_normal((STEPS, NX, NU)),
        rng.standard_normal((NX, NU)),
        rng.standard_normal((NX, NU)),
        np.array([0.5, 0.2]),
        np.array([2.0, 0.0]),
        np.repeat(np.arange(STEPS // 2), 2),
    ), rng.standard_normal((STEPS + 1, READINGS, NX))


def test_the_pull_is_the_motion_transposed(driven):
    motion, slopes = driven
    rng = np.random.default_rng(1)
    errors, readings = rng.standard_normal((motion.size, 2)), rng.standard_normal((STEPS + 1, READINGS, 2))
    there, back = motion.moved(errors, slopes), motion.pulled(readings, slopes)
    assert motion.size == NU * (2 + STEPS // 2 + STEPS)
    for i in range(2):
        for j in range(2):
            assert np.sum(there[..., i] * readings[..., j]) == pytest.approx(errors[:, i] @ back[:, j], rel=1e-10)


@pytest.mark.parametrize("size", [1.0, 0.02])
def test_few_unknowns_have_the_covariance_of_all(driven, monkeypatch, size):
    motion, slopes = driven
    slopes = size * slopes
    monkeypatch.setattr(torque_error_propagation._Motion, "of", lambda course, errors: motion)
    monkeypatch.setattr(torque_error_propagation, "_INITIAL_RANDOM_SAMPLES", 8)
    whole = motion.moved(np.eye(motion.size), slopes).reshape(-1, motion.size)
    few = _low_rank_error_sensitivity(None, None, slopes).reshape(len(whole), -1)
    missing = whole @ whole.T - few @ few.T
    assert few.shape[1] < min(whole.shape) if size < 1 else few.shape[1] <= min(whole.shape)
    assert np.diag(missing).max() < _NEGLIGIBLE_STD**2
    assert np.abs(np.linalg.eigvalsh(missing)).max() < _NEGLIGIBLE_STD**2


# -- experiments ------------------------------------------------------------------------------------------------------


def short(repository, *settings):
    """One arm on a coarse Y, for a second; its torques have white noise and offsets."""
    coarse = (
        "model.object.links=1",
        "problem.duration=1.0",
        "problem.use_compiler=false",
        "recordings.held_out=[]",
        "parameters={}",
        "parameters={T1.bend: {free: true, initial: 20}, T2.bend: {free: true, initial: 10}, T2.twist: {initial: 10}}",
    )
    return load_problem(repository / "configs" / "single_arm_vision.yaml", (*coarse, *settings))


@pytest.fixture(scope="module")
def noisy(repository):
    return short(repository)


def relative(problem):
    return {name: entry.std_relative for name, entry in identifiability(problem).parameters.items()}


def test_the_experiment_as_it_is_knows_the_noise_of_its_torques(noisy):
    ranking = what_if(noisy, options=WhatIfOptions(considered_changes=("rate:30",), max_set_size=1))
    told, exact = relative(noisy), relative(without_input_errors(noisy))
    for name, std in told.items():
        assert ranking.unchanged_experiment.std_relative[name] == pytest.approx(std, rel=0.02)
        assert std > 1.2 * exact[name]


def test_encoders_that_are_measurements_stay_so(repository):
    problem = short(repository, "sensors.points_arm.use=false")
    found = what_if(
        problem, options=WhatIfOptions(considered_changes=("rate:30",), max_set_size=1)
    ).unchanged_experiment.std_relative
    without = short(repository, "sensors.points_arm.use=false", "sensors.joints.position.use=false")
    blind = what_if(
        without, options=WhatIfOptions(considered_changes=("rate:30",), max_set_size=1)
    ).unchanged_experiment.std_relative
    for name, std in relative(problem).items():
        assert found[name] == pytest.approx(std, rel=0.3)
        assert found[name] < 0.5 * blind[name]


def test_a_predicted_camera_tells_beside_wrong_torques_what_it_tells_when_it_is_there(noisy):
    """The faster camera predicted, and the same one in the recording."""
    predicted = what_if(noisy, options=WhatIfOptions(considered_changes=("rate:30",), max_set_size=1)).single_changes[0]
    recording = noisy.episodes[0].recording
    times = recording.joints.t[0] + np.arange(0.0, 1.0 + 1e-9, 1 / 30)
    groups = []
    for group in recording.points:
        if group.name == "points_camera":
            shape = (len(times), len(group.names), 3)
            position, std = np.zeros(shape), np.full(shape, float(np.nanmedian(group.std)))
            group = PointGroup(group.name, group.names, times, position, std=std, sensor=group.sensor, pose=group.pose)
        groups.append(group)
    # what is there tells of errors of torques too: those that the real recording tells of
    effort, errors = (
        recording.joints.effort.copy(),
        whitened_at(noisy, noisy.initial_unknowns, rounds=2).episodes[0].input_errors,
    )
    effort[: len(errors.torque_noise)] -= errors.total_torque_error
    faster = replace(recording, points=tuple(groups), joints=replace(recording.joints, effort=effort))
    problem = EstimationProblem(
        noisy.step, [faster], noisy.free, noisy.options, noisy.named_values(noisy.initial_unknowns)
    )
    weighted = whitened_at(problem, problem.initial_unknowns)
    jacobian = residual_without_weak_priors(weighted, weighted.evaluate(problem.initial_unknowns))[1]
    std = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian))) / problem.initial_unknowns
    for name, value in zip(problem.unknown_names, std, strict=True):
        assert predicted.std_relative[name] == pytest.approx(value, rel=0.02)


def test_made_motions_are_as_noisy_as_the_recorded_one(noisy, monkeypatch):
    builder = CandidateExperimentBuilder(BaseExperiment(noisy, noisy.initial_unknowns))
    made = builder.build_experiment(frozenset({"motion"}))
    assert not isinstance(made, str), made
    own, recorded = made.problem.episodes[0].input_errors, noisy.episodes[0].input_errors
    for name in ("torque_std", "torque_bias_std", "angle_std"):
        np.testing.assert_allclose(getattr(own, name), getattr(recorded, name))
    second = SimpleNamespace(driven=(*noisy.system.driven, "other"))
    angle, torque, bias = experiment_design._noise_as_recorded(noisy.system, second, noisy.episodes[0])
    assert torque[-1] == np.median(recorded.torque_std)
    assert bias[-1] == np.median(recorded.torque_bias_std)
    np.testing.assert_array_equal(angle[:-1], recorded.angle_std)

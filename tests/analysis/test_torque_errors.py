"""What wrong torques do to readings: few unknowns that stand for all errors, and what-if experiments under them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from yid_ocp.analysis import experiment_design
from yid_ocp.analysis import torque_error_propagation as module
from yid_ocp.analysis.experiment_design import CandidateExperimentBuilder, RecordedExperiment
from yid_ocp.analysis.identifiability import identifiability
from yid_ocp.analysis.what_if import what_if
from yid_ocp.data.recording import PointGroup
from yid_ocp.inference.linearized_residual import linearization_without_weak_priors
from yid_ocp.inference.whitening import problem_whitened_at, problem_without_input_errors
from yid_ocp.problem import EstimationProblem, SensorOptions
from yid_ocp.workflow.build_problem import load_problem

STEPS, NX, NU, READINGS = 30, 4, 2, 3


@pytest.fixture
def made(monkeypatch):
    """A made-up motion of two driven joints, torques recorded every other step: course, errors, readings' slopes."""
    rng = np.random.default_rng(3)
    steps = [
        SimpleNamespace(
            state_by_state=0.9 * np.linalg.qr(rng.standard_normal((NX, NX)))[0],
            state_by_torque=rng.standard_normal((NX, NU)),
        )
        for _ in range(STEPS)
    ]
    monkeypatch.setattr(module, "linearized_steps", lambda *_: steps)
    monkeypatch.setattr(module, "applied_torque_error_feedthrough", lambda gain, momentum: np.eye(NU))
    monkeypatch.setattr(module, "_INITIAL_RANDOM_SAMPLES", 8)
    functions = SimpleNamespace(
        step=None, momentum_shift=SimpleNamespace(momentum_derivative_by_previous_torque=lambda theta: None)
    )
    feedback = SimpleNamespace(state_indices=[0, 1], gain=0.3 * rng.standard_normal((STEPS, NU, 2)))
    course = SimpleNamespace(
        model_functions=functions, tracking_feedback=feedback, theta=None, rollout=None,
        initial_state_by_angles=rng.standard_normal((NX, NU)), initial_state_by_torque=rng.standard_normal((NX, NU)),
    )  # fmt: skip
    errors = SimpleNamespace(
        angle_std=np.ones(NU), torque_std=np.array([0.5, 0.2]), torque_bias_std=np.array([2.0, 0.0]),
        encoder_noise_steps=1.0, sample_of_step=np.repeat(np.arange(STEPS // 2), 2),
    )  # fmt: skip
    return course, errors, rng.standard_normal((STEPS + 1, READINGS, NX)), steps


def covariance(course, errors, slopes, steps):
    """Of all readings, from every error by itself."""
    columns = []
    samples = errors.sample_of_step

    def run(start, torque=None, angles=None):
        state, found = start, [slopes[0] @ start]
        for k, here in enumerate(steps):
            pulled = here.state_by_torque @ course.tracking_feedback.gain[k]
            moved = here.state_by_state @ state - pulled @ state[:2]
            state = moved + here.state_by_torque @ torque[samples[k]] + pulled @ angles[k]
            found.append(slopes[k + 1] @ state)
        columns.append(np.ravel(found))

    for joint in np.eye(NU):
        none, still = np.zeros((STEPS // 2, NU)), np.zeros((STEPS, NU))
        run(course.initial_state_by_angles @ joint, none, still)
        bias = joint * errors.torque_bias_std
        run(course.initial_state_by_torque @ bias, none + bias, still)
        for i in range(len(none)):
            white = np.array([joint * errors.torque_std * (i == k) for k in range(len(none))])
            run(course.initial_state_by_torque @ white[0], white, still)
        for k in range(STEPS):
            run(np.zeros(NX), none, still + joint * (np.arange(STEPS) == k)[:, None])
    return np.array(columns).T @ np.array(columns)


@pytest.mark.parametrize("size", [1.0, 0.02])
def test_few_unknowns_have_the_covariance_of_all(made, size):
    course, errors, slopes, steps = made
    few = module._low_rank_error_sensitivity(course, errors, size * slopes)
    few = few.reshape(READINGS * (STEPS + 1), -1)
    missing = covariance(course, errors, size * slopes, steps) - few @ few.T
    assert few.shape[1] < len(few) if size < 1 else few.shape[1] <= len(few)
    assert np.abs(np.linalg.eigvalsh(missing)).max() < 0.1**2


# -- experiments ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def noisy(repository):
    """One arm on a coarse Y, for a second; its torques have white noise and offsets."""
    coarse = (
        "model.object.links=1",
        "problem.duration=1.0",
        "problem.use_compiler=false",
        "recordings.held_out=[]",
        "parameters={}",
        "parameters={T1.bend: {free: true, initial: 20}, T2.bend: {free: true, initial: 10}, T2.twist: {initial: 10}}",
    )
    return load_problem(repository / "configs" / "single_arm_vision.yaml", coarse)


def half_without(problem, *groups):
    """Half a second of a problem without some sensors."""
    sensors = {**problem.options.sensors, **{name: SensorOptions(use=False) for name in groups}}
    return problem.with_options(replace(problem.options, sensors=sensors, duration=0.5))


def relative(problem):
    return {name: entry.std_relative for name, entry in identifiability(problem).parameters.items()}


@pytest.fixture(scope="module")
def ranking(noisy):
    return what_if(noisy, considered_changes=("rate:30",))


def test_the_experiment_as_it_is_knows_the_noise_of_its_torques(noisy, ranking):
    told, exact = relative(noisy), relative(problem_without_input_errors(noisy))
    for name, std in told.items():
        assert ranking.unchanged_experiment.std_relative[name] == pytest.approx(std, rel=0.02)
        assert std > 1.2 * exact[name]


def test_encoders_that_are_measurements_stay_so(noisy):
    problem, without = (half_without(noisy, "points_arm", *more) for more in ((), ("joints.position",)))
    found, blind = (what_if(one, considered_changes=()).unchanged_experiment.std_relative for one in (problem, without))
    for name, std in relative(problem).items():
        assert found[name] == pytest.approx(std, rel=0.3)
        assert found[name] < 0.5 * blind[name]


def test_a_predicted_camera_tells_beside_wrong_torques_what_it_tells_when_it_is_there(noisy, ranking):
    """The faster camera predicted, and the same one in the recording."""
    predicted = ranking.single_changes[0]
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
        problem_whitened_at(noisy, noisy.initial_unknowns, rounds=2).episodes[0].input_errors,
    )
    effort[: len(errors.torque_noise)] -= errors.total_torque_error
    faster = replace(recording, points=tuple(groups), joints=replace(recording.joints, effort=effort))
    problem = EstimationProblem(
        noisy.step, [faster], noisy.free, noisy.options, noisy.named_values(noisy.initial_unknowns)
    )
    weighted = problem_whitened_at(problem, problem.initial_unknowns)
    jacobian = linearization_without_weak_priors(weighted, weighted.evaluate(problem.initial_unknowns))[1]
    std = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian))) / problem.initial_unknowns
    for name, value in zip(problem.unknown_names, std, strict=True):
        assert predicted.std_relative[name] == pytest.approx(value, rel=0.02)


def test_made_motions_are_as_noisy_as_the_recorded_one(noisy, monkeypatch):
    builder = CandidateExperimentBuilder(RecordedExperiment(noisy, noisy.initial_unknowns))
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

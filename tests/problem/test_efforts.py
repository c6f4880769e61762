"""Smoothed joint efforts count for as much as they tell."""

from __future__ import annotations

import math

import numpy as np
import pytest
from small_problems import PENDULUM, pendulum_step, taken

from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.errors import DataError
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.sensors.joints import JOINT_EFFORT_GROUP_NAME
from yid_ocp.solvers import GaussNewton, solve

JOINTS = ("shoulder", "elbow")
TRUTH = {"shoulder.damping": 0.3, "elbow.damping": 0.2}
NOISE = 0.05  # of the efforts [N m]
CUTOFF = 5.0  # [Hz]
TWINS = 60


@pytest.fixture(scope="module")
def arm(urdf_folder):
    """arm(effort, cutoff): both joints moved as measured for six seconds at 100 Hz, their efforts measured."""
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    system = System.build(robot, prescribed=JOINTS, damping=0.1)
    steps = {h: compile_step(system, h, use_compiler=h == 0.01) for h in (0.02, 0.01, 0.005, 0.0025)}
    t = 0.01 * np.arange(601)
    path = np.stack([0.6 * np.sin(2.9 * t), 0.5 * np.sin(3.7 * t + 1)], axis=1)

    def build(effort: np.ndarray, cutoff: float, kind: str | None = None, time_step: float = 0.01) -> EstimationProblem:
        joints = JointGroup(JOINTS, t, path, effort=effort, position_std=0.0, effort_std=NOISE, effort_kind=kind)
        options = ProblemOptions(path_cutoff=cutoff, weak_prior_factor=0.0)
        return EstimationProblem(steps[time_step], [Recording(joints, name="arm")], tuple(TRUTH), options, TRUTH)

    return build


def test_deviations_are_those_of_repeats(arm):
    exact = arm(np.zeros((601, 2)), math.inf)
    inner = exact.evaluate(exact.initial_unknowns, derivatives=False).episode_predictions[0].predicted_outputs[0]
    clean = np.vstack([inner[:1], inner, inner[-1:]])
    found, stated = [], []
    for seed in range(TWINS):
        noise = NOISE * np.random.default_rng(seed).standard_normal(clean.shape)
        solution = solve(arm(clean + noise, CUTOFF), GaussNewton())
        found.append([solution.parameters[name].value for name in TRUTH])
        stated.append([solution.parameters[name].std for name in TRUTH])
    error = np.array(found) - list(TRUTH.values())
    inside = np.mean(np.abs(error) <= 1.96 * np.array(stated))
    assert 0.90 <= inside <= 0.99
    np.testing.assert_allclose(np.std(error, axis=0), np.median(stated, axis=0), rtol=0.2)


def test_a_record_shorter_than_the_filter_is_refused(arm):
    with pytest.raises(DataError, match=r"(?s)6 s of efforts are too short.*more than 15\.4 s"):
        arm(np.zeros((601, 2)), 0.5)


def test_neighbours_that_repeat_each_other_are_left_out(arm):
    plain, smooth = (arm(np.zeros((601, 2)), cutoff).episodes[0].measurements[0] for cutoff in (math.inf, CUTOFF))
    np.testing.assert_array_equal(plain.node, np.arange(1, 600))
    np.testing.assert_array_equal(smooth.node + np.rint(smooth.fraction), np.arange(77, 524, 10))


@pytest.mark.parametrize(("kind", "late"), [(None, 0.0), ("sample", 0.0), ("mean", 0.005), ("command", 0.005)])
def test_an_effort_that_stands_for_an_interval_belongs_to_its_middle(arm, kind, late):
    t = 0.01 * np.arange(601)
    [samples] = arm(np.stack([t, 2 - t], axis=1), np.inf, kind).episodes[0].measurements
    at = 0.01 * (samples.node + samples.fraction)[:, None]
    expected = np.hstack([at - late, 2 - at + late])
    np.testing.assert_allclose(samples.value.reshape(len(at), 2), expected, atol=1e-12)


@pytest.mark.parametrize("kind", ["sample", "mean", "command"])
def test_settings_say_what_recorded_efforts_are(urdf_folder, kind):
    step = pendulum_step(urdf_folder, driven=PENDULUM)
    recorded, free = taken(step, 1), ["shoulder.damping"]
    stated = ProblemOptions(sensors={JOINT_EFFORT_GROUP_NAME: SensorOptions(effort_kind=kind)})
    [said] = EstimationProblem(step, [recorded], free, stated).episodes
    [held] = EstimationProblem(step, [recorded.with_effort_kind(kind)], free, ProblemOptions()).episodes
    assert said.recording.joints.effort_kind == kind
    np.testing.assert_array_equal(said.torque, held.torque)
    assert (np.abs(said.torque - recorded.joints.effort[:-1]).max() < 1e-12) == (kind != "sample")


@pytest.mark.parametrize("cutoff", [math.inf, CUTOFF])
@pytest.mark.parametrize("time_step", [0.02, 0.005, 0.0025])
def test_efforts_are_compared_where_they_were_measured(arm, cutoff, time_step):
    """Never between samples, however short the step: what lies there was not measured."""
    effort = np.random.default_rng(0).standard_normal((601, 2))
    found = {}
    for h in (0.01, time_step):
        samples = arm(effort, cutoff, time_step=h).episodes[0].measurements[0]
        found[h] = dict(zip(np.round((samples.node + samples.fraction) * h / 0.01, 6), samples.value, strict=True))
    assert all(time == round(time) for time in found[time_step])
    if time_step < 0.01:
        assert len(found[time_step]) == len(found[0.01])
    if math.isinf(cutoff):
        for time, value in found[time_step].items():
            np.testing.assert_allclose(value, effort[round(time)], atol=1e-12)

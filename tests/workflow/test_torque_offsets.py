"""Torque errors in what commands leave: offsets in results, drawn ones in simulations, levels in `check`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.inference.whitening import whitened_at, without_input_errors
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import System
from yid_ocp.model.servos_and_springs import RobotJointSpring
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.problem.synthetic_recording import recording_from_prediction
from yid_ocp.report.model_summaries import _noise_words
from yid_ocp.report.tables import torque_offset_rows
from yid_ocp.report.terminal import aligned_table_lines
from yid_ocp.workflow.check import _input_noise
from yid_ocp.workflow.prediction_outputs import estimated_torque_offsets

STEPS, OFFSET, WHITE, ANGLE = 200, 0.2, 0.05, 1e-4


@pytest.fixture(scope="module")
def step(urdf_folder):
    tree = read_urdf(urdf_folder / "double_pendulum.urdf")
    system = System.build(tree, driven=("shoulder",), springs={"elbow": RobotJointSpring(3.0)}, damping=0.2)
    return compile_step(system, 0.01, use_compiler=False)


def problem_of(step, *, bias=OFFSET, white=WHITE, held_out=True, options=None):
    """A pendulum under torques that are 0.3 N m too large, in one recording to estimate on and one held out."""
    t = 0.01 * np.arange(STEPS + 1)
    torque = np.sin(6 * t)[:, None]
    options = options or ProblemOptions(feedback="proportional", proportional_gains=(9.0,))
    first = Recording(
        JointGroup(
            ("shoulder",), t, np.zeros((STEPS + 1, 1)), effort=torque, effort_std=white, effort_bias_std=bias,
            position_std=ANGLE, effort_kind="command",
        ),
        (),
        name="first",
    )  # fmt: skip
    made = EstimationProblem(
        step, [first], ("elbow.stiffness",), replace(options, feedback="none", proportional_gains=None)
    )
    episode = made.episodes[0]
    swept = made.predictor.predict_episode(episode, *made.split(made.initial_unknowns, 0), False)
    joints = replace(first.joints, position=swept.rollout.state[:, :1], effort=torque + 0.3)
    recordings = [replace(first, joints=joints, name=name) for name in ("first", "second")]
    return EstimationProblem(
        step, recordings[:1], ("elbow.stiffness",), options, None, recordings[1:] if held_out else ()
    )


def test_offsets_of_all_recordings_are_told_with_what_was_expected(step):
    problem = problem_of(step)
    assert estimated_torque_offsets(problem, problem.initial_unknowns) == {}
    weighted = whitened_at(problem, problem.initial_unknowns, rounds=2)
    found = estimated_torque_offsets(weighted, problem.initial_unknowns)
    assert list(found) == ["first", "second"]
    for entry in found.values():
        own = entry["shoulder"]
        assert own["prior_std"] == OFFSET
        assert own["std"] < 0.1 * OFFSET
        assert own["value"] == pytest.approx(0.3, abs=4 * own["std"])
    assert list(
        estimated_torque_offsets(
            whitened_at(problem_of(step, held_out=False), problem.initial_unknowns), problem.initial_unknowns
        )
    ) == ["first"]


def test_where_offsets_are_no_part_of_the_model_nothing_is_said(step):
    problem = problem_of(step, bias=0.0)
    assert estimated_torque_offsets(whitened_at(problem, problem.initial_unknowns), problem.initial_unknowns) == {}
    assert torque_offset_rows({"torque_offsets": {}}) == torque_offset_rows({}) == []


def entry(value, prior=0.3):
    return {"value": value, "std": 0.012, "prior_std": prior}


def test_the_table_has_a_row_for_a_joint_and_a_column_for_a_recording():
    offsets = {"a": {"s0": entry(0.4), "e0": entry(-0.1)}, "b": {"s0": entry(0.2, 0.1)}}
    rows = torque_offset_rows({"torque_offsets": offsets})
    assert rows == [
        ("torque offset [N m]", "a", "b", "expected"),
        ("s0", "0.40 ± 0.01", "0.20 ± 0.01", "± 0.3, ± 0.1"),
        ("e0", "-0.10 ± 0.01", "", "± 0.3"),
    ]
    many = {f"run {i}": {"s0": entry(0.1)} for i in range(6)}
    assert torque_offset_rows({"torque_offsets": many})[-1][0] == "2 more recordings are in result.json"
    assert aligned_table_lines(rows)[0].split() == ["torque", "offset", "[N", "m]", "a", "b", "expected"]


def simulated(problem, seed):
    episode = problem.episodes[0]
    outcome = problem.predictor.predict_episode(episode, *problem.split(problem.initial_unknowns, 0), False)
    return recording_from_prediction(problem.predictor, episode, outcome, problem.theta, seed).joints


def test_simulated_torques_are_wrong_as_the_estimation_expects_and_say_so(step):
    problem = problem_of(step)
    exact = simulated(problem, None)
    errors = np.array([(simulated(problem, seed).effort - exact.effort)[:, 0] for seed in range(60)])
    # for 60 draws a standard deviation is good to a tenth of itself
    assert errors.mean(axis=1).std() == pytest.approx(OFFSET, rel=0.3)
    assert (errors - errors.mean(axis=1, keepdims=True)).std() == pytest.approx(WHITE, rel=0.05)
    made = simulated(problem, 1)
    for group in (made, exact):
        assert (group.effort_std, group.effort_bias_std, group.position_std) == (WHITE, OFFSET, ANGLE)


def test_settings_come_before_what_the_recording_says(step):
    sensors = {"joints.effort": SensorOptions(std={"shoulder": 0.4}, bias_std=0.7)}
    options = ProblemOptions(feedback="proportional", proportional_gains=(9.0,), sensors=sensors)
    made = simulated(problem_of(step, options=options), 1)
    assert (made.effort_std, made.effort_bias_std) == (0.4, 0.7)


@pytest.mark.parametrize(("white", "estimated"), [(WHITE, False), (None, True)])
def test_check_lists_noise_that_drives_the_motion_and_whether_anybody_stated_it(step, white, estimated):
    problem = problem_of(step, white=white)
    noise = _input_noise(problem, problem.episodes[0])
    effort, position = noise["joints.effort"], noise["joints.position"]
    assert (effort["estimated"], position["estimated"]) == (estimated, False)
    assert (effort["bias_std"], position["std"]) == (OFFSET, ANGLE)
    words = _noise_words(noise, "joints")
    assert ("(estimated)" in words) is estimated
    assert words.endswith("; 0.0001 rad")
    assert ", offset 0.2" in words
    calm = without_input_errors(problem)
    assert _input_noise(calm, calm.episodes[0]) == {}

"""Recorded torques as the model holds them, delayed or not."""

from __future__ import annotations

import numpy as np
import pytest
from small_problems import PENDULUM, pendulum_step, taken

from yid_ocp.data.recording import JointGroup
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.problem.measurements import TimeGrid
from yid_ocp.problem.recorded_inputs import mean_step_input_delay_derivative, mean_step_inputs
from yid_ocp.sensors.joints import JOINT_EFFORT_GROUP_NAME

H = 0.01


def test_torque_acts_late() -> None:
    t = H * np.arange(6)
    effort = np.array([[1.0, 2.0, 4.0, 8.0, 16.0, 32.0], [0.0, 1.0, 0.0, 1.0, 0.0, 1.0]]).T
    joints = JointGroup(("a", "b"), t, np.zeros((6, 2)), effort=effort, effort_kind="command")
    grid = TimeGrid(0.0, H, 5)
    prompt = mean_step_inputs(joints, ("a", "b"), grid, "made")
    late = mean_step_inputs(joints, ("a", "b"), grid, "made", np.array([H, 0.25 * H]))
    assert late[:, 0] == pytest.approx([1.0, 1, 2, 4, 8])
    assert late[1:, 1] == pytest.approx(0.75 * prompt[1:, 1] + 0.25 * prompt[:-1, 1])
    slope = mean_step_input_delay_derivative(joints, ("a", "b"), grid, "made", np.array([0.0, 0.25 * H]))
    assert slope[:, 0] == pytest.approx(-np.array([0.5, 1.5, 3.0, 6.0, 12.0]) / H)
    assert slope[1:, 1] == pytest.approx(-np.diff(prompt[:, 1]) / H)


@pytest.mark.parametrize("kind", ["sample", "mean", "command"])
def test_settings_say_what_recorded_efforts_are(urdf_folder, kind):
    step = pendulum_step(urdf_folder, driven=PENDULUM)
    recorded = taken(step, 1)
    stated = ProblemOptions(sensors={JOINT_EFFORT_GROUP_NAME: SensorOptions(effort_kind=kind)})
    (said,) = EstimationProblem(step, [recorded], ["shoulder.damping"], stated).episodes
    (held,) = EstimationProblem(
        step, [recorded.with_effort_kind(kind)], ["shoulder.damping"], ProblemOptions()
    ).episodes
    assert said.recording.joints.effort_kind == kind
    np.testing.assert_array_equal(said.torque, held.torque)
    assert (np.abs(said.torque - recorded.joints.effort[:-1]).max() < 1e-12) == (kind != "sample")

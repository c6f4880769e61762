"""Recorded torques as the model holds them, delayed or not."""

from __future__ import annotations

import numpy as np
import pytest

from yid_ocp.data.recording import JointGroup
from yid_ocp.problem.grid import Grid
from yid_ocp.problem.inputs import held_torque, held_torque_slope

H = 0.01


def test_torque_acts_late() -> None:
    t = H * np.arange(6)
    effort = np.array([[1.0, 2.0, 4.0, 8.0, 16.0, 32.0], [0.0, 1.0, 0.0, 1.0, 0.0, 1.0]]).T
    joints = JointGroup(("a", "b"), t, np.zeros((6, 2)), effort=effort, effort_kind="command")
    grid = Grid(0.0, H, 5)
    prompt = held_torque(joints, ("a", "b"), grid, "made")
    late = held_torque(joints, ("a", "b"), grid, "made", np.array([H, 0.25 * H]))
    assert late[:, 0] == pytest.approx([1.0, 1, 2, 4, 8])
    assert late[1:, 1] == pytest.approx(0.75 * prompt[1:, 1] + 0.25 * prompt[:-1, 1])
    slope = held_torque_slope(joints, ("a", "b"), grid, "made", np.array([0.0, 0.25 * H]))
    assert slope[:, 0] == pytest.approx(-np.array([0.5, 1.5, 3.0, 6.0, 12.0]) / H)
    assert slope[1:, 1] == pytest.approx(-np.diff(prompt[:, 1]) / H)

"""Measured order of the step: two with the symmetric force split, one where forces go left."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from yid_ocp.integrator.step import compile_step, step_with_time_step
from yid_ocp.model import Grasp, Segment, System, flexible_object, forward_kinematics
from yid_ocp.model.system import floating_clamp
from yid_ocp.model.urdf import read_urdf


def mixed_joints(urdf_folder):
    system = System.build(read_urdf(urdf_folder / "mixed_joints.urdf"), driven=["spin", "extend"], damping=0.4)
    n, rng = system.n_coordinates, np.random.default_rng(1)
    return system, rng.uniform(-0.4, 0.4, n), rng.normal(size=n), [2.0, 8.0], 0.4, (40, 80, 160, 320)


def double_pendulum(urdf_folder):
    system = System.build(read_urdf(urdf_folder / "double_pendulum.urdf"), driven=["elbow"], damping=0.1)
    return system, np.array([1.0, -0.5]), np.array([0.5, 2.0]), [0.6], 1.0, (200, 400, 800)


def grasped_cable(urdf_folder):
    """Thick and soft: the twist of a thin one is too fast for time steps in the range where the order shows."""
    cable = flexible_object([Segment("C", 0.6, 0.3, 0.1, 3, bend=2.0, twist=2.0, damping=2e-3)])
    bent = np.array([0.3, -0.2, 0.1, 0.4, 0.2, -0.1, 0.2, 0.3, 0.15])
    pose = forward_kinematics(cable.mechanism.with_numeric_values(), ca.SX(ca.DM(bent))).frame_position("w_C")
    clamp, grasp = floating_clamp("clamp"), Grasp("end", "clamp", "w_C")
    system = System.build(clamp, objects=[(cable, None, None)], grasps=[grasp], prescribed=clamp.joint_names)
    q = np.concatenate([np.array(ca.DM(pose)).ravel(), np.zeros(3), bent])
    return system, q, np.zeros_like(q), [], 0.1, (50, 100, 200)


def slopes(motion, split, roll, momentum):
    """Slope of log error over log time step, of q and of p, against a run with many more steps."""
    system, q, v, amplitude, duration, counts = motion
    plain, theta, n = (
        compile_step(system, duration / counts[0], split),
        system.parameters.vector(),
        system.n_coordinates,
    )

    def finish(step, count):
        """Coordinates and momenta at the end; the torque is held at its value in each step's middle."""
        times = (np.arange(count) + 0.5) * step.time_step
        torque = np.sin(2 * np.pi * times / duration + 0.3)[:, None] * np.array(amplitude)
        rollout = roll(step, theta, q, momentum(step, q, v, theta), count, torque=torque)
        assert rollout.status.is_converged, rollout.status.message
        return rollout.state[-1, :n], rollout.state[-1, n : 2 * n]

    ends = [finish(step_with_time_step(plain, duration / count), count) for count in counts]
    count = 8 * counts[-1]
    reference = finish(compile_step(system, duration / count, "symmetric"), count)
    errors = [[np.linalg.norm(a - b) for a, b in zip(end, reference, strict=True)] for end in ends]
    return np.polyfit(np.log(1 / np.array(counts)), np.log(errors), 1)[0]


@pytest.mark.parametrize("make", [mixed_joints, double_pendulum])
@pytest.mark.parametrize(("split", "order"), [("symmetric", 2.0), ("left", 1.0)])
def test_the_force_split_gives_the_order(make, split, order, urdf_folder, roll, momentum):
    assert slopes(make(urdf_folder), split, roll, momentum) == pytest.approx([order, order], abs=0.1)


def test_coordinates_of_a_grasped_object_have_order_two(urdf_folder, roll, momentum):
    """p is not compared, it lacks half a step's pull of the grasp."""
    assert slopes(grasped_cable(urdf_folder), "symmetric", roll, momentum)[0] == pytest.approx(2.0, abs=0.1)

"""Motions of the driven joints: where they begin, and random multisines from there."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from virtual_examples import SYSTEMS, grasp_gaps

from yid_ocp.errors import ModelError
from yid_ocp.model.kinematics import forward_kinematics, mass_matrix, rigid_body_lagrangian_derivatives
from yid_ocp.virtual.joint_motion import MultisineOptions, grasping_joint_angles, random_multisine_motion


def test_initial_posture_reaches_the_tubes_within_the_limits() -> None:
    for arms, system in SYSTEMS.items():
        posture = grasping_joint_angles(system)
        assert len(posture) == 7 * arms
        for name, angle in posture.items():
            joint = system.mechanism.joints[system.mechanism.joint_index(name)]
            assert joint.lower_limit <= angle <= joint.upper_limit
        full = [posture.get(name, 0.0) for name in system.mechanism.joint_names]
        assert np.abs(np.array(grasp_gaps(system)(full))).max() < 1e-8
    with pytest.raises(ModelError, match="miss the grasped points"):
        grasping_joint_angles(SYSTEMS[1], {"T1.length": 3.0})


def test_motion_starts_smoothly_and_is_drawn_from_the_seed() -> None:
    motion = random_multisine_motion(SYSTEMS[1], seed=3)
    assert all(np.abs(part).max() == 0.0 for part in motion.offset_and_derivatives(0.0))
    assert np.all((motion.frequency >= 0.2) & (motion.frequency <= 2.0))
    h = 1e-4
    for t in (0.4, 1.0, 2.3):
        before, now, after = (motion.offset_and_derivatives(t + shift) for shift in (-h, 0.0, h))
        np.testing.assert_allclose((after[0] - before[0]) / (2 * h), now[1], atol=1e-6)
        np.testing.assert_allclose((after[1] - before[1]) / (2 * h), now[2], atol=1e-4)
    np.testing.assert_array_equal(random_multisine_motion(SYSTEMS[1], seed=3).amplitude, motion.amplitude)
    assert not np.array_equal(random_multisine_motion(SYSTEMS[1], seed=4).amplitude, motion.amplitude)


def test_shaking_takes_the_torque_that_was_asked_for_and_leaves_the_travel_alone() -> None:
    system = SYSTEMS[1]
    calm = random_multisine_motion(system, seed=3)
    rough = random_multisine_motion(
        system,
        seed=3,
        excitation=MultisineOptions(shake_torque_rms=0.5, shake_frequency_band=(5.0, 8.0), max_shake_speed=0.2),
    )
    for part in ("amplitude", "frequency", "phase"):
        np.testing.assert_array_equal(getattr(rough, part)[:, :3], getattr(calm, part))
    omega = 2 * np.pi * rough.frequency[:, 3:]
    assert np.all((omega >= 2 * np.pi * 5.0) & (omega <= 2 * np.pi * 8.0))
    q = ca.SX.sym("q", system.n_coordinates)
    tree, zero = system.mechanism.with_numeric_values(), ca.SX(ca.DM.zeros(system.n_coordinates))
    mass = mass_matrix(rigid_body_lagrangian_derivatives(forward_kinematics(tree, q), zero, zero[:3]), tree)
    posture = grasping_joint_angles(system)
    start = [posture.get(name, 0.0) for name in system.mechanism.joint_names]
    inertia = np.diag(np.array(ca.densify(ca.Function("M", [q], [mass])(start))))[
        list(system.driven_coordinate_indices)
    ]
    torque = inertia[:, None] * rough.amplitude[:, 3:] * omega**2
    np.testing.assert_allclose(np.sqrt((torque[:4] ** 2).sum(1) / 2), 0.5, rtol=1e-9)
    speed = rough.amplitude[:, 3:] * omega
    assert speed.max() == pytest.approx(0.2)
    np.testing.assert_allclose(speed[6], 0.2)
    assert torque[6].max() < 0.5

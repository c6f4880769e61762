"""Virtual experiments: motions of the driven joints, and what sensors make of a simulation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from virtual_examples import SEEDS, SYSTEMS, TRUTH, Runs, grasp_gaps

import yid_ocp
from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.data.recording_hdf5 import read_recording
from yid_ocp.errors import ConfigError, ModelError
from yid_ocp.model.kinematics import forward_kinematics, mass_matrix, rigid_body_lagrangian_derivatives
from yid_ocp.virtual.experiment import (
    ArmSensorNoise,
    PointCamera,
    VirtualExperiment,
    baxter_foam_y_system,
    record_simulation,
    run_virtual_experiment,
)
from yid_ocp.virtual.joint_motion import MultisineOptions, grasping_joint_angles, random_multisine_motion
from yid_ocp.virtual.mujoco_simulation import SimulationOptions, SimulationResult, simulate_in_mujoco

DEFAULTS = Path(yid_ocp.__file__).parent / "data" / "defaults"


def test_recording_has_what_the_sensors_saw(runs: Runs) -> None:
    system, run = SYSTEMS[1], runs(1, 1e-3, 3.0)
    motion = random_multisine_motion(system, TRUTH, seed=SEEDS[1])
    simulation = SimulationOptions(3.0, time_step=1e-3)
    recording = run_virtual_experiment(system, TRUTH, VirtualExperiment(motion=motion, simulation=simulation, seed=5))
    joints = recording.joints
    assert joints is not None
    assert joints.velocity is not None
    np.testing.assert_array_equal(joints.t, np.arange(301) / 100)
    np.testing.assert_array_equal(joints.effort, run.effort)  # a camera must not disturb the experiment
    assert np.std(joints.position - run.q[:, :7]) == pytest.approx(2e-4, rel=0.1)
    assert np.std(joints.velocity - run.v[:, :7]) == pytest.approx(5e-3, rel=0.1)
    arm, camera = recording.points
    assert (arm.name, arm.names, arm.sensor) == ("points_arm", ("w_T2",), "arm")
    assert np.std(arm.position[:, 0] - run.point_positions[:, 1]) == pytest.approx(1e-3, rel=0.1)
    assert (camera.name, camera.names, camera.sensor) == ("points_camera", ("w_T1", "w_T3"), "camera")
    assert np.diff(camera.t).max() > 1.0
    assert 0.2 < np.diff(camera.t).min() < 0.45
    for column, point in enumerate(camera.names):
        truth = run.point_positions[:, system.point_frames.index(point)]
        path = np.column_stack([np.interp(camera.t, run.t, truth[:, axis]) for axis in range(3)])
        assert np.nanmax(np.abs(camera.position[:, column] - path)) < 5 * 5e-3
    assert camera.pose is not None
    assert np.linalg.norm(camera.pose[:3, 3] - run.point_positions[0].mean(0)) == pytest.approx(2.0)
    assert TRUTH.items() <= recording.true_parameters.items()
    assert all(name.rpartition(".")[2] in ("bend", "twist", "damping", "mass") for name in recording.true_parameters)
    assert "MuJoCo" in recording.description


def recorded(run: SimulationResult, seed: int, noise: ArmSensorNoise, camera: PointCamera | None = None) -> Recording:
    """What sensors with some noise make of a simulation of one arm."""
    simulation = SimulationOptions(time_step=1e-3, effort_kind="sample")
    experiment = VirtualExperiment(None, None, simulation, noise, camera, seed=seed)
    return record_simulation(SYSTEMS[1], TRUTH, experiment, run)


def test_sensors_have_their_own_noise(runs: Runs) -> None:
    run = runs(1, 1e-3, 3.0)
    run = replace(run, frame_times=run.t[::30], frame_point_positions=run.point_positions[::30])
    often_hidden, quiet = PointCamera(hidden_probability=0.5), ArmSensorNoise()
    first, again, other = (recorded(run, seed, quiet, often_hidden) for seed in (1, 1, 2))
    blind = recorded(run, 1, ArmSensorNoise(effort_std=0.3))
    for a, b in zip(first.points, again.points, strict=True):
        np.testing.assert_array_equal(a.position, b.position)
    np.testing.assert_array_equal(first.joints.position, blind.joints.position)
    np.testing.assert_array_equal(first.points[0].position, blind.points[0].position)
    assert len(blind.points) == 1
    assert not np.array_equal(first.joints.position, other.joints.position)
    assert np.std(first.joints.effort - blind.joints.effort) == pytest.approx(0.3, rel=0.1)
    assert np.isnan(first.points[1].position).any()


def test_torques_are_off_by_a_constant_and_by_white_noise(runs: Runs) -> None:
    white = (0.02, 0.04, 0.06, 0.08, 0.1, 0.12, 0.14)

    def joints(seed: int = 1, **noise: Any) -> JointGroup:
        return recorded(runs(1, 1e-3, 3.0), seed, ArmSensorNoise(**noise)).joints

    clean, noisy = joints(), joints(effort_std=white, effort_bias_std=0.3)
    other, unstated = joints(2, effort_bias_std=0.3), joints(effort_bias_std=0.3, records_effort_std=False)
    assert (clean.effort_kind, clean.effort_std, clean.effort_bias_std) == ("sample", 0.0, 0.0)
    assert noisy.effort_bias_std == 0.3
    np.testing.assert_array_equal(noisy.effort_std, white)
    assert (unstated.effort_std, unstated.effort_bias_std, unstated.position_std) == (None, None, 2e-4)
    error = noisy.effort - clean.effort
    offset = (unstated.effort - clean.effort)[0]
    np.testing.assert_allclose(unstated.effort - clean.effort, np.tile(offset, (301, 1)), rtol=0, atol=1e-12)
    np.testing.assert_allclose((error - offset).std(0), white, rtol=0.2)
    assert 0.1 < offset.std() < 0.6
    assert len(np.unique(offset)) == 7
    assert not np.allclose((other.effort - clean.effort)[0], offset, atol=0.1)
    np.testing.assert_array_equal(noisy.position, clean.position)


def test_experiments_that_do_not_fit_are_refused() -> None:
    brief = SimulationOptions(0.1, time_step=1e-3)
    with pytest.raises(ConfigError, match="2 standard deviations for 7 joints"):
        run_virtual_experiment(
            SYSTEMS[1], None, VirtualExperiment(None, None, brief, ArmSensorNoise(effort_std=(0.1, 0.2)))
        )
    with pytest.raises(ConfigError, match="arms = 3"):
        baxter_foam_y_system(3)


@pytest.mark.parametrize(("kind", "arms"), [("ROUGH", 1), ("CLEAN", 2)])
def test_recordings_are_reproducible(kind: str, arms: int, clean: Path, benchmark_module) -> None:
    made = benchmark_module("make_recordings")
    torques, system = getattr(made, kind), SYSTEMS[arms]
    posture = grasping_joint_angles(system, made.TRUTH, offsets=made.OFFSETS[arms])
    excitation = MultisineOptions(gripper_travel=torques.travel[arms], shake_torque_rms=torques.shake)
    seed, start = torques.motion_seeds[arms, "estimate"], {"initial_joint_angles": posture}
    motion = random_multisine_motion(system, made.TRUTH, seed=seed, excitation=excitation, **start)
    run = simulate_in_mujoco(system, made.TRUTH, motion, replace(torques.simulation, duration=0.1), **start)
    name = f"{['single', 'dual'][arms - 1]}_arm_no_vision_estimate.h5"
    joints = read_recording((DEFAULTS if torques.white else clean) / name).joints
    assert joints is not None
    error = joints.effort[:11] - run.effort
    # noise and offsets as stated lie on the effort of the rough ones, noise alone on the angles of both
    if torques.white:
        assert np.all(error.std(axis=0) < 1.5 * np.array(arms * torques.white))
        assert np.all(np.abs(error.mean(axis=0)) < 4 * np.array(arms * torques.offset))
    else:
        np.testing.assert_allclose(error, 0.0, rtol=0, atol=1e-6)
    angles = run.q[:, list(system.driven_coordinate_indices)]
    np.testing.assert_allclose(joints.position[:11], angles, rtol=0, atol=1.5e-3)


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
    shaking = MultisineOptions(shake_torque_rms=0.5, shake_frequency_band=(5.0, 8.0), max_shake_speed=0.2)
    rough = random_multisine_motion(system, seed=3, excitation=shaking)
    for part in ("amplitude", "frequency", "phase"):
        np.testing.assert_array_equal(getattr(rough, part)[:, :3], getattr(calm, part))
    omega = 2 * np.pi * rough.frequency[:, 3:]
    assert np.all((omega >= 2 * np.pi * 5.0) & (omega <= 2 * np.pi * 8.0))
    q = ca.SX.sym("q", system.n_coordinates)
    tree, zero = system.mechanism.with_numeric_values(), ca.SX(ca.DM.zeros(system.n_coordinates))
    mass = mass_matrix(rigid_body_lagrangian_derivatives(forward_kinematics(tree, q), zero, zero[:3]), tree)
    posture = grasping_joint_angles(system)
    start = [posture.get(name, 0.0) for name in system.mechanism.joint_names]
    inertia = np.diag(np.array(ca.densify(ca.Function("M", [q], [mass])(start))))
    torque = inertia[list(system.driven_coordinate_indices), None] * rough.amplitude[:, 3:] * omega**2
    np.testing.assert_allclose(np.sqrt((torque[:4] ** 2).sum(1) / 2), 0.5, rtol=1e-9)
    speed = rough.amplitude[:, 3:] * omega
    assert speed.max() == pytest.approx(0.2)
    np.testing.assert_allclose(speed[6], 0.2)
    assert torque[6].max() < 0.5

"""MuJoCo as the other engine: what it simulates, the motions it follows, and what sensors record of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from virtual_examples import SYSTEMS, TRUTH, mujoco

import yid_ocp
from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.data.recording_hdf5 import read_recording
from yid_ocp.errors import ConfigError, ModelError
from yid_ocp.model.kinematics import forward_kinematics, lagrangian_first_derivatives, mass_matrix
from yid_ocp.model.objects.foam_y import foam_y_object
from yid_ocp.model.system import Grasp, System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.virtual.experiment import (
    ArmSensorNoise,
    PointCamera,
    VirtualExperimentSettings,
    recording_from_simulation,
    run_virtual_experiment,
)
from yid_ocp.virtual.joint_motion import MultisineOptions, grasping_joint_angles, random_multisine_motion
from yid_ocp.virtual.mjcf import mujoco_model_from_mjcf_text, mujoco_xml
from yid_ocp.virtual.mujoco_simulation import (
    MujocoModelAndState,
    SimulationOptions,
    SimulationResult,
    settle_and_return_holding_torques,
    simulate_in_mujoco,
)

DEFAULT_RECORDINGS = Path(yid_ocp.__file__).parent / "data" / "defaults"


Runs = Callable[..., SimulationResult]


def grasp_gaps(system: System) -> ca.Function:
    """From a configuration to what the grasps leave open."""
    q = ca.SX.sym("q", system.n_coordinates)
    return ca.Function("phi", [q], [system.constraint_residual(forward_kinematics(system.mechanism_with_values(), q))])


@pytest.fixture(scope="module")
def runs() -> Runs:
    """runs(arms, time step [s], duration [s]): the paper's system, one second where nothing else is said."""

    @cache
    def run(arms: int, step: float, duration: float = 1.0) -> SimulationResult:
        motion = random_multisine_motion(SYSTEMS[arms], TRUTH, seed=7)
        return simulate_in_mujoco(SYSTEMS[arms], TRUTH, motion, SimulationOptions(duration, time_step=step))

    return run


@pytest.mark.parametrize("arms", [1, 2])
def test_grasps_hold(runs: Runs, arms: int) -> None:
    run, system = runs(arms, 2e-4), SYSTEMS[arms]
    phi = grasp_gaps(system)
    gaps = np.array([phi(row) for row in run.q]).reshape(len(run.t), -1, 3)
    assert np.linalg.norm(gaps, axis=2).max() < 1e-4


def test_halving_the_inner_step_changes_little(runs: Runs) -> None:
    coarse, fine = runs(2, 2e-4), runs(2, 1e-4, 0.5)
    np.testing.assert_array_equal(coarse.t[:51], fine.t)
    assert np.linalg.norm(coarse.point_positions[:51] - fine.point_positions, axis=-1).max() < 5e-5


@pytest.mark.parametrize("arms", [1, 2])
def test_starts_in_static_equilibrium_of_the_symbolic_equations(runs: Runs, arms: int) -> None:
    run, system = runs(arms, 2e-4), SYSTEMS[arms]
    q, u = ca.SX.sym("q", system.n_coordinates), ca.SX.sym("u", len(system.driven))
    kinematics = forward_kinematics(system.mechanism, q)
    rigid = lagrangian_first_derivatives(kinematics, ca.SX(ca.DM.zeros(system.n_coordinates)), system.gravity)
    force = rigid.lagrangian_by_q - ca.gradient(system.elastic_energy(q), q) + system.input_force(u, q, q)
    jacobian = ca.jacobian(system.constraint_residual(kinematics), q)
    function = ca.Function("statics", [q, u, system.parameters.symbols], [force, jacobian])
    found = function(run.q[0], run.effort[0], system.parameters.vector(TRUTH))
    load, gradient = (np.array(ca.densify(part)) for part in found)
    multiplier = np.linalg.lstsq(gradient.T, load, rcond=None)[0]
    assert np.abs(load - gradient.T @ multiplier).max() < 1e-5
    assert np.abs(run.v[0]).max() == 0.0
    posture = grasping_joint_angles(system, TRUTH)
    start = dict(zip(system.mechanism.joint_names, run.q[0], strict=True))
    assert all(abs(start[name] - angle) < 1e-5 for name, angle in posture.items())


@pytest.mark.parametrize("kind", ["axis", "weld"])
def test_other_grasps_hold(kind: str) -> None:
    system = SYSTEMS[1]
    posture = grasping_joint_angles(system)
    q = ca.SX.sym("q", system.n_coordinates)
    kinematics = forward_kinematics(system.mechanism.with_numeric_values(), q)
    rotation = kinematics.frame_pose("left_gripper").rotation.T @ kinematics.frame_pose("w_T2").rotation
    start = [posture.get(name, 0.0) for name in system.mechanism.joint_names]
    turned = ca.SX(ca.densify(ca.Function("r", [q], [rotation])(start)))
    grasp = Grasp("left", "left_gripper", "w_T2", kind, held_orientation=turned)
    system = replace(system, grasps=(grasp,))
    motion = random_multisine_motion(system, TRUTH, seed=1, initial_joint_angles=posture)
    options = SimulationOptions(0.5, time_step=5e-4)
    run = simulate_in_mujoco(system, TRUTH, motion, options, initial_joint_angles=posture)
    assert np.abs(run.q[-1] - run.q[0]).max() > 0.02
    phi = grasp_gaps(system)
    residual = np.array([np.array(phi(row)).ravel() for row in run.q])
    assert residual.shape[1] == grasp.n_constraint_equations
    assert np.abs(residual).max() < 1e-4


def test_what_a_slow_recording_keeps_of_a_fast_controller() -> None:
    motion = random_multisine_motion(SYSTEMS[1], TRUTH, seed=1)

    def run(**choices: Any) -> SimulationResult:
        return simulate_in_mujoco(SYSTEMS[1], TRUTH, motion, SimulationOptions(0.2, time_step=1e-3, **choices))

    finely = run(sample_rate=1000.0)
    sample = run(sample_rate=100.0, controller_rate=1000.0, effort_kind="sample")
    mean = run(sample_rate=100.0, controller_rate=1000.0, effort_kind="mean")
    for coarse in (sample, mean):
        assert len(coarse.t) == 21
        np.testing.assert_array_equal(coarse.q, finely.q[::10])
        np.testing.assert_array_equal(coarse.point_positions, finely.point_positions[::10])
    np.testing.assert_array_equal(sample.effort, finely.effort[::10])
    np.testing.assert_allclose(mean.effort[:-1], finely.effort[:-1].reshape(20, 10, -1).mean(1), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(mean.effort[-1], finely.effort[-1])
    assert np.abs(mean.effort - sample.effort)[:-1].max() > 1e-3


@pytest.mark.parametrize(
    ("choices", "match"),
    [
        ({"time_step": 3e-4}, "does not divide the period of 100 Hz"),
        ({"time_step": 3e-4, "controller_rate": 1e3, "effort_kind": "mean"}, "not divide the period of 1000 Hz"),
        ({"controller_rate": 150.0, "effort_kind": "mean"}, "150 Hz is not a multiple of sample_rate = 100 Hz"),
        ({"controller_rate": 50.0}, "50 Hz is not a multiple"),
        ({"controller_rate": 1000.0}, "1000 Hz. changes commands within a sample"),
        ({"effort_kind": "average"}, "no kind 'average'"),
    ],
)
def test_rates_that_do_not_fit_are_refused(choices: dict[str, Any], match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        SimulationOptions(**choices)


def grippers_beside(system: System, values: dict[str, float], time_step: float, held: System) -> MujocoModelAndState:
    """The scene with the joints a tenth of a radian from where the grippers meet another system's object."""
    scene = MujocoModelAndState(system, mujoco_model_from_mjcf_text(mujoco_xml(system, values, time_step=time_step)))
    scene.data.qpos[:] = scene.model.qpos_spring
    for name, angle in grasping_joint_angles(held, TRUTH).items():
        scene.data.qpos[scene.model.joint(name).id] = angle + 0.1
    return scene


def test_the_constraint_solver_converges_on_a_fine_chain() -> None:
    coarse = SYSTEMS[2]
    robot, objects = read_urdf("package:baxter", joints=list(coarse.driven)), [(foam_y_object(links=8), None, None)]
    fine = System.build(robot, objects=objects, grasps=coarse.grasps, driven=coarse.driven, damping=0.1)
    assert fine.n_coordinates > 80  # MuJoCo takes sparse matrices for more than 60, if it is let
    scene = grippers_beside(fine, {name: 2 * value for name, value in TRUTH.items()}, 1e-4, coarse)
    mujoco.mj_step(scene.model, scene.data, nstep=3)
    assert scene.data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number == 0
    assert scene.data.solver_niter[0] < 10


def test_grippers_beside_what_they_hold_close_at_a_short_step_too(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a log where it is
    system = SYSTEMS[2]
    scene = grippers_beside(system, TRUTH, 5e-5, system)
    balance = settle_and_return_holding_torques(scene, np.array(scene.model.dof_damping))
    scene.data.qfrc_applied[scene.moved_joint_ids] = balance
    mujoco.mj_forward(scene.model, scene.data)
    for grasp in system.grasps:
        holder, held = (scene.data.site(f"grasp_{grasp.name}_{end}").xpos for end in ("holder", "held"))
        assert np.abs(holder - held).max() < 1e-7
    # at rest as it is simulated from here on, with grasps as firm as the step allows
    assert np.abs(scene.data.qacc).max() < 0.01


@pytest.mark.parametrize(("later", "said"), [(False, "before the motion began"), (True, "the simulation diverged")])
def test_a_state_that_is_lost_is_told(later: bool, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a log where it is

    class Thrown:
        begun = False

        def edit_model(self, model: Any) -> None: ...
        def begin_motion(self, data: Any) -> None:
            self.begun = True

        def add_forces(self, model: Any, data: Any) -> None:
            if self.begun or not later:
                data.qfrc_passive[:] += 1e14

    system = SYSTEMS[1]
    motion = random_multisine_motion(system, TRUTH, seed=1)
    with pytest.raises(ModelError, match=said):
        simulate_in_mujoco(system, TRUTH, motion, SimulationOptions(0.1, time_step=1e-3), injected=Thrown())


def test_recording_has_what_the_sensors_saw(runs: Runs) -> None:
    system, run = SYSTEMS[1], runs(1, 1e-3, 3.0)
    motion = random_multisine_motion(system, TRUTH, seed=7)
    simulation = SimulationOptions(3.0, time_step=1e-3)
    recording = run_virtual_experiment(
        system, TRUTH, VirtualExperimentSettings(motion=motion, simulation=simulation, seed=5)
    )
    joints = recording.joints
    np.testing.assert_array_equal(joints.t, np.arange(301) / 100)
    np.testing.assert_array_equal(joints.effort, run.effort)  # a camera must not disturb the experiment
    assert np.std(joints.position - run.q[:, :7]) == pytest.approx(2e-4, rel=0.1)
    assert np.std(joints.velocity - run.v[:, :7]) == pytest.approx(5e-3, rel=0.1)
    arm, camera = recording.points
    assert (arm.name, arm.names, arm.sensor_name) == ("points_arm", ("w_T2",), "arm")
    assert np.std(arm.position[:, 0] - run.point_positions[:, 1]) == pytest.approx(1e-3, rel=0.1)
    assert (camera.name, camera.names, camera.sensor_name) == ("points_camera", ("w_T1", "w_T3"), "camera")
    assert np.diff(camera.t).max() > 1.0
    assert 0.2 < np.diff(camera.t).min() < 0.45
    for column, point in enumerate(camera.names):
        truth = run.point_positions[:, system.point_frames.index(point)]
        path = np.column_stack([np.interp(camera.t, run.t, truth[:, axis]) for axis in range(3)])
        assert np.nanmax(np.abs(camera.position[:, column] - path)) < 5 * 5e-3
    assert np.linalg.norm(camera.camera_pose[:3, 3] - run.point_positions[0].mean(0)) == pytest.approx(2.0)
    assert TRUTH.items() <= recording.true_parameters.items()
    assert all(name.rpartition(".")[2] in ("bend", "twist", "damping", "mass") for name in recording.true_parameters)


def recorded(run: SimulationResult, seed: int, noise: ArmSensorNoise, camera: PointCamera | None = None) -> Recording:
    """What sensors with some noise make of a simulation of one arm."""
    simulation = SimulationOptions(time_step=1e-3, effort_kind="sample")
    experiment = VirtualExperimentSettings(None, None, simulation, noise, camera, seed=seed)
    return recording_from_simulation(SYSTEMS[1], TRUTH, experiment, run)


def test_sensors_have_their_own_noise(runs: Runs) -> None:
    run = runs(1, 1e-3, 3.0)
    run = replace(run, frame_times=run.t[::30], frame_point_positions=run.point_positions[::30])
    sensors = ArmSensorNoise(), PointCamera(hidden_probability=0.5)
    first, again, other = (recorded(run, seed, *sensors) for seed in (1, 1, 2))
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
    brief, of_two = SimulationOptions(0.1, time_step=1e-3), ArmSensorNoise(effort_std=(0.1, 0.2))
    with pytest.raises(ConfigError, match="2 standard deviations for 7 joints"):
        run_virtual_experiment(SYSTEMS[1], None, VirtualExperimentSettings(None, None, brief, of_two))
    system = SYSTEMS[1]
    motion = random_multisine_motion(system, seed=0)
    with pytest.raises(ModelError, match="driven joints"):
        simulate_in_mujoco(replace(system, driven=system.driven[:3], prescribed=system.driven[3:]), None, motion)


@pytest.mark.parametrize(("kind", "arms"), [("ROUGH", 1), pytest.param("CLEAN", 2, marks=pytest.mark.slow)])
def test_recordings_are_reproducible(kind: str, arms: int, clean: Path, benchmark_module) -> None:
    made = benchmark_module("make_recordings")
    torques, system = getattr(made, kind), SYSTEMS[arms]
    posture = grasping_joint_angles(system, made.TRUTH, offsets=made.OFFSETS[arms])
    excitation = MultisineOptions(gripper_travel=torques.travel[arms])
    seed, brief = torques.motion_seeds[arms, "estimate"], replace(torques.simulation, duration=0.1)
    motion = made.shaken_motion(system, made.TRUTH, posture, seed, excitation, torques.shake)
    run = simulate_in_mujoco(system, made.TRUTH, motion, brief, initial_joint_angles=posture)
    name = f"{['single', 'dual'][arms - 1]}_arm_no_vision_estimate.h5"
    joints = read_recording((DEFAULT_RECORDINGS if torques.white else clean) / name).joints
    error = joints.effort[:11] - run.effort
    # noise and offsets as stated lie on the effort of the rough ones, noise alone on the angles of both
    if torques.white:
        assert np.all(error.std(axis=0) < 1.5 * np.array(arms * torques.white))
        assert np.all(np.abs(error.mean(axis=0)) < 4 * np.array(arms * torques.offset))
    else:
        np.testing.assert_allclose(error, 0.0, rtol=0, atol=1e-6)
    angles = run.q[:, list(system.actuated_coordinate_indices)]
    np.testing.assert_allclose(joints.position[:11], angles, rtol=0, atol=1.5e-3)


def test_initial_posture_reaches_the_tubes_within_the_limits() -> None:
    for arms, system in SYSTEMS.items():
        posture = grasping_joint_angles(system)
        assert len(posture) == 7 * arms
        for name, angle in posture.items():
            joint = system.mechanism.joint(name)
            assert joint.lower_limit <= angle <= joint.upper_limit
        full = [posture.get(name, 0.0) for name in system.mechanism.joint_names]
        assert np.abs(np.array(grasp_gaps(system)(full))).max() < 1e-8
    with pytest.raises(ModelError, match="are missing at the best angles"):
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


def test_shaking_takes_the_torque_that_was_asked_for_and_leaves_the_travel_alone(benchmark_module) -> None:
    system = SYSTEMS[1]
    calm, shaken = random_multisine_motion(system, seed=3), benchmark_module("make_recordings").shaken_motion
    rough = shaken(system, None, grasping_joint_angles(system), 3, MultisineOptions(), 0.5, (5.0, 8.0), 0.2)
    for part in ("amplitude", "frequency", "phase"):
        np.testing.assert_array_equal(getattr(rough, part)[:, :3], getattr(calm, part))
    omega = 2 * np.pi * rough.frequency[:, 3:]
    assert np.all((omega >= 2 * np.pi * 5.0) & (omega <= 2 * np.pi * 8.0))
    q = ca.SX.sym("q", system.n_coordinates)
    tree, zero = system.mechanism.with_numeric_values(), ca.SX(ca.DM.zeros(system.n_coordinates))
    mass = mass_matrix(lagrangian_first_derivatives(forward_kinematics(tree, q), zero, zero[:3]), tree)
    posture = grasping_joint_angles(system)
    start = [posture.get(name, 0.0) for name in system.mechanism.joint_names]
    inertia = np.diag(np.array(ca.densify(ca.Function("M", [q], [mass])(start))))
    torque = inertia[list(system.actuated_coordinate_indices), None] * rough.amplitude[:, 3:] * omega**2
    np.testing.assert_allclose(np.sqrt((torque[:4] ** 2).sum(1) / 2), 0.5, rtol=1e-9)
    speed = rough.amplitude[:, 3:] * omega
    assert speed.max() == pytest.approx(0.2)
    np.testing.assert_allclose(speed[6], 0.2)
    assert torque[6].max() < 0.5

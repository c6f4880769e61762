from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from virtual_examples import SYSTEMS, TRUTH, Runs, grasp_gaps, mujoco

from yid_ocp.errors import ConfigError, ModelError
from yid_ocp.model.kinematics import forward_kinematics, rigid_body_lagrangian_derivatives
from yid_ocp.model.objects.foam_y import foam_y_object
from yid_ocp.model.system import Grasp, System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.virtual.joint_motion import grasping_joint_angles, random_multisine_motion
from yid_ocp.virtual.mjcf import compile_mjcf, mujoco_xml
from yid_ocp.virtual.mujoco_simulation import (
    MujocoScene,
    SimulationOptions,
    SimulationResult,
    settle_to_equilibrium,
    simulate_in_mujoco,
)


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
    rigid = rigid_body_lagrangian_derivatives(kinematics, ca.SX(ca.DM.zeros(system.n_coordinates)), system.gravity)
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
    grasp = Grasp("left", "left_gripper", "w_T2", kind, held_orientation=turned)  # type: ignore[arg-type]
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
        ({"controller_rate": 150.0, "effort_kind": "mean"}, "150 Hz is no multiple of the recording's 100 Hz"),
        ({"controller_rate": 50.0}, "50 Hz is no multiple"),
        ({"controller_rate": 1000.0}, "1000 Hz is not held over a sample of 100 Hz"),
        ({"effort_kind": "average"}, "effort_kind = 'average'"),
    ],
)
def test_rates_that_do_not_fit_are_refused(choices: dict[str, Any], match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        SimulationOptions(**choices)


def test_simulations_that_do_not_fit_are_refused() -> None:
    system = SYSTEMS[1]
    motion = random_multisine_motion(system, seed=0)
    with pytest.raises(ModelError, match="driven joints"):
        simulate_in_mujoco(replace(system, driven=system.driven[:3], prescribed=system.driven[3:]), None, motion)


def grippers_beside(system: System, values: dict[str, float], time_step: float, held: System) -> MujocoScene:
    """The scene with the joints a tenth of a radian from where the grippers meet another system's object."""
    scene = MujocoScene.from_model(system, mujoco, compile_mjcf(mujoco_xml(system, values, time_step=time_step)))
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
    balance = settle_to_equilibrium(scene, np.array(scene.model.dof_damping))
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
        def start_motion(self, data: Any) -> None:
            self.begun = True

        def add_forces(self, model: Any, data: Any) -> None:
            if self.begun or not later:
                data.qfrc_passive[:] += 1e14

    system = SYSTEMS[1]
    motion = random_multisine_motion(system, TRUTH, seed=1)
    with pytest.raises(ModelError, match=said):
        simulate_in_mujoco(system, TRUTH, motion, SimulationOptions(0.1, time_step=1e-3), injected=Thrown())

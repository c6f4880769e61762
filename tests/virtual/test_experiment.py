from __future__ import annotations

import importlib.util
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import yid_ocp
from yid_ocp.data.hdf5 import read_recording
from yid_ocp.errors import ConfigError, DataError, ModelError
from yid_ocp.model.flexible import Segment, flexible_object
from yid_ocp.model.kinematics import forward_kinematics, mass_matrix, rigid_body
from yid_ocp.model.mechanism import Frame, Inertia, Placement
from yid_ocp.model.parameters import Parameter, Parameters
from yid_ocp.model.system import Grasp, MidpointState, System, Terms, floating_clamp
from yid_ocp.model.urdf import read_urdf
from yid_ocp.virtual.experiment import (
    Motion,
    SimulatedRun,
    initial_posture,
    mujoco_xml,
    paper_system,
    simulate_in_mujoco,
    virtual_experiment,
)

mujoco = pytest.importorskip("mujoco", reason="virtual experiments need MuJoCo: pip install 'yid-ocp[blind]'")

TRUTH = {"T1.bend": 22.0, "T1.twist": 13.6, "T2.bend": 10.7, "T2.twist": 8.2, "T3.bend": 11.5, "T3.twist": 9.7}
DEFAULTS = Path(yid_ocp.__file__).parent / "data" / "defaults"
SYSTEMS = {arms: paper_system(arms) for arms in (1, 2)}
SEEDS = {1: 7, 2: 7}


@pytest.fixture(scope="module")
def runs() -> dict[tuple[int, float], SimulatedRun]:
    made = {}
    for arms, system in SYSTEMS.items():
        motion = Motion.multisine(system, TRUTH, seed=SEEDS[arms])
        for step in (1e-4, 5e-5):
            made[arms, step] = simulate_in_mujoco(system, TRUTH, motion, time_step=step)
    return made


def clamped_beam() -> System:
    beam = flexible_object([Segment("B", 0.5, 0.2, 0.01, links=3)], name="beam")
    clamp = floating_clamp("clamp")
    body = Inertia.of(0.3, [0.01, 0.02, 0.03], np.diag([1e-3, 2e-3, 2.5e-3]))
    clamp = replace(clamp, joints=(*clamp.joints[:-1], replace(clamp.joints[-1], bodies=(body,))))
    return System.build(clamp, objects=[(beam, "clamp", None)], driven=["clamp_x"], damping=0.1)


@pytest.mark.parametrize(
    ("system", "values"),
    [
        (SYSTEMS[1], TRUTH),
        (SYSTEMS[2], {**TRUTH, "T2.mass": 0.03, "T3.length": 0.9, "left_w0.mass": 3.0}),
        (clamped_beam(), {"B.length": 0.6}),
    ],
    ids=["single", "dual", "clamp"],
)
def test_mechanics_equals_the_symbolic_one(system: System, values: dict[str, float]) -> None:
    q, v = ca.SX.sym("q", system.size), ca.SX.sym("v", system.size)
    kinematics = forward_kinematics(system.mechanism, q)
    rigid = rigid_body(kinematics, v, system.gravity)
    bias = ca.jtimes(rigid.by_v, q, v) - rigid.by_q
    passive = system.viscous_force(v) - ca.gradient(system.elastic_energy(q), q)
    points = ca.horzcat(*(kinematics.position(name) for name in system.points))
    ours = ca.Function(
        "ours", [q, v, system.parameters.symbols], [mass_matrix(rigid, system.mechanism), bias, passive, points]
    )
    model = mujoco.MjModel.from_xml_string(mujoco_xml(system, values))
    data = mujoco.MjData(model)
    order = [model.joint(name).id for name in system.mechanism.joint_names]
    assert model.nv == system.size
    rng = np.random.default_rng(0)
    for _ in range(3):
        posture, velocity = rng.uniform(-1, 1, system.size), rng.uniform(-1, 1, system.size)
        data.qpos[order], data.qvel[order] = posture, velocity
        mujoco.mj_forward(model, data)
        mass = np.zeros((model.nv, model.nv))
        for column in range(model.nv):
            mujoco.mj_mulM(model, data, mass[column], np.eye(model.nv)[column])
        expected = [np.array(ca.densify(e)) for e in ours(posture, velocity, system.parameters.vector(values))]
        np.testing.assert_allclose(mass[np.ix_(order, order)], expected[0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(data.qfrc_bias[order], expected[1].ravel(), rtol=0, atol=1e-9)
        np.testing.assert_allclose(data.qfrc_passive[order], expected[2].ravel(), rtol=0, atol=1e-9)
        seen = np.array([data.site(name).xpos for name in system.points])
        np.testing.assert_allclose(seen, expected[3].T, rtol=0, atol=1e-9)


@pytest.mark.parametrize("arms", [1, 2])
def test_grasps_hold(runs: dict[tuple[int, float], SimulatedRun], arms: int) -> None:
    run, system = runs[arms, 1e-4], SYSTEMS[arms]
    assert run.grasp_error.max() < 1e-4
    q = ca.SX.sym("q", system.size)
    phi = ca.Function("phi", [q], [system.constraints(forward_kinematics(system.mechanism.numeric(), q))])
    gaps = np.array([phi(row) for row in run.q]).reshape(len(run.t), -1, 3)
    np.testing.assert_allclose(np.linalg.norm(gaps, axis=2), run.grasp_error, rtol=0, atol=1e-9)


@pytest.mark.parametrize("arms", [1, 2])
def test_halving_the_inner_step_changes_little(runs: dict[tuple[int, float], SimulatedRun], arms: int) -> None:
    coarse, fine = runs[arms, 1e-4], runs[arms, 5e-5]
    assert np.linalg.norm(coarse.points - fine.points, axis=-1).max() < 5e-5


@pytest.mark.parametrize("arms", [1, 2])
def test_the_motion_excites_the_object_at_moderate_speed(
    runs: dict[tuple[int, float], SimulatedRun], arms: int
) -> None:
    run, system = runs[arms, 5e-5], SYSTEMS[arms]
    held = [system.points.index(grasp.held) for grasp in system.grasps]
    extent = np.ptp(run.points[:, held], axis=0).max(-1)
    assert np.all((extent > 0.1) & (extent < 0.25))
    assert np.abs(run.v[:, list(system.driven_indices)]).max() < 1.5
    limits = [system.mechanism.joints[j].effort_limit for j in system.driven_indices]
    assert np.all(np.abs(run.effort).max(0) < limits)


@pytest.mark.parametrize("arms", [1, 2])
def test_starts_in_static_equilibrium_of_the_symbolic_equations(
    runs: dict[tuple[int, float], SimulatedRun], arms: int
) -> None:
    run, system = runs[arms, 1e-4], SYSTEMS[arms]
    q, u = ca.SX.sym("q", system.size), ca.SX.sym("u", len(system.driven))
    kinematics = forward_kinematics(system.mechanism, q)
    rigid = rigid_body(kinematics, ca.SX(ca.DM.zeros(system.size)), system.gravity)
    force = rigid.by_q - ca.gradient(system.elastic_energy(q), q) + system.input_force(u)
    jacobian = ca.jacobian(system.constraints(kinematics), q)
    function = ca.Function("statics", [q, u, system.parameters.symbols], [force, jacobian])
    load, gradient = (
        np.array(ca.densify(e)) for e in function(run.q[0], run.effort[0], system.parameters.vector(TRUTH))
    )
    multiplier = np.linalg.lstsq(gradient.T, load, rcond=None)[0]
    assert np.abs(load - gradient.T @ multiplier).max() < 1e-5
    assert np.abs(run.v[0]).max() == 0.0
    posture = initial_posture(system, TRUTH)
    start = dict(zip(system.mechanism.joint_names, run.q[0], strict=True))
    assert all(abs(start[name] - angle) < 1e-5 for name, angle in posture.items())


@pytest.mark.parametrize("kind", ["axis", "weld"])
def test_other_grasps_hold(kind: str) -> None:
    system = SYSTEMS[1]
    posture = initial_posture(system)
    q = ca.SX.sym("q", system.size)
    kinematics = forward_kinematics(system.mechanism.numeric(), q)
    rotation = kinematics.pose("left_gripper").rotation.T @ kinematics.pose("w_T2").rotation
    start = [posture.get(name, 0.0) for name in system.mechanism.joint_names]
    turned = ca.SX(ca.densify(ca.Function("r", [q], [rotation])(start)))
    grasp = Grasp("left", "left_gripper", "w_T2", kind, rotation=turned)  # type: ignore[arg-type]
    system = replace(system, grasps=(grasp,))
    motion = Motion.multisine(system, TRUTH, seed=1, posture=posture)
    run = simulate_in_mujoco(system, TRUTH, motion, duration=0.8, time_step=2e-4, posture=posture)
    phi = ca.Function("phi", [q], [system.constraints(forward_kinematics(system.mechanism.numeric(), q))])
    assert np.abs(run.q[-1] - run.q[0]).max() > 0.02
    residual = np.array([np.array(phi(row)).ravel() for row in run.q])
    assert residual.shape[1] == grasp.equations
    assert np.abs(residual).max() < 1e-4


def test_initial_posture_reaches_the_tubes_within_the_limits() -> None:
    for arms, system in SYSTEMS.items():
        posture = initial_posture(system)
        assert len(posture) == 7 * arms
        for name, angle in posture.items():
            joint = system.mechanism.joints[system.mechanism.joint_index(name)]
            assert joint.lower <= angle <= joint.upper
        q = ca.SX.sym("q", system.size)
        phi = ca.Function("phi", [q], [system.constraints(forward_kinematics(system.mechanism.numeric(), q))])
        full = [posture.get(name, 0.0) for name in system.mechanism.joint_names]
        assert np.abs(np.array(phi(full))).max() < 1e-8
    with pytest.raises(ModelError, match="miss the grasped points"):
        initial_posture(SYSTEMS[1], {"T1.length": 3.0})


def test_motion_starts_smoothly_and_is_drawn_from_the_seed() -> None:
    motion = Motion.multisine(SYSTEMS[1], seed=3)
    assert all(np.abs(part).max() == 0.0 for part in motion.at(0.0))
    assert np.all((motion.frequency >= 0.2) & (motion.frequency <= 2.0))
    h = 1e-4
    for t in (0.4, 1.0, 2.3):
        before, now, after = (motion.at(t + shift) for shift in (-h, 0.0, h))
        np.testing.assert_allclose((after[0] - before[0]) / (2 * h), now[1], atol=1e-6)
        np.testing.assert_allclose((after[1] - before[1]) / (2 * h), now[2], atol=1e-4)
    np.testing.assert_array_equal(Motion.multisine(SYSTEMS[1], seed=3).amplitude, motion.amplitude)
    assert not np.array_equal(Motion.multisine(SYSTEMS[1], seed=4).amplitude, motion.amplitude)


def test_recording_has_what_the_sensors_saw(runs: dict[tuple[int, float], SimulatedRun]) -> None:
    system, run = SYSTEMS[1], runs[1, 1e-4]
    motion = Motion.multisine(system, TRUTH, seed=SEEDS[1])
    recording = virtual_experiment(system, TRUTH, motion=motion, seed=5)
    joints = recording.joints
    assert joints is not None
    assert joints.velocity is not None
    np.testing.assert_array_equal(joints.t, np.arange(501) / 100)
    np.testing.assert_array_equal(joints.effort, run.effort)  # a camera must not disturb the experiment
    assert np.std(joints.position - run.q[:, :7]) == pytest.approx(2e-4, rel=0.1)
    assert np.std(joints.velocity - run.v[:, :7]) == pytest.approx(5e-3, rel=0.1)
    arm, camera = recording.points
    assert (arm.name, arm.names, arm.sensor) == ("points_arm", ("w_T2",), "arm")
    assert np.std(arm.position[:, 0] - run.points[:, 1]) == pytest.approx(1e-3, rel=0.1)
    assert (camera.name, camera.names, camera.sensor) == ("points_camera", ("w_T1", "w_T3"), "camera")
    assert np.diff(camera.t).max() > 1.0
    assert 0.2 < np.diff(camera.t).min() < 0.45
    for column, point in enumerate(camera.names):
        truth = run.points[:, system.points.index(point)]
        path = np.column_stack([np.interp(camera.t, run.t, truth[:, axis]) for axis in range(3)])
        assert np.nanmax(np.abs(camera.position[:, column] - path)) < 5 * 5e-3
    assert camera.pose is not None
    assert np.linalg.norm(camera.pose[:3, 3] - run.points[0].mean(0)) == pytest.approx(2.0)
    assert TRUTH.items() <= recording.truth.items()
    assert all(name.rpartition(".")[2] in ("bend", "twist", "damping", "mass") for name in recording.truth)
    assert "MuJoCo" in recording.description


def test_sensors_have_their_own_noise() -> None:
    system = SYSTEMS[1]
    motion = Motion.multisine(system, TRUTH, seed=1)

    def record(seed: int, **options: object):  # type: ignore[no-untyped-def]
        return virtual_experiment(
            system, TRUTH, motion=motion, duration=3.0, seed=seed, time_step=5e-4, camera_missing=0.5, **options
        )

    first, again, blind, other = record(1), record(1), record(1, vision=False, effort_noise=0.3), record(2)
    for a, b in zip(first.points, again.points, strict=True):
        np.testing.assert_array_equal(a.position, b.position)
    np.testing.assert_array_equal(first.joints.position, blind.joints.position)
    np.testing.assert_array_equal(first.points[0].position, blind.points[0].position)
    assert len(blind.points) == 1
    assert not np.array_equal(first.joints.position, other.joints.position)
    assert np.std(first.joints.effort - blind.joints.effort) == pytest.approx(0.3, rel=0.1)
    assert np.isnan(first.points[1].position).any()


def test_default_recordings() -> None:
    files = sorted(DEFAULTS.glob("*_arm_*.h5"))
    assert len(files) == 8
    assert sum(path.stat().st_size for path in files) < 2.5e6
    for path in files:
        recording = read_recording(path)
        arms = 1 if path.name.startswith("single") else 2
        assert recording.joint_names == SYSTEMS[arms].driven
        assert recording.duration == pytest.approx(5.0)
        assert TRUTH.items() <= recording.truth.items()
        assert "MuJoCo" in recording.description
        expected = {"points_arm"} | ({"points_camera"} if "_no_vision" not in path.name else set())
        assert {group.name for group in recording.points} == expected


def test_default_recordings_are_reproducible() -> None:
    script = Path(__file__).resolve().parents[2] / "benchmarks" / "make_recordings.py"
    spec = importlib.util.spec_from_file_location("make_recordings", script)
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    system = SYSTEMS[2]
    posture = initial_posture(system, made.TRUTH, offsets=made.OFFSETS[2])
    seed, travel = made.MOTION_SEEDS[2, "estimate"], made.TRAVEL[2]
    motion = Motion.multisine(system, made.TRUTH, seed=seed, posture=posture, travel=travel)
    run = simulate_in_mujoco(system, made.TRUTH, motion, duration=1.0, time_step=made.INNER_STEP, posture=posture)
    joints = read_recording(DEFAULTS / "dual_arm_no_vision_estimate.h5").joints
    assert joints is not None
    np.testing.assert_allclose(joints.effort[:101], run.effort, rtol=0, atol=1e-6)


@dataclass(frozen=True)
class Pull:
    kind: str = "pull"
    location: str = "T1"

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", Parameters([Parameter("pull@T1.force", 0.0, "N m")]))
        object.__setattr__(self, "internal", {})

    def modify(self, system: System) -> System:
        return system

    def terms(self, state: MidpointState) -> Terms:
        return Terms(force=self.parameters["pull@T1.force"].symbol * state.v)  # type: ignore[attr-defined]


def test_what_mujoco_cannot_express_is_refused() -> None:
    system = clamped_beam()
    with_effect = system.with_effects([Pull()])  # type: ignore[list-item]
    assert mujoco_xml(with_effect) == mujoco_xml(system)
    with pytest.raises(ModelError, match="pull@T1"):
        mujoco_xml(with_effect, {"pull@T1.force": 1.0})
    grasp = Grasp("clamp", "clamp", "w_B", compliance=ca.SX(1e-3))
    with pytest.raises(ModelError, match="compliant"):
        mujoco_xml(replace(system, grasps=(grasp,)))
    with pytest.raises(ModelError, match="compliant"):
        mujoco_xml(replace(system, compliant={"B_0_x": ca.SX(1e-3)}))
    with pytest.raises(ModelError, match="has a mass"):
        mujoco_xml(System.build(floating_clamp("clamp")))
    beam = flexible_object([Segment("B", 0.5, 0.2, 0.01)])
    tree = SYSTEMS[1].mechanism
    bare = Frame(tree.joint_index("T2_1_y"), Placement.identity())
    with pytest.raises(ModelError, match="more than six"):
        mujoco_xml(System.build(floating_clamp("clamp"), objects=[(beam, "clamp", None)]))
    with pytest.raises(ModelError, match="sits on a joint that carries no mass"):
        mujoco_xml(replace(SYSTEMS[1], points=("bare",), mechanism=replace(tree, frames={**tree.frames, "bare": bare})))
    with pytest.raises(ConfigError, match="time_step"):
        mujoco_xml(system, time_step=0.0)


def test_experiments_that_do_not_fit_are_refused() -> None:
    system = SYSTEMS[1]
    motion = Motion.multisine(system, seed=0)
    with pytest.raises(ConfigError, match="does not divide"):
        simulate_in_mujoco(system, None, motion, time_step=3e-4)
    with pytest.raises(ModelError, match="driven joints"):
        simulate_in_mujoco(replace(system, driven=system.driven[:3], prescribed=system.driven[3:]), None, motion)
    with pytest.raises(ConfigError, match="w_T9"):
        virtual_experiment(system, motion=motion, camera_points=["w_T9"])
    with pytest.raises(ConfigError, match="arms = 3"):
        paper_system(3)


def test_without_mujoco_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(DataError, match=r"yid-ocp\[blind\]"):
        simulate_in_mujoco(SYSTEMS[1], None, Motion.multisine(SYSTEMS[1], seed=0))


def test_other_robots_start_from_the_middle_of_their_range() -> None:
    robot = read_urdf("package:panda", locked={"panda_finger_joint1": 0.0, "panda_finger_joint2": 0.0})
    beam = flexible_object([Segment("B", 0.5, 0.2, 0.01, links=2)])
    names = robot.joint_names[:7]
    placement = np.eye(4)
    placement[:3, 3] = [0.5, 0.0, 0.0]
    system = System.build(
        robot, objects=[(beam, None, placement)], grasps=[Grasp("hand", "panda_hand", "w_B")], driven=names
    )
    posture = initial_posture(system)
    assert set(names) <= set(posture)

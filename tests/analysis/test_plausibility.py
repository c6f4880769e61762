"""What a model says against a recording: Baxter holding the foam Y in MuJoCo, and a cable made up here."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.analysis.clock_checks import check_fit_for_drift_and_noise
from yid_ocp.analysis.joint_checks import (
    RecordedJointsModel,
    check_efforts_by_inverse_dynamics,
    check_inertial_effort_excitation,
    check_joint_excitation,
    check_joint_limits,
)
from yid_ocp.analysis.point_checks import check_cable_point_geometry, check_point_distances, check_robot_held_points
from yid_ocp.config.reader import load_config
from yid_ocp.data import read_recording
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.model.objects.base import CableTopology
from yid_ocp.model.system import System
from yid_ocp.model.urdf import _example_robot_urdf, read_urdf
from yid_ocp.problem import EstimationProblem, SensorOptions
from yid_ocp.solvers import solve
from yid_ocp.virtual.experiment import baxter_foam_y_system
from yid_ocp.workflow.build_problem import build_problem


def usual(_group: str) -> SensorOptions:
    return SensorOptions()


@pytest.fixture(scope="module")
def arms() -> dict[int, RecordedJointsModel]:
    systems = {count: baxter_foam_y_system(count) for count in (1, 2)}
    return {n: RecordedJointsModel.from_system(system, system.parameters.vector()) for n, system in systems.items()}


@pytest.fixture(scope="module")
def runs(clean) -> dict[int, Recording]:
    names = {1: "single_arm_vision", 2: "dual_arm_vision"}
    return {count: read_recording(clean / f"{name}_estimate.h5") for count, name in names.items()}


def with_joints(recording: Recording, **changes) -> Recording:
    made = {name: change(recording.joints) for name, change in changes.items()}
    return replace(recording, joints=replace(recording.joints, **made))


def with_points(recording: Recording, name: str, change) -> Recording:
    groups = [replace(g, position=change(g.position)) if g.name == name else g for g in recording.points]
    return replace(recording, points=tuple(groups))


def test_inverse_dynamics_are_pinocchios():
    pin = pytest.importorskip("pinocchio")
    robot = read_urdf("package:baxter", joints=[f"left_{j}" for j in ("s0", "s1", "e0", "e1", "w0", "w1", "w2")])
    system = System.build(robot, prescribed=robot.joint_names)
    arm = RecordedJointsModel.from_system(system, system.parameters.vector())
    whole = pin.buildModelFromUrdf(str(_example_robot_urdf("baxter")))
    others = [whole.getJointId(name) for name in whole.names[1:] if name not in robot.joint_names]
    model = pin.buildReducedModel(whole, others, pin.neutral(whole))
    data = model.createData()
    q, v, a = np.random.default_rng(1).uniform(-1, 1, (3, 5, 7))
    expected = np.array([pin.rnea(model, data, *row) for row in zip(q, v, a, strict=True)])
    assert np.max(np.abs(arm._inverse_dynamics(q, v, a) - expected)) < 1e-9


def test_slopes_of_places_are_their_derivatives(arms):
    arm, frames = arms[2], ("left_gripper", "right_gripper")
    q, step = np.random.default_rng(2).uniform(-1, 1, (3, 14)), 1e-6
    _, slope = arm.frame_positions_and_jacobians(frames, q)
    for j in range(14):
        up, down = q.copy(), q.copy()
        up[:, j] += step
        down[:, j] -= step
        above, below = (arm.frame_positions_and_jacobians(frames, at)[0] for at in (up, down))
        assert np.max(np.abs((above - below) / (2 * step) - slope[..., j])) < 1e-8


def times(factor, *columns):
    def change(joints):
        effort = np.array(joints.effort)
        effort[:, list(columns) or slice(None)] *= factor
        return effort

    return change


def late(by):
    def change(joints):
        rows = round(by / 0.01)
        return np.vstack([joints.effort[rows:0:-1], joints.effort[: len(joints.t) - rows]])

    return change


EFFORTS = {
    "as recorded": (1, lambda j: j.effort, set()),
    "as recorded by two": (2, lambda j: j.effort, set()),
    "a tenth": (1, times(0.1), {"effort_gain"}),
    "a thousand times": (2, times(1e3), {"effort_gain", "effort_limits"}),
    "flipped": (2, times(-1.0), {"effort_sign"}),
    "one flipped": (1, times(-1.0, 3), {"effort_sign"}),
    "one arm flipped": (2, times(-1.0, *range(7, 14)), {"effort_sign"}),
    "zero": (1, times(0.0), {"effort_zero"}),
    "one zero": (1, times(0.0, 1), {"effort_zero"}),
    "late": (2, late(0.3), {"effort_lag"}),
    "wrist off": (1, lambda j: j.effort + 5.0 * (np.arange(7) == 6), {"effort_offset"}),
}


@pytest.mark.parametrize("case", EFFORTS)
def test_efforts_beside_inverse_dynamics(arms, runs, case):
    count, change, expected = EFFORTS[case]
    found = check_efforts_by_inverse_dynamics(arms[count], with_joints(runs[count], effort=change))
    assert {doubt.cause for doubt in found} == expected
    if case == "one flipped":
        assert [doubt.channel for doubt in found] == ["effort.left_e1"]
    if case == "flipped":
        assert [doubt.channel for doubt in found] == ["effort"]
    if case == "late":
        assert "0.3 s earlier" in found[0].what


@pytest.mark.parametrize(("kind", "least", "expected"), [("command", 0.3, set()), ("sample", 0.3, {"effort_zero"}),
                                                         ("command", 2.0, {"effort_zero"})])  # fmt: skip
def test_a_joint_of_which_nothing_is_asked_may_swing(repository, kind, least, expected):
    """Friction and what the model lacks are all that it then seems to need; what holds an arm up is more."""
    robot = read_urdf(str(repository / "models" / "urdf" / "two_drives.urdf"))
    system = System.build(robot, prescribed=robot.joint_names)
    arm = RecordedJointsModel.from_system(system, system.parameters.vector())
    t = np.arange(0.0, 6.0, 0.005)
    q = np.stack([np.sin(2 * t), 0.4 * np.sin(3 * t)], axis=1)
    v = np.stack([2 * np.cos(2 * t), 1.2 * np.cos(3 * t)], axis=1)
    a = np.stack([-4 * np.sin(2 * t), -3.6 * np.sin(3 * t)], axis=1)
    q, v, a = (values * least / 2.4 for values in (q, v, a))
    needed = arm._inverse_dynamics(q, v, a)
    assert np.sqrt(np.mean(needed[:, 0] ** 2)) == pytest.approx(least, rel=0.3)
    effort = needed * [0.0, 1.0]
    recording = Recording(JointGroup(tuple(robot.joint_names), t, q, effort=effort, effort_kind=kind))
    assert {doubt.cause for doubt in check_efforts_by_inverse_dynamics(arm, recording)} == expected


def test_motion_of_another_robot_or_with_a_counterbalance(arms, runs):
    quick = with_joints(runs[1], t=lambda j: j.t / 10)
    robot = read_urdf("package:baxter", joints=arms[1].joint_names)
    system = System.build(robot, prescribed=robot.joint_names)
    free = RecordedJointsModel.from_system(system, system.parameters.vector())
    # nothing else can load an arm that holds nothing
    assert "effort_unlike" in {doubt.cause for doubt in check_efforts_by_inverse_dynamics(free, quick)}
    balanced = with_joints(runs[1], effort=lambda j: j.effort + 20.0 * (np.arange(7) == 1))
    assert check_efforts_by_inverse_dynamics(arms[1], balanced) == []


def test_limits_of_joints(arms, runs):
    arm, run = arms[1], runs[1]
    assert list(check_joint_limits(arm, run)) == []
    wide = with_joints(run, position=lambda j: j.position + 3.0 * (np.arange(7) == 3))
    assert [(d.cause, d.channel) for d in check_joint_limits(arm, wide)] == [("angle_limits", "position.left_e1")]
    degrees = with_joints(run, position=lambda j: np.degrees(j.position))
    assert [(d.cause, d.weight) for d in check_joint_limits(arm, degrees)] == [("degrees", "refused")]
    quick = with_joints(run, t=lambda j: j.t / 30)
    assert "speed_limits" in {d.cause for d in check_joint_limits(arm, quick)}


MIRROR = np.array([1.0, -1.0, 1.0])
TURN = np.array([[0.9, -np.sqrt(0.19), 0.0], [np.sqrt(0.19), 0.9, 0.0], [0.0, 0.0, 1.0]])
HELD = {
    "as recorded": (1, lambda p: p, None, ""),
    "as recorded by two": (2, lambda p: p, None, ""),
    "mirrored": (1, lambda p: MIRROR * p, "point_mirrored", "(x, -y, z)"),
    "axes exchanged": (2, lambda p: p[..., [1, 0, 2]], "point_mirrored", "(y, x, z)"),
    "in millimetres": (1, lambda p: 1e3 * p, "point_scale", "divided by 1000"),
    "shifted": (2, lambda p: p + np.array([0.1, 0.0, 0.2]), "point_frame", "shifted by (-0.1"),
    "turned": (2, lambda p: p @ TURN.T, "point_frame", "turned by 25.8 degrees"),
    "exchanged": (2, lambda p: p[:, ::-1], "point_swapped", "w_T2 and w_T3 exchanged"),
}


@pytest.mark.parametrize("case", HELD)
def test_points_that_the_arm_holds(arms, runs, case):
    count, change, cause, words = HELD[case]
    found = list(check_robot_held_points(arms[count], with_points(runs[count], "points_arm", change), usual))
    assert [doubt.cause for doubt in found] == ([] if cause is None else [cause])
    assert not found or words in found[0].what


@pytest.mark.parametrize("joint", [1, 3, 5])
@pytest.mark.parametrize("offset", [0.05, -0.03])
def test_an_encoder_whose_zero_is_off_is_named_with_its_size(arms, runs, joint, offset):
    moved = with_joints(runs[1], position=lambda j: j.position + offset * (np.arange(7) == joint))
    (doubt,) = check_robot_held_points(arms[1], moved, usual)
    name = arms[1].joint_names[joint]
    assert (doubt.cause, name in doubt.setting) == ("encoder_offset", True)
    assert f"with {-offset:+.3g}"[:9] in doubt.what.replace("+0.0499", "+0.05").replace("-0.0499", "-0.05")


def test_clocks_that_are_far_apart(arms, runs):
    groups = [replace(g, t=g.t + 0.4) if g.name == "points_arm" else g for g in runs[2].points]
    (doubt,) = check_robot_held_points(arms[2], replace(runs[2], points=tuple(groups)), usual)
    assert doubt.cause == "clock_offset"
    assert "taken +0.4 s" in doubt.what
    (doubt,) = check_robot_held_points(arms[1], stamped(runs[1], drift=0.05), usual)
    assert doubt.cause == "clock_drift"
    assert re.search(r"\+4[78][.\d]* parts per thousand fast", doubt.what)


def stamped(recording: Recording, late: float = 0.0, drift: float = 0.0) -> Recording:
    """The arm's points on a clock that is late, and runs fast, from the middle on."""
    groups = [replace(g, t=g.t + late + drift * (g.t - g.t.mean())) if "arm" in g.name else g for g in recording.points]
    return replace(recording, points=tuple(groups))


CLOCKS = {
    "as recorded": (1, 0.0, 0.0, None),
    "as recorded by two": (2, 0.0, 0.0, None),
    "late by less than a period": (1, 0.005, 0.0, None),
    "late by two periods": (1, 0.02, 0.0, "clock_offset"),
    "early by two periods": (2, -0.02, 0.0, "clock_offset"),
    "a part per thousand apart": (2, 0.0, 0.001, None),
    "a hundredth apart": (1, 0.0, 0.01, "clock_drift"),
    "late and apart": (2, 0.01, -0.02, "clock_drift"),
}


@pytest.mark.parametrize("case", CLOCKS)
def test_a_clock_that_is_a_little_off(arms, runs, case):
    count, late, drift, cause = CLOCKS[case]
    found = list(check_robot_held_points(arms[count], stamped(runs[count], late, drift), usual))
    assert [doubt.cause for doubt in found] == ([] if cause is None else [cause])
    for doubt in found:
        size, std = (float(number) for number in re.search(r"([-+\d.]+) ± ([\d.]+)", doubt.what).groups())
        told = 1e-3 * size * (-1 if "slowly" in doubt.what else 1)
        assert told == pytest.approx(drift if drift else late, rel=0.05, abs=3e-3 * std)
        assert (doubt.group, doubt.weight) == ("points_arm", "not_trusted")
        assert doubt.setting == "sensors.points_arm.use: false"


def test_a_camera_that_is_late_is_answered_by_its_latency(arms, runs):
    (group,) = stamped(runs[1], 0.03).points[:1]
    seen = replace(group, name="points_camera", sensor="camera")
    (doubt,) = check_robot_held_points(arms[1], replace(runs[1], points=(seen,)), usual)
    assert re.search(r"kind: camera_latency, location: camera, values: {delay: 0.03\d*}", doubt.setting)


def test_what_is_a_little_off_or_at_rest_is_no_wrong_clock(arms, runs):
    joints = runs[1].joints
    still = with_joints(runs[1], position=lambda j: np.repeat(j.position[:1], len(j.t), axis=0))
    place = arms[1].frame_positions_and_jacobians(("left_gripper",), joints.position[:1])[0]
    rng = np.random.default_rng(0)
    at_rest = with_points(still, "points_arm", lambda p: place + 1e-3 * rng.standard_normal(p.shape))
    assert list(check_robot_held_points(arms[1], stamped(at_rest, 0.5), usual)) == []
    short = runs[1].time_slice(-1.0, float(joints.t[200]))
    for run, off in ((runs[1], 1), (short, 0), (short, 4)):
        moved = with_joints(run, position=lambda j, off=off: j.position + 0.005 * (np.arange(7) == off))
        assert list(check_robot_held_points(arms[1], moved, usual)) == []


def test_what_no_change_explains_is_said_so(arms, runs):
    rng = np.random.default_rng(0)
    walk = np.cumsum(0.02 * rng.standard_normal((501, 1, 3)), axis=0)
    (doubt,) = check_robot_held_points(arms[1], with_points(runs[1], "points_arm", lambda p: p + walk), usual)
    assert doubt.cause == "point_unlike"


@pytest.mark.parametrize(
    ("factor", "cause"), [(1.0, None), (10.0, "point_scale"), (1 / 0.3048, "point_reach"), (-1.0, "point_reach")]
)
def test_the_object_does_not_stretch(arms, runs, factor, cause):
    recording = with_points(runs[1], "points_camera", lambda p: factor * p)
    found = check_point_distances(arms[1], arms[1].system, arms[1].theta, recording, usual)
    assert [doubt.cause for doubt in found] == ([] if cause is None else [cause])


REST = {f"p{i}": (0.1 * i, 0.0, 0.0) for i in range(9)} | {f"a{i}": (0.4, 0.07 * i, 0.0) for i in (1, 2, 3)}
CABLE = CableTopology(tuple(f"p{i}" for i in range(9)), {"a": ("p4", "a1", "a2", "a3")}, REST)
GRAVITY = np.array([0.0, 0.0, -9.81])


def hanging(seed: int = 0) -> Recording:
    """The parent as an arc below its ends, the child hanging from it, swinging a little."""
    t = np.arange(200) / 100
    at = np.linspace(-0.8, 0.8, 9)
    arc = 0.5 * np.stack([np.sin(at), 0 * at, 1 - np.cos(at)], axis=1)
    child = arc[4] + np.array([[0.0, 0.0, -0.07 * i] for i in (1, 2, 3)])
    shape = np.concatenate([arc, child])
    swing = 0.02 * np.sin(3 * t)[:, None, None] * np.ones((1, 12, 3))
    noise = 2e-4 * np.random.default_rng(seed).standard_normal((200, 12, 3))
    names = (*(f"p{i}" for i in range(9)), "a1", "a2", "a3")
    return Recording(None, (PointGroup("points", names, t, shape + swing + noise, sensor="motion capture"),), name="c")


@pytest.mark.parametrize(
    ("change", "cause", "words"),
    [
        (lambda p: p, None, ""),
        (lambda p: 10 * p, "point_scale", "9.98 times as long"),
        (lambda p: p * [1, 1, -1], "point_mirrored", "above its clamps"),
        (lambda p: p[:, [0, 1, 2, 10, 4, 5, 6, 7, 8, 9, 3, 11]], "point_swapped", "a2 and p3 exchanged"),
    ],
)
def test_a_cable_keeps_its_lengths_and_hangs(change, cause, words):
    found = list(check_cable_point_geometry(CABLE, with_points(hanging(), "points", change), GRAVITY))
    assert [doubt.cause for doubt in found] == ([] if cause is None else [cause])
    assert not found or words in found[0].what


def test_joints_of_another_name_leave_nothing_to_compare(arms, runs):
    joints = runs[1].joints
    other = JointGroup(tuple(name.replace("left", "right") for name in joints.names), joints.t, joints.position)
    assert not arms[1].has_all_angles_recorded(replace(runs[1], joints=other))
    assert arms[1].has_all_angles_recorded(runs[1])


USUAL = SensorOptions()


@pytest.fixture(scope="module")
def pendulum_arm(urdf_folder) -> RecordedJointsModel:
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    system = System.build(robot, prescribed=robot.joint_names)
    return RecordedJointsModel.from_system(system, system.parameters.vector())


def swung(pendulum_arm: RecordedJointsModel, hertz: float, size: float = 0.3, seed: int = 0) -> Recording:
    """Both joints to and fro, with the efforts that they need and noise."""
    rng, noise = np.random.default_rng(seed), 0.05
    t = 0.01 * np.arange(3001)
    phase = 2 * np.pi * hertz * t[:, None] + np.array([0.0, 1.0])
    rate = 2 * np.pi * hertz
    q, v, a = size * np.sin(phase), size * rate * np.cos(phase), -size * rate**2 * np.sin(phase)
    effort = pendulum_arm._inverse_dynamics(q, v, a) + noise * rng.standard_normal(q.shape)
    return Recording(JointGroup(pendulum_arm.joint_names, t, q, effort=effort, effort_std=noise), name="run")


@pytest.mark.parametrize(("hertz", "said"), [(0.02, True), (0.5, False), (1.0, False)])
def test_a_motion_so_slow_that_only_postures_tell(pendulum_arm, hertz, said):
    for seed in range(3):
        found = list(check_inertial_effort_excitation(pendulum_arm, swung(pendulum_arm, hertz, 0.03, seed=seed), USUAL))
        assert [(d.cause, d.weight) for d in found] == ([("weak_excitation", "warning")] if said else [])


def test_less_noise_sees_more_and_efforts_that_nobody_uses_do_not_count(pendulum_arm):
    slow = swung(pendulum_arm, 0.02, 0.03)
    assert list(check_inertial_effort_excitation(pendulum_arm, slow, replace(USUAL, std=1e-4))) == []
    assert len(list(check_inertial_effort_excitation(pendulum_arm, slow, replace(USUAL, std=10.0)))) == 1
    assert list(check_inertial_effort_excitation(pendulum_arm, slow, replace(USUAL, use=False))) == []


def test_a_joint_that_never_turns_tells_nothing_of_its_own_spring(pendulum_arm):
    asked = {"elbow": ("elbow.stiffness", "elbow.damping")}
    recording = swung(pendulum_arm, 0.5)
    still = replace(recording.joints, position=recording.joints.position * [1.0, 0.01])
    held = replace(recording, joints=still, name="held")
    (doubt,) = check_joint_excitation([held], asked, USUAL)
    assert (doubt.cause, doubt.channel, doubt.recording) == ("weak_excitation", "position.elbow", "held")
    assert doubt.setting == "parameters.elbow.stiffness.free: false; parameters.elbow.damping.free: false"
    assert list(check_joint_excitation([held, recording], asked, USUAL)) == []
    assert list(check_joint_excitation([held], {"shoulder": ("shoulder.damping",)}, USUAL)) == []
    coarse = replace(USUAL, std=0.2)
    assert len(list(check_joint_excitation([recording], asked, coarse))) == 1


@pytest.fixture(scope="module")
def springs(repository):
    run = load_config(repository / "configs" / "springs_series_joint.yaml", ["problem.use_compiler=false"])
    return run, build_problem(run)


def doubts(springs, late=0.0, drift=0.0, std=None):
    """Doubts after a fit of the recording on another clock, or with another noise in the settings."""
    run, problem = springs
    recording = problem.episodes[0].recording
    group = recording.points[0]
    moved = replace(group, t=group.t + late + drift * (group.t - group.t.mean()))
    inside = (moved.t >= recording.joints.t[0]) & (moved.t <= recording.joints.t[-1])
    moved = replace(moved, t=moved.t[inside], position=moved.position[inside], std=group.std[inside])
    options = problem.options
    if std is not None:
        own = replace(options.sensors.get(group.name, SensorOptions()), std=std)
        options = replace(options, sensors={**options.sensors, group.name: own})
    made = EstimationProblem(problem.step, [replace(recording, points=(moved,))], problem.free, options)
    solution = solve(made, run.solver)
    return check_fit_for_drift_and_noise(solution.problem or made, solution.x, solution.evaluation)


def test_a_fit_of_a_sound_recording_raises_nothing_and_a_late_clock_is_left_to_a_diagnosis(springs):
    assert doubts(springs) == []
    assert "clock_drift" not in {doubt.cause for doubt in doubts(springs, late=0.1)}


def test_a_clock_that_runs_apart_is_told_by_what_the_fit_leaves(springs):
    (doubt,) = doubts(springs, drift=0.01)
    assert (doubt.cause, doubt.weight, doubt.group) == ("clock_drift", "not_trusted", "points_camera")
    told, std = map(float, re.search(r"runs ([\d.]+) ± ([\d.]+) parts per thousand too fast", doubt.what).groups())
    assert told == pytest.approx(10.0, abs=4 * std + 0.5)


def test_noise_that_settings_state_ten_times_too_large(springs):
    (doubt,) = doubts(springs, std=1e-2)
    assert (doubt.cause, doubt.weight) == ("noise_overstated", "warning")
    name, value = doubt.setting.split(": ")
    assert name == "sensors.points_camera.std"
    assert float(value) == pytest.approx(1e-3, rel=0.15)
    assert np.isclose(doubt.evidence_ratio, 1e-2 / (5 * float(value)), rtol=0.05)

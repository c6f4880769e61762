"""What a model says against a recording: Baxter holding the foam Y in MuJoCo, and a cable made up here."""

import re
from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from baxter import baxter_foam_y_system
from small_problems import joints, measured, pendulum_step, points, recording, seen

from yid_ocp.analysis.clock_checks import clock_and_noise_issues_from_residuals, point_clock_offset_drift_and_rms_error
from yid_ocp.analysis.estimation import prediction_errors_units_and_fit_rmse
from yid_ocp.analysis.joint_checks import (
    RecordedJointsModel,
    _loaded,
    inverse_dynamics_effort_issues,
    joint_excitation_issues,
    joint_limit_issues,
    slow_motion_excitation_issues,
)
from yid_ocp.analysis.point_checks import (
    _moved,
    cable_point_geometry_issues,
    correctable_object_point_issues,
    forward_kinematics_issues,
    points_too_distant_issues,
)
from yid_ocp.config.reader import load_config
from yid_ocp.data import read_recording
from yid_ocp.data.channel_checks import QUALITY_LIMITS
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.effects import make_effect
from yid_ocp.model import FlexibleSegment, Grasp, System, flexible_object
from yid_ocp.model.kinematics import forward_kinematics, lagrangian_first_derivatives
from yid_ocp.model.objects.base import CableVertices
from yid_ocp.model.urdf import read_urdf, urdf_path_from_robot_name
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.problem.options import ExcessResidualCriteria
from yid_ocp.solvers import GaussNewton, fit_problem
from yid_ocp.workflow.build_problem import build_problem


def usual(_group: str) -> SensorOptions:
    return SensorOptions()


def free_arm(source, **how) -> RecordedJointsModel:
    """Joints that hold nothing."""
    robot = read_urdf(source, **how)
    return RecordedJointsModel.from_system(System.build(robot, prescribed=robot.joint_names))


@pytest.fixture(scope="module")
def arms() -> dict[int, RecordedJointsModel]:
    systems = {count: baxter_foam_y_system(count) for count in (1, 2)}
    return {n: RecordedJointsModel.from_system(system) for n, system in systems.items()}


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
    arm = free_arm("package:baxter", joints=[f"left_{j}" for j in ("s0", "s1", "e0", "e1", "w0", "w1", "w2")])
    whole = pin.buildModelFromUrdf(str(urdf_path_from_robot_name("package:baxter")))
    others = [whole.getJointId(name) for name in whole.names[1:] if name not in arm.joint_names]
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
        turned = step * (np.arange(14) == j)
        above, below = (arm.frame_positions_and_jacobians(frames, at)[0] for at in (q + turned, q - turned))
        assert np.max(np.abs((above - below) / (2 * step) - slope[..., j])) < 1e-8


def times(factor, *columns):
    def change(joints):
        chosen = np.isin(np.arange(len(joints.names)), columns) if columns else True
        return joints.effort * np.where(chosen, factor, 1.0)

    return change


def late(rows):
    return lambda joints: np.vstack([joints.effort[rows:0:-1], joints.effort[: len(joints.t) - rows]])


def offset(torque, column, *, rubs=False):
    """An offset, with what else lives in a joint: viscous and dry friction and a spring."""

    def change(joints):
        angle = joints.position[:, column] - joints.position[:, column].mean()
        speed = np.gradient(angle, joints.t)
        more = 0.3 * (speed + np.tanh(speed / 0.02) + angle) if rubs else 0.0
        return joints.effort + np.outer(torque + more, np.arange(joints.effort.shape[1]) == column)

    return change


ARM_FLIPPED = {"right_s0": 1.390, "right_s1": 2.551, "right_e0": 1.165, "right_e1": 1.364, "right_w0": 1.022}
SIGNS = [("effort_sign", name, ratio, f"of {name} has") for name, ratio in ARM_FLIPPED.items()]
THOUSAND = [("effort_limits", "right_s1", 562.7, "732 times its effort limit (50 N m; 1.3 times is")]
THOUSAND += [("effort_gain", "", 388.8, "efforts are 1200 times")]
EFFORTS = {
    "as recorded": (1, lambda j: j.effort, []),
    "as recorded by two": (2, lambda j: j.effort, []),
    "a tenth": (1, times(0.1), [("effort_gain", "", 2.559, "efforts are 0.13 times")]),
    "a thousand times": (2, times(1e3), THOUSAND),
    "flipped": (2, times(-1.0), [("effort_sign", "", 2.551, "all efforts have the opposite sign")]),
    "one flipped": (1, times(-1.0, 3), [("effort_sign", "left_e1", 1.915, "of left_e1 has the opposite sign")]),
    "one arm flipped": (2, times(-1.0, *range(7, 14)), SIGNS),
    "zero": (1, times(0.0), [("effort_zero", "", 1e3, "left_s1, left_e1 is zero throughout")]),
    "one next to zero": (1, times(1e-4, 1), [("effort_zero", "", 1e3, "of left_s1 is zero")]),
    "late": (2, late(30), [("effort_lag", "", 3.0, "0.3 s earlier")]),
    "wrist off": (1, offset(5.0, 6), [("effort_offset", "left_w2", 2.223, "error of +5 N m")]),
    "wrist far off": (1, offset(12.0, 6), [("effort_offset", "left_w2", 5.334, "error of +12 N m")]),
    "a wrist rubs off": (1, offset(-5.0, 6, rubs=True), [("effort_offset", "left_w2", 2.207, "error of -4.97 N m")]),
    "wrist ten times": (1, times(10.0, 6), [("effort_gain", "left_w2", 1.545, "10 times what gravity")]),
    "what may hang on the gripper": (1, offset(20.0, 2), []),
}


@pytest.mark.parametrize(("case", "begun"), [*((case, 0.0) for case in EFFORTS), ("late", 1e4)])
def test_efforts_beside_inverse_dynamics(arms, runs, case, begun):
    count, change, expected = EFFORTS[case]
    run = with_joints(runs[count], effort=change, t=lambda j: j.t + begun)
    found = inverse_dynamics_effort_issues(arms[count], run)
    assert_issues(found, expected)
    assert {(doubt.recording, doubt.severity) for doubt in found} <= {(runs[count].name, "not_trusted")}


def assert_issues(found, expected, quantity="effort"):
    """Cause, joint, evidence and a part of the words of every issue, of the channel of a quantity."""
    named = [(cause, f"{quantity}.{joint}" if joint else quantity) for cause, joint, *_ in expected]
    assert [(doubt.cause, doubt.channel) for doubt in found] == named
    for doubt, (*_, ratio, words) in zip(found, expected, strict=True):
        assert doubt.limit_violation_ratio == pytest.approx(ratio, rel=1e-3)
        assert words in doubt.what


@pytest.fixture(scope="module")
def drives(repository) -> RecordedJointsModel:
    return free_arm(repository / "models" / "urdf" / "two_drives.urdf")


def swing(t, size=1.0, rate=2.0):
    """Angles, speeds and accelerations."""
    angle, rate = size * np.array([1.0, 0.4]), rate * np.array([1.0, 1.5])
    phase = rate * t[:, None]
    return angle * np.sin(phase), angle * rate * np.cos(phase), -angle * rate**2 * np.sin(phase)


def needed(drives, q, v, a):
    """Efforts (N, k) of rigid bodies, as the Lagrangian has them."""
    tree, (x, w, u) = drives.system.mechanism_with_values(), (ca.SX.sym(name, 2) for name in "xwu")
    terms = lagrangian_first_derivatives(forward_kinematics(tree, x), w, drives.system.gravity)
    effort = ca.jtimes(terms.lagrangian_by_v, x, w) + ca.jtimes(terms.lagrangian_by_v, w, u) - terms.lagrangian_by_q
    return np.array(ca.Function("needed", [x, w, u], [effort]).map(len(q))(q.T, v.T, a.T)).T


def swung(drives, change=lambda e: e, size=1.0, rate=2.0, behind=0.0, noise=0.0, length=12.0, seed=0, **more):
    """Two drives that swing, with the efforts that they need, changed, and noise."""
    t = np.arange(0.0, length, 0.005)
    effort = change(needed(drives, *swing(t - behind, size, rate)))
    effort = effort + noise * np.random.default_rng(seed).standard_normal(effort.shape)
    return Recording(JointGroup(drives.joint_names, t, swing(t, size, rate)[0], effort=effort, **more), name="run")


LIMIT = ("effort_limits", "shoulder", 3.218, "of shoulder is 4.18 times its effort limit (6 N m; 1.3")
ELBOW_LIMIT = ("effort_limits", "elbow", 1.345, "of elbow is 1.75 times its effort limit (6 N m; 1.3")
SWUNG = {
    "as needed": (lambda e: e, 0.0, []),
    "one a tenth": (lambda e: e * [0.1, 1.0], 0.0, [("effort_gain", "shoulder", 3.124, "0.1 times what gravity")]),
    "one ten times": (lambda e: e * [10, 1], 0.0, [LIMIT, ("effort_gain", "shoulder", 31.80, "10 times what gravity")]),
    "other ten": (lambda e: e * [1, 10], 0.0, [ELBOW_LIMIT, ("effort_gain", "elbow", 32.30, "10 times what gravity")]),
    "other a tenth": (lambda e: e * [1.0, 0.1], 0.0, [("effort_gain", "elbow", 3.175, "0.1 times what gravity")]),
    "ten times": (lambda e: 10 * e, 0.0, [LIMIT, ("effort_gain", "", 10 / 3, "efforts are 10 times")]),
    "a tenth": (lambda e: 0.1 * e, 0.0, [("effort_gain", "", 10 / 3, "efforts are 0.1 times")]),
    "flipped": (lambda e: -e, 0.0, [("effort_sign", "", 7.172, "all efforts")]),
    "one flipped": (lambda e: e * [-1.0, 1.0], 0.0, [("effort_sign", "shoulder", 7.061, "of shoulder has")]),
    "one off": (lambda e: e + np.array([0.0, 1.0]), 0.0, [("effort_offset", "elbow", 1.051, "error of +0.946 N m")]),
    "other off": (lambda e: e - [-3.0, 0.0], 0.0, [("effort_offset", "shoulder", 2.390, "error of +2.15 N m")]),
    "a little off": (lambda e: e + np.array([0.0, 0.9]), 0.0, []),
    "balanced": (lambda e: e - [3.0, 0.0], 0.0, []),
    "late": (lambda e: e, 0.1, [("effort_lag", "", 1.0, "0.1 s earlier")]),
    "early": (lambda e: e, -0.3, [("effort_lag", "", 3.0, "0.3 s later")]),
    "a little late": (lambda e: e, 0.04, []),
}


@pytest.mark.parametrize("case", SWUNG)
def test_efforts_of_two_drives_that_swing(drives, case):
    change, behind, expected = SWUNG[case]
    found = inverse_dynamics_effort_issues(drives, swung(drives, change, behind=behind))
    assert_issues(found, expected)
    lag = f"model.effects: [{{kind: effort_delay, location: gripper, values: {{delay: {behind:g}}}}}]"
    assert [doubt.setting for doubt in found if "lag" in doubt.cause] == {0.1: [lag], -0.3: [""]}.get(behind, [])
    rod = flexible_object([FlexibleSegment("T1", 0.3, 0.1, 0.01, links=1, bend=1.0, twist=1.0)])
    held = {"objects": [(rod, "tip", None)], "grasps": [Grasp("far", "stand", "w_T1", "point")]}
    loop = System.build(drives.system.mechanism, prescribed=drives.joint_names, **held)
    found = inverse_dynamics_effort_issues(RecordedJointsModel.from_system(loop), swung(drives, change, behind=behind))
    assert {issue.cause for issue in found} <= {"effort_limits"}, "a stretched object loads joints without a limit"


@pytest.mark.parametrize(("kind", "least", "expected"), [("command", 0.3, set()), ("sample", 0.3, {"effort_zero"}),
                                                         ("command", 2.0, {"effort_zero"})])  # fmt: skip
def test_a_joint_of_which_nothing_is_asked_may_swing(drives, kind, least, expected):
    """Friction and what the model lacks are all that it then seems to need; what holds an arm up is more."""
    needed = swung(drives, size=least / 2.4, length=6.0).joints.effort[:, 0]
    assert np.sqrt(np.mean(needed**2)) == pytest.approx(least, rel=0.3)
    recording = swung(drives, lambda e: e * [0.0, 1.0], least / 2.4, length=6.0, effort_kind=kind)
    assert {doubt.cause for doubt in inverse_dynamics_effort_issues(drives, recording)} == expected


def test_an_unknown_payload_is_no_wrong_gain(drives):
    payload = make_effect("payload", "tip", drives.system)
    system, names = drives.system.with_effects([payload]), payload.parameters.names
    known = system.parameters.with_nominal_values({"payload@tip.mass": 1.2, "payload@tip.mz": -0.3})
    run = swung(RecordedJointsModel.from_system(replace(system, parameters=known)))
    for free, expected in (((), ["effort_gain"]), (names, [])):
        found = inverse_dynamics_effort_issues(RecordedJointsModel.from_system(system, free), run)
        assert [doubt.cause for doubt in found] == expected


def test_motion_of_another_robot_or_with_a_counterbalance(arms, runs):
    quick = with_joints(runs[1], t=lambda j: j.t / 10)
    free = free_arm("package:baxter", joints=arms[1].joint_names)
    # nothing else can load an arm that holds nothing
    for arm, many, times_off, ratio in ((arms[1], 4, "4.3", 1.425), (free, 7, "6.6", 2.212)):
        found = inverse_dynamics_effort_issues(arm, quick)
        assert_issues(found, [("effort_unlike", "", ratio, f"efforts of {many} of 7 joints (")])
        assert f"{times_off} times the usual model error" in found[0].what
    balanced = with_joints(runs[1], effort=lambda j: j.effort + 20.0 * (np.arange(7) == 1))
    assert inverse_dynamics_effort_issues(arms[1], balanced) == []


def test_too_little_of_a_recording_says_nothing(arms, runs, drives):
    arm, few = arms[1], runs[1].time_slice(-1.0, float(runs[1].joints.t[8]))
    blind = replace(with_joints(few, position=lambda j: 9.0 * j.position), joints=None)
    deaf = with_joints(runs[1], effort=lambda _: None)
    for check in (inverse_dynamics_effort_issues, lambda *given: slow_motion_excitation_issues(*given, USUAL)):
        assert [list(check(arm, run)) for run in (few, blind, deaf)] == [[], [], []]
    assert list(joint_limit_issues(arm, with_joints(few, t=lambda j: j.t / 30))) == []
    assert list(joint_limit_issues(arm, blind)) == list(forward_kinematics_issues(arm, blind, usual)) == []
    assert list(joint_excitation_issues([blind, runs[1]], {"else": ("else.damping",)}, USUAL)) == []
    assert list(slow_motion_excitation_issues(drives, swung(drives, size=1e-3, **SLOW), USUAL)) == []
    runs = (swung(drives, lambda e: 1e3 * e, length=0.005 * (count - 0.5)) for count in (29, 30))
    assert [len(inverse_dynamics_effort_issues(drives, run)) for run in runs] == [0, 2], "thirty samples are enough"


def test_limits_of_joints(arms, runs):
    arm, run = arms[1], runs[1]
    assert list(joint_limit_issues(arm, run)) == []
    for shift, past, ratio in ((3.0, 1.74, 17.44), (-3.0, 1.94, 19.42)):
        wide = with_joints(run, position=lambda j, by=shift: j.position + by * (np.arange(7) == 3))
        (doubt,) = joint_limit_issues(arm, wide)
        words = f"left_e1 goes {past} rad beyond its limits of -0.05 to 2.62"
        assert_issues([doubt], [("angle_limits", "left_e1", ratio, words)], "position")
        assert (doubt.group, doubt.recording) == ("joints", run.name)
    (doubt,) = joint_limit_issues(arm, with_joints(run, position=lambda j: np.degrees(j.position)))
    assert_issues([doubt], [("degrees", "", 754.1, "angles reach 78 rad")], "position")
    assert doubt.severity == "refused"
    fast = list(joint_limit_issues(arm, with_joints(run, t=lambda j: j.t / 30)))
    words = "left_e1 turns 10.4 times as fast as its speed limit (1.5 rad/s; 1.5 times"
    assert_issues(fast, [("speed_limits", "", 6.959, words)], "t")


MIRROR, WALK = np.array([1.0, -1.0, 1.0]), np.cumsum(0.02 * np.random.default_rng(0).standard_normal((501, 1, 3)), 0)
TURN = np.array([[0.9, -np.sqrt(0.19), 0.0], [np.sqrt(0.19), 0.9, 0.0], [0.0, 0.0, 1.0]])
HELD = {
    "as recorded": (1, lambda p: p, None, ""),
    "as recorded by two": (2, lambda p: p, None, ""),
    "mirrored": (1, lambda p: MIRROR * p, "point_mirrored", "replaced by (x, -y, z) (a mirror image)"),
    "turned about x": (1, lambda p: p * [1, -1, -1], "point_mirrored", "replaced by (x, -y, -z)"),
    "axes exchanged": (2, lambda p: p[..., [1, 0, 2]], "point_mirrored", "replaced by (y, x, z) (a mirror"),
    "shifted": (2, lambda p: p + np.array([0.1, 0.0, 0.2]), "point_frame", "shifted by (-0.1"),
    "turned": (2, lambda p: p @ TURN.T, "point_frame", "turned by 25.8 degrees"),
    "exchanged": (2, lambda p: p[:, ::-1], "point_swapped", "w_T2 and w_T3 are exchanged"),
    "walking away": (1, lambda p: p + WALK[: len(p)], "point_unlike", "no change of unit, axes, names, frame, clock"),
}
# millimetres, centimetres, inches, decimetres and feet, and read as such
for unit in (1e-3, 1e-2, 0.0254, 0.1, 0.3048):
    for scale in (unit, 1 / unit):
        HELD[f"times {scale:.3g}"] = (2, lambda p, by=scale: by * p, "point_scale", f"are divided by {scale:g}")


@pytest.mark.parametrize("case", HELD)
def test_points_that_the_arm_holds(arms, runs, case):
    count, change, cause, words = HELD[case]
    found = list(forward_kinematics_issues(arms[count], with_points(runs[count], "points_arm", change), usual))
    assert [doubt.cause for doubt in found] == ([] if cause is None else [cause])
    for doubt in found:
        assert words in doubt.what
        assert ("explains this" if case == "walking away" else f"but only 0.001{6 + count} m if ") in doubt.what
        [group] = (group for group in runs[count].points if group.name == "points_arm")
        apart = np.linalg.norm(change(group.position) - group.position, axis=2)
        assert doubt.group == "points_arm"
        assert doubt.limit_violation_ratio == pytest.approx(min(np.sqrt(np.nanmean(apart**2)) / 0.01, 1e3), rel=5e-3)
        assert f"points ({', '.join(np.array(group.names)[np.nanmean(apart**2, axis=0) > 1e-4])}) are" in doubt.what


@pytest.mark.parametrize("joint", [1, 3, 5])
@pytest.mark.parametrize("offset", [0.05, -0.03])
def test_an_encoder_whose_zero_is_off_is_named_with_its_size(arms, runs, joint, offset):
    moved = with_joints(runs[1], position=lambda j: j.position + offset * (np.arange(7) == joint))
    (doubt,) = forward_kinematics_issues(arms[1], moved, usual)
    name = arms[1].joint_names[joint]
    assert (doubt.cause, doubt.group, doubt.channel) == ("encoder_offset", "joints", f"position.{name}")
    size, found = re.search(r"([-+\d.]+) rad are.*location: (\S+, .*)}}", f"{doubt.what} {doubt.setting}").groups()
    assert float(size) == pytest.approx(-offset, abs=2e-4)
    assert found == f"{name}, values: {{offset: {-float(size):.3g}"


@pytest.mark.parametrize(("std", "is_known"), [(0.02, False), (1e-3, True), (None, True)])
def test_points_may_be_as_far_off_as_they_are_said_to_be(arms, runs, std, is_known):
    def moved(group):
        level = None if std is None else np.full(group.position.shape, std)
        return replace(group, position=group.position + np.array([0.06, 0.0, 0.0]), std=level)

    groups = tuple(moved(g) if g.name == "points_arm" else g for g in runs[1].points)
    found = list(forward_kinematics_issues(arms[1], replace(runs[1], points=groups), usual))
    assert [doubt.cause for doubt in found] == (["point_frame"] if is_known else [])


def test_clocks_that_are_far_apart(arms, runs):
    (doubt,) = forward_kinematics_issues(arms[2], stamped(runs[2], 0.2, -0.05), usual)
    assert "if their clock is corrected by -0.202 s and +5.24 %" in doubt.what
    groups = [replace(g, t=g.t + 0.4) if g.name == "points_arm" else g for g in runs[2].points]
    (doubt,) = forward_kinematics_issues(arms[2], replace(runs[2], points=tuple(groups)), usual)
    assert (doubt.cause, doubt.limit_violation_ratio) == ("clock_offset", pytest.approx(6.603, rel=2e-3))
    assert ("-0.4 s" in doubt.what, "add -0.4 s" in doubt.advice) == (True, True)
    (doubt,) = forward_kinematics_issues(arms[1], stamped(runs[1], drift=0.05), usual)
    assert (doubt.cause, doubt.limit_violation_ratio) == ("clock_drift", pytest.approx(1.392, rel=2e-3))
    assert re.search(r"-4\.[78]\d* %", doubt.what)
    late, drift, middle = map(float, re.search(r"by t (\S+) (\S+) \(t - (\S+)\)", doubt.advice).groups())
    assert (late, drift, middle) == (pytest.approx(0.0, abs=2e-4), pytest.approx(-0.05 / 1.05, rel=5e-3), 2.5)


def stamped(recording: Recording, late: float = 0.0, drift: float = 0.0) -> Recording:
    """The arm's points on a clock that is late, and runs fast, from the middle on."""
    groups = [replace(g, t=g.t + late + drift * (g.t - g.t.mean())) if "arm" in g.name else g for g in recording.points]
    return replace(recording, points=tuple(groups))


KEPT = np.arange(501)[:, None, None] % 9 > 0
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
    gaps = with_points(stamped(runs[count], late, drift), "points_arm", lambda p: np.where(KEPT[: len(p)], p, np.nan))
    found = list(forward_kinematics_issues(arms[count], gaps, usual))
    assert [doubt.cause for doubt in found] == ([] if cause is None else [cause])
    for doubt in found:
        size, std = (float(number) for number in re.search(r"([-+\d.]+) ± ([\d.]+)", doubt.what).groups())
        backward = "slowly" if drift else " ms early"
        told = (1e-2 if drift else 1e-3) * size * (-1 if backward in doubt.what else 1)
        assert told == pytest.approx(drift if drift else late, rel=0.05, abs=(3e-2 if drift else 3e-3) * std)
        assert (doubt.group, doubt.severity) == ("points_arm", "not_trusted")
        assert doubt.setting == "sensors.points_arm.use: false"
        # over the limit of half a period of both, at the end of the recording for a drift
        assert doubt.limit_violation_ratio == pytest.approx(abs(5.0 * drift if drift else late) / 0.01, rel=0.03)
        if drift:
            ends = re.findall(r"([.\d]+) ms (late|early)", doubt.what)
            begin, end = (float(number) * (1 if side == "late" else -1) for number, side in ends)
            assert (end - begin, end + begin) == pytest.approx((5e3 * drift, 2e3 * late), abs=2.0)


def test_a_camera_that_is_late_is_answered_by_its_latency(arms, runs):
    (group,) = stamped(runs[1], 0.03).points[:1]
    seen = replace(group, name="points_camera", sensor_name="camera")
    (doubt,) = forward_kinematics_issues(arms[1], replace(runs[1], points=(seen,)), usual)
    assert re.search(r"kind: camera_latency, location: camera, values: {delay: 0.03\d*}", doubt.setting)


def test_what_is_a_little_off_or_at_rest_is_no_wrong_clock(arms, runs):
    joints = runs[1].joints
    still = with_joints(runs[1], position=lambda j: np.repeat(j.position[:1], len(j.t), axis=0))
    place = arms[1].frame_positions_and_jacobians(("left_gripper",), joints.position[:1])[0]
    rng = np.random.default_rng(0)
    at_rest = with_points(still, "points_arm", lambda p: place + 1e-3 * rng.standard_normal(p.shape))
    assert list(forward_kinematics_issues(arms[1], stamped(at_rest, 0.5), usual)) == []
    short = runs[1].time_slice(-1.0, float(joints.t[200]))
    for run, off in ((runs[1], 1), (short, 0), (short, 4)):
        moved = with_joints(run, position=lambda j, off=off: j.position + 0.005 * (np.arange(7) == off))
        assert list(forward_kinematics_issues(arms[1], moved, usual)) == []


@pytest.mark.parametrize(
    ("factor", "cause", "ratio"),
    [(1.0, None, 0), (10.0, "point_scale", 7.587), (1 / 0.3048, "point_reach", 2.005), (-1.0, "point_reach", 1.970)],
)
def test_the_object_does_not_stretch(arms, runs, factor, cause, ratio):
    arm, recording = arms[1], with_points(runs[1], "points_camera", lambda p: factor * p)
    found = list(points_too_distant_issues(arm, arm.system, arm.system.parameters.vector(), recording, usual))
    assert [doubt.cause for doubt in found] == ([] if cause is None else [cause])
    for doubt in found:
        assert doubt.limit_violation_ratio == pytest.approx(ratio, rel=1e-3)
        assert re.fullmatch(r"w_T1 is measured \S+ m from the object's root .* 0.813 m .*\(.* \S+ m .*\)", doubt.what)


def test_two_points_on_either_side_of_the_root_are_too_far_apart_for_the_branches_between_them(arms, runs):
    recording = with_points(runs[1], "points_camera", lambda p: p + np.array([[0.0, 0.6, 0.0], [0.0, -0.6, 0.0]]))
    (doubt,) = points_too_distant_issues(arms[1], arms[1].system, arms[1].system.parameters.vector(), recording, usual)
    assert re.search(r"w_T1\b.*\b1\.81 m\b.*\bw_T3\b.*\b1\.14 m", doubt.what)


@pytest.mark.parametrize("seed", range(8))
def test_half_a_turn_is_told_as_such_although_its_cosine_may_be_rounded_below_minus_one(seed):
    rng = np.random.default_rng(seed)
    place, axis = rng.standard_normal((20, 2, 3)), rng.standard_normal(3)
    turned = 2 * np.multiply.outer(place @ axis, axis) / (axis @ axis) - place
    assert [change.words for change in _moved(turned, place)][1] == "if turned by 180 degrees and shifted"


def test_a_held_object_loads_a_joint_by_its_lever(drives):
    """By the length of a grasp's path per angle, of the grasp that moves most, whatever its direction."""
    slopes = np.array([[[[0.3, 0.0], [0.4, 0.1], [0.0, 0.0]], [[0.2, 0.0], [0.2, 0.0], [0.2, 0.1]]]])
    arm = SimpleNamespace(frame_positions_and_jacobians=lambda frames, q: (None, slopes))
    data = SimpleNamespace(holders=("a", "b"), motion=SimpleNamespace(q=np.zeros((1, 2))), arm=arm)
    reach = 30.0 * np.array([0.5, 0.1]) / (3 * 0.05)
    for factor, loaded in ((0.99, True), (1.01, False)):
        data.size = factor * reach
        assert _loaded(data).tolist() == [loaded, loaded]


def test_a_search_without_drifts_finds_a_lateness_alone():
    t, rates = np.linspace(1.0, 9.0, 200), [[1.0, 2.0, 3.0]]

    def path(at):
        return np.sin(np.multiply.outer(at, rates))

    seen = path(t - 0.2 - 0.02 * (t - 5.0))
    offset, drift, _ = point_clock_offset_drift_and_rms_error(path, (0.0, 10.0), t, seen)
    assert (offset, drift) == (pytest.approx(0.2, abs=5e-3), 0.0)
    both = point_clock_offset_drift_and_rms_error(path, (0.0, 10.0), t, seen, drifts=True)
    assert both == pytest.approx((0.2, 0.02, 0.0), abs=1e-4)


def errors_of_guess(names, value, run=None, cable=None):
    """By channel, the errors of a guess that points stay, in a prediction from 0.5 to 1 s; values (M, 3 per point)."""
    sensor = SimpleNamespace(naive_prediction="stays", point_names=names, group_name="points", outputs_per_channel=3)
    sensor.channel_names = tuple(f"points.{name}" for name in names)
    seen = SimpleNamespace(sensor=sensor, value=value, node=np.arange(len(value)), fraction=0.0)
    grid = SimpleNamespace(start_time=0.5, node_times=np.array([0.5, 1.0]))
    episode = SimpleNamespace(recording=run, name="run", measurements=[seen], grid=grid)
    options = ProblemOptions(initial_state="equilibrium", cable_vertices=cable)
    problem = SimpleNamespace(options=options, step=SimpleNamespace(time_step=0.1))
    fit = SimpleNamespace(evaluation=None)
    [told], *_ = prediction_errors_units_and_fit_rmse(problem, fit, [(episode, "not predicted")])
    return told["baselines"]["stays"]


def test_a_guess_of_a_cable_covers_the_samples_that_the_model_predicts():
    run = hanging()
    position = run.points[0].position[:, [4, 11]]
    square = np.sum((position[50:101] - position[1]) ** 2, axis=2)
    errors = errors_of_guess(("p4", "a3"), position[50:101].reshape(51, 6), run, CABLE)
    means = [*np.mean(square, axis=0), np.mean(square)]
    assert errors == pytest.approx(dict(zip(("points.p4", "points.a3", "points"), np.sqrt(means), strict=True)))


def test_a_guess_is_not_judged_by_the_sample_that_made_it():
    """A point that is seen once makes a guess without an error, which would beat every model."""
    value = np.array([[1.0, 1, 1, np.nan, np.nan, np.nan], [2.0, 2, 2, 5, 5, 5], *[[np.nan] * 6] * 2])
    assert errors_of_guess(("p", "q"), value) == pytest.approx(dict.fromkeys(("points.p", "points"), np.sqrt(3)))


POSE = np.eye(4)
POSE[:3, :3], POSE[:3, 3] = [[0.0, 0.6, 0.8], [1.0, 0.0, 0.0], [0.0, 0.8, -0.6]], [2.0, 0.5, 1.0]
BACK = np.linalg.inv(POSE)


def applied(pose):
    return lambda p: p @ pose[:3, :3].T + pose[:3, 3]


ROLLED = {
    "as predicted": (lambda p: p + 0.1, True, None, ""),
    "in the camera's frame": (applied(BACK), True, "point_frame", "if the camera's pose is applied"),
    "pose inverted": (applied(BACK @ BACK), True, "point_frame", "if the camera's pose is inverted"),
    "axis turned": (applied(POSE @ np.diag([1, -1, 1, 1]) @ BACK), True, "point_mirrored", "camera's y axis is rev"),
    "no pose is known": (applied(BACK), False, None, ""),
    "in millimetres": (lambda p: 1e3 * p, False, "point_scale", "divided by 1000"),
    "exchanged": (lambda p: p[:, [1, 0, 2]], False, "point_swapped", "if a and b are exchanged"),
    "elsewhere": (lambda p: p + 5.0 * np.sin(np.arange(3))[:, None], True, None, ""),
}


@pytest.mark.parametrize("case", ROLLED)
def test_points_far_from_a_rollout_are_explained_or_left_alone(case):
    change, posed, cause, words = ROLLED[case]
    place = np.random.default_rng(4).uniform(-1, 1, (20, 3, 3)) + np.arange(3.0)
    sensor, at = points("a", "b", "c", pose=POSE if posed else None, group="points_camera"), np.arange(20)
    episode = SimpleNamespace(name="run", measurements=(measured(sensor, at, 0.0 * at, change(place).reshape(20, 9)),))
    result = SimpleNamespace(predicted_outputs=(place.reshape(20, 9),))
    found = list(correctable_object_point_issues(episode, result, 2.0))
    assert [doubt.cause for doubt in found] == ([] if cause is None else [cause])
    for doubt in found:
        apart = np.sqrt(np.mean(np.sum((change(place) - place) ** 2, axis=2)))
        assert (doubt.recording, doubt.group, doubt.severity) == ("run", "points_camera", "not_trusted")
        assert doubt.limit_violation_ratio == pytest.approx(min(apart / (0.25 * 2.0), 1e3))
        assert words in doubt.what
    assert list(correctable_object_point_issues(episode, result, 0.0)) == []


REST = {f"p{i}": (0.1 * i, 0.0, 0.0) for i in range(9)} | {f"a{i}": (0.4, 0.07 * i, 0.0) for i in (1, 2, 3)}
CABLE = CableVertices(tuple(f"p{i}" for i in range(9)), {"a": ("p4", "a1", "a2", "a3")}, REST)
GRAVITY = np.array([0.0, 0.0, -9.81])


def hanging(seed: int = 0) -> Recording:
    """The parent as an arc below its ends, the child hanging from it, swinging a little."""
    t = np.arange(200) / 100
    at = np.linspace(-0.8, 0.8, 9)
    arc = 0.5 * np.stack([np.sin(at), 0 * at, 1 - np.cos(at)], axis=1)
    shape = np.concatenate([arc, arc[4] + np.array([[0.0, 0.0, -0.07 * i] for i in (1, 2, 3)])])
    swing = 0.02 * np.sin(3 * t)[:, None, None] * np.ones((1, 12, 3))
    noise = 2e-4 * np.random.default_rng(seed).standard_normal((200, 12, 3))
    names = (*(f"p{i}" for i in range(9)), "a1", "a2", "a3")
    return Recording(None, (PointGroup("points", names, t, shape + swing + noise, None, "motion capture"),), name="c")


@pytest.mark.parametrize(
    ("change", "cause", "words", "ratio"),
    [
        (lambda p: p, None, "", 0.0),
        (lambda p: 10 * p, "point_scale", "are 9.98 times those of the undeformed", 9.98 / 1.2),
        (lambda p: 0.5 * p, "point_scale", "are 0.499 times those of the undeformed", 0.8 / 0.499),
        (lambda p: p * [1, 1, -1], "point_mirrored", "on average 0.192 m above its clamps", 3.798),
        (
            lambda p: p[:, [0, 1, 2, 10, 4, 5, 6, 7, 8, 9, 3, 11]],
            "point_swapped",
            "3.45 times as far apart as in the undeformed object (0.625 to 1.6 times is tolerated). If a2 and p3",
            3.45 / 1.6,
        ),
    ],
)
def test_a_cable_keeps_its_lengths_and_hangs(change, cause, words, ratio):
    found = list(cable_point_geometry_issues(CABLE, with_points(hanging(), "points", change), GRAVITY))
    assert [doubt.cause for doubt in found] == ([] if cause is None else [cause])
    for doubt in found:
        assert words in doubt.what
        assert (doubt.recording, doubt.group) == ("c", "points")
        assert doubt.limit_violation_ratio == pytest.approx(ratio, rel=5e-3)


def test_a_cable_of_which_a_point_is_missing_is_judged_by_the_others():
    (group,) = with_points(hanging(), "points", lambda p: 10 * p).points
    fewer = Recording(None, (replace(group, names=group.names[:-1], position=group.position[:, :-1]),), name="c")
    (doubt,) = cable_point_geometry_issues(CABLE, fewer, GRAVITY)
    assert (doubt.cause, "are 9.98 times those of the undeformed" in doubt.what) == ("point_scale", True)
    two = Recording(None, (replace(group, names=group.names[:3], position=group.position[:, :3]),), name="c")
    assert list(cable_point_geometry_issues(CABLE, two, GRAVITY)) == []


def test_joints_of_another_name_leave_nothing_to_compare(arms, runs):
    joints = runs[1].joints
    other = JointGroup(tuple(name.replace("left", "right") for name in joints.names), joints.t, joints.position)
    assert not arms[1].recording_has_all_joint_angles(replace(runs[1], joints=other))
    assert arms[1].recording_has_all_joint_angles(runs[1])


USUAL = SensorOptions()


SLOW = {"rate": 0.12, "noise": 0.05, "effort_std": 0.05, "length": 30.0}


@pytest.mark.parametrize(("rate", "said"), [(0.12, True), (3.0, False), (6.0, False)])
def test_a_motion_so_slow_that_only_postures_tell(drives, rate, said):
    q, v, a = swing(np.arange(0.0, 30.0, 0.005), 0.03, rate)
    moving = needed(drives, q, v, a) - needed(drives, q, 0 * v, 0 * a)
    # beside friction of 4 % of the largest effort per rad/s
    seen = pytest.approx(5.0 / np.linalg.norm(np.hypot(moving, 6 * 0.04 * v) / 0.05), rel=0.02)
    for seed in range(3):
        recording = swung(drives, size=0.03, seed=seed, **{**SLOW, "rate": rate})
        found = list(slow_motion_excitation_issues(drives, recording, USUAL))
        told = [(d.cause, d.severity, d.group, d.channel, d.limit_violation_ratio) for d in found]
        assert told == ([("weak_excitation", "warning", "joints", "position", seen)] if said else [])


def test_less_noise_sees_more_and_efforts_that_nobody_uses_do_not_count(drives):
    slow = swung(drives, size=0.03, **SLOW)
    (unstated,) = slow_motion_excitation_issues(drives, with_joints(slow, effort_std=lambda _: None), USUAL)
    assert "only 1.2 standard deviations of the noise" in unstated.what
    assert list(slow_motion_excitation_issues(drives, slow, replace(USUAL, std=1e-4))) == []
    assert len(list(slow_motion_excitation_issues(drives, slow, replace(USUAL, std=10.0)))) == 1
    assert list(slow_motion_excitation_issues(drives, slow, replace(USUAL, use=False))) == []


def test_a_joint_that_never_turns_tells_nothing_of_its_own_spring(drives):
    asked = {"elbow": ("elbow.stiffness", "elbow.damping")}
    recording = swung(drives, size=0.75)
    held = replace(with_joints(recording, position=lambda j: j.position * [1.0, 0.01]), name="held")
    (doubt,) = joint_excitation_issues([held], asked, USUAL)
    words, ratio = "elbow turns by at most 0.006 rad (0.01 rad is needed", QUALITY_LIMITS.min_joint_motion / 0.006
    assert_issues([doubt], [("weak_excitation", "elbow", ratio, words)], "position")
    assert doubt.recording == "held"
    assert doubt.setting == "parameters.elbow.stiffness.free: false; parameters.elbow.damping.free: false"
    assert list(joint_excitation_issues([held, recording], asked, USUAL)) == []
    assert list(joint_excitation_issues([recording, held], asked, USUAL)) == []
    assert list(joint_excitation_issues([held], {"shoulder": ("shoulder.damping",)}, USUAL)) == []
    (doubt,) = joint_excitation_issues([held, recording], asked, replace(USUAL, std=0.2))
    assert (doubt.recording, doubt.limit_violation_ratio) == ("run", pytest.approx(6 * 0.2 / 0.6, rel=1e-3))


@pytest.fixture(scope="module")
def springs(repository):
    run = load_config(repository / "configs" / "springs_series_joint.yaml", ["problem.use_compiler=false"])
    return run, build_problem(run)


def doubts(springs, late=0.0, drift=0.0, std=None, slow=0.0, gain=1.0, **criteria):
    """Doubts after a fit of the recording on another clock, with a slow error, or another noise in the settings."""
    run, problem = springs
    recording = problem.episodes[0].recording
    turned = replace(recording.joints, position=gain * recording.joints.position)
    recording, group = replace(recording, joints=turned), recording.points[0]
    error = slow * np.sin(2 * np.pi * (group.t - group.t[0]) / np.ptp(group.t))[:, None, None]
    moved = replace(group, t=group.t + late + drift * (group.t - group.t.mean()), position=group.position + error)
    inside = (moved.t >= recording.joints.t[0]) & (moved.t <= recording.joints.t[-1])
    moved = replace(moved, t=moved.t[inside], position=moved.position[inside], std=group.std[inside])
    options = replace(problem.options, excess_residual_criteria=ExcessResidualCriteria(**criteria))
    if std is not None:
        own = replace(options.sensors.get(group.name, SensorOptions()), std=std)
        options = replace(options, sensors={**options.sensors, group.name: own})
    made = EstimationProblem(problem.step, [replace(recording, points=(moved,))], problem.free, options)
    solution = fit_problem(made, run.solver)
    return clock_and_noise_issues_from_residuals(solution.problem or made, solution.x, solution.evaluation)


def test_a_fit_of_a_sound_recording_raises_nothing_and_a_late_clock_is_left_to_a_diagnosis(springs):
    assert doubts(springs) == []
    assert "clock_drift" not in {doubt.cause for doubt in doubts(springs, late=0.1)}
    assert doubts(springs, gain=1.1) == [], "wrong angles are no clock that runs apart"
    (doubt,) = doubts(springs, late=0.6)  # beyond the linear model, in which it would be a drift as well
    told = float(re.search(r"about (\d+) ms late", doubt.what)[1])
    assert (doubt.cause, told) == ("clock_offset", pytest.approx(600.0, rel=0.05))


def test_a_clock_that_runs_apart_is_told_by_what_the_fit_leaves(springs):
    (doubt,) = doubts(springs, drift=0.01)
    assert (doubt.cause, doubt.severity, doubt.group) == ("clock_drift", "not_trusted", "points_camera")
    assert ("leave the points out" in doubt.advice, doubt.setting) == (False, "")  # the only sensor
    told, std = map(float, re.search(r"runs ([\d.]+) ± ([\d.]+) % too fast", doubt.what).groups())
    assert told == pytest.approx(1.0, abs=4 * std + 0.05)


def test_a_clock_that_runs_apart_is_told_beside_errors_of_torques(urdf_folder):
    step, t = pendulum_step(urdf_folder, driven=("shoulder",)), 0.01 * np.arange(301)
    more = {"effort_std": 0.02, "effort_kind": "command", "position_std": 1e-3}
    arm = joints(("shoulder",), t, 0.4 * np.sin(5 * t)[:, None], effort=2 * np.cos(5 * t)[:, None], **more)
    camera = seen(["tip"], t[4:-4:4], np.zeros((74, 1, 3)), "points_camera", std=np.full((74, 1, 3), 2e-3))
    made = EstimationProblem(step, [recording(arm, camera)], ["elbow.stiffness"]).simulate_synthetic_recording(seed=1)
    moved = replace(made.points[0], t=1.5 + 1.02 * (made.points[0].t - 1.5))
    problem = EstimationProblem(step, [replace(made, points=(moved,))], ["elbow.stiffness"])
    solution = fit_problem(problem, GaussNewton(), restarts=False)
    assert solution.problem.has_process_noise
    (doubt,) = clock_and_noise_issues_from_residuals(solution.problem, solution.x, solution.evaluation)
    assert (doubt.cause, doubt.group) == ("clock_drift", "points_camera")
    assert "Their clock runs 2 ± 0.04 % too fast" in doubt.what


def test_noise_that_settings_state_ten_times_too_large(springs):
    (doubt,) = doubts(springs, std=1e-2)
    assert (doubt.cause, doubt.severity, doubt.group) == ("noise_overstated", "warning", "points_camera")
    assert "the errors of points_camera after the fit, slow ones included, have a std of 0.001 m per axis" in doubt.what
    name, value = doubt.setting.split(": ")
    assert name == "sensors.points_camera.std"
    assert float(value) == pytest.approx(1e-3, rel=0.15)
    assert np.isclose(doubt.limit_violation_ratio, 1e-2 / (5 * float(value)), rtol=0.05)
    # what lasts for long counts as what it sums up to
    assert doubts(springs, std=1e-2, slow=2e-3) == []
    assert doubts(springs, std=1e-2, noise_fraction_of_stated_std=0.1) == [], "the stated noise contains model error"

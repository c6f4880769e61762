"""Experiments that were not made, rule by rule: what could see, what it would tell, how robots would move."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from yid_ocp.analysis import layouts as module
from yid_ocp.analysis.layouts import (
    ARM,
    ARM_STD,
    CAMERA,
    CAMERA_STD,
    FORWARD,
    MARKER_DISTANCE,
    TOGETHER,
    Layout,
    LayoutBuilder,
    Setting,
    View,
    _pushed_together,
    _travel,
    regular_times,
    seeing,
    sights,
)
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.errors import DataError, SolverError
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import Grasp, Segment, System, flexible_object
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.system import Spring
from yid_ocp.model.urdf import read_urdf
from yid_ocp.model.y_object import y_object
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.problem.grid import Grid

GRID = Grid(10.0, 0.1, 20)


# -- what a recording saw ---------------------------------------------------------------------------------------------


def group(name="points_camera", names=("a", "b"), t=(10.0, 10.5, 11.0), std=2e-3, **more):
    position = np.ones((len(t), len(names), 3))
    return PointGroup(name, tuple(names), np.array(t), position, std, **more)


def setting(*groups, sensors=None, frames=("a", "b", "tip"), **more):
    """A setting of one made-up recording with these groups, in a model with these frames."""
    episode = SimpleNamespace(recording=Recording(None, groups, name="run"), grid=GRID)
    problem = SimpleNamespace(
        episodes=(episode,),
        options=ProblemOptions(sensors=sensors or {}),
        system=SimpleNamespace(mechanism=SimpleNamespace(frames=dict.fromkeys(frames))),
    )
    return Setting(problem, np.zeros(1), **more), episode


def test_settings_ask_for_an_unknown_start_and_known_grasps_unless_told():
    made, _ = setting(group())
    assert (made.start, made.grasp_std, made.second_arm, made.torque_std, made.seed) == ("unknown", None, None, 0.1, 11)


@pytest.mark.parametrize(
    ("groups", "camera", "arm"),
    [
        ([group()], "points_camera", None),
        ([group("points_arm"), group()], "points_camera", "points_arm"),
        ([group("points_x", sensor="arm"), group("points_y", sensor="a camera")], "points_y", "points_x"),
        ([group("points_z", pose=np.eye(4))], "points_z", None),
        ([group("points_left_arm")], None, "points_left_arm"),
        ([group("points_mocap")], None, None),
        ([], None, None),
    ],
)
def test_cameras_and_arms_are_told_apart(groups, camera, arm):
    made, episode = setting(*groups)
    seen, felt = made.camera(episode), made.arm(episode)
    assert (None if seen[0] is None else seen[0].name) == camera
    assert (None if felt[0] is None else felt[0].name) == arm


def test_times_count_from_the_start_and_the_typical_noise_is_the_median():
    std = np.full((3, 2, 3), 2e-3)
    std[0] = [9e-3, np.nan, 9e-3]
    made, episode = setting(group(std=std), group("points_arm", t=(10.2, 10.3), std=7e-4))
    _, times, noise = made.camera(episode)
    np.testing.assert_allclose(times, [0.0, 0.5, 1.0])
    assert noise == 2e-3
    _, times, noise = made.arm(episode)
    np.testing.assert_allclose(times, [0.2, 0.3])
    assert noise == 7e-4


def test_sensors_that_were_not_there_are_typical():
    made, episode = setting()
    found, times, noise = made.camera(episode)
    assert (found, noise) == (None, CAMERA_STD)
    np.testing.assert_allclose(times, np.arange(7) / 3.0)
    found, times, noise = made.arm(episode)
    assert (found, noise) == (None, ARM_STD)
    np.testing.assert_allclose(times, 0.1 * np.arange(21), atol=1e-12)


def test_groups_that_are_not_used_see_nothing():
    made, episode = setting(group(), group("points_arm"), sensors={"points_camera": SensorOptions(use=False)})
    assert made.camera(episode)[0] is None
    assert {view.group for view in made.views(episode)} == {"points_arm"}


def test_views_are_of_the_frames_of_points_that_the_model_has():
    sensors = {"points_camera": SensorOptions(frames={"led": "tip"}), "points_arm": SensorOptions(points=("b",))}
    groups = (group(names=("a", "led", "nothing")), group("points_arm"))
    made, episode = setting(*groups, sensors=sensors)
    assert made.frames(groups[0]) == {"a": "a", "led": "tip"}
    assert made.frames(groups[1]) == {"b": "b"}
    assert [(view.group, view.frame) for view in made.views(episode)] == [
        ("points_camera", "a"),
        ("points_camera", "tip"),
        ("points_arm", "b"),
    ]


def test_views_are_where_points_were_seen():
    made = group()
    position, std = made.position.copy(), np.arange(18.0).reshape(3, 2, 3) + 1
    position[1, 1] = np.nan
    chosen, episode = setting(replace(made, position=position, std=std))
    first, second = chosen.views(episode)
    np.testing.assert_allclose(first.times, [0.0, 0.5, 1.0])
    np.testing.assert_array_equal(first.std, std[:, 0])
    np.testing.assert_allclose(second.times, [0.0, 1.0])
    np.testing.assert_array_equal(second.std, std[[0, 2], 1])


def test_a_stated_noise_level_replaces_the_recorded_one():
    made, episode = setting(group(std=None), sensors={"points_camera": SensorOptions(std=3e-3)})
    assert made.camera(episode)[2] == 3e-3
    assert made.views(episode)[1].std.shape == (3, 3)
    unknown, episode = setting(group(std=None))
    with pytest.raises(DataError, match="the noise level of group 'points_camera' is not known"):
        unknown.views(episode)


@pytest.mark.parametrize(
    ("rate", "times"),
    [(1.0, [0.0, 1.0, 2.0]), (0.4, [0.0]), (1.5, [0.0, 2 / 3, 4 / 3, 2.0]), (10.0, 0.1 * np.arange(21))],
)
def test_an_even_clock_covers_the_recording(rate, times):
    np.testing.assert_allclose(regular_times(GRID, rate), times, atol=1e-12)


# -- information ------------------------------------------------------------------------------------------------------


def sloped(seed=3, episodes=1, unknowns=2):
    """A layout whose frames move by random slopes; information that is fixed is 7 of the first unknown."""
    rng = np.random.default_rng(seed)
    grid = Grid(10.0, 0.5, 4)
    slopes = {
        (i, "camera", frame): rng.standard_normal((5, 3, unknowns)) for i in range(episodes) for frame in ("a", "b")
    }
    fixed = np.zeros((unknowns, unknowns))
    fixed[0, 0] = 7.0
    problem = SimpleNamespace(episodes=[SimpleNamespace(grid=grid)] * episodes)
    return Layout(problem, np.zeros(unknowns), ("p", "q"), slopes, fixed)


def view(times, std, frame="a"):
    return View("camera", frame, np.array(times), np.array(std, float) * np.ones((len(times), 3)))


def test_no_views_tell_what_is_fixed():
    made = sloped()
    found = made.information([[]])
    np.testing.assert_array_equal(found, made.fixed)
    found += 1.0
    assert made.fixed[1, 1] == 0.0


@pytest.mark.parametrize(
    ("time", "weights"),
    [
        (0.0, {0: 1.0}),
        (0.5, {1: 1.0}),
        (0.75, {1: 0.5, 2: 0.5}),
        (1.6, {3: 0.8, 4: 0.2}),
        (2.0, {4: 1.0}),
        (-0.1, {}),
        (2.1, {}),
    ],
    ids=["start", "node", "halfway", "part of the way", "end", "before", "after"],
)
def test_a_view_is_interpolated_between_nodes(time, weights):
    made = sloped()
    std = np.array([[0.1, 0.2, 0.5]])
    rows = sum((w * made.slopes[0, "camera", "a"][k] for k, w in weights.items()), np.zeros((3, 2))) / std.T
    found = made.information([[view([time], std)]])
    np.testing.assert_allclose(found - made.fixed, rows.T @ rows, atol=1e-9)


def test_views_add_up_over_frames_times_and_recordings():
    made = sloped(episodes=3)
    first, second = [view([0.0, 1.0], 0.1)], [view([0.5], 0.2), view([0.5], 0.2, "b")]

    def of(i, frame, node, std):
        rows = made.slopes[i, "camera", frame][node] / std
        return rows.T @ rows

    def lists(i, chosen):
        if chosen is first:
            return of(i, "a", 0, 0.1) + of(i, "a", 2, 0.1)
        return of(i, "a", 1, 0.2) + of(i, "b", 1, 0.2)

    wanted = made.fixed + lists(0, first) + lists(1, second) + lists(2, first)
    np.testing.assert_allclose(made.information([first, second]), wanted)
    # each once: the same views again come from memory, others do not
    assert len(made._known) == 4 + 0 * 3
    np.testing.assert_allclose(made.information([first, second]), wanted)
    finer = made.information([[view([0.0, 1.0], 0.05)], second])
    np.testing.assert_allclose(finer - wanted, 3 * (lists(0, first) + lists(2, first)), atol=1e-9)


# -- what could be seen -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rod():
    return flexible_object([Segment("T1", 0.6, 0.1, 0.02, links=3, bend=4.0, twist=3.0)])


@pytest.fixture(scope="module")
def holding(urdf_folder, rod):
    """A pendulum of two motors that takes the end of a rod on the ground."""
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    return System.build(
        robot, objects=[(rod, None, None)], grasps=[Grasp("hand", "tip", "w_T1")], driven=["shoulder", "elbow"]
    )


@pytest.mark.parametrize(
    ("links", "names"),
    [
        (1, ["w_T1", "T1_marker"]),
        (2, ["w_T1", "T1_0_tip", "T1_marker"]),
        (3, ["w_T1", "T1_1_tip", "T1_marker"]),
        (4, ["w_T1", "T1_1_tip", "T1_marker"]),
    ],
)
def test_a_segment_has_a_tip_a_middle_and_a_marker(links, names):
    tube = flexible_object([Segment("T1", 0.6, 0.1, 0.02, links=links, bend=4.0, twist=3.0)])
    found = sights(System.build(None, objects=[(tube, None, None)]))
    assert [sight.name for sight in found] == names
    assert [sight.arm for sight in found] == [False] * len(names)
    assert found[-1].words == "a marker 3 cm off the axis at the end of T1"
    assert [sight.frame is None for sight in found] == [True] * (len(names) - 1) + [False]


def test_markers_at_held_ends_can_be_felt(holding):
    assert {sight.name: sight.arm for sight in sights(holding)} == {
        "w_T1": False,
        "T1_1_tip": False,
        "T1_marker": True,
    }


def places(system, frames, q):
    """Positions of frames at a configuration."""
    symbol = ca.SX.sym("q", system.size)
    kinematics = forward_kinematics(system.mechanism, symbol)
    expression = ca.horzcat(*(kinematics.position(frame) for frame in frames))
    function = ca.Function("at", [symbol, system.parameters.symbols], [expression])
    return np.array(function(q, system.parameters.vector())).T


def test_a_marker_is_off_the_axis(holding):
    marker = sights(holding)[-1].frame
    tip, beside = places(holding, ["w_T1", marker], np.zeros(holding.size))
    np.testing.assert_allclose(beside - tip, [MARKER_DISTANCE, 0.0, 0.0], atol=1e-12)


URDF = """<robot name="r"><link name="wall"/>
<joint name="turn" type="continuous"><parent link="wall"/><child link="a"/><axis xyz="{axis}"/></joint>
<link name="a"><inertial><mass value="0.5"/><inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/>
</inertial></link>
<joint name="slide" type="prismatic"><parent link="a"/><child link="b"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="100" velocity="5"/></joint>
<link name="b"><inertial><mass value="0.5"/><inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/>
</inertial></link></robot>"""


@pytest.mark.parametrize(
    ("axis", "beside"),
    [
        ((1, 0, 0), (0, 0.03, 0)),
        ((0, 0, 1), (0.03, 0, 0)),
        ((0.6, 0, 0.8), (0, 0.03, 0)),
        ((0.64, 0.48, 0.6), (-0.64 * 0.48, 1 - 0.48**2, -0.48 * 0.6)),
    ],
)
def test_a_springy_joint_has_a_marker_across_its_axis(tmp_path, axis, beside):
    file = tmp_path / "r.urdf"
    file.write_text(URDF.format(axis=" ".join(map(str, axis))))
    springs = {"turn": Spring(1.0), "slide": Spring(1.0)}
    system = System.build(read_urdf(file), springs=springs, points=["b"])
    found = {sight.name: sight for sight in sights(system)}
    moving = {name for name, frame in system.mechanism.frames.items() if frame.joint >= 0}
    assert set(found) == moving | {"turn_marker"}
    assert "wall" in system.mechanism.frames
    assert all(sight.frame is None and sight.words == name for name, sight in found.items() if name in moving)
    marker = found["turn_marker"]
    assert marker.words == "a marker 3 cm off the axis of turn"
    wanted = MARKER_DISTANCE * np.array(beside) / np.linalg.norm(beside)
    np.testing.assert_allclose(places(system, [marker.frame], np.zeros(2))[0], wanted, atol=1e-12)


def test_more_frames_need_no_new_equations(urdf_folder):
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    step = compile_step(System.build(robot, points=["tip"]), 0.01, use_compiler=False)
    frame = step.system.mechanism.frame("tip")
    more = seeing(step, {"other": frame})
    assert set(more.system.mechanism.frames) == {*step.system.mechanism.frames, "other"}
    assert "other" not in step.system.mechanism.frames
    assert more.kernel is step.kernel


# -- mechanics --------------------------------------------------------------------------------------------------------


def mechanics(*, grasps=(), second=None, driven=(), prescribed=(), measured=False, joints=True):
    sensor = SimpleNamespace(efforts=measured)
    recording = SimpleNamespace(joints=object() if joints else None)
    episode = SimpleNamespace(samples=(SimpleNamespace(sensor=sensor),), recording=recording)
    system = SimpleNamespace(
        grasps=[SimpleNamespace(kind=kind) for kind in grasps], driven=driven, prescribed=prescribed
    )
    return LayoutBuilder(Setting(SimpleNamespace(system=system, episodes=(episode,)), np.zeros(1), second_arm=second))


@pytest.mark.parametrize(
    ("settings", "possible"),
    [
        ({"joints": False}, ""),
        ({"grasps": ("point",)}, "weld"),
        ({"grasps": ("weld", "point")}, "weld"),
        ({"grasps": ("weld",)}, ""),
        ({"second": "arm"}, "second_arm"),
        ({"driven": ("a",)}, "motion travel torque"),
        ({"driven": ("a",), "measured": True}, "motion travel"),
        ({"driven": ("a",), "joints": False}, "motion travel"),
        ({"prescribed": ("a",)}, "torque"),
        ({"prescribed": ("a",), "measured": True}, ""),
        ({"prescribed": ("a",), "joints": False}, ""),
    ],
)
def test_changes_of_mechanics_that_make_sense(settings, possible):
    assert mechanics(**settings).possible() == possible.split()


@pytest.mark.parametrize(
    ("joints", "std", "position_std"),
    [
        (None, 0.7, 0.0),
        ({}, 0.7, 0.0),
        ({"effort_std": 0.2}, None, 0.0),
        ({"effort_std": np.array([0.2, 0.3])}, None, 0.0),
        ({"effort_std": np.array([0.2, 0.0])}, 0.7, 0.0),
        ({"effort_std": 0.0}, 0.7, 0.0),
        ({"position_std": 1e-3}, 0.7, None),
        ({"effort_std": 0.2, "position_std": 0.0}, None, None),
    ],
)
def test_noise_of_torques_is_what_is_stated_or_typical(joints, std, position_std):
    made = None if joints is None else JointGroup(("a", "b"), np.arange(2.0), np.zeros((2, 2)), **joints)
    problem = SimpleNamespace(episodes=(SimpleNamespace(recording=SimpleNamespace(joints=made)),))
    found = LayoutBuilder(Setting(problem, np.zeros(1), torque_std=0.7))._torque_options()
    assert (found.std, found.position_std) == (std, position_std)


def test_a_layout_is_built_once_and_says_what_takes_time(monkeypatch):
    told, built = [], []
    builder = LayoutBuilder(Setting(None, np.zeros(1)), told.append)

    def build(mechanics):
        built.append(mechanics)
        if "weld" in mechanics:
            raise SolverError("it snaps", where="here")
        return "a layout"

    monkeypatch.setattr(builder, "_build", build)
    both, none = frozenset({"weld", "torque"}), frozenset()
    for _ in range(2):
        assert builder.layout(none) == "a layout"
        assert builder.layout(both) == "it snaps"
        assert builder.layout(frozenset({"motion"})) == "a layout"
    assert built == [none, both, frozenset({"motion"})]
    assert told == [
        "working out joint torques as a measurement, the arms' motion as known and weld grasps in place of points",
        "working out another motion",
    ]


# -- motions ----------------------------------------------------------------------------------------------------------


def travelled(system, angles):
    episode = SimpleNamespace(measured_arm=np.array(angles, float))
    return _travel(system, {}, episode)


def test_travel_is_the_farthest_of_the_gripper_from_its_start(holding):
    lengths = (0.5, 0.4)

    def tip(shoulder, elbow):
        both = shoulder + elbow
        return np.array(
            [
                lengths[0] * math.sin(shoulder) + lengths[1] * math.sin(both),
                -lengths[0] * math.cos(shoulder) - lengths[1] * math.cos(both),
            ]
        )

    angles = [(0.3, 0.1), (0.9, -0.4), (0.35, 0.2)]
    wanted = max(float(np.linalg.norm(tip(*angle) - tip(*angles[0]))) for angle in angles)
    assert travelled(holding, angles) == pytest.approx(wanted)
    assert travelled(holding, angles[:1]) == 0.11


def test_travel_without_grippers_is_typical(urdf_folder):
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    system = System.build(robot, driven=["shoulder", "elbow"], points=["tip"])
    assert travelled(system, [(0.0, 0.0), (1.0, 1.0)]) == 0.11


@pytest.mark.parametrize("points", [("w_T1", "w_T2", "w_T3"), ("w_T1", "w_T2")])
def test_two_arms_hold_the_object_together_and_away(urdf_folder, points):
    """The Y, a metre along x and 0.4 m along y: each arm's hand a bit towards the middle, both a bit outwards."""
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    place = np.eye(4)
    place[:2, 3] = 1.0, 0.4
    grasps = [Grasp("left", "tip", "w_T2"), Grasp("right", "lower", "w_T3")]
    objects = [(y_object(), None, place)]
    system = System.build(robot, objects=objects, grasps=grasps, driven=["shoulder", "elbow"], points=points)
    ends = dict(zip(points, places(system, points, np.zeros(system.size)), strict=True))
    middle = sum(ends.values()) / len(ends)
    away = np.array([*middle[:2], 0.0]) / math.hypot(*middle[:2])
    found = _pushed_together(system, {})
    assert set(found) == {grasp.name for grasp in grasps if grasp.held in ends}
    for grasp in grasps[: len(found)]:
        inward = (middle - ends[grasp.held]) / np.linalg.norm(middle - ends[grasp.held])
        np.testing.assert_allclose(found[grasp.name], TOGETHER * inward + FORWARD * away, atol=1e-12)


def test_an_object_over_the_robot_is_not_pushed_away(holding):
    """One end that is the middle itself, on the robot's own axis."""
    assert _pushed_together(holding, {})["hand"] == pytest.approx([0.0, 0.0, 0.0])


@pytest.fixture
def moving(holding, monkeypatch):
    """moving(system, twice): a motion as `_moved` asks for it, of an engine that only remembers."""
    kept = SimpleNamespace()
    joints = list(holding.mechanism.joints)
    for i, (lower, upper, effort) in enumerate([(-1.0, 1.0, 5.0), (-0.5, 2.0, 3.0)]):
        joints[i] = replace(joints[i], lower=lower, upper=upper, effort_limit=effort)
    limited = replace(holding, mechanism=replace(holding.mechanism, joints=tuple(joints)))

    def engine(system, values, motion, simulation, posture):
        kept.simulated = (system, values, motion, simulation, posture)
        return SimpleNamespace(t=np.arange(3.0), q=kept.q, effort=kept.effort)

    def draw(system, values, seed, posture, excitation):
        kept.drawn = (system, values, seed, posture, excitation)
        return "motion"

    monkeypatch.setattr(module, "simulate_in_mujoco", engine)
    monkeypatch.setattr(module, "multisine", draw)

    def run(q=((0.0, 0.0),) * 3, effort=((0.0, 0.0),) * 3, twice=False, system=None):
        q = np.array(q, float)
        kept.q = np.hstack([q, np.full((len(q), limited.size - 2), 9.0)])
        kept.effort = np.array(effort, float)
        angles = np.array([[0.3, 0.1], [0.9, -0.4]])
        episode = SimpleNamespace(measured_arm=angles, grid=GRID, name="run")
        problem = SimpleNamespace(
            system=limited, split=lambda x, i: (limited.parameters.vector({"T1.bend": x[0]}), None), episodes=(episode,)
        )
        made = Setting(problem, np.array([6.5]))
        recording, notes = LayoutBuilder(made)._moved(system or limited, episode, 5, twice)
        kept.travel = _travel(limited, made.values, episode)
        return recording, notes, kept

    run.system = limited
    return run


@pytest.mark.parametrize(("twice", "factor", "speed"), [(False, 1.0, 1.4), (True, 2.0, 2.8)])
def test_another_motion_starts_where_the_recording_does_and_goes_as_far(moving, twice, factor, speed):
    recording, notes, kept = moving(twice=twice)
    system, values, seed, posture, excitation = kept.drawn
    assert values["T1.bend"] == 6.5
    assert (seed, posture) == (5, {"shoulder": 0.3, "elbow": 0.1})
    assert excitation.travel == pytest.approx(factor * kept.travel)
    assert excitation.speed == speed
    assert excitation.duration == pytest.approx(2.0)
    assert kept.simulated[:3] == (system, values, "motion")
    assert kept.simulated[3].duration == pytest.approx(2.0)
    assert kept.simulated[4] == posture
    assert (recording.name, notes, recording.points) == ("run", [], ())
    assert recording.joints.names == ("shoulder", "elbow")
    np.testing.assert_array_equal(recording.joints.position, np.zeros((3, 2)))
    assert (recording.joints.position_std, recording.joints.effort_std) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("q", "effort", "notes"),
    [
        ([(0, 0), (1.0, 2.0), (-1.0, -0.5)], [(5.0, -3.0), (0, 0), (0, 0)], []),
        ([(0, 0), (1.1, 0), (0, 0)], [(0, 0)] * 3, ["beyond the range of shoulder"]),
        ([(0, 0), (0, -0.6), (0, 0)], [(0, 0)] * 3, ["beyond the range of elbow"]),
        ([(0, 0), (-1.1, 2.1), (0, 0)], [(0, 0)] * 3, ["beyond the range of shoulder, elbow"]),
        ([(0, 0)] * 3, [(0, 0), (0, -3.1), (0, 0)], ["beyond the torque of elbow"]),
        (
            [(0, 0), (0, 2.1), (0, 0)],
            [(5.1, 0), (0, 0), (0, 0)],
            ["beyond the range of elbow", "beyond the torque of shoulder"],
        ),
    ],
)
def test_what_a_robot_could_not_do_is_noted(moving, q, effort, notes):
    recording, found, _ = moving(q, effort)
    assert found == notes
    np.testing.assert_array_equal(recording.joints.position, np.array(q, float))
    np.testing.assert_array_equal(recording.joints.effort, np.array(effort, float))


def test_a_second_arm_finds_its_own_posture(moving, monkeypatch):
    asked = []

    def settle(system, values, seed, offsets):
        asked.append((system, seed, offsets))
        return {"elbow": 0.7, "shoulder": 0.2}

    monkeypatch.setattr(module, "initial_posture", settle)
    other = replace(moving.system, driven=("elbow", "shoulder"))
    _, _, kept = moving(system=other)
    assert kept.drawn[3] == kept.simulated[4] == {"elbow": 0.7, "shoulder": 0.2}
    assert asked[0][0] is other
    assert asked[0][1] == {"shoulder": 0.3, "elbow": 0.1}
    assert set(asked[0][2]) == {"hand"}
    moving()
    assert len(asked) == 1


# -- experiments ------------------------------------------------------------------------------------------------------


class Base:
    """A problem of one driven joint, two recordings to estimate on and one held out."""

    def __init__(self, held_out=1, duration=None):
        def episode(name):
            joints = JointGroup(("a",), 10.0 + np.arange(0, 3.001, 0.1), np.zeros((31, 1)))
            return SimpleNamespace(name=name, recording=Recording(joints, (), name=name), grid=GRID)

        self.episodes = (episode("one"), episode("two"))
        self.held_out = tuple(episode(f"held_{i}") for i in range(held_out))
        self.system = SimpleNamespace(driven=("a",))
        self.options = ProblemOptions(duration=duration)


@pytest.fixture
def engine(monkeypatch):
    """Motions as asked for; `fails` as in a place without MuJoCo."""
    kept = SimpleNamespace(asked=[], fails=False, welded=[])

    def moved(self, system, episode, seed, twice):
        kept.asked.append((system, episode.name, seed, twice))
        if kept.fails:
            raise DataError("MuJoCo is not installed")
        return replace(episode.recording, name="made", source="what if"), ["beyond the range", f"of {episode.name}"]

    def weld(self, system, others):
        kept.welded.append((system, others))
        return SimpleNamespace(driven=system.driven, welded=True)

    monkeypatch.setattr(LayoutBuilder, "_moved", moved)
    monkeypatch.setattr(LayoutBuilder, "_welded", weld)
    return kept


def experiment(base, *names, second=None):
    return LayoutBuilder(Setting(base, np.zeros(1), second_arm=second, seed=20))._experiment(frozenset(names))


@pytest.mark.parametrize("names", [(), ("torque",)])
def test_without_another_motion_the_recordings_stay(engine, names):
    base = Base()
    system, recordings, notes = experiment(base, *names)
    assert system is base.system
    assert recordings == [episode.recording for episode in base.episodes]
    assert (notes, engine.asked) == ([], [])


def test_recordings_end_where_the_problem_does():
    made = LayoutBuilder(Setting(Base(duration=2.0), np.zeros(1)))
    cut = made._cut(made.setting.problem.episodes[0])
    np.testing.assert_allclose(cut.joints.t, 10.0 + 0.1 * np.arange(21))


@pytest.mark.parametrize(("name", "twice"), [("motion", False), ("travel", True)])
def test_every_recording_has_another_motion_with_a_seed_of_its_own(engine, name, twice):
    base = Base()
    _, recordings, notes = experiment(base, name)
    assert engine.asked == [(base.system, "one", 20, twice), (base.system, "two", 21, twice)]
    assert [recording.name for recording in recordings] == ["one", "two"]
    assert {recording.source for recording in recordings} == {"what if"}
    assert notes == ["beyond the range", "of one", "of two"]


def test_without_an_engine_held_out_recordings_move_otherwise(engine):
    engine.fails = True
    base = Base()
    _, recordings, notes = experiment(base, "motion")
    assert notes == []
    assert [recording.name for recording in recordings] == ["one", "two"]
    for recording in recordings:
        assert recording.joints is base.held_out[0].recording.joints


@pytest.mark.parametrize(
    ("names", "held_out", "driven"),
    [(("travel",), 1, ("a",)), (("motion",), 0, ("a",)), (("second_arm",), 1, ("a", "b"))],
    ids=["twice the travel", "nothing held out", "another arm"],
)
def test_without_an_engine_some_motions_cannot_be_had(engine, names, held_out, driven):
    engine.fails = True
    with pytest.raises(DataError, match="MuJoCo is not installed"):
        experiment(Base(held_out), *names, second=SimpleNamespace(driven=driven))


def test_a_second_arm_moves_and_its_grasps_are_welded_as_they_lie(engine):
    second = SimpleNamespace(driven=("a", "b"))
    system, recordings, _ = experiment(Base(), "second_arm", "weld", "torque", second=second)
    assert engine.welded == [(second, frozenset({"second_arm"}))]
    assert system.welded
    assert [entry[0] for entry in engine.asked] == [system, system]
    assert len(recordings) == 2
    experiment(Base(), "weld", "motion", "torque")
    assert engine.welded[1][1] == frozenset()


# -- what a layout sees -----------------------------------------------------------------------------------------------


def dense(made, torque=False, seen=(), second=None, joints=None, base_grasps=("w_T2",)):
    chosen, episode = made
    chosen.problem.system.grasps = [SimpleNamespace(held=name) for name in base_grasps]
    chosen.problem.step = SimpleNamespace(time_step=0.1)
    builder = LayoutBuilder(replace(chosen, second_arm=second))
    recording = replace(episode.recording, joints=joints) if joints is not None else episode.recording
    return builder._dense(recording, 3, seen, torque)


SEEN = [SimpleNamespace(name="tip", arm=False), SimpleNamespace(name="marker", arm=True)]


def test_everything_is_in_view_at_every_node():
    pose = np.eye(4)
    pose[0, 3] = 2.0
    found = dense(
        setting(group("points_top", pose=pose, sensor="kinect"), group("points_arm", names=("b",))), seen=SEEN
    )
    top, arm = found.points
    assert (top.name, top.names, top.sensor) == ("points_top", ("a", "b", "tip", "marker"), "kinect")
    np.testing.assert_array_equal(top.pose, pose)
    assert (arm.name, arm.names, arm.pose) == ("points_arm", ("b", "marker", "w_T2"), None)
    for made in found.points:
        np.testing.assert_allclose(made.t, 10.0 + 0.1 * np.arange(11))
        assert not np.any(made.position)
        np.testing.assert_array_equal(made.std, np.ones((11, len(made.names), 3)))


def test_sensors_that_were_not_there_are_added():
    t = np.arange(10.0, 12.05, 0.05)
    joints = JointGroup(("j",), t, np.zeros((len(t), 1)))
    found = dense(setting(), seen=SEEN, joints=joints, second=SimpleNamespace(grasps=[SimpleNamespace(held="w_T3")]))
    looking, feeling = found.points
    assert (looking.name, looking.names, looking.sensor) == (CAMERA, ("tip", "marker"), "camera")
    np.testing.assert_array_equal(looking.pose, np.eye(4))
    assert (feeling.name, feeling.names, feeling.sensor, feeling.pose) == (ARM, ("marker", "w_T3"), "arm", None)
    np.testing.assert_allclose(looking.t, 10.0 + 0.1 * np.arange(21))
    assert found.joints.effort is None


def test_sensors_without_frames_are_left_out():
    found = dense(setting(group()), base_grasps=())
    assert [made.name for made in found.points] == ["points_camera"]


@pytest.mark.parametrize("known", [True, False])
def test_torques_that_were_not_recorded_are_predicted(known):
    t = np.arange(10.0, 12.05, 0.05)
    effort = np.full((len(t), 1), 3.0) if known else None
    joints = JointGroup(("j",), t, np.zeros((len(t), 1)), effort=effort)
    found = dense(setting(group()), torque=True, joints=joints)
    assert found.joints.effort.shape == (len(t), 1)
    assert np.all(found.joints.effort == (3.0 if known else 0.0))


# -- of a real problem ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def swung(urdf_folder):
    """swung(**options): a pendulum, the shoulder driven, the elbow springy, the tip seen by a camera."""
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    system = System.build(robot, prescribed=["shoulder"], springs={"elbow": Spring(3.0)}, damping=0.1, points=["tip"])
    step = compile_step(system, 0.02, use_compiler=False)
    t = 0.02 * np.arange(41)
    path = 0.4 * np.sin(7.0 * t)
    joints = JointGroup(["shoulder"], t, path[:, None], position_std=0.0)
    camera = PointGroup(CAMERA, ["tip"], t[::4], np.zeros((11, 1, 3)), 2e-3, sensor="camera", pose=np.eye(4))
    recording = Recording(joints, (camera,), name="swing")

    def build(**options):
        chosen = ProblemOptions(path_cutoff=math.inf, **options)
        return EstimationProblem(step, [recording], ("elbow.stiffness", "elbow.rest"), chosen, {"elbow.rest": 0.1})

    return build


def informed(problem, mechanics=(), **settings):
    made = Setting(problem, problem.start, "known", None, **settings)
    built = LayoutBuilder(made).layout(frozenset(mechanics))
    assert not isinstance(built, str), built
    return built, built.information([made.views(episode) for episode in problem.episodes])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"huber_threshold": 0.1},
        {"weighting": "paper"},
        {"weak_prior_factor": 0.01},
        {"priors": {"elbow.stiffness": 1e-3}},
        {"duration": 0.8},
    ],
    ids=["plain", "robust", "paper", "weak priors", "stated priors", "all of it"],
)
def test_information_is_of_the_sensors_alone(swung, options):
    """Neither robust costs nor weights nor priors of the parameters themselves change what sensors would tell."""
    problem = swung()
    evaluation = problem.evaluate(problem.start)
    rows = evaluation.jacobian[problem.rows.data]
    built, found = informed(swung(**options))
    assert built.names == ("elbow.stiffness", "elbow.rest")
    assert not np.any(built.fixed)
    np.testing.assert_allclose(found, rows.T @ rows, rtol=1e-9)


def test_shorter_recordings_tell_less(swung):
    _, whole = informed(swung())
    built, half = informed(swung(duration=0.4))
    assert built.problem.episodes[0].grid.steps == 20
    assert np.all(np.linalg.eigvalsh(whole - half) > 0)
    assert built.problem.options.duration is None


def test_torques_as_a_measurement_are_fixed_information(swung):
    built, _ = informed(swung(), ["torque"])
    finer, _ = informed(swung(), ["torque"], torque_std=0.05)
    assert np.all(np.linalg.eigvalsh(built.fixed) > 0)
    np.testing.assert_allclose(finer.fixed, 4 * built.fixed, rtol=1e-9)
    assert built.problem.system.prescribed == ("shoulder",)


def test_what_cannot_be_rolled_out_is_no_layout(swung, monkeypatch):
    problem = swung()
    monkeypatch.setattr(
        EstimationProblem, "evaluate", lambda self, x: SimpleNamespace(ok=False, jacobian=None, message="it snaps")
    )
    made = LayoutBuilder(Setting(problem, problem.start, "known", None))
    assert made.layout(frozenset()) == "the model cannot be rolled out: it snaps"


def test_welds_keep_the_orientation_at_the_start(held_tube):
    builder = LayoutBuilder(Setting(held_tube, held_tube.start, "known", None))
    system = builder._welded(held_tube.system, frozenset())
    layout = builder.layout(frozenset())
    (grasp,) = system.grasps
    assert grasp.kind == "weld"
    start = layout.problem.start_state(layout.problem.episodes[0], *layout.problem.split(layout.x, 0))
    symbol = ca.SX.sym("q", system.size)
    tree = replace(layout.problem.system.mechanism, parameters=system.parameters).numeric(None)
    kinematics = forward_kinematics(tree, symbol)
    turn = kinematics.pose(grasp.holder).rotation.T @ kinematics.pose(grasp.held).rotation
    wanted = np.array(ca.Function("turn", [symbol], [turn])(start.state[: system.size]))
    np.testing.assert_allclose(np.array(ca.DM(grasp.rotation)), wanted, atol=1e-9)
    assert np.linalg.norm(wanted - np.eye(3)) > 0.01


@pytest.mark.parametrize("how", ["layout", "start"])
def test_welds_need_a_start(held_tube, monkeypatch, how):
    builder = LayoutBuilder(Setting(held_tube, held_tube.start, "known", None))
    if how == "layout":
        monkeypatch.setattr(builder, "layout", lambda others: "it snaps")
    else:
        builder.layout(frozenset())
        monkeypatch.setattr(
            EstimationProblem, "start_state", lambda self, *rest: SimpleNamespace(message="it snaps", state=None)
        )
    with pytest.raises(SolverError, match="it snaps"):
        builder._welded(held_tube.system, frozenset())

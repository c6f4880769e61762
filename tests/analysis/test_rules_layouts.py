"""Experiments that were not made, rule by rule: what could see, what it would tell, how robots would move."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_recordings import GRID, group, holding_pendulum, places, setting

from yid_ocp.analysis.experiment_design import (
    _DEFAULT_ARM_POINT_STD,
    _DEFAULT_CAMERA_STD,
    _MARKER_AXIS_DISTANCE,
    CandidateExperiment,
    FrameObservation,
    observable_frames,
    uniform_sample_times,
    with_observable_frames,
)
from yid_ocp.errors import DataError
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import Segment, System, flexible_object
from yid_ocp.model.servos_and_springs import RobotJointSpring
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import SensorOptions
from yid_ocp.problem.measurements import TimeGrid

# -- what a recording saw ---------------------------------------------------------------------------------------------


def test_settings_ask_for_the_start_that_is_assumed_and_known_grasps_unless_told():
    made, _ = setting(group())
    assert (
        made.initial_state_knowledge,
        made.grasp_offset_prior_std,
        made.two_arm_system,
        made.torque_std,
        made.motion_seed,
    ) == ("assumed", None, None, 0.1, 11)


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
    seen, felt = made.camera_sampling(episode), made.arm_sampling(episode)
    assert (None if seen[0] is None else seen[0].name) == camera
    assert (None if felt[0] is None else felt[0].name) == arm


def test_times_count_from_the_start_and_the_typical_noise_is_the_median():
    std = np.full((3, 2, 3), 2e-3)
    std[0] = [9e-3, np.nan, 9e-3]
    made, episode = setting(group(std=std), group("points_arm", t=(10.2, 10.3), std=7e-4))
    _, times, noise = made.camera_sampling(episode)
    np.testing.assert_allclose(times, [0.0, 0.5, 1.0])
    assert noise == 2e-3
    _, times, noise = made.arm_sampling(episode)
    np.testing.assert_allclose(times, [0.2, 0.3])
    assert noise == 7e-4


def test_sensors_that_were_not_there_are_typical():
    made, episode = setting()
    found, times, noise = made.camera_sampling(episode)
    assert (found, noise) == (None, _DEFAULT_CAMERA_STD)
    np.testing.assert_allclose(times, np.arange(7) / 3.0)
    found, times, noise = made.arm_sampling(episode)
    assert (found, noise) == (None, _DEFAULT_ARM_POINT_STD)
    np.testing.assert_allclose(times, 0.1 * np.arange(21), atol=1e-12)


def test_groups_that_are_not_used_see_nothing():
    made, episode = setting(group(), group("points_arm"), sensors={"points_camera": SensorOptions(use=False)})
    assert made.camera_sampling(episode)[0] is None
    assert {view.point_group for view in made.recorded_observations(episode)} == {"points_arm"}


def test_views_are_of_the_frames_of_points_that_the_model_has():
    sensors = {"points_camera": SensorOptions(frames={"led": "tip"}), "points_arm": SensorOptions(points=("b",))}
    groups = (group(names=("a", "led", "nothing")), group("points_arm"))
    made, episode = setting(*groups, sensors=sensors)
    assert made.point_frames(groups[0]) == {"a": "a", "led": "tip"}
    assert made.point_frames(groups[1]) == {"b": "b"}
    assert [(view.point_group, view.frame) for view in made.recorded_observations(episode)] == [
        ("points_camera", "a"),
        ("points_camera", "tip"),
        ("points_arm", "b"),
    ]


def test_views_are_where_points_were_seen():
    made = group()
    position, std = made.position.copy(), np.arange(18.0).reshape(3, 2, 3) + 1
    position[1, 1] = np.nan
    chosen, episode = setting(replace(made, position=position, std=std))
    first, second = chosen.recorded_observations(episode)
    np.testing.assert_allclose(first.times, [0.0, 0.5, 1.0])
    np.testing.assert_array_equal(first.std, std[:, 0])
    np.testing.assert_allclose(second.times, [0.0, 1.0])
    np.testing.assert_array_equal(second.std, std[[0, 2], 1])


def test_a_stated_noise_level_replaces_the_recorded_one():
    made, episode = setting(group(std=None), sensors={"points_camera": SensorOptions(std=3e-3)})
    assert made.camera_sampling(episode)[2] == 3e-3
    assert made.recorded_observations(episode)[1].std.shape == (3, 3)
    unknown, episode = setting(group(std=None))
    with pytest.raises(DataError, match="the noise level of group 'points_camera' is not known"):
        unknown.recorded_observations(episode)


@pytest.mark.parametrize(
    ("rate", "times"),
    [(1.0, [0.0, 1.0, 2.0]), (0.4, [0.0]), (1.5, [0.0, 2 / 3, 4 / 3, 2.0]), (10.0, 0.1 * np.arange(21))],
)
def test_an_even_clock_covers_the_recording(rate, times):
    np.testing.assert_allclose(uniform_sample_times(GRID, rate), times, atol=1e-12)


# -- information ------------------------------------------------------------------------------------------------------


def sloped(seed=3, episodes=1, unknowns=2):
    """A layout whose frames move by random slopes; information that is fixed is 7 of the first unknown."""
    rng = np.random.default_rng(seed)
    grid = TimeGrid(10.0, 0.5, 4)
    slopes = {
        (i, "camera", frame): rng.standard_normal((5, 3, unknowns)) for i in range(episodes) for frame in ("a", "b")
    }
    fixed = np.zeros((unknowns, unknowns))
    fixed[0, 0] = 7.0
    problem = SimpleNamespace(episodes=[SimpleNamespace(grid=grid)] * episodes)
    return CandidateExperiment(problem, np.zeros(unknowns), ("p", "q"), slopes, fixed)


def view(times, std, frame="a"):
    return FrameObservation("camera", frame, np.array(times), np.array(std, float) * np.ones((len(times), 3)))


def test_no_views_tell_what_is_fixed():
    made = sloped()
    found = made.fisher_information([[]])
    np.testing.assert_array_equal(found, made.prior_information)
    found += 1.0
    assert made.prior_information[1, 1] == 0.0


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
    rows = (
        sum((w * made.position_sensitivities[0, "camera", "a"][k] for k, w in weights.items()), np.zeros((3, 2)))
        / std.T
    )
    found = made.fisher_information([[view([time], std)]])
    np.testing.assert_allclose(found - made.prior_information, rows.T @ rows, atol=1e-9)


def test_views_add_up_over_frames_times_and_recordings():
    made = sloped(episodes=3)
    first, second = [view([0.0, 1.0], 0.1)], [view([0.5], 0.2), view([0.5], 0.2, "b")]

    def of(i, frame, node, std):
        rows = made.position_sensitivities[i, "camera", frame][node] / std
        return rows.T @ rows

    def lists(i, chosen):
        if chosen is first:
            return of(i, "a", 0, 0.1) + of(i, "a", 2, 0.1)
        return of(i, "a", 1, 0.2) + of(i, "b", 1, 0.2)

    wanted = made.prior_information + lists(0, first) + lists(1, second) + lists(2, first)
    np.testing.assert_allclose(made.fisher_information([first, second]), wanted)
    # each once: the same views again come from memory, others do not
    assert len(made._known) == 4 + 0 * 3
    np.testing.assert_allclose(made.fisher_information([first, second]), wanted)
    finer = made.fisher_information([[view([0.0, 1.0], 0.05)], second])
    np.testing.assert_allclose(finer - wanted, 3 * (lists(0, first) + lists(2, first)), atol=1e-9)


# -- what could be seen -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def holding(urdf_folder):
    return holding_pendulum(urdf_folder)


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
    found = observable_frames(System.build(None, objects=[(tube, None, None)]))
    assert [sight.name for sight in found] == names
    assert [sight.is_arm_measurable for sight in found] == [False] * len(names)
    assert found[-1].description == "a marker 3 cm off the axis at the end of T1"
    assert [sight.added_frame is None for sight in found] == [True] * (len(names) - 1) + [False]


def test_markers_at_held_ends_can_be_felt(holding):
    assert {sight.name: sight.is_arm_measurable for sight in observable_frames(holding)} == {
        "w_T1": False,
        "T1_1_tip": False,
        "T1_marker": True,
    }


def test_a_marker_is_off_the_axis(holding):
    marker = observable_frames(holding)[-1].added_frame
    tip, beside = places(holding, ["w_T1", marker], np.zeros(holding.n_coordinates))
    np.testing.assert_allclose(beside - tip, [_MARKER_AXIS_DISTANCE, 0.0, 0.0], atol=1e-12)


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
    springs = {"turn": RobotJointSpring(1.0), "slide": RobotJointSpring(1.0)}
    system = System.build(read_urdf(file), springs=springs, point_frames=["b"])
    found = {sight.name: sight for sight in observable_frames(system)}
    moving = {name for name, frame in system.mechanism.frames.items() if frame.joint_index >= 0}
    assert set(found) == moving | {"turn_marker"}
    assert "wall" in system.mechanism.frames
    assert all(
        sight.added_frame is None and sight.description == name for name, sight in found.items() if name in moving
    )
    marker = found["turn_marker"]
    assert marker.description == "a marker 3 cm off the axis of turn"
    wanted = _MARKER_AXIS_DISTANCE * np.array(beside) / np.linalg.norm(beside)
    np.testing.assert_allclose(places(system, [marker.added_frame], np.zeros(2))[0], wanted, atol=1e-12)


def test_more_frames_need_no_new_equations(urdf_folder):
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    springs = {"elbow": RobotJointSpring(3.0)}
    system = System.build(robot, springs=springs, prescribed=["shoulder"], point_frames=["tip"])
    step = compile_step(system, 0.01, use_compiler=False)
    more, seen = with_observable_frames(step)
    assert {sight.name for sight in seen} <= set(more.system.mechanism.frames)
    assert set(more.system.mechanism.frames) - set(step.system.mechanism.frames) == {"elbow_marker"}
    assert more.kernel is step.kernel

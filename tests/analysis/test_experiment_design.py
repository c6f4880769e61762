"""Experiments that were not made: what could see, what it would tell, how robots would move."""

import math
from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from heard import Heard
from made_recordings import chain_of_motors, group, holding_pendulum, setting
from small_problems import pendulum_step, places, taken

from yid_ocp.analysis import experiment_design
from yid_ocp.analysis import torque_error_propagation as propagation
from yid_ocp.analysis.experiment_design import (
    ARM_GROUP,
    CAMERA_GROUP,
    ExperimentVariantSensitivityBuilder,
    SinglePointObservationSchedule,
    UnchangedExperiment,
    VariantPositionSensitivities,
    measurable_points,
    step_and_measurable_points_with_frames,
)
from yid_ocp.analysis.identifiability import identifiability
from yid_ocp.analysis.what_if import what_if
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.errors import DataError
from yid_ocp.inference.linearized_residual import residual_and_jacobian_with_stated_priors
from yid_ocp.inference.whitening import problem_with_exact_inputs, problem_with_whitening_at
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import FlexibleSegment, System, flexible_object
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.servos_and_springs import StiffnessAndRest
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.problem.measurements import TimeGrid
from yid_ocp.workflow.build_problem import load_problem

MARKER_DISTANCE = 0.03


@pytest.mark.parametrize(
    ("groups", "camera", "arm"),
    [
        ([group()], "points_camera", None),
        ([group("points_arm"), group()], "points_camera", "points_arm"),
        ([group("points_x", sensor_name="arm"), group("points_y", sensor_name="a camera")], "points_y", "points_x"),
        ([group("points_z", camera_pose=np.eye(4))], "points_z", None),
        ([group("points_left_arm")], None, "points_left_arm"),
        ([group("points_mocap")], None, None),
    ],
)
def test_cameras_and_arms_are_told_apart(groups, camera, arm):
    made, episode = setting(*groups)
    for (found, times, std), name, usual in (
        (made.camera_points_times_and_median_std(episode), camera, (np.arange(7) / 3.0, 5e-3)),
        (made.arm_point_group_times_and_std(episode), arm, (0.1 * np.arange(21), 1e-3)),
    ):
        assert (None if found is None else found.name) == name
        np.testing.assert_allclose(times, [0.0, 0.5, 1.0] if name else usual[0], atol=1e-12)
        assert std == (2e-3 if name else usual[1])


def test_the_typical_noise_is_the_median_or_the_stated_one():
    std = np.full((3, 2, 3), 2e-3)
    std[0] = [9e-3, np.nan, 9e-3]
    made, episode = setting(group(std=std))
    assert made.camera_points_times_and_median_std(episode)[2] == 2e-3
    made, episode = setting(group(std=None), sensors={"points_camera": SensorOptions(std=3e-3)})
    assert made.camera_points_times_and_median_std(episode)[2] == 3e-3
    unknown, episode = setting(group(std=None))
    with pytest.raises(DataError, match="group 'points_camera' is neither recorded nor in the settings"):
        unknown.existing_point_observation_schedules(episode)


def test_observations_are_of_used_points_that_the_model_has_where_they_were_seen():
    made = group(names=("a", "led", "nothing"))
    position = made.position.copy()
    position[1, 1] = np.nan
    sensors = {
        "points_camera": SensorOptions(frame_by_recorded_name={"led": "tip"}),
        "points_arm": SensorOptions(used_points=("b",)),
        "points_off": SensorOptions(use=False),
    }
    groups = replace(made, position=position), group("points_arm"), group("points_off")
    chosen, episode = setting(*groups, sensors=sensors)
    found = chosen.existing_point_observation_schedules(episode)
    seen = [("points_camera", "a"), ("points_camera", "tip"), ("points_arm", "b")]
    assert [(view.point_group, view.frame) for view in found] == seen
    np.testing.assert_allclose(found[0].times, [0.0, 0.5, 1.0])
    np.testing.assert_allclose(found[1].times, [0.0, 1.0])
    np.testing.assert_array_equal(found[1].std, np.full((2, 3), 2e-3))


@pytest.fixture
def sloped():
    """Three recordings whose frames move by random slopes; the prior is 7 of the first unknown."""
    rng = np.random.default_rng(3)
    slopes = {(i, "camera", frame): rng.standard_normal((5, 3, 2)) for i in range(3) for frame in ("a", "b")}
    problem = SimpleNamespace(episodes=[SimpleNamespace(grid=TimeGrid(10.0, 0.5, 4))] * 3)
    return VariantPositionSensitivities(problem, np.zeros(2), ("p", "q"), slopes, np.diag([7.0, 0.0]))


def view(times, std, frame="a"):
    stds = np.array(std, float) * np.ones((len(times), 3))
    return SinglePointObservationSchedule("camera", frame, np.array(times), stds)


TIMES = [(0.0, {0: 1.0}), (0.5, {1: 1.0}), (0.75, {1: 0.5, 2: 0.5}), (1.6, {3: 0.8, 4: 0.2}), (2.0, {4: 1.0})]


@pytest.mark.parametrize(("time", "weights"), [*TIMES, (-0.1, {}), (2.1, {})])
def test_a_view_is_interpolated_between_nodes(sloped, time, weights):
    std = np.array([[0.1, 0.2, 0.5]])
    slopes = sloped.position_sensitivities[0, "camera", "a"]
    rows = sum((w * slopes[k] for k, w in weights.items()), np.zeros((3, 2))) / std.T
    found = sloped.fisher_information_with_prior([[view([time], std)], [], []])
    np.testing.assert_allclose(found, np.diag([7.0, 0.0]) + rows.T @ rows, atol=1e-9)


def test_views_add_up_over_frames_times_and_recordings(sloped):
    """Lists of views come in turn where there are fewer than recordings."""

    def told(i, frame, node, std):
        rows = sloped.position_sensitivities[i, "camera", frame][node] / std
        return rows.T @ rows

    def information(std):
        first = sum(told(i, "a", node, std) for i in (0, 2) for node in (0, 2))
        return np.diag([7.0, 0.0]) + first + told(1, "a", 1, 0.2) + told(1, "b", 1, 0.2)

    for std in (0.1, 0.1, 0.05):
        views = [[view([0.0, 1.0], std)], [view([0.5], 0.2), view([0.5], 0.2, "b")]]
        np.testing.assert_allclose(sloped.fisher_information_with_prior(views), information(std))


@pytest.mark.parametrize(("links", "middle"), [(1, []), (2, ["T1_0_tip"]), (3, ["T1_1_tip"]), (4, ["T1_1_tip"])])
def test_a_segment_has_a_tip_a_middle_and_a_marker(links, middle):
    tube = flexible_object([FlexibleSegment("T1", 0.6, 0.1, 0.02, links=links, bend=4.0, twist=3.0)])
    *there, marker = measurable_points(System.build(None, objects=[(tube, None, None)]))
    assert [sight.name for sight in (*there, marker)] == ["w_T1", *middle, "T1_marker"]
    assert not any(sight.is_arm_measurable for sight in (*there, marker))
    assert all(sight.added_frame is None for sight in there)
    assert all(fact in marker.description for fact in ("marker", "3 cm", "end of T1"))


def test_a_marker_is_off_the_axis_and_felt_at_a_held_end(urdf_folder):
    holding = holding_pendulum(urdf_folder)
    found = measurable_points(holding)
    assert {sight.name for sight in found if sight.is_arm_measurable} == {"T1_marker"}
    tip, beside = places(holding, ["w_T1", found[-1].added_frame], np.zeros(holding.n_coordinates))
    np.testing.assert_allclose(beside - tip, [MARKER_DISTANCE, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("axis", "beside"),
    [((1, 0, 0), (0, 1, 0)), ((0, 0, 1), (1, 0, 0)), ((0.64, 0.48, 0.6), (-0.64 * 0.48, 1 - 0.48**2, -0.48 * 0.6))],
)
def test_a_springy_joint_has_a_marker_across_its_axis(tmp_path, axis, beside):
    robot = chain_of_motors(tmp_path, turn=("continuous", " ".join(map(str, axis))), slide=("prismatic", "1 0 0"))
    springs = {"turn": StiffnessAndRest(1.0), "slide": StiffnessAndRest(1.0)}
    system = System.build(robot, springs=springs, point_frames=["hand"])
    *moving, marker = measurable_points(system)
    there = [name for name, frame in system.mechanism.frames.items() if frame.joint_index >= 0]
    assert [sight.name for sight in moving] == there
    assert marker.name == "turn_marker"
    assert all(fact in marker.description for fact in ("marker", "3 cm", "axis of turn"))
    wanted = MARKER_DISTANCE * np.array(beside) / np.linalg.norm(beside)
    np.testing.assert_allclose(places(system, [marker.added_frame], np.zeros(2))[0], wanted, atol=1e-12)


DRIVEN, MOVED = {"driven": ("a",)}, {"prescribed": ("a",)}
POSSIBLE = [({"joints": False}, ""), ({"grasps": ("weld", "point")}, "weld"), ({"grasps": ("weld",)}, "")]
POSSIBLE += [({"second": "arm"}, "second_arm"), (DRIVEN, "motion travel torque"), (MOVED, "torque")]
POSSIBLE += [(DRIVEN | {"measured": True}, "motion travel"), (DRIVEN | {"joints": False}, "motion travel")]
POSSIBLE += [(DRIVEN | {"servos": {"a": 1}}, "torque"), (MOVED | {"measured": True}, "")]


@pytest.mark.parametrize(("settings", "possible"), POSSIBLE)
def test_changes_of_mechanics_that_make_sense(settings, possible):
    made = {"grasps": (), "driven": (), "prescribed": (), "servos": {}, "measured": False, "joints": True} | settings
    grasps = [SimpleNamespace(kind=kind) for kind in made["grasps"]]
    system = SimpleNamespace(**{name: made[name] for name in ("driven", "prescribed", "servos")}, grasps=grasps)
    sensor = SimpleNamespace(effort_joints=made["measured"])
    recording = SimpleNamespace(joints=object() if made["joints"] else None)
    episode = SimpleNamespace(measurements=(SimpleNamespace(sensor=sensor),), recording=recording)
    base = UnchangedExperiment(
        SimpleNamespace(system=system, episodes=(episode,)), np.zeros(1), two_arm_system=made.get("second")
    )
    assert ExperimentVariantSensitivityBuilder(base).applicable_setup_changes() == possible.split()


@pytest.fixture(scope="module")
def swung(robot):
    """swung(**options): a pendulum, the shoulder moved as measured, the elbow springy, the tip seen by a camera."""
    system = System.build(
        robot, prescribed=["shoulder"], springs={"elbow": StiffnessAndRest(3.0)}, damping=0.1, point_frames=["tip"]
    )
    step = compile_step(system, 0.02, use_compiler=False)
    t = 0.02 * np.arange(41)
    path = 0.4 * np.sin(7.0 * t)
    camera = PointGroup(CAMERA_GROUP, ["tip"], t[::4], np.zeros((11, 1, 3)), 2e-3, "camera", camera_pose=np.eye(4))

    def build(effort_std=None, **options):
        joints = JointGroup(["shoulder"], t, path[:, None], position_std=0.0, effort_std=effort_std)
        recording, chosen = Recording(joints, (camera,), name="swing"), ProblemOptions(path_cutoff=math.inf, **options)
        return EstimationProblem(step, [recording], ("elbow.stiffness", "elbow.rest"), chosen, {"elbow.rest": 0.1})

    return build


def built(problem, *setup_changes, heard=None, **settings):
    """The builder of a problem's variants, and the variant with these changes."""
    made = ExperimentVariantSensitivityBuilder(
        UnchangedExperiment(problem, problem.initial_unknowns, **settings), *([heard] if heard else [])
    )
    found = made.position_sensitivities_of_variant(frozenset(setup_changes))
    assert not isinstance(found, str), found
    return made, found


def informed(problem, *setup_changes):
    made, found = built(problem, *setup_changes)
    views = [made.setting.existing_point_observation_schedules(episode) for episode in problem.episodes]
    return found, found.fisher_information_with_prior(views)


COSTS = [{}, {"huber_threshold": 0.1}, {"weighting": "paper"}, {"weak_prior_geometric_std": 0.01}, {"duration": 0.8}]


@pytest.mark.parametrize("options", [*COSTS, {"prior_stds": {"elbow.stiffness": 1e-3}}])
def test_information_is_of_the_sensors_alone(swung, options):
    """Neither robust costs nor weights nor priors of the parameters themselves change what sensors would tell."""
    problem = swung()
    rows = problem.evaluate(problem.initial_unknowns).jacobian[problem.residual_rows.data]
    made, found = informed(swung(**options))
    assert made.free_parameters == ("elbow.stiffness", "elbow.rest")
    assert not np.any(made.prior_information)
    np.testing.assert_allclose(found, rows.T @ rows, rtol=1e-9)


def test_shorter_recordings_tell_less_and_what_cannot_be_evaluated_nothing(swung):
    _, whole = informed(swung())
    made, half = informed(swung(duration=0.4))
    assert made.problem.episodes[0].grid.steps == 20
    assert np.all(np.linalg.eigvalsh(whole - half) > 0)
    builder = ExperimentVariantSensitivityBuilder(UnchangedExperiment(swung(), np.array([np.nan, 0.1])))
    found = builder.position_sensitivities_of_variant(frozenset())
    assert all(fact in found for fact in ("elbow.stiffness", "nan"))


def test_torques_as_a_measurement_are_fixed_information_with_typical_noise(swung):
    heard = Heard()
    builder, made = built(swung(), "torque", heard=heard)
    blind = made.fisher_information_with_prior([[]])
    assert np.all(np.linalg.eigvalsh(blind) > 0)
    stated = built(swung(effort_std=0.05), "torque")[1].fisher_information_with_prior([[]])
    np.testing.assert_allclose(stated, 4 * blind, rtol=1e-9)
    assert made.problem.system.prescribed == ("shoulder",)
    assert builder.position_sensitivities_of_variant(frozenset({"torque"})) is made
    assert ["joint torques" in stage for stage in heard.stages] == [True]


def test_every_frame_is_in_view_at_every_node_without_new_equations(swung):
    [episode] = built(swung())[1].problem.episodes
    assert [points.name for points in episode.recording.points] == [CAMERA_GROUP]
    camera = episode.recording.points[0]
    assert set(camera.names) == {sight.name for sight in measurable_points(swung().system)}
    np.testing.assert_allclose(camera.t, episode.grid.node_times)
    assert np.all(camera.std == 1.0)
    step = swung().step
    more, seen = step_and_measurable_points_with_frames(step)
    assert {sight.name for sight in seen} <= set(more.system.mechanism.frames)
    assert more.kernel is step.kernel
    assert built(swung())[1].problem.step.kernel is step.kernel


def test_welds_keep_the_orientation_at_the_start(held_tube):
    builder, made = built(held_tube, "weld")
    (grasp,), free = made.problem.system.grasps, builder.position_sensitivities_of_variant(frozenset())
    assert grasp.kind == "weld"
    start = free.problem.predictor.initial_state_and_derivative(
        free.problem.episodes[0], *free.problem.unpack_episode_unknowns(free.x, 0)
    )
    system, symbol = free.problem.system, ca.SX.sym("q", made.problem.system.n_coordinates)
    kinematics = forward_kinematics(system.mechanism_with_values(), symbol)
    turn = kinematics.frame_pose(grasp.holder_frame).rotation.T @ kinematics.frame_pose(grasp.held_frame).rotation
    wanted = np.array(ca.Function("turn", [symbol], [turn])(start.state[: system.n_coordinates]))
    np.testing.assert_allclose(np.array(ca.DM(grasp.held_orientation)), wanted, atol=1e-9)
    assert np.linalg.norm(wanted - np.eye(3)) > 0.01
    assert ARM_GROUP not in {points.name for points in held_tube.episodes[0].recording.points}
    assert ARM_GROUP in {points.name for points in made.problem.episodes[0].recording.points}


@pytest.fixture(scope="module")
def driven(urdf_folder):
    """The pendulum's motors at work for a second, with narrow limits; the rod's middle seen."""
    holding = holding_pendulum(urdf_folder)
    joints = list(holding.mechanism.joints)
    for i, (lower, upper, effort) in enumerate([(-1.0, 0.35, 0.1), (-0.65, 2.0, 0.05)]):
        joints[i] = replace(joints[i], lower_limit=lower, upper_limit=upper, effort_limit=effort)
    system = replace(holding, mechanism=replace(holding.mechanism, joints=tuple(joints)))
    t = 0.02 * np.arange(51)
    angles = np.array([0.3, -0.6]) + np.outer(np.sin(2 * t) ** 2, [0.03, -0.05])
    group = JointGroup(
        ("shoulder", "elbow"), t, angles, effort=np.zeros((51, 2)), effort_kind="command", position_std=1e-3
    )
    camera = PointGroup(CAMERA_GROUP, ["T1_1_tip"], t[::5], np.zeros((11, 1, 3)), 2e-3, "camera", camera_pose=np.eye(4))
    step = compile_step(system, 0.02, use_compiler=False)
    return EstimationProblem(step, [Recording(group, (camera,), name="run")], ("T1.bend",), ProblemOptions())


BEYOND = tuple(f"the simulated motion exceeds the {it}" for it in ("range of shoulder, elbow", "torque limit of elbow"))


@pytest.mark.parametrize(
    ("name", "factor", "q", "effort", "note"),
    [
        ("motion", 1.0, (0.04, 0.0), (0.09, -0.04), ()),
        ("travel", 2.0, (0.06, 0.0), (0.0, 0.0), ("the simulated motion exceeds the range of shoulder",)),
        ("motion", 1.0, (0.06, -0.06), (0, -0.06), BEYOND),
    ],
)
def test_another_motion_starts_where_the_recording_does(driven, monkeypatch, name, factor, q, effort, note):
    """With an engine that goes to and fro: it travels as far as recorded, and what a robot cannot do is noted."""
    asked = SimpleNamespace()

    def draw(system, values, seed, initial_joint_angles, excitation):
        asked.seed, asked.start, asked.excitation = seed, initial_joint_angles, excitation
        return "motion"

    def simulate(system, values, motion, simulation, initial_joint_angles):
        t = 0.02 * np.arange(51)
        angles = np.array(list(asked.start.values())) + np.outer(np.sin(2 * t) ** 2, q)
        whole = np.hstack([angles, np.zeros((51, system.n_coordinates - 2))])
        return SimpleNamespace(t=t, q=whole, effort=np.tile(effort, (51, 1)))

    monkeypatch.setattr(experiment_design, "random_multisine_motion", draw)
    monkeypatch.setattr(experiment_design, "simulate_in_mujoco", simulate)
    _, made = built(driven, name)
    assert made.feasibility_notes == note
    episode = driven.episodes[0]
    assert list(asked.start.values()) == pytest.approx(episode.measured_driven_angles[0])
    still = np.zeros(driven.system.n_coordinates - 2)
    way = np.array([places(driven.system, ["tip"], [*at, *still])[0] for at in episode.measured_driven_angles])
    assert asked.excitation.gripper_travel == pytest.approx(factor * np.linalg.norm(way - way[0], axis=1).max())
    assert (asked.seed, asked.excitation.max_joint_speed) == (11, 1.4 * factor)
    assert asked.excitation.duration == pytest.approx(1.0)


STEPS, NX, NU, READINGS = 30, 4, 2, 3


@pytest.fixture
def drawn_motion(monkeypatch):
    """A made-up motion of two driven joints, torques recorded every other step: course, errors, readings' slopes."""
    rng = np.random.default_rng(3)
    steps = []
    for _ in range(STEPS):
        turned, by_torque = np.linalg.qr(rng.standard_normal((NX, NX)))[0], rng.standard_normal((NX, NU))
        steps.append(SimpleNamespace(state_by_state=0.9 * turned, state_by_torque=by_torque))

    def maps(step, theta, rollout, inputs, feedback):
        pairs = zip(steps, feedback.gain, inputs, strict=True)
        rows = [np.hstack([s.state_by_state, s.state_by_torque @ given]) for s, _, given in pairs]
        for row, s, gain in zip(rows, steps, feedback.gain, strict=True):
            row[:, feedback.state_indices] -= s.state_by_torque @ gain
        return [(np.stack(rows), None)]

    monkeypatch.setattr(propagation, "linearized_rollout_steps", maps)
    monkeypatch.setattr(
        propagation, "applied_torque_derivative_by_torque_error", lambda gain, _: np.tile(np.eye(NU), (STEPS, 1, 1))
    )
    monkeypatch.setattr(propagation, "_INITIAL_RANDOM_SAMPLES", 8)
    shift = SimpleNamespace(momentum_derivative_by_previous_torque=lambda theta: None)
    functions = SimpleNamespace(step=None, effect_momentum_calculator=shift)
    feedback = SimpleNamespace(state_indices=[0, 1], gain=0.3 * rng.standard_normal((STEPS, NU, 2)))
    course = SimpleNamespace(
        model_functions=functions, tracking_feedback=feedback, theta=None, rollout=None,
        initial_state_by_angles=rng.standard_normal((NX, NU)), initial_state_by_torque=rng.standard_normal((NX, NU)),
    )  # fmt: skip
    errors = SimpleNamespace(
        angle_std=np.ones(NU), torque_std=np.array([0.5, 0.2]), torque_bias_std=np.array([2.0, 0.0]),
        encoder_noise_steps=1.0, sample_of_step=np.repeat(np.arange(STEPS // 2), 2),
    )  # fmt: skip
    return course, errors, rng.standard_normal((STEPS + 1, READINGS, NX)), steps


def covariance(course, errors, slopes, steps):
    """Of all readings, from every error by itself."""
    columns = []
    samples = errors.sample_of_step

    def run(start, torque=None, angles=None):
        state, found = start, [slopes[0] @ start]
        for k, here in enumerate(steps):
            pulled = here.state_by_torque @ course.tracking_feedback.gain[k]
            moved = here.state_by_state @ state - pulled @ state[:2]
            state = moved + here.state_by_torque @ torque[samples[k]] + pulled @ angles[k]
            found.append(slopes[k + 1] @ state)
        columns.append(np.ravel(found))

    for joint in np.eye(NU):
        none, still = np.zeros((STEPS // 2, NU)), np.zeros((STEPS, NU))
        run(course.initial_state_by_angles @ joint, none, still)
        bias = joint * errors.torque_bias_std
        run(course.initial_state_by_torque @ bias, none + bias, still)
        for i in range(len(none)):
            white = np.array([joint * errors.torque_std * (i == k) for k in range(len(none))])
            run(course.initial_state_by_torque @ white[0], white, still)
        for k in range(STEPS):
            run(np.zeros(NX), none, still + joint * (np.arange(STEPS) == k)[:, None])
    return np.array(columns).T @ np.array(columns)


@pytest.mark.parametrize("size", [1.0, 0.02])
def test_few_unknowns_have_the_covariance_of_all(drawn_motion, size):
    course, errors, slopes, steps = drawn_motion
    few = propagation._low_rank_error_sensitivity(course, errors, size * slopes)
    few = few.reshape(READINGS * (STEPS + 1), -1)
    missing = covariance(course, errors, size * slopes, steps) - few @ few.T
    assert few.shape[1] < len(few) if size < 1 else few.shape[1] <= len(few)
    assert np.abs(np.linalg.eigvalsh(missing)).max() < 0.1**2


@pytest.fixture(scope="module")
def noisy(repository):
    """One arm on a coarse Y, for a second; its torques have white noise and offsets."""
    coarse = ["model.object.links=1", "problem.duration=1.0", "problem.use_compiler=false", "recordings.held_out=[]"]
    free = "{T1.bend: {free: true, initial: 20}, T2.bend: {free: true, initial: 10}, T2.twist: {initial: 10}}"
    coarse += ["parameters={}", f"parameters={free}"]
    return load_problem(repository / "configs" / "single_arm_vision.yaml", coarse)


def relative(problem):
    return {name: entry.std_relative for name, entry in identifiability(problem).parameters.items()}


@pytest.fixture(scope="module")
def ranking(noisy):
    return what_if(noisy, considered_changes=("rate:30",))


def test_the_experiment_as_it_is_knows_the_noise_of_its_torques(noisy, ranking):
    told, exact = relative(noisy), relative(problem_with_exact_inputs(noisy))
    for name, std in told.items():
        assert ranking.unchanged_experiment.std_relative[name] == pytest.approx(std, rel=0.02)
        assert std > 1.2 * exact[name]


def test_encoders_that_are_measurements_stay_so(noisy):
    half, off = replace(noisy.options, duration=0.5), SensorOptions(use=False)
    arms = half.sensors | {"points_arm": off}
    sensors = (arms, arms | {"joints.position": off})
    problem, without = (noisy.with_options(replace(half, sensors=own)) for own in sensors)
    found, blind = (what_if(one, considered_changes=()).unchanged_experiment.std_relative for one in (problem, without))
    for name, std in relative(problem).items():
        assert found[name] == pytest.approx(std, rel=0.3)
        assert found[name] < 0.5 * blind[name]


def test_a_predicted_camera_tells_beside_wrong_torques_what_it_tells_when_it_is_there(noisy, ranking):
    """The faster camera predicted, and the same one in the recording."""
    predicted = ranking.single_changes[0]
    recording = noisy.episodes[0].recording
    times = recording.joints.t[0] + np.arange(0.0, 1.0 + 1e-9, 1 / 30)
    groups = []
    for own in recording.points:
        if own.name == "points_camera":
            shape = (len(times), len(own.names), 3)
            std = np.full(shape, float(np.nanmedian(own.std)))
            own = replace(own, t=times, position=np.zeros(shape), std=std)
        groups.append(own)
    # what is there tells of errors of torques too: those that the real recording tells of
    errors = problem_with_whitening_at(noisy, noisy.initial_unknowns, rounds=2).episodes[0].input_errors
    effort = recording.joints.effort.copy()
    effort[: len(errors.torque_noise)] -= errors.recorded_minus_true_torque
    faster = replace(recording, points=tuple(groups), joints=replace(recording.joints, effort=effort))
    values = noisy.unknowns.named_values(noisy.initial_unknowns)
    problem = EstimationProblem(noisy.step, [faster], noisy.free, noisy.options, values)
    weighted = problem_with_whitening_at(problem, problem.initial_unknowns)
    jacobian = residual_and_jacobian_with_stated_priors(weighted, weighted.evaluate(problem.initial_unknowns))[1]
    std = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian))) / problem.initial_unknowns
    for name, value in zip(problem.unknown_names, std, strict=True):
        assert predicted.std_relative[name] == pytest.approx(value, rel=0.02)


def test_made_motions_are_as_noisy_as_the_recorded_one(noisy, monkeypatch):
    builder = ExperimentVariantSensitivityBuilder(UnchangedExperiment(noisy, noisy.initial_unknowns))
    made = builder.position_sensitivities_of_variant(frozenset({"motion"}))
    assert not isinstance(made, str), made
    own, recorded = made.problem.episodes[0].input_errors, noisy.episodes[0].input_errors
    for name in ("torque_std", "torque_bias_std", "angle_std"):
        np.testing.assert_allclose(getattr(own, name), getattr(recorded, name))
    second = SimpleNamespace(driven=(*noisy.system.driven, "other"))
    angle, torque, bias = experiment_design._noise_as_recorded(noisy.system, second, noisy.episodes[0])
    assert torque[-1] == np.median(recorded.torque_std)
    assert bias[-1] == np.median(recorded.torque_bias_std)
    np.testing.assert_array_equal(angle[:-1], recorded.angle_std)


@pytest.mark.parametrize("feedback", ["none", "proportional"])
def test_errors_of_torques_move_points_as_rollouts_with_other_torques_do(urdf_folder, feedback):
    """Also of an arm that nothing brings back to its motion."""
    step = pendulum_step(urdf_folder, driven=("shoulder",))
    made = taken(step, 3, camera=False)
    [tip] = made.points
    made = replace(made, points=(replace(tip, std=np.ones(tip.position.shape), sensor_name="arm"),))
    levels = {"effort_std": 0.3, "effort_bias_std": 0.2, "position_std": 0.0}
    made = replace(made, joints=replace(made.joints, **levels))
    options = ProblemOptions(
        path_cutoff=math.inf, arm_tracking_feedback=feedback, arm_proportional_gains=(9.0,), initial_state="equilibrium"
    )
    problem = EstimationProblem(step, [made], ("elbow.stiffness",), options)
    x, [episode] = problem.initial_unknowns, problem.episodes
    slopes, _ = propagation.point_jacobians_and_joint_information(problem, problem.evaluate(x), x, 0, {tip.name: 1e-6})
    [found] = (own[:, :, len(x) :].reshape(-1, own.shape[2] - len(x)) for own in slopes.values())

    def seen(change):
        moved = replace(episode, torque=episode.torque + change[:, None], input_errors=None)
        result = problem.predictor.predict_episode(moved, *problem.unpack_episode_unknowns(x, 0), False)
        return result.predicted_outputs[0].ravel()

    count, size = len(episode.torque), 1e-4
    by_torque = np.stack([(seen(size * row) - seen(-size * row)) / (2 * size) for row in np.eye(count)], axis=1)
    constant = by_torque.sum(axis=1)
    expected = 0.3**2 * by_torque @ by_torque.T + 0.2**2 * np.outer(constant, constant)
    np.testing.assert_allclose(found @ found.T, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())

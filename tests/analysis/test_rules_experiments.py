"""Experiments that were not made, rule by rule: their mechanics, how robots would move, all that would be seen."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from made_recordings import GRID, group, holding_pendulum, places, setting

from yid_ocp.analysis import experiment_design as module
from yid_ocp.analysis.experiment_design import (
    _FORWARD_GRIPPER_OFFSET,
    _INWARD_GRIPPER_OFFSET,
    ARM_GROUP,
    CAMERA_GROUP,
    BaseExperiment,
    CandidateExperimentBuilder,
    _pushed_together,
    _travel,
)
from yid_ocp.analysis.identifiability import transfer_unknowns, with_grasp_offset_effects, with_nuisance_unknowns
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.errors import DataError, SolverError
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import Grasp, System
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.objects.foam_y import y_object
from yid_ocp.model.servos_and_springs import RobotJointSpring
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions


@pytest.fixture(scope="module")
def holding(urdf_folder):
    return holding_pendulum(urdf_folder)


# -- mechanics --------------------------------------------------------------------------------------------------------


def mechanics(*, grasps=(), second=None, driven=(), prescribed=(), measured=False, joints=True):
    sensor = SimpleNamespace(effort_joints=measured)
    recording = SimpleNamespace(joints=object() if joints else None)
    episode = SimpleNamespace(measurements=(SimpleNamespace(sensor=sensor),), recording=recording)
    system = SimpleNamespace(
        grasps=[SimpleNamespace(kind=kind) for kind in grasps], driven=driven, prescribed=prescribed, servos=()
    )
    return CandidateExperimentBuilder(
        BaseExperiment(SimpleNamespace(system=system, episodes=(episode,)), np.zeros(1), two_arm_system=second)
    )


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
    assert mechanics(**settings).applicable_changes() == possible.split()


@pytest.mark.parametrize(
    ("joints", "std"),
    [
        (None, 0.7),
        ({}, 0.7),
        ({"effort_std": 0.2}, None),
        ({"effort_std": np.array([0.2, 0.3])}, None),
        ({"effort_std": np.array([0.2, 0.0])}, 0.7),
        ({"effort_std": 0.0}, 0.7),
    ],
)
def test_noise_of_torques_is_what_is_stated_or_typical(joints, std):
    made = None if joints is None else JointGroup(("a", "b"), np.arange(2.0), np.zeros((2, 2)), **joints)
    problem = SimpleNamespace(episodes=(SimpleNamespace(recording=SimpleNamespace(joints=made)),))
    found = CandidateExperimentBuilder(BaseExperiment(problem, np.zeros(1), torque_std=0.7))._torque_options()
    assert found.std == std


def test_a_layout_is_built_once_and_says_what_takes_time(monkeypatch):
    told, built = [], []
    builder = CandidateExperimentBuilder(BaseExperiment(None, np.zeros(1)), SimpleNamespace(begin_stage=told.append))

    def build(mechanics):
        built.append(mechanics)
        if "weld" in mechanics:
            raise SolverError("it snaps", where="here")
        return "a layout"

    monkeypatch.setattr(builder, "_build", build)
    both, none = frozenset({"weld", "torque"}), frozenset()
    for _ in range(2):
        assert builder.build_experiment(none) == "a layout"
        assert builder.build_experiment(both) == "it snaps"
        assert builder.build_experiment(frozenset({"motion"})) == "a layout"
    assert built == [none, both, frozenset({"motion"})]
    assert told == [
        "working out joint torques as a measurement, the arms' motion as known and weld grasps in place of points",
        "working out another motion",
    ]


# -- motions ----------------------------------------------------------------------------------------------------------


def travelled(system, angles):
    episode = SimpleNamespace(measured_driven_angles=np.array(angles, float))
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
    system = System.build(robot, driven=["shoulder", "elbow"], point_frames=["tip"])
    assert travelled(system, [(0.0, 0.0), (1.0, 1.0)]) == 0.11


@pytest.mark.parametrize("points", [("w_T1", "w_T2", "w_T3"), ("w_T1", "w_T2")])
def test_two_arms_hold_the_object_together_and_away(urdf_folder, points):
    """The Y, half a metre along x and 0.2 m along y: each arm's hand a bit towards the middle, both a bit outwards."""
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    place = np.eye(4)
    place[:2, 3] = 0.5, 0.2
    grasps = [Grasp("left", "tip", "w_T2"), Grasp("right", "lower", "w_T3")]
    objects = [(y_object(), None, place)]
    system = System.build(robot, objects=objects, grasps=grasps, driven=["shoulder", "elbow"], point_frames=points)
    ends = dict(zip(points, places(system, points, np.zeros(system.n_coordinates)), strict=True))
    middle = sum(ends.values()) / len(ends)
    away = np.array([*middle[:2], 0.0]) / math.hypot(*middle[:2])
    found = _pushed_together(system, {})
    assert set(found) == {grasp.name for grasp in grasps if grasp.held_frame in ends}
    for grasp in grasps[: len(found)]:
        inward = (middle - ends[grasp.held_frame]) / np.linalg.norm(middle - ends[grasp.held_frame])
        np.testing.assert_allclose(
            found[grasp.name], _INWARD_GRIPPER_OFFSET * inward + _FORWARD_GRIPPER_OFFSET * away, atol=1e-12
        )


def test_an_object_over_the_robot_is_not_pushed_away(holding):
    """One end that is the middle itself, on the robot's own axis."""
    assert _pushed_together(holding, {})["hand"] == pytest.approx([0.0, 0.0, 0.0])


@pytest.fixture
def moving(holding, monkeypatch):
    """moving(system, twice): a motion as `_moved` asks for it, of an engine that only remembers."""
    kept = SimpleNamespace()
    joints = list(holding.mechanism.joints)
    for i, (lower, upper, effort) in enumerate([(-1.0, 1.0, 5.0), (-0.5, 2.0, 3.0)]):
        joints[i] = replace(joints[i], lower_limit=lower, upper_limit=upper, effort_limit=effort)
    limited = replace(holding, mechanism=replace(holding.mechanism, joints=tuple(joints)))

    def engine(system, values, motion, simulation, initial_joint_angles):
        kept.simulated = (system, values, motion, simulation, initial_joint_angles)
        return SimpleNamespace(t=np.arange(3.0), q=kept.q, effort=kept.effort)

    def draw(system, values, seed, initial_joint_angles, excitation):
        kept.drawn = (system, values, seed, initial_joint_angles, excitation)
        return "motion"

    monkeypatch.setattr(module, "simulate_in_mujoco", engine)
    monkeypatch.setattr(module, "random_multisine", draw)

    def run(q=((0.0, 0.0),) * 3, effort=((0.0, 0.0),) * 3, twice=False, system=None):
        q = np.array(q, float)
        kept.q = np.hstack([q, np.full((len(q), limited.n_coordinates - 2), 9.0)])
        kept.effort = np.array(effort, float)
        angles = np.array([[0.3, 0.1], [0.9, -0.4]])
        episode = SimpleNamespace(measured_driven_angles=angles, grid=GRID, name="run", input_errors=None)
        problem = SimpleNamespace(
            system=limited, split=lambda x, i: (limited.parameters.vector({"T1.bend": x[0]}), None), episodes=(episode,)
        )
        made = BaseExperiment(problem, np.array([6.5]))
        recording, notes = CandidateExperimentBuilder(made)._moved(system or limited, episode, 5, twice)
        kept.travel = _travel(limited, made.parameter_values, episode)
        return recording, notes, kept

    run.system = limited
    return run


@pytest.mark.parametrize(("twice", "factor", "speed"), [(False, 1.0, 1.4), (True, 2.0, 2.8)])
def test_another_motion_starts_where_the_recording_does_and_goes_as_far(moving, twice, factor, speed):
    recording, notes, kept = moving(twice=twice)
    system, values, seed, posture, excitation = kept.drawn
    assert values["T1.bend"] == 6.5
    assert (seed, posture) == (5, {"shoulder": 0.3, "elbow": 0.1})
    assert excitation.gripper_travel == pytest.approx(factor * kept.travel)
    assert excitation.max_joint_speed == speed
    assert excitation.duration == pytest.approx(2.0)
    assert kept.simulated[:3] == (system, values, "motion")
    assert kept.simulated[3].duration == pytest.approx(2.0)
    assert kept.simulated[4] == posture
    assert (recording.name, notes, recording.points) == ("run", [], ())
    assert recording.joints.names == ("shoulder", "elbow")
    np.testing.assert_array_equal(recording.joints.position, np.zeros((3, 2)))
    joints = recording.joints
    assert (joints.position_std, joints.effort_std, joints.effort_bias_std) == (0.0, 0.0, 0.0)
    assert joints.effort_kind == "command"


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

    def settle(system, values, start_angles, offsets):
        asked.append((system, start_angles, offsets))
        return {"elbow": 0.7, "shoulder": 0.2}

    monkeypatch.setattr(module, "grasping_joint_angles", settle)
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
            return SimpleNamespace(name=name, recording=Recording(joints, (), name=name), grid=GRID, input_errors=None)

        self.episodes = (episode("one"), episode("two"))
        self.held_out = tuple(episode(f"held_{i}") for i in range(held_out))
        self.system = SimpleNamespace(driven=("a",))
        self.options = ProblemOptions(duration=duration)
        self.has_process_noise = False


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

    monkeypatch.setattr(CandidateExperimentBuilder, "_moved", moved)
    monkeypatch.setattr(CandidateExperimentBuilder, "_welded", weld)
    return kept


def experiment(base, *names, second=None):
    return CandidateExperimentBuilder(
        BaseExperiment(base, np.zeros(1), two_arm_system=second, motion_seed=20)
    )._experiment(frozenset(names))


@pytest.mark.parametrize("names", [(), ("torque",)])
def test_without_another_motion_the_recordings_stay(engine, names):
    base = Base()
    system, recordings, notes = experiment(base, *names)
    assert system is base.system
    assert recordings == [episode.recording for episode in base.episodes]
    assert (notes, engine.asked) == ([], [])


def test_recordings_end_where_the_problem_does():
    made = CandidateExperimentBuilder(BaseExperiment(Base(duration=2.0), np.zeros(1)))
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
    chosen.problem.system.grasps = [SimpleNamespace(held_frame=name) for name in base_grasps]
    chosen.problem.step = SimpleNamespace(time_step=0.1)
    builder = CandidateExperimentBuilder(replace(chosen, two_arm_system=second))
    recording = replace(episode.recording, joints=joints) if joints is not None else episode.recording
    return builder._dense(recording, 3, seen, torque)


SEEN = [
    SimpleNamespace(name="tip", is_arm_measurable=False, added_frame=None),
    SimpleNamespace(name="marker", is_arm_measurable=True, added_frame=None),
]


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
    found = dense(
        setting(), seen=SEEN, joints=joints, second=SimpleNamespace(grasps=[SimpleNamespace(held_frame="w_T3")])
    )
    looking, feeling = found.points
    assert (looking.name, looking.names, looking.sensor) == (CAMERA_GROUP, ("tip", "marker"), "camera")
    np.testing.assert_array_equal(looking.pose, np.eye(4))
    assert (feeling.name, feeling.names, feeling.sensor, feeling.pose) == (ARM_GROUP, ("marker", "w_T3"), "arm", None)
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
    system = System.build(
        robot, prescribed=["shoulder"], springs={"elbow": RobotJointSpring(3.0)}, damping=0.1, point_frames=["tip"]
    )
    step = compile_step(system, 0.02, use_compiler=False)
    t = 0.02 * np.arange(41)
    path = 0.4 * np.sin(7.0 * t)
    joints = JointGroup(["shoulder"], t, path[:, None], position_std=0.0)
    camera = PointGroup(CAMERA_GROUP, ["tip"], t[::4], np.zeros((11, 1, 3)), 2e-3, sensor="camera", pose=np.eye(4))
    recording = Recording(joints, (camera,), name="swing")

    def build(**options):
        chosen = ProblemOptions(path_cutoff=math.inf, **options)
        return EstimationProblem(step, [recording], ("elbow.stiffness", "elbow.rest"), chosen, {"elbow.rest": 0.1})

    return build


def informed(problem, mechanics=(), **settings):
    made = BaseExperiment(problem, problem.initial_unknowns, "known", None, **settings)
    built = CandidateExperimentBuilder(made).build_experiment(frozenset(mechanics))
    assert not isinstance(built, str), built
    return built, built.fisher_information([made.recorded_observations(episode) for episode in problem.episodes])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"huber_threshold": 0.1},
        {"weighting": "paper"},
        {"weak_prior_factor": 0.01},
        {"prior_stds": {"elbow.stiffness": 1e-3}},
        {"duration": 0.8},
    ],
    ids=["plain", "robust", "paper", "weak priors", "stated priors", "all of it"],
)
def test_information_is_of_the_sensors_alone(swung, options):
    """Neither robust costs nor weights nor priors of the parameters themselves change what sensors would tell."""
    problem = swung()
    evaluation = problem.evaluate(problem.initial_unknowns)
    rows = evaluation.jacobian[problem.residual_rows.data]
    built, found = informed(swung(**options))
    assert built.free_parameters == ("elbow.stiffness", "elbow.rest")
    assert not np.any(built.prior_information)
    np.testing.assert_allclose(found, rows.T @ rows, rtol=1e-9)


def test_the_same_mechanics_need_no_other_step(swung):
    problem = swung()
    same, _ = informed(problem)
    other, _ = informed(problem, ["torque"])
    assert same.problem.step.kernel is problem.step.kernel
    # torques as a measurement take the arm's motion as known, which is another system even where it was known already
    assert other.problem.step.kernel is not problem.step.kernel


@pytest.mark.parametrize(
    ("initial", "start", "becomes", "given"),
    [
        ("equilibrium", "known", "equilibrium", False),
        ("equilibrium", "unknown", "estimated", False),
        ("estimated", "known", "equilibrium", True),
        ("estimated", "unknown", "estimated", False),
        ("fitted_to_points", "known", "fitted_to_points", True),
        ("fitted_to_points", "unknown", "estimated", True),
    ],
)
def test_starts_are_unknown_or_stay_where_the_fit_has_them(swung, initial, start, becomes, given):
    problem = swung(initial_state=initial)
    x = problem.initial_unknowns
    made = with_nuisance_unknowns(problem, x, start, None)
    assert made.options.initial_state == becomes
    assert (made is problem) == (becomes == initial)
    assert made.free == problem.free
    if made is not problem:
        assert set(made.options.known_initial_states) == ({"swing"} if given else set())
    if given and made is not problem:
        episode = problem.episodes[0]
        before = problem.initial_state(episode, *problem.split(x, 0)).state
        np.testing.assert_allclose(made.options.known_initial_states["swing"], before)
        after = made.initial_state(
            made.episodes[0], *made.split(transfer_unknowns(x, problem.unknown_names, made), 0)
        ).state
        np.testing.assert_allclose(after, before)


@pytest.mark.parametrize("std", [None, 2e-3])
def test_where_grasps_sit_is_unknown_only_where_that_is_asked(held_tube, std):
    step = compile_step(with_grasp_offset_effects(held_tube.system), 0.02, use_compiler=False)
    recordings = [episode.recording for episode in held_tube.episodes]
    free = (*held_tube.free, "grasp_offset@hand.dy")
    problem = EstimationProblem(step, recordings, free, held_tube.options)
    made = with_nuisance_unknowns(problem, problem.initial_unknowns, "known", std)
    added = () if std is None else ("grasp_offset@hand.dx", "grasp_offset@hand.dz")
    assert made.free == (*free, *added)
    assert made.options.prior_stds == dict.fromkeys(added, std)


def test_shorter_recordings_tell_less(swung):
    _, whole = informed(swung())
    built, half = informed(swung(duration=0.4))
    assert built.problem.episodes[0].grid.steps == 20
    assert np.all(np.linalg.eigvalsh(whole - half) > 0)
    assert built.problem.options.duration is None


def test_torques_as_a_measurement_are_fixed_information(swung):
    built, _ = informed(swung(), ["torque"])
    finer, _ = informed(swung(), ["torque"], torque_std=0.05)
    blind = built.fisher_information([[]])
    assert np.all(np.linalg.eigvalsh(blind) > 0)
    np.testing.assert_allclose(finer.fisher_information([[]]), 4 * blind, rtol=1e-9)
    assert built.problem.system.prescribed == ("shoulder",)


def test_what_cannot_be_rolled_out_is_no_layout(swung, monkeypatch):
    problem = swung()
    monkeypatch.setattr(
        EstimationProblem, "evaluate", lambda self, x: SimpleNamespace(ok=False, jacobian=None, message="it snaps")
    )
    made = CandidateExperimentBuilder(BaseExperiment(problem, problem.initial_unknowns, "known", None))
    assert made.build_experiment(frozenset()) == "the model cannot be rolled out: it snaps"


def test_welds_keep_the_orientation_at_the_start(held_tube):
    builder = CandidateExperimentBuilder(BaseExperiment(held_tube, held_tube.initial_unknowns, "known", None))
    system = builder._welded(held_tube.system, frozenset())
    layout = builder.build_experiment(frozenset())
    (grasp,) = system.grasps
    assert grasp.kind == "weld"
    start = layout.problem.initial_state(layout.problem.episodes[0], *layout.problem.split(layout.x, 0))
    symbol = ca.SX.sym("q", system.n_coordinates)
    tree = replace(layout.problem.system.mechanism, parameters=system.parameters).with_numeric_values(None)
    kinematics = forward_kinematics(tree, symbol)
    turn = kinematics.frame_pose(grasp.holder_frame).rotation.T @ kinematics.frame_pose(grasp.held_frame).rotation
    wanted = np.array(ca.Function("turn", [symbol], [turn])(start.state[: system.n_coordinates]))
    np.testing.assert_allclose(np.array(ca.DM(grasp.held_orientation)), wanted, atol=1e-9)
    assert np.linalg.norm(wanted - np.eye(3)) > 0.01


@pytest.mark.parametrize("how", ["layout", "start"])
def test_welds_need_a_start(held_tube, monkeypatch, how):
    builder = CandidateExperimentBuilder(BaseExperiment(held_tube, held_tube.initial_unknowns, "known", None))
    if how == "layout":
        monkeypatch.setattr(builder, "build_experiment", lambda others: "it snaps")
    else:
        builder.build_experiment(frozenset())
        monkeypatch.setattr(
            EstimationProblem,
            "initial_state",
            lambda self, *rest: SimpleNamespace(failure_message="it snaps", state=None),
        )
    with pytest.raises(SolverError, match="it snaps"):
        builder._welded(held_tube.system, frozenset())

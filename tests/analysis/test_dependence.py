"""Which rows a parameter enters and what sensors see of them: known cases, and rollouts with the parameter changed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.analysis.step_diagnostics import (
    ParameterEquationDependence,
    linearise_step_equations,
    parameter_dependences,
)
from yid_ocp.analysis.step_symbols import StepSymbols
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import compile_step
from yid_ocp.integrator.step_model import RolloutInputs
from yid_ocp.model import Segment, System, flexible_object
from yid_ocp.model.rotations import homogeneous_transform, rotation_from_rpy
from yid_ocp.model.servos_and_springs import RobotJointSpring
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.problem.model_functions import TimeGridStateValues

STD = 2e-3
STEPS = 60


def camera(t, points):
    seen = np.zeros((len(t), len(points), 3))
    return PointGroup("points_camera", list(points), t, seen, STD, sensor="camera", pose=np.eye(4))


def judged(problem):
    """By parameter: its dependence about the rest at the first posture; the rest besides."""
    step, episode = problem.step, problem.episodes[0]
    system = step.system
    rest = EquilibriumSolver(step).solve(
        episode.initial_known_coordinates, problem.theta, episode.torque[0] if system.driven else None
    )
    assert rest.is_converged
    path = episode.initial_known_coordinates[len(system.driven) :]
    rows = linearise_step_equations(step, rest.state, rest.holding_torque, problem.theta, path)
    symbols = StepSymbols.from_equations(step.equations)
    found = parameter_dependences(step, symbols, episode, rest.state, problem.theta, rows)
    return {entry.parameter: entry for entry in found}, rest, rows


@pytest.fixture(scope="module")
def hanging():
    """hanging(gravity, turned): a rod of three links under the ceiling or a wall, its tip seen."""
    rod = flexible_object([Segment("T1", 0.6, 0.1, 0.02, links=3, bend=4.0, twist=3.0)])
    t = 0.01 * np.arange(STEPS + 1)

    def build(gravity=(0.0, 0.0, -9.81), turned=(math.pi, 0.0, 0.0)):
        system = System.build(
            objects=[(rod, None, homogeneous_transform(rotation_from_rpy(*turned), np.zeros(3)))], gravity=gravity
        )
        step = compile_step(system, 0.01, use_compiler=False)
        recording = Recording(None, (camera(t, ["w_T1"]),), name="hanging")
        return EstimationProblem(step, [recording], ("T1.bend", "T1.twist"), ProblemOptions())

    return build


@pytest.mark.parametrize("turned", [(math.pi, 0.0, 0.0), (2.8, 0.3, 0.7), (2.0, -0.5, 1.1)])
def test_the_twist_of_a_straight_rod_is_seen_by_nobody(hanging, turned):
    """Also where it hangs along no axis of the world, so that its rest is straight within rounding only."""
    along = np.array(rotation_from_rpy(*turned))[:, 2]
    found, _, _ = judged(hanging(gravity=9.81 * along, turned=turned))
    twist, bend = found["T1.twist"], found["T1.bend"]
    rows = tuple(f"{row}[T1_{i}_z]" for row in ("del", "p1") for i in range(3))
    assert twist.rows == rows
    assert twist.seen == ()
    assert twist.best == ""
    assert twist.words.startswith(
        f"T1.twist enters 6 rows ({', '.join(rows)}), none of which a sensor sees to first order."
    )
    assert "moves no reading by a millionth of its standard deviation within 0.6 s" in twist.words
    assert bend.seen == bend.rows
    assert "all of which sensors see to first order, points_camera best" in bend.words
    # a rod that hangs straight does not bend: its stiffness moves nothing either
    assert bend.moved < 1e-6


def test_the_twist_of_a_bent_rod_is_seen_but_not_its_stiffness(hanging):
    """Pulled sideways it bends in one plane, out of which a twist turns it; at rest there is no twist to resist."""
    found, _, _ = judged(hanging(gravity=(3.0, 0.0, -9.0)))
    twist, bend = found["T1.twist"], found["T1.bend"]
    assert twist.seen == twist.rows
    assert "all of which sensors see to first order, points_camera best" in twist.words
    assert twist.moved < 1e-6
    assert bend.moved > 0.1
    assert f"one N m/rad more of it moves readings by at most {bend.moved:.2g} standard deviations" in bend.words


def test_a_length_changes_readings_directly_and_this_counts(hanging):
    problem = hanging()
    found, rest, _ = judged(problem)
    assert found["T1.length"].read == ("points_camera",)
    assert found["T1.bend"].read == ()
    assert "the reading of points_camera depends on it directly" in found["T1.length"].words
    assert found["T1.length"].moved == pytest.approx(moved_by(problem, rest, "T1.length"), rel=1e-6)
    # the tip goes down by as much, of a standard deviation of 2 mm
    assert found["T1.length"].moved == pytest.approx(1.0 / STD, rel=1e-6)


# -- numbers, against rollouts ----------------------------------------------------------------------------------------


MODES = pytest.mark.parametrize("swinging", ["driven", "prescribed"], indirect=True)


@pytest.fixture(scope="module")
def swinging(request, urdf_folder):
    """A pendulum on a springy elbow, its tip seen; the shoulder follows its torque under the filter, or its path."""
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    system = System.build(
        robot,
        **{request.param: ["shoulder"]},
        springs={"elbow": RobotJointSpring(3.0, 0.4)},
        damping=0.1,
        point_frames=["tip"],
    )
    step = compile_step(system, 0.01, use_compiler=False)
    t = 0.01 * np.arange(STEPS + 1)
    effort = {"effort": np.zeros((len(t), 1)), "effort_kind": "command", "effort_std": 0.05}
    joints = JointGroup(("shoulder",), t, np.full((len(t), 1), 0.3), position_std=1e-3, **effort)
    options = ProblemOptions(path_cutoff=math.inf, sensors={"joints.effort": SensorOptions(std=0.05)})
    return EstimationProblem(
        step, [Recording(joints, (camera(t, ["tip"]),), name="swing")], ("elbow.stiffness",), options
    )


def rolled_out(problem, rest, theta):
    """Whitened readings along a rollout from the rest under the filter's first gain, shape (sensor, node, output)."""
    step, episode = problem.step, problem.episodes[0]
    system = step.system
    torque = np.tile(rest.holding_torque, (STEPS + 1, 1))
    path = np.tile(episode.initial_known_coordinates[len(system.driven) :], (STEPS + 2, 1))
    feedback = episode.tracking_feedback
    if feedback is not None:
        feedback = replace(
            feedback,
            gain=np.tile(feedback.gain[:1], (STEPS + 1, 1, 1)),
            reference=np.tile(rest.state[feedback.state_indices], (STEPS + 1, 1)),
        )
    rollout = step.kernel.rollout(RolloutInputs(theta, rest.state, torque, path, feedback))
    assert rollout.status.is_converged
    found = []
    for samples in episode.measurements:
        std = np.nanmedian(samples.std, axis=0)
        effort = np.zeros((STEPS + 1, step.sizes["n"]))
        effort[:, list(system.prescribed_coordinate_indices)] = rollout.effort
        values = TimeGridStateValues.from_trajectory(step, rollout.state[:-1], effort)
        found.append(problem.model_functions.compiled_sensor_function(samples.sensor)(values, theta).output / std)
    return found


def moved_by(problem, rest, name):
    """The largest change of a whitened reading by a parameter, in differences of rollouts."""
    ends, change = [], 1e-5 * np.eye(len(problem.theta))[problem.system.parameters.index(name)]
    for sign in (1, -1):
        ends.append(rolled_out(problem, rest, problem.theta + sign * change))
    return max(np.max(np.abs(up - down)) / 2e-5 for up, down in zip(*ends, strict=True))


@MODES
def test_what_a_parameter_moves_is_what_rollouts_say(swinging):
    found, rest, _ = judged(swinging)
    for name in ("elbow.stiffness", "elbow.rest", "elbow.mass", "shoulder.mass", "elbow.damping"):
        assert found[name].moved == pytest.approx(moved_by(swinging, rest, name), rel=2e-3, abs=2e-4), name
        assert found[name].unit == swinging.system.parameters[name].unit


@MODES
def test_efforts_of_joints_moved_as_measured_feel_their_own_rows(swinging):
    found, _, _ = judged(swinging)
    damping = found["shoulder.damping"]
    assert damping.rows == ("del[shoulder]", "p1[shoulder]")
    assert damping.seen == damping.rows
    if swinging.system.prescribed:
        assert damping.best == "joints.effort"


# -- words ------------------------------------------------------------------------------------------------------------


def test_without_sensors_only_rows_are_said(hanging):
    step = hanging().step
    symbols = StepSymbols.from_equations(step.equations)
    theta = step.system.parameters.vector()
    rest = EquilibriumSolver(step).solve(np.zeros(0), theta, None)
    rows = linearise_step_equations(step, rest.state, rest.holding_torque, theta, np.zeros(0))
    found = {e.parameter: e for e in parameter_dependences(step, symbols, None, rest.state, theta, rows)}
    assert found["T1.twist"].seen is None
    assert found["T1.twist"].moved is None
    assert found["T1.bend"].words == "T1.bend enters 12 rows (6 of del, 6 of p1)."


ROWS = "k enters 2 rows (del[a], p1[a])"
SEES = "sensors see to first order"


MANY = (*(f"del[{i}]" for i in range(5)), *(f"p1[{i}]" for i in range(4)))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rows": MANY, "seen": None}, "k enters 9 rows (5 of del, 4 of p1)."),
        ({"rows": MANY[:8], "seen": None}, f"k enters 8 rows ({', '.join(MANY[:8])})."),
        ({}, f"{ROWS}, all of which {SEES}, tip best."),
        ({"rows": ("del[a]",), "seen": ()}, "k enters 1 row (del[a]), which no sensor sees to first order."),
        ({"rows": ("del[a]",), "seen": ("del[a]",)}, f"k enters 1 row (del[a]), which {SEES}, tip best."),
        ({"seen": ("p1[a]",)}, f"{ROWS}, 1 of which {SEES} (p1[a]), tip best."),
        (
            {"rows": (), "seen": (), "read": ("tip",)},
            "k enters no row of a step; the reading of tip depends on it directly.",
        ),
        (
            {"seen": (), "moved": 0.0, "along": 12.345},
            f"{ROWS}, none of which a sensor sees to first order. From rest, one N more of it moves no reading by a "
            "millionth of its standard deviation within 0.5 s. Along the recordings, one N more of it moves all "
            "readings together by 12 standard deviations, to first order.",
        ),
        (
            {"unit": "1", "moved": 0.25},
            f"{ROWS}, all of which {SEES}, tip best. From rest, 1 more of it moves readings by at most 0.25 standard "
            "deviations within 0.5 s.",
        ),
    ],
)
def test_words(changes, words):
    made = ParameterEquationDependence("k", "N", ("del[a]", "p1[a]"), ("del[a]", "p1[a]"), "tip", (), None, 0.5)
    assert replace(made, **changes).words == words

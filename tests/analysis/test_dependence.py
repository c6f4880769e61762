"""Which rows a parameter enters and what sensors see of them: known cases, and rollouts with the parameter changed."""

import math

import casadi as ca
import numpy as np
import pytest
from small_problems import pendulum_step

from yid_ocp.analysis.discretisation import min_gap_by_grasp_at_robot_posture
from yid_ocp.analysis.step_diagnostics import (
    equations_and_sensors_per_parameter,
    step_complexity_summary,
    step_equation_jacobians_at_state,
    step_map_natural_frequencies,
)
from yid_ocp.analysis.step_symbols import NamedStepEquations
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import FlexibleSegment, Grasp, System, flexible_object
from yid_ocp.model.mechanism import homogeneous_transform, rotation_from_rpy
from yid_ocp.model.servos_and_springs import StiffnessAndRest
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions

STD, STEPS = 2e-3, 60


def camera(t, points):
    seen = np.zeros((len(t), len(points), 3))
    return PointGroup("points_camera", list(points), t, seen, STD, sensor_name="camera", camera_pose=np.eye(4))


def judged(problem):
    """By parameter: its dependence about the rest at the first posture; the rest besides."""
    step, episode = problem.step, problem.episodes[0]
    system = step.system
    torque = episode.torque[0] if system.driven else None
    rest = EquilibriumSolver(step).solve(episode.initial_known_coordinates, problem.theta, torque)
    assert rest.is_converged
    path = episode.initial_known_coordinates[len(system.driven) :]
    rows = step_equation_jacobians_at_state(step, rest.state, rest.holding_torque, problem.theta, path)
    symbols = NamedStepEquations.from_equations(step.equations)
    at = rest.state, rest.holding_torque, problem.theta, path
    found = equations_and_sensors_per_parameter(step, symbols, episode, *at)
    return {entry.parameter: entry for entry in found}, rest, rows


@pytest.fixture(scope="module")
def hanging():
    """hanging(gravity, turned): a rod of three links under the ceiling or a wall, its tip seen."""
    rod = flexible_object([FlexibleSegment("T1", 0.6, 0.1, 0.02, links=3, bend=4.0, twist=3.0)])
    t = 0.01 * np.arange(STEPS + 1)

    def build(gravity=(0.0, 0.0, -9.81), turned=(math.pi, 0.0, 0.0)):
        place = homogeneous_transform(rotation_from_rpy(*turned), np.zeros(3))
        step = compile_step(System.build(objects=[(rod, None, place)], gravity=gravity), 0.01, use_compiler=False)
        recording = Recording(None, (camera(t, ["w_T1"]),), name="hanging")
        return EstimationProblem(step, [recording], ("T1.bend", "T1.twist"), ProblemOptions())

    return build


@pytest.mark.parametrize("turned", [(math.pi, 0.0, 0.0), (2.8, 0.3, 0.7), (2.0, -0.5, 1.1)])
def test_the_twist_of_a_straight_rod_is_seen_by_nobody(hanging, turned):
    """Also where it hangs along no axis of the world, so that its rest is straight within rounding only."""
    found, _, _ = judged(hanging(gravity=9.81 * np.array(rotation_from_rpy(*turned))[:, 2], turned=turned))
    twist, bend = found["T1.twist"], found["T1.bend"]
    assert twist.rows == tuple(f"{row}[T1_{i}_z]" for row in ("del", "p1") for i in range(3))
    assert (twist.observable_rows, twist.most_sensitive_sensor) == ((), "")
    assert (bend.observable_rows, bend.most_sensitive_sensor) == (bend.rows, "points_camera")


def test_the_twist_of_a_bent_rod_is_seen_but_not_its_stiffness(hanging):
    """Pulled sideways it bends in one plane, out of which a twist turns it; at rest there is no twist to resist."""
    found, _, _ = judged(hanging(gravity=(3.0, 0.0, -9.0)))
    twist = found["T1.twist"]
    assert (twist.observable_rows, twist.most_sensitive_sensor) == (twist.rows, "points_camera")


def test_a_length_changes_readings_directly_and_this_counts(hanging):
    found, _, _ = judged(hanging())
    assert found["T1.length"].directly_dependent_sensors == ("points_camera",)
    assert found["T1.bend"].directly_dependent_sensors == ()


MODES = pytest.mark.parametrize("swinging", ["driven", "prescribed"], indirect=True)


@pytest.fixture(scope="module")
def swinging(request, robot):
    """A pendulum on a springy elbow, its tip seen; the shoulder follows its torque under the filter, or its path."""
    how = {request.param: ["shoulder"], "damping": 0.1, "point_frames": ["tip"]}
    system = System.build(robot, springs={"elbow": StiffnessAndRest(3.0, 0.4)}, **how)
    step, t = compile_step(system, 0.01, use_compiler=False), 0.01 * np.arange(STEPS + 1)
    effort = {"effort": np.zeros((len(t), 1)), "effort_kind": "command", "effort_std": 0.05}
    joints = JointGroup(("shoulder",), t, np.full((len(t), 1), 0.3), position_std=1e-3, **effort)
    options = ProblemOptions(path_cutoff=math.inf, sensors={"joints.effort": SensorOptions(std=0.05)})
    recording = Recording(joints, (camera(t, ["tip"]),), name="swing")
    return EstimationProblem(step, [recording], ("elbow.stiffness",), options)


@MODES
def test_efforts_of_joints_moved_as_measured_feel_their_own_rows(swinging):
    found, _, _ = judged(swinging)
    damping = found["shoulder.damping"]
    assert damping.observable_rows == damping.rows == ("del[shoulder]", "p1[shoulder]")
    if swinging.system.prescribed:
        assert damping.most_sensitive_sensor == "joints.effort"


def test_without_sensors_only_rows_are_said(hanging):
    step = hanging().step
    symbols, theta = NamedStepEquations.from_equations(step.equations), step.system.parameters.vector()
    rest = EquilibriumSolver(step).solve(np.zeros(0), theta, None)
    at = rest.state, rest.holding_torque, theta, np.zeros(0)
    found = {e.parameter: e for e in equations_and_sensors_per_parameter(step, symbols, None, *at)}
    assert found["T1.twist"].observable_rows is None
    assert len(found["T1.bend"].rows) == 12


def test_a_step_is_counted_its_unknowns_without_what_is_prescribed(urdf_folder, robot):
    swing = pendulum_step(urdf_folder, driven=("shoulder",))
    found = step_complexity_summary(swing)
    assert found["sizes"] == swing.sizes
    assert found["sizes"] | {"n": 2, "nu": 1, "nz": 0, "m": 0, "nc": 0, "nx": 4} == found["sizes"]
    assert (found["unknowns"], found["jacobian_nonzeros"]) == (2, 4)
    for entry, f in zip(found["functions"], swing.model.functions.all_functions, strict=True):
        nonzeros = sum(f.sparsity_out(i).nnz() for i in range(f.n_out()))
        assert entry == {"name": f.name(), "operations": f.n_instructions(), "nonzeros": nonzeros}
    assert max(entry["operations"] for entry in found["functions"]) > 100
    rod = flexible_object([FlexibleSegment("T1", 0.6, 0.1, 0.02, links=2, bend=4.0, twist=3.0)])
    held = {"grasps": [Grasp("hand", "tip", "w_T1")], "prescribed": ["shoulder", "elbow"]}
    tied = compile_step(System.build(robot, objects=[(rod, None, None)], **held), 0.01, use_compiler=False)
    sizes = tied.sizes
    assert step_complexity_summary(tied)["unknowns"] == sizes["n"] - 2 + sizes["nz"] + sizes["m"]


H = 0.02
INERTIA, WEIGHT = 0.008 + 0.6 * 0.2**2, 0.6 * 9.81 * 0.2  # of the lower rod about the elbow


@pytest.fixture(scope="module")
def hung_rod(robot):
    """hung_rod(stiffness, damping, mode, gravity): frequencies of the lower rod, its upper one held."""

    def find(stiffness=3.0, damping=0.0, mode="driven", gravity=-9.81):
        more = {"gravity": (0, 0, gravity), "damping": damping, mode: ["shoulder"]}
        system = System.build(robot, springs={"elbow": StiffnessAndRest(stiffness)}, point_frames=["tip"], **more)
        return step_map_natural_frequencies(system, {"shoulder": 0.0}, system.parameters.vector(), H)

    return find


@pytest.mark.parametrize("mode", ["driven", "prescribed"])
@pytest.mark.parametrize(("stiffness", "damping"), [(3.0, 0.0), (3.0, 0.05), (0.5, 0.0)])
def test_a_rod_swings_at_the_frequency_of_its_spring_and_weight(hung_rod, mode, stiffness, damping):
    found = hung_rod(stiffness, damping, mode)
    exact = math.sqrt((stiffness + WEIGHT) / INERTIA) / (2 * math.pi)
    lowered = math.atan(math.pi * exact * H) / (math.pi * H)
    assert found.frequencies_hz == pytest.approx([lowered], rel=1e-6)
    assert lowered < 0.999 * exact
    assert (found.n_unstable_modes, found.message) == (0, "")


def test_frequencies_of_several_joints_ascend(robot):
    springs = {"shoulder": StiffnessAndRest(30.0), "elbow": StiffnessAndRest(3.0)}
    system = System.build(robot, springs=springs, damping=0.3, point_frames=["tip"])
    found = step_map_natural_frequencies(system, {}, system.parameters.vector(), H)
    m1, m2, l1, c1, c2 = 1.0, 0.6, 0.5, 0.25, 0.2
    a = 0.0208 + m1 * c1**2 + m2 * (l1**2 + c2**2 + 2 * l1 * c2) + 0.008
    b, c = 0.008 + m2 * (c2**2 + l1 * c2), INERTIA
    stiff = np.array([[30.0 + 9.81 * (m1 * c1 + m2 * (l1 + c2)), WEIGHT], [WEIGHT, 3.0 + WEIGHT]])
    exact = np.sort(np.sqrt(np.linalg.eigvals(np.linalg.solve([[a, b], [b, c]], stiff)))) / (2 * math.pi)
    assert found.frequencies_hz == pytest.approx(np.arctan(math.pi * exact * H) / (math.pi * H), rel=1e-6)


def test_what_leaves_its_posture_grows(hung_rod):
    """A rod that stands on a spring too soft for its weight: no frequency, one way to fall."""
    found = hung_rod(0.5, 0.05, gravity=9.81)
    assert found.n_unstable_modes == 1
    assert not len(found.frequencies_hz)
    assert hung_rod(3.0, 0.05, gravity=9.81).n_unstable_modes == 0


def test_what_cannot_swing_says_so(robot):
    system = System.build(robot, driven=["shoulder"], prescribed=["elbow"], point_frames=["tip"])
    found = step_map_natural_frequencies(system, {}, system.parameters.vector(), H)
    assert (len(found.frequencies_hz), found.n_unstable_modes) == (0, 0)
    assert all(fact in found.message for fact in ("every coordinate is", "driven or prescribed")), found.message
    # an equation across the plane in which the pendulum moves is redundant
    tip = Grasp("hand", "ceiling", "tip", holder_offset=ca.SX(ca.DM([0.0, 0.0, 0.3])))
    system = System.build(robot, prescribed=["shoulder"], grasps=[tip], point_frames=["tip"])
    found = step_map_natural_frequencies(system, {"shoulder": 0.0}, system.parameters.vector(), H)
    assert "redundant grasps" in found.message


@pytest.fixture(scope="module")
def reaching(robot):
    """A rod of 0.6 m on the ground, half a metre from the pendulum's line; the pendulum's tip takes its end."""
    rod = flexible_object([FlexibleSegment("T1", 0.6, 0.1, 0.02, links=3, bend=4.0, twist=3.0)])

    def build(x=0.0, grasps=1):
        place = np.eye(4)
        place[0, 3] = x
        held = [Grasp("hand", "tip", "w_T1"), Grasp("other", "lower", "T1_1_tip")][:grasps]
        return System.build(robot, objects=[(rod, None, place)], grasps=held, prescribed=["shoulder", "elbow"])

    return build


@pytest.mark.parametrize(
    ("x", "angle", "gap"),
    [(0.0, 0.0, 0.0), (0.0, math.pi, 1.5), (2.0, 0.0, math.hypot(2.0, 0.3) - 0.6)],
    ids=["within reach", "too high", "too far"],
)
def test_gaps_of_grasps_are_what_bending_cannot_close(reaching, x, angle, gap):
    system = reaching(x)
    found = min_gap_by_grasp_at_robot_posture(system, {"shoulder": angle, "elbow": 0.0}, system.parameters.vector())
    assert set(found) == {"hand"}
    assert found["hand"] == pytest.approx(gap, abs=2e-3)


def test_each_grasp_has_its_gap_and_no_grasp_none(reaching):
    """Tip at 0.3 m and elbow at 0.7 m above the ground, of a rod of 0.6 m whose middle link ends at 0.4 m."""
    system = reaching(grasps=2)
    found = min_gap_by_grasp_at_robot_posture(system, {"shoulder": 0.0, "elbow": 0.0}, system.parameters.vector())
    assert list(found) == ["hand", "other"]
    assert min(found.values()) > 0.05
    system = reaching(grasps=0)
    assert min_gap_by_grasp_at_robot_posture(system, {"shoulder": 0.0, "elbow": 0.0}, system.parameters.vector()) == {}

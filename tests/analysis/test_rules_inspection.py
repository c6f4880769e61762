"""A step in numbers: its sizes, its pattern, its linearisation against finite differences; frequencies and gaps."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from made_recordings import places

from yid_ocp.analysis import discretisation as convergence
from yid_ocp.analysis.discretisation import _with_prescribed_joints, min_grasp_gaps, natural_frequencies
from yid_ocp.analysis.step_diagnostics import (
    _DIFFERENCE_STEP,
    _differences,
    _error,
    linearise_and_check,
    step_structure,
)
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import Grasp, Segment, System, flexible_object
from yid_ocp.model.servos_and_springs import RobotJointSpring
from yid_ocp.model.urdf import read_urdf


@pytest.fixture(scope="module")
def swing(urdf_folder):
    """A double pendulum whose shoulder is driven, its elbow springy."""
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    springs = {"elbow": RobotJointSpring(3.0)}
    system = System.build(robot, driven=["shoulder"], springs=springs, damping=0.2, point_frames=["tip"])
    return compile_step(system, 0.01, use_compiler=False)


@pytest.fixture(scope="module")
def held(urdf_folder):
    """The same, its tip tied to a rod that hangs from the ceiling: constraints beside coordinates."""
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    rod = flexible_object([Segment("T1", 0.6, 0.1, 0.02, links=2, bend=4.0, twist=3.0)])
    system = System.build(
        robot, objects=[(rod, None, None)], grasps=[Grasp("hand", "tip", "w_T1")], prescribed=["shoulder", "elbow"]
    )
    return compile_step(system, 0.01, use_compiler=False)


# -- counts and pattern -----------------------------------------------------------------------------------------------


def test_a_step_is_counted(swing):
    found = step_structure(swing)
    assert found["sizes"] == swing.sizes
    assert found["sizes"] | {"n": 2, "nu": 1, "nz": 0, "m": 0, "nc": 0, "nx": 4} == found["sizes"]
    assert (found["unknowns"], found["jacobian_nonzeros"]) == (2, 4)
    for entry, f in zip(found["functions"], swing.functions.all_functions, strict=True):
        nonzeros = sum(f.sparsity_out(i).nnz() for i in range(f.n_out()))
        assert entry == {"name": f.name(), "operations": f.n_instructions(), "nonzeros": nonzeros}
    assert max(entry["operations"] for entry in found["functions"]) > 100


def test_unknowns_are_what_is_not_prescribed(held):
    assert step_structure(held)["unknowns"] == held.sizes["n"] - 2 + held.sizes["nz"] + held.sizes["m"]


# -- linearisation ----------------------------------------------------------------------------------------------------


class Linear:
    """A made-up linear step of two coordinates, the second prescribed, one internal coordinate, two inputs."""

    sizes: ClassVar = {"n": 2, "nx": 5, "nu": 2, "ntheta": 3}
    system = SimpleNamespace(prescribed_indices=(1,))

    def __init__(self, **wrong):
        rng = np.random.default_rng(1)
        self.a, self.b, self.c = (rng.standard_normal((5, k)) for k in (5, 2, 3))
        self.a[:, 1] = 0.0
        self.wrong = wrong
        self.asked = []

    def __call__(self, q, p, u, theta, prescribed, z):
        after = self.a @ np.concatenate([q, p, z]) + self.b @ u + self.c @ theta + prescribed[0]
        self.asked.append(np.concatenate([q, p, z, u, theta]))
        return after[:2], after[2:4], np.zeros(0), SimpleNamespace(internal_coordinates=after[4:])

    def jacobians(self, q, p, u, theta, prescribed, z):
        said = [self.a.copy(), self.b.copy(), self.c.copy()]
        said[0][:, 1] = 99.0
        for part, name in zip(said, ("A", "B_u", "B_theta"), strict=True):
            if name in self.wrong:
                part[3, -1] += self.wrong[name]
        return said


STATE, TORQUE, THETA = np.array([0.5, -3.0, 20.0, 0.0, -0.5]), np.array([1.0, 4.0]), np.array([2.0, 0.1, 7.0])


def test_a_linear_step_is_linearised():
    step = Linear()
    found = linearise_and_check(step, STATE, TORQUE, THETA, (1.0, 2.0))
    np.testing.assert_array_equal(found.state, STATE)
    np.testing.assert_array_equal(found.b_input, step.b)
    np.testing.assert_array_equal(found.b_theta, step.c)
    assert found.spectral_radius == pytest.approx(np.max(np.abs(np.linalg.eigvals(found.a))))
    assert set(found.finite_difference_errors) == {"A", "B_u", "B_theta"}
    assert max(found.finite_difference_errors.values()) < 1e-8


@pytest.mark.parametrize("name", ["A", "B_u", "B_theta"])
@pytest.mark.parametrize("by", [0.5, -0.25])
def test_a_wrong_entry_is_a_fraction_of_the_largest(name, by):
    step = Linear(**{name: by})
    found = linearise_and_check(step, STATE, TORQUE, THETA, (1.0, 2.0))
    matrix = {"A": np.delete(found.a, 1, axis=1), "B_u": found.b_input, "B_theta": found.b_theta}[name]
    assert found.finite_difference_errors[name] == pytest.approx(abs(by) / np.max(np.abs(matrix)), rel=1e-6)
    assert all(error < 1e-8 for other, error in found.finite_difference_errors.items() if other != name)


def test_differences_are_taken_relative_to_the_size_of_what_is_varied():
    asked = []

    def square(x):
        asked.append(x.copy())
        return np.array([x[0] ** 3, x[1] * x[0]])

    at = np.array([0.1, -50.0])
    slopes = _differences(square, at)
    np.testing.assert_allclose(slopes, [[0.03, 0.0], [-50.0, 0.1]], atol=1e-8)
    moved = np.array(asked) - at
    np.testing.assert_allclose(
        moved, np.array([[1, 0], [-1, 0], [0, 50], [0, -50]]) * _DIFFERENCE_STEP, rtol=1e-6, atol=1e-18
    )
    assert _differences(lambda x: np.ones(3), np.zeros(0)).shape == (3, 0)


@pytest.mark.parametrize(
    ("exact", "difference", "error"),
    [
        ([[4.0, -8.0]], [[4.0, -6.0]], 0.25),
        ([[-4.0, 2.0]], [[-4.0, 3.0]], 0.25),
        ([[0.5]], [[0.25]], 0.5),
        ([[0.0]], [[3.0]], 0.0),
        (np.zeros((4, 0)), np.zeros((4, 0)), 0.0),
    ],
)
def test_errors_are_relative_to_the_largest_entry(exact, difference, error):
    assert _error(np.array(exact), np.array(difference)) == error


def test_a_real_step_agrees_with_its_differences(held):
    values = held.system.parameters.vector()
    state = np.zeros(held.sizes["nx"])
    posture = np.array([0.3, -0.6])
    state[list(held.system.prescribed_indices)] = posture
    state[0 : held.sizes["n"]] += 0.01
    found = linearise_and_check(held, state, np.zeros(0), values, (posture, posture + 0.01))
    assert found.a.shape == (held.sizes["nx"],) * 2
    assert max(found.finite_difference_errors.values()) < 1e-5


# -- frequencies ------------------------------------------------------------------------------------------------------


H = 0.02
INERTIA, WEIGHT = 0.008 + 0.6 * 0.2**2, 0.6 * 9.81 * 0.2  # of the lower rod about the elbow


@pytest.fixture(scope="module")
def hanging(urdf_folder):
    """hanging(stiffness, damping, mode, gravity): frequencies of the lower rod, its upper one held."""
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")

    def find(stiffness=3.0, damping=0.0, mode="driven", gravity=-9.81):
        more = {"gravity": (0, 0, gravity), "damping": damping, mode: ["shoulder"]}
        system = System.build(robot, springs={"elbow": RobotJointSpring(stiffness)}, point_frames=["tip"], **more)
        return natural_frequencies(system, {"shoulder": 0.0}, system.parameters.vector(), H)

    return find


@pytest.mark.parametrize("mode", ["driven", "prescribed"])
@pytest.mark.parametrize(("stiffness", "damping"), [(3.0, 0.0), (3.0, 0.05), (0.5, 0.0)])
def test_a_rod_swings_at_the_frequency_of_its_spring_and_weight(hanging, mode, stiffness, damping):
    found = hanging(stiffness, damping, mode)
    exact = math.sqrt((stiffness + WEIGHT) / INERTIA) / (2 * math.pi)
    lowered = math.atan(math.pi * exact * H) / (math.pi * H)
    assert found.frequencies_hz == pytest.approx([lowered], rel=1e-6)
    assert lowered < 0.999 * exact
    assert (found.n_unstable_modes, found.message) == (0, "")


def test_frequencies_of_several_joints_ascend(urdf_folder):
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    springs = {"shoulder": RobotJointSpring(30.0), "elbow": RobotJointSpring(3.0)}
    system = System.build(robot, springs=springs, damping=0.3, point_frames=["tip"])
    found = natural_frequencies(system, {}, system.parameters.vector(), H)
    m1, m2, l1, c1, c2 = 1.0, 0.6, 0.5, 0.25, 0.2
    a = 0.0208 + m1 * c1**2 + m2 * (l1**2 + c2**2 + 2 * l1 * c2) + 0.008
    b, c = 0.008 + m2 * (c2**2 + l1 * c2), INERTIA
    stiff = np.array([[30.0 + 9.81 * (m1 * c1 + m2 * (l1 + c2)), WEIGHT], [WEIGHT, 3.0 + WEIGHT]])
    exact = np.sort(np.sqrt(np.linalg.eigvals(np.linalg.solve([[a, b], [b, c]], stiff)))) / (2 * math.pi)
    assert found.frequencies_hz == pytest.approx(np.arctan(math.pi * exact * H) / (math.pi * H), rel=1e-6)


def test_what_leaves_its_posture_grows(hanging):
    """A rod that stands on a spring too soft for its weight: no frequency, one way to fall."""
    found = hanging(0.5, 0.05, gravity=9.81)
    assert found.n_unstable_modes == 1
    assert not len(found.frequencies_hz)
    assert hanging(3.0, 0.05, gravity=9.81).n_unstable_modes == 0


def test_what_cannot_swing_says_so(urdf_folder, hanging, monkeypatch):
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    system = System.build(robot, driven=["shoulder"], prescribed=["elbow"], point_frames=["tip"])
    found = natural_frequencies(system, {}, system.parameters.vector(), H)
    assert (len(found.frequencies_hz), found.n_unstable_modes) == (0, 0)
    assert found.message == "every coordinate is prescribed, nothing can swing"
    rest = SimpleNamespace(is_converged=False, message="it does not come to rest")
    monkeypatch.setattr(
        "yid_ocp.analysis.discretisation.EquilibriumSolver", lambda step: SimpleNamespace(solve=lambda *a, **k: rest)
    )
    found = hanging()
    assert (len(found.frequencies_hz), found.message) == (0, "it does not come to rest")


def test_a_robot_held_still_keeps_its_order(urdf_folder):
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    system = System.build(robot, driven=["elbow"], prescribed=["shoulder"], point_frames=["tip"])
    still = _with_prescribed_joints(system)
    assert (still.driven, still.prescribed) == ((), ("elbow", "shoulder"))


# -- grasps that cannot be closed -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def reaching(urdf_folder):
    """A rod of 0.6 m on the ground, half a metre from the pendulum's line; the pendulum's tip takes its end."""
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    rod = flexible_object([Segment("T1", 0.6, 0.1, 0.02, links=3, bend=4.0, twist=3.0)])

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
    found = min_grasp_gaps(system, {"shoulder": angle, "elbow": 0.0}, system.parameters.vector())
    assert set(found) == {"hand"}
    assert found["hand"] == pytest.approx(gap, abs=2e-3)


def test_systems_without_grasps_have_no_gaps(reaching):
    system = reaching(grasps=0)
    assert min_grasp_gaps(system, {"shoulder": 0.0, "elbow": 0.0}, system.parameters.vector()) == {}


def test_each_grasp_has_its_gap(reaching):
    """Tip at 0.3 m and elbow at 0.7 m above the ground, of a rod of 0.6 m whose middle link ends at 0.4 m."""
    system = reaching(grasps=2)
    found = min_grasp_gaps(system, {"shoulder": 0.0, "elbow": 0.0}, system.parameters.vector())
    assert list(found) == ["hand", "other"]
    assert min(found.values()) > 0.05


@pytest.mark.parametrize(
    ("starts", "searches", "gap"),
    [((0.0, 0.4, 1.0), 3, 0.0), ((0.0, 0.2, 0.4, 0.3, 1.0), 4, 0.6), ((1.0, 0.0), 1, 0.0)],
    ids=["the third closes it", "the best of four", "at once"],
)
def test_a_gap_is_sought_from_four_starts_until_it_closes(reaching, monkeypatch, starts, searches, gap):
    """Made-up searches that end so much of the way from the straight rod to the one that reaches the hand."""
    system, whole = reaching(), {}
    search = convergence.scipy.optimize.least_squares

    def found(fun, start, jac, max_nfev):
        if not whole:
            whole["x"] = search(fun, start, jac, max_nfev=max_nfev).x
        done.append(1)
        return SimpleNamespace(x=starts[len(done) - 1] * whole["x"])

    done: list[int] = []
    monkeypatch.setattr(convergence.scipy.optimize, "least_squares", found)
    gaps = min_grasp_gaps(system, {"shoulder": 0.0, "elbow": 0.0}, system.parameters.vector())
    assert len(done) == searches
    q = np.zeros(system.n_coordinates)
    ends = [starts[i] * whole["x"] for i in range(searches)]
    distances = []
    for end in ends:
        q[2:] = end
        tip, held = places(system, ["tip", "w_T1"], q)
        distances.append(float(np.linalg.norm(tip - held)))
    assert gaps["hand"] == pytest.approx(min(distances))
    assert (min(distances) < 1e-3) == (gap == 0.0)

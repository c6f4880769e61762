"""A step in numbers: its sizes, its pattern, its linearisation against finite differences; frequencies and gaps."""

from __future__ import annotations

import math

import numpy as np
import pytest

from yid_ocp.analysis.discretisation import min_grasp_closure_errors, step_map_natural_frequencies
from yid_ocp.analysis.step_diagnostics import linearise_and_check, step_size_summary
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
    found = step_size_summary(swing)
    assert found["sizes"] == swing.sizes
    assert found["sizes"] | {"n": 2, "nu": 1, "nz": 0, "m": 0, "nc": 0, "nx": 4} == found["sizes"]
    assert (found["unknowns"], found["jacobian_nonzeros"]) == (2, 4)
    for entry, f in zip(found["functions"], swing.functions.all_functions, strict=True):
        nonzeros = sum(f.sparsity_out(i).nnz() for i in range(f.n_out()))
        assert entry == {"name": f.name(), "operations": f.n_instructions(), "nonzeros": nonzeros}
    assert max(entry["operations"] for entry in found["functions"]) > 100


def test_unknowns_are_what_is_not_prescribed(held):
    assert step_size_summary(held)["unknowns"] == held.sizes["n"] - 2 + held.sizes["nz"] + held.sizes["m"]


# -- linearisation ----------------------------------------------------------------------------------------------------


def linearised(step, wrong=None):
    """The held pendulum near a rest, its hands moved; with a number of one matrix changed."""
    state = np.zeros(step.sizes["nx"])
    posture = np.array([0.3, -0.6])
    state[: step.sizes["n"]] = 0.01
    state[list(step.system.prescribed_coordinate_indices)] = posture
    if wrong is not None:
        inner, place = step.jacobians, ("A", "B_u", "B_theta").index(wrong)

        def jacobians(*arguments):
            matrices = [np.array(matrix) for matrix in inner(*arguments)]
            matrices[place][-1, -1] += 0.5 * np.max(np.abs(matrices[place]))
            return matrices

        step = Changed(step, jacobians)
    return linearise_and_check(step, state, np.zeros(step.sizes["nu"]), step.system.parameters.vector(), posture)


class Changed:
    """A step whose derivatives are other ones."""

    def __init__(self, step, jacobians):
        self._step, self.jacobians = step, jacobians

    def __getattr__(self, name):
        return getattr(self._step, name)

    def __call__(self, *arguments):
        return self._step(*arguments)


def test_a_step_agrees_with_its_differences(held):
    found = linearised(held)
    assert found.a.shape == (held.sizes["nx"],) * 2
    assert found.spectral_radius == pytest.approx(np.max(np.abs(np.linalg.eigvals(found.a))))
    assert set(found.finite_difference_errors) == {"A", "B_u", "B_theta"}
    assert found.finite_difference_errors["B_u"] == 0.0  # there is no input
    assert max(found.finite_difference_errors.values()) < 1e-5


@pytest.mark.parametrize("name", ["A", "B_theta"])
def test_a_wrong_entry_is_a_fraction_of_the_largest(held, name):
    errors = linearised(held, name).finite_difference_errors
    assert 0.3 < errors.pop(name) < 0.7
    assert max(errors.values()) < 1e-5


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
        return step_map_natural_frequencies(system, {"shoulder": 0.0}, system.parameters.vector(), H)

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
    found = step_map_natural_frequencies(system, {}, system.parameters.vector(), H)
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


def test_what_cannot_swing_says_so(urdf_folder):
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    system = System.build(robot, driven=["shoulder"], prescribed=["elbow"], point_frames=["tip"])
    found = step_map_natural_frequencies(system, {}, system.parameters.vector(), H)
    assert (len(found.frequencies_hz), found.n_unstable_modes) == (0, 0)
    assert found.message == "every coordinate is driven or prescribed: with these held still nothing can swing"


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
    found = min_grasp_closure_errors(system, {"shoulder": angle, "elbow": 0.0}, system.parameters.vector())
    assert set(found) == {"hand"}
    assert found["hand"] == pytest.approx(gap, abs=2e-3)


def test_systems_without_grasps_have_no_gaps(reaching):
    system = reaching(grasps=0)
    assert min_grasp_closure_errors(system, {"shoulder": 0.0, "elbow": 0.0}, system.parameters.vector()) == {}


def test_each_grasp_has_its_gap(reaching):
    """Tip at 0.3 m and elbow at 0.7 m above the ground, of a rod of 0.6 m whose middle link ends at 0.4 m."""
    system = reaching(grasps=2)
    found = min_grasp_closure_errors(system, {"shoulder": 0.0, "elbow": 0.0}, system.parameters.vector())
    assert list(found) == ["hand", "other"]
    assert min(found.values()) > 0.05

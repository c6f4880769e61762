"""A rod that is held at both ends, too close together, rests in several shapes: its first points say in which."""

from __future__ import annotations

import numpy as np
import pytest
from small_problems import joints, recording, seen

from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import Grasp, Segment, System, flexible_object
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.problem.episode_prediction import _MAX_FIRST_SAMPLE_TIME
from yid_ocp.sensors import sensor_reading_function
from yid_ocp.sensors.points import PointSensor

POSTURE = (0.5, 0.5)
TIP, GAP = (0.0, 0.576, 0.545), 0.55  # where the hand is, how far below the 0.6 m of rod begin [m]
MIDDLE = "T1:50%"


@pytest.fixture(scope="module")
def buckled(urdf_folder):
    """The step, and the state of the shape of least energy and of its mirror image."""
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    rod = flexible_object([Segment("T1", 0.6, 0.1, 0.02, links=3, bend=4.0, twist=3.0)])
    placement = np.eye(4)
    placement[:3, 3] = np.array(TIP) - [0.0, 0.0, GAP]
    system = System.build(
        robot,
        objects=[(rod, None, placement)],
        grasps=[Grasp("hand", "tip", "w_T1", "point")],
        prescribed=["shoulder", "elbow"],
        point_frames=["w_T1", MIDDLE],
    )
    step = compile_step(system, 0.01, use_compiler=False)
    statics, theta = EquilibriumSolver(step), system.parameters.vector()
    least = statics.solve(POSTURE, theta)
    across = least.state[: system.n_coordinates].copy()
    across[2:] *= -1.0
    mirrored = statics.solve(POSTURE, theta, None, across)
    assert least.is_converged
    assert mirrored.is_converged
    assert np.abs(least.state - mirrored.state).max() > 0.5
    return step, least.state, mirrored.state


def problem_of(step, state, first=0.1, std=1e-3, **options):
    """A recording of the rod at rest, its middle seen from `first` seconds on."""
    n, t = step.system.n_coordinates, 0.01 * np.arange(int(100 * (first + 0.3)))
    sensor = PointSensor("points_camera", (MIDDLE,), (MIDDLE,), None)
    function = sensor_reading_function(step.system, sensor, ())
    place = np.array(function(q=state[:n], theta=step.system.parameters.vector())["y"])
    late = t[t >= first - 1e-9]
    camera = seen(
        [MIDDLE], late, np.tile(place.ravel(), (len(late), 1, 1)), "points_camera", std=np.full((len(late), 1, 3), std)
    )
    made = recording(joints(["shoulder", "elbow"], t, np.tile(POSTURE, (len(t), 1))), camera)
    return EstimationProblem(
        step,
        [made],
        ("T1.bend",),
        ProblemOptions(weak_prior_factor=0.0, path_cutoff=np.inf, **options),
        held_out=[made],
    )


@pytest.mark.parametrize("which", [1, 2], ids=["least_energy", "mirrored"])
def test_a_recording_starts_in_the_shape_that_its_first_points_show(buckled, which):
    step, *states = buckled
    problem = problem_of(step, states[which - 1])
    found = problem.evaluate(problem.initial_unknowns)
    assert np.abs(found.residual).max() < 0.05
    assert (problem.episodes[0].equilibrium_guess is None) is (which == 1)
    [(_, held)] = problem.predict_held_out(problem.initial_unknowns)
    np.testing.assert_allclose(held.rollout.state[0], states[which - 1], atol=1e-6)
    if which == 2:  # and so it does with other stiffnesses
        moved = problem.evaluate(2.0 * problem.initial_unknowns)
        np.testing.assert_allclose(moved.episode_predictions[0].rollout.state[0][:5], states[1][:5], atol=0.05)


def test_points_that_come_late_or_that_no_shape_is_near_leave_the_least_energy(buckled):
    step, least, mirrored = buckled
    assert problem_of(step, mirrored, first=_MAX_FIRST_SAMPLE_TIME + 0.1).episodes[0].equilibrium_guess is None
    # an error of some standard deviations is what is to be found out, not another shape
    assert problem_of(step, mirrored, std=0.2).episodes[0].equilibrium_guess is None
    assert problem_of(step, least, first=0.0, initial_state="fitted_to_points").held_out[0].equilibrium_guess is None

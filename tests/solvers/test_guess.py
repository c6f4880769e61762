"""Where methods with node states begin, and derivatives of whole problems: adjoint = forward = finite differences."""

from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.data import JointGroup, Recording
from yid_ocp.effects import make_effect
from yid_ocp.integrator.step import compile_step, simulate
from yid_ocp.model import System
from yid_ocp.model.servos_and_springs import StiffnessAndRest
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.solvers import GaussNewton, Status, fit_problem
from yid_ocp.solvers.initial_guess import guess_unknowns_and_node_states, unknowns_with_neutral_effects_activated
from yid_ocp.solvers.multiple_shooting import _ShootingIntervals

START = np.array([5.0, 4.0])


@pytest.fixture(scope="module")
def problem(make_problem):
    return make_problem(free=("T1.bend", "T2.bend"), duration=0.1)


def nodes_of(problem):
    return [np.arange(problem.episodes[0].grid.steps + 1)]


@pytest.mark.parametrize(
    ("misfits", "taken", "tried"),
    [
        ({1.0: 9.0}, 1.0, [1.0]),
        ({1.0: 50.0, 4.0: 9.0}, 4.0, [1.0, 4.0]),
        ({1.0: 50.0, 4.0: 20.0, 2.0: 12.0, 10.0: 30.0}, 2.0, [1.0, 4.0, 2.0, 10.0]),
        ({1.0: 11.0, 4.0: 20.0, 2.0: 12.0, 10.0: 30.0}, 1.0, [1.0, 4.0, 2.0, 10.0]),
    ],
)
def test_larger_parameters_are_tried_until_states_fit(problem, misfits, taken, tried):
    told = []

    def misfit(i, state, x):
        factor = float(x[0] / START[0])
        np.testing.assert_allclose(x, factor * START)
        assert state.shape == (11, problem.step.sizes["nx"])
        told.append(factor)
        return misfits[factor]

    found = guess_unknowns_and_node_states(problem, nodes_of(problem), START, misfit)
    np.testing.assert_allclose(found.x, taken * START)
    assert list(dict.fromkeys(told)) == tried
    theta, _ = problem.unpack_episode_unknowns(found.x, 0)
    rest = problem.predictor.initial_state_and_derivative(problem.episodes[0], theta)
    np.testing.assert_allclose(found.initial_states[0].state, rest.state, atol=1e-9)


def test_what_fits_is_the_rollout_and_what_does_not_is_rest_where_the_arm_was(problem):
    nodes, episode = nodes_of(problem), problem.episodes[0]
    driven = list(problem.system.actuated_coordinate_indices)
    rolled = problem.evaluate(START).episode_predictions[0].rollout
    found = guess_unknowns_and_node_states(problem, nodes, START, lambda i, state, x: 1.0)
    np.testing.assert_allclose(found.node_states[0], rolled.state, atol=1e-9)
    np.testing.assert_allclose(found.multipliers[0], rolled.multipliers, atol=1e-9)

    def strays(i, state, x):
        return 1e3 * np.abs(state[:, driven] - episode.measured_driven_angles).max() + 20.0

    found = guess_unknowns_and_node_states(problem, nodes, START, strays)
    np.testing.assert_allclose(found.node_states[0][:, driven], episode.measured_driven_angles, atol=1e-12)
    assert np.abs(rolled.state[:, driven] - episode.measured_driven_angles).max() > 1e-4


@pytest.mark.parametrize(("interval", "initial_state"), [(1, "equilibrium"), (5, "equilibrium"), (4, "estimated")])
def test_condensed_derivatives_match_differences(make_problem, interval, initial_state):
    """Of the residual by the unknowns, node states moved along, and by closing the defects."""
    problem = make_problem(duration=0.15, initial_state=initial_state)
    intervals = _ShootingIntervals(problem, interval)
    rng = np.random.default_rng(1)
    x, nodes = intervals.initial_guess(4 * problem.initial_unknowns)
    nodes = [state + 1e-4 * rng.normal(size=state.shape) for state in nodes]
    now = intervals.linearize(x, nodes)
    assert now.defect > 1e-5
    open_defects = replace(now, node_slopes=tuple((by_x, 0.0 * by_defect) for by_x, by_defect in now.node_slopes))
    held = replace(now, node_slopes=tuple((0.0 * by_x, by_defect) for by_x, by_defect in now.node_slopes))
    direction = rng.normal(size=len(x)) * np.maximum(np.abs(x), 1e-3)

    def residual(part, step, size):
        return intervals.linearize(x + size * step, intervals.moved(nodes, part, step, size)).residual

    size = 1e-5
    along = (residual(open_defects, direction, size) - residual(open_defects, direction, -size)) / (2 * size)
    np.testing.assert_allclose(now.jacobian @ direction, along, rtol=1e-4, atol=1e-4 * np.abs(along).max())
    size, none = 1e-3, np.zeros_like(x)
    closing = (residual(held, none, size) - residual(held, none, -size)) / (2 * size)
    np.testing.assert_allclose(now.by_defect, closing, rtol=1e-4, atol=1e-4 * np.abs(closing).max())


H, N_STEPS, STD = 0.01, 150, 0.02
JOINTS = ("shoulder", "elbow")


@pytest.fixture(scope="module")
def moved(urdf_folder):
    """A double pendulum moved as measured, with an effect's values at its elbow; what its joints need is seen."""

    def make(kind, truth, free, seed=0, places=("elbow",)):
        robot = read_urdf(urdf_folder / "double_pendulum.urdf")
        plain = System.build(robot, springs={"shoulder": StiffnessAndRest(6.0, 0.1)}, prescribed=JOINTS)
        system = plain.with_effects([make_effect(kind, place, plain) for place in places])
        step = compile_step(system, H, use_compiler=False)
        t = H * np.arange(N_STEPS + 1)
        path = np.stack([0.6 * np.sin(2.1 * t), 0.9 + 0.3 * np.sin(3.3 * t + 0.4)], axis=1)
        theta = system.parameters.vector({f"{kind}@elbow.{name}": value for name, value in truth.items()})
        begin = np.concatenate([path[0], np.zeros(step.sizes["nx"] - 2)])
        effort = simulate(step, theta, begin, N_STEPS, np.zeros((N_STEPS, 0)), path).effort
        noise = np.random.default_rng(seed).normal(scale=STD, size=(N_STEPS + 1, 2))
        recorded = np.vstack([effort, effort[-1]]) + noise
        group = JointGroup(JOINTS, t, path, effort=recorded, effort_std=STD, position_std=0.0)
        options = ProblemOptions(path_cutoff=np.inf)
        names = [f"{kind}@{place}.{name}" for place in places for name in free]
        return EstimationProblem(step, [Recording(group, name="twin")], ["shoulder.stiffness", *names], options)

    return make


@pytest.mark.parametrize(("stiffness", "rest_angle"), [(8.0, -1.5), (25.0, 0.3)])
def test_a_spring_relaxed_elsewhere_is_found_from_its_neutral_value(moved, stiffness, rest_angle):
    problem = moved("joint_spring", {"stiffness": stiffness, "rest_angle": rest_angle}, ("stiffness", "rest_angle"))
    assert problem.initial_unknowns[1] == 0.0
    solution = fit_problem(problem, GaussNewton())
    assert solution.status == Status.CONVERGED
    for name, truth in (("stiffness", stiffness), ("rest_angle", rest_angle)):
        entry = solution.parameters[f"joint_spring@elbow.{name}"]
        assert entry.verdict == "identifiable", name
        assert abs(entry.value - truth) < 4 * entry.std, name


def test_an_amplitude_seen_at_its_neutral_value_begins_there_and_one_given_at_its_value(moved):
    problem = moved("joint_viscous", {"b": 0.3}, ("b",))
    fixed = moved("joint_spring", {"stiffness": 8.0, "rest_angle": 1.4}, ())
    free = moved("joint_spring", {"stiffness": 8.0, "rest_angle": 1.4}, ("stiffness", "rest_angle"))
    for begun in (problem, fixed, free.with_parameter_values({"joint_spring@elbow.stiffness": 2.0})):
        x = begun.initial_unknowns
        np.testing.assert_array_equal(unknowns_with_neutral_effects_activated(begun, x), x)


def test_effects_that_begin_neutral_share_one_evaluation(moved, monkeypatch):
    problem, points = moved("joint_viscous", {"b": 0.3}, ("b",), places=JOINTS), []
    plain = problem.evaluate
    monkeypatch.setattr(problem, "evaluate", lambda x: points.append(x) or plain(x))
    unknowns_with_neutral_effects_activated(problem, problem.initial_unknowns)
    assert len(points) == 1


@pytest.mark.parametrize(("kind", "name"), [("joint_viscous", "b"), ("joint_coulomb", "tau_c")])
def test_friction_that_is_not_there_is_zero_after_a_few_steps_and_costs_nothing(moved, kind, name):
    problem = moved(kind, {name: 0.0}, (name,))
    from_zero = fit_problem(problem, GaussNewton())
    guessed = problem.with_parameter_values({f"{kind}@elbow.{name}": 0.5})
    np.testing.assert_array_equal(guessed.positive_unknowns_mask, [True, False])
    solution = fit_problem(guessed, GaussNewton())
    entry = solution.parameters[f"{kind}@elbow.{name}"]
    assert abs(entry.value) < 3 * entry.std
    assert solution.n_evaluations <= from_zero.n_evaluations + 2
    # where it began adds no prior
    assert solution.cost == pytest.approx(from_zero.cost, rel=1e-6)


def test_an_amplitude_with_a_shape_stays_positive(moved):
    free = moved("joint_spring", {"stiffness": 8.0, "rest_angle": 1.4}, ("stiffness", "rest_angle"))
    given = free.with_parameter_values({"joint_spring@elbow.stiffness": 2.0})
    np.testing.assert_array_equal(given.positive_unknowns_mask, [True, True, False])


def test_a_start_that_cannot_be_rolled_out_is_drawn_back(moved, monkeypatch):
    problem = moved("joint_spring", {"stiffness": 8.0, "rest_angle": 1.4}, ("stiffness", "rest_angle"))
    whole, plain = unknowns_with_neutral_effects_activated(problem, problem.initial_unknowns), problem.evaluate

    def stiff(x, derivatives=True, warm=None):
        found = plain(x, derivatives, warm)
        return found if x[1] < 0.6 * whole[1] else type(found)(np.inf, found.residual, None, False, "it snaps", ())

    monkeypatch.setattr(problem, "evaluate", stiff)
    drawn = unknowns_with_neutral_effects_activated(problem, problem.initial_unknowns)
    assert drawn[1] == pytest.approx(0.5 * whole[1])

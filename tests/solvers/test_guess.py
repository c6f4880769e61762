"""Where methods with node states begin."""

from __future__ import annotations

import numpy as np
import pytest

from yid_ocp.solvers.initial_guess import guess_node_states

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

    found = guess_node_states(problem, nodes_of(problem), START, misfit)
    np.testing.assert_allclose(found.x, taken * START)
    assert list(dict.fromkeys(told)) == tried
    rest = problem.initial_state(problem.episodes[0], problem.split(found.x, 0)[0])
    np.testing.assert_allclose(found.initial_states[0].state, rest.state, atol=1e-9)


def test_what_fits_is_the_rollout_and_what_does_not_is_rest_where_the_arm_was(problem):
    nodes, episode = nodes_of(problem), problem.episodes[0]
    driven = list(problem.system.driven_coordinate_indices)
    rolled = problem.evaluate(START).episode_predictions[0].rollout
    found = guess_node_states(problem, nodes, START, lambda i, state, x: 1.0)
    np.testing.assert_allclose(found.node_states[0], rolled.state, atol=1e-9)
    np.testing.assert_allclose(found.multipliers[0], rolled.multipliers, atol=1e-9)

    def strays(i, state, x):
        return 1e3 * np.abs(state[:, driven] - episode.measured_driven_angles).max() + 20.0

    found = guess_node_states(problem, nodes, START, strays)
    np.testing.assert_allclose(found.node_states[0][:, driven], episode.measured_driven_angles, atol=1e-12)
    assert np.abs(rolled.state[:, driven] - episode.measured_driven_angles).max() > 1e-4

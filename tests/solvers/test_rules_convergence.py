"""When a search has come to its end, rule by rule: steep rows, damping, bounds, methods that stop short."""

from __future__ import annotations

import math

import numpy as np
import pytest
from made_problems import MadeUp, Steps, linear

from yid_ocp.errors import DataError, SolverError
from yid_ocp.inference.linearized_residual import is_stationary_point, predicted_cost_reduction
from yid_ocp.problem.unknown_vector import soft_logarithm_and_slope
from yid_ocp.solvers import GaussNewton, Status, solve
from yid_ocp.solvers.gradient_methods import _PATIENCE_STEPS


def with_weak_prior(target, std=0.1, start=3.0):
    """One stiffness that the data want at a value, with the weak prior of a problem."""

    def rows(x, duration):
        value, slope = soft_logarithm_and_slope(x / start)
        spread = math.log(10.0)
        residual = np.concatenate([(x - target) / std, value / spread])
        return residual, np.array([[1 / std], [slope[0] / (spread * start)]])

    return MadeUp(rows, (start,), weak=1)


def test_an_unknown_clipped_to_its_bound_at_zero_comes_back():
    problem = with_weak_prior(2.0)
    found = GaussNewton().minimize_cost(problem, np.zeros(1), None)
    assert found.status == Status.CONVERGED
    assert found.x[0] == pytest.approx(2.0, abs=1e-2)


def test_a_short_step_beside_a_steep_row_is_no_end():
    """A row of slope 1e9 allows no step but a short one; the cost falls along it all the same."""

    def rows(x, duration):
        wall = 1e9 * (x[1] - 1e-9 * (x[0] - 3.0))
        return np.array([10 * (x[0] - 1.0), wall]), np.array([[10.0, 0.0], [-1.0, 1e9]])

    problem = MadeUp(rows, (3.0, 1.0), lower=-np.inf)
    assert not is_stationary_point(problem, np.array([3.0, 0.0]), problem.evaluate([3.0, 0.0]))
    end = np.array([1.0, -2e-9])
    assert is_stationary_point(problem, end, problem.evaluate(end))
    found = GaussNewton(max_iterations=3).minimize_cost(problem, np.array([3.0, 0.0]), None)
    assert found.status != Status.CONVERGED


@pytest.mark.parametrize(
    ("x", "residual", "expected"),
    [
        ((1.0, 1.0), (0.0, 0.0), True),
        ((1.0, 1.0), (0.1, 0.0), True),
        ((1.0, 1.0), (0.2, 0.0), False),
        # pushed against its bound an unknown is at its end
        ((0.0, 1.0), (5.0, 0.0), True),
        ((0.0, 1.0), (-5.0, 0.0), False),
        ((9.0, 1.0), (-5.0, 0.0), True),
        ((9.0, 1.0), (5.0, 0.0), False),
    ],
)
def test_a_point_is_an_end_where_no_step_within_the_bounds_promises_much(x, residual, expected):
    problem = MadeUp(lambda at, duration: (np.array(residual), np.eye(2)), (1.0, 1.0), upper=9.0, count=2)
    assert is_stationary_point(problem, np.array(x), problem.evaluate(x)) is expected


@pytest.mark.parametrize(
    ("size", "slope", "residual", "expected"),
    [
        (100.0, [[0.01]], [-5.0], False),
        (1.0, [[1e-3]], [-5.0], True),
        (1e-3, [[10.0]], [-0.5], True),
        (1.0, [[10.0]], [-0.5], False),
        (1.0, [[1e-9]], [50.0], True),
        (1.0, [[1.0], [0.0]], [1.0, 100.0], True),
    ],
    ids=["large", "not worth a large one", "small", "worth a large one", "not informed", "a small part of the cost"],
)
def test_no_step_longer_than_the_unknowns_size_counts(size, slope, residual, expected):
    problem = MadeUp(linear(slope, residual), lower=-np.inf, scales=(size,))
    assert is_stationary_point(problem, np.zeros(1), problem.evaluate([0.0])) is expected


def test_without_unknowns_a_search_is_at_its_end():
    none = MadeUp(linear(np.zeros((2, 0)), [3.0, 3.0]), ())
    assert is_stationary_point(none, np.zeros(0), none.evaluate(np.zeros(0)))


def test_the_promise_of_a_step_is_the_fall_of_a_linear_models_cost():
    jacobian, residual, step = np.array([[1.0, 2.0], [0.5, -1.0]]), np.array([3.0, -1.0]), np.array([0.2, -0.4])
    after = residual + jacobian @ step
    assert predicted_cost_reduction(jacobian, residual, step) == pytest.approx(
        0.5 * (residual @ residual - after @ after)
    )


def test_a_method_that_stops_short_has_not_converged_whatever_it_says():
    problem = MadeUp(linear([[1.0], [1.0]], [-3.0, -3.0]), (1.0,))
    stopped = solve(problem, Steps([[2.0]]))
    assert stopped.status == Status.STALLED
    assert "a further step would lower the cost (run 1)" in stopped.message
    assert solve(problem, Steps([[3.0]])).status == Status.CONVERGED
    limited = solve(problem, Steps([[2.0]], status=Status.ITERATION_LIMIT))
    assert (limited.status, limited.message) == (Status.ITERATION_LIMIT, "run 1")


# -- what never ends a run --------------------------------------------------------------------------------------------


def failing_beyond(limit):
    return lambda x, duration: None if duration > limit and x[0] < 2 else (np.full(10, 0.1), np.zeros((10, 1)))


def test_a_horizon_too_short_for_a_filter_is_left_out():
    problem = MadeUp(failing_beyond(3.0), count=10)
    whole = problem.truncated_to_duration

    def shortened(duration):
        if duration < 2.0:
            raise DataError("0.6 s of efforts are too short for a filter of 8 Hz")
        return whole(duration)

    problem.truncated_to_duration = shortened
    solver = Steps([[2.0]], [[2.0]])
    solution = solve(problem, solver)
    assert [duration for _, duration in solver.runs] == [2.5, 10.0]
    assert solution.status == Status.CONVERGED


def test_another_start_that_cannot_even_begin_loses_nothing():
    class Fragile(Steps):
        def minimize_cost(self, problem, start, callback):
            if start[0] > 3.0:
                raise SolverError("no transcription from here")
            return super().minimize_cost(problem, start, callback)

    problem = MadeUp(lambda x, duration: (9.0 * (-1.0) ** np.arange(10), np.ones((10, 1))))
    solution = solve(problem, Fragile())
    assert (solution.status, solution.x.tolist()) == (Status.CONVERGED, [1.0])


def winding(steepness, pull, wound=40.0, size=0.2):
    """A pull towards 1 along a valley that winds: steps are short, and the linear model promises all of the pull."""

    def rows(x, duration):
        bend = wound * x[0]
        residual = np.array([steepness * (x[1] - np.sin(bend) / wound), pull * (x[0] - 1.0), 3.0])
        return residual, np.array([[-steepness * np.cos(bend), steepness], [pull, 0.0], [0.0, 0.0]])

    return MadeUp(rows, (size, size), lower=-np.inf)


def test_steps_that_are_worth_nothing_beside_the_noise_are_an_end():
    """The pull is worth 0.4 of a standard deviation; a hundredth of it is gained in twenty steps."""
    problem = winding(1e4, 0.4, size=1.0)
    found = solve(problem, GaussNewton(max_iterations=100), initial_unknowns=[0.0, 0.0], restarts=False)
    assert found.status == Status.CONVERGED
    assert found.n_iterations == _PATIENCE_STEPS
    assert "moved nothing by a tenth of its standard deviation" in found.message


@pytest.mark.parametrize(("steepness", "pull"), [(1e4, 2.5), (1e2, 1.5)], ids=["worth more", "quick enough"])
def test_what_is_worth_a_standard_deviation_or_is_gained_is_none(steepness, pull):
    problem = winding(steepness, pull, size=1.0)
    found = GaussNewton(max_iterations=_PATIENCE_STEPS + 5).minimize_cost(problem, np.zeros(2), None)
    assert not found.stopped_at_noise_level

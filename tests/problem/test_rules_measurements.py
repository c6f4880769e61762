"""Samples beside their prediction: weights, losses, nodes in time, lateness; rule by rule."""

import math

import numpy as np
import pytest
from small_problems import efforts, joints, measured, points, recording, seen

from yid_ocp.errors import DataError
from yid_ocp.problem.measurements import (
    TimeGrid,
    huber_loss_and_sqrt_weights,
    measurements_located_on_grid,
    measurements_with_paper_weights,
    rollout_time_grid,
)
from yid_ocp.sensors.base import SensorData

NAN = math.nan


def test_a_time_lies_between_two_nodes():
    times = [5.0, 5.05, 5.1, 5.1 + 5e-8, 5.1 - 5e-8, 5.1 + 5e-7, 5.275, 5.3, 5.4, 4.9]
    node, fraction = TimeGrid(5.0, 0.1, 3).preceding_node_and_fraction(times)
    assert node.tolist() == [0, 0, 1, 1, 1, 1, 2, 2, 2, 0]
    assert fraction == pytest.approx([0.0, 0.5, 0.0, 0.0, 0.0, 5e-6, 0.75, 1.0, 2.0, -1.0], abs=1e-9)


@pytest.mark.parametrize(
    ("last", "duration", "steps"),
    [(1.05, None, 10), (1.0 - 1e-9, None, 10), (1.0, 0.5, 5), (1.0, 0.55, 5), (1.0, 9.0, 10), (0.2, None, 2)],
)
def test_a_grid_covers_the_recording_or_as_much_as_is_wanted(last, duration, steps):
    t = 3.0 + np.array([0.0, last])
    made = recording(joints(["a"], t, np.zeros((2, 1))), seen(["p"], [0.0, 9.0], np.zeros((2, 1, 3))))
    found = rollout_time_grid(made, 0.1, duration)
    assert (found.start_time, found.time_step, found.steps) == (3.0, 0.1, steps)
    np.testing.assert_allclose(found.node_times, 3.0 + 0.1 * np.arange(steps + 1))


def test_without_joints_points_drive_the_clock_and_too_little_is_refused():
    made = recording(None, seen(["p"], [1.0, 1.4], np.zeros((2, 1, 3))))
    assert (rollout_time_grid(made, 0.1).start_time, rollout_time_grid(made, 0.1).steps) == (1.0, 4)
    with pytest.raises(DataError, match=r"0\.4 s of data are shorter than two time steps"):
        rollout_time_grid(made, 0.3)


def test_hubers_loss_is_square_first_and_then_straight():
    cost, factor = huber_loss_and_sqrt_weights(np.array([-1.0, 2.0, 3.0, -8.0, 0.0]), 2.0)
    assert cost == pytest.approx(0.5 + 2.0 + 2.0 * (3.0 - 1.0) + 2.0 * (8.0 - 1.0))
    assert factor == pytest.approx([1.0, 1.0, math.sqrt(2 / 3), 0.5, 1.0])
    for scale, cost, factor in ((math.inf, 0.5e12, 1.0), (0.0, 0.0, 0.0)):
        assert huber_loss_and_sqrt_weights(np.array([1e6]), scale) == (pytest.approx(cost), pytest.approx([factor]))


TWO = measured(efforts("a", "b"), [0, 1], [0.0, 0.0], [[1.0, NAN], [3.0, 4.0]], [[2.0, 0.0], [0.5, 10.0]])


def test_rows_are_whitened_differences_where_something_was_measured():
    predicted = np.array([[2.0, 9.0], [1.0, 5.0]])
    np.testing.assert_array_equal(TWO.whitened_residual(predicted), [[2.0, 0.0], [-1.0, 10.0]])
    found = TWO.residual_and_jacobian(predicted)
    np.testing.assert_array_equal(found.residual, [2.0, -1.0, 10.0])
    np.testing.assert_array_equal(found.robust_factor, [1.0, 1.0, 1.0])
    assert found.cost == pytest.approx(0.5 * (4 + 1 + 100))
    assert found.jacobian is None
    assert TWO.n_residuals == 3
    np.testing.assert_array_equal(TWO.positive_weight_mask, [[True, False], [True, True]])


def test_rows_have_the_slopes_of_their_predictions_and_a_robust_weight():
    slopes = np.arange(12.0).reshape(2, 2, 3)
    found = TWO.residual_and_jacobian(np.array([[2.0, 9.0], [1.0, 5.0]]), slopes, threshold=2.5)
    np.testing.assert_allclose(found.residual, [2.0, -1.0, 5.0])
    np.testing.assert_allclose(found.robust_factor, [1.0, 1.0, 0.5])
    np.testing.assert_allclose(found.jacobian, [[0, 2, 4], [3, 3.5, 4], [45, 50, 55]])
    assert found.cost == pytest.approx(2.0 + 0.5 + 2.5 * (10 - 1.25))


def test_every_output_has_its_channel():
    made = measured(points("p", "r"), [0], [0.0], np.zeros((1, 6)))
    assert made.channel_name_per_output == ("points.p",) * 3 + ("points.r",) * 3
    assert TWO.channel_name_per_output == ("joints.effort.a", "joints.effort.b")


def located(t, value, std, *span):
    data = SensorData(efforts("a"), np.array(t), np.array(value)[:, None], np.array(std)[:, None], *span)
    return measurements_located_on_grid(data, TimeGrid(5.0, 0.1, 3), "run")


def test_data_are_placed_on_nodes_and_whitened():
    found = located([5.05, 5.2], [1.0, NAN], [0.5, 7.0])
    assert (found.node.tolist(), found.fraction.tolist()) == ([0, 2], [pytest.approx(0.5), 0.0])
    np.testing.assert_array_equal(found.weight, [[2.0], [0.0]])
    np.testing.assert_array_equal(found.std, [[0.5], [NAN]])
    assert (found.predictable_nodes, found.sensor) == ((0, 3), efforts("a"))
    assert located([5.05, 5.2], [1.0, NAN], [0.5, 7.0], (1, 2)).predictable_nodes == (1, 2)


@pytest.mark.parametrize("std", [0.0, -1.0, NAN])
def test_a_noise_level_that_is_not_positive_is_refused_where_something_was_measured(std):
    with pytest.raises(DataError, match="zero or missing"):
        located([5.0, 5.1], [1.0, 2.0], [0.5, std])
    assert located([5.0, 5.1], [1.0, NAN], [0.5, std]).weight.tolist() == [[2.0], [0.0]]


def test_the_papers_cost_counts_the_end_twice_and_the_start_not_at_all():
    node, fraction = [0, 0, 0, 1, 1, 2, 3], [0.0, 0.49, 0.5, 0.49, 0.5, 0.9, 0.0]
    made = measured(points("p"), node, fraction, [[1.0, NAN, 3.0]] * 7, weight=[[1e3, 0.0, 1e3]] * 7)
    found = measurements_with_paper_weights(made, TimeGrid(0.0, 0.1, 3))
    assert (found.node.tolist(), found.fraction.tolist()) == ([0, 0, 1, 1, 2, 3, 3], [0.0] * 7)
    weight = np.array([0.0, 0.0, 1.0, 1.0, 1.0, math.sqrt(2), math.sqrt(2)])
    np.testing.assert_allclose(found.weight, np.stack([weight, 0 * weight, weight], axis=1))


def test_predictions_are_interpolated_between_the_nodes_that_are_needed():
    made = measured(efforts("a", "b"), [2, 2, 5, 9], [0.0, 0.25, 0.0, 0.5], np.zeros((4, 2)))
    assert made.evaluation_node_indices.tolist() == [2, 3, 5, 9, 10]
    at_nodes = np.array([[k, k**2] for k in made.evaluation_node_indices], float)
    np.testing.assert_allclose(made.interpolate_to_samples(at_nodes), [[2, 4], [2.25, 5.25], [5, 25], [9.5, 90.5]])
    deep = np.stack([at_nodes, 10 * at_nodes], axis=2)
    np.testing.assert_allclose(made.interpolate_to_samples(deep)[:, :, 1], 10 * made.interpolate_to_samples(at_nodes))


def test_a_sample_on_its_node_does_not_look_at_the_next_one():
    made = measured(efforts("a"), [2, 3], [0.0, 0.0], np.zeros((2, 1)))
    assert made.evaluation_node_indices.tolist() == [2, 3]
    np.testing.assert_array_equal(made.interpolate_to_samples(np.array([[1.0], [NAN]])), [[1.0], [NAN]])


LATE = {
    "on time": (5, 0.5, 0.0, 5, 0.5),
    "a little": (5, 0.5, 0.25, 5, 0.25),
    "past a node": (5, 0.5, 0.75, 4, 0.75),
    "nearly on a node": (5, 0.5, 0.5 + 1e-10, 5, 0.0),
    "early": (5, 0.0, -1.5, 6, 0.5),
    "before the span": (3, 0.0, 2.0, 2, 0.0),
    "beyond it": (8, 0.5, -9.0, 7, 1.0),
    "its end": (8, 0.0, 0.0, 7, 1.0),
}


@pytest.mark.parametrize(("node", "fraction", "steps", "late_node", "late_fraction"), LATE.values(), ids=LATE)
def test_a_late_sample_is_that_of_before_within_the_span(node, fraction, steps, late_node, late_fraction):
    made = measured(efforts("a"), [node], [fraction], [[1.0]], span=(2, 8)).shifted_earlier_by_delays(np.array([steps]))
    assert made.node.tolist() == [[late_node]]
    np.testing.assert_allclose(made.fraction, [[late_fraction]], atol=1e-12)


def test_outputs_are_late_by_different_times_and_their_nodes_have_neighbours():
    made = measured(efforts("a", "b"), [5, 6], [0.5, 0.0], np.zeros((2, 2)), span=(0, 10))
    made = made.shifted_earlier_by_delays(np.array([0.25, 2.0]))
    assert made.node.tolist() == [[5, 3], [5, 4]]
    np.testing.assert_allclose(made.fraction, [[0.25, 0.5], [0.75, 0.0]])
    assert made.evaluation_node_indices.tolist() == [2, 3, 4, 5, 6]
    for node, nodes in ((0, [0, 1]), (3, [1, 2, 3])):
        near_an_end = measured(efforts("a"), [node], [0.0], [[1.0]], span=(0, 3)).shifted_earlier_by_delays(np.zeros(1))
        assert near_an_end.evaluation_node_indices.tolist() == nodes
    at_nodes = np.array([[k, 10 * k] for k in made.evaluation_node_indices], float)
    np.testing.assert_allclose(made.interpolate_to_samples(at_nodes), [[5.25, 35.0], [5.75, 40.0]])


RATES = {
    "between": (5, 0.5, 0.25, 36.0 - 25.0),
    "on a node": (5, 0.5, 0.5, (36.0 - 16.0) / 2),
    "across": (5, 0.5, 0.75, 25.0 - 16.0),
    "beyond": (3, 0.0, 2.0, 0.0),
    "at the start": (3, 0.0, 1.0, (9.0 - 4.0) / 2),
    "after": (8, 0.0, -1.0, 0.0),
    "at the end": (8, 0.0, 0.0, (64.0 - 49.0) / 2),
    "last": (7, 0.5, 0.0, 64.0 - 49.0),
}


@pytest.mark.parametrize(("node", "fraction", "steps", "rate"), RATES.values(), ids=RATES)
def test_a_late_sample_changes_by_the_slope_on_its_node_by_the_mean_of_two(node, fraction, steps, rate):
    plain = measured(efforts("a"), [node], [fraction], [[1.0]], span=(2, 8))
    late = plain.shifted_earlier_by_delays(np.array([steps]))
    at_nodes = np.array([[float(k**2)] for k in late.evaluation_node_indices])
    np.testing.assert_allclose(late.prediction_change_per_step(at_nodes, plain, np.array([steps])), [[rate]])
    # others beside it make no difference
    several = measured(efforts("a"), [2, node, 8], [0.25, fraction, 0.0], np.ones((3, 1)), span=(2, 8))
    all_late = several.shifted_earlier_by_delays(np.array([steps]))
    at_nodes = np.array([[float(k**2)] for k in all_late.evaluation_node_indices])
    np.testing.assert_allclose(all_late.prediction_change_per_step(at_nodes, several, np.array([steps]))[1], [rate])


def test_late_samples_of_which_a_short_piece_holds_none_change_by_nothing():
    none = measured(efforts("a"), np.zeros(0, int), np.zeros(0), np.zeros((0, 1)), span=(2, 8))
    late = none.shifted_earlier_by_delays(np.array([0.5]))
    assert late.prediction_change_per_step(np.zeros((0, 1)), none, np.array([0.5])).shape == (0, 1)
    assert late.interpolate_to_samples(np.zeros((0, 1, 3))).shape == (0, 1, 3)


CLOCKS = {
    "in milliseconds": (np.linspace(0.0, 3e3, 400), 0.01),
    "slow": (np.arange(0.0, 3e3, 10.0), 0.01),
    "that jumps": (np.append(np.arange(0.0, 20.0, 0.001), 1e6), 0.1),
}


@pytest.mark.parametrize(("t", "time_step"), CLOCKS.values(), ids=CLOCKS)
def test_a_clock_in_other_units_or_that_jumps_does_not_make_an_endless_rollout(t, time_step):
    made = recording(joints(["a"], t, np.zeros((len(t), 1))))
    with pytest.raises(DataError, match="times are in seconds and do not jump"):
        rollout_time_grid(made, time_step)
    assert rollout_time_grid(made, 100 * time_step).steps > 2

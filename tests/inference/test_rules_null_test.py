"""The null test, rule by rule, against numbers worked out by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.stats
from made_series import samples, series

from yid_ocp.inference.null_test import (
    NullTestResult,
    channel_noise_levels,
    residuals_exceed_noise,
    run_null_test,
    whiten_with_extra_errors,
)

CHI2 = scipy.stats.chi2


@pytest.mark.parametrize(
    ("count", "value", "parameters", "colour", "degrees", "ratio"),
    [
        (8, 2.0, 0, (1.0,), 8.0, 4.0),
        (8, 2.0, 3, (1.0,), 5.0, 32 / 5),
        (26, 1.0, 0, (1.0, 0.5, 0.25), 16.0, 1.0),
        (26, 1.0, 2, (1.0, 0.5, 0.25), 14.0, 26 / 24),
        (26, 1.0, 0, (1.0, -0.5, 0.0, 0.25), 16.0, 1.0),
        (3, 1.0, 3, (1.0,), 1.0, 3.0),
        (3, 1.0, 7, (1.0,), 1.0, 3.0),
    ],
    ids=["white", "less parameters", "coloured", "coloured less parameters", "a lag apart", "as many", "too many"],
)
def test_the_whole_residual_against_chi_squared(count, value, parameters, colour, degrees, ratio):
    found = run_null_test([series(range(count), colour=colour)], np.full(count, value), parameters)
    assert found.degrees_of_freedom == pytest.approx(degrees)
    assert found.chi2_per_dof == pytest.approx(ratio)
    assert found.p_value == pytest.approx(CHI2.sf(ratio * degrees, degrees), rel=1e-12)


def test_several_series_add_and_rows_of_no_series_do_not_count():
    residual = np.array([1.0, 2.0, 3.0, 50.0, 4.0, 60.0])
    parts = [series([0, 1]), series([2, 4], channel="points.other", colour=(1.0, 0.5))]
    found = run_null_test(parts, residual, 1)
    assert found.degrees_of_freedom == pytest.approx(2 + 2 / 1.5 - 1)
    assert found.chi2_per_dof == pytest.approx((1 + 4 + 9 + 16) / 3)
    assert found.channel_chi2 == {"points.tip": pytest.approx(2.5), "points.other": pytest.approx(12.5)}


# -- more than noise --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tests", "said"),
    [
        ([(1.5, 0.009)], True),
        ([(1.5, 0.01)], False),
        ([(1.11, 1e-9)], True),
        ([(1.1, 1e-9)], False),
        ([(1.5, 0.004), (1.0, 0.5)], True),
        ([(1.5, 0.006), (1.0, 0.5)], False),
        ([(1.0, 0.5), (1.5, 0.006)], False),
        ([(1.0, 0.5), (1.5, 0.003), (1.0, 0.6)], True),
        ([(1.05, 1e-9), (1.2, 0.3)], True),
        ([(1.05, 1e-9), (1.0, 0.3)], False),
    ],
)
def test_more_than_noise_is_sure_among_all_tests_and_worth_a_word(tests, said):
    made = [NullTestResult(ratio, 10.0, p, {}, ()) for ratio, p in tests]
    assert residuals_exceed_noise(made) is said


# -- beside what else has moved it ------------------------------------------------------------------------------------


def test_a_residual_beside_other_errors_has_unit_covariance():
    rng = np.random.default_rng(0)
    spread = rng.standard_normal((7, 3)) * [0.1, 3.0, 1e6]
    root = np.array([whiten_with_extra_errors(unit, spread) for unit in np.eye(7)])
    np.testing.assert_allclose(root @ (np.eye(7) + spread @ spread.T) @ root.T, np.eye(7), atol=1e-4)


def test_what_no_other_error_could_have_done_is_left_as_it_is():
    spread = np.array([[2.0], [0.0], [0.0]])
    found = whiten_with_extra_errors(np.array([3.0, 5.0, -7.0]), spread)
    np.testing.assert_allclose(found, [3.0 / math.sqrt(5.0), 5.0, -7.0])


def test_a_column_that_overflowed_says_nothing():
    spread = np.array([[2.0, math.inf], [0.0, 1.0]])
    np.testing.assert_allclose(whiten_with_extra_errors(np.array([3.0, 5.0]), spread), [3.0 / math.sqrt(5.0), 5.0])
    np.testing.assert_array_equal(whiten_with_extra_errors(np.array([3.0]), np.array([[math.nan]])), [3.0])


# -- windows ----------------------------------------------------------------------------------------------------------

PER_WINDOW = 20


def with_p_values(*wanted: float) -> tuple[list, np.ndarray]:
    """A series whose windows of half a second have these p-values."""
    residual = [math.sqrt(CHI2.isf(p, PER_WINDOW) / PER_WINDOW) for p in wanted for _ in range(PER_WINDOW)]
    t = 0.5 * np.arange(len(residual)) / PER_WINDOW
    return [series(range(len(residual)), t)], np.array(residual)


@pytest.mark.parametrize(
    ("p_values", "flagged"),
    [
        ((0.008, 0.5, 0.6, 0.7), ()),
        ((0.002, 0.5, 0.6, 0.7), (0,)),
        ((0.6, 0.7, 0.5, 0.002), (3,)),
        ((0.5, 0.0049, 0.6, 0.004), (1, 3)),
        ((0.0074, 0.0049, 0.5, 0.007), (0, 1, 3)),
        ((0.0099, 0.009, 0.0095, 0.0098), (0, 1, 2, 3)),
        ((0.0049, 0.5, 0.6, 0.7), ()),
    ],
)
def test_windows_are_flagged_by_their_false_discovery_rate(p_values, flagged):
    found = run_null_test(*with_p_values(*p_values), 0, level=0.01).windows
    assert len(found) == 4
    assert tuple(i for i, entry in enumerate(found) if entry.is_flagged) == flagged


@pytest.mark.parametrize(("level", "flagged"), [(0.1, True), (0.05, False)])
def test_the_rate_is_the_level(level, flagged):
    found = run_null_test(*with_p_values(0.02, 0.5, 0.6, 0.7), 0, level=level).windows
    assert [w.is_flagged for w in found] == [flagged, False, False, False]


def test_columns_of_a_channel_share_windows_and_recordings_do_not():
    residual = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    parts = [series([0, 1]), series([2, 3]), series([4], recording="second"), series([5], channel="points.other")]
    found = run_null_test(parts, residual, 0).windows
    assert [(w.recording, w.channel) for w in found] == [
        ("run", "points.tip"),
        ("second", "points.tip"),
        ("run", "points.other"),
    ]


def test_windows_are_as_long_as_wanted_and_reach_the_last_sample():
    t = [0.0, 0.25, 0.5, 0.75, 1.0, 2.1]
    parts = [series(range(3), t[:3]), series([3, 4, 5], t[3:])]
    for length, expected in ((0.5, [(0.0, 0.5), (0.5, 1.0), (1.0, 1.5), (2.0, 2.1)]), (3.0, [(0.0, 2.1)])):
        found = run_null_test(parts, np.ones(6), 0, window=length).windows
        assert [(w.start_time, w.end_time) for w in found] == expected


# -- noise floor ------------------------------------------------------------------------------------------------------


def test_the_noise_floor_is_the_median_of_each_channel():
    nan = math.nan
    first = samples(["points.a", "points.b"], [[1.0, 9.0], [2.0, nan], [6.0, nan]])
    second = samples(["points.a", "effort"], [[3.0, nan], [4.0, nan]], unit="N m")
    problem = SimpleNamespace(episodes=[SimpleNamespace(measurements=[first]), SimpleNamespace(measurements=[second])])
    found = {entry.channel: entry for entry in channel_noise_levels(problem)}
    assert set(found) == {"points.a", "points.b"}
    assert (found["points.a"].noise_std, found["points.a"].n_samples) == (3.0, 5)
    assert (found["points.b"].noise_std, found["points.b"].n_samples, found["points.b"].unit) == (9.0, 1, "m")

"""How sure a fit is and what may be said of it, rule by rule: the null test, misfit, bounds, verdicts."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.stats
from made_problems import MadeUp, linear
from made_series import samples, series
from small_problems import PENDULUM, H, pendulum_step, taken

from yid_ocp.inference import uncertainty
from yid_ocp.inference.null_test import (
    NullTestResult,
    assumed_noise_rmse_by_channel,
    benjamini_hochberg_mask,
    channels_with_residual_indices,
    residual_chi2_null_test,
    residuals_exceed_noise,
    whiten_with_drawn_errors,
)
from yid_ocp.inference.uncertainty import (
    GoodnessOfFit,
    ParameterEstimate,
    _score_covariance,
    apply_profile_interval,
    assess_goodness_of_fit,
    mask_of_priors_determining_unknown,
    misfit_robust_covariance,
    needs_no_profile_likelihood,
    parameter_estimates,
    parameter_verdict,
    typical_parameter_magnitudes,
    unknowns_covariance_and_reduced_chi2,
)
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.problem.measurements import whiten_with_extra_errors
from yid_ocp.problem.options import ExcessResidualCriteria
from yid_ocp.sensors.signal_filters import zero_phase_effort_filter

GOOD, BAD = GoodnessOfFit(1.0, 0.5, True), GoodnessOfFit(9.0, 0.0, False)


def stiffness(value, std, said):
    return ParameterEstimate(value, std, "N m/rad", 3.0, 0.0, 100.0, True, said)


@pytest.mark.parametrize(
    ("value", "std", "said", "interval", "expected", "spread"),
    [
        (2.0, 0.1, "identifiable", (1.8, 2.2), "identifiable", 0.1),
        (2.0, 1.0, "weak", (1.0, 4.5), "weak", 1.0),
        # the wider side is more than twice what the parabola has
        (2.0, 1.0, "weak", (1.0, 6.0), "weak", 4.0 / 1.959963984540054),
        (2.0, 0.1, "identifiable", (1.9, None), "weak", math.inf),
        (2.0, 0.1, "not_trusted", (1.9, None), "not_trusted", math.inf),
        (2.0, 0.1, "identifiable", (None, None), "not_identifiable", math.inf),
        (2.0, 0.1, "not_identifiable", (1.8, 2.2), "not_identifiable", 0.1),
        # small beside others of its kind (10): known to be small, not quite, not at all
        (0.1, 0.2, "identifiable", (None, 0.5), "identifiable", 0.2),
        (0.1, 0.2, "identifiable", (0.02, 5.0), "weak", 4.9 / 1.959963984540054),
        (0.25, 0.26, "identifiable", (0.06, None), "weak", math.inf),
        # its bound is far away, and within reach
        (50.0, 1.0, "identifiable", (None, 51.0), "weak", math.inf),
        (98.0, 2.0, "weak", (95.0, None), "weak", 2.0),
        (10.0, 1.0, "identifiable", (None, 11.0), "weak", 10.0 / 1.959963984540054),
        (90.0, 2.0, "weak", (85.0, None), "weak", 10.0 / 1.959963984540054),
    ],
)
def test_no_verdict_and_no_spread_contradicts_a_profile(value, std, said, interval, expected, spread):
    found = apply_profile_interval(stiffness(value, std, said), interval, 10.0)
    assert (found.verdict, found.interval, found.value) == (expected, interval, value)
    assert found.std == pytest.approx(spread, rel=1e-12)
    too_narrow = apply_profile_interval(stiffness(2.0, 1.0, "weak"), (1.1, 2.9), 10.0)
    assert too_narrow.interval == pytest.approx((0.04, 3.96), abs=1e-3)
    at_bound = stiffness(9.0, 4.0, "not_trusted")
    assert apply_profile_interval(replace(at_bound, upper=9.0), (8.9, None), 10.0).interval == (8.9, None)


@pytest.mark.parametrize(("value", "std", "sufficient"), [(-10.0, 1.0, True), (0.1, 0.2, False)])
def test_small_values_do_not_stand_by_themselves(value, std, sufficient):
    assert needs_no_profile_likelihood(stiffness(value, std, "identifiable")) is sufficient


def judged(problem, at=None):
    x = np.zeros(len(problem.initial_unknowns)) if at is None else np.array(at)
    return unknowns_covariance_and_reduced_chi2(problem, problem.evaluate(x))


INFORMED, COLUMN = np.array([[3.0, 1.0], [0.0, 2.0], [1.0, 1.0], [2.0, -1.0]]), [[1.0], [1.0], [2.0], [9.0]]
KNOWN = np.linalg.inv(INFORMED.T @ INFORMED)
FITS = {
    "noise alone": (MadeUp(linear(INFORMED, [0.1, 0.2, 0.3, 0.4]), (5.0, 70.0)), KNOWN, 0.15),
    "a misfit": (MadeUp(linear(np.eye(2)[[0, 1, 0, 1]], [3.0, 4.0] * 2), (1.0, 1.0)), 12.5 * np.eye(2), 25.0),
    # a stated prior counts as an observation but its misfit says nothing of the noise; a weak one does not count
    "a stated and a weak prior": (MadeUp(linear(COLUMN, [1.0, 2.0, 5.0, 7.0]), stated=1, weak=1), 2.5 / 6, 2.5),
    "a weak prior": (MadeUp(linear(COLUMN, [1.0, 2.0, 5.0, 7.0]), weak=1), 15.0 / 6, 15.0),
    "in units of the noise": (
        MadeUp(linear([[1.0], [2.0], [2.0]], [0.02, 0.02, 0.5]), stated=1, noise=0.01, weighting="paper"),
        4.0 / (1e4 + 4e4 + 4),
        4.0,
    ),
    "at least one degree of freedom": (MadeUp(linear([[1.0]], [2.0])), 4.0, 4.0),
}


@pytest.mark.parametrize(("problem", "expected", "reduced"), FITS.values(), ids=FITS)
def test_the_covariance_is_the_inverse_of_the_information_times_the_misfit(problem, expected, reduced):
    covariance, chi2 = judged(problem)
    assert chi2 == pytest.approx(reduced)
    np.testing.assert_allclose(covariance, np.atleast_2d(expected), rtol=1e-9)


TALL = [([[1.0, 0], [0, 1], [0, 0]], (1.0, 1.0)), ([[1.0, 0], [1, 0], [0, 0]], (0.5, None))]
WIDE = [([[2.0, 0]], (0.25, None)), ([[0, 2.0]], (None, 0.25)), (np.zeros((0, 2)), (None, None))]


@pytest.mark.parametrize(("matrix", "known"), [*TALL, *WIDE])
def test_what_the_data_do_not_inform_gets_a_huge_variance_in_units_of_its_size(matrix, known):
    covariance, _ = judged(MadeUp(linear(matrix), (3.0, 50.0)))
    for i, (variance, size) in enumerate(zip(known, (3.0, 50.0), strict=True)):
        assert covariance[i, i] == pytest.approx(variance if variance is not None else (1e8 * size) ** 2, rel=1e-9)
    assert covariance[0, 1] == pytest.approx(0.0, abs=1e-6 * np.sqrt(covariance[0, 0] * covariance[1, 1]))


@pytest.mark.parametrize("ok", [True, False])
def test_without_a_jacobian_nothing_is_known(ok):
    problem = MadeUp(linear(np.eye(2)) if ok else lambda x, duration: None, (1.0, 1.0), count=2)
    covariance, chi2 = unknowns_covariance_and_reduced_chi2(problem, problem.evaluate(np.zeros(2), derivatives=False))
    assert covariance.shape == (2, 2)
    assert np.all(np.isnan(covariance))
    assert math.isnan(chi2)


# value, standard deviation and, near zero, the size that the parameter might have; what is surely not zero is judged by
# itself, however large the others are
VERDICTS = {
    "identifiable": [(10.0, 1.0, 0.0), (0.0, 1e-14, 0.0), (0.2, 0.39, 10.0)],
    "weak": [(10.0, 1.01, 0.0), (-10.0, 3.0, 0.0), (0.2, 0.41, 10.0), (0.0, 4.9, 10.0), (0.5, 0.2, 1000.0)],
    "not_identifiable": [(10.0, 40.1, 0.0), (10.0, math.nan, 0.0), (0.0, 1e-3, 0.0), (0.0, 5.1, 10.0)],
}


@pytest.mark.parametrize(("said", "known"), [(said, known) for said, many in VERDICTS.items() for known in many])
def test_what_may_be_said_of_a_parameter(said, known):
    value, std, scale = known
    assert parameter_verdict(value, std, scale=scale) == said


JUDGED = [(0.5, False, False, "not_trusted"), (0.5, False, True, "not_trusted"), (0.5, True, True, "at_bound")]
JUDGED += [(41.0, False, True, "not_identifiable"), (math.inf, True, True, "not_identifiable")]


@pytest.mark.parametrize(("std", "explains", "at_bound", "said"), JUDGED)
def test_misfit_comes_before_a_bound_and_after_what_nothing_informs(std, explains, at_bound, said):
    assert parameter_verdict(10.0, std, explains=explains, at_bound=at_bound) == said
    assert parameter_verdict(0.0, 0.1, scale=10.0, at_bound=True) == "at_bound"


def of_size(square, count=400, **more):
    """A problem of one unknown whose residual has this mean square at one."""
    return MadeUp(lambda x, duration: (np.full(count, math.sqrt(square)) * x[0], np.full((count, 1), 1.0)), **more)


@pytest.mark.parametrize(
    ("square", "count", "explains"),
    [(0.2, 400, True), (1.0, 400, True), (1.09, 40000, True), (1.12, 400, True), (1.2, 400, False), (9.0, 5, False)],
    ids=["too good", "noise", "sure and negligible", "chance", "more than noise", "few and far off"],
)
def test_a_fit_explains_what_is_not_surely_and_relevantly_more_than_noise(square, count, explains):
    problem = of_size(square, count)
    assert assess_goodness_of_fit(problem, problem.evaluate([1.0])).explains is explains


def test_a_fit_is_judged_in_units_of_noise_by_the_limits_of_a_diagnosis():
    plain = of_size(9.0 * 0.01**2, weighting="paper", noise=0.01)
    assert assess_goodness_of_fit(plain, plain.evaluate([1.0])).chi2_per_dof == pytest.approx(9.0, rel=0.01)
    failed = MadeUp(lambda x, duration: None, count=3)
    assert not assess_goodness_of_fit(failed, failed.evaluate([1.0])).explains
    # the prior knows as much of the unknown as the data
    halved = MadeUp(linear([[1.0]] * 9 + [[3.0]], [1.0] * 9 + [0.0]), stated=1)
    assert assess_goodness_of_fit(halved, halved.evaluate([0.0])).chi2_per_dof == pytest.approx(9 / 8.5)
    problem = of_size(1.2)
    found = problem.evaluate([1.0])
    assert assess_goodness_of_fit(problem, found, ExcessResidualCriteria(significance_level=1e-6)).explains
    assert assess_goodness_of_fit(problem, found, ExcessResidualCriteria(min_excess_chi2_per_dof=0.5)).explains
    half = assess_goodness_of_fit(problem, found, ExcessResidualCriteria(noise_fraction_of_stated_std=0.5))
    assert half.chi2_per_dof == pytest.approx(4 * assess_goodness_of_fit(problem, found).chi2_per_dof)


@pytest.mark.parametrize(("square", "counted"), [(1.0, 1.0), (2.0, 0.5)], ids=["noise", "more than noise"])
def test_a_misfit_by_noise_of_encoders_that_move_the_model_is_none(square, counted, monkeypatch):
    monkeypatch.setattr(uncertainty.null_test, "whiten_with_encoder_noise", lambda problem, x, residual: residual / 2)
    problem = of_size(square)
    fit = assess_goodness_of_fit(problem, problem.evaluate([1.0]), x=np.ones(1))
    assert (fit.explains, fit.chi2_per_dof) == (True, pytest.approx(counted, rel=0.01))


def wider_by_few(count):
    """How much wider intervals of so many independent scores are than those of very many."""
    return scipy.stats.t.ppf(0.975, count - 1) / scipy.stats.norm.ppf(0.975)


def constant(residual):
    """A constant seen by every sample."""
    return MadeUp(linear(np.ones((len(residual), 1)), residual))


def widened(problem):
    found = problem.evaluate([0.0])
    covariance, _ = unknowns_covariance_and_reduced_chi2(problem, found)
    return math.sqrt(misfit_robust_covariance(problem, found, BAD)[0, 0] / covariance[0, 0])


def test_a_misfit_that_stays_for_long_counts_as_one_and_one_that_alternates_as_many():
    t = np.linspace(0, 1, 480)
    slow, quick = 5 * np.sign(np.sin(4 * np.pi * t)), 5 * (-1.0) ** np.arange(480)
    # each of the eight blocks of 60 samples counts about as one, and eight are few
    assert widened(constant(slow)) == pytest.approx(math.sqrt(60 * 8 / 7) * wider_by_few(8), rel=0.1)
    assert widened(constant(quick)) == 1.0


def test_only_a_fit_that_does_not_explain_the_data_counts_its_misfit():
    problem = constant(5 * np.sign(np.sin(4 * np.pi * np.linspace(0, 1, 480))))
    found = problem.evaluate([0.0])
    plain, _ = unknowns_covariance_and_reduced_chi2(problem, found)
    assert misfit_robust_covariance(problem, found, GOOD) == plain
    assert misfit_robust_covariance(problem, found, BAD) > 5 * plain


def test_a_misfit_of_one_block_or_of_none_widens_nothing():
    one = MadeUp(linear(np.ones((3, 1)), [5.0, 5.0, 5.0]), duration=0.2)
    for problem in (one, MadeUp(linear(np.zeros((3, 0))), ())):
        found = problem.evaluate(np.zeros(len(problem.initial_unknowns)))
        covariance, _ = unknowns_covariance_and_reduced_chi2(problem, found)
        np.testing.assert_array_equal(misfit_robust_covariance(problem, found, BAD), covariance)


def test_a_constant_misfit_of_every_channel_of_a_recording_counts_as_one_each(urdf_folder):
    """Zeros that move from recording to recording cancel in no block of time, and show in no other channel."""
    step = pendulum_step(urdf_folder, prescribed=PENDULUM)
    options = ProblemOptions(path_cutoff=np.inf, weak_prior_geometric_std=0.0)
    recordings = [taken(step, seed, camera=False, steps=200) for seed in range(3)]
    problem = EstimationProblem(step, recordings, ("elbow.mass",), options)
    found, series = problem.evaluate(problem.initial_unknowns), channels_with_residual_indices(problem)
    offset = np.random.default_rng(2).choice([-3.0, 3.0], len(series))
    moved = np.zeros(len(found.residual))
    for own, size in zip(series, offset, strict=True):
        moved[own.residual_indices] = size
    found = replace(found, residual=moved)
    slope = found.jacobian[:, 0]
    scores = np.array([size * slope[own.residual_indices].sum() for own, size in zip(series, offset, strict=True)])
    scores -= scores.mean()
    own_part = np.array([slope[own.residual_indices] @ slope[own.residual_indices] for own in series])
    scores *= wider_by_few(len(series)) / np.sqrt(1 - own_part / (slope @ slope))
    expected = scores @ scores / (slope @ slope) ** 2
    plain, _ = unknowns_covariance_and_reduced_chi2(problem, found)
    assert len(series) >= 8
    assert expected > 3 * plain[0, 0]
    assert misfit_robust_covariance(problem, found, BAD)[0, 0] == pytest.approx(expected)


def test_scores_of_a_fit_scatter_as_the_noise_does_however_much_a_cluster_decides():
    """Summed over the directions of white noise, what a fit leaves of it gives the information itself."""
    slopes = np.random.default_rng(0).standard_normal((12, 3))
    slopes[:4] *= 5.0  # the first of four clusters decides
    information, left = slopes.T @ slopes, np.eye(12) - slopes @ np.linalg.pinv(slopes)
    clusters = [slice(0, 4), slice(4, 6), slice(6, 7), slice(7, 12)]

    def scatter(residual):
        return _score_covariance(information, np.linalg.inv(information), [(slopes[c], residual[c]) for c in clusters])

    np.testing.assert_allclose(sum(map(scatter, left)) / wider_by_few(4) ** 2, information, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_scores_are_numbers_where_unknowns_are_seen_only_together(seed):
    """Rounding makes eigenvalues of a singular information negative."""
    rng = np.random.default_rng(seed)
    slopes, residual = np.outer(rng.standard_normal(12), rng.standard_normal(4)), rng.standard_normal(12)
    information = slopes.T @ slopes
    found = _score_covariance(
        information, np.linalg.pinv(information), [(slopes[c], residual[c]) for c in (slice(0, 5), slice(5, 12))]
    )
    assert np.all(np.isfinite(found))


def test_a_prior_counts_as_stated_where_a_part_of_all_stated_deviations_is_noise():
    share, slopes = 0.1, np.array([[0.0, 2.0], [0.0, -2.0], [1 / (0.5 * 0.1), 0.0]])  # the prior of the first is 0.5
    problem = MadeUp(linear(slopes, [3.0, 4.0, 0.0]), (1.0, 1.0), stated=1)
    problem.options = replace(problem.options, stated_std_factor=share)
    found = problem.evaluate([0.0, 0.0])
    covariance, chi2 = unknowns_covariance_and_reduced_chi2(problem, found)
    assert covariance[1, 1] == pytest.approx(chi2 / 8)
    assert covariance[0, 0] == pytest.approx(0.5**2)
    assert misfit_robust_covariance(problem, found, BAD)[0, 0] == pytest.approx(0.5**2)


def saturating(top, at):
    """One sample whose prediction saturates: seen where it is small, not where it is large."""
    return lambda x, duration: ((y := top * np.tanh((x[:1] - at) / top)), (1.0 - (y / top) ** 2)[:, None])


@pytest.mark.parametrize(
    ("top", "at", "kept"), [(1e6, 0.0, True), (20.0, 0.0, True), (0.5, 0.0, False), (0.5, 30.0, False)]
)
def test_a_standard_deviation_that_the_cost_does_not_bear_out_grows(top, at, kept):
    problem = MadeUp(saturating(top, at), lower=-np.inf, scales=(1.0,), priors={"k0": 100.0})
    x = np.array([at])
    covariance, _ = unknowns_covariance_and_reduced_chi2(problem, problem.evaluate(x))
    # at 1.96 standard deviations the cost is that of a saturated prediction: 0.5^2 in place of 3.84
    said = [estimated(problem, x, covariance, fit)["k0"].std for fit in (GOOD, None)]
    assert said == [pytest.approx(1.0 if kept else 1.96 / 0.5, rel=0.01), 1.0]


@pytest.mark.parametrize("bound", [{"lower": 0.9}, {"lower": -np.inf, "upper": 1.1}])
def test_beyond_a_bound_the_cost_is_not_asked(bound):
    assert estimated(MadeUp(linear([[1.0]], [-1.0]), **bound), [1.0], np.eye(1))["k0"].std == 1.0


def estimated(problem, x, covariance, fit=GOOD):
    x = np.asarray(x, float)
    return parameter_estimates(problem, x, problem.evaluate(x), np.asarray(covariance, float), fit)


def test_every_parameter_has_its_estimate_and_fixed_ones_are_said_to_be():
    problem = MadeUp(linear(np.diag([2.5, 0.02]), [-12.5, -1.2]), (4.0, 50.0), fixed=(7.0,), upper=99.0)
    found = estimated(problem, [5.0, 60.0], np.diag([0.16, 2500.0]))
    assert list(found) == ["k2", "k1", "k0"]
    first, second, fixed = found["k0"], found["k1"], found["k2"]
    assert (first.value, first.std, first.initial, first.verdict) == (5.0, pytest.approx(0.4), 4.0, "identifiable")
    assert (second.value, second.std, second.initial, second.verdict) == (60.0, pytest.approx(50.0), 50.0, "weak")
    assert (fixed.value, fixed.std, fixed.initial, fixed.verdict) == (7.0, 0.0, 7.0, "fixed")
    assert [entry.free for entry in (first, second, fixed)] == [True, True, False]
    assert (first.unit, first.lower, first.upper, first.interval) == ("N m/rad", 0.0, 99.0, None)


def test_of_what_nothing_informs_no_standard_deviation_is_said_and_rounding_below_zero_is_no_variance():
    problem = MadeUp(linear([[0.02]], [-0.02]), (1.0,))
    lost = estimated(problem, [1.0], [[2500.0]])["k0"]
    assert (lost.verdict, lost.std, lost.interval) == ("not_identifiable", math.inf, None)
    without = estimated(problem, [1.0], [[math.nan]])["k0"]
    assert (without.verdict, without.std) == ("not_identifiable", math.inf)
    assert estimated(MadeUp(linear([[1.0]]), (1.0,)), [1.0], [[-1e-20]])["k0"].std == 0.0
    none = MadeUp(linear(np.zeros((1, 0))), (), fixed=(3.0,))
    assert estimated(none, np.zeros(0), np.zeros((0, 0)))["k0"].verdict == "fixed"


def test_misfit_takes_the_trust_from_informed_parameters_and_no_fit_says_nothing_of_bounds():
    problem = MadeUp(linear(np.diag([2.5, 1e-9]), [-12.5, 0.0]), (4.0, 50.0))
    found = estimated(problem, [5.0, 50.0], np.diag([0.16, 1e18]), BAD)
    assert {name: entry.verdict for name, entry in found.items()} == {"k0": "not_trusted", "k1": "not_identifiable"}
    assert found["k0"].std == pytest.approx(0.4)
    problem = MadeUp(linear([[2.0]]), (3.0,), upper=3.0)
    assert estimated(problem, [3.0], [[0.01]], None)["k0"].verdict == "identifiable"


def test_a_parameter_at_its_bound_has_an_interval_on_one_side():
    # the data ask for -1 with a standard deviation of 0.5; the bound is at zero, the other parameter tells the size
    rows = np.vstack([np.diag([2.0, 50.0]), np.zeros((40, 2))])
    problem = MadeUp(linear(rows, [2.0, -500.0, *np.zeros(40)]), (3.0, 10.0))
    at = estimated(problem, [0.0, 10.0], np.diag([0.25, 4e-4]))["k0"]
    assert at.verdict == "at_bound"
    pull = 2.0 * 2.0
    assert at.interval[0] == 0.0
    assert pull * at.interval[1] + at.interval[1] ** 2 / (2 * 0.25) == pytest.approx(2.706 / 2, rel=1e-3)


@pytest.mark.parametrize(("value", "at_bound"), [(0.0, True), (1e-5, True), (1e-3, False), (10.0 - 1e-5, True)])
def test_a_value_near_its_bound_lies_at_it(value, at_bound):
    problem = MadeUp(linear([[20.0]], [-20.0 * value]), (5.0,), upper=10.0, scales=(1.0,), priors={"k0": 10.0})
    assert (estimated(problem, [value], [[0.0025]])["k0"].verdict == "at_bound") is at_bound


def test_the_size_that_a_parameter_might_have():
    for how, size in (({}, 3.0), ({"upper": 8.0}, 3.0), ({"upper": 8.0, "priors": {"k0": 0.5}}, 0.5)):
        assert typical_parameter_magnitudes(MadeUp(linear(np.eye(1)), (3.0,), **how), np.ones(1))["k0"] == size
    three = MadeUp(linear(np.eye(2)), (3.0, 5.0), fixed=(9.0,))
    assert typical_parameter_magnitudes(three, np.array([1.0, 5.0]))["k0"] == 7.0
    assert typical_parameter_magnitudes(three, np.array([1.0, 0.0]))["k0"] == 9.0


@pytest.mark.parametrize(("scale", "expected"), [(1e-7, "not_identifiable"), (1.0, "identifiable")])
def test_a_standard_deviation_of_a_million_times_value_and_size_is_none(scale, expected):
    problem = MadeUp(linear([[1.0]]), (0.0,), lower=-np.inf, priors={"k0": 100.0}, scales=(scale,))
    assert estimated(problem, [0.0], [[0.5**2]])["k0"].verdict == expected


@pytest.mark.parametrize(("count", "asked"), [(12, range(12)), (13, range(1, 13))])
def test_of_many_parameters_those_that_are_positive_are_asked_first(count, asked):
    problem = MadeUp(linear(np.eye(count)), [0.0] + [1.0] * (count - 1), scales=np.ones(count))
    estimated(problem, np.ones(count), 0.01**2 * np.eye(count))
    moved = {int(i) for x, *_ in problem.asked for i in np.flatnonzero(x != 1.0)}
    assert (moved, len(problem.asked)) == ({*asked}, 25)


def test_numbers_of_a_result():
    known = stiffness(2.0, 0.5, "weak")
    for interval, ends in {None: (1.02, 2.98), (1.0, None): (1.0, math.inf), (None, 3.0): (-math.inf, 3.0)}.items():
        assert replace(known, interval=interval).confidence_interval_ends == pytest.approx(ends)
    matrix = np.array([[4.0, 1.0, 9.0, 1.0], [1.0, 1.0, 9.0, 1.0], [9.0, 9.0, -1.0, 1.0], [1.0, 1.0, 1.0, 1.0]])
    found = uncertainty.covariance_to_dict(("a", "b", "c", "d"), matrix, (1.0, 3.0, 5.0, math.inf))
    assert (found["names"], np.ravel(found["matrix"])) == (["a", "b"], pytest.approx([1.0, 1.5, 1.5, 9.0]))
    lost, fixed = replace(known, verdict="not_identifiable"), replace(known, free=False, verdict="fixed")
    marked = uncertainty.mark_free_estimates_not_trusted({"a": known, "b": lost, "c": fixed})
    assert marked == {"a": replace(known, verdict="not_trusted"), "b": lost, "c": fixed}
    parts = {0.1234: "12", 0.994: "99", 0.996: "100", 12.34: "1234", 123.4: "1.2e+04"}
    assert [uncertainty.percent_number_text(part) for part in parts] == list(parts.values())
    assert [uncertainty.finite_or_none(x) for x in (2.0, math.inf, math.nan)] == [2.0, None, None]
    problem = MadeUp(linear(COLUMN, [1.0, 2.0, 5.0, 7.0]), stated=1, weak=1, noise=0.1, weighting="paper")
    cost = uncertainty.cost_with_stated_priors(problem, problem.evaluate([0.0]))
    assert cost == pytest.approx(0.5 * (1 + 4) / 0.1**2 + 0.5 * 25)


TOLD = [(0.1234, None, "22.12 ± 0.12"), (0.1234, (20.0, None), "22.12 (above 20)"), (0.0, None, "22.12 ± 0")]
TOLD += [(0.1234, (None, 1.23456), "22.12 (below 1.235)"), (None, (20.0, 24.0), "22.12 (20 to 24)")]


@pytest.mark.parametrize(
    ("std", "interval", "expected"), [*TOLD, (0.1234, (None, None), "22.12 ± 0.12"), (None, (None, None), "22.12")]
)
def test_a_value_is_told_with_what_is_known_of_it(std, interval, expected):
    assert uncertainty.value_and_uncertainty_text(22.1234, std, interval) == expected
    assert uncertainty.interval_text(None, None) == "open"


@pytest.mark.parametrize(
    ("chi2", "explains", "words"),
    [
        (None, True, "not known"),
        (math.nan, False, "not known"),
        (1.0449, True, "explains the recordings to within their noise (chi2 per degree of freedom is 1.04; noise al"),
        (2.75, True, "larger than noise usually leaves them"),
        (9.0, False, "does not explain the recordings (chi2 per degree of freedom is 9; noise alone gives 1)"),
        (1e4, False, "check units, signs, names and noise and run"),
    ],
)
def test_a_fit_is_told_with_its_misfit(chi2, explains, words):
    assert words in uncertainty.goodness_of_fit_message({"chi2_per_dof": chi2, "explains": explains})


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
    found = residual_chi2_null_test([series(range(count), colour=colour)], np.full(count, value), parameters)
    assert found.degrees_of_freedom == pytest.approx(degrees)
    assert found.chi2_per_dof == pytest.approx(ratio)
    assert found.p_value == pytest.approx(CHI2.sf(ratio * degrees, degrees), rel=1e-12)


def test_smoothed_efforts_repeat_each_other_as_filtered_white_noise_does(urdf_folder):
    step = pendulum_step(urdf_folder, prescribed=PENDULUM)
    problem = EstimationProblem(step, [taken(step, 1, steps=90)], ("elbow.mass",), ProblemOptions(path_cutoff=15.0))
    low_pass, own = zero_phase_effort_filter(15.0), channels_with_residual_indices(problem)
    found = next(entry.noise_autocorrelation for entry in own if "effort" in entry.group)
    noise = low_pass(H * np.arange(200_000), np.random.default_rng(0).standard_normal((200_000, 1)))[:, 0]
    lags = low_pass.decorrelation_stride_for_step(H) * np.arange(1, 4)
    assert found[0] == 1.0
    assert found[1:4] == pytest.approx([noise[:-lag] @ noise[lag:] / (noise @ noise) for lag in lags], abs=0.02)
    assert np.abs(found[5:]).max() < 0.02 < abs(found[1])


def test_several_series_add_and_rows_of_no_series_do_not_count():
    residual = np.array([1.0, 2.0, 3.0, 50.0, 4.0, 60.0])
    parts = [series([0, 1]), series([2, 4], channel="points.other", colour=(1.0, 0.5))]
    found = residual_chi2_null_test(parts, residual, 1)
    assert found.degrees_of_freedom == pytest.approx(2 + 2 / 1.5 - 1)
    assert found.chi2_per_dof == pytest.approx((1 + 4 + 9 + 16) / 3)


# chi2 per degree of freedom and p-value of several tests of one model
MORE = [[(1.5, 0.009)], [(1.11, 1e-9)], [(1.5, 0.004), (1, 0.5)], [(1, 0.5), (1.5, 0.003), (1, 0.6)]]
NOISE = [[(1.5, 0.01)], [(1.1, 1e-9)], [(1.5, 0.006), (1, 0.5)], [(1, 0.5), (1.5, 0.006)], [(1.05, 1e-9), (1, 0.3)]]
CASES = [(tests, True) for tests in (*MORE, [(1.05, 1e-9), (1.2, 0.3)])] + [(tests, False) for tests in NOISE]


@pytest.mark.parametrize(("tests", "said"), CASES)
def test_more_than_noise_is_sure_among_all_tests_and_worth_a_word(tests, said):
    assert residuals_exceed_noise([NullTestResult(ratio, 10.0, p, ()) for ratio, p in tests]) is said


def test_what_other_errors_did_is_whitened_and_the_rest_left_as_it_is():
    spread = np.random.default_rng(0).standard_normal((7, 3)) * [0.1, 3.0, 1e6]
    root = np.array([whiten_with_extra_errors(unit, spread) for unit in np.eye(7)])
    np.testing.assert_allclose(root @ (np.eye(7) + spread @ spread.T) @ root.T, np.eye(7), atol=1e-4)
    spread = np.array([[2.0], [0.0], [0.0]])
    found = whiten_with_extra_errors(np.array([3.0, 5.0, -7.0]), spread)
    np.testing.assert_allclose(found, [3.0 / math.sqrt(5.0), 5.0, -7.0])
    spread = np.array([[2.0, math.inf], [0.0, 1.0]])
    np.testing.assert_allclose(whiten_with_extra_errors(np.array([3.0, 5.0]), spread), [3.0 / math.sqrt(5.0), 5.0])
    np.testing.assert_array_equal(whiten_with_extra_errors(np.array([3.0]), np.array([[math.nan]])), [3.0])


def test_what_few_draws_of_an_error_leave_counts_as_noise():
    rng = np.random.default_rng(3)  # 32 draws show a third of 100 directions
    ways, none = np.linalg.qr(rng.standard_normal((2000, 100)))[0] * 3.0, np.full((2000, 1), np.inf)
    drawn = ways @ rng.standard_normal((100, 32)) / np.sqrt(32)
    seen = rng.standard_normal(2000) + ways @ rng.standard_normal(100)
    assert np.mean(whiten_with_extra_errors(seen, drawn) ** 2) > 1.15
    assert np.mean(whiten_with_drawn_errors(seen, none, drawn) ** 2) == pytest.approx(1.0, abs=0.06)
    assert whiten_with_drawn_errors(seen, none, none) == pytest.approx(seen)


PER_WINDOW = 20


def with_p_values(*wanted: float) -> tuple[list, np.ndarray]:
    """A series whose windows of half a second have these p-values."""
    residual = [math.sqrt(CHI2.isf(p, PER_WINDOW) / PER_WINDOW) for p in wanted for _ in range(PER_WINDOW)]
    t = 0.5 * np.arange(len(residual)) / PER_WINDOW
    return [series(range(len(residual)), t)], np.array(residual)


few = [((0.008, 0.5, 0.6, 0.7), ()), ((0.0049, 0.5, 0.6, 0.7), ()), ((0.002, 0.5, 0.6, 0.7), (0,))]
SOME = [((0.6, 0.7, 0.5, 0.002), (3,)), ((0.5, 0.0049, 0.6, 0.004), (1, 3)), ((0.0074, 0.0049, 0.5, 0.007), (0, 1, 3))]


ALL = (0.0099, 0.009, 0.0095, 0.0098), (0, 1, 2, 3)
RATES = [(0.1, (0.02, 0.5, 0.6, 0.7), (0,)), (0.05, (0.02, 0.5, 0.6, 0.7), ())]


@pytest.mark.parametrize(("level", "p_values", "flagged"), [*((0.01, *case) for case in (*few, *SOME, ALL)), *RATES])
def test_windows_are_flagged_by_their_false_discovery_rate(level, p_values, flagged):
    found = residual_chi2_null_test(*with_p_values(*p_values), 0, level=level).flagged_windows
    assert found == tuple((0.5 * i, min(0.5 * (i + 1), 1.975)) for i in flagged)


@pytest.mark.parametrize(("p_value", "tries", "expected"), [(0.04, 1.0, True), (0.06, 1.0, False), (0.04, 2.0, False)])
def test_one_test_is_judged_by_the_level_and_the_number_of_tries(p_value, tries, expected):
    assert benjamini_hochberg_mask([p_value], tries, 0.05) == [expected]


def test_columns_of_a_channel_share_windows_and_recordings_do_not():
    residual = np.array([10.0, 20.0, 30.0, 40.0, 50.0, 60.0])
    parts = [series([0, 1]), series([2, 3]), series([4], recording="second"), series([5], channel="points.other")]
    assert len(residual_chi2_null_test(parts, residual, 0).flagged_windows) == 3


def test_windows_are_as_long_as_wanted_and_reach_the_last_sample():
    t = [0.0, 0.25, 0.5, 0.75, 1.0, 2.1]
    parts = [series(range(3), t[:3]), series([3, 4, 5], t[3:])]
    for length, expected in ((0.5, [(0.0, 0.5), (0.5, 1.0), (1.0, 1.5), (2.0, 2.1)]), (3.0, [(0.0, 2.1)])):
        found = residual_chi2_null_test(parts, np.full(6, 9.0), 0, window=length).flagged_windows
        assert [*found] == expected


def test_the_noise_floor_is_the_median_of_each_channel():
    nan = math.nan
    first = samples(["points.a", "points.b"], [[1.0, 9.0], [2.0, nan], [6.0, nan]])
    second = samples(["points.a", "effort"], [[3.0, nan], [4.0, nan]], unit="N m")
    seen = samples(["camera.w"], [[2.0, 2.0, 2.0]], width=3)
    episodes = [SimpleNamespace(measurements=own) for own in ([first, seen], [second])]
    problem = SimpleNamespace(episodes=episodes[:1], held_out=episodes[1:])
    distance = {"camera.w": math.sqrt(3) * 2.0}
    assert assumed_noise_rmse_by_channel(problem) == {"points.a": 3.0, "points.b": 9.0} | distance


@pytest.mark.parametrize(("own_part", "named"), [(0.0, [1, 2]), (1.0, [])])
def test_a_mass_that_scales_with_a_motor_is_known_by_the_motors_priors(own_part, named):
    """Unknowns: mass, gain, back-EMF, zero angle, viscous friction, which takes the place of the back-EMF."""
    gain, speed, zero, own = 50 * np.random.default_rng(0).standard_normal((4, 200))
    data = np.stack([-(gain + speed) + own_part * own, gain, speed, zero, speed], axis=1)
    priors = np.zeros((3, 5))
    priors[[0, 1, 2], [1, 2, 3]] = 4.0, 4.0, 1.0

    def determined_by(count, column, known=priors):
        mask = mask_of_priors_determining_unknown(data[:, :count], known[:, :count], column)
        return np.flatnonzero(mask).tolist()

    assert determined_by(4, 0) == named
    assert determined_by(5, 0) == named[:1]
    assert determined_by(4, 3) == determined_by(4, 0, priors[:0]) == []
    # in whatever unit
    data *= (units := np.array([1.0, 1.0, 1e-12, 1.0, 1.0]))
    assert determined_by(4, 0, priors * units) == named

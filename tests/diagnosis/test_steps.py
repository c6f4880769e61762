"""The steps of a diagnosis, each on its own."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.stats

from yid_ocp.diagnosis import (
    candidate_detectability,
    confusability_matrix,
    gap_closure,
    linearize_candidates,
    refit_with_effects,
    score_candidates,
    score_jointly,
)
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem, make_candidate_effects
from yid_ocp.diagnosis.refit import HeldOutLoss
from yid_ocp.diagnosis.screening import CandidateLinearization, EffectSignature, _newey_west_covariance, _shape_grid
from yid_ocp.diagnosis.select import (
    _is_amplitude_outside_prior,
    _is_shape_outside_prior,
    _near_best_models,
    held_out_improvement,
)
from yid_ocp.effects import make_effect
from yid_ocp.inference.null_test import (
    ResidualChannel,
    _filtered_noise_autocorrelation,
    residual_channels,
    run_null_test,
)
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.signal_filters import LowPassFilter


def white(rows, colour=None):
    t = 0.01 * np.arange(len(rows))
    return ResidualChannel("run", "points.tip", "points", "m", t, rows, np.ones(1) if colour is None else colour)


@pytest.fixture(scope="module")
def screened(bench):
    recordings = [bench.recording({"joint_coulomb@elbow": {"tau_c": 0.1}}, seed, duration=2.0) for seed in (1, 2)]
    problem = bench.problem(recordings[:1])
    choice = ("effort_offset", "joint_coulomb", "joint_stribeck@elbow", "rotor_inertia@elbow", "link_mass@elbow")
    effects = make_candidate_effects(bench.system, recordings, choice)
    composed = AllCandidatesProblem.from_problem(problem, effects, recordings[1:])
    nominal = refit_with_effects(composed, (), {})
    return composed, nominal, linearize_candidates(composed, (), nominal.values)


def test_all_candidates_together_are_the_nominal_model_until_they_are_freed(bench, screened):
    composed, _, _ = screened
    recordings = [episode.recording for episode in composed.problem.episodes]
    x = composed.problem.initial_unknowns * 1.1
    plain = bench.problem(recordings).evaluate(x)
    together = composed.with_free_effects(()).evaluate(x)
    assert together.residual == pytest.approx(plain.residual, rel=1e-9, abs=1e-9)
    assert together.jacobian == pytest.approx(plain.jacobian, rel=1e-8, abs=1e-8)


def test_part_of_the_parameters_is_freed_by_columns_of_the_whole(screened):
    composed, nominal, _ = screened
    chosen = [effect for effect in composed.candidate_effects if effect.kind in ("joint_stribeck", "link_mass")]
    some = composed.with_free_effects(chosen)
    alone = EstimationProblem(composed.problem.step, [e.recording for e in some.episodes], some.free, some.options)
    x = some.vector(nominal.values) + 0.01
    assert some.unknown_names == alone.unknown_names
    assert some.evaluate(x).jacobian == pytest.approx(alone.evaluate(x).jacobian, rel=1e-9, abs=1e-9)
    assert composed.problem.free == composed.nominal_parameters == ("shoulder.damping", "elbow.damping")


def test_p_values_of_matching_noise_are_uniform():
    rng = np.random.default_rng(5)
    rows = np.arange(400)
    p = [run_null_test([white(rows)], rng.standard_normal(400), 0).p_value for _ in range(300)]
    assert scipy.stats.kstest(p, "uniform").pvalue > 0.01


def test_p_values_of_coloured_noise_are_uniform_when_its_colour_is_known():
    rng = np.random.default_rng(6)
    colour = _filtered_noise_autocorrelation(LowPassFilter(5.0), 0.01)
    lags = np.abs(np.subtract.outer(np.arange(400), np.arange(400)))
    covariance = np.where(lags < len(colour), colour[np.minimum(lags, len(colour) - 1)], 0.0)
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0))
    rows = np.arange(400)
    p = np.array([run_null_test([white(rows, colour)], root @ rng.standard_normal(400), 0).p_value for _ in range(300)])
    assert scipy.stats.kstest(p, "uniform").pvalue > 1e-3
    blind = np.array([run_null_test([white(rows)], root @ rng.standard_normal(400), 0).p_value for _ in range(300)])
    assert np.mean(blind < 0.01) > np.mean(p < 0.01), "taking coloured noise for white raises false alarms"


def test_a_burst_is_flagged_where_it_is():
    rng = np.random.default_rng(7)
    r = rng.standard_normal(1000)
    r[310:340] += 4
    test = run_null_test([white(np.arange(1000))], r, 0)
    assert [(w.start_time, w.end_time) for w in test.windows if w.is_flagged] == [(3.0, 3.5)]
    assert test.whiteness_p_values["points.tip"] < 1e-3


def test_screening_finds_the_withheld_effect_first(screened):
    _, nominal, point = screened
    series = residual_channels(nominal.problem)
    ranked = score_candidates(point, series, candidate_detectability(point))
    assert ranked[0].effect.label == "joint_coulomb@elbow"
    assert ranked[0].predicted_values["joint_coulomb@elbow.tau_c"] == pytest.approx(0.1, rel=0.1)
    assert ranked[0].p_value < 1e-6
    assert all(a.predicted_chi2_decrease >= b.predicted_chi2_decrease for a, b in itertools.pairwise(ranked))


def test_the_promised_decrease_is_that_of_a_refit_where_the_model_is_linear(screened):
    composed, nominal, point = screened
    series = residual_channels(nominal.problem)
    ranked = {s.effect.label: s for s in score_candidates(point, series, candidate_detectability(point))}
    for label in ("joint_coulomb@elbow", "rotor_inertia@elbow", "effort_offset@shoulder"):
        if label not in ranked:
            continue
        effect = next(e for e in composed.candidate_effects if e.label == label)
        fit = refit_with_effects(composed, (effect,), nominal.values)
        assert 2 * (nominal.cost - fit.cost) == pytest.approx(ranked[label].predicted_chi2_decrease, rel=1e-3, abs=1e-3)


def test_what_the_fit_has_explained_is_projected_off(screened):
    _, nominal, point = screened
    jacobian = nominal.evaluation.jacobian[: len(point.projected_residual)]
    size = np.linalg.norm(jacobian, axis=0)
    assert np.abs(jacobian.T @ point.projected_residual / size).max() < 1e-8 * np.linalg.norm(point.projected_residual)
    for signature in point.signatures:
        leak = np.abs(jacobian.T @ signature.projected_sensitivity / size[:, None]).max()
        assert leak < 1e-8 * max(np.abs(signature.projected_sensitivity).max(), 1e-300) * len(jacobian)


def test_a_candidate_explains_itself_and_nothing_explains_more(screened):
    _, _, point = screened
    table = confusability_matrix(score_jointly(point))
    assert np.diag(table.overlap_fractions) == pytest.approx(1.0)
    assert np.all((table.overlap_fractions >= 0) & (table.overlap_fractions <= 1))
    assert "joint_stribeck@elbow" in table.labels


def test_detectable_amplitudes_do_not_depend_on_the_residual_and_fall_with_the_noise(screened):
    _, nominal, point = screened
    table = {v.effect.label: v for v in candidate_detectability(point)}
    silent = {
        v.effect.label: v
        for v in candidate_detectability(type(point)(0 * point.projected_residual, point.signatures, {}))
    }
    assert all(table[label].detectable_amplitudes == silent[label].detectable_amplitudes for label in table)
    coulomb = table["joint_coulomb@elbow"].detectable_amplitudes["joint_coulomb@elbow.tau_c"]
    assert 0 < coulomb < 0.1
    del nominal


def test_robust_covariance_of_white_scores_is_the_plain_one():
    rng = np.random.default_rng(8)
    x = rng.standard_normal((4000, 2))
    total = np.mean(
        [_newey_west_covariance(x, rng.standard_normal(4000), [white(np.arange(4000))]) for _ in range(40)], axis=0
    )
    assert total == pytest.approx(x.T @ x, rel=0.1, abs=300)


def test_shapes_are_tried_over_their_range(bench):
    effect = make_effect("joint_stribeck", "elbow", bench.system)
    grid = _shape_grid(effect, 4)
    values = [entry["joint_stribeck@elbow.v_stribeck"] for entry in grid]
    assert (values[0], values[-1]) == pytest.approx(effect.prior_ranges["joint_stribeck@elbow.v_stribeck"])
    assert _shape_grid(make_effect("joint_coulomb", "elbow", bench.system)) == [{}]


@pytest.mark.parametrize(("lean", "chosen"), [(0.0, 0), (1e-10, 0), (0.01, 1)])
def test_of_shape_values_that_make_no_difference_the_first_counts(bench, lean, chosen):
    effect = make_effect("joint_stribeck", "elbow", bench.system)
    rng = np.random.default_rng(4)
    column = rng.standard_normal((200, 1))
    residual = rng.standard_normal((200, 1)) - 0.3 * column
    # the more it leans towards the residual, the more of it the second one explains
    columns = (column, column - lean * residual)
    grid = [{"joint_stribeck@elbow.v_stribeck": value} for value in (0.02, 0.05)]
    signatures = tuple(EffectSignature(effect, values, x, x.T @ x) for values, x in zip(grid, columns, strict=True))
    point = CandidateLinearization(residual[:, 0], signatures, {})
    best = score_candidates(point, [white(np.arange(200))], candidate_detectability(point))[0]
    assert best.predicted_values["joint_stribeck@elbow.v_stribeck"] == grid[chosen]["joint_stribeck@elbow.v_stribeck"]


def loss(squares, counts):
    return HeldOutLoss(np.asarray(squares, float), np.asarray(counts, float), {})


def test_closure_is_the_part_of_the_gap_that_is_gone():
    rng = np.random.default_rng(9)
    counts = np.full(40, 50.0)
    noise = 50 * (1 + 0.1 * rng.standard_normal(40))
    before, after = loss(noise + 100, counts), loss(noise + 25, counts)
    found = gap_closure(before, after)
    assert found.fraction == pytest.approx(1 - after.excess_chi2 / before.excess_chi2)
    assert found.ci_low < found.fraction < found.ci_high
    assert found.ci_low > 0.6
    assert found.ci_high < 0.9
    assert gap_closure(before, before).fraction == 0
    assert np.isnan(gap_closure(loss(0.9 * counts, counts), after).fraction)


def test_a_rollout_that_failed_never_wins():
    counts = np.full(10, 50.0)
    good, failed = loss(counts, counts), loss(np.full(10, np.inf), counts)
    assert held_out_improvement(failed, good)[0] == np.inf
    assert held_out_improvement(good, failed)[0] == -np.inf


def test_the_simplest_within_one_standard_error_wins(screened):
    composed, nominal, _ = screened
    effects = {e.label: e for e in composed.candidate_effects}
    one = refit_with_effects(composed, (effects["joint_coulomb@elbow"],), nominal.values)
    two = refit_with_effects(
        composed, (effects["joint_coulomb@elbow"], effects["effort_offset@shoulder"]), nominal.values
    )
    assert _near_best_models([two, one])[0] is one
    assert nominal not in _near_best_models([nominal, one])


def test_values_far_from_what_one_would_expect_are_noticed(bench):
    stribeck = make_effect("joint_stribeck", "elbow", bench.system)
    low, high = stribeck.prior_ranges["joint_stribeck@elbow.v_stribeck"]

    def values(size, speed):
        return {"joint_stribeck@elbow.tau_s": size, "joint_stribeck@elbow.v_stribeck": speed}

    middle = (low * high) ** 0.5
    assert not _is_amplitude_outside_prior(stribeck, values(3.9, middle))
    assert _is_amplitude_outside_prior(stribeck, values(4.1, middle))
    assert not _is_shape_outside_prior(stribeck, values(4.1, 1.9 * high))
    assert _is_shape_outside_prior(stribeck, values(1.0, low / 3))

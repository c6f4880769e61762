"""The steps of a diagnosis, each on its own."""

import itertools
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from factories import point as made_point
from factories import screened as screened_at
from factories import signature as made_signature
from made_series import series

from yid_ocp.diagnosis import diagnose
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem, make_candidate_effects
from yid_ocp.diagnosis.pulse_detection import CompiledInverseDynamics
from yid_ocp.diagnosis.refit import RefitContext, refit_with_effects
from yid_ocp.diagnosis.screening import changes_by_candidates_at_location, linearize_candidates, screen_candidates
from yid_ocp.effects import make_effect
from yid_ocp.problem import EstimationProblem


@pytest.fixture(scope="module")
def screened(bench):
    recordings = [bench.recording({"joint_coulomb@elbow": {"tau_c": 0.1}}, seed, duration=2.0) for seed in (1, 2)]
    problem = bench.problem(recordings[:1])
    choice = ("effort_offset", "joint_coulomb", "joint_stribeck@elbow", "rotor_inertia@elbow", "link_mass@elbow")
    effects = make_candidate_effects(bench.system, recordings, choice)
    composed = AllCandidatesProblem.from_problem(problem, effects, recordings[1:])
    nominal = refit_with_effects(RefitContext(composed), (), {})
    return composed, nominal, linearize_candidates(composed, (), nominal.values)


def test_all_candidates_together_are_the_nominal_model_until_they_are_freed(bench, screened):
    composed, _, _ = screened
    recordings = [episode.recording for episode in composed.problem.episodes]
    x = composed.problem.initial_unknowns * 1.1
    plain = bench.problem(recordings).evaluate(x)
    together = composed.problem_with_nominal_and_effects_free(()).evaluate(x)
    assert together.residual == pytest.approx(plain.residual, rel=1e-9, abs=1e-9)
    assert together.jacobian == pytest.approx(plain.jacobian, rel=1e-8, abs=1e-8)


def test_part_of_the_parameters_is_freed_by_columns_of_the_whole(screened):
    composed, nominal, _ = screened
    chosen = [effect for effect in composed.candidate_effects if effect.kind in ("rotor_inertia", "link_mass")]
    some = composed.problem_with_nominal_and_effects_free(chosen)
    alone = EstimationProblem(composed.problem.step, [e.recording for e in some.episodes], some.free, some.options)
    x = some.pack_unknowns(nominal.values) + 0.01
    assert some.unknown_names == alone.unknown_names
    assert some.evaluate(x).jacobian == pytest.approx(alone.evaluate(x).jacobian, rel=1e-9, abs=1e-9)
    assert composed.problem.free == ("shoulder.damping", "elbow.damping")


def test_screening_finds_the_withheld_effect_first_and_promises_what_a_refit_does_to_a_linear_model(screened):
    composed, nominal, _ = screened
    ranked = screen_candidates(composed, (), nominal.values).candidate_scores
    assert ranked[0].effect.label == "joint_coulomb@elbow"
    assert ranked[0].predicted_values["joint_coulomb@elbow.tau_c"] == pytest.approx(0.1, rel=0.1)
    assert ranked[0].p_value < 1e-6
    assert all(a.predicted_chi2_decrease >= b.predicted_chi2_decrease for a, b in itertools.pairwise(ranked))
    by_label = {s.effect.label: s for s in ranked}
    for label in ("joint_coulomb@elbow", "rotor_inertia@elbow", "effort_offset@shoulder"):
        effect = next(e for e in composed.candidate_effects if e.label == label)
        fit = refit_with_effects(RefitContext(composed), (effect,), nominal.values)
        assert 2 * (nominal.cost - fit.cost) == pytest.approx(
            by_label[label].predicted_chi2_decrease, rel=1e-3, abs=1e-3
        )


def test_an_effect_changes_as_forecast_if_the_best_candidate_at_its_location_is_added(screened):
    composed, nominal, _ = screened
    known = {effect.label: effect for effect in composed.candidate_effects}
    base = tuple(known[label] for label in ("effort_offset@elbow", "effort_offset@shoulder"))
    fit = refit_with_effects(RefitContext(composed), base, nominal.values)
    more = refit_with_effects(RefitContext(composed), (*base, known["joint_coulomb@elbow"]), fit.values)
    forecast = changes_by_candidates_at_location(screen_candidates(composed, base, fit.values), base, 1e-6)
    name = "effort_offset@elbow.offset"
    assert forecast == {name: pytest.approx(more.values[name] - fit.values[name], rel=0.05)}


def test_what_the_fit_has_explained_is_projected_off_and_overlaps_are_parts_of_the_rest(screened):
    _, nominal, point = screened
    residual, signatures = point
    jacobian = nominal.evaluation.jacobian[: len(residual)]
    size = np.linalg.norm(jacobian, axis=0)
    assert np.abs(jacobian.T @ residual / size).max() < 1e-8 * np.linalg.norm(residual)
    for signature in signatures:
        leak = np.abs(jacobian.T @ signature.projected_sensitivity / size[:, None]).max()
        assert leak < 1e-8 * max(np.abs(signature.projected_sensitivity).max(), 1e-300) * len(jacobian)
    # a candidate explains itself, and nothing explains more
    table = screened_at(point)
    assert np.diag(table.overlap_fractions) == pytest.approx(1.0)
    assert np.all((table.overlap_fractions >= 0) & (table.overlap_fractions <= 1))
    assert "joint_stribeck@elbow" in table.labels


def test_detectable_amplitudes_do_not_depend_on_the_residual_and_fall_with_the_noise(screened):
    _, _, (residual, signatures) = screened
    points = ((residual, signatures), (0 * residual, signatures))
    sizes, silent = ([v.detectable_amplitudes for v in screened_at(at).detectability] for at in points)
    assert sizes == silent
    coulomb = next(size["joint_coulomb@elbow.tau_c"] for size in sizes if "joint_coulomb@elbow.tau_c" in size)
    assert 0 < coulomb < 0.1


def test_torques_at_a_node_do_not_depend_on_how_often_it_is_asked(screened):
    own, run = screened[1].problem, screened[1].evaluation.episode_predictions[0].rollout
    read = CompiledInverseDynamics(own.step).torque_magnitude_rate_and_static_friction
    once, twice = (read(own.theta, run, np.array(nodes)) for nodes in ([1, 4, 9], [1, 4, 4, 9]))
    assert all(np.array_equal(one[[0, 1, 1, 2]], two) for one, two in zip(once, twice, strict=True))


@pytest.mark.parametrize(("lean", "chosen"), [(0.0, 0), (1e-10, 0), (0.01, 1)])
def test_of_shape_values_that_make_no_difference_the_first_counts(bench, lean, chosen):
    effect = make_effect("joint_stribeck", "elbow", bench.system)
    rng = np.random.default_rng(4)
    column = rng.standard_normal((200, 1))
    residual = rng.standard_normal((200, 1)) - 0.3 * column
    # the more it leans towards the residual, the more of it the second one explains
    columns = (column, column - lean * residual)
    grid = [{"joint_stribeck@elbow.v_stribeck": value} for value in (0.02, 0.05)]
    made = (made_signature(effect, x) for x in columns)
    at = made_point(residual[:, 0], *(replace(s, shape_values=own) for s, own in zip(made, grid, strict=True)))
    best = screened_at(at, [series(range(200))]).candidate_scores[0]
    assert best.predicted_values["joint_stribeck@elbow.v_stribeck"] == grid[chosen]["joint_stribeck@elbow.v_stribeck"]


def test_readings_that_a_shorter_step_makes_worse_do_not_hide_others(monkeypatch):
    """Such as efforts, in which the noise of accelerations depends on the step."""
    problem = Mock(residual_rows=Mock(measurements=[[slice(0, 2), slice(2, 4)]]), step=Mock(time_step=0.01))
    forecast, name = np.array([1.0, 1.0, 9.0, 9.0]), "predicted_refit_residual_at_finer_step"
    monkeypatch.setattr(diagnose.discretisation, name, lambda *_: forecast)
    fall = diagnose.discretisation.predicted_chi2_fall_at_finer_step
    assert fall(problem, problem, None, Mock(residual=np.full(4, 2.0)), False) == pytest.approx(8.0 - 2.0)


def test_a_gap_without_a_cause_is_refitted_with_half_the_time_step(monkeypatch):
    asked, seen = [], Mock(with_events=Mock(is_corrected_for_links=False))
    seen.evidence.screening.largest_predicted_chi2_decrease, seen.search.thresholds.min_log_bayes_factor = 50.0, 5.0
    monkeypatch.setattr(diagnose, "_at_finer_step", lambda *_: None)
    fall = Mock(predicted_chi2_fall_at_finer_step=lambda *given: asked.append(given[-1]) or 26.0)
    monkeypatch.setattr(diagnose, "discretisation", fall)
    seen.nominal.at_estimates = ()
    monkeypatch.setattr(diagnose, "_at_half_time_step", lambda *_: "finer")
    for verdict, step, found in (("unknown", 0.005, "finer"), ("no_gap", 0.005, seen), ("unknown", 0.002, seen)):
        seen.nominal.problem.step.time_step = step
        assert diagnose._examined_anew(seen, Mock(selected_effects=(), verdict=verdict)) == found
    assert asked == [True]

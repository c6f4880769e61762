"""Screening, rule by rule: what could be seen, how sure a score is, what stands in for what."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from factories import alike, amplitude, cases, effect, point, screened, shape, signature
from made_series import series
from small_problems import PENDULUM, H, pendulum_step, taken

from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem
from yid_ocp.diagnosis.screening import _shape_grid, linearize_candidates, screen_candidates
from yid_ocp.effects import make_effect
from yid_ocp.inference import null_test
from yid_ocp.inference.null_test import channels_with_residual_indices, encoder_noise_residual_covariance_factor
from yid_ocp.integrator.step import compile_step
from yid_ocp.model.system import System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.options import ProblemOptions

CHI2 = scipy.stats.chi2
ONE_SIDED = effect("friction@elbow", amplitude(lower=0.0, expected=(0.0, 1.0)))
TWO_SIDED = effect("offset@elbow", amplitude(lower=-math.inf, expected=(-1.0, 1.0)))
PAIR = effect("tilt@world", amplitude("x", lower=-9.0, upper=9.0), amplitude("y", lower=-9.0, upper=9.0))
SHAPED = effect("branch@T1", amplitude(), shape())


def scored(at, rows=None):
    """The scores of candidates, all of them visible."""
    return screened(at, [series(rows or range(len(at[0])))], detectable_at=0.0).candidate_scores


def only(of, columns, residual, noise=None, **shapes):
    """The score of one candidate that is visible."""
    [found] = scored(point(residual, signature(of, columns, noise, **shapes)))
    return found


def detectable(*signatures):
    """Of one candidate, with all its shapes, beside a residual of zero."""
    [found] = screened(point(np.zeros(len(signatures[0].projected_sensitivity)), *signatures), (), 2.0).detectability
    return found


def overlaps(at):
    return screened(at, detectable_at=0.1)


@cases(
    "expected, count, values",
    {
        "logarithm": ((0.1, 100.0), 4, (0.1, 1.0, 10.0, 100.0)),
        "from zero": ((0.0, 3.0), 4, (0.0, 1.0, 2.0, 3.0)),
        "through zero": ((-1.0, 1.0), 3, (-1.0, 0.0, 1.0)),
        "one value": ((0.5, 2.0), 1, (0.5,)),
    },
)
def test_shapes_are_tried_evenly_over_their_range(expected, count, values):
    found = _shape_grid(effect("branch@T1", amplitude(), shape("s", expected=expected)), count)
    assert [entry["branch@T1.s"] for entry in found] == pytest.approx(values)
    assert all(len(entry) == 1 for entry in found)


def toeplitz(colour, count):
    lags = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    return np.where(lags < len(colour), np.array(colour)[np.minimum(lags, len(colour) - 1)], 0.0)


@pytest.mark.parametrize("how", [{"prescribed": ["shoulder"]}, {"driven": list(PENDULUM)}], ids=["moved", "driven"])
def test_scores_scatter_with_the_encoders_noise_that_moves_an_arm(urdf_folder, how, monkeypatch):
    """As much as predictions of points scatter over recordings that differ by that noise, and in points alone."""
    monkeypatch.setattr(null_test, "_N_PATH_NOISE_DRAWS", 12)
    step = pendulum_step(urdf_folder, **how)
    recording = taken(step, 3, camera=False, steps=80)
    problem = EstimationProblem(step, [recording], ("elbow.damping",), ProblemOptions(path_cutoff=10.0))
    found = encoder_noise_residual_covariance_factor(problem, x := problem.initial_unknowns)
    channels = channels_with_residual_indices(problem)
    rows = np.concatenate([c.residual_indices for c in channels if c.group == "points_arm"])
    assert not np.delete(found, rows, axis=0).any()
    if "driven" in how:
        assert not found.any()
        return
    rng, scatter = np.random.default_rng(8), []
    for _ in range(8):
        position = recording.joints.position + 1e-3 * rng.standard_normal(recording.joints.position.shape)
        noisy = replace(recording, joints=replace(recording.joints, position=position))
        own = EstimationProblem(step, [noisy], ("elbow.damping",), problem.options)
        scatter.append((own.evaluate(x, False).residual - problem.evaluate(x, False).residual)[rows])
    assert np.sum(found[rows] ** 2) == pytest.approx(np.mean(np.sum(np.square(scatter), axis=1)), rel=0.5)


@cases(
    "kind, place, rotor",
    {
        "gain": ("effort_gain", "joint", False),
        "beside a free inertia": ("effort_gain", "joint", True),
        "load beside a free inertia": ("point_mass", "weight", True),
    },
)
def test_noise_that_moves_an_arm_and_predicts_its_efforts_biases_no_score(kind, place, rotor, urdf_folder):
    """What damps a predicted effort damps the noise of its acceleration, and is no effect for that.

    A free inertia takes up what such noise does to an inertia.
    """
    robot, damping = read_urdf(urdf_folder / "servo_pendulum.urdf"), {"joint": 0.05}
    system = System.build(robot, prescribed=["joint"], damping=damping)
    free = ("joint.damping", *["rotor_inertia@joint.armature"] * rotor)
    system = system.with_effects([make_effect("rotor_inertia", "joint", system)] * rotor)
    step = compile_step(system, H, use_compiler=False)
    smooth, options = replace(taken(step, 4, steps=300), points=()), ProblemOptions(path_cutoff=40.0)
    problem, group = EstimationProblem(step, [smooth], free, options), smooth.joints
    [exact] = problem.evaluate(problem.initial_unknowns, False).episode_predictions
    effort = np.interp(group.t, group.t[:-1] + H / 2, exact.rollout.effort[:, 0])[:, None]
    z, p_values = [], []
    for seed in range(4):
        position, read = np.random.default_rng(seed).standard_normal((2, *effort.shape)) * [[[6e-4]], [[0.01]]]
        noisy = {"position": group.position + position, "effort": effort + read, "position_std": 6e-4}
        own = replace(smooth, joints=replace(group, **noisy, effort_std=0.01))
        made = EstimationProblem(step, [own], problem.free, options)
        made = AllCandidatesProblem.from_problem(made, [make_effect(kind, place, step.system)])
        residual, [signature] = linearize_candidates(made, (), {"joint.damping": 0.05})
        [score] = screen_candidates(made, (), {"joint.damping": 0.05}).candidate_scores
        raw = (signature.projected_sensitivity.T @ residual).item()
        z.append([part / signature.score_noise_covariance.item() ** 0.5 for part in (raw, signature.score_bias.item())])
        p_values.append(score.p_value)
    raw, bias = np.mean(z, axis=0)
    assert abs(raw) > 5.0 or rotor
    assert bias == pytest.approx(raw, abs=1.0)
    assert min(p_values) > 0.01


def test_an_inertia_turns_the_encoders_noise_into_more_noise_of_efforts(urdf_folder):
    system = System.build(read_urdf(urdf_folder / "servo_pendulum.urdf"), prescribed=["joint"], damping={"joint": 0.05})
    rotor, values = make_effect("rotor_inertia", "joint", system), {"rotor_inertia@joint.armature": 0.02}
    heavy, plain = (compile_step(own, H, use_compiler=False) for own in (system.with_effects([rotor]), system))
    smooth, options = replace(taken(plain, 4, steps=300), points=()), ProblemOptions(path_cutoff=40.0)
    exact = EstimationProblem(heavy, [smooth], ("joint.damping",), options, values)
    [exact] = exact.evaluate(exact.initial_unknowns, False).episode_predictions
    group, noise = smooth.joints, np.random.default_rng(1).standard_normal((2, 301, 1))
    effort = np.interp(group.t, group.t[:-1] + H / 2, exact.rollout.effort[:, 0])[:, None] + 0.01 * noise[0]
    noisy = replace(group, position=group.position + 6e-4 * noise[1], effort=effort, position_std=6e-4, effort_std=0.01)
    made = EstimationProblem(plain, [replace(smooth, joints=noisy)], ("joint.damping",), options)
    made = AllCandidatesProblem.from_problem(made, [rotor])
    assert made.with_encoder_noise_in_efforts([rotor], {**values, "rotor_inertia@joint.armature": 1e-4}) is None
    chi2 = []
    for own in (made, made.with_encoder_noise_in_efforts([rotor], values)):
        own = own.problem_with_nominal_and_effects_free([rotor])
        residual = own.evaluate(own.pack_unknowns(values), False).residual[own.residual_rows.data]
        chi2.append(residual @ residual / len(residual))
    assert chi2[1] == pytest.approx(1.0, abs=0.3)
    assert chi2[0] > 3.0


@pytest.mark.parametrize("colour", [(1.0,), (1.0, 0.6), (1.0, 0.5, -0.3), (1.0, *[0.1] * 40)])
def test_the_noise_of_a_signature_has_the_colour_of_its_rows(colour):
    columns = np.random.default_rng(1).standard_normal((30, 2))
    parts = [series(range(10, 30), colour=colour), series(range(8))]
    expected = columns[10:].T @ toeplitz(colour, 20) @ columns[10:] + columns[:8].T @ columns[:8]
    found = null_test.covariance_of_scores(columns, parts)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)
    np.testing.assert_array_equal(found, found.T)


@cases(
    "columns, noise, expected, size, seen",
    {
        "seen": ([3.0, 4.0], None, (0.0, 1.0), 2.0 / 5.0, True),
        "as large as expected": ([3.0, 4.0], None, (0.0, 0.4), 2.0 / 5.0, False),
        "to either side": ([3.0, 4.0], None, (-0.5, 0.3), 2.0 / 5.0, True),
        "too noisy": ([3.0, 4.0], 400.0, (0.0, 1.0), 2.0 * 20.0 / 25.0, False),
        "noise that rounding makes negative": ([3.0, 4.0], -1e-18, (0.0, 1.0), 0.0, True),
        "nothing": ([0.0, 0.0], None, (0.0, 1.0), math.inf, False),
        "hardly": ([1e-09, 0.0], None, (0.0, 1000000000000.0), math.inf, False),
        "little": ([1e-07, 0.0], None, (0.0, 1000000000000.0), 2.0 / 1e-07, True),
    },
)
def test_an_amplitude_is_detectable_by_its_noise(columns, noise, expected, size, seen):
    of = effect("friction@elbow", amplitude(lower=-math.inf, expected=expected))
    found = detectable(signature(of, columns, noise, changes={"k": np.array([-3.0])}))
    assert found.detectable_amplitudes == {"friction@elbow.a": pytest.approx(size)}
    assert found.hidden_changes == {"k": pytest.approx(3 * min(size, max(map(abs, expected))))}
    assert found.is_detectable is seen


def test_the_range_counts_from_the_neutral_value():
    of = effect("factor@T1", amplitude(neutral=1.0, lower=0.0, expected=(0.7, 1.2)))
    assert [entry.is_detectable for entry in [detectable(signature(of, [c])) for c in (6.0, 8.0)]] == [False, True]


@pytest.mark.parametrize("order", [(0.5, 4.0, 1.0), (4.0, 0.5, 1.0), (1.0, 0.5, 4.0)])
def test_the_best_shape_tells_what_is_detectable(order):
    found = detectable(*(signature(SHAPED, [size], s=size) for size in order))
    assert found.detectable_amplitudes["branch@T1.a"] == pytest.approx(0.5)
    assert found.is_detectable


def test_a_shape_that_is_seen_comes_before_one_that_is_detectable_but_never_so_small():
    of = effect("pair@x", amplitude("x", expected=(0.0, 0.05)), amplitude("y", expected=(0.0, 1.0)), shape())
    hidden, seen = signature(of, [[20.0, 0.0]], s=0.1), signature(of, [[0.0, 4.0]], s=0.2)
    weaker, larger = signature(of, [[0.0, 3.0]], s=0.3), signature(of, [[10.0, 0.0]], s=0.4)
    for pair, name, size, is_seen in (
        ((hidden, seen), "y", 0.5, True),
        ((seen, hidden), "y", 0.5, True),
        ((seen, weaker), "y", 0.5, True),
        ((hidden, larger), "x", 0.1, False),
    ):
        found = detectable(*pair)
        assert (found.detectable_amplitudes[f"pair@x.{name}"], found.is_detectable) == (pytest.approx(size), is_seen)


@pytest.mark.parametrize(("of", "count"), [(TWO_SIDED, 1), (TWO_SIDED, 4), (PAIR, 4), (PAIR, 9), (PAIR, 17)])
def test_a_score_is_that_of_the_lagrange_multiplier_test(of, count):
    names, rows, rng = of.amplitude_parameter_names, range(2, count + 2), np.random.default_rng(count)
    x, r = rng.standard_normal((count + 5, len(names))), rng.standard_normal(count + 5)
    [found] = scored(point(r, signature(of, x, 1e-9 * np.eye(len(names)))), rows)
    step = -np.linalg.solve(x.T @ x, x.T @ r)
    left = r + x @ step
    assert found.predicted_values == pytest.approx(dict(zip(names, step, strict=True)))
    assert found.predicted_chi2_decrease == pytest.approx(float(r @ r - left @ left))
    # scattering as what would be left with the step done, by Bartlett's weights
    u, apart = (x * left[:, None])[2 : count + 2], np.abs(np.subtract.outer(rows, rows))
    covariance = u.T @ np.maximum(0.0, 1 - apart / (int(math.sqrt(count)) + 1)) @ u
    assert found.lm_statistic == pytest.approx(float((x.T @ r) @ np.linalg.solve(covariance, x.T @ r)))
    assert found.p_value == pytest.approx(float(CHI2.sf(found.lm_statistic, len(names))))


def test_stated_priors_scatter_as_stated_where_they_decide_a_score():
    """A load that the uncertain mass of a link imitates shows in the prior of that mass more than in the data."""
    x, r = np.array([0.1, -0.1, 0.1, 5.0]), np.array([0.1, 0.2, -0.1, -0.8])
    [found] = scored(point(r, signature(TWO_SIDED, x, noise=1e-9, priors=25.0)), range(3))
    assert found.lm_statistic == pytest.approx(float(x @ r) ** 2 / 25.0, rel=1e-2)


def test_a_residual_below_the_noise_does_not_make_a_score_sure():
    """What would be left scatters less than noise does, so the noise decides."""
    x, r = np.ones(4), -1.5 * np.ones(4)
    found = only(TWO_SIDED, x, r)
    assert found.lm_statistic == pytest.approx(36.0 / 4.0)
    assert found.p_value == pytest.approx(float(CHI2.sf(9.0, 1)))
    assert only(TWO_SIDED, x, r, noise=16.0).lm_statistic == pytest.approx(36.0 / 16.0)


def test_an_amplitude_of_one_sign_is_tested_on_one_side():
    x, r = np.ones(4), -1.5 * np.ones(4)
    two, one = only(TWO_SIDED, x, r), only(ONE_SIDED, x, r)
    assert one.lm_statistic == two.lm_statistic > 0
    assert one.p_value == pytest.approx(two.p_value / 2)


@pytest.mark.parametrize("size", [1.5, 0.5])
def test_an_amplitude_of_the_wrong_sign_explains_nothing(size):
    found = only(ONE_SIDED, np.ones(4), size * np.ones(4))
    assert found.predicted_values == {"friction@elbow.a": 0.0}
    assert (found.predicted_chi2_decrease, found.lm_statistic, found.p_value) == (0.0, 0.0, 1.0)
    other = only(TWO_SIDED, np.ones(4), size * np.ones(4))
    assert other.predicted_values == {"offset@elbow.a": pytest.approx(-size)}
    assert other.p_value == pytest.approx(float(CHI2.sf(4 * size**2, 1)))


@cases(
    "wanted, step, decrease",
    {"free": (1.0, 1.0, 4 * 1.0), "above": (2.0, 1.5, 4 * (4.0 - 0.25)), "below": (-2.0, -0.5, 4 * (4.0 - 2.25))},
)
def test_a_step_stops_at_its_bounds_and_promises_less(wanted, step, decrease):
    of = effect("offset@elbow", amplitude(neutral=1.0, lower=0.5, upper=2.5))
    found = only(of, np.ones(4), -wanted * np.ones(4))
    assert found.predicted_values == {"offset@elbow.a": pytest.approx(1.0 + step)}
    assert found.predicted_chi2_decrease == pytest.approx(decrease)


def test_two_amplitudes_have_two_degrees_of_freedom():
    x = np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 2.0]])
    r = np.array([-1.0, -2.0, -3.0])
    found = only(PAIR, x, r)
    assert list(found.predicted_values.values()) == pytest.approx(np.linalg.lstsq(x, -r, rcond=None)[0])
    statistic = float(x.T @ r @ np.linalg.solve(x.T @ x, x.T @ r))
    assert found.lm_statistic == pytest.approx(statistic)
    assert found.p_value == pytest.approx(float(CHI2.sf(statistic, 2)))


def test_the_best_of_many_shapes_counts_as_the_best_of_that_many_tries():
    r = np.array([-1.5, -1.5, 0.0, 0.0])
    columns = [np.array(c) for c in ([1.0, 0.0, 1.0, 0.0], [1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0])]
    [found] = scored(point(r, *(signature(SHAPED, c, s=0.1 * (i + 1)) for i, c in enumerate(columns))))
    alone = only(SHAPED, columns[1], r, s=0.2)
    assert found.predicted_values == {"branch@T1.a": pytest.approx(1.5), "branch@T1.s": 0.2}
    assert found.predicted_chi2_decrease == pytest.approx(4.5)
    assert found.p_value == pytest.approx(3 * alone.p_value)
    assert scored(point(0 * r, *(signature(SHAPED, c, s=1.0) for c in columns)))[0].p_value == 1.0


def test_scores_are_of_visible_candidates_and_the_most_promising_first():
    ranges = {"a": (0.0, 9.0), "b": (0.0, 9.0), "c": (0.0, 1.0)}
    others = [effect(f"offset@{name}", amplitude(lower=-math.inf, expected=own)) for name, own in ranges.items()]
    at = point([3.0, 2.0, 1.0], *(signature(of, np.eye(3)[i]) for i, of in zip((1, 0, 2), others, strict=True)))
    found = screened(at, [series(range(3))], detectable_at=2.0).candidate_scores
    assert [s.effect.label for s in found] == ["offset@b", "offset@a"]
    assert [s.predicted_chi2_decrease for s in found] == pytest.approx([9.0, 4.0])


def test_a_signature_explained_by_another():
    a = effect("a@x", amplitude(lower=-1.0, expected=(-1.0, 1.0)))
    b = effect("b@x", amplitude(lower=-1.0, expected=(-1.0, 1.0)))
    angle = math.radians(30)
    at = point([0.0] * 2, signature(a, [2.0, 0.0]), signature(b, [math.cos(angle), math.sin(angle)]))
    found = overlaps(at)
    assert found.labels == ["a@x", "b@x"]
    np.testing.assert_allclose(found.overlap_fractions, [[1.0, 0.75], [0.75, 1.0]], atol=1e-12)
    # nothing is like what moves nothing
    at = point([0.0] * 2, signature(a, [0.0, 0.0]), signature(b, [1.0, 0.0]))
    np.testing.assert_array_equal(overlaps(at).overlap_fractions, [[0.0, 0.0], [0.0, 1.0]])
    assert overlaps(point([0.0])).labels == []


def test_shapes_are_those_of_the_scores_or_the_middle_of_the_grid():
    one, residual = effect("one@x", amplitude()), [0.0, -1.0, 0.0, 0.0]
    for size, middle in ((1.0, False), (0.05, True)):  # small ones are not detectable and have no score
        axes = [signature(SHAPED, size * np.eye(4)[i], s=0.1 * (i + 1)) for i in range(4)]
        second, third = (point(residual, *axes, signature(one, np.eye(4)[i])) for i in (1, 2))
        overlap = [overlaps(at).overlap_fractions[1, 0] for at in (second, third)]
        assert overlap == pytest.approx([0.0, 1.0] if middle else [1.0, 0.0])


def test_candidates_alike_explain_the_signature_from_the_limit_on():
    a, *others = labels = [f"{name}@x" for name in "abcd"]
    table = alike(labels, [[1.0, 0.9, 0.89, 0.95], [0.2, 1.0, 0.3, 0.1], [0, 0, 1, 0], [0, 0, 0, 1]])
    assert table.candidates_confusable_with(a, 0.9) == ("b@x", "d@x")
    assert table.candidates_confusable_with(a, 0.5) == tuple(others)
    assert table.candidates_confusable_with("b@x", 0.9) == ()


def test_two_that_hide_in_each_other_show_as_a_pair():
    """The residual is the difference of two signatures that are nearly one: neither does anything alone."""
    a, b, c = (effect(f"{name}@x", amplitude(lower=-9.0)) for name in "abc")
    at = point(
        [0.0, -1.0, 0.0], *(signature(of, x) for of, x in ((a, [1, 0.5, 0]), (b, [1, -0.5, 0]), (c, [0, 0.5, 2])))
    )
    seen = screened(at, detectable_at=0.1)
    pairs = list(seen.rank_candidate_pairs(""))
    assert ["".join(of.kind for of in pair) for pair, *_ in pairs] == ["ab", "ac", "bc"]
    assert pairs[0][1:] == (pytest.approx({"a@x.a": 1.0, "b@x.a": -1.0}), pytest.approx(-1.0))
    [(fewer, *_)] = seen.rank_candidate_pairs("a@x")
    assert fewer == (b, c)


def test_pairs_promise_what_the_linear_model_of_both_does():
    rng = np.random.default_rng(3)
    effects = (PAIR, TWO_SIDED, SHAPED)
    columns = [rng.standard_normal((9, len(of.amplitude_parameter_names))) for of in effects]
    residual = rng.standard_normal(9)
    made = [signature(of, x, **({"s": 0.2} if of is SHAPED else {})) for of, x in zip(effects, columns, strict=True)]
    pairs = screened(point(residual, *made), detectable_at=0.1).rank_candidate_pairs("")
    assert len(pairs) == 3
    for pair, values, decrease in pairs:
        x = np.hstack([columns[effects.index(of)] for of in pair])
        names = [name for of in pair for name in of.amplitude_parameter_names]
        own = [q for of in pair for q in of.definitions if not q.is_shape_parameter]
        lower, upper = zip(*((q.lower - q.neutral_value, q.upper - q.neutral_value) for q in own), strict=True)
        step = np.clip(-np.linalg.lstsq(x, residual)[0], lower, upper)
        assert [values[name] for name in names] == pytest.approx(step)
        promised = residual @ residual - np.sum((residual + x @ step) ** 2)
        assert decrease == pytest.approx(promised - len(names))
        assert values.get("branch@T1.s", 0.2) == 0.2

"""What recordings say about parameters, rule by rule, on formulas whose information is known."""

from __future__ import annotations

import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from made_models import Formula, estimate, solution
from made_recordings import holding_pendulum

from yid_ocp.analysis import identifiability as module
from yid_ocp.analysis.identifiability import (
    _orthogonal_part,
    identifiability,
    transfer_unknowns,
    unknowns_from_solution,
    with_grasp_offset_effects,
)
from yid_ocp.analysis.parameter_combinations import DirectionComponent, describe_combination, join_names, sparse_basis
from yid_ocp.effects import make_effect
from yid_ocp.errors import ConfigError, SolverError
from yid_ocp.inference.uncertainty import percent_text
from yid_ocp.model import Grasp


def judged(problem, at=None, **more):
    return identifiability(problem, at, start="known", **more)


def two(size_a=30.0, size_b=3.0, extra=0.0):
    """Each of two parameters seen by a row of its own (relative: so many standard deviations for its whole value)."""
    return lambda x: [size_a * (x["a"] / 2.0 - 1) + extra, size_b * (x["b"] / 50.0 - 1)]


START = {"a": 2.0, "b": 50.0}


# -- parameters -------------------------------------------------------------------------------------------------------


def test_a_parameter_is_as_sure_as_its_rows_say():
    info = judged(Formula(two(), START, units={"a": "N m/rad", "b": "kg"}))
    a, b = info.parameters["a"], info.parameters["b"]
    assert (a.value, a.unit, a.interval) == (2.0, "N m/rad", None)
    assert (a.std, a.std_relative, a.std_alone) == pytest.approx((2 / 30, 1 / 30, 1 / 30))
    assert (b.value, b.unit) == (50.0, "kg")
    assert (b.std, b.std_relative, b.verdict) == (pytest.approx(50 / 3), pytest.approx(1 / 3), "weak")
    assert a.verdict == "identifiable"
    assert info.identifiable_parameters == ("a",)
    np.testing.assert_allclose(info.fisher_information, np.diag([900.0, 9.0]))
    np.testing.assert_allclose(info.correlations, np.eye(2), atol=1e-12)
    assert (info.parameter_names, info.nuisance_names, info.profiles) == (("a", "b"), (), {})


def test_parameters_that_are_seen_together_are_less_sure_than_each_alone():
    def rows(x):
        a, b = x["a"] / 2 - 1, x["b"] / 50 - 1
        return [30 * (a + b), 10 * b]

    info = judged(Formula(rows, START))
    inverse = np.linalg.inv(np.array([[900.0, 900.0], [900.0, 1000.0]]))
    assert info.parameters["a"].std_relative == pytest.approx(math.sqrt(inverse[0, 0]))
    assert info.parameters["a"].std_alone == pytest.approx(1 / 30)
    assert info.parameters["b"].std_alone == pytest.approx(1 / math.sqrt(1000.0))
    correlation = inverse[0, 1] / math.sqrt(inverse[0, 0] * inverse[1, 1])
    np.testing.assert_allclose(info.correlations, [[1.0, correlation], [correlation, 1.0]], rtol=1e-9)


def test_what_nothing_informs_is_infinitely_unsure():
    info = judged(Formula(lambda x: [30 * (x["a"] / 2 - 1), 0 * x["b"]], START))
    b = info.parameters["b"]
    assert (b.std, b.std_relative, b.std_alone) == (math.inf, math.inf, math.inf)
    assert b.verdict == "not_identifiable"
    assert info.correlations[0, 0] == pytest.approx(1.0)
    assert np.isnan(info.correlations[[0, 1, 1], [1, 0, 1]]).all()


def test_a_misfit_counts_at_a_fit_and_not_at_the_start():
    problem = Formula(lambda x: [30 * (x["a"] / 2 - 1) + 3.0, 30 * (x["a"] / 2 - 1) - 3.0], {"a": 2.0})
    start, fit = judged(problem), judged(problem, [2.0])
    assert start.chi2_per_dof == fit.chi2_per_dof == pytest.approx(18.0)
    plain = 2 / (30 * math.sqrt(2.0))
    assert start.parameters["a"].std == pytest.approx(plain)
    assert fit.parameters["a"].std == pytest.approx(plain * math.sqrt(18.0))
    np.testing.assert_allclose(start.fisher_information, [[1800.0]])
    np.testing.assert_allclose(fit.fisher_information, [[100.0]])
    assert fit.parameters["a"].std_alone == pytest.approx(fit.parameters["a"].std_relative)
    good = Formula(lambda x: [30 * (x["a"] / 2 - 1)] * 5, {"a": 2.0})
    assert judged(good, [2.0]).parameters["a"].std == pytest.approx(2 / (30 * math.sqrt(5.0)))


def test_a_fit_is_judged_by_the_noise_that_drives_the_motion_too(monkeypatch):
    """Far too large a residual until it is weighed by the noise that drives the motion."""
    problem = Formula(lambda x: [300 * (x["a"] / 2 - 1) + 20.0 * (-1) ** k for k in range(60)], {"a": 2.0})
    weighed = Formula(lambda x: [300 * (x["a"] / 2 - 1) + (-1) ** k for k in range(60)], {"a": 2.0})
    monkeypatch.setattr(module, "whitened_at", lambda *given, rounds: weighed)
    assert judged(problem, [2.0]).parameters["a"].verdict == "identifiable"
    # of a problem with more unknowns the fit is still that of the problem as it was solved
    monkeypatch.setattr(module, "with_nuisance_unknowns", lambda *given: weighed)
    assert judged(problem, [2.0]).parameters["a"].verdict == "identifiable"


def test_a_parameter_at_zero_is_as_large_as_its_scale():
    problem = Formula(lambda x: [30 * x["a"]], {"a": 0.0}, bounds={"a": (-9.0, 9.0)}, scales={"a": 0.5})
    entry = judged(problem).parameters["a"]
    assert (entry.value, entry.std, entry.std_relative) == (0.0, pytest.approx(1 / 30), pytest.approx(1 / 15))
    negative = Formula(lambda x: [30 * x["a"]], {"a": -0.5}, bounds={"a": (-9.0, 9.0)})
    assert judged(negative).parameters["a"].std_relative == pytest.approx(1 / 15)


def test_what_was_known_beforehand_is_not_something_that_a_sensor_sees():
    problem = Formula(lambda x: [3 * (x["a"] / 2 - 1), 40 * (x["a"] / 2 - 1)], {"a": 2.0}, stated=1)
    info = judged(problem)
    assert info.parameters["a"].std_relative == pytest.approx(1 / math.hypot(3, 40))
    assert info.parameters["a"].std_alone == pytest.approx(1 / 3)
    np.testing.assert_allclose(info.fisher_information, [[9.0]])


# -- nuisances --------------------------------------------------------------------------------------------------------


def with_start(rows, **more):
    return Formula(rows, {**START, "start.q.x[run]": 0.0}, bounds={"start.q.x[run]": (-math.inf, math.inf)}, **more)


def test_a_nuisance_takes_what_it_explains():
    def rows(x):
        a, s = x["a"] / 2 - 1, x["start.q.x[run]"]
        return [30 * a + 5 * s, 40 * (x["b"] / 50 - 1), 0 * a + 2 * s]

    info = judged(with_start(rows, stated=1))
    assert info.parameter_names == ("a", "b")
    assert info.nuisance_names == ("start.q.x[run]",)
    expected = np.linalg.inv(np.array([[900.0, 150.0], [150.0, 29.0]]))[0, 0]
    assert info.parameters["a"].std_relative == pytest.approx(math.sqrt(expected))
    assert info.parameters["a"].std_alone == pytest.approx(1 / 30)
    np.testing.assert_allclose(info.fisher_information, np.diag([1 / expected, 1600.0]), atol=1e-9)


def test_what_only_a_nuisance_hides_is_said_to_be_hidden_by_it():
    def rows(x):
        return [30 * (x["a"] / 2 - 1) + 5 * x["start.q.x[run]"], 40 * (x["b"] / 50 - 1)]

    [hidden, _] = judged(with_start(rows)).directions
    assert hidden.words == "a cannot be told apart from the unknown start"
    assert hidden.verdict == "not_identifiable"


GRASP = "grasp_offset@left.dx"


def test_other_nuisances_are_named_as_well(monkeypatch):
    def rows(x):
        return [30 * (x["a"] / 2 - 1) + 5 * x[GRASP]]

    free = {"a": (0.0, math.inf), GRASP: (-1.0, 1.0), "start.q": (-1.0, 1.0)}
    wide = Formula(rows, {"a": 2.0, GRASP: 0.0}, bounds=free)
    narrow = Formula(lambda x: [30 * (x["a"] / 2 - 1)], {"a": 2.0})
    monkeypatch.setattr(module, "with_nuisance_unknowns", lambda *_: wide)
    [hidden] = judged(narrow).directions
    assert hidden.words == "a cannot be told apart from where the grasp sits"

    def both(x):
        a = x["a"] / 2 - 1
        return [30 * a + 5 * x[GRASP], 30 * a + 5 * x["start.q"]]

    wider = Formula(both, {"a": 2.0, GRASP: 0.0, "start.q": 0.0}, bounds=free)
    monkeypatch.setattr(module, "with_nuisance_unknowns", lambda *_: wider)
    [hidden] = judged(narrow).directions
    assert hidden.words == "a cannot be told apart from the unknown start and where the grasp sits"


def test_a_combination_that_a_nuisance_hides_is_said_so():
    def rows(x):
        a, b, s = x["a"] / 2 - 1, x["b"] / 50 - 1, x["start.q.x[run]"]
        return [30 * (a + b) + 5 * s, 30 * (a - b)]

    directions = judged(with_start(rows)).directions
    assert directions[0].words == (
        "this: a and b are seen only together: a +10 % with b +10 % changes nothing that is measured "
        "cannot be told apart from the unknown start"
    )


@pytest.mark.parametrize("tolerance", [1e-9, 1e-11])
def test_a_column_far_smaller_than_the_largest_counts_as_none(tolerance):
    explained = np.array([[1.0, 0.0], [0.0, tolerance], [0.0, 0.0]])
    left = _orthogonal_part(np.eye(3)[:, 1:2], explained)
    np.testing.assert_allclose(left.ravel(), [0, 0.0 if tolerance > 1e-10 else 1.0, 0], atol=1e-9)
    np.testing.assert_array_equal(_orthogonal_part(np.eye(3), np.zeros((3, 0))), np.eye(3))
    np.testing.assert_array_equal(_orthogonal_part(np.eye(3), np.zeros((3, 2))), np.eye(3))


# -- directions -------------------------------------------------------------------------------------------------------


def test_directions_are_sorted_and_say_how_well_they_are_seen():
    directions = judged(Formula(two(30.0, 3.0), START)).directions
    assert [d.singular_value for d in directions] == pytest.approx([3.0, 30.0])
    assert [d.std_relative for d in directions] == pytest.approx([1 / 3, 1 / 30])
    assert [d.verdict for d in directions] == ["weak", "identifiable"]
    assert [d.words for d in directions] == ["b is seen only weakly (± 33 %)", "a is seen (± 3.3 %)"]
    assert directions[0].components == {"a": pytest.approx(0.0), "b": pytest.approx(1.0)}
    assert judged(Formula(two(30.0, 10.0), START)).directions[0].words == "b is seen (± 10 %)"


def test_what_is_said_of_one_parameter_is_what_stands_beside_it():
    """Directions know the size of a misfit, standard deviations also whom it concerns."""

    def rows(x):
        slow = [(-1) ** (k // 10) for k in range(60)]
        return [
            *(30 * (x["a"] / 2 - 1) + (-1) ** k for k in range(60)),
            *(30 * (x["b"] / 50 - 1) + 9 * sign for sign in slow),
        ]

    info = judged(Formula(rows, START), [2.0, 50.0])
    assert len(info.directions) == 2
    for direction in info.directions:
        [name] = [name for name, part in direction.components.items() if abs(part) > 0.5]
        assert f"(± {percent_text(info.parameters[name].std_relative)} %)" in direction.words


def test_a_joint_change_names_the_largest_part_first_and_leaves_small_ones_out():
    def rows(x):
        a, b, c = (x[name] / 2 - 1 for name in "abc")
        return [50 * (0.3 * a + 0.95 * b + 0.01 * c), 20 * (0.95 * a - 0.3 * b), 30 * c]

    directions = judged(Formula(rows, dict.fromkeys("abc", 2.0))).directions
    assert directions[-1].words.startswith("a joint change of b and a is seen (± 2")
    assert directions[-1].components["b"] > 0.9


def test_the_largest_component_of_a_direction_is_positive():
    for sign in (1, -1):
        [direction] = judged(Formula(lambda x, sign=sign: [sign * 30 * x["a"]], {"a": 2.0})).directions
        assert direction.components == {"a": 1.0}


def test_what_is_hardly_seen_is_said_not_to_be_seen():
    """Fewer standard deviations than a quarter for a change by the whole value."""
    for size, words in ((0.24, "b is not seen by any sensor"), (0.26, "b is seen only weakly (± 385 %)")):
        directions = judged(Formula(two(30.0, size), START)).directions
        assert directions[0].words == words
        assert directions[0].singular_value == pytest.approx(size)
    info = judged(Formula(two(30.0, 0.24), START))
    assert [d.words for d in info.unidentifiable_directions] == ["b is not seen by any sensor"]
    none = judged(Formula(lambda x: [30 * x["a"], 0 * x["b"]], START)).unidentifiable_directions[0]
    assert (none.singular_value, none.std_relative) == (0.0, math.inf)


def test_springs_in_series_are_named():
    def rows(x):
        return [300 * (1 / x["a"] + 1 / x["b"] - 0.7)]

    info = judged(Formula(rows, {"a": 2.0, "b": 5.0}))
    [unseen] = info.unidentifiable_directions
    assert unseen.words == "a and b are seen only as 1/a + 1/b, as springs in series are"
    assert unseen.components["b"] / unseen.components["a"] == pytest.approx(-2.5)
    assert len(info.directions) == 2


def test_two_pairs_that_are_each_seen_together_are_told_apart():
    def rows(x):
        return [300 * (x["a"] + x["b"] - 7), 300 * (x["c"] * x["d"] - 12)]

    info = judged(Formula(rows, {"a": 2.0, "b": 5.0, "c": 3.0, "d": 4.0}))
    assert {d.words for d in info.unidentifiable_directions} == {
        "a and b are seen only as a + b, as springs side by side are",
        "c and d are seen only as the product c x d",
    }


def test_a_combination_is_not_named_where_the_model_cannot_be_rolled_out():
    def rows(x):
        return [300 * (x["a"] + x["b"] - 7)]

    far = Formula(rows, {"a": 2.0, "b": 5.0}, fails=lambda values: values["a"] != 2.0)
    assert "as springs" not in judged(far).unidentifiable_directions[0].words


def test_fewer_rows_than_parameters_leave_directions_open():
    info = judged(Formula(lambda x: [30 * (x["a"] + x["b"] + x["c"])], dict.fromkeys("abc", 2.0)))
    assert len(info.directions) == 3
    assert [d.verdict for d in info.directions] == ["not_identifiable", "not_identifiable", "identifiable"]


def test_rows_in_metres_inform_in_units_of_their_noise():
    info = judged(Formula(lambda x: [0.3 * (x["a"] / 2 - 1)], {"a": 2.0}, noise=0.01))
    assert info.parameters["a"].std_relative == pytest.approx(1 / 30)
    series = Formula(lambda x: [3 * (x["a"] + x["b"] - 7)], {"a": 2.0, "b": 5.0}, noise=0.01)
    assert "a + b" in judged(series).unidentifiable_directions[0].words


# -- intervals --------------------------------------------------------------------------------------------------------


def test_intervals_are_worked_out_where_they_are_wanted_about_the_best_fit():
    problem = Formula(lambda x: [15 * (x["a"] / 2 - 1), 30 * (x["b"] / 50 - 1)], {"a": 2.1, "b": 50.0})
    info = judged(problem, intervals=["a"])
    half = 1.96 * 2 / 15
    np.testing.assert_allclose(info.parameters["a"].interval, [2 - half, 2 + half], rtol=0.02)
    assert info.parameters["b"].interval is None
    assert set(info.profiles) == {"a"}
    assert info.profiles["a"].value == pytest.approx(2.0, abs=1e-3)
    assert set(judged(problem, intervals="all").profiles) == {"a", "b"}


def test_an_open_interval_lowers_the_verdict():
    problem = Formula(lambda x: [1.9 * (1 - ca.exp(-7.0 / 1.9 * (x["a"] - 2)))], {"a": 2.0})
    assert judged(problem).parameters["a"].verdict == "identifiable"
    assert judged(problem, intervals="all").parameters["a"].verdict == "weak"


def test_an_interval_of_what_is_not_free_is_refused():
    with pytest.raises(ConfigError, match="'c' is not a free parameter"):
        judged(Formula(two(), START), intervals=["c"])


def test_a_point_that_cannot_be_rolled_out_is_refused():
    with pytest.raises(SolverError, match="it snaps"):
        judged(Formula(two(), START, fails=lambda values: True))


# -- points -----------------------------------------------------------------------------------------------------------


def test_a_point_is_a_solution_an_array_or_the_start():
    problem = Formula(two(), START)
    np.testing.assert_array_equal(unknowns_from_solution(problem, None), [2.0, 50.0])
    np.testing.assert_array_equal(unknowns_from_solution(problem, [3, 4]), [3.0, 4.0])
    found = solution(b=estimate(70.0), other=estimate(9.0))
    np.testing.assert_array_equal(unknowns_from_solution(problem, found), [2.0, 70.0])
    with pytest.raises(SolverError, match="shape"):
        unknowns_from_solution(problem, [1.0])
    with pytest.raises(SolverError, match="b is not finite"):
        unknowns_from_solution(problem, [1.0, math.nan])


@pytest.mark.parametrize("size", [1e-12, 1.0, 1e12])
def test_what_is_explained_does_not_depend_on_the_size_of_the_explanation(size):
    rng = np.random.default_rng(4)
    columns, explained = rng.standard_normal((6, 2)), rng.standard_normal((6, 3))
    explained = np.column_stack([explained, explained @ [1.0, 2.0, 3.0]])
    left = _orthogonal_part(columns, size * explained)
    np.testing.assert_allclose(explained.T @ left, 0.0, atol=1e-12)
    projected = explained @ np.linalg.lstsq(explained, columns, rcond=1e-9)[0]
    np.testing.assert_allclose(left, columns - projected, atol=1e-12)


def test_every_grasp_without_an_offset_gets_one(urdf_folder):
    """Other effects on a grasp do not count as its offset, whatever they are called."""
    system = holding_pendulum(urdf_folder)
    other = Grasp("other", "lower", "T1_1_tip")
    system = replace(system, grasps=(*system.grasps, other))
    for there in ((), (("grasp_compliance", "hand"),), (("grasp_offset", "other"), ("grasp_compliance", "other"))):
        made = system.with_effects([make_effect(kind, place, system) for kind, place in there])
        found = [(e.kind, e.location) for e in with_grasp_offset_effects(made).effects]
        assert found[: len(there)] == list(there)
        missing = [place for place in ("hand", "other") if ("grasp_offset", place) not in there]
        assert found[len(there) :] == [("grasp_offset", place) for place in missing]


def test_unknowns_are_carried_over_by_name():
    other = Formula(lambda x: [x["c"]], {"b": 1.0, "c": 7.0, "a": 1.0})
    np.testing.assert_array_equal(transfer_unknowns(np.array([2.0, 50.0]), ("a", "b"), other), [50.0, 7.0, 2.0])


# -- combinations -----------------------------------------------------------------------------------------------------


def parts(*values, units=("N/m", "N/m")):
    return [
        DirectionComponent(f"k{i}", part, value, unit)
        for i, ((part, value), unit) in enumerate(zip(values, units, strict=False))
    ]


def moves(function):
    def moved(changes):
        a, b = changes.get("k0", 2.0), changes.get("k1", 5.0)
        return 1e3 * abs(function(a, b) - function(2.0, 5.0))

    return moved


@pytest.mark.parametrize(
    ("direction", "function", "units", "words"),
    [
        ((2.0, -5.0), lambda a, b: 1 / a + 1 / b, ("N/m", "N/m"), "1/k0 + 1/k1"),
        ((2.0, -5.0), lambda a, b: 1 / a + 1 / b, ("N/m", "kg"), None),
        ((2.2, -5.0), lambda a, b: 1 / a + 1 / b, ("N/m", "N/m"), "1/k0 + 1/k1"),
        ((2.6, -5.0), lambda a, b: 1 / a + 1 / b, ("N/m", "N/m"), None),
        ((-2.0, 5.0), lambda a, b: 1 / a + 1 / b, ("N/m", "N/m"), "1/k0 + 1/k1"),
        ((1.0, 1.0), lambda a, b: a / b, ("N/m", "kg"), "the ratio k0 / k1"),
        ((1.0, -1.0), lambda a, b: a * b, ("N/m", "kg"), "the product k0 x k1"),
        ((1.0, -1.0), lambda a, b: a * b * b, ("N/m", "kg"), None),
        ((5.0, -2.0), lambda a, b: a + b, ("N/m", "N/m"), "k0 + k1"),
    ],
    ids=["series", "units differ", "nearly", "too far", "other way", "ratio", "product", "only at first", "sum"],
)
def test_a_plain_combination_has_its_direction_and_holds_at_a_finite_change(direction, function, units, words):
    a, b = np.array(direction) / np.linalg.norm(direction)
    said = describe_combination(parts((a, 2.0), (b, 5.0), units=units), moves(function))
    assert (words is not None and said.startswith(f"k0 and k1 are seen only as {words}")) is (words is not None)


def test_a_combination_may_move_the_data_a_little():
    """By a tenth of what one change alone does, or by one standard deviation."""
    made = parts((0.5**0.5, 2.0), (-(0.5**0.5), 5.0))
    for size, named in ((0.09, True), (0.11, False)):

        def moved(changes, size=size):
            alone = len(changes) == 1
            return 100.0 if alone else 100.0 * size

        assert ("the product" in describe_combination(made, moved)) is named
    assert "the product" in describe_combination(made, lambda changes: 5.0 if len(changes) == 1 else 0.99)
    assert "the product" not in describe_combination(made, lambda changes: 5.0 if len(changes) == 1 else 1.01)


def test_the_combination_that_moves_the_data_least_is_named():
    made = parts((0.5**0.5, 3.0), (-(0.5**0.5), 3.0))

    def moved(changes):
        a, b = changes.get("k0", 3.0), changes.get("k1", 3.0)
        return 1e3 * abs(a + b - 6.0)

    # equal values: sum, product and series look alike at first
    assert "k0 + k1" in describe_combination(made, moved)


def test_a_partner_that_would_have_to_be_negative_is_none():
    made = parts((1.0, 9.0), (-9.0, 1.0))
    said = describe_combination(made, lambda changes: 0.0 if len(changes) == 2 else 100.0)
    assert "k0 + k1" not in said


def test_one_parameter_alone_and_names_in_a_row():
    assert describe_combination(parts((1.0, 2.0)), None) == "k0 is not seen"
    assert join_names(["a"]) == "a"
    assert join_names(["a", "b"]) == "a and b"
    assert join_names(list("abcd")) == "a, b, c and d"
    assert join_names(list("abcde")) == "a, b, c, d and 1 more"


def test_a_trade_is_in_percent_of_the_largest_change():
    made = [DirectionComponent(name, part, 1.0, "N/m") for name, part in (("a", 0.1), ("b", -0.4), ("c", 0.3))]
    said = describe_combination(made, None)
    assert (
        said
        == "a, b and c are seen only together: a +2.5 % with b -10 % with c +7.5 % changes nothing that is measured"
    )
    five = [
        DirectionComponent(name, part, 1.0, "N/m")
        for name, part in zip("abcde", (0.1, -0.5, 0.2, 0.3, 0.4), strict=True)
    ]
    assert "b -10 % with e +8 % with d +6 % with c +4 % and the others to match" in describe_combination(five, None)


@pytest.mark.parametrize("seed", range(4))
def test_a_sparse_basis_spans_the_same_space(seed):
    rng = np.random.default_rng(seed)
    vectors = rng.standard_normal((3, 6))
    found = np.array(sparse_basis(vectors))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0)
    q = np.linalg.qr(vectors.T)[0]
    np.testing.assert_allclose(found @ q @ q.T, found, atol=1e-9)
    # three columns stand in one vector only
    alone = [np.sum(np.abs(found[:, j]) > 1e-9) == 1 for j in range(6)]
    assert sum(alone) == 3
    np.testing.assert_array_equal(vectors, np.random.default_rng(seed).standard_normal((3, 6)))

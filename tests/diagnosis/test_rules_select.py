"""Losses, closures and the choice among refits, rule by rule."""

import math
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from factories import alike, amplitude, cases, effect, fit, loss, score, screening, shape
from heard import Heard

from yid_ocp.diagnosis import select
from yid_ocp.diagnosis.refit import RefitContext, RefitStatistics
from yid_ocp.diagnosis.screening import EMPTY_SCREENING_RESULT
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.inference.null_test import HeldOutLoss, chi2_per_sample_decrease_and_std_error, held_out_gap_closure

LIMITS = Thresholds()


@cases(
    "squares, counts, mean, gap",
    {
        "above": ([30.0, 10.0], [10.0, 10.0], 2.0, 1.0),
        "weighed by samples": ([30.0, 10.0], [10.0, 30.0], 1.0, 0.0),
        "below noise": ([5.0], [10.0], 0.5, 0.0),
        "failed": ([math.inf, 1.0], [10.0, 10.0], math.inf, math.inf),
        "empty": ([0.0], [0.0], 0.0, 0.0),
    },
)
def test_a_loss_is_a_mean_over_samples_and_a_gap_what_exceeds_one(squares, counts, mean, gap):
    found = HeldOutLoss(np.array(squares), np.array(counts), {}, math.nan)
    assert found.chi2_per_sample == pytest.approx(mean)
    assert found.excess_chi2_per_sample == pytest.approx(gap)


@cases(
    "before, after, closed",
    {
        "all": ((3.0, 3.0), (1.0, 1.0), 1.0),
        "half": ((3.0, 3.0), (2.0, 2.0), 0.5),
        "worse": ((2.0, 2.0), (3.0, 3.0), -1.0),
        "below noise": ((3.0, 3.0), (0.5, 0.5), 1.0),
        "no gap": ((0.9, 1.0), (0.5, 0.5), math.nan),
        "noise": ((1.0, 1.0), (1.0, 1.0), math.nan),
        "no prediction": ((2.0, 3.0), (math.inf, 1.0), math.nan),
    },
)
def test_a_closure_is_the_part_of_the_gap_that_went_if_there_was_any(before, after, closed):
    found = held_out_gap_closure(loss(*before), loss(*after))
    assert (found.fraction, found.ci_low, found.ci_high) == pytest.approx((closed, closed, closed), nan_ok=True)


def bootstrapped(before: HeldOutLoss, after: HeldOutLoss):
    """95 % interval of the closure over resampled blocks, the same for both losses, those without a gap left out."""
    count = len(before.block_sample_counts)
    ratios = []
    for at in np.random.default_rng(0).integers(0, count, (1000, count)):
        g0, g1 = (max(of.block_chi2[at].sum() / of.block_sample_counts[at].sum() - 1, 0.0) for of in (before, after))
        ratios += [1 - g1 / g0] if g0 > 0 else []
    return np.quantile(ratios, (0.025, 0.975))


def test_the_interval_of_a_closure_is_that_of_95_percent_over_paired_blocks():
    """Of blocks in which the gap differs much and what is left of it follows, and of few with a gap at all."""
    rng = np.random.default_rng(3)
    size = rng.uniform(0.5, 6.0, 20)
    left = 1 + 0.4 * (size - 1) + 0.1 * rng.standard_normal(20)
    counts = rng.integers(50, 150, 20).astype(float)
    noisy = [HeldOutLoss(of * counts, counts, {}, math.nan) for of in (size, left)]
    for pair in (noisy, (loss(0.1, 4.0, 0.2), loss(0.1, 1.5, 0.2))):
        found = held_out_gap_closure(*pair)
        np.testing.assert_allclose([found.ci_low, found.ci_high], bootstrapped(*pair), rtol=1e-12)
        assert found.ci_low < found.ci_high <= 1.0


def test_a_gain_has_the_standard_error_of_its_sum_over_blocks():
    before, after = loss(3.0, 4.0, 2.0, count=10.0), loss(2.0, 2.0, 2.0, count=10.0)
    gained, error = chi2_per_sample_decrease_and_std_error(before, after)
    assert gained == pytest.approx(1.0)
    # blocks differ by 10, 20 and 0: their standard deviation is 10, and there are three of them
    assert error == pytest.approx(math.sqrt(3) * 10.0 / 30.0)
    assert chi2_per_sample_decrease_and_std_error(after, before) == pytest.approx((-gained, error))


SMALL = effect("small@x", amplitude())
LARGE = effect("large@x", amplitude("a"), amplitude("b"))
WIDE = effect("wide@x", amplitude("a"), shape("s", expected=(0.1, 1.0)))


def there(of, *means, **values):
    """A fit whose effect is surely there."""
    sizes = {f"{of.label}.{q.name}": 1.0 for q in of.definitions if not q.is_shape_parameter}
    return fit([of], loss(*means), values=sizes | {f"{of.label}.{name}": value for name, value in values.items()})


def labels(fits):
    return [entry.effects[-1].label for entry in fits]


def nearest(fits, limits=LIMITS, nominal=None):
    """Labels of the models that do as well as the best; little is explained unless a nominal model says more."""
    return labels(found for found, _ in select._near_best_models(nominal or fit((), loss(1.0, 1.0)), fits, limits))


@cases(
    "small, large, expected",
    {
        "within its error": ((1.1, 1.3, 1.0, 1.2), (1.2, 1.0, 1.2, 1.12), ["small@x", "large@x"]),
        "sure": ((1.2, 1.2, 1.2), (1.1, 1.1, 1.1), ["large@x"]),
        "all recordings together": ((1.01, 1.01), (1.0, 1.0), ["small@x", "large@x"]),
        "not predicted": ((math.inf, 1.2, 1.2), (1.1, 1.1, 1.1), ["large@x"]),
    },
)
def test_the_simplest_within_reach_of_the_best_comes_first(small, large, expected):
    fits = [replace(there(of, *own), residual_count=100) for of, own in ((LARGE, large), (SMALL, small))]
    assert nearest(fits) == expected
    assert nearest(fits[::-1]) == expected


@cases(
    "level, ratio, expected",
    {
        "worse in every block": (163.0, 1.2, ["small@x"]),
        "worse in one loud block alone": (163.0, 1.0, ["large@x", "small@x"]),
        "worse where noise is left alone": (0.9, 1.0, ["large@x", "small@x"]),
    },
)
def test_a_rival_that_is_worse_in_all_blocks_is_told_apart_however_loud_one_block_is(level, ratio, expected):
    """195 beside 163: a block of half of all squares makes the standard error of the sum as large as the difference."""
    blocks = [level / 2] * 19 + [level * 10.5] if level > 1 else [level] * 20
    worse = [ratio * x for x in blocks[:-1]] + [1.2 * blocks[-1] if level > 1 else 1.02 * blocks[-1]]
    fits = [there(SMALL, *blocks), there(effect("large@x", amplitude()), *worse)]
    assert sorted(nearest(fits)) == expected


@pytest.mark.parametrize(("size", "expected"), [(1.5, ["small@x"]), (9.0, ["large@x"]), (0.0, ["large@x"])])
def test_where_a_gap_is_left_an_implausible_model_gives_way_to_one_that_explains_enough(size, expected):
    fits = [there(SMALL, 3.0, 3.1, a=size), there(LARGE, 4.0, 4.1)]
    assert nearest(fits, nominal=fit((), loss(30.0, 30.0))) == expected
    # nothing that is plausible explains three quarters
    assert nearest(fits, nominal=fit((), loss(9.0, 9.0))) == ["small@x"]
    # what leaves noise is judged by all recordings
    quiet = [there(SMALL, 1.0, 1.0, a=size), there(LARGE, 4.0, 4.1)]
    assert nearest(quiet, nominal=fit((), loss(30.0, 30.0))) == ["small@x"]


@pytest.mark.parametrize(
    ("expected", "within", "beyond"),
    [
        ((0.1, 1.0), (0.05, 1.9), (0.049, 1.91)),
        ((0.0, 1.0), (-1.0, 2.0), (-1.01, 2.01)),
        ((-3.0, -1.0), (-5.0, 1.0), (-5.01, 1.01)),
    ],
)
def test_a_parameter_may_leave_its_range_by_a_factor_or_a_width(expected, within, beyond):
    for quantity in (shape("s", expected=expected, lower=-math.inf), amplitude("s", lower=-9.0, expected=expected)):
        of = effect("wide@x", amplitude(), quantity)
        exact = [there(of, 1.0, s=value) for value in (*within, *beyond)]
        exact = [replace(found, std=found.std | {"wide@x.s": 0.0}) for found in exact]
        assert [found.implausible_parameters(of, LIMITS) for found in exact] == [[], [], ["wide@x.s"], ["wide@x.s"]]


def test_a_value_that_may_as_well_lie_within_is_not_out_of_its_range():
    of = effect("wide@x", amplitude(), shape("s", expected=(0.1, 1.0), lower=-math.inf))
    for std, plausible in ((0.1, False), (0.54, False), (0.56, True), (math.inf, True)):
        found = fit([of], loss(1.0, 1.0), values={"wide@x.a": 1.0, "wide@x.s": 3.0}, std={"wide@x.s": std})
        assert (found.implausible_parameters(of, LIMITS) == []) is plausible


def ranked(**decreases):
    return [
        score(effect(f"{name}@x"), p=1e-9, decrease=decrease, step={f"{name}@x.a": decrease})
        for name, decrease in sorted(decreases.items(), key=lambda entry: -entry[1])
    ]


def one_round(nominal, fits, screened=None, **limits):
    """The effect that is selected of one round of refits, if any, and which candidates are refitted from where."""
    tried = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(select, "refit_with_each_effect", lambda _, base, chosen, start: tried.extend(chosen) or fits)
        search = Mock(thresholds=Thresholds(max_effects=1, **limits))
        seen = screened or screening([score(found.effects[-1]) for found in fits])
        return [entry.effect for entry in select.select_effects(search, nominal, seen)[1]], tried


def shortlisted(scores, table, **limits):
    screened = replace(table, candidate_scores=tuple(scores))
    return [of.kind for (of,), _ in one_round(fit(), [], screened, **limits)[1]]


def test_the_best_are_refitted_and_those_that_can_stand_in_for_them():
    scores = ranked(a=9.0, b=8.0, c=7.0, d=6.0, e=5.0)
    matrix = np.eye(5)
    matrix[0, 4] = matrix[1, 3] = 0.95
    matrix[2, 0] = 0.99
    table = alike([s.effect.label for s in scores], matrix)
    assert shortlisted(scores, table, n_refit_per_round=2) == ["a", "b", "d", "e"]
    assert shortlisted(scores, table, n_refit_per_round=1) == ["a", "e"]
    assert shortlisted(scores, table, n_refit_per_round=2, signature_overlap=0.96) == ["a", "b"]
    assert shortlisted(scores, table, n_refit_per_round=9) == ["a", "b", "c", "d", "e"]
    assert shortlisted(scores[:4], table, n_refit_per_round=2) == ["a", "b", "d"]
    matrix[0, 2:] = matrix[1, 2:] = 0.95
    many = alike([s.effect.label for s in scores], matrix)
    assert shortlisted(scores, many, n_refit_per_round=2) == ["a", "b", "c", "d"], "as many more, and each once"
    [((of,), step), *_] = one_round(fit(), [], replace(many, candidate_scores=tuple(scores)))[1]
    assert (of.kind, step) == ("a", {"a@x.a": 9.0})


A, B, C = EFFECTS = [effect(f"{name}@x", amplitude()) for name in "abc"]


class Rounds:
    """A search whose refits' held-out losses are given by the effects' kinds; remembers what was asked."""

    def __init__(self, monkeypatch, losses, p_values=(1e-9,) * 3, **how):
        self.losses, self.refits, self.screens, self.heard = losses, [], [], Heard()
        usual = {"fails": (), "absent": (), "before": None, "pairs": (), "left": None, "cost": 1.0, "noisy": False}
        vars(self).update(usual | how)
        self.scores = tuple(map(lambda of, p, by: score(of, p=p, decrease=by), EFFECTS, p_values, (19.0, 18.0, 17.0)))
        self.progress, self.skipped, self.is_late, self.checked = self.heard, [], False, []
        monkeypatch.setattr(select, "refit_with_each_effect", self.refit_all)

    def is_skipped_past_deadline(self, *what):
        self.skipped += what if self.is_late else ()
        return self.is_late

    def fit(self, effects):
        known = "".join(sorted(of.kind for of in effects))
        values = {f"{of.label}.a": 0.0 if of.kind in self.absent else 1.0 for of in effects}
        return fit(effects, loss(*self.losses[known]), self.cost, {"k": float(len(effects)), **values})

    def check_discretisation(self, fit, gap):
        self.checked.append((round(fit.values["k"]), gap, len(self.refits)))

    def screened(self, base=()):
        labels = {of.label for of in base}
        left = tuple(s for s in self.scores if s.effect.label not in labels)
        if base and self.left is not None:
            left = tuple(replace(s, p_value=self.left) for s in left)
        return screening(left)

    def rank_candidate_pairs(self, screened, without=""):
        kinds = {of.kind: of for of in EFFECTS if of.label != without}
        pairs = [(one, other) for one, other in self.pairs if {one, other} <= set(kinds)]
        return [((kinds[one], kinds[other]), {}, 17.0) for one, other in pairs]

    def screen(self, base, values, name):
        if not values and self.before is None:
            return EMPTY_SCREENING_RESULT  # it snaps
        self.screens.append(([of.kind for of in base], values.get("k"), name))
        return self.screened(base)

    def refit_all(self, search, base, tried, values, where=""):
        if where == "together":
            if tried:
                self.refits.append((["".join(of.kind for of in pair) for pair, _ in tried], values.get("k")))
            return [self.fit(pair) for pair, _ in tried]
        self.refits.append(([of.kind for of in base], [of.kind for (of,), _ in tried], values.get("k")))
        known = [(*base, of) for (of,), _ in tried]
        if where.startswith("from"):
            before = self.before
            lost = [(of, before.get(of.kind, (9.0, 9.2)), 0.5 if of.kind in before else 2.0) for (of,) in known]
            return [fit([of], loss(*own), cost, {"k": 7.0, f"{of.label}.a": 1.0}) for of, own, cost in lost]
        return [self.fit(effects) for effects in known if "".join(sorted(e.kind for e in effects)) in self.losses]

    def refit(self, effects, start, name):
        self.refits.append((name, [of.kind for of in effects], start["k"]))
        kinds = "".join(sorted(of.kind for of in effects))
        return None if kinds in self.fails else self.fit(effects)

    def compose(self, moved=False, is_late=False, far=False, **limits):
        self.thresholds, self.is_late = Thresholds(**limits), is_late
        problem = SimpleNamespace(has_process_noise=self.noisy)
        nominal = fit((), loss(*self.losses[""]), self.cost, {"k": 0.0}, problem=problem)
        first, added, self.model_error_std = select.select_effects(self, nominal, self.screened(), moved, far)
        return [f.effects[0].kind for f in first], [entry.effect.kind for entry in added], added


def test_one_effect_that_leaves_no_gap_is_enough(monkeypatch):
    rounds = Rounds(monkeypatch, {"": (3.0, 3.2), "a": (1.0, 1.1), "b": (2.0, 2.2), "c": (1.5, 1.7)}, cost=200.0)
    first, chosen, added = rounds.compose()
    assert (first, chosen) == (["a", "c", "b"], ["a"])
    assert rounds.refits == [([], ["a", "b", "c"], 0.0)]
    assert rounds.screens == []
    assert added[0].cumulative_closure.fraction == pytest.approx(1 - 0.05 / 2.1)
    assert [of.kind for of in added[0].equivalent_effects] == ["a"]
    assert [("a@x" in stage, "97.6 %" in stage) for stage in rounds.heard.stages] == [(True, True)]


def test_a_search_out_of_time_keeps_what_it_has_and_says_what_it_leaves(monkeypatch):
    losses = {"": (3.0, 3.2), "a": (2.0, 2.2), "b": (2.9, 3.1), "c": (2.9, 3.1)}
    rounds = Rounds(monkeypatch, losses, before={}, left=1e-3)
    first, chosen, _ = rounds.compose(moved=True, is_late=True)
    assert (first, chosen) == (["a", "b", "c"], ["a"])
    assert [("initial values" in text, "beside a@x" in text) for text in rounds.skipped] == [
        (True, False),
        (False, True),
    ]
    assert rounds.screens == []


@cases("left, kept", {"noise: what looks alike": (1.0, ["a", "b"]), "a gap: any": (1.5, ["a", "b", "c"])})
def test_what_was_not_tried_stays_beside_what_was_added_if_it_may_be_better(monkeypatch, left, kept):
    rounds = Rounds(monkeypatch, {"": (3.0, 3.2), "a": (left, 1.1)}, left=1e-3)
    shared = alike(["a@x", "b@x", "c@x"], [[1.0, 0.95, 0.1], [0.95, 1.0, 0.1], [0.1, 0.1, 1.0]])
    seen = rounds.screened
    monkeypatch.setattr(
        rounds, "screened", lambda *base: replace(shared, candidate_scores=seen(*base).candidate_scores)
    )
    tried = rounds.refit_all

    def first_alone(search, base, *rest):
        search.skipped.extend(["b@x", "c@x"])
        return tried(search, base, *rest)

    monkeypatch.setattr(select, "refit_with_each_effect", first_alone)
    [entry] = rounds.compose(is_late=True)[2]
    assert [of.kind for of in entry.equivalent_effects] == kept


@cases("cost, goes_on", {"less than three quarters": (12.6, False), "three quarters": (12.5, True)})
def test_where_a_second_effect_does_not_promise_to_explain_a_gap_nothing_more_is_refitted(monkeypatch, cost, goes_on):
    """It promises 18 of r'r; the excess over the one residual there is is 2 cost - 1."""
    losses = {"": (3.0, 3.2), "a": (2.2, 2.2), "b": (2.9, 3.1), "c": (2.9, 3.1), "bc": (2.9, 3.1)}
    rounds = Rounds(monkeypatch, losses, cost=cost, pairs=[("b", "c")])
    _, chosen, _ = rounds.compose()
    assert chosen == ["a"]
    assert [kinds for kinds, *_ in rounds.screens] == [["a"]]
    assert rounds.checked == [(1, 18.0, 1)], "before that, whether the discretisation explains what the effect leaves"
    assert (len(rounds.refits) > 1) is goes_on


def test_where_a_fit_has_left_an_earlier_run_candidates_are_tried_from_there_too(monkeypatch):
    """Each keeps the likelier of its two fits: b's from before, whatever its held-out loss, and a's from the fit."""
    losses = {"": (3.0, 3.2), "a": (2.0, 2.2), "b": (2.5, 2.7), "c": (2.6, 2.8)}
    rounds = Rounds(monkeypatch, losses, before={"b": (1.0, 1.1)}, left=1e-3)
    first, chosen, added = rounds.compose(moved=True, min_log_bayes_factor=10.0)
    assert (first, chosen) == (["b", "a", "c"], ["b"])
    assert rounds.refits == [([], ["a", "b", "c"], 0.0), ([], ["a", "b", "c"], None)]
    assert added[0].refitted_model.values["k"] == 7.0
    # once an effect is in, and where the earlier run's model does not run, nothing is tried from there
    assert Rounds(monkeypatch, losses).compose(moved=True)[1] == ["a"]


@cases("left, chosen", {"a gap": (2.0, "b"), "noise": (1.0, "a")})
def test_a_nominal_fit_far_from_its_start_is_no_start_for_effects_that_leave_a_gap(monkeypatch, left, chosen):
    losses = {"": (3.0, 3.2), "a": (left, left + 0.1), "b": (2.5, 2.7), "c": (2.6, 2.8)}
    rounds = Rounds(monkeypatch, losses, before={"b": (1.0, 1.1)}, left=1e-3, cost=200.0)
    assert rounds.compose(far=True, min_log_bayes_factor=10.0)[1] == [chosen]
    assert len(rounds.refits) == (2 if chosen == "b" else 1)


GROWING = {"": 5.0, "a": 3.0, "b": 4.0, "c": 4.5, "ab": 1.8, "ac": 2.1, "abc": 1.3, "bc": 3.5}
GROWING = {kinds: (chi2, chi2 + 0.2) for kinds, chi2 in GROWING.items()}


def test_effects_are_added_while_the_gap_closes(monkeypatch):
    rounds = Rounds(monkeypatch, GROWING)
    first, chosen, added = rounds.compose()
    assert (first, chosen) == (["a", "b", "c"], ["a", "b", "c"])
    assert rounds.refits[:3] == [([], ["a", "b", "c"], 0.0), (["a"], ["b", "c"], 1.0), (["a", "b"], ["c"], 2.0)]
    assert [screened[:2] for screened in rounds.screens[:2]] == [(["a"], 1.0), (["a", "b"], 2.0)]
    closed = [entry.cumulative_closure.fraction for entry in added]
    assert closed == pytest.approx([1 - 2.1 / 4.1, 1 - 0.9 / 4.1, 1 - 0.4 / 4.1])
    assert [len(entry.refitted_model.effects) for entry in added] == [1, 2, 3]
    assert "scoring further effects beside a@x and b@x" in rounds.heard.stages
    alone = [what for what, *_ in rounds.refits[3:] if "without" in what]
    assert alone == [f"a@x and b@x and c@x without {one}@x" for one in "ab"], "the last one has just been tried there"


def test_no_more_effects_than_allowed_nor_than_are_significant(monkeypatch):
    assert Rounds(monkeypatch, GROWING).compose(max_effects=2)[1] == ["a", "b"]
    assert Rounds(monkeypatch, GROWING).compose(max_effects=1)[1] == ["a"]
    rounds = Rounds(monkeypatch, GROWING, p_values=(1e-9, 0.01, 0.009))
    assert rounds.compose()[1] == ["a", "c"]
    assert rounds.refits[0] == ([], ["a", "c"], 0.0)
    assert Rounds(monkeypatch, GROWING, p_values=(0.02, 0.03, 0.04)).compose() == ([], [], ())


def test_what_is_added_to_others_is_of_a_size_to_be_expected(monkeypatch):
    rounds = Rounds(monkeypatch, GROWING)
    monkeypatch.setattr(RefitStatistics, "implausible_parameters", lambda _, of, limits: ["a"] * (of.kind == "b"))
    assert rounds.compose()[1] == ["a", "c"]
    # the first one may be larger, and what is in the place of one that is may be too
    assert Rounds(monkeypatch, {**GROWING, "b": (1.0, 1.1)}).compose()[1] == ["b"]


def test_where_a_gap_is_left_an_estimate_is_as_unsure_as_further_effects_make_it(monkeypatch):
    rounds = Rounds(monkeypatch, GROWING)
    assert (rounds.compose(max_effects=1)[1], rounds.model_error_std) == (["a"], {"a@x.a": 0.0})
    moved = {"ab": 1.3, "ac": 0.6, "bc": 9.0, "abc": 9.0}

    def unsure(**losses):
        rounds = Rounds(monkeypatch, GROWING | {"ab": (3.1, 3.2), "ac": (3.1, 3.2), "bc": (3.1, 3.2)} | losses)
        fitted, rounds.pairs = rounds.fit, ("bc",)

        def elsewhere(effects):
            made, kinds = fitted(effects), "".join(of.kind for of in effects)
            return replace(made, values=made.values | {"a@x.a": moved.get(kinds, 1.0)})

        monkeypatch.setattr(rounds, "fit", elsewhere)
        rounds.compose(max_effects=2)
        return rounds.model_error_std

    assert unsure() == {"a@x.a": pytest.approx(math.sqrt(0.125))}
    assert unsure(a=(1.0, 1.0)) == {}, "what leaves only noise"
    monkeypatch.setattr(RefitStatistics, "implausible_parameters", lambda _, of, limits: ["a"] * (of.kind == "b"))
    assert unsure() == {"a@x.a": pytest.approx(0.4)}


LITTLE = {"": (1.6, 1.8), "a": (1.04, 1.14), "b": (2.0, 2.2), "c": (2.5, 2.7), "ab": (1.0, 1.0), "ac": (1.0, 1.0)}


@pytest.mark.parametrize(("least", "whole", "chosen"), [(0.1, 1.7, "a"), (0.05, 1.7, "ab"), (0.05, 228, "ab")])
def test_a_rest_that_is_hardly_more_than_noise_is_left(monkeypatch, least, whole, chosen):
    """9 % more than noise, which both others would close."""
    rounds = Rounds(monkeypatch, LITTLE | {"": (whole, whole)}, left=1e-9)
    assert "".join(rounds.compose(min_excess_chi2_per_dof=least)[1]) == chosen


@cases(
    "nominal, best, chosen",
    {
        "everywhere": ((3.0, 3.0, 3.0), (2.4, 2.4, 2.4), ["a"]),
        "everywhere, but little": ((3.0, 3.0, 3.0), (2.6, 2.6, 2.6), []),
        "not sure": ((3.0, 5.0, 3.0), (4.4, 2.5, 2.9), []),
        "no gap": ((0.9, 1.0, 1.0), (0.88, 0.98, 0.98), []),
        "likelier": ((1.0, 1.0, 1.0), (0.9, 0.99, 1.0), ["a"]),
        "likelier in one block": ((1.2, 1.0, 1.0), (1.0, 1.01, 1.02), ["a"]),
    },
)
def test_an_effect_must_close_a_sure_part_of_the_gap(monkeypatch, nominal, best, chosen):
    worse = tuple(9.0 for _ in nominal)
    rounds = Rounds(monkeypatch, {"": nominal, "a": best, "b": worse, "c": worse})
    first, found, _ = rounds.compose(max_effects=1)
    assert (found, first[0]) == (chosen, "a")


@cases(
    "before, after, sure",
    {
        "a fall by 15": ((1.05, 1.0), (0.9, 1.0), True),
        "a fall by 9": ((1.05, 1.0), (0.96, 1.0), False),
        "a fall by 19": ((1.19, 1.0), (1.0, 1.0), True),
        "chi2 tells enough of it": ((1.2, 1.0), (1.0, 1.0), False),
    },
)
def test_held_out_recordings_are_far_likelier_with_an_effect_that_leaves_noise(before, after, sure):
    nominal, found = fit((), loss(*before)), there(SMALL, *after)
    assert one_round(nominal, [found])[0] == ([SMALL] if sure else [])
    assert one_round(nominal, [found], min_log_bayes_factor=20.0)[0] == []


def test_where_noise_is_left_all_recordings_are_one_likelihood():
    """A spring that bends far away is an offset; chance alone may predict one motion better with it, by 2 here."""
    spring = fit([effect("spring@elbow", amplitude("a"), amplitude("b"))], loss(1.0, 1.0), cost=100.0)
    offset = fit([effect("offset@elbow")], loss(1.01, 1.01), cost=101.0)
    spring, offset = (replace(own, residual_count=100) for own in (spring, offset))
    assert chi2_per_sample_decrease_and_std_error(offset.held_out_loss, spring.held_out_loss) == pytest.approx(
        (0.01, 0.0)
    )
    # 4 more of r'r; a parameter less is worth the logarithm of a hundred
    assert select.bic_difference(offset, spring) == pytest.approx(4.0 - math.log(100.0))
    assert nearest([spring, offset]) == ["offset@elbow", "spring@elbow"]
    # uncertain parameters predict badly; a fit to all recordings would change them
    updated = replace(spring, held_out_loss=replace(spring.held_out_loss, updated_chi2=150.0))
    assert select.bic_difference(updated, spring) == pytest.approx(150.0 - spring.held_out_loss.total_chi2)
    # the contradiction of a baseline is already a part of the cost
    shifted = replace(spring, held_out_loss=replace(spring.held_out_loss, baseline_chi2=9.0))
    assert select.bic_difference(shifted, spring) == 0.0
    assert nearest([spring, replace(offset, cost=101.5)]) == ["spring@elbow", "offset@elbow"]
    # up to odds of 150 to 1, half as sure as the difference
    assert nearest([spring, replace(offset, cost=111.2)]) == ["spring@elbow", "offset@elbow"]
    assert nearest([spring, replace(offset, cost=111.4)]) == ["spring@elbow"]
    # a model's response to an effect is known to a twentieth, so a 400th of what is explained proves nothing
    for cost, found in ((4775.0, ["spring@elbow"]), (4790.0, ["spring@elbow", "offset@elbow"])):
        whole = replace(fit((), loss(1.0, 1.0), cost=cost), residual_count=100)
        assert nearest([spring, replace(offset, cost=113.0)], nominal=whole) == found
    # the likeliest of all recordings counts, whatever is ahead on those held out
    ahead, true = fit([effect("ahead@elbow")], loss(0.9, 1.0), cost=130.0), fit([effect("true@elbow")], loss(1.0, 0.95))
    assert nearest([ahead, replace(true, cost=100.0)]) == ["true@elbow"]
    # where more than noise is left, squares are errors of the model
    spring, offset = (replace(own, values=dict.fromkeys(own.values, 0.5)) for own in (spring, offset))
    rough = replace(spring, held_out_loss=loss(1.2, 1.2))
    assert nearest([rough, replace(offset, held_out_loss=loss(1.21, 1.21))]) == ["spring@elbow"]
    found = nearest([replace(rough, cost=1e3), replace(offset, held_out_loss=loss(1.2, 1.2))])
    assert found == ["offset@elbow", "spring@elbow"]


EACH_LEFT_OUT = [("b@x and c@x without b@x", ["c"], 2.0), (["c"], ["a"], 1.0)]
EACH_LEFT_OUT += [("b@x and c@x without c@x", ["b"], 2.0), (["b"], ["a"], 1.0)]


def test_an_effect_that_others_make_superfluous_is_left_out_again(monkeypatch):
    rounds = Rounds(monkeypatch, GROWING | {"bc": (1.4, 1.6), "b": (4.0, 4.2)})
    _, chosen, added = rounds.compose()
    assert chosen == ["b", "c"]
    assert [len(entry.refitted_model.effects) for entry in added] == [1, 2]
    assert added[1].refitted_model.held_out_loss.chi2_per_sample == pytest.approx(1.5)
    assert [entry.cumulative_closure.fraction for entry in added] == pytest.approx([1 - 3.1 / 4.1, 1 - 0.5 / 4.1])
    assert rounds.refits[3:] == [("a@x and b@x and c@x without a@x", ["b", "c"], 3.0), *EACH_LEFT_OUT], (
        "without each, and others in its place, as both stand in another company than when they were added"
    )
    assert [entry.effect for entry in added] == [B, C]
    assert "removed a@x, because the other effects explain as much without it" in rounds.heard.stages


def test_an_effect_that_is_not_there_any_more_beside_another_is_left_out_again(monkeypatch):
    rounds = Rounds(monkeypatch, GROWING)
    fitted = rounds.fit

    def without_a(effects):
        rounds.absent = ("a",) if len(effects) == 2 else ()
        return fitted(effects)

    monkeypatch.setattr(rounds, "fit", without_a)
    assert rounds.compose(max_effects=2)[1] == ["b"]


def test_the_last_of_three_may_make_both_others_superfluous(monkeypatch):
    rounds = Rounds(monkeypatch, GROWING | {"bc": (1.4, 1.6), "c": (1.3, 1.5)}, p_values=(1e-9, 1e-9, 1e-9))
    rounds.scores = rounds.scores[:2]
    # the third candidate shows only once two are in the model
    usual, last = rounds.screened, screening([score(C, p=1e-9)])
    monkeypatch.setattr(rounds, "screened", lambda base=(): usual(base) if len(base) < 2 else last)
    first, chosen, added = rounds.compose()
    assert chosen == ["c"]
    assert added[0].cumulative_closure.fraction == pytest.approx(1 - 0.4 / 4.1)
    assert first == ["c", "a", "b"], "what stays alone is said first, as it ended"


def test_a_later_effect_shows_what_an_earlier_one_stood_in_for(monkeypatch):
    # a looks best alone and b beside it; beside b, c does better than a
    rounds = Rounds(monkeypatch, GROWING | {"ab": (2.0, 2.2), "b": (3.4, 3.5), "bc": (1.2, 1.3)})
    _, chosen, added = rounds.compose(max_effects=2)
    assert chosen == ["b", "c"]
    assert added[-1].refitted_model.held_out_loss.chi2_per_sample == pytest.approx(1.25)
    assert [e.label for e in added[-1].refitted_model.effects] == ["b@x", "c@x"], "the last one comes last"
    assert [len(entry.refitted_model.effects) for entry in added] == [1, 2]
    assert "replaced a@x by c@x" in rounds.heard.stages
    assert [[of.kind for of in entry.equivalent_effects] for entry in added] == [["b"], ["c"]]


HIDDEN = GROWING | {"b": (9.0, 9.2), "c": (9.1, 9.3), "ab": (1.0, 5.0), "ac": (3.1, 3.3), "bc": (1.2, 1.3)}
"""Beside a, which stands in for b and c, neither is sure to help."""


def test_one_that_stands_in_for_two_gives_way_to_both(monkeypatch):
    assert Rounds(monkeypatch, HIDDEN).compose(max_effects=2)[1] == ["a"]
    rounds = Rounds(monkeypatch, HIDDEN, pairs=("ab", "bc"))
    first, chosen, added = rounds.compose(max_effects=2)
    assert first[0] == "a", "what alone does best is still said"
    assert chosen == ["b", "c"]
    assert added[-1].refitted_model.held_out_loss.chi2_per_sample == pytest.approx(1.25)
    assert [len(entry.refitted_model.effects) for entry in added] == [1, 2]
    assert "the model now has b@x and c@x (93.9 % of the held-out gap closed)" in rounds.heard.stages
    # from the nominal fit, without those that have the best one in them, which others are tried beside anyway
    assert rounds.refits[2] == (["bc"], 0.0)
    assert rounds.refits[3:] == EACH_LEFT_OUT, "others are tried in the place of either"


def test_a_pair_that_is_no_better_or_of_which_one_is_not_there_is_not_taken(monkeypatch):
    rounds = Rounds(monkeypatch, HIDDEN | {"bc": (3.0, 3.2)}, pairs=("bc",))
    assert rounds.compose(max_effects=2)[1] == ["a"]
    # what one effect explains to the noise is not looked at in pairs
    alone = Rounds(monkeypatch, HIDDEN | {"a": (1.0, 1.1), "bc": (0.9, 0.95)}, pairs=("bc",), left=1e-3)
    assert alone.compose()[1] == ["a"]
    for absent in "bc":
        rounds = Rounds(monkeypatch, HIDDEN, pairs=("bc",), absent=(absent,))
        assert rounds.compose(max_effects=2)[1] == ["a"]


def test_pairs_that_others_can_stand_in_for_are_not_refitted(monkeypatch):
    kinds = {name: effect(f"{name}@x", amplitude()) for name in "abcdef"}
    promised = [((kinds[one], kinds[other]), {}, 7.0 - i) for i, (one, other) in enumerate(PROMISED)]
    table = np.eye(6)
    table[3, 1] = 0.9  # d's signature is b's, not the other way round
    asked = []
    found = screening([score(of) for of in kinds.values()], table=table)
    name = "rank_candidate_pairs"
    monkeypatch.setattr(type(found), name, lambda _, without: asked.append(without) or promised)

    def to_refit(count):
        search = RefitContext(None, Thresholds(n_refit_pairs=count), Heard())
        return select._pairs_to_refit(search, found, kinds["a"])

    chosen = to_refit(3)
    assert asked == ["a@x"]
    assert ["".join(of.kind for of in pair) for pair, _ in chosen] == ["bc", "ef", "bd"]
    assert to_refit(0) == []


PROMISED = ("bc", "cd", "dc", "ef", "bd", "be")
"""cd and dc are bc again."""


def test_what_does_as_well_beside_the_others_is_a_rival(monkeypatch):
    losses = GROWING | {"ab": (2.0, 2.2), "b": (3.4, 3.5), "bc": (2.001, 2.201)}
    _, chosen, added = Rounds(monkeypatch, losses).compose(max_effects=2)
    assert chosen == ["a", "b"]
    assert [of.kind for of in added[0].equivalent_effects] == ["a", "c"]
    assert sum(added[0].shares.values()) == pytest.approx(1.0)
    assert added[0].shares["a@x"] > added[0].shares["c@x"] > 0.1, "the nearer, the likelier"
    rivals = [(effect("b@x"), 0.8), (effect("c@x"), 0.3)]
    effects, shares = select._equivalents_and_shares(effect("a@x"), rivals)
    assert [of.kind for of in effects] == ["a", "c"], "what is unlikely is not named"
    assert shares == pytest.approx({"a@x": 0.8055, "c@x": 0.1797}, abs=1e-4)


@pytest.mark.parametrize(("std", "there"), [(0.499, True), (0.51, False)])
def test_an_effect_within_two_standard_deviations_of_neutral_is_not_there(std, there):
    of = effect("wide@x", amplitude("a", neutral=1.0), shape("s"))
    nominal, found = fit((), loss(3.0, 3.2)), fit([of], values={"wide@x.a": 2.0}, std={"wide@x.a": std})
    assert one_round(nominal, [found])[0] == ([of] if there else [])
    assert one_round(nominal, [found], min_z=1.9)[0] == [of]
    # a shape that is not known next to nothing makes the amplitude no less sure
    unsure = fit([of], values=found.values, std={"wide@x.a": 9.0}, held={"wide@x.a": std})
    assert one_round(nominal, [unsure])[0] == ([of] if there else [])


def test_an_effect_that_is_not_there_is_not_added(monkeypatch):
    losses = {"": (3.0, 3.2), "a": (1.0, 1.1), "b": (2.0, 2.2), "c": (2.5, 2.7)}
    assert Rounds(monkeypatch, losses, absent=("a",)).compose()[1] == []
    tied = losses | {"b": (1.001, 1.101)}
    assert Rounds(monkeypatch, tied, absent=("a",)).compose()[1] == ["b"], "another that does as well may be there"


def test_what_contradicts_a_baseline_counts_whatever_blocks_are_drawn():
    counts = np.full(8, 10.0)
    before, after = (HeldOutLoss(of * counts, counts, {}, of * counts.sum(), by) for of, by in ((2, 800.0), (3, 0.0)))
    assert (before.chi2_per_sample, after.chi2_per_sample) == (12.0, 3.0)
    assert chi2_per_sample_decrease_and_std_error(before, after) == (pytest.approx(9.0), 0.0)
    found = held_out_gap_closure(before, after)
    assert (found.fraction, found.ci_low, found.ci_high) == pytest.approx((9 / 11, 9 / 11, 9 / 11))

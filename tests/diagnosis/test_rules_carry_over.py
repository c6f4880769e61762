"""Whether effects come out the same on other recordings, rule by rule."""

from __future__ import annotations

import math

import pytest
from factories import amplitude, carried, effect, fit, shape

from yid_ocp.diagnosis import transfer_check
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem
from yid_ocp.diagnosis.refit import RefitContext
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.diagnosis.transfer_check import (
    _compare_amplitudes,
    check_transfer,
    failed_transfer_checks,
    inflate_std_by_disagreement,
)
from yid_ocp.progress import NULL_PROGRESS

SPRING = effect("spring@elbow", amplitude("k", lower=-9.0, expected=(0.0, 10.0)), shape("s"))
SHIFT = effect(
    "shift@grasp",
    amplitude("x", lower=-9.0, expected=(-1.0, 1.0), unit="m"),
    amplitude("y", lower=-9.0, expected=(-1.0, 1.0), unit="m"),
)


def of(label, values, stds, effects=(SPRING,)):
    return fit(
        effects,
        values={f"{label}.{name}": value for name, value in values.items()},
        std={f"{label}.{name}": std for name, std in stds.items()},
    )


@pytest.mark.parametrize(
    ("first", "second", "agrees"),
    [
        # 3 apart, with 0.6 and 0.8 together 1: 3 standard deviations
        ((2.0, 0.6), (5.0, 0.8), True),
        ((2.0, 0.6), (5.4, 0.8), False),
        # sure, and by no more than three tenths of the larger
        ((10.0, 0.01), (7.1, 0.01), True),
        ((10.0, 0.01), (6.9, 0.01), False),
        ((6.9, 0.01), (10.0, 0.01), False),
        ((5.0, 0.01), (-5.0, 0.01), False),
        ((5.0, math.nan), (-5.0, 0.01), True),
        ((5.0, 0.01), (-5.0, math.inf), True),
    ],
)
def test_values_agree_within_their_errors_or_a_part_of_their_size(first, second, agrees):
    one, other = (of("spring@elbow", {"k": value}, {"k": std}) for value, std in (first, second))
    [entry] = _compare_amplitudes(SPRING, one, other, Thresholds(transfer_z_max=3.3))
    assert entry.is_consistent is agrees
    assert (entry.effect_label, entry.parameter, entry.unit) == ("spring@elbow", "k", "N m")
    assert (entry.estimation_value, entry.held_out_value) == (first[0], second[0])
    assert (entry.estimation_std, entry.held_out_std) == pytest.approx((first[1], second[1]), nan_ok=True)


def test_how_far_they_may_differ_is_two_thresholds():
    one, other = (of("spring@elbow", {"k": v}, {"k": 0.01}) for v in (10.0, 6.9))
    assert _compare_amplitudes(SPRING, one, other, Thresholds(transfer_rtol=0.32))[0].is_consistent
    assert _compare_amplitudes(SPRING, one, other, Thresholds(transfer_z_max=250.0))[0].is_consistent


def test_a_small_part_of_a_vector_may_differ_by_a_part_of_the_whole():
    stds = {"x": 1e-3, "y": 1e-3}
    one, other = (of("shift@grasp", values, stds, (SHIFT,)) for values in ({"x": 1.0, "y": 0.1}, {"x": 1.0, "y": -0.1}))
    assert [entry.is_consistent for entry in _compare_amplitudes(SHIFT, one, other)] == [True, True]
    far = of("shift@grasp", {"x": 1.0, "y": -0.3}, stds, (SHIFT,))
    assert [entry.is_consistent for entry in _compare_amplitudes(SHIFT, one, far)] == [True, False]


@pytest.mark.parametrize(
    ("first", "second", "std"),
    [
        # 2 apart: as likely as not with 0.6 and 0.8, together 1
        ((2.0, 0.6), (4.0, 0.8), 0.6),
        ((2.0, 0.6), (4.1, 0.8), 2.1 / math.sqrt(2)),
        ((4.1, 0.6), (2.0, 0.8), 2.1 / math.sqrt(2)),
        ((2.0, 1.6), (5.5, 0.1), 3.5 / math.sqrt(2)),
        ((2.0, math.inf), (5.0, 0.1), math.inf),
        ((2.0, 0.1), (5.0, math.nan), 0.1),
    ],
)
def test_standard_deviations_count_how_far_two_sets_of_recordings_are_apart(first, second, std):
    one, other = (of("spring@elbow", {"k": value, "s": 3.0}, {"k": size}) for value, size in (first, second))
    counted = inflate_std_by_disagreement(one, _compare_amplitudes(SPRING, one, other))
    assert counted.std == one.std | {"spring@elbow.k": pytest.approx(std)}
    assert counted.values == one.values
    again = inflate_std_by_disagreement(other, _compare_amplitudes(SPRING, other, one))
    reach = 2 * (counted.std["spring@elbow.k"] + again.std["spring@elbow.k"])
    assert not abs(first[0] - second[0]) > reach  # their intervals overlap


def test_those_that_do_not_carry_over_are_told():
    entries = (carried(agrees=True), carried(name="b"))
    assert failed_transfer_checks(entries) == entries[1:]


class Problem:
    """Episodes and held-out ones that can change places."""

    def __init__(self, episodes=("own",), held_out=("other",), disturbed=False):
        self.episodes, self.held_out, self.has_process_noise = episodes, held_out, disturbed
        self.free, self.weighted = ("k",), []

    def with_episodes(self, episodes, held_out):
        return Problem(episodes, held_out, self.has_process_noise)


def test_the_held_out_recordings_are_fitted_with_the_same_effects(monkeypatch):
    asked = []
    first = of("spring@elbow", {"k": 2.0}, {"k": 0.1})
    again = of("spring@elbow", {"k": 7.0}, {"k": 0.1})
    first.values.update({"k": 3.0, "start.tip[own]": 0.2})

    def refitted(problem, effects, start, store, name, limits):
        asked.append((problem.problem.episodes, problem.problem.held_out, effects, dict(start), store, name, limits))
        return again

    monkeypatch.setattr(transfer_check, "refit_with_effects", refitted)
    search = RefitContext(AllCandidatesProblem(Problem(), (SPRING,), False), Thresholds(), NULL_PROGRESS, "store")
    [entry] = check_transfer(search, first)
    assert (entry.estimation_value, entry.held_out_value, entry.is_consistent) == (2.0, 7.0, False)
    [(episodes, held_out, effects, start, store, name, limits)] = asked
    assert (episodes, held_out, effects, store, limits) == (("other",), ("own",), (SPRING,), "store", Thresholds())
    assert start == {"k": 3.0, "spring@elbow.k": 2.0, "spring@elbow.s": 0.5}, "no start of a single recording"
    assert name == "spring@elbow on the held-out recordings"


@pytest.mark.parametrize(("blocks", "effects"), [(True, (SPRING,)), (False, ())], ids=["in blocks", "no effect"])
def test_nothing_is_compared_where_there_is_nothing_to_compare(monkeypatch, blocks, effects):
    monkeypatch.setattr(transfer_check, "refit_with_effects", lambda *_: pytest.fail("not asked for"))
    search = RefitContext(AllCandidatesProblem(Problem(), (SPRING,), blocks), Thresholds(), NULL_PROGRESS)
    assert check_transfer(search, fit(effects)) == ()


def test_a_model_that_cannot_be_fitted_there_is_no_evidence(monkeypatch):
    monkeypatch.setattr(transfer_check, "refit_with_effects", lambda *_: None)
    search = RefitContext(AllCandidatesProblem(Problem(), (SPRING,), False), Thresholds(), NULL_PROGRESS)
    assert check_transfer(search, fit([SPRING])) == ()


def test_noise_that_drives_the_motion_weighs_there_too(monkeypatch):
    problem = Problem(disturbed=True)
    seen = []
    composed = AllCandidatesProblem(problem, (SPRING,), False)
    monkeypatch.setattr(
        AllCandidatesProblem, "whitened_at", lambda self, values: seen.append(dict(values)) or "weighted"
    )
    monkeypatch.setattr(AllCandidatesProblem, "nominal_parameters", ("k",), raising=False)
    monkeypatch.setattr(transfer_check, "_shared", lambda turned, fitted: {})
    asked = []
    monkeypatch.setattr(transfer_check, "refit_with_effects", lambda problem, *_: asked.append(problem))
    check_transfer(RefitContext(composed, Thresholds(), NULL_PROGRESS), fit([SPRING], values={"k": 4.0}))
    assert asked == ["weighted"]
    assert seen[0]["k"] == 4.0

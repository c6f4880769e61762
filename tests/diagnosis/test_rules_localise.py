"""Where a gap lies and when: rule by rule."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from factories import BIAS, FORCE, OFFSET, OTHER_FORCE, cases, place, smoothed, trace

from yid_ocp.inference.smoother import (
    gap_locations_by_smoother_evidence,
    gap_locations_from_closures_and_smoother,
    merge_time_intervals,
    smoothed_unknown_units,
    smoothed_unknown_z_scores,
)
from yid_ocp.inference.smoother_model import SmoothedUnknownGroup
from yid_ocp.model.mechanism import Joint, Mechanism, Placement

TWIST = SmoothedUnknownGroup("T1", "bias")
NONE = {FORCE: 0.0, OTHER_FORCE: 0.0}
THREE_TO_ONE = [("T1", 0.75, True), ("T2", 0.25, True)]


def described(places):
    return [(p.location, pytest.approx(p.gap_share), p.is_observable) for p in places]


@cases(
    "weight, detectable, expected",
    {
        "by evidence": ({FORCE: 3.0, OTHER_FORCE: 1.0}, {}, THREE_TO_ONE),
        "unknowns of one place add": ({FORCE: 1.0, TWIST: 2.0, OTHER_FORCE: 1.0}, {}, THREE_TO_ONE),
        "none, one would have shown": (NONE, {FORCE: 0.5, OTHER_FORCE: 2.0}, [("T1", 0.0, True), ("T2", 0.0, False)]),
        "reference size does not show": (NONE, {FORCE: 1.0, OTHER_FORCE: 0.9}, [("T2", 0.0, True), ("T1", 0.0, False)]),
        "one of two would have shown": ({FORCE: 0.0, TWIST: 0.0}, {FORCE: 0.5, TWIST: 2.0}, [("T1", 0.0, True)]),
        "what is there shows": ({FORCE: 2.0}, {FORCE: 5.0}, [("T1", 1.0, True)]),
    },
)
def test_places_share_the_gap_by_their_evidence(weight, detectable, expected):
    found = smoothed(weight, detectable=dict.fromkeys(weight, 0.5) | detectable)
    assert described(gap_locations_by_smoother_evidence(found)) == expected


def test_a_gap_is_there_when_an_unknown_is_surely_not_zero():
    traces = [
        trace([FORCE, OTHER_FORCE], [[3.1, 0.0], [-3.1, 0.0], [2.9, 9.0], [3.1, 0.0]], np.ones((4, 2))),
        trace([OTHER_FORCE], [[0.0], [9.0]], np.ones((2, 1)), recording="second"),
    ]
    seen = smoothed({FORCE: 3.0, OTHER_FORCE: 1.0}, traces=traces)
    found = {p.location: p.time_windows for p in gap_locations_by_smoother_evidence(seen)}
    assert found == {"T1": ((0.0, 1.0), (1.5, 2.0)), "T2": ((0.5, 1.5),)}


@cases(
    "spans, expected",
    {
        "none": ([], ()),
        "touching": ([(1.0, 2.0), (0.0, 1.0)], ((0.0, 2.0),)),
        "touching up to rounding": ([(0.0, 1.0), (1.0 + 1e-10, 2.0)], ((0.0, 2.0),)),
        "apart": ([(0.0, 1.0), (1.0 + 1e-06, 2.0)], ((0.0, 1.0), (1.0 + 1e-06, 2.0))),
        "overlapping": ([(2.0, 3.0), (0.0, 0.5), (2.5, 4.0)], ((0.0, 0.5), (2.0, 4.0))),
    },
)
def test_touching_spans_are_one_stretch(spans, expected):
    assert merge_time_intervals(spans) == expected


T1, T2, T3 = place("T1"), place("T2"), place("T3")


@cases(
    "before, closed, rest, expected",
    {
        "all": (T1, {"T1": 1.0}, [], [("T1", 1.0, True)]),
        "what is left goes to its places": (T1, {"T1": 0.6}, [T2], [("T1", 0.6, True), ("T2", 0.4, False)]),
        "what is left of an effect's own place": (
            T1,
            {"T1": 0.6},
            [place("T1", 0.5), place("T2", 0.5)],
            [("T1", 0.8, True), ("T2", 0.2, False)],
        ),
        "more than all": (T1, {"T1": 0.9, "T2": 0.3}, [T3], [("T1", 0.75, True), ("T2", 0.25, True), ("T3", 0, False)]),
        "nothing is left to be seen": (T1, {"T1": 0.5}, [], [("T1", 1.0, True)]),
        "an unseen place": (place("T1", observable=False), {"T2": 0.5}, [], [("T2", 1.0, True), ("T1", 0.0, False)]),
        "a place without an effect": (T1, {"T2": 0.5}, [], [("T2", 1.0, True), ("T1", 0.0, True)]),
        "nothing closed": (T1, {"world": 0.0}, [], [("T1", 0.0, True), ("world", 0.0, True)]),
    },
)
def test_places_of_effects_share_by_what_they_close(before, closed, rest, expected):
    found = described(gap_locations_from_closures_and_smoother([before], closed, rest, ()))
    assert sorted(found, key=lambda p: p[0]) == sorted(expected, key=lambda p: p[0])
    shares = [share.expected for _, share, _ in found]
    assert shares == sorted(shares, reverse=True)


def test_places_keep_their_windows_and_those_without_unknowns_take_the_residuals():
    seen, residual = ((0.0, 1.0),), ((2.0, 3.0),)
    before = [place("T1", windows=seen), place("T2")]
    found = {
        p.location: p.time_windows
        for p in gap_locations_from_closures_and_smoother(before, {"T1": 0.5, "world": 0.2}, [place("T3")], residual)
    }
    assert found == {"T1": seen, "world": residual, "T2": (), "T3": ()}
    [whole] = gap_locations_from_closures_and_smoother([place("T2")], {"T2": 1.0}, [], residual)
    assert whole.time_windows == residual


@cases(
    "variance, std, mean, expected",
    {
        "informed": (4.0, 1.0, 3.0, 3.0),
        "at the limit": (2.0, 1.0, 3.0, math.nan),
        "just above": (2.1, 1.0, 3.0, 3.0),
        "not at work": (0.0, 1.0, 3.0, math.nan),
        "not informed": (1.0, 0.9, 3.0, math.nan),
    },
)
def test_only_informed_values_are_on_the_map(variance, std, mean, expected):
    found = smoothed({FORCE: 1.0}, variance={FORCE: variance}, traces=[trace([FORCE], [[mean]], [[std]])])
    np.testing.assert_allclose(smoothed_unknown_z_scores(found, found.smoothed_unknowns[0]), [[expected]])


def test_units_of_unknowns_are_those_of_their_joints_or_metres():
    kinds = {"slide": "prismatic", "hinge": "revolute"}
    joints = (Joint(name, kind, -1, Placement.identity(), (0.0, 0.0, 1.0)) for name, kind in kinds.items())
    system = SimpleNamespace(mechanism=Mechanism("made", tuple(joints), {}))
    made = SimpleNamespace(
        unknown_names=("hinge", "slide", "left.x", "tip.z"), unknown_groups=(FORCE, FORCE, OFFSET, BIAS)
    )
    assert smoothed_unknown_units(system, made) == ("N m", "N", "m", "m")

"""The source paper's answers, and the one sentence that is said of each."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from made_models import estimate

from yid_ocp.analysis import compare as module
from yid_ocp.analysis.compare import (
    _PAPER_PARAMETERS,
    _TRUTH_EXPERIMENT,
    PAPER_ESTIMATES,
    _load_torque_ensemble,
    explain_paper_estimates,
    is_within_ensemble_range,
)


def test_the_papers_answers():
    """Tables of the source paper [N m/rad], thousandths as whole numbers."""
    told = {name: [round(1000 * value) for value in values.values()] for name, values in PAPER_ESTIMATES.items()}
    assert told == {
        "single_arm_no_vision": [23780, 0, 18357, 11103, 3200, 3059],
        "single_arm_vision": [22270, 13593, 10735, 8202, 11511, 9692],
        "dual_arm_no_vision": [19559, 4965, 8575, 10374, 0, 11287],
        "dual_arm_vision": [24840, 0, 12373, 30775, 1406, 24900],
    }
    for values in PAPER_ESTIMATES.values():
        assert tuple(values) == ("T1.bend", "T1.twist", "T2.bend", "T2.twist", "T3.bend", "T3.twist")


# -- what they rest on ------------------------------------------------------------------------------------------------


def test_the_ensemble_covers_every_published_value():
    found = _load_torque_ensemble()
    assert set(found) == set(PAPER_ESTIMATES)
    for by_errors in found.values():
        assert {"none", "offsets"} <= set(by_errors)
        for values in by_errors.values():
            assert tuple(values) == _PAPER_PARAMETERS
            assert all(np.all(np.isfinite(members)) and min(members) >= 0 for members in values.values())
        assert {len(members) for members in by_errors["offsets"].values()} == {len(by_errors["offsets"]["T1.bend"])}
        assert len(by_errors["offsets"]["T1.bend"]) >= 4
        # a point grasp hides these from any torque, so that no search moves them
        for name in ("T2.twist", "T3.twist"):
            assert by_errors["offsets"][name] == pytest.approx([3.0] * len(by_errors["offsets"][name]), abs=0.2)


@pytest.mark.parametrize(("least", "expected"), [(0.04, True), (0.06, False)])
def test_a_published_zero_is_explained_by_members_at_the_bound(least, expected):
    assert is_within_ensemble_range(0.0, [least, 5.0]) is expected


# -- the decision -----------------------------------------------------------------------------------------------------

FOUND, LOST = estimate(10.0), estimate(10.0, math.inf, "not_identifiable")
WEAK = estimate(10.0, 2.0, "weak")
OPEN = replace(WEAK, interval=(8.0, None))


@pytest.mark.parametrize(
    ("published", "entry", "truth", "stopped", "expected"),
    [
        (99.0, LOST, 10.0, 5.0, "not informed"),
        (10.0, LOST, 10.0, 5.0, "not informed"),
        (13.9, WEAK, 10.0, 5.0, "not informed"),
        (14.1, WEAK, 10.0, 5.0, "unexplained"),
        (13.9, FOUND, 10.0, 5.0, "torque error"),
        (99.0, OPEN, 10.0, 5.0, "hardly informed"),
        (7.9, OPEN, 10.0, 5.0, "torque error"),
        (9.0, FOUND, 10.0, 5.0, "near the truth"),
        (11.0, FOUND, 10.0, 5.0, "near the truth"),
        (8.9, FOUND, 10.0, 5.0, "torque error"),
        (3.0, FOUND, 10.0, 5.0, "slow"),
        (5.5, FOUND, 10.0, 5.0, "slow"),
        (5.6, FOUND, 10.0, 5.0, "unexplained"),
        (2.9, FOUND, 10.0, 5.0, "unexplained"),
        (4.0, FOUND, 10.0, 9.1, "unexplained"),
        (6.0, FOUND, 10.0, 8.0, "slow"),
        (2.5, FOUND, 1.0, 2.0, "slow"),
        (10.0, FOUND, None, 5.0, "torque error"),
        (4.0, FOUND, None, 5.0, "unexplained"),
    ],
)
def test_why_a_published_value_is_what_it_is(monkeypatch, published, entry, truth, stopped, expected):
    """Of descents that start at 3, stop where it says, and end between 6 and 14 with errors of the torques."""
    monkeypatch.setitem(PAPER_ESTIMATES, "made up", {"T1.bend": published})
    ensemble = {"made up": {"none": {"T1.bend": [stopped]}, "offsets": {"T1.bend": [6.0, 14.0]}}}
    monkeypatch.setattr(module, "_load_torque_ensemble", lambda: ensemble)
    [said] = explain_paper_estimates("made up", {"T1.bend": entry}, {} if truth is None else {"T1.bend": truth})
    assert said.startswith(f"T1.bend = {published:.4g} of the paper: {expected}")


TRUTH = dict(zip(_PAPER_PARAMETERS, (22.0, 13.6, 10.7, 8.2, 11.5, 9.7), strict=True))


def judged(**verdicts):
    """Found at the truth, but for some."""
    made = {name: estimate(value) for name, value in TRUTH.items()}
    return made | {name.replace("_", "."): entry for name, entry in verdicts.items()}


def test_each_published_value_has_one_sentence():
    for experiment, values in PAPER_ESTIMATES.items():
        said = explain_paper_estimates(experiment, judged(T2_twist=LOST, T3_twist=LOST), TRUTH)
        assert [text.split(" = ")[0] for text in said] == list(_PAPER_PARAMETERS)
        for text, value in zip(said, values.values(), strict=True):
            assert f" = {value:.4g} of the paper: " in text
        assert all("not informed; in such an experiment it cannot be found" in said[i] for i in (3, 5))


def test_the_truth_was_chosen_from_one_answer_and_this_is_said():
    assert all(0 not in values.values() for name, values in PAPER_ESTIMATES.items() if name == _TRUTH_EXPERIMENT)
    assert all(0 in values.values() for name, values in PAPER_ESTIMATES.items() if name != _TRUTH_EXPERIMENT)
    assert all(
        "which was chosen from it" in text for text in explain_paper_estimates(_TRUTH_EXPERIMENT, judged(), TRUTH)
    )
    other = explain_paper_estimates("single_arm_no_vision", judged(), TRUTH)
    assert other[0] == "T1.bend = 23.78 of the paper: near the truth of these recordings, 22"
    elsewhere = explain_paper_estimates(
        _TRUTH_EXPERIMENT, judged(), {name: 1.05 * value for name, value in TRUTH.items()}
    )
    assert not any("chosen" in text for text in elsewhere)


def test_weak_parameters_are_said_with_their_interval():
    said = explain_paper_estimates("single_arm_no_vision", judged(T3_bend=replace(OPEN, interval=(0.84, None))), TRUTH)
    assert said[4].endswith(
        "hardly informed; in such an experiment it is weakly determined, above 0.84, where the value lies"
    )
    said = explain_paper_estimates(
        "single_arm_no_vision", judged(T1_twist=replace(OPEN, interval=(8.65, 109.7))), TRUTH
    )
    assert said[1].startswith(
        "T1.twist = 0 of the paper: unexplained; such recordings leave 8.65 to 109.7 open and not this, it is not slow"
    )


def test_nothing_is_said_where_the_recordings_are_not_explained_or_a_parameter_is_not_free():
    assert explain_paper_estimates(_TRUTH_EXPERIMENT, judged(T1_bend=estimate(1.0, 1.0, "not_trusted")), TRUTH) == ()
    fixed = estimate(10.7, 0.0, "fixed", free=False)
    assert len(explain_paper_estimates(_TRUTH_EXPERIMENT, judged(T2_bend=fixed), TRUTH)) == 5
    assert len(explain_paper_estimates(_TRUTH_EXPERIMENT, {"T1.bend": FOUND, "else": FOUND}, TRUTH)) == 1

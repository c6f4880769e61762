"""What a finding says in sentences."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from yid_ocp.diagnosis import Thresholds, diagnose
from yid_ocp.diagnosis.diagnosis_messages import (
    _separating_experiment,
    diagnosis_summary_text,
    insufficient_data_message,
    next_experiment_text,
)
from yid_ocp.effects import make_effect


@pytest.fixture(scope="module")
def finding(bench):
    recordings = [bench.recording({"joint_coulomb@elbow": {"tau_c": 0.1}}, seed, duration=2.0) for seed in (1, 2)]
    return diagnose(bench.problem(recordings[:1]), ("joint_coulomb@elbow",), recordings[1:])


def test_a_finding_keeps_its_words_and_what_decided_them(finding):
    assert finding.thresholds == Thresholds()
    assert finding.summary == diagnosis_summary_text(finding) == finding.to_dict()["summary"]


def kind(label: str, depends_on: str):
    return SimpleNamespace(label=label, location=label.partition("@")[2], required_excitation=depends_on)


@pytest.mark.parametrize(
    ("labels", "said"),
    [
        (("joint_viscous@elbow", "joint_coulomb@elbow"), "Vary how fast it moves over a wider range."),
        (
            ("joint_coulomb@elbow", "joint_coulomb@shoulder"),
            "Move so that elbow and shoulder work one at a time, or measure a point between them.",
        ),
        (
            ("gravity_tilt@world", "link_mass@elbow", "joint_coulomb@elbow"),
            "Vary how fast it moves and how hard it accelerates and how it stands against gravity independently of "
            "each other, over a wide range, in one recording.",
        ),
    ],
)
def test_rivals_are_separated_by_what_they_depend_on(bench, labels, said):
    effects = [make_effect(*label.split("@"), bench.system) for label in labels]
    assert _separating_experiment(effects) == said


def test_an_aspect_that_the_library_does_not_know_comes_last():
    rivals = [kind("melting@T1", "how hot it is"), kind("density@T1", "how hard it accelerates")]
    assert _separating_experiment(rivals).startswith("Vary how hard it accelerates and how hot it is independently")
    assert _separating_experiment([kind("odd@T1", "")]) == "Record other motions, faster and larger."


def test_rivals_come_before_all_else():
    rivals = (kind("a@T1", "when it is read"), kind("b@T1", "when it is read"))
    added = [SimpleNamespace(equivalent_effects=rivals[:1]), SimpleNamespace(equivalent_effects=rivals)]
    assert next_experiment_text("confusable", added, (), ()) == "Vary when it is read over a wider range."


def test_a_shortage_says_what_is_needed():
    before, limits = SimpleNamespace(degrees_of_freedom=11.6), Thresholds(min_samples_per_unknown=4.0)
    seen = [SimpleNamespace(is_detectable=True)]
    assert insufficient_data_message("effect", before, 5, seen, limits) == ""
    said = insufficient_data_message("insufficient_data", before, 5, seen, limits)
    assert said.startswith("12 effective samples for 5 unknowns, at least 20 are needed")
    hidden = insufficient_data_message("insufficient_data", before, 5, [SimpleNamespace(is_detectable=False)], limits)
    assert hidden == "no candidate of the size that one would expect would show in these recordings."

"""The report of a diagnosis: every chapter of every verdict, in words and pictures."""

from __future__ import annotations

import html
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.diagnosis import Thresholds, diagnose
from yid_ocp.diagnosis.events import DisturbanceEvent, EventSet, _Overspeed
from yid_ocp.diagnosis.pulse_detection import DetectedForcePulse, ForceEstimate
from yid_ocp.report.html import write_report
from yid_ocp.report.sections import ReportData
from yid_ocp.workflow.build_problem import load_problem
from yid_ocp.workflow.diagnose import _held_out_predictions

KNOWN = {"command": "yid-ocp diagnose 'a b.yaml'", "next_plan": None, "versions": {"python": "3"}, "date": "today"}
CHAPTERS = ("gap", "where", "which", "alike", "curves", "absorbed")


@pytest.fixture(scope="module")
def found(rubbing, solved_pendulum):
    """Findings on a pendulum: friction in the elbow that is named, that no candidate explains, and none at all."""
    problem, limits = load_problem(rubbing), Thresholds(max_effects=1)
    return {
        "effect": diagnose(problem, ["joint_coulomb", "effort_offset"], thresholds=limits),
        "unknown": diagnose(problem, ["effort_offset"], thresholds=limits),
        "no_gap": diagnose(solved_pendulum[0], ["joint_coulomb", "effort_offset"], thresholds=limits),
    }


def page_of(finding, file) -> str:
    result = json.loads(json.dumps(finding.to_dict() | KNOWN))
    more = {"finding": finding, "predictions": _held_out_predictions(finding)}
    assert write_report(file, ReportData("run", "", result, section_data=more))
    return file.read_text(encoding="utf-8").split("<body>")[1]


def text_of(page: str) -> str:
    bare = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]+>", "", bare)))


@pytest.mark.parametrize(
    ("verdict", "chapters"),
    [
        ("effect", CHAPTERS),
        ("unknown", ("gap", "where", "which", "alike", "curves")),
        ("no_gap", ("gap", "which", "alike", "curves")),
    ],
)
def test_every_verdict_has_its_chapters(found, verdict, chapters, tmp_path):
    finding = found[verdict]
    assert finding.verdict == verdict
    page = page_of(finding, tmp_path / "r.html")
    assert tuple(re.findall(r'<h3 id="(\w+)">', page)) == chapters
    text = text_of(page)
    assert text.index(" ".join(finding.to_dict()["summary"].split())) < text.index("How large the gap is")
    assert text.index("How large the gap is") < text.index("yid-ocp diagnose 'a b.yaml'")
    assert page.count('<div class="plot"') >= len(chapters)
    assert "nan" not in text


def test_the_words_beside_the_pictures_say_what_is_seen(found, tmp_path):
    [first, *others] = found["effect"].nominal_changes
    moved = replace(first, value_after=2 * first.value_before)
    text = text_of(page_of(replace(found["effect"], nominal_changes=(moved, *others)), tmp_path / "r.html"))
    assert "The error of joints.effort.elbow changes most" in text
    assert "A gap would have shown at" in text
    assert "By evidence the gap lies in the mechanics or what the effort sensors read" in text
    assert "Closed by joint_coulomb@elbow" in text
    assert "the surest value is that of elbow" in text
    assert f"{moved.name} goes from" in text


def test_a_map_without_a_sure_value_shows_what_was_expected_beforehand(found, tmp_path):
    finding = found["effect"]
    smoothed = finding.smoother_result
    trace = smoothed.smoothed_unknowns[0]
    prior = np.sqrt([smoothed.group_variance[source] for source in trace.unknown_groups])
    vague = replace(trace, posterior_std=np.broadcast_to(0.9 * prior, trace.posterior_std.shape))
    page = page_of(replace(finding, smoother_result=replace(smoothed, smoothed_unknowns=(vague,))), tmp_path / "r.html")
    assert "value in standard deviations expected beforehand" in page
    assert "take the picture for a hint only" in text_of(page)


def test_a_result_alone_gives_words_and_tables(found, tmp_path):
    result = found["effect"].to_dict() | KNOWN
    assert write_report(tmp_path / "r.html", ReportData("run", "", result))
    page = (tmp_path / "r.html").read_text(encoding="utf-8").split("<body>")[1]
    assert "joint_coulomb@elbow" in page
    assert '<div class="plot"' not in page


def test_events_are_marked_on_the_time_axis_told_and_listed(found, tmp_path):
    t = np.linspace(0, 2, 21)
    pulse = DetectedForcePulse(0.5, 1.0, 0.7, False, 0.05, 1e-9)
    event = DisturbanceEvent("run", "elbow", "elbow", "force", 0.5, 1.0, 0.7, pulse.impulse, 0.0125, "N m", pulse)
    events = EventSet(
        (event,),
        (_Overspeed("run", "elbow", 1.5),),
        (ForceEstimate("run", "elbow", "elbow", "N m", t, pulse.filtered_force_at(t), np.eye(21), 0.1 + 0 * t, 0 * t),),
    )
    page = page_of(replace(found["no_gap"], events=events), tmp_path / "report.html")
    assert 'id="events"' in page
    text = text_of(page)
    assert f"{pulse.impulse:.3g} ± {0.0125:.2g}" in text
    assert "From 1.5 s on nothing is judged in run" in text
    assert 'id="events"' not in page_of(found["no_gap"], tmp_path / "plain.html")

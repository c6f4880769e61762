"""The report: sections from results alone and from solved problems, self-contained, and its absence."""

from __future__ import annotations

import base64
import gzip
import importlib
import logging
import re
import sys
from dataclasses import replace

import plotly.offline
import pytest

from yid_ocp.errors import OutputError
from yid_ocp.report.html import write_report
from yid_ocp.report.sections import REPORT_SECTIONS, ReportData, render_sections
from yid_ocp.workflow.solve import solve_result


def findings(solved, **changes) -> ReportData:
    problem, solution, *_ = solved
    made = {"command": "yid-ocp solve p.yaml", "date": "2026-01-02 03:04:05+00:00"}
    result = solve_result(problem, solution, []) | made | {"inputs": {"a": "0" * 64}, "versions": {"python": "3"}}
    return ReportData("run <one>", "A & B.", result | changes, problem, solution)


def test_a_whole_report_is_one_self_contained_page(solved_pendulum, tmp_path):
    assert write_report(tmp_path / "r.html", findings(solved_pendulum))
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    body = page[page.index("<body>") :]
    assert not re.search(r"<(script|link|img)[^>]+(src|href)=", page)
    packed = re.search(r'id="packed">([^<]+)</script>', page).group(1)
    assert gzip.decompress(base64.b64decode(packed)).decode() == plotly.offline.get_plotlyjs()
    assert len(page) < 2.5e6
    assert "<title>run &lt;one&gt;</title>" in page
    assert "A &amp; B." in body
    order = ("verdict", "scene", "estimates", "fit", "search", "numbers", "inputs")
    assert tuple(re.findall(r'<section id="(\w+)">', body)) == order
    for known in ("yid-ocp solve p.yaml", "2026-01-02 03:04:05+00:00", "0" * 64, "python 3"):
        assert known in body
    assert "elbow.damping" in body
    assert "joints.effort.shoulder" in body
    opened = []
    for end, tag in re.findall(r"<(/?)([a-z]\w*)", re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)):
        if end:
            assert opened.pop() == tag
        elif tag not in ("meta", "br", "img", "link", "input", "hr"):
            opened.append(tag)
    assert opened == []


def test_words_follow_the_verdicts(solved_pendulum, tmp_path):
    problem, solution, _ = solved_pendulum
    for verdict, words in (
        ("identifiable", "3 of 3"),
        ("weak", "only weakly determined: elbow.damping"),
        ("not_identifiable", "cannot be found from these recordings: elbow.damping"),
    ):
        entry = replace(solution.parameters["elbow.damping"], verdict=verdict)
        other = replace(solution, parameters=solution.parameters | {"elbow.damping": entry})
        write_report(tmp_path / "r.html", findings((problem, other)))
        assert f'<p class="said">{words}' in (tmp_path / "r.html").read_text(encoding="utf-8")


def test_a_failed_solve_gets_no_verdicts(solved_pendulum, tmp_path):
    problem, solution, _ = solved_pendulum
    failed = replace(solution, evaluation=None, cost=float("nan"))
    write_report(tmp_path / "r.html", findings((problem, failed), status="failed", message="step 3 did not converge"))
    body = (tmp_path / "r.html").read_text(encoding="utf-8").split("<body>")[1]
    assert '<p class="said">failed: step 3 did not converge' in body
    assert 'class="verdict' not in body
    assert '<section id="fit">' not in body


def test_sections_may_have_nothing_to_say():
    empty = ReportData("x", "", {"format": "other/1"})
    assert render_sections(empty, environment=None) == []


def test_a_new_section_is_a_file_and_a_template(solved_pendulum, tmp_path, monkeypatch):
    (tmp_path / "weather_section.py").write_text(
        "from yid_ocp.report.sections import register_report_section\n\n\n"
        "@register_report_section('weather', 15, 'The weather')\n"
        "def prepare(findings):\n"
        "    return {'sky': 'blue & dry'} if 'parameters' in findings.result else None\n"
    )
    (tmp_path / "weather.html").write_text("<p>The sky was {{ sky }}.</p>")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(REPORT_SECTIONS, "_entries", dict(REPORT_SECTIONS._entries))
    importlib.import_module("weather_section")
    monkeypatch.delitem(sys.modules, "weather_section")
    assert write_report(tmp_path / "r.html", findings(solved_pendulum))
    body = (tmp_path / "r.html").read_text(encoding="utf-8").split("<body>")[1]
    assert "<h2>The weather</h2>" in body
    assert "The sky was blue &amp; dry." in body
    assert body.index('id="verdict"') < body.index('id="weather"') < body.index('id="fit"')
    assert REPORT_SECTIONS["weather"].prepare_context(ReportData("x", "", {"format": "other/1"})) is None


def test_every_template_has_its_section(repository):
    templates = {path.stem for path in (repository / "yid_ocp" / "report" / "templates").glob("*.html")}
    assert templates - {"page", "blocks", "figures"} < set(REPORT_SECTIONS)


def test_without_the_extra_there_is_a_notice_and_no_report(solved_pendulum, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr("yid_ocp.report.html.util.find_spec", lambda name: None)
    with caplog.at_level(logging.WARNING):
        assert not write_report(tmp_path / "r.html", findings(solved_pendulum))
    assert "yid-ocp[report]" in caplog.text
    assert not (tmp_path / "r.html").exists()


def test_a_report_that_cannot_be_written(solved_pendulum, tmp_path):
    with pytest.raises(OutputError, match="does not exist"):
        write_report(tmp_path / "no" / "r.html", findings(solved_pendulum))

"""Progress on a terminal and in lines, and what commands print."""

from __future__ import annotations

import argparse
import io
import sys

import numpy as np
import pytest
from rich.progress import Progress as Bars

from yid_ocp.progress import NULL_PROGRESS
from yid_ocp.report.terminal import SummaryStatement
from yid_ocp.solvers import Iterate
from yid_ocp.workflow import command_runner

ENTRY = Iterate(3, 12.5, np.zeros(1), 0.1, 4, 1.25, "first 2 s")


def asked(quiet: bool = False, program: bool = False) -> argparse.Namespace:
    return argparse.Namespace(quiet=quiet, json=program)


@pytest.fixture
def clock(monkeypatch):
    """A clock that is set by hand."""
    now = [100.0]
    monkeypatch.setattr("yid_ocp.workflow.command_runner.time.monotonic", lambda: now[0])
    return now


def test_lines_for_stages_iterates_and_tenths(capsys, clock):
    progress = command_runner.StderrLogLinesProgress()
    progress.begin_stage("solving")
    progress.report_iterate(ENTRY)
    for _ in range(2):  # the tenths begin again with every stage
        progress.begin_stage("tracking")
        for i in range(101):
            progress.report_parts_done(i, 100, f"frame {i}")
    lines = capsys.readouterr().err.splitlines()
    tracking = ["tracking ...", *(f"  {10 * i} of 100, frame {10 * i}" for i in range(1, 11))]
    assert lines == ["solving ...", "  iteration 3, cost 12.5, 1.2 s, first 2 s", *tracking, *tracking]


@pytest.mark.parametrize(
    ("pace", "left"), [(30.0, ["about 4 min", "about 30 s"]), (45.0, ["about 6 min", "about 45 s"]),
                       (3000.0, ["about 6.7 h", "about 50 min"])]
)  # fmt: skip
def test_the_time_left_counts_what_this_run_did(capsys, clock, pace, left):
    progress = command_runner.StderrLogLinesProgress()
    progress.begin_stage("diagnosing")
    for done in (10, 12, 19, 20):  # ten were done before and took nothing
        clock[0] = 100.0 + pace * (done - 10)
        progress.report_parts_done(done, 20, f"case {done}")
    lines = capsys.readouterr().err.splitlines()[1:]
    told = ["", *(f", {words} left" for words in left), ""]
    assert lines == [f"  {done} of 20, case {done}{words}" for done, words in zip((10, 12, 19, 20), told, strict=True)]


def test_slow_parts_have_a_line_each_and_quick_ones_one_in_ten(capsys, clock):
    progress = command_runner.StderrLogLinesProgress()
    progress.begin_stage("diagnosing")
    for done in range(4):
        clock[0] += 30.0
        progress.report_parts_done(done, 1000, f"case {done}")
    assert len(capsys.readouterr().err.splitlines()) == 5
    for done in range(4, 99):
        clock[0] += 0.01
        progress.report_parts_done(done, 1000, f"case {done}")
    assert capsys.readouterr().err == ""


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_bar_moves_with_its_stage_and_is_a_line_when_the_next_begins(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("COLUMNS", "200")
    update = Bars.update
    monkeypatch.setattr(Bars, "update", lambda self, task, **what: update(self, task, refresh=True, **what))
    with command_runner.stderr_progress_display(asked(program=True)) as progress:
        progress.report_parts_done(1, 2, "before any stage")
        progress.begin_stage("solving")
        progress.report_iterate(ENTRY)
        progress.begin_stage("tracking")
        progress.report_parts_done(1, 4, "frame 1")
    said = sys.stderr.getvalue()
    for words in ("solving: 0 s", "tracking: 1 of 4, frame 1", "tracking: 0 s"):
        assert words in said
    assert "before any stage" not in said


def test_who_does_not_look_is_shown_nothing_or_lines():
    for arguments in (asked(quiet=True), asked(program=True)):
        with command_runner.stderr_progress_display(arguments) as progress:
            assert progress is NULL_PROGRESS
    with command_runner.stderr_progress_display(asked()) as progress:
        assert isinstance(progress, command_runner.StderrLogLinesProgress)


@pytest.mark.parametrize(("quiet", "reached"), [(True, True), (False, True), (False, False)])
def test_a_command_ends_with_its_table_and_its_folder(tmp_path, monkeypatch, capsys, quiet, reached):
    monkeypatch.chdir(tmp_path)
    said = [SummaryStatement("a = 1"), SummaryStatement("done")]
    monkeypatch.setattr(command_runner, "SUMMARY_BY_FORMAT", {"made": lambda result: said if result["a"] == 1 else []})

    def work(progress):
        progress.begin_stage("working")
        return command_runner.CommandResult(folder, {"format": "made", "a": 1}, None, reached)

    folder = tmp_path / "runs" / "x"
    code = command_runner.run_command_and_print(asked(quiet=quiet), work)
    captured = capsys.readouterr()
    assert code == (command_runner.EXIT_DONE if reached else command_runner.EXIT_FAILED)
    expected = (f"{folder}\n", "") if quiet else ("a = 1\ndone\nrun folder: runs/x\n", "working ...\n")
    assert (captured.out, captured.err) == expected


def test_a_folder_elsewhere_is_named_in_full(tmp_path, monkeypatch, capsys):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setattr(command_runner, "SUMMARY_BY_FORMAT", {"made": lambda result: []})
    made = command_runner.CommandResult(tmp_path / "there", {"format": "made"}, None)
    command_runner.run_command_and_print(asked(), lambda progress: made)
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "there")

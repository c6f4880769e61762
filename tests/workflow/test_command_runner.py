"""Progress on a terminal and in lines, and what commands print."""

from __future__ import annotations

import argparse
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from yid_ocp.report.terminal import SummaryStatement
from yid_ocp.solvers import Iterate
from yid_ocp.workflow.command_runner import (
    EXIT_DONE,
    EXIT_FAILED,
    NULL_PROGRESS,
    CommandResult,
    LineProgress,
    _BarProgress,
    _format_duration,
    run_and_print,
    show_progress,
)

ENTRY = Iterate(3, 12.5, np.zeros(1), 0.1, 4, 1.25, "first 2 s")


def asked(quiet: bool = False, program: bool = False) -> argparse.Namespace:
    return argparse.Namespace(quiet=quiet, json=program)


def report(progress) -> None:
    """Two stages, the first with an iterate, the second with a hundred parts."""
    progress.begin_stage("solving")
    progress.report_iterate(ENTRY)
    progress.begin_stage("tracking")
    for i in range(101):
        progress.report_parts_done(i, 100, f"frame {i}")


def test_lines_for_stages_iterates_and_tenths(capsys):
    report(LineProgress())
    lines = capsys.readouterr().err.splitlines()
    assert lines[:3] == ["solving ...", "  iteration 3, cost 12.5, 1.2 s, first 2 s", "tracking ..."]
    assert lines[3:] == [f"  {10 * i} of 100, frame {10 * i}" for i in range(1, 11)]


def test_the_tenths_begin_again_with_every_stage(capsys):
    progress = LineProgress()
    for _ in range(2):
        progress.begin_stage("tracking")
        progress.report_parts_done(5, 10, "half")
    assert capsys.readouterr().err.count("5 of 10, half") == 2


@pytest.fixture
def clock(monkeypatch):
    """A clock that is set by hand."""
    now = [100.0]
    monkeypatch.setattr("yid_ocp.workflow.command_runner.time.monotonic", lambda: now[0])
    return now


def test_the_time_left_counts_what_this_run_did(capsys, clock):
    progress = LineProgress()
    progress.begin_stage("diagnosing")
    for done, now in ((10, 100.0), (12, 160.0), (19, 370.0), (20, 400.0)):
        clock[0] = now
        progress.report_parts_done(done, 20, f"case {done}")
    lines = capsys.readouterr().err.splitlines()[1:]
    # ten were done before and took nothing; two in a minute leave eight for four minutes
    assert lines == [
        "  10 of 20, case 10",
        "  12 of 20, case 12, about 4 min left",
        "  19 of 20, case 19, about 30 s left",
        "  20 of 20, case 20",
    ]


def test_slow_parts_have_a_line_each_and_quick_ones_one_in_ten(capsys, clock):
    progress = LineProgress()
    progress.begin_stage("diagnosing")
    for done in range(4):
        clock[0] += 30.0
        progress.report_parts_done(done, 1000, f"case {done}")
    assert len(capsys.readouterr().err.splitlines()) == 5
    for done in range(4, 99):
        clock[0] += 0.01
        progress.report_parts_done(done, 1000, f"case {done}")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.4, "0 s"), (89.0, "89 s"), (90.0, "2 min"), (5399.0, "90 min"), (9000.0, "2.5 h")]
)
def test_times_for_people(seconds, words):
    assert _format_duration(seconds) == words


class Bars:
    """What a bar is told."""

    def __init__(self) -> None:
        self.calls: list[tuple] = []

    def add_task(self, text, total=None):
        self.calls.append(("add", text, total))
        return len(self.calls)

    def update(self, task, **what):
        self.calls.append(("update", task, what))

    def remove_task(self, task):
        self.calls.append(("remove", task))

    @property
    def console(self):
        return SimpleNamespace(print=lambda text, **how: self.calls.append(("print", text)))


def test_a_bar_moves_with_its_stage_and_is_a_line_when_the_next_begins(clock):
    bars = Bars()
    progress = _BarProgress(bars)
    progress.report_parts_done(1, 2, "before any stage")
    progress.begin_stage("solving")
    progress.report_iterate(ENTRY)
    clock[0] += 7.0
    progress.begin_stage("tracking")
    progress.report_parts_done(1, 4, "frame 1")
    progress.finish_stage()
    progress.finish_stage()
    assert bars.calls == [
        ("add", "solving", None),
        ("update", 1, {"description": "solving: iteration 3, cost 12.5, 1.2 s, first 2 s"}),
        ("remove", 1),
        ("print", "solving: 7 s"),
        ("add", "tracking", None),
        ("update", 5, {"description": "tracking: 1 of 4, frame 1", "completed": 1, "total": 4}),
        ("remove", 5),
        ("print", "tracking: 0 s"),
    ]


def test_what_is_shown_depends_on_who_looks(capsys, monkeypatch):
    with show_progress(asked(quiet=True)) as progress:
        assert progress is NULL_PROGRESS
        report(progress)
    assert capsys.readouterr().err == ""
    with show_progress(asked()) as progress:
        assert isinstance(progress, LineProgress)
    with show_progress(asked(program=True)) as progress:
        assert progress is NULL_PROGRESS
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with show_progress(asked(program=True)) as progress:
        assert isinstance(progress, _BarProgress)
    with show_progress(asked()) as progress:
        assert isinstance(progress, _BarProgress)
        report(progress)


@pytest.mark.parametrize(("quiet", "reached"), [(True, True), (False, True), (False, False)])
def test_a_command_ends_with_its_table_and_its_folder(tmp_path, monkeypatch, capsys, quiet, reached):
    monkeypatch.chdir(tmp_path)

    def work(progress):
        progress.begin_stage("working")
        return CommandResult(folder, {"a": 1}, is_successful=reached)

    folder = tmp_path / "runs" / "x"
    said = [SummaryStatement("a = 1"), SummaryStatement("done")]
    code = run_and_print(asked(quiet=quiet), work, lambda result: said if result == {"a": 1} else [])
    captured = capsys.readouterr()
    assert code == (EXIT_DONE if reached else EXIT_FAILED)
    if quiet:
        assert (captured.out, captured.err) == (f"{folder}\n", "")
    else:
        assert (captured.out, captured.err) == ("a = 1\ndone\nrun folder: runs/x\n", "working ...\n")


def test_a_folder_elsewhere_is_named_in_full(tmp_path, monkeypatch, capsys):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    run_and_print(asked(), lambda progress: CommandResult(tmp_path / "there", {"a": 1}), lambda result: [])
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "there")

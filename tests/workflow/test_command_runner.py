"""Progress on a terminal and in lines, and what commands print."""

import argparse
import io
import math
import re
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from heard import Heard
from rich.progress import Progress as Bars

from yid_ocp.cli import main
from yid_ocp.display import NULL_PROGRESS
from yid_ocp.report.terminal import SUMMARIES, SummaryStatement
from yid_ocp.solvers import Iterate
from yid_ocp.workflow import command_runner
from yid_ocp.workflow.solve import _iterate_logger

ENTRY = Iterate(3, 12.5, np.zeros(1), 0.1, 4, 1.25, "first 2 s")


def asked(quiet: bool = False, program: bool = False, verbose: bool = False) -> argparse.Namespace:
    return argparse.Namespace(quiet=quiet, json=program, verbose=verbose, begin_time=100.0)


@pytest.fixture
def clock(monkeypatch):
    """A clock that is set by hand."""
    now = [100.0]
    monkeypatch.setattr("yid_ocp.workflow.command_runner.time.monotonic", lambda: now[0])
    return now


def test_lines_for_stages_iterates_and_tenths(capsys, clock):
    progress = command_runner.StderrLogLinesProgress()
    progress.begin_stage("solving")
    for _ in range(99):  # a long search says so now and then
        progress.report_iterate(ENTRY)
    for _ in range(2):  # the tenths begin again with every stage
        progress.begin_stage("tracking")
        for i in range(101):
            progress.report_parts_done(i, 100, f"frame {i}")
    tracking = ["tracking ...", *(f"  {5 * i} of 100, frame {5 * i}" for i in range(1, 21))]
    said = ["solving ...", *(f"  iteration N, cost 12.5{k}, 1.2 s, first 2 s" for k in ("", *19 * [" (first 12.5)"]))]
    said[-1] += " (then a line every 5 s)"
    lines = re.sub(r"[\d.]+ s, f", "1.2 s, f", capsys.readouterr().err)
    assert re.sub(r"iteration \d+", "iteration N", lines).splitlines() == said + 2 * tracking


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


def test_slow_parts_have_a_line_each_and_quick_ones_one_in_twenty(capsys, clock):
    progress = command_runner.StderrLogLinesProgress()
    progress.begin_stage("diagnosing")
    for done in range(4):
        clock[0] += 30.0
        progress.report_parts_done(done, 1000, f"case {done}")
    assert len(capsys.readouterr().err.splitlines()) == 5
    for done in range(4, 49):
        clock[0] += 0.01
        progress.report_parts_done(done, 1000, f"case {done}")
    assert capsys.readouterr().err == ""


STAGES = {
    "solve": {"building": 4.0, "solving": 5.0, "half": 2.5, "held out": 1.2, "report": 1.5},
    "diagnose": {"building": 2.5, "composing": 2.5, "nominal": 3.0, "events": 4.0, "none": 0.0, "screening": 4.0,
                 "locating": 3.0, "refitting": 4.0, "scoring": 3.0, "held out": 1.0, "report": 1.5},
}  # fmt: skip
"""Stages of a command, with the time that each usually takes [s]."""


@pytest.mark.parametrize("imports", [1.6, None])
@pytest.mark.parametrize("compiling", [1.0, 4.0])
@pytest.mark.parametrize("pace", [0.7, 1.0, 5.0, 20.0])
@pytest.mark.parametrize("command", STAGES)
def test_the_time_left_is_right_within_a_factor_of_two_by_the_first_third(clock, command, pace, compiling, imports):
    """At any pace, whether imports show it or not, and until the end where the first stage has nothing to compile."""
    works = STAGES[command]
    before, told = imports or 1.6 * pace, []
    lengths = [work * pace * (compiling if name == "building" else 1.0) for name, work in works.items()]
    end = before + sum(lengths)
    clock[0] = before
    left = command_runner._RemainingTime(before)
    for k, ((name, work), length) in enumerate(zip(works.items(), lengths, strict=True)):
        may_compile = name in ("building", "composing")
        left.begin_stage(0.0 if may_compile else work, sum([*works.values()][k + (not may_compile) :]))
        for _ in range(20):
            told.append((clock[0] / end, left.seconds_left() / (end - clock[0])))
            clock[0] += length / 20
            if name == "solving":
                left.n_iterates += 1
    assert math.isfinite(told[0][1])
    late = [ratio for part, ratio in told if 1 / 3 <= part <= 0.95]
    assert 0.5 <= late[0] <= 2.0
    if compiling == 1.0 and (pace <= 5.0 or imports is None):
        assert min(late) >= 0.5
        assert max(late) <= 2.0


def test_the_time_left_of_a_command_is_said_where_its_first_stage_plans(capsys, clock):
    """A plan that grows may grow again, so what is said from then on is the time since the start."""
    for plan, more in (((0.0, 10.0), " 32 s so far"), ((2.0, None), "")):
        progress = command_runner.StderrLogLinesProgress()
        progress.begin_stage("building", *plan)
        clock[0] += 30.0
        progress.begin_stage("refitting", 1.5, 16.0)
        assert capsys.readouterr().err.splitlines() == ["building ...", f"refitting ...{more}"]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def show_all_on_a_terminal(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("COLUMNS", "200")
    update = Bars.update
    monkeypatch.setattr(Bars, "update", lambda self, task, **what: update(self, task, refresh=True, **what))


def test_a_bar_moves_with_its_stage_and_is_a_line_when_the_next_begins(monkeypatch):
    show_all_on_a_terminal(monkeypatch)
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


@pytest.mark.parametrize("verbose", [False, True])
def test_a_terminal_renews_one_line_of_iterations_and_a_table_of_results(monkeypatch, verbose):
    show_all_on_a_terminal(monkeypatch)
    with command_runner.stderr_progress_display(asked(verbose=verbose)) as progress:
        progress.begin_stage("solving", ahead=60.0)
        for _ in range(2):
            progress.report_iterate(ENTRY)
        progress.renew_results_table([("effects", "chi2/n"), *((f"a{k}@x", str(k)) for k in range(30))])
        progress.report_iterate(ENTRY)
    said = sys.stderr.getvalue()
    assert all(part in said for part in ("\x1b", " left"))
    assert len(re.findall(r"\[2K  iteration \d+, cost 12.5", said)) == (3 if verbose else 0)
    assert all(part in said for part in ("effects", "a9@x"))
    assert "a10@x" not in said


def test_a_live_fit_shows_cost_and_the_courses_of_parameters_those_that_move_first(tmp_path):
    heard, folder = Heard(), SimpleNamespace(log_event=lambda *_, **__: None)
    known = dict.fromkeys(("still", "moving"), SimpleNamespace(unit="N m/rad"))
    problem = SimpleNamespace(shared_parameters=tuple(known), system=SimpleNamespace(parameters=known))
    for is_live in (False, True):
        iterate = _iterate_logger(problem, folder, heard, is_live)
        for k, (cost, value) in enumerate([(100.0, 1.0), (10.0, 4.0), (1.0, 5.0)]):
            iterate(replace(ENTRY, iteration=k, cost=cost, x=np.array([2.0, value, 99.0])))
        if not is_live:
            assert heard.table == []
    head, *rows = heard.table
    assert head[1:4] == ("start", "now", "last step")
    assert rows[0] == ("cost", "100", "1", "-9", "")
    assert rows[1] == ("moving", "1", "5", "+1", "N m/rad")
    assert rows[2] == ("still", "2", "2", "+0", "N m/rad")


def test_a_live_solve_is_shown_on_a_terminal_and_nowhere_else(pendulum, monkeypatch, capsys, tmp_path):
    settings = ["--set", "output={write_report: false}", "--set", "output.checked_discretisation=none"]
    assert main(["solve", str(pendulum), "--live", *settings, "--out", str(tmp_path / "lines")]) == 0
    assert "last step" not in capsys.readouterr().err
    show_all_on_a_terminal(monkeypatch)
    monkeypatch.setattr(command_runner, "_MAX_LIVE_ROWS", 2)
    assert main(["solve", str(pendulum), "--live", *settings, "--out", str(tmp_path / "bars")]) == 0
    said = sys.stderr.getvalue()
    assert all(part in said for part in ("last step", "\ncost "))


def test_lines_have_no_control_characters(capsys, clock):
    with command_runner.stderr_progress_display(asked(verbose=True)) as progress:
        progress.begin_stage("solving", 2.0, 60.0)
        progress.report_iterate(ENTRY)
        progress.report_parts_done(1, 2, "frame 1")
        progress.renew_results_table([("effects", "chi2/n"), ("a@x", "1")])
    assert set(capsys.readouterr().err) <= {*map(chr, range(32, 127)), "\n"}


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
    monkeypatch.setitem(SUMMARIES.data, "made", lambda result: said if result["a"] == 1 else [])

    def work(progress):
        progress.begin_stage("working")
        return command_runner.CommandOutcome(folder, {"format": "made", "a": 1}, None, reached)

    folder = tmp_path / "runs" / "x"
    code = command_runner.run_command_and_print(asked(quiet=quiet), work)
    captured = capsys.readouterr()
    assert code == (command_runner.EXIT_DONE if reached else command_runner.EXIT_FAILED)
    expected = (
        (f"{folder}\n", "" if reached else "a = 1\n")
        if quiet
        else ("a = 1\ndone\n\nrun folder: runs/x\n", "working ...\n")
    )
    assert (captured.out, captured.err) == expected


def test_a_folder_elsewhere_is_named_in_full(tmp_path, monkeypatch, capsys):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    made = command_runner.CommandOutcome(tmp_path / "there", {"format": "made"}, None)
    command_runner.run_command_and_print(asked(), lambda progress: made)
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "there")

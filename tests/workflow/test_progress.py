"""How a long run shows how it is doing."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from yid_ocp.solvers import Iterate
from yid_ocp.workflow.command import carry_out
from yid_ocp.workflow.progress import SILENT, BarProgress, PlainProgress, shown

ENTRY = Iterate(3, 12.5, np.zeros(1), 0.1, 4, 1.25, "first 2 s")


def report(progress) -> None:
    """Two stages, the first with an iterate, the second with a hundred parts."""
    progress.stage("solving")
    progress.iterate(ENTRY)
    progress.stage("tracking")
    for i in range(101):
        progress.advance(i, 100, f"frame {i}")


def test_lines_for_stages_iterates_and_tenths(capsys):
    report(PlainProgress())
    lines = capsys.readouterr().err.splitlines()
    assert lines[:3] == ["solving ...", "  iteration 3, cost 12.5, 1.2 s, first 2 s", "tracking ..."]
    assert lines[3:] == [f"  {10 * i} of 100, frame {10 * i}" for i in range(1, 11)]


def test_the_tenths_begin_again_with_every_stage(capsys):
    progress = PlainProgress()
    for _ in range(2):
        progress.stage("tracking")
        progress.advance(5, 10, "half")
    assert capsys.readouterr().err.count("5 of 10, half") == 2


class Bars:
    """What a bar is told."""

    def __init__(self) -> None:
        self.calls: list[tuple] = []

    def add_task(self, text, total=None):
        self.calls.append(("add", text, total))
        return len(self.calls)

    def update(self, task, **what):
        self.calls.append(("update", task, what))


def test_a_bar_moves_with_its_stage_and_is_full_when_the_next_begins():
    bars = Bars()
    progress = BarProgress(bars)
    progress.advance(1, 2, "before any stage")
    progress.stage("solving")
    progress.iterate(ENTRY)
    progress.stage("tracking")
    progress.advance(1, 4, "frame 1")
    progress.close()
    assert bars.calls == [
        ("add", "solving", None),
        ("update", 1, {"description": "solving: iteration 3, cost 12.5, 1.2 s, first 2 s"}),
        ("update", 1, {"description": "solving", "total": 1, "completed": 1}),
        ("add", "tracking", None),
        ("update", 4, {"description": "tracking: frame 1", "completed": 1, "total": 4}),
        ("update", 4, {"description": "tracking", "total": 1, "completed": 1}),
    ]


def test_what_is_shown_depends_on_who_looks(capsys, monkeypatch):
    with shown(quiet=True) as progress:
        assert progress is SILENT
        report(progress)
    assert capsys.readouterr().err == ""
    with shown(quiet=False) as progress:
        assert isinstance(progress, PlainProgress)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with shown(quiet=False) as progress:
        assert isinstance(progress, BarProgress)
        report(progress)


class Outcome:
    def __init__(self, folder) -> None:
        self.folder, self.result = folder, {"a": 1}


@pytest.mark.parametrize("quiet", [True, False])
def test_a_command_ends_with_its_table_and_its_folder(tmp_path, monkeypatch, capsys, quiet):
    monkeypatch.chdir(tmp_path)

    def work(progress):
        progress.stage("working")
        return Outcome(tmp_path / "runs" / "x")

    outcome = carry_out(work, lambda result: [f"a = {result['a']}", "done"], quiet)
    captured = capsys.readouterr()
    assert outcome.folder == tmp_path / "runs" / "x"
    if quiet:
        assert (captured.out, captured.err) == (f"{outcome.folder}\n", "")
    else:
        assert (captured.out, captured.err) == ("a = 1\ndone\nrun folder: runs/x\n", "working ...\n")


def test_a_folder_elsewhere_is_named_in_full(tmp_path, monkeypatch, capsys):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    carry_out(lambda progress: Outcome(tmp_path / "there"), lambda result: [], False)
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "there")

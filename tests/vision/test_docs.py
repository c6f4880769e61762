from __future__ import annotations

import dataclasses
import re

import pytest

from yid_ocp.data.recording_hdf5 import read_recording
from yid_ocp.vision import TrackOptions


@pytest.fixture(scope="module")
def text(repository):
    return (repository / "docs" / "vision.md").read_text(encoding="utf-8")


def test_the_example_runs(text, repository, tmp_path, monkeypatch, capsys):
    [block] = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    monkeypatch.chdir(repository)
    exec(compile(block.replace('"tracked.h5"', repr(str(tmp_path / "tracked.h5"))), "docs/vision.md", "exec"), {})
    assert read_recording(tmp_path / "tracked.h5").points[-1].names == ("w_T1", "w_T3")
    assert "clock offset" in capsys.readouterr().out


def test_the_settings_exist(text):
    options = TrackOptions()
    known = {field.name for field in dataclasses.fields(options)}
    for part in ("filters", "skeleton", "shape_fit", "clock", "calibration"):
        known |= {field.name for field in dataclasses.fields(getattr(options, part))}
    _, _, table = text.partition("| stage |")
    rows = [line for line in table.splitlines()[1:] if line.startswith("| ") and line.count("|") == 4]
    named = [name for row in rows for name in re.findall(r"`([\w.]+)`", row.split("|")[3])]
    assert len(named) > 20
    assert {name.rpartition(".")[2] for name in named} <= known

"""Run folders: whole under their name or not there, with a log and results that JSON can hold."""

from __future__ import annotations

import json
import logging
import math

import pytest

from yid_ocp.config.reader import load_config
from yid_ocp.errors import OutputError
from yid_ocp.files import file_sha256
from yid_ocp.workflow.folder import new_run_folder


@pytest.fixture
def settings(pendulum):
    return load_config(pendulum)


def test_a_folder_appears_when_the_block_ends(settings, tmp_path):
    with new_run_folder(settings, tmp_path / "run") as folder:
        folder.write("a.txt", "a")
        assert not (tmp_path / "run").exists()
        assert folder.path != folder.target
    assert folder.path == folder.target == tmp_path / "run"
    assert {path.name for path in folder.path.iterdir()} == {"a.txt", "log.jsonl"}


def test_a_folder_that_is_left_by_an_error_is_not_there(settings, tmp_path):
    def failing() -> None:
        with new_run_folder(settings, tmp_path / "deep" / "run") as folder:
            folder.write("a.txt", "a")
            raise KeyError("a")

    with pytest.raises(KeyError):
        failing()
    assert not (tmp_path / "deep").exists()


def test_begin_and_finish_say_what_a_result_was_made_from(settings, pendulum_data, tmp_path):
    with new_run_folder(settings, tmp_path / "run") as folder:
        folder.begin(settings, "test")
        written = folder.finish({"format": "x", "value": math.inf, "deep": {"list": [1.0, math.nan]}})
    assert load_config(tmp_path / "run" / "config.yaml").solver == settings.solver
    assert json.loads((tmp_path / "run" / "result.json").read_text(), parse_constant=pytest.fail) == written
    assert written["value"] is None
    assert written["deep"]["list"] == [1.0, None]
    assert written["notes"] == ["value is infinite", "deep.list[1] is not known"]
    recording = pendulum_data.folder / "estimate.h5"
    assert written["inputs"][str(recording)] == file_sha256(recording)
    assert "numpy" in written["versions"]
    (line,) = (json.loads(text) for text in (tmp_path / "run" / "log.jsonl").read_text().splitlines())
    assert (line["event"], line["command"], line["inputs"]) == ("start", "test", written["inputs"])


def test_many_notes_on_one_key_are_one(settings, tmp_path):
    with new_run_folder(settings, tmp_path / "run") as folder:
        written = folder.finish({name: {"std": math.inf} for name in "abcd"} | {"z": {"std": math.nan}})
    assert written["notes"] == ["std is infinite (4 times)", "z.std is not known"]


def test_messages_of_the_library_are_logged_while_the_folder_is_made(settings, tmp_path):
    logger = logging.getLogger("yid_ocp.test")
    with new_run_folder(settings, tmp_path / "run") as folder:
        logger.info("inside")
    logger.warning("outside")
    lines = [json.loads(text) for text in (folder.path / "log.jsonl").read_text().splitlines()]
    assert [(line["source"], line["text"]) for line in lines] == [("yid_ocp.test", "inside")]


def test_a_folder_in_use_is_refused_and_an_unnamed_one_is_numbered(settings, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "file").write_text("")
    for name, message in (("used", "not empty"), ("used/file", "that of a file")):
        with pytest.raises(OutputError, match=message), new_run_folder(settings, name):
            pass
    monkeypatch.setattr("yid_ocp.workflow.folder.time.strftime", lambda _: "now")
    for _ in range(2):
        with new_run_folder(settings, None, "check"):
            pass
    assert {path.name for path in (tmp_path / "runs").iterdir()} == {"pendulum-check-now", "pendulum-check-now-2"}

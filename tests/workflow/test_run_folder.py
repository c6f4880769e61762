"""Run folders: whole or not there, named once, cleared of what killed runs left. Plug-ins from files and packages."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import re
import shlex
from unittest.mock import Mock

import pytest

from yid_ocp.config.reader import load_config
from yid_ocp.effects import EFFECTS
from yid_ocp.errors import ConfigError, OutputError, ParallelWorkError
from yid_ocp.files import file_sha256, write_text
from yid_ocp.report.sections import REPORT_SECTIONS
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.run_folder import atomic_run_folder, software_and_plugin_versions


@pytest.fixture
def settings(pendulum):
    return load_config(pendulum)


def test_a_folder_appears_when_the_block_ends_and_not_when_it_is_left_by_an_error(settings, tmp_path):
    def write(out, error=None) -> None:
        with atomic_run_folder(settings, out) as folder:
            write_text(folder.path / "a.txt", "a")
            assert not out.exists()
            assert folder.path != folder.final_path
            if error:
                raise error
        assert folder.path == folder.final_path == out

    write(tmp_path / "run")
    assert {path.name for path in (tmp_path / "run").iterdir()} == {"a.txt", "log.jsonl"}
    with pytest.raises(KeyError):
        write(tmp_path / "deep" / "run", KeyError("a"))
    assert not (tmp_path / "deep").exists()


def test_begin_and_finish_say_what_a_result_was_made_from(settings, pendulum_data, tmp_path):
    with atomic_run_folder(settings, tmp_path / "run") as folder:
        folder.record_run_start(settings, "test")
        many = folder.write_result({name: {"std": math.inf} for name in "abcd"} | {"z": {"std": math.nan}})
        written = folder.write_result({"format": "x", "value": math.inf, "deep": {"list": [1.0, math.nan]}})
    assert many["notes"][0].startswith("std is infinite")
    assert ("4" in many["notes"][0], many["notes"][1:]) == (True, ["z.std is not known"])
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


def test_messages_of_the_library_are_logged_while_the_folder_is_made(settings, tmp_path):
    logger = logging.getLogger("yid_ocp.test")
    with atomic_run_folder(settings, tmp_path / "run") as folder:
        logger.info("inside")
    logger.warning("outside")
    lines = [json.loads(text) for text in (folder.path / "log.jsonl").read_text().splitlines()]
    assert [(line["source"], line["text"]) for line in lines] == [("yid_ocp.test", "inside")]


def test_an_unnamed_one_is_numbered_and_its_name_reserved_from_the_start(settings, tmp_path, monkeypatch):
    monkeypatch.setattr("yid_ocp.workflow.run_folder.time.strftime", lambda _: "now")
    monkeypatch.chdir(tmp_path)
    with contextlib.ExitStack() as runs:
        folders = [runs.enter_context(atomic_run_folder(settings, None, "check")) for _ in range(3)]
        for i, folder in enumerate(folders):
            write_text(folder.path / "number.txt", str(i))
    names = ["pendulum-check-now", "pendulum-check-now-2", "pendulum-check-now-3"]
    assert [(tmp_path / "runs" / name / "number.txt").read_text() for name in names] == ["0", "1", "2"]
    with atomic_run_folder(settings, None, "check") as folder:
        assert folder.final_path.name == "pendulum-check-now-4"


def test_a_name_that_another_run_has_is_refused_before_the_work(settings, tmp_path):
    taken = pytest.raises(OutputError, match="another run")
    with atomic_run_folder(settings, tmp_path / "run"), taken, atomic_run_folder(settings, tmp_path / "run"):
        pass
    assert (tmp_path / "run" / "log.jsonl").is_file()


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_a_result_is_not_lost_because_its_name_was_taken(settings, tmp_path, caplog, kind):
    with atomic_run_folder(settings, tmp_path / "run") as folder:
        write_text(folder.path / "a.txt", "mine")
        taken = tmp_path / "run" / "theirs" if kind == "folder" else tmp_path / "run"
        taken.parent.mkdir(exist_ok=True)
        taken.write_text("theirs")
    assert taken.read_text() == "theirs"
    assert folder.path == tmp_path / "run-2"
    assert (tmp_path / "run-2" / "a.txt").read_text() == "mine"
    assert "in the meantime" in caplog.text


def test_what_a_killed_run_left_is_cleared_away_and_what_lives_stays(settings, tmp_path):
    left = tmp_path / ".left.partial"
    left.mkdir()
    (left / "yid-ocp.lock").touch()
    (left / "big").write_text("x")
    (tmp_path / ".foreign.partial").mkdir()
    with atomic_run_folder(settings, tmp_path / "lives") as alive:
        write_text(alive.path / "a.txt", "a")
        with atomic_run_folder(settings, tmp_path / "other"):
            assert (alive.path / "a.txt").is_file()
    assert {path.name for path in tmp_path.iterdir() if path.is_dir()} >= {"lives", "other", ".foreign.partial"}
    assert not left.exists()


@pytest.mark.parametrize("kind", ["link", "folder", "linked lock"])
def test_a_hidden_folder_that_no_run_made_is_not_emptied(settings, tmp_path, kind):
    theirs = tmp_path / ("theirs" if kind == "link" else ".run.partial")
    theirs.mkdir()
    (theirs / "data").write_text("precious")
    if kind == "link":
        (tmp_path / ".run.partial").symlink_to(theirs)
    elif kind == "linked lock":
        (tmp_path / "lock").touch()
        (theirs / "yid-ocp.lock").symlink_to(tmp_path / "lock")
    with atomic_run_folder(settings, tmp_path / "other"):  # which clears away what killed runs left
        assert (theirs / "data").read_text() == "precious"
    with pytest.raises(OutputError, match="not from a run"), atomic_run_folder(settings, tmp_path / "run"):
        pytest.fail("went on")
    assert (theirs / "data").read_text() == "precious"
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("used", "not empty"),
        ("used/file", "is an existing file"),
        ("link", "is a symbolic link"),
        ("broken link", "is a symbolic link"),
        ("", "not a valid folder name"),
        ("  ", "not a valid folder name"),
        ("a\0b", "not a valid folder name"),
        ("x" * 300, "cannot be"),
        ("~nobody_of_this_name/run", "cannot be"),
    ],
)
def test_a_name_that_cannot_be_a_new_folder_is_refused(settings, tmp_path, monkeypatch, name, message):
    for folder in ("used", "empty"):
        (tmp_path / folder).mkdir()
    (tmp_path / "used" / "file").write_text("")
    (tmp_path / "link").symlink_to(tmp_path / "empty")
    (tmp_path / "broken link").symlink_to(tmp_path / "nowhere")
    monkeypatch.chdir(tmp_path)
    before = set(tmp_path.rglob("*"))
    with pytest.raises(OutputError, match=message), atomic_run_folder(settings, name):
        pytest.fail("went on")
    assert set(tmp_path.rglob("*")) == before


def test_a_full_disk_names_the_folder_that_was_asked_for(settings, tmp_path, monkeypatch):
    def fail_in_task(file):
        with pytest.raises(OutputError) as failed:
            write_text(file, "a")
        raise ParallelWorkError(f"3 tasks failed: {failed.value}", hint="mend it")

    monkeypatch.setattr("yid_ocp.files.os.replace", Mock(side_effect=OSError(28, "No space left on device")))
    with (
        pytest.raises(OutputError, match="No space left") as caught,
        atomic_run_folder(settings, tmp_path / "runs" / "run") as folder,
    ):
        write_text(folder.path / "a.txt", "a")
    assert caught.value.where == str(tmp_path / "runs" / "run" / "a.txt")
    assert not (tmp_path / "runs").exists()
    with pytest.raises(ParallelWorkError) as caught, atomic_run_folder(settings, tmp_path / "run") as folder:
        fail_in_task(folder.resume_folder / "done.json")
    assert f"where: {tmp_path / 'run' / 'done.json'}" in caught.value.what
    assert ".partial" not in str(caught.value)
    assert caught.value.hint == "mend it"


EFFECT = """
from yid_ocp.effects.base import EFFECTS, EffectBase, ParameterDefinition, one_joint_generalized_force, arm_joint_names
from yid_ocp.model.system import EffectStepTerms


@EFFECTS.register("{kind}")
class Constant(EffectBase):
    equation = "F = push"
    required_excitation = "its orientation to gravity"

    @classmethod
    def possible_locations(cls, system):
        return arm_joint_names(system)

    @classmethod
    def parameter_definitions(cls, location, system):
        return (ParameterDefinition("push", "N m", 0.0, -5.0, 5.0, (-1.0, 1.0), "constant torque"),)

    def step_terms(self, state):
        return EffectStepTerms(generalized_force=one_joint_generalized_force(state.system, self.location, self["push"]))
"""


@pytest.fixture
def kinds():
    """Kinds that a test registers are forgotten after it."""
    before = set(EFFECTS)
    yield before
    for name in set(EFFECTS) - before:
        del EFFECTS[name]


def configured(file, *names):
    file.write_text(f"plugins: {list(names)}\n{file.read_text()}")
    return load_config(file)


def test_a_file_is_run_once_and_its_kind_is_there(kinds, pendulum) -> None:
    (pendulum.parent / "own.py").write_text(EFFECT.format(kind="constant") + "print('run')\n")
    run = configured(pendulum, "own.py")
    assert "constant" not in EFFECTS  # reading a configuration runs nothing
    build_system(run)
    assert set(EFFECTS) - kinds == {"constant"}
    build_system(run)


def test_a_file_may_register_a_report_section_alone(kinds, pendulum, monkeypatch) -> None:
    monkeypatch.setattr(REPORT_SECTIONS, "data", {})
    text = "from yid_ocp.report.sections import register_report_section as made\nmade('weather', 15, 'Weather')(dict)\n"
    (pendulum.parent / "own.py").write_text(text)
    build_system(configured(pendulum, "own.py"))
    assert "weather" in REPORT_SECTIONS


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x = 1\n", ["plug-in own.py registers nothing", "@EFFECTS.register"]),
        ("\nraise RuntimeError('no magnet')\n", ["raised RuntimeError: no magnet", "line 2"]),
        ("import sys\nsys.exit(3)\n", ["raised SystemExit: 3", "line 2"]),
        ("def f(:\n", ["raised SyntaxError", "line 1"]),
        ("import nothing_like_this\n", ["raised ModuleNotFoundError", "line 1"]),
        (EFFECT.format(kind="density"), ["already has the name 'density'", "another name"]),
        (EFFECT.format(kind="half") + "1 / 0\n", ["raised ZeroDivisionError", "line 21"]),
    ],
)
def test_what_does_not_work_is_refused_and_leaves_nothing(kinds, pendulum, text, said, refused_with) -> None:
    (pendulum.parent / "own.py").write_text(text)
    with refused_with(ConfigError, (*said, "pendulum.yaml, line 1: plugins.0")):
        build_system(configured(pendulum, "own.py"))
    assert set(EFFECTS) == kinds


def test_a_file_that_is_missing_or_changed(kinds, pendulum) -> None:
    own = pendulum.parent / "own.py"
    own.write_text(EFFECT.format(kind="constant"))
    run = configured(pendulum, "own.py")
    build_system(run)
    own.write_text(EFFECT.format(kind="other"))
    with pytest.raises(ConfigError, match="changed after this process loaded it"):
        build_system(run)
    own.rename(pendulum.parent / "owm.py")
    with pytest.raises(ConfigError, match=r"no such plug-in(.|\n)*did you mean 'owm.py'"):
        build_system(run)


def test_distributions_are_found_by_their_entry_point(kinds, pendulum, monkeypatch) -> None:
    def install(name, module):
        info = pendulum.parent / name / "my_effects-1.2.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-effects\nVersion: 1.2\n")
        (info / "entry_points.txt").write_text(f"[yid_ocp.effects]\n{name} = {module}\n")
        monkeypatch.syspath_prepend(str(info.parent))
        return info.parent

    (install("constant", "constant_effect") / "constant_effect.py").write_text(EFFECT.format(kind="constant"))
    assert software_and_plugin_versions()["entry point constant"] == "my-effects 1.2"
    build_system(load_config(pendulum))
    assert "constant" in EFFECTS
    build_system(load_config(pendulum))  # as if a script had imported it before
    install("gone", "no_such_module")
    with pytest.raises(ConfigError, match=r"entry point gone raised ModuleNotFoundError(.|\n)*my-effects 1.2"):
        build_system(load_config(pendulum))


def test_a_diagnosis_names_it_and_its_command_repeats_the_result(kinds, rubbing, tmp_path, carried_out) -> None:
    (tmp_path / "own.py").write_text(EFFECT.format(kind="constant"))
    text = re.sub(r"candidates: \[.*?\]", "candidates: [constant]", rubbing.read_text())
    (tmp_path / "pushed.yaml").write_text(f"plugins: [own.py]\n{text}")
    command, results = ["diagnose", tmp_path / "pushed.yaml", "--set", "output.write_report=false"], []
    for name in ("first", "second"):
        results.append(carried_out(*command, out=name).result)
        command = shlex.split(results[-1]["command"])[1:]
    assert results[0]["inputs"][str(tmp_path / "own.py")] == file_sha256(tmp_path / "own.py")
    assert [entry["kind"] for entry in results[0]["which"]] == ["constant", "constant"]
    assert results[1]["which"] == results[0]["which"]
    assert results[1]["verdict"] == results[0]["verdict"]

"""Completion by a shell: the scripts, and the answers to what it asks."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import pytest

from yid_ocp.config.reader import settable_keys_with_prefix

pytest.importorskip("argcomplete")
FILE = "model: {object: {kind: foam_y}}\nparameters:\n  T1.bend: {free: true}\n  T1.twist: {}\n"


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_every_shell_has_its_script(cli, shell):
    done = cli("completion", shell)
    assert (done.code, done.err) == (0, "")
    assert "yid-ocp" in done.out
    program = shutil.which(shell)
    if program is not None:
        checked = subprocess.run([program, "-n"], input=done.out, text=True, capture_output=True, check=False)
        assert (checked.returncode, checked.stderr) == (0, "")


def asked(line, tmp_path):
    """What may stand at the end of a line, by the protocol of the scripts."""
    answer = tmp_path / "answer"
    asking = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "_ARGCOMPLETE_STDOUT_FILENAME": str(answer)}
    asking |= {"COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_COMP_WORDBREAKS": "\"'><=;|&(:"}
    code = "import sys; from yid_ocp.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "yid-ocp"]
    done = subprocess.run(command, env=os.environ | asking, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return {word.strip() for word in answer.read_text().splitlines()}


def test_commands_options_files_and_settings_are_completed(tmp_path):
    (tmp_path / "run.yaml").write_text(FILE)
    (tmp_path / "notes.txt").write_text("")
    (tmp_path / "past").mkdir()
    assert asked("yid-ocp so", tmp_path) == {"solve"}
    found = asked("yid-ocp check ", tmp_path)
    assert found >= {"run.yaml", "past/", "--json", "--set", "--strict"}
    assert "notes.txt" not in found
    assert asked("yid-ocp solve run.yaml --set parameters.T1.t", tmp_path) == {"parameters.T1.twist."}


def test_keys_that_may_be_set(tmp_path):
    file = tmp_path / "run.yaml"
    file.write_text(FILE)
    assert settable_keys_with_prefix("problem.ti") == ["problem.time_step="]
    assert settable_keys_with_prefix("mod") == ["model."]
    assert settable_keys_with_prefix("parameters.", file) == ["parameters.T1.bend.", "parameters.T1.twist."]
    assert "parameters.T1.bend.free=" in settable_keys_with_prefix("parameters.T1.bend.", file)
    assert settable_keys_with_prefix("parameters.") == settable_keys_with_prefix("nothing.") == []
    assert settable_keys_with_prefix("compare.methods.multi") == ["compare.methods.multiple_shooting."]
    assert "model.object.links=" in settable_keys_with_prefix("model.object.l", file)
    assert "compare.methods.multiple_shooting.condensing=" in settable_keys_with_prefix(
        "compare.methods.multiple_shooting."
    )


def test_without_the_package_the_command_says_so_and_the_shell_gets_nothing(cli, monkeypatch):
    monkeypatch.setitem(sys.modules, "argcomplete", None)
    done = cli("completion", "bash")
    assert done.code == 2
    assert "pip install 'yid-ocp[completion]'" in done.err

"""Solves that fail, interruptions and bugs: exit codes 1, 130 and 3, and what they leave behind."""

import contextlib
import io
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import Mock

import pytest

from yid_ocp.analysis import estimation
from yid_ocp.cli import main
from yid_ocp.errors import DataError
from yid_ocp.problem.episode_prediction import EpisodePredictor
from yid_ocp.workflow import simulate as simulate_module


def test_a_solve_that_does_not_converge(carried_out, pendulum):
    settings = ("solver.max_iterations=1", "solver.name=steepest_descent")
    done = carried_out("solve", pendulum, settings=settings, codes=(1,))
    assert done.result["status"] == "iteration_limit"
    assert "iterations" in done.result["message"]
    assert done.result["parameters"]["shoulder.stiffness"]["value"] > 0
    assert (done.folder / "report.html").is_file()
    assert "run folder: run" in done.out


def test_a_rollout_that_fails_leaves_reason_and_best_point(carried_out, pendulum, monkeypatch):
    told = "estimate: step 3: Newton's method did not converge"
    monkeypatch.setattr(EpisodePredictor, "predict_episodes", lambda predictor, asked, derivatives: iter([told]))
    done = carried_out("solve", pendulum, codes=(1,))
    result = done.result
    assert result["status"] == "failed"
    assert "step 3" in result["message"]
    assert result["parameters"]["shoulder.stiffness"]["std"] is None
    assert any("std" in note for note in result["notes"])
    assert "could not be predicted" in done.out
    assert "found" not in done.out.split("The held-out")[0]
    assert (done.folder / "report.html").is_file()


def test_a_bug_is_told_from_wrong_input(printed, pendulum, left_nothing, monkeypatch):
    monkeypatch.setattr(estimation, "solve", Mock(side_effect=ZeroDivisionError("a mistake of ours")))
    told = printed("solve", pendulum, code=3)
    assert "Traceback" not in told
    assert "a mistake of ours" in told
    log = Path(told.rsplit(maxsplit=1)[1])
    assert "ZeroDivisionError" in log.read_text()
    log.unlink()
    left_nothing()


@pytest.mark.skipif(os.name != "posix", reason="signals as on POSIX")
@pytest.mark.parametrize("made_of_it", [None, DataError("cut", hint=""), OSError("cut off"), ValueError("no")])
def test_an_interruption_is_one_whatever_a_library_makes_of_it(cli, pendulum, left_nothing, monkeypatch, made_of_it):
    left = []

    def swallowed(*arguments, **named):
        left.extend((path.name[0], (path / "result.json").exists()) for path in Path("runs").iterdir())
        with contextlib.suppress(*([KeyboardInterrupt] if made_of_it else [])):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(10)
        raise made_of_it

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(estimation, "solve", swallowed)
    done = cli("solve", pendulum)
    signal.signal(signal.SIGINT, before)
    assert (done.code, left) == (130, [(".", False)])  # what a kill would leave does not look finished
    assert done.err.rstrip().endswith("interrupted (SIGINT); incomplete results were discarded")
    left_nothing()


def test_a_full_disk_is_the_users_business(printed, pendulum, left_nothing, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(estimation, "solve", Mock(side_effect=FileNotFoundError(2, "No such file", "a")))
        said = printed("solve", pendulum, code=2)
        assert re.search("reports: No such file\n.*: a\n.*\n  try: correct the path\n", said)
    monkeypatch.setattr("yid_ocp.workflow.run_folder.os.replace", Mock(side_effect=OSError(28, "No space left on")))
    assert "No space left on device" in printed("solve", pendulum, code=2)
    left_nothing()


def ran(code: str, *arguments: object, **options: object) -> subprocess.CompletedProcess[str]:
    """`yid-ocp` in a shell."""
    text = " ".join([f"'{sys.executable}' -m yid_ocp", *map(str, arguments)])
    return subprocess.run(["sh", "-c", code.format(text)], capture_output=True, text=True, timeout=120, **options)


@pytest.mark.skipif(os.name != "posix", reason="a POSIX shell")
def test_a_reader_that_stops_reading(tmp_path):
    done = ran("({}; echo $? > code) | true", "schema", cwd=tmp_path)
    assert (tmp_path / "code").read_text().strip() == "2"
    assert "closed it before the whole output was printed" in done.stderr
    assert "Traceback" not in done.stderr
    done = ran("{} >&-", "schema", cwd=tmp_path)
    assert done.returncode in (0, 2)
    assert "bug" not in done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
@pytest.mark.parametrize("state", ["closed", "full"])
def test_standard_error_that_cannot_be_written_to_is_no_reason_to_stop(pendulum, tmp_path, monkeypatch, capsys, state):
    monkeypatch.chdir(tmp_path)
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stderr", None if state == "closed" else full)
        assert main(["simulate", str(pendulum), "--out", "run"]) == 0
        assert main(["simulate", "absent.yaml"]) == 2
    assert "run folder: run" in capsys.readouterr().out
    assert (tmp_path / "run" / "result.json").is_file()


def test_letters_that_the_terminal_lacks_are_shown_as_escapes(pendulum, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(said, encoding="ascii"))
    assert main(["simulate", str(pendulum), "--out", "größe"]) == 0
    assert rb"gr\xf6\xdfe" in said.getvalue()
    assert (tmp_path / "größe" / "result.json").is_file()


@pytest.mark.skipif(os.name != "posix", reason="signals as on POSIX")
def test_a_signal_that_a_library_swallows_still_ends_the_command(cli, pendulum, left_nothing, monkeypatch):
    """As an import does that tries what there is."""
    made = simulate_module.run_and_return_exit_code

    def swallow(*arguments, **named):
        with contextlib.suppress(BaseException):
            os.kill(os.getpid(), signal.SIGTERM)
        return made(*arguments, **named)

    monkeypatch.setattr(simulate_module, "run_and_return_exit_code", swallow)
    assert cli("simulate", pendulum, "--quiet").code == 143
    left_nothing()


@pytest.mark.skipif(os.name != "posix", reason="a POSIX shell")
def test_a_working_directory_that_is_gone(pendulum, tmp_path):
    (tmp_path / "gone").mkdir()
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    done = ran("rmdir ../gone; {}", "check", pendulum, cwd=tmp_path / "gone", env=environment)
    assert done.returncode == 2
    assert "working directory" in done.stderr

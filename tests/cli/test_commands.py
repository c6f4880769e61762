"""Every command on a small run: exit code, table for people, what stands in the run folder; completion by a shell."""

import argparse
import importlib
import json
import logging
import os
import pathlib
import re
import subprocess
import sys
from dataclasses import replace
from unittest.mock import Mock

import h5py
import pytest

from yid_ocp.analysis.pinocchio_comparison import compare_urdf_with_pinocchio
from yid_ocp.cli import COMMANDS
from yid_ocp.config.reader import load_config
from yid_ocp.config.schema import config_json_schema
from yid_ocp.data import read_recording
from yid_ocp.report.terminal import summary_blocks

SOLVE_KEYS = {
    "format", "status", "message", "parameters", "cost", "iterations", "evaluations", "seconds", "residuals", "fit",
    "held_out", "command", "date", "inputs", "versions", "notes", "safeguard", "discretisation", "sensor_noise",
        "covariance", "refinement_notes", "finer_settings", "stability",
    "issues", "torque_offsets", "to_use", "unused_efforts",
}  # fmt: skip
PARAMETER_KEYS = {"value", "std", "unit", "initial", "lower", "upper", "free", "verdict", "interval"}
PARAMETER_KEYS |= {"meaning", "prior_std"}


@pytest.mark.parametrize("arguments", [["--help"], ["solve", "--help"], ["--version"]])
def test_help_imports_nothing_but_the_standard_library(arguments):
    """What makes it quick: time itself is measured nowhere in tests."""
    code = (
        "import sys; before = set(sys.modules); from yid_ocp.cli import main; code = main(sys.argv[1:]);"
        "found = {name.partition('.')[0] for name in set(sys.modules) - before} - set(sys.stdlib_module_names);"
        "print('BEYOND', sorted(found)); sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.rstrip().endswith("BEYOND ['yid_ocp']")
    module = subprocess.run([sys.executable, "-m", "yid_ocp", *arguments], capture_output=True, text=True, check=False)
    assert (module.returncode, module.stdout) == (0, done.stdout.partition("BEYOND")[0])


def test_a_solve_waits_for_no_library_that_it_does_not_run():
    heavy = "scipy.stats", "scipy.signal", "scipy.ndimage", "trimesh", "plotly", "jinja2", "rich", "mujoco"
    code = f"import sys, yid_ocp.workflow.solve; print(sorted(set({heavy}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_help_has_the_groups_of_the_readme(cli, repository):
    readme = (repository / "README.md").read_text("utf-8").partition("## Commands")[2].partition("`yid-ocp COMMAND")[0]
    groups = re.findall(r"- \*\*(.*?):\*\*(.*?)(?=\n- |\Z)", readme, re.S)
    said = {
        name.lower(): re.findall("`([a-z]+)`", re.sub(r"\(\[.*?\)\)?", "", text, flags=re.S)) for name, text in groups
    }
    found = re.findall(r"\n  (\w[\w ]+):\n(.*?)(?=\n\n)", cli("--help").out, re.S)
    assert said == {name: re.findall(r"^    (\w+)", text, re.M) for name, text in found}


def test_every_command_is_a_function_of_workflow_and_prints_json():
    for row in COMMANDS:
        if isinstance(row.run, str):
            assert callable(importlib.import_module(f"yid_ocp.workflow.{row.run}").run_and_return_exit_code)
            made = argparse.ArgumentParser()
            row.add_arguments(made)
            assert {"--json", "--quiet", "--verbose"} <= set(made._option_string_actions), row.name
    assert len({row.name for row in COMMANDS}) == len(COMMANDS)


def test_solve_finds_what_the_efforts_say(cli, pendulum, pendulum_data, tmp_path):
    done = cli("solve", pendulum)
    assert done.code == 0, done.err
    [folder] = (tmp_path / "runs").iterdir()
    assert folder.name.startswith("pendulum-20")
    files = {"config.yaml", "result.json", "trajectories.h5", "report.html", "log.jsonl"}
    assert {entry.name for entry in folder.iterdir()} >= files

    result = json.loads((folder / "result.json").read_text(), parse_constant=pytest.fail)
    assert set(result) == SOLVE_KEYS
    assert (result["format"], result["status"]) == ("yid-solve/1", "converged")
    assert all(set(entry) == PARAMETER_KEYS for entry in result["parameters"].values())
    for name, value in pendulum_data.truth.items():
        entry = result["parameters"][name]
        assert entry["free"]
        assert abs(entry["value"] - value) < 4 * entry["std"] < 0.2 * value
        assert entry["verdict"] == "identifiable"
    assert result["parameters"]["shoulder.rest"]["verdict"] == "fixed"
    assert result["fit"]["explains"]
    assert 0.01 < result["fit"]["p_value"] <= 1
    assert "The model explains the recordings to within their noise" in done.out
    channel = result["residuals"]["joints.effort.shoulder"]
    assert set(result["discretisation"]) == set(pendulum_data.truth)
    for name, moved in result["discretisation"].items():
        # its damping is that of a robot's joints, without links
        assert moved["links"] is None
        assert abs(moved["time_step"]) < 0.01 * pendulum_data.truth[name]
        assert 0 < moved["std"] <= result["parameters"][name]["std"]
    assert done.out.count("Half the time step would") == 1
    assert (set(channel), channel["unit"]) == ({"rmse", "unit", "n", "expected", "baselines"}, "N m")
    assert 0.005 < channel["rmse"] < 0.02
    held_out = result["held_out"][0]
    assert set(held_out) == {"recording", "rmse", "baselines", "expected"}
    assert held_out["rmse"]["joints.effort.shoulder"] < 0.1 * held_out["baselines"]["zero"]["joints.effort.shoulder"]
    assert len(result["inputs"]) == 4
    assert all(len(digest) == 64 for digest in result["inputs"].values())
    assert {"python", "yid-ocp", "casadi", "numpy"} <= set(result["versions"])

    events = [json.loads(line)["event"] for line in (folder / "log.jsonl").read_text().splitlines()]
    assert (events[0], events[-1], events.count("iterate") >= 2) == ("start", "end", True)

    assert load_config(folder / "config.yaml").solver == load_config(pendulum).solver
    with h5py.File(folder / "trajectories.h5") as file:
        assert file.attrs["format"] == "yid-trajectories/2"
        group = file["recordings/estimate"]
        assert group["q"].shape == (121, 2)
        assert group["joints.effort/predicted"].shape == group["joints.effort/measured"].shape
        assert list(file["unknowns"].attrs["names"]) == list(pendulum_data.truth)
    for words in ("shoulder.stiffness", "N m/rad", "held-out recording", "run folder: runs", "converged"):
        assert words in done.out
    assert "iteration 1" in done.err


def test_a_resolved_configuration_runs_again(carried_out, pendulum):
    first = carried_out("solve", pendulum, settings=["output.write_report=false"], out="first")
    assert not (first.folder / "report.html").exists()
    second = carried_out("solve", first.folder / "config.yaml", out="second")
    assert first.result["parameters"] == second.result["parameters"]


def test_without_the_extra_report(pendulum, tmp_path):
    code = (
        "import sys; sys.modules['plotly'] = None;"
        "import importlib.util as util; find = util.find_spec;"
        "util.find_spec = lambda name, *a: None if name == 'plotly' else find(name, *a);"
        "from yid_ocp.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", code, "simulate", str(pendulum), "--out", "run"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count(".[report]") == 1
    assert (tmp_path / "run" / "result.json").is_file()
    assert not (tmp_path / "run" / "report.html").exists()


def test_quiet_prints_the_folder_alone_and_set_changes_the_run(carried_out, pendulum):
    settings = ("parameters.elbow.damping.free=false", "problem.duration=0.5")
    done = carried_out("solve", pendulum, "--quiet", settings=settings)
    assert (done.out.strip(), done.err) == (str(done.folder), "")
    assert not done.result["parameters"]["elbow.damping"]["free"]
    assert done.result["residuals"]["joints.effort.shoulder"]["n"] < 60


def test_a_named_empty_folder_may_be_used(cli, pendulum, tmp_path):
    (tmp_path / "empty").mkdir()
    done = cli("solve", pendulum, "--out", "empty", "--json")
    assert done.code == 0
    assert done.out == (tmp_path / "empty" / "result.json").read_text()
    assert done.err == f"run folder: {os.path.relpath(tmp_path / 'empty')}\n"


def test_errors_are_json_where_that_is_asked_for(cli, pendulum, tmp_path, monkeypatch):
    wrong = cli("solve", pendulum, "--json", "--set", "solver.iteration=3")
    assert wrong.code == 2
    assert json.loads(wrong.out) == {
        "format": "yid-error/1",
        "kind": "ConfigError",
        "what": "there is no key 'iteration'",
        "where": "--set solver.iteration",
        "allowed": "name, max_iterations, step_tolerance, cost_tolerance",
        "hint": "did you mean 'max_iterations'? CHANGELOG.md of the project has the new names of older ones",
        "exit_code": 2,
    }
    assert "did you mean 'max_iterations'?" in wrong.err
    assert json.loads(cli("solve", "--json", "--sett", "a").out)["what"].endswith("no option '--sett'")
    assert cli("solve", "--sett", "a").out == ""
    broken, command = Mock(side_effect=ZeroDivisionError("no good")), "yid_ocp.workflow.check.run_and_return_exit_code"
    monkeypatch.setattr(command, broken)
    bug = cli("check", pendulum, "--json")
    said = json.loads(bug.out)
    assert (bug.code, said["exit_code"], said["kind"], said["what"]) == (3, 3, "bug", "ZeroDivisionError: no good")
    pathlib.Path(said["where"]).unlink()  # which is there
    monkeypatch.setattr(command, Mock(side_effect=KeyboardInterrupt))
    ended = cli("check", pendulum, "--json")
    assert (ended.code, json.loads(ended.out)["exit_code"]) == (130, 130)


def test_a_notice_is_shown_once(cli, pendulum, monkeypatch):
    def noted(arguments):
        for text in ("a coupling is not modelled", "another thing", "a coupling is not modelled"):
            logging.getLogger("yid_ocp.model").warning(text)
        return 0

    monkeypatch.setattr("yid_ocp.workflow.check.run_and_return_exit_code", noted)
    for _ in range(2):
        [first, second] = cli("check", pendulum).err.splitlines()
        assert ("a coupling is not modelled" in first, "another thing" in second) == (True, True)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ("COMMAND",)),
        (["slove"], ("there is no command 'slove'", "did you mean 'solve'?")),
        (["check"], ("the following arguments are required: CONFIG.yaml", "where: yid-ocp check", "--help")),
        (["check", "a.yaml", "b.yaml"], ("'b.yaml' is one argument too many",)),
        (["check", "--set", "a.b", "=", "0.1"], ("--set a.b has no value", "--set a.b=VALUE")),
        (["solve", "--qiet"], ("there is no option '--qiet'", "where: yid-ocp solve", "did you mean '--quiet'?")),
        (["batch", "a", "--command", "slv"], ("there is no choice of --command 'slv'", "allowed: solve, diagnose")),
    ],
)
def test_a_wrong_command_line_is_told_like_all_that_is_wrong(cli, arguments, words):
    done = cli(*arguments)
    assert (done.code, done.out) == (2, "")
    for word in words:
        assert word in done.err


def test_check(carried_out, pendulum):
    done = carried_out("check", pendulum)
    result = done.result
    assert (result["format"], result["model"]["n"]) == ("yid-check/1", 2)
    assert [entry["role"] for entry in result["recordings"]] == ["estimate", "held_out"]
    assert all(text in done.out for text in ("100 Hz", "run folder: run"))
    assert not any("effort_kind" in text for text in result["warnings"])
    assert set(result["mechanics"]) == {"built", "file"}
    assert all(entry["agrees"] for entry in result["mechanics"].values())
    assert "kinematics for this model and the file double_pendulum.urdf." in " ".join(done.out.split())


def test_check_says_what_kind_of_torque_is_assumed(carried_out, pendulum, pendulum_data, tmp_path):
    (tmp_path / "untold.h5").write_bytes((pendulum_data.folder / "estimate.h5").read_bytes())
    with h5py.File(tmp_path / "untold.h5", "r+") as file:
        del file["joints"].attrs["effort_kind"]
    result = carried_out("check", pendulum, settings=["recordings.estimate=[untold.h5]"]).result
    [said] = [text for text in result["warnings"] if "effort_sampling_kind" in text]
    assert said.startswith("in 'untold', efforts are taken as the torques at the times of the samples, because")


def test_check_refines_links_and_time_step(carried_out, written):
    beam = "{length: 0.5, mass: 0.3, radius: 0.01, values_given_as_rigidities: true, clamped_at_base: true}"
    file = written(
        f"model: {{object: {{kind: segments, named_segments: {{beam: {beam}}}}}, damping: 0.001, gravity: [0, 0, 0]}}\n"
        "parameters: {beam.bend: {initial: 0.5}, beam.twist: {initial: 0.5}}\n"
    )
    done = carried_out("check", file)
    convergence = done.result["convergence"]
    assert [row["value"] for row in convergence["links"]] == [4, 8]
    assert [row["value"] for row in convergence["time_step"]] == [0.01, 0.005, 0.0025]
    # a clamped uniform beam: f1 = 1.8751^2/(2 pi) sqrt(EI/(rho A L^4))
    exact = 1.8751**2 / 6.2832 * (0.5 / (0.3 / 0.5 * 0.5**4)) ** 0.5
    coarsest, finest = (row["hertz"][0] for row in convergence["links"])
    assert abs(finest - exact) < 0.05 * exact
    assert abs(finest - exact) < abs(coarsest - exact)
    assert "warning: at the initial values, natural frequencies change by more than 2 % when" in done.out
    heavy = carried_out("check", file, "--set", "model.object.named_segments.beam.mass=300", out="heavy")
    assert "'beam' has the density 1.9e+06 kg/m^3" in heavy.out
    assert "density" not in done.out


def test_inspect(carried_out, pendulum, tmp_path):
    entries = ("del[elbow], elbow.damping", "p1[shoulder]", "elbow.mass", "elbow.damping")
    asked = [part for entry in entries for part in ("--entry", entry)]
    done = carried_out("inspect", pendulum, *asked, "--export", "eq")
    folder, result = done.folder, done.result
    assert (result["format"], result["patterns"]["A"]["shape"]) == ("yid-inspect/1", [4, 4])
    assert [entry["role"] for entry in result["variables"]] == ["prescribed", "prescribed"]
    assert result["parameters"]["shoulder.stiffness"]["free"]
    assert (folder / "sparsity.png").read_bytes().startswith(b"\x89PNG")
    damping = result["dependence"]["elbow.damping"]
    assert damping["rows"] == damping["seen"] == ["del[elbow]", "p1[elbow]"]
    assert damping["best"] == "joints.effort"
    table = done.out.split("recorded readings:", 1)[1].split("\nParameters:")[0]
    row, equations = (re.split(r"\s{2,}", line) for line in table.splitlines() if line.startswith("elbow.damping"))
    assert (row[3:], equations[1:3]) == (["yes", "joints.effort"], ["del[elbow], p1[elbow]", "all"])
    assert float(row[2]) == pytest.approx(float(row[1].split()[0]) * damping["along"], rel=0.02)
    assert done.out.startswith("The readings change visibly with elbow.damping.")
    result["dependence"]["shoulder.stiffness"]["along"] = result["dependence"]["elbow.damping"]["along"] = 1e-3
    text = summary_blocks(result)[0].text
    assert ("hardly determine elbow.damping," in text, "shoulder.stiffness" in text) == (True, False)
    # what is not asked for is in the result alone
    assert ("shoulder.stiffness" in table, "elbow.mass" in table) == (False, True)
    assert len(result["dependence"]["elbow.mass"]["rows"]) == 4
    assert result["dependence"]["elbow.mass"]["along"] is None
    assert any(line.startswith("del[elbow]: ") for line in (folder / "equations.txt").read_text().splitlines())
    with h5py.File(folder / "linearisation.h5") as file:
        assert (file["A"].shape, file["B_theta"].shape) == ((4, 4), (4, len(result["parameters"])))
        before = file["state"][2]
    assert [entry["title"] for entry in result["entries"]] == ["d del[elbow] / d elbow.damping", "p1[shoulder]"]
    assert result["asked"] == ["elbow.mass", "elbow.damping"]
    assert all(line in done.out for entry in result["entries"] for line in entry["lines"])
    # a damper takes half of what the coordinate moves, which is nothing at rest; there the momentum stays what it was
    slope, momentum = result["entries"]
    assert slope["value"] == pytest.approx(0.0, abs=1e-12)
    assert abs(before) > 1e-3
    assert momentum["value"] == pytest.approx(before, rel=1e-9)
    assert f"p1[shoulder] at rest at the first posture of estimate is {before:.6g} (" in " ".join(done.out.split())
    files = {path.name for path in (tmp_path / "eq").iterdir()}
    assert files == {pathlib.Path(name).name for name in result["exported"]}
    assert {"rows.casadi", "equations.c", "names.json"} <= files


def test_inspect_without_recordings(carried_out, written, urdf_folder):
    file = written(
        f"model:\n  robot: {urdf_folder / 'double_pendulum.urdf'}\n  arms: {{mode: driven}}\n"
        "problem: {use_compiler: false}\n"
    )
    result = carried_out("inspect", file).result
    # the pendulums hang and are damped: no change of the state grows
    assert 0.99 < result["linearisation"]["spectral_radius"] < 1.0
    assert (result["equations"]["unknowns"], result["equations"]["jacobian_nonzeros"]) == (2, 4)


MEANT = {"dle[elbow]": "del[elbow]", "del[elbow], q1[elbo]": "q1[elbow]", "elbow.mas": "elbow.mass"}
WRONG_ENTRIES = {entry: f"did you mean '{name}'?" for entry, name in MEANT.items()}
WRONG_ENTRIES["del[elbow], h, h"] = "ROW (an equation), or ROW, COLUMN (its derivative"


@pytest.mark.parametrize(("entry", "said"), WRONG_ENTRIES.items())
def test_a_wrong_entry_leaves_nothing_behind(printed, pendulum, tmp_path, entry, said):
    assert said in printed("inspect", pendulum, "--out", "i", "--entry", entry, "--export", "eq", code=2)
    assert not (tmp_path / "i").exists()
    assert not (tmp_path / "eq").exists()


def test_check_warns_of_a_file_that_another_library_reads_otherwise(printed, pendulum, monkeypatch):
    def otherwise(*arguments, **more):
        return replace(compare_urdf_with_pinocchio(*arguments, **more), mass=0.03)

    monkeypatch.setattr("yid_ocp.workflow.check.compare_urdf_with_pinocchio", otherwise)
    told = printed("check", pendulum, "--out", "c")
    assert "warning: the file double_pendulum.urdf differs from Pinocchio's: mass matrix by 3 %" in told
    unread = Mock(side_effect=ValueError("no such joint type"))
    monkeypatch.setattr("yid_ocp.workflow.check.compare_urdf_with_pinocchio", unread)
    told = printed("check", pendulum, "--out", "d")
    assert "warning: double_pendulum.urdf is not compared, because Pinocchio cannot read it: no such joint" in told


def test_check_compares_no_mjcf_file_with_a_library_that_reads_urdf(printed, tmp_path):
    pytest.importorskip("mujoco")
    body = (
        "<body><joint name='j' axis='0 1 0'/><geom type='capsule' fromto='0 0 0 0 0 -0.3' size='0.02' mass='1'/></body>"
    )
    (tmp_path / "arm.xml").write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    (tmp_path / "arm.yaml").write_text("model: {robot: arm.xml, arms: {joints: [j], mode: driven}}\n")
    told = printed("check", tmp_path / "arm.yaml", "--out", tmp_path / "m", "--set", "output.write_report=false")
    assert "is not compared" not in told
    assert "computes the same masses, inertias and kinematics for this model" in " ".join(told.split())


def test_what_is_simulated_is_exported_and_imported(printed, pendulum_data, tmp_path):
    recording = read_recording(pendulum_data.folder / "estimate.h5")
    assert recording.joint_names == ("shoulder", "elbow")
    assert abs(recording.joints.effort).max() > 0.5
    # of prescribed joints: what they need at the nodes
    assert recording.joints.effort_kind == "sample"
    assert recording.true_parameters["shoulder.stiffness"] == pendulum_data.truth["shoulder.stiffness"]
    printed("export", pendulum_data.folder / "estimate.h5", "--out", tmp_path / "csv")
    told = printed("import", next((tmp_path / "csv").glob("*.csv")), "--out", tmp_path / "back.h5")
    assert read_recording(tmp_path / "back.h5", allow_nan_effort=True).joint_names == ("shoulder", "elbow")
    assert "back.h5" in told


def test_schema_is_the_one_beside_the_configurations(cli, repository, tmp_path):
    assert cli("schema", "--out", tmp_path / "schema.json").code == 0
    made, kept = (path.read_text() for path in (tmp_path / "schema.json", repository / "configs" / "schema.json"))
    assert made == kept, "regenerate it with  yid-ocp schema --out configs/schema.json"
    assert json.loads(kept) == config_json_schema()


FILE = "model: {object: {kind: foam_y}}\nparameters:\n  T1.bend: {free: true}\n  T1.twist: {}\n"


def asked(line, tmp_path):
    """What may stand at the end of a line, by the protocol of the scripts."""
    pytest.importorskip("argcomplete")
    answer = tmp_path / "answer"
    asking = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "_ARGCOMPLETE_STDOUT_FILENAME": str(answer)}
    asking |= {"COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_COMP_WORDBREAKS": "\"'><=;|&(:"}
    command = [sys.executable, "-c", "import sys; from yid_ocp.cli import main; sys.exit(main())", "yid-ocp"]
    done = subprocess.run(command, env=os.environ | asking, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return {word.strip() for word in answer.read_text().splitlines()}


def test_commands_options_and_files_are_completed(tmp_path):
    (tmp_path / "run.yaml").write_text(FILE)
    (tmp_path / "past").mkdir()
    assert asked("yid-ocp so", tmp_path) == {"solve"}
    assert asked("yid-ocp check ", tmp_path) >= {"run.yaml", "past/", "--json", "--set", "--strict"}

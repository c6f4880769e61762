"""Commands run as the pages print them, in a folder with the files that they name, the costly ones as slow tests."""

import json
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from argparse import ArgumentParser
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio
import pytest
from made_lerobot import lerobot_dataset
from ruamel.yaml import YAML
from test_documents import blocks, printed_commands

from yid_ocp.cli import build_argument_parser, main
from yid_ocp.config.reader import load_config
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.data.recording_hdf5 import read_recording, write_recording
from yid_ocp.export.signals import export_mcap, export_recording_csv_files, ros_signals_from_recording
from yid_ocp.model.urdf import urdf_path_from_robot_name
from yid_ocp.workflow.init import _object_from_arguments

PARSED_ONLY = {
    r"blind (?!--join).*": "20 to 300 virtual experiments and their diagnoses, of a minute each",
    r"track \w+\.yaml .*": "needs frames of a depth camera",
    r"diagnose configs/(baxter_arm|deft_bdlo1).*": "take 6 and 35 minutes of CPU time (docs/reference/speed.md)",
}
"""Patterns of the commands that are not run, with the reason."""
COSTLY = (
    r"(check|solve|diagnose|identifiability|compare|inspect|friction|plan|track) configs/(?!springs).*",
    r"(solve|diagnose)( --out \S+)?|(solve|diagnose) (run|cable|again)\.yaml|check cable\.yaml",
    r"export found .*|batch .* --command diagnose .*",
)
"""Patterns of the commands that only the slow tests run."""
UNFINISHED = ("solve cable.yaml",)
"""Searches that do not converge: as its page says, and because the markers below do not hang on a cable."""
PROGRAMS = ("README", "export", "experiment", "workers", "import_formats", "recordings")
"""Pages with a program in Python that the slow tests run after the page's commands."""
REPOSITORY = Path(__file__).resolve().parents[2]
FILES = (REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *sorted(REPOSITORY.glob("docs/**/*.md")))
PAGES = {p: p.read_text("utf-8") for p in FILES}
PRINTED = {p: found for p, text in PAGES.items() if (found := printed_commands(text)) or p.stem == "recordings"}
PARSER = build_argument_parser()
SCRIPT = re.compile(r"(`)?python\s+((?:benchmarks|docs)/(?(1)[^`]+|[^#\n]+))")
"""Command of a script beside the package, in a sentence or on a line of its own."""
SCRIPTS = sorted({" ".join(said.split()) for text in PAGES.values() for _, said in SCRIPT.findall(text)})
STAND_INS = {"NAME ...": "friction", "NAME": "friction", "ROBOT": "1", "CASE": "clean"}
BRIEF = [said for said in SCRIPTS if re.search(r"torque_noise|wrist$|one_way|--simulated$|--only hands", said)]
"""Scripts that need less than a minute of CPU time."""


def understood(arguments: list[str]) -> None:
    parsed = PARSER.parse_args(arguments)
    if arguments[0] == "init":
        _object_from_arguments(parsed)  # has all the numbers that it needs


def swung(urdf: str | Path, tool: str) -> Recording:
    """A swing of all joints from rest, with two markers below the tool, as those of a cable of 1 m."""
    model = pinocchio.buildModelFromUrdf(str(urdf))
    names, data, t = tuple(model.names)[1:], model.createData(), 0.01 * np.arange(301)
    path = 0.2 * (1 - np.cos(np.outer(t, 1 + 0.3 * np.arange(len(names)))))
    tools = []
    for q in path[::2]:
        pinocchio.framesForwardKinematics(model, data, pinocchio.integrate(model, pinocchio.neutral(model), q))
        tools.append(data.oMf[model.getFrameId(tool)].translation.copy())
    seen = np.array(tools)[:, None] - [[0, 0, 0.5], [0, 0, 1.0]]
    joints = JointGroup(names, t, path, effort=np.cos(np.outer(t, 1 + np.arange(len(names)))))
    return Recording(joints, (PointGroup("points", ("middle", "tip"), t[::2], seen),), name="swing")


@pytest.fixture(scope="module")
def lab(tmp_path_factory, pendulum_data, repository) -> Path:
    """A folder with the files that the pages name, where RUN is a finished run."""
    folder, urdf = tmp_path_factory.mktemp("lab"), repository / "models" / "urdf" / "double_pendulum.urdf"
    shutil.copy(urdf, folder / "my_robot.urdf")
    shutil.copytree(repository / "configs", folder / "configs")
    for name in ("benchmarks", "models", "yid_ocp"):
        (folder / name).symlink_to(repository / name)
    swing = swung(urdf, "tip")
    for name in ("recording", "one", "two"):
        write_recording(swing, folder / f"{name}.h5")
    export_recording_csv_files(swing, folder)
    (folder / "points.csv").rename(folder / "mocap.csv")
    of_arm = swung(urdf_path_from_robot_name("package:ur5"), "tool0")
    export_mcap(ros_signals_from_recording(of_arm), folder / "swing.mcap")
    t, angles = swing.joints.t[:, None], np.degrees(swing.joints.position)
    np.savetxt(folder / "run.csv", np.hstack([t, angles]), delimiter=",", header="t,q1,q2", comments="")
    arm = np.hstack([t, *[swing.joints.position] * 4, *[swing.joints.effort] * 4])[:, [*range(8), *range(9, 16)]]
    head = ",".join(["t", *(f"{kind}_joint{i + 1}" for kind in ("q", "tau") for i in range(7))])
    for name in ("one", "two"):
        np.savetxt(folder / f"{name}.csv", arm, delimiter=",", header=head, comments="")
    rng = np.random.default_rng(0)
    for name in ("today_1", "today_2", "monday/first", "monday/late/second"):
        (folder / name).parent.mkdir(exist_ok=True)
        known = read_recording(pendulum_data.folder / ("held_out.h5" if name == "today_2" else "estimate.h5"))
        effort = known.joints.effort + 0.001 * rng.normal(size=known.joints.effort.shape)
        write_recording(replace(known, joints=replace(known.joints, effort=effort)), folder / f"{name}.h5")
    few = "diagnosis: {candidates: [joint_coulomb, effort_offset]}\n"
    for name in ("CONFIG", "RUN", "A", "robot_a", "robot_b", "robot_c", "arm"):
        (folder / f"{name}.yaml").write_text(pendulum_data.text + few)
    for run in ("RUN", "RUN_2", "RUN_3"):
        assert main(["solve", str(folder / "RUN.yaml"), "--out", str(folder / run), "--quiet"]) == 0
    lerobot_dataset(folder / "DATASET", read_recording(folder / "configs" / "recordings" / "so101_1.h5").joints)
    return folder


@pytest.mark.parametrize(
    "left", [(*PARSED_ONLY, *COSTLY), pytest.param(PARSED_ONLY, marks=pytest.mark.slow)], ids=["cheap", "all"]
)
@pytest.mark.parametrize("page", PRINTED, ids=lambda page: page.stem)
def test_printed_commands_are_understood_and_run(page, left, lab, tmp_path, monkeypatch, request):
    shutil.copytree(lab, tmp_path / "lab", symlinks=True)
    (tmp_path / "shared").symlink_to(REPOSITORY.parent / "shared")
    monkeypatch.chdir(tmp_path / "lab")
    if page.stem == "baseline":
        shutil.rmtree("monday")  # there it is a run
    for _, *arguments in PRINTED[page]:
        said = shlex.join(arguments)
        if arguments[0] == "init":  # files that it makes, or another example of the page has
            for made in (arguments[-1], *(word.replace(".csv", ".h5") for word in arguments if ".csv" in word)):
                Path(made).unlink(missing_ok=True)
        files = [Path(word) for word in arguments if re.fullmatch(r"configs/\w+\.yaml", word)]
        assert all(file.is_file() for file in files), said
        if any(re.fullmatch(pattern, said) for pattern in left):
            understood(arguments)
            continue
        if arguments[0] == "report":  # RUN stands for several runs
            arguments = [f"RUN_{i}" if i > 1 and word == "RUN" else word for i, word in enumerate(arguments)]
        if any("/shared/" in file.read_text(encoding="utf-8") for file in files):
            request.getfixturevalue("shared")
        assert main(arguments) == (said in UNFINISHED), said
    if left is PARSED_ONLY and page.stem in PROGRAMS:
        [program] = blocks(PAGES[page], "python")
        exec(compile(program, page.name, "exec"), {})


def test_only_commands_that_are_printed_are_left_out():
    printed = [shlex.join(arguments) for commands in PRINTED.values() for _, *arguments in commands]
    left = {pattern: {said for said in printed if re.fullmatch(pattern, said)} for pattern in (*PARSED_ONLY, *COSTLY)}
    assert all(left.values())
    assert len(printed) > 50
    assert len(set(printed) - set().union(*left.values())) > 20


def test_sentences_and_yaml_blocks_are_understood():
    """Their commands can be parsed, and blocks are parts of configurations, but for pages that have their own test."""
    for page, text in PAGES.items():
        for said in re.findall(r"`yid-ocp ([a-z]+\s(?!--help)[^`]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL)):
            understood(shlex.split(said))
        for block in blocks(text, "yaml") if page.stem not in ("settings", "extending") else ():
            said = YAML(typ="safe", pure=True).load(block)
            load_config(None, [f"{section}={json.dumps(value)}" for section, value in said.items()])


@pytest.mark.parametrize("said", SCRIPTS)
def test_printed_scripts_take_their_arguments(said, monkeypatch):
    script, *words = shlex.split(re.sub("|".join(STAND_INS), lambda word: STAND_INS[word[0]], said))
    parse = ArgumentParser.parse_args
    _ = "mutation" in script and pytest.importorskip("cosmic_ray", reason="belongs to the extra dev")
    monkeypatch.setattr(ArgumentParser, "parse_args", lambda *given: (parse(*given), sys.exit("understood")))
    monkeypatch.setattr(Path, "write_text", lambda *_, **__: sys.exit("understood"))  # of a script without arguments
    monkeypatch.setattr(sys, "argv", [script, *words])
    monkeypatch.syspath_prepend(REPOSITORY / "benchmarks")
    monkeypatch.delitem(sys.modules, "coverage", raising=False)  # a benchmark has this name
    with pytest.raises(SystemExit, match="understood"):
        runpy.run_path(str(REPOSITORY / script), run_name="__main__")


@pytest.mark.slow
@pytest.mark.parametrize("said", BRIEF)
def test_brief_scripts_run(said, shared):
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    subprocess.run([sys.executable, *shlex.split(said)], cwd=REPOSITORY, env=environment, check=True)

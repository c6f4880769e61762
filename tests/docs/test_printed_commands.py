"""Commands run as the pages print them, in a folder with the files that they name; the costly ones are only parsed."""

from __future__ import annotations

import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio
import pytest
from test_documents import printed_commands

from yid_ocp.cli import build_argument_parser, main
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.data.recording_hdf5 import read_recording, write_recording
from yid_ocp.errors import ConfigError
from yid_ocp.export.signals import export_mcap, export_recording_csv_files, ros_signals_from_recording
from yid_ocp.model.urdf import urdf_path_from_robot_name
from yid_ocp.workflow.init import _object_from_arguments

PARSED_ONLY = {
    r"blind .*": "a virtual experiment and its diagnosis take a minute per case",
    r"track .*": "a script makes the frames of a camera, and a fit takes minutes",
    r"(check|solve|diagnose|identifiability|compare|inspect) '?configs/(?!springs).*": "compiles and fits two arms",
    r"(solve|diagnose)( --out \S+)?": "compiles and fits the embedded recordings",
    r"(solve|diagnose) (run|cable)\.yaml|check cable\.yaml": "compiles and fits a cable",
    r"friction .*|plan .*": "takes minutes",
    r"export found .*|solve again\.yaml": "needs the diagnosis of the embedded recordings",
    r"init package:so101 DATASET .*": "needs a dataset of LeRobot, as in tests/workflow/test_init.py",
    r"report RUN RUN.*": "RUN stands for the folders of several runs",
    r"batch .* --command diagnose .*": "a diagnosis of each of several recordings",
}
"""Patterns of the commands that are not run, with the reason."""
REPOSITORY = Path(__file__).resolve().parents[2]
PAGES = [REPOSITORY / "README.md", *sorted(REPOSITORY.glob("docs/**/*.md"))]
PRINTED = {path: commands for path in PAGES if (commands := printed_commands(path.read_text(encoding="utf-8")))}


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
    (folder / "configs").symlink_to(repository / "configs")
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
    assert main(["solve", str(folder / "RUN.yaml"), "--out", str(folder / "RUN"), "--quiet"]) == 0
    return folder


@pytest.mark.parametrize("page", PRINTED, ids=lambda page: page.stem)
def test_printed_commands_are_understood_and_the_cheap_ones_run(page, lab, tmp_path, monkeypatch):
    shutil.copytree(lab, tmp_path / "lab", symlinks=True)
    monkeypatch.chdir(tmp_path / "lab")
    if page.stem == "baseline":
        shutil.rmtree("monday")  # there it is a run
    for _, *arguments in PRINTED[page]:
        said = shlex.join(arguments)
        if arguments[0] == "init":  # files that it makes, or another example of the page has
            for made in (arguments[-1], *(word.replace(".csv", ".h5") for word in arguments if ".csv" in word)):
                Path(made).unlink(missing_ok=True)
        assert all(Path(word).is_file() for word in arguments if re.fullmatch(r"configs/\w+\.yaml", word)), said
        if not any(re.fullmatch(pattern, said) for pattern in PARSED_ONLY):
            assert main(arguments) == 0, said
            continue
        try:
            parsed = build_argument_parser().parse_args(arguments)
            if arguments[0] == "init":
                _object_from_arguments(parsed)  # has all the numbers that it needs
        except (SystemExit, ConfigError) as error:
            pytest.fail(f"{said}: {error}")


def test_only_commands_that_are_printed_are_left_out():
    printed = [shlex.join(arguments) for commands in PRINTED.values() for _, *arguments in commands]
    left = {pattern: {said for said in printed if re.fullmatch(pattern, said)} for pattern in PARSED_ONLY}
    assert all(left.values())
    assert len(printed) > 50
    assert len(set(printed) - set().union(*left.values())) > 20

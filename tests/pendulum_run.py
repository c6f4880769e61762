"""A run small enough for seconds: a double pendulum moved as measured, springs and dampers estimated from effort."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from yid_ocp.cli import main
from yid_ocp.data import JointGroup, Recording, read_recording, write_recording
from yid_ocp.solvers import GaussNewton, fit_problem
from yid_ocp.workflow.build_problem import load_problem

TRUTH = {"shoulder.stiffness": 4.0, "shoulder.damping": 0.3, "elbow.damping": 0.2}
EFFORT_STD = 0.01

CONFIG = """\
description: A double pendulum, moved as measured.
model:
  robot: {urdf}
  arms: {{mode: prescribed}}
  joint_springs:
    shoulder: {{stiffness: 1.0, rest_position: 0.2}}
recordings:
  estimate: [{estimate}]
  held_out: [{held_out}]
parameters:
  shoulder.stiffness: {{free: true, bounds: [0.0, 100.0]}}
  shoulder.damping: {{free: true}}
  elbow.damping: {{free: true}}
problem:
  path_cutoff: .inf
  use_compiler: false
solver:
  name: gauss_newton
"""


def motion(seed: int, steps: int = 120) -> Recording:
    """Two joints on smooth paths at 100 Hz, efforts still zero."""
    rng = np.random.default_rng(seed)
    t = 0.01 * np.arange(steps + 1)

    def wave():
        return sum(rng.normal() * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) / f for f in (0.4, 0.9, 1.7))

    position = 0.5 * np.stack([wave(), wave()], axis=1)
    stds = {"effort_std": EFFORT_STD, "position_std": 0.0}
    joints = JointGroup(("shoulder", "elbow"), t, position, effort=np.zeros_like(position), **stds)
    return Recording(joints, source="test", name=f"motion_{seed}")


@pytest.fixture
def cli(capsys):
    """Run a command; returns exit code, standard output and standard error."""

    def run(*arguments: object, settings: Sequence[str] = ()) -> SimpleNamespace:
        capsys.readouterr()
        code = main([*map(str, arguments), *(part for entry in settings for part in ("--set", entry))])
        captured = capsys.readouterr()
        return SimpleNamespace(code=code, out=captured.out, err=captured.err)

    return run


@pytest.fixture
def printed(cli):
    """Run a command that ends with a code; what it prints, or the message where it fails."""

    def run(*arguments: object, code: int = 0, settings: Sequence[str] = ()) -> str:
        done = cli(*arguments, settings=settings)
        assert done.code == code, done.err
        return done.err if code else done.out

    return run


@pytest.fixture
def carried_out(cli, tmp_path):
    """Run a command that succeeds, into the folder `out`; what `cli` returns, with the folder and its result."""

    def run(*arguments: object, settings: Sequence[str] = (), out: str = "run", codes=(0,)) -> SimpleNamespace:
        done = cli(*arguments, "--out", tmp_path / out, settings=settings)
        assert done.code in codes, done.err
        done.folder = tmp_path / out
        done.result = json.loads((done.folder / "result.json").read_text(), parse_constant=pytest.fail)
        return done

    return run


@pytest.fixture(scope="session")
def pendulum_data(tmp_path_factory, urdf_folder):
    """Folder with `estimate.h5` and `held_out.h5`, simulated with TRUTH, and the text of a configuration."""
    folder = tmp_path_factory.mktemp("pendulum")
    for seed, name in ((1, "estimate"), (2, "held_out")):
        write_recording(motion(seed), folder / "motion.h5")
        text = CONFIG.format(urdf=urdf_folder / "double_pendulum.urdf", estimate="motion.h5", held_out="motion.h5")
        (folder / "simulate.yaml").write_text(text)
        said = ["recordings.held_out=[]", *(f"parameters.{name}.initial={value}" for name, value in TRUTH.items())]
        settings = [part for setting in said for part in ("--set", setting)]
        out = folder / f"simulate_{name}"
        arguments = ["--out", str(out), "--noise", "--seed", str(seed), "--quiet"]
        assert main(["simulate", str(folder / "simulate.yaml"), *arguments, *settings]) == 0
        (out / "recording.h5").rename(folder / f"{name}.h5")
    files = {name: folder / f"{name}.h5" for name in ("estimate", "held_out")}
    text = CONFIG.format(urdf=urdf_folder / "double_pendulum.urdf", **files)
    return SimpleNamespace(folder=folder, text=text, truth=TRUTH)


@pytest.fixture(scope="session")
def solved_pendulum(pendulum_data):
    """The pendulum's problem, its solution, and the predictions held out."""
    file = pendulum_data.folder / "solved.yaml"
    file.write_text(pendulum_data.text)
    problem = load_problem(file)
    solution = fit_problem(problem, GaussNewton())
    return problem, solution, problem.predict_held_out(solution.x)


@pytest.fixture(scope="session")
def rubbing(tmp_path_factory, pendulum_data):
    """The configuration of a pendulum whose elbow rubs, which its model does not know."""
    folder = tmp_path_factory.mktemp("rubbing")
    for name in ("estimate", "held_out"):
        recording = read_recording(pendulum_data.folder / f"{name}.h5")
        joints = recording.joints
        rubbed = joints.effort.copy()
        rubbed[:, 1] += 0.03 * np.sign(np.gradient(joints.position[:, 1]))
        write_recording(replace(recording, joints=replace(joints, effort=rubbed)), folder / f"{name}.h5")
    text = pendulum_data.text.replace(str(pendulum_data.folder), str(folder))
    file = folder / "rubbing.yaml"
    candidates = "diagnosis: {candidates: [joint_coulomb, effort_offset, link_mass@elbow], max_effects: 1}"
    file.write_text(f"{text}{candidates}\noutput: {{write_report: false}}\n")
    return file


@pytest.fixture
def pendulum(pendulum_data, tmp_path, monkeypatch) -> Path:
    """A fresh working folder with the configuration `pendulum.yaml` in it."""
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "pendulum.yaml"
    file.write_text(pendulum_data.text)
    return file


@pytest.fixture
def left_nothing(tmp_path):
    """Check that a command left no run folder, not even an unfinished one."""
    before = set(tmp_path.rglob("*"))

    def check(*also: Path) -> None:
        found = set(tmp_path.rglob("*")) - before - set(also)
        left = [path for path in found if path.suffix not in (".yaml", ".h5")]
        assert left == []

    return check

"""A new user: a bag of an arm with something flexible in its hand, commands in order, no edit of what they write."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from made_newcomer import PANDA, SERVO, SERVOS, UR5, write_mcap

from yid_ocp.cli import main
from yid_ocp.config.reader import load_config
from yid_ocp.virtual.joint_motion import MultisineOptions
from yid_ocp.workflow.build_problem import load_problem

UR5_NUMBERS = ("--object", "cable", "--length", "1", "--mass", "0.1", "--radius", "0.005")
ROD_NUMBERS = ("--object", "cable", "--length", "0.4", "--mass", "0.04", "--radius", "0.003", "--links", "12")
CROSS_NUMBERS = ("--object", "tree", "--branches", "4", "--length", "0.4", "--mass", "0.03", "--radius", "0.004")


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    pytest.importorskip("rosbags", reason="bags need rosbags: pip install 'yid-ocp[bags]'")
    pytest.importorskip("mujoco", reason="made recordings need mujoco: pip install 'yid-ocp[blind]'")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def carried_out(name: str, *words: str) -> dict[str, Any]:
    """Run a command into the folder `name`; contents of its result, and how long it took."""
    begun = time.process_time()
    assert main([*words, "--out", name]) == 0
    print(f"{words[0]}: {time.process_time() - begun:.1f} s of CPU")
    file = Path(name) / "result.json"
    return json.loads(file.read_text()) if file.is_file() else {}


def check_truth(result: Mapping[str, Any], truth: Mapping[str, float]) -> None:
    """Every true value within twice the stated standard deviation, and that no wider than a fifth of the value."""
    for name, value in truth.items():
        found = result["parameters"][name]
        assert abs(found["value"] - value) < 2 * found["std"], (name, found)
        assert found["std"] < 0.2 * value
        assert found["verdict"] == "identifiable", (name, found)


def test_a_bag_becomes_a_problem_that_is_right_at_the_truth(desk: Path) -> None:
    recording = UR5.simulate(desk, 3, 0.7, links=8)
    bag = write_mcap(recording, desk / "run")
    assert main(["init", "package:ur5", str(bag), *UR5_NUMBERS, "--out", "cable.yaml", "--quiet"]) == 0
    run = load_config("cable.yaml")
    assert run.model.object is not None
    assert run.sensors["points"].frames == {"middle": "cable:50%", "tip": "w_cable"}
    problem = load_problem("cable.yaml", ["problem.use_compiler=false"])
    assert set(problem.free) == set(UR5.truth)
    at_truth = problem.evaluate(problem.vector(UR5.truth), derivatives=False)
    count = sum(len(group.t) * 3 * len(group.names) for group in recording.points)
    # the noise that the file states is what the data show, and the model that made them explains them
    assert 0.1 < 2 * at_truth.cost / count < 2
    for factor in (0.5, 2.0):
        other = UR5.truth | {"cable.bend": factor * UR5.truth["cable.bend"]}
        assert problem.evaluate(problem.vector(other), derivatives=False).cost > 3 * at_truth.cost


@pytest.mark.slow
def test_a_cable_on_a_ur5(desk: Path) -> None:
    bag = write_mcap(UR5.simulate(desk, 3, 3.0), desk / "run")
    assert main(["import", str(bag), "--preview"]) == 0
    carried_out("run.h5", "import", str(bag), "--sensor", "mocap")
    carried_out("cable.yaml", "init", "package:ur5", "run.h5", *UR5_NUMBERS)
    checked = carried_out("checked", "check", "cable.yaml")
    assert not checked["warnings"]
    assert not checked["doubts"]
    check_truth(carried_out("solved", "solve", "cable.yaml"), UR5.truth)


@pytest.mark.slow
def test_a_cross_on_a_panda(desk: Path) -> None:
    """What is held sits in the flange, which the tool's name does not say: an option, and no edit."""
    bag = write_mcap(PANDA.simulate(desk, 3, 2.5), desk / "run")
    carried_out("cross.yaml", "init", "package:panda", str(bag), *CROSS_NUMBERS, "--holder", "panda_link8")
    checked = carried_out("checked", "check", "cross.yaml")
    assert not checked["warnings"]
    assert not checked["doubts"]
    check_truth(carried_out("solved", "solve", "cross.yaml"), PANDA.truth)


@pytest.mark.slow
def test_a_rod_on_an_arm_of_servos(desk: Path) -> None:
    """Commands and angles are all that the arm says; what it holds is called a cable until somebody names it."""
    excitation = MultisineOptions(max_joint_speed=2.5, duration=3.0, frequency_band=(0.3, 2.0))
    bags = [write_mcap(SERVO.simulate(desk, seed, 3.0, excitation), desk / f"run_{seed}") for seed in (3, 4)]
    for bag in bags:
        carried_out(f"{bag.stem}.h5", "import", str(bag), "--command-topic", "/joint_commands", "--sensor", "mocap")
    carried_out("rod.yaml", "init", "default:servo_arm.urdf", "run_3.h5", "run_4.h5", *ROD_NUMBERS)
    assert load_config("rod.yaml").model.arms.mode == "servo"
    checked = carried_out("checked", "check", "rod.yaml")
    assert not checked["doubts"]
    solved = carried_out("solved", "solve", "rod.yaml")
    check_truth(solved, SERVO.truth)
    for name, value in SERVOS.items():
        found = solved["parameters"][name]
        assert abs(found["value"] - value) < max(2 * found["std"], 0.02 * value), (name, found)
    told = carried_out("diagnosed", "diagnose", "rod.yaml")
    assert told["verdict"] == "no_gap"
    assert main(["export", "solved", "--out", "rod.xml"]) == 0
    manifest = json.loads(Path("rod.xml.manifest.json").read_text())
    assert manifest["parameters"]["lift.servo_gain"]["status"] == "native"
    assert manifest["gate"]["status"] == "done"
    assert manifest["gate"]["fall"] > 0.8

"""A new user: a bag from MuJoCo of an arm that holds a flexible object, and commands whose files are not edited."""

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_bags import START, Bag

from yid_ocp.cli import main
from yid_ocp.config.reader import load_config
from yid_ocp.data.recording import PointGroup, Recording
from yid_ocp.virtual.experiment import ArmSensorNoise, PointCamera, VirtualExperimentSettings, run_virtual_experiment
from yid_ocp.virtual.joint_motion import MultisineOptions, random_multisine_motion
from yid_ocp.virtual.mujoco_simulation import SimulationOptions
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.build_problem import load_problem

CURVED = "values_given_as_rigidities: true, clamped_at_base: true"

MODEL = """\
model:
  robot: {robot}
  arms: {arms}
  object:
    kind: segments
    mount: {{parent_frame: {frame}}}
    named_segments:
{segments}
  damping: {damping}
  measured_points: [{points}]
  effects: [{effects}]
parameters: {{{parameters}}}
"""


@dataclass(frozen=True)
class Newcomer:
    """A robot with something flexible in its hand, as it is in truth."""

    links: int
    settings: Mapping[str, str]  # of `MODEL` but for the segments
    parameters: Mapping[str, float]
    segments: Mapping[str, str]  # settings of each, without the number of links
    posture: Mapping[str, float]
    points: Mapping[str, str]  # what the user calls them, by frame
    truth: Mapping[str, float]

    def text(self, links: int) -> str:
        shapes = (f"      {n}: {{{s}, links: {links or self.links}, joint_axes: xy}}" for n, s in self.segments.items())
        values = ", ".join(f'"{name}": {{initial: {value}}}' for name, value in self.parameters.items())
        named = {"points": ", ".join(f'"{name}"' for name in self.points), "effects": "", "segments": "\n".join(shapes)}
        return MODEL.format(**named | dict(self.settings), parameters=values)

    def simulate(
        self, folder: Path, seed: int, duration: float, excitation: MultisineOptions | None = None, links: int = 0
    ) -> Recording:
        """Joints at 100 Hz without efforts, points at 50 Hz to half a millimetre under names of their own."""
        file = folder / "truth.yaml"
        file.write_text(self.text(links))
        system = build_system(load_config(file))
        excitation = excitation or MultisineOptions(max_joint_speed=1.0, duration=duration, frequency_band=(0.3, 1.5))
        start = {"initial_joint_angles": self.posture, "seed": seed}
        seen = {"point_std": 5e-4, "frame_rate": 50.0, "has_dropouts": False, "hidden_probability": 0.0}
        experiment = VirtualExperimentSettings(
            motion=random_multisine_motion(system, None, excitation=excitation, **start),
            simulation=SimulationOptions(duration, time_step=2e-4),
            arm_noise=ArmSensorNoise(position_std=1e-4),
            camera=PointCamera(pose=np.eye(4), **seen),
            **start,
        )
        made = run_virtual_experiment(system, None, experiment)
        [group] = made.points
        names = tuple(self.points[name] for name in group.names)
        points = (PointGroup("points", names, group.t, group.position, None, "mocap"),)
        return Recording(made.joints, points, name="run")


UR5 = Newcomer(
    16,
    {"robot": "package:ur5", "arms": "{mode: driven}", "frame": "tool0",
     "damping": "{shoulder_pan_joint: 0.1, object: 5.0e-4}"},
    {"cable.bend": 0.03},
    {"cable": f"length: 1.0, mass: 0.1, radius: 0.005, {CURVED}"},
    {"shoulder_pan_joint": 0.3, "shoulder_lift_joint": -1.2, "elbow_joint": 1.6, "wrist_1_joint": -1.9708,
     "wrist_2_joint": -1.5708, "wrist_3_joint": 0.0},
    {"w_cable": "tip", "cable:50%": "middle"},
    {"cable.bend": 0.03, "cable.damping": 5e-4},
)  # fmt: skip
PANDA_JOINTS = [f"panda_joint{i}" for i in range(1, 8)]
PANDA_TRUTH = {"b1.bend": 0.10, "b2.bend": 0.15, "b3.bend": 0.20, "b4.bend": 0.25}
PANDA = Newcomer(
    10,
    {"robot": "package:panda", "frame": "panda_link8", "damping": "{panda_joint1: 0.1, object: 2.0e-3}",
     "arms": f"{{mode: driven, joints: [{', '.join(PANDA_JOINTS)}], exclude_links: [panda_hand]}}"},
    PANDA_TRUTH,
    {f"b{i + 1}": f"length: 0.4, mass: 0.03, radius: 0.004, {CURVED}, rpy: [0.0, 1.5707963, {round(1.5707963 * i, 7)}]"
     for i in range(4)},
    dict(zip(PANDA_JOINTS, (0.0, -0.4, 0.0, -2.0, 0.0, 1.6, 0.8), strict=True)),
    {f"w_b{i}": f"marker_{i}" for i in range(1, 5)},
    PANDA_TRUTH,
)  # fmt: skip
SERVO_POSTURE = {"pan": 0.0, "lift": 0.4, "elbow": 1.0, "wrist_flex": 0.3, "wrist_roll": 0.0}
SERVO_VALUES = {"gain": 45.0, "damping": 2.0, "delay": 0.03}
SERVO = Newcomer(
    12,
    {"robot": "default:servo_arm.urdf", "arms": "{mode: servo}", "frame": "gripper",
     "damping": "{pan: 0.05, object: 4.0e-4}",
     "effects": ", ".join(f"{{kind: rotor_inertia, location: {joint}, values: {{armature: 0.01}}}}"
                          for joint in SERVO_POSTURE)},
    {"rod.bend": 0.03, **{f"*.servo_{name}": value for name, value in SERVO_VALUES.items()}},
    {"rod": f"length: 0.4, mass: 0.04, radius: 0.003, {CURVED}"},
    SERVO_POSTURE,
    {"w_rod": "tip", "rod:50%": "middle"},
    {"cable.bend": 0.03, "cable.damping": 4e-4},
)  # fmt: skip
SERVOS = {f"{joint}.servo_{key}": x for joint in ("lift", "elbow", "wrist_flex") for key, x in SERVO_VALUES.items()}


def write_mcap(recording: Recording, folder: Path) -> Path:
    """A bag with the joints on one topic, their commands on another, every point on its own, and one nobody needs."""
    joints = recording.joints
    nothing = {"velocity": np.zeros(0), "effort": np.zeros(0)}
    messages: list[tuple[float, str, str, dict[str, Any]]] = [(0.0, "/note", "std_msgs/msg/String", {"data": "hello"})]
    for topic, rows in (("/joint_states", joints.position), ("/joint_commands", joints.position_command)):
        for t, row in zip(joints.t, () if rows is None else rows, strict=False):
            state = {"name": list(joints.names), "position": row, **nothing}
            messages.append((t, topic, "sensor_msgs/msg/JointState", state))
    for group in recording.points:
        for t, row in zip(group.t, group.position, strict=True):
            for name, place in zip(group.names, row, strict=True):
                messages.append((t, f"/mocap/{name}", "geometry_msgs/msg/PointStamped", {"point": place}))
    with Bag(folder, "mcap") as bag:
        for t, topic, kind, fields in sorted(messages, key=lambda entry: entry[0]):
            stamp = START + round(1e9 * t)
            own = {} if "data" in fields else {"header": bag.header(stamp, "world" if "point" in fields else "")}
            own |= {"point": bag.of("geometry_msgs/msg/Point", *fields["point"])} if "point" in fields else {}
            bag.put(topic, kind, stamp, **fields | own)
    return bag.path


UR5_NUMBERS = ("--object", "cable", "--length", "1", "--mass", "0.1", "--radius", "0.005")
ROD_NUMBERS = ("--object", "cable", "--length", "0.4", "--mass", "0.04", "--radius", "0.003", "--links", "12")
CROSS_NUMBERS = ("--object", "tree", "--branches", "4", "--length", "0.4", "--mass", "0.03", "--radius", "0.004")
CROSS_NUMBERS += ("--holder", "panda_link8")  # it sits in the flange, which the tool's name does not say: no edit


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    pytest.importorskip("mujoco", reason="made recordings need mujoco: pip install '.[blind]'")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def carried_out(name: str, *words: str) -> dict[str, Any]:
    """Run a command into the folder `name`; contents of its result; prints how long it took."""
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
    bag = write_mcap(recording, desk)
    assert main(["init", "package:ur5", str(bag), *UR5_NUMBERS, "--out", "cable.yaml", "--quiet"]) == 0
    places = {name: said.parent_frame for name, said in load_config("cable.yaml").model.frames.items()}
    assert places == {"middle": "cable:50%", "tip": "w_cable"}
    problem = load_problem("cable.yaml", ["problem.use_compiler=false"])
    where = {f"{name}.{axis}": 0.0 for name in places for axis in "xyz"} | {"mount.rx": 0.0, "mount.ry": 0.0}
    assert set(problem.free) == {*UR5.truth, *where}
    at_truth = problem.evaluate(problem.pack_unknowns(UR5.truth | where), derivatives=False)
    count = sum(len(group.t) * 3 * len(group.names) for group in recording.points)
    # the noise that the file states is what the data show, and the model that made them explains them
    assert 0.1 < 2 * at_truth.cost / count < 2
    for factor in (0.5, 2.0):
        other = UR5.truth | where | {"cable.bend": factor * UR5.truth["cable.bend"]}
        assert problem.evaluate(problem.pack_unknowns(other), derivatives=False).cost > 3 * at_truth.cost


@pytest.mark.slow
@pytest.mark.parametrize(
    ("user", "duration", "numbers"), [(UR5, 3.0, UR5_NUMBERS), (PANDA, 2.5, CROSS_NUMBERS)], ids=["cable", "cross"]
)
def test_a_cable_on_a_ur5_and_a_cross_on_a_panda(desk: Path, user: Newcomer, duration: float, numbers: Any) -> None:
    bag = write_mcap(user.simulate(desk, 3, duration), desk)
    assert main(["import", str(bag), "--preview"]) == 0
    carried_out("run.h5", "import", str(bag), "--point-sensor-name", "mocap")
    carried_out("run.yaml", "init", user.settings["robot"], "run.h5", *numbers)
    checked = carried_out("checked", "check", "run.yaml")
    assert not checked["warnings"] + checked["issues"]
    check_truth(carried_out("solved", "solve", "run.yaml"), user.truth)


@pytest.mark.slow
def test_a_rod_on_an_arm_of_servos(desk: Path) -> None:
    """Commands and angles are all that the arm says; what it holds is called a cable until somebody names it."""
    excitation = MultisineOptions(max_joint_speed=2.5, duration=3.0, frequency_band=(0.3, 2.0))
    for seed in (3, 4):
        (desk / str(seed)).mkdir()
        bag = write_mcap(SERVO.simulate(desk, seed, 3.0, excitation), desk / str(seed))
        carried_out(
            f"run_{seed}.h5", "import", str(bag), "--command-topic", "/joint_commands", "--point-sensor-name", "mocap"
        )
    carried_out("rod.yaml", "init", "default:servo_arm.urdf", "run_3.h5", "run_4.h5", *ROD_NUMBERS)
    assert load_config("rod.yaml").model.arms.mode == "servo"
    assert not carried_out("checked", "check", "rod.yaml")["issues"]
    solved = carried_out("solved", "solve", "rod.yaml")
    check_truth(solved, SERVO.truth)
    for name, value in SERVOS.items():
        found = solved["parameters"][name]
        assert abs(found["value"] - value) < max(2 * found["std"], 0.02 * value), (name, found)
    assert carried_out("diagnosed", "diagnose", "rod.yaml")["verdict"] == "no_gap"
    assert main(["export", "solved", "--out", "rod.xml"]) == 0
    manifest = json.loads(Path("rod.xml.manifest.json").read_text())
    assert manifest["parameters"]["lift.servo_gain"]["status"] == "native"
    assert manifest["gate"]["status"] == "done"
    channels = manifest["gate"]["channels"].values()
    assert max(own["after"] / own["noise"] for own in channels) < 3
    assert max(own["before"] / own["noise"] for own in channels) > 10

"""The command `init` on made recordings: what it reads from them, what it writes, what it asks for and refuses."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from made_cross import URDF
from made_lerobot import lerobot_dataset
from ruamel.yaml import YAML

from yid_ocp.cli import main
from yid_ocp.config.reader import load_config
from yid_ocp.config.schema import config_json_schema
from yid_ocp.config.settings import RunSettings
from yid_ocp.data import JointGroup, PointGroup, Recording, SensorChannelGroup, read_recording, write_recording
from yid_ocp.model.servos_and_springs import MotorKindAndPreset
from yid_ocp.model.urdf import urdf_path_from_robot_name
from yid_ocp.problem.recorded_inputs import select_path_cutoff
from yid_ocp.workflow.build import build_system, free_parameter_names, settings_by_parameter_name
from yid_ocp.workflow.build_problem import build_problem

RATE = 125.0
LENGTH = 0.5
CABLE = ("--object", "cable", "--length", "0.5", "--mass", "0.05", "--radius", "0.004")


def turned(axis: int, angle: np.ndarray) -> np.ndarray:
    """Rotations about x or y, shape (N, 3, 3)."""
    c, s, one, zero = np.cos(angle), np.sin(angle), np.ones_like(angle), np.zeros_like(angle)
    rows = ([one, zero, zero, zero, c, -s, zero, s, c], [c, zero, s, zero, one, zero, -s, zero, c])[axis]
    return np.stack(rows, axis=1).reshape(-1, 3, 3)


def moved(
    t: np.ndarray,
    parts: Sequence[float] = (0.5, 1.0),
    rest: tuple[float, float] | None = None,
    effort: bool = False,
    moving: bool = False,
    far: float = 0.0,
    seed: int = 1,
) -> Recording:
    """A wrist that turns a straight stick, seen where it says; it rests at the start and in an interval."""
    rng = np.random.default_rng(seed)
    phase = np.ones_like(t) if moving else np.clip(t / 0.5 - 0.4, 0, 1) ** 2
    if rest is not None:
        phase = phase * np.clip(np.where(t < rest[0], rest[0] - t, t - rest[1]) / 0.3, 0, 1) ** 2
    angles = np.stack([0.4 * np.sin(3 * t) * phase, 0.3 * np.sin(2 * t) * phase], axis=1)
    along = (turned(0, angles[:, 0]) @ turned(1, angles[:, 1]))[:, :, 2]
    points = np.array(parts)[None, :, None] * LENGTH * along[:, None] + far
    points = points + 2e-4 * rng.standard_normal(points.shape)
    names = tuple(f"m{i + 1}" for i in range(len(parts)))
    efforts = rng.standard_normal((len(t), 2)) if effort else None
    joints = JointGroup(("roll", "pitch"), t, angles + 1e-4 * rng.standard_normal(angles.shape), effort=efforts)
    groups = (PointGroup("points", names, t, points, None, "mocap"),) if parts else ()
    return Recording(joints, groups, source="made", name="made")


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a wrist and a recording of it, in which the command is run."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "wrist.urdf").write_text(URDF)
    write_recording(moved(np.arange(0, 4, 1 / RATE)), tmp_path / "one.h5")
    return tmp_path


def init(*words: str, files: Sequence[str] = ("one.h5",)) -> int:
    return main(["init", "wrist.urdf", *files, "--out", "run.yaml", *words])


def proposed(recording: Recording, *words: str) -> RunSettings:
    """The configuration that is written for a recording."""
    write_recording(recording, Path("one.h5"))
    assert init(*(words or CABLE), "--replace") == 0
    return load_config("run.yaml")


SHORT = np.arange(0, 2, 1 / RATE)


def test_the_file_loads_and_says_what_was_recorded(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert init(*CABLE) == 0
    assert "`init` assigns recorded m1 to the frame cable:50% of the model, because its" in capsys.readouterr().out
    run = load_config("run.yaml")
    assert (run.model.arms.mode, run.model.arms.joints) == ("prescribed", ("roll", "pitch"))
    assert (run.problem.time_step, run.problem.initial_state) == (pytest.approx(0.008), "equilibrium")
    assert {name: said.parent_frame for name, said in run.model.frames.items()} == {"m1": "cable:50%", "m2": "w_cable"}
    assert not run.sensors["points"].frame_by_recorded_name, "a point has the name of its frame"
    # white noise from differences of a smooth motion, within a fifth
    assert run.sensors["points"].std == pytest.approx(2e-4, rel=0.08)
    assert run.sensors["joints.position"].std == pytest.approx(1e-4, rel=0.2)
    system = build_system(run)
    assert system.prescribed == ("roll", "pitch")
    assert {"m1", "m2", "w_cable"} <= set(system.point_frames)
    # where a marker sits on the rod is known to some millimetres only
    free = free_parameter_names(run, system.parameters)
    assert {f"{name}.{axis}" for name in ("m1", "m2") for axis in "xyz"} <= set(free)
    assert run.model.frames["m1"].position_std == pytest.approx(0.005 * LENGTH, rel=0.05)
    clamp = settings_by_parameter_name(run, system.parameters)["mount.rx"]  # and how straight the clamp is
    assert (clamp.free, clamp.prior_std) == (True, 0.05)
    text = (bench / "run.yaml").read_text()
    assert text.startswith("# yaml-language-server: $schema=yid-ocp.schema.json\n")
    jsonschema.validate(YAML(typ="safe").load(text), config_json_schema())
    assert (bench / "yid-ocp.schema.json").is_file()
    keys = [line for line in text.splitlines() if line.strip() and not line.strip().startswith(("#", "joints:"))]
    bare = [line for line in keys if "#" not in line and not line.rstrip().endswith(":")]
    assert len(bare) <= 6, bare  # what has no comment is said by the line above it


def test_the_first_lines_of_the_readme_run_as_printed(bench: Path, repository: Path) -> None:
    recording = moved(np.arange(0, 2, 1 / RATE))
    (bench / "my_robot.urdf").write_text(URDF)
    joints, [points] = recording.joints, recording.points
    table = np.column_stack([joints.t, joints.position])
    np.savetxt("joints.csv", table, header="time,q_roll,q_pitch", comments="", delimiter=",")
    table = np.column_stack([points.t, points.position.reshape(len(points.t), -1)])
    header = "time," + ",".join(f"{name}_{axis}" for name in points.names for axis in "xyz")
    np.savetxt("mocap.csv", table, header=header, comments="", delimiter=",")
    text = (repository / "README.md").read_text(encoding="utf-8")
    commands = re.search(r"```text\n(yid-ocp import .*?)```", text, re.S)
    lines = [line.split()[1:] for line in commands[1].splitlines()]
    assert [words[0] for words in lines] == ["import", "init", "check", "solve", "diagnose"]
    for words in lines[:2]:  # the others run a configuration
        assert main(words) == 0
    assert {words[1] for words in lines[2:]} == {"run.yaml"}
    build_system(load_config("run.yaml"))


def test_a_page_shows_what_was_guessed_before_the_fit(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Arm, unbent object and markers in motion, markers under the names of their frames, so that lines join the two."""
    assert init(*CABLE) == 0
    assert "Check them in the picture run.html:" in capsys.readouterr().out
    page = Path("run.html").read_text()
    [scene] = [json.loads(text) for text in re.findall(r'<script type="application/json">(.*?)</script>', page, re.S)]
    model, measured = scene["scenes"][0]["motions"]
    assert set(measured["points"]) == {"m1", "m2"}
    assert set(measured["points"]) <= set(model["points"])
    # a straight stick that is seen where it is: points and frames meet all the time
    for name, at in measured["points"].items():
        both = ((measured, at), (model, model["points"][name]))
        seen, told = (np.array([row[3 * k : 3 * k + 3] for row in own["places"]], float) for own, k in both)
        assert np.nanmax(np.abs(seen - told)) < 30  # tenths of a millimetre
    # a page that already exists is not written over
    Path("run.yaml").unlink()
    assert init(*CABLE) == 2
    assert "already exists" in capsys.readouterr().err


def test_several_recordings_are_split_and_a_rest_splits_one(bench: Path) -> None:
    for i, name in enumerate(names := [f"run_{i}.h5" for i in range(4)]):
        write_recording(moved(SHORT, seed=i), bench / name)
    assert init(*CABLE, files=names) == 0
    recordings = load_config("run.yaml").recordings
    assert [Path(p).name for p in (*recordings.estimate, "|", *recordings.held_out)] == [*names[:3], "|", *names[3:]]
    write_recording(moved(np.arange(0, 6, 1 / RATE), rest=(3.4, 4.4)), bench / "long.h5")
    assert init(*CABLE, "--replace", files=["long.h5"]) == 0
    recordings = load_config("run.yaml").recordings
    first, second = (read_recording(path) for path in (*recordings.estimate, *recordings.held_out))
    assert 3.4 < second.joints.t[0] < 4.4
    assert first.joints.t[-1] == pytest.approx(second.joints.t[0], abs=1.1 / RATE)
    assert np.abs(np.diff(second.joints.position[:10], axis=0)).max() < 1e-3
    assert "of made" in second.notes[0]


@pytest.mark.parametrize("parts", [(0.5, 1.0), ()], ids=["joints and points", "joints alone"])
def test_a_start_in_motion_is_estimated(parts: Sequence[float], bench: Path) -> None:
    assert proposed(moved(SHORT, parts=parts, effort=True, moving=True)).problem.initial_state == "estimated"


def test_the_low_pass_lies_above_motion_that_exceeds_the_noise_of_the_encoders(bench: Path) -> None:
    t = np.arange(0, 4, 1 / RATE)
    assert proposed(moved(t, moving=True)).problem.path_cutoff == 10.0
    shaken = moved(t, moving=True)
    # of 0.7 times the noise's size
    angles = shaken.joints.position + 1e-4 * np.sin(2 * np.pi * 14 * t)[:, None]
    assert proposed(replace(shaken, joints=replace(shaken.joints, position=angles))).problem.path_cutoff == 20.0
    uneven = np.sort(t + 4e-3 * np.random.default_rng(0).uniform(-1, 1, len(t)))
    assert proposed(moved(uneven, moving=True)).problem.path_cutoff == 10.0, "an uneven clock does not show the noise"
    joints, noise = tuple(f"j{i}" for i in range(80)), np.random.default_rng(0).normal(scale=1e-4, size=(len(t), 80))
    assert select_path_cutoff([Recording(JointGroup(joints, t, noise))], joints) == 10.0, "one of many is no motion"


def test_the_last_frame_of_the_arm_holds_the_object(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fixed = '<link name="{0}"/><joint name="{0}" type="fixed"><parent link="hub"/><child link="{0}"/></joint></robot>'
    # of two last frames none is: the frame that carries both
    frames = ("mount", "mount", "hub"), ("finger", "hub", "finger, mount"), ("grip", "grip", "hub, finger, mount")
    for end, holder, others in frames:
        (bench / "wrist.urdf").write_text((bench / "wrist.urdf").read_text().replace("</robot>", fixed.format(end)))
        assert proposed(moved(SHORT)).model.object.mount.parent_frame == holder
        assert f"{holder}  other choices for --holder: {others}" in re.sub(" {2,}", "  ", capsys.readouterr().out)


def test_a_finger_that_rests_is_locked_and_its_hand_holds_the_object(
    bench: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    link = '<link name="{0}"/><joint name="{0}" type="{1}"><parent link="hub"/><child link="{0}"/>{2}</joint>'
    more = link.format("finger", "prismatic", '<limit lower="0" upper="0.04" effort="9" velocity="1"/>')
    more += link.format("hub_tcp", "fixed", "") + "</robot>"
    (bench / "wrist.urdf").write_text((bench / "wrist.urdf").read_text().replace("</robot>", more))
    made = moved(SHORT)
    for opening, holder, locked in ((np.full(len(SHORT), 0.01), "hub_tcp", {"finger": 0.01}), (SHORT, "finger", {})):
        position = np.column_stack([made.joints.position, opening])
        names = (*made.joint_names, "finger", "gantry")
        position = np.column_stack([position, SHORT])
        model = proposed(replace(made, joints=JointGroup(names, SHORT, position))).model
        assert f"recorded, but not used: {'finger, ' * bool(locked)}gantry" in capsys.readouterr().out
        assert (model.object.mount.parent_frame, model.arms.locked_joints) == (holder, locked)


def test_a_marker_beside_the_object_has_its_measured_place_on_the_gripper(bench: Path) -> None:
    made, place = moved(SHORT), (0.03, -0.02, 0.01)
    roll, pitch = made.joints.position.T
    held = (turned(0, roll) @ turned(1, pitch)) @ place
    points = np.concatenate([made.points[0].position, held[:, None]], axis=1)
    group = replace(made.points[0], names=("m1", "m2", "hand"), position=points)
    model = proposed(replace(made, points=(group,))).model
    frame = model.frames["hand"]
    assert (frame.parent_frame, frame.xyz) == (model.object.mount.parent_frame, pytest.approx(place, abs=1e-4))


@pytest.mark.parametrize(("axis", "rpy"), [(0, [0, np.pi / 2, 0]), (1, [-np.pi / 2, 0, 0]), (2, [0, 0, 0])])
def test_an_object_is_mounted_along_the_axis_on_which_its_points_lie(bench: Path, axis: int, rpy: list[float]) -> None:
    made = moved(SHORT)
    roll, pitch = made.joints.position.T
    along = (turned(0, roll) @ turned(1, pitch))[:, :, axis]
    group = replace(made.points[0], position=np.array([0.5, 1.0])[None, :, None] * LENGTH * along[:, None])
    mount = proposed(replace(made, points=(group,))).model.object.mount
    assert mount.rpy == pytest.approx(rpy, abs=1e-4)


def test_efforts_alone_bring_zeros_and_friction_of_the_arm(bench: Path) -> None:
    beam = ("--object", "beam", "--length", "0.5", "--mass", "0.1", "--section", "0.001,0.05")
    run = proposed(moved(SHORT, parts=(), effort=True), *beam)
    assert [effect.kind for effect in run.model.effects] == ["effort_offset"] * 2
    assert run.parameters["roll.damping"].free
    assert run.sensors["joints.effort"].std == pytest.approx(1.0, rel=0.2)
    made = moved(SHORT, parts=(), effort=True)
    unlike = replace(made, joints=replace(made.joints, effort=made.joints.effort * [1.0, 0.1]))
    stds = proposed(unlike, *beam).sensors["joints.effort"].std
    assert stds == pytest.approx({"roll": 1.0, "pitch": 0.1}, rel=0.2), "noise that differs is stated by joint"
    item = build_system(run)
    assert item.prescribed == ("roll", "pitch")
    assert "effort_offset@roll.offset" in item.parameters


def test_friction_without_efforts_is_refused_before_all_models_are_built(
    bench: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    built: list[RunSettings] = []
    monkeypatch.setattr("yid_ocp.workflow.friction.build_problem", lambda run: built.append(run) or build_problem(run))
    proposed(moved(SHORT, effort=True))
    write_recording(moved(SHORT, effort=True, seed=2), Path("two.h5"))
    asked = ["friction", "run.yaml", "--set", "recordings.held_out=[two.h5]", "--set", "problem.use_compiler=false"]
    asked += ["--set", "model.friction={law: load, sign_smoothing_speed: 0.003}"]
    assert main(asked) == 2
    assert "set sensors.joints.effort.use: true and, unless the torques have no" in capsys.readouterr().err
    assert [run.model.friction and run.model.friction.sign_smoothing_speed for run in built] == [0.003]


def test_efforts_beside_points_are_left_alone(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = proposed(moved(SHORT, effort=True))
    assert run.sensors["joints.effort"].use is False
    assert not run.model.effects
    assert run.model.damping == {"object": pytest.approx(2e-3, rel=2), "roll": 0.0, "pitch": 0.0}
    # the constant error of a torque is never silently zero, and what looks for friction is said without a warning
    assert run.sensors["joints.effort"].bias_std == pytest.approx(0.01 * 50.0)  # of its limit
    text = Path("run.yaml").read_text()
    assert "To use the efforts, set use: true. bias_std is the" in text
    assert "add {kind: effort_offset, location: JOINT} to\n" in text
    assert "#   efforts are taken as samples, since the recordings do not state it" in text
    Path("friction.yaml").write_text(text.replace("use: false, ", "use: true, ").replace("# friction:", "friction:"))
    assert "joint_coulomb@roll.tau_c" in build_system(load_config("friction.yaml")).parameters
    # damping of the URDF is proposed, friction only said
    stated, urdf = moved(SHORT, effort=True), Path("wrist.urdf").read_text()
    dry = '<dynamics damping="0.4" friction="0.8"/></joint>'
    Path("wrist.urdf").write_text(urdf[: (end := urdf.rindex("</joint>"))] + urdf[end:].replace("</joint>", dry, 1))
    known = proposed(replace(stated, joints=replace(stated.joints, effort_bias_std=0.2)))
    assert known.sensors["joints.effort"].bias_std is None
    text = Path("run.yaml").read_text()
    assert (known.model.damping["pitch"], "friction of the robot file, {pitch: 0.8}" in text) == (0.4, True)
    assert proposed(moved(SHORT, parts=(), effort=True)).parameters["pitch.damping"].initial == 0.4
    assert "0.4 N m s/rad  of pitch, as the robot file states" in (told := capsys.readouterr().out)
    assert told.count("find friction and payload of the arm too, set sensors.joints.effort.use: true") == 2
    weak = replace(stated.joints, effort=0.01 * np.asarray(stated.joints.effort))  # less than the limit's error
    assert max(proposed(replace(stated, joints=weak)).sensors["joints.effort"].bias_std.values()) < 0.2


def test_a_wrist_sensor_is_proposed_with_its_frame_and_noise(bench: Path) -> None:
    """It takes the place of points; a sensor on an unknown frame, or beside torques that drive, is left out."""
    noise = np.random.default_rng(0).standard_normal((len(SHORT), 1, 3))
    wrist = SensorChannelGroup("wrist", ("ft",), SHORT, {"force": 0.1 * noise, "torque": noise}, {"torque_std": 1.0})
    imu = SensorChannelGroup("imu", ("head",), SHORT, {"angular_velocity": noise})
    run = proposed(replace(moved(SHORT, parts=(), effort=True), channel_groups=(wrist, imu)))
    assert run.sensors["joints.effort"].use is False
    assert run.sensors["wrist.force"].std == pytest.approx(0.1, rel=0.2)
    assert run.sensors["wrist.torque"].std is None
    frames = [run.sensors[f"wrist.{quantity}"].frame_by_recorded_name for quantity in ("force", "torque")]
    assert frames == [{"ft": "hub"}] * 2
    assert run.sensors["imu.angular_velocity"].use is False


def test_commands_without_efforts_are_followed_by_servos(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = moved(SHORT)
    commands = np.vstack([made.joints.position[6:], np.tile(made.joints.position[-1:], (6, 1))])
    run = proposed(replace(made, joints=replace(made.joints, position_command=commands)))
    assert "no efforts were recorded, but commanded positions" in capsys.readouterr().out
    arms = run.model.arms
    assert (arms.mode, arms.servo.command_interpolation, arms.relative_link_mass_std) == ("servo", "held", 0.05)
    system = build_system(run)
    assert set(system.servos) == set(system.driven) == {"roll", "pitch"}
    free = {name for name in free_parameter_names(run, system.parameters) if "mass" not in name and name[0] != "m"}
    own = ("{}.servo_gain", "{}.servo_damping", "{}.servo_delay", "rotor_inertia@{}.armature")
    assert free == {"cable.bend", "cable.damping", *(name.format(joint) for joint in ("roll", "pitch") for name in own)}
    # a copy of the measured angles is no command, and efforts say more than commands
    for changes in ({"position_command": made.joints.position}, {"effort": np.ones_like(commands)}):
        other = replace(made.joints, **{"position_command": commands, **changes})
        assert proposed(replace(made, joints=other)).model.arms.mode == "prescribed"


def test_a_lerobot_dataset_of_a_known_arm_says_what_the_arm_holds(bench: Path, repository: Path) -> None:
    made = read_recording(repository / "configs" / "recordings" / "so101_1.h5")
    lerobot_dataset(bench / "arm", made.joints)
    assert main(["init", "package:so101", "arm", "--units", "deg", "--out", "run.yaml"]) == 0
    run = load_config("run.yaml")
    assert run.model.arms.servo.motor == MotorKindAndPreset("dc", "sts3215")
    assert (run.model.friction.law, run.model.friction.joints) == ("load", None)
    assert read_recording(run.recordings.estimate[0]).joint_names == made.joint_names[:5]  # the gripper has no angles
    assert run.parameters["*.servo_gain_factor"].initial == 16
    settings = ["--set", "output.write_report=false", "--set", "model.arms.locked_joints={gripper: 0.6}"]
    assert main(["solve", "run.yaml", "--out", "solved", *settings]) == 0
    result = json.loads(Path("solved/result.json").read_text())
    assert result["fit"]["explains"]
    for key in (f"payload@gripper_frame_link.{name}" for name in ("mass", "mx", "my", "mz")):
        entry = result["parameters"][key]
        assert abs(entry["value"] - made.true_parameters[key]) < 2 * entry["std"]
    # a recording that states the firmware's gain needs none in the file
    write_recording(made, bench / "stated.h5")
    assert main(["init", "package:so101", "stated.h5", "--out", "other.yaml"]) == 0
    assert "*.servo_gain_factor" not in load_config("other.yaml").parameters


def pushed_pendulum(folder: Path, phases: Sequence[float], name: str) -> None:
    """A double pendulum in free air, its efforts by Pinocchio with friction, rotors, zeros of sensors and a payload."""
    pin = pytest.importorskip("pinocchio")
    model = pin.buildModelFromUrdf(str(urdf_path_from_robot_name("default:double_pendulum.urdf")))
    rng, t = np.random.default_rng(len(name)), np.arange(0, 6, 0.005)
    model.appendBodyToJoint(2, pin.Inertia(0.3, np.array([0.0, 0.05, -0.4]), np.zeros((3, 3))), pin.SE3.Identity())
    model.armature = np.array([0.05, 0.02])
    waves = [(0.6, 2.1), (0.4, 5.3)]
    starts = np.array(phases) + np.arange(len(phases))
    q, v, a = (sum(A * w**k * np.sin(w * t[:, None] + starts + k * np.pi / 2) for A, w in waves) for k in range(3))
    data = model.createData()
    turns = np.stack([np.cos(q), np.sin(q)], axis=2).reshape(len(t), 4)  # of joints without limits
    torque = np.array([pin.rnea(model, data, *row) for row in zip(turns, v, a, strict=True)])
    torque += [0.3, 0.1] * np.tanh(v / 0.02) + [0.4, 0.2] * v + [0.2, -0.1] + 0.02 * rng.standard_normal(v.shape)
    names = tuple(model.names[1:])
    seen = PointGroup("points", ("m1",), t, turns[:, None, :3], 1e-3)  # nobody says where
    write_recording(Recording(JointGroup(names, t, q, effort=torque), (seen,), name=name), folder / f"{name}.h5")


def test_an_arm_alone_with_efforts_is_identified_as_written(bench: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without an object the arm's friction, rotors, zeros of sensors and payload are free, and found."""
    for name, phases in {"first": (0.0, 1.0), "second": (2.0, 0.5)}.items():
        pushed_pendulum(bench, phases, name)
    assert main(["init", "default:double_pendulum.urdf", "first.h5", "second.h5", "--out", "run.yaml"]) == 0
    model = load_config("run.yaml").model
    assert (model.object, model.arms.mode) == (None, "prescribed")
    assert main(["solve", "run.yaml", "--out", "solved", "--set", "output.write_report=false"]) == 0
    found = json.loads(Path("solved/result.json").read_text())["parameters"]
    [payload] = [name.removesuffix(".mass") for name in found if name.startswith("payload@") and name.endswith(".mass")]
    truth = {"shoulder.damping": 0.4, "joint_coulomb@elbow.tau_c": 0.1, "rotor_inertia@shoulder.armature": 0.05}
    truth |= {"effort_offset@shoulder.offset": 0.2, "effort_offset@elbow.offset": -0.1, f"{payload}.mass": 0.3}
    for name, value in truth.items():
        assert found[name]["free"], name
        assert abs(found[name]["value"] - value) < max(4 * found[name]["std"], 0.03 * abs(value)), name
    # fits of friction laws leave wrong minima
    monkeypatch.setattr(
        "yid_ocp.workflow.friction.fit_problem", lambda *_, restarts: pytest.fail(f"restarts: {restarts}")
    )
    with pytest.raises(pytest.fail.Exception, match="restarts: True"):
        main(["friction", "run.yaml", "--out", "laws"])
    assert main(["friction", "run.yaml", "--set", "sensors.joints.effort.use=false"]) == 2, "no torque shows friction"


def test_a_servo_arm_without_commands_is_told_what_is_missing(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert init(*CABLE) == 0
    assert main(["check", "run.yaml", "--out", "checked", "--set", "model.arms.mode=servo"]) == 2
    assert re.search("(?s)follow commanded positions.*joints/position_command.*prescribed", capsys.readouterr().err)


def test_a_tree_gets_its_markers_where_they_are(bench: Path) -> None:
    tree = ("--object", "tree", "--branch", "up=0.5,0.05,0.004", "--branch", "side=0.3,0.03,0.004,0,1.57,0")
    run = proposed(moved(SHORT, parts=(0.4, 1.0, np.nan)), *tree)  # the third was never seen
    assert run.sensors["points"].frame_by_recorded_name == {"m1": "up:40%", "m2": "w_up"}
    assert {"w_up", "w_side", "up:40%"} == set(build_system(run).point_frames)


def test_on_a_rod_that_was_straight_a_marker_is_placed_within_a_fraction_of_a_millimetre(bench: Path) -> None:
    frames = proposed(moved(SHORT, parts=(1 / 3, 1.0))).model.frames
    owner, _, percent = str(frames["m1"].parent_frame).partition(":")
    assert (owner, frames["m2"].parent_frame) == ("cable", "w_cable")
    assert float(percent.removesuffix("%")) == pytest.approx(100 / 3, abs=0.05)
    # without a marker at its end nobody knows whether it was straight
    rounded = proposed(moved(SHORT, parts=(1 / 3, 0.8))).model.frames["m1"]
    assert (rounded.parent_frame, rounded.position_std) == ("cable:35%", pytest.approx(0.015 * LENGTH, rel=0.05))


def test_arms_that_hold_both_ends_of_a_rod_move_as_measured(bench: Path) -> None:
    system = build_system(proposed(moved(SHORT, effort=True), *CABLE, "--grasp", "fork=w_cable"))
    assert system.prescribed == ("roll", "pitch"), "the tracking filter needs arms that carry no object"


SWING = """<robot name="swing"><link name="base"/><link name="upper"><inertial><mass value="1"/>
  <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link><link name="tool"/>
  <joint name="lift" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="9" velocity="9"/></joint>
  <joint name="end" type="fixed"><parent link="upper"/><child link="tool"/><origin xyz="0.4 0 0"/></joint></robot>"""


@pytest.mark.parametrize(
    ("late", "places", "given"),
    [(0.0, (1 / 3, 1.0), (33.3, 100)), (0.06, (1 / 3, 1.0), (33.3, 100)), (0.0125, (0.38, 0.96), (40, 95))],
)
def test_late_markers_are_placed_by_where_they_are_while_the_arm_rests(
    late: float, places: tuple[float, float], given: tuple[float, float], bench: Path
) -> None:
    Path("swing.urdf").write_text(SWING)
    t = np.arange(0, 3, 1 / RATE)

    def angle(time: np.ndarray) -> np.ndarray:
        return 0.8 * np.sin(5 * time) * np.clip(time - 0.6, 0, 1)

    joints = JointGroup(("lift",), t, angle(t)[:, None])
    c, s, part = np.cos(angle(t - late))[:, None], np.sin(angle(t - late))[:, None], LENGTH * np.array(places)
    place = np.stack([0.4 * c + part * s, 0 * c * part, part * c - 0.4 * s], axis=2)
    place += 2e-4 * np.random.default_rng(0).standard_normal(place.shape)
    write_recording(Recording(joints, (PointGroup("points", ("a", "b"), t, place),), name="swing"), "swing.h5")
    assert main(["init", "swing.urdf", "swing.h5", "--out", "swing.yaml", *CABLE]) == 0
    frames = load_config("swing.yaml").model.frames
    percents = [str(frames[n].parent_frame).replace("w_cable", ":100").partition(":")[2].rstrip("%") for n in "ab"]
    assert [float(percent) for percent in percents] == pytest.approx(given, abs=0.1)


def test_a_file_of_another_tool_is_imported_along(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = moved(SHORT)
    columns = ["t,r,p,ax,ay,az"]
    for t, q, x in zip(recording.joints.t, recording.joints.position, recording.points[0].position, strict=True):
        columns.append(",".join(repr(float(v)) for v in (t, *np.degrees(q), *(1e3 * x[1]))))
    (bench / "bag.csv").write_text("\n".join(columns) + "\n")
    flags = ["--columns", "r=position:roll,p=position:pitch,ax=x:tip,ay=y:tip,az=z:tip", "--units", "deg,mm"]
    assert init(*CABLE, *flags, "--points", "tip=cable:100%", files=["bag.csv"]) == 0
    assert main(["init", "wrist.urdf", "bag.csv", *CABLE, *flags, "--out", "new.yaml"]) == 2
    told = capsys.readouterr()
    assert ("run.yaml, recording: bag.h5" in told.out, "give bag.h5 as the recording" in told.err) == (True, True)
    run = load_config("run.yaml")
    made = read_recording(run.recordings.estimate[0])
    assert np.allclose(made.joints.position, recording.joints.position)
    assert made.point_names == ("cable:100%",)
    # the section repeats the import
    columns = {"r": "position:roll", "p": "position:pitch", "ax": "x:tip", "ay": "y:tip", "az": "z:tip"}
    assert run.import_.column_meanings == columns
    assert main(["import", "bag.csv", "--out", "again.h5", "--config", "run.yaml"]) == 0
    left = "/scan was left out (9 of Scan): its type is not known"
    write_recording(replace(read_recording("again.h5"), notes=(left,)), "again.h5")
    assert main(["init", "wrist.urdf", "again.h5", "--out", "my run.yaml", *CABLE]) == 0
    said = capsys.readouterr().out
    assert f"note: {left}" in said
    assert "yid-ocp check 'my run.yaml'" in said
    assert np.array_equal(read_recording("again.h5").points[0].position, made.points[0].position)


ONE = ("--length", "1", "--mass", "1")
TREE = ("--object", "tree", "--branch", "a=1,1,1")
REFUSED: dict[str, tuple[Sequence[str], str, str]] = {
    "nothing, no efforts and no commands": ((), "no measurement of the forces that move the arm", "--object"),
    "no object by name": (("--object", "none"), "there is no object 'none'", "beam for a rod (a configuration"),
    "a length of nothing": (ONE[:2], "--length needs --object", "add --object"),
    "cable without a length": (("--object", "cable"), "a cable needs a length", "--length"),
    "cable without a mass": (("--object", "cable", *ONE[:2]), "a cable needs a mass", "--mass"),
    "cable without a radius": (("--object", "cable", *ONE), "a cable needs a radius", "--radius"),
    "beam without a section": (("--object", "beam", *ONE), "radius or a section", "--section"),
    "tree without branches": (("--object", "tree"), "a tree needs branches", "--branches"),
    "equal branches without a mass": (("--object", "tree", "--branches", "4", *ONE[:2]), "needs a mass", "--mass"),
    "branch of two numbers": (("--object", "tree", "--branch", "a=1,2"), "does not describe a branch", "NAME=LENGTH"),
    "branch of no size": (("--object", "tree", "--branch", "a=1,0,1"), "not above 0", "--branch"),
    "branches of a cable": ((*CABLE, "--branch", "a=1,1,1"), "the object 'cable' has no branches", "--object tree"),
    "branch on nothing": (("--object", "tree", "--branch", "a@b=1,1,1"), "grows on 'b', which", "--branch"),
    "branches of one name": ((*TREE, "--branch", "a=1,1,1"), "two branches are called 'a'", "--branch"),
    "negative length": ((*CABLE, "--length", "-1"), "the length is -1, not above 0", "write --length NUMBER"),
    "grams": ((*CABLE, "--mass", "50"), "'cable' has the density 2e+06 kg/m^3", "--mass"),
    "too many links": ((*CABLE, "--links", "99"), "--links is 99", "--links"),
    "unknown holder": ((*CABLE, "--holder", "gripper"), "no frame 'gripper'", "one of the allowed names"),
    "unknown grasp": ((*CABLE, "--grasp", "hup=w_cable"), "no frame 'hup'", "did you mean 'hub'?"),
    "other number": (("--object", "tapered_rod", "--number", "tip_radus=1"), "not a NAME=NUMBER of", "'tip_radius'?"),
    "number alone": (("--object", "tapered_rod", "--number", "tip_radius"), "not a NAME=NUMBER of", "tip_radius=0.1\n"),
    "radius and section": ((*CABLE, "--section", "0.01,0.02"), "are both given", "leave --radius out"),
    "grasp at the root": ((*CABLE, "--grasp", "hub=w_cable"), "'hub' holds the object's root and w_cable", "--holder"),
    "grasp of no point": ((*CABLE, "--grasp", "hub"), "is not FRAME=POINT", "FRAME=POINT"),
    "import flags of a recording": ((*CABLE, "--units", "deg"), "is a recording already", "give the original file"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_missing_is_named_and_nothing_is_written(case, bench, capsys) -> None:
    words, said, where = REFUSED[case]
    before = sorted(bench.iterdir())
    assert init(*words) == 2
    told = capsys.readouterr().err
    assert (said in told, where in told, sorted(bench.iterdir())) == (True, True, before)


def test_recordings_that_do_not_fit_are_refused(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refusal(*files: str, robot: str = "wrist.urdf") -> str:
        assert main(["init", robot, *files, "--out", "run.yaml", *CABLE]) == 2
        return capsys.readouterr().err

    write_recording(moved(SHORT, parts=()), bench / "one.h5")
    assert "no measurement of the object" in refusal("one.h5")
    assert "the robot has no joint that can move" in refusal("one.h5", robot="package:quadrotor_base")
    (bench / "bag.csv").write_text("t,q_shoulder,tip_x,tip_y,tip_z\n" + "".join(f"{k},0.1,0,0,0.5\n" for k in range(9)))
    told = refusal("bag.csv")
    assert re.search("(?s)none of the recorded joints is a joint of the robot: shoulder.*--joints shoulder=NAME", told)
    (bench / "two.csv").write_text("t,q_l,q_h,tip_x,tip_y,tip_z\n" + "".join(f"{k},0.1,0,0,0,0.5\n" for k in range(9)))
    assert "--joints l=roll,h=pitch" in refusal("two.csv")
    (bench / "bag.csv").write_text((bench / "bag.csv").read_text().replace("q_shoulder", "q_roll"))
    write_recording(moved(SHORT), bench / "one.h5")
    assert "the recording lacks the joint 'pitch', which one has" in refusal("one.h5", "bag.csv")
    assert not (bench / "bag.h5").exists()
    (bench / "tip.csv").write_text("t,tip_x,tip_y,tip_z\n0,1,1,1\n1,1,1,2\n")
    assert "yid-ocp import one.h5 tip.csv --out one_merged.h5" in refusal("one.h5", "tip.csv")
    roll = moved(SHORT)
    roll = replace(roll, joints=JointGroup(("roll",), SHORT, roll.joints.position[:, :1]))
    write_recording(roll, bench / "roll.h5")
    assert "the recording lacks the joint 'pitch', which moves in one" in refusal("roll.h5", "one.h5")
    (bench / "run.yaml").write_text("kept: true\n")
    assert "already exists" in refusal("one.h5")
    assert (bench / "run.yaml").read_text() == "kept: true\n"


def test_a_recording_of_one_sample_is_doubted(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    proposed(moved(SHORT[:1]))
    told = capsys.readouterr().out
    assert "joints has only 1 sample (at least 4 are needed)" in told
    assert ("do not use it before the advice above is followed" in told, "yid-ocp check" in told) == (True, False)
    made = moved(1e3 * SHORT, parts=())
    made = replace(made, joints=replace(made.joints, effort=made.joints.position))
    proposed(made, "--holder", "hub")
    assert "try: import the original file again with --units t=ms, and give the" in capsys.readouterr().out
    rows = "".join(f"{t},{a},{a},{a},{a}\n" for t, a in zip(made.joints.t, made.joints.position[:, 0], strict=True))
    Path("ms.csv").write_text("t,q_roll,q_pitch,tau_roll,tau_pitch\n" + rows)
    assert init("--replace", files=["ms.csv"]) == 0
    assert "try: repeat this command with --units t=ms --replace" in capsys.readouterr().out
    assert init("--units", "t=ms", "--replace", files=["ms.csv"]) == 0
    assert "next: yid-ocp check run.yaml" in capsys.readouterr().out


def test_points_in_another_frame_are_not_placed(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = proposed(moved(SHORT, far=3.0))
    assert re.search("(?s)--length and --point-frame.*no point of the group points is on", capsys.readouterr().out)
    assert not run.sensors["points"].frame_by_recorded_name
    # and `check` says what is missing
    assert main(["check", "run.yaml"]) == 2
    assert "has the name of a frame of the model" in capsys.readouterr().err

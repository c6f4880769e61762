"""Models in other formats."""

import json
import shutil
import sys
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from yid_ocp.config.reader import SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME, load_config
from yid_ocp.config.settings import config_yaml_with_defaults
from yid_ocp.data import JointGroup, Recording
from yid_ocp.virtual.mujoco_simulation import replay_mismatch_by_channel
from yid_ocp.workflow import export
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.run_inputs import read_recordings_of_role

mujoco = pytest.importorskip("mujoco", reason="exported models need MuJoCo: pip install '.[blind]'")


def written_run(folder, effects, run, recorded=True):
    """A run folder as `diagnose` leaves it that found the truth of the embedded recordings, and some effects."""
    system = build_system(run)
    truth = read_recordings_of_role(run, "estimate")[0].true_parameters
    values = {p.name: p.value for p in system.parameters} | effects
    values |= {name: value for name, value in truth.items() if name.endswith((".bend", ".twist"))}
    free = {*(name for name in values if name.endswith((".bend", ".twist"))), *effects}
    parameters = {
        name: {"value": value, "std": 0.01 if name in free else 0.0, "unit": "", "free": name in free}
        for name, value in values.items()
    }
    parameters["T2.twist"]["verdict"] = "not_identifiable"
    folder.mkdir()
    said = run if recorded else replace(run, recordings=replace(run.recordings, held_out=(), estimate=()))
    (folder / "config.yaml").write_text(config_yaml_with_defaults(said))
    result = {"format": "yid-diagnosis/2", "verdict": "effect", "to_use": {"left_out": ["T3.twist"]}}
    result["model"] = {"parameters": parameters, "covariance": {}}
    (folder / "result.json").write_text(json.dumps(result))
    return folder


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    run = load_config(None, ["problem.duration=1.5"], default=SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME)
    return written_run(tmp_path_factory.mktemp("found") / "run", {"kelvin_voigt@T1.tau": 0.05}, run)


@pytest.fixture
def exported(printed):
    """exported(run, out, form): write a model; returns its manifest."""

    def export(run, out, form="mjcf"):
        return json.loads(printed("export", run, "--out", out, "--format", form, "--json", "--lossy"))

    return export


def gate_holds(gate) -> None:
    assert (gate["status"], gate["which"]) == ("done", "held_out")
    times_noise = {
        name: (own["before"] / own["noise"], own["after"] / own["noise"]) for name, own in gate["channels"].items()
    }
    assert all(after < 1.3 for _, after in times_noise.values())
    assert min(times_noise["joints.effort"][0], times_noise["points_camera.w_T3"][0]) > 2


@pytest.mark.slow
def test_the_embedded_diagnosis_in_mujoco(printed, found, tmp_path) -> None:
    out = tmp_path / "y.xml"
    told = printed("export", found, "--out", out)
    parts = "kelvin_voigt@T1               exact", "value of T2.twist, T3.twist"
    assert [part for part in parts if part not in told] == []
    manifest = json.loads(out.with_name(f"{out.name}.manifest.json").read_text())
    gate_holds(manifest["gate"])
    assert manifest["effects"] == {"kelvin_voigt@T1": {"status": "native", "how": "damping of joints"}}
    entry = manifest["parameters"]["kelvin_voigt@T1.tau"]
    assert (entry["value"], entry["std"], entry["status"]) == (0.05, 0.01, "native")
    system = build_system(load_config(found / "config.yaml"))
    assert set(manifest["parameters"]) == {*system.parameters.names, "kelvin_voigt@T1.tau"}
    model = mujoco.MjModel.from_xml_path(str(out))
    bend = manifest["parameters"]["T1.bend"]["value"]
    joint = model.joint("T1_2_y").id
    assert model.jnt_stiffness[joint] == pytest.approx(bend)
    assert model.dof_damping[joint] == pytest.approx(0.05 + 0.05 * bend)
    assert model.nu == len(system.driven)
    pinocchio = pytest.importorskip("pinocchio", minversion="4.0", reason="constraints between sites need Pinocchio 4")
    other = pinocchio.buildModelFromMJCF(str(out))
    assert other.nv == model.nv == system.n_coordinates
    assert sum(body.mass for body in other.inertias) == pytest.approx(model.body_mass.sum())


@pytest.mark.slow
def test_the_embedded_example_finds_what_was_withheld_and_plays_it_in_mujoco(carried_out, tmp_path, exported) -> None:
    done = carried_out("diagnose")
    result = done.result
    assert result["verdict"] == "effect"
    assert result["effects"] == [{"kind": "kelvin_voigt", "location": "T1"}]
    assert result["which"][0]["parameters"]["tau"]["value"] == pytest.approx(0.05, rel=0.1)
    assert result["gap"]["closure_ci"][0] > 0.9
    assert (done.folder / "report.html").exists()
    gate_holds(exported(done.folder, tmp_path / "y.xml")["gate"])


def test_urdf_loads_in_three_readers(found, tmp_path, exported) -> None:
    pinocchio, yourdfpy = pytest.importorskip("pinocchio"), pytest.importorskip("yourdfpy")
    out = tmp_path / "y.urdf"
    manifest = exported(found, out, "urdf")
    said = {name: entry["status"] for name, entry in manifest["parameters"].items()}
    assert said["T1.bend"] == "not representable"
    assert said["kelvin_voigt@T1.tau"] == said["T1.damping"] == said["T1.mass"] == "native"
    assert manifest["grasps"]["left"]["status"] == "not representable"
    system = build_system(load_config(found / "config.yaml"))
    robot = yourdfpy.URDF.load(str(out), load_meshes=False).robot
    assert [j.name for j in robot.joints if j.type != "fixed"] == list(system.mechanism.joint_names)
    ours = pinocchio.buildModelFromUrdf(str(out))
    model = mujoco.MjModel.from_xml_path(str(out))
    assert ours.nv == model.nv == system.n_coordinates
    assert sum(body.mass for body in ours.inertias) == pytest.approx(model.body_mass.sum(), abs=1e-6)
    bend = manifest["parameters"]["T1.bend"]["value"]
    assert model.dof_damping[model.joint("T1_2_y").dofadr[0]] == pytest.approx(0.05 + 0.05 * bend)


def test_sdf_has_springs_too(found, tmp_path, exported) -> None:
    out = tmp_path / "y.sdf"
    manifest = exported(found, out, "sdf")
    assert manifest["parameters"]["T1.bend"]["status"] == "native"
    model = ElementTree.parse(out).getroot().find("world/model")
    system = build_system(load_config(found / "config.yaml"))
    assert [joint.get("name") for joint in model.findall("joint")] == list(system.mechanism.joint_names)
    dynamics = model.find("joint[@name='T1_2_y']/axis/dynamics")
    bend = manifest["parameters"]["T1.bend"]["value"]
    sizes = {"damping": 0.05 + 0.05 * bend, "friction": 0.0, "spring_stiffness": bend, "spring_reference": 0.0}
    assert {entry.tag: float(entry.text) for entry in dynamics} == pytest.approx(sizes)
    masses = [float(entry.text) for entry in model.findall("link/inertial/mass")]
    assert sum(masses) == pytest.approx(20.16662, abs=1e-5)
    assert min(masses) > 0
    link = model.find("link[@name='T1_1_x_link']/pose")
    assert link.get("relative_to") == "T1_0_z_link"
    np.testing.assert_allclose([float(x) for x in link.text.split()], [0, 0, 0.813 / 4, 0, 0, 0], atol=1e-12)


def test_what_cannot_be_said_is_left_out_and_listed(tmp_path, exported) -> None:
    effects = {"hysteresis@T2.stiffness": 0.4, "hysteresis@T2.yield_angle": 0.1, "kelvin_voigt@T1.tau": 0.05}
    effects |= {"junction_compliance@w_T1.compliance": 0.02, "joint_coulomb@left_e1.tau_c": 0.5}
    effects |= {"joint_load_friction@left_e1.share": 0.1, "grasp_compliance@left.compliance": 0.0}
    law = "model.friction={law: load, joints: [left_e1]}"
    coarse = load_config(None, ["model.object.links=1", law], SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME)
    manifest = exported(written_run(tmp_path / "both", effects, coarse, False), tmp_path / "both.xml")
    assert {label: entry["status"] for label, entry in manifest["effects"].items()} == {
        "hysteresis@T2": "not representable",
        "kelvin_voigt@T1": "native",
        "junction_compliance@w_T1": "not representable",
        "joint_coulomb@left_e1": "emulated",
        "joint_load_friction@left_e1": "not representable",
        "grasp_compliance@left": "native",
    }
    assert manifest["grasps"]["left"] == {"status": "native", "how": "equality constraints between sites"}
    assert "memory" in manifest["effects"]["hysteresis@T2"]["how"]
    assert manifest["parameters"]["hysteresis@T2.stiffness"]["status"] == "not representable"
    assert manifest["gate"] == {"status": "not done", "reason": "the run has no recordings"}
    kept = {name: value for name, value in effects.items() if name.startswith(("kelvin", "joint_coulomb"))}
    exported(written_run(tmp_path / "less", kept, coarse, False), tmp_path / "less.xml")
    assert (tmp_path / "both.xml").read_text() == (tmp_path / "less.xml").read_text()


def test_a_configuration_that_starts_at_the_estimates(printed, carried_out, pendulum) -> None:
    settings = ["output={write_report: false, checked_discretisation: none}"]
    first = carried_out("solve", pendulum, settings=settings, out="first").result
    assert printed("export", "first", "--format", "yaml", "--out", "again.yaml", "--quiet") == "again.yaml\n"
    second = carried_out("solve", "again.yaml", out="second").result
    assert second["iterations"] <= 1 < first["iterations"]
    for name, entry in second["parameters"].items():
        if entry["free"]:
            assert entry["initial"] == first["parameters"][name]["value"]
            assert entry["value"] == pytest.approx(first["parameters"][name]["value"], rel=1e-5)


def test_effects_that_were_found_come_back_free(found, tmp_path, exported) -> None:
    exported(found, tmp_path / "again.yaml", "yaml")
    run = load_config(tmp_path / "again.yaml")
    assert [(e.kind, e.location, dict(e.values)) for e in run.model.effects] == [("kelvin_voigt", "T1", {"tau": 0.05})]
    assert run.parameters["kelvin_voigt@T1.tau"].free
    assert build_system(run).parameters["T1.bend"].value == run.parameters["T1.bend"].initial != 10.0


def test_recorded_points_of_a_robot_without_an_object_are_replayed(cli, repository, tmp_path, exported) -> None:
    assert cli("solve", repository / "configs" / "springs_series_joint.yaml", "--out", tmp_path / "run").code == 0
    channels = exported(tmp_path / "run", tmp_path / "s.xml")["gate"]["channels"]
    assert [*channels] == ["points_camera.joint", "points_camera.end"]
    assert all(own["after"] < 1.2 * own["noise"] < 0.2 * own["before"] for own in channels.values())


def test_wrong_input_leaves_nothing(printed, found, pendulum_data, tmp_path) -> None:
    recording = pendulum_data.folder / "estimate.h5"
    broken = shutil.copytree(found, tmp_path / "broken")
    (broken / "result.json").write_text("{")
    before = set(tmp_path.rglob("*"))
    for arguments, parts in (
        ((found, "--format", "usd"), ["exported as 'usd'", "sdf, yaml, mcap", "UsdPhysics has no cables yet"]),
        ((found, "--out", tmp_path / "a.mcap"), ["a.mcap would be a folder", f"--out {tmp_path / 'a'}"]),
        ((recording, "--format", "mjcf"), ["the format mjcf needs a run folder", "solve"]),
        ((recording, "--out", tmp_path / "a.urdf"), ["the format urdf needs a run folder"]),
        ((broken,), ["result.json", "not valid JSON"]),
        ((tmp_path,), ["is not the folder of a finished run"]),
        ((tmp_path / "nothing",), ["nothing"]),
        ((found, "--lossy", "--out", tmp_path / "no" / "y.urdf"), ["folder to write to does not exist"]),
    ):
        told = printed("export", *arguments, *(() if "--out" in arguments else ("--out", tmp_path / "y.xml")), code=2)
        assert all(part in told for part in parts), told
    assert set(tmp_path.rglob("*")) == before


def test_no_model_without_its_manifest_and_no_replay_without_mujoco(cli, found, tmp_path, monkeypatch) -> None:
    (tmp_path / "y.urdf.manifest.json").mkdir()
    assert cli("export", found, "--format", "urdf", "--lossy", "--out", tmp_path / "y.urdf").code == 2
    assert not (tmp_path / "y.urdf").exists()
    monkeypatch.setitem(sys.modules, "mujoco", None)
    done = cli("export", found, "--out", tmp_path / "y.xml")
    assert "not tested by a replay in MuJoCo: the replay needs MuJoCo. Try: pip" in " ".join(done.out.split())
    assert "replaying" not in done.err


def test_a_format_that_cannot_hold_all_is_refused_before_anything_is_replayed(printed, found, tmp_path) -> None:
    told = printed("export", found, "--out", tmp_path / "y.urdf", code=2)  # the ending chooses the format
    for part in ("parts of the model: T1.bend, T2.bend", "grasp left", "--lossy"):
        assert part in told
    assert list(tmp_path.iterdir()) == []


def test_prescribed_joints_are_moved_as_recorded(cli, pendulum, tmp_path, exported, urdf_folder) -> None:
    robot = shutil.copy(urdf_folder / "double_pendulum.urdf", tmp_path)
    said = ("output.write_report=false", "sensors.joints.effort.std=0.02", f"model.robot={robot}")
    said += ("model.effects=[{kind: effort_offset, location: shoulder}]", "parameters.effort_offset@*={free: true}")
    assert cli("solve", pendulum, "--out", "run", *(word for entry in said for word in ("--set", entry))).code == 0
    assert "double_pendulum.urdf already exists" in cli("export", "run", "--lossy", "--out", robot).err
    manifest = exported("run", tmp_path / "pendulum.xml")
    [(name, entry)] = manifest["gate"]["channels"].items()
    assert (name, entry["unit"]) == ("joints.effort", "N m")
    assert entry["after"] < 0.3 * entry["before"]
    assert entry["noise"] == pytest.approx(0.02)  # as the settings state
    assert manifest["parameters"]["shoulder.stiffness"]["estimated"]
    assert manifest["parameters"]["shoulder.stiffness"]["how"] == "stiffness of joints"
    run = load_config(tmp_path / "run" / "config.yaml")
    [recording] = read_recordings_of_role(run, "held_out")
    rough = recording.joints.position + 1e-3 * np.random.default_rng(0).standard_normal(recording.joints.position.shape)
    noisy = replace(recording, joints=replace(recording.joints, position=rough, position_std=None))
    text = (tmp_path / "pendulum.xml").read_text(encoding="utf-8")
    # noise that the recording does not state is smoothed: differentiated twice, it would be many times the torques
    assert replay_mismatch_by_channel(text, build_system(run), noisy)["joints.effort"].rmse < 0.6


def test_a_servo_has_the_gain_that_the_recording_states(tmp_path, urdf_folder) -> None:
    config = tmp_path / "servo.yaml"
    robot = urdf_folder / "double_pendulum.urdf"
    arms = f"model: {{robot: {robot}, arms: {{mode: servo, servo: {{motor: {{kind: dc}}}}}}}}\n"
    stated = "parameters: {shoulder.servo_gain_factor: {initial: 7.0}}\n"
    joints = JointGroup(("shoulder", "elbow"), np.arange(3.0), np.zeros((3, 2)), position_command=np.zeros((3, 2)))
    recording = Recording(replace(joints, proportional_gain=400.0), name="firmware")
    for text, factors in ((arms, {"shoulder": 400.0, "elbow": 400.0}), (arms + stated, {"elbow": 400.0})):
        config.write_text(text, encoding="utf-8")
        run = load_config(config)
        values = {p.name: p.value for p in build_system(run).parameters} | {"elbow.servo_gain": 0.01}
        model = export._CalibratedModel(run, run, values, {})
        [gains] = model.servo_gains([recording])
        assert gains == {f"{joint}.servo_gain_factor": factor for joint, factor in factors.items()}
        root = ElementTree.fromstring(model.with_values(gains).text("mjcf", model.system(())))
        assert float(root.find("actuator/*[@name='elbow']").get("gainprm")) == pytest.approx(4.0)

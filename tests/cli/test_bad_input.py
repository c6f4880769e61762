"""What a user gets wrong: exit code 2, a message that says what, where, what is allowed, what to do; nothing left."""

import traceback
from operator import delitem, setitem

import h5py
import numpy as np
import pytest

from yid_ocp.config.reader import load_config
from yid_ocp.errors import ConfigError


def assert_refused(done, *words):
    assert done.code == 2, done.err
    assert "Traceback" not in done.err
    for word in ("error: ", "where: ", "allowed: ", "try: ", *words):
        assert word in done.err, done.err


def test_a_value_below_its_comment_is_read(cli, pendulum):
    """The YAML reader that keeps comments gives up on this one."""
    text = pendulum.read_text()
    assert "problem:\n" in text
    pendulum.write_text(text.replace("problem:\n", "problem:\n  time_step: # [s]\n    0.005\n\n  # smoothing\n"))
    assert cli("check", pendulum).code == 0


def test_very_many_keys_are_refused_before_the_work(cli, tmp_path):
    (tmp_path / "long.yaml").write_text("".join(f"k{i}: 1\n" for i in range(50_000)))
    assert_refused(cli("check", tmp_path / "long.yaml"), "more than 20000 entries", "long.yaml, line")
    (tmp_path / "long.yaml").write_text("# " + "x" * (1 << 20))
    assert_refused(cli("check", tmp_path / "long.yaml"), "more than 1 MiB", "at most 1 MiB")


def test_a_path_with_a_nul_is_refused(cli, pendulum, tmp_path):
    assert_refused(cli("solve", str(tmp_path / "a\0b.yaml")))
    assert_refused(cli("export", "a\0b", "--out", tmp_path / "x"))
    assert_refused(cli("import", "a\0b.csv", "--out", tmp_path / "x.h5"))


def test_two_units_of_one_quantity_are_refused(cli, tmp_path):
    (tmp_path / "a.csv").write_text("t,q_a\n0,1\n1,2\n2,3\n")
    wrong = ("import", tmp_path / "a.csv", "--out", tmp_path / "a.h5", "--units", "deg,rad")
    assert_refused(cli(*wrong), "'position' has two units, deg and rad", "one unit for every quantity")


def edited(file, old, new):
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    return next(i for i, line in enumerate(file.read_text().splitlines(), 1) if new.splitlines()[0].strip() in line)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("held_out:", "heldout:", ("there is no key 'heldout'", "recordings.heldout", "did you mean 'held_out'?")),
        ("{free: true}", "{fre: true}", ("did you mean 'free'?", "parameters.shoulder.damping.fre")),
        ("path_cutoff: .inf", "path_cutoff: 5 Hz", ("path_cutoff", "[Hz]", "write 5 alone, without a unit")),
        ("path_cutoff: .inf", "time_step: 10 ms", ("time_step", "[s]", "write 0.01 alone")),
        ("path_cutoff: .inf", "time_step: .nan", ("time_step",)),
        ("path_cutoff: .inf", "time_step: '0.01'", ("time_step", "time_step: 0.01 (the default)")),
        ("bounds: [0.0, 100.0]", "bounds: [-5.0, 100.0]", ("bounds", "from 0 to inf N m/rad")),
        ("bounds: [0.0, 100.0]", "bounds: [0.0, 0.5]", ("upper bound of 0.5 N", "at most 0.5 N m/rad")),
        ("bounds: [0.0, 100.0]", "initial: 200, bounds: [0.0, 100.0]", ("upper bound of 100 N", "at most 100 N m/rad")),
        ("shoulder.stiffness:", "sholder.stiffness:", ("no parameter", "did you mean 'shoulder.stiffness'?")),
        ("shoulder.stiffness:", "*.stiffness:", ("quote patterns, such as '*.stiffness'",)),
        ("    shoulder: {stiff", "    sholder: {stiff", ("there is no joint 'sholder'", "did you mean 'shoulder'?")),
        ("mode: prescribed", "mode: prescribed, joints: [sholder]", ("sholder", "did you mean 'shoulder'?")),
        ("mode: prescribed", "mode: prescribed, locked_joints: {albow: 1}", ("albow", "did you mean 'elbow'?")),
        ("double_pendulum.urdf", "doubel_pendulum.urdf", ("no such URDF file", "double_pendulum.urdf")),
        ("double_pendulum.urdf", "..", ("is a folder, but must be a URDF file", "the path of a file")),
        ("estimate.h5", "estimat.h5", ("no such recording", "recordings.estimate", "did you mean 'estimate.h5'?")),
        ("recordings:", "sensors: {points: {std: 1}}\nrecordings:", ("no recording has the sensor 'points'",)),
        ("  held_out:", "  held_out: [nothing.h5]\n  held_out:", ("is duplicated", "held_out")),
        ("recordings:", "recordings: [", ("not valid YAML",)),
    ],
)  # fmt: skip
def test_configuration(cli, pendulum, left_nothing, old, new, words):
    line = edited(pendulum, old, new)
    done = cli("solve", pendulum)
    assert_refused(done, *words)
    if "YAML" not in words[0] and "duplicated" not in words[0]:
        assert f"pendulum.yaml, line {line}" in done.err
    left_nothing()


def test_no_such_configuration(cli, pendulum):
    folder = pendulum.parent
    assert_refused(cli("solve", folder / "pendolum.yaml"), "no such configuration", "did you mean 'pendulum.yaml'?")
    with pytest.raises(ConfigError) as caught:
        load_config(folder / "pendolum.yaml")
    said = "".join(traceback.format_exception(caught.value))
    assert said.count("Traceback") == 1, said
    assert_refused(cli("solve", folder / "x.h5"), "x.h5 is a recording, not a configuration", "init ROBOT.urdf")
    assert_refused(cli("check", folder), "this is a folder, but must be a file", "a YAML file")
    for text, words in ((b"- 1\n", "but no keys"), (b"description: \xe9\n", "UTF-8")):
        (folder / "odd.yaml").write_bytes(text)
        assert_refused(cli("solve", folder / "odd.yaml"), words)


def test_nothing_to_solve(cli, pendulum, pendulum_data, left_nothing):
    assert_refused(cli("solve", pendulum, "--set", "parameters={}"), "no parameter is free")
    fixed = "parameters={'shoulder.*ss': {free: false}}"
    done = cli("solve", pendulum, "--set", "parameters={}", "--set", fixed)
    assert_refused(done, "for example parameters.shoulder.stiffness.free: true")
    assert_refused(cli("solve", pendulum, "--set", "recordings.estimate=[]"), "no recording is listed for estimation")
    assert_refused(cli("solve", pendulum, "--set", "model={}"), "neither a robot nor an object")
    assert_refused(cli("solve", pendulum, "--set", "problem.time_step"), "KEY=VALUE")
    same = pendulum_data.folder / "estimate.h5"
    assert_refused(cli("solve", pendulum, "--set", f"recordings.held_out=[{same}]"), "for estimation and as held out")
    missing = "recordings.estimate=[default:dual_arm_vison_estimate.h5]"
    assert_refused(cli("solve", pendulum, "--set", missing), "no such recording", "'dual_arm_vision_estimate.h5'?")
    left_nothing()


OTHER = np.array(["shoulder", "elbo"], dtype=h5py.string_dtype())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda j: setitem(j.attrs, "names", OTHER),
            ("joint 'elbow' of the model is not recorded", "mean 'elbo'?", "RECORDED=elbow"),
        ),
        (lambda j: delitem(j, "effort"), ("no sensor of the model has a measurement", "which has no efforts")),
        (lambda j: delitem(j.attrs, "effort_std"), ("deviation of the noise", "sensors.joints.effort.std")),
    ],
    ids=["another joint", "no effort", "no noise"],
)
def test_recordings(cli, pendulum, pendulum_data, tmp_path, left_nothing, change, words):
    """A copy of the recording, changed in the file where the package itself would refuse to write it."""
    path = tmp_path / "changed.h5"
    path.write_bytes((pendulum_data.folder / "estimate.h5").read_bytes())
    with h5py.File(path, "r+") as file:
        change(file["joints"])
    assert_refused(cli("solve", pendulum, "--set", f"recordings.estimate=[{path}]"), *words)
    left_nothing()


def test_a_grasp_out_of_reach(cli, tmp_path, monkeypatch, repository, left_nothing):
    monkeypatch.chdir(tmp_path)
    done = cli(
        "solve", repository / "configs" / "single_arm_no_vision.yaml",
        "--set", "model.object={kind: foam_y, links: 1, mount: {xyz: [2.5, 0, -0.93]}}",
    )  # fmt: skip
    assert_refused(done, "grasp 'left' are at least", "mm apart", "model.grasp.left")
    done = cli("check", repository / "configs/single_arm_vision.yaml", "--set", "model.arms.joints=[left_s0, left_s1]")
    assert_refused(done, "mm apart", "model.arms.joints", "add these recorded joints, which the model fixes: left_e0")
    left_nothing()


def test_a_grasp_of_an_unknown_frame(cli, tmp_path, monkeypatch, repository):
    monkeypatch.chdir(tmp_path)
    config = repository / "configs" / "single_arm_no_vision.yaml"
    done = cli("solve", config, "--set", "model.grasp.left.holder_frame=left_griper")
    assert_refused(done, "there is no frame 'left_griper'", "did you mean 'left_gripper'?")
    done = cli("solve", config, "--set", "model.object.mount.parent_frame=left_griper")
    assert_refused(done, "there is no frame 'left_griper'", "where: --set model.object.mount.parent_frame")
    frame = "model.frames={mark: {parent_frame: 'T:25%'}}"
    assert_refused(cli("solve", config, "--set", frame), "no frame 'T:25%'", "allowed: T3:40%")
    assert_refused(cli("solve", config, "--set", "model.object={kind: z}"), "there is no kind 'z'", "y, segments")


@pytest.mark.parametrize("command", ["solve", "check", "inspect", "simulate"])
def test_an_output_folder_that_cannot_be(cli, pendulum, tmp_path, monkeypatch, left_nothing, command):
    # nothing may be built before the folder is known to be writable
    monkeypatch.setattr(f"yid_ocp.workflow.{command}.build_step", lambda *a: pytest.fail("too late"), raising=False)
    monkeypatch.setattr(f"yid_ocp.workflow.{command}.build_problem", lambda *a: pytest.fail("too late"), raising=False)
    (tmp_path / "file.h5").write_text("not a folder")
    assert_refused(cli(command, pendulum, "--out", tmp_path / "file.h5" / "run"), "cannot be created", "--out")
    assert_refused(cli(command, pendulum, "--out", tmp_path / "file.h5"), "existing file")
    assert_refused(cli(command, pendulum, "--out", tmp_path), "exists and is not empty", "--out")
    left_nothing()


def test_two_recordings_of_one_name_are_told_apart(cli, pendulum, pendulum_data, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    copy = other / "estimate.h5"
    copy.write_bytes((pendulum_data.folder / "estimate.h5").read_bytes())
    both = f"recordings.estimate=[{pendulum_data.folder / 'estimate.h5'}, {copy}]"
    assert cli("solve", pendulum, "--set", both, "--out", "two").code == 0

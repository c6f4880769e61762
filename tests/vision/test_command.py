import contextlib
import dataclasses
import io
import json
import re
from types import SimpleNamespace

import numpy as np
import pytest

from yid_ocp.cli import build_argument_parser, main
from yid_ocp.config.reader import load_config
from yid_ocp.data.recording_hdf5 import read_recording
from yid_ocp.vision import TrackOptions
from yid_ocp.vision.track import SingleFrameTracker

CONFIG = """\
model:
  robot: package:baxter
  arms:
    joints: [left_s0, left_s1, left_e0, left_e1, left_w0, left_w1, left_w2]
  object: {{kind: foam_y}}
  grasp:
    left: {{holder_frame: left_gripper, held_frame: w_T2}}
recordings:
  estimate: [{data}/joints.h5]
track:
  frames_path: {data}/frames
  n_drawn_frames: 1
  options: {{calibration: {{fix_pose: true}}, clock_offset_search: {{search_half_width: 0}}}}
"""
PLAIN, UNDRAWN = "output.write_report=false", "track.n_drawn_frames=0"


@pytest.fixture(scope="module")
def config(repository, tmp_path_factory):
    file = tmp_path_factory.mktemp("config") / "small.yaml"
    file.write_text(CONFIG.format(data=repository / "tests" / "vision" / "data"))
    return file


@pytest.fixture(scope="module")
def whole(config):
    """What a run in one process made and said."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(["track", str(config), "--out", str(config.parent / "whole")])
    return SimpleNamespace(folder=config.parent / "whole", code=code, out=out.getvalue(), err=err.getvalue())


def test_track_makes_a_recording_that_solve_reads(whole, small, system):
    from matplotlib.image import imread  # half a second

    assert whole.code == 0, whole.err
    assert "3 of 3 images are used" in whole.out
    assert "w_T1" in whole.out
    assert "fitting the object in every image" in whole.err
    made = read_recording(whole.folder / "recording.h5")
    group = next(group for group in made.points if group.name == "points_camera")
    assert group.names == ("w_T1", "w_T3")
    truth = small.truth[:, [system.point_frames.index(name) for name in group.names]]
    assert np.linalg.norm(group.position - truth, axis=2).max() < 0.008
    result = json.loads((whole.folder / "result.json").read_text())
    assert result["format"] == "yid-track/1"
    assert [frame["reason"] for frame in result["frames"]] == ["", "", ""]
    assert result["camera"]["n_frames"] == 0  # the clouds hold no arm
    assert len(result["inputs"]) == 4
    pictures = sorted((whole.folder / "pictures").glob("*.png"))
    assert [path.stem.rpartition("_")[2] for path in pictures] == ["cloud", "filtered", "skeleton", "graph", "fit"]
    for file in (*pictures, whole.folder / "track.png"):
        image = imread(file)
        assert image.shape[0] > 400
        assert image[..., :3].std() > 0.01


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["track.frames_path=nowhere"], "no such file or folder"),
        (["recordings.estimate=[]"], "no recording with the joint angles"),
        (["track.camera_pose=[[1,0,0,0],[0,1,0,0],[0,0,2,0],[0,0,0,1]]"], "not a rigid transform"),
        (["track.options.max_distance_in_radi=0.02"], "did you mean 'max_mean_surface_distance_in_radii'"),
        (["track.options.filters.robot_padding=-1"], "robot_padding is -1"),
        (["model.arms.mode=prescribed", "track.frames_path=null"], "needs model.arms.mode: driven"),
    ],
)
def test_wrong_input_is_said_and_leaves_nothing(printed, config, tmp_path, settings, message):
    told = printed("track", config, "--out", tmp_path / "run", settings=settings, code=2)
    assert message in told
    assert "Traceback" not in told
    assert not (tmp_path / "run").exists()


def test_without_a_good_frame_the_reasons_and_pictures_are_left(carried_out, config, tmp_path):
    done = carried_out("track", config, settings=("track.point_cloud_unit=mm", PLAIN), codes=(2,))
    assert "no frame could be used" in done.err
    assert f"reasons, and pictures of readable frames, are in {done.folder}" in done.err
    assert "no frame could" in done.result["refused"]
    assert all("no point lies in the region" in frame["reason"] for frame in done.result["frames"])
    assert len(list((done.folder / "pictures").glob("*_cloud.png"))) == 1
    assert not (done.folder / "recording.h5").exists()
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == ["run"]


def result_of(folder):
    """Numbers of a run, without what depends on the clock on the wall."""
    result = json.loads((folder / "result.json").read_text())
    for key in ("date", "command"):
        del result[key]
    for frame in result["frames"]:
        del frame["seconds"]
    return result


def test_what_an_interrupted_run_did_is_used_and_workers_do_the_rest(
    cli, carried_out, config, whole, tmp_path, monkeypatch
):
    """Killed after the second frame: the next run does the other alone, with the same result to the last bit."""
    worked, work = [], SingleFrameTracker.process_one_frame

    def interrupted(self, index, common):
        if len(worked) == 2:
            raise KeyboardInterrupt
        worked.append(work(self, index, common))
        return worked[-1]

    monkeypatch.setattr(SingleFrameTracker, "process_one_frame", interrupted)
    assert cli("track", config, "--out", tmp_path / "run").code not in (0, 1)
    assert not (tmp_path / "run").exists()
    assert (tmp_path / "run.partial").is_dir()
    monkeypatch.setattr(SingleFrameTracker, "estimate_shared_values", None)  # it is known
    again = carried_out("track", config, "--workers", "2", settings=(PLAIN, UNDRAWN))
    assert [frame["seconds"] for frame in again.result["frames"][:2]] == [report.cpu_seconds for report in worked]
    assert not (tmp_path / "run.partial").exists()
    assert result_of(again.folder) == result_of(whole.folder)
    one, other = (read_recording(folder / "recording.h5").points[-1] for folder in (again.folder, whole.folder))
    assert np.array_equal(one.position, other.position)
    assert np.array_equal(one.std, other.std)


@pytest.mark.parametrize("name", ["track_single_arm", pytest.param("track_dual_arm", marks=pytest.mark.slow)])
def test_the_examples_run(carried_out, repository, name):
    pytest.importorskip("mujoco", reason="virtual experiments need MuJoCo")
    file = repository / "configs" / f"{name}.yaml"
    short = ("virtual_frames={duration: 1.0, frame_rate: 4.0, dropped_frame_fraction: 0.0}",)
    coarse = ("options.filters.voxel_size=0.014", "options.calibration.n_frames=3")
    settings = [f"track.{setting}" for setting in (*short, *coarse)]
    done = carried_out("track", file, "--quiet", settings=(*settings, PLAIN, UNDRAWN))
    assert done.out.strip() == str(done.folder)
    result = done.result
    assert all(entry["largest"] < 0.015 for entry in result["truth_errors"].values())
    assert set(result["truth_errors"]) == ({"w_T1", "w_T3"} if name == "track_single_arm" else {"w_T1"})


def test_a_flag_keeps_the_told_pose(repository):
    config = str(repository / "configs" / "track_single_arm.yaml")
    for flags in ([], ["--fix-pose"]):
        run = load_config(config, build_argument_parser().parse_args(["track", config, *flags]).overrides)
        assert run.track.options.calibration.fix_pose is bool(flags)


@pytest.fixture(scope="module")
def text(repository):
    return (repository / "docs" / "howto" / "vision.md").read_text(encoding="utf-8")


def test_the_example_runs(text, repository, tmp_path, monkeypatch, capsys):
    [block] = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    monkeypatch.chdir(repository)
    exec(compile(block.replace('"tracked.h5"', repr(str(tmp_path / "tracked.h5"))), "docs/howto/vision.md", "exec"), {})
    assert read_recording(tmp_path / "tracked.h5").points[-1].names == ("w_T1", "w_T3")
    assert "clock offset" in capsys.readouterr().out


def test_the_settings_exist(repository):
    text = (repository / "docs" / "explain" / "tracking.md").read_text(encoding="utf-8")
    options = TrackOptions()
    known = {field.name for field in dataclasses.fields(options)}
    for part in ("filters", "clock_offset_search", "calibration"):
        known |= {field.name for field in dataclasses.fields(getattr(options, part))}
    _, _, table = text.partition("| stage | settings")
    rows = [line for line in table.partition("\n\n")[0].splitlines()[2:] if line.startswith("| ")]
    named = [name for row in rows for name in re.findall(r"`([\w.]+)`", row.split("|")[2])]
    assert len(named) > 10
    assert {name.rpartition(".")[2] for name in named} <= known

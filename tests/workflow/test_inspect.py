"""Where the command `inspect` looks."""

import math

import h5py
import numpy as np
import pytest

from yid_ocp.data import PointGroup, Recording, write_recording

TIMES = 0.01 * np.arange(31)
ROD = "named_segments: {T1: {length: LENGTH, mass: 0.1, radius: 0.02, links: 2}}"
HANGING = f"""\
model:
  object: {{kind: segments, mount: {{rpy: [3.141592653589793, 0, 0]}}, {ROD.replace("LENGTH", "0.6")}}}
  measured_points: [T1_0_tip, w_T1]
recordings: {{estimate: [aside.h5]}}
parameters: {{T1.bend: {{free: true, initial: 4}}, T1.twist: {{initial: 3}}}}
problem: {{use_compiler: false, initial_state: fitted_to_points}}
output: {{write_report: false}}
"""
FAR = f"""\
model:
  robot: URDF
  object: {{kind: segments, mount: {{xyz: [2, 0, 0]}}, {ROD.replace("LENGTH", "0.3")}}}
  grasp: {{hand: {{holder_frame: tip, held_frame: w_T1}}}}
problem: {{use_compiler: false}}
output: {{write_report: false}}
"""


def test_a_recording_whose_start_is_fitted(carried_out, written, tmp_path):
    """A rod of two links under the ceiling, an eighth of a radian aside; the ends of both are seen."""
    aside = 0.3 * np.array([math.sin(0.125), 0.0, -math.cos(0.125)])
    place = np.stack([aside, 2 * aside]) + 1e-4 * np.random.default_rng(1).standard_normal((len(TIMES), 2, 3))
    camera = PointGroup("points_camera", ["T1_0_tip", "w_T1"], TIMES, place, 1e-3, "camera", camera_pose=np.eye(4))
    write_recording(Recording(None, (camera,)), tmp_path / "aside.h5")
    entries = ("--entry", "del[T1_0_y]", "--entry", "del[T1_0_y], T1.bend")
    done = carried_out("inspect", written(HANGING), *entries)
    result = done.result
    assert all(fact in result["linearisation"]["at"] for fact in ("start", "fitted", "aside"))
    with h5py.File(tmp_path / "run" / "linearisation.h5") as file:
        assert abs(file["state"][1]) == pytest.approx(0.125, abs=0.01)
    # about a motion nothing is said of what is seen, but the recordings tell
    bend = result["dependence"]["T1.bend"]
    assert (bend["seen"], "'Observed'" in done.out) == (None, False)
    assert (bend["along"] > 0, result["dependence"]["T1.mass"]["along"]) == (True, None)
    # the step is taken: its equation holds
    row, slope = result["entries"]
    assert row["value"] == pytest.approx(0.0, abs=1e-10)
    assert abs(slope["value"]) > 1e-4


def test_what_has_no_rest_is_looked_at_where_all_is_zero(printed, written, tmp_path, urdf_folder):
    """A rod whose end is a metre away from the hand that should hold it; there no step can be taken."""
    text = FAR.replace("URDF", str(urdf_folder / "double_pendulum.urdf"))
    told = printed("inspect", written(text), "--out", tmp_path / "run", code=2)
    assert "the step cannot be linearised: its equations are singular" in told
    assert "where: the zero state (no equilibrium was found: " in told

"""The command `report` with two runs of the same recordings: what it compares, and when it refuses to."""

import json
import re

import h5py
import numpy as np
import pytest

from yid_ocp.cli import main
from yid_ocp.report import diagnosis_summaries  # noqa: F401, it registers
from yid_ocp.report.terminal import summary_blocks, summary_terminal_lines
from yid_ocp.workflow.run_history import _overlaid_parameters


@pytest.fixture(scope="module")
def two_runs(pendulum_data, tmp_path_factory):
    """Run folders of two models of the same recordings: the second one keeps one parameter at its initial value."""
    folder = tmp_path_factory.mktemp("overlay")
    (folder / "pendulum.yaml").write_text(pendulum_data.text + "output: {write_report: false}\n")
    [fixed, *_] = pendulum_data.truth
    for name, more in (("free", ()), ("fixed", ("--set", f"parameters.{fixed}.free=false"))):
        assert main(["solve", str(folder / "pendulum.yaml"), "--out", str(folder / name), "--quiet", *more]) in (0, 1)
    return folder / "free", folder / "fixed", fixed


def test_two_runs_of_the_same_recordings_are_overlaid(two_runs, printed, tmp_path):
    first, second, fixed = two_runs
    told = printed("report", first, second, "--out", tmp_path / "both")
    made = json.loads((tmp_path / "both" / "overlay.json").read_text(), parse_constant=pytest.fail)
    assert list(made["runs"]) == ["free", "fixed"]
    own, other = (json.loads((run / "result.json").read_text()) for run in (first, second))
    entry, difference = made["parameters"][fixed], made["model_difference"]
    assert entry["values"]["free"]["value"] == own["parameters"][fixed]["value"]
    moved = other["parameters"][fixed]["value"] - own["parameters"][fixed]["value"]
    assert (entry["difference"], difference) == (pytest.approx(moved), "")
    assert entry["difference_in_std"] == pytest.approx(moved / own["parameters"][fixed]["std"])
    held_out = [e for e in made["channels"] if e["held_out"]]
    assert {e["channel"]: e["rmse"]["free"] for e in held_out} == pytest.approx(
        {c: size for c, size in own["held_out"][0]["rmse"].items() if c in {e["channel"] for e in held_out}}
    )
    for e in made["channels"]:
        with h5py.File(first / "trajectories.h5") as a, h5py.File(second / "trajectories.h5") as b:
            group, _, joint = e["channel"].rpartition(".")
            paths = [file["recordings"][e["recording"]][group] for file in (a, b)]
            at = list(paths[0].attrs["channels"]).index(e["channel"])
            apart = np.array(paths[1]["predicted"])[:, at] - np.array(paths[0]["predicted"])[:, at]
        assert e["difference"] == pytest.approx(np.sqrt(np.nanmean(apart**2))), joint
    assert f"{other['parameters'][fixed]['value']:.4g} (fixed)" in told
    assert f"differ by more than 2 standard deviations in these parameters: {fixed}" in " ".join(told.split())
    page = (tmp_path / "both" / "report.html").read_text(encoding="utf-8")
    names = ["verdict", "scene", "days", "overlay", "numbers"]
    assert [name for name in re.findall(r'<section id="(\w+)">', page) if name != "inputs"] == names
    assert "fixed minus free" in page


def test_runs_that_share_only_some_recordings_are_refused_by_name(two_runs, printed, tmp_path):
    first, *_ = two_runs
    alone = tmp_path / "alone"
    copied = json.loads((first / "result.json").read_text())
    copied["inputs"] = {name: digest for name, digest in copied["inputs"].items() if not name.endswith("held_out.h5")}
    alone.mkdir()
    (alone / "result.json").write_text(json.dumps(copied))
    told = printed("report", first, alone, "--out", tmp_path / "both", code=2)
    assert f"held_out.h5 only in {first}" in told
    assert "the `recordings` of the other" in told
    assert not (tmp_path / "both").exists()


def test_a_value_that_cannot_be_found_has_no_digits_and_no_difference():
    entry = {"value": 3.001, "std": None, "unit": "N m/rad", "free": True, "verdict": "not_identifiable"}
    found = [{"k": entry}, {"k": entry | {"value": 2.5, "std": 0.1, "verdict": "identifiable"}}]
    parameters = _overlaid_parameters(["a", "b"], found)
    assert (parameters["k"]["difference"], parameters["k"]["difference_in_std"]) == (None, None)
    channel = {"recording": "r", "channel": "points.p", "unit": "m", "held_out": True, "rmse": {"a": 1.0, "b": 2.0}}
    result = {"format": "yid-overlay/1", "runs": {"a": "a", "b": "b"}, "parameters": parameters}
    result |= {"channels": [channel | {"difference": 0.5}], "model_difference": "a has no model.object", "poor": ["b"]}
    lines = summary_terminal_lines(summary_blocks(result))
    assert "k          –  2.5 ± 0.1  N m/rad" in lines
    assert "No parameter can be compared" in lines[0]
    assert "The model did not explain the recordings of b." in " ".join(lines)
    assert "The models differ (a has no model.object), so a parameter may differ" in " ".join(lines)

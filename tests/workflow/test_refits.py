"""Kept refits count only for what they were made from."""

from __future__ import annotations

import pytest

from yid_ocp.config.reader import load_config
from yid_ocp.diagnosis import StoredFit
from yid_ocp.workflow.diagnose import JsonRefitStore
from yid_ocp.workflow.run_folder import new_run_folder


@pytest.mark.parametrize("spoil", ["nothing", "inputs", "version", "half a file", "other text"])
def test_kept_refits_count_only_for_what_they_were_made_from(spoil, rubbing, tmp_path, caplog):
    made_from = [{"a.h5": "12"}, "a: 1", {"yid-ocp": "1.0"}]
    refitted = StoredFit({"b": 0.1 + 0.2}, {"b": float("inf")}, {"b": 0.1}, "done")
    with new_run_folder(load_config(rubbing), tmp_path / "run") as folder:
        first = JsonRefitStore(folder, *made_from)
        first.put("joint_coulomb@elbow", refitted)
        if spoil == "inputs":
            made_from[0] = {"a.h5": "34"}
        elif spoil == "version":
            made_from[2] = {"yid-ocp": "1.1"}
        elif spoil == "half a file":
            first.file.write_text(first.file.read_text()[:40])
        elif spoil == "other text":
            first.file.write_text("[1, 2]")
        second = JsonRefitStore(folder, *made_from)
        assert second.get("joint_coulomb@elbow") == (refitted if spoil == "nothing" else None)
        assert second.get("joint_viscous@elbow") is None
        assert len(caplog.records) == (0 if spoil == "nothing" else 1)
        second.delete_file()
    assert [path.name for path in tmp_path.iterdir()] == ["run"]

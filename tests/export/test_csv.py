"""Tables that read back as what was written."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from yid_ocp.data import JointGroup, PointGroup, Recording, read_csv
from yid_ocp.errors import OutputError
from yid_ocp.export.signals import export_csv


@given(
    hnp.arrays(float, (4, 2), elements=st.floats(-50, 50)),
    hnp.arrays(float, (3, 2, 3), elements=st.floats(-50, 50)),
    hnp.arrays(bool, (3, 2)),
)
def test_csv_round_trip(position: np.ndarray, points: np.ndarray, hidden: np.ndarray) -> None:
    points[hidden] = np.nan
    joints = JointGroup(("a", "b_x"), np.array([0.0, 0.1, 0.3, 1e9 / 3]), position, effort=-position)
    camera = PointGroup("points_camera", ("p", "q r"), np.array([-1.0, 0.0, math.pi]), points)
    with tempfile.TemporaryDirectory() as folder:
        files = export_csv(Recording(joints, (camera,)), Path(folder) / "new" / "tables")
        assert [file.name for file in files] == ["joints.csv", "points_camera.csv"]
        back, (points_back,) = read_csv(files[0]).joints, read_csv(files[1]).points
    assert back.names == joints.names
    assert np.array_equal(back.t, joints.t)
    assert np.array_equal(back.position, position)
    assert np.array_equal(back.channels["effort"], -position)
    assert list(back.channels) == ["position", "effort"]
    assert points_back.names == camera.names
    assert np.array_equal(points_back.t, camera.t)
    assert np.array_equal(points_back.position, points, equal_nan=True)


def test_export_to_an_unusable_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    recording = Recording(JointGroup(("a",), np.zeros(1), np.zeros((1, 1))))
    with pytest.raises(OutputError, match="folder cannot be made"):
        export_csv(recording, tmp_path / "file")
    (tmp_path / "joints.csv").mkdir()
    with pytest.raises(OutputError, match="that of a folder"):
        export_csv(recording, tmp_path)

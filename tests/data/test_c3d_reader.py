import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_examples import refused

from yid_ocp.data.readers import preview_file, read_any

LABELS = ("Cable:base", "Cable:tip", "*3", "LKneeAngles", "gone")


def write_c3d(path: Path, labels: tuple[str, ...] = LABELS, unit: str = "mm", frames: int = 6) -> np.ndarray:
    """A file at 200 Hz whose markers go up; frame 2 hides the tip, frame 4 the base. What was written, (N, 2, 3)."""
    ezc3d: Any = pytest.importorskip("ezc3d", reason="C3D needs ezc3d: pip install '.[c3d]'")
    file = ezc3d.c3d()
    point = file["parameters"]["POINT"]
    point["LABELS"]["value"], point["UNITS"]["value"], point["RATE"]["value"] = labels, [unit], [200.0]
    file.add_parameter("POINT", "ANGLES", ["LKneeAngles"])
    values = np.ones((4, len(labels), frames))
    values[:3] = 100.0 * (1 + np.arange(len(labels)))[None, :, None] + np.arange(frames)
    if len(labels) == len(LABELS):
        values[:3, 1, 2] = np.nan
        values[:3, 4] = values[:3, 0, 4] = 0.0
    file["data"]["points"] = values
    file["parameters"]["ANALOG"]["LABELS"]["value"] = ["force"]
    file["parameters"]["ANALOG"]["RATE"]["value"] = [200.0]
    file["data"]["analogs"] = np.zeros((1, 1, frames))
    file.write(str(path))
    values[values == 0] = np.nan
    return np.asarray(values[:3, :2].transpose(2, 1, 0))


def test_markers_of_a_file(tmp_path: Path) -> None:
    written = write_c3d(tmp_path / "run.c3d")
    recording = read_any(tmp_path / "run.c3d", point_frame="lab")
    (points,) = recording.points
    assert (points.names, points.frame, points.clock) == (("base", "tip"), "lab", "nominal")
    assert np.allclose(points.t, np.arange(6) / 200)
    assert np.allclose(points.position, 1e-3 * written, equal_nan=True)
    assert np.argwhere(np.isnan(points.position).all(axis=2)).tolist() == [[2, 1], [4, 0]]
    why = {"*3": "label", "LKneeAngles": "body model", "force": "analog", "gone": "never seen"}
    assert [note.split()[0] for note in sorted(recording.notes)] == list(why)
    assert all(word in note for word, note in zip(why.values(), sorted(recording.notes), strict=True))


def test_markers_are_named_and_chosen_and_keep_subjects_where_names_would_be_the_same(tmp_path: Path) -> None:
    write_c3d(tmp_path / "run.c3d")
    assert read_any(tmp_path / "run.c3d", point_names={"tip": "cable:100%"}).point_names == ("cable:100%",)
    assert refused(tmp_path / "run.c3d", "no point 'tp'", point_names={"tp": "a"}).hint == "did you mean 'tip'?"
    write_c3d(tmp_path / "run.c3d", ("A:tip", "B:tip"), "m", 3)
    refused(tmp_path / "run.c3d", "reaches 202 m")  # 200 m are millimetres whose unit the file says wrongly
    assert read_any(tmp_path / "run.c3d", units={"points": "mm"}).point_names == ("A:tip", "B:tip")


def test_the_preview_lists_markers_and_the_rest(tmp_path: Path) -> None:
    write_c3d(tmp_path / "run.c3d")
    contents = preview_file(tmp_path / "run.c3d")
    assert [source.imported_as for source in contents.sources[:2]] == ["point base", "point tip"]
    assert "83%" in contents.sources[1].note
    assert contents.sources[0].mean_rate == pytest.approx(200.0)
    assert read_any(tmp_path / "run.c3d", **contents.reader_options).point_names == ("base", "tip")


def test_files_that_are_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_c3d(tmp_path / "run.c3d")
    contents = (tmp_path / "run.c3d").read_bytes()
    for name, text in {"text": b"no markers at all" * 100, "short": contents[:600], "empty": b""}.items():
        (tmp_path / f"{name}.c3d").write_bytes(text)
        assert f"{name}.c3d" in refused(tmp_path / f"{name}.c3d", "C3D file").where
    write_c3d(tmp_path / "inch.c3d", unit="inch")
    refused(tmp_path / "inch.c3d", "unit of the markers is 'inch'")
    write_c3d(tmp_path / "none.c3d", ("*1", "LKneeAngles"))
    refused(tmp_path / "none.c3d", "no usable marker: 1 without label, 1 result of a body model")
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    assert refused(tmp_path / "run.c3d", "needs the package ezc3d").hint.startswith("pip install '.[c3d]'")

import math
from pathlib import Path
from pkgutil import iter_modules
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from recording_examples import joints_of, refused, table

from yid_ocp.data import readers
from yid_ocp.data.foreign_formats import column_meanings
from yid_ocp.data.readers import READERS, preview_file, read_any
from yid_ocp.data.readers.base import parse_quantity_units
from yid_ocp.data.recording import JointGroup, Recording, validated_recording
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.errors import DataError


def test_csv_conventional_columns(tmp_path: Path) -> None:
    path = table(
        tmp_path,
        "\ufefft, q_a, position_b, effort_a, effort_b, position_command_a, position_command_b, tip_x, tip_y, tip_z\n"
        "0.0, 0.1, 0.2, 1, 2, 0, 0, 0.5, 0.6, 0.7\n"
        "\n"
        "0.5, 0.3, 0.4, 3, 4, 0, 1, , , \n",
    )
    said = {"point_sensor_name": "camera", "point_frame": "base", "description": "two joints"}
    recording = read_any(path, timestamp_kind="nominal", **said)
    joints = joints_of(recording)
    assert joints.names == ("a", "b")
    assert joints.clock == "nominal"
    assert np.array_equal(joints.position, [[0.1, 0.2], [0.3, 0.4]])
    assert np.array_equal(joints.values_by_channel["effort"], [[1, 2], [3, 4]])
    assert np.array_equal(joints.values_by_channel["position_command"], [[0, 0], [0, 1]])
    (points,) = recording.points
    assert (points.names, points.sensor_name, points.frame, points.clock) == (("tip",), "camera", "base", "nominal")
    assert np.array_equal(points.position, [[[0.5, 0.6, 0.7]]])
    assert np.array_equal(points.t, [0.0])
    assert (recording.name, recording.source, recording.description) == ("run", "run.csv", "two joints")
    assert recording.sha256 is not None


def test_csv_columns_of_sensors_on_links(tmp_path: Path) -> None:
    """They have rows of their own; a column of another name is said to be a component."""
    header = "t,q_a,ft_force_x,ft_force_y,ft_force_z,w1,w2,w3"
    rows = ["0.0,0.1,1,2,3,,,", "0.5,0.2,,,,0.1,0.2,0.3", "1.0,0.3,4,5,6,0.4,0.5,0.6"]
    (tmp_path / "run.csv").write_text("\n".join([header, *rows]))
    columns = {f"w{i + 1}": f"angular_velocity_{axis}:imu_link" for i, axis in enumerate("xyz")}
    imu, wrist = sorted(read_any(tmp_path / "run.csv", column_meanings=columns).channel_groups, key=lambda g: g.name)
    assert (imu.name, imu.names, wrist.name, wrist.names) == ("imu", ("imu_link",), "wrist", ("ft",))
    np.testing.assert_allclose(wrist.t, [0.0, 1.0])
    np.testing.assert_allclose(wrist.values_by_quantity["force"][:, 0], [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(imu.t, [0.5, 1.0])
    np.testing.assert_allclose(imu.values_by_quantity["angular_velocity"][1, 0], [0.4, 0.5, 0.6])
    refused(tmp_path / "run.csv", "no column for force_z of 'ft'", column_meanings={**columns, "ft_force_z": "skip"})


def test_csv_units_are_converted(tmp_path: Path) -> None:
    path = table(tmp_path, "time,q_a,velocity_a,effort_a,p_x,p_y,p_z\n0,180,60,1000,1,2,3\n500,90,0,0,0,0,0\n")
    units = {"t": "ms", "position": "deg", "velocity": "rpm", "effort": "N mm", "points": "mm"}
    recording = read_any(path, units=units)
    joints = joints_of(recording)
    assert np.allclose(joints.t, [0.0, 0.5])
    assert np.allclose(joints.position[:, 0], [math.pi, math.pi / 2])
    assert joints.values_by_channel["velocity"][0, 0] == pytest.approx(2 * math.pi)
    assert joints.values_by_channel["effort"][0, 0] == pytest.approx(1.0)
    assert np.allclose(recording.points[0].position[0, 0], [0.001, 0.002, 0.003])
    refused(path, "reaches 180 rad", units={"t": "ms"})


def test_csv_columns_given_chosen_and_renamed(tmp_path: Path) -> None:
    path = table(tmp_path, "stamp;angle;label;X;Y;Z\n0;0.1;start;1;2;3\n1;0.2;;4;5;6\n")
    columns = {"stamp": "t", "angle": "position:elbow", "label": "skip", "X": "x:tip", "Y": "y:tip", "Z": "z:tip"}
    recording = read_any(path, column_meanings=columns, delimiter=";")
    assert recording.joint_names == ("elbow",)
    assert np.array_equal(recording.points[0].position[:, 0], [[1, 2, 3], [4, 5, 6]])
    path = table(tmp_path, "t,q_a,q_b,x:m1,y:m1,z:m1,m2_x,m2_y,m2_z\n0,1,2,3,3,3,4,4,4\n")
    assert read_any(path, joints=["*=arm_*"]).joint_names == ("arm_a", "arm_b")
    refused(path, "there is no joint 'j[*]'", joints=["j*=arm_*"])
    recording = read_any(path, joints=["b=elbow"], point_names={"m2": "cable:100%"})
    assert (recording.joint_names, recording.point_names) == (("elbow",), ("cable:100%",))
    assert (joints_of(recording).position[0, 0], recording.points[0].position[0, 0, 0]) == (2, 4)


def test_csv_clocks_of_joints_and_points(tmp_path: Path) -> None:
    # the first line tells Excel the delimiter
    recording = read_any(table(tmp_path, "sep=,\nt,q_a,p_x,p_y,p_z\n0,1,,,\n1,2,1,1,1\n2,,2,2,2\n3,3,,,\n"))
    assert np.array_equal(joints_of(recording).t, [0, 1, 3])
    assert np.array_equal(recording.points[0].t, [1, 2])
    # of points alone frames without any stay
    recording = read_any(table(tmp_path, "t,p_x,p_y,p_z\n0,1,1,1\n1,,,\n"))
    assert np.array_equal(recording.points[0].t, [0, 1])
    assert np.isnan(recording.points[0].position[1]).all()
    # joints named after axes are no points
    recording = read_any(table(tmp_path, "t,q_T1_x,q_T1_y,q_T1_z\n0,1,2,3\n1,,,\n"))
    assert (recording.joint_names, recording.points, recording.duration) == (("T1_x", "T1_y", "T1_z"), (), 0)


STAMPS = {
    "2025-03-04T10:20:30": "2025-03-04 10:20:31.5", "2025-03-04T10:20:30Z": "2025-03-04T11:20:31.500000001+01:00",
    "2025-03-04 10:20:30,25": "2025-03-04 04:50:31,750 -0530", "1,5": "3", "-2,5e-1": "1,25",
}  # fmt: skip


@pytest.mark.parametrize("first", STAMPS)
@pytest.mark.parametrize("mark", ["\t", ";"], ids=["tab", "semicolon"])
def test_csv_decimal_commas_and_time_stamps(first: str, mark: str, tmp_path: Path) -> None:
    """With a header and without; seconds are those of the stamps, whatever their zone."""
    rows = [mark.join(("t", "q_a", "q_b")), mark.join((first, "0,5", "-1")), mark.join((STAMPS[first], "1", "2,5e-1"))]
    for path in (table(tmp_path, "\n".join(rows)), table(tmp_path, "\n".join(rows[1:]))):
        contents = preview_file(path)
        known = {"column_meanings": {"1": "t", "2": "position:a", "3": "position:b"}, "has_header": False}
        recording = read_any(path, **(known if "has_header" in contents.reader_options else {}))
        assert np.diff(joints_of(recording).t) == pytest.approx(1.5, abs=1e-6)
        np.testing.assert_array_equal(joints_of(recording).position, [[0.5, -1.0], [1.0, 0.25]])


GOOD = "t,q_a\n0,1\n"
CSV_ERRORS: dict[str, tuple[str, dict[str, Any], str, str]] = {
    "empty": ("", {}, "the table is empty", ""),
    "no header": ("0,1\n1,2\n", {}, "no header row", ""),
    "no rows": ("t,q_a\n", {}, "no rows", ""),
    "other delimiter": ("t;q_a\n0;1\n", {"delimiter": ","}, "one column, 't;q_a'", "--delimiter ';'"),
    "one column": ("t\n0\n", {}, "one column, 't'", ""),
    "long delimiter": (GOOD, {"delimiter": "::"}, "the delimiter is '::'", ""),
    "repeated column": ("t,q_a,q_a\n0,1,1\n", {}, "2 columns are called 'q_a'", ""),
    "same meaning": ("t,q_a,position_a\n0,1,1\n", {}, "'q_a' and 'position_a' have the same meaning, position a", ""),
    "unknown column": ("t,q_a,label\n0,1,2\n", {}, "not known: label", "label=skip"),
    "bare prefix": ("t,q_\n0,1\n", {}, "not known: q_", ""),
    "no time": ("q_a,q_b\n0,1\n", {}, "no column of times", ""),
    "only time": ("t,label\n0,1\n", {"column_meanings": {"label": "skip"}}, "has no measurements", "import more"),
    "column not there": (GOOD, {"column_meanings": {"q_b": "skip"}}, "there is no column 'q_b'", "did you mean 'q_a'"),
    "meaning of a column": (GOOD, {"column_meanings": {"q_a": "x:"}}, "meaning 'x:' of column", "q_a=x:NAME"),
    "meaning of times": (GOOD, {"column_meanings": {"t": "time"}}, "meaning 'time' of column", "'t=t'"),
    "meaning without kind": (GOOD, {"column_meanings": {"q_a": "angle:a"}}, "'angle:a' of", "q_a=position:a'"),
    "short row": ("t,q_a\n0,1\n1\n", {}, "the row has 1 cell,", ""),
    "decimal commas": ("t,q_a\n0,0,1,5\n", {}, "the row has 4 cells", "decimal commas need semicolons"),
    "marks of two rows": ("t;q_a\n0.1;999.5\n0.2;1,234\n", {}, "numbers with commas and numbers with points", ""),
    "both marks": ("t;q_a;q_b\n0;0.1;1,234\n", {}, "numbers with commas and numbers with points", ""),
    "time of day": ("t,q_a\n10:20:30,1\n", {}, "the cell '10:20:30' in column 't' is not a number", ""),
    "no such day": ("t,q_a\n2025-13-04T10:20:30,1\n", {}, "the cell '2025-13-04T10:20:30' in column 't'", ""),
    "text": ("t,q_a\n0,1\n1,fast\n", {}, "the cell 'fast' in column 'q_a'", ""),
    "joint missing": ("t,q_a,q_b,effort_a\n0,1,1,1\n", {}, "no column for effort of 'b'", "add the column"),
    "misspelt": ("t,q_elbwo,q_b,effort_elbow,effort_b\n0,1,1,1,1\n", {}, "for position of 'elbow'", "mean 'elbwo'?"),
    "no position": ("t,effort_a\n0,1\n", {}, "no column for position of 'a'", ""),
    "axis missing": ("t,p_x,p_y\n0,1,1\n", {}, "no column for z of 'p'", ""),
    "empty cell of a joint": ("t,q_a,q_b\n0,1,1\n1,1,\n", {}, "infinite value, the first of joint 'b' at t = 1 s", ""),
    "clock": ("t,q_a\n1,1\n0,1\n", {}, "from sample 1 to 2", ""),
    "unknown unit": ("t,q_a [mrad]\n0,1\n", {}, "not known: q_a .mrad.", ""),
    "force of no link": ("t,force_x,force_y,force_z\n0,1,1,1\n", {}, "not known: force_x", ""),
    "unit of what": (GOOD, {"units": {"angle": "deg"}}, "'angle', which is not the name of a quantity", ""),
    "unit": (GOOD, {"units": {"velocity": "deg"}}, "'deg' is not a unit of 'velocity'", "did you mean 'deg/s'"),
    "unit of a switch": (GOOD, {"units": {"torque_enable": "V"}}, "is not a unit of .torque_enable.", "leave"),
}


@pytest.mark.parametrize("case", CSV_ERRORS)
def test_csv_errors(case: str, tmp_path: Path) -> None:
    text, options, message, hint = CSV_ERRORS[case]
    error = refused(table(tmp_path, text), message.replace("(", r"\("), **options)
    assert "run" in error.where
    assert hint in error.hint


def test_csv_that_is_no_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.csv"
    path.write_bytes(b"t,q_a\n\xff\xfe\x00,1\n")
    absent = tmp_path / "absent.csv"
    for file, message in ((path, "table in UTF-8"), (tmp_path, "is a folder, but must be"), (absent, "no such file")):
        with pytest.raises(DataError, match=message):
            READERS[".csv"](file)
    monkeypatch.setattr("csv.reader", Mock(side_effect=OSError(5, "any words")))
    refused(path, r"cannot be read \(Input/output error\)(.|\n)*try: copy it again")


def test_many_short_lines_are_refused_before_they_fill_the_memory(tmp_path, monkeypatch):
    """A line takes more than its cells, and is counted as 16 of them."""
    file = tmp_path / "a.csv"
    file.write_text("t,q_a\n" + "".join(f"{i},{i}\n" for i in range(9)))
    monkeypatch.setattr("yid_ocp.files.MAX_INPUT_NUMBERS", 10 * (2 + 16))
    for read in (read_any, preview_file):
        read(file)
    with file.open("a") as more:
        more.write("9,9\n")
    for read in (read_any, preview_file):
        refused(file, "the file holds too many numbers", read)


def test_too_many_columns_and_a_line_without_end_are_refused_before_the_work(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text(",".join(["t", *(f"q_{i}" for i in range(20_000))]) + "\n" + ",".join(["0"] * 20_001) + "\n")
    for read in (read_any, preview_file):
        refused(path, "20001 columns", read)
    path.write_text(",".join(["t", *(f"q_{i}" for i in range(4_999))]) + "\n" + ",".join(["0"] * 5_000) + "\n")
    assert len(read_any(path).joint_names) == 4_999
    path.write_text("t,q_a\n" + "0," * 2_000_000)
    refused(path, "more than 1048576 characters")


@pytest.mark.parametrize(
    "content",
    [b"t,q_a\n", b"t\n1\n2\n", b"<!DOCTYPE html>\n<html>\n", b'{"t": [1], "q": 3}', b"PK\x03\x04\xff", b"sep=,\n"],
)
def test_a_preview_of_what_is_no_table_is_refused_as_reading_it_is(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_bytes(content)
    for read in (read_any, preview_file):
        with pytest.raises(DataError):
            read(tmp_path / "run.csv")


# ------------------------------------------------------------------------------- no header, patterns, bad lines


def test_a_table_without_a_header(tmp_path: Path) -> None:
    path, columns = table(tmp_path, "0,0.1,5\n1,0.2,6\n"), {"1": "t", "2": "position:a", "3": "effort:a"}
    joints = joints_of(read_any(path, has_header=False, column_meanings=columns))
    assert np.array_equal(joints.position[:, 0], [0.1, 0.2])
    assert np.array_equal(joints.values_by_channel["effort"][:, 0], [5, 6])
    assert "--no-header --columns t," in refused(path, "no header row", column_meanings=columns).hint


def test_patterns_of_columns(tmp_path: Path) -> None:
    path = table(tmp_path, "stamp,a_pos,b_pos,a_tau,b_tau,b_ref\n0,1,2,3,4,5\n1,6,7,8,9,10\n")
    columns = {"stamp": "t", "*_pos": "position:*", "*_tau": "effort:*", "b_*": "skip", "b_pos": "position:elbow"}
    refused(path, "no column for effort of 'elbow'", column_meanings=columns)
    joints = joints_of(read_any(path, column_meanings={**columns, "b_tau": "effort:elbow"}))
    assert joints.names == ("a", "elbow")
    assert np.array_equal(joints.values_by_channel["effort"], [[3, 4], [8, 9]])


def test_bad_lines_are_refused_or_skipped_and_counted(tmp_path: Path) -> None:
    path = table(tmp_path, "t,q_a\n0,1\n1,fast\n2,3\n3,4,5\n4\n5,6\n6,7\n7,8\n")
    assert refused(path, "'fast'").where.endswith("line 3")
    recording = read_any(path, skip_bad_lines=True)
    assert np.array_equal(joints_of(recording).t, [0, 2, 5, 6, 7])
    [note] = recording.notes
    assert all(fact in note for fact in ("left out", "3 of 8 lines", "In line 3")), note
    mostly = table(tmp_path, "t,q_a\n0,1\n1,fast\n2,slow\n")
    refused(mostly, r"2 of 3 lines are not rows of 2 numbers. .*, the cell 'fast' in", skip_bad_lines=True)


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ("t;q_a;label;tip_x;tip_y;tip_z\n" + "".join(f"{k};{k};x;1;2;3\n" for k in range(4)), {"label": "skip"}),
        ("t,bend\n" + "".join(f"{k},{k}\n" for k in range(4)), {"bend": "skip"}),
        ("".join(f"{k},1,2\n" for k in range(4)), {"1": "t", "2": "skip", "3": "skip"}),
    ],
    ids=["text among it", "unknown name", "no header"],
)
def test_the_preview_of_a_table(text: str, columns: dict[str, str], tmp_path: Path) -> None:
    contents = preview_file(table(tmp_path, text))
    assert contents.reader_options["column_meanings"] == columns
    assert ("has_header" in contents.reader_options) == text.startswith("0")


def test_the_rates_of_a_preview_are_those_of_the_import(tmp_path: Path) -> None:
    rows = "".join(f"{5 * k},0.1,{',,' if k % 3 else '1,1,1'}\n" for k in range(31))
    contents = preview_file(table(tmp_path, f"t_ms,q_a,x,y,z\n{rows}"))
    assert [source.mean_rate for source in contents.sources] == pytest.approx([200, 200, *[200 / 3] * 3])
    assert {source.kind for source in contents.sources} == {"numbers"}


@pytest.mark.parametrize(("wrong", "units"), [(2, None), (3, {"position": "deg"})])
def test_few_wrong_angles_are_not_taken_for_degrees(tmp_path: Path, wrong: int, units: dict[str, str] | None) -> None:
    rows = "".join(f"{0.01 * k},{9.0 if k < wrong else 0.1}\n" for k in range(200))
    assert preview_file(table(tmp_path, f"t,q_a\n{rows}")).reader_options.get("units") == units


def test_the_preview_counts_bad_lines_and_guesses_units(tmp_path: Path) -> None:
    rows = "".join(f"{10 * k},{90 + k},500,500,500\n" for k in range(8))
    path = table(tmp_path, "t,q_a,tip_x,tip_y,tip_z\n" + rows + "80,broken,1,1,1\n")
    contents = preview_file(path)
    assert contents.reader_options["units"] == {"position": "deg", "points": "mm", "t": "ms"}
    assert contents.reader_options["skip_bad_lines"] is True
    assert contents.notes[0].startswith("1 of 9 lines ")
    joints = joints_of(read_any(path, **contents.reader_options))
    assert joints.t[1] == pytest.approx(0.01)
    assert joints.position[0, 0] == pytest.approx(math.pi / 2)


def test_telemetry_of_isaac_sims_identification(tmp_path: Path) -> None:
    """`Time`, q1 ... dq1 ... cmd1 ... after comments; a table of two joints, here with their names in the URDF."""
    path = tmp_path / "telemetry.csv"
    path.write_text(
        "# excited at 50 Hz\nTime, q1, q2, dq1, dq2, cmd1, cmd2\n0.0, 0.1, 0.2, 1, 2, 0.3, 0.4\n"
        "# a pause\n0.02, 0.5, 0.6, 3, 4, 0.7, 0.8\n",
        encoding="utf-8",
    )
    joints = joints_of(read_any(path, joints=["1=shoulder", "2=elbow"]))
    assert joints.names == ("shoulder", "elbow")
    np.testing.assert_array_equal(joints.t, [0.0, 0.02])
    values = {"position": [[0.1, 0.2], [0.5, 0.6]], "velocity": [[1, 2], [3, 4]]}
    np.testing.assert_equal(joints.values_by_channel, {**values, "position_command": [[0.3, 0.4], [0.7, 0.8]]})
    contents = preview_file(path)
    assert "column_meanings" not in contents.reader_options
    assert [source.imported_as for source in contents.sources][:4] == ["t", "position:1", "position:2", "velocity:1"]
    # a name that says nothing is not guessed
    path.write_text("t,j0\n0,1\n1,2\n", encoding="utf-8")
    refused(path, "meaning is not known: j0")
    path.write_text("t,a_current,b_current\n0,1,1\n1,2,2\n", encoding="utf-8")
    assert "--columns '*_current=effort:*' --units effort=A" in refused(path, "meaning is not known").hint


@pytest.mark.parametrize(
    ("header", "meanings"),
    [
        ("timestamp,pos_a,vel_a,tau_a", "t position:a velocity:a effort:a"),
        ("Time [ms],q1_deg,dq1,tau_1", "t position:1 velocity:1 effort:1"),
        ("time_s,a.pos,a.vel,a_effort", "t position:a velocity:a effort:a"),
        ("time (s),Q0,QD0,torque0", "t position:0 velocity:0 effort:0"),
        ("__time,/joint_states/a/position,/joint_states/a/velocity,/joint_states/a/effort",
         "t position:a velocity:a effort:a"),
        ("%time,field.position0,field.velocity0,field.effort0", "t position:0 velocity:0 effort:0"),
        ("time,q[0],dq[0],tau_J[0],elbow_joint.velocity", "t position:0 velocity:0 effort:0 velocity:elbow_joint"),
        ("t,q_j1,tau_j1,q_d_1,q1_cmd", "t position:j1 effort:j1 position_command:1 position_command:1"),
        ("timestamp,actual_q_0,actual_qd_0,target_q_0", "t position:0 velocity:0 position_command:0"),
        ("time [µs],q_a [°],/ft/wrench/torque/x", "t position:a None"),
        ("Time (s),Rail Position (m),Rail Force (N),Tip Force (N)", "t position:Rail effort:Rail None"),
        ("t,lift.q_mm,lift.qd_mm_s,lift.F_N", "t position:lift velocity:lift effort:lift"),
        ("t,tip X,tip Y,tip Z", "t x:tip y:tip z:tip"),
        ("t,tip_x [mm],tip_y [mm],tip_z [mm]", "t x:tip y:tip z:tip"),
        ("time [ms],yaw_deg,lift_rad,heat_s", "t position:yaw position:lift None"),
        ("t,x,y,z", "t x:marker y:marker z:marker"),
        ("frame,tip_qw,j0", "None None None"),
    ],
)  # fmt: skip
def test_columns_are_understood_as_loggers_and_mocap_call_them(header: str, meanings: str) -> None:
    found, _ = column_meanings(header.split(","), ["force_x"])
    assert " ".join(":".join(filter(None, m)) if m else "None" for m in found) == meanings


def test_units_in_a_header_convert_and_a_flag_goes_before_them(tmp_path: Path) -> None:
    path = table(tmp_path, "Time [ms],q1_deg,tip_x [mm],tip_y [mm],tip_z [mm]\n0,90,100,200,300\n10,45,100,200,300\n")
    recording = read_any(path)
    assert joints_of(recording).t == pytest.approx([0, 0.01])
    assert joints_of(recording).position[:, 0] == pytest.approx(np.radians([90, 45]))
    assert recording.points[0].position[0, 0] == pytest.approx([0.1, 0.2, 0.3])
    assert read_any(path, units={"points": "cm"}).points[0].position[0, 0] == pytest.approx([1, 2, 3])
    # a linear axis beside a joint, and a unit in a name that only `--columns` explains
    header = "t,lift_position [mm],a_position [deg],lift_velocity [mm/s],a_velocity [deg/s],elbow angle [deg]"
    path = table(tmp_path, f"{header}\n0,250,90,100,180,45\n1,250,90,100,180,45\n")
    joints = joints_of(read_any(path, column_meanings={"elbow angle [deg]": "skip"}))
    both = np.stack([joints.position[0], joints.values_by_channel["velocity"][0]])
    np.testing.assert_allclose(both, [[0.25, np.pi / 2], [0.1, np.pi]])
    path = table(tmp_path, "t,elbow angle [deg]\n0,90\n1,45\n")
    joints = joints_of(read_any(path, column_meanings={"elbow angle [deg]": "position:elbow"}))
    assert joints.position[:, 0] == pytest.approx(np.radians([90, 45]))
    # a motor's current is no external effort
    assert parse_quantity_units(["A", "ms", "points=CM"]) == {"effort": "A", "t": "ms", "points": "cm"}
    with pytest.raises(DataError, match="allowed: s, ms, us, ns, m, cm, mm, rad, deg, rev, rad/s"):
        parse_quantity_units(["degree"])
    # units in a row of their own, numbers of the rows, and a row that a spreadsheet left
    path = table(tmp_path, ",Time,q1,p_x,p_y,p_z\n,(ms),°,mm,mm,mm\n0,0,90,100,200,300\n1,10,45,100,200,300\n,,,,,\n")
    assert preview_file(path).reader_options == {}
    assert read_any(path).points[0].position[1, 0] == pytest.approx([0.1, 0.2, 0.3])
    assert joints_of(read_any(path)).position[:, 0] == pytest.approx(np.radians([90, 45]))
    # a slide in millimetres, and torques of a wrist sensor
    header = ",".join(["t", "q_slide [mm]", *(f"ft_torque_{axis} [Nm]" for axis in "xyz")])
    path = table(tmp_path, f"{header}\n0,90,1,2,3\n1,91,1,2,3\n")
    assert joints_of(read_any(path)).position[0, 0] == pytest.approx(0.09)
    # a counter of rows, a rail and a hinge
    path = table(tmp_path, "Frame,t,rail q [m],pan q [rad],rail tau [N],pan tau [Nm]\n0,0,1,1,5,2\n1,1,2,1,5,2\n")
    np.testing.assert_array_equal(joints_of(read_any(path)).effort, [[5, 2], [5, 2]])


RIGID = "Rotation,Rotation,Rotation,Rotation,Position,Position,Position,Mean Marker Error"
EXPORTS = {
    "motive.csv": (
        "Format Version,1.23,Take Name,rod,Length Units,Meters,Coordinate Space,Global\n\n,Type,"
        + ",".join(["Rigid Body"] * 8 + ["Marker"] * 3)
        + "\n,Name,"
        + ",".join(["base"] * 8 + ["tip"] * 3)
        + f"\n,ID,1\n,,{RIGID},Position,Position,Position\nFrame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X,Y,Z\n"
        "0,0.00,0,0,0,1,1,2,3,0,0.1,0.2,0.3\n1,0.01,0,0,0,1,1,2,3,0,,,\n",
        "OptiTrack",
        ("base", "tip"),
    ),
    "vicon.csv": (
        "Trajectories\n100\n,,rod:base,,,rod:tip,,\nFrame,Sub Frame,X,Y,Z,X,Y,Z\n,,mm,mm,mm,mm,mm,mm\n"
        "1,0,1000,2000,3000,100,200,300\n2,0,1000,2000,3000,,,\n",
        "Vicon",
        ("base", "tip"),
    ),
    "qtm.tsv": (
        "NO_OF_FRAMES\t2\nNO_OF_MARKERS\t2\nFREQUENCY\t100\nDATA_INCLUDED\t3D\nMARKER_NAMES\tbase\ttip\n"
        "1000\t2000\t3000\t100\t200\t300\n1000\t2000\t3000\t0.000\t0.000\t0.000\n",
        "Qualisys",
        ("base", "tip"),
    ),
}


@pytest.mark.parametrize("name", EXPORTS)
def test_exports_of_motion_capture_are_read_in_their_unit_and_unseen_markers_are_nan(name: str, tmp_path: Path) -> None:
    text, program, names = EXPORTS[name]
    (tmp_path / name).write_text(text)
    [group] = read_any(tmp_path / name).points
    assert (group.names, group.sensor_name) == (names, program)
    assert group.t == pytest.approx([0, 0.01])
    np.testing.assert_allclose(group.position[0], [[1, 2, 3], [0.1, 0.2, 0.3]])
    np.testing.assert_array_equal(np.isnan(group.position[1]).all(axis=1), [False, True])
    assert read_any(tmp_path / name, point_names={"tip": "w_rod"}).points[0].names == ("w_rod",)
    assert [source.name for source in preview_file(tmp_path / name).sources] == list(names)
    without_rate = text.replace("\n100\n", "\n0\n").replace("Y\t100", "Y\t0").replace(",Time (Seconds),X,Y,Z,W,X,Y", "")
    lacks, lost = "the motion capture export lacks", text.replace("300", "lost").replace("0.3", "lost")
    for broken, said in ((without_rate, lacks), (text.splitlines()[0] + "\n", lacks), (lost, "lost.*is not a number")):
        (tmp_path / name).write_text(broken)
        refused(tmp_path / name, said)


# ------------------------------------------------------------------------------------------------------- any format


def test_read_any_chooses_by_suffix(tmp_path: Path) -> None:
    recording = read_any(table(tmp_path, "t,q_a\n0,1\n", "RUN.CSV"), units={"position": "deg"})
    assert joints_of(recording).position[0, 0] == pytest.approx(math.pi / 180)
    write_recording(recording, tmp_path / "run.h5")
    assert joints_of(read_any(tmp_path / "run.h5", allow_nan_effort=True)).names == ("a",)


def test_read_any_refuses_what_it_does_not_know(tmp_path: Path) -> None:
    error = refused(table(tmp_path, "", "run.mat"), r"no reader for '\.mat'")
    assert ("export CSV" in error.hint, ".mcap" in error.allowed) == (True, True)
    assert refused(table(tmp_path, "t,q_a\n0,1\n"), "no option 'unit'", unit={}).hint == "did you mean 'units'?"


def test_every_file_of_the_folder_registers_a_format() -> None:
    files = {entry.name for entry in iter_modules(readers.__path__)} - {"base"}
    assert files == {READERS[name].__module__.rpartition(".")[2] for name in READERS} - {"recording_hdf5"}


def test_a_new_reader_is_one_registration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(READERS, "data", dict(READERS.data))

    @READERS.register(".one")
    def read_one(path: Path, *, value: float = 1.0) -> Recording:
        return validated_recording(Recording(JointGroup(("a",), np.zeros(1), np.full((1, 1), value)), name=path.stem))

    assert joints_of(read_any(tmp_path / "run.one", value=2.0)).position[0, 0] == 2.0

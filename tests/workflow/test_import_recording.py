"""The command `import`."""

import json
import math
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from yid_ocp.cli import build_argument_parser
from yid_ocp.data import read_recording
from yid_ocp.files import file_sha256

ROWS = "".join(f"{10 * k},{k},{2 * k},{100 + k},200,300\n" for k in range(20))
ODD = "stamp,j1,j2,mx,my,mz\n" + ROWS
FLAGS = [
    "--columns", "stamp=t,j1=position:shoulder,j2=position:elbow", "--columns", "mx=x:tip,my=y:tip,mz=z:tip",
    "--units", "deg,mm,ms", "--points", "tip=cable:100%",
]  # fmt: skip


@pytest.fixture
def odd(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.csv").write_text(ODD)
    return tmp_path


def check_odd(file: Path, source: Path):
    recording = read_recording(file)
    assert recording.joints.names == ("shoulder", "elbow")
    assert np.allclose(recording.joints.t, 0.01 * np.arange(20))
    assert np.allclose(recording.joints.position[:, 1], np.radians(2 * np.arange(20)))
    assert recording.point_names == ("cable:100%",)
    assert np.allclose(recording.points[0].position[0, 0], [0.1, 0.2, 0.3])
    assert file_sha256(source) in recording.source


def test_flags_say_what_columns_and_units_mean(odd, printed):
    printed("import", "run.csv", "--out", "run.h5", *FLAGS)
    check_odd(odd / "run.h5", odd / "run.csv")


def test_a_section_of_a_configuration_does_the_same_and_flags_go_before_it(odd, printed):
    columns = '{stamp: t, j1: "position:shoulder", j2: "position:elbow", mx: "x:tip", my: "y:tip", mz: "z:tip"}'
    more = '  units: {t: ms, position: deg, points: mm}\n  point_names: {tip: "cable:100%"}\n'
    (odd / "run.yaml").write_text(f"import:\n  column_meanings: {columns}\n{more}")
    printed("import", "run.csv", "--out", "run.h5", "--config", "run.yaml")
    check_odd(odd / "run.h5", odd / "run.csv")
    printed("import", "run.csv", "--out", "run.h5", "--config", "run.yaml", "--points", "tip=other")
    assert read_recording(odd / "run.h5").point_names == ("other",)


def test_what_the_preview_proposes_imports_the_file(odd, printed):
    (odd / "plain.csv").write_text("t;q_a;tip_x;tip_y;tip_z\n" + "".join(f"{k};90;900;0;0\n" for k in range(9)))
    told = json.loads(printed("import", "plain.csv", "--preview", "--json"))
    assert (told["format"], told["recording"]) == ("yid-import/1", None)
    assert {source["name"] for source in told["sources"]} >= {"t"}
    *_, said = printed("import", "plain.csv", "--preview").strip().splitlines()
    assert not (odd / "plain.h5").exists()
    assert said.split()[0] == "yid-ocp"
    printed(*shlex.split(said)[1:])
    recording = read_recording(odd / "plain.h5")
    assert recording.joints.position[0, 0] == pytest.approx(math.pi / 2)
    assert recording.points[0].position[0, 0, 0] == pytest.approx(0.9)
    # a recording of our own is shown, too
    told = printed("import", "plain.h5", "--preview")
    assert ("note: the file is already a recording" in told, "to import it" in told) == (True, False)


def test_left_out_lines_are_told(odd, printed):
    (odd / "bad.csv").write_text("t,q_a\n0,0\n1,x\n2,0\n")
    told = printed("import", "bad.csv", "--out", "bad.h5", "--skip-bad-lines")
    assert "1 of 3 lines are left out, because they are not rows of numbers. In line 3, the cell 'x'" in told


BOTH = ("joints.csv", "mocap.csv")
GOOD = "t,q_a,tip_x,tip_y,tip_z\n0,0.1,1,1,1\n1,0.2,1,1,1\n"
BAD: dict[str, tuple[str, str | None, str, str]] = {
    # file, its text (None: there is no such file), flags, what is said
    "no such file": ("run.csv", None, "", "no such file"),
    "no name to write to": ("run.csv", GOOD, "--out", "the option --out is missing"),
    "the name of the file that is read": ("run.csv", GOOD, "--out run.csv", "'run.csv' does not end in .h5"),
    "more meanings than columns": ("run.csv", "0,1\n", "--no-header --columns t,position:a,skip", "no column '3'"),
    "bad lines alone": ("run.csv", "t,q_a\n0,x\n", "--skip-bad-lines", "no rows"),
    "an unknown unit": ("run.csv", GOOD, "--units furlong", "the unit 'furlong' is unknown"),
    "a joint that is not there": ("run.csv", GOOD, "--joints b", "no joint 'b'"),
    "text in place of a pair": ("run.csv", GOOD, "--points tip=", "'tip=' is not NAME=VALUE"),
    "text in place of a number": ("run.csv", GOOD, "--gear-ratios a=fast", "'fast' is not a number"),
    "a constant without a current": ("run.csv", "t,q_a,effort_a\n0,0,1\n", "--torque-constants a=1", "unit of current"),
    "a constant without efforts": ("run.csv", GOOD, "--torque-constants a=1", "the file has no efforts"),
    "an option of another format": ("run.csv", GOOD, "--joint-topic /j", "--joint-topic does not apply"),
    "a long delimiter": ("run.csv", GOOD, "--delimiter tab", "the delimiter is 'tab'"),
    "a section that is none": ("run.csv", GOOD, "--config wrong.yaml", "there is no key 'colums'"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_bad_import_says_what_is_wrong_and_writes_nothing(case, tmp_path, monkeypatch, printed):
    name, text, flags, said = BAD[case]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "wrong.yaml").write_text("import: {colums: {q_a: skip}}\n")
    if text is not None:
        (tmp_path / name).write_text(text)
    before = sorted(entry.name for entry in tmp_path.iterdir())
    told = printed("import", name, *([] if flags == "--out" else ["--out", "made.h5", *flags.split()]), code=2)
    first, *more = (line for line in told.strip().splitlines() if not line.startswith("reading "))
    assert first.startswith("error: ")
    assert said in first
    assert any(line.startswith(("  where: ", "  allowed: ", "  try: ")) for line in more)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == before


def test_joints_and_motion_capture_become_one_recording_by_the_command_of_the_preview(odd, printed):
    t = np.arange(0, 2, 0.01)
    rows = "".join(f"{x:.3f},{math.sin(3 * x):.6f},{3 * math.cos(3 * x):.6f},{k % 3}\n" for k, x in enumerate(t))
    (odd / "joints.csv").write_text("timestamp,pos_a,vel_a,tau_a [Nm]\n" + rows)
    turned = np.column_stack([t, 500 * np.cos(np.sin(3 * t)), 500 * np.sin(np.sin(3 * t))])
    turned[7, 1:] = 0.0  # a lost marker
    rows = "".join(f"{x:.3f},{y:.3f},{z:.3f},0\n" for x, y, z in turned)
    (odd / "mocap.csv").write_text("time,tip X,tip Y,tip Z\n" + rows)
    *_, said = printed("import", *BOTH, "--preview").strip().splitlines()
    twice = printed("import", "joints.csv", "joints.csv", "--preview")
    assert "the files are not parts of one recording: " in twice
    printed("import", *BOTH, "--out", "no.h5", "--columns", "Zeit=t", code=2)
    told = printed(*shlex.split(said)[1:])
    assert "position [rad], velocity [rad/s], effort [N m]" in told
    assert "have one clock" in told
    recording = read_recording(odd / "joints_merged.h5")
    assert recording.joints.names == ("a",)
    assert recording.points[0].position[0, 0] == pytest.approx([0.5, 0, 0])
    assert np.flatnonzero(np.isnan(recording.points[0].position[:, 0, 0])).tolist() == [7]
    assert "not measured: 1 position of tip that the file states as 0, 0, 0" in told
    assert all(file_sha256(odd / name) in recording.source for name in BOTH)
    words = ["--units", "mm", "--points", "tip=w_rod", "--joints", "a=elbow", "--columns", "tau_a [Nm]=skip"]
    printed("import", *BOTH, "--out", "both.h5", *words, "--clock-offset", "mocap=0.5")
    recording = read_recording(odd / "both.h5")
    assert (recording.joints.names, recording.joints.effort) == (("elbow",), None)
    assert (recording.point_names, recording.points[0].t[0]) == (("w_rod",), 0.5)
    for flags, what in (
        (["--columns", "x=skip"], "no file has a column 'x'"),
        (["--episode", "1"], "--episode does not apply to files of these formats"),
    ):
        assert what in printed("import", *BOTH, "--out", "no.h5", "--units", "mm", *flags, code=2)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("t,q_a\n0,0\n1,0.5\n", "joints has only 2 samples (at least 4 are needed)"),
        ("t,q_a\n" + "".join(f"{10 * k},{0.1 * k % 1}\n" for k in range(99)), "--units t=ms"),
        ("t,q_a\n" + "".join(f"{0.01 * k},0.2\n" for k in range(99)), "turn by at most 0 rad (at least 0.01 rad"),
        ("t,q_a\n" + "".join(f"{0.01 * k},{k % 45}\n" for k in range(99)), "--units position=deg"),
    ],
    ids=["two samples", "milliseconds", "no motion", "degrees"],
)
def test_doubts_are_said_at_import(text, said, odd, printed):
    (odd / "run.csv").write_text(text)
    printed("import", "run.csv", "--out", "run.h5")
    told = printed("import", "run.csv", "--out", "run.h5")
    assert said in told
    is_usable = "next: yid-ocp init" in told
    assert (is_usable, told.startswith("warning" if is_usable else "issue")) == ("turn by" in said, True)


def test_sources_that_differ_in_a_number_are_one_row(odd, printed):
    """In the tables of `import`, and points in what `init` prints and writes; JSON lists all."""
    names = [f"q_joint{i}" for i in range(1, 8)] + [f"tau_joint{i}" for i in range(1, 8)]
    names += [f"m{i}_{axis}" for i in (1, 2, 3, 5) for axis in "xyz"] + [f"tip_{axis}" for axis in "xyz"]
    rows = [",".join(["0.01" if k else "0", *(f"{math.sin(0.1 * k + i):.4f}" for i in range(29))]) for k in range(2)]
    (odd / "run.csv").write_text("\n".join([",".join(["t", *names]), *rows]))
    told = [re.split(r"\s{2,}", line) for line in printed("import", "run.csv", "--preview").splitlines()]
    shown = [
        *(f"{of}_joint1 to {of}_joint7" for of in ("q", "tau")),
        *(f"m{i}_{axis}" for i in (1, 2, 3, 5) for axis in "xyz"),
    ]
    assert [words[0] for words in told[3:17]] == shown
    assert told[3][-1] == "position:joint1 to position:joint7"
    sources = json.loads(printed("import", "run.csv", "--preview", "--json"))["sources"]
    assert [source["name"] for source in sources] == ["t", *names]
    assert "m1 to m3, m5, tip" in printed("import", "run.csv", "--out", "run.h5")
    told = printed("init", "package:xarm7", "run.h5", "--out", "run.yaml")
    assert "joint1 to joint7\n" in told
    for text in (told, (odd / "run.yaml").read_text()):
        assert "`init` leaves out recorded m1 to m3, m5, tip, because" in text


def test_no_command_is_suggested_that_would_fail(odd, printed):
    (odd / "run.csv").write_text("t,bend,c\n0,1,1\n1,2,1\n")
    told = printed("import", "run.csv", "--preview")
    parts = "the import needs more information", "--columns COLUMN=position:JOINT", "yid-ocp import"
    assert [part in told for part in parts] == [True, True, False]


def test_every_flag_is_a_key_of_the_section():
    from yid_ocp.config.settings import ImportSettings
    from yid_ocp.options import class_options_by_key

    given = vars(build_argument_parser().parse_args(["import", "x"]))
    others = {"command", "run", "files", "out", "preview", "config", "quiet", "verbose", "json"}
    assert set(given) - others == set(class_options_by_key(ImportSettings))

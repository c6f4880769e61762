"""Files that appear whole or not at all, and hashes of files, data and sources."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest

from yid_ocp.config.reader import load_config
from yid_ocp.data.readers import preview_file, read_any
from yid_ocp.errors import ConfigError, DataError, ModelError, OutputError
from yid_ocp.files import (
    atomic_write,
    file_sha256,
    is_file,
    json_sha256,
    read_input_json,
    to_json_types,
    write_json,
)
from yid_ocp.model.urdf import read_urdf
from yid_ocp.version import package_source_hash, software_fingerprint, software_fingerprint_differences, source_hash


def test_an_interruption_leaves_nothing(tmp_path):
    def interrupted():
        with atomic_write(tmp_path / "run.h5") as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not list(tmp_path.iterdir())


def test_a_file_is_replaced_as_a_whole(tmp_path):
    file = tmp_path / "a.json"
    write_json(file, {"a": 1})
    write_json(file, {"a": [2, None]})
    assert json.loads(file.read_text()) == {"a": [2, None]}
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_what_json_cannot_hold_leaves_the_old_file(tmp_path):
    file = tmp_path / "a.json"
    write_json(file, {"a": 1})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(file, {"a": float("nan")})
    assert json.loads(file.read_text()) == {"a": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_a_disk_that_refuses_is_the_users_business(tmp_path, monkeypatch):
    def full(source, target):
        raise OSError(28, "any words")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OutputError, match=os.strerror(28)):
        write_json(tmp_path / "a.json", 1)
    assert not list(tmp_path.iterdir())


def test_a_place_that_cannot_hold_a_file(tmp_path):
    with pytest.raises(OutputError, match="that of a folder"):
        write_json(tmp_path, 1)
    with pytest.raises(OutputError, match="does not exist"):
        write_json(tmp_path / "no" / "a.json", 1)


def test_the_hash_of_a_folder_is_that_of_its_files(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a").write_text("1")
    (tmp_path / "in" / "b").write_text("2")
    before = file_sha256(tmp_path / "in")
    assert before == file_sha256(tmp_path / "in")
    (tmp_path / "in" / "b").write_text("3")
    assert file_sha256(tmp_path / "in") != before
    with pytest.raises(DataError, match="no such file"):
        file_sha256(tmp_path / "absent")


def test_the_hash_of_data_is_that_of_its_content():
    assert json_sha256({"a": 1, "b": [1, 2]}) == json_sha256({"b": [1, 2], "a": 1})
    assert json_sha256({"a": [1, 2]}) != json_sha256({"a": [2, 1]})
    assert json_sha256({"a": 1}) != json_sha256({"a": "1"})


def test_numbers_that_json_lacks_become_null_and_a_note():
    notes: list[str] = []
    data = {"a": np.array([1.0, np.nan]), "b": {"c": np.float64(np.inf)}, "d": (np.int64(3), Path("x"))}
    assert to_json_types(data, notes) == {"a": [1.0, None], "b": {"c": None}, "d": [3, "x"]}
    assert notes == ["a[1] is not known", "b.c is infinite"]


@pytest.mark.parametrize("name", ["é" * 300 + ".ply", "a\0b", "nothing", ".."])
def test_any_name_may_be_asked_for(tmp_path, name):
    assert not is_file(tmp_path / name)
    (tmp_path / "something").touch()
    assert is_file(tmp_path / "something")


def test_the_hash_of_sources_follows_their_names_and_content(tmp_path):
    (tmp_path / "inner").mkdir()
    (tmp_path / "a.py").write_text("a = 1\n")
    (tmp_path / "inner" / "kernel.c").write_text("int a;\n")
    first = source_hash(tmp_path)
    (tmp_path / "a.pyc").write_text("compiled")
    assert source_hash(tmp_path) == first
    (tmp_path / "inner" / "kernel.c").write_text("int b;\n")
    assert source_hash(tmp_path) != first
    (tmp_path / "inner" / "kernel.c").write_text("int a;\n")
    assert source_hash(tmp_path) == first
    (tmp_path / "a.py").rename(tmp_path / "b.py")
    assert source_hash(tmp_path) != first


def test_where_two_processes_differ_is_said():
    here = software_fingerprint()
    assert here["code"] == package_source_hash()
    assert software_fingerprint_differences(here, software_fingerprint()) == []
    assert software_fingerprint_differences(here, {**here, "casadi": "1.0"}) == [
        f"casadi 1.0 instead of {here['casadi']}"
    ]
    assert software_fingerprint_differences(here, {**here, "code": "f" * 64}) == [
        f"code {'f' * 12} instead of {here['code'][:12]}"
    ]
    del here["numpy"]
    assert software_fingerprint_differences({**here, "numpy": "2"}, here) == ["numpy unknown instead of 2"]


# -- files from outside -----------------------------------------------------------------------------------------------

OPENERS = re.compile(
    r"\.read_text\(|\.read_bytes\(|(?<![\w.])open\(|\.open\(|np\.load|h5py\.File\(|read_table|ParquetFile|ElementTree\.parse|"
    r"YAML\(|json\.load\(|ezc3d\.c3d\(|AnyReader\(|o3d\.io\.read|URDF\.load|trimesh\.load|pin\.build\w*Model\("
)
"""What opens a file in one of the libraries that the package uses."""
OWN = {
    "files.py": "the door, and temporary files of writers",
    "version.py": "the package's own sources",
    "cli.py": "where standard output leads",
    "config/settings.py": "writes YAML",
    "analysis/compare.py": "/proc, and a table that comes with the package",
    "integrator/codegen.py": "sources in C that come with the package",
    "integrator/compiler.py": "/proc",
    "solvers/nonlinear_program.py": "what IPOPT said in a temporary file",
    "report/html.py": "a script that is compared with its original",
    "report/sections/results.py": "pictures that the run drew",
    "export/signals.py": "writes",
    "workflow/run_folder.py": "writes",
}
"""Files of the package that open what did not come from outside."""


def test_every_file_from_outside_comes_through_the_door(repository):
    package = repository / "yid_ocp"
    openers = {}
    for file in package.rglob("*.py"):
        text = file.read_text(encoding="utf-8")
        if OPENERS.search(text):
            openers[str(file.relative_to(package))] = text
    assert set(OWN) <= set(openers), "a file that opens nothing needs no mention"
    without = {name for name, text in openers.items() if name not in OWN and not re.search(r"check_\w+\(|_yaml", text)}
    assert not without
    for name in set(openers) - set(OWN):
        assert re.search(r"check_input_file|check_readable_in_fork|read_input_text", openers[name]), name


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names")
@pytest.mark.parametrize("name", ["a.csv", "a.h5", "a.c3d", "a.mcap", "a.bag", "a.db3"])
@pytest.mark.parametrize("kind", ["pipe", "endless"])
def test_a_recording_that_is_no_regular_file_is_refused_at_once(tmp_path, name, kind):
    path = tmp_path / name
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    with pytest.raises(DataError, match="a pipe or a device"):
        read_any(path)
    with pytest.raises(DataError, match="a pipe or a device"):
        preview_file(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names")
def test_a_configuration_or_robot_that_is_no_regular_file_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "a.yaml")
    with pytest.raises(ConfigError, match="a pipe or a device"):
        load_config(tmp_path / "a.yaml")
    (tmp_path / "a.urdf").symlink_to("/dev/zero")
    with pytest.raises(ModelError):
        read_urdf(tmp_path / "a.urdf")


@pytest.mark.parametrize("text", [b"\xff", b"{", b"[" * 100_000])
def test_json_that_is_none_is_refused(tmp_path, text):
    (tmp_path / "a.json").write_bytes(text)
    with pytest.raises(DataError):
        read_input_json(tmp_path / "a.json")


def test_a_text_that_is_too_long_is_refused_before_it_is_read(tmp_path):
    with (tmp_path / "a.json").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(DataError, match="more than can be meant"):
        read_input_json(tmp_path / "a.json")

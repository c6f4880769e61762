"""Files that appear whole or not at all, and hashes of files, data and sources."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from yid_ocp.errors import DataError, OutputError
from yid_ocp.files import atomic_write, file_sha256, is_file, json_sha256, to_json_types, write_json
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

"""Files that appear whole or not at all, and hashes that say whether anything changed."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from yid_ocp.errors import DataError, OutputError
from yid_ocp.files import atomic_write, file_sha256, is_file, json_sha256, to_json_types, write_json


def test_an_interruption_leaves_nothing(tmp_path: Path) -> None:
    def interrupted() -> None:
        with atomic_write(tmp_path / "run.h5") as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not list(tmp_path.iterdir())


def test_a_file_is_replaced_as_a_whole(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    write_json(file, {"a": 1})
    write_json(file, {"a": [2, None]})
    assert json.loads(file.read_text()) == {"a": [2, None]}
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_what_json_cannot_hold_leaves_the_old_file(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    write_json(file, {"a": 1})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(file, {"a": float("nan")})
    assert json.loads(file.read_text()) == {"a": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_a_disk_that_refuses_is_the_users_business(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(source: object, target: object) -> None:
        raise OSError(28, "any words")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OutputError, match=os.strerror(28)):
        write_json(tmp_path / "a.json", 1)
    assert not list(tmp_path.iterdir())


def test_a_place_that_cannot_hold_a_file(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="that of a folder"):
        write_json(tmp_path, 1)
    with pytest.raises(OutputError, match="does not exist"):
        write_json(tmp_path / "no" / "a.json", 1)


def test_the_hash_of_a_folder_is_that_of_its_files(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a").write_text("1")
    (tmp_path / "in" / "b").write_text("2")
    before = file_sha256(tmp_path / "in")
    assert before == file_sha256(tmp_path / "in")
    (tmp_path / "in" / "b").write_text("3")
    assert file_sha256(tmp_path / "in") != before
    with pytest.raises(DataError, match="no such file"):
        file_sha256(tmp_path / "absent")


def test_the_hash_of_data_is_that_of_its_content() -> None:
    assert json_sha256({"a": 1, "b": [1, 2]}) == json_sha256({"b": [1, 2], "a": 1})
    assert json_sha256({"a": [1, 2]}) != json_sha256({"a": [2, 1]})
    assert json_sha256({"a": 1}) != json_sha256({"a": "1"})


def test_numbers_that_json_lacks_become_null_and_a_note() -> None:
    notes: list[str] = []
    data = {"a": np.array([1.0, np.nan]), "b": {"c": np.float64(np.inf)}, "d": (np.int64(3), Path("x"))}
    assert to_json_types(data, notes) == {"a": [1.0, None], "b": {"c": None}, "d": [3, "x"]}
    assert notes == ["a[1] is not known", "b.c is infinite"]


@pytest.mark.parametrize("name", ["é" * 300 + ".ply", "a\0b", "nothing", ".."])
def test_any_name_may_be_asked_for(tmp_path: Path, name: str) -> None:
    assert not is_file(tmp_path / name)
    (tmp_path / "something").touch()
    assert is_file(tmp_path / "something")

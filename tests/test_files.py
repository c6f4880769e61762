"""Files that appear whole or not at all, and hashes of files, data and sources."""

import ast
import json
import math
import os
from pathlib import Path
from unittest.mock import Mock

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
    write_strict_json,
)
from yid_ocp.model.urdf import read_urdf
from yid_ocp.version import (
    package_source_hash,
    sha256_of_folder_sources,
    software_fingerprint,
    software_fingerprint_differences,
)


def test_an_interruption_leaves_nothing(tmp_path):
    def interrupted(temporary):
        temporary.write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), atomic_write(tmp_path / "run.h5") as file:
        interrupted(file)
    assert not list(tmp_path.iterdir())


def test_a_file_is_replaced_as_a_whole_or_not_at_all(tmp_path, monkeypatch):
    file = tmp_path / "a.json"
    write_strict_json(file, {"a": 1})
    write_strict_json(file, {"a": [2, None]})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_strict_json(file, {"a": float("nan")})
    monkeypatch.setattr(os, "replace", Mock(side_effect=OSError(28, "any words")))
    with pytest.raises(OutputError, match=os.strerror(28)):
        write_strict_json(file, 1)
    assert json.loads(file.read_text()) == {"a": [2, None]}
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_a_place_that_cannot_hold_a_file(tmp_path):
    with pytest.raises(OutputError, match="this path is a folder"):
        write_strict_json(tmp_path, 1)
    with pytest.raises(OutputError, match="does not exist"):
        write_strict_json(tmp_path / "no" / "a.json", 1)


def test_the_hash_of_a_folder_is_that_of_its_files(tmp_path):
    folder, hashes = tmp_path / "in", []
    folder.mkdir()
    (folder / "a").write_text("1")
    for text in ("2", "2", "3"):
        (folder / "b").write_text(text)
        hashes.append(file_sha256(folder))
    assert hashes[0] == hashes[1] != hashes[2]
    with pytest.raises(DataError, match=r"(?s)no such file.*did you mean 'in'"):
        file_sha256(tmp_path / "inn.json")


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
    kernel = tmp_path / "inner" / "kernel.c"
    (tmp_path / "a.py").write_text("a = 1\n")
    kernel.write_text("int a;\n")
    first = sha256_of_folder_sources(tmp_path)
    (tmp_path / "a.pyc").write_text("compiled")
    assert sha256_of_folder_sources(tmp_path) == first
    kernel.write_text("int b;\n")
    assert sha256_of_folder_sources(tmp_path) != first
    kernel.write_text("int a;\n")
    (tmp_path / "a.py").rename(tmp_path / "b.py")
    assert sha256_of_folder_sources(tmp_path) != first


def test_where_two_processes_differ_is_said():
    here = software_fingerprint()
    assert here["code"] == package_source_hash()
    assert software_fingerprint_differences(here, software_fingerprint()) == []
    casadi, code = (f"casadi 1.0 instead of {here['casadi']}", f"code {'f' * 12} instead of {here['code'][:12]}")
    assert software_fingerprint_differences(here, {**here, "casadi": "1.0", "code": "f" * 64}) == [casadi, code]
    del here["numpy"]
    [missing] = software_fingerprint_differences({**here, "numpy": "2"}, here)
    assert all(fact in missing for fact in ("numpy", "unknown", " 2"))


OPENERS = {"open", "read_text", "read_bytes", "load", "loadtxt", "genfromtxt", "fromfile", "memmap", "read_csv"}
OPENERS |= {"parse", "iterparse", "from_xml_path", "File", "ParquetFile", "read_table", "c3d", "AnyReader", "Reader"}
OPENERS |= {"imread", "read_image", "read_point_cloud", "read_triangle_mesh"}
"""Functions that open a file: Python's own, and those of the libraries that the package uses."""
GUARDS = {"check_input_file", "check_readable_in_child_process", "read_input_text"}
OPENED_ELSEWHERE = {
    "files.limit_process_memory": "/proc",
    "files.atomic_write": "what was written",
    "version.sha256_of_folder_sources": "the package's own sources",
    "cli._discard_what_follows": "/dev/null",
    "cli._reliable_streams": "/dev/null",
    "config.reader._loaded": "a text that was read",
    "data.recording_hdf5.create_hdf5_atomically": "writes",
    "data.recording_hdf5._complaint": "in the process that is tried first",
    "data.readers.c3d._complaint": "in the process that is tried first",
    "export.signals.export_recording_csv_files": "writes",
    "integrator.codegen.kernel_c_source": "sources in C that come with the package",
    "integrator.codegen.kernel_cache_key_text": "sources that come with the package",
    "inference.kalman._library": "a source in C that comes with the package",
    "workflow.prediction_outputs.copyable_estimate_texts": "the citation that comes with the package",
    "integrator.compiler._machine": "/proc",
    "report.html._packed_script": "the user's own cache",
    "report.html._is_plotly_script": "a script that is compared with its original",
    "report.sections.results._image_files": "pictures that the run drew",
    "solvers.nonlinear_program.available_memory_bytes": "/proc",
    **{f"vision.frame_folder._read_{suffix}": "`_read_cloud` has looked" for suffix in ("npz", "xyz", "pcd", "ply")},
    "vision.frame_folder.write_frame_folder": "writes",
    "virtual.mjcf.elements_by_aspect_and_file_format": "a table that comes with the package",
    "workflow.run_folder.atomic_run_folder": "writes",
    "workflow.run_inputs.load_plugins": "a package that the user installed",
}
"""Functions of the package that open what did not come from outside, or what stands behind the door already."""


def opened_without_guard(module, tree):
    """Functions of a module that open a file before anything in them has looked at it."""
    found = set()
    for function in ast.walk(tree):
        if not isinstance(function, ast.FunctionDef):
            continue
        calls = [node for node in ast.walk(function) if isinstance(node, ast.Call)]
        names = [getattr(call.func, "attr", getattr(call.func, "id", "")) for call in calls]
        opened = [call.end_lineno for call, name in zip(calls, names, strict=True) if name in OPENERS]
        guarded = [call.lineno for call, name in zip(calls, names, strict=True) if name in GUARDS]
        if opened and min(opened) < min(guarded, default=math.inf):
            found.add(f"{module}.{function.name}")
    return found


def test_every_file_from_outside_comes_through_the_door(repository):
    package, found = repository / "yid_ocp", set()
    for file in package.rglob("*.py"):
        module = ".".join(file.relative_to(package).with_suffix("").parts)
        found |= opened_without_guard(module, ast.parse(file.read_text(encoding="utf-8")))
    assert found - set(OPENED_ELSEWHERE) == set()
    assert set(OPENED_ELSEWHERE) <= found, "a function that opens nothing needs no mention"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names")
@pytest.mark.parametrize("name", ["a.csv", "a.h5", "a.c3d", "a.mcap", "a.bag", "a.db3", "a.yaml", "a.urdf"])
@pytest.mark.parametrize("kind", ["pipe", "endless"])
def test_an_input_that_is_no_regular_file_is_refused_at_once(tmp_path, name, kind):
    path = tmp_path / name
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    readers = {".yaml": [load_config], ".urdf": [read_urdf]}.get(path.suffix, [read_any, preview_file])
    words = "" if name == "a.urdf" else "a pipe or a device"
    for read in readers:
        with pytest.raises((DataError, ConfigError, ModelError), match=words):
            read(path)


@pytest.mark.parametrize("text", [b"\xff", b"{", b"[" * 100_000])
def test_json_that_is_none_is_refused(tmp_path, monkeypatch, text):
    (tmp_path / "a.json").write_bytes(text)
    with pytest.raises(DataError):
        read_input_json(tmp_path / "a.json")
    monkeypatch.setattr(Path, "read_text", Mock(side_effect=OSError(5, "any words")))
    with pytest.raises(DataError, match=r"\(Input/output error\)(.|\n)*try: copy it again"):
        read_input_json(tmp_path / "a.json")


def test_a_text_that_is_too_long_is_refused_before_it_is_read(tmp_path):
    with (tmp_path / "a.json").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(DataError, match="more than 64 MiB"):
        read_input_json(tmp_path / "a.json")

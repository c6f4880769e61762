"""Versions and hashes of sources."""

from __future__ import annotations

from yid_ocp.version import fingerprint_differences, package_source_hash, software_fingerprint, source_hash


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
    assert fingerprint_differences(here, software_fingerprint()) == []
    assert fingerprint_differences(here, {**here, "casadi": "1.0"}) == [f"casadi 1.0 instead of {here['casadi']}"]
    assert fingerprint_differences(here, {**here, "code": "f" * 64}) == [
        f"code {'f' * 12} instead of {here['code'][:12]}"
    ]
    del here["numpy"]
    assert fingerprint_differences({**here, "numpy": "2"}, here) == ["numpy unknown instead of 2"]

"""Versions and hashes of sources."""

from __future__ import annotations

from yid_ocp.version import code_hash, differences, fingerprint, package_code


def test_the_hash_of_sources_follows_their_names_and_content(tmp_path):
    (tmp_path / "inner").mkdir()
    (tmp_path / "a.py").write_text("a = 1\n")
    (tmp_path / "inner" / "kernel.c").write_text("int a;\n")
    first = code_hash(tmp_path)
    (tmp_path / "a.pyc").write_text("compiled")
    assert code_hash(tmp_path) == first
    (tmp_path / "inner" / "kernel.c").write_text("int b;\n")
    assert code_hash(tmp_path) != first
    (tmp_path / "inner" / "kernel.c").write_text("int a;\n")
    assert code_hash(tmp_path) == first
    (tmp_path / "a.py").rename(tmp_path / "b.py")
    assert code_hash(tmp_path) != first


def test_where_two_processes_differ_is_said():
    here = fingerprint()
    assert here["code"] == package_code()
    assert differences(here, fingerprint()) == []
    assert differences(here, {**here, "casadi": "1.0"}) == [f"casadi 1.0 instead of {here['casadi']}"]
    assert differences(here, {**here, "code": "f" * 64}) == [f"code {'f' * 12} instead of {here['code'][:12]}"]
    del here["numpy"]
    assert differences({**here, "numpy": "2"}, here) == ["numpy unknown instead of 2"]

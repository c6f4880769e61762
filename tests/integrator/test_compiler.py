"""Compiled code: the private cache, its keys, the compiler's absence, functions at many points at once."""

import hashlib
import logging
import os
import stat
import subprocess
import time

import casadi as ca
import numpy as np
import pytest

from yid_ocp.errors import ConfigError, OutputError
from yid_ocp.integrator import compiler
from yid_ocp.integrator.compiler import MappedFunction
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import System
from yid_ocp.model.urdf import read_urdf

SOURCE = "int yid_answer(void) { return %d; }\n"

needs_compiler = pytest.mark.usefixtures("c_compiler")


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("YID_OCP_CACHE", str(folder))
    return folder


@pytest.fixture
def choose(monkeypatch, tmp_path):
    """Take another compiler: a name, or what a shell does that is asked for more than its version."""

    def take(name="", script="", version=""):
        if script:
            path = tmp_path / f"cc_{len(list(tmp_path.iterdir()))}"
            path.write_text(f'#!/bin/sh\n[ "$1" = --version ] && echo {version} && exit\n{script}\n', encoding="utf-8")
            path.chmod(0o755)
        monkeypatch.setenv("CC", name or str(path))

    return take


@pytest.fixture
def pendulum(urdf_folder):
    return System.build(read_urdf(urdf_folder / "double_pendulum.urdf"))


@pytest.fixture
def runs(monkeypatch):
    """Commands that were run."""
    commands = []
    original = compiler.subprocess.run

    def run(command, *arguments, **options):
        commands.append(command)
        return original(command, *arguments, **options)

    monkeypatch.setattr(compiler.subprocess, "run", run)
    return commands


@needs_compiler
def test_the_second_compilation_reads_the_cache(cache, runs):
    assert compiler.compile_and_load_library(SOURCE % 42).yid_answer() == 42
    assert len([command for command in runs if "-shared" in command]) == 1
    assert [path.suffix for path in cache.iterdir()] == [".so"]
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700
    del runs[:]
    assert compiler.compile_and_load_library(SOURCE % 42).yid_answer() == 42
    assert runs == []
    assert compiler.compile_and_load_library(SOURCE % 43).yid_answer() == 43
    assert len(list(cache.iterdir())) == 2


@needs_compiler
@pytest.mark.parametrize("change", ["nothing", "compiler", "processor", "flags", "level", "casadi"])
def test_what_a_library_was_made_with_is_part_of_its_key(cache, choose, monkeypatch, c_compiler, change):
    """A cache that moves to another machine, or meets another compiler, is not trusted."""
    choose(script=f'exec {c_compiler} "$@"', version="one")
    compiler.compile_and_load_library(SOURCE % 42)
    choose(script=f'exec {c_compiler} "$@"', version="other" if change == "compiler" else "one")
    if change == "processor":
        monkeypatch.setattr(compiler.platform, "machine", lambda: "another")
        monkeypatch.setattr(compiler.platform, "processor", lambda: "another")
    elif change == "flags":
        monkeypatch.setattr(compiler, "_COMMON_FLAGS", (*compiler._COMMON_FLAGS, "-g"))
    elif change == "level":
        monkeypatch.setenv("YID_OCP_OPTIMIZE", "2")
    elif change == "casadi":
        monkeypatch.setattr(compiler.ca.CasadiMeta, "version", lambda: "another")
    assert compiler.compile_and_load_library(SOURCE % 42).yid_answer() == 42
    assert len(list(cache.iterdir())) == 1 + (change != "nothing")


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="this system has no file owners and modes")
def test_a_cache_that_others_may_write_or_that_cannot_be_made_is_refused(refused_with, cache, monkeypatch):
    cache.mkdir()
    for mode in (0o720, 0o702, 0o777):
        cache.chmod(mode)
        with refused_with(OutputError, (str(cache), "delete its files", "chmod 700", "YID_OCP_CACHE")):
            compiler.private_cache_folder()
    (cache / "file").write_text("not a folder", encoding="utf-8")
    monkeypatch.setenv("YID_OCP_CACHE", str(cache / "file" / "cache"))
    with pytest.raises(OutputError, match="CC=none"):
        compiler.private_cache_folder()


def test_without_a_compiler_everything_works_after_one_notice(cache, choose, caplog, pendulum):
    choose("none")
    with caplog.at_level(logging.INFO, logger="yid_ocp"):
        step = compile_step(pendulum, 0.01)
        q, _, _, status = step([0.3, 0.1], [0.0, 0.0], [], pendulum.parameters.vector())
        assert not compile_step(pendulum, 0.02).is_compiled
    assert status.is_converged
    assert not step.is_compiled
    assert np.all(np.isfinite(q))
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert "are about ten times slower, because CC is none." in caplog.text
    assert not cache.exists()


@needs_compiler
@pytest.mark.parametrize("damage", ["truncated", "flipped", "unreadable"])
def test_a_damaged_library_is_made_again(cache, caplog, damage):
    """Loading one would end the process with a signal."""
    assert compiler.compile_and_load_library(SOURCE % 42).yid_answer() == 42
    (path,) = cache.iterdir()
    whole = path.read_bytes()
    path.unlink()  # a new file: the old one stays loaded
    if damage == "unreadable":
        path.symlink_to(cache.parent / "nowhere")
    else:
        path.write_bytes(whole[:900] if damage == "truncated" else whole[:700] + bytes([whole[700] ^ 8]) + whole[701:])
    assert compiler.compile_and_load_library(SOURCE % 42).yid_answer() == 42
    assert "damaged" in caplog.text


PLANTED = """
#include <stdio.h>
__attribute__((constructor)) static void run(void) {{ FILE *f = fopen("{trace}", "w"); if (f) fclose(f); }}
int yid_compiled(void) {{ return 1; }}
int yid_answer(void) {{ return 666; }}
"""


@needs_compiler
@pytest.mark.parametrize("how", ["writable by all", "link", "pipe", "without its symbols"])
def test_a_planted_library_is_not_run_but_made_again(cache, tmp_path, c_compiler, how):
    """Its name holds the hash of its content, as anybody can work out."""
    assert compiler.compile_and_load_library(SOURCE % 42).yid_answer() == 42
    (own,) = cache.iterdir()
    key, made = own.stem.partition("-")[0], tmp_path / "made.so"
    own.unlink()
    text = "int nothing;" if how == "without its symbols" else PLANTED.format(trace=tmp_path / "trace")
    subprocess.run([c_compiler, "-shared", "-fPIC", "-x", "c", "-", "-o", made], input=text, text=True)
    planted = cache / f"{key}-{hashlib.sha256(made.read_bytes()).hexdigest()[:32]}.so"
    if how == "link":
        planted.symlink_to(made)
    elif how == "pipe":
        os.mkfifo(planted)
    else:
        made.rename(planted)
        planted.chmod(0o777 if how == "writable by all" else 0o755)
    assert compiler.compile_and_load_library(SOURCE % 42).yid_answer() == 42
    assert not (tmp_path / "trace").exists()
    assert [path.is_symlink() or path.stat().st_mode & 0o022 for path in cache.iterdir()] == [0]


@needs_compiler
def test_what_a_killed_compilation_left_is_removed(cache):
    cache.mkdir(mode=0o700)
    for name, age in (("build-old", 1e5), ("build-new", 0.0)):
        (cache / name).mkdir()
        os.utime(cache / name, (time.time() - age,) * 2)
    assert compiler.compile_and_load_library(SOURCE % 1).yid_answer() == 1
    assert [path.name for path in cache.iterdir() if path.is_dir()] == ["build-new"]


@needs_compiler
def test_a_home_that_cannot_be_written_to_has_a_cache_for_the_command(cache, tmp_path, monkeypatch, caplog):
    (tmp_path / "home").write_text("a file, so that no folder can be made below it")
    monkeypatch.delenv("YID_OCP_CACHE")
    monkeypatch.setattr(compiler.platformdirs, "user_cache_dir", lambda name: str(tmp_path / "home" / name))
    assert compiler.compile_and_load_library(SOURCE % 7).yid_answer() == 7
    assert "set YID_OCP_CACHE" in caplog.text
    folder = compiler.private_cache_folder()
    assert (folder.stat().st_mode & 0o777, len(list(folder.glob("*.so")))) == (0o700, 1)


def test_a_compiler_that_hangs_is_spoken_of_and_waited_for_once(cache, choose, tmp_path, monkeypatch, caplog):
    choose(script=f"echo x >> {tmp_path}/calls\nexec sleep 60")
    monkeypatch.setattr(compiler, "_COMPILE_TIMEOUT", 0.5)
    monkeypatch.setattr(compiler, "_NOTICE_DELAY", 0.1)
    assert [compiler.compile_and_load_library(SOURCE % i) for i in range(3)] == [None] * 3
    assert (tmp_path / "calls").read_text().split() == ["x"]
    assert "It is stopped after" in caplog.text


@needs_compiler
@pytest.mark.parametrize(
    "text", ["echo no space left >&2; exit 1", "exit 0", 'while [ "$1" != -o ]; do shift; done; echo nothing > "$2"']
)
def test_a_compiler_that_makes_no_library_leaves_the_interpreter(cache, choose, monkeypatch, caplog, pendulum, text):
    choose(script=text)
    monkeypatch.setattr(compiler, "_COMPILE_TIMEOUT", 0.5)
    assert not compile_step(pendulum, 0.01).is_compiled
    assert "so computations run uncompiled" in caplog.text
    assert ("no space left" in caplog.text) == ("no space left" in text)
    assert list(cache.iterdir()) == []


def test_a_level_of_optimization_or_a_compiler_that_is_none_is_said(cache, c_compiler, monkeypatch):
    for name, value in (("YID_OCP_OPTIMIZE", "fast"), ("CC", "no_such_cc")):
        monkeypatch.setenv(name, value)
        with pytest.raises(ConfigError, match=f"{value}(.|\n)*{name}"):
            compiler.compile_and_load_library(SOURCE % 42)
        monkeypatch.delenv(name)


@needs_compiler
@pytest.mark.parametrize("said", ["No space left", "cannot be loaded"])
def test_a_library_that_cannot_be_kept_or_loaded_leaves_the_interpreter(cache, monkeypatch, caplog, pendulum, said):
    def kept(source, target):
        if said == "No space left":
            raise OSError(28, "No space left on device")
        target.write_bytes(b"not a library")

    monkeypatch.setattr(compiler.os, "replace", kept)
    assert not compile_step(pendulum, 0.01).is_compiled
    assert str(cache) in caplog.text
    assert said in caplog.text


def polynomial(scale=2.0):
    x = ca.SX.sym("x", 3)
    return ca.Function("polynomial", [x], [scale * x**2, ca.jacobian(x**3, x)])


@needs_compiler
def test_a_function_is_compiled_once_and_keeps_its_sparsity(cache, runs):
    plain = polynomial()
    made = [compiler.compile_casadi_function(plain) for _ in range(2)]
    assert len([command for command in runs if "-shared" in command]) == 1
    for function in made:
        assert not function.is_a("SXFunction")
        assert function.sparsity_out(1) == plain.sparsity_out(1)
        for actual, expected in zip(function([1.0, 2.0, 3.0]), plain([1.0, 2.0, 3.0]), strict=True):
            np.testing.assert_allclose(np.array(actual), np.array(expected), rtol=1e-15)
    assert float(compiler.compile_casadi_function(polynomial(5.0))([1.0, 2.0, 3.0])[0][2]) == 45.0
    assert float(made[0]([1.0, 2.0, 3.0])[0][2]) == 18.0


@needs_compiler
def test_a_function_that_cannot_be_compiled_is_as_it_was(cache, choose, monkeypatch, caplog):
    plain = polynomial()
    with monkeypatch.context() as change:
        change.setattr(compiler.os, "replace", lambda source, target: target.write_bytes(b"not a library"))
        assert compiler.compile_casadi_function(plain).is_a("SXFunction")
    assert "cannot be loaded" in caplog.text
    choose("none")
    assert compiler.compile_casadi_function(polynomial(3.0)).is_a("SXFunction")


@pytest.mark.parametrize("use_compiler", [True, False], ids=["compiled", "interpreted"])
def test_values_at_every_point(use_compiler, monkeypatch):
    monkeypatch.setattr(compiler, "_MIN_COMPILED_INSTRUCTION_COUNT", 0)
    x, y = ca.SX.sym("x", 3), ca.SX.sym("y", 2)
    sparse = ca.SX(3, 4)
    sparse[0, 1], sparse[2, 3] = x[0] * y[1], 7
    function = ca.Function("products", [x, y], [x @ y.T, sparse, ca.SX(0, 2)])
    points, shared = np.arange(12.0).reshape(4, 3), np.array([2.0, 5.0])
    one, two, none = MappedFunction(function, shared_inputs=(1,), use_compiler=use_compiler)(points, shared)
    np.testing.assert_array_equal(one, points[:, :, None] * shared)
    expected = np.zeros((4, 3, 4))
    expected[:, 0, 1], expected[:, 2, 3] = 5 * points[:, 0], 7
    np.testing.assert_array_equal(two, expected)
    assert none.shape == (4, 0, 2)
    with pytest.raises(AssertionError, match=r"input 1 of products"):
        MappedFunction(function, use_compiler=use_compiler)(points, shared[None])

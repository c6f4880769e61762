"""Compilation of C code with the machine's C compiler, and a cache of the compiled libraries."""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import functools
import hashlib
import logging
import os
import platform
import shutil
import stat
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import platformdirs

from yid_ocp.arrays import Array
from yid_ocp.errors import ConfigError, DataError, OutputError
from yid_ocp.files import file_sha256
from yid_ocp.integrator.codegen import casadi_c_source, rows_and_columns_of_nonzeros
from yid_ocp.integrator.interpreted import function_bound_to_arrays
from yid_ocp.parallel import CasadiLockedCache

_LOG = logging.getLogger(__name__)

_COMMON_FLAGS = ("-ftree-vectorize", "-ffp-contract=fast", "-fopenmp-simd", "-fPIC", "-shared")
_NATIVE_FLAGS = ("-march=native",)
# Code without branches gains nothing from these passes, which take a third of GCC's time; other compilers refuse them.
_GCC_FLAGS = ("-fno-tree-dominator-opts", "-fno-tree-ccp", "-fno-tree-bit-ccp")

_OPTIMIZATION_FLAG = "-O1"  # -O2 takes 1.7 times as long on a step of 43 variables, for a gain of 2 to 4 %
# For code that runs for seconds in all and is new for every model: 70 000 lines compile in three seconds instead of a
# minute (-O1), and run two or three times as fast as CasADi's interpreter.
_NO_OPTIMIZATION_FLAG = "-O0"
_MIN_COMPILED_INSTRUCTION_COUNT = 100  # of a `MappedFunction`: compiling takes as long as hundreds of calls

# Ten times the compile time of the longest function; a compiler that hangs would hang the run.
_COMPILE_TIMEOUT, _VERSION_TIMEOUT = 900.0, 30.0  # [s]
_NOTICE_DELAY = 60.0  # time after which a compiler that is still at work is spoken of [s]
_BUILD_PREFIX, _BUILD_AGE_LIMIT = "build-", 2 * _COMPILE_TIMEOUT  # of folders in the cache that a killed process left
_HUNG_COMPILERS: set[str] = set()  # compilers that did not end in time: they are waited for once
_MARKER_SYMBOL = "yid_compiled"


@functools.cache
def _compiler_path(wanted: str | None) -> str | None:
    """Path of the C compiler, or None and one log message. The environment variable CC names it, or is `none`."""
    names = () if wanted == "none" else (wanted,) if wanted else ("cc", "gcc", "clang")
    path = next((found for name in names if (found := shutil.which(name))), None)
    if path is None and wanted not in (None, "", "none"):
        allowed, hint = "the name or path of a C compiler, without options, or none", "unset CC to use cc, gcc or clang"
        what, where = f"the C compiler '{wanted}' is not found", "the environment variable CC"
        raise ConfigError(what, where=where, allowed=allowed, hint=hint)
    if path is None:
        why = "CC is none" if wanted == "none" else "no C compiler was found (install one, such as gcc)"
        _LOG.warning("Computations have the same results but are about ten times slower, because %s.", why)
    return path


def _optimization_flag() -> str:
    """Optimisation flag for the step, from the environment variable YID_OCP_OPTIMIZE or the default."""
    level = os.environ.get("YID_OCP_OPTIMIZE", "")
    if level not in ("", "0", "1", "2", "3"):
        what, where = f"the optimisation level is '{level}', not 0 to 3", "the environment variable YID_OCP_OPTIMIZE"
        hint = "unset the variable, or set it to 0 for many short runs such as tests"
        raise ConfigError(what, where=where, allowed="0, 1, 2, 3", hint=hint)
    return f"-O{level}" if level else _OPTIMIZATION_FLAG


def private_cache_folder() -> Path:
    """Return the private folder of compiled code, created if absent. The environment variable YID_OCP_CACHE sets it."""
    wanted = os.environ.get("YID_OCP_CACHE")
    folder = Path(wanted or platformdirs.user_cache_dir("yid_ocp"))
    allowed = "a folder that you own, writable by you alone"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        writable = os.access(folder, os.W_OK)
    except OSError as error:
        if wanted:
            what = f"the folder of compiled code cannot be created: {error.strerror}"
            hint = "set YID_OCP_CACHE to a folder of your own, or CC=none for no compiled code"
            raise OutputError(what, where=str(folder), allowed=allowed, hint=hint) from error
        writable = False
    if not writable and not wanted:  # as in containers
        return _temporary_cache_folder(folder)
    if not _is_mine_alone(folder.stat()):
        what = "the folder of compiled code belongs to another user, or others can write to it"
        hint = "set YID_OCP_CACHE to another folder; or, if it is yours, delete its files and run chmod 700 on it"
        raise OutputError(what, where=str(folder), allowed=allowed, hint=hint)
    return folder


@functools.cache
def _temporary_cache_folder(instead_of: Path) -> Path:
    """Path of a cache folder for this process alone, which is removed when the process ends."""
    folder = Path(tempfile.mkdtemp(prefix="yid-ocp-cache-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    message = "The folder of compiled code, %s, is not writable, so compiled code is kept for this command only. %s"
    _LOG.warning(message, instead_of, "To keep it, set YID_OCP_CACHE to a folder of your own.")
    return folder


def _is_mine_alone(info: os.stat_result) -> bool:
    """Whether a file or folder belongs to this user and nobody else can write to it."""
    is_shared = info.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return not hasattr(os, "getuid") or (info.st_uid == os.getuid() and not is_shared)


@functools.cache
def _version(path: str) -> str:
    return _said([path, "--version"], _VERSION_TIMEOUT)[1]


@functools.cache
def _machine(compiler: str) -> str:
    processor = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        lines = set(info.read_text(errors="replace").splitlines())
        processor += "".join(sorted(line for line in lines if line.startswith(("model name", "flags", "Features"))))
    return f"{_version(compiler)}|{platform.system()}|{processor}"


def compile_and_load_library(
    source: str, make: Callable[[], str | None] | None = None, level: str | None = None
) -> ctypes.CDLL | None:
    """Compile a C source, or find it in the cache, and load the shared library. Returns None if no compiler works.

    The cache key is the hash of `source`, the flags, the compiler, the processor and CasADi's version. With `make`,
    `source` is only part of the key, and `make` returns the C text (or None) if the library is not in the cache.
    `level` replaces the default optimisation flag.
    """
    target = _library_file(source, level or _optimization_flag(), make)
    if target is None:
        return None
    try:
        return ctypes.CDLL(str(target))
    except OSError as error:
        message = "Compiled code cannot be loaded (%s), so computations run uncompiled (same results, but slower)."
        _LOG.warning(message, error)
        return None


def compile_casadi_function(function: ca.Function, level: str = _NO_OPTIMIZATION_FLAG) -> ca.Function:
    """Compile a CasADi function to C. Returns the function unchanged if no compiler works.

    The default `level` suits large functions whose calls take seconds in all. The compiled function cannot be
    differentiated.
    """
    library = compile_and_load_library(casadi_c_source(function.name(), (function,)), level=level)
    return function if library is None else ca.external(function.name(), library._name)


def _library_file(source: str, level: str, make: Callable[[], str | None] | None = None) -> Path | None:
    """Path of the library in the cache, compiled if it is missing. None if no compiler works."""
    path = _compiler_path(os.environ.get("CC"))
    if path is None or path in _HUNG_COMPILERS:
        return None
    flags = (*_COMMON_FLAGS, *_GCC_FLAGS) if "Free Software Foundation" in _version(path) else _COMMON_FLAGS
    told = [source, level, *flags, *_NATIVE_FLAGS, _machine(path), ca.CasadiMeta.version()]
    folder, key = private_cache_folder(), hashlib.sha256("\0".join(told).encode()).hexdigest()[:32]
    if (kept := _kept(folder, key)) is not None:
        return kept
    said = ""
    try:
        for left in folder.glob(f"{_BUILD_PREFIX}*"):
            with contextlib.suppress(OSError):
                if left.lstat().st_mtime < time.time() - _BUILD_AGE_LIMIT:
                    shutil.rmtree(left)
        with tempfile.TemporaryDirectory(prefix=_BUILD_PREFIX, dir=folder) as work:
            text, built = Path(work) / "source.c", Path(work) / "library.so"
            code = source if make is None else make()
            if code is None:
                return None
            text.write_text(f"{code}\nint {_MARKER_SYMBOL}(void) {{ return 1; }}\n", encoding="utf-8")
            for own in ((*flags, *_NATIVE_FLAGS), flags):
                if path in _HUNG_COMPILERS:
                    break
                good, said = _said([path, level, *own, str(text), "-o", str(built), "-lm"], _COMPILE_TIMEOUT)
                if good and _is_ours(built):
                    target = folder / f"{key}-{file_sha256(built)[:32]}.so"
                    os.replace(built, target)
                    return target
    except OSError as error:
        message = "Compiled code cannot be stored in %s (%s), so computations run uncompiled (slower). %s"
        _LOG.warning(message, folder, error.strerror or error, "Set YID_OCP_CACHE to another folder, or CC=none.")
        return None
    message = "The C compiler %s failed, so computations run uncompiled (slower). Repair it, or set CC to another. "
    _LOG.warning(message + "It printed:\n%s", path, said[:2000])
    return None


def _kept(folder: Path, key: str) -> Path | None:
    """Path of the cached library of a key. Damaged libraries (by their hash) and foreign ones are removed."""
    for path in sorted(folder.glob(f"{key}-*.so")):
        with contextlib.suppress(OSError, DataError):
            info = path.lstat()
            own = stat.S_ISREG(info.st_mode) and _is_mine_alone(info)
            if own and path.stem.partition("-")[2] == file_sha256(path)[:32] and _is_ours(path):
                return path
        _LOG.warning("The compiled code %s is damaged or belongs to another user, so it is compiled again.", path)
        with contextlib.suppress(OSError):
            path.unlink()
    return None


def _said(command: list[str], patience: float) -> tuple[bool, str]:
    """Whether a program succeeded within `patience` seconds, and its output."""
    notice = "The C compiler %s has run for %g s. It is stopped after %g s. Set CC=none to work without it."
    timer = threading.Timer(_NOTICE_DELAY, _LOG.warning, (notice, command[0], _NOTICE_DELAY, patience))
    timer.daemon = True
    try:
        timer.start()
        options: dict[str, Any] = {"stdin": subprocess.DEVNULL, "text": True, "errors": "replace"}
        run = subprocess.run(command, check=False, timeout=patience, capture_output=True, **options)
    except subprocess.TimeoutExpired:
        _HUNG_COMPILERS.add(command[0])
        return False, f"it did not end within {patience:g} s"
    except OSError as error:
        return False, str(error)
    finally:
        timer.cancel()
    return run.returncode == 0, run.stdout + run.stderr


def _is_ours(built: Path) -> bool:
    """Whether a compiled library has our marker symbol."""
    try:
        return bool(getattr(ctypes.CDLL(str(built)), _MARKER_SYMBOL)() == 1)
    except (OSError, AttributeError):
        return False


class MappedFunction:
    """A CasADi function that is evaluated at many points in one call, compiled if possible and if it is long.

    Inputs and outputs are dense columns. `shared_inputs` are the indices of inputs that have one value for all points.
    """

    def __init__(self, function: ca.Function, shared_inputs: Sequence[int] = (), use_compiler: bool = True) -> None:
        self.function = function
        self.shared_inputs = frozenset(shared_inputs)
        self._inputs = [function.numel_in(i) for i in range(function.n_in())]
        self._outputs = [function.nnz_out(i) for i in range(function.n_out())]
        is_long = not function.is_a("SXFunction") or function.n_instructions() >= _MIN_COMPILED_INSTRUCTION_COUNT
        quick = compile_casadi_function(function, _optimization_flag()) if use_compiler and is_long else function
        shared = sorted(shared_inputs)
        self._mapped = CasadiLockedCache[int, ca.Function](lambda n: quick.map("mapped", "serial", n, shared, []))

    def __call__(self, *inputs: Array) -> list[Array]:
        """Values at all points, dense (count, rows, columns) per output; inputs (count, size), or (size,) if shared."""
        count = next((len(x) for i, x in enumerate(inputs) if i not in self.shared_inputs), 1)
        arrays = [np.ascontiguousarray(x, dtype=float) for x in inputs]
        for i, array in enumerate(arrays):
            expected = (self._inputs[i],) if i in self.shared_inputs else (count, self._inputs[i])
            assert array.shape == expected, f"input {i} of {self.function.name()}: {array.shape}, not {expected}"
        values = [np.zeros((count, size)) for size in self._outputs]
        if count:
            function_bound_to_arrays(self._mapped(count), arrays, values)()
        dense = []
        for o, value in enumerate(values):
            sparsity = self.function.sparsity_out(o)
            if sparsity.is_dense():
                dense.append(value.reshape(count, sparsity.size2(), sparsity.size1()).transpose(0, 2, 1))
                continue
            full = np.zeros((count, *sparsity.shape))
            row, column = rows_and_columns_of_nonzeros(sparsity)
            full[:, row, column] = value
            dense.append(full)
        return dense

"""The C compiler and the private cache of compiled libraries."""

from __future__ import annotations

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
from collections.abc import Callable
from pathlib import Path

import casadi as ca
import platformdirs

from yid_ocp.errors import ConfigError, DataError, OutputError
from yid_ocp.files import file_sha256

log = logging.getLogger(__name__)

_COMMON_FLAGS = ("-ftree-vectorize", "-ffp-contract=fast", "-fopenmp-simd", "-fPIC", "-shared")
_NATIVE_FLAGS = ("-march=native",)
# Straight lines of arithmetic have no branch to thread and few constants left to fold; looking for them is a third of
# GCC's time on a step of 50 variables, and what it makes runs as fast without. Other compilers refuse these words.
_GCC_FLAGS = ("-fno-tree-dominator-opts", "-fno-tree-ccp", "-fno-tree-bit-ccp")

# -O2 takes 1.7 times as long on a step of 43 variables, for a gain of 2 to 4 %, and minutes on single functions of tens
# of thousands of lines.
_OPTIMIZATION_FLAG = "-O1"
# What runs for seconds in all and is new for every model is worth no more: -O1 takes a minute on 70 000 lines, this
# three seconds, for code that is still two or three times as fast as CasADi's own machine.
_NO_OPTIMIZATION_FLAG = "-O0"


# Ten times what the longest of our functions takes; a compiler that hangs would hang the run.
_COMPILE_TIMEOUT, _VERSION_TIMEOUT = 900.0, 30.0  # [s]
_MARKER_SYMBOL = "yid_compiled"


@functools.cache
def _compiler_path() -> str | None:
    """Path of the C compiler, or None with one log message; the environment variable CC selects it, `none` disables.

    Raises
    ------
    ConfigError
        CC names a program that is not there.
    """
    wanted = os.environ.get("CC")
    names = () if wanted == "none" else (wanted,) if wanted else ("cc", "gcc", "clang")
    path = next((found for name in names if (found := shutil.which(name))), None)
    if path is None and wanted not in (None, "", "none"):
        raise ConfigError(
            f"there is no compiler '{wanted}'",
            where="the environment's variable CC",
            allowed="name or path of a C compiler, without options; none",
            hint="unset CC to have cc, gcc or clang found",
        )
    if path is None:
        log.warning("no C compiler: everything works without compiled code, about ten times slower")
    return path


def _cache_folder() -> Path:
    """Path of the private folder of compiled code, created if absent; YID_OCP_CACHE overrides it.

    Raises
    ------
    OutputError
        It cannot be made, or others could write to it.
    """
    folder = Path(os.environ.get("YID_OCP_CACHE") or platformdirs.user_cache_dir("yid_ocp"))
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"the cache of compiled code cannot be made: {error.strerror}",
            where=str(folder),
            hint="set YID_OCP_CACHE to a folder of your own, or CC=none to do without compiled code",
        ) from error
    info = folder.stat()
    if hasattr(os, "getuid") and (info.st_uid != os.getuid() or info.st_mode & (stat.S_IWGRP | stat.S_IWOTH)):
        raise OutputError(
            "the cache of compiled code belongs to, or is writable by, somebody else",
            where=str(folder),
            allowed="a folder that you own, writable by you alone",
            hint=f"chmod 700 it, or set YID_OCP_CACHE to another folder ({folder.name})",
        )
    return folder


@functools.cache
def _version(path: str) -> str:
    return _said([path, "--version"], _VERSION_TIMEOUT)[1]


def _flags(path: str) -> tuple[str, ...]:
    """What a compiler is told wherever its code runs."""
    return (*_COMMON_FLAGS, *_GCC_FLAGS) if "Free Software Foundation" in _version(path) else _COMMON_FLAGS


@functools.cache
def _machine() -> str:
    processor = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        wanted = ("model name", "flags", "Features")
        processor += "".join(
            sorted({line for line in info.read_text(errors="replace").splitlines() if line.startswith(wanted)})
        )
    version = _version(_compiler_path() or "none")
    return f"{version}|{platform.system()}|{processor}"


def compile_library(source: str, make: Callable[[], str] | None = None) -> ctypes.CDLL | None:
    """Shared library of a C source, from the cache if present; None if no compiler works.

    Parameters
    ----------
    source : str
        C text, or what determines it. The cache key is the hash of this text, the flags, the compiler, the processor
        and CasADi's version.
    make : callable, optional
        Returns the C text if `source` is not the C text; called only if the library is not in the cache.
    """
    target = _library_file(source, _OPTIMIZATION_FLAG, make)
    if target is None:
        return None
    try:
        return ctypes.CDLL(str(target))
    except OSError as error:
        log.warning("compiled code cannot be loaded (%s); going on without it", error)
        return None


def compiled_function(function: ca.Function) -> ca.Function:
    """The function compiled to C, or unchanged if no compiler works; it cannot be differentiated.

    Parameters
    ----------
    function : casadi.Function
        Compiled without optimisation: for functions of many operations with a total run time of seconds.
    """
    generator = ca.CodeGenerator(function.name(), {"with_header": False, "indent": 0})
    generator.add(function)
    target = _library_file(generator.dump(), _NO_OPTIMIZATION_FLAG)
    if target is None:
        return function
    try:
        return ca.external(function.name(), str(target))
    except RuntimeError as error:
        log.warning("compiled code cannot be loaded (%s); going on without it", error)
        return function


def _library_file(source: str, level: str, make: Callable[[], str] | None = None) -> Path | None:
    """The library in the cache, compiled if it is not there yet; None where nothing can compile it."""
    path = _compiler_path()
    if path is None:
        return None
    flags = _flags(path)
    key = hashlib.sha256(
        "\0".join([source, level, *flags, *_NATIVE_FLAGS, _machine(), ca.CasadiMeta.version()]).encode()
    ).hexdigest()[:32]
    folder = _cache_folder()
    kept = _kept(folder, key)
    if kept is not None:
        return kept
    said = ""
    try:
        with tempfile.TemporaryDirectory(dir=folder) as work:
            text, built = Path(work) / "source.c", Path(work) / "library.so"
            text.write_text(
                f"{source if make is None else make()}\nint {_MARKER_SYMBOL}(void) {{ return 1; }}\n", encoding="utf-8"
            )
            for told in ((*flags, *_NATIVE_FLAGS), flags):
                good, said = _said([path, level, *told, str(text), "-o", str(built), "-lm"], _COMPILE_TIMEOUT)
                if good and _is_ours(built):
                    target = folder / f"{key}-{file_sha256(built)[:32]}.so"
                    os.replace(built, target)
                    return target
    except OSError as error:
        hint = "set YID_OCP_CACHE to a folder with room, or CC=none"
        log.warning(
            "compiled code cannot be kept in %s (%s); going on without it: %s", folder, error.strerror or error, hint
        )
        return None
    log.warning("the C compiler %s failed; going on without compiled code:\n%s", path, said[:2000])
    return None


def _kept(folder: Path, key: str) -> Path | None:
    """The whole library of a key; what was damaged since it was made would end the process, and is removed."""
    for path in sorted(folder.glob(f"{key}-*.so")):
        with contextlib.suppress(OSError, DataError):
            if path.stem.partition("-")[2] == file_sha256(path)[:32]:
                return path
        log.warning("compiled code in the cache is damaged or cannot be read, and is made again: %s", path)
        with contextlib.suppress(OSError):
            path.unlink()
    return None


def _said(command: list[str], patience: float) -> tuple[bool, str]:
    """Whether a program ended well, and what it said."""
    try:
        run = subprocess.run(
            command,
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
            timeout=patience,
            stdin=subprocess.DEVNULL,
        )
    except subprocess.TimeoutExpired:
        return False, f"it did not end within {patience:g} s"
    except OSError as error:
        return False, str(error)
    return run.returncode == 0, run.stdout + run.stderr


def _is_ours(built: Path) -> bool:
    """Whether what a compiler left is a library with our symbols."""
    try:
        return bool(getattr(ctypes.CDLL(str(built)), _MARKER_SYMBOL)() == 1)
    except (OSError, AttributeError):
        return False

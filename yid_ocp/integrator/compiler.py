"""The C compiler and the private cache of what it made."""

from __future__ import annotations

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
from pathlib import Path

import casadi as ca
import platformdirs

from yid_ocp.errors import OutputError

log = logging.getLogger(__name__)

FLAGS = ("-ftree-vectorize", "-ffp-contract=fast", "-fopenmp-simd", "-fPIC", "-shared")
NATIVE = ("-march=native",)

# -O2 takes minutes on single functions of tens of thousands of lines, for a gain of some 10 %.
SHORT, LONG, LONG_FROM = "-O2", "-O1", 45_000
# What runs for seconds in all and is new for every model is worth no more: -O1 takes a minute on 70 000 lines, this
# three seconds, for code that is still two or three times as fast as CasADi's own machine.
QUICK = "-O0"


@functools.cache
def compiler() -> str | None:
    """Path of the C compiler, or None with one notice; the variable CC chooses one, `CC=none` means none."""
    wanted = os.environ.get("CC")
    names = () if wanted == "none" else (wanted, "cc", "gcc", "clang")
    path = next((found for name in names if name and (found := shutil.which(name))), None)
    if path is None:
        log.warning("no C compiler: everything works without compiled code, about ten times slower")
    return path


def cache_folder() -> Path:
    """The private folder of compiled code, made when absent; YID_OCP_CACHE overrides its place.

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
def _machine() -> str:
    path = compiler() or "none"
    version = subprocess.run([path, "--version"], capture_output=True, text=True, check=False).stdout
    processor = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        wanted = ("model name", "flags", "Features")
        processor += "".join(
            sorted({line for line in info.read_text(errors="replace").splitlines() if line.startswith(wanted)})
        )
    return f"{version}|{platform.system()}|{processor}"


def compile_library(source: str, straight_line: bool = False) -> ctypes.CDLL | None:
    """Shared library of a C source, from the cache where it is there; None where nothing can compile it.

    Parameters
    ----------
    source : str
        C text. The cache key is the hash of this text, the flags, the compiler, the processor and CasADi's version.
    straight_line : bool
        Whether the text is one long function without loops, on which the compiler should not dwell.
    """
    target = _library_file(source, LONG if straight_line or source.count("\n") > LONG_FROM else SHORT)
    if target is None:
        return None
    try:
        return ctypes.CDLL(str(target))
    except OSError as error:
        log.warning("compiled code cannot be loaded (%s); going on without it", error)
        return None


def compiled_function(function: ca.Function) -> ca.Function:
    """The same function from compiled code, or as it is where nothing can compile it; it cannot be differentiated.

    Parameters
    ----------
    function : casadi.Function
        Compiled in a hurry: for functions of many operations that run for seconds in all.
    """
    generator = ca.CodeGenerator(function.name(), {"with_header": False, "indent": 0})
    generator.add(function)
    target = _library_file(generator.dump(), QUICK)
    if target is None:
        return function
    try:
        return ca.external(function.name(), str(target))
    except RuntimeError as error:
        log.warning("compiled code cannot be loaded (%s); going on without it", error)
        return function


def _library_file(source: str, level: str) -> Path | None:
    """The library in the cache, compiled if it is not there yet; None where nothing can compile it."""
    path = compiler()
    if path is None:
        return None
    key = hashlib.sha256(
        "\0".join([source, level, *FLAGS, *NATIVE, _machine(), ca.CasadiMeta.version()]).encode()
    ).hexdigest()[:32]
    target = cache_folder() / f"{key}.so"
    if target.exists():
        return target
    with tempfile.TemporaryDirectory(dir=target.parent) as work:
        text, built = Path(work) / "source.c", Path(work) / "library.so"
        text.write_text(source, encoding="utf-8")
        for flags in ((*FLAGS, *NATIVE), FLAGS):
            command = [path, level, *flags, str(text), "-o", str(built), "-lm"]
            run = subprocess.run(command, capture_output=True, text=True, check=False)
            if run.returncode == 0:
                os.replace(built, target)
                return target
    log.warning("the C compiler %s failed; going on without compiled code:\n%s", path, run.stderr[:2000])
    return None

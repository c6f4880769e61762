"""The versions of this package, its sources and its numerical dependencies."""

from __future__ import annotations

import functools
import hashlib
import platform
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path

_SOURCE_SUFFIXES = (".py", ".c")
_NUMERICAL_PACKAGES = ("casadi", "numpy", "scipy", "h5py")  # whose versions are stored with every result


def package_version() -> str:
    """Return the version of this package, or `0+unknown` if it is not installed."""
    return _version("yid-ocp", "0+unknown")


def installed_versions() -> dict[str, str]:
    """Return the versions of Python, this package and its numerical dependencies, and the platform, by name."""
    result = {"python": platform.python_version(), "platform": f"{platform.system()} {platform.machine()}"}
    return result | {name: _version(name, "not installed") for name in ("yid-ocp", *_NUMERICAL_PACKAGES)}


def sha256_of_folder_sources(folder: Path) -> str:
    """Compute the SHA-256 of all source files in a folder and its subfolders, 64 hexadecimal digits."""
    digest = hashlib.sha256()
    for file in sorted(path for path in folder.rglob("*") if path.suffix in _SOURCE_SUFFIXES):
        content = hashlib.sha256(file.read_bytes()).hexdigest()
        digest.update(f"{file.relative_to(folder).as_posix()} {content}\n".encode())
    return digest.hexdigest()


@functools.cache
def package_source_hash() -> str:
    """Return the SHA-256 of this package's source files at the first call in this process, 64 hexadecimal digits."""
    return sha256_of_folder_sources(Path(__file__).parent)


def software_fingerprint() -> dict[str, str]:
    """Return the versions and the source hash that two processes must share to compute the same numbers."""
    python = ".".join(platform.python_version_tuple()[:2])
    own = {name: text for name, text in installed_versions().items() if name in ("yid-ocp", *_NUMERICAL_PACKAGES)}
    return {"python": python, **own, "code": package_source_hash()}


def software_fingerprint_differences(here: Mapping[str, str], there: Mapping[str, str]) -> list[str]:
    """Return a text for each entry in which the fingerprint `there` (of another process) differs from `here`."""
    length = {"code": 12}
    return [
        f"{name} {there.get(name, 'unknown')[: length.get(name)]} instead of {value[: length.get(name)]}"
        for name, value in here.items()
        if there.get(name) != value
    ]


@functools.cache
def _version(package: str, otherwise: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return otherwise

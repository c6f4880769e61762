"""The version of this package."""

from __future__ import annotations

from importlib import metadata


def package_version() -> str:
    """Version of this package, `0+unknown` where it is not installed."""
    try:
        return metadata.version("yid-ocp")
    except metadata.PackageNotFoundError:
        return "0+unknown"

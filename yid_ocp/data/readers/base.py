"""The table of readers: formats of other tools that become a recording."""

from __future__ import annotations

from collections.abc import Callable

from yid_ocp.data.recording import Recording
from yid_ocp.registry import Registry

Reader = Callable[..., Recording]

READERS: Registry[Reader] = Registry("recording format")
"""Readers by file suffix, and `folder` for what is stored as a folder; each takes a path, then named options."""

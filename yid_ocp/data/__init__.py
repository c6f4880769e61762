"""Recordings in memory and on disk. A new file format is one file in `readers/`; other modules do not change.

Readers of other formats load on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from yid_ocp.data.recording import JOINT_CHANNEL_UNITS as JOINT_CHANNEL_UNITS
from yid_ocp.data.recording import JointGroup as JointGroup
from yid_ocp.data.recording import PointGroup as PointGroup
from yid_ocp.data.recording import Recording as Recording
from yid_ocp.data.recording import SensorChannelGroup as SensorChannelGroup
from yid_ocp.data.recording import validated_recording as validated_recording
from yid_ocp.data.recording_hdf5 import read_recording as read_recording
from yid_ocp.data.recording_hdf5 import write_recording as write_recording

if TYPE_CHECKING:
    from yid_ocp.data.readers import preview_file as preview_file
    from yid_ocp.data.readers import read_any as read_any


def __getattr__(name: str) -> Any:
    if name in ("preview_file", "read_any"):
        return getattr(import_module(f"{__name__}.readers"), name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")

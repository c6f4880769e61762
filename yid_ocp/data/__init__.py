"""Recordings in memory and on disk. A new file format is one file in `readers/`; other modules do not change."""

from yid_ocp.data.recording import JOINT_CHANNEL_UNITS as JOINT_CHANNEL_UNITS
from yid_ocp.data.recording import JointGroup as JointGroup
from yid_ocp.data.recording import PointGroup as PointGroup
from yid_ocp.data.recording import Recording as Recording
from yid_ocp.data.recording import SensorChannelGroup as SensorChannelGroup
from yid_ocp.data.recording_hdf5 import read_recording as read_recording
from yid_ocp.data.recording_hdf5 import write_recording as write_recording

"""Recordings in memory and on disk. A new file format is one file in `readers/`; other modules do not change."""

from yid_ocp.data.readers import READERS as READERS
from yid_ocp.data.readers import preview_file as preview_file
from yid_ocp.data.readers import read_any as read_any
from yid_ocp.data.readers.bags import BagOptions as BagOptions
from yid_ocp.data.readers.bags import read_bag as read_bag
from yid_ocp.data.readers.c3d import read_c3d as read_c3d
from yid_ocp.data.readers.csv import CsvOptions as CsvOptions
from yid_ocp.data.readers.csv import read_csv as read_csv
from yid_ocp.data.readers.lerobot import read_lerobot_episode as read_lerobot_episode
from yid_ocp.data.recording import JOINT_CHANNEL_UNITS as JOINT_CHANNEL_UNITS
from yid_ocp.data.recording import JointGroup as JointGroup
from yid_ocp.data.recording import PointGroup as PointGroup
from yid_ocp.data.recording import Recording as Recording
from yid_ocp.data.recording import SensorChannelGroup as SensorChannelGroup
from yid_ocp.data.recording import validated_recording as validated_recording
from yid_ocp.data.recording_hdf5 import read_recording as read_recording
from yid_ocp.data.recording_hdf5 import write_recording as write_recording

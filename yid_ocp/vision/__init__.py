"""From a depth camera's clouds to measured points of the object; and a virtual camera that makes such clouds."""

from yid_ocp.vision.calibration import Calibration as Calibration
from yid_ocp.vision.calibration import CalibrationOptions as CalibrationOptions
from yid_ocp.vision.camera import Background as Background
from yid_ocp.vision.camera import DepthCamera as DepthCamera
from yid_ocp.vision.camera import FrameTiming as FrameTiming
from yid_ocp.vision.camera import VirtualCamera as VirtualCamera
from yid_ocp.vision.camera import VirtualFrames as VirtualFrames
from yid_ocp.vision.camera import virtual_frames as virtual_frames
from yid_ocp.vision.clock import ClockOptions as ClockOptions
from yid_ocp.vision.filters import FilterOptions as FilterOptions
from yid_ocp.vision.fit import FitOptions as FitOptions
from yid_ocp.vision.fit import ShapeFit as ShapeFit
from yid_ocp.vision.folders import write_frames as write_frames
from yid_ocp.vision.frames import FrameSequence as FrameSequence
from yid_ocp.vision.frames import look_at as look_at
from yid_ocp.vision.lens import XTION as XTION
from yid_ocp.vision.lens import Pinhole as Pinhole
from yid_ocp.vision.meshes import ExtraMesh as ExtraMesh
from yid_ocp.vision.meshes import Scene as Scene
from yid_ocp.vision.options import TrackOptions as TrackOptions
from yid_ocp.vision.reading import read_frames as read_frames
from yid_ocp.vision.results import FrameReport as FrameReport
from yid_ocp.vision.results import Track as Track
from yid_ocp.vision.skeleton import WalkOptions as WalkOptions
from yid_ocp.vision.track import track as track

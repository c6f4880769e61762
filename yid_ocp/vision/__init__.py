"""Measurement of an object's points from the point clouds of a depth camera, and simulation of such clouds.

Letters in shapes: N points of a cloud, K links or skeleton nodes, np points of the model, M frames, s tubes.
"""

from yid_ocp.vision.calibration import ArmBasedCameraCalibrationOptions as ArmBasedCameraCalibrationOptions
from yid_ocp.vision.calibration import CameraClockOptions as CameraClockOptions
from yid_ocp.vision.frame_folder import write_frame_folder as write_frame_folder
from yid_ocp.vision.frame_selection import TrackOptions as TrackOptions
from yid_ocp.vision.frames import CameraIntrinsics as CameraIntrinsics
from yid_ocp.vision.frames import FrameSequence as FrameSequence
from yid_ocp.vision.frames import look_at_pose as look_at_pose
from yid_ocp.vision.point_cloud import CloudFilterOptions as CloudFilterOptions
from yid_ocp.vision.surface_meshes import DepthCameraModel as DepthCameraModel
from yid_ocp.vision.surface_meshes import ExtraMesh as ExtraMesh
from yid_ocp.vision.surface_meshes import SceneDescription as SceneDescription
from yid_ocp.vision.surface_meshes import VirtualCameraSetup as VirtualCameraSetup
from yid_ocp.vision.surface_meshes import render_virtual_frames as render_virtual_frames
from yid_ocp.vision.track_result import TrackResult as TrackResult

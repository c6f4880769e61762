"""Calibration shared by all frames of a sequence, estimated from a subset of them."""

from __future__ import annotations

from dataclasses import dataclass

from yid_ocp.vision.calibration import CameraCalibration
from yid_ocp.vision.clutter import BackgroundPoints
from yid_ocp.vision.dimension_check import DimensionCheck


@dataclass(frozen=True, eq=False)
class SequenceCalibration:
    """Camera calibration, object dimensions and background of a sequence.

    Attributes
    ----------
    camera_calibration : Calibration
        Where the camera stands, how it scales depth, and its clock.
    dimensions : Sizes
        What the frames say of the object's lengths and radii.
    background : Background
        What stands there in all frames.
    """

    camera_calibration: CameraCalibration
    dimensions: DimensionCheck
    background: BackgroundPoints

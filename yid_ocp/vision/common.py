"""Calibration shared by all frames of a sequence, estimated from a subset of them."""

from __future__ import annotations

from dataclasses import dataclass

from yid_ocp.vision.calibration import Calibration
from yid_ocp.vision.clutter import Background
from yid_ocp.vision.doubt import Sizes


@dataclass(frozen=True, eq=False)
class Common:
    """Camera calibration, object dimensions and background of a sequence.

    Attributes
    ----------
    calibration : Calibration
        Where the camera stands, how it scales depth, and its clock.
    sizes : Sizes
        What the frames say of the object's lengths and radii.
    background : Background
        What stands there in all frames.
    """

    calibration: Calibration
    sizes: Sizes
    background: Background

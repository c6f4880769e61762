"""The source paper's foam letter Y: three tubes of four links each, standing on the ground."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from yid_ocp.errors import OutputError
from yid_ocp.model.flexible import FlexibleObject, Segment, flexible_object
from yid_ocp.model.rotations import homogeneous_transform, rotation_from_rpy
from yid_ocp.model.urdf import mechanism_to_urdf

Y_FOOT_POSITION = (0.85, 0.0, -0.93)
"""Position of the trunk's foot in the world, Baxter's `base` [m]."""


def y_segments() -> tuple[Segment, ...]:
    """Segments of the paper's foam Y: trunk T1, branches T2 (45 degrees towards +y) and T3 (towards -y)."""
    lean = math.radians(45.0)
    return (
        Segment("T1", 0.813, 0.064, 0.032),
        Segment("T2", 0.610, 0.015, 0.025, parent="T1", rest_rotation=rotation_from_rpy(-lean, 0.0, 0.0)),
        Segment("T3", 0.737, 0.016, 0.019, parent="T1", rest_rotation=rotation_from_rpy(lean, 0.0, 0.0)),
    )


def y_object(links: int = 4, gravity_fraction: float = 1.0) -> FlexibleObject:
    """The paper's foam Y as a flexible object, its trunk's foot at (0.85, 0, -0.93) m.

    Parameters
    ----------
    links : int
        Rigid links of every tube; the nominal stiffness per joint is that of four links.
    gravity_fraction : float
        See `flexible_object`.
    """
    segments = [replace(segment, links=links) for segment in y_segments()]
    return flexible_object(segments, homogeneous_transform(np.eye(3), Y_FOOT_POSITION), "y_object", gravity_fraction)


def write_y_urdf(path: str | Path) -> None:
    """Write the paper's Y object as a URDF file; `OutputError` where that fails."""
    try:
        Path(path).write_text(mechanism_to_urdf(y_object().mechanism), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"the URDF cannot be written: {error.strerror}", where=str(path)) from error

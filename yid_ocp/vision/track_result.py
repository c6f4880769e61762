"""Results of tracking: a report of every frame, shapes and points of the good ones, and stages for figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from yid_ocp.data.recording import PointGroup, Recording, validate_recording
from yid_ocp.vision.calibration import CameraCalibration
from yid_ocp.vision.clutter import ForeignObject
from yid_ocp.vision.dimension_check import DimensionCheck
from yid_ocp.vision.shape_fit_result import FrameShapeFit
from yid_ocp.vision.skeleton import CloudSkeleton

Array = NDArray[np.float64]

_CAMERA_POINT_GROUP = "points_camera"


@dataclass(frozen=True, eq=False)
class FrameReport:
    """Report of one frame: why it was dropped, or its fitted shape.

    Attributes
    ----------
    index : int
        Of the sequence.
    name : str
    stamp : float
        As the camera gave it [s].
    joint_time : float
        On the joints' clock [s].
    drop_reason : str
        Why it was dropped; empty for a good one.
    n_raw_points, n_filtered_points, n_skeleton_nodes : int
        Points of the cloud, points left by the filters, nodes of the skeleton.
    stamp_delay : float
        Of its stamp beyond the common offset, NaN where it cannot be told [s].
    cpu_seconds : float
        Processor time from the filtered cloud to the fitted points [s].
    shape_fit : Fit or None
    alternative_fit : Fit or None
        The shape with another end as its root that fits as well, where the root is sought.
    """

    index: int
    name: str
    stamp: float
    joint_time: float
    drop_reason: str
    n_raw_points: int
    n_filtered_points: int
    n_skeleton_nodes: int
    stamp_delay: float
    cpu_seconds: float
    shape_fit: FrameShapeFit | None
    alternative_fit: FrameShapeFit | None = None

    @property
    def is_good(self) -> bool:
        """Whether the frame was used."""
        return not self.drop_reason


def count_drop_reasons(frames: Iterable[FrameReport]) -> dict[str, int]:
    """Number of frames dropped for each reason; numbers in the reasons are left out."""
    return dict(Counter(frame.drop_reason.partition(":")[0] for frame in frames if not frame.is_good).most_common())


@dataclass(frozen=True, eq=False)
class FrameStages:
    """Processing stages of one frame, for figures; stages that a dropped frame did not reach are None.

    Attributes
    ----------
    frame_name : str
    drop_reason : str
        Why the frame was dropped; empty for a good one.
    camera_position : ndarray, shape (3,)
        [m]
    raw_points : ndarray, shape (N, 3)
        In the world [m].
    filtered_points : ndarray, shape (N, 3), optional
        What the filters left [m].
    skeleton : Skeleton, optional
    shape_fit : Fit, optional
    """

    frame_name: str
    drop_reason: str
    camera_position: Array
    raw_points: Array
    filtered_points: Array | None = None
    skeleton: CloudSkeleton | None = None
    shape_fit: FrameShapeFit | None = None


@dataclass(frozen=True, eq=False)
class TrackResult:
    """Result of tracking: shapes and points of the good frames.

    Attributes
    ----------
    point_names : tuple of str
        Points written down.
    t : ndarray, shape (M,)
        Times of the good frames on the joints' clock [s].
    configurations : ndarray, shape (M, n)
        Configurations, twists at rest.
    position, std, shared_std : ndarray, shape (M, np, 3)
        [m]; NaN where a point was not seen well enough. `shared_std`: the part of `std` that all frames have in common,
        from the camera's pose, depth and clock.
    frame_reports : tuple of FrameReport
        All of them, by time stamp.
    camera_calibration : Calibration
    dimensions : Sizes
        What the frames say of the object's lengths and radii.
    foreign_objects : tuple of Foreign
        What stood about the object.
    root_note : str
        How the root was told from other ends; empty where the model says where it is.
    frame_stages : tuple of Stages
        Of the frames that were asked for and turned out well.
    """

    point_names: tuple[str, ...]
    t: Array
    configurations: Array
    position: Array
    std: Array
    shared_std: Array
    frame_reports: tuple[FrameReport, ...]
    camera_calibration: CameraCalibration
    dimensions: DimensionCheck
    foreign_objects: tuple[ForeignObject, ...]
    root_note: str
    frame_stages: tuple[FrameStages, ...]
    _system_points: tuple[str, ...]
    _place: Callable[[Array], Array]

    def configuration_at(self, t: float) -> Array:
        """Configuration at any time between the good frames, by a cubic spline through theirs, shape (n,).

        Beyond the first and the last frame it stays as it was there.
        """
        at = float(np.clip(t, self.t[0], self.t[-1]))
        return (
            self.configurations[0].copy()
            if len(self.t) < 2
            else np.asarray(CubicSpline(self.t, self.configurations, axis=0)(at))
        )

    def points_at(self, t: float) -> Array:
        """Positions of the tracked points at any time, by the kinematics of `configuration_at`, shape (np, 3) [m]."""
        return self._place(self.configuration_at(t))[[self._system_points.index(name) for name in self.point_names]]

    @property
    def drop_reason_counts(self) -> dict[str, int]:
        """Number of frames dropped for each reason."""
        return count_drop_reasons(self.frame_reports)

    @property
    def notes(self) -> tuple[str, ...]:
        """Messages about the object's dimensions and foreign objects."""
        return (*self.dimensions.messages, *(thing.text for thing in self.foreign_objects))

    def to_point_group(self) -> PointGroup:
        """The points as a group of a recording, called `points_camera`."""
        pose, words = self.camera_calibration.camera_state.pose, "depth camera, fitted shape"
        if np.nanmax(self.shared_std) > 0:
            words += f"; of std, {1e3 * np.nanmedian(self.shared_std):.1f} mm (median) are one error of all frames"
        return PointGroup(_CAMERA_POINT_GROUP, self.point_names, self.t, self.position, self.std, words, pose=pose)

    def to_recording(self, recording: Recording | None) -> Recording:
        """A recording with these points as its `points_camera`; `DataError` as `validate_recording`.

        Without a recording, as of an object that no robot holds, one of these points alone.
        """
        recording = Recording(source="depth camera", name="camera") if recording is None else recording
        others = tuple(group for group in recording.points if group.name != _CAMERA_POINT_GROUP)
        count = f"Points of {len(self.t)} of {len(self.frame_reports)} frames"
        text = f"{recording.description} {count}; {self.camera_calibration.message}."
        made = replace(recording, points=(*others, self.to_point_group()), description=text.strip(), sha256=None)
        # the positions of a straight object belong to the group that a file lists first
        if not others or others[0] is not recording.points[0] or others[0].name > _CAMERA_POINT_GROUP:
            made = replace(made, marker_reference_pose=None)
        return validate_recording(made)

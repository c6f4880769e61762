"""Results of tracking: a report of every frame, shapes and points of the good ones, and stages for figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from yid_ocp.data.recording import PointGroup, Recording, validate
from yid_ocp.vision.calibration import Calibration
from yid_ocp.vision.clutter import Foreign
from yid_ocp.vision.doubt import Sizes
from yid_ocp.vision.fitted import Fit
from yid_ocp.vision.skeleton import Skeleton

Array = NDArray[np.float64]

GROUP = "points_camera"


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
    t : float
        On the joints' clock [s].
    reason : str
        Why it was dropped; empty for a good one.
    raw, filtered, nodes : int
        Points of the cloud, points left by the filters, nodes of the skeleton.
    delay : float
        Of its stamp beyond the common offset, NaN where it cannot be told [s].
    seconds : float
        Processor time from the filtered cloud to the fitted points [s].
    fit : Fit or None
    other : Fit or None
        The shape with another end as its root that fits as well, where the root is sought.
    """

    index: int
    name: str
    stamp: float
    t: float
    reason: str
    raw: int
    filtered: int
    nodes: int
    delay: float
    seconds: float
    fit: Fit | None
    other: Fit | None = None

    @property
    def good(self) -> bool:
        """Whether the frame was used."""
        return not self.reason


def dropped(frames: Iterable[FrameReport]) -> dict[str, int]:
    """Number of frames dropped for each reason; numbers in the reasons are left out."""
    return dict(Counter(frame.reason.partition(":")[0] for frame in frames if not frame.good).most_common())


@dataclass(frozen=True, eq=False)
class Stages:
    """Processing stages of one frame, for figures; stages that a dropped frame did not reach are None.

    Attributes
    ----------
    name : str
    reason : str
        Why the frame was dropped; empty for a good one.
    camera : ndarray, shape (3,)
        [m]
    cloud : ndarray, shape (N, 3)
        In the world [m].
    filtered : ndarray, shape (N, 3), optional
        What the filters left [m].
    skeleton : Skeleton, optional
    fit : Fit, optional
    """

    name: str
    reason: str
    camera: Array
    cloud: Array
    filtered: Array | None = None
    skeleton: Skeleton | None = None
    fit: Fit | None = None


@dataclass(frozen=True, eq=False)
class Track:
    """Result of tracking: shapes and points of the good frames.

    Attributes
    ----------
    names : tuple of str
        Points written down.
    t : ndarray, shape (M,)
        Times of the good frames on the joints' clock [s].
    q : ndarray, shape (M, n)
        Configurations, twists at rest.
    position, std, common : ndarray, shape (M, np, 3)
        [m]; NaN where a point was not seen well enough. `common`: of `std`, what all frames have in common, from the
        camera's pose, depth and clock.
    frames : tuple of FrameReport
        All of them, by time stamp.
    calibration : Calibration
    sizes : Sizes
        What the frames say of the object's lengths and radii.
    things : tuple of Foreign
        What stood about the object.
    note : str
        How the root was told from other ends; empty where the model says where it is.
    stages : tuple of Stages
        Of the frames that were asked for and turned out well.
    """

    names: tuple[str, ...]
    t: Array
    q: Array
    position: Array
    std: Array
    common: Array
    frames: tuple[FrameReport, ...]
    calibration: Calibration
    sizes: Sizes
    things: tuple[Foreign, ...]
    note: str
    stages: tuple[Stages, ...]
    _system_points: tuple[str, ...]
    _place: Callable[[Array], Array]

    def shape(self, t: float) -> Array:
        """Configuration at any time between the good frames, by a cubic spline through theirs, shape (n,).

        Beyond the first and the last frame it stays as it was there.
        """
        at = float(np.clip(t, self.t[0], self.t[-1]))
        return self.q[0].copy() if len(self.t) < 2 else np.asarray(CubicSpline(self.t, self.q, axis=0)(at))

    def points(self, t: float) -> Array:
        """Positions of the tracked points at any time, by the kinematics of `shape`, shape (np, 3) [m]."""
        return self._place(self.shape(t))[[self._system_points.index(name) for name in self.names]]

    @property
    def dropped(self) -> dict[str, int]:
        """Number of frames dropped for each reason."""
        return dropped(self.frames)

    @property
    def notes(self) -> tuple[str, ...]:
        """Messages about the object's dimensions and foreign objects."""
        return (*self.sizes.messages, *(thing.text for thing in self.things))

    def group(self) -> PointGroup:
        """The points as a group of a recording, called `points_camera`."""
        pose, words = self.calibration.state.pose, "depth camera, fitted shape"
        if np.nanmax(self.common) > 0:
            words += f"; of std, {1e3 * np.nanmedian(self.common):.1f} mm (median) are one error of all frames"
        return PointGroup(GROUP, self.names, self.t, self.position, self.std, words, pose=pose)

    def recording(self, recording: Recording | None) -> Recording:
        """A recording with these points in place of any `points_camera` that it had; `DataError` as `validate`.

        Without a recording, as of an object that no robot holds, one of these points alone.
        """
        recording = Recording(source="depth camera", name="camera") if recording is None else recording
        others = tuple(group for group in recording.points if group.name != GROUP)
        text = (
            f"{recording.description} Points of {len(self.t)} of {len(self.frames)} frames; {self.calibration.message}."
        )
        made = replace(recording, points=(*others, self.group()), description=text.strip(), sha256=None)
        # the positions of a straight object belong to the group that a file lists first
        if not others or others[0] is not recording.points[0] or others[0].name > GROUP:
            made = replace(made, straight=None)
        return validate(made)

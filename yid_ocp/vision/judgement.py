"""Which frames are good, and how well their points are known: judged over the small results of all frames."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from yid_ocp.errors import DataError
from yid_ocp.vision.calibration import Calibration
from yid_ocp.vision.fit import Fit, ShapeFit
from yid_ocp.vision.options import TrackOptions
from yid_ocp.vision.results import FrameReport

Array = NDArray[np.float64]


def unfit(fit: Fit, shape: ShapeFit, options: TrackOptions) -> str:
    """Why a frame's fit cannot be used, by itself; empty for a good one."""
    if not np.isfinite(fit.q).all():
        return "the fit failed"
    if fit.distance > options.d_max:
        limit = 1e3 * options.d_max
        return f"the shape does not fit: {1e3 * fit.distance:.1f} mm off on average, d_max is {limit:g} mm"
    bend = float(np.abs((fit.q - shape.rest)[list(shape.bends)]).max())
    if bend > options.largest_bend:
        return f"the shape is folded: a joint is bent by {math.degrees(bend):.0f} degrees"
    if fit.inliers < options.least_inliers:
        return f"the shape does not fit: only {100 * fit.inliers:.0f} % of the points lie on it"
    return ""


def judged(frames: Sequence[FrameReport], options: TrackOptions) -> list[FrameReport]:
    """Drop those of the good frames that are unlike the others."""
    fits = [frame.fit for frame in frames if frame.good and frame.fit is not None]
    if not fits:
        return list(frames)
    usual = float(np.median([fit.distance for fit in fits]))
    gap = np.median([fit.gap for fit in fits], axis=0)
    return [_compared(frame, usual, gap, options) for frame in frames]


def _compared(frame: FrameReport, usual: float, gap: Array, options: TrackOptions) -> FrameReport:
    if not frame.good or frame.fit is None:
        return frame
    if frame.fit.distance > options.worse * usual:
        off = f"{1e3 * frame.fit.distance:.1f} mm off on average, {1e3 * usual:.1f} mm are usual"
        return replace(frame, reason=f"the shape fits worse than in other frames: {off}")
    apart = float(np.linalg.norm(frame.fit.gap - gap, axis=1).max(initial=0.0))
    if apart > options.gap_max:
        off = f"{1e3 * apart:.0f} mm more than usual (a late stamp?)"
        return replace(frame, reason=f"an end is not where its gripper is: {off}")
    return frame


@dataclass(frozen=True, eq=False)
class Measured:
    """Points of the good frames.

    Attributes
    ----------
    t : ndarray, shape (M,)
        [s]
    q : ndarray, shape (M, n)
    position, std, common : ndarray, shape (M, np, 3)
        [m]; NaN where a point was not seen well enough.
    """

    t: Array
    q: Array
    position: Array
    std: Array
    common: Array


def measured(
    frames: Sequence[FrameReport], columns: Sequence[int], calibration: Calibration, options: TrackOptions, source: str
) -> Measured:
    """Points of the good frames with standard deviations.

    Parameters
    ----------
    frames : sequence of FrameReport
        All of them, judged.
    columns : sequence of int
        Of the system's points, those that are wanted.
    calibration : Calibration
    options : TrackOptions
    source : str
        Where the frames come from.

    Raises
    ------
    DataError
        No good frame, or no point that is known well enough in any.
    """
    good = [frame for frame in frames if frame.good]
    if not good:
        raise _none_good(frames, source)
    fits = [frame.fit for frame in good if frame.fit is not None]
    t = np.array([frame.t for frame in good])
    position = np.array([fit.points[list(columns)] for fit in fits])
    std = np.hypot(np.array([fit.std[list(columns)] for fit in fits]), options.std_floor)
    velocity = np.zeros_like(position)
    if len(t) > 1:
        velocity = np.asarray(CubicSpline(t, position, axis=0)(t, 1))
    # a point is where it was at some time of the exposure, which is uniform over that
    std = np.hypot(std, np.abs(velocity) * math.hypot(options.stamp_std, options.exposure / math.sqrt(12.0)))
    stamps = np.repeat([frame.stamp for frame in good], len(columns))
    common = calibration.common_std(position.reshape(-1, 3), velocity.reshape(-1, 3), stamps).reshape(std.shape)
    std = np.hypot(std, common)
    unseen = np.linalg.norm(std, axis=2) > math.sqrt(3.0) * options.point_std_max
    unseen |= ~np.array([fit.seen[list(columns)] for fit in fits])
    if unseen.all():
        best = 1e3 * float(np.sqrt((std**2).mean(axis=2)).min())
        raise DataError(
            f"no point is known well enough in any frame: the best within {best:.0f} mm,"
            f" point_std_max is {1e3 * options.point_std_max:g} mm",
            where=source,
            hint=f"check the camera's pose and clock ({calibration.message}), or look at the pictures of a frame",
        )
    hidden = unseen[..., None]
    q = np.array([fit.q for fit in fits])
    return Measured(t, q, *(np.where(hidden, np.nan, entry) for entry in (position, std, common)))


def _none_good(frames: Sequence[FrameReport], source: str) -> DataError:
    count = Counter(frame.reason for frame in frames).most_common(3)
    listed = "; ".join(f"{reason} ({number} of {len(frames)})" for reason, number in count)
    hint = "check the camera's pose, the unit of the clouds and the filters, and look at the pictures of a frame"
    if "metres" in listed:
        hint = "say in camera.json that the unit is mm"
    return DataError(f"not one frame could be used: {listed}", where=source, hint=hint)

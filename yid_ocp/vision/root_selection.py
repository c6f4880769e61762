"""Selection of the object's root end from all frames, for a model without a fixed root."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import shortest_path

from yid_ocp.vision.fit import FrameShapeFit
from yid_ocp.vision.options import TrackOptions
from yid_ocp.vision.track_result import FrameReport

Array = NDArray[np.float64]

_TOUCHING = 1e-3  # [m]
_APART = 4.0  # parts of an object nearer than so many radii along it cannot help being near each other
_MOST = 400  # places along a shape that are compared
_CLEARLY = 2.0  # times
_SAME = 0.1  # of the length between the ends, within which roots are the same
_HANGING = 0.2  # of the length between the ends, by which one is higher


def choose_root_ends(frames: Sequence[FrameReport], options: TrackOptions) -> tuple[list[FrameReport], str]:
    """Frames with the same end as root in all of them, and the criterion in words.

    Where a shape fits as well with its root at another end, the ends are followed from frame to frame first. Then the
    root is the one that stays in its place, if it is fixed, or the higher one.
    """
    if options.root_placement == "model":
        return list(frames), ""
    two = [
        k
        for k, frame in enumerate(frames)
        if frame.is_good and frame.shape_fit is not None and frame.alternative_fit is not None
    ]
    if not two:
        said = (
            "it is the one nearest to approximate_root_position"
            if options.approximate_root_position is not None
            else "lengths and branches tell it"
        )
        return _fixed(frames, options), f"root: {said}"
    made, last = list(frames), None
    for k in (k for k, frame in enumerate(frames) if frame.is_good and frame.shape_fit is not None):
        if (
            made[k].alternative_fit is not None
            and last is not None
            and _apart(made[k].alternative_fit, last) < _apart(made[k].shape_fit, last)
        ):
            made[k] = _exchanged(made[k])
        last = made[k].shape_fit
    roots, tips = _ends([frame.shape_fit for frame in (made[k] for k in two)])
    moving = [float(np.median(np.linalg.norm(ends - np.median(ends, axis=0), axis=1))) for ends in (roots, tips)]
    above = float(np.median(roots[:, 2] - tips[:, 2]))
    between = float(np.median(np.linalg.norm(roots - tips, axis=1)))
    own = float(np.median(np.linalg.norm(roots - _ends([made[k].alternative_fit for k in two])[0], axis=1)))
    if own < _SAME * between:
        other, said = False, "branches that are alike were followed from frame to frame, which is which is not known"
    elif options.root_placement == "fixed" and max(moving) > _CLEARLY * min(moving):
        other, said = moving[0] > moving[1], "it is the end that stays in its place"
    elif abs(above) > _HANGING * between:
        other, said = above < 0, "it is the higher end"
    else:
        other, said = False, "either end may be it, one was taken: approximate_root_position says which"
    if other:
        made = [_exchanged(frame) for frame in made]
    return _fixed(made, options), f"root: {said}"


def _exchanged(frame: FrameReport) -> FrameReport:
    return (
        frame
        if frame.alternative_fit is None
        else replace(frame, shape_fit=frame.alternative_fit, alternative_fit=frame.shape_fit)
    )


def _apart(one: FrameShapeFit | None, other: FrameShapeFit | None) -> float:
    assert one is not None
    assert other is not None
    return float(np.linalg.norm(one.link_ends - other.link_ends, axis=2).mean())


def _ends(fits: Sequence[FrameShapeFit | None]) -> tuple[Array, Array]:
    lines = np.array([fit.link_ends for fit in fits if fit is not None])
    return lines[:, 0, 0], lines[:, -1, 1]


def _fixed(frames: Sequence[FrameReport], options: TrackOptions) -> list[FrameReport]:
    """Drop frames whose root is not where it is in the others, where it is fixed."""
    good = [frame.shape_fit for frame in frames if frame.is_good and frame.shape_fit is not None]
    if options.root_placement != "fixed" or not good:
        return list(frames)
    usual = np.median(_ends(good)[0], axis=0)
    made = []
    for frame in frames:
        if frame.is_good and frame.shape_fit is not None:
            away = float(np.linalg.norm(frame.shape_fit.link_ends[0, 0] - usual))
            if away > options.max_grasp_gap_change + 2 * options.max_point_std:
                reason = f"its root is not where it is in other frames: {1e3 * away:.0f} mm away"
                made.append(replace(frame, drop_reason=reason))
                continue
        made.append(frame)
    return made


def is_self_touching(centre_line: Array, radius: Array) -> bool:
    """Whether a shape touches itself at parts that are far apart along it.

    Parameters
    ----------
    centre_line : ndarray, shape (K, 2, 3)
        Start and end of every link [m].
    radius : ndarray, shape (K,)
        [m]
    """
    corners = centre_line.reshape(-1, 3)
    near = np.linalg.norm(corners[:, None] - corners, axis=2)
    edges = np.where(near < _TOUCHING, 1e-6, np.inf)  # zero would be no way
    lengths = np.linalg.norm(centre_line[:, 1] - centre_line[:, 0], axis=1)
    starts = 2 * np.arange(len(centre_line))
    edges[starts, starts + 1] = edges[starts + 1, starts] = lengths
    along = shortest_path(np.where(np.isfinite(edges), edges, 0.0), directed=False)
    spacing = max(float(radius.min()), float(lengths.sum()) / _MOST)
    link = np.repeat(np.arange(len(lengths)), np.ceil(lengths / spacing).astype(np.int64) + 1)
    share = np.concatenate([np.linspace(0.0, 1.0, np.count_nonzero(link == k)) for k in range(len(lengths))])
    places = centre_line[link, 0] + share[:, None] * (centre_line[link, 1] - centre_line[link, 0])
    to = [share * lengths[link], (1 - share) * lengths[link]]  # each end of its link
    ways = [along[np.ix_(2 * link + a, 2 * link + b)] + to[a][:, None] + to[b] for a in (0, 1) for b in (0, 1)]
    reach = radius[link][:, None] + radius[link]
    far = (np.min(ways, axis=0) > _APART * reach) & (link[:, None] != link)
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    return bool((far & (apart < reach)).any())

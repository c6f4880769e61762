"""Occlusion in a camera's view: whether a place without points is hidden or visibly empty.

A depth camera that measures something behind a place has looked through it: nothing was there. Something measured
before it hides it. Without any point in that direction the place counts as empty, unless something nearer stands so
close beside the line of sight that its shadow falls there: a projector or second lens beside the camera sees less than
the camera itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from yid_ocp.vision.camera_intrinsics import CameraIntrinsics

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_BASELINE = 0.1  # [m]; between the camera's two eyes, of which no usual depth camera has a wider one
_PLENTY = 24  # points about the narrowest place; of more, some are left out
_NARROWER = 0.8  # times the narrowest place, up to which what is sorted stays enough
_MORE = 0.02  # of the picture, as x/z, that is sorted beyond what is asked for
_HALF = 0.5  # of the points in a direction decide
_STRIP, _PIECES = 0.02, 20  # of a picture: width of the strip along a side and the pieces of it, half of them filled
_NARROWEST = 0.3  # of a picture, as x/z: what is narrower is a cloud that was cut out
_LEAST_DEPTH = 0.05  # [m]; nearer to the camera's plane there is no picture


@dataclass(frozen=True, eq=False)
class OcclusionMap:
    """Occlusion map of a frame, from all points that the camera saw.

    Attributes
    ----------
    points : ndarray, shape (N, 3)
        In the world, before anything is left out [m].
    camera_pose : ndarray, shape (4, 4)
        Camera (x right, y down, z ahead) in the world.
    intrinsics : Pinhole, optional
        Without it the picture ends where points stand along most of a side.
    expected_points : ndarray, shape (M, 3), optional
        Points about which will be asked, so that what stands before them is sorted once [m].
    """

    points: Array
    camera_pose: Array
    intrinsics: CameraIntrinsics | None = None
    expected_points: Array | None = None
    _kept: list[tuple[Array, Array, float, cKDTree, Array]] = field(default_factory=list, repr=False)

    def is_hidden(self, places: Array, radius: Array, margin: float) -> Mask:
        """Whether places are hidden from the camera.

        Parameters
        ----------
        places : ndarray, shape (S, 3)
            In the world [m].
        radius : ndarray, shape (S,)
            How far about its line of sight each place reaches [m].
        margin : float
            What is nearer to the camera than a place by more than its radius and this stands before it [m].

        Returns
        -------
        ndarray, shape (S,)
            True where something nearer stands before it, throws its shadow on it, or where the picture ends.
        """
        seen, depth = _picture(places, self.camera_pose)
        asked, wide = seen.T, radius / np.maximum(depth, _LEAST_DEPTH)
        hidden = depth < _LEAST_DEPTH
        if self.intrinsics is not None:
            camera = self.intrinsics
            u, v = camera.fx * asked[:, 0] + camera.cx, camera.fy * asked[:, 1] + camera.cy
            hidden |= (u < 0) | (u > camera.width - 1) | (v < 0) | (v > camera.height - 1)
        else:
            low, high = self._borders
            hidden |= ((asked < low + wide[:, None]) | (asked > high - wide[:, None])).any(axis=1)
        if hidden.all():
            return hidden
        tree, distance = self._about(asked[~hidden], wide[~hidden])
        if not len(distance):
            return hidden
        for i in np.flatnonzero(~hidden):
            there = distance[tree.query_ball_point(asked[i], wide[i])]
            limit = depth[i] - radius[i] - margin
            hidden[i] = (
                np.mean(there < limit) > _HALF if len(there) else self._shadowed(tree, distance, asked[i], limit)
            )
        return hidden

    @cached_property
    def _all(self) -> tuple[Array, Array]:
        seen, depth = _picture(self.points, self.camera_pose)
        ahead = depth > _LEAST_DEPTH
        return (seen, depth) if ahead.all() else (seen[:, ahead], depth[ahead])

    @cached_property
    def _borders(self) -> tuple[Array, Array]:
        """Where the picture ends, as far as points along all of a side show it; infinite at other sides."""
        borders = np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
        seen, _ = self._all
        if seen.size:
            low, high = seen.min(1), seen.max(1)
            for axis in range(2 if (high - low > _NARROWEST).all() else 0):
                for end, value in enumerate((low[axis], high[axis])):
                    strip = np.abs(seen[axis] - value) <= _STRIP * (high[axis] - low[axis])
                    other = 1 - axis
                    along = (seen[other, strip] - low[other]) / max(high[other] - low[other], 1e-12)
                    filled = np.bincount(np.minimum((along * _PIECES).astype(np.int64), _PIECES - 1), minlength=_PIECES)
                    if np.mean(filled > 0) > _HALF:
                        borders[end, axis] = value
        return borders[0], borders[1]

    @cached_property
    def _shadow(self) -> float:
        """How far beside its place in the picture the shadow of the nearest point can fall, as x/z."""
        _, depth = self._all
        return _BASELINE / float(depth.min()) if len(depth) else 0.0

    def _about(self, asked: Array, wide: Array) -> tuple[cKDTree, Array]:
        """Points of the picture round about the places: where in the picture, and how deep.

        One frame asks again and again for much the same: what was found stays while it is enough.
        """
        reach, narrow = max(float(wide.max()), self._shadow), float(wide.min())
        low, high = asked.min(0) - reach, asked.max(0) + reach
        for lower, upper, least, tree, depth in self._kept:
            if (lower <= low).all() and (upper >= high).all() and narrow >= least:
                return tree, depth
        if self.expected_points is not None and len(self.expected_points):
            likely = _picture(self.expected_points, self.camera_pose)[0]
            low, high = np.minimum(low, likely.min(1) - reach), np.maximum(high, likely.max(1) + reach)
        low, high = low - _MORE, high + _MORE
        seen, depth = self._all
        x, y = seen
        near = np.flatnonzero((x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1]))
        narrow *= _NARROWER
        about = len(near) * math.pi * narrow**2 / float(np.prod(high - low))
        near = near[:: max(1, int(about / _PLENTY))]
        tree = cKDTree(seen.take(near, axis=1).T, leafsize=64, compact_nodes=False, balanced_tree=False)
        self._kept.append((low, high, narrow, tree, depth[near]))
        return tree, depth[near]

    @staticmethod
    def _shadowed(tree: cKDTree, distance: Array, asked: Array, limit: float) -> bool:
        """Whether something nearer stands where the other eye would have to look through it."""
        if limit <= _LEAST_DEPTH:
            return False
        nearest = float(distance.min())
        widest = _BASELINE * (1.0 / max(nearest, _LEAST_DEPTH) - 1.0 / limit)
        if widest <= 0:
            return False
        around = np.asarray(tree.query_ball_point(asked, widest), dtype=np.int64)
        around = around[distance[around] < limit]
        apart = np.linalg.norm(tree.data[around] - asked, axis=1)
        return bool((apart <= _BASELINE * (1.0 / distance[around] - 1.0 / limit)).any())


def _picture(points: Array, pose: Array) -> tuple[Array, Array]:
    """Where points stand in the picture, x/z and y/z, shape (2, N), and their depth z [m]."""
    local = pose[:3, :3].T @ points.T
    local -= (pose[:3, :3].T @ pose[:3, 3])[:, None]
    depth = local[2]
    seen = local[:2]
    seen /= np.maximum(depth, _LEAST_DEPTH)
    return seen, depth

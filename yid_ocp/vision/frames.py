"""The frames of a depth camera: clouds, time stamps, lens and occlusion.

With x = X/Z, y = Y/Z, r^2 = x^2 + y^2 and theta = atan r, a point has the pixel u = fx x' + cx, v = fy y' + cy, where

    plumb_bob, rational    x' = c x + 2 p1 x y + p2 (r^2 + 2 x^2),  y' = c y + p1 (r^2 + 2 y^2) + 2 p2 x y,
                           c = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
    equidistant            (x', y') = (x, y) theta/r (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)

References
----------
Brown (1971), Photogrammetric Engineering 37:855. Kannala & Brandt (2006), doi:10.1109/TPAMI.2006.153. Names and order
of the coefficients: sensor_msgs/CameraInfo of ROS (REP 104).
"""

from __future__ import annotations

import contextlib
import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from yid_ocp.arrays import Array, BoolArray
from yid_ocp.errors import DataError, import_optional, unknown_name_error_arguments
from yid_ocp.model.mechanism import homogeneous_transform

PointColourArray = NDArray[np.uint8]

dropped_frame_error = partial(DataError, where="frame", allowed="a frame that shows the object", hint="leave it out")
"""Makes the `DataError` that drops a frame from its argument, the `drop_reason` of the frame."""
_DISTORTION_COEFFICIENT_COUNTS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}
"""Allowed numbers of coefficients by distortion model. Order: k1, k2, p1, p2, k3 (k4, k5, k6); equidistant k1 to k4."""
_MAX_UNDISTORTION_STEPS = 30  # largest number of Newton steps for a pixel's direction
_UNDISTORTION_TOLERANCE = 1e-3  # [pixels]


@dataclass(frozen=True)
class CameraIntrinsics:
    """The intrinsic parameters of a camera with axes x right, y down, z forward.

    Without distortion u = fx x/z + cx, v = fy y/z + cy, with focal lengths fx, fy and principal point (cx, cy) in
    pixels. Raises `DataError` for an unknown distortion model.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "plumb_bob"  # distortion model, one of `_DISTORTION_COEFFICIENT_COUNTS`
    coefficients: tuple[float, ...] = ()  # empty for a lens without distortion

    def __post_init__(self) -> None:
        if self.has_distortion and self.model not in _DISTORTION_COEFFICIENT_COUNTS:
            known = unknown_name_error_arguments(self.model, _DISTORTION_COEFFICIENT_COUNTS)
            raise DataError(f"the distortion model '{self.model}' is unknown", where="intrinsics: model", **known)
        count = _DISTORTION_COEFFICIENT_COUNTS.get(self.model, ())
        if self.has_distortion and (len(self.coefficients) not in count or not np.isfinite(self.coefficients).all()):
            allowed = f"{' or '.join(map(str, count))} finite numbers"
            what = f"the distortion model '{self.model}' has the coefficients {self.coefficients}, not {allowed}"
            hint = "copy all coefficients of the camera's calibration, or leave them out for a lens without distortion"
            raise DataError(what, where="intrinsics: coefficients", allowed=allowed, hint=hint)

    @staticmethod
    def from_field_of_view(width: int, height: int, horizontal: float) -> CameraIntrinsics:
        """Make intrinsics from a horizontal field of view [rad], with square pixels and a centred principal point."""
        focal = 0.5 * width / math.tan(0.5 * horizontal)
        return CameraIntrinsics(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))

    @property
    def has_distortion(self) -> bool:
        """Whether the lens has distortion."""
        return any(self.coefficients)

    @cached_property
    def pixel_rays_at_unit_depth(self) -> Array:
        """The ray (height, width, 3) of every pixel in the camera's frame, with z = 1. NaN outside the lens model."""
        u, v = np.meshgrid(np.arange(self.width, dtype=float), np.arange(self.height, dtype=float))
        made = np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones(u.shape)], axis=-1)
        if self.has_distortion:
            made[..., 0], made[..., 1] = _straightened(self, made[..., 0].copy(), made[..., 1].copy())
        made.setflags(write=False)
        return made

    def points_from_depth(self, depth: ArrayLike) -> Array:
        """Convert a depth image (height, width) to points (N, 3) [m] in the camera's frame, row by row.

        Pixels without depth (zero or NaN) give no point. Raises `DataError` if the image has not the camera's size.
        """
        image, rays = np.asarray(depth, float), self.pixel_rays_at_unit_depth
        if image.shape != (self.height, self.width):
            what = f"the depth image has shape {image.shape}, but must have shape ({self.height}, {self.width})"
            hint = "correct width and height in `intrinsics`, or export the image in this size"
            raise DataError(what, where="depth image", allowed="(height, width) of the intrinsics", hint=hint)
        seen = np.flatnonzero(np.isfinite(image) & (image > 0) & np.isfinite(rays[..., 0]))
        # a third of the time that a mask over rows takes
        points = rays.reshape(-1, 3).take(seen, axis=0)
        points *= image.ravel().take(seen)[:, None]
        return points

    def _distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        square = x**2 + y**2
        if self.model == "equidistant" and self.has_distortion:
            radius = np.sqrt(square)
            angle = np.arctan(radius)
            bent = angle * (1 + sum(k * angle ** (2 * n) for n, k in enumerate(self.coefficients, start=1)))
            factor = np.where(radius > 1e-9, bent / np.maximum(radius, 1e-9), 1.0)
            return x * factor, y * factor
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.coefficients, *[0.0] * (8 - len(self.coefficients)))
        factor = (1 + square * (k1 + square * (k2 + square * k3))) / (1 + square * (k4 + square * (k5 + square * k6)))
        beside_x, beside_y = p2 * (square + 2 * x**2), p1 * (square + 2 * y**2)
        return x * factor + 2 * p1 * x * y + beside_x, y * factor + beside_y + 2 * p2 * x * y


def _straightened(lens: CameraIntrinsics, aim_x: Array, aim_y: Array) -> tuple[Array, Array]:
    """Solution (x, y) of distort(x, y) = (aim_x, aim_y) by Newton's method; NaN outside the range of the distortion."""
    x, y, h = aim_x, aim_y, 1e-6
    if lens.model == "equidistant":  # the aim is an angle, which is nearer to the answer as one
        bent = np.maximum(np.hypot(aim_x, aim_y), 1e-9)
        x, y = (aim * np.tan(np.minimum(bent, 1.5)) / bent for aim in (aim_x, aim_y))
    with np.errstate(all="ignore"):
        for _ in range(_MAX_UNDISTORTION_STEPS):
            at_x, at_y = lens._distort(x, y)
            right_x, right_y = lens._distort(x + h, y)
            down_x, down_y = lens._distort(x, y + h)
            a, b, c, d = (right_x - at_x) / h, (down_x - at_x) / h, (right_y - at_y) / h, (down_y - at_y) / h
            error_x, error_y, turn = aim_x - at_x, aim_y - at_y, a * d - b * c
            x, y = x + (d * error_x - b * error_y) / turn, y + (a * error_y - c * error_x) / turn
        seen_x, seen_y = lens._distort(x, y)
        off = np.hypot((seen_x - aim_x) * lens.fx, (seen_y - aim_y) * lens.fy)
        # beyond the turning point of a distortion formula, other solutions are outside the image or mirrored
        good = (off < _UNDISTORTION_TOLERANCE) & (turn > 0) & (x * aim_x + y * aim_y >= 0)
    return np.where(good, x, np.nan), np.where(good, y, np.nan)


XTION_INTRINSICS = CameraIntrinsics.from_field_of_view(640, 480, math.radians(58.0))
"""Intrinsics of the Asus Xtion Pro Live's depth camera: 640 x 480 pixels, horizontal field of view 58 degrees."""


@cache
def import_open3d() -> ModuleType:
    """Import the open3d package. Raises `DataError` if it is not installed or cannot be loaded."""
    with contextlib.suppress(ImportError, OSError):  # the system may have its own
        # the wheel of open3d wants the system's libusb, which a bare machine does not have
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    return import_optional("open3d", "vision", "vision needs the package open3d")


@dataclass(frozen=True, eq=False)
class FrameSequence:
    """The point clouds of one camera with time stamps, names and camera pose. Each cloud is loaded on demand."""

    stamps: Array  # (M,), the camera's time stamps in the order of the frames; may be unsorted or repeated [s]
    frame_names: tuple[str, ...]
    camera_pose: Array  # (4, 4), camera (x right, y down, z ahead) in the world [m]
    # from a frame's index to its cloud (N, 3) [m] in the camera's frame; `DataError` if it cannot be read
    load_cloud: Callable[[int], Array]
    intrinsics: CameraIntrinsics | None = None
    source: str = "sequence"  # origin of the frames, for messages
    # from a frame's index to red, green and blue (N, 3) of its points; None if the frame has no colours
    load_colours: Callable[[int], PointColourArray | None] | None = None

    def __len__(self) -> int:
        return len(self.frame_names)


def look_at_pose(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """Return the pose (4, 4) [m] of a camera at `eye` that looks at `target`, with axes x right, y down, z forward."""
    ahead = np.asarray(target, float) - np.asarray(eye, float)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, np.asarray(up, float))
    right /= np.linalg.norm(right)
    return homogeneous_transform(np.column_stack([right, np.cross(ahead, right), ahead]), eye)


def validated_camera_pose(pose: ArrayLike | None, where: str) -> Array:
    """Check and return a camera pose (4, 4). Raises `DataError` if it is missing or not a rigid transform."""
    try:
        matrix = np.asarray(pose, float)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    good = matrix.shape == (4, 4) and np.isfinite(matrix).all() and np.allclose(matrix[3], [0, 0, 0, 1])
    turn = matrix[:3, :3] if good else -np.eye(3)
    if not (np.allclose(turn.T @ turn, np.eye(3), atol=1e-4) and np.linalg.det(turn) > 0):
        fault = "not a rigid transform of shape (4, 4)" if matrix.size else "not a matrix of numbers"
        what = f"the pose of the camera is {'missing' if pose is None else fault}"
        allowed = "4x4 from camera (x right, y down, z forward) to world [m]: orthonormal axes, last row 0, 0, 0, 1"
        hint = "set track.camera_pose (in Python: pose=), or, for a folder of frames, `pose` in its camera.json"
        raise DataError(what, where=where, allowed=allowed, hint=hint)
    return matrix


_MAX_STEREO_BASELINE = 0.1  # [m]; between the camera's two eyes, of which no usual depth camera has a wider one
_MAX_EDGE_POINTS = 24  # largest number of points near a narrow passage
_NARROWEST_RATIO = 0.8  # times the narrowest place, up to which what is sorted stays enough
_SORTED_MARGIN = 0.02  # sorted region of the image beyond the requested one, as x/z
_DECIDING_FRACTION = 0.5  # fraction of the points in a direction that decides
# of a picture: width of the strip along a side, and the pieces of it, half of them filled
_EDGE_STRIP_WIDTH, _EDGE_STRIP_PIECES = 0.02, 20
_MIN_PICTURE_WIDTH = 0.3  # smallest image width, as x/z; a narrower cloud is a cut-out
_MIN_DEPTH = 0.05  # smallest depth in front of the camera [m]


@dataclass(frozen=True, eq=False)
class OcclusionMap:
    """A map of the regions that surfaces in a frame hide, computed from all measured points."""

    points: Array  # (N, 3), in the world, before filtering [m]
    camera_pose: Array  # (4, 4), camera (x right, y down, z ahead) in the world
    intrinsics: CameraIntrinsics | None = None  # without it, points along most of a side define the image border
    # (M, 3), points near later queries, so that occluders are sorted only once [m]
    expected_points: Array | None = None
    _kept: list[tuple[Array, Array, float, cKDTree, Array]] = field(default_factory=list, repr=False)

    def occluded_position_mask(self, places: Array, radius: Array, margin: float) -> BoolArray:
        """Return the mask (S,) of world positions (S, 3) that are hidden or shadowed by a surface, or out of the image.

        A surface occludes a position if it is nearer to the camera by more than `radius` (S,) plus `margin` [m].
        `radius` is also the extent of the position across the line of sight.
        """
        seen, depth = _picture(places, self.camera_pose)
        asked, wide = seen.T, radius / np.maximum(depth, _MIN_DEPTH)
        if self.intrinsics is not None:
            lens, room = self.intrinsics, 0 * wide[:, None]
            last = np.array([lens.width - 1, lens.height - 1])
            low, high = ((edge - [lens.cx, lens.cy]) / [lens.fx, lens.fy] for edge in (0 * last, last))
        else:
            (low, high), room = self._borders, wide[:, None]
        hidden = (depth < _MIN_DEPTH) | ((asked < low + room) | (asked > high - room)).any(axis=1)
        if hidden.all():
            return hidden
        tree, distance = self._about(asked[~hidden], wide[~hidden])
        for i in np.flatnonzero(~hidden) if len(distance) else ():
            there = distance[tree.query_ball_point(asked[i], wide[i])]
            limit = depth[i] - radius[i] - margin
            before = len(there) and np.mean(there < limit) > _DECIDING_FRACTION
            hidden[i] = before if len(there) else self._shadowed(tree, distance, asked[i], limit)
        return hidden

    @cached_property
    def _all(self) -> tuple[Array, Array]:
        seen, depth = _picture(self.points, self.camera_pose)
        ahead = depth > _MIN_DEPTH
        return (seen, depth) if ahead.all() else (seen[:, ahead], depth[ahead])

    @cached_property
    def _borders(self) -> Array:
        """Lower and upper image borders, if points along a whole side show them; else infinite."""
        borders = np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
        seen, _ = self._all
        if seen.size:
            low, high = seen.min(1), seen.max(1)
            for axis in range(2 if (high - low > _MIN_PICTURE_WIDTH).all() else 0):
                other = 1 - axis
                for end, value in enumerate((low[axis], high[axis])):
                    strip = np.abs(seen[axis] - value) <= _EDGE_STRIP_WIDTH * (high[axis] - low[axis])
                    along = (seen[other, strip] - low[other]) / max(high[other] - low[other], 1e-12)
                    pieces = np.unique(np.minimum(np.floor(along * _EDGE_STRIP_PIECES), _EDGE_STRIP_PIECES - 1))
                    if len(pieces) / _EDGE_STRIP_PIECES > _DECIDING_FRACTION:
                        borders[end, axis] = value
        return borders

    def _about(self, asked: Array, wide: Array) -> tuple[cKDTree, Array]:
        """Search tree of the image coordinates of measured points near the positions `asked`, and their depths."""
        # distance in the image at which the nearest point can cast a shadow
        shadow, narrow = _MAX_STEREO_BASELINE / float(self._all[1].min(initial=np.inf)), float(wide.min())
        reach = max(float(wide.max()), shadow)
        low, high = asked.min(0) - reach, asked.max(0) + reach
        for lower, upper, least, tree, depth in self._kept:
            if (lower <= low).all() and (upper >= high).all() and narrow >= least:
                return tree, depth
        if self.expected_points is not None and len(self.expected_points):
            likely = _picture(self.expected_points, self.camera_pose)[0]
            low, high = np.minimum(low, likely.min(1) - reach), np.maximum(high, likely.max(1) + reach)
        low, high = low - _SORTED_MARGIN, high + _SORTED_MARGIN
        seen, depth = self._all
        near = np.flatnonzero(((seen >= low[:, None]) & (seen <= high[:, None])).all(axis=0))
        narrow *= _NARROWEST_RATIO
        about = len(near) * math.pi * narrow**2 / float(np.prod(high - low))
        near = near[:: max(1, int(about / _MAX_EDGE_POINTS))]
        tree = cKDTree(seen.take(near, axis=1).T, leafsize=64, compact_nodes=False, balanced_tree=False)
        self._kept.append((low, high, narrow, tree, depth[near]))
        return tree, depth[near]

    @staticmethod
    def _shadowed(tree: cKDTree, distance: Array, asked: Array, limit: float) -> bool:
        """Whether a nearer surface hides a position from the depth camera's projector or second lens."""
        nearest = max(float(distance.min()), _MIN_DEPTH)
        widest = _MAX_STEREO_BASELINE * (1.0 / nearest - 1.0 / limit) if limit > 0 else 0.0
        if widest <= 0:
            return False
        around = np.asarray(tree.query_ball_point(asked, widest), dtype=np.int64)
        around = around[distance[around] < limit]
        apart = np.linalg.norm(tree.data[around] - asked, axis=1)
        return bool((apart <= _MAX_STEREO_BASELINE * (1.0 / distance[around] - 1.0 / limit)).any())


def _picture(points: Array, pose: Array) -> tuple[Array, Array]:
    """Image coordinates x/z and y/z (2, N) of points, and their depth z [m]."""
    local = pose[:3, :3].T @ points.T
    local -= (pose[:3, :3].T @ pose[:3, 3])[:, None]
    local[:2] /= np.maximum(local[2], _MIN_DEPTH)
    return local[:2], local[2]

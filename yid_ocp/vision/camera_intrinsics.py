"""Intrinsics of a depth camera: from a depth image to points, with the distortion of its lens.

With x = X/Z, y = Y/Z, r^2 = x^2 + y^2 and theta = atan r, a point appears at u = fx x' + cx, v = fy y' + cy, where

    plumb_bob, rational    x' = c x + 2 p1 x y + p2 (r^2 + 2 x^2),  y' = c y + p1 (r^2 + 2 y^2) + 2 p2 x y,
                           c = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
    equidistant            (x', y') = (x, y) theta/r (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)

References
----------
Brown (1971), Photogrammetric Engineering 37:855. Kannala & Brandt (2006), doi:10.1109/TPAMI.2006.153. Names and order
of the coefficients: sensor_msgs/CameraInfo of ROS (REP 104).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.errors import DataError, unknown_name_details

Array = NDArray[np.float64]

_DISTORTION_COEFFICIENT_COUNTS: Mapping[str, tuple[int, ...]] = {
    "plumb_bob": (4, 5),
    "rational_polynomial": (8,),
    "equidistant": (4,),
}
"""Models of distortion, and how many coefficients each may have: k1, k2, p1, p2, k3 (k4, k5, k6), or k1 to k4."""
_STEPS = 30  # of the search for a pixel's direction
_CLOSE = 1e-3  # [pixels]


@dataclass(frozen=True)
class CameraIntrinsics:
    """Intrinsics of a camera (x right, y down, z ahead).

    Attributes
    ----------
    width, height : int
        [pixels]
    fx, fy, cx, cy : float
        Focal lengths and principal point [pixels]:  u = fx x/z + cx,  v = fy y/z + cy  without distortion.
    model : str
        Of the lens's distortion, one of `_DISTORTION_COEFFICIENT_COUNTS`.
    coefficients : tuple of float
        Empty for a lens without distortion.

    Raises
    ------
    DataError
        A model that is not known, or coefficients of another number than it has.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "plumb_bob"
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not any(self.coefficients):
            return
        if self.model not in _DISTORTION_COEFFICIENT_COUNTS:
            raise DataError(
                f"the distortion is '{self.model}'",
                where="intrinsics",
                **unknown_name_details(self.model, _DISTORTION_COEFFICIENT_COUNTS),
            )
        count = _DISTORTION_COEFFICIENT_COUNTS[self.model]
        if len(self.coefficients) not in count or not np.isfinite(self.coefficients).all():
            raise DataError(
                f"the distortion '{self.model}' has the coefficients {self.coefficients}",
                where="intrinsics",
                allowed=f"{' or '.join(map(str, count))} numbers",
            )

    @staticmethod
    def from_field_of_view(width: int, height: int, horizontal: float) -> CameraIntrinsics:
        """Intrinsics with square pixels and a centred principal point, from a horizontal field of view [rad]."""
        focal = 0.5 * width / math.tan(0.5 * horizontal)
        return CameraIntrinsics(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))

    @property
    def has_distortion(self) -> bool:
        """Whether the lens has distortion."""
        return any(self.coefficients)

    @property
    def pixel_rays(self) -> Array:
        """Direction of every pixel with z = 1, shape (height, width, 3); NaN where the lens shows none."""
        return _rays(self)

    def project_to_pixels(self, points: ArrayLike) -> Array:
        """Pixels (u, v) at which points of the camera's frame with z > 0, shape (N, 3) [m], appear; shape (N, 2)."""
        seen = np.asarray(points, float)
        x, y = self._distort(seen[:, 0] / seen[:, 2], seen[:, 1] / seen[:, 2])
        return np.stack([self.fx * x + self.cx, self.fy * y + self.cy], axis=1)

    def points_from_depth(self, depth: ArrayLike) -> Array:
        """Points of a depth image in the camera's frame.

        Parameters
        ----------
        depth : array_like, shape (height, width)
            Distance along the optical axis [m]; zero or NaN where nothing was measured.

        Returns
        -------
        ndarray, shape (N, 3)
            [m], row by row.

        Raises
        ------
        DataError
            An image of another size.
        """
        image = np.asarray(depth, float)
        seen = np.flatnonzero(self.is_measured(image))
        # a third of the time that a mask over rows takes
        points = self.pixel_rays.reshape(-1, 3).take(seen, axis=0)
        points *= image.ravel().take(seen)[:, None]
        return points

    def is_measured(self, depth: Array) -> NDArray[np.bool_]:
        """Whether each pixel of a depth image is measured, shape (height, width); `DataError` for another size."""
        if depth.shape != (self.height, self.width):
            raise DataError(f"the depth image has shape {depth.shape}", allowed=f"({self.height}, {self.width})")
        measured = np.isfinite(depth) & (depth > 0)
        return np.asarray(measured & np.isfinite(self.pixel_rays[..., 0])) if self.has_distortion else measured

    def _distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        if not self.has_distortion:
            return x, y
        square = x**2 + y**2
        if self.model == "equidistant":
            radius = np.sqrt(square)
            angle = np.arctan(radius)
            bent = angle * (1 + sum(k * angle ** (2 * n) for n, k in enumerate(self.coefficients, start=1)))
            factor = np.where(radius > 1e-9, bent / np.maximum(radius, 1e-9), 1.0)
            return x * factor, y * factor
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.coefficients, *[0.0] * (8 - len(self.coefficients)))
        above = 1 + square * (k1 + square * (k2 + square * k3))
        factor = above / (1 + square * (k4 + square * (k5 + square * k6)))
        return (
            x * factor + 2 * p1 * x * y + p2 * (square + 2 * x**2),
            y * factor + p1 * (square + 2 * y**2) + 2 * p2 * x * y,
        )


@lru_cache(maxsize=4)
def _rays(lens: CameraIntrinsics) -> Array:
    u, v = np.meshgrid(np.arange(lens.width, dtype=float), np.arange(lens.height, dtype=float))
    made = np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones(u.shape)], axis=-1)
    if lens.has_distortion:
        made[..., 0], made[..., 1] = _straightened(lens, made[..., 0].copy(), made[..., 1].copy())
    made.setflags(write=False)
    return made


def _straightened(lens: CameraIntrinsics, aim_x: Array, aim_y: Array) -> tuple[Array, Array]:
    """Where  distort(x, y) = aim, by Newton's method; NaN where the lens's formula does not reach."""
    x, y = aim_x, aim_y
    if lens.model == "equidistant":  # the aim is an angle, which is nearer to the answer as one
        bent = np.maximum(np.hypot(aim_x, aim_y), 1e-9)
        x, y = (aim * np.tan(np.minimum(bent, 1.5)) / bent for aim in (aim_x, aim_y))
    with np.errstate(all="ignore"):
        for _ in range(_STEPS):
            change_x, change_y, turn = _newton(lens, x, y, aim_x, aim_y)
            x, y = x + change_x, y + change_y
        seen_x, seen_y = lens._distort(x, y)
        off = np.hypot((seen_x - aim_x) * lens.fx, (seen_y - aim_y) * lens.fy)
        # beyond where a formula turns back, its other solutions are behind the edge or mirrored
        good = (off < _CLOSE) & (turn > 0) & (x * aim_x + y * aim_y >= 0)
    return np.where(good, x, np.nan), np.where(good, y, np.nan)


def _newton(lens: CameraIntrinsics, x: Array, y: Array, aim_x: Array, aim_y: Array) -> tuple[Array, Array, Array]:
    """A step, and the determinant of the derivatives, by differences."""
    h = 1e-6
    at_x, at_y = lens._distort(x, y)
    right_x, right_y = lens._distort(x + h, y)
    down_x, down_y = lens._distort(x, y + h)
    a, b, c, d = (right_x - at_x) / h, (down_x - at_x) / h, (right_y - at_y) / h, (down_y - at_y) / h
    error_x, error_y = aim_x - at_x, aim_y - at_y
    turn = a * d - b * c
    return (d * error_x - b * error_y) / turn, (a * error_y - c * error_x) / turn, turn


XTION_INTRINSICS = CameraIntrinsics.from_field_of_view(640, 480, math.radians(58.0))
"""The depth camera of the Asus Xtion Pro Live: 640 x 480 pixels, 58 degrees wide."""

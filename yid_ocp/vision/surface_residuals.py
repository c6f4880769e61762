"""Distances of points from the tubes' surface and their derivatives, by two measures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yid_ocp.vision.shape_evidence import faces_away_from_camera, nearest_on_tubes

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_RIM = 0.85  # of the radius to either side, within which a tube's depth is compared


@dataclass(frozen=True, eq=False)
class SurfaceResiduals:
    """Signed distances of points from the tubes' surface, with derivatives.

    Attributes
    ----------
    point_indices : ndarray of int, shape (M,)
        Of the points that are compared.
    link_indices : ndarray of int, shape (M,)
    signed_distance : ndarray, shape (M,)
        Positive outside of the surface [m].
    jacobian_by_link_ends : ndarray, shape (M, 6)
        Derivative by the start and the end of the link's centre line.
    derivative_by_radius : ndarray, shape (M,)
        By the radius of the tube.
    """

    point_indices: Integers
    link_indices: Integers
    signed_distance: Array
    jacobian_by_link_ends: Array
    derivative_by_radius: Array


def nearest_surface_residuals(
    corners: Array, radius: Array, points: Array, camera: Array, share: float = 1.0
) -> SurfaceResiduals:
    """Residuals along the nearest way to the surface,  e = |p - c| - f r.

    Parameters
    ----------
    corners : ndarray, shape (K, 2, 3)
        [m]
    radius : ndarray, shape (K,)
        [m]
    points : ndarray, shape (N, 3)
        [m]
    camera : ndarray, shape (3,)
        [m]; a point that only the far side of a tube is near to counts from the near side.
    share : float
        f, of the radius, at which points lie.
    """
    link, along, normal, distance = nearest_on_tubes(corners, radius, points, share)
    sign = np.where(faces_away_from_camera(normal, points - camera), -1.0, 1.0)
    error = sign * distance - share * radius[link]
    # e falls as the centre line moves along the normal: de = -n'((1 - t) da + t db)
    direction = -sign[:, None] * normal
    rows = np.concatenate([direction * (1 - along)[:, None], direction * along[:, None]], axis=1)
    return SurfaceResiduals(np.arange(len(points)), link, error, rows, np.full(len(points), -share))


def line_of_sight_residuals(corners: Array, radius: Array, points: Array, camera: Array) -> SurfaceResiduals:
    """Residuals along the lines of sight, where the camera's noise is; parameters as of `nearest_surface_residuals`.

    Across the sight a point stands where its pixel does, by u from the axis; towards the camera the surface lies at
    sqrt(r^2 - u^2). The nearest way turns with the noise, which does little to where a tube is found, but makes it
    appear thinner by several times noise^2/r. Points near the rim, where depth says little, are not compared.
    """
    link, along, normal, distance = nearest_on_tubes(corners, radius, points)
    edge = corners[:, 1] - corners[:, 0]
    axis = (edge / np.linalg.norm(edge, axis=1)[:, None])[link]
    sight = camera - points
    front = sight - np.einsum("ij,ij->i", sight, axis)[:, None] * axis
    front /= np.maximum(np.linalg.norm(front, axis=1), 1e-12)[:, None]
    side = np.cross(axis, front)
    offset = normal * distance[:, None]
    across = np.einsum("ij,ij->i", offset, side)
    index = np.flatnonzero((np.abs(across) < _RIM * radius[link]) & (along > 0) & (along < 1))
    link, along, front, side, across = link[index], along[index], front[index], side[index], across[index]
    deep = np.sqrt(radius[link] ** 2 - across**2)
    error = np.einsum("ij,ij->i", offset[index], front) - deep
    direction = -front - (across / deep)[:, None] * side
    rows = np.concatenate([direction * (1 - along)[:, None], direction * along[:, None]], axis=1)
    return SurfaceResiduals(index, link, error, rows, -radius[link] / deep)

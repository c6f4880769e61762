"""Result of one frame's shape fit: shape, uncertainty and quality measures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yid_ocp.vision.shape_evidence import ForeignCluster

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DimensionEquations:
    """Quadratic cost of the tubes' dimensions in one frame, minimised over the bends.

    The sizes are the logarithms of all lengths and then of all radii, segment by segment, relative to the values of the
    fit. About these the least cost is  g'x + x'Sx/2.

    Attributes
    ----------
    gradient : ndarray, shape (2 s,)
    hessian : ndarray, shape (2 s, 2 s)
    point_jacobian : ndarray, shape (np, 3, 2 s)
        How the system's points move with them [m].
    """

    gradient: Array
    hessian: Array
    point_jacobian: Array


@dataclass(frozen=True, eq=False)
class FrameShapeFit:
    """Fitted shape of one frame with its uncertainty and quality.

    Attributes
    ----------
    q : ndarray, shape (n,)
        Configuration, twists at rest.
    point_positions : ndarray, shape (np, 3)
        The system's points there [m].
    point_std : ndarray, shape (np, 3)
        Standard deviation of each coordinate by the curvature of the cost [m].
    mean_distance : float
        Mean of |e_i| over the points near the shape that belong to no other thing [m].
    noise_std : float
        Standard deviation of e_i of the points on the shape [m].
    covered_fraction, visibly_empty_fraction : ndarray, shape (K,)
        Share of each link's length on which there are points, and on which the camera sees that there are none.
    is_point_seen : ndarray of bool, shape (np,)
        Whether there are points enough about each of the system's points, or a gripper that holds it.
    grasp_gaps : ndarray, shape (grasps, 3)
        From what each gripper holds to the gripper [m].
    end_offsets : ndarray, shape (E,)
        By how much each free tube's end lies further along than the shape has it, NaN where that is not seen [m].
    contested_fraction : float
        Share of the points on the shape that may belong to a thing which touches it; they are left out.
    foreign_clusters : tuple of Thing
        What else there is.
    dimension_equations : SizeRows
        What the frame says of lengths and radii.
    n_iterations : int
    link_ends : ndarray, shape (K, 2, 3)
        Start and end of every link [m].
    """

    q: Array
    point_positions: Array
    point_std: Array
    mean_distance: float
    noise_std: float
    covered_fraction: Array
    visibly_empty_fraction: Array
    is_point_seen: NDArray[np.bool_]
    grasp_gaps: Array
    end_offsets: Array
    contested_fraction: float
    foreign_clusters: tuple[ForeignCluster, ...]
    dimension_equations: DimensionEquations
    n_iterations: int
    link_ends: Array

    @property
    def visible_coverage(self) -> float:
        """Fraction of the shape's visible length that has points."""
        lengths = np.linalg.norm(self.link_ends[:, 1] - self.link_ends[:, 0], axis=1)
        there, bare = float(lengths @ self.covered_fraction), float(lengths @ self.visibly_empty_fraction)
        return there / max(there + bare, 1e-12)

"""Result of one frame's shape fit: shape, uncertainty and quality measures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yid_ocp.vision.evidence import Thing

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SizeRows:
    """Quadratic cost of the tubes' dimensions in one frame, minimised over the bends.

    The sizes are the logarithms of all lengths and then of all radii, segment by segment, relative to the values of the
    fit. About these the least cost is  g'x + x'Sx/2.

    Attributes
    ----------
    gradient : ndarray, shape (2 s,)
    curvature : ndarray, shape (2 s, 2 s)
    points : ndarray, shape (np, 3, 2 s)
        How the system's points move with them [m].
    """

    gradient: Array
    curvature: Array
    points: Array


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted shape of one frame with its uncertainty and quality.

    Attributes
    ----------
    q : ndarray, shape (n,)
        Configuration, twists at rest.
    points : ndarray, shape (np, 3)
        The system's points there [m].
    std : ndarray, shape (np, 3)
        Standard deviation of each coordinate by the curvature of the cost [m].
    distance : float
        Mean of |e_i| over the points near the shape that belong to no other thing [m].
    noise : float
        Standard deviation of e_i of the points on the shape [m].
    filled, empty : ndarray, shape (K,)
        Share of each link's length on which there are points, and on which the camera sees that there are none.
    seen : ndarray of bool, shape (np,)
        Whether there are points enough about each of the system's points, or a gripper that holds it.
    gap : ndarray, shape (grasps, 3)
        From what each gripper holds to the gripper [m].
    ends : ndarray, shape (E,)
        By how much each free tube's end lies further along than the shape has it, NaN where that is not seen [m].
    contested : float
        Share of the points on the shape that may belong to a thing which touches it; they are left out.
    things : tuple of Thing
        What else there is.
    sizes : SizeRows
        What the frame says of lengths and radii.
    iterations : int
    centre_line : ndarray, shape (K, 2, 3)
        Start and end of every link [m].
    """

    q: Array
    points: Array
    std: Array
    distance: float
    noise: float
    filled: Array
    empty: Array
    seen: NDArray[np.bool_]
    gap: Array
    ends: Array
    contested: float
    things: tuple[Thing, ...]
    sizes: SizeRows
    iterations: int
    centre_line: Array

    @property
    def covered(self) -> float:
        """Fraction of the shape's visible length that has points."""
        lengths = np.linalg.norm(self.centre_line[:, 1] - self.centre_line[:, 0], axis=1)
        there, bare = float(lengths @ self.filled), float(lengths @ self.empty)
        return there / max(there + bare, 1e-12)

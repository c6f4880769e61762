"""Lengths of edges between measured points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from yid_ocp.data.recording import Recording
from yid_ocp.errors import DataError, nearest_name_hint

Array = NDArray[np.float64]


def median_edge_lengths(
    edges: Sequence[tuple[str, str]], recordings: Sequence[Recording], frames: int | None = None
) -> dict[tuple[str, str], float]:
    """Median over recordings of the mean measured length of every edge [m].

    Parameters
    ----------
    edges : sequence of (str, str)
        Names of the two points of each.
    recordings : sequence of Recording
    frames : int, optional
        Use only that many frames from the start of each.

    Raises
    ------
    DataError
        No recording, or an edge that none of them ever shows.
    """
    result: dict[tuple[str, str], float] = {}
    for edge in edges:
        seen = []
        for recording in recordings:
            difference = (
                _measured_positions(recording, edge[1])[:frames] - _measured_positions(recording, edge[0])[:frames]
            )
            length = np.linalg.norm(difference, axis=1)
            if np.any(np.isfinite(length)):
                seen.append(float(np.nanmean(length)))
        if not seen:
            raise DataError(f"edge {edge[0]} to {edge[1]} is never seen", hint="give recordings in which it is")
        result[edge] = float(np.median(seen))
    return result


def _measured_positions(recording: Recording, point: str) -> Array:
    """Measured positions of a point, shape (M, 3) [m], NaN where it was not seen."""
    for group in recording.points:
        if point in group.names:
            return group.position[:, group.names.index(point)]
    raise DataError(
        f"point '{point}' is not recorded", where=recording.name, hint=nearest_name_hint(point, recording.point_names)
    )

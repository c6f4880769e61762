from __future__ import annotations

import numpy as np
import pytest

from yid_ocp.data.channel_checks import _measured_positions, median_point_pair_distances
from yid_ocp.data.recording import PointGroup, Recording
from yid_ocp.errors import DataError


def stretched(lengths: list[float], name: str = "r") -> Recording:
    """Two points that are so far apart in each frame."""
    position = np.zeros((len(lengths), 2, 3))
    position[:, 1, 0] = lengths
    return Recording(points=(PointGroup("points", ("a", "b"), np.arange(len(lengths)), position),), name=name)


def test_lengths_are_means_over_frames_and_medians_over_recordings() -> None:
    recordings = [stretched([1.0, 2.0, np.nan]), stretched([5.0]), stretched([3.0, 3.0])]
    assert median_point_pair_distances([("a", "b")], recordings) == {("a", "b"): 3.0}
    assert median_point_pair_distances([("a", "b")], recordings[:1], frames=1) == {("a", "b"): 1.0}


def test_a_recording_that_never_shows_an_edge_does_not_count() -> None:
    hidden, seen = stretched([np.nan]), stretched([2.0])
    assert median_point_pair_distances([("a", "b")], [hidden, seen]) == {("a", "b"): 2.0}
    with pytest.raises(DataError, match="edge a to b is never seen"):
        median_point_pair_distances([("a", "b")], [hidden])


def test_measured_positions_are_those_of_the_group() -> None:
    assert np.array_equal(_measured_positions(stretched([4.0]), "b"), [[4.0, 0.0, 0.0]])
    with pytest.raises(DataError, match="point 'c' is not recorded") as caught:
        _measured_positions(stretched([4.0], "run"), "c")
    assert caught.value.where == "run"

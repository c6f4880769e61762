from __future__ import annotations

import numpy as np
import pytest

from yid_ocp.vision import CameraIntrinsics
from yid_ocp.vision.frames import OcclusionMap

POSE = np.eye(4)  # at the origin, looking along z
PLACE, RADIUS = np.array([[0.0, 0.0, 2.0]]), np.array([0.02])


def patch(centre, size, step=0.004):
    """Points of an upright square."""
    across = np.arange(-size / 2, size / 2, step)
    x, y = np.meshgrid(across, across)
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) + centre


@pytest.mark.parametrize(
    ("points", "hidden"),
    [
        (patch([0.0, 0.0, 3.0], 1.0), False),  # looked through, on what is behind
        (patch([0.0, 0.0, 1.0], 0.1), True),  # something before it
        (patch([0.0, 0.0, 1.99], 0.1), False),  # its own surface
        (patch([0.4, 0.0, 3.0], 0.1), False),  # nothing in that direction
        (patch([-0.04, 0.0, 1.0], 0.05), True),  # in the shadow of something beside the line of sight
        (patch([-0.2, 0.0, 1.0], 0.05), False),  # too far beside it for a shadow
        (patch([-0.072, 0.0, 0.4], 0.02), True),  # the nearer it is, the further its shadow falls
    ],
)
def test_a_place_without_points_is_hidden_or_empty(points, hidden):
    assert OcclusionMap(points, POSE).is_hidden(PLACE, RADIUS, 0.01).tolist() == [hidden]
    # what is expected to be asked about saves work and changes nothing
    for expected in (PLACE, PLACE + 0.3, np.empty((0, 3))):
        assert OcclusionMap(points, POSE, expected_points=expected).is_hidden(PLACE, RADIUS, 0.01).tolist() == [hidden]


def test_nothing_is_seen_beside_the_picture():
    camera = CameraIntrinsics(320, 240, 300.0, 300.0, 159.5, 119.5)
    behind = patch([0.0, 0.0, 4.0], 1.0)
    places = np.array([[0.0, 0.0, 2.0], [1.2, 0.0, 2.0], [0.0, 0.0, -1.0]])
    assert OcclusionMap(behind, POSE, camera).is_hidden(places, np.full(3, 0.02), 0.01).tolist() == [False, True, True]


def test_the_picture_ends_where_points_stand_along_its_side():
    wall = patch([0.0, 0.0, 4.0], 2.0, 0.02)  # fills the picture, which is 0.5 wide in x/z
    places = np.array([[0.2, 0.0, 2.0], [0.6, 0.0, 2.0]])
    radius = np.full(2, 0.02)
    assert OcclusionMap(wall, POSE).is_hidden(places, radius, 0.01).tolist() == [False, True]
    # a cloud of the object alone has no such side: what is missing beside it is missing
    rod = np.column_stack([np.linspace(-0.2, 0.2, 200), np.zeros(200), np.full(200, 2.0)])
    assert OcclusionMap(rod, POSE).is_hidden(places, radius, 0.01).tolist() == [False, False]

"""One straight tube before a camera, its points made by hand."""

import numpy as np
import pytest
from smooth_rods import nowhere

from yid_ocp.vision.frames import OcclusionMap
from yid_ocp.vision.shape_evidence import (
    ProcessedFrameCloud,
    TubeLinks,
    fit_quality_and_point_classes,
    nearest_surface_residuals,
    surface_residuals_along_sight,
    tube_like_node_and_point_masks,
)

CAMERA = np.zeros(3)
RADIUS, NEAR = 0.02, 0.045
TUBES = TubeLinks(
    np.array([[[-0.3, 0.0, 2.0], [0.0, 0.0, 2.0]], [[0.0, 0.0, 2.0], [0.3, 0.0, 2.0]]]),
    np.array([RADIUS, RADIUS]),
    (1,),
    np.array([0.6, 0.6]),
)


def tube(low=-0.3, high=0.3, radius=RADIUS, wide=1.0, noise=0.002, seed=0):
    """Points on the camera's side, as pixels fall on it: evenly along and across."""
    rng = np.random.default_rng(seed)
    along, across = np.meshgrid(np.arange(low, high, 0.004), radius * (np.arange(-4, 5) / 4.5))
    depth = 2.0 - np.sqrt(radius**2 - across**2) + noise * rng.standard_normal(across.shape)
    return np.column_stack([along.ravel(), wide * across.ravel(), depth.ravel()])


def wall(x, y, z, step=0.006):
    across = np.meshgrid(np.arange(*x, step), np.arange(*y, step))
    return np.column_stack([across[0].ravel(), across[1].ravel(), np.full(across[0].size, z)])


def asked(points, behind=None, removed=nowhere):
    view = OcclusionMap(points if behind is None else np.concatenate([points, behind]), np.eye(4))
    return fit_quality_and_point_classes(
        TUBES, ProcessedFrameCloud(points, np.ones(len(points)), points[::50], CAMERA, view, removed), NEAR
    )


def test_a_whole_tube_has_points_everywhere_and_nothing_else():
    found = asked(tube())
    assert found.covered_fraction.tolist() == [1.0, 1.0]
    assert found.visibly_empty_fraction.tolist() == [0.0, 0.0]
    assert not found.foreign_clusters
    assert not found.is_contested.any()
    assert found.end_offsets == pytest.approx([0.0], abs=0.006)
    assert found.mean_distance < 0.003
    assert found.noise_std == pytest.approx(0.002, rel=0.4)


def test_a_gap_is_empty_unless_something_hides_it():
    points = np.concatenate([tube(high=-0.25), tube(low=-0.05)])
    bare = asked(points)
    assert bare.visibly_empty_fraction[0] == pytest.approx(0.6, abs=0.11)
    assert bare.covered_fraction_of_visible_length(np.array([1.0, 0.0])) <= 0.5
    before = asked(points, wall((-0.2, 0.0), (-0.05, 0.05), 1.2))
    assert before.visibly_empty_fraction[0] == 0.0
    assert before.covered_fraction_of_visible_length(np.array([1.0, 0.0])) == 1.0
    assert before.covered_fraction[0] <= 0.5
    assert asked(points, removed=lambda places: places[:, 0] < 0.0).visibly_empty_fraction[0] == 0.0


@pytest.mark.parametrize("high", [0.2, 0.26, 0.36, 0.45])
def test_where_the_points_end(high):
    """Along a tube that is shorter or longer than the shape."""
    assert asked(tube(high=high)).end_offsets == pytest.approx([high - 0.3], abs=0.008)


def test_an_end_that_is_hidden_or_contested_tells_nothing():
    assert np.isnan(asked(tube(high=0.2), wall((0.05, 0.2), (-0.05, 0.05), 1.2)).end_offsets).all()
    touching = wall((0.22, 0.45), (-0.2, 0.2), 1.985)
    assert np.isnan(asked(np.concatenate([tube(high=0.22), touching])).end_offsets).all()


def test_things_are_set_apart_and_contested_only_where_they_touch():
    apart = asked(np.concatenate([tube(), wall((-0.3, 0.3), (0.1, 0.3), 2.0)]))
    [thing] = apart.foreign_clusters
    assert thing.centre == pytest.approx([0.0, 0.2, 2.0], abs=0.02)
    assert thing.extent == pytest.approx([0.6, 0.2, 0.0], abs=0.02)
    assert not apart.is_contested.any()
    # a hand about the tube's start
    points = np.concatenate([tube(low=-0.2), wall((-0.3, -0.2), (-0.1, 0.1), 1.985)])
    held = asked(points)
    assert held.is_contested[points[:, 0] < -0.17].sum() > 50
    assert not held.is_contested[points[:, 0] > 0.0].any()
    # on a wall all of it
    around = wall((-0.3, 0.3), (-0.2, 0.2), 1.985)
    assert asked(np.concatenate([tube(), around[np.abs(around[:, 1]) > RADIUS]])).covered_fraction.max() == 0.0


def test_points_on_a_swath_are_wider_than_the_tube_and_tubes_are_slender():
    assert (asked(tube()).excess_variance < (0.1 * RADIUS) ** 2).all()
    blurred = asked(tube(wide=1.8))
    assert np.sqrt(blurred.excess_variance) == pytest.approx(RADIUS * np.sqrt((1.8**2 - 1) / 3), rel=0.15)
    points = np.concatenate([tube(), wall((-0.3, 0.3), (0.3, 0.6), 2.0)])
    nodes = np.array([[-0.1, 0.0, 1.985], [0.1, 0.0, 1.985], [0.0, 0.45, 2.0]])
    cloud = ProcessedFrameCloud(points, np.ones(len(points)), nodes, CAMERA, OcclusionMap(points, np.eye(4)), nowhere)
    thin, mine = tube_like_node_and_point_masks(cloud, RADIUS)
    assert thin.tolist() == [True, True, False]
    assert mine.sum() == len(tube())


@pytest.mark.parametrize("ask", [nearest_surface_residuals, surface_residuals_along_sight])
def test_residuals_move_as_their_derivatives_say(ask):
    points = tube(noise=0.003)[::7]
    base = ask(TUBES.link_ends, TUBES.radius, points, CAMERA)
    step = 1e-6
    for corner in range(2):
        for axis in range(3):
            moved = TUBES.link_ends.copy()
            moved[:, corner, axis] += step
            other = ask(moved, TUBES.radius, points, CAMERA)
            both, here, there = np.intersect1d(base.point_indices, other.point_indices, return_indices=True)
            same = base.link_indices[here] == other.link_indices[there]
            # lines of sight turn a little about an axis that tilts: of the order of the noise
            change = (other.signed_distance[there] - base.signed_distance[here])[same] / step
            assert len(both) > 50
            assert change == pytest.approx(base.jacobian_by_link_ends[here, 3 * corner + axis][same], abs=0.12)
    grown = ask(TUBES.link_ends, TUBES.radius + step, points, CAMERA)
    _, here, there = np.intersect1d(base.point_indices, grown.point_indices, return_indices=True)
    assert (grown.signed_distance[there] - base.signed_distance[here]) / step == pytest.approx(
        base.derivative_by_radius[here], abs=1e-4
    )


def test_noise_along_the_sight_leaves_the_radius():
    """The mean error of a tube of the right radius is nothing along the sight; the nearest way it is not."""
    points = np.concatenate([tube(noise=0.005, seed=seed) for seed in range(8)])
    found = surface_residuals_along_sight(TUBES.link_ends, TUBES.radius, points, CAMERA)
    assert abs(found.signed_distance.mean()) < 0.0004

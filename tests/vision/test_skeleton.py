from __future__ import annotations

import numpy as np

from yid_ocp.vision import SkeletonOptions
from yid_ocp.vision.point_cloud import WeightedCloud, extract_skeleton

FOOT, FORK = np.zeros(3), np.array([0.0, 0.0, 0.8])
ENDS = (np.array([0.0, 0.4, 1.2]), np.array([0.0, -0.5, 1.3]))
BONES = ((FOOT, FORK), (FORK, ENDS[0]), (FORK, ENDS[1]))


def letter(seed=0, count=900, spread=0.008):
    rng = np.random.default_rng(seed)
    parts = []
    for start, end in BONES:
        t = rng.uniform(0, 1, count)
        parts.append(start + t[:, None] * (end - start) + spread * rng.standard_normal((count, 3)))
    points = np.concatenate(parts)
    return WeightedCloud(points, np.ones(len(points)))


def from_bones(points):
    best = np.full(len(points), np.inf)
    for start, end in BONES:
        edge = end - start
        t = np.clip((points - start) @ edge / (edge @ edge), 0, 1)
        best = np.minimum(best, np.linalg.norm(points - start - t[:, None] * edge, axis=1))
    return best


def test_nodes_lie_on_the_centre_lines():
    cloud = letter()
    found = extract_skeleton(cloud, np.random.default_rng(0))
    nodes, label = found.nodes, found.node_of_point
    assert np.median(from_bones(nodes)) < 0.005
    assert from_bones(nodes).max() < 0.02
    assert found.has_skeleton_node.mean() > 0.9
    for i in range(len(nodes)):
        mine = cloud.points[label == i]
        assert len(mine) <= 50
        assert np.allclose(mine.mean(0), nodes[i])


def test_the_walk_begins_at_the_lowest_point():
    nodes = extract_skeleton(letter(), np.random.default_rng(0)).nodes
    assert np.linalg.norm(nodes[0] - FOOT) < 0.05
    # from there it goes on to neighbours
    assert np.linalg.norm(np.diff(nodes[:6], axis=0), axis=1).max() < 0.1


def test_the_same_seed_gives_the_same_nodes_and_another_hardly_others():
    one, two, other = (extract_skeleton(letter(), np.random.default_rng(seed)).nodes for seed in (1, 1, 2))
    assert np.array_equal(one, two)
    assert abs(len(other) - len(one)) < 0.15 * len(one)


def test_the_graph_is_a_tree_along_the_tubes():
    found = extract_skeleton(letter(), np.random.default_rng(0))
    assert len(set(found.component_of_node.tolist())) == 1
    assert len(found.edges) == len(found.nodes) - 1
    middles = found.nodes[found.edges].mean(axis=1)
    assert from_bones(middles).max() < 0.02


def test_two_parts_and_a_stray_heap():
    cloud = letter()
    far = np.random.default_rng(3).normal([0.5, 0.5, 0.5], 0.01, (60, 3))
    near = np.abs(cloud.points[:, 2] - 0.4) > 0.15  # a gap across the trunk
    points = np.concatenate([cloud.points[near], far])
    found = extract_skeleton(WeightedCloud(points, np.ones(len(points))), np.random.default_rng(0))
    assert set(found.component_of_node.tolist()) == {0, 1}
    assert not found.has_skeleton_node[-60:].any()
    weights = np.bincount(found.component_of_node[found.node_of_point[found.has_skeleton_node]])
    assert weights[0] > weights[1]


def test_too_little_gives_nothing():
    few = WeightedCloud(np.random.default_rng(0).uniform(-1, 1, (30, 3)), np.ones(30))
    assert len(extract_skeleton(few, np.random.default_rng(0)).nodes) == 0
    empty = extract_skeleton(WeightedCloud(np.empty((0, 3)), np.empty(0)), np.random.default_rng(0))
    assert len(empty.nodes) == len(empty.edges) == len(empty.node_of_point) == 0


def test_points_at_one_place_do_not_hang_it():
    cloud = WeightedCloud(np.zeros((500, 3)), np.ones(500))
    found = extract_skeleton(cloud, np.random.default_rng(0))
    assert len(found.nodes) == 10
    assert found.has_skeleton_node.all()
    ring = WeightedCloud(
        0.069 * np.column_stack([np.cos(np.arange(40)), np.sin(np.arange(40)), np.zeros(40)]), np.ones(40)
    )
    lonely = SkeletonOptions(neighbour_radius=0.01, min_segment_points=1)
    assert len(extract_skeleton(ring, np.random.default_rng(0), lonely).nodes)

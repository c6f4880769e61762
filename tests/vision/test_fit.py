from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.errors import ConfigError, DataError
from yid_ocp.model.objects.foam_y import y_object
from yid_ocp.model.system import System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.vision import ShapeFitOptions, ShapeFitter
from yid_ocp.vision.fit import _NODE_RADIUS_FRACTION, _Task
from yid_ocp.vision.initial_shapes import EndAnchor
from yid_ocp.vision.shape_evidence import CloudObservation

CAMERA = np.array([2.6, 0.0, 0.45])
NODES = 4  # of every link


@pytest.fixture(scope="module")
def alone():
    """The Y without a robot."""
    return System.build(objects=[(y_object(), None, None)])


def bent(system, seed, size=0.12):
    rng = np.random.default_rng(seed)
    q = np.zeros(system.n_coordinates)
    q[list(ShapeFitter(system).free_joints)] = size * rng.standard_normal(len(ShapeFitter(system).free_joints))
    return q


def seen(shape, q, count=250, noise=0.0, seed=0):
    """Points on the visible side of every link, and nodes where the visible half's mean is."""
    rng = np.random.default_rng(seed)
    points, nodes = [], []
    corners = np.array(shape._corners(q)[0]).reshape(-1, 2, 3)
    for (start, end), radius in zip(corners, shape.link_radii, strict=True):
        axis = (end - start) / np.linalg.norm(end - start)
        middle = 0.5 * (start + end)
        front = CAMERA - middle
        front = front - (front @ axis) * axis
        front /= np.linalg.norm(front)
        side = np.cross(axis, front)
        across = rng.uniform(-1, 1, count)
        around = radius * (across[:, None] * side + np.sqrt(1 - across**2)[:, None] * front)
        points.append(start + rng.uniform(0, 1, count)[:, None] * (end - start) + around)
        for t in (np.arange(NODES) + 0.5) / NODES:
            nodes.append(start + t * (end - start) + _NODE_RADIUS_FRACTION * radius * front)
    cloud = np.concatenate(points)
    sight = cloud - CAMERA
    cloud = cloud + noise * rng.standard_normal(len(cloud))[:, None] * sight / np.linalg.norm(sight, axis=1)[:, None]
    return CloudObservation(cloud, np.ones(len(cloud)), np.array(nodes), CAMERA)


@pytest.mark.parametrize("seed", range(4))
def test_a_shape_is_found_again(alone, seed):
    shape = ShapeFitter(alone)
    q = bent(alone, seed)
    fit = shape.fit_frame(seen(shape, q), np.zeros(alone.n_coordinates))
    assert np.linalg.norm(fit.point_positions - shape.points_at(q), axis=1).max() < 0.002
    assert fit.mean_distance < 0.001
    assert (fit.covered_fraction > 0.9).all()
    assert fit.visible_coverage > 0.98
    assert fit.is_point_seen.all()
    assert not fit.foreign_clusters


def test_twists_stay_at_rest_and_cost_nothing(alone):
    shape = ShapeFitter(alone)
    q = bent(alone, 1)
    twists = [i for i, name in enumerate(alone.mechanism.joint_names) if name.endswith("_z")]
    q[twists] = 0.1
    fit = shape.fit_frame(seen(shape, q), np.zeros(alone.n_coordinates))
    assert np.array_equal(fit.q[twists], np.zeros(len(twists)))
    assert np.linalg.norm(fit.point_positions - shape.points_at(q), axis=1).max() < 0.002


def test_nodes_alone_are_the_papers_fit(alone):
    shape = ShapeFitter(alone, ShapeFitOptions(node_loss_scales=(0.15, 0.05, 0.02), surface_loss_scales=()))
    q = bent(alone, 2, 0.08)
    fit = shape.fit_frame(seen(shape, q), np.zeros(alone.n_coordinates))
    assert np.linalg.norm(fit.point_positions - shape.points_at(q), axis=1).max() < 0.015


def test_surface_and_centre_line_are_told_apart(alone):
    shape = ShapeFitter(alone)
    q = np.zeros(alone.n_coordinates)
    sight = seen(shape, q)
    # with tubes of no thickness the fit would lie on the surface, on the camera's side
    thin = ShapeFitter(alone, values={"T1.radius": 1e-4, "T2.radius": 1e-4, "T3.radius": 1e-4})
    flat = thin.fit_frame(sight, q).point_positions - shape.points_at(q)
    assert 0.012 < flat[0, 0] < 0.04
    assert np.linalg.norm(shape.fit_frame(sight, q).point_positions - shape.points_at(q), axis=1).max() < 0.003


def test_wrong_points_hardly_matter(alone):
    shape = ShapeFitter(alone)
    q = bent(alone, 3)
    clean = seen(shape, q, noise=0.006)
    rng = np.random.default_rng(0)
    wrong = rng.uniform(clean.points.min(0) - 0.1, clean.points.max(0) + 0.1, (len(clean.points) // 4, 3))
    points = np.concatenate([clean.points, wrong])
    nodes = np.concatenate([clean.skeleton_nodes, wrong[:6]])
    mixed = replace(clean, points=points, point_weights=np.ones(len(points)), skeleton_nodes=nodes)
    fit = shape.fit_frame(mixed, np.zeros(alone.n_coordinates))
    assert np.linalg.norm(fit.point_positions - shape.points_at(q), axis=1).max() < 0.006
    assert fit.mean_distance < 0.012
    assert fit.visible_coverage > 0.95


def test_a_heap_beside_it_does_not_count_against_the_fit(alone):
    shape = ShapeFitter(alone)
    clean = seen(shape, np.zeros(alone.n_coordinates))
    heap = np.random.default_rng(0).normal([1.3, 0.5, -0.5], 0.01, (200, 3))
    points = np.concatenate([clean.points, heap])
    both = shape.fit_frame(
        replace(clean, points=points, point_weights=np.ones(len(points))), np.zeros(alone.n_coordinates)
    )
    alone_there = shape.fit_frame(clean, np.zeros(alone.n_coordinates))
    assert both.mean_distance < alone_there.mean_distance + 1e-4
    [thing] = both.foreign_clusters
    assert thing.centre == pytest.approx([1.3, 0.5, -0.5], abs=0.01)
    assert both.contested_fraction == 0.0


def test_a_hidden_branch_is_not_seen(alone):
    shape = ShapeFitter(alone)
    q = bent(alone, 0, 0.05)
    sight = seen(shape, q)
    keep = np.repeat(np.arange(12) < 8, 250)
    hidden = replace(
        sight,
        points=sight.points[keep],
        point_weights=sight.point_weights[keep],
        skeleton_nodes=sight.skeleton_nodes[: 8 * NODES],
    )
    fit = shape.fit_frame(hidden, np.zeros(alone.n_coordinates))
    assert dict(zip(alone.point_frames, fit.is_point_seen.tolist(), strict=True)) == {
        "w_T1": True,
        "w_T2": True,
        "w_T3": False,
    }
    assert np.linalg.norm(fit.point_std[2]) > 3 * np.linalg.norm(fit.point_std[1])


def test_the_gripper_tells_where_the_end_is(system, shape, run):
    q = run.q[150]
    sight = seen(shape, q)
    keep = np.repeat(~np.isin(np.arange(12), (5, 6, 7)), 250)
    nodes = sight.skeleton_nodes[np.repeat(~np.isin(np.arange(12), (5, 6, 7)), NODES)]
    part = replace(sight, points=sight.points[keep], point_weights=sight.point_weights[keep], skeleton_nodes=nodes)
    fit = shape.fit_frame(part, q)
    held = system.point_frames.index("w_T2")
    assert np.linalg.norm(fit.point_positions[held] - shape.points_at(q)[held]) < 0.006
    assert fit.is_point_seen[held]


def test_it_starts_from_where_it_was(alone):
    shape = ShapeFitter(alone)
    q = bent(alone, 5, 0.3)
    sight = seen(shape, q)
    fit = shape.fit_frame(sight, np.zeros(alone.n_coordinates), [q + 0.02])
    assert np.linalg.norm(fit.point_positions - shape.points_at(q), axis=1).max() < 0.004


def test_derivatives_agree_with_differences(system, shape, run):
    q = run.q[200].copy()
    sight = seen(shape, q, 20, noise=0.005)
    seen_end = EndAnchor(3, np.array([0.6, 0.0, 0.8]), np.array([0.1, 0.2, 0.3]), 0.05)
    task = _Task(sight.points, sight.point_weights / 0.006**2, 1.0, 0.03, CAMERA, (seen_end,))
    q[list(shape.free_joints)] += 0.01 * np.random.default_rng(0).standard_normal(len(shape.free_joints))
    model = shape._quadratic(q, task)
    step, differences = 1e-6, []
    for index in shape.free_joints:
        ahead, behind = q.copy(), q.copy()
        ahead[index] += step
        behind[index] -= step
        differences.append((shape._quadratic(ahead, task).cost - shape._quadratic(behind, task).cost) / (2 * step))
    assert np.allclose(model.gradient, differences, rtol=1e-4, atol=1e-4 * np.abs(model.gradient).max())
    assert np.linalg.eigvalsh(model.hessian).min() > 0


def test_without_points_near_it_a_shape_has_its_priors_alone(shape, run):
    nothing = _Task(np.empty((0, 3)), np.empty(0), 1.0, 0.03, CAMERA, ())
    q = run.q[200].copy()
    model = shape._quadratic(q, nothing)
    far = _Task(q[:3] + 100.0 + np.eye(3), np.full(3, 1e-9), 1.0, 0.03, CAMERA, ())
    assert model.cost == pytest.approx(shape._quadratic(q, far).cost, rel=1e-6)
    assert np.linalg.eigvalsh(model.hessian).min() > 0


def test_what_cannot_be_fitted_is_said(alone, urdf_folder):

    with pytest.raises(DataError, match="no object"):
        ShapeFitter(System.build(read_urdf(urdf_folder / "double_pendulum.urdf", parametric=False)))
    nothing = np.empty((0, 3))
    sight = CloudObservation(nothing, np.empty(0), nothing, CAMERA)
    with pytest.raises(DataError, match="no point"):
        ShapeFitter(alone).fit_frame(sight, np.zeros(alone.n_coordinates))
    with pytest.raises(ConfigError, match="surface_noise_std = 0"):
        ShapeFitOptions(surface_noise_std=0.0)
    with pytest.raises(ConfigError, match="no pass"):
        ShapeFitOptions(node_loss_scales=(), surface_loss_scales=())

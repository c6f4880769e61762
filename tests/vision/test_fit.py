from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from smooth_rods import nowhere

from yid_ocp.errors import DataError
from yid_ocp.model.system import System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.vision.fit import ShapeFitter, _Task
from yid_ocp.vision.shape_evidence import ProcessedFrameCloud
from yid_ocp.vision.shape_guesses import ObservedObjectEnd

CAMERA = np.array([2.6, 0.0, 0.45])
NODES = 4  # of every link


def bent(shape, seed, size=0.12):
    q = np.zeros(shape.system.n_coordinates)
    q[list(shape.free_joints)] = size * np.random.default_rng(seed).standard_normal(len(shape.free_joints))
    return q


def seen(shape, q, count=250, noise=0.0, seed=0):
    """Points on the visible side of every link, and nodes where the visible half's mean is."""
    rng = np.random.default_rng(seed)
    points, nodes = [], []
    for (start, end), radius in zip(shape.tube_links_at_configuration(q).link_ends, shape.link_radii, strict=True):
        axis = (end - start) / np.linalg.norm(end - start)
        front = CAMERA - (0.5 * (start + end))
        front = front - (front @ axis) * axis
        front /= np.linalg.norm(front)
        side = np.cross(axis, front)
        across = rng.uniform(-1, 1, count)
        around = radius * (across[:, None] * side + np.sqrt(1 - across**2)[:, None] * front)
        points.append(start + rng.uniform(0, 1, count)[:, None] * (end - start) + around)
        for t in (np.arange(NODES) + 0.5) / NODES:
            nodes.append(start + t * (end - start) + np.pi / 4 * radius * front)
    cloud = np.concatenate(points)
    sight = cloud - CAMERA
    cloud = cloud + noise * rng.standard_normal(len(cloud))[:, None] * sight / np.linalg.norm(sight, axis=1)[:, None]
    view = SimpleNamespace(occluded_position_mask=nowhere)
    return ProcessedFrameCloud(cloud, np.ones(len(cloud)), np.array(nodes), CAMERA, view, nowhere)


@pytest.fixture(scope="module")
def whole(alone):
    """The fitter of the Y without a robot."""
    return ShapeFitter(alone)


def off(fit, shape, q):
    """How far the points are from where they should be [m]."""
    return np.linalg.norm(fit.point_positions - shape.point_positions_at_configuration(q), axis=1).max()


@pytest.mark.parametrize("seed", range(3))
def test_a_shape_is_found_again(whole, seed):
    q = bent(whole, seed)
    fit = whole.fit_frame(seen(whole, q), 0 * q)
    assert off(fit, whole, q) < 0.002
    assert fit.mean_distance < 0.001
    assert (fit.covered_fraction > 0.9).all()
    assert fit.visible_length_coverage > 0.98
    assert fit.is_point_seen.all()
    assert not fit.foreign_clusters


def test_twists_stay_at_rest_and_a_fit_starts_from_where_it_was(alone, whole):
    q = bent(whole, 1)
    twists = [i for i, name in enumerate(alone.mechanism.joint_names) if name.endswith("_z")]
    q[twists] = 0.1
    fit = whole.fit_frame(seen(whole, q), 0 * q)
    assert np.array_equal(fit.q[twists], np.zeros(len(twists)))
    assert off(fit, whole, q) < 0.002
    q = bent(whole, 5, 0.3)
    assert off(whole.fit_frame(seen(whole, q), 0 * q, [q + 0.02]), whole, q) < 0.004


def test_surface_and_centre_line_are_told_apart(alone, whole):
    q = np.zeros(alone.n_coordinates)
    sight = seen(whole, q)
    # with tubes of no thickness the fit would lie on the surface, on the camera's side
    thin = ShapeFitter(alone, values={"T1.radius": 1e-4, "T2.radius": 1e-4, "T3.radius": 1e-4})
    flat = thin.fit_frame(sight, q).point_positions - whole.point_positions_at_configuration(q)
    assert 0.012 < flat[0, 0] < 0.04
    assert off(whole.fit_frame(sight, q), whole, q) < 0.003


def beside(clean, more, nodes=()):
    """What is seen with more points and nodes."""
    points, nodes = np.concatenate([clean.points, more]), np.concatenate([clean.skeleton_nodes, *nodes])
    return replace(clean, points=points, point_weights=np.ones(len(points)), skeleton_nodes=nodes)


def test_wrong_points_hardly_matter(whole):
    q = bent(whole, 3)
    clean = seen(whole, q, noise=0.006)
    rng = np.random.default_rng(0)
    wrong = rng.uniform(clean.points.min(0) - 0.1, clean.points.max(0) + 0.1, (len(clean.points) // 4, 3))
    fit = whole.fit_frame(beside(clean, wrong, [wrong[:6]]), 0 * q)
    assert off(fit, whole, q) < 0.006
    assert fit.mean_distance < 0.012
    assert fit.visible_length_coverage > 0.95


def test_a_heap_beside_it_does_not_count_against_the_fit(alone, whole):
    q = np.zeros(alone.n_coordinates)
    clean = seen(whole, q)
    both = whole.fit_frame(beside(clean, np.random.default_rng(0).normal([1.3, 0.5, -0.5], 0.01, (200, 3))), q)
    assert both.mean_distance < whole.fit_frame(clean, q).mean_distance + 1e-4
    [thing] = both.foreign_clusters
    assert thing.centre == pytest.approx([1.3, 0.5, -0.5], abs=0.01)


def without(sight, links):
    """What is seen without the points and nodes of some links."""
    keep = ~np.isin(np.arange(12), links)
    rows, nodes = np.repeat(keep, len(sight.points) // 12), sight.skeleton_nodes[np.repeat(keep, NODES)]
    return replace(sight, points=sight.points[rows], point_weights=sight.point_weights[rows], skeleton_nodes=nodes)


def test_a_hidden_branch_is_not_seen(alone, whole):
    q = bent(whole, 0, 0.05)
    fit = whole.fit_frame(without(seen(whole, q), (8, 9, 10, 11)), 0 * q)
    assert alone.point_frames == ("w_T1", "w_T2", "w_T3")
    assert fit.is_point_seen.tolist() == [True, True, False]
    assert np.linalg.norm(fit.point_std[2]) > 3 * np.linalg.norm(fit.point_std[1])


def test_the_gripper_tells_where_the_end_is(system, shape, run):
    q = run.q[150]
    fit = shape.fit_frame(without(seen(shape, q), (5, 6, 7)), q)
    held = system.point_frames.index("w_T2")
    assert np.linalg.norm(fit.point_positions[held] - shape.point_positions_at_configuration(q)[held]) < 0.006
    assert fit.is_point_seen[held]


def test_derivatives_agree_with_differences(system, shape, run):
    q = run.q[200].copy()
    sight = seen(shape, q, 20, noise=0.005)
    seen_end = ObservedObjectEnd(3, np.array([0.6, 0.0, 0.8]), np.array([0.1, 0.2, 0.3]), 0.05)
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


def test_what_cannot_be_fitted_is_said(urdf_folder):
    with pytest.raises(DataError, match="no object"):
        ShapeFitter(System.build(read_urdf(urdf_folder / "double_pendulum.urdf")))

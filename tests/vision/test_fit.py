from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.errors import ConfigError, DataError
from yid_ocp.model.system import System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.model.y_object import y_object
from yid_ocp.vision import FitOptions, ShapeFit
from yid_ocp.vision.evidence import Sight
from yid_ocp.vision.fit import NODE_FACTOR, _Task
from yid_ocp.vision.starts import Anchor

CAMERA = np.array([2.6, 0.0, 0.45])
NODES = 4  # of every link


@pytest.fixture(scope="module")
def alone():
    """The Y without a robot."""
    return System.build(objects=[(y_object(), None, None)])


def bent(system, seed, size=0.12):
    rng = np.random.default_rng(seed)
    q = np.zeros(system.size)
    q[list(ShapeFit(system).free)] = size * rng.standard_normal(len(ShapeFit(system).free))
    return q


def seen(shape, q, count=250, noise=0.0, seed=0):
    """Points on the visible side of every link, and nodes where the visible half's mean is."""
    rng = np.random.default_rng(seed)
    points, nodes = [], []
    corners = np.array(shape._corners(q)[0]).reshape(-1, 2, 3)
    for (start, end), radius in zip(corners, shape.radius, strict=True):
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
            nodes.append(start + t * (end - start) + NODE_FACTOR * radius * front)
    cloud = np.concatenate(points)
    sight = cloud - CAMERA
    cloud = cloud + noise * rng.standard_normal(len(cloud))[:, None] * sight / np.linalg.norm(sight, axis=1)[:, None]
    return Sight(cloud, np.ones(len(cloud)), np.array(nodes), CAMERA)


@pytest.mark.parametrize("seed", range(4))
def test_a_shape_is_found_again(alone, seed):
    shape = ShapeFit(alone)
    q = bent(alone, seed)
    fit = shape.solve(seen(shape, q), np.zeros(alone.size))
    assert np.linalg.norm(fit.points - shape.place(q), axis=1).max() < 0.002
    assert fit.distance < 0.001
    assert (fit.filled > 0.9).all()
    assert fit.covered > 0.98
    assert fit.seen.all()
    assert not fit.things


def test_twists_stay_at_rest_and_cost_nothing(alone):
    shape = ShapeFit(alone)
    q = bent(alone, 1)
    twists = [i for i, name in enumerate(alone.mechanism.joint_names) if name.endswith("_z")]
    q[twists] = 0.1
    fit = shape.solve(seen(shape, q), np.zeros(alone.size))
    assert np.array_equal(fit.q[twists], np.zeros(len(twists)))
    assert np.linalg.norm(fit.points - shape.place(q), axis=1).max() < 0.002


def test_nodes_alone_are_the_papers_fit(alone):
    shape = ShapeFit(alone, FitOptions(scales=(0.15, 0.05, 0.02), surface_scales=()))
    q = bent(alone, 2, 0.08)
    fit = shape.solve(seen(shape, q), np.zeros(alone.size))
    assert np.linalg.norm(fit.points - shape.place(q), axis=1).max() < 0.015


def test_surface_and_centre_line_are_told_apart(alone):
    shape = ShapeFit(alone)
    q = np.zeros(alone.size)
    sight = seen(shape, q)
    # with tubes of no thickness the fit would lie on the surface, on the camera's side
    thin = ShapeFit(alone, values={"T1.radius": 1e-4, "T2.radius": 1e-4, "T3.radius": 1e-4})
    flat = thin.solve(sight, q).points - shape.place(q)
    assert 0.012 < flat[0, 0] < 0.04
    assert np.linalg.norm(shape.solve(sight, q).points - shape.place(q), axis=1).max() < 0.003


def test_wrong_points_hardly_matter(alone):
    shape = ShapeFit(alone)
    q = bent(alone, 3)
    clean = seen(shape, q, noise=0.006)
    rng = np.random.default_rng(0)
    wrong = rng.uniform(clean.points.min(0) - 0.1, clean.points.max(0) + 0.1, (len(clean.points) // 4, 3))
    points = np.concatenate([clean.points, wrong])
    nodes = np.concatenate([clean.nodes, wrong[:6]])
    mixed = replace(clean, points=points, weight=np.ones(len(points)), nodes=nodes)
    fit = shape.solve(mixed, np.zeros(alone.size))
    assert np.linalg.norm(fit.points - shape.place(q), axis=1).max() < 0.006
    assert fit.distance < 0.012
    assert fit.covered > 0.95


def test_a_heap_beside_it_does_not_count_against_the_fit(alone):
    shape = ShapeFit(alone)
    clean = seen(shape, np.zeros(alone.size))
    heap = np.random.default_rng(0).normal([1.3, 0.5, -0.5], 0.01, (200, 3))
    points = np.concatenate([clean.points, heap])
    both = shape.solve(replace(clean, points=points, weight=np.ones(len(points))), np.zeros(alone.size))
    alone_there = shape.solve(clean, np.zeros(alone.size))
    assert both.distance < alone_there.distance + 1e-4
    [thing] = both.things
    assert thing.centre == pytest.approx([1.3, 0.5, -0.5], abs=0.01)
    assert both.contested == 0.0


def test_a_hidden_branch_is_not_seen(alone):
    shape = ShapeFit(alone)
    q = bent(alone, 0, 0.05)
    sight = seen(shape, q)
    keep = np.repeat(np.arange(12) < 8, 250)
    hidden = replace(
        sight,
        points=sight.points[keep],
        weight=sight.weight[keep],
        nodes=sight.nodes[: 8 * NODES],
    )
    fit = shape.solve(hidden, np.zeros(alone.size))
    assert dict(zip(alone.points, fit.seen.tolist(), strict=True)) == {"w_T1": True, "w_T2": True, "w_T3": False}
    assert np.linalg.norm(fit.std[2]) > 3 * np.linalg.norm(fit.std[1])


def test_the_gripper_tells_where_the_end_is(system, shape, run):
    q = run.q[150]
    sight = seen(shape, q)
    keep = np.repeat(~np.isin(np.arange(12), (5, 6, 7)), 250)
    nodes = sight.nodes[np.repeat(~np.isin(np.arange(12), (5, 6, 7)), NODES)]
    part = replace(sight, points=sight.points[keep], weight=sight.weight[keep], nodes=nodes)
    fit = shape.solve(part, q)
    held = system.points.index("w_T2")
    assert np.linalg.norm(fit.points[held] - shape.place(q)[held]) < 0.006
    assert fit.seen[held]


def test_it_starts_from_where_it_was(alone):
    shape = ShapeFit(alone)
    q = bent(alone, 5, 0.3)
    sight = seen(shape, q)
    fit = shape.solve(sight, np.zeros(alone.size), [q + 0.02])
    assert np.linalg.norm(fit.points - shape.place(q), axis=1).max() < 0.004


def test_derivatives_agree_with_differences(system, shape, run):
    q = run.q[200].copy()
    sight = seen(shape, q, 20, noise=0.005)
    seen_end = Anchor(3, np.array([0.6, 0.0, 0.8]), np.array([0.1, 0.2, 0.3]), 0.05)
    task = _Task(sight.points, sight.weight / 0.006**2, 1.0, 0.03, CAMERA, (seen_end,))
    q[list(shape.free)] += 0.01 * np.random.default_rng(0).standard_normal(len(shape.free))
    model = shape._quadratic(q, task)
    step, differences = 1e-6, []
    for index in shape.free:
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
        ShapeFit(System.build(read_urdf(urdf_folder / "double_pendulum.urdf", parametric=False)))
    nothing = np.empty((0, 3))
    sight = Sight(nothing, np.empty(0), nothing, CAMERA)
    with pytest.raises(DataError, match="no point"):
        ShapeFit(alone).solve(sight, np.zeros(alone.size))
    with pytest.raises(ConfigError, match="noise = 0"):
        FitOptions(noise=0.0)
    with pytest.raises(ConfigError, match="no pass"):
        FitOptions(scales=(), surface_scales=())

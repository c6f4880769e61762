"""Trees of bodies: hung on frames, merged, given more frames."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from yid_ocp.errors import ModelError
from yid_ocp.model.mechanism import Inertia, merged
from yid_ocp.model.rotations import placement_matrix, transform
from yid_ocp.model.urdf import read_urdf
from yid_ocp.model.y_object import y_object


def numbers(expression) -> np.ndarray:
    return np.array(ca.DM(expression))


def test_joined_mechanisms_hang_on_a_frame(urdf_folder):
    carrier = read_urdf(urdf_folder / "double_pendulum.urdf")
    item = y_object().mechanism
    placement = placement_matrix([0.0, 0.1, 0.0], [0.0, 0.3, 0.0])
    both = carrier.joined(item, "tip", placement)
    assert both.joint_names == (*carrier.joint_names, *item.joint_names)
    assert both.joints[2].parent == 1
    assert both.frames["object_root"].joint == 1
    assert set(both.parameters.names) == {*carrier.parameters.names, *item.parameters.names}
    expected = numbers(carrier.frames["tip"].placement.matrix()) @ placement
    expected = expected @ numbers(item.numeric().joints[0].placement.matrix())
    np.testing.assert_allclose(numbers(both.numeric().joints[2].placement.matrix()), expected, atol=1e-15)


def test_merged_bodies_weigh_what_they_weigh_together():
    rng = np.random.default_rng(1)
    bodies = []
    for _ in range(3):
        root = rng.normal(size=(3, 3))
        bodies.append(Inertia.of(rng.uniform(0.1, 2), rng.normal(size=3), root @ root.T))
    one = merged(bodies)
    masses = np.array([float(b.mass) for b in bodies])
    centres = np.array([numbers(b.com).ravel() for b in bodies])
    assert float(one.mass) == pytest.approx(masses.sum())
    np.testing.assert_allclose(numbers(one.com).ravel(), masses @ centres / masses.sum())

    def about_origin(body):
        c, m = numbers(body.com).ravel(), float(body.mass)
        return numbers(body.about_com) + m * (c @ c * np.eye(3) - np.outer(c, c))

    np.testing.assert_allclose(about_origin(one), sum(about_origin(b) for b in bodies), atol=1e-12)
    assert merged([]) is None
    assert merged([Inertia.of(0.0, np.zeros(3), np.zeros((3, 3)))]) is None


def test_a_frame_that_the_file_does_not_have(urdf_folder):
    robot = read_urdf(urdf_folder / "double_pendulum.urdf", parametric=False)
    at = transform(np.eye(3), [0.1, 0.2, 0.3])
    more = robot.with_frame("load", "tip", at).with_frame("wall", None, at)
    tip, load = more.frame("tip"), more.frame("load")
    assert load.joint == tip.joint
    np.testing.assert_allclose(
        numbers(load.placement.translation - tip.placement.translation),
        numbers(tip.placement.rotation) @ [[0.1], [0.2], [0.3]],
    )
    assert more.frame("wall").joint == -1
    with pytest.raises(ModelError, match="there is a frame 'tip' already"):
        robot.with_frame("tip", None, at)
    with pytest.raises(ModelError, match="no frame 'tips'"):
        robot.with_frame("load", "tips", at)

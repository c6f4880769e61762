"""Trees of bodies: hung on frames, merged, given more frames."""

from __future__ import annotations

import numpy as np
import pytest
from placed_frames import numbers

from yid_ocp.errors import ModelError
from yid_ocp.model.mechanism import Inertia, merge_bodies
from yid_ocp.model.objects.foam_y import foam_y_object
from yid_ocp.model.rotations import homogeneous_transform, transform_from_xyz_rpy
from yid_ocp.model.urdf import read_urdf


def test_joined_mechanisms_hang_on_a_frame(urdf_folder):
    carrier = read_urdf(urdf_folder / "double_pendulum.urdf")
    item = foam_y_object().mechanism
    placement = transform_from_xyz_rpy([0.0, 0.1, 0.0], [0.0, 0.3, 0.0])
    both = carrier.with_attached_mechanism(item, "tip", placement)
    assert both.joint_names == (*carrier.joint_names, *item.joint_names)
    assert both.joints[2].parent_index == 1
    assert both.frames["object_root"].joint_index == 1
    assert set(both.parameters.names) == {*carrier.parameters.names, *item.parameters.names}
    expected = numbers(carrier.frames["tip"].placement.homogeneous_matrix()) @ placement
    expected = expected @ numbers(item.with_numeric_values().joints[0].placement.homogeneous_matrix())
    np.testing.assert_allclose(
        numbers(both.with_numeric_values().joints[2].placement.homogeneous_matrix()), expected, atol=1e-15
    )


def test_merged_bodies_weigh_what_they_weigh_together():
    rng = np.random.default_rng(1)
    bodies = []
    for _ in range(3):
        root = rng.normal(size=(3, 3))
        bodies.append(Inertia.from_values(rng.uniform(0.1, 2), rng.normal(size=3), root @ root.T))
    one = merge_bodies(bodies)
    masses = np.array([float(b.mass) for b in bodies])
    centres = np.array([numbers(b.center_of_mass).ravel() for b in bodies])
    assert float(one.mass) == pytest.approx(masses.sum())
    np.testing.assert_allclose(numbers(one.center_of_mass).ravel(), masses @ centres / masses.sum())

    def about_origin(body):
        c, m = numbers(body.center_of_mass).ravel(), float(body.mass)
        return numbers(body.inertia_about_com) + m * (c @ c * np.eye(3) - np.outer(c, c))

    np.testing.assert_allclose(about_origin(one), sum(about_origin(b) for b in bodies), atol=1e-12)
    assert merge_bodies([]) is None
    assert merge_bodies([Inertia.from_values(0.0, np.zeros(3), np.zeros((3, 3)))]) is None


def test_a_frame_that_the_file_does_not_have(urdf_folder):
    robot = read_urdf(urdf_folder / "double_pendulum.urdf").with_numeric_values()
    at = homogeneous_transform(np.eye(3), [0.1, 0.2, 0.3])
    more = robot.with_added_frame("load", "tip", at).with_added_frame("wall", None, at)
    tip, load = more.frame("tip"), more.frame("load")
    assert load.joint_index == tip.joint_index
    np.testing.assert_allclose(
        numbers(load.placement.translation - tip.placement.translation),
        numbers(tip.placement.rotation) @ [[0.1], [0.2], [0.3]],
    )
    assert more.frame("wall").joint_index == -1
    with pytest.raises(ModelError, match="there is a frame 'tip' already"):
        robot.with_added_frame("tip", None, at)
    with pytest.raises(ModelError, match="no frame 'tips'"):
        robot.with_added_frame("load", "tips", at)

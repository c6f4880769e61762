"""The paper's Y: its numbers, where it stands, the file that is checked in."""

from __future__ import annotations

import math

import numpy as np
from placed_frames import numbers, positions

from yid_ocp.model import flexible_object
from yid_ocp.model.objects.foam_y import foam_y_object, foam_y_segments
from yid_ocp.model.rotations import homogeneous_transform
from yid_ocp.model.urdf import mechanism_to_urdf


def test_the_paper_y_stands_where_it_should():
    item = foam_y_object()
    foot, junction, left, right = positions(item, ["object_root", "w_T1", "w_T2", "w_T3"])
    half = math.sqrt(0.5)
    np.testing.assert_allclose(foot, [0.85, 0.0, -0.93])
    np.testing.assert_allclose(junction, foot + np.array([0, 0, 0.813]))
    np.testing.assert_allclose(left, junction + 0.610 * half * np.array([0, 1, 1]), atol=1e-15)
    np.testing.assert_allclose(right, junction + 0.737 * half * np.array([0, -1, 1]), atol=1e-15)
    moved = flexible_object(foam_y_segments(), homogeneous_transform(np.eye(3), [0.0, 0.0, 1.0]))
    np.testing.assert_allclose(positions(moved, ["w_T1"])[0], [0, 0, 1.813])
    assert flexible_object(foam_y_segments()).mechanism.joint_names == item.mechanism.joint_names


def test_checked_in_urdf_is_what_the_generator_writes(urdf_folder):
    assert mechanism_to_urdf(foam_y_object().mechanism) == (urdf_folder / "y_object.urdf").read_text(encoding="utf-8")


def test_a_share_of_the_weight_leaves_the_inertia_whole():
    whole, half = foam_y_object(), foam_y_object(gravity_fraction=0.5)
    for a, b in zip(
        whole.mechanism.with_numeric_values().joints, half.mechanism.with_numeric_values().joints, strict=True
    ):
        for body, light in zip(a.bodies, b.bodies, strict=True):
            assert float(light.mass) == float(body.mass)
            np.testing.assert_array_equal(numbers(light.inertia_about_com), numbers(body.inertia_about_com))
            assert body.gravity_fraction is None
            assert float(light.gravity_fraction) == 0.5

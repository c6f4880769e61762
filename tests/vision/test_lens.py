"""Distorted lenses: pixels and directions belong together, and straight edges come out straight."""

from __future__ import annotations

import numpy as np
import pytest

from yid_ocp.errors import DataError
from yid_ocp.vision import CameraIntrinsics

LENSES = {
    "none": CameraIntrinsics(64, 48, 60.0, 61.0, 31.0, 24.5),
    "plumb_bob": CameraIntrinsics(64, 48, 60.0, 61.0, 31.0, 24.5, "plumb_bob", (-0.25, 0.08, 1e-3, -2e-3, 0.01)),
    "four": CameraIntrinsics(64, 48, 60.0, 61.0, 31.0, 24.5, "plumb_bob", (0.1, -0.05, 1e-3, 2e-3)),
    "rational": CameraIntrinsics(
        64, 48, 60.0, 61.0, 31.0, 24.5, "rational_polynomial", (0.5, 0.1, 1e-3, -1e-3, 0, 0.6, 0.2, 0)
    ),
    "equidistant": CameraIntrinsics(64, 48, 30.0, 30.0, 31.0, 24.5, "equidistant", (0.02, -0.01, 0.003, 0.0)),
}


def pixels(lens, points):
    """Where points (..., 3) before a camera appear."""
    x, y = lens._distort(points[..., 0] / points[..., 2], points[..., 1] / points[..., 2])
    return np.stack([lens.fx * x + lens.cx, lens.fy * y + lens.cy], axis=-1)


@pytest.mark.parametrize("name", LENSES)
def test_a_ray_appears_at_its_pixel(name):
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    assert np.abs(pixels(LENSES[name], LENSES[name].pixel_rays) - np.stack([u, v], axis=-1)).max() < 2e-3


def test_the_formula_of_ros():
    """Worked out by hand for one point: r^2 = 0.05, and the equidistant angle."""
    point = np.array([0.4, 0.2, 2.0])
    x, y, square = 0.2, 0.1, 0.05
    k1, k2, p1, p2, k3 = (-0.25, 0.08, 1e-3, -2e-3, 0.01)
    factor = 1 + k1 * square + k2 * square**2 + k3 * square**3
    u = 60 * (x * factor + 2 * p1 * x * y + p2 * (square + 2 * x**2)) + 31.0
    v = 61 * (y * factor + p1 * (square + 2 * y**2) + 2 * p2 * x * y) + 24.5
    assert np.allclose(pixels(LENSES["plumb_bob"], point), [u, v])
    angle = np.arctan(np.sqrt(square))
    bent = angle + 0.02 * angle**3 - 0.01 * angle**5 + 0.003 * angle**7
    assert np.allclose(
        pixels(LENSES["equidistant"], point),
        [30 * x * bent / np.sqrt(square) + 31.0, 30 * y * bent / np.sqrt(square) + 24.5],
    )


def test_pixels_that_a_lens_does_not_have_are_no_points():
    """A barrel that turns back: its corners have no direction."""
    lens = CameraIntrinsics(64, 48, 30.0, 30.0, 31.5, 23.5, "plumb_bob", (-0.6, 0.0, 0.0, 0.0))
    assert np.isnan(lens.pixel_rays[0, 0]).any()
    cloud = lens.points_from_depth(np.ones((48, 64)))
    assert np.isfinite(cloud).all()
    assert len(cloud) < 48 * 64


@pytest.mark.parametrize(
    ("model", "coefficients", "message"),
    [
        ("inverse_brown", (0.1, 0, 0, 0, 0), "the distortion is 'inverse_brown'"),
        ("plumb_bob", (0.1, 0.2), "has the coefficients"),
        ("equidistant", (np.nan, 0, 0, 0), "has the coefficients"),
    ],
)
def test_unknown_distortions_are_refused(model, coefficients, message):
    with pytest.raises(DataError, match=message):
        CameraIntrinsics(64, 48, 60.0, 60.0, 32.0, 24.0, model, coefficients)
    assert not CameraIntrinsics(64, 48, 60.0, 60.0, 32.0, 24.0, model, (0.0,) * 5).has_distortion

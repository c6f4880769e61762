"""Joint paths: rest at both ends, derivatives, and limits that hold between nodes as well."""

import numpy as np
import pytest

from yid_ocp.planning.joint_paths import RestToRestSplineBasis


@pytest.fixture(params=[2, 3, 7, 12])
def path(request):
    return RestToRestSplineBasis(1.3, request.param)


def test_a_path_starts_and_ends_at_rest_where_it_should(path):
    ends = np.array([0.0, 1.3, 1.7])
    last = np.eye(path.n_coefficients)[-1]
    np.testing.assert_allclose(path.basis_values(ends), [0 * last, last, last], atol=1e-12)
    for order in (1, 2):
        np.testing.assert_allclose(path.basis_values(ends, order), 0.0, atol=1e-9)


def test_derivatives_are_those_of_the_path(path):
    t, e = np.linspace(0.1, 1.2, 23), 1e-5
    for order in (0, 1):
        slope = (path.basis_values(t + e, order) - path.basis_values(t - e, order)) / (2 * e)
        np.testing.assert_allclose(path.basis_values(t, order + 1), slope, rtol=1e-5, atol=1e-4)


def test_control_points_bound_the_path_and_its_derivatives_at_all_times(path):
    rng, t = np.random.default_rng(3), np.linspace(0.0, 1.3, 2001)
    for order in (0, 1, 2):
        for _ in range(20):
            w = rng.normal(size=path.n_coefficients)
            value, hull = path.basis_values(t, order) @ w, path.coefficients_to_control_points_matrix(order) @ w
            assert hull.min() - 1e-9 <= value.min()
            assert value.max() <= hull.max() + 1e-9


def test_a_straight_motion_is_the_smooth_one():
    path, t = RestToRestSplineBasis(2.0, 8), np.linspace(0.0, 2.0, 50)
    s = t / 2.0
    smooth = s**3 * (10 - 15 * s + 6 * s**2)
    np.testing.assert_allclose(
        path.basis_values(t) @ path.straight_line_coefficients([0.4, -1.0]), np.outer(smooth, [0.4, -1.0]), atol=2e-3
    )

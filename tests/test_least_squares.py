from __future__ import annotations

import numpy as np
import pytest

from yid_ocp.least_squares import Quadratic, damped_newton, levenberg_marquardt


def rosenbrock(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residual and Jacobian with the minimum at (1, 1), behind a curved valley."""
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]), np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])


def as_quadratic(x: np.ndarray) -> Quadratic:
    residual, jacobian = rosenbrock(x)
    return Quadratic(float(residual @ residual), jacobian.T @ residual, jacobian.T @ jacobian)


def test_a_curved_valley_is_followed_to_its_end() -> None:
    fit = levenberg_marquardt(rosenbrock, np.array([-1.2, 1.0]))
    assert fit.converged
    assert fit.x == pytest.approx([1.0, 1.0], abs=1e-8)
    assert fit.cost < 1e-16
    assert np.array_equal(fit.jacobian, rosenbrock(fit.x)[1])


def test_quadratic_models_go_the_same_way_as_rows() -> None:
    start = np.array([-1.2, 1.0])
    rows = levenberg_marquardt(rosenbrock, start, iterations=5)
    models = damped_newton(as_quadratic, start, iterations=5)
    assert models.x == pytest.approx(rows.x, rel=1e-9)
    assert models.model.cost == pytest.approx(rows.cost, rel=1e-9)
    assert (rows.iterations, rows.converged) == (models.iterations, models.converged) == (5, False)
    assert damped_newton(as_quadratic, start).x == pytest.approx([1.0, 1.0], abs=1e-6)


def test_no_step_is_longer_than_allowed() -> None:
    fit = levenberg_marquardt(lambda x: (x - 10.0, np.eye(1)), np.zeros(1), largest_step=0.25, iterations=3)
    assert fit.x == pytest.approx([0.75])


def test_points_are_brought_back_to_where_they_may_be() -> None:
    fit = levenberg_marquardt(lambda x: (x - 2.0, np.eye(1)), np.zeros(1), project=lambda x: np.minimum(x, 1.0))
    assert fit.x == pytest.approx([1.0])


def test_it_ends_when_steps_or_gains_are_small() -> None:
    """On x^2 = 2 steps fall as 0.5, 0.083, 0.0025 and costs as 1, 0.0625, 5e-5."""

    def square(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return x**2 - 2, np.diag(2 * x)

    def ended(step_tolerance: float, cost_tolerance: float) -> tuple[int, bool]:
        tolerances = {"step_tolerance": step_tolerance, "cost_tolerance": cost_tolerance}
        fit = levenberg_marquardt(square, np.ones(1), iterations=50, **tolerances)
        return fit.iterations, fit.converged

    assert ended(0.1, 0.0) == (2, True)
    assert ended(0.0, 0.99) == (1, True)
    assert ended(0.01, 0.0) == (3, True)


def test_it_ends_where_no_step_helps() -> None:
    """The slope has the wrong sign, so every step is refused and damped more."""

    def wrong(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.array([1.0 + x[0]]), np.array([[-1.0]])

    gives_up = levenberg_marquardt(wrong, np.zeros(1), step_tolerance=0.0)
    assert (gives_up.iterations, gives_up.converged) == (12, False)
    tolerant = levenberg_marquardt(wrong, np.zeros(1), step_tolerance=0.2)
    assert (tolerant.iterations, tolerant.converged) == (5, True)


def test_a_start_at_the_minimum_stays_there() -> None:
    fit = levenberg_marquardt(lambda x: (x, np.eye(2)), np.zeros(2))
    assert fit.converged
    assert np.array_equal(fit.x, np.zeros(2))


def test_least_damping_shortens_the_last_steps() -> None:
    def steep(x: np.ndarray) -> Quadratic:
        return Quadratic(float(x @ x), x, np.eye(1))

    ended = damped_newton(steep, np.array([1.0]), largest_step=9.0, iterations=1, least_damping=1.0)
    assert ended.x == pytest.approx([1.0 - 1 / 1.001])
    ended = damped_newton(steep, np.array([1.0]), largest_step=9.0, iterations=2, least_damping=1.0)
    assert ended.x == pytest.approx([(1.0 - 1 / 1.001) / 2])

from __future__ import annotations

import numpy as np
import pytest

from yid_ocp.least_squares import LocalQuadraticModel, levenberg_marquardt, minimize_by_damped_newton


def rosenbrock(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residual and Jacobian with the minimum at (1, 1), behind a curved valley."""
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]), np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])


def as_quadratic(x: np.ndarray) -> LocalQuadraticModel:
    residual, jacobian = rosenbrock(x)
    return LocalQuadraticModel(float(residual @ residual), jacobian.T @ residual, jacobian.T @ jacobian)


def test_a_curved_valley_is_followed_to_its_end() -> None:
    fit = levenberg_marquardt(rosenbrock, np.array([-1.2, 1.0]))
    assert fit.has_converged
    assert fit.x == pytest.approx([1.0, 1.0], abs=1e-8)
    assert fit.sum_of_squares < 1e-16
    assert np.array_equal(fit.jacobian, rosenbrock(fit.x)[1])


def test_quadratic_models_go_the_same_way_as_rows() -> None:
    start = np.array([-1.2, 1.0])
    rows = levenberg_marquardt(rosenbrock, start, max_iterations=5)
    models = minimize_by_damped_newton(as_quadratic, start, max_iterations=5)
    assert models.x == pytest.approx(rows.x, rel=1e-9)
    assert models.final_model.cost == pytest.approx(rows.sum_of_squares, rel=1e-9)
    assert (rows.n_iterations, rows.has_converged) == (models.n_iterations, models.has_converged) == (5, False)
    assert minimize_by_damped_newton(as_quadratic, start).x == pytest.approx([1.0, 1.0], abs=1e-6)


def test_no_step_is_longer_than_allowed() -> None:
    fit = levenberg_marquardt(lambda x: (x - 10.0, np.eye(1)), np.zeros(1), max_step=0.25, max_iterations=3)
    assert fit.x == pytest.approx([0.75])


def test_points_are_brought_back_to_where_they_may_be() -> None:
    fit = levenberg_marquardt(lambda x: (x - 2.0, np.eye(1)), np.zeros(1), projection=lambda x: np.minimum(x, 1.0))
    assert fit.x == pytest.approx([1.0])


def test_it_ends_when_steps_or_gains_are_small() -> None:
    """On x^2 = 2 steps fall as 0.5, 0.083, 0.0025 and costs as 1, 0.0625, 5e-5."""

    def square(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return x**2 - 2, np.diag(2 * x)

    def ended(step_tolerance: float, cost_tolerance: float) -> tuple[int, bool]:
        tolerances = {"step_tolerance": step_tolerance, "cost_tolerance": cost_tolerance}
        fit = levenberg_marquardt(square, np.ones(1), max_iterations=50, **tolerances)
        return fit.n_iterations, fit.has_converged

    assert ended(0.1, 0.0) == (2, True)
    assert ended(0.0, 0.99) == (1, True)
    assert ended(0.01, 0.0) == (3, True)


def test_it_ends_where_no_step_helps() -> None:
    """The slope has the wrong sign, so every step is refused and damped more."""

    def wrong(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.array([1.0 + x[0]]), np.array([[-1.0]])

    gives_up = levenberg_marquardt(wrong, np.zeros(1), step_tolerance=0.0)
    assert (gives_up.n_iterations, gives_up.has_converged) == (12, False)
    tolerant = levenberg_marquardt(wrong, np.zeros(1), step_tolerance=0.2)
    assert (tolerant.n_iterations, tolerant.has_converged) == (5, True)


def test_a_start_at_the_minimum_stays_there() -> None:
    fit = levenberg_marquardt(lambda x: (x, np.eye(2)), np.zeros(2))
    assert fit.has_converged
    assert np.array_equal(fit.x, np.zeros(2))


def test_least_damping_shortens_the_last_steps() -> None:
    def steep(x: np.ndarray) -> LocalQuadraticModel:
        return LocalQuadraticModel(float(x @ x), x, np.eye(1))

    ended = minimize_by_damped_newton(steep, np.array([1.0]), max_step=9.0, max_iterations=1, min_damping=1.0)
    assert ended.x == pytest.approx([1.0 - 1 / 1.001])
    ended = minimize_by_damped_newton(steep, np.array([1.0]), max_step=9.0, max_iterations=2, min_damping=1.0)
    assert ended.x == pytest.approx([(1.0 - 1 / 1.001) / 2])

import numpy as np
import pytest

from yid_ocp.least_squares import LocalQuadraticModel, levenberg_marquardt, minimize_by_damped_newton


def rosenbrock(x):
    """Residual and Jacobian with the minimum at (1, 1), behind a curved valley."""
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]), np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])


def minimized(function, start, **how):
    """The minimum of |r|^2 by quadratic models of Gauss and Newton, and the number of steps."""
    asked = []

    def model(x):
        asked.append(x)
        residual, jacobian = (np.array(part, float) for part in function(x))
        return LocalQuadraticModel(float(residual @ residual), jacobian.T @ residual, jacobian.T @ jacobian)

    return minimize_by_damped_newton(model, np.array(start, float), **how)[0], len(asked) - 1


def test_a_curved_valley_is_followed_to_its_end_by_rows_and_by_quadratic_models():
    x, final = levenberg_marquardt(rosenbrock, np.array([-1.2, 1.0]))
    assert x == pytest.approx([1.0, 1.0], abs=1e-8)
    assert final.cost < 1e-16
    assert minimized(rosenbrock, [-1.2, 1.0])[0] == pytest.approx([1.0, 1.0], abs=1e-6)
    assert np.array_equal(levenberg_marquardt(lambda x: (x, np.eye(2)), np.zeros(2))[0], np.zeros(2))


def test_no_step_is_longer_than_allowed():
    assert minimized(lambda x: (x - 10.0, np.eye(1)), [0.0], max_iterations=3)[0] == pytest.approx([1.5])


def test_points_are_brought_back_to_where_they_may_be():
    found = levenberg_marquardt(lambda x: (x - 2.0, np.eye(1)), np.zeros(1), lambda x: np.minimum(x, 1.0))
    assert found[0] == pytest.approx([1.0])


@pytest.mark.parametrize(
    ("step_tolerance", "cost_tolerance", "steps"), [(0.1, 0.0, 2), (0.0, 0.99, 1), (0.01, 0.0, 3), (0.0, -1.0, 4)]
)
def test_it_ends_when_steps_or_gains_are_small(step_tolerance, cost_tolerance, steps):
    """On x^2 = 2 steps fall as 0.5, 0.083, 0.0025 and costs as 1, 0.0625, 5e-5."""
    limits = {"step_tolerance": step_tolerance, "cost_tolerance": cost_tolerance, "max_iterations": 4}
    assert minimized(lambda x: (x**2 - 2, np.diag(2 * x)), [1.0], **limits)[1] == steps


@pytest.mark.parametrize(("tolerance", "steps"), [(0.0, 12), (0.2, 5)])
def test_it_ends_where_no_step_helps(tolerance, steps):
    """The slope has the wrong sign, so every step is refused and damped more."""
    assert minimized(lambda x: ([1.0 + x[0]], [[-1.0]]), [0.0], step_tolerance=tolerance)[1] == steps


def test_least_damping_shortens_the_last_steps():
    ends = [minimized(lambda x: (x, [[1.0]]), [0.4], max_iterations=n, min_damping=1.0)[0] for n in (1, 2)]
    first = 0.4 - 0.4 / 1.001
    assert np.ravel(ends) == pytest.approx([first, first / 2])

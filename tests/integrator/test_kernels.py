"""Derivatives of steps and rollouts: forward, adjoint, finite differences; interpreter and compiled code."""

import numpy as np
import pytest

from yid_ocp.integrator.step import linearized_rollout_steps
from yid_ocp.integrator.step_model import RolloutInputs, SensitivityDirections


def sizes_of(theta):
    """Natural size of each parameter; only compliances are zero here."""
    return np.where(theta == 0, 1e-2, np.abs(theta))


def random_cost(rollout):
    """Weights of a cost linear in every output of a rollout, scaled so that all parts count."""
    sizes, rng = {"state": 1.0, "multipliers": 0.1, "effort": 0.01}, np.random.default_rng(11)
    return {name: size * rng.normal(size=getattr(rollout, name).shape) for name, size in sizes.items()}


@pytest.mark.parametrize("fed_back", [False, True], ids=["open_loop", "feedback"])
def test_forward_equals_adjoint_equals_differences(case, fed_back):
    s, steps, theta = case.step.sizes, len(case.torque), case.theta
    assert s["nu"] == 2
    feedback = case.feedback if fed_back else None
    names = case.step.system.parameters.names
    fixed = list(case.step.system.prescribed_coordinate_indices)
    rng = np.random.default_rng(12)

    rollout = case.rollout(feedback=feedback)
    assert rollout.status.is_converged, rollout.status.message
    weights = random_cost(rollout)
    cost = tuple(weights.values())
    gradient = case.step.kernel.adjoint_gradient(theta, rollout, feedback, names, cost)

    # columns: all of theta, then two of everything else at once
    d = s["ntheta"] + 2
    start, torque = np.zeros((s["nx"], d)), np.zeros((steps, s["nu"], d))
    path = np.zeros((steps + 1, s["nc"], d))
    start[:, -2:], torque[..., -2:] = rng.normal(size=(s["nx"], 2)), rng.normal(size=(steps, s["nu"], 2))
    start[s["n"] : 2 * s["n"]] *= 0.01
    path[..., -1] = rng.normal(size=(steps + 1, s["nc"]))
    start[fixed] = path[0]
    forward = case.rollout(feedback=feedback, directions=SensitivityDirections(names, start, torque, path))
    by_directions = (forward.state_sensitivity, forward.multipliers_sensitivity, forward.effort_sensitivity)
    slopes = sum(np.tensordot(weight, by, 2) for weight, by in zip(cost, by_directions, strict=True))

    np.testing.assert_allclose(forward.state, rollout.state, rtol=0, atol=1e-9 * scale_of(rollout.state))
    scale = np.max(np.abs(slopes))
    np.testing.assert_allclose(slopes[:-2], gradient.by_theta, rtol=1e-8, atol=1e-9 * scale)
    expected = np.sum(gradient.by_initial_state * start[:, -2]) + np.sum(gradient.by_torque * torque[..., -2])
    assert slopes[-2] == pytest.approx(expected, rel=1e-8, abs=1e-9 * scale)

    def along(direction, epsilon):
        values = zip((theta, case.start, case.torque, case.path), direction, strict=True)
        moved = case.rollout(*(value + epsilon * move for value, move in values), feedback)
        assert moved.status.is_converged, moved.status.message
        return sum(np.sum(weight * getattr(moved, name)) for name, weight in weights.items())

    def difference(direction, epsilon=3e-6):
        return (along(direction, epsilon) - along(direction, -epsilon)) / (2 * epsilon)

    for column in (-2, -1):
        direction = (0 * theta, start[:, column], torque[..., column], path[..., column])
        assert slopes[column] == pytest.approx(difference(direction), rel=1e-5, abs=1e-5 * scale)
    for column in rng.choice(s["ntheta"], size=4, replace=False):
        unit = np.zeros(s["ntheta"])
        unit[column] = sizes_of(theta)[column]
        zero = (0 * case.start, 0 * case.torque, 0 * case.path)
        assert slopes[column] * unit[column] == pytest.approx(difference((unit, *zero)), rel=1e-5, abs=1e-5 * scale)


def test_interpreter_equals_compiled(parts, case):
    plain = case.interpreted_step
    if not case.step.is_compiled:
        pytest.skip("this machine has no C compiler to compare with")
    names = tuple(case.step.system.parameters.names[::2])
    d, rng = len(names) + 1, np.random.default_rng(3)
    torque, path = (rng.normal(size=(*values.shape, d)) for values in (case.torque, case.path))
    directions = SensitivityDirections(names, rng.normal(size=(len(case.start), d)), torque, path)
    directions.initial_state_tangents[list(case.step.system.prescribed_coordinate_indices)] = path[0]
    inputs = RolloutInputs(case.theta, case.start, case.torque, case.path, case.feedback, directions)
    parts.assert_kernels_agree((case.step, plain), inputs, tolerance=1e-9)


def scale_of(array):
    return max(1.0, np.max(np.abs(array), initial=0.0))


def test_linearized_steps_are_the_equations_along_any_trajectory(case):
    s, step, names = case.step.sizes, case.step, case.step.system.parameters.names[::3]
    n, h = s["n"], step.time_step
    rollout = case.rollout()
    exact = step.kernel.step_residuals_and_jacobians(
        case.theta, rollout.state, rollout.multipliers, rollout.torque, (), False
    )
    solved = exact.residual[:, step.model.index_tables.unknown_rows]
    assert np.max(np.abs(solved)) < 1e-9 * scale_of(rollout.multipliers)
    np.testing.assert_allclose(exact.p1, rollout.state[1:, n : 2 * n], rtol=0, atol=1e-9)
    effort = -exact.residual[:, list(step.system.prescribed_coordinate_indices)] / h
    np.testing.assert_allclose(effort, rollout.effort, rtol=0, atol=1e-7 * scale_of(rollout.effort))

    rng = np.random.default_rng(8)
    state = rollout.state + 0.01 * rng.normal(size=rollout.state.shape)
    lam = rollout.multipliers + 0.01 * rng.normal(size=rollout.multipliers.shape)
    one, two = (
        s.kernel.step_residuals_and_jacobians(case.theta, state, lam, case.torque, names, True)
        for s in (step, case.interpreted_step)
    )
    for key in vars(one):
        actual, expected = getattr(one, key), getattr(two, key)
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-9 * scale_of(expected))

    # along a random direction of everything
    moves = [rng.normal(size=a.shape) for a in (case.theta, state, lam, case.torque)]
    moves[0] *= sizes_of(case.theta) * np.isin(step.system.parameters.names, names)
    values = (case.theta, state, lam, case.torque)

    def at(epsilon):
        arguments = [value + epsilon * move for value, move in zip(values, moves, strict=True)]
        return step.kernel.step_residuals_and_jacobians(*arguments, (), False)

    epsilon = 1e-6
    plus, minus = at(epsilon), at(-epsilon)
    for part in ("residual", "p1"):
        expected = (getattr(plus, part) - getattr(minus, part)) / (2 * epsilon)
        old = np.hstack([moves[1][:-1, :n], moves[1][:-1, 2 * n :]])
        new = np.hstack([moves[1][1:, :n], moves[1][1:, 2 * n :], moves[2]])
        theta = moves[0][[step.system.parameters.index(name) for name in names]]
        actual = np.einsum("kij,kj->ki", getattr(one, f"{part}_by_old"), old)
        actual += np.einsum("kij,kj->ki", getattr(one, f"{part}_by_new"), new)
        actual += np.einsum("kij,kj->ki", getattr(one, f"{part}_by_input"), moves[3])
        actual += getattr(one, f"{part}_by_theta") @ theta
        if part == "residual":
            actual[:, :n] += moves[1][:-1, n : 2 * n]
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-6 * scale_of(expected))


def test_single_steps_are_those_of_a_rollout_by_both_kernels(case):
    """By state, torque and loads that act on every step alike."""
    sizes, slow = case.step.sizes, case.interpreted_step
    rollout, rng = case.rollout(), np.random.default_rng(3)
    assert rollout.status.is_converged, rollout.status.message
    rows, momentum = rng.normal(size=(sizes["n"] + sizes["nz"] + sizes["m"], 2)), rng.normal(size=(sizes["n"], 2))
    inputs = rng.normal(size=(len(rollout.torque), sizes["nu"], 3))
    for feedback in (None, case.feedback):
        maps = (
            linearized_rollout_steps(s, case.theta, rollout, inputs, feedback, (rows, momentum))
            for s in (case.step, slow)
        )
        both = ([np.concatenate(parts) for parts in zip(*some, strict=True)] for some in maps)
        made, expected = ((state, *np.split(effort, [sizes["nc"]], axis=1)) for state, effort in both)
        for one, other in zip(made, expected, strict=True):
            # large terms cancel in efforts
            least = 1e-4 * np.max(np.abs(other), initial=1.0)
            scale = np.maximum(np.max(np.abs(other), axis=(0, 1), initial=0.0), least)
            assert np.max(np.abs(one - other) / scale, initial=0.0) < 1e-9
    each = np.tile(np.eye(sizes["nu"]), (len(rollout.torque), 1, 1))
    by_all, effort = next(linearized_rollout_steps(case.step, case.theta, rollout, each))
    n, q0 = sizes["n"], rollout.state[0]
    prescribed = (case.path[0], case.path[1]) if sizes["nc"] else None
    A, B_u, _ = case.step.jacobians(q0[:n], q0[n : 2 * n], case.torque[0], case.theta, prescribed, q0[2 * n :], ())
    free = np.delete(np.arange(sizes["nx"]), list(case.step.system.prescribed_coordinate_indices))
    np.testing.assert_allclose(by_all[0, free, : sizes["nx"]], A[free], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(by_all[0, free, sizes["nx"] :], B_u[free], rtol=1e-9, atol=1e-9)
    # implicit differentiation of a rollout: the efforts are those of its sensitivities
    directions = SensitivityDirections((), np.eye(sizes["nx"]))
    forward = case.rollout(directions=directions).effort_sensitivity
    scale = scale_of(forward[0])
    np.testing.assert_allclose(effort[0][: sizes["nc"], free], forward[0][:, free], rtol=0, atol=1e-9 * scale)

"""Errors of one acceleration stand in the efforts of all joints that inertia couples with it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from small_problems import correlated, efforts, measured, pendulum_step, taken

from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.inference.smoother_model import linear_residual_models
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.problem.signal_filters import LowPassFilter
from yid_ocp.solvers import GaussNewton, MultipleShooting, SingleShooting, solve
from yid_ocp.solvers.symbolic_transcription import transcribe

NAN = math.nan
JOINTS = ("shoulder", "elbow")
ANGLE, EFFORT = 2e-4, 0.01  # [rad], [N m]
CUTOFF, TWINS = 8.0, 40  # [Hz]


def test_rows_are_independent_whatever_of_a_sample_was_seen():
    correlation = np.array([[[1.0, 0.8, -0.3], [0.8, 1.0, 0.1], [-0.3, 0.1, 1.0]]] * 2)
    made = measured(efforts("a", "b", "c"), [0, 1], [0.0, 0.0], [[1.0, 2.0, 3.0], [4.0, NAN, 6.0]])
    made = replace(made, noise_correlation=correlation, weight=made.weight * 2.0)
    mixing = made.decorrelation_matrix.toarray()
    np.testing.assert_allclose(mixing, mixing.T, atol=1e-12)
    covariance = np.zeros((5, 5))
    covariance[:3, :3] = correlation[0]
    covariance[3:, 3:] = correlation[1][np.ix_([0, 2], [0, 2])]
    np.testing.assert_allclose(mixing @ covariance @ mixing, np.eye(5), atol=1e-12)
    predicted = np.array([[0.0, 1.0, 5.0], [1.0, 9.0, 2.0]])
    plain = 2.0 * np.array([-1.0, -1.0, 2.0, -3.0, -4.0])
    np.testing.assert_allclose(made.residual_block(predicted).residual, mixing @ plain, rtol=1e-12)
    np.testing.assert_allclose(made.whitened_residual(predicted)[made.used_output_mask], mixing @ plain, rtol=1e-12)
    assert made.whitened_residual(predicted)[1, 1] == 0.0
    slopes = np.random.default_rng(0).standard_normal((2, 3, 4))
    found = made.residual_block(predicted, slopes, threshold=1.5)
    np.testing.assert_allclose(
        found.jacobian, found.robust_factor[:, None] * (mixing @ (2.0 * slopes[made.used_output_mask])), rtol=1e-12
    )
    pull = np.random.default_rng(1).standard_normal((2, 3))
    back = np.einsum("mk,mkd->d", made.whitened_residual_adjoint(np.where(made.used_output_mask, pull, 0.0)), slopes)
    np.testing.assert_allclose(
        back, pull[made.used_output_mask] @ made.residual_block(predicted, slopes).jacobian, rtol=1e-12
    )


def arm(step, path, effort, angle=ANGLE, std=EFFORT, free=("shoulder.damping",), cutoff=CUTOFF):
    t = 0.01 * np.arange(len(path))
    group = JointGroup(JOINTS, t, path, effort=effort, position_std=angle, effort_std=std, effort_kind="sample")
    options = ProblemOptions(path_cutoff=cutoff, weak_prior_factor=0.0)
    return EstimationProblem(step, [Recording(group, name="arm")], free, options)


def motion():
    t = 0.01 * np.arange(401)
    return np.stack([0.8 * np.sin(2.9 * t), 0.9 * np.sin(3.7 * t + 1)], axis=1)


def needed(step, path):
    """Efforts that a clean motion needs, at every sample."""
    clean = arm(step, path, np.zeros_like(path), angle=0.0, cutoff=math.inf)
    inner = clean.evaluate(clean.initial_unknowns, derivatives=False).episode_predictions[0].predicted_outputs[0]
    return np.vstack([inner[:1], inner, inner[-1:]])


def test_residuals_of_a_right_model_are_white_among_joints(urdf_folder):
    step, path = pendulum_step(urdf_folder, prescribed=JOINTS), motion()
    effort, found, alone = needed(step, path), [], []
    for seed in range(TWINS):
        rng = np.random.default_rng(seed)
        noisy = (a + b * rng.standard_normal(path.shape) for a, b in ((path, ANGLE), (effort, EFFORT)))
        problem = arm(step, *noisy)
        evaluation = problem.evaluate(problem.initial_unknowns, derivatives=False)
        [samples], [predicted] = (
            problem.episodes[0].measurements,
            evaluation.episode_predictions[0].predicted_outputs,
        )
        found.append(evaluation.residual.reshape(-1, 2))
        alone.append((predicted - samples.value) / samples.std)
    rows, plain = np.vstack(found), np.vstack(alone)
    assert len(rows) > 1500
    assert np.corrcoef(plain.T)[0, 1] > 0.5  # what independent rows would make of them
    np.testing.assert_allclose(rows.T @ rows / len(rows), np.eye(2), atol=0.1)


def correlated_problem(folder, cutoff=math.inf, **how):
    step = pendulum_step(folder, **how)
    names = ("shoulder.damping", "elbow.damping")
    options = ProblemOptions(weak_prior_factor=0.0, path_cutoff=cutoff)
    made = EstimationProblem(step, [taken(step, 1, steps=40 if math.isinf(cutoff) else 90)], names, options)
    return made.with_episodes([correlated(episode) for episode in made.episodes], ())


@pytest.mark.parametrize(
    "how", [{"prescribed": JOINTS}, {"prescribed": JOINTS, "cutoff": 15.0}, {}], ids=["moved", "moved_smoothly", "free"]
)
def test_derivatives_and_transcriptions_count_what_is_correlated(urdf_folder, how):
    problem = correlated_problem(urdf_folder, **how)
    x = 1.2 * problem.initial_unknowns
    evaluation = problem.evaluate(x)
    size = 1e-6 * x
    moved = [
        (problem.evaluate(x + d).residual - problem.evaluate(x - d).residual) / (2 * d.max()) for d in np.diag(size)
    ]
    np.testing.assert_allclose(evaluation.jacobian, np.stack(moved, axis=1), rtol=1e-5, atol=1e-5 * np.abs(moved).max())
    np.testing.assert_allclose(problem.cost_and_gradient(x)[1], evaluation.jacobian.T @ evaluation.residual, rtol=1e-8)
    program = transcribe(problem)
    arguments, theta = program.solver_arguments, program.block("theta").index.ravel()
    arguments["lbx"][theta] = arguments["ubx"][theta] = x
    solver = program.make_solver("ipopt", "exact", ipopt={"print_level": 0, "sb": "yes", "tol": 1e-9})
    assert float(solver(**arguments)["f"]) == pytest.approx(evaluation.cost, rel=1e-8)
    if "cutoff" in how:  # what is measured of the efforts says little beside points that are this wrong
        return
    solvers = [
        GaussNewton(),
        SingleShooting(),
        *([] if how else [MultipleShooting(), MultipleShooting(condensing=True)]),
    ]
    found = [solve(problem, s, restarts=False) for s in solvers]
    for other in found[1:]:
        assert other.cost == pytest.approx(found[0].cost, rel=1e-6)
        np.testing.assert_allclose(other.x, found[0].x, rtol=1e-3)


def test_unknown_forces_are_seen_as_correlated(urdf_folder):
    problem = correlated_problem(urdf_folder, prescribed=JOINTS)
    [linear] = linear_residual_models(problem, problem.initial_unknowns, problem.evaluate(problem.initial_unknowns))
    at = [linear.unknown_names.index(joint) for joint in JOINTS]
    found = sum(interval.unknown_jacobian[:, at].T @ interval.unknown_jacobian[:, at] for interval in linear.intervals)
    [samples] = (s for s in problem.episodes[0].measurements if s.sensor.effort_joints)
    slopes = samples.weight[:, :, None] * np.diag(linear.reference_std[at])
    assert np.array_equal(samples.sensor.effort_joints, JOINTS)
    seen = samples.decorrelation_matrix @ slopes[samples.used_output_mask]
    # but for the first and the last step, of which a node sees half
    np.testing.assert_allclose(found, seen.T @ seen, rtol=0.03)
    assert abs(found[0, 1]) > 0.05 * found.diagonal().min()


def test_a_gear_does_not_give_way_to_the_noise_of_an_effort_that_is_compared(urdf_folder):
    elastic = [("series_elasticity", "elbow", {"compliance": 0.0})]
    step, path = pendulum_step(urdf_folder, elastic, prescribed=JOINTS), motion()
    effort, rng = needed(pendulum_step(urdf_folder, prescribed=JOINTS), path), np.random.default_rng(4)
    name = "series_elasticity@elbow.compliance"
    clean, noisy, heavier = (
        arm(step, path, made, angle=0.0, free=(name,)).episodes[0]
        for made in (effort, effort + 0.3 * rng.standard_normal(effort.shape), effort + 2.0)
    )
    inner, gain = slice(50, -50), LowPassFilter(CUTOFF).noise_gains(0.01)[0]
    np.testing.assert_allclose(
        clean.joint_loads[inner], LowPassFilter(CUTOFF)(clean.grid.node_times, effort)[inner], atol=0.02
    )
    assert np.std((noisy.joint_loads - clean.joint_loads)[inner]) < 0.5 * 0.3 * gain
    # what the model does not know of a load is measured all the same
    np.testing.assert_allclose((heavier.joint_loads - clean.joint_loads)[inner], 2.0, atol=1e-6)
    # and so an elasticity that is not there is found as often as chance has it
    sizes = []
    for seed in range(TWINS):
        rng = np.random.default_rng(seed)
        problem = arm(step, path, effort + 0.3 * rng.standard_normal(effort.shape), angle=0.0, std=0.3, free=(name,))
        found = problem.evaluate(problem.initial_unknowns)
        slope = found.jacobian[:, 0]
        sizes.append((slope @ found.residual) / np.linalg.norm(slope))
    assert np.mean(np.square(sizes)) < 2.0


def test_dry_friction_needs_no_time_to_turn(urdf_folder):
    """Measured efforts are smoothed: a prediction that is not has other steps where the motion turns."""
    friction = [("joint_coulomb", "elbow", {"tau_c": 0.4})]
    step, path = pendulum_step(urdf_folder, friction, prescribed=JOINTS), motion()
    effort = needed(step, path)
    noisy = effort + 0.05 * np.random.default_rng(2).standard_normal(path.shape)
    problem = arm(step, path, noisy, angle=0.0, std=0.05)
    found = problem.evaluate(problem.initial_unknowns, derivatives=False).residual
    assert found @ found / len(found) < 1.5
    [samples] = problem.episodes[0].measurements
    assert np.abs(np.diff(samples.value[:, 1])).max() > 30 * samples.std.max()

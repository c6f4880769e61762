"""Innovations against dense algebra: the covariance of all residuals from rollouts whose inputs are wrong."""

from dataclasses import dataclass, make_dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from held_rod import held_rod
from small_problems import PENDULUM, TRACKED, H, correlated, joints, pendulum_step, recording, seen, taken

from yid_ocp.inference import kalman, whitening
from yid_ocp.inference.smoother_model import residual_models_with_smoother_unknowns
from yid_ocp.inference.whitening import problem_with_whitening_at, torque_biases_and_stds_per_recording
from yid_ocp.integrator.step import compile_step
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.problem.evaluation import episode_residual_and_jacobian

TORQUE, BIAS, ANGLE = 0.3, 0.2, 2e-3


def problem_of(
    folder, *, encoders, period=1, feedback=TRACKED, effects=(), size=1.0, angle=ANGLE, prescribed=(), **more
):
    """A pendulum whose shoulder is driven by wrong torques, `period` steps a sample, errors `size` times as large."""
    step = pendulum_step(folder, effects, driven=("shoulder",), prescribed=prescribed)
    made = taken(step, 3, steps=120 if prescribed else 24)
    group = made.joints
    assert group is not None
    group = replace(group, effort_std=size * TORQUE, effort_bias_std=size * BIAS, effort_kind="command")
    group = replace(group, position_std=size * angle)
    if period > 1:
        group = replace(group, t=group.t[::period], position=group.position[::period], effort=group.effort[::period])
    points = tuple(g for g in made.points if not encoders or g.name == "points_camera")
    recording = replace(made, joints=group, points=points)
    options = ProblemOptions(**feedback, **more)
    first = ("elbow.mass",) if prescribed else ("elbow.damping", "elbow.stiffness")
    names = (*first, *(n for e in step.system.effects for n in e.parameters.names))
    return EstimationProblem(step, [recording], names, options)


def residual(problem, x, torque=0.0, posture=0.0, reference=None):
    """Residual by the sensors' noise alone of an episode whose torques, first angles and reference are changed."""
    episode = problem.episodes[0]
    errors = replace(episode.input_errors, torque_bias=np.zeros(1))
    arm = episode.measured_driven_angles.copy()
    arm[0] += posture
    feedback = episode.tracking_feedback
    if reference is not None and feedback is not None:
        feedback = replace(feedback, reference=feedback.reference + reference)
    torques = {"torque": episode.torque + torque, "measured_driven_angles": arm}
    changed = replace(episode, **torques, tracking_feedback=feedback, input_errors=errors)
    result = problem.predictor.predict_episode(changed, *problem.unpack_episode_unknowns(x, 0), False)
    return episode_residual_and_jacobian(changed, None, result).residual


def slopes(change, count, size):
    """Derivative of a residual by inputs, column by column, by central differences."""
    return np.stack([(change(k, size) - change(k, -size)) / (2 * size) for k in range(count)], axis=1)


def dense_covariance(problem, x, angle):
    """Covariance of the residual where encoders are no measurements, the tracking filter at work on wrong angles."""
    episode = problem.episodes[0]
    errors, steps = episode.input_errors, episode.grid.steps
    samples = np.unique(errors.sample_of_step)

    def held(k, size):
        return residual(problem, x, torque=size * (errors.sample_of_step == samples[k])[:, None])

    def followed(k, size):
        return residual(problem, x, reference=size * (np.arange(steps) == k)[:, None])

    by_torque = slopes(held, len(samples), 1e-3)
    by_angle = slopes(followed, steps, 1e-4)
    by_first = slopes(lambda _, size: residual(problem, x, posture=size), 1, 1e-4)
    total = np.eye(len(by_torque)) + TORQUE**2 * by_torque @ by_torque.T
    constant = by_torque.sum(axis=1, keepdims=True)
    total += BIAS**2 * constant @ constant.T + angle**2 * by_angle @ by_angle.T
    return total + angle**2 * by_first @ by_first.T


@pytest.mark.parametrize(
    ("how", "effects", "together"),
    [
        ({}, (), True),
        ({"feedback": {"arm_tracking_feedback": "none"}}, (), False),
        ({}, (("camera_latency", "camera", {"delay": 0.0137}),), False),
        # the noise of interpolated angles is only as large as white noise makes it
        ({"period": 2, "angle": 1e-9}, (), True),
    ],
    ids=["tracked and correlated", "open_loop", "late_camera", "two_steps_a_sample and correlated"],
)
def test_innovations_weigh_by_the_covariance_of_all_residuals(urdf_folder, how, effects, together):
    problem = problem_of(urdf_folder, encoders=False, effects=effects, **how)
    if together:
        problem = problem.with_episodes([correlated(episode) for episode in problem.episodes], ())
    x = problem.initial_unknowns * 1.1
    plain, weighted = problem.evaluate(x), problem_with_whitening_at(problem, x).evaluate(x)
    rows = problem.residual_rows.data
    covariance = dense_covariance(problem, x, how.get("angle", ANGLE))
    solved = np.linalg.solve(covariance, np.column_stack([plain.residual[rows], plain.jacobian[rows]]))
    left = np.column_stack([plain.residual[rows], plain.jacobian[rows]]).T @ solved
    mine = np.column_stack([weighted.residual[rows], weighted.jacobian[rows]])
    np.testing.assert_allclose(mine.T @ mine, left, rtol=2e-5, atol=1e-6 * np.abs(left).max())
    np.testing.assert_array_equal(weighted.residual[rows.stop :], plain.residual[rows.stop :])


def test_a_step_without_a_measurement_adds_no_likelihood_and_lets_the_state_go_on():
    covariance = np.array([[2.0, 0.3], [0.3, 1.0]])
    map_ = np.array([[0.9, 0.2]])
    transition = kalman.StateTransition(map_, np.array([0.5]))
    step, after, log_determinant = kalman.kalman_covariance_step(covariance, np.zeros((0, 2)), transition)
    assert log_determinant == 0.0
    whole = np.vstack([map_, [0.0, 0.5]])
    np.testing.assert_allclose(after, whole @ covariance @ whole.T)
    white, mean = step.normalized_innovations_and_next_mean(np.array([[1.0], [2.0]]), np.zeros((0, 1)))
    assert white.shape == (0, 1)
    np.testing.assert_allclose(mean[:, 0], whole @ [1.0, 2.0])


@pytest.mark.usefixtures("c_compiler")
@pytest.mark.parametrize(
    "how",
    [
        {"encoders": False},
        {"encoders": True, "period": 2},
        {"encoders": False, "period": 3, "effects": (("camera_latency", "camera", {"delay": 0.0137}),)},
        {"encoders": False, "prescribed": ("elbow",)},
        {"encoders": True, "feedback": {"arm_tracking_feedback": "none"}, "prescribed": ("elbow",), "period": 2},
        {"encoders": False, "size": 1e4, "angle": 1e-9},
    ],
    ids=["tracked", "encoders", "late", "prescribed", "open_loop", "ill_conditioned"],
)
def test_compiled_filters_do_what_plain_ones_do(urdf_folder, monkeypatch, how):
    problem = problem_of(urdf_folder, **how)
    x, rows = problem.initial_unknowns * 1.1, problem.residual_rows.data
    found = []
    for is_plain in (False, True):
        if is_plain:
            monkeypatch.setattr(kalman, "_library", lambda: None)
        weighted = problem_with_whitening_at(problem, x, rounds=2)
        own = weighted.evaluate(x)
        found.append((own.residual[rows], own.jacobian[rows], *torque_biases_and_stds_per_recording(weighted, x)[0]))
    for compiled, plain in zip(*found, strict=True):
        np.testing.assert_allclose(compiled, plain, rtol=1e-9, atol=1e-9 * np.abs(plain).max())


@pytest.mark.parametrize("gain", [0.0, 20.0])
def test_with_encoders_the_outcome_does_not_depend_on_the_tracking_filter(urdf_folder, gain):
    """Encoders are measurements and the filter only says where to linearise: gains move chi2 by what is not linear."""
    costs = []
    for g in (9.0, gain):
        feedback = {"arm_tracking_feedback": "proportional", "arm_proportional_gains": (g,)}
        problem = small_gap(problem_of(urdf_folder, encoders=True, feedback=feedback, size=0.1), size=0.1)
        weighted = problem_with_whitening_at(problem, problem.initial_unknowns)
        rows = problem.residual_rows.data
        found = weighted.evaluate(problem.initial_unknowns)
        r, jacobian = found.residual[rows], found.jacobian[rows]
        covariance = np.linalg.inv(jacobian.T @ jacobian)
        costs.append((r @ r, covariance @ jacobian.T @ r, covariance))
    (one, step, covariance), (other, moved, _) = costs
    assert one == pytest.approx(other, rel=1e-4)
    np.testing.assert_allclose((moved - step) / np.sqrt(np.diag(covariance)), 0.0, atol=0.02)


def small_gap(problem, size=1.0):
    """The same problem with measurements near what the model says: a true motion with wrong torques."""
    episode = problem.episodes[0]
    rng = np.random.default_rng(5)
    truth = replace(episode, torque=episode.torque + 0.3 * size * TORQUE * rng.standard_normal(episode.torque.shape))
    truth = replace(truth, tracking_feedback=None)
    result = problem.predictor.predict_episode(
        truth, *problem.unpack_episode_unknowns(problem.initial_unknowns, 0), False
    )
    pairs = zip(episode.measurements, result.predicted_outputs, strict=True)
    samples = tuple(replace(s, value=y + s.std * rng.standard_normal(y.shape)) for s, y in pairs)
    angles = result.rollout.state[:, :1] + size * ANGLE * rng.standard_normal((len(result.rollout.state), 1))
    angles[0] = episode.measured_driven_angles[0]
    feedback = episode.tracking_feedback
    if feedback is not None:
        feedback = replace(feedback, reference=angles[:-1].copy())
    return problem.with_episodes(
        [replace(episode, measurements=samples, tracking_feedback=feedback, measured_driven_angles=angles)], []
    )


def test_without_errors_of_inputs_nothing_changes(urdf_folder):
    problem = problem_of(urdf_folder, encoders=False, size=0.0)
    assert not problem.has_process_noise
    assert problem_with_whitening_at(problem, problem.initial_unknowns) is problem
    paper = problem_of(urdf_folder, encoders=False, weighting="paper")
    assert not paper.has_process_noise
    assert {s.sensor.group_name for s in paper.episodes[0].measurements} == {"points_arm", "points_camera"}


def test_a_constant_error_is_seen_and_its_spread_said(urdf_folder):
    problem = small_gap(problem_of(urdf_folder, encoders=True))
    episode = problem.episodes[0]
    problem = problem.with_episodes([replace(episode, torque=episode.torque + 0.35)], [])
    weighted = problem_with_whitening_at(problem, problem.initial_unknowns)
    ((value, std),) = torque_biases_and_stds_per_recording(weighted, problem.initial_unknowns)
    assert std[0] < BIAS
    assert value[0] == pytest.approx(0.35, abs=4 * std[0])
    again = problem_with_whitening_at(weighted, problem.initial_unknowns)
    np.testing.assert_allclose(again.episodes[0].input_errors.torque_bias, value)
    moved = whitening.max_torque_bias_change_in_stds(weighted.whitening_filters, again.whitening_filters)
    assert moved == pytest.approx(value[0] / BIAS)
    assert whitening.max_torque_bias_change_in_stds(weighted.whitening_filters, [None]) == 0.0
    ((settled, _),) = torque_biases_and_stds_per_recording(again, problem.initial_unknowns)
    assert settled[0] == pytest.approx(value[0], abs=0.5 * std[0])
    assert torque_biases_and_stds_per_recording(problem, problem.initial_unknowns) == [None]


@pytest.mark.parametrize("feedback", [TRACKED, {"arm_tracking_feedback": "lqr"}], ids=["angles", "angles_and_momenta"])
def test_a_constant_error_counts_in_what_the_filter_follows_too(urdf_folder, feedback):
    """The momentum of the measured motion is worked out from recorded torques; weights know what their error does."""
    problem = problem_of(urdf_folder, encoders=False, feedback=feedback)
    x, error = problem.initial_unknowns, 1e-3
    weighted = problem_with_whitening_at(problem, x)
    [episode], [own] = weighted.episodes, weighted.whitening_filters
    group = episode.recording.joints
    wrong = replace(episode.recording, joints=replace(group, effort=group.effort + error))
    again = EstimationProblem(problem.step, [wrong], problem.free, problem.options).episodes[0]
    other = replace(again, input_errors=episode.input_errors)
    found = []
    for each in (episode, other):
        result = weighted.predictor.predict_episode(each, *problem.unpack_episode_unknowns(x, 0), False)
        found.append(whitening.estimate_episode_torque_bias(each, result, own)[0])
    seen = 1 - (own.torque_bias_std[0] / BIAS) ** 2
    assert seen > 0.05
    assert (found[1] - found[0]) / error == pytest.approx(seen, rel=0.01)


def test_jacobians_of_innovations_are_those_of_differences(urdf_folder):
    problem = small_gap(problem_of(urdf_folder, encoders=True))
    weighted = problem_with_whitening_at(problem, problem.initial_unknowns)
    x = problem.initial_unknowns * 1.05
    found = weighted.evaluate(x)
    for i in range(len(x)):
        step = np.zeros(len(x))
        step[i] = 1e-5 * x[i]
        up, down = (weighted.evaluate(x + sign * step, True, found.equilibrium_guesses).residual for sign in (1, -1))
        numeric = (up - down) / (2 * step[i])
        np.testing.assert_allclose(numeric, found.jacobian[:, i], atol=2e-5 * np.abs(found.jacobian[:, i]).max())
    cost, gradient, again = weighted.cost_and_gradient(x)
    assert (cost, again.jacobian) == (pytest.approx(found.cost), None)
    np.testing.assert_allclose(gradient, found.jacobian.T @ found.residual, rtol=1e-9)


def test_what_may_act_on_a_held_rod(urdf_folder):
    system = held_rod(urdf_folder, prescribed=PENDULUM, damping=0.05)
    t = H * np.arange(13)
    # the tip stands 2 cm below the end of the rod
    arm = joints(PENDULUM, t, np.tile([0.6994, -1.6348], (13, 1)), position_std=0.0)
    felt = seen(["w_T1"], t, np.full((13, 1, 3), 0.5), "points_arm", std=np.full((13, 1, 3), 0.01))
    step = compile_step(system, H, use_compiler=False)
    problem = EstimationProblem(step, [recording(arm, felt)], ("T1.bend",), ProblemOptions(initial_state="equilibrium"))
    x = problem.initial_unknowns
    evaluation = problem.evaluate(x)
    [model] = residual_models_with_smoother_unknowns(problem, x, evaluation)
    told = zip(model.unknown_names, model.unknown_groups, model.reference_std, strict=True)
    found = {name: (group.location, group.kind, std) for name, group, std in told}
    bent = evaluation.episode_predictions[0].rollout.state[:, 2 : system.n_coordinates]
    load = np.sqrt(np.mean((bent * np.tile([4.0, 4.0, 3.0], 2)) ** 2))
    expected = {f"T1_{i}_{axis}": ("T1", "force", pytest.approx(0.1 * load)) for i in (0, 1) for axis in "xyz"}
    for axis in "xyz":
        expected[f"hand.{axis}"] = ("hand", "offset", 2e-3)
        # the segment weighs 0.1 kg
        expected[f"T1.push_{axis}"] = ("T1", "push", pytest.approx(0.1 * 0.1 * 9.81))
        expected[f"points_arm.w_T1.{axis}"] = ("hand", "bias", pytest.approx(3 * 0.01))
    assert found == expected


_Errors = make_dataclass("_Errors", ["torque_bias", "torque_bias_std"])


@dataclass
class _OvershootingFilter:
    """Its estimate lies three times as far beyond the true offset 1 as the offset is short of it."""

    input_error_model: _Errors

    def whiten_residuals_and_estimate_torque_bias(self, rows, push):
        apart = self.input_error_model.torque_bias[:, None] - 1.0
        return apart, 1.0 - 3.0 * apart


def test_a_torque_offset_whose_linear_estimate_overshoots_is_approached_by_halves(monkeypatch):
    monkeypatch.setattr(whitening, "_plain", lambda episode, result: np.zeros(1))
    predictor = SimpleNamespace(
        theta_with_episode_values=lambda episode, theta: theta,
        corrected_inputs=lambda episode, theta, names: SimpleNamespace(torque=np.zeros((3, 1))),
        predict_episode=lambda *given: SimpleNamespace(stacked_feedback_torque_and_sensitivity=None),
    )
    errors = _Errors(np.zeros(1), np.ones(1))
    recorded = make_dataclass("_Recorded", ["input_errors"])(errors)
    found = whitening._settled(predictor, _OvershootingFilter(errors), recorded, *3 * [np.zeros(1)])
    np.testing.assert_allclose(found.input_error_model.torque_bias, 1.0, atol=0.3)

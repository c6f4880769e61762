"""Predictions and their derivatives: forward, adjoint and differences agree, whatever is driven, late or misread."""

import math
from dataclasses import replace

import numpy as np
import pytest
from small_problems import PENDULUM, STEPS, TRACKED, H, keeps_inputs, pendulum_step, taken

from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions, episode_prediction
from yid_ocp.problem.episodes import TorqueAndAngleErrorModel, truncate_episode
from yid_ocp.problem.model_functions import (
    central_difference_velocity,
    central_difference_velocity_adjoint,
    second_difference_acceleration,
    second_difference_acceleration_adjoint,
)

MISREAD = (("encoder_offset", "shoulder", {"offset": 0.03}), ("effort_gain", "shoulder", {"scale": 0.9}))
LATE = (("camera_latency", "camera", {"delay": 0.0137}), ("clock_scale", "clock", {"scale": 0.97}))
GEARS = (("series_elasticity", "shoulder", {"stiffness": 300.0}), ("backlash", "shoulder", {"width": 0.02}))
HEAVY = (("rotor_inertia", "shoulder", {"armature": 0.03}), ("link_mass", "elbow", {"scale": 1.1}))
DELAYED = (("effort_delay", "gripper", {"delay": 0.0137}), ("effort_offset", "shoulder", {"offset": 0.2}))
SOFT = (("joint_coulomb", "elbow", {"tau_c": 0.05}), ("gravity_tilt", "world", {"rx": 0.03, "ry": 0.02}))
STICKING = (("joint_presliding", "shoulder", {"tau_c": 0.3, "yield_angle": 0.02}),)

FILTERED = {"arm_tracking_feedback": "lqr"}
CASES = {
    "free": ((), {}, {}),
    "estimated start": ((), {}, {"initial_state": "estimated"}),
    "local": (SOFT, {}, {"local_parameters": ("elbow.stiffness",)}),
    "robust": (LATE, {}, {"huber_threshold": 1.5}),
    "paper": ((), {}, {"weighting": "paper"}),
    "prescribed": (MISREAD + LATE, {"prescribed": ("shoulder",)}, {}),
    "prescribed gears": (GEARS + HEAVY, {"prescribed": ("shoulder",)}, {}),
    "all prescribed": (MISREAD, {"prescribed": PENDULUM}, {}),
    "driven": (DELAYED + MISREAD, {"driven": ("shoulder",)}, {"arm_tracking_feedback": "none"}),
    "driven, proportional": (MISREAD + GEARS, {"driven": ("shoulder",)}, TRACKED),
    "driven, filtered": (MISREAD + HEAVY + LATE, {"driven": ("shoulder",)}, FILTERED),
    "driven, filtered, both": (MISREAD + HEAVY, {"driven": PENDULUM}, FILTERED),
    "driven, filtered, remembering": (STICKING + GEARS + DELAYED, {"driven": ("shoulder",)}, FILTERED),
    "driven, filtered, estimated": (MISREAD, {"driven": ("shoulder",)}, {**FILTERED, "initial_state": "estimated"}),
    "driven and prescribed": (MISREAD, {"driven": ("elbow",), "prescribed": ("shoulder",)}, TRACKED),
}


def problem_of(folder, case, seeds=(1, 2), **more):
    effects, how, options = CASES[case]
    step = pendulum_step(folder, effects, **how)
    names = [name for effect in step.system.effects for name in effect.parameters.names]
    springs = [f"{joint}.stiffness" for joint in PENDULUM if f"{joint}.stiffness" in step.system.parameters.names]
    settings = ProblemOptions(path_cutoff=math.inf, **options | more)
    recordings = [taken(step, seed) for seed in seeds]
    return EstimationProblem(step, recordings, ("elbow.damping", *springs, *names), settings)


@pytest.fixture(scope="module", params=CASES)
def problem(request, urdf_folder):
    return problem_of(urdf_folder, request.param)


def moved(problem):
    """A point beside the start."""
    x = problem.initial_unknowns
    change = np.random.default_rng(3).uniform(0.9, 1.1, len(x))
    return np.where(x == 0, 0.01 * (change - 0.9), x * change)


def test_forward_and_adjoint_derivatives_are_those_of_differences(problem):
    x = moved(problem)
    evaluation = problem.evaluate(x)
    assert evaluation.ok, evaluation.message
    cost, gradient, _ = problem.cost_and_gradient(x)
    scale = np.maximum(np.abs(x), 1e-2)
    forward = evaluation.jacobian.T @ evaluation.residual
    np.testing.assert_allclose(gradient * scale, forward * scale, rtol=1e-6, atol=1e-8 * np.abs(forward * scale).max())
    assert cost == pytest.approx(evaluation.cost, rel=1e-12)
    rows = problem.residual_rows.slice_of_data_and_stated_priors
    for i in range(len(x)):
        step = np.zeros(len(x))
        step[i] = 1e-5 * scale[i]
        ends = [
            problem.evaluate(x + sign * step, equilibrium_guesses=evaluation.equilibrium_guesses) for sign in (1, -1)
        ]
        slope = (ends[0].cost - ends[1].cost) / (2 * step[i])
        assert slope == pytest.approx(gradient[i], rel=2e-4, abs=1e-6 * np.abs(gradient * scale).max() / scale[i])
        if problem.options.huber_threshold == math.inf:
            numeric = (ends[0].residual - ends[1].residual)[rows] / (2 * step[i])
            exact = evaluation.jacobian[rows, i]
            np.testing.assert_allclose(numeric, exact, atol=2e-4 * max(np.abs(exact).max(), 1e-6 / scale[i]))


def test_without_derivatives_the_cost_is_the_same(problem):
    x = moved(problem)
    plain, full = problem.evaluate(x, derivatives=False), problem.evaluate(x)
    np.testing.assert_array_equal(plain.residual, full.residual)
    assert plain.jacobian is None
    assert (plain.cost, plain.ok) == (full.cost, True)
    warm = problem.evaluate(x, equilibrium_guesses=full.equilibrium_guesses)
    np.testing.assert_allclose(warm.residual, full.residual, atol=1e-7)


def test_what_is_freed_later_has_the_same_derivatives(urdf_folder):
    whole = problem_of(urdf_folder, "driven, filtered")
    x, few = moved(whole), whole.unknown_names[1:4]
    known = dict(zip(whole.unknown_names, x, strict=True))
    part = whole.with_free_parameters_without_recompiling(few).with_parameter_values(known)
    own = np.array([x[whole.unknown_names.index(name)] for name in few])
    one, two = part.evaluate(own), whole.evaluate(x)
    data = whole.residual_rows.data
    np.testing.assert_allclose(one.residual[part.residual_rows.data], two.residual[data], atol=1e-9)
    columns = [whole.unknown_names.index(name) for name in few]
    np.testing.assert_allclose(one.jacobian[part.residual_rows.data], two.jacobian[data][:, columns], atol=1e-7)
    none = whole.with_free_parameters_without_recompiling(()).with_parameter_values(known)
    alone = none.evaluate(np.zeros(0))
    np.testing.assert_allclose(alone.residual, two.residual[data], atol=1e-9)
    assert alone.jacobian.shape == (len(alone.residual), 0)


def test_a_delay_is_in_true_time(urdf_folder):
    problem = problem_of(urdf_folder, "robust", seeds=(1,))
    samples, theta = problem.episodes[0].measurements[1], problem.system.parameters.vector
    values = {"camera_latency@camera.delay": 0.02, "clock_scale@clock.scale": 0.8}
    late, _ = problem.predictor._delay_in_steps(samples, theta(values), ())
    assert late.shape == (6,)
    # a clock that goes slow shows 0.8 s for a second, and 16 ms for a delay of 20 ms
    np.testing.assert_allclose(late, 0.8 * 0.02 / H)
    assert problem.predictor._delay_in_steps(problem.episodes[0].measurements[0], theta(values), ()) is None


def test_an_encoder_that_is_offset_moves_the_path(urdf_folder):
    problem = problem_of(urdf_folder, "prescribed", seeds=(1,))
    values = {"encoder_offset@shoulder.offset": 0.05}
    episode = problem.episodes[0]
    inputs = problem.predictor.corrected_inputs(episode, problem.system.parameters.vector(values), ())
    np.testing.assert_allclose(inputs.prescribed_path - episode.prescribed_path, -0.05, atol=1e-12)
    rollout = problem.evaluate(problem.pack_unknowns(values), False).episode_predictions[0].rollout
    np.testing.assert_allclose(rollout.state[:, 0], inputs.prescribed_path[:, 0], atol=1e-12)


def test_an_elastic_gear_gives_under_the_recorded_effort(urdf_folder):
    problem = problem_of(urdf_folder, "prescribed gears", seeds=(1,))
    episode = problem.episodes[0]
    values = {"series_elasticity@shoulder.compliance": 0.004, "backlash@shoulder.width": 0.0}
    inputs = problem.predictor.corrected_inputs(episode, problem.system.parameters.vector(values), ())
    effort = episode.recording.joints.effort
    np.testing.assert_allclose(episode.joint_loads, effort, atol=1e-12)
    np.testing.assert_allclose(inputs.prescribed_path, episode.prescribed_path - 0.004 * effort, atol=1e-12)


def test_a_torque_acts_as_it_was_recorded_less_what_its_sensor_adds(urdf_folder):
    problem = problem_of(urdf_folder, "driven", seeds=(1,))
    episode = problem.episodes[0]
    vector = problem.system.parameters.vector
    neutral = {
        "effort_delay@gripper.delay": 0.0,
        "effort_offset@shoulder.offset": 0.0,
        "effort_gain@shoulder.inverse": 1.0,
        "encoder_offset@shoulder.offset": 0.0,
    }
    assert set(neutral) <= set(problem.unknown_names)
    plain = problem.predictor.corrected_inputs(episode, vector(neutral), ())
    np.testing.assert_allclose(plain.torque, episode.torque, atol=1e-12)
    np.testing.assert_allclose(plain.first_torque, episode.torque[0])
    shifted = problem.predictor.corrected_inputs(episode, vector(neutral | {"effort_delay@gripper.delay": H}), ())
    np.testing.assert_allclose(shifted.torque[1:], episode.torque[:-1], atol=1e-9)
    offset = problem.predictor.corrected_inputs(episode, vector(neutral | {"effort_offset@shoulder.offset": 0.5}), ())
    np.testing.assert_allclose(offset.torque, episode.torque - 0.5, atol=1e-12)
    np.testing.assert_allclose(offset.first_torque, episode.torque[0] - 0.5, atol=1e-12)


def test_a_problem_is_as_recorded_unless_an_effect_may_change_it(urdf_folder):
    assert keeps_inputs(problem_of(urdf_folder, "free", seeds=(1,)))
    for case in ("prescribed", "prescribed gears", "driven", "driven, filtered", "robust"):
        assert not keeps_inputs(problem_of(urdf_folder, case, seeds=(1,))), case
    neutral = {"encoder_offset@shoulder.offset": 0.0, "effort_gain@shoulder.inverse": 1.0}
    made = problem_of(urdf_folder, "all prescribed", seeds=(1,))
    assert not keeps_inputs(made.with_parameter_values(neutral)), "a free one may change it"
    fixed = made.with_free_parameters_without_recompiling(("elbow.damping",))
    assert keeps_inputs(fixed.with_parameter_values(neutral))
    assert not keeps_inputs(fixed.with_parameter_values(neutral | {"encoder_offset@shoulder.offset": 0.01}))
    assert keeps_inputs(problem_of(urdf_folder, "local", seeds=(1,)))


def test_efforts_along_a_rollout_are_those_of_driven_and_prescribed_joints(urdf_folder):
    problem = problem_of(urdf_folder, "driven and prescribed", seeds=(1,))
    rollout = problem.evaluate(problem.initial_unknowns, False).episode_predictions[0].rollout
    effort = problem.predictor.rollout_node_values(rollout).load
    assert effort.shape == (STEPS + 1, 2)
    np.testing.assert_array_equal(effort[:-1, 0], rollout.effort[:, 0])
    np.testing.assert_array_equal(effort[:-1, 1], rollout.torque[:, 0])
    np.testing.assert_array_equal(effort[-1], effort[-2])


def test_readings_along_a_trajectory_are_those_of_its_rollout(urdf_folder):
    problem = problem_of(urdf_folder, "free", seeds=(1,))
    x = problem.initial_unknowns
    evaluation = problem.evaluate(x, False)
    state, theta = evaluation.episode_predictions[0].rollout.state, problem.unpack_episode_unknowns(x, 0)[0]
    by_state = np.zeros((STEPS + 1, 4, len(x)))
    for k, samples in enumerate(problem.episodes[0].measurements):
        along, slopes = problem.predictor.readings_and_sensitivities(samples, state, by_state, theta)
        np.testing.assert_allclose(along, evaluation.episode_predictions[0].predicted_outputs[k], atol=1e-12)
        np.testing.assert_array_equal(slopes, np.zeros((*along.shape, len(x))))
    by_state[:, 0, 1] = 1.0
    samples = problem.episodes[0].measurements[0]
    _, slopes = problem.predictor.readings_and_sensitivities(samples, state, by_state, theta)
    # turned about the shoulder as a whole, the tip moves across its lever
    lever = evaluation.episode_predictions[0].predicted_outputs[0] - [0.0, 0.0, 1.2]
    np.testing.assert_allclose(slopes[:, 1, 1], -lever[:, 2], atol=1e-9)
    np.testing.assert_allclose(slopes[:, 2, 1], lever[:, 1], atol=1e-9)


def test_heavier_joints_have_more_momentum_for_the_filter_to_follow(urdf_folder):
    problem = problem_of(urdf_folder, "driven, filtered, both", seeds=(1,))
    episode, vector = problem.episodes[0], problem.system.parameters.vector
    neutral = {name: value for effect in problem.system.effects for name, value in effect.neutral_values.items()}
    none, shifted = (np.zeros(problem.step.sizes["nx"]), problem.predictor.corrected_inputs_with_effect_momentum)
    assert shifted(episode, vector(neutral), (), none).momentum_shift is None
    name = "rotor_inertia@shoulder.armature"
    found = shifted(episode, vector(neutral | {name: 0.05}), (name,), none)
    # of the motion up to each node; it begins from a stand
    rate = np.diff(episode.smoothed_driven_angles[:, 0], prepend=episode.smoothed_driven_angles[0, 0])[:-1] / H
    np.testing.assert_allclose(found.momentum_shift, np.stack([0.05 * rate, 0 * rate], axis=1), atol=1e-12)
    np.testing.assert_allclose(found.momentum_shift_sensitivity[:, 0, 0], rate, atol=1e-12)


def test_the_filter_of_an_episode_is_the_one_that_was_asked_for(urdf_folder):
    filters = {
        case: problem_of(urdf_folder, case, seeds=(1,)).episodes[0]
        for case in ("free", "prescribed", "driven", "driven, proportional", "driven, filtered, both")
    }
    assert [filters[case].tracking_feedback for case in ("free", "prescribed", "driven")] == [None] * 3
    tracked = filters["driven, proportional"]
    np.testing.assert_array_equal(tracked.tracking_feedback.gain, np.full((STEPS, 1, 1), 9.0))
    np.testing.assert_array_equal(tracked.tracking_feedback.reference, tracked.measured_driven_angles[:-1])
    followed = filters["driven, filtered, both"].tracking_feedback
    assert followed.state_indices.tolist() == [0, 1, 2, 3]
    assert np.all(followed.gain[0, [0, 1], [0, 1]] > 1.0)


def test_gains_do_not_know_of_effects(urdf_folder):
    """They are worked out at the nominal parameters with the effects' momentum left out, which is followed apart."""
    effects, how, _ = CASES["driven, filtered, both"]
    light = tuple((kind, place, {} if kind == "rotor_inertia" else values) for kind, place, values in effects)
    made, options = [], ProblemOptions(path_cutoff=math.inf)
    for chosen in (effects, light):
        step = pendulum_step(urdf_folder, chosen, **how)
        [episode] = EstimationProblem(step, [taken(step, 1)], ("elbow.damping",), options).episodes
        made.append(episode.tracking_feedback)
    np.testing.assert_allclose(made[0].gain, made[1].gain, rtol=1e-9)
    np.testing.assert_allclose(made[0].reference, made[1].reference, rtol=1e-9)


@pytest.mark.parametrize(("case", "driven", "prescribed"), [("driven and prescribed", 1, 1), ("all prescribed", 0, 2)])
def test_an_episode_begins_at_its_first_posture(urdf_folder, case, driven, prescribed):
    episode = problem_of(urdf_folder, case, seeds=(1,)).episodes[0]
    position = episode.recording.joints.position
    assert episode.measured_driven_angles.shape == (STEPS + 1, driven)
    assert episode.prescribed_path.shape == (STEPS + 1, prescribed)
    np.testing.assert_allclose(episode.initial_known_coordinates, position[0], atol=1e-12)
    path = np.hstack([episode.measured_driven_angles, episode.prescribed_path])
    np.testing.assert_allclose(path, position, atol=1e-12)
    assert episode.torque.shape == (STEPS, driven)
    np.testing.assert_allclose(episode.torque, episode.recording.joints.effort[:-1, :driven], atol=1e-9)


def test_a_filtered_arm_is_smooth_enough_to_be_differenced(urdf_folder):
    effects, how, _ = CASES["driven, filtered, both"]
    step = pendulum_step(urdf_folder, effects, **how)
    made = taken(step, 1, steps=100)
    noisy = made.joints.position + 1e-3 * np.random.default_rng(1).standard_normal(made.joints.position.shape)
    made = replace(made, joints=replace(made.joints, position=noisy))
    smooth, plain = (
        EstimationProblem(step, [made], ("elbow.damping",), ProblemOptions(path_cutoff=5.0, **how)).episodes[0]
        for how in (FILTERED, TRACKED)
    )
    rough = [np.abs(np.diff(episode.smoothed_driven_angles, 2, axis=0)).max() for episode in (smooth, plain)]
    assert rough[0] < 0.5 * rough[1]
    np.testing.assert_array_equal(plain.smoothed_driven_angles, plain.measured_driven_angles)
    np.testing.assert_array_equal(smooth.measured_driven_angles, plain.measured_driven_angles)


@pytest.mark.parametrize("case", ["driven, filtered", "prescribed gears", "estimated start"])
def test_the_beginning_of_an_episode_is_predicted_as_in_the_whole(urdf_folder, case):
    problem = problem_of(urdf_folder, case, seeds=(1,))
    whole = problem.episodes[0]
    short = problem.with_episodes([truncate_episode(whole, 10)], ())
    x = moved(problem)
    one, two = problem.evaluate(x, False).episode_predictions[0], short.evaluate(x, False).episode_predictions[0]
    assert short.episodes[0].grid.steps == 10
    np.testing.assert_allclose(two.rollout.state, one.rollout.state[:11], atol=1e-9)
    for k, samples in enumerate(short.episodes[0].measurements):
        before = whole.measurements[k]
        last = 10 - (STEPS - before.predictable_nodes[1])
        assert samples.predictable_nodes == (before.predictable_nodes[0], last)
        early = before.node + before.fraction <= last + 1e-9
        np.testing.assert_array_equal(samples.value, before.value[early])
        np.testing.assert_allclose(two.predicted_outputs[k], one.predicted_outputs[k][early], atol=1e-9)
    assert truncate_episode(whole, 99).grid.steps == STEPS


def test_rates_at_nodes_are_those_of_a_parabola_and_of_one_step_at_the_ends():
    t, h = 0.1 * np.arange(6), 0.1
    q, nodes = np.stack([1.0 + 2.0 * t + 3.0 * t**2, -t], axis=1), np.arange(6)
    speed, rate = central_difference_velocity(q, nodes, h), second_difference_acceleration(q, nodes, h)
    expected = 2.0 + 6.0 * np.array([h / 2, *t[1:-1], t[-1] - h / 2])
    np.testing.assert_allclose(speed, np.stack([expected, -np.ones(6)], axis=1))
    np.testing.assert_allclose(rate, np.tile([6.0, 0.0], (6, 1)), atol=1e-9)
    pull = np.random.default_rng(0).standard_normal((6, 2))
    for forward, back in ((speed, central_difference_velocity_adjoint), (rate, second_difference_acceleration_adjoint)):
        assert np.sum(back(pull, nodes, 6, h) * q) == pytest.approx(np.sum(pull * forward))


@pytest.mark.parametrize(("share", "calls"), [(0.0, [1, 1, 1]), (1.5, [1, 1, 1]), (2.5, [2, 1]), (9.0, [3])])
def test_so_many_rollouts_are_held_at_once_as_the_memory_takes(urdf_folder, monkeypatch, share, calls):
    problem, asked = problem_of(urdf_folder, "free", seeds=(1, 2, 3)), []
    plain = problem.evaluate(problem.initial_unknowns)
    free = len(problem.free)
    held = 8 * (STEPS + 1) * 4 * (free + 1)  # bytes of one recording's states and their derivatives
    monkeypatch.setattr(episode_prediction, "_MAX_ROLLOUT_MEMORY", share * held)
    kernel, batch = type(problem.step.kernel), type(problem.step.kernel).rollout_batch
    monkeypatch.setattr(kernel, "rollout_batch", lambda own, some: asked.append(len(some)) or batch(own, some))
    found = problem.evaluate(problem.initial_unknowns)
    assert asked == calls
    np.testing.assert_array_equal(found.residual, plain.residual)


@pytest.mark.parametrize("reference", [None, [[0.0], [1.0], [3.0]]])
def test_errors_of_inputs_on_finer_steps_are_held_and_the_reference_lies_between(reference):
    rng, reference = np.random.default_rng(0), None if reference is None else np.array(reference)
    noise = rng.standard_normal((3, 3, 1))
    one = np.ones(1)
    errors = TorqueAndAngleErrorModel(one, one, one, np.array([0, 1, 1]), 1.0, False, one, *noise, reference)
    fine = errors.on_finer_steps(2)
    assert fine.sample_of_step.tolist() == [0, 0, 1, 1, 1, 1]
    np.testing.assert_array_equal(fine.torque_noise[:, 0], np.repeat(noise[0, :, 0], 2))
    if reference is None:
        assert fine.smoothed_reference is None
    else:
        # beyond the last node it stays
        np.testing.assert_allclose(fine.smoothed_reference[:, 0], [0.0, 0.5, 1.0, 2.0, 3.0, 3.0])


@pytest.mark.parametrize(
    ("position_std", "stated", "angle"), [(1e-3, None, 1e-3), (1e-3, 4e-3, 4e-3), (None, None, 0.0)]
)
def test_predicted_efforts_have_the_noise_of_encoders_in_them(urdf_folder, position_std, stated, angle):
    """Accelerations come from the path: their noise times the inertia adds to that of the effort sensor."""
    step = pendulum_step(urdf_folder, prescribed=("shoulder",))
    made = taken(step, 1)
    made = replace(made, joints=replace(made.joints, position_std=position_std))
    options = ProblemOptions(path_cutoff=math.inf, sensors={"joints.position": SensorOptions(std=stated)})
    problem = EstimationProblem(step, [made], ("elbow.damping",), options)
    effort = next(s for s in problem.episodes[0].measurements if s.sensor.effort_joints)
    # a second difference of white noise is larger by the root of 1 + 4 + 1
    acceleration = angle * math.sqrt(6.0) / H**2
    inertia = 0.0208 + 0.25**2 + 0.008 + 0.6 * 0.7**2
    np.testing.assert_allclose(effort.std, math.hypot(0.3, inertia * acceleration), rtol=1e-9)

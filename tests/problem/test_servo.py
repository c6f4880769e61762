"""Arms of position servos: commands instead of torques, rest under a command, slopes, effects on servos."""

from dataclasses import replace

import numpy as np
import pytest
from small_problems import (
    PENDULUM,
    H,
    assert_slopes_are_those_of_differences,
    assert_the_compiled_step_agrees,
    joints,
    pendulum_step,
    recording,
    torque_function,
)

from yid_ocp.data.recording import Recording
from yid_ocp.effects import candidate_kinds_and_locations, make_effect
from yid_ocp.errors import DataError
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import actuated_joint_torques_of_rollout, simulate
from yid_ocp.model.servos_and_springs import TORQUE_SATURATION_EXPONENT, ServoModelOptions
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.problem.measurements import TimeGrid
from yid_ocp.problem.recorded_inputs import step_mean_inputs
from yid_ocp.solvers import GaussNewton

VALUES = {
    "shoulder.servo_gain": 60.0, "shoulder.servo_damping": 4.0, "shoulder.servo_delay": 0.017,
    "shoulder.servo_torque_limit": 9.0, "elbow.servo_gain": 25.0, "elbow.servo_damping": 1.5,
    "elbow.servo_delay": 0.0, "elbow.servo_torque_limit": 3.0,
}  # fmt: skip
EFFECTS = (
    ("servo_gain", "shoulder", {"scale": 0.8}),
    ("servo_delay", "elbow", {"delay": 0.013}),
    ("servo_saturation", "shoulder", {"limit": 6.0}),
    ("backlash", "elbow", {"width": 0.02}),
    ("encoder_offset", "shoulder", {"offset": 0.03}),
)


@pytest.fixture(scope="module")
def step(urdf_folder):
    return servo_step(urdf_folder)


def servo_step(folder, effects=(), commands="held", gravity_compensation=False):
    return pendulum_step(folder, effects, driven=PENDULUM, servos=ServoModelOptions(commands, gravity_compensation))


def commanded(steps: int = 40, period: float = H, position=None, command=None) -> Recording:
    """Commands that begin at rest and grow into a motion of some tenths of a radian; angles that are noise."""
    t = period * np.arange(steps + 1)
    wave = np.minimum(t / 0.1, 1.0)[:, None] * np.sin(9.0 * t[:, None] + np.array([0.0, 1.0]))
    command = np.array([0.3, -0.2]) + 0.4 * wave if command is None else command
    position = command + 0.02 * np.random.default_rng(1).normal(size=command.shape) if position is None else position
    return recording(joints(PENDULUM, t, position, position_command=command, position_std=1e-3))


def problem_of(step, made, free, values=None, **options) -> EstimationProblem:
    known = {name: value for name, value in VALUES.items() if name in step.system.parameters}
    return EstimationProblem(step, [made], free, ProblemOptions(**options), {**known, **(values or {})})


def saturated(demand, limit):
    power = TORQUE_SATURATION_EXPONENT
    return demand / (1 + (np.abs(demand) / limit) ** power) ** (1 / power)


@pytest.mark.parametrize("demand", [-40.0, -2.0, 0.5, 8.0, 30.0])
def test_the_torque_is_that_of_a_spring_and_a_damper_within_a_limit(step, demand) -> None:
    command = np.array([0.3 + (demand + 4.0 * 0.7) / 60.0, 0.0])
    found = torque_function(step, VALUES)(command, [0.3, 0.0], [0.7, 0.0])
    assert found[0] == pytest.approx(saturated(demand, 9.0))
    assert abs(found[0]) < 9.0
    assert found[1] == 0.0


def test_it_rests_where_its_servos_balance_the_weight(step) -> None:
    theta, command = step.system.parameters.vector(VALUES), np.array([0.4, -0.3])
    rest = EquilibriumSolver(step).solve(command, theta, command)
    assert rest.is_converged
    sag = command - rest.state[:2]
    upper, lower = np.sin(rest.state[0]), np.sin(rest.state[0] + rest.state[1])
    weight = 9.81 * np.array([0.25 * upper + 0.6 * (0.5 * upper + 0.2 * lower), 0.6 * 0.2 * lower])
    np.testing.assert_allclose(saturated(np.array([60.0, 25.0]) * sag, [9.0, 3.0]), weight, rtol=1e-8)
    still = simulate(step, theta, rest.state, 30, np.tile(command, (30, 1)))
    np.testing.assert_allclose(still.state, np.tile(rest.state, (31, 1)), atol=1e-9)
    for i in range(2):
        moved = command.copy()
        moved[i] += 1e-5
        change = (EquilibriumSolver(step).solve(moved, theta, moved).state - rest.state) / 1e-5
        np.testing.assert_allclose(rest.state_by_torque[:, i], change, rtol=1e-3, atol=1e-4)
    # without a command, that which holds the posture is looked for
    held = EquilibriumSolver(step).solve(command, theta)
    np.testing.assert_allclose(held.state[:2], command, atol=1e-3)
    assert np.all((held.holding_torque - command) * sag > 0)


@pytest.mark.parametrize("scale", [1.0, 1.25])
def test_the_torque_along_a_rollout_is_what_moves_it(urdf_folder, scale) -> None:
    step = servo_step(urdf_folder, [("clock_scale", "clock", {"scale": scale})])
    made = problem_of(step, commanded(), ["shoulder.damping"])
    [result] = made.evaluate(made.initial_unknowns, False).episode_predictions
    torque = actuated_joint_torques_of_rollout(step, made.theta, result.rollout)
    q = result.rollout.state[:, :2]
    rate, middle = np.diff(q, axis=0) * scale / H, (q[1:] + q[:-1]) / 2
    demand = np.array([60.0, 25.0]) * (result.rollout.torque - middle) - np.array([4.0, 1.5]) * rate
    np.testing.assert_allclose(torque, saturated(demand, [9.0, 3.0]), rtol=1e-9)


def test_a_controller_that_carries_the_arm_leaves_no_sag(urdf_folder) -> None:
    carried = servo_step(urdf_folder, gravity_compensation=True)
    command = np.array([0.9, 0.4])
    rest = EquilibriumSolver(carried).solve(command, carried.system.parameters.vector(VALUES), command)
    np.testing.assert_allclose(rest.state[:2], command, atol=1e-8)


def test_a_servo_far_stiffer_than_the_step_is_stable(step) -> None:
    stiff = {f"{joint}.servo_gain": 1e6 for joint in PENDULUM} | {f"{joint}.servo_damping": 2e3 for joint in PENDULUM}
    theta = step.system.parameters.vector(VALUES | stiff | {f"{joint}.servo_torque_limit": 1e5 for joint in PENDULUM})
    run = simulate(step, theta, np.zeros(step.sizes["nx"]), 60, np.tile([0.5, 0.5], (60, 1)))
    assert run.status.is_converged
    assert np.abs(run.state[:, :2]).max() < 1.1
    np.testing.assert_allclose(run.state[-1, :2], 0.5, atol=2e-3)


@pytest.mark.parametrize(
    ("commands", "expected"), [("held", [1.0, 3.0, 2.0, 3.0]), ("interpolated", [2.0, 2.5, 2.5, 3.5])]
)
def test_commands_are_held_or_interpolated_and_late_and_may_be_lost(urdf_folder, commands, expected) -> None:
    system = servo_step(urdf_folder, commands=commands).system
    t = np.array([0.0, 0.1, 0.2, 0.4])
    group = joints(PENDULUM, t, np.zeros((4, 2)), position_command=np.outer([1.0, 3.0, 2.0, 4.0], [1.0, 0.0]))
    found = step_mean_inputs(group, PENDULUM, TimeGrid(0.0, 0.1, 4), "run", servos=system.servos)
    np.testing.assert_allclose(found[:, 0], expected)
    late = step_mean_inputs(group, PENDULUM, TimeGrid(0.1, 0.1, 3), "run", np.array([0.1, 0.0]), system.servos)
    np.testing.assert_allclose(late[:, 0], expected[:3])


@pytest.mark.parametrize("commands", ["held", "interpolated"])
@pytest.mark.parametrize("period", [H, 3 * H])
def test_slopes_are_those_of_differences(urdf_folder, commands, period) -> None:
    step = servo_step(urdf_folder, EFFECTS, commands)
    free = [name for name in step.system.parameters.names if "servo" in name or "@" in name]
    made = problem_of(step, commanded(round(0.4 / period), period), free)

    def width(name, value):
        return 1e-4 * value if "tightness" in name else 1e-6 * max(1.0, abs(value))

    assert_slopes_are_those_of_differences(made, width, 1e-4, 1e-6)


def test_nothing_drives_it_wrong_and_no_filter_follows_its_encoders(step) -> None:
    [episode] = problem_of(step, commanded(), ["shoulder.servo_gain"]).episodes
    assert episode.tracking_feedback is None
    assert episode.input_errors is None
    assert [samples.sensor.group_name for samples in episode.measurements] == ["joints.position"]
    np.testing.assert_allclose(episode.torque, episode.recording.joints.position_command[:-1])


def test_what_it_is_is_found_again(step) -> None:
    quiet = commanded(60)
    truth = problem_of(step, quiet, ["shoulder.servo_gain"])
    [seen] = truth.evaluate(truth.initial_unknowns, False).episode_predictions[0].predicted_outputs
    angles = np.vstack([quiet.joints.position[:1], seen])
    made = replace(quiet, joints=replace(quiet.joints, position=angles))
    names = [f"{joint}.servo_{what}" for joint in PENDULUM for what in ("gain", "damping")] + ["shoulder.servo_delay"]
    wrong = {"shoulder.servo_gain": 90.0, "shoulder.servo_damping": 2.0, "shoulder.servo_delay": 0.0}
    problem = problem_of(step, made, names, wrong)
    solution = GaussNewton().minimize_cost(problem, problem.initial_unknowns, None)
    for name, value in problem.unknowns.named_values(solution.x).items():
        assert value == pytest.approx(VALUES[name], rel=1e-3, abs=1e-5), name


def test_without_commands_it_says_what_is_missing(step) -> None:
    silent = recording(joints(PENDULUM, [0.0, 0.1, 0.2], np.zeros((3, 2)), position_std=1e-3, effort=np.ones((3, 2))))
    with pytest.raises(DataError, match="follow commanded positions, but the recording has none") as caught:
        problem_of(step, silent, ["shoulder.servo_gain"])
    assert "position_command" in caught.value.where
    assert "prescribed" in caught.value.hint


def test_effects_on_efforts_are_none_of_a_servo(step) -> None:
    recorded = ("joints.position", "joints.effort", "camera", "nominal_clock")
    kinds = {kind for kind, place in candidate_kinds_and_locations(step.system, recorded) if place in PENDULUM}
    assert {"servo_gain", "servo_delay", "servo_saturation", "backlash", "encoder_offset"} <= kinds
    assert not kinds & {"effort_gain", "effort_offset", "effort_lag", "series_elasticity"}
    without = {kind for kind, _ in candidate_kinds_and_locations(step.system, ["joints.position"])}
    assert {"servo_gain", "servo_delay", "servo_saturation", "backlash"} <= without
    assert make_effect("servo_gain", "elbow", step.system).neutral_values == {"servo_gain@elbow.scale": 1.0}
    bare = candidate_kinds_and_locations(replace(step.system, servos={}, driven=()), recorded)
    assert bare
    assert "servo_gain" not in {kind for kind, _ in bare}


@pytest.mark.parametrize("kind", ["servo_gain", "servo_delay", "servo_saturation", "backlash"])
def test_neutral_it_changes_nothing_and_shows_at_once(urdf_folder, step, kind) -> None:
    free = ["shoulder.damping"]
    plain = problem_of(step, commanded(), free)
    with_it = problem_of(servo_step(urdf_folder, [(kind, "shoulder", {})]), commanded(), free)
    [effect] = with_it.system.effects
    both = [made.evaluate(made.initial_unknowns).residual for made in (plain, with_it)]
    np.testing.assert_allclose(both[0], both[1], atol=1e-8)
    freed = problem_of(with_it.step, commanded(), [*effect.amplitude_parameter_names])
    slope = freed.evaluate(freed.initial_unknowns).jacobian[: len(both[0]), 0]
    low, high = effect.prior_ranges[effect.amplitude_parameter_names[0]]
    assert np.abs(slope).max() * (high - low) > 1.0


def test_a_servo_delay_and_a_gain_are_what_the_servo_itself_could_be(urdf_folder, step) -> None:
    made, free = commanded(), ["shoulder.damping"]
    for effect, values in (
        (("servo_delay", "shoulder", {"delay": 0.013}), {"shoulder.servo_delay": 0.03}),
        (("servo_gain", "shoulder", {"scale": 0.7}), {"shoulder.servo_gain": 42.0, "shoulder.servo_damping": 2.8}),
    ):
        pair = problem_of(servo_step(urdf_folder, [effect]), made, free), problem_of(step, made, free, values)
        np.testing.assert_allclose(*(p.evaluate(p.initial_unknowns).residual for p in pair), atol=1e-9)


def test_a_saturation_reports_its_limit_and_binds_like_the_servos_own(urdf_folder, step) -> None:
    made, far = commanded(), {"shoulder.servo_torque_limit": 2e4}
    limited = servo_step(urdf_folder, [("servo_saturation", "shoulder", {"limit": 5.0})])
    [effect] = limited.system.effects
    name = effect.amplitude_parameter_names[0]
    power = TORQUE_SATURATION_EXPONENT
    told = effect.to_reported_parameters({name: 5.0**-power}, {name: 0.01 * power * 5.0**-power})["limit"]
    assert (told.value, told.std, told.unit) == (pytest.approx(5.0), pytest.approx(0.05), "N m")
    one = problem_of(limited, made, ["shoulder.damping"], far)
    other = problem_of(step, made, ["shoulder.damping"], {"shoulder.servo_torque_limit": 5.0})
    np.testing.assert_allclose(*(p.evaluate(p.initial_unknowns).residual for p in (one, other)), atol=1e-6)


def test_play_is_taken_up_on_the_side_of_the_torque(urdf_folder) -> None:
    """A hand's weight against a stop: the encoder reads half the width beyond the joint, the servo acts on that."""
    step = servo_step(urdf_folder, [("backlash", "shoulder", {"width": 0.02})])
    theta, command = step.system.parameters.vector(VALUES), np.array([0.8, 0.0])
    rest = EquilibriumSolver(step).solve(command, theta, command)
    q, play = rest.state[0], rest.state[4]
    torque = 60.0 * (command[0] - q - play)
    assert torque > 1.0
    assert play == pytest.approx(0.01 * np.tanh(torque / 0.2), abs=1e-9)
    still = simulate(step, theta, rest.state, 20, np.tile(command, (20, 1)))
    np.testing.assert_allclose(still.state[-1], rest.state, atol=1e-9)
    made = problem_of(step, commanded(command=np.tile(command, (41, 1))), ["shoulder.damping"])
    [angles] = made.evaluate(made.initial_unknowns, False).episode_predictions[0].predicted_outputs
    assert angles[-1, 0] == pytest.approx(q + play, abs=1e-6)


def test_a_zero_that_is_off_moves_readings_and_commands_alike(urdf_folder, step) -> None:
    """Without gravity an arm whose encoder reads 0.03 too much stands 0.03 lower and reads what it was commanded."""
    offset = servo_step(urdf_folder, [("encoder_offset", "shoulder", {"offset": 0.03})], gravity_compensation=True)
    plain = servo_step(urdf_folder, gravity_compensation=True)
    made = [problem_of(s, commanded(), ["shoulder.damping"]) for s in (plain, offset)]
    first, second = (p.evaluate(p.initial_unknowns, False).episode_predictions[0] for p in made)
    np.testing.assert_allclose(second.predicted_outputs[0][0], first.predicted_outputs[0][0], atol=1e-9)
    np.testing.assert_allclose(first.rollout.state[0, 0] - second.rollout.state[0, 0], 0.03, atol=1e-9)


def test_the_compiled_step_agrees(urdf_folder) -> None:
    free = ["shoulder.servo_gain", "elbow.servo_delay"]
    slow = servo_step(urdf_folder, EFFECTS)
    assert_the_compiled_step_agrees(slow, lambda step: problem_of(step, commanded(), free))


def test_an_estimated_start_frees_the_arm_as_well(step) -> None:
    made = problem_of(step, commanded(), ["shoulder.damping"], initial_state="estimated")
    assert {"start.q.shoulder[made]", "start.p.elbow[made]"} <= set(made.unknown_names)

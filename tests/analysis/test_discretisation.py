"""How far estimates move with a finer model, rule by rule, on formulas and on chains."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_models import Formula, estimate, solution
from made_models import estimate as estimated
from made_recordings import chain_of_motors
from small_problems import pendulum_step, places, taken

from yid_ocp.analysis import discretisation
from yid_ocp.analysis.discretisation import (
    AlternatingErrorGrowth,
    _fine_joints_by_coarse_joint,
    _FinerModel,
    _gauss_newton_step_in_finer_model,
    _half_step_error,
    alternating_error_growth_of_worst_recording,
    estimates_widened_by_discretisation_error,
    longest_accurate_time_step,
    parameter_shifts_at_finer_discretisation,
    predicted_refit_residual_at_finer_step,
)
from yid_ocp.analysis.estimation import add_intervals_and_checks
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.display import NULL_PROGRESS
from yid_ocp.inference import null_test
from yid_ocp.inference.uncertainty import EstimateShiftByDiscretisation
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import compile_step, simulate, step_with_time_step
from yid_ocp.integrator.step_model import TrackingFeedback
from yid_ocp.model import FlexibleSegment, Grasp, System, flexible_object
from yid_ocp.model.servos_and_springs import StiffnessAndRest
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.problem.predictions import channel_predictions
from yid_ocp.solvers import GaussNewton, Status, fit_problem

OPEN = {"a": (-math.inf, math.inf), "b": (-math.inf, math.inf)}


def problem(rows, start, shared=None, **more):
    made = Formula(rows, start, **more)
    made.shared_parameters = tuple(start) if shared is None else shared
    made.system = SimpleNamespace(mechanism=SimpleNamespace(joint_names=()))
    return made


def shifts(coarse, finer, factors=None, divided=None, **more):
    """Of the coarse problem's parameters at its initial values."""
    x, refined = coarse.initial_unknowns, _FinerModel(finer, factors or {}, divided or {})
    made = _gauss_newton_step_in_finer_model(refined, coarse, x, coarse.evaluate(x), **more)
    return made if isinstance(made, str) else made[0]


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_an_estimate_moves_to_where_a_linear_finer_model_fits_best(factor):
    """The finer model's own parameter is so many times the coarse one's; its best fit is at 3.3 coarse units."""
    coarse = problem(lambda x: [2 * (x["a"] - 3.0), x["a"] + x["b"] - 5.0], {"a": 3.0, "b": 2.0}, bounds=OPEN)
    finer = problem(
        lambda x: [2 * (x["a"] / factor - 3.3), x["a"] / factor + x["b"] - 5.1], {"a": 1.0, "b": 1.0}, bounds=OPEN
    )
    assert shifts(coarse, finer, {"a": factor}) == pytest.approx({"a": 0.3, "b": -0.2})


def test_a_finer_model_that_is_far_away_is_fitted_and_not_followed_along_a_tangent():
    """One linear step from 3 leaves the second row at 10; the fit at 4 leaves nothing."""
    coarse = problem(lambda x: [x["a"] - 3.0, 0.5], {"a": 3.0}, bounds=OPEN)
    finer = problem(lambda x: [10 * (x["a"] - 4.0), 10 * ((x["a"] - 3.0) ** 2 - 1.0)], {"a": 3.0}, bounds=OPEN)
    x = coarse.initial_unknowns
    left = predicted_refit_residual_at_finer_step(finer, coarse, x, coarse.evaluate(x))
    assert left == pytest.approx(np.zeros(2), abs=1e-3)


def test_a_move_ends_at_the_bound_and_what_cannot_be_compared_says_why():
    start = {"a": 1.0}
    assert shifts(problem(lambda x: [x["a"] - 1.0], start), problem(lambda x: [x["a"] + 5.0], start)) == {"a": -1.0}
    coarse = problem(lambda x: [x["a"] - 1.0], {"a": 1.0})
    assert shifts(coarse, problem(lambda x: [x["a"]], {"a": 1.0}, fails=lambda values: True)) == "it snaps"


def chain(links):
    tube = flexible_object([FlexibleSegment("T1", 0.6, 0.1, 0.02, links=links, joint_axes="xy")])
    return System.build(None, objects=[(tube, None, None)])


def test_divided_links_share_their_angle():
    coarse, fine = chain(2), chain(4)
    divided = _fine_joints_by_coarse_joint(coarse, fine)
    pairs = {f"T1_{i}_{axis}": (f"T1_{2 * i}_{axis}", f"T1_{2 * i + 1}_{axis}") for i in (0, 1) for axis in "xy"}
    assert divided == pairs
    assert _fine_joints_by_coarse_joint(coarse, coarse) == _fine_joints_by_coarse_joint(fine, coarse) == {}


def test_a_start_and_its_equilibrium_are_carried_to_the_finer_chain():
    """Of a chain of half the links, whose angles are shared; what a finer model has besides keeps its own value."""
    names = [f"start.{kind}.{joint}[run]" for kind in "qp" for joint in ("T1_0_x", "T1_1_x")]
    free = dict.fromkeys((*names, "start.q.T1_0_x[run]", "start.p.T1_0_x[run]"), (-9.0, 9.0))
    given = {"a": 1.5, "c[run]": 2.0, "start.q.T1_0_x[run]": 0.4, "start.p.T1_0_x[run]": 0.9, "gone": 5.0}
    coarse = problem(lambda x: [x["a"]], given, bounds=free)
    coarse.system = chain(1)
    start = {"a": 1.0, "c[run]": 1.0, "b": 7.0, **dict.fromkeys(names, 0.0)}
    fine, asked = problem(lambda x: [x["a"]], start, bounds=free), []
    fine.system = chain(2)
    inner = fine.evaluate
    fine.evaluate = lambda x, derivatives, equilibrium_guesses: asked.append((x, equilibrium_guesses)) or inner(x)
    guesses = (SimpleNamespace(equilibrium_guess=guess) for guess in (np.array([0.2, -0.4]), None))
    at = replace(coarse.evaluate(coarse.initial_unknowns), episode_predictions=tuple(guesses))
    refined = _FinerModel(fine, {"a": 2.0, "c": 3.0}, _fine_joints_by_coarse_joint(coarse.system, fine.system))
    _gauss_newton_step_in_finer_model(refined, coarse, coarse.initial_unknowns, at)
    [(x, (warm, none))] = asked
    point = dict(zip(fine.unknown_names, x, strict=True))
    assert point == {"a": 3.0, "c[run]": 6.0, "b": 7.0, **dict(zip(names, (0.2, 0.2, 0.0, 0.0), strict=True))}
    np.testing.assert_allclose(warm, [0.1, -0.2, 0.1, -0.2])
    assert none is None


ONE, BOTH = math.hypot(0.1, 0.6), math.hypot(0.1, 0.6, 0.8)


@pytest.mark.parametrize(
    ("links", "time_step", "std"),
    [(None, None, 0.1), (0.1, -0.1, 0.1), (-0.3, 0.05, ONE), (0.05, 0.3, ONE), (0.3, -0.4, BOTH)],
    ids=["not tried", "within it", "links", "time step", "both"],
)
def test_a_move_larger_than_the_standard_deviation_widens_it_to_where_the_limit_is(links, time_step, std):
    shifts = {"a": EstimateShiftByDiscretisation(links, time_step)}
    found = estimates_widened_by_discretisation_error({"a": estimate(10.0, 0.1)}, shifts, {})
    assert found["a"].std == pytest.approx(std)


KEPT = [(0.01, "identifiable"), (0.4, "identifiable"), (0.6, "weak"), (0.4, "weak"), (0.6, "at_bound")]
KEPT += [(30.0, "not_identifiable"), (0.6, "not_trusted")]
LOWERED = [(0.6, "identifiable", "weak"), (30.0, "identifiable", "not_identifiable")]


@pytest.mark.parametrize(("move", "before", "after"), [*((move, said, said) for move, said in KEPT), *LOWERED])
def test_a_verdict_is_lowered_by_moves_and_never_raised(move, before, after):
    """Of a value of 10 and a standard deviation of 0.02: ten percent are reached by a move of half of them."""
    said = {"a": estimate(10.0, 0.02, verdict=before), "b": estimate(10.0, 0.02), "c": estimate(3.0, 0.0, free=False)}
    shifts = {"c": EstimateShiftByDiscretisation(9.0), "a": EstimateShiftByDiscretisation(move)}
    found = estimates_widened_by_discretisation_error(said, shifts, {})
    assert found["a"].verdict == after
    widened = math.inf if after == "not_identifiable" else pytest.approx(math.hypot(0.02, 2 * move))
    assert found["a"].std == (0.02 if move < 0.02 else widened)
    assert found["b"] == said["b"]
    assert found["c"] == said["c"]
    assert replace(found["a"], std=0.02, verdict=before) == said["a"]


@pytest.mark.parametrize(
    ("interval", "expected"),
    [
        ((9.0, 12.0), (9.0 - 1.96 * 0.6, 12.0 + 1.96 * 0.6)),
        ((None, 12.0), (None, 12.0 + 1.96 * 0.6)),
        ((9.0, None), (9.0 - 1.96 * 0.6, None)),
        ((0.2, 19.5), (0.0, 20.0)),
        (None, None),
    ],
    ids=["both", "open below", "open above", "to the bounds", "none"],
)
def test_an_interval_grows_at_its_ends_by_what_the_move_adds(interval, expected):
    said = replace(estimate(10.0, 0.2), interval=interval, lower=0.0, upper=20.0)
    shifts = {"a": EstimateShiftByDiscretisation(0.3)}
    found = estimates_widened_by_discretisation_error({"a": said}, shifts, {})["a"].interval
    assert found == (expected and tuple(end and pytest.approx(end, rel=1e-4) for end in expected))


def test_what_nothing_informs_stays_unknown():
    said = {"a": estimate(10.0, math.inf, verdict="not_identifiable")}
    assert estimates_widened_by_discretisation_error(said, {"a": EstimateShiftByDiscretisation(5.0, 5.0)}, {}) == said


def test_a_problem_takes_the_data_of_another_one(pendulum, twin):
    clean = pendulum()
    first, second = (pendulum(twin(clean, clean.initial_unknowns, seed)) for seed in (1, 2))
    taken_over = discretisation.problem_with_data_of(first, second)
    x = clean.initial_unknowns
    np.testing.assert_array_equal(taken_over.evaluate(x).residual, second.evaluate(x).residual)
    assert not np.array_equal(first.evaluate(x).residual, second.evaluate(x).residual)


def test_half_the_step_of_a_pendulum_is_where_its_own_fit_goes(pendulum, twin):
    """The problem's own answer with half the step is what one Gauss-Newton step says, to second order."""
    clean = pendulum()
    recording = twin(clean, clean.initial_unknowns, 3)
    coarse = pendulum(recording)
    step = compile_step(coarse.system, coarse.step.time_step / 2, coarse.step.force_split, use_compiler=False)
    values = dict(zip(coarse.free, coarse.initial_unknowns, strict=True))
    fine = EstimationProblem(step, [recording], coarse.free, coarse.options, values)
    found = fit_problem(coarse, GaussNewton())
    finer = fit_problem(fine, GaussNewton(), initial_unknowns=found.x)
    own, *_ = _gauss_newton_step_in_finer_model(_FinerModel(fine), coarse, found.x, found.evaluation)
    # without segments there are no links to divide
    told, notes = parameter_shifts_at_finer_discretisation(
        coarse, found.x, found.evaluation, ("links", "time_step"), NULL_PROGRESS
    )
    assert notes == {}
    assert {name: entry.time_step for name, entry in told.items()} == pytest.approx(own, rel=1e-6)
    assert {entry.links for entry in told.values()} == {None}
    left = predicted_refit_residual_at_finer_step(fine, coarse, found.x, found.evaluation, True)
    np.testing.assert_allclose(left, finer.evaluation.residual, atol=1e-6)
    change = finer.x - found.x
    assert np.abs(change).max() > 1e-5
    np.testing.assert_allclose(
        [own[name] for name in coarse.unknown_names], change, rtol=0.1, atol=0.05 * np.abs(change).max()
    )


@pytest.mark.parametrize(
    ("feedback", "encoders"), [("proportional", False), ("proportional", True), ("lqr", True)], ids=str
)
def test_beside_torque_noise_the_coarse_weights_say_where_half_the_step_moves_a_fit(urdf_folder, feedback, encoders):
    """Of steps of 40 ms, of a motion with steps of 2.5 ms: moves of up to three standard deviations."""
    step = pendulum_step(urdf_folder, driven=("shoulder",))
    drawn = taken(step, 3, steps=200, camera=False)
    levels = {"effort_std": 0.05, "effort_bias_std": 0.1, "effort_kind": "command", "position_std": 1e-3}
    points = replace(drawn.points[0], std=np.full(drawn.points[0].position.shape, 1e-3))
    if encoders:  # no points that are made of them
        points = replace(points, name="points_camera", sensor_name="camera", camera_pose=np.eye(4))
    drawn = replace(drawn, joints=replace(drawn.joints, **levels), points=(points,))
    free, gains = ("elbow.damping", "elbow.stiffness"), (9.0,)
    options = ProblemOptions(arm_tracking_feedback=feedback, arm_proportional_gains=gains)
    truth = EstimationProblem(step_with_time_step(step, 0.0025), [drawn], free, options)
    recording = truth.simulate_synthetic_recording(seed=1)
    coarse, anew = (EstimationProblem(step_with_time_step(step, h), [recording], free, options) for h in (0.04, 0.02))
    fine, x = coarse.with_time_step(0.02), coarse.initial_unknowns
    np.testing.assert_array_equal(fine.evaluate(x).residual, anew.evaluate(x).residual)
    found, finer = (fit_problem(problem, GaussNewton()) for problem in (coarse, anew))
    own, left, _ = _gauss_newton_step_in_finer_model(_FinerModel(fine), found.problem, found.x, found.evaluation)
    std = np.array([found.std[name] for name in free])
    change = (finer.x - found.x) / std
    assert np.abs(change).max() > 2
    np.testing.assert_allclose([own[name] for name in free] / std, change, rtol=0.1, atol=0.05)
    # what it leaves is what a fit with that step leaves
    np.testing.assert_array_equal(
        predicted_refit_residual_at_finer_step(fine, found.problem, found.x, found.evaluation), left
    )
    assert left @ left == pytest.approx(2 * finer.evaluation.cost, rel=0.02)


def test_a_brisk_motion_has_a_shorter_step_than_a_calm_one(urdf_folder):
    """Each the longest of 20 ms, 10 ms, ... whose half changes what is predicted by at most 3 % of the noise."""
    step, chosen = pendulum_step(urdf_folder, driven=("shoulder",)), []
    for rate in (1.5, 30.0):
        drawn = taken(step, 3, steps=200, camera=False)
        t = drawn.joints.t[:, None]
        moved = {"position": 0.2 + 0.1 * np.sin(rate * t), "effort": 1.0 + 0.5 * np.sin(rate * t + 1)}
        points = (replace(drawn.points[0], std=np.full(drawn.points[0].position.shape, 5e-3)),)
        joints = replace(drawn.joints, effort_kind="command", effort_std=0.01, **moved)
        drawn = replace(drawn, joints=joints, points=points)
        options = ProblemOptions(arm_tracking_feedback="proportional", arm_proportional_gains=(9.0,))
        truth = EstimationProblem(step_with_time_step(step, 0.00125), [drawn], ("elbow.stiffness",), options)
        recording = truth.simulate_synthetic_recording(seed=1)
        problem = EstimationProblem(step, [recording], ("elbow.stiffness",), options)
        h = longest_accurate_time_step(problem)
        assert h == pytest.approx(0.02 / 2 ** round(math.log2(0.02 / h)))
        errors = [
            _half_step_error(problem.with_time_step(at), problem.with_time_step(at / 2), problem.initial_unknowns)
            for at in (h, 2 * h)
        ]
        assert errors[0] <= 0.03
        assert h == 0.02 or errors[1] > 0.03
        chosen.append(h)
    assert chosen[1] < chosen[0]


H = 0.01


def made(matrices, *, by_torque=None, fixed=(), finite=None):
    """A step whose A is given node by node, of two coordinates, and a rollout that stays where it is."""
    count = len(matrices)
    input_matrix = np.zeros((4, 1)) if by_torque is None else np.array(by_torque, float)[:, None]

    def jacobians(q, p, u, theta, prescribed, z, names):
        return np.array(matrices[int(u[0])], float), input_matrix, None

    system = SimpleNamespace(n_coordinates=2, prescribed_coordinate_indices=fixed)
    step = SimpleNamespace(system=system, sizes={"nx": 4}, time_step=H, jacobians=jacobians)
    state = np.zeros((count + 1, 4))
    if finite is not None:
        state[finite:] = np.nan
    return step, SimpleNamespace(state=state, torque=np.arange(count, dtype=float)[:, None])


def growth(step, rollout, feedback=None, theta=()):
    """Of one recording whose rollout is given."""
    inputs = SimpleNamespace(torque=None, prescribed_path=None)
    inputs.tracking_feedback_with_corrected_reference = lambda *_: feedback
    predictor = SimpleNamespace(
        theta_with_episode_values=lambda _, shared: shared,
        initial_state_and_derivative=lambda *_: SimpleNamespace(failure_message="", state=None),
        corrected_inputs_with_effect_momentum=lambda *_: inputs,
    )
    grid = SimpleNamespace(steps=len(rollout.state) - 1)
    episode = SimpleNamespace(name="motion", grid=grid, tracking_feedback=None, measured_driven_angles=None)
    own = {"system": SimpleNamespace(actuated_coordinate_indices=()), "step": step, "episodes": (episode,)}
    whole = SimpleNamespace(predictor=predictor, unpack_episode_unknowns=lambda *_: (np.array(theta), None), **own)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(discretisation, "simulate", lambda *_: rollout)
        return alternating_error_growth_of_worst_recording(whole, np.zeros(0))


def diagonal(*values):
    return np.diag(np.array(values, float))


def turned(size, degrees):
    """Two modes of a magnitude that turn by an angle in every step, beside two that do not move."""
    a, c, s = np.zeros((4, 4)), np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    a[:2, :2] = size * np.array([[c, -s], [s, c]])
    return a


@pytest.mark.parametrize(
    ("matrix", "factor"),
    [
        (diagonal(-1.3, 0.5, 1, 0), 1.3),
        (diagonal(1.3, 0.5, 1, 0), 0.0),
        (diagonal(1.5, -0.9, -0.2, 0), 0.9),
        (turned(1.2, 170), 1.2),
        (turned(1.2, 91), 1.2),
        (turned(1.2, 89), 0.0),
    ],
    ids=["alternates", "falls over", "dies out", "nearly alternates", "turns back", "swings"],
)
def test_only_what_turns_back_at_every_step_is_the_methods_own(matrix, factor):
    found = growth(*made([matrix] * 10))
    assert found.max_step_factor == pytest.approx(factor)
    assert found.growth_decades == pytest.approx(10 * np.log10(factor) if factor > 1 else 0.0)
    assert found.time_step == H


def test_the_tracking_filter_is_part_of_the_loop():
    """Gains too high for the time step alternate by themselves, others calm what would."""
    matrix = diagonal(0.9, 0.5, -1.2, 0.0)
    step, rollout = made([matrix] * 4, by_torque=[1.0, 0.0, 0.0, 0.0])
    feedback = TrackingFeedback(np.array([0], np.int32), np.full((4, 1, 1), 2.4), np.zeros((4, 1)))
    assert growth(step, rollout).max_step_factor == pytest.approx(1.2)
    assert growth(step, rollout, feedback).max_step_factor == pytest.approx(1.5)
    calm = replace(feedback, state_indices=np.array([2], np.int32), gain=np.full((4, 1, 1), -0.4))
    step, rollout = made([matrix] * 4, by_torque=[0.0, 0.0, 1.0, 0.0])
    assert growth(step, rollout, calm).max_step_factor == pytest.approx(0.8)


def test_growth_is_that_of_the_worst_stretch():
    """Ten steps of ten percent, five that calm it down, three of fifty percent."""
    found = growth(*made([diagonal(-size, 0, 0, 0) for size in [1.1] * 10 + [0.1] * 5 + [1.5] * 3]))
    assert found.growth_decades == pytest.approx(max(10 * np.log10(1.1), 3 * np.log10(1.5)))
    assert found.max_step_factor == pytest.approx(1.5)
    assert found.max_growth_time == pytest.approx(15 * H)
    joined = growth(*made([diagonal(-size, 0, 0, 0) for size in [1.1] * 10 + [0.9] + [1.5] * 3]))
    assert joined.growth_decades == pytest.approx(10 * np.log10(1.1) + np.log10(0.9) + 3 * np.log10(1.5))


def test_a_rollout_that_failed_counts_as_far_as_it_got_without_prescribed_coordinates():
    step, rollout = made([diagonal(-1.2, 0, 0, 0)] * 20, finite=8)
    assert growth(step, rollout).growth_decades == pytest.approx(7 * np.log10(1.2))
    step, rollout = made([diagonal(-1.2, 0, 0, 0)] * 20, finite=1)
    assert growth(step, rollout) == AlternatingErrorGrowth("motion", 0.0, 0.0, 0.0, H)
    broken = [diagonal(-1.2, 0, 0, 0)] * 5 + [np.full((4, 4), np.nan)] * 5
    assert growth(*made(broken)).growth_decades == pytest.approx(5 * np.log10(1.2))
    step, rollout = made([diagonal(-3.0, -1.1, -5.0, 0.3)] * 4, fixed=(0,))
    assert growth(step, rollout).max_step_factor == pytest.approx(1.1)


@pytest.mark.parametrize(("decades", "stable"), [(0.0, True), (6.0, True), (6.1, False)])
def test_what_is_said(decades, stable):
    said = AlternatingErrorGrowth("run", decades, 1.29, 0.35, 0.005)
    told = "too long for the motion of 'run' (small errors grow to 10^6.1 times their size, and 10^6 is tolerated). "
    told += "Set problem.time_step: 0.0025 or less"
    told = f"the time step of 0.005 s is {'stable along the motion of ' + repr('run') if stable else told}"
    assert (said.keeps_errors_below_resolution, said.stability_message) == (stable, told)


def test_a_recording_is_judged_by_its_name(pendulum):
    problem = pendulum()
    assert alternating_error_growth_of_worst_recording(problem, problem.initial_unknowns).keeps_errors_below_resolution
    assert alternating_error_growth_of_worst_recording(problem, problem.initial_unknowns).recording_name == "twin"


NODE = ("symmetric", "node")
"""The rule under which the constraints pull at the nodes, which is what does not bear a light cable's tension."""


@pytest.fixture(scope="module")
def light(tmp_path_factory):
    """light(stiffness, time_step): the step of twenty grams on a metre; `path(time_step)` moves its hands."""
    robot = chain_of_motors(tmp_path_factory.mktemp("hands"), x=("prismatic", "1 0 0"), z=("prismatic", "0 0 1"))

    def build(stiffness, time_step):
        segment = FlexibleSegment("cable", 1.0, 0.02, 0.003, links=8, bend=stiffness, twist=stiffness, damping=1e-4)
        grasps = [Grasp("hand", "hand", "w_cable")]
        objects = [(flexible_object([segment]), None, None)]
        system = System.build(
            robot, objects=objects, grasps=grasps, prescribed=["x", "z"], point_frames=["cable:30%", "cable:60%"]
        )
        return compile_step(system, time_step, *NODE, use_compiler=False)

    return build


def test_readings_at_a_slide_are_in_metres_and_newtons(tmp_path):
    robot = chain_of_motors(tmp_path, z=("prismatic", "0 0 1"), turn=("continuous", "0 1 0"))
    step = compile_step(System.build(robot, prescribed=robot.joint_names), 0.01, use_compiler=False)
    t = 0.01 * np.arange(120)
    group = JointGroup(robot.joint_names, t, np.stack([0.1 * t, t], 1), effort=np.ones((120, 2)), effort_std=0.1)
    problem = EstimationProblem(step, [Recording(group, name="lift")], ["turn.damping"])
    evaluation = problem.evaluate(problem.initial_unknowns)
    seen = channel_predictions(problem.episodes[0], evaluation.episode_predictions[0])
    assert {own.channel: own.unit for own in seen} == {"joints.effort.z": "N", "joints.effort.turn": "N m"}


def moved_hands(step, duration):
    """Times, the hands' path and the rollout from rest."""
    t = step.time_step * np.arange(round(duration / step.time_step) + 1)
    ramp = np.minimum(t / 0.3, 1.0) ** 2
    path = np.stack([0.35 + 0.1 * ramp * np.sin(6 * t), 0.75 + 0.08 * ramp * np.sin(9 * t)], axis=1)
    theta = step.system.parameters.vector()
    return t, path, simulate(step, theta, EquilibriumSolver(step).solve(path[0], theta).state, len(t) - 1, path=path)


@pytest.mark.parametrize(("stiffness", "time_step", "stable"), [(0.5, 0.005, False), (0.5, 0.0025, True)])
def test_a_light_cable_between_two_hands(light, stiffness, time_step, stable):
    """The rollout converges at every step all the same."""
    step = light(stiffness, time_step)
    _, _, rollout = moved_hands(step, 0.4)
    assert rollout.status.is_converged
    found = growth(step, rollout, theta=step.system.parameters.vector())
    assert found.keeps_errors_below_resolution is stable
    assert (found.max_step_factor > 1.1) is not stable


@pytest.fixture(scope="module")
def light_recording(light):
    """The cable as a step of a millisecond moves it, its points seen to a millimetre at 100 Hz."""
    fine = light(0.5, 0.001)
    t, path, rollout = moved_hands(fine, 0.8)
    seen = places(fine.system, fine.system.point_frames, rollout.state[::10, : fine.system.n_coordinates])
    seen += 1e-3 * np.random.default_rng(0).standard_normal(seen.shape)
    points = PointGroup("points", fine.system.point_frames, t[::10], seen, 1e-3)
    return Recording(JointGroup(["x", "z"], t[::5], path[::5], position_std=0.0), (points,), name="light")


@pytest.mark.slow
@pytest.mark.parametrize(("time_step", "status"), [(0.005, Status.STALLED), (0.0025, Status.CONVERGED)])
def test_a_search_that_converged_at_an_unstable_time_step_has_stalled(light, light_recording, time_step, status):
    """At 5 ms the estimate depends on rollouts in which an error grows by more than half per step."""
    options = ProblemOptions(path_cutoff=np.inf)
    problem = EstimationProblem(light(0.3, time_step), [light_recording], ("cable.bend",), options)
    found = fit_problem(problem, GaussNewton())
    assert found.status == Status.CONVERGED
    judged = add_intervals_and_checks(problem, found)
    said = judged.checks.step_stability
    assert judged.status == status
    assert set(said) == {"start", "estimate"}
    if status == Status.STALLED:
        assert judged.message.startswith("the simulation is unstable at the estimate, because the time step of 0.005 s")
        assert found.message in judged.message
    else:
        entry = found.parameters["cable.bend"]
        assert abs(entry.value - 0.5) < 3 * entry.std
        assert judged.message == found.message


@pytest.mark.parametrize(("noise", "moved"), [(0.0, False), (2e-4, True), (2e-3, True)])
def test_noise_of_the_angles_that_move_an_object_widens_its_damping(urdf_folder, noise, moved):
    """It makes the rod vibrate, which a fit damps away: by several standard deviations of the data."""
    robot, springs = read_urdf(urdf_folder / "double_pendulum.urdf"), {"elbow": StiffnessAndRest(60.0)}
    how = {"springs": springs, "damping": {"shoulder": 0.0, "elbow": 0.02}, "prescribed": ["shoulder"]}
    system = System.build(robot, point_frames=["tip"], **how)
    step, t = compile_step(system, 0.005), 0.005 * np.arange(801)
    path = (0.25 * (np.tanh(8 * (t - 0.6)) + np.tanh(4.8)) + 0.3 * np.sin(2 * t) * np.minimum(1, t) ** 2)[:, None]
    rollout = simulate(step, system.parameters.vector(), np.zeros(step.sizes["nx"]), 800, path=path)
    rng = np.random.default_rng(1)
    tip = places(system, ("tip",), rollout.state[:, :2])

    def recorded(name):
        seen, angles = (own + std * rng.standard_normal(own.shape) for own, std in ((tip, 1e-3), (path, noise)))
        arm = JointGroup(["shoulder"], t, angles, position_std=noise)
        return Recording(arm, (PointGroup("points", ("tip",), t, seen, 1e-3),), name=name)

    options = ProblemOptions(path_cutoff=40.0)
    given = EstimationProblem(step, [recorded("rod")], ("elbow.damping",), options, held_out=[recorded("other")])
    fit = fit_problem(given, GaussNewton())
    if noise == 2e-3:  # damping that is too large would hide how far the noise moves the rod
        less, residual = null_test.unknowns_without_encoder_noise_bias(given, fit.x), fit.evaluation.residual
        assert 0.0 < less[0] - 0.02 < 0.5 * (fit.x[0] - 0.02)
        biased = null_test.encoder_noise_residual_covariance_factor(given, fit.x)
        hidden = null_test.whiten_with_drawn_errors(residual, biased[:, :0], biased)
        whitened = null_test.whiten_with_encoder_noise(given, fit.x, residual)
        assert np.linalg.norm(whitened) < 0.998 * np.linalg.norm(hidden)
    found = add_intervals_and_checks(given, fit)
    entry, data_std = found.parameters["elbow.damping"], found.checks.data_std["elbow.damping"]
    shift = found.checks.discretisation_shifts["elbow.damping"].encoder_noise
    assert (abs(entry.value - 0.02) > 5 * data_std) == (abs(shift) > data_std) == moved
    assert abs(entry.value - 0.02) < 2 * entry.std
    [(_, outcome)], expected = found.checks.held_out_predictions, found.checks.expected_prediction_errors["other"]
    error = np.sqrt(np.mean(np.sum((outcome.predicted_outputs[0] - tip[:, 0]) ** 2, axis=1)) + 3e-6)
    assert expected["points.tip"] == pytest.approx(error, rel=0.25)
    noisier, said = null_test.problem_with_encoder_noise_in_points(given, fit.x)
    assert (noisier is not given) == bool(said) == (noise == 2e-3)
    assert not said or np.sqrt(3) * noisier.options.sensors["points"].std == pytest.approx(error, rel=0.25)
    # the scatter of single draws, of either sign, no longer hides the mean
    assert noise < 1e-3 or shift > 0.3 * (entry.value - 0.02)
    if moved:
        slow = given.with_options(ProblemOptions(path_cutoff=4.0))
        assert ["encoder_noise" in discretisation.finer_settings(own) for own in (given, slow)] == [True, False], (
            "no motion is removed"
        )


@pytest.mark.parametrize(
    ("before", "start", "estimate", "after"),
    [
        (Status.CONVERGED, 0.0, 0.0, Status.CONVERGED),
        (Status.CONVERGED, 9.0, 0.0, Status.CONVERGED),
        (Status.CONVERGED, 0.0, 9.0, Status.STALLED),
        (Status.ITERATION_LIMIT, 0.0, 9.0, Status.ITERATION_LIMIT),
        (Status.FAILED, 9.0, 0.0, Status.FAILED),
        (Status.FAILED, 0.0, 0.0, Status.FAILED),
    ],
)
def test_a_search_may_begin_but_not_end_where_the_step_is_not_stable(monkeypatch, before, start, estimate, after):
    decades = {0.0: start, 1.0: estimate}
    grown = {x: AlternatingErrorGrowth("run", size, 1.3, 0.1, H) for x, size in decades.items()}
    monkeypatch.setattr(
        discretisation, "alternating_error_growth_of_worst_recording", lambda problem, x: grown[float(x[0])]
    )
    found = replace(solution(status=before, a=estimated(1.0)), message="done")
    none = dict.fromkeys(("episodes", "held_out", "whitening_filters", "held_out_whitening_filters"), ())
    more = {"initial_unknowns": np.zeros(1), "options": ProblemOptions()}
    more["predictor"] = SimpleNamespace(predict_episode=None)
    empty = SimpleNamespace(**none, **more)
    empty.with_episodes = lambda *_: empty
    judged = add_intervals_and_checks(empty, found)
    said = judged.checks.step_stability
    assert judged.status == after
    assert said["estimate"]["decades"] == estimate
    assert said["start"] == (None if before != Status.FAILED else dict(said["estimate"], decades=start))
    told = "at the estimate" if estimate else "at the start" if start and before == Status.FAILED else ""
    assert judged.message.startswith(f"the simulation is unstable {told}, because the time" if told else "done")
    assert "done" in judged.message
    monkeypatch.setattr(discretisation, "alternating_error_growth_of_worst_recording", lambda problem, x: None)
    unchecked = add_intervals_and_checks(empty, found)
    assert (unchecked.status, unchecked.message) == (before, "done")
    assert unchecked.checks.step_stability == {"start": None, "estimate": None}

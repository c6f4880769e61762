"""The estimation problem, rule by rule: unknowns, priors, scales, starts, what is refused."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.optimize
from small_problems import PENDULUM, H, pendulum_step, recording, seen, taken, tip

from yid_ocp.errors import ConfigError, DataError
from yid_ocp.inference.linearized_residual import residual_and_jacobian_with_stated_priors
from yid_ocp.model.parameters import Parameter, Parameters
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.problem.episodes import mass_matrix_diagonal_at_zero, truncate_episode
from yid_ocp.problem.estimation_problem import held_out_prediction_arguments
from yid_ocp.problem.evaluation import (
    PriorResiduals,
    ResidualVectorLayout,
    UnknownVectorLayout,
    check_initial_values_and_bounds,
)

FREE = ("shoulder.stiffness", "elbow.stiffness", "elbow.rest")
START = {"shoulder.stiffness": 6.0, "elbow.stiffness": 3.0, "elbow.rest": 0.1}


@pytest.fixture(scope="module")
def free_step(urdf_folder):
    return pendulum_step(urdf_folder)


@pytest.fixture(scope="module")
def make(free_step):
    """make(...): two recordings of a pendulum on springs."""

    def build(free=FREE, held_out=(), values=None, may_free=(), seeds=(1, 2), **options):
        recordings = [taken(free_step, seed) for seed in seeds]
        return EstimationProblem(free_step, recordings, free, ProblemOptions(**options), values, held_out, may_free)

    return build


LAYOUT = UnknownVectorLayout(("a", "b"), ("l",), ("q.x", "p.x"), ("one", "two"))


def test_unknowns_are_shared_ones_then_those_of_every_recording():
    own = [f"{name}[{recording}]" for recording in ("one", "two") for name in ("l", "start.q.x", "start.p.x")]
    assert LAYOUT.unknown_names == ("a", "b", *own)
    assert LAYOUT.free_parameter_names == ("a", "b", "l")
    assert LAYOUT.unknown_indices_affecting_recording(0).tolist() == [0, 1, 2, 3, 4]
    assert LAYOUT.unknown_indices_affecting_recording(1).tolist() == [0, 1, 5, 6, 7]


def test_blocks_and_values_find_their_places():
    wide = LAYOUT.scatter_to_unknown_columns(np.arange(10.0).reshape(2, 5), 1)
    np.testing.assert_array_equal(wide[1], [5, 6, 0, 0, 0, 7, 8, 9])
    packed = LAYOUT.pack_same_for_all_recordings({"a": 1, "b": 2, "l": 3}.get, np.array([4, 5]))
    assert packed.tolist() == [1, 2, 3, 4, 5, 3, 4, 5]


def test_a_recording_has_its_own_values_and_start(make):
    problem = make(local_parameters=("elbow.rest",), initial_state="estimated")
    x = np.arange(1.0, 1 + len(problem.unknown_names))
    theta, offset = problem.unpack_episode_unknowns(x, 1)
    names = problem.system.parameters.names
    assert [theta[names.index(name)] for name in ("shoulder.stiffness", "elbow.stiffness", "elbow.rest")] == [1, 2, 8]
    assert offset.tolist() == [9, 10, 11, 12]
    assert theta[names.index("elbow.damping")] == 0.2
    assert problem.unpack_episode_unknowns(x, 0)[1].tolist() == [4, 5, 6, 7]
    assert problem.theta[names.index("elbow.rest")] == 0.1
    assert (problem.shared_parameters, problem.local_parameters) == (FREE[:2], FREE[2:])


def test_start_bounds_and_values_by_name(make):
    problem = make(initial_state="estimated", seeds=(1,))
    named, begin = problem.unknowns.named_values, START | dict.fromkeys(problem.unknown_names[3:], 0.0)
    assert named(problem.initial_unknowns) == begin
    lower, upper = problem.bounds
    assert lower[0] == 0.0
    assert upper[0] == math.inf
    np.testing.assert_array_equal(lower[3:], -np.inf)
    np.testing.assert_array_equal(upper[3:], np.inf)
    found = problem.pack_unknowns({"elbow.stiffness": 9.0, "shoulder.stiffness": -1.0, "start.q.elbow[run_1]": 0.5})
    changed = {"elbow.stiffness": 9.0, "shoulder.stiffness": 0.0, "start.q.elbow[run_1]": 0.5}
    assert named(found) == begin | changed


def test_an_estimated_start_has_a_prior_in_angles_and_momenta(make, momentum, free_step):
    """The momentum's prior is that of a velocity times the inertia at the joint."""
    problem = make(
        initial_state="estimated", initial_configuration_prior_std=0.07, initial_velocity_prior_std=0.3, seeds=(1,)
    )
    theta = free_step.system.parameters.vector()
    inertia = [momentum(free_step, np.zeros(2), velocity, theta)[i] for i, velocity in enumerate(np.eye(2))]
    # two rods: 1/3 m l^2 and more about the shoulder
    assert inertia == pytest.approx([0.0208 + 0.25**2 + 0.008 + 0.6 * 0.7**2, 0.008 + 0.6 * 0.2**2], rel=1e-9)
    expected = [0.07, 0.07, 0.3 * inertia[0], 0.3 * inertia[1]]
    np.testing.assert_allclose(problem.priors.initial_state_stds, expected, rtol=1e-9)
    found = mass_matrix_diagonal_at_zero(free_step, theta, ("elbow", "shoulder"))
    np.testing.assert_allclose(found, inertia[::-1], rtol=1e-9)
    assert problem.unknown_names[3:] == tuple(f"start.{kind}.{joint}[run_1]" for kind in "qp" for joint in PENDULUM)
    assert problem.predictor.estimated_initial_state_indices == (0, 1, 2, 3)
    problem = make()
    assert problem.predictor.estimated_initial_state_indices == ()
    assert problem.priors.initial_state_stds.shape == (0,)
    assert problem.unknown_names == FREE


def test_stated_priors_are_gaussian_about_the_start(make):
    problem = make(prior_stds={"elbow.stiffness": 0.5, "elbow.rest": 0.02}, weak_prior_geometric_std=0.0)
    residual, rows = problem.priors.residual_and_jacobian(np.array([7.0, 4.0, 0.14]))
    np.testing.assert_allclose(residual, [2.0, 2.0])
    np.testing.assert_allclose(rows, [[0.0, 2.0, 0.0], [0.0, 0.0, 50.0]])
    assert problem.residual_rows.stated_priors.stop - problem.residual_rows.stated_priors.start == 2
    assert problem.residual_rows.weak_priors.stop == problem.residual_rows.weak_priors.start


def test_weak_priors_are_log_normal_and_only_of_positive_unknowns_without_another(make):
    problem = make(prior_stds={"shoulder.stiffness": 2.0}, weak_prior_geometric_std=10.0)
    residual, rows = problem.priors.residual_and_jacobian(np.array([7.0, 30.0, 0.5]))
    np.testing.assert_allclose(residual, [0.5, 1.0])
    np.testing.assert_allclose(rows, [[0.5, 0.0, 0.0], [0.0, 1 / (math.log(10.0) * 30.0), 0.0]])
    assert problem.positive_unknowns_mask.tolist() == [True, True, False]
    rows_of, at = problem.residual_rows, problem.residual_rows.data.stop + 1
    assert (rows_of.weak_priors, rows_of.slice_of_data_and_stated_priors) == (slice(at, at + 1), slice(0, at))
    # at its bound the row is one that a step can follow: a thousandth of the start has its value but for 0.65
    low, slope = problem.priors.residual_and_jacobian(np.array([7.0, 0.0, 0.5]))
    assert low[1] == pytest.approx(-3.0 - 1.5 / math.log(10.0))
    assert slope[1, 1] == pytest.approx(2000.0 / (math.log(10.0) * 3.0))


def test_the_weak_priors_logarithm_ends_smoothly_where_the_ratio_is_small():
    ratio = np.array([0.0, 1e-6, 5e-4, 0.999e-3, 1.001e-3, 0.1, 1.0, 700.0])
    weak = PriorResiduals(np.ones(8), np.zeros((0, 8)), np.zeros(0), np.arange(8), 1.0)
    value, slopes = weak.residual_and_jacobian(ratio)
    slope = np.diag(slopes)
    np.testing.assert_array_equal(value[4:], np.log(ratio[4:]))
    step = 1e-7 * np.maximum(ratio, 1e-2)
    np.testing.assert_allclose((weak.residual_and_jacobian(ratio + step)[0] - value) / step, slope, rtol=1e-5)
    assert np.all(np.diff(value) > 0)
    assert slope[3] == pytest.approx(slope[4], rel=3e-3)


@pytest.mark.parametrize(
    "options", [{"weak_prior_geometric_std": 1.0}, {"weak_prior_geometric_std": 0.0}, {"weighting": "paper"}]
)
def test_some_problems_have_no_weak_prior(make, options):
    problem = make(**options)
    residual, rows = problem.priors.residual_and_jacobian(problem.initial_unknowns)
    assert residual.shape == (0,)
    assert rows.shape == (0, 3)
    assert make(weak_prior_geometric_std=1.1).priors.residual_and_jacobian(problem.initial_unknowns)[0].shape == (2,)


def test_an_unknown_is_as_large_as_its_start_its_prior_or_a_tenth_of_its_range(make):
    values = {"shoulder.stiffness": 0.0, "elbow.stiffness": 0.0, "elbow.rest": 0.0}
    problem = make(values=values, prior_stds={"elbow.stiffness": 0.25}, initial_state="estimated", seeds=(1,))
    np.testing.assert_allclose(problem.unknown_scales[:2], [1.0, 0.25])
    np.testing.assert_allclose(problem.unknown_scales[3:], problem.priors.initial_state_stds)
    lower, upper = problem.bounds
    width = upper[2] - lower[2]
    assert problem.unknown_scales[2] == pytest.approx(0.1 * width if math.isfinite(width) else 1.0)
    np.testing.assert_allclose(make(values={"elbow.rest": -0.4}).unknown_scales, [6.0, 3.0, 0.4])


def test_the_residual_is_made_of_measurements_then_priors(make):
    problem = make(prior_stds={"elbow.stiffness": 1.0}, weak_prior_geometric_std=5.0)
    evaluation = problem.evaluate(problem.initial_unknowns + np.array([1.0, 2.0, 0.1]))
    rows = problem.residual_rows
    assert [[part.stop - part.start for part in group] for group in rows.measurements] == [[75, 39], [75, 39]]
    assert rows.measurements[1][0] == slice(114, 189)
    assert (rows.data, rows.stated_priors, rows.weak_priors) == (slice(0, 228), slice(228, 229), slice(229, 230))
    np.testing.assert_allclose(evaluation.residual[228:], [2.0, math.log(7.0 / 6.0) / math.log(5.0)])
    assert evaluation.cost == pytest.approx(0.5 * evaluation.residual @ evaluation.residual)
    residual, jacobian = residual_and_jacobian_with_stated_priors(problem, evaluation)
    np.testing.assert_array_equal(residual, evaluation.residual[:229])
    np.testing.assert_array_equal(jacobian, evaluation.jacobian[:229])
    none = ResidualVectorLayout.from_episodes((), 2, 3)
    assert none == ResidualVectorLayout((), slice(0, 0), slice(0, 2), slice(2, 5))


@pytest.mark.parametrize("stated", [None, 2.0], ids=["small", "more than a metre"])
def test_the_papers_rows_are_metres_and_inform_in_units_of_the_noise(make, stated):
    names = () if stated is None else sorted({s.sensor.group_name for s in make().episodes[0].measurements})
    sensors = {name: SensorOptions(std=stated) for name in names}
    problem = make(weighting="paper", prior_stds={"elbow.stiffness": 1.0}, sensors=sensors)
    evaluation = problem.evaluate(problem.initial_unknowns + np.array([0.0, 2.0, 0.0]))
    # 75 coordinates of 2 cm and 39 of 5 cm in each recording
    noise = stated or math.sqrt((75 * 0.02**2 + 39 * 0.05**2) / 114)
    assert problem.stated_rms_noise_of_data_residuals == pytest.approx(noise)
    residual, jacobian = residual_and_jacobian_with_stated_priors(problem, evaluation)
    data = problem.residual_rows.data
    np.testing.assert_allclose(residual[data], evaluation.residual[data] / noise)
    np.testing.assert_allclose(jacobian[data], evaluation.jacobian[data] / noise)
    assert residual[-1] == 2.0
    assert jacobian[-1].tolist() == [0.0, 1.0, 0.0]
    assert make().stated_rms_noise_of_data_residuals == 1.0


def test_predictions_are_those_of_a_rollout_from_rest(make, free_step, roll):
    """Readings of the tip, interpolated between nodes, in the camera's frame: nothing else enters the residual."""
    problem = make(seeds=(1,))
    x = problem.pack_unknowns({"elbow.stiffness": 4.0})
    evaluation = problem.evaluate(x, derivatives=False)
    assert evaluation.jacobian is None
    result = evaluation.episode_predictions[0]
    theta, _ = problem.unpack_episode_unknowns(x, 0)
    state = result.equilibrium.state
    np.testing.assert_allclose(result.rollout.state, roll(free_step, theta, state[:2], state[2:], 24).state, atol=1e-12)

    places = np.stack([tip(q) for q in result.rollout.state[:, :2]])
    episode = problem.episodes[0]
    seen_tip = (places - episode.measurements[0].value) / 0.02
    np.testing.assert_allclose(evaluation.residual[:75], seen_tip.ravel(), atol=1e-9)
    camera = episode.measurements[1]
    t = H * (camera.node + camera.fraction)
    between = np.stack([np.interp(t, H * np.arange(25), places[:, i]) for i in range(3)], axis=1)
    expected = (between - camera.value[:, 3:]) / 0.05
    good = np.isfinite(camera.value)
    rows = np.full(camera.value.shape, np.nan)
    rows[good] = evaluation.residual[75:114]
    np.testing.assert_allclose(rows[:, 3:], expected, atol=1e-9)


@pytest.mark.filterwarnings("ignore:overflow")
def test_costs_and_derivatives_that_are_not_finite_are_failures(make, monkeypatch):
    problem = make(free=("elbow.rest",), prior_stds={"elbow.rest": 1e-200})
    failing = problem.evaluate(problem.initial_unknowns + 0.01)
    assert (failing.ok, failing.cost, failing.jacobian) == (False, math.inf, None)
    assert "cost is not finite" in failing.message
    problem = make(free=("elbow.rest",), prior_stds={"elbow.rest": 1.0})
    steep = SimpleNamespace(residual_and_jacobian=lambda x: (np.zeros(1), np.full((1, 1), np.inf)))
    monkeypatch.setattr(problem, "priors", steep)
    failing = problem.evaluate(problem.initial_unknowns)
    assert (failing.ok, failing.cost, failing.jacobian) == (False, math.inf, None)
    assert "derivatives are not finite" in failing.message
    assert problem.evaluate(problem.initial_unknowns, derivatives=False).ok


def test_a_problem_whose_rollout_fails_says_why(make):
    problem = make(free=("elbow.rest",))
    failing = problem.evaluate([1e8])
    assert not failing.ok
    assert (failing.cost, failing.jacobian) == (math.inf, None)
    assert failing.episode_predictions == failing.equilibrium_guesses == ()
    assert failing.message.startswith("in 'run_1', no equilibrium was found")
    cost, gradient, same = problem.cost_and_gradient([1e8])
    assert (cost, gradient.tolist(), same.ok) == (math.inf, [0.0], False)


@pytest.fixture(scope="module")
def held(free_step, make, roll):
    """Two swings from near rest, the tip seen."""
    rest = make().evaluate(list(START.values()), False).episode_predictions[0].equilibrium.state
    theta = free_step.system.parameters.vector()
    found = []
    for seed in (8, 9):
        rng = np.random.default_rng(seed)
        start = rest + np.array([0.03, 0.05, 0.01, 0.005]) * rng.standard_normal(4)
        q = roll(free_step, theta, start[:2], start[2:], 24).state[:, :2]
        place = np.stack([tip(row) for row in q])[:, None]
        place += 0.005 * rng.standard_normal(place.shape)
        t = 1.0 + H * np.arange(25)
        found.append(recording(None, seen(["tip"], t, place, std=np.full(place.shape, 0.02)), name=f"run_{seed}"))
    return found


@pytest.mark.parametrize(("configuration", "velocity"), [(0.05, 0.2), (0.01, 0.05), (1.0, 5.0)])
def test_a_held_out_start_balances_its_prior_and_its_first_moments(make, held, configuration, velocity):
    options = {
        "initial_state": "estimated",
        "initial_configuration_prior_std": configuration,
        "initial_velocity_prior_std": velocity,
    }
    problem = make(held_out=held, **options)
    x = problem.initial_unknowns
    short = truncate_episode(problem.held_out[1], 20)
    theta, _ = problem.unpack_episode_unknowns(x, 0)

    std = problem.priors.initial_state_stds

    def rows(offset):
        result = problem.predictor.predict_episode(short, theta, offset, False)
        pairs = zip(short.measurements, result.predicted_outputs, strict=True)
        return np.concatenate([*(samples.whitened_residual(y).ravel() for samples, y in pairs), offset / std])

    best = scipy.optimize.least_squares(rows, np.zeros(4), x_scale=std, xtol=1e-12, ftol=1e-14)
    np.testing.assert_allclose(held_out_prediction_arguments(problem, x)[1][2] / std, best.x / std, atol=2e-3)


def test_held_out_recordings_are_predicted_with_shared_parameters_only(make, held):
    problem = make(held_out=held, local_parameters=("elbow.rest",), initial_state="estimated")
    x = problem.pack_unknowns({"elbow.stiffness": 4.0, "elbow.rest[run_1]": 0.7})
    found = problem.predict_held_out(x)
    assert [episode.name for episode, _ in found] == ["run_8", "run_9"]
    offsets = [offset for *_, offset in held_out_prediction_arguments(problem, x)]
    for (episode, result), offset in zip(found, offsets, strict=True):
        theta = problem.system.parameters.vector({"elbow.stiffness": 4.0, "elbow.rest": 0.1})
        expected = problem.predictor.predict_episode(episode, theta, offset, False)
        np.testing.assert_allclose(result.predicted_outputs[0], expected.predicted_outputs[0], atol=1e-12)
        assert np.any(offset)


def test_a_held_out_part_of_a_recording_shares_its_start_and_local_parameters(make):
    problem = make(initial_state="estimated", local_parameters=("elbow.rest",))
    split = problem.with_episodes(problem.episodes, [replace(problem.episodes[1], initial_state_shared_with=1)])
    x = problem.pack_unknowns({name: 0.01 * i for i, name in enumerate(problem.unknown_names[3:])})
    assert held_out_prediction_arguments(split, x)[0][2].tolist() == problem.unpack_episode_unknowns(x, 1)[1].tolist()
    np.testing.assert_array_equal(
        split.predict_held_out(x)[0][1].predicted_outputs[0],
        problem.evaluate(x, False).episode_predictions[1].predicted_outputs[0],
    )


def test_the_first_moments_are_at_least_two_steps_of_a_fifth_of_a_second(make, held):
    problem = make(held_out=held, initial_state="estimated")
    episode, x = problem.held_out[0], problem.initial_unknowns
    for first, same in ((21, True), (20, False)):
        changed = episode.measurements[0].value.copy()
        changed[first:] += 0.3
        moved = replace(episode, measurements=(replace(episode.measurements[0], value=changed),))
        other = problem.with_episodes(problem.episodes, [moved])
        offsets = [held_out_prediction_arguments(one, x)[0][2] for one in (problem, other)]
        assert np.allclose(*offsets, atol=1e-12) is same
    # a start at rest needs none
    assert held_out_prediction_arguments(make(held_out=held), np.array([6.0, 3.0, 0.1]))[0][2].shape == (0,)


def test_problems_that_free_other_parameters_share_all_else(make):
    problem = make(may_free=("elbow.damping",), local_parameters=("elbow.rest",))
    other = problem.with_free_parameters_without_recompiling(("elbow.damping", "shoulder.stiffness"))
    assert other.unknown_names == ("elbow.damping", "shoulder.stiffness")
    assert other.episodes is problem.episodes
    assert other.model_functions is problem.model_functions
    whole = make(free=("elbow.damping", "shoulder.stiffness"))
    one, two = other.evaluate(other.initial_unknowns), whole.evaluate(whole.initial_unknowns)
    np.testing.assert_allclose(one.residual, two.residual, atol=1e-9)
    np.testing.assert_allclose(one.jacobian, two.jacobian, atol=1e-7)
    moved = problem.with_parameter_values({"elbow.damping": 0.9})
    assert moved.theta[problem.system.parameters.index("elbow.damping")] == 0.9
    assert problem.theta[problem.system.parameters.index("elbow.damping")] == 0.2
    assert moved.episodes is problem.episodes


def test_problems_prepared_anew_keep_what_is_not_changed(make, held):
    problem = make(
        held_out=held, values={"elbow.damping": 0.7}, prior_stds={"elbow.rest": 0.1}, local_parameters=("elbow.rest",)
    )
    index = problem.system.parameters.index
    shorter = problem.with_episodes(problem.episodes, ()).with_options(replace(problem.options, duration=0.1))
    assert (shorter.episodes[0].grid.steps, shorter.held_out, shorter.free) == (10, (), FREE)
    assert shorter.theta[index("elbow.damping")] == 0.7
    changed = problem.with_options(replace(problem.options, weak_prior_geometric_std=3.0))
    assert (changed.options.weak_prior_geometric_std, len(changed.held_out), changed.free) == (3.0, 2, FREE)
    assert changed.theta[index("elbow.damping")] == 0.7


def test_a_problem_cannot_be_changed_through_its_parameters(make):
    with pytest.raises(ValueError, match="read-only"):
        make().theta[0] = 1.0


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"free": ("elbow.stiffness", "elbow.stiffness")}, "listed twice"),
        ({"free": ("elbow.stiff",)}, "elbow.stiffness"),
        ({"local_parameters": ("elbow.damping",)}, "'elbow.damping' has a value per recording"),
        ({"prior_stds": {"elbow.damping": 0.1}}, "'elbow.damping' has a prior, but"),
        ({"values": {"elbow.stiffness": -1.0}}, "elbow.stiffness"),
        ({"seeds": (1, 1)}, "two recordings are called 'run_1'"),
        ({"parameters_by_recording": {"run_2": {"elbow.rest": 0.3}}}, "'elbow.rest' is free, but the recording has a"),
    ],
)
def test_what_does_not_fit_is_refused(make, given, words):
    with pytest.raises(ConfigError, match=words):
        make(**given)


@pytest.mark.parametrize(
    ("bounds", "words"),
    [
        ((4.0, 9.0), r"k = 3 N m/rad lies below its lower bound of 4 N m/rad"),
        ((0.0, 2.0), r"k = 3 N m/rad lies above its upper bound of 2 N m/rad"),
        ((3.0, 3.0), "are equal"),
    ],
)
def test_a_free_parameter_has_room_about_its_start(bounds, words):
    lower, upper = bounds
    system = SimpleNamespace(parameters=Parameters([Parameter("k", lower, "N m/rad", lower, upper)]))
    with pytest.raises(ConfigError, match=words):
        check_initial_values_and_bounds(system, ("k",), np.array([3.0]))
    check_initial_values_and_bounds(system, (), np.array([3.0]))
    for value in (lower, upper) if lower < upper else ():
        check_initial_values_and_bounds(system, ("k",), np.array([value]))


def test_there_must_be_something_to_estimate_on(free_step):
    with pytest.raises(DataError, match="no recording to estimate from"):
        EstimationProblem(free_step, [], FREE)
    t = H * np.arange(10)
    hidden = recording(None, seen(["tip"], t, np.full((10, 1, 3), np.nan), std=np.ones((10, 1, 3))))
    with pytest.raises(DataError, match="no sensor of the model has a measurement"):
        EstimationProblem(free_step, [hidden], FREE)
    unused = ProblemOptions(sensors={"points": SensorOptions(use=False)})
    with pytest.raises(DataError, match="no sensor of the model has a measurement"):
        EstimationProblem(free_step, [hidden], FREE, unused)

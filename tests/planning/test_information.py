"""Motions that tell more: what they would tell, the criteria and their derivatives, known optima, what is refused."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from small_problems import pendulum_step, taken

from yid_ocp.analysis.identifiability import identifiability
from yid_ocp.display import NULL_PROGRESS
from yid_ocp.errors import ConfigError, YidError
from yid_ocp.planning.information_plan import plan_informative_motion
from yid_ocp.planning.joint_paths import PlanLimits, PlanOptions
from yid_ocp.planning.motion_search import DOptimalityCriterion, EffectDiscriminationCriterion, InformativeMotionSearch
from yid_ocp.planning.planned_experiment import SplineMotionExperiment
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions

PAIR = ("joint_coulomb@shoulder", "joint_viscous@shoulder")
FREE = ("elbow.stiffness", "elbow.damping")
LIMITS = PlanLimits(max_acceleration=15.0, max_spring_angle=1.0)
SIZES = {"duration": 1.0, "hold_duration": 0.4, "n_spline_coefficients": 4, "n_random_starts": 2}
OPTIONS = PlanOptions(goal="information", limits=LIMITS, **SIZES)


def problem_of(limited_urdf, free=FREE, **how):
    step = pendulum_step(limited_urdf.parent, **how)
    options = ProblemOptions(path_cutoff=15.0, arm_tracking_feedback="none")
    return EstimationProblem(step, [taken(step, 3, steps=140)], free, options)


@pytest.fixture(scope="module")
def moved_problem(limited_urdf):
    return problem_of(limited_urdf, prescribed=("shoulder",))


@pytest.fixture(scope="module")
def driven_problem(limited_urdf):
    return problem_of(limited_urdf, driven=("shoulder",))


@pytest.fixture(scope="module")
def moved_experiment(moved_problem):
    return SplineMotionExperiment(moved_problem, {}, OPTIONS)


@pytest.fixture(scope="module")
def driven_experiment(driven_problem):
    return SplineMotionExperiment(driven_problem, {}, OPTIONS)


@pytest.fixture(scope="module")
def told(moved_problem):
    return plan_informative_motion(moved_problem, OPTIONS)


def some_motion(experiment, seed=0, size=0.1):
    return size * np.random.default_rng(seed).normal(size=experiment.zero_coefficients.shape)


def test_sensors_tell_as_much_in_a_second_as_in_the_recording(driven_problem, driven_experiment):
    experiment = driven_experiment
    w = some_motion(experiment)
    planned, base = experiment.problem_with_planned_recording_only(w), driven_problem
    spent = base.episodes[0].grid.steps * base.step.time_step
    for new, old in zip(planned.episodes[0].measurements, base.episodes[0].measurements, strict=True):
        assert new.sensor.channel_names == old.sensor.channel_names
        length = len(new.node) * (new.node[1] - new.node[0]) * base.step.time_step
        after, before = (np.sum(samples.weight**2, axis=0) for samples in (new, old))
        np.testing.assert_allclose(after / length, before / spent, rtol=1e-9)
    joints = experiment._noise_free_recording(w).joints
    path = experiment.simulator.joint_positions(w)[: len(joints.t)]
    np.testing.assert_allclose(joints.position, path, atol=1e-12)
    assert np.ravel(joints.effort_std) == pytest.approx(0.3)
    # the model itself, driven by these torques, goes where they came from
    evaluation = planned.evaluate(planned.initial_unknowns)
    pairs = zip(planned.episodes[0].measurements, evaluation.episode_predictions[0].predicted_outputs, strict=True)
    assert max(np.abs(samples.whitened_residual(predicted)).max() for samples, predicted in pairs) < 0.1


@pytest.mark.parametrize("kind", ["moved_experiment", "driven_experiment"])
def test_slopes_are_derivatives_of_the_sensitivities(kind, request):
    experiment = request.getfixturevalue(kind)
    w, way = some_motion(experiment), some_motion(experiment, 1, 1.0)
    rows, e = experiment.sensitivities_to_unknowns(w), 1e-4
    slope = np.tensordot(way.ravel(), experiment.sensitivity_derivatives_by_coefficients(w, rows), 1)
    after, before = (experiment.sensitivities_to_unknowns(w + sign * e * way) for sign in (1, -1))
    central = (after - before) / (2 * e)
    np.testing.assert_allclose(slope, central, atol=2e-3 * np.abs(central).max())


def test_prescribed_arms_tell_what_identifiability_says(moved_experiment):
    w = some_motion(moved_experiment, size=0.3)
    searched = moved_experiment.sensitivities_to_unknowns(w)
    judged = identifiability(moved_experiment.problem_with_planned_recording_only(w))
    # the search sees fewer samples of points, each telling more
    np.testing.assert_allclose(np.diag(searched.T @ searched), np.diag(judged.fisher_information), rtol=0.05)


def test_driven_arms_tell_about_what_the_innovations_say(driven_experiment):
    for seed in range(2):
        w = some_motion(driven_experiment, seed, 0.3)
        searched = driven_experiment.sensitivities_to_unknowns(w)
        judged = driven_experiment.planned_recording_sensitivities(w)
        for criterion in (DOptimalityCriterion((i,), (0, 1)) for i in (0, 1)):  # logarithms of standard deviations
            told, true = (criterion.value_and_gradient_wrt_sensitivities(rows)[0] for rows in (searched, judged))
            assert told == pytest.approx(true, abs=0.5)


ROWS = np.random.default_rng(4).normal(size=(30, 7))
APART = ((3,), (4, 5)), (np.array([[2.0]]), np.diag([0.5, 3.0])), (0, 1, 2, 3, 4, 5)
CRITERIA = {
    "all": DOptimalityCriterion((0, 1, 2), (0, 1, 2)),
    "one": DOptimalityCriterion((1,), (0, 1, 2)),
    "apart": EffectDiscriminationCriterion(*APART),
}


@pytest.mark.parametrize("name", CRITERIA)
def test_criteria_know_their_derivatives(name):
    criterion, way, e = CRITERIA[name], np.random.default_rng(5).normal(size=ROWS.shape), 1e-6
    _, slope = criterion.value_and_gradient_wrt_sensitivities(ROWS)
    after, before = (criterion.value_and_gradient_wrt_sensitivities(ROWS + sign * e * way)[0] for sign in (1, -1))
    assert float(np.sum(slope * way)) == pytest.approx((after - before) / (2 * e), rel=1e-6)


def test_precision_is_that_of_the_marginal_standard_deviation():
    wide = np.vstack([1e3 * ROWS, np.eye(7)[3:]])
    covariance = np.linalg.inv(wide.T @ wide)
    criteria = (DOptimalityCriterion(chosen, (0, 1, 2)) for chosen in ((1,), (0, 1)))
    one, both = (criterion.value_and_gradient_wrt_sensitivities(wide)[0] for criterion in criteria)
    assert one == pytest.approx(-0.5 * np.log(covariance[1, 1]), abs=1e-5)
    assert both == pytest.approx(-0.5 * np.log(np.linalg.det(covariance[:2, :2])), abs=1e-5)
    # with no data a parameter is known to within 400 %
    assert CRITERIA["one"].value_and_gradient_wrt_sensitivities(np.zeros((1, 7)))[0] == pytest.approx(-np.log(4.0))


def test_distances_are_what_others_cannot_explain():
    criterion = CRITERIA["apart"]
    rows = np.zeros((6, 7))
    rows[[0, 1, 2], [3, 4, 5]] = 50.0, 20.0, 10.0
    rows[0, 0] = 1e4  # a free parameter does to the data what the first effect does
    first, second = criterion.imitation_distance(rows, 0, 1), criterion.imitation_distance(rows, 1, 0)
    assert first < 0.2
    assert second == pytest.approx(np.sqrt((10.0**2 + 30.0**2) / 2))
    rows[3, 3] = 7.0  # now a reading of its own
    assert criterion.imitation_distance(rows, 0, 1) == pytest.approx(14.0, rel=1e-3)


def line(w):
    """Readings of a straight line at two places: its height and its slope are sought."""
    return 1e3 * np.column_stack([np.ones(2), w.ravel()])


def searched(limits, rounds=50):
    """What a search found over two places from -1 to 1.5 at which a line is read, within values and bounds."""

    def slopes(w, here):
        return np.array([(line(w + 1e-6 * e.reshape(w.shape)) - here) / 1e-6 for e in np.eye(2)])

    values, upper = limits
    bounds = np.full((2, 1), -1.0), np.full((2, 1), 1.5)
    simulator = SimpleNamespace(coefficient_bounds=lambda: bounds, simulate_path=lambda w, slopes=False: w)
    read = {"sensitivities_to_unknowns": line, "sensitivity_derivatives_by_coefficients": slopes}
    experiment = SimpleNamespace(simulator=simulator, planned_recording_sensitivities=line, **read)
    bounded = [SimpleNamespace(unit=np.ones(len(upper)), lower=-np.inf * np.ones(len(upper)), upper=np.array(upper))]
    kept = SimpleNamespace(limit_rows=bounded, constraints_and_jacobian=lambda rolled, w: values(w.ravel()))
    search = InformativeMotionSearch(experiment, kept, DOptimalityCriterion((0, 1), (0, 1)))
    return search.improve_motion(np.array([[0.1], [-0.05]]), rounds, NULL_PROGRESS)


def straight(matrix):
    return lambda w: (np.array(matrix) @ w, np.array(matrix))


def test_a_straight_line_is_read_at_the_ends_of_its_range():
    found = searched((straight([[0.0, 0.0]]), [1.0]))
    assert found.is_converged
    np.testing.assert_allclose(np.sort(found.w.ravel()), [-1.0, 1.5], atol=1e-6)
    assert found.final_criterion > found.initial_criterion


KEPT = [((straight([[1.0, -1.0], [-1.0, 1.0]]), [0.8, 0.8]), 0.8)]  # the places are no more than 0.8 apart
KEPT += [((lambda w: (np.array([w @ w]), 2 * w[None, :]), [0.36]), 2 * 0.6 / 2**0.5)]  # in a circle of radius 0.6


@pytest.mark.parametrize(("limits", "apart"), KEPT)
def test_a_limit_is_kept_on_the_way_and_used_up_in_the_end(limits, apart):
    for rounds in (1, 2, 50):
        found = searched(limits, rounds)
        assert np.all(limits[0](found.w.ravel())[0] <= limits[1])
        assert -1.0 <= found.w.min() <= found.w.max() <= 1.5
    assert abs(float(np.diff(found.w.ravel())[0])) == pytest.approx(apart, abs=5e-3)


def test_the_motion_tells_more_than_those_it_came_from(told, moved_problem):
    assert told.is_successful, told.message
    assert len(told.start_results) == OPTIONS.n_random_starts
    assert all(start.final_criterion > start.initial_criterion + 0.3 for start in told.start_results)
    best = max(told.start_results, key=lambda start: start.configured_criterion)
    assert np.array_equal(told.spline_coefficients, best.w)
    before = identifiability(moved_problem)
    for name, known in told.parameter_precisions.items():
        assert known.std_recorded == pytest.approx(before.parameters[name].std_relative)
        assert known.std_combined <= min(known.std_recorded, known.std_planned)
    stiffness = told.parameter_precisions["elbow.stiffness"]
    assert stiffness.std_planned < stiffness.std_recorded


def test_it_starts_and_ends_at_rest_within_limits(told):
    for values in (told.joint_velocities, told.joint_accelerations):
        np.testing.assert_allclose(values[[0, -1]], 0.0, atol=1e-9)
    assert np.abs(told.joint_accelerations).max() <= 15.0 * (1 + 1e-6)
    assert np.abs(told.joint_efforts).max() <= 0.9 * 40.0 * (1 + 1e-6)
    assert np.all(np.abs(told.joint_positions) <= 1.2 + 1e-9)
    elbow = told.simulator.step.system.mechanism.joint_index("elbow")
    assert np.abs(told.rollout.state[::2, elbow]).max() <= 1.0
    # what tells much goes to the limits
    assert told.active_limits
    assert all(names in (("shoulder",), ("elbow",)) for names in told.active_limits.values())


QUICK = replace(OPTIONS, n_random_starts=1, max_iterations=1, n_spline_coefficients=2)


def test_the_same_seed_gives_the_same_motion(moved_problem):
    plans = [plan_informative_motion(moved_problem, replace(QUICK, seed=seed)) for seed in (0, 0, 1)]
    assert plans[0].message.startswith("plan.max_iterations ended the search (1 round).")
    first, again, other = (plan.spline_coefficients for plan in plans)
    np.testing.assert_array_equal(first, again)
    assert not np.allclose(first, other)


def test_two_effects_are_moved_apart(driven_problem):
    options = replace(OPTIONS, effects_to_discriminate=PAIR, n_random_starts=1, max_iterations=4)
    found = plan_informative_motion(driven_problem, options)
    assert set(found.effect_distances) == {PAIR, PAIR[::-1]}
    for before, after in found.effect_distances.values():
        assert after > 1.5 * before


def test_effects_of_twice_the_size_lie_twice_as_far_apart(driven_problem):
    quick, told = replace(QUICK, effects_to_discriminate=PAIR), []
    for factor in (1.0, 2.0):
        sizes = {PAIR[0]: {"tau_c": 0.2 * factor}, PAIR[1]: {"b": 0.05 * factor}}
        told.append(plan_informative_motion(driven_problem, quick, None, sizes).effect_distances)
    for key in told[0]:
        assert told[1][key][0] == pytest.approx(2 * told[0][key][0], rel=1e-3)


def test_a_parameter_that_nothing_sees_is_named_and_the_others_are_told(refused_with, limited_urdf):
    problem = problem_of(limited_urdf, free=("elbow.stiffness", "shoulder.damping"), prescribed=("shoulder",))
    blind = problem.with_options(replace(problem.options, sensors={"joints.effort": SensorOptions(use=False)}))
    found = plan_informative_motion(blind, replace(OPTIONS, n_random_starts=1, max_iterations=3))
    assert set(found.unobservable_parameters) == {"shoulder.damping"}
    damping = found.parameter_precisions["shoulder.damping"]
    assert damping.std_planned == damping.std_combined == np.inf
    assert found.parameter_precisions["elbow.stiffness"].std_planned < 1.0
    with refused_with(
        ConfigError, ("determines shoulder.damping", "a parameter that changes readings", "readings by 0 std")
    ):
        plan_informative_motion(blind, replace(OPTIONS, parameters_to_identify=("shoulder.damping",)))
    servos = SimpleNamespace(servos=(1,), driven=(1,))
    words = {
        "a": r"a plan cannot move clamps(.|\n)*try: let a robot",
        "": r"of servos(.|\n)*goal(.|\n)*leave servo_\* out",
    }
    for clamps, said in words.items():
        options = SimpleNamespace(clamp_pose_point_names=clamps)
        of = SimpleNamespace(system=problem.system if clamps else servos, episodes=[None], options=options)
        with pytest.raises(ConfigError, match=said):
            SplineMotionExperiment(of, {}, OPTIONS)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (
            {"parameters_to_identify": ("elbow.stifness",)},
            ("no parameter 'elbow.stifness'", "did you mean 'elbow.stiffness'?"),
        ),
        ({"parameters_to_identify": ()}, ("plan.parameters_to_identify is empty", "elbow.stiffness")),
        ({"parameters_to_identify": FREE, "effects_to_discriminate": ("joint_viscous@elbow",)}, ("one of the two",)),
        (
            {"effects_to_discriminate": ("joint_viscous@elbow",)},
            ("two effects are needed, but the list has 1", "plan.effects_to_discriminate", "two effects or more"),
        ),
        ({"effects_to_discriminate": ("joint_viscous", "joint_coulomb@elbow")}, ("has no location", "KIND@LOCATION")),
        ({"effects_to_discriminate": ("joint_viscus@elbow", PAIR[0])}, ("no effect 'joint_viscus'", "joint_viscous")),
        ({"effects_to_discriminate": ("joint_viscous@elbw", "joint_coulomb@elbow")}, ("elbw", "elbow")),
        ({"start_joint_positions": {"shoulder": 1.5}}, ("which is 0.3 rad beyond its limit",)),
        ({"limits": PlanLimits(effort_fraction=1e-4)}, ("exceed their limits before they move", "limit 0.004")),
        ({"n_random_starts": 0}, ("n_random_starts is 0", "from 1")),
    ],
)
def test_what_is_refused(refused_with, moved_problem, more, words):
    with refused_with(YidError, words):
        plan_informative_motion(moved_problem, replace(OPTIONS, **more))

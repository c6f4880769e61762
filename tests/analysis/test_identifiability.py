"""Fisher information against an independent computation, verdicts of the spring examples, nuisances, intervals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.analysis.identifiability import identifiability, with_grasp_offset_effects
from yid_ocp.analysis.parameter_combinations import DirectionComponent, describe_combination, sparse_basis
from yid_ocp.errors import ConfigError, SolverError
from yid_ocp.integrator.step import compile_step
from yid_ocp.problem import EstimationProblem
from yid_ocp.solvers import GaussNewton, solve

TWISTS = {"T2.twist", "T3.twist"}
# relative deviation of T3.bend with one arm, start known and unknown, by an independent computation
T3_BEND = {True: (0.34, 0.38), False: (1.17, 2.54)}


@pytest.mark.parametrize("vision", [False, True], ids=["no_vision", "vision"])
@pytest.mark.parametrize("name", ["single", "dual"])
def test_the_papers_four_experiments(golden_problem, name, vision):
    problem = golden_problem(name, vision)
    known = identifiability(problem, start="known")
    unknown = identifiability(problem, start="unknown")
    assert known.nuisance_names == ()
    assert len(unknown.nuisance_names) == 72
    for info in (known, unknown):
        assert {n for n, e in info.parameters.items() if e.verdict == "not_identifiable"} == TWISTS
        words = [direction.words for direction in info.unidentifiable_directions]
        assert set(words) == {f"{twist} is not seen by any sensor" for twist in TWISTS}
        for twist in TWISTS:
            assert info.parameters[twist].std_relative > 1e3
        others = {n: e.std_relative for n, e in info.parameters.items() if n not in TWISTS}
        assert others["T1.bend"] < 0.005
        assert others["T2.bend"] < 0.006
        if name == "dual":
            assert max(others.values()) < 0.04
            assert set(info.identifiable_parameters) == set(others)
        else:
            assert info.parameters["T3.bend"].verdict == "weak"
    for parameter, entry in known.parameters.items():
        assert entry.std_alone <= entry.std_relative * (1 + 1e-6)
        assert entry.std_relative <= unknown.parameters[parameter].std_relative * (1 + 1e-6)
    if name == "single":
        stated_known, stated_unknown = T3_BEND[vision]
        assert known.parameters["T3.bend"].std_relative == pytest.approx(stated_known, rel=0.12)
        # a prior on the start can only make it better than with none
        assert known.parameters["T3.bend"].std_relative < unknown.parameters["T3.bend"].std_relative < stated_unknown


def test_the_independent_figures_leave_the_unseen_twists_out(golden_problem):
    for vision, stated in ((True, 0.34), (False, 1.17)):
        problem = golden_problem("single", vision).with_free_parameters(("T1.bend", "T1.twist", "T2.bend", "T3.bend"))
        found = identifiability(problem, start="known").parameters["T3.bend"]
        assert found.std_relative == pytest.approx(stated, rel=0.03)


def test_a_start_that_nothing_is_known_of(golden_problem):
    """A prior of 10 rad and 50 rad/s on the start leaves T3.bend 228 %, where the default prior leaves it 172 %.

    An independent computation of the same motion gave 254 to 345 %; the difference is not explained.
    """
    problem = golden_problem("single", False)
    problem.options = replace(problem.options, start_configuration_std=10.0, start_velocity_std=50.0)
    assert identifiability(problem, start="unknown").parameters["T3.bend"].std_relative == pytest.approx(2.28, rel=0.05)


def test_correlations_and_information(golden_problem):
    info = identifiability(golden_problem("dual", True), start="known")
    known = [i for i, name in enumerate(info.parameter_names) if name not in TWISTS]
    block = info.correlations[np.ix_(known, known)]
    np.testing.assert_allclose(np.diag(block), 1.0, atol=1e-12)
    assert np.all(np.abs(block) <= 1 + 1e-9)
    # with the unseen twists known, deviations are a little smaller
    stds = np.sqrt(np.diag(np.linalg.inv(info.fisher_information[np.ix_(known, known)])))
    stated = np.array([info.parameters[info.parameter_names[i]].std_relative for i in known])
    assert np.all(stds <= stated)
    np.testing.assert_allclose(stds, stated, rtol=0.1)
    values = [direction.singular_value for direction in info.directions]
    assert values == sorted(values)


# -- the three spring examples ----------------------------------------------------------------------------------------


def test_two_springs_in_series_seen_at_the_ends_only(springs):
    problem = springs("series_ends")
    solution = solve(problem, GaussNewton())
    info = identifiability(problem, solution, intervals="all")
    assert info.identifiable_parameters == ()
    assert [entry.verdict for entry in info.parameters.values()] == ["not_identifiable"] * 2
    assert len(info.unidentifiable_directions) == 1
    assert (
        "1/spring_1.stiffness + 1/spring_2.stiffness, as springs in series are"
        in info.unidentifiable_directions[0].words
    )
    assert info.correlations[0, 1] == pytest.approx(-1, abs=1e-6)
    total = 1 / (1 / 200.0 + 1 / 300.0)
    for entry in info.parameters.values():
        # neither can be softer than both together, and either can be rigid
        assert entry.interval[0] == pytest.approx(total, rel=0.03)
        assert entry.interval[1] is None
        assert entry.std_alone < 0.01
    found = [info.parameters[name].value for name in info.parameter_names]
    assert 1 / (1 / found[0] + 1 / found[1]) == pytest.approx(total, rel=0.02)


def test_two_springs_in_series_with_the_joint_seen(springs):
    problem = springs("series_joint")
    solution = solve(problem, GaussNewton())
    info = identifiability(problem, solution, intervals="all")
    assert info.identifiable_parameters == ("spring_1.stiffness", "spring_2.stiffness")
    assert info.unidentifiable_directions == ()
    for name, truth in (("spring_1.stiffness", 200.0), ("spring_2.stiffness", 300.0)):
        lower, upper = info.parameters[name].interval
        assert lower < truth < upper
        assert upper - lower < 0.1 * truth


@pytest.mark.parametrize(
    ("points", "verdict"),
    [
        ("[pointer]", "not_identifiable"),
        ("[pointer, shaft_end, coupling]", "not_identifiable"),
        ("[pointer, coupling_marker]", "identifiable"),
    ],
)
def test_two_torsional_springs_under_a_known_torque(springs, points, verdict):
    problem = springs("torsion", f"sensors.points_camera.points={points}")
    info = identifiability(problem, solve(problem, GaussNewton()))
    assert {entry.verdict for entry in info.parameters.values()} == {verdict}
    assert bool(info.unidentifiable_directions) == (verdict == "not_identifiable")
    for direction in info.unidentifiable_directions:
        assert "as springs in series are" in direction.words


# -- intervals --------------------------------------------------------------------------------------------------------


def test_profile_is_the_parabola_where_the_model_is_nearly_linear(pendulum, twin):
    empty = pendulum()
    problem = pendulum(twin(empty, empty.initial_unknowns, 3))
    solution = solve(problem, GaussNewton())
    info = identifiability(problem, solution, start="known", intervals=["elbow.rest", "elbow.stiffness"])
    assert set(info.profiles) == {"elbow.rest", "elbow.stiffness"}
    assert info.parameters["elbow.damping"].interval is None
    for name in info.profiles:
        entry = info.parameters[name]
        half = 1.96 * entry.std
        np.testing.assert_allclose(entry.interval, [entry.value - half, entry.value + half], atol=0.06 * half)
        profile = info.profiles[name]
        assert np.all(np.diff(profile.values) > 0)
        assert profile.delta_chi2.min() == pytest.approx(0.0, abs=0.01)


def test_intervals_of_weak_parameters_are_lopsided_and_agree_with_chi2(golden_problem):
    problem = golden_problem("single", True)
    info = identifiability(problem, problem.initial_unknowns, start="known", intervals=["T3.bend", "T3.twist"])
    entry = info.parameters["T3.bend"]
    lower, upper = entry.interval
    assert 5.5 < lower < 7.5
    assert upper - entry.value > 2 * (entry.value - lower)
    assert info.parameters["T3.twist"].interval == (None, None)
    at = problem.with_free_parameters([name for name in problem.free if name != "T3.bend"], {"T3.bend": lower})
    refit = solve(at, GaussNewton())
    assert 2 * refit.cost == pytest.approx(3.84, abs=0.1)


@pytest.mark.parametrize("name", ["series_ends", "series_joint", "torsion"])
def test_nothing_is_called_identifiable_whose_interval_is_open(springs, name):
    problem = springs(name)
    info = identifiability(problem, solve(problem, GaussNewton()), start="known", intervals="all")
    for entry in info.parameters.values():
        assert (entry.verdict == "identifiable") == (None not in entry.interval)


# -- nuisances --------------------------------------------------------------------------------------------------------


def test_where_the_grasp_sits_is_a_nuisance(held_tube):
    base = identifiability(held_tube, start="known")
    system = with_grasp_offset_effects(held_tube.system)
    assert with_grasp_offset_effects(system).parameters.names == system.parameters.names
    step = compile_step(system, held_tube.step.time_step, use_compiler=False)
    recordings = [episode.recording for episode in held_tube.episodes]
    problem = EstimationProblem(step, recordings, held_tube.free, held_tube.options)
    fixed = identifiability(problem, start="known", grasp_std=None)
    tight = identifiability(problem, start="known", grasp_std=1e-9)
    loose = identifiability(problem, start="known", grasp_std=0.01)
    assert loose.nuisance_names == tuple(f"grasp_offset@hand.d{axis}" for axis in "xyz")
    for name, entry in base.parameters.items():
        for other in (fixed, tight):
            assert other.parameters[name].std == pytest.approx(entry.std, rel=1e-4)
    assert loose.parameters["T1.bend"].std > 1.5 * base.parameters["T1.bend"].std


def test_an_estimated_start_can_be_judged_as_known(held_tube):
    estimated = EstimationProblem(
        held_tube.step,
        [episode.recording for episode in held_tube.episodes],
        held_tube.free,
        replace(held_tube.options, initial_state="estimated"),
    )
    wide, other = identifiability(estimated), identifiability(held_tube, start="unknown")
    assert wide.parameters["T1.bend"].std == pytest.approx(other.parameters["T1.bend"].std)
    assert identifiability(estimated, start="known").nuisance_names == ()


def test_a_start_fitted_to_points_becomes_the_centre_of_a_prior(pendulum, twin):
    empty = pendulum()
    made = pendulum(twin(empty, empty.initial_unknowns, 3))
    recordings = [episode.recording for episode in made.episodes]
    options = replace(made.options, initial_state="fitted_to_points", start_fit_window=0.05)
    given = EstimationProblem(made.step, recordings, made.free, options)
    known, unknown = identifiability(given, start="known"), identifiability(given, start="unknown")
    assert known.nuisance_names == ()
    assert unknown.nuisance_names == ("start.q.elbow[twin]", "start.p.elbow[twin]")
    for name, entry in known.parameters.items():
        assert entry.std < unknown.parameters[name].std


# -- words ------------------------------------------------------------------------------------------------------------


def moved_by(function):
    """How far data move that see one number of two parameters (k1 = 2, k2 = 5)."""

    def moved(changes):
        values = {"k1": 2.0, "k2": 5.0} | changes
        return 1e3 * abs(function(values["k1"], values["k2"]) - function(2.0, 5.0))

    return moved


@pytest.mark.parametrize(
    ("function", "direction", "words"),
    [
        (lambda a, b: 1 / a + 1 / b, (2.0, -5.0), "1/k1 + 1/k2, as springs in series are"),
        (lambda a, b: a + b, (5.0, -2.0), "k1 + k2, as springs side by side are"),
        (lambda a, b: a / b, (1.0, 1.0), "the ratio k1 / k2"),
        (lambda a, b: a * b, (1.0, -1.0), "the product k1 x k2"),
    ],
)
def test_plain_combinations_have_names(function, direction, words):
    unit = np.array(direction) / np.linalg.norm(direction)
    parts = [DirectionComponent("k1", unit[0], 2.0, "N/m"), DirectionComponent("k2", unit[1], 5.0, "N/m")]
    assert describe_combination(parts, moved_by(function)) == f"k1 and k2 are seen only as {words}"


def test_other_combinations_are_described():
    parts = [DirectionComponent("k1", 0.8, 2.0, "N/m"), DirectionComponent("k2", -0.6, 5.0, "N/m")]
    words = "k1 and k2 are seen only together: k1 +10 % with k2 -7.5 % changes nothing that is measured"
    assert describe_combination(parts, moved_by(lambda a, b: a**0.6 * b**0.8)) == words
    assert describe_combination(parts, None) == words


def test_many_parameters_are_counted():
    parts = [DirectionComponent(f"k{i}", 0.1 * (i + 1), 1.0, "N/m") for i in range(7)]
    words = describe_combination(parts, None)
    assert words.startswith("k0, k1, k2, k3 and 3 more are seen only together: k6 +10 % with k5 +8.6 % with")
    assert words.endswith("and the others to match changes nothing that is measured")


def test_sparse_basis_separates_pairs():
    pairs = np.array([[1.0, -2.0, 0.0, 0.0], [0.0, 0.0, 3.0, 1.0]])
    turn = np.array([[0.8, 0.6], [-0.6, 0.8]])
    found = sparse_basis(turn @ pairs)
    assert sorted(int(np.sum(np.abs(vector) > 1e-9)) for vector in found) == [2, 2]
    np.testing.assert_allclose([np.linalg.norm(vector) for vector in found], 1.0)


# -- bad input --------------------------------------------------------------------------------------------------------


def test_bad_requests_say_what_is_wrong(held_tube):
    with pytest.raises(ConfigError, match=r"(?s)'T1\.bendd' is not .*did you mean 'T1\.bend'"):
        identifiability(held_tube, intervals=["T1.bendd"])
    with pytest.raises(SolverError, match="shape"):
        identifiability(held_tube, [1.0])
    with pytest.raises(SolverError, match=r"T1\.bend is not finite"):
        identifiability(held_tube, [math.nan, 1.0])
    episode = held_tube.episodes[0]
    far = replace(episode.recording.joints, position=episode.recording.joints.position + np.array([1.0, 0.0, 0.0]))
    recording = replace(episode.recording, joints=far)
    unreachable = EstimationProblem(held_tube.step, [recording], held_tube.free, held_tube.options)
    with pytest.raises(SolverError, match=r"cannot be rolled out.*out of reach"):
        identifiability(unreachable)

"""Several methods on one problem: cost in time, agreement, and what is said of parameters that nothing informs."""

import math
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_models import estimate, solution
from small_problems import pendulum_step, taken

from yid_ocp.analysis import compare as module
from yid_ocp.analysis import estimation
from yid_ocp.analysis.compare import PAPER_ESTIMATES, compare_methods
from yid_ocp.analysis.estimation import choose_fit_with_or_without_shape_memory, prediction_errors_units_and_fit_rmse
from yid_ocp.errors import ConfigError
from yid_ocp.model.objects.cable import INITIAL_RMS_SPEED_PARAMETER
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.problem.options import ExcessResidualCriteria
from yid_ocp.solvers import GaussNewton, MultipleShooting, SingleShooting, Status, SteepestDescent, fit_problem
from yid_ocp.solvers.base import StopSearch
from yid_ocp.workflow.build_problem import load_problem

CONVERGED, LIMIT = Status.CONVERGED, Status.ITERATION_LIMIT
TRUTH = {"elbow.stiffness": 4.0, "elbow.damping": 0.15, "elbow.rest": 0.3, "shoulder.damping": 0.1}


@pytest.fixture(scope="module")
def problem(pendulum, twin):
    """A pendulum of which the elbow's spring is seen, and nothing informs the damping of the moved shoulder."""
    empty = pendulum()
    recordings = [twin(empty, empty.initial_unknowns, seed) for seed in (3, 4)]
    free, values = ("elbow.stiffness", "elbow.rest", "shoulder.damping"), TRUTH | {"elbow.rest": 0.2}
    options = replace(empty.options, duration=1.0)
    return EstimationProblem(empty.step, recordings[:1], free, options, values, recordings[1:])


def test_methods_agree_on_what_the_data_inform(problem):
    told = []
    found = compare_methods(problem, [GaussNewton(), SingleShooting()], lambda name, _: told.append(name))
    assert found.is_consistent
    assert {run.method for run in found.method_results} == set(told) == {"gauss_newton", "single_shooting"}
    for run in found.method_results:
        assert run.wall_seconds > 0
        assert len(run.held_out_predictions) == 1


@pytest.mark.parametrize(
    ("start", "said"),
    [
        ([-1.0, 0.2, 0.1], "elbow.stiffness = -1 N m/rad lies below its lower bound of 0 N m/rad"),
        ([4.0, math.nan, 0.1], "elbow.rest = nan is not a finite number"),
        ([4.0], "1 values are given for 3 unknowns"),
    ],
)
def test_a_start_beyond_a_bound_is_refused_by_name(problem, start, said):
    with pytest.raises(ConfigError, match=re.escape(said)) as caught:
        estimation.solve(problem, initial_unknowns=start)
    assert (caught.value.where, "parameters." in caught.value.hint) == ("initial_unknowns", False)


def test_nothing_to_agree_on(repository, carried_out):
    config = repository / "configs" / "springs_series_ends.yaml"
    methods = "compare.methods={gauss_newton: {}, single_shooting: {max_iterations: 3}, "
    methods += "multiple_shooting: {max_iterations: 2}}"
    done = carried_out("compare", config, settings=[methods])
    text = " ".join(done.out.split())
    assert "single_shooting did not converge" in text
    advice = "Set compare.methods.multiple_shooting.max_iterations: 200."
    assert f"multiple_shooting did not converge: IPOPT reached its limit. {advice}" in text
    assert "Use 95 % intervals in place of values, because no ± is below 10 %." in text
    values = [entry["parameters"]["spring_1.stiffness"]["value"] for entry in done.result["methods"].values()]
    page = (done.folder / "report.html").read_text(encoding="utf-8").partition("<script")[0]
    assert not [
        v for v in values if v <= 0 or re.search(rf"(?<![\d.]){v:.3g}(?![\d.])", text + page)
    ]  # no digits mean nothing


def test_command(repository, clean, carried_out):
    config = repository / "configs" / "single_arm_no_vision.yaml"
    settings = ["problem.duration=0.3", "problem.use_compiler=false", "model.object.links=1", "parameters={}"]
    settings += [
        "compare.methods={gauss_newton: {}, single_shooting: {}}",
        "parameters={T1.bend: {free: true, initial: 15}, T1.twist: {initial: 13.6}, T2.bend: {initial: 10.7}, "
        "T2.twist: {initial: 8.2}, T3.bend: {initial: 11.5}, T3.twist: {initial: 9.7}}",
        *(f"recordings.{purpose}=[{clean}/single_arm_no_vision_{purpose}.h5]" for purpose in ("estimate", "held_out")),
    ]
    done = carried_out("compare", config, settings=settings)
    assert "published" in done.out
    assert "truth" in done.out
    assert "noise that drives" not in done.out
    result = done.result
    assert result["format"] == "yid-compare/1"
    assert set(result["methods"]) == {"gauss_newton", "single_shooting"}
    assert result["methods"]["gauss_newton"]["format"] == "yid-solve/1"
    for name, entry in result["methods"][result["reference"]]["parameters"].items():
        own = result["judged"]["parameters"][name]
        assert (own["value"], own["verdict"]) == (entry["value"], entry["verdict"])
        assert (own["std"] or 0.0) >= (entry["std"] or 0.0)  # the discretisation counts
    assert result["published"] == PAPER_ESTIMATES["single_arm_no_vision"]
    assert "Cost over time" in (done.folder / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_command_weighs_all_noise_of_the_embedded_recordings(repository, carried_out):
    """Torques with offsets mislead what takes them as true; the verdicts do not follow it."""
    config = repository / "configs" / "dual_arm_no_vision.yaml"
    done = carried_out("compare", config, settings=["compare.methods={single_shooting: {}}"])
    assert done.out.startswith("Do not use the columns single_shooting, because these methods ignore noise")
    result = done.result
    assert result["judged"]["fit"]["explains"]
    assert not result["methods"]["single_shooting"]["fit"]["explains"]
    found = {name: e for name, e in result["judged"]["parameters"].items() if e["verdict"] == "identifiable"}
    assert set(found) == {"T1.bend", "T1.twist", "T2.bend", "T3.bend"}
    for name, entry in found.items():
        assert abs(entry["value"] - result["truth"][name]) < 2 * entry["std"], name


@pytest.mark.parametrize("methods", ["{newton: {}}", "{gauss_newton: {iteration: 3}}", "{}", "[adam]"])
def test_wrong_methods_are_refused(repository, tmp_path, printed, methods):
    config = repository / "configs" / "single_arm_no_vision.yaml"
    told = printed("compare", config, "--out", tmp_path / "run", "--set", f"compare.methods={methods}", code=2)
    assert ("compare.methods" in told, "such as {gauss_newton: {}}" in told) == (True, methods in ("{}", "[adam]"))
    assert not (tmp_path / "run").exists()


class Problem:
    """A problem whose answers cost what they are."""

    def __init__(self, weighting="whitened", disturbed=False):
        self.options, self.has_process_noise = ProblemOptions(weighting=weighting), disturbed

    def with_options(self, options):
        return Problem(options.weighting)

    def evaluate(self, x, derivatives=True):
        return SimpleNamespace(cost=float(x[-1]), ok=False)

    def predict_held_out(self, x):
        return [(self.options.weighting, float(x[-1]))]


@pytest.fixture
def compared(monkeypatch):
    """compared(disturbed, weighting, **solutions): methods that find these; the last parameter is the cost.

    `asked` are the methods as they ran; a run that can weigh all noise finds what `able` says.
    """
    asked = []

    def run(disturbed=False, weighting="whitened", **solutions):
        def fit(problem, solver, callback, limits, restarts=True):
            asked.append((solver.name, problem.options.weighting, problem.has_process_noise, restarts))
            if callback is not None:
                callback("step")
            return solutions["all_noise" if problem.has_process_noise else solver.name]

        def whole(problem, solver, callback):
            return replace(fit(problem, solver, callback, None), message="checked")

        monkeypatch.setattr(module, "fit_problem", fit)
        monkeypatch.setattr(estimation, "solve", whole)
        monkeypatch.setattr(estimation, "add_intervals_and_checks", lambda _, made: replace(made, message="checked"))
        monkeypatch.setattr(module, "solution_with_profile_intervals", lambda _, own: replace(own, message="profiled"))
        monkeypatch.setattr(module, "problem_with_exact_inputs", lambda problem: Problem(problem.options.weighting))
        solvers = [SimpleNamespace(name=name) for name in solutions if name != "all_noise"]
        told = []
        found = compare_methods(Problem(weighting, disturbed), solvers, lambda *entry: told.append(entry))
        run.told = told
        return found

    run.asked = asked
    return run


def found_by(status=Status.CONVERGED, cost=1.0, **parameters):
    return solution(status=status, **parameters, z_cost=estimate(cost, 9.0, "fixed", free=False))


ALIKE = [((10.2, 0.1), (10, 0.1)), ((10.3, 0.2), (10, 0.1)), ((10.3, 0.1), (10, 0.2)), ((10.04, 0), (10, 0))]
APART = [((10.21, 0.1), (10, 0.1)), ((9.79, 0.1), (10, 0.1)), ((10.06, 0), (10, 0))]
PAIRS = [(*pair, False) for pair in (*ALIKE, ((-10.04, 0), (-10, 0)))] + [(*pair, True) for pair in APART]


@pytest.mark.parametrize(("here", "best", "differs"), PAIRS)
def test_estimates_agree_within_two_standard_deviations_or_half_a_percent(compared, here, best, differs):
    found = compared(one=found_by(a=estimate(*best)), two=found_by(a=estimate(*here)))
    assert found.is_consistent is not differs
    assert bool(found.disagreements["two"]) is differs


@pytest.mark.parametrize(
    ("status", "cost", "why"),
    [
        (LIMIT, 1.0, "it stopped before it reached the minimum"),
        (Status.STALLED, 99.0, "it stopped before it reached the minimum"),
        (CONVERGED, 3.1, "it stopped in another local minimum, whose cost is higher"),
        (CONVERGED, 3.0, "its cost weights the measurements differently"),
    ],
)
def test_a_difference_has_a_likely_reason(compared, status, cost, why):
    hidden = estimate(5.0, verdict="not_identifiable")
    best = found_by(a_b=estimate(10.0, 0.123), c=estimate(5.0, verdict="weak"), d=hidden, e=estimate(2.0, 0.1))
    std = 0.1 if status == CONVERGED else 9.0  # one that stopped early may have any
    other = found_by(status, cost, a_b=estimate(12.3456), c=estimate(99.0), d=estimate(9.0), e=estimate(3.0, std))
    found = compared(one=best, two=other)
    said = f"gives other values than one, because {why}: a.b = 12.35 N m/rad (not 10), e = 3 N m/rad (not 2)"  # no ±
    assert found.disagreements == {"one": [], "two": [said]}


@pytest.mark.parametrize("weighting", ["whitened", "paper"])
def test_methods_run_one_by_one_and_the_lowest_cost_is_the_reference(compared, weighting):
    runs = {name: found_by(cost=cost, a=estimate(2.0)) for name, cost in METHODS.items()}
    found = compared(weighting=weighting, **runs)
    own = [(name, "paper" if name == "steepest_descent" else weighting, False, True) for name in METHODS]
    assert compared.asked == own
    assert compared.told == [(name, "step") for name in METHODS]
    assert (found.reference_method, found.has_process_noise) == ("gauss_newton", False)
    assert [run.whitened_cost for run in found.method_results] == list(METHODS.values())
    predicted = [[(entry[1], cost)] for entry, cost in zip(own, METHODS.values(), strict=True)]
    assert [run.held_out_predictions for run in found.method_results] == predicted
    assert found.verdict_solution == replace(found.method_results[1].solution, message="checked")
    assert [run.solution.message for run in found.method_results] == ["done", "profiled", "done"]
    # chi2 of the residual of the problem, not of the method's own weights
    assert math.isnan(found.method_results[2].solution.goodness_of_fit.chi2_per_dof) == (weighting == "whitened")


METHODS = {"single_shooting": 3.0, "gauss_newton": 2.0, "steepest_descent": 5.0}


def test_verdicts_count_the_noise_that_drives_the_motion(compared):
    """The methods are compared without it, where nothing can be trusted; one more run, told as another, weighs it."""
    costs = {"single_shooting": 7.5, "steepest_descent": 7.0}
    poor = {name: found_by(cost=c, a=estimate(c, 0.1)) for name, c in costs.items()}
    found = compared(True, **poor, all_noise=found_by(cost=10.0, a=estimate(10.0)))
    # by the sensors' noise alone every fit is poor, from wherever it starts
    assert [entry[2:] for entry in compared.asked] == [(False, False), (False, False), (True, True)]
    assert compared.asked[-1][0] == "gauss_newton"
    assert [name for name, _ in compared.told] == ["single_shooting", "steepest_descent", "solve"]
    assert found.has_process_noise
    assert found.verdict_solution.parameters["a"] == estimate(10.0)
    # intervals of the paper's cost mean nothing
    assert [run.solution.message for run in found.method_results] == ["done", "done"]
    assert found.verdict_solution.message == "checked"
    # what cannot weigh this noise has no verdict of its own
    assert {run.solution.parameters["a"].verdict for run in found.method_results} == {"not_trusted"}
    # found by the likelihood, so the methods have to agree on it
    assert all(p in found.disagreements["single_shooting"][0] for p in ("values than steepest_descent, b", ": a = 7.5"))


def test_a_method_is_stopped_after_its_share_of_the_budget(repository):
    """At its last iterate, which its column shows; nothing more is tried, and `solve` answers all the same."""
    problem = load_problem(repository / "configs" / "springs_series_joint.yaml")
    found = compare_methods(problem, [SteepestDescent(), GaussNewton()], total_time_budget=1e-9)
    for run in found.method_results:
        assert "stopped before its first iteration" in found.disagreements[run.method][0]
        assert run.solution.status == Status.STOPPED
        assert run.solution.message.startswith("stopped at its part of ")
        assert "compare.total_time_budget" in run.solution.message
        assert len(run.solution.history) == 1


@pytest.mark.parametrize("solver", [MultipleShooting(), MultipleShooting(condensing=True), SingleShooting()])
def test_a_callback_stops_any_search_at_its_last_iterate(repository, solver):
    def enough(entry):
        if entry.iteration == 2:
            raise StopSearch("enough")

    found = fit_problem(load_problem(repository / "configs" / "springs_series_joint.yaml"), solver, callback=enough)
    assert (found.status, found.message) == (Status.STOPPED, "enough")
    assert [entry.iteration for entry in found.history] == [0, 1, 2]
    assert np.array_equal(found.x, found.history[-1].x)


def test_the_published_values_are_those_of_the_paper():
    """Tables of the source paper [N m/rad], thousandths as whole numbers."""
    thousandths = {
        "single_arm_no_vision": [23780, 0, 18357, 11103, 3200, 3059],
        "single_arm_vision": [22270, 13593, 10735, 8202, 11511, 9692],
        "dual_arm_no_vision": [19559, 4965, 8575, 10374, 0, 11287],
        "dual_arm_vision": [24840, 0, 12373, 30775, 1406, 24900],
    }
    names = ["T1.bend", "T1.twist", "T2.bend", "T2.twist", "T3.bend", "T3.twist"]
    assert list(PAPER_ESTIMATES) == list(thousandths)
    for experiment, values in PAPER_ESTIMATES.items():
        assert [round(1000 * value) for value in values.values()] == thousandths[experiment]
        assert list(values) == names


class Means:
    """One unknown measured once by every recording, and the memory of one branch; without it predictions are off."""

    options = ProblemOptions()

    def __init__(self, values, speeds, names=("k", "a.memory"), off=0.0):
        self.values, self.unknown_names, self.off = np.array(values, float), names, off
        self.shared_parameters = self.free = names
        self.episodes = [self._episode(value, speed) for value, speed in zip(values, speeds, strict=True)]
        self.residual_rows = SimpleNamespace(measurements=[(slice(i, i + 1),) for i in range(len(values))])
        self.bounds = np.full(len(names), -np.inf), np.full(len(names), np.inf)
        self.unknown_scales = np.full(len(names), 100.0)
        self.predictor = SimpleNamespace(
            predict_episode=lambda episode, theta, offset, _: SimpleNamespace(predicted_outputs=(np.array([theta]),))
        )

    @staticmethod
    def _episode(value, speed):
        samples = SimpleNamespace(whitened_residual=lambda predicted: predicted - value, n_residuals=1)
        start = None if speed is None else SimpleNamespace(fitted_parameters={INITIAL_RMS_SPEED_PARAMETER: speed})
        return SimpleNamespace(measurements=(samples,), fixed_initial_state=start)

    def unpack_episode_unknowns(self, x, i):
        return float(x[0]) + (0.0 if "a.memory" in self.unknown_names else self.off), None

    def evaluate(self, x, equilibrium_guesses=None):
        jacobian = np.zeros((len(self.values), len(self.unknown_names)))
        jacobian[:, 0] = 1.0
        return SimpleNamespace(residual=x[0] - self.values, jacobian=jacobian, equilibrium_guesses=None)

    def with_free_parameters_without_recompiling(self, names):
        made = Means(self.values, [0.0] * len(self.values), tuple(names), self.off)
        made.episodes, made.bounds = self.episodes, tuple(bound[:1] for bound in self.bounds)
        return made

    def with_parameter_values(self, values):
        assert values == {"a.memory": 0.0}
        return self

    def pack_unknowns(self, values):
        return np.array([values[name] for name in self.unknown_names])


def fitted(x, names=("k", "a.memory")):
    evaluation = SimpleNamespace(equilibrium_guesses=None)
    return SimpleNamespace(unknown_names=names, x=np.array(x, float), evaluation=evaluation)


@pytest.fixture
def solved(monkeypatch):
    """Solves the problem without memory where it starts, and keeps it; `ok` is whether that succeeds."""
    kept = SimpleNamespace(problems=[], ok=True)

    def fit(problem, solver, start, limits):
        kept.problems.append(problem)
        return fitted(start, problem.unknown_names) if kept.ok else SimpleNamespace(evaluation=None)

    monkeypatch.setattr(estimation.solvers, "fit_problem", fit)
    return kept


@pytest.mark.parametrize(
    ("names", "speeds"),
    [(("k", "m"), (0.5, 0.5, 0.5)), (("k", "a.memory"), (0.0, None, 0.005))],
    ids=["no memory", "all at rest"],
)
def test_nothing_is_asked_where_nothing_is_in_question(solved, names, speeds):
    problem, found = Means((1.0, 2.0, 3.0), speeds, names), fitted((2.0, 0.5), names)
    chosen = choose_fit_with_or_without_shape_memory(problem, None, found)
    assert (chosen, solved.problems) == ((problem, found, ""), [])


def test_a_single_recording_in_motion_bears_nothing_out(solved):
    moving = Means((1.0, 2.0, 3.0), (0.5, 0.0, None))
    problem, found, message = choose_fit_with_or_without_shape_memory(moving, None, fitted((2.0, 0.5)))
    assert problem is solved.problems[0]
    assert (problem.unknown_names, found.x.tolist()) == (("k",), [2.0])
    assert "add a second recording that starts in motion" in message


@pytest.mark.parametrize(
    ("off", "bounds", "at", "predicted", "kept"),
    [
        (1.0, (-np.inf, np.inf), 3.0, (4.0, 1.5), False),
        (0.0, (-np.inf, np.inf), 10.0, (4.0, 1.5), False),
        (-1.0, (-np.inf, np.inf), 3.0, (4.0, 1.5), True),
        (0.0, (-np.inf, 3.0), 2.5, (3.0, 1.5), False),
        (0.0, (2.0, np.inf), 2.5, (4.0, 2.0), False),
    ],
    ids=["worse with it", "no better", "better", "a bound above", "a bound below"],
)
def test_memory_is_kept_where_recordings_left_out_are_predicted_better_with_it(
    solved, off, bounds, at, predicted, kept
):
    """Each from the others alone: the first from a mean of 4, the last from 1.5, wherever the fit of all stands."""
    problem, found = Means((1.0, 2.0, 6.0), (0.5, 0.0, 0.5), off=off), fitted((at, 0.5))
    problem.bounds = tuple(np.array([bound, side]) for bound, side in zip(bounds, (0.0, 1.0), strict=True))
    chosen, _, message = choose_fit_with_or_without_shape_memory(problem, None, found)
    missed = np.array(predicted) - [1.0, 6.0]
    with_it, without = (np.sqrt(np.mean((missed + more) ** 2)) for more in (0.0, off))
    assert (chosen is problem) is kept
    assert f"The estimates {'include' if kept else 'are without'} shape memory" in message
    assert f"{with_it:.3g} times the noise with this memory and {without:.3g} times without" in message


def test_what_cannot_be_predicted_without_memory_keeps_it(solved):
    problem, found = Means((1.0, 2.0, 3.0), (0.5, 0.2, 0.0)), fitted((2.0, 0.5))
    problem.predictor.predict_episode = lambda *_: "it snaps"
    assert "of inf times the noise" in choose_fit_with_or_without_shape_memory(problem, None, found)[2]
    solved.ok = False
    assert choose_fit_with_or_without_shape_memory(problem, None, found)[1] is found


@pytest.mark.parametrize(("start", "window"), [("equilibrium", -1.0), ("fitted_to_points", 0.1)])
def test_errors_of_held_out_and_fitted_recordings_leave_out_what_fixed_the_start(urdf_folder, start, window):
    step = pendulum_step(urdf_folder)
    options = ProblemOptions(initial_state=start, initial_state_fit_window=0.1, weak_prior_geometric_std=0.0)
    made = EstimationProblem(step, [taken(step, 1)], ("elbow.stiffness",), options, None, [taken(step, 2)])
    evaluation, held_out = made.evaluate(made.initial_unknowns, False), made.predict_held_out(made.initial_unknowns)
    fit = SimpleNamespace(evaluation=evaluation, episode_predictions=evaluation.episode_predictions)
    entries, units, residuals = prediction_errors_units_and_fit_rmse(made, fit, held_out)
    assert [entry["recording"] for entry in entries] == ["run_2", "run_1"]
    assert units == dict.fromkeys(residuals, "m")
    [k] = [i for i, s in enumerate(made.episodes[0].measurements) if s.sensor.group_name == "points_camera"]
    samples, predicted = made.episodes[0].measurements[k], evaluation.episode_predictions[0].predicted_outputs[k]
    square = np.sum((predicted - samples.value).reshape(-1, 2, 3) ** 2, axis=2)
    later = (samples.node + samples.fraction) * step.time_step > window
    assert later.all() == (start == "equilibrium")
    assert entries[1]["rmse"]["points_camera"] == pytest.approx(math.sqrt(np.nanmean(square[later])))
    assert entries[1]["rmse"]["points_camera.tip"] == pytest.approx(math.sqrt(np.nanmean(square[:, 1])))
    unfitted, nothing, _ = prediction_errors_units_and_fit_rmse(made, SimpleNamespace(evaluation=None), held_out)
    assert ([entry["recording"] for entry in unfitted], nothing) == (["run_2"], {})


def test_the_error_to_expect_is_that_of_the_sensors_and_of_torques_as_wrong_as_stated(urdf_folder):
    step = pendulum_step(urdf_folder, driven=("shoulder",))
    how = {"arm_tracking_feedback": "proportional", "arm_proportional_gains": (9.0,)}

    def expected(size, share=1.0):
        recordings = [taken(step, seed) for seed in (3, 4)]
        recordings = [replace(r, joints=replace(r.joints, effort_std=size, effort_bias_std=size)) for r in recordings]
        limits = ExcessResidualCriteria(noise_fraction_of_stated_std=share)
        options = ProblemOptions(path_cutoff=math.inf, excess_residual_criteria=limits, **how)
        made = EstimationProblem(step, recordings[:1], ("elbow.stiffness",), options, None, recordings[1:])
        fit = replace(solution(elbow_stiffness=estimate(1.0)), x=made.initial_unknowns)
        checks = estimation.add_intervals_and_checks(made, fit).checks
        [(_, outcome)], found = checks.held_out_predictions, checks.expected_prediction_errors
        [(_, plain)] = made.predict_held_out(made.initial_unknowns)
        np.testing.assert_array_equal(outcome.predicted_outputs[0], plain.predicted_outputs[0])
        return found["run_4"]["points_arm.tip"]

    exact, small, large = map(expected, (0.0, 0.05, 0.1))
    assert expected(0.1, 0.25) == pytest.approx(0.25 * large)
    assert exact == pytest.approx(math.sqrt(3) * 0.02)
    assert small > exact + 1e-5
    assert (large**2 - exact**2) / (small**2 - exact**2) == pytest.approx(4.0, rel=0.1)


def test_torque_errors_carry_a_held_out_motion_as_far_as_is_said(urdf_folder):
    """Errors of the stated size, drawn by the simulation: the root mean square of what they do is what is expected."""
    step = pendulum_step(urdf_folder, driven=("shoulder",), prescribed=("elbow",))
    source = taken(step, 1)
    points = tuple(replace(group, std=1e-3) for group in source.points)
    source = replace(source, joints=replace(source.joints, effort_bias_std=0.5), points=points)
    options = ProblemOptions(path_cutoff=math.inf, arm_tracking_feedback="none")
    truth = EstimationProblem(step, [source], ("elbow.mass",), options)
    made = [replace(truth.simulate_synthetic_recording(seed=seed), name=f"held_{seed}") for seed in range(10)]
    problem = EstimationProblem(step, [source], ("elbow.mass",), options, held_out=made)
    fit = replace(solution(elbow_mass=estimate(1.0)), x=problem.initial_unknowns)
    checks = estimation.add_intervals_and_checks(problem, fit).checks
    pairs, expected = checks.held_out_predictions, checks.expected_prediction_errors
    found = [entry["rmse"] for entry in prediction_errors_units_and_fit_rmse(problem, fit, pairs)[0]]
    channel = next(name for name in expected["held_0"] if name.endswith(".tip"))
    errors = np.sqrt(np.mean([own[channel] ** 2 for own in found]))
    noise = np.sqrt(np.mean([own[channel] ** 2 for own in expected.values()]))
    assert noise > 4e-3, "torques matter here more than sensors"
    assert 0.6 < errors / noise < 1.6


@pytest.mark.parametrize(
    ("segments", "kinds", "divided", "links"),
    [
        (True, ("time_step",), False, True),
        (True, ("links", "time_step"), True, True),
        (True, ("links", "time_step"), False, True),
        (True, ("time_step",), True, False),
        (False, ("links", "time_step"), False, False),
        (False, ("time_step",), True, False),
    ],
)
def test_the_error_of_links_is_uncounted_where_an_object_has_them_and_nothing_is_said_of_it(
    monkeypatch, segments, kinds, divided, links
):
    """Where neither could be compared; an object divided otherwise is not asked for its links."""
    layouts = (SimpleNamespace(name="T1"),) if segments else ()
    options = SimpleNamespace(checked_discretisations=kinds, divided_links_model=divided)
    made = SimpleNamespace(options=options, system=SimpleNamespace(segment_layouts=layouts))
    notes = {"links": "why"}
    monkeypatch.setattr(estimation.discretisation, "parameter_shifts_at_finer_discretisation", lambda *_: ({}, notes))
    monkeypatch.setattr(estimation.uncertainty, "typical_parameter_magnitudes", lambda *_: {"k": 1.0})
    fit = replace(solution(k=estimate(2.0)), evaluation=SimpleNamespace())
    found, checks = estimation.add_discretisation_errors(made, fit, None)
    assert found.parameters == fit.parameters
    assert checks.notes == notes
    assert checks.uncounted_errors == (("from the number of links",) if links else ()) + ("from the time step",)

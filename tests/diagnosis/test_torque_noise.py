"""A diagnosis weighs recordings by the noise that drives the motion, and the smoother knows of it."""

import math
from dataclasses import replace

import numpy as np
import pytest
from factories import cases
from small_problems import places

from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.diagnosis import gap_law
from yid_ocp.diagnosis.diagnose import diagnose, fit_nominal_model
from yid_ocp.diagnosis.events import NO_EVENTS
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem, make_candidate_effects
from yid_ocp.diagnosis.refit import RefitContext, refit_with_effects
from yid_ocp.diagnosis.screening import linearize_candidates
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.display import NULL_PROGRESS
from yid_ocp.effects import make_effect
from yid_ocp.inference.linearized_residual import residual_and_jacobian_with_stated_priors
from yid_ocp.inference.smoother_model import residual_models_with_smoother_unknowns
from yid_ocp.inference.uncertainty import noise_only_covariance_sqrt, null_tests_of_fit
from yid_ocp.inference.whitening import (
    problem_relinearized_at_torque_bias,
    problem_with_exact_inputs,
    problem_with_reestimated_held_out_torque_biases,
    problem_with_sensor_noise_only,
    problem_with_whitening_at,
)
from yid_ocp.integrator.step import Step, compile_step, reachable_and_observable_state_mask, simulate
from yid_ocp.model import System
from yid_ocp.model.flexible import FlexibleSegment, flexible_object
from yid_ocp.model.servos_and_springs import StiffnessAndRest
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.problem.evaluation import episode_residual_and_jacobian
from yid_ocp.solvers import GaussNewton, fit_problem

TIME_STEP, STEPS = 0.01, 200
WHITE, OFFSET, ANGLE, POINT = 0.05, 0.1, 2e-4, 1e-3
FREE = ("elbow.stiffness", "elbow.damping")


@pytest.fixture(scope="module")
def step(robot) -> Step:
    springs = {"elbow": StiffnessAndRest(3.0)}
    system = System.build(robot, driven=("shoulder",), springs=springs, damping={"shoulder": 0.3, "elbow": 0.05})
    return compile_step(system, TIME_STEP)


def recorded(step: Step, seed: int, offset: float | None = None, friction: float = 0.0) -> Recording:
    """A pendulum that swings from rest, seen by an encoder and a camera; its torque is wrong as the recording says."""
    rng = np.random.default_rng(seed)
    system, t = step.system, TIME_STEP * np.arange(STEPS + 1)
    torque = sum(rng.uniform(0.3, 0.8) * np.sin(2 * np.pi * f * t) for f in rng.uniform([0.3, 0.7, 1.5], [0.5, 1, 2]))
    theta = system.parameters.vector({"shoulder.damping": 0.3 + friction})
    swept = simulate(step, theta, np.zeros(step.sizes["nx"]), STEPS, torque[:-1, None])
    assert swept.status.is_converged
    off = OFFSET * rng.standard_normal() if offset is None else offset
    angle = swept.state[:, :1] + ANGLE * rng.standard_normal((STEPS + 1, 1))
    effort = torque[:, None] + WHITE * rng.standard_normal((STEPS + 1, 1)) + off
    said = {"position_std": ANGLE, "effort_std": WHITE, "effort_bias_std": OFFSET, "effort_kind": "command"}
    joints = JointGroup(("shoulder",), t, angle, effort=effort, **said)
    tip = places(system, ["tip"], swept.state[:, : system.n_coordinates])
    tip += POINT * rng.standard_normal((STEPS + 1, 1, 3))
    points = PointGroup("points_camera", ("tip",), t, tip, std=np.full(tip.shape, POINT))
    return Recording(joints, (points,), name=f"run_{seed}")


def problem_of(step: Step, recordings: list[Recording], held_out: list[Recording] | None = None) -> EstimationProblem:
    options = ProblemOptions(
        initial_state="equilibrium", arm_tracking_feedback="proportional", arm_proportional_gains=(9.0,)
    )
    return EstimationProblem(step, recordings, FREE, options, None, held_out or [])


def composed(step: Step, held_out: bool, *candidates: str) -> AllCandidatesProblem:
    problem = problem_of(step, [recorded(step, 1)])
    recordings = [problem.episodes[0].recording]
    effects = make_candidate_effects(step.system, recordings, list(candidates) or ["joint_viscous"])
    return AllCandidatesProblem.from_problem(problem, effects, [recorded(step, 2)] if held_out else [])


@cases("held_out", {"held_out": True, "in_blocks": False})
def test_all_hypotheses_share_weights_frozen_at_one_point(step, held_out):
    made = composed(step, held_out)
    weighted = made.with_whitening_linearized_at({"elbow.stiffness": 2.5})
    assert weighted.candidate_effects == made.candidate_effects
    assert weighted.is_split_in_blocks == made.is_split_in_blocks
    own = weighted.problem
    extended = weighted.problem_with_nominal_and_effects_free(weighted.candidate_effects)
    assert all(x is y is not None for x, y in zip(own.whitening_filters, extended.whitening_filters, strict=True))
    held = zip(own.held_out_whitening_filters, extended.held_out_whitening_filters, strict=True)
    assert all(x is y is not None for x, y in held)
    assert made.problem.whitening_filters == made.problem.held_out_whitening_filters == (None,)
    x = own.pack_unknowns({"elbow.stiffness": 2.5})
    assert own.evaluate(x, False).cost == pytest.approx(
        problem_with_whitening_at(own, x).evaluate(x, False).cost, rel=0.02
    )


def held_out_residual(problem, episode, result):
    return episode_residual_and_jacobian(episode, problem.held_out_whitening_filters[0], result).residual


@cases("held_out", {"held_out": True, "in_blocks": False})
def test_what_an_effect_takes_from_a_torque_its_offset_gives_back(step, held_out):
    """Weights are frozen once, about torques that an offset among the effects must not move."""
    made = composed(step, held_out, "effort_offset", "joint_viscous").with_whitening_linearized_at(
        {"elbow.stiffness": 2.5}
    )
    wide = made.problem_with_nominal_and_effects_free(made.candidate_effects)
    at = {"elbow.stiffness": 2.5}
    x, frozen = (wide.pack_unknowns({**at, "effort_offset@shoulder.offset": value}) for value in (0.3, 0.0))
    moved = problem_with_reestimated_held_out_torque_biases(
        problem_relinearized_at_torque_bias(wide, x, frozen), x, frozen
    )
    for group in ("whitening_filters", "held_out_whitening_filters"):
        [before], [after] = getattr(wide, group), getattr(moved, group)
        assert after.filter_steps is before.filter_steps
        biases = before.input_error_model.torque_bias - 0.3, after.input_error_model.torque_bias
        np.testing.assert_allclose(*biases, atol=1e-12)
    there, then = (problem_with_sensor_noise_only(own).evaluate(at) for own, at in ((moved, x), (wide, frozen)))
    np.testing.assert_allclose(there.residual[: len(then.residual)], then.residual, atol=1e-7)
    pairs = ((moved, x), (wide, frozen))
    predicted = ((p, p.predict_held_out(at)[0]) for p, at in pairs)
    own, nominal = (held_out_residual(p, *found) for p, found in predicted)
    assert np.max(np.abs(own - nominal)) > 1e-3  # its prior is no longer about zero
    # and to first order the rows are those of a filter that is worked out there
    again = problem_with_whitening_at(moved, x)
    np.testing.assert_allclose(again.evaluate(x).residual, moved.evaluate(x).residual, atol=0.1)


def test_other_candidates_are_left_out_of_refits(step):
    """A step of some candidates gives the residuals of all, also where others add internal coordinates."""
    made = composed(step, True, "joint_viscous", "joint_presliding", "effort_offset")
    all_candidates, at = (
        made.with_whitening_linearized_at({"elbow.stiffness": 2.5}),
        {"elbow.stiffness": 2.6, "joint_viscous@shoulder.b": 0.02},
    )
    friction = next(e for e in made.candidate_effects if e.label == "joint_viscous@shoulder")
    elsewhere = next(e for e in made.candidate_effects if e.label == "joint_viscous@elbow")
    some = all_candidates.with_step_of_only_effects([friction, elsewhere])
    assert some.problem.step.sizes["nx"] < all_candidates.problem.step.sizes["nx"]
    assert {own.label for own in some.problem.system.effects} == {friction.label, elsewhere.label}
    assert made.with_step_of_only_effects([friction]).problem.whitening_filters == (None,)
    found = []
    for hypotheses in (all_candidates, some):
        own = hypotheses.problem_with_effects_and_relinearized_filters([friction], at)
        own = hypotheses.relinearize_held_out_filters_of_problem(own, [friction], at)
        x = own.pack_unknowns(at)
        evaluation, [held] = own.evaluate(x), own.predict_held_out(x)
        rows = held_out_residual(own, *held)
        found.append((own.unknown_names, evaluation.residual, evaluation.jacobian, rows))
    names, values = zip(*((own[0], own[1:]) for own in found), strict=True)
    assert names[0] == names[1]
    for every, single in zip(*values, strict=True):
        np.testing.assert_allclose(single, every, rtol=1e-6, atol=1e-6 * np.abs(every).max())


def test_states_that_no_error_reaches_are_left_out_of_a_filter():
    """A neutral mount's joints stand still, although equations of a step have them in every row."""
    bare = System.build(objects=[(flexible_object([FlexibleSegment("rod", 0.4, 0.1, 0.01, links=2)]), None, None)])
    mounted = compile_step(bare.with_effects([make_effect("mount_compliance", "base", bare)]), TIME_STEP)
    joints = np.array(["@" not in name for name in mounted.system.mechanism.joint_names])
    own, theta = np.tile(joints, 2), mounted.system.parameters.vector()
    swept = simulate(mounted, theta, np.where(own, 0.01, 0.0), 20)
    assert reachable_and_observable_state_mask(mounted, theta, swept).all()
    assert reachable_and_observable_state_mask(mounted, theta, swept, disturbed=own).tolist() == own.tolist()
    assert not own.all()


def test_noise_that_drives_the_motion_is_no_gap(step):
    """With weights by the sensors' noise alone the same fit leaves several times what noise would."""
    made = composed(step, True)
    fit = fit_nominal_model(problem_of(step, [recorded(step, 1)]), RefitContext(made))
    bare = problem_with_exact_inputs(made.problem)
    plain = bare.evaluate(bare.pack_unknowns(fit.values), False)
    assert 2 * plain.cost > 2 * len(plain.residual)
    _, test, _ = null_tests_of_fit(fit.problem, fit.unknowns, fit.evaluation, 0.01)
    assert 0.8 < test.chi2_per_dof < 1.2
    assert test.p_value > 1e-3


def test_what_parameters_are_unsure_of_is_no_gap(step):
    """A fit to recordings that tell a fiftieth as much may be fifty times as far off."""
    fit = fit_nominal_model(problem_of(step, [recorded(step, 1)]), RefitContext(composed(step, True)))
    spread = noise_only_covariance_sqrt(fit.problem, fit.evaluation)
    off = fit.problem.pack_unknowns(fit.values) + 50 * spread @ np.ones(spread.shape[1]) / math.sqrt(spread.shape[1])
    assert null_tests_of_fit(fit.problem, off, fit.evaluation, 0.01)[1].p_value < 1e-12
    less = replace(fit.evaluation, jacobian=fit.evaluation.jacobian / 50)
    _, test, _ = null_tests_of_fit(fit.problem, off, less, 0.01)
    assert 0.8 < test.chi2_per_dof < 1.2
    assert test.p_value > 1e-3


STRONG, REST = 0.6, 2.0


@pytest.fixture(scope="module")
def sprung(step, robot):
    """The pendulum with candidates, and recordings of it with a spring at the shoulder that its motor works against.

    The spring's torque at rest is twelve times the offset that is stated.
    """
    springs = {"elbow": StiffnessAndRest(3.0), "shoulder": StiffnessAndRest(STRONG)}
    system = System.build(robot, driven=("shoulder",), springs=springs, damping={"shoulder": 0.3, "elbow": 0.05})
    moves = compile_step(system, TIME_STEP)
    # a spring about another angle is one about zero and a constant torque
    files = [recorded(moves, seed, -STRONG * REST) for seed in (1, 2)]
    problem = problem_of(step, files[:1])
    effects = make_candidate_effects(step.system, files[:1], ["joint_spring@shoulder", "effort_offset@shoulder"])
    return problem, AllCandidatesProblem.from_problem(problem, effects, files[1:])


def test_a_filter_is_about_the_torque_that_is_left_beside_an_effect(sprung):
    """Its offset as the nominal model has it, some newton metres, is no error beside the spring."""
    problem, made = sprung
    nominal = fit_nominal_model(problem, RefitContext(made))
    made = replace(made, problem=nominal.problem)
    kinds = ("joint_spring", "effort_offset")
    spring, offset = (next(e for e in made.candidate_effects if e.kind == kind) for kind in kinds)
    k, rest = "joint_spring@shoulder.stiffness", "joint_spring@shoulder.rest_angle"
    found = refit_with_effects(RefitContext(made), [spring], {**nominal.values, k: 0.3, rest: 1.0})
    other = refit_with_effects(RefitContext(made), [offset], nominal.values)
    assert found.values[k] == pytest.approx(STRONG, abs=4 * found.std[k])
    assert found.values[rest] == pytest.approx(REST, abs=4 * found.std[rest])
    assert found.std[k] < 0.1 * STRONG
    assert found.held_out_loss.chi2_per_sample < 1.1 < other.held_out_loss.chi2_per_sample
    for whitening in (*found.problem.whitening_filters, *found.problem.held_out_whitening_filters):
        assert abs(whitening.input_error_model.torque_bias[0]) < OFFSET
    # and what is looked for beside it stands on the same ground
    left, _ = linearize_candidates(made, [spring], found.values)
    assert 0.95 < float(left @ left) / (2 * found.cost) < 1.001


def test_a_law_is_sought_at_another_joint_than_that_of_a_named_effect(sprung):
    """The named effect is refitted in the step of its own joint, which lacks the law."""
    problem, made = sprung
    spring = next(e for e in made.candidate_effects if e.kind == "joint_spring")
    nominal = fit_nominal_model(problem, RefitContext(made))
    own = replace(made, problem=nominal.problem).with_step_of_only_effects([spring])
    found = refit_with_effects(RefitContext(own), [spring], nominal.values)
    assert found.problem.step is not made.problem.step
    search, sought = RefitContext(made, Thresholds(), NULL_PROGRESS), gap_law._neutral_law(found, "elbow", ("angle",))
    before, families = gap_law._refitted_families(search, problem, found, [sought], NO_EVENTS)
    assert [own.law.location for own in families] == ["elbow"]
    assert families[0].fit.cost <= before.cost


def with_absent(step: Step, effect: str) -> Step:
    """The pendulum with an effect that it has not."""
    effects = make_candidate_effects(step.system, [recorded(step, 1)], [effect])
    return compile_step(step.system.with_effects(effects), TIME_STEP)


@pytest.fixture(scope="module")
def geared(step) -> Step:
    """The pendulum whose motor may have an inertia."""
    return with_absent(step, "rotor_inertia@shoulder")


def weighted_at_truth(geared: Step, recording: Recording, feedback: str) -> EstimationProblem:
    free = (*FREE, *(name for effect in geared.system.effects for name in effect.parameters.names))
    options = ProblemOptions(initial_state="equilibrium", arm_tracking_feedback=feedback, arm_proportional_gains=(9.0,))
    problem = EstimationProblem(geared, [recording], free, options, {"elbow.stiffness": 3.0, "elbow.damping": 0.05})
    return problem_with_whitening_at(problem, problem.initial_unknowns, rounds=3)


@pytest.mark.parametrize("effect", ["rotor_inertia@shoulder", "effort_gain@shoulder", "effort_lag@shoulder"])
def test_noise_of_torques_is_not_mistaken_for_what_they_multiply(step, monkeypatch, effect):
    """By recorded torques absent inertias, gains and lags are on average three to five standard deviations off."""
    monkeypatch.setattr("test_torque_noise.WHITE", 6 * WHITE)
    absent, z = with_absent(step, effect), []
    for seed in range(20, 26):
        problem = weighted_at_truth(absent, recorded(step, seed), "proportional")
        residual, jacobian = residual_and_jacobian_with_stated_priors(
            problem, problem.evaluate(problem.initial_unknowns)
        )
        covariance = np.linalg.inv(jacobian.T @ jacobian)
        z.append(-covariance @ jacobian.T @ residual / np.sqrt(np.diag(covariance)))
    assert np.all(np.abs(np.mean(z, axis=0)) < 3 / np.sqrt(len(z)))
    assert np.all(np.mean(np.square(z), axis=0) < 2)


@pytest.mark.parametrize("inverse", [0.5, -1.5, 0.0])
def test_taking_noise_off_a_reading_leaves_the_torque_that_acts(step, inverse):
    """Where weights are frozen, whatever reading and gain; further off the gain multiplies what is no noise."""
    gained = with_absent(step, "effort_gain@shoulder")
    problem = EstimationProblem(gained, [recorded(step, 7)], ("effort_gain@shoulder.inverse",))
    at, near = (np.array([value]) for value in (inverse, inverse + 0.01))
    episode = problem_with_whitening_at(problem, at, rounds=3).episodes[0]
    errors = episode.input_errors
    [theta, later] = [problem.unpack_episode_unknowns(x, 0)[0] for x in (at, near)]
    assert np.max(np.abs(errors.torque_noise)) > WHITE
    acting, more = (problem.predictor.corrected_inputs(episode, own, ()).torque for own in (theta, later))
    np.testing.assert_allclose(acting, inverse * episode.torque - errors.recorded_minus_true_torque, atol=1e-12)
    noise = errors.torque_noise / inverse if inverse else 0.0
    np.testing.assert_allclose(more - acting, 0.01 * (episode.torque - noise), atol=1e-12)


@pytest.mark.parametrize("feedback", ["proportional", "lqr"])
def test_squares_of_innovations_are_the_least_over_all_errors(geared, step, feedback):
    """What sensors and torques must have been wrong by along the smoothed motion, in units of their noise."""
    problem = weighted_at_truth(geared, recorded(step, 8), feedback)
    innovations = problem.evaluate(problem.initial_unknowns).residual[problem.residual_rows.data]
    errors = problem.episodes[0].input_errors
    plain = problem.with_episodes(problem.episodes, ())
    along = plain.evaluate(problem.initial_unknowns).residual[problem.residual_rows.data]
    apart = [errors.torque_noise[:-1] / errors.torque_std, errors.torque_bias / errors.torque_bias_std]
    least = along @ along + sum(float(np.sum(part**2)) for part in apart)
    assert least == pytest.approx(innovations @ innovations, rel=5e-3)
    # and nobody mistakes it for a prediction
    by_sensors = problem_with_sensor_noise_only(problem).evaluate(problem.initial_unknowns)
    recorded_torque = by_sensors.residual[problem.residual_rows.data]
    assert recorded_torque @ recorded_torque > 2 * along @ along


@cases("friction", {"explained": 0.0, "not explained": 0.5})
def test_a_refit_is_as_sure_as_a_solution(step, friction):
    """One deviation for one parameter, whichever command says it; a misfit counts in it."""
    problem = problem_of(step, [recorded(step, 1, friction=friction)])
    found = fit_problem(problem, GaussNewton())
    effects = make_candidate_effects(step.system, [problem.episodes[0].recording], ["joint_viscous"])
    made = AllCandidatesProblem.from_problem(problem, effects, [recorded(step, 2)])
    fit = fit_nominal_model(problem, RefitContext(made), found)
    std = found.parameters["elbow.stiffness"].std
    assert fit.std["elbow.stiffness"] == pytest.approx(std, rel=0.1)
    _, jacobian = residual_and_jacobian_with_stated_priors(fit.problem, fit.evaluation)
    assert (std > 1.5 * np.sqrt(np.linalg.inv(jacobian.T @ jacobian)[0, 0])) == (friction > 0)


LIBRARY = ["joint_viscous@shoulder", "effort_offset@shoulder"]


@pytest.fixture(scope="module")
def within(step):
    """A diagnosis of recordings whose offsets are as was expected."""
    return diagnose(problem_of(step, [recorded(step, 1)], [recorded(step, 2)]), LIBRARY)


def test_offsets_are_named_where_they_leave_what_was_expected(step, within):
    """Within their prior they are no gap; six times as large they are, and named."""
    assert within.verdict == "no_gap"
    far = [recorded(step, seed, 6 * OFFSET) for seed in (3, 4)]
    beyond = diagnose(problem_of(step, far[:1], far[1:]), LIBRARY)
    assert [effect.label for effect in beyond.accepted_effects] == ["effort_offset@shoulder"]
    found = beyond.final_model.values["effort_offset@shoulder.offset"]
    assert found == pytest.approx(6 * OFFSET, abs=4 * OFFSET)


def test_an_effect_is_found_beside_the_noise_of_torques(step, within):
    """A gear whose friction is ten times what could be noticed."""
    name = "joint_viscous@shoulder.b"
    more = 10 * next(
        e.detectable_amplitudes[name] for e in within.screening.detectability if name in e.detectable_amplitudes
    )
    rubbing = [recorded(step, seed, friction=more) for seed in (5, 6)]
    finding = diagnose(problem_of(step, rubbing[:1], rubbing[1:]), LIBRARY)
    assert [effect.label for effect in finding.accepted_effects] == ["joint_viscous@shoulder"]
    assert finding.final_model.values[name] == pytest.approx(more, abs=4 * finding.final_model.std[name])


def test_the_smoother_expects_forces_as_large_as_the_torques_noise(step):
    problem = problem_of(step, [recorded(step, 1)])
    weighted = problem_with_sensor_noise_only(problem)
    x = problem.initial_unknowns
    model = residual_models_with_smoother_unknowns(weighted, x, weighted.evaluate(x))[0]
    decay = math.exp(-0.1 / 0.5)  # intervals of 0.1 s of forces that last for 0.5 s
    column = model.unknown_names.index("shoulder")
    # the integral over a long time has the variance of white noise that is held over each sample
    variance = model.torque_noise_variance[column] * model.reference_std[column] ** 2 - OFFSET**2
    lasting = variance * 0.1 * (1 + decay) / (1 - decay)
    assert lasting == pytest.approx(WHITE**2 * TIME_STEP, rel=0.02)
    assert np.count_nonzero(model.torque_noise_variance) == 1
    calm = problem_with_exact_inputs(problem)
    assert not residual_models_with_smoother_unknowns(calm, x, calm.evaluate(x))[0].torque_noise_variance.any()


def test_the_smoother_starts_at_rest_and_counts_priors_once(step):
    """Rest under constant unknowns stays rest; a prior of a parameter is an observation beside all recordings."""
    plain = problem_with_sensor_noise_only(problem_of(step, [recorded(step, seed) for seed in (1, 2)]))
    x = 1.1 * plain.initial_unknowns
    given = plain.with_options(replace(plain.options, prior_stds={"elbow.stiffness": 0.5}))
    bare, models = (residual_models_with_smoother_unknowns(own, x, own.evaluate(x)) for own in (plain, given))
    assert [model.recording for model in models] == ["run_1", "run_2"]
    for i, (model, other) in enumerate(zip(models, bare, strict=True)):
        for j, (here, there) in enumerate(zip(model.intervals, other.intervals, strict=True)):
            row = np.array([(x[0] - 3.0) / 0.5, plain.unknown_scales[0] / 0.5, 0.0]) if i == j == 0 else np.zeros(3)
            added = here.unreachable_products - there.unreachable_products
            np.testing.assert_allclose(added, np.outer(row, row), atol=1e-6)
        first, rest = model.intervals[0], model.initial_state_jacobian
        forced = [k for k, group in enumerate(model.unknown_groups) if group.kind == "force"]
        later = first.state_transition @ rest + first.unknown_input_matrix
        np.testing.assert_allclose(later[:, forced], rest[:, forced], rtol=1e-3, atol=1e-6)
        assert np.all(np.abs(rest[:, forced]).max(axis=0) > 1e-3)
        assert not model.initial_state_std.any()

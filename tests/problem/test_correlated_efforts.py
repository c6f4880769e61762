"""Measured efforts count for as much as they tell: smoothed ones, and errors of one acceleration in all of them."""

import math
from dataclasses import replace

import numpy as np
import pytest
from small_problems import PENDULUM, correlated, efforts, measured, pendulum_step, taken

from yid_ocp.analysis.friction_law_comparison import problems_with_common_samples
from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.errors import DataError
from yid_ocp.inference.null_test import channels_with_residual_indices
from yid_ocp.inference.smoother_model import residual_models_with_smoother_unknowns
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.problem.estimation_problem import held_out_prediction_arguments
from yid_ocp.sensors.joints import JOINT_EFFORT_SENSOR_KEY
from yid_ocp.solvers import GaussNewton, MultipleShooting, SingleShooting, fit_problem
from yid_ocp.solvers.symbolic_transcription import transcribe

NAN = math.nan
JOINTS = ("shoulder", "elbow")
ANGLE, EFFORT = 2e-4, 0.01  # [rad], [N m]
CUTOFF, TWINS = 8.0, 40  # [Hz]


def test_rows_are_independent_whatever_of_a_sample_was_seen():
    correlation = np.array([[[1.0, 0.8, -0.3], [0.8, 1.0, 0.1], [-0.3, 0.1, 1.0]]] * 2)
    made = measured(efforts("a", "b", "c"), [0, 1], [0.0, 0.0], [[1.0, 2.0, 3.0], [4.0, NAN, 6.0]])
    made = replace(made, noise_correlation=correlation, weight=made.weight * 2.0)
    mixing = made.residual_decorrelation_matrix.toarray()
    np.testing.assert_allclose(mixing, mixing.T, atol=1e-12)
    covariance = np.zeros((5, 5))
    covariance[:3, :3] = correlation[0]
    covariance[3:, 3:] = correlation[1][np.ix_([0, 2], [0, 2])]
    np.testing.assert_allclose(mixing @ covariance @ mixing, np.eye(5), atol=1e-12)
    predicted = np.array([[0.0, 1.0, 5.0], [1.0, 9.0, 2.0]])
    plain = 2.0 * np.array([-1.0, -1.0, 2.0, -3.0, -4.0])
    np.testing.assert_allclose(made.residual_and_jacobian(predicted).residual, mixing @ plain, rtol=1e-12)
    np.testing.assert_allclose(made.whitened_residual(predicted)[made.positive_weight_mask], mixing @ plain, rtol=1e-12)
    assert made.whitened_residual(predicted)[1, 1] == 0.0
    slopes = np.random.default_rng(0).standard_normal((2, 3, 4))
    found = made.residual_and_jacobian(predicted, slopes, threshold=1.5)
    seen = made.positive_weight_mask
    expected = found.robust_factor[:, None] * (mixing @ (2.0 * slopes[seen]))
    np.testing.assert_allclose(found.jacobian, expected, rtol=1e-12)
    pull = np.random.default_rng(1).standard_normal((2, 3))
    back = np.einsum("mk,mkd->d", made.whitened_residual_adjoint(np.where(seen, pull, 0.0)), slopes)
    np.testing.assert_allclose(back, pull[seen] @ made.residual_and_jacobian(predicted, slopes).jacobian, rtol=1e-12)


def arm(step, path, effort, angle=ANGLE, std=EFFORT, free=("shoulder.damping",), cutoff=CUTOFF, values=None, **joint):
    t = 0.01 * np.arange(len(path))
    group = JointGroup(
        JOINTS, t, path, effort=effort, position_std=angle, effort_std=std, **{"effort_kind": "sample"} | joint
    )
    options = ProblemOptions(path_cutoff=cutoff, weak_prior_geometric_std=0.0)
    return EstimationProblem(step, [Recording(group, name="arm")], free, options, values)


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
        [samples] = problem.episodes[0].measurements
        [predicted] = evaluation.episode_predictions[0].predicted_outputs
        found.append(evaluation.residual.reshape(-1, 2))
        alone.append((predicted - samples.value) / samples.std)
    rows, plain = np.vstack(found), np.vstack(alone)
    assert len(rows) > 1500
    assert np.corrcoef(plain.T)[0, 1] > 0.5  # what independent rows would make of them
    np.testing.assert_allclose(rows.T @ rows / len(rows), np.eye(2), atol=0.1)


def correlated_problem(folder, cutoff=math.inf, **how):
    step = pendulum_step(folder, **how)
    names = ("shoulder.damping", "elbow.damping")
    options = ProblemOptions(weak_prior_geometric_std=0.0, path_cutoff=cutoff)
    made = EstimationProblem(step, [taken(step, 1, steps=40 if math.isinf(cutoff) else 90)], names, options)
    return made.with_episodes([correlated(episode) for episode in made.episodes], ())


@pytest.mark.parametrize(
    "how", [{"prescribed": JOINTS}, {"prescribed": JOINTS, "cutoff": 15.0}, {}], ids=["moved", "moved_smoothly", "free"]
)
def test_derivatives_and_transcriptions_count_what_is_correlated(urdf_folder, how):
    problem = correlated_problem(urdf_folder, **how)
    x = 1.2 * problem.initial_unknowns
    evaluation = problem.evaluate(x)
    ends = [(problem.evaluate(x + d).residual, problem.evaluate(x - d).residual) for d in np.diag(1e-6 * x)]
    moved = [(above - below) / (2e-6 * value) for (above, below), value in zip(ends, x, strict=True)]
    np.testing.assert_allclose(evaluation.jacobian, np.stack(moved, axis=1), rtol=1e-5, atol=1e-5 * np.abs(moved).max())
    np.testing.assert_allclose(problem.cost_and_gradient(x)[1], evaluation.jacobian.T @ evaluation.residual, rtol=1e-8)
    program = transcribe(problem)
    arguments, theta = program.solver_arguments, program.find_vector_block("theta").index.ravel()
    arguments["lbx"][theta] = arguments["ubx"][theta] = x
    solver = program.make_solver("ipopt", "exact", ipopt={"print_level": 0, "sb": "yes", "tol": 1e-9})
    assert float(solver(**arguments)["f"]) == pytest.approx(evaluation.cost, rel=1e-8)
    if "cutoff" in how:  # what is measured of the efforts says little beside points that are this wrong
        return
    solvers = [GaussNewton(), SingleShooting()]
    solvers += [] if how else [MultipleShooting(), MultipleShooting(condensing=True)]
    found = [fit_problem(problem, s, restarts=False) for s in solvers]
    for other in found[1:]:
        assert other.cost == pytest.approx(found[0].cost, rel=1e-6)
        np.testing.assert_allclose(other.x, found[0].x, rtol=1e-3)


def test_unknown_forces_are_seen_as_correlated(urdf_folder):
    problem = correlated_problem(urdf_folder, prescribed=JOINTS)
    [linear] = residual_models_with_smoother_unknowns(
        problem, problem.initial_unknowns, problem.evaluate(problem.initial_unknowns)
    )
    at = [linear.unknown_names.index(joint) for joint in JOINTS]
    found = sum(interval.unknown_jacobian[:, at].T @ interval.unknown_jacobian[:, at] for interval in linear.intervals)
    [samples] = (s for s in problem.episodes[0].measurements if s.sensor.effort_joints)
    slopes = samples.weight[:, :, None] * np.diag(linear.reference_std[at])
    assert np.array_equal(samples.sensor.effort_joints, JOINTS)
    seen = samples.residual_decorrelation_matrix @ slopes[samples.positive_weight_mask]
    # but for the first and the last step, of which a node sees half
    np.testing.assert_allclose(found, seen.T @ seen, rtol=0.03)
    assert abs(found[0, 1]) > 0.05 * found.diagonal().min()


def test_a_gear_does_not_give_way_to_the_noise_of_an_effort_that_is_compared(urdf_folder):
    """An elasticity that is not there is found as often as chance has it."""
    elastic = [("series_elasticity", "elbow", {"compliance": 0.0})]
    step, path = pendulum_step(urdf_folder, elastic, prescribed=JOINTS), motion()
    effort, sizes = needed(pendulum_step(urdf_folder, prescribed=JOINTS), path), []
    given = {"angle": 0.0, "std": 0.3, "free": ("series_elasticity@elbow.compliance",)}
    for seed in range(TWINS):
        noise = np.random.default_rng(seed).standard_normal(effort.shape)
        found = (problem := arm(step, path, effort + 0.3 * noise, **given)).evaluate(problem.initial_unknowns)
        slope = found.jacobian[:, 0]
        sizes.append((slope @ found.residual) / np.linalg.norm(slope))
    assert np.mean(np.square(sizes)) < 2.0


def test_a_gear_gives_way_to_its_load_and_not_to_the_noise_of_encoders(urdf_folder):
    """Loads that follow from noisy angles are differentiated twice, and again where the gear gives way to them."""
    name, true, path = "series_elasticity@elbow.compliance", 0.02, motion()
    step = pendulum_step(urdf_folder, [("series_elasticity", "elbow", {"compliance": 0.0})], prescribed=JOINTS)
    effort, sizes = needed(pendulum_step(urdf_folder, prescribed=JOINTS), path), []
    for seed in range(4):
        noise = np.random.default_rng(seed).standard_normal((2, *path.shape))
        seen, read = path + true * effort * [0, 1] + 2e-4 * noise[0], effort + 0.02 * noise[1]
        given = {"angle": 2e-4, "std": 0.02, "free": (name,), "cutoff": 15.0, "values": {name: true}}
        found = (problem := arm(step, seen, read, **given)).evaluate(problem.initial_unknowns)
        slope = found.jacobian[:, 0]
        sizes.append(1 - slope @ found.residual / (slope @ slope) / true)
    assert np.mean(sizes) == pytest.approx(1.0, abs=0.1)


def test_dry_friction_needs_no_time_to_turn(urdf_folder):
    """Measured efforts are smoothed: a prediction that is not has other steps where the motion turns."""
    friction = [("joint_coulomb", "elbow", {"tau_c": 0.4})]
    step, path = pendulum_step(urdf_folder, friction, prescribed=JOINTS), motion()
    noisy = needed(step, path) + 0.05 * np.random.default_rng(2).standard_normal(path.shape)
    problem = arm(step, path, noisy, angle=0.0, std=0.05)
    found = problem.evaluate(problem.initial_unknowns, derivatives=False).residual
    assert found @ found / len(found) < 1.5
    [samples] = problem.episodes[0].measurements
    assert np.abs(np.diff(samples.value[:, 1])).max() > 30 * samples.std.max()


@pytest.mark.parametrize(("free", "size"), [(True, 1.0), (False, 1.0), (True, 6.0)], ids=["free", "known", "fast"])
def test_an_effort_where_an_estimated_dry_friction_may_hold_the_joint_is_no_measurement(free, size, urdf_folder):
    friction = [("joint_coulomb", "elbow", {"tau_c": 0.4}), ("joint_viscous", "shoulder", {"b": 0.1})]
    step, path = pendulum_step(urdf_folder, friction, prescribed=JOINTS), size * motion()
    names = ("joint_viscous@shoulder.b", *(("joint_coulomb@elbow.tau_c",) if free else ()))
    [samples] = arm(step, path, np.ones_like(path), angle=0.0, free=names).episodes[0].measurements
    speed, reach = np.gradient(path[:, 1], 0.01), round(1 / (2 * CUTOFF) / 0.01)
    windows = [speed[node - reach : node + reach] for node in samples.node]
    slow = np.array([np.abs(own).min() < 0.06 for own in windows])
    stops = slow | [own.min() < 0 < own.max() for own in windows]
    assert not np.isnan(samples.value[:, 0]).any()
    np.testing.assert_array_equal(np.isnan(samples.value[:, 1]), free & stops)
    assert 4 < np.count_nonzero(stops) < 0.5 * len(stops)
    assert np.any(stops & ~slow) == (size > 1), "a fast joint turns between two samples"


def test_friction_laws_are_compared_on_the_samples_that_all_of_them_use(urdf_folder):
    friction = [("joint_coulomb", "elbow", {"tau_c": 0.4}), ("joint_viscous", "elbow", {"b": 0.1})]
    step, path = pendulum_step(urdf_folder, friction, prescribed=JOINTS), motion()
    names = ("joint_viscous@elbow.b",), ("joint_coulomb@elbow.tau_c",)
    laws = [arm(step, path, np.ones_like(path), angle=0.0, free=own) for own in names]
    masks = [
        [own.positive_weight_mask for own in problem.episodes[0].measurements]
        for problem in (*laws, *problems_with_common_samples(laws))
    ]
    assert masks[0][0].sum() > masks[1][0].sum()
    np.testing.assert_array_equal(masks[2], masks[1])
    np.testing.assert_array_equal(masks[3], masks[1])
    for problem in problems_with_common_samples(laws):
        [samples] = problem.episodes[0].measurements
        np.testing.assert_array_equal(np.isfinite(samples.value), samples.positive_weight_mask)


DAMPING = {"shoulder.damping": 0.3, "elbow.damping": 0.2}
EFFORT_NOISE = 0.05  # of the efforts [N m]
LOW_CUTOFF = 5.0  # [Hz]


@pytest.fixture(scope="module")
def efforts_of(urdf_folder):
    """efforts_of(effort, cutoff): both joints moved as measured for six seconds at 100 Hz, their efforts measured."""
    system = System.build(read_urdf(urdf_folder / "double_pendulum.urdf"), prescribed=JOINTS, damping=0.1)
    step = compile_step(system, 0.01)
    t = 0.01 * np.arange(601)
    path = np.stack([0.6 * np.sin(2.9 * t), 0.5 * np.sin(3.7 * t + 1)], axis=1)

    known = 0.0, EFFORT_NOISE, tuple(DAMPING)
    return lambda effort, cutoff, kind=None: arm(step, path, effort, *known, cutoff, DAMPING, effort_kind=kind)


def test_deviations_are_those_of_repeats(efforts_of):
    exact = efforts_of(np.zeros((601, 2)), math.inf)
    inner = exact.evaluate(exact.initial_unknowns, derivatives=False).episode_predictions[0].predicted_outputs[0]
    clean = np.vstack([inner[:1], inner, inner[-1:]])
    found, stated = [], []
    for seed in range(60):
        noise = EFFORT_NOISE * np.random.default_rng(seed).standard_normal(clean.shape)
        solution = fit_problem(efforts_of(clean + noise, LOW_CUTOFF), GaussNewton())
        found.append([solution.parameters[name].value for name in DAMPING])
        stated.append([solution.parameters[name].std for name in DAMPING])
    error = np.array(found) - list(DAMPING.values())
    assert 0.90 <= np.mean(np.abs(error) <= 1.96 * np.array(stated)) <= 0.99
    np.testing.assert_allclose(np.std(error, axis=0), np.median(stated, axis=0), rtol=0.2)


def test_a_record_shorter_than_the_filter_is_refused(efforts_of):
    with pytest.raises(DataError, match=r"(?s)6 s of joints.effort are too short.*more than 15\.4 s"):
        efforts_of(np.zeros((601, 2)), 0.5)


def test_neighbours_that_repeat_each_other_are_left_out(efforts_of):
    nothing = np.zeros((601, 2))
    plain, smooth = (efforts_of(nothing, cutoff).episodes[0].measurements[0] for cutoff in (math.inf, LOW_CUTOFF))
    np.testing.assert_array_equal(plain.node, np.arange(1, 600))
    np.testing.assert_array_equal(smooth.node + np.rint(smooth.fraction), np.arange(77, 524, 10))
    assert efforts_of(nothing, 0.0).options.path_cutoff == 20.0, "angles without noise are all motion"


@pytest.mark.parametrize(("kind", "late"), [(None, 0.0), ("sample", 0.0), ("mean", 0.005), ("command", 0.005)])
def test_an_effort_that_stands_for_an_interval_belongs_to_its_middle(efforts_of, kind, late):
    t = 0.01 * np.arange(601)
    [samples] = efforts_of(np.stack([t, 2 - t], axis=1), np.inf, kind).episodes[0].measurements
    at = 0.01 * (samples.node + samples.fraction)[:, None]
    np.testing.assert_allclose(samples.value.reshape(len(at), 2), np.hstack([at - late, 2 - at + late]), atol=1e-12)


@pytest.mark.parametrize("kind", ["sample", "mean", "command"])
def test_settings_say_what_recorded_efforts_are(urdf_folder, kind):
    step = pendulum_step(urdf_folder, driven=PENDULUM)
    recorded, free = taken(step, 1), ["shoulder.damping"]
    stated = ProblemOptions(sensors={JOINT_EFFORT_SENSOR_KEY: SensorOptions(effort_sampling_kind=kind)})
    [said] = EstimationProblem(step, [recorded], free, stated).episodes
    [held] = EstimationProblem(step, [recorded.with_effort_sampling_kind(kind)], free, ProblemOptions()).episodes
    assert said.recording.joints.effort_kind == kind
    np.testing.assert_array_equal(said.torque, held.torque)
    assert (np.abs(said.torque - recorded.joints.effort[:-1]).max() < 1e-12) == (kind != "sample")


@pytest.mark.parametrize("cutoff", [math.inf, 20.0, LOW_CUTOFF])
@pytest.mark.parametrize("time_step", [0.02, 0.005, 0.0025])
def test_efforts_are_compared_where_they_were_measured(efforts_of, cutoff, time_step):
    """Never between samples, however short the step: what lies there was not measured. A shorter step keeps them."""
    effort = np.random.default_rng(0).standard_normal((601, 2))
    problem, found, correlations = efforts_of(effort, cutoff), {}, []
    for h in (0.01, time_step):
        changed = problem.with_time_step(h)
        correlations.append(channels_with_residual_indices(changed)[0].noise_autocorrelation[:3])
        [samples] = changed.episodes[0].measurements
        found[h] = dict(zip(np.round((samples.node + samples.fraction) * h / 0.01, 6), samples.value, strict=True))
    assert all(time == round(time) for time in found[time_step])
    if time_step < 0.01:
        assert found[time_step].keys() == found[0.01].keys()
        np.testing.assert_allclose(*correlations, atol=0.04)
    if math.isinf(cutoff):
        for time, value in found[time_step].items():
            np.testing.assert_allclose(value, effort[round(time)], atol=1e-12)


def test_friction_that_holds_a_held_out_arm_is_estimated_from_its_first_efforts(urdf_folder):
    """Filtered efforts begin long after the recording does, and friction that holds acts from its start on."""
    friction = {"tau_c": 0.5, "yield_angle": 0.005}
    step = pendulum_step(urdf_folder, [("joint_presliding", "elbow", friction)], prescribed=JOINTS)
    still = np.tile([0.3, 0.2], (301, 1))
    problem = arm(step, still, needed(step, still) + np.array([0.0, 0.6 * friction["tau_c"]]))
    held = problem.with_episodes(problem.episodes, problem.episodes)
    [(episode, _, offset)] = held_out_prediction_arguments(held, problem.initial_unknowns)
    assert episode.measurements[0].node[0] * 0.01 > 0.2
    assert offset == pytest.approx([0.6], abs=0.01)

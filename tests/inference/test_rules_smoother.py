"""What the smoother adds, against dense algebra over all disturbances and parameters at once."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Literal

import casadi as ca
import numpy as np
import pytest
import threadpoolctl
from baxter import baxter_foam_y_system
from small_problems import places

from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.inference import smoother, smoother_model
from yid_ocp.inference.smoother import gap_locations_by_smoother_evidence, smooth_unknown_forces_and_biases
from yid_ocp.inference.smoother_model import ResidualStateSpaceModel, SmoothedUnknownGroup, _IntervalModel
from yid_ocp.integrator.step import compile_step, simulate
from yid_ocp.model import System
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.solvers import GaussNewton, fit_problem

SOURCES = tuple(SmoothedUnknownGroup(*told) for told in (("T1", "force"), ("T2", "force"), ("camera", "bias")))
FORCE, OTHER_FORCE, BIAS = SOURCES
STATES, COUNT, ROWS, DECAY = 2, 8, 6, 0.7


@pytest.fixture(autouse=True)
def one_thread():
    """The matrices are small."""
    with threadpoolctl.threadpool_limits(1):
        yield


def made(seed: int, parameters=2, recording="run", size=None, loose=0.3) -> ResidualStateSpaceModel:
    """A linear model of three unknowns; with `size` its residual holds disturbances of these standard deviations."""
    rng = np.random.default_rng(seed)
    intervals = []
    for _ in range(COUNT):
        outside = rng.standard_normal((2, 1 + parameters))
        outside[:, 0] *= 0.0 if size is None else 1.0
        shapes = (ROWS, 1 + parameters), (ROWS, STATES), (ROWS, len(SOURCES)), (STATES, STATES), (STATES, len(SOURCES))
        residual, by_state, by_unknown, state, drive = (rng.standard_normal(shape) for shape in shapes)
        outside = outside.T @ outside
        intervals.append(_IntervalModel(residual, by_state, by_unknown, 0.5 * state, drive, outside, ROWS + 2))
    start = rng.standard_normal((STATES, len(SOURCES))), np.full(STATES, loose)
    told = 0.1 * np.arange(COUNT + 1), tuple(f"u{i}" for i in range(len(SOURCES))), SOURCES, np.ones(3)
    model = ResidualStateSpaceModel(recording, tuple(intervals), *told, *start, DECAY, np.zeros(3))
    if size is not None:
        design, _ = dense(model)
        scale = np.concatenate([model.initial_state_std, np.tile(size, COUNT)])
        signal = (design @ (scale * rng.standard_normal(len(scale)))).reshape(COUNT, ROWS)
        for interval, part in zip(intervals, signal, strict=True):
            interval.negative_residual_jacobian[:, 0] += part
    return model


def dense(model: ResidualStateSpaceModel) -> tuple[np.ndarray, np.ndarray]:
    """Residual rows, and unknowns (COUNT, nd, ...), by the first state and all disturbances of unit variance."""
    nd, width = len(model.unknown_groups), STATES + len(model.unknown_groups) * COUNT
    unknown = np.zeros((COUNT, nd, width))
    for j in range(COUNT):
        if j:
            unknown[j] = model.interval_correlation * unknown[j - 1]
        own = slice(STATES + nd * j, STATES + nd * (j + 1))
        unknown[j][:, own] += np.eye(nd) * (math.sqrt(1 - model.interval_correlation**2) if j else 1.0)
    state = np.eye(STATES, width) + model.initial_state_jacobian @ unknown[0]
    rows = []
    for j, interval in enumerate(model.intervals):
        rows.append(interval.state_jacobian @ state + interval.unknown_jacobian @ unknown[j])
        state = interval.state_transition @ state + interval.unknown_input_matrix @ unknown[j]
    return np.vstack(rows), unknown


class Dense:
    """Posterior and evidence of several recordings with common parameters, all at once."""

    def __init__(self, models, variance):
        self.models, blocks, observed, prior, outside = models, [], [], [], []
        for model in models:
            design, _ = dense(model)
            blocks.append(design)
            observed.append(np.vstack([i.negative_residual_jacobian for i in model.intervals]))
            by_source = np.array([variance[s] for s in model.unknown_groups]) + model.torque_noise_variance
            prior.append(np.concatenate([model.initial_state_std**2, np.tile(by_source, COUNT)]))
            for interval in model.intervals:
                values, vectors = np.linalg.eigh(interval.unreachable_products)
                outside.append((vectors * np.sqrt(np.maximum(values, 0.0))).T)
        rows = sum(len(b) for b in blocks)
        self.design = np.zeros((rows + sum(map(len, outside)), sum(b.shape[1] for b in blocks)))
        row = column = 0
        for block in blocks:
            self.design[row : row + len(block), column : column + block.shape[1]] = block
            row, column = row + len(block), column + block.shape[1]
        self.observed = np.vstack([*observed, *outside])
        self.prior = np.concatenate(prior)
        self.y, self.by_theta = self.observed[:, 0], self.observed[:, 1:]
        noise = np.eye(len(self.y)) + (self.design * self.prior) @ self.design.T
        self.conditional = noise
        # a parameter may move by three of its sizes
        self.total = noise + 9.0 * self.by_theta @ self.by_theta.T
        self.inverse = np.linalg.inv(self.total)

    @property
    def log_evidence(self):
        return -0.5 * (self.y @ self.inverse @ self.y + np.linalg.slogdet(self.total)[1])

    @property
    def theta(self):
        return 9.0 * self.by_theta.T @ self.inverse @ self.y

    def disturbances(self):
        """Mean and covariance, the parameters' uncertainty in it."""
        gain = self.prior[:, None] * self.design.T @ self.inverse
        return gain @ self.y, np.diag(self.prior) - gain @ self.design * self.prior

    def scores(self, model_index, column):
        """|score|^2 of one unknown's disturbances and its expectation."""
        nd, start = len(SOURCES), model_index * (STATES + len(SOURCES) * COUNT) + STATES
        own = self.design[:, [start + nd * j + column for j in range(COUNT)]]
        return np.sum((own.T @ self.inverse @ self.y) ** 2), np.trace(own.T @ self.inverse @ own)


def smoothed(monkeypatch, models, **limits):
    """The smoother on linear models as they are."""
    monkeypatch.setattr(smoother, "residual_models_with_smoother_unknowns", lambda *_: tuple(models))
    return smooth_unknown_forces_and_biases(
        SimpleNamespace(has_process_noise=False, episodes=()), np.zeros(0), None, **limits
    )


NOTHING = dict.fromkeys(SOURCES, 0.0)


def test_parameters_that_rounding_cannot_tell_apart_share_the_step():
    products = 1e24 * np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0 - 1e-15]])
    evidence, shift, _ = smoother._judged(products, 0.0)
    assert np.isfinite(evidence)
    assert np.sum(shift) == pytest.approx(1.0)


def test_variances_stay_within_their_range(monkeypatch):
    assert set(smoothed(monkeypatch, [made(3, size=np.full(3, 1e9))]).group_variance.values()) == {1e7}
    assert smoother._refined([made(3, size=np.zeros(3))], NOTHING | {FORCE: 1e-6}, 0.0).variance[FORCE] >= 1e-6
    assert smoother._refined([made(1, loose=1e12)], NOTHING, 0.0).log_evidence == -math.inf


def test_a_group_may_hold_several_unknowns_and_some_of_them_errors_that_are_known(monkeypatch):
    shared = {"unknown_groups": (FORCE, FORCE, BIAS), "torque_noise_variance": np.array([0.0, 0.4, 0.0])}
    models = [replace(made(seed, size=np.array([size, 0.0, 0.0])), **shared) for seed, size in ((3, 30.0), (4, 20.0))]
    found = smoothed(monkeypatch, models)
    none, most = {FORCE: 0.0, BIAS: 0.0}, Dense(models, found.group_variance).log_evidence
    assert found.log_evidence["both"] == pytest.approx(most - Dense(models, none).log_evidence, rel=1e-7)
    for times in (0.25, 4.0):
        assert most > Dense(models, found.group_variance | {FORCE: times * found.group_variance[FORCE]}).log_evidence


@pytest.mark.parametrize("column", [0, 1, 2])
def test_the_group_that_explains_the_residual_is_taken_in(monkeypatch, column):
    size = np.zeros(3)
    size[column] = 3.0
    models = [made(5, size=size), made(6, size=size, recording="second")]
    found = smoothed(monkeypatch, models)
    source = SOURCES[column]
    assert set({s: v for s, v in found.group_variance.items() if v}) == {source}
    best = max(Dense(models, NOTHING | {source: v}).log_evidence for v in np.geomspace(0.05, 400, 60))
    assert Dense(models, found.group_variance).log_evidence == pytest.approx(best, abs=0.15)
    reference, nothing = Dense(models, found.group_variance), Dense(models, NOTHING)
    own, other = ("sensor", "plant") if source is BIAS else ("plant", "sensor")
    gained = pytest.approx(reference.log_evidence - nothing.log_evidence)
    assert found.log_evidence[own] == found.log_evidence["both"] == gained
    assert found.log_evidence[own] > found.log_evidence[other] + 5
    assert found.log_evidence["none"] == 0.0
    assert found.log_evidence_drop == NOTHING | {source: gained}
    assert found.plant_or_sensor_origin == own
    assert found.min_log_bayes_factor == 5.0


def test_several_groups_are_taken_in_while_the_evidence_rises_enough(monkeypatch):
    models = [made(7, size=np.array([3.0, 3.0, 3.0])), made(8, size=np.array([3.0, 3.0, 3.0]))]
    found = smoothed(monkeypatch, models)
    assert all(v > 0 for v in found.group_variance.values())
    full = Dense(models, found.group_variance).log_evidence
    for source in SOURCES:
        size = found.group_variance[source]
        for other in (size / 2, 2 * size):  # the variances together are those of the largest evidence
            assert Dense(models, found.group_variance | {source: other}).log_evidence < full + 0.15
        less = Dense(models, found.group_variance | {source: 0.0}).log_evidence
        assert found.log_evidence_drop[source] == pytest.approx(full - less, rel=1e-6)
    assert found.plant_or_sensor_origin == "both"
    assert not any(smoothed(monkeypatch, models, least=1e6).group_variance.values())
    monkeypatch.setattr(smoother, "_MAX_GROUPS", 2)
    assert sum(v > 0 for v in smoothed(monkeypatch, models).group_variance.values()) == 2


def test_noise_alone_takes_nothing_in(monkeypatch):
    found = smoothed(monkeypatch, [made(9, size=np.zeros(3), loose=0.0)])
    assert found.plant_or_sensor_origin == "none"
    assert not any(found.group_variance.values())
    assert found.log_evidence_drop == NOTHING
    assert found.chi2_before == pytest.approx(found.chi2_after)
    assert found.dof_before == found.dof_after == COUNT * (ROWS + 2) - 2


def test_what_is_explained_is_the_fall_of_the_residual_and_the_degrees_that_it_takes(monkeypatch):
    models = [made(5, size=np.array([3.0, 0.0, 0.0])), made(6, size=np.array([3.0, 0.0, 0.0]))]
    found = smoothed(monkeypatch, models)
    plain, full = Dense(models, NOTHING), Dense(models, found.group_variance)
    bare = plain.y - plain.by_theta @ plain.theta
    # the first state is loose in any case, but it is no unknown: only the residual after it counts
    assert found.chi2_before == pytest.approx(float(bare @ bare), rel=1e-8)
    left = np.linalg.solve(full.conditional, full.y - full.by_theta @ full.theta)
    assert found.chi2_after == pytest.approx(float(left @ left), rel=1e-8)
    assert found.dof_before == 2 * COUNT * (ROWS + 2) - 2
    start = [STATES + 3 * j for j in range(COUNT)]
    own = [model * (STATES + 3 * COUNT) + i for model in range(2) for i in start]
    design = full.design[:, own]
    taken = found.group_variance[FORCE] * np.trace(design.T @ np.linalg.solve(full.conditional, design))
    assert found.dof_after == pytest.approx(found.dof_before - taken, rel=1e-8)


def test_traces_hold_the_posterior_with_the_uncertainty_of_parameters(monkeypatch):
    models = [made(5, size=np.array([3.0, 0.0, 0.0])), made(6, size=np.array([3.0, 0.0, 0.0]), recording="second")]
    found = smoothed(monkeypatch, models)
    mean, covariance = Dense(models, found.group_variance).disturbances()
    assert [trace.recording for trace in found.smoothed_unknowns] == ["run", "second"]
    width = STATES + 3 * COUNT
    for i, trace in enumerate(found.smoothed_unknowns):
        _, unknown = dense(models[i])
        own = slice(i * width, (i + 1) * width)
        np.testing.assert_allclose(trace.posterior_mean, unknown @ mean[own], rtol=1e-6, atol=1e-9)
        variance = np.einsum("jdw,wv,jdv->jd", unknown, covariance[own, own], unknown)
        np.testing.assert_allclose(trace.posterior_std, np.sqrt(np.maximum(variance, 0.0)), rtol=1e-5, atol=1e-7)
        assert trace.unknown_names == ("u0", "u1", "u2")
        np.testing.assert_array_equal(trace.interval_edges, models[i].interval_edges)


def test_what_would_be_noticed_comes_from_the_model_alone(monkeypatch):
    models = [made(5, size=np.array([3.0, 0.0, 0.0]))]
    found = smoothed(monkeypatch, models)
    reference = Dense(models, NOTHING)
    for column, source in enumerate(SOURCES):
        expected = math.sqrt(10.0 / reference.scores(0, column)[1])
        assert found.detectable_std[source] == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("unknown", [0, 2])
def test_what_is_said_of_one_unknowns_history_is_that_of_dense_algebra(unknown):
    model = made(5)
    variance = dict(zip(SOURCES, (0.8, 0.0, 2.5), strict=True))
    reference = Dense([model], variance)
    assert smoother.force_log_likelihood_coefficients(made(1, loose=1e12), variance, [unknown]) == []
    state, rows = np.zeros((STATES, COUNT)), []
    for j, interval in enumerate(model.intervals):
        now = np.eye(COUNT)[j]
        rows.append(interval.state_jacobian @ state + np.outer(interval.unknown_jacobian[:, unknown], now))
        state = interval.state_transition @ state + np.outer(interval.unknown_input_matrix[:, unknown], now)
    response = np.vstack([*rows, np.zeros((len(reference.y) - COUNT * ROWS, COUNT))])
    score, information = smoother.force_log_likelihood_coefficients(model, variance, [1, unknown])[1]
    assert score == pytest.approx(response.T @ reference.inverse @ reference.y, rel=1e-7, abs=1e-9)
    assert information == pytest.approx(response.T @ reference.inverse @ response, rel=1e-7, abs=1e-9)


HERE, OTHER = (SmoothedUnknownGroup(place, "force") for place in ("here", "elsewhere"))
LIKE = SmoothedUnknownGroup("there", "push")


@pytest.mark.parametrize(("otherwise", "named"), [(0.9, (LIKE,)), (1.2, ())])
def test_a_place_that_does_as_well_is_told(monkeypatch, otherwise, named):
    """Two unknowns at two places do much the same, a third something else, and the first one is at work."""
    model, rng, intervals = made(2, size=np.array([7.0, 0.0, 0.0])), np.random.default_rng(0), []
    for one in model.intervals:
        by, drive = one.unknown_jacobian[:, [0, 0, 2]], one.unknown_input_matrix[:, [0, 0, 2]]
        by[:, 1] += otherwise * rng.standard_normal(len(by))
        intervals.append(replace(one, unknown_jacobian=by, unknown_input_matrix=drive))
    same = {"unknown_groups": (HERE, LIKE, OTHER), "initial_state_jacobian": model.initial_state_jacobian[:, [0, 0, 2]]}
    found = smoothed(monkeypatch, [replace(model, intervals=tuple(intervals), **same)])
    assert found.log_evidence_drop[HERE] > 50
    assert found.alternative_groups == {HERE: named}


def test_it_is_named_beside_the_place_but_its_own_other_unknowns_are_not():
    same = SmoothedUnknownGroup("here", "push")
    sizes, detectable = {HERE: 1.0, LIKE: 0.0, same: 0.0}, dict.fromkeys((HERE, LIKE, same), 0.5)
    seen = SimpleNamespace(group_variance=sizes, detectable_std=detectable, smoothed_unknowns=())
    seen.log_evidence_drop, seen.alternative_groups = {HERE: 9.0, LIKE: 0.0, same: 0.0}, {HERE: (LIKE, same)}
    first, *_ = gap_locations_by_smoother_evidence(seen)
    assert (first.location, first.indistinguishable_from) == ("here", ("there",))


TIME_STEP = 0.01


@pytest.fixture(scope="module")
def driven(urdf_folder) -> System:
    tree = read_urdf(str(urdf_folder / "double_pendulum.urdf"))
    return System.build(tree, driven=("shoulder", "elbow"), damping={"shoulder": 0.3, "elbow": 0.3})


def recorded(system: System, pushed: dict[int, tuple[float, float, float]], seed: int) -> Recording:
    """Points under a torque that is not in the recording: joint index to (torque, begin, end)."""
    step = compile_step(system, TIME_STEP)
    steps = 200
    t = TIME_STEP * np.arange(steps + 1)
    torque = np.zeros((steps, 2))
    torque[:, 0] = 1.5 * np.sin(2 * np.pi * 0.7 * t[:-1])
    extra = torque.copy()
    for joint, (size, begin, end) in pushed.items():
        extra[(t[:-1] >= begin) & (t[:-1] < end), joint] += size
    swept = simulate(step, system.parameters.vector(), np.zeros(step.sizes["nx"]), steps, extra)
    assert swept.status.is_converged
    known = list(system.mechanism.frames)[-2:]
    position = places(system, known, swept.state[:, :2])
    noise = np.random.default_rng(seed).standard_normal(position.shape)
    points = PointGroup("points", tuple(known), t, position + 1e-3 * noise, std=np.full(position.shape, 1e-3))
    effort = {"effort": np.vstack([torque, torque[-1:]]), "effort_std": 0.0, "effort_kind": "command"}
    return Recording(JointGroup(("shoulder", "elbow"), t, swept.state[:, :2], **effort), (points,), name="push")


def problem_of(system: System, recording: Recording, feedback: Literal["none", "lqr"] = "none") -> EstimationProblem:
    sensors = {"joints.position": SensorOptions(use=False)}
    options = ProblemOptions(initial_state="equilibrium", arm_tracking_feedback=feedback, sensors=sensors)
    return EstimationProblem(compile_step(system, TIME_STEP), [recording], ("shoulder.damping",), options)


def said_of(problem: EstimationProblem):
    """What the smoother says about the fit of a problem."""
    solution = fit_problem(problem, GaussNewton())
    return smooth_unknown_forces_and_biases(problem, np.array(solution.x), solution.evaluation)


def as_they_are(observed, by_state, by_unknown, transition, drive, typical):
    none = np.zeros((observed.shape[1], observed.shape[1]))
    return _IntervalModel(observed, by_state, by_unknown, transition, drive, none, len(observed))


def test_rows_that_are_left_out_change_nothing(driven, monkeypatch):
    problem = problem_of(driven, recorded(driven, {0: (0.3, 0.6, 1.0)}, 1))
    short = said_of(problem)
    monkeypatch.setattr(smoother_model, "_compressed", as_they_are)
    whole = said_of(problem)
    assert short.log_evidence == pytest.approx(whole.log_evidence, rel=1e-6)
    assert short.chi2_after == pytest.approx(whole.chi2_after, rel=1e-6)


@pytest.mark.parametrize("feedback", ["none", "lqr"])
def test_the_linear_model_predicts_what_a_small_push_does(driven, monkeypatch, feedback):
    """Whatever keeps the arm on its measured motion, whose momentum has the push in it."""
    monkeypatch.setattr(smoother_model, "_compressed", as_they_are)
    recording = recorded(driven, {}, 1)
    problem = problem_of(driven, recording, feedback)
    x = problem.initial_unknowns
    evaluation = problem.evaluate(x)
    model = smoother_model.residual_models_with_smoother_unknowns(problem, x, evaluation)[0]
    column = model.unknown_names.index("elbow")
    size = 1e-4 / model.reference_std[column]
    state, moved = np.zeros(len(model.initial_state_std)), []
    for j, interval in enumerate(model.intervals):
        unknown = np.zeros(len(model.unknown_names))
        unknown[column] = size if 5 <= j < 9 else 0.0
        moved.append(interval.state_jacobian @ state + interval.unknown_jacobian @ unknown)
        state = interval.state_transition @ state + interval.unknown_input_matrix @ unknown
    effort = recording.joints.effort.copy()
    effort[50:90, 1] += 1e-4
    changed = problem_of(driven, replace(recording, joints=replace(recording.joints, effort=effort)), feedback)
    difference = changed.evaluate(x, False).residual - evaluation.residual
    rows = np.concatenate(moved)
    # with one sensor the residual's order is that of time, interval after interval
    assert len(rows) == problem.residual_rows.data.stop
    difference = difference[: len(rows)]
    if feedback == "none":
        assert rows == pytest.approx(difference, rel=1e-3, abs=1e-4 * np.abs(difference).max())
    else:
        # a step late where the push begins and ends
        assert np.linalg.norm(rows - difference) < 0.03 * np.linalg.norm(difference)


def test_clean_data_have_no_place(driven):
    found = said_of(problem_of(driven, recorded(driven, {}, 2)))
    assert found.log_evidence["both"] == 0
    assert found.plant_or_sensor_origin == "none"
    assert all(place.gap_share == 0 for place in gap_locations_by_smoother_evidence(found))
    assert any(place.is_observable for place in gap_locations_by_smoother_evidence(found))


@pytest.mark.parametrize(("joint", "name", "push"), [(0, "shoulder", 0.3), (1, "elbow", 0.03)])
def test_a_push_is_found_where_and_when_it_was(driven, joint, name, push):
    found = said_of(problem_of(driven, recorded(driven, {joint: (push, 0.8, 1.3)}, 3)))
    places = gap_locations_by_smoother_evidence(found)
    assert places[0].location == name
    assert places[0].gap_share > 0.5
    assert found.log_evidence["plant"] > found.log_evidence["sensor"] + 10
    assert any(begin < 1.2 and end > 0.9 for begin, end in places[0].time_windows)
    trace = found.smoothed_unknowns[0]
    column = trace.unknown_names.index(name)
    middle = (trace.interval_edges[:-1] >= 0.9) & (trace.interval_edges[1:] <= 1.25)
    size = trace.reference_std[column] * trace.posterior_mean[middle, column]
    assert np.abs(size).mean() == pytest.approx(push, rel=0.35)
    trace = found.smoothed_unknowns[0]
    values = smoother.smoothed_unknown_z_scores(found, trace)
    assert values.shape == (len(trace.interval_edges) - 1, len(trace.unknown_names))
    assert np.isfinite(values[:, trace.unknown_names.index(name)]).any()


def test_a_sensor_that_reads_wrong_is_told_from_a_push(driven):
    recording = recorded(driven, {}, 4)
    group = recording.points[0]
    moved = group.position.copy()
    moved[80:130, 1] += [0.0, 0.02, 0.0]
    found = said_of(problem_of(driven, replace(recording, points=(replace(group, position=moved),))))
    assert found.plant_or_sensor_origin == "sensor"
    assert gap_locations_by_smoother_evidence(found)[0].location == "points"


def test_efforts_of_prescribed_joints_say_which(bench):
    found = said_of(bench.problem([bench.recording({"joint_coulomb@elbow": {"tau_c": 0.3}}, 1, duration=2.0)]))
    places = gap_locations_by_smoother_evidence(found)
    assert places[0].location == "elbow"
    assert places[0].gap_share > 0.8
    assert found.explainable_gap_fraction > 0.5
    assert found.plant_or_sensor_origin == "either", "a force at a measured joint and its sensor's bias are the same"


SYSTEM = baxter_foam_y_system(1)
THETA = np.array([parameter.value for parameter in SYSTEM.parameters])


def test_a_push_is_what_virtual_work_says_by_the_weight_of_its_segment():
    q = 0.3 * np.random.default_rng(3).standard_normal((2, SYSTEM.n_coordinates))
    found = smoother_model._generalized_forces_per_newton(SYSTEM, THETA, q, ("T1", "T3"))
    assert found.shape == (2, SYSTEM.n_coordinates, 6)
    symbol = ca.SX.sym("q", SYSTEM.n_coordinates)
    at = ca.vertcat(*(forward_kinematics(SYSTEM.mechanism, symbol).frame_position(f"{s}:75%") for s in ("T1", "T3")))
    place = ca.Function("place", [symbol, SYSTEM.parameters.symbols], [at])
    for k, row in enumerate(q):
        for i in range(SYSTEM.n_coordinates):
            step = np.zeros(SYSTEM.n_coordinates)
            step[i] = 1e-6
            moved = (np.array(place(row + step, THETA)) - np.array(place(row - step, THETA))).ravel() / 2e-6
            assert found[k, i] == pytest.approx(moved, abs=1e-8)
    found = smoother_model._segment_weights(SYSTEM, THETA)
    assert found == pytest.approx({"T1": 9.81 * 0.064, "T2": 9.81 * 0.015, "T3": 9.81 * 0.016})

"""What the smoother adds, against dense algebra over all disturbances and parameters at once."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import threadpoolctl

from yid_ocp.diagnosis.localise import localise_gap
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.inference import smoother
from yid_ocp.inference.smoother_model import LinearResidualModel, SmoothedUnknownGroup, _IntervalModel

FORCE, OTHER_FORCE, BIAS = (
    SmoothedUnknownGroup("T1", "force"),
    SmoothedUnknownGroup("T2", "force"),
    SmoothedUnknownGroup("camera", "bias"),
)
SOURCES = (FORCE, OTHER_FORCE, BIAS)
STATES, COUNT, ROWS, DECAY = 2, 8, 6, 0.7


@pytest.fixture(autouse=True)
def one_thread():
    """The matrices are small."""
    with threadpoolctl.threadpool_limits(1):
        yield


def made(seed: int, parameters=2, recording="run", size=None, loose=0.3) -> LinearResidualModel:
    """A linear model of three unknowns; with `size` its residual holds disturbances of these standard deviations."""
    rng = np.random.default_rng(seed)
    intervals = []
    for _ in range(COUNT):
        outside = rng.standard_normal((2, 1 + parameters))
        outside[:, 0] *= 0.0 if size is None else 1.0
        by_unknown = rng.standard_normal((ROWS, len(SOURCES)))
        intervals.append(
            _IntervalModel(
                rng.standard_normal((ROWS, 1 + parameters)),
                rng.standard_normal((ROWS, STATES)),
                by_unknown,
                0.5 * rng.standard_normal((STATES, STATES)),
                rng.standard_normal((STATES, len(SOURCES))),
                outside.T @ outside,
                ROWS + 2,
            )
        )
    at_rest = rng.standard_normal((STATES, len(SOURCES)))
    edges = 0.1 * np.arange(COUNT + 1)
    names = tuple(f"u{i}" for i in range(len(SOURCES)))
    model = LinearResidualModel(
        recording,
        tuple(intervals),
        edges,
        names,
        SOURCES,
        np.ones(3),
        at_rest,
        np.full(STATES, loose),
        DECAY,
        np.zeros(3),
    )
    if size is not None:
        design, _ = dense(model)
        scale = np.concatenate([model.initial_state_std, np.tile(size, COUNT)])
        signal = (design @ (scale * rng.standard_normal(len(scale)))).reshape(COUNT, ROWS)
        for interval, part in zip(intervals, signal, strict=True):
            interval.negative_residual_jacobian[:, 0] += part
    return model


def dense(model: LinearResidualModel) -> tuple[np.ndarray, np.ndarray]:
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
            by_source = np.array([variance[s] for s in model.unknown_groups])
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
    told = {}

    def linear_model(problem, x, evaluation, given):
        told["limits"] = given
        return tuple(models)

    monkeypatch.setattr(smoother, "linear_residual_models", linear_model)
    chosen = Thresholds(**limits)
    found = smoother.select_and_smooth_unknowns(SimpleNamespace(), np.zeros(0), None, chosen)
    assert told["limits"] == chosen
    return found


NOTHING = dict.fromkeys(SOURCES, 0.0)


def test_variances_so_large_that_rounding_shows_are_never_the_best():
    assert smoother._run([made(1, loose=1e12)], NOTHING).log_evidence == -math.inf


@pytest.mark.parametrize("column", [0, 1, 2])
def test_variances_go_to_the_largest_evidence(column):
    models = [made(3, size=np.eye(3)[column] * 2.0)]
    source = SOURCES[column]
    variance, state = smoother._refined(models, NOTHING | {source: 0.05})
    assert {s for s, v in variance.items() if v} == {source}
    grid = np.geomspace(0.05, 400, 60)
    best = max(Dense(models, NOTHING | {source: v}).log_evidence for v in grid)
    assert state.log_evidence == pytest.approx(best, abs=0.15)
    assert state.log_evidence == pytest.approx(Dense(models, variance).log_evidence, rel=1e-9)


def test_variances_stay_within_their_range():
    variance, _ = smoother._refined([made(3, size=np.zeros(3))], NOTHING | {FORCE: 1e-6})
    assert variance[FORCE] >= 1e-6
    exploding, _ = smoother._refined([made(3, size=np.full(3, 1e9))], NOTHING | {FORCE: 1e6})
    assert exploding[FORCE] <= 1e7


def test_the_best_variance_of_a_group_is_searched_over_all_sizes():
    models = [made(3, size=np.array([30.0, 0.0, 0.0])), made(4, size=np.array([20.0, 0.0, 0.0]))]
    [(evidence, size)] = smoother._largest_evidences(models, NOTHING, [FORCE])
    assert evidence == pytest.approx(Dense(models, NOTHING | {FORCE: size}).log_evidence, rel=1e-9)
    assert evidence > Dense(models, NOTHING | {FORCE: 4 * size}).log_evidence
    assert evidence > Dense(models, NOTHING | {FORCE: size / 4}).log_evidence
    base = NOTHING | {OTHER_FORCE: 1.0}
    [(more, at)] = smoother._largest_evidences(models, base, [FORCE])
    assert more == pytest.approx(Dense(models, base | {FORCE: at}).log_evidence, rel=1e-9)
    # a group may hold several unknowns, and some of them errors that are known
    both = [
        replace(model, unknown_groups=(FORCE, FORCE, BIAS), torque_noise_variance=np.array([0.0, 0.4, 0.0]))
        for model in models
    ]
    some = {FORCE: 0.0, BIAS: 0.3}
    [(most, here)] = smoother._largest_evidences(both, some, [FORCE])
    assert most == pytest.approx(smoother._run(both, some | {FORCE: here}).log_evidence, rel=1e-9)
    assert most > smoother._run(both, some).log_evidence + 1


@pytest.mark.parametrize("column", [0, 1, 2])
def test_the_group_that_explains_the_residual_is_taken_in(monkeypatch, column):
    size = np.zeros(3)
    size[column] = 3.0
    models = [made(5, size=size), made(6, size=size, recording="second")]
    found = smoothed(monkeypatch, models)
    source = SOURCES[column]
    at_work = {s: v for s, v in found.group_variance.items() if v}
    assert set(at_work) == {source}
    reference, nothing = Dense(models, found.group_variance), Dense(models, NOTHING)
    own, other = ("sensor", "plant") if source is BIAS else ("plant", "sensor")
    assert (
        found.log_evidence[own]
        == found.log_evidence["both"]
        == pytest.approx(reference.log_evidence - nothing.log_evidence)
    )
    assert found.log_evidence[own] > found.log_evidence[other] + 5
    assert found.log_evidence["none"] == 0.0
    assert found.log_evidence_drop == NOTHING | {source: pytest.approx(reference.log_evidence - nothing.log_evidence)}
    assert found.gap_origin == own
    assert found.min_log_bayes_factor == 5.0


def test_several_groups_are_taken_in_while_the_evidence_rises_enough(monkeypatch):
    models = [made(7, size=np.array([3.0, 3.0, 3.0])), made(8, size=np.array([3.0, 3.0, 3.0]))]
    found = smoothed(monkeypatch, models)
    assert all(v > 0 for v in found.group_variance.values())
    full = Dense(models, found.group_variance).log_evidence
    for source in SOURCES:
        less = Dense(models, found.group_variance | {source: 0.0}).log_evidence
        assert found.log_evidence_drop[source] == pytest.approx(full - less, rel=1e-6)
    assert found.gap_origin == "both"
    assert sum(v > 0 for v in smoothed(monkeypatch, models, max_unknown_groups=2).group_variance.values()) == 2
    assert not any(smoothed(monkeypatch, models, min_log_bayes_factor=1e6).group_variance.values())


def test_noise_alone_takes_nothing_in(monkeypatch):
    models = [made(9, size=np.zeros(3), loose=0.0)]
    found = smoothed(monkeypatch, models)
    assert found.gap_origin == "none"
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
        assert (trace.interval_edges.tolist(), trace.unknown_names) == (
            models[i].interval_edges.tolist(),
            ("u0", "u1", "u2"),
        )


def test_what_would_be_noticed_comes_from_the_model_alone(monkeypatch):
    models = [made(5, size=np.array([3.0, 0.0, 0.0]))]
    found = smoothed(monkeypatch, models)
    reference = Dense(models, NOTHING)
    for column, source in enumerate(SOURCES):
        expected = math.sqrt(10.0 / reference.scores(0, column)[1])
        assert found.detectable_std[source] == pytest.approx(expected, rel=1e-8)
    more = smoothed(monkeypatch, models, detectable_chi2=40.0)
    assert more.detectable_std == {s: pytest.approx(2 * v) for s, v in found.detectable_std.items()}


@pytest.mark.parametrize("unknown", [0, 2])
def test_what_is_said_of_one_unknowns_history_is_that_of_dense_algebra(unknown):
    model = made(5)
    variance = dict(zip(SOURCES, (0.8, 0.0, 2.5), strict=True))
    reference = Dense([model], variance)
    state, rows = np.zeros((STATES, COUNT)), []
    for j, interval in enumerate(model.intervals):
        now = np.eye(COUNT)[j]
        rows.append(interval.state_jacobian @ state + np.outer(interval.unknown_jacobian[:, unknown], now))
        state = interval.state_transition @ state + np.outer(interval.unknown_input_matrix[:, unknown], now)
    response = np.vstack([*rows, np.zeros((len(reference.y) - COUNT * ROWS, COUNT))])
    score, information = smoother.force_log_likelihood_coefficients(model, variance, unknown)
    assert score == pytest.approx(response.T @ reference.inverse @ reference.y, rel=1e-7, abs=1e-9)
    assert information == pytest.approx(response.T @ reference.inverse @ response, rel=1e-7, abs=1e-9)


HERE, LIKE, OTHER = (
    SmoothedUnknownGroup("here", "force"),
    SmoothedUnknownGroup("there", "push"),
    SmoothedUnknownGroup("elsewhere", "force"),
)


def test_a_place_that_does_as_well_is_told():
    """Two unknowns at two places do the same, a third something else, and the first one is at work."""
    model, intervals, rng = made(2), [], np.random.default_rng(0)
    for one in model.intervals:
        by, drive = one.unknown_jacobian.copy(), one.unknown_input_matrix.copy()
        by[:, 1] = by[:, 0] + 0.02 * rng.standard_normal(len(by))
        drive[:, 1] = drive[:, 0]
        observed = 0.1 * one.negative_residual_jacobian
        observed[:, 0] += 8.0 * by[:, 0]
        changed = {"negative_residual_jacobian": observed, "unknown_jacobian": by, "unknown_input_matrix": drive}
        intervals.append(replace(one, **changed))
    twice = replace(model, intervals=tuple(intervals), unknown_groups=(HERE, LIKE, OTHER))
    variance = {HERE: 50.0, LIKE: 0.0, OTHER: 0.0}
    state = smoother._run([twice], variance)
    drop, found = smoother._alternatives([twice], variance, state, Thresholds())
    assert drop[HERE] > 100
    assert found == {HERE: (LIKE,)}
    strict, better = Thresholds(location_tie=1.0, min_log_bayes_factor=1e-9), replace(state, log_evidence=1e6)
    assert LIKE not in smoother._alternatives([twice], variance, better, strict)[1][HERE]


def test_it_is_named_beside_the_place_but_its_own_other_unknowns_are_not():
    same = SmoothedUnknownGroup("here", "push")
    seen = SimpleNamespace(
        log_evidence_drop={HERE: 9.0, LIKE: 0.0, same: 0.0},
        detectable_std=dict.fromkeys((HERE, LIKE, same), 0.5),
        group_variance={HERE: 1.0, LIKE: 0.0, same: 0.0},
        smoothed_unknowns=(),
        alternative_groups={HERE: (LIKE, same)},
    )
    first, *_ = localise_gap(seen)
    assert (first.location, first.indistinguishable_from) == ("here", ("there",))

"""A weak-constraint smoother that finds the unknown forces, grasp offsets and sensor biases behind a residual.

The unknowns of `smoother_model` change from interval to interval by

    d_{j+1} = a d_j + sqrt(1 - a^2) s eta_j,

where a follows from the time constant `_CORRELATION_TIME`. This equals the penalty |d|^2_Q + gamma |d_{j+1} - d_j|^2 of
a weak constraint, with Q and gamma given by a standard deviation s and a memory. A Kalman filter and disturbance
smoother make the cost linear in the number of intervals (de Jong 1989, doi:10.2307/2290075). Free parameters are
regression effects of the filter: the unknowns only explain what the parameters cannot. Groups of unknowns (forces of a
segment or a joint, biases of a camera, ...) are added one after another, the one that raises the evidence most first.
Their standard deviations s maximise the evidence (MacKay 1992, doi:10.1162/neco.1992.4.3.415).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize
import threadpoolctl

from yid_ocp.arrays import Array, BoolArray, IntArray
from yid_ocp.display import grouped
from yid_ocp.inference.kalman import KalmanStepMatrices, StateTransition, kalman_covariance_step
from yid_ocp.inference.smoother_model import (
    ResidualStateSpaceModel,
    SmoothedUnknownGroup,
    residual_models_with_smoother_unknowns,
)
from yid_ocp.inference.whitening import problem_with_sensor_noise_only
from yid_ocp.model.system import System
from yid_ocp.parallel import map_in_threads
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.problem.measurements import measurements_minus_sensor_error_estimates

_Models = Sequence[ResidualStateSpaceModel]
_Groups = Sequence[SmoothedUnknownGroup]
_Variances = dict[SmoothedUnknownGroup, float]  # [squared reference]

DEFAULT_MIN_LOG_BAYES_FACTOR = 5.0  # rise of the log evidence that selects a group: odds of 150 to 1
SIGNIFICANT_Z = 3.0  # standard deviations from zero beyond which an unknown is significant
_INFORMED_FRACTION = 0.5  # of the prior variance that the data remove, above which they inform an unknown
_DETECTABLE_CHI2_RISE = 10.0  # rise of r'r that shows an unknown
_MIN_TIED_EVIDENCE_RATIO = 0.9  # share of a location's evidence at which an alternative is named
_MAX_GROUPS = 4  # selected at most
_MAX_STD_ITERATIONS = 12  # fixed-point iterations on the standard deviations
_MIN_EVIDENCE_GAIN = 0.2  # of an iteration, else it is the last one; groups differ significantly by 5 or more
_MIN_EVIDENCE_GAIN_FRACTION = 1e-3  # likewise, of the gain by the group that was added last
_VARIANCE_BOUNDS = (1e-6, 1e7)  # range of the variances, in units of the squared reference
_LATER_GROUP_TRIALS = 6  # groups tried after the first round, the most promising ones by their scores


@dataclass(frozen=True)
class SmoothedDisturbances:
    """The smoothed forces, offsets and biases of one recording, with mean and standard deviation in each interval."""

    recording: str
    interval_edges: Array  # shape (J + 1,) [s]
    unknown_names: tuple[str, ...]
    unknown_groups: tuple[SmoothedUnknownGroup, ...]
    reference_std: Array  # shape (nd,) [N m, N or m]
    posterior_mean: Array  # in units of the reference, shape (J, nd)
    posterior_std: Array  # in units of the reference, shape (J, nd)


@dataclass(frozen=True)
class SmoothedUnknownsResult:
    """The result of the weak-constraint smoother: smoothed unknowns, and the log evidence that each group adds."""

    smoothed_unknowns: tuple[SmoothedDisturbances, ...]
    group_variance: dict[SmoothedUnknownGroup, float]  # variance at the largest evidence [squared reference]
    log_evidence_drop: dict[SmoothedUnknownGroup, float]  # how much lower the log evidence is without the group
    detectable_std: dict[SmoothedUnknownGroup, float]  # smallest detectable size by the model alone [reference]
    chi2_before: float  # r'r after a refit of the free parameters, without (`after`: with) the unknowns
    chi2_after: float
    dof_before: float  # measurements minus the degrees of freedom of parameters (and unknowns)
    dof_after: float
    # log evidence with forces and offsets ("plant"), biases ("sensor") or "both", minus that with neither ("none")
    log_evidence: dict[str, float]
    min_log_bayes_factor: float = DEFAULT_MIN_LOG_BAYES_FACTOR  # smallest significant rise of the log evidence
    # groups that could replace each selected group almost as well
    alternative_groups: Mapping[SmoothedUnknownGroup, tuple[SmoothedUnknownGroup, ...]] = field(default_factory=dict)

    @property
    def explainable_gap_fraction(self) -> float:
        """The fraction of the gap that the smoothed unknowns can explain. The gap is G = max(0, chi2/n - 1)."""
        gap = self.chi2_before / self.dof_before - 1
        return float(np.clip(1 - max(self.chi2_after / self.dof_after - 1, 0.0) / gap, 0.0, 1.0)) if gap > 0 else 0.0

    @property
    def plant_or_sensor_origin(self) -> str:
        """The origin of the gap: "none", "plant", "sensor", "both", or "either" if the data cannot distinguish them."""
        if max(self.log_evidence.values()) <= 0:
            return "none"
        if max(self.log_evidence_drop, key=lambda source: self.log_evidence_drop[source]).is_confounded_with_bias:
            return "either"
        # both must exceed either alone by more than chance
        alone = max(("plant", "sensor"), key=lambda name: self.log_evidence[name])
        return "both" if self.log_evidence["both"] - self.log_evidence[alone] > self.min_log_bayes_factor else alone


class _Update(NamedTuple):
    """One interval of the filter, kept for the backward pass."""

    step: KalmanStepMatrices
    mean: Array  # prediction of the `used` unknowns, shape (used, 1 + ntheta)
    covariance: Array  # with states and used unknowns, shape (used, ns + used)
    white: Array  # innovations


@dataclass(frozen=True)
class _Filtered:
    """Filter of one recording at given variances, for states and unknowns of nonzero variance, which are `used`."""

    model: ResidualStateSpaceModel
    used: IntArray
    products: Array  # V' S^-1 V, shape (1 + ntheta, 1 + ntheta)
    log_determinant: float  # infinite if large variances make the filter ill-conditioned
    updates: Sequence[_Update]  # empty if the filter is ill-conditioned


class _Smoothed(NamedTuple):
    """Disturbance smoother over one recording, for disturbances of unit variance before scaling."""

    score: Array  # scores of the disturbances, shape (J, nd, 1 + ntheta)
    information: Array  # variances of the disturbances, shape (J, nd)
    mean: Array  # smoothed unknowns, shape (J, nd, 1 + ntheta)
    covariance: Array  # their variances, shape (J, nd)
    left: tuple[Array, ...]  # smoothed residuals


def _forwards(model: ResidualStateSpaceModel, variance: Array) -> _Filtered:
    """Filter one recording with given variances of the unknowns, shape (nd,)."""
    variance = variance[used := np.flatnonzero(variance > 0)]
    ns, nd = len(model.initial_state_std), len(used)
    size, columns = ns + nd, model.intervals[0].negative_residual_jacobian.shape[1]
    fresh = np.zeros((size, size))
    fresh[ns:, ns:] = (1 - model.interval_correlation**2) * np.diag(variance)
    begin = np.vstack([model.initial_state_jacobian[:, used], np.eye(nd)])
    p = (begin * variance) @ begin.T
    p[np.arange(ns), np.arange(ns)] += model.initial_state_std**2
    mean = np.zeros((size, columns))
    products, log_determinant, updates = np.zeros((columns, columns)), 0.0, []
    for interval in model.intervals:
        design = np.hstack([interval.state_jacobian, interval.unknown_jacobian[:, used]])
        products += interval.unreachable_products
        move = np.hstack([interval.state_transition, interval.unknown_input_matrix[:, used]])
        transition = StateTransition(move, np.full(nd, model.interval_correlation))
        step, later, own = kalman_covariance_step(p, design, transition)
        if math.isinf(own):
            return _Filtered(model, used, products, math.inf, ())
        white, after = step.normalized_innovations_and_next_mean(mean, interval.negative_residual_jacobian)
        products += white.T @ white
        log_determinant += own
        updates.append(_Update(step, mean[ns:].copy(), p[ns:].copy(), white))
        mean, p = after, later + fresh
        p = (p + p.T) / 2
    return _Filtered(model, used, products, log_determinant, updates)


def _backwards(done: _Filtered) -> _Smoothed:
    """Smoother from a filter that is not ill-conditioned."""
    model, used, updates = done.model, done.used, done.updates
    rho, start = model.interval_correlation, model.initial_state_jacobian
    (ns, nd), columns, size = start.shape, updates[0].white.shape[1], updates[0].covariance.shape[1]
    count, gain, left = len(updates), math.sqrt(1 - rho**2), list[Array]()
    score, smoothed = np.zeros((2, count, nd, columns))
    information, covariance = np.zeros((2, count, nd))
    r, n = np.zeros((size, columns)), np.zeros((size, size))
    # costates of all unknowns: their values, covariance with those of states and used unknowns, and variance
    own, cross, variance = np.zeros((nd, columns)), np.zeros((nd, size)), np.zeros(nd)
    for j in reversed(range(count)):
        step, mean, own_covariance, white = updates[j]
        seen, drive = step.whitening @ model.intervals[j].unknown_jacobian, model.intervals[j].unknown_input_matrix
        if j + 1 < count:
            score[j + 1], information[j + 1] = gain * own, gain**2 * variance
        own = drive.T @ r[:ns] + rho * own
        noise, r = step.smoothed_measurement_noise_and_costate(white, r)
        own += model.intervals[j].unknown_jacobian.T @ noise
        left.append(noise)
        pulled = drive.T @ n[:ns] + rho * cross
        variance = np.sum((pulled[:, :ns] + rho * cross[:, :ns]) * drive.T, axis=1) + rho**2 * variance
        n, cross, added = step.costate_covariances_before(n, pulled, seen)
        variance = variance + added
        smoothed[j, used] = mean + own_covariance @ r
        covariance[j, used] = np.diag(own_covariance[:, ns:]) - np.sum((own_covariance @ n) * own_covariance, axis=1)
    score[0] = start.T @ r[:ns] + own
    information[0] = np.sum((start.T @ n[:ns, :ns] + 2 * cross[:, :ns]) * start.T, axis=1) + variance
    return _Smoothed(score, information, smoothed, covariance, tuple(reversed(left)))


@dataclass(frozen=True)
class _State:
    """Result for all recordings at given variances: also `shift` of the scaled free parameters, covariance `spread`."""

    models: _Models
    variance: _Variances
    recordings: tuple[_Smoothed, ...]  # without those whose filter is ill-conditioned; empty if no longer needed
    shift: Array
    spread: Array
    log_evidence: float
    # for every group, |score|^2 of its unknowns and the expectation of this number (also for variance zero)
    scores: dict[SmoothedUnknownGroup, tuple[float, float]]
    # largest log evidence with one more group, and the group's variance
    larger: dict[SmoothedUnknownGroup, tuple[float, float]] = field(default_factory=dict)
    # result of `_refined` with one more group
    refined: dict[SmoothedUnknownGroup, _State] = field(default_factory=dict)

    def largest_evidences(self, sources: _Groups) -> list[tuple[float, float]]:
        """Result of `_largest_evidence` for each of several groups, added alone to the groups of these variances."""
        if new := [source for source in sources if source not in self.larger]:
            bases, parts = zip(*map_in_threads(partial(_responses, self.variance, new), self.models), strict=True)
            reached = [(-math.inf, _VARIANCE_BOUNDS[0])] * len(new)
            if all(math.isfinite(base.log_determinant) for base in bases):
                reached = map_in_threads(partial(_largest_evidence, bases), zip(*parts, strict=True))
            self.larger.update(zip(new, reached, strict=True))
        return [self.larger[source] for source in sources]


def _filtered(variance: Mapping[SmoothedUnknownGroup, float], model: ResidualStateSpaceModel) -> _Filtered:
    return _forwards(model, np.array([variance[group] for group in model.unknown_groups]) + model.torque_noise_variance)


def _run(models: _Models, variance: _Variances) -> _State:
    """Filter and smooth all recordings at given variances. The filters are too large to be kept."""

    def smoothed(model: ResidualStateSpaceModel) -> tuple[_Filtered, list[_Smoothed]]:
        done = _filtered(variance, model)
        return replace(done, updates=()), [_backwards(done)] if done.updates else []

    filtered, recordings = zip(*map_in_threads(smoothed, models), strict=True)
    products = np.sum([done.products for done in filtered], axis=0)
    evidence, shift, information = _judged(products, sum(done.log_determinant for done in filtered))
    spread = scipy.linalg.cho_solve(information, np.eye(len(shift)))
    known = tuple(itertools.chain(*recordings))
    scores = _scores(models, known, shift, spread) if len(known) == len(models) else {}
    return _State(models, variance, known, shift, spread, evidence, scores)


def _judged(products: Array, log_determinant: float) -> tuple[float, Array, tuple[Array, bool]]:
    """Log evidence, the parameters' step, and the Cholesky factor of its information, from sums over recordings."""
    # a parameter may move by several times its size: the prior only fixes unobserved ones, beyond rounding errors
    precision = np.maximum(1.0 / 9.0, 1e-13 * np.diag(products)[1:])
    factor, failed = scipy.linalg.lapack.dpotrf(products[1:, 1:] + np.diag(precision), lower=1)
    if failed:  # rounding
        return -math.inf, np.zeros(len(precision)), (np.eye(len(precision)), True)
    shift = scipy.linalg.cho_solve((factor, True), products[1:, 0])
    quadratic = float(products[0, 0] - products[0, 1:] @ shift)
    determinant = 2 * float(np.sum(np.log(np.diag(factor)))) + len(shift) * math.log(9.0)
    return -0.5 * (quadratic + log_determinant + determinant), shift, (factor, True)


def _scores(
    models: _Models, recordings: Sequence[_Smoothed], shift: Array, spread: Array
) -> dict[SmoothedUnknownGroup, tuple[float, float]]:
    found: dict[SmoothedUnknownGroup, tuple[float, float]] = {}
    for model, done in zip(models, recordings, strict=True):
        by_theta = done.score[:, :, 1:]
        score = done.score[:, :, 0] - by_theta @ shift
        information = np.maximum(done.information - np.sum((by_theta @ spread) * by_theta, axis=2), 0.0)
        for source, up, down in zip(model.unknown_groups, np.sum(score**2, 0), np.sum(information, 0), strict=True):
            before = found.get(source, (0.0, 0.0))
            found[source] = before[0] + float(up), before[1] + float(down)
    return found


def _refined(models: _Models, variance: _Variances, before: float) -> _State:
    """Result at the largest evidence, by MacKay's fixed point: s^2 <- s^2 |score|^2 / its expectation.

    `before` is the log evidence without the group that was added last.
    """
    state = _run(models, variance)
    for _ in range(_MAX_STD_ITERATIONS if math.isfinite(state.log_evidence) else 0):
        ratio = {s: np.clip(up / max(down, 1e-300), 0.05, 20.0) for s, (up, down) in state.scores.items()}
        trial = {s: float(np.clip(v * ratio[s], *_VARIANCE_BOUNDS)) if v else 0.0 for s, v in state.variance.items()}
        after = _run(models, trial)
        gained = after.log_evidence - state.log_evidence
        state = after if gained > 0 else state
        if not gained > max(_MIN_EVIDENCE_GAIN, _MIN_EVIDENCE_GAIN_FRACTION * (state.log_evidence - before)):
            break
    return replace(state, recordings=())


def _selected(models: _Models, sources: _Groups, state: _State, least: float) -> _State:
    """Repeatedly add the group that raises the log evidence most, by more than `least`."""
    while sum(v > 0 for v in state.variance.values()) < _MAX_GROUPS:
        found = state.scores
        promising = [s for s in sources if not state.variance[s] and found[s][0] > found[s][1]]
        promising.sort(key=lambda s: -found[s][0] / max(found[s][1], 1e-300))
        if any(state.variance.values()):
            promising = promising[:_LATER_GROUP_TRIALS]
        if not promising:
            break
        reached = zip(state.largest_evidences(promising), promising, strict=True)
        (evidence, size), source = max(reached, key=lambda pair: pair[0][0])
        if not evidence > state.log_evidence + least:
            break
        if source not in state.refined:
            state.refined[source] = _refined(models, state.variance | {source: size}, state.log_evidence)
        if math.isinf(state.refined[source].log_evidence):
            break
        state = state.refined[source]
    return state


def _response_products(base: _Filtered, chosen: IntArray, correlation: float) -> tuple[Array, Array]:
    """Products W'W (J u, J u) and W'V (J u, 1 + ntheta), where V are the filter's innovations.

    W are innovations caused by disturbances of unit variance of the u `chosen` unknowns in each of the J intervals.
    """
    model, updates = base.model, base.updates
    ns, count, u = len(model.initial_state_std), len(updates), len(chosen)
    # state error that the filter has not yet followed, by the interval of the disturbance, and the disturbed unknown
    behind, unknown = np.zeros((updates[0].covariance.shape[1], count * u)), np.zeros((count, 1))
    if correlation:  # the first disturbance acted before the start
        behind[:ns, :u] = model.initial_state_jacobian[:, chosen]
    information, pull = np.zeros((count * u, count * u)), np.zeros((count * u, len(base.products)))
    for k, (interval, (step, _, _, white)) in enumerate(zip(model.intervals, updates, strict=True)):
        unknown[:k] *= correlation
        unknown[k] = math.sqrt(1 - correlation**2) if k else 1.0
        # later disturbances do not act yet
        begun, known = unknown[: k + 1], (k + 1) * u
        left, (shaped, closed) = behind[:, :known], step.closed_loop
        seen = step.whitening @ interval.unknown_jacobian[:, chosen]
        pushed = -step.transition.propagate_state(step.projected_covariance.T @ seen)
        pushed[:ns] += interval.unknown_input_matrix[:, chosen]
        rows = shaped @ left + (seen[:, None] * begun).reshape(len(seen), known)
        left[:] = closed @ left + (pushed[:, None] * begun).reshape(left.shape)
        information[:known, :known] += rows.T @ rows
        pull[:known] += rows.T @ white
    return information, pull


def _responses(
    variance: _Variances, sources: _Groups, model: ResidualStateSpaceModel
) -> tuple[_Filtered, list[tuple[Array, Array]]]:
    """Filter of one recording, without its updates, which are too large to be kept, and products for each group."""
    base, found = _filtered(variance, model), []
    for source in sources if base.updates else ():
        chosen = np.flatnonzero([own == source for own in model.unknown_groups])
        found.append(_response_products(base, chosen, model.interval_correlation))
    return replace(base, updates=()), found


def _largest_evidence(bases: Sequence[_Filtered], parts: Sequence[tuple[Array, Array]]) -> tuple[float, float]:
    """Largest log evidence over the variance s^2 of one additional group, and this variance.

    With W the innovations caused by the group, those of the base have the covariance I + s^2 W W' (Woodbury identity).
    `parts` are W'W and W'V of every recording.
    """
    products, log_determinant = np.sum([b.products for b in bases], axis=0), sum(b.log_determinant for b in bases)

    def cost(exponent: float) -> float:
        variance, left, determinant = 10.0**exponent, products, log_determinant
        for information, pull in parts:
            inner = variance * information
            inner[np.diag_indices_from(inner)] += 1.0
            factor, failed = scipy.linalg.lapack.dpotrf(inner.T, lower=1, overwrite_a=1)
            if failed:  # rounding
                return math.inf
            seen = scipy.linalg.lapack.dtrtrs(factor, pull, lower=1)[0]
            left = left - variance * seen.T @ seen
            determinant += 2 * float(np.sum(np.log(np.diag(factor))))
        return -_judged(left, determinant)[0]

    low, high = np.log10(_VARIANCE_BOUNDS)
    outcome = scipy.optimize.minimize_scalar(cost, bounds=(low, high), method="bounded", options={"xatol": 0.4})
    return -float(outcome.fun), 10.0 ** float(outcome.x)


def smooth_unknown_forces_and_biases(
    problem: EstimationProblem, x: Array, evaluation: Evaluation, least: float = DEFAULT_MIN_LOG_BAYES_FACTOR
) -> SmoothedUnknownsResult:
    """Select and estimate unknown forces, offsets and biases that raise the log evidence at `x` by more than `least`.

    Torque noise is part of the unknown forces, and constant sensor errors are removed first.
    """
    if problem.has_process_noise:
        problem = problem_with_sensor_noise_only(problem)
        evaluation = problem.evaluate(x, equilibrium_guesses=evaluation.equilibrium_guesses)
    if any(episode.has_biases_treated_as_noise for episode in problem.episodes):
        pairs = zip(problem.episodes, evaluation.episode_predictions, strict=True)
        less = ((e, measurements_minus_sensor_error_estimates(e.measurements, p.predicted_outputs)) for e, p in pairs)
        problem = problem.with_episodes([replace(e, measurements=own) for e, own in less], ())
        evaluation = problem.evaluate(x, equilibrium_guesses=evaluation.equilibrium_guesses)
    # matrices of this size are multiplied faster by one thread
    with threadpoolctl.threadpool_limits(1):
        models = residual_models_with_smoother_unknowns(problem, x, evaluation)
        sources = tuple(dict.fromkeys(source for model in models for source in model.unknown_groups))
        nothing = _run(models, dict.fromkeys(sources, 0.0))
        sides = {"both": sources, "plant": tuple(s for s in sources if s.kind != "bias")}
        sides["sensor"] = tuple(s for s in sources if s.kind == "bias")
        found: dict[str, _State] = {}
        for side, own in sides.items():
            done = [state for state in found.values() if {s for s, v in state.variance.items() if v} <= set(own)]
            found[side] = done[0] if done else _selected(models, own, nothing, least)
        gain = {side: state.log_evidence - nothing.log_evidence for side, state in found.items()}
        # a greedy choice among all groups may be worse than a choice among fewer; filters are too large to keep all
        variance = max(found.values(), key=lambda state: state.log_evidence).variance
        state = _run(models, variance) if any(variance.values()) else nothing
        before, after, taken, samples = _explained(models, variance, nothing, state)
        degrees = max(float(samples) - len(nothing.shift), 1.0)
        drop, alternatives = _alternatives(models, variance, nothing, state, least)
        traces = tuple(_trace(model, done, state) for model, done in zip(models, state.recordings, strict=True))
        # the variance of a group's scores is the mean rise of r'r by unknowns of the reference size
        detectable = {s: math.sqrt(_DETECTABLE_CHI2_RISE / max(v, 1e-300)) for s, (_, v) in nothing.scores.items()}
        explained, evidence = (before, after, degrees, max(degrees - taken, 1.0)), {"none": 0.0} | gain
        return SmoothedUnknownsResult(traces, variance, drop, detectable, *explained, evidence, least, alternatives)


def force_log_likelihood_coefficients(
    model: ResidualStateSpaceModel, variance: Mapping[SmoothedUnknownGroup, float], unknowns: Sequence[int]
) -> list[tuple[Array, Array]]:
    """Return g (J,) and L (J, J) in the log likelihood g'f - f'L f / 2 of unknowns with values f (J,) in J intervals.

    `unknowns` are indices. f is in units of the unknown's reference, `variance` of the groups in its square. Free
    parameters, states and other unknowns are integrated out. The list is empty if the filter is ill-conditioned.
    """
    done = _filtered(variance, model)
    if not done.updates:
        return []
    free, found, u = done.products[1:, 1:] + np.eye(len(done.products) - 1) / 9.0, [], len(unknowns)
    products, pull = _response_products(done, np.array(unknowns, int), 0.0)
    for i in range(u):
        own = pull[i::u]
        weighed = np.linalg.solve(free, np.column_stack([done.products[1:, 0], own[:, 1:].T]))
        found.append((own[:, 0] - own[:, 1:] @ weighed[:, 0], products[i::u, i::u] - own[:, 1:] @ weighed[:, 1:]))
    return found


def _trace(model: ResidualStateSpaceModel, done: _Smoothed, state: _State) -> SmoothedDisturbances:
    """The unknowns of one recording. Their standard deviations include the uncertainty of the free parameters."""
    smoothed, by_theta = done.mean[:, :, 0] - done.mean[:, :, 1:] @ state.shift, done.mean[:, :, 1:]
    spread = np.sqrt(np.maximum(done.covariance + np.sum((by_theta @ state.spread) * by_theta, axis=2), 0.0))
    named = model.unknown_names, model.unknown_groups, model.reference_std
    return SmoothedDisturbances(model.recording, model.interval_edges, *named, smoothed, spread)


def _explained(models: _Models, variance: _Variances, plain: _State, state: _State) -> tuple[float, float, float, int]:
    """r'r without and with the unknowns, degrees of freedom of the unknowns, and the number of samples."""
    before = after = taken = 0.0
    bare, full = np.append(1.0, -plain.shift), np.append(1.0, -state.shift)
    for model, done in zip(models, state.recordings, strict=True):
        own = np.array([variance[s] for s in model.unknown_groups])
        taken += float(np.sum((own * done.information)[:, own > 0]))
        for interval, smoothed in zip(model.intervals, done.left, strict=True):
            first, left = interval.negative_residual_jacobian @ bare, smoothed @ full
            before += float(first @ first + bare @ interval.unreachable_products @ bare)
            after += float(left @ left + full @ interval.unreachable_products @ full)
    return before, after, taken, sum(interval.sample_count for model in models for interval in model.intervals)


def _alternatives(
    models: _Models, variance: _Variances, nothing: _State, state: _State, least: float
) -> tuple[_Variances, dict[SmoothedUnknownGroup, tuple[SmoothedUnknownGroup, ...]]]:
    """Fall of the log evidence without each selected group, and groups that could replace it. `nothing` has none."""
    drop, found = dict.fromkeys(variance, 0.0), {}
    for source in [s for s, v in variance.items() if v]:
        less = variance | {source: 0.0}
        without = _run(models, less) if any(less.values()) else nothing
        drop[source] = max(state.log_evidence - without.log_evidence, 0.0)
        scores = without.scores
        # the score at zero variance is a poor predictor here: all groups are tried
        asked = [s for s, v in variance.items() if not v and scores[s][0] > scores[s][1]]
        loss = max(least, (1 - _MIN_TIED_EVIDENCE_RATIO) * drop[source])
        reached = zip(asked, without.largest_evidences(asked), strict=True)
        found[source] = tuple(other for other, (reach, _) in reached if reach >= state.log_evidence - loss)
    return drop, found


@dataclass(frozen=True)
class GapLocation:
    """A location of the gap in the model or a sensor, with its share of the gap, observability and time windows."""

    location: str
    gap_share: float  # share of the locatable gap; all shares sum to one
    is_observable: bool  # whether the data would reveal a gap at this location
    time_windows: tuple[tuple[float, float], ...]  # times of the gap in any recording [s]
    indistinguishable_from: tuple[str, ...] = ()  # locations that the data cannot distinguish from this one


def _by_share(places: Iterable[GapLocation]) -> tuple[GapLocation, ...]:
    return tuple(sorted(places, key=lambda place: (-place.gap_share, not place.is_observable)))


def gap_locations_by_smoother_evidence(smoothed: SmoothedUnknownsResult) -> tuple[GapLocation, ...]:
    """Return all locations in order of their share of the log evidence. At equal shares, observable ones come first.

    In the time windows of a location, one of its unknowns is more than three standard deviations from zero.
    """
    groups = grouped((source.location, source) for source in smoothed.log_evidence_drop)
    drop = smoothed.log_evidence_drop
    weight = {location: sum(drop[s] for s in own) for location, own in groups.items()}
    total, found = sum(weight.values()), []
    for location, own in groups.items():
        share = weight[location] / total if total > 0 else 0.0
        seen = any(smoothed.detectable_std[s] < 1.0 or drop[s] > 0 for s in own)
        when = _windows(smoothed, [s for s in own if smoothed.group_variance[s]])
        # locations that could replace every selected group of this location
        also = [{e.location for e in smoothed.alternative_groups[s]} for s in own if s in smoothed.alternative_groups]
        others = tuple(sorted(set.intersection(*also) - {location})) if also else ()
        found.append(GapLocation(location, share, seen, when, others))
    return _by_share(found)


def smoothed_unknown_significance_mask(trace: SmoothedDisturbances, columns: Sequence[int]) -> BoolArray:
    """Return a mask (J, len(columns)): which unknowns are more than `SIGNIFICANT_Z` standard deviations from zero."""
    std = np.maximum(trace.posterior_std[:, columns], 1e-12)
    return np.asarray(np.abs(trace.posterior_mean[:, columns]) > SIGNIFICANT_Z * std)


def _windows(smoothed: SmoothedUnknownsResult, sources: _Groups) -> tuple[tuple[float, float], ...]:
    spans: list[tuple[float, float]] = []
    for trace in smoothed.smoothed_unknowns:
        own = [i for i, source in enumerate(trace.unknown_groups) if source in sources]
        sure = np.flatnonzero(np.any(smoothed_unknown_significance_mask(trace, own), axis=1))
        spans += [(float(trace.interval_edges[j]), float(trace.interval_edges[j + 1])) for j in sure]
    return merge_time_intervals(spans)


def merge_time_intervals(spans: Sequence[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """Merge overlapping or adjacent time intervals. The result is in order of time."""
    joined: list[tuple[float, float]] = []
    for begin, end in sorted(spans):
        if joined and begin <= joined[-1][1] + 1e-9:
            begin, last = joined.pop()
            end = max(last, end)
        joined.append((begin, end))
    return tuple(joined)


def gap_locations_from_closures_and_smoother(
    before: Sequence[GapLocation],
    closed: Mapping[str, float],
    rest: Sequence[GapLocation],
    windows: tuple[tuple[float, float], ...],
) -> tuple[GapLocation, ...]:
    """Return the locations of the gap, in order of their shares, from accepted effects and the smoother.

    A location has the part of the gap that its effects close (`closed`, a fraction by location), plus its part of the
    rest of the gap according to the smoother. `before` are the smoother's locations for the nominal model, `rest` those
    for the model with the effects. `windows` are for locations without smoother unknowns (`world`, `clock`).
    """
    known = {place.location: place for place in before}
    left, share = max(1.0 - sum(closed.values()), 0.0), dict(closed)
    for place in rest:
        share[place.location] = share.get(place.location, 0.0) + left * place.gap_share
    total, found = sum(share.values()), []
    for location in dict.fromkeys([*share, *known]):
        first = known.get(location, GapLocation(location, 0.0, False, ()))
        own = replace(first, gap_share=share.get(location, 0.0) / total if total > 0 else 0.0)
        if location in closed:
            when = first.time_windows or windows
            own = replace(own, is_observable=True, time_windows=when, indistinguishable_from=())
        found.append(own)
    return _by_share(found)


def smoothed_unknown_z_scores(smoothed: SmoothedUnknownsResult, trace: SmoothedDisturbances) -> Array:
    """Return the z scores (J, nd) of a recording: posterior mean over standard deviation of nd unknowns in J intervals.

    A z score is NaN if the data reduced the variance of the unknown by half or less.
    """
    prior = np.array([smoothed.group_variance[source] for source in trace.unknown_groups])
    with np.errstate(divide="ignore", invalid="ignore"):
        informed = (prior > 0) & (1 - trace.posterior_std**2 / prior > _INFORMED_FRACTION)
        return np.where(informed, trace.posterior_mean / trace.posterior_std, np.nan)


def smoothed_unknown_units(system: System, trace: SmoothedDisturbances) -> tuple[str, ...]:
    """Return the SI unit of each smoothed unknown in `trace`: a force, torque, push, grasp offset or sensor bias."""
    pairs = zip(trace.unknown_names, trace.unknown_groups, strict=True)
    other = {"push": "N", "offset": "m", "bias": "m"}
    joint = system.mechanism.joint
    return tuple(joint(name).unit("N m") if of.kind == "force" else other[of.kind] for name, of in pairs)

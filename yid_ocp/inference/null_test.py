"""Null test, which decides whether noise alone explains a residual, and the part of a gap that another model closes.

Under the null hypothesis the whitened residual r is noise of unit standard deviation with a known autocorrelation rho
(white, or that of the smoothing filter). Then r'r/n has the variance 2/n (1 + 2 sum rho_l^2). A chi-squared variable
with n/(1 + 2 sum rho_l^2) degrees of freedom has the same variance. Each determined parameter removes one of them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import scipy.special

from yid_ocp.arrays import Array, IntArray
from yid_ocp.display import grouped
from yid_ocp.inference import whitening
from yid_ocp.inference.linearized_residual import bounded_levenberg_marquardt_step
from yid_ocp.problem.episodes import Episode, EpisodeAndPredictionOrFailure
from yid_ocp.problem.estimation_problem import EstimationProblem
from yid_ocp.problem.evaluation import episode_residual_and_jacobian
from yid_ocp.problem.measurements import SensorMeasurements, whiten_with_extra_errors
from yid_ocp.problem.options import ExcessResidualCriteria, SensorOptions
from yid_ocp.problem.predictions import held_out_rmse_and_unit_by_channel
from yid_ocp.problem.recorded_inputs import prescribed_coordinates_at_nodes
from yid_ocp.sensors.joints import JOINT_POSITION_GROUP_NAME, NOISE_ESTIMATE_DIFFERENCE_ORDER, joint_angle_noise_std
from yid_ocp.sensors.signal_filters import ZeroPhaseLowPassFilter

_RESIDUAL_WINDOW_SECONDS = 0.5  # length of the time windows in which a residual is tested
_N_PATH_NOISE_DRAWS, _N_FOLDS = 32, 8  # draws of encoder noise (the variance of a score to a quarter), and their folds
_N_BIAS_DRAWS = 6  # of encoder noise, for the shifts of estimates
_BLOCK_DURATIONS = (0.5, 2.0)  # shortest and longest held-out time blocks, about forty in all [s]
_N_BOOTSTRAP = 1000  # draws of held-out blocks for the interval of a closure
DEFAULT_EXCESS_RESIDUAL_CRITERIA = ExcessResidualCriteria()
MIN_NOISE_GROWTH = 1.05  # of a std by encoder noise, less than which is neglected
EXTRAPOLATION_FACTOR = 2.0
"""Distance to many links, short steps or no encoder noise, over the shift of one refinement: m + m/2 + m/4 + ..."""


@dataclass(frozen=True)
class OutputResidualIndices:
    """The sample times of one scalar sensor output, and the indices of its samples in the residual vector."""

    recording: str
    channel: str
    group: str
    t: Array  # since the recording's start, shape (M,) [s]
    residual_indices: IntArray  # shape (M,)
    noise_autocorrelation: Array  # at lags 0 to L samples, shape (L + 1,)


@dataclass(frozen=True)
class NullTestResult:
    """The result of a null test: chi2 per degree of freedom, p-value and flagged time windows."""

    chi2_per_dof: float
    degrees_of_freedom: float  # effective ones, of autocorrelated noise
    p_value: float
    # start and end since the recording's start, of windows of a channel whose r'r noise alone does not explain [s]
    flagged_windows: tuple[tuple[float, float], ...] = ()


def assumed_noise_rmse_by_channel(problem: EstimationProblem) -> dict[str, float]:
    """Return the root mean square error that the stated noise alone causes in each channel, in the channel's unit.

    It follows from the median std of the channel's samples. For points it is that of a distance.
    """
    found, outputs = dict[str, list[Array]](), dict[str, int]()
    for episode in (*problem.episodes, *problem.held_out):
        for samples in episode.measurements:
            for column, channel in enumerate(samples.channel_name_per_output):
                found.setdefault(channel, []).append(samples.std[np.isfinite(samples.std[:, column]), column])
                outputs[channel] = samples.sensor.outputs_per_channel
    joined = {channel: np.concatenate(parts) for channel, parts in found.items()}
    return {name: math.sqrt(outputs[name]) * float(np.median(std)) for name, std in joined.items() if len(std)}


def _variance_inflation(autocorrelation: Array) -> float:
    """Variance inflation 1 + 2 sum rho_l^2 of a mean square of autocorrelated noise."""
    return float(1 + 2 * np.sum(autocorrelation[1:] ** 2))


def chi2_p_value(chi2: float, degrees: float) -> float:
    """Compute the probability that noise alone gives at least `chi2`. It is 1 for zero degrees of freedom."""
    return float(scipy.special.chdtrc(degrees, max(chi2, 0.0))) if degrees else 1.0


def residual_chi2_null_test(
    series: Sequence[OutputResidualIndices],
    residual: Array,
    parameters: float,
    level: float = DEFAULT_EXCESS_RESIDUAL_CRITERIA.significance_level,
    window: float = _RESIDUAL_WINDOW_SECONDS,
) -> NullTestResult:
    """Test whether a whitened residual (nr,) is only noise after a fit of `parameters` parameters.

    Rows that belong to no channel in `series` (priors) are ignored. `parameters` does not count what priors determine.
    `level` is the false-discovery rate over time windows of length `window` [s].
    """
    count = sum(len(s.residual_indices) for s in series)
    degrees = sum(len(s.residual_indices) / _variance_inflation(s.noise_autocorrelation) for s in series)
    effective = max(degrees - parameters, 1.0)
    ratio = float(sum(np.sum(residual[s.residual_indices] ** 2) for s in series)) / max(count - parameters, 1)
    p_value = chi2_p_value(ratio * effective, effective)
    return NullTestResult(ratio, effective, p_value, _flagged_windows(series, residual, level, window))


def excess_over_sample_count(residual: Array) -> float:
    """Return r'r of a whitened residual (n,) minus the number of used samples, which noise alone gives."""
    return float(residual @ residual) - np.count_nonzero(residual)


def whiten_with_drawn_errors(residual: Array, known: Array, drawn: Array) -> Array:
    """Whiten a residual (nr,) for errors of the factors `known` (nr, k) and, from K random draws, `drawn` (nr, K).

    Few draws whiten another in part only. The residual is divided by the rms of noise that other folds have whitened.
    """
    known, drawn = (own[:, np.isfinite(own).all(axis=0)] for own in (known, drawn))
    rng, used, (n, count), total = np.random.default_rng(0), residual != 0, drawn.shape, 0.0
    for fold in np.array_split(np.arange(count), min(_N_FOLDS, count)) if count else ():
        others = np.hstack([known, np.delete(drawn, fold, axis=1) * math.sqrt(count / max(count - len(fold), 1))])
        rest = [used * rng.standard_normal(n) + known @ rng.standard_normal(known.shape[1]) for _ in fold]
        made = math.sqrt(count) * drawn[:, fold] + np.transpose(rest)
        total += float(np.sum(whiten_with_extra_errors(made, others) ** 2))
    whole = whiten_with_extra_errors(residual, np.hstack([known, drawn]))
    return whole / (math.sqrt(total / max(count * np.count_nonzero(used), 1)) or 1.0)


def whiten_with_encoder_noise(problem: EstimationProblem, x: Array, residual: Array) -> Array:
    """Whiten the residual (nr,) of a fit at `x` for the noise of encoders that move the model, too."""
    by_path = encoder_noise_residual_covariance_factor(problem, unknowns_without_encoder_noise_bias(problem, x))
    return whiten_with_drawn_errors(residual, by_path[:, :0], by_path)


def unknown_shifts_by_more_encoder_noise(problem: EstimationProblem, x: Array) -> Array:
    """Compute the shifts (K, nx) of a fit `x` if the angles that move an object get the noise of their encoders again.

    It makes the object vibrate, so a fit finds too much damping (Cook and Stefanski 1994, simulation extrapolation,
    doi:10.1080/01621459.1994.10476871). K is 0 if no angles move an object.
    """
    rng, scale, moves = np.random.default_rng(0), problem.unknown_scales, list[Array]()
    low, high = ((bound - x) / scale for bound in problem.bounds)
    for _ in range(_N_BIAS_DRAWS if encoders_move_object(problem) else 0):
        noisy = problem.with_episodes(episodes_with_noisier_motion(problem, rng), (), problem.whitening_filters)
        seen = noisy.evaluate(x)
        if seen.ok and seen.jacobian is not None:
            step = bounded_levenberg_marquardt_step(seen.jacobian * scale, seen.residual, 0.0, low, high)
            moves.append(scale * step)
    return np.array(moves).reshape(-1, len(x))


def unknowns_without_encoder_noise_bias(problem: EstimationProblem, x: Array) -> Array:
    """Return a fit `x` (nx,) without the shift by encoder noise, at most halfway to bounds; `x` without points.

    Damping that is estimated too large hides how far the noise of encoders moves the object.
    """
    has_points = any(episode.recording.points for episode in problem.episodes)
    moves = unknown_shifts_by_more_encoder_noise(problem, x) if has_points else ()
    if not len(moves):
        return x
    return np.clip(x - EXTRAPOLATION_FACTOR * np.mean(moves, axis=0), *((x + bound) / 2 for bound in problem.bounds))


def encoders_move_object(problem: EstimationProblem) -> bool:
    """Check whether measured angles of prescribed joints move coordinates that are not prescribed."""
    system = problem.system
    has_encoders = system.prescribed and any(episode.recording.joints for episode in problem.episodes)
    return bool(has_encoders and system.unprescribed_coordinate_indices)


def encoder_noise_residual_covariance_factor(
    problem: EstimationProblem, x: Array, predicted: Callable[[EstimationProblem], Array | None] | None = None
) -> Array:
    """Compute a factor F (nr, K) of the covariance F F' that encoder noise of prescribed arms adds to the residual.

    This noise makes a lightly damped object vibrate, which is neither white noise nor a model error. `predicted`
    returns the residual of a problem, here with redrawn noise, or None if it fails; default: the residual at `x`. K is
    0 if no prescribed joint moves an object, or no points are measured.
    """
    residual_of = predicted or (lambda own: seen.residual if (seen := own.evaluate(x, False)).ok else None)
    nothing = np.zeros((problem.residual_rows.weak_priors.stop, 0))
    points = {group.name for episode in problem.episodes for group in episode.recording.points}
    rows = [c.residual_indices for c in channels_with_residual_indices(problem) if c.group in points]
    if not rows or not encoders_move_object(problem) or (before := residual_of(problem)) is None:
        return nothing
    rng, at, found = np.random.default_rng(0), np.concatenate(rows), []
    for _ in range(_N_PATH_NOISE_DRAWS):
        after = residual_of(problem.with_episodes(episodes_with_noisier_motion(problem, rng), ()))
        if after is not None:
            found.append(np.zeros(len(before)))
            found[-1][at] = (after - before)[at]
    return np.stack(found, axis=1) / np.sqrt(len(found)) if found else nothing


def problem_with_encoder_noise_in_points(problem: EstimationProblem, x: Array) -> tuple[EstimationProblem, str]:
    """Return a problem whose noise of points contains that of encoders which move the object, as at a fit `x` (nx,).

    Also returns a text with the stds of groups of points, empty if none grows by 5 %; then the problem is unchanged.
    Groups whose std differs between points or times keep it.
    """
    by_path = encoder_noise_residual_covariance_factor(problem, unknowns_without_encoder_noise_bias(problem, x))
    rows = grouped((own.group, own.residual_indices) for own in channels_with_residual_indices(problem))
    growth = {name: 1 + np.sum(by_path[np.concatenate(own)] ** 2, axis=1).mean() for name, own in rows.items()}
    sensors, said = dict(problem.options.sensors), list[str]()
    for name, factor in growth.items():
        samples = [own for e in problem.episodes for own in e.measurements if own.sensor.group_name == name]
        stds = np.concatenate([own.std[own.positive_weight_mask] for own in samples])
        std = float(np.median(stds))
        if factor > MIN_NOISE_GROWTH**2 and np.ptp(stds) < (MIN_NOISE_GROWTH - 1) * std:
            sensors[name] = replace(sensors.get(name, SensorOptions()), std=math.sqrt(factor) * std)
            said.append(f"{name}: {1e3 * math.sqrt(factor) * std:.2g} mm in place of {1e3 * std:.2g} mm")
    changed = problem.with_options(replace(problem.options, sensors=sensors)) if said else problem
    return changed, ", ".join(said)


def episodes_with_noisier_motion(problem: EstimationProblem, rng: np.random.Generator) -> list[Episode]:
    """Return the estimation recordings, each as `episode_with_noisier_motion`."""
    return [episode_with_noisier_motion(own, problem, rng) for own in problem.episodes]


def episode_with_noisier_motion(episode: Episode, problem: EstimationProblem, rng: np.random.Generator) -> Episode:
    """Return a recording with one more random draw of encoder noise in the prescribed motion, not in sensor data."""
    joints, system, options = episode.recording.joints, problem.system, problem.options
    names = () if joints is None else tuple(name for name in system.prescribed if name in joints.names)
    if joints is None or not names or len(joints.t) <= NOISE_ESTIMATE_DIFFERENCE_ORDER:
        return episode
    encoders = options.sensors.get(JOINT_POSITION_GROUP_NAME, SensorOptions())
    std = joint_angle_noise_std(joints, names, encoders, episode.name)
    position = joints.position.copy()
    position[:, [joints.names.index(name) for name in names]] += std * rng.standard_normal((len(position), len(names)))
    moved = replace(episode.recording, joints=replace(joints, position=position))
    low_pass, clamps = ZeroPhaseLowPassFilter(options.path_cutoff), options.clamp_pose_point_names
    path = prescribed_coordinates_at_nodes(moved, system, episode.grid, low_pass, clamps)
    start = np.concatenate([episode.initial_known_coordinates[: len(system.driven)], path[0]])
    return replace(episode, prescribed_path=path, initial_known_coordinates=start)


def residuals_exceed_noise(
    tests: Sequence[NullTestResult], limits: ExcessResidualCriteria = DEFAULT_EXCESS_RESIDUAL_CRITERIA
) -> bool:
    """Check whether the residuals of a model exceed noise by a significant and relevant amount, in any of `tests`."""
    significant = bonferroni_corrected_min_p_value([test.p_value for test in tests]) < limits.significance_level
    return significant and max(test.chi2_per_dof for test in tests) > 1 + limits.min_excess_chi2_per_dof


def bonferroni_corrected_min_p_value(p_values: Sequence[float]) -> float:
    """Return the smallest p-value after Bonferroni correction, or 1 if there is none."""
    return min([1.0, *(len(p_values) * p for p in p_values)])


@dataclass(frozen=True)
class HeldOutLoss:
    """The whitened squared prediction errors of a model, summed in nb time blocks of held-out data, shape (nb,)."""

    block_chi2: Array  # sums of whitened squares; infinite if a rollout failed
    block_sample_counts: Array
    channel_rmse: dict[str, tuple[float, str]]  # root mean square error and its unit
    updated_chi2: float  # what the blocks add to chi2 of a fit to all recordings, in the linear model
    # chi2 of the deviation from a baseline, which does not depend on the resampled blocks
    baseline_chi2: float = 0.0

    @property
    def total_chi2(self) -> float:
        """The sum of chi2 over all held-out time blocks, plus chi2 of the deviation from earlier runs."""
        return float(self.block_chi2.sum()) + self.baseline_chi2

    @property
    def chi2_per_sample(self) -> float:
        """The value of `total_chi2` divided by the number of held-out samples. Noise alone gives 1 on average."""
        return self.total_chi2 / max(float(self.block_sample_counts.sum()), 1.0)

    @property
    def excess_chi2_per_sample(self) -> float:
        """The gap on held-out recordings, G = max(0, chi2/n - 1)."""
        return max(0.0, self.chi2_per_sample - 1.0)


@np.errstate(invalid="ignore")  # of recordings that cannot be predicted
def held_out_loss(
    problem: EstimationProblem,
    x: Array,
    covariance_factor: Array,
    spread: Array | None = None,
    predicted: Sequence[EpisodeAndPredictionOrFailure] = (),
) -> HeldOutLoss:
    """Compute the prediction loss on held-out recordings of a fit at `x` (nx,) whose covariance by noise is F F'.

    `covariance_factor` is F (nx, nx). `spread` (n, k) has errors of the residual that are no gap, each by one standard
    deviation. `predicted` are predictions with derivatives, if they are known.
    """
    total = sum(episode.grid.steps * episode.grid.time_step for episode in problem.held_out)
    length = float(np.clip(total / 40, *_BLOCK_DURATIONS))
    factor = covariance_factor[: len(problem.shared_parameters)]
    found, residuals, errors, numbered, count = predicted or problem.predict_held_out(x, True), [], [], [], 0
    for (episode, result), whitener in zip(found, problem.held_out_whitening_filters, strict=True):
        blocks = []
        for samples in episode.measurements:
            used, times = samples.positive_weight_mask, times_since_recording_start(episode, samples)
            blocks.append(np.broadcast_to(np.trunc(times / length).T, used.T.shape).T[used])
        own, block = np.unique(np.concatenate(blocks), return_inverse=True)
        numbered.append(count + block)
        count += len(own)
        residuals.append(np.full(len(block), np.inf))
        errors.append(np.zeros((len(block), factor.shape[1])))
        if not isinstance(result, str):
            part = episode_residual_and_jacobian(episode, whitener, result)
            residuals[-1], errors[-1] = part.residual, np.asarray(part.jacobian)[:, : len(factor)] @ factor
    whole, number = np.concatenate(residuals), np.concatenate(numbered)

    def whitened(beside: Array) -> Array:
        return np.nan_to_num(whiten_with_extra_errors(whole, beside), nan=np.inf, posinf=np.inf, neginf=np.inf)

    updated = float(np.sum(whitened(np.vstack(errors)) ** 2))
    if spread is not None:  # what the nominal parameters leave uncertain is no gap
        whole = whitened(spread)
    if problem.has_process_noise:
        # errors in metres and radians are those of predictions from recorded torques minus offsets
        found = whitening.problem_with_sensor_noise_only(problem).predict_held_out(x)
    joint = problem.options.multivariate_prior.restricted_to(problem.shared_parameters)
    apart = (x - problem.initial_unknowns)[[problem.unknown_names.index(name) for name in joint.parameter_names]]
    contradiction = float(apart @ np.linalg.solve(joint.covariance, apart))
    channels = held_out_rmse_and_unit_by_channel(found)
    squares = np.bincount(number, weights=whole**2).astype(float)
    return HeldOutLoss(squares, np.bincount(number).astype(float), channels, updated, contradiction)


@dataclass(frozen=True)
class HeldOutGapClosure:
    """The fraction of the held-out gap that a model closes, with its 95 % interval. NaN if there is no gap."""

    fraction: float
    ci_low: float
    ci_high: float

    @property
    def text(self) -> str:
        """A text that states the closed fraction; empty if there is no gap."""
        return f"{100 * self.fraction:.3g} % of the held-out gap closed" if math.isfinite(self.fraction) else ""

    def to_dict(self) -> dict[str, float | list[float]]:
        """Convert the closed fraction and its interval to entries of result.json."""
        return {"closure": self.fraction, "closure_ci": [self.ci_low, self.ci_high]}


UNDEFINED_GAP_CLOSURE = HeldOutGapClosure(math.nan, math.nan, math.nan)


def held_out_gap_closure(before: HeldOutLoss, after: HeldOutLoss) -> HeldOutGapClosure:
    """Compute the fraction of the gap that closes, 1 - G_after/G_before, with its interval from resampled blocks.

    Kuensch 1989, doi:10.1214/aos/1176347265.
    """
    if before.excess_chi2_per_sample <= 0 or not math.isfinite(after.chi2_per_sample):
        return UNDEFINED_GAP_CLOSURE
    fraction = 1 - after.excess_chi2_per_sample / before.excess_chi2_per_sample
    count = len(before.block_sample_counts)
    draws = np.random.default_rng(0).integers(0, count, (_N_BOOTSTRAP, count))
    n = before.block_sample_counts[draws].sum(axis=1)
    chi2 = (loss.block_chi2[draws].sum(axis=1) + loss.baseline_chi2 for loss in (before, after))
    g0, g1 = (np.maximum(total / n - 1.0, 0.0) for total in chi2)
    low, high = np.quantile(1 - g1[g0 > 0] / g0[g0 > 0], [0.025, 0.975])
    return HeldOutGapClosure(fraction, float(low), float(high))


def chi2_per_sample_decrease_and_std_error(before: HeldOutLoss, after: HeldOutLoss) -> tuple[float, float]:
    """Compute the decrease of held-out chi2/n from `before` to `after`, and its standard error over blocks."""
    total = float(before.block_sample_counts.sum())
    difference = before.block_chi2 - after.block_chi2
    if not np.all(np.isfinite(difference)):
        return before.chi2_per_sample - after.chi2_per_sample, 0.0
    count = len(difference)
    error = np.sqrt(count) * float(np.std(difference, ddof=1)) if count > 1 else np.inf
    return float(difference.sum() + before.baseline_chi2 - after.baseline_chi2) / total, float(error) / total


def _flagged_windows(
    series: Sequence[OutputResidualIndices], residual: Array, level: float, length: float
) -> tuple[tuple[float, float], ...]:
    spans, p_values = list[tuple[float, float]](), list[float]()
    for own in grouped(((s.recording, s.channel), s) for s in series).values():
        last = max(float(s.t[-1]) for s in own)
        for k in range(int(last / length) + 1):
            begin, total, degrees, count = k * length, 0.0, 0.0, 0
            for s in own:
                r = residual[s.residual_indices[(s.t >= begin) & (s.t < begin + length)]]
                total, count = total + float(r @ r), count + len(r)
                degrees += len(r) / _variance_inflation(s.noise_autocorrelation)
            if count:
                p_values.append(chi2_p_value(total / count * degrees, degrees))
                spans.append((begin, min(begin + length, last)))
    return tuple(itertools.compress(spans, benjamini_hochberg_mask(p_values, len(spans), level)))


def benjamini_hochberg_mask(p_values: Sequence[float], tries: float, level: float) -> list[bool]:
    """Return which of the p-values are significant at the false-discovery rate `level` among `tries` tests.

    `p_values` may omit tests with large p-values. Benjamini and Hochberg (1995),
    doi:10.1111/j.2517-6161.1995.tb02031.x.
    """
    order = np.argsort(p_values)
    passed = np.flatnonzero(np.sort(p_values) <= level * np.arange(1, len(order) + 1) / max(tries, 1.0))
    real = np.zeros(len(order), bool)
    real[order[: passed[-1] + 1 if len(passed) else 0]] = True
    return real.tolist()


def times_since_recording_start(episode: Episode, samples: SensorMeasurements) -> Array:
    """Return the sample times since the start of the recording, shape (M,) [s]."""
    return np.asarray((samples.node + samples.fraction) * episode.grid.time_step)


def channels_with_residual_indices(problem: EstimationProblem) -> tuple[OutputResidualIndices, ...]:
    """Return the sample times and residual indices of every scalar sensor output of every recording."""
    series: list[OutputResidualIndices] = []
    for episode, groups in zip(problem.episodes, problem.residual_rows.measurements, strict=True):
        for samples, rows in zip(episode.measurements, groups, strict=True):
            t = times_since_recording_start(episode, samples)
            place = np.full(samples.positive_weight_mask.shape, -1)
            place[samples.positive_weight_mask] = np.arange(rows.start, rows.stop)
            autocorrelation = _noise_autocorrelation(samples.smoothing_filter, episode.grid.time_step, samples.node)
            for column, channel in enumerate(samples.channel_name_per_output):
                seen = samples.positive_weight_mask[:, column]
                if seen.any():
                    text = (episode.name, channel, samples.sensor.group_name)
                    series.append(OutputResidualIndices(*text, t[seen], place[seen, column], autocorrelation))
    return tuple(series)


def covariance_of_scores(columns: Array, series: Sequence[OutputResidualIndices]) -> Array:
    """Compute the covariance X' Omega X (p, p) of X'r, X (nr, p), under the noise's known autocorrelation."""
    total = np.zeros((columns.shape[1], columns.shape[1]))
    for s in series:
        x, lags = columns[s.residual_indices], s.noise_autocorrelation[: len(s.residual_indices)]
        seen = scipy.linalg.matmul_toeplitz(np.pad(lags, (0, len(x) - len(lags))), x) if len(lags) > 1 else x
        total += x.T @ seen
    return (total + total.T) / 2


def newey_west_covariance_of_scores(columns: Array, residual: Array, series: Sequence[OutputResidualIndices]) -> Array:
    """Compute the covariance (p, p) of X'r, X = `columns`, if the rows of each series correlate (Newey, West 1987)."""
    total = np.zeros((columns.shape[1], columns.shape[1]))
    for s in series:
        u = columns[s.residual_indices] * residual[s.residual_indices, None]
        length = int(np.sqrt(len(u))) + 1
        cumulative = np.cumsum(np.pad(u, ((length, length - 1), (0, 0))), axis=0)
        sums = cumulative[length:] - cumulative[:-length]
        total += sums.T @ sums / length
    return total


def _noise_autocorrelation(low_pass: ZeroPhaseLowPassFilter | None, step: float, nodes: IntArray) -> Array:
    """Autocorrelation, at lags 0, 1, ... samples, of white noise that was filtered every `step` [s], at some nodes."""
    if low_pass is None or not np.isfinite(low_pass.cutoff) or len(nodes) < 2:
        return np.ones(1)
    half = int(2 * low_pass.passes / (low_pass.cutoff * step)) + 10
    impulse = np.zeros((2 * half + 1, 1))
    impulse[half] = 1.0
    response = low_pass(step * np.arange(2 * half + 1, dtype=float), impulse)[:, 0]
    full = np.correlate(response, response, "full")[2 * half :]
    return np.asarray(full[:half] / full[0])[:: int(np.median(np.diff(nodes)))]

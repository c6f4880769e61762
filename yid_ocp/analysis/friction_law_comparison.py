"""Cross-validation of friction laws, choice of the simplest adequate law, and measured friction torques."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.special

from yid_ocp.arrays import Array
from yid_ocp.display import PartsDoneCounter, grouped
from yid_ocp.effects.law import torque_law_quantity_at_midpoints
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.evaluation import episode_residual_and_jacobian
from yid_ocp.problem.measurements import SensorMeasurements
from yid_ocp.problem.predictions import channel_predictions
from yid_ocp.problem.recorded_inputs import smoothed_joint_angles_at_nodes
from yid_ocp.sensors.signal_filters import ZeroPhaseLowPassFilter
from yid_ocp.solvers import GaussNewton, Solution

_MAX_FOLD_ITERATIONS = 15
_MIN_MOTION_KINDS = 3  # with fewer kinds by name, every recording counts as a kind of its own
_MAX_CLOUD_POINTS = 1500


@dataclass(frozen=True)
class CrossValidatedFrictionLawFit:
    """A friction law fitted to all recordings, with its prediction errors on recordings left out of the fit.

    `left_out_errors` holds, by recording, the rms prediction error of a fit without the recordings of the same kind of
    motion (NaN if the prediction failed). The error is that of the angles of driven joints [rad] or, for prescribed
    joints, that of their efforts, in standard deviations and without constant errors of the sensors.
    """

    law: str
    left_out_errors: Mapping[str, float]
    unit: str
    is_converged: bool


def recording_names_by_name_stem(problem: EstimationProblem) -> dict[str, tuple[str, ...]]:
    """Return the names of the recordings by kind of motion, which is the name without a final number.

    Recordings with the motors off are omitted. With fewer than three kinds, every recording is a kind of its own.
    """
    joints = {e.name: e.recording.joints for e in problem.episodes}
    commanded = {name for name, own in joints.items() if own is not None and own.position_command is not None}
    names = [name for name in joints if not problem.system.servos or name in commanded]
    found = grouped((re.sub(r"[_-]?\d+$", "", name), name) for name in names)
    if len(found) < _MIN_MOTION_KINDS:
        return {name: (name,) for name in names}
    return {kind: tuple(own) for kind, own in found.items()}


def cross_validate_law_by_motion_kind(
    law: str,
    problem: EstimationProblem,
    solution: Solution,
    kinds: Mapping[str, Sequence[str]],
    parts: PartsDoneCounter,
) -> CrossValidatedFrictionLawFit:
    """Fit a friction law without each of the `kinds` of motion in turn, and compute its errors on the omitted kind."""
    errors: dict[str, float] = {}
    used = (e.measurements for e in problem.episodes)
    is_whitened = {own[i].sensor.unit for own in used for i in _indices_of_sensors_of_friction(own)} != {"rad"}
    unit = "std" if is_whitened else "rad"
    pairs = list(zip(problem.episodes, problem.whitening_filters, strict=True))
    known = problem.unknowns.named_values(solution.x)
    for kind, own in kinds.items():
        inside, outside = ([pair for pair in pairs if (pair[0].name in own) == out] for out in (False, True))
        (episodes, filters), (left, left_filters) = zip(*inside, strict=True), zip(*outside, strict=True)
        fold = problem.with_episodes(episodes, left, filters, left_filters)
        start = fold.pack_unknowns({name: known[name] for name in fold.unknown_names})
        found = GaussNewton(max_iterations=_MAX_FOLD_ITERATIONS).minimize_cost(fold, start, None)
        for episode, outcome in fold.predict_held_out(found.x):
            if isinstance(outcome, str):
                errors[episode.name] = float("nan")
                continue
            kept = _indices_of_sensors_of_friction(episode.measurements)
            own_episode = replace(episode, measurements=tuple(episode.measurements[i] for i in kept))
            outcome = replace(outcome, predicted_outputs=tuple(outcome.predicted_outputs[i] for i in kept))
            if is_whitened:
                rows = episode_residual_and_jacobian(own_episode, None, outcome, np.inf).residual
            else:
                rows = np.vstack([p.predicted_minus_measured for p in channel_predictions(own_episode, outcome)])
            errors[episode.name] = float(np.sqrt(np.nanmean(rows**2)))
        error = np.mean([errors[name] for name in own if name in errors])
        parts.count_done(f"law '{law}' fitted to the other motions: rms error on {kind} {error:.3g} {unit}")
    return CrossValidatedFrictionLawFit(law, errors, unit, solution.status.value == "converged")


def _indices_of_sensors_of_friction(samples: Sequence[SensorMeasurements]) -> Sequence[int]:
    """Return the indices of joint sensors, or of all without any: held points have the same error for all laws."""
    return [i for i, own in enumerate(samples) if not own.sensor.frame_names] or range(len(samples))


def mean_and_std_error_over_motion_kinds(
    errors: Mapping[str, float], kinds: Mapping[str, Sequence[str]]
) -> tuple[float, float]:
    """Return the mean over the kinds of motion of their mean prediction errors, and the standard error of this mean."""
    by_kind = np.array([np.mean([errors[name] for name in own]) for own in kinds.values()])
    return float(np.mean(by_kind)), float(np.std(by_kind, ddof=1) / np.sqrt(len(by_kind)))


def prediction_error_difference_and_std_error(
    fit: CrossValidatedFrictionLawFit, other: CrossValidatedFrictionLawFit, kinds: Mapping[str, Sequence[str]]
) -> tuple[float, float]:
    """Return the mean prediction error of `fit` minus that of `other` over kinds of motion, and its standard error."""
    beyond = {name: own - other.left_out_errors[name] for name, own in fit.left_out_errors.items()}
    return mean_and_std_error_over_motion_kinds(beyond, kinds)


def simplest_fit_within_one_std_error(
    fits: Sequence[CrossValidatedFrictionLawFit], kinds: Mapping[str, Sequence[str]]
) -> CrossValidatedFrictionLawFit:
    """Choose the simplest friction law by the one-standard-error rule of cross-validation.

    Returns the first of `fits` (simplest first) whose mean error over the `kinds` of motion is within one standard
    error of the smallest mean error (Hastie, Tibshirani and Friedman 2009, The elements of statistical learning, 7.10,
    doi:10.1007/978-0-387-84858-7). This standard error is the larger of that of the smallest error and that of the
    difference from it. A difference that is significant at the 5 % level (two-sided t-test) counts in any case.
    """
    quantile = float(scipy.special.stdtrit(len(kinds) - 1, 0.975))
    means = [mean_and_std_error_over_motion_kinds(fit.left_out_errors, kinds)[0] for fit in fits]
    best = fits[int(np.argmin(np.where(np.isfinite(means), means, np.inf)))]
    _, error = mean_and_std_error_over_motion_kinds(best.left_out_errors, kinds)

    def is_near(fit: CrossValidatedFrictionLawFit) -> bool:
        difference, paired = prediction_error_difference_and_std_error(fit, best, kinds)
        return difference <= min(max(error, paired), quantile * paired)

    return next((fit for fit in fits if is_near(fit)), fits[0])


@dataclass(frozen=True)
class _FrictionTorqueCloud:
    """Measured and predicted friction torque of one joint at M points of its recorded motion."""

    joint: str
    speed: Array  # shape (M,) [rad/s]
    load: Array  # torque through the gear: motor torque minus external torque, shape (M,) [N m]
    measured: Array  # torque against the motion that the model without friction lacks, shape (M,) [N m]
    predicted: Array  # friction of the fitted law, shape (M,) [N m]


def measured_and_predicted_friction_torques(
    problem: EstimationProblem, solution: Solution, friction_parameters: Sequence[str]
) -> tuple[_FrictionTorqueCloud, ...]:
    """Return measured and predicted friction torques of the driven joints to which `friction_parameters` belong.

    The measured friction torque is the residual of the discrete equations of motion without friction, along the
    smoothed measured angles. The predicted torque is the change of this residual by the fitted law. The result is empty
    if a coordinate is not driven, or if the model has constraints or internal coordinates.
    """
    step, system = problem.step, problem.system
    driven = system.driven
    if not driven or step.sizes["m"] or step.sizes["nz"] or len(driven) != system.n_coordinates:
        return ()
    own = {name.rpartition(".")[0].rpartition("@")[2] for name in friction_parameters}
    parts: dict[str, list[Array]] = {name: [] for name in driven if name in own}
    for i, episode in enumerate(problem.episodes):
        joints = episode.recording.joints
        assert joints is not None
        low_pass = ZeroPhaseLowPassFilter(problem.options.path_cutoff)
        path = smoothed_joint_angles_at_nodes(joints, driven, episode.grid, episode.name, low_pass)
        theta = problem.theta_of_episode(solution.x, i)
        inputs = problem.predictor.corrected_inputs(episode, theta, ())
        shift = inputs.driven_angles - episode.measured_driven_angles
        q = np.zeros_like(path)
        q[:, list(system.actuated_coordinate_indices)] = path + shift
        without = theta.copy()
        without[[system.parameters.index(name) for name in friction_parameters]] = 0.0
        nodes = {"state": q, "torque": inputs.torque, "multipliers": np.zeros((len(inputs.torque), 0))}
        still = np.hstack([q, np.zeros_like(q)]), nodes["multipliers"], inputs.torque, (), False
        residuals = (step.kernel.step_residuals_and_jacobians(at, *still) for at in (without, theta))
        # torques (N - 1, n) that the equations lack at the inner nodes
        lacking, given = ((own.residual[1:, : q.shape[1]] + own.p1[:-1]) / step.time_step for own in residuals)
        speed = (q[2:] - q[:-2]) / (2 * step.time_step)
        nodes["time_step"] = np.array(step.time_step)
        for name, found in parts.items():
            at = system.mechanism.joint_index(name)
            load = torque_law_quantity_at_midpoints(system, name, "load", theta, nodes)[:, 0]
            mean_load = (load[:-1] + load[1:]) / 2
            found.append(np.stack([speed[:, at], mean_load, -lacking[:, at], (given - lacking)[:, at]]))
    clouds = []
    for name, found in parts.items():
        rows = np.concatenate(found, axis=1)
        keep = np.unique(np.linspace(0, rows.shape[1] - 1, min(rows.shape[1], _MAX_CLOUD_POINTS)).astype(int))
        speed, load, measured, predicted = rows[:, keep]
        clouds.append(_FrictionTorqueCloud(name, speed, load, -measured, -predicted))
    return tuple(clouds)


def problems_with_common_samples(problems: Sequence[EstimationProblem]) -> list[EstimationProblem]:
    """Return the problems with only the samples that all of them contain, so that their errors are comparable."""
    found = []
    for problem in problems:
        episodes = []
        for episode, *alike in zip(problem.episodes, *(other.episodes for other in problems), strict=True):
            samples = []
            for own, *others in zip(episode.measurements, *(other.measurements for other in alike), strict=True):
                seen = np.all([other.positive_weight_mask for other in others], axis=0)
                samples.append(replace(own, weight=own.weight * seen, value=np.where(seen, own.value, np.nan)))
            episodes.append(replace(episode, measurements=tuple(samples)))
        found.append(problem.with_episodes(episodes, ()))
    return found


def problem_estimating_from_all_recordings(problem: EstimationProblem) -> EstimationProblem:
    """Return the problem that estimates from all recordings: held-out recordings become estimation recordings."""
    added = (replace(held, initial_state_shared_with=None) for held in problem.held_out)
    filters = (*problem.whitening_filters, *problem.held_out_whitening_filters)
    return problem.with_episodes((*problem.episodes, *added), (), filters, ())

"""Errors due to finite links and finite time steps, gaps at grasps, and numerical stability."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace

import casadi as ca
import numpy as np
import scipy.optimize

from yid_ocp.arrays import Array
from yid_ocp.data.recording import Recording
from yid_ocp.display import Progress, abbreviated_names_text
from yid_ocp.effects import EffectBase
from yid_ocp.errors import YidError
from yid_ocp.inference.linearized_residual import bounded_levenberg_marquardt_step
from yid_ocp.inference.null_test import (
    EXTRAPOLATION_FACTOR,
    excess_over_sample_count,
    unknown_shifts_by_more_encoder_noise,
)
from yid_ocp.inference.uncertainty import EstimateShiftByDiscretisation, ParameterEstimate, verdict_by_relative_std
from yid_ocp.inference.whitening import problem_with_whitening_at
from yid_ocp.integrator.step import Step, simulate, step_with_time_step
from yid_ocp.integrator.step_model import Rollout, TrackingFeedback
from yid_ocp.model.system import System
from yid_ocp.parallel import CASADI_LOCK
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode, EpisodePrediction, TorqueAndAngleErrorModel, truncate_episode
from yid_ocp.problem.evaluation import INITIAL_STATE_UNKNOWN_PREFIX, Evaluation, ProcessNoiseWhitener
from yid_ocp.problem.options import RefinementKind
from yid_ocp.problem.recorded_inputs import has_motion_in_band
from yid_ocp.solvers import GaussNewton

_START_ANGLE_PREFIX = f"{INITIAL_STATE_UNKNOWN_PREFIX}q."
_NORMAL_QUANTILE_95 = 1.96
_LEFT_AFTER_CORRECTION = 1 - 1 / EXTRAPOLATION_FACTOR  # of this distance, in data corrected by one refinement
_MAX_TIME_STEP, _MAX_HALVINGS, _MAX_STEP_ERROR_FRACTION = 0.02, 5, 0.03
_MAX_FINER_FIT_ITERATIONS = 3
# changes by a finer model in units of r'r, up to which a linear step suffices, and up to which it rules out a decrease
_MAX_LINEAR_CHANGE, _MAX_REFUTING_CHANGE = 1.0, 10.0
_REFINEMENT_DESCRIPTIONS = {"links": "twice the links", "time_step": "half the time step"}
_MIN_NOTED_SHARE, _MIN_NOTED_FALL = 0.25, 0.05  # of the misfit beyond noise that is removed; of chi2 per sample


@dataclass(frozen=True)
class _FinerModel:
    """An estimation problem with a finer discretisation, and the mapping from coarse to fine unknowns."""

    problem: EstimationProblem
    parameter_factors: Mapping[str, float] = field(default_factory=dict)  # fine over coarse value; default 1
    subdivided_joints: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # fine joints that share its angle

    def _factor(self, name: str) -> float:
        return float(self.parameter_factors.get(name.split("[")[0], 1.0))

    def _slopes(self, names: Sequence[str]) -> Array:
        """Derivatives of the fine unknowns by the named coarse ones. Divided links share their link's angle."""
        at = {name: i for i, name in enumerate(self.problem.unknown_names)}
        slopes = np.zeros((len(at), len(names)))
        for i, name in enumerate(names):
            base, bracket, recording = name.partition("[")
            joint = base.rpartition(".")[2] if base.startswith(INITIAL_STATE_UNKNOWN_PREFIX) else ""
            parts = self.subdivided_joints.get(joint)
            if parts is None and name in at:
                slopes[at[name], i] = self._factor(name)
            elif parts is not None and base.startswith(_START_ANGLE_PREFIX):
                slopes[[at[f"{_START_ANGLE_PREFIX}{part}{bracket}{recording}"] for part in parts], i] = 1 / len(parts)
        return slopes

    def _unknowns(self, names: Sequence[str], x: Array) -> Array:
        """Return the fine unknowns for coarse unknowns `x`, within bounds."""
        slopes = self._slopes(names)
        return np.clip(np.where(slopes.any(axis=1), slopes @ x, self.problem.initial_unknowns), *self.problem.bounds)

    def _guess(self, coarse: System, q: Array) -> Array:
        tree = self.problem.system.mechanism
        fine = np.zeros(len(tree.joints))
        for name, angle in zip(coarse.mechanism.joint_names, q, strict=True):
            parts = self.subdivided_joints.get(name, (name,))
            # a neutral effect of the coarse model may add a joint
            fine[[tree.joint_index(part) for part in parts if part in tree.joint_names]] = angle / len(parts)
        return fine


def _has_divisible_links(problem: EstimationProblem) -> bool:
    return bool(problem.options.divided_links_model and problem.system.segment_layouts)


def _fine_joints_by_coarse_joint(coarse: System, fine: System) -> dict[str, tuple[str, ...]]:
    """Return the names of the fine joints that replace each divided joint of the coarse model."""
    found = {}
    for segment in coarse.segment_layouts:
        links = fine.find_segment_layout(segment.name).link_joints
        times = len(links) // len(segment.link_joints)
        for i, joints in enumerate(segment.link_joints if times > 1 else ()):
            for axis, joint in enumerate(joints):
                found[joint] = tuple(links[times * i + k][axis] for k in range(times))
    return found


def _gauss_newton_step_in_finer_model(
    refined: _FinerModel, coarse: EstimationProblem, x: Array, at_x: Evaluation
) -> tuple[dict[str, float], Array, Evaluation] | str:
    """Make one Gauss-Newton step in a finer model, from the coarse unknowns x (nx,).

    Returns the shift of each shared free parameter, the linearised residual after the step and the fine evaluation, or
    a message if the step fails. `at_x` is the coarse evaluation at `x`. With process noise, or the same links and
    samples, Jacobian and priors are coarse.
    """
    point, guesses = refined._unknowns(coarse.unknown_names, x), at_x.equilibrium_guesses
    warm = tuple(None if q is None else refined._guess(coarse.system, q) for q in guesses)
    weighted = any(own is not None for own in coarse.whitening_filters)
    problem = _with_coarse_weights(refined.problem, coarse) if weighted else refined.problem
    own, other = problem.residual_rows, coarse.residual_rows
    if weighted and own.measurements != other.measurements:
        return "the finer model would use other samples of the recordings"
    is_alike = weighted or (not refined.subdivided_joints and own.measurements == other.measurements)
    evaluation = problem.evaluate(point, derivatives=not is_alike, equilibrium_guesses=warm)
    residual, jacobian = evaluation.residual, evaluation.jacobian
    if not evaluation.ok:
        return evaluation.message
    if is_alike:
        problem, point, jacobian = coarse, x, at_x.jacobian
        residual = np.concatenate([residual[other.data], at_x.residual[other.data.stop :]])
    assert jacobian is not None
    scale = problem.unknown_scales
    low, high = ((bound - point) / scale for bound in problem.bounds)
    step = scale * bounded_levenberg_marquardt_step(jacobian * scale, residual, 0.0, low, high)
    moved = dict(zip(problem.unknown_names, map(float, step), strict=True))
    factors = {name: 1.0 if is_alike else refined._factor(name) for name in problem.shared_parameters}
    return {name: moved[name] / factor for name, factor in factors.items()}, residual + jacobian @ step, evaluation


def predicted_refit_residual_at_finer_step(
    fine: EstimationProblem, coarse: EstimationProblem, x: Array, at_x: Evaluation, is_refitted: bool = False
) -> Array | None:
    """Predict the whitened residual that a fit with a shorter time step would have, or return None if this fails.

    `fine` is the problem with the shorter time step. One Gauss-Newton step is made from the coarse fit `x` (nx,), where
    `at_x` is the coarse evaluation with Jacobian. With process noise, the coarse weights are used. Without it, `fine`
    is fitted with `is_refitted`, or if the shorter step changes predictions by more than the residual.
    """
    refined = _FinerModel(fine)
    made = _gauss_newton_step_in_finer_model(refined, coarse, x, at_x)
    if isinstance(made, str) or coarse.has_process_noise:
        return None if isinstance(made, str) else made[1]
    _, left, before = made
    changed = before.residual - at_x.residual if len(before.residual) == len(at_x.residual) else np.zeros(1)
    if not is_refitted and changed @ changed <= at_x.residual @ at_x.residual:
        return left
    start = refined._unknowns(coarse.unknown_names, x)
    fitted = fine.evaluate(GaussNewton().minimize_cost(fine, start, None).x, False, at_x.equilibrium_guesses)
    return fitted.residual if fitted.ok and fitted.cost < before.cost else left


def predicted_chi2_fall_at_finer_step(
    fine: EstimationProblem, coarse: EstimationProblem, x: Array, at_x: Evaluation, is_refitted: bool = False
) -> float:
    """Predict the sum of the falls of r'r - n over sensors by a shorter time step; minus infinity if this fails.

    The arguments are those of `predicted_refit_residual_at_finer_step`. Only falls count: r'r of efforts may rise,
    because the noise of accelerations in it depends on the time step.
    """
    left = predicted_refit_residual_at_finer_step(fine, coarse, x, at_x, is_refitted)
    if left is None:
        return -math.inf
    rows = (itertools.chain.from_iterable(own.residual_rows.measurements) for own in (coarse, fine))
    pairs = zip((at_x.residual, left), rows, strict=True)
    before, after = ([excess_over_sample_count(r[at]) for at in part] for r, part in pairs)
    return sum(max(old - new, 0.0) for old, new in zip(before, after, strict=True))


def stds_with_discretisation_and_encoder_errors(
    fine: EstimationProblem,
    coarse: EstimationProblem,
    x: Array,
    at_x: Evaluation,
    stds: Mapping[str, float],
    effects: Sequence[EffectBase],
    is_corrected_for_links: bool,
) -> tuple[dict[str, float], tuple[RefinementKind, ...]]:
    """Add the errors of discretisation and of encoder noise to standard deviations of a fit `x` (nx,), as `solve` does.

    `fine` is the problem with half the time step, `at_x` the coarse evaluation with Jacobian. The error of the links,
    in a model with the `effects` of the fit, is added if `solve` does so too. Of data that are corrected for it, a part
    is left. Also returns which refinements were made.
    """
    refinements: dict[RefinementKind, Callable[[], _FinerModel]] = {"time_step": lambda: _FinerModel(fine)}
    if "links" in coarse.options.checked_discretisations and _has_divisible_links(coarse):
        refinements["links"] = lambda: _refined_problem(coarse, "links", effects=effects)
    shifts, counted = [_shifts_by_more_encoder_noise(coarse, x)], list[RefinementKind]()
    for kind, refined in refinements.items():
        with contextlib.suppress(YidError):
            finer = refined()
            finer = replace(finer, problem=problem_with_data_of(finer.problem, coarse))  # corrected ones
            made = _gauss_newton_step_in_finer_model(finer, coarse, x, at_x)
            if not isinstance(made, str):
                left = _LEFT_AFTER_CORRECTION if kind == "links" and is_corrected_for_links else 1.0
                shifts.append({name: left * move for name, move in made[0].items()})
                counted.append(kind)
    own = {name: _std_with_shifts(std, [part[name] for part in shifts if name in part]) for name, std in stds.items()}
    return own, tuple(counted)


def problem_with_data_of(problem: EstimationProblem, other: EstimationProblem) -> EstimationProblem:
    """Return the problem with the data of another one of the same recordings, where both have the same samples."""

    def with_data_of(episode: Episode, other: Episode) -> Episode:
        pairs = zip(episode.measurements, other.measurements, strict=True)
        same = (replace(a, value=b.value) if a.value.shape == b.value.shape else a for a, b in pairs)
        return replace(episode, measurements=tuple(same))

    episodes = list(map(with_data_of, problem.episodes, other.episodes))
    return problem.with_episodes(episodes, list(map(with_data_of, problem.held_out, other.held_out)))


def _std_with_shifts(std: float, shifts: Iterable[float]) -> float:
    """Standard deviation with the errors of finite refinements. Shifts below the standard deviation are ignored."""
    return math.hypot(std, *(EXTRAPOLATION_FACTOR * move for move in shifts if abs(move) > std))


def problem_data_corrected_for_few_links(
    problem: EstimationProblem,
    fitted: EstimationProblem,
    x: Array,
    at_x: Evaluation,
    effects: Sequence[EffectBase],
    min_chi2_decrease: float,
) -> EstimationProblem | None:
    """Return `problem` with all data corrected for the error of too few links.

    The change of the predictions by dividing each link in two is subtracted. `fitted` is the problem with the `effects`
    of a fit; `at_x` is its evaluation at the fit `x` (nx,), with Jacobian. A large change is computed at parameters
    refitted in the finer model. None if a refit would not lower r'r by `min_chi2_decrease`, or if this is impossible.
    """
    if problem.has_process_noise or not _has_divisible_links(problem):
        return None
    guesses, before = at_x.equilibrium_guesses, at_x.residual
    try:
        refined = _refined_problem(fitted, "links", effects=effects)
        point, finer = refined._unknowns(fitted.unknown_names, x), refined.problem
        warm = tuple(None if q is None else refined._guess(fitted.system, q) for q in guesses)
        for is_refitted in (False, True):
            if is_refitted:
                point = GaussNewton(max_iterations=_MAX_FINER_FIT_ITERATIONS).minimize_cost(finer, point, None).x
                slopes = refined._slopes(fitted.unknown_names)
                x = x + np.linalg.lstsq(slopes, point - slopes @ x, rcond=None)[0]
            fine, coarse = finer.evaluate(point, False, warm), fitted.evaluate(x, False, guesses)
            if not (fine.ok and coarse.ok):
                return None
            changes = coarse.episode_predictions, fine.episode_predictions
            episodes = list(map(_with_data_shifted, problem.episodes, *changes))
            after = fitted.with_episodes(episodes, ()).evaluate(x, False, guesses).residual
            if len(after) != len(before):
                return None  # events have removed samples
            assert at_x.jacobian is not None
            left = after - at_x.jacobian @ np.linalg.lstsq(at_x.jacobian, after, rcond=1e-10)[0]
            change = np.sum((after - before) ** 2) / (before @ before)
            is_lower = before @ before - left @ left > min_chi2_decrease
            if not is_lower and (is_refitted or change <= _MAX_REFUTING_CHANGE):
                return None
            if change <= _MAX_LINEAR_CHANGE:
                break
        finer = _refined_problem(fitted, "links", [e.recording for e in problem.held_out], finer.step).problem
        held_out = zip(problem.held_out, fitted.predict_held_out(x), finer.predict_held_out(point), strict=True)
        others = [_with_data_shifted(e, one, other) for e, (_, one), (_, other) in held_out]
    except YidError:
        return None
    return problem.with_episodes(episodes, others)


def _with_data_shifted(episode: Episode, before: EpisodePrediction | str, after: EpisodePrediction | str) -> Episode:
    """Return the episode with the change of its predictions subtracted from its data, if both predictions succeeded."""
    if isinstance(before, str) or isinstance(after, str):
        return episode
    triples = zip(episode.measurements, before.predicted_outputs, after.predicted_outputs, strict=True)
    alike = ((own, new - old if new.shape == old.shape else 0.0) for own, old, new in triples)
    return replace(episode, measurements=tuple(replace(own, value=own.value - change) for own, change in alike))


def longest_accurate_time_step(problem: EstimationProblem) -> float:
    """Find the longest time step [s] whose error is small compared with the residual at the initial values.

    Starting at 20 ms, the step is halved, at most five times, until a further halving changes the predictions by at
    most 3 % of the larger of residual and noise (root mean squares of whitened values). Poor initial values have a
    larger residual and therefore allow a larger error.
    """
    x, problem = problem.initial_unknowns, problem.with_time_step(_MAX_TIME_STEP)
    for _ in range(_MAX_HALVINGS):
        fine = problem.with_time_step(problem.step.time_step / 2)
        error = _half_step_error(problem, fine, x)
        if error is not None and error <= _MAX_STEP_ERROR_FRACTION:
            break
        problem = fine
    return problem.step.time_step


def _half_step_error(problem: EstimationProblem, fine: EstimationProblem, x: Array) -> float | None:
    """Return the rms change of whitened predictions by a finer step, over their residual or 1; None if incomparable."""
    try:
        coarse = problem_with_whitening_at(problem, x)
        if any(own is not None for own in coarse.whitening_filters):
            fine = _with_coarse_weights(fine, coarse)
        before, after = coarse.evaluate(x, False), fine.evaluate(x, False)
    except YidError:
        return None
    rows = coarse.residual_rows, fine.residual_rows
    if not (before.ok and after.ok) or rows[0].measurements != rows[1].measurements:
        return None
    left = before.residual[rows[0].data]
    return float(np.sqrt(np.mean((after.residual[rows[1].data] - left) ** 2)) / max(1.0, np.sqrt(np.mean(left**2))))


@dataclass(frozen=True)
class _CoarseWeights:
    """The whitening filter of a coarser rollout, applied to finer steps. `ratio` fine steps make one coarse step."""

    coarse: ProcessNoiseWhitener
    input_error_model: TorqueAndAngleErrorModel
    ratio: int

    def whiten_residuals_and_estimate_torque_bias(self, rows: Array, push: Array | None) -> tuple[Array, Array]:
        """Whiten with the coarser filter; see `ProcessNoiseWhitener`. `push` is averaged over each coarse step."""
        if push is not None:
            push = np.mean(push.reshape(-1, self.ratio, *push.shape[1:]), axis=1)
        return self.coarse.whiten_residuals_and_estimate_torque_bias(rows, push)


def _with_coarse_weights(fine: EstimationProblem, coarse: EstimationProblem) -> EstimationProblem:
    """Return the finer problem with the input errors and filters of the coarse one, over whole coarse steps."""
    ratio, episodes = round(coarse.step.time_step / fine.step.time_step), []
    filters: list[ProcessNoiseWhitener | None] = []
    for own, other, whitening in zip(fine.episodes, coarse.episodes, coarse.whitening_filters, strict=True):
        errors = other.input_errors and other.input_errors.on_finer_steps(ratio)
        episodes.append(replace(truncate_episode(own, ratio * other.grid.steps), input_errors=errors))
        filters.append(_CoarseWeights(whitening, errors, ratio) if whitening and errors else None)
    return fine.with_episodes(episodes, (), filters)


def finer_settings(problem: EstimationProblem) -> dict[str, list[str]]:
    """Return the settings of twice the links, half the time step, and less encoder noise if this removes no motion."""
    divided = problem.options.divided_links_model
    found = {"links": [*divided.settings]} if divided is not None else {}
    found["time_step"] = [f"problem.time_step: {problem.step.time_step / 2:g}"]
    cutoff, recordings = problem.options.path_cutoff, [episode.recording for episode in problem.episodes]
    if math.isfinite(cutoff) and not has_motion_in_band(recordings, problem.system.prescribed, cutoff / 2, cutoff):
        found["encoder_noise"] = [f"problem.path_cutoff: {cutoff / 2:g}"]
    return found


def parameter_shifts_at_finer_discretisation(
    problem: EstimationProblem, x: Array, at_x: Evaluation, kinds: Sequence[RefinementKind], progress: Progress
) -> tuple[dict[str, EstimateShiftByDiscretisation], dict[str, str]]:
    """Compute how much estimates change with twice the links, half the time step, and more noise of encoders.

    `kinds` selects `links` and `time_step`; with any, noise is added. `x` (nx,) is the estimate, `at_x` its evaluation
    with Jacobian. Returns the shifts by shared free parameter, and by kind a note if it failed or would remove a
    quarter of the misfit.
    """
    found: dict[str, dict[str, float]] = {}
    notes, settings = dict[str, str](), finer_settings(problem)
    for key in kinds:
        words = _REFINEMENT_DESCRIPTIONS[key]
        finer = abbreviated_names_text(settings.get(key, ()))
        if key == "links" and not _has_divisible_links(problem):
            continue
        progress.begin_stage(f"trying {words}", 2.5, 2.7)
        try:
            own = _gauss_newton_step_in_finer_model(_refined_problem(problem, key), problem, x, at_x)
        except YidError as error:
            own = error.what
        if isinstance(own, str):
            remedy = f"To see it, set {finer}, run `solve` again and compare the estimates."
            usable = "The estimates may be used, but their ± leaves this error out."
            notes[key] = f"Whether {words} would change the estimates is unknown: {own}. {usable} {remedy}"
        else:
            found[key], left, _ = own
            excess, rest = (max(float(r @ r) - len(r), 0.0) for r in (at_x.residual, left))
            if excess - rest > max(_MIN_NOTED_SHARE * excess, _MIN_NOTED_FALL * len(left)):
                said = f"{words} would remove {100 * (1 - rest / excess):.0f} % of the error beyond noise".capitalize()
                notes[key] = f"{said}. First set {finer}, and run `solve` again."
    if kinds and (moved := _shifts_by_more_encoder_noise(problem, x)):
        found["encoder_noise"] = moved
    names = problem.shared_parameters if found else ()
    return {n: EstimateShiftByDiscretisation(**{key: own[n] for key, own in found.items()}) for n in names}, notes


def _shifts_by_more_encoder_noise(problem: EstimationProblem, x: Array) -> dict[str, float]:
    """Shifts of the shared estimates by encoder noise. The scatter of draws counts half. Empty without such noise."""
    moves = unknown_shifts_by_more_encoder_noise(problem, x)
    shifts = {name: moves[:, problem.unknown_names.index(name)] for name in problem.shared_parameters if len(moves)}
    return {name: math.copysign(math.hypot(own.mean(), own.std() / 2), own.mean()) for name, own in shifts.items()}


def _refined_problem(
    problem: EstimationProblem,
    what: RefinementKind,
    held_out: Sequence[Recording] = (),
    step: Step | None = None,
    effects: Sequence[EffectBase] = (),
) -> _FinerModel:
    options, fine = problem.options, problem.options.divided_links_model
    if what == "time_step" or fine is None:
        return _FinerModel(problem.with_time_step(problem.step.time_step / 2))
    recordings = [episode.recording for episode in problem.episodes]
    factors = fine.parameter_factors
    if step is None:
        step = step_with_time_step(fine.build_step(problem.step.is_compiled, effects), problem.step.time_step)
    priors = {name: std * factors.get(name, 1.0) for name, std in options.prior_stds.items()}
    joint = options.multivariate_prior.with_parameters_scaled_by(factors)
    options = replace(options, prior_stds=priors, multivariate_prior=joint)
    # also the centre of priors
    known = dict(zip(problem.system.parameters.names, map(float, problem.theta), strict=True))
    values = {name: known[name] * factors.get(name, 1.0) for name in step.system.parameters.names if name in known}
    made = EstimationProblem(step, recordings, problem.free, options, values, held_out, like=problem)
    return _FinerModel(made, factors, _fine_joints_by_coarse_joint(problem.system, step.system))


def estimates_widened_by_discretisation_error(
    estimates: Mapping[str, ParameterEstimate],
    found: Mapping[str, EstimateShiftByDiscretisation],
    sizes: Mapping[str, float],
) -> dict[str, ParameterEstimate]:
    """Return estimates whose standard deviations, intervals and verdicts include the discretisation error.

    `found` holds the shifts of the estimates at finer discretisations. Shifts below the standard deviation are ignored.
    A verdict can only get worse. `sizes` are typical sizes, as in `inference.uncertainty.parameter_verdict`.
    """
    counted, ranks = dict(estimates), ("identifiable", "weak", "not_identifiable")
    for name, own in found.items():
        entry = counted[name]
        std = _std_with_shifts(entry.std, [move for move in astuple(own) if move is not None])
        if not entry.free or not std > entry.std:
            continue
        verdict, said = entry.verdict, verdict_by_relative_std(entry.value, std, sizes.get(name, 0.0))
        if verdict in ranks and said in ranks:
            verdict = max(verdict, said, key=ranks.index)
        interval = entry.interval
        if interval is not None:
            further = _NORMAL_QUANTILE_95 * math.sqrt(std**2 - entry.std**2)
            low, high = interval
            low = None if low is None else max(low - further, entry.lower)
            interval = low, None if high is None else min(high + further, entry.upper)
        if verdict == "not_identifiable":
            std, interval = math.inf, None
        counted[name] = replace(entry, std=std, verdict=verdict, interval=interval)
    return counted


def min_gap_by_grasp_at_robot_posture(
    system: System, configuration: Mapping[str, float], theta: Array, near: Array | None = None
) -> dict[str, float]:
    """Compute the smallest distance [m] of the two points of each grasp: the robot is fixed, the object bends freely.

    `configuration` holds the driven and prescribed coordinates by name [rad or m]. `theta` are all parameters; only
    lengths matter. The search starts at the configuration `near` (n,), if given, and at random ones.
    """
    if not system.grasps:
        return {}
    known = [system.mechanism.joint_index(name) for name in configuration]
    free = [i for i in range(system.n_coordinates) if i not in known]
    full = np.zeros(system.n_coordinates)
    full[known] = list(configuration.values())
    with CASADI_LOCK:
        (q, kinematics), inner = system.symbols_and_kinematics, system.effect_internal_coordinate_symbols.values()
        phi = ca.vertcat(*(grasp.constraint_residual(kinematics)[:3] for grasp in system.grasps))
        # a small stiffness prevents the search from winding up the object
        rows = ca.densify(ca.vertcat(phi, 1e-4 * q[free]))
        symbols = [q, system.parameters.symbols, ca.vertcat(*inner)]
        function = ca.Function("phi", symbols, [rows, ca.densify(ca.jacobian(rows, q)[:, free])])

    def at(x: Array, part: int) -> Array:
        full[free] = x
        return np.array(function(full, theta, 0)[part])

    best, starts = np.full(phi.numel(), math.inf), [] if near is None else [near[free]]
    starts += [np.random.default_rng(seed).normal(scale=0.1, size=len(free)) for seed in range(4)]
    for start in starts:
        found = scipy.optimize.least_squares(lambda x: at(x, 0).ravel(), start, lambda x: at(x, 1), max_nfev=100)
        best = min(best, found.fun[: phi.numel()], key=np.linalg.norm)
        if np.linalg.norm(best) < 1e-3:
            break
    return {g.name: float(np.linalg.norm(gap)) for g, gap in zip(system.grasps, best.reshape(-1, 3), strict=True)}


_N_CHECKED_NODES, _MIN_CHECKED_NODES = 24, 4  # nodes at which a step is linearised: in total, at least per motion
_MAX_GROWTH_DECADES = 6.0  # growth of an alternating error: from rounding (1e-12) to below the sensors' resolution


@dataclass(frozen=True)
class AlternatingErrorGrowth:
    """The growth of numerical errors that change their sign at every step of a motion.

    A mode of the linearised step alternates if its eigenvalue has a negative real part. Such a mode is a numerical
    artefact, because physical motion keeps its direction for several steps. If the eigenvalue's magnitude exceeds one,
    the integration is unstable, even if Newton's method converges.
    """

    recording_name: str
    growth_decades: float  # powers of ten, over the part of the motion with the largest growth
    max_step_factor: float  # largest growth in one step
    max_growth_time: float  # time of that step from the start of the motion [s]
    time_step: float

    @property
    def keeps_errors_below_resolution(self) -> bool:
        """True if alternating errors grow by at most 10^6, so that they stay below the sensors' resolution."""
        return self.growth_decades <= _MAX_GROWTH_DECADES

    @property
    def stability_message(self) -> str:
        """A sentence that states whether the time step is stable, with a remedy if it is not."""
        step, motion = f"the time step of {self.time_step:g} s is", f"the motion of '{self.recording_name}'"
        if self.keeps_errors_below_resolution:
            return f"{step} stable along {motion}"
        grows = f"small errors grow to 10^{self.growth_decades:.2g} times their size, and 10^{_MAX_GROWTH_DECADES:g} is"
        remedy = f"Set problem.time_step: {self.time_step / 2:g} or less"
        return f"{step} too long for {motion} ({grows} tolerated). {remedy}"


def _error_growth_along(
    step: Step, theta: Array, rollout: Rollout, feedback: TrackingFeedback | None, name: str, looks: int
) -> AlternatingErrorGrowth:
    """Return the growth of alternating errors along a rollout to its first failed step, from `looks` nodes at most."""
    failed = np.flatnonzero(~np.isfinite(rollout.state).all(axis=1))
    steps = (int(failed[0]) if len(failed) else len(rollout.state)) - 1
    at, magnitudes = [], []
    for node in np.unique(np.linspace(0, steps - 1, looks).astype(int)) if steps > 0 else ():
        found = _alternating_mode_magnitude(step, theta, rollout, int(node), feedback)
        if found is None:
            break
        at.append(int(node))
        magnitudes.append(found)
    if not at:
        return AlternatingErrorGrowth(name, 0.0, 0.0, 0.0, step.time_step)
    worst, decades, running = int(np.argmax(magnitudes)), 0.0, 0.0
    for rate in np.log10(np.maximum(np.interp(np.arange(at[-1] + 1), at, magnitudes), 1e-3)):
        running = max(0.0, running + float(rate))  # largest sum over a stretch, zero where all shrink (Kadane)
        decades = max(decades, running)
    return AlternatingErrorGrowth(name, decades, magnitudes[worst], at[worst] * step.time_step, step.time_step)


def _alternating_mode_magnitude(
    step: Step, theta: Array, rollout: Rollout, node: int, feedback: TrackingFeedback | None
) -> float | None:
    """Return the largest |eigenvalue| of A - B K with negative real part at a node, or None if A is not finite."""
    n, fixed = step.system.n_coordinates, list(step.system.prescribed_coordinate_indices)
    state, after = rollout.state[node], rollout.state[node + 1]
    q, p, z, path = state[:n], state[n : 2 * n], state[2 * n :], (state[fixed], after[fixed])
    a, by_torque, _ = step.jacobians(q, p, rollout.torque[node], theta, path, z, names=())
    if feedback is not None:
        a[:, feedback.state_indices] -= by_torque @ feedback.gain[node]
    if not np.isfinite(a).all():
        return None
    moving = np.setdiff1d(np.arange(len(a)), [*fixed, *(n + index for index in fixed)])
    values = np.linalg.eigvals(a[np.ix_(moving, moving)])
    return float(np.max(np.abs(values[values.real < 0]), initial=0.0))


def alternating_error_growth_of_worst_recording(problem: EstimationProblem, x: Array) -> AlternatingErrorGrowth | None:
    """Return the largest growth of alternating errors over all rollouts at `x` (nx,). None if no rollout can start."""
    predictor, system = problem.predictor, problem.system
    found = []
    looks = max(_N_CHECKED_NODES // len(problem.episodes), _MIN_CHECKED_NODES)
    for i, episode in enumerate(problem.episodes):
        theta, offset = problem.unpack_episode_unknowns(x, i)
        theta = predictor.theta_with_episode_values(episode, theta)
        begin = predictor.initial_state_and_derivative(episode, theta, offset, ())
        if begin.failure_message:
            continue
        inputs = predictor.corrected_inputs_with_effect_momentum(episode, theta, (), begin.state)
        feedback = inputs.tracking_feedback_with_corrected_reference(
            episode.tracking_feedback, system.actuated_coordinate_indices, episode.measured_driven_angles
        )
        driven_by = inputs.torque, inputs.prescribed_path, feedback
        rollout = simulate(problem.step, theta, begin.state, episode.grid.steps, *driven_by)
        found.append(_error_growth_along(problem.step, theta, rollout, feedback, episode.name, looks))
    return max(found, key=lambda growth: (growth.growth_decades, growth.max_step_factor), default=None)

"""Planning of motions that best identify parameters or distinguish similar effects."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from yid_ocp.analysis.experiment_design import step_and_measurable_points_with_frames
from yid_ocp.analysis.identifiability import identifiability
from yid_ocp.arrays import Array, BoolArray
from yid_ocp.display import NULL_PROGRESS, Progress, count_with_noun
from yid_ocp.effects import EffectBase, make_effect
from yid_ocp.errors import ConfigError, SolverError, require_known_names
from yid_ocp.inference.uncertainty import MAX_WEAK_RELATIVE_STD, MIN_RELATIVE_STD_TAKEN_AS_INFINITE
from yid_ocp.integrator.step import compile_step_like
from yid_ocp.options import check_option_bounds
from yid_ocp.planning import motion_search
from yid_ocp.planning.joint_paths import FramePositionEvaluator, PlannedMotion, PlanOptions
from yid_ocp.planning.planned_experiment import SplineMotionExperiment
from yid_ocp.problem import EstimationProblem

_UNOBSERVABLE_STDS = 1e-2  # [data stds], for a change of a parameter by its whole value; below, it is unobservable
_RANDOM_COEFFICIENT_STD = 0.3  # of random initial motions, before limits scale them down [rad or m]
_MAX_RELATIVE_SENSITIVITY_CHANGE = 0.05  # for a 1e-4 larger motion; more means that the object snaps
_ACTIVE_LIMIT_FRACTION = 0.98  # fraction of a limit from which the limit counts as reached
_PROBE_AMPLITUDE = 0.05  # largest coefficient of the motion that tests other sensors [rad or m]
_MIN_VISIBLE_MOTION = 1e-4  # of a point, for a change of a parameter by its whole value, to be worth a camera [m]


@dataclass(frozen=True)
class _ParameterPrecision:
    std_recorded: float  # relative standard deviation of the parameter from the existing recordings
    std_planned: float  # from the planned recording alone
    std_combined: float  # from the existing and the planned recordings together
    verdict: str  # from the planned recording alone


@dataclass(frozen=True, eq=False)
class InformativeMotionPlan(PlannedMotion):
    """The best motion of an information search, with the parameter precision and effect distances it should give."""

    parameter_precisions: Mapping[str, _ParameterPrecision]
    # for each pair of effects: distance of the first effect's change of the data from its best imitation by the second
    # effect and all free unknowns [data stds], in the existing recordings and in the planned one; empty without effects
    effect_distances: Mapping[tuple[str, str], tuple[float, float]]
    start_results: tuple[motion_search.MotionSearchResult, ...]  # of the random initial motions, in the order drawn
    active_limits: Mapping[str, tuple[str, ...]]  # joints, springs or frames that reach a limit, by kind of limit
    unobservable_parameters: Mapping[str, str]  # parameters that no motion informs, each with a measurement that would
    unidentifiable_directions: tuple[str, ...]  # sentences on what else the planned recording leaves unidentifiable


def plan_informative_motion(
    problem: EstimationProblem,
    options: PlanOptions,
    values: Mapping[str, float] | None = None,
    effects: Mapping[str, Mapping[str, float]] | None = None,
    progress: Progress = NULL_PROGRESS,
) -> InformativeMotionPlan:
    """Plan the arm motion, within limits, that best identifies parameters or distinguishes effects.

    Raises `ConfigError`, `ModelError` or `DataError` if a parameter or effect does not exist or is unobservable, if no
    motion is possible within the limits, if there is no start equilibrium, or if a sensor has no noise level. Raises
    `SolverError` if the rollout of a motion fails.

    Parameters
    ----------
    problem : EstimationProblem
        Problem whose first recording defines sensors, noise and sample rates of the planned one.
    values : mapping of str to float, optional
        Parameter values at which the motion is optimised. Default: the values of the problem.
    effects : mapping of kind@location to mapping of quantity to value, optional
        Known sizes of the effects to discriminate. Default: typical sizes.
    """
    check_option_bounds(options, "plan")
    known = dict(zip(problem.system.parameters.names, map(float, problem.theta), strict=True)) | dict(values or {})
    progress.begin_stage("building the experiment")
    chosen, rivals = _chosen(problem, options, effects or {})
    composed = problem
    if rivals:  # the problem of the system with all effects, neutral
        system = problem.system.with_effects([make_effect(e.kind, e.location, problem.system) for e in rivals])
        recordings = [episode.recording for episode in problem.episodes]
        extra, step = [name for e in rivals for name in e.parameters.names], compile_step_like(problem.step, system)
        composed = EstimationProblem(step, recordings, problem.free, problem.options, known, (), extra)
    names = (*problem.free, *(name for effect in rivals for name in effect.amplitude_parameter_names))
    shapes = {name: e.parameters[name].value for e in rivals for name in e.shape_parameter_names}
    experiment = SplineMotionExperiment(composed, known | shapes, options, names)
    system, still = experiment.simulator.step.system, experiment.zero_coefficients
    points = FramePositionEvaluator(system, system.point_frames)
    limits = motion_search.PlanResidualAndLimitFunctions(experiment.simulator, options, points, np.zeros(3), still)
    search = motion_search.InformativeMotionSearch(experiment, limits, _criterion(experiment, chosen, rivals))
    _check_room(search)
    seeds = range(options.seed, options.seed + options.n_random_starts)
    begins = [_smooth(experiment, search.shrink_coefficients_to_limits(_random(experiment, seed))) for seed in seeds]
    if not any(np.any(begin) for begin, _ in begins):
        what, allowed = f"none of {len(begins)} random motions keeps the limits", "limits within which arms can move"
        hint = "raise plan.limits.max_acceleration, velocity_fraction or effort_fraction, or plan.duration"
        raise ConfigError(what, where="plan.limits", allowed=allowed, hint=hint)
    unseen = _unseen(experiment, [rows for _, rows in begins])
    _check_seen(chosen, rivals, unseen, experiment)
    found = []
    for i, (begin, _) in enumerate(begins):
        progress.begin_stage(f"improving random motion {i + 1} of {len(begins)}")
        found.append(search.improve_motion(begin, options.max_iterations, progress))
    return _plan(search, found, rivals, unseen)


def _chosen(
    problem: EstimationProblem, options: PlanOptions, sizes: Mapping[str, Mapping[str, float]]
) -> tuple[tuple[str, ...], tuple[EffectBase, ...]]:
    """Parameters to identify, or effects to discriminate."""
    where, sought = "plan.parameters_to_identify", options.parameters_to_identify
    effects = options.effects_to_discriminate
    if sought is not None and effects is not None:
        what, hint = f"{where} and plan.effects_to_discriminate are both given", "set one of them to null"
        raise ConfigError(what, where="plan.effects_to_discriminate", allowed="one of the two", hint=hint)
    if effects is not None:
        return (), _effects(problem, effects, sizes)
    wanted = problem.free if sought is None else sought
    if not wanted:
        what, hint = f"{where} is empty", "list free parameters, or remove the key: then all free ones are used"
        raise ConfigError(what, where=where, allowed=", ".join(problem.free) or "free parameters", hint=hint)
    for name in wanted:
        require_known_names([name], problem.system.parameters.names, "parameter", where, ConfigError)
        if name not in problem.free:
            hint, allowed = f"set parameters.{name}.free: true", ", ".join(problem.free)
            raise ConfigError(f"the parameter '{name}' is not free", where=where, allowed=allowed, hint=hint)
    return wanted, ()


def _effects(
    problem: EstimationProblem, labels: Sequence[str], sizes: Mapping[str, Mapping[str, float]]
) -> tuple[EffectBase, ...]:
    where = "plan.effects_to_discriminate"
    if len(set(labels)) < 2:
        what, hint = f"two effects are needed, but the list has {len(set(labels))}", "list the effects to compare"
        raise ConfigError(what, where=where, allowed="two effects or more, such as joint_coulomb@JOINT", hint=hint)
    there, found = {effect.label for effect in problem.system.effects}, []
    for label in dict.fromkeys(labels):
        kind, _, place = label.partition("@")
        if not place:
            hint = f"write {label}@LOCATION, with the name of a joint, frame or segment"
            raise ConfigError(f"the effect '{label}' has no location", where=where, allowed="KIND@LOCATION", hint=hint)
        if label in there:
            what, allowed = f"the effect {label} is already part of the model", "effects that the model does not have"
            raise ConfigError(what, where=where, allowed=allowed, hint=f"remove {label} from the list")
        found.append(make_effect(kind, place, problem.system, sizes.get(label)))
    return tuple(found)


def _criterion(
    experiment: SplineMotionExperiment, chosen: Sequence[str], rivals: Sequence[EffectBase]
) -> motion_search.MotionSearchCriterion:
    columns = [name.split("[")[0] for name in experiment.sensitivity_column_names]
    parameters = tuple(i for i, name in enumerate(columns) if name in experiment.free_parameters)
    if not rivals:
        return motion_search.DOptimalityCriterion(
            tuple(i for i, name in enumerate(columns) if name in chosen), parameters
        )
    places = tuple(tuple(map(columns.index, effect.amplitude_parameter_names)) for effect in rivals)
    scales = (experiment.scales_of_estimated_unknowns[list(own)][:, None] for own in places)
    sizes = tuple(_size(effect) / scale for effect, scale in zip(rivals, scales, strict=True))
    return motion_search.EffectDiscriminationCriterion(places, sizes, parameters)


def _size(effect: EffectBase) -> Array:
    """Amplitudes of an effect relative to neutral, a case per column: all known ones, else half a range of each one."""
    neutral = effect.neutral_values
    known = np.array([effect.parameters[name].value - neutral[name] for name in effect.amplitude_parameter_names])
    if np.any(known):
        return known[:, None]
    ranges = (effect.prior_ranges[name] for name in effect.amplitude_parameter_names)
    return np.diag([(high - low) / 2 for low, high in ranges])


def _check_room(search: motion_search.InformativeMotionSearch) -> None:
    """Raise `ConfigError` if the arms exceed a velocity, effort or spring limit before they move."""
    mover, still = search.experiment.simulator, search.experiment.zero_coefficients
    values, _ = search.limits.constraints_and_jacobian(mover.simulate_path(still), still)
    if broken := search.limits.worst_value_and_bound_by_violated_limit(values):
        parts = ((what, *passed) for what, passed in broken.items())
        said = "; ".join(f"{what} of {name} is {x:.4g}, limit {bound:.4g}" for what, name, x, bound in parts)
        hint = "widen plan.limits if the robot allows it, or set another plan.start_joint_positions"
        what, allowed = f"the arms exceed their limits before they move: {said}", "a start within all limits"
        raise ConfigError(what, where="plan.limits", allowed=allowed, hint=hint)


def _random(experiment: SplineMotionExperiment, seed: int) -> Array:
    return _RANDOM_COEFFICIENT_STD * np.random.default_rng(seed).normal(size=experiment.zero_coefficients.shape)


def _smooth(experiment: SplineMotionExperiment, w: Array) -> tuple[Array, Array | None]:
    """Scale a motion down until its sensitivities change smoothly with it. Returns the motion and its sensitivities."""
    for _ in range(10):
        rows = experiment.sensitivities_to_unknowns(w)
        there = None if rows is None else experiment.sensitivities_to_unknowns((1.0 + 1e-4) * w)
        if rows is not None and there is not None:
            change = np.linalg.norm(there - rows)
            if change <= _MAX_RELATIVE_SENSITIVITY_CHANGE * np.linalg.norm(rows):
                return w, rows
        w = 0.5 * w
    return w, experiment.sensitivities_to_unknowns(w)


def _unseen(experiment: SplineMotionExperiment, told: Sequence[Array | None]) -> dict[str, float]:
    """Parameters to which no motion's measurements are sensitive, with the largest sensitivity of each [data stds]."""
    norms = [np.linalg.norm(rows, axis=0) for rows in told if rows is not None]
    largest = np.max([np.zeros(len(experiment.sensitivity_column_names)), *norms], axis=0)
    named = zip(experiment.sensitivity_column_names, largest, strict=True)
    hidden = {name: float(size) for name, size in named if size < _UNOBSERVABLE_STDS}
    return {name: size for name, size in hidden.items() if name.split("[")[0] in experiment.free_parameters}


def _check_seen(
    chosen: Sequence[str], rivals: Sequence[EffectBase], unseen: Mapping[str, float], experiment: SplineMotionExperiment
) -> None:
    lost = [name for name in chosen if name in unseen]
    if chosen and len(lost) == len(chosen):
        worst = max(unseen[name] for name in lost)
        what = f"no motion determines {', '.join(lost)}: doubling one changes all readings by {worst:.1g} std at most"
        hint = "; ".join(dict.fromkeys(_would_see(experiment, name, _random(experiment, 0)) for name in lost))
        where = "plan.parameters_to_identify"
        raise ConfigError(what, where=where, allowed="a parameter that changes readings", hint=hint)
    for effect in rivals:
        if all(name in unseen for name in effect.amplitude_parameter_names):
            what = f"{effect.label} is unobservable: a small amplitude of this effect changes no reading of any sensor"
            allowed, hint = "effects that change readings", "remove the effect, or add a sensor that it influences"
            raise ConfigError(what, where="plan.effects_to_discriminate", allowed=allowed, hint=hint)


def _would_see(experiment: SplineMotionExperiment, name: str, w: Array) -> str:
    """Hint on a sensor or grasp with which the parameter `name` would be observable."""
    mover, n = experiment.simulator, experiment.simulator.step.system.n_coordinates
    wide, seen = step_and_measurable_points_with_frames(mover.step)
    w = _PROBE_AMPLITUDE * w / max(float(np.abs(w).max()), _PROBE_AMPLITUDE)
    rolled = mover.simulate_path(w, names=[name])
    if rolled.state_sensitivity is None or not rolled.status.is_converged:
        return f"add another sensor to observe {name}"
    frames = FramePositionEvaluator(wide.system, [sight.name for sight in seen])
    by_q = frames.positions_and_jacobian(rolled.state[:, :n], mover.theta)[1]
    size, unit = abs(mover.theta[wide.system.parameters.index(name)]) or 1.0, wide.system.parameters[name].unit
    moved = size * np.einsum("tiq,tq->ti", by_q, rolled.state_sensitivity[:, :n, 0]).reshape(len(by_q), -1, 3)
    farthest = np.linalg.norm(moved, axis=2).max(0)
    best = int(np.argmax(farthest))
    moved_by = f"{1e3 * farthest[best]:.2g} mm if {name} changes by {size:.3g} {unit}"
    if farthest[best] > _MIN_VISIBLE_MOTION:
        return f"let a camera measure {seen[best].description}, which moves by {moved_by}"
    return "choose another grasp (`yid-ocp identifiability --what-if` ranks some), or set parameters.NAME.free: false"


def _plan(
    search: motion_search.InformativeMotionSearch,
    found: Sequence[motion_search.MotionSearchResult],
    rivals: Sequence[EffectBase],
    unseen: Mapping[str, float],
) -> InformativeMotionPlan:
    experiment = search.experiment
    chosen = max(found, key=lambda one: one.configured_criterion)
    if not np.isfinite(chosen.configured_criterion):
        what = f"the simulation of the model by planned torques failed for all {len(found)} motions"
        hint = "lower plan.limits.max_acceleration, or plan more motions: plan.n_random_starts: 20"
        raise SolverError(what, where="plan", allowed="a motion that the model follows with its torques", hint=hint)
    w, rounds, message = chosen.w, count_with_noun(chosen.n_iterations, "round"), "the motion was found"
    if chosen.final_criterion == chosen.initial_criterion and not chosen.is_converged:
        way = "For a better one, lower plan.limits, or set another plan.start_joint_positions"
        message = f"the search did not improve the best random motion. It may be used with the ± of the table. {way}"
    elif not chosen.is_converged:
        message = f"plan.max_iterations ended the search ({rounds}). Use this motion, or raise the limit"
    precisions, unidentifiable = _parameters(experiment, w)
    hidden = [name for name, own in precisions.items() if name in unseen and own.verdict == "not_identifiable"]
    lost = {name: _would_see(experiment, name, w) for name in hidden}
    return InformativeMotionPlan(
        experiment.simulator,
        w,
        experiment.simulator.simulate_path(w),
        chosen.is_converged,
        message,
        parameter_precisions=precisions,
        effect_distances=_distances(search, rivals, w) if rivals else {},
        start_results=tuple(found),
        active_limits=_active(search, w),
        unobservable_parameters=lost,
        unidentifiable_directions=tuple(words for words, name in unidentifiable.items() if name not in lost),
    )


def _parameters(experiment: SplineMotionExperiment, w: Array) -> tuple[dict[str, _ParameterPrecision], dict[str, str]]:
    """Parameter precisions by recordings, plan and both; directions left open, with what no sensor observes."""
    problem = experiment.configured_problem
    before = identifiability(problem.with_parameter_values(experiment.parameter_values))
    planned = experiment.problem_with_planned_recording_only(w)
    after = identifiability(planned.with_free_parameters_without_recompiling(problem.free))
    shared = [name for name in problem.free if name not in problem.options.local_parameters]
    at = [[entry.parameter_names.index(name) for name in shared] for entry in (before, after)]
    both = sum(entry.fisher_information[np.ix_(i, i)] for entry, i in zip((before, after), at, strict=True))
    values, vectors = np.linalg.eigh(np.atleast_2d(both))
    together = np.sqrt(np.sum(vectors**2 / np.maximum(values, MIN_RELATIVE_STD_TAKEN_AS_INFINITE**-2), axis=1))
    found = {}
    for name, std in zip(shared, together, strict=True):
        first, last = before.parameters[name].std_relative, after.parameters[name].std_relative
        least = min(first, last, float(std) if std < MAX_WEAK_RELATIVE_STD else math.inf)
        found[name] = _ParameterPrecision(first, last, least, after.parameters[name].verdict)
    return found, {entry.words: entry.unobserved_parameter for entry in after.unidentifiable_directions}


def _distances(
    search: motion_search.InformativeMotionSearch, rivals: Sequence[EffectBase], w: Array
) -> dict[tuple[str, str], tuple[float, float]]:
    experiment, criterion, found = search.experiment, search.criterion, {}
    assert isinstance(criterion, motion_search.EffectDiscriminationCriterion)
    recorded, planned = experiment.existing_recording_sensitivities, experiment.planned_recording_sensitivities(w)
    for (i, one), (j, other) in itertools.permutations(enumerate(rivals), 2):
        distances = criterion.imitation_distance(recorded, i, j), criterion.imitation_distance(planned, i, j)
        found[one.label, other.label] = distances
    return found


def _active(search: motion_search.InformativeMotionSearch, w: Array) -> dict[str, tuple[str, ...]]:
    mover, limits, found = search.experiment.simulator, search.limits, {}

    def reached(names: Sequence[str], is_near: BoolArray) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for name, near in zip(names, is_near, strict=True) if near))

    for rows, own in limits.split_values_by_limit_kind(limits.constraints_and_jacobian(mover.simulate_path(w), w)[0]):
        near = (own > _ACTIVE_LIMIT_FRACTION * rows.upper) | (own < _ACTIVE_LIMIT_FRACTION * rows.lower)
        found[rows.description] = reached(rows.row_names, near)
    flat = w.ravel()
    room = np.minimum(search.upper - flat, flat - search.lower).reshape(w.shape).min(0)
    found["position [rad or m]"] = reached(mover.step.system.prescribed, room < 1e-3)
    return {what: names for what, names in found.items() if names}

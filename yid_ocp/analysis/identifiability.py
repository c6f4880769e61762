"""Identifiability of parameters by the Fisher information, with correlations and unidentifiable directions."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np
import threadpoolctl
from numpy.typing import ArrayLike

from yid_ocp.analysis.profile import (
    ParameterProfileLikelihood,
    apply_function_per_parameter_at_optimum,
    compute_profile_likelihood_interval,
    mark_near_zero_estimate_unidentifiable,
)
from yid_ocp.arrays import Array, IntArray
from yid_ocp.display import NULL_PROGRESS, Progress, ReprMixin, ReprTexts, count_with_noun
from yid_ocp.effects import make_effect
from yid_ocp.errors import ConfigError, failed_rollout_error, require_known_names
from yid_ocp.inference import uncertainty
from yid_ocp.inference.linearized_residual import residual_and_jacobian_with_stated_priors
from yid_ocp.inference.whitening import problem_with_whitening_at
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.estimation_problem import checked_unknowns
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.solvers.base import Solution

InitialStateKnowledge = Literal["assumed", "unknown"]

_GRASP_OFFSET_KIND = "grasp_offset"
_GRASP_OFFSET_PREFIX = f"{_GRASP_OFFSET_KIND}@"
GRASP_OFFSET_PRIOR_STD = 0.01  # prior standard deviation of the position of a grasp [m]
_RANK_RTOL = 1e-10  # a column this much smaller than the largest counts as zero when nuisances are eliminated
_MAX_DIRECTION_MISMATCH = 0.05  # between the unit vectors of a direction and of a simple combination
_FINITE_CHANGE_FACTOR = 1.3  # factor on the first parameter in the test of a combination at a finite change
_MAX_LISTED_NAMES = 4  # in a sentence
_MIN_NAMED_SHARE = 0.1  # of the largest change along a determined direction, from which on a parameter is named
_MAX_RELATIVE_DATA_CHANGE = 0.1  # change of the data by a combination over that by one parameter


@dataclass(frozen=True)
class StdsAndVerdictOfParameter:
    """The value, standard deviations and identifiability verdict of one parameter.

    The verdict follows the rules of `inference.uncertainty.parameter_verdict`, as in a solution. `interval` is the 95 %
    profile-likelihood interval, in which all other unknowns are refitted (an open end is None); the verdict agrees with
    it. It is None if it was not requested.
    """

    value: float
    unit: str
    std: float  # in `unit`, with all other unknowns free; infinite without information
    std_relative: float  # `std` over the value, or over the typical size of a value that is zero
    std_alone: float  # relative standard deviation if all other unknowns were known
    verdict: str
    interval: tuple[float | None, float | None] | None = None


@dataclass(frozen=True)
class _ParameterDirection:
    """A direction in the space of relative parameter changes, with its uncertainty and verdict."""

    singular_value: float  # of the whitened sensitivity, with nuisances eliminated [stds per unit change]
    std_relative: float  # reciprocal of the singular value
    components: Mapping[str, float]  # relative change by parameter, together of unit length
    verdict: str
    words: str  # sentence on what the recordings determine along it
    unobserved_parameter: str = ""  # the parameter along it, if no sensor observes it
    hidden_change: str = ""  # in words, if other unknowns imitate it
    hidden_by: str = ""  # these unknowns, with advice


@dataclass(frozen=True, repr=False)
class IdentifiabilityResult(ReprMixin):
    """The identifiability of p free parameters, with correlations, Fisher information and uncertain directions.

    Values and standard deviations in `parameters` are in each parameter's `unit`. Relative standard deviations,
    correlations (p, p) and the Fisher information of relative changes (p, p) are dimensionless.
    """

    parameters: Mapping[str, StdsAndVerdictOfParameter]
    parameter_names: tuple[str, ...]  # in the order of the matrices
    correlations: Array  # shape (p, p), NaN in rows of parameters without information
    fisher_information: Array  # for relative changes, nuisances eliminated, shape (p, p)
    directions: tuple[_ParameterDirection, ...]  # least observable first
    nuisance_names: tuple[str, ...]  # further unknowns, estimated together with the parameters
    chi2_per_dof: float  # if it is above one, its root multiplies the standard deviations at a fit
    profiles: Mapping[str, ParameterProfileLikelihood] = field(default_factory=dict)

    def _summary(self) -> ReprTexts:
        rows = [("parameter", "value", "unit", "")]
        for name, entry in self.parameters.items():
            std = uncertainty.finite_or_none(entry.std)
            value = uncertainty.value_and_uncertainty_text(entry.value, std, verdict=entry.verdict)
            rows.append((name, value, entry.unit, uncertainty.VERDICT_TABLE_TEXTS[entry.verdict]))
        found = sum(entry.verdict == "identifiable" for entry in self.parameters.values())
        return ReprTexts(f"{found} of {count_with_noun(len(self.parameter_names), 'parameter')} found", rows)

    @property
    def unidentifiable_directions(self) -> tuple[_ParameterDirection, ...]:
        """The directions in parameter space that the recordings do not identify."""
        return tuple(entry for entry in self.directions if entry.verdict == "not_identifiable")


def identifiability(
    problem: EstimationProblem,
    solution: Solution | ArrayLike | None = None,
    *,
    start: InitialStateKnowledge = "assumed",
    grasp_std: float | None = None,
    intervals: Iterable[str] | Literal["all"] = (),
    progress: Progress = NULL_PROGRESS,
) -> IdentifiabilityResult:
    """Determine by the Fisher information which free parameters the recordings identify.

    With independent Gaussian noise, the Fisher information is I = J' J, where J = d r/d x is the Jacobian of the
    whitened residual r with respect to the unknowns x. The standard deviation of an unknown is the root of the
    corresponding diagonal entry of the inverse of I, which includes all nuisances (Ljung 1999, System Identification,
    section 7.4; Raue et al. 2009, Bioinformatics 25:1923, doi:10.1093/bioinformatics/btp358). Raises `SolverError` if
    the rollout at the point fails, and `ConfigError` for a point beyond a bound or names in `intervals` that are fixed.

    Parameters
    ----------
    solution : Solution or array_like, optional
        Point of the analysis (a solution of this problem, or its unknown vector); default: the initial values.
    start : "assumed" or "unknown"
        "assumed": initial states as in the problem, so that verdicts equal those of its solution. "unknown": every
        initial state is also estimated, with the problem's prior.
    grasp_std : float, optional
        Prior standard deviation [m] of the fixed `grasp_offset@...` parameters (`system_with_grasp_offset_effects`),
        which are then also estimated; default: grasps are known.
    intervals : iterable of str, or "all"
        Parameters for which a profile-likelihood interval is computed.

    Returns
    -------
    IdentifiabilityResult
        Value, std and verdict of each of p parameters, in its unit; dimensionless correlations and information (p, p).
    """
    names = uncertainty.parameter_unknown_names(problem)
    chosen = (intervals,) if isinstance(intervals, str) else tuple(intervals)
    wanted = names if intervals == "all" else chosen
    require_known_names(wanted, names, "free parameter", "intervals", ConfigError)
    given = unknown_vector_from_solution(problem, solution)
    wide = with_free_starts_and_grasps(problem, start, grasp_std)
    x = wide.pack_unknowns(dict(zip(problem.unknown_names, given, strict=True)))
    # the matrices are small: threads of the linear algebra library cost more than they gain
    with threadpoolctl.threadpool_limits(1):
        as_solved, wide = wide is problem, problem_with_whitening_at(wide, x, rounds=2)
        evaluation = wide.evaluate(x)
        if not evaluation.ok or evaluation.jacobian is None:
            raise failed_rollout_error(evaluation.message, "the initial values" if solution is None else "the solution")
        covariance, chi2 = uncertainty.unknowns_covariance_and_reduced_chi2(wide, evaluation)
        inflation, fit = math.sqrt(max(1.0, chi2)), None
        if solution is None:
            # far from a fit, chi2 is no measure of the noise
            covariance, inflation = covariance / inflation**2, 1.0
        else:
            own = wide if as_solved else problem_with_whitening_at(problem, given, rounds=2)
            solved = evaluation if as_solved else own.evaluate(given)
            fit = uncertainty.assess_goodness_of_fit(own, solved, problem.options.excess_residual_criteria, given)
            covariance = uncertainty.misfit_robust_covariance(wide, evaluation, fit)
        view = _Sensitivities.of(wide, x, evaluation, names, inflation)
        judged = uncertainty.parameter_estimates(wide, x, evaluation, covariance, fit)
        std = np.array([judged[name].std for name in names])
        profiles = _profiles(view, wanted, judged, progress) if wanted else {}
        nuisances = tuple(name for name in wide.unknown_names if name not in names)
        correlations, information = view.correlations(covariance), view.relative.T @ view.relative
        directions = _directions(view, std / view.scale)
    parameters = {}
    for name, value, scale, alone in zip(names, x[view.chosen], view.scale, view.alone, strict=True):
        entry, relative = judged[name], 1.0 / float(alone) if alone > 0 else math.inf
        sizes = entry.std, entry.std / float(scale), relative
        parameters[name] = StdsAndVerdictOfParameter(float(value), entry.unit, *sizes, entry.verdict, entry.interval)
    return IdentifiabilityResult(parameters, names, correlations, information, directions, nuisances, chi2, profiles)


def _profiles(
    view: _Sensitivities, wanted: Sequence[str], judged: dict[str, uncertainty.ParameterEstimate], progress: Progress
) -> dict[str, ParameterProfileLikelihood]:
    """Compute profile likelihoods of the `wanted` parameters about the best fit, and update `judged` by them."""
    problem, sizes = view.problem, uncertainty.typical_parameter_magnitudes(view.problem, view.x)

    def one(
        name: str, best: Array, there: Evaluation
    ) -> tuple[ParameterProfileLikelihood, uncertainty.ParameterEstimate]:
        index, size, entry = problem.unknown_names.index(name), sizes[name.split("[")[0]], judged[name]
        found = compute_profile_likelihood_interval(problem, best, index, float(entry.std), there)
        said = mark_near_zero_estimate_unidentifiable(problem, best, index, entry, size, there)
        if said.verdict == entry.verdict:
            said = uncertainty.apply_profile_interval(entry, found.interval, size)
        return found, said

    progress.begin_stage(f"computing 95 % intervals of {count_with_noun(len(wanted), 'parameter')}")
    pairs = apply_function_per_parameter_at_optimum(one, problem, view.x, wanted, progress)
    judged.update({name: said for name, (_, said) in pairs.items()})
    return {name: profile for name, (profile, _) in pairs.items()}


def system_with_grasp_offset_effects(system: System) -> System:
    """Return the system with a `grasp_offset` effect, with zero offset, at every grasp that has no such effect."""
    there = {effect.location for effect in system.effects if effect.kind == _GRASP_OFFSET_KIND}
    places = [grasp.name for grasp in system.grasps if grasp.name not in there]
    return system.with_effects([make_effect(_GRASP_OFFSET_KIND, place, system) for place in places])


def unknown_vector_from_solution(problem: EstimationProblem, solution: Solution | ArrayLike | None) -> Array:
    """Return the vector of unknowns from a solution or an array (see `checked_unknowns`); default: initial values."""
    if solution is None:
        return problem.initial_unknowns
    if isinstance(solution, Solution):
        # solvers may round beyond a bound
        return problem.pack_unknowns(dict(zip(solution.unknown_names, solution.x, strict=True)))
    return checked_unknowns(problem, solution, "solution")


def with_free_starts_and_grasps(
    problem: EstimationProblem, start: InitialStateKnowledge, grasp_std: float | None
) -> EstimationProblem:
    """Return the problem with initial states (`start` "unknown") and grasp offsets (`grasp_std` given) as unknowns."""
    options, grasps, priors = problem.options, [], dict(problem.options.prior_stds)
    initial = "estimated" if start == "unknown" else options.initial_state
    if grasp_std is not None:
        fixed = (name for name in problem.system.parameters.names if name not in problem.free)
        grasps = [name for name in fixed if name.startswith(_GRASP_OFFSET_PREFIX)]
        priors |= dict.fromkeys(grasps, float(grasp_std))
    if initial == options.initial_state and not grasps:
        return problem
    known = dict(options.known_initial_states)
    values = {name: dict(entry) for name, entry in options.parameters_by_recording.items()}
    if options.initial_state == "fitted_to_points" and start == "unknown":
        # the state fitted to the points becomes the mean of a prior
        for episode in problem.episodes:
            if episode.name not in known and episode.fixed_initial_state is not None:
                known[episode.name] = episode.fixed_initial_state.state
                values.setdefault(episode.name, {}).update(episode.fixed_initial_state.fitted_parameters)
    changed = replace(
        options, initial_state=initial, known_initial_states=known, parameters_by_recording=values, prior_stds=priors
    )
    nominal = dict(zip(problem.system.parameters.names, problem.theta, strict=True))
    recordings = [episode.recording for episode in problem.episodes]
    return EstimationProblem(problem.step, recordings, (*problem.free, *grasps), changed, nominal)


@dataclass(frozen=True)
class _Sensitivities:
    """Sensitivities of the data to p named parameters at one point `x` (nx,), with the `evaluation` there."""

    problem: EstimationProblem
    x: Array
    evaluation: Evaluation
    names: tuple[str, ...]
    chosen: IntArray  # indices of the parameters in x
    scale: Array  # absolute value of each parameter, or its typical size if the value is zero
    inflation: float  # factor on the stated standard deviations of the noise
    by_alone: Array  # whitened, of relative changes with everything else known, shape (nr, p)
    relative: Array  # `by_alone` with nuisances eliminated
    nuisance: Array  # sensitivities of all other unknowns in their scales

    @staticmethod
    def of(
        problem: EstimationProblem, x: Array, evaluation: Evaluation, names: tuple[str, ...], inflation: float
    ) -> _Sensitivities:
        jacobian = residual_and_jacobian_with_stated_priors(problem, evaluation)[1].copy()
        chosen = np.array([problem.unknown_names.index(name) for name in names], int)
        others = np.setdiff1d(np.arange(jacobian.shape[1]), chosen)
        # prior knowledge of the parameters is not information of a sensor
        jacobian[problem.residual_rows.stated_priors, chosen] = 0.0
        scale = np.where(x[chosen] != 0, np.abs(x[chosen]), problem.unknown_scales[chosen])
        unit, nuisance = scale / inflation, jacobian[:, others] * problem.unknown_scales[others]
        own = jacobian[:, chosen]
        relative = _orthogonal_part(own, nuisance) * unit
        return _Sensitivities(problem, x, evaluation, names, chosen, scale, inflation, own * unit, relative, nuisance)

    @property
    def alone(self) -> Array:
        """Norms (p,) of the whitened sensitivities to a relative change of each parameter, if all else is known."""
        return np.linalg.norm(self.by_alone, axis=0)

    def unit(self, name: str) -> str:
        """Return the unit of a parameter, whose name may include a recording in brackets."""
        return self.problem.system.parameters[name.split("[")[0]].unit

    def correlations(self, covariance: Array) -> Array:
        """Return the correlations (p, p) of the parameters, NaN for parameters without information."""
        own = covariance[np.ix_(self.chosen, self.chosen)]
        std = np.sqrt(np.diag(own))
        largest = np.maximum(self.scale, self.problem.unknown_scales[self.chosen])
        std = np.where(std < uncertainty.MIN_RELATIVE_STD_TAKEN_AS_INFINITE * largest, std, np.nan)
        return np.asarray(own / np.outer(std, std))


def _orthogonal_part(columns: Array, explained: Array) -> Array:
    """Return the part of each column that is orthogonal to all columns of `explained`."""
    vectors, singular, _ = np.linalg.svd(explained, full_matrices=False)
    basis = vectors[:, singular > _RANK_RTOL * max(float(singular.max(initial=0.0)), 1e-300)]
    return np.asarray(columns - basis @ (basis.T @ columns))


def _directions(view: _Sensitivities, std: Array) -> tuple[_ParameterDirection, ...]:
    """Return parameters and combinations without information, and informed directions, sorted by their information."""
    relative, count = view.relative, len(view.names)
    hidden = view.alone * uncertainty.MAX_WEAK_RELATIVE_STD < 1.0
    found = [_unseen_direction(view, vector) for vector in np.eye(count)[hidden]]
    rest = np.flatnonzero(~hidden)
    if len(rest):
        _, singular, vectors = np.linalg.svd(relative[:, rest], full_matrices=False)
        sizes, wide = np.zeros(len(rest)), np.zeros((len(rest), count))
        sizes[: len(singular)], wide[: len(vectors), rest] = singular, vectors
        blind = sizes * uncertainty.MAX_WEAK_RELATIVE_STD < 1.0
        if np.any(blind):
            # an orthonormal basis of the complement of the observable directions
            seen, left = wide[~blind][:, rest], np.zeros((int(blind.sum()), count))
            left[:, rest] = np.linalg.svd(np.eye(len(rest)) - seen.T @ seen)[0][:, : len(left)].T
            found += [_unseen_direction(view, vector) for vector in _sparse_basis(left)]
        for size, vector in zip(sizes[~blind], wide[~blind], strict=True):
            found.append(_direction(view, vector, _seen_words(view, float(size), vector, std)))
    return tuple(sorted(found, key=lambda entry: entry.singular_value))


def _direction(view: _Sensitivities, vector: Array, words: str) -> _ParameterDirection:
    vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
    size = float(np.linalg.norm(view.relative @ vector))
    std = 1.0 / size if size > 0 else math.inf
    components = dict(zip(view.names, map(float, vector), strict=True))
    return _ParameterDirection(size, std, components, uncertainty.parameter_verdict(1.0, std), words)


def _sparse_basis(vectors: Array) -> list[Array]:
    rows, open_columns = vectors.copy(), list(range(vectors.shape[1]))
    for i in range(len(rows)):
        block = np.abs(rows[i:][:, open_columns])
        pivot, at = np.unravel_index(int(np.argmax(block)), block.shape)
        column = open_columns.pop(int(at))
        rows[[i, i + int(pivot)]] = rows[[i + int(pivot), i]]
        rows[i] /= rows[i, column]
        others = np.arange(len(rows)) != i
        rows[others] -= np.outer(rows[others, column], rows[i])
    return [row / np.linalg.norm(row) for row in rows]


class _Component(NamedTuple):
    """One parameter's coefficient in a direction of relative parameter changes, with its value and unit."""

    name: str
    coefficient: float
    value: float
    unit: str


# combinations of a and b: text, value v, its relative change by those of a and b, b for v and a new a, if units equal
_Combination = tuple[str, Callable[..., float], Callable[..., tuple[float, float]], Callable[..., float], bool]
_SERIES, _SUM = "1/{a} + 1/{b}, like springs in series", "{a} + {b}, like parallel springs"
_COMBINATIONS: tuple[_Combination, ...] = (
    (_SERIES, lambda a, b: a * b / (a + b), lambda a, b, v: (v / a, v / b), lambda v, n: v * n / (n - v), True),
    (_SUM, lambda a, b: a + b, lambda a, b, v: (a / v, b / v), lambda v, n: v - n, True),
    ("the ratio {a} / {b}", lambda a, b: a / b, lambda a, b, v: (1.0, -1.0), lambda v, n: n / v, False),
    ("the product {a} x {b}", lambda a, b: a * b, lambda a, b, v: (1.0, 1.0), lambda v, n: v / n, False),
)


def _components(view: _Sensitivities, vector: Array) -> list[_Component]:
    parts = zip(view.names, vector.tolist(), view.x[view.chosen].tolist(), map(view.unit, view.names), strict=True)
    return [_Component(*part) for part in parts if abs(part[1]) > 0.05 * np.max(np.abs(vector))]


def _unseen_direction(view: _Sensitivities, vector: Array) -> _ParameterDirection:
    parts = _components(view, vector)
    if float(np.linalg.norm(view.by_alone @ vector)) * uncertainty.MAX_WEAK_RELATIVE_STD >= 1.0:
        change = _change_words(parts)
        cause = _hiding_nuisances(view, vector)
        made = _direction(view, vector, f"these recordings cannot distinguish {change} from {cause}")
        return replace(made, hidden_change=change, hidden_by=cause)
    if len(parts) == 1:
        name = parts[0].name
        return replace(_direction(view, vector, f"{name} is observed by no sensor"), unobserved_parameter=name)
    said = _combination(view, *parts) if len(parts) == 2 and all(part.value > 0 for part in parts) else None
    words = _combination_words(parts) if said is None else f"{_joined([p.name for p in parts])} are determined {said}"
    return _direction(view, vector, words)


def _hiding_nuisances(view: _Sensitivities, vector: Array) -> str:
    others = [name for i, name in enumerate(view.problem.unknown_names) if i not in set(view.chosen)]
    column = (view.by_alone @ vector)[:, None]
    rest = "Begin recordings at rest, set problem.initial_state: equilibrium, and leave out --unknown-start"
    places = {name.partition("@")[2].rpartition(".")[0] for name in others if name.startswith(_GRASP_OFFSET_PREFIX)}
    grasp = f"Measure the position of grasp {', '.join(sorted(places))}, and leave out --unknown-grasp"
    start = f"another initial state. {rest}", "start."
    for words, prefix in (start, (f"another position of the grasp. {grasp}", _GRASP_OFFSET_PREFIX)):
        at = [i for i, name in enumerate(others) if name.startswith(prefix)]
        if np.linalg.norm(_orthogonal_part(column, view.nuisance[:, at])) * uncertainty.MAX_WEAK_RELATIVE_STD < 1.0:
            return words
    return f"another initial state and position of the grasp. {rest}. {grasp}" if places else f"other unknowns. {rest}"


def _moved(view: _Sensitivities, changes: Mapping[str, float]) -> float:
    """Return the change of the data [stds] for other parameter values, after elimination of nuisances."""
    problem, x = view.problem, view.x.copy()
    x[[problem.unknown_names.index(name) for name in changes]] = list(changes.values())
    evaluation = problem.evaluate(x, False, view.evaluation.equilibrium_guesses)
    if not evaluation.ok:
        return math.inf
    rows, change = problem.residual_rows.data, np.zeros((len(view.nuisance), 1))
    moved = evaluation.residual[rows] - view.evaluation.residual[rows]
    change[rows, 0] = moved / problem.stated_rms_noise_of_data_residuals
    return float(np.linalg.norm(_orthogonal_part(change, view.nuisance))) / view.inflation


def _seen_words(view: _Sensitivities, size: float, vector: Array, std: Array) -> str:
    parts = sorted(_components(view, vector), key=lambda part: -abs(part.coefficient))
    parts = [part for part in parts if abs(part.coefficient) > _MIN_NAMED_SHARE * abs(parts[0].coefficient)]
    own = float(std[view.names.index(parts[0].name)])
    spread = own if len(parts) == 1 and math.isfinite(own) else 1.0 / size
    rough = "" if spread <= uncertainty.MAX_IDENTIFIABLE_RELATIVE_STD else " only weakly"
    if len(parts) > 1:
        sign = math.copysign(100 * spread, parts[0].coefficient)
        changes = _joined([f"{sign * part.coefficient:+.2g} %" for part in parts])
        names = _joined([part.name for part in parts])
        return f"{names} are determined{rough} together: one standard deviation changes them by {changes}"
    order = "" if math.isfinite(own) else " to first order"
    return f"{parts[0].name} is determined{rough} (± {uncertainty.percent_number_text(spread)} %{order})"


def _change_words(parts: Sequence[_Component]) -> str:
    changes = [f"{part.name} by {10 * part.coefficient / parts[0].coefficient:+.2g} %" for part in parts]
    return f"a change of {parts[0].name if len(parts) == 1 else _joined(changes)}"


def _combination_words(parts: Sequence[_Component]) -> str:
    """Return a sentence on the combined change of parameters along an unidentifiable direction."""
    order = sorted(parts, key=lambda part: -abs(part.coefficient))
    sizes = ((part.name, 10 * part.coefficient / abs(order[0].coefficient)) for part in order[:_MAX_LISTED_NAMES])
    trade = " with ".join(f"{name} {size:+.2g} %" for name, size in sizes)
    rest = " and matching changes of the others" if len(parts) > _MAX_LISTED_NAMES else ""
    listed = _joined([part.name for part in parts])
    return f"{listed} are determined only together: {trade}{rest} changes no measurement"


def _joined(names: Sequence[str]) -> str:
    if len(names) > _MAX_LISTED_NAMES:
        return f"{', '.join(names[:_MAX_LISTED_NAMES])} and {len(names) - _MAX_LISTED_NAMES} more"
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _combination(view: _Sensitivities, first: _Component, second: _Component) -> str | None:
    """Return the simple combination of two parameters > 0 that the data determine, with its value and ±, or None."""
    direction = np.array([first.coefficient, second.coefficient])
    direction /= np.linalg.norm(direction)
    (a, b), tried = (first.value, second.value), list[tuple[float, str]]()
    new_a = a * _FINITE_CHANGE_FACTOR
    least_seen = 1.0 / (uncertainty.MAX_WEAK_RELATIVE_STD * float(np.linalg.norm(view.relative, 2)))
    stds = np.linalg.pinv(view.relative, least_seen)[[view.names.index(part.name) for part in (first, second)]]
    for words, value_of, gradient_at, partner, same_unit in _COMBINATIONS:
        value = value_of(a, b)
        gradient = np.array(gradient_at(a, b, value))
        preserving = np.array([gradient[1], -gradient[0]])
        mismatch = 1.0 - abs(float(preserving @ direction)) / float(np.linalg.norm(gradient))
        if (same_unit and first.unit != second.unit) or mismatch > _MAX_DIRECTION_MISMATCH**2:
            continue
        new_b = partner(value, new_a)
        if new_b > 0:
            std = abs(value) * float(np.linalg.norm(gradient @ stds))
            size = f"{uncertainty.value_and_uncertainty_text(value, std)} {first.unit if same_unit else 'in SI units'}"
            said = f"only as {words.format(a=first.name, b=second.name)} ({'together ' * same_unit}{size})"
            tried.append((_moved(view, {first.name: new_a, second.name: new_b}), said))
    if not tried:
        return None
    least, best = min(tried, key=lambda entry: entry[0])
    allowed = max(_MAX_RELATIVE_DATA_CHANGE * _moved(view, {first.name: new_a}), 1.0)
    return best if math.isfinite(least) and least <= allowed else None

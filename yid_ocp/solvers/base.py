"""The function `fit_problem`, the solver interface, and the solution with its status and history."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
import threadpoolctl

from yid_ocp.arrays import Array, BoolArray
from yid_ocp.display import ReprMixin, ReprTexts, count_with_noun
from yid_ocp.errors import YidError
from yid_ocp.inference import linearized_residual
from yid_ocp.inference.null_test import DEFAULT_EXCESS_RESIDUAL_CRITERIA
from yid_ocp.inference.uncertainty import (
    MAX_WEAK_RELATIVE_STD,
    VERDICT_TABLE_TEXTS,
    EstimateChecksBeyondFit,
    GoodnessOfFit,
    ParameterEstimate,
    assess_goodness_of_fit,
    finite_or_none,
    misfit_robust_covariance,
    parameter_estimates,
    unknowns_covariance_and_reduced_chi2,
    value_and_uncertainty_text,
)
from yid_ocp.inference.whitening import problem_with_sensor_noise_only, problem_with_whitening_at
from yid_ocp.options import check_option_bounds
from yid_ocp.problem.episodes import EpisodePrediction
from yid_ocp.problem.estimation_problem import EstimationProblem
from yid_ocp.problem.evaluation import EquilibriumGuesses, Evaluation
from yid_ocp.problem.options import ExcessResidualCriteria
from yid_ocp.problem.predictions import ChannelPrediction, channel_predictions
from yid_ocp.registry import Registry
from yid_ocp.solvers.initial_guess import start_vectors_toward_other_minima, unknowns_with_neutral_effects_activated

log = logging.getLogger(__name__)


class Status(str, Enum):
    """How a solver ended: `stopped` by a callback, `stalled` if no step lowers the cost or the step is unstable."""

    CONVERGED = "converged"
    ITERATION_LIMIT = "iteration_limit"
    STOPPED = "stopped"
    STALLED = "stalled"
    FAILED = "failed"


@dataclass(frozen=True)
class Iterate:
    """An accepted iterate of a solver, with cost, gradient norm, evaluations and seconds since the start."""

    iteration: int
    cost: float
    x: Array
    gradient_norm: float  # largest scaled component of the projected gradient
    n_evaluations: int  # evaluations of the problem so far
    seconds: float
    note: str = ""  # special conditions, such as a shortened horizon


@dataclass(frozen=True, repr=False)
class Solution(ReprMixin):
    """The solution of an estimation problem, with estimates, covariance, goodness of fit and history.

    Attributes
    ----------
    message : str
        Why the search ended, and what to try if it did not converge.
    x : ndarray, shape (nx,)
        The unknown vector of lowest cost, in the order of `unknown_names`: parameters in their own units, initial
        coordinates [rad or m], initial momenta [N m s or N s].
    covariance : ndarray, shape (nx, nx)
        Covariance of `x` from the data and stated priors, without the weak prior. It is scaled by chi2 per degree of
        freedom above one. If the model does not explain the data, it includes the misfit
        (`uncertainty.misfit_robust_covariance`).
    parameters : dict of str to ParameterEstimate
        Free parameters shared by all recordings, and the fixed parameters of the model. Value, std, bounds and interval
        are in the estimate's `unit`.
    cost : float
        Half the sum of squared whitened residuals and priors [1].
    history : tuple of Iterate
        Cost [1], unknowns (nx,) and seconds [s] of every accepted iterate.
    wall_time : float
        Duration of the search [s].
    evaluation, problem : Evaluation or None, EstimationProblem or None
        Evaluation at `x`; the problem with its whitening filters at `x`.
    checks : EstimateChecksBeyondFit, optional
        Checks by `yid_ocp.solve`. Without them, standard deviations include errors of the data and the misfit only.
    """

    status: Status
    message: str
    unknown_names: tuple[str, ...]
    x: Array
    covariance: Array
    parameters: dict[str, ParameterEstimate]
    cost: float
    goodness_of_fit: GoodnessOfFit
    history: tuple[Iterate, ...]
    n_evaluations: int
    wall_time: float
    evaluation: Evaluation | None
    solver_name: str
    problem: EstimationProblem | None = None
    checks: EstimateChecksBeyondFit | None = None

    def _summary(self) -> ReprTexts:
        free = {name: entry for name, entry in self.parameters.items() if entry.free}
        words, rows = {}, [("parameter", "value", "unit", "")]
        for name, e in free.items():
            words[name] = value_and_uncertainty_text(e.value, finite_or_none(e.std), e.interval, verdict=e.verdict)
            rows.append((name, words[name], e.unit, VERDICT_TABLE_TEXTS[e.verdict]))
        told = [f"{name} = {words[name]} {e.unit}" for name, e in free.items() if e.verdict == "identifiable"][:3]
        count = len(free) - len(told)
        rest = f"and {count_with_noun(count, 'more parameter')}" if told else f"none of {count} parameters found"
        more, chi2 = rest if count else "", self.goodness_of_fit.chi2_per_dof
        fit = f"chi2 per degree of freedom {chi2:.3g}" if math.isfinite(chi2) else self.message
        how = f"{self.status.value.replace('_', ' ')} by {self.solver_name}"
        left_out = ("from links and time step",) if self.checks is None else self.checks.uncounted_errors
        uncounted = f"± without the error {' and '.join(left_out)}" if left_out and free else ""
        return ReprTexts(", ".join(filter(None, (how, *told, more, fit, uncounted))), rows)

    @property
    def n_iterations(self) -> int:
        """The number of accepted steps."""
        return max(len(self.history) - 1, 0)

    @property
    def std(self) -> dict[str, float]:
        """The standard deviation of every shared free parameter."""
        return {name: entry.std for name, entry in self.parameters.items() if entry.free}

    @cached_property
    def episode_predictions(self) -> tuple[EpisodePrediction | str, ...]:
        """Each recording's prediction from its torques minus estimated offsets, or the message of a failed rollout."""
        if self.evaluation is None or self.problem is None or not self.problem.has_process_noise:
            return () if self.evaluation is None else self.evaluation.episode_predictions
        problem = problem_with_sensor_noise_only(self.problem)
        found = problem.evaluate(self.x, False, self.evaluation.equilibrium_guesses)
        if found.ok:
            return found.episode_predictions
        predict, pairs = problem.predictor.predict_episode, enumerate(problem.episodes)
        return tuple(predict(episode, *problem.unpack_episode_unknowns(self.x, i), False) for i, episode in pairs)

    def channel_measurements_and_predictions(self) -> tuple[ChannelPrediction, ...]:
        """The measured and predicted samples of all recorded channels at the estimate. Empty if not evaluated."""
        pairs = zip(() if self.problem is None else self.problem.episodes, self.episode_predictions, strict=False)
        known = [(episode, result) for episode, result in pairs if not isinstance(result, str)]
        return tuple(sample for pair in known for sample in channel_predictions(*pair))


IterationCallback = Callable[[Iterate], None]


class StopSearch(Exception):  # noqa: N818
    """An exception for callbacks, which ends the search at its last iterate. Its text becomes the message."""


@dataclass(frozen=True)
class SolverResult:
    """The raw result of a solver: status, message, best unknown vector `x` and history."""

    status: Status
    message: str
    x: Array
    history: tuple[Iterate, ...]
    n_evaluations: int
    equilibrium_guesses: EquilibriumGuesses | None = None  # start equilibria at `x`, if known
    evaluation: Evaluation | None = None  # at `x`, with Jacobian, if the solver has computed it
    stopped_at_noise_level: bool = False  # many steps lowered the cost negligibly compared with the noise
    stopped_by_callback: bool = False  # the callback raised `StopSearch`


@runtime_checkable
class Solver(Protocol):
    """The interface of a solver, which is a frozen dataclass of settings, registered under its name.

    Optional attributes and their defaults: `needs_rollout` (True), whether the rollout must succeed at the start;
    `uses_process_noise_covariance` (False), whether the solver can whiten residuals by process noise;
    `estimates_torque_errors` (False), whether torque errors are unknowns; `with_coarse_tolerances` (the solver itself),
    a quicker solver for preliminary searches; `cost_tolerance` (0), the relative change of cost at convergence.
    """

    @property
    def name(self) -> str:
        """The registered name of the solver."""
        ...

    def minimize_cost(
        self, problem: EstimationProblem, start: Array, callback: IterationCallback | None
    ) -> SolverResult:
        """Minimise the problem's cost from the unknown vector `start`. `callback` receives accepted iterates."""
        ...


class SolverWithCheckedSettings:
    """The base class of the package's solvers, which checks the settings in the fields against their bounds."""

    name: ClassVar[str]

    def __post_init__(self) -> None:
        check_option_bounds(self, f"solver {self.name}")


def iteration_limit_message(max_iterations: int, searcher: str = "the search") -> str:
    """Return that a search reached its limit, with advice: twice as much, and at least the default of most solvers."""
    return f"{searcher} reached its limit. Set solver.max_iterations: {max(2 * max_iterations, 200)}"


SOLVERS: Registry[type[Solver]] = Registry("solver")


@dataclass
class AcceptedIterateRecorder:
    """A recorder of a solver's accepted iterates, evaluations and time. It also passes iterates to a callback."""

    callback: IterationCallback | None
    start_time: float = field(default_factory=time.perf_counter)
    n_evaluations: int = 0
    history: list[Iterate] = field(default_factory=list)

    def record_iterate(self, cost: float, x: Array, gradient: float, note: str = "") -> None:
        """Add an accepted iterate to the history and pass it to the callback."""
        seconds = time.perf_counter() - self.start_time
        self.history.append(Iterate(len(self.history), cost, x.copy(), gradient, self.n_evaluations, seconds, note))
        if self.callback is not None:
            self.callback(self.history[-1])

    def solver_result_with_iterates(
        self, status: Status, message: str, x: Array, equilibrium_guesses: EquilibriumGuesses | None = None
    ) -> SolverResult:
        """Make the result of a search that ended at `x`, with the iterates recorded so far."""
        return SolverResult(status, message, x, tuple(self.history), self.n_evaluations, equilibrium_guesses)


# If the rollout fails at the start, shorter horizons are solved first; each result is the start of the next [fraction].
_HORIZON_FRACTIONS = (0.06, 0.12, 0.25, 0.5)
# A fit with more chi2 per degree of freedom may be a wrong minimum (a soft object has several equilibrium shapes). It
# is repeated from these multiples of the initial values, and the best fit is kept.
_POOR_CHI2_PER_DOF = 5.0
_INITIAL_VALUE_RESTART_FACTORS = (4.0, 2.0, 10.0)
# If all of these fits are poor, other multiples are predicted. The best one is a start where it beats every fit.
_FAR_FACTORS = (1e-2, 3e-2, 0.1, 0.3, 30.0, 100.0, 300.0, 1000.0)
# With process noise, a wrong minimum can have a chi2 per degree of freedom of only 1.03. Another start is tried if a
# relative std is between the first number and that of no information, or if value over start is below the second.
_LOOSE_RELATIVE_STD, _COLLAPSED_FRACTION = 0.1, 0.02
# If the arm folds the object for a moment, minima can be close together. If the model does not explain the recording,
# the best fit is multiplied by these factors and tried again: a stiffer object folds less.
_NEARBY_START_FACTORS = (1.25, 1.6)
# With process noise, residuals are whitened anew after every step, at most this often. Short steps [stds] keep gains
# and need not lower the cost; the last step is negligible. Positive unknowns fall by no more than this factor.
_MAX_LINEARIZATIONS, _SHORT_STEP_STDS, _LAST_STEP_STDS, _LEAST_FACTOR, _MIN_STEP_FRACTION = 15, 1.0, 0.01, 0.1, 0.2
# Another start leads to the best fit's minimum if it comes this near [stds] without this gain of the cost and with less
# than twice the rise of the linear model, and to a worse minimum above this multiple of the best fit's cost.
_SAME_MINIMUM_STDS, _MIN_COST_GAIN_OF_START, _MAX_COST_RATIO_OF_START = 2.0, 0.005, 1.15


def fit_problem(
    problem: EstimationProblem,
    solver: Solver | None = None,
    initial_unknowns: Sequence[float] | None = None,
    callback: IterationCallback | None = None,
    limits: ExcessResidualCriteria = DEFAULT_EXCESS_RESIDUAL_CRITERIA,
    restarts: bool = True,
    verdicts: bool = True,
) -> Solution:
    """Fit an estimation problem and return estimates with uncertainties and verdicts.

    `yid_ocp.solve` (`analysis.estimation`) adds the discretisation error and checks of the fit. Without
    `initial_unknowns`, free effects start with a small amplitude (`unknowns_with_neutral_effects_activated`). If the
    rollout fails at the start (a soft object snaps, an arm falls), the problem is first solved over a short horizon,
    which then grows. Solvers that can whiten by process noise are followed by steps with renewed whitening. The same
    whitening applies to the result if torque errors are unknowns. A search without convergence raises no error.

    Parameters
    ----------
    solver : Solver, optional
        Default: `GaussNewton()`.
    initial_unknowns : sequence of float, optional
        Default: the initial unknowns of the problem.
    callback : callable, optional
        Receives every `Iterate`; it can raise `StopSearch`.
    limits : ExcessResidualCriteria
        Criteria for a residual that exceeds noise.
    restarts : bool
        Whether a poor fit is repeated from other initial values.
    verdicts : bool
        Whether loosely known parameters are evaluated at the ends of their intervals. If not, verdicts are provisional.
    """
    with threadpoolctl.threadpool_limits(1):  # threads cost more than they save for small matrices
        if initial_unknowns is None:
            start = unknowns_with_neutral_effects_activated(problem, problem.initial_unknowns)
        else:
            start = np.clip(np.asarray(initial_unknowns, float), *problem.bounds)
        search = _MultiStartSearch(problem, solver or SOLVERS["gauss_newton"](), callback, start)
        if restarts:
            search.restart(start, limits)
        return search.solution(limits, verdicts)


@dataclass(frozen=True)
class _Fit:
    result: SolverResult
    evaluation: Evaluation  # at the end of the search
    weighted: EstimationProblem  # with whitening filters at the end of the search
    n_evaluations: int
    history: Sequence[Iterate]


class _MultiStartSearch:
    """Fits from several starts; the best fit is kept."""

    def __init__(
        self, problem: EstimationProblem, solver: Solver, callback: IterationCallback | None, start: Array
    ) -> None:
        self._problem, self._solver, self._callback = problem, solver, callback
        self._begun, self._n_starts = time.perf_counter(), 1
        self._fits = [_fit_from(problem, solver, start, callback)]

    @property
    def _best(self) -> _Fit:
        return min(self._fits, key=lambda fit: fit.evaluation.cost)

    def restart(self, first: Array, limits: ExcessResidualCriteria) -> None:
        """Fit again from other starts if the best fit is poor, uncertain or may be a local minimum."""
        noisy, most = self._problem.has_process_noise, 1 + len(_INITIAL_VALUE_RESTART_FACTORS)
        for factor in _INITIAL_VALUE_RESTART_FACTORS:
            if _good_fit(self._problem, self._best.evaluation):
                break
            self._try_multiple(first, factor, most)
        if not _good_fit(self._problem, self._best.evaluation):
            evaluate = self._best.weighted.evaluate
            cost, factor = min((evaluate(self._multiple(first, far), False).cost, far) for far in _FAR_FACTORS)
            if cost < self._best.evaluation.cost:
                self._try_multiple(first, factor, self._n_starts + 1)
        once = len(self._fits) == 1 and noisy and _accounts_for_process_noise(self._solver)
        if once and np.any(_doubtful(self._best, first)):
            self._try_multiple(first, _INITIAL_VALUE_RESTART_FACTORS[0], 2)
        if not uses_process_noise_covariance(self._solver):
            return
        most = self._n_starts + len(_NEARBY_START_FACTORS)
        for factor in _NEARBY_START_FACTORS if noisy else ():
            best = self._best
            if not best.evaluation.ok or assess_goodness_of_fit(best.weighted, best.evaluation, limits).explains:
                break
            self._try(self._multiple(best.result.x, factor), f"best fit times {factor:g}", most)
        minima = start_vectors_toward_other_minima(self._best.weighted, self._best.evaluation, self._best.result.x)
        most = self._n_starts + len(minima)
        for near in minima:
            self._try(near, "another local minimum", most)

    def _try_multiple(self, first: Array, factor: float, most: int) -> None:
        self._try(self._multiple(first, factor), f"initial values times {factor:g}", most)

    def _multiple(self, x: Array, factor: float) -> Array:
        return np.where(self._problem.positive_unknowns_mask, np.clip(x * factor, *self._problem.bounds), x)

    def _try(self, x: Array, what: str, most: int) -> None:
        if any(fit.result.stopped_by_callback for fit in self._fits):
            return
        self._n_starts += 1
        note = f"start {self._n_starts} of at most {most}: {what}"
        log.info("starting again: %s", note)
        try:
            again = self._fit_from_other_start(x, note)
        except YidError as error:
            # a failed restart must not lose the present fit
            log.info("no fit from there: %s", error)
            return
        self._fits.append(replace(again, history=[replace(entry, note=note) for entry in again.history]))

    def _fit_from_other_start(self, x: Array, note: str) -> _Fit:
        """The fit from `x`. With process noise, a coarse search with the best fit's whitening goes first.

        If that search ends at the best fit or a worse minimum, the best fit is returned.
        """
        best, coarse = self._best, getattr(self._solver, "with_coarse_tolerances", None)
        callback = _noting(self._callback, note)
        if coarse is None or not (best.evaluation.ok and self._problem.has_process_noise):
            return _fit_from(self._problem, self._solver, x, callback)
        noted, reached = callback or (lambda entry: None), list[bool]()
        # along an unknown that the data hardly inform the better end counts, beyond the solver's own tolerance
        least = max(_MIN_COST_GAIN_OF_START, getattr(self._solver, "cost_tolerance", 0.0) * best.evaluation.cost)

        def watched(entry: Iterate) -> None:
            noted(entry)
            distance = linearized_residual.step_norm_in_stds(best.evaluation, entry.x - best.result.x)
            if distance < _SAME_MINIMUM_STDS and -(distance**2) - least < best.evaluation.cost - entry.cost < least:
                reached.append(True)
                raise StopSearch

        near = _minimize_cost(coarse, best.weighted, x, watched)
        is_worse = bool(near.history) and near.history[-1].cost > _MAX_COST_RATIO_OF_START * best.evaluation.cost
        if near.status == Status.FAILED or not (is_worse or near.stopped_by_callback):
            return _fit_from(self._problem, self._solver, near.x, callback)
        same = replace(best.result, stopped_by_callback=near.stopped_by_callback and not reached)
        return replace(best, result=same, n_evaluations=near.n_evaluations, history=near.history)

    def solution(self, limits: ExcessResidualCriteria, verdicts: bool) -> Solution:
        result, finish, problem = self._best.result, self._best.evaluation, self._best.weighted
        fit = assess_goodness_of_fit(problem, finish, limits, result.x if verdicts else None)
        covariance = misfit_robust_covariance(problem, finish, fit)
        estimates = parameter_estimates(problem, result.x, finish, covariance, fit if verdicts else None)
        found = *self._status_and_message(), problem.unknown_names, result.x, covariance, estimates, finish.cost, fit
        history = tuple(entry for one in self._fits for entry in one.history)
        count, seconds = sum(one.n_evaluations for one in self._fits), time.perf_counter() - self._begun
        return Solution(*found, history, count, seconds, finish if finish.ok else None, self._solver.name, problem)

    def _status_and_message(self) -> tuple[Status, str]:
        result, finish, solver = self._best.result, self._best.evaluation, self._solver
        status = result.status
        many = len(self._fits) > 1 and result.status == Status.CONVERGED
        message = result.message + f" (best of {len(self._fits)} starts)" * many
        if self._problem.has_process_noise and not _accounts_for_process_noise(solver):
            message += ". Weights and ± ignore noise of the torques or angles that move the model. Use gauss_newton"
        constant = any(episode.has_biases_treated_as_noise for episode in self._problem.episodes)
        if constant and not getattr(solver, "needs_rollout", True):
            message += ". Its weights ignore constant errors of sensors and clocks. gauss_newton includes them"
        if not finish.ok:
            return Status.FAILED, finish.message
        is_stationary = linearized_residual.is_stationary_point
        ended = result.stopped_at_noise_level or is_stationary(self._best.weighted, result.x, finish)
        if status == Status.CONVERGED and not ended:
            stopped = f"the search stopped where the cost still falls ({message})"
            return Status.STALLED, f"{stopped}. Set a smaller tolerance, other initial values or another solver"
        return status, message


def _noting(callback: IterationCallback | None, note: str) -> IterationCallback | None:
    if callback is None or not note:
        return callback
    return lambda entry: callback(replace(entry, note=", ".join(filter(None, (note, entry.note)))))


def _minimize_cost(
    solver: Solver, problem: EstimationProblem, x: Array, callback: IterationCallback | None
) -> SolverResult:
    seen: list[Iterate] = []

    def watched(entry: Iterate) -> None:
        seen.append(entry)
        if callback is not None:
            callback(entry)

    try:
        return solver.minimize_cost(problem, x, watched)
    except StopSearch as stop:
        last = seen[-1]
        found = (Status.STOPPED, str(stop), last.x, tuple(seen), last.n_evaluations)
        return SolverResult(*found, stopped_by_callback=True)


def _fit_from(problem: EstimationProblem, solver: Solver, x: Array, callback: IterationCallback | None) -> _Fit:
    """The fit from one start, with shorter horizons first if the rollout fails there."""
    history: list[Iterate] = []
    evaluations, known_at_x = 0, problem.evaluate(x, False) if getattr(solver, "needs_rollout", True) else None
    warm = known_at_x.equilibrium_guesses or None if known_at_x is not None and known_at_x.ok else None
    if known_at_x is not None and not known_at_x.ok:
        longest = max(episode.grid.steps for episode in problem.episodes) * problem.step.time_step
        for fraction in _HORIZON_FRACTIONS:
            note = f"first {fraction * longest:.3g} s"
            try:
                options = replace(problem.options, duration=fraction * longest)
                shorter = problem.with_episodes(problem.episodes, ()).with_options(options)
                if not shorter.evaluate(x, derivatives=False).ok:
                    continue
                part = _minimize_cost(solver, shorter, x, _noting(callback, note))
            except YidError as error:
                # a very short part may be too short for a filter or node, or have no measurements
                log.info("the %s are left out: %s", note, error)
                continue
            x, evaluations = part.x, evaluations + part.n_evaluations
            history += [replace(entry, note=note) for entry in part.history]
            known_at_x = problem.evaluate(x, derivatives=False)
            if known_at_x.ok:
                break
    fitted = problem.has_process_noise and uses_process_noise_covariance(solver)
    coarse = getattr(solver, "with_coarse_tolerances", solver) if fitted else solver
    predictions = () if known_at_x is None else known_at_x.episode_predictions
    weighted = problem_with_whitening_at(problem, x, warm, predictions) if fitted else problem
    result = _minimize_cost(coarse, weighted, x, callback)
    evaluations, history = evaluations + result.n_evaluations, [*history, *result.history]
    if fitted and not result.stopped_by_callback and (at_end := result.evaluation or weighted.evaluate(result.x)).ok:
        search = _RelinearizingSearch(weighted, at_end, coarse)
        result = _minimize_cost(search, weighted, result.x, callback)
        weighted, evaluations = search.weighted, evaluations + result.n_evaluations
        history += result.history
    finish, warm = result.evaluation, result.equilibrium_guesses
    if problem.has_process_noise and not fitted and _accounts_for_process_noise(solver):
        weighted, finish = problem_with_whitening_at(problem, result.x, warm, rounds=2), None
    finish = finish or weighted.evaluate(result.x, equilibrium_guesses=warm)
    return _Fit(result, finish, weighted, evaluations, history)


@dataclass
class _RelinearizingSearch:
    """A search by Gauss-Newton steps with process noise, in which residuals are whitened anew after every step."""

    weighted: EstimationProblem  # about the last iterate
    evaluation: Evaluation
    solver: Solver  # of steps that do not lower the cost
    name: ClassVar[str] = "gauss_newton"

    def minimize_cost(self, _: EstimationProblem, x: Array, callback: IterationCallback | None) -> SolverResult:
        recorder, length = AcceptedIterateRecorder(callback), math.inf
        moved, fraction = np.zeros(len(x)), 1.0  # the last step, as a fraction of a whole one

        def ended(status: Status, message: str) -> SolverResult:
            made = recorder.solver_result_with_iterates(status, message, x, self.evaluation.equilibrium_guesses)
            return replace(made, evaluation=self.evaluation)

        for number in range(_MAX_LINEARIZATIONS):
            guesses, at = self.evaluation.equilibrium_guesses, self.evaluation.episode_predictions
            kept = length < _SHORT_STEP_STDS
            problem = self.weighted = problem_with_whitening_at(self.weighted, x, guesses, at, keep_weights=kept)
            now = self.evaluation = problem.evaluate(x, equilibrium_guesses=guesses)
            recorder.n_evaluations += 1
            if now.jacobian is None:
                return ended(Status.FAILED, now.message)
            (lower, upper), size = problem.bounds, np.maximum(np.abs(x), problem.unknown_scales)
            slope = linearized_residual.max_abs_projected_gradient(x, now.jacobian.T @ now.residual, lower, upper, size)
            recorder.record_iterate(now.cost, x, slope, f"weighting {number + 2} of at most {_MAX_LINEARIZATIONS + 1}")
            step = linearized_residual.size_limited_damped_step(problem, x, now.jacobian, now.residual, 1e-12)
            length = linearized_residual.step_norm_in_stds(now, step)
            if length < _LAST_STEP_STDS:
                return ended(Status.CONVERGED, "the estimates no longer change")
            least = np.where(problem.positive_unknowns_mask, np.maximum(lower, _LEAST_FACTOR * x), lower)
            along, whole = now.jacobian @ moved, now.jacobian @ step
            if np.any(along):
                # if steps alternate, the secant through the last two gives the fraction of this step to take
                alternation = float(along @ whole) / float(along @ along)
                fraction = float(np.clip(1 / max(1 / fraction - alternation, 1.0), _MIN_STEP_FRACTION, 1.0))
            ahead = np.clip(x + fraction * step, least, upper)
            trial = problem.evaluate(ahead, False, guesses)
            recorder.n_evaluations += 1
            if trial.ok and (length < _SHORT_STEP_STDS or trial.cost < now.cost):
                moved, x, self.evaluation = ahead - x, ahead, trial
                continue
            found = self.solver.minimize_cost(problem, x, callback)
            recorder.n_evaluations += found.n_evaluations
            recorder.history += found.history
            length, moved = linearized_residual.step_norm_in_stds(now, found.x - x), np.zeros(len(x))
            x, self.evaluation = found.x, found.evaluation or now
        self.evaluation = self.weighted.evaluate(x, equilibrium_guesses=guesses)
        status = Status.CONVERGED if length < 10 * _LAST_STEP_STDS else Status.ITERATION_LIMIT
        return ended(status, f"the last of {_MAX_LINEARIZATIONS} linearizations moved the unknowns by {length:.2g} std")


def _doubtful(fit: _Fit, first: Array) -> BoolArray:
    """Mask of positive unknowns that the data determine poorly or that are nearly zero compared with their start."""
    x = fit.result.x
    if not fit.evaluation.ok or fit.evaluation.jacobian is None:
        return np.zeros(len(x), bool)
    std = np.sqrt(np.maximum(np.diag(unknowns_covariance_and_reduced_chi2(fit.weighted, fit.evaluation)[0]), 0.0))
    loose = (std > _LOOSE_RELATIVE_STD * np.abs(x)) & (std < MAX_WEAK_RELATIVE_STD * np.abs([x, first]).max(axis=0))
    return fit.weighted.positive_unknowns_mask & (loose | (x < _COLLAPSED_FRACTION * first))


def uses_process_noise_covariance(solver: Solver) -> bool:
    """Return whether a solver can whiten residuals by process noise."""
    return bool(getattr(solver, "uses_process_noise_covariance", False))


def _accounts_for_process_noise(solver: Solver) -> bool:
    return uses_process_noise_covariance(solver) or bool(getattr(solver, "estimates_torque_errors", False))


def _good_fit(problem: EstimationProblem, finish: Evaluation) -> bool:
    """Whether a fit needs no other start: it is good, or its cost has no noise level."""
    if problem.options.weighting == "paper" or not finish.ok:
        return finish.ok
    return unknowns_covariance_and_reduced_chi2(problem, finish)[1] < _POOR_CHI2_PER_DOF

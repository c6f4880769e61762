"""Entry point `solve`, the solver interface, and the solution with its status and history."""

from __future__ import annotations

import importlib
import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
import threadpoolctl
from numpy.typing import NDArray

from yid_ocp.errors import ConfigError, YidError
from yid_ocp.problem.evaluation import Evaluation, WarmStart
from yid_ocp.problem.null_test import USUAL, GapLimits
from yid_ocp.problem.outcome import EpisodeResult
from yid_ocp.problem.problem import EstimationProblem
from yid_ocp.problem.validation import Series, series
from yid_ocp.registry import Registry
from yid_ocp.shown import Shown, Summary, counted
from yid_ocp.solvers.judgement import Estimate, Fit, covariance_of_fit, estimates, judge_fit, uncertainty
from yid_ocp.solvers.linear_model import settled
from yid_ocp.solvers.off_neutral import off_neutral
from yid_ocp.solvers.words import VERDICT_WORDS, finite, parameter_words

if TYPE_CHECKING:
    import pandas

log = logging.getLogger(__name__)

Array = NDArray[np.float64]


class Status(str, Enum):
    """Termination status of a solver."""

    CONVERGED = "converged"
    ITERATION_LIMIT = "iteration_limit"
    STALLED = "stalled"
    FAILED = "failed"


@dataclass(frozen=True)
class Iterate:
    """One accepted iterate of a solver.

    Attributes
    ----------
    iteration : int
    cost : float
    x : ndarray, shape (nx,)
    gradient : float
        Largest scaled component of the projected gradient.
    evaluations : int
        Rollouts of all recordings so far.
    seconds : float
        Wall time so far.
    note : str
        Anything out of the ordinary, such as a shortened horizon.
    """

    iteration: int
    cost: float
    x: Array
    gradient: float
    evaluations: int
    seconds: float
    note: str = ""


@dataclass(frozen=True, repr=False)
class Solution(Shown):
    """Solution of an estimation problem: estimates, covariance, goodness of fit and history.

    Attributes
    ----------
    status : Status
    message : str
        Why it ended, and what to try where it did not converge.
    names : tuple of str
        Unknowns, in the order of `x`.
    x : ndarray, shape (nx,)
        Unknown vector of lowest cost.
    covariance : ndarray, shape (nx, nx)
        From the data and stated priors (the weak prior excluded), scaled by chi2 per degree of freedom above one, and
        counting the misfit where the model does not explain the data (`judgement.counting_misfit`).
    parameters : dict of str to Estimate
        Free parameters shared by all recordings, and the fixed ones that the problem's model has.
    cost : float
    fit : Fit
        Whether the model explains the recordings.
    history : tuple of Iterate
    iterations, evaluations : int
    seconds : float
    evaluation : Evaluation or None
        At `x`.
    method : str
    problem : EstimationProblem, optional
        Problem as solved, whitened at `x`.
    """

    status: Status
    message: str
    names: tuple[str, ...]
    x: Array
    covariance: Array
    parameters: dict[str, Estimate]
    cost: float
    fit: Fit
    history: tuple[Iterate, ...]
    iterations: int
    evaluations: int
    seconds: float
    evaluation: Evaluation | None
    method: str
    problem: EstimationProblem | None = None

    def _summary(self) -> Summary:
        free = {name: entry for name, entry in self.parameters.items() if entry.free}
        words = {name: parameter_words(e.value, finite(e.std), e.interval) for name, e in free.items()}
        rows = [("parameter", "value", "unit", "")]
        rows += [(name, words[name], e.unit, VERDICT_WORDS[e.verdict]) for name, e in free.items()]
        told = [f"{name} = {words[name]} {e.unit}" for name, e in free.items() if e.verdict == "identifiable"][:3]
        more = f"and {counted(len(free) - len(told), 'more parameter')}" if len(free) > len(told) else ""
        fit = f"chi2 per degree of freedom {self.fit.chi2_per_dof:.3g}"
        how = f"{self.status.value.replace('_', ' ')} by {self.method}"
        return Summary(", ".join(filter(None, (how, *told, more, fit))), rows)

    @property
    def std(self) -> dict[str, float]:
        """Standard deviation of every shared free parameter."""
        return {name: entry.std for name, entry in self.parameters.items() if entry.free}

    @cached_property
    def predicted(self) -> tuple[EpisodeResult | str, ...]:
        """Prediction of each recording from its recorded torques minus their offsets; empty without a result.

        A recording whose rollout fails under these torques has the error message in place of a prediction.
        """
        if self.evaluation is None or self.problem is None or not self.problem.disturbed:
            return () if self.evaluation is None else self.evaluation.episodes
        problem = self.problem.weighted_by_sensors()
        found = problem.evaluate(self.x, False, self.evaluation.warm)
        if found.ok:
            return found.episodes
        return tuple(
            problem.predictor.run(episode, *problem.split(self.x, i), False)
            for i, episode in enumerate(problem.episodes)
        )

    def residuals(self) -> tuple[Series, ...]:
        """Measured and predicted samples of every channel of the recordings at `x`; empty without a result."""
        pairs = zip(() if self.problem is None else self.problem.episodes, self.predicted, strict=False)
        return tuple(s for episode, result in pairs if not isinstance(result, str) for s in series(episode, result))

    def to_frame(self) -> pandas.DataFrame:
        """Parameters as a pandas data frame, free ones first: value, std, lower, upper, unit, verdict, free, initial.

        `lower` and `upper` are the 95 % interval, infinite at an open end and where nothing is known.

        Raises
        ------
        ConfigError
            pandas is not installed.
        """
        try:
            pandas = importlib.import_module("pandas")
        except ImportError as error:
            raise ConfigError("pandas is not installed", hint="pip install 'yid-ocp[pandas]'") from error
        entries = sorted(self.parameters.items(), key=lambda entry: not entry[1].free)
        rows = {name: (e.value, e.std, *e.ends, e.unit, e.verdict, e.free, e.initial) for name, e in entries}
        columns = ["value", "std", "lower", "upper", "unit", "verdict", "free", "initial"]
        return pandas.DataFrame.from_dict(rows, orient="index", columns=columns).rename_axis("parameter")


Callback = Callable[[Iterate], None]


@dataclass(frozen=True)
class Outcome:
    """Raw result of a solver: best unknown vector, termination status, message and history.

    `warm` holds guesses of the equilibria at the best point, where known. `worn_out` tells that the search ended
    because many steps reduced the cost negligibly compared with the noise.
    """

    status: Status
    message: str
    x: Array
    history: tuple[Iterate, ...]
    evaluations: int
    warm: WarmStart | None = None
    worn_out: bool = False


@runtime_checkable
class Solver(Protocol):
    """Interface of a solver: a frozen dataclass of settings, registered under its name."""

    @property
    def name(self) -> str:
        """Name under which the solver is registered."""
        ...

    def run(self, problem: EstimationProblem, start: Array, callback: Callback | None) -> Outcome:
        """Minimise the problem's cost from `start`."""
        ...


SOLVERS: Registry[type[Solver]] = Registry("solver")
DEFAULT = "gauss_newton"
"""Name of the default solver."""


@dataclass
class Recorder:
    """Records accepted iterates, counts evaluations and time, and calls the callback."""

    callback: Callback | None
    begun: float = field(default_factory=time.perf_counter)
    evaluations: int = 0
    history: list[Iterate] = field(default_factory=list)

    def accept(self, cost: float, x: Array, gradient: float, note: str = "") -> None:
        """Record an accepted iterate."""
        seconds = time.perf_counter() - self.begun
        entry = Iterate(len(self.history), cost, x.copy(), gradient, self.evaluations, seconds, note)
        self.history.append(entry)
        if self.callback is not None:
            self.callback(entry)


# A start from which the rollout fails is approached over shorter horizons, each the start of the next [fraction].
CONTINUATION = (0.06, 0.12, 0.25, 0.5)
# A fit whose chi2 per degree of freedom exceeds this may be a wrong valley (a soft object has several shapes at rest):
# it is started again from these multiples of the initial values, and the best is kept.
POOR_FIT = 5.0
RESTARTS = (4.0, 2.0, 10.0)
# Beside noise that drives the motion a wrong valley may hide in chi2 per degree of freedom of 1.03. Where anything is
# known worse than this part of its value, or has fallen below that part of its start, another start is tried.
DOUBTFUL, COLLAPSED = 0.1, 0.02
# An arm that folds the object for a moment parts valleys that lie near each other: where the model does not explain the
# recording, starts these factors off the best fit are tried, stiffer ones, with which less folds.
NEARBY = (1.25, 1.6)
# A branch that is seen a few times a second has the phase of several frequencies: what is known worse than this part of
# its value may have other valleys. It is moved by these factors, the others as the fit's covariance says, and where the
# cost then rises by less than this part of what the fit predicts, the search goes on from there.
LOOSE, APART, SHALLOW, OTHERS = 0.03, (1 / 2.5, 1 / 1.6, 1.6, 2.5), 0.2, 2
# Noise that drives the motion is linearised where a pass begins; passes end when one changes nothing.
PASSES = 6
REMEDY = "start nearer, widen the bounds, or use gauss_newton"


def solve(
    problem: EstimationProblem,
    solver: Solver | None = None,
    start: Sequence[float] | None = None,
    callback: Callback | None = None,
    limits: GapLimits = USUAL,
    restarts: bool = True,
) -> Solution:
    """Solve an estimation problem and return estimates with uncertainty and verdicts.

    Free effects begin off their neutral value (`off_neutral`) unless a start is given. Where the rollout fails at the
    start (a soft object snaps, an arm falls), the problem is first solved over its first seconds only, and then over
    longer and longer horizons. A poor fit is started again from other initial values. Where noise drives the motion,
    methods that can weigh residuals by it do so in several passes, its covariance frozen in each
    (`EstimationProblem.weighted_at`); the answer of one that has its errors as unknowns is judged in the same way.

    Parameters
    ----------
    problem : EstimationProblem
    solver : Solver, optional
        `GaussNewton()` when absent.
    start : sequence of float, optional
        Initial unknown vector; the problem's when absent.
    callback : callable, optional
        Called with every `Iterate`.
    limits : GapLimits, optional
        Criteria for a residual that exceeds noise.
    restarts : bool
        Whether a poor fit is started again from other initial values.

    Returns
    -------
    Solution
        Non-convergence raises nothing: see its status and message.
    """
    # the matrices are small: threads of the linear algebra library cost more than they give
    with threadpoolctl.threadpool_limits(1):
        return _solved(problem, solver or SOLVERS[DEFAULT](), start, callback, limits, RESTARTS if restarts else ())


def _solved(
    problem: EstimationProblem,
    solver: Solver,
    start: Sequence[float] | None,
    callback: Callback | None,
    limits: GapLimits,
    restarts: Sequence[float],
) -> Solution:
    begun = time.perf_counter()
    lower, upper = problem.bounds
    first = off_neutral(problem, problem.start) if start is None else np.clip(np.asarray(start, float), lower, upper)
    best, evaluations, history = _attempt(problem, solver, first, callback)
    tried = number = 1

    def try_from(x: Array, what: str, most: int) -> None:
        nonlocal best, evaluations, tried, number
        number += 1
        note = f"start {number} of at most {most}: {what}"
        log.info("starting again: %s", note)
        try:
            again, more, steps = _attempt(problem, solver, x, _noting(callback, note))
        except YidError as error:
            # another start is a chance, never a reason to lose what is there
            log.info("no fit from there: %s", error)
            return
        tried, evaluations = tried + 1, evaluations + more
        history.extend(replace(entry, note=note) for entry in steps)
        if again[1].cost < best[1].cost:
            best = again

    for factor in restarts:
        if _good_fit(problem, best[1]):
            break
        moved = np.where(problem.positive, np.clip(first * factor, lower, upper), first)
        try_from(moved, f"initial values x {factor:g}", 1 + len(restarts))
    once = tried == 1 and restarts and problem.disturbed and carries_noise(solver)
    if once and np.any(_doubtful(best[2], best[1], best[0].x, first)):
        factor = RESTARTS[0]
        moved = np.where(problem.positive, np.clip(first * factor, lower, upper), first)
        try_from(moved, f"initial values x {factor:g}", 2)
    most = number + len(NEARBY)
    for factor in NEARBY if restarts and problem.disturbed and carries_covariance(solver) else ():
        outcome, finish, weighted = best
        if not finish.ok or judge_fit(weighted, finish, limits).explains:
            break
        near = np.where(problem.positive, np.clip(outcome.x * factor, lower, upper), outcome.x)
        try_from(near, f"best fit x {factor:g}", most)
    looks = restarts and carries_covariance(solver)
    valleys = _other_valleys(best[2], best[1], best[0].x) if looks else []
    most = number + len(valleys)
    for near in valleys:
        try_from(near, "another valley", most)
    outcome, finish, weighted = best
    if problem.disturbed and not carries_noise(solver):
        remark = "; weighted by the sensors' noise alone, without the noise that drives the motion"
        outcome = replace(outcome, message=outcome.message + remark)
    if not getattr(solver, "needs_rollout", True) and any(e.has_constant_errors for e in problem.episodes):
        remark = "; weighted without the constant errors that measured efforts may have"
        outcome = replace(outcome, message=outcome.message + remark)
    problem = weighted
    fit = judge_fit(problem, finish, limits)
    covariance = covariance_of_fit(problem, finish, fit)
    status, message = outcome.status, outcome.message
    if not finish.ok:
        status, message = Status.FAILED, finish.message
    elif status == Status.CONVERGED and not (outcome.worn_out or settled(problem, outcome.x, finish)):
        status = Status.STALLED
        message = f"the search stopped where a further step would lower the cost ({message}); {REMEDY}"
    elif tried > 1:
        message += f" (best of {tried} starts)"
    return Solution(
        status,
        message,
        problem.names,
        outcome.x,
        covariance,
        estimates(problem, outcome.x, finish, covariance, fit),
        finish.cost,
        fit,
        tuple(history),
        max(len(history) - 1, 0),
        evaluations,
        time.perf_counter() - begun,
        finish if finish.ok else None,
        solver.name,
        problem,
    )


def _noting(callback: Callback | None, note: str) -> Callback | None:
    """The callback for a part of the search, whose points say which part it is."""
    if callback is None:
        return None
    return lambda entry: callback(replace(entry, note=", ".join(filter(None, (note, entry.note)))))


def _attempt(
    problem: EstimationProblem, solver: Solver, x: Array, callback: Callback | None
) -> tuple[tuple[Outcome, Evaluation, EstimationProblem], int, list[Iterate]]:
    """One run from one start, by shorter horizons where the rollout fails there, and the problem as it was weighted."""
    history: list[Iterate] = []
    evaluations = 0
    if getattr(solver, "needs_rollout", True) and not problem.evaluate(x, derivatives=False).ok:
        longest = max(episode.grid.steps for episode in problem.episodes) * problem.step.time_step
        for fraction in CONTINUATION:
            try:
                shorter = problem.shortened(fraction * longest)
                if not shorter.evaluate(x, derivatives=False).ok:
                    continue
                part = solver.run(shorter, x, _noting(callback, f"first {fraction * longest:.3g} s"))
            except YidError as error:
                # so short a piece may hold too little for a filter or a node, or nothing to compare with
                log.info("the first %.3g s are left out: %s", fraction * longest, error)
                continue
            x, evaluations = part.x, evaluations + part.evaluations
            history += [replace(entry, note=f"first {fraction * longest:.3g} s") for entry in part.history]
            if problem.evaluate(x, derivatives=False).ok:
                break
    passes = PASSES if problem.disturbed and carries_covariance(solver) else 1
    weighted, warm = problem, None
    for number in range(passes):
        weighted = weighted.weighted_at(x, warm) if passes > 1 else problem
        which = f"pass {number + 1} of at most {passes}" if passes > 1 else ""
        outcome = solver.run(weighted, x, _noting(callback, which) if which else callback)
        x, warm, evaluations = outcome.x, outcome.warm, evaluations + outcome.evaluations
        history += outcome.history
        # the second pass is the first about torque offsets that are not guessed
        if number and len(outcome.history) < 2:
            break
    if problem.disturbed and passes == 1 and carries_noise(solver):
        # it had the errors themselves as unknowns; what is judged is their likelihood about its answer
        weighted = problem.weighted_at(x, warm, rounds=2)
    return (outcome, weighted.evaluate(outcome.x, warm=outcome.warm), weighted), evaluations, history


def _doubtful(problem: EstimationProblem, finish: Evaluation, x: Array, first: Array) -> NDArray[np.bool_]:
    """Positive unknowns that the data inform, but loosely, and those that have all but vanished."""
    if not finish.ok or finish.jacobian is None:
        return np.zeros(len(x), bool)
    std = np.sqrt(np.maximum(np.diag(uncertainty(problem, finish)[0]), 0.0))
    loose = (std > DOUBTFUL * np.abs(x)) & (std < 100 * np.abs(first))
    return problem.positive & (loose | (x < COLLAPSED * first))


def _other_valleys(problem: EstimationProblem, finish: Evaluation, x: Array) -> list[Array]:
    """Starts from which a loosely known unknown may go to another value than the one found, the likeliest first."""
    if not finish.ok or finish.jacobian is None or not problem.disturbed:
        return []
    covariance, _ = uncertainty(problem, finish)
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    found: list[tuple[float, Array]] = []
    # what is hardly known stays where it is
    known = std < np.abs(x)
    for i in np.flatnonzero(problem.positive & known & (std > LOOSE * np.abs(x))):
        for factor in APART:
            along = np.where(known, covariance[:, i] / covariance[i, i], 0.0)
            moved = np.clip(x + along * (factor - 1.0) * x[i], *problem.bounds)
            # a stiffness counts by its logarithm where that says less: a slope that fades is no valley
            expected = 0.5 * (min(abs(factor - 1.0), abs(math.log(factor))) * x[i] / std[i]) ** 2
            there = problem.evaluate(moved, derivatives=False, warm=finish.warm)
            rise = there.cost - finish.cost
            if there.ok and expected > 2.0 and rise < SHALLOW * expected:
                found.append((rise, moved))
    found.sort(key=lambda entry: entry[0])
    return [moved for _, moved in found[:OTHERS]]


def carries_covariance(solver: Solver) -> bool:
    """Whether a solver can whiten residuals by process noise."""
    return bool(getattr(solver, "carries_covariance", False))


def carries_noise(solver: Solver) -> bool:
    """Whether a solver accounts for process noise, by its covariance or with the errors as unknowns."""
    return carries_covariance(solver) or bool(getattr(solver, "errors_are_unknowns", False))


def _good_fit(problem: EstimationProblem, finish: Evaluation) -> bool:
    """Whether a fit needs no other start: good, or with a cost that says nothing of noise."""
    if problem.options.weighting == "paper":
        return finish.ok
    return finish.ok and uncertainty(problem, finish)[1] < POOR_FIT


def projected_gradient(x: Array, gradient: Array, lower: Array, upper: Array, scale: Array) -> float:
    """Infinity norm of the scaled gradient without components that push against a bound."""
    free = ~(((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0)))
    return float(np.max(np.abs(scale * gradient)[free], initial=0.0))

"""What all solvers share: the solution, its history, statuses, uncertainty and verdicts, and the entry point."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Protocol, runtime_checkable

import numpy as np
import threadpoolctl
from numpy.typing import NDArray

from yid_ocp.problem.evaluation import Evaluation, WarmStart
from yid_ocp.problem.problem import EstimationProblem
from yid_ocp.registry import Registry

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

IDENTIFIABLE = 0.1
WEAK = 4.0


class Status(str, Enum):
    """How a solver ended."""

    CONVERGED = "converged"
    ITERATION_LIMIT = "iteration_limit"
    STALLED = "stalled"
    FAILED = "failed"


@dataclass(frozen=True)
class Iterate:
    """One accepted point.

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


@dataclass(frozen=True)
class Estimate:
    """One parameter after the fit.

    Attributes
    ----------
    value, std : float
        In `unit`; `std` is infinite where the data do not inform the parameter.
    unit : str
    initial, lower, upper : float
    free : bool
    verdict : str
        identifiable (relative standard deviation up to 10 %), weak (up to 400 %), not_identifiable, or fixed.
    """

    value: float
    std: float
    unit: str
    initial: float
    lower: float
    upper: float
    free: bool
    verdict: str


@dataclass(frozen=True)
class Solution:
    """Outcome of an identification.

    Attributes
    ----------
    status : Status
    message : str
        Why it ended, and what to try where it did not converge.
    names : tuple of str
        Unknowns, in the order of `x`.
    x : ndarray, shape (nx,)
        Best point so far.
    covariance : ndarray, shape (nx, nx)
        From the data and stated priors (the weak prior excluded), scaled by chi2 per degree of freedom above one.
    parameters : dict of str to Estimate
        Free parameters shared by all recordings, and the fixed ones that the problem's model has.
    cost : float
    chi2_per_dof : float
        NaN for a cost that is not whitened.
    history : tuple of Iterate
    iterations, evaluations : int
    seconds : float
    evaluation : Evaluation or None
        At `x`.
    method : str
    """

    status: Status
    message: str
    names: tuple[str, ...]
    x: Array
    covariance: Array
    parameters: dict[str, Estimate]
    cost: float
    chi2_per_dof: float
    history: tuple[Iterate, ...]
    iterations: int
    evaluations: int
    seconds: float
    evaluation: Evaluation | None
    method: str

    @property
    def std(self) -> dict[str, float]:
        """Standard deviation of every shared free parameter."""
        return {name: entry.std for name, entry in self.parameters.items() if entry.free}


Callback = Callable[[Iterate], None]


@dataclass(frozen=True)
class Outcome:
    """What a method's own loop returns: the best point, why it stopped, and how it got there.

    `warm` is where the equilibria of the best point are looked for, as far as the method knows.
    """

    status: Status
    message: str
    x: Array
    history: tuple[Iterate, ...]
    evaluations: int
    warm: WarmStart | None = None


@runtime_checkable
class Solver(Protocol):
    """A method with its settings; a frozen dataclass registered under its name."""

    @property
    def name(self) -> str:
        """Under which it is registered."""
        ...

    def run(self, problem: EstimationProblem, start: Array, callback: Callback | None) -> Outcome:
        """Minimise the problem's cost from `start`."""
        ...


SOLVERS: Registry[type[Solver]] = Registry("solver")


@dataclass
class Recorder:
    """Counts evaluations and time, keeps the history, and tells the callback."""

    callback: Callback | None
    begun: float = field(default_factory=time.perf_counter)
    evaluations: int = 0
    history: list[Iterate] = field(default_factory=list)

    def accept(self, cost: float, x: Array, gradient: float, note: str = "") -> None:
        """Enter an accepted point."""
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
# Noise that drives the motion is linearised where a pass begins; passes end when one changes nothing.
PASSES = 6


def solve(
    problem: EstimationProblem, solver: Solver, start: Sequence[float] | None = None, callback: Callback | None = None
) -> Solution:
    """Run a solver on a problem and say what was found, how sure, and what was not.

    Where the rollout fails at the start (a soft object snaps, an arm falls), the problem is first solved over its first
    seconds only, and then over longer and longer horizons. A poor fit is started again from other initial values.
    Where noise drives the motion, methods that can weigh residuals by it do so in several passes, its covariance frozen
    in each (`EstimationProblem.weighted_at`).

    Parameters
    ----------
    problem : EstimationProblem
    solver : Solver
    start : sequence of float, optional
        Initial unknown vector; the problem's when absent.
    callback : callable, optional
        Called with every `Iterate`.

    Returns
    -------
    Solution
        Never raises for non-convergence: the status and the best point so far tell.
    """
    # the matrices are small: threads of the linear algebra library cost more than they give
    with threadpoolctl.threadpool_limits(1):
        return _solved(problem, solver, start, callback)


def _solved(
    problem: EstimationProblem, solver: Solver, start: Sequence[float] | None, callback: Callback | None
) -> Solution:
    begun = time.perf_counter()
    lower, upper = problem.bounds
    first = np.clip(problem.start if start is None else np.asarray(start, float), lower, upper)
    best, evaluations, history = _attempt(problem, solver, first, callback)
    tried = 1
    for factor in RESTARTS:
        if _good_fit(problem, best[1]):
            break
        x = np.where(problem.positive, np.clip(first * factor, lower, upper), first)
        log.info("starting again from %g times the initial values", factor)
        again, more, steps = _attempt(problem, solver, x, callback)
        tried, evaluations = tried + 1, evaluations + more
        history += [replace(entry, note=f"start x {factor:g}") for entry in steps]
        if again[1].cost < best[1].cost:
            best = again
    outcome, finish = best
    covariance, chi2 = uncertainty(problem, finish)
    status, message = outcome.status, outcome.message
    if problem.disturbed and not carries_covariance(solver):
        message += "; weighted by the sensors' noise alone, without the noise that drives the motion"
    if not finish.ok:
        status, message = Status.FAILED, finish.message
    elif tried > 1:
        message += f" (best of {tried} starts)"
    return Solution(
        status,
        message,
        problem.names,
        outcome.x,
        covariance,
        estimates(problem, outcome.x, covariance),
        finish.cost,
        chi2,
        tuple(history),
        max(len(history) - 1, 0),
        evaluations,
        time.perf_counter() - begun,
        finish if finish.ok else None,
        solver.name,
    )


def _attempt(
    problem: EstimationProblem, solver: Solver, x: Array, callback: Callback | None
) -> tuple[tuple[Outcome, Evaluation], int, list[Iterate]]:
    """One run from one start, by shorter horizons where the rollout fails there."""
    history: list[Iterate] = []
    evaluations = 0
    if getattr(solver, "needs_rollout", True) and not problem.evaluate(x, derivatives=False).ok:
        longest = max(episode.grid.steps for episode in problem.episodes) * problem.step.time_step
        for fraction in CONTINUATION:
            shorter = problem.shortened(fraction * longest)
            if not shorter.evaluate(x, derivatives=False).ok:
                continue
            part = solver.run(shorter, x, callback)
            x, evaluations = part.x, evaluations + part.evaluations
            history += [replace(entry, note=f"first {fraction * longest:.3g} s") for entry in part.history]
            if problem.evaluate(x, derivatives=False).ok:
                break
    passes = PASSES if problem.disturbed and carries_covariance(solver) else 1
    weighted, warm = problem, None
    for number in range(passes):
        weighted = weighted.weighted_at(x, warm) if passes > 1 else problem
        outcome = solver.run(weighted, x, callback)
        x, warm, evaluations = outcome.x, outcome.warm, evaluations + outcome.evaluations
        history += outcome.history
        # the second pass is the first about torque offsets that are not guessed
        if number and len(outcome.history) < 2:
            break
    return (outcome, weighted.evaluate(outcome.x, warm=outcome.warm)), evaluations, history


def carries_covariance(solver: Solver) -> bool:
    """Whether a method can weigh residuals by noise that drives the motion."""
    return bool(getattr(solver, "carries_covariance", False))


def _good_fit(problem: EstimationProblem, finish: Evaluation) -> bool:
    """Whether a fit needs no other start: good, or with a cost that says nothing of noise."""
    if problem.options.weighting == "paper":
        return finish.ok
    return finish.ok and uncertainty(problem, finish)[1] < POOR_FIT


def uncertainty(problem: EstimationProblem, evaluation: Evaluation) -> tuple[Array, float]:
    """Covariance of the unknowns from data and stated priors, not the weak prior, and chi2 per degree of freedom.

    Directions that the data do not inform get a variance of (1e8 x scale)^2 rather than an infinite one.
    """
    count = len(problem.start)
    if evaluation.jacobian is None or not evaluation.ok:
        return np.full((count, count), np.nan), math.nan
    scale = problem.scales
    residual, jacobian = problem.informing(evaluation)
    jacobian = jacobian * scale
    _, singular, vectors = np.linalg.svd(jacobian, full_matrices=False)
    inverse = np.zeros(count)
    inverse[: len(singular)] = singular
    inverse = 1.0 / np.maximum(inverse, 1e-8)
    basis = np.eye(count) if len(vectors) == 0 else _completed(vectors, count)
    covariance = (basis.T * inverse**2) @ basis * np.outer(scale, scale)
    data = residual[problem.rows.data]
    chi2 = float(data @ data) / max(len(residual) - count, 1)
    return covariance * max(1.0, chi2), chi2


def _completed(vectors: Array, count: int) -> Array:
    if len(vectors) == count:
        return vectors
    rest = np.linalg.svd(np.eye(count) - vectors.T @ vectors)[0][:, : count - len(vectors)]
    return np.vstack([vectors, rest.T])


def verdict(value: float, std: float) -> str:
    """identifiable, weak or not_identifiable, by the relative standard deviation (limits 10 % and 400 %)."""
    if not math.isfinite(std):
        return "not_identifiable"
    relative = std / max(abs(value), 1e-12)
    if relative <= IDENTIFIABLE:
        return "identifiable"
    return "weak" if relative <= WEAK else "not_identifiable"


def estimates(problem: EstimationProblem, x: Array, covariance: Array) -> dict[str, Estimate]:
    """Every parameter of the model with its value, standard deviation and verdict."""
    theta, _ = problem.split(x, 0)
    spread = np.sqrt(np.maximum(np.diag(covariance), 0.0)) if len(covariance) else np.zeros(0)
    result: dict[str, Estimate] = {}
    for i, entry in enumerate(problem.system.parameters):
        free = entry.name in problem.shared
        at = problem.shared.index(entry.name) if free else -1
        std = float(spread[at]) if free else 0.0
        value, initial = float(theta[i]), float(problem.theta[i])
        std = std if std < 1e6 * max(abs(value), abs(initial), 1e-12) else math.inf
        result[entry.name] = Estimate(
            value,
            std,
            entry.unit,
            initial,
            entry.lower,
            entry.upper,
            free,
            verdict(value, std) if free else "fixed",
        )
    return result


def projected_gradient(x: Array, gradient: Array, lower: Array, upper: Array, scale: Array) -> float:
    """Largest component of scale * gradient that does not push against a bound."""
    free = ~(((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0)))
    return float(np.max(np.abs(scale * gradient)[free], initial=0.0))

"""Several methods on one problem: what each found, how sure, at what cost, and whether they agree."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from yid_ocp.analysis.profile import with_intervals
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.null_test import USUAL, GapLimits
from yid_ocp.problem.prediction import EpisodeResult
from yid_ocp.solvers import Iterate, Solution, Status, solve
from yid_ocp.solvers.base import Solver
from yid_ocp.solvers.judgement import IDENTIFIABLE
from yid_ocp.solvers.words import PREDICATES, VERDICT_WORDS

Array = NDArray[np.float64]

NAMES = ("T1.bend", "T1.twist", "T2.bend", "T2.twist", "T3.bend", "T3.twist")
PUBLISHED: dict[str, dict[str, float]] = {
    "single_arm_no_vision": dict(zip(NAMES, (23.780, 0.000, 18.357, 11.103, 3.200, 3.059), strict=True)),
    "single_arm_vision": dict(zip(NAMES, (22.270, 13.593, 10.735, 8.202, 11.511, 9.692), strict=True)),
    "dual_arm_no_vision": dict(zip(NAMES, (19.559, 4.965, 8.575, 10.374, 0.000, 11.287), strict=True)),
    "dual_arm_vision": dict(zip(NAMES, (24.840, 0.000, 12.373, 30.775, 1.406, 24.900), strict=True)),
}
"""The source paper's answers for its four experiments [N m/rad]; its data are not public."""

SAMPLING_PERIOD = 0.02
# Two estimates agree when they differ by less than this many of the larger standard deviation, or by this fraction of
# the value: below that the methods' own stopping rules show.
STDS, FRACTION = 2.0, 0.005


@dataclass(frozen=True)
class MethodRun:
    """One method's outcome.

    Attributes
    ----------
    method : str
    solution : Solution
    whitened_cost : float
        Cost of its answer in the problem's own weighting, so that methods with another cost can be compared.
    held_out : list of (Episode, EpisodeResult or str)
    wall_seconds, cpu_seconds : float
    peak_memory : float
        Largest resident memory of the process during the run [MiB].
    """

    method: str
    solution: Solution
    whitened_cost: float
    held_out: list[tuple[Episode, EpisodeResult | str]]
    wall_seconds: float
    cpu_seconds: float
    peak_memory: float


@dataclass(frozen=True)
class Comparison:
    """All runs, and how they compare.

    Attributes
    ----------
    runs : tuple of MethodRun
    reference : str
        Method of the lowest cost, with which the others are compared.
    agreement : mapping of method to list of str
        One sentence for each identifiable parameter on which the method differs, with the likely reason; empty where
        it agrees.
    explained : tuple of str
        What became of the parameters that the data do not inform, and, where the truth is known, which parameters
        steepest descent left far from it.
    """

    runs: tuple[MethodRun, ...]
    reference: str
    agreement: Mapping[str, list[str]]
    explained: tuple[str, ...]

    @property
    def agree(self) -> bool:
        """Whether every method agrees on every identifiable parameter."""
        return not any(self.agreement.values())


def compare(
    problem: EstimationProblem,
    solvers: Sequence[Solver],
    truth: Mapping[str, float] | None = None,
    callback: Callable[[str, Iterate], None] | None = None,
    limits: GapLimits = USUAL,
) -> Comparison:
    """Run several methods from the same start and say whether they agree.

    Steepest descent gets the paper's cost (points in metres, no noise levels, no weak prior), the others the problem's,
    weighted by the sensors' noise alone where more drives the motion: not every method can carry its covariance.

    Parameters
    ----------
    problem : EstimationProblem
    solvers : sequence of Solver
    truth : mapping of str to float, optional
        Known parameter values.
    callback : callable, optional
        Called with the method's name and every `Iterate`.
    limits : GapLimits, optional
        What makes a residual more than noise.

    Returns
    -------
    Comparison
    """
    runs, problem = [], problem.without_input_errors()
    for solver in solvers:
        own = problem
        if solver.name == "steepest_descent" and problem.options.weighting != "paper":
            own = problem.with_options(replace(problem.options, weighting="paper"))

        def progress(entry: Iterate, name: str = solver.name) -> None:
            if callback is not None:
                callback(name, entry)

        wall, cpu = time.perf_counter(), time.process_time()
        with _Memory() as memory:
            solution = solve(own, solver, callback=progress, limits=limits)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        cost = problem.evaluate(solution.x, derivatives=False).cost
        runs.append(MethodRun(solver.name, solution, cost, own.validate(solution.x), wall, cpu, memory.peak))
    best = min(runs, key=lambda run: run.whitened_cost)
    if best.method != "steepest_descent":
        judged = replace(best, solution=with_intervals(problem, best.solution))
        runs[runs.index(best)] = best = judged
    agreement = {run.method: _differences(run, best) for run in runs}
    return Comparison(tuple(runs), best.method, agreement, tuple(_explanations(runs, best, truth or {})))


def _differences(run: MethodRun, best: MethodRun) -> list[str]:
    sentences = []
    for name, reference in best.solution.parameters.items():
        if reference.verdict != "identifiable":
            continue
        entry = run.solution.parameters[name]
        gap = abs(entry.value - reference.value)
        if gap <= max(STDS * max(entry.std, reference.std), FRACTION * abs(reference.value)):
            continue
        if run.solution.status != Status.CONVERGED:
            why = f"it ended with '{run.solution.status.value}' before reaching the optimum"
        elif run.whitened_cost > best.whitened_cost + 2.0:
            why = "it stopped in another valley of the cost"
        else:
            why = "its cost weighs the measurements otherwise"
        text = f"{name} = {entry.value:.4g}, while {best.method} finds {reference.value:.4g} +- {reference.std:.2g}"
        sentences.append(f"{text}: {why}")
    return sentences


def _explanations(runs: Sequence[MethodRun], best: MethodRun, truth: Mapping[str, float]) -> list[str]:
    """Where methods sent the parameters that are not found, and where the paper's method went wrong."""
    sentences = []
    for name, reference in best.solution.parameters.items():
        if not reference.free or reference.verdict == "identifiable":
            continue
        known = f" (truth {truth[name]:g})" if name in truth else ""
        places = ", ".join(f"{run.method} {run.solution.parameters[name].value:.3g}" for run in runs)
        said = PREDICATES[reference.verdict]
        sentences.append(f"{name}{known} {said}: where it ends is the method's choice ({places})")
    sentences += [_descent_errors(run, best, truth) for run in runs if run.method == "steepest_descent" and truth]
    return sentences


def _descent_errors(run: MethodRun, best: MethodRun, truth: Mapping[str, float]) -> str:
    """Which parameters a method left far from the truth, and whether these are the ones that the data do not tell."""
    known = {name: entry for name, entry in best.solution.parameters.items() if entry.free and name in truth}
    found = {name: run.solution.parameters[name].value for name in known}
    # the same limit makes a standard deviation too large for an identifiable parameter
    wrong = [name for name in known if abs(found[name] - truth[name]) > IDENTIFIABLE * abs(truth[name])]
    verdicts = {name: VERDICT_WORDS[entry.verdict] for name, entry in known.items()}
    hidden = [name for name in known if known[name].verdict != "identifiable"]
    within = f"within {100 * IDENTIFIABLE:.0f} % of the truth"
    if not wrong:
        return f"{run.method} ended {within} everywhere"
    places = ", ".join(f"{name} ({found[name]:.3g} for {truth[name]:.3g}, {verdicts[name]})" for name in wrong)
    text = f"where {run.method} did not end {within}: {places}"
    if wrong == hidden:
        return f"{text}; these are exactly the parameters that are not found"
    seen, lucky = [name for name in wrong if name not in hidden], [name for name in hidden if name not in wrong]
    if seen:
        text += f"; {', '.join(seen)} could be found: the method stopped short ({run.solution.status.value})"
    if lucky:
        text += f"; {', '.join(f'{name} ({verdicts[name]})' for name in lucky)} came out near the truth all the same"
    return text


class _Memory:
    """Largest resident memory of this process while the block runs, sampled by a thread."""

    def __init__(self) -> None:
        self.peak = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> _Memory:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _watch(self) -> None:
        while True:
            self.peak = max(self.peak, _resident())
            if self._stop.wait(SAMPLING_PERIOD):
                return


def _resident() -> float:
    """Resident memory [MiB]; the peak so far where the system does not tell the present one."""
    status = Path("/proc/self/status")
    if status.is_file():
        for line in status.read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmRSS:"):
                return float(line.split()[1]) / 1024.0
    import resource
    import sys

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024.0**2 if sys.platform == "darwin" else 1024.0)

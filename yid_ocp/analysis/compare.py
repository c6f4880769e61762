"""Comparison of estimation methods on one problem: estimates, uncertainty, cost and agreement."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from yid_ocp.analysis.profile import with_profile_intervals
from yid_ocp.inference.null_test import DEFAULT_GAP_CRITERIA, GapCriteria
from yid_ocp.inference.uncertainty import MAX_IDENTIFIABLE_RELATIVE_STD, ParameterEstimate
from yid_ocp.inference.whitening import without_input_errors
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode, EpisodePrediction
from yid_ocp.solvers import GaussNewton, Iterate, Solution, Status, solve
from yid_ocp.solvers.base import Solver, uses_process_noise_covariance
from yid_ocp.solvers.fit_messages import VERDICT_PREDICATES, VERDICT_WORDS

Array = NDArray[np.float64]

_MEMORY_SAMPLING_PERIOD = 0.02
# Two estimates agree when they differ by less than this many of the larger standard deviation, or by this fraction of
# the value: below that the methods' own stopping rules show.
_AGREEMENT_STDS, _AGREEMENT_RTOL = 2.0, 0.005
_ALL_NOISE_LABEL = "all noise"  # what the run is called that weighs residuals by the noise that drives the motion too


@dataclass(frozen=True)
class MethodResult:
    """Solution, cost and computing effort of one estimation method.

    Attributes
    ----------
    method : str
    solution : Solution
    whitened_cost : float
        Cost of its solution in the problem's own weighting, the same for all methods.
    held_out_predictions : list of (Episode, EpisodeResult or str)
    wall_seconds, cpu_seconds : float
    peak_memory_mib : float
        Largest resident memory of the process during the run [MiB].
    """

    method: str
    solution: Solution
    whitened_cost: float
    held_out_predictions: list[tuple[Episode, EpisodePrediction | str]]
    wall_seconds: float
    cpu_seconds: float
    peak_memory_mib: float


@dataclass(frozen=True)
class MethodComparison:
    """Results of all methods on one problem, and where they disagree.

    Attributes
    ----------
    method_results : tuple of MethodRun
    reference_method : str
        Method of the lowest cost, with which the others are compared.
    has_process_noise : bool
        Whether the problem has process noise, which the methods are compared without.
    verdict_solution : Solution
        Solution whose verdicts are reported: the reference's or, with process noise, that of a method that models it.
    verdict_held_out_predictions : list of (Episode, EpisodeResult or str)
        Its predictions of the held-out recordings.
    disagreements : mapping of method to list of str
        One sentence for each identifiable parameter on which the method differs, with the likely reason; empty where
        it agrees.
    explanations : tuple of str
        Sentences on the estimates of unidentifiable parameters and, where the truth is known, on the parameters that
        steepest descent left far from it.
    """

    method_results: tuple[MethodResult, ...]
    reference_method: str
    has_process_noise: bool
    verdict_solution: Solution
    verdict_held_out_predictions: list[tuple[Episode, EpisodePrediction | str]]
    disagreements: Mapping[str, list[str]]
    explanations: tuple[str, ...]

    @property
    def is_consistent(self) -> bool:
        """Whether every method agrees on every identifiable parameter."""
        return not any(self.disagreements.values())


def compare_methods(
    problem: EstimationProblem,
    solvers: Sequence[Solver],
    truth: Mapping[str, float] | None = None,
    callback: Callable[[str, Iterate], None] | None = None,
    limits: GapCriteria = DEFAULT_GAP_CRITERIA,
) -> MethodComparison:
    """Run several methods from the same initial values and compare their estimates.

    Steepest descent gets the paper's cost (points in metres, no noise levels, no weak prior), the others the problem's,
    without process noise, whose covariance not every method can carry. With process noise, the verdicts come from one
    more run of a method that can.

    Parameters
    ----------
    problem : EstimationProblem
    solvers : sequence of Solver
    truth : mapping of str to float, optional
        Known parameter values.
    callback : callable, optional
        Called with the method's name and every `Iterate`.
    limits : GapLimits, optional
        Limits from which a residual counts as more than noise.

    Returns
    -------
    Comparison
    """
    runs, whole, problem = [], problem, without_input_errors(problem)

    def told(name: str, entry: Iterate) -> None:
        if callback is not None:
            callback(name, entry)

    for solver in solvers:
        own = problem
        if solver.name == "steepest_descent" and problem.options.weighting != "paper":
            own = problem.with_options(replace(problem.options, weighting="paper"))

        def progress(entry: Iterate, name: str = solver.name) -> None:
            told(name, entry)

        wall, cpu = time.perf_counter(), time.process_time()
        with _Memory() as memory:
            solution = solve(own, solver, callback=progress, limits=limits, restarts=not whole.has_process_noise)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        cost = problem.evaluate(solution.x, derivatives=False).cost
        runs.append(MethodResult(solver.name, solution, cost, own.predict_held_out(solution.x), wall, cpu, memory.peak))
    best = min(runs, key=lambda run: run.whitened_cost)
    if best.method != "steepest_descent":
        shown = replace(best, solution=with_profile_intervals(problem, best.solution))
        runs[runs.index(best)] = best = shown
    judged, held_out = best.solution, best.held_out_predictions
    if whole.has_process_noise:
        able: Solver = next((solver for solver in solvers if uses_process_noise_covariance(solver)), GaussNewton())
        judged = solve(whole, able, callback=lambda entry: told(_ALL_NOISE_LABEL, entry), limits=limits)
        weighted = judged.problem or whole
        judged, held_out = with_profile_intervals(weighted, judged), weighted.predict_held_out(judged.x)
    agreement = {run.method: _differences(run, best, judged.parameters) for run in runs}
    explained = tuple(_explanations(runs, judged.parameters, truth or {}, whole.has_process_noise))
    return MethodComparison(tuple(runs), best.method, whole.has_process_noise, judged, held_out, agreement, explained)


def _differences(run: MethodResult, best: MethodResult, judged: Mapping[str, ParameterEstimate]) -> list[str]:
    """Where a method is not where the best one is, of the parameters that are found."""
    sentences = []
    for name, reference in best.solution.parameters.items():
        if judged[name].verdict != "identifiable":
            continue
        entry = run.solution.parameters[name]
        gap = abs(entry.value - reference.value)
        if gap <= max(_AGREEMENT_STDS * max(entry.std, reference.std), _AGREEMENT_RTOL * abs(reference.value)):
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


def _explanations(
    runs: Sequence[MethodResult], judged: Mapping[str, ParameterEstimate], truth: Mapping[str, float], disturbed: bool
) -> list[str]:
    """Where methods sent the parameters that are not found, and where the paper's method went wrong."""
    sentences = []
    for name, reference in judged.items():
        if not reference.free or reference.verdict == "identifiable":
            continue
        known = f" (truth {truth[name]:g})" if name in truth else ""
        places = ", ".join(f"{run.method} {run.solution.parameters[name].value:.3g}" for run in runs)
        said = VERDICT_PREDICATES[reference.verdict]
        sentences.append(f"{name}{known} {said}: where it ends is the method's choice ({places})")
    sentences += [
        _descent_errors(run, judged, truth, disturbed) for run in runs if run.method == "steepest_descent" and truth
    ]
    return sentences


def _descent_errors(
    run: MethodResult, judged: Mapping[str, ParameterEstimate], truth: Mapping[str, float], disturbed: bool
) -> str:
    """Which parameters a method left far from the truth, and whether these are the ones that the data do not tell."""
    known = {name: entry for name, entry in judged.items() if entry.free and name in truth}
    found = {name: run.solution.parameters[name].value for name in known}
    # the same limit makes a standard deviation too large for an identifiable parameter
    wrong = [
        name for name in known if abs(found[name] - truth[name]) > MAX_IDENTIFIABLE_RELATIVE_STD * abs(truth[name])
    ]
    verdicts = {name: VERDICT_WORDS[entry.verdict] for name, entry in known.items()}
    hidden = [name for name in known if known[name].verdict != "identifiable"]
    within = f"within {100 * MAX_IDENTIFIABLE_RELATIVE_STD:.0f} % of the truth"
    if not wrong:
        return f"{run.method} ended {within} everywhere"
    places = ", ".join(f"{name} ({found[name]:.3g} for {truth[name]:.3g}, {verdicts[name]})" for name in wrong)
    text = f"where {run.method} did not end {within}: {places}"
    if wrong == hidden:
        return f"{text}; these are exactly the parameters that are not found"
    seen, lucky = [name for name in wrong if name not in hidden], [name for name in hidden if name not in wrong]
    if seen:
        why = "it takes the recorded torques as true" if disturbed else "its cost weighs the measurements otherwise"
        if run.solution.status != Status.CONVERGED:
            why = f"the method stopped short ({run.solution.status.value})"
        text += f"; {', '.join(seen)} could be found: {why}"
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
            if self._stop.wait(_MEMORY_SAMPLING_PERIOD):
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

"""The command `identifiability`: Fisher information of a run's recordings and of changed experiments."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from yid_ocp.analysis.identifiability import (
    GRASP_STD,
    Identifiability,
    StartKnowledge,
    identifiability,
    with_grasp_offsets,
)
from yid_ocp.analysis.profile import small
from yid_ocp.analysis.start_in_motion import safe_start
from yid_ocp.analysis.what_if import Outcome, WhatIf, what_if
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import Run
from yid_ocp.model.system import System
from yid_ocp.parallel import Workers
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.null_test import GapLimits
from yid_ocp.progress import SILENT, Progress
from yid_ocp.report.summaries import identifiability_summary
from yid_ocp.solvers import Iterate, Solution, Status, solve
from yid_ocp.workflow.build import build_problem, build_step, build_system
from yid_ocp.workflow.command import DONE, FAILED, carry_out, given_workers
from yid_ocp.workflow.doubts import doubts_result
from yid_ocp.workflow.elsewhere import Elsewhere
from yid_ocp.workflow.folder import RunFolder, new_run_folder
from yid_ocp.workflow.second_arm import second_arm

FORMAT = "yid-identifiability/1"


@dataclass(frozen=True)
class Question:
    """Options of an identifiability analysis beyond the run's settings.

    Attributes
    ----------
    at : "solution" or "initial"
        Point at which to judge: where the solver ends, or the initial values, without solving.
    start : "assumed" or "unknown"
        Initial states as the settings have them, so that verdicts are those of `solve`, or all estimated along.
    grasp_std : float or None
        Prior standard deviation of where the grasps sit [m]; None for grasps as the settings have them.
    intervals : "auto", "all" or sequence of str
        Parameters whose interval by profile likelihood is wanted; `auto` for all of a small problem, none of a large
        one.
    what_if : bool
        Whether to rank changes of the experiment.
    """

    at: Literal["solution", "initial"] = "solution"
    start: StartKnowledge = "assumed"
    grasp_std: float | None = None
    intervals: Literal["auto", "all"] | Sequence[str] = "auto"
    what_if: bool = False

    @property
    def flags(self) -> list[str]:
        """The options as command-line flags."""
        names = self.intervals if isinstance(self.intervals, str) else ",".join(self.intervals) or "none"
        said = {
            "--what-if": self.what_if,
            "--initial": self.at == "initial",
            "--unknown-start": self.start == "unknown",
            "--unknown-grasp": self.grasp_std is not None,
        }
        asked = [flag for flag, given in said.items() if given]
        return asked + ([] if names == "auto" else ["--intervals", names])


@dataclass(frozen=True)
class IdentifiabilityOutcome:
    """Result of `run_identifiability`: run folder, result.json's contents and the analysis (None if it failed)."""

    folder: Path
    result: dict[str, Any]
    information: Identifiability | None

    @property
    def ok(self) -> bool:
        """Whether the analysis was possible."""
        return self.information is not None


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    settings = load_config(arguments.config, arguments.overrides)
    names = [name for name in arguments.intervals.split(",") if name]
    asked = Question(
        at="initial" if arguments.initial else "solution",
        start="unknown" if arguments.unknown_start else "assumed",
        grasp_std=GRASP_STD if arguments.unknown_grasp else None,
        intervals={"auto": "auto", "all": "all", "none": ()}.get(arguments.intervals, names),
        what_if=arguments.what_if,
    )

    workers = given_workers(arguments)

    def judged(shown: Progress) -> IdentifiabilityOutcome:
        return run_identifiability(settings, arguments.out, shown, asked, workers)

    outcome = carry_out(judged, identifiability_summary, arguments)
    return DONE if outcome.ok else FAILED


def run_identifiability(
    run: Run,
    out: str | Path | None = None,
    progress: Progress = SILENT,
    question: Question | None = None,
    workers: Workers | Executor | None = None,
) -> IdentifiabilityOutcome:
    """Solve, analyse identifiability and write the run folder.

    Parameters
    ----------
    run : Run
    out : str or Path, optional
        The run folder; see `new_run_folder`.
    progress : Progress, optional
    question : Question, optional
    workers : Workers or Executor, optional
        Who works out intervals, one parameter a task, and the experiments of `what_if`; this process when absent.

    Returns
    -------
    IdentifiabilityOutcome
        Also where the solver failed: the run folder then holds the reason.

    Raises
    ------
    ConfigError, DataError, ModelError, SolverError, OutputError
    """
    asked = question or Question()
    with new_run_folder(run, out, "identifiability") as folder:
        folder.begin(run, "identifiability", asked.flags)
        progress.stage("building the model and its compiled step")
        system = build_system(run)
        problem = build_problem(run, build_step(run, with_grasp_offsets(system)))
        limits = run.diagnosis.of_a_fit
        solution, whole = None, problem
        if asked.at == "solution":
            solved = _solved(run, problem, folder, progress)
            safe = safe_start(problem, run.solver, solved, limits)
            problem, solution = safe.problem, safe.solution
        elsewhere = None
        if workers is not None:
            point = (problem, solution, problem is whole, asked.start, asked.grasp_std)
            elsewhere = Elsewhere.of(workers, folder, run, *point, progress)
        unknown = information = ranking = None
        if solution is None or solution.status != Status.FAILED:
            progress.stage("Fisher information")
            unknown = identifiability(problem, solution, start="unknown", grasp_std=GRASP_STD, limits=limits)
            information = _information(problem, solution, asked, progress, limits, elsewhere)
            if asked.what_if:
                ranking = _ranking(run, system, problem, solution, asked, progress, elsewhere)
        result = identifiability_result(problem, solution, information, unknown, ranking, asked)
        folder.log("end", status=result["status"], message=result["message"])
        written = folder.finish(result)
        folder.report(run, written, progress, problem=problem, solution=solution)
    if elsewhere is not None:
        elsewhere.clear()
    return IdentifiabilityOutcome(folder.path, written, information)


def _solved(run: Run, problem: EstimationProblem, folder: RunFolder, progress: Progress) -> Solution:
    progress.stage(f"solving for {len(problem.start)} unknowns by {run.solver.name}")

    def iterate(entry: Iterate) -> None:
        folder.log("iterate", iteration=entry.iteration, cost=entry.cost, seconds=entry.seconds)
        progress.iterate(entry)

    return solve(problem, run.solver, callback=iterate, limits=run.diagnosis.of_a_fit)


def _information(
    problem: EstimationProblem,
    solution: Solution | None,
    asked: Question,
    progress: Progress,
    limits: GapLimits,
    elsewhere: Elsewhere | None,
) -> Identifiability:
    judged = partial(identifiability, problem, solution, start=asked.start, grasp_std=asked.grasp_std, limits=limits)
    information = judged()
    wanted = _wanted(problem, information, asked)
    if not wanted:
        return information
    if elsewhere is not None and set(wanted) <= set(information.names):
        progress.stage(f"intervals of {len(wanted)} parameters by profile likelihood")
        return elsewhere.with_profiles(information, wanted)
    return judged(intervals=wanted, progress=progress)


def _ranking(
    run: Run,
    system: System,
    problem: EstimationProblem,
    solution: Solution | None,
    asked: Question,
    progress: Progress,
    elsewhere: Elsewhere | None,
) -> WhatIf:
    other = second_arm(run, system)
    return what_if(
        problem,
        solution,
        start=asked.start,
        grasp_std=asked.grasp_std,
        second_arm=None if other is None else with_grasp_offsets(other),
        progress=progress,
        judge=None if elsewhere is None else elsewhere.judge(),
    )


def _wanted(problem: EstimationProblem, information: Identifiability, asked: Question) -> Sequence[str]:
    """Parameters whose intervals are worked out."""
    if asked.intervals not in ("auto", "all"):
        return asked.intervals
    return information.names if asked.intervals == "all" or small(problem) else ()


def identifiability_result(
    problem: EstimationProblem,
    solution: Solution | None,
    information: Identifiability | None,
    unknown: Identifiability | None,
    ranking: WhatIf | None,
    asked: Question,
) -> dict[str, Any]:
    """`yid-identifiability/1` without inputs and versions."""
    result: dict[str, Any] = {
        "format": FORMAT,
        "status": "not_solved" if solution is None else solution.status.value,
        "message": "judged at the initial values" if solution is None else solution.message,
        "at": asked.at,
        "start": asked.start,
        "grasp_std": asked.grasp_std if problem.system.grasps else None,
        "parameters": {},
        "correlations": {"names": [], "matrix": []},
        "directions": [],
        "nuisances": 0,
        "fit": None if solution is None else asdict(solution.fit),
        "doubts": doubts_result(problem.options.doubts),
        "profiles": {},
        "what_if": None,
    }
    if information is None or unknown is None:
        return result
    for name, entry in information.parameters.items():
        unsure = unknown.parameters[name]
        # knowing less makes nothing better known, whatever the interval took back
        spread = max(entry.std_relative, unsure.std_relative)
        own = {"std_relative_unknown": spread, "verdict_unknown": unsure.verdict}
        result["parameters"][name] = asdict(entry) | own
    result["correlations"] = {"names": information.names, "matrix": information.correlations}
    result["directions"] = [asdict(direction) for direction in information.directions]
    result["nuisances"] = len(information.nuisances)
    result["profiles"] = {
        name: {"values": profile.values, "delta_chi2": profile.delta_chi2, "notes": profile.notes}
        for name, profile in information.profiles.items()
    }
    if ranking is not None:
        result["what_if"] = {
            "base": _outcome(ranking.base),
            "singles": [_outcome(entry) for entry in ranking.singles],
            "smallest": [_outcome(entry) for entry in ranking.smallest],
            "greedy": [_outcome(entry) for entry in ranking.greedy],
            "searched": ranking.searched,
        }
    return result


def _outcome(entry: Outcome) -> dict[str, Any]:
    gain = entry.gain if entry.verdicts else None
    return asdict(entry) | {"gain": gain}

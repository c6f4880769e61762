"""The command `compare`: runs several solvers on one problem and tests whether they agree."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from yid_ocp.analysis.compare import Comparison, compare
from yid_ocp.analysis.published import PUBLISHED, published_sentences
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import Run
from yid_ocp.problem import EstimationProblem
from yid_ocp.progress import SILENT, Progress
from yid_ocp.report.pictures import draw_convergence
from yid_ocp.report.summaries import compare_summary
from yid_ocp.solvers import SOLVERS, Iterate
from yid_ocp.solvers.base import Solver
from yid_ocp.workflow.build import build_problem
from yid_ocp.workflow.command import DONE, FAILED, carry_out
from yid_ocp.workflow.doubts import doubts_result
from yid_ocp.workflow.folder import new_run_folder
from yid_ocp.workflow.solve import doubted, solve_result

FORMAT = "yid-compare/1"


@dataclass(frozen=True)
class CompareOutcome:
    """Result of `run_compare`: the run folder, result.json's contents and the comparison."""

    folder: Path
    result: dict[str, Any]
    comparison: Comparison

    @property
    def ok(self) -> bool:
        """Whether any method converged."""
        return any(run.solution.status.value == "converged" for run in self.comparison.runs)


def chosen_solvers(run: Run) -> list[Solver]:
    """Solvers listed in `compare.methods`, with their settings.

    Raises
    ------
    ConfigError
        None at all.
    """
    if not run.compare.methods:
        raise run.refuse("there is no method to compare", "compare", "methods", allowed=", ".join(SOLVERS))
    return list(run.compare.methods.values())


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    settings = load_config(arguments.config, arguments.overrides)
    outcome = carry_out(lambda shown: run_compare(settings, arguments.out, shown), compare_summary, arguments)
    return DONE if outcome.ok else FAILED


def run_compare(run: Run, out: str | Path | None = None, progress: Progress = SILENT) -> CompareOutcome:
    """Run every method, compare, and write the run folder.

    Parameters
    ----------
    run : Run
    out : str or Path, optional
        The run folder; see `new_run_folder`.
    progress : Progress, optional

    Returns
    -------
    CompareOutcome

    Raises
    ------
    ConfigError, DataError, ModelError, OutputError
    """
    solvers = chosen_solvers(run)
    published = published_answers(run)
    with new_run_folder(run, out, "compare") as folder:
        folder.begin(run, "compare")
        progress.stage("building the model and its compiled step")
        problem = build_problem(run)
        truth = _truth(problem)
        current, names = [""], [solver.name for solver in solvers]

        def iterate(name: str, entry: Iterate) -> None:
            if name != current[0]:
                current[0] = name
                count = f", method {names.index(name) + 1} of {len(names)}" if name in names else ""
                progress.stage(f"solving by {name}{count}")
            folder.log("iterate", method=name, iteration=entry.iteration, cost=entry.cost, seconds=entry.seconds)
            progress.iterate(entry)

        comparison = compare(problem, solvers, truth, iterate, run.diagnosis.of_a_fit)
        draw_convergence(folder.path / "convergence.png", comparison)
        own = comparison.judged.problem or problem
        judged, doubts = doubted(own, comparison.judged, comparison.judged_held_out)
        comparison = replace(comparison, judged=judged)
        experiment = run.compare.published
        said = published_sentences(experiment, comparison.judged.parameters, truth) if experiment else ()
        about = {
            "doubts": doubts_result(doubts),
            "published": published,
            "published_explained": list(said),
            "truth": truth,
        }
        written = folder.finish(compare_result(problem, comparison) | about)
        held_out = tuple(comparison.judged_held_out)
        known = {"problem": own, "solution": judged, "held_out": held_out, "more": {"comparison": comparison}}
        folder.report(run, written, progress, **known)
    return CompareOutcome(folder.path, written, comparison)


def compare_result(problem: EstimationProblem, comparison: Comparison) -> dict[str, Any]:
    """`yid-compare/1` without inputs, versions and what is known beside.

    One `yid-solve/1` for each method, with its cost in time, and for the run whose verdicts count, `judged`.
    """
    methods = {}
    for run in comparison.runs:
        methods[run.method] = solve_result(problem, run.solution, run.held_out) | {
            "whitened_cost": run.whitened_cost,
            "wall_seconds": run.wall_seconds,
            "cpu_seconds": run.cpu_seconds,
            "peak_memory_mib": run.peak_memory,
            "disagreements": comparison.agreement[run.method],
        }
    return {
        "format": FORMAT,
        "methods": methods,
        "reference": comparison.reference,
        "agree": comparison.agree,
        "explained": list(comparison.explained),
        "disturbed": comparison.disturbed,
        "judged": solve_result(comparison.judged.problem or problem, comparison.judged, comparison.judged_held_out),
    }


def published_answers(run: Run) -> dict[str, float]:
    """The paper's estimates for the experiment named by `compare.published`; empty where none is named."""
    name = run.compare.published
    if name is None:
        return {}
    if name not in PUBLISHED:
        raise run.refuse(f"the paper has no experiment '{name}'", "compare", "published", allowed=", ".join(PUBLISHED))
    return PUBLISHED[name]


def _truth(problem: EstimationProblem) -> dict[str, float]:
    """Parameter values that the recordings of a virtual experiment carry along."""
    known: dict[str, float] = {}
    for episode in problem.episodes:
        known |= {name: value for name, value in episode.recording.truth.items() if name in problem.free}
    return known

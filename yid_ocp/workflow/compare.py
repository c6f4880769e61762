"""The command `compare_methods`: runs several solvers on one problem and tests whether they agree."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from yid_ocp.analysis.compare import PAPER_ESTIMATES, MethodComparison, compare_methods, explain_paper_estimates
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import RunSettings
from yid_ocp.problem import EstimationProblem
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.report.png_figures import draw_convergence
from yid_ocp.report.summaries import compare_summary
from yid_ocp.solvers import SOLVERS, Iterate, Status
from yid_ocp.solvers.base import Solver
from yid_ocp.workflow.build_problem import build_problem
from yid_ocp.workflow.command_runner import CommandResult, run_and_print
from yid_ocp.workflow.recording_issues import issues_result
from yid_ocp.workflow.run_folder import new_run_folder
from yid_ocp.workflow.solve import solve_result, with_fit_issues

_RESULT_FORMAT = "yid-compare/1"


@dataclass(frozen=True)
class CompareCommandResult(CommandResult):
    """Result of `run_compare` with the comparison; successful where any method converged."""

    comparison: MethodComparison


def _chosen_solvers(run: RunSettings) -> list[Solver]:
    if not run.compare.methods:
        raise run.config_error("there is no method to compare", "compare", "methods", allowed=", ".join(SOLVERS))
    return list(run.compare.methods.values())


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    settings = load_config(arguments.config, arguments.overrides)
    return run_and_print(arguments, lambda shown: run_compare(settings, arguments.out, shown), compare_summary)


def run_compare(
    run: RunSettings, out: str | Path | None = None, progress: Progress = NULL_PROGRESS
) -> CompareCommandResult:
    """Run every method, compare, and write the run folder.

    Raises
    ------
    ConfigError, DataError, ModelError, OutputError
    """
    solvers = _chosen_solvers(run)
    published = _paper_estimates(run)
    with new_run_folder(run, out, "compare") as folder:
        folder.begin_run(run, "compare")
        progress.begin_stage("building the model and its compiled step")
        problem = build_problem(run)
        truth = _truth(problem)
        current, names = [""], [solver.name for solver in solvers]

        def iterate(name: str, entry: Iterate) -> None:
            if name != current[0]:
                current[0] = name
                count = f", method {names.index(name) + 1} of {len(names)}" if name in names else ""
                progress.begin_stage(f"solving by {name}{count}")
            folder.log_event("iterate", method=name, iteration=entry.iteration, cost=entry.cost, seconds=entry.seconds)
            progress.report_iterate(entry)

        comparison = compare_methods(problem, solvers, truth, iterate, run.diagnosis.fit_gap_limits)
        draw_convergence(folder.path / "convergence.png", comparison)
        own = comparison.verdict_solution.problem or problem
        judged, doubts = with_fit_issues(own, comparison.verdict_solution, comparison.verdict_held_out_predictions)
        comparison = replace(comparison, verdict_solution=judged)
        experiment = run.compare.paper_experiment
        said = explain_paper_estimates(experiment, comparison.verdict_solution.parameters, truth) if experiment else ()
        about = {
            "doubts": issues_result(doubts),
            "published": published,
            "published_explained": list(said),
            "truth": truth,
        }
        written = folder.write_result(_compare_result(problem, comparison) | about)
        held_out = tuple(comparison.verdict_held_out_predictions)
        known = {"problem": own, "solution": judged, "held_out": held_out, "section_data": {"comparison": comparison}}
        folder.write_report_page(run, written, progress, **known)
    done = any(run.solution.status == Status.CONVERGED for run in comparison.method_results)
    return CompareCommandResult(folder.path, written, comparison, is_successful=done)


def _compare_result(problem: EstimationProblem, comparison: MethodComparison) -> dict[str, Any]:
    methods = {}
    for run in comparison.method_results:
        methods[run.method] = solve_result(problem, run.solution, run.held_out_predictions) | {
            "whitened_cost": run.whitened_cost,
            "wall_seconds": run.wall_seconds,
            "cpu_seconds": run.cpu_seconds,
            "peak_memory_mib": run.peak_memory_mib,
            "disagreements": comparison.disagreements[run.method],
        }
    return {
        "format": _RESULT_FORMAT,
        "methods": methods,
        "reference": comparison.reference_method,
        "agree": comparison.is_consistent,
        "explained": list(comparison.explanations),
        "disturbed": comparison.has_process_noise,
        "judged": solve_result(
            comparison.verdict_solution.problem or problem,
            comparison.verdict_solution,
            comparison.verdict_held_out_predictions,
        ),
    }


def _paper_estimates(run: RunSettings) -> dict[str, float]:
    name = run.compare.paper_experiment
    if name is None:
        return {}
    if name not in PAPER_ESTIMATES:
        raise run.config_error(
            f"the paper has no experiment '{name}'", "compare", "paper_experiment", allowed=", ".join(PAPER_ESTIMATES)
        )
    return PAPER_ESTIMATES[name]


def _truth(problem: EstimationProblem) -> dict[str, float]:
    known: dict[str, float] = {}
    for episode in problem.episodes:
        known |= {name: value for name, value in episode.recording.true_parameters.items() if name in problem.free}
    return known

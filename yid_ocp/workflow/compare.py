"""The command `compare`: fit one problem by several methods, beside published results of Caldwell et al. (2014)."""

from __future__ import annotations

import math
from pathlib import Path

from yid_ocp.analysis.compare import PAPER_ESTIMATES, compare_methods
from yid_ocp.config.settings import RunSettings
from yid_ocp.display import Progress
from yid_ocp.files import attributes_to_dict
from yid_ocp.inference.uncertainty import EstimateChecksBeyondFit
from yid_ocp.solvers import SOLVERS, Iterate, Status
from yid_ocp.workflow.build_problem import build_problem, issues_to_plain_data
from yid_ocp.workflow.command_runner import CommandOutcome, make_command_function
from yid_ocp.workflow.run_folder import atomic_run_folder
from yid_ocp.workflow.solve import solution_to_result_dict


def _run_compare(run: RunSettings, out: str | Path | None, progress: Progress) -> CommandOutcome[None]:
    """Run and compare all methods, and write the run folder. Successful if any method converged."""
    solvers, experiment = list(run.compare.methods.values()), run.compare.reference_paper_experiment_name
    if not solvers:
        what, allowed = "compare.methods lists no method", ", ".join(SOLVERS)
        hint = "add a method, such as {gauss_newton: {}}, or leave the key out"
        raise run.config_error(what, "compare", "methods", allowed=allowed, hint=hint)
    if experiment is not None and experiment not in PAPER_ESTIMATES:
        what = f"Caldwell et al. (2014) have no experiment '{experiment}'"
        allowed, hint = ", ".join(PAPER_ESTIMATES), "use an allowed name, or leave the key out"
        raise run.config_error(what, "compare", "reference_paper_experiment_name", allowed=allowed, hint=hint)
    with atomic_run_folder(run, out, "compare") as folder:
        folder.record_run_start(run, "compare")
        progress.begin_stage("building the model and its compiled step")
        problem = build_problem(run)
        true = {name: value for e in problem.episodes for name, value in e.recording.true_parameters.items()}
        truth = {name: value for name, value in true.items() if name in problem.free}
        current, names = [""], [solver.name for solver in solvers]

        def iterate(name: str, entry: Iterate) -> None:
            if name != current[0]:
                current[0] = name
                count = f", method {names.index(name) + 1} of {len(names)}" if name in names else ", with all noise"
                progress.begin_stage(f"solving by {name}{' (unweighted cost)' * (name == 'steepest_descent')}{count}")
            folder.log_event("iterate", method=name, iteration=entry.iteration, cost=entry.cost, seconds=entry.seconds)
            progress.report_iterate(entry)

        budget = run.compare.total_time_budget
        comparison = compare_methods(problem, solvers, iterate, math.inf if budget is None else budget)
        judged = comparison.verdict_solution
        own, checks = judged.problem or problem, judged.checks or EstimateChecksBeyondFit()
        held_out = checks.held_out_predictions
        methods = {}
        for tried in comparison.method_results:
            known = attributes_to_dict(tried, "whitened_cost wall_seconds")
            known["disagreements"] = comparison.disagreements[tried.method]
            methods[tried.method] = solution_to_result_dict(problem, tried.solution, tried.held_out_predictions) | known
        keys = "reference=reference_method agree=is_consistent disturbed=has_process_noise"
        result = attributes_to_dict(comparison, keys) | {
            "format": "yid-compare/1",
            "methods": methods,
            "issues": issues_to_plain_data(checks.data_issues),
            "published": PAPER_ESTIMATES[experiment] if experiment else {},
            "truth": truth,
            "judged": solution_to_result_dict(own, judged, held_out),
        }
        known = {"problem": own, "solution": judged, "section_data": {"comparison": comparison}}
        written = folder.write_result_and_report(run, progress, result, **known)
    done = any(run.solution.status == Status.CONVERGED for run in comparison.method_results)
    return CommandOutcome(folder.path, written, None, done)


run_and_return_exit_code = make_command_function(_run_compare)

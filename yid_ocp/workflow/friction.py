"""The command `friction`: every law of the friction ladder, judged by motions that it was not fitted to."""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from yid_ocp.analysis.friction_ladder import (
    FrictionLawFit,
    fit_friction_law,
    friction_torque_clouds,
    mean_and_standard_error,
    motion_kinds,
    warranted_law,
    without_held_out,
)
from yid_ocp.config.settings import FrictionSettings, RunSettings
from yid_ocp.effects.friction import FRICTION_LAWS
from yid_ocp.errors import DataError
from yid_ocp.problem import EstimationProblem
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.report.summaries import friction_summary
from yid_ocp.solvers import Solution, Status, solve
from yid_ocp.workflow.build import friction_joints, friction_parameter_names
from yid_ocp.workflow.build_problem import build_problem
from yid_ocp.workflow.command_runner import CommandResult, run_command_with_settings
from yid_ocp.workflow.run_folder import atomic_run_folder

_RESULT_FORMAT = "yid-friction/1"


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    return run_command_with_settings(arguments, run_friction, friction_summary)


def run_friction(
    run: RunSettings, out: str | Path | None = None, progress: Progress = NULL_PROGRESS
) -> CommandResult[FrictionLawFit]:
    """Fit every friction law to all recordings but one kind of motion in turn, and write the run folder.

    Successful where the warranted law's fit to all recordings converged.

    Raises
    ------
    DataError
        Fewer than two motions that could be left out.
    """
    joints = None if run.model.friction is None else run.model.friction.joints
    with atomic_run_folder(run, out, "friction") as folder:
        folder.record_run_start(run, "friction")
        fits: list[FrictionLawFit] = []
        solved: dict[str, tuple[RunSettings, EstimationProblem, Solution]] = {}
        for law in FRICTION_LAWS:
            progress.begin_stage(f"fitting the law '{law}', each kind of motion left out in turn")
            settings = replace(run, model=replace(run.model, friction=FrictionSettings(law=law, joints=joints)))
            problem = without_held_out(build_problem(settings))
            kinds = motion_kinds(problem)
            if len(kinds) < 2:
                allowed = "two recordings or more in which the motors are on"
                hint = "list more under recordings.estimate or recordings.held_out"
                raise DataError(
                    "a law is judged by motions it was not fitted to, and there is one", allowed=allowed, hint=hint
                )
            solution = solve(problem, run.solver, restarts=False)
            if solution.status == Status.FAILED:
                progress.begin_stage(f"the law '{law}' could not be fitted: {solution.message}")
                continue
            fits.append(fit_friction_law(law, problem, solution, kinds))
            solved[law] = (settings, problem, solution)
        if not fits:
            raise DataError("no friction law could be fitted", hint="look at `yid-ocp check` of this configuration")
        best = warranted_law(fits, kinds)
        settings, problem, solution = solved[best.law]
        names = friction_parameter_names(settings, problem.system.parameters)
        clouds = friction_torque_clouds(problem, solution, names)
        result: dict[str, Any] = {
            "format": _RESULT_FORMAT,
            "kinds": {kind: list(own) for kind, own in kinds.items()},
            "joints": list(friction_joints(settings, problem.system)),
            "unit": best.unit,
            "laws": {fit.law: _law_result(fit, best, kinds) for fit in fits},
            "warranted": best.law,
        }
        folder.log_event("end", warranted=best.law)
        more = {"friction_clouds": clouds}
        written = folder.write_result_and_report(
            run, progress, result, problem=problem, solution=solution, section_data=more
        )
    return CommandResult(folder.path, written, best, best.is_converged)


def _law_result(fit: FrictionLawFit, best: FrictionLawFit, kinds: dict[str, tuple[str, ...]]) -> dict[str, Any]:
    mean, error = mean_and_standard_error(fit.left_out_errors, kinds)
    beyond = {name: own - best.left_out_errors[name] for name, own in fit.left_out_errors.items()}
    difference, paired = mean_and_standard_error(beyond, kinds)
    return {
        "mean_error": mean,
        "standard_error": error,
        "left_out_errors": dict(fit.left_out_errors),
        "beyond_warranted": difference,
        "beyond_warranted_standard_error": paired,
        "converged": fit.is_converged,
        "parameters": {name: asdict(entry) for name, entry in fit.parameters.items()},
    }

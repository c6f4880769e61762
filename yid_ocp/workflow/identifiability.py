"""The command `identifiability`: Fisher information of recordings and of changed experiments, on workers too."""

from __future__ import annotations

import argparse
import contextlib
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from yid_ocp.analysis.compare import decide_cable_memory, without_cable_memory
from yid_ocp.analysis.experiment_design import BaseExperiment
from yid_ocp.analysis.identifiability import (
    GRASP_OFFSET_PRIOR_STD,
    IdentifiabilityResult,
    InitialStateKnowledge,
    ParameterInformation,
    identifiability,
    unknowns_from_solution,
    with_grasp_offset_effects,
)
from yid_ocp.analysis.profile import ParameterProfile, is_small_problem
from yid_ocp.analysis.what_if import (
    ChangedExperimentResult,
    ChangeSetEvaluator,
    ExperimentChange,
    ExperimentRanking,
    WhatIfOptions,
    evaluate_change_sets,
    what_if,
)
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import RunSettings
from yid_ocp.files import from_plain_data, to_plain_data
from yid_ocp.inference.null_test import GapCriteria
from yid_ocp.model.system import System
from yid_ocp.parallel import Task, WorkerConfig, require_task_values, run_tasks
from yid_ocp.problem import EstimationProblem
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.report.summaries import identifiability_summary
from yid_ocp.solvers import Iterate, Solution, Status, solve
from yid_ocp.workflow.build import build_step, build_system, system_with_second_arm
from yid_ocp.workflow.build_problem import build_problem
from yid_ocp.workflow.command_runner import CommandResult, run_and_print, workers_from_arguments
from yid_ocp.workflow.recording_issues import issues_result
from yid_ocp.workflow.run_folder import RunFolder, new_run_folder
from yid_ocp.workflow.run_inputs import input_files

_RESULT_FORMAT = "yid-identifiability/1"


@dataclass(frozen=True)
class IdentifiabilityOptions:
    """Options of an identifiability analysis beyond the run's settings.

    Attributes
    ----------
    evaluation_point : "solution" or "initial"
        Point at which to judge: where the solver ends, or the initial values, without solving.
    start_knowledge : "assumed" or "unknown"
        Initial states as the settings have them, so that verdicts are those of `solve`, or all estimated along.
    grasp_offset_std : float or None
        Prior standard deviation of where the grasps sit [m]; None for grasps as the settings have them.
    interval_parameters : "auto", "all" or sequence of str
        Parameters whose interval by profile likelihood is wanted; `auto` for all of a small problem, none of a large
        one.
    rank_changes : bool
        Whether to rank changes of the experiment.
    """

    evaluation_point: Literal["solution", "initial"] = "solution"
    start_knowledge: InitialStateKnowledge = "assumed"
    grasp_offset_std: float | None = None
    interval_parameters: Literal["auto", "all"] | Sequence[str] = "auto"
    rank_changes: bool = False

    @property
    def command_line_flags(self) -> list[str]:
        """The options as command-line flags."""
        names = (
            self.interval_parameters
            if isinstance(self.interval_parameters, str)
            else ",".join(self.interval_parameters) or "none"
        )
        said = {
            "--what-if": self.rank_changes,
            "--initial": self.evaluation_point == "initial",
            "--unknown-start": self.start_knowledge == "unknown",
            "--unknown-grasp": self.grasp_offset_std is not None,
        }
        asked = [flag for flag, given in said.items() if given]
        return asked + ([] if names == "auto" else ["--intervals", names])


@dataclass(frozen=True)
class IdentifiabilityCommandResult(CommandResult):
    """Result of `run_identifiability` with the analysis, None where it was not possible."""

    analysis: IdentifiabilityResult | None


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    settings = load_config(arguments.config, arguments.overrides)
    names = [name for name in arguments.intervals.split(",") if name]
    asked = IdentifiabilityOptions(
        evaluation_point="initial" if arguments.initial else "solution",
        start_knowledge="unknown" if arguments.unknown_start else "assumed",
        grasp_offset_std=GRASP_OFFSET_PRIOR_STD if arguments.unknown_grasp else None,
        interval_parameters={"auto": "auto", "all": "all", "none": ()}.get(arguments.intervals, names),
        rank_changes=arguments.what_if,
    )
    workers = workers_from_arguments(arguments)

    def judged(shown: Progress) -> IdentifiabilityCommandResult:
        return run_identifiability(settings, arguments.out, shown, asked, workers)

    return run_and_print(arguments, judged, identifiability_summary)


def run_identifiability(
    run: RunSettings,
    out: str | Path | None = None,
    progress: Progress = NULL_PROGRESS,
    options: IdentifiabilityOptions | None = None,
    workers: WorkerConfig | Executor | None = None,
) -> IdentifiabilityCommandResult:
    """Solve, analyse identifiability and write the run folder.

    Parameters
    ----------
    workers : WorkerConfig or Executor, optional
        Who works out intervals, one parameter a task, and the experiments of `what_if`; this process when absent.

    Returns
    -------
    IdentifiabilityCommandResult
        Also where the solver failed: the run folder then holds the reason.

    Raises
    ------
    ConfigError, DataError, ModelError, SolverError, OutputError
    """
    asked = options or IdentifiabilityOptions()
    with new_run_folder(run, out, "identifiability") as folder:
        folder.begin_run(run, "identifiability", asked.command_line_flags)
        progress.begin_stage("building the model and its compiled step")
        system = build_system(run)
        problem = build_problem(run, build_step(run, with_grasp_offset_effects(system)))
        limits = run.diagnosis.fit_gap_limits
        solution, whole = None, problem
        if asked.evaluation_point == "solution":
            solved = _solved(run, problem, folder, progress)
            safe = decide_cable_memory(problem, run.solver, solved, limits)
            problem, solution = safe.problem, safe.solution
        elsewhere = None
        if workers is not None:
            point = (problem, solution, problem is whole, asked)
            elsewhere = _IdentifiabilityTasks.from_run(workers, folder, run, *point, progress)
        unknown = information = ranking = None
        if solution is None or solution.status != Status.FAILED:
            progress.begin_stage("Fisher information")
            unknown = identifiability(
                problem, solution, start="unknown", grasp_std=GRASP_OFFSET_PRIOR_STD, limits=limits
            )
            information = _information(problem, solution, asked, progress, limits, elsewhere)
            if asked.rank_changes:
                ranking = _ranking(run, system, problem, solution, asked, progress, elsewhere)
        result = _identifiability_result(problem, solution, information, unknown, ranking, asked)
        folder.log_event("end", status=result["status"], message=result["message"])
        written = folder.write_result(result)
        folder.write_report_page(run, written, progress, problem=problem, solution=solution)
    if elsewhere is not None:
        elsewhere.delete_results()
    done = information is not None
    return IdentifiabilityCommandResult(folder.path, written, information, is_successful=done)


def _solved(run: RunSettings, problem: EstimationProblem, folder: RunFolder, progress: Progress) -> Solution:
    progress.begin_stage(f"solving for {len(problem.initial_unknowns)} unknowns by {run.solver.name}")

    def iterate(entry: Iterate) -> None:
        folder.log_event("iterate", iteration=entry.iteration, cost=entry.cost, seconds=entry.seconds)
        progress.report_iterate(entry)

    return solve(problem, run.solver, callback=iterate, limits=run.diagnosis.fit_gap_limits)


def _information(
    problem: EstimationProblem,
    solution: Solution | None,
    asked: IdentifiabilityOptions,
    progress: Progress,
    limits: GapCriteria,
    elsewhere: _IdentifiabilityTasks | None,
) -> IdentifiabilityResult:
    judged = partial(
        identifiability, problem, solution, start=asked.start_knowledge, grasp_std=asked.grasp_offset_std, limits=limits
    )
    information = judged()
    wanted = _wanted(problem, information, asked)
    if not wanted:
        return information
    if elsewhere is not None and set(wanted) <= set(information.parameter_names):
        progress.begin_stage(f"intervals of {len(wanted)} parameters by profile likelihood")
        return elsewhere.with_profile_likelihoods(information, wanted)
    return judged(intervals=wanted, progress=progress)


def _ranking(
    run: RunSettings,
    system: System,
    problem: EstimationProblem,
    solution: Solution | None,
    asked: IdentifiabilityOptions,
    progress: Progress,
    elsewhere: _IdentifiabilityTasks | None,
) -> ExperimentRanking:
    other = system_with_second_arm(run, system)
    return what_if(
        problem,
        solution,
        start=asked.start_knowledge,
        grasp_std=asked.grasp_offset_std,
        two_arm_system=None if other is None else with_grasp_offset_effects(other),
        progress=progress,
        evaluate_changes=None if elsewhere is None else elsewhere.change_evaluator(),
    )


def _wanted(
    problem: EstimationProblem, information: IdentifiabilityResult, asked: IdentifiabilityOptions
) -> Sequence[str]:
    if asked.interval_parameters not in ("auto", "all"):
        return asked.interval_parameters
    return information.parameter_names if asked.interval_parameters == "all" or is_small_problem(problem) else ()


def _identifiability_result(
    problem: EstimationProblem,
    solution: Solution | None,
    information: IdentifiabilityResult | None,
    unknown: IdentifiabilityResult | None,
    ranking: ExperimentRanking | None,
    asked: IdentifiabilityOptions,
) -> dict[str, Any]:
    """`yid-identifiability/1` without inputs and versions."""
    result: dict[str, Any] = {
        "format": _RESULT_FORMAT,
        "status": "not_solved" if solution is None else solution.status.value,
        "message": "judged at the initial values" if solution is None else solution.message,
        "at": asked.evaluation_point,
        "start": asked.start_knowledge,
        "grasp_std": asked.grasp_offset_std if problem.system.grasps else None,
        "parameters": {},
        "correlations": {"names": [], "matrix": []},
        "directions": [],
        "nuisances": 0,
        "fit": None if solution is None else asdict(solution.goodness_of_fit),
        "doubts": issues_result(problem.options.data_issues),
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
    result["correlations"] = {"names": information.parameter_names, "matrix": information.correlations}
    result["directions"] = [asdict(direction) for direction in information.directions]
    result["nuisances"] = len(information.nuisance_names)
    result["profiles"] = {
        name: {"values": profile.values, "delta_chi2": profile.delta_chi2, "notes": profile.notes}
        for name, profile in information.profiles.items()
    }
    if ranking is not None:
        result["what_if"] = {
            "base": _outcome(ranking.unchanged_experiment),
            "singles": [_outcome(entry) for entry in ranking.single_changes],
            "smallest": [_outcome(entry) for entry in ranking.smallest_sufficient_sets],
            "greedy": [_outcome(entry) for entry in ranking.greedy_sequence],
            "searched": ranking.n_evaluated_sets,
        }
    return result


def _outcome(entry: ChangedExperimentResult) -> dict[str, Any]:
    gain = entry.gain if entry.verdicts else None
    return asdict(entry) | {"gain": gain}


@dataclass(frozen=True)
class _IdentifiabilityTasks:
    """Workers and common task arguments of the identifiability analysis of one run."""

    workers: WorkerConfig | Executor
    results_folder: Path
    task_arguments: Mapping[str, Any]
    progress: Progress

    @staticmethod
    def from_run(
        workers: WorkerConfig | Executor,
        folder: RunFolder,
        run: RunSettings,
        problem: EstimationProblem,
        solution: Solution | None,
        remembers: bool,
        asked: IdentifiabilityOptions,
        progress: Progress,
    ) -> _IdentifiabilityTasks:
        """Tasks for a run whose folder contains its configuration."""
        told = {
            "config": folder.path / "config.yaml",
            "inputs": sorted({path.absolute() for name, path in input_files(run).items() if name != "configuration"}),
            "x": None if solution is None else [float(value) for value in unknowns_from_solution(problem, solution)],
            "remembers": remembers,
            "start": asked.start_knowledge,
            "grasp_std": asked.grasp_offset_std,
        }
        return _IdentifiabilityTasks(workers, folder.resume_folder / "tasks", told, progress)

    def with_profile_likelihoods(
        self, information: IdentifiabilityResult, names: Sequence[str]
    ) -> IdentifiabilityResult:
        """The analysis with profile likelihoods of the named parameters, one task per parameter."""
        tasks = [Task(name, {**self.task_arguments, "name": name}) for name in names]
        found = require_task_values(
            run_tasks(profile_parameter, tasks, self._folder(), self.workers, self.progress.report_parts_done)
        )
        parameters, profiles = dict(information.parameters), dict(information.profiles)
        for name, told in zip(names, found, strict=True):
            parameters[name] = from_plain_data(ParameterInformation, told["parameter"])
            profiles[name] = from_plain_data(ParameterProfile, told["profile"])
        return replace(information, parameters=parameters, profiles=profiles)

    def change_evaluator(self) -> ChangeSetEvaluator:
        """Function that evaluates sets of experiment changes on the workers, one task per changed mechanics."""

        def judged(sets: Sequence[Sequence[ExperimentChange]], inflation: float) -> list[ChangedExperimentResult]:
            groups: dict[tuple[str, ...], list[int]] = {}
            for i, changes in enumerate(sets):
                mechanics = tuple(sorted({change.mechanical_change for change in changes if change.mechanical_change}))
                groups.setdefault(mechanics, []).append(i)
            tasks = []
            for mechanics, members in groups.items():
                named = [[change.name for change in sets[i]] for i in members]
                arguments = {**self.task_arguments, "sets": named, "inflation": inflation}
                tasks.append(Task(" and ".join(mechanics) or "sensors", arguments))
            self.progress.begin_stage(f"judging {len(sets)} experiments")
            done = require_task_values(
                run_tasks(_change_set_outcomes, tasks, self._folder(), self.workers, self.progress.report_parts_done)
            )
            found: dict[int, ChangedExperimentResult] = {}
            for members, told in zip(groups.values(), done, strict=True):
                found |= {
                    i: from_plain_data(ChangedExperimentResult, entry) for i, entry in zip(members, told, strict=True)
                }
            return [found[i] for i in range(len(sets))]

        return judged

    def delete_results(self) -> None:
        """Delete the stored task results."""
        with contextlib.suppress(OSError):
            shutil.rmtree(self.results_folder)
            self.results_folder.parent.rmdir()

    def _folder(self) -> Path:
        self.results_folder.parent.mkdir(parents=True, exist_ok=True)
        return self.results_folder


# -- tasks ------------------------------------------------------------------------------------------------------------


def profile_parameter(
    config: Path,
    inputs: Sequence[Path],
    x: Sequence[float] | None,
    remembers: bool,
    start: InitialStateKnowledge,
    grasp_std: float | None,
    name: str,
) -> dict[str, Any]:
    """Task: profile likelihood of one parameter and its updated verdict, as plain data."""
    del inputs  # they are part of what the result is kept by
    run, problem = _problem(config, remembers)
    found = identifiability(
        problem, x, start=start, grasp_std=grasp_std, intervals=[name], limits=run.diagnosis.fit_gap_limits
    )
    return {
        key: to_plain_data(own[name]) for key, own in (("parameter", found.parameters), ("profile", found.profiles))
    }


def _change_set_outcomes(
    config: Path,
    inputs: Sequence[Path],
    x: Sequence[float] | None,
    remembers: bool,
    start: InitialStateKnowledge,
    grasp_std: float | None,
    sets: Sequence[Sequence[str]],
    inflation: float,
) -> list[dict[str, Any]]:
    """Task: expected information of the experiment with each set of changes, as plain data."""
    del inputs
    run, problem = _problem(config, remembers)
    other = system_with_second_arm(run, build_system(run))
    options = WhatIfOptions()
    setting = BaseExperiment(
        problem,
        unknowns_from_solution(problem, x),
        start,
        grasp_std,
        None if other is None else with_grasp_offset_effects(other),
        options.torque_std,
        options.motion_seed,
    )
    return [to_plain_data(entry) for entry in evaluate_change_sets(setting, sets, inflation)]


def _problem(config: Path, remembers: bool) -> tuple[RunSettings, EstimationProblem]:
    run = load_config(config)
    problem = build_problem(run, build_step(run, with_grasp_offset_effects(build_system(run))))
    return run, problem if remembers else without_cable_memory(problem)

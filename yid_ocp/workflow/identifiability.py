"""The command `identifiability`: which parameters recordings, or changed experiments, determine."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from yid_ocp.analysis import identifiability as fisher
from yid_ocp.analysis import what_if
from yid_ocp.analysis.estimation import problem_without_shape_memory
from yid_ocp.analysis.experiment_design import UnchangedExperiment
from yid_ocp.analysis.identifiability import IdentifiabilityResult, system_with_grasp_offset_effects
from yid_ocp.analysis.profile import ParameterProfileLikelihood, is_small_enough_for_profiles
from yid_ocp.analysis.what_if import ChangedExperimentResult
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import RunSettings
from yid_ocp.display import NULL_PROGRESS, Progress, count_with_noun, grouped
from yid_ocp.errors import ConfigError, require_known_names
from yid_ocp.files import attributes_to_dict, dataclass_from_plain_data, to_lossless_plain_data
from yid_ocp.parallel import Task, WorkerConfig, require_task_values, run_tasks
from yid_ocp.problem import EstimationProblem
from yid_ocp.solvers import Solution, Status
from yid_ocp.workflow.build import build_step, build_system, free_parameter_names, system_with_second_arm_holding_object
from yid_ocp.workflow.build_problem import build_problem, issues_to_plain_data
from yid_ocp.workflow.command_runner import CommandOutcome, make_command_function, worker_config_from_arguments
from yid_ocp.workflow.run_folder import atomic_run_folder
from yid_ocp.workflow.run_inputs import input_files_by_name
from yid_ocp.workflow.solve import solve_and_choose_cable_shape_memory


@dataclass(frozen=True)
class IdentifiabilityOptions:
    """The options of an identifiability analysis that are not part of the run's settings.

    `evaluation_point`: parameter values of the analysis, from a solve or the `initial` ones. `start_knowledge`: initial
    states are `assumed` as in the settings, so that verdicts equal those of `solve`, or all `unknown` and estimated.
    `grasp_offset_std` is the prior standard deviation of grasp positions [m]; None keeps the grasps of the settings.
    `interval_parameters` get profile likelihoods; `auto` means all in a small problem at a solution, otherwise none.
    """

    evaluation_point: Literal["solution", "initial"] = "solution"
    start_knowledge: fisher.InitialStateKnowledge = "assumed"
    grasp_offset_std: float | None = None
    interval_parameters: Literal["auto", "all"] | Sequence[str] = "auto"
    rank_changes: bool = False

    def _command_line_flags(self) -> list[str]:
        wanted = self.interval_parameters
        names = wanted if isinstance(wanted, str) else ",".join(wanted) or "none"
        said = {
            "--what-if": self.rank_changes,
            "--initial": self.evaluation_point == "initial",
            "--unknown-start": self.start_knowledge == "unknown",
            "--unknown-grasp": self.grasp_offset_std is not None,
        }
        return [flag for flag, given in said.items() if given] + ([] if names == "auto" else ["--intervals", names])


def run_and_return_exit_code(arguments: argparse.Namespace) -> int:
    """Run the command `identifiability` and return its exit code."""
    names = [name for name in arguments.intervals.split(",") if name]
    asked = IdentifiabilityOptions(
        evaluation_point="initial" if arguments.initial else "solution",
        start_knowledge="unknown" if arguments.unknown_start else "assumed",
        grasp_offset_std=fisher.GRASP_OFFSET_PRIOR_STD if arguments.unknown_grasp else None,
        interval_parameters={"auto": "auto", "all": "all", "none": ()}.get(arguments.intervals, names),
        rank_changes=arguments.what_if,
    )
    work = partial(run_identifiability, options=asked, workers=worker_config_from_arguments(arguments))
    return make_command_function(work)(arguments)


def run_identifiability(
    run: RunSettings,
    out: str | Path | None = None,
    progress: Progress = NULL_PROGRESS,
    options: IdentifiabilityOptions | None = None,
    workers: WorkerConfig | Executor | None = None,
) -> CommandOutcome[IdentifiabilityResult | None]:
    """Solve the problem, analyse identifiability and write the run folder.

    If the solver fails, the analysis is omitted and the run folder holds the reason. `workers` compute intervals, one
    parameter per task, and the changed experiments of `what_if` (default: this process).
    """
    asked = options or IdentifiabilityOptions()
    with atomic_run_folder(run, out, "identifiability") as folder:
        folder.record_run_start(run, "identifiability", asked._command_line_flags())
        progress.begin_stage("building the model and its compiled step")
        system, wanted = build_system(run), asked.interval_parameters
        if not isinstance(wanted, str):
            free = free_parameter_names(run, system.parameters)
            require_known_names(wanted, free, "free parameter", "--intervals (else `all` or `none`)", ConfigError)
        problem = whole = build_problem(run, build_step(run, system_with_grasp_offset_effects(system)))
        solution = None
        if asked.evaluation_point == "solution":
            problem, solution = solve_and_choose_cable_shape_memory(run, problem, folder, progress)
        tasks = None
        knowledge: dict[str, Any] = {"start": asked.start_knowledge, "grasp_std": asked.grasp_offset_std}
        if workers is not None:
            told = {
                "config": folder.path / "config.yaml",
                # further inputs of the results
                "inputs": sorted({p.absolute() for n, p in input_files_by_name(run).items() if n != "configuration"}),
                "x": None if solution is None else fisher.unknown_vector_from_solution(problem, solution).tolist(),
                "remembers": problem is whole,
                **knowledge,
            }
            tasks = _IdentifiabilityTasks(workers, folder.resume_folder / "tasks", told, progress)
        unknown = information = ranking = None
        if solution is None or solution.status != Status.FAILED:
            progress.begin_stage("computing the Fisher information")
            judged = partial(fisher.identifiability, problem, solution)
            unknown = judged(start="unknown", grasp_std=fisher.GRASP_OFFSET_PRIOR_STD)
            judged = partial(judged, **knowledge)
            information = judged()
            wanted, names = asked.interval_parameters, information.parameter_names
            if isinstance(wanted, str):
                wanted = names if wanted == "all" or (solution and is_small_enough_for_profiles(problem)) else ()
            if tasks is not None and wanted and set(wanted) <= set(names):
                progress.begin_stage(f"computing 95 % intervals of {count_with_noun(len(wanted), 'parameter')}")
                information = tasks.with_profile_likelihoods(information, wanted)
            elif wanted:
                information = judged(intervals=wanted, progress=progress)
            if asked.rank_changes:
                other = system_with_second_arm_holding_object(run, system)
                knowledge["two_arm_system"] = None if other is None else system_with_grasp_offset_effects(other)
                knowledge["evaluate_changes"] = None if tasks is None else tasks.evaluate_experiment_change_sets
                ranking = what_if.what_if(problem, solution, progress=progress, **knowledge)
        result = _identifiability_result(problem, solution, information, unknown, ranking, asked)
        folder.log_event("end", status=result["status"], message=result["message"])
        written = folder.write_result_and_report(run, progress, result, problem=problem, solution=solution)
    if tasks is not None:
        folder.delete_resume_data(tasks.results_folder)
    return CommandOutcome(folder.path, written, information, information is not None)


def _identifiability_result(
    problem: EstimationProblem,
    solution: Solution | None,
    information: IdentifiabilityResult | None,
    unknown: IdentifiabilityResult | None,
    ranking: what_if.ExperimentChangesRankedByIdentifiability | None,
    asked: IdentifiabilityOptions,
) -> dict[str, Any]:
    result: dict[str, Any] = {
        "format": "yid-identifiability/1",
        "status": "not_solved" if solution is None else solution.status.value,
        "message": "judged at the initial values" if solution is None else solution.message,
        **attributes_to_dict(asked, "at=evaluation_point start=start_knowledge"),
        "grasp_std": asked.grasp_offset_std if problem.system.grasps else None,
        "fit": None if solution is None else asdict(solution.goodness_of_fit),
        "issues": issues_to_plain_data(problem.options.data_issues),
        "what_if": None,
        # servos cannot follow a planned motion exactly
        "can_plan_motion": bool(problem.system.driven or problem.system.prescribed) and not problem.system.servos,
        "groups_with_chosen_points": [n for n, own in problem.options.sensors.items() if own.used_points is not None],
    }
    if information is None or unknown is None:
        result |= {"parameters": {}, "correlations": {"names": [], "matrix": []}}
        return result | {"directions": [], "nuisances": 0, "profiles": {}}
    parameters = {}
    for name, entry in information.parameters.items():
        parameters[name] = asdict(entry) | {"verdict_unknown": unknown.parameters[name].verdict}
        parameters[name] |= attributes_to_dict(problem.system.parameters[name.split("[")[0]], "lower upper")
    if ranking is not None:
        result["what_if"] = {
            "base": _outcome(ranking.unchanged_experiment),
            "singles": list(map(_outcome, ranking.single_changes)),
            "smallest": list(map(_outcome, ranking.smallest_sufficient_sets)),
            "searched": ranking.n_evaluated_sets,
        }
    return result | {
        "parameters": parameters,
        "correlations": {"names": information.parameter_names, "matrix": information.correlations},
        "directions": [asdict(direction) for direction in information.directions],
        "nuisances": len(information.nuisance_names),
        "profiles": {
            name: {
                **attributes_to_dict(own, "values delta_chi2"),
                "notes": [t for t in (*own.notes, own.better_fit) if t],
            }
            for name, own in information.profiles.items()
        },
    }


def _outcome(entry: ChangedExperimentResult) -> dict[str, Any]:
    own = {"words" if key == "description" else key: value for key, value in asdict(entry).items()}
    return own | {"gain": entry.gain if entry.verdicts else None}


@dataclass(frozen=True)
class _IdentifiabilityTasks:
    workers: WorkerConfig | Executor
    results_folder: Path
    common: Mapping[str, Any]
    progress: Progress

    def with_profile_likelihoods(self, analysis: IdentifiabilityResult, names: Sequence[str]) -> IdentifiabilityResult:
        """Return the analysis with profile likelihoods of the parameters `names`, one task per parameter."""
        found = self._done(_profile_likelihood_task, {name: {"name": name} for name in names})
        parameters, profiles = dict(analysis.parameters), dict(analysis.profiles)
        for name, told in zip(names, found, strict=True):
            parameters[name] = dataclass_from_plain_data(fisher.StdsAndVerdictOfParameter, told["parameter"])
            profiles[name] = dataclass_from_plain_data(ParameterProfileLikelihood, told["profile"])
        return replace(analysis, parameters=parameters, profiles=profiles)

    def evaluate_experiment_change_sets(
        self, sets: Sequence[Sequence[what_if.ExperimentChange]], inflation: float
    ) -> list[ChangedExperimentResult]:
        """Return the expected result of the experiment with each set of changes; one task per changed setup."""
        setups = (sorted({change.setup_change for change in changes if change.setup_change}) for changes in sets)
        groups = grouped((" and ".join(setup) or "sensors", i) for i, setup in enumerate(setups))
        named = [[change.name for change in changes] for changes in sets]
        own = {name: [named[i] for i in members] for name, members in groups.items()}
        tasks = {name: {"sets": members, "inflation": inflation} for name, members in own.items()}
        self.progress.begin_stage(f"predicting the ± of {count_with_noun(len(sets), 'experiment')}")
        done = self._done(_change_set_outcomes, tasks)
        order = [i for members in groups.values() for i in members]
        found = [dataclass_from_plain_data(ChangedExperimentResult, entry) for told in done for entry in told]
        return [own for _, own in sorted(zip(order, found, strict=True), key=lambda pair: pair[0])]

    def _done(self, function: Callable[..., Any], tasks: Mapping[str, Mapping[str, Any]]) -> list[Any]:
        listed = [Task(name, {"common": self.common, **own}) for name, own in tasks.items()]
        report = self.progress.report_parts_done
        return require_task_values(run_tasks(function, listed, self.results_folder, self.workers, report))


def _profile_likelihood_task(common: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Task: profile likelihood of one parameter and its updated verdict, as plain data."""
    _, problem = _problem(common)
    start, std = common["start"], common["grasp_std"]
    found = fisher.identifiability(problem, common["x"], intervals=[name], start=start, grasp_std=std)
    return dict(to_lossless_plain_data({"parameter": found.parameters[name], "profile": found.profiles[name]}))


def _change_set_outcomes(
    common: Mapping[str, Any], sets: Sequence[Sequence[str]], inflation: float
) -> list[dict[str, Any]]:
    """Task: return the expected information of the experiment with each set of changes, as plain data."""
    run, problem = _problem(common)
    other = system_with_second_arm_holding_object(run, build_system(run))
    two_arms = None if other is None else system_with_grasp_offset_effects(other)
    x = fisher.unknown_vector_from_solution(problem, common["x"])
    setting = UnchangedExperiment(problem, x, common["start"], common["grasp_std"], two_arms)
    return list(to_lossless_plain_data(what_if.evaluate_experiment_change_sets(setting, sets, inflation)))


def _problem(common: Mapping[str, Any]) -> tuple[RunSettings, EstimationProblem]:
    run = load_config(common["config"])
    problem = build_problem(run, build_step(run, system_with_grasp_offset_effects(build_system(run))))
    return run, problem if common["remembers"] else problem_without_shape_memory(problem)

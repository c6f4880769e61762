"""Identifiability analysis as tasks for worker processes, which rebuild the problem from its configuration."""

from __future__ import annotations

import contextlib
import math
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.analysis.cable_memory_check import without_cable_memory
from yid_ocp.analysis.experiment_design import BaseExperiment
from yid_ocp.analysis.identifiability import (
    IdentifiabilityResult,
    InitialStateKnowledge,
    ParameterInformation,
    identifiability,
    unknowns_from_solution,
    with_grasp_offset_effects,
)
from yid_ocp.analysis.profile import ParameterProfile
from yid_ocp.analysis.what_if import (
    ChangedExperimentResult,
    ChangeSetEvaluator,
    ExperimentChange,
    WhatIfOptions,
    evaluate_change_sets,
)
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import RunSettings
from yid_ocp.parallel import Task, WorkerConfig, require_task_values, run_tasks
from yid_ocp.problem import EstimationProblem
from yid_ocp.progress import Progress
from yid_ocp.solvers import Solution
from yid_ocp.workflow.build import build_problem, build_step, build_system, input_files
from yid_ocp.workflow.run_folder import RunFolder
from yid_ocp.workflow.second_arm import system_with_second_arm


@dataclass(frozen=True)
class IdentifiabilityTasks:
    """Workers and common task arguments of the identifiability analysis of one run.

    Attributes
    ----------
    results_folder : Path
        Folder that their results are kept in while the run is not complete.
    task_arguments : mapping
        Arguments of every task.
    """

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
        start: InitialStateKnowledge,
        grasp_std: float | None,
        progress: Progress,
    ) -> IdentifiabilityTasks:
        """Tasks for a run whose folder contains its configuration.

        Parameters
        ----------
        solution : Solution or None
            Point at which to judge; the initial values where None.
        remembers : bool
            Whether the problem is the run's, not that of a cable that remembers nothing.
        start, grasp_std
            As in `identifiability`.
        """
        told = {
            "config": folder.path / "config.yaml",
            "inputs": sorted({path.absolute() for name, path in input_files(run).items() if name != "configuration"}),
            "x": None if solution is None else [float(value) for value in unknowns_from_solution(problem, solution)],
            "remembers": remembers,
            "start": start,
            "grasp_std": grasp_std,
        }
        return IdentifiabilityTasks(workers, folder.resume_folder / "tasks", told, progress)

    def with_profile_likelihoods(
        self, information: IdentifiabilityResult, names: Sequence[str]
    ) -> IdentifiabilityResult:
        """The analysis with profile likelihoods of the named parameters, one task per parameter.

        Raises
        ------
        WorkerError
            One could not be worked out.
        """
        tasks = [Task(name, {**self.task_arguments, "name": name}) for name in names]
        found = require_task_values(
            run_tasks(profile_parameter, tasks, self._folder(), self.workers, self.progress.report_parts_done)
        )
        parameters, profiles = dict(information.parameters), dict(information.profiles)
        for name, told in zip(names, found, strict=True):
            parameters[name] = _parameter(told["parameter"])
            profiles[name] = _profile(told["profile"])
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
                run_tasks(change_set_outcomes, tasks, self._folder(), self.workers, self.progress.report_parts_done)
            )
            found: dict[int, ChangedExperimentResult] = {}
            for members, told in zip(groups.values(), done, strict=True):
                found |= {i: _outcome(entry) for i, entry in zip(members, told, strict=True)}
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
    own, profile = asdict(found.parameters[name]), asdict(found.profiles[name])
    return {"parameter": _finite(own), "profile": _finite(profile)}


def change_set_outcomes(
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
    return [_finite(asdict(entry)) for entry in evaluate_change_sets(setting, sets, inflation)]


def _problem(config: Path, remembers: bool) -> tuple[RunSettings, EstimationProblem]:
    run = load_config(config)
    problem = build_problem(run, build_step(run, with_grasp_offset_effects(build_system(run))))
    return run, problem if remembers else without_cable_memory(problem)


# -- plain data -------------------------------------------------------------------------------------------------------


def _finite(value: Any) -> Any:
    """Plain data in which numbers that JSON does not have are text."""
    if isinstance(value, Mapping):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_finite(entry) for entry in value]
    if isinstance(value, np.generic):
        value = value.item()
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _number(value: float | str) -> float:
    return float(value)


def _parameter(told: Mapping[str, Any]) -> ParameterInformation:
    numbers = {key: _number(told[key]) for key in ("value", "std", "std_relative", "std_alone")}
    interval = None if told["interval"] is None else tuple(told["interval"])
    return ParameterInformation(**{**told, **numbers, "interval": interval})


def _profile(told: Mapping[str, Any]) -> ParameterProfile:
    values, deltas = (np.array([_number(x) for x in told[key]]) for key in ("values", "delta_chi2"))
    return ParameterProfile(
        told["name"], _number(told["value"]), told["lower"], told["upper"], values, deltas, tuple(told["notes"])
    )


def _outcome(told: Mapping[str, Any]) -> ChangedExperimentResult:
    std = {name: _number(value) for name, value in told["std_relative"].items()}
    own = {"changes": tuple(told["changes"]), "std_relative": std, "gain": _number(told["gain"])}
    return ChangedExperimentResult(**{**told, **own})

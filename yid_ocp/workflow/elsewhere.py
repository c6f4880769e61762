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

from yid_ocp.analysis.identifiability import (
    Identifiability,
    ParameterInformation,
    StartKnowledge,
    identifiability,
    unknown_vector,
    with_grasp_offsets,
)
from yid_ocp.analysis.layouts import Setting
from yid_ocp.analysis.profile import Profile
from yid_ocp.analysis.start_in_motion import without_memory
from yid_ocp.analysis.what_if import Change, Judge, Outcome, WhatIfOptions, judged_changes
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import Run
from yid_ocp.parallel import Task, Workers, run_tasks, values_of
from yid_ocp.problem import EstimationProblem
from yid_ocp.progress import Progress
from yid_ocp.solvers import Solution
from yid_ocp.workflow.build import build_problem, build_step, build_system, input_files
from yid_ocp.workflow.folder import RunFolder
from yid_ocp.workflow.second_arm import second_arm


@dataclass(frozen=True)
class Elsewhere:
    """Workers and common task arguments of the identifiability analysis of one run.

    Attributes
    ----------
    workers : Workers or Executor
    results : Path
        Folder that their results are kept in while the run is not complete.
    told : mapping
        Arguments of every task.
    progress : Progress
    """

    workers: Workers | Executor
    results: Path
    told: Mapping[str, Any]
    progress: Progress

    @staticmethod
    def of(
        workers: Workers | Executor,
        folder: RunFolder,
        run: Run,
        problem: EstimationProblem,
        solution: Solution | None,
        remembers: bool,
        start: StartKnowledge,
        grasp_std: float | None,
        progress: Progress,
    ) -> Elsewhere:
        """Tasks for a run whose folder contains its configuration.

        Parameters
        ----------
        workers : Workers or Executor
        folder : RunFolder
        run : Run
        problem : EstimationProblem
        solution : Solution or None
            Point at which to judge; the initial values where None.
        remembers : bool
            Whether the problem is the run's, not that of a cable that remembers nothing.
        start, grasp_std
            As in `identifiability`.
        progress : Progress
        """
        told = {
            "config": folder.path / "config.yaml",
            "inputs": sorted({path.absolute() for name, path in input_files(run).items() if name != "configuration"}),
            "x": None if solution is None else [float(value) for value in unknown_vector(problem, solution)],
            "remembers": remembers,
            "start": start,
            "grasp_std": grasp_std,
        }
        return Elsewhere(workers, folder.partial / "tasks", told, progress)

    def with_profiles(self, information: Identifiability, names: Sequence[str]) -> Identifiability:
        """The analysis with profile likelihoods of the named parameters, one task per parameter.

        Raises
        ------
        WorkerError
            One could not be worked out.
        """
        tasks = [Task(name, {**self.told, "name": name}) for name in names]
        found = values_of(run_tasks(profiled, tasks, self._folder(), self.workers, self.progress.advance))
        parameters, profiles = dict(information.parameters), dict(information.profiles)
        for name, told in zip(names, found, strict=True):
            parameters[name] = _parameter(told["parameter"])
            profiles[name] = _profile(told["profile"])
        return replace(information, parameters=parameters, profiles=profiles)

    def judge(self) -> Judge:
        """Function that evaluates sets of experiment changes on the workers, one task per changed mechanics."""

        def judged(sets: Sequence[Sequence[Change]], inflation: float) -> list[Outcome]:
            groups: dict[tuple[str, ...], list[int]] = {}
            for i, changes in enumerate(sets):
                mechanics = tuple(sorted({change.mechanics for change in changes if change.mechanics}))
                groups.setdefault(mechanics, []).append(i)
            tasks = []
            for mechanics, members in groups.items():
                named = [[change.name for change in sets[i]] for i in members]
                arguments = {**self.told, "sets": named, "inflation": inflation}
                tasks.append(Task(" and ".join(mechanics) or "sensors", arguments))
            self.progress.stage(f"judging {len(sets)} experiments")
            done = values_of(run_tasks(outcomes, tasks, self._folder(), self.workers, self.progress.advance))
            found: dict[int, Outcome] = {}
            for members, told in zip(groups.values(), done, strict=True):
                found |= {i: _outcome(entry) for i, entry in zip(members, told, strict=True)}
            return [found[i] for i in range(len(sets))]

        return judged

    def clear(self) -> None:
        """Delete the stored task results."""
        with contextlib.suppress(OSError):
            shutil.rmtree(self.results)
            self.results.parent.rmdir()

    def _folder(self) -> Path:
        self.results.parent.mkdir(parents=True, exist_ok=True)
        return self.results


# -- tasks ------------------------------------------------------------------------------------------------------------


def profiled(
    config: Path,
    inputs: Sequence[Path],
    x: Sequence[float] | None,
    remembers: bool,
    start: StartKnowledge,
    grasp_std: float | None,
    name: str,
) -> dict[str, Any]:
    """Task: profile likelihood of one parameter and its updated verdict, as plain data."""
    del inputs  # they are part of what the result is kept by
    run, problem = _problem(config, remembers)
    found = identifiability(
        problem, x, start=start, grasp_std=grasp_std, intervals=[name], limits=run.diagnosis.of_a_fit
    )
    own, profile = asdict(found.parameters[name]), asdict(found.profiles[name])
    return {"parameter": _finite(own), "profile": _finite(profile)}


def outcomes(
    config: Path,
    inputs: Sequence[Path],
    x: Sequence[float] | None,
    remembers: bool,
    start: StartKnowledge,
    grasp_std: float | None,
    sets: Sequence[Sequence[str]],
    inflation: float,
) -> list[dict[str, Any]]:
    """Task: expected information of the experiment with each set of changes, as plain data."""
    del inputs
    run, problem = _problem(config, remembers)
    other = second_arm(run, build_system(run))
    options = WhatIfOptions()
    setting = Setting(
        problem,
        unknown_vector(problem, x),
        start,
        grasp_std,
        None if other is None else with_grasp_offsets(other),
        options.torque_std,
        options.seed,
    )
    return [_finite(asdict(entry)) for entry in judged_changes(setting, sets, inflation)]


def _problem(config: Path, remembers: bool) -> tuple[Run, EstimationProblem]:
    run = load_config(config)
    problem = build_problem(run, build_step(run, with_grasp_offsets(build_system(run))))
    return run, problem if remembers else without_memory(problem)


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


def _profile(told: Mapping[str, Any]) -> Profile:
    values, deltas = (np.array([_number(x) for x in told[key]]) for key in ("values", "delta_chi2"))
    return Profile(
        told["name"], _number(told["value"]), told["lower"], told["upper"], values, deltas, tuple(told["notes"])
    )


def _outcome(told: Mapping[str, Any]) -> Outcome:
    std = {name: _number(value) for name, value in told["std_relative"].items()}
    own = {"changes": tuple(told["changes"]), "std_relative": std, "gain": _number(told["gain"])}
    return Outcome(**{**told, **own})

"""The command `solve`: estimates the free parameters, predicts held-out recordings, writes the run folder."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.analysis.plausibility import check_fit
from yid_ocp.analysis.profile import with_intervals
from yid_ocp.analysis.start_in_motion import safe_start
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import Run
from yid_ocp.data.doubt import Doubt
from yid_ocp.model.cable import Cable
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.outcome import EpisodeResult
from yid_ocp.problem.validation import channel_errors
from yid_ocp.progress import SILENT, Progress
from yid_ocp.report.summaries import solve_summary
from yid_ocp.solvers import Iterate, Solution, Status, solve
from yid_ocp.solvers.judgement import distrusted, known_covariance
from yid_ocp.workflow.build import build_cable, build_problem
from yid_ocp.workflow.command import DONE, FAILED, carry_out
from yid_ocp.workflow.doubts import doubts_result
from yid_ocp.workflow.folder import new_run_folder
from yid_ocp.workflow.held_out import guess_doubts, held_out_entry, worse_than_guess
from yid_ocp.workflow.refine import Discretisation, counted, discretisation, steadied, wanted
from yid_ocp.workflow.torque_offsets import torque_offsets
from yid_ocp.workflow.trajectories import write_trajectories

FORMAT = "yid-solve/1"


@dataclass(frozen=True)
class SolveOutcome:
    """Result of `run_solve`.

    Attributes
    ----------
    folder : Path
        The finished run folder.
    result : dict
        Contents of result.json.
    solution : Solution
    problem : EstimationProblem
    """

    folder: Path
    result: dict[str, Any]
    solution: Solution
    problem: EstimationProblem

    @property
    def ok(self) -> bool:
        """Whether the solver converged."""
        return self.solution.status == Status.CONVERGED


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    settings = load_config(arguments.config, arguments.overrides)
    outcome = carry_out(lambda shown: run_solve(settings, arguments.out, shown), solve_summary, arguments)
    return DONE if outcome.ok else FAILED


def run_solve(run: Run, out: str | Path | None = None, progress: Progress = SILENT) -> SolveOutcome:
    """Estimate, validate and write the run folder.

    Parameters
    ----------
    run : Run
    out : str or Path, optional
        The run folder; see `new_run_folder`.
    progress : Progress, optional

    Returns
    -------
    SolveOutcome
        Also where the solver failed: the run folder then holds the reason and the best point.

    Raises
    ------
    ConfigError, DataError, ModelError, OutputError
    """
    with new_run_folder(run, out) as folder:
        folder.begin(run, "solve")
        progress.stage("building the model and its compiled step")
        problem = build_problem(run)
        progress.stage(f"solving for {len(problem.start)} unknowns by {run.solver.name}")

        def iterate(entry: Iterate) -> None:
            values = {name: float(value) for name, value in zip(problem.shared, entry.x, strict=False)}
            folder.log("iterate", iteration=entry.iteration, cost=entry.cost, gradient=entry.gradient, x=values)
            progress.iterate(entry)

        solution = solve(problem, run.solver, callback=iterate, limits=run.diagnosis.of_a_fit)
        safe = safe_start(problem, run.solver, solution, run.diagnosis.of_a_fit)
        solution, stability = steadied(safe.problem, safe.solution)
        problem = solution.problem or safe.problem
        solution = with_intervals(problem, solution, progress)
        finer = Discretisation({})
        if solution.evaluation is not None:
            finer = discretisation(run, problem, solution.x, solution.evaluation, wanted(run), progress)
        # the ± and the verdict of everything below count how far the estimate is from a fine model's
        data_std, solution = solution.std, counted(solution, finer)
        progress.stage("predicting the held-out recordings")
        held_out = problem.validate(solution.x)
        cable = build_cable(run)
        solution, doubts = doubted(problem, solution, held_out, cable)
        folder.log("end", status=solution.status.value, message=solution.message, seconds_solving=solution.seconds)
        write_trajectories(folder.path / "trajectories.h5", problem, solution, held_out)
        more = {
            "doubts": doubts_result(doubts),
            "safeguard": safe.message,
            "covariance": covariance_result(solution, data_std),
            "discretisation": finer.result(data_std),
            "discretisation_notes": list(finer.notes),
            "stability": stability,
            "torque_offsets": {} if solution.evaluation is None else torque_offsets(problem, solution.x),
        }
        written = folder.finish(solve_result(problem, solution, held_out, cable) | more)
        folder.report(run, written, progress, problem=problem, solution=solution, held_out=tuple(held_out))
    return SolveOutcome(folder.path, written, solution, problem)


def doubted(
    problem: EstimationProblem,
    solution: Solution,
    held_out: Sequence[tuple[Episode, EpisodeResult | str]],
    cable: Cable | None = None,
) -> tuple[Solution, tuple[Doubt, ...]]:
    """The solution with untrusted verdicts where its fit raises issues, and all issues of the data.

    Parameters
    ----------
    problem : EstimationProblem
        As it was solved.
    solution : Solution
    held_out : sequence of (Episode, EpisodeResult or str)
        From `EstimationProblem.validate`.
    cable : Cable, optional
        For the baselines that it has.
    """
    if solution.evaluation is None:
        return solution, problem.options.doubts
    fitted, predicted, residuals = _predictions(problem, solution, held_out, cable)
    found = check_fit(problem, solution.x, solution.evaluation) + guess_doubts([*predicted, *fitted], _units(residuals))
    if all(doubt.weight == "warning" for doubt in found):
        return solution, (*problem.options.doubts, *found)
    believed = replace(solution.fit, believed=False)
    solution = replace(solution, fit=believed, parameters=distrusted(solution.parameters))
    return solution, (*problem.options.doubts, *found)


def covariance_result(solution: Solution, data_std: Mapping[str, float]) -> dict[str, Any]:
    """Covariance of the shared free parameters as plain data, from the data alone.

    How far a finer model is counts in the reported ±, not here: another run of this model is as far from it.
    """
    names = [name for name in data_std if name in solution.names]
    at = [solution.names.index(name) for name in names]
    if not solution.covariance.size:
        return {"names": [], "matrix": []}
    return known_covariance(names, solution.covariance[np.ix_(at, at)], [data_std[name] for name in names])


def solve_result(
    problem: EstimationProblem,
    solution: Solution,
    held_out: Sequence[tuple[Episode, EpisodeResult | str]],
    cable: Cable | None = None,
) -> dict[str, Any]:
    """Entries of `yid-solve/1` without inputs and versions."""
    fitted, predicted, residuals = _predictions(problem, solution, held_out, cable)
    return {
        "format": FORMAT,
        "status": solution.status.value,
        "message": solution.message,
        "parameters": {name: asdict(entry) for name, entry in solution.parameters.items()},
        "cost": solution.cost,
        "iterations": solution.iterations,
        "evaluations": solution.evaluations,
        "seconds": solution.seconds,
        "fit": asdict(solution.fit) | {"worse_than_guess": worse_than_guess([*predicted, *fitted], _units(residuals))},
        "residuals": residuals,
        "held_out": predicted,
    }


def _predictions(
    problem: EstimationProblem,
    solution: Solution,
    held_out: Sequence[tuple[Episode, EpisodeResult | str]],
    cable: Cable | None,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], Mapping[str, Any]]:
    """Errors of the recordings that were fitted and of those held out beside guesses, and of every channel fitted."""
    residuals: Mapping[str, Any] = {}
    fitted: list[dict[str, Any]] = []
    if solution.evaluation is not None:
        done = solution.predicted
        able = [(r, e) for r, e in zip(done, problem.episodes, strict=True) if not isinstance(r, str)]
        residuals = channel_errors([result for result, _ in able], [episode for _, episode in able])
        fitted = [held_out_entry(problem, *pair, cable) for pair in zip(problem.episodes, done, strict=True)]
    return fitted, [held_out_entry(problem, episode, outcome, cable) for episode, outcome in held_out], residuals


def _units(residuals: Mapping[str, Any]) -> dict[str, str]:
    """Unit of every channel."""
    return {channel: entry["unit"] for channel, entry in residuals.items()}

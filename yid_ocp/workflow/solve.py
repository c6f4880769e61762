"""The command `solve`: estimate the free parameters, predict the held-out recordings, write the run folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from yid_ocp.config.settings import Run, dump_config
from yid_ocp.errors import OutputError
from yid_ocp.model.cable import Cable
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.prediction import EpisodeResult
from yid_ocp.problem.validation import channel_errors
from yid_ocp.report.html import write_report
from yid_ocp.report.sections import Findings
from yid_ocp.solvers import Solution, Status, solve
from yid_ocp.workflow.build import build_cable, build_problem
from yid_ocp.workflow.folder import Monitor, Silent, both, input_hashes, new_run_folder, versions
from yid_ocp.workflow.held_out import held_out_entry

FORMAT = "yid-solve/1"
TRAJECTORIES = "yid-trajectories/1"


@dataclass(frozen=True)
class SolveOutcome:
    """What `run_solve` leaves.

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


def run_solve(run: Run, out: str | Path | None = None, monitor: Monitor | None = None) -> SolveOutcome:
    """Estimate, validate and write the run folder.

    Parameters
    ----------
    run : Run
    out : str or Path, optional
        The run folder; see `new_run_folder`.
    monitor : Monitor, optional
        Told about stages and iterates.

    Returns
    -------
    SolveOutcome
        Also where the solver failed: the run folder then holds the reason and the best point.

    Raises
    ------
    ConfigError, DataError, ModelError, OutputError
    """
    watcher = monitor or Silent()
    with new_run_folder(run, out) as folder:
        inputs = input_hashes(run)
        folder.write("config.yaml", dump_config(run))
        watcher.stage("building the model and its compiled step")
        folder.log("start", command="solve", versions=versions(), inputs=inputs)
        problem = build_problem(run)
        watcher.stage(f"solving for {len(problem.start)} unknowns by {run.solver.name}")

        def note(entry: Any) -> None:
            values = {name: float(value) for name, value in zip(problem.shared, entry.x, strict=False)}
            folder.log("iterate", iteration=entry.iteration, cost=entry.cost, gradient=entry.gradient, x=values)

        solution = solve(problem, run.solver.method, callback=both(note, watcher.iterate))
        watcher.stage("predicting the held-out recordings")
        held_out = problem.validate(solution.x)
        result = solve_result(problem, solution, held_out, build_cable(run)) | {
            "inputs": inputs,
            "versions": versions(),
        }
        folder.log("end", status=solution.status.value, message=solution.message, seconds_solving=solution.seconds)
        write_trajectories(folder.path / "trajectories.h5", problem, solution, held_out)
        written = folder.write_json("result.json", result)
        if run.output.report:
            watcher.stage("writing the report")
            findings = Findings(run.name, run.description, written, problem, solution, tuple(held_out))
            write_report(folder.path / "report.html", findings)
    return SolveOutcome(folder.path, written, solution, problem)


def solve_result(
    problem: EstimationProblem,
    solution: Solution,
    held_out: Sequence[tuple[Episode, EpisodeResult | str]],
    cable: Cable | None = None,
) -> dict[str, Any]:
    """`yid-solve/1` without inputs and versions; a cable has baselines of its own."""
    residuals: Mapping[str, Any] = {}
    if solution.evaluation is not None:
        residuals = channel_errors(solution.evaluation.episodes, problem.episodes)
    return {
        "format": FORMAT,
        "status": solution.status.value,
        "message": solution.message,
        "parameters": {name: asdict(entry) for name, entry in solution.parameters.items()},
        "cost": solution.cost,
        "iterations": solution.iterations,
        "evaluations": solution.evaluations,
        "seconds": solution.seconds,
        "residuals": residuals,
        "held_out": [held_out_entry(problem, episode, outcome, cable) for episode, outcome in held_out],
    }


def write_trajectories(
    path: Path, problem: EstimationProblem, solution: Solution, held_out: Sequence[tuple[Episode, EpisodeResult | str]]
) -> None:
    """Trajectories, predictions and the unknowns with their covariance, as `yid-trajectories/1` (HDF5).

    `unknowns/`: names, x, covariance. `recordings/NAME/`: `t` (N+1,) [s], `q`, `p` (N+1, n), `multipliers` (N, m)
    [N s], `torque` (N, nu) [N m], `effort` (N, nc) [N m], and for every sensor `GROUP/` with `t`, `measured`,
    `predicted`, `std` and the attributes `channels`, `unit`.

    Raises
    ------
    OutputError
    """
    pairs: list[tuple[str, Episode, EpisodeResult | str]] = [("held_out", *pair) for pair in held_out]
    if solution.evaluation is not None:
        done = solution.evaluation.episodes
        pairs = [("estimate", e, r) for e, r in zip(problem.episodes, done, strict=True)] + pairs
    text = h5py.string_dtype()
    try:
        with h5py.File(path, "w") as file:
            file.attrs["format"] = TRAJECTORIES
            unknowns = file.create_group("unknowns")
            unknowns.attrs["names"] = np.array(solution.names, dtype=text)
            unknowns.create_dataset("x", data=solution.x)
            unknowns.create_dataset("covariance", data=solution.covariance)
            for role, episode, outcome in pairs:
                group = file.require_group("recordings").create_group(episode.name)
                group.attrs["role"] = role
                group.attrs["joints"] = np.array(problem.system.mechanism.joint_names, dtype=text)
                if isinstance(outcome, str):
                    group.attrs["message"] = outcome
                    continue
                _write_episode(group, problem, episode, outcome)
    except OSError as error:
        raise OutputError(f"the trajectories cannot be written: {error}", where=str(path)) from error


def _write_episode(group: h5py.Group, problem: EstimationProblem, episode: Episode, outcome: EpisodeResult) -> None:
    n, rollout = problem.system.size, outcome.rollout
    arrays = {
        "t": episode.grid.times,
        "q": rollout.state[:, :n],
        "p": rollout.state[:, n : 2 * n],
        "multipliers": rollout.multipliers,
        "torque": rollout.torque,
        "effort": rollout.effort,
    }
    for name, array in arrays.items():
        group.create_dataset(name, data=array, compression="gzip", shuffle=True)
    for samples, predicted in zip(episode.samples, outcome.predicted, strict=True):
        part = group.create_group(samples.sensor.group)
        part.attrs["channels"] = np.array(samples.sensor.channels, dtype=h5py.string_dtype())
        part.attrs["unit"] = samples.sensor.unit
        times = episode.grid.start + problem.step.time_step * (samples.node + samples.fraction)
        for name, array in (("t", times), ("measured", samples.value), ("predicted", predicted), ("std", samples.std)):
            part.create_dataset(name, data=array, compression="gzip", shuffle=True)

"""The command `identifiability`: what the recordings of a run can tell, and what another experiment would."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from yid_ocp.analysis.identifiability import (
    GRASP_STD,
    Identifiability,
    StartKnowledge,
    identifiability,
    with_grasp_offsets,
)
from yid_ocp.analysis.what_if import Outcome, WhatIf, what_if
from yid_ocp.config.settings import GraspSettings, Run, dump_config
from yid_ocp.errors import YidError
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem
from yid_ocp.report.html import write_report
from yid_ocp.report.sections import Findings
from yid_ocp.solvers import Solution, Status, solve
from yid_ocp.workflow.build import build_problem, build_step, build_system
from yid_ocp.workflow.folder import Monitor, Silent, both, input_hashes, new_run_folder, versions

FORMAT = "yid-identifiability/1"
MOST_INTERVALS, MOST_UNKNOWNS = 12, 300  # beyond, profiles take long and are worked out only where asked for
OTHER_SIDE = {"left": "right", "right": "left"}


@dataclass(frozen=True)
class Question:
    """What is asked of a run beyond its settings.

    Attributes
    ----------
    at : "solution" or "initial"
        Point at which to judge: where the solver ends, or the initial values, without solving.
    start : "unknown" or "known"
        Whether initial states are estimated along.
    grasp_std : float or None
        Prior deviation of where the grasps sit [m]; None for grasps that are known.
    intervals : "auto", "all" or sequence of str
        Parameters whose interval by profile likelihood is wanted; `auto` for all of a small problem, none of a large
        one.
    what_if : bool
        Whether to rank changes of the experiment.
    """

    at: Literal["solution", "initial"] = "solution"
    start: StartKnowledge = "unknown"
    grasp_std: float | None = GRASP_STD
    intervals: Literal["auto", "all"] | Sequence[str] = "auto"
    what_if: bool = False


@dataclass(frozen=True)
class IdentifiabilityOutcome:
    """What `run_identifiability` leaves: the run folder, result.json's contents, the analysis where there is one."""

    folder: Path
    result: dict[str, Any]
    information: Identifiability | None

    @property
    def ok(self) -> bool:
        """Whether there was a point at which to judge."""
        return self.information is not None


def run_identifiability(
    run: Run, out: str | Path | None = None, monitor: Monitor | None = None, question: Question | None = None
) -> IdentifiabilityOutcome:
    """Solve, judge and write the run folder.

    Parameters
    ----------
    run : Run
    out : str or Path, optional
        The run folder; see `new_run_folder`.
    monitor : Monitor, optional
    question : Question, optional

    Returns
    -------
    IdentifiabilityOutcome
        Also where the solver failed: the run folder then holds the reason.

    Raises
    ------
    ConfigError, DataError, ModelError, SolverError, OutputError
    """
    asked = question or Question()
    watcher = monitor or Silent()
    with new_run_folder(run, out, "identifiability") as folder:
        inputs = input_hashes(run)
        folder.write("config.yaml", dump_config(run))
        watcher.stage("building the model and its compiled step")
        folder.log("start", command="identifiability", versions=versions(), inputs=inputs)
        system = build_system(run)
        problem = build_problem(run, build_step(run, _nuisanced(system, asked)))
        solution: Solution | None = None
        information: Identifiability | None = None
        ranking: WhatIf | None = None
        known: Identifiability | None = None
        if asked.at == "solution":
            watcher.stage(f"solving for {len(problem.start)} unknowns by {run.solver.name}")

            def note(entry: Any) -> None:
                folder.log("iterate", iteration=entry.iteration, cost=entry.cost, seconds=entry.seconds)

            solution = solve(problem, run.solver.method, callback=both(note, watcher.iterate))
        if solution is None or solution.status != Status.FAILED:
            watcher.stage("Fisher information")
            known = identifiability(problem, solution, start="known", grasp_std=None)
            information = identifiability(problem, solution, start=asked.start, grasp_std=asked.grasp_std)
            wanted = _wanted(information, asked)
            if wanted:
                watcher.stage(f"intervals of {len(wanted)} parameters by profile likelihood")
                information = identifiability(
                    problem, solution, start=asked.start, grasp_std=asked.grasp_std, intervals=wanted
                )
        if information is not None and asked.what_if:
            other = second_arm(run, system)
            ranking = what_if(
                problem,
                solution,
                start=asked.start,
                grasp_std=asked.grasp_std,
                second_arm=None if other is None else _nuisanced(other, asked),
                progress=watcher.stage,
            )
        result = identifiability_result(problem, solution, information, known, ranking, asked) | {
            "inputs": inputs,
            "versions": versions(),
        }
        folder.log("end", status=result["status"], message=result["message"])
        written = folder.write_json("result.json", result)
        if run.output.report:
            watcher.stage("writing the report")
            findings = Findings(run.name, run.description, written, solution=solution)
            write_report(folder.path / "report.html", findings)
    return IdentifiabilityOutcome(folder.path, written, information)


def _wanted(information: Identifiability, asked: Question) -> Sequence[str]:
    """Parameters whose intervals are worked out."""
    if asked.intervals not in ("auto", "all"):
        return asked.intervals
    count = len(information.names)
    small = count <= MOST_INTERVALS and count + len(information.nuisances) <= MOST_UNKNOWNS
    return information.names if small or asked.intervals == "all" else ()


def _nuisanced(system: System, asked: Question) -> System:
    return system if asked.grasp_std is None else with_grasp_offsets(system)


def second_arm(run: Run, system: System) -> System | None:
    """The run's system with the robot's other arm at a free end of the object; None where there is no such thing."""
    model = run.model
    joints = model.arms.joints
    if joints is None or model.arms.mode != "driven" or len(model.grasp) != 1:
        return None
    side, grasp = next(iter(model.grasp.items()))
    prefix = f"{side}_"
    if side not in OTHER_SIDE or not all(name.startswith(prefix) for name in (*joints, grasp.holder)):
        return None
    parents = {segment.parent for segment in system.segments}
    free = [f"w_{s.name}" for s in system.segments if s.name not in parents and f"w_{s.name}" != grasp.held]
    if not free:
        return None

    def mirrored(name: str) -> str:
        return f"{OTHER_SIDE[side]}_{name.removeprefix(prefix)}"

    arms = replace(model.arms, joints=(*joints, *(mirrored(name) for name in joints)))
    added = GraspSettings(holder=mirrored(grasp.holder), held=free[0], kind=grasp.kind, rpy=grasp.rpy)
    changed = replace(model, arms=arms, grasp={**model.grasp, OTHER_SIDE[side]: added})
    try:
        return build_system(replace(run, model=changed))
    except YidError:
        # the robot has no other arm of that name
        return None


def identifiability_result(
    problem: EstimationProblem,
    solution: Solution | None,
    information: Identifiability | None,
    known: Identifiability | None,
    ranking: WhatIf | None,
    asked: Question,
) -> dict[str, Any]:
    """`yid-identifiability/1` without inputs and versions."""
    result: dict[str, Any] = {
        "format": FORMAT,
        "status": "not_solved" if solution is None else solution.status.value,
        "message": "judged at the initial values" if solution is None else solution.message,
        "at": asked.at,
        "start": asked.start,
        "grasp_std": asked.grasp_std if problem.system.grasps else None,
        "parameters": {},
        "correlations": {"names": [], "matrix": []},
        "directions": [],
        "nuisances": 0,
        "chi2_per_dof": None if solution is None else solution.chi2_per_dof,
        "profiles": {},
        "what_if": None,
    }
    if information is None or known is None:
        return result
    for name, entry in information.parameters.items():
        sure = known.parameters[name]
        own = {"std_relative_known": sure.std_relative, "verdict_known": sure.verdict}
        result["parameters"][name] = asdict(entry) | own
    result["correlations"] = {"names": information.names, "matrix": information.correlations}
    result["directions"] = [asdict(direction) for direction in information.directions]
    result["nuisances"] = len(information.nuisances)
    result["profiles"] = {
        name: {"values": profile.values, "delta_chi2": profile.delta_chi2, "notes": profile.notes}
        for name, profile in information.profiles.items()
    }
    if ranking is not None:
        result["what_if"] = {
            "base": _outcome(ranking.base),
            "singles": [_outcome(entry) for entry in ranking.singles],
            "smallest": [_outcome(entry) for entry in ranking.smallest],
            "greedy": [_outcome(entry) for entry in ranking.greedy],
            "searched": ranking.searched,
        }
    return result


def _outcome(entry: Outcome) -> dict[str, Any]:
    gain = entry.gain if entry.verdicts else None
    return asdict(entry) | {"gain": gain}

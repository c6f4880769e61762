"""The command `plan`: plans an arm motion with the identified model and writes it for simulation and robot."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import Run
from yid_ocp.data.hdf5 import write_recording
from yid_ocp.data.hdf5_file import open_hdf5
from yid_ocp.data.recording import JointGroup, PointGroup, Recording, validate
from yid_ocp.export.csv import export_csv
from yid_ocp.export.trajectory import joint_trajectory
from yid_ocp.integrator.step import Step
from yid_ocp.planning.information import InformationPlan
from yid_ocp.planning.plan import Known, Plan, plan
from yid_ocp.problem.grid import make_grid
from yid_ocp.problem.inputs import prescribed_path
from yid_ocp.problem.low_pass import LowPass
from yid_ocp.progress import SILENT, Progress
from yid_ocp.report.scene import Scene, Told, scene
from yid_ocp.report.summaries import plan_summary
from yid_ocp.workflow.build import build_cable, build_step, located, parameter_settings, read_recordings
from yid_ocp.workflow.command import DONE, FAILED, carry_out
from yid_ocp.workflow.folder import new_run_folder
from yid_ocp.workflow.information import information_result, informed, refuse_other_effects, run_result

FORMAT = "yid-plan/1"
EFFORT_STD, POINT_STD = 0.1, 1e-3  # stated in the recording of a plan, for whoever estimates on it [N m], [m]
Array = NDArray[np.float64]


@dataclass(frozen=True)
class PlanOutcome:
    """Result of `run_plan`: the run folder, the contents of result.json and the plan."""

    folder: Path
    result: dict[str, Any]
    plan: Plan | InformationPlan

    @property
    def ok(self) -> bool:
        """Whether the goal was reached within all limits."""
        return self.plan.reached


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    settings = load_config(arguments.config, arguments.overrides)
    outcome = carry_out(lambda shown: run_plan(settings, arguments.out, shown), plan_summary, arguments)
    return DONE if outcome.ok else FAILED


def run_plan(run: Run, out: str | Path | None = None, progress: Progress = SILENT) -> PlanOutcome:
    """Plan the motion of `plan` and write `recording.h5`, CSV tables, `trajectory.json`, result.json and the report.

    Parameters
    ----------
    run : Run
    out : str or Path, optional
        The run folder; see `new_run_folder`.
    progress : Progress, optional

    Returns
    -------
    PlanOutcome
        Also where no motion within the limits was found: the run folder then says why.

    Raises
    ------
    ConfigError, DataError, ModelError, OutputError
    """
    with new_run_folder(run, out, "plan") as folder:
        folder.begin(run, "plan")
        progress.stage("building the model and its compiled step")
        found: Plan | InformationPlan
        if run.plan.goal == "information":
            found, source = informed(run, progress)
        else:
            step = planning_step(run)
            theta, known, source = identified(run, step)
            options = replace(run.plan, posture=start_posture(run, step))
            with located(run, "plan"):
                found = plan(step, options, theta, known, progress)
        recording = as_recording(run, found)
        write_recording(recording, folder.path / "recording.h5")
        export_csv(recording, folder.path / "csv")
        trajectory = joint_trajectory(
            found.joints, found.t, found.position, found.velocity, found.acceleration, found.effort
        )
        folder.write("trajectory.json", json.dumps(trajectory, indent=1) + "\n")
        folder.log("end", reached=found.reached, message=found.message)
        told = plan_result(run, found) if isinstance(found, Plan) else information_result(run, found)
        written = folder.finish(motion_result(run, found, source) | told)
        more = {"plan" if isinstance(found, Plan) else "information": found}
        folder.report(run, written, progress, scenes=_scenes(found), more=more)
    return PlanOutcome(folder.path, written, found)


def planning_step(run: Run) -> Step:
    """The compiled step of a run with prescribed arms, for planning."""
    arms = replace(run.model.arms, mode="prescribed")
    model = replace(run.model, arms=arms)
    recordings = run.recordings if run.model.robot is None else replace(run.recordings, estimate=(), held_out=())
    return build_step(replace(run, model=model, recordings=recordings))


def start_posture(run: Run, step: Step) -> Mapping[str, float] | None:
    """Joint positions at the start of the motion: from the settings, else from the first recording.

    None where neither says it: then it begins where the arms first grasp the undeformed object. Two arms that hold a
    straight object are at its full stretch, from which it snaps to either side; a recording rarely begins there.

    Raises
    ------
    DataError
        The recording does not hold a joint that moves.
    """
    if run.plan.posture is not None or not run.recordings.estimate:
        return run.plan.posture
    recording, cable, system = read_recordings(run, "estimate")[0], build_cable(run), step.system
    clamps = () if cable is None else cable.clamps
    grid = make_grid(recording, step.time_step, run.problem.duration)
    with located(run, "recordings", "estimate", 0):
        path = prescribed_path(recording, system, grid, LowPass(run.problem.path_cutoff), clamps)
    return dict(zip(system.prescribed, map(float, path[0]), strict=True))


def identified(run: Run, step: Step) -> tuple[Array, Known, dict[str, Any]]:
    """Parameters, their covariance, and where both come from: a run folder of `solve`, or the settings.

    Raises
    ------
    ConfigError, DataError
        The folder is none of `solve`, its solve failed, or it had effects that this model has not.
    """
    parameters = step.system.parameters
    theta = parameters.vector()
    if run.plan.run is None:
        free = [name for name, said in parameter_settings(run, parameters).items() if said.free]
        return theta, Known(), {"run": None, "parameters": {name: parameters[name].value for name in free}}
    result, folder = run_result(run, ("solve",))
    solved = folder / "trajectories.h5"
    refuse_other_effects(run, result["parameters"], parameters.names)
    found = {name: entry["value"] for name, entry in result["parameters"].items() if name in parameters}
    for name, value in found.items():
        theta[parameters.index(name)] = value
    with open_hdf5(solved) as data:
        names = [str(name) for name in data["unknowns"].attrs["names"]]
        covariance = np.array(data["unknowns/covariance"])
    usable = [i for i, name in enumerate(names) if name in found and np.all(np.isfinite(covariance[i, i]))]
    lost = sorted(name for name, entry in result["parameters"].items() if entry["free"] and name in found)
    lost = [name for name in lost if name not in [names[i] for i in usable]]
    chosen = np.nan_to_num(covariance[np.ix_(usable, usable)])
    source = {"run": str(folder), "parameters": found, "uncertainty_unknown": lost}
    return theta, Known(tuple(names[i] for i in usable), chosen), source


def as_recording(run: Run, found: Plan | InformationPlan) -> Recording:
    """The planned motion as a recording: joints, and object points predicted by the model."""
    joints = JointGroup(
        found.joints, found.t, found.position, found.velocity, found.effort,
        position_command=found.position, velocity_command=found.velocity, effort_kind="sample",
        effort_std=EFFORT_STD, clock="nominal",
    )  # fmt: skip
    names = tuple(found.points)
    points: tuple[PointGroup, ...] = ()
    if names:
        position = np.stack([found.points[name] for name in names], axis=1)
        std = np.full(position.shape, POINT_STD)
        points = (PointGroup("points_planned", names, found.t, position, std, sensor="plan"),)
    truth = dict(zip(found.mover.step.system.parameters.names, map(float, found.mover.theta), strict=True))
    text = f"{run.description} Planned motion, goal {run.plan.goal}.".strip()
    return validate(Recording(joints, points, text, "yid_ocp plan", "recording", truth=truth))


def motion_result(run: Run, found: Plan | InformationPlan, source: dict[str, Any]) -> dict[str, Any]:
    """Entries of `yid-plan/1` common to all goals, without inputs and versions."""
    joints = found.mover.step.system.mechanism.joints
    limits = [joints[i] for i in found.mover.joints]
    shares = {
        joint.name: {
            "velocity": _share(found.velocity[:, i], joint.velocity_limit),
            "effort": _share(found.effort[:, i], joint.effort_limit),
            "travel": float(np.ptp(found.position[:, i])),
        }
        for i, joint in enumerate(limits)
    }
    return {
        "format": FORMAT,
        "status": "done" if found.reached else "failed",
        "message": found.message,
        "goal": run.plan.goal,
        "duration": found.mover.path.duration,
        "settle": run.plan.settle,
        "joints": shares,
        "from": source,
    }


def plan_result(run: Run, found: Plan) -> dict[str, Any]:
    """Entries of `yid-plan/1` for a point that is moved to a target."""
    return {
        "point": run.plan.point,
        "place": found.place.tolist(),
        "error": found.error,
        "swing": found.swing,
        "off_path": found.off_path,
        "time_step": found.mover.step.time_step,
        "std": None if found.std is None else found.std.tolist(),
        "tolerance": run.plan.tolerance,
        "evaluations": found.evaluations,
    }


def _scenes(found: Plan | InformationPlan) -> list[Scene]:
    """The planned motion, as the model has it."""
    system = found.mover.step.system
    state = found.state if isinstance(found, Plan) else found.rollout.state
    return [scene("planned", [Told("planned", system, found.mover.theta, found.t, state[:, : system.size])])]


def _share(values: Array, limit: float) -> float | None:
    return float(np.max(np.abs(values)) / limit) if math.isfinite(limit) and limit > 0 else None

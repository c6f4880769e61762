"""The command `plan`: motions of the arms with the identified model, to a target or for information."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import RunSettings
from yid_ocp.data.hdf5_io import open_checked_hdf5
from yid_ocp.data.recording import JointGroup, PointGroup, Recording, validate_recording
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.errors import DataError
from yid_ocp.export.signals import export_csv, joint_trajectory_message
from yid_ocp.integrator.step import Step
from yid_ocp.planning.information_plan import InformativeMotionPlan, plan_informative_motion
from yid_ocp.planning.motion_plan import MotionPlan, ParameterCovariance, plan_motion
from yid_ocp.problem.measurements import make_time_grid
from yid_ocp.problem.recorded_inputs import prescribed_path
from yid_ocp.problem.signal_filters import LowPassFilter
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.report.animation import Animation, ModelTrajectory, make_animation
from yid_ocp.report.summaries import plan_summary
from yid_ocp.workflow.build import build_cable, build_step, parameter_settings
from yid_ocp.workflow.build_problem import build_problem
from yid_ocp.workflow.command_runner import CommandResult, run_and_print
from yid_ocp.workflow.run_folder import new_run_folder
from yid_ocp.workflow.run_history import require_current_format
from yid_ocp.workflow.run_inputs import locate_errors, read_recordings

_RESULT_FORMAT = "yid-plan/1"
_EFFORT_STD, _POINT_STD = 0.1, 1e-3  # stated in the recording of a plan, for whoever estimates on it [N m], [m]
Array = NDArray[np.float64]


@dataclass(frozen=True)
class PlanCommandResult(CommandResult):
    """Result of `run_plan` with the plan; successful where the goal was reached within all limits."""

    plan: MotionPlan | InformativeMotionPlan


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    settings = load_config(arguments.config, arguments.overrides)
    return run_and_print(arguments, lambda shown: run_plan(settings, arguments.out, shown), plan_summary)


def run_plan(run: RunSettings, out: str | Path | None = None, progress: Progress = NULL_PROGRESS) -> PlanCommandResult:
    """Plan the motion of a run's goal; write `recording.h5`, CSV tables, `trajectory.json`, result.json and the report.

    Returns
    -------
    PlanCommandResult
        Also where no motion within the limits was found: the run folder then says why.

    Raises
    ------
    ConfigError, DataError, ModelError, OutputError
    """
    with new_run_folder(run, out, "plan") as folder:
        folder.begin_run(run, "plan")
        progress.begin_stage("building the model and its compiled step")
        found: MotionPlan | InformativeMotionPlan
        if run.plan.goal == "information":
            found, source = _plan_from_settings(run, progress)
        else:
            step = compile_planning_step(run)
            theta, known, source = identified_parameters(run, step)
            options = replace(run.plan, start_joint_positions=start_configuration(run, step))
            with locate_errors(run, "plan"):
                found = plan_motion(step, options, theta, known, progress)
        recording = _plan_as_recording(run, found)
        write_recording(recording, folder.path / "recording.h5")
        export_csv(recording, folder.path / "csv")
        trajectory = joint_trajectory_message(
            found.joint_names,
            found.t,
            found.joint_positions,
            found.joint_velocities,
            found.joint_accelerations,
            found.joint_efforts,
        )
        folder.write_text_file("trajectory.json", json.dumps(trajectory, indent=1) + "\n")
        folder.log_event("end", reached=found.is_successful, message=found.message)
        told = _plan_result(run, found) if isinstance(found, MotionPlan) else _information_plan_result(run, found)
        written = folder.write_result(_motion_result(run, found, source) | told)
        more = {"plan" if isinstance(found, MotionPlan) else "information": found}
        folder.write_report_page(run, written, progress, animations=_scenes(found), section_data=more)
    return PlanCommandResult(folder.path, written, found, is_successful=found.is_successful)


def compile_planning_step(run: RunSettings) -> Step:
    """The compiled step of a run with prescribed arms, for planning."""
    arms = replace(run.model.arms, mode="prescribed")
    model = replace(run.model, arms=arms)
    recordings = run.recordings if run.model.robot is None else replace(run.recordings, estimate=(), held_out=())
    return build_step(replace(run, model=model, recordings=recordings))


def start_configuration(run: RunSettings, step: Step) -> Mapping[str, float] | None:
    """Joint positions at the start of the motion: from the settings, else from the first recording.

    None where neither says it: then it begins where the arms first grasp the undeformed object. Two arms that hold a
    straight object are at its full stretch, from which it snaps to either side; a recording rarely begins there.

    Raises
    ------
    DataError
        The recording does not hold a joint that moves.
    """
    if run.plan.start_joint_positions is not None or not run.recordings.estimate:
        return run.plan.start_joint_positions
    recording, cable, system = read_recordings(run, "estimate")[0], build_cable(run), step.system
    clamps = () if cable is None else cable.clamp_paths
    grid = make_time_grid(recording, step.time_step, run.problem.duration)
    with locate_errors(run, "recordings", "estimate", 0):
        path = prescribed_path(recording, system, grid, LowPassFilter(run.problem.path_cutoff), clamps)
    return dict(zip(system.prescribed, map(float, path[0]), strict=True))


def identified_parameters(run: RunSettings, step: Step) -> tuple[Array, ParameterCovariance, dict[str, Any]]:
    """Parameters, their covariance, and where both come from: a run folder of `solve`, or the settings.

    Raises
    ------
    ConfigError, DataError
        The folder is none of `solve`, its solve failed, or it had effects that this model has not.
    """
    parameters = step.system.parameters
    theta = parameters.vector()
    if run.plan.parameter_run is None:
        free = [name for name, said in parameter_settings(run, parameters).items() if said.free]
        return (
            theta,
            ParameterCovariance(),
            {"run": None, "parameters": {name: parameters[name].value for name in free}},
        )
    result, folder = _read_parameter_run(run, ("solve",))
    solved = folder / "trajectories.h5"
    _require_same_effects(run, result["parameters"], parameters.names)
    found = {name: entry["value"] for name, entry in result["parameters"].items() if name in parameters}
    for name, value in found.items():
        theta[parameters.index(name)] = value
    with open_checked_hdf5(solved) as data:
        names = [str(name) for name in data["unknowns"].attrs["names"]]
        covariance = np.array(data["unknowns/covariance"])
    usable = [i for i, name in enumerate(names) if name in found and np.all(np.isfinite(covariance[i, i]))]
    lost = sorted(name for name, entry in result["parameters"].items() if entry["free"] and name in found)
    lost = [name for name in lost if name not in [names[i] for i in usable]]
    chosen = np.nan_to_num(covariance[np.ix_(usable, usable)])
    source = {"run": str(folder), "parameters": found, "uncertainty_unknown": lost}
    return theta, ParameterCovariance(tuple(names[i] for i in usable), chosen), source


def _plan_as_recording(run: RunSettings, found: MotionPlan | InformativeMotionPlan) -> Recording:
    joints = JointGroup(
        found.joint_names, found.t, found.joint_positions, found.joint_velocities, found.joint_efforts,
        position_command=found.joint_positions, velocity_command=found.joint_velocities, effort_kind="sample",
        effort_std=_EFFORT_STD, clock="nominal",
    )  # fmt: skip
    names = tuple(found.point_trajectories)
    points: tuple[PointGroup, ...] = ()
    if names:
        position = np.stack([found.point_trajectories[name] for name in names], axis=1)
        std = np.full(position.shape, _POINT_STD)
        points = (PointGroup("points_planned", names, found.t, position, std, sensor="plan"),)
    truth = dict(zip(found.simulator.step.system.parameters.names, map(float, found.simulator.theta), strict=True))
    text = f"{run.description} Planned motion, goal {run.plan.goal}.".strip()
    return validate_recording(Recording(joints, points, text, "yid_ocp plan", "recording", true_parameters=truth))


def _motion_result(
    run: RunSettings, found: MotionPlan | InformativeMotionPlan, source: dict[str, Any]
) -> dict[str, Any]:
    joints = found.simulator.step.system.mechanism.joints
    limits = [joints[i] for i in found.simulator.joint_indices]
    shares = {
        joint.name: {
            "velocity": _share(found.joint_velocities[:, i], joint.velocity_limit),
            "effort": _share(found.joint_efforts[:, i], joint.effort_limit),
            "travel": float(np.ptp(found.joint_positions[:, i])),
        }
        for i, joint in enumerate(limits)
    }
    return {
        "format": _RESULT_FORMAT,
        "status": "done" if found.is_successful else "failed",
        "message": found.message,
        "goal": run.plan.goal,
        "duration": found.simulator.path.duration,
        "settle": run.plan.hold_duration,
        "joints": shares,
        "from": source,
    }


def _plan_result(run: RunSettings, found: MotionPlan) -> dict[str, Any]:
    return {
        "point": run.plan.point,
        "place": found.target_position.tolist(),
        "error": found.max_position_error,
        "swing": found.max_residual_speed,
        "off_path": found.max_path_deviation,
        "time_step": found.simulator.step.time_step,
        "std": None if found.end_position_std is None else found.end_position_std.tolist(),
        "tolerance": run.plan.position_tolerance,
        "evaluations": found.n_evaluations,
    }


def _scenes(found: MotionPlan | InformativeMotionPlan) -> list[Animation]:
    """The planned motion, as the model has it."""
    system = found.simulator.step.system
    state = found.rollout.state
    return [
        make_animation(
            "planned",
            [ModelTrajectory("planned", system, found.simulator.theta, found.t, state[:, : system.n_coordinates])],
        )
    ]


def _share(values: Array, limit: float) -> float | None:
    return float(np.max(np.abs(values)) / limit) if math.isfinite(limit) and limit > 0 else None


_MAX_DISCRIMINATED_EFFECTS = 3  # effects that one motion is asked to separate, the likeliest ones


def _read_parameter_run(run: RunSettings, commands: Sequence[str]) -> tuple[dict[str, Any], Path]:
    """Contents of result.json in the folder of `plan.parameter_run`, and the folder."""
    folder = Path(str(run.plan.parameter_run))
    file = folder / "result.json"
    if not file.is_file() or not (folder / "trajectories.h5").is_file():
        what = f"there is no finished run of {' or '.join(f'`{command}`' for command in commands)} in {folder}"
        raise run.config_error(what, "plan", "parameter_run", hint="give the run folder that it printed")
    try:
        result: dict[str, Any] = dict(json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise DataError(f"the result cannot be read ({error})", where=str(file), hint="run it again") from error
    require_current_format(result, file)
    formats = {"solve": "yid-solve/1", "diagnose": "yid-diagnosis/2"}
    if result.get("format") not in [formats[command] for command in commands]:
        what = f"{folder} is a run folder of another command ({result.get('format')})"
        raise run.config_error(
            what, "plan", "parameter_run", allowed=" or ".join(formats[command] for command in commands)
        )
    if result.get("status") == "failed":
        raise DataError(
            f"the solve in {folder} failed: {result['message']}", where=run.describe_location("plan", "parameter_run")
        )
    return result, folder


def _plan_from_settings(run: RunSettings, progress: Progress) -> tuple[InformativeMotionPlan, dict[str, Any]]:
    """The most informative motion, and the source of its parameters: settings or a run folder."""
    problem = build_problem(run)
    free = {name: float(problem.theta[problem.system.parameters.index(name)]) for name in problem.free}
    sizes: dict[str, dict[str, float]] = {}
    source: dict[str, Any] = {"run": None, "parameters": free}
    if run.plan.parameter_run is not None:
        result, folder = _read_parameter_run(run, ("solve", "diagnose"))
        found, sizes = parameter_and_effect_values(result)
        _require_same_effects(run, found, problem.system.parameters.names)
        known = {name: value for name, value in found.items() if name in problem.system.parameters}
        source = {"run": str(folder), "parameters": free | known}
    with locate_errors(run, "plan"):
        plan = plan_informative_motion(problem, run.plan, source["parameters"], sizes, progress)
    return plan, source


def _require_same_effects(run: RunSettings, found: Iterable[str], own: Collection[str]) -> None:
    """Raise an error where the run has parameters of effects that the plan's model lacks."""
    lacking = sorted({name.rpartition(".")[0] for name in found if "@" in name and name not in own})
    if lacking:
        what = f"{run.plan.parameter_run} was solved with {', '.join(lacking)}, which this model does not have"
        hint = "list the same effects under model.effects"
        raise run.config_error(what, "plan", "parameter_run", allowed="a run of `solve` on the same model", hint=hint)


def parameter_and_effect_values(result: Mapping[str, Any]) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """Parameter values of a solve or diagnosis result, and effect sizes of a diagnosis, in display units."""
    if "parameters" in result:
        return {name: entry["value"] for name, entry in result["parameters"].items()}, {}
    sizes = {
        f"{entry['kind']}@{entry['location']}": {
            name: quantity["value"] for name, quantity in entry["parameters"].items() if quantity["value"] is not None
        }
        for entry in result["which"]
    }
    return {name: entry["before"] for name, entry in result["absorption"].items()}, sizes


def _information_plan_result(run: RunSettings, found: InformativeMotionPlan) -> dict[str, Any]:
    """Entries of `yid-plan/1` for an informative motion."""
    pairs = [
        {"effect": first, "explained_by": second, "before": before, "after": after}
        for (first, second), (before, after) in found.effect_distances.items()
    ]
    return {
        "inform": None if run.plan.identify is None else list(run.plan.identify),
        "separate": None if run.plan.discriminate is None else list(run.plan.discriminate),
        "parameters": {
            name: {
                "std_relative_before": _number(known.std_recorded),
                "std_relative_after": _number(known.std_planned),
                "std_relative_together": _number(known.std_combined),
                "verdict": known.verdict,
            }
            for name, known in found.parameter_precisions.items()
        },
        "distances": pairs,
        "starts": [
            {
                "first": start.initial_criterion,
                "value": start.final_criterion,
                "judged": _number(start.configured_criterion),
                "finished": start.is_converged,
                "rounds": start.n_iterations,
            }
            for start in found.start_results
        ],
        "best": found.best_start_index,
        "limits_reached": {what: list(names) for what, names in found.active_limits.items()},
        "unseen": dict(found.unobservable_parameters),
        "open": list(found.unidentifiable_directions),
    }


def next_plan_settings(confusable: Sequence[Sequence[Mapping[str, str]]], folder: Path) -> dict[str, Any] | None:
    """Settings of `plan` for a motion that discriminates confusable effects; None without any."""
    if not confusable:
        return None
    labels = [f"{entry['kind']}@{entry['location']}" for entry in confusable[0]]
    return {"goal": "information", "discriminate": labels[:_MAX_DISCRIMINATED_EFFECTS], "parameter_run": str(folder)}


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None

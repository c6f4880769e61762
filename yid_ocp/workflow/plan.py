"""The command `plan`: plan arm motions with the identified model, to a target or for information."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.config.settings import RunSettings
from yid_ocp.data.recording import JointGroup, PointGroup, Recording, validated_recording
from yid_ocp.data.recording_hdf5 import open_hdf5_after_read_check, write_recording
from yid_ocp.display import NULL_PROGRESS, Progress, effect_entry_label
from yid_ocp.export.signals import export_recording_csv_files, joint_trajectory_message
from yid_ocp.files import attributes_to_dict, write_text
from yid_ocp.integrator.step import Step
from yid_ocp.planning import motion_plan
from yid_ocp.planning.information_plan import InformativeMotionPlan, plan_informative_motion
from yid_ocp.planning.motion_plan import ParameterCovarianceBeforePlan, TargetMotionPlan
from yid_ocp.problem.measurements import rollout_time_grid
from yid_ocp.problem.recorded_inputs import prescribed_coordinates_at_nodes, select_path_cutoff
from yid_ocp.report.animation import ConfigurationTrajectory, animation_of_trajectories
from yid_ocp.sensors.signal_filters import ZeroPhaseLowPassFilter
from yid_ocp.workflow.build import build_step, build_system, cable_vertices_between_clamps, free_parameter_names
from yid_ocp.workflow.build_problem import build_problem
from yid_ocp.workflow.command_runner import CommandOutcome, make_command_function
from yid_ocp.workflow.run_folder import atomic_run_folder
from yid_ocp.workflow.run_history import read_estimation_result
from yid_ocp.workflow.run_inputs import add_setting_location_to_errors, read_recordings_of_role

_EFFORT_STD, _POINT_STD = 0.1, 1e-3  # stated noise in the recording of a plan, for later estimation [N m], [m]
_MAX_DISCRIMINATED_EFFECTS = 3  # number of effects that one motion discriminates, the most likely ones
_Plan = TargetMotionPlan | InformativeMotionPlan


def run_plan(
    run: RunSettings, out: str | Path | None = None, progress: Progress = NULL_PROGRESS
) -> CommandOutcome[_Plan]:
    """Plan a motion for `plan.goal`, and write it as recording, CSV and JSON, with result and report.

    The outcome is successful if the motion reaches the goal within all limits; otherwise result.json has the reason.
    """
    with atomic_run_folder(run, out, "plan") as folder:
        folder.record_run_start(run, "plan")
        progress.begin_stage("building the model and its compiled step")
        found: _Plan
        if run.plan.goal == "information":
            found, source = _plan_from_settings(run, progress)
        else:
            if run.model.arms.mode == "servo":  # prescribed arms have no parameters of servos
                run = replace(run, parameters={k: own for k, own in run.parameters.items() if ".servo_" not in k})
            prescribed = _run_with_prescribed_arms(run)
            system = build_system(prescribed)
            with add_setting_location_to_errors(run, "plan"):
                motion_plan.moved_point_and_boxed_frames(system, run.plan)  # unknown frames, before a step is compiled
            step = build_step(prescribed, system)
            theta, known, source = identified_parameters_with_covariance(run, step)
            options = replace(run.plan, start_joint_positions=_configured_or_recorded_start_positions(run, step))
            with add_setting_location_to_errors(run, "plan"):
                found = motion_plan.plan_motion_to_target(step, options, theta, known, progress)
        recording = _plan_as_recording(run, found)
        write_recording(recording, folder.path / "recording.h5")
        export_recording_csv_files(recording, folder.path / "csv")
        rates = (found.joint_velocities, found.joint_accelerations, found.joint_efforts)
        trajectory = joint_trajectory_message(found.joint_names, found.t, found.joint_positions, *rates)
        write_text(folder.path / "trajectory.json", json.dumps(trajectory, indent=1) + "\n")
        folder.log_event("end", reached=found.is_successful, message=found.message)
        told = _plan_result(run, found) if isinstance(found, TargetMotionPlan) else _information_plan_result(found)
        system, q = found.simulator.step.system, found.rollout.state[:, : found.simulator.step.system.n_coordinates]
        planned = ConfigurationTrajectory("planned", system, found.simulator.theta, found.t, q)
        goal = found.target_position if isinstance(found, TargetMotionPlan) else None
        scene = animation_of_trajectories("planned", [planned], goal=goal)
        shown: dict[str, Any] = {"animations": [scene], "section_data": {"plan": found}}
        written = folder.write_result_and_report(run, progress, _motion_result(run, found, source) | told, **shown)
    return CommandOutcome(folder.path, written, found, found.is_successful)


run_and_return_exit_code = make_command_function(run_plan)


def _run_with_prescribed_arms(run: RunSettings) -> RunSettings:
    """The run without recordings, unless its model needs them, whose arms move as planned."""
    model = replace(run.model, arms=replace(run.model.arms, mode="prescribed"))
    recordings = run.recordings if run.model.robot is None else replace(run.recordings, estimate=(), held_out=())
    return replace(run, model=model, recordings=recordings)


def _configured_or_recorded_start_positions(run: RunSettings, step: Step) -> Mapping[str, float] | None:
    """Return the joint positions at the start of the motion, from the settings or else from the first recording.

    None without both: the arms then grasp the undeformed object. Two arms hold it fully stretched, so it may snap.
    """
    if run.plan.start_joint_positions is not None or not run.recordings.estimate:
        return run.plan.start_joint_positions
    [recording], cable, system = read_recordings_of_role(run, count=1), cable_vertices_between_clamps(run), step.system
    clamps = () if cable is None else cable.clamp_pose_point_names
    grid = rollout_time_grid(recording, step.time_step, run.problem.duration)
    with add_setting_location_to_errors(run, "recordings", "estimate", 0):
        low_pass = ZeroPhaseLowPassFilter(run.problem.path_cutoff or select_path_cutoff([recording], system.prescribed))
        path = prescribed_coordinates_at_nodes(recording, system, grid, low_pass, clamps)
    return dict(zip(system.prescribed, map(float, path[0]), strict=True))


def identified_parameters_with_covariance(
    run: RunSettings, step: Step
) -> tuple[Array, ParameterCovarianceBeforePlan, dict[str, Any]]:
    """Return parameter values (ntheta,), their covariance and their source: a run folder of `solve` or the settings."""
    parameters = step.system.parameters
    theta = parameters.vector()
    if run.plan.parameter_run_folder is None:
        values = {name: parameters[name].value for name in free_parameter_names(run, parameters)}
        return theta, ParameterCovarianceBeforePlan(), {"run": None, "parameters": values}
    result, folder = _read_parameter_run(run, ("solve",))
    _require_same_model(run, result["parameters"], parameters.names)
    found = {name: entry["value"] for name, entry in result["parameters"].items() if name in parameters}
    theta[[parameters.index(name) for name in found]] = list(found.values())
    with open_hdf5_after_read_check(folder / "trajectories.h5") as data:
        names = [str(name) for name in data["unknowns"].attrs["names"]]
        covariance = np.array(data["unknowns/covariance"])
    usable = [i for i, name in enumerate(names) if name in found and np.all(np.isfinite(covariance[i, i]))]
    certain = tuple(names[i] for i in usable)
    lost = sorted(name for name in found if result["parameters"][name]["free"] and name not in certain)
    source = {"run": str(folder), "parameters": found, "uncertainty_unknown": lost}
    return theta, ParameterCovarianceBeforePlan(certain, np.nan_to_num(covariance[np.ix_(usable, usable)])), source


def _plan_as_recording(run: RunSettings, found: _Plan) -> Recording:
    q, v = found.joint_positions, found.joint_velocities
    known: dict[str, Any] = {"position_command": q, "velocity_command": v, "clock": "nominal"}
    known |= {"effort_kind": "sample", "effort_std": _EFFORT_STD}
    joints = JointGroup(found.joint_names, found.t, q, v, found.joint_efforts, **known)
    points: tuple[PointGroup, ...] = ()
    if names := tuple(found.point_trajectories):
        position = np.stack([found.point_trajectories[name] for name in names], axis=1)
        std = np.full(position.shape, _POINT_STD)
        points = (PointGroup("points_planned", names, found.t, position, std, sensor_name="plan"),)
    truth = dict(zip(found.simulator.step.system.parameters.names, map(float, found.simulator.theta), strict=True))
    text = f"{run.description} Planned motion, goal {run.plan.goal}.".strip()
    return validated_recording(Recording(joints, points, text, "yid_ocp plan", "recording", true_parameters=truth))


def _motion_result(run: RunSettings, found: _Plan, source: dict[str, Any]) -> dict[str, Any]:
    joints = [found.simulator.step.system.mechanism.joints[i] for i in found.simulator.moved_joint_indices]
    return {
        "format": "yid-plan/1",
        "status": "done" if found.is_successful else "failed",
        "message": found.message,
        "duration": found.simulator.path.duration,
        **attributes_to_dict(run.plan, "goal settle=hold_duration"),
        "joints": {
            joint.name: {
                "velocity": _share(found.joint_velocities[:, i], joint.velocity_limit),
                "effort": _share(found.joint_efforts[:, i], joint.effort_limit),
                "travel": float(np.ptp(found.joint_positions[:, i])),
            }
            for i, joint in enumerate(joints)
        },
        "from": source,
    }


def _share(values: Array, limit: float) -> float | None:
    return float(np.max(np.abs(values)) / limit) if math.isfinite(limit) and limit > 0 else None


def _plan_result(run: RunSettings, found: TargetMotionPlan) -> dict[str, Any]:
    names = "place=target_position error=max_position_error swing=max_residual_speed off_path=max_path_deviation"
    own = attributes_to_dict(found, f"{names} std=end_position_std unfinished=is_unfinished")
    tolerances = "point tolerance=position_tolerance speed_tolerance=point_rest_speed_tolerance"
    return own | attributes_to_dict(run.plan, tolerances)


def _read_parameter_run(run: RunSettings, commands: Sequence[str]) -> tuple[dict[str, Any], Path]:
    folder = Path(str(run.plan.parameter_run_folder))
    with add_setting_location_to_errors(run, "plan", "parameter_run_folder"):
        return read_estimation_result(folder, commands), folder


def _plan_from_settings(run: RunSettings, progress: Progress) -> tuple[InformativeMotionPlan, dict[str, Any]]:
    """Return the most informative motion, and the source of its parameters: the settings or a run folder."""
    problem = build_problem(run)
    known = problem.system.parameters
    values = {name: float(problem.theta[known.index(name)]) for name in problem.free}
    sizes: dict[str, dict[str, float]] = {}
    origin = None
    if run.plan.parameter_run_folder is not None:
        result, origin = _read_parameter_run(run, ("solve", "diagnose"))
        found, sizes = _parameter_and_effect_values(result)
        _require_same_model(run, result["parameters" if "parameters" in result else "absorption"], known.names)
        values |= {name: value for name, value in found.items() if name in known}
    with add_setting_location_to_errors(run, "plan"):
        plan = plan_informative_motion(problem, run.plan, values, sizes, progress)
    return plan, {"run": None if origin is None else str(origin), "parameters": values}


def _require_same_model(run: RunSettings, found: Mapping[str, Mapping[str, Any]], own: Collection[str]) -> None:
    lacking = sorted({name.rpartition(".")[0] for name in found if "@" in name and name not in own})
    free = {name for name, entry in found.items() if entry.get("free", True)}
    folder, allowed = run.plan.parameter_run_folder, "a run of `solve` on the same model"
    if lacking:
        what = f"the model of {folder} has effects that this one lacks: {', '.join(lacking)}"
        hint = "list the same effects under model.effects"
        raise run.config_error(what, "plan", "parameter_run_folder", allowed=allowed, hint=hint)
    if free and free.isdisjoint(own):
        what, hint = f"{folder} estimated no parameter of this model", "give the run folder of another run"
        raise run.config_error(what, "plan", "parameter_run_folder", allowed=allowed, hint=hint)


def _parameter_and_effect_values(result: Mapping[str, Any]) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """Return the parameter values of a solve or diagnosis result, and of a diagnosis also its effects' values."""
    if "parameters" in result:
        return {name: entry["value"] for name, entry in result["parameters"].items()}, {}
    sizes = {}
    for entry in result["which"]:
        values = {name: quantity["value"] for name, quantity in entry["parameters"].items()}
        sizes[effect_entry_label(entry)] = {name: x for name, x in values.items() if x is not None}
    return {name: entry["before"] for name, entry in result["absorption"].items()}, sizes


def _information_plan_result(found: InformativeMotionPlan) -> dict[str, Any]:
    stds = "std_relative_before=std_recorded std_relative_after=std_planned std_relative_together=std_combined verdict"
    rest = "unseen=unobservable_parameters open=unidentifiable_directions"
    return {
        "parameters": {name: attributes_to_dict(own, stds) for name, own in found.parameter_precisions.items()},
        "distances": [
            {"effect": first, "explained_by": second, "before": before, "after": after}
            for (first, second), (before, after) in found.effect_distances.items()
        ],
        **attributes_to_dict(found, f"limits_reached=active_limits {rest}"),
    }


def discrimination_plan_settings(confusable: Sequence[Sequence[Mapping[str, str]]], path: str) -> dict[str, Any] | None:
    """Return settings of `plan` that distinguish confusable effects of the run at the absolute `path`, if any."""
    if not confusable:
        return None
    labels = [effect_entry_label(entry) for entry in confusable[0]]
    asked = {"goal": "information", "effects_to_discriminate": labels[:_MAX_DISCRIMINATED_EFFECTS]}
    return asked | {"parameter_run_folder": path}

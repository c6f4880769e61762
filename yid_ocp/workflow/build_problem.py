"""Builds the estimation problem of a run: recordings, options and free parameters on a compiled step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from yid_ocp.analysis.discretisation import min_grasp_gaps
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import (
    RunSettings,
)
from yid_ocp.data.channel_checks import median_edge_lengths
from yid_ocp.data.recording import Recording
from yid_ocp.errors import DataError, nearest_name_hint, unknown_name_details
from yid_ocp.integrator.step import Step
from yid_ocp.model import System
from yid_ocp.model.objects.base import ClampedObject
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.problem.episodes import Episode
from yid_ocp.sensors.joints import EFFORT_GROUP, POSITION_GROUP, is_measured_by_arm
from yid_ocp.workflow.build import arms_are_estimated_states, build_cable, build_step, build_system, parameter_settings
from yid_ocp.workflow.clamps import clamp_paths, marker_parameter_values
from yid_ocp.workflow.recording_issues import (
    check_recordings,
    mention_issues_in_errors,
    object_point_issues,
    raise_for_issues,
)
from yid_ocp.workflow.run_inputs import read_recordings

_START_FRAMES = 2  # of a cable's free points, from which every prediction starts


_MAX_GRASP_GAP = 0.01  # what encoder noise and a slightly wrong length of the object can make of a grasp [m]


def problem_options(run: RunSettings, system: System, recordings: Sequence[Recording] = ()) -> ProblemOptions:
    """`ProblemOptions` of a run, with values that depend on system and recordings.

    Parameters
    ----------
    recordings : sequence of Recording
        Where values differ from recording to recording (a cable's edges, places of markers), those of these.
    """
    parameters = system.parameters
    chosen = parameter_settings(run, parameters)
    for name in run.problem.start_fit_parameters:
        if name not in parameters:
            hint = nearest_name_hint(name, parameters.names)
            raise run.config_error(f"there is no parameter '{name}'", "problem", "start_fit_parameters", hint=hint)
    sensors = dict(run.sensors)
    if arms_are_estimated_states(run):
        # what the encoders say is what counts of the arms, as it does where they are prescribed
        sensors[POSITION_GROUP] = replace(sensors.get(POSITION_GROUP, SensorOptions()), use=True)
        for group in {
            group.name for recording in recordings for group in recording.points if is_measured_by_arm(group)
        }:
            sensors[group] = replace(sensors.get(group, SensorOptions()), use=False)
    cable = build_cable(run)
    own = marker_parameter_values(run, system, recordings)
    if cable is not None and isinstance(run.model.object, ClampedObject):
        for group in {group.name for recording in recordings for group in recording.points}:
            said = sensors.get(group, SensorOptions())
            sensors[group] = said if said.points is not None else replace(said, points=cable.free_vertices)
        for recording in recordings:
            lengths = median_edge_lengths(cable.edges, [recording], _START_FRAMES)
            if values := run.model.object.recording_parameters(lengths):
                own[recording.name] = values
    return replace(
        run.problem,
        sensors=sensors,
        clamp_paths=clamp_paths(run, cable),
        local_parameters=tuple(name for name, said in chosen.items() if said.per_recording),
        prior_stds={name: said.prior_std for name, said in chosen.items() if said.prior_std is not None},
        parameters_by_recording=own,
    )


def build_problem(
    run: RunSettings, step: Step | None = None, reference_recordings: Sequence[Recording] = ()
) -> EstimationProblem:
    """The estimation problem of a run.

    Parameters
    ----------
    step : Step, optional
        Compiled before; built when absent.
    reference_recordings : sequence of Recording
        That will be predicted only; the options say where markers sit in them.

    Raises
    ------
    ConfigError, DataError, ModelError
        Settings, recordings or names that do not fit, a grasp that cannot be closed, a recording that nothing can be
        done with; with `recordings.strict` any doubt about one.
    """
    system = build_system(run) if step is None else step.system
    free = [name for name, said in parameter_settings(run, system.parameters).items() if said.free]
    if not free:
        raise run.config_error(
            "no parameter is free", "parameters", hint="set parameters.NAME.free: true for what is sought"
        )
    same = sorted(set(run.recordings.estimate) & set(run.recordings.held_out))
    if same:
        what = "a recording is both estimated on and held out"
        raise run.config_error(what, "recordings", "held_out", allowed="one of the two", hint=same[0])
    estimate, held_out = read_recordings(run, "estimate"), read_recordings(run, "held_out")
    if not estimate:
        raise run.config_error(
            "there is no recording to estimate on", "recordings", "estimate", hint="list at least one recording"
        )
    _check_sensors(run, [*estimate, *held_out])
    seen = check_recordings(run, system, build_cable(run), free, estimate, held_out)
    options = problem_options(run, system, [*seen.estimate, *seen.held_out, *reference_recordings])
    step = build_step(run, system) if step is None else step
    said = replace(options, data_issues=seen.issues)
    problem = EstimationProblem(step, seen.estimate, free, said, None, seen.held_out)
    with mention_issues_in_errors(seen.issues):
        _check_grasps_close(run, problem)
    more = object_point_issues(problem)
    if more:
        raise_for_issues(run, more)
        problem = problem.with_options(replace(said, data_issues=(*seen.issues, *more)))
    return problem


def initial_grasp_gaps(problem: EstimationProblem, episode: Episode) -> dict[str, float]:
    """Remaining gap of every grasp at the first configuration of a recording, by grasp name [m]."""
    system = problem.system
    if not system.grasps:
        return {}
    posture = dict(
        zip((*system.driven, *system.prescribed), map(float, episode.initial_known_coordinates), strict=True)
    )
    theta = problem.theta.copy()
    for name, value in problem.options.parameters_by_recording.get(episode.name, {}).items():
        theta[system.parameters.index(name)] = value
    return min_grasp_gaps(system, posture, theta)


def _check_grasps_close(run: RunSettings, problem: EstimationProblem) -> None:
    """Raise an error for recordings at whose first configuration a grasp cannot be closed."""
    for episode in (*problem.episodes, *problem.held_out):
        for name, gap in initial_grasp_gaps(problem, episode).items():
            if gap > _MAX_GRASP_GAP:
                raise DataError(
                    f"grasp '{name}' cannot be closed at the first posture of '{episode.name}': "
                    f"{1e3 * gap:.3g} mm are missing",
                    where=run.describe_location("model", "grasp", name),
                    allowed=f"at most {1e3 * _MAX_GRASP_GAP:g} mm",
                    hint="check the object's lengths and mount, the grasp's frames and the recording's joints",
                )


def _check_sensors(run: RunSettings, recordings: Sequence[Recording]) -> None:
    known = {group.name for recording in recordings for group in recording.points}
    known |= (
        {"joints.position", "joints.effort"} if any(recording.joints is not None for recording in recordings) else set()
    )
    for name in run.sensors:
        if name not in known:
            raise run.config_error(
                f"no recording has a group '{name}'", "sensors", name, **unknown_name_details(name, sorted(known))
            )
        if run.sensors[name].effort_kind is not None and name != EFFORT_GROUP:
            hint = f"say it of {EFFORT_GROUP}, or leave it out"
            raise run.config_error(f"'{name}' holds no efforts", "sensors", name, "effort_kind", hint=hint)


def load_problem(path: str | Path | None = None, overrides: Sequence[str] = ()) -> EstimationProblem:
    """The estimation problem of a configuration file, of the embedded one when absent.

    Parameters and errors as `load_config`; errors as `build_problem`.
    """
    return build_problem(load_config(path, overrides))

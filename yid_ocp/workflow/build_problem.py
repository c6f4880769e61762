"""Functions that build a run's estimation problem from recordings, options, free parameters and a compiled step.

Recordings are checked first: duplicates count once, and gaps are cut out. Other issues are reported, not corrected.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from yid_ocp.analysis import joint_checks, point_checks
from yid_ocp.analysis.clock_checks import problem_with_fitted_clocks_and_issues
from yid_ocp.analysis.discretisation import longest_accurate_time_step, min_gap_by_grasp_at_robot_posture
from yid_ocp.analysis.joint_checks import RecordedJointsModel
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import RunSettings
from yid_ocp.data.channel_checks import ISSUE_CAUSE_DESCRIPTIONS, Issue, typical_point_pair_distances
from yid_ocp.data.checks import duplicate_data_issue, recording_quality_issues, split_recording_at_gaps
from yid_ocp.data.recording import Recording
from yid_ocp.display import grouped
from yid_ocp.effects import EffectBase, make_effect
from yid_ocp.errors import DataError, unknown_name_error_arguments
from yid_ocp.integrator.step import Step, step_with_time_step
from yid_ocp.model import System
from yid_ocp.model.objects.base import CableVertices, ClampPosePointNames
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.problem.episodes import Episode, EpisodePrediction
from yid_ocp.problem.options import DividedLinksModel, RefinementKind
from yid_ocp.problem.recorded_inputs import servo_gain_parameters_by_recording
from yid_ocp.sensors.base import channel_specs_for_group_name
from yid_ocp.sensors.joints import JOINT_EFFORT_SENSOR_KEY, JOINT_POSITION_GROUP_NAME, is_point_group_measured_by_arm
from yid_ocp.workflow import build
from yid_ocp.workflow.build import build_step, build_system, cable_vertices_between_clamps, free_parameter_names
from yid_ocp.workflow.run_inputs import check_names_in_setting, read_recordings_of_role

log = logging.getLogger(__name__)
_START_FRAMES = 2  # frames of a cable's free points from which predictions start
_MAX_GRASP_GAP = 0.01  # largest grasp gap due to encoder noise and a slightly wrong object length [m]
_EFFECTS_BY_CAUSE = {
    "encoder_offset": ("encoder_offset",),
    "effort_gain": ("effort_gain",),
    "effort_sign": ("effort_gain",),
    "effort_offset": ("effort_offset",),
    "effort_lag": ("effort_delay", "effort_lag"),
    "clock_offset": ("camera_latency",),
}
"""Effects that model the error behind an issue, by the cause of the issue."""
_MOTION_PARAMETER_WORDS = ("damping", "viscous", "coulomb", "stribeck", "inertia", "tau")
"""Words in the names of parameters that are unobservable at rest."""


def servo_gains_by_recording(
    run: RunSettings, system: System, recordings: Sequence[Recording]
) -> dict[str, dict[str, float]]:
    """Return the servo gains that recordings state, by recording and parameter, without those that settings state."""
    chosen = build.settings_by_parameter_name(run, system.parameters)
    stated = {name for name, own in chosen.items() if own.initial is not None}
    found = servo_gain_parameters_by_recording(system, recordings)
    return {recording: {n: x for n, x in own.items() if n not in stated} for recording, own in found.items()}


def make_problem_options(run: RunSettings, system: System, recordings: Sequence[Recording] = ()) -> ProblemOptions:
    """Make the options of the estimation problem that a run's settings describe.

    Values that differ between recordings (edges of a cable, marker positions) come from `recordings`.
    """
    parameters = system.parameters
    chosen = build.settings_by_parameter_name(run, parameters)
    where, wanted = ("problem", "initial_state_fit_parameters"), run.problem.initial_state_fit_parameters
    check_names_in_setting(run, "parameter", wanted, parameters.names, *where)
    sensors = dict(run.sensors)
    groups = [group for recording in recordings for group in recording.points]
    if build.are_arm_states_estimated(run):
        # encoders determine the arms' motion, as for prescribed arms
        sensors[JOINT_POSITION_GROUP_NAME] = replace(sensors.get(JOINT_POSITION_GROUP_NAME, SensorOptions()), use=True)
        for name in {group.name for group in groups if is_point_group_measured_by_arm(group)}:
            sensors[name] = replace(sensors.get(name, SensorOptions()), use=False)
    cable = cable_vertices_between_clamps(run)
    own = build.marker_position_values_by_recording(run, system, recordings)
    for name, factors in servo_gains_by_recording(run, system, recordings).items():
        own[name] = own.get(name, {}) | factors
    clamps: tuple[ClampPosePointNames, ...] = ()
    item, checked = run.model.object, run.output.checked_discretisation
    if checked is None:
        checked = "both" if item is not None and item.default_link_refinement else "time_step"
    divided: DividedLinksModel | None = None
    if item is not None and item.uniform_or_total_link_count is not None:
        scales = {name: float(build.link_division_parameter_scale(run, name, 2)) for name in parameters.names}
        divided = DividedLinksModel(partial(_divided_links_step, run), scales, item.divided_links_settings)
    kinds: dict[str, tuple[RefinementKind, ...]] = {"time_step": ("time_step",), "both": ("links", "time_step")}
    if cable is not None and item is not None:
        clamps = cable.clamp_pose_point_names
        for group in groups:
            said = sensors.setdefault(group.name, SensorOptions())
            if said.used_points is None:
                free = tuple(name for name in cable.unclamped_vertex_names if name in group.names)
                sensors[group.name] = replace(said, used_points=free, use=said.use if free else False)
        for recording in recordings:
            lengths = typical_point_pair_distances(cable.edge_vertex_names, [recording], _START_FRAMES)
            if values := item.edge_length_parameter_values(lengths):
                own[recording.name] = values
    return replace(
        run.problem,
        sensors=sensors,
        clamp_pose_point_names=clamps,
        local_parameters=tuple(name for name, said in chosen.items() if said.per_recording),
        prior_stds={name: said.prior_std for name, said in chosen.items() if said.prior_std is not None},
        parameters_by_recording=own,
        has_uncertain_point_clocks=not clamps,  # clamps follow the points' own clock
        excess_residual_criteria=run.diagnosis.fit_excess_residual_criteria,
        checked_discretisations=kinds.get(checked, ()),
        divided_links_model=divided,
        cable_vertices=cable,
    )


def _divided_links_step(run: RunSettings, is_compiled: bool, effects: Sequence[EffectBase]) -> Step:
    settings = replace(run, problem=replace(run.problem, use_compiler=is_compiled))
    system = build_system(run, link_division=2)
    own = [make_effect(effect.kind, effect.location, system) for effect in effects]
    return build_step(settings, system.with_effects(own) if own else system)


def _refuse_object_mounted_on_driven_arm(run: RunSettings, system: System) -> None:
    """Raise `ConfigError` if the tracking filter would take the object's momentum for an error of the arm."""
    tree, driven = system.mechanism, set(system.actuated_coordinate_indices)
    for i, name in enumerate(tree.joint_names):
        of_arm = i in driven or name in run.model.arms.passive_joints
        if not of_arm and driven.intersection(tree.ancestor_joint_indices(i)):
            what = f"{name} of the object is mounted on a driven arm, whose tracking filter needs its own momentum"
            hint = "set model.arms.mode: prescribed, or problem.arm_tracking_feedback: proportional"
            allowed = "a driven arm that holds its object only by grasps"
            raise run.config_error(what, "model", "object", "mount", allowed=allowed, hint=hint)


def build_problem(
    run: RunSettings, step: Step | None = None, reference_recordings: Sequence[Recording] = ()
) -> EstimationProblem:
    """Build the estimation problem that a run's settings and recordings define.

    Raises `ConfigError`, `DataError` or `ModelError` if settings, recordings or names are inconsistent, a grasp cannot
    be closed, or a recording is unusable. With `recordings.stop_on_any_issue`, any issue raises an error.
    """
    system = build_system(run) if step is None else step.system
    if run.problem.arm_tracking_feedback == "lqr" and not system.servos:
        _refuse_object_mounted_on_driven_arm(run, system)
    free = free_parameter_names(run, system.parameters)
    if not free:
        named = build.settings_by_parameter_name(run, system.parameters)
        unlikely = (".damping", ".mass")
        names = sorted(system.parameters.names, key=lambda name: (name not in named, name.endswith(unlikely)))
        allowed = ", ".join(names[:8]) + f" and {len(names) - 8} more" * (len(names) > 8)
        what = "no parameter is free, so there is nothing to estimate"
        hint = f"free those to estimate, for example parameters.{names[0]}.free: true"
        raise run.config_error(what, "parameters", allowed=f"one free parameter or more, among {allowed}", hint=hint)
    if same := sorted(set(run.recordings.estimate) & set(run.recordings.held_out)):
        what, hint = f"{same[0]} is listed for estimation and as held out", "remove it from one of the two lists"
        raise run.config_error(what, "recordings", "held_out", allowed="each recording in only one of them", hint=hint)
    estimate, held_out = read_recordings_of_role(run), read_recordings_of_role(run, "held_out")
    if not estimate:
        what, allowed = "no recording is listed for estimation", "one recording or more"
        raise run.config_error(what, "recordings", "estimate", allowed=allowed, hint="set estimate: [RECORDING.h5]")
    _check_sensors(run, [*estimate, *held_out])
    estimate, held_out, issues = _check_recordings(run, system, free, estimate, held_out)
    said = replace(make_problem_options(run, system, [*estimate, *held_out, *reference_recordings]), data_issues=issues)
    step = build_step(run, system) if step is None else step
    problem = EstimationProblem(step, estimate, free, said, None, held_out)
    if run.problem.time_step == "auto":
        step = step_with_time_step(step, longest_accurate_time_step(problem))
        log.info("problem.time_step: auto chooses %g s for these recordings", step.time_step)
        problem = EstimationProblem(step, estimate, free, said, None, held_out)
    _check_grasps_close(run, problem)
    more = _object_point_issues(problem)
    _raise_for_issues(run, more)
    as_stamped, (problem, clocks) = problem, problem_with_fitted_clocks_and_issues(problem)
    if problem is not as_stamped:  # issues that only the uncertain clock caused are dropped
        corrected = ([episode.recording for episode in group] for group in (problem.episodes, problem.held_out))
        _raise_for_issues(run, clocks)
        left = {(issue.cause, issue.recording) for issue in _check_recordings(run, system, free, *corrected)[2]}
        issues = tuple(own for own in issues if own.severity == "warning" or (own.cause, own.recording) in left)
    if more or problem is not as_stamped:
        problem = problem.with_options(replace(said, data_issues=(*issues, *more, *clocks)))
    return problem


def min_grasp_gaps_at_start(problem: EstimationProblem, episode: Episode) -> dict[str, float]:
    """Return, by grasp, the smallest possible distance [m] of its two frames at a recording's first joint angles."""
    system = problem.system
    if not system.grasps:
        return {}
    names = (*system.driven, *system.prescribed)
    posture = dict(zip(names, map(float, episode.initial_known_coordinates), strict=True))
    theta = problem.predictor.theta_with_episode_values(episode, problem.theta)
    start = problem.predictor.initial_state_and_derivative(episode, theta)
    near = None if start.failure_message else start.state[: system.n_coordinates]
    return min_gap_by_grasp_at_robot_posture(system, posture, theta, near)


def _check_grasps_close(run: RunSettings, problem: EstimationProblem) -> None:
    hint = "check the object's lengths and mount, the grasp's frames and the recording's joints"
    if issues := grouped((own.cause, own) for own in _gravest_first(problem.options.data_issues)):
        told = [f"{ISSUE_CAUSE_DESCRIPTIONS[cause]} ({own[0].location_text})" for cause, own in issues.items()]
        hint = f"{hint}. Issues found before: {'; '.join(told[:3])}"
    for episode in (*problem.episodes, *problem.held_out):
        for name, gap in min_grasp_gaps_at_start(problem, episode).items():
            if gap > _MAX_GRASP_GAP:
                what = f"at the first posture of '{episode.name}', the two frames of grasp '{name}' are at least "
                what = f"{what}{1e3 * gap:.3g} mm apart"
                at, allowed = ("grasp", name), f"at most {1e3 * _MAX_GRASP_GAP:g} mm"
                known = problem.system.mechanism.joint_names
                if still := [joint for joint in episode.recording.joint_names if joint not in known]:
                    at = ("arms", "joints")
                    hint = f"add these recorded joints, which the model fixes: {', '.join(still)}"
                raise DataError(what, where=run.setting_location("model", *at), allowed=allowed, hint=hint)


def _check_sensors(run: RunSettings, recordings: Sequence[Recording]) -> None:
    known = {key for recording in recordings for key in recording.sensor_setting_keys}
    without = all(own.joints is None or own.joints.effort is None for own in recordings)
    shown = sorted(known - ({JOINT_EFFORT_SENSOR_KEY} if without else set()))
    for name, said in run.sensors.items():
        if name not in known:
            what, hint = f"no recording has the sensor '{name}'", f"leave sensors.{name} out, or correct the name"
            raise run.config_error(what, "sensors", name, **unknown_name_error_arguments(name, shown, hint))
        if said.effort_sampling_kind is not None and name != JOINT_EFFORT_SENSOR_KEY:
            what, hint = f"'{name}' measures no efforts", f"set it under sensors.{JOINT_EFFORT_SENSOR_KEY} or remove it"
            where, allowed = ("sensors", name, "effort_sampling_kind"), f"only under {JOINT_EFFORT_SENSOR_KEY}"
            raise run.config_error(what, *where, allowed=allowed, hint=hint)
        group, _, quantity = name.rpartition(".")
        constants = next((c.constants for c in channel_specs_for_group_name(group) if c.quantity == quantity), {})
        check_names_in_setting(run, "constant", said.constants, constants, "sensors", name, "constants")


def load_problem(path: str | Path | None = None, overrides: Sequence[str] = ()) -> EstimationProblem:
    """Build the problem of a file or the embedded one. Raises `ConfigError`, `DataError` or `ModelError` for faults."""
    return build_problem(load_config(path, overrides))


def _check_recordings(
    run: RunSettings, system: System, free: Sequence[str], estimate: Sequence[Recording], held_out: Sequence[Recording]
) -> tuple[list[Recording], list[Recording], tuple[Issue, ...]]:
    """Recordings to estimate on and to hold out, without duplicates and cut at gaps, and all issues found."""
    issues, cable = list[Issue](), cable_vertices_between_clamps(run)
    kept: tuple[list[Recording], list[Recording]] = [], []
    arm = None if cable is not None else RecordedJointsModel.from_system(system, free)
    anywhere = run.problem.initial_state != "equilibrium" or not system.unprescribed_coordinate_indices
    clamped = () if cable is None else cable.clamped_vertex_names
    for role, recordings in zip(kept, _once(run, estimate, held_out, issues), strict=True):
        for recording in recordings:
            span = run.problem.duration or np.inf
            found = recording_quality_issues(recording, _choice(run), span)
            is_refused = any(issue.severity == "refused" for issue in found)
            parts, doubts = ([], []) if is_refused else split_recording_at_gaps(recording, clamped, anywhere)
            found += doubts
            for part in parts:
                found += _beside_the_model(run, system, arm, cable, part)
            issues += [issue for issue in found if not parts or _is_in_used_time(issue, parts, span)]
            role += parts
    if arm is not None:
        issues += _excitation(run, arm, free, kept[0])
    issues = _without_repeated_warnings(issues)
    _raise_for_issues(run, issues)
    if not kept[0]:
        gaps = dict.fromkeys(own.what.partition(";")[0] for own in issues if own.cause in ("gap", "clock_jump"))
        what, hint = f"no recording has a usable part: {'; '.join(gaps)}", "record again without such gaps"
        where = "" if anywhere else ", from the start of a recording or from a rest"
        allowed = f"0.5 s without a gap{where}"
        raise DataError(what, where=run.setting_location("recordings", "estimate"), allowed=allowed, hint=hint)
    return *kept, tuple(issues)


def _is_in_used_time(issue: Issue, parts: Sequence[Recording], span: float) -> bool:
    """Whether an issue concerns the used data: the first `span` seconds of each of the `parts` of a recording."""
    starts = [float(part.all_groups[0].t[0]) for part in parts]
    begin, end = issue.begin, issue.end
    return begin is None or end is None or any(begin <= start + span and start <= end for start in starts)


def _without_repeated_warnings(issues: Sequence[Issue]) -> list[Issue]:
    """The issues without warnings about groups that certainly have the same issue."""
    certain = {(own.cause, own.recording, own.group) for own in issues if own.severity == "not_trusted"}
    return [o for o in issues if o.severity != "warning" or (o.cause, o.recording, o.group) not in certain]


def data_quality_issues_of_recording(run: RunSettings, system: System, recording: Recording) -> list[Issue]:
    """Find all data quality issues of one whole recording. Errors are as in `build_problem`."""
    found = recording_quality_issues(recording, _choice(run))
    _raise_for_issues(run, found)
    arm = RecordedJointsModel.from_system(system, free_parameter_names(run, system.parameters))
    found += _beside_the_model(run, system, arm, None, recording)
    _raise_for_issues(run, found)
    return found


def _choice(run: RunSettings) -> Callable[[str], SensorOptions]:
    return lambda name: run.sensors.get(name, SensorOptions())


def _once(
    run: RunSettings, estimate: Sequence[Recording], held_out: Sequence[Recording], issues: list[Issue]
) -> tuple[list[Recording], list[Recording]]:
    used, others = list[Recording](), list[Recording]()
    for recording in estimate:
        if same := _duplicate(used, recording):
            issues.append(replace(same[0], what=f"{same[0].what}, so these samples are used only once"))
        else:
            used.append(recording)
    for recording in held_out:
        if same := _duplicate(used, recording):
            what = f"the same measurement is listed for estimation and as held out: {same[0].what}"
            where = run.setting_location("recordings", "held_out")
            hint = f"leave out {recording.name} or {same[1].name}"
            raise DataError(what, where=where, allowed="every measurement in one list", hint=hint)
        if same := _duplicate(others, recording):
            issues.append(replace(same[0], what=f"{same[0].what}, so {recording.name} is left out"))
        else:
            others.append(recording)
    return used, others


def _duplicate(others: Sequence[Recording], recording: Recording) -> tuple[Issue, Recording] | None:
    return next(((same, other) for other in others if (same := duplicate_data_issue(other, recording))), None)


def _beside_the_model(
    run: RunSettings, system: System, arm: RecordedJointsModel | None, cable: CableVertices | None, recording: Recording
) -> list[Issue]:
    gravity = np.array(run.model.gravity, float)
    recording = recording.with_effort_sampling_kind(_choice(run)(JOINT_EFFORT_SENSOR_KEY).effort_sampling_kind)
    if cable is not None:
        return list(point_checks.cable_point_geometry_issues(cable, recording, gravity))
    found: list[Issue] = []
    if arm is not None and arm.recording_has_all_joint_angles(recording):
        found += joint_checks.joint_limit_issues(arm, recording)
        if any(issue.severity == "refused" for issue in found):
            return found
        told = list(joint_checks.inverse_dynamics_effort_issues(arm, recording))
        told += point_checks.forward_kinematics_issues(arm, recording, _choice(run))
        found += [issue for issue in told if not _is_modelled(system, issue)]
    theta = system.parameters.vector()
    return found + list(point_checks.points_too_distant_issues(arm, system, theta, recording, _choice(run)))


def _excitation(
    run: RunSettings, arm: RecordedJointsModel, free: Sequence[str], recordings: Sequence[Recording]
) -> list[Issue]:
    """Return issues of recordings whose motion of the robot's joints is too small or slow for the free parameters."""
    asked: dict[str, list[str]] = {}
    for name in free:
        joint, _, quantity = name.rpartition(".")
        if joint in arm.joint_names and quantity in ("damping", "stiffness"):
            asked.setdefault(joint, []).append(name)
    found = list(joint_checks.joint_excitation_issues(recordings, asked, _choice(run)(JOINT_POSITION_GROUP_NAME)))
    if any(word in name for name in free for word in _MOTION_PARAMETER_WORDS):
        options = _choice(run)(JOINT_EFFORT_SENSOR_KEY)
        whole = [one for one in recordings if arm.recording_has_all_joint_angles(one)]
        weak = [list(joint_checks.slow_motion_excitation_issues(arm, one, options)) for one in whole]
        if all(weak):  # one informative recording is enough
            found += [issue for issues in weak for issue in issues]
    return found


def _is_modelled(system: System, issue: Issue) -> bool:
    kinds = _EFFECTS_BY_CAUSE.get(issue.cause, ())
    places = {effect.location for effect in system.effects if effect.kind in kinds}
    if "camera_latency" in kinds and "camera_latency" not in issue.setting:  # no camera's clock
        return False
    joint = issue.channel.partition(".")[2]
    return bool(places) and (not joint or joint in places)


def _object_point_issues(problem: EstimationProblem) -> list[Issue]:
    """Issues of measured object points, from one rollout per recording at the initial parameters."""
    system = problem.system
    lengths = ca.vertcat(ca.SX(0), *(length for segment in system.segment_layouts for length in segment.link_lengths))
    size = float(ca.Function("size", [system.parameters.symbols], [ca.sum1(lengths)])(problem.theta))
    wanted = any(samples.sensor.point_names for episode in problem.episodes for samples in episode.measurements)
    if not size or not wanted or problem.options.clamp_pose_point_names:
        return []
    found: list[Issue] = []
    for i, episode in enumerate(problem.episodes):
        own = problem.unpack_episode_unknowns(problem.initial_unknowns, i)
        result = problem.predictor.predict_episode(episode, *own, False, None)
        if isinstance(result, EpisodePrediction):
            found += point_checks.correctable_object_point_issues(episode, result, size)
    return found


def _raise_for_issues(run: RunSettings, issues: Sequence[Issue]) -> None:
    """Raise `DataError` for issues that forbid a run; with `recordings.stop_on_any_issue`, for any issue."""
    grave = [issue for issue in issues if run.recordings.stop_on_any_issue or issue.severity == "refused"]
    if not grave:
        return
    first, *others = grave
    more = f"; also at {', '.join(issue.location_text for issue in others)}" if others else ""
    what = f"{ISSUE_CAUSE_DESCRIPTIONS[first.cause]}: {first.what}{more}"
    hint = first.advice + (f" ({first.setting})" if first.setting else "")
    raise DataError(what, where=first.location_text, allowed="the limits in docs/reference/data_checks.md", hint=hint)


def _gravest_first(issues: Sequence[Issue]) -> list[Issue]:
    strongest = sorted(issues, key=lambda own: -own.limit_violation_ratio)
    causes = [own.cause for own in strongest]
    # an issue of all joints explains those of single ones with the same cause
    return sorted(strongest, key=lambda own: (own.severity == "warning", causes.index(own.cause), "." in own.channel))


def issues_to_plain_data(issues: Sequence[Issue]) -> list[dict[str, Any]]:
    """Convert data quality issues to JSON-ready dictionaries, most severe first, for the key `issues` of a result."""
    found = []
    for issue in _gravest_first(issues):
        own = {"evidence" if key == "limit_violation_ratio" else key: value for key, value in asdict(issue).items()}
        found.append(own | {"certainty": issue.certainty_word, "where": issue.location_text})
    return found

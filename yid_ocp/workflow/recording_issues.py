"""Data-quality checks of a run's recordings: issues found, data left out, and errors that stop a run.

Recordings given twice count once, gaps are cut out; everything else is said and left as it is.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from yid_ocp.analysis.effort_checks import check_efforts
from yid_ocp.analysis.joint_checks import (
    RecordedJointsModel,
    check_dynamic_excitation,
    check_joint_excitation,
    check_joint_limits,
)
from yid_ocp.analysis.point_checks import (
    check_cable_points,
    check_held_points,
    check_object_points,
    check_point_distances,
)
from yid_ocp.config.settings import RunSettings
from yid_ocp.data.checks import check_recording, duplicate_data_issue, split_at_gaps
from yid_ocp.data.issues import ISSUE_CAUSES, Issue
from yid_ocp.data.recording import Recording
from yid_ocp.errors import DataError
from yid_ocp.model.objects.base import CableTopology
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem, SensorOptions
from yid_ocp.problem.episodes import EpisodePrediction
from yid_ocp.sensors.joints import EFFORT_GROUP, POSITION_GROUP

_EFFECTS_BY_CAUSE = {
    "encoder_offset": ("encoder_offset",),
    "effort_gain": ("effort_gain",),
    "effort_sign": ("effort_gain",),
    "effort_offset": ("effort_offset",),
    "effort_lag": ("effort_delay", "effort_lag"),
    "clock_offset": ("camera_latency",),
}
"""Effects by which a model takes such an error into account."""
_MOTION_PARAMETER_WORDS = ("damping", "viscous", "coulomb", "stribeck", "inertia", "tau")
"""Words in the names of parameters that nothing at rest tells."""
_MAX_QUOTED_ISSUES = 3  # doubts that an error quotes


@dataclass(frozen=True)
class CheckedRecordings:
    """Checked recordings of a run as they are used, and all issues found."""

    estimate: tuple[Recording, ...]
    held_out: tuple[Recording, ...]
    issues: tuple[Issue, ...]


def check_recordings(
    run: RunSettings,
    system: System,
    cable: CableTopology | None,
    free: Sequence[str],
    estimate: Sequence[Recording],
    held_out: Sequence[Recording],
) -> CheckedRecordings:
    """Check the recordings of a run, remove duplicates and cut them at gaps.

    Parameters
    ----------
    cable : CableTopology, optional
        The run's object, where it is one.
    free : sequence of str
        Parameters that are sought.

    Raises
    ------
    DataError
        Nothing can be done with a recording, a measurement is both estimated on and held out, or, with
        `recordings.strict`, any doubt.
    """
    doubts: list[Issue] = []
    used, others = _once(run, estimate, held_out, doubts)
    kept: list[list[Recording]] = [[], []]
    arm = None if cable is not None else RecordedJointsModel.from_system(system, system.parameters.vector())
    anywhere = run.problem.initial_state != "equilibrium" or not system.free_indices
    clamped = () if cable is None else cable.clamped_vertices
    for role, recordings in enumerate((used, others)):
        for recording in recordings:
            found = check_recording(recording, _choice(run))
            doubts += found
            if any(doubt.weight == "refused" for doubt in found):
                continue
            parts = split_at_gaps(recording, clamped, anywhere)
            doubts += parts.issues
            for part in parts.recordings:
                doubts += _beside_the_model(run, system, arm, cable, part)
            kept[role] += parts.recordings
    if arm is not None:
        doubts += _excitation(run, arm, free, kept[0])
    raise_for_issues(run, doubts)
    if not kept[0]:
        hint = "; ".join(doubt.what for doubt in doubts if doubt.cause in ("gap", "clock_jump"))
        what = "gaps leave nothing of the recordings to estimate on"
        raise DataError(what, where=run.describe_location("recordings", "estimate"), hint=hint)
    return CheckedRecordings(tuple(kept[0]), tuple(kept[1]), tuple(doubts))


def single_recording_issues(run: RunSettings, system: System, recording: Recording) -> list[Issue]:
    """All issues of one recording, which is not cut; errors as `check_recordings`."""
    found = check_recording(recording, _choice(run))
    raise_for_issues(run, found)
    found += _beside_the_model(
        run, system, RecordedJointsModel.from_system(system, system.parameters.vector()), None, recording
    )
    raise_for_issues(run, found)
    return found


def _choice(run: RunSettings) -> Callable[[str], SensorOptions]:
    return lambda name: run.sensors.get(name, SensorOptions())


def _once(
    run: RunSettings, estimate: Sequence[Recording], held_out: Sequence[Recording], doubts: list[Issue]
) -> tuple[list[Recording], list[Recording]]:
    used: list[Recording] = []
    others: list[Recording] = []
    for recording in estimate:
        same = next(filter(None, (duplicate_data_issue(other, recording) for other in used)), None)
        if same is None:
            used.append(recording)
        else:
            doubts.append(replace(same, what=f"{same.what}; it counts once"))
    for recording in held_out:
        for other in used:
            same = duplicate_data_issue(other, recording)
            if same is not None:
                what = f"a measurement is both estimated on and held out: {same.what}"
                where = run.describe_location("recordings", "held_out")
                hint = f"leave out {recording.name} or {other.name}"
                raise DataError(what, where=where, allowed="one of the two", hint=hint)
        if all(duplicate_data_issue(other, recording) is None for other in others):
            others.append(recording)
        else:
            text = f"{recording.name} is held out twice; it counts once"
            doubts.append(Issue("same_data", text, "warning", 1e3, "list every measurement once", recording.name))
    return used, others


def _beside_the_model(
    run: RunSettings, system: System, arm: RecordedJointsModel | None, cable: CableTopology | None, recording: Recording
) -> list[Issue]:
    gravity = np.array(run.model.gravity, float)
    recording = recording.with_effort_kind(_choice(run)(EFFORT_GROUP).effort_kind)
    if cable is not None:
        return list(check_cable_points(cable, recording, gravity))
    found: list[Issue] = []
    theta = system.parameters.vector()
    if arm is not None and arm.is_recorded_in(recording):
        found += check_joint_limits(arm, recording)
        if any(doubt.weight == "refused" for doubt in found):
            return found
        told = [*check_efforts(arm, recording), *check_held_points(arm, recording, _choice(run))]
        found += [doubt for doubt in told if not _is_modelled(system, doubt)]
    return found + list(check_point_distances(arm, system, theta, recording, _choice(run)))


def _excitation(
    run: RunSettings, arm: RecordedJointsModel, free: Sequence[str], recordings: Sequence[Recording]
) -> list[Issue]:
    """Whether the motion can tell what is sought, as far as that shows without the object."""
    choice, found = _choice(run), list[Issue]()
    asked: dict[str, list[str]] = {}
    for name in free:
        joint, _, quantity = name.rpartition(".")
        if joint in arm.joint_names and quantity in ("damping", "stiffness"):
            asked.setdefault(joint, []).append(name)
    found += check_joint_excitation(recordings, asked, choice(POSITION_GROUP))
    if any(word in name for name in free for word in _MOTION_PARAMETER_WORDS):
        weak = [
            list(check_dynamic_excitation(arm, one, choice(EFFORT_GROUP)))
            for one in recordings
            if arm.is_recorded_in(one)
        ]
        if all(weak):  # one recording that tells is enough
            found += [doubt for doubts in weak for doubt in doubts]
    return found


def _is_modelled(system: System, doubt: Issue) -> bool:
    """Whether an effect of the model already accounts for the issue."""
    kinds = _EFFECTS_BY_CAUSE.get(doubt.cause, ())
    places = {effect.location for effect in system.effects if effect.kind in kinds}
    if "camera_latency" in kinds and "camera_latency" not in doubt.setting:  # no camera's clock
        return False
    joint = doubt.channel.partition(".")[2]
    return bool(places) and (not joint or joint in places)


def object_point_issues(problem: EstimationProblem) -> list[Issue]:
    """Issues of measured object points, from one rollout per recording with the initial parameters."""
    lengths = ca.vertcat(
        ca.SX(0), *(length for segment in problem.system.segment_layouts for length in segment.link_lengths)
    )
    size = float(ca.Function("size", [problem.system.parameters.symbols], [ca.sum1(lengths)])(problem.theta))
    wanted = any(samples.sensor.point_names for episode in problem.episodes for samples in episode.measurements)
    if not size or not wanted or problem.options.clamp_paths:
        return []
    found: list[Issue] = []
    for i, episode in enumerate(problem.episodes):
        result = problem.predictor.predict_episode(episode, *problem.split(problem.initial_unknowns, i), False, None)
        if isinstance(result, EpisodePrediction):
            found += check_object_points(episode, result, size)
    return found


def raise_for_issues(run: RunSettings, doubts: Sequence[Issue]) -> None:
    """Raise `DataError` for issues that forbid a run; with `recordings.strict`, for any issue."""
    grave = [doubt for doubt in doubts if run.recordings.strict or doubt.weight == "refused"]
    if not grave:
        return
    first, *others = grave
    more = [f"{doubt.where}: {doubt.what}" for doubt in others]
    what = "; ".join([f"{ISSUE_CAUSES[first.cause]}: {first.what}", *more])
    raise DataError(what, where=first.where, hint=first.advice + (f" ({first.setting})" if first.setting else ""))


@contextlib.contextmanager
def mention_issues_in_errors(doubts: Sequence[Issue]) -> Iterator[None]:
    """Context manager that adds known issues of the recordings to a `DataError` raised in its block."""
    try:
        yield
    except DataError as error:
        if not doubts:
            raise
        said = "; ".join(f"{doubt.where}: {doubt.what}" for doubt in _sorted_by_severity(doubts)[:_MAX_QUOTED_ISSUES])
        hint = f"first look at what is in doubt: {said}"
        raise DataError(error.what, where=error.where, allowed=error.allowed, hint=hint) from error


def _sorted_by_severity(doubts: Sequence[Issue]) -> list[Issue]:
    return sorted(doubts, key=lambda doubt: (doubt.weight == "warning", -doubt.evidence))


def issues_result(doubts: Sequence[Issue]) -> list[dict[str, Any]]:
    """Issues as plain data for the key `doubts` of a result."""
    return [
        {**asdict(doubt), "sure": doubt.certainty_word, "where": doubt.where} for doubt in _sorted_by_severity(doubts)
    ]

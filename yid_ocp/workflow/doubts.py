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

from yid_ocp.analysis.plausibility import (
    Arm,
    check_asked,
    check_cable,
    check_efforts,
    check_held_points,
    check_limits,
    check_motion,
    check_object,
    check_reach,
)
from yid_ocp.config.settings import Run
from yid_ocp.data.checks import check_recording, same_data
from yid_ocp.data.doubt import CAUSES, Doubt
from yid_ocp.data.gaps import cut_at_gaps
from yid_ocp.data.recording import Recording
from yid_ocp.errors import DataError
from yid_ocp.model.cable import Cable
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem, SensorOptions
from yid_ocp.problem.outcome import EpisodeResult
from yid_ocp.sensors.joints import EFFORT, POSITION

MODELLED = {
    "encoder_offset": ("encoder_offset",),
    "effort_gain": ("effort_gain",),
    "effort_sign": ("effort_gain",),
    "effort_offset": ("effort_offset",),
    "effort_lag": ("effort_delay", "effort_lag"),
    "clock_offset": ("camera_latency",),
}
"""Effects by which a model takes such an error into account."""
MOVING = ("damping", "viscous", "coulomb", "stribeck", "inertia", "tau")
"""Words in the names of parameters that nothing at rest tells."""
MOST_BLAMED = 3
"""Doubts that an error quotes."""


@dataclass(frozen=True)
class Examined:
    """Checked recordings of a run as they are used, and all issues found."""

    estimate: tuple[Recording, ...]
    held_out: tuple[Recording, ...]
    doubts: tuple[Doubt, ...]


def examined(
    run: Run,
    system: System,
    cable: Cable | None,
    free: Sequence[str],
    estimate: Sequence[Recording],
    held_out: Sequence[Recording],
) -> Examined:
    """Check the recordings of a run, remove duplicates and cut them at gaps.

    Parameters
    ----------
    run : Run
    system : System
    cable : Cable, optional
        The run's object, where it is one.
    free : sequence of str
        Parameters that are sought.
    estimate, held_out : sequence of Recording

    Raises
    ------
    DataError
        Nothing can be done with a recording, a measurement is both estimated on and held out, or, with
        `recordings.strict`, any doubt.
    """
    doubts: list[Doubt] = []
    used, others = _once(run, estimate, held_out, doubts)
    kept: list[list[Recording]] = [[], []]
    arm = None if cable is not None else Arm.of(system, system.parameters.vector())
    anywhere = run.problem.initial_state != "equilibrium" or not system.free_indices
    clamped = () if cable is None else cable.held
    for role, recordings in enumerate((used, others)):
        for recording in recordings:
            found = check_recording(recording, _choice(run))
            doubts += found
            if any(doubt.weight == "refused" for doubt in found):
                continue
            parts = cut_at_gaps(recording, clamped, anywhere)
            doubts += parts.doubts
            for part in parts.recordings:
                doubts += _beside_the_model(run, system, arm, cable, part)
            kept[role] += parts.recordings
    if arm is not None:
        doubts += _excitation(run, arm, free, kept[0])
    stop_at(run, doubts)
    if not kept[0]:
        raise DataError(
            "gaps leave nothing of the recordings to estimate on",
            where=run.where("recordings", "estimate"),
            hint="; ".join(doubt.what for doubt in doubts if doubt.cause in ("gap", "clock_jump")),
        )
    return Examined(tuple(kept[0]), tuple(kept[1]), tuple(doubts))


def of_one(run: Run, system: System, recording: Recording) -> list[Doubt]:
    """All issues of one recording, which is not cut; errors as `examined`."""
    found = check_recording(recording, _choice(run))
    stop_at(run, found)
    found += _beside_the_model(run, system, Arm.of(system, system.parameters.vector()), None, recording)
    stop_at(run, found)
    return found


def _choice(run: Run) -> Callable[[str], SensorOptions]:
    """What is chosen of a group of sensors, by its name."""
    return lambda name: run.sensors.get(name, SensorOptions())


def _once(
    run: Run, estimate: Sequence[Recording], held_out: Sequence[Recording], doubts: list[Doubt]
) -> tuple[list[Recording], list[Recording]]:
    used: list[Recording] = []
    others: list[Recording] = []
    for recording in estimate:
        same = next(filter(None, (same_data(other, recording) for other in used)), None)
        if same is None:
            used.append(recording)
        else:
            doubts.append(replace(same, what=f"{same.what}; it counts once"))
    for recording in held_out:
        for other in used:
            same = same_data(other, recording)
            if same is not None:
                raise DataError(
                    f"a measurement is both estimated on and held out: {same.what}",
                    where=run.where("recordings", "held_out"),
                    allowed="one of the two",
                    hint=f"leave out {recording.name} or {other.name}",
                )
        if all(same_data(other, recording) is None for other in others):
            others.append(recording)
        else:
            text = f"{recording.name} is held out twice; it counts once"
            doubts.append(Doubt("same_data", text, "warning", 1e3, "list every measurement once", recording.name))
    return used, others


def _beside_the_model(
    run: Run, system: System, arm: Arm | None, cable: Cable | None, recording: Recording
) -> list[Doubt]:
    gravity = np.array(run.model.gravity, float)
    recording = recording.with_effort_kind(_choice(run)(EFFORT).kind)
    if cable is not None:
        return list(check_cable(cable, recording, gravity))
    found: list[Doubt] = []
    theta = system.parameters.vector()
    if arm is not None and arm.is_in(recording):
        found += check_limits(arm, recording)
        if any(doubt.weight == "refused" for doubt in found):
            return found
        told = [*check_efforts(arm, recording), *check_held_points(arm, recording, _choice(run))]
        found += [doubt for doubt in told if not is_modelled(system, doubt)]
    return found + list(check_reach(arm, system, theta, recording, _choice(run)))


def _excitation(run: Run, arm: Arm, free: Sequence[str], recordings: Sequence[Recording]) -> list[Doubt]:
    """Whether the motion can tell what is sought, as far as that shows without the object."""
    choice, found = _choice(run), list[Doubt]()
    asked: dict[str, list[str]] = {}
    for name in free:
        joint, _, quantity = name.rpartition(".")
        if joint in arm.names and quantity in ("damping", "stiffness"):
            asked.setdefault(joint, []).append(name)
    found += check_asked(recordings, asked, choice(POSITION))
    if any(word in name for name in free for word in MOVING):
        weak = [list(check_motion(arm, one, choice(EFFORT))) for one in recordings if arm.is_in(one)]
        if all(weak):  # one recording that tells is enough
            found += [doubt for doubts in weak for doubt in doubts]
    return found


def is_modelled(system: System, doubt: Doubt) -> bool:
    """Whether an effect of the model already accounts for the issue."""
    kinds = MODELLED.get(doubt.cause, ())
    places = {effect.location for effect in system.effects if effect.kind in kinds}
    if "camera_latency" in kinds and "camera_latency" not in doubt.setting:  # no camera's clock
        return False
    joint = doubt.channel.partition(".")[2]
    return bool(places) and (not joint or joint in places)


def object_doubts(problem: EstimationProblem) -> list[Doubt]:
    """Issues of measured object points, from one rollout per recording with the initial parameters."""
    lengths = ca.vertcat(ca.SX(0), *(length for segment in problem.system.segments for length in segment.lengths))
    size = float(ca.Function("size", [problem.system.parameters.symbols], [ca.sum1(lengths)])(problem.theta))
    wanted = any(samples.sensor.points for episode in problem.episodes for samples in episode.samples)
    if not size or not wanted or problem.options.clamps:
        return []
    found: list[Doubt] = []
    for i, episode in enumerate(problem.episodes):
        result = problem.predictor.run(episode, *problem.split(problem.start, i), False, None)
        if isinstance(result, EpisodeResult):
            found += check_object(episode, result, size)
    return found


def stop_at(run: Run, doubts: Sequence[Doubt]) -> None:
    """Raise `DataError` for issues that forbid a run; with `recordings.strict`, for any issue."""
    grave = [doubt for doubt in doubts if run.recordings.strict or doubt.weight == "refused"]
    if not grave:
        return
    first, *others = grave
    more = [f"{doubt.where}: {doubt.what}" for doubt in others]
    raise DataError(
        "; ".join([f"{CAUSES[first.cause]}: {first.what}", *more]),
        where=first.where,
        hint=first.advice + (f" ({first.setting})" if first.setting else ""),
    )


@contextlib.contextmanager
def blaming(doubts: Sequence[Doubt]) -> Iterator[None]:
    """Context manager that adds known issues of the recordings to a `DataError` raised in its block."""
    try:
        yield
    except DataError as error:
        if not doubts:
            raise
        said = "; ".join(f"{doubt.where}: {doubt.what}" for doubt in ordered(doubts)[:MOST_BLAMED])
        hint = f"first look at what is in doubt: {said}"
        raise DataError(error.what, where=error.where, allowed=error.allowed, hint=hint) from error


def ordered(doubts: Sequence[Doubt]) -> list[Doubt]:
    """The issues sorted by severity, most severe first."""
    return sorted(doubts, key=lambda doubt: (doubt.weight == "warning", -doubt.evidence))


def doubts_result(doubts: Sequence[Doubt]) -> list[dict[str, Any]]:
    """Issues as plain data for the key `doubts` of a result."""
    return [{**asdict(doubt), "sure": doubt.sure, "where": doubt.where} for doubt in ordered(doubts)]

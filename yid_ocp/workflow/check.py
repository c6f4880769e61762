"""The command `check`: everything that can be wrong before a long run, and how fine the model is."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.analysis.convergence import Frequencies, natural_frequencies
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import Run
from yid_ocp.data.recording import Recording
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode
from yid_ocp.report.terminal import check_summary
from yid_ocp.workflow.build import build_problem, build_step, build_system, first_gaps
from yid_ocp.workflow.command import DONE, carry_out
from yid_ocp.workflow.folder import new_run_folder
from yid_ocp.workflow.progress import SILENT, Progress

FORMAT = "yid-check/1"
TOLERATED = 0.02  # a frequency that moves by more than this fraction when links or steps are refined is worth a warning
MODES = 3


@dataclass(frozen=True)
class CheckOutcome:
    """What `run_check` leaves: the run folder and the contents of its result.json."""

    folder: Path
    result: dict[str, Any]


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    settings = load_config(arguments.config, arguments.overrides)
    carry_out(lambda shown: run_check(settings, arguments.out, shown), check_summary, arguments.quiet)
    return DONE


def run_check(run: Run, out: str | Path | None = None, progress: Progress = SILENT) -> CheckOutcome:
    """Validate a run without solving it.

    Parameters
    ----------
    run : Run
    out : str or Path, optional
    progress : Progress, optional

    Returns
    -------
    CheckOutcome
        `warnings` in its result lists what will work but should be looked at.

    Raises
    ------
    ConfigError, DataError, ModelError, OutputError
        Whatever would stop `solve`.
    """
    with new_run_folder(run, out, "check") as folder:
        folder.begin(run, "check")
        warnings: list[str] = []
        progress.stage("building the model")
        # the equations are the same compiled or not, and a check needs only a few steps
        plain = replace(run, problem=replace(run.problem, compiler=False))
        step = build_step(plain)
        model = {"name": step.system.mechanism.name, **step.sizes}
        recordings, problem = [], None
        if run.recordings.estimate:
            progress.stage("placing the recordings on the model")
            problem = build_problem(plain, step)
            for role, episodes in (("estimate", problem.episodes), ("held_out", problem.held_out)):
                recordings += [_recording(problem, role, episode, warnings) for episode in episodes]
        progress.stage("refining links and time step")
        convergence = refine(run, problem, warnings)
        result = {
            "format": FORMAT,
            "model": model,
            "recordings": recordings,
            "convergence": convergence,
            "warnings": warnings,
        }
        written = folder.finish(result)
    return CheckOutcome(folder.path, written)


def _recording(problem: EstimationProblem, role: str, episode: Episode, warnings: list[str]) -> dict[str, Any]:
    recording, system = episode.recording, problem.system
    entry: dict[str, Any] = {
        "recording": episode.name,
        "role": role,
        "duration": recording.duration,
        "steps": episode.grid.steps,
        "groups": _groups(recording),
    }
    noise = {}
    for samples in episode.samples:
        known = samples.std[np.isfinite(samples.std)]
        noise[samples.sensor.group] = {
            "samples": int(np.sum(np.any(samples.weight > 0, axis=1))),
            "std": float(np.median(known)) if known.size else None,
            "unit": samples.sensor.unit,
        }
    entry["noise"] = noise
    rate = 1.0 / problem.step.time_step
    joints = recording.joints
    if joints is not None:
        recorded = 1.0 / float(np.median(np.diff(joints.t)))
        if recorded < 0.5 * rate:
            warnings.append(f"{episode.name}: joints come at {recorded:.4g} Hz, the model steps at {rate:.4g} Hz")
        moves = system.driven or any(samples.sensor.efforts for samples in episode.samples)
        if moves and joints.effort is not None and joints.effort_kind is None:
            warnings.append(
                f"{episode.name}: nothing says whether joints/effort is a sample, a mean or a command (attribute "
                f"effort_kind); it is taken as a {joints.effort_taken_as}"
            )
    if problem.options.initial_state != "fitted_to_points" and (system.driven or system.prescribed or system.elastic):
        torque = episode.torque[0] if system.driven else None
        rest = problem.functions.statics.solve(
            episode.posture, problem.predictor.own_theta(episode, problem.theta), torque
        )
        entry["equilibrium"] = {"found": rest.converged, "imbalance": rest.error, "message": rest.message}
        if not rest.converged:
            warnings.append(f"{episode.name}: {rest.message} with the initial parameters")
    entry["grasp_gaps"] = first_gaps(problem, episode)
    return entry


def _groups(recording: Recording) -> dict[str, dict[str, Any]]:
    result: dict[str, dict[str, Any]] = {}
    for group in recording.groups:
        name = getattr(group, "name", "joints")
        steps = np.diff(group.t)
        rate = 1.0 / float(np.median(steps)) if len(steps) else 0.0
        longest = float(np.max(steps)) if len(steps) else 0.0
        result[name] = {"samples": len(group.t), "rate": rate, "longest_gap": longest, "names": list(group.names)}
    return result


def refine(run: Run, problem: EstimationProblem | None, warnings: list[str]) -> dict[str, Any]:
    """Lowest frequencies at half and twice the links, and at half and a quarter of the time step.

    Returns
    -------
    dict
        `links` and `time_step`: lists of {value, hertz, growing, message}; empty where there is nothing to vary.
    """
    system = build_system(run)
    h = run.problem.time_step
    posture = _posture(system, problem)
    if posture is None:
        return {"links": [], "time_step": [], "message": "no posture is known: the run names no recording"}
    theta, guess = system.parameters.vector(), None
    rule = (run.problem.force_split, run.problem.constraint_force)
    if problem is not None:
        first = problem.episodes[0]
        theta = problem.predictor.own_theta(first, theta)
        guess = None if first.start is None else first.start.state[: system.size]
    own = natural_frequencies(system, posture, theta, h, *rule, guess)
    if own.message:
        return {"links": [], "time_step": [], "message": own.message}
    if own.growing:
        remedy = "problem.constraint_force: midpoint, " if rule[1] == "node" and system.grasps else ""
        warnings.append(
            f"{own.growing} modes grow from step to step about the first posture: take a shorter problem.time_step, "
            f"{remedy}or more damping"
        )
    values = dict(zip(system.parameters.names, theta, strict=True))
    steps = [_row(h, own)]
    steps += [_row(h / k, natural_frequencies(system, posture, theta, h / k, *rule, guess)) for k in (2, 4)]
    _warn(warnings, "the time step goes", "s", steps, len(steps) - 1, 0)
    count = object_links(run)
    rows = []
    if count is not None:
        for links in sorted({max(1, count // 2), count, 2 * count}):
            other = system if links == count else build_system(run, links=links)
            factor = links / count
            scaled = other.parameters.vector(
                {
                    name: value * (factor if _per_joint(run, name) else 1.0)
                    for name, value in values.items()
                    if name in other.parameters
                }
            )
            found = own if links == count else natural_frequencies(other, posture, scaled, h, *rule)
            rows.append(_row(links, found))
        _warn(warnings, "the links go", "", rows, len(rows) - 1, [row["value"] for row in rows].index(count))
    return {"links": rows, "time_step": steps, "message": ""}


def object_links(run: Run) -> int | None:
    """Number of equal links of the object's tubes, None where there is no such number to vary."""
    item = run.model.object
    if item is None or item.kind == "cable":
        return None
    if item.kind == "y":
        return item.links
    counts = {segment.links for segment in item.segments.values() if segment.link_lengths is None}
    return counts.pop() if len(counts) == 1 else None


def _per_joint(run: Run, name: str) -> bool:
    """Whether a parameter is a stiffness per joint, which must grow with the number of links."""
    owner, _, quantity = name.rpartition(".")
    item = run.model.object
    if quantity not in ("bend", "twist") or item is None:
        return False
    if item.kind == "segments":
        return owner in item.segments and not item.segments[owner].rigidity
    return item.kind == "y"


def _posture(system: Any, problem: EstimationProblem | None) -> dict[str, float] | None:
    names = (*system.driven, *system.prescribed)
    if not names:
        return {}
    if problem is None:
        return None
    return dict(zip(names, map(float, problem.episodes[0].posture), strict=True))


def _row(value: float, found: Frequencies) -> dict[str, Any]:
    return {
        "value": value,
        "hertz": found.hertz[:MODES].tolist(),
        "growing": found.growing,
        "message": found.message,
    }


def _warn(warnings: list[str], what: str, unit: str, rows: list[dict[str, Any]], finest: int, own: int) -> None:
    fine, coarse = rows[finest]["hertz"], rows[own]["hertz"]
    for i, (a, b) in enumerate(zip(coarse, fine, strict=False)):
        if b > 0 and abs(a - b) / b > TOLERATED:
            change = f"from {rows[own]['value']:g} to {rows[finest]['value']:g} {unit}".rstrip()
            moved = f"{a:.3g} Hz to {b:.3g} Hz ({100 * abs(a - b) / b:.2g} %)"
            warnings.append(f"frequency {i + 1} moves from {moved} when {what} {change}")

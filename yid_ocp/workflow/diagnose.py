"""The command `diagnose`: detects, locates and explains the gap, and writes the run folder."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.analysis.history import Estimates, together
from yid_ocp.config.reader import DIAGNOSIS_DEFAULT, load_config
from yid_ocp.config.settings import Run, dump_config
from yid_ocp.data.recording import Recording
from yid_ocp.diagnosis import Finding, diagnose
from yid_ocp.diagnosis.baseline import with_baseline
from yid_ocp.diagnosis.finding import model_result
from yid_ocp.problem import EstimationProblem
from yid_ocp.progress import SILENT, Point, Progress
from yid_ocp.report.scene import Scene, Told, scene
from yid_ocp.report.summaries import diagnose_summary
from yid_ocp.sensors.joints import EFFORT, POSITION
from yid_ocp.solvers import Solution, solve
from yid_ocp.workflow.baseline import earlier_runs, recordings_without, refuse_same, with_effects_of
from yid_ocp.workflow.build import build_problem
from yid_ocp.workflow.command import DONE, carry_out
from yid_ocp.workflow.doubts import doubts_result
from yid_ocp.workflow.folder import RunFolder, new_run_folder, used_versions
from yid_ocp.workflow.information import next_plan
from yid_ocp.workflow.refits import Refits
from yid_ocp.workflow.torque_offsets import torque_offsets
from yid_ocp.workflow.trajectories import Prediction, write_diagnosis_trajectories

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class DiagnoseOutcome:
    """Result of `run_diagnose`.

    Attributes
    ----------
    folder : Path
        The finished run folder.
    result : dict
        Contents of result.json.
    finding : Finding
    """

    folder: Path
    result: dict[str, Any]
    finding: Finding


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    settings = load_config(arguments.config, arguments.overrides, DIAGNOSIS_DEFAULT)
    if arguments.baseline:
        said = tuple(str(Path(folder).expanduser().resolve()) for folder in arguments.baseline)
        settings = replace(settings, diagnosis=replace(settings.diagnosis, baseline=said))
    carry_out(lambda shown: run_diagnose(settings, arguments.out, shown), diagnose_summary, arguments)
    return DONE


def run_diagnose(run: Run, out: str | Path | None = None, progress: Progress = SILENT) -> DiagnoseOutcome:
    """Diagnose and write the run folder; finished refits of an interrupted, identical run are reused.

    Parameters
    ----------
    run : Run
    out : str or Path, optional
        The run folder; see `new_run_folder`.
    progress : Progress, optional

    Returns
    -------
    DiagnoseOutcome

    Raises
    ------
    ConfigError, DataError, ModelError, SolverError, OutputError
    """
    with new_run_folder(run, out, "diagnose") as folder:
        folder.begin(run, "diagnose", _flags(run))
        refits = Refits(folder, folder.inputs, dump_config(run), used_versions())
        told_and_kept = _Kept(progress, folder)
        progress.stage("building the model and its compiled step")
        runs = earlier_runs(run)
        without, said = recordings_without(run)
        if said:
            folder.log("message", level="WARNING", source="baseline", text=said)
        run = with_effects_of(run, runs)
        problem = build_problem(run, without=without)
        refuse_same(run, problem, runs, without)
        if runs:
            problem = with_baseline(problem, together(runs)[0])
        try:
            finding = _found(run, problem, refits, told_and_kept, runs, without)
        except KeyboardInterrupt:
            if len(refits):
                log.warning("%d finished refits are in %s; the same command resumes them", len(refits), refits.file)
            raise
        folder.log("end", verdict=finding.verdict, effects=[effect.label for effect in finding.effects])
        predicted = predictions(finding)
        write_diagnosis_trajectories(folder.path / "trajectories.h5", finding, predicted)
        last = finding.last
        offsets = torque_offsets(last.problem, last.problem.vector(last.values))
        told = finding.to_dict()
        moving = not last.problem.options.clamps and bool(last.problem.system.driven or last.problem.system.prescribed)
        own = {
            "model": model_result(finding),
            "doubts": doubts_result(problem.options.doubts),
            "torque_offsets": offsets,
            "next_plan": next_plan(told["confusable"] if moving else (), folder.target),
        }
        written = folder.finish(told | own)
        more = {"finding": finding, "predictions": predicted}
        folder.report(run, written, progress, problem=problem, scenes=_scenes(finding, predicted), more=more)
    refits.clear()
    return DiagnoseOutcome(folder.path, written, finding)


@dataclass(frozen=True)
class _Kept:
    """Progress that is shown, and entered in the run folder's log."""

    shown: Progress
    folder: RunFolder

    def stage(self, text: str) -> None:
        self.folder.log("stage", text=text)
        self.shown.stage(text)

    def iterate(self, entry: Point) -> None:
        self.shown.iterate(entry)

    def advance(self, done: int, total: int, text: str) -> None:
        self.folder.log("part", done=done, total=total, text=text)
        self.shown.advance(done, total, text)


def _found(
    run: Run,
    problem: EstimationProblem,
    refits: Refits,
    progress: Progress,
    runs: Sequence[Estimates],
    without: Sequence[Recording],
) -> Finding:
    said = run.diagnosis
    nominal: Solution | None = None
    if said.noise_fraction < 1 and problem.held_out:
        # in units of noise the solver would take any fit for a bad one and start again elsewhere
        progress.stage("solving the nominal model")
        nominal = solve(problem, run.solver, callback=progress.iterate)
    return diagnose(
        in_units_of_noise(problem, run),
        said.candidates,
        thresholds=said,
        solution=nominal,
        progress=progress,
        store=refits,
        baseline=runs,
        without=without,
        leave_out=said.leave_out,
    )


def _flags(run: Run) -> list[str]:
    """What the command was given beside the configuration: baselines that it does not say itself."""
    if any(origin.startswith("--set") for origin in run.places.values()):
        return []
    if any(key[:2] == ("diagnosis", "baseline") for key in run.places):
        return []
    return [part for folder in run.diagnosis.baseline for part in ("--baseline", folder)]


def in_units_of_noise(problem: EstimationProblem, run: Run) -> EstimationProblem:
    """The problem with all stated standard deviations scaled by `diagnosis.noise_fraction` to noise alone.

    Errors of torques and angles that drive the motion, priors and weak prior shrink alike, so that every fit stays what
    it is; what changes is when a gap counts as one.

    Raises
    ------
    ConfigError
        A sensor, or a torque, without a standard deviation in the settings.
    """
    share, options = run.diagnosis.noise_fraction, problem.options
    if share == 1:
        return problem
    sensors = dict(options.sensors)
    for group, field in sorted(_noise_levels(problem)):
        level = getattr(sensors[group], field) if group in sensors else None
        if level is None:
            raise run.refuse(
                f"the fraction of noise in the {field} of '{group}' is given, but not the {field}",
                "diagnosis",
                "noise_fraction",
                hint=f"set sensors.{group}.{field}",
            )
        smaller: dict[str, Any] = {field: _times(share, level)}
        sensors[group] = replace(sensors[group], **smaller)
    return problem.with_options(
        replace(
            options,
            sensors=sensors,
            priors={name: share * std for name, std in options.priors.items()},
            joint_prior=options.joint_prior.scaled(dict.fromkeys(options.joint_prior.names, share)),
            huber_threshold=options.huber_threshold / share,
            weak_prior_factor=options.weak_prior_factor**share if options.weak_prior_factor > 0 else 0.0,
            configuration_std=share * options.configuration_std,
            velocity_std=share * options.velocity_std,
        )
    )


def _noise_levels(problem: EstimationProblem) -> set[tuple[str, str]]:
    """Group and field of every noise level that residuals or their weights depend on."""
    levels = {(samples.sensor.group, "std") for episode in problem.episodes for samples in episode.samples}
    recorded = [e.recording.joints.position_std for e in problem.episodes if e.recording.joints is not None]
    encoders = problem.options.sensors.get(POSITION)
    if (EFFORT, "std") in levels and any(std is not None and np.any(std) for std in recorded):
        levels.add((POSITION, "std"))  # the encoders' noise is part of that of efforts
    if encoders is not None and encoders.std is not None:
        levels.add((POSITION, "std"))
    for errors in (episode.errors for episode in problem.episodes):
        if errors is not None:
            given = {
                (EFFORT, "std"): errors.torque_std,
                (EFFORT, "bias_std"): errors.bias_std,
                (POSITION, "std"): errors.angle_std,
            }
            levels |= {level for level, std in given.items() if np.any(std > 0)}
    return levels


def _times(share: float, std: float | Mapping[str, float]) -> float | Mapping[str, float]:
    return {name: share * value for name, value in std.items()} if isinstance(std, Mapping) else share * std


def predictions(finding: Finding) -> list[Prediction]:
    """Held-out episodes with predictions of the nominal and of the final model; failed ones are left out."""
    before, after = (
        fit.problem.weighted_by_sensors().validate(fit.problem.vector(fit.values))
        for fit in (finding.nominal, finding.last)
    )
    return [
        (episode, first, last)
        for (episode, first), (_, last) in zip(before, after, strict=True)
        if not isinstance(first, str) and not isinstance(last, str)
    ]


def _scenes(finding: Finding, predicted: Sequence[Prediction]) -> list[Scene]:
    """What was predicted of every held-out recording, without the effects and with them."""
    fits = {"nominal model": finding.nominal}
    fits |= {"with the effects": finding.last} if finding.effects else {}
    scenes = []
    for episode, *outcomes in predicted:
        told = []
        for (name, fit), outcome in zip(fits.items(), outcomes, strict=False):
            system, predictor = fit.problem.system, fit.problem.predictor
            theta, _ = fit.problem.split(fit.problem.vector(fit.values), 0)
            q = outcome.rollout.state[:, : system.size]
            told.append(Told(name, system, predictor.own_theta(episode, theta), episode.grid.times, q))
        scenes.append(scene(f"{episode.name} (held out)", told, episode.recording))
    return scenes

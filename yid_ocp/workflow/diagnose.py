"""The command `diagnose`: detect, locate and explain the gap between simulation and recordings."""

from __future__ import annotations

import argparse
import logging
import os
import threading
from collections import UserDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp import files
from yid_ocp.analysis.estimation import uncounted_error_texts
from yid_ocp.arrays import Array
from yid_ocp.config.reader import SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME, load_config
from yid_ocp.config.settings import RunSettings
from yid_ocp.diagnosis.baseline import EarlierRunsBaseline, problem_with_priors_and_baseline
from yid_ocp.diagnosis.diagnose import diagnose
from yid_ocp.diagnosis.diagnosis_result import DiagnosisResult
from yid_ocp.diagnosis.hypotheses import REFIT_SOLVER, make_candidate_effects
from yid_ocp.diagnosis.refit import RefittedModel, StoredFit
from yid_ocp.display import NULL_PROGRESS, Progress
from yid_ocp.effects import EFFECTS
from yid_ocp.effects.law import torque_law_tables_csv
from yid_ocp.errors import DataError, OutputError
from yid_ocp.inference import uncertainty
from yid_ocp.inference.smoother import smoothed_unknown_units
from yid_ocp.inference.whitening import problem_with_sensor_noise_only
from yid_ocp.parallel import return_freed_memory
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode, EpisodePrediction
from yid_ocp.problem.recorded_inputs import effect_kinds_by_missing_signals
from yid_ocp.report.animation import AnimationData, ConfigurationTrajectory, animation_of_trajectories
from yid_ocp.sensors.joints import JOINT_EFFORT_SENSOR_KEY, JOINT_POSITION_GROUP_NAME
from yid_ocp.solvers import GaussNewton, Solution, fit_problem
from yid_ocp.solvers.base import Iterate
from yid_ocp.workflow import prediction_outputs, run_history, run_inputs
from yid_ocp.workflow.build_problem import build_problem, issues_to_plain_data
from yid_ocp.workflow.command_runner import CommandOutcome, run_command_and_print
from yid_ocp.workflow.plan import discrimination_plan_settings
from yid_ocp.workflow.prediction_outputs import EpisodeWithNominalAndEffectPredictions
from yid_ocp.workflow.run_folder import RunFolder, atomic_run_folder, software_and_plugin_versions

log = logging.getLogger(__name__)
_STORE_FORMAT = "yid-refits/1"
_MAX_SHOWN_UNKNOWNS = 5  # in a figure; the page's maps and trajectories.h5 contain all


def run_and_return_exit_code(arguments: argparse.Namespace) -> int:
    """Run the command `diagnose` and return its exit code."""
    settings = load_config(arguments.config, arguments.overrides, SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME)
    if arguments.baseline:
        said = tuple(str(Path(folder).expanduser().resolve()) for folder in arguments.baseline)
        key = ("diagnosis", "baseline_run_folders")
        at = {own: place for own, place in settings.key_locations.items() if own[:2] != key} | {key: "--baseline"}
        settings = replace(settings, diagnosis=replace(settings.diagnosis, baseline_run_folders=said), key_locations=at)
    return run_command_and_print(arguments, lambda shown: run_diagnose(settings, arguments.out, shown))


def run_diagnose(
    run: RunSettings, out: str | Path | None = None, progress: Progress = NULL_PROGRESS
) -> CommandOutcome[DiagnosisResult]:
    """Run a diagnosis and write the run folder. Finished refits of an interrupted, identical run are reused."""
    with atomic_run_folder(run, out, "diagnose") as folder:
        text = folder.record_run_start(run, "diagnose", _flags(run))
        refits = _SingleJsonFileRefitStore(folder, folder.input_hashes, text, software_and_plugin_versions())
        logged = _LoggedProgress(progress, folder)
        progress.begin_stage("building the model and its compiled step", ahead=24.5)
        run_inputs.load_plugins(run)  # they may register effects
        with run_inputs.add_setting_location_to_errors(run, "diagnosis", "candidates"):
            for text in () if isinstance(run.diagnosis.candidates, str) else run.diagnosis.candidates:
                _ = EFFECTS[text.partition("@")[0]]  # a misspelt name needs no model
        runs = run_history.estimates_of_each_baseline_run(run)
        without, said = run_history.recordings_without_effect_or_reason(run)
        if said:
            folder.log_event("message", level="WARNING", source="baseline", text=said)
        run = run_history.settings_with_baseline_effects(run, runs)
        problem = build_problem(run, reference_recordings=without)
        with run_inputs.add_setting_location_to_errors(run, "diagnosis", "candidates"):
            make_candidate_effects(problem.system, [e.recording for e in problem.episodes], run.diagnosis.candidates)
        run_history.require_recordings_not_in_baseline(run, problem, runs, without)
        earlier = EarlierRunsBaseline.from_run_estimates(runs, without)
        problem, _ = problem_with_priors_and_baseline(problem, earlier)
        nominal: Solution | None = None
        stated = run.solver if isinstance(run.solver, GaussNewton) else REFIT_SOLVER
        try:
            if run.diagnosis.noise_fraction_of_stated_std < 1 and problem.held_out:
                # in units of noise, the solver would reject any fit and restart
                logged.begin_stage("solving the nominal model", 5.0, 19.5)
                # without the evaluation, whose Jacobian would fill the memory
                nominal = replace(fit_problem(problem, run.solver, callback=logged.report_iterate), evaluation=None)
            finding = diagnose(
                _with_noise_only_stds(problem, run),
                run.diagnosis.candidates,
                thresholds=run.diagnosis,
                progress=logged,
                solution=nominal,
                store=refits,
                baseline=earlier,
                exclude=run.diagnosis.excluded_candidates,
                refit_solver=replace(stated.with_coarse_tolerances, max_iterations=REFIT_SOLVER.max_iterations),
            )
        except KeyboardInterrupt:
            if len(refits):
                log.warning("%d finished refits are kept in %s. The same command reuses them", len(refits), refits.file)
            raise
        folder.log_event("end", verdict=finding.verdict, effects=[effect.label for effect in finding.accepted_effects])
        predicted = _held_out_predictions(finding)
        prediction_outputs.write_diagnosis_hdf5(folder.path / "trajectories.h5", finding, predicted)
        if finding.law is not None:
            files.write_text(folder.path / "law.csv", torque_law_tables_csv(finding.law.tables))
        last, told = finding.final_model, finding.to_dict()
        system = last.problem.system
        moving = not last.problem.options.clamp_pose_point_names and bool(system.driven or system.prescribed)
        x, is_found = last.unknowns, finding.verdict in ("effect", "no_gap")
        is_found = is_found and problem.options.has_no_data_issue_above_warning
        recordings = [episode.recording for episode in (*problem.episodes, *problem.held_out)]
        tries_all = isinstance(run.diagnosis.candidates, str)
        own = {
            "model": _final_model_to_dict(finding),
            "issues": issues_to_plain_data(problem.options.data_issues),
            "torque_offsets": prediction_outputs.torque_offsets_by_recording(last.problem, x),
            "to_use": _texts_of_final_model(finding, os.path.relpath(folder.final_path)) if is_found else {},
            "not_candidates": effect_kinds_by_missing_signals(recordings) if tries_all else {},
            "unused_efforts": prediction_outputs.has_unused_efforts(problem),
            "next_plan": discrimination_plan_settings(told["confusable"] if moving else (), str(folder.final_path)),
        }
        known = {"problem": problem, "animations": _scenes(finding, predicted)}
        more = {"finding": finding, "predictions": predicted}
        written = folder.write_result_and_report(run, progress, told | own, **known, section_data=more)
    folder.delete_resume_data(*folder.resume_folder.glob("*refits.json*"))  # also temporary copies
    return CommandOutcome(folder.path, written, finding)


def _final_model_to_dict(finding: DiagnosisResult) -> dict[str, Any]:
    """Return the final model for result.json: its parameters, also of effects, and the free ones' covariance."""
    fit = finding.final_model
    problem, shared = fit.problem, fit.problem.shared_parameters
    idle = {entry.effect.label for entry in finding.screening.detectability} - {effect.label for effect in fit.effects}
    theta, _ = problem.unpack_episode_unknowns(fit.unknowns, 0)
    found = {}
    for entry, value in zip(problem.system.parameters, theta, strict=True):
        if entry.name not in problem.local_parameters and entry.name.rpartition(".")[0] not in idle:
            free = entry.name in shared
            std = files.to_json_types(fit.std[entry.name]) if free else 0.0
            found[entry.name] = {"value": float(value), "std": std, "unit": entry.unit, "free": free}
    matrix, _ = uncertainty.unknowns_covariance_and_reduced_chi2(problem, fit.evaluation)
    stds = [fit.std[name] for name in shared]
    covariance = uncertainty.covariance_to_dict(shared, matrix[: len(shared), : len(shared)], stds)
    return {"parameters": found, "covariance": covariance}


def _texts_of_final_model(finding: DiagnosisResult, folder: str) -> dict[str, Any]:
    """Return texts to copy: estimates (of accepted effects also weak ones), effects, and a changed time step."""
    fit, system = finding.final_model, finding.final_model.problem.system
    sizes, estimates = uncertainty.typical_parameter_magnitudes(fit.problem, fit.unknowns), {}
    added = [own.label for own in finding.accepted_effects]
    for name in fit.problem.shared_parameters:
        entry, value, std = system.parameters[name], fit.values[name], fit.std[name]
        verdict = uncertainty.verdict_by_relative_std(value, std, sizes[name])
        verdict = "identifiable" if verdict == "weak" and name.rpartition(".")[0] in added else verdict
        told = entry.unit, entry.value, entry.lower, entry.upper
        estimates[name] = uncertainty.ParameterEstimate(value, std, *told, True, verdict)
    effects = [f"  - {{kind: {own.kind}, location: {own.location}}}" for own in finding.accepted_effects]
    lines = ["model:", "  effects:  # add them to those of the configuration", *effects] if effects else []
    stated, used = finding.stated_and_used_time_step
    lines += ["problem:", f"  time_step: {used:g}"] if used != stated else []
    copied = system, fit.problem.unpack_episode_unknowns(fit.unknowns, 0)[0], estimates
    export = "export", folder, "--out", "model.xml"
    left_out = uncounted_error_texts(fit.problem, finding.errors_in_std)
    return prediction_outputs.copyable_estimate_texts(*copied, export, left_out, lines)


@dataclass(frozen=True)
class _LoggedProgress(Progress):
    shown: Progress
    folder: RunFolder

    def begin_stage(self, text: str, work: float = 0.0, ahead: float | None = None) -> None:
        return_freed_memory()
        self.folder.log_event("stage", text=text)
        self.shown.begin_stage(text, work, ahead)

    def report_iterate(self, entry: Iterate) -> None:
        self.shown.report_iterate(entry)

    def report_parts_done(self, done: int, total: int, text: str) -> None:
        self.folder.log_event("part", done=done, total=total, text=text)
        self.shown.report_parts_done(done, total, text)

    def renew_results_table(self, rows: Sequence[Sequence[str]]) -> None:
        self.shown.renew_results_table(rows)


def _flags(run: RunSettings) -> list[str]:
    said = run.key_locations
    given = said.get(("diagnosis", "baseline_run_folders"), "--baseline")
    if given != "--baseline" or any(at.startswith("--set") for at in said.values()):
        return []  # the configuration has them
    return [part for folder in run.diagnosis.baseline_run_folders for part in ("--baseline", folder)]


def _with_noise_only_stds(problem: EstimationProblem, run: RunSettings) -> EstimationProblem:
    """Return the problem with all stated stds times `diagnosis.noise_fraction_of_stated_std`, so that noise remains."""
    share, options = run.diagnosis.noise_fraction_of_stated_std, problem.options
    if share == 1:
        return problem
    sensors = dict(options.sensors)
    for group, field in sorted(_noise_levels(problem)):
        level = getattr(sensors[group], field) if group in sensors else None
        if level is None:
            what = f"diagnosis.noise_fraction_of_stated_std needs sensors.{group}.{field}, which is not set"
            where, hint = ("diagnosis", "noise_fraction_of_stated_std"), f"set sensors.{group}.{field}"
            raise run.config_error(what, *where, allowed="all noise levels under `sensors`, or 1", hint=hint)
        by_name = isinstance(level, Mapping)
        smaller: Any = {name: share * std for name, std in level.items()} if by_name else share * level
        sensors[group] = replace(sensors[group], **{field: smaller})
    prior = options.multivariate_prior
    return problem.with_options(
        replace(
            options,
            sensors=sensors,
            stated_std_factor=share * options.stated_std_factor,
            prior_stds={name: share * std for name, std in options.prior_stds.items()},
            multivariate_prior=prior.with_parameters_scaled_by(dict.fromkeys(prior.parameter_names, share)),
            huber_threshold=options.huber_threshold / share,
            weak_prior_geometric_std=options.weak_prior_geometric_std**share,  # 0 stays 0
            initial_configuration_prior_std=share * options.initial_configuration_prior_std,
            initial_velocity_prior_std=share * options.initial_velocity_prior_std,
        )
    )


def _noise_levels(problem: EstimationProblem) -> set[tuple[str, str]]:
    """Return the standard deviations that the problem uses, each as a sensor group and a field of `SensorOptions`."""
    levels = {(samples.sensor.group_name, "std") for episode in problem.episodes for samples in episode.measurements}
    recorded = [e.recording.joints.position_std for e in problem.episodes if e.recording.joints is not None]
    encoders = problem.options.sensors.get(JOINT_POSITION_GROUP_NAME)
    noisy = any(std is not None and np.any(std) for std in recorded)
    samples_of_all = [samples for episode in problem.episodes for samples in episode.measurements]
    compared = any(s.sensor.effort_joints or s.noise_correlation is not None for s in samples_of_all)
    if (compared and noisy) or (encoders is not None and encoders.std is not None):
        levels.add((JOINT_POSITION_GROUP_NAME, "std"))  # encoder noise is part of the effort noise
    for errors in (episode.input_errors for episode in problem.episodes if episode.input_errors is not None):
        given = {
            (JOINT_EFFORT_SENSOR_KEY, "std"): errors.torque_std,
            (JOINT_EFFORT_SENSOR_KEY, "bias_std"): errors.torque_bias_std,
            (JOINT_POSITION_GROUP_NAME, "std"): errors.angle_std,
        }
        levels |= {level for level, std in given.items() if np.any(std > 0)}
    return levels


def _held_out_predictions(finding: DiagnosisResult) -> list[EpisodeWithNominalAndEffectPredictions]:
    before, after = (
        problem_with_sensor_noise_only(fit.problem).predict_held_out(fit.unknowns)
        for fit in (finding.nominal_model, finding.final_model)
    )
    pairs = ((episode, first, last) for (episode, first), (_, last) in zip(before, after, strict=True))
    return [(e, first, last) for e, first, last in pairs if not isinstance(first, str) and not isinstance(last, str)]


def _scenes(finding: DiagnosisResult, predicted: list[EpisodeWithNominalAndEffectPredictions]) -> list[AnimationData]:
    fits = {"nominal model": finding.nominal_model}
    fits |= {"with the effects": finding.final_model} if finding.accepted_effects else {}
    scenes = []
    for episode, *outcomes in predicted:
        told = []
        for (name, fit), outcome in zip(fits.items(), outcomes, strict=False):
            course, unseen = _course(name, fit, episode, outcome), np.zeros((episode.grid.steps + 1, 0))
            told.append(replace(course, acting=[(own.label, own.location, "", unseen) for own in fit.effects]))
        scenes.append(animation_of_trajectories(f"{episode.name} (held out)", told, episode.recording))
    scenes[1:1] = _unknown_force_scene(finding)
    return scenes


def _course(name: str, fit: RefittedModel, episode: Episode, outcome: EpisodePrediction) -> ConfigurationTrajectory:
    theta = fit.problem.unpack_episode_unknowns(fit.unknowns, 0)[0]
    return prediction_outputs.predicted_configuration_trajectory(name, fit.problem, episode, outcome, theta)


def _unknown_force_scene(finding: DiagnosisResult) -> list[AnimationData]:
    """Return an animation of the recording with the largest unknown forces and offsets, by the nominal model."""
    fit, smoothed = finding.nominal_model, finding.smoother_result
    if smoothed is None or not smoothed.smoothed_unknowns:
        return []
    trace = max(smoothed.smoothed_unknowns, key=lambda own: float(np.linalg.norm(own.posterior_mean)))
    pairs = zip(fit.problem.episodes, fit.evaluation.episode_predictions, strict=True)
    episode, outcome = next(pair for pair in pairs if pair[0].name == trace.recording)
    since = episode.grid.node_times - episode.grid.start_time
    at = np.clip(np.searchsorted(trace.interval_edges, since, "right") - 1, 0, len(trace.posterior_mean) - 1)
    units, found = smoothed_unknown_units(fit.problem.system, trace), list[tuple[float, tuple[str, str, str, Array]]]()
    for group in dict.fromkeys(trace.unknown_groups):
        columns = [i for i, own in enumerate(trace.unknown_groups) if own == group]
        values = (trace.reference_std * trace.posterior_mean)[at][:, columns]
        is_vector = [trace.unknown_names[i][-1] for i in columns] == ["x", "y", "z"] and group.kind != "force"
        values = values if is_vector else np.linalg.norm(values, axis=1, keepdims=True)
        if smoothed.group_variance[group] > 0:
            own = (f"{group.kind} {group.location}", group.location, units[columns[0]], values)
            found.append((float(np.linalg.norm(trace.posterior_mean[:, columns])), own))
    shown = [own for _, own in sorted(found, key=lambda entry: -entry[0])[:_MAX_SHOWN_UNKNOWNS]]
    course = replace(_course("nominal model", fit, episode, outcome), acting=shown)
    return [animation_of_trajectories(f"{episode.name} (unknown forces)", [course], episode.recording)]


class _SingleJsonFileRefitStore(UserDict[str, StoredFit]):
    """A store of refits in one JSON file, replaced as a whole after every refit."""

    def __init__(self, folder: RunFolder, *made_from: Mapping[str, str] | str) -> None:
        super().__init__()
        self.file = folder.resume_folder / "refits.json"
        self._folder, self._key = folder, files.json_sha256(made_from)
        self._lock, self._warned = threading.Lock(), False
        self.data = self._read()

    def __getitem__(self, name: str) -> StoredFit:
        """Return the stored refit of that name. Reuse is logged."""
        found = super().__getitem__(name)
        self._folder.log_event("resumed", refit=name)
        return found

    def __setitem__(self, name: str, refitted: StoredFit) -> None:
        with self._lock:
            self.data[name] = refitted
            try:
                self.file.parent.mkdir(parents=True, exist_ok=True)
                data = {"format": _STORE_FORMAT, "key": self._key, "refits": files.to_lossless_plain_data(self.data)}
                files.write_strict_json(self.file, data)
            except (OSError, OutputError) as error:
                if not self._warned:
                    log.warning("Finished refits cannot be stored (%s), so an interruption would lose them", error)
                self._warned = True

    def _read(self) -> dict[str, StoredFit]:
        if not self.file.exists():
            return {}
        try:
            held = files.read_input_json(self.file)
            if (held["format"], held["key"]) == (_STORE_FORMAT, self._key):
                return {name: files.dataclass_from_plain_data(StoredFit, fit) for name, fit in held["refits"].items()}
            reason = "they are of other inputs, other settings or another version"
        except (DataError, ValueError, LookupError, TypeError, AttributeError):
            reason = "the file cannot be read"
        log.warning("All effects are fitted again. The refits in %s are not used, because %s", self.file, reason)
        return {}

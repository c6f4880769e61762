"""The command `friction`: compare the laws of the friction ladder on motions that were not fitted."""

from __future__ import annotations

import os
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from yid_ocp.analysis import estimation, friction_law_comparison
from yid_ocp.analysis.friction_law_comparison import CrossValidatedFrictionLawFit, mean_and_std_error_over_motion_kinds
from yid_ocp.config.settings import FrictionLawSettings, RunSettings
from yid_ocp.display import PartsDoneCounter, Progress
from yid_ocp.effects.friction import EFFECT_KINDS_BY_FRICTION_LAW
from yid_ocp.errors import FAILED_ROLLOUT_ADVICE, DataError
from yid_ocp.problem import EstimationProblem
from yid_ocp.sensors.joints import JOINT_EFFORT_SENSOR_KEY
from yid_ocp.solvers import Solution, Status, fit_problem
from yid_ocp.workflow.build import friction_joint_names, friction_parameter_names
from yid_ocp.workflow.build_problem import build_problem
from yid_ocp.workflow.command_runner import CommandOutcome, make_command_function
from yid_ocp.workflow.prediction_outputs import copyable_estimate_texts
from yid_ocp.workflow.run_folder import atomic_run_folder


def _run_friction(run: RunSettings, out: str | Path | None, progress: Progress) -> CommandOutcome[None]:
    """Fit all friction laws with each kind of motion left out. Successful if the warranted law's fit converged."""
    said = run.model.friction or FrictionLawSettings(law="viscous")
    with atomic_run_folder(run, out, "friction") as folder:
        folder.record_run_start(run, "friction")
        progress.begin_stage("building the models of the friction laws")
        fits: list[CrossValidatedFrictionLawFit] = []
        solved: dict[str, tuple[RunSettings, EstimationProblem, Solution]] = {}
        by_law = {
            law: replace(run, model=replace(run.model, friction=replace(said, law=law)))
            for law in EFFECT_KINDS_BY_FRICTION_LAW
        }
        settings, *others = by_law.values()
        on_all = friction_law_comparison.problem_estimating_from_all_recordings
        problem = on_all(build_problem(settings))
        kinds = _testable_motion_kinds(settings, problem)  # before the other models are compiled
        problems = [problem, *(on_all(build_problem(own)) for own in others)]
        problems = friction_law_comparison.problems_with_common_samples(problems)
        progress.begin_stage("fitting the friction laws, each also with one kind of motion left out in turn")
        parts = PartsDoneCounter(progress, len(problems) * (1 + len(kinds)), next(iter(by_law)))
        for (law, settings), problem in zip(by_law.items(), problems, strict=True):
            solution = fit_problem(problem, run.solver, restarts=not problem.system.driven)
            if solution.status == Status.FAILED:
                for _ in range(1 + len(kinds)):
                    parts.count_done(f"law '{law}' could not be fitted: {solution.message}")
                continue
            parts.count_done(f"law '{law}' is fitted to all motions")
            fits.append(friction_law_comparison.cross_validate_law_by_motion_kind(law, problem, solution, kinds, parts))
            solved[law] = (settings, problem, solution)
        if not fits:
            what = f"none of the {len(by_law)} friction laws could be fitted, the last one because {solution.message}"
            where, allowed = run.setting_location("recordings"), "recordings that one of the laws can follow"
            raise DataError(what, where=where, allowed=allowed, hint=FAILED_ROLLOUT_ADVICE)
        best = friction_law_comparison.simplest_fit_within_one_std_error(fits, kinds)
        settings, problem, fitted = solved[best.law]
        solution, checks = estimation.add_discretisation_errors(fitted.problem or problem, fitted, progress)
        solved[best.law] = settings, problem, solution
        names = friction_parameter_names(settings, problem.system.parameters)
        clouds = friction_law_comparison.measured_and_predicted_friction_torques(problem, solution, names)
        result: dict[str, Any] = {
            "format": "yid-friction/1",
            "kinds": {kind: list(own) for kind, own in kinds.items()},
            "joints": list(friction_joint_names(settings, problem.system)),
            "unit": best.unit,
            "laws": {fit.law: _law_result(fit, best, kinds, *solved[fit.law][1:]) for fit in fits},
            "warranted": best.law,
            "friction_parameters": [name for name in names if name in problem.free],
        }
        speed = "" if said.sign_smoothing_speed is None else f", sign_smoothing_speed: {said.sign_smoothing_speed:g}"
        section = f"{{law: {best.law}, joints: [{', '.join(result['joints'])}]{speed}}}"
        again = "solve", os.path.relpath(folder.final_path / "config.yaml"), "--set", f"model.friction={section}"
        model = ["model:", f"  friction: {section}"]
        copied = problem.system, problem.unpack_episode_unknowns(solution.x, 0)[0], solution.parameters, again
        texts = copyable_estimate_texts(*copied, checks.uncounted_errors, model)
        result["to_use"] = texts if best.is_converged else {}
        folder.log_event("end", warranted=best.law)
        known = {"problem": problem, "solution": solution, "section_data": {"friction_clouds": clouds}}
        written = folder.write_result_and_report(run, progress, result, **known)
    return CommandOutcome(folder.path, written, None, best.is_converged)


def _testable_motion_kinds(run: RunSettings, problem: EstimationProblem) -> dict[str, tuple[str, ...]]:
    """Return the recordings by kind of motion. Raises `DataError` if they cannot test the friction of the joints."""
    kinds = friction_law_comparison.recording_names_by_name_stem(problem)
    if len(kinds) < 2:
        allowed, hint = "two recordings or more", "list a recording of another motion under recordings.estimate"
        unused = [e.name for e in problem.episodes if not any(e.name in own for own in kinds.values())]
        what = f"each motion is held out in turn, which needs two recordings, but only {len(kinds)} can be used"
        what += f" (the motors are off in {', '.join(unused)})" if unused else ""
        raise DataError(what, where=run.setting_location("recordings"), allowed=allowed, hint=hint)
    rubbing, compared = friction_joint_names(run, problem.system), problem.episodes[0].measurements
    if {*rubbing} <= {*problem.system.prescribed} and not any(own.sensor.effort_joints for own in compared):
        what = "the joints follow their measured angles, so friction shows only in torques, which are not used"
        where, hint = run.setting_location("sensors"), f"set sensors.{JOINT_EFFORT_SENSOR_KEY}.use: true"
        hint += " and, unless the torques have no constant error or it is stated, bias_std there to its size [N m]"
        raise DataError(what, where=where, allowed="recorded torques that the fit compares with the model", hint=hint)
    return kinds


def _law_result(
    fit: CrossValidatedFrictionLawFit,
    best: CrossValidatedFrictionLawFit,
    kinds: dict[str, tuple[str, ...]],
    problem: EstimationProblem,
    solution: Solution,
) -> dict[str, Any]:
    mean, error = mean_and_std_error_over_motion_kinds(fit.left_out_errors, kinds)
    difference, paired = friction_law_comparison.prediction_error_difference_and_std_error(fit, best, kinds)
    result = {"mean_error": mean, "standard_error": error, "left_out_errors": dict(fit.left_out_errors)}
    result |= {"beyond_warranted": difference, "beyond_warranted_standard_error": paired}
    parameters = {name: asdict(entry) for name, entry in solution.parameters.items() if name in problem.free}
    return {**result, "converged": fit.is_converged, "parameters": parameters}


run_and_return_exit_code = make_command_function(_run_friction)

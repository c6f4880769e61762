"""Diagnoses of blind cases, and the best closure a diagnosis could reach."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from yid_ocp.diagnosis.blind.ensemble import BlindCase, CaseGenerator, CaseLabel
from yid_ocp.diagnosis.diagnose import diagnose, fit_nominal_model
from yid_ocp.diagnosis.diagnosis_result import DiagnosisResult
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem, CandidateChoice, make_candidate_effects
from yid_ocp.diagnosis.refit import refit_with_effects
from yid_ocp.diagnosis.select import gap_closure
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.effects.base import ParameterDefinition
from yid_ocp.progress import Progress


def diagnose_case(
    ensemble: CaseGenerator,
    case: BlindCase,
    candidates: CandidateChoice = "all",
    thresholds: Thresholds | None = None,
    progress: Progress | None = None,
) -> DiagnosisResult:
    """Diagnose a blind case from its recordings alone."""
    problem = ensemble.nominal_problem(case.estimation_recordings)
    return diagnose(
        problem,
        candidates,
        [case.held_out_recording],
        thresholds=thresholds,
        progress=progress,
        exclude=case.excluded_kinds,
    )


def best_possible_closure(
    ensemble: CaseGenerator, case: BlindCase, label: CaseLabel, candidates: CandidateChoice = "all"
) -> float:
    """Return the held-out closure of the true effects after a refit, the best a diagnosis could reach."""
    problem = ensemble.nominal_problem(case.estimation_recordings)
    effects = make_candidate_effects(problem.system, case.estimation_recordings, candidates)
    composed = AllCandidatesProblem.from_problem(problem, effects, [case.held_out_recording])
    nominal = fit_nominal_model(problem, composed)
    true = {entry.label: entry for entry in label.injected}
    chosen = [effect for effect in composed.candidate_effects if effect.label in true]
    start = {}
    for effect in chosen:
        start.update(_internal(effect.label, true[effect.label].values, effect.definitions))
    # under the weights of the nominal fit, as all that it is compared with
    fit = refit_with_effects(replace(composed, problem=nominal.problem), chosen, {**nominal.values, **start})
    return (
        math.nan
        if fit is None or len(chosen) < len(true)
        else gap_closure(nominal.held_out_loss, fit.held_out_loss).fraction
    )


def _internal(label: str, values: Mapping[str, float], quantities: Sequence[ParameterDefinition]) -> dict[str, float]:
    """Reported values in the parameters' own unit."""
    found = {}
    for quantity in quantities:
        name, _ = quantity.reported_name_and_unit
        if name in values:
            found[f"{label}.{quantity.name}"] = quantity.to_internal(values[name])
    return found

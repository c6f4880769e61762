"""Diagnoses of blind cases, and the best closure a diagnosis could reach."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from yid_ocp.diagnosis.blind.ensemble import Case, Ensemble, Label
from yid_ocp.diagnosis.diagnose import diagnose, nominal_fit
from yid_ocp.diagnosis.finding import Finding
from yid_ocp.diagnosis.hypotheses import CandidateProblem, Choice, chosen_effects
from yid_ocp.diagnosis.refit import refit
from yid_ocp.diagnosis.select import closure
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.effects.base import Quantity
from yid_ocp.progress import Progress


def answer(
    ensemble: Ensemble,
    case: Case,
    candidates: Choice = "all",
    thresholds: Thresholds | None = None,
    progress: Progress | None = None,
) -> Finding:
    """Diagnose a blind case from its recordings alone."""
    problem = ensemble.of(case.estimate)
    return diagnose(
        problem, candidates, [case.held_out], thresholds=thresholds, progress=progress, leave_out=case.without
    )


def best_closure(ensemble: Ensemble, case: Case, label: Label, candidates: Choice = "all") -> float:
    """Return the held-out closure of the true effects after a refit, the best a diagnosis could reach."""
    problem = ensemble.of(case.estimate)
    effects = chosen_effects(problem.system, case.estimate, candidates)
    composed = CandidateProblem.of(problem, effects, [case.held_out])
    nominal = nominal_fit(problem, composed)
    true = {entry.label: entry for entry in label.injected}
    chosen = [effect for effect in composed.effects if effect.label in true]
    start = {}
    for effect in chosen:
        start.update(_internal(effect.label, true[effect.label].values, effect.quantities))
    # under the weights of the nominal fit, as all that it is compared with
    fit = refit(replace(composed, problem=nominal.problem), chosen, {**nominal.values, **start})
    return math.nan if fit is None or len(chosen) < len(true) else closure(nominal.loss, fit.loss).value


def _internal(label: str, values: Mapping[str, float], quantities: Sequence[Quantity]) -> dict[str, float]:
    """Reported values in the parameters' own unit."""
    found = {}
    for quantity in quantities:
        name, _ = quantity.reported
        if name in values:
            found[f"{label}.{quantity.name}"] = quantity.kept(values[name])
    return found

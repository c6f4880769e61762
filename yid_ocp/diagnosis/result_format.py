"""A judgement in the format `yid-diagnosis/2`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from yid_ocp.diagnosis.refit import RefitStatistics
from yid_ocp.diagnosis.screening import CandidateScore
from yid_ocp.diagnosis.select import UNDEFINED_GAP_CLOSURE, GapClosure, held_out_gap_closure
from yid_ocp.diagnosis.verdict import Judgement, NominalModelGapEvidence
from yid_ocp.files import attributes_to_dict, to_json_types
from yid_ocp.inference.smoother import GapLocation

EFFECT_KEYS = "kind location"
PLACE_KEYS = "location share=gap_share observable=is_observable windows=time_windows indistinguishable_from"


def judgement_to_dict(judged: Judgement, seen: NominalModelGapEvidence, where: Sequence[GapLocation]) -> dict[str, Any]:
    """Convert the verdict of a diagnosis and the evidence for it to a JSON-compatible dictionary."""
    added = judged.accepted_selected_effects
    before = errors_to_dict(seen.nominal_model) | attributes_to_dict(seen.nominal_held_out_test, "chi2_per_dof p_value")
    closed = judged.closure_by_selected_effects if added else UNDEFINED_GAP_CLOSURE
    rivals = [entry.equivalent_effects for entry in added if len(entry.equivalent_effects) > 1]
    found = {
        "verdict": judged.verdict,
        "probability": judged.probability,
        "gap": {"before": before, **closure_to_dict(closed)},
        "where": [attributes_to_dict(place, PLACE_KEYS) for place in where],
        "which": _ranked_candidates(judged, seen),
        "effects": [attributes_to_dict(entry.effect, EFFECT_KEYS) for entry in added],
        "confusable": [[attributes_to_dict(effect, EFFECT_KEYS) for effect in own] for own in rivals],
    }
    return dict(to_json_types(found))


def closure_to_dict(closed: GapClosure) -> dict[str, Any]:
    """Convert a closed fraction of the gap and its 95 % interval to entries of result.json."""
    return {"closure": closed.fraction, "closure_ci": [closed.ci_low, closed.ci_high]}


def errors_to_dict(fit: RefitStatistics) -> dict[str, Any]:
    """Convert the held-out errors of a fit and their units, by channel, to entries of result.json."""
    channels = fit.held_out_loss.channel_rmse.items()
    return {"rmse": {name: rmse for name, (rmse, _) in channels}, "unit": {name: unit for name, (_, unit) in channels}}


def _ranked_candidates(judged: Judgement, seen: NominalModelGapEvidence) -> list[dict[str, Any]]:
    """All candidates: accepted effects, then other refits by held-out loss, then the rest by score."""
    added, alone = judged.accepted_selected_effects, judged.single_effect_models
    before = seen.nominal_model.held_out_loss
    closures = {fit.effects[0].label: held_out_gap_closure(before, fit.held_out_loss) for fit in alone}
    scores = {score.effect.label: score for score in seen.screening.candidate_scores}
    probabilities = judged.selected_effect_and_equivalent_probabilities
    found = [
        *((e.effect, added[-1].refitted_model.effect_parameters_as_reported(e.effect)) for e in added),
        *((fit.effects[0], fit.effect_parameters_as_reported(fit.effects[0])) for fit in alone),
        *((s.effect, s.effect.parameters_as_reported(s.predicted_values)) for s in scores.values()),
    ]
    listed: dict[str, dict[str, Any]] = {}
    for effect, reported in found:
        score = scores.get(effect.label, CandidateScore(effect, {}, 0.0, 0.0, 1.0))
        entry = {
            **attributes_to_dict(effect, EFFECT_KEYS),
            "parameters": {name: attributes_to_dict(own, "value std unit") for name, own in reported.items()},
            **attributes_to_dict(score, "score=lm_statistic p_value"),
            "probability": probabilities.get(effect.label, 0.0),
            **closure_to_dict(closures.get(effect.label, UNDEFINED_GAP_CLOSURE)),
        }
        listed.setdefault(effect.label, to_json_types(entry))
    return list(listed.values())

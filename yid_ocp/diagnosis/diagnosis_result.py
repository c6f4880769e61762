"""The result of a diagnosis, as a dataclass and as `yid-diagnosis/2`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from yid_ocp.diagnosis.baseline import BaselineComparison, CounterfactualTest
from yid_ocp.diagnosis.events import NO_EVENTS, EventSet
from yid_ocp.diagnosis.hypotheses import TruncatedRecording
from yid_ocp.diagnosis.localise import GapLocation
from yid_ocp.diagnosis.refit import RefitModel
from yid_ocp.diagnosis.screening import (
    CandidateDetectability,
    CandidateScore,
    ConfusabilityMatrix,
    bonferroni_min_p_value,
)
from yid_ocp.diagnosis.select import (
    GapClosure,
    SelectedEffect,
    gap_closure,
    held_out_improvement,
    penalized_chi2_difference,
    rmse_reduction,
)
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.diagnosis.transfer_check import TransferCheck, failed_transfer_checks
from yid_ocp.diagnosis.verdict import UnknownReason, assumption_count
from yid_ocp.display import ReprMixin, ReprSummary
from yid_ocp.effects import EffectBase
from yid_ocp.inference.null_test import ChannelNoiseLevel, NullTestResult, bonferroni_p_value
from yid_ocp.inference.smoother import SmootherResult
from yid_ocp.inference.uncertainty import covariance_and_chi2, covariance_to_dict

_FORMAT = "yid-diagnosis/2"


@dataclass(frozen=True)
class NominalParameterChange:
    """Change of a nominal parameter between the nominal model and the model with the effects."""

    name: str
    unit: str
    value_before: float
    value_after: float
    std_after: float


def nominal_parameter_changes(before: RefitModel, after: RefitModel) -> tuple[NominalParameterChange, ...]:
    """Return how each nominal parameter changes when the effects are added."""
    parameters = before.problem.system.parameters
    return tuple(
        NominalParameterChange(name, parameters[name].unit, before.values[name], after.values[name], after.std[name])
        for name in before.problem.shared_parameters
    )


@dataclass(frozen=True, repr=False)
class DiagnosisResult(ReprMixin):
    """The result of a diagnosis: verdict, gap, locations, effects and the statistics behind them.

    Attributes
    ----------
    verdict : str
        effect, confusable, no_gap, unknown or insufficient_data.
    nominal_test, nominal_held_out_test : NullTestResult
        Nominal model, on the recordings to estimate on and on the held-out ones.
    candidate_scores : tuple of CandidateScore
        First pass, best first.
    smoother_result : SmootherResult or None
        Unknown forces, offsets and biases about the nominal model; None where there is no gap to locate.
    single_effect_models : tuple of RefitModel
        Refits of the first round, best first.
    remaining_test : NullTestResult
        Held-out, with the effects added.
    message : str
        Why the data are insufficient; empty if they suffice.
    explained_fraction : float
        What the effects explain over what unknown forces, offsets and biases explain.
    transfer_checks : tuple of TransferCheck
        The effects' amplitudes on the held-out recordings.
    events : EventSet
        Taken out of the recordings before the rest was judged, as far as that can be done.
    """

    verdict: str
    noise_floor: tuple[ChannelNoiseLevel, ...]
    nominal_test: NullTestResult
    nominal_held_out_test: NullTestResult
    detectability: tuple[CandidateDetectability, ...]
    confusability: ConfusabilityMatrix
    candidate_scores: tuple[CandidateScore, ...]
    smoother_result: SmootherResult | None
    gap_locations: tuple[GapLocation, ...]
    nominal_model: RefitModel
    single_effect_models: tuple[RefitModel, ...]
    selected_effects: tuple[SelectedEffect, ...]
    gap_closure: GapClosure
    remaining_test: NullTestResult
    remaining_gap_locations: tuple[GapLocation, ...]
    nominal_changes: tuple[NominalParameterChange, ...]
    next_experiment: str
    held_out_names: tuple[str, ...]
    is_split_in_blocks: bool
    message: str
    thresholds: Thresholds
    stage_seconds: Mapping[str, float]
    baseline_comparison: BaselineComparison | None = None
    counterfactual: CounterfactualTest | None = None
    summary: str = ""
    truncated_recordings: tuple[TruncatedRecording, ...] = ()
    unknown_reason: UnknownReason = ""
    explained_fraction: float = 1.0
    transfer_checks: tuple[TransferCheck, ...] = ()
    events: EventSet = NO_EVENTS

    def _summary(self) -> ReprSummary:
        effects, closed = ", ".join(effect.label for effect in self.accepted_effects), self.gap_closure.fraction
        said = f"{100 * closed:.3g} % of the held-out gap closed" if effects and math.isfinite(closed) else ""
        rows = [("candidate", "parameters", "closure alone", "p")]
        for entry in _ranked_candidates(self)[:8]:
            values = {name: own for name, own in entry["parameters"].items() if own["value"] is not None}
            known = ", ".join(f"{name} = {own['value']:.3g} {own['unit']}" for name, own in values.items())
            alone = "" if entry["closure"] is None else f"{100 * entry['closure']:.3g} %"
            rows.append((f"{entry['kind']}@{entry['location']}", known, alone, f"{entry['p_value']:.2g}"))
        return ReprSummary(", ".join(filter(None, (self.verdict.replace("_", " "), effects, said))), rows)

    @property
    def accepted_effects(self) -> tuple[EffectBase, ...]:
        """Effects accepted by the verdict, in the order they were added; empty unless effect or confusable."""
        return (
            tuple(entry.effect for entry in self.selected_effects) if self.verdict in ("effect", "confusable") else ()
        )

    @property
    def final_model(self) -> RefitModel:
        """The model with all accepted effects; the nominal model if there are none."""
        return self.selected_effects[-1].refitted_model if self.accepted_effects else self.nominal_model

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `yid-diagnosis/2`, JSON-compatible."""
        return {
            "format": _FORMAT,
            "verdict": self.verdict,
            "gap": {
                "before": _state(self.nominal_model, self.nominal_held_out_test),
                "after": _state(self.final_model, self.remaining_test),
                **(_closure(self.gap_closure) if self.accepted_effects else {"closure": None, "closure_ci": None}),
                "held_out": list(self.held_out_names),
                "cut": [
                    {"recording": c.recording, "kept": c.kept_duration, "whole": c.full_duration}
                    for c in self.truncated_recordings
                ],
            },
            "where": [_place(p) for p in self.gap_locations],
            "which": _ranked_candidates(self),
            "effects": [{"kind": e.kind, "location": e.location} for e in self.accepted_effects],
            "remaining": {
                "p_value": self.remaining_test.p_value,
                "where": [_place(p) for p in self.remaining_gap_locations],
            },
            "reason": self.unknown_reason,
            "rejected_candidates": _rejected_candidates(self),
            "carried_over": [
                {
                    "effect": c.effect_label,
                    "parameter": c.parameter,
                    "value": c.estimation_value,
                    "std": _number(c.estimation_std),
                    "again": c.held_out_value,
                    "again_std": _number(c.held_out_std),
                    "unit": c.unit,
                    "agrees": c.is_consistent,
                }
                for c in self.transfer_checks
            ],
            "confusable": [
                [{"kind": e.kind, "location": e.location} for e in entry.equivalent_effects]
                for entry in self.selected_effects
                if self.accepted_effects and len(entry.equivalent_effects) > 1
            ],
            "events": [event.to_dict() for event in self.events.disturbances],
            "not_judged": [
                {"recording": f.recording, "joint": f.joint, "from": f.start_time} for f in self.events.overspeeds
            ],
            "next_experiment": self.next_experiment,
            "side": None if self.smoother_result is None else self.smoother_result.gap_origin,
            "evidence": {} if self.smoother_result is None else dict(self.smoother_result.log_evidence),
            "explainable": None if self.smoother_result is None else self.smoother_result.explainable_fraction,
            "statistics": threshold_statistics(self),
            "summary": self.summary,
            "message": self.message,
            "held_out_in_blocks": self.is_split_in_blocks,
            "absorption": {
                a.name: {"before": a.value_before, "after": a.value_after, "std": _number(a.std_after), "unit": a.unit}
                for a in self.nominal_changes
            },
            "steps": [
                {
                    "added": entry.effect.label,
                    **_closure(entry.cumulative_closure),
                    "chi2_per_dof": entry.refitted_model.held_out_loss.chi2_per_sample,
                    "rmse": {
                        name: value for name, (value, _) in entry.refitted_model.held_out_loss.channel_rmse.items()
                    },
                }
                for entry in self.selected_effects
            ],
            "unseen": [v.effect.label for v in self.detectability if not v.is_detectable],
            "noise": {
                f.channel: {"std": f.noise_std, "unit": f.unit, "samples": f.n_samples} for f in self.noise_floor
            },
            "baseline": None if self.baseline_comparison is None else _since(self.baseline_comparison),
            "counterfactual": None if self.counterfactual is None else self.counterfactual.to_dict(),
            "seconds": dict(self.stage_seconds),
        }


def threshold_statistics(finding: DiagnosisResult) -> dict[str, Any]:
    """Return the statistics compared with `Thresholds`, JSON-compatible, from which these are calibrated.

    None where a step was not come to.

    Returns
    -------
    dict
        `p_value` and `chi2_per_dof` of the null test (of both residuals together), `largest_channel` (chi2/n of the
        worst channel), `candidate` (p-value of the best, as the best of so many), `evidence` (what unknown forces,
        offsets and biases raise the log evidence by; not where noise that drives the motion is among them), `closure`
        and `closure_low` (held out, of all that was added, accepted or not), `fall` (part of the held-out error that
        they take away), `explained` (over what the smoother explains), `assumptions` (how many), `carried` (standard
        deviations between the values found and those on the held-out recordings, at most), `behind` (of every effect
        that was refitted alone, the held-out chi2/n that it leaves and how far it is behind the first: in held-out
        chi2/n with its standard error, and in r'r of all recordings).
    """
    tests = (finding.nominal_test, finding.nominal_held_out_test)
    apart = [
        abs(entry.estimation_value - entry.held_out_value) / math.hypot(entry.estimation_std, entry.held_out_std)
        for entry in finding.transfer_checks
        if math.hypot(entry.estimation_std, entry.held_out_std) > 0
    ]
    added, seen = finding.selected_effects, finding.smoother_result
    found = {
        "p_value": bonferroni_p_value(tests),
        "chi2_per_dof": max(test.chi2_per_dof for test in tests),
        "largest_channel": max((value for test in tests for value in test.channel_chi2.values()), default=None),
        "candidate": min(1.0, bonferroni_min_p_value(finding.candidate_scores)),
        "evidence": None
        if seen is None or finding.nominal_model.problem.has_process_noise
        else max(seen.log_evidence.values()),
        "closure": finding.gap_closure.fraction if added else None,
        "closure_low": finding.gap_closure.ci_low if added else None,
        "fall": rmse_reduction(finding.nominal_model.held_out_loss, added[-1].refitted_model.held_out_loss)
        if added
        else None,
        "explained": finding.explained_fraction if added else None,
        "assumptions": assumption_count(added),
        "carried": max(apart, default=None),
    }
    said: dict[str, Any] = {name: None if value is None else _number(value) for name, value in found.items()}
    return said | {"behind": _behind(finding.single_effect_models)}


def _behind(fits: Sequence[RefitModel]) -> dict[str, Any]:
    """Return how much worse each refit is than the first, by effect label."""
    found = {}
    for fit in fits:
        lost, error = held_out_improvement(fit.held_out_loss, fits[0].held_out_loss)
        figures = {
            "left": fit.held_out_loss.chi2_per_sample,
            "chi2_per_dof": lost,
            "error": error,
            "squares": penalized_chi2_difference(fit, fits[0]),
        }
        found[fit.effects[-1].label] = {name: _number(value) for name, value in figures.items()}
    return found


def final_model_to_dict(finding: DiagnosisResult) -> dict[str, Any]:
    """Return `model` of result.json: parameters and covariance of the final model."""
    return {"parameters": _parameters(finding), "covariance": _covariance(finding.final_model)}


def _parameters(finding: DiagnosisResult) -> dict[str, dict[str, Any]]:
    """Every parameter of the last model, of tried effects only those that it has: value, std, unit, whether free."""
    fit = finding.final_model
    problem = fit.problem
    idle = {entry.effect.label for entry in finding.detectability} - {effect.label for effect in fit.effects}
    theta, _ = problem.split(problem.vector(fit.values), 0)
    found = {}
    for entry, value in zip(problem.system.parameters, theta, strict=True):
        if entry.name in problem.local_parameters or entry.name.rpartition(".")[0] in idle:
            continue
        free = entry.name in problem.shared_parameters
        std = _number(fit.std[entry.name]) if free else 0.0
        found[entry.name] = {"value": float(value), "std": std, "unit": entry.unit, "free": free}
    return found


def _covariance(fit: RefitModel) -> dict[str, Any]:
    """Names and matrix of what is known of the shared free parameters together; those not known at all left out."""
    problem, shared = fit.problem, fit.problem.shared_parameters
    finish = fit.evaluation
    if finish.jacobian is None:
        finish = problem.evaluate(problem.vector(fit.values), equilibrium_guesses=finish.equilibrium_guesses)
    matrix, _ = covariance_and_chi2(problem, finish)
    std = [fit.std[name] for name in shared]
    return covariance_to_dict(shared, matrix[: len(shared), : len(shared)], std)


def _since(found: BaselineComparison) -> dict[str, Any]:
    return {
        "runs": list(found.baseline_runs),
        "explains": found.is_baseline_explained,
        "effects": list(found.baseline_effects),
        "chi2": found.between_runs_chi2,
        "p_value": found.between_runs_p_value,
        "parameters": {
            entry.name: {
                "before": entry.baseline_value,
                "before_std": entry.baseline_std,
                "now": entry.current_value,
                "now_std": _number(entry.current_std),
                "unit": entry.unit,
                "score": entry.z_score,
                "p_value": entry.p_value,
                "changed": entry.has_changed,
            }
            for entry in found.parameter_shifts
        },
        "changed": [entry.name for entry in found.changed_parameters],
    }


def _state(fit: RefitModel, test: NullTestResult) -> dict[str, Any]:
    return {
        "rmse": {name: value for name, (value, _) in fit.held_out_loss.channel_rmse.items()},
        "unit": {name: unit for name, (_, unit) in fit.held_out_loss.channel_rmse.items()},
        "chi2_per_dof": test.chi2_per_dof,
        "p_value": test.p_value,
    }


def _place(place: GapLocation) -> dict[str, Any]:
    return {
        "location": place.location,
        "share": place.gap_share,
        "observable": place.is_observable,
        "windows": [list(window) for window in place.time_windows],
        "indistinguishable_from": list(place.indistinguishable_from),
    }


def _rejected_candidates(finding: DiagnosisResult) -> list[dict[str, Any]]:
    """Effects that imitate the gap and are not its cause, each with the closure that it reaches and why it is none."""
    if finding.unknown_reason != "stand_in":
        return []
    failed = failed_transfer_checks(finding.transfer_checks)
    listed = []
    for entry in finding.selected_effects:
        own = [check for check in failed if check.effect_label == entry.effect.label] or failed
        listed.append(
            {
                "kind": entry.effect.kind,
                "location": entry.effect.location,
                "closure": _number(entry.cumulative_closure.fraction),
                "reason": "; ".join(check.disagreement for check in own),
            }
        )
    return listed


def _closure(closed: GapClosure) -> dict[str, Any]:
    return {"closure": _number(closed.fraction), "closure_ci": [_number(closed.ci_low), _number(closed.ci_high)]}


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _ranked_candidates(finding: DiagnosisResult) -> list[dict[str, Any]]:
    """Return all candidates ranked: added effects, then other refits by held-out loss, then the rest by score."""
    scores = {score.effect.label: score for score in finding.candidate_scores}
    listed: dict[str, dict[str, Any]] = {}
    entries: list[tuple[EffectBase, RefitModel | None]] = [
        (a.effect, finding.final_model) for a in finding.selected_effects if finding.accepted_effects
    ]
    entries += [(fit.effects[0], fit) for fit in finding.single_effect_models]
    entries += [(score.effect, None) for score in finding.candidate_scores]
    alone = {fit.effects[0].label: fit for fit in finding.single_effect_models}
    for effect, fit in entries:
        if effect.label in listed:
            continue
        score = scores.get(effect.label)
        if fit is None:
            step = {} if score is None else score.predicted_values
            reported = effect.reported_parameters(step)
        else:
            reported = fit.reported_parameters(effect)
        own = alone.get(effect.label)
        closed = None if own is None else gap_closure(finding.nominal_model.held_out_loss, own.held_out_loss)
        listed[effect.label] = {
            "kind": effect.kind,
            "location": effect.location,
            "parameters": {
                name: {"value": _number(r.value), "std": _number(r.std), "unit": r.unit} for name, r in reported.items()
            },
            "score": 0.0 if score is None else score.lm_statistic,
            "p_value": 1.0 if score is None else score.p_value,
            **({"closure": None, "closure_ci": None} if closed is None else _closure(closed)),
        }
    return list(listed.values())

"""The result of a diagnosis, as a dataclass and as `yid-diagnosis/1`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from yid_ocp.diagnosis.baseline import Since
from yid_ocp.diagnosis.carry_over import Carried
from yid_ocp.diagnosis.counterfactual import Counterfactual
from yid_ocp.diagnosis.events import NOTHING, Events
from yid_ocp.diagnosis.hypotheses import Cut
from yid_ocp.diagnosis.localise import Place
from yid_ocp.diagnosis.refit import Fit
from yid_ocp.diagnosis.screening import Confusability, Score, Visibility, best_of
from yid_ocp.diagnosis.select import Added, Closure, behind, closure, fall, gain
from yid_ocp.diagnosis.smoother import Smoothed
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.diagnosis.verdict import Reason, assumptions
from yid_ocp.effects import EffectBase
from yid_ocp.problem.null_test import Floor, NullTest, smallest_p_value
from yid_ocp.shown import Shown, Summary
from yid_ocp.solvers.judgement import known_covariance, uncertainty

FORMAT = "yid-diagnosis/1"


@dataclass(frozen=True)
class Absorbed:
    """Change of a nominal parameter between the nominal model and the model with the effects."""

    name: str
    unit: str
    before: float
    after: float
    std: float


def absorption(before: Fit, after: Fit) -> tuple[Absorbed, ...]:
    """Return how each nominal parameter changes when the effects are added."""
    parameters = before.problem.system.parameters
    return tuple(
        Absorbed(name, parameters[name].unit, before.values[name], after.values[name], after.std[name])
        for name in before.problem.shared
    )


@dataclass(frozen=True, repr=False)
class Finding(Shown):
    """The result of a diagnosis: verdict, gap, locations, effects and the statistics behind them.

    Attributes
    ----------
    verdict : str
        effect, confusable, no_gap, unknown or insufficient_data.
    floor : tuple of Floor
    before, held_out_before : NullTest
        Nominal model, on the recordings to estimate on and on the held-out ones.
    visibility : tuple of Visibility
    confusability : Confusability
    scores : tuple of Score
        First pass, best first.
    smoothed : Smoothed or None
        Unknown forces, offsets and biases about the nominal model; None where there is no gap to locate.
    where : tuple of Place
    nominal : Fit
    fits : tuple of Fit
        Refits of the first round, best first.
    added : tuple of Added
    closure : Closure
    remaining : NullTest
        Held-out, with the effects added.
    remaining_where : tuple of Place
    absorbed : tuple of Absorbed
    next_experiment : str
    held_out : tuple of str
        Names of the recordings.
    in_blocks : bool
        Whether one recording was split in blocks.
    message : str
        Why the data are insufficient; empty if they suffice.
    limits : Thresholds
        Thresholds of the decision.
    seconds : dict of stage to float
    since : Since or None
        Parameter changes since the baseline; None without one.
    counterfactual : Counterfactual or None
        Predictions with the effects removed and added; None without effects or reference recordings.
    summary : str
        Summary text; see `words.sentences`.
    cuts : tuple of Cut
        Held-out recordings that the nominal model cannot follow to their end.
    reason : str
        Why the verdict is unknown; see `verdict.Reason`.
    explained : float
        What the effects explain over what unknown forces, offsets and biases explain.
    carried : tuple of Carried
        The effects' amplitudes on the held-out recordings.
    events : Events
        Taken out of the recordings before the rest was judged, as far as that can be done.
    """

    verdict: str
    floor: tuple[Floor, ...]
    before: NullTest
    held_out_before: NullTest
    visibility: tuple[Visibility, ...]
    confusability: Confusability
    scores: tuple[Score, ...]
    smoothed: Smoothed | None
    where: tuple[Place, ...]
    nominal: Fit
    fits: tuple[Fit, ...]
    added: tuple[Added, ...]
    closure: Closure
    remaining: NullTest
    remaining_where: tuple[Place, ...]
    absorbed: tuple[Absorbed, ...]
    next_experiment: str
    held_out: tuple[str, ...]
    in_blocks: bool
    message: str
    limits: Thresholds
    seconds: Mapping[str, float]
    since: Since | None = None
    counterfactual: Counterfactual | None = None
    summary: str = ""
    cuts: tuple[Cut, ...] = ()
    reason: Reason = ""
    explained: float = 1.0
    carried: tuple[Carried, ...] = ()
    events: Events = NOTHING

    def _summary(self) -> Summary:
        effects, closed = ", ".join(effect.label for effect in self.effects), self.closure.value
        said = f"{100 * closed:.3g} % of the held-out gap closed" if effects and math.isfinite(closed) else ""
        rows = [("candidate", "parameters", "closure alone", "p")]
        for entry in which(self)[:8]:
            values = {name: own for name, own in entry["parameters"].items() if own["value"] is not None}
            known = ", ".join(f"{name} = {own['value']:.3g} {own['unit']}" for name, own in values.items())
            alone = "" if entry["closure"] is None else f"{100 * entry['closure']:.3g} %"
            rows.append((f"{entry['kind']}@{entry['location']}", known, alone, f"{entry['p_value']:.2g}"))
        return Summary(", ".join(filter(None, (self.verdict.replace("_", " "), effects, said))), rows)

    @property
    def effects(self) -> tuple[EffectBase, ...]:
        """Effects accepted by the verdict, in the order they were added; empty unless effect or confusable."""
        return tuple(entry.effect for entry in self.added) if self.verdict in ("effect", "confusable") else ()

    @property
    def last(self) -> Fit:
        """The model with all accepted effects; the nominal model if there are none."""
        return self.added[-1].fit if self.effects else self.nominal

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `yid-diagnosis/1`, JSON-compatible."""
        return {
            "format": FORMAT,
            "verdict": self.verdict,
            "gap": {
                "before": _state(self.nominal, self.held_out_before),
                "after": _state(self.last, self.remaining),
                "closure": _number(self.closure.value) if self.effects else None,
                "closure_ci": [_number(self.closure.low), _number(self.closure.high)] if self.effects else None,
                "held_out": list(self.held_out),
                "cut": [{"recording": c.recording, "kept": c.kept, "whole": c.whole} for c in self.cuts],
            },
            "where": [_place(p) for p in self.where],
            "which": which(self),
            "effects": [{"kind": e.kind, "location": e.location} for e in self.effects],
            "remaining": {"p_value": self.remaining.p_value, "where": [_place(p) for p in self.remaining_where]},
            "reason": self.reason,
            "stand_ins": [
                {"kind": e.effect.kind, "location": e.effect.location}
                for e in (self.added if self.reason == "stand_in" else ())
            ],
            "carried_over": [
                {
                    "effect": c.effect,
                    "parameter": c.name,
                    "value": c.value,
                    "std": _number(c.std),
                    "again": c.again,
                    "again_std": _number(c.again_std),
                    "unit": c.unit,
                    "agrees": c.agrees,
                }
                for c in self.carried
            ],
            "confusable": [
                [{"kind": e.kind, "location": e.location} for e in entry.rivals]
                for entry in self.added
                if self.effects and len(entry.rivals) > 1
            ],
            "events": [event.to_dict() for event in self.events.found],
            "not_judged": [{"recording": f.recording, "joint": f.joint, "from": f.time} for f in self.events.falls],
            "next_experiment": self.next_experiment,
            "side": None if self.smoothed is None else self.smoothed.side,
            "evidence": {} if self.smoothed is None else dict(self.smoothed.evidence),
            "explainable": None if self.smoothed is None else self.smoothed.explainable,
            "statistics": statistics(self),
            "summary": self.summary,
            "message": self.message,
            "held_out_in_blocks": self.in_blocks,
            "absorption": {
                a.name: {"before": a.before, "after": a.after, "std": _number(a.std), "unit": a.unit}
                for a in self.absorbed
            },
            "steps": [
                {
                    "added": entry.effect.label,
                    "closure": _number(entry.closure.value),
                    "closure_ci": [_number(entry.closure.low), _number(entry.closure.high)],
                    "chi2_per_dof": entry.fit.loss.mean,
                    "rmse": {name: value for name, (value, _) in entry.fit.loss.channels.items()},
                }
                for entry in self.added
            ],
            "unseen": [v.effect.label for v in self.visibility if not v.visible],
            "noise": {f.channel: {"std": f.std, "unit": f.unit, "samples": f.samples} for f in self.floor},
            "baseline": None if self.since is None else _since(self.since),
            "counterfactual": None if self.counterfactual is None else self.counterfactual.to_dict(),
            "seconds": dict(self.seconds),
        }


def statistics(finding: Finding) -> dict[str, Any]:
    """Return the statistics compared with `Thresholds`, JSON-compatible, from which these are calibrated.

    None where a step was not come to.

    Parameters
    ----------
    finding : Finding

    Returns
    -------
    dict
        `p_value` and `chi2_per_dof` of the null test (of both residuals together), `largest_channel` (chi2/n of the
        worst channel), `candidate` (p-value of the best, as the best of so many), `evidence` (what unknown forces,
        offsets and biases raise the log evidence by; not where noise that drives the motion is among them), `closure`
        and `closure_low` (held out, of all that was added, accepted or not), `fall` (part of the held-out error that
        they take away), `explained` (over what the smoother explains), `assumptions`, `carried` (standard deviations
        between the values found and those on the held-out recordings, at most), `behind` (of every effect that was
        refitted alone, the held-out chi2/n that it leaves and how far it is behind the first: in held-out chi2/n with
        its standard error, and in r'r of all recordings).
    """
    tests = (finding.before, finding.held_out_before)
    apart = [
        abs(entry.value - entry.again) / math.hypot(entry.std, entry.again_std)
        for entry in finding.carried
        if math.hypot(entry.std, entry.again_std) > 0
    ]
    added, seen = finding.added, finding.smoothed
    found = {
        "p_value": smallest_p_value(tests),
        "chi2_per_dof": max(test.chi2_per_dof for test in tests),
        "largest_channel": max((value for test in tests for value in test.channels.values()), default=None),
        "candidate": min(1.0, best_of(finding.scores)),
        "evidence": None if seen is None or finding.nominal.problem.disturbed else max(seen.evidence.values()),
        "closure": finding.closure.value if added else None,
        "closure_low": finding.closure.low if added else None,
        "fall": fall(finding.nominal.loss, added[-1].fit.loss) if added else None,
        "explained": finding.explained if added else None,
        "assumptions": assumptions(added),
        "carried": max(apart, default=None),
    }
    said: dict[str, Any] = {name: None if value is None else _number(value) for name, value in found.items()}
    return said | {"behind": _behind(finding.fits)}


def _behind(fits: Sequence[Fit]) -> dict[str, Any]:
    """Return how much worse each refit is than the first, by effect label."""
    found = {}
    for fit in fits:
        lost, error = gain(fit.loss, fits[0].loss)
        figures = {
            "left": fit.loss.mean,
            "chi2_per_dof": lost,
            "error": error,
            "squares": behind(fit, fits[0]),
        }
        found[fit.effects[-1].label] = {name: _number(value) for name, value in figures.items()}
    return found


def model_result(finding: Finding) -> dict[str, Any]:
    """Return `model` of result.json: parameters and covariance of the final model."""
    return {"parameters": _parameters(finding), "covariance": _covariance(finding.last)}


def _parameters(finding: Finding) -> dict[str, dict[str, Any]]:
    """Every parameter of the last model, of tried effects only those that it has: value, std, unit, whether free."""
    fit = finding.last
    problem = fit.problem
    idle = {entry.effect.label for entry in finding.visibility} - {effect.label for effect in fit.effects}
    theta, _ = problem.split(problem.vector(fit.values), 0)
    found = {}
    for entry, value in zip(problem.system.parameters, theta, strict=True):
        if entry.name in problem.local or entry.name.rpartition(".")[0] in idle:
            continue
        free = entry.name in problem.shared
        std = _number(fit.std[entry.name]) if free else 0.0
        found[entry.name] = {"value": float(value), "std": std, "unit": entry.unit, "free": free}
    return found


def _covariance(fit: Fit) -> dict[str, Any]:
    """Names and matrix of what is known of the shared free parameters together; those not known at all left out."""
    problem, shared = fit.problem, fit.problem.shared
    finish = fit.evaluation
    if finish.jacobian is None:
        finish = problem.evaluate(problem.vector(fit.values), warm=finish.warm)
    matrix, _ = uncertainty(problem, finish)
    std = [fit.std[name] for name in shared]
    return known_covariance(shared, matrix[: len(shared), : len(shared)], std)


def _since(found: Since) -> dict[str, Any]:
    return {
        "runs": list(found.runs),
        "explains": found.explains,
        "effects": list(found.effects),
        "chi2": found.chi2,
        "p_value": found.p_value,
        "parameters": {
            entry.name: {
                "before": entry.before,
                "before_std": entry.before_std,
                "now": entry.now,
                "now_std": _number(entry.now_std),
                "unit": entry.unit,
                "score": entry.score,
                "p_value": entry.p_value,
                "changed": entry.changed,
            }
            for entry in found.parameters
        },
        "changed": [entry.name for entry in found.changed],
    }


def _state(fit: Fit, test: NullTest) -> dict[str, Any]:
    return {
        "rmse": {name: value for name, (value, _) in fit.loss.channels.items()},
        "unit": {name: unit for name, (_, unit) in fit.loss.channels.items()},
        "chi2_per_dof": test.chi2_per_dof,
        "p_value": test.p_value,
    }


def _place(place: Place) -> dict[str, Any]:
    return {
        "location": place.location,
        "share": place.share,
        "observable": place.observable,
        "windows": [list(window) for window in place.windows],
        "also": list(place.also),
    }


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def which(finding: Finding) -> list[dict[str, Any]]:
    """Return all candidates ranked: added effects, then other refits by held-out loss, then the rest by score."""
    scores = {score.effect.label: score for score in finding.scores}
    listed: dict[str, dict[str, Any]] = {}
    entries: list[tuple[EffectBase, Fit | None]] = [(a.effect, finding.last) for a in finding.added if finding.effects]
    entries += [(fit.effects[0], fit) for fit in finding.fits]
    entries += [(score.effect, None) for score in finding.scores]
    alone = {fit.effects[0].label: fit for fit in finding.fits}
    for effect, fit in entries:
        if effect.label in listed:
            continue
        score = scores.get(effect.label)
        if fit is None:
            step = {} if score is None else score.step
            reported = effect.reported(step)
        else:
            reported = fit.reported(effect)
        own = alone.get(effect.label)
        closed = None if own is None else closure(finding.nominal.loss, own.loss)
        listed[effect.label] = {
            "kind": effect.kind,
            "location": effect.location,
            "parameters": {
                name: {"value": _number(r.value), "std": _number(r.std), "unit": r.unit} for name, r in reported.items()
            },
            "score": 0.0 if score is None else score.statistic,
            "p_value": 1.0 if score is None else score.p_value,
            "closure": None if closed is None else _number(closed.value),
            "closure_ci": None if closed is None else [_number(closed.low), _number(closed.high)],
        }
    return list(listed.values())

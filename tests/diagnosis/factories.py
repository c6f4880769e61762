"""Small made-up inputs of the rules of a diagnosis. Nothing is rolled out, and every constructor is called here."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy
from made_series import seeing

from yid_ocp.diagnosis import screening as module
from yid_ocp.diagnosis.diagnosis_result import DiagnosisResult
from yid_ocp.diagnosis.refit import RefittedModel
from yid_ocp.diagnosis.screening import (
    EMPTY_SCREENING_RESULT,
    CandidateDetectability,
    ScoreTestResult,
    ScreeningResult,
    _EffectSignature,
)
from yid_ocp.diagnosis.select import SelectedEffect
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.effects.base import EffectBase, ParameterDefinition
from yid_ocp.inference.null_test import HeldOutGapClosure, HeldOutLoss, NullTestResult
from yid_ocp.inference.smoother import GapLocation, SmoothedDisturbances, SmoothedUnknownsResult
from yid_ocp.inference.smoother_model import SmoothedUnknownGroup
from yid_ocp.model.parameters import Parameter, Parameters
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.problem.measurements import SensorMeasurements


def cases(names: str, rows: Mapping[str, object]):
    """Parametrise a test by a table of named rows."""
    return pytest.mark.parametrize(names, list(rows.values()), ids=list(rows))


class Local(EffectBase):
    """One that says nothing of other places."""

    is_local = True


def amplitude(name="a", neutral=0.0, lower=0.0, upper=math.inf, expected=(0.0, 1.0), unit="N m"):
    """A quantity whose neutral value alone makes the effect vanish."""
    return ParameterDefinition(name, unit, neutral, lower, upper, expected, "made up")


def shape(name="s", neutral=0.5, expected=(0.1, 1.0), lower=0.0, upper=math.inf):
    """A quantity that says nothing while the amplitudes are neutral."""
    return ParameterDefinition(name, "s", neutral, lower, upper, expected, "made up", is_shape_parameter=True)


def effect(label="friction@elbow", *quantities: ParameterDefinition, alone=False) -> EffectBase:
    """An effect `kind@location` with some quantities, one amplitude where none are given."""
    kind, _, location = label.partition("@")
    chosen = quantities or (amplitude(),)
    entries = (Parameter(f"{label}.{q.name}", q.neutral_value, q.unit, q.lower, q.upper, q.description) for q in chosen)
    return (Local if alone else EffectBase)(kind, location, Parameters(entries), definitions=tuple(chosen))


def outcome(p=0.5, chi2=1.0, degrees=100.0, windows=()) -> NullTestResult:
    """The outcome of a null test."""
    return NullTestResult(chi2, degrees, p, tuple(windows))


def signature(of: EffectBase, columns, noise=None, priors=0.0, changes=None, **shapes: float) -> _EffectSignature:
    """A signature; its noise is white unless given, and no stated priors contribute."""
    columns = np.asarray(columns, float)
    columns = columns[:, None] if columns.ndim == 1 else columns
    noise = columns.T @ columns if noise is None else np.atleast_2d(np.asarray(noise, float))
    named = {f"{of.label}.{name}": value for name, value in shapes.items()}
    made = (columns, noise, priors * np.ones_like(noise), np.zeros(len(noise)), changes or {})
    return _EffectSignature(of, named, *made)


def point(residual, *signatures: _EffectSignature):
    """What `linearize_candidates` returns."""
    return np.asarray(residual, float), list(signatures)


def screened(at, channels=(), detectable_at=module.DETECTABLE_AMPLITUDE_Z) -> ScreeningResult:
    """What screening says of a linearisation, with residuals in channels; detectable at so many standard deviations."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "linearize_candidates", lambda *_: at)
        patch.setattr(module, "channels_with_residual_indices", lambda _: channels)
        patch.setattr(module, "DETECTABLE_AMPLITUDE_Z", detectable_at)
        return module.screen_candidates(SimpleNamespace(problem=None), (), {})


def score(of: EffectBase, p=0.5, decrease=1.0, statistic=1.0, step=None) -> ScoreTestResult:
    values = dict.fromkeys(of.amplitude_parameter_names, 0.1) if step is None else dict(step)
    return ScoreTestResult(of, values, decrease, statistic, p)


def visible(of: EffectBase, seen=True, detectable=0.1, **hidden: float) -> CandidateDetectability:
    return CandidateDetectability(of, dict.fromkeys(of.amplitude_parameter_names, detectable), seen, hidden)


def alike(labels: Sequence[str], matrix) -> ScreeningResult:
    """Candidates without scores, and how far they explain each other."""
    return screening(seen=[visible(effect(label)) for label in labels], table=np.asarray(matrix, float))


def screening(scores=(), seen=None, table=None) -> ScreeningResult:
    """Candidates that are seen and like no other, unless said."""
    seen = [visible(entry.effect) for entry in scores] if seen is None else seen
    table, seen = np.eye(len(seen)) if table is None else table, tuple(seen)
    return replace(EMPTY_SCREENING_RESULT, detectability=seen, candidate_scores=tuple(scores), overlap_fractions=table)


def loss(*means: float, count=100.0, channels=None) -> HeldOutLoss:
    """A held-out loss with these chi2/n in its blocks, all with as many samples."""
    counts = np.full(len(means), float(count))
    squares = counts * np.asarray(means, float)
    return HeldOutLoss(squares, counts, channels or {"points.tip": (0.01, "m")}, float(squares.sum()))


def evaluation(residual, jacobian=None, ok=True, message="") -> Evaluation:
    residual = np.asarray(residual, float)
    jacobian = None if jacobian is None else np.asarray(jacobian, float)
    return Evaluation(0.5 * float(residual @ residual) if ok else math.inf, residual, jacobian, ok, message, ())


def costing(cost: float, rows: int) -> Evaluation:
    """An evaluation of this cost, however its residual looks."""
    return replace(evaluation(np.zeros(rows)), cost=cost)


def problem_of(*names: str) -> SimpleNamespace:
    """The part of a problem that a result uses; its free parameters [N m/rad] have these names."""
    parameters = {name: SimpleNamespace(unit="N m/rad", lower=0.0, upper=9.0) for name in names}
    system = SimpleNamespace(parameters=parameters, mechanism=SimpleNamespace(frames={"tip": None}))
    options = SimpleNamespace(divided_links_model=None)
    rows, rest = SimpleNamespace(data=slice(0, 1), stated_priors=slice(1, 1)), {"system": system, "options": options}
    return SimpleNamespace(has_process_noise=False, shared_parameters=names, held_out=(), residual_rows=rows, **rest)


def fit(effects=(), lost=None, cost=1.0, values=None, std=None, problem=None, held=None) -> RefittedModel:
    """A refitted model; values are neutral unless given. `held`: std of amplitudes with shapes held, if others."""
    neutral = {name: value for entry in effects for name, value in entry.neutral_values.items()}
    values = neutral | dict(values or {})
    std = dict.fromkeys(values, 0.01) | dict(std or {})
    held = std | dict(held or {})
    sizes = {
        e.label: [(values[n] - neutral[n]) / (held[n] or 1e-9) for n in e.amplitude_parameter_names] for e in effects
    }
    p_values = {label: float(scipy.special.chdtrc(len(z), np.square(z).sum())) for label, z in sizes.items()}
    if problem is None:
        problem = SimpleNamespace(**vars(problem_of()), unknown_names=tuple(values))
    end = evaluation([1.0], np.ones((1, len(values))))
    rest = (tuple(effects), cost, loss(1.0, 1.0) if lost is None else lost, 1, problem, end)
    return RefittedModel(values, std, p_values, *rest)


def closed(value=0.9, low=0.8, high=0.95) -> HeldOutGapClosure:
    return HeldOutGapClosure(value, low, high)


def added(of: EffectBase, rivals: Sequence[EffectBase] = (), fitted=None, part=None) -> SelectedEffect:
    """An effect that was added; it is the first of its rivals."""
    fitted = fitted or fit([of], values=dict.fromkeys(of.amplitude_parameter_names, 0.5))
    return SelectedEffect(
        of, fitted, part or closed(), (of, *rivals), dict.fromkeys([r.label for r in rivals], 0.0) | {of.label: 1.0}
    )


def carried(*effects: EffectBase) -> dict[str, list[str]]:
    """The amplitude of each effect on the recordings to estimate on and on the held-out ones."""
    both = "0.5 ± 0.01 N m on the fitted recordings and 0.9 ± 0.02 N m on the held-out ones"
    return {of.label: [f"{of.label}.a is {both}"] for of in effects}


FORCE, OTHER_FORCE = SmoothedUnknownGroup("T1", "force"), SmoothedUnknownGroup("T2", "force")
READ_FORCE, BIAS = SmoothedUnknownGroup("elbow", "force", True), SmoothedUnknownGroup("camera", "bias")
OFFSET = SmoothedUnknownGroup("left", "offset")


def trace(sources: Sequence[SmoothedUnknownGroup], mean, std, recording="run") -> SmoothedDisturbances:
    """Unknowns of a recording, one column each, over intervals of half a second."""
    mean, std = np.asarray(mean, float), np.asarray(std, float)
    edges = 0.5 * np.arange(len(mean) + 1)
    names = tuple(f"{source.location}.{i}" for i, source in enumerate(sources))
    return SmoothedDisturbances(recording, edges, names, tuple(sources), np.ones(len(sources)), mean, std)


def smoothed(
    weight: Mapping[SmoothedUnknownGroup, float],
    *,
    evidence=None,
    variance=None,
    detectable=None,
    traces=(),
    chi2=(200.0, 100.0),
    degrees=(100.0, 90.0),
) -> SmoothedUnknownsResult:
    """What the smoother says."""
    return SmoothedUnknownsResult(
        smoothed_unknowns=tuple(traces),
        group_variance={s: float(w > 0) for s, w in weight.items()} if variance is None else dict(variance),
        log_evidence_drop=dict(weight),
        detectable_std=dict.fromkeys(weight, 0.5) if detectable is None else dict(detectable),
        **dict(zip(("chi2_before", "chi2_after", "dof_before", "dof_after"), (*chi2, *degrees), strict=True)),
        log_evidence=dict.fromkeys(("none", "both", "plant", "sensor"), 0.0) | dict(evidence or {}),
    )


def place(location="T1", share=1.0, observable=True, windows=()) -> GapLocation:
    return GapLocation(location, share, observable, tuple(windows))


def absorbing(of: EffectBase, std=0.1, **moved: tuple[float, float]) -> dict:
    """What a finding has if parameters [N m/rad], with values before and after, absorb an effect."""
    first = {name: own[0] for name, own in moved.items()}
    last = {name: own[1] for name, own in moved.items()} | {f"{of.label}.a": 0.5}
    fitted = fit([of], loss(1.0, 1.1), values=last, std=dict.fromkeys(moved, std))
    nominal = fit(lost=loss(2.0, 2.2), values=first, problem=problem_of(*moved))
    return {"nominal_model": nominal, "selected_effects": (added(of, fitted=fitted),)}


def finding(verdict="effect", **changed) -> DiagnosisResult:
    """A finding; everything that is not named is unremarkable."""
    of = effect()
    alone = fit([of], loss(1.0, 1.1), values={f"{of.label}.a": 0.5})
    usual = {
        "verdict": verdict,
        "noise_floor": {"points.tip": 0.001},
        "nominal_test": outcome(p=0.3, chi2=1.02) if verdict == "no_gap" else outcome(p=1e-9, chi2=2.0),
        "nominal_held_out_test": outcome(p=0.6, chi2=0.99) if verdict == "no_gap" else outcome(p=1e-8, chi2=2.1),
        "screening": screening([score(of, p=0.3 if verdict == "no_gap" else 1e-9, decrease=100.0, statistic=40.0)]),
        "explained_fraction": 1.0,
        "probability": 0.9,
        "transfer_texts": {},
        "rival_shifts": (),
        "rival_probability": 0.0,
        "smoother_result": smoothed({FORCE: 9.0, BIAS: 9.0}, evidence={"plant": 9.0, "sensor": 9.0, "both": 20.0}),
        "gap_locations": (place(),),
        "nominal_model": fit(lost=loss(2.0, 2.2)),
        "single_effect_models": (alone,),
        "selected_effects": (added(of, fitted=alone),),
        "gap_closure": None,  # by all effects, if not what the last one has
        "remaining_test": outcome(p=1e-8, chi2=2.1) if verdict == "unknown" else outcome(p=0.4, chi2=1.02),
        "remaining_gap_locations": (),
        "next_experiment": "Repeat.",
        "is_split_in_blocks": False,
        "thresholds": Thresholds(),
        "stage_seconds": {"nominal_model": 1.0},
        "unknown_reason": "none" if verdict == "unknown" else "",
    }
    found = usual | changed
    if total := found.pop("gap_closure"):
        last = [replace(entry, cumulative_closure=total) for entry in found["selected_effects"][-1:]]
        found["selected_effects"] = (*found["selected_effects"][:-1], *last)
    return DiagnosisResult(**found)


def measurements(channels, node, fraction, value, weight, span=(0, 100), **sensor) -> SensorMeasurements:
    """Samples of unit noise on nodes."""
    value, weight = np.asarray(value, float), np.asarray(weight, float)
    made = seeing(channels, **sensor)
    rest = (weight, np.ones(value.shape), span, np.zeros(value.shape[1]))
    return SensorMeasurements(made, np.asarray(node), np.asarray(fraction, float), value, *rest)

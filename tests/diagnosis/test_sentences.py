"""What a diagnosis says: every sentence in `sentences.json`, one text for each case.

After a change that is meant `PYTHONPATH=.:tests:tests/diagnosis python tests/diagnosis/test_sentences.py` writes the
file again; its difference is to be read.
"""

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from factories import (
    BIAS,
    FORCE,
    READ_FORCE,
    absorbing,
    added,
    amplitude,
    carried,
    closed,
    effect,
    evaluation,
    finding,
    fit,
    loss,
    outcome,
    place,
    problem_of,
    score,
    screening,
    smoothed,
    visible,
)
from hypothesis import given
from hypothesis import strategies as st
from sound_findings import assert_nothing_impossible_is_said

from yid_ocp.diagnosis.baseline import (
    CounterfactualPredictionErrors,
    ParameterShift,
    ParameterShiftsSinceBaseline,
    _PredictionErrors,
)
from yid_ocp.diagnosis.events import EventSet, ForceOrFaultEvent, _Overspeed
from yid_ocp.diagnosis.hypotheses import HeldOutTruncation
from yid_ocp.diagnosis.sentences import diagnosis_summary_text, next_step_texts, recommended_experiment_text
from yid_ocp.diagnosis.thresholds import NEED_TEST, Thresholds
from yid_ocp.effects import EFFECTS, EffectBase
from yid_ocp.effects.friction import EFFECT_KINDS_BY_FRICTION_LAW

FILE = Path(__file__).with_name("sentences.json")
FRICTION, OFFSET = effect("friction@elbow"), effect("offset@wrist", amplitude(lower=-9.0))
SPEED, ACCELERATION, GRAVITY = "the speed", "the acceleration", "the orientation to gravity"
REASONS = ("little", "stand_in")
STEPS = {"stated_and_used_time_step": (0.01, 0.01)}
NO_EFFECT = {"selected_effects": (), "single_effect_models": ()}


def with_effect(of, value, std=0.02, **changed):
    """A finding in which this effect was added."""
    names = of.amplitude_parameter_names
    fitted = fit([of], loss(1.0, 1.1), values=dict.fromkeys(names, value), std=dict.fromkeys(names, std))
    return finding(**({"selected_effects": (added(of, fitted=fitted),), "single_effect_models": (fitted,)} | changed))


def gaps():
    """Whether there is a gap, by the smaller of two p-values."""
    for verdict, *p in [
        ("unknown", 1e-5, 0.5), ("unknown", 0.5, 2e-6), ("unknown", 1e-12, 0.5), ("unknown", 1.1e-12, 0.5),
        ("no_gap", 0.4, 0.3), ("no_gap", 0.2, 0.3),
    ]:  # fmt: skip
        tests = {"nominal_test": outcome(p[0], chi2=1.123), "nominal_held_out_test": outcome(p[1], chi2=2.345)}
        yield f"{verdict}, p = {p[0]:g} and {p[1]:g}", finding(verdict, **tests, **NO_EFFECT)
    for degrees, seen in ((11.6, ()), (11.6, (False,)), (4.6, (True, False))):
        few = {"nominal_test": outcome(degrees=degrees), "nominal_model": fit(values=dict.fromkeys("abcde", 1.0))}
        hidden = {"screening": screening(seen=[visible(FRICTION, own) for own in seen])}
        yield f"insufficient data, {degrees} {seen}", finding("insufficient_data", **few, **hidden, **NO_EFFECT)
    for p, size in ((1e-9, 1.05), (1e-3, 1.15), (0.006, 1.15)):
        tests = {"nominal_test": outcome(p, chi2=size), "nominal_held_out_test": outcome(0.5, chi2=0.99)}
        seen = {"screening": screening([score(FRICTION, p=1e-6 if size < 1.1 else 1e-3)])}
        yield f"no gap, p = {p} and chi2 {size}", finding("no_gap", **tests, **seen, **NO_EFFECT)
    quiet = {"nominal_test": outcome(0.2, chi2=1.02), "nominal_held_out_test": outcome(0.6, chi2=0.989)}
    yield "along a candidate alone", finding(**quiet)
    own = problem_of("k", "damping", "weak", "tip.x")
    known = fit(values={"k": 2.0, "damping": 5.0, "weak": 0.02, "tip.x": 0.1}, problem=own)
    seen = [visible(FRICTION, k=0.21, damping=0.4), visible(OFFSET, k=0.5, weak=9.0, damping=0.51, **{"tip.x": 9.0})]
    yield "no gap, hidden changes", finding("no_gap", nominal_model=known, screening=screening(seen=seen), **NO_EFFECT)
    yield "no gap", finding("no_gap", next_experiment="None is needed for these motions.", **NO_EFFECT)


def places():
    """Where it lies, and on which side."""
    for shares in [
        {"T1": 0.95, "T2": 0.05}, {"T1": 0.8, "T2": 0.2}, {"T1": 0.9, "T2": 0.1},
        {"T1": 0.4, "T2": 0.25, "T3": 0.2, "T4": 0.15}, {"T1": 0.06, "T2": 0.05}, {}, {"T1": 0.0}, {"T1": 0.004},
    ]:  # fmt: skip
        where = tuple(place(name, share) for name, share in shares.items())
        yield f"shares {shares}", finding("unknown", gap_locations=where, **NO_EFFECT)
    together = replace(place("T3"), indistinguishable_from=("T1", "T2"))
    yield "places that cannot be told apart", finding(gap_locations=(together,))
    for name, weight, evidence in [
        ("mechanics", {FORCE: 9.0}, {"plant": 9.0, "both": 9.0}),
        ("sensors", {BIAS: 9.0}, {"sensor": 9.0, "both": 9.0}),
        ("mechanics or sensor", {READ_FORCE: 9.0}, {"plant": 9.0, "both": 9.0}),
        ("both", {FORCE: 9.0, BIAS: 9.0}, {"plant": 9.0, "sensor": 9.0, "both": 20.0}),
    ]:
        found = {"smoother_result": smoothed(weight, evidence=evidence), **NO_EFFECT}
        yield f"side: {name}", finding("unknown", **found)
        yield f"side: {name}, at a camera", finding("unknown", gap_locations=(place("camera"),), **found)


def effects():
    """What was added, how sure it is, what it closes and what is left."""
    for unit, std in [("N m", 0.0234), ("1", 2.34e-6), ("N m", math.inf), ("N m", math.nan)]:
        yield f"a = 0.457, std {std} {unit}", with_effect(effect("friction@elbow", amplitude(unit=unit)), 0.456789, std)
    yield "closure", with_effect(FRICTION, 0.5, gap_closure=closed(0.9123, 0.8012, 0.9534))
    yield "no sure closure", with_effect(FRICTION, 0.5, gap_closure=closed(0.9, -0.01, 0.95))
    both = fit([FRICTION, OFFSET], values={"friction@elbow.a": 0.5, "offset@wrist.a": 0.25})
    yield "two effects", finding(selected_effects=(added(FRICTION), added(OFFSET, fitted=both)))
    rivals = (added(FRICTION, [OFFSET, effect("third@x")]),)
    yield "rivals", with_effect(FRICTION, 0.5, selected_effects=rivals)
    odd = effect("offset@wrist", amplitude(neutral=9.0, lower=-99.0, upper=99.0, expected=(0.0, 2.0)))
    for value in (4.03, 4.05, -2.03, -2.05, 9.0):
        yield f"range 0 to 2, value {value}", with_effect(odd, value)
    for chi2, p, where in [
        (1.23, 0.002, (place("T2"),)), (1.23, 0.002, ()), (1.23, 0.02, ()), (1.23, 0.01, ()),
    ]:  # fmt: skip
        rest = {"remaining_test": outcome(p=p, chi2=chi2), "remaining_gap_locations": where}
        yield f"remains chi2 {chi2}, p = {p}, {len(where)} places", with_effect(FRICTION, 0.5, **rest)
    for before, after in [(10.0, 11.1), (10.0, 8.9), (10.0, 11.0), (-10.0, -8.9), (0.0, 1e-9), (0.0, 1e-11)]:
        yield f"moves from {before} to {after}", finding(**absorbing(FRICTION, **{"T1.bend": (before, after)}))
    yield "eight parameters move", finding(**absorbing(FRICTION, **{f"p{i}": (1.0, 2.0) for i in range(8)}))
    yield "in blocks", with_effect(FRICTION, 0.5, is_split_in_blocks=True)


def unknown():
    """Why a gap has no name, with the numbers that decide it."""
    sizes = {"friction@elbow.a": 0.5, "offset@wrist.a": 0.25}
    both = fit([FRICTION, OFFSET], values=sizes, std={"offset@wrist.a": 0.2})
    unsure = (added(FRICTION, fitted=fit([FRICTION], values={"friction@elbow.a": 0.5}, std={"friction@elbow.a": 0.3})),)
    for name, reason, changed in [
        ("little explained", "little", {"explained_fraction": 0.31, "gap_closure": closed(0.4, 0.29, 0.5)}),
        ("imitates", "stand_in", {"selected_effects": unsure, "transfer_texts": carried(FRICTION)}),
        ("of a size that is not known", "stand_in", {"selected_effects": unsure}),
        *((f"two effects, {reason}", reason, {
            "selected_effects": (added(FRICTION), added(OFFSET, fitted=both)),
            "explained_fraction": 0.31, "gap_closure": closed(0.4, 0.01, 0.7), "transfer_texts": carried(OFFSET),
        }) for reason in REASONS),
    ]:  # fmt: skip
        limits = Thresholds(min_explained_fraction=0.5)
        yield name, finding("unknown", unknown_reason=reason, thresholds=limits, **changed)
    for reason in REASONS:
        none = {"gap_closure": closed(math.nan, math.nan, math.nan), "transfer_texts": carried(FRICTION)}
        none |= {"selected_effects": unsure if reason == "stand_in" else (added(FRICTION),)}
        none |= {"nominal_held_out_test": outcome(), "remaining_test": outcome(), "explained_fraction": 0.31}
        yield f"no held-out gap, {reason}", finding("unknown", unknown_reason=reason, **none)
    joints = [effect(f"friction@{name}") for name in ("elbow", "wrist", "waist")]
    for of, p_values in (("two joints", (1e-9, 3e-5, 4e-5)), ("one joint", (1e-9, 4e-5, 4e-5))):
        seen = screening([score(own, p=p) for own, p in zip(joints, p_values, strict=True)])
        few = {"explained_fraction": 0.31, "gap_closure": closed(0.4, 0.29, 0.5)}
        yield f"significant at {of}", finding("unknown", unknown_reason="little", screening=seen, **few)
    hurried = {"thresholds": Thresholds(budget=12.5), "untried": tuple(f"{kind}@x" for kind in "abcdefghij")}
    yield "stopped before any refit", finding("unknown", **hurried, **NO_EFFECT)
    yield (
        "stopped with an effect",
        with_effect(FRICTION, 0.5, **hurried | {"untried": ("further effects beside a@x",)}),
    )
    yield "need not tested", with_effect(FRICTION, 0.5, **hurried | {"untried": (NEED_TEST,)})
    yield "improbable", finding(**absorbing(FRICTION, **{"T1.bend": (1.0, 9.0)}), probability=0.49)
    rivals = {"selected_effects": (added(FRICTION, [OFFSET, joints[1]]),), "untried": (OFFSET.label,)}
    yield "stopped beside a probable cause", finding("confusable", **hurried | rivals)
    best = {"single_effect_models": (fit([OFFSET]), fit([FRICTION])), "selected_effects": ()}
    yield "the best attempt", finding("unknown", **best)
    for kept in (1.8, 0.0):
        cut = (HeldOutTruncation("other", kept, 5.0),)
        yield f"followed for {kept} s", finding(truncated_recordings=cut, **STEPS)
    yield "a finer step", finding("no_gap", stated_and_used_time_step=(0.01, 0.005))
    lost = (HeldOutTruncation("other", 0.0, 5.0),)
    yield "none can be followed", finding(truncated_recordings=lost, is_split_in_blocks=True, **STEPS)


def compared():
    """What changed since a baseline, and what the effects predict elsewhere."""
    for name, (moved, shared, is_explained) in {
        "nothing changed": (False, 0.5, True), "one changed": (True, 0.5, True), "runs differ": (True, 1e-3, False),
    }.items():  # fmt: skip
        shift = ParameterShift("T1.bend", "N m/rad", 10.0, 0.1, 12.0, 0.2, 9.0, moved)
        earlier = ParameterShiftsSinceBaseline(is_explained, shared, (shift,))
        yield name, finding("no_gap", baseline_comparison=earlier, **NO_EFFECT)
    earlier = replace(earlier, parameter_shifts=(replace(shift, z_score=None, has_changed=False),))
    yield "not testable", finding("no_gap", baseline_comparison=earlier, **NO_EFFECT)
    errors = [{"points.tip": (error, "m")} for error in (0.02, 0.01)]
    better = _PredictionErrors(("bare (without)",), *errors)
    for name, other in {"worse": _PredictionErrors(("a", "b", "c"), *reversed(errors)),
                        "better": _PredictionErrors(("a",), *({"p": (e, "m")} for e in (0.003, 0.001))),
                        "failed": _PredictionErrors(("a",), {}, {}, "it diverges")}.items():  # fmt: skip
        yield f"{name} with effects", finding(counterfactual=CounterfactualPredictionErrors(better, other))


def all_told(made) -> str:
    return "\n".join([diagnosis_summary_text(made), "Do next:", *next_step_texts(made)])


def said() -> dict[str, str]:
    """Every text by its case."""
    found = {
        f"{part.__name__}: {name}": all_told(made) for part in (gaps, places, effects, unknown) for name, made in part()
    }
    for verdict, where, unseen in [
        ("insufficient_data", (), ()), ("unknown", (place("T2"),), ()), ("unknown", (place("world", 0.8),), ()),
        ("unknown", (place("camera", 0.8),), ()), ("unknown", (place("spring_1", 0.0),), ()), ("no_gap", (), ()),
        ("no_gap", (), ("a@b",)), ("no_gap", (), tuple(f"{kind}@x" for kind in "abcde")), ("effect", (), ()),
    ]:  # fmt: skip
        case = f"next experiment: {verdict} {[p.location for p in where]} {len(unseen)} unseen"
        hidden = screening(seen=[visible(effect(label), seen=False) for label in unseen])
        made = finding(verdict, selected_effects=(), gap_locations=where, screening=hidden)
        found[case] = recommended_experiment_text(made)
    for rivals in [
        {"joint_viscous@elbow": SPEED, "joint_coulomb@elbow": SPEED}, {"a@elbow": SPEED, "b@shoulder": SPEED},
        {"tilt@world": GRAVITY, "mass@elbow": ACCELERATION, "a@elbow": SPEED},
        {"melting@T1": "how hot it is", "density@T1": ACCELERATION},
    ]:  # fmt: skip
        alike = [SimpleNamespace(label=k, location=k.split("@")[1], required_excitation=v) for k, v in rivals.items()]
        made = finding(selected_effects=(SimpleNamespace(equivalent_effects=alike),))
        found[f"next experiment: rivals {list(rivals)}"] = recommended_experiment_text(made)
    force = ForceOrFaultEvent("run", "elbow", "elbow", "force", 1.0, 1.5, 0.5, 0.12, 0.01, "N m")
    odd = ForceOrFaultEvent("run", "camera", "points.w_T1.x", "sample", 2.0, 2.01, 0.05, 5e-4, 1e-5, "m")
    for events in ((force,), (force, odd), (force,) * 14):
        seen = EventSet(events, (_Overspeed("run_0", "elbow", 3.0),))
        found[f"events: {len(events)}"] = all_told(finding("no_gap", events=seen, **NO_EFFECT))
    found |= {f"baseline: {name}": all_told(made) for name, made in compared()}
    return found


CLOSURES = st.sampled_from(
    [closed(), closed(0.4, 0.01, 0.7), closed(math.nan, math.nan, math.nan), closed(0.5, math.nan, math.nan)]
)
SIZES = st.sampled_from([0.3, 0.989, 1.0, 1.05, 1.2, 40.0])


@given(CLOSURES, SIZES, SIZES, st.sampled_from([1e-13, 1e-3, 0.5]), st.sampled_from(["effect", "no_gap", *REASONS]))
def test_nothing_impossible_is_said(closure, fitted, held_out, p, how):
    """Every finding of a diagnosis has finite numbers, no gap below noise, and no closure without a gap."""
    lost = loss(held_out, held_out)
    if lost.excess_chi2_per_sample <= 0:
        closure = closed(math.nan, math.nan, math.nan)
    tests = {"nominal_test": outcome(p, chi2=fitted), "nominal_held_out_test": outcome(p, chi2=held_out)}
    known = {**tests, "gap_closure": closure, "nominal_model": fit(lost=lost)}
    verdict = how if how in ("effect", "no_gap") else "unknown"
    none = NO_EFFECT if verdict == "no_gap" else {"transfer_texts": carried(FRICTION)}
    made = finding(verdict, **known, **none, **({} if verdict == how else {"unknown_reason": how}))
    assert_nothing_impossible_is_said(made, all_told(made))


def test_a_diagnosis_says_what_is_written_down():
    assert said() == json.loads(FILE.read_text("utf-8"))


def test_friction_is_to_be_fitted_law_by_law(monkeypatch):
    kinds = {kind for own in EFFECT_KINDS_BY_FRICTION_LAW.values() for kind in own}
    assert all(EFFECTS[kind].is_joint_friction for kind in kinds)
    assert "yid-ocp friction" not in all_told(with_effect(FRICTION, 0.5))
    monkeypatch.setattr(EffectBase, "is_joint_friction", True)
    assert "Compare friction laws by `yid-ocp friction`" in all_told(with_effect(FRICTION, 0.5))


def test_effects_that_only_a_prior_separates_from_the_nominal_model_share_one_advice():
    rows = {"data": slice(0, 2), "stated_priors": slice(2, 3)}
    jacobian = evaluation([0.0] * 3, jacobian=np.array([[9.0, 9.0], [8.0, 8.0], [1.0, 0.0]]))
    known = {"residual_rows": SimpleNamespace(**rows), "shared_parameters": ("k",)}
    pairs = [(own, SimpleNamespace(unknown_names=("k", f"{own.label}.a"), **known)) for own in (FRICTION, OFFSET)]
    models = [replace(fit([own], problem=problem), evaluation=jacobian) for own, problem in pairs]
    said = all_told(with_effect(FRICTION, 0.5, single_effect_models=tuple(models)))
    assert "separate friction@elbow from k; offset@wrist from k. To determine an effect, measure" in said


def test_effects_that_cannot_be_told_apart_are_to_be_separated_where_the_data_suffice():
    alike = finding("effect", selected_effects=(added(FRICTION, rivals=[OFFSET]),))
    assert recommended_experiment_text(alike).startswith("Move elbow and wrist one after the other")
    others = finding("effect", selected_effects=(added(FRICTION),)), replace(alike, verdict="insufficient_data")
    sole, few = map(recommended_experiment_text, others)
    assert (sole[:20], few[:25]) == ("Record and diagnose ", "Raise problem.duration if")


if __name__ == "__main__":
    FILE.write_text(json.dumps(said(), indent=1, ensure_ascii=False) + "\n", "utf-8")

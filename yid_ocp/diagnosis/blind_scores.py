"""Scores of blind diagnoses against their labels, and calibration of thresholds on an ensemble of cases.

Given n values of a statistic on cases of one kind, a further case lies at or below their k-th smallest with a
probability of at least k/(n + 1) (split conformal prediction: Vovk, Gammerman and Shafer 2005, doi:10.1007/b106715).
"""

from __future__ import annotations

import decimal
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Literal, cast

import numpy as np
import scipy.optimize
import scipy.special
import scipy.stats

from yid_ocp.arrays import Array
from yid_ocp.diagnosis import screening
from yid_ocp.diagnosis.blind import BLIND_CASE_CATEGORY_SHARES, CaseGroundTruth
from yid_ocp.diagnosis.diagnosis_result import DiagnosisResult, judgement_to_dict
from yid_ocp.diagnosis.refit import EffectSearchRecord, RefitContext, RefitStatistics
from yid_ocp.diagnosis.screening import EMPTY_SCREENING_RESULT, CandidateDetectability, ScoreTestResult
from yid_ocp.diagnosis.thresholds import DEFAULT_THRESHOLDS, Thresholds
from yid_ocp.diagnosis.verdict import Judgement, NominalModelGapEvidence, judge
from yid_ocp.display import effect_entry_label
from yid_ocp.effects import EFFECTS, EffectBase
from yid_ocp.effects.base import ParameterDefinition
from yid_ocp.errors import DataError
from yid_ocp.files import dataclass_from_plain_data, to_json_types, to_lossless_plain_data
from yid_ocp.inference import smoother
from yid_ocp.inference.null_test import NullTestResult
from yid_ocp.model.parameters import Parameter, Parameters

_FORMAT = "yid-blind/1"
_CATEGORIES = tuple(BLIND_CASE_CATEGORY_SHARES)
_OUT_OF_LIBRARY_CATEGORIES = ("outside", "left_out")  # categories whose true effect is not among the candidates
_MAX_CONFUSABLE_SET = 3  # largest number of confusable effects that counts as a right answer
_NOT_JUDGED = "not_judged"  # verdict of a recorded case if changed thresholds need a refit that was not made
_VERDICTS = ("no_gap", "unknown", "insufficient_data", "effect", "confusable", _NOT_JUDGED)


@dataclass(frozen=True)
class BlindCaseScore:
    """The score of a blind diagnosis against its label: correct answers, gap closure, errors and time."""

    case: str
    category: str
    truth: str  # labels of the injected effects, joined by " + "; "-" without any
    verdict: str
    answer: str  # labels of the effects that the diagnosis names, likewise
    multiple: float  # true size over the detectable size; NaN if not applicable
    gap: bool  # whether a gap was reported
    kind_first: bool  # whether the first candidate has the true kind at the true location
    location_first: bool  # whether the first location of the gap is that of a true effect
    confusable: tuple[str, ...]  # effects that the diagnosis calls confusable with the first named one
    # whether the answer is right. Clean case: `no_gap`. Effect outside the library: `unknown` with the true location.
    # Otherwise: each true effect is named, alone or in a confusable set of at most three
    right: bool
    closure: float  # fraction of the held-out gap that the named effects close
    best: float  # closure by a refit of the true effects
    # per parameter of an accepted true effect: relative error, and whether the 95 % interval contains the truth
    errors: Mapping[str, tuple[float, bool]] = field(default_factory=dict)
    seconds: float = math.nan
    experiment: str = ""
    z: Mapping[str, float] = field(default_factory=dict)  # (estimate - truth)/std of the same parameters
    p_value: float = math.nan  # p-value of the null test on the held-out recordings
    probability: float = math.nan  # stated probability that the cause is named; NaN in answers of older versions
    is_cause_in_sets: bool = False  # whether the cause is named: each true effect, alone or in a confusable set

    @property
    def _named_effect_labels(self) -> tuple[str, ...]:
        """Labels of the first effect that the diagnosis names, and of the effects confusable with it."""
        return self.confusable or tuple(self.answer.split(" + ")[:1])


def score_blind_case(
    label: CaseGroundTruth, result: Mapping[str, Any], best: float = math.nan, seconds: float = math.nan
) -> BlindCaseScore:
    """Score a diagnosis result (`yid-diagnosis/2`) against its label. `best`: closure by the true effects, if known."""

    def labels(entries: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
        return tuple(map(effect_entry_label, entries))

    verdict, named, listed = str(result["verdict"]), labels(result["effects"]), labels(result["which"])
    groups = [labels(group) for group in result["confusable"]]
    true, places = [effect.label for effect in label.injected], [p["location"] for p in result["where"]]
    located = bool(true) and places[:1] != [] and places[0] in {effect.location for effect in label.injected}
    if label.category == "null":
        right = verdict == "no_gap"
    elif label.category in _OUT_OF_LIBRARY_CATEGORIES:
        right = verdict == "unknown" and located
    else:
        right = bool(true) and _found(true, named if label.category == "pair" else named[:1], groups)
    errors, z = dict[str, tuple[float, bool]](), dict[str, float]()
    for effect in label.injected:
        if effect.label not in named or effect.kind not in EFFECTS:
            continue
        entry = result["which"][listed.index(effect.label)]
        for name, value in effect.values.items():
            found = entry["parameters"].get(name, {})
            if found.get("value") is None or found.get("std") is None or not math.isfinite(value):
                continue
            miss = found["value"] - value
            errors[f"{effect.label}.{name}"] = (abs(miss) / max(abs(value), 1e-9), abs(miss) <= 1.96 * found["std"])
            if found["std"] > 0:
                z[f"{effect.label}.{name}"] = miss / found["std"]
    before = result["gap"].get("before") or {}
    return BlindCaseScore(
        case=label.case,
        category=label.category,
        truth=" + ".join(true) or "-",
        verdict=verdict,
        answer=" + ".join(named) or "-",
        multiple=_or_nan(label.multiple),
        gap=verdict not in ("no_gap", "insufficient_data"),
        kind_first=bool(true) and listed[:1] == (true[0],),
        location_first=located,
        confusable=next((group for group in groups if named and named[0] in group), ()),
        right=right,
        closure=_or_nan(result["gap"]["closure"]),
        best=best,
        errors=errors,
        seconds=seconds,
        experiment=label.experiment,
        z=z,
        p_value=_or_nan(before.get("p_value")),
        probability=_or_nan(result.get("probability")),
        is_cause_in_sets=bool(true) and _found(true, named, groups, math.inf),
    )


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _found(
    true: Sequence[str], named: Sequence[str], groups: Sequence[tuple[str, ...]], most: float = _MAX_CONFUSABLE_SET
) -> bool:
    """Return whether every true effect is named: itself, or by another one in a confusable set of at most `most`."""
    if not true:
        return True
    small = [group for group in groups if len(group) <= most]
    sets = [{name, *(label for group in small if name in group for label in group)} for name in named]
    left = ([*named[:i], *named[i + 1 :]] for i, own in enumerate(sets) if true[0] in own)
    return any(_found(true[1:], others, groups, most) for others in left)


def _binomial_proportion(hits: Sequence[bool]) -> dict[str, float | int | None]:
    """Return count, total, rate and its 95 % interval (Clopper and Pearson 1934, doi:10.1093/biomet/26.4.404)."""
    count, total = sum(map(bool, hits)), len(hits)
    if not total:
        return {"count": 0, "of": 0, "rate": None, "low": None, "high": None}
    low = 0.0 if count == 0 else float(scipy.stats.beta.ppf(0.025, count, total - count + 1))
    high = 1.0 if count == total else float(scipy.stats.beta.ppf(0.975, count + 1, total - count))
    return {"count": count, "of": total, "rate": count / total, "low": low, "high": high}


def blind_case_score_summary(marks: Sequence[BlindCaseScore]) -> dict[str, Any]:
    """Return a summary of scores: rates of false alarms, detections and right answers. A rate without cases is None.

    Cases that are not judged are excluded from all rates and counted as `not_judged`.
    """

    def mean(values: Sequence[float]) -> float | None:
        return float(np.mean(values)) if len(values) else None

    every, marks = marks, [m for m in marks if m.verdict != _NOT_JUDGED]
    by = {sort: [m for m in marks if m.category == sort] for sort in _CATEGORIES}
    singles = by["single"]
    strange = [m for m in marks if m.category in _OUT_OF_LIBRARY_CATEGORIES]
    seen = [m for m in singles if m.gap]
    named = [m for m in seen if m.answer != "-"]
    errors = [entry for m in singles for entry in m.errors.values()]
    shares = {
        "false_alarms": [m.gap for m in by["null"]],
        "detected": [m.gap for m in singles],
        "kind_first": [m.kind_first for m in seen],
        "location_first": [m.location_first for m in seen],
        "sets_cover": [m.truth in m._named_effect_labels for m in named],
        **{f"unknown_{sort}": [m.verdict == "unknown" for m in by[sort]] for sort in _OUT_OF_LIBRARY_CATEGORIES},
        "unknown_location": [m.location_first for m in strange if m.gap],
        "pairs_right": [m.right for m in by["pair"]],
        "interval_coverage": [inside for _, inside in errors],
    }
    intervals = {name: _binomial_proportion(hits) for name, hits in shares.items()}
    experiments = dict.fromkeys(m.experiment for m in every)
    detected = {}
    for size in sorted({m.multiple for m in singles if math.isfinite(m.multiple)}):
        own = [m for m in singles if m.multiple == size]
        hits = {"gap": [m.gap for m in own], "first": [m.gap and m.kind_first for m in own]}
        hits["right"] = [m.right for m in own]
        detected[f"{size:.3g}"] = {name: _binomial_proportion(said) for name, said in hits.items()}
    return {
        "format": _FORMAT,
        "cases": len(every),
        "not_judged": len(every) - len(marks),
        "intervals": intervals,
        "detection_intervals": detected,
        "set_size": mean([len(m._named_effect_labels) for m in named]),
        "closure_of_best": mean([m.closure / m.best for m in singles if m.best > 0 and math.isfinite(m.closure)]),
        "parameter_error": None if not errors else float(np.median([e for e, _ in errors])),
        "seconds": mean([m.seconds for m in marks if math.isfinite(m.seconds)]),
        "experiments": {name: _experiment_rates([m for m in every if m.experiment == name]) for name in experiments},
        "confusion": _confusion_matrix(every),
        "calibration": _calibration_rates(marks),
        "marks": [asdict(m) for m in every],
    }


def _experiment_rates(own: Sequence[BlindCaseScore]) -> dict[str, Any]:
    """Return the numbers of cases and unjudged cases, and the rates of false alarms and right answers."""
    every, own = own, [m for m in own if m.verdict != _NOT_JUDGED]
    return {
        "cases": len(every),
        "not_judged": len(every) - len(own),
        "false_alarms": _binomial_proportion([m.gap for m in own if m.category == "null"]),
        "right": _binomial_proportion([m.right for m in own if m.category not in ("null", "finer_chain")]),
    }


def _confusion_matrix(marks: Sequence[BlindCaseScore]) -> dict[str, Any]:
    """Return counts of cases by truth (kind of a single effect, or category) and answer (first kind, or verdict)."""
    true = [m.truth.partition("@")[0] if m.category == "single" else m.category for m in marks]
    answered = [m.verdict if m.answer == "-" else m.answer.partition("@")[0] for m in marks]
    pairs = list(zip(true, answered, strict=True))
    rows = sorted({*true}, key=lambda name: (name in _CATEGORIES, name))
    columns = sorted({*answered}, key=lambda name: (name in _VERDICTS, name))
    counts = [[pairs.count((row, column)) for column in columns] for row in rows]
    return {"true": rows, "said": columns, "counts": counts}


def _calibration_rates(marks: Sequence[BlindCaseScore]) -> dict[str, Any]:
    """Return how often intervals, p-values of clean cases and stated probabilities of the cause are right, by level.

    The probabilities are sorted into five bins of equal counts. Each bin is compared with its fraction of right sets.
    """
    z = [abs(value) for m in marks if m.category == "single" for value in m.z.values()]
    p = [m.p_value for m in marks if m.category == "null" and math.isfinite(m.p_value)]
    quantiles = {a: float(scipy.stats.norm.ppf(0.5 * (1 + a))) for a in (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)}
    named = _probabilities_and_outcomes(marks)
    bins = [own for own in np.array_split(named, 5) if len(own)]
    errors = [abs(float(np.sum(own[:, 0] - own[:, 1]))) for own in bins]
    return {
        "probabilities": [{"level": float(own[:, 0].mean()), **_binomial_proportion([*own[:, 1]])} for own in bins],
        "expected_calibration_error": sum(errors) / len(named) if len(named) else None,
        "intervals": [{"level": a, **_binomial_proportion([x <= q for x in z])} for a, q in quantiles.items()],
        "p_values": [{"level": a, **_binomial_proportion([x < a for x in p])} for a in (0.01, 0.05, 0.1, 0.2, 0.5)],
    }


def _probabilities_and_outcomes(marks: Sequence[BlindCaseScore]) -> Array:
    """Return stated probabilities of the cause, ascending, and whether the cause is named (1 or 0), shape (n, 2)."""
    named = [(m.probability, m.is_cause_in_sets) for m in marks if m.answer != "-" and m.probability >= 0]
    # equal probabilities stay in the order of cases: an order by outcome would fill bins with errors alone
    return np.array(sorted(named, key=lambda own: own[0]), float).reshape(-1, 2)


def _log_odds_regression(marks: Sequence[BlindCaseScore]) -> dict[str, float]:
    """Return the line from stated log odds, that the cause is named, to log odds that agree with the outcomes.

    These are `offset` + `slope` x the stated ones, by logistic regression. Priors 0 ± 1 and 1 ± 0.5 keep both finite.
    """
    probabilities, outcomes = _probabilities_and_outcomes(marks).T
    log_odds, sides = scipy.special.logit(probabilities), 2 * outcomes - 1

    def cost(line: Array) -> float:
        misfit = np.logaddexp(0.0, -sides * (line[0] + line[1] * log_odds)).sum()
        return float(misfit + line[0] ** 2 / 2 + ((line[1] - 1) / 0.5) ** 2 / 2)

    offset, slope = map(float, scipy.optimize.minimize(cost, [0.0, 1.0]).x)
    return {"cases": len(outcomes), "right": float(outcomes.sum()), "offset": offset, "slope": slope}


_CALIBRATION_FORMAT = "yid-calibration/1"
_TARGET_COVERAGE = 0.95  # fraction of the cases that must lie on the intended side of a threshold

_Statistics = Mapping[str, Any]
_Statistic = Callable[[_Statistics, Thresholds, str], float]


def thresholds_always_accepting_best_candidate(limits: Thresholds) -> Thresholds:
    """Return thresholds with which every residual counts as a gap and the best candidate is always accepted."""
    sure = 1.0 + 1e-9
    return replace(
        limits,
        significance_level=sure,
        gap_significance_level=sure,
        min_excess_chi2_per_dof=-1.0,
        min_log_bayes_factor=1e-9,
        max_effects=1,
    )


def _excess(said: _Statistics, limits: Thresholds, _: str) -> float:
    """Return chi2/n - 1 of a significant residual, and minus infinity for any other."""
    if said["chi2_per_dof"] is None:
        return math.inf  # the model could not follow the recording
    return float(said["chi2_per_dof"]) - 1 if said["p_value"] < limits.gap_significance_level else -math.inf


def _of(name: str) -> _Statistic:
    return lambda said, limits, truth: -math.inf if said.get(name) is None else float(said[name])


def _odds(said: _Statistics, limits: Thresholds, truth: str) -> float:
    """Return the log odds of the most likely single effect against the true effect alone.

    Likelihood separates only refits that leave noise alone: minus infinity if that of the true effect leaves more.
    """
    most = 1 + limits.min_excess_chi2_per_dof
    known = {
        label: own["bic_difference"]
        for label, own in said["single_effects"].items()
        if own["held_out_chi2_per_sample"] is not None and own["held_out_chi2_per_sample"] < most
    }
    return 0.5 * (known[truth] - min(known.values())) if truth in known else -math.inf


@dataclass(frozen=True)
class _CalibrationRule:
    """Rule by which a statistic of cases (`of`: clean, right or refitted ones) gives the threshold `setting`."""

    setting: str
    statistic: _Statistic
    of: Literal["clean", "named", "refitted"]
    side: Literal["most", "least"]
    limit: float


_CALIBRATION_RULES: Mapping[str, _CalibrationRule] = {
    "gap": _CalibrationRule("min_excess_chi2_per_dof", _excess, "clean", "most", 0.1),
    "candidate": _CalibrationRule("gap_significance_level", _of("candidate"), "clean", "least", 1e-4),
    "evidence": _CalibrationRule("min_log_bayes_factor", _of("evidence"), "clean", "most", 5.0),
    "rival": _CalibrationRule("min_log_bayes_factor", _odds, "refitted", "most", 5.0),
    "explained": _CalibrationRule("min_explained_fraction", _of("explained_fraction"), "named", "least", 0.75),
}
"""All rules by name. `_STATISTIC_TEXTS` describes their statistics."""
_STATISTIC_TEXTS = {
    "gap": "chi2/n - 1 of a significant residual",
    "candidate": "p-value of the best candidate",
    "evidence": "rise of the log evidence by the best location",
    "rival": "log odds of the most likely effect against the true one",
    "explained": "explained part of the gap",
}


def _conformal_quantile(
    sample: Sequence[float], side: Literal["most", "least"], coverage: float = _TARGET_COVERAGE
) -> tuple[float, float]:
    """Return the value below (`side` "least": above) which the fraction `coverage` of cases lies, and its coverage."""
    n = len(sample)
    if not n:
        return math.nan, 0.0
    ordered = sorted(sample) if side == "most" else sorted(sample, reverse=True)
    k = min(math.ceil((n + 1) * coverage - 1e-9), n)
    return ordered[k - 1], k / (n + 1)


def calibrate_thresholds(
    labels: Sequence[CaseGroundTruth],
    marks: Sequence[BlindCaseScore],
    answers: Sequence[Mapping[str, Any]],
    limits: Thresholds = DEFAULT_THRESHOLDS,
) -> dict[str, Any]:
    """Compute diagnosis thresholds as conformal quantiles of the statistics of a blind test (`yid-calibration/1`).

    `labels`, `marks` (scores) and `answers` belong to the same cases. An answer holds the `result` with its
    `statistics` and, if no gap was detected, `open`: statistics from `thresholds_always_accepting_best_candidate`.
    `limits` are the thresholds of the answers.
    """
    every = zip(labels, marks, answers, strict=True)
    known = ((label, mark, entry["result"].get("statistics"), entry.get("open") or {}) for label, mark, entry in every)
    cases = [(label.category, mark, said, wide) for label, mark, said, wide in known if said is not None]
    # clean recordings: statistics with permissive thresholds, or the original ones if that diagnosis failed
    clean = [wide if "p_value" in wide else said for category, _, said, wide in cases if category == "null"]
    single = [(mark, said) for category, mark, said, _ in cases if category == "single"]
    outside = [said for category, _, said, _ in cases if category in _OUT_OF_LIBRARY_CATEGORIES]
    found = {}
    for name, rule in _CALIBRATION_RULES.items():
        scored = [(m, rule.statistic(said, limits, m.truth)) for m, said in single if m.right or rule.of != "named"]
        sample = [value for _, value in scored if value > -math.inf]
        if rule.of == "clean":
            sample = [rule.statistic(said, limits, "") for said in clean]
        value, attained = _conformal_quantile(sample, rule.side)
        # for a lower bound from clean cases, small values indicate an effect
        sign = -1.0 if rule.of == "clean" and rule.side == "least" else 1.0
        sizes = sorted({m.multiple for m, _ in scored})
        beyond = {size: [sign * x > sign * value for m, x in scored if m.multiple == size] for size in sizes}
        strange = [sign * rule.statistic(said, limits, "") > sign * value for said in outside]
        found[name] = {
            "setting": rule.setting,
            "statistic": _STATISTIC_TEXTS[name],
            "of": rule.of,
            "side": rule.side,
            "cases": len(sample),
            "coverage": attained,
            "quantile": to_json_types(value),
            "limit": rule.limit,
            "is": getattr(limits, rule.setting),
            "sample": to_json_types(sorted(sample)),
            "effects_beyond": {f"{size:.3g}": _binomial_proportion(hits) for size, hits in beyond.items()},
            "strange_beyond": _binomial_proportion(strange),
        }
    head = {"format": _CALIBRATION_FORMAT, "asked": _TARGET_COVERAGE}
    return head | {"rules": found, "log_odds": _log_odds_regression(marks), "settings": _recommended_settings(found)}


def _recommended_settings(rules: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Return thresholds by setting: quantiles rounded away from the cases to two digits, within each rule's limit."""
    settings: dict[str, float] = {}
    for own in rules.values():
        most, value, limit = own["side"] == "most", own["quantile"], float(own["limit"])
        if value is not None:
            context = decimal.Context(prec=2, rounding=decimal.ROUND_CEILING if most else decimal.ROUND_FLOOR)
            outwards = float(context.create_decimal(f"{value:.10g}"))  # more digits are numerical errors
            limit = max(limit, outwards) if most else min(limit, outwards)
        settings[own["setting"]] = max(limit, settings.get(own["setting"], limit))
    return settings


_EVIDENCE_FORMAT = "yid-evidence/3"  # 2 had no chi2 of one fit to all recordings
_MIN_RECORDED_OVERLAP = 0.5  # smallest overlap of two candidates' signatures that is recorded, as a fraction


def diagnosis_evidence_to_dict(result: DiagnosisResult) -> dict[str, Any]:
    """Return all numbers on which a diagnosis depends as JSON-compatible data for `rejudge_diagnosis_evidence`."""
    record, plain = result.record, to_lossless_plain_data
    pairs = {name: [[[e.label for e in both], fall] for both, _, fall in own] for name, own in record.pairs.items()}
    candidates = {entry.effect.label: entry.effect for entry in result.screening.detectability}
    smoothed = result.smoother_result
    located = () if smoothed is None else smoother.gap_locations_by_smoother_evidence(smoothed)
    return {
        "format": _EVIDENCE_FORMAT,
        "effects": {label: plain(effect.definitions) for label, effect in candidates.items()},
        "nominal_model": _refit_to_json(result.nominal_model),
        "tests": [plain(test) for test in (result.nominal_test, result.nominal_held_out_test)],
        "screening": _screening_to_json(result.screening),
        "has_left_baseline": result.has_left_baseline,
        "discretisation_chi2": result.discretisation_chi2,
        "has_left_start": result.has_left_start,
        "thresholds": plain(result.thresholds),
        "located_gap": {"locations": plain(located)},
        "remaining": [plain(place) for place in result.remaining_gap_locations],
        "refits": {name: fit and _refit_to_json(fit) for name, fit in sorted(record.refits.items())},
        "screenings": {name: _screening_to_json(own) for name, own in record.screenings.items()},
        "pairs": plain(pairs),
    }


def _refit_to_json(fit: RefitStatistics) -> dict[str, Any]:
    return dict(to_lossless_plain_data(vars(fit.statistics()) | {"effects": [effect.label for effect in fit.effects]}))


def _screening_to_json(screened: screening.ScreeningResult) -> dict[str, Any]:
    labels, overlaps = screened.labels, screened.overlap_fractions
    near = [(i, j, overlaps[i, j]) for i, j in np.argwhere(overlaps >= _MIN_RECORDED_OVERLAP) if i != j]
    scores = [{**vars(score), "effect": score.effect.label, "changes": {}} for score in screened.candidate_scores]
    seen = {entry.effect.label: entry.is_detectable for entry in screened.detectability}
    return dict(to_lossless_plain_data({"labels": labels, "alike": near, "scores": scores, "detectable": seen}))


class _UnrecordedRefitError(LookupError):
    """An error that is raised when the rules require a refit that the recorded search did not make."""


class _RecordedSearch(RefitContext):
    """A search that takes results from a record only. A missing result raises `_UnrecordedRefitError`."""

    def _answer(self, answers: dict[str, Any], name: str, work: Callable[[], Any]) -> Any:
        if name not in answers:
            raise _UnrecordedRefitError(name)
        return answers[name]


class _RecordedCase:
    """The objects that the rules need, restored from the output of `diagnosis_evidence_to_dict`."""

    def __init__(self, data: Mapping[str, Any]) -> None:
        self._effects = known = {label: _restored_effect(label, own) for label, own in data["effects"].items()}
        restored = dataclass_from_plain_data
        before, held = (restored(NullTestResult, test) for test in data["tests"])
        nominal, screened = self._refit(data["nominal_model"]), self._screening(data["screening"])
        other = (data.get(name, 0) for name in ("has_left_baseline", "discretisation_chi2", "has_left_start"))
        self.evidence = NominalModelGapEvidence(nominal, before, held, screened, *other)
        self.record = EffectSearchRecord(
            {name: fit and self._refit(fit) for name, fit in data["refits"].items()},
            {name: self._screening(own) for name, own in data["screenings"].items()},
            {name: [((known[a], known[b]), {}, fall) for (a, b), fall in own] for name, own in data["pairs"].items()},
        )

    def _refit(self, data: Mapping[str, Any]) -> RefitStatistics:
        effects = tuple(self._effects[label] for label in data["effects"])
        return replace(dataclass_from_plain_data(RefitStatistics, {**data, "effects": ()}), effects=effects)

    def _screening(self, data: Mapping[str, Any]) -> screening.ScreeningResult:
        overlaps = np.eye(len(data["labels"]))
        for i, j, fraction in data["alike"]:
            overlaps[i, j] = fraction
        names = {own.name for own in fields(ScoreTestResult)}  # answers of other versions may have more
        parts = ({name: own[name] for name in names & own.keys()} for own in data["scores"])
        scores = tuple(ScoreTestResult(**{**own, "effect": self._effects[own["effect"]]}) for own in parts)
        shown = {label: data["detectable"][label] for label in data["labels"]}
        seen = tuple(CandidateDetectability(self._effects[label], {}, own) for label, own in shown.items())
        return replace(EMPTY_SCREENING_RESULT, detectability=seen, candidate_scores=scores, overlap_fractions=overlaps)


def _restored_effect(label: str, data: Sequence[Mapping[str, Any]]) -> EffectBase:
    kind, _, location = label.partition("@")
    defined = tuple(dataclass_from_plain_data(ParameterDefinition, own) for own in data)
    made = (Parameter(f"{label}.{q.name}", q.neutral_value, q.unit, q.lower, q.upper, q.description) for q in defined)
    return EFFECTS[kind](kind, location, Parameters(made), definitions=defined)


def rejudge_diagnosis_evidence(data: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Judge a recorded diagnosis again with changed thresholds, from the data of `diagnosis_evidence_to_dict`.

    Thresholds that `changes` does not name are those of the recorded diagnosis. The verdict is `not_judged` if the
    changed thresholds need a refit that was not made. Steps before the first screening (events, time step) are not
    repeated. Raises `DataError` if the case was recorded in another format.
    """
    if data.get("format") != _EVIDENCE_FORMAT:
        hint = "run `yid-ocp blind` again, or rescore with the version of yid_ocp that made the answers"
        what = f"the answers of the cases have the format '{data.get('format')}' of another version of yid_ocp"
        raise DataError(what, where="key `evidence` of a file in answers/", allowed=_EVIDENCE_FORMAT, hint=hint)
    known = {entry.name for entry in fields(Thresholds)}
    kept = {name: value for name, value in data["thresholds"].items() if name in known}
    limits = replace(DEFAULT_THRESHOLDS, **(kept | dict(changes)))
    case = _RecordedCase(data)
    try:
        judged = judge(_RecordedSearch(cast(Any, None), limits, record=case.record), case.evidence)
    except _UnrecordedRefitError:
        judged = Judgement(_NOT_JUDGED, "", (), (), 1.0, {}, 0.0, (), 0.0)
    places = (data["located_gap"]["locations"], data["remaining"])
    where, rest = (tuple(dataclass_from_plain_data(smoother.GapLocation, own) for own in part) for part in places)
    if judged.accepted_selected_effects:
        closed = judged.accepted_effects_closure_by_location
        where = smoother.gap_locations_from_closures_and_smoother(where, closed, rest, ())
    return judgement_to_dict(judged, case.evidence, where)

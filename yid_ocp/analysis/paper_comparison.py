"""Comparison with the source paper's estimates of its four experiments, and explanations of differences.

Its recordings are not public. What is said of a value rests on twins of its experiments in MuJoCo, whose truth was
chosen: what their recordings inform, where steepest descent with the paper's cost and step lengths stands after 200
iterations, and where constant errors of the torques lead it (`benchmarks/torque_ensemble.py`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources

from yid_ocp.inference.uncertainty import MAX_IDENTIFIABLE_RELATIVE_STD, ParameterEstimate
from yid_ocp.solvers.fit_messages import VERDICT_PREDICATES, interval_text

_PAPER_PARAMETERS = ("T1.bend", "T1.twist", "T2.bend", "T2.twist", "T3.bend", "T3.twist")
PAPER_ESTIMATES: dict[str, dict[str, float]] = {
    "single_arm_no_vision": dict(zip(_PAPER_PARAMETERS, (23.780, 0.000, 18.357, 11.103, 3.200, 3.059), strict=True)),
    "single_arm_vision": dict(zip(_PAPER_PARAMETERS, (22.270, 13.593, 10.735, 8.202, 11.511, 9.692), strict=True)),
    "dual_arm_no_vision": dict(zip(_PAPER_PARAMETERS, (19.559, 4.965, 8.575, 10.374, 0.000, 11.287), strict=True)),
    "dual_arm_vision": dict(zip(_PAPER_PARAMETERS, (24.840, 0.000, 12.373, 30.775, 1.406, 24.900), strict=True)),
}
"""The source paper's answers for its four experiments [N m/rad]; its data are not public."""
_TRUTH_EXPERIMENT = "single_arm_vision"
"""The answer whose rounded values are the truth of the embedded recordings: the only one without a zero."""

_TORQUE_BIAS_STD = 0.3  # standard deviation of the constant error of a joint's torque in the ensemble [N m]
_DESCENT_INITIAL_VALUE, _DESCENT_ITERATIONS = 3.0, 200  # of steepest descent in the ensemble [N m/rad]
_ROUNDING_RTOL = 0.02  # a truth so near a published value, relatively, was made of it by rounding
_ZERO_BOUND_FRACTION = 0.01  # a bound at zero is reached within this fraction of the largest of an ensemble's values


@dataclass(frozen=True)
class _DescentEndpoints:
    """Values of one parameter where steepest descent with the paper's step lengths ends, on synthetic recordings.

    Attributes
    ----------
    start : float
        [N m/rad]
    stopped : float
        After 200 iterations with torques that are exact.
    offsets : tuple of float
        With torques that are off by a constant, one for each member of the ensemble.
    """

    start: float
    stopped: float
    offsets: tuple[float, ...]


@cache
def _load_torque_ensemble() -> Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]]:
    """Estimates of all ensemble members [N m/rad] by experiment, torque errors (none, offsets) and parameter.

    Written by `benchmarks/torque_ensemble.py`.
    """
    text = (resources.files("yid_ocp.data") / "defaults" / "torque_ensemble.json").read_text(encoding="utf-8")
    found: Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]] = json.loads(text)
    return found


def explain_paper_estimates(
    experiment: str, estimates: Mapping[str, ParameterEstimate], truth: Mapping[str, float]
) -> tuple[str, ...]:
    """One sentence for each published estimate of an experiment, explaining its difference from ours.

    Parameters
    ----------
    experiment : str
        A key of `PAPER_ESTIMATES`.
    estimates : mapping of str to Estimate
        Estimates of the free parameters from recordings of such an experiment.
    truth : mapping of str to float
        Of these recordings, where it is known.

    Returns
    -------
    tuple of str
        Empty where the model does not explain the recordings.
    """
    judged = {name: estimates[name] for name in _PAPER_PARAMETERS if name in estimates and estimates[name].free}
    if any(entry.verdict == "not_trusted" for entry in judged.values()):
        return ()
    found = _load_torque_ensemble()[experiment]
    sentences = []
    for name, entry in judged.items():
        ends = _DescentEndpoints(_DESCENT_INITIAL_VALUE, found["none"][name][0], tuple(found["offsets"][name]))
        value = PAPER_ESTIMATES[experiment][name]
        why = _discrepancy_reason(value, entry, truth.get(name), ends)
        words = _words(why, value, entry, truth.get(name), ends, experiment)
        sentences.append(f"{name} = {value:.4g} of the paper: {words}")
    return tuple(sentences)


def _discrepancy_reason(
    published: float, entry: ParameterEstimate, truth: float | None, ends: _DescentEndpoints
) -> str:
    """Label of the likeliest reason for a published estimate, judged by synthetic recordings.

    ============  ======================================================================================================
    not_informed  such recordings do not find the parameter, or only so weakly that their interval holds the value
    near_truth    the value is within 10 % of the twin's truth
    slow          it lies between the start and where the paper's method stops without torque errors, far from the
                  truth, or within 10 % of the latter
    torque_error  it lies within what constant errors of the torques lead the paper's method to
    unexplained   anything else
    ============  ======================================================================================================

    The first that applies is returned.
    """
    if entry.verdict == "not_identifiable" or (entry.verdict != "identifiable" and _holds(entry, published)):
        return "not_informed"
    if truth is not None and _near(published, truth):
        return "near_truth"
    if truth is not None and not _near(ends.stopped, truth):
        low, high = sorted((ends.start, ends.stopped))
        if low <= published <= high or _near(published, ends.stopped):
            return "slow"
    return "torque_error" if is_within_ensemble(published, ends.offsets) else "unexplained"


def is_within_ensemble(published: float, values: Sequence[float]) -> bool:
    """Whether a published estimate lies in the range of an ensemble's estimates, with a margin at a zero bound."""
    return min(values) - _ZERO_BOUND_FRACTION * max(values) <= published <= max(values)


def _near(value: float, truth: float) -> bool:
    return abs(value - truth) <= MAX_IDENTIFIABLE_RELATIVE_STD * abs(truth)


def _holds(entry: ParameterEstimate, value: float) -> bool:
    lower, upper = entry.interval or (entry.value - 2 * entry.std, entry.value + 2 * entry.std)
    return (lower is None or lower <= value) and (upper is None or value <= upper)


def _words(
    why: str, value: float, entry: ParameterEstimate, truth: float | None, ends: _DescentEndpoints, experiment: str
) -> str:
    if why == "not_informed":
        known = f"in such an experiment it {VERDICT_PREDICATES[entry.verdict]}"
        if entry.verdict == "weak" and entry.interval not in (None, (None, None)):
            return f"hardly informed; {known}, {interval_text(*entry.interval)}, where the value lies"
        return f"not informed; {known}"
    if why == "near_truth":
        assert truth is not None
        chosen = experiment == _TRUTH_EXPERIMENT and abs(value - truth) <= _ROUNDING_RTOL * abs(truth)
        return f"near the truth of these recordings, {truth:.4g}" + (", which was chosen from it" if chosen else "")
    many = f"{min(ends.offsets):.3g} to {max(ends.offsets):.3g} in {len(ends.offsets)} twins"
    led = f"constant torque errors of {_TORQUE_BIAS_STD:g} N m lead the paper's method to {many}"
    if why == "slow":
        return (
            f"slow; without torque errors the paper's method goes from {ends.start:.3g} to {ends.stopped:.3g} "
            f"in {_DESCENT_ITERATIONS} iterations"
        )
    if why == "torque_error":
        return f"torque error; {led}"
    told = "such recordings inform it"
    if entry.verdict == "weak" and entry.interval not in (None, (None, None)):
        told = f"such recordings leave {interval_text(*entry.interval)} open and not this"
    return f"unexplained; {told}, it is not slow, and {led}"

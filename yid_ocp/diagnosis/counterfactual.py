"""An effect is understood when taking it away predicts the world without it, and adding it the world with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from yid_ocp.analysis.history import Estimates
from yid_ocp.data.recording import Recording
from yid_ocp.diagnosis.refit import SOLVER, Fit
from yid_ocp.effects import EffectBase
from yid_ocp.errors import SolverError, YidError
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.options import JointPrior
from yid_ocp.problem.validation import channel_errors
from yid_ocp.solvers import Status

Values = Mapping[str, float]


@dataclass(frozen=True)
class Predicted:
    """Prediction errors (RMSE by channel) on recordings no fit has used, without diagnosis and counterfactual.

    Attributes
    ----------
    recordings : tuple of str
    plain, counterfactual : mapping of channel to float
        Root mean square errors without a diagnosis, and with the effects removed (or added).
    units : mapping of channel to str
    message : str
        Why there are none.
    """

    recordings: tuple[str, ...]
    plain: Mapping[str, float]
    counterfactual: Mapping[str, float]
    units: Mapping[str, str]
    message: str = ""

    @property
    def means(self) -> dict[str, tuple[float, float]]:
        """Root mean square over the channels of each unit: (without a diagnosis, counterfactual)."""
        found = {}
        for unit in dict.fromkeys(self.units.values()):
            own = [channel for channel, of in self.units.items() if of == unit]
            found[unit] = tuple(
                float(np.sqrt(np.mean([errors[c] ** 2 for c in own]))) for errors in (self.plain, self.counterfactual)
            )
        return {unit: (pair[0], pair[1]) for unit, pair in found.items()}

    @property
    def better(self) -> bool:
        """Whether the counterfactual prediction has the smaller RMSE in every unit."""
        return bool(self.means) and all(after < before for before, after in self.means.values())


@dataclass(frozen=True)
class Counterfactual:
    """Prediction errors with the effects removed, and with the effects added.

    Attributes
    ----------
    removed : Predicted
        Recordings made without the effects: by the diagnosed model with its effects taken out, against the nominal
        model as it was fitted to the recordings with them.
    added : Predicted
        Recordings made with the effects: by the model of the world without them with the effects put in, against that
        model alone.
    """

    removed: Predicted
    added: Predicted

    def to_dict(self) -> dict[str, object]:
        """Return `counterfactual` of `yid-diagnosis/1`, JSON-compatible."""
        return {name: _entry(part) for name, part in (("removed", self.removed), ("added", self.added))}


def counterfactual(
    nominal: Fit, last: Fit, without: Sequence[Recording], baseline: Estimates | None = None
) -> Counterfactual:
    """Predict reference recordings with the effects removed, and the diagnosed recordings with them added.

    Parameters
    ----------
    nominal, last : Fit
        Without and with the effects.
    without : sequence of Recording
        Made without the effects; with the same sensors.
    baseline : Estimates, optional
        What is known of the world without the effects; estimated on `without` where absent.

    Returns
    -------
    Counterfactual
        A message stands for what cannot be predicted.
    """
    shared = nominal.problem.shared
    now = {name: last.values[name] for name in shared}
    effects = {name: last.values[name] for effect in last.effects for name in effect.parameters.names}
    held = [e.recording for e in (*last.problem.episodes, *last.problem.held_out)]
    present = list({id(recording): recording for recording in held}.values())
    removed = _predicted(last, without, {name: nominal.values[name] for name in shared}, now)
    try:
        then = (
            _then(last, without, shared)
            if baseline is None
            else dict(zip(baseline.names, baseline.values, strict=True))
        )
    except YidError as error:
        return Counterfactual(removed, _nothing(present, error.what))
    return Counterfactual(removed, _predicted(last, present, then, {**then, **effects}))


def _predicted(last: Fit, recordings: Sequence[Recording], plain: Values, other: Values) -> Predicted:
    """Errors by two models; parameters that neither names are the problem's own, and effects neutral."""
    try:
        problem = _on(last, recordings)
        first, units = _errors(problem, plain, last.effects)
        second, _ = _errors(problem, other, last.effects)
    except YidError as error:
        return _nothing(recordings, error.what)
    return Predicted(tuple(recording.name for recording in recordings), first, second, units)


def _nothing(recordings: Sequence[Recording], message: str) -> Predicted:
    return Predicted(tuple(recording.name for recording in recordings), {}, {}, {}, message)


def _on(last: Fit, recordings: Sequence[Recording]) -> EstimationProblem:
    """The problem with its compiled step, all candidates in it, on other recordings: to predict and to estimate on."""
    own = last.problem
    options = replace(own.options, priors={}, local=(), joint_prior=JointPrior(), known_start={})
    values = dict(zip(own.system.parameters.names, map(float, own.theta), strict=True))
    return EstimationProblem(own.step, recordings, own.shared, options, values, recordings)


def _errors(
    problem: EstimationProblem, values: Values, effects: Sequence[EffectBase]
) -> tuple[dict[str, float], dict[str, str]]:
    neutral = {name: value for effect in effects for name, value in effect.neutral.items()}
    if problem.disturbed:
        problem = problem.weighted_by_sensors()
    found = problem.validate(problem.vector({**neutral, **values}))
    failed = [result for _, result in found if isinstance(result, str)]
    if failed:
        raise SolverError(f"a recording cannot be predicted: {failed[0]}")
    errors = channel_errors([r for _, r in found if not isinstance(r, str)], [episode for episode, _ in found])
    return {c: float(e["rmse"]) for c, e in errors.items()}, {c: str(e["unit"]) for c, e in errors.items()}


def _then(last: Fit, without: Sequence[Recording], shared: Sequence[str]) -> dict[str, float]:
    """The nominal parameters as they are estimated on the recordings without the effects."""
    problem = _on(last, without).freeing(shared)
    outcome = SOLVER.run(problem, problem.start, None)
    if outcome.status == Status.FAILED:
        raise SolverError(
            f"the nominal model cannot be fitted to the recordings without the effects: {outcome.message}"
        )
    return {name: problem.named(outcome.x)[name] for name in shared}


def _entry(part: Predicted) -> dict[str, object]:
    return {
        "recordings": list(part.recordings),
        "rmse": {
            channel: {
                "without_diagnosis": part.plain[channel],
                "counterfactual": part.counterfactual[channel],
                "unit": unit,
            }
            for channel, unit in part.units.items()
        },
        "better": part.better if part.units else None,
        "message": part.message,
    }

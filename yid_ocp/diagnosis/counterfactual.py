"""An effect is understood when taking it away predicts the world without it, and adding it the world with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from yid_ocp.analysis.estimate_history import RunEstimates
from yid_ocp.data.recording import Recording
from yid_ocp.diagnosis.refit import REFIT_SOLVER, RefitModel
from yid_ocp.effects import EffectBase
from yid_ocp.errors import SolverError, YidError
from yid_ocp.inference.whitening import whitened_by_sensor_noise
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.options import MultivariateGaussianPrior
from yid_ocp.problem.prediction_errors import rmse_by_channel
from yid_ocp.solvers import Status

_ParameterValues = Mapping[str, float]


@dataclass(frozen=True)
class PredictionErrors:
    """Prediction errors (RMSE by channel) on recordings no fit has used, without diagnosis and counterfactual.

    Attributes
    ----------
    recordings : tuple of str
    rmse_without_diagnosis, rmse_counterfactual : mapping of channel to float
        Root mean square errors without a diagnosis, and with the effects removed (or added).
    channel_units : mapping of channel to str
    failure_message : str
        Why there are none.
    """

    recordings: tuple[str, ...]
    rmse_without_diagnosis: Mapping[str, float]
    rmse_counterfactual: Mapping[str, float]
    channel_units: Mapping[str, str]
    failure_message: str = ""

    @property
    def rmse_by_unit(self) -> dict[str, tuple[float, float]]:
        """Root mean square over the channels of each unit: (without a diagnosis, counterfactual)."""
        found = {}
        for unit in dict.fromkeys(self.channel_units.values()):
            own = [channel for channel, of in self.channel_units.items() if of == unit]
            found[unit] = tuple(
                float(np.sqrt(np.mean([errors[c] ** 2 for c in own])))
                for errors in (self.rmse_without_diagnosis, self.rmse_counterfactual)
            )
        return {unit: (pair[0], pair[1]) for unit, pair in found.items()}

    @property
    def is_improved(self) -> bool:
        """Whether the counterfactual prediction has the smaller RMSE in every unit."""
        return bool(self.rmse_by_unit) and all(after < before for before, after in self.rmse_by_unit.values())


@dataclass(frozen=True)
class CounterfactualTest:
    """Prediction errors with the effects removed, and with the effects added.

    Attributes
    ----------
    effects_removed : Predicted
        Recordings made without the effects: by the diagnosed model with its effects taken out, against the nominal
        model as it was fitted to the recordings with them.
    effects_added : Predicted
        Recordings made with the effects: by the model of the world without them with the effects put in, against that
        model alone.
    """

    effects_removed: PredictionErrors
    effects_added: PredictionErrors

    def to_dict(self) -> dict[str, object]:
        """Return `predict_counterfactual` of `yid-diagnosis/2`, JSON-compatible."""
        return {name: _entry(part) for name, part in (("removed", self.effects_removed), ("added", self.effects_added))}


def predict_counterfactual(
    nominal: RefitModel,
    last: RefitModel,
    reference_recordings: Sequence[Recording],
    baseline: RunEstimates | None = None,
) -> CounterfactualTest:
    """Predict reference recordings with the effects removed, and the diagnosed recordings with them added.

    Parameters
    ----------
    nominal, last : Fit
        Without and with the effects.
    reference_recordings : sequence of Recording
        Made without the effects; with the same sensors.
    baseline : Estimates, optional
        What is known of the world without the effects; estimated on `reference_recordings` where absent.

    Returns
    -------
    Counterfactual
        A message stands for what cannot be predicted.
    """
    shared = nominal.problem.shared_parameters
    now = {name: last.values[name] for name in shared}
    effects = {name: last.values[name] for effect in last.effects for name in effect.parameters.names}
    held = [e.recording for e in (*last.problem.episodes, *last.problem.held_out)]
    present = list({id(recording): recording for recording in held}.values())
    removed = _predicted(last, reference_recordings, {name: nominal.values[name] for name in shared}, now)
    try:
        then = (
            _then(last, reference_recordings, shared)
            if baseline is None
            else dict(zip(baseline.parameter_names, baseline.values, strict=True))
        )
    except YidError as error:
        return CounterfactualTest(removed, _nothing(present, error.what))
    return CounterfactualTest(removed, _predicted(last, present, then, {**then, **effects}))


def _predicted(
    last: RefitModel, recordings: Sequence[Recording], plain: _ParameterValues, other: _ParameterValues
) -> PredictionErrors:
    """Errors by two models; parameters that neither names are the problem's own, and effects neutral."""
    try:
        problem = _on(last, recordings)
        first, units = _errors(problem, plain, last.effects)
        second, _ = _errors(problem, other, last.effects)
    except YidError as error:
        return _nothing(recordings, error.what)
    return PredictionErrors(tuple(recording.name for recording in recordings), first, second, units)


def _nothing(recordings: Sequence[Recording], message: str) -> PredictionErrors:
    return PredictionErrors(tuple(recording.name for recording in recordings), {}, {}, {}, message)


def _on(last: RefitModel, recordings: Sequence[Recording]) -> EstimationProblem:
    """The problem with its compiled step, all candidates in it, on other recordings: to predict and to estimate on."""
    own = last.problem
    options = replace(
        own.options,
        prior_stds={},
        local_parameters=(),
        multivariate_prior=MultivariateGaussianPrior(),
        known_initial_states={},
    )
    values = dict(zip(own.system.parameters.names, map(float, own.theta), strict=True))
    return EstimationProblem(own.step, recordings, own.shared_parameters, options, values, recordings)


def _errors(
    problem: EstimationProblem, values: _ParameterValues, effects: Sequence[EffectBase]
) -> tuple[dict[str, float], dict[str, str]]:
    neutral = {name: value for effect in effects for name, value in effect.neutral_values.items()}
    if problem.has_process_noise:
        problem = whitened_by_sensor_noise(problem)
    found = problem.predict_held_out(problem.vector({**neutral, **values}))
    failed = [result for _, result in found if isinstance(result, str)]
    if failed:
        raise SolverError(f"a recording cannot be predicted: {failed[0]}")
    errors = rmse_by_channel([r for _, r in found if not isinstance(r, str)], [episode for episode, _ in found])
    return {c: float(e["rmse"]) for c, e in errors.items()}, {c: str(e["unit"]) for c, e in errors.items()}


def _then(last: RefitModel, without: Sequence[Recording], shared: Sequence[str]) -> dict[str, float]:
    """The nominal parameters as they are estimated on the recordings without the effects."""
    problem = _on(last, without).with_free_subset(shared)
    outcome = REFIT_SOLVER.minimize_cost(problem, problem.initial_unknowns, None)
    if outcome.status == Status.FAILED:
        raise SolverError(
            f"the nominal model cannot be fitted to the recordings without the effects: {outcome.message}"
        )
    return {name: problem.named_values(outcome.x)[name] for name in shared}


def _entry(part: PredictionErrors) -> dict[str, object]:
    return {
        "recordings": list(part.recordings),
        "rmse": {
            channel: {
                "without_diagnosis": part.rmse_without_diagnosis[channel],
                "counterfactual": part.rmse_counterfactual[channel],
                "unit": unit,
            }
            for channel, unit in part.channel_units.items()
        },
        "better": part.is_improved if part.channel_units else None,
        "message": part.failure_message,
    }

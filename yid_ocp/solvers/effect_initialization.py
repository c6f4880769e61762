"""Initial values of free effects, away from the neutral values at which they are absent."""

from __future__ import annotations

import itertools
import logging

import numpy as np
from numpy.typing import NDArray

from yid_ocp.effects import EffectBase
from yid_ocp.inference.linearized_residual import bounded_least_squares_step, predicted_reduction
from yid_ocp.problem.estimation_problem import EstimationProblem
from yid_ocp.problem.evaluation import Evaluation

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

# Values tried of every shape parameter, across its range.
_N_SHAPE_VALUES = 4
# Part of an amplitude's range at which an effect begins that has no slope at its neutral value, and at the least.
_MIN_AMPLITUDE_FRACTION = 0.1
# A start that cannot be rolled out is drawn back towards the neutral one.
_START_FRACTIONS = (1.0, 0.5, 0.2, 0.05)


def initialize_free_effects(problem: EstimationProblem, x: Array) -> Array:
    """Return an initial unknown vector at which every free effect is slightly active.

    At its neutral value an effect's shape (where a spring is relaxed, how fast a branch creeps) moves nothing, and the
    slope by its amplitude is that of whatever shape the settings name: a spring that would have to push from there
    stays at its bound of zero. So each free effect that starts neutral, one after the other, is tried with several
    shapes; the linear model at the best of them gives its amplitude, within the range that one would expect. Without a
    shape the neutral value is kept, unless nothing is seen of the amplitude there.

    Parameters
    ----------
    problem : EstimationProblem
    x : ndarray, shape (nx,)

    Returns
    -------
    ndarray, shape (nx,)
        `x` itself where no free effect starts neutral, or where nothing else can be rolled out.
    """
    place = {name: i for i, name in enumerate(problem.unknown_names)}
    for effect in problem.system.effects:
        if not isinstance(effect, EffectBase):
            continue
        free = [name for name in effect.parameters.names if name in place]
        amplitudes = [name for name in effect.amplitude_names if name in free]
        if not amplitudes or any(x[place[name]] != effect.neutral_values[name] for name in amplitudes):
            continue
        begun = _begun(problem, x, effect, place)
        if begun is None:
            continue
        for pull in _START_FRACTIONS:
            trial = x + pull * (begun - x)
            if np.any(trial != x) and problem.evaluate(trial, derivatives=False).ok:
                log.info("%s begins at %s", effect.label, {name: float(trial[place[name]]) for name in free})
                x = trial
                break
    return x


def _begun(problem: EstimationProblem, x: Array, effect: EffectBase, place: dict[str, int]) -> Array | None:
    """The start with one effect at the best of its shapes, as far as the linear model tells.

    None where the neutral value is as good a start as any: nothing but the amplitude is free, and it is seen there.
    """
    amplitudes = [place[name] for name in effect.amplitude_names if name in place]
    shapes = [place[name] for name in effect.shape_names if name in place]
    expected = {place[name]: limits for name, limits in effect.prior_ranges.items() if name in place}
    grids = [[float(x[at]), *np.linspace(*expected[at], _N_SHAPE_VALUES)] for at in shapes]
    best, most, blind = x.copy(), -np.inf, True
    for values in itertools.product(*grids):
        trial = x.copy()
        trial[shapes] = values
        found = problem.evaluate(trial)
        if not found.ok or found.jacobian is None:
            continue
        blind = blind and not np.any(found.jacobian[problem.residual_rows.data][:, amplitudes])
        step, fall = _amplitude(problem, trial, found, amplitudes)
        if fall > most:
            best, most = trial, fall
            best[amplitudes] += step
    if not shapes and not blind:
        return None
    for at in amplitudes:
        low, high = expected[at]
        width = high - low
        moved = float(np.clip(best[at] - x[at], -width, width))
        if abs(moved) < _MIN_AMPLITUDE_FRACTION * width:
            lower = problem.bounds[0][at]
            moved = (
                _MIN_AMPLITUDE_FRACTION
                * width
                * (-1.0 if moved < 0 and x[at] - _MIN_AMPLITUDE_FRACTION * width >= lower else 1.0)
            )
        best[at] = x[at] + moved
    return np.clip(best, *problem.bounds)


def _amplitude(problem: EstimationProblem, x: Array, found: Evaluation, amplitudes: list[int]) -> tuple[Array, float]:
    """Step of the amplitudes, all other unknowns moved along, and the fall of the cost that it promises."""
    assert found.jacobian is not None
    lower, upper = problem.bounds
    size = np.maximum(np.abs(x), problem.unknown_scales)
    others = np.setdiff1d(np.arange(len(x)), amplitudes)
    low, high = (lower - x) / size, (upper - x) / size
    # the others may move by their size, no further: the model is linear about a start
    low[others], high[others] = np.maximum(low[others], -1.0), np.minimum(high[others], 1.0)
    scaled = found.jacobian * size
    step = bounded_least_squares_step(scaled, found.residual, 1e-10, low, high)
    return step[amplitudes] * size[amplitudes], predicted_reduction(scaled, found.residual, step)

"""Steps six and seven: full refits, judged on held-out recordings; several effects one after the other.

Every loss is a mean square of whitened residuals over blocks of held-out time, the same blocks for every model, so that
differences between models are paired. G = max(0, chi2/n - 1) is the gap, 1 - G_after/G_before what was closed; its
interval comes from resampling blocks (Kuensch 1989, doi:10.1214/aos/1176347265).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yid_ocp.diagnosis.hypotheses import Composed, residual_series, sample_times
from yid_ocp.diagnosis.score import robust
from yid_ocp.effects import EffectBase, Reported
from yid_ocp.problem.problem import Evaluation
from yid_ocp.solvers import GaussNewton
from yid_ocp.solvers.base import uncertainty

Array = NDArray[np.float64]

SOLVER = GaussNewton(iterations=15, step_tolerance=1e-3, cost_tolerance=1e-4)
"""A refit starts near its end and must be good to a small part of its deviation, and of `TIE`, only."""
RESAMPLES = 1000
TIE = 0.01
"""Part of chi2/n by which two models may differ and still count as equal, however sure the difference."""


@dataclass(frozen=True)
class Loss:
    """How badly held-out recordings are predicted.

    Attributes
    ----------
    squares, counts : ndarray, shape (nb,)
        Sum of whitened squares and number of samples of every block; infinite where a rollout failed.
    channels : dict of channel to (float, str)
        Root mean square error and its unit.
    """

    squares: Array
    counts: Array
    channels: dict[str, tuple[float, str]]

    @property
    def mean(self) -> float:
        """chi2/n."""
        return float(self.squares.sum() / max(self.counts.sum(), 1.0))

    @property
    def gap(self) -> float:
        """G."""
        return max(0.0, self.mean - 1.0)


@dataclass(frozen=True)
class Fit:
    """The model with some effects, refitted.

    Attributes
    ----------
    effects : tuple of EffectBase
    problem : Composed
    values : dict of str to float
        Unknowns.
    std : dict of str to float
        Their deviations; see `deviations`.
    cost : float
    evaluation : Evaluation
    loss : Loss
        Held-out.
    message : str
        Why the solver ended.
    """

    effects: tuple[EffectBase, ...]
    problem: Composed
    values: dict[str, float]
    std: dict[str, float]
    cost: float
    evaluation: Evaluation
    loss: Loss
    message: str

    @property
    def size(self) -> int:
        """Number of the effects' parameters."""
        return sum(len(effect.parameters) for effect in self.effects)

    def reported(self, effect: EffectBase) -> dict[str, Reported]:
        """An effect's quantities as people read them."""
        return effect.reported(self.values, self.std)


@dataclass(frozen=True)
class Closure:
    """Part of the held-out gap that a model closes, with a 95 % interval; NaN where there was no gap."""

    value: float
    low: float
    high: float


def refit(problem: Composed, effects: Sequence[EffectBase], start: Mapping[str, float]) -> Fit | None:
    """Fit the nominal parameters and those of some effects, and predict the held-out recordings.

    Parameters
    ----------
    problem : Composed
    effects : sequence of EffectBase
    start : mapping of str to float
        Where unknowns begin; a start that cannot be rolled out is drawn back towards neutral effects.

    Returns
    -------
    Fit or None
        None where the model cannot be rolled out at all.
    """
    own = problem.freeing(effects)
    neutral = {name: value for effect in effects for name, value in effect.neutral.items()}
    x = own.unknowns(start)
    for pull in (1.0, 0.5, 0.2, 0.05, 0.0):
        drawn = {name: value + pull * (start.get(name, value) - value) for name, value in neutral.items()}
        x = own.unknowns({**start, **drawn})
        if own.evaluate(x, derivatives=False).ok:
            break
    else:
        return None
    outcome = SOLVER.run(own, x, None)
    finish = own.evaluate(outcome.x)
    if not finish.ok:
        return None
    deviation = deviations(own, finish)
    std = dict(zip(own.names, map(float, deviation), strict=True))
    loss = held_out_loss(own, outcome.x)
    return Fit(tuple(effects), own, own.named(outcome.x), std, finish.cost, finish, loss, outcome.message)


def deviations(problem: Composed, finish: Evaluation) -> Array:
    """Standard deviation of every unknown, shape (nx,): the larger of two.

    The first scales (J'J)^-1 by chi2 per degree of freedom; the second is the sandwich (J'J)^-1 S (J'J)^-1 with the
    scores' autocovariances in S, which knows that samples of a coloured residual repeat each other.
    """
    covariance, _ = uncertainty(problem, finish)
    plain = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if finish.jacobian is None or not plain.size:
        return plain
    rows = len(finish.residual) - problem.tie_break_rows
    scale = problem.scales
    jacobian = finish.jacobian[:rows] * scale
    inverse = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-10, hermitian=True)
    middle = robust(jacobian, finish.residual[:rows], residual_series(problem))
    return np.maximum(plain, scale * np.sqrt(np.maximum(np.diag(inverse @ middle @ inverse), 0.0)))


def refit_all(
    problem: Composed,
    base: Sequence[EffectBase],
    tried: Sequence[tuple[EffectBase, Mapping[str, float]]],
    values: Mapping[str, float],
    progress: Callable[[str], None] | None = None,
) -> list[Fit]:
    """Refit the model with each of several effects added to those of `base`, two at a time; failures are left out."""

    def one(entry: tuple[EffectBase, Mapping[str, float]]) -> Fit | None:
        effect, step = entry
        fit = refit(problem, (*base, effect), {**values, **step})
        if progress is not None and fit is not None:
            progress(f"refitted with {effect.label}: held-out chi2/n {fit.loss.mean:.4g}")
        return fit

    with ThreadPoolExecutor(max_workers=min(2, os.cpu_count() or 1)) as pool:
        return [fit for fit in pool.map(one, tried) if fit is not None]


def block_length(problem: Composed) -> float:
    """Length of the blocks of held-out time [s]: some forty of them, between half a second and two seconds long."""
    total = sum(episode.grid.steps * episode.grid.time_step for episode in problem.held_out)
    return float(np.clip(total / 40, 0.5, 2.0))


def held_out_loss(problem: Composed, x: Array) -> Loss:
    """Predict the held-out recordings; initial states are found in the same way for every model."""
    length = block_length(problem)
    squares: list[Array] = []
    counts: list[Array] = []
    results, episodes = [], []
    for episode, result in problem.validate(x):
        number = int(episode.grid.steps * episode.grid.time_step / length) + 1
        total, count = np.zeros(number), np.zeros(number)
        for k, samples in enumerate(episode.samples):
            block = np.minimum((sample_times(episode, samples) / length).astype(int), number - 1)
            good = samples.weight > 0
            count += np.bincount(block, good.sum(axis=1), number)
            if not isinstance(result, str):
                r = samples.weight * np.where(good, result.predicted[k] - samples.value, 0.0)
                total += np.bincount(block, np.sum(r**2, axis=1), number)
        if isinstance(result, str):
            total[:] = np.inf
        else:
            results.append(result)
            episodes.append(episode)
        keep = count > 0
        squares.append(total[keep])
        counts.append(count[keep])
    errors = problem.channel_errors(results, episodes) if results else {}
    channels = {name: (float(entry["rmse"]), str(entry["unit"])) for name, entry in errors.items()}
    return Loss(np.concatenate(squares), np.concatenate(counts), channels)


def closure(before: Loss, after: Loss, seed: int = 0) -> Closure:
    """Part of the held-out gap that is closed, with a block-bootstrap interval."""
    if before.gap <= 0 or not np.isfinite(after.mean):
        return Closure(float("nan"), float("nan"), float("nan"))
    rng = np.random.default_rng(seed)
    draws = rng.integers(0, len(before.counts), (RESAMPLES, len(before.counts)))
    n = before.counts[draws].sum(axis=1)
    g0 = np.maximum(before.squares[draws].sum(axis=1) / n - 1.0, 0.0)
    g1 = np.maximum(after.squares[draws].sum(axis=1) / n - 1.0, 0.0)
    ratio = 1 - g1[g0 > 0] / g0[g0 > 0]
    low, high = np.quantile(ratio, [0.025, 0.975]) if len(ratio) else (float("nan"), float("nan"))
    return Closure(1 - after.gap / before.gap, float(low), float(high))


def gain(before: Loss, after: Loss) -> tuple[float, float]:
    """Held-out chi2/n that `after` is better by, and its standard error over blocks."""
    total = float(before.counts.sum())
    difference = before.squares - after.squares
    if not np.all(np.isfinite(difference)):
        return (-np.inf if np.isfinite(before.mean) else np.inf), 0.0
    count = len(difference)
    error = np.sqrt(count) * float(np.std(difference, ddof=1)) if count > 1 else np.inf
    return float(difference.sum()) / total, float(error) / total


def within_reach(fits: Sequence[Fit]) -> list[Fit]:
    """Fits whose held-out loss is within one standard error of the best one's (or `TIE` of it), the simplest first."""
    best = min(fits, key=lambda fit: fit.loss.mean)
    near = []
    for fit in fits:
        lost, error = gain(fit.loss, best.loss)
        if fit is best or lost <= max(error, TIE * best.loss.mean):
            near.append(fit)
    return sorted(near, key=lambda fit: (fit.size, fit.loss.mean))

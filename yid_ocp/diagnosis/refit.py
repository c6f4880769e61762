"""Step six: full refits of the nominal parameters and those of some effects, judged on held-out recordings.

Every loss is a mean square of whitened residuals over blocks of held-out time, the same blocks for every model, so that
differences between models are paired. G = max(0, chi2/n - 1) is the gap.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

from yid_ocp.diagnosis.hypotheses import CandidateProblem, describe
from yid_ocp.diagnosis.thresholds import DEFAULTS, Thresholds
from yid_ocp.effects import EffectBase, Reported
from yid_ocp.parallel import map_in_step
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.evaluation import Evaluation, WarmStart
from yid_ocp.problem.null_test import sample_times
from yid_ocp.problem.torque_offsets import torques_apart
from yid_ocp.problem.validation import channel_errors
from yid_ocp.progress import Parts, Progress
from yid_ocp.solvers import GaussNewton, Status
from yid_ocp.solvers.base import Outcome
from yid_ocp.solvers.judgement import covariance_of_fit, judge_fit, plain_std

Array = NDArray[np.float64]

SOLVER = GaussNewton(iterations=25, step_tolerance=1e-3, cost_tolerance=1e-5)
"""A refit starts near its end and must be good to a small part of its standard deviation, and of the `tie`, only."""
UNTOLD = 100.0
"""A standard deviation so many times the range in which an engineer would expect a parameter tells nothing of it."""
FAR = 1.0
"""Stated standard deviations of a torque's offset; an effect that takes more of it is fitted once more."""


@dataclass(frozen=True)
class Loss:
    """Whitened squared prediction error of a model on the held-out recordings, by block of time.

    Attributes
    ----------
    squares, counts : ndarray, shape (nb,)
        Sum of whitened squares and number of samples of every block; infinite where a rollout failed.
    channels : dict of channel to (float, str)
        Root mean square error and its unit.
    known : float
        Squares by which the parameters contradict a baseline; other recordings say that, whatever blocks are drawn.
    """

    squares: Array
    counts: Array
    channels: dict[str, tuple[float, str]]
    known: float = 0.0

    @property
    def mean(self) -> float:
        """chi2/n, the contradiction to a baseline counted in."""
        return float((self.squares.sum() + self.known) / max(self.counts.sum(), 1.0))

    @property
    def gap(self) -> float:
        """G."""
        return max(0.0, self.mean - 1.0)


@dataclass(frozen=True)
class Fit:
    """The nominal model with some effects, fitted again, with its standard deviations and held-out loss.

    Attributes
    ----------
    effects : tuple of EffectBase
    problem : EstimationProblem
        Of the composed system, with the nominal parameters and those of the effects free.
    values : dict of str to float
        Unknowns.
    std : dict of str to float
        Their standard deviations; see `refit_covariance`.
    amplitude_std : dict of str to float
        Of the effects' amplitudes, with their shapes held; see `amplitude_std`.
    cost : float
    evaluation : Evaluation
    loss : Loss
        Held-out.
    message : str
        Why the solver ended.
    resumed : bool
        Whether it comes from a store instead of the solver.
    """

    effects: tuple[EffectBase, ...]
    problem: EstimationProblem
    values: dict[str, float]
    std: dict[str, float]
    amplitude_std: dict[str, float]
    cost: float
    evaluation: Evaluation
    loss: Loss
    message: str
    resumed: bool = False

    @property
    def size(self) -> int:
        """Number of the effects' parameters."""
        return sum(len(effect.parameters) for effect in self.effects)

    def reported(self, effect: EffectBase) -> dict[str, Reported]:
        """Return an effect's parameters in reported units, with standard deviations."""
        return effect.reported(self.values, self.std)


@dataclass(frozen=True)
class Refitted:
    """The result of a refit as stored: one evaluation restores its `Fit`.

    Attributes
    ----------
    values, std : dict of str to float
        Of every unknown.
    amplitude_std : dict of str to float
        Of amplitudes; see `Fit`.
    message : str
    """

    values: dict[str, float]
    std: dict[str, float]
    amplitude_std: dict[str, float]
    message: str


class Store(Protocol):
    """Store of finished refits of one diagnosis, which an interrupted diagnosis reads; called by two threads."""

    def get(self, name: str) -> Refitted | None:
        """The refit of this name, None where it is not known."""
        ...

    def put(self, name: str, refitted: Refitted) -> None:
        """Keep a refit."""
        ...


@dataclass(frozen=True)
class Search:
    """Problem, thresholds, progress and store shared by all refits of one diagnosis.

    Attributes
    ----------
    problem : CandidateProblem
    limits : Thresholds
    progress : Progress
        Told what is going on.
    store : Store, optional
    """

    problem: CandidateProblem
    limits: Thresholds
    progress: Progress
    store: Store | None = None


def refit(
    problem: CandidateProblem,
    effects: Sequence[EffectBase],
    start: Mapping[str, float],
    store: Store | None = None,
    name: str = "",
    limits: Thresholds = DEFAULTS,
) -> Fit | None:
    """Fit the nominal parameters and those of some effects, and predict the held-out recordings.

    Parameters
    ----------
    problem : CandidateProblem
    effects : sequence of EffectBase
    start : mapping of str to float
        Where unknowns begin; a start that cannot be rolled out is drawn back towards neutral effects.
    store : Store, optional
        Asked before the solver is, and told what it finds.
    name : str
        In the store; the effects' labels where empty, which do for refits that differ by their effects alone.
    limits : Thresholds
        For when a refit is tried again.

    Returns
    -------
    Fit or None
        None where the model cannot be rolled out at all.
    """
    known = recalled(problem, effects, store, name)
    if known is not None:
        return known
    best = _attempt(problem, effects, start)
    if best is not None and _half_done(problem, effects, start, best.finish, limits):
        # the nominal fit may have driven its parameters to where this model cannot come back from
        nominal = {*problem.nominal}
        fresh = {
            key: value
            for key, value in start.items()
            if key.split("[")[0] not in nominal and not key.startswith("start.")
        }
        again = _attempt(problem, effects, fresh) if len(fresh) < len(start) else None
        best = again if again is not None and again.finish.cost < best.finish.cost else best
    # those before it were found from both already
    for effect in effects[-1:]:
        moved = effect.elsewhere(start)
        if moved is None or (best is not None and _leaves_noise(best.finish, limits)):
            continue
        again = _attempt(problem, effects, {**start, **moved})
        if again is not None and (best is None or again.finish.cost < best.finish.cost):
            best = again
    if best is None:
        return None
    outcome, finish = best.outcome, best.finish
    values = best.problem.named(outcome.x)
    own = problem.held_out_placed(best.problem, effects, values)
    covariance = refit_covariance(own, finish, limits)
    std = told(effects, own.named(plain_std(covariance, outcome.x)))
    held = told(effects, amplitude_std(own.names, effects, covariance))
    loss = held_out_loss(own, outcome.x)
    if store is not None:
        store.put(name or describe(effects), Refitted(values, std, held, outcome.message))
    return Fit(tuple(effects), own, values, std, held, finish.cost, finish, loss, outcome.message)


@dataclass(frozen=True)
class _Attempt:
    """Where a run ended, and the problem that it solved, its filters about the torques that are seen there."""

    problem: EstimationProblem
    outcome: Outcome
    finish: Evaluation


class _Following(EstimationProblem):
    """A problem whose filters are about the torques that are seen wherever it is evaluated, from the last place on."""

    def __init__(self, problem: EstimationProblem) -> None:
        vars(self).update(vars(problem))
        self._last = problem

    def evaluate(self, x: ArrayLike, derivatives: bool = True, warm: WarmStart | None = None) -> Evaluation:
        """Evaluate residual and Jacobian about the torques estimated at `x`."""
        x = np.asarray(x, float)
        self._last = self._last.about_torques_at(x, x)
        return self._last.evaluate(x, derivatives, warm)


def _half_done(
    problem: CandidateProblem,
    effects: Sequence[EffectBase],
    start: Mapping[str, float],
    finish: Evaluation,
    limits: Thresholds,
) -> bool:
    """Whether a refit explains much of what the model without the effects leaves, but by far not all."""
    own, count = problem.freeing(effects), len(finish.residual)
    neutral = {name: value for effect in effects for name, value in effect.neutral.items()}
    before = own.evaluate(own.vector({**start, **neutral}), False, finish.warm)
    if 2 * finish.cost < limits.poor * count or not before.ok:
        return False
    return before.cost - finish.cost > limits.promising * (before.cost - count / 2)


def _leaves_noise(finish: Evaluation, limits: Thresholds) -> bool:
    """Whether a refit leaves no more than noise may, so that no other place can be better."""
    return float(chi2.sf(2 * finish.cost, len(finish.residual))) >= limits.level


def _attempt(problem: CandidateProblem, effects: Sequence[EffectBase], start: Mapping[str, float]) -> _Attempt | None:
    """One run from one start; None where the model cannot be rolled out."""
    neutral = {name: value for effect in effects for name, value in effect.neutral.items()}
    own = problem.placed(effects, start)
    for pull in (1.0, 0.5, 0.2, 0.05, 0.0):
        drawn = {name: value + pull * (start.get(name, value) - value) for name, value in neutral.items()}
        outcome = SOLVER.run(own, own.vector({**start, **drawn}), None)
        if outcome.status != Status.FAILED:
            break
    found = _seen(problem, effects, outcome)
    # without effects all weights are frozen anew where it ends
    if found is None or not effects or torques_apart(problem.problem.innovations, found.problem.innovations) < FAR:
        return found
    # about fixed torques a run stops where the effect and an offset that it makes superfluous hold each other
    outcome = SOLVER.run(_Following(found.problem), outcome.x, None)
    again = None if outcome.status == Status.FAILED else _seen(problem, effects, outcome)
    return again if again is not None and again.finish.cost < found.finish.cost else found


def _seen(problem: CandidateProblem, effects: Sequence[EffectBase], outcome: Outcome) -> _Attempt | None:
    """Where a run ended, about the torques that are seen there."""
    placed = problem.placed(effects, problem.freeing(effects).named(outcome.x))
    finish = placed.evaluate(outcome.x, warm=outcome.warm)
    return _Attempt(placed, outcome, finish) if finish.ok else None


def recalled(
    problem: CandidateProblem, effects: Sequence[EffectBase], store: Store | None, name: str = ""
) -> Fit | None:
    """Return a refit from the store, evaluated once; None if the store does not have it."""
    known = None if store is None else store.get(name or describe(effects))
    own = problem.freeing(effects)
    amplitudes = {name for effect in effects for name in effect.amplitudes}
    if known is None or not set(known.values) == set(known.std) == set(own.names):
        return None
    if set(known.amplitude_std) != amplitudes:
        return None
    own = problem.placed(effects, known.values)
    x = own.vector(known.values)
    finish = own.evaluate(x)
    if not finish.ok:
        return None
    own = problem.held_out_placed(own, effects, known.values)
    loss = held_out_loss(own, x)
    spread = known.std, known.amplitude_std
    return Fit(tuple(effects), own, known.values, *spread, finish.cost, finish, loss, known.message, True)


def refit_covariance(problem: EstimationProblem, finish: Evaluation, limits: Thresholds = DEFAULTS) -> Array:
    """Covariance of the unknowns, shape (nx, nx), inflated by the misfit as in `solve`."""
    return covariance_of_fit(problem, finish, judge_fit(problem, finish, limits.gap))


def amplitude_std(names: Sequence[str], effects: Sequence[EffectBase], covariance: Array) -> dict[str, float]:
    """Standard deviations of the effects' amplitudes with their shape parameters held at their estimates.

    Next to nothing an effect has any shape: that of a weak spring is a rest angle as far away as one likes. Whether it
    is there at all is asked with its shape held (Davies 1987, doi:10.1093/biomet/74.1.33).
    """
    found = {}
    for effect in effects if len(covariance) else ():
        shapes = [names.index(name) for name in effect.shapes]
        for name in effect.amplitudes:
            i = names.index(name)
            own, along, other = covariance[i, i], covariance[shapes, i], covariance[np.ix_(shapes, shapes)]
            if np.isfinite(along).all() and np.isfinite(other).all():
                own = own - along @ np.linalg.pinv(other, hermitian=True) @ along
            found[name] = math.inf if np.isnan(own) else math.sqrt(max(float(own), 0.0))
    return found


def told(effects: Sequence[EffectBase], std: Mapping[str, float]) -> dict[str, float]:
    """Standard deviations, infinite where larger than `UNTOLD` times the width of the prior range."""
    width = {name: high - low for effect in effects for name, (low, high) in effect.prior_range.items()}
    return {name: math.inf if size > UNTOLD * width.get(name, math.inf) else size for name, size in std.items()}


def refit_all(
    search: Search,
    base: Sequence[EffectBase],
    tried: Sequence[tuple[EffectBase, Mapping[str, float]]],
    values: Mapping[str, float],
    where: str = "",
) -> list[Fit]:
    """Refit the model with each of several effects added to those of `base`; return the refits that succeed.

    Parameters
    ----------
    search : Search
    base : sequence of EffectBase
    tried : sequence of (EffectBase, mapping of parameter to float)
        With the values at which each begins.
    values : mapping of str to float
        Where all other unknowns begin.
    where : str
        What is said of `values` in the store, if the same effects are refitted from elsewhere too.
    """
    beside = f" beside {', '.join(effect.label for effect in base)}" if base else ""
    entries = [_Tried((*base, effect), effect.label, step, where) for effect, step in tried]
    return _each(search, entries, values, f"{len(tried)} effects{beside}")


def refit_pairs(
    search: Search,
    tried: Sequence[tuple[tuple[EffectBase, EffectBase], Mapping[str, float]]],
    values: Mapping[str, float],
) -> list[Fit]:
    """Refit the model with each of several pairs of effects; return the refits that succeed."""
    entries = [_Tried(pair, describe(pair), step, "together") for pair, step in tried]
    return _each(search, entries, values, f"{len(tried)} pairs")


@dataclass(frozen=True)
class _Tried:
    effects: tuple[EffectBase, ...]
    label: str  # of those that are new
    step: Mapping[str, float]
    where: str


def _each(search: Search, tried: Sequence[_Tried], values: Mapping[str, float], words: str) -> list[Fit]:
    if not tried:
        return []
    search.progress.stage(f"refitting with each of {words}")
    parts = Parts(search.progress, len(tried), tried[0].label)

    def one(entry: _Tried) -> Fit | None:
        name = f"{describe(entry.effects)} {entry.where}" if entry.where else ""
        fit = refit(search.problem, entry.effects, {**values, **entry.step}, search.store, name, search.limits)
        text = f"no fit with {entry.label}"
        if fit is not None:
            how = "resumed the refit" if fit.resumed else "refitted"
            text = f"{how} with {entry.label}: held-out chi2/n {fit.loss.mean:.4g}"
        parts.done(text)
        return fit

    return [fit for fit in map_in_step(one, tried) if fit is not None]


def block_length(episodes: Sequence[Episode]) -> float:
    """Length of the blocks of held-out time [s]: about forty blocks, each 0.5 s to 2 s long."""
    total = sum(episode.grid.steps * episode.grid.time_step for episode in episodes)
    return float(np.clip(total / 40, 0.5, 2.0))


def held_out_loss(problem: EstimationProblem, x: Array) -> Loss:
    """Return the loss of a model on the held-out recordings; initial states are found alike for every model."""
    length = block_length(problem.held_out)
    squares: list[Array] = []
    counts: list[Array] = []
    found = problem.validate(x)
    for i, (episode, result) in enumerate(found):
        number = int(episode.grid.steps * episode.grid.time_step / length) + 1
        blocks = []
        for samples in episode.samples:
            block = np.minimum((sample_times(episode, samples) / length).astype(int), number - 1)
            blocks.append(np.broadcast_to(block.reshape(len(block), -1), samples.seen.shape)[samples.seen])
        of_row = np.concatenate(blocks)
        count = np.bincount(of_row, minlength=number).astype(float)
        if isinstance(result, str):
            total = np.full(number, np.inf)
        else:
            total = np.bincount(
                of_row, weights=problem.held_out_rows(i, episode, result).residual ** 2, minlength=number
            )
        keep = count > 0
        squares.append(total[keep])
        counts.append(count[keep])
    if problem.disturbed:
        # in metres and radians a prediction has its torques as they were recorded, less their offsets
        found = problem.weighted_by_sensors().validate(x)
    predicted = [(result, episode) for episode, result in found if not isinstance(result, str)]
    errors = channel_errors(*map(list, zip(*predicted, strict=True))) if predicted else {}
    channels = {name: (float(entry["rmse"]), str(entry["unit"])) for name, entry in errors.items()}
    return Loss(np.concatenate(squares), np.concatenate(counts), channels, _contradiction(problem, x))


def _contradiction(problem: EstimationProblem, x: Array) -> float:
    """Squares of the joint prior's rows."""
    joint = problem.options.joint_prior.of(problem.shared)
    at = [problem.names.index(name) for name in joint.names]
    apart = (x - problem.start)[at]
    return float(apart @ np.linalg.solve(joint.covariance, apart)) if at else 0.0

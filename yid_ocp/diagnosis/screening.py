"""Screening: detectability and score test of every candidate from one sensitivity sweep (steps three and five).

With r the whitened residual of the nominal fit, J_theta its sensitivity to what that fit frees, J_j that to the
amplitudes of candidate j and P = I - J_theta J_theta^+:

    G_j = J_j' P J_j,  s_j = -J_j' P r,  LM_j = s_j' S_j^-1 s_j,

S_j = G_j for white noise of unit standard deviation, and the sum of the scores' autocovariances for a coloured one,
taken as it would be with the candidate's step done (Bartlett's weights, Newey and West 1987, doi:10.2307/1913610). The
decrease of r'r that the linear model promises is s_j' G_j^-1 s_j, less where the amplitude would leave its bounds.

Parameters that say nothing while the amplitude is neutral (relaxation times and the like) are taken over a grid, the
best one counting as the best of that many tries (Davies 1987, doi:10.1093/biomet/74.1.33, bounded by Bonferroni).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.signal
import scipy.stats
from numpy.typing import NDArray

from yid_ocp.diagnosis.hypotheses import CandidateProblem
from yid_ocp.diagnosis.thresholds import DEFAULTS, Thresholds
from yid_ocp.effects import EffectBase
from yid_ocp.errors import SolverError
from yid_ocp.problem.null_test import Series, residual_series

Array = NDArray[np.float64]

EQUAL = 1e-6
"""Relative difference of promised decreases that rounding can make."""


@dataclass(frozen=True)
class Signature:
    """First-order change of the residual by the amplitudes of a candidate.

    Attributes
    ----------
    effect : EffectBase
    shape : dict of str to float
        Values of its shape parameters.
    columns : ndarray, shape (nr, p)
        P J_j, by its amplitudes.
    noise : ndarray, shape (p, p)
        Covariance of `columns'` r under the noise's own colour.
    """

    effect: EffectBase
    shape: dict[str, float]
    columns: Array
    noise: Array


@dataclass(frozen=True)
class Linearisation:
    """Residual and signatures of all candidates, linearised at one point.

    Attributes
    ----------
    residual : ndarray, shape (nr,)
        P r.
    signatures : tuple of Signature
        One for each candidate and grid value.
    values : dict of str to float
        Where it was taken.
    """

    residual: Array
    signatures: tuple[Signature, ...]
    values: dict[str, float]


@dataclass(frozen=True)
class Visibility:
    """Smallest detectable amplitudes of a candidate, from sensitivity and noise alone.

    Attributes
    ----------
    effect : EffectBase
    detectable : dict of amplitude to float
        Smallest value that would be noticed, in the parameter's unit.
    visible : bool
        Whether one of them lies within the range that an engineer would expect.
    """

    effect: EffectBase
    detectable: dict[str, float]
    visible: bool


@dataclass(frozen=True)
class Score:
    """Score test (Lagrange multiplier) of a candidate on the residual.

    Attributes
    ----------
    effect : EffectBase
    step : dict of str to float
        Amplitudes to which the linear model would go, and the shape values.
    decrease : float
        Promised decrease of r'r.
    statistic : float
        LM with robust covariance.
    p_value : float
    """

    effect: EffectBase
    step: dict[str, float]
    decrease: float
    statistic: float
    p_value: float


def shape_grid(effect: EffectBase, count: int = DEFAULTS.shape_values) -> list[dict[str, float]]:
    """Return grid values of a candidate's shape parameters, uniform or log-uniform over the prior range."""
    if not effect.shapes:
        return [{}]
    axes = []
    for name in effect.shapes:
        low, high = effect.prior_range[name]
        axes.append(np.geomspace(low, high, count) if low > 0 else np.linspace(low, high, count))
    return [{name: float(axis[i]) for name, axis in zip(effect.shapes, axes, strict=True)} for i in range(count)]


def linearise(
    problem: CandidateProblem,
    base: Sequence[EffectBase],
    values: Mapping[str, float],
    grid: int = DEFAULTS.shape_values,
) -> Linearisation:
    """Return the residual and the signatures of all candidates that are not yet in the model.

    Parameters
    ----------
    problem : CandidateProblem
    base : sequence of EffectBase
        In the model, with all their parameters free.
    values : mapping of str to float
        Unknowns of the fit.
    grid : int
        Values of every shape parameter.

    Raises
    ------
    SolverError
        The model cannot be rolled out there.
    """
    labels = {effect.label for effect in base}
    others = [effect for effect in problem.effects if effect.label not in labels]
    grids = {effect.label: shape_grid(effect, grid) for effect in others}
    own = [name for effect in base for name in effect.parameters.names]
    residual, basis = np.zeros(0), np.zeros((0, 0))
    placed, series = problem.placed(base, values), residual_series(problem.problem)
    warm = None
    signatures: list[Signature] = []
    for k in range(max((len(g) for g in grids.values()), default=0)):
        chosen = [effect for effect in others if k < len(grids[effect.label])]
        shape = {name: value for effect in chosen for name, value in grids[effect.label][k].items()}
        amplitudes = [name for effect in chosen for name in effect.amplitudes]
        trial = placed.freeing((*problem.nominal, *own, *amplitudes)).at(shape)
        evaluation = trial.evaluate(trial.vector(values), warm=warm)
        if not evaluation.ok or evaluation.jacobian is None:
            raise SolverError(f"the model cannot be linearised: {evaluation.message}", where="diagnosis")
        names, warm = list(trial.names), evaluation.warm
        places = [names.index(name) for name in amplitudes]
        rest = np.setdiff1d(np.arange(len(names)), places)
        data, jacobian = trial.informing(evaluation)
        if k == 0:
            basis = _basis(jacobian[:, rest])
            residual = data - basis @ (basis.T @ data)
        moved = jacobian[:, places]
        moved = moved - basis @ (basis.T @ moved)
        at = 0
        for effect in chosen:
            width = len(effect.amplitudes)
            columns = np.ascontiguousarray(moved[:, at : at + width])
            signatures.append(Signature(effect, grids[effect.label][k], columns, _coloured(columns, series)))
            at += width
    return Linearisation(residual, tuple(signatures), dict(values))


def _basis(matrix: Array) -> Array:
    """Orthonormal basis of the columns, those that depend on others left out."""
    size = np.linalg.norm(matrix, axis=0)
    scaled = matrix[:, size > 0] / size[size > 0]
    u, singular, _ = np.linalg.svd(scaled, full_matrices=False)
    return np.asarray(u[:, singular > 1e-7 * max(singular.max(initial=0.0), 1e-300)])


def visibility(point: Linearisation, detection: float = DEFAULTS.detection) -> tuple[Visibility, ...]:
    """Return the detectability of every candidate: amplitudes of `detection` standard deviations, from J and noise."""
    found: dict[str, Visibility] = {}
    for signature in point.signatures:
        effect = signature.effect
        information = signature.columns.T @ signature.columns
        noise = signature.noise
        inverse = np.linalg.pinv(information, rcond=1e-10, hermitian=True)
        covariance = inverse @ noise @ inverse
        detectable = {}
        visible = False
        for i, name in enumerate(effect.amplitudes):
            informed = information[i, i] > 1e-16
            size = detection * float(np.sqrt(max(covariance[i, i], 0.0))) if informed else float("inf")
            detectable[name] = size
            quantity = next(q for q in effect.quantities if name.endswith(f".{q.name}"))
            visible |= size < max(abs(bound - quantity.neutral) for bound in effect.prior_range[name])
        best = found.get(effect.label)
        if best is None or (visible and not best.visible) or min(detectable.values()) < min(best.detectable.values()):
            found[effect.label] = Visibility(effect, detectable, visible or (best is not None and best.visible))
    return tuple(found.values())


def _coloured(columns: Array, series: Sequence[Series]) -> Array:
    """X' Omega X under the noise's known colour."""
    total = np.zeros((columns.shape[1], columns.shape[1]))
    size = float(np.max(np.abs(columns), initial=0.0))
    for s in series:
        x = columns[s.rows]
        if not np.any(np.abs(x) > 1e-6 * size):
            continue
        if len(s.colour) > 1:
            both = np.concatenate([s.colour[:0:-1], s.colour])[:, None]
            total += x.T @ scipy.signal.oaconvolve(x, both, mode="full", axes=0)[len(s.colour) - 1 :][: len(x)]
        else:
            total += x.T @ x
    return (total + total.T) / 2


def robust(columns: Array, residual: Array, series: Sequence[Series]) -> Array:
    """Return the Newey-West covariance of X' r for a residual of unknown autocorrelation, shape (p, p).

    Bartlett's weights of L = sqrt(M) lags are the mean square of the sums over all windows of that length.
    """
    total = np.zeros((columns.shape[1], columns.shape[1]))
    for s in series:
        u = columns[s.rows] * residual[s.rows, None]
        length = int(np.sqrt(len(u))) + 1
        cumulative = np.vstack([np.zeros((length, u.shape[1])), np.cumsum(u, axis=0)])
        cumulative = np.vstack([cumulative, np.tile(cumulative[-1], (length - 1, 1))])
        sums = cumulative[length:] - cumulative[:-length]
        total += sums.T @ sums / length
    return total


def scores(point: Linearisation, series: Sequence[Series], visible: Sequence[Visibility]) -> tuple[Score, ...]:
    """Return the score of every detectable candidate, largest predicted decrease of r'r first."""
    seen = {entry.effect.label for entry in visible if entry.visible}
    best: dict[str, Score] = {}
    tries: dict[str, int] = {}
    for signature in point.signatures:
        label = signature.effect.label
        if label not in seen:
            continue
        tries[label] = tries.get(label, 0) + 1
        score = _score(signature, point.residual, series)
        # shape values that make no difference are told apart by nothing but rounding: the first one stays
        if label not in best or score.decrease > best[label].decrease * (1 + EQUAL):
            best[label] = score
    final = [
        Score(s.effect, s.step, s.decrease, s.statistic, min(1.0, s.p_value * tries[label]))
        for label, s in best.items()
    ]
    return tuple(sorted(final, key=lambda s: -s.decrease))


def best_of(ranked: Sequence[Score]) -> float:
    """Return the Bonferroni-corrected smallest p-value of the candidates; 1 if there are none."""
    return min((score.p_value for score in ranked), default=1.0) * max(len(ranked), 1)


def _room(effect: EffectBase) -> tuple[Array, Array]:
    """How far amplitudes may go from neutral, to either side."""
    quantities = {f"{effect.label}.{q.name}": q for q in effect.quantities}
    own = [quantities[name] for name in effect.amplitudes]
    return np.array([q.lower - q.neutral for q in own]), np.array([q.upper - q.neutral for q in own])


def _promised(information: Array, slope: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """The linear model's step within bounds and the decrease of r'r by it; of one, or of a stack of them."""
    plain = (np.linalg.pinv(information, rcond=1e-10, hermitian=True) @ slope[..., None])[..., 0]
    step = np.clip(plain, lower, upper)
    return step, np.sum((2 * slope - (information @ step[..., None])[..., 0]) * step, axis=-1)


def _score(signature: Signature, residual: Array, series: Sequence[Series]) -> Score:
    effect, x = signature.effect, signature.columns
    slope = -(x.T @ residual)
    lower, upper = _room(effect)
    step, decrease = _promised(x.T @ x, slope, lower, upper)
    # the candidate's own share of the residual would hide it: what would be left is what its score scatters with
    covariance = robust(x, residual + x @ step, series)
    floor = signature.noise
    # a residual below the noise must not make a score look sure
    covariance = covariance if np.trace(covariance) > np.trace(floor) else floor
    statistic = float(slope @ np.linalg.pinv(covariance, rcond=1e-10, hermitian=True) @ slope)
    p_value = float(scipy.stats.chi2.sf(statistic, len(step)))
    if len(step) == 1 and lower[0] == 0:
        if step[0] <= 0:
            statistic, p_value = 0.0, 1.0
        p_value = p_value / 2 if statistic > 0 else 1.0
    return Score(effect, _values(effect, step) | signature.shape, max(float(decrease), 0.0), statistic, p_value)


def _values(effect: EffectBase, step: Array) -> dict[str, float]:
    """Amplitudes a step from neutral."""
    neutral = effect.neutral
    return {name: neutral[name] + float(moved) for name, moved in zip(effect.amplitudes, step, strict=True)}


@dataclass(frozen=True)
class Confusability:
    """Fractions of each candidate's signature that the others explain.

    Attributes
    ----------
    labels : tuple of str
    matrix : ndarray, shape (nj, nj)
        Fraction of row j's signature that column i's can explain, beyond what the nominal parameters can.
    """

    labels: tuple[str, ...]
    matrix: Array

    def like(self, label: str, limit: float) -> tuple[str, ...]:
        """Return the candidates that explain at least the fraction `limit` of one candidate's signature."""
        row = self.matrix[self.labels.index(label)]
        return tuple(n for n, f in zip(self.labels, row, strict=True) if f >= limit and n != label)


@dataclass(frozen=True)
class Pair:
    """First-order decrease of the residual by two candidates together.

    Attributes
    ----------
    effects : tuple of EffectBase
    step : dict of str to float
        Amplitudes to which the linear model would go, and the shape values.
    decrease : float
        Promised decrease of r'r.
    worth : float
        The decrease beyond what chance alone brings by so many amplitudes.
    """

    effects: tuple[EffectBase, EffectBase]
    step: dict[str, float]
    decrease: float
    worth: float


@dataclass(frozen=True)
class Together:
    """Joint linear model of the residual in the amplitudes of all candidates, each at one shape value.

    Attributes
    ----------
    effects : tuple of EffectBase
    shapes : tuple of dict of str to float
    information : ndarray, shape (n, n)
        X'X of all signatures side by side.
    slope : ndarray, shape (n,)
        -X'r.
    """

    effects: tuple[EffectBase, ...]
    shapes: tuple[dict[str, float], ...]
    information: Array
    slope: Array

    @property
    def blocks(self) -> list[slice]:
        """Columns of every candidate."""
        edges = np.cumsum([0, *(len(effect.amplitudes) for effect in self.effects)])
        return [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]

    def pairs(self, among: Sequence[str]) -> Iterator[Pair]:
        """Yield all pairs of some candidates, largest penalised decrease first.

        What two effects do together neither need do alone: one of them may hide in what the other leaves.

        Parameters
        ----------
        among : sequence of str
            Labels.
        """
        bounds = [_room(effect) for effect in self.effects]
        lower, upper = (np.concatenate([np.zeros(0), *(entry[k] for entry in bounds)]) for k in (0, 1))
        columns = [np.arange(block.start, block.stop) for block in self.blocks]
        wanted = set(among)
        by_size: dict[tuple[int, int], list[tuple[int, int]]] = {}
        for i, j in itertools.combinations([i for i, e in enumerate(self.effects) if e.label in wanted], 2):
            by_size.setdefault((len(columns[i]), len(columns[j])), []).append((i, j))
        found: list[tuple[float, float, int, int, Array]] = []
        for members in by_size.values():
            at = np.array([[*columns[i], *columns[j]] for i, j in members])
            information, slope = self.information[at[:, :, None], at[:, None, :]], self.slope[at]
            steps, decrease = _promised(information, slope, lower[at], upper[at])
            worth = decrease - at.shape[1]
            found += [(w, d, *both, s) for w, d, both, s in zip(worth, decrease, members, steps, strict=True)]
        for worth, promised, i, j, step in sorted(found, key=lambda entry: -entry[0]):
            (one, other), width = (self.effects[i], self.effects[j]), len(columns[i])
            values = _values(one, step[:width]) | _values(other, step[width:])
            yield Pair((one, other), values | self.shapes[i] | self.shapes[j], float(promised), float(worth))


def together(point: Linearisation, chosen: Sequence[Score] = ()) -> Together:
    """Return the joint linear model of all candidates, at the scores' shape values or the middle of the grid."""
    shape = {s.effect.label: {k: v for k, v in s.step.items() if k in s.effect.shapes} for s in chosen}
    groups: dict[str, list[Signature]] = {}
    for signature in point.signatures:
        groups.setdefault(signature.effect.label, []).append(signature)
    kept = []
    for label, group in groups.items():
        wanted = shape.get(label)
        kept.append(next((s for s in group if s.shape == wanted), group[len(group) // 2]))
    every = np.hstack([s.columns for s in kept]) if kept else np.zeros((len(point.residual), 0))
    effects, shapes = tuple(s.effect for s in kept), tuple(s.shape for s in kept)
    return Together(effects, shapes, every.T @ every, -(every.T @ point.residual))


def confusability(everything: Together) -> Confusability:
    """Return the matrix of signature fractions that candidates explain, amplitudes scaled by prior range."""
    ranges = [effect.prior_range[name] for effect in everything.effects for name in effect.amplitudes]
    scale = np.array([(high - low) / 2 for low, high in ranges])
    gram = everything.information * scale[:, None] * scale
    blocks = everything.blocks
    matrix = np.zeros((len(blocks), len(blocks)))
    inverses = [np.linalg.pinv(gram[b, b], rcond=1e-8, hermitian=True) for b in blocks]
    for j, row in enumerate(blocks):
        size = float(np.trace(gram[row, row]))
        for i, column in enumerate(blocks):
            cross = gram[row, column]
            matrix[j, i] = float(np.trace(cross @ inverses[i] @ cross.T)) / size if size > 0 else 0.0
    return Confusability(tuple(effect.label for effect in everything.effects), np.clip(matrix, 0.0, 1.0))


@dataclass(frozen=True)
class Screened:
    """Detectability, scores and confusability of all candidates at one point.

    Attributes
    ----------
    visible : tuple of Visibility
    scores : tuple of Score
        Best first.
    alike : Confusability
    together : Together
    """

    visible: tuple[Visibility, ...]
    scores: tuple[Score, ...]
    alike: Confusability
    together: Together

    @property
    def unseen(self) -> list[str]:
        """Labels of candidates that these data cannot detect."""
        return [entry.effect.label for entry in self.visible if not entry.visible]


def screen(
    problem: CandidateProblem, base: Sequence[EffectBase], values: Mapping[str, float], limits: Thresholds = DEFAULTS
) -> Screened:
    """Screen all candidates except those of `base`: detectability, score and confusability."""
    point = linearise(problem, base, values, limits.shape_values)
    visible = visibility(point, limits.detection)
    ranked = scores(point, residual_series(problem.problem), visible)
    everything = together(point, ranked)
    return Screened(visible, ranked, confusability(everything), everything)

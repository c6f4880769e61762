"""Planning of informative motions: to identify parameters, or to discriminate effects that look alike."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from yid_ocp.analysis.identifiability import identifiability
from yid_ocp.analysis.layouts import seeing, sights
from yid_ocp.effects import EffectBase, make_effect
from yid_ocp.errors import ConfigError, SolverError, nearest
from yid_ocp.integrator.step import compile_alike
from yid_ocp.integrator.step_model import Rollout
from yid_ocp.options import check
from yid_ocp.planning.criteria import Criterion, Precision, Separation
from yid_ocp.planning.ends import joint_range
from yid_ocp.planning.experiment import Experiment
from yid_ocp.planning.improve import Improved, Search
from yid_ocp.planning.mover import Mover
from yid_ocp.planning.options import PlanOptions
from yid_ocp.planning.points import Points
from yid_ocp.planning.rows import Rows
from yid_ocp.problem import EstimationProblem
from yid_ocp.progress import SILENT, Progress
from yid_ocp.solvers.judgement import UNINFORMED, WEAK

Array = NDArray[np.float64]

UNSEEN = 1e-2
"""Standard deviations by which no reading moves when a parameter changes by its whole value: nothing sees it."""
FIRST = 0.3
"""Size of the random motions from which a search begins, before limits make them smaller [rad or m]."""
ROUGH = 0.05
"""Part of itself by which a sensitivity may change with a ten-thousandth of the motion, or the object snaps."""
AT_LIMIT = 0.98
"""Part of a limit from which it counts as reached."""
SMALL = 0.05
"""Largest unknown of a motion in which it is asked what else could see a parameter [rad or m]."""
VISIBLE = 1e-4
"""Motion of a point that a camera may see, for a change of a parameter by its whole value [m]."""


@dataclass(frozen=True)
class Start:
    """Result of the search from one random initial motion.

    Attributes
    ----------
    first, value : float
        Search criterion of the initial and of the final motion [nat].
    judged : float
        Criterion of the final motion in the configured problem [nat]; minus infinity where it cannot be simulated.
    finished : bool
        Whether no round would gain more.
    rounds : int
    """

    first: float
    value: float
    judged: float
    finished: bool
    rounds: int


@dataclass(frozen=True)
class Knowledge:
    """Relative standard deviations of a parameter before and after a planned recording; infinite without information.

    Attributes
    ----------
    before : float
        From the existing recordings.
    after : float
        From the planned recording alone.
    together : float
        From both.
    verdict : str
        From the planned recording alone.
    """

    before: float
    after: float
    together: float
    verdict: str


@dataclass(frozen=True, eq=False)
class InformationPlan:
    """The most informative motion that was found, with predicted parameter precisions.

    Attributes
    ----------
    mover : Mover
    unknowns : ndarray, shape (K, nc)
    rollout : Rollout
        By the mover.
    reached : bool
        Whether the search converged.
    message : str
    parameters : mapping of str to Knowledge
    distances : mapping of (str, str) to (float, float)
        For each pair of effects, distance of the change by the first from what the second and all free unknowns can
        imitate, in standard deviations of the data: in the recordings and in the plan. Empty without effects.
    starts : tuple of Start
        Results of the random initial motions, in the order drawn.
    best : int
        Index of the best one.
    active : mapping of str to tuple of str
        Names of the joints, springs or frames that reach a limit, by kind of limit.
    unseen : mapping of str to str
        Parameters that no motion informs, each with a sentence on which measurement would.
    open : tuple of str
        Sentences on directions that the planned recording would leave unidentifiable.
    """

    mover: Mover
    unknowns: Array
    rollout: Rollout
    reached: bool
    message: str
    parameters: Mapping[str, Knowledge]
    distances: Mapping[tuple[str, str], tuple[float, float]]
    starts: tuple[Start, ...]
    best: int
    active: Mapping[str, tuple[str, ...]]
    unseen: Mapping[str, str]
    open: tuple[str, ...]

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the moved joints."""
        return self.mover.step.system.prescribed

    @property
    def t(self) -> Array:
        """Times of the nodes, shape (N + 1,) [s]."""
        return self.mover.times

    @property
    def position(self) -> Array:
        """Joint positions, shape (N + 1, nc) [rad or m]."""
        return self.mover.positions(self.unknowns)

    @property
    def velocity(self) -> Array:
        """Joint velocities, shape (N + 1, nc) [rad/s or m/s]."""
        return self.mover.path.basis(self.t, 1) @ self.unknowns

    @property
    def acceleration(self) -> Array:
        """Joint accelerations, shape (N + 1, nc) [rad/s^2 or m/s^2]."""
        return self.mover.path.basis(self.t, 2) @ self.unknowns

    @property
    def effort(self) -> Array:
        """Required joint efforts, the last row repeated, shape (N + 1, nc) [N m or N]."""
        return np.vstack([self.rollout.effort, self.rollout.effort[-1:]])

    @cached_property
    def points(self) -> dict[str, Array]:
        """Trajectories of the system's points by name, each of shape (N + 1, 3) [m]."""
        system = self.mover.step.system
        at = Points(system, system.points).at(self.rollout.state[:, : system.size], self.mover.theta)[0]
        return {name: at[:, 3 * i : 3 * i + 3] for i, name in enumerate(system.points)}


def informative(
    problem: EstimationProblem,
    options: PlanOptions,
    values: Mapping[str, float] | None = None,
    effects: Mapping[str, Mapping[str, float]] | None = None,
    progress: Progress = SILENT,
) -> InformationPlan:
    """Plan the motion of the arms that best identifies parameters or discriminates effects, within limits.

    Parameters
    ----------
    problem : EstimationProblem
        As configured: its sensors with their noise and rates are those of its first recording, its free parameters are
        those that a recording of the motion would be fitted by.
    options : PlanOptions
        Of goal `information`.
    values : mapping of str to float, optional
        Parameters at which to judge; the problem's when absent.
    effects : mapping of label to mapping of quantity to value, optional
        Sizes of effects that are to be separated, where they are known; typical ones otherwise.
    progress : Progress, optional

    Returns
    -------
    InformationPlan

    Raises
    ------
    ConfigError
        Parameters or effects that do not exist, that no sensor sees in any motion, limits that leave no motion.
    ModelError, DataError, SolverError
        No rest to begin from; sensors without a noise level; a motion that its torques do not follow.
    """
    check(options, "plan")
    known = dict(zip(problem.system.parameters.names, map(float, problem.theta), strict=True)) | dict(values or {})
    progress.stage("building the experiment")
    chosen, rivals = _chosen(problem, options, effects or {})
    composed = problem if not rivals else _composed(problem, rivals, known)
    names = (*problem.free, *(name for effect in rivals for name in effect.amplitudes))
    shapes = {
        entry.name: entry.value for effect in rivals for entry in effect.parameters if entry.name in effect.shapes
    }
    experiment = Experiment.of(composed, known | shapes, options, names)
    limits = _limits(experiment, options)
    criterion = _criterion(experiment, chosen, rivals)
    lower, upper = (side - experiment.mover.first for side in joint_range(experiment.mover.step.system))
    search = Search(experiment, limits, criterion, lower, upper)
    _check_room(search, limits)
    begins = [_smooth(experiment, search.within(_random(experiment, options.seed + i))) for i in range(options.starts)]
    if not any(np.any(begin) for begin in begins):
        raise ConfigError("the limits leave no motion", where="plan.limits", hint="widen plan.limits")
    unseen = _unseen(experiment, begins)
    _check_seen(chosen, rivals, unseen, experiment)
    found = []
    for i, begin in enumerate(begins):
        progress.stage(f"improving the motion, start {i + 1} of {len(begins)}")
        found.append(search.improve(begin, options.iterations, progress))
    return _plan(experiment, limits, search, criterion, found, rivals, unseen)


# -- what is asked ----------------------------------------------------------------------------------------------------


def _chosen(
    problem: EstimationProblem, options: PlanOptions, sizes: Mapping[str, Mapping[str, float]]
) -> tuple[tuple[str, ...], tuple[EffectBase, ...]]:
    """Parameters that are to be told, or effects that are to be separated."""
    if options.inform is not None and options.separate is not None:
        raise ConfigError(
            "parameters are to be told and effects to be separated", where="plan.separate", allowed="one of the two"
        )
    if options.separate is not None:
        return (), _effects(problem, options.separate, sizes)
    wanted = problem.free if options.inform is None else options.inform
    if not wanted:
        raise ConfigError("no parameter is to be told", where="plan.inform", allowed=", ".join(problem.free))
    for name in wanted:
        if name not in problem.system.parameters:
            raise ConfigError(
                f"there is no parameter '{name}'",
                where="plan.inform",
                hint=nearest(name, problem.system.parameters.names),
            )
        if name not in problem.free:
            raise ConfigError(
                f"'{name}' is not free: a recording would say nothing of it",
                where="plan.inform",
                allowed=", ".join(problem.free),
                hint=f"set parameters.{name}.free: true",
            )
    return wanted, ()


def _effects(
    problem: EstimationProblem, labels: Sequence[str], sizes: Mapping[str, Mapping[str, float]]
) -> tuple[EffectBase, ...]:
    if len(set(labels)) < 2:
        raise ConfigError(
            f"{len(set(labels))} effect is to be separated from others" if labels else "no effect is to be separated",
            where="plan.separate",
            allowed="two effects or more, kind@location each",
        )
    there = {f"{effect.kind}@{effect.location}" for effect in problem.system.effects}
    found = []
    for label in dict.fromkeys(labels):
        kind, _, place = label.partition("@")
        if not place:
            raise ConfigError(
                f"'{label}' says nothing of where the effect is",
                where="plan.separate",
                allowed=f"kind@location, such as {label}@PLACE",
            )
        if label in there:
            raise ConfigError(
                f"{label} is part of the model", where="plan.separate", hint="free its parameters instead"
            )
        found.append(make_effect(kind, place, problem.system, sizes.get(label)))
    return tuple(found)


def _composed(
    problem: EstimationProblem, effects: Sequence[EffectBase], values: Mapping[str, float]
) -> EstimationProblem:
    """The problem of the system with all effects, neutral."""
    system = problem.system.with_effects([make_effect(e.kind, e.location, problem.system) for e in effects])
    recordings = [episode.recording for episode in problem.episodes]
    extra = [name for effect in effects for name in effect.parameters.names]
    step = compile_alike(problem.step, system)
    return EstimationProblem(step, recordings, problem.free, problem.options, values, (), extra)


def _criterion(experiment: Experiment, chosen: Sequence[str], rivals: Sequence[EffectBase]) -> Criterion:
    columns = [name.split("[")[0] for name in experiment.columns]
    parameters = tuple(i for i, name in enumerate(columns) if name in experiment.names)
    if not rivals:
        return Precision(tuple(i for i, name in enumerate(columns) if name in chosen), parameters)
    places, sizes = [], []
    for effect in rivals:
        own = tuple(columns.index(name) for name in effect.amplitudes)
        places.append(own)
        sizes.append(_size(effect) / experiment.scale[list(own)][:, None])
    return Separation(tuple(places), tuple(sizes), parameters)


def _size(effect: EffectBase) -> Array:
    """Amplitudes of an effect beside neutral: the known ones together, else half of its range, one after the other."""
    neutral = effect.neutral
    known = np.array([effect.parameters[name].value - neutral[name] for name in effect.amplitudes])
    if np.any(known):
        return known[:, None]
    half = [(effect.prior_range[name][1] - effect.prior_range[name][0]) / 2 for name in effect.amplitudes]
    return np.diag(half)


# -- within which limits ----------------------------------------------------------------------------------------------


def _limits(experiment: Experiment, options: PlanOptions) -> Rows:
    system, still = experiment.mover.step.system, experiment.still
    return Rows(experiment.mover, options, Points(system, system.points), np.zeros(3), still)


def _check_room(search: Search, limits: Rows) -> None:
    """Refuse limits that the arms pass where they begin."""
    mover, still = search.experiment.mover, search.experiment.still
    for name, low, high in zip(mover.step.system.prescribed, search.lower, search.upper, strict=False):
        if not low <= 0.0 <= high:
            raise ConfigError(
                f"{name} begins {max(low, -high):.3g} beyond the limit of the joint",
                where="plan.posture",
                hint="give a plan.posture within the limits",
            )
    broken = limits.broken(limits.limits(mover.roll(still), still).value)
    if broken:
        said = "; ".join(
            f"{name}: {value:.4g} where {bound:.4g} is allowed, {what}" for what, (name, value, bound) in broken.items()
        )
        raise ConfigError(
            f"the arms pass their limits before they move: {said}",
            where="plan.limits",
            hint="widen plan.limits where the machine allows it, or give another plan.posture",
        )


def _random(experiment: Experiment, seed: int) -> Array:
    return FIRST * np.random.default_rng(seed).normal(size=experiment.still.shape)


def _smooth(experiment: Experiment, w: Array) -> Array:
    """The motion, made smaller until what it tells changes smoothly with it."""
    for _ in range(10):
        rows, there = experiment.rows(w), experiment.rows((1.0 + 1e-4) * w)
        if rows is not None and there is not None and np.linalg.norm(there - rows) <= ROUGH * np.linalg.norm(rows):
            return w
        w = 0.5 * w
    return w


# -- what nothing sees ------------------------------------------------------------------------------------------------


def _unseen(experiment: Experiment, motions: Sequence[Array]) -> dict[str, float]:
    """Parameters of which no reading tells in any of the motions: how far one moves at most [standard deviations]."""
    largest = np.zeros(len(experiment.columns))
    for w in motions:
        rows = experiment.rows(w)
        if rows is not None:
            largest = np.maximum(largest, np.linalg.norm(rows, axis=0))
    named = zip(experiment.columns, largest, strict=True)
    return {name: float(size) for name, size in named if name.split("[")[0] in experiment.names and size < UNSEEN}


def _check_seen(
    chosen: Sequence[str], rivals: Sequence[EffectBase], unseen: Mapping[str, float], experiment: Experiment
) -> None:
    lost = [name for name in chosen if name in unseen]
    if chosen and len(lost) == len(chosen):
        worst = max(unseen[name] for name in lost)
        raise ConfigError(
            f"no motion informs {', '.join(lost)}: no sensor sees it to first order, a change by its whole value moves "
            f"all readings together by {worst:.1g} standard deviations",
            where="plan.inform",
            allowed="a parameter that a sensor sees",
            hint="; ".join(_would_see(experiment, name, _random(experiment, 0)) for name in lost),
        )
    for effect in rivals:
        if all(name in unseen for name in effect.amplitudes):
            raise ConfigError(
                f"no motion tells {effect.label} from anything: no sensor sees it to first order",
                where="plan.separate",
                hint="add a sensor that sees it",
            )


def _would_see(experiment: Experiment, name: str, w: Array) -> str:
    """What would see a parameter, in words."""
    mover = experiment.mover
    seen = sights(mover.step.system)
    wide = seeing(mover.step, {sight.name: sight.frame for sight in seen if sight.frame is not None}).system
    w = SMALL * w / max(float(np.abs(w).max()), SMALL)
    rolled, n = mover.roll(w, names=[name]), wide.size
    if rolled.by_state is None or not rolled.status.ok:
        return f"{name} needs another sensor"
    _, by_q = Points(wide, [sight.name for sight in seen]).at(rolled.state[:, :n], mover.theta)
    size = abs(mover.theta[wide.parameters.index(name)]) or 1.0
    moved = size * np.einsum("tiq,tq->ti", by_q, rolled.by_state[:, :n, 0]).reshape(len(by_q), -1, 3)
    farthest = np.linalg.norm(moved, axis=2).max(0)
    best = int(np.argmax(farthest))
    moved_by = (
        f"{1e3 * farthest[best]:.2g} mm in a random motion of {SMALL:g} rad, with {name} changed by its whole value"
    )
    if farthest[best] > VISIBLE:
        return f"let a camera see {seen[best].words}: it moves by {moved_by}"
    return (
        f"no point of the object moves by more than {moved_by}: take another grasp, which loads it "
        "(`identifiability --what-if` tries some), or fix it"
    )


# -- what was found ---------------------------------------------------------------------------------------------------


def _plan(
    experiment: Experiment,
    limits: Rows,
    search: Search,
    criterion: Criterion,
    found: Sequence[Improved],
    rivals: Sequence[EffectBase],
    unseen: Mapping[str, float],
) -> InformationPlan:
    judged = [_judged(experiment, criterion, one) for one in found]
    best = int(np.argmax(judged))
    if not np.isfinite(judged[best]):
        raise SolverError(
            "no motion that was found can be followed by its torques",
            where="plan",
            hint="lower plan.limits.acceleration",
        )
    w = found[best].w
    starts = tuple(
        Start(one.first, one.value, value, one.finished, one.rounds) for one, value in zip(found, judged, strict=True)
    )
    parameters, open_words = _parameters(experiment, w)
    distances = {} if not isinstance(criterion, Separation) else _distances(experiment, criterion, rivals, w)
    message = "the motion was found"
    if found[best].value == found[best].first and not found[best].finished:
        message = "the motions are too rough to be improved; lower plan.limits, or give another plan.posture"
    elif not found[best].finished:
        message = f"the search was stopped after {found[best].rounds} rounds; raise plan.iterations"
    lost = {name: _would_see(experiment, name, w) for name in unseen if name in experiment.configured.free}
    return InformationPlan(
        experiment.mover, w, experiment.mover.roll(w), found[best].finished, message, parameters, distances,
        starts, best, _active(search, limits, w), lost, open_words,
    )  # fmt: skip


def _judged(experiment: Experiment, criterion: Criterion, found: Improved) -> float:
    try:
        return criterion.value(experiment.judged(found.w), False)[0]
    except SolverError:
        return -math.inf


def _parameters(experiment: Experiment, w: Array) -> tuple[dict[str, Knowledge], tuple[str, ...]]:
    """Parameters of the nominal problem before, after and with both, and what the planned recording leaves open."""
    problem = experiment.configured
    before = identifiability(problem.at(experiment.values))
    after = identifiability(experiment.as_configured(w).freeing(problem.free))
    shared = [name for name in problem.free if name not in problem.options.local]
    at = [[entry.names.index(name) for name in shared] for entry in (before, after)]
    both = sum(entry.information[np.ix_(i, i)] for entry, i in zip((before, after), at, strict=True))
    values, vectors = np.linalg.eigh(np.atleast_2d(both))
    together = np.sqrt(np.sum(vectors**2 / np.maximum(values, UNINFORMED**-2), axis=1))
    found = {}
    for name, std in zip(shared, together, strict=True):
        first, last = before.parameters[name].std_relative, after.parameters[name].std_relative
        least = min(first, last, float(std) if std < WEAK else math.inf)
        found[name] = Knowledge(first, last, least, after.parameters[name].verdict)
    return found, tuple(entry.words for entry in after.unseen)


def _distances(
    experiment: Experiment, criterion: Separation, rivals: Sequence[EffectBase], w: Array
) -> dict[tuple[str, str], tuple[float, float]]:
    """Distances of effects in the recordings that there are, and in the planned one."""
    before, after = (criterion.distances(rows) for rows in (experiment.recorded, experiment.judged(w)))
    labels = [effect.label for effect in rivals]
    return {
        (a, b): (float(before[i, j]), float(after[i, j]))
        for i, a in enumerate(labels)
        for j, b in enumerate(labels)
        if i != j
    }


def _active(search: Search, limits: Rows, w: Array) -> dict[str, tuple[str, ...]]:
    """Limits that a motion reaches."""
    mover = search.experiment.mover
    value, at = limits.limits(mover.roll(w), w).value, 0
    found: dict[str, tuple[str, ...]] = {}
    for rows in limits.bounded:
        own = value[at : at + len(rows.names)]
        at += len(rows.names)
        near = (own > AT_LIMIT * rows.upper) | (own < AT_LIMIT * rows.lower)
        found[rows.what] = tuple(dict.fromkeys(name for name, one in zip(rows.names, near, strict=True) if one))
    flat = w.ravel()
    room = np.minimum(search.upper - flat, flat - search.lower).reshape(w.shape).min(0)
    found["position [rad or m]"] = tuple(
        name for name, left in zip(mover.step.system.prescribed, room, strict=True) if left < 1e-3
    )
    return {what: names for what, names in found.items() if names}

"""Ranking of changes of an experiment by the parameters they make identifiable, and smallest sufficient sets."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.analysis.identifiability import StartKnowledge, identifiability, unknown_vector
from yid_ocp.analysis.layouts import (
    ARM,
    CAMERA,
    MECHANICS,
    TORQUE_STD,
    Layout,
    LayoutBuilder,
    Setting,
    View,
    regular_times,
    sights,
)
from yid_ocp.errors import SolverError
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode
from yid_ocp.progress import SILENT, Progress
from yid_ocp.shown import Shown, Summary, counted
from yid_ocp.solvers.base import Solution
from yid_ocp.solvers.judgement import WEAK, verdict

Array = NDArray[np.float64]

FASTER = (10.0, 30.0)  # rates of the camera to try [Hz]
FLOOR = 1e-16  # of eigenvalues of the information on relative changes: standard deviations up to 1e8
LARGEST_SET = 3


@dataclass(frozen=True)
class Change:
    """One change of an experiment.

    Attributes
    ----------
    name : str
        `weld`, `second_arm`, `motion`, `travel`, `torque`, `camera:FRAME`, `arm:FRAME` or `rate:HERTZ`.
    words : str
    mechanics : str
        Key of `MECHANICS`, empty where only sensors change.
    camera, arm : tuple of str
        Additional frames that the camera, or the arm, measures.
    rate : float or None
        Of the camera [Hz].
    """

    name: str
    words: str
    mechanics: str = ""
    camera: tuple[str, ...] = ()
    arm: tuple[str, ...] = ()
    rate: float | None = None


@dataclass(frozen=True)
class Outcome:
    """Predicted identifiability of an experiment with some changes.

    Attributes
    ----------
    changes : tuple of str
        Names of the changes; empty for the unchanged experiment.
    words : str
    std_relative : mapping of parameter to float
        Empty where the experiment could not be evaluated.
    verdicts : mapping of parameter to str
    identifiable : int
        How many parameters.
    gain : float
        Information gain 1/2 log det(1 + 16 I) over relative changes [nat], for a prior standard deviation of 400 % of
        each parameter.
    message : str
        Why it could not be evaluated, or obstacles on a real robot.
    """

    changes: tuple[str, ...]
    words: str
    std_relative: Mapping[str, float]
    verdicts: Mapping[str, str]
    identifiable: int
    gain: float
    message: str = ""

    @property
    def complete(self) -> bool:
        """Whether every parameter is identifiable."""
        return bool(self.verdicts) and self.identifiable == len(self.verdicts)


@dataclass(frozen=True, repr=False)
class WhatIf(Shown):
    """Changes of an experiment, ranked by the parameters they make identifiable.

    Attributes
    ----------
    base : Outcome
        The experiment as it is.
    singles : tuple of Outcome
        Single changes, most identifiable parameters first, then by gain; those that could not be evaluated last.
    smallest : tuple of Outcome
        All sets of fewest changes with which every parameter is identifiable, largest gain first; empty where none of
        up to three changes does it.
    greedy : tuple of Outcome
        Best single change added one after the other.
    searched : int
        Number of evaluated sets of changes.
    """

    base: Outcome
    singles: tuple[Outcome, ...]
    smallest: tuple[Outcome, ...]
    greedy: tuple[Outcome, ...]
    searched: int

    def _summary(self) -> Summary:
        rows = [("change", "parameters found", "gain [nat]")]
        rows += [(entry.words, str(entry.identifiable), f"{entry.gain:.3g}") for entry in (self.base, *self.singles)]
        return Summary(f"{counted(len(self.singles), 'change')}, {self.searched} sets of them judged", rows)


@dataclass(frozen=True)
class WhatIfOptions:
    """Settings of the search for changes of an experiment.

    Attributes
    ----------
    torque_std : float
        Noise of joint torques as a measurement, where the recordings state none [N m].
    seed : int
        Random seed of alternative motions.
    largest : int
        Largest set of changes that is searched.
    only : tuple of str, optional
        Names of changes to consider, all when absent.
    """

    torque_std: float = TORQUE_STD
    seed: int = 11
    largest: int = LARGEST_SET
    only: tuple[str, ...] | None = None


Judge = Callable[[Sequence[Sequence[Change]], float], list[Outcome]]
"""From sets of changes and a factor on the stated variances to the predicted results, one for each set."""


def what_if(
    problem: EstimationProblem,
    solution: Solution | ArrayLike | None = None,
    *,
    start: StartKnowledge = "assumed",
    grasp_std: float | None = None,
    second_arm: System | None = None,
    options: WhatIfOptions | None = None,
    progress: Progress = SILENT,
    judge: Judge | None = None,
) -> WhatIf:
    """Rank changes of an experiment by how many parameters they would make identifiable.

    Nothing is measured for it: new sensors look at the rollout of the recorded motion, the tracking filter keeping the
    arms on it; new motions and a second arm are simulated in MuJoCo (or, another motion, taken from held-out
    recordings where MuJoCo is not installed).

    Parameters
    ----------
    problem : EstimationProblem
    solution : Solution or array_like, optional
        Point at which to judge; the initial values when absent.
    start, grasp_std
        Nuisances, as in `identifiability`.
    second_arm : System, optional
        The system with one more arm and its grasp; without it that change is not tried.
    options : WhatIfOptions, optional
    progress : Progress, optional
    judge : callable, optional
        Evaluates sets of changes, in other processes for example, by `judged_changes`; in this process when absent.

    Returns
    -------
    WhatIf

    Raises
    ------
    SolverError
        The model cannot be rolled out at the point.
    ConfigError, DataError
        As `identifiability`.
    """
    options = options or WhatIfOptions()
    x = unknown_vector(problem, solution)
    fit = None if solution is None else identifiability(problem, x, start=start, grasp_std=grasp_std)
    inflation = 1.0 if fit is None else max(1.0, fit.chi2_per_dof)
    setting = Setting(problem, x, start, grasp_std, second_arm, options.torque_std, options.seed)
    outcomes = _Outcomes(setting, LayoutBuilder(setting, progress), inflation, judge, progress)
    (base,) = outcomes.of_all([()])
    if not base.verdicts:
        raise SolverError(base.message)
    known = possible_changes(setting, outcomes.builder)
    changes = [change for change in known if options.only is None or change.name in options.only]
    singles = ranked(outcomes.of_all([(change,) for change in changes]))
    greedy = _greedy(outcomes, changes, base, options.largest)
    smallest = _smallest(outcomes, changes, base, options.largest)
    return WhatIf(base, tuple(singles), tuple(ranked(smallest)), tuple(greedy), outcomes.count)


def judged_changes(setting: Setting, sets: Sequence[Sequence[str]], inflation: float) -> list[Outcome]:
    """Predicted results of an experiment with each of several sets of changes, given by name.

    Parameters
    ----------
    setting : Setting
    sets : sequence of sequence of str
        Names of `possible_changes`.
    inflation : float
        Factor by which variances are larger than stated.
    """
    outcomes = _Outcomes(setting, LayoutBuilder(setting), inflation)
    known = {change.name: change for change in possible_changes(setting, outcomes.builder)}
    return outcomes.of_all([[known[name] for name in names] for names in sets])


def _smallest(outcomes: _Outcomes, changes: Sequence[Change], base: Outcome, largest: int) -> list[Outcome]:
    """All sets of as few changes as will do with which every parameter is identifiable."""
    for size in range(0 if base.complete else 1, largest + 1):
        found = outcomes.of_all([chosen for chosen in itertools.combinations(changes, size) if compatible(chosen)])
        complete = [outcome for outcome in found if outcome.complete]
        if complete or not changes:
            return complete
    return []


def possible_changes(setting: Setting, builder: LayoutBuilder) -> list[Change]:
    """All single changes that apply to an experiment."""
    episode = setting.problem.episodes[0]
    camera, arm = setting.camera(episode)[0], setting.arm(episode)[0]
    looked = {view.frame for view in setting.views(episode) if camera is not None and view.group == camera.name}
    felt = {view.frame for view in setting.views(episode) if arm is not None and view.group == arm.name}
    changes = [Change(name, MECHANICS[name], name) for name in builder.possible()]
    system = setting.problem.system
    for sight in sights(system):
        if sight.name not in looked | felt:
            changes.append(Change(f"camera:{sight.name}", f"{sight.words}, seen by the camera", camera=(sight.name,)))
        if sight.arm and sight.name not in felt:
            changes.append(Change(f"arm:{sight.name}", f"{sight.words}, seen by the arm", arm=(sight.name,)))
    if camera is not None:
        now = 1.0 / float(np.median(np.diff(camera.t))) if len(camera.t) > 1 else 0.0
        faster = [rate for rate in FASTER if rate > now]
        changes += [Change(f"rate:{r:g}", f"the camera at {r:g} Hz without gaps", rate=r) for r in faster]
    return changes


def compatible(changes: Sequence[Change]) -> bool:
    """Whether changes can be combined: at most one camera rate and one motion."""
    rates = sum(change.rate is not None for change in changes)
    motions = sum(change.mechanics in ("motion", "travel") for change in changes)
    return rates <= 1 and motions <= 1


def ranked(outcomes: Iterable[Outcome]) -> list[Outcome]:
    """Results sorted by identifiable parameters, then by gain; those that could not be evaluated last."""
    return sorted(outcomes, key=lambda entry: (not entry.verdicts, -entry.identifiable, -entry.gain))


class _Outcomes:
    """What sets of changes would tell, each worked out once.

    Attributes
    ----------
    setting : Setting
    builder : LayoutBuilder
    inflation : float
        Factor by which variances are larger than stated.
    judge : callable, optional
        Who works them out instead.
    progress : Progress, optional
    """

    def __init__(
        self,
        setting: Setting,
        builder: LayoutBuilder,
        inflation: float,
        judge: Judge | None = None,
        progress: Progress = SILENT,
    ) -> None:
        self.setting, self.builder, self.inflation, self.progress = setting, builder, inflation, progress
        self._judge = judge or self._judged
        self._known: dict[frozenset[str], Outcome] = {}

    @property
    def count(self) -> int:
        """Sets worked out so far."""
        return len(self._known)

    def of_all(self, sets: Sequence[Sequence[Change]]) -> list[Outcome]:
        """The outcomes of several sets of changes."""
        keys = [frozenset(change.name for change in changes) for changes in sets]
        new = {key: changes for key, changes in zip(keys, sets, strict=True) if key not in self._known}
        if new:
            self._known |= dict(zip(new, self._judge(list(new.values()), self.inflation), strict=True))
        return [self._known[key] for key in keys]

    def _judged(self, sets: Sequence[Sequence[Change]], _: float) -> list[Outcome]:
        self.progress.stage(f"judging {len(sets)} experiments")
        found = []
        for done, changes in enumerate(sets):
            self.progress.advance(done, len(sets), "; ".join(change.words for change in changes) or "as it is")
            found.append(self._outcome(changes))
        return found

    def _outcome(self, changes: Sequence[Change]) -> Outcome:
        names = tuple(change.name for change in changes)
        words = "; ".join(change.words for change in changes) if changes else "as it is"
        layout = self.builder.layout(frozenset(change.mechanics for change in changes if change.mechanics))
        if isinstance(layout, str):
            return Outcome(names, words, {}, {}, 0, -math.inf, layout)
        views = [self._views(episode, changes, layout) for episode in self.setting.problem.episodes]
        std, gain = precision(layout, layout.information(views) / self.inflation)
        verdicts = {name: verdict(1.0, value) for name, value in std.items()}
        count = sum(said == "identifiable" for said in verdicts.values())
        return Outcome(names, words, std, verdicts, count, gain, "; ".join(layout.notes))

    def _views(self, episode: Episode, changes: Sequence[Change], layout: Layout) -> list[View]:
        setting = self.setting
        camera, times, std = setting.camera(episode)
        arm, arm_times, arm_std = setting.arm(episode)
        looking, feeling = CAMERA if camera is None else camera.name, ARM if arm is None else arm.name
        rate = next((change.rate for change in changes if change.rate is not None), None)
        if rate is not None:
            times = regular_times(episode.grid, rate)
        held = {grasp.held for grasp in layout.problem.system.grasps}
        # a point that a second arm now holds is that arm's to measure
        taken = held - {grasp.held for grasp in setting.problem.system.grasps}
        views = []
        for view in setting.views(episode):
            if view.group == looking and view.frame in taken:
                continue
            if view.group == looking and rate is not None:
                view = View(looking, view.frame, times, np.full((len(times), 3), std))
            views.append(view)
        views += [
            View(looking, frame, times, np.full((len(times), 3), std)) for change in changes for frame in change.camera
        ]
        feels = [*sorted(taken), *(frame for change in changes for frame in change.arm)]
        views += [View(feeling, frame, arm_times, np.full((len(arm_times), 3), arm_std)) for frame in feels]
        return views


def precision(layout: Layout, information: Array) -> tuple[dict[str, float], float]:
    """Relative standard deviation of every free parameter, and the gain, from a Fisher information of all unknowns.

    Parameters
    ----------
    layout : Layout
    information : ndarray, shape (nx, nx)
    """
    problem, x = layout.problem, layout.x
    chosen = np.array([problem.names.index(name) for name in layout.names])
    others = np.setdiff1d(np.arange(len(x)), chosen)
    scale = problem.scales.copy()
    scale[chosen] = np.where(x[chosen] != 0, np.abs(x[chosen]), scale[chosen])
    scaled = information * np.outer(scale, scale)
    own, cross = scaled[np.ix_(chosen, chosen)], scaled[np.ix_(chosen, others)]
    if len(others):
        own = own - cross @ np.linalg.lstsq(scaled[np.ix_(others, others)], cross.T, rcond=None)[0]
    values, vectors = np.linalg.eigh(0.5 * (own + own.T))
    values = np.maximum(values, FLOOR)
    std = np.sqrt(np.sum(vectors**2 / values, axis=1))
    gain = 0.5 * float(np.sum(np.log1p(WEAK**2 * values)))
    return dict(zip(layout.names, map(float, std), strict=True)), gain


def _greedy(outcomes: _Outcomes, changes: Sequence[Change], base: Outcome, largest: int) -> list[Outcome]:
    """Best single change added one after the other."""
    chosen: tuple[Change, ...] = ()
    steps: list[Outcome] = []
    best = base
    while len(chosen) < largest and not best.complete:
        trials = [(*chosen, change) for change in changes if change not in chosen and compatible((*chosen, change))]
        if not trials:
            break
        found = outcomes.of_all(trials)
        top = ranked(found)[0]
        if (top.identifiable, top.gain) <= (best.identifiable, best.gain):
            break
        chosen, best = trials[found.index(top)], top
        steps.append(top)
    return steps

"""Ranking of possible changes of an experiment by the number of parameters that they make identifiable."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from yid_ocp.analysis.experiment_design import (
    ARM_GROUP,
    CAMERA_GROUP,
    SETUP_CHANGE_DESCRIPTIONS,
    ExperimentVariantSensitivityBuilder,
    SinglePointObservationSchedule,
    UnchangedExperiment,
    VariantPositionSensitivities,
    measurable_points,
    uniform_sample_times,
)
from yid_ocp.analysis.identifiability import InitialStateKnowledge, identifiability, unknown_vector_from_solution
from yid_ocp.arrays import Array
from yid_ocp.display import NULL_PROGRESS, Progress, ReprMixin, ReprTexts, count_with_noun
from yid_ocp.errors import SolverError
from yid_ocp.inference.uncertainty import MAX_WEAK_RELATIVE_STD, parameter_verdict
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode
from yid_ocp.solvers.base import Solution

_FASTER_CAMERA_RATES = (10.0, 30.0)  # rates of the camera to try [Hz]
_MIN_INFORMATION_EIGENVALUE = 1e-16  # for relative changes; allows standard deviations up to 1e8
_MAX_CHANGE_SET_SIZE = 3


@dataclass(frozen=True)
class ExperimentChange:
    """A single change of an experiment, such as another setup, another measured point or another camera rate."""

    name: str  # weld, second_arm, motion, travel, torque, camera:FRAME, arm:FRAME or rate:HERTZ
    description: str
    setup_change: str = ""  # key of `SETUP_CHANGE_DESCRIPTIONS`, empty if the simulated experiment stays the same
    camera_frame: str = ""  # additional frame that the camera sees; empty for none
    arm_frame: str = ""  # additional frame that an arm measures; empty for none
    camera_rate: float | None = None  # [Hz]


@dataclass(frozen=True)
class ChangedExperimentResult:
    """The predicted identifiability if an experiment is changed. `verdicts` is empty if the prediction failed.

    `gain` [nat] is the information gain 1/2 log det(1 + 16 I), where I is the Fisher information of relative changes
    and the prior standard deviation of each parameter is 400 %.
    """

    changes: tuple[str, ...]
    description: str
    std_relative: Mapping[str, float]
    verdicts: Mapping[str, str]
    identifiable: int  # number of identifiable parameters
    gain: float
    message: str = ""  # reason for a failure, or obstacles on a real robot

    @property
    def _is_complete(self) -> bool:
        return bool(self.verdicts) and self.identifiable == len(self.verdicts)


@dataclass(frozen=True, repr=False)
class ExperimentChangesRankedByIdentifiability(ReprMixin):
    """The possible changes of an experiment, ranked by the number of parameters that they make identifiable.

    `single_changes` are sorted by this number, then by information gain [nat]; changes that could not be evaluated come
    last. `smallest_sufficient_sets` are all sets of as few changes as possible (at most three) with which every
    parameter is identifiable, largest gain first.
    """

    unchanged_experiment: ChangedExperimentResult
    single_changes: tuple[ChangedExperimentResult, ...]
    smallest_sufficient_sets: tuple[ChangedExperimentResult, ...]
    n_evaluated_sets: int

    def _summary(self) -> ReprTexts:
        shown = (self.unchanged_experiment, *self.single_changes)
        rows = [("change", "parameters found", "gain [nat]")]
        rows += [(entry.description, str(entry.identifiable), f"{entry.gain:.3g}") for entry in shown]
        count = count_with_noun(len(self.single_changes), "change")
        return ReprTexts(f"{count}, {self.n_evaluated_sets} sets of them judged", rows)


# Function from sets of changes and a factor on the stated variances to the predicted result of each set.
_ChangeSetsEvaluationFunction = Callable[[Sequence[Sequence[ExperimentChange]], float], list[ChangedExperimentResult]]


def what_if(
    problem: EstimationProblem,
    solution: Solution | ArrayLike | None = None,
    *,
    start: InitialStateKnowledge = "assumed",
    grasp_std: float | None = None,
    two_arm_system: System | None = None,
    considered_changes: Collection[str] | None = None,
    progress: Progress = NULL_PROGRESS,
    evaluate_changes: _ChangeSetsEvaluationFunction | None = None,
) -> ExperimentChangesRankedByIdentifiability:
    """Rank changes of an experiment by how many parameters they make identifiable, without new measurements.

    The readings of a new sensor are simulated along the recorded motion, on which the tracking filter keeps the arms.
    New motions and a second arm are simulated in MuJoCo; without it, the new motion is that of a held-out recording.
    Raises `SolverError` if the unchanged experiment cannot be simulated.

    Parameters
    ----------
    solution : Solution or array_like, optional
        Point of the analysis; default: the initial values.
    start, grasp_std
        Knowledge of initial states and grasps, as in `identifiability`.
    two_arm_system : System, optional
        The system with a second arm and its grasp; without it this change is not tried.
    considered_changes : collection of str, optional
        Names of changes to consider; default: all.
    evaluate_changes : callable, optional
        Replacement for the evaluation in this process, for example one that uses other processes.

    Returns
    -------
    ExperimentChangesRankedByIdentifiability
        Verdicts and relative standard deviations [1] for the unchanged experiment, each change, and the smallest sets.
    """
    x, inflation = unknown_vector_from_solution(problem, solution), 1.0
    if solution is not None:
        inflation = max(1.0, identifiability(problem, x, start=start, grasp_std=grasp_std).chi2_per_dof)
    setting = UnchangedExperiment(problem, x, start, grasp_std, two_arm_system)
    outcomes = _Outcomes(setting, inflation, progress, evaluate_changes)
    (base,) = outcomes.of_all([()])
    if not base.verdicts:
        where, allowed = "the experiment without changes", "an experiment that the model can simulate"
        raise SolverError(base.message, where=where, allowed=allowed, hint="find the cause with `yid-ocp check FILE`")
    changes = [c for c in outcomes.possible if considered_changes is None or c.name in considered_changes]
    singles = _rank_results(outcomes.of_all([(change,) for change in changes]))
    smallest = _rank_results(_smallest(outcomes, changes, base))
    return ExperimentChangesRankedByIdentifiability(base, tuple(singles), tuple(smallest), len(outcomes.known))


def evaluate_experiment_change_sets(
    setting: UnchangedExperiment, sets: Sequence[Sequence[str]], inflation: float
) -> list[ChangedExperimentResult]:
    """Predict the result of each set of names of changes in `sets`. `inflation` multiplies the stated variances."""
    outcomes = _Outcomes(setting, inflation)
    known = {change.name: change for change in outcomes.possible}
    return outcomes.of_all([[known[name] for name in names] for names in sets])


def _smallest(
    outcomes: _Outcomes, changes: Sequence[ExperimentChange], base: ChangedExperimentResult
) -> list[ChangedExperimentResult]:
    if base._is_complete:
        return [base]
    for size in range(1, _MAX_CHANGE_SET_SIZE + 1) if changes else ():
        sets = itertools.combinations(changes, size)
        # at most one camera rate and one other motion
        able = [own for own in sets if sum(change.camera_rate is not None for change in own) <= 1]
        able = [own for own in able if sum(change.setup_change in ("motion", "travel") for change in own) <= 1]
        if complete := [outcome for outcome in outcomes.of_all(able) if outcome._is_complete]:
            return complete
    return []


def _rank_results(outcomes: Iterable[ChangedExperimentResult]) -> list[ChangedExperimentResult]:
    """Sort results by their number of identifiable parameters, then by gain; failed ones come last."""
    return sorted(outcomes, key=lambda entry: (not entry.verdicts, -entry.identifiable, -entry.gain))


def _words(changes: Sequence[ExperimentChange]) -> str:
    return " + ".join(change.description for change in changes) or "none (the experiment as it is)"


class _Outcomes:
    def __init__(
        self,
        setting: UnchangedExperiment,
        inflation: float,
        progress: Progress = NULL_PROGRESS,
        judge: _ChangeSetsEvaluationFunction | None = None,
    ) -> None:
        self.setting, self.inflation, self.progress = setting, inflation, progress
        self.builder = ExperimentVariantSensitivityBuilder(setting, progress)
        self.judge = judge or self._judged
        self.known: dict[frozenset[str], ChangedExperimentResult] = {}

    @property
    def possible(self) -> list[ExperimentChange]:
        """All single changes that apply to the experiment."""
        setting, episode = self.setting, self.setting.problem.episodes[0]
        camera = setting.camera_points_times_and_median_std(episode)[0]
        arm = setting.arm_point_group_times_and_std(episode)[0]
        views = setting.existing_point_observation_schedules(episode)
        groups = ("" if group is None else group.name for group in (camera, arm))
        looked, felt = ({view.frame for view in views if view.point_group == name} for name in groups)
        names = self.builder.applicable_setup_changes()
        changes = [ExperimentChange(name, SETUP_CHANGE_DESCRIPTIONS[name], name) for name in names]
        for sight in measurable_points(setting.problem.system):
            name, words = sight.name, sight.description
            if name not in looked | felt:
                changes.append(ExperimentChange(f"camera:{name}", f"{words}, seen by the camera", camera_frame=name))
            if sight.is_arm_measurable and name not in felt:
                changes.append(ExperimentChange(f"arm:{name}", f"{words}, seen by the arm", arm_frame=name))
        if camera is not None:
            now = 1.0 / float(np.median(np.diff(camera.t))) if len(camera.t) > 1 else 0.0
            for rate in (rate for rate in _FASTER_CAMERA_RATES if rate > now):
                words = f"the camera at {rate:g} Hz without gaps"
                changes.append(ExperimentChange(f"rate:{rate:g}", words, camera_rate=rate))
        return changes

    def of_all(self, sets: Sequence[Sequence[ExperimentChange]]) -> list[ChangedExperimentResult]:
        """Return the results of several sets of changes, each computed only once."""
        keys = [frozenset(change.name for change in changes) for changes in sets]
        if new := {key: changes for key, changes in zip(keys, sets, strict=True) if key not in self.known}:
            self.known |= dict(zip(new, self.judge(list(new.values()), self.inflation), strict=True))
        return [self.known[key] for key in keys]

    def _judged(self, sets: Sequence[Sequence[ExperimentChange]], _: float) -> list[ChangedExperimentResult]:
        self.progress.begin_stage(f"predicting the ± of {count_with_noun(len(sets), 'experiment')}")
        found = []
        for done, changes in enumerate(sets, 1):
            found.append(own := self._outcome(changes))
            text = f"{own.identifiable} of {len(own.verdicts)} parameters found" if own.verdicts else "not simulated"
            self.progress.report_parts_done(done, len(sets), f"{text}: {own.description}")
        return found

    def _outcome(self, changes: Sequence[ExperimentChange]) -> ChangedExperimentResult:
        names, words = tuple(change.name for change in changes), _words(changes)
        setup_changes = frozenset(change.setup_change for change in changes if change.setup_change)
        layout = self.builder.position_sensitivities_of_variant(setup_changes)
        if isinstance(layout, str):
            return ChangedExperimentResult(names, words, {}, {}, 0, -math.inf, layout)
        views = [self._views(episode, changes, layout) for episode in self.setting.problem.episodes]
        std, gain = _relative_stds_and_gain(layout, layout.fisher_information_with_prior(views) / self.inflation)
        verdicts = {name: parameter_verdict(1.0, value) for name, value in std.items()}
        count = sum(said == "identifiable" for said in verdicts.values())
        return ChangedExperimentResult(names, words, std, verdicts, count, gain, "; ".join(layout.feasibility_notes))

    def _views(
        self, episode: Episode, changes: Sequence[ExperimentChange], layout: VariantPositionSensitivities
    ) -> list[SinglePointObservationSchedule]:
        setting = self.setting
        camera, times, std = setting.camera_points_times_and_median_std(episode)
        arm, arm_times, arm_std = setting.arm_point_group_times_and_std(episode)
        looking, feeling = CAMERA_GROUP if camera is None else camera.name, ARM_GROUP if arm is None else arm.name
        rate = next((change.camera_rate for change in changes if change.camera_rate is not None), None)
        if rate is not None:
            times = uniform_sample_times(episode.grid, rate)

        def look(frame: str) -> SinglePointObservationSchedule:
            return SinglePointObservationSchedule(looking, frame, times, np.full((len(times), 3), std))

        # a point that the second arm holds is measured by that arm
        held, before = ({grasp.held_frame for grasp in p.system.grasps} for p in (layout.problem, setting.problem))
        views = [
            look(view.frame) if view.point_group == looking and rate is not None else view
            for view in setting.existing_point_observation_schedules(episode)
            if view.point_group != looking or view.frame not in held - before
        ]
        views += [look(change.camera_frame) for change in changes if change.camera_frame]
        feels = [*sorted(held - before), *(change.arm_frame for change in changes if change.arm_frame)]
        felt = np.full((len(arm_times), 3), arm_std)
        return views + [SinglePointObservationSchedule(feeling, frame, arm_times, felt) for frame in feels]


def _relative_stds_and_gain(layout: VariantPositionSensitivities, information: Array) -> tuple[dict[str, float], float]:
    """Return the relative std of every free parameter, and the gain [nat], from the information of all unknowns."""
    problem, x = layout.problem, layout.x
    chosen = np.array([problem.unknown_names.index(name) for name in layout.free_parameters])
    others, scale = np.setdiff1d(np.arange(len(x)), chosen), problem.unknown_scales.copy()
    scale[chosen] = np.where(x[chosen] != 0, np.abs(x[chosen]), scale[chosen])
    scaled = information * np.outer(scale, scale)
    own, cross = scaled[np.ix_(chosen, chosen)], scaled[np.ix_(chosen, others)]
    if len(others):
        own = own - cross @ np.linalg.lstsq(scaled[np.ix_(others, others)], cross.T, rcond=None)[0]
    values, vectors = np.linalg.eigh(0.5 * (own + own.T))
    values = np.maximum(values, _MIN_INFORMATION_EIGENVALUE)
    std = np.sqrt(np.sum(vectors**2 / values, axis=1))
    gain = 0.5 * float(np.sum(np.log1p(MAX_WEAK_RELATIVE_STD**2 * values)))
    return dict(zip(layout.free_parameters, map(float, std), strict=True)), gain

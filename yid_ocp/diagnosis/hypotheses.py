"""An estimation problem that contains all candidate effects in one compiled step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from yid_ocp.arrays import Array, BoolArray
from yid_ocp.data.recording import Recording
from yid_ocp.display import Progress
from yid_ocp.effects import EFFECTS, EffectBase, candidate_kinds_and_locations, make_effect
from yid_ocp.effects.friction import effect_as_sharp_as_nominal_friction
from yid_ocp.errors import ConfigError, DataError, SolverError, nearest_name_question
from yid_ocp.inference.whitening import (
    WhiteningFilter,
    problem_relinearized_at_torque_bias,
    problem_with_held_out_kalman_whitening,
    problem_with_reestimated_held_out_torque_biases,
    problem_with_whitening_at,
)
from yid_ocp.integrator.step import compile_step_like
from yid_ocp.model.system import System
from yid_ocp.parallel import CasadiLockedCache
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode, truncate_episode
from yid_ocp.problem.evaluation import ProcessNoiseWhitener
from yid_ocp.problem.measurements import SensorMeasurements
from yid_ocp.problem.model_functions import ModelFunctions
from yid_ocp.problem.recorded_inputs import signal_kinds_for_effects

CandidateNamesOrAll = Literal["all"] | Sequence[str]

_BLOCK_DURATION = 1.0  # length of the blocks in which a single recording is split [s]
_MIN_PREDICTED_DURATION = 1.0  # shortest beginning of a held-out recording that is worth predicting [s]
KEPT_FRACTIONS_BEFORE_FAILURE = (0.9, 0.5, 0.0)
"""Held-out recordings keep one of these fractions of the duration that a model follows before its rollout fails: before
a failure it has already deviated. The next fraction is tried if the refitted model fails earlier."""


def make_candidate_effects(
    system: System, recordings: Sequence[Recording], choice: CandidateNamesOrAll
) -> list[EffectBase]:
    """Create the candidate effects for a system, except effects that its nominal model already contains.

    `choice` is "all", or a list of `kind@location` or `kind` (at all locations that a diagnosis tries). Raises
    `ConfigError` if the list is empty, or if a kind does not exist, has no location here or is part of the nominal
    model. Raises `ModelError` if a location does not exist.
    """
    where, sensors = "diagnosis.candidates", signal_kinds_for_effects(recordings)
    present = {f"{effect.kind}@{effect.location}" for effect in system.effects}
    possible = [pair for pair in candidate_kinds_and_locations(system, sensors) if "@".join(pair) not in present]
    if choice == "all":
        return [_make_candidate(kind, place, system) for kind, place in possible]
    if isinstance(choice, str) or not choice:
        what = f"candidates = '{choice}'" if choice else "there is no candidate to try"
        raise ConfigError(what, where=where, allowed="all, or a list of kinds", hint="leave the key out to try all")
    pairs: list[tuple[str, str]] = []
    for text in choice:
        kind, _, place = text.partition("@")
        cls = EFFECTS[kind]
        if text in present:
            what, allowed = f"the effect {text} is already part of the model", "effects that the model does not have"
            raise ConfigError(what, where=where, allowed=allowed, hint="leave it out")
        found = [(kind, place)] if place else [pair for pair in possible if pair[0] == kind]
        if not found:
            missing = ", ".join(sorted(cls.required_sensors - sensors))
            what = f"the effect {kind} is not possible for this model" + (f" without {missing}" if missing else "")
            allowed, hint = ", ".join(dict.fromkeys(k for k, _ in possible)), "leave it out"
            raise ConfigError(what, where=where, allowed=allowed, hint=f"record {missing}" if missing else hint)
        pairs += [pair for pair in found if pair not in pairs]
    return [_make_candidate(kind, place, system) for kind, place in pairs]


def _make_candidate(kind: str, place: str, system: System) -> EffectBase:
    return effect_as_sharp_as_nominal_friction(make_effect(kind, place, system), system)


def exclude_candidates(effects: Sequence[EffectBase], names: Sequence[str]) -> list[EffectBase]:
    """Return the candidate effects that are not listed in `names` (as `kind` or `kind@location`).

    Excluded candidates stay in the compiled step, at values without effect, so nothing is recompiled. Raises
    `ConfigError` if a name is not a candidate, or if no candidate is left.
    """
    where = "diagnosis.excluded_candidates"
    known = {name for effect in effects for name in (effect.kind, effect.label)}
    for name in names:
        if name not in known:
            allowed = ", ".join(dict.fromkeys(effect.kind for effect in effects))
            what, hint = f"'{name}' is not a candidate", nearest_name_question(name, known) or "leave it out"
            raise ConfigError(what, where=where, allowed=f"{allowed}, or kind@location", hint=hint)
    kept = [effect for effect in effects if not {effect.kind, effect.label} & set(names)]
    if not kept:
        what, allowed = "every candidate is excluded", "at least one candidate that is not excluded"
        raise ConfigError(what, where=where, allowed=allowed, hint="exclude fewer")
    return kept


def neutral_effect_parameter_values(effects: Sequence[EffectBase]) -> dict[str, float]:
    """Return the parameter values at which the given effects change nothing."""
    return {name: value for effect in effects for name, value in effect.neutral_values.items()}


def join_effect_labels(effects: Sequence[EffectBase]) -> str:
    """Join the labels `kind@location` of effects with "and", or return "the nominal model" if there are none."""
    return " and ".join(effect.label for effect in effects) or "the nominal model"


@dataclass(frozen=True)
class HeldOutTruncation:
    """A held-out recording that is cut off where the nominal model stops following it, with its durations."""

    recording: str
    kept_duration: float  # compared duration [s]; 0 if nothing is compared
    full_duration: float  # [s]


@dataclass(frozen=True)
class AllCandidatesProblem:
    """An estimation problem with all candidate effects, each of which can be freed without recompiling.

    Sensors, statics and corrections are compiled once with all derivatives, and recordings are placed on the nodes
    once. The tracking filter is computed at the nominal initial values and is therefore the same for every hypothesis.
    """

    # system with all candidates at their neutral values, and free nominal parameters
    problem: EstimationProblem
    candidate_effects: tuple[EffectBase, ...]  # candidates to try: neutral in the nominal model and not excluded
    is_split_in_blocks: bool  # whether a single recording is both estimated on and held out, in alternate blocks
    # functions of the nominal system with some candidates, by their labels and the time step [s]
    functions_of_some: CasadiLockedCache[tuple[tuple[str, ...], float], ModelFunctions] | None = None
    held_out_spread: Array | None = None  # change (n, k) of held-out residuals by one std of each nominal parameter

    @staticmethod
    def from_problem(
        problem: EstimationProblem, effects: Sequence[EffectBase], held_out: Sequence[Recording] = ()
    ) -> AllCandidatesProblem:
        """Add candidate effects to a problem. Raises `DataError` if a recording is both estimated on and held out."""
        effects = tuple(effects)
        joint = compile_step_like(problem.step, problem.step.system.with_effects(effects))
        estimate = [episode.recording for episode in problem.episodes]
        held = [*held_out] or [episode.recording for episode in problem.held_out]
        for recording in held:
            if any(_same(recording, other) for other in estimate):
                what, allowed = "a recording is both estimated on and held out", "held-out recordings of other motions"
                hint = "leave held_out empty to split one recording in blocks"
                raise DataError(what, where=f"recording '{recording.name}'", allowed=allowed, hint=hint)
        values = dict(zip(problem.system.parameters.names, map(float, problem.theta), strict=True))
        extra = [name for effect in effects for name in effect.parameters.names]
        made = EstimationProblem(joint, estimate, problem.free, problem.options, values, held, extra)

        def functions(key: tuple[tuple[str, ...], float]) -> ModelFunctions:
            labels, time_step = key
            if time_step != problem.step.time_step:
                return some((labels, problem.step.time_step)).with_time_step(time_step)
            own = [effect for effect in effects if effect.label in labels]
            if not own:
                return problem.model_functions
            names = (*problem.free, *(name for effect in own for name in effect.parameters.names))
            step = compile_step_like(problem.step, problem.step.system.with_effects(own))
            return ModelFunctions(step, names, problem.options.initial_state_fit_parameters)

        some = CasadiLockedCache[tuple[tuple[str, ...], float], ModelFunctions](functions)
        return AllCandidatesProblem(made if held else _in_blocks(made), effects, not held, some)

    @property
    def problem_with_all_samples(self) -> EstimationProblem:
        """The composed problem with all samples, even if a single recording is divided in blocks."""
        if not self.is_split_in_blocks:
            return self.problem

        def joined(own: Episode, other: Episode) -> Episode:
            pairs = zip(own.measurements, other.measurements, strict=True)
            parts = [replace(a, value=np.fmax(a.value, b.value), weight=a.weight + b.weight) for a, b in pairs]
            return replace(own, measurements=tuple(parts))

        return self.problem.with_episodes(list(map(joined, self.problem.episodes, self.problem.held_out)), ())

    @property
    def nominal_free_parameter_names(self) -> tuple[str, ...]:
        """The names of the free parameters of the nominal problem."""
        return self.problem.free

    def candidates_with_prior_ranges_for(self, states: Sequence[Array]) -> tuple[EffectBase, ...]:
        """Return the candidates with prior ranges for the largest joint angles of each segment in rolled-out states."""
        mechanism, largest = self.problem.system.mechanism, {}
        for segment in self.problem.system.segment_layouts:
            index = [mechanism.joint_index(joint) for link in segment.link_joints for joint in link]
            largest[segment.name] = max(float(np.abs(state[:, index]).max()) for state in states)
        return tuple(effect.with_prior_ranges_for_largest_angles(largest) for effect in self.candidate_effects)

    def with_whitening_linearized_at(self, values: Mapping[str, float]) -> AllCandidatesProblem:
        """Return the problem whitened by sensor and torque noise, with filters linearised at `values`."""
        if not self.problem.has_process_noise:
            return self
        # filters are linearised about the estimated torques, so these must be known first
        x, errors = self.problem.unknown_vector(values), (episode.input_errors for episode in self.problem.episodes)
        known = all(own is None or np.any(own.torque_noise) for own in errors)
        made = problem_with_whitening_at(self.problem, x, rounds=1 if known else 2)
        return replace(self, problem=problem_with_held_out_kalman_whitening(made, x))

    def with_time_step(self, time_step: float, with_held_out: bool = True) -> AllCandidatesProblem:
        """Return the problem with another time step [s] and whole recordings, whitened by sensor noise alone."""
        made = self.problem.with_time_step(time_step)
        if self.is_split_in_blocks or not with_held_out:
            return replace(self, problem=_in_blocks(made) if self.is_split_in_blocks else made, held_out_spread=None)
        held = self.problem.with_episodes(self.problem.held_out, ()).with_time_step(time_step)
        return replace(self, problem=made.with_episodes(made.episodes, held.episodes), held_out_spread=None)

    def truncate_failing_held_out_recordings(
        self, values: Mapping[str, float], kept_fraction: float
    ) -> tuple[AllCandidatesProblem, tuple[HeldOutTruncation, ...]]:
        """Cut off held-out recordings where the nominal model's simulation fails. Also returns these recordings.

        They keep `kept_fraction` of the duration that the model follows. If too little of every recording remains,
        estimation recordings are split in blocks instead. Residuals are whitened by sensor noise alone.
        """
        problem, x = self.problem, self.problem.unknown_vector(values)
        kept, cuts = [], []
        for episode in problem.held_out:
            whole, h = episode.grid.steps, episode.grid.time_step
            steps = _steps_followed(problem, episode, x)
            if steps == whole:
                kept.append(episode)
                continue
            steps = round(kept_fraction * steps)
            usable = steps * h >= _MIN_PREDICTED_DURATION
            cuts.append(HeldOutTruncation(episode.name, steps * h if usable else 0.0, whole * h))
            kept += [truncate_episode(episode, steps)] if usable else []
        if not cuts:
            return self, ()
        cut = problem.with_episodes(problem.episodes, kept) if kept else _in_blocks(problem)
        return replace(self, problem=cut, is_split_in_blocks=self.is_split_in_blocks or not kept), tuple(cuts)

    def restricted_to_effects(self, effects: Sequence[EffectBase]) -> AllCandidatesProblem:
        """Return a cheaper problem whose step contains only the given candidates.

        A step of all candidates costs three times as much. The problem is unchanged if the filters contain states of
        other candidates.
        """
        if self.functions_of_some is None:
            return self
        key = tuple(sorted(effect.label for effect in effects)), self.problem.step.time_step
        own = _on_step_of_fewer_effects(self.problem, self.functions_of_some(key))
        return self if own is None else replace(self, problem=own, functions_of_some=None)

    def with_nominal_and_effects_free(self, effects: Sequence[EffectBase]) -> EstimationProblem:
        """Return the problem in which the nominal free parameters and all parameters of `effects` are free."""
        own = (name for effect in effects for name in effect.parameters.names)
        return self.problem.with_free_parameters_without_recompiling((*self.nominal_free_parameter_names, *own))

    def with_effects_and_relinearized_filters(
        self, effects: Sequence[EffectBase], at: Mapping[str, float]
    ) -> EstimationProblem:
        """Return the problem with free `effects`, and with filters linearised again at the torque offsets for `at`.

        Filters of held-out recordings are unchanged: see `relinearize_held_out_filters`.
        """
        own = self.with_nominal_and_effects_free(effects)
        return problem_relinearized_at_torque_bias(own, *_beside(own, effects, at)) if own.has_process_noise else own

    def relinearize_held_out_filters(
        self, own: EstimationProblem, effects: Sequence[EffectBase], at: Mapping[str, float]
    ) -> EstimationProblem:
        """Return `own`, from `with_effects_and_relinearized_filters`, with its held-out filters linearised at `at`."""
        if not own.has_process_noise:
            return own
        return problem_with_reestimated_held_out_torque_biases(own, *_beside(own, effects, at))


def compose_candidates(
    problem: EstimationProblem,
    candidates: CandidateNamesOrAll,
    leave_out: Sequence[str],
    held_out: Sequence[Recording],
    progress: Progress,
) -> AllCandidatesProblem:
    """Return the problem with all candidates that are not left out. See `diagnose` for errors."""
    if problem.options.weighting != "whitened":
        what = "a diagnosis needs residuals in units of their noise"
        hint = "set problem.weighting: whitened and the noise levels under `sensors`"
        raise SolverError(what, where="problem.weighting", allowed="whitened", hint=hint)
    effects = make_candidate_effects(problem.system, [episode.recording for episode in problem.episodes], candidates)
    exclude_candidates(effects, leave_out)  # reject names before compilation
    progress.begin_stage(f"composing {len(effects)} candidates into one step", ahead=16.0)
    composed = AllCandidatesProblem.from_problem(problem, effects, held_out)
    return replace(composed, candidate_effects=tuple(exclude_candidates(composed.candidate_effects, leave_out)))


def _on_step_of_fewer_effects(problem: EstimationProblem, functions: ModelFunctions) -> EstimationProblem | None:
    """The problem, its episodes and filters on another step; None where filters contain states that it lacks."""
    whole, part, n = problem.system, functions.step.system, problem.system.n_coordinates
    joints = np.array([whole.mechanism.joint_index(name) for name in part.mechanism.joint_names], np.int64)
    hidden = [*whole.effect_internal_coordinate_symbols]
    inner = np.array([2 * n + hidden.index(name) for name in part.effect_internal_coordinate_symbols], np.int64)
    kept = np.concatenate([joints, n + joints, inner])
    filters = [own for own in (*problem.whitening_filters, *problem.held_out_whitening_filters) if own is not None]
    if any(isinstance(own, WhiteningFilter) and np.delete(own.state_mask, kept).any() for own in filters):
        return None

    def placed(episode: Episode) -> Episode:
        loop, start, rest = episode.tracking_feedback, episode.fixed_initial_state, episode.equilibrium_guess
        loop = loop and replace(loop, state_indices=np.searchsorted(kept, loop.state_indices).astype(np.int32))
        start = start and replace(start, state=start.state[kept])
        rest = None if rest is None else rest[joints]
        return replace(episode, tracking_feedback=loop, fixed_initial_state=start, equilibrium_guess=rest)

    def masked(own: ProcessNoiseWhitener | None) -> ProcessNoiseWhitener | None:
        return replace(own, state_mask=own.state_mask[kept]) if isinstance(own, WhiteningFilter) else own

    episodes, held_out = (list(map(placed, own)) for own in (problem.episodes, problem.held_out))
    made = (list(map(masked, own)) for own in (problem.whitening_filters, problem.held_out_whitening_filters))
    return problem.with_model_functions(functions).with_episodes(episodes, held_out, *made)


def _beside(own: EstimationProblem, effects: Sequence[EffectBase], at: Mapping[str, float]) -> tuple[Array, Array]:
    """Unknowns at some values, and with neutral effects, for the linearisation of filters."""
    return own.unknown_vector(at), own.unknown_vector({**at, **neutral_effect_parameter_values(effects)})


def _same(a: Recording, b: Recording) -> bool:
    """Whether two recordings hold the same positions."""
    first, second = ([group.position for group in (r.joints, *r.points) if group is not None] for r in (a, b))
    return len(first) == len(second) and all(map(partial(np.array_equal, equal_nan=True), first, second))


def _in_blocks(problem: EstimationProblem) -> EstimationProblem:
    """The problem with alternate blocks of its recordings held out."""
    others = [replace(_masked(e, 1), initial_state_shared_with=i) for i, e in enumerate(problem.episodes)]
    return problem.with_episodes([_masked(episode, 0) for episode in problem.episodes], others)


def _steps_followed(problem: EstimationProblem, episode: Episode, x: Array) -> int:
    """Number of steps of a held-out recording that can be rolled out, to within 1/64 of its length."""

    def runs(steps: int) -> bool:
        [(_, result)] = problem.with_episodes(problem.episodes, [truncate_episode(episode, steps)]).predict_held_out(x)
        return not isinstance(result, str)

    low, high = 0, episode.grid.steps
    if runs(high):
        return high
    while high - low > max(episode.grid.steps // 64, 1):
        middle = (low + high) // 2
        low, high = (middle, high) if runs(middle) else (low, middle)
    return low


def _masked(episode: Episode, parity: int) -> Episode:
    """The episode with the measurements of alternate blocks only; its rollout is complete."""
    samples = []
    for entry in episode.measurements:
        t = (entry.node + entry.fraction) * episode.grid.time_step
        hidden = (np.floor(t / _BLOCK_DURATION).astype(int) % 2 != parity)[:, None] & np.ones(entry.value.shape, bool)
        samples.append(mask_out_samples(entry, hidden))
    return replace(episode, measurements=tuple(samples))


def mask_out_samples(samples: SensorMeasurements, hidden: BoolArray) -> SensorMeasurements:
    """Return the measurements without the samples that the mask `hidden` (M, k) marks."""
    return replace(samples, value=np.where(hidden, np.nan, samples.value), weight=np.where(hidden, 0.0, samples.weight))

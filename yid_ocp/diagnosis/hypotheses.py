"""Candidate effects of a diagnosis, and an estimation problem that contains all of them in one compiled step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Literal

import numpy as np

from yid_ocp.arrays import Array, BoolArray, IntArray
from yid_ocp.data.recording import Recording
from yid_ocp.display import Progress, count_with_noun
from yid_ocp.effects import EFFECTS, EffectBase, candidate_kinds_and_locations, make_effect
from yid_ocp.effects.friction import lower_smoothing_speed_to_joint_min
from yid_ocp.errors import ConfigError, DataError, SolverError, unknown_name_error_arguments
from yid_ocp.inference import null_test
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
from yid_ocp.problem.episodes import Episode, truncate_episode, with_encoder_noise_in_effort_std
from yid_ocp.problem.evaluation import ProcessNoiseWhitener
from yid_ocp.problem.measurements import SensorMeasurements
from yid_ocp.problem.model_functions import ModelFunctions
from yid_ocp.problem.recorded_inputs import recorded_signal_kinds
from yid_ocp.solvers import GaussNewton, Solution, fit_problem

CandidateNamesOrAll = Literal["all"] | Sequence[str]
REFIT_SOLVER = GaussNewton(max_iterations=25).with_coarse_tolerances  # good to a part of a std
NOMINAL_SOLVER = replace(REFIT_SOLVER, cost_tolerance=1e-8)

_BLOCK_DURATION = 1.0  # of the blocks into which a recording is split if none is held out, at most a third of it [s]
_MIN_PREDICTED_DURATION = 1.0  # shortest part of a truncated held-out recording that is kept [s]
KEPT_HELD_OUT_FRACTIONS = (0.9, 0.5, 0.0)
"""Fractions of the duration until the simulation of a held-out recording fails, of which it keeps one. All are below 1,
because the simulation deviates before it fails. The next fraction is tried if the refitted model fails earlier."""


def make_candidate_effects(
    system: System, recordings: Sequence[Recording], choice: CandidateNamesOrAll
) -> list[EffectBase]:
    """Return the candidate effects that `choice` names, for a system and the signals in its recordings.

    `choice` is "all", or a list of `kind@location` or `kind` (at all locations that a diagnosis tries). "all" leaves
    out effects of the system. Raises `ConfigError` if the list is empty, or a kind does not exist, has no location here
    or is an effect of the system. Raises `ModelError` if a location does not exist.
    """
    where, sensors = "diagnosis.candidates", recorded_signal_kinds(recordings)
    present = {effect.label for effect in system.effects}
    possible = [pair for pair in candidate_kinds_and_locations(system, sensors) if "@".join(pair) not in present]
    if choice == "all":
        return [_make_candidate(kind, place, system) for kind, place in possible]
    if isinstance(choice, str) or not choice:
        what, hint = f"the candidates are {choice!r}, but must be 'all' or a list", f"leave {where} out to try all"
        raise ConfigError(what, where=where, allowed="all, or a list of kinds such as [joint_coulomb]", hint=hint)
    kinds, own = {kind for kind, _ in possible}, {effect.kind for effect in system.effects}
    if held := [text for text in choice if text in present or text in own - kinds]:
        allowed = ", ".join(dict.fromkeys(kind for kind, _ in possible))
        what, hint = f"the model already has the effect {', '.join(held)}", f"remove {', '.join(held)} from this list"
        raise ConfigError(what, where=where, allowed=allowed, hint=hint)
    pairs: list[tuple[str, str]] = []
    for text in choice:
        kind, _, place = text.partition("@")
        cls = EFFECTS[kind]
        found = [(kind, place)] if place else [pair for pair in possible if pair[0] == kind]
        if not found:
            could = {own for own, _ in candidate_kinds_and_locations(system, {*sensors, *cls.required_sensors})}
            missing = ", ".join(sorted(cls.required_sensors - sensors)) if kind in could else ""
            what = f"the effect {kind} is not possible for this model" + (f" without {missing}" if missing else "")
            allowed, hint = ", ".join(dict.fromkeys(k for k, _ in possible)), f"remove {kind} from this list"
            raise ConfigError(what, where=where, allowed=allowed, hint=f"record {missing}" if missing else hint)
        pairs += [pair for pair in found if pair not in pairs]
    return [_make_candidate(kind, place, system) for kind, place in pairs]


def _make_candidate(kind: str, place: str, system: System) -> EffectBase:
    return lower_smoothing_speed_to_joint_min(make_effect(kind, place, system), system)


def _exclude_candidates(effects: Sequence[EffectBase], names: Sequence[str]) -> list[EffectBase]:
    """Return the candidates `effects` without those that `names` lists (as `kind` or `kind@location`).

    Excluded candidates stay in the compiled step at their neutral values, so that it is not compiled again.
    """
    where, kinds = "diagnosis.excluded_candidates", (effect.kind for effect in effects)
    known = dict.fromkeys([*kinds, *(effect.label for effect in effects)])
    frictions = dict.fromkeys(effect.kind for effect in effects if effect.is_joint_friction)
    for name in names:
        if name not in known:
            alike = (entry for entry in known if ("@" in entry) == ("@" in name))
            said = unknown_name_error_arguments(name, alike, "remove it from the list")
            said |= {"hint": f"list {', '.join(frictions)}"} if "friction" in name and frictions else {}
            raise ConfigError(f"this diagnosis has no candidate '{name}'", where=where, **said)
    kept = [effect for effect in effects if not {effect.kind, effect.label} & set(names)]
    if not kept:
        what, allowed = f"all {len(effects)} candidates are excluded", f"at most {len(effects) - 1} excluded candidates"
        raise ConfigError(what, where=where, allowed=allowed, hint="remove at least one name from this list")
    return kept


def neutral_effect_parameter_values(effects: Sequence[EffectBase]) -> dict[str, float]:
    """Return the values of all parameters of `effects`, by name, at which the effects change nothing."""
    return {name: value for effect in effects for name, value in effect.neutral_values.items()}


def join_effect_labels(effects: Sequence[EffectBase]) -> str:
    """Return the labels `kind@location` of effects, joined with "and"; "the nominal model" without effects."""
    return " and ".join(effect.label for effect in effects) or "the nominal model"


@dataclass(frozen=True)
class HeldOutTruncation:
    """A held-out recording that is cut off because its simulation with the nominal model fails later on."""

    recording: str
    kept_duration: float  # duration that is compared with predictions [s]; 0 if the recording is left out
    full_duration: float  # duration of the whole recording [s]

    def sentence(self, time_step: float) -> str:
        """Return a sentence that states for how long the nominal model with this time step follows the recording."""
        used = f"Only {self.kept_duration:.3g} of {self.full_duration:.3g} s of held-out recording '{self.recording}'"
        more = f"To use more, set problem.time_step: {time_step / 2:.4g}."
        return f"{used} are used, because its simulation then fails. {more}"


@dataclass(frozen=True)
class AllCandidatesProblem:
    """An estimation problem with all candidate effects, whose parameters can be freed without compiling again.

    Sensors, statics and corrections are compiled once with all derivatives, and recordings are placed on the nodes
    once. The tracking filter is computed at the nominal initial values, so it is the same with any effects.
    """

    # system with all candidates at their neutral values, and free nominal parameters
    problem: EstimationProblem
    candidate_effects: tuple[EffectBase, ...]  # candidates to try: neutral in the nominal model and not excluded
    is_split_in_blocks: bool  # whether alternate blocks of the estimation recordings are held out, without other ones
    # functions of the nominal system with some candidates, by their labels and the time step [s]
    functions_of_some: CasadiLockedCache[tuple[tuple[str, ...], float], ModelFunctions] | None = None
    refit_solver: GaussNewton = REFIT_SOLVER  # of all refits
    held_out_spread: Array | None = None  # change (n, k) of held-out residuals by one std of each nominal parameter
    # of screenings that share them, by point of the shape grid: changes of residual and, by unknown, Jacobian (n,)
    changes_by_encoder_noise: dict[int, list[tuple[Array, dict[str, Array]]]] = field(default_factory=dict)
    truncated_recordings: Mapping[str, HeldOutTruncation] = field(default_factory=dict)  # by name of the recording
    is_corrected_for_links: bool = False  # whether the data lack the error of the finite number of links
    chi2_removed_by_discretisation: float = 0.0  # r'r that finer steps and this correction have removed

    @staticmethod
    def from_problem(
        problem: EstimationProblem, effects: Sequence[EffectBase], held_out: Sequence[Recording] = ()
    ) -> AllCandidatesProblem:
        """Return a problem with neutral candidates. Raises `DataError` if an estimation recording is held out too."""
        effects = tuple(effects)
        joint = compile_step_like(problem.step, problem.step.system.with_effects(effects))
        estimate = [episode.recording for episode in problem.episodes]
        held = [*held_out] or [episode.recording for episode in problem.held_out]
        if repeated := [own.name for own in held if any(_same(own, other) for other in estimate)]:
            what = f"recording '{repeated[0]}' is used both for the estimate and as held-out recording"
            hint = "pass other recordings, or none: then blocks of time of the recordings are held out"
            raise DataError(what, where="held_out, recordings.held_out", allowed="other recordings", hint=hint)
        values = dict(zip(problem.system.parameters.names, map(float, problem.theta), strict=True))
        extra = [name for effect in effects for name in effect.parameters.names]
        made = EstimationProblem(joint, estimate, problem.free, problem.options, values, held, extra, problem)

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
    def problem_fitting_all_samples(self) -> EstimationProblem:
        """The problem with all candidates and all samples: alternate blocks that are held out are estimated on, too."""
        if not self.is_split_in_blocks:
            return self.problem

        def joined(own: Episode, other: Episode) -> Episode:
            pairs = zip(own.measurements, other.measurements, strict=True)
            parts = [replace(a, value=np.fmax(a.value, b.value), weight=a.weight + b.weight) for a, b in pairs]
            return replace(own, measurements=tuple(parts))

        return self.problem.with_episodes(list(map(joined, self.problem.episodes, self.problem.held_out)), ())

    def candidates_with_prior_ranges_from_states(self, states: Sequence[Array]) -> tuple[EffectBase, ...]:
        """Return the candidates with prior ranges for the largest joint angles of each segment in `states` (N, nx)."""
        mechanism, largest = self.problem.system.mechanism, {}
        for segment in self.problem.system.segment_layouts:
            index = [mechanism.joint_index(joint) for link in segment.link_joints for joint in link]
            largest[segment.name] = max(float(np.abs(state[:, index]).max()) for state in states)
        return tuple(effect.with_prior_ranges_for_largest_angles(largest) for effect in self.candidate_effects)

    def with_whitening_linearized_at(
        self, values: Mapping[str, float], effects: Sequence[EffectBase] = ()
    ) -> AllCandidatesProblem:
        """Return the problem whitened by sensor and input noise, with filters linearised at the parameters `values`.

        `effects` are those that are not neutral at `values`.
        """
        own = replace(self, problem=self.problem.with_equilibria_near_first_points(values))
        if not own.problem.has_process_noise:
            return own
        # filters of the nominal step are those of all candidates, which are neutral
        made = (own if effects else own.with_step_of_only_effects(())).problem
        # filters are linearised about the estimated torques, so these must be known first
        x, errors = made.pack_unknowns(values), (episode.input_errors for episode in made.episodes)
        known = all(own is None or np.any(own.torque_noise) for own in errors)
        made = problem_with_held_out_kalman_whitening(problem_with_whitening_at(made, x, rounds=1 if known else 2), x)
        made = problem_with_reestimated_held_out_torque_biases(problem_relinearized_at_torque_bias(made, x, x), x, x)
        return replace(own, problem=_with_filters_of_part(own.problem, made))

    @cached_property
    def estimated_at_half_time_step(self) -> EstimationProblem:
        """The problem with half the time step, without held-out recordings, whitened by sensor noise alone."""
        made = self.problem.with_time_step(self.problem.step.time_step / 2)
        return _in_blocks(made) if self.is_split_in_blocks else made

    def with_half_time_step(self, removed_chi2: float) -> AllCandidatesProblem:
        """Return the problem with half the time step, which removes `removed_chi2` of r'r.

        Recordings are whole, with their own data, and whitened by sensor noise alone.
        """
        made, held = self.estimated_at_half_time_step, self.problem.with_episodes(self.problem.held_out, ())
        if not self.is_split_in_blocks:
            made = made.with_episodes(made.episodes, held.with_time_step(made.step.time_step).episodes)
        removed = self.chi2_removed_by_discretisation + removed_chi2
        anew = replace(self, problem=made, held_out_spread=None, chi2_removed_by_discretisation=removed)
        return replace(anew, truncated_recordings={}, is_corrected_for_links=False)

    def with_smoothed_input_errors_of(self, fitted: EstimationProblem | None) -> AllCandidatesProblem:
        """Return the problem with the smoothed errors of torques and angles of a fit to the same recordings."""
        if fitted is None:
            return self
        pairs, held_out = zip(self.problem.episodes, fitted.episodes, strict=True), self.problem.held_out
        told = [replace(episode, input_errors=own.input_errors) for episode, own in pairs]
        return replace(self, problem=self.problem.with_episodes(told, held_out))

    def with_encoder_noise_in_efforts(
        self, effects: Sequence[EffectBase], values: Mapping[str, float]
    ) -> AllCandidatesProblem | None:
        """Return the problem with the noise of compared efforts that encoder noise causes beside `effects`.

        None if no joint's noise is clearly larger than now. Whitening is by sensor noise alone.
        """
        own, now = self.problem_with_nominal_and_effects_free(effects), self.problem
        theta, _ = own.unpack_episode_unknowns(own.pack_unknowns(values), 0)
        told = partial(with_encoder_noise_in_effort_std, now.step, options=now.options, theta=theta)
        made = now.with_episodes([*map(told, now.episodes)], [*map(told, now.held_out)])
        pairs = zip(now.episodes, made.episodes, strict=True)
        samples = (own for before, after in pairs for own in zip(before.measurements, after.measurements, strict=True))
        growth = [np.nanmedian(new.std / old.std, axis=0).max() for old, new in samples if old.sensor.effort_joints]
        is_noisier = max(growth, default=1.0) > null_test.MIN_NOISE_GROWTH
        return replace(self, problem=made, held_out_spread=None) if is_noisier else None

    def truncate_failing_held_out_recordings(
        self, values: Mapping[str, float], kept_fraction: float
    ) -> tuple[AllCandidatesProblem, tuple[HeldOutTruncation, ...]]:
        """Return the problem with truncated held-out recordings where their simulation at `values` fails, and a list.

        A truncated recording keeps `kept_fraction` of the duration until the failure, and is left out if this is less
        than 1 s. If none remains, blocks of the estimation recordings are held out. Whitening is by sensor noise alone.
        """
        problem, x = self.problem, self.problem.pack_unknowns(values)
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
        known, is_split = {own.recording: own for own in cuts}, self.is_split_in_blocks or not kept
        told = {**self.truncated_recordings, **known}
        return replace(self, problem=cut, is_split_in_blocks=is_split, truncated_recordings=told), tuple(cuts)

    def with_step_of_only_effects(self, effects: Sequence[EffectBase]) -> AllCandidatesProblem:
        """Return the problem on a step of `effects` only (a third of the cost), unchanged if filters need others."""
        if self.functions_of_some is None:
            return self
        key = tuple(sorted(effect.label for effect in effects)), self.problem.step.time_step
        own = _on_step_of_fewer_effects(self.problem, self.functions_of_some(key))
        return self if own is None else replace(self, problem=own, functions_of_some=None)

    def problem_with_nominal_and_effects_free(self, effects: Sequence[EffectBase]) -> EstimationProblem:
        """Return the problem in which the nominal free parameters and all parameters of `effects` are free."""
        own = (name for effect in effects for name in effect.parameters.names)
        return self.problem.with_free_parameters_without_recompiling((*self.problem.free, *own))

    def problem_with_effects_and_relinearized_filters(
        self, effects: Sequence[EffectBase], at: Mapping[str, float]
    ) -> EstimationProblem:
        """Return the problem with free `effects`, and whitening of estimation recordings linearised at values `at`."""
        own = self.problem_with_nominal_and_effects_free(effects)
        return problem_relinearized_at_torque_bias(own, *_beside(own, effects, at)) if own.has_process_noise else own

    def relinearize_held_out_filters_of_problem(
        self, own: EstimationProblem, effects: Sequence[EffectBase], at: Mapping[str, float]
    ) -> EstimationProblem:
        """Return `own` (with free `effects`), and whitening of held-out recordings linearised at values `at`."""
        if not own.has_process_noise:
            return own
        return problem_with_reestimated_held_out_torque_biases(own, *_beside(own, effects, at))


def fit_with_encoder_noise_in_points(
    problem: EstimationProblem, solution: Solution | None, progress: Progress
) -> tuple[EstimationProblem, Solution | None]:
    """Return the problem whose noise of points contains that of encoders that move the object, and its nominal fit.

    Without such noise, the problem and the `solution` of the nominal model are returned unchanged.
    """
    if not null_test.encoders_move_object(problem):
        return problem, solution
    progress.begin_stage("fitting the nominal model", 3.0, 18.5)
    solution = solution or fit_problem(problem, NOMINAL_SOLVER, verdicts=False)
    noisier, said = null_test.problem_with_encoder_noise_in_points(problem, solution.x)
    if not said:
        return problem, solution
    progress.begin_stage(f"counting noise of encoders as noise of points ({said})", 3.0, 18.5)
    return noisier, fit_problem(noisier, NOMINAL_SOLVER, solution.x.tolist(), verdicts=False)


def make_all_candidates_problem(
    problem: EstimationProblem,
    candidates: CandidateNamesOrAll,
    leave_out: Sequence[str],
    held_out: Sequence[Recording],
    progress: Progress,
) -> AllCandidatesProblem:
    """Return the problem with all `candidates` except `leave_out` as candidates to try. Errors are as in `diagnose`."""
    if problem.options.weighting != "whitened":
        what = f"problem.weighting is '{problem.options.weighting}', but a diagnosis needs 'whitened' residuals"
        hint = "set problem.weighting: whitened and the noise levels under `sensors`"
        raise SolverError(what, where="problem.weighting", allowed="whitened", hint=hint)
    effects = make_candidate_effects(problem.system, [episode.recording for episode in problem.episodes], candidates)
    kept = _exclude_candidates(effects, leave_out)  # rejects names before compilation
    progress.begin_stage(f"building one model with {count_with_noun(len(effects), 'candidate effect')}", ahead=19.5)
    composed = AllCandidatesProblem.from_problem(problem, effects, held_out)
    return replace(composed, candidate_effects=tuple(kept))


def _states_of_part(whole: System, part: System) -> tuple[IntArray, IntArray]:
    """Return the indices in `whole` of the states, and of the coordinates, of a system with some of its effects."""
    n, hidden = whole.n_coordinates, [*whole.effect_internal_coordinate_symbols]
    joints = np.array([whole.mechanism.joint_index(name) for name in part.mechanism.joint_names], np.int64)
    inner = np.array([2 * n + hidden.index(name) for name in part.effect_internal_coordinate_symbols], np.int64)
    return np.concatenate([joints, n + joints, inner]), joints


def _with_filters_of_part(problem: EstimationProblem, part: EstimationProblem) -> EstimationProblem:
    """Return the problem with input errors and filters of the same problem on a step of fewer effects."""
    kept, joints = _states_of_part(problem.system, part.system)

    def placed(episode: Episode, own: Episode) -> Episode:
        guess = own.equilibrium_guess
        if guess is not None:
            guess = np.zeros(problem.system.n_coordinates)
            guess[joints] = own.equilibrium_guess
        return replace(episode, input_errors=own.input_errors, equilibrium_guess=guess)

    def masked(own: ProcessNoiseWhitener | None) -> ProcessNoiseWhitener | None:
        if not isinstance(own, WhiteningFilter):
            return own
        return replace(own, state_mask=np.isin(np.arange(problem.step.sizes["nx"]), kept[own.state_mask]))

    episodes, held_out = map(placed, problem.episodes, part.episodes), map(placed, problem.held_out, part.held_out)
    made = (list(map(masked, own)) for own in (part.whitening_filters, part.held_out_whitening_filters))
    return problem.with_episodes(list(episodes), list(held_out), *made)


def _on_step_of_fewer_effects(problem: EstimationProblem, functions: ModelFunctions) -> EstimationProblem | None:
    """Return the problem on a step of fewer effects. None if its whitening filters have states that the step lacks."""
    kept, joints = _states_of_part(problem.system, functions.step.system)
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
    """Return the unknowns for the parameters `at`, and for `at` with neutral effects, to linearise filters."""
    return own.pack_unknowns(at), own.pack_unknowns({**at, **neutral_effect_parameter_values(effects)})


def _same(a: Recording, b: Recording) -> bool:
    """Return whether two recordings hold the same positions of joints and points."""
    first, second = ([group.position for group in (r.joints, *r.points) if group is not None] for r in (a, b))
    return len(first) == len(second) and all(map(partial(np.array_equal, equal_nan=True), first, second))


def _in_blocks(problem: EstimationProblem) -> EstimationProblem:
    """Return the problem in which alternate blocks of its estimation recordings are held out."""
    others = [replace(_masked(e, 1), initial_state_shared_with=i) for i, e in enumerate(problem.episodes)]
    return problem.with_episodes([_masked(episode, 0) for episode in problem.episodes], others)


def _steps_followed(problem: EstimationProblem, episode: Episode, x: Array) -> int:
    """Return how many steps of a held-out recording can be simulated, to within 1/64 of its length."""

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
    """Return the episode with measurements of alternate blocks (`parity` 0 or 1) only; all of it is simulated."""
    samples, block = [], min(_BLOCK_DURATION / episode.grid.time_step, episode.grid.steps / 3)
    for entry in episode.measurements:
        is_hidden = np.floor((entry.node + entry.fraction) / block).astype(int) % 2 != parity
        samples.append(hide_marked_measurements(entry, is_hidden[:, None]))
    return replace(episode, measurements=tuple(samples))


def hide_marked_measurements(samples: SensorMeasurements, hidden: BoolArray) -> SensorMeasurements:
    """Return the measurements without the samples that the mask `hidden`, (M, k) or (M, 1), marks."""
    return replace(samples, value=np.where(hidden, np.nan, samples.value), weight=np.where(hidden, 0.0, samples.weight))

"""Random cases of a blind test: plan, synthetic recordings, sealed labels, and their diagnosis without labels."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.data.recording import Recording
from yid_ocp.diagnosis.diagnose import diagnose, fit_nominal_model
from yid_ocp.diagnosis.diagnosis_result import DiagnosisResult
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem, CandidateNamesOrAll, make_candidate_effects
from yid_ocp.diagnosis.refit import RefitContext, refit_with_effects
from yid_ocp.diagnosis.screening import DETECTABLE_AMPLITUDE_Z, linearize_candidates
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.effects.base import EffectBase, elastic_joints_of_segment
from yid_ocp.errors import ConfigError, DataError, ModelError, YidError
from yid_ocp.inference.null_test import held_out_gap_closure
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.recorded_inputs import select_path_cutoff
from yid_ocp.virtual.experiment import ArmSensorNoise, PointCamera, VirtualExperimentSettings
from yid_ocp.virtual.injected import (
    INJECTABLE_EFFECT_KINDS,
    OUT_OF_LIBRARY_FORCE_BUILDERS,
    InjectedEffect,
    run_experiment_with_injected_effects,
    typical_friction_amplitude_range,
)
from yid_ocp.virtual.joint_motion import MultisineOptions, random_multisine_motion
from yid_ocp.virtual.mujoco_simulation import SimulationOptions

_DETECTABLE_MULTIPLES = (1.0, 3.0, 10.0)  # multiples of the detectable size
BLIND_CASE_CATEGORY_SHARES: Mapping[str, float] = {
    "null": 0.2,
    "single": 0.48,
    "pair": 0.1,
    "outside": 0.1,
    "left_out": 0.06,
    "finer_chain": 0.06,
}
"""Fraction of all cases in each category (`CaseGroundTruth.category`)."""
BLIND_ENSEMBLE_PURPOSES = ("report", "calibration")  # one seed gives different cases for each purpose
_MIN_CASES_PER_EXPERIMENT = 3  # experiments with fewer cases are left out, because each must be compiled


@dataclass(frozen=True)
class PlannedBlindCase:
    """The plan of one blind-test case, with its number, experiment, category and effect size."""

    number: int
    experiment: str
    category: str  # key of `BLIND_CASE_CATEGORY_SHARES`
    multiple: float | None  # effect size as a multiple of the detectable size; None if not applicable
    is_brisk: bool = False  # whether the motion has three times the usual acceleration


def plan_blind_cases(
    count: int,
    seed: int,
    weights: Mapping[str, float],
    chains: frozenset[str] = frozenset(),
    purpose: str = BLIND_ENSEMBLE_PURPOSES[0],
) -> list[PlannedBlindCase]:
    """Plan `count` blind-test cases in random order, each with an experiment, effect category and effect size.

    `weights` holds the share of cases of each experiment. An experiment whose share is less than
    `_MIN_CASES_PER_EXPERIMENT` cases gets none; if this holds for all, the largest gets all. The category `finer_chain`
    needs an experiment in `chains`. `seed` and `purpose` determine the order.
    """
    total = sum(weights.values())
    kept = {name: part / total for name, part in weights.items() if count * part / total >= _MIN_CASES_PER_EXPERIMENT}
    kept = kept or {max(weights, key=lambda name: weights[name]): 1.0}
    slots: list[tuple[str, float | None]] = []
    for category, number in _dealt(count, BLIND_CASE_CATEGORY_SHARES).items():
        sizes = {_DETECTABLE_MULTIPLES[-1] if category in ("pair", "left_out") else None: number}
        if category == "single":
            sizes = _dealt(number, dict.fromkeys(_DETECTABLE_MULTIPLES, 1.0))
        slots += [(category, size) for size, times in sizes.items() for _ in range(times)]
    # the experiment furthest behind its share gets the next case, so that all have all categories
    given = dict.fromkeys(kept, 0)
    cases = []
    slots.sort(key=lambda slot: slot[0] != "finer_chain")  # rare categories first; later cases balance the shares
    for i, slot in enumerate(slots):
        able = [name for name in kept if slot[0] != "finer_chain" or name in chains]
        name = max(able or kept, key=lambda entry: kept[entry] * (i + 1) - given[entry])
        given[name] += 1
        cases.append((name, *(slot if able else ("single", _DETECTABLE_MULTIPLES[1]))))
    order = np.random.default_rng([seed, BLIND_ENSEMBLE_PURPOSES.index(purpose), 2]).permutation(count)
    # every third clean case, so that each experiment has some
    brisk = {place for i, place in enumerate(p for p, (_, kind, _) in enumerate(cases) if kind == "null") if i % 3 == 1}
    return [PlannedBlindCase(number, *cases[int(place)], int(place) in brisk) for number, place in enumerate(order)]


def _dealt(count: int, parts: Mapping[Any, float]) -> dict[Any, int]:
    """Return whole numbers with the sum `count` in the proportions `parts` (method of largest remainders)."""
    total = sum(parts.values())
    exact = {key: count * part / total for key, part in parts.items()}
    found = {key: int(value) for key, value in exact.items()}
    for key in sorted(exact, key=lambda key: found[key] - exact[key])[: count - sum(found.values())]:
        found[key] += 1
    return found


MAX_DRAWS_PER_CASE = 64  # motions, objects and effects; with eight, 1 of 300 cases was not simulated
_STIFFNESS_SPREAD_FACTOR = 1.5  # factor by which true stiffnesses lie above or below the problem's start, at most
_PRIOR_DEVIATIONS = (0.6, 1.0)  # deviation of a parameter with a prior from its initial value, in stds of the prior
_BRISK_FREQUENCY_FACTOR = 1.41  # together with the second harmonic, triples the accelerations
_OUT_OF_LIBRARY_SIZES: Mapping[str, tuple[str, float, float, str]] = {
    "torque_ripple": ("joint", 0.5, 2.0, ""),
    "saturating_drive": ("joint", 0.75, 0.9, "torque"),
    "warming_gear": ("joint", 1.0, 4.0, ""),
    "shifting_load": ("joint", 0.5, 2.0, ""),
    "slipping_grasp": ("grasp", 0.004, 0.01, ""),
    "cross_stiffness": ("segment", 0.3, 0.6, "stiffness"),
    "quadratic_stiffness": ("segment", 2.0, 5.0, "stiffness"),
    "crease": ("segment", 0.3, 0.7, "stiffness"),
    "gusts": ("segment", 0.05, 0.15, ""),
    "tether": ("segment", 5.0, 20.0, ""),
    "magnet": ("segment", 0.1, 0.4, ""),
    "wall": ("segment", 10.0, 50.0, ""),
    "stiffness_drift": ("segment", 0.2, 0.5, ""),
    "one_way_damping": ("segment", 0.3, 1.0, ""),
}
"""Effects outside the library, by kind: type of location, smallest and largest size, what relative sizes refer to."""
_GRIPPER_TRAVEL, _SHARED_GRIPPER_TRAVEL = 0.15, 0.05
"""Travel [m] of a single gripper, and of several on one object, which snaps over in a sixth of motions of 0.08 m."""


@dataclass(frozen=True)
class CaseGroundTruth:
    """The true effects and parameters of a blind-test case, which stay sealed until scoring."""

    case: str
    category: str  # null, single, pair, outside, left_out or finer_chain
    injected: tuple[InjectedEffect, ...]
    multiple: float | None  # true size over the detectable size; None if not applicable
    truth: Mapping[str, float]  # true values of the nominal parameters
    experiment: str = ""  # experiment of the case

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> CaseGroundTruth:
        """Restore the true effects and parameters from a dictionary that `asdict` returned."""
        return CaseGroundTruth(**{**data, "injected": tuple(InjectedEffect(**entry) for entry in data["injected"])})


@dataclass(frozen=True)
class UnlabelledCase:
    """A blind-test case as the diagnosis sees it: recordings, and effect kinds excluded from the candidates."""

    name: str
    estimation_recordings: tuple[Recording, ...]
    held_out_recording: Recording
    excluded_kinds: tuple[str, ...]  # includes the true kind only in the category left_out


def labels_json_and_sha256(labels: Sequence[CaseGroundTruth]) -> tuple[str, str]:
    """Return the labels of cases as JSON text, and its SHA-256 hash, which is written before the diagnosis."""
    text = json.dumps([asdict(label) for label in labels], indent=1, sort_keys=True, allow_nan=False)
    return text, hashlib.sha256(text.encode()).hexdigest()


def read_labels_checking_sha256(text: str, commitment: str) -> list[CaseGroundTruth]:
    """Read the sealed labels of cases from JSON `text`. Raises `DataError` if its SHA-256 hash is not `commitment`."""
    if hashlib.sha256(text.encode()).hexdigest() != commitment:
        what, hint = "sealed/labels.json was changed after the diagnosis began", "copy the original file back"
        where, allowed = "sealed/labels.json", f"the file with the SHA-256 in commitment.json, {commitment[:12]}..."
        raise DataError(what, where=where, allowed=allowed, hint=hint)
    return [CaseGroundTruth.from_dict(entry) for entry in json.loads(text)]


@dataclass(frozen=True)
class SyntheticRecordingConditions:
    """The settings for an experiment's synthetic recordings: number, sensor noise, simulation and camera."""

    estimation_count: int = 1  # number of estimation recordings; one more is held out
    arm_noise: ArmSensorNoise = field(default_factory=ArmSensorNoise)
    simulation: SimulationOptions = field(default_factory=SimulationOptions)  # duration of each, and MuJoCo's time step
    has_camera: bool = False  # whether a camera sees the object
    # friction that MuJoCo simulates with sticking, like injected friction; None: both are smooth forces
    ordinary_friction: Sequence[InjectedEffect] | None = None
    is_brisk: bool = False  # whether the motion has three times the usual acceleration
    purpose: str = BLIND_ENSEMBLE_PURPOSES[0]  # one of `BLIND_ENSEMBLE_PURPOSES`


_Detectable = tuple[EffectBase, Mapping[str, float], Array]
"""A candidate, its shape parameters, and F (p, p): amplitudes a change the whitened residual by |F a|."""


class BlindCaseGenerator:
    """A generator of random blind-test cases for one experiment. Raises `ConfigError` if no joint is driven.

    Parameters
    ----------
    problem : EstimationProblem
        Defines the system, options and free parameters of all cases. Its first recording gives the first joint angles.
    finer : callable, optional
        Function that returns the system with each link divided into a given number, for the category `finer_chain`.
    simulated_system : System, optional
        The same system with driven arms, which is simulated. Default: the system of the problem.
    """

    def __init__(
        self,
        problem: EstimationProblem,
        seed: int,
        finer: Callable[[int], System] | None = None,
        candidates: CandidateNamesOrAll = "all",
        *,
        simulated_system: System | None = None,
        conditions: SyntheticRecordingConditions | None = None,
    ) -> None:
        self.simulated_system = problem.system if simulated_system is None else simulated_system
        if not self.simulated_system.driven or self.simulated_system.prescribed:
            what, allowed = "the arms have prescribed joints, or no driven ones", "driven joints alone"
            raise ConfigError(what, where="model.arms.mode", allowed=allowed, hint="set model.arms.mode: driven")
        self.problem, self.seed, self._finer = problem, seed, finer
        self.candidates = candidates
        recording = problem.episodes[0].recording
        self.initial_configuration = first_recorded_driven_joint_positions(self.simulated_system, recording)
        seen = any(group.camera_pose is not None for group in recording.points)
        self.conditions = replace(conditions or SyntheticRecordingConditions(), has_camera=seen)
        self._effects = make_candidate_effects(problem.system, [recording], candidates)
        if not {effect.kind for effect in self._effects} & set(INJECTABLE_EFFECT_KINDS):
            what, hint = "the blind test cannot inject any of the candidates", "add one of these kinds to this list"
            raise ConfigError(what, where="diagnosis.candidates", allowed=", ".join(INJECTABLE_EFFECT_KINDS), hint=hint)

    def _rng(self, *path: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, BLIND_ENSEMBLE_PURPOSES.index(self.conditions.purpose), *path])

    def _draw_true_parameters(self, rng: np.random.Generator) -> dict[str, float]:
        """Draw true values of the free parameters (log-uniform, or from a prior) and of all ordinary friction."""
        system, priors = self.problem.system, self.problem.options.prior_stds
        start = dict(zip(system.parameters.names, map(float, self.problem.theta), strict=True))
        drawn = {name: start[name] * _STIFFNESS_SPREAD_FACTOR ** rng.uniform(-1, 1) for name in self.problem.free}
        stated = self.problem.episodes[0].known_parameters
        for name in (own for own in drawn if own in priors):  # a set would have another order in each process
            drawn[name] = start[name] + priors[name] * rng.uniform(*_PRIOR_DEVIATIONS) * rng.choice([-1.0, 1.0])
        for effect in self._ordinary_friction:
            drawn |= {name: start[name] for name in effect.shape_parameter_names}
            for name in effect.amplitude_parameter_names:
                drawn[name] = rng.uniform(*typical_friction_amplitude_range(effect, system))
        return {name: float(value) for name, value in {**drawn, **stated}.items()}

    @property
    def _ordinary_friction(self) -> tuple[EffectBase, ...]:
        """Friction of the nominal model that is not in the simulated system, because MuJoCo simulates it itself."""
        known = {(effect.kind, effect.location) for effect in self.simulated_system.effects}
        own = (effect for effect in self.problem.system.effects if isinstance(effect, EffectBase))
        return tuple(effect for effect in own if (effect.kind, effect.location) not in known)

    def simulate_synthetic_recording(
        self,
        truth: Mapping[str, float],
        injected: Sequence[InjectedEffect],
        rng: np.random.Generator,
        name: str,
        planned: PlannedBlindCase | None = None,
    ) -> Recording:
        """Simulate one recording with the true values `truth` and injected effects. It does not contain these."""
        nominal, posture = self.simulated_system, self.initial_configuration
        finer = self._finer if planned is not None and planned.category == "finer_chain" else None
        system = nominal if finer is None else finer(2)
        friction = [
            InjectedEffect(own.kind, own.location, {q.name: truth[f"{own.label}.{q.name}"] for q in own.definitions})
            for own in self._ordinary_friction
        ]
        own = {name: value for name, value in truth.items() if name in nominal.parameters.names}
        values = own if finer is None else scale_parameters_to_more_links(nominal, system, own)
        is_held = self.conditions.ordinary_friction is not None
        conditions = replace(self.conditions, ordinary_friction=tuple(friction) if is_held else None)
        conditions = replace(conditions, is_brisk=planned is not None and planned.is_brisk)
        made = simulate_random_motion(nominal, system, posture, own, values, injected, rng, conditions)
        return replace(made, name=name, description="", source="", true_parameters={})

    def _nominal_problem(self, recordings: Sequence[Recording]) -> EstimationProblem:
        nominal = self.problem
        values = dict(zip(nominal.system.parameters.names, map(float, nominal.theta), strict=True))
        values |= nominal.episodes[0].known_parameters
        # motions differ between cases; a filter for the first recording could remove motion of the others
        cutoff = max(nominal.options.path_cutoff, select_path_cutoff(recordings, nominal.system.prescribed))
        options = replace(nominal.options, path_cutoff=cutoff)
        return EstimationProblem(nominal.step, list(recordings), nominal.free, options, values)

    def _detectable_candidates(
        self, truth: Mapping[str, float], clean: Sequence[Recording], held_out: Recording
    ) -> list[_Detectable]:
        """Return every candidate with its sensitivity at the parameters `truth` of recordings without effects."""
        problem = self._nominal_problem(clean)
        effects = make_candidate_effects(problem.system, clean, self.candidates)
        composed = AllCandidatesProblem.from_problem(problem, effects, [held_out])
        _, signatures = linearize_candidates(composed.with_whitening_linearized_at(truth), (), truth)
        return [(s.effect, s.shape_values, np.linalg.qr(s.projected_sensitivity).R) for s in signatures]

    def draw_recordings_and_ground_truth(self, planned: PlannedBlindCase) -> tuple[UnlabelledCase, CaseGroundTruth]:
        """Return the recordings of a planned case, and its label. Raises `ModelError` if no draw can be simulated."""
        name = f"case_{planned.number:03d}"
        for attempt in range(MAX_DRAWS_PER_CASE):
            rng = self._rng(1, planned.number, attempt)
            truth = self._draw_true_parameters(rng)
            try:
                injected, multiple = self._injected(planned, truth, attempt, rng)
                *estimate, held_out = self._case_recordings(planned, truth, injected, attempt)
            except YidError as error:
                lately = error.what  # this motion cannot be simulated or recorded; draw another
                continue
            kinds = sorted({effect.kind for effect in self._effects} - {effect.kind for effect in injected})
            other = (str(rng.choice(kinds)),) if len(kinds) > 1 else ()
            left_out = (injected[0].kind,) if planned.category == "left_out" else other
            label = CaseGroundTruth(name, planned.category, injected, multiple, truth, planned.experiment)
            return UnlabelledCase(name, tuple(estimate), held_out, left_out), label
        what = f"MuJoCo simulated none of {MAX_DRAWS_PER_CASE} random motions, lately because {lately}"
        allowed = "one motion that stays finite"
        where, hint = f"{name} of experiment {planned.experiment}", "set another --seed; next, a larger model.damping"
        raise ModelError(what, where=where, allowed=allowed, hint=hint)

    def _case_recordings(
        self, planned: PlannedBlindCase, truth: Mapping[str, float], injected: Sequence[InjectedEffect], attempt: int
    ) -> list[Recording]:
        """Simulate a case, the last recording held out. Motions and noise are the same with and without effects."""
        rng, estimate = self._rng(1, planned.number, attempt, 1), range(self.conditions.estimation_count)
        purposes = (*(f"estimate_{i}" for i in estimate), "held_out")
        names = (f"case_{planned.number:03d}_{purpose}" for purpose in purposes)
        return [self.simulate_synthetic_recording(truth, injected, rng, name, planned) for name in names]

    def _injected(
        self, wanted: PlannedBlindCase, truth: Mapping[str, float], attempt: int, rng: np.random.Generator
    ) -> tuple[tuple[InjectedEffect, ...], float | None]:
        """Draw the effects of a case, with sizes relative to the detectable sizes in the motions of this case."""
        if wanted.category in ("null", "finer_chain"):
            return (), None
        if wanted.category == "outside":
            return (self._outside(rng),), None
        size = _DETECTABLE_MULTIPLES[-1] if wanted.multiple is None else wanted.multiple
        *clean, held_out = self._case_recordings(wanted, truth, (), attempt)
        detectable = self._detectable_candidates(truth, clean, held_out)
        drawn = [_inside(detectable, rng, size) for _ in range(2 if wanted.category == "pair" else 1)]
        labels = [effect.label for effect, _ in drawn]
        return tuple(e for i, (e, _) in enumerate(drawn) if e.label not in labels[:i]), drawn[0][1]

    def _outside(self, rng: np.random.Generator) -> InjectedEffect:
        system = self.simulated_system
        places: dict[str, tuple[str, ...]] = {
            "joint": system.driven[: max(len(system.driven) // 2, 1)],
            "segment": tuple(segment.name for segment in system.segment_layouts),
            "grasp": tuple(grasp.name for grasp in system.grasps),
        }
        kinds = [kind for kind in OUT_OF_LIBRARY_FORCE_BUILDERS if places[_OUT_OF_LIBRARY_SIZES[kind][0]]]
        kind = str(rng.choice(kinds))
        place, low, high, part_of = _OUT_OF_LIBRARY_SIZES[kind]
        location = str(rng.choice(places[place]))
        size = float(rng.uniform(low, high))
        if part_of == "torque":
            size *= self._largest_torque(location)
        elif part_of == "stiffness":
            start = dict(zip(self.problem.system.parameters.names, self.problem.theta, strict=True))
            bends = any(spring.deformation == "bend" for spring in elastic_joints_of_segment(system, location))
            size *= float(start.get(f"{location}.bend", 10.0)) if bends else 10.0
        return InjectedEffect(kind, location, {"size": size})

    def _largest_torque(self, joint: str) -> float:
        """Return the largest torque [N m] of a joint in the problem's first recording; 10 if it has no torques."""
        recorded = self.problem.episodes[0].recording.joints
        if recorded is None or recorded.effort is None or joint not in recorded.names:
            return 10.0
        return float(np.nanmax(np.abs(recorded.effort[:, recorded.names.index(joint)])))


def _inside(detectable: Sequence[_Detectable], rng: np.random.Generator, wanted: float) -> tuple[InjectedEffect, float]:
    """Draw an effect of the library at `wanted` times its detectable size, or the nearest size within its range."""
    groups: dict[str, dict[str, list[_Detectable]]] = {}
    for entry in (own for own in detectable if own[0].kind in INJECTABLE_EFFECT_KINDS):
        groups.setdefault(entry[0].kind, {}).setdefault(entry[0].location, []).append(entry)
    drawn = []
    for _ in range(40):
        kind = str(rng.choice(sorted(groups)))
        shapes = groups[kind][str(rng.choice(sorted(groups[kind])))]
        found = _sized(shapes[int(rng.choice(len(shapes)))], rng, wanted)
        if found is not None and found[1] > 0.9 * wanted:
            return found[0], wanted
        drawn += [] if found is None else [found]
    return max(drawn, key=lambda entry: entry[1])


def _sized(entry: _Detectable, rng: np.random.Generator, wanted: float) -> tuple[InjectedEffect, float] | None:
    """Draw amplitudes at `wanted` times the detectable size, limited to the range. None without sensitivity."""
    (effect, shape, factor), names = entry, entry[0].amplitude_parameter_names
    neutral = np.array([effect.neutral_values[n] for n in names])
    low, high = np.array([effect.prior_ranges[n] for n in names]).T - neutral
    way = rng.uniform(low, high)
    seen = float(np.linalg.norm(factor @ way))
    if seen <= 0:
        return None
    reach = np.min(np.where(way > 0, high, low)[way != 0] / way[way != 0])
    times = min(wanted * DETECTABLE_AMPLITUDE_Z / seen, float(reach))
    values = {**dict(zip(names, neutral + times * way, strict=True)), **shape}
    reported = {name: told.value for name, told in effect.to_reported_parameters(values).items()}
    return InjectedEffect(effect.kind, effect.location, reported), times * seen / DETECTABLE_AMPLITUDE_Z


def simulate_random_motion(
    nominal: System,
    simulated: System,
    posture: Mapping[str, float],
    truth: Mapping[str, float],
    values: Mapping[str, float],
    injected: Sequence[InjectedEffect],
    rng: np.random.Generator,
    conditions: SyntheticRecordingConditions,
) -> Recording:
    """Return a recording of `simulated` in a random multisine motion, which is planned with the nominal system."""
    travel = _GRIPPER_TRAVEL if len(nominal.grasps) < 2 else _SHARED_GRIPPER_TRAVEL
    excitation = MultisineOptions(gripper_travel=travel, duration=conditions.simulation.duration)
    if conditions.is_brisk:
        low, high = (_BRISK_FREQUENCY_FACTOR * edge for edge in excitation.frequency_band)
        faster = _BRISK_FREQUENCY_FACTOR * excitation.max_joint_speed
        excitation = replace(excitation, frequency_band=(low, high), max_joint_speed=faster, has_second_harmonic=True)
    seed = int(rng.integers(2**31))
    motion = random_multisine_motion(nominal, truth, seed=seed, initial_joint_angles=posture, excitation=excitation)
    experiment = VirtualExperimentSettings(
        motion=motion,
        initial_joint_angles=posture,
        simulation=conditions.simulation,
        arm_noise=conditions.arm_noise,
        camera=PointCamera() if conditions.has_camera else None,
        seed=int(rng.integers(2**31)),
    )
    return run_experiment_with_injected_effects(simulated, values, injected, experiment, conditions.ordinary_friction)


def first_recorded_driven_joint_positions(system: System, recording: Recording) -> dict[str, float]:
    """Return the first recorded position of every driven joint. Raises `ConfigError` if one is not recorded."""
    joints = recording.joints
    names = [] if joints is None else list(joints.names)
    missing = [name for name in system.driven if name not in names]
    if joints is None or missing:
        what, hint = f"recording '{recording.name}' lacks the driven joints {', '.join(missing)}", "import them too"
        raise ConfigError(what, where="recordings.estimate", allowed="recordings of all driven joints", hint=hint)
    return {name: float(joints.position[0, names.index(name)]) for name in system.driven}


def scale_parameters_to_more_links(nominal: System, finer: System, truth: Mapping[str, float]) -> dict[str, float]:
    """Return `truth` with stiffness and damping of joints scaled so that `finer` describes the same tubes."""
    start = dict(zip(nominal.parameters.names, map(float, nominal.parameters.vector()), strict=True))
    finer_start = dict(zip(finer.parameters.names, map(float, finer.parameters.vector()), strict=True))
    values = dict(truth)
    for segment in nominal.segment_layouts:
        factor = len(finer.find_segment_layout(segment.name).link_joints) / len(segment.link_joints)
        for what in ("bend", "twist"):
            name = f"{segment.name}.{what}"
            if name in truth and start[name] > 0:
                # the finer system defines how a stiffness scales with the links
                values[name] = truth[name] * finer_start[name] / start[name]
        for what in ("damping", "twist_damping"):
            name = f"{segment.name}.{what}"
            if name in start:
                values[name] = truth.get(name, start[name]) * factor
    return values


def diagnose_unlabelled_case(
    ensemble: BlindCaseGenerator, case: UnlabelledCase, thresholds: Thresholds
) -> DiagnosisResult:
    """Diagnose a blind-test case from its recordings and excluded kinds of effects, without its label."""
    problem, held_out = ensemble._nominal_problem(case.estimation_recordings), [case.held_out_recording]
    return diagnose(problem, ensemble.candidates, held_out, thresholds=thresholds, exclude=case.excluded_kinds)


def true_effects_gap_closure(ensemble: BlindCaseGenerator, case: UnlabelledCase, label: CaseGroundTruth) -> float:
    """Return the fraction of the held-out gap that the true effects close after a refit. NaN if the refit fails."""
    problem = ensemble._nominal_problem(case.estimation_recordings)
    effects = make_candidate_effects(problem.system, case.estimation_recordings, ensemble.candidates)
    composed = AllCandidatesProblem.from_problem(problem, effects, [case.held_out_recording])
    nominal = fit_nominal_model(problem, RefitContext(composed))
    true = {entry.label: entry.values for entry in label.injected}
    chosen = [effect for effect in composed.candidate_effects if effect.label in true]
    start = {}  # reported values in the parameters' own unit
    for effect in chosen:
        for quantity in effect.definitions:
            reported = true[effect.label].get(quantity.reported_name_and_unit[0])
            if reported is not None:
                start[f"{effect.label}.{quantity.name}"] = quantity.internal_from_reported_value(reported)
    # whitened as the nominal fit, like all models that it is compared with
    whitened = replace(composed, problem=nominal.problem)
    fit = refit_with_effects(RefitContext(whitened), chosen, {**nominal.values, **start})
    if fit is None or len(chosen) < len(true):
        return math.nan
    return held_out_gap_closure(nominal.held_out_loss, fit.held_out_loss).fraction

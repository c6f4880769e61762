"""Random blind cases of one experiment, and their labels.

What sort a case is of stands in the plan. Labels are written apart from the recordings and their hash is published
before any recording is looked at.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yid_ocp.data.recording import Recording
from yid_ocp.diagnosis.blind.plan import PURPOSES, SIZES, Planned
from yid_ocp.diagnosis.diagnose import nominal_fit
from yid_ocp.diagnosis.hypotheses import CandidateProblem, Choice, chosen_effects
from yid_ocp.diagnosis.screening import Linearisation, Signature, linearise
from yid_ocp.diagnosis.thresholds import DEFAULTS, Thresholds
from yid_ocp.effects.base import EffectBase, Quantity, segment_springs
from yid_ocp.errors import ConfigError, DataError, ModelError
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem
from yid_ocp.virtual.engine import Simulation
from yid_ocp.virtual.experiment import ArmNoise, PointCamera, VirtualExperiment
from yid_ocp.virtual.injected import KINDS, InjectedEffect, injected_experiment
from yid_ocp.virtual.motion import Excitation, multisine
from yid_ocp.virtual.outside import OUTSIDE

Array = NDArray[np.float64]

DRAWS = 64
"""Motions, objects and effects drawn for a case until one can be simulated; of 300, one was given up after eight."""
SPREAD = 1.5
"""Factor by which true stiffnesses lie above or below the problem's start, at most."""
OUTSIDE_SIZES: Mapping[str, tuple[str, float, float, str]] = {
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
"""Of effects outside the library: where they sit, their least and largest size, and what of it they are parts of."""
TRAVEL, TRAVEL_TOGETHER = 0.15, 0.08
"""How far the grippers go, one alone and several on one object, which they soon bring to snap [m]."""


@dataclass(frozen=True)
class Label:
    """True effects and parameters of a case, sealed until scoring.

    Attributes
    ----------
    case : str
    category : str
        null, single, pair, outside, left_out or finer_chain.
    injected : tuple of InjectedEffect
    multiple : float, optional
        Of the detectable size, as made; None where that has no meaning.
    truth : dict of str to float
        Nominal parameters.
    experiment : str
        In which it was made.
    """

    case: str
    category: str
    injected: tuple[InjectedEffect, ...]
    multiple: float | None
    truth: Mapping[str, float]
    experiment: str = ""

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        own: dict[str, Any] = asdict(self)
        return own | {"injected": [asdict(effect) for effect in self.injected]}

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> Label:
        """From JSON."""
        injected = tuple(InjectedEffect(**entry) for entry in data["injected"])
        return Label(**{**data, "injected": injected})


@dataclass(frozen=True)
class Case:
    """Recordings and candidate exclusions of a case, as given to the diagnosis.

    Attributes
    ----------
    name : str
    estimate : tuple of Recording
    held_out : Recording
    without : tuple of str
        Kinds that are left out of the library; mostly one that has nothing to do with the case.
    """

    name: str
    estimate: tuple[Recording, ...]
    held_out: Recording
    without: tuple[str, ...]


def seal(labels: Sequence[Label]) -> tuple[str, str]:
    """Return the labels as JSON text and its SHA-256 hash, published before the diagnosis."""
    text = json.dumps([label.to_dict() for label in labels], indent=1, sort_keys=True, allow_nan=False)
    return text, hashlib.sha256(text.encode()).hexdigest()


def opened(text: str, commitment: str) -> list[Label]:
    """Read sealed labels after checking their hash.

    Raises
    ------
    DataError
        The text is not the one that was committed to.
    """
    if hashlib.sha256(text.encode()).hexdigest() != commitment:
        raise DataError("the labels are not those that were committed to", where="sealed labels")
    return [Label.from_dict(entry) for entry in json.loads(text)]


@dataclass(frozen=True)
class Conditions:
    """Settings of the synthetic recordings of an experiment.

    Attributes
    ----------
    recordings : int
        To estimate on; one more is held out.
    noise : ArmNoise
    simulation : Simulation
        Duration of each, and the engine's step.
    vision : bool
        Whether a camera sees the object.
    purpose : str
        Of `PURPOSES`.
    """

    recordings: int = 1
    noise: ArmNoise = field(default_factory=ArmNoise)
    simulation: Simulation = field(default_factory=Simulation)
    vision: bool = False
    purpose: str = PURPOSES[0]


@dataclass(frozen=True)
class Detectable:
    """Sensitivity of an experiment to an effect, which gives its detectable size.

    Attributes
    ----------
    effect : EffectBase
    shape : dict of str to float
        Values of its shape parameters.
    columns : ndarray, shape (p, p)
        |columns a| is by how many standard deviations of the data the amplitudes a move the residual.
    """

    effect: EffectBase
    shape: Mapping[str, float]
    columns: Array

    @staticmethod
    def of(signature: Signature) -> Detectable:
        """Build from a candidate's signature on a clean recording."""
        return Detectable(signature.effect, signature.shape, np.asarray(np.linalg.qr(signature.columns, mode="r")))

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        return {"effect": self.effect.label, "shape": dict(self.shape), "columns": self.columns.tolist()}


class Ensemble:
    """Generator of random blind cases of one experiment.

    Parameters
    ----------
    problem : EstimationProblem
        Its system, options and free parameters are every case's; its first recording gives the initial posture.
    seed : int
    finer : callable, optional
        The system with so many times its links.
    candidates : "all" or sequence of str
        The library.
    limits : Thresholds
        For the detectable size.
    simulated : System, optional
        What moves, where that is not the problem's: the same with its arms driven.
    conditions : Conditions
        Whether there is a camera is seen from the problem's first recording.

    Raises
    ------
    ConfigError
        A system without driven joints, which MuJoCo could not be made to move.
    """

    def __init__(
        self,
        problem: EstimationProblem,
        seed: int,
        finer: Callable[[int], System] | None = None,
        candidates: Choice = "all",
        limits: Thresholds = DEFAULTS,
        *,
        simulated: System | None = None,
        conditions: Conditions | None = None,
    ) -> None:
        self.simulated = problem.system if simulated is None else simulated
        if not self.simulated.driven or self.simulated.prescribed:
            raise ConfigError(
                "a blind proof moves driven arms",
                where="model",
                allowed="a robot whose arms are driven, nothing prescribed",
            )
        if seed < 0:
            raise ConfigError(f"seed = {seed}", where="--seed", allowed="a whole number from 0")
        self.problem, self.seed, self._finer = problem, seed, finer
        self._candidates, self._limits = candidates, limits
        recording = problem.episodes[0].recording
        self.posture = first_posture(self.simulated, recording)
        seen = any(group.pose is not None for group in recording.points)
        self.conditions = replace(conditions or Conditions(), vision=seen)
        self._effects = chosen_effects(problem.system, [recording], candidates)
        if not {effect.kind for effect in self._effects} & set(KINDS):
            raise ConfigError(
                "none of the candidates can be done in MuJoCo",
                where="diagnosis.candidates",
                allowed=", ".join(KINDS),
            )
        self._detectable: tuple[Detectable, ...] | None = None

    def _rng(self, *path: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, PURPOSES.index(self.conditions.purpose), *path])

    def truth(self, rng: np.random.Generator) -> dict[str, float]:
        """Draw true values of the free parameters, log-uniform about their start."""
        start = dict(zip(self.problem.system.parameters.names, self.problem.theta, strict=True))
        return {name: float(start[name] * SPREAD ** rng.uniform(-1, 1)) for name in self.problem.free}

    def record(
        self,
        truth: Mapping[str, float],
        injected: Sequence[InjectedEffect],
        rng: np.random.Generator,
        name: str,
        links: int = 1,
    ) -> Recording:
        """Simulate one recording with injected effects; it carries no description or truth."""
        system = self.simulated
        if links > 1:
            assert self._finer is not None
            system = self._finer(links)
        values = truth if links == 1 else finer_values(self.simulated, system, truth)
        made = recorded(self.simulated, system, self.posture, truth, values, injected, rng, self.conditions)
        return replace(made, name=name, description="", source="", truth={})

    def point(self) -> Linearisation:
        """Return the candidates' signatures on clean recordings."""
        rng = self._rng(0)
        names = [f"clean_{i}" for i in range(self.conditions.recordings)]
        clean = tuple(self.record(self.truth(rng), (), rng, name) for name in names)
        problem = self.of(clean)
        effects = chosen_effects(problem.system, clean, self._candidates)
        composed = CandidateProblem.of(problem, effects, [self.record(self.truth(rng), (), rng, "other")])
        nominal = nominal_fit(problem, composed, limits=self._limits)
        # weighted by all noise, that of torques too
        composed = replace(composed, problem=nominal.problem)
        return linearise(composed, (), nominal.values, self._limits.shape_values)

    @property
    def detectable(self) -> tuple[Detectable, ...]:
        """Detectable size of every candidate, computed once."""
        if self._detectable is None:
            self._detectable = tuple(Detectable.of(signature) for signature in self.point().signatures)
        return self._detectable

    def knowing(self, detectable: Sequence[Mapping[str, Any]]) -> None:
        """Load detectable sizes computed by another process, from `Detectable.to_dict`."""
        by_label = {effect.label: effect for effect in self._effects}
        self._detectable = tuple(
            Detectable(
                by_label[entry["effect"]], dict(entry["shape"]), np.atleast_2d(np.array(entry["columns"], float))
            )
            for entry in detectable
        )

    def of(self, recordings: Sequence[Recording]) -> EstimationProblem:
        """Return the nominal estimation problem of some recordings."""
        nominal = self.problem
        values = dict(zip(nominal.system.parameters.names, map(float, nominal.theta), strict=True))
        return EstimationProblem(nominal.step, list(recordings), nominal.free, nominal.options, values)

    def draw(self, wanted: Planned) -> tuple[Case, Label]:
        """Draw a planned case; the same seed and purpose give the same case.

        Raises
        ------
        ModelError
            None of several draws could be simulated.
        """
        name = f"case_{wanted.number:03d}"
        purposes = [f"estimate_{i}" for i in range(self.conditions.recordings)]
        for attempt in range(DRAWS):
            rng = self._rng(1, wanted.number, attempt)
            truth = self.truth(rng)
            injected, multiple = self._injected(wanted, rng)
            links = 2 if wanted.category == "finer_chain" else 1
            try:
                *estimate, held_out = (
                    self.record(truth, injected, rng, f"{name}_{purpose}", links) for purpose in (*purposes, "held_out")
                )
            except ModelError:
                continue  # the motion throws the object about; draw another
            left_out = (injected[0].kind,) if wanted.category == "left_out" else self._other_kind(injected, rng)
            label = Label(name, wanted.category, injected, multiple, truth, wanted.experiment)
            return Case(name, tuple(estimate), held_out, left_out), label
        raise ModelError(
            f"none of {DRAWS} motions can be simulated",
            where=f"{name} of {wanted.experiment}",
            hint="take another --seed: a seed draws the same again",
        )

    def _other_kind(self, injected: Sequence[InjectedEffect], rng: np.random.Generator) -> tuple[str, ...]:
        at_work = {effect.kind for effect in injected}
        kinds = sorted({entry.effect.kind for entry in self.detectable} - at_work)
        return (str(rng.choice(kinds)),) if len(kinds) > 1 else ()

    def _injected(self, wanted: Planned, rng: np.random.Generator) -> tuple[tuple[InjectedEffect, ...], float | None]:
        if wanted.category in ("null", "finer_chain"):
            return (), None
        if wanted.category == "outside":
            return (self._outside(rng),), None
        size = SIZES[-1] if wanted.multiple is None else wanted.multiple
        if wanted.category == "pair":
            (one, multiple), (two, _) = self._inside(rng, size), self._inside(rng, size)
            return ((one, two) if one.label != two.label else (one,)), multiple
        effect, multiple = self._inside(rng, size)
        return (effect,), multiple

    def _inside(self, rng: np.random.Generator, wanted: float) -> tuple[InjectedEffect, float]:
        """An effect of the library at so many times its detectable size, or as near as its range lets it come."""
        groups: dict[str, dict[str, list[int]]] = {}
        for i, entry in enumerate(self.detectable):
            if entry.effect.kind in KINDS:
                places = groups.setdefault(entry.effect.kind, {})
                places.setdefault(entry.effect.location, []).append(i)
        best: tuple[InjectedEffect, float] | None = None
        for _ in range(40):
            kind = str(rng.choice(sorted(groups)))
            place = str(rng.choice(sorted(groups[kind])))
            drawn = self._sized(self.detectable[int(rng.choice(groups[kind][place]))], rng, wanted)
            if drawn is None:
                continue
            made, multiple = drawn
            if multiple > 0.9 * wanted:
                return made, wanted
            if best is None or multiple > best[1]:
                best = made, multiple
        assert best is not None
        return best

    def _sized(self, entry: Detectable, rng: np.random.Generator, wanted: float) -> tuple[InjectedEffect, float] | None:
        """Amplitudes in a random proportion at so many times the detectable size, as far as the range allows."""
        effect = entry.effect
        quantities: dict[str, Quantity] = {f"{effect.label}.{q.name}": q for q in effect.quantities}
        room = {n: effect.prior_range[n] for n in effect.amplitudes}
        neutral = np.array([quantities[n].neutral for n in effect.amplitudes])
        low, high = (np.array([room[n][side] for n in effect.amplitudes]) - neutral for side in (0, 1))
        way = rng.uniform(low, high)
        seen = float(np.linalg.norm(entry.columns @ way))
        if seen <= 0:
            return None
        reach = np.min(np.where(way > 0, high, low)[way != 0] / way[way != 0])
        factor = min(wanted * self._limits.detection / seen, float(reach))
        values = {**dict(zip(effect.amplitudes, neutral + factor * way, strict=True)), **entry.shape}
        reported = {name: told.value for name, told in effect.reported(values).items()}
        return InjectedEffect(effect.kind, effect.location, reported), factor * seen / self._limits.detection

    def _outside(self, rng: np.random.Generator) -> InjectedEffect:
        system = self.simulated
        places: dict[str, tuple[str, ...]] = {
            "joint": system.driven[: max(len(system.driven) // 2, 1)],
            "segment": tuple(segment.name for segment in system.segments),
            "grasp": tuple(grasp.name for grasp in system.grasps),
        }
        known = [kind for kind in OUTSIDE if places[OUTSIDE_SIZES[kind][0]]]
        kind = str(rng.choice(known))
        place, low, high, part_of = OUTSIDE_SIZES[kind]
        location = str(rng.choice(places[place]))
        size = float(rng.uniform(low, high))
        if part_of == "torque":
            size *= self._largest_torque(location)
        elif part_of == "stiffness":
            start = dict(zip(self.problem.system.parameters.names, self.problem.theta, strict=True))
            bends = any(spring.kind == "bend" for spring in segment_springs(system, location))
            size *= float(start.get(f"{location}.bend", 10.0)) if bends else 10.0
        return InjectedEffect(kind, location, {"size": size})

    def _largest_torque(self, joint: str) -> float:
        """Of a joint in the problem's first recording [N m]; 10 where none is recorded."""
        recorded = self.problem.episodes[0].recording.joints
        if recorded is None or recorded.effort is None or joint not in recorded.names:
            return 10.0
        return float(np.nanmax(np.abs(recorded.effort[:, recorded.names.index(joint)])))


def recorded(
    nominal: System,
    simulated: System,
    posture: Mapping[str, float],
    truth: Mapping[str, float],
    values: Mapping[str, float],
    injected: Sequence[InjectedEffect],
    rng: np.random.Generator,
    conditions: Conditions,
) -> Recording:
    """Simulate a recording of a random motion planned for the nominal system.

    Parameters
    ----------
    nominal, simulated : System
    posture : mapping of str to float
        Of the driven joints at the start.
    truth, values : mapping of str to float
        Parameters of the nominal and of the simulated system.
    injected : sequence of InjectedEffect
    rng : numpy.random.Generator
        Of motion and noise.
    conditions : Conditions
    """
    travel = TRAVEL if len(nominal.grasps) < 2 else TRAVEL_TOGETHER
    excitation = Excitation(travel=travel, duration=conditions.simulation.duration)
    motion = multisine(nominal, truth, seed=int(rng.integers(2**31)), posture=posture, excitation=excitation)
    experiment = VirtualExperiment(
        motion=motion,
        posture=posture,
        simulation=conditions.simulation,
        noise=conditions.noise,
        camera=PointCamera() if conditions.vision else None,
        seed=int(rng.integers(2**31)),
    )
    return injected_experiment(simulated, values, injected, experiment)


def first_posture(system: System, recording: Recording) -> dict[str, float]:
    """Return the initial positions of the driven joints of a recording.

    Raises
    ------
    ConfigError
        One of them is not recorded.
    """
    joints = recording.joints
    names = [] if joints is None else list(joints.names)
    missing = [name for name in system.driven if name not in names]
    if joints is None or missing:
        raise ConfigError(
            f"the first recording does not say where {missing[0]} begins",
            where="recordings.estimate",
            allowed="a recording of all driven joints",
        )
    return {name: float(joints.position[0, names.index(name)]) for name in system.driven}


def finer_values(nominal: System, finer: System, truth: Mapping[str, float]) -> dict[str, float]:
    """Return the parameters of the same tubes with more links: joint springs and dampers scaled by their number.

    A segment whose links did not change, or whose stiffness is that of its cross section, keeps its values.
    """
    start = dict(zip(nominal.parameters.names, map(float, nominal.parameters.vector()), strict=True))
    finer_start = dict(zip(finer.parameters.names, map(float, finer.parameters.vector()), strict=True))
    values = dict(truth)
    for segment in nominal.segments:
        factor = len(finer.segment(segment.name).links) / len(segment.links)
        for what in ("bend", "twist"):
            name = f"{segment.name}.{what}"
            if name in truth and start[name] > 0:
                # the finer description says how a stiffness follows the links
                values[name] = truth[name] * finer_start[name] / start[name]
        for what in ("damping", "twist_damping"):
            name = f"{segment.name}.{what}"
            if name in start:
                values[name] = truth.get(name, start[name]) * factor
    return values

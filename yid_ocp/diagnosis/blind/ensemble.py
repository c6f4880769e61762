"""Cases drawn at random, and their labels.

Some are clean, some have one effect at one, three or ten times its detectable size, some two, some an effect that is in
no library or that was left out of the library, some twice as many links as the model. Labels are written apart from
the recordings and their hash is published before any recording is looked at.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from yid_ocp.data.recording import Recording
from yid_ocp.diagnosis.diagnose import nominal_fit
from yid_ocp.diagnosis.hypotheses import CandidateProblem, Choice, chosen_effects
from yid_ocp.diagnosis.screening import Linearisation, Signature, linearise
from yid_ocp.diagnosis.thresholds import DEFAULTS, Thresholds
from yid_ocp.effects.base import Quantity, segment_springs
from yid_ocp.errors import ConfigError, DataError, ModelError
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem
from yid_ocp.virtual.experiment import PointCamera, VirtualExperiment
from yid_ocp.virtual.injected import KINDS, InjectedEffect, injected_experiment
from yid_ocp.virtual.motion import Excitation, multisine
from yid_ocp.virtual.outside import OUTSIDE

SIZES = (1.0, 3.0, 10.0)
"""Multiples of the detectable size."""
SHARES: Mapping[str, float] = {"null": 0.2, "single": 0.5, "outside": 0.15, "left_out": 0.05, "pair": 0.05}
"""What an ensemble is made of; the rest has a finer chain."""
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
TRAVEL = 0.15
"""How far the grippers go [m]."""


@dataclass(frozen=True)
class Label:
    """What is true of a case; sealed until it is scored.

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
    """

    case: str
    category: str
    injected: tuple[InjectedEffect, ...]
    multiple: float | None
    truth: Mapping[str, float]

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self) | {"injected": [asdict(e) for e in self.injected]}

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> Label:
        """From JSON."""
        injected = tuple(InjectedEffect(**entry) for entry in data["injected"])
        return Label(data["case"], data["category"], injected, data["multiple"], data["truth"])


@dataclass(frozen=True)
class Case:
    """What a diagnosis is given of a case.

    Attributes
    ----------
    name : str
    estimate, held_out : Recording
    without : tuple of str
        Kinds that are left out of the library; mostly one that has nothing to do with the case.
    """

    name: str
    estimate: Recording
    held_out: Recording
    without: tuple[str, ...]


def seal(labels: Sequence[Label]) -> tuple[str, str]:
    """Labels as text, and the hash by which they are committed to before the run."""
    text = json.dumps([label.to_dict() for label in labels], indent=1, sort_keys=True, allow_nan=False)
    return text, hashlib.sha256(text.encode()).hexdigest()


def opened(text: str, commitment: str) -> list[Label]:
    """Labels from their text.

    Raises
    ------
    DataError
        The text is not the one that was committed to.
    """
    if hashlib.sha256(text.encode()).hexdigest() != commitment:
        raise DataError("the labels are not those that were committed to", where="sealed labels")
    return [Label.from_dict(entry) for entry in json.loads(text)]


class Ensemble:
    """Draws cases of one experiment.

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
    ) -> None:
        if not problem.system.driven or problem.system.prescribed:
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
        assert recording.joints is not None
        names = list(recording.joints.names)
        self.posture = {j: float(recording.joints.position[0, names.index(j)]) for j in problem.system.driven}
        self.vision = any(group.pose is not None for group in recording.points)
        effects = chosen_effects(problem.system, [recording], candidates)
        if not {effect.kind for effect in effects} & set(KINDS):
            raise ConfigError(
                "none of the candidates can be done in MuJoCo",
                where="diagnosis.candidates",
                allowed=", ".join(KINDS),
            )
        self._point: Linearisation | None = None

    def _rng(self, *path: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, *path])

    def truth(self, rng: np.random.Generator) -> dict[str, float]:
        """True values of the free parameters, log-uniform about their start."""
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
        """One recording, without a word on what is in it."""
        system = self.problem.system
        if links > 1:
            assert self._finer is not None
            system = self._finer(links)
        motion = multisine(
            self.problem.system,
            truth,
            seed=int(rng.integers(2**31)),
            posture=self.posture,
            excitation=Excitation(travel=TRAVEL),
        )
        experiment = VirtualExperiment(
            motion=motion,
            posture=self.posture,
            camera=PointCamera() if self.vision else None,
            seed=int(rng.integers(2**31)),
        )
        made = injected_experiment(
            system,
            truth if links == 1 else finer_values(self.problem.system, system, truth),
            injected,
            experiment,
        )
        return replace(made, name=name, description="", source="", truth={})

    def point(self) -> Linearisation:
        """The candidates' signatures on a clean recording: what of each would be detectable."""
        if self._point is None:
            rng = self._rng(0)
            clean = self.record(self.truth(rng), (), rng, "clean")
            problem = self.of(clean)
            effects = chosen_effects(problem.system, [clean], self._candidates)
            composed = CandidateProblem.of(problem, effects, [self.record(self.truth(rng), (), rng, "other")])
            nominal = nominal_fit(problem, composed, limits=self._limits)
            self._point = linearise(composed, (), nominal.values, self._limits.shape_values)
        return self._point

    def of(self, recording: Recording) -> EstimationProblem:
        """The nominal problem of a recording."""
        nominal = self.problem
        values = dict(zip(nominal.system.parameters.names, map(float, nominal.theta), strict=True))
        return EstimationProblem(nominal.step, [recording], nominal.free, nominal.options, values)

    def draw(self, number: int, count: int) -> tuple[Case, Label]:
        """Case `number` of `count`; the same for the same seed, whatever was drawn before.

        Raises
        ------
        ModelError
            None of several draws could be simulated.
        """
        for attempt in range(8):
            rng = self._rng(1, number, attempt)
            category = self._category(number, count)
            truth = self.truth(rng)
            injected, multiple = self._injected(category, rng)
            links = 2 if category == "finer_chain" else 1
            name = f"case_{number:03d}"
            try:
                estimate, held_out = (
                    self.record(truth, injected, rng, f"{name}_{purpose}", links)
                    for purpose in ("estimate", "held_out")
                )
            except ModelError:
                continue  # the motion throws the object about; draw another
            left_out = (injected[0].kind,) if category == "left_out" else self._other_kind(injected, rng)
            return Case(name, estimate, held_out, left_out), Label(name, category, injected, multiple, truth)
        raise ModelError("no motion of this experiment can be simulated", where=f"case {number}")

    def _category(self, number: int, count: int) -> str:
        edges = np.cumsum(list(SHARES.values()))
        # an even spread over the ensemble, in an order that the seed decides
        order = self._rng(2).permutation(count)
        position = (float(order[number]) + 0.5) / count
        place = int(np.searchsorted(edges, position))
        category = [*SHARES, "finer_chain"][place]
        return "single" if category == "finer_chain" and self._finer is None else category

    def _other_kind(self, injected: Sequence[InjectedEffect], rng: np.random.Generator) -> tuple[str, ...]:
        at_work = {effect.kind for effect in injected}
        kinds = sorted({s.effect.kind for s in self.point().signatures} - at_work)
        return (str(rng.choice(kinds)),) if len(kinds) > 1 else ()

    def _injected(self, category: str, rng: np.random.Generator) -> tuple[tuple[InjectedEffect, ...], float | None]:
        if category in ("null", "finer_chain"):
            return (), None
        if category == "outside":
            return (self._outside(rng),), None
        if category == "pair":
            (one, size), (two, _) = self._inside(rng, SIZES[-1]), self._inside(rng, SIZES[-1])
            return ((one, two) if one.label != two.label else (one,)), size
        size = SIZES[-1] if category == "left_out" else float(rng.choice(SIZES))
        effect, multiple = self._inside(rng, size)
        return (effect,), multiple

    def _inside(self, rng: np.random.Generator, wanted: float) -> tuple[InjectedEffect, float]:
        """An effect of the library at so many times its detectable size, or as near as its range lets it come."""
        groups: dict[str, dict[str, list[int]]] = {}
        for i, signature in enumerate(self.point().signatures):
            if signature.effect.kind in KINDS:
                places = groups.setdefault(signature.effect.kind, {})
                places.setdefault(signature.effect.location, []).append(i)
        best: tuple[InjectedEffect, float] | None = None
        for _ in range(40):
            kind = str(rng.choice(sorted(groups)))
            place = str(rng.choice(sorted(groups[kind])))
            drawn = self._sized(self.point().signatures[int(rng.choice(groups[kind][place]))], rng, wanted)
            if drawn is None:
                continue
            made, multiple = drawn
            if multiple > 0.9 * wanted:
                return made, wanted
            if best is None or multiple > best[1]:
                best = made, multiple
        assert best is not None
        return best

    def _sized(
        self, signature: Signature, rng: np.random.Generator, wanted: float
    ) -> tuple[InjectedEffect, float] | None:
        """Amplitudes in a random proportion at so many times the detectable size, as far as the range allows."""
        effect = signature.effect
        quantities: dict[str, Quantity] = {f"{effect.label}.{q.name}": q for q in effect.quantities}
        room = {n: effect.prior_range[n] for n in effect.amplitudes}
        neutral = np.array([quantities[n].neutral for n in effect.amplitudes])
        low, high = (np.array([room[n][side] for n in effect.amplitudes]) - neutral for side in (0, 1))
        way = rng.uniform(low, high)
        seen = float(np.linalg.norm(signature.columns @ way))
        if seen <= 0:
            return None
        reach = np.min(np.where(way > 0, high, low)[way != 0] / way[way != 0])
        factor = min(wanted * self._limits.detection / seen, float(reach))
        values = dict(zip(effect.amplitudes, neutral + factor * way, strict=True)) | signature.shape
        reported = {name: entry.value for name, entry in effect.reported(values).items()}
        return InjectedEffect(effect.kind, effect.location, reported), factor * seen / self._limits.detection

    def _outside(self, rng: np.random.Generator) -> InjectedEffect:
        system = self.problem.system
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
            start = dict(zip(system.parameters.names, self.problem.theta, strict=True))
            bends = any(spring.kind == "bend" for spring in segment_springs(system, location))
            size *= float(start.get(f"{location}.bend", 10.0)) if bends else 10.0
        return InjectedEffect(kind, location, {"size": size})

    def _largest_torque(self, joint: str) -> float:
        """Of a joint in the problem's first recording [N m]; 10 where none is recorded."""
        recorded = self.problem.episodes[0].recording.joints
        if recorded is None or recorded.effort is None or joint not in recorded.names:
            return 10.0
        return float(np.nanmax(np.abs(recorded.effort[:, recorded.names.index(joint)])))


def finer_values(nominal: System, finer: System, truth: Mapping[str, float]) -> dict[str, float]:
    """Values that make the same tubes of more links: springs and dampers of a joint as many times as strong.

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

"""All candidate effects composed into one system with one compiled step; problems that free parts of it."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.data.recording import Recording
from yid_ocp.effects import EFFECTS, EffectBase, candidates, make_effect
from yid_ocp.errors import ConfigError, DataError
from yid_ocp.integrator.mapped import Mapped
from yid_ocp.integrator.statics import Rest, Statics
from yid_ocp.integrator.step import Step, compile_step
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.corrections import InputCorrections
from yid_ocp.problem.inputs import sensors_present
from yid_ocp.problem.low_pass import LowPass
from yid_ocp.problem.measurements import Measurements
from yid_ocp.problem.problem import Episode
from yid_ocp.problem.start import FittedStart
from yid_ocp.sensors import EffortSensor, Sensor

Array = NDArray[np.float64]
Choice = Literal["all"] | Sequence[str]

BLOCK = 1.0
"""Length of the blocks in which a single recording is split [s]."""


@dataclass(frozen=True)
class Series:
    """One scalar output of one recording, as it stands in the residual of a problem.

    Attributes
    ----------
    recording, channel : str
    group : str
    unit : str
    t : ndarray, shape (M,)
        Times since the start of the recording [s].
    rows : ndarray of int, shape (M,)
        Places in the residual.
    colour : ndarray, shape (L + 1,)
        Autocorrelation of the noise at lags 0 to L samples.
    """

    recording: str
    channel: str
    group: str
    unit: str
    t: Array
    rows: NDArray[np.int64]
    colour: Array


def chosen_effects(system: System, recordings: Sequence[Recording], choice: Choice) -> list[EffectBase]:
    """The effects to try: none that the nominal model has already.

    Parameters
    ----------
    system : System
        The nominal one.
    recordings : sequence of Recording
    choice : "all" or sequence of str
        `kind` (wherever a diagnosis tries it) or `kind@location`.

    Raises
    ------
    ConfigError
        No such kind, a kind that has no place here, an effect of the nominal model, an empty list.
    ModelError
        A location that does not exist.
    """
    present = {f"{effect.kind}@{effect.location}" for effect in system.effects}
    possible = [
        (kind, place)
        for kind, place in candidates(system, sensors_present(recordings))
        if f"{kind}@{place}" not in present
    ]
    if isinstance(choice, str):
        if choice != "all":
            raise ConfigError(
                f"candidates = '{choice}'", where="diagnosis.candidates", allowed="all, or a list of kinds"
            )
        return [make_effect(kind, place, system) for kind, place in possible]
    pairs: list[tuple[str, str]] = []
    for text in choice:
        kind, _, place = text.partition("@")
        cls = EFFECTS[kind]
        if text in present:
            raise ConfigError(f"{text} is part of the model", where="diagnosis.candidates", hint="leave it out")
        found = [(kind, place)] if place else [pair for pair in possible if pair[0] == kind]
        if not found:
            missing = ", ".join(sorted(cls.needs - sensors_present(recordings)))
            raise ConfigError(
                f"{kind} does not fit this system or these recordings",
                where="diagnosis.candidates",
                allowed=", ".join(dict.fromkeys(k for k, _ in possible)),
                hint=f"it needs {missing}" if missing else "leave it out",
            )
        pairs += [pair for pair in found if pair not in pairs]
    if not pairs:
        raise ConfigError(
            "there is no candidate to try", where="diagnosis.candidates", allowed="all, or a list of kinds"
        )
    return [make_effect(kind, place, system) for kind, place in pairs]


class _SlicedMap(Mapped):
    """A sensor's compiled function with the derivatives by some of its parameters only."""

    def __init__(self, full: Mapped, columns: Sequence[int]) -> None:
        self._full, self._chosen = full, list(columns)

    def __call__(self, *inputs: Array) -> list[Array]:
        *rest, by_theta = self._full(*inputs)
        return [*rest, by_theta[:, :, self._chosen]]


class _SlicedStatics(Statics):
    def __init__(self, step: Step, names: tuple[str, ...]) -> None:
        super().__init__(step)
        self._names = names

    def solve(
        self,
        posture: ArrayLike,
        theta: ArrayLike,
        torque: ArrayLike | None = None,
        guess: ArrayLike | None = None,
        names: Sequence[str] = (),
        tolerance: float = 1e-10,
    ) -> Rest:
        if not names:
            return super().solve(posture, theta, torque, guess, (), tolerance)
        rest = super().solve(posture, theta, torque, guess, self._names, tolerance)
        return replace(rest, by_theta=rest.by_theta[:, [self._names.index(name) for name in names]])


class _SlicedReadings(InputCorrections):
    def __init__(self, system: System, use_compiler: bool, names: tuple[str, ...]) -> None:
        super().__init__(system, use_compiler)
        self._names = names

    def true(
        self, angle: Array, effort: Array, theta: Array, names: tuple[str, ...]
    ) -> tuple[Array, Array, Array, Array, Array]:
        if not names:
            return super().true(angle, effort, theta, names)
        at = [self._names.index(name) for name in names]
        a, e, a_theta, e_theta, e_reading = super().true(angle, effort, theta, self._names)
        return a, e, a_theta[:, :, at], e_theta[:, :, at], e_reading

    def _chosen_columns(self, found: tuple[Array, Array], names: tuple[str, ...]) -> tuple[Array, Array]:
        return found[0], found[1][:, [self._names.index(name) for name in names]]

    def torque_delay(self, theta: Array, names: tuple[str, ...]) -> tuple[Array, Array]:
        return self._chosen_columns(super().torque_delay(theta, self._names), names)

    def sensor_delay(self, sensor: Sensor, theta: Array, names: tuple[str, ...]) -> tuple[Array, Array] | None:
        found = super().sensor_delay(sensor, theta, self._names)
        return None if found is None else self._chosen_columns(found, names)


class CandidateProblem(EstimationProblem):
    """The estimation problem of a system with all candidates, of which any part can be freed at no cost.

    Sensors, statics and readings are differentiated by everything once and sliced, recordings are placed on the nodes
    once, and the tracking filter is that of the nominal start, the same for every hypothesis.

    Attributes
    ----------
    effects : tuple of EffectBase
        All candidates, neutral.
    nominal : tuple of str
        Parameters that the nominal problem frees.
    blocks : bool
        Whether a single recording is both estimated on and held out, in alternate blocks.
    """

    effects: tuple[EffectBase, ...]
    nominal: tuple[str, ...]
    blocks: bool
    _everything: tuple[str, ...]

    @staticmethod
    def of(
        problem: EstimationProblem, effects: Sequence[EffectBase], held_out: Sequence[Recording] = ()
    ) -> CandidateProblem:
        """Compose the candidates with a problem's system, all neutral.

        Raises
        ------
        DataError
            A recording is both estimated on and held out.
        """
        step = problem.step
        system = step.system.with_effects(effects)
        joint = compile_step(system, step.time_step, step.force_split, use_compiler=step.compiled)
        estimate = [episode.recording for episode in problem.episodes]
        held = [*held_out] if held_out else [episode.recording for episode in problem.held_out]
        _check_apart(estimate, held)
        values = dict(zip(problem.system.parameters.names, map(float, problem.theta), strict=True))
        made = CandidateProblem(joint, estimate, problem.free, problem.options, values, held)
        made.effects, made.nominal, made.blocks = tuple(effects), tuple(problem.free), not held
        everything = (*problem.free, *(name for effect in effects for name in effect.parameters.names))
        made._everything = everything
        made.readings = _SlicedReadings(system, joint.compiled, everything)
        made._statics = _SlicedStatics(joint, everything)
        if joint.system.driven and problem.options.feedback == "lqr":
            _ = made._momentum_shift  # built once, before copies are made
        if not held:
            made.held_out = tuple(_masked(episode, 1) for episode in made.episodes)
            made.episodes = tuple(_masked(episode, 0) for episode in made.episodes)
        return made

    def held_out_start(self, i: int, theta: Array, x: Array) -> Array:
        """See `EstimationProblem.held_out_start`; where one recording is split in blocks, both have one start."""
        return self.split(x, i)[1] if self.blocks else super().held_out_start(i, theta, x)

    def fitted_start(self, episode: Episode, theta: Array) -> FittedStart:
        """See `EstimationProblem.fitted_start`."""
        twins = {id(held): own for held, own in zip(self.held_out, self.episodes, strict=True)} if self.blocks else {}
        return super().fitted_start(twins.get(id(episode), episode), theta)

    def sensor(self, sensor: Sensor, wanted: tuple[str, ...]) -> Mapped:
        """See `EstimationProblem.sensor`."""
        if not wanted:
            return super().sensor(sensor, wanted)
        full = super().sensor(sensor, self._everything)
        return _SlicedMap(full, [self._everything.index(name) for name in wanted])

    def freeing(self, effects: Sequence[EffectBase], names: Sequence[str] | None = None) -> CandidateProblem:
        """The problem with the parameters of some effects free beside the nominal ones.

        Parameters
        ----------
        effects : sequence of EffectBase
        names : sequence of str, optional
            Those of their parameters to free; all where absent.
        """
        extra = tuple(name for effect in effects for name in effect.parameters.names) if names is None else tuple(names)
        made = copy.copy(self)
        made.free = (*self.nominal, *extra)
        made.shared = tuple(name for name in made.free if name not in self.options.local)
        made._columns = (*made.shared, *made.local)
        made._starts = {}
        for cached in ("_prior_deviations", "_tied"):
            made.__dict__.pop(cached, None)
        return made

    def at(self, values: Mapping[str, float]) -> CandidateProblem:
        """The problem with other values of parameters that are not free."""
        made = copy.copy(self)
        made.theta = self.theta.copy()
        made._starts = {}
        for name, value in values.items():
            made.theta[self.system.parameters.index(name)] = value
        return made

    def unknowns(self, values: Mapping[str, float]) -> Array:
        """Unknown vector with named entries replaced, clipped to the bounds."""
        x = self.start
        for i, name in enumerate(self.names):
            x[i] = values.get(name, x[i])
        return np.clip(x, *self.bounds)

    def named(self, x: Array) -> dict[str, float]:
        """An unknown vector as a mapping."""
        return dict(zip(self.names, map(float, x), strict=True))


def _check_apart(estimate: Sequence[Recording], held: Sequence[Recording]) -> None:
    for recording in held:
        for other in estimate:
            if recording is other or _same(recording, other):
                raise DataError(
                    "a recording is both estimated on and held out",
                    where=recording.name,
                    allowed="held-out recordings of other motions",
                    hint="leave held_out empty to split one recording in blocks",
                )


def _same(a: Recording, b: Recording) -> bool:
    def arrays(recording: Recording) -> list[Array]:
        joints = [] if recording.joints is None else [recording.joints.position]
        return [*joints, *(group.position for group in recording.points)]

    first, second = arrays(a), arrays(b)
    return len(first) == len(second) and all(
        x.shape == y.shape and np.array_equal(x, y, equal_nan=True) for x, y in zip(first, second, strict=True)
    )


def _masked(episode: Episode, parity: int) -> Episode:
    """The episode with the measurements of every other block only; it is rolled out from its start all the same."""
    samples = []
    for entry in episode.samples:
        t = (entry.node + entry.fraction) * episode.grid.time_step
        hidden = (np.floor(t / BLOCK).astype(int) % 2 != parity)[:, None] & np.ones(entry.value.shape, bool)
        value, weight = np.where(hidden, np.nan, entry.value), np.where(hidden, 0.0, entry.weight)
        samples.append(replace(entry, value=value, weight=weight))
    return replace(episode, samples=tuple(samples))


def sample_times(episode: Episode, samples: Measurements) -> Array:
    """Times of samples since the start of their recording, shape (M,) [s]."""
    return np.asarray((samples.node + samples.fraction) * episode.grid.time_step)


def residual_series(problem: EstimationProblem) -> tuple[Series, ...]:
    """How the residual of a problem is made up, output by output."""
    series: list[Series] = []
    at = 0
    for episode in problem.episodes:
        for samples in episode.samples:
            t = sample_times(episode, samples)
            keep = samples.weight > 0
            place = np.full(keep.shape, -1)
            place[keep] = at + np.arange(int(keep.sum()))
            at += int(keep.sum())
            colour = noise_colour(problem, episode, samples)
            for column, channel in enumerate(samples.channel_of_column):
                seen = keep[:, column]
                if seen.any():
                    text = (episode.name, channel, samples.sensor.group, samples.sensor.unit)
                    series.append(Series(*text, t[seen], place[seen, column], colour))
    return tuple(series)


def noise_colour(problem: EstimationProblem, episode: Episode, samples: Measurements) -> Array:
    """Autocorrelation of a sensor's noise at lags 0, 1, ... samples: white, but for efforts, which are smoothed."""
    if not isinstance(samples.sensor, EffortSensor):
        return np.ones(1)
    stride = LowPass(problem.options.path_cutoff).stride(episode.grid.time_step)
    return smoothed_colour(problem.options.path_cutoff, episode.grid.time_step)[::stride]


def smoothed_colour(cutoff: float, step: float) -> Array:
    """Autocorrelation of white noise after the zero-phase filter of paths and efforts."""
    if not np.isfinite(cutoff):
        return np.ones(1)
    half = int(2 / (cutoff * step)) + 10
    impulse = np.zeros((2 * half + 1, 1))
    impulse[half] = 1.0
    times = step * np.arange(2 * half + 1, dtype=float)
    response = LowPass(cutoff)(times, impulse)[:, 0]
    full = np.correlate(response, response, "full")[2 * half :]
    return np.asarray(full[:half] / full[0])


def describe(effects: Sequence[Any]) -> str:
    """`kind@location` of several effects, in words."""
    return " and ".join(effect.label for effect in effects) if effects else "the nominal model"

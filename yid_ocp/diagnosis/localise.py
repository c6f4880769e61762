"""Localisation of the gap from the weak-constraint smoother and from the closure of added effects (step four)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yid_ocp.diagnosis.smoother import Smoothed, Trace
from yid_ocp.diagnosis.smoother_model import Source
from yid_ocp.diagnosis.thresholds import DEFAULTS
from yid_ocp.model.system import System

Array = NDArray[np.float64]

NAMED = 0.1
"""Share of the gap from which a place is named."""
MAIN = 3
"""Places that are named at most."""


@dataclass(frozen=True)
class Place:
    """A location with its share of the gap.

    Attributes
    ----------
    location : str
    share : float
        Of the gap that can be located, between 0 and 1; all shares add up to one.
    observable : bool
        Whether the data would show a gap there.
    windows : tuple of (float, float)
        When it is there [s]; of all recordings together.
    also : tuple of str
        Places that the data cannot tell from this one.
    """

    location: str
    share: float
    observable: bool
    windows: tuple[tuple[float, float], ...]
    also: tuple[str, ...] = ()


def main_places(where: Sequence[Place]) -> tuple[Place, ...]:
    """Return the locations to report: shares above `NAMED`, at most three, at least one."""
    return tuple([place for place in where if place.share > NAMED] or where[:1])[:MAIN]


def localise(smoothed: Smoothed, sure: float = DEFAULTS.sure) -> tuple[Place, ...]:
    """Return all locations by their share of the log evidence, largest first, then observable ones without a share.

    Parameters
    ----------
    smoothed : Smoothed
    sure : float
        Standard deviations that an unknown must be away from zero to say when the gap is there.
    """
    weight: dict[str, float] = {}
    observable: dict[str, bool] = {}
    for source, value in smoothed.weight.items():
        weight[source.location] = weight.get(source.location, 0.0) + value
        noticed = smoothed.detectable[source] < 1.0
        observable[source.location] = observable.get(source.location, False) or noticed or value > 0
    total = sum(weight.values())
    found = [
        Place(
            location,
            value / total if total > 0 else 0.0,
            observable[location],
            _windows(smoothed, [s for s in smoothed.weight if s.location == location and smoothed.variance[s]], sure),
            _also(smoothed, location),
        )
        for location, value in weight.items()
    ]
    return tuple(sorted(found, key=lambda place: (-place.share, not place.observable)))


def _also(smoothed: Smoothed, location: str) -> tuple[str, ...]:
    """Places that would do in the place of every group at work at a location."""
    own = [{entry.location for entry in others} for s, others in smoothed.instead.items() if s.location == location]
    return tuple(sorted(set.intersection(*own) - {location})) if own else ()


def _windows(smoothed: Smoothed, sources: Sequence[Source], limit: float) -> tuple[tuple[float, float], ...]:
    spans = []
    for trace in smoothed.traces:
        own = [i for i, source in enumerate(trace.sources) if source in sources]
        if own:
            sure = np.any(np.abs(trace.mean[:, own]) > limit * np.maximum(trace.std[:, own], 1e-12), axis=1)
            spans += [(float(trace.edges[j]), float(trace.edges[j + 1])) for j in np.flatnonzero(sure)]
    return merged(spans)


def merged(spans: Sequence[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """Merge overlapping or adjacent time intervals."""
    joined: list[list[float]] = []
    for begin, end in sorted(spans):
        if joined and begin <= joined[-1][1] + 1e-9:
            joined[-1][1] = max(joined[-1][1], end)
        else:
            joined.append([begin, end])
    return tuple((a, b) for a, b in joined)


def attributed(
    before: Sequence[Place],
    closed: Mapping[str, float],
    rest: Sequence[Place],
    windows: tuple[tuple[float, float], ...],
) -> tuple[Place, ...]:
    """Return locations with shares by the closure of the effects there, the rest shared out by the smoother.

    Parameters
    ----------
    before : sequence of Place
        Of the nominal model.
    closed : mapping of location to float
        Part of the gap that the effects there close.
    rest : sequence of Place
        Of the model with the effects.
    windows : tuple of (float, float)
        When the residual was more than noise, for locations that the smoother has no unknown for (`world`, `clock`).
    """
    known = {place.location: place for place in before}
    left = max(1.0 - sum(closed.values()), 0.0)
    share = dict(closed)
    for place in rest:
        share[place.location] = share.get(place.location, 0.0) + left * place.share
    total = sum(share.values())
    found = []
    for location in dict.fromkeys([*share, *known]):
        first = known.get(location)
        when = first.windows if first is not None and first.windows else windows if location in closed else ()
        part = share.get(location, 0.0) / total if total > 0 else 0.0
        also = () if first is None or location in closed else first.also
        found.append(Place(location, part, location in closed or (first is not None and first.observable), when, also))
    return tuple(sorted(found, key=lambda place: (-place.share, not place.observable)))


def informed_map(
    smoothed: Smoothed, recording: int = 0, mapped: float = DEFAULTS.mapped
) -> tuple[Array, tuple[str, ...], Array]:
    """Return the unknowns of one recording divided by their posterior standard deviation, NaN if not informed.

    Parameters
    ----------
    smoothed : Smoothed
    recording : int
    mapped : float
        1 - posterior/prior variance from which an unknown's value is informed.

    Returns
    -------
    edges : ndarray, shape (J + 1,)
        [s]
    names : tuple of str, length nd
    values : ndarray, shape (J, nd)
    """
    trace = smoothed.traces[recording]
    prior = np.array([smoothed.variance[source] for source in trace.sources])
    with np.errstate(divide="ignore", invalid="ignore"):
        informed = 1 - trace.std**2 / prior
        values = np.where((prior > 0) & (informed > mapped), trace.mean / trace.std, np.nan)
    return trace.edges, trace.unknowns, values


def units(system: System, trace: Trace) -> tuple[str, ...]:
    """Return the SI unit of every unknown of a trace: force or torque, push, grasp offset or sensor bias."""
    tree = system.mechanism
    sliding = {joint.name for joint in tree.joints if joint.kind == "prismatic"}
    forces = {name: "N" if name in sliding else "N m" for name in tree.joint_names}
    pairs = zip(trace.unknowns, trace.sources, strict=True)
    other = {"push": "N", "offset": "m", "bias": "m"}
    return tuple(forces[name] if source.kind == "force" else other[source.kind] for name, source in pairs)

"""Localisation of the gap from the weak-constraint smoother and from the closure of added effects (step four)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yid_ocp.diagnosis.thresholds import DEFAULT_THRESHOLDS
from yid_ocp.inference.smoother import SmoothedUnknowns, SmootherResult
from yid_ocp.inference.smoother_model import UnknownGroup
from yid_ocp.model.system import System

Array = NDArray[np.float64]

_MIN_NAMED_SHARE = 0.1  # share of the gap from which a place is named
_MAX_NAMED_LOCATIONS = 3  # places that are named at most


@dataclass(frozen=True)
class GapLocation:
    """A location with its share of the gap.

    Attributes
    ----------
    gap_share : float
        Of the gap that can be located, between 0 and 1; all shares add up to one.
    is_observable : bool
        Whether the data would show a gap there.
    time_windows : tuple of (float, float)
        When it is there [s]; of all recordings together.
    indistinguishable_from : tuple of str
        Places that the data cannot tell from this one.
    """

    location: str
    gap_share: float
    is_observable: bool
    time_windows: tuple[tuple[float, float], ...]
    indistinguishable_from: tuple[str, ...] = ()


def main_gap_locations(where: Sequence[GapLocation]) -> tuple[GapLocation, ...]:
    """Return the locations to report: shares above `_MIN_NAMED_SHARE`, at most three, at least one."""
    return tuple([place for place in where if place.gap_share > _MIN_NAMED_SHARE] or where[:1])[:_MAX_NAMED_LOCATIONS]


def localise_gap(
    smoothed: SmootherResult, location_z: float = DEFAULT_THRESHOLDS.location_z
) -> tuple[GapLocation, ...]:
    """Return all locations by their share of the log evidence, largest first, then observable ones without a share.

    Parameters
    ----------
    location_z : float
        Standard deviations that an unknown must be away from zero to say when the gap is there.
    """
    weight: dict[str, float] = {}
    observable: dict[str, bool] = {}
    for source, value in smoothed.log_evidence_drop.items():
        weight[source.location] = weight.get(source.location, 0.0) + value
        noticed = smoothed.detectable_std[source] < 1.0
        observable[source.location] = observable.get(source.location, False) or noticed or value > 0
    total = sum(weight.values())
    found = [
        GapLocation(
            location,
            value / total if total > 0 else 0.0,
            observable[location],
            _windows(
                smoothed,
                [s for s in smoothed.log_evidence_drop if s.location == location and smoothed.group_variance[s]],
                location_z,
            ),
            _also(smoothed, location),
        )
        for location, value in weight.items()
    ]
    return tuple(sorted(found, key=lambda place: (-place.gap_share, not place.is_observable)))


def _also(smoothed: SmootherResult, location: str) -> tuple[str, ...]:
    """Places that would do in the place of every group at work at a location."""
    own = [
        {entry.location for entry in others}
        for s, others in smoothed.alternative_groups.items()
        if s.location == location
    ]
    return tuple(sorted(set.intersection(*own) - {location})) if own else ()


def _windows(
    smoothed: SmootherResult, sources: Sequence[UnknownGroup], limit: float
) -> tuple[tuple[float, float], ...]:
    spans = []
    for trace in smoothed.smoothed_unknowns:
        own = [i for i, source in enumerate(trace.unknown_groups) if source in sources]
        if own:
            sure = np.any(
                np.abs(trace.posterior_mean[:, own]) > limit * np.maximum(trace.posterior_std[:, own], 1e-12), axis=1
            )
            spans += [
                (float(trace.interval_edges[j]), float(trace.interval_edges[j + 1])) for j in np.flatnonzero(sure)
            ]
    return merge_intervals(spans)


def merge_intervals(spans: Sequence[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """Merge overlapping or adjacent time intervals."""
    joined: list[list[float]] = []
    for begin, end in sorted(spans):
        if joined and begin <= joined[-1][1] + 1e-9:
            joined[-1][1] = max(joined[-1][1], end)
        else:
            joined.append([begin, end])
    return tuple((a, b) for a, b in joined)


def attribute_gap_to_effects(
    before: Sequence[GapLocation],
    closed: Mapping[str, float],
    rest: Sequence[GapLocation],
    windows: tuple[tuple[float, float], ...],
) -> tuple[GapLocation, ...]:
    """Return locations with shares by the closure of the effects there, the rest shared out by the smoother.

    Parameters
    ----------
    before : sequence of GapLocation
        Of the nominal model.
    closed : mapping of location to float
        Part of the gap that the effects there close.
    rest : sequence of GapLocation
        Of the model with the effects.
    windows : tuple of (float, float)
        When the residual was more than noise, for locations that the smoother has no unknown for (`world`, `clock`).
    """
    known = {place.location: place for place in before}
    left = max(1.0 - sum(closed.values()), 0.0)
    share = dict(closed)
    for place in rest:
        share[place.location] = share.get(place.location, 0.0) + left * place.gap_share
    total = sum(share.values())
    found = []
    for location in dict.fromkeys([*share, *known]):
        first = known.get(location)
        when = first.time_windows if first is not None and first.time_windows else windows if location in closed else ()
        part = share.get(location, 0.0) / total if total > 0 else 0.0
        also = () if first is None or location in closed else first.indistinguishable_from
        found.append(
            GapLocation(location, part, location in closed or (first is not None and first.is_observable), when, also)
        )
    return tuple(sorted(found, key=lambda place: (-place.gap_share, not place.is_observable)))


def informed_z_scores(
    smoothed: SmootherResult, recording: int = 0, informed_fraction: float = DEFAULT_THRESHOLDS.informed_fraction
) -> tuple[Array, tuple[str, ...], Array]:
    """Return the unknowns of one recording divided by their posterior standard deviation, NaN if not informed.

    Parameters
    ----------
    informed_fraction : float
        1 - posterior/prior variance from which an unknown's value is informed.

    Returns
    -------
    edges : ndarray, shape (J + 1,)
        [s]
    values : ndarray, shape (J, nd)
    """
    trace = smoothed.smoothed_unknowns[recording]
    prior = np.array([smoothed.group_variance[source] for source in trace.unknown_groups])
    with np.errstate(divide="ignore", invalid="ignore"):
        informed = 1 - trace.posterior_std**2 / prior
        values = np.where(
            (prior > 0) & (informed > informed_fraction), trace.posterior_mean / trace.posterior_std, np.nan
        )
    return trace.interval_edges, trace.unknown_names, values


def unknown_units(system: System, trace: SmoothedUnknowns) -> tuple[str, ...]:
    """Return the SI unit of every unknown of a trace: force or torque, push, grasp offset or sensor bias."""
    tree = system.mechanism
    sliding = {joint.name for joint in tree.joints if joint.kind == "prismatic"}
    forces = {name: "N" if name in sliding else "N m" for name in tree.joint_names}
    pairs = zip(trace.unknown_names, trace.unknown_groups, strict=True)
    other = {"push": "N", "offset": "m", "bias": "m"}
    return tuple(forces[name] if source.kind == "force" else other[source.kind] for name, source in pairs)

"""Localisation of the gap from the weak-constraint smoother and from the closure of added effects (step four)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from yid_ocp.arrays import Array, BoolArray
from yid_ocp.diagnosis.thresholds import DEFAULT_THRESHOLDS
from yid_ocp.inference.smoother import SmoothedUnknowns, SmoothedUnknownsResult
from yid_ocp.inference.smoother_model import SmoothedUnknownGroup
from yid_ocp.model.system import System

_MIN_NAMED_SHARE = 0.1  # share of the gap from which a place is named
_MAX_NAMED_LOCATIONS = 3  # places that are named at most


@dataclass(frozen=True)
class GapLocation:
    """A location in the model or sensors with its share of the gap, observability and time windows."""

    location: str
    gap_share: float  # of the gap that can be located; all shares add up to one
    is_observable: bool  # whether the data would show a gap there
    time_windows: tuple[tuple[float, float], ...]  # when it is there, in any recording [s]
    indistinguishable_from: tuple[str, ...] = ()  # places that the data cannot tell from this one


def main_gap_locations(where: Sequence[GapLocation]) -> tuple[GapLocation, ...]:
    """Return the locations to report: those with a share above `_MIN_NAMED_SHARE`, or the first, at most three."""
    return tuple([place for place in where if place.gap_share > _MIN_NAMED_SHARE] or where[:1])[:_MAX_NAMED_LOCATIONS]


def _by_share(places: Iterable[GapLocation]) -> tuple[GapLocation, ...]:
    return tuple(sorted(places, key=lambda place: (-place.gap_share, not place.is_observable)))


def gap_locations_by_smoother_evidence(
    smoothed: SmoothedUnknownsResult, location_z: float = DEFAULT_THRESHOLDS.location_z
) -> tuple[GapLocation, ...]:
    """Return all locations with their share of the log evidence, largest first; at equal shares observable ones first.

    A location's time windows are those in which an unknown is over `location_z` standard deviations from zero.
    """
    groups: dict[str, list[SmoothedUnknownGroup]] = {}
    for source in smoothed.log_evidence_drop:
        groups.setdefault(source.location, []).append(source)
    drop = smoothed.log_evidence_drop
    weight = {location: sum(drop[s] for s in own) for location, own in groups.items()}
    total, found = sum(weight.values()), []
    for location, own in groups.items():
        share = weight[location] / total if total > 0 else 0.0
        seen = any(smoothed.detectable_std[s] < 1.0 or drop[s] > 0 for s in own)
        when = _windows(smoothed, [s for s in own if smoothed.group_variance[s]], location_z)
        # places that would do in the place of every group at work there
        also = [{e.location for e in smoothed.alternative_groups[s]} for s in own if s in smoothed.alternative_groups]
        others = tuple(sorted(set.intersection(*also) - {location})) if also else ()
        found.append(GapLocation(location, share, seen, when, others))
    return _by_share(found)


def smoothed_unknown_significance_mask(trace: SmoothedUnknowns, columns: Sequence[int], limit: float) -> BoolArray:
    """Mask (J, columns) of the unknowns that are more than `limit` standard deviations from zero."""
    std = np.maximum(trace.posterior_std[:, columns], 1e-12)
    return np.asarray(np.abs(trace.posterior_mean[:, columns]) > limit * std)


def _windows(
    smoothed: SmoothedUnknownsResult, sources: Sequence[SmoothedUnknownGroup], limit: float
) -> tuple[tuple[float, float], ...]:
    spans: list[tuple[float, float]] = []
    for trace in smoothed.smoothed_unknowns:
        own = [i for i, source in enumerate(trace.unknown_groups) if source in sources]
        sure = np.flatnonzero(np.any(smoothed_unknown_significance_mask(trace, own, limit), axis=1))
        spans += [(float(trace.interval_edges[j]), float(trace.interval_edges[j + 1])) for j in sure]
    return merge_time_intervals(spans)


def merge_time_intervals(spans: Sequence[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """Merge overlapping or adjacent time intervals; return them in order of time."""
    joined: list[tuple[float, float]] = []
    for begin, end in sorted(spans):
        if joined and begin <= joined[-1][1] + 1e-9:
            begin, last = joined.pop()
            end = max(last, end)
        joined.append((begin, end))
    return tuple(joined)


def gap_locations_from_effect_closures(
    before: Sequence[GapLocation],
    closed: Mapping[str, float],
    rest: Sequence[GapLocation],
    windows: tuple[tuple[float, float], ...],
) -> tuple[GapLocation, ...]:
    """Return locations with gap shares by the closure of effects there; the smoother distributes the rest.

    `before` and `rest` are the locations of the nominal model and of the model with the effects, `closed` is the part
    that the effects at each close, `windows` serve locations without an unknown of the smoother (`world`, `clock`).
    """
    known = {place.location: place for place in before}
    left, share = max(1.0 - sum(closed.values()), 0.0), dict(closed)
    for place in rest:
        share[place.location] = share.get(place.location, 0.0) + left * place.gap_share
    total = sum(share.values())
    found = []
    for location in dict.fromkeys([*share, *known]):
        first = known.get(location, GapLocation(location, 0.0, False, ()))
        part = share.get(location, 0.0) / total if total > 0 else 0.0
        own = replace(first, gap_share=part)
        if location in closed:
            when = first.time_windows or windows
            own = replace(own, is_observable=True, time_windows=when, indistinguishable_from=())
        found.append(own)
    return _by_share(found)


def z_scores_of_smoothed_unknowns(
    smoothed: SmoothedUnknownsResult,
    recording: int = 0,
    informed_fraction: float = DEFAULT_THRESHOLDS.informed_fraction,
) -> tuple[Array, tuple[str, ...], Array]:
    """Return interval edges (J + 1,) [s], unknowns' names, and z scores (J, nd): posterior mean over posterior std.

    Scores are NaN unless 1 - posterior/prior variance is above `informed_fraction`.
    """
    trace = smoothed.smoothed_unknowns[recording]
    prior = np.array([smoothed.group_variance[source] for source in trace.unknown_groups])
    with np.errstate(divide="ignore", invalid="ignore"):
        informed = (prior > 0) & (1 - trace.posterior_std**2 / prior > informed_fraction)
        values = np.where(informed, trace.posterior_mean / trace.posterior_std, np.nan)
    return trace.interval_edges, trace.unknown_names, values


def smoothed_unknown_units(system: System, trace: SmoothedUnknowns) -> tuple[str, ...]:
    """Return the SI unit of every smoothed unknown in `trace`: force, torque, push, grasp offset or sensor bias."""
    pairs = zip(trace.unknown_names, trace.unknown_groups, strict=True)
    other = {"push": "N", "offset": "m", "bias": "m"}
    return tuple(generalised_force_unit(system, name) if of.kind == "force" else other[of.kind] for name, of in pairs)


def generalised_force_unit(system: System, coordinate: str) -> str:
    """Return the SI unit of the generalised force at a coordinate: N for a prismatic joint, else N m."""
    kinds = {joint.name: joint.kind for joint in system.mechanism.joints}
    return "N" if kinds.get(coordinate) == "prismatic" else "N m"

"""Merging of joint states from several sources onto one clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yid_ocp.data.recording import Array, JointGroup
from yid_ocp.errors import DataError

_MAX_INTERPOLATED_PERIODS = 5.0
"""Longest gap of a source that is interpolated, in its sample periods."""


def merge_on_fastest_clock(groups: Sequence[tuple[str, JointGroup]], where: str) -> tuple[JointGroup, tuple[str, ...]]:
    """Merge the joints of several sources onto the clock of the fastest one.

    Values of the others are interpolated linearly between their samples. A time at which one of them has no sample
    within `_MAX_INTERPOLATED_PERIODS` of its periods on both sides is left out, so that a gap stays a gap.

    Parameters
    ----------
    groups : sequence of (str, JointGroup)
        Name of every source, and its joints with strictly increasing times on the same clock.
    where : str
        What errors call the file.

    Returns
    -------
    JointGroup
        All joints, with the channels that every source has.
    tuple of str
        What was done, in words.

    Raises
    ------
    DataError
        Two sources have a joint in common, one lacks a channel that another has, or they share no time.
    """
    if len(groups) == 1:
        return groups[0][1], ()
    _check_separate(groups, where)
    fastest = max(range(len(groups)), key=lambda i: len(groups[i][1].t) / max(np.ptp(groups[i][1].t), 1e-12))
    name, clock = groups[fastest]
    kept = np.ones(len(clock.t), bool)
    for _, group in groups:
        kept &= _can_interpolate(group.t, clock.t)
    if not kept.any():
        listed = "; ".join(f"{name}: {group.t[0]:.6g} to {group.t[-1]:.6g} s" for name, group in groups)
        raise DataError("the joint states share no time", where=where, allowed=listed, hint="choose one of the topics")
    t = clock.t[kept]
    channels: dict[str, Any] = {
        channel: np.hstack([_at(group.t, values, t) for _, group in groups for values in [group.channels[channel]]])
        for channel in clock.channels
    }
    notes = []
    others = [entry for i, entry in enumerate(groups) if i != fastest]
    moved = [source for source, group in others if not np.isin(t, group.t).all()]
    if moved:
        notes.append(f"joint states of {', '.join(moved)} were interpolated to the times of {name}")
    if len(t) < len(clock.t):
        notes.append(f"{len(clock.t) - len(t)} of {len(clock.t)} samples of {name} have none of another topic near")
    names = tuple(joint for _, group in groups for joint in group.names)
    return replace(clock, names=names, t=t, **channels), tuple(notes)


def zero_order_hold(group: JointGroup, t: Array) -> Array:
    """Positions of a group at other times by zero-order hold, shape (N, nj); before its first sample, that one."""
    return group.position[np.maximum(np.searchsorted(group.t, t + 1e-9, side="right") - 1, 0)]


def _can_interpolate(known: Array, t: Array) -> NDArray[np.bool_]:
    """Whether each time is a sample or lies between two samples close enough to interpolate."""
    after = np.searchsorted(known, t)
    before = np.searchsorted(known, t, side="right") - 1
    inside = (after < len(known)) & (before >= 0)
    period = float(np.median(np.diff(known))) if len(known) > 1 else 0.0
    gap = known[np.minimum(after, len(known) - 1)] - known[np.maximum(before, 0)]
    return np.asarray(inside & (gap <= _MAX_INTERPOLATED_PERIODS * period + 1e-12))


def _at(known: Array, values: Array, t: Array) -> Array:
    return np.stack([np.interp(t, known, column) for column in values.T], axis=1)


def _check_separate(groups: Sequence[tuple[str, JointGroup]], where: str) -> None:
    choose = "choose topics: --joint-topic TOPIC, once for each"
    owner: dict[str, str] = {}
    for source, group in groups:
        for joint in group.names:
            if joint in owner:
                what = f"the joint '{joint}' is on {owner[joint]} and on {source}"
                raise DataError(what, where=where, allowed="every joint on one topic", hint=choose)
            owner[joint] = source
    every = {channel for _, group in groups for channel in group.channels}
    for source, group in groups:
        lacking = sorted(every - set(group.channels))
        if lacking:
            what = f"{source} has no {lacking[0]}, which another topic of joint states has"
            raise DataError(what, where=where, allowed="the same channels on every topic", hint=choose)

"""Splitting of recordings at gaps in the signals that drive the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from yid_ocp.data.issues import Issue, median_sample_period
from yid_ocp.data.recording import Recording

Array = NDArray[np.float64]

_MAX_SAMPLE_GAP = 0.1
"""Longest time between samples that is interpolated; arm motion has a bandwidth of 5 Hz [s]."""
_MAX_MISSING_PERIODS = 5
"""Number of sample periods that may always be missing."""
_MIN_PART_DURATION = 0.5
"""Shortest part of a recording that is kept [s]."""
_MAX_ROTATION_AT_REST = 0.01
"""Largest joint rotation in the first 0.2 s of a part that starts at rest [rad]."""
_MAX_CLOCK_JUMP_PERIODS = 5
"""A gap that the joints cross in fewer periods at their speed is a jump of the clock."""
_MIN_JUMP_ROTATION = 0.05
"""Smallest rotation at joint speed over a gap that allows a clock jump to be detected [rad]."""


@dataclass(frozen=True)
class RecordingParts:
    """Parts of a recording between its gaps, and one issue for each gap."""

    recordings: tuple[Recording, ...]
    issues: tuple[Issue, ...]


def split_at_gaps(recording: Recording, driving: Sequence[str], anywhere: bool) -> RecordingParts:
    """Split a recording at gaps in the signals that drive the model.

    Parameters
    ----------
    recording : Recording
    driving : sequence of str
        Points that drive it besides the joints: those that clamps follow.
    anywhere : bool
        Whether a rollout may start in motion; else later parts are kept only where they start at rest.

    Returns
    -------
    Parts
        The recording itself where there is no gap.
    """
    t = _times(recording, driving)
    steps = np.diff(t)
    if len(steps) < 2:
        return RecordingParts((recording,), ())
    allowed = max(_MAX_SAMPLE_GAP, _MAX_MISSING_PERIODS * float(np.median(steps)))
    gaps = np.flatnonzero(steps > allowed)
    if not len(gaps):
        return RecordingParts((recording,), ())
    edges = [(0, gaps[0]), *((a + 1, b) for a, b in pairwise(gaps)), (gaps[-1] + 1, len(t) - 1)]
    kept = []
    for begin, end in edges:
        part = None if t[end] - t[begin] < _MIN_PART_DURATION else recording.time_slice(float(t[begin]), float(t[end]))
        if part is not None and (begin == 0 or anywhere or _rests(part)):
            kept.append(part)
    left = sum(part.duration for part in kept)
    parts = [f"_part{i + 1}" for i in range(len(kept))] if len(kept) > 1 else [""]
    named = tuple(replace(one, name=f"{recording.name}{part}") for one, part in zip(kept, parts, strict=False))
    said = (
        f"{len(kept)} part{'' if len(kept) == 1 else 's'} of it, {left:.3g} s, {'is' if len(kept) == 1 else 'are'} used"
    )
    if not anywhere and len(kept) < len(edges):
        said += "; a part counts only where it starts at rest"
    return RecordingParts(named, tuple(_doubt(recording, t, int(gap), allowed, said) for gap in gaps))


def _times(recording: Recording, driving: Sequence[str]) -> Array:
    """Times at which all that drives the model was seen."""
    if recording.joints is not None:
        return recording.joints.t
    for group in recording.points:
        columns = [group.names.index(name) for name in driving if name in group.names]
        if columns:
            return group.t[np.isfinite(group.position[:, columns]).all(axis=(1, 2))]
    return recording.points[0].t


def _rests(part: Recording) -> bool:
    joints = part.joints
    if joints is None:
        return False
    first = joints.t <= joints.t[0] + 0.2
    return float(np.max(np.ptp(joints.position[first], axis=0))) < _MAX_ROTATION_AT_REST


def _doubt(recording: Recording, t: Array, gap: int, allowed: float, said: str) -> Issue:
    length = float(t[gap + 1] - t[gap])
    joints, jumped = recording.joints, False
    if joints is not None and gap >= 5 and gap + 6 < len(t):
        before = (joints.position[gap] - joints.position[gap - 5]) / (t[gap] - t[gap - 5])
        after = (joints.position[gap + 6] - joints.position[gap + 1]) / (t[gap + 6] - t[gap + 1])
        speed = 0.5 * (np.abs(before) + np.abs(after)) * (np.sign(before) == np.sign(after))
        way = np.abs(joints.position[gap + 1] - joints.position[gap])
        fastest = float(np.max(speed))
        jumped = bool(
            fastest * length > _MIN_JUMP_ROTATION
            and np.max(way) < _MAX_CLOCK_JUMP_PERIODS * median_sample_period(t) * fastest
        )
    what = f"nothing was recorded of what drives the model for {length:.3g} s"
    if jumped:
        what = f"the clock jumps by {length - median_sample_period(t):.3g} s while the joints go on as if it had not"
    return Issue(
        "clock_jump" if jumped else "gap",
        f"{what}; {said}",
        "warning",
        length / allowed,
        "find what lost the samples, or list the part that is wanted as a recording of its own",
        recording.name,
        "joints" if joints is not None else "",
        "t",
        float(t[gap]),
        float(t[gap + 1]),
    )

"""Step four: where the gap lies.

Efforts of prescribed joints need no inference: the discrete inverse dynamics makes the residual of a joint the
generalized force that the model lacks there. Anywhere else the promised decreases of all candidates are compared place
by place; a place that no visible candidate reaches is not observable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yid_ocp.diagnosis.hypotheses import Series
from yid_ocp.diagnosis.null_test import NullTest, Window
from yid_ocp.diagnosis.score import Score, Visibility

Array = NDArray[np.float64]

EFFORT = "joints.effort."


@dataclass(frozen=True)
class Place:
    """One location's part of the gap.

    Attributes
    ----------
    location : str
    share : float
        Of the gap that can be located, between 0 and 1; all shares add up to one.
    observable : bool
        Whether the data would show a gap there.
    windows : tuple of (float, float)
        When it is there [s]; of all recordings together.
    """

    location: str
    share: float
    observable: bool
    windows: tuple[tuple[float, float], ...]


def localise(
    series: Sequence[Series],
    residual: Array,
    test: NullTest,
    scores: Sequence[Score],
    visible: Sequence[Visibility],
) -> tuple[Place, ...]:
    """Locations by their share of the gap, largest first."""
    if series and all(s.channel.startswith(EFFORT) for s in series):
        return by_effort(series, residual, test.windows)
    return by_scores(scores, visible, test.windows)


def by_effort(series: Sequence[Series], residual: Array, windows: Sequence[Window]) -> tuple[Place, ...]:
    """Shares of prescribed joints in the excess of the whitened effort residual over noise."""
    excess: dict[str, float] = {}
    for s in series:
        joint = s.channel.removeprefix(EFFORT)
        excess[joint] = excess.get(joint, 0.0) + float(np.sum(residual[s.rows] ** 2)) - len(s.rows)
    flagged = {
        joint: _merged([w for w in windows if w.flagged and w.channel == f"{EFFORT}{joint}"]) for joint in excess
    }
    return _ranked({joint: max(value, 0.0) for joint, value in excess.items()}, set(excess), flagged)


def by_scores(scores: Sequence[Score], visible: Sequence[Visibility], windows: Sequence[Window]) -> tuple[Place, ...]:
    """Shares of places in the decrease of r'r that the best candidate of each promises."""
    places = dict.fromkeys(entry.effect.location for entry in visible)
    seen = {entry.effect.location for entry in visible if entry.visible}
    best = dict.fromkeys(places, 0.0)
    for score in scores:
        best[score.effect.location] = max(best[score.effect.location], score.decrease)
    when = _merged([w for w in windows if w.flagged])
    return _ranked(best, seen, dict.fromkeys(places, when))


def _ranked(
    amounts: Mapping[str, float], observable: set[str], windows: Mapping[str, tuple[tuple[float, float], ...]]
) -> tuple[Place, ...]:
    total = sum(amounts.values())
    found = [
        Place(location, amount / total if total > 0 else 0.0, location in observable, windows[location])
        for location, amount in amounts.items()
    ]
    return tuple(sorted(found, key=lambda place: -place.share))


def _merged(windows: Sequence[Window]) -> tuple[tuple[float, float], ...]:
    """Stretches of time that flagged windows cover."""
    joined: list[list[float]] = []
    for begin, end in sorted((w.begin, w.end) for w in windows):
        if joined and begin <= joined[-1][1] + 1e-9:
            joined[-1][1] = max(joined[-1][1], end)
        else:
            joined.append([begin, end])
    return tuple((a, b) for a, b in joined)

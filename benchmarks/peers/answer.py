"""What a tool answers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Answer:
    """Estimates, 95 % intervals where the tool states some, and what it says of them.

    `doubted` are parameters that the tool itself does not call known; `messages` its own warnings. `held_out` are
    root mean square errors of the tool's own predictions of held-out recordings [rad], where no true values are known.
    """

    estimates: Mapping[str, float]
    intervals: Mapping[str, tuple[float, float]] | None = None
    doubted: tuple[str, ...] = ()
    messages: tuple[str, ...] = ()
    held_out: tuple[float, ...] = ()

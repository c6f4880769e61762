"""Rows that the report and the command line show alike."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

MOST_POINTS = 4  # a group of more points is shown as a whole; result.json has every point


@dataclass(frozen=True)
class HeldOutRow:
    """Error of one channel, or of a whole group of points, beside that of every baseline; [unit]."""

    recording: str
    channel: str
    rmse: float
    unit: str
    baselines: Mapping[str, float]


def held_out_rows(result: Mapping[str, Any]) -> list[HeldOutRow]:
    """Rows of the held-out recordings of a `yid-solve/1` result that people want to see."""
    units = {channel: entry["unit"] for channel, entry in result["residuals"].items()}
    rows = []
    for entry in result["held_out"]:
        for channel, rmse in entry["rmse"].items():
            if channel in _hidden(entry["rmse"]):
                continue
            members = [unit for name, unit in units.items() if name == channel or name.startswith(f"{channel}.")]
            baselines = {name: errors[channel] for name, errors in entry["baselines"].items() if channel in errors}
            rows.append(HeldOutRow(entry["recording"], channel, rmse, members[0] if members else "", baselines))
    return rows


def _hidden(errors: Mapping[str, float]) -> set[str]:
    hidden: set[str] = set()
    for group in errors:
        members = {channel for channel in errors if channel.startswith(f"{group}.")}
        if len(members) > MOST_POINTS:
            hidden |= members
        elif members:
            hidden.add(group)
    return hidden


def medians(rows: Sequence[HeldOutRow]) -> list[HeldOutRow]:
    """Median over recordings of every channel that several of them have."""
    channels = dict.fromkeys(row.channel for row in rows)
    result = []
    for channel in channels:
        own = [row for row in rows if row.channel == channel]
        if len(own) > 2:
            names = [name for name in own[0].baselines if all(name in row.baselines for row in own)]
            baselines = {name: statistics.median(row.baselines[name] for row in own) for name in names}
            median = statistics.median(row.rmse for row in own)
            result.append(HeldOutRow(f"median of {len(own)}", channel, median, own[0].unit, baselines))
    return result
